"""What a vendor decides for one identity on one domain at one moment, and why."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime, tzinfo

from sros_tool.dds.decision.answers import Decision, Outcome, Refusal, Verb
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.governed import Governed
from sros_tool.dds.decision.grants import choose_grant
from sros_tool.dds.decision.joining import decide_join
from sros_tool.dds.decision.rights import Rights, Verdict, rules_for
from sros_tool.dds.decision.vendors import TRAITS, Vendor
from sros_tool.dds.decision.wording import verdict_text
from sros_tool.dds.governance import Governance, Protection, TopicRule
from sros_tool.dds.permissions import Grant, Permissions

_TOPIC_NAME = re.compile(r"[A-Za-z_/][A-Za-z0-9_/]*\Z")
_ENDPOINTS = (Verb.PUBLISH, Verb.SUBSCRIBE)


class Access:
    """The decisions of one vendor; prepared once, asked often.

    A peer is taken to have the same governance, clock and zone, and every right of its own.
    """

    def __init__(
        self,
        vendor: Vendor,
        governance: Governance,
        permissions: Permissions,
        subject: str,
        *,
        domain: int,
        at: datetime,
        zone: tzinfo = UTC,
    ) -> None:
        """Prepare the answers for ``subject`` (RFC 4514) on ``domain`` at the aware moment ``at``.

        ``zone`` is the host's time zone.  No error is raised: what is wrong is answered.
        """
        self._traits = TRAITS[vendor]
        self._domain = domain
        self._governed = Governed(self._traits, governance, domain)
        self._grant: int | None = None
        chosen = choose_grant(self._traits, permissions, subject, at=at, zone=zone)
        if isinstance(chosen, Refusal):
            self._join = chosen.decision()
            return
        self._grant = chosen
        self._prepare(permissions.grants[chosen])

    @classmethod
    def of_documents(
        cls,
        vendor: Vendor,
        governance_xml: bytes,
        permissions_xml: bytes,
        subject: str,
        *,
        domain: int,
        at: datetime,
        zone: tzinfo = UTC,
    ) -> Access | Refusal:
        """The decisions under two documents as ``vendor`` reads them, or why it refuses them."""
        governance = read_governance_as(vendor, governance_xml)
        if isinstance(governance, Refusal):
            return governance
        permissions = read_permissions_as(vendor, permissions_xml)
        if isinstance(permissions, Refusal):
            return permissions
        return cls(vendor, governance, permissions, subject, domain=domain, at=at, zone=zone)

    def decide(self, verb: Verb, topic: str = "", partitions: tuple[str, ...] = ()) -> Decision:
        """The decision on ``verb``; ``topic`` is the DDS name (``rt/chatter``)."""
        return self.join() if verb is Verb.JOIN else self._endpoint(verb, topic, partitions)

    def join(self) -> Decision:
        """Whether the participant starts, and peers talk to it."""
        return self._join

    def publish(self, topic: str, partitions: tuple[str, ...] = ()) -> Decision:
        """Whether a writer of ``topic`` can be created and heard (no partitions: the default)."""
        return self._endpoint(Verb.PUBLISH, topic, partitions)

    def subscribe(self, topic: str, partitions: tuple[str, ...] = ()) -> Decision:
        """Whether a reader of ``topic`` can be created and hears."""
        return self._endpoint(Verb.SUBSCRIBE, topic, partitions)

    def _prepare(self, grant: Grant) -> None:
        traits = self._traits
        rules, otherwise = rules_for(traits, grant, self._domain)
        joining = decide_join(traits, self._governed, grant, rules, otherwise, self._domain)
        self._join = self._answer(joining.outcome, joining.reason, joining.text)
        self._peers = {verb: Rights(traits, rules, otherwise, verb) for verb in _ENDPOINTS}
        self._own = self._peers
        if not traits.filters_own_domain:
            everywhere = list(enumerate(grant.rules))
            self._own = {verb: Rights(traits, everywhere, otherwise, verb) for verb in _ENDPOINTS}
        if traits.relays_count_for_readers:
            readers = Rights(traits, rules, otherwise, Verb.SUBSCRIBE, "relay")
            self._peers = {**self._peers, Verb.SUBSCRIBE: readers}
        self._either = Rights(traits, rules, otherwise, *_ENDPOINTS)

    # ── answering ──────────────────────────────────────────────────────────────────────────

    def _endpoint(self, verb: Verb, topic: str, partitions: tuple[str, ...]) -> Decision:
        join = self._join
        if join.outcome in (Outcome.REFUSED, Outcome.CRASHES):
            return join
        traits = self._traits
        if traits.creates_topics and not _is_topic_name(topic):
            return self._answer(Outcome.DENIED, "invalid-name", f"{topic!r} is no name for a topic")
        decision = self._ruled(verb, topic, partitions)
        longest = traits.longest_topic_name
        if decision.outcome.ok and longest is not None and len(topic.encode()) > longest:
            text = f"no peer matches a topic whose name has more than {longest} bytes"
            return replace(
                decision,
                outcome=Outcome.PEER_DENIES,
                reason="long-name",
                text=f"{traits.title}: {text}.",
            )
        return decision

    def _ruled(self, verb: Verb, topic: str, partitions: tuple[str, ...]) -> Decision:
        """What the governance and the rules of the grant say, for a participant that starts."""
        join, traits = self._join, self._traits
        rule = self._governed.topic_rule(topic)
        if rule is None:
            return self._without_topic_rule(topic)
        if traits.crashes_on_empty_texts and not rule.topic_expression.strip():
            text = "a topic rule of the governance is empty, over which the process crashes"
            return self._answer(Outcome.CRASHES, "empty-topic", text)
        writes, reads = rule.enable_write_access_control, rule.enable_read_access_control
        asked = f"{verb} {topic}"
        if traits.creates_topics and writes and reads:
            verdict = self._either.ask_topic(topic)
            if not verdict.allowed:
                return self._verdict(verdict, asked, rule)
        if not (writes if verb is Verb.PUBLISH else reads):
            if join.outcome is Outcome.PEER_DENIES and not self._in_the_open(rule):
                return self._peers_refuse(rule)
            text = f"the governance leaves {asked} open to everybody"
            return self._answer(Outcome.ALLOWED, "unrestricted", text, topic_rule=rule)
        verdict = self._own[verb].ask(topic, partitions)
        if not verdict.allowed:
            return self._verdict(verdict, asked, rule)
        if join.outcome is Outcome.PEER_DENIES:
            return self._peers_refuse(rule)
        if self._peers is not self._own:
            remote = self._peers[verb].ask(topic, partitions)
            if not remote.allowed:
                return self._verdict(remote, asked, rule, by_peers=True)
        return self._verdict(verdict, asked, rule)

    def _in_the_open(self, rule: TopicRule) -> bool:
        """Whether even participants that refuse each other exchange the topic."""
        domain = self._governed.rule
        return (
            self._traits.shares_open_topics
            and domain is not None
            and domain.rtps_protection_kind is Protection.NONE
            and not (rule.enable_read_access_control or rule.enable_write_access_control)
            and not (
                rule.enable_discovery_protection
                and domain.discovery_protection_kind is not Protection.NONE
            )
            and rule.metadata_protection_kind is Protection.NONE
            and rule.data_protection_kind is Protection.NONE
        )

    def _without_topic_rule(self, topic: str) -> Decision:
        if self._governed.rule is None:
            text = f"the governance does not list domain {self._domain}"
            return self._answer(Outcome.DENIED, "domain-not-in-governance", text)
        text = f"the governance has no topic rule for {topic}"
        return self._answer(Outcome.DENIED, "no-topic-rule", text)

    def _peers_refuse(self, rule: TopicRule) -> Decision:
        text = f"no allow rule of the grant holds on domain {self._domain}, so peers refuse it"
        return self._answer(Outcome.PEER_DENIES, "peer-refuses-participant", text, topic_rule=rule)

    def _verdict(
        self, verdict: Verdict, asked: str, topic_rule: TopicRule, *, by_peers: bool = False
    ) -> Decision:
        text = verdict_text(verdict, asked, self._domain, by_peers=by_peers)
        outcome = Outcome.PEER_DENIES if by_peers else verdict.outcome
        return self._answer(outcome, verdict.reason, text, verdict, topic_rule)

    def _answer(
        self,
        outcome: Outcome,
        reason: str,
        text: str,
        verdict: Verdict | None = None,
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


def _is_topic_name(name: str) -> bool:
    """Whether Cyclone DDS 0.10 takes it: letters, digits, ``_`` and ``/``, no digit first."""
    return bool(_TOPIC_NAME.match(name))
