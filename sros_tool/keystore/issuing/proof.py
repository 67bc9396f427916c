"""Proof that permissions give exactly the rights of the policy they are made from.

A policy allows a topic if a rule allows it and no rule denies it.  DDS applies the first rule that
matches.  Policy and DDS decide alike for every topic name if

- the document has one grant, its deny rules come first, every rule is for all domains of the
  keystore and without partitions, the default is to deny, and its expressions equal the policy's.
  (A name can be missing if a wildcard of the same list matches it anyway.)  This is checked by
  comparing the two sets of expressions;
- the function by which each vendor matches an expression with wildcards matches the same names as a
  policy does.  This is checked with test names on which two such functions could differ.  (Without
  wildcards, an expression matches only itself.)

Both comparisons are made for every document.  If one fails, the decision engine is asked about
example topics: every name in the policy or the document, and names in neither.

The DDS names are defined here a second time, so that the proof finds an error of
`sros_tool.translate`.  Source: ROS 2 design "Topic and Service name mapping to DDS".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache

from sros_tool.dds.decision.access import Access, AccessVerb, GovernedDomain, Outcome
from sros_tool.dds.decision.expressions import ExpressionIndex
from sros_tool.dds.decision.expressions import matches as dds_matches
from sros_tool.dds.decision.vendors import Style, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, TopicRule, attribute_values
from sros_tool.dds.permissions import Permissions
from sros_tool.errors import KeystoreError
from sros_tool.names import ROS_DISCOVERY_TOPIC, expand, is_expression
from sros_tool.policy.model import ALLOW, Enclave
from sros_tool.policy.patterns import common_name, matches, overlap
from sros_tool.wording import counted

_COMPARED_VENDORS = (Vendor.STANDARD, Vendor.FAST)
"""The vendors that must decide as the policy does.

On these documents, Fast DDS 2.9 decides as 2.14 does.  Cyclone DDS 0.10 is left out, because it
denies a topic in both directions if one direction is denied.  No document can avoid this; a note
reports it (``portable.deny-blocks-topic``).
"""

_CHARACTER_SET = re.compile(r"\[!?[^\]]+\]")
_CHARACTERS = "nabcdefghijklmopqrstuvwxyz_/0123456789" + "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_PUBLISH, _SUBSCRIBE = "publish", "subscribe"
_ACTION_SERVICES = ("send_goal", "cancel_goal", "get_result")
_ACTION_TOPICS = ("feedback", "status")


def _service_topics(is_client: bool, part: str = "") -> tuple[tuple[str, str, str], ...]:
    """Return (direction, prefix, suffix) of both DDS topics of a service.

    The direction is that of a client (``is_client``) or a server.  ``part`` stands between the name
    and the suffix, as in the services of an action.
    """
    ask, answer = (_PUBLISH, _SUBSCRIBE) if is_client else (_SUBSCRIBE, _PUBLISH)
    return (ask, "rq", f"{part}Request"), (answer, "rr", f"{part}Reply")


def _action_topics(is_client: bool) -> tuple[tuple[str, str, str], ...]:
    """Return (direction, prefix, suffix) of all DDS topics of an action.

    The direction is as in `_service_topics`.
    """
    direction = _SUBSCRIBE if is_client else _PUBLISH
    parts = (f"/_action/{name}" for name in _ACTION_SERVICES)
    services = (topic for part in parts for topic in _service_topics(is_client, part))
    return (*services, *((direction, "rt", f"/_action/{topic}") for topic in _ACTION_TOPICS))


_ENDPOINTS = {
    "publish": ((_PUBLISH, "rt", ""),),
    "subscribe": ((_SUBSCRIBE, "rt", ""),),
    "request": _service_topics(True),
    "reply": _service_topics(False),
    "call": _action_topics(True),
    "execute": _action_topics(False),
}


@dataclass(slots=True)
class ExpressionSets:
    """The DDS expressions that are allowed and denied, by direction (publish, subscribe)."""

    allowed: dict[str, set[str]]
    denied: dict[str, set[str]]

    @classmethod
    def none(cls) -> ExpressionSets:
        """Return the empty sets: no right and no denial."""
        return cls({_PUBLISH: set(), _SUBSCRIBE: set()}, {_PUBLISH: set(), _SUBSCRIBE: set()})

    def allows(self, verb: str, topic: str) -> bool:
        """Return whether a policy allows ``verb`` ("publish", "subscribe") for the DDS ``topic``.

        It does if an expression in ``allowed`` matches, and no expression in ``denied``.
        """
        return _any_matches(self.allowed[verb], topic) and not _any_matches(
            self.denied[verb], topic
        )

    def matches_same_names(self, stated: ExpressionSets) -> bool:
        """Return whether these sets match the same names as the sets ``stated``.

        The sets must be subsets of ``stated``, and may lack only names that one of their wildcards
        matches.
        """
        return all(
            own <= theirs and _are_matched_by_wildcards(theirs - own, own)
            for own, theirs in self.paired_sets(stated)
        )

    def paired_sets(self, other: ExpressionSets) -> Iterator[tuple[set[str], set[str]]]:
        """Yield pairs of sets of the same kind and direction: from ``self``, and from ``other``."""
        for own, theirs in ((self.allowed, other.allowed), (self.denied, other.denied)):
            for verb in (_PUBLISH, _SUBSCRIBE):
                yield own[verb], theirs[verb]

    def all(self) -> Iterator[str]:
        """Yield every expression, perhaps more than once."""
        for side in (self.allowed, self.denied):
            for expressions in side.values():
                yield from expressions


@dataclass(frozen=True, slots=True)
class Disagreement:
    """A DDS topic on which policy and permissions disagree.

    ``allowed`` says whether the policy allows the topic; ``outcome`` is the decision of ``vendor``.
    """

    verb: str
    topic: str
    allowed: bool
    vendor: Vendor
    outcome: Outcome

    def __str__(self) -> str:
        """Return text such as ``publish rt/x is allowed, but Fast DDS 2.14 decides: denied``."""
        stated = "allowed" if self.allowed else "denied"
        return (
            f"{self.verb} {self.topic} is {stated}, but {self.vendor.title} decides: {self.outcome}"
        )


def prove(policy: Enclave, permissions: Permissions, domains: DomainSet) -> None:
    """Raise `KeystoreError` unless ``permissions`` allow exactly what ``policy`` allows.

    The permissions must do so in all ``domains``.
    """
    stated = stated_expressions(policy)
    wildcards = {expression for expression in stated.all() if is_expression(expression)}
    signed = signed_expressions(permissions, domains)
    if signed and signed.matches_same_names(stated) and all(map(is_matched_as_meant, wildcards)):
        return
    disagreements = differences(policy, permissions, domains)
    if disagreements:
        raise KeystoreError(
            f"the permissions of {policy.path} would not match the policy",
            f"By the policy, {disagreements[0]}"
            + (
                f" (and {counted(len(disagreements) - 1, 'more difference')})."
                if len(disagreements) > 1
                else "."
            ),
            "Nothing was written. This is a defect of sros: please report it with the policy.",
        )


def _are_matched_by_wildcards(left_out: set[str], expressions: set[str]) -> bool:
    """Return whether each name in ``left_out`` (no wildcards) matches one of ``expressions``."""
    if not left_out:
        return True
    wildcards = list(filter(is_expression, expressions))
    index = ExpressionIndex(Style.FNMATCH, wildcards)
    return all(
        not is_expression(name)
        and any(matches(wildcards[position], name) for position in index.matching(name))
        for name in left_out
    )


@lru_cache(maxsize=4096)
def is_matched_as_meant(expression: str) -> bool:
    """Return whether vendors and policies agree on which example names an expression matches."""
    return all(
        dds_matches(vendor.traits.style, expression, name) == matches(expression, name)
        for name in example_topics([expression])
        for vendor in _COMPARED_VENDORS
    )


def stated_expressions(policy: Enclave) -> ExpressionSets:
    """Return the rights that a policy gives an enclave, as DDS expressions.

    The topic of ROS discovery, which every node needs, is added.
    """
    expressions = ExpressionSets.none()
    for verb in (_PUBLISH, _SUBSCRIBE):
        expressions.allowed[verb].add(ROS_DISCOVERY_TOPIC)
    for profile in policy.all_profiles():
        ns, node = profile.ns, profile.node
        for group in profile.groups:
            names = [expand(name, ns, node) for name in group.names]
            for right, qualifier in group.rights:
                by_verb = expressions.allowed if qualifier is ALLOW else expressions.denied
                for verb, before, behind in _ENDPOINTS[right]:
                    by_verb[verb].update([f"{before}{name}{behind}" for name in names])
    return expressions


def signed_expressions(permissions: Permissions, domains: DomainSet) -> ExpressionSets | None:
    """Return the expressions that permissions allow and deny.

    The result is None if the permissions do not have the form that the docstring of this module
    describes.
    """
    if len(permissions.grants) != 1 or permissions.grants[0].default_allow:
        return None
    expressions = ExpressionSets.none()
    allowing = False
    for rule in permissions.grants[0].rules:
        if (allowing and not rule.allow) or rule.domains != domains or rule.relay:
            return None
        allowing = rule.allow
        by_verb = expressions.allowed if allowing else expressions.denied
        for verb, all_criteria in ((_PUBLISH, rule.publish), (_SUBSCRIBE, rule.subscribe)):
            for criteria in all_criteria:
                if criteria.partitions or criteria.data_tags:
                    return None
                by_verb[verb].update(criteria.topics)
    return expressions


# ── comparison by the decision engine ────────────────────────────────────────────────────


def differences(
    policy: Enclave,
    permissions: Permissions,
    domains: DomainSet,
    vendors: Iterable[Vendor] = _COMPARED_VENDORS,
) -> list[Disagreement]:
    """Return the topics on which a vendor's decision differs from the policy's.

    Three kinds of topics are compared: the `example_topics` of all expressions together; those of
    each wildcard expression by itself; and a topic for each expression that only the policy or only
    the permissions have.
    """
    stated = stated_expressions(policy)
    expressions = {*stated.all(), *_topics_in(permissions)}
    topics = set(example_topics(expressions))
    for expression in filter(is_expression, expressions):
        topics.update(example_topics([expression]))
    signed = signed_expressions(permissions, domains)
    for pair in signed.paired_sets(stated) if signed else ():
        for left, right in (pair, pair[::-1]):
            names = (common_name([n], sorted(right), absolute=False) for n in left - right)
            topics.update(filter(None, names))
    disagreements = []
    for vendor in vendors:
        for domain in _range_ends(domains):
            access = _access(vendor, permissions, domain)
            for topic in sorted(topics):
                for verb in (_PUBLISH, _SUBSCRIBE):
                    allowed = stated.allows(verb, topic)
                    outcome = access.decide(AccessVerb(verb), topic).outcome
                    if outcome.ok != allowed:
                        disagreements.append(Disagreement(verb, topic, allowed, vendor, outcome))
    return disagreements


def example_topics(expressions: Iterable[str]) -> tuple[str, ...]:
    """Return sorted example topics that tell the expressions apart.

    They are:

    - each expression without wildcards;
    - for each expression with wildcards: a topic that it matches, a topic that no other expression
      matches, and a topic that it shares with each overlapping expression;
    - for each ROS prefix, a topic that no expression matches.
    """
    known = sorted(set(expressions))
    wild = [expression for expression in known if is_expression(expression)]
    topics: set[str | None] = {name for name in known if not is_expression(name)}
    for index, wildcard in enumerate(wild):
        topics.add(_uniquely_matched_name(wildcard, known))
        topics.add(_matching_name(wildcard))
        for other_expression in wild[index + 1 :]:
            if overlap(wildcard, other_expression):
                topics.add(common_name([wildcard, other_expression], absolute=False))
    for prefix in ("rt/*", "rq/*Request", "rr/*Reply", "*"):
        topics.add(_uniquely_matched_name(prefix, known))
    return tuple(sorted(topic for topic in topics if topic))


def _matching_name(expression: str) -> str | None:
    """Return a name that an expression matches; None if it matches no valid name."""
    name = expression.replace("*", "n")
    # Searching for the shortest name takes long, so it is only done if this name still has a
    # wildcard.
    return common_name([expression], absolute=False) if is_expression(name) else name


def _uniquely_matched_name(expression: str, known: list[str]) -> str | None:
    """Return a name that only ``expression`` matches; None if no simple name does."""
    for letter in ("never_mentioned", "n", "0", ""):
        name = _CHARACTER_SET.sub(_member_of_set, expression).replace("*", letter).replace("?", "n")
        if matches(expression, name) and not any(
            matches(other_expression, name)
            for other_expression in known
            if other_expression != expression
        ):
            return name
    return None


def _member_of_set(match: re.Match[str]) -> str:
    """Return a character that a set such as ``[a-c]`` matches, or ""."""
    return next((c for c in _CHARACTERS if matches(match[0], c)), "")


def _range_ends(domains: DomainSet) -> tuple[int, ...]:
    """Return the first and the last domain of each range in ``domains``, sorted."""
    ends = ((part.first, part.last) for part in domains.closed().ranges)
    return tuple(sorted({end for pair in ends for end in pair if end is not None}))


def _access(vendor: Vendor, permissions: Permissions, domain: int) -> Access:
    """Return the access control of ``vendor`` for the subject of the first grant.

    The time is the middle of the grant's validity.
    """
    grant = permissions.grants[0]
    window = grant.validity
    middle = window.not_before + (window.not_after - window.not_before) / 2
    at = datetime.fromtimestamp(int(middle.timestamp()), UTC) + timedelta(seconds=1)
    governed = GovernedDomain(vendor, _governance_with_access_control(domain), domain)
    return Access(governed, permissions, grant.subject, moment=at)


def _governance_with_access_control(domain: int) -> Governance:
    topic = TopicRule("*", **attribute_values(TopicRule, protect=True))
    rule = DomainRule(
        domains=DomainSet.of((domain, domain)),
        topic_access_rules=(topic,),
        **attribute_values(DomainRule, protect=True),
    )
    return Governance((rule,))


def _topics_in(permissions: Permissions) -> Iterator[str]:
    for grant in permissions.grants:
        for rule in grant.rules:
            for criteria in (*rule.publish, *rule.subscribe):
                yield from criteria.topics


def _any_matches(expressions: set[str], topic: str) -> bool:
    return topic in expressions or any(
        matches(expression, topic) for expression in expressions if is_expression(expression)
    )
