"""The steps that close a robot, as command lines of sros."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from sros_tool.close.export import enclaves_to_export
from sros_tool.close.robot import TEMPLATE, LocalRobot
from sros_tool.runtime.environment import RMW_ZENOH
from sros_tool.runtime.rmw import RMW


class CommandStep(NamedTuple):
    """The words of a command line of sros, what it makes, and where its output goes."""

    words: Sequence[str]
    made: Path | None = None
    into: Path | None = None
    guards: bool = False
    """Whether the later steps are left out if this step finds something."""
    signs: bool = False
    """Whether the step changes rights, and says which on standard error."""

    @property
    def command(self) -> str:
        """The command line that does the same."""
        redirected = f" > {shlex.quote(str(self.into))}" if self.into else ""
        return f"sros {shlex.join(self.words)}{redirected}"


def steps(robot: LocalRobot, duration: str | None) -> Iterator[CommandStep]:
    """Yield the steps; with a ``duration``, the robot is watched even if it was before.

    The enclaves to export are known when the steps before are done.
    """
    policy, keystore, needed = str(robot.policy), str(robot.keystore), str(robot.requirements)
    domain = ("--domain", str(robot.domain))
    learn = ["generate_policy", policy, "--enclave-per-node", *domain]
    learn += ["--watch", duration] if duration else []
    learn += ["--dry-run"] if robot.policy.exists() else []  # it may have been edited
    only_errors = ("--fail-on", "error")
    policies, created = ("-p", policy, str(robot.observer)), ("--template", TEMPLATE)
    on_zenoh = robot.shell.environment.get(RMW) == RMW_ZENOH
    watched = robot.policy.exists() and not duration
    yield CommandStep(
        (*learn, "--json"), robot.processes_file if watched else None, robot.observation_file
    )
    yield CommandStep(("check", policy, "--suggest"), robot.requirements, robot.requirements)
    yield CommandStep(
        ("check", policy, "--requirements", needed, *created, *only_errors), guards=True
    )
    yield CommandStep(("create_keystore", keystore, *created, *domain), robot.keystore)
    yield CommandStep(("generate_artifacts", "-k", keystore, *policies), signs=True)
    if on_zenoh:
        yield CommandStep(("zenoh", keystore))
    exported = *enclaves_to_export(robot), str(robot.export)
    yield CommandStep(("distribute_key", keystore, *exported, "--force"))
    yield CommandStep(("check", policy, keystore, "--policy", policy, *only_errors))
    yield CommandStep(("view", policy, *created, "-o", str(robot.page), "--force"))
