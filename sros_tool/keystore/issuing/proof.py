"""Proves that permissions say what the policy says that they were made from, before they are used.

A policy allows what something allows and nothing denies; DDS takes the first rule that matches.
Both mean the same if the document has one grant, its denials stand first, every rule is for all of
its domains and without partitions, nothing else is allowed, and the expressions are those of the
policy: for every name then, mentioned or not.  That is a comparison of sets, cheap enough to make
of every document.  Where it does not hold, and wherever there is little to sign, the decision
engine is asked for every name that either of them mentions, and for names that none mentions.

The DDS names are written down here a second time, from the ROS 2 design "Topic and Service name
mapping to DDS", so that an error of `sros_tool.translate` does not prove itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import Outcome, Verb
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, TopicRule, settings
from sros_tool.dds.permissions import Permissions
from sros_tool.errors import KeystoreError
from sros_tool.keystore.issuing.issuance import Make
from sros_tool.names import ROS_DISCOVERY_TOPIC, expand, is_expression
from sros_tool.policy.model import ALLOW, Enclave
from sros_tool.policy.patterns import common_name, matches, overlap
from sros_tool.translate import permissions_for
from sros_tool.validity import Window

ASKED = (Vendor.STANDARD, Vendor.FAST)
"""Whose decisions have to be those of the policy; Fast DDS 2.9 reads such documents as 2.14.

Not Cyclone DDS 0.10: it denies a topic in both directions if one is denied, which is remarked on
(``portable.deny-blocks-topic``) and cannot be said otherwise.
"""

FEW = 4
"""Up to so many enclaves are signed at once, asking the engine for each takes no time to notice."""

_MOST_ASKED = 200
_SET = re.compile(r"\[!?[^\]]+\]")
_CHARACTERS = "nabcdefghijklmopqrstuvwxyz_/0123456789" + "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_OUT, _IN = "publish", "subscribe"
_ACTION_SERVICES = ("send_goal", "cancel_goal", "get_result")
_ACTION_TOPICS = ("feedback", "status")


def _service(client: bool, part: str = "") -> tuple[tuple[str, str, str], ...]:
    """Both topics of a service: the direction, what stands before the name, and what behind it."""
    ask, answer = (_OUT, _IN) if client else (_IN, _OUT)
    return (ask, "rq", f"{part}Request"), (answer, "rr", f"{part}Reply")


def _action(client: bool) -> tuple[tuple[str, str, str], ...]:
    told = _IN if client else _OUT
    services = (end for p in _ACTION_SERVICES for end in _service(client, f"/_action/{p}"))
    return (*services, *((told, "rt", f"/_action/{topic}") for topic in _ACTION_TOPICS))


_ENDPOINTS = {
    "publish": ((_OUT, "rt", ""),),
    "subscribe": ((_IN, "rt", ""),),
    "request": _service(True),
    "reply": _service(False),
    "call": _action(True),
    "execute": _action(False),
}


@dataclass(slots=True)
class Expressions:
    """The DDS expressions that are allowed and denied, for writing and for reading."""

    allowed: dict[str, set[str]]
    denied: dict[str, set[str]]

    @classmethod
    def none(cls) -> Expressions:
        """Nothing allowed, nothing denied."""
        return cls({_OUT: set(), _IN: set()}, {_OUT: set(), _IN: set()})

    def allow(self, verb: str, topic: str) -> bool:
        """What a policy means: something allows it, and nothing denies it."""
        return _meant(self.allowed[verb], topic) and not _meant(self.denied[verb], topic)

    def count(self) -> int:
        """How many expressions there are."""
        return sum(1 for _ in self.all())

    def all(self) -> Iterator[str]:
        """Every expression, perhaps more than once."""
        for side in (self.allowed, self.denied):
            for expressions in side.values():
                yield from expressions


@dataclass(frozen=True, slots=True)
class Difference:
    """A DDS topic on which policy and permissions do not agree; ``meant`` is what the policy says.

    ``outcome`` is what the vendor decides.
    """

    verb: str
    topic: str
    meant: bool
    vendor: Vendor
    outcome: Outcome

    def __str__(self) -> str:
        """As ``publish rt/x is allowed, and Fast DDS 2.14 says denied``."""
        meant = "allowed" if self.meant else "denied"
        return f"{self.verb} {self.topic} is {meant}, and {self.vendor.title} says {self.outcome}"


def proven(policy: Enclave, domains: DomainSet, *, ask: bool) -> Make:
    """Makes the permissions that a policy states, each proven to say what the policy says.

    With ``ask`` the decision engine is asked, too; see `prove`.
    """

    def make(subject: str, validity: Window) -> Permissions:
        permissions = permissions_for(policy, subject=subject, validity=validity, domains=domains)
        prove(policy, permissions, domains, ask=ask)
        return permissions

    return make


def prove(
    policy: Enclave, permissions: Permissions, domains: DomainSet, *, ask: bool = False
) -> None:
    """Raise `KeystoreError` unless ``permissions`` decide as ``policy`` does on all ``domains``.

    With ``ask`` the engine is asked even where the comparison says enough, unless the document
    has more names than are asked for in a moment.
    """
    stated = stated_expressions(policy)
    if signed_expressions(permissions, domains) == stated and not (
        ask and stated.count() <= _MOST_ASKED
    ):
        return
    found = differences(policy, permissions, domains)
    if found:
        raise KeystoreError(
            f"the permissions of {policy.path} would not be what the policy says",
            f"For the policy, {found[0]}"
            + (f" ({len(found) - 1} differences more)." if len(found) > 1 else "."),
            "Nothing was written. This is an error of sros: please report it with the policy.",
        )


def stated_expressions(policy: Enclave) -> Expressions:
    """What a policy states of an enclave, in the names of DDS, with what every participant has."""
    found = Expressions.none()
    for verb in (_OUT, _IN):
        found.allowed[verb].add(ROS_DISCOVERY_TOPIC)
    for profile in policy.all_profiles():
        ns, node = profile.ns, profile.node
        for group in profile.groups:
            names = [expand(name, ns, node) for name in group.names]
            for right, qualifier in group.rights:
                into = found.allowed if qualifier is ALLOW else found.denied
                for verb, before, behind in _ENDPOINTS[right]:
                    into[verb].update([f"{before}{name}{behind}" for name in names])
    return found


def signed_expressions(permissions: Permissions, domains: DomainSet) -> Expressions | None:
    """What permissions say, if they have the form in which the order of rules does not matter."""
    if len(permissions.grants) != 1 or permissions.grants[0].default_allow:
        return None
    found = Expressions.none()
    allowing = False
    for rule in permissions.grants[0].rules:
        if (allowing and not rule.allow) or rule.domains != domains or rule.relay:
            return None
        allowing = rule.allow
        into = found.allowed if allowing else found.denied
        for verb, all_criteria in ((_OUT, rule.publish), (_IN, rule.subscribe)):
            for criteria in all_criteria:
                if criteria.partitions or criteria.data_tags:
                    return None
                into[verb].update(criteria.topics)
    return found


# ── by the decision engine ─────────────────────────────────────────────────────────────────


def differences(
    policy: Enclave,
    permissions: Permissions,
    domains: DomainSet,
    vendors: Iterable[Vendor] = ASKED,
) -> list[Difference]:
    """Where the vendors' decisions are not what the policy says, over all `telling_topics`."""
    stated = stated_expressions(policy)
    topics = telling_topics([*stated.all(), *_topics(permissions)])
    found = []
    for vendor in vendors:
        for domain in _ends(domains):
            access = _access(vendor, permissions, domain)
            for topic in topics:
                for verb in (_OUT, _IN):
                    meant = stated.allow(verb, topic)
                    outcome = access.decide(Verb(verb), topic).outcome
                    if outcome.ok != meant:
                        found.append(Difference(verb, topic, meant, vendor, outcome))
    return found


def telling_topics(expressions: Iterable[str]) -> tuple[str, ...]:
    """Topics that tell apart what the expressions mean, sorted.

    Every one that is mentioned; for each wildcard one that it means, one that only it means, and
    one for each other wildcard that it overlaps; and one that nothing means, in each of ROS'
    prefixes.
    """
    known = sorted(set(expressions))
    wild = [each for each in known if is_expression(each)]
    found: set[str | None] = {each for each in known if not is_expression(each)}
    for index, one in enumerate(wild):
        found.add(_only(one, known))
        found.add(common_name([one], absolute=False))
        for other in wild[index + 1 :]:
            if overlap(one, other):
                found.add(common_name([one, other], absolute=False))
    for prefix in ("rt/*", "rq/*Request", "rr/*Reply", "*"):
        found.add(_only(prefix, known))
    return tuple(sorted(each for each in found if each))


def _only(one: str, known: list[str]) -> str | None:
    """A name that only ``one`` means, if there is a simple one."""
    for letter in ("never_mentioned", "n", "0", ""):
        name = _SET.sub(_member, one).replace("*", letter).replace("?", "n")
        if matches(one, name) and not any(matches(each, name) for each in known if each != one):
            return name
    return None


def _member(found: re.Match[str]) -> str:
    """A character that a set stands for."""
    return next((c for c in _CHARACTERS if matches(found[0], c)), "")


def _ends(domains: DomainSet) -> tuple[int, ...]:
    """The first and the last domain of each range."""
    ends = ((part.first, part.last) for part in domains.closed().ranges)
    return tuple(sorted({end for pair in ends for end in pair if end is not None}))


def _access(vendor: Vendor, permissions: Permissions, domain: int) -> Access:
    """The decisions for the document's own subject, in the middle of its validity."""
    grant = permissions.grants[0]
    window = grant.validity
    middle = window.not_before + (window.not_after - window.not_before) / 2
    at = datetime.fromtimestamp(int(middle.timestamp()), UTC) + timedelta(seconds=1)
    governance = _everything_controlled(domain)
    return Access(vendor, governance, permissions, grant.subject, domain=domain, at=at)


def _everything_controlled(domain: int) -> Governance:
    topic = TopicRule("*", **settings(TopicRule, protect=True))
    rule = DomainRule(
        domains=DomainSet.of((domain, domain)),
        topic_access_rules=(topic,),
        **settings(DomainRule, protect=True),
    )
    return Governance((rule,))


def _topics(permissions: Permissions) -> Iterator[str]:
    for grant in permissions.grants:
        for rule in grant.rules:
            for criteria in (*rule.publish, *rule.subscribe):
                yield from criteria.topics


def _meant(expressions: set[str], topic: str) -> bool:
    return topic in expressions or any(
        matches(each, topic) for each in expressions if is_expression(each)
    )
