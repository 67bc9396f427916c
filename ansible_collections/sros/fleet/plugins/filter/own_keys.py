"""The filter that collects the enclaves whose keys are made on robots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ansible.errors import AnsibleFilterError

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

DOCUMENTATION = r"""
name: own_keys
short_description: The enclaves whose keys are made on robots
description:
  - Returns the enclaves in C(sros_own_keys) of all hosts.
  - A host whose facts replace variables is refused by name.
options:
  _input:
    description: The variables of all hosts (C(hostvars)).
    type: dict
    required: true
author:
  - The authors of sros
"""

EXAMPLES = r"""
own: "{{ hostvars | sros.fleet.own_keys }}"
"""

RETURN = r"""
_value:
  description: The names of the enclaves.
  type: list
  elements: str
"""


def own_keys(hosts: Mapping[str, Any]) -> list[str]:
    """Return the enclaves whose keys are made on their robots."""
    found: list[str] = []
    for host in sorted(hosts):
        variables = hosts[host]
        try:
            check_facts(variables)
        except RefusedError as error:
            raise AnsibleFilterError(f"{host}: {error}") from error
        found += map(str, variables.get("sros_own_keys") or [])
    return found


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"own_keys": own_keys}
