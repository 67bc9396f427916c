"""The scenarios on Zenoh: nodes with the names, tokens and messages of rmw_zenoh."""

from __future__ import annotations

from sros_tool.demo.scenarios.model import Scenario
from sros_tool.demo.scenarios.zenoh.attacks import ATTACKS
from sros_tool.demo.scenarios.zenoh.isolation import ISOLATION, SERVICES

ZENOH_SCENARIOS: tuple[Scenario, ...] = (ISOLATION, SERVICES, ATTACKS)
