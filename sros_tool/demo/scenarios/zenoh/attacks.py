"""The attacks on Zenoh, each with a control, and again without the defence that stops it."""

from __future__ import annotations

from dataclasses import replace

from sros_tool.demo import forger
from sros_tool.demo.forger import STOLEN
from sros_tool.demo.scenarios.model import (
    OWN,
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
)
from sros_tool.demo.scenarios.policies import zenoh_policy
from sros_tool.demo.scenarios.zenoh import forgeries
from sros_tool.demo.scenarios.zenoh.parties import (
    CAST,
    CLIENTS,
    PEERS,
    ROUTER,
    answered,
    attacker,
    attempt,
    executes,
    hears,
    rightful,
    service_pair,
    topic_pair,
)

_CHATTER = (hears("listener", "talker"),)
_CALLS = (answered("client", "server"),)
_WORLD = PEERS


# ── on the wire ────────────────────────────────────────────────────────────────────────────


def _tapped(name: str, keystore: KeystoreChoice, wire: Wire, *, readable: bool) -> Row:
    hidden = "TLS hides it: only the endpoints of a link have its keys"
    return Row(
        f"{name}, without TLS" if readable else name,
        RowStatus.READABLE if readable else RowStatus.NOT_READABLE,
        "TCP sends it as it is" if readable else hidden,
        topic_pair(keystore),
        (Claim(Relation.READABLE, "talker", holds=readable, wire=wire),),
        _CHATTER,
        wire=True,
        brief=True,
        world="tapped, open" if readable else "tapped",
        attack=name,
        removed="TLS" if readable else "",
    )


_WIRE_ROWS = tuple(
    _tapped(name, forgeries.in_the_clear if readable else OWN, wire, readable=readable)
    for readable in (False, True)
    for name, wire in (
        ("payload read on the wire", Wire.TEXT),
        ("topic names read on the wire", Wire.TOPIC),
    )
)

_LARGE = 64 * 1024


def _shared(name: str, keystore: KeystoreChoice, *, readable: bool) -> Row:
    wide, talker, listener = topic_pair(keystore)
    return Row(
        name,
        RowStatus.READABLE if readable else RowStatus.NOT_READABLE,
        "a large message lies in shared memory as it is"
        if readable
        else "the files switch shared memory off: TLS carries large messages, too",
        (wide, replace(talker, size=_LARGE), listener),
        (Claim(Relation.READABLE, "talker", holds=readable, wire=Wire.MEMORY),),
        _CHATTER,
        brief=True,
        attack="large messages in shared memory",
        removed="`shared_memory` off" if readable else "",
    )


_MEMORY_ROWS = (
    _shared("large messages in shared memory", OWN, readable=False),
    _shared(
        "large messages in shared memory, switched on", forgeries.in_shared_memory, readable=True
    ),
)


# ── who gets a connection ──────────────────────────────────────────────────────────────────


def _outsider(
    name: str, keystore: KeystoreChoice, mechanism: str, evidence: str, *, attack: str = ""
) -> Row:
    """Return a row in which a process in the name of the talker gets no connection."""
    party = attacker(f"talker with {name}", Role.TALKER, keystore, "talker")
    return attempt(
        name,
        RowStatus.NOT_LET_IN,
        mechanism,
        hears("listener", party.name),
        (*topic_pair(), party),
        _CHATTER,
        world=_WORLD,
        attack=attack or name,
        evidence=evidence,
    )


def _let_in(name: str, keystore: KeystoreChoice, attack: str, removed: str) -> Row:
    """Return a row in which the same process is heard, because a defence is missing."""
    wide, _, listener = topic_pair(keystore)
    party = attacker("attacker", Role.TALKER, keystore, "talker")
    return attempt(
        name,
        RowStatus.HEARD,
        "it gets a connection, and rules that are not for a name let it through",
        hears("listener", party.name),
        (wide, listener, party),
        attack=attack,
        removed=removed,
    )


_IN_DATE = attacker("talker in date", Role.TALKER, forgeries.in_date, "talker")
_OUT_OF_DATE = "identity out of date"


def _in_date(name: str, attack: str, removed: str) -> Row:
    return attempt(
        name,
        RowStatus.HEARD,
        "an attacker with valid files is heard",
        hears("listener", _IN_DATE.name),
        (*topic_pair(), _IN_DATE),
        world=_WORLD,
        attack=attack,
        removed=removed,
    )


_CONNECTION_ROWS = (
    _outsider(
        "no certificate",
        forgeries.without_certificate,
        "router and sessions ask for a certificate of the keystore's identity CA",
        "peer sent no certificates",
    ),
    _let_in(
        "no certificate, and none is asked for",
        forgeries.certificates_not_asked_for,
        "no certificate",
        "mutual TLS and named subjects",
    ),
    _outsider(
        "a certificate of another CA",
        forgeries.identity_of_another_ca,
        "it says the talker's name, but the identity CA has not signed it",
        "UnknownIssuer",
    ),
    _let_in(
        "a certificate of another CA, which is trusted",
        forgeries.both_cas_trusted,
        "a certificate of another CA",
        "a different CA",
    ),
    _outsider(
        "TCP instead of TLS",
        forgeries.plain_tcp,
        "the router listens with TLS alone",
        "InvalidContentType",
    ),
    _let_in(
        "TCP instead of TLS, which the router also accepts",
        forgeries.tcp_next_to_tls,
        "TCP instead of TLS",
        "the list of protocols and named subjects",
    ),
    _outsider(
        "an expired certificate",
        forger.expired_identity,
        "TLS checks the dates of the certificate",
        "certificate expired",
        attack=_OUT_OF_DATE,
    ),
    _outsider(
        "a certificate that is not yet valid",
        forger.identity_not_yet_valid,
        "TLS checks the dates of the certificate",
        "certificate not valid yet",
        attack=_OUT_OF_DATE,
    ),
    _in_date("the same identity in date", _OUT_OF_DATE, "the wrong dates"),
    _outsider(
        "the key of another enclave",
        forger.key_of_another_enclave,
        "TLS needs the key that belongs to the certificate",
        "KeyMismatch",
    ),
    _in_date("certificate with its own key", "the key of another enclave", "the wrong key"),
)


def _expiring(name: str, keystore: KeystoreChoice, *, cut: bool) -> Row:
    steady = rightful("steady talker", Role.TALKER, keystore, "admin")
    return Row(
        name,
        RowStatus.CUT_OFF if cut else RowStatus.STILL_HEARD,
        "router and sessions close a link when its certificate expires"
        if cut
        else "Zenoh looks at the dates of a certificate only when a link is opened",
        (*topic_pair(keystore), steady),
        (Claim(Relation.HEARS_EXPIRED, "listener", "talker", holds=not cut),),
        (hears("listener", steady.name),),
        brief=True,
        short_lived=True,
        attack="certificate that expires during a link",
        removed="" if cut else "close_link_on_expiration",
    )


_EXPIRY_ROWS = (
    _expiring("certificate that expires during a link", forgeries.short_lived, cut=True),
    _expiring(
        "certificate that expires, the link stays",
        forgeries.links_that_outlive_certificates,
        cut=False,
    ),
)


# ── enclaves without the right ─────────────────────────────────────────────────────────────

_TALKING = attacker("guest that talks", Role.TALKER, OWN)
_LISTENING = attacker("guest that listens", Role.LISTENER, OWN)
_CALLING = attacker("guest that calls", Role.CLIENT, OWN)
_SERVING = attacker("guest that serves", Role.SERVER, OWN)
_ON_SERVICE = frozenset({_CALLING.name, _SERVING.name})


def _trespass(
    name: str,
    who: Party,
    expected: RowStatus,
    mechanism: str,
    keystore: KeystoreChoice,
    world: str,
    attack: str,
    removed: str = "",
) -> Row:
    """Return a row in which a guest uses the topic or the service, or tries to."""
    claim = {
        _TALKING.name: hears("listener", who.name),
        _LISTENING.name: hears(who.name, "talker"),
        _CALLING.name: executes("server", who.name),
        _SERVING.name: answered("client", who.name),
    }[who.name]
    on_service = who.name in _ON_SERVICE
    others = service_pair(keystore) if on_service else topic_pair(keystore)
    identity = replace(who.identity, keystore=keystore)
    return attempt(
        name,
        expected,
        mechanism,
        claim,
        (*others, replace(who, identity=identity)),
        _CALLS if on_service else _CHATTER,
        world=world,
        attack=attack,
        removed=removed,
    )


_ENTRIES: tuple[tuple[Party, str, RowStatus, RowStatus], ...] = (
    (_TALKING, "publishes", RowStatus.NOT_HEARD, RowStatus.HEARD),
    (_LISTENING, "listens", RowStatus.NOT_HEARD, RowStatus.HEARD),
    (_CALLING, "calls a service", RowStatus.NOT_EXECUTED, RowStatus.EXECUTED),
    (_SERVING, "poses as a server", RowStatus.NOT_ANSWERED, RowStatus.ANSWERED),
)


def _trespasses() -> tuple[Row, ...]:
    """Return the rows past the router, and through it, with and without the defence."""
    rows: list[Row] = []
    for who, does, denied, done in _ENTRIES:
        attack = f"another enclave {does} past the router"
        rows += [
            _trespass(
                attack,
                who,
                denied,
                "every session enforces the rights of all others, by their certificates",
                OWN,
                _WORLD,
                attack,
            ),
            _trespass(
                f"{attack}, rules at the router only",
                who,
                done,
                "sessions of a host connect to each other: the router sees nothing of it",
                forgeries.rules_at_the_router_only,
                "rules at the router",
                attack,
                "the rules in the sessions",
            ),
        ]
    for who, does, denied, done in _ENTRIES:
        attack = f"another enclave {does} through the router"
        rows += [
            _trespass(
                attack,
                who,
                denied,
                "the router enforces everybody's rights, whatever the attacker's own session does",
                forgeries.through_the_router,
                CLIENTS,
                attack,
            ),
            _trespass(
                f"{attack}, sessions that limit themselves",
                who,
                done,
                "a process that does not enforce its own rules is not limited by them",
                forgeries.sessions_that_limit_themselves,
                "limited by themselves",
                attack,
                "rules that others enforce",
            ),
        ]
    rows += [
        _trespass(
            f"an enclave that was given the topic {does}",
            who,
            done,
            "the rules allow it",
            forgeries.guest_may_use_the_topic,
            "rule added",
            f"another enclave {does} past the router",
            "the missing rule",
        )
        for who, does, _, done in _ENTRIES[:2]
    ]
    return tuple(rows)


# ── a router of another enclave ────────────────────────────────────────────────────────────


def _rogue(
    name: str,
    keystore: KeystoreChoice,
    world: str,
    *,
    reads: bool,
    succeeds: bool,
    part: str = "guest",
) -> Row:
    """Return a row in which a talker and a listener are connected to a router that attacks."""
    rogue = Party("attacking router", Role.RELAY, Identity(keystore, part), intruder=True)
    talker, listener = topic_pair(keystore)[1:]
    direct = keystore is not forgeries.talkative_router
    return attempt(
        name,
        RowStatus.HEARD if succeeds else RowStatus.NOT_HEARD,
        "sessions believe this router"
        if succeeds
        else "a session believes only the router's name, and nobody else what passes the router",
        hears(rogue.name, "talker") if reads else hears("listener", rogue.name),
        (rogue, talker, listener),
        _CHATTER if direct else (),
        world=world,
        attack=f"another enclave plays the router and {'reads' if reads else 'injects'}",
        removed="a named subject for the router" if succeeds else "",
    )


_ROUTER_ROWS = tuple(
    _rogue(
        f"another enclave plays the router and {'reads' if reads else 'injects'}{suffix}",
        keystore,
        world,
        reads=reads,
        succeeds=bool(suffix),
    )
    for suffix, keystore, world in (
        ("", forgeries.another_router, "rogue router"),
        (", a subject for everybody", forgeries.subject_for_everybody, "believed router"),
    )
    for reads in (False, True)
)


# ── wildcards and tokens ───────────────────────────────────────────────────────────────────

_WILDCARDS: tuple[tuple[Party, str, RowStatus, RowStatus], ...] = (
    (
        attacker("wildcard talker", Role.TALKER, OWN, topic="/*"),
        "a put with a wildcard",
        RowStatus.NOT_HEARD,
        RowStatus.HEARD,
    ),
    (
        attacker("wildcard listener", Role.LISTENER, OWN, topic="/**"),
        "a subscription with a wildcard",
        RowStatus.NOT_HEARD,
        RowStatus.HEARD,
    ),
    (
        attacker("wildcard client", Role.CLIENT, OWN, topic="/**"),
        "a query with a wildcard",
        RowStatus.NOT_EXECUTED,
        RowStatus.EXECUTED,
    ),
)


def _wildcards() -> tuple[Row, ...]:
    rows = []
    for keystore, world, removed in (
        (OWN, _WORLD, ""),
        (forgeries.denial_in_a_wildcard, "denial in a wildcard", "exact permission"),
    ):
        for who, what, denied, done in _WILDCARDS:
            party = replace(who, identity=replace(who.identity, keystore=keystore))
            claim = {
                Role.TALKER: hears("listener", who.name),
                Role.LISTENER: hears(who.name, "talker"),
                Role.CLIENT: executes("server", who.name),
            }[who.role]
            on_service = who.role is Role.CLIENT
            others = service_pair(keystore) if on_service else topic_pair(keystore)
            rows.append(
                attempt(
                    f"{what}, denied inside a wildcard" if removed else what,
                    done if removed else denied,
                    "a denial of the name holds only for the name, not for a wider expression"
                    if removed
                    else "a rule applies only to what it includes as a whole, and sros writes no"
                    " denials inside wildcards",
                    claim,
                    (*others, party),
                    _CALLS if on_service else _CHATTER,
                    world=world,
                    attack=what,
                    removed=removed,
                )
            )
    return tuple(rows)


def _spoofing(name: str, keystore: KeystoreChoice, world: str, removed: str = "") -> Row:
    impostor = attacker("impostor", Role.TALKER, keystore, topic="/spoofed")
    observer = rightful("observer", Role.OBSERVER, keystore, "client")
    wide, talker, _ = topic_pair(keystore)
    return attempt(
        name,
        RowStatus.VISIBLE if removed else RowStatus.NOT_VISIBLE,
        "anybody may announce nodes under any name"
        if removed
        else "a token passes only with the enclave of its sender's certificate",
        Claim(Relation.SEES, "observer", "impostor"),
        (wide, talker, observer, replace(impostor, announced="talker")),
        (Claim(Relation.SEES, "observer", "talker"),),
        world=world,
        attack="spoofed graph token",
        removed=removed,
    )


_TOKEN_ROWS = (
    _spoofing("spoofed graph token", OWN, _WORLD),
    _spoofing(
        "spoofed graph token, tokens of any enclave",
        forgeries.tokens_of_any_enclave,
        "",
        "rules that bind tokens to enclaves",
    ),
)


# ── what was valid earlier ─────────────────────────────────────────────────────────────────


def _earlier(name: str, keystore: KeystoreChoice, expected: RowStatus, removed: str = "") -> Row:
    guest = attacker("guest with an earlier file", Role.TALKER, keystore, lawless=False)
    return attempt(
        name,
        expected,
        "a session file limits only others: what this enclave may do, they decide"
        if not removed
        else "the file decides what its own process may do, and nobody else does",
        hears("listener", guest.name),
        (*topic_pair(keystore), guest),
        _CHATTER,
        attack="session file of an earlier policy",
        removed=removed,
    )


def _thief(
    name: str,
    keystore: KeystoreChoice,
    expected: RowStatus,
    mechanism: str,
    *,
    attack: str = "revoked identity",
    removed: str = "",
) -> Row:
    wide, _, listener = topic_pair(keystore)
    talker = rightful("talker", Role.TALKER, keystore, "admin")
    thief = attacker("thief", Role.TALKER, keystore, STOLEN)
    return attempt(
        name,
        expected,
        mechanism,
        hears("listener", "thief"),
        (wide, talker, listener, thief),
        _CHATTER,
        attack=attack,
        removed=removed,
    )


_EARLIER_ROWS = (
    _earlier(
        "session file of an earlier policy",
        forgeries.earlier_session_file,
        RowStatus.NOT_HEARD,
    ),
    _earlier(
        "session file of an earlier policy, sessions that limit themselves",
        forgeries.earlier_session_file_of_one_that_limits_itself,
        RowStatus.HEARD,
        "rules that others enforce",
    ),
    _thief(
        "revoked identity",
        forgeries.revoked_talker,
        RowStatus.NOT_HEARD,
        "it still gets a connection, but its name is in no rule any more",
    ),
    _thief(
        "revoked identity, the rules not written again",
        forgeries.revoked_talker_in_the_rules,
        RowStatus.HEARD,
        "its name is still in the rules",
        removed="the new rules",
    ),
)


# ── what is known to be open ───────────────────────────────────────────────────────────────

_OPEN_ROWS = (
    replace(
        _thief(
            "revoked identity whose name is used again",
            forgeries.revoked_name_in_use_again,
            RowStatus.HEARD,
            "the rules know the name alone, and the old certificate has it, too",
            attack="revoked identity whose name is used again",
        ),
        open_because="Zenoh has no revocation list (zenoh#2749)",
        remedy="give the enclave another name, or `sros rotate_ca`; short validity",
    ),
    replace(
        attempt(
            "rights taken away while all run",
            RowStatus.HEARD,
            "Zenoh reads its configuration at start",
            hears("listener", "talker"),
            topic_pair(forgeries.rights_to_take_away),
            attack="rights taken away while all run",
        ),
        meanwhile=forgeries.rights_taken_away,
        open_because="Zenoh reads the rules only at start (zenoh#2169)",
        remedy="restart the processes that `sros` names after the change",
    ),
    *(
        replace(
            _rogue(
                f"the router itself {'reads' if reads else 'injects'}",
                forgeries.talkative_router,
                "believed",
                reads=reads,
                succeeds=True,
                part="router",
            ),
            attack=f"the router itself {'reads' if reads else 'injects'}",
            removed="",
            open_because="TLS ends at the router, and sessions believe what it passes on",
            remedy="run the router as a user of its own, with its key readable to it alone",
        )
        for reads in (False, True)
    ),
    replace(
        attempt(
            "an enclave without rights lists topics",
            RowStatus.VISIBLE,
            "every node may ask for the graph of its domain",
            Claim(Relation.SEES, "guest that looks around", "talker"),
            (*topic_pair(), attacker("guest that looks around", Role.OBSERVER, OWN)),
            world=_WORLD,
            attack="an enclave without rights lists topics",
        ),
        open_because="a node of rmw_zenoh needs the whole graph, or it sees nothing",
        remedy="give an identity only to those who may see all names of the robot",
    ),
)

_FLOODED = "new connections during a flood of useless ones"
_LATE = replace(rightful("late talker", Role.TALKER, OWN, "admin"), intruder=True, turn=3)
_FLOOD_ROWS = (
    replace(
        attempt(
            _FLOODED,
            RowStatus.NOT_LET_IN,
            "after each failed handshake the router accepts nobody for a moment",
            hears("listener", _LATE.name),
            (*topic_pair(), attacker("flooder", Role.FLOODER, OWN), _LATE),
            _CHATTER,
            attack=_FLOODED,
            evidence="InvalidContentType",
        ),
        open_because="anybody who reaches the port keeps others out; open links go on",
        remedy="let the router listen on localhost, or limit connections with a firewall",
    ),
)

_ROWS: tuple[Row, ...] = (
    *_EXPIRY_ROWS,
    *_WIRE_ROWS,
    *_MEMORY_ROWS,
    *_CONNECTION_ROWS,
    *_trespasses(),
    *_ROUTER_ROWS,
    *_wildcards(),
    *_TOKEN_ROWS,
    *_EARLIER_ROWS,
    *_OPEN_ROWS,
    *_FLOOD_ROWS,
)

ATTACKS = Scenario(
    "attacks",
    "attacks on Zenoh, also without the defences that stop them",
    _ROWS,
    CAST,
    zenoh_policy,
    router=ROUTER,
)
