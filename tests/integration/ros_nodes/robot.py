"""Start processes of nodes, run commands of sros next to them, and tell how these ended.

A process is ``{"enclave", "nodes" (as in run_nodes.py), "arguments", "visits"}``; all but visitors
are ready before the first command.  A visitor starts when the first command has said the first of
two texts (``visits``) on its stderr, and is killed when it has said the second.  A command is
``{"words", "signal", "once"}``: the words after ``sros``, and the signal that it gets once it has
said all of these texts, or, where there are none, once it looks at the graph.  The commands of one
list run at the same time.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Any

from tests.integration.ros_nodes.run_nodes import Nodes, load_types
from tests.support.children import wait_for
from tests.support.harness import Ended, Running

load_types()

OBSERVER = b"sros_tool.graph.observation"
OF_THE_VERBS = (
    "sros_tool.cli.observing",
    "sros_tool.explain.audit",
    "sros_tool.graph.learn",
    "sros_tool.graph.observe",
    "sros_tool.policy.document",
)
"""Modules that the verbs which observe the graph import when they run."""


def start(process: dict[str, Any]) -> Nodes:
    words = ("--ros-args", "--enclave", process["enclave"], *process.get("arguments", ()))
    return Nodes(process["nodes"], *words)


class Command(Running):
    """A command of sros that runs beside nodes."""

    def wait_until_said(self, text: str) -> None:
        """Wait until a line with this text is whole; fails when the command ends without it."""
        wait_for(
            lambda: (
                any(text in line for line in self.err.split("\n")[:-1]) or self.poll() is not None
            ),
            repr(text),
        )
        if text not in self.err:
            raise AssertionError(f"it ended without {text!r}: {self.out}\n{self.err}")

    def wait_until_it_looks(self) -> None:
        """Wait until the process that observes the graph for it has been started."""
        children = Path(f"/proc/{self.pid}/task/{self.pid}/children")

        def observes() -> bool:
            found = [Path(f"/proc/{each}/cmdline") for each in children.read_text().split()]
            return any(OBSERVER in each.read_bytes() for each in found if each.exists())

        wait_for(lambda: observes() or self.poll() is not None, "the observer")


def run(command: dict[str, Any], visitors: list[dict[str, Any]], folder: Path) -> Ended:
    running = Command(*command["words"], cwd=folder)
    for each in visitors:
        come, go = each["visits"]
        running.wait_until_said(come)
        visitor = start(each)
        visitor.wait_until_ready()
        running.wait_until_said(go)
        visitor.kill()
        visitor.wait()
    if "signal" in command:
        for text in command["once"]:
            running.wait_until_said(text)
        if not command["once"]:
            running.wait_until_it_looks()
        running.send_signal(command["signal"])
    return running.end()


def play(
    domain: int,
    folder: Path,
    processes: Sequence[dict[str, Any]],
    commands: Sequence[Sequence[dict[str, Any]]],
) -> list[Ended]:
    """Start nodes in a domain, and run the commands in a folder, list after list.

    It changes the environment, so it is for a process of its own.
    """
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    for name in OF_THE_VERBS:  # once for all commands, which are forked
        importlib.import_module(name)
    visitors = [each for each in processes if "visits" in each]
    steady = [start(each) for each in processes if "visits" not in each]
    try:
        for process in steady:
            process.wait_until_ready()
        ended: list[Ended] = []
        for together in commands:
            with ThreadPoolExecutor(len(together)) as pool:
                come = [[] if ended or number else visitors for number in range(len(together))]
                ended += pool.map(run, together, come, repeat(folder))
        return ended
    finally:
        for process in steady:
            process.kill()
            process.wait()
