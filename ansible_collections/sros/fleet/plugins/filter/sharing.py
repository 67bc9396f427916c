"""The filter that tells which hosts mean the same robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

DOCUMENTATION = r"""
name: sharing
short_description: The hosts that mean the same robot
description:
  - Returns the hosts whose C(sros_robot) is that of another one, each of which would get the keys
    of that robot. Hosts with C(sros_patterns) do not choose enclaves by a robot.
  - A host whose facts replace variables is left out, so that none can hold up another;
    it gets nothing.
options:
  _input:
    description: The variables of all hosts (C(hostvars)).
    type: dict
    required: true
  meant:
    description: The hosts of the play.
    type: list
    elements: str
    required: true
positional: meant
author:
  - The authors of sros
"""

EXAMPLES = r"""
shared: "{{ hostvars | sros.fleet.sharing(['r1', 'r2']) }}"
"""

RETURN = r"""
_value:
  description: The robots, each with its hosts.
  type: list
  elements: str
"""


def sharing(hosts: Mapping[str, Any], meant: Sequence[str]) -> list[str]:
    """Return the robots that several of the hosts ``meant`` mean, with these hosts."""
    found: dict[str, list[str]] = {}
    for host in meant:
        variables = hosts[host]
        try:
            check_facts(variables)
        except RefusedError:
            continue
        if not variables.get("sros_patterns"):
            found.setdefault(str(variables.get("sros_robot") or host), []).append(host)
    return [f"{robot} ({', '.join(hosts)})" for robot, hosts in found.items() if len(hosts) > 1]


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"sharing": sharing}
