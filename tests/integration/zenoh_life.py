"""Running Zenoh sessions while their keystore changes, in a process and a network of their own."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from tests.integration.zenoh_world import PAUSE, World, key, text, until
from tests.support.harness import policy_text, sros, subscribe

ROUTER, TALKER, LISTENER, OTHER = "/router", "/talker", "/listener", "/other"


class Robot:
    """Processes of enclaves, each with the files that the keystore had when it started."""

    def __init__(self, keystore: Path) -> None:
        self.keystore = keystore
        self.world = World(keystore, rules=True)
        self.open: dict[str, Any] = {}
        self.heard: set[str] = set()
        self.kept: list[Any] = []

    def start(self, *enclaves: str, keystore: Path | None = None, **how: Any) -> None:
        """Start processes, or start them again; ``how`` changes keys of their configuration."""
        for enclave in enclaves:
            if enclave in self.open:
                self.open.pop(enclave).close()
            self.world.keystore = keystore or self.keystore
            file = "router.json5" if enclave == ROUTER else "session.json5"
            session = self.open[enclave] = self.world.open(enclave, file, **how)
            if enclave == LISTENER:
                for name in ("/chatter", "/more", "/extra"):
                    self.kept.append(
                        session.declare_subscriber(key(name), lambda each: self.hear(each))
                    )

    def hear(self, sample: Any) -> None:
        self.heard.add(text(sample))

    def hears(self, who: str, name: str, *, wanted: bool) -> bool:
        """Whether the listener hears what a process publishes; waits long only if it should."""
        word = f"{who}{name}{time.monotonic()}"
        session = self.open[who]
        if wanted:
            return until(lambda: word in self.heard, lambda: session.put(key(name), word))
        for _ in range(10):
            session.put(key(name), word)
            time.sleep(PAUSE / 5)
        return word in self.heard


def verb(*words: object) -> Any:
    """Run a verb, and return what it shows as JSON."""
    return json.loads(sros(*words, "--json").ok().out)


def rights(keystore: Path) -> dict[str, Any]:
    """The listener loses /chatter and gets /more; which restarts that needs."""
    robot = Robot(keystore)
    robot.start(ROUTER, TALKER, LISTENER)
    found: dict[str, Any] = {
        "before": [
            robot.hears(TALKER, "/chatter", wanted=True),
            robot.hears(TALKER, "/more", wanted=False),
        ]
    }
    policy = keystore.parent / "changed.xml"
    policy.write_text(policy_text({LISTENER: subscribe("/more")}))
    changed = verb("create_permission", keystore, LISTENER, policy)
    found["restart"] = changed["restart_zenoh"]
    found["none restarted"] = robot.hears(TALKER, "/chatter", wanted=True)
    robot.start(LISTENER)
    found["listener alone"] = robot.hears(TALKER, "/more", wanted=False)
    robot.start(ROUTER)
    direct = TALKER in changed["restart_zenoh"]
    found["both"] = robot.hears(TALKER, "/more", wanted=not direct)
    robot.start(*(each for each in changed["restart_zenoh"] if each in (TALKER, OTHER)))
    found["listed"] = [
        robot.hears(TALKER, "/more", wanted=True),
        robot.hears(TALKER, "/chatter", wanted=False),
    ]
    return found


def renewal(keystore: Path) -> dict[str, Any]:
    """The talker gets a new key and certificate; nobody else has to be restarted."""
    robot = Robot(keystore)
    robot.start(ROUTER, TALKER, LISTENER)
    found: dict[str, Any] = {"before": robot.hears(TALKER, "/chatter", wanted=True)}
    found["restart"] = verb("renew", keystore, TALKER, "--new-key")["restart"]
    found["after"] = robot.hears(TALKER, "/chatter", wanted=True)
    robot.start(TALKER)
    found["restarted"] = robot.hears(TALKER, "/chatter", wanted=True)
    return found


def revocation(keystore: Path) -> dict[str, Any]:
    """The talker is revoked, and somebody kept its files."""
    robot = Robot(keystore)
    robot.start(ROUTER, TALKER, OTHER, LISTENER)
    found: dict[str, Any] = {"before": robot.hears(TALKER, "/chatter", wanted=True)}
    kept = keystore.with_name("kept")
    shutil.copytree(keystore, kept)
    done = verb("revoke", keystore, TALKER)
    found["restart"] = done["restart_zenoh"]
    found["none restarted"] = robot.hears(TALKER, "/chatter", wanted=True)
    robot.start(ROUTER)
    found["others"] = [robot.hears(OTHER, "/extra", wanted=True)]
    found["router restarted"] = robot.hears(TALKER, "/chatter", wanted=False)
    robot.start(*(each for each in done["restart_zenoh"] if each != ROUTER))
    found["others"].append(robot.hears(OTHER, "/extra", wanted=True))
    found["listed restarted"] = robot.hears(TALKER, "/chatter", wanted=False)
    robot.start(TALKER, keystore=kept)
    found["connects"] = until(lambda: bool(list(robot.open[TALKER].info.routers_zid())))
    found["with its old files"] = robot.hears(TALKER, "/chatter", wanted=False)
    return found


def rotation(keystore: Path) -> dict[str, Any]:
    """Both CAs are replaced in three stages, all processes restarted one by one after each."""
    robot = Robot(keystore)
    robot.start(ROUTER, TALKER, LISTENER)
    found: dict[str, Any] = {"0": [robot.hears(TALKER, "/chatter", wanted=True)]}
    kept = keystore.with_name("kept")
    shutil.copytree(keystore, kept)
    for stage in ("distribute", "reissue", "retire"):
        verb("rotate_ca", keystore, "--next")
        found[stage] = [robot.hears(TALKER, "/chatter", wanted=True)]
        for each in (LISTENER, ROUTER, TALKER):
            robot.start(each)
            found[stage].append(robot.hears(TALKER, "/chatter", wanted=True))
    document = json.loads((kept / f"enclaves{TALKER}/session.json5").read_text())
    # As written, a client would wait without end for a router that does not refuse it.
    hurried = document["connect"] | {"timeout_ms": 4000}
    try:
        robot.start(TALKER, keystore=kept, connect=hurried)
        found["with the old CA"] = robot.hears(TALKER, "/chatter", wanted=False)
    except zenoh.ZError:  # a client without a router
        found["with the old CA"] = False
    robot.start(TALKER)
    found["again"] = robot.hears(TALKER, "/chatter", wanted=True)
    return found


PLAYS: dict[str, Callable[[Path], Any]] = {
    each.__name__: each for each in (rights, renewal, revocation, rotation)
}
