"""Each finding about Zenoh configurations: what is changed in a sound one to bring it about."""

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


def all_of(*changes: Change) -> Change:
    def change(document: dict[str, Any]) -> None:
        for each in changes:
            each(document)

    return change


def rule(name: str, permission: str, key: str, *subjects: str) -> Change:
    """One more rule about puts, for some subjects."""

    def change(document: dict[str, Any]) -> None:
        control = document["access_control"]
        control["rules"].append(
            {"id": name, "permission": permission, "messages": ["put"], "key_exprs": [key]}
        )
        if subjects:
            control["policies"].append({"rules": [name], "subjects": list(subjects)})

    return change


def subject(name: str, **properties: list[str]) -> Change:
    def change(document: dict[str, Any]) -> None:
        document["access_control"]["subjects"].append({"id": name, **properties})

    return change


def of_everybody(document: dict[str, Any]) -> None:
    """Subjects without any name, as zenoh_security_tools writes them."""
    for each in document["access_control"]["subjects"]:
        del each["cert_common_names"]
        each["link_protocols"] = ["tls"]


NEVER_DENIED = "0/shutdown/*/*"
ALLOW = having("access_control.default_permission", "allow")
TLS = "transport.link.tls"

CASES: dict[str, Change] = {
    "zenoh.malformed": having("mode", "Client"),
    "zenoh.unread": having("listen", [["tls/localhost:0"]]),
    "zenoh.unknown-setting": having("acces_control", {}),
    "zenoh.router-without-rules": all_of(
        having("mode", "router"), having("access_control.enabled", False)
    ),
    "zenoh.session-without-rules": having("access_control.enabled", False),
    "zenoh.default-allow": ALLOW,
    "zenoh.nothing-allowed": having("access_control.policies", []),
    "zenoh.subject-of-everybody": all_of(subject("all"), rule("r", "allow", "a", "all")),
    "zenoh.self-limiting": of_everybody,
    "zenoh.deny-in-wildcard": all_of(
        rule("wide", "allow", "0/**", "/talker"), rule("no", "deny", NEVER_DENIED, "/talker")
    ),
    "zenoh.deny-overruled": all_of(
        subject("all", link_protocols=["tls"]),
        rule("exact", "allow", NEVER_DENIED, "all"),
        rule("no", "deny", NEVER_DENIED, "/talker"),
    ),
    "zenoh.overlapping-subjects": all_of(
        subject("tls", cert_common_names=["/talker"], link_protocols=["tls"]),
        rule("r", "allow", "a", "tls"),
    ),
    "zenoh.unused": rule("idle", "allow", "a"),
    "zenoh.plain-endpoint": all_of(
        having("transport.link.protocols", ["tls", "tcp"]),
        having("listen.endpoints", ["tcp/localhost:0"]),
    ),
    "zenoh.endpoint-refused": having("listen.endpoints", ["tcp/localhost:0"]),
    "zenoh.protocols-open": having("transport.link.protocols", None),
    "zenoh.no-mutual-tls": all_of(
        having("listen.endpoints", ["tls/localhost:0"]), having(f"{TLS}.enable_mtls", False)
    ),
    "zenoh.name-not-verified": all_of(subject("all"), rule("r", "allow", "a", "all")),
    "zenoh.expired-stays": having(f"{TLS}.close_link_on_expiration", False),
    "zenoh.shared-memory": having("transport.shared_memory.enabled", True),
    "zenoh.multicast": having("scouting.multicast", {}),
    "zenoh.admin-space": having("adminspace.enabled", True),
}

HARMLESS: dict[str, Change] = {
    "zenoh.no-mutual-tls": having(f"{TLS}.enable_mtls", False),  # it does not listen
    "zenoh.deny-in-wildcard": rule("no", "deny", "1/shutdown/*/*", "/talker"),
    "zenoh.deny-overruled": rule("no", "deny", "0/chatter/*/*", "/talker"),
    "zenoh.overlapping-subjects": all_of(
        subject("same", cert_common_names=["/talker", "/x"]), rule("r", "allow", "a", "same")
    ),
    "zenoh.name-not-verified": all_of(
        subject("all"),
        rule("r", "allow", "a", "all"),
        having("connect.endpoints", ["tls/localhost:1#verify_name_on_connect=true"]),
    ),
    "zenoh.admin-space": having(
        "adminspace", {"enabled": True, "permissions": {"read": False, "write": False}}
    ),
    "zenoh.expired-stays": having(
        "connect.endpoints", ["tls/localhost:1#close_link_on_expiration=true"]
    ),
    "zenoh.subject-of-everybody": all_of(
        subject("user", usernames=["tom"]), rule("r", "allow", "a", "user")
    ),
}
"""Configurations that come near to a finding, and do not have it."""
