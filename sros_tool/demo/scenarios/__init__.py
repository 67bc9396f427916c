"""The scenarios that ship with sros, as data; `custom` reads user-defined scenarios."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.composition import COMPOSITION
from sros_tool.demo.scenarios.custom import read_scenario
from sros_tool.demo.scenarios.governance import GOVERNANCE
from sros_tool.demo.scenarios.isolation import ISOLATION
from sros_tool.demo.scenarios.model import Scenario
from sros_tool.demo.scenarios.services import ACTIONS, SERVICES
from sros_tool.errors import UsageError

SCENARIOS: tuple[Scenario, ...] = (
    ISOLATION,
    SERVICES,
    ACTIONS,
    COMPOSITION,
    ATTACKS,
    GOVERNANCE,
)
_DEFAULT_SCENARIO = ISOLATION.name
ALL = "all"


def choose_scenarios(names: Sequence[str]) -> tuple[Scenario, ...]:
    """Return the scenarios with these names or TOML files, in order; without names, the default.

    Raises:
        UsageError: no scenario has a given name.
        DocumentError: a file is not a valid scenario.
    """
    if ALL in names:
        return SCENARIOS
    known = {scenario.name: scenario for scenario in SCENARIOS}
    chosen = []
    for name in dict.fromkeys(names or (_DEFAULT_SCENARIO,)):
        if name.endswith(".toml"):
            chosen.append(read_scenario(Path(name)))
            continue
        if name not in known:
            raise UsageError(
                f"there is no scenario {name!r}",
                f"sros has {', '.join(known)}.",
                "Name one of them, `all`, or a TOML file.",
            )
        chosen.append(known[name])
    return tuple(chosen)
