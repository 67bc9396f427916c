"""Looks at the ROS graph through a process of its own, and gives what it sees as values."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from sros_tool.errors import UnavailableError
from sros_tool.graph.observation import Endpoint, Observation
from sros_tool.graph.resolve import Sighting, nodes_of, resolve

PERIOD_SECONDS = 0.1
"""How often the graph is looked at; a node that lives for a second is seen several times."""
_START_SECONDS = 30.0
_END_SECONDS = 3.0


class GraphSource(Protocol):
    """Where observations come from; tests put a script in its place."""

    def next(self, seconds: float) -> Observation | None:
        """The graph after its next change, or None if it has not changed for ``seconds``."""


class ObserverError(UnavailableError):
    """The observer could not look: ``reason`` and ``output`` say what rclpy and the DDS said."""

    def __init__(self, what: str, reason: str, output: str) -> None:
        super().__init__(what, reason)
        self.reason = reason
        self.output = output


def require_rclpy() -> None:
    """Raise `UnavailableError` if this Python has no rclpy."""
    if importlib.util.find_spec("rclpy") is None:
        raise UnavailableError(
            "rclpy is not installed for this Python, and without it sros cannot see the ROS graph",
            f"Python is {sys.executable}.",
            "On a machine with ROS 2, source its setup file first (. /opt/ros/jazzy/setup.bash); "
            "elsewhere install sros with it: pip install 'sros_tool[ros]'. "
            "A policy can still be learned from logs with --from-log.",
        )


class RosGraph:
    """The ROS graph as it is from now on; use as a context manager.

    ``environment`` is added to that of this process: the domain, and the enclave if the observer
    is to be secured.  Raises `UnavailableError` without rclpy, and `ObserverError` where rclpy
    cannot start a node.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        require_rclpy()
        self._environment = {**os.environ, **(environment or {})}
        self.rmw = ""

    def __enter__(self) -> Self:
        read_end, write_end = os.pipe()
        self._output = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(
                # -P: what lies in the present folder is not what shall be imported.
                [
                    *(sys.executable, "-P", "-m", "sros_tool.graph.observer"),
                    *(str(write_end), str(PERIOD_SECONDS)),
                ],
                stdin=subprocess.PIPE,
                stdout=self._output,
                stderr=subprocess.STDOUT,
                pass_fds=[write_end],
                env=self._environment,
                process_group=0,  # Ctrl-C is for this process, which then ends the other one
            )
        except BaseException:
            os.close(read_end)
            self._output.close()
            raise
        finally:
            os.close(write_end)
        self._report = read_end
        self._rest = b""
        try:
            answer = self._line(_START_SECONDS)
            if answer is None or "ready" not in answer:
                raise self._failed(answer)
        except BaseException:
            self.close()
            raise
        self.rmw = answer["ready"]
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def next(self, seconds: float) -> Observation | None:
        """The graph after its next change, or None if it has not changed for ``seconds``."""
        line = self._line(seconds)
        if line is None:
            return None
        endpoints = tuple(
            (participant, ns, name, Endpoint(topic, direction))
            for participant, ns, name, topic, direction in line["endpoints"]
        )
        return resolve(Sighting(nodes_of(line["listed"]), endpoints, line["ordered"]))

    def close(self) -> None:
        """End the observer, politely first, so that the graph forgets it at once."""
        if self._process.stdin:
            self._process.stdin.close()
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._report)
        self._output.close()

    def _line(self, seconds: float) -> dict[str, Any] | None:
        """The next line of the observer, or None after ``seconds``."""
        deadline = time.monotonic() + seconds
        with selectors.DefaultSelector() as selector:
            selector.register(self._report, selectors.EVENT_READ)
            while b"\n" not in self._rest:
                left = deadline - time.monotonic()
                if not selector.select(max(left, 0)):
                    return None
                data = os.read(self._report, 1 << 20)
                if not data:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        self._process.wait(_END_SECONDS)
                    raise self._failed(None)
                self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        found: dict[str, Any] = json.loads(line)
        return found

    def _failed(self, answer: Mapping[str, Any] | None) -> ObserverError:
        self._output.seek(0)
        output = self._output.read().decode("utf-8", "replace")
        if answer is None:
            ended = self._process.poll()
            reason = (
                f"It ended with status {ended}." if ended is not None else "It does not answer."
            )
            return ObserverError("the process that observes the ROS graph failed", reason, output)
        what = {
            "import": "rclpy cannot be imported",
            "participant": "rclpy cannot start",
            "node": "rclpy cannot start a node to observe the graph with",
        }[answer["failed"]]
        return ObserverError(what, f"{answer['reason']}".rstrip(".") + ".", output)
