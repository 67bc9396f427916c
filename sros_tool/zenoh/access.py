"""Access control of Zenoh: rules for remote processes by certificate, and what they decide.

Only permission is stated, and what no rule allows is denied: a denial inside a wider permission
holds neither against a query nor against a put with a wildcard key (measured with 1.10.2).
Sources: zenoh.io "Access Control"; zenoh 1.9, access_control.rs and authorization.rs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

from sros_tool.automata import NameSet
from sros_tool.zenoh.key_expressions import KeyExpressions, includes, names_of


class Message(StrEnum):
    """The kinds of messages that a rule can name, in the order in which rules list them."""

    PUT = "put"
    DELETE = "delete"
    DECLARE_SUBSCRIBER = "declare_subscriber"
    QUERY = "query"
    REPLY = "reply"
    DECLARE_QUERYABLE = "declare_queryable"
    LIVELINESS_TOKEN = "liveliness_token"  # noqa: S105 - no password
    LIVELINESS_QUERY = "liveliness_query"
    DECLARE_LIVELINESS_SUBSCRIBER = "declare_liveliness_subscriber"


class Flow(StrEnum):
    """The direction of a message, as the process sees it that has the rule."""

    INGRESS = "ingress"
    """From the remote process."""
    EGRESS = "egress"
    """To the remote process."""

    def opposite(self) -> Flow:
        """Return the direction as the remote process sees it."""
        return Flow.EGRESS if self is Flow.INGRESS else Flow.INGRESS


class AccessRule(NamedTuple):
    """Messages that are allowed in one direction, on keys that ``key_expressions`` include."""

    flow: Flow
    messages: tuple[Message, ...]
    key_expressions: tuple[str, ...]

    def mirrored(self) -> AccessRule:
        """Return the rule that the remote process needs for the same messages."""
        return AccessRule(self.flow.opposite(), self.messages, self.key_expressions)


@dataclass(frozen=True, slots=True)
class RemoteRights:
    """What processes may send and get whose certificate has the common name ``common_name``."""

    common_name: str
    rules: tuple[AccessRule, ...]


@dataclass(frozen=True, slots=True)
class AccessControl:
    """The access control of a process: each common name occurs once, everybody else is denied.

    A name that matched two subjects of Zenoh would have the rights of both; and in zenoh up to
    1.5.1, those of one of them by chance.
    """

    remotes: tuple[RemoteRights, ...]

    def allows(self, common_name: str, flow: Flow, message: Message, key: str) -> bool:
        """Return whether a message to or from a remote process passes.

        ``key`` is the key or the key expression that the message names: a rule applies to it only
        as a whole, so that a wider subscription, query or put is dropped and not cut down.
        """
        return any(
            _include(each.key_expressions, key) for each in self._rules(common_name, flow, message)
        )

    def passing(self, common_name: str, flow: Flow, message: Message) -> KeyExpressions:
        """Return the key expressions of all rules for a message, to ask about many keys."""
        rules = self._rules(common_name, flow, message)
        return KeyExpressions(each for rule in rules for each in rule.key_expressions)

    def keys(self, common_name: str, flow: Flow, message: Message) -> NameSet:
        """Return the set of all keys with which a message passes."""
        return names_of(self.passing(common_name, flow, message).all)

    def _rules(self, common_name: str, flow: Flow, message: Message) -> Iterator[AccessRule]:
        for remote in self.remotes:
            if remote.common_name == common_name:
                for rule in remote.rules:
                    if rule.flow is flow and message in rule.messages:
                        yield rule


_FEW = 16
"""So many key expressions are compared one by one, without an index."""


def _include(expressions: tuple[str, ...], key: str) -> bool:
    if len(expressions) <= _FEW:
        return any(includes(each, key) for each in expressions)
    return _search(expressions).include(key)


@lru_cache(maxsize=4096)
def _search(expressions: tuple[str, ...]) -> KeyExpressions:
    return KeyExpressions(expressions)


def joined(rules: Iterable[AccessRule]) -> tuple[AccessRule, ...]:
    """Return rules that allow the same, in an order that does not depend on theirs.

    Rules of the same direction and messages become one; key expressions that others of the same
    rule include are left out.
    """
    found: dict[tuple[Flow, tuple[Message, ...]], set[str]] = {}
    for rule in rules:
        found.setdefault((rule.flow, rule.messages), set()).update(rule.key_expressions)
    return in_order(
        AccessRule(flow, messages, _needed(frozenset(keys)))
        for (flow, messages), keys in found.items()
    )


@lru_cache(maxsize=16)  # several messages of a right have the same keys
def _needed(keys: frozenset[str]) -> tuple[str, ...]:
    return tuple(KeyExpressions(keys).needed())


def in_order(rules: Iterable[AccessRule]) -> tuple[AccessRule, ...]:
    """Return rules of different directions and messages in the order of `joined`."""
    return tuple(sorted(rules, key=lambda each: _place(each.flow, each.messages)))


_ORDER = {message: number for number, message in enumerate(Message)}


@lru_cache(maxsize=64)  # the rules of all enclaves have the same few
def _place(flow: Flow, messages: tuple[Message, ...]) -> tuple[bool, list[int]]:
    return flow is Flow.EGRESS, [_ORDER[each] for each in messages]
