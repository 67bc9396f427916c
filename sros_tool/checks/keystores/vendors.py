"""Check how each DDS vendor decides on an enclave: whether a node can start, and its rights.

The decision engine is the same as for `sros explain`.  A vendor's refusal is not reported if
another finding already names its cause.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from sros_tool.checks.keystores.documents import PARTITIONS, UNREACHABLE
from sros_tool.checks.keystores.enclaves import fault_remedy, grant_of
from sros_tool.checks.keystores.opened import CheckedEnclave
from sros_tool.checks.keystores.topic_names import NO_ROS_NAME, has_invalid_characters, is_for_ros
from sros_tool.checks.kind import ERROR, WARNING, Cause, Finding, FindingKind, names_text
from sros_tool.dds.decision.access import Access, AccessVerb, Outcome
from sros_tool.dds.decision.vendors import TESTED, Vendor, joined_titles
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant
from sros_tool.distributions import Distribution, shipped_title
from sros_tool.errors import DocumentError
from sros_tool.faults import FAULTS, Fault
from sros_tool.keystore.layout import PERMISSIONS_FILE
from sros_tool.keystore.participant import (
    JoinContext,
    RefusalCause,
    VendorParticipant,
    accepted_state,
    loaded_enclave,
)
from sros_tool.keystore.reader import OpenedEnclave
from sros_tool.names import (
    NODE_SERVICES,
    ROS_DISCOVERY_TOPIC,
    dds_names,
    has_type_descriptions,
    is_expression,
    service_of,
)
from sros_tool.policy.patterns import common_name, overlap
from sros_tool.wording import counted, enumerated, first_few

_ENGINE_SOURCE = (
    "sros: its decision engine, compared with Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0."
)
_SEE_VENDORS_REMEDY = "`sros explain --all-vendors` shows the answer of each vendor."

REFUSED = FindingKind(
    "enclave.refused",
    ERROR,
    "an enclave that no DDS vendor accepts",
    "Every vendor refuses the enclave, or peers refuse its nodes, so no node can run in it. With "
    "--vendor, only that vendor counts.",
    _ENGINE_SOURCE,
    f"Replace the files that the vendors refuse. {_SEE_VENDORS_REMEDY}",
)
SOME_REFUSE = FindingKind(
    "portable.refused",
    WARNING,
    "an enclave that some DDS vendors refuse",
    "With one RMW, a node runs in the enclave; with another RMW, it fails or finds no peer.",
    _ENGINE_SOURCE,
    "Use an RMW of a vendor that accepts the enclave, or replace the files that the other "
    f"vendors refuse. {_SEE_VENDORS_REMEDY}",
)
DIFFER = FindingKind(
    "portable.vendors-differ",
    WARNING,
    "vendors that decide differently on the same permissions",
    "An access that works with one RMW is denied, or open to everybody, with another.",
    _ENGINE_SOURCE,
    "Sign the rights in the form that sros writes: `sros create_permission KEYSTORE ENCLAVE "
    "POLICY_FILE`. `sros explain --all-vendors` shows the decision of each vendor.",
)

_IDS_BY_REASON: Mapping[str, frozenset[str]] = {
    reason: frozenset(ids)
    for reason, ids in {
        Fault.SIGNATURE_HASH.id: ("portable.signature-hash",),
        Fault.KEY_ALGORITHM.id: ("portable.key-algorithm",),
        Fault.KEY_ON_TOKEN.id: ("portable.key-on-token",),
        Fault.DOCUMENT_SIZE.id: ("portable.document-size",),
        Fault.CA_CHAIN.id: ("portable.intermediate", "keystore.not-a-ca"),
        Fault.CERTIFICATE_ISSUER.id: ("portable.intermediate", "keystore.not-a-ca"),
        Fault.SIGNATURE.id: (
            *("portable.ca-purpose", "portable.intermediate", "enclave.signer-no-ca"),
        ),
        Fault.GOVERNANCE_MALFORMED.id: ("governance.domain-range",),
        Fault.PERMISSIONS_MALFORMED.id: (
            *("portable.domain-range", "portable.empty-topic", "portable.grant-name"),
            "portable.time-format",
        ),
        "domain-not-in-governance": ("enclave.governance-domain", "enclave.permissions-domains"),
        "empty-default": ("portable.empty-default",),
        "empty-topic": ("portable.empty-topic",),
        "expired": (
            *("enclave.permissions-expired", "enclave.permissions-local-time"),
            *("enclave.permissions-malformed", "portable.time-format", "portable.several-grants"),
        ),
        "malformed": ("portable.time-format", "enclave.permissions-malformed"),
        "no-grant": ("enclave.permissions-subject", "portable.subject"),
        "no-rule": (
            *("enclave.permissions-domain", "enclave.permissions-domains"),
            "portable.default-first",
        ),
        "no-topic-rule": ("governance.no-topic-rule",),
        "not-yet-valid": (
            *("enclave.permissions-not-yet-valid", "enclave.permissions-local-time"),
            *("enclave.permissions-malformed", "portable.time-format", "portable.several-grants"),
        ),
        "open-range": ("portable.domain-range", "enclave.permissions-malformed"),
        "unauthenticated-with-rtps-protection": ("governance.unauthenticated",),
    }.items()
}
"""Reason of a vendor's refusal → ids of other findings that name the same cause."""

_OUTCOME_VERBS = {
    Outcome.CRASHES: ("crash on it", "crashes on it"),
    Outcome.PEER_DENIES: (
        "let it start, and its peers refuse it",
        "lets it start, and its peers refuse it",
    ),
}
_HIT_PEERS_VERBS = ("let it start, and its peers crash", "lets it start, and its peers crash")
_REFUSAL_VERBS = ("refuse it", "refuses it")


def asked_vendors(words: Sequence[str]) -> tuple[Vendor, ...]:
    """Return the DDS vendors with the names in ``words``, or all if ``words`` is empty.

    Leaves out vendors whose real library was not tried.  ``zenoh`` is no DDS vendor, so that
    ``("zenoh",)`` gives no vendor.
    """
    return tuple(vendor for vendor in TESTED if not words or vendor.value in words)


class EnclaveEvaluation(NamedTuple):
    """The decisions of DDS vendors on an enclave.

    ``enclave`` is the loaded enclave with its faults for these vendors; ``by_domain`` maps a ROS
    domain to the participant of each vendor.  ``portable`` says that the permissions have the
    portable form that sros writes.  ``distributions`` are the ROS 2 distributions that the enclave
    is for, or () for any.
    """

    enclave: CheckedEnclave
    by_domain: Mapping[int, Mapping[Vendor, VendorParticipant]]
    portable: bool
    distributions: tuple[Distribution, ...] = ()

    def titles(self, vendors: Sequence[Vendor]) -> list[str]:
        """Return the titles of vendors, with the distributions that ship them."""
        if not self.distributions:
            return joined_titles(vendor.title for vendor in vendors)
        return [shipped_title(vendor, self.distributions) for vendor in vendors]


def evaluate(
    enclave: CheckedEnclave,
    vendors: Sequence[Vendor],
    domain: int | None,
    distributions: tuple[Distribution, ...] = (),
) -> EnclaveEvaluation:
    """Evaluate an enclave as the vendors do.

    Args:
        enclave: the enclave.
        vendors: the vendors that the enclave's nodes may use.
        domain: the ROS domain to join; None for the domains in the enclave's documents.
        distributions: the ROS 2 distributions that the enclave is for, which findings name.
    """
    keystore = enclave.keystore
    loaded = loaded_enclave(enclave.name, enclave.folder, enclave.state, moment=keystore.at.now)
    numbers = (domain,) if domain is not None else example_domains(enclave.state)
    by_domain = {
        number: {
            vendor: VendorParticipant(
                vendor, loaded, JoinContext(number, keystore.at.now, keystore.at.zone)
            )
            for vendor in vendors
        }
        for number in numbers
    }
    participants = [
        participant for by_vendor in by_domain.values() for participant in by_vendor.values()
    ]
    state = accepted_state(enclave.state, participants) if participants else enclave.state
    checked = CheckedEnclave(keystore, enclave.name, state)
    return EnclaveEvaluation(checked, by_domain, loaded.portable is not None, distributions)


def check_vendors(
    evaluation: EnclaveEvaluation, known_findings: Collection[Finding]
) -> Iterator[Finding]:
    """Yield findings about refusals by vendors, and about decisions in which vendors differ.

    ``known_findings`` are the other findings about the enclave and its CAs.
    """
    for domain, participants in evaluation.by_domain.items():
        if findings := list(_refusal_findings(evaluation, participants, known_findings)):
            yield from findings
            return
        # Comparing each topic takes time, and vendors decide alike on usual names in documents as
        # sros writes them.
        if evaluation.portable and not any(_is_about_rules(finding) for finding in known_findings):
            continue
        ids = {finding.id for finding in known_findings}
        if findings := list(_different_rights_findings(evaluation, participants, domain, ids)):
            yield from findings
            return


def example_domains(state: OpenedEnclave) -> tuple[int, ...]:
    """Return example domains of an enclave: one for each group of domains with the same rules.

    At most `_MOST_DOMAINS` domains; only domain 0 if the enclave can join none.
    """
    if state.governance is None:
        return (0,)
    rules = [rule.domains for rule in state.governance.domain_access_rules]
    granted = [rule.domains for rule in state.grant.rules] if state.grant else []
    if len(sets := {*rules, *granted}) == 1:
        (only,) = sets
        return (next(iter(only.closed()), 0),)
    joined = state.joined_domains() or DomainSet(())
    kinds = DomainSet.one_of_each_kind([joined], [*rules, *granted])
    return tuple(kind for kind in kinds if kind in joined)[:_MOST_DOMAINS] or (0,)


_MOST_DOMAINS = 8


# ── who refuses it ─────────────────────────────────────────────────────────────────────────


def _refusal_findings(
    evaluation: EnclaveEvaluation,
    participants: Mapping[Vendor, VendorParticipant],
    known_findings: Collection[Finding],
) -> Iterator[Finding]:
    """Yield an error if all vendors refuse the enclave, or else the refusals by some vendors.

    Yields nothing if errors in ``known_findings`` name a cause for every vendor.  A refusal by only
    some vendors is left out if a finding in ``known_findings`` names its cause.
    """
    enclave = evaluation.enclave
    causes = {vendor: participant.causes() for vendor, participant in participants.items()}
    by_cause: dict[RefusalCause, list[Vendor]] = {}
    for vendor, cause in causes.items():
        for refusal_cause in cause:
            by_cause.setdefault(refusal_cause, []).append(vendor)
    if not by_cause:
        return
    all_refuse = all(causes.values())
    if all_refuse:
        errors = [
            finding for finding in known_findings if finding.kind.severity is ERROR
        ]  # errors by kind, also those that the keystore's template accepts
        if all(
            any(_is_cause_named(refusal_cause, errors) for refusal_cause in cause)
            for cause in causes.values()
        ):
            return
    else:
        by_cause = {
            cause: vendors
            for cause, vendors in by_cause.items()
            if not _is_cause_named(cause, known_findings)
        }
        if not by_cause:
            return
    clauses = [
        refusal_clause(cause, evaluation.titles(vendors)) for cause, vendors in by_cause.items()
    ]
    accepting = evaluation.titles([vendor for vendor, cause in causes.items() if not cause])
    if accepting:
        clauses.append(
            f"{enumerated(accepting)} {'accepts' if len(accepting) == 1 else 'accept'} it"
        )
    first = next(iter(by_cause))
    fault = FAULTS.get(first.reason)
    yield (REFUSED if all_refuse else SOME_REFUSE).found(
        enclave.name,
        "; ".join(clauses),
        enclave.file(first.file),
        remedy=fault_remedy(enclave, fault, first.file) if fault else "",
    )


def _is_cause_named(cause: RefusalCause, known_findings: Iterable[Finding]) -> bool:
    """Return whether a known finding already names the cause of a refusal."""
    wanted = _IDS_BY_REASON.get(cause.reason, frozenset())
    fault_id = f"enclave.{cause.reason}"
    return any(
        finding.id in wanted or (finding.id == fault_id and _file_name(finding) == cause.file)
        for finding in known_findings
    )


def _is_about_rules(finding: Finding) -> bool:
    """Return whether a finding is about the rules of the permissions or the names in them."""
    family, _, _ = finding.id.partition(".")
    return family in {"permissions", "portable"} and _file_name(finding) == PERMISSIONS_FILE


def _file_name(finding: Finding) -> str:
    """Return the name, without folder, of the file that a finding is about."""
    return finding.file.rpartition("/")[2]


def refusal_clause(cause: RefusalCause, titles: Sequence[str]) -> str:
    """Return a clause on how vendors with these titles react to a cause of refusal."""
    plural, singular = (
        _HIT_PEERS_VERBS if cause.hits_peers else _OUTCOME_VERBS.get(cause.outcome, _REFUSAL_VERBS)
    )
    says = singular if len(titles) == 1 else plural
    return f"{enumerated(titles)} {says} ({cause.text})"


# ── what they decide differently ───────────────────────────────────────────────────────────

_UNNAMED_TOPIC = "rt/sros_nobody_has_this"
_BLANKS_FINDING_ID = "portable.blanks"
_MOST_SHOWN = 3


def _different_rights_findings(
    evaluation: EnclaveEvaluation,
    participants: Mapping[Vendor, VendorParticipant],
    domain: int,
    known: Collection[str],
) -> Iterator[Finding]:
    """Yield a finding if vendors decide differently on a topic that the permissions name.

    ``known`` are the ids of the other findings about the enclave.
    """
    enclave = evaluation.enclave
    answers = {
        vendor: participant.access
        for vendor, participant in participants.items()
        if participant.access and not participant.causes()
    }
    differing = list(_differences(evaluation, answers, _topics_to_ask(enclave, known)))
    if differing:
        text = f"in domain {domain}, {first_few(differing, _MOST_SHOWN, '; ', '; and ')}"
        yield DIFFER.found(enclave.name, text, enclave.file(PERMISSIONS_FILE))


def _differences(
    evaluation: EnclaveEvaluation, answers: Mapping[Vendor, Access], topics: list[str]
) -> Iterator[str]:
    questions = [
        (verb, topic) for topic in topics for verb in (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)
    ]
    for verb, topic in questions:
        vendors_by_outcome: dict[Outcome, list[Vendor]] = {}
        for vendor, answer in answers.items():
            vendors_by_outcome.setdefault(answer.decide(verb, topic).outcome, []).append(vendor)
        if len({outcome.ok for outcome in vendors_by_outcome}) > 1:
            answers_text = ", ".join(
                f"{', '.join(evaluation.titles(vendors))}: {outcome.value}"
                for outcome, vendors in vendors_by_outcome.items()
            )
            yield f"{verb.value} {topic} ({answers_text})"


def _topics_to_ask(enclave: CheckedEnclave, known_ids: Collection[str]) -> list[str]:
    """Return topics to compare: the named topics, examples of wildcards, and an unnamed topic.

    If a finding in ``known_ids`` reports names that are no ROS names, these names are left out.
    """
    grant = grant_of(enclave)
    named: dict[str, None] = {ROS_DISCOVERY_TOPIC: None}
    for rule in grant.rules if grant else ():
        for criteria in (*rule.publish, *rule.subscribe):
            for topic in criteria.topics:
                if not (_BLANKS_FINDING_ID in known_ids and topic != topic.strip()) and not (
                    NO_ROS_NAME.id in known_ids and has_invalid_characters(topic)
                ):
                    named[_example_name(topic)] = None
    return [*named, _UNNAMED_TOPIC]


def _example_name(expression: str) -> str:
    """Return an example name that matches a wildcard; a [set] becomes its first character."""
    if not is_expression(expression):
        return expression
    name, index = "", 0
    while index < len(expression):
        letter = expression[index]
        end = expression.find("]", index + 2) if letter == "[" else -1
        if end > 0:
            members = expression[index + 1 : end].lstrip("!^")
            negated = expression[index + 1] in "!^"
            name += "x" if negated or not members[:1].isalnum() else members[0]
            index = end
        else:
            name += "x" if letter in "*?" else letter
        index += 1
    return name


NO_NODE = FindingKind(
    "enclave.node-cannot-start",
    ERROR,
    "permissions with which no ordinary ROS 2 node can start",
    "A node of rclpy or rclcpp exits when it starts if an endpoint that the finding names is "
    "denied. Nodes that were created without these endpoints do not need them, but every process "
    "needs ros_discovery_info.",
    "ROS 2 Jazzy, rcl 9, rclcpp 28, rclpy 7 and rmw_dds_common; ~/get_type_description since Iron "
    "(REP-2016).",
    "Include common/node.xml in the profiles of the enclave's nodes (`sros check POLICY_FILE` says "
    "how), and sign the policy with `sros generate_artifacts -k KEYSTORE -p POLICY_FILE`.",
)
_PARAMETER_EVENTS, _ROSOUT = "rt/parameter_events", "rt/rosout"
_ENDPOINTS_OF_TOOLS = (
    (AccessVerb.PUBLISH, ROS_DISCOVERY_TOPIC),
    (AccessVerb.SUBSCRIBE, ROS_DISCOVERY_TOPIC),
    (AccessVerb.PUBLISH, _PARAMETER_EVENTS),
)
_ENDPOINTS_OF_NODES = (*_ENDPOINTS_OF_TOOLS, (AccessVerb.PUBLISH, _ROSOUT))
_TYPES_SERVICE = "get_type_description"
_UNNAMED_NODE = "/sros_nobody_has_this"


class _Denial(NamedTuple):
    """The endpoints that an ordinary node needs and that a vendor denies.

    ``text`` is a clause; ``by`` names the deciding deny rule in the words of findings; in the
    partition ``partition``, the access would be allowed.
    """

    text: str
    by: str = ""
    partition: str = ""

    def __str__(self) -> str:
        """Return the clause with its reason."""
        if self.by:
            return f"{self.text}, as {self.by}"
        where = f", except in partition {self.partition}, which ROS 2 does not use"
        return f"{self.text}{where if self.partition else ''}"

    def explains(self, finding: Finding) -> bool:
        """Return whether a finding about the same permissions already names this denial's cause."""
        if finding.kind is UNREACHABLE:
            return bool(self.by) and finding.text.endswith(self.by[self.by.index("denies") :])
        return finding.kind is PARTITIONS and bool(self.partition)


def with_start_finding(
    evaluation: EnclaveEvaluation, known_findings: Sequence[Finding]
) -> list[Finding]:
    """Return the findings, plus an error if no vendor lets an ordinary node start in the enclave.

    Vendors that refuse the enclave do not count.  If the error is added, known findings with the
    same cause are left out.

    An enclave that has only some of the rights that every node needs gets no error: it is for a
    tool such as the observer of `sros generate_policy`, which has no log and no services.
    """
    enclave = evaluation.enclave
    grant = grant_of(enclave)
    if grant is None or not is_for_ros(grant):
        return [*known_findings]
    described = has_type_descriptions(enclave.keystore.at.distribution)
    if evaluation.portable and _names_all_node_topics(grant):
        return [*known_findings]
    has_denials = any(not rule.allow for rule in grant.rules)
    for domain, participants in evaluation.by_domain.items():
        running = [p for p in participants.values() if not p.causes()]
        # Vendors decide alike on documents as sros writes them, so one vendor is enough.
        asked = running[:1] if evaluation.portable and not has_denials else running
        denials = [
            _ordinary_node_denial(participant, grant, described=described) for participant in asked
        ]
        if not denials or None in denials:
            continue
        longest_denial = max(filter(None, denials), key=lambda denial: len(denial.text))
        where = f"in domain {domain}, " if len(evaluation.by_domain) > 1 else ""
        if len(running) < len(participants):
            titles = evaluation.titles([participant.vendor for participant in running])
            where += f"on {' and '.join(titles)} "
        finding = NO_NODE.found(
            enclave.name, f"{where}{longest_denial}", enclave.file(PERMISSIONS_FILE)
        )
        return [*(known for known in known_findings if not longest_denial.explains(known)), finding]
    return [*known_findings]


def _names_all_node_topics(grant: Grant) -> bool:
    """Return whether the only rule of a grant names every topic that a node needs."""
    if len(grant.rules) != 1 or not grant.rules[0].allow:
        return False
    published, subscribed = (
        {topic for criteria in side_criteria for topic in criteria.topics}
        for side_criteria in (grant.rules[0].publish, grant.rules[0].subscribe)
    )
    return (
        published.issuperset(
            topic for verb, topic in _ENDPOINTS_OF_NODES if verb is AccessVerb.PUBLISH
        )
        and ROS_DISCOVERY_TOPIC in subscribed
        and any(
            names.subscribe[0] in subscribed
            for topic in published
            if topic.endswith(f"/{_TYPES_SERVICE}Reply") and not is_expression(topic)
            for names in (dds_names("reply", service_of(topic)[0]),)
        )
    )


def _ordinary_node_denial(
    participant: VendorParticipant, grant: Grant, *, described: bool
) -> _Denial | None:
    """Return the endpoints that an ordinary node needs and a vendor denies; None without a denial.

    None also if the enclave is only for a tool, as in `with_start_finding`.

    ``described`` says that nodes offer ~/get_type_description (since ROS 2 Iron).
    """
    access = participant.access
    assert access is not None
    denied = [
        endpoint for endpoint in _ENDPOINTS_OF_NODES if not access.decide(*endpoint).outcome.ok
    ]
    verbs = [verb.value for verb, topic in denied if topic == ROS_DISCOVERY_TOPIC]
    wanted = [f"{' or '.join(verbs)} {ROS_DISCOVERY_TOPIC}"] if verbs else []
    wanted += [
        f"{verb.value} {topic.removeprefix('rt')}"
        for verb, topic in denied
        if topic != ROS_DISCOVERY_TOPIC
    ]
    if described and not _may_offer_type_description(access, grant):
        wanted.append(f"offer ~/{_TYPES_SERVICE}")
    is_tool = not set(denied).intersection(_ENDPOINTS_OF_TOOLS)
    if not wanted or (is_tool and not any(map(_is_topic_of_robot, _allowed_to_publish(grant)))):
        return None
    text = f"no node may {' or '.join(wanted)}"
    for verb, topic in denied:
        decision = access.decide(verb, topic)
        if decision.reason == "deny-rule":
            rule = (decision.rule or 0) + 1
            return _Denial(text, by=f"rule {rule} denies {decision.expression}")
        for name in _partitions(grant):
            if access.decide(verb, topic, (name,)).outcome.ok:
                return _Denial(text, partition=name)
    return _Denial(text)


def _partitions(grant: Grant) -> tuple[str, ...]:
    """Return the partitions in allow rules, without duplicates."""
    return tuple(
        dict.fromkeys(
            name
            for rule in grant.rules
            if rule.allow
            for criteria in (*rule.publish, *rule.subscribe)
            for name in criteria.partitions
            if name
        )
    )


def _may_offer_type_description(access: Access, grant: Grant) -> bool:
    """Return whether a node of any name may offer ~/get_type_description.

    Tries a node name that no rule names, and an example name for each matching expression.
    """
    wanted = dds_names("reply", f"/*/{_TYPES_SERVICE}").publish[0]
    return any(
        all(access.publish(topic).outcome.ok for topic in names.publish)
        and all(access.subscribe(topic).outcome.ok for topic in names.subscribe)
        for node in _nodes_to_try(grant, wanted)
        for names in (dds_names("reply", f"{node}/{_TYPES_SERVICE}"),)
    )


def _nodes_to_try(grant: Grant, wanted: str) -> Iterator[str]:
    """Yield a node that no rule names, and a node for each expression that overlaps ``wanted``."""
    yield _UNNAMED_NODE
    with suppress(DocumentError):  # too many wildcards
        for expression in _allowed_to_publish(grant):
            if not overlap(expression, wanted):
                continue
            # If only the part after the node's name has a wildcard, that node is the example.
            beginning = expression.partition("*")[0].rpartition("/")[0]
            topic = f"{beginning}/{_TYPES_SERVICE}Reply"
            if not is_expression(topic) and overlap(topic, wanted) and overlap(expression, topic):
                example: str | None = topic
            else:
                example = common_name([expression, wanted], absolute=False)
            if example:
                yield service_of(example)[0].removesuffix(f"/{_TYPES_SERVICE}")


def _allowed_to_publish(grant: Grant) -> Iterator[str]:
    """Yield the topic expressions in the publish criteria of the grant's allow rules."""
    for rule in grant.rules:
        for criteria in rule.publish if rule.allow else ():
            yield from criteria.topics


def _is_topic_of_robot(topic: str) -> bool:
    """Return whether a topic belongs to the robot, and not to the topics that every node has."""
    name = topic.rpartition("/")[2].removesuffix("Reply")
    common = topic in (ROS_DISCOVERY_TOPIC, _PARAMETER_EVENTS, _ROSOUT)
    return not common and name not in NODE_SERVICES


def with_causes(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings, with a common cause if several enclaves let no node start."""
    similar_findings: dict[str, list[Finding]] = defaultdict(list)
    for finding in findings:
        if finding.kind is NO_NODE:
            similar_findings[finding.text].append(finding)
    causes = {
        text: Cause(
            f"{counted(len(group), 'enclave')} in which no ordinary ROS 2 node can start",
            f"In {names_text([finding.subject for finding in group])}, {text}. {NO_NODE.why}",
            group[0].remedy,
            len(group),
        )
        for text, group in similar_findings.items()
        if len(group) > 1
    }
    return [
        finding._replace(cause=causes.get(finding.text)) if finding.kind is NO_NODE else finding
        for finding in findings
    ]
