"""The scenarios that ship with sros."""

from __future__ import annotations

from sros_tool.demo.model import Scenario
from sros_tool.demo.scenarios.isolation import ISOLATION

SCENARIOS: tuple[Scenario, ...] = (ISOLATION,)
DEFAULT_SCENARIO = ISOLATION.name
