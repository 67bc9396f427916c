"""The filter that tells who did not get a revocation list."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any

from ansible_collections.sros.fleet.plugins.filter.hosts_with import hosts_with

DOCUMENTATION = r"""
name: trusting
short_description: The robots and enclaves that a delivery did not get to
description:
  - Returns the robots with enclaves for which the role did not get to its end, and the enclaves of
    no robot that no host got by its C(sros_patterns).
  - Only what is known at home counts, not what a robot answers.
options:
  _input:
    description: What C(sros list_enclaves --json) prints.
    type: dict
    required: true
  hosts:
    description: The variables of all hosts (C(hostvars)).
    type: dict
    required: true
positional: hosts
author:
  - The authors of sros
"""

EXAMPLES = r"""
left: "{{ listed.answer | sros.fleet.trusting(hostvars) }}"
"""

RETURN = r"""
_value:
  description: The names of C(robots) and of C(enclaves).
  type: dict
"""


def trusting(listed: Mapping[str, Any], hosts: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the robots, and the enclaves of no robot, that were not served."""
    served = [hosts[each]["sros_served"] for each in hosts_with(hosts, "sros_served")]
    robots = {each["robot"] for each in served if not each["patterns"]}
    patterns = [one for each in served for one in each["patterns"]]
    owners: Mapping[str, str] = listed.get("robots") or {}
    lacking: set[str] = set()
    enclaves = []
    for name in listed["enclaves"]:
        if any(fnmatchcase(name, one) for one in patterns):
            continue
        if name not in owners:
            enclaves.append(name)
        elif owners[name] not in robots:
            lacking.add(owners[name])
    return {"robots": sorted(lacking), "enclaves": enclaves}


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"trusting": trusting}
