"""Choose the enclaves of a large keystore that a picture reads in full.

Reading an enclave as vendors do takes milliseconds, and equal units (robots, or namespaces and
enclaves that look alike) are drawn once anyway.  So if the signed permissions of units have the
same text except for the units' names, only the first and the last of these units are read in full.
For the units in between, the picture relies on this comparison of texts.
"""

from __future__ import annotations

import hashlib
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from sros_tool.errors import SrosError
from sros_tool.fleet.robots import Robot
from sros_tool.keystore.layout import PERMISSIONS_FILE
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import load_rights
from sros_tool.policy.rights import Right
from sros_tool.report.folding import DrawnUnit, UnitNames, name_order, units_of
from sros_tool.report.picture import UnreadUnits
from sros_tool.xml import read_bytes

_MAX_READ_IN_FULL = 1000
"""Maximum number of enclaves for which a picture reads all enclaves."""
_BOUNDARY = re.compile(rb'(?i)multipart/signed[^\r\n]*boundary="([^"\r\n]+)"')
_VALIDITY = re.compile(r"<not_(before|after)>[^<]*</not_\1>")
_UNIT_MARKS = "\x01\x02"
"""Characters that stand for the name of a unit and its namespace; XML cannot have them."""


class SampledKeystore(NamedTuple):
    """The enclaves of a keystore to read in full, and the units of all other enclaves.

    ``unread`` are these units, and ``left_out`` their numbers in ``names``.
    """

    keystore: OpenedKeystore
    enclaves: tuple[str, ...]
    unread: tuple[UnreadUnits, ...] = ()
    names: UnitNames = UnitNames((), ())
    left_out: frozenset[int] = frozenset()

    def without_unread_units(self, rights: Collection[Right]) -> frozenset[Right]:
        """Return the rights, except rights to names of units that are not read."""
        if not self.left_out:
            return frozenset(rights)
        return frozenset(
            right for right in rights if self.left_out.isdisjoint(self.names.text(right.name).units)
        )


def sample_of(
    keystore: OpenedKeystore, robots: Mapping[str, Robot], wanted_names: Collection[str] = ()
) -> SampledKeystore:
    """Return the enclaves of a keystore to read in full: all of them, or a sample of equal units.

    Args:
        keystore: the keystore.
        robots: the robots of the keystore's fleet, by enclave.
        wanted_names: names of units that are read in any case.

    All units that use names of other units are read. Everything is read if names of units are
    ambiguous, or if too few units are alike.
    """
    paths = keystore.names
    whole_keystore = SampledKeystore(keystore, paths)
    if len(paths) <= _MAX_READ_IN_FULL:
        return whole_keystore
    units = units_of(paths, robots)
    names = UnitNames(units, paths)
    if any(_is_ambiguous(word, names.words) for word in names.words):
        return whole_keystore
    enclaves: dict[int, list[str]] = defaultdict(list)
    for path, number in names.unit_of.items():
        enclaves[number].append(path)
    equal_units: dict[object, list[int]] = defaultdict(list)
    for n in sorted(enclaves, key=lambda n: name_order(units[n].name)):
        digest = _digest_of(keystore, enclaves[n], units[n], names)
        equal_units[units[n].family, digest or n].append(n)
    # Equal units name the same other units, so looking at the first one is enough.
    few = {
        n: number
        for number, (first, *further) in enumerate(equal_units.values())
        if len(further) > 1 and _named_units(keystore, enclaves[first], names) <= {first}
        for n in (first, *further)
    }
    other_paths = [path for path in paths if names.unit_of.get(path) not in few]
    if len(other_paths) > _MAX_READ_IN_FULL:
        return whole_keystore
    named: dict[int, set[Right]] = defaultdict(set)
    for right in load_rights(keystore, only_enclaves=other_paths).rights:
        of_right = {*names.text(right.name).units}
        for n in of_right & few.keys():
            if len(of_right) > 1:
                return whole_keystore
            named[n].add(right._replace(name=_without_unit_names(right.name, units[n], names)))
    equal: dict[object, list[int]] = defaultdict(list)
    for n, number in few.items():
        equal[number, frozenset(named[n])].append(n)
    unread, left_out = [], set()
    for first, *further in equal.values():
        if unread_units := [n for n in further[:-1] if units[n].name not in wanted_names]:
            members = tuple(units[n].name for n in unread_units)
            number = sum(len(enclaves[n]) for n in unread_units)
            unread.append(UnreadUnits(units[first].what, members, number, units[first].name))
            left_out |= {*unread_units}
    chosen = tuple(path for path in paths if names.unit_of.get(path) not in left_out)
    return SampledKeystore(keystore, chosen, tuple(unread), names, frozenset(left_out))


def _is_ambiguous(word: str, words: Collection[str]) -> bool:
    """Return whether a part of a unit's word is the word of another unit, such as r1 in r1_2."""
    pieces = word.split("_")
    return any(
        "_".join(pieces[begin:end]) in words
        for begin in range(len(pieces))
        for end in range(begin + 1, len(pieces) + 1)
        if end - begin < len(pieces)
    )


_UNIQUE_SUBJECT_PART = re.compile(",OU=[0-9a-f]{16}(?=</subject_name>)")
"""The part that makes a certificate's subject unique, and that says nothing about rights."""


def _digest_of(
    keystore: OpenedKeystore, enclaves: Sequence[str], unit: DrawnUnit, names: UnitNames
) -> str:
    """Return a digest of a unit's permissions with the unit's name masked.

    Returns "" if permissions of the unit cannot be read, or are not in the usual form.
    """
    texts = {path: _signed_text(keystore, path) for path in enclaves}
    hidden = [
        hashlib.sha256(
            f"{_without_unit_names(path, unit, names)}\n"
            f"{_without_unit_names(_UNIQUE_SUBJECT_PART.sub('', text), unit, names)}".encode()
        )
        for path, text in texts.items()
        if text and not any(mark in text for mark in _UNIT_MARKS)
    ]
    if len(hidden) < len(enclaves):
        return ""
    return hashlib.sha256(b"".join(sorted(masked.digest() for masked in hidden))).hexdigest()


def _without_unit_names(text: str, unit: DrawnUnit, names: UnitNames) -> str:
    """Return a text in which a mark replaces each name of the unit."""
    for word in sorted(unit.values, key=len, reverse=True):
        if word in names.words:
            text = _with_mark(text, word, _UNIT_MARKS[names.words[word][1]])
    return text


def _with_mark(text: str, word: str, mark: str) -> str:
    """Return a text with ``mark`` in place of each whole word ``word``.

    This is faster than a regular expression, which would be compiled for each robot.
    """
    first, *later_parts = f"{text}\n".split(word)
    parts, before = [first], first[-1:]
    for part in later_parts:
        alone = not (before.isalnum() or (part or word)[0].isalnum())
        parts += (mark if alone else word, part)
        before = (part or word)[-1]
    return "".join(parts)[:-1]


def _named_units(keystore: OpenedKeystore, enclaves: Iterable[str], names: UnitNames) -> set[int]:
    """Return the units whose names are in the permissions of enclaves."""
    texts = (_signed_text(keystore, path) or "" for path in enclaves)
    lines = {line for text in texts for line in text.splitlines()}
    return {unit for line in lines for unit in names.text(line).units}


def _signed_text(keystore: OpenedKeystore, path: str) -> str | None:
    """Return the signed text of an enclave's permissions without dates, or None."""
    try:
        data = read_bytes(keystore.folder(path) / PERMISSIONS_FILE, "permissions document")
        boundary = _BOUNDARY.search(data[:1000])
    except SrosError:
        return None
    parts = data.split(b"--" + boundary[1]) if boundary else []
    try:
        return _VALIDITY.sub("", parts[1].decode()) if len(parts) == 4 else None
    except ValueError:
        return None
