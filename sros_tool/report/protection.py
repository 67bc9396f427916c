"""How names are protected: what a governance document says of the DDS topics behind them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from sros_tool.dds.governance import DomainRule, Governance, TopicRule
from sros_tool.names import dds_names
from sros_tool.policy.model import RIGHTS
from sros_tool.policy.patterns import covers, overlap
from sros_tool.report.picture import UNKNOWN, Level, Protection

_ORDER = list(Level)


def protection_of(governance: Governance | None, kind: str, name: str) -> Protection:
    """The weakest protection of the DDS topics of a name, in the governance's first domain rule.

    Whatever protects whole RTPS messages protects every topic in them.  A topic that no rule
    names is not protected: vendors refuse it.  Access is controlled where it is for each of the
    topics in every domain, as in `sros_tool.explain.unguarded`.
    """
    if governance is None or not governance.domain_access_rules:
        return UNKNOWN
    domain = governance.domain_access_rules[0]
    topics = _topics(kind, name)
    found = [_protection(domain, rule) for topic in topics for rule in _rules_for(domain, topic)]
    anywhere = [
        rule
        for each in governance.domain_access_rules
        for topic in topics
        for rule in _rules_for(each, topic)
    ]
    weakest = min(found, key=lambda each: _ORDER.index(each.level), default=Protection(Level.NONE))
    return replace(
        weakest,
        read_control=all(rule.enable_read_access_control for rule in anywhere),
        write_control=all(rule.enable_write_access_control for rule in anywhere),
    )


def _topics(kind: str, name: str) -> tuple[str, ...]:
    if kind == "dds":
        return (name,)
    found = (dds_names(right, name) for right in RIGHTS[kind])
    return tuple(dict.fromkeys(topic for each in found for topic in each.publish + each.subscribe))


def _rules_for(domain: DomainRule, topic: str) -> Iterator[TopicRule]:
    """The rule for a topic; for a wildcard every rule that may hold for a topic of it."""
    for rule in domain.topic_access_rules:
        if overlap(rule.topic_expression, topic):
            yield rule
            if covers(rule.topic_expression, topic):
                return


def _protection(domain: DomainRule, rule: TopicRule) -> Protection:
    data, metadata = rule.data_protection_kind, rule.metadata_protection_kind
    rtps = domain.rtps_protection_kind
    return Protection(
        max((_level(each) for each in (data, metadata, rtps)), key=_ORDER.index),
        str(data),
        str(metadata),
        str(rtps),
    )


def _level(kind: str) -> Level:
    return Level(str(kind).partition("_")[0].lower())
