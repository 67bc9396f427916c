"""The rules of a grant for one domain, asked for a topic and partitions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sros_tool.dds.decision.matching import Expressions, matches
from sros_tool.dds.decision.vendors import DenyPartitions, Style, Traits
from sros_tool.dds.permissions import Criteria, Rule

DEFAULT_PARTITION = ("",)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the rules say: ``allowed``, why, and by which rule and expression (None: by none)."""

    allowed: bool
    reason: str
    rule: int | None = None
    expression: str | None = None


NO_RULE = Verdict(False, "no-rule")


@dataclass(frozen=True, slots=True)
class _Entry:
    """One ``<topic>`` of a rule; ``partitions`` are those that the vendor weighs with it."""

    rule: int
    allow: bool
    expression: str
    partitions: tuple[str, ...]

    @property
    def crashes(self) -> bool:
        return not self.expression


EMPTY_TOPIC = "empty-topic"
"""The reason of a verdict that is a crash."""


class Rights:
    """The rules of one verb in their order, or with both verbs those on which a topic rests."""

    def __init__(self, traits: Traits, rules: Iterable[tuple[int, Rule]], *verbs: str) -> None:
        self._traits = traits
        self._entries: list[_Entry] = []
        for index, rule in rules:
            criteria = tuple(each for verb in verbs for each in getattr(rule, verb))
            for each in criteria:
                # Fast DDS weighs the partitions of all criteria of a rule together.
                weighed = _partitions(traits, rule, criteria if traits.topic_decides else (each,))
                self._entries += [
                    _Entry(index, rule.allow, trimmed(traits, expression), weighed)
                    for expression in each.topics
                ]
        texts = (stand_in(traits, entry.expression) for entry in self._entries)
        self._topics = Expressions(traits.style, texts)

    def ask(self, topic: str, partitions: tuple[str, ...]) -> Verdict:
        """The verdict on an endpoint of ``topic`` in ``partitions`` (none: the default one)."""
        wanted = partitions or DEFAULT_PARTITION
        for position in self._topics.matching(topic):
            entry = self._entries[position]
            if entry.crashes:
                return Verdict(False, EMPTY_TOPIC, entry.rule)
            fits = self._fits(entry, wanted)
            if fits or self._traits.topic_decides:
                reason = ("allow-rule" if fits else "partition") if entry.allow else "deny-rule"
                return Verdict(reason == "allow-rule", reason, entry.rule, entry.expression)
        return NO_RULE

    def ask_topic(self, topic: str) -> Verdict:
        """The verdict on a topic in itself, whatever the partitions."""
        position = self._topics.first(topic)
        if position is None:
            return NO_RULE
        entry = self._entries[position]
        if entry.crashes:
            return Verdict(False, EMPTY_TOPIC, entry.rule)
        reason = "allow-rule" if entry.allow else "deny-rule"
        return Verdict(entry.allow, reason, entry.rule, entry.expression)

    def _fits(self, entry: _Entry, wanted: tuple[str, ...]) -> bool:
        style, named = self._traits.style, entry.partitions
        if entry.allow or self._traits.deny_partitions is DenyPartitions.ALL:
            return wanted == named or all(_named(style, named, each) for each in wanted)
        if self._traits.deny_partitions is DenyPartitions.IGNORED:
            return True
        return any(_named(style, named, each) for each in wanted)


def _named(style: Style, expressions: tuple[str, ...], partition: str) -> bool:
    return any(matches(style, expression, partition) for expression in expressions)


def stand_in(traits: Traits, text: str) -> str:
    """An expression that matches every name, for one over which the vendor crashes."""
    text = trimmed(traits, text)
    return text or "*" if traits.crashes_on_empty_expressions else text


def trimmed(traits: Traits, text: str) -> str:
    """The text as the vendor takes it from its element."""
    return text.strip(" \t\v\r\n") if traits.trims_texts else text


def _partitions(traits: Traits, rule: Rule, criteria: tuple[Criteria, ...]) -> tuple[str, ...]:
    """The partitions that ``criteria`` of ``rule`` name; without any, what the vendor implies."""
    everywhere = not rule.allow and traits.deny_partitions is DenyPartitions.ANY
    implied = ("*",) if everywhere else DEFAULT_PARTITION
    found = [text for each in criteria for text in each.partitions or implied]
    return tuple(dict.fromkeys(trimmed(traits, text) for text in found))
