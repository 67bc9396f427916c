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
