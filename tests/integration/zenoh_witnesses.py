"""Ask real Zenoh, past a router with given rules, who may write and read what.

A world is {"access_control", "uses": [[enclave, writes, topic, allowed]...]}.  The enclave /probe
is at the other end; its rights have to be all.  What is not allowed is tried until /twin, which has
all rights, too, has done the same.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import zenoh

from tests.integration.zenoh_world import PAUSE, key, replies, serve, text, until, world

_ENDS = {"rt": "", "rq": "Request", "rr": "Reply"}


def happens(who: dict[str, Any], enclave: str, writes: bool, topic: str, allowed: bool) -> bool:
    """Whether an enclave writes or reads a topic; each message names its sender."""
    begin = topic[:2]
    name = topic[2 : len(topic) - len(_ENDS[begin])]
    both = {"own": who[enclave], "twin": who["/twin"]}
    done: set[str] = set()
    if begin == "rt":
        kept, again = published(both, who["/probe"], key(name), done, writes=writes)
    elif (begin == "rq") is writes:
        kept, again = called(both, who["/probe"], name, done, answers=begin == "rr")
    else:
        kept, again = served(both, who["/probe"], name, done, answers=begin == "rr")
    time.sleep(PAUSE)
    until(lambda: "own" in done if allowed else "twin" in done, again)
    if not allowed:
        again()
        time.sleep(PAUSE)
    for each in kept:
        each.undeclare()
    return "own" in done


def published(
    both: dict[str, Any], probe: zenoh.Session, name: str, done: set[str], *, writes: bool
) -> tuple[list[Any], Any]:
    """Publish to the probe, or hear it."""
    if writes:
        kept = [probe.declare_subscriber(name, lambda each: done.add(text(each)))]
        return kept, lambda: [session.put(name, mark) for mark, session in both.items()]
    kept = [
        session.declare_subscriber(name, lambda _, mark=mark: done.add(mark))
        for mark, session in both.items()
    ]
    return kept, lambda: probe.put(name, "probe")


def called(
    both: dict[str, Any], probe: zenoh.Session, name: str, done: set[str], *, answers: bool
) -> tuple[list[Any], Any]:
    """Call the probe: whether it executes the request, or also whether its reply arrives."""
    executed: set[str] = set()
    kept = [serve(probe, name, "probe", executed)]

    def again() -> None:
        for mark, session in both.items():
            if replies(session, name, mark) and answers:
                done.add(mark)
        done.update(() if answers else executed)

    return kept, again


def served(
    both: dict[str, Any], probe: zenoh.Session, name: str, done: set[str], *, answers: bool
) -> tuple[list[Any], Any]:
    """Be called by the probe: whether the request arrives, or also the reply gets back."""
    executed: dict[str, set[str]] = {mark: set() for mark in both}
    kept = [serve(session, name, mark, executed[mark]) for mark, session in both.items()]

    def again() -> None:
        answered = replies(probe, name, "probe")
        done.update(answered if answers else {mark for mark, of in executed.items() if of})

    return kept, again


def observe(keystore: Path, given: dict[str, Any]) -> list[bool]:
    """Whether each use happens in a world."""
    enclaves = {enclave for enclave, *_ in given["uses"]}
    with world(keystore, rules=False) as at:
        at.open("/router", "router.json5", rules=True, access_control=given["access_control"])
        who = {each: at.open(each) for each in sorted(enclaves | {"/probe", "/twin"})}
        return [happens(who, *use) for use in given["uses"]]
