"""Says the endpoints of a node in ROS terms: topics, services, actions, and what is neither."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Criteria, Rule
from sros_tool.graph.observation import PUBLISH, SUBSCRIBE, Endpoint
from sros_tool.translate import ros_rights

_ANY_DOMAIN = DomainSet.of((0, 0))


@dataclass(frozen=True, slots=True, order=True)
class Right:
    """A right (publish, subscribe, request, reply, call, execute) on an absolute ROS name."""

    right: str
    name: str


@dataclass(frozen=True, slots=True)
class Folded:
    """The rights behind a set of endpoints.

    ``halves`` are endpoints of services whose other half is missing; ``foreign`` are topics that
    have no ROS name.  Neither can be said in a policy.
    """

    rights: frozenset[Right]
    halves: frozenset[Endpoint]
    foreign: frozenset[Endpoint]


def fold(endpoints: Iterable[Endpoint]) -> Folded:
    """Actions and services are folded back from their topics where all of these are there."""
    endpoints = tuple(endpoints)
    rule = Rule(True, _ANY_DOMAIN, _criteria(endpoints, PUBLISH), _criteria(endpoints, SUBSCRIBE))
    rights, halves, foreign = set(), set(), set()
    for each in ros_rights(rule):
        if each.kind != "dds":
            rights.add(Right(each.right, each.name))
        elif each.name.startswith(("rq/", "rr/")):
            halves.add(Endpoint(each.name, each.right))
        else:
            foreign.add(Endpoint(each.name, each.right))
    return Folded(frozenset(rights), frozenset(halves), frozenset(foreign))


def _criteria(endpoints: Iterable[Endpoint], direction: str) -> tuple[Criteria, ...]:
    topics = tuple(sorted(each.topic for each in endpoints if each.direction == direction))
    return (Criteria(topics),) if topics else ()
