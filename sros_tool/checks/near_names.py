"""Names of ROS that are equal but for one letter, or for capitals and separators: typing errors."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator

_PARTS = re.compile(r"([/_])")
_DIGITS = re.compile(r"\d+")
_SHORTEST = 4  # letters of a part: /arm_l and /arm_r are two arms, and min and max two words


class NearNames:
    """Names to compare others with; each comparison takes the same time, however many there are."""

    def __init__(self, names: Iterable[str]) -> None:
        self._by_key: dict[str, list[str]] = defaultdict(list)
        for name in dict.fromkeys(names):
            for key in set(_keys(name)):
                self._by_key[key].append(name)

    def near(self, name: str) -> list[str]:
        """Return the names that are nearly equal to ``name``, sorted; not ``name`` itself.

        One part between "/" and "_" has one letter more, less or another, or two letters changed
        places; or the names differ only in capitals and separators.  Parts that differ in digits,
        or are shorter than four letters, are names of different things.
        """
        found = {each for key in set(_keys(name)) for each in self._by_key.get(key, ())}
        return sorted(each for each in found if each != name and _is_near(name, each))


def _keys(name: str) -> Iterator[str]:
    """Yield texts of which nearly equal names have one in common."""
    yield _plain(name)
    parts = _PARTS.split(name)
    for index, part in enumerate(parts):
        if len(part) < _SHORTEST - 1:
            continue
        before, after = "".join(parts[:index]), "".join(parts[index + 1 :])
        for at in range(len(part) + 1):  # with the letter at this place left out, at last none
            yield f"{before}{part[:at]}{part[at + 1 :]}\0{after}"


def _plain(name: str) -> str:
    return name.replace("_", "").replace("/", "").lower()


def _is_near(one: str, other: str) -> bool:
    if _plain(one) == _plain(other):
        return True
    pairs = zip(_PARTS.split(one), _PARTS.split(other), strict=False)
    different = [(a, b) for a, b in pairs if a != b]
    if len(different) != 1:
        return False
    a, b = sorted(different[0], key=len)
    if len(b) < _SHORTEST or _DIGITS.sub("", a) == _DIGITS.sub("", b):
        return False
    return _one_edit(a, b)


def _one_edit(a: str, b: str) -> bool:
    """Return whether ``b``, which is not shorter, is ``a`` with one letter typed wrong."""
    at = next((index for index, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), len(a))
    if len(a) < len(b):
        return a[at:] == b[at + 1 :]
    changed_places = a[at : at + 2] == b[at : at + 2][::-1] and a[at + 2 :] == b[at + 2 :]
    return a[at + 1 :] == b[at + 1 :] or changed_places
