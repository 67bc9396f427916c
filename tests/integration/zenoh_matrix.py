"""Every enclave of a policy tries every name in every direction, on real Zenoh sessions.

A matrix has the names of topics and services, and which of them each enclave may publish,
subscribe, request and reply.

Each enclave has two sessions: one with the written file, which uses all that it may, and one that
obeys no rules, and tries everything. The second one shows that the others enforce; so no pair of
two such sessions counts in peer mode.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import zenoh

from sros_tool.translate_zenoh.graph import example_token
from tests.integration.zenoh_world import key, text, tokens_of, until, world
from tests.support.children import PATIENCE

ROUTER = "/router"
ROUNDS = 2
"""What is denied is said in each round, before what is allowed and waited for. When all of the last
round was heard, what was denied in the rounds before had long been delivered, if it was."""
AGAIN = 1.0
"""Seconds after which a message or a call that is allowed, and had no effect, is repeated."""

Tried = tuple[str, str, str]
"""Who says or asks, who hears or answers, and the name."""


@dataclass(frozen=True)
class Voice:
    """A session of an enclave, which may ignore its own rules."""

    enclave: str
    ignores_rules: bool

    def __str__(self) -> str:
        return f"{'ignores_rules ' if self.ignores_rules else ''}{self.enclave}"


@dataclass(frozen=True)
class Matrix:
    """What may be: the names, and those that each enclave may use in each right."""

    topics: tuple[str, ...]
    services: tuple[str, ...]
    rights: dict[str, dict[str, frozenset[str]]]

    def voices(self) -> list[Voice]:
        """All sessions."""
        return [
            Voice(each, ignores_rules) for each in self.rights for ignores_rules in (False, True)
        ]

    def may(self, voice: Voice, right: str) -> frozenset[str]:
        """The names that the enclave of a session has a right to."""
        return self.rights[voice.enclave][right]

    def used(self, voice: Voice, right: str) -> list[str]:
        """The names that a session tries, first those that it has no right to."""
        names = self.topics if right in ("publish", "subscribe") else self.services
        may = self.may(voice, right)
        tried = names if voice.ignores_rules else may
        return sorted(tried, key=lambda each: (each in may, each))

    def wanted(self, direct: bool, says: str, hears: str) -> set[Tried]:
        """What has to happen when everybody tries all that it uses."""
        return {
            (str(one), str(other), name)
            for one, other in pairs(self.voices(), direct)
            for name in self.may(one, says) & self.may(other, hears)
        }

    def tried(self, direct: bool, says: str, hears: str) -> int:
        """How many pairs of a name and two sessions are tried."""
        return sum(
            len(set(self.used(one, says)) & set(self.used(other, hears)))
            for one, other in pairs(self.voices(), direct)
        )


def pairs(voices: list[Voice], direct: bool) -> Iterator[tuple[Voice, Voice]]:
    """The pairs of different sessions between which somebody enforces rules."""
    for one, other in product(voices, repeat=2):
        if one != other and not (direct and one.ignores_rules and other.ignores_rules):
            yield one, other


def publish_all(matrix: Matrix, sessions: dict[Voice, Any], direct: bool) -> set[Tried]:
    """Every session publishes and subscribes topics; return what all of them heard."""
    last: dict[Tried, int] = {}

    def subscribe(listener: Voice, name: str) -> Any:
        def hear(sample: Any) -> None:
            speaker, _, number = text(sample).rpartition(" ")
            tried = (speaker, str(listener), name)
            last[tried] = max(last.get(tried, 0), int(number))

        return sessions[listener].declare_subscriber(key(name), directly(hear))

    kept = [subscribe(each, name) for each in sessions for name in matrix.used(each, "subscribe")]
    wanted = matrix.wanted(direct, "publish", "subscribe")
    for number in range(1, ROUNDS + 1):
        for voice, session in sessions.items():
            for name in matrix.used(voice, "publish"):
                session.put(key(name), f"{voice} {number}")

        def missing(number: int = number) -> set[Tried]:
            return {each for each in wanted if last.get(each, 0) < number}

        repeat(
            missing,
            lambda speaker, name, number=number: sessions[speaker].put(
                key(name), f"{speaker} {number}"
            ),
            list(sessions),
        )
    del kept
    return counted(set(last), direct)


def call_all(
    matrix: Matrix, sessions: dict[Voice, Any], direct: bool
) -> tuple[set[Tried], set[Tried]]:
    """Every session serves and calls services; return which calls were executed, or replied to.

    A call ends when all have replied that get it, so nothing denied is still under way afterwards.
    """
    executed: set[Tried] = set()
    replied: set[Tried] = set()
    pending: set[object] = set()

    def serve(server: Voice, name: str) -> Any:
        def answer(query: Any) -> None:
            with query:
                executed.add((bytes(query.payload or b"").decode(), str(server), name))
                query.reply(key(name), str(server))

        return sessions[server].declare_queryable(key(name), directly(answer), complete=True)

    def call(client: Voice, name: str) -> None:
        def reply(got: Any) -> None:
            if got.ok is not None:
                replied.add((str(client), text(got.ok), name))

        one = object()
        pending.add(one)
        sessions[client].get(
            key(name),
            directly(reply, lambda: pending.discard(one)),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            payload=str(client),
            timeout=PATIENCE,
        )

    kept = [serve(each, name) for each in sessions for name in matrix.used(each, "reply")]
    wanted = matrix.wanted(direct, "request", "reply")
    for voice in sessions:
        for name in matrix.used(voice, "request"):
            call(voice, name)
    repeat(lambda: wanted - (executed & replied), call, list(sessions))
    ended = time.monotonic() + PATIENCE
    while pending and time.monotonic() < ended:
        time.sleep(0.05)
    del kept
    return counted(executed, direct), counted(replied, direct)


def directly(callback: Any, ended: Any = None) -> Any:
    """Return a handler in the threads of Zenoh; usually each handler has a thread of its own."""
    return zenoh.handlers.Callback(callback, ended, indirect=False)


def counted(seen: set[Tried], direct: bool) -> set[Tried]:
    """What was seen between different sessions of which one obeys rules, or the router enforces."""

    def counts(one: str, other: str) -> bool:
        ignores_rules = one.startswith("ignores_rules") and other.startswith("ignores_rules")
        return one != other and not (direct and ignores_rules)

    return {each for each in seen if counts(each[0], each[1])}


def repeat(missing: Any, again: Any, voices: list[Voice]) -> None:
    """Wait until nothing is missing; try again now and then what is missing, until it is late."""
    by_name = {str(each): each for each in voices}
    end = time.monotonic() + PATIENCE / 2
    pause = 0.02
    since = 0.0
    while (left := missing()) and time.monotonic() < end:
        if since >= AGAIN:
            since = 0.0
            for speaker, name in sorted({(each[0], each[2]) for each in left}):
                again(by_name[speaker], name)
        time.sleep(pause)
        since += pause


def observed(keystore: Path, matrix: Matrix, *, enforced: bool) -> dict[str, Any]:
    """Return what happened and should not, what did not and should, and how much was tried.

    Unless it is ``enforced``, nobody has any rules.
    """
    with world(keystore, rules=enforced) as at:
        at.open(ROUTER, "router.json5")
        sessions = {
            each: at.open(each.enclave, rules=enforced and not each.ignores_rules)
            for each in matrix.voices()
        }
        example = next(iter(matrix.rights))[1:]
        document = json.loads((keystore / "enclaves" / example / "session.json5").read_text())
        direct = document["mode"] == "peer"
        router = json.loads((keystore / "enclaves" / ROUTER[1:] / "router.json5").read_text())
        keys = [key for rule in router["access_control"]["rules"] for key in rule["key_exprs"]]
        tokens = [
            session.liveliness().declare_token(
                example_token(0, each.enclave, keys).replace("/zid/", f"/{session.info.zid()}/")
            )
            for each, session in sessions.items()
        ]
        everybody = {str(session.info.zid()) for session in sessions.values()}
        up = all(
            until(lambda s=s: {each[2] for each in tokens_of(s)} >= everybody)  # type: ignore[misc]
            for s in sessions.values()
        )
        heard = publish_all(matrix, sessions, direct)
        executed, replied = call_all(matrix, sessions, direct)
        del tokens
    found = {
        "heard": (heard, matrix.wanted(direct, "publish", "subscribe")),
        "executed": (executed, matrix.wanted(direct, "request", "reply")),
        "replied": (replied, matrix.wanted(direct, "request", "reply")),
    }
    called = matrix.tried(direct, "request", "reply")
    return {
        "up": up,
        "different": {
            what: {"too much": sorted(seen - wanted)[:20], "missing": sorted(wanted - seen)[:20]}
            for what, (seen, wanted) in found.items()
            if seen != wanted
        },
        "allowed": {what: len(wanted) for what, (_, wanted) in found.items()},
        "tried": {
            "heard": matrix.tried(direct, "publish", "subscribe"),
            "executed": called,
            "replied": called,
        },
    }


def read_matrix(document: dict[str, Any]) -> Matrix:
    """Return the matrix of a document."""
    rights = {
        enclave: {right: frozenset(names) for right, names in of.items()}
        for enclave, of in document["rights"].items()
    }
    return Matrix(tuple(document["topics"]), tuple(document["services"]), rights)
