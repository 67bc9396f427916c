"""Filters that tell which units run in the enclaves that changed."""

from __future__ import annotations

from typing import Any

DOCUMENTATION = r"""
name: due_units
short_description: The units to restart, in order
description:
  - Returns the names of the units that run in an enclave whose files changed. Units of a Zenoh
    router come first, then the others, both in the order in which they are given.
options:
  _input:
    description: The units, each with C(name) and, unless it runs in all of them, C(enclaves).
    type: list
    elements: dict
    required: true
  changed:
    description: The enclaves whose processes have to be restarted.
    type: list
    elements: str
    required: true
  routers:
    description: The enclaves of Zenoh routers.
    type: list
    elements: str
positional: changed, routers
author:
  - The authors of sros
"""

EXAMPLES = r"""
units: "{{ sros_units | sros.fleet.due_units(installed.restart, installed.routers) }}"
"""

RETURN = r"""
_value:
  description: The names of the units.
  type: list
  elements: str
"""


def due_units(units: list[Any], changed: list[str], routers: list[str] | None = None) -> list[str]:
    """Return the names of the units to restart, those of Zenoh routers first."""
    due = [unit for unit in units if changed and _runs_in(unit, changed)]
    first = [unit for unit in due if _names_one(unit, routers or [])]
    return [unit["name"] for unit in [*first, *(unit for unit in due if unit not in first)]]


def without_unit(changed: list[str], units: list[Any]) -> list[str]:
    """Return the enclaves in which no unit runs."""
    return [enclave for enclave in changed if not any(_runs_in(unit, [enclave]) for unit in units)]


def _runs_in(unit: dict[str, Any], enclaves: list[str]) -> bool:
    return unit.get("enclaves") is None or bool(set(unit["enclaves"]) & set(enclaves))


def _names_one(unit: dict[str, Any], enclaves: list[str]) -> bool:
    return bool(set(unit.get("enclaves") or ()) & set(enclaves))


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"due_units": due_units, "without_unit": without_unit}
