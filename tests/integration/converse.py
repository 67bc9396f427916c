"""Let Cyclone DDS nodes talk in a network of their own: what was heard, refused, and readable.

Each node takes part in a process of its own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sros_tool.demo import cyclone_node
from sros_tool.demo.wire import Capture
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.events import Event, EventKind, EventReader
from tests.support.children import LATE, PATIENCE, Forked, apart, importing

Running = subprocess.Popen[bytes] | Forked

ENOUGH = 11
"""Messages after which somebody is heard, and is no longer waited for."""

SILENCE = 4.0
"""Seconds after which who is not expected is not heard any more; or twice what others needed."""

SETTLED = {EventKind.READY, EventKind.REFUSED, EventKind.FAILED}


@dataclass(frozen=True)
class Node:
    """A talker or listener; with "" as ``keystore`` it is unsecured.

    Those of whom it is expected that they speak or hear (``hears``) are waited for.  ``through``
    is a program, with arguments, that runs the command of the node.
    """

    role: str
    name: str
    keystore: str
    enclave: str
    topic: str = "/chatter"
    text: str = "Hello"
    hears: bool = True
    through: tuple[str, ...] = ()


@dataclass(frozen=True)
class Told:
    """What a node reported: the kinds of its events, and why it was refused or failed."""

    kinds: list[str]
    sent: int
    heard: list[str]
    reasons: list[str]
    errors: str


@dataclass(frozen=True)
class Conversation:
    """What each node told, and in how many packets each talker's text was readable.

    ``readable`` is None where packets may not be captured.
    """

    nodes: dict[str, Told]
    readable: dict[str, int] | None

    def heard(self, listener: str = "listener") -> bool:
        """Whether a listener heard enough; fails unless it was able to."""
        told = self.nodes[listener]
        assert told.kinds and "failed" not in told.kinds, self
        return len(told.heard) >= ENOUGH


def talker(
    keystore: Path,
    enclave: str,
    name: str = "talker",
    *,
    topic: str = "/chatter",
    text: str = "Hello",
) -> Node:
    return Node("talker", name, str(keystore), enclave, topic, text)


def listener(
    keystore: Path,
    enclave: str,
    name: str = "listener",
    *,
    topic: str = "/chatter",
    hears: bool = True,
) -> Node:
    return Node("listener", name, str(keystore), enclave, topic, hears=hears)


def converse(domain: int, *nodes: Node) -> Conversation:
    """Let the nodes talk, and tell what came of it."""
    return apart(partial(_play, domain, nodes))


def _play(domain: int, nodes: Sequence[Node]) -> Conversation:
    capture = open_capture([node.text for node in nodes if node.role == "talker"])
    with tempfile.TemporaryDirectory() as folder:
        parties = [Party(node, domain, Path(folder)) for node in nodes]
        wait_until_over(parties, capture)
        told = {party.node.name: party.end() for party in parties}
    return Conversation(told, dict(capture.plain) if capture else None)


class Party:
    """A node that takes part, in a process of its own."""

    def __init__(self, node: Node, domain: int, folder: Path) -> None:
        self.node = node
        self.process, report = start(node, domain, folder)
        self._reader = EventReader(report)
        self._events: list[Event] = []
        self._errors = report.with_suffix(".err")

    def events(self) -> list[Event]:
        self._events += self._reader.new_events()
        return self._events

    def is_settled(self) -> bool:
        """Whether it is ready, or will never be."""
        return any(e.kind in SETTLED for e in self.events()) or self.process.poll() is not None

    def is_content(self) -> bool:
        """Whether nothing more has to be awaited of it."""
        if self.process.poll() is not None:
            return True
        wanted = EventKind.SENT if self.node.role == "talker" else EventKind.HEARD
        return sum(event.kind is wanted for event in self.events()) >= ENOUGH

    def end(self) -> Told:
        self.process.terminate()
        self.process.wait(PATIENCE)
        events = self.events()
        return Told(
            kinds=sorted({event.kind.value for event in events}),
            sent=sum(event.kind is EventKind.SENT for event in events),
            heard=[event.text for event in events if event.kind is EventKind.HEARD],
            reasons=[e.text for e in events if e.kind in (EventKind.REFUSED, EventKind.FAILED)],
            errors=self._errors.read_text(errors="replace"),
        )


def wait_until_over(parties: Sequence[Party], capture: Capture | None) -> None:
    """Wait until all who can be heard were; who is to stay silent gets as long, and longer."""

    def pause() -> None:
        if capture:
            capture.drain()
        time.sleep(0.02)

    hung = time.monotonic() + PATIENCE
    while not all(party.is_settled() for party in parties) and time.monotonic() < hung:
        pause()
    begin = time.monotonic()
    expected = [party for party in parties if party.node.hears]
    while not all(party.is_content() for party in expected) and time.monotonic() < begin + LATE:
        pause()
    if len(expected) < len(parties):
        needed = time.monotonic() - begin
        end = begin + max(SILENCE, 2 * needed)
        while time.monotonic() < end:
            pause()


def open_capture(texts: list[str]) -> Capture | None:
    """None where packets may not be captured: without root, and without a network of one's own."""
    try:
        return Capture(texts)
    except PermissionError:
        return None


def start(node: Node, domain: int, folder: Path) -> tuple[Running, Path]:
    """The process of a node, the file that it reports to, and beside that its errors (.err)."""
    report = folder / f"{node.name}.jsonl"
    report.touch()
    environment = {k: v for k, v in importing().items() if not k.startswith("ROS_")}
    environment["ROS_DOMAIN_ID"] = str(domain)
    if node.keystore:
        environment |= secured_environment(Path(node.keystore), node.enclave, domain)
    arguments = [node.role, "--topic", node.topic, "--text", node.text, "--period", "0.1"]
    arguments += ["--report", str(report)]
    if not node.through:
        work = partial(cyclone_node.main, arguments)
        return Forked(work, env=environment, errors=report.with_suffix(".err")), report
    command = [*node.through, sys.executable, "-m", "sros_tool.demo.cyclone_node"]
    with report.with_suffix(".err").open("wb") as errors:
        return subprocess.Popen([*command, *arguments], env=environment, stderr=errors), report
