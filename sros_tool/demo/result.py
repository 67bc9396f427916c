"""The result of a demo, and its JSON.

`DemoResult.as_json` is what ``sros demo --json`` prints and ``--keep`` leaves as ``result.json``:

- ``backend``, ``dds``, ``why``: the backend, its DDS and version, the reason for the choice;
- ``template``: the keystore template on which the expected statuses depend;
- ``topic``: the topic of the demo;
- ``own_network``, ``network_reason``: whether it ran in a network namespace, and if not, why;
- ``as_expected``: whether the exit status is 0;
- ``scenarios``: a list of ``{"name", "title", "as_expected", "cast", "rows", "cost"}``;
- ``rows``: the rows of all scenarios, in order, each with its ``scenario``.

A row has ``name``, ``expected`` and ``observed`` (values of `RowStatus`), ``as_expected``,
``mechanism`` (the reason for the expected status), ``detail`` (the observation, with counts),
``domain``, ``seconds`` (the length of the window), ``attack`` (the name of the attack; "" if the
row is not an attack), ``defence_removed`` ("" for the attack itself; otherwise the row shows that
the attack works without the named defence), ``open_because`` (why an attack is known to succeed,
or ""), ``remedy``, ``accepted`` (the user accepts that the attack succeeds) and ``open_here`` (it
succeeds because of the user's keystore, and was not accepted: the row is not as expected).

``cast`` has the enclave of each part in a user's keystore (empty without ``--keystore``): a list
of ``{"part", "enclave", "nodes"}``; ``nodes`` are the absolute names of the ROS nodes that ran in
the enclave.

``cost`` is null, or what `sros_tool.demo.cost.CostResult.as_json` describes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sros_tool.demo.backend import Backend
from sros_tool.demo.casting import CastMember
from sros_tool.demo.cost import CostResult
from sros_tool.demo.verdict import RowResult
from sros_tool.runtime.netns import Isolation
from sros_tool.values import as_plain


@dataclass(frozen=True)
class ScenarioResult:
    """The result of one scenario."""

    name: str
    title: str
    rows: tuple[RowResult, ...]
    cost: CostResult | None = None
    cast: tuple[CastMember, ...] = ()

    @property
    def as_expected(self) -> bool:
        """Whether every row is as expected or skipped with a reason."""
        return all(row.as_expected for row in self.rows)

    def as_json(self) -> dict[str, Any]:
        """Return the scenario as `sros demo --json` shows it."""
        return {
            "name": self.name,
            "title": self.title,
            "as_expected": self.as_expected,
            "cast": as_plain(self.cast),
            "rows": [{**row.as_json(), "scenario": self.name} for row in self.rows],
            "cost": self.cost.as_json() if self.cost else None,
        }


@dataclass(frozen=True)
class DemoResult:
    """The result of the demo."""

    backend: Backend
    topic: str
    isolation: Isolation
    template: str
    scenarios: tuple[ScenarioResult, ...]

    @property
    def rows(self) -> tuple[RowResult, ...]:
        """The rows of all scenarios."""
        return tuple(row for scenario in self.scenarios for row in scenario.rows)

    @property
    def cost(self) -> CostResult | None:
        """The cost of security in the first scenario that measured it, or None."""
        return next((each.cost for each in self.scenarios if each.cost is not None), None)

    @property
    def as_expected(self) -> bool:
        """Whether every row is as expected or skipped with a reason."""
        return all(scenario.as_expected for scenario in self.scenarios)

    def as_json(self) -> dict[str, Any]:
        """Return the result as JSON, described at the top of this module."""
        scenarios = [scenario.as_json() for scenario in self.scenarios]
        return {
            "backend": self.backend.name,
            "dds": self.backend.dds,
            "why": self.backend.why,
            "template": self.template,
            "topic": self.topic,
            "own_network": self.isolation.isolated,
            "network_reason": self.isolation.reason,
            "as_expected": self.as_expected,
            "scenarios": scenarios,
            "rows": [row for scenario in scenarios for row in scenario["rows"]],
        }
