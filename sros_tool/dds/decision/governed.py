"""What a governance document says of one domain and of the topics on it, by vendor."""

from __future__ import annotations

from sros_tool.dds.decision.domains import holds_for
from sros_tool.dds.decision.matching import Expressions
from sros_tool.dds.decision.rights import stand_in
from sros_tool.dds.decision.vendors import Traits
from sros_tool.dds.governance import DomainRule, Governance, TopicRule


class Governed:
    """The first domain rule that lists the domain (``rule``, None without one), and its topics."""

    def __init__(self, traits: Traits, governance: Governance, domain: int) -> None:
        self.rule: DomainRule | None = None
        for rule in governance.domain_access_rules:
            if holds_for(traits.open_range, rule.domains, domain):
                self.rule = rule
                break
        self._topic_rules = self.rule.topic_access_rules if self.rule else ()
        self._topics = Expressions(
            traits.style,
            (stand_in(traits, each.topic_expression) for each in self._topic_rules),
            both_ways=traits.governance_both_ways,
        )

    def topic_rule(self, topic: str) -> TopicRule | None:
        """The first rule whose expression matches; where one is empty, the vendor may crash."""
        position = self._topics.first(topic)
        return None if position is None else self._topic_rules[position]

    def all_controlled(self) -> bool:
        """Whether every topic rule controls reading and writing."""
        return all(
            rule.enable_read_access_control and rule.enable_write_access_control
            for rule in self._topic_rules
        )
