"""The result of a demo, and its JSON.

`DemoResult.as_json` is what ``sros demo --json`` prints and ``--keep`` leaves as ``result.json``:

- ``backend``, ``dds``, ``why``: the backend, its DDS and version, the reason for the choice;
- ``template``: the keystore template on which the expected statuses depend;
- ``topic``: the topic of the demo;
- ``own_network``, ``network_reason``: whether it ran in a network namespace, and if not, why;
- ``as_expected``: whether the exit status is 0;
- ``left_out``: the number of rows that ``--only`` did not choose;
- ``scenarios``: a list of ``{"name", "title", "as_expected", "cast", "keystore", "rows", "cost"}``;
- ``rows``: the rows of all scenarios, in order, each with its ``scenario``.

A row has ``name``, ``expected`` and ``observed`` (values of `RowStatus`), ``as_expected``,
``mechanism`` (the reason for the expected status), ``detail`` (the observation, with counts),
``domain``, ``seconds`` (the length of the window), ``attack`` (the name of the attack; "" if the
row is not an attack), ``defence_removed`` ("" for the attack itself; otherwise the row shows that
the attack works without the named defence), ``open_because`` (why an attack is known to succeed,
or ""), ``remedy``, ``accepted`` (the user accepts that the attack succeeds) and ``open_here`` (it
succeeds because of the user's keystore, and was not accepted: the row is not as expected), and
``applies`` (false: the keystore has nobody for a part of the row, which was skipped).

``cast`` has the enclave of each part in a user's keystore (empty without ``--keystore``): a list
of ``{"part", "enclave", "nodes", "why"}``; ``nodes`` are the absolute names of the ROS nodes that
ran in the enclave, ``why`` is why it was chosen, or "".

``keystore`` is null without ``--keystore``; otherwise ``{"enclaves", "elsewhere", "not_tried"}``:
the number of enclaves, how many have their key elsewhere, and what would have to be tried for a
proof, and was not: attacks that were skipped, and peculiar enclaves that got no part.

``cost`` is null: readers of earlier versions expect the key.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sros_tool.demo.backend import Backend
from sros_tool.demo.casting import CastMember
from sros_tool.demo.verdict import RowResult
from sros_tool.errors import NOT_DONE
from sros_tool.runtime.netns import Isolation
from sros_tool.values import as_plain


@dataclass(frozen=True)
class KeystoreSummary:
    """The enclaves of a user's keystore, and those that cannot be tried; as in `UserKeystore`."""

    enclaves: int
    elsewhere: int = 0
    not_tried: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScenarioResult:
    """The result of one scenario; ``keystore`` describes a keystore of the user."""

    name: str
    title: str
    rows: tuple[RowResult, ...]
    cast: tuple[CastMember, ...] = ()
    keystore: KeystoreSummary | None = None

    @property
    def wrong(self) -> tuple[RowResult, ...]:
        """The rows that are not as expected."""
        return tuple(row for row in self.rows if not row.as_expected)

    @property
    def not_tried(self) -> tuple[str, ...]:
        """What would have to be tried to prove a user's keystore sound, and was not.

        The demo's own keystores are to show what works, and prove nothing of other ones.
        """
        if self.keystore is None:
            return ()
        return (*(row.name for row in self.rows if row.untried), *self.keystore.not_tried)

    @property
    def as_expected(self) -> bool:
        """Whether every row is as expected or skipped with a reason, and a keystore is proved."""
        return not self.wrong and not self.not_tried

    def as_json(self) -> dict[str, Any]:
        """Return the scenario as `sros demo --json` shows it."""
        return {
            "name": self.name,
            "title": self.title,
            "as_expected": self.as_expected,
            "cast": as_plain(self.cast),
            "keystore": self._keystore_as_json(),
            "rows": [{**row.as_json(), "scenario": self.name} for row in self.rows],
            "cost": None,
        }

    def _keystore_as_json(self) -> dict[str, Any] | None:
        if self.keystore is None:
            return None
        return {**as_plain(self.keystore), "not_tried": list(self.not_tried)}


@dataclass(frozen=True)
class DemoResult:
    """The result of the demo; ``left_out`` is the number of rows that --only did not choose."""

    backend: Backend
    topic: str
    isolation: Isolation
    template: str
    scenarios: tuple[ScenarioResult, ...]
    left_out: int = 0

    @property
    def rows(self) -> tuple[RowResult, ...]:
        """The rows of all scenarios."""
        return tuple(row for scenario in self.scenarios for row in scenario.rows)

    @property
    def as_expected(self) -> bool:
        """Whether every row is as expected or skipped with a reason, and a keystore is proved."""
        return all(scenario.as_expected for scenario in self.scenarios)

    @property
    def exit_status(self) -> int:
        """0: as expected; 1: a row is not; `NOT_DONE`: a keystore could not be proved sound."""
        if any(scenario.wrong for scenario in self.scenarios):
            return 1
        return 0 if self.as_expected else NOT_DONE

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
            "left_out": self.left_out,
            "scenarios": scenarios,
            "rows": [row for scenario in scenarios for row in scenario["rows"]],
        }
