"""Zenoh access control: rules for remote processes, and the decisions by these rules.

`AccessControl` is the access control that sros writes: subjects are certificates, and messages are
denied by default.  A deny rule for a part of the keys that another rule allows does not stop
queries and puts with a wildcard key (tested with 1.10.2). Such a rule does stop graph tokens,
because no process reads the keys of tokens as wildcards.  `Enforcement` is the access control in
any configuration. Sources: zenoh.io "Access Control"; zenoh 1.9, access_control.rs and
authorization.rs; compared with the wheel 1.10.2.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from functools import cached_property, lru_cache
from itertools import count, product
from typing import NamedTuple, Protocol

from sros_tool.automata import NameSet
from sros_tool.zenoh.key_expressions import KeyExpressions, includes
from sros_tool.zenoh.subtraction import Difference, RuleKeys, keys_of


class Message(StrEnum):
    """The kinds of messages that a rule can name, in the order of rules that sros writes."""

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
    """The direction of a message, from the view of the process that has the rule."""

    INGRESS = "ingress"
    """From the remote process."""
    EGRESS = "egress"
    """To the remote process."""

    def opposite(self) -> Flow:
        """Return the direction from the view of the remote process."""
        return Flow.EGRESS if self is Flow.INGRESS else Flow.INGRESS


class AccessRule(NamedTuple):
    """A rule that allows or denies messages in one direction, on keys in ``key_expressions``.

    Only rules for graph tokens deny.  No process reads the key of a token as a wildcard, so a rule
    for tokens can deny some of the keys that another rule allows.  For other messages, Zenoh would
    not enforce such a denial.
    """

    flow: Flow
    messages: tuple[Message, ...]
    key_expressions: tuple[str, ...]
    allows: bool = True

    def mirrored(self) -> AccessRule:
        """Return the rule that the remote process needs to exchange the same messages."""
        return self._replace(flow=self.flow.opposite())


@dataclass(frozen=True, slots=True)
class RemoteRights:
    """The rights of the remote processes whose certificate has this common name.

    A denial turns a key with wildcards into a list of keys.  ``differences`` keeps the original
    keys and the keys that were subtracted, by the direction and the kinds of messages of a rule.
    """

    common_name: str
    rules: tuple[AccessRule, ...]
    differences: Mapping[_RuleUse, tuple[Difference, ...]] = field(
        default_factory=dict, compare=False
    )

    def mirrored(self, common_name: str) -> RemoteRights:
        """Return the rights that the remote process must give this process for the same messages.

        ``common_name`` is the common name of this process.
        """
        return RemoteRights(
            common_name,
            sorted_rules(rule.mirrored() for rule in self.rules),
            {(flow.opposite(), messages): of for (flow, messages), of in self.differences.items()},
        )

    def keys_of(self, rule: AccessRule) -> RuleKeys:
        """Return the keys of a rule."""
        differences = self.differences.get((rule.flow, rule.messages), ()) if rule.allows else ()
        return keys_of(frozenset(rule.key_expressions), differences)


_RuleUse = tuple[Flow, tuple[Message, ...]]
"""The direction and message kinds of a rule."""


@dataclass(frozen=True)
class AccessControl:
    """The access control of a process: rules by common name; other processes are denied.

    Each common name occurs only once. The rights of a second subject with the same name would be
    added to the rights of the first, and in Zenoh up to 1.5.1, one of the two subjects, chosen at
    random, would decide.
    """

    remotes: tuple[RemoteRights, ...]

    def allows(self, common_name: str, flow: Flow, message: Message, key: str) -> bool:
        """Return whether a message to or from a remote process passes.

        ``key`` is the key or key expression of the message.  A rule applies only if it includes all
        of ``key``: Zenoh drops a subscription, query or put with a wider key, and does not narrow
        the key.
        """
        rules = [
            rule.allows
            for rule in self._rules(common_name, flow, message)
            if _include(rule.key_expressions, key)
        ]
        return bool(rules) and all(rules)

    def passing(self, common_name: str, flow: Flow, message: Message) -> KeyExpressions:
        """Return the key expressions of the rules that allow a message, with a fast search."""
        return self._expressions(common_name, flow, message, allows=True)

    def denied(self, common_name: str, flow: Flow, message: Message) -> KeyExpressions:
        """Return the key expressions of the rules that deny a message.

        Other rules may allow the same key expressions.
        """
        return self._expressions(common_name, flow, message, allows=False)

    def _expressions(
        self, common_name: str, flow: Flow, message: Message, *, allows: bool
    ) -> KeyExpressions:
        rules = self._rules(common_name, flow, message)
        return KeyExpressions(
            key for rule in rules if rule.allows is allows for key in rule.key_expressions
        )

    def decide(self, remote: Remote, flow: Flow, message: Message, key: str) -> AccessDecision:
        """Return the decision of `Enforcement.decide` for a file with these rules."""
        rights = None if remote.common_name is None else self._by_name.get(remote.common_name)
        if rights is None:
            stated = any(of_remote.rules for of_remote in self.remotes)
            return AccessDecision(False, (), (), _NO_SUBJECT if stated else _NO_RULE_AT_ALL)
        applying = [
            (rule.allows, name)
            for name, rule in self._with_ids(rights)
            if rule.flow is flow
            and message in rule.messages
            and _include(rule.key_expressions, key)
        ]
        return _decide_by_rules(applying, (rights.common_name,))

    def allowed_keys(self, common_name: str, flow: Flow, message: Message) -> tuple[str, ...]:
        """Return the key expressions that rules allow, including denied ones."""
        rules = self._rules(common_name, flow, message)
        return tuple(key for rule in rules if rule.allows for key in rule.key_expressions)

    def key_expressions_of(self, rule: str) -> tuple[str, ...]:
        """Return the key expressions of a rule, by its id in a decision."""
        ids = ((id_, of) for remote in self.remotes for id_, of in self._with_ids(remote))
        return next(of.key_expressions for id_, of in ids if id_ == rule)

    def _with_ids(self, remote: RemoteRights) -> Iterator[tuple[str, AccessRule]]:
        return zip(self._ids[remote.common_name], remote.rules, strict=True)

    @cached_property
    def _ids(self) -> Mapping[str, list[str]]:
        names = [remote.common_name for remote in self.remotes]
        return dict(
            zip(names, rule_ids([remote.rules for remote in self.remotes], names), strict=True)
        )

    def names(self) -> frozenset[str]:
        """Return the common names for which there are rules."""
        return frozenset(self._by_name)

    def number_of_rules(self, common_name: str) -> int:
        """Return the number of rules for the remote process with this common name."""
        remote = self._by_name.get(common_name)
        return len(remote.rules) if remote else 0

    @cached_property
    def _by_name(self) -> Mapping[str, RemoteRights]:
        return {remote.common_name: remote for remote in self.remotes}

    def _rules(self, common_name: str, flow: Flow, message: Message) -> Iterator[AccessRule]:
        if remote := self._by_name.get(common_name):
            for rule in remote.rules:
                if rule.flow is flow and message in rule.messages:
                    yield rule


def rule_ids(rules: Sequence[Sequence[Hashable]], names: Sequence[str]) -> list[list[str]]:
    """Return the ids of rules in a file: a list per remote process, in the order of ``names``.

    A rule that several processes have has one shared id.
    """
    uses = Counter(rule for of in rules for rule in of)
    number = count()
    shared = {rule: f"several#{next(number)}" for rule, times in uses.items() if times > 1}
    return [
        [shared.get(rule) or f"{name}#{at}" for at, rule in enumerate(of)]
        for name, of in zip(names, rules, strict=True)
    ]


_NO_RULE = "no rule allows it, and the default is DENY"
_NO_SUBJECT = "no subject matches, and the default is DENY"
_NO_RULE_AT_ALL = "no rule is in force, and the default is DENY"


def _decide_by_rules(
    applicable_rules: Sequence[tuple[bool, str]], subjects: tuple[str, ...]
) -> AccessDecision:
    """Return the decision on a message by the applicable rules; a denial wins.

    ``applicable_rules`` are pairs: whether the rule allows, and the rule's id.
    """
    if denied := tuple(rule for allows, rule in applicable_rules if not allows):
        return AccessDecision(False, denied, subjects, f"rule {denied[0]} denies it")
    allowed = tuple(rule for _, rule in applicable_rules)
    why = f"rule {allowed[0]} allows it" if allowed else _NO_RULE
    return AccessDecision(bool(allowed), allowed, subjects, why)


_MAX_WITHOUT_INDEX = 16
"""Maximum number of key expressions that are compared one by one, without an index."""


def _include(expressions: tuple[str, ...], key: str) -> bool:
    if len(expressions) <= _MAX_WITHOUT_INDEX:
        return any(includes(wide, key) for wide in expressions)
    return _search(expressions).include(key)


@lru_cache(maxsize=4096)
def _search(expressions: tuple[str, ...]) -> KeyExpressions:
    return KeyExpressions(expressions)


def joined(rules: Iterable[AccessRule]) -> tuple[AccessRule, ...]:
    """Return equivalent rules, sorted, with a single rule for each direction and list of messages.

    Leaves out key expressions that another key expression of the same rule includes.
    """
    keys_of_use: dict[tuple[Flow, tuple[Message, ...], bool], list[tuple[str, ...]]] = {}
    for flow, messages, keys, allows in rules:
        keys_of_use.setdefault((flow, messages, allows), []).append(keys)
    return sorted_rules(
        AccessRule(flow, messages, _joined_keys(keys), allows)
        for (flow, messages, allows), keys in keys_of_use.items()
    )


def _joined_keys(keys: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    if len(keys) == 1 and len(keys[0]) > _MAX_WITHOUT_INDEX:
        return tuple(sorted(keys[0]))
    return _needed_keys(frozenset(key for some_keys in keys for key in some_keys))


@lru_cache(maxsize=16)  # the rules for several messages have the same keys
def _needed_keys(keys: frozenset[str]) -> tuple[str, ...]:
    return tuple(KeyExpressions(keys).needed())


def sorted_rules(rules: Iterable[AccessRule]) -> tuple[AccessRule, ...]:
    """Return rules in the order of `joined`, without joining rules."""
    return tuple(
        sorted(rules, key=lambda rule: (*_rule_order(rule.flow, rule.messages), not rule.allows))
    )


def joined_rights(name: str, rights: Iterable[RemoteRights]) -> RemoteRights:
    """Return the joint rights of all processes, as the rights of a process named ``name``."""
    of_all = list(rights)
    differences: dict[_RuleUse, dict[Difference, None]] = {}
    for use, of in (item for rights in of_all for item in rights.differences.items()):
        differences.setdefault(use, {}).update(dict.fromkeys(of))
    return RemoteRights(
        name,
        joined(rule for rights in of_all for rule in rights.rules),
        {use: tuple(of) for use, of in differences.items()},
    )


class RightsBetween:
    """The messages that processes of two enclaves may exchange directly, by the rights of both.

    So a process that enforces its rules sends and receives nothing that its rights deny, whatever
    the other process does.
    """

    def __init__(self, rights: Iterable[RemoteRights]) -> None:
        """Keep the rights of all enclaves whose processes connect to each other."""
        self._rules: dict[str, list[_RuleOfPeer]] = {}
        self._mirrored: dict[str, list[_RuleOfPeer]] = {}
        for peer in rights:
            name = peer.common_name
            self._rules[name] = _RuleOfPeer.of_rights(peer)
            self._mirrored[name] = _RuleOfPeer.of_rights(peer.mirrored(name))
        self._plain = {
            name: frozenset().union(*(rule_of_peer.keys.plain for rule_of_peer in rules))
            for name, rules in self._rules.items()
        }

    def rights_for_others(self, own_name: str) -> Iterator[RemoteRights]:
        """Yield the rights that a process of the enclave ``own_name`` gives to each other enclave.

        Raises:
            TooManyExpressions: the rights that two enclaves share need too many key expressions.
        """
        mine = self._mirrored[own_name]
        denied = [rule_of_peer for rule_of_peer in mine if not rule_of_peer.rule.allows]
        meeting: dict[_RuleKind, list[tuple[tuple[Message, ...], RuleKeys]]] = {}
        for remote, theirs in self._rules.items():
            shared: dict[_RuleKind, tuple[str, ...]] = {}
            are_apart = self._plain[own_name].isdisjoint(self._plain[remote])
            for kind, _, keys in theirs:
                if kind not in meeting:
                    meeting[kind] = [
                        (messages, rule_of_peer.keys)
                        for rule_of_peer in mine
                        if (messages := _shared_messages(kind, rule_of_peer.kind))
                    ]
                for messages, other_keys in meeting[kind]:
                    if are_apart and keys.is_plain and other_keys.is_plain:
                        continue
                    if common_keys := keys.common(other_keys):
                        common = (kind[0], messages, True)
                        shared[common] = _added_keys(shared.get(common, ()), common_keys)
            for kind, rule, _ in (
                *(rule_of_peer for rule_of_peer in theirs if not rule_of_peer.rule.allows),
                *denied,
            ):
                shared[kind] = _added_keys(shared.get(kind, ()), rule.key_expressions)
            rules = (
                AccessRule(flow, messages, keys, allows)
                for (flow, messages, allows), keys in shared.items()
            )
            yield RemoteRights(remote, sorted_rules(rules))


_RuleKind = tuple[Flow, tuple[Message, ...], bool]
"""The direction and messages of a rule, and whether the rule allows the messages."""


class _RuleOfPeer(NamedTuple):
    kind: _RuleKind
    rule: AccessRule
    keys: RuleKeys

    @classmethod
    def of_rights(cls, rights: RemoteRights) -> list[_RuleOfPeer]:
        return [
            cls((rule.flow, rule.messages, rule.allows), rule, rights.keys_of(rule))
            for rule in rights.rules
        ]


def _shared_messages(first: _RuleKind, second: _RuleKind) -> tuple[Message, ...]:
    """Return the messages that both rules allow in the same direction."""
    if first[0] is not second[0] or not (first[2] and second[2]):
        return ()
    return tuple(message for message in first[1] if message in second[1])


def _added_keys(first_keys: tuple[str, ...], second_keys: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted({*first_keys, *second_keys})) if first_keys else second_keys


def narrowed_rights(
    rights: RemoteRights, limit: Iterable[AccessRule], graph_prefix: str
) -> RemoteRights:
    """Return the part of ``rights`` that the rules in ``limit`` also allow.

    Rules for graph tokens are not narrowed, because the names of nodes and topics are only parts
    of their keys. These keys begin with ``graph_prefix``.

    Raises:
        TooManyExpressions: the result needs too many key expressions.
    """
    graph = [rule for rule in rights.rules if rule.key_expressions[0].startswith(graph_prefix)]
    other_rules = tuple(rule for rule in rights.rules if rule not in graph)
    limiting_rights = RemoteRights("", tuple(rule.mirrored() for rule in limit))
    other_rights = RemoteRights(rights.common_name, other_rules, rights.differences)
    common_rights, _ = RightsBetween((other_rights, limiting_rights)).rights_for_others("")
    return RemoteRights(rights.common_name, sorted_rules((*graph, *common_rights.rules)))


def is_within(remote: RemoteRights, own_rights: RemoteRights) -> bool:
    """Return whether the rights of a remote process allow nothing beyond ``own_rights``."""
    mine, theirs = AccessControl((own_rights,)), AccessControl((remote,))
    return all(
        mine.allows(own_rights.common_name, rule.flow.opposite(), message, key)
        or not theirs.allows(remote.common_name, rule.flow, message, key)
        or any(
            message in answering.messages and own_rights.keys_of(answering).include(key)
            for answering in own_rights.rules
            if answering.flow is rule.flow.opposite()
        )
        for rule in remote.rules
        if rule.allows
        for message in rule.messages
        for key in rule.key_expressions
    )


_MESSAGE_ORDER = {message: number for number, message in enumerate(Message)}


@lru_cache(maxsize=64)  # the rules of all enclaves have the same few directions and messages
def _rule_order(flow: Flow, messages: tuple[Message, ...]) -> tuple[bool, list[int]]:
    return flow is Flow.EGRESS, [_MESSAGE_ORDER[message] for message in messages]


@dataclass(frozen=True, slots=True)
class Remote:
    """The properties of a remote process for access control; None for a missing property.

    ``common_name`` is the first common name in the process's certificate.  ``link_protocol`` is a
    protocol such as "tls".  ``interfaces`` are the network interfaces of this host that the
    connection uses.
    """

    common_name: str | None = None
    link_protocol: str | None = "tls"
    username: str | None = None
    interfaces: tuple[str, ...] = ()
    zid: str | None = None


@dataclass(frozen=True, slots=True)
class AclRule:
    """A rule that allows or denies messages in some directions, on some keys.

    ``key_expressions`` are the keys, perhaps with wildcards.  ``line`` is the line of the rule in
    the file.
    """

    id: str
    allows: bool
    flows: tuple[Flow, ...]
    messages: tuple[Message, ...]
    key_expressions: tuple[str, ...]
    line: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class AclSubject:
    """The remote processes that have one of the listed values for each property.

    None in place of a list stands for any value.
    """

    id: str
    cert_common_names: tuple[str, ...] | None = None
    usernames: tuple[str, ...] | None = None
    interfaces: tuple[str, ...] | None = None
    link_protocols: tuple[str, ...] | None = None
    zids: tuple[str, ...] | None = None
    line: int = field(default=0, compare=False)

    def is_named(self) -> bool:
        """Return whether the subject restricts who a process is, and not only its connection."""
        return self.cert_common_names is not None or self.usernames is not None

    def overlaps(self, other: AclSubject) -> bool:
        """Return whether a process can match both subjects, and then has the rights of both.

        The result is False for subjects that restrict the same properties: a value that both list
        is one subject for Zenoh, with the rules of both.
        """
        pairs = [(getattr(self, name), getattr(other, name)) for name in PROPERTIES]
        return any((first is None) is not (second is None) for first, second in pairs) and all(
            first is None or second is None or not set(first).isdisjoint(second)
            for first, second in pairs
        )


PROPERTIES = tuple(
    property_.name for property_ in fields(AclSubject) if property_.name not in ("id", "line")
)
"""The names of a subject's properties."""


@dataclass(frozen=True, slots=True)
class AclPolicy:
    """An entry of Zenoh's ``policies``: ids of rules, and ids of the subjects with these rules."""

    rules: tuple[str, ...]
    subjects: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class AccessDecision:
    """Whether a message passes, and the reason.

    ``rules`` are the ids of the deciding rules; () if the default decides. ``subjects`` are the ids
    of all subjects that match the remote process.  ``why`` is the reason, as a clause.
    """

    allowed: bool
    rules: tuple[str, ...]
    subjects: tuple[str, ...]
    why: str


class MessageFilter(Protocol):
    """A decider on the messages of a process: `AccessControl` or `Enforcement`."""

    def decide(self, remote: Remote, flow: Flow, message: Message, key: str) -> AccessDecision:
        """Return whether a message from or to a remote process passes."""

    def key_expressions_of(self, rule: str) -> tuple[str, ...]:
        """Return the key expressions of a rule, by its id."""

    def allowed_keys(self, common_name: str, flow: Flow, message: Message) -> tuple[str, ...]:
        """Return the key expressions that rules allow, including denied ones."""

    def number_of_rules(self, common_name: str) -> int:
        """Return the number of rules for the remote process with this common name."""

    def names(self) -> frozenset[str]:
        """Return the common names for which there are rules."""


_HISTORY_MESSAGES = (Message.PUT, Message.QUERY)

_Combination = tuple[str | None, ...]
"""A value for each of `PROPERTIES`; None stands for any value."""


@dataclass(frozen=True)
class Enforcement:
    """The access control of a process by any Zenoh configuration, also one not written by sros."""

    enabled: bool = False
    allows_by_default: bool = False
    rules: tuple[AclRule, ...] = ()
    subjects: tuple[AclSubject, ...] = ()
    policies: tuple[AclPolicy, ...] = ()

    def rules_of(self, subject: str) -> tuple[AclRule, ...]:
        """Return the rules that policies apply to a subject, by its id."""
        return self._rules_of.get(subject, ())

    def subjects_of(self, remote: Remote) -> tuple[AclSubject, ...]:
        """Return the subjects that match a remote process, in the order of the file."""
        ids = {
            subject_id
            for combination in self._matching_subjects(remote)
            for subject_id in self._combinations[combination]
        }
        return tuple(subject for subject in self.subjects if subject.id in ids)

    def names(self) -> frozenset[str]:
        """Return the common names in subjects: the enclaves that have rules."""
        return frozenset(
            name for subject in self.subjects for name in subject.cert_common_names or ()
        )

    def unclear_reason(self) -> str:
        """Return a clause on why the common name alone does not decide, or ""."""
        for subject in self.subjects:
            stated = {name for name in PROPERTIES if getattr(subject, name) is not None}
            if subject.cert_common_names is not None and len(stated) > 1:
                conditions = ", ".join(sorted(stated - {"cert_common_names"}))
                return (
                    f"its subject {subject.id[:80]!r} has conditions besides the name: {conditions}"
                )
        if any(
            not rule.allows and set(rule.messages) != {Message.LIVELINESS_TOKEN}
            for rule in self.rules
        ):
            return "it has deny rules, which do not apply to messages with wildcards"
        for subject in self.subjects:
            if key := self._history_only_key(subject.id):
                return (
                    f"its subject {subject.id[:80]!r} gets only earlier messages (the history) of "
                    f"{key[:80]!r}"
                )
        return ""

    def _history_only_key(self, subject: str) -> str:
        """Return a key on which only the history (``@adv``) passes for a subject, or ""."""
        keys: dict[Flow, list[str]] = {flow: [] for flow in Flow}
        history: dict[Flow, set[str]] = {flow: set() for flow in Flow}
        for rule in self.rules_of(subject):
            for flow, message in product(rule.flows, rule.messages):
                if message not in _HISTORY_MESSAGES:
                    continue
                # A process that asks for a history gets what the other direction lets pass.
                other = Flow.EGRESS if flow is Flow.INGRESS else Flow.INGRESS
                for key in rule.key_expressions:
                    begin, of_history, _ = key.partition("/@adv")
                    if of_history:
                        history[flow if message is Message.PUT else other].add(begin)
                    elif message is Message.PUT:
                        keys[flow].append(key)
        for flow, begins in history.items():
            exact = set(keys[flow])
            for begin in sorted(begins - exact):
                if not any(includes(key, begin) for key in keys[flow]):
                    return begin
        return ""

    def decide(self, remote: Remote, flow: Flow, message: Message, key: str) -> AccessDecision:
        """Return whether a message from or to a remote process passes.

        ``key`` is the key or key expression of the message: a rule applies if one of its key
        expressions includes the whole ``key``.  Subjects with the same values count as one subject,
        in which DENY wins.  If several subjects match, it is enough that one subject allows the
        message. With the default ALLOW, a subject allows the message unless a rule of the subject
        denies the message.
        """
        if not self.enabled:
            return AccessDecision(True, (), (), "access control is off")
        subjects = tuple(subject.id for subject in self.subjects_of(remote))
        default = "ALLOW" if self.allows_by_default else "DENY"
        if not self._rules_of:
            return self._default_decision(
                subjects, f"no rule is in force, and the default is {default}"
            )
        if not subjects:
            return self._default_decision((), f"no subject matches, and the default is {default}")
        denying: list[str] = []
        for combination in self._matching_subjects(remote):
            applying = [
                rule
                for rule in self._in_force[combination].get((flow, message), ())
                if any(includes(wide, key) for wide in rule.key_expressions)
            ]
            denied = [rule.id for rule in applying if not rule.allows]
            allowed = [rule.id for rule in applying if rule.allows]
            if denied:
                denying += denied
            elif allowed or self.allows_by_default:
                why = f"rule {allowed[0]} allows it" if allowed else "the default is ALLOW"
                return AccessDecision(True, _unique_ids(allowed), subjects, why)
        if denying:
            return AccessDecision(
                False, _unique_ids(denying), subjects, f"rule {denying[0]} denies it"
            )
        return AccessDecision(False, (), subjects, _NO_RULE)

    def key_expressions_of(self, rule: str) -> tuple[str, ...]:
        """Return the key expressions of a rule, by its id."""
        return next(stated.key_expressions for stated in self.rules if stated.id == rule)

    def allowed_keys(self, common_name: str, flow: Flow, message: Message) -> tuple[str, ...]:
        """Return the key expressions that the rules of subjects with this common name allow."""
        return tuple(
            key
            for subject in self.subjects
            if common_name in (subject.cert_common_names or ())
            for rule in self.rules_of(subject.id)
            if rule.allows and flow in rule.flows and message in rule.messages
            for key in rule.key_expressions
        )

    def number_of_rules(self, common_name: str) -> int:
        """Return the number of rules of the subjects with this common name."""
        return sum(
            len(self.rules_of(subject.id))
            for subject in self.subjects
            if common_name in (subject.cert_common_names or ())
        )

    def passing(
        self,
        remote: Remote,
        flow: Flow,
        message: Message,
        names_of_keys: Callable[[Iterable[str]], NameSet],
    ) -> NameSet:
        """Return the keys, without wildcards, on which `decide` lets a message pass.

        ``names_of_keys`` maps key expressions to a set of names: the included keys, or names that
        stand for these keys.
        """
        all_names = ~NameSet()
        if not self.enabled:
            return all_names
        combinations = self._matching_subjects(remote)
        if not self._rules_of or not combinations:
            return all_names if self.allows_by_default else NameSet()
        passing = []
        for combination in combinations:
            rules = self._in_force[combination].get((flow, message), ())
            denied = names_of_keys(
                key for rule in rules if not rule.allows for key in rule.key_expressions
            )
            allowed = names_of_keys(
                key for rule in rules if rule.allows for key in rule.key_expressions
            )
            passing.append((all_names if self.allows_by_default else allowed) - denied)
        return NameSet.union(passing)

    def _default_decision(self, subjects: tuple[str, ...], why: str) -> AccessDecision:
        return AccessDecision(self.allows_by_default, (), subjects, why)

    @cached_property
    def _combinations(self) -> Mapping[_Combination, tuple[str, ...]]:
        """Map combinations of property values to the ids of the subjects that list the values."""
        ids_of: dict[_Combination, list[str]] = {}
        for subject in self.subjects:
            values = (getattr(subject, name) or (None,) for name in PROPERTIES)
            for combination in product(*values):
                ids_of.setdefault(combination, []).append(subject.id)
        return {values: _unique_ids(subjects) for values, subjects in ids_of.items()}

    @cached_property
    def _rules_of(self) -> Mapping[str, tuple[AclRule, ...]]:
        rules = {rule.id: rule for rule in self.rules}
        rules_of: dict[str, dict[str, AclRule]] = {}
        for policy in self.policies:
            for subject in policy.subjects:
                rules_of.setdefault(subject, {}).update(
                    (rule, rules[rule]) for rule in policy.rules
                )
        return {subject: tuple(of.values()) for subject, of in rules_of.items()}

    @cached_property
    def _in_force(
        self,
    ) -> Mapping[_Combination, Mapping[tuple[Flow, Message], tuple[AclRule, ...]]]:
        in_force: dict[_Combination, dict[tuple[Flow, Message], dict[str, AclRule]]] = {}
        for combination, ids in self._combinations.items():
            of = in_force.setdefault(combination, {})
            for rule in (rule for subject in ids for rule in self.rules_of(subject)):
                for place in product(rule.flows, rule.messages):
                    of.setdefault(place, {})[rule.id] = rule
        return {
            combination: {place: tuple(rules.values()) for place, rules in of.items()}
            for combination, of in in_force.items()
        }

    @cached_property
    def _combinations_by_name(self) -> Mapping[str | None, tuple[_Combination, ...]]:
        by_name: dict[str | None, list[_Combination]] = {}
        for combination in self._combinations:
            by_name.setdefault(combination[0], []).append(combination)
        return {name: tuple(of) for name, of in by_name.items()}

    def _matching_subjects(self, remote: Remote) -> list[_Combination]:
        values: tuple[tuple[str | None, ...], ...] = (
            (remote.common_name,),
            (remote.username,),
            remote.interfaces,
            (remote.link_protocol,),
            (remote.zid,),
        )
        by_name = self._combinations_by_name
        named = () if remote.common_name is None else by_name.get(remote.common_name, ())
        return [
            combination
            for combination in (*named, *by_name.get(None, ()))
            if all(
                wanted is None or wanted in value
                for wanted, value in zip(combination, values, strict=True)
            )
        ]


def _unique_ids(ids: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(ids))
