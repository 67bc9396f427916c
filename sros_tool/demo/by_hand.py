"""Run one node of the demo by hand: a talker, a listener, or the router of a Zenoh network.

The node runs in the environment that is there, such as that of ``sros run``, until it is stopped.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from sros_tool.demo.backend import CYCLONE, RCLPY, ZENOH, zenoh_backend
from sros_tool.demo.scenarios.model import Role
from sros_tool.errors import SrosError, UsageError
from sros_tool.runtime.events import Event, EventKind, parse_event
from sros_tool.runtime.netns import end_with_starter
from sros_tool.runtime.rcl_security import choose_loadable, domain_of
from sros_tool.runtime.variables import ENABLE, ENCLAVE

_SILENCE = 5.0
"""Seconds after which a node says that it heard nothing, or is not connected."""

_LIBRARIES = {CYCLONE: "Cyclone DDS", RCLPY: "rclpy", ZENOH: "Zenoh"}
_MODULES = {CYCLONE: "cyclone", RCLPY: "ros", ZENOH: "zenoh"}
_LONGEST_LINE = 1 << 20
"""Bytes of an event; whoever sends longer messages is not listened to any further."""


@dataclass(frozen=True)
class HandNode:
    """A node to run by hand; ``topic`` is absolute."""

    role: Role
    backend: str
    topic: str

    def __post_init__(self) -> None:
        if self.role is Role.ROUTER and self.backend != ZENOH:
            raise UsageError(
                "only Zenoh has routers", "Nodes on DDS find each other.", "Add --backend zenoh."
            )
        if self.backend == ZENOH:
            zenoh_backend()


def security_of(node: HandNode, environment: Mapping[str, str]) -> str:
    """Return in one line what the node runs on, and whether it is secured.

    Raises:
        SrosError: The environment demands security, and the enclave cannot be loaded.
    """
    if node.backend == ZENOH:
        kind = "ROUTER" if node.role is Role.ROUTER else "SESSION"
        uri = environment.get(f"ZENOH_{kind}_CONFIG_URI", "")
        security = f"configured by {uri}" if uri else "WITHOUT security"
        if not uri and environment.get(ENABLE) == "true":
            security += ", as Zenoh ignores ROS_SECURITY_*: add --rmw rmw_zenoh_cpp to `sros run`"
    else:
        choice = choose_loadable(environment)
        name = environment.get(ENCLAVE) or "/"
        security = f"secured, in the enclave {name}" if choice.enclave else "WITHOUT security"
    topic = "" if node.role is Role.ROUTER else f", topic {node.topic}"
    domain = domain_of(environment)
    return f"{node.role} on {_LIBRARIES[node.backend]}{topic}, domain {domain}: {security}"


def run_by_hand(node: HandNode, say: Callable[[str], None]) -> int:
    """Run a node until it is stopped by a signal; return its exit status.

    ``say`` gets lines about what is sent and heard, without line breaks at their ends.

    Raises:
        SrosError: The environment demands security, and the enclave cannot be loaded.
    """
    say(f"{security_of(node, os.environ)} (stop with Ctrl-C)")
    events, writing = os.pipe()
    module = f"sros_tool.demo.{_MODULES[node.backend]}_node"
    command = [sys.executable, "-P", "-m", module, node.role.value, "--period", "1"]
    if node.role is not Role.ROUTER:
        command += ["--topic", node.topic]
    if node.backend == ZENOH and os.environ.get(ENCLAVE):
        command += ["--ros-args", "--enclave", os.environ[ENCLAVE], "--"]
    if node.backend == RCLPY:  # what it logs of its messages is said here already
        command += ["--ros-args", "--log-level", "warn", "--"]
    command += ["--report", f"/proc/self/fd/{writing}"]
    stopped = threading.Event()

    def stop(*_: object) -> None:
        stopped.set()
        process.terminate()

    with subprocess.Popen(command, pass_fds=[writing], preexec_fn=end_with_starter()) as process:
        os.close(writing)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, stop)
        with open(events, "rb", buffering=0) as pipe:
            _tell(node, pipe.fileno(), say)
        status = process.wait()
    if stopped.is_set():
        say("stopped")
    elif status and node.backend == RCLPY:
        say("`sros doctor` says whether rclpy on this machine can be secured")
    return status


def _tell(node: HandNode, pipe: int, say: Callable[[str], None]) -> None:
    """Say what the node reports, until it ends."""
    data = b""
    connected = node.backend != ZENOH
    while len(data) < _LONGEST_LINE:
        ready, _, _ = select.select([pipe], [], [], _SILENCE)
        if not ready:
            if not connected:
                say(
                    f"not connected for {_SILENCE:.0f} s: no router runs (`sros demo router` "
                    "starts one), or it refuses this node"
                )
            elif node.role is Role.LISTENER:
                say(f"heard nothing for {_SILENCE:.0f} s")
            continue
        if not (more := os.read(pipe, 65536)):
            return
        *lines, data = (data + more).split(b"\n")
        for line in lines:
            event = parse_event(line, Path("the node's report"))
            connected = connected or event.kind is EventKind.READY
            if text := _line(event):
                say(text)
    raise SrosError("a node reported too long a message", f"It is over {_LONGEST_LINE} bytes long.")


def _line(event: Event) -> str:
    match event.kind:
        case EventKind.SENT:
            return f"sent   {event.text}"
        case EventKind.HEARD:
            return f"heard  {event.text}"
        case EventKind.REFUSED | EventKind.FAILED:
            return f"{event.kind}: {' '.join(event.text.split())}"
        case EventKind.READY:
            return "ready"
        case _:
            return ""
