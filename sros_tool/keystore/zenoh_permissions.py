"""The rights that signed permissions give, in the form of Zenoh rules.

The permissions need not be written by sros.  Zenoh has no partitions, so only the default partition
counts, in which ROS nodes open their topics.  In Zenoh, the rules have no order, so the topics of
an earlier rule are subtracted from later rules.  The result is compared with the decisions of each
vendor.  If two vendors differ, or if the order of the rules cannot be expressed, the permissions
are refused.

One difference between vendors is accepted: on Cyclone DDS 0.10, a denial of one direction also
keeps an enclave from the other direction of the topic (``portable.deny-blocks-topic``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from string import ascii_letters, digits

from sros_tool.automata import Automaton, Letters, NameSet
from sros_tool.dds.decision.access import AccessVerb, GrantedAccess, Refusal, choose_grant
from sros_tool.dds.decision.documents import are_canonical_permissions, read_permissions_as
from sros_tool.dds.decision.expressions import names_of
from sros_tool.dds.decision.vendors import TESTED, DocumentReader, Style, Vendor, joined_titles
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Criteria, Grant, Permissions, Rule, parse_permissions
from sros_tool.errors import DocumentError, PolicyError
from sros_tool.names import expression_problem, is_expression
from sros_tool.policy.model import ALLOW, RIGHTS, Source
from sros_tool.policy.patterns import covers, matches, overlap
from sros_tool.policy.rights import Right, parts
from sros_tool.translate import grant_rights
from sros_tool.translate_zenoh.rights import StatedRight
from sros_tool.wording import capitalized

_ROS_VENDORS = (*TESTED, Vendor.CONNEXT)
"""The vendors of ROS 2, whose decisions must be the same; Connext stands for the standard."""
_ACCESS_VERBS = (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)
_REMEDY_STATE_RIGHTS = "State the rights of the enclave in a policy, with `sros create_permission`."
_TOPIC_PREFIX = "rt"
"""The prefix of ROS topics on DDS."""
_ROS_PREFIXES = (_TOPIC_PREFIX, "rq", "rr")


def grant_for_all_vendors(document: bytes, name: str, subject: str) -> Grant | None:
    """Return the grant in signed permissions on which all vendors agree; None if there is none.

    ``name`` is the name of the document in errors, and ``subject`` the subject of the certificate.

    Raises:
        DocumentError: a vendor refuses the document, or reads other rules from it.
    """
    permissions = parse_permissions(document, name)
    grant = permissions.grant_of(subject)
    single = len(permissions.grants) == 1
    if grant is None or (single and are_canonical_permissions(permissions, document)):
        return grant
    validity = grant.validity
    at = (validity.not_before + (validity.not_after - validity.not_before) / 2).astimezone(UTC)
    read: dict[DocumentReader, Permissions | Refusal] = {}
    for vendor in _ROS_VENDORS:
        reader = vendor.traits.reader
        if reader not in read:
            read[reader] = read_permissions_as(vendor, document)
        chosen = _grant_for(vendor, read[reader], subject, at)
        if isinstance(chosen, Refusal):
            raise DocumentError(f"not every DDS vendor accepts {name}: {chosen.text}")
        if (chosen.rules, chosen.default_allow) != (grant.rules, grant.default_allow):
            raise DocumentError(
                f"{name} are not the same for every DDS vendor: {vendor.title} uses other rules"
            )
    return grant


def _grant_for(
    vendor: Vendor, permissions: Permissions | Refusal, subject: str, moment: datetime
) -> Grant | Refusal:
    """Return the grant that a vendor applies at a time, or why it applies none."""
    if isinstance(permissions, Refusal):
        return permissions
    index = choose_grant(vendor.traits, permissions, subject, moment=moment, zone=UTC)
    return index if isinstance(index, Refusal) else permissions.grants[index]


def joined_domains(grant: Grant, domains: Iterable[int]) -> tuple[int, ...]:
    """Return the domains out of ``domains`` that an enclave may join by its permissions."""
    allowed = grant.domains()
    return tuple(domain for domain in domains if domain in allowed)


def rights_in_domain(enclave: str, grant: Grant, domain: int) -> tuple[StatedRight, ...]:
    """Return the ROS rights that signed permissions give an enclave in a ROS domain.

    If the DDS topic ``*`` may be published and subscribed, as ros2/sros2 grants it, it stands for
    all topics and services.  Other topics that are not ROS names are translated exactly if their
    wildcard begins directly after the prefix of ROS topics.  Topics that match no ROS topic are
    left out, because they are not on Zenoh.

    Raises:
        PolicyError: it is uncertain which ROS names a right or a denial is about; the default
            allows; DDS vendors do not decide alike; or the order of the rules matters in a way that
            Zenoh cannot express.
    """
    source = Source(f"the permissions of {enclave}", 0)
    if grant.default_allow:
        raise PolicyError(
            f"{source}: <default>ALLOW</default> cannot be expressed in Zenoh",
            "Some DDS vendors follow this default, and others ignore it.",
            _REMEDY_STATE_RIGHTS,
        )
    rules = [rule for rule in grant.rules if domain in rule.domains.closed()]
    if not _has_denials_first(grant):
        rules = _joined_if_unordered(rules)
        _check_vendors(source, grant, domain, rules)
    rights = set(grant_rights(enclave, grant._replace(rules=_joined_rules(rules))))
    raw = {right for right in rights if not right.name.startswith("/")}
    rights -= raw
    allow_all = {right for right in raw if right.name == "*" and right.qualifier is ALLOW}
    if {right.right for right in allow_all} == {"publish", "subscribe"}:
        rights |= {
            Right(enclave, ALLOW, right, "/*") for right in (*RIGHTS["topics"], *RIGHTS["services"])
        }
        raw -= allow_all
    for right in sorted(raw):
        if right.name.startswith(f"{_TOPIC_PREFIX}*"):
            rights |= {right._replace(name=right.name.removeprefix(_TOPIC_PREFIX))}
        elif right.qualifier is not ALLOW or _overlaps_ros_names(right.name):
            raise PolicyError(
                f"{source}: {right.describe()} cannot be expressed in Zenoh",
                "It is a DDS name, and it is uncertain which ROS names it means.",
                _REMEDY_STATE_RIGHTS,
            )
    parted = (part for right in rights for part in parts(right))
    return tuple([StatedRight(right, source) for right in sorted(set(parted))])


def _overlaps_ros_names(topic: str) -> bool:
    """Return whether a DDS topic with wildcards also matches topics of ROS names."""
    return is_expression(topic) and any(overlap(topic, f"{prefix}/*") for prefix in _ROS_PREFIXES)


# ── rules without an order ─────────────────────────────────────────────────────────────────


def _has_denials_first(grant: Grant) -> bool:
    """Return whether a grant has the form that sros writes, with denials first.

    All vendors decide alike on such a grant.
    """
    kinds = [rule.allow for rule in grant.rules]
    return (
        not (grant.default_first or grant.default_empty)
        and len({rule.domains for rule in grant.rules}) == 1
        and _have_both_ends(grant.rules[0].domains)
        and kinds == sorted(kinds)
        and not any(rule.relay for rule in grant.rules)
        and all(
            not criteria.partitions and all(map(_is_plain_topic, criteria.topics))
            for rule in grant.rules
            for criteria in (*rule.publish, *rule.subscribe)
        )
    )


def _have_both_ends(domains: DomainSet) -> bool:
    ends = ((part.first, part.last) for part in domains.ranges)
    return all(first is not None and last is not None and first <= last for first, last in ends)


def _is_plain_topic(topic: str) -> bool:
    if not topic or topic != topic.strip():
        return False
    return "[" not in topic or not expression_problem(f"/{topic}")


def _joined_if_unordered(rules: Sequence[Rule]) -> list[Rule]:
    """Return equivalent rules with denials first, for the default partition.

    A right that an earlier rule completely denies is left out.  A denial is left out if it comes
    after all rights that it concerns.
    """
    allowed: dict[AccessVerb, tuple[str, ...]] = {}
    denied: dict[AccessVerb, tuple[str, ...]] = {}
    for verb in _ACCESS_VERBS:
        # The topics that rules allow and deny, each with the position of its rule.
        allows, denies = (
            [
                (position, topic)
                for position, rule in enumerate(rules)
                if rule.allow is allow
                for topic in _topics_in_default_partition(getattr(rule, verb))
            ]
            for allow in (True, False)
        )
        kept = [
            (position, topic)
            for position, topic in allows
            if not any(at < position and covers(wide, topic) for at, wide in denies)
        ]
        allowed[verb] = tuple(topic for _, topic in kept)
        denied[verb] = tuple(
            topic
            for position, topic in denies
            if any(at > position and overlap(topic, of) for at, of in kept)
        )
    return [
        Rule(
            allow,
            DomainSet(()),
            _plain_criteria(topics[AccessVerb.PUBLISH]),
            _plain_criteria(topics[AccessVerb.SUBSCRIBE]),
        )
        for allow, topics in ((False, denied), (True, allowed))
    ]


def _topics_in_default_partition(all_criteria: Iterable[Criteria]) -> Iterator[str]:
    for criteria in all_criteria:
        if not criteria.partitions or any(matches(text, "") for text in criteria.partitions):
            yield from criteria.topics


def _plain_criteria(topics: tuple[str, ...]) -> tuple[Criteria, ...]:
    return (Criteria(topics),) if topics else ()


def _joined_rules(rules: Iterable[Rule]) -> tuple[Rule, ...]:
    """Return one rule with all denials and one with all rights, regardless of their order."""
    joined = []
    for allow in (False, True):
        alike = [rule for rule in rules if rule.allow is allow]
        publish, subscribe = (
            _plain_criteria(
                tuple(topic for rule in alike for topic in _topics(getattr(rule, verb)))
            )
            for verb in _ACCESS_VERBS
        )
        if publish or subscribe:
            joined.append(Rule(allow, alike[0].domains, publish, subscribe))
    return tuple(joined)


def _topics(all_criteria: Iterable[Criteria]) -> Iterator[str]:
    for criteria in all_criteria:
        yield from criteria.topics


def _check_vendors(source: Source, grant: Grant, domain: int, rules: Sequence[Rule]) -> None:
    """Raise `PolicyError` unless every vendor decides like ``rules``, in which denials win."""
    decisions = {vendor: GrantedAccess(vendor.traits, grant, domain) for vendor in _ROS_VENDORS}
    for verb in _ACCESS_VERBS:
        denied, allowed = (
            names_of(Style.FNMATCH, _topics(getattr(rule, verb)))
            for rule in sorted(rules, key=lambda rule: rule.allow)
        )
        meant = allowed - denied
        for decision in decisions.values():
            granted = decision.topics(verb)
            more, less = granted - meant, meant - granted
            topic = ((more | less) & _ros_topics()).example()
            if topic is not None:
                raise _vendors_differ_error(source, grant, verb, topic, decisions)


def _vendors_differ_error(
    source: Source,
    grant: Grant,
    verb: AccessVerb,
    topic: str,
    decisions: Mapping[Vendor, GrantedAccess],
) -> PolicyError:
    """Return the error for a topic on which vendors, or vendors and Zenoh, decide differently."""
    difference = f"{source}: {verb} {topic} cannot be expressed in Zenoh"
    reasons: dict[str, list[str]] = {}
    for vendor, decision in decisions.items():
        reasons.setdefault(decision.reason(verb, topic), []).append(vendor.title)
    denying = [
        number
        for number, rule in enumerate(grant.rules, 1)
        if not rule.allow
        and any(matches(expression, topic) for expression in _topics(getattr(rule, verb)))
    ]
    are_alike = len({topic in decision.topics(verb) for decision in decisions.values()}) == 1
    if not are_alike or not denying:
        differing = "; ".join(
            f"{reason} ({', '.join(joined_titles(of))})" for reason, of in reasons.items()
        )
        return PolicyError(
            f"{difference}, because DDS vendors do not "
            f"{'read the rules' if are_alike else 'decide'} alike",
            f"{capitalized(differing)}.",
            _REMEDY_STATE_RIGHTS,
        )
    return PolicyError(
        f"{difference}, because the order of the rules matters",
        f"On DDS, {next(iter(reasons))}, and rule {denying[0]} comes too late to deny it. On "
        "Zenoh, as in a policy, a deny rule wins wherever it stands.",
        f"In a policy, list the names to {verb}, without that deny rule, and sign the policy with "
        "`sros create_permission`.",
    )


@cache
def _ros_topics() -> NameSet:
    """Return the DDS topics that ROS names can have."""
    letters = [Letters.of("r"), Letters.of("tqr"), Letters.of("/"), Letters.of(_ROS_LETTERS)]
    edges = [(at, letter, at + 1) for at, letter in enumerate(letters)]
    end = len(letters)
    edges.append((end, letters[-1] | Letters.of("/"), end))
    return NameSet((), [Automaton(tuple(edges), frozenset((end,)))])


_ROS_LETTERS = f"{ascii_letters}{digits}_"
