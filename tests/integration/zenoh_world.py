"""Zenoh sessions that speak as nodes of rmw_zenoh do, in a process and a network of their own."""

from __future__ import annotations

import contextlib
import json
import random
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import zenoh
import zenoh.ext

from sros_tool.zenoh.access import AccessControl, AccessRule, Flow, Message, RemoteRights
from sros_tool.zenoh.configuration import Configuration, Mode
from tests.support.children import LONG, apart

TYPE = "std_msgs::msg::dds_::String_/RIHS01_" + "0" * 64
BUFFERS = ("_buf_cpu", "_buf/0a1b")
"""Where images of /chatter would be sent, below its key (`sros_tool.zenoh.releases`)."""
GRAPH = "@ros2_lv/0/**"
MOST_TOKENS = 1_000_000
WITHIN = 60.0
"""Seconds within which what is allowed has to happen; usually it takes parts of one."""
PAUSE = 0.5

ITS_OWN = {"other", "wildcard", "wildcards", "thief", "forged image", "strayed", "twin"}
"""What a session says to itself: no rule stands in between; and what its enclave may hear."""
FALSE_TOKENS = (
    ("/talker", "spoofed"),
    ("/other", "talker"),
    ("/other", "other", "MP /chatter"),
    ("/other", "other", "SS /add"),
    ("/other", "talker", "MP /elsewhere"),
)
"""What /other announces falsely: enclave, node, and what the node has."""
WIDE_TOKENS = ("denied", "guest")
"""Nodes of /wide, which may serve everything but what the first one of them would have."""
_SIDES = ("connect", "listen")


def key(name: str) -> str:
    """The key of a topic or service in domain 0."""
    return f"0{name}/{TYPE}"


def configured(
    keystore: Path,
    enclave: str,
    file: str = "session.json5",
    *,
    rules: bool = True,
    certificate: bool = True,
    **changes: Any,
) -> zenoh.Config:
    """The written configuration of an enclave, and the paths that a process adds to it.

    Without `rules` the process obeys nobody; without `certificate` it shows none.
    """
    folder = keystore / "enclaves" / enclave[1:]
    document = json.loads((folder / file).read_text())
    paths = {"root_ca_certificate": "identity_ca.cert.pem"}
    for side in _SIDES if certificate else ():
        paths |= {f"{side}_private_key": "key.pem", f"{side}_certificate": "cert.pem"}
    if not certificate:
        document["transport"]["link"]["tls"]["enable_mtls"] = False
        document["listen"]["endpoints"] = []
    if not rules:
        del document["access_control"]
    config = zenoh.Config.from_json5(json.dumps(document | changes))
    for name, path in paths.items():  # as ZENOH_CONFIG_OVERRIDE does
        config.insert_json5(f"transport/link/tls/{name}", json.dumps(str(folder / path)))
    return config


def until(happened: Callable[[], bool], again: Callable[[], object] = lambda: None) -> bool:
    """Do something again and again until something happens; False if it never does."""
    end = time.monotonic() + WITHIN
    while time.monotonic() < end:
        again()
        time.sleep(0.1)
        if happened():
            return True
    return False


class World:
    """Open sessions, all of which are closed at the end."""

    def __init__(self, keystore: Path, *, rules: bool) -> None:
        self.keystore = keystore
        self.rules = rules
        self.sessions: list[Any] = []

    def open(self, enclave: str, file: str = "session.json5", **how: Any) -> Any:
        """Open a session of an enclave."""
        how.setdefault("rules", self.rules)
        session = zenoh.open(configured(self.keystore, enclave, file, **how))
        self.sessions.append(session)
        return session


@contextlib.contextmanager
def world(keystore: Path, *, rules: bool) -> Iterator[World]:
    """A world that closes its sessions."""
    opened = World(keystore, rules=rules)
    try:
        yield opened
    finally:
        for session in reversed(opened.sessions):
            with contextlib.suppress(zenoh.ZError):  # where closing many takes longer than 10 s
                session.close()


def text(sample: Any) -> str:
    return bytes(sample.payload).decode()


def replies(session: zenoh.Session, name: str, request: str) -> set[str]:
    """Who replies to a call, as a client of rmw_zenoh makes it."""
    got = session.get(
        key(name),
        target=zenoh.QueryTarget.ALL_COMPLETE,
        consolidation=zenoh.ConsolidationMode.NONE,
        payload=request,
        timeout=5.0,
    )
    return {text(reply.ok) for reply in got if reply.ok is not None}


def serve(session: zenoh.Session, name: str, who: str, executed: set[str]) -> Any:
    def answer(query: Any) -> None:
        with query:
            executed.add(bytes(query.payload or b"").decode())
            query.reply(key(name), who)

    return session.declare_queryable(key(name), answer, complete=True)


def token(
    session: zenoh.Session, enclave: str, node: str, announced: str = "NN", zid: str = ""
) -> Any:
    """Announce a node in the graph, or what it has (`MP /chatter`), in the name of an enclave."""
    kind, _, name = announced.partition(" ")
    place = f"{enclave.replace('/', '%')}/%/{node}"
    if name:
        place += f"/{name.replace('/', '%')}/{TYPE}/::,7:,:,:,,"
    zid = zid or str(session.info.zid())
    return session.liveliness().declare_token(f"@ros2_lv/0/{zid}/0/0/{kind}/{place}")


class Graph:
    """The nodes that a session discovers, each with what it has, as rmw_zenoh keeps them.

    Session, number, namespace and name make a node: nobody looks at the enclave.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.found: dict[tuple[str, ...], set[str]] = {}
        self._kept = session.liveliness().declare_subscriber(GRAPH, self._change, history=True)

    def _change(self, sample: Any) -> None:
        _, _, zid, number, _, kind, _, *node = str(sample.key_expr).split("/")
        place, name = (zid, number, *node[:2]), " ".join([kind, *node[2:3]])
        if sample.kind == zenoh.SampleKind.PUT:
            self.found.setdefault(place, set()).add(name)
        elif kind == "NN":
            self.found.pop(place, None)
        else:
            self.found.get(place, set()).discard(name)

    def nodes(self) -> set[str]:
        return {place[3] for place in self.found}

    def announced(self) -> set[str]:
        """What nodes have, as `MP %chatter`, each after the name of the node."""
        found = {(place[3], name) for place, names in self.found.items() for name in names}
        return {f"{node} {name}" for node, name in found if name != "NN"}


def nodes(session: zenoh.Session) -> set[str]:
    """The nodes of the graph that a session sees."""
    return {each[8] for each in tokens_of(session) if each[5] == "NN"}


def tokens_of(session: zenoh.Session) -> list[list[str]]:
    """The parts of all tokens that a session sees.

    What the session knows is in the channel before it can be read: more than its size blocks it.
    """
    found = session.liveliness().get(GRAPH, zenoh.handlers.FifoChannel(MOST_TOKENS), timeout=5.0)
    return [str(each.ok.key_expr).split("/") for each in found if each.ok is not None]


def communicate(keystore: Path, *, rules: bool) -> dict[str, Any]:
    """Everybody says and asks what it may, and what it may not; /other obeys no rules of its own.

    Each denied message is sent before an allowed one that is waited for.
    """
    with world(keystore, rules=rules) as at:
        at.open("/router", "router.json5")
        talker, keeper, listener = (
            at.open(f"/{each}") for each in ("talker", "keeper", "listener")
        )
        server, client, wide = (at.open(f"/{each}") for each in ("server", "client", "wide"))
        one, two = at.open("/other"), at.open("/other")
        other = at.open("/other", rules=False)
        heard: set[str] = set()
        overheard: set[str] = set()
        executed: set[str] = set()
        stolen: set[str] = set()
        kept: list[Any] = [
            listener.declare_subscriber(key("/chatter"), lambda each: heard.add(text(each))),
            listener.declare_subscriber(key("/secret"), lambda each: heard.add(text(each))),
            listener.declare_subscriber(key("/elsewhere"), lambda each: heard.add(text(each))),
            other.declare_subscriber(key("/elsewhere"), lambda each: overheard.add(text(each))),
            other.declare_subscriber(key("/chatter"), lambda each: overheard.add(text(each))),
            other.declare_subscriber("0/**", lambda each: overheard.add(text(each))),
            # What /other may hear below /chatter is no buffer of /chatter.
            other.declare_subscriber(
                "0/chatter/*/**/$*::$*/*/**", lambda each: overheard.add(text(each))
            ),
            serve(server, "/add", "server", executed),
            serve(other, "/add", "thief", stolen),
            token(talker, "/talker", "talker"),
            token(server, "/server", "server", "SS /add"),
            *(token(other, *each) for each in FALSE_TOKENS),
            *(token(wide, "/wide", node) for node in WIDE_TOKENS),
            token(other, "/other", "other"),
        ]
        for each in BUFFERS:
            buffer = f"{key('/chatter')}/{each}"
            for session, what in ((listener, heard), (other, overheard)):
                kept.append(
                    session.declare_subscriber(buffer, lambda each, to=what: to.add(text(each)))
                )
        graph = Graph(listener)
        until(lambda: "talker" in graph.nodes())
        talkers = (str(talker.info.zid()), "0", "%", "talker")

        def erase() -> None:
            token(other, "/other", "talker", zid=str(talker.info.zid())).undeclare()

        erase()
        if not rules:  # as for the attacks below
            until(lambda: talkers not in graph.found, erase)
        erased = talkers not in graph.found  # the router may announce the talker again
        kept.append(token(other, "/other", "other", "MP /elsewhere"))
        until(lambda: "other MP %elsewhere" in graph.announced())
        kept += [
            zenoh.ext.declare_advanced_publisher(
                keeper, key("/map"), cache=zenoh.ext.CacheConfig(max_samples=1)
            )
        ]
        kept[-1].put("map")
        seen: set[str] = set()
        late: set[str] = set()
        time.sleep(PAUSE)

        def attack() -> None:
            other.put(key("/chatter"), "other")
            other.put(f"{key('/chatter')}/_buf_cpu", "forged image")
            other.put(f"0/*/{TYPE}", "wildcard")
            other.put("0/**", "wildcards")
            talker.put(key("/secret"), "talker")
            # Processes that obey, and another one that may do it and does not obey.
            talker.put(key("/elsewhere"), "astray")
            other.put(key("/elsewhere"), "strayed")
            for name in (key("/add"), "0/**"):
                asked = other.get(name, payload="other", target=zenoh.QueryTarget.ALL, timeout=5.0)
                overheard.update(text(each.ok) for each in asked if each.ok is not None)

        for _ in range(3):
            attack()
            time.sleep(0.1)
        if not rules:  # what succeeds may take its time on a busy machine
            attacks = {"other", "wildcard", "wildcards", "talker", "forged image", "strayed"}
            until(lambda: heard >= attacks and {"server", "astray"} <= overheard, attack)
        until(lambda: "chatter" in heard, lambda: talker.put(key("/chatter"), "chatter"))
        for each in BUFFERS:
            buffer = f"{key('/chatter')}/{each}"
            until(lambda e=each: e in heard, lambda b=buffer, e=each: talker.put(b, e))  # type: ignore[misc]
        until(lambda: "keeper" in heard, lambda: keeper.put(key("/secret"), "keeper"))
        answered: set[str] = set()
        until(
            lambda: "server" in answered, lambda: answered.update(replies(client, "/add", "client"))
        )
        until(lambda: seen >= {"talker", "other", "guest"}, lambda: seen.update(nodes(listener)))
        kept.append(
            zenoh.ext.declare_advanced_subscriber(
                listener,
                key("/map"),
                lambda each: late.add(text(each)),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
            )
        )
        until(lambda: bool(late))
        twin: set[str] = set()
        kept.append(two.declare_subscriber(key("/elsewhere"), lambda each: twin.add(text(each))))
        until(lambda: bool(twin), lambda: one.put(key("/elsewhere"), "twin"))
        time.sleep(PAUSE)
        return {
            "heard": sorted(heard),
            "overheard": sorted(overheard - ITS_OWN),
            "executed": sorted(executed),
            "answered": sorted(answered),
            "nodes": sorted(seen),
            "graph": sorted(graph.nodes()),
            "announced": sorted(graph.announced()),
            "erased": erased or talkers not in graph.found,
            "history": sorted(late),
            "same_enclave": sorted(twin),
        }


def entrances(keystore: Path, foreign: Path) -> dict[str, Any]:
    """Who gets a connection to the router; and what a router of another enclave gets."""
    hurried = {"timeout_ms": 4000, "exit_on_failure": True}
    found: dict[str, Any] = {}
    with world(keystore, rules=True) as at:
        at.open("/router", "router.json5")
        document = json.loads((keystore / "enclaves/talker/session.json5").read_text())
        endpoints = document["connect"]["endpoints"]
        tries: dict[str, Callable[[], zenoh.Config]] = {
            "ours": lambda: configured(
                keystore, "/talker", connect={"endpoints": endpoints, **hurried}
            ),
            "foreign": lambda: configured(
                foreign, "/talker", connect={"endpoints": endpoints, **hurried}
            ),
            "none": lambda: configured(
                keystore,
                "/talker",
                certificate=False,
                connect={"endpoints": endpoints, **hurried},
            ),
            "tcp": lambda: zenoh.Config.from_json5(
                json.dumps(
                    {
                        "mode": "client",
                        "connect": {
                            "endpoints": [each.replace("tls/", "tcp/") for each in endpoints],
                            **hurried,
                        },
                        "scouting": {"multicast": {"enabled": False}},
                    }
                )
            ),
        }
        for name, config in (*tries.items(), ("ours again", tries["ours"])):
            try:
                with zenoh.open(config()) as session:
                    until(lambda s=session: bool(list(s.info.routers_zid())))  # type: ignore[misc]
                    found[name] = bool(list(session.info.routers_zid()))
            except zenoh.ZError:
                found[name] = False
        without = document | {"connect": {"endpoints": endpoints, **hurried}}
        try:
            with zenoh.open(zenoh.Config.from_json5(json.dumps(without))):
                found["without paths"] = True
        except zenoh.ZError:
            found["without paths"] = False
    return found


def passed_on(keystore: Path, router: str) -> bool:
    """Whether the listener hears the talker when an enclave plays the router, without rules."""
    document = json.loads((keystore / "enclaves/router/router.json5").read_text())
    with world(keystore, rules=True) as at:
        at.open(
            router,
            "router.json5" if router == "/router" else "session.json5",
            rules=False,
            mode="router",
            listen=document["listen"],
            connect={"endpoints": []},
        )
        talker, listener = at.open("/talker"), at.open("/listener")
        heard: set[str] = set()
        kept = listener.declare_subscriber(key("/chatter"), lambda each: heard.add(text(each)))
        for _ in range(20 if router != "/router" else 1):
            talker.put(key("/chatter"), "chatter")
            time.sleep(0.1)
        if router == "/router":
            until(lambda: bool(heard), lambda: talker.put(key("/chatter"), "chatter"))
        del kept
        return bool(heard)


def starting(keystore: Path, number: int) -> dict[str, bool]:
    """Start sessions before their router, all at once, then the router, twice."""
    told: dict[str, bool] = {}
    with world(keystore, rules=True) as at:
        talker, listener = (
            threading.Thread(target=lambda name=each: opened.update({name: at.open(name)}))
            for each in ("/talker", "/listener")
        )
        others = [threading.Thread(target=at.open, args=("/other",)) for _ in range(number - 2)]
        opened: dict[str, Any] = {}
        starting = [talker, listener, *others]
        for each in starting:
            each.start()
        time.sleep(PAUSE)
        told["opened before the router"] = len(at.sessions) > 0
        router = at.open("/router", "router.json5")
        for each in starting:
            each.join(WITHIN)
        told["all opened"] = len(at.sessions) == number + 1
        heard: set[str] = set()
        kept = opened["/listener"].declare_subscriber(
            key("/chatter"), lambda each: heard.add(text(each))
        )

        def say(what: str) -> bool:
            put = opened["/talker"].put
            return until(lambda: what in heard, lambda: put(key("/chatter"), what))

        told["heard"] = say("first")
        at.sessions.remove(router)
        router.close()
        at.open("/router", "router.json5")
        told["heard after the router's restart"] = say("second")
        del kept
    return told


MESSAGES = {
    "put": (
        ("/talker", Flow.INGRESS, Message.PUT, 0),
        ("/talker", Flow.EGRESS, Message.DECLARE_SUBSCRIBER, 1),
        ("/listener", Flow.INGRESS, Message.DECLARE_SUBSCRIBER, 1),
        ("/listener", Flow.EGRESS, Message.PUT, 0),
    ),
    "query": (
        ("/talker", Flow.INGRESS, Message.QUERY, 0),
        ("/listener", Flow.INGRESS, Message.DECLARE_QUERYABLE, 1),
        ("/listener", Flow.EGRESS, Message.QUERY, 0),
    ),
    "reply": (
        ("/listener", Flow.INGRESS, Message.REPLY, 2),
        ("/talker", Flow.EGRESS, Message.REPLY, 2),
    ),
}
"""The messages by which /talker puts or asks and /listener hears or answers, past the router: who,
direction, message, and the key: of the first one, of the declaration, or of the reply.

A publisher sends nothing that nobody seems to want; one with a wildcard key sends all the same.
"""


def drawn_rule(draw: random.Random, base: str) -> tuple[str, ...]:
    """Key expressions below a base; often all that is needed, sometimes nothing."""
    forms = (("a",), ("*",), ("$*a",), ("a$*",), ("**",), ("b",), ("a", "b"), ("*", "**"))
    weights = (8, 8, 3, 3, 6, 1, 1, 2)
    chosen = draw.choices(forms, weights)[0]
    return (f"{base}/{'/'.join(chosen)}",)


def observed_cases(
    talker: Any, listener: Any, cases: Sequence[tuple[str, str, str]], pause: float
) -> dict[str, set[int]]:
    """Have the talker put and ask, and return the numbers of the cases that were heard.

    A case is a key that is put and asked, one that the listener declares, and that of its reply.
    """
    seen: dict[str, set[int]] = {"put": set(), "query": set(), "reply": set()}
    kept: list[Any] = []
    for number, (_, declared, answer) in enumerate(cases):

        def reply(query: Any, number: int = number, answer: str = answer) -> None:
            with query:
                seen["query"].add(number)
                query.reply(answer, "answer")

        def hear(_: Any, number: int = number) -> None:
            seen["put"].add(number)

        kept += [
            listener.declare_subscriber(declared, hear),
            listener.declare_queryable(declared, reply),
        ]
    publishers = [talker.declare_publisher(asked) for asked, _, _ in cases]
    time.sleep(pause)
    for number, (asked, _, _) in enumerate(cases):
        publishers[number].put("x")
        got = talker.get(asked, target=zenoh.QueryTarget.ALL, timeout=10.0)
        if any(each.ok is not None for each in got):
            seen["reply"].add(number)
    time.sleep(pause)
    del kept
    return seen


def decisions(keystore: Path, count: int) -> dict[str, Any]:
    """Compare what `AccessControl` says with what a router does, on random rules and messages."""
    draw = random.Random(15)
    rules: dict[str, list[AccessRule]] = {"/talker": [], "/listener": []}
    cases = []
    for number in range(count):
        base = f"t/{number}"
        for who, flow, message, _ in (each for of in MESSAGES.values() for each in of):
            if draw.random() < 0.95:
                rules[who].append(AccessRule(flow, (message,), drawn_rule(draw, base)))
        asked, declared = (f"{base}/{draw.choices(('a', '*', '**'), (6, 1, 1))[0]}" for _ in "12")
        cases.append((asked, declared, f"{base}/a"))
    rules = {who: draw.sample(of, len(of)) for who, of in rules.items()}
    control = AccessControl(tuple(RemoteRights(who, tuple(of)) for who, of in rules.items()))
    written = Configuration(Mode.ROUTER, (), (), control)
    with world(keystore, rules=False) as at:
        enforced = json.loads(written.render())["access_control"]
        at.open("/router", "router.json5", rules=True, access_control=enforced)
        talker, listener = at.open("/talker"), at.open("/listener")
        seen = observed_cases(talker, listener, cases, 4 * PAUSE)
    told: dict[str, set[int]] = {
        what: {
            number
            for number, names in enumerate(cases)
            if all(
                control.allows(who, flow, message, names[place])
                or (message is Message.DECLARE_SUBSCRIBER and who == "/talker" and "*" in names[0])
                for who, flow, message, place in of
            )
        }
        for what, of in MESSAGES.items()
    }
    told["reply"] &= told["query"]
    return {
        "different": {
            what: {n: [*cases[n], n in told[what]] for n in sorted(told[what] ^ seen[what])}
            for what in seen
        },
        "happened": {what: len(seen[what]) for what in seen},
    }


PLAYS: dict[str, Callable[[Path, Path], Any]] = {
    "secured": lambda keystore, _: communicate(keystore, rules=True),
    "open": lambda keystore, _: communicate(keystore, rules=False),
    "entrances": entrances,
    "decisions": lambda keystore, _: decisions(keystore, 1000 if LONG else 200),
    "starting": lambda keystore, _: starting(keystore, 300 if LONG else 20),
    "routers": lambda keystore, _: {
        each: passed_on(keystore, each) for each in ("/other", "/router")
    },
}


def observed_apart(look: Callable[[], object]) -> Any:
    """Return, as JSON has it, what a function observes in a process and a network of its own.

    Threads of a session that hangs end with the process.
    """
    return json.loads(apart(lambda: json.dumps(look()), patience=3600))
