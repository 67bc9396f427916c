"""The filter that tells who did not get a revocation list."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

from ansible_collections.sros.fleet.plugins.filter.hosts_with import hosts_with
from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

DOCUMENTATION = r"""
name: trusting
short_description: The robots and enclaves that a delivery did not get to
description:
  - Returns the robots with enclaves for which the role did not get to its end, and the enclaves of
    no robot that no host got by its C(sros_patterns).
  - Also the enclaves that the inventory brings to the revoked robots besides their own.
  - Only what is known on the keystore machine counts, not what a robot answers.
options:
  _input:
    description: What C(sros list_enclaves --json) prints.
    type: dict
    required: true
  hosts:
    description: The variables of all hosts (C(hostvars)).
    type: dict
    required: true
  revoked:
    description: The robots that were revoked.
    type: list
    elements: str
    default: []
positional: hosts, revoked
author:
  - The authors of sros
"""

EXAMPLES = r"""
left: "{{ listed.answer | sros.fleet.trusting(hostvars, ['r3']) }}"
"""

RETURN = r"""
_value:
  description: >-
    The names of C(robots), of C(enclaves), of those C(kept) by revoked robots, and of hosts of
    which that is C(unknown).
  type: dict
"""


def trusting(
    listed: Mapping[str, Any], hosts: Mapping[str, Any], revoked: Collection[str] = ()
) -> dict[str, list[str]]:
    """Return who was not served, and what the ``revoked`` robots have besides their own."""
    served = [hosts[host]["sros_served"] for host in hosts_with(hosts, "sros_served")]
    owners: Mapping[str, str] = listed.get("robots") or {}
    lacking: set[str] = set()
    enclaves = []
    for name in listed["enclaves"]:
        owner = owners.get(name)
        if owner is None:
            got = any(_fits(name, robot["patterns"]) for robot in served)
        else:  # that another host got it, too, brings its robot nothing
            own = [robot["patterns"] for robot in served if robot["robot"] == owner]
            got = any(not patterns or _fits(name, patterns) for patterns in own)
        if got:
            continue
        if owner is None:
            enclaves.append(name)
        else:
            lacking.add(owner)
    kept, unknown = _kept(listed["enclaves"], hosts, revoked)
    return {"robots": sorted(lacking), "enclaves": enclaves, "kept": kept, "unknown": unknown}


def _kept(
    names: Sequence[str], hosts: Mapping[str, Any], revoked: Collection[str]
) -> tuple[list[str], list[str]]:
    """Return the enclaves that the inventory brought to robots that were revoked.

    Then the hosts that could be these robots, and whose variables are not those of the inventory.
    """
    kept: set[str] = set()
    unknown = []
    for host in sorted(hosts):
        variables = hosts[host]
        try:
            check_facts(variables)
        except RefusedError:
            if host in revoked:
                unknown.append(host)
            continue
        if (variables.get("sros_robot") or host) in revoked:
            patterns, own = (
                variables.get(f"sros_{variable}") or [] for variable in ("patterns", "own_keys")
            )
            kept.update(name for name in names if name in own or _fits(name, patterns))
    return sorted(kept), unknown


def _fits(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"trusting": trusting}
