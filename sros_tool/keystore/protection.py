"""The protection that policies state for names, as the protection of a keystore.

A keystore has a single governance, so the statement of one enclave about a name applies to all
enclaves.  Levels are minimums: if the keystore protects a name better, nothing changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, ProtectionKind, TopicRule
from sros_tool.errors import PolicyError
from sros_tool.names import ACTION_PARTS
from sros_tool.policy.model import (
    DomainProtection,
    Level,
    NamedProtection,
    StatedProtection,
    TopicProtection,
)
from sros_tool.policy.patterns import Names, covers
from sros_tool.policy.rights import KIND_OF
from sros_tool.translate import governance_for, protected_topics, refuse_contradictions

# ── from statements to the protection of a keystore ────────────────────────────────────────


def with_stated_protections(
    protection: DomainProtection, stated_protections: Sequence[StatedProtection]
) -> DomainProtection:
    """Return ``protection``, raised to the levels that policies state, but never lowered.

    Raises:
        PolicyError: statements contradict each other; or a wildcard in the settings matches only
            some of the names of a statement, so that it is unclear which of the two decides.
    """
    refuse_contradictions(stated_protections)
    raised = _RaisedProtection(protection)
    for stated_protection in {
        (stated_protection.kind, stated_protection.name, stated_protection.level): stated_protection
        for stated_protection in stated_protections
    }.values():
        raised.state(stated_protection)
    result = raised.result()
    missing = next(unfulfilled_protections(governance_for_all(result), stated_protections), None)
    assert missing is None, f"{missing} is not protected as stated"
    return result


def governance_with_stated_protections(
    protection: DomainProtection, stated_protections: Sequence[StatedProtection], domain: int = 0
) -> Governance:
    """Return the governance for a raised ``protection`` (`with_stated_protections`) in a domain.

    Raises:
        PolicyError: as `with_stated_protections`.
    """
    return governance_for(
        with_stated_protections(protection, stated_protections), DomainSet.of((domain, domain))
    )


def governance_for_all(protection: DomainProtection) -> Governance:
    """Return the governance for ``protection`` in domain 0; the rules of all domains are equal."""
    return governance_for(protection, DomainSet.of((0, 0)))


class _RaisedProtection:
    """The protection of a keystore while it is raised by the statements of policies."""

    def __init__(self, protection: DomainProtection) -> None:
        self._protection = protection
        self._named = list(protection.named)
        self._added: list[NamedProtection] = []
        self._owner: dict[str, int] = {}
        for number, named_protection in enumerate(self._named):
            for topic in protected_topics(named_protection.kind, named_protection.name):
                self._owner.setdefault(topic, number)
        rules = governance_for_all(protection).domain_access_rules[0].topic_access_rules
        self._rank = {rule.topic_expression: place for place, rule in enumerate(rules)}
        self._topics = Names(self._owner)

    def result(self) -> DomainProtection:
        """Return the raised protection."""
        named = (*self._added, *self._named)
        return replace(self._protection, named=named)

    def state(self, protection: StatedProtection) -> None:
        """Raise the protection of a name to the level that a policy states."""
        topics = protected_topics(protection.kind, protection.name)
        deciding = {topic: self._deciding_entry(topic, protection) for topic in topics}
        if len({self._value(number) for number in deciding.values()}) > 1:
            for part in _parts_of_action(protection):
                self.state(part)
            return
        base = self._value(deciding[topics[0]])
        needed = self._raised_protection(base, protection.level)
        if needed == base:
            return
        for topic in topics:
            self._refuse_partial_overlap(topic, protection)
        numbers = set(deciding.values())
        number = numbers.pop()
        if number is not None and not numbers and self._is_for_topics(number, topics):
            self._named[number] = self._named[number]._replace(protection=needed)
        else:
            self._added.append(NamedProtection(protection.kind, protection.name, needed))

    def _is_for_topics(self, number: int, topics: Sequence[str]) -> bool:
        """Return whether an entry of the settings is for exactly these topics."""
        own_topics = protected_topics(self._named[number].kind, self._named[number].name)
        return len(own_topics) == len(topics) and all(
            any(covers(topic, own_topic) and covers(own_topic, topic) for own_topic in own_topics)
            for topic in topics
        )

    def _deciding_entry(self, topic: str, protection: StatedProtection) -> int | None:
        """Return the number of the settings entry that decides on all names of ``topic``, or None.

        As a side effect, entries for only some of the names are raised to the stated level.
        """
        wide: list[str] = []
        for name in self._topics.overlapping(topic):
            number = self._owner[name]
            if covers(name, topic):
                wide.append(name)
            elif covers(topic, name):
                value = self._raised_protection(self._value(number), protection.level)
                self._named[number] = self._named[number]._replace(protection=value)
            elif self._raised_protection(self._value(number), protection.level) != self._value(
                number
            ):
                raise self._overlap_error(name, protection)
        return self._owner[min(wide, key=self._rank.__getitem__)] if wide else None

    def _refuse_partial_overlap(self, topic: str, protection: StatedProtection) -> None:
        for name in self._topics.overlapping(topic):
            if not covers(name, topic) and not covers(topic, name):
                raise self._overlap_error(name, protection)

    def _overlap_error(self, topic: str, protection: StatedProtection) -> PolicyError:
        other = self._named[self._owner[topic]]
        return PolicyError(
            f'{protection.source}: {protection} has protect="{protection.word}", but the '
            f"settings of the keystore already protect {other}",
            "Some names match both wildcards, and it is unclear which of the two applies to "
            "these names.",
            "In the policy, protect names that only one of the wildcards matches, or change the "
            "settings: `sros update_keystore --help` describes --rule and --drop-rule.",
        )

    def _value(self, number: int | None) -> TopicProtection:
        return self._protection.default if number is None else self._named[number].protection

    def _raised_protection(self, protection: TopicProtection, level: Level) -> TopicProtection:
        kinds = (protection.data, protection.metadata, self._protection.rtps)
        if max(map(_strength, kinds)) >= _strength(level):
            return protection
        if level is Level.ENCRYPT:
            return replace(protection, data=Level.ENCRYPT)
        # With data=SIGN, Fast DDS loses messages; the submessage contains the payload, so it is
        # signed instead.
        return replace(protection, metadata=Level.SIGN)


def _parts_of_action(protection: StatedProtection) -> Iterator[StatedProtection]:
    """Yield the services and topics of an action."""
    for right, end in ACTION_PARTS["call"]:
        yield replace(protection, kind=KIND_OF[right], name=protection.name + end)


def _strength(level: str) -> int:
    """Return 0 for no protection, 1 for a signature, 2 for encryption."""
    return ("NONE", "SIGN", "ENCRYPT").index(str(level).partition("_")[0])


# ── from a governance back to statements ───────────────────────────────────────────────────


def unfulfilled_protections(
    governance: Governance, stated_protections: Iterable[StatedProtection]
) -> Iterator[tuple[StatedProtection, Level]]:
    """Yield the statements that a governance does not fulfill, with its level for the name.

    The level of a name is the lowest level of its DDS topics in all domains.  A topic without a
    rule does not count, because no vendor allows its use.
    """
    domains = [_DomainRules(rule) for rule in governance.domain_access_rules]
    for protection in stated_protections:
        levels = [
            level
            for topic in protected_topics(protection.kind, protection.name)
            for rules in domains
            for level in rules.levels(topic)
        ]
        least = min(levels, key=_strength, default=protection.level)
        if _strength(least) < _strength(protection.level):
            yield protection, least


class _DomainRules:
    """The topic rules of a domain, with a fast search for the rules that apply to a topic."""

    def __init__(self, rule: DomainRule) -> None:
        self._rtps = rule.rtps_protection_kind
        self._rules: Mapping[str, tuple[int, TopicRule]] = {
            topic_rule.topic_expression: (number, topic_rule)
            for number, topic_rule in reversed(list(enumerate(rule.topic_access_rules)))
        }
        self._names = Names(self._rules)

    def levels(self, topic: str) -> Iterator[Level]:
        """Yield the levels of all rules that apply to some name of a topic expression."""
        for _, rule in sorted(
            (self._rules[name] for name in self._names.overlapping(topic)), key=lambda pair: pair[0]
        ):
            kinds: tuple[ProtectionKind, ...] = (
                rule.data_protection_kind,
                rule.metadata_protection_kind,
                self._rtps,
            )
            yield Level(max(kinds, key=_strength).partition("_")[0])
            if covers(rule.topic_expression, topic):
                return
