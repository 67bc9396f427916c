"""Zenoh configurations of single processes in the form for rmw_zenoh, without paths and keys.

`ZenohNetwork` has the settings for all processes of a keystore.

A configuration file replaces the whole default configuration of rmw_zenoh.  So the file repeats
values that ROS needs, if they differ from Zenoh's defaults
(rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_*_CONFIG.json5).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from fnmatch import fnmatchcase
from functools import lru_cache
from hashlib import sha256
from itertools import combinations
from json.encoder import encode_basestring_ascii
from typing import Any, NamedTuple

from sros_tool.errors import DocumentError, UsageError
from sros_tool.zenoh.access import AccessControl, AccessRule, Flow, Message, RemoteRights, rule_ids


class Mode(StrEnum):
    """The part that a process takes in the Zenoh network."""

    ROUTER = "router"
    PEER = "peer"
    """Connects to the router, and directly to the processes that the router names."""
    CLIENT = "client"
    """Connects only to the router, which forwards all data."""


@dataclass(frozen=True, slots=True)
class ZenohRouter:
    """A router, and the enclaves whose sessions connect to this router.

    ``name`` is the router's enclave.  Sessions and other routers connect to ``endpoints``
    (``HOST:PORT``).  The router listens at ``listen``, or at the ports of ``endpoints`` on all
    addresses.  ``enclaves`` are names of enclaves, in which ``*`` stands for any characters.
    ``crossing`` are the topics and services that may pass between this router and other routers; if
    empty, the ``crossing`` of the network applies.
    """

    name: str
    endpoints: tuple[str, ...]
    listen: tuple[str, ...] = ()
    enclaves: tuple[str, ...] = ()
    crossing: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return text like ``/r1/router at r1.local:7447 for /r1/*``."""
        served = f" for {' '.join(self.enclaves)}" if self.enclaves else ""
        passing = f", passing on {' '.join(self.crossing)}" if self.crossing else ""
        return f"{self.name} at {' '.join(self.endpoints)}{served}{passing}"

    def listening(self) -> tuple[str, ...]:
        """Return the addresses at which the router listens, as ``HOST:PORT``."""
        ports = dict.fromkeys(endpoint.rpartition(":")[2] for endpoint in self.endpoints)
        return self.listen or tuple(f"[::]:{port}" for port in ports)


@dataclass(frozen=True, slots=True)
class ZenohNetwork:
    """The Zenoh network of the enclaves of a keystore.

    ``router`` is the enclave of the router.  Sessions connect to ``endpoints`` (``HOST:PORT``).
    The router listens at ``listen``, such as ``[::]:7447``, or at ``endpoints`` if ``listen`` is
    empty.  ``mode`` is the mode of the sessions, client or peer.  ``domains`` are ROS domains; if
    empty, the domains of the keystore's governance.

    ``routers`` are further routers.  All routers connect to each other, and the sessions of an
    enclave connect to the first router in ``routers`` that names the enclave.  ``crossing`` are the
    topics and services, perhaps with wildcards, that may pass between routers; if empty, only the
    rights of the enclaves decide.
    """

    router: str = "/router"
    endpoints: tuple[str, ...] = ("localhost:7447",)
    listen: tuple[str, ...] = ()
    mode: Mode = Mode.CLIENT
    domains: tuple[int, ...] = ()
    routers: tuple[ZenohRouter, ...] = ()
    crossing: tuple[str, ...] = ()

    def listening(self) -> tuple[str, ...]:
        """Return the addresses at which the router listens, as ``HOST:PORT``."""
        return self.listen or self.endpoints

    def every_router(self) -> tuple[ZenohRouter, ...]:
        """Return all routers; the first router has the enclaves that no other router names."""
        return (ZenohRouter(self.router, self.endpoints, self.listening(), ("*",)), *self.routers)

    def router_names(self) -> tuple[str, ...]:
        """Return the enclaves of all routers."""
        return (self.router, *(router.name for router in self.routers))

    def router_of(self, enclave: str) -> ZenohRouter:
        """Return the router to which the sessions of an enclave connect."""
        for router in self.routers:
            if any(fnmatchcase(enclave, pattern) for pattern in router.enclaves):
                return router
        return self.every_router()[0]

    def connects(self) -> Mapping[str, tuple[str, ...]]:
        """Map each router to the endpoints of the routers to which it connects.

        In each pair of routers, only one router connects to the other.

        Raises:
            UsageError: in a pair of routers, neither can reach the other.
        """
        connections: dict[str, tuple[str, ...]] = {
            router.name: () for router in self.every_router()
        }
        for first, second in combinations(self.every_router(), 2):
            for listening, connecting in ((first, second), (second, first)):
                if reachable := _endpoints_for_others(listening):
                    connections[connecting.name] += reachable[:1]
                    break
            else:
                raise UsageError(
                    f"the routers {first.name} and {second.name} cannot connect to each other",
                    "Other hosts can reach neither of them: each router listens only at localhost, "
                    "or its endpoints, to which others connect, are all at localhost.",
                    "For one of the two routers, name an endpoint that other hosts can reach.",
                )
        return connections


_REVOKED_KEY = "last_revocation"
_REPLY_TIMEOUT_MILLISECONDS = 600_000
"""Time that rmw_zenoh waits for a reply; Zenoh's default of 10 s would end long calls."""
_MICROSECONDS_UNTIL_CLOSED = 60_000_000
"""Time that a session of rmw_zenoh waits for a stuck receiver before closing the connection."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """The configuration of a Zenoh process: its endpoints and its access control.

    The process listens at ``listen`` and connects to ``connect``, in the form ``tls/HOST:PORT``.
    ``revoked`` is the time of the last revocation in UTC, which identifies older files; "" if no
    enclave was revoked, or if the age of the file does not matter.
    """

    mode: Mode
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    access_control: AccessControl
    revoked: str = ""

    def render(self) -> bytes:
        """Return the file as JSON; equal configurations have equal files.

        The file does not name the TLS files, which $ZENOH_CONFIG_OVERRIDE has to name.
        """
        rights = [render_rights(remote) for remote in self.access_control.remotes]
        return render_configuration(self.mode, self.listen, self.connect, rights, self.revoked)


class RenderedRights(NamedTuple):
    """The rules for one remote enclave in the form of the file, without ids."""

    name: str
    rules: tuple[str, ...]


def render_configuration(
    mode: Mode,
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    rights: Iterable[RenderedRights],
    revoked: str = "",
) -> bytes:
    """Return the bytes of `Configuration.render`, from rights that are already rendered."""
    without_control = _text_without_control(mode, listen, connect, revoked)
    return f"{without_control}{_CONTROL_BEGIN}{_access_control_text([*rights])}".encode()


_CONTROL_BEGIN = ',\n "access_control": {\n'


def _access_control_text(rendered_rights: Sequence[RenderedRights]) -> str:
    """Return the text of a file's access control; a rule of several enclaves is written once."""
    rules: dict[str, str] = {}
    lines: dict[str, list[str]] = {"rules": [], "subjects": [], "policies": []}
    names = [rights.name for rights in rendered_rights]
    every_ids = rule_ids([rights.rules for rights in rendered_rights], names)
    for rights, ids in zip(rendered_rights, every_ids, strict=True):
        rules.update(zip(ids, rights.rules, strict=True))
        own_names = _json_list([rights.name])
        lines["subjects"].append(
            f'   {{"id": {own_names[1:-1]}, "cert_common_names": {own_names}}}'
        )
        lines["policies"].append(f'   {{"rules": {_json_list(ids)}, "subjects": {own_names}}}')
    lines["rules"] = [
        f'   {{"id": {_json_list([name])[1:-1]}, {rule}' for name, rule in rules.items()
    ]
    lists = [
        f'  "{name}": [\n{text}\n  ]' if (text := ",\n".join(of)) else f'  "{name}": [\n  ]'
        for name, of in lines.items()
    ]
    control = ",\n".join(('  "enabled": true', '  "default_permission": "deny"', *lists))
    return f"{control}\n }}\n}}\n"


@lru_cache
def _text_without_control(
    mode: Mode,
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    revoked: str,
) -> str:
    """Return the text of a configuration without access control and the closing brace."""
    document: dict[str, Any] = {
        "mode": mode.value,
        "connect": {"endpoints": list(connect)},
        "listen": {"endpoints": list(listen)},
        "scouting": {
            # Multicast groups are neither encrypted nor filtered.
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": mode is not Mode.CLIENT,
                "target": {"router": ["router", "peer"], "peer": ["router"]},
                "autoconnect": {"router": [], "peer": ["router", "peer"]},
            },
        },
        "timestamping": {"enabled": {"router": True, "peer": True, "client": True}},
        "queries_default_timeout": _REPLY_TIMEOUT_MILLISECONDS,
        "transport": {
            "link": {
                # Without this list, the process could also open an endpoint tcp/... in addition to
                # tls/... .
                "protocols": ["tls"],
                "tls": {
                    "enable_mtls": True,
                    # The certificate of an enclave names the enclave, not a host.  Rules check this
                    # name, and every subject has a name.
                    "verify_name_on_connect": False,
                    "close_link_on_expiration": True,
                },
            },
            # Shared memory between processes of a host is not encrypted.
            "shared_memory": {"enabled": False},
        },
        "adminspace": {"enabled": False},
    }
    _add_settings_of_rmw_zenoh(document, mode)
    if revoked:
        document["metadata"] = {_REVOKED_KEY: revoked}
    return json.dumps(document, indent=1).removesuffix("\n}")


def _add_settings_of_rmw_zenoh(document: dict[str, Any], mode: Mode) -> None:
    transport = document["transport"]
    # These limits let hundreds of nodes that start together connect, although each connection takes
    # a while.
    transport["unicast"] = {
        "open_timeout": 60_000,
        "accept_timeout": 60_000,
        "accept_pending": 10_000,
        "max_sessions": 10_000,
    }
    sending: dict[str, Any] = {"lease": 60_000, "keep_alive": 2}
    transport["link"]["tx"] = sending
    strategy = {"to_router": "always", "to_peer": "greater-zid" if mode is Mode.PEER else "always"}
    if mode is Mode.ROUTER:
        document["routing"] = {"router": {"peers_failover_brokering": False}}
    else:
        # In microseconds, unlike all other times, which are in milliseconds.
        block = {"wait_before_close": _MICROSECONDS_UNTIL_CLOSED}
        sending["queue"] = {"congestion_control": {"block": block}}
    if mode is Mode.CLIENT:
        # Zenoh's default ends a client whose router is not there yet; with this value it waits, as
        # in rmw_zenoh.
        document["connect"]["timeout_ms"] = -1
    else:
        document["scouting"]["gossip"]["autoconnect_strategy"] = {mode.value: strategy}


_PERMISSIONS = {True: "allow", False: "deny"}


def render_rights(remote: RemoteRights) -> RenderedRights:
    """Return the rules of a remote enclave in the form of the file."""
    return RenderedRights(
        remote.common_name, tuple([_rendered_rule(rule) for rule in remote.rules])
    )


def _rendered_rule(rule: AccessRule) -> str:
    return (
        f'"permission": "{_PERMISSIONS[rule.allows]}", "flows": ["{rule.flow}"], '
        f'"messages": {_kept_list(rule.messages)}, '
        f'"key_exprs": {_kept_list(rule.key_expressions)}}}'
    )


@lru_cache(maxsize=4096)  # several rules have the same list, and in peer mode many files have it
def _kept_list(texts: tuple[str, ...]) -> str:
    """Return `_json_list` of texts, made once."""
    return _json_list(texts)


def _json_list(texts: Iterable[str]) -> str:
    """Return texts as a JSON list; for short texts, this is much faster than `json.dumps`."""
    return f"[{', '.join(map(encode_basestring_ascii, texts))}]"


def parse_rendered(data: bytes, name: str) -> Configuration:
    """Return the configuration in a file that `Configuration.render` wrote.

    ``name`` names the file in errors.

    Raises:
        DocumentError: the file is not exactly in the form that sros writes, so that its meaning is
            uncertain.
    """
    configuration = RenderedReader().read(data)
    if configuration is None:
        raise DocumentError(
            f"{name} is not a Zenoh configuration as sros writes it",
            "Another program wrote it, or somebody changed it by hand.",
        )
    return configuration


_SECTIONS = re.compile(
    r'  "enabled": true,\n  "default_permission": "deny",\n'
    r'  "rules": \[(.*)\n  \],\n  "subjects": \[(.*)\n  \],\n  "policies": \[(.*)\n  \]\n }\n}\n',
    re.DOTALL,
)


class RenderedReader:
    """A reader of many configurations that `Configuration.render` wrote.

    Equal files, and equal rules in several files, are read only once.
    """

    def __init__(self) -> None:
        self._read: dict[bytes, Configuration | None] = {}
        self._beginnings: dict[str, Configuration] = {}
        self._policies: dict[str, tuple[str, list[str]]] = {}
        self._rules: dict[str, AccessRule] = {}

    def read(self, data: bytes) -> Configuration | None:
        """Return a configuration, or None if sros would not write exactly this file."""
        digest = sha256(data).digest()
        if digest not in self._read:
            self._read[digest] = self._read_in_full(data)
        return self._read[digest]

    def _read_in_full(self, data: bytes) -> Configuration | None:
        try:
            beginning, mark, control = data.decode().partition(_CONTROL_BEGIN)
            sections = _SECTIONS.fullmatch(control)
            if not mark or not sections:
                return None
            configuration = self._parse_without_rules(beginning)
            rights = self._rendered_rights(sections)
            if _access_control_text(rights) != control:
                return None
            remotes = tuple(
                RemoteRights(rendered.name, tuple(map(self._rule, rendered.rules)))
                for rendered in rights
            )
            return replace(configuration, access_control=AccessControl(remotes))
        except (ValueError, KeyError, IndexError, TypeError, RecursionError):
            return None

    def _parse_without_rules(self, text: str) -> Configuration:
        """Return the mode and the endpoints of a configuration.

        Raises:
            ValueError, KeyError: sros did not write the file.
        """
        if text not in self._beginnings:
            document = json.loads(f"{text}\n}}")
            mode = Mode(document["mode"])
            listen, connect = (tuple(document[key]["endpoints"]) for key in ("listen", "connect"))
            revoked = document.get("metadata", {}).get(_REVOKED_KEY, "")
            if _text_without_control(mode, listen, connect, revoked) != text:
                raise ValueError("the text is not as sros writes it")
            self._beginnings[text] = Configuration(
                mode, listen, connect, AccessControl(()), revoked
            )
        return self._beginnings[text]

    def _rendered_rights(self, sections: re.Match[str]) -> list[RenderedRights]:
        rules, _, policies = (_lines(section) for section in sections.groups())
        by_id = {}
        for line in rules:
            begin, mark, rest = line.partition(', "permission": ')
            by_id[json.loads(begin.removeprefix('   {"id": '))] = f"{mark[2:]}{rest}"
        rights = []
        for name, ids in map(self._policy, policies):
            rights.append(RenderedRights(name, tuple([by_id[rule_id] for rule_id in ids])))
        if len({rendered.name for rendered in rights}) != len(rights):
            raise ValueError("a subject twice")
        return rights

    def _policy(self, line: str) -> tuple[str, list[str]]:
        """Return the enclave to which a policy applies, and the ids of the policy's rules."""
        if line not in self._policies:
            policy = json.loads(line)
            self._policies[line] = policy["subjects"][0], policy["rules"]
        return self._policies[line]

    def _rule(self, text: str) -> AccessRule:
        """Return a rule without its id."""
        if text not in self._rules:
            stated = json.loads(f"{{{text}")
            rule = AccessRule(
                Flow(stated["flows"][0]),
                tuple(map(Message, stated["messages"])),
                tuple(stated["key_exprs"]),
                stated["permission"] == _PERMISSIONS[True],
            )
            if _rendered_rule(rule) != text:
                raise ValueError("the text is not as sros writes it")
            self._rules[text] = rule
        return self._rules[text]


def _lines(section: str) -> list[str]:
    return section.removeprefix("\n").split(",\n") if section else []


_ENDPOINT = re.compile(r"(?:[A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\]):(\d{1,5})\Z", re.ASCII)
_MOST_PORT = 65535


def is_endpoint(text: str) -> bool:
    """Return whether ``text`` is ``HOST:PORT``, with a name or an address and a port above 0."""
    endpoint = _ENDPOINT.match(text)
    return bool(endpoint and 0 < int(endpoint[1]) <= _MOST_PORT)


def check_network(network: ZenohNetwork) -> None:
    """Raise `UsageError` for a network in which processes cannot communicate.

    Hosts are compared by name. Only names such as localhost count as this host, although other
    names may mean the same host.
    """
    if network.routers:
        _check_routers(network)
    connect, listen = (
        {_host_and_port(endpoint) for endpoint in endpoints}
        for endpoints in (network.endpoints, network.listen)
    )
    hosts = {host for host, _ in connect}
    far = sorted(hosts - {_LOOPBACK})
    if network.mode is Mode.PEER and far:
        raise UsageError(
            f"sessions in peer mode cannot reach both a router at {far[0]} and each other",
            "They listen only on their own host, and the router forwards no data between peers: "
            "peers on different hosts would receive nothing.",
            "Use client mode for several hosts: `--mode client`. For one host, leave the endpoint "
            "at localhost.",
        )
    if len(hosts) > 1 and not listen:
        raise UsageError(
            f"the router cannot listen at {' and '.join(sorted(hosts))}",
            "Without --listen the router listens at each endpoint, and does not start if one of "
            "them is on another host.",
            f"State where the router listens, for example with `--listen [::]:{min(connect)[1]}`.",
        )
    if not listen:
        return
    if not {port for _, port in connect} & {port for _, port in listen}:
        ports = " and ".join(sorted({str(port) for _, port in listen}))
        raise UsageError(
            f"no session connects to port {ports}, at which the router listens",
            f"The endpoints are {', '.join(network.endpoints)}.",
            "Name the same port with --endpoint and --listen.",
        )
    if hosts == set(far) and {host for host, _ in listen} == {_LOOPBACK}:
        raise UsageError(
            f"the router listens only on its own host, but sessions connect to {far[0]}",
            "Another host cannot reach a router that listens at localhost.",
            f"Let it listen for other hosts, for example with `--listen [::]:{min(listen)[1]}`.",
        )


def _check_routers(network: ZenohNetwork) -> None:
    """Raise `UsageError` for a network whose routers cannot work together."""
    if network.mode is Mode.PEER:
        raise UsageError(
            "several routers need client mode",
            "In peer mode, sessions listen only on their own host, so sessions on different hosts "
            "would not find each other.",
            "Use client mode: `--mode client`.",
        )
    network.connects()
    for router in network.routers:
        # The rules for the first router apply to each router.
        check_network(ZenohNetwork(router.name, router.endpoints, router.listening(), network.mode))


def _endpoints_for_others(router: ZenohRouter) -> tuple[str, ...]:
    """Return the endpoints at which processes on other hosts can reach a router."""
    listens = {_host_and_port(endpoint)[0] for endpoint in router.listening()}
    far = tuple(
        endpoint for endpoint in router.endpoints if _host_and_port(endpoint)[0] != _LOOPBACK
    )
    return () if listens == {_LOOPBACK} else far


_LOOPBACK = "localhost"
_LOOPBACKS = ("localhost", "[::1]", "ip6-localhost")


def _host_and_port(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.rpartition(":")
    is_here = host.lower() in _LOOPBACKS or host.startswith("127.")
    return _LOOPBACK if is_here else host, int(port)
