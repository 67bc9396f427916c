"""Find requirements that a new version of a requirements file drops or weakens.

Whoever changes a policy can also change its requirements.  A requirement counts as kept if
requirements of the new file together demand at least as much, whatever their names and order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from sros_tool.checks.kind import Finding, RelatedPlace
from sros_tool.checks.requirements import DROPPED
from sros_tool.policy.model import Level
from sros_tool.policy.patterns import covers, overlap
from sros_tool.proof.requirements import (
    EXCEPT,
    Apart,
    AtMost,
    Must,
    Nobody,
    NotBoth,
    NothingBut,
    OfRights,
    Only,
    Protected,
    Requirement,
    RightNames,
    Widest,
    demand,
)
from sros_tool.values import shows


@shows("change", "demand", "name", "why", "file", "line", "now")
@dataclass(frozen=True, slots=True)
class DroppedRequirement:
    """A requirement of the earlier file that the new file drops or weakens.

    ``requirement`` has its place in the earlier file; ``kept`` are requirements of the new file
    about some of the same names or enclaves.
    """

    requirement: Requirement
    kept: tuple[Requirement, ...] = ()

    @property
    def change(self) -> str:
        """``dropped`` if the new file demands nothing similar, else ``weakened``."""
        return "weakened" if self.kept else "dropped"

    @property
    def demand(self) -> str:
        """The demand of the requirement, as a clause."""
        return demand(self.requirement)

    @property
    def name(self) -> str:
        """The name that the file gives the requirement, or ""."""
        return self.requirement.name

    @property
    def why(self) -> str:
        """The ``why`` of the requirement, or ""."""
        return self.requirement.why

    @property
    def file(self) -> str:
        """Path of the earlier file."""
        return self.requirement.source.file

    @property
    def line(self) -> int:
        """The line of the requirement in the earlier file."""
        return self.requirement.source.line

    @property
    def now(self) -> tuple[str, ...]:
        """The demands of the new file about some of the same names, as clauses."""
        return tuple(demand(requirement) for requirement in self.kept)

    def text(self) -> str:
        """Return a clause with the part of the requirement that the new file still demands."""
        if not self.kept:
            return "the new file has no such requirement"
        return f"only this is left of it: {'; '.join(self.now)}"


def dropped_requirements(
    before: Iterable[Requirement], after: Iterable[Requirement]
) -> tuple[DroppedRequirement, ...]:
    """Return the requirements of ``before`` that ``after`` does not fully demand, in order.

    All other requirements of ``before`` hold wherever all requirements of ``after`` hold.
    """
    now = [(part, whole) for whole in after for part in _parts(whole)]
    dropped = []
    for requirement in before:
        parts = tuple(_parts(requirement))
        if all(any(_implies(each, part) for each, _ in now) for part in parts):
            continue
        kept = (whole for each, whole in now if any(_is_alike(each, part) for part in parts))
        dropped.append(DroppedRequirement(requirement, tuple(dict.fromkeys(kept))))
    return tuple(dropped)


def dropped_findings(
    before: Iterable[Requirement], after: Iterable[Requirement], file: str
) -> list[Finding]:
    """Return a finding for each requirement that ``after`` does not fully demand.

    ``file`` is the path of the requirements ``after``.
    """
    return [
        DROPPED.found(
            ": ".join(filter(None, (requirement.name, requirement.demand))),
            requirement.text(),
            file,
            related=(RelatedPlace("required before", requirement.file, requirement.line or None),),
        )
        for requirement in dropped_requirements(before, after)
    ]


# ── what a requirement demands, part by part ───────────────────────────────────────────────


def _parts(requirement: Requirement) -> Iterator[Requirement]:
    """Yield requirements about a single name that together demand the same as ``requirement``."""
    match requirement:
        case Widest(rights=rights, enclaves=enclaves):
            for right in rights:
                for some in _one_by_one(enclaves):
                    yield replace(requirement, rights=(right,), enclaves=some)
        case NothingBut(enclaves=enclaves):
            for some in _one_by_one(enclaves):
                yield replace(requirement, enclaves=some)
        case NotBoth(first=first, second=second):
            for right in _single_rights(first):
                for other in _single_rights(second):
                    yield replace(requirement, first=(right,), second=(other,))
        case (
            Only(rights=rights)
            | Nobody(rights=rights)
            | Must(rights=rights)
            | AtMost(rights=rights)
        ):
            for verb, names in rights:
                for name in names:
                    yield replace(requirement, rights=((verb, (name,)),))
        case Protected(names=pairs):
            for pair in pairs:
                yield replace(requirement, names=(pair,))
        case Apart(sources=sources, targets=targets):
            for source in _one_by_one(sources):
                for target in _one_by_one(targets):
                    yield replace(requirement, sources=source, targets=target)
        case _:
            raise AssertionError(requirement)


def _one_by_one(enclaves: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Yield lists with one enclave or pattern of a list, each with all its exceptions."""
    excepted = tuple(enclave for enclave in enclaves if enclave.startswith(EXCEPT))
    yield from ((enclave, *excepted) for enclave in enclaves if not enclave.startswith(EXCEPT))


def _single_rights(rights: RightNames) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield pairs of a right and a single name."""
    yield from ((right, (name,)) for right, names in rights for name in names)


def _implies(new: Requirement, old: Requirement) -> bool:
    """Return whether ``old`` certainly holds wherever ``new`` holds."""
    match new, old:
        case Nobody(), Only() | AtMost() | Nobody():
            return _right_within(old, new)
        case Only(), Only():
            return _right_within(old, new) and _enclaves_within(new.enclaves, old.enclaves)
        case Must(), Must():
            return new.enclave == old.enclave and _right_within(old, new)
        case AtMost(), AtMost():
            return new.most <= old.most and _right_within(old, new)
        case Widest(), Widest():
            ((right, names),), ((old_right, old_names),) = new.rights, old.rights
            return (
                right == old_right
                and _all_within(names, old_names)
                and _enclaves_within(old.enclaves, new.enclaves)
            )
        case NothingBut(), NothingBut():
            return _enclaves_within(old.enclaves, new.enclaves) and all(
                any(right == one and _all_within(names, some) for one, some in old.rights)
                for right, names in new.rights
                if names
            )
        case NotBoth(), NotBoth():
            return all(
                one[0] == other[0] and covers(one[1][0], other[1][0])
                for one, other in ((new.first[0], old.first[0]), (new.second[0], old.second[0]))
            )
        case Protected(), Protected():
            ((kind, name),), ((old_kind, old_name),) = new.names, old.names
            strong = new.level is old.level or new.level is Level.ENCRYPT
            return kind == old_kind and strong and covers(name, old_name)
        case Apart(), Apart():
            return (
                _enclaves_within(old.sources, new.sources)
                and _enclaves_within(old.targets, new.targets)
                and _enclaves_within(new.through, old.through)
            )
        case _:
            return False


def _right_within(part: OfRights, wide: OfRights) -> bool:
    """Return whether the right of ``part`` is among the rights of ``wide``."""
    ((right, (name,)),), ((wide_right, (wide_name,)),) = part.rights, wide.rights
    return right == wide_right and covers(wide_name, name)


def _all_within(narrow: Iterable[str], wide: Sequence[str]) -> bool:
    """Return whether each pattern of ``narrow`` is covered by a pattern of ``wide``."""
    return all(any(covers(one, name) for one in wide) for name in narrow)


def _enclaves_within(narrow: Sequence[str], wide: Sequence[str]) -> bool:
    """Return whether all enclaves of the list ``narrow`` are in the list ``wide``."""
    ours, others = ([name[1:] for name in of if name.startswith(EXCEPT)] for of in (narrow, wide))
    some = [name for name in narrow if not name.startswith(EXCEPT)]
    more = [name for name in wide if not name.startswith(EXCEPT)]
    free = (e for e in others if any(overlap(e, name) for name in some))
    return _all_within(some, more) and _all_within(free, ours)


def _is_alike(new: Requirement, old: Requirement) -> bool:
    """Return whether both requirements are of one kind, about some equal names or enclaves."""
    if type(new) is not type(old):
        return False
    match new, old:
        case Widest(), Widest():
            same = new.rights[0][0] == old.rights[0][0]
            return same and overlap(new.enclaves[0], old.enclaves[0])
        case NothingBut(), NothingBut():
            return overlap(new.enclaves[0], old.enclaves[0])
        case NotBoth(), NotBoth():
            return all(
                one[0] == other[0] and overlap(one[1][0], other[1][0])
                for one, other in ((new.first[0], old.first[0]), (new.second[0], old.second[0]))
            )
        case Must(), Must() if new.enclave != old.enclave:
            return False
        case OfRights(), OfRights():
            ((right, (name,)),), ((old_right, (old_name,)),) = new.rights, old.rights
            return right == old_right and overlap(name, old_name)
        case Protected(), Protected():
            ((kind, name),), ((old_kind, old_name),) = new.names, old.names
            return kind == old_kind and overlap(name, old_name)
        case Apart(), Apart():
            same = overlap(new.sources[0], old.sources[0])
            return same and overlap(new.targets[0], old.targets[0])
        case _:
            raise AssertionError(old)
