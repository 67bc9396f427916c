"""The rules of a grant, asked for a topic and partitions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sros_tool.dds.decision.answers import Outcome
from sros_tool.dds.decision.domains import holds_for
from sros_tool.dds.decision.matching import Expressions, matches
from sros_tool.dds.decision.vendors import DenyPartitions, Style, Traits
from sros_tool.dds.permissions import Criteria, Grant, Rule

DEFAULT_PARTITION = ("",)
Numbered = tuple[int, Rule]
"""A rule with its index in the grant."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the rules say: ALLOWED, DENIED or CRASHES, why, by which rule and expression."""

    outcome: Outcome
    reason: str
    rule: int | None = None
    expression: str | None = None

    @property
    def allowed(self) -> bool:
        """Whether they say yes."""
        return self.outcome is Outcome.ALLOWED


@dataclass(frozen=True, slots=True)
class _Entry:
    """One ``<topic>`` of a rule; ``partitions`` are those that the vendor weighs with it."""

    criteria: int
    rule: int
    allow: bool
    expression: str
    partitions: tuple[str, ...]

    def verdict(self, *, fits: bool) -> Verdict:
        if not self.expression:
            return Verdict(Outcome.CRASHES, "empty-topic", self.rule)
        if not self.allow:
            return Verdict(Outcome.DENIED, "deny-rule", self.rule, self.expression)
        if not fits:
            return Verdict(Outcome.DENIED, "partition", self.rule, self.expression)
        return Verdict(Outcome.ALLOWED, "allow-rule", self.rule, self.expression)


def rules_for(traits: Traits, grant: Grant, domain: int) -> tuple[list[Numbered], Verdict]:
    """The rules of the grant for ``domain``, and the verdict where none of them matches."""
    found: list[Numbered] = []
    for index, rule in enumerate(grant.rules):
        holds = holds_for(traits.open_range, rule.domains, domain)
        if holds is None:
            # Cyclone DDS looks for the next rule before it uses one: the last one is never used.
            return found[:-1], Verdict(Outcome.CRASHES, "open-range", index)
        if holds:
            found.append((index, rule))
    return found, last_word(traits, grant)


def last_word(traits: Traits, grant: Grant) -> Verdict:
    """The verdict where no rule matches."""
    if not traits.honours_default:
        return Verdict(Outcome.DENIED, "no-rule")
    if traits.crashes_on_empty_texts and grant.default_empty:
        return Verdict(Outcome.CRASHES, "empty-default")
    return Verdict(Outcome.ALLOWED if grant.default_allow else Outcome.DENIED, "default")


class Rights:
    """Rules in their order, for one verb, or for both where only the topic is asked for."""

    def __init__(
        self, traits: Traits, rules: Iterable[Numbered], otherwise: Verdict, *verbs: str
    ) -> None:
        """``otherwise`` is the verdict where no rule matches."""
        self._traits = traits
        self._otherwise = otherwise
        self._entries: list[_Entry] = []
        count = 0
        for index, rule, criteria in (
            (index, rule, getattr(rule, verb)) for index, rule in rules for verb in verbs
        ):
            for each in criteria:
                count += 1
                # Fast DDS weighs the partitions of all criteria of a verb in a rule together.
                weighed = _partitions(traits, rule, criteria if traits.topic_decides else (each,))
                self._entries += [
                    _Entry(count, index, rule.allow, trimmed(traits, expression), weighed)
                    for expression in each.topics
                    if trimmed(traits, expression) or traits.crashes_on_empty_texts
                ]
        texts = (stand_in(traits, entry.expression) for entry in self._entries)
        self._topics = Expressions(traits.style, texts)

    def ask(self, topic: str, partitions: tuple[str, ...]) -> Verdict:
        """The verdict on an endpoint of ``topic`` in ``partitions`` (none: the default one)."""
        wanted = partitions or DEFAULT_PARTITION
        passed = 0
        for position in self._topics.matching(topic):
            entry = self._entries[position]
            if entry.criteria == passed:
                continue  # the first topic of some criteria that matches is the only one looked at
            passed = entry.criteria
            fits = self._fits(entry, wanted)
            if fits or self._traits.topic_decides or not entry.expression:
                return entry.verdict(fits=fits)
        return self._otherwise

    def ask_topic(self, topic: str) -> Verdict:
        """The verdict on a topic in itself, whatever the partitions."""
        position = self._topics.first(topic)
        if position is None:
            return self._otherwise
        return self._entries[position].verdict(fits=True)

    def _fits(self, entry: _Entry, wanted: tuple[str, ...]) -> bool:
        style, named = self._traits.style, entry.partitions
        if entry.allow:
            if wanted is DEFAULT_PARTITION is named:
                return True
            return all(_named(style, named, each) for each in wanted)
        if self._traits.deny_partitions is DenyPartitions.IGNORED:
            return True
        return any(_named(style, named, each) for each in wanted)


def _named(style: Style, expressions: tuple[str, ...], partition: str) -> bool:
    return any(matches(style, expression, partition) for expression in expressions)


def stand_in(traits: Traits, text: str) -> str:
    """An expression that matches every name, for one over which the vendor crashes."""
    text = trimmed(traits, text)
    return text or "*" if traits.crashes_on_empty_texts else text


def trimmed(traits: Traits, text: str) -> str:
    """The text as the vendor takes it from its element."""
    return text.strip(" \t\v\r\n") if traits.trims_texts else text


def _partitions(traits: Traits, rule: Rule, criteria: tuple[Criteria, ...]) -> tuple[str, ...]:
    """The partitions that ``criteria`` of ``rule`` name; without any, what the vendor implies."""
    everywhere = not rule.allow and traits.deny_partitions is DenyPartitions.ANY_OR_ALL
    implied = ("*",) if everywhere else DEFAULT_PARTITION
    if implied is DEFAULT_PARTITION and not any(each.partitions for each in criteria):
        return DEFAULT_PARTITION
    found = [text for each in criteria for text in each.partitions or implied]
    return tuple(dict.fromkeys(trimmed(traits, text) for text in found))
