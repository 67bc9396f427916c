"""Change a keystore under Cyclone DDS nodes that run, restart these one by one: who hears whom?

The keystore has the enclaves /talker and /listener, perhaps also /server and /client.  Steps are
stages of `rotate_ca`, "finish", "same-key", or a template and a stage of `update_keystore`, as in
"production governance", with what is expected after each: "running" (nobody was restarted),
"listener" (it alone was), "talker", and "both", each true or false.  A client counts as listener,
and its server as talker.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from sros_tool.keystore.layout import list_enclaves
from sros_tool.keystore.lifecycle.rotate import renew_identity_ca, rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage
from sros_tool.keystore.lifecycle.update import UpdateStage, update_keystore
from sros_tool.keystore.template import load_template
from sros_tool.runtime.events import Event, EventKind, EventReader
from tests.integration.converse import SETTLED, SILENCE, Node, Running, start
from tests.support.children import LATE, PATIENCE, wait_for

ENOUGH = 5


class Nodes:
    """Starts nodes, and tells what they heard."""

    def __init__(self, root: str, domain: int, folder: Path) -> None:
        self._root = root
        self._domain = domain
        self._folder = folder
        self._processes: dict[str, Running] = {}
        self._readers: dict[str, EventReader] = {}
        self._events: dict[str, list[Event]] = {}

    def start(self, role: str, number: int) -> str:
        node = Node(role, f"{role} {number}", self._root, f"/{role}", text=f"from {role} {number};")
        process, report = start(node, self._domain, self._folder)
        self._processes[node.name] = process
        self._readers[node.name], self._events[node.name] = EventReader(report), []
        wait_for(lambda: self._kinds(node.name) & SETTLED or process.poll() is not None, node.name)
        errors = report.with_suffix(".err").read_text()
        assert EventKind.READY in self._kinds(node.name), (self._events[node.name], errors)
        return node.name

    def stop(self, name: str) -> None:
        process = self._processes.pop(name)
        process.terminate()
        process.wait(PATIENCE)

    def hears(self, listener: str, talker: str, *, expected: bool = True) -> bool:
        """Whether the listener hears the talker from now on; longer awaited where expected."""
        enough = self._heard(listener)[talker] + ENOUGH
        end = time.monotonic() + (LATE if expected else SILENCE)
        while self._heard(listener)[talker] < enough:
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

    def _kinds(self, name: str) -> set[EventKind]:
        return {event.kind for event in self._look(name)}

    def _heard(self, name: str) -> Counter[str]:
        texts = [event.text for event in self._look(name) if event.kind is EventKind.HEARD]
        return Counter(text.partition("from ")[2].partition(";")[0] for text in texts)

    def _look(self, name: str) -> list[Event]:
        """All that a node has reported so far."""
        self._events[name] += self._readers[name].new_events()
        return self._events[name]


def go(root: Path, step: str) -> None:
    now = datetime.now(UTC)
    if step == "same-key":
        renew_identity_ca(root, now=now)
    elif step == "finish":
        rotate_ca(root, finish=True, now=now)
    elif " " in step:
        template, stage = step.split()
        target = load_template(template)
        done = update_keystore(root, target, now=now, next_stage=True, allow_looser=True).done
        assert done == (UpdateStage(stage),), done
    else:
        assert rotate_ca(root, RotationStage(step), now=now).changes


def play(
    root: Path, domain: int, steps: Mapping[str, Mapping[str, bool]]
) -> dict[str, dict[str, bool]]:
    """Take the steps, and tell who heard whom after each, in the form of ``steps``."""
    pairs = [("listener", "talker")]
    pairs += [("client", "server")] if "/client" in list_enclaves(root) else []
    answers = {}
    with tempfile.TemporaryDirectory() as folder:
        nodes = Nodes(str(root), domain, Path(folder))
        old = {role: nodes.start(role, 0) for role in roles(pairs, 1) + roles(pairs, 0)}

        def hear(listening: Mapping[str, str], talking: Mapping[str, str], wanted: bool) -> bool:
            """Whether each listener hears its talker, which has to be the same for all."""
            (found,) = {
                nodes.hears(listening[one], talking[other], expected=wanted) for one, other in pairs
            }
            return found

        assert hear(old, old, True)
        for number, (step, expected) in enumerate(steps.items(), 1):
            go(root, step)
            answer = {"running": hear(old, old, expected["running"])}
            new = {role: nodes.start(role, number) for role in roles(pairs, 0)}
            answer["listener"] = hear(new, old, expected["listener"])
            new |= {role: nodes.start(role, number) for role in roles(pairs, 1)}
            answer["both"] = hear(new, new, expected["both"])
            answer["talker"] = hear(old, new, expected["talker"])
            answers[step] = answer
            for name in old.values():
                nodes.stop(name)
            old = new
        for name in old.values():
            nodes.stop(name)
    return answers


def roles(pairs: Sequence[tuple[str, str]], side: int) -> list[str]:
    return [pair[side] for pair in pairs]
