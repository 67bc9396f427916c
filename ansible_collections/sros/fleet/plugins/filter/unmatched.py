"""The filter that tells which names in a pattern of hosts mean no host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ansible.inventory.manager import InventoryManager, split_host_pattern
from ansible.parsing.dataloader import DataLoader

DOCUMENTATION = r"""
name: unmatched
short_description: The parts of a pattern of hosts that mean no host
description:
  - Ansible only warns of a name that the inventory lacks, and leaves out nobody for an exclusion
    that is misspelt.
options:
  _input:
    description: A pattern of hosts, or a list of patterns.
    type: raw
    required: true
  groups:
    description: The hosts of each group (C(groups)).
    type: dict
    required: true
positional: groups
author:
  - The authors of sros
"""

EXAMPLES = r"""
misspelt: "{{ 'r1,r33:!r4' | sros.fleet.unmatched(groups) }}"
"""

RETURN = r"""
_value:
  description: The parts.
  type: list
  elements: str
"""


def unmatched(pattern: str | Sequence[str], groups: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the parts of ``pattern`` that mean no host."""
    inventory = InventoryManager(loader=DataLoader(), parse=False)
    for group, hosts in groups.items():
        inventory.add_group(group)
        for host in hosts:
            inventory.add_host(host, group=group)
    written = pattern if isinstance(pattern, str) else [str(part) for part in pattern]
    parts = [str(part) for part in split_host_pattern(written)]
    meant = {part: inventory.get_hosts(part.lstrip("!&")) for part in parts}
    return [part for part in parts if not meant[part]]


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"unmatched": unmatched}
