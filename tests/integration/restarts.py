"""Rotate CAs under Cyclone DDS nodes that run, restart these one by one, and say who hears whom.

Arguments: a keystore with the enclaves /talker and /listener, a domain, and the steps: stages of
`rotate_ca`, "finish", or "same-key".  Prints a JSON list with an object for each step: "running"
(nobody was restarted), "listener" (it alone was), "talker", and "both", each true or false.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from subprocess import Popen

from converse import start

from sros_tool.keystore.rotate import renew_identity_ca, rotate_ca
from sros_tool.keystore.rotation import Stage
from sros_tool.runtime.events import Kind, read_events
from sros_tool.runtime.netns import enter_isolation, try_isolation

ENOUGH = 5
LONGEST = 8.0  # until a late joiner is heard
SILENCE = 4.0  # after which nobody is expected any more


class Nodes:
    """Starts nodes, and tells what they heard."""

    def __init__(self, root: str, domain: int, folder: Path) -> None:
        self._root = root
        self._domain = domain
        self._folder = folder
        self._processes: dict[str, tuple[Popen[bytes], Path]] = {}

    def start(self, role: str, number: int) -> str:
        name = f"{role} {number}"
        node = {"role": role, "name": name, "keystore": self._root, "enclave": f"/{role}"}
        self._processes[name] = start(
            {**node, "topic": "/chatter", "text": f"from {name};"}, self._domain, self._folder
        )
        wait_for(lambda: self._kinds(name) & {Kind.READY, Kind.REFUSED, Kind.FAILED}, 30.0)
        assert Kind.READY in self._kinds(name), read_events(self._processes[name][1])
        return name

    def stop(self, name: str) -> None:
        process, _ = self._processes.pop(name)
        process.terminate()
        process.wait(10)

    def hears(self, listener: str, talker: str, patience: float = LONGEST) -> bool:
        """Whether the listener hears the talker from now on."""
        before = self._heard(listener)[talker]
        return wait_for(lambda: self._heard(listener)[talker] >= before + ENOUGH, patience)

    def _kinds(self, name: str) -> set[Kind]:
        return {event.kind for event in read_events(self._processes[name][1])}

    def _heard(self, name: str) -> Counter[str]:
        events = read_events(self._processes[name][1])
        texts = [event.text for event in events if event.kind is Kind.HEARD]
        return Counter(text.partition("from ")[2].partition(";")[0] for text in texts)


def wait_for(what: Callable[[], object], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if what():
            return True
        time.sleep(0.05)
    return False


def go(root: Path, step: str) -> None:
    now = datetime.now(UTC)
    if step == "same-key":
        renew_identity_ca(root, now=now)
    elif step == "finish":
        rotate_ca(root, finish=True, now=now)
    else:
        assert rotate_ca(root, Stage(step), now=now).changes


def main() -> None:
    root, domain, steps = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    if try_isolation().isolated:
        enter_isolation()
    answers = []
    with tempfile.TemporaryDirectory() as folder:
        nodes = Nodes(str(root), domain, Path(folder))
        talker, listener = nodes.start("talker", 0), nodes.start("listener", 0)
        assert nodes.hears(listener, talker)
        for number, step in enumerate(steps, 1):
            go(root, step)
            answer = {"running": nodes.hears(listener, talker)}
            new_listener = nodes.start("listener", number)
            answer["listener"] = nodes.hears(new_listener, talker, SILENCE)
            new_talker = nodes.start("talker", number)
            answer["both"] = nodes.hears(new_listener, new_talker)
            answer["talker"] = nodes.hears(listener, new_talker, SILENCE)
            answers.append(answer)
            for name in (talker, listener):
                nodes.stop(name)
            talker, listener = new_talker, new_listener
        for name in (talker, listener):
            nodes.stop(name)
    json.dump(answers, sys.stdout)


if __name__ == "__main__":
    main()
