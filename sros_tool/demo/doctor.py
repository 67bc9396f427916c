"""The diagnosis of `sros doctor`: which DDS enforces security here, and whose `ros2 security` runs.

ros2cli takes the last of the packages that have the command.  Source: ros2cli 0.32,
``entry_points.py``: entry points by name, in the order of ``sys.path``.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.keystores import KeystoreSpec, create_keystores
from sros_tool.demo.scenarios.communication import ISOLATION
from sros_tool.demo.scenarios.policies import DEFAULT_TOPIC
from sros_tool.keystore.template import load_template
from sros_tool.runtime.cyclone import INSTALL_ADVICE
from sros_tool.runtime.rmw import RMW
from sros_tool.runtime.stacks import ROS_ADVICE, Stack, survey
from sros_tool.values import shows

_PROBE_DOMAIN = 80
_TEMPLATE = "production"


@shows("enforces", "ros_enforces", "stacks", "advice")
class Diagnosis(NamedTuple):
    """The stacks of this machine, and advice if none enforces security."""

    stacks: tuple[Stack, ...]
    """What was tried."""

    @property
    def enforces(self) -> bool:
        """Whether at least one DDS here enforces security."""
        return any(stack.enforces for stack in self.stacks)

    @property
    def ros(self) -> Stack | None:
        """The RMW that ROS nodes use here, or None if no RMW is installed."""
        return next((stack for stack in self.stacks if stack.kind == "rmw" and stack.present), None)

    @property
    def ros_enforces(self) -> bool | None:
        """Whether the RMW that ROS nodes use here enforces security; null if there is none, or if
        it could not be tried.
        """
        return self.ros.enforces if self.ros else None

    @property
    def sound(self) -> bool:
        """Whether ROS nodes here are secured by their RMW; without an RMW, whether any DDS is."""
        return self.enforces if self.ros is None else self.ros.enforces is True

    @property
    def conclusion(self) -> str:
        """What enforces security here and what does not, as sentences."""
        if not self.enforces:
            return f"Nothing here enforces DDS Security. {self.advice}"
        named = " and ".join(stack.name for stack in self.stacks if stack.enforces)
        able = f"DDS Security can be enforced here, by {named}"
        ros = self.ros
        if ros is None:
            return f"{able}. No RMW is installed here, so ROS nodes were not tried."
        if ros.enforces:
            return f"{able}."
        fault = "does not enforce it" if ros.enforces is False else "could not be tried"
        other = next((e.rmw for e in self.stacks if e.kind == "rmw" and e.enforces and e.rmw), "")
        advice = f"Set {RMW}={other}, which enforces it." if other else ROS_ADVICE
        return f"{able}, but NOT by ROS nodes: {ros.rmw or 'their RMW'} {fault}. {advice}"

    @property
    def advice(self) -> str:
        """What to install if nothing here enforces security, or an empty string."""
        return "" if self.enforces else f"{INSTALL_ADVICE} {ROS_ADVICE}"


def examine(now: datetime) -> Diagnosis:
    """Try every DDS stack with a temporary keystore, and return the diagnosis."""
    with TemporaryDirectory(prefix="sros-doctor-") as folder:
        domains = DomainSet.of((_PROBE_DOMAIN, _PROBE_DOMAIN))
        template = load_template(_TEMPLATE)
        spec = KeystoreSpec(DEFAULT_TOPIC, domains, template, now)
        keystores = create_keystores(Path(folder), ISOLATION, spec)
        stacks = survey(keystores.probe(DEFAULT_TOPIC, _PROBE_DOMAIN))
    return Diagnosis(stacks)


def diagnosis_text(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as text: a line per stack, then the evidence and what to do."""
    width = max(len(stack.name) for stack in diagnosis.stacks)
    lines: list[str] = []
    for stack in diagnosis.stacks:
        identity = f"{stack.dds} {stack.version}".strip() if stack.present else ""
        lines.append(f"{stack.name:<{width}}  {_answer(stack):<19}  {identity}".rstrip())
        lines += _indented([stack.evidence, stack.where, stack.advice])
    lines += ["", diagnosis.conclusion]
    return "\n".join(lines)


def _answer(stack: Stack) -> str:
    if not stack.present:
        return "not installed"
    if stack.enforces is None:
        return "could not be tried"
    return "enforces security" if stack.enforces else "does not enforce"


def _indented(texts: Sequence[str]) -> list[str]:
    return [f"    {text}" for text in texts if text]


_OURS = ("sros_tool", "sros_ros2_security")
"""The distributions that have the command of sros; the second one is that of a workspace."""
_SECONDS = 60.0
_ASK = """
import sys
sys.path[:] = [each for each in sys.path if each]  # not the working folder: anybody may own it
import json, importlib.metadata as metadata
found = metadata.entry_points(group="ros2cli.command", name="security")
print(json.dumps([each.dist.name for each in found if each.dist]))
"""


@dataclass(frozen=True, slots=True)
class SecurityProvider:
    """The distribution whose `ros2 security` runs, and those whose command it hides."""

    provider: str
    """The Python package whose command runs: ``sros_tool`` or ``sros_ros2_security`` are sros."""
    hidden: tuple[str, ...]
    """Other packages that have the command, which does not run."""

    @property
    def ours(self) -> bool:
        """Whether it is that of sros."""
        return self.provider in _OURS

    def __str__(self) -> str:
        if self.ours:
            return "`ros2 security` is that of sros."
        return (
            f"`ros2 security` is that of {self.provider}, not of sros: ros2cli takes the one that "
            "Python finds last. `sros` itself is not concerned."
        )


def security_provider(environment: Mapping[str, str]) -> SecurityProvider | None:
    """Ask the Python of the program ``ros2``; None without the program, a command, or an answer."""
    program = shutil.which("ros2", path=environment.get("PATH"))
    words = _interpreter(Path(program)) if program else []
    if not words:
        return None
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        ended = subprocess.run(
            [*words, "-c", _ASK],
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_SECONDS,
            check=True,
        )
        names = [str(each) for each in json.loads(ended.stdout)]
        if names:
            hidden = {name for name in names if name != names[-1] and name not in _OURS}
            return SecurityProvider(names[-1], tuple(sorted(hidden)))
    return None


def _interpreter(script: Path) -> list[str]:
    """Return the words behind ``#!`` in the first line of a script, if they name a Python."""
    with suppress(OSError, ValueError), script.open("rb") as file:
        first = file.readline(512)
        if first.startswith(b"#!") and b"python" in first:
            return shlex.split(first[2:].decode())
    return []
