"""What a vendor decides for one identity on one domain at one moment, and why."""

from __future__ import annotations

import re
from datetime import UTC, datetime, tzinfo

from sros_tool.dds.decision.answers import Decision, Outcome, Refusal, Verb
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.domains import holds_for
from sros_tool.dds.decision.governed import Governed
from sros_tool.dds.decision.grants import choose_grant
from sros_tool.dds.decision.rights import EMPTY_TOPIC, Rights, Verdict
from sros_tool.dds.decision.vendors import TRAITS, Vendor
from sros_tool.dds.governance import Governance, Protection, TopicRule
from sros_tool.dds.permissions import Grant, Permissions, Rule

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
        self._vendor = vendor
        self._traits = TRAITS[vendor]
        self._domain = domain
        self._governed = Governed(self._traits, governance, domain)
        self._grant_index: int | None = None
        self._grant: Grant | None = None
        self._crash_at: int | None = None
        chosen = choose_grant(self._traits, permissions, subject, at=at, zone=zone)
        if isinstance(chosen, Refusal):
            self._join = chosen.decision()
            return
        self._grant_index, self._grant = chosen, permissions.grants[chosen]
        own = list(enumerate(self._grant.rules))
        local = self._on_domain(own)
        self._allows_domain = any(rule.allow for _, rule in local)
        self._join = self._decide_join(self._grant)
        self._prepare(own, local)

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

    # ── preparing ──────────────────────────────────────────────────────────────────────────

    def _on_domain(self, rules: list[tuple[int, Rule]]) -> list[tuple[int, Rule]]:
        """The rules for the domain, up to the one over whose domains the vendor crashes."""
        found = []
        for index, rule in rules:
            holds = holds_for(self._traits.open_range, rule.domains, self._domain)
            if holds is None:
                self._crash_at = index
                break
            if holds:
                found.append((index, rule))
        return found

    def _prepare(self, own: list[tuple[int, Rule]], local: list[tuple[int, Rule]]) -> None:
        traits = self._traits
        checked = local if traits.filters_own_domain else own
        self._own = {verb: Rights(traits, checked, verb.value) for verb in _ENDPOINTS}
        self._peers = self._own
        if not traits.filters_own_domain:
            self._peers = {verb: Rights(traits, local, verb.value) for verb in _ENDPOINTS}
        self._either = Rights(traits, local, "publish", "subscribe")

    def _decide_join(self, grant: Grant) -> Decision:
        traits, rule = self._traits, self._governed.rule
        where = f"domain {self._domain}"
        if traits.always_needs_allow_rule and not any(each.allow for each in grant.rules):
            return self._refused("no-rule", "the grant has no allow rule, so nothing starts")
        if rule is None:
            text = f"the governance does not list {where}"
            if traits.needs_domain_rule:
                return self._refused("domain-not-in-governance", text)
            text += "; the participant starts, but no endpoint can be created"
            return self._answer(Outcome.ALLOWED, "domain-not-in-governance", text)
        if (
            traits.refuses_open_rtps
            and rule.allow_unauthenticated_participants
            and rule.rtps_protection_kind is not Protection.NONE
        ):
            return self._refused(
                "unauthenticated-with-rtps-protection",
                "the governance lets unauthenticated participants in and protects RTPS",
            )
        if not rule.enable_join_access_control:
            return self._answer(
                Outcome.ALLOWED, "unrestricted", f"joining {where} is not access controlled"
            )
        if self._allows_domain:
            return self._answer(Outcome.ALLOWED, "allow-rule", f"an allow rule holds on {where}")
        missing = f"no allow rule of the grant holds on {where}"
        if traits.always_needs_allow_rule or not self._governed.all_controlled():
            return self._answer(Outcome.PEER_DENIES, "no-rule", missing)
        if self._crash_at is not None:
            return self._crash(self._crash_at)
        if traits.honours_default and grant.default_allow:
            return self._answer(Outcome.ALLOWED, "default", "the grant's default is ALLOW")
        return self._refused("no-rule", missing)

    # ── answering ──────────────────────────────────────────────────────────────────────────

    def _endpoint(self, verb: Verb, topic: str, partitions: tuple[str, ...]) -> Decision:
        join = self._join
        if join.outcome in (Outcome.REFUSED, Outcome.CRASHES):
            return join
        traits = self._traits
        if traits.creates_topics and not _is_topic_name(topic):
            return self._answer(Outcome.DENIED, "invalid-name", f"{topic!r} is no name for a topic")
        rule = self._governed.topic_rule(topic)
        if rule is None:
            if self._governed.rule is None:
                reason, what = "domain-not-in-governance", f"does not list domain {self._domain}"
            else:
                reason, what = "no-topic-rule", f"has no topic rule for {topic}"
            return self._answer(Outcome.DENIED, reason, f"the governance {what}")
        if traits.crashes_on_empty_expressions and not rule.topic_expression.strip():
            text = "a topic rule of the governance is without its expression, over which it crashes"
            return self._answer(Outcome.CRASHES, EMPTY_TOPIC, text)
        controlled = (
            rule.enable_write_access_control
            if verb is Verb.PUBLISH
            else rule.enable_read_access_control
        )
        if (
            traits.creates_topics
            and rule.enable_write_access_control
            and rule.enable_read_access_control
        ):
            verdict = self._either.ask_topic(topic)
            if not self._permits(verdict):
                return self._verdict(verb, topic, verdict, rule, Outcome.DENIED)
        if not controlled:
            if join.outcome is Outcome.PEER_DENIES and not self._in_the_open(rule):
                return self._peer_denies_all(rule)
            return self._answer(
                Outcome.ALLOWED,
                "unrestricted",
                f"the governance leaves {verb.value} {topic} open to everybody",
                topic_rule=rule,
            )
        verdict = self._own[verb].ask(topic, partitions)
        if not self._permits(verdict):
            return self._verdict(verb, topic, verdict, rule, Outcome.DENIED)
        if join.outcome is Outcome.PEER_DENIES:
            return self._peer_denies_all(rule)
        if self._peers is not self._own:
            remote = self._peers[verb].ask(topic, partitions)
            if not remote.allowed:
                return self._verdict(verb, topic, remote, rule, Outcome.PEER_DENIES)
        return self._verdict(verb, topic, verdict, rule, Outcome.ALLOWED)

    def _permits(self, verdict: Verdict) -> bool:
        if verdict.rule is not None or not self._traits.honours_default:
            return verdict.allowed
        # Past the last rule before a crash, only the crash is certain.
        return self._crash_at is None and self._grant is not None and self._grant.default_allow

    def _verdict(
        self, verb: Verb, topic: str, verdict: Verdict, rule: TopicRule, outcome: Outcome
    ) -> Decision:
        if verdict.rule is None and self._crash_at is not None:
            return self._crash(self._crash_at)
        if verdict.reason == EMPTY_TOPIC and verdict.rule is not None:
            text = f"rule {verdict.rule + 1} has a <topic> without text, over which it crashes"
            return self._answer(Outcome.CRASHES, EMPTY_TOPIC, text, verdict.rule)
        asked = f"{verb.value} {topic}"
        number = f"rule {verdict.rule + 1}" if verdict.rule is not None else ""
        reason = verdict.reason
        match reason:
            case "allow-rule":
                text = f"{number} allows {asked} by {verdict.expression}"
            case "deny-rule":
                text = f"{number} denies {asked} by {verdict.expression}"
            case "partition":
                text = f"{number} names {verdict.expression}, but not the partitions of {asked}"
            case _ if outcome is Outcome.PEER_DENIES:
                text = f"no rule for domain {self._domain} allows {asked}, and peers see to that"
            case _ if self._traits.honours_default:
                reason = "default"
                word = "ALLOW" if outcome is Outcome.ALLOWED else "DENY"
                text = f"no rule names {asked}, and the grant's default is {word}"
            case _:
                text = f"no rule allows {asked}"
        return self._answer(
            outcome, reason, text, verdict.rule, verdict.expression, topic_rule=rule
        )

    def _in_the_open(self, rule: TopicRule) -> bool:
        """Whether even participants that refuse each other exchange the topic."""
        domain = self._governed.rule
        return (
            self._traits.shares_open_topics
            and domain is not None
            and domain.rtps_protection_kind is Protection.NONE
            and not (rule.enable_read_access_control or rule.enable_write_access_control)
            and rule.metadata_protection_kind is Protection.NONE
            and rule.data_protection_kind is Protection.NONE
        )

    def _peer_denies_all(self, rule: TopicRule) -> Decision:
        return self._answer(
            Outcome.PEER_DENIES,
            "peer-refuses-participant",
            f"no allow rule of the grant holds on domain {self._domain}, so peers refuse it",
            topic_rule=rule,
        )

    def _refused(self, reason: str, text: str) -> Decision:
        return self._answer(Outcome.REFUSED, reason, text)

    def _crash(self, rule: int) -> Decision:
        return self._answer(
            Outcome.CRASHES,
            "open-range",
            f"rule {rule + 1} has a range of domains without <min>, over which it crashes",
            rule,
        )

    def _answer(
        self,
        outcome: Outcome,
        reason: str,
        text: str,
        rule: int | None = None,
        expression: str | None = None,
        *,
        topic_rule: TopicRule | None = None,
    ) -> Decision:
        return Decision(
            outcome,
            reason,
            f"{self._traits.title}: {text}.",
            self._grant_index,
            rule,
            expression,
            topic_rule,
        )


def _is_topic_name(name: str) -> bool:
    """Whether Cyclone DDS 0.10 takes it: letters, digits, ``_`` and ``/``, no digit first."""
    return bool(_TOPIC_NAME.match(name))
