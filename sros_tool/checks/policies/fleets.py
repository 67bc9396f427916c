"""Checks of policies with the fleet that they are for."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from difflib import get_close_matches
from itertools import chain

from sros_tool.checks.kind import WARNING, Finding, FindingKind
from sros_tool.checks.policies.counterparts import check_servers
from sros_tool.checks.policies.enclaves import node_in_two_enclaves_findings
from sros_tool.checks.policies.statements import CheckedPolicy
from sros_tool.fleet.robots import Fleet, Robot, group_of, robot_of
from sros_tool.policy.model import Enclave, Policy
from sros_tool.policy.placeholders import parts_of
from sros_tool.wording import first_few

SHARED_NAMESPACE = FindingKind(
    "policy.shared-namespace",
    WARNING,
    "robots with the same namespace, or with one namespace inside the other",
    "In the same namespace, both robots publish and subscribe to the same names. A wildcard in "
    "an outer namespace also matches the names in the inner namespace.",
    "rcl (puts the node's namespace before relative names); sros (placeholder {namespace}).",
    "Give each robot a namespace of its own in the fleet file, or a ROS domain of its own. "
    "Computers of one robot may share its namespace: put them, and no other robot, into one group, "
    "and let no node run on two of them.",
)
UNKNOWN_GROUP = FindingKind(
    "policy.unknown-group",
    WARNING,
    "robots in no group, or in a group that no policy names",
    "Their processes get no enclaves, and no keys.",
    "sros (placeholder {robot:GROUP}).",
    "Correct the groups of the robots in the fleet file, or name all policies of the fleet.",
)
ROBOT_WRITTEN_OUT = FindingKind(
    "policy.robot-written-out",
    WARNING,
    "the name of a robot in place of its placeholder",
    "For sros, the enclave belongs to no robot: nothing delivers, renews or revokes it with the "
    "robot.",
    "sros (placeholder {robot}).",
    "Write the path with the placeholder that the finding names.",
)
_NUMBER = re.compile(r"[0-9]+")


def fleet_findings(
    policies: Sequence[Policy],
    fleet: Fleet,
    patterns: Collection[str],
    file: str,
    *,
    has_all_policies: bool,
) -> Iterator[Finding]:
    """Yield findings about the robots of a fleet, and the enclaves that policies have for them.

    ``patterns`` are the paths of these enclaves, with placeholders.  Findings about robots are
    placed in ``file``.  Unless ``has_all_policies``, robots may have enclaves in other policies.
    """
    fleet = fleet.with_enclaves(tuple(patterns))
    enclaves = [enclave for policy in policies for enclave in policy.enclaves]
    if shared := [*_shared_namespaces(fleet, enclaves)]:
        yield SHARED_NAMESPACE.found(file, first_few(shared, 3, "; "), file)
    groups = {group_of(parts_of(pattern)) for pattern in patterns}
    if has_all_policies and (text := _unknown_groups_clause(groups, fleet)):
        yield UNKNOWN_GROUP.found(file, text, file)
    yield from _written_out_robot_findings(enclaves, fleet)
    for of_robot in _enclaves_of_one_robot(fleet, enclaves):
        yield from node_in_two_enclaves_findings(of_robot)
        yield from check_servers(CheckedPolicy(replace(policies[0], enclaves=tuple(of_robot))))


def _enclaves_of_one_robot(
    fleet: Fleet, enclaves: Iterable[Enclave]
) -> Iterable[Sequence[Enclave]]:
    """Return the enclaves of the first robot of all robots in the same groups.

    The others have the same enclaves, with other values of the placeholders.
    """
    first: dict[tuple[str, ...], str] = {}
    by_robot: dict[str, list[Enclave]] = defaultdict(list)
    for enclave in enclaves:
        if robot := robot_of(fleet, enclave.path):
            first.setdefault(robot.groups, robot.name)
            by_robot[robot.name].append(enclave)
    return [by_robot[name] for name in first.values()]


def _shared_namespaces(fleet: Fleet, enclaves: Iterable[Enclave]) -> Iterator[str]:
    """Yield a clause for each namespace that several robots on one ROS domain share.

    The computers of one robot (in the fleet file, each counts as a robot) may share a namespace if
    they are exactly one group, and no node runs on two of them.
    """
    robots = {
        namespace: [fleet.robots[name] for name in names]
        for namespace, names in fleet.by_namespace.items()
    }
    groups = {*fleet.groups.values()}
    shared = {*chain(*(names for names in fleet.by_namespace.values() if names in groups))}
    twice = _robots_with_the_same_node(fleet, enclaves) if len(shared) > 1 else frozenset()
    for namespace, inside in robots.items():
        names = fleet.by_namespace[namespace]
        is_one_robot = names in groups and not twice & {*names}
        if not is_one_robot and (met := _robots_on_one_domain(inside)):
            yield f"{met[0].name} and {met[1].name} have the namespace {namespace}"
        above = namespace
        while above := above.rpartition("/")[0]:  # a robot in / may contain the others
            if met := _robots_on_one_domain(inside, robots.get(above, [])):
                outer, inner = (robot.name for robot in met)
                yield (
                    f"the namespace of {inner}, {namespace}, is inside {above}, the namespace of "
                    f"{outer}"
                )


def _robots_with_the_same_node(fleet: Fleet, enclaves: Iterable[Enclave]) -> frozenset[str]:
    """Return the names of robots with a node whose full name a node of another robot has, too."""
    robots_by_node: dict[str, set[str]] = defaultdict(set)
    for enclave in enclaves:
        if robot := robot_of(fleet, enclave.path):
            for profile in enclave.all_profiles():
                robots_by_node[profile.full_name].add(robot.name)
    return frozenset(chain(*(names for names in robots_by_node.values() if len(names) > 1)))


def _unknown_groups_clause(named: Collection[str], fleet: Fleet) -> str:
    """Return a clause on robots with a misspelled group or without a group; "" if there are none.

    ``named`` are the groups in the policies, with "" for enclaves of all robots.  Other groups may
    belong to policies that were not named.  So a group counts only if no other robot has the group,
    and if the name differs from a group in the policies by a typing error, not only by a number.  A
    robot without a group counts if every enclave is for a group.
    """
    for_all, groups = not named or "" in named, {*named} - {""}
    clauses = []
    for robot in fleet.robots.values():
        for group in sorted({*robot.groups} - groups):
            close = get_close_matches(group, groups) if len(fleet.groups[group]) < 2 else []
            letters = _NUMBER.sub("", group)
            if meant := sorted(name for name in close if _NUMBER.sub("", name) != letters):
                clauses.append(f"{robot.name} (group {group}: perhaps {first_few(meant, 2)})")
        if not (robot.groups or for_all):
            clauses.append(f"{robot.name} (in no group)")
    return f"no enclave is for {first_few(clauses, 5)}" if clauses else ""


def _written_out_robot_findings(enclaves: Iterable[Enclave], fleet: Fleet) -> Iterator[Finding]:
    """Yield a finding for each enclave whose path has a robot's name in place of a placeholder."""
    for enclave in enclaves:
        name, _, rest = enclave.path[1:].partition("/")
        robot = fleet.robots.get(name)
        if robot and robot_of(fleet, enclave.path) is None:
            group = f":{robot.groups[0]}" if robot.groups else ""
            path = f"/{{robot{group}}}/{rest}".rstrip("/")
            text = f"{enclave.path} is no enclave of the robot {name}: write {path}"
            yield ROBOT_WRITTEN_OUT.found(enclave.path, text, enclave.source.file)


def _robots_on_one_domain(
    robots: Sequence[Robot], other_robots: Sequence[Robot] | None = None
) -> tuple[Robot, Robot] | None:
    """Return two robots that may be in the same ROS domain, or None.

    One robot is from ``robots``, and the other is from ``other_robots``. If that is None, both are
    from ``robots``.
    """
    robots_by_domain = {robot.domain: robot for robot in other_robots or ()}
    for robot in robots:
        candidates = (robots_by_domain.get(robot.domain), robots_by_domain.get(None))
        for other_robot in robots_by_domain.values() if robot.domain is None else candidates:
            if other_robot:
                return other_robot, robot
        if other_robots is None:
            robots_by_domain[robot.domain] = robot
    return None
