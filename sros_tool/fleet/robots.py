"""A fleet, and the settings of its robots, with a check of each setting.

The grammar of every value allows it to be one name in a policy, a command or a path: no markup, no
wildcard, no white space, and "/" only in a namespace.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from ipaddress import ip_address
from types import MappingProxyType
from typing import NamedTuple

from sros_tool.errors import DocumentError, UsageError
from sros_tool.names import expression_problem
from sros_tool.validity import parse_duration

MAX_ROBOTS = 100_000
RENEWAL_ALLOWED, _RENEWAL_REFUSED = "allowed", "refused"
ROUTERS = "/{robot}/router"
"""Default path of the enclave of each robot's Zenoh router."""
_MAX_NAME = 64
"""Longest name of a robot or group in characters: longer ones fit into no enclave's name."""
__MAX_NAMESPACE = 245
"""Longest ROS namespace (rmw: RMW_NAMESPACE_MAX_LENGTH)."""
_MAX_HOST = 253
"""Longest host name (RFC 1035)."""

_OF_ANSIBLE = frozenset({"all", "ungrouped", "_meta", "localhost"})
"""Names that Ansible reserves in an inventory; "localhost" is the machine that runs Ansible."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
_HOST = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?\.?", re.ASCII)
_USER = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,31}\$?", re.ASCII)


class Robot(NamedTuple):
    """A robot: its ROS namespace, and its network address.

    ``domain`` is its ROS_DOMAIN_ID; None stands for every domain of the keystore.  ``address`` is a
    host name or IP address, ``user`` the account there ("": the default of ssh).  ``groups`` are
    sorted.  ``router`` is the address (``HOST:PORT``) at which sessions and other routers connect
    to its Zenoh router, or "" if it has none; ``crossing`` are the names that may pass between that
    router and others, if not all may.  ``distribution`` is its ROS 2 distribution ("": those of
    the keystore).  ``renewal`` is `RENEWAL_ALLOWED` if `sros fleet collect` may sign its requests
    for renewal; ``renewal_grace`` is a duration, such as ``30d``, for which a certificate is still
    accepted with such a request after its expiry ("": none).
    """

    name: str
    namespace: str
    domain: int | None = None
    address: str = ""
    user: str = ""
    groups: tuple[str, ...] = ()
    router: str = ""
    crossing: tuple[str, ...] = ()
    distribution: str = ""
    renewal: str = ""
    renewal_grace: str = ""


@dataclass(frozen=True, slots=True)
class Fleet:
    """The robots by name, and the robot names of each group; both sorted.

    ``enclaves`` are paths of enclaves with a placeholder, such as ``/{robot}/base``: they say
    which robot an enclave belongs to.  ``routers`` is the path of the enclaves of the robots' Zenoh
    routers; it is one of ``enclaves`` if a robot has one.  ``by_namespace`` has the names of the
    robots in each namespace.
    """

    robots: Mapping[str, Robot]
    groups: Mapping[str, tuple[str, ...]]
    enclaves: tuple[str, ...] = ()
    routers: str = ROUTERS
    by_namespace: Mapping[str, tuple[str, ...]] = field(default_factory=dict, compare=False)

    @classmethod
    def of(
        cls,
        robots: Iterable[Robot],
        groups: Iterable[str] = (),
        enclaves: Sequence[str] = (),
        routers: str = ROUTERS,
    ) -> Fleet:
        """Return a fleet of ``robots``; ``groups`` may name groups without robots."""
        named = {robot.name: robot for robot in sorted(robots, key=lambda robot: robot.name)}
        members: dict[str, list[str]] = {name: [] for name in groups}
        spaces: dict[str, list[str]] = {}
        for robot in named.values():
            spaces.setdefault(robot.namespace, []).append(robot.name)
            for group in robot.groups:
                members.setdefault(group, []).append(robot.name)
        return cls(
            MappingProxyType(named),
            MappingProxyType({name: tuple(members[name]) for name in sorted(members)}),
            (),
            routers,
            MappingProxyType({name: tuple(spaces[name]) for name in spaces}),
        ).with_enclaves(enclaves)

    def robot(self, name: str) -> Robot:
        """Return the robot with this name.

        Raises:
            DocumentError: there is none; the error has similar names.
        """
        if name in self.robots:
            return self.robots[name]
        raise DocumentError(f"the fleet has no robot {name!r}", remedy=_near(name, self.robots))

    def members(self, group: str) -> tuple[Robot, ...]:
        """Return the robots of a group; "" stands for the whole fleet.

        Raises:
            DocumentError: the fleet has no such group; the error has similar names.
        """
        if not group:
            return tuple(self.robots.values())
        if group not in self.groups:
            raise DocumentError(
                f"the fleet has no group {group!r}", remedy=_near(group, self.groups)
            )
        return tuple(self.robots[name] for name in self.groups[group])

    def with_enclaves(self, enclaves: Sequence[str]) -> Fleet:
        """Return the fleet with these enclave paths.

        The path of routers is added if a robot has a router.
        """
        of_routers = [self.routers] if any(robot.router for robot in self.robots.values()) else []
        return replace(self, enclaves=tuple(dict.fromkeys((*enclaves, *of_routers))))


def _near(name: str, known: Iterable[str]) -> str:
    """Return the remedy for an unknown name: similar known names, or else the first ones."""
    names = list(known)
    similar = get_close_matches(name[:_MAX_NAME], names, n=3, cutoff=0.5) or names[:3]
    return (
        f"It has {', '.join(similar)}{', ...' if len(names) > len(similar) else ''}."
        if similar
        else ""
    )


# ── grammar ────────────────────────────────────────────────────────────────────────────────


def name_problem(name: str) -> str:
    """Return why ``name`` is not the name of a robot or group, as a sentence; "" if it is."""
    if len(name) > _MAX_NAME:
        return f"It has {len(name)} characters, more than {_MAX_NAME}."
    if not _TOKEN.fullmatch(name) or "__" in name:
        return (
            "A name is one part of a ROS name: letters, digits and single underscores, and no "
            "digit at its start, such as r7."
        )
    if name in _OF_ANSIBLE:
        return "In an Ansible inventory this name means something else."
    return ""


def namespace_problem(namespace: str) -> str:
    """Return why ``namespace`` is not an absolute ROS namespace, as a sentence; "" if it is."""
    if len(namespace) > __MAX_NAMESPACE:
        return f"It has {len(namespace)} characters, more than {__MAX_NAMESPACE}."
    if namespace == "/":
        return ""
    first, *parts = namespace.split("/")
    if first or not parts or not all(_TOKEN.fullmatch(part) for part in parts):
        return (
            "A namespace is absolute, and its parts are letters, digits and underscores, such as "
            "/warehouse/r7."
        )
    return "It contains '__', which ROS does not allow." if "__" in namespace else ""


def address_problem(address: str) -> str:
    """Return why ``address`` is neither a host name nor an IP address; "" if it is one."""
    if len(address) <= _MAX_HOST and _HOST.fullmatch(address) and ".." not in address:
        return ""
    try:
        ip_address(address)
    except ValueError:
        return "It is neither a host name nor an IP address, such as r7.example.com or 10.0.7.1."
    # An IPv6 address can have a zone of any characters.
    return "" if "%" not in address else "It has a zone: write the address without it."


def router_problem(router: str) -> str:
    """Return why ``router`` is no address of a Zenoh router, as a sentence; "" if it is one."""
    from sros_tool.zenoh.configuration import is_endpoint  # most fleets name no routers

    return "" if is_endpoint(router) else "It is not HOST:PORT, such as r7.example.com:7447."


def crossing_problem(name: str) -> str:
    """Return why ``name`` cannot pass between routers, as a sentence; "" if it can."""
    if not name.startswith("/"):
        return "It does not start with '/', as /fleet/* does."
    return expression_problem(name)


def user_problem(user: str) -> str:
    """Return why ``user`` is not the name of an account, as a sentence; "" if it is."""
    return "" if _USER.fullmatch(user) else "It is not the name of an account, such as ros."


def renewal_problem(renewal: str) -> str:
    """Return why ``renewal`` does not say whether renewals are allowed; "" if it does."""
    known = (RENEWAL_ALLOWED, _RENEWAL_REFUSED)
    return "" if renewal in known else f"It is neither {known[0]} nor {known[1]}."


def grace_problem(grace: str) -> str:
    """Return why ``grace`` is not a duration, as a sentence; "" if it is."""
    try:
        parse_duration(grace)
    except UsageError as error:
        return error.remedy
    return ""
