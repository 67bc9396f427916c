"""Each finding about configurations of Zenoh: what is changed in a sound one to bring it about."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from sros_tool.zenoh.access import AccessControl, AccessRule, Flow, Message, RemoteRights
from sros_tool.zenoh.configuration import Configuration, Mode

Change = Callable[[dict[str, Any]], None]

_KEYS = ("0/chatter/*/*",)
_REMOTES = (
    RemoteRights("/router", (AccessRule(Flow.INGRESS, (Message.PUT,), _KEYS),)),
    RemoteRights("/talker", (AccessRule(Flow.INGRESS, (Message.PUT,), _KEYS),)),
)


def sound(mode: Mode = Mode.CLIENT) -> dict[str, Any]:
    """A configuration as sros writes it."""
    listen = ("tls/localhost:7447",) if mode is Mode.ROUTER else ()
    connect = () if mode is Mode.ROUTER else ("tls/localhost:7447",)
    written = Configuration(mode, listen, connect, AccessControl(_REMOTES))
    found: dict[str, Any] = json.loads(written.render())
    return found


def having(path: str, value: Any) -> Change:
    """A setting, by its path with dots, that has a value."""

    def change(document: dict[str, Any]) -> None:
        *parents, last = path.split(".")
        for each in parents:
            document = document[int(each)] if isinstance(document, list) else document[each]
        document[last] = value

    return change


CASES: dict[str, Change] = {
    "zenoh.malformed": having("mode", "Client"),
    "zenoh.no-access-control": having("access_control.enabled", False),
}
