"""Whether an ordinary node of ROS 2 can start in an enclave, as the vendors decide."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from sros_tool.checks.keystores.documents import PARTITIONS, UNREACHABLE
from sros_tool.checks.keystores.enclaves import grant_of
from sros_tool.checks.keystores.topic_names import is_for_ros
from sros_tool.checks.keystores.vendors import EnclaveEvaluation
from sros_tool.checks.kind import ERROR, Cause, Finding, FindingKind, some_names
from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.dds.permissions import Grant
from sros_tool.errors import DocumentError
from sros_tool.keystore.layout import PERMISSIONS_FILE
from sros_tool.keystore.participant import VendorParticipant
from sros_tool.names import (
    NODE_SERVICES,
    ROS_DISCOVERY_TOPIC,
    has_type_descriptions,
    is_expression,
)
from sros_tool.policy.patterns import common_name, overlap
from sros_tool.topics import dds_names, service_of
from sros_tool.wording import counted

NO_NODE = FindingKind(
    "enclave.node-cannot-start",
    ERROR,
    "permissions with which no ordinary node of ROS 2 can start",
    "A node of rclpy or rclcpp creates these endpoints when it starts, and exits if one of them is "
    "denied. The permissions say nothing of nodes that were created without them; "
    "ros_discovery_info no process can do without.",
    "ROS 2 Jazzy, rcl 9, rclcpp 28, rclpy 7 and rmw_dds_common; ~/get_type_description since Iron "
    "(REP-2016).",
    "Include common/node.xml in the profiles of its nodes (`sros check POLICY_FILE` says how), and "
    "sign the policy with `sros generate_artifacts -k ROOT -p POLICY_FILE`.",
)
_PARAMETER_EVENTS, _ROSOUT = "rt/parameter_events", "rt/rosout"
_OF_TOOLS = (
    (AccessVerb.PUBLISH, ROS_DISCOVERY_TOPIC),
    (AccessVerb.SUBSCRIBE, ROS_DISCOVERY_TOPIC),
    (AccessVerb.PUBLISH, _PARAMETER_EVENTS),
)
_ENDPOINTS = (*_OF_TOOLS, (AccessVerb.PUBLISH, _ROSOUT))
_TYPES = "get_type_description"
_SOME_NODE = "/sros_nobody_has_this"


@dataclass(frozen=True, slots=True)
class _Denial:
    """What a vendor denies of that which an ordinary node needs.

    ``text`` is a clause; ``by`` is the deny rule that decides, as findings name it, and
    ``partition`` one in which it would be allowed.
    """

    text: str
    by: str = ""
    partition: str = ""

    def __str__(self) -> str:
        """Return the clause with its reason."""
        if self.by:
            return f"{self.text}, as {self.by}"
        where = f", unless in partition {self.partition}, which ROS 2 does not use"
        return f"{self.text}{where if self.partition else ''}"

    def explains(self, finding: Finding) -> bool:
        """Return whether a finding about the same permissions has the same cause."""
        if finding.kind is UNREACHABLE:
            return bool(self.by) and finding.text.endswith(self.by[self.by.index("denies") :])
        return finding.kind is PARTITIONS and bool(self.partition)


def check_starting(evaluation: EnclaveEvaluation, known: Sequence[Finding]) -> list[Finding]:
    """Return the findings, with another if no vendor lets an ordinary node start in the enclave.

    Vendors that refuse the enclave are not asked.  Of the ``known`` findings about the enclave,
    those with the same cause are left out.

    An enclave with a part of what every node needs, and nothing else, is for a tool such as the
    observer of `sros generate_policy`, which has no log and no services.
    """
    enclave = evaluation.enclave
    grant = grant_of(enclave)
    if grant is None or not is_for_ros(grant):
        return [*known]
    described = has_type_descriptions(enclave.keystore.distribution)
    if evaluation.portable and _states_all(grant):
        return [*known]
    has_denials = any(not rule.allow for rule in grant.rules)
    for domain, made in evaluation.by_domain.items():
        running = [each for each in made.values() if not each.causes()]
        # Vendors decide alike on a document as sros writes it.
        asked = running[:1] if evaluation.portable and not has_denials else running
        denials = [_denial(each, grant, described=described) for each in asked]
        if not denials or None in denials:
            continue
        worst = max(filter(None, denials), key=lambda each: len(each.text))
        where = f"on domain {domain}, " if len(evaluation.by_domain) > 1 else ""
        if len(running) < len(made):
            where += f"on {' and '.join(each.vendor.title for each in running)} "
        found = NO_NODE.found(enclave.name, f"{where}{worst}", enclave.file(PERMISSIONS_FILE))
        return [*(each for each in known if not worst.explains(each)), found]
    return [*known]


def _states_all(grant: Grant) -> bool:
    """Return whether the only rule of a grant names all that a node needs: no vendor denies it."""
    if len(grant.rules) != 1 or not grant.rules[0].allow:
        return False
    published, subscribed = (
        {topic for criteria in some for topic in criteria.topics}
        for some in (grant.rules[0].publish, grant.rules[0].subscribe)
    )
    return (
        published.issuperset(topic for verb, topic in _ENDPOINTS if verb is AccessVerb.PUBLISH)
        and ROS_DISCOVERY_TOPIC in subscribed
        and any(
            names.subscribe[0] in subscribed
            for each in published
            if each.endswith(f"/{_TYPES}Reply") and not is_expression(each)
            for names in (dds_names("reply", service_of(each)[0]),)
        )
    )


def _denial(participant: VendorParticipant, grant: Grant, *, described: bool) -> _Denial | None:
    """Return what a vendor denies of that which an ordinary node needs, or None.

    ``described`` says that nodes describe their types.
    """
    access = participant.access
    assert access is not None
    denied = [each for each in _ENDPOINTS if not access.decide(*each).outcome.ok]
    verbs = [verb.value for verb, topic in denied if topic == ROS_DISCOVERY_TOPIC]
    wanted = [f"{' or '.join(verbs)} {ROS_DISCOVERY_TOPIC}"] if verbs else []
    wanted += [
        f"{verb.value} {topic.removeprefix('rt')}"
        for verb, topic in denied
        if topic != ROS_DISCOVERY_TOPIC
    ]
    if described and not _offers_types(access, grant):
        wanted.append(f"offer ~/{_TYPES}")
    is_tool = not set(denied).intersection(_OF_TOOLS)
    if not wanted or (is_tool and not any(map(_is_own, _written(grant)))):
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
    """Return the partitions that allow rules name, once."""
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


def _offers_types(access: Access, grant: Grant) -> bool:
    """Return whether the node of some name may describe its types.

    Asked are a name that no rule has, and an example for each expression that fits.
    """
    wanted = dds_names("reply", f"/*/{_TYPES}").publish[0]
    nodes = [_SOME_NODE]
    with suppress(DocumentError):  # too many wildcards
        fitting = (each for each in _written(grant) if overlap(each, wanted))
        examples = (common_name([each, wanted], absolute=False) for each in fitting)
        nodes += [service_of(each)[0].removesuffix(f"/{_TYPES}") for each in examples if each]
    for node in nodes:
        names = dds_names("reply", f"{node}/{_TYPES}")
        if all(access.publish(each).outcome.ok for each in names.publish) and all(
            access.subscribe(each).outcome.ok for each in names.subscribe
        ):
            return True
    return False


def _written(grant: Grant) -> Iterator[str]:
    """Yield the topics that allow rules let the enclave publish."""
    for rule in grant.rules:
        for criteria in rule.publish if rule.allow else ():
            yield from criteria.topics


def _is_own(topic: str) -> bool:
    """Return whether a topic is one of the robot, not one that every node has."""
    name = topic.rpartition("/")[2].removesuffix("Reply")
    common = topic in (ROS_DISCOVERY_TOPIC, _PARAMETER_EVENTS, _ROSOUT)
    return not common and name not in NODE_SERVICES


def with_causes(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings; those of several enclaves in which no node can start have one cause."""
    same: dict[str, list[Finding]] = defaultdict(list)
    for each in findings:
        if each.kind is NO_NODE:
            same[each.text].append(each)
    causes = {
        text: Cause(
            f"{counted(len(group), 'enclave')} in which no ordinary node of ROS 2 can start",
            f"In {some_names([each.subject for each in group])}, {text}. {NO_NODE.why}",
            group[0].remedy,
            len(group),
        )
        for text, group in same.items()
        if len(group) > 1
    }
    return [
        replace(each, cause=causes.get(each.text)) if each.kind is NO_NODE else each
        for each in findings
    ]
