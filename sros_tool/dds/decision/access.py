"""The access control of one vendor: who may join, publish and subscribe, and why.

The governance and the permissions of a participant decide.  A decision chooses the grant of the
subject (`choose_grant`), takes the grant's rules for the domain (`_rules_for`), applies these rules
to a topic (`_GrantRules`), and combines the result with the access control that the governance
requires (`GovernedDomain`, `_decide_join`, `Access`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime, tzinfo
from enum import Enum, StrEnum, auto
from functools import cache, cached_property, lru_cache
from itertools import groupby, takewhile
from string import ascii_letters, digits
from typing import TYPE_CHECKING, Annotated, NamedTuple

from sros_tool.dds.decision.expressions import ExpressionIndex, matches
from sros_tool.dds.decision.grants import ComparisonCrash, certified_text, read_date, same_subject
from sros_tool.dds.decision.vendors import (
    DateRule,
    DenyPartitions,
    OpenRange,
    Style,
    TopicNames,
    Vendor,
    VendorTraits,
)
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, ProtectionKind, TopicRule
from sros_tool.dds.permissions import Criteria, Grant, Permissions, Rule, size_of_topic
from sros_tool.values import shows

if TYPE_CHECKING:
    from sros_tool.automata import NameSet


class AccessVerb(StrEnum):
    """An action of a participant that access control allows or denies."""

    JOIN = "join"
    PUBLISH = "publish"
    SUBSCRIBE = "subscribe"


class Outcome(StrEnum):
    """The outcome for a participant or endpoint."""

    ALLOWED = "allowed"
    DENIED = "denied"
    """The participant cannot create the endpoint."""
    PEER_DENIES = "peer denies"
    """The participant or endpoint is created, but peers refuse to communicate with it."""
    REFUSED = "refused"
    """The participant does not start."""
    CRASHES = "crashes"
    """The participant's process crashes, or the processes of peers do (`Decision.hits_peers`)."""

    @property
    def ok(self) -> bool:
        """Whether data can flow."""
        return self is Outcome.ALLOWED


OutcomeWord = Annotated[
    Outcome,
    "What happens: nothing stops the access (`allowed`), the endpoint is not created (`denied`), "
    "peers do not match the endpoint (`peer denies`), the process does not start (`refused`), or "
    "the process or its peers crash (`crashes`).",
]
ReasonWord = Annotated[str, "Reason of the decision, as a stable word such as `no-rule`."]


@shows("outcome", "reason", "expression")
class Decision(NamedTuple):
    """The outcome of a question to access control, with the deciding rule.

    ``reason`` is a fixed word for programs (one of `_REASONS`), ``text`` a sentence for people.
    ``grant`` is an index in the permissions, and ``rule`` an index in the grant. ``expression`` is
    the ``<topic>`` that matched, and ``topic_rule`` the governance rule for the topic. With
    ``hits_peers``, the processes of peers crash, but not the participant's own process.
    """

    outcome: OutcomeWord
    reason: ReasonWord
    text: str
    grant: int | None = None
    rule: int | None = None
    expression: Annotated[str | None, "The expression that decided, or null."] = None
    topic_rule: TopicRule | None = None
    hits_peers: bool = False

    @property
    def clause(self) -> str:
        """The text without the vendor's name at the beginning, and without full stop."""
        _, colon, text = self.text.partition(": ")
        return (text if colon else self.text).removesuffix(".")


_REASONS = {
    "allow-rule": "an allow rule matches",
    "deny-rule": "a deny rule matches",
    "partition": "the rule that decides does not name the partitions of the endpoint",
    "default": "no rule matches, so the default of the grant decides",
    "no-rule": "no rule allows the access, and the vendor ignores the default",
    "unrestricted": "the governance does not control this access",
    "no-topic-rule": "no topic rule of the governance matches the topic",
    "domain-not-in-governance": "no domain rule of the governance lists the domain",
    "peer-refuses-participant": "peers do not accept the participant in this domain",
    "no-grant": "no grant names the subject",
    "empty-subject": "a certificate with an empty subject crashes the process",
    "blank-subject": "a grant whose subject has a part of only blanks crashes the process",
    "not-yet-valid": "the grant of the subject is not valid yet",
    "expired": "the grant of the subject has expired",
    "malformed": "the vendor does not accept a document",
    "unauthenticated-with-rtps-protection": "the governance allows unauthenticated participants, "
    "but protects RTPS messages",
    "long-name": "the name of the topic is too long for peers",
    "invalid-name": "the vendor does not accept the name of the topic",
    "open-range": "a range of domains without <min> crashes the process",
    "empty-topic": "an expression without text crashes the process",
    "empty-default": "a default without text crashes the process",
}
"""Every reason and its meaning."""


class Refusal(NamedTuple):
    """The reason that a vendor does not accept a document; ``outcome`` is REFUSED or CRASHES."""

    reason: str
    text: str
    outcome: Outcome = Outcome.REFUSED

    def decision(self) -> Decision:
        """Return this refusal as a decision, which applies to any access."""
        return Decision(self.outcome, self.reason, self.text)


def choose_grant(
    traits: VendorTraits, permissions: Permissions, subject: str, *, moment: datetime, zone: tzinfo
) -> int | Refusal:
    """Return the index of the grant that decides for ``subject``, or a `Refusal` if none does."""
    if not subject and traits.crashes_on_empty_subject:
        text = f"{traits.title} fails with an error on a certificate with an empty subject."
        return Refusal("empty-subject", text, Outcome.CRASHES)
    now = moment.timestamp()
    outdated: Refusal | None = None
    certified = certified_text(traits, subject)
    states = [
        _validity_refusal(traits, index, grant, now, zone)
        for index, grant in enumerate(permissions.grants)
    ]
    for state in states:
        # A malformed date counts even in a grant for another subject.
        if state and state.reason == "malformed":
            return state
    for index, (grant, state) in enumerate(zip(permissions.grants, states, strict=True)):
        granted = grant.subject.strip() if traits.trims_texts else grant.subject
        try:
            if not same_subject(traits.subjects, granted, certified):
                continue
        except ComparisonCrash:
            if state:  # the subject of this grant is not compared
                continue
            text = (
                f"{traits.title} ends with an error when it compares the grant for {granted!r} "
                f"with the subject {subject!r}."
            )
            return Refusal("blank-subject", text, Outcome.CRASHES)
        if state is None:
            return index
        if not traits.passes_over_outdated_grants:
            return state
        outdated = outdated or state
    return outdated or Refusal(
        "no-grant", f"{traits.title}: no grant of the permissions names the subject {subject!r}."
    )


def _validity_refusal(
    traits: VendorTraits, index: int, grant: Grant, now: float, zone: tzinfo
) -> Refusal | None:
    """Return the refusal of a grant that is not valid at the moment ``now``, or None."""
    begin = read_date(traits.date_rule, grant.not_before, zone)
    end = read_date(traits.date_rule, grant.not_after, zone)
    name = f"grant {grant.name!r}" if grant.name else f"grant {index + 1}"
    if begin is None or end is None:
        wrong = grant.not_before if begin is None else grant.not_after
        return Refusal("malformed", f"{traits.title} cannot read the date {wrong!r} of {name}.")
    how = " (read in the host's local time)" if traits.date_rule is DateRule.LOCAL else ""
    # Fast DDS counts whole seconds, and a grant is valid at both ends; in Cyclone DDS, at neither.
    strict = traits.date_rule is DateRule.CYCLONE
    if now < begin or (strict and now == begin):
        return Refusal(
            "not-yet-valid", f"{traits.title}: {name} is valid only from {grant.not_before}{how}."
        )
    seconds = int(now) if traits.date_rule is DateRule.LOCAL else now
    if seconds > end or (strict and now == end):
        return Refusal("expired", f"{traits.title}: {name} expired at {grant.not_after}{how}.")
    return None


def includes_domain(rule: OpenRange, domains: DomainSet, domain: int) -> bool | None:
    """Return whether ``domain`` is in ``domains``; None if the check crashes the vendor's process.

    ``rule`` gives the meaning of a range with only a minimum or only a maximum.
    """
    for part in domains.ranges:
        first, last = part.first, part.last
        if first is None:
            if rule is OpenRange.CRASHES:
                return None
            first = 0
        if last is None:
            last = first if rule is not OpenRange.OPEN else domain
        elif last == 0 and rule is OpenRange.SINGLE:
            last = first  # Fast DDS stores 0 for a missing maximum
        if first <= domain <= last:
            return True
    return False


_DEFAULT_PARTITION = ("",)
NumberedRule = tuple[int, Rule]
"""A rule with its index in the grant."""


class RuleVerdict(NamedTuple):
    """The verdict of a grant's rules, with the reason, the rule and the expression that decided.

    The outcome is ALLOWED, DENIED or CRASHES.
    """

    outcome: Outcome
    reason: str
    rule: int | None = None
    expression: str | None = None

    @property
    def allowed(self) -> bool:
        """Whether the rules allow the access."""
        return self.outcome is Outcome.ALLOWED


class _TopicEntry(NamedTuple):
    """A ``<topic>`` of a rule, with the ``partitions`` that the vendor compares for the topic.

    ``rule`` is the index of the rule in the grant; ``criteria_index`` is equal for all topics of
    the same criteria.
    """

    criteria_index: int
    rule: int
    allow: bool
    expression: str
    partitions: tuple[str, ...]

    def verdict(self, *, fits: bool) -> RuleVerdict:
        if not self.expression:
            return RuleVerdict(Outcome.CRASHES, "empty-topic", self.rule)
        if not self.allow:
            return RuleVerdict(Outcome.DENIED, "deny-rule", self.rule, self.expression)
        if not fits:
            return RuleVerdict(Outcome.DENIED, "partition", self.rule, self.expression)
        return RuleVerdict(Outcome.ALLOWED, "allow-rule", self.rule, self.expression)


def _rules_for(
    traits: VendorTraits, grant: Grant, domain: int
) -> tuple[list[NumberedRule], RuleVerdict]:
    """Return the grant's rules for ``domain``, and the verdict if no rule matches a topic."""
    rules: list[NumberedRule] = []
    for index, rule in enumerate(grant.rules):
        holds = includes_domain(traits.open_range, rule.domains, domain)
        if holds is None:
            # Before Cyclone DDS uses a rule, it looks for the next one, so the crash hides the last
            # rule.
            return rules[:-1], RuleVerdict(Outcome.CRASHES, "open-range", index)
        if holds:
            rules.append((index, rule))
    return rules, _default_verdict(traits, grant)


def _default_verdict(traits: VendorTraits, grant: Grant) -> RuleVerdict:
    """Return the verdict by the grant's ``<default>``, which decides if no rule matches."""
    if not traits.honors_default:
        return RuleVerdict(Outcome.DENIED, "no-rule")
    if traits.crashes_on_empty_texts and grant.default_empty:
        return RuleVerdict(Outcome.CRASHES, "empty-default")
    return RuleVerdict(Outcome.ALLOWED if grant.default_allow else Outcome.DENIED, "default")


class _GrantRules:
    """The rules of a grant in order: for publishing, for subscribing, or for both."""

    def __init__(
        self,
        traits: VendorTraits,
        rules: Sequence[NumberedRule],
        otherwise: RuleVerdict,
        *verbs: str,
    ) -> None:
        """Keep the criteria for ``verbs``; ``otherwise`` is the verdict if no rule matches."""
        self._traits = traits
        self._rules = rules
        self._otherwise = otherwise
        self._verbs = verbs

    @cached_property
    def _entries(self) -> Sequence[_TopicEntry]:
        """The ``<topic>`` elements of the rules, in order."""
        traits = self._traits
        entries: list[_TopicEntry] = []
        count = 0
        for index, rule in self._rules:
            for verb, criterion in rule.criteria_of(self._verbs):
                count += 1
                # Fast DDS joins the partitions of all criteria of a verb in a rule.
                joined = getattr(rule, verb) if traits.topic_decides else (criterion,)
                weighed = _partitions(traits, rule, joined)
                entries += [
                    _TopicEntry(count, index, rule.allow, _trimmed(traits, expression), weighed)
                    for expression in criterion.topics
                    if _trimmed(traits, expression) or traits.crashes_on_empty_texts
                ]
        return entries

    @cached_property
    def _index(self) -> ExpressionIndex:
        """An index that finds the entries matching a topic."""
        texts = (_usable_expression(self._traits, entry.expression) for entry in self._entries)
        return ExpressionIndex(self._traits.style, texts)

    def ask(self, topic: str, partitions: tuple[str, ...]) -> RuleVerdict:
        """Return the verdict on an endpoint of ``topic``; () means the default partition."""
        wanted = partitions or _DEFAULT_PARTITION
        passed = 0
        for position in self._index.matching(topic):
            entry = self._entries[position]
            if entry.criteria_index == passed:
                continue  # of each criteria, only the first matching topic counts
            passed = entry.criteria_index
            fits = self._matches_partitions(entry, wanted)
            if fits or self._traits.topic_decides or not entry.expression:
                return entry.verdict(fits=fits)
        return self._otherwise

    def ask_topic(self, topic: str) -> RuleVerdict:
        """Return the verdict on a topic; partitions are ignored."""
        position = self._index.first(topic)
        if position is None:
            return self._otherwise
        return self._entries[position].verdict(fits=True)

    def crash_verdict(self, topic: str) -> RuleVerdict | None:
        """Return the verdict that a process crashes when it reads all criteria for a topic.

        Returns None if the process does not crash.
        """
        passed = 0
        for position in self._index.matching(topic):
            entry = self._entries[position]
            if entry.criteria_index != passed and not entry.expression:
                return entry.verdict(fits=True)
            passed = entry.criteria_index
        return None

    def only_allows(self) -> bool:
        """Return whether no rule denies a topic or crashes the process."""
        return all(entry.allow and entry.expression for entry in self._entries)

    def safe_names(self) -> NameSet:
        """Return the topics for which `crash_verdict` returns None."""
        from sros_tool.automata import NameSet

        groups = groupby(self._entries, key=lambda entry: entry.criteria_index)
        crashing = [self._crashing_topics(list(group)) for _, group in groups]
        return _every_topic() - NameSet.union(filter(None, crashing))

    def _crashing_topics(self, group: Sequence[_TopicEntry]) -> NameSet | None:
        """Return the topics for which reading these criteria crashes the process, or None.

        An empty ``<topic>`` crashes the process, unless an earlier ``<topic>`` of the criteria
        matches.
        """
        before = list(takewhile(lambda entry: entry.expression, group))
        return _every_topic() - self._names_of(before) if len(before) < len(group) else None

    def names(self) -> NameSet:
        """Return the topics that `ask` allows in the default partition."""
        from sros_tool.automata import NameSet

        rules: list[tuple[NameSet, bool]] = []
        for _, entries in groupby(self._entries, key=lambda entry: entry.criteria_index):
            group = list(entries)
            fits = self._matches_partitions(group[0], _DEFAULT_PARTITION)
            if fits or self._traits.topic_decides:
                rules += [
                    (names, allowed and fits) for names, allowed in self._decisions_by_topic(group)
                ]
                continue
            if crashing := self._crashing_topics(group):
                rules.append((crashing, False))
        return NameSet.first(rules, self._otherwise.allowed)

    def topic_names(self) -> NameSet:
        """Return the topics that `ask_topic` allows."""
        from sros_tool.automata import NameSet

        return NameSet.first(self._decisions_by_topic(self._entries), self._otherwise.allowed)

    def _decisions_by_topic(self, entries: Iterable[_TopicEntry]) -> Iterator[tuple[NameSet, bool]]:
        """Yield sets of topics, in the order of the rules, and whether the topics are allowed.

        Consecutive entries with the same verdict are joined.
        """
        for allowed, group in groupby(
            entries, key=lambda entry: entry.allow and bool(entry.expression)
        ):
            yield self._names_of(group), allowed

    def _names_of(self, entries: Iterable[_TopicEntry]) -> NameSet:
        texts = tuple([_usable_expression(self._traits, entry.expression) for entry in entries])
        return _cached_names(self._traits.style, texts)

    def _matches_partitions(self, entry: _TopicEntry, wanted: tuple[str, ...]) -> bool:
        style, named = self._traits.style, entry.partitions
        if entry.allow:
            if wanted is _DEFAULT_PARTITION is named:
                return True
            return all(_any_matches(style, named, partition) for partition in wanted)
        if self._traits.deny_partitions is DenyPartitions.IGNORED:
            return True
        return any(_any_matches(style, named, partition) for partition in wanted)


@lru_cache(maxsize=8192)  # several vendors and enclaves have the same expressions
def _cached_names(style: Style, texts: tuple[str, ...]) -> NameSet:
    from sros_tool.dds.decision.expressions import names_of

    return names_of(style, texts)


def _any_matches(style: Style, expressions: tuple[str, ...], partition: str) -> bool:
    return any(matches(style, expression, partition) for expression in expressions)


def _usable_expression(traits: VendorTraits, text: str) -> str:
    """Return an expression as the vendor reads it.

    An empty expression becomes ``*`` for vendors that crash on it, because they crash for every
    name.
    """
    text = _trimmed(traits, text)
    return text or "*" if traits.crashes_on_empty_texts else text


def _trimmed(traits: VendorTraits, text: str) -> str:
    """Return the text of an element, without surrounding spaces if the vendor ignores them."""
    return text.strip(" \t\v\r\n") if traits.trims_texts else text


def _partitions(
    traits: VendorTraits, rule: Rule, criteria: tuple[Criteria, ...]
) -> tuple[str, ...]:
    """Return the partitions that ``criteria`` name, or else the vendor's default partitions."""
    everywhere = not rule.allow and traits.deny_partitions is DenyPartitions.ANY_OR_ALL
    implied = ("*",) if everywhere else _DEFAULT_PARTITION
    if implied is _DEFAULT_PARTITION and not any(criterion.partitions for criterion in criteria):
        return _DEFAULT_PARTITION
    names = [text for criterion in criteria for text in criterion.partitions or implied]
    return tuple(dict.fromkeys(_trimmed(traits, text) for text in names))


def is_open_to_unauthenticated(domain: DomainRule, topic: TopicRule, vendor: Vendor) -> bool:
    """Return whether participants without an identity may use the topics of a topic rule."""
    traits = vendor.traits
    if not domain.allow_unauthenticated_participants or traits.ignores_unauthenticated:
        return False
    hides = (
        not traits.controls_unauthenticated
        or domain.discovery_protection_kind is not ProtectionKind.NONE
    )
    controls = topic.enable_read_access_control or topic.enable_write_access_control
    return (
        not (traits.controls_unauthenticated and controls)
        and not (topic.enable_discovery_protection and hides)
        and all(
            kind is ProtectionKind.NONE
            for kind in (
                domain.rtps_protection_kind,
                topic.metadata_protection_kind,
                topic.data_protection_kind,
            )
        )
    )


class GovernedDomain:
    """The governance of a domain, as a vendor applies it to all subjects.

    ``rule`` is the first domain rule that lists the domain, or None.
    """

    def __init__(self, vendor: Vendor, governance: Governance, domain: int) -> None:
        self.vendor = vendor
        self.governance = governance
        self.domain = domain
        self._traits = traits = vendor.traits
        self.rule: DomainRule | None = None
        for rule in governance.domain_access_rules:
            if includes_domain(traits.open_range, rule.domains, domain):
                self.rule = rule
                break
        self._topic_rules = self.rule.topic_access_rules if self.rule else ()
        self._topics = ExpressionIndex(
            traits.style,
            (_usable_expression(traits, rule.topic_expression) for rule in self._topic_rules),
            both_ways=traits.governance_both_ways,
        )

    def topic_rule(self, topic: str) -> TopicRule | None:
        """Return the first topic rule that matches; None if no rule does."""
        position = self._topics.first(topic)
        return None if position is None else self._topic_rules[position]

    def names_by_rule(self) -> Iterator[tuple[NameSet, TopicRule]]:
        """Yield each topic rule in order, with the topics that its expression matches."""
        for rule in self._topic_rules:
            text = _usable_expression(self._traits, rule.topic_expression)
            yield _cached_names(self._traits.style, (text,)), rule

    def topics_of_unauthenticated(self) -> NameSet | None:
        """Return the topics that participants without an identity may write and read, or None.

        None means that there are no such topics.
        """
        domain = self.rule
        if domain is None or not domain.allow_unauthenticated_participants:
            return None
        from sros_tool.automata import NameSet

        rules = [
            (names, is_open_to_unauthenticated(domain, rule, self.vendor))
            for names, rule in self.names_by_rule()
        ]
        return NameSet.first(rules) if any(is_open for _, is_open in rules) else None

    def all_controlled(self) -> bool:
        """Return whether every topic rule controls reading and writing."""
        return all(
            rule.enable_read_access_control and rule.enable_write_access_control
            for rule in self._topic_rules
        )


def _verdict_text(
    verdict: RuleVerdict, asked_access: str, domain: int, *, by_peers: bool = False
) -> str:
    """Return ``verdict`` on ``asked_access``, such as ``publish rt/a``, as a clause.

    ``by_peers`` says that the participant itself allows the access, and its peers deny it.
    """
    rule = "" if verdict.rule is None else f"rule {verdict.rule + 1}"
    peers = f" for domain {domain}, and peers deny the access" if by_peers else ""
    match verdict.reason:
        case "allow-rule":
            return f"{rule} allows {asked_access} by {verdict.expression}"
        case "deny-rule":
            return f"{rule} denies {asked_access} by {verdict.expression}{peers}"
        case "partition":
            names = f"{rule} names {verdict.expression}"
            return f"{names}, but not the partitions of {asked_access}{peers}"
        case "default":
            word = "ALLOW" if verdict.allowed else "DENY"
            return f"no rule names {asked_access}, and the grant's default is {word}"
        case "open-range":
            return f"{rule} has a range of domains without <min>, which crashes the process"
        case "empty-topic":
            return f"{rule} has a <topic> without text, which crashes the process"
        case "empty-default":
            return "the grant's <default> is empty, which crashes the process"
        case _:
            return f"no rule allows {asked_access}{peers}"


class _Joining(NamedTuple):
    """The outcome of joining a domain, with a reason word for programs and a clause for people."""

    outcome: Outcome
    reason: str
    text: str
    hits_peers: bool = False


def _decide_join(
    traits: VendorTraits,
    governed: GovernedDomain,
    grant: Grant,
    rules: list[NumberedRule],
    otherwise: RuleVerdict,
) -> _Joining:
    """Return the outcome of joining a domain, by the governance and the rules of a grant.

    If no rule in ``rules`` matches, ``otherwise`` decides.
    """
    where = f"domain {governed.domain}"
    if traits.always_needs_allow_rule and not any(rule.allow for rule in grant.rules):
        text = "the grant has no allow rule, so the participant does not start"
        return _Joining(Outcome.REFUSED, "no-rule", text)
    rule = governed.rule
    if rule is None:
        text = f"the governance does not list {where}"
        if traits.needs_domain_rule:
            return _Joining(Outcome.REFUSED, "domain-not-in-governance", text)
        text += "; the participant starts, but no endpoint can be created"
        return _Joining(Outcome.ALLOWED, "domain-not-in-governance", text)
    open_door = rule.allow_unauthenticated_participants
    if traits.refuses_open_rtps and open_door and rule.rtps_protection_kind != ProtectionKind.NONE:
        text = "the governance allows unauthenticated participants, but protects RTPS messages"
        return _Joining(Outcome.REFUSED, "unauthenticated-with-rtps-protection", text)
    if not rule.enable_join_access_control:
        text = f"the governance does not control joining {where}"
        return _Joining(Outcome.ALLOWED, "unrestricted", text)
    if any(each.allow for _, each in rules):
        return _Joining(Outcome.ALLOWED, "allow-rule", f"an allow rule covers {where}")
    missing = f"no allow rule of the grant covers {where}"
    opened = not governed.all_controlled() and otherwise.outcome is not Outcome.ALLOWED
    if opened and otherwise.outcome is Outcome.CRASHES:
        # If some topic is not access-controlled, the participant starts without reading its rules;
        # its peers do read them.
        text = _verdict_text(otherwise, f"joining {where}", governed.domain)
        text = text.replace("crashes the process", "crashes the processes of its peers")
        return _Joining(Outcome.CRASHES, otherwise.reason, text, hits_peers=True)
    if traits.always_needs_allow_rule or opened:
        return _Joining(
            Outcome.PEER_DENIES, "no-rule", f"{missing}, so peers refuse the participant"
        )
    if otherwise.outcome is Outcome.DENIED:
        return _Joining(Outcome.REFUSED, "no-rule", missing)
    text = _verdict_text(otherwise, f"joining {where}", governed.domain)
    return _Joining(otherwise.outcome, otherwise.reason, text)


class _DecisionBasis(Enum):
    """The basis of decisions on access to the topics of a governance topic rule."""

    NOTHING = auto()
    """All access is denied."""
    EVERYTHING = auto()
    """All access is allowed."""
    RULES = auto()
    """The grant's rules for the requested direction (publish or subscribe) decide."""
    BOTH_WAYS = auto()
    """The grant's rules must allow both the requested direction and creating the topic."""


@cache
def _every_topic() -> NameSet:
    from sros_tool.automata import NameSet

    return ~NameSet()


_TOPIC_NAMES = {
    TopicNames.WORDS: (f"{ascii_letters}_/", f"{ascii_letters}{digits}_/"),
    TopicNames.PRINTABLE: ("".join(sorted({*map(chr, range(33, 127))} - {*"*?[]\"'#$"})),) * 2,
}
"""Rule → characters that may begin a topic name, and characters that may follow."""


def _is_topic_name(rule: TopicNames, text: str) -> bool:
    if rule is TopicNames.ANY:
        return True
    first, following = _TOPIC_NAMES[rule]
    return text[:1] in first and bool(text) and not text.strip(following)


@cache
def _usable_topics(rule: TopicNames) -> NameSet:
    """Return the topics that `_is_topic_name` accepts, without names that have wildcards."""
    from sros_tool.automata import Automaton, Letters, NameSet

    if rule is TopicNames.ANY:
        return NameSet((), [Automaton(((0, ~Letters.of("*?["), 0),), frozenset((0,)))])
    first, following = map(Letters.of, _TOPIC_NAMES[rule])
    return NameSet((), [Automaton(((0, first, 1), (1, following, 1)), frozenset((1,)))])


_ENDPOINTS = (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)


class GrantedAccess:
    """The access that a grant's rules allow in a domain, regardless of governance and validity.

    The rules are applied by the participant itself and by its peers, and both have to allow the
    access.
    """

    def __init__(self, traits: VendorTraits, grant: Grant, domain: int) -> None:
        """Take the rules of ``grant`` that the vendor applies in ``domain``."""
        self._traits = traits
        self._domain = domain
        self.rules, self.otherwise = _rules_for(traits, grant, domain)
        """The rules for the domain, and the verdict if no rule matches."""
        self._own_rules = self.rules if traits.filters_own_domain else list(enumerate(grant.rules))

    def topics(self, verb: AccessVerb) -> NameSet:
        """Return the topics that the rules allow for ``verb`` in the default partition."""
        allowed = self.own[verb].names()
        return allowed if self.peers is self.own else allowed & self.peers[verb].names()

    def reason(self, verb: AccessVerb, topic: str) -> str:
        """Return a clause that names the rule which allows or denies ``verb`` on a topic.

        The topic is in the default partition.
        """
        verdict, by_peers = self.own[verb].ask(topic, ()), False
        if verdict.allowed and self.peers is not self.own:
            verdict, by_peers = self.peers[verb].ask(topic, ()), True
        return _verdict_text(verdict, f"{verb} {topic}", self._domain, by_peers=by_peers)

    @cached_property
    def own(self) -> dict[AccessVerb, _GrantRules]:
        """The rules in the form in which the participant itself applies them."""
        return {verb: self.deciding_rules(self._own_rules, verb) for verb in _ENDPOINTS}

    @cached_property
    def peers(self) -> dict[AccessVerb, _GrantRules]:
        """The rules in the form in which peers apply them; `own` itself if both are equal."""
        relays = ("relay",) if self._traits.relays_count_for_readers else ()
        if self._own_rules is self.rules and not relays:
            return self.own
        return {
            AccessVerb.PUBLISH: self.deciding_rules(self.rules, AccessVerb.PUBLISH),
            AccessVerb.SUBSCRIBE: self.deciding_rules(self.rules, AccessVerb.SUBSCRIBE, *relays),
        }

    def deciding_rules(self, rules: Sequence[NumberedRule], *verbs: str) -> _GrantRules:
        """Return the rules that decide on ``verbs``, in order."""
        return _GrantRules(self._traits, rules, self.otherwise, *verbs)


class Access:
    """The access control of one vendor for one subject.

    Peers are assumed to have the same governance, clock and time zone, and all rights.
    """

    def __init__(
        self,
        governed: GovernedDomain,
        permissions: Permissions,
        subject: str,
        *,
        moment: datetime,
        zone: tzinfo = UTC,
    ) -> None:
        """Prepare the decisions on ``subject`` (RFC 4514) in a domain at the time ``moment``.

        ``moment`` is timezone-aware, and ``zone`` is the host's time zone.  No error is raised:
        faults of the documents become decisions.
        """
        self._traits = governed.vendor.traits
        self._governed = governed
        self._grant: int | None = None
        chosen = choose_grant(self._traits, permissions, subject, moment=moment, zone=zone)
        if isinstance(chosen, Refusal):
            self._join = chosen.decision()
            return
        self._grant = chosen
        self._prepare(permissions.grants[chosen])

    def decide(
        self, verb: AccessVerb, topic: str = "", partitions: tuple[str, ...] = ()
    ) -> Decision:
        """Return the decision on ``verb``; ``topic`` is the DDS name (``rt/chatter``).

        ``partitions`` are the partitions of the endpoint; () means the default partition.
        """
        return self.join() if verb is AccessVerb.JOIN else self._endpoint(verb, topic, partitions)

    def join(self) -> Decision:
        """Return the decision on the participant: whether it starts and peers accept it."""
        return self._join

    def publish(self, topic: str, partitions: tuple[str, ...] = ()) -> Decision:
        """Return the decision on a DataWriter: whether it is created and peers match it."""
        return self._endpoint(AccessVerb.PUBLISH, topic, partitions)

    def subscribe(self, topic: str, partitions: tuple[str, ...] = ()) -> Decision:
        """Return the decision on a DataReader: whether it is created and peers match it."""
        return self._endpoint(AccessVerb.SUBSCRIBE, topic, partitions)

    def governance_refusal(self, topic: str) -> Decision | None:
        """Return the decision if the governance forbids all endpoints of ``topic``, or None."""
        rule = self._governed.topic_rule(topic)
        if rule is None:
            return self._no_topic_rule_decision(topic)
        if self._traits.crashes_on_empty_texts and not rule.topic_expression.strip():
            text = "a topic rule of the governance is empty, which crashes the process"
            return self._answer(Outcome.CRASHES, "empty-topic", text)
        return None

    def topics(self, verb: AccessVerb) -> NameSet:
        """Return the topics for which `decide` allows ``verb``, without names that have wildcards.

        The topics are in the default partition.  The length of names is not limited.
        """
        return self.ruled_topics(verb) & _usable_topics(self._traits.topic_names)

    def ruled_topics(self, verb: AccessVerb) -> NameSet:
        """Return the topics that the rules allow, including names that are not valid in DDS.

        `topics` leaves these names out, and ROS 2 never uses them. `ruled_topics` includes them, so
        that the sets of two vendors that read documents alike are mostly equal.
        """
        from sros_tool.automata import NameSet

        if self._join.outcome in (Outcome.REFUSED, Outcome.CRASHES) or self._grant is None:
            return NameSet()
        rules = list(self._governed.names_by_rule())
        bases = [self._basis_of(verb, rule) for _, rule in rules]
        topics = (
            NameSet.first(
                (names, each is basis) for (names, _), each in zip(rules, bases, strict=True)
            )
            & self._allowed_topics(verb, basis)
            for basis in dict.fromkeys(bases)
            if basis is not _DecisionBasis.NOTHING
        )
        return NameSet.union(topics)

    def protection(self) -> tuple[tuple[NameSet, DomainRule, TopicRule], ...]:
        """Return the topics, the domain rule and the topic rule for each topic rule of the domain.

        The topics are those to which the topic rule applies.
        """
        domain = self._governed.rule
        if domain is None:
            return ()
        return tuple((names, domain, rule) for names, rule in self._governed.names_by_rule())

    def topics_of_unauthenticated(self) -> NameSet | None:
        """Return the topics that participants without an identity may write and read, or None.

        None means that there are no such topics.
        """
        return self._governed.topics_of_unauthenticated()

    def _basis_of(self, verb: AccessVerb, rule: TopicRule) -> _DecisionBasis:
        """Return the basis of decisions on a topic rule's topics, as in `_decision_by_rules`."""
        if self._traits.crashes_on_empty_texts and not rule.topic_expression.strip():
            return _DecisionBasis.NOTHING
        writes, reads = rule.enable_write_access_control, rule.enable_read_access_control
        refused = self._join.outcome is Outcome.PEER_DENIES
        if not (writes if verb is AccessVerb.PUBLISH else reads):
            return (
                _DecisionBasis.NOTHING
                if refused and not self._can_exchange_unprotected(rule)
                else _DecisionBasis.EVERYTHING
            )
        if refused:
            return _DecisionBasis.NOTHING
        return (
            _DecisionBasis.BOTH_WAYS
            if self._traits.creates_topics and writes and reads
            else _DecisionBasis.RULES
        )

    def _allowed_topics(self, verb: AccessVerb, basis: _DecisionBasis) -> NameSet:
        if basis is _DecisionBasis.EVERYTHING:
            return _every_topic()
        allowed = self._granted.topics(verb)
        # If the rules deny nothing, the rule that allows an endpoint also allows creating its
        # topic.
        if basis is not _DecisionBasis.BOTH_WAYS or self._rules_for_both_directions.only_allows():
            return allowed
        return allowed & self._creatable_names()

    def _prepare(self, grant: Grant) -> None:
        traits = self._traits
        self._granted = GrantedAccess(traits, grant, self._governed.domain)
        rules, otherwise = self._granted.rules, self._granted.otherwise
        joining = _decide_join(traits, self._governed, grant, rules, otherwise)
        self._join = self._answer(joining.outcome, joining.reason, joining.text)._replace(
            hits_peers=joining.hits_peers,
        )

    @cached_property
    def _own(self) -> dict[AccessVerb, _GrantRules]:
        """The grant's rules in the form in which the participant itself applies them."""
        return self._granted.own

    @cached_property
    def _peers(self) -> dict[AccessVerb, _GrantRules]:
        """The grant's rules in the form in which peers apply them; `_own` if both are equal."""
        return self._granted.peers

    @cached_property
    def _rules_for_both_directions(self) -> _GrantRules:
        """The grant's rules for both directions in one list, to decide on creating topics."""
        return self._granted.deciding_rules(self._granted.rules, *_ENDPOINTS)

    def _creation(self, verb: AccessVerb, topic: str) -> RuleVerdict:
        """Return the verdict on creating a topic, which comes before the endpoint for ``verb``."""
        if not self._traits.asks_both_directions:
            return self._rules_for_both_directions.ask_topic(topic)
        directions = sorted(_ENDPOINTS, key=lambda endpoint: endpoint is not verb)
        crashes = (self._own[direction].crash_verdict(topic) for direction in directions)
        verdicts = [self._own[direction].ask_topic(topic) for direction in directions]
        allowed = (verdict for verdict in verdicts if verdict.allowed)
        return next(filter(None, crashes), None) or next(allowed, verdicts[0])

    def _creatable_names(self) -> NameSet:
        """Return the topics that may be created."""
        if not self._traits.asks_both_directions:
            return self._rules_for_both_directions.topic_names()
        publish, subscribe = (self._own[direction] for direction in _ENDPOINTS)
        either = publish.topic_names() | subscribe.topic_names()
        return either & publish.safe_names() & subscribe.safe_names()

    # ── deciding ───────────────────────────────────────────────────────────────────────────

    def _endpoint(self, verb: AccessVerb, topic: str, partitions: tuple[str, ...]) -> Decision:
        join = self._join
        if join.outcome in (Outcome.REFUSED, Outcome.CRASHES) and not join.hits_peers:
            return join
        traits = self._traits
        if not _is_topic_name(traits.topic_names, topic):
            return self._answer(
                Outcome.DENIED, "invalid-name", f"{topic!r} is not a valid topic name"
            )
        decision = self._decision_by_rules(verb, topic, partitions)
        longest = traits.longest_topic_name
        if decision.outcome.ok and longest is not None and size_of_topic(topic) > longest:
            text = f"no peer matches a topic whose name has more than {longest} bytes"
            return decision._replace(
                outcome=Outcome.PEER_DENIES,
                reason="long-name",
                text=f"{traits.title}: {text}.",
            )
        return decision

    def _decision_by_rules(
        self, verb: AccessVerb, topic: str, partitions: tuple[str, ...]
    ) -> Decision:
        """Return the decision of governance and grant, for a participant that starts."""
        join, traits = self._join, self._traits
        rule = self._governed.topic_rule(topic)
        if stopped := self.governance_refusal(topic):
            return stopped
        assert rule is not None
        writes, reads = rule.enable_write_access_control, rule.enable_read_access_control
        asked = f"{verb} {topic}"
        if traits.creates_topics and writes and reads:
            verdict = self._creation(verb, topic)
            if not verdict.allowed:
                return self._verdict(verdict, asked, rule)
        if not (writes if verb is AccessVerb.PUBLISH else reads):
            text = f"the governance does not control {asked}"
            if join.hits_peers:
                return join._replace(topic_rule=rule)
            if join.outcome is Outcome.PEER_DENIES:
                if not self._can_exchange_unprotected(rule):
                    return self._peers_refuse(rule)
                text = (
                    f"the governance neither controls {asked} nor protects the topic, so even "
                    "peers that refuse the participant exchange messages with it"
                )
            return self._answer(Outcome.ALLOWED, "unrestricted", text, topic_rule=rule)
        verdict = self._own[verb].ask(topic, partitions)
        if not verdict.allowed:
            return self._verdict(verdict, asked, rule)
        if join.hits_peers:
            return join._replace(topic_rule=rule)
        if join.outcome is Outcome.PEER_DENIES:
            return self._peers_refuse(rule)
        if self._peers is not self._own:
            remote = self._peers[verb].ask(topic, partitions)
            if not remote.allowed:
                return self._verdict(remote, asked, rule, by_peers=True)
        return self._verdict(verdict, asked, rule)

    def _can_exchange_unprotected(self, rule: TopicRule) -> bool:
        """Return whether a refused participant can still exchange data on an unprotected topic.

        Peers check only the direction of the refused participant: read access for its readers,
        write access for its writers.  If the other direction is access-controlled, the refused
        participant itself checks the rights of its peers; it knows these rights only after the
        handshake.  So the refused participant matches endpoints that either side opens later
        (Cyclone DDS 0.10.2, `q_omg_security_check_remote_writer_permissions` and
        `.._reader_permissions`).
        """
        domain = self._governed.rule
        return (
            self._traits.shares_open_topics
            and domain is not None
            and domain.rtps_protection_kind is ProtectionKind.NONE
            and not (
                rule.enable_discovery_protection
                and domain.discovery_protection_kind is not ProtectionKind.NONE
            )
            and rule.metadata_protection_kind is ProtectionKind.NONE
            and rule.data_protection_kind is ProtectionKind.NONE
        )

    def _no_topic_rule_decision(self, topic: str) -> Decision:
        if self._governed.rule is None:
            text = f"the governance does not list domain {self._governed.domain}"
            return self._answer(Outcome.DENIED, "domain-not-in-governance", text)
        text = f"the governance has no topic rule for {topic}"
        return self._answer(Outcome.DENIED, "no-topic-rule", text)

    def _peers_refuse(self, rule: TopicRule) -> Decision:
        text = (
            f"no allow rule of the grant covers domain {self._governed.domain}, so peers refuse "
            "the participant"
        )
        return self._answer(Outcome.PEER_DENIES, "peer-refuses-participant", text, topic_rule=rule)

    def _verdict(
        self,
        verdict: RuleVerdict,
        asked_access: str,
        topic_rule: TopicRule,
        *,
        by_peers: bool = False,
    ) -> Decision:
        text = _verdict_text(verdict, asked_access, self._governed.domain, by_peers=by_peers)
        outcome = Outcome.PEER_DENIES if by_peers else verdict.outcome
        return self._answer(outcome, verdict.reason, text, verdict, topic_rule)

    def _answer(
        self,
        outcome: Outcome,
        reason: str,
        text: str,
        verdict: RuleVerdict | None = None,
        topic_rule: TopicRule | None = None,
    ) -> Decision:
        return Decision(
            outcome,
            reason,
            f"{self._traits.title}: {text}.",
            self._grant,
            verdict.rule if verdict else None,
            verdict.expression if verdict else None,
            topic_rule,
        )
