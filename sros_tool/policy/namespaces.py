"""Names that became absolute, or relative to the namespace of their node.

Where a policy stands, such a change may change nothing.  But users who merge the policy with a
namespace of their own get other names.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, islice
from typing import NamedTuple

from sros_tool.policy.model import ALLOW, DENY, Enclave, Policy, Profile, Source
from sros_tool.policy.patterns import OTHER_NAMESPACE, common_name
from sros_tool.policy.rights import (
    PlacedRight,
    Right,
    Rules,
    parts,
    placed_rights,
    policy_rights,
    renamed_enclaves,
)
from sros_tool.values import shows


@shows("right", "written", "place")
class ChangedForm(NamedTuple):
    """A right that is new only for nodes in another namespace, or a DENY that denies less there."""

    right: Right
    """The right, in the namespace that the policy states."""
    written: str
    """The name as written in the policy, such as `/cmd` if it became absolute."""
    place: Source
    """File and line of the right."""

    @property
    def is_absolute(self) -> bool:
        """Whether the name became absolute, so that it does not move with its node."""
        return self.written.startswith("/")

    def example_elsewhere(self) -> str:
        """Return a name in another namespace that an absolute DENY no longer denies.

        The result is "" if the name is relative or has a wildcard.
        """
        name = self.right.name
        return f"/any_namespace{name}" if self.is_absolute and "*" not in name else ""


def changed_forms(before: Iterable[Enclave], after: Iterable[Enclave]) -> Iterator[ChangedForm]:
    """Yield the rights in ``after`` that are new only for nodes in another namespace.

    The names of these rights became absolute, or relative. Denials that deny less in another
    namespace are yielded, too.  An enclave under a new name is compared with itself.
    """
    before, after = tuple(before), tuple(after)
    renamed = renamed_enclaves(*(policy_rights(Policy(side)) for side in (before, after)))
    before = tuple(
        replace(enclave, path=renamed.get(enclave.path, enclave.path)) for enclave in before
    )
    of_before, of_after = (
        [*chain.from_iterable(map(_moved_rights, enclaves))] for enclaves in (before, after)
    )
    (was, was_elsewhere), (now, now_elsewhere) = (
        (Rules(placed.right for placed, _ in rights), Rules(moved for _, moved in rights))
        for rights in (of_before, of_after)
    )
    for placed, moved in of_after:
        allows = placed.right.qualifier is ALLOW
        if allows and was.cover(placed.right) and not was_elsewhere.cover(moved):
            yield _changed_form(placed)
    denials = [placed for placed, _ in of_after if placed.right.qualifier is DENY]
    for placed, moved in of_before:
        here, elsewhere = (
            placed.right.qualifier is DENY
            and any(undenied_name(part, rules) for part in parts(right))
            for right, rules in ((placed.right, now), (moved, now_elsewhere))
        )
        if elsewhere and not here:
            same = (denial for denial in denials if Rules([denial.right]).overlaps(placed.right))
            yield from map(_changed_form, islice(same, 1))


def _changed_form(placed: PlacedRight) -> ChangedForm:
    return ChangedForm(placed.right, placed.written, placed.source)


def _moved_rights(enclave: Enclave) -> Iterator[tuple[PlacedRight, Right]]:
    """Yield each right of an enclave, and the same right for a node in another namespace."""

    def elsewhere(profile: Profile) -> Profile:
        return replace(profile, ns=f"{OTHER_NAMESPACE}{profile.ns}".rstrip("/"))

    moved = placed_rights(enclave.with_profiles(elsewhere))
    for placed, moved_right in zip(placed_rights(enclave), moved, strict=True):
        yield placed, moved_right.right


def undenied_name(denied: Right, stated: Rules) -> str | None:
    """Return a name, if any, that ``denied`` matches, but no rule of ``stated`` matches.

    ``denied`` is not for an action.
    """
    if stated.cover(denied):
        return None
    allowed = stated.overlapping(denied._replace(qualifier=ALLOW))
    if denied.kind == "dds":  # such a right has no ROS name to search for
        return None if allowed else denied.name
    names = [right.name for right in (*allowed, *stated.overlapping(denied))]
    # A DENY of "/*stop" is for all namespaces: a name in a namespace shows best what it lost.
    shown = [denied.name, "/any_namespace/*"]
    in_namespace = denied.name.startswith("/*") and common_name(shown, names)
    return in_namespace or common_name([denied.name], names)
