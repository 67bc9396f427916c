"""The parties of the scenarios on Zenoh, and the worlds in which several rows share them.

Every world has a router.  Attackers are lawless: their process does not enforce its own rules, so
that only the rules of others stop them.
"""

from __future__ import annotations

from dataclasses import replace

from sros_tool.demo.scenarios.model import (
    OWN,
    UNSECURED,
    Claim,
    Identity,
    KeystoreChoice,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
)
from sros_tool.demo.scenarios.policies import ACTION, SERVICE

ROUTER = "/router"
PEERS, CLIENTS = "peers", "clients"
"""The worlds with all defences: sessions connect to each other, or to the router alone."""
CAST = {
    "talker": "/talker_listener/talker",
    "listener": "/talker_listener/listener",
    "guest": "/talker_listener/guest",
    "admin": "/talker_listener/guest/admin",
    "server": f"{SERVICE}/server",
    "client": f"{SERVICE}/client",
    "action server": f"{ACTION}/server",
    "action client": f"{ACTION}/client",
    "router": ROUTER,
}
_TOPIC_OF = {
    Role.SERVER: SERVICE,
    Role.CLIENT: SERVICE,
    Role.ACTION_SERVER: ACTION,
    Role.ACTION_CLIENT: ACTION,
}


def router(keystore: KeystoreChoice | None) -> Party:
    """Return the router of a world, unsecured without a keystore."""
    identity = UNSECURED if keystore is None else Identity(keystore, "router")
    return Party("router", Role.ROUTER, identity)


def rightful(name: str, role: Role, keystore: KeystoreChoice, part: str = "") -> Party:
    """Return a party that does what its enclave may do; ``part`` is its name by default."""
    return Party(name, role, Identity(keystore, part or name), _TOPIC_OF.get(role, ""), turn=1)


def attacker(
    name: str,
    role: Role,
    keystore: KeystoreChoice,
    part: str = "guest",
    topic: str = "",
    *,
    lawless: bool = True,
) -> Party:
    """Return an attacker in an enclave that has not the right, or with files that are not valid."""
    identity = Identity(keystore, part, lawless=lawless)
    return Party(name, role, identity, topic or _TOPIC_OF.get(role, ""), intruder=True, turn=2)


def attempt(
    name: str,
    expected: RowStatus,
    mechanism: str,
    claim: Claim,
    parties: tuple[Party, ...],
    controls: tuple[Claim, ...] = (),
    *,
    world: str = "",
    attack: str = "",
    removed: str = "",
    evidence: str = "",
) -> Row:
    """Return a brief row with one claim, expected as ``expected``."""
    return Row(
        name,
        expected,
        mechanism,
        parties,
        (replace(claim.expecting(expected), evidence=evidence),),
        controls,
        brief=True,
        world=world,
        attack=attack,
        removed=removed,
    )


def hears(listener: str, talker: str) -> Claim:
    """Return the claim that a listener hears a talker."""
    return Claim(Relation.HEARS, listener, talker)


def executes(server: str, client: str) -> Claim:
    """Return the claim that a server executes a call of a client."""
    return Claim(Relation.EXECUTES, server, client)


def answered(client: str, server: str) -> Claim:
    """Return the claim that a client is answered by a server."""
    return Claim(Relation.IS_ANSWERED, client, server)


def topic_pair(keystore: KeystoreChoice = OWN) -> tuple[Party, ...]:
    """Return router, talker and listener."""
    talker = rightful("talker", Role.TALKER, keystore)
    listener = rightful("listener", Role.LISTENER, keystore)
    return router(keystore), talker, listener


def service_pair(keystore: KeystoreChoice = OWN) -> tuple[Party, ...]:
    """Return router, server and client."""
    server = rightful("server", Role.SERVER, keystore)
    client = rightful("client", Role.CLIENT, keystore)
    return router(keystore), server, client


def action_pair(keystore: KeystoreChoice = OWN) -> tuple[Party, ...]:
    """Return router, action server and action client."""
    server = rightful("action server", Role.ACTION_SERVER, keystore)
    client = rightful("action client", Role.ACTION_CLIENT, keystore)
    return router(keystore), server, client
