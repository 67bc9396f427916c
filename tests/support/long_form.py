"""What only the long form of the tests runs, and what the short form draws."""

from __future__ import annotations

import os
import random
from collections.abc import Sequence
from typing import TypeVar

import pytest

from tests.support.children import LONG

ONLY_LONG = pytest.mark.skipif(not LONG, reason="only in the long form")
"""Marks cases whose mechanism another case shows in the short form, too."""

SEED = os.environ.setdefault("SROS_SEED", str(random.SystemRandom().randrange(1_000_000)))
"""What is drawn depends on; the same in all processes of a run, and in its first lines."""

_Item = TypeVar("_Item")


def drawn(name: str, part: float) -> bool:
    """Return whether a case belongs to the random part of this run; in the long form all do."""
    return LONG or random.Random(f"{SEED} {name}").random() < part


def some(items: Sequence[_Item], number: int) -> list[_Item]:
    """Return so many items, drawn anew in every run, in their order; in the long form all."""
    if LONG or number >= len(items):
        return list(items)
    places = random.Random(SEED).sample(range(len(items)), number)
    return [items[place] for place in sorted(places)]


def few_steps(steps: Sequence[int]) -> Sequence[int]:
    """Return the first step, the last and one that is drawn; in the long form all.

    That nothing is left half done after any step, the tests of the transaction itself show.
    """
    return list(steps) if LONG else [steps[0], *some(steps[1:-1], 1), *steps[1:][-1:]]


def sometimes(name: str, part: float = 1 / 8) -> pytest.MarkDecorator:
    """Mark a test that a ``part`` of the short runs has, and the long form always."""
    return pytest.mark.skipif(not drawn(name, part), reason=f"not drawn by SROS_SEED={SEED}")
