"""Decides what of one policy another one lacks: the values behind `edit.merge_into`.

Nothing here weakens: a denial stays whatever asks for more, and a right is added for the one
direction in which it was asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sros_tool.names import expand
from sros_tool.notes import Note
from sros_tool.policy.model import ALLOW, DENY, Policy, Qualifier
from sros_tool.policy.rights import (
    RIGHT_ORDER,
    Right,
    Rules,
    Said,
    folded,
    order,
    policy_rights,
    sayable,
)

_MANY = 3


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A right that one side allows and the other denies, wholly or in part.

    The denial always holds.  ``new`` says that the merge brought it, while the file allowed the
    right; otherwise the denial stood in the file, and the right was asked for.
    """

    denied: Right
    allowed: Right
    new: bool


@dataclass(frozen=True, slots=True)
class Entry:
    """A name to be added to a profile, as it is to be written, with the rights to be added."""

    kind: str
    name: str
    rights: Said


@dataclass(frozen=True, slots=True)
class Place:
    """A profile: of which enclave, namespace and node."""

    enclave: str
    ns: str
    node: str


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be added where, the same as rights, and what contradicts."""

    entries: dict[Place, tuple[Entry, ...]]
    added: tuple[Right, ...]
    contradictions: tuple[Contradiction, ...]


def plan_merge(before: Policy, additions: Policy) -> Plan:
    """What ``before`` lacks of ``additions``.

    Not added is what ``before`` says already for that enclave, by whatever profile or wildcard,
    and what it denies as a whole.
    """
    return _Planner(before, additions).plan()


class _Planner:
    def __init__(self, before: Policy, additions: Policy) -> None:
        self._additions = additions
        self._file = Rules(policy_rights(before))
        self._asked = Rules(policy_rights(additions))
        self._wanted: dict[Right, bool] = {}
        self._contradictions: list[Contradiction] = []

    def plan(self) -> Plan:
        names: dict[Place, dict[tuple[str, str], _Name]] = {}
        for enclave in self._additions.enclaves:
            for profile in enclave.all_profiles():
                place = Place(enclave.path, profile.ns, profile.node)
                here = names.setdefault(place, {})
                for group in profile.groups:
                    for name in group.names:
                        fqn = expand(name, profile.ns, profile.node)
                        for right, qualifier in group.rights:
                            if self._is_wanted(Right(enclave.path, qualifier, right, fqn)):
                                entry = here.setdefault((group.kind, fqn), _Name(name, {}))
                                entry.rights[right, qualifier] = None
        entries = {
            place: tuple(sorted(_entries(found), key=_entry_order))
            for place, found in sorted(names.items(), key=lambda item: _place_order(item[0]))
            if found
        }
        added = [right for right, wanted in self._wanted.items() if wanted]
        return Plan(entries, tuple(sorted(added, key=order)), tuple(self._contradictions))

    def _is_wanted(self, right: Right) -> bool:
        known = self._wanted.get(right)
        if known is None:
            known = self._wanted[right] = self._decide(right)
        return known

    def _decide(self, right: Right) -> bool:
        if right.qualifier is DENY:
            if self._file.cover(right):
                return False
            for allowed in folded(self._file.meeting(right._replace(qualifier=ALLOW))):
                self._contradictions.append(Contradiction(right, allowed, True))
            return True
        denial = right._replace(qualifier=DENY)
        for denied in folded(self._file.meeting(denial)):
            if not self._asked.cover(denied):  # else both sides mean the same exception
                self._contradictions.append(Contradiction(denied, right, False))
        return not (self._file.cover(right) or self._file.cover(denial))


@dataclass(frozen=True, slots=True)
class _Name:
    """A name as it is written first, and the rights on it that are wanted."""

    written: str
    rights: dict[tuple[str, Qualifier], None]


def _entries(found: dict[tuple[str, str], _Name]) -> Iterable[Entry]:
    for (kind, _), name in found.items():
        for qualifiers in sayable(name.rights):
            yield Entry(kind, name.written, qualifiers)


def _place_order(place: Place) -> tuple[str, str, str]:
    return place.enclave, place.ns, place.node


def _entry_order(entry: Entry) -> tuple[int, Said, str]:
    return RIGHT_ORDER[entry.rights[0][0]], entry.rights, entry.name


# ── telling ────────────────────────────────────────────────────────────────────────────────


def merge_notes(contradictions: Sequence[Contradiction]) -> tuple[Note, ...]:
    """One remark for each denial that a merge met."""
    by_denial: dict[tuple[Right, bool], list[Right]] = {}
    for each in contradictions:
        by_denial.setdefault((each.denied, each.new), []).append(each.allowed)
    notes = []
    for (denied, new), allowed in by_denial.items():
        told = [right.told() for right in dict.fromkeys(sorted(allowed, key=order))]
        some = ", ".join(told[:_MANY])
        if len(told) > _MANY:
            some += f" and {len(told) - _MANY} more"
        if new:
            text = f"{denied} was added. It takes away from what the file allows: {some}."
            notes.append(Note("merge.newly-denied", text))
        else:
            text = f"{denied} stays, and counts before what was asked for: {some}."
            notes.append(Note("merge.still-denied", text))
    return tuple(notes)
