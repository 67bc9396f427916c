"""Questions to the access control of DDS (verbs), and its answers (outcomes, decisions)."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, NamedTuple

from sros_tool.dds.governance import TopicRule
from sros_tool.values import shows


class AccessVerb(StrEnum):
    """An action of a participant that access control allows or denies."""

    JOIN = "join"
    PUBLISH = "publish"
    SUBSCRIBE = "subscribe"


class Outcome(StrEnum):
    """The outcome for a participant or endpoint."""

    ALLOWED = "allowed"
    DENIED = "denied"
    """Creating the endpoint fails."""
    PEER_DENIES = "peer denies"
    """The participant or endpoint is created, but permitted peers do not match it."""
    REFUSED = "refused"
    """The participant does not start at all."""
    CRASHES = "crashes"
    """The process crashes, or its peers do (`Decision.hits_peers`)."""

    @property
    def ok(self) -> bool:
        """Whether data can flow."""
        return self is Outcome.ALLOWED


OutcomeWord = Annotated[
    Outcome,
    "What happens: creating it fails (`denied`), peers do not match it (`peer denies`), the "
    "process does not start (`refused`), or it or its peers crash (`crashes`).",
]
ReasonWord = Annotated[str, "Why, as a stable word such as `no-rule`."]


@shows("outcome", "reason", "expression")
class Decision(NamedTuple):
    """The outcome of a question to access control, and what decided it.

    ``reason`` is a fixed word for programs (one of `_REASONS`), ``text`` a sentence for people.
    ``grant`` is an index in the permissions, ``rule`` an index in the grant, ``expression`` the
    ``<topic>`` that matched, ``topic_rule`` the rule of the governance for the topic. With
    ``hits_peers``, the processes of peers crash, but not the participant's own.
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
        """The text without the vendor's name at the beginning and the full stop at the end."""
        _, colon, text = self.text.partition(": ")
        return (text if colon else self.text).removesuffix(".")


_REASONS = {
    "allow-rule": "an allow rule matches",
    "deny-rule": "a deny rule matches",
    "partition": "the rule that decides does not name the partitions",
    "default": "no rule matches, so the default of the grant decides",
    "no-rule": "no rule allows it, and the vendor ignores the default",
    "unrestricted": "the governance does not control this access",
    "no-topic-rule": "no topic rule of the governance matches the topic",
    "domain-not-in-governance": "no domain rule of the governance lists the domain",
    "peer-refuses-participant": "peers do not accept the participant on this domain",
    "no-grant": "no grant names the subject",
    "empty-subject": "a certificate with an empty subject crashes the process",
    "blank-subject": "a grant whose subject has a part of blanks crashes the process",
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
    """Why a vendor does not accept a document; ``outcome`` is REFUSED or CRASHES."""

    reason: str
    text: str
    outcome: Outcome = Outcome.REFUSED

    def decision(self) -> Decision:
        """Return the decision on any access: it fails with this refusal."""
        return Decision(self.outcome, self.reason, self.text)
