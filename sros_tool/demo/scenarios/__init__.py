"""The scenarios that ship with sros, as data; `custom` reads user-defined scenarios."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.communication import (
    ACTIONS,
    COMPOSITION,
    GOVERNANCE,
    ISOLATION,
    SERVICES,
)
from sros_tool.demo.scenarios.custom import read_scenario
from sros_tool.demo.scenarios.model import Scenario
from sros_tool.demo.scenarios.on_zenoh import ZENOH_SCENARIOS
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


def choose_scenarios(names: Sequence[str], *, on_zenoh: bool = False) -> tuple[Scenario, ...]:
    """Return the scenarios with these names or TOML files, in order.

    Without names, it is the default scenario on DDS, and all of them ``on_zenoh``.

    Raises:
        UsageError: no scenario has a given name.
        DocumentError: a file is not a valid scenario.
    """
    scenarios = ZENOH_SCENARIOS if on_zenoh else SCENARIOS
    if ALL in names or (on_zenoh and not names):
        return scenarios
    known = {scenario.name: scenario for scenario in scenarios}
    chosen = []
    for name in dict.fromkeys(names or (_DEFAULT_SCENARIO,)):
        if name.endswith(".toml"):
            if on_zenoh:
                raise UsageError(
                    f"the scenario {name} cannot run on Zenoh",
                    "Scenarios of your own run on a DDS.",
                    f"Leave out --backend zenoh, or name {', '.join(known)}.",
                )
            chosen.append(read_scenario(Path(name)))
            continue
        if name not in known:
            raise UsageError(
                f"there is no scenario {name!r}",
                f"sros has {', '.join(known)}{' on Zenoh' if on_zenoh else ''}.",
                "Name one of them, `all`, or a TOML file.",
            )
        chosen.append(known[name])
    return tuple(chosen)
