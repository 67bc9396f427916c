"""Translation between ROS policies and DDS Security documents, in both directions.

Names are mapped as in ros2/sros2, so that both tools give the same rights for a policy.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence, Set
from typing import TYPE_CHECKING, Any, NamedTuple

from sros_tool.dds.decision.expressions import ExpressionIndex
from sros_tool.dds.decision.vendors import Style
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, ProtectionKind, TopicRule, attributes
from sros_tool.dds.permissions import (
    LARGE_BYTES,
    TOPIC_LINE_BYTES,
    Criteria,
    Grant,
    Permissions,
    Rule,
    grant,
)
from sros_tool.errors import PolicyError
from sros_tool.names import (
    GOAL,
    ROS_DISCOVERY_TOPIC,
    TOPIC_ENDS,
    dds_names,
    expand,
    is_expression,
    service_of,
)
from sros_tool.policy.model import ALLOW, DENY, RIGHTS, Enclave, Level, Qualifier
from sros_tool.policy.patterns import ComparisonLimit, Names, covers
from sros_tool.policy.rights import Right
from sros_tool.validity import Window

if TYPE_CHECKING:
    from sros_tool.policy.model import DomainProtection, StatedProtection, TopicProtection

# ── ROS → DDS ──────────────────────────────────────────────────────────────────────────────


def permissions_for(
    enclave: Enclave, *, subject: str, validity: Window, domains: DomainSet
) -> Permissions:
    """Return the permissions of an enclave: one grant, with the deny rule before the allow rule.

    The allow rule also has ``ros_discovery_info``, which every ROS 2 participant publishes and
    subscribes: no participant starts without that right.

    A large document lists no name that a wildcard of the same list matches anyway.  A smaller
    document has every name of the policy, so that people can compare both.
    """
    allowed, denied = _Topics(), _Topics()
    for profile in enclave.all_profiles():
        ns, node = profile.ns, profile.node
        for group in profile.groups:
            names = [expand(name, ns, node) for name in group.names]
            for right, qualifier in group.rights:
                (allowed if qualifier is ALLOW else denied).add(right, names)
    allowed.publish.add(ROS_DISCOVERY_TOPIC)
    allowed.subscribe.add(ROS_DISCOVERY_TOPIC)
    if allowed.text_bytes() + denied.text_bytes() >= LARGE_BYTES:
        allowed.shorten()
        denied.shorten()
    rules = [] if denied.is_empty() else [denied.rule(allow=False, domains=domains)]
    rules.append(allowed.rule(allow=True, domains=domains))
    return Permissions((grant(enclave.path, subject, validity, tuple(rules)),))


class _Topics:
    """The DDS topics collected for one rule of a grant."""

    def __init__(self) -> None:
        self.publish: set[str] = set()
        self.subscribe: set[str] = set()

    def add(self, right: str, names: Iterable[str]) -> None:
        written, read = TOPIC_ENDS[right]
        for begin, end in written:
            self.publish.update([f"{begin}{name}{end}" for name in names])
        for begin, end in read:
            self.subscribe.update([f"{begin}{name}{end}" for name in names])

    def is_empty(self) -> bool:
        return not (self.publish or self.subscribe)

    def text_bytes(self) -> int:
        return sum(TOPIC_LINE_BYTES + len(topic) for topic in (*self.publish, *self.subscribe))

    def shorten(self) -> None:
        self.publish = needed_expressions(self.publish)
        self.subscribe = needed_expressions(self.subscribe)

    def rule(self, *, allow: bool, domains: DomainSet) -> Rule:
        return Rule(
            allow, domains, _sorted_criteria(self.publish), _sorted_criteria(self.subscribe)
        )


def _sorted_criteria(topics: set[str]) -> tuple[Criteria, ...]:
    return (Criteria(tuple(sorted(topics))),) if topics else ()


def needed_expressions(topics: Set[str]) -> set[str]:
    """Return ``topics`` without the names that wildcards among them match for every vendor."""
    wildcards = set(filter(is_expression, topics))
    matched = [ExpressionIndex(style, wildcards) for style in Style]
    return {
        topic
        for topic in topics
        if topic in wildcards or any(index.first(topic) is None for index in matched)
    }


def governance_for(protection: DomainProtection, domains: DomainSet) -> Governance:
    """Return the governance of a keystore: one domain rule, narrow topic rules before wide ones.

    The first topic rule that matches a topic decides, so each rule comes before the rules that
    cover it.  The last rule, ``*``, applies to all other topics.
    """
    rules = [
        _topic_rule(expression, named.protection)
        for named in protection.named
        for expression in protected_topics(named.kind, named.name)
    ]
    rules = _narrow_first(rules)
    rules.append(_topic_rule("*", protection.default))
    return Governance(
        (
            DomainRule(
                domains=domains,
                topic_access_rules=tuple(rules),
                **_rule_attributes(protection, DomainRule),
            ),
        )
    )


def hidden_protections(protection: DomainProtection) -> list[tuple[str, str]]:
    """Return pairs of protected names ("topic /camera/*") where the second hides the first.

    The protection of the first name never applies, because another rule decides on each of its DDS
    topics.  Narrow rules come first, so the two rules are for the same topics.
    """
    protections = []
    earlier: list[tuple[str, str]] = []
    for named in protection.named:
        own_topics = protected_topics(named.kind, named.name)
        by = [
            next((at for one, at in earlier if covers(one, name) and covers(name, one)), "")
            for name in own_topics
        ]
        if all(by):
            protections.append((str(named), by[0]))
        earlier += [(name, str(named)) for name in own_topics]
    return protections


def protected_topics(kind: str, name: str) -> list[str]:
    """Return the DDS topics, in both directions, of a topic, service or action.

    ``kind`` is "topics", "services" or "actions".
    """
    expressions: dict[str, None] = {}
    for right in RIGHTS[kind]:
        names = dds_names(right, expand(name, "/", ""))
        expressions.update(dict.fromkeys(names.publish + names.subscribe))
    return list(expressions)


def contradictions(
    stated_protections: Sequence[StatedProtection],
) -> Iterator[tuple[StatedProtection, StatedProtection]]:
    """Yield the pairs of statements that state different levels for a common name, in order."""
    limit = ComparisonLimit()
    signed: dict[str, list[StatedProtection]] = {}
    for protection in stated_protections:
        if protection.level is Level.SIGN:
            for topic in protected_topics(protection.kind, protection.name):
                signed.setdefault(topic, []).append(protection)
    names = Names(signed, limit)
    place = {protection: number for number, protection in enumerate(stated_protections)}
    for protection in stated_protections:
        if protection.level is Level.SIGN:
            continue
        met = {
            statement: None
            for topic in protected_topics(protection.kind, protection.name)
            for meeting in names.overlapping(topic)
            for statement in signed[meeting]
        }
        for statement in met:
            first, second = sorted((protection, statement), key=place.__getitem__)
            yield first, second


def refuse_contradictions(
    stated_protections: Sequence[StatedProtection], known: Collection[StatedProtection] = ()
) -> None:
    """Raise `PolicyError` if statements contradict each other, unless both are ``known``."""
    for stated_protection, other in contradictions(stated_protections):
        if stated_protection in known and other in known:
            continue
        raise PolicyError(
            f'{other.source}: {other} has protect="{other.word}", and {stated_protection} has '
            f'protect="{stated_protection.word}" at {stated_protection.source}',
            "A keystore has one governance for all enclaves, so each name has one protection; a "
            "wildcard protects all names that it matches.",
            "State the same protection in both places, or only one protection.",
        )


def _topic_rule(expression: str, protection: TopicProtection) -> TopicRule:
    return TopicRule(topic_expression=expression, **_rule_attributes(protection, TopicRule))


def _rule_attributes(
    protection: DomainProtection | TopicProtection, rule_class: type[DomainRule | TopicRule]
) -> dict[str, Any]:
    """Map the name of each attribute of ``rule_class`` to its value in ``protection``.

    The attribute's ``term`` is the name of the field of ``protection``.
    """
    chosen = {
        attribute: getattr(protection, attribute.term) for attribute in attributes(rule_class)
    }
    return {
        attribute.name: value if attribute.is_flag else ProtectionKind(value)
        for attribute, value in chosen.items()
    }


def _narrow_first(rules: list[TopicRule]) -> list[TopicRule]:
    """Return ``rules``, reordered as little as needed so that no rule follows a wider one."""
    ordered: list[TopicRule] = []
    wide: list[TopicRule] = []  # the rules with wildcards, in the same order
    for rule in rules:
        place, among = next(
            (
                (next(at for at, topic_rule in enumerate(ordered) if topic_rule is earlier), number)
                for number, earlier in enumerate(wide)
                if covers(earlier.topic_expression, rule.topic_expression)
                and not covers(rule.topic_expression, earlier.topic_expression)
            ),
            (len(ordered), None),
        )
        if is_expression(rule.topic_expression):
            wide.insert(len(wide) if among is None else among, rule)
        ordered.insert(place, rule)
    return ordered


def protection_for(governance: Governance) -> DomainProtection | None:
    """Return the protection that `governance_for` translates to ``governance``, or None.

    None means that no settings of a keystore can state the protection in the document: it protects
    a DDS topic without a ROS name, only half of a service, or single domains in different ways.
    """
    from sros_tool.policy.model import DomainProtection, NamedProtection, TopicProtection

    if len(governance.domain_access_rules) != 1:
        return None
    (rule,) = governance.domain_access_rules
    *narrow, last = rule.topic_access_rules or (None,)
    if last is None or last.topic_expression != "*":
        return None
    by_protection: dict[TopicProtection, list[str]] = {}
    for topic_rule in narrow:
        if topic_rule is not None:
            values = TopicProtection(**_protection_fields(topic_rule))
            by_protection.setdefault(values, []).append(topic_rule.topic_expression)
    named = []
    for values, expressions in by_protection.items():
        both = (Criteria(tuple(expressions)),)
        rights = ros_rights(Rule(True, rule.domains, both, both))
        if any(right.kind == "dds" for right in rights):
            return None
        places = dict.fromkeys((right.kind, right.name) for right in rights)
        named += [NamedProtection(kind, name, values) for kind, name in places]
    order = [topic_rule.topic_expression for topic_rule in narrow if topic_rule is not None]
    named.sort(
        key=lambda named_protection: min(
            order.index(topic)
            for topic in protected_topics(named_protection.kind, named_protection.name)
        )
    )
    protection = DomainProtection(
        **_protection_fields(rule),
        default=TopicProtection(**_protection_fields(last)),
        named=tuple(named),
    )
    governance_again = governance_for(protection, governance.domains().closed())
    return protection if governance_again == governance else None


def _protection_fields(rule: DomainRule | TopicRule) -> dict[str, Any]:
    """Map the fields of a protection to the values of a rule: the reverse of `_rule_attributes`."""

    chosen = {attribute: getattr(rule, attribute.name) for attribute in attributes(type(rule))}
    return {
        attribute.term: value if attribute.is_flag else Level(str(value))
        for attribute, value in chosen.items()
    }


# ── DDS → ROS ──────────────────────────────────────────────────────────────────────────────


class RosRight(NamedTuple):
    """One right or denial in ROS terms.

    ``kind`` is "topics", "services", "actions", or "dds" for a DDS topic without a ROS name.
    """

    qualifier: Qualifier
    right: str
    kind: str
    name: str


def ros_rights(rule: Rule) -> tuple[RosRight, ...]:
    """Return the ROS rights of a rule, with the topics of services and actions combined again.

    Other topics (half a service, a topic without a ROS prefix) keep their DDS names, with ``kind``
    "dds".  Partitions and relay criteria are ignored.
    """
    qualifier = ALLOW if rule.allow else DENY
    publish = _all_topics(rule.publish)
    subscribe = _all_topics(rule.subscribe)
    rights: list[RosRight] = []
    for kind, right, name in _possible_actions_and_services(publish, subscribe):
        names = dds_names(right, name)
        if all(map(publish.get, names.publish)) and all(map(subscribe.get, names.subscribe)):
            continue  # these topics already belong to an action
        if all(map(publish.__contains__, names.publish)) and all(
            map(subscribe.__contains__, names.subscribe)
        ):
            rights.append(RosRight(qualifier, right, kind, name))
            if kind != "topics":
                for topic in names.publish:
                    publish[topic] = True
                for topic in names.subscribe:
                    subscribe[topic] = True
    rest = []
    for right, topics in (("publish", publish), ("subscribe", subscribe)):
        for topic, listed in topics.items():
            if listed:
                continue
            if topic.startswith("rt/"):
                rest.append(RosRight(qualifier, right, "topics", topic[2:]))
            else:
                rest.append(RosRight(qualifier, right, "dds", topic))
    return tuple(rest + rights)


_EVERY_TOPIC = frozenset({"*", "rt/*"})


def allows_everything(grant: Grant) -> bool:
    """Return whether a grant allows publishing and subscribing to every ROS topic.

    Denials are ignored, unless everything is allowed only by default.
    """
    allowed = [rule for rule in grant.rules if rule.allow]
    wide = [
        {topic for criteria in criterias for topic in criteria.topics} & _EVERY_TOPIC
        for criterias in (
            [criteria for rule in allowed for criteria in rule.publish],
            [criteria for rule in allowed for criteria in rule.subscribe],
        )
    ]
    return all(wide) or (grant.default_allow and not any(not rule.allow for rule in grant.rules))


def grant_rights(enclave: str, grant: Grant) -> frozenset[Right]:
    """Return the rights that a grant gives ``enclave``, without ``ros_discovery_info``.

    Domains, partitions, relay criteria, the default of the grant and the order of its rules are
    ignored.
    """
    return frozenset(
        Right(enclave, right.qualifier, right.right, right.name)
        for rule in grant.rules
        for right in ros_rights(rule)
        if right.name != ROS_DISCOVERY_TOPIC
    )


def _all_topics(criteria: Iterable[Criteria]) -> dict[str, bool]:
    """Map every topic to False; `ros_rights` marks topics of services and actions with True."""
    return dict.fromkeys((topic for criterion in criteria for topic in criterion.topics), False)


def _possible_actions_and_services(
    publish: Iterable[str], subscribe: Iterable[str]
) -> Iterable[tuple[str, str, str]]:
    """Yield (kind, right, name) of actions, then services, to which the topics may belong.

    Actions and services are recognized by their request topics. The caller checks that the other
    topics of the action or service are in the rule, too.
    """
    requests_out, requests_in = (
        [name for name, _ in map(service_of, requests) if name]
        for requests in (
            [topic for topic in of if topic[:2] == "rq"] for of in (publish, subscribe)
        )
    )
    for kind, end in (("actions", GOAL), ("services", "")):
        for right, services in zip(RIGHTS[kind], (requests_out, requests_in), strict=True):
            for service in services:
                if service.endswith(end):
                    yield kind, right, service.removesuffix(end)
