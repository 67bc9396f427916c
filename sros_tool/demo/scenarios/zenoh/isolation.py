"""The scenarios `isolation` and `services` on Zenoh: who hears, who calls, and who serves."""

from __future__ import annotations

from sros_tool.demo.scenarios.model import (
    OWN,
    UNSECURED,
    Claim,
    KeystoreChoice,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
)
from sros_tool.demo.scenarios.policies import zenoh_policy
from sros_tool.demo.scenarios.zenoh.forgeries import through_the_router
from sros_tool.demo.scenarios.zenoh.parties import (
    CAST,
    CLIENTS,
    PEERS,
    ROUTER,
    action_pair,
    answered,
    attacker,
    attempt,
    executes,
    hears,
    rightful,
    router,
    service_pair,
    topic_pair,
)

_CHATTER = (hears("listener", "talker"),)
_DENIED = "no rule allows it, and what no rule allows is dropped"
_OPEN_PAIR = (
    router(None),
    Party("unsecured talker", Role.TALKER, UNSECURED, turn=1),
    Party("unsecured listener", Role.LISTENER, UNSECURED, turn=1),
)


def _topic_rows(how: str, keystore: KeystoreChoice, world: str) -> tuple[Row, ...]:
    """Return the rows of one way in which sessions connect."""
    pair = topic_pair(keystore)
    talker = attacker("talker without permission", Role.TALKER, keystore, lawless=False)
    listener = attacker("listener without permission", Role.LISTENER, keystore, lawless=False)
    return (
        attempt(
            f"talker to listener, {how}",
            RowStatus.HEARD,
            "the rules allow the topic to both, by the names in their certificates",
            hears("listener", "talker"),
            pair,
            world=world,
        ),
        attempt(
            f"talker without permission, {how}",
            RowStatus.NOT_HEARD,
            _DENIED,
            hears("listener", talker.name),
            (*pair, talker),
            _CHATTER,
            world=world,
        ),
        attempt(
            f"listener without permission, {how}",
            RowStatus.NOT_HEARD,
            _DENIED,
            hears(listener.name, "talker"),
            (*pair, listener),
            _CHATTER,
            world=world,
        ),
    )


_ROWS: tuple[Row, ...] = (
    *_topic_rows("directly", OWN, PEERS),
    *_topic_rows("through the router", through_the_router, CLIENTS),
    attempt(
        "unsecured talker to unsecured listener",
        RowStatus.HEARD,
        "no security: what rmw_zenoh does by itself",
        hears("unsecured listener", "unsecured talker"),
        _OPEN_PAIR,
    ),
    attempt(
        "talker in the graph of another enclave",
        RowStatus.VISIBLE,
        "every node needs the graph, and its token names the enclave of its certificate",
        Claim(Relation.SEES, "observer", "talker"),
        (*topic_pair(), rightful("observer", Role.OBSERVER, OWN, "client")),
        world=PEERS,
    ),
)

ISOLATION = Scenario(
    "isolation",
    "nobody hears or is heard without permission on Zenoh",
    _ROWS,
    CAST,
    zenoh_policy,
    router=ROUTER,
)

_POSING_SERVER = attacker("posing server", Role.SERVER, OWN, lawless=False)
_UNASKED_CLIENT = attacker("client without permission", Role.CLIENT, OWN, lawless=False)
_POSING_ACTION_SERVER = attacker("posing action server", Role.ACTION_SERVER, OWN, lawless=False)
_UNASKED_ACTION_CLIENT = attacker(
    "action client without permission", Role.ACTION_CLIENT, OWN, lawless=False
)
_CALLS = (answered("client", "server"),)
_GOALS = (answered("action client", "action server"),)

_SERVICE_ROWS: tuple[Row, ...] = (
    attempt(
        "client of a service",
        RowStatus.ANSWERED,
        "the client may send requests and receive replies, the server the reverse",
        answered("client", "server"),
        service_pair(),
        world=PEERS,
    ),
    attempt(
        "client without permission",
        RowStatus.NOT_EXECUTED,
        "the request is dropped before the server: no rule allows it",
        executes("server", _UNASKED_CLIENT.name),
        (*service_pair(), _UNASKED_CLIENT),
        _CALLS,
        world=PEERS,
    ),
    attempt(
        "enclave that poses as the server",
        RowStatus.NOT_ANSWERED,
        "nobody hears that it offers the service: no rule allows it",
        answered("client", _POSING_SERVER.name),
        (*service_pair(), _POSING_SERVER),
        _CALLS,
        world=PEERS,
    ),
    attempt(
        "client of an action",
        RowStatus.ANSWERED,
        "goal, feedback, status and result arrive: three services and two topics",
        answered("action client", "action server"),
        action_pair(),
        world=PEERS,
    ),
    attempt(
        "action client without permission",
        RowStatus.NOT_EXECUTED,
        "the goal is dropped before the server: no rule allows it",
        executes("action server", _UNASKED_ACTION_CLIENT.name),
        (*action_pair(), _UNASKED_ACTION_CLIENT),
        _GOALS,
        world=PEERS,
    ),
    attempt(
        "enclave that poses as the action server",
        RowStatus.NOT_ANSWERED,
        "nobody hears that it offers the action: no rule allows it",
        answered("action client", _POSING_ACTION_SERVER.name),
        (*action_pair(), _POSING_ACTION_SERVER),
        _GOALS,
        world=PEERS,
    ),
)

SERVICES = Scenario(
    "services",
    "who may call and who may serve services and actions on Zenoh",
    _SERVICE_ROWS,
    CAST,
    zenoh_policy,
    router=ROUTER,
)
