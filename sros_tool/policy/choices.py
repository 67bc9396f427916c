"""The names that ``?`` and sets of characters in an expression stand for."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from math import prod
from string import ascii_letters, digits

_LETTERS = "_" + digits + ascii_letters
_PIECE = re.compile(r"\[(!?)([^\]]+)\]|(\?)|([^?\[]+)")
_RANGE = re.compile(r"(.)-(.)|(.)", re.DOTALL)
_STARS = re.compile(r"\*\*+")


class TooManyNames(Exception):  # noqa: N818 - the caller makes an error of it
    """An expression stands for too many others."""


def listed(expression: str, most: int) -> list[str]:
    """Return expressions whose only wildcard is ``*`` and that match the same ROS names.

    A ``?`` is any character of ROS names.

    Raises:
        TooManyNames: there are more than ``most``.
    """
    if "?" not in expression and "[" not in expression:
        return [_STARS.sub("*", expression)]
    pieces = [_choices(*match.groups()) for match in _PIECE.finditer(expression)]
    if prod(map(len, pieces)) > most:
        raise TooManyNames
    names = ("".join(choice) for choice in product(*pieces))
    # "/" next to another one or at the end is in no name.
    found = (_STARS.sub("*", name) for name in names if "//" not in name and name[-1:] != "/")
    return list(dict.fromkeys(found))


def _choices(negated: str, members: str, one: str, text: str) -> Sequence[str]:
    if text:
        return [text]
    if one:
        return _LETTERS + "/"
    chosen: set[str] = set()
    for low, high, single in _RANGE.findall(members):
        chosen.update([single] if single else map(chr, range(ord(low), ord(high) + 1)))
    return [letter for letter in _LETTERS + "/" if (letter in chosen) is not bool(negated)]
