"""The filter that tells which hosts got to a step of a play."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

DOCUMENTATION = r"""
name: hosts_with
short_description: The hosts for which a play set a variable
description:
  - Returns the hosts that have a variable, by which a play noted what was done for them.
  - A host whose facts replace variables is left out, so that no robot can say itself that
    something was done for it.
options:
  _input:
    description: The variables of all hosts (C(hostvars)).
    type: dict
    required: true
  variable:
    description: The name of the variable.
    type: str
    required: true
  value:
    description: Only with this value.
    type: str
positional: variable, value
author:
  - The authors of sros
"""

EXAMPLES = r"""
done: "{{ hostvars | sros.fleet.hosts_with('sros_done') }}"
"""

RETURN = r"""
_value:
  description: The names of the hosts, sorted.
  type: list
  elements: str
"""


def hosts_with(hosts: Mapping[str, Any], variable: str, value: str | None = None) -> list[str]:
    """Return the hosts for which a play set ``variable``, to ``value`` unless that is None."""
    found = []
    for host in sorted(hosts):
        variables = hosts[host]
        if variable not in variables or value not in (None, variables[variable]):
            continue
        try:
            check_facts(variables)
        except RefusedError:
            continue
        found.append(host)
    return found


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"hosts_with": hosts_with}
