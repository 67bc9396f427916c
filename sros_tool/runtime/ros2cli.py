"""Whose `ros2 security` runs here: ros2cli takes the last of the packages that have the command.

Source: ros2cli 0.32, ``entry_points.py``: entry points by name, in the order of ``sys.path``.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

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
            hidden = {each for each in names if each != names[-1] and each not in _OURS}
            return SecurityProvider(names[-1], tuple(sorted(hidden)))
    return None


def _interpreter(script: Path) -> list[str]:
    """Return the words behind ``#!`` in the first line of a script, if they name a Python."""
    with suppress(OSError, ValueError), script.open("rb") as file:
        first = file.readline(512)
        if first.startswith(b"#!") and b"python" in first:
            return shlex.split(first[2:].decode())
    return []
