"""What is wrong with policies whose permissions are signed: what `sros check` finds in them."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

from sros_tool.checks.kind import WARNING, Finding, by_cause
from sros_tool.checks.policies import findings_in
from sros_tool.errors import Note
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.policy.model import Policy

_MOST_ENCLAVES = 1000  # of each policy: signing must not wait for the check of a whole fleet


def signed_findings(
    policies: Iterable[Policy | FleetPolicy], enclaves: Collection[str], distribution: str = ""
) -> list[tuple[Finding, ...]]:
    """Return the errors and warnings in policies, the worst first, those of one cause together.

    A policy for a fleet is checked as it is for one robot of each group, and of a larger policy
    the first 1,000 enclaves.

    Args:
        policies: the policies.
        enclaves: the enclaves that they are signed for; all others are left out.
        distribution: the ROS 2 distribution of the nodes; "" is the latest.
    """
    found: list[Finding] = []
    for each in policies:
        policy = each.for_one_robot() if isinstance(each, FleetPolicy) else each
        chosen = [one for one in policy.enclaves if one.path in enclaves][:_MOST_ENCLAVES]
        found += findings_in(replace(policy, enclaves=tuple(chosen)), distribution)
    shown = [each for each in found if each.severity >= WARNING]
    shown.sort(key=lambda each: -each.severity.weight)
    return list(by_cause(list(dict.fromkeys(shown))))


def as_note(findings: tuple[Finding, ...]) -> Note:
    """Return one finding, or findings of one cause, as a note."""
    first = findings[0]
    if first.cause and len(findings) > 1:
        cause, place = first.cause, first.cause.place or first.place
        text = f"{place}: {cause.title}. {cause.text} {cause.remedy}"
    else:
        text = f"{first.place}: {first.kind.title}: {first.text}. {first.remedy}"
    return Note(first.id, text)
