"""The scenarios on Zenoh: nodes with the names, tokens and messages of rmw_zenoh.

A world is a group of rows that share processes, among them a router. An attacker's process does not
enforce its own rules, so that only the rules of other processes stop the attack. Each attack has a
control, and is tried again without the defense that stops it.

Most parameters of the functions for rows are fields of `Row`; ``keystore`` is the keystore of all
parties.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from sros_tool.demo import forger
from sros_tool.demo.forger import STOLEN
from sros_tool.demo.scenarios import zenoh_forger
from sros_tool.demo.scenarios.model import (
    ACTION,
    OWN,
    SERVICE,
    UNSECURED,
    Claim,
    Identity,
    KeystoreChoice,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
    Wire,
    answered,
    hears,
    known_open,
    talker_and_listener,
    tries,
    zenoh_policy,
)

_ROUTER = "/router"
_PEERS, _CLIENTS = "peers", "clients"
"""The groups of rows with all defenses: sessions connect to each other, or only to the router."""
_CAST = {
    "talker": "/talker_listener/talker",
    "listener": "/talker_listener/listener",
    "guest": "/talker_listener/guest",
    "admin": "/talker_listener/guest/admin",
    "server": f"{SERVICE}/server",
    "client": f"{SERVICE}/client",
    "action server": f"{ACTION}/server",
    "action client": f"{ACTION}/client",
    "router": _ROUTER,
}
_TOPIC_OF = {
    Role.SERVER: SERVICE,
    Role.CLIENT: SERVICE,
    Role.ACTION_SERVER: ACTION,
    Role.ACTION_CLIENT: ACTION,
}
_CHATTER = (hears("listener", "talker"),)
_CALLS = (answered("client", "server"),)
_GOALS = (answered("action client", "action server"),)


def _scenario(name: str, title: str, *rows: Row) -> Scenario:
    return Scenario(name, title, rows, _CAST, zenoh_policy, router=_ROUTER)


def _router(keystore: KeystoreChoice | None) -> Party:
    """Return the router of a group of rows; unsecured if there is no keystore."""
    identity = UNSECURED if keystore is None else Identity(keystore, "router")
    return Party("router", Role.ROUTER, identity)


def _permitted_party(name: str, role: Role, keystore: KeystoreChoice, part: str = "") -> Party:
    """Return a party that does what its enclave may do; by default, ``part`` is ``name``."""
    return Party(name, role, Identity(keystore, part or name), _TOPIC_OF.get(role, ""), turn=1)


def _attacker(
    name: str,
    role: Role,
    keystore: KeystoreChoice,
    part: str = "guest",
    topic: str = "",
    *,
    ignores_rules: bool = True,
) -> Party:
    """Return an attacker whose enclave lacks the right, or whose files are invalid."""
    identity = Identity(keystore, part, ignores_rules=ignores_rules)
    return Party(name, role, identity, topic or _TOPIC_OF.get(role, ""), intruder=True, turn=2)


def _attempt_row(
    name: str,
    expected: RowStatus,
    mechanism: str,
    claim: Claim,
    parties: tuple[Party, ...],
    controls: tuple[Claim, ...] = (),
    *,
    world: str = "",
    defence_removed: str = "",
    evidence: str = "",
) -> Row:
    """Return a brief row with one claim that should have the status ``expected``."""
    return Row(
        name,
        expected,
        mechanism,
        parties,
        (replace(claim.expecting(expected), evidence=evidence),),
        controls,
        brief=True,
        world=world,
        defence_removed=defence_removed,
    )


def _execution_claim(server: str, client: str) -> Claim:
    """Return the claim that a server executes a call of a client."""
    return Claim(Relation.EXECUTES, server, client)


def _topic_pair(keystore: KeystoreChoice = OWN) -> tuple[Party, Party, Party]:
    """Return router, talker and listener."""
    talker, listener = talker_and_listener(keystore)
    return _router(keystore), replace(talker, turn=1), replace(listener, turn=1)


def _service_pair(keystore: KeystoreChoice = OWN) -> tuple[Party, ...]:
    """Return router, server and client."""
    server = _permitted_party("server", Role.SERVER, keystore)
    client = _permitted_party("client", Role.CLIENT, keystore)
    return _router(keystore), server, client


def _action_pair() -> tuple[Party, ...]:
    """Return router, action server and action client."""
    server = _permitted_party("action server", Role.ACTION_SERVER, OWN)
    client = _permitted_party("action client", Role.ACTION_CLIENT, OWN)
    return _router(OWN), server, client


# ── who hears, who calls, and who serves ───────────────────────────────────────────────────


def _topic_rows(link_mode: str, keystore: KeystoreChoice, world: str) -> tuple[Row, ...]:
    """Return the rows for sessions that connect in peer mode, or in client mode."""
    pair = _topic_pair(keystore)
    talker = _attacker("talker without permission", Role.TALKER, keystore, ignores_rules=False)
    listener = _attacker(
        "listener without permission", Role.LISTENER, keystore, ignores_rules=False
    )
    rows = [
        _attempt_row(
            f"talker to listener, {link_mode}",
            RowStatus.HEARD,
            "the rules allow both enclaves the topic, by the names in their certificates",
            hears("listener", "talker"),
            pair,
            world=world,
        )
    ]
    for party, claim in (
        (talker, hears("listener", talker.name)),
        (listener, hears(listener.name, "talker")),
    ):
        rows.append(
            _attempt_row(
                f"{party.name}, {link_mode}",
                RowStatus.NOT_HEARD,
                "no rule gives the enclave this right, and Zenoh drops what no rule allows",
                claim,
                (*pair, party),
                _CHATTER,
                world=world,
            )
        )
    return tuple(rows)


_ISOLATION = _scenario(
    "isolation",
    "nobody hears or is heard without permission on Zenoh",
    *_topic_rows("directly", OWN, _PEERS),
    *_topic_rows("through the router", zenoh_forger.through_the_router, _CLIENTS),
    _attempt_row(
        "unsecured talker to unsecured listener",
        RowStatus.HEARD,
        "by default, rmw_zenoh has no security",
        hears("unsecured listener", "unsecured talker"),
        (
            _router(None),
            Party("unsecured talker", Role.TALKER, turn=1),
            Party("unsecured listener", Role.LISTENER, turn=1),
        ),
    ),
    _attempt_row(
        "talker in the graph of another enclave",
        RowStatus.VISIBLE,
        "every node may see the graph, and the talker's token names the enclave of its certificate",
        Claim(Relation.SEES, "observer", "talker"),
        (*_topic_pair(), _permitted_party("observer", Role.OBSERVER, OWN, "client")),
        world=_PEERS,
    ),
)


def _unpermitted_service_row(
    name: str, role: Role, mechanism: str, party: str, server: str, client: str
) -> Row:
    """Return a row in which an enclave calls or serves a service without the right to do so."""
    intruder = _attacker(party, role, OWN, ignores_rules=False)
    calls = role in (Role.CLIENT, Role.ACTION_CLIENT)
    on_service = role in (Role.CLIENT, Role.SERVER)
    return _attempt_row(
        name,
        RowStatus.NOT_EXECUTED if calls else RowStatus.NOT_ANSWERED,
        f"{mechanism}: no rule allows it",
        _execution_claim(server, party) if calls else answered(client, party),
        (*(_service_pair() if on_service else _action_pair()), intruder),
        _CALLS if on_service else _GOALS,
        world=_PEERS,
    )


_SERVICES = _scenario(
    "services",
    "who may call and who may serve services and actions on Zenoh",
    _attempt_row(
        "client of a service",
        RowStatus.ANSWERED,
        "the client may send requests and receive replies, the server the reverse",
        answered("client", "server"),
        _service_pair(),
        world=_PEERS,
    ),
    _unpermitted_service_row(
        "client without permission",
        Role.CLIENT,
        "the request is dropped before it reaches the server",
        "client without permission",
        "server",
        "client",
    ),
    _unpermitted_service_row(
        "enclave that poses as the server",
        Role.SERVER,
        "nobody receives its announcement of the service",
        "posing server",
        "server",
        "client",
    ),
    _attempt_row(
        "client of an action",
        RowStatus.ANSWERED,
        "goal, feedback, status and result arrive, over three services and two topics",
        answered("action client", "action server"),
        _action_pair(),
        world=_PEERS,
    ),
    _unpermitted_service_row(
        "action client without permission",
        Role.ACTION_CLIENT,
        "the goal is dropped before it reaches the server",
        "action client without permission",
        "action server",
        "action client",
    ),
    _unpermitted_service_row(
        "enclave that poses as the action server",
        Role.ACTION_SERVER,
        "nobody receives its announcement of the action",
        "posing action server",
        "action server",
        "action client",
    ),
)


# ── attacks on the wire ────────────────────────────────────────────────────────────────────


def _wiretap_rows(attack: str, wire: Wire, *, readable: bool) -> tuple[Row, ...]:
    hidden = "TLS encrypts each link: only the endpoints of a link have its keys"
    row = Row(
        f"{attack}, without TLS" if readable else attack,
        RowStatus.READABLE if readable else RowStatus.NOT_READABLE,
        "TCP encrypts nothing" if readable else hidden,
        _topic_pair(zenoh_forger.links_in_the_clear if readable else OWN),
        (Claim(Relation.READABLE, "talker", holds=readable, wire=wire),),
        _CHATTER,
        wire=True,
        brief=True,
        world="tapped, open" if readable else "tapped",
        defence_removed="TLS" if readable else "",
    )
    return tries(attack, row)


_WIRE_ROWS = tuple(
    row
    for readable in (False, True)
    for attack, wire in (
        ("payload read on the wire", Wire.TEXT),
        ("topic names read on the wire", Wire.TOPIC),
    )
    for row in _wiretap_rows(attack, wire, readable=readable)
)

_LARGE_BYTES = 64 * 1024


def _shared_memory_row(name: str, keystore: KeystoreChoice, *, readable: bool) -> Row:
    wide, talker, listener = _topic_pair(keystore)
    return Row(
        name,
        RowStatus.READABLE if readable else RowStatus.NOT_READABLE,
        "large messages lie unencrypted in shared memory"
        if readable
        else "the Zenoh files switch shared memory off, so large messages also go through TLS",
        (wide, replace(talker, size=_LARGE_BYTES), listener),
        (Claim(Relation.READABLE, "talker", holds=readable, wire=Wire.MEMORY),),
        _CHATTER,
        brief=True,
        defence_removed="switching shared memory off" if readable else "",
    )


_MEMORY_ROWS = tries(
    "large messages in shared memory",
    _shared_memory_row("large messages in shared memory", OWN, readable=False),
    _shared_memory_row(
        "large messages in shared memory, switched on",
        zenoh_forger.allow_shared_memory,
        readable=True,
    ),
)


# ── who gets a connection ──────────────────────────────────────────────────────────────────


def _refused_connection_row(
    name: str, keystore: KeystoreChoice, mechanism: str, evidence: str
) -> Row:
    """Return a row in which a process in the name of the talker gets no connection."""
    party = _attacker(f"talker with {name}", Role.TALKER, keystore, "talker")
    return _attempt_row(
        name,
        RowStatus.NOT_LET_IN,
        mechanism,
        hears("listener", party.name),
        (*_topic_pair(), party),
        _CHATTER,
        world=_PEERS,
        evidence=evidence,
    )


def _accepted_connection_row(name: str, keystore: KeystoreChoice, defence_removed: str) -> Row:
    """Return a row in which a process in the name of the talker is heard, without a defense."""
    wide, _, listener = _topic_pair(keystore)
    party = _attacker("attacker", Role.TALKER, keystore, "talker")
    return _attempt_row(
        name,
        RowStatus.HEARD,
        "the attacker gets a connection, and the rules let every name through",
        hears("listener", party.name),
        (wide, listener, party),
        defence_removed=defence_removed,
    )


_IN_DATE = _attacker("talker in date", Role.TALKER, zenoh_forger.valid_certificate, "talker")


def _valid_certificate_row(name: str, defence_removed: str) -> Row:
    return _attempt_row(
        name,
        RowStatus.HEARD,
        "an attacker with valid files is heard",
        hears("listener", _IN_DATE.name),
        (*_topic_pair(), _IN_DATE),
        world=_PEERS,
        defence_removed=defence_removed,
    )


_CONNECTION_ROWS = (
    *tries(
        "no certificate",
        _refused_connection_row(
            "no certificate",
            zenoh_forger.without_certificate,
            "router and sessions ask for a certificate of the keystore's identity CA",
            "peer sent no certificates",
        ),
        _accepted_connection_row(
            "no certificate, and none is asked for",
            zenoh_forger.certificates_not_asked_for,
            "mutual TLS and without rules that trust only known names",
        ),
    ),
    *tries(
        "a certificate of another CA",
        _refused_connection_row(
            "a certificate of another CA",
            zenoh_forger.identity_of_another_ca,
            "the certificate has the talker's name, but the identity CA has not signed it",
            "UnknownIssuer",
        ),
        _accepted_connection_row(
            "a certificate of another CA, which is trusted",
            zenoh_forger.both_cas_trusted,
            "the wrong CA",
        ),
    ),
    *tries(
        "TCP instead of TLS",
        _refused_connection_row(
            "TCP instead of TLS",
            zenoh_forger.plain_tcp,
            "the router listens only with TLS",
            "InvalidContentType",
        ),
        _accepted_connection_row(
            "TCP instead of TLS, with a router that also accepts TCP",
            zenoh_forger.tcp_next_to_tls,
            "the list of protocols and without rules that trust only known names",
        ),
    ),
    *tries(
        "identity out of date",
        _refused_connection_row(
            "an expired certificate",
            forger.expired_identity,
            "TLS checks the dates of the certificate",
            "certificate expired",
        ),
        _refused_connection_row(
            "a certificate that is not yet valid",
            forger.identity_not_yet_valid,
            "TLS checks the dates of the certificate",
            "certificate not valid yet",
        ),
        _valid_certificate_row("the same identity with the right dates", "the wrong dates"),
    ),
    *tries(
        "the key of another enclave",
        _refused_connection_row(
            "the key of another enclave",
            forger.key_of_another_enclave,
            "TLS needs the key that belongs to the certificate",
            "KeyMismatch",
        ),
        _valid_certificate_row("certificate with its own key", "the wrong key"),
    ),
)


def _expiring_certificate_row(name: str, keystore: KeystoreChoice, *, link_is_cut: bool) -> Row:
    steady = _permitted_party("steady talker", Role.TALKER, keystore, "admin")
    return Row(
        name,
        RowStatus.CUT_OFF if link_is_cut else RowStatus.STILL_HEARD,
        "router and sessions close a link when its certificate expires"
        if link_is_cut
        else "Zenoh looks at the dates of a certificate only when a link is opened",
        (*_topic_pair(keystore), steady),
        (Claim(Relation.HEARS_EXPIRED, "listener", "talker", holds=not link_is_cut),),
        (hears("listener", steady.name),),
        brief=True,
        short_lived=True,
        defence_removed="" if link_is_cut else "close_link_on_expiration",
    )


_EXPIRY_ROWS = tries(
    "certificate that expires during a link",
    _expiring_certificate_row(
        "certificate that expires during a link", zenoh_forger.short_lived, link_is_cut=True
    ),
    _expiring_certificate_row(
        "certificate that expires, the link stays",
        zenoh_forger.links_that_outlive_certificates,
        link_is_cut=False,
    ),
)


# ── enclaves without the right ─────────────────────────────────────────────────────────────


def _trespass_row(
    name: str,
    party: Party,
    expected: RowStatus,
    mechanism: str,
    keystore: KeystoreChoice,
    world: str,
    defence_removed: str = "",
) -> Row:
    """Return a row in which a party uses, or tries to use, the topic or the service.

    All parties have enclaves of ``keystore``.
    """
    claim = {
        Role.TALKER: hears("listener", party.name),
        Role.LISTENER: hears(party.name, "talker"),
        Role.CLIENT: _execution_claim("server", party.name),
        Role.SERVER: answered("client", party.name),
    }[party.role]
    on_service = party.role in (Role.CLIENT, Role.SERVER)
    other_parties = _service_pair(keystore) if on_service else _topic_pair(keystore)
    identity = replace(party.identity, keystore=keystore)
    return _attempt_row(
        name,
        expected,
        mechanism,
        claim,
        (*other_parties, replace(party, identity=identity)),
        _CALLS if on_service else _CHATTER,
        world=world,
        defence_removed=defence_removed,
    )


_ENTRIES: tuple[tuple[Party, str, RowStatus, RowStatus], ...] = (
    (
        _attacker("guest that talks", Role.TALKER, OWN),
        "publishes",
        RowStatus.NOT_HEARD,
        RowStatus.HEARD,
    ),
    (
        _attacker("guest that listens", Role.LISTENER, OWN),
        "listens",
        RowStatus.NOT_HEARD,
        RowStatus.HEARD,
    ),
    (
        _attacker("guest that calls", Role.CLIENT, OWN),
        "calls a service",
        RowStatus.NOT_EXECUTED,
        RowStatus.EXECUTED,
    ),
    (
        _attacker("guest that serves", Role.SERVER, OWN),
        "poses as a server",
        RowStatus.NOT_ANSWERED,
        RowStatus.ANSWERED,
    ),
)


def _rows_past_the_router(
    party: Party, attack: str, denied: RowStatus, done: RowStatus
) -> list[Row]:
    return [
        _trespass_row(
            attack,
            party,
            denied,
            "every session enforces the rights of all other enclaves, which it knows by their "
            "certificates",
            OWN,
            _PEERS,
        ),
        _trespass_row(
            f"{attack}, rules at the router only",
            party,
            done,
            "sessions of a host connect to each other: the router does not see their messages",
            zenoh_forger.rules_at_the_router_only,
            "rules at the router",
            "the rules in the sessions",
        ),
    ]


def _rows_through_the_router(
    party: Party, attack: str, denied: RowStatus, done: RowStatus
) -> list[Row]:
    return [
        _trespass_row(
            attack,
            party,
            denied,
            "the router enforces the rights of all enclaves, whatever the attacker's own session "
            "does",
            zenoh_forger.through_the_router,
            _CLIENTS,
        ),
        _trespass_row(
            f"{attack}, sessions that limit themselves",
            party,
            done,
            "a process that does not enforce its own rules is not limited by them",
            zenoh_forger.sessions_that_limit_themselves,
            "limited by themselves",
            "rules that other processes enforce",
        ),
    ]


def _trespass_rows() -> tuple[Row, ...]:
    """Return the trespass rows: with and without a router in between, and without the defense."""
    rows: list[Row] = []
    for way, rows_of in (
        ("past the router", _rows_past_the_router),
        ("through the router", _rows_through_the_router),
    ):
        for party, act, denied, done in _ENTRIES:
            attack = f"another enclave {act} {way}"
            rows += tries(attack, *rows_of(party, attack, denied, done))
    for party, act, _, done in _ENTRIES[:2]:
        rows += tries(
            f"another enclave {act} past the router",
            _trespass_row(
                f"an enclave that was given the topic {act}",
                party,
                done,
                "the rules allow it",
                zenoh_forger.guest_may_use_the_topic,
                "rule added",
                "least privilege",
            ),
        )
    return tuple(rows)


# ── a router of another enclave ────────────────────────────────────────────────────────────


def _rogue_router_row(
    name: str,
    keystore: KeystoreChoice,
    world: str,
    *,
    router_reads: bool,
    defence_removed: str = "",
    part: str = "guest",
) -> Row:
    """Return a row in which a talker and a listener are connected to a router that attacks.

    The attack succeeds without the defense, or with the router's enclave.
    """
    rogue = Party("attacking router", Role.RELAY, Identity(keystore, part), intruder=True)
    succeeds = bool(defence_removed) or part == "router"
    return _attempt_row(
        name,
        RowStatus.HEARD if succeeds else RowStatus.NOT_HEARD,
        "sessions trust this router"
        if succeeds
        else "a session exchanges data only with a router whose certificate has the router's name",
        hears(rogue.name, "talker") if router_reads else hears("listener", rogue.name),
        (rogue, *_topic_pair(keystore)[1:]),
        () if part == "router" else _CHATTER,
        world=world,
        defence_removed=defence_removed,
    )


_ROUTER_ROWS = tuple(
    row
    for suffix, keystore, world, defence_removed in (
        ("", zenoh_forger.another_router, "rogue router", ""),
        (
            ", trusted under any name",
            zenoh_forger.subject_for_everybody,
            "believed router",
            "rules that trust only the router's name",
        ),
    )
    for reads, attack in (
        (False, "another enclave plays the router and injects"),
        (True, "another enclave plays the router and reads"),
    )
    for row in tries(
        attack,
        _rogue_router_row(
            f"{attack}{suffix}",
            keystore,
            world,
            router_reads=reads,
            defence_removed=defence_removed,
        ),
    )
)


# ── the router of another host ─────────────────────────────────────────────────────────────


def _far_and_near_router(keystore: KeystoreChoice) -> tuple[Party, Party]:
    """Return two routers; listener and admin connect to the far router, which starts first."""
    far = Identity(keystore, zenoh_forger.FAR_ROUTER)
    return Party("far router", Role.ROUTER, far), replace(_router(keystore), turn=1)


def _far_pair(keystore: KeystoreChoice) -> tuple[Party, ...]:
    """Return two routers, a talker and a listener."""
    talker, listener = talker_and_listener(keystore)
    return (*_far_and_near_router(keystore), replace(talker, turn=2), replace(listener, turn=2))


_NEAR = replace(
    _permitted_party(
        "near talker", Role.TALKER, zenoh_forger.far_router_without_the_topic, "admin"
    ),
    turn=2,
)
_NOT_CROSSING = (*_far_pair(zenoh_forger.far_router_without_the_topic), _NEAR)
_ROUTERS = _scenario(
    "routers",
    "what passes between the routers of two hosts on Zenoh",
    _attempt_row(
        "talker to listener at another router",
        RowStatus.HEARD,
        "both routers pass on a name if --cross allows it and both enclaves have rights to it",
        hears("listener", "talker"),
        _far_pair(zenoh_forger.far_router),
    ),
    _attempt_row(
        "talker to listener at the same router, --cross excludes the topic",
        RowStatus.HEARD,
        "--cross limits only what passes between routers",
        hears("listener", _NEAR.name),
        _NOT_CROSSING,
        world="not crossing",
    ),
    _attempt_row(
        "talker to listener at another router, --cross excludes the topic",
        RowStatus.NOT_HEARD,
        "a router passes on to another router only the names of --cross",
        hears("listener", "talker"),
        _NOT_CROSSING,
        (hears("listener", _NEAR.name),),
        world="not crossing",
    ),
)


def _rogue_far_router_row(name: str, keystore: KeystoreChoice, defence_removed: str = "") -> Row:
    """Return a row in which the guest connects to the talker's router as another router."""
    rogue = Party("attacking far router", Role.RELAY, Identity(keystore, "guest"), intruder=True)
    wide, talker, _ = _topic_pair(keystore)
    observer = _permitted_party("observer", Role.OBSERVER, keystore, "client")
    return _attempt_row(
        name,
        RowStatus.HEARD if defence_removed else RowStatus.NOT_HEARD,
        "the router accepts the attacker as another router"
        if defence_removed
        else "a router accepts a sender as another router only if the sender's certificate has a "
        "router's name",
        hears(rogue.name, "talker"),
        (rogue, replace(wide, turn=1), replace(talker, turn=2), replace(observer, turn=2)),
        (Claim(Relation.SEES, "observer", "talker"),),
        defence_removed=defence_removed,
    )


_PLAYS_FAR_ROUTER = "another enclave plays the router of another host"
_FAR_ROUTER_ROWS = tries(
    _PLAYS_FAR_ROUTER,
    _rogue_far_router_row(_PLAYS_FAR_ROUTER, zenoh_forger.another_far_router),
    _rogue_far_router_row(
        f"{_PLAYS_FAR_ROUTER}, trusted under any name",
        zenoh_forger.guest_as_far_router,
        "rules that trust only the router's name",
    ),
)


# ── wildcards and tokens ───────────────────────────────────────────────────────────────────

_WILDCARDS: tuple[tuple[Party, str, RowStatus, RowStatus], ...] = (
    (
        _attacker("wildcard talker", Role.TALKER, OWN, topic="/*"),
        "a put with a wildcard",
        RowStatus.NOT_HEARD,
        RowStatus.HEARD,
    ),
    (
        _attacker("wildcard listener", Role.LISTENER, OWN, topic="/**"),
        "a subscription with a wildcard",
        RowStatus.NOT_HEARD,
        RowStatus.HEARD,
    ),
    (
        _attacker("wildcard client", Role.CLIENT, OWN, topic="/**"),
        "a query with a wildcard",
        RowStatus.NOT_EXECUTED,
        RowStatus.EXECUTED,
    ),
)
_WILDCARD_ROWS = (
    *(
        row
        for party, attack, denied, _ in _WILDCARDS
        for row in tries(
            attack,
            _trespass_row(
                attack,
                party,
                denied,
                "Zenoh passes a wildcard only if a rule allows every name that the wildcard"
                " matches; sros lists the allowed names, and does not rely on deny rules",
                OWN,
                _PEERS,
            ),
        )
    ),
    *(
        row
        for party, attack, _, done in _WILDCARDS
        for row in tries(
            attack,
            _trespass_row(
                f"{attack}, denied inside a wildcard",
                party,
                done,
                "a deny rule for the name applies only to the name, not to a wider expression",
                zenoh_forger.denial_in_a_wildcard,
                "denial in a wildcard",
                "an exact list of the allowed names",
            ),
        )
    ),
)


class _FalseToken(NamedTuple):
    """A graph token with which the enclave of ``part`` announces more than it may.

    ``announced`` is the enclave that the token names ("": the enclave itself); ``role`` says
    whether ``topic`` is a topic or a service.
    """

    attack: str
    mechanism: str
    part: str
    topic: str
    announced: str = ""
    role: Role = Role.TALKER


_TOKENS = (
    _FalseToken(
        "spoofed graph token",
        "a token passes only if it names the enclave of its sender's certificate",
        "guest",
        "/spoofed",
        "talker",
    ),
    _FalseToken(
        "another enclave announces a topic",
        "a token passes only if its sender has a right to the name",
        "admin",
        "/not_its_own",
    ),
    _FalseToken(
        "another enclave poses as a node",
        "a token passes only if the policy of its sender names the node",
        "guest",
        "/rosout",
    ),
    _FalseToken(
        "another enclave announces a service",
        "a token passes only if its sender has a right to the name: `wait_for_service` finds"
        " nothing",
        "guest",
        "/not_offered",
        role=Role.SERVER,
    ),
)


def _false_token_row(
    token: _FalseToken,
    keystore: KeystoreChoice,
    world: str,
    name_suffix: str = "",
    defence_removed: str = "",
) -> Row:
    """Return a row in which an enclave announces a publisher to an observer of the graph."""
    impostor = replace(
        _attacker(f"impostor on {token.topic[1:]}", token.role, keystore, token.part, token.topic),
        announced=token.announced,
    )
    observer = _permitted_party("observer", Role.OBSERVER, keystore, "client")
    wide, talker, _ = _topic_pair(keystore)
    return _attempt_row(
        f"{token.attack}{name_suffix}",
        RowStatus.VISIBLE if defence_removed else RowStatus.NOT_VISIBLE,
        "nobody compares the names in a token with a policy"
        if defence_removed
        else token.mechanism,
        Claim(Relation.SEES, "observer", impostor.name),
        (wide, talker, observer, impostor),
        (Claim(Relation.SEES, "observer", "talker"),),
        world=world,
        defence_removed=defence_removed,
    )


def _false_token_rows(token: _FalseToken) -> tuple[Row, ...]:
    """Return the rows of a token: sent directly, through the router, and without the defense."""
    forgery, wide = zenoh_forger.tokens_of_any_name, "names"
    if token.announced:
        forgery, wide = zenoh_forger.tokens_of_any_enclave, "enclaves"
    return tries(
        token.attack,
        _false_token_row(token, OWN, _PEERS),
        _false_token_row(token, zenoh_forger.through_the_router, _CLIENTS, ", through the router"),
        _false_token_row(
            token,
            forgery,
            f"tokens of any {wide}",
            f", tokens of any {wide.removesuffix('s')}",
            f"rules that bind tokens to {wide}",
        ),
    )


_NAMES_OF_TOKENS = "rules that bind tokens to names"
_SERVICE_TOKEN = _TOKENS[-1]
_ERASING = "another enclave erases a node"


def _erased_token_row(
    name_suffix: str, keystore: KeystoreChoice, world: str, defence_removed: str = ""
) -> Row:
    """Return a row in which the guest takes the talker out of the graph of an observer."""
    wide, talker, _ = _topic_pair(keystore)
    eraser = _attacker("eraser", Role.ERASER, keystore)
    observer = _permitted_party("observer", Role.OBSERVER, keystore, "client")
    return _attempt_row(
        f"{_ERASING}{name_suffix}",
        RowStatus.ERASED if defence_removed else RowStatus.NOT_ERASED,
        "when a token ends, the graph removes the node with the same session and name, even if "
        "this node runs in another enclave"
        if defence_removed
        else "a token passes only if the policy of its sender names the node",
        Claim(Relation.LOSES, "observer", "eraser"),
        (wide, talker, observer, eraser),
        () if defence_removed else (Claim(Relation.SEES, "observer", "talker"),),
        world=world,
        defence_removed=defence_removed,
    )


_TOKEN_ROWS = (
    *(row for token in _TOKENS for row in _false_token_rows(token)),
    *tries(
        _SERVICE_TOKEN.attack,
        _false_token_row(
            _SERVICE_TOKEN,
            zenoh_forger.tokens_of_any_name_through_the_router,
            "names through the router",
            ", tokens of any name through the router",
            _NAMES_OF_TOKENS,
        ),
    ),
    *tries(
        _ERASING,
        _erased_token_row("", OWN, _PEERS),
        _erased_token_row(", through the router", zenoh_forger.through_the_router, _CLIENTS),
        _erased_token_row(
            ", tokens of any name", zenoh_forger.tokens_of_any_name, "erased", _NAMES_OF_TOKENS
        ),
        _erased_token_row(
            ", tokens of any name through the router",
            zenoh_forger.tokens_of_any_name_through_the_router,
            "erased through the router",
            _NAMES_OF_TOKENS,
        ),
    ),
)


# ── what was valid earlier ─────────────────────────────────────────────────────────────────


def _earlier_file_row(
    name: str, keystore: KeystoreChoice, expected: RowStatus, defence_removed: str = ""
) -> Row:
    guest = _attacker("guest with an earlier file", Role.TALKER, keystore, ignores_rules=False)
    return _attempt_row(
        name,
        expected,
        "only the session file of a process decides what this process may do"
        if defence_removed
        else "the files of the other enclaves decide what an enclave may do, "
        "not its own session file",
        hears("listener", guest.name),
        (*_topic_pair(keystore), guest),
        _CHATTER,
        defence_removed=defence_removed,
    )


def _stolen_files_row(
    name: str,
    keystore: KeystoreChoice,
    expected: RowStatus,
    mechanism: str,
    defence_removed: str = "",
) -> Row:
    wide, _, listener = _topic_pair(keystore)
    talker = _permitted_party("talker", Role.TALKER, keystore, "admin")
    thief = _attacker("thief", Role.TALKER, keystore, STOLEN)
    return _attempt_row(
        name,
        expected,
        mechanism,
        hears("listener", "thief"),
        (wide, talker, listener, thief),
        _CHATTER,
        defence_removed=defence_removed,
    )


_EARLIER_ROWS = (
    *tries(
        "session file of an earlier policy",
        _earlier_file_row(
            "session file of an earlier policy",
            zenoh_forger.earlier_session_file,
            RowStatus.NOT_HEARD,
        ),
        _earlier_file_row(
            "session file of an earlier policy, sessions that limit themselves",
            zenoh_forger.earlier_self_limiting_session_file,
            RowStatus.HEARD,
            "rules that other processes enforce",
        ),
    ),
    *tries(
        "revoked identity",
        _stolen_files_row(
            "revoked identity",
            zenoh_forger.revoked_talker,
            RowStatus.NOT_HEARD,
            "the enclave still gets a connection, but no rule has its name any more",
        ),
        _stolen_files_row(
            "revoked identity, the rules not written again",
            zenoh_forger.revoked_talker_in_the_rules,
            RowStatus.HEARD,
            "the name of the enclave is still in the rules",
            "the new rules",
        ),
    ),
)


# ── what is known to be open ───────────────────────────────────────────────────────────────


def _succeeding_attack(row: Row, because: str, remedy: str) -> Row:
    """Return the single row of an attack that is known to succeed."""
    return known_open(replace(row, attack=row.name), because, remedy)


_LATE = replace(_permitted_party("late talker", Role.TALKER, OWN, "admin"), intruder=True, turn=3)
_OPEN_ROWS = (
    _succeeding_attack(
        _stolen_files_row(
            "revoked identity whose name is used again",
            zenoh_forger.revoked_name_in_use_again,
            RowStatus.HEARD,
            "the rules know only the name, which the old certificate has, too",
        ),
        "Zenoh has no revocation list (zenoh#2749)",
        "give the enclave another name, or run `sros rotate_ca`; a short validity ends such an "
        "attack earlier",
    ),
    replace(
        _succeeding_attack(
            _attempt_row(
                "rights taken away from running nodes",
                RowStatus.HEARD,
                "Zenoh reads its configuration only at start",
                hears("listener", "talker"),
                _topic_pair(zenoh_forger.rights_to_take_away),
            ),
            "Zenoh reads the rules only at start (zenoh#2169)",
            "restart the processes that `sros` names after the change",
        ),
        meanwhile=zenoh_forger.rights_taken_away,
    ),
    *(
        _succeeding_attack(
            _rogue_router_row(
                f"the router itself {'reads' if reads else 'injects'}",
                zenoh_forger.talkative_router,
                "believed",
                router_reads=reads,
                part="router",
            ),
            "TLS ends at the router, and sessions trust what the router passes on",
            "run the router as a separate user, and let only that user read its key",
        )
        for reads in (False, True)
    ),
    _succeeding_attack(
        _attempt_row(
            "an enclave without rights lists topics",
            RowStatus.VISIBLE,
            "every node may ask for the graph of its domain",
            Claim(Relation.SEES, "guest that looks around", "talker"),
            (*_topic_pair(), _attacker("guest that looks around", Role.OBSERVER, OWN)),
            world=_PEERS,
        ),
        "a node of rmw_zenoh asks for the whole graph in one query: a node that is denied the "
        "query sees no names at all",
        "give an identity only to those who may see all names of the robot",
    ),
)


def _flood_row(name: str, keystore: KeystoreChoice, world: str, defence_removed: str = "") -> Row:
    """Return a row in which a talker connects while somebody makes useless connections."""
    late = replace(_LATE, identity=replace(_LATE.identity, keystore=keystore))
    return _attempt_row(
        name,
        RowStatus.NOT_LET_IN if defence_removed else RowStatus.HEARD,
        "after each failed handshake the router accepts nobody for a moment"
        if defence_removed
        else "the router has room for thousands of handshakes that do not end",
        hears("listener", late.name),
        (*_topic_pair(keystore), _attacker("flooder", Role.FLOODER, keystore), late),
        _CHATTER,
        world=world,
        evidence="InvalidContentType" if defence_removed else "",
        defence_removed=defence_removed,
    )


_FLOOD_ROWS = tries(
    "new connections during a flood of useless ones",
    _flood_row("new connections during a flood of useless ones", OWN, "flooded"),
    _flood_row(
        "new connections during a flood, room for few handshakes",
        zenoh_forger.room_for_few_handshakes,
        "flooded, few handshakes",
        "room for many handshakes",
    ),
)

ATTACKS = _scenario(
    "attacks",
    "attacks on Zenoh, also without the defenses that stop them",
    *_EXPIRY_ROWS,
    *_WIRE_ROWS,
    *_MEMORY_ROWS,
    *_CONNECTION_ROWS,
    *_trespass_rows(),
    *_ROUTER_ROWS,
    *_FAR_ROUTER_ROWS,
    *_WILDCARD_ROWS,
    *_TOKEN_ROWS,
    *_EARLIER_ROWS,
    *_FLOOD_ROWS,
    *_OPEN_ROWS,
)

ZENOH_SCENARIOS: tuple[Scenario, ...] = (_ISOLATION, _SERVICES, _ROUTERS, ATTACKS)
