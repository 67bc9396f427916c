"""Starts processes of nodes, runs commands of sros next to them, and prints how these ended.

Reads from stdin ``{"domain": N, "folder": PATH, "processes": [...], "commands": [[...], ...]}``,
and prints JSON.  A process is ``{"enclave", "nodes" (as in run_nodes.py), "arguments", "visits"}``;
all but visitors are ready before the first command.  A visitor starts when the first command has
said the first of two texts (``visits``) on its stderr, and is killed when it has said the second.
A command is ``{"words", "signal", "once"}``: the words after ``sros``, and the signal that it gets
once it has said all of these texts, or, where there are none, once it looks at the graph.  The
commands of one list run at the same time.  All is in a network of its own where the kernel allows
it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Any

from sros_tool.runtime.netns import end_with_parent, enter_isolation, try_isolation
from tests.integration.ros_nodes.run_nodes import Nodes
from tests.support.children import PATIENCE, wait_for

OBSERVER = b"sros_tool.graph.observation"


def start(process: dict[str, Any]) -> Nodes:
    words = ("--ros-args", "--enclave", process["enclave"], *process.get("arguments", ()))
    return Nodes(process["nodes"], *words)


class Command:
    """A command of sros that runs, and what it has said so far."""

    def __init__(self, words: list[str], folder: str) -> None:
        self.out, self.err = "", ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sros_tool", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            preexec_fn=end_with_parent,
        )
        self._readers = [threading.Thread(target=self._hear), threading.Thread(target=self._read)]
        for each in self._readers:
            each.start()

    def _hear(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            self.err += line

    def _read(self) -> None:
        assert self.process.stdout
        self.out = self.process.stdout.read()

    def wait_until_said(self, text: str) -> None:
        """Wait until a line with this text is whole; fails when the command ends without it."""
        wait_for(
            lambda: any(text in line for line in self.err.split("\n")[:-1]) or self._ended(),
            f"{text!r} of {self.process.args!r}",
        )
        if text not in self.err:
            raise SystemExit(f"it ended without {text!r}: {self.out}\n{self.err}")

    def wait_until_it_looks(self) -> None:
        """Wait until the process that observes the graph for it has been started."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")

        def observes() -> bool:
            found = [Path(f"/proc/{each}/cmdline") for each in children.read_text().split()]
            return any(OBSERVER in each.read_bytes() for each in found if each.exists())

        wait_for(lambda: observes() or self._ended(), f"the observer of {self.process.args!r}")

    def end(self) -> dict[str, Any]:
        self.process.wait(PATIENCE)
        for each in self._readers:
            each.join()
        return {"status": self.process.returncode, "out": self.out, "err": self.err}

    def _ended(self) -> bool:
        return self.process.poll() is not None


def run(command: dict[str, Any], visitors: list[dict[str, Any]], folder: str) -> dict[str, Any]:
    running = Command(command["words"], folder)
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
        running.process.send_signal(command["signal"])
    return running.end()


def main() -> None:
    task = json.load(sys.stdin)
    if try_isolation().isolated:
        enter_isolation()
    os.environ["ROS_DOMAIN_ID"] = str(task["domain"])
    visitors = [each for each in task["processes"] if "visits" in each]
    steady = [start(each) for each in task["processes"] if "visits" not in each]
    try:
        for process in steady:
            process.wait_until_ready()
        ended: list[dict[str, Any]] = []
        for together in task["commands"]:
            with ThreadPoolExecutor(len(together)) as pool:
                come = [[] if ended or number else visitors for number in range(len(together))]
                ended += pool.map(run, together, come, repeat(task["folder"]))
        print(json.dumps(ended))
    finally:
        for process in steady:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
