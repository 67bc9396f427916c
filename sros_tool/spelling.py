"""ROS names that are nearly equal, as a typing error makes them."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator

_SEPARATORS = re.compile(r"([/_])")
_DIGITS = re.compile(r"\d+")
_SHORTEST_PART = 4
"""Letters of the shortest part that can have a typing error: /arm_l and /arm_r are two names."""
_MOST_SAME_ENDS = 8
"""Maximum number of names with the same last part; a last part of more names says nothing."""


class NearNames:
    """An index of names that finds similar names in constant time."""

    def __init__(self, names: Iterable[str]) -> None:
        self._by_key: dict[str, list[str]] = defaultdict(list)
        self._by_end: dict[str, list[str]] = defaultdict(list)
        self._by_last: dict[str, list[str]] = defaultdict(list)
        self._names = dict.fromkeys(names)
        for name in self._names:
            self._by_last[name.rpartition("/")[2]].append(name)
            for end in _name_ends(name):
                self._by_end[end].append(name)
            for key in set(_index_keys(name)):
                self._by_key[key].append(name)

    def similar_names(self, name: str) -> list[str]:
        """Return the sorted names, other than ``name``, that are spelled like ``name``."""
        candidates = {
            candidate for key in set(_index_keys(name)) for candidate in self._by_key.get(key, ())
        }
        return sorted(
            candidate
            for candidate in candidates
            if candidate != name and is_spelled_alike(name, candidate)
        )

    def same_name_elsewhere(self, name: str) -> list[str]:
        """Return the sorted names that are ``name`` with a namespace added in front, or removed."""
        shorter = (end for end in _name_ends(name) if end in self._names)
        longer = self._by_end.get(name, ()) if name.count("/") > 1 else ()
        return sorted({*shorter, *longer} - {name})

    def names_with_same_end(self, name: str) -> list[str]:
        """Return the sorted names with the same last part as ``name``, without ``name`` itself.

        Empty if there are many: a last part that many names share says nothing.
        """
        names = self._by_last.get(name.rpartition("/")[2], ())
        return sorted({*names} - {name}) if len(names) <= _MOST_SAME_ENDS else []


def _name_ends(name: str) -> Iterator[str]:
    """Yield the proper suffixes of a name that have at least two parts."""
    parts = name.split("/")[1:]
    for at in range(1, len(parts) - 1):
        yield "/" + "/".join(parts[at:])


def _index_keys(name: str) -> Iterator[str]:
    """Yield index keys of a name; similar names have a key in common."""
    yield _without_separators(name)
    parts = _SEPARATORS.split(name)
    for index, part in enumerate(parts):
        if len(part) < _SHORTEST_PART - 1:
            continue
        before, after = "".join(parts[:index]), "".join(parts[index + 1 :])
        # The part without each of its letters, and at last the whole part.
        for at in range(len(part) + 1):
            yield f"{before}{part[:at]}{part[at + 1 :]}\0{after}"


def _without_separators(name: str) -> str:
    return name.replace("_", "").replace("/", "").lower()


def is_spelled_alike(first_name: str, second_name: str) -> bool:
    """Return whether two names differ by one typing error, or only in capitals and separators.

    A typing error adds, removes or replaces one letter of a part (between "/" and "_"), or swaps
    two neighbors.  Parts that differ in digits, or have less than four letters, are not alike.
    """
    if _without_separators(first_name) == _without_separators(second_name):
        return True
    pairs = zip(_SEPARATORS.split(first_name), _SEPARATORS.split(second_name), strict=False)
    different = [(a, b) for a, b in pairs if a != b]
    if len(different) != 1:
        return False
    a, b = sorted(different[0], key=len)
    if len(b) < _SHORTEST_PART or _DIGITS.sub("", a) == _DIGITS.sub("", b):
        return False
    return _is_one_edit(a, b)


def is_typing_error(a: str, b: str) -> bool:
    """Return whether two names differ by a typing error, not only in capitals and separators."""
    return _without_separators(a) != _without_separators(b) and is_spelled_alike(a, b)


def _is_one_edit(a: str, b: str) -> bool:
    """Return whether one typing error turns ``a`` into ``b``; ``b`` is at least as long."""
    at = next((index for index, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), len(a))
    if len(a) < len(b):
        return a[at:] == b[at + 1 :]
    changed_places = a[at : at + 2] == b[at : at + 2][::-1] and a[at + 2 :] == b[at + 2 :]
    return a[at + 1 :] == b[at + 1 :] or changed_places
