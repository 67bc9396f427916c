"""All findings in policies: in files, as parsed, or before they are signed."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from sros_tool.checks.kind import ERROR, WARNING, Finding, FindingKind, group_by_cause
from sros_tool.checks.policies.counterparts import check_counterparts, check_servers
from sros_tool.checks.policies.enclaves import (
    check_instances,
    check_node_names,
    check_parameters_of_others,
    check_root_enclave,
    duplicate_enclave_findings,
    node_in_two_enclaves_findings,
)
from sros_tool.checks.policies.fleets import fleet_findings
from sros_tool.checks.policies.includes import include_findings
from sros_tool.checks.policies.names import check_names
from sros_tool.checks.policies.node_basics import check_nodes
from sros_tool.checks.policies.portability import ENCLAVE_NAMES, check_portability, check_zenoh
from sros_tool.checks.policies.rules import check_protection, check_rules
from sros_tool.checks.policies.statements import CheckedPolicy, split_place
from sros_tool.errors import Note, SrosError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.xml import parse, read_bytes

MALFORMED = FindingKind(
    "policy.malformed",
    ERROR,
    "a policy that cannot be read",
    "No verb of sros can use it.",
    "SROS2 policy XML 0.2.0 (policy.xsd of ros2/sros2) and the ROS 2 names.",
    "Correct the policy at the reported place.",
)
DUPLICATE = FindingKind(
    "policy.duplicate-enclave",
    ERROR,
    "an enclave that is defined twice",
    "Some verbs of ros2/sros2 use the first definition, others the last, so rights depend on the "
    "command. sros refuses the policy.",
    "ros2/sros2 0.13 (create_permission, generate_artifacts).",
    "Join the two into one <enclave>.",
)
_CHECKS = (
    check_rules,
    check_nodes,
    check_names,
    check_node_names,
    check_protection,
    check_root_enclave,
    check_portability,
)
_CHECKS_TOGETHER = (check_counterparts, check_instances, check_parameters_of_others)
"""Checks for which the policies of a robot count as one policy."""
_XML_ERROR_PLACE = re.compile(r", line (?P<line>\d+), column \d+")  # in messages of libxml2


def findings_in(
    policies: Sequence[Policy], distribution: str = "", *, of_fleet: bool = False
) -> Iterator[Finding]:
    """Yield all findings in the parsed policies of a robot, except the findings about includes.

    A name may have its counterpart in any of the policies.  With ``of_fleet``, the policies are for
    several robots, whose nodes may have the same names in different ROS domains; `fleet_findings`
    compares the enclaves of one robot.
    """
    checked = [CheckedPolicy(policy, distribution) for policy in policies]
    for checked_policy in checked:
        for check in _CHECKS:
            yield from check(checked_policy)
    if len(checked) > 1:
        enclaves = tuple(enclave for policy in policies for enclave in policy.enclaves)
        checked = [CheckedPolicy(replace(policies[0], enclaves=enclaves), distribution)]
        yield from duplicate_enclave_findings(enclaves)
    for checked_policy in checked:
        if not of_fleet:
            yield from node_in_two_enclaves_findings(checked_policy.policy.enclaves)
            yield from check_servers(checked_policy)
        for check in _CHECKS_TOGETHER:
            yield from check(checked_policy)


def policy_file_findings(
    *paths: Path,
    distribution: str = "",
    fleet: Fleet | None = None,
    policy: Policy | None = None,
    on_zenoh: bool = False,
) -> Iterator[Finding]:
    """Yield all findings in policy files; a file that cannot be read is a finding too.

    Args:
        paths: the files, which are of one robot or fleet.
        distribution: the ROS 2 distribution of the nodes, such as ``humble``; "" is the latest.
        fleet: the robots that placeholders in the policies stand for.
        policy: the policy in the only file, if it is parsed already.
        on_zenoh: whether the nodes use Zenoh.
    """
    read: list[Policy] = []
    patterns: list[str] = []
    for path in paths:
        try:
            known = policy if policy and len(paths) == 1 else None
            if fleet:
                expanded = FleetPolicy(read_policy(path, placeholders=True), fleet)
                patterns += expanded.patterns
                known = known or expanded.policy()
            known = known or read_policy(path)
        except SrosError as error:
            yield from _unreadable_policy_findings(path, error)
            continue
        read.append(known)
        yield from include_findings(path)
    if fleet:
        has_all = len(read) == len(paths)
        yield from fleet_findings(read, fleet, patterns, str(paths[0]), has_all_policies=has_all)
    yield from findings_in(read, distribution, of_fleet=fleet is not None)
    if on_zenoh:
        yield from check_zenoh(enclave for policy in read for enclave in policy.enclaves)


def _unreadable_policy_findings(path: Path, error: SrosError) -> Iterator[Finding]:
    has_duplicates = False
    for name, line in _duplicates(path):
        has_duplicates = True
        yield DUPLICATE.found(name, f"{name} is defined here again", str(path), line)
    if has_duplicates:
        return
    file, line, text = split_place(error)
    if not file and (syntax := _XML_ERROR_PLACE.search(error.why)):
        line = int(syntax["line"])
    why = " ".join(part for part in (f"{text}.", error.why) if part)
    yield MALFORMED.found(str(path), why, file or str(path), line, error.remedy)


def _duplicates(path: Path) -> Iterator[tuple[str, int]]:
    try:
        root = parse(read_bytes(path, "policy file"), str(path))
    except SrosError:
        return
    names: set[str] = set()
    for element in root.iter("enclave"):
        name = element.get("path", "")
        if name in names:
            yield name, element.sourceline or 0
        names.add(name)


_MOST_ENCLAVES = 1000  # per policy; checking a whole fleet would delay signing


def signed_findings(
    policies: Sequence[Policy | FleetPolicy], enclaves: Collection[str], distribution: str = ""
) -> list[tuple[Finding, ...]]:
    """Return the errors and warnings in policies, worst first, grouped by cause.

    A policy for a fleet is checked for one robot of each group.  At most 1,000 enclaves are
    checked.  `ENCLAVE_NAMES` is left out: whoever signs knows the subjects, and notes this.

    Args:
        policies: the policies.
        enclaves: the enclaves whose permissions are to be signed; no other enclaves are checked.
        distribution: the ROS 2 distribution of the nodes; "" is the latest.
    """
    parts: list[Policy] = []
    for policy_or_fleet in policies:
        policy = (
            policy_or_fleet.for_one_robot()
            if isinstance(policy_or_fleet, FleetPolicy)
            else policy_or_fleet
        )
        chosen = [enclave for enclave in policy.enclaves if enclave.path in enclaves][
            :_MOST_ENCLAVES
        ]
        parts.append(replace(policy, enclaves=tuple(chosen)))
    of_fleet = any(isinstance(policy, FleetPolicy) for policy in policies)
    findings = findings_in(parts, distribution, of_fleet=of_fleet)
    shown = [
        finding
        for finding in findings
        if finding.severity >= WARNING and finding.kind is not ENCLAVE_NAMES
    ]
    shown.sort(key=lambda finding: -finding.severity.weight)
    return list(group_by_cause(list(dict.fromkeys(shown))))


def as_note(findings: tuple[Finding, ...]) -> Note:
    """Return a finding, or several findings with one cause, as a note."""
    first = findings[0]
    if first.cause and len(findings) > 1:
        cause, place = first.cause, first.cause.place or first.place
        text = f"{place}: {cause.title}. {cause.text} {cause.remedy}"
    else:
        text = f"{first.place}: {first.kind.title}: {first.text}. {first.remedy}"
    return Note(first.id, text)
