"""Random access control in every process of a Zenoh network: what arrives, and what sros says.

For a process of its own, as all that opens sessions (`zenoh_world.observed_apart`).
"""

from __future__ import annotations

import json
import random
import time
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import zenoh
import zenoh.ext

from sros_tool.zenoh.access import Enforcement, Flow, Message
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.delivery import (
    ZenohProcess,
    query_delivery,
    route,
    sample_delivery,
    token_delivery,
)
from sros_tool.zenoh.document import parse_configuration
from tests.integration.zenoh_world import PAUSE, drawn_rule, until, world

TALKER, LISTENER, ROUTER = "/talker", "/listener", "/router"
HISTORY = (Message.QUERY, Message.DECLARE_QUERYABLE)
"""The messages about the history of a topic, on keys below that of the topic."""
KINDS = ("publish", "call", "answer", "watch", "ask the graph", "history")


@dataclass(frozen=True)
class Case:
    """The keys of one case: asked or published, declared, announced, watched, and with history.

    ``asks`` says how the graph is looked at: a session would answer a query from its subscription.
    """

    asked: str
    declared: str
    announced: str
    watched: str
    kept: str
    asks: bool


def drawn_case(draw: random.Random, number: int) -> Case:
    """Return a case whose keys are below its own chunk; mostly without wildcards."""
    base = f"t/{number}"
    asked, declared = (f"{base}/{draw.choices(('a', '*', '**'), (6, 1, 1))[0]}" for _ in "12")
    watched = f"{base}/{draw.choices(('a', '*', '**'), (4, 3, 3))[0]}"
    return Case(asked, declared, f"{base}/a", watched, f"h/{number}/a", draw.random() < 0.5)


def drawn_access(draw: random.Random, remotes: list[str], count: int) -> dict[str, Any]:
    """Return the access control of a process: each message allowed in most cases, some denied."""
    rules: list[dict[str, Any]] = []
    for remote, flow, message, permission in product(remotes, Flow, Message, ("allow", "deny")):
        keys = [
            key
            for number in range(count)
            if draw.random() < (0.97 if permission == "allow" else 0.005)
            for key in drawn_keys(draw, number, message)
        ]
        if keys:
            rules.append(
                {
                    "id": f"{remote} {flow} {message} {permission}",
                    "permission": permission,
                    "flows": [flow],
                    "messages": [message],
                    "key_exprs": keys,
                }
            )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": each, "cert_common_names": [each]} for each in remotes],
        "policies": [
            {
                "rules": [rule["id"] for rule in rules if rule["id"].startswith(f"{each} ")],
                "subjects": [each],
            }
            for each in remotes
        ],
    }


def parsed(access: dict[str, Any]) -> Enforcement:
    return parse_configuration(json.dumps({"access_control": access}).encode(), "drawn").access


def drawn_keys(draw: random.Random, number: int, message: Message) -> Iterator[str]:
    """Yield keys of rules for a case, and for its topic with history."""
    yield from drawn_rule(draw, f"t/{number}")
    if message in HISTORY:
        yield f"h/{number}/{draw.choice('a*')}/@adv/**"
    else:
        yield from drawn_rule(draw, f"h/{number}")


def remotes_of(modes: dict[str, Mode]) -> dict[str, list[str]]:
    """Return with whom each process has links, and a little more."""
    return {each: [other for other in modes if other != each] for each in modes}


def compared(keystore: Path, modes: dict[str, Mode], seed: int, count: int) -> dict[str, Any]:
    """Return where real sessions and the engine differ, and how many deliveries arrived."""
    draw = random.Random(seed)
    cases = [drawn_case(draw, number) for number in range(count)]
    remotes = remotes_of(modes)
    access = {each: drawn_access(draw, remotes[each], count) for each in modes}
    said = predicted(cases, modes, access)
    seen: dict[str, set[int]] = {kind: set() for kind in KINDS}
    with world(keystore, rules=True) as at:
        at.open(ROUTER, "router.json5", access_control=access[ROUTER])
        talker, listener = (
            at.open(
                each,
                access_control=access[each],
                mode=modes[each].value,
                listen={"endpoints": ["tls/localhost:0"] if modes[each] is Mode.PEER else []},
            )
            for each in (TALKER, LISTENER)
        )
        if modes[TALKER] is modes[LISTENER] is Mode.PEER:
            until(lambda: bool(list(talker.info.peers_zid())))
        play(talker, listener, cases, said, seen)
    return {
        "different": {
            kind: {
                number: [*astuple(cases[number]), number in said[kind]]
                for number in sorted(said[kind] ^ seen[kind])
            }
            for kind in KINDS
        },
        "arrived": {kind: len(seen[kind]) for kind in KINDS},
        "dropped": {kind: count - len(seen[kind]) for kind in KINDS},
    }


def asking_with(case: Case) -> Message:
    return Message.LIVELINESS_QUERY if case.asks else Message.DECLARE_LIVELINESS_SUBSCRIBER


def predicted(
    cases: list[Case], modes: dict[str, Mode], access: dict[str, dict[str, Any]]
) -> dict[str, set[int]]:
    """Return the cases that arrive, of each kind, as the engine says."""
    processes = {
        name: ZenohProcess(name, mode, parsed(access[name])) for name, mode in modes.items()
    }
    there = route(processes[TALKER], processes[LISTENER], processes[ROUTER])
    back = there[::-1]
    said: dict[str, set[int]] = {kind: set() for kind in KINDS}
    for number, case in enumerate(cases):
        asked = query_delivery(there, case.asked, case.declared, case.announced)
        told = {
            "publish": sample_delivery(there, case.asked, case.declared).arrives,
            "call": asked.arrives,
            "answer": asked.answered,
            "ask the graph" if case.asks else "watch": token_delivery(
                back, case.announced, case.watched, asking_with(case)
            ).arrives,
            "history": query_delivery(back, f"{case.kept}/@adv/**", reply_key=case.kept).answered,
        }
        for kind, arrives in told.items():
            if arrives:
                said[kind].add(number)
    return said


def play(
    talker: zenoh.Session,
    listener: zenoh.Session,
    cases: list[Case],
    said: dict[str, set[int]],
    seen: dict[str, set[int]],
) -> None:
    """Let the sessions do what the cases say; what should arrive is tried again until it does."""
    kept: list[Any] = []
    for number, case in enumerate(cases):

        def reply(query: Any, number: int = number, key: str = case.announced) -> None:
            with query:
                seen["call"].add(number)
                query.reply(key, "answer")

        def noted(kind: str, number: int = number) -> Any:
            return lambda _: seen[kind].add(number)

        kept += [
            listener.declare_subscriber(case.declared, noted("publish")),
            listener.declare_queryable(case.declared, reply),
            listener.liveliness().declare_token(case.announced),
            zenoh.ext.declare_advanced_publisher(
                talker, case.kept, cache=zenoh.ext.CacheConfig(max_samples=1)
            ),
        ]
        kept[-1].put("history")
        if not case.asks:
            watch = talker.liveliness().declare_subscriber
            kept.append(watch(case.watched, noted("watch"), history=True))
    publishers = [talker.declare_publisher(case.asked) for case in cases]
    time.sleep(2 * PAUSE)

    def attempt(number: int) -> None:
        case = cases[number]
        publishers[number].put("x")
        got = talker.get(case.asked, target=zenoh.QueryTarget.ALL, timeout=10.0)
        if any(each.ok is not None for each in got):
            seen["answer"].add(number)
        tokens = talker.liveliness().get(case.watched, timeout=10.0) if case.asks else ()
        if any(each.ok is not None for each in tokens):
            seen["ask the graph"].add(number)

    def late(number: int) -> None:
        subscriber = zenoh.ext.declare_advanced_subscriber(
            listener,
            cases[number].kept,
            lambda _: seen["history"].add(number),
            history=zenoh.ext.HistoryConfig(),
        )
        kept.append(subscriber)

    def again() -> None:
        for number in range(len(cases)):
            if any(number in said[kind] - seen[kind] for kind in KINDS if kind != "history"):
                attempt(number)
            if number in said["history"] - seen["history"]:
                late(number)

    for number in range(len(cases)):
        attempt(number)
        late(number)
    time.sleep(2 * PAUSE)
    until(lambda: all(said[kind] <= seen[kind] for kind in KINDS), again)
    time.sleep(2 * PAUSE)
