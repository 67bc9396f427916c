"""Checks of an enclave's signed permissions and governance, and of vendors' decisions.

Vendors read documents outside of the portable profile differently, and decide differently.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import chain, islice
from math import isfinite

from sros_tool.checks.keystores.enclaves import grant_of, plain
from sros_tool.checks.keystores.opened import CheckedEnclave, CheckedKeystore
from sros_tool.checks.keystores.topic_names import check_topic_names
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind, names_text
from sros_tool.dds.decision.access import is_open_to_unauthenticated
from sros_tool.dds.decision.grants import read_date
from sros_tool.dds.decision.vendors import FAST_DDS, TESTED, DateRule, Vendor, joined_titles
from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.dds.governance import DomainRule, Governance, ProtectionKind, TopicRule, attributes
from sros_tool.dds.permissions import Criteria, Grant, Rule, portability_problems
from sros_tool.errors import SrosError
from sros_tool.faults import REFUSE_STRANGERS
from sros_tool.fleet.robots import robot_of
from sros_tool.keystore.fleet import EnclaveDomains
from sros_tool.keystore.layout import GOVERNANCE_FILE, GOVERNANCE_XML
from sros_tool.keystore.settings import LENGTHEN_PERMISSIONS, edit_remedy, lengthening_remedy
from sros_tool.keystore.template import Template
from sros_tool.names import ROS_DISCOVERY_TOPIC
from sros_tool.pki import smime
from sros_tool.policy.patterns import ComparisonLimit, Names, covers
from sros_tool.translate import governance_for
from sros_tool.validity import iso

SEVERAL_GRANTS = FindingKind(
    "portable.several-grants",
    WARNING,
    "several grants in one document",
    "Of the grants for a certificate's subject, Fast DDS uses the first that is valid now, and "
    "Cyclone DDS uses the first, valid or not. Cyclone DDS also accepts a grant whose subject "
    "has all parts of the certificate's subject, and more. Permissions are not secret: an "
    "enclave can also use a grant for its subject in the permissions of another enclave.",
    "Fast DDS 2.6 to 3.6 (Permissions.cpp), Cyclone DDS 0.10 and 11.0; tested.",
    "Write one document with one grant for each enclave.",
)
DEFAULT_ALLOW = FindingKind(
    "portable.default-allow",
    WARNING,
    "a grant that allows by default",
    "Fast DDS ignores <default>, and denies; Cyclone DDS allows everything that no rule names.",
    "Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Write <default>DENY</default>, and an allow rule for the intended topics.",
)
ALLOW_RULES = FindingKind(
    "portable.several-allow-rules",
    NOTE,
    "several allow rules in one grant",
    "Fast DDS decides by the first rule whose topic matches, and denies if the partitions of this "
    "rule do not match; Cyclone DDS goes on to a rule in which topic and partitions match.",
    "Fast DDS 2.6 to 3.6 (Permissions.cpp), Cyclone DDS 0.10 and 11.0; tested.",
    "Put all topics into one allow rule.",
    vendors=FAST_DDS,
)
PARTITIONS = FindingKind(
    "portable.partitions",
    WARNING,
    "partitions in a rule",
    "Fast DDS ignores partitions in deny rules, and denies if an allow rule matches the topic but "
    "not the partition; Cyclone DDS goes on to the next rule. ROS 2 uses only the default "
    "partition.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Leave partitions out.",
)
DEFAULT_FIRST = FindingKind(
    "portable.default-first",
    ERROR,
    "rules after the <default> of a grant",
    "Fast DDS ends a grant at its <default>, and ignores the rules that follow; Cyclone DDS reads "
    "them.",
    "omg_shared_ca_permissions.xsd; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Put <default> after the rules.",
    vendors=FAST_DDS,
)
DOMAIN_RANGE = FindingKind(
    "portable.domain-range",
    ERROR,
    "a range of domains that vendors read differently",
    "Fast DDS and Cyclone DDS read a range without <max> as a single domain. Cyclone DDS crashes "
    "on a range without <min>, and refuses domains above 230.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Write <id>, or <min> and <max> up to 230.",
)
GRANT_NAME = FindingKind(
    "portable.grant-name",
    WARNING,
    "a grant without a name",
    "Fast DDS refuses the document; Cyclone DDS accepts it.",
    "omg_shared_ca_permissions.xsd; Fast DDS 2.6 to 3.6; tested.",
    'Write <grant name="...">.',
    vendors=FAST_DDS,
)
SUBJECT = FindingKind(
    "portable.subject",
    WARNING,
    "a subject that vendors compare differently",
    "Cyclone DDS splits subjects at commas, slashes and vertical bars, and compares characters "
    "beyond ASCII in their escaped form; Fast DDS 2.6 and 2.9 treat spaces around = as part of the "
    "name.",
    "Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Write the subject in the form of RFC 4514, CN=/name, with no comma, vertical bar or quote in "
    "the name.",
)
TIME_FORMAT = FindingKind(
    "portable.time-format",
    WARNING,
    "a date that vendors read differently",
    "Fast DDS ignores the UTC offset and reads local time; Cyclone DDS refuses dates without a "
    "time, and years from 2263 on.",
    "DDS-Security 1.1, 9.4.1.3.2.2; Fast DDS 2.6 to 3.6 (mktime), Cyclone DDS 0.10 and 11.0; "
    "tested.",
    "Sign the permissions again: `sros create_permission KEYSTORE ENCLAVE POLICY_FILE` does this "
    "for one enclave, `renew --all` for all enclaves whose permissions sros has signed. In "
    "documents that sros does not sign, write CCYY-MM-DDThh:mm:ssZ.",
)
_RENEW_IN_TIME = (
    "Let the hosts run in UTC, or renew the enclave at least 14 hours before its permissions "
    "expire (`sros renew KEYSTORE ENCLAVE`)."
)
_RENEW_OR_UTC = "Let the host run in UTC, or renew the enclave (`sros renew KEYSTORE ENCLAVE`)."
TIME_WINDOW = FindingKind(
    "portable.validity-window",
    WARNING,
    "a validity that in some time zones begins too late or expires too early",
    "Fast DDS reads the dates of permissions in the host's local time: the permissions begin up "
    "to 12 hours late in the west, and expire up to 14 hours early in the east.",
    "Fast DDS 2.6 to 3.6 (mktime); tested in Los Angeles and Tokyo.",
    f"{_RENEW_IN_TIME} {LENGTHEN_PERMISSIONS}",
    vendors=FAST_DDS,
)
LOCAL_TIME = FindingKind(
    "enclave.permissions-local-time",
    ERROR,
    "permissions that Fast DDS refuses in the time zone of this host",
    'Fast DDS reads the dates of permissions in local time, and says "Not found the identity '
    'subject name in permissions file".',
    "Fast DDS 2.6 to 3.6 (mktime); tested.",
    f"{_RENEW_OR_UTC} {LENGTHEN_PERMISSIONS}",
    vendors=FAST_DDS,
)
CHARACTER_CLASS = FindingKind(
    "portable.character-class",
    WARNING,
    "a [set] of characters that vendors read differently",
    "Cyclone DDS reads [^...] and [[:class:]] as plain characters; Fast DDS supports negation and "
    "classes.",
    "Fast DDS 2.6 to 3.6 (fnmatch), Cyclone DDS 0.10 and 11.0; tested.",
    "Use * or ?, or write the names out.",
)
BLANKS = FindingKind(
    "portable.blanks",
    WARNING,
    "spaces or line ends around the name of a topic",
    "Fast DDS takes them for a part of the name, so the rule matches no topic of a node; Cyclone "
    "DDS strips them.",
    "Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Write only the name between the tags: <topic>rt/chatter</topic>.",
    vendors=FAST_DDS,
)
EMPTY_TOPIC = FindingKind(
    "portable.empty-topic",
    ERROR,
    "a <topic> without text",
    "Cyclone DDS crashes when it evaluates the rule; Fast DDS refuses the document.",
    "Cyclone DDS 0.10.2 (a fault in create_topic), Fast DDS 2.9.1; tested.",
    "Remove the empty <topic>.",
)
NO_EFFECT = FindingKind(
    "permissions.deny-without-effect",
    ERROR,
    "a deny rule after an allow rule for the same topic",
    "The first rule that matches decides, so the deny rule has no effect.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Put deny rules first, as sros does.",
)
UNREACHABLE = FindingKind(
    "permissions.unreachable-rule",
    WARNING,
    "a rule that never decides, because an earlier rule matches first",
    "The first rule that matches decides, so this rule never decides on these topics.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Remove the topic, or put the narrower rule first.",
)
DOMAINS = FindingKind(
    "enclave.permissions-domains",
    WARNING,
    "permissions and governance for different domains",
    "In a domain that only one of the two documents names, no node of the enclave can communicate.",
    "DDS-Security 1.1, 9.4.1.2 and 9.4.1.3; tested.",
    "Sign both for the same domains: `sros create_permission` uses the domains of the governance, "
    "or the robot's domain in the fleet file. If the keystore's fleet lacks the robot, first run "
    "`sros generate_artifacts -k KEYSTORE -p POLICY_FILE --fleet FLEET_FILE`.",
)
FEWER_DOMAINS = FindingKind(
    "enclave.fewer-domains",
    NOTE,
    "permissions for fewer domains than the governance",
    "In the other domains no node of the enclave can communicate. This is intended if a fleet file "
    "gives the robot a domain.",
    "DDS-Security 1.1, 9.4.1.2 and 9.4.1.3; tested.",
    "Nothing to do if the robot is in a domain of the permissions. Otherwise, sign permissions for "
    "the domain of the robot, and export the enclave again: `sros create_permission KEYSTORE "
    "ENCLAVE POLICY_FILE && sros distribute_key KEYSTORE ENCLAVE TARGET --force`.",
)

_PORTABLE_DATE = re.compile(r"(\d{4})-\d\d-\d\dT\d\d:\d\d:\d\dZ\Z")
_PORTABLE_SUBJECT = re.compile(
    r"(?:[A-Za-z0-9.]+=[^,|\"\s/][^,|\"]*|CN=/[^,|\"\s]*)(?:,(?! )[A-Za-z0-9.]+=[^,|\"/]+)*"
    r"(?:,CN=/)?\Z"
)
_LAST_YEAR = 2262
_WEST, _EAST = timedelta(hours=12), timedelta(hours=14)
_DIRECTIONS = ("publish", "subscribe")


def check_documents(enclave: CheckedEnclave) -> Iterator[Finding]:
    """Yield findings about an enclave's permissions, if their signature is valid and they parse."""
    permissions = enclave.state.permissions
    if permissions is None:
        return
    name, file = enclave.name, enclave.file("permissions.p7s")
    size = enclave.state.permissions_bytes
    if any(portability_problems(permissions, size, lambda names: Names(names).overlaps)):
        from sros_tool.checks.policies.portability import portability_findings

        yield from portability_findings(permissions, size, name, file)
    if len(permissions.grants) > 1:
        yield SEVERAL_GRANTS.found(name, f"it has {len(permissions.grants)} grants", file)
    for grant in permissions.grants:
        yield from _form_findings(grant, name, file)
    if enclave_grant := grant_of(enclave):
        yield from _validity_findings(enclave, enclave_grant, file)
        yield from _order_findings(enclave_grant, name, file)
        yield from check_topic_names(enclave, enclave_grant, file)
        yield from _domain_findings(enclave, enclave_grant, file)


def _domain_problems(domains: DomainSet) -> Iterator[str]:
    """Yield a clause for each range of domains that vendors read differently."""
    for part in domains.ranges:
        if part.first is None and part.last is None:
            continue  # the rule has no <domains>, which is an error of its own
        if part.first is None or part.last is None:
            yield f"{part} has no {'minimum' if part.first is None else 'maximum'}"
        elif part.last > MAX_DOMAIN:
            yield f"{part} goes beyond {MAX_DOMAIN}"


def _form_findings(grant: Grant, enclave: str, file: str) -> Iterator[Finding]:
    if not grant.name:
        yield GRANT_NAME.found(enclave, f"the grant for {grant.subject} has no name", file)
    if not (_PORTABLE_SUBJECT.match(grant.subject) and grant.subject.isascii()):
        yield SUBJECT.found(enclave, f"the subject is {grant.subject!r}", file)
    if grant.default_allow:
        yield DEFAULT_ALLOW.found(enclave, "<default> is ALLOW", file)
    if grant.default_first:
        yield DEFAULT_FIRST.found(enclave, "<default> stands before a rule", file)
    dates = [
        repr(moment)
        for moment in (grant.not_before, grant.not_after)
        if not (match := _PORTABLE_DATE.match(moment)) or int(match[1]) > _LAST_YEAR
    ]
    if dates:
        yield TIME_FORMAT.found(enclave, f"its validity has {' and '.join(dates)}", file)
    allow_rules = sum(rule.allow for rule in grant.rules)
    if allow_rules > 1:
        yield ALLOW_RULES.found(enclave, f"the grant has {allow_rules} allow rules", file)
    problems = [text for rule in grant.rules for text in _domain_problems(rule.domains)]
    for problem in dict.fromkeys(problems):
        yield DOMAIN_RANGE.found(enclave, f"the range {problem}", file)
    criteria = [criterion for rule in grant.rules for criterion in (*rule.publish, *rule.subscribe)]
    if any(criterion.partitions for criterion in criteria):
        yield PARTITIONS.found(enclave, _partitions_text(grant), file)
    if any(not topic.strip() for criterion in criteria for topic in criterion.topics):
        yield EMPTY_TOPIC.found(enclave, "a <topic> in a rule is empty", file)
    topics = sorted({topic for criterion in criteria for topic in criterion.topics})
    if with_character_class := [topic for topic in topics if "[^" in topic or "[:" in topic]:
        yield CHARACTER_CLASS.found(
            enclave, f"a rule names {names_text([*map(repr, with_character_class)])}", file
        )
    if blank := [topic.strip() for topic in topics if topic != topic.strip() != ""]:
        yield BLANKS.found(
            enclave, f"there are spaces or line ends around {names_text(blank)}", file
        )


def _partitions_text(grant: Grant) -> str:
    """Return a clause on topics that a rule allows only in partitions, which ROS 2 never uses.

    If there are no such topics, the clause only says that a rule names partitions.
    """
    for rule in grant.rules:
        for criteria in (*rule.publish, *rule.subscribe) if rule.allow else ():
            if (
                criteria.topics
                and criteria.partitions
                and not any(map(_is_default, criteria.partitions))
            ):
                word = "partition" if len(criteria.partitions) == 1 else "partitions"
                topics = names_text(criteria.topics)
                return (
                    f"{topics} {'is' if len(criteria.topics) == 1 else 'are'} allowed only in "
                    f"{word} {names_text(criteria.partitions)}, which ROS 2 does not use"
                )
    return "a rule names partitions"


def _is_default(partition: str) -> bool:
    """Return whether an expression matches the default partition, whose name is empty."""
    return not partition.strip("* \t\r\n")


def _validity_findings(enclave: CheckedEnclave, grant: Grant, file: str) -> Iterator[Finding]:
    now, window = enclave.keystore.at.now, grant.validity
    if not window.contains(now):
        return
    text = f"they are valid from {grant.not_before} to {grant.not_after}"
    longer = lengthening_remedy(enclave.keystore.settings, enclave.name)
    begin, end = (
        read_date(DateRule.LOCAL, moment, enclave.keystore.at.zone)
        for moment in (grant.not_before, grant.not_after)
    )
    if begin is None or end is None:
        return  # the finding TIME_FORMAT reports the dates
    if not begin <= int(now.timestamp()) <= end:
        zone, dates = enclave.keystore.at.zone, f"{_utc_text(begin)} to {_utc_text(end)}"
        utc_dates = f"in {zone} Fast DDS reads these dates as {dates}"
        accepted = enclave.expiry_accepted_by if now.timestamp() > end else ""
        text = f"{text}, and {utc_dates}"
        remedy = f"{_RENEW_OR_UTC} {longer}".rstrip()
        yield LOCAL_TIME.found(enclave.name, text, file, remedy=remedy, accepted=accepted)
    elif now - _WEST < window.not_before or now + _EAST > window.not_after:
        is_early = now - _WEST < window.not_before
        accepted = "" if is_early else enclave.expiry_accepted_by
        text = f"{text}, and now it is {iso(now)}"
        remedy = f"{_RENEW_IN_TIME} {longer}".rstrip()
        if is_early:
            moment = iso(window.not_before + _WEST)
            remedy = (
                f"Wait until {moment}: then they are valid in every time zone. Until then, let the "
                "hosts run in UTC. Sign later permissions with a not_before at least 12 hours in "
                "the past, as sros does once the CA is that old."
            )
        yield TIME_WINDOW.found(enclave.name, text, file, remedy=remedy, accepted=accepted)


def _utc_text(seconds: float) -> str:
    return iso(datetime.fromtimestamp(seconds, UTC)) if isfinite(seconds) else "never"


def _order_findings(grant: Grant, enclave: str, file: str) -> Iterator[Finding]:
    limit = ComparisonLimit()
    stated = {
        (direction, allow): _Topics(grant, direction, allow, limit)
        for direction in _DIRECTIONS
        for allow in (True, False)
    }
    for index, rule in enumerate(grant.rules):
        if rule.allow:
            yield from _unreachable_rule_findings(stated, rule, index, enclave, file)
            continue
        for direction in _DIRECTIONS:
            allowed = stated[direction, True]
            late: dict[str, list[str]] = {}
            for topic in _topics(getattr(rule, direction)):
                if met := allowed.earlier_overlapping(topic, index):
                    late.setdefault(met, []).append(topic)
            for met, topics in late.items():
                text = (
                    f"rule {index + 1} denies {direction} {names_text(topics)} after a rule that "
                )
                yield NO_EFFECT.found(enclave, f"{text}allows {met}", file)


def _unreachable_rule_findings(
    stated: Mapping[tuple[str, bool], _Topics], rule: Rule, index: int, enclave: str, file: str
) -> Iterator[Finding]:
    """Yield a finding if earlier deny rules deny topics that a rule allows.

    ``stated`` maps a direction, and whether rules allow or deny, to the topics in such rules.
    """
    hidden: dict[str, dict[str, list[str]]] = {}
    left = 0
    for direction in _DIRECTIONS:
        for topic in _topics(getattr(rule, direction)):
            if by := stated[direction, False].earlier_covering(topic, index):
                hidden.setdefault(by, {}).setdefault(direction, []).append(topic)
            else:
                left += 1
    if hidden and not left:
        text = f"rule {index + 1} allows nothing, as an earlier rule denies {names_text([*hidden])}"
        yield UNREACHABLE.found(enclave, text, file)
        return
    for by, topics in hidden.items():
        described_topics = " and ".join(
            f"{direction} {names_text(topic)}" for direction, topic in topics.items()
        )
        text = f"rule {index + 1} allows {described_topics} after a rule that denies {by}"
        yield UNREACHABLE.found(enclave, text, file)


class _Topics:
    """The topics in the allow rules of a grant, or in its deny rules."""

    def __init__(self, grant: Grant, direction: str, allow: bool, limit: ComparisonLimit) -> None:
        self._rules = grant.rules
        self._places: dict[str, list[int]] = {}
        for index, rule in enumerate(grant.rules):
            if rule.allow is allow:
                for topic in _topics(getattr(rule, direction)):
                    self._places.setdefault(topic, []).append(index)
        self._names = Names(self._places, limit)

    def earlier_covering(self, topic: str, index: int) -> str:
        """Return a topic expression in a rule before ``index`` that covers ``topic``, or ""."""
        same_topic = (topic,) if topic in self._places else ()
        return self._first_earlier(chain(same_topic, self._names.covering(topic)), index)

    def earlier_overlapping(self, topic: str, index: int) -> str:
        """Return a topic expression in a rule before ``index`` that overlaps ``topic``, or ""."""
        return self._first_earlier(self._names.overlapping(topic), index)

    def _first_earlier(self, topics: Iterable[str], index: int) -> str:
        """Return the first of ``topics`` that is in a rule before the rule ``index``, or "".

        The two rules must have a domain in common.
        """
        for topic in topics:
            for place in self._places[topic]:
                if place < index and _share_domains(self._rules[place], self._rules[index]):
                    return topic
        return ""


def _share_domains(rule: Rule, other: Rule) -> bool:
    return any(domain in other.domains.closed() for domain in rule.domains.closed())


def _topics(criteria: tuple[Criteria, ...]) -> list[str]:
    return [topic for criterion in criteria for topic in criterion.topics]


def _domain_findings(enclave: CheckedEnclave, grant: Grant, file: str) -> Iterator[Finding]:
    governed = enclave.state.domains()
    if governed is None:
        return
    allowed, wanted = grant.domains(), governed
    if grant.default_allow and not allowed.ranges:
        return  # by default, permissions are for every domain
    with suppress(SrosError):
        recorded, fleet = enclave.keystore.fleet, enclave.keystore.at.fleet
        stated = robot_of(fleet, enclave.name) if fleet else None
        robots = {enclave.name: stated} if stated else {}
        # The keystore's fleet decides, also if the fleet file has moved the robot.
        if robot := EnclaveDomains(governed, recorded, robots).robot_of(enclave.name):
            robots = {enclave.name: robot}
            wanted = EnclaveDomains(governed, None, robots).domains_of(enclave.name)
    if allowed == wanted:
        return
    text = f"the permissions are for {f'domain {allowed}' if allowed.ranges else 'no domain'}, but "
    if wanted != governed:
        yield DOMAINS.found(enclave.name, f"{text}its robot is in domain {wanted}", file)
        return
    text += f"the governance is for domain {governed}"
    fewer = bool(allowed.ranges) and all(domain in governed for domain in allowed)
    # In an export, fewer domains may be intended, and no node can use a wrong domain.
    kind = FEWER_DOMAINS if fewer and not enclave.keystore.is_original else DOMAINS
    yield kind.found(enclave.name, text, file)


_GOVERNANCE_SOURCE = "DDS-Security 1.1, 9.4.1.2"
_TEMPLATE_REMEDY = (
    "Run `sros update_keystore KEYSTORE --template production --dry-run` to see what it would "
    "change, and then without --dry-run."
)

UNAUTHENTICATED = FindingKind(
    "governance.unauthenticated",
    ERROR,
    "participants without an identity may join",
    "On Fast DDS, they can read and write each topic that has neither access control nor "
    "protection; on Cyclone DDS, each topic that has no protection, even if it has access "
    "control. If the governance also protects RTPS messages, Fast DDS refuses the governance. "
    "(Fast DDS 2.9 accepts it, and ignores allow_unauthenticated_participants.)",
    f"{_GOVERNANCE_SOURCE} (allow_unauthenticated_participants); Fast DDS 2.9.1 and 2.14.5, "
    "Cyclone DDS 0.10 and 11.0; tested.",
    f"Run {REFUSE_STRANGERS}.",
)
UNAUTHENTICATED_KEPT_OUT = FindingKind(
    "governance.unauthenticated-kept-out",
    NOTE,
    "participants without an identity are allowed, but the vendor keeps them out",
    "Fast DDS 2.9 ignores allow_unauthenticated_participants, and Cyclone DDS refuses such "
    "participants if RTPS messages are protected. Another vendor may open topics to these "
    "participants, or refuse the document.",
    UNAUTHENTICATED.source,
    UNAUTHENTICATED.remedy,
)
NO_JOIN_CONTROL = FindingKind(
    "governance.no-join-control",
    WARNING,
    "any authenticated participant may join, whatever its permissions",
    "The permissions of a participant are not checked when it joins; vendors then decide "
    "differently about a participant without permissions.",
    f"{_GOVERNANCE_SOURCE} (enable_join_access_control); Fast DDS 2.14.5, Cyclone DDS 0.10.2.",
    "Run `sros update_keystore KEYSTORE --set protection.join_access_control=true`.",
)
NO_ACCESS_CONTROL = FindingKind(
    "governance.no-access-control",
    WARNING,
    "topics that every participant in the domain may read or write",
    "Permissions are not checked for this access, so a policy has no effect on it.",
    f"{_GOVERNANCE_SOURCE} (enable_read_access_control, enable_write_access_control).",
    _TEMPLATE_REMEDY,
)
NO_ENCRYPTION = FindingKind(
    "governance.no-encryption",
    WARNING,
    "topics whose payload can be read on the wire",
    "Neither the payload, nor the submessage, nor the whole message is encrypted.",
    f"{_GOVERNANCE_SOURCE} (data_protection_kind, metadata_protection_kind, rtps_protection_kind).",
    _TEMPLATE_REMEDY,
)
SIGNED_PAYLOAD = FindingKind(
    "governance.signed-payload",
    WARNING,
    "topics whose messages Fast DDS loses",
    "If the payload is only signed, Fast DDS leaves its padding out of the signature: the reader "
    "rejects every message whose serialized length is not a multiple of four.",
    "Fast DDS 2.14.5, tested; fixed in its source in August 2026 (pull request 6498).",
    "Sign the submessage, with the payload in it (data NONE, metadata SIGN), or encrypt the "
    "payload (data ENCRYPT).",
)
NOT_AUTHENTIC = FindingKind(
    "governance.no-authenticity",
    ERROR,
    "topics whose messages anybody can forge",
    "Nothing is signed: neither payload, nor submessage, nor the whole message.",
    f"{_GOVERNANCE_SOURCE} (rtps, metadata and data protection kinds).",
    _TEMPLATE_REMEDY,
)
DISCOVERY_OPEN = FindingKind(
    "governance.discovery-open",
    WARNING,
    "discovery without protection",
    "Anyone in the network can see every node, topic and type, and announce false ones.",
    f"{_GOVERNANCE_SOURCE} (discovery_protection_kind, enable_discovery_protection).",
    _TEMPLATE_REMEDY,
)
LIVELINESS_OPEN = FindingKind(
    "governance.liveliness-open",
    WARNING,
    "liveliness without protection",
    "An attacker can make readers believe that a dead writer is still alive.",
    f"{_GOVERNANCE_SOURCE} (liveliness_protection_kind, enable_liveliness_protection).",
    _TEMPLATE_REMEDY,
)
NO_TOPIC_RULE = FindingKind(
    "governance.no-topic-rule",
    ERROR,
    "topics without a topic rule",
    "An endpoint can be created only if a topic rule matches, and every ROS 2 node needs "
    "ros_discovery_info.",
    f"{_GOVERNANCE_SOURCE}; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Add a rule for * at the end.",
)
NO_OTHER_TOPIC_RULE = FindingKind(
    "governance.only-ros-topics",
    NOTE,
    "topic rules for ROS names only",
    "A program that uses DDS without ROS can create no endpoint.",
    f"{_GOVERNANCE_SOURCE}; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Nothing to do if all programs are ROS 2 nodes. Otherwise add a rule for * at the end.",
)
UNREACHABLE_TOPIC_RULE = FindingKind(
    "governance.unreachable-rule",
    WARNING,
    "a topic rule that never applies, because an earlier one matches first",
    "The first topic rule that matches a topic decides.",
    f"{_GOVERNANCE_SOURCE}; Fast DDS 2.14.5, Cyclone DDS 0.10.2.",
    "Put narrower rules first, as sros does.",
)
GOVERNANCE_DOMAIN_RANGE = FindingKind(
    "governance.domain-range",
    ERROR,
    "a range of domains that vendors read differently",
    "Cyclone DDS refuses a range without <min>, and domains above 230; Fast DDS accepts them.",
    "DDS-Security 1.1, 9.4.1.2; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Write <id>, or <min> and <max> up to 230.",
)
GOVERNANCE_OPEN_RANGE = FindingKind(
    "governance.open-range",
    WARNING,
    "a range of domains without an end, which counts as one domain",
    "Fast DDS and Cyclone DDS read a range without <max> as only the domain <min>; by the "
    "standard, the range has no end.",
    "DDS-Security 1.1, 9.4.1.2; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Write <id>, or <min> and <max> up to 230.",
)
DIFFERS = FindingKind(
    "governance.differs",
    ERROR,
    "enclaves with different governance",
    "Nodes that protect a topic differently do not match, and do not report it.",
    "DDS-Security 1.1, 8.4 (the protection attributes of both sides must agree).",
    "Replace the copy with a link to the governance of the keystore, or export the enclave again.",
)
XML_DIFFERS = FindingKind(
    "governance.xml-differs",
    WARNING,
    "governance.xml differs from the signed governance.p7s",
    "DDS loads governance.p7s. The readable copy was changed, but never signed again.",
    "rcl 9 (security.c).",
    f"{edit_remedy('KEYSTORE')}",
)

_OPEN_KINDS = {
    "allow_unauthenticated_participants": UNAUTHENTICATED,
    "enable_join_access_control": NO_JOIN_CONTROL,
    "discovery_protection_kind": DISCOVERY_OPEN,
    "liveliness_protection_kind": LIVELINESS_OPEN,
    "enable_discovery_protection": DISCOVERY_OPEN,
    "enable_liveliness_protection": LIVELINESS_OPEN,
}
"""The kind of finding for each governance attribute that is open."""
_ROS_TOPICS = ("rt/*", "rq/*Request", "rr/*Reply")
"""The DDS topics of all topics, services and actions of ROS."""
_SIGNED_KINDS = (ProtectionKind.SIGN, ProtectionKind.SIGN_WITH_ORIGIN_AUTHENTICATION)
_UNPROTECTED_KINDS = (ProtectionKind.NONE,)


def check_governance(
    enclave: CheckedEnclave, common: bytes, vendors: Sequence[Vendor]
) -> Iterator[Finding]:
    """Yield findings if an enclave has another governance than the document ``common``.

    ``common`` is the signed governance of the keystore, or of the first enclave of an export.
    ``vendors`` are the vendors that the enclave's nodes may use.
    """
    governance = enclave.state.governance
    if governance is None:
        return
    enclave_governance = enclave.state.files[GOVERNANCE_FILE]
    if enclave_governance != common and _content(enclave_governance) != _content(common):
        file = enclave.file(GOVERNANCE_FILE)
        source = "the keystore" if enclave.keystore.governance else "other enclaves"
        yield DIFFERS.found(enclave.name, f"'{file}' differs from the governance of {source}", file)
        yield from governance_findings(enclave.keystore, governance, file, vendors)


@dataclass(frozen=True, slots=True)
class _ChosenByTemplate:
    """A function that returns whether a template's own governance would have the same finding."""

    kind: FindingKind
    text: str
    domains: DomainSet
    vendors: Sequence[Vendor]

    def __call__(self, settings: Template) -> bool:
        governance = governance_for(settings.protection, self.domains)
        return any(
            (self.kind, self.text) in _rule_findings(rule, self.vendors)
            for rule in governance.domain_access_rules
        )


def _rule_findings(
    rule: DomainRule, vendors: Sequence[Vendor]
) -> Iterator[tuple[FindingKind, str]]:
    yield from _findings_of_domain_rule(rule, vendors)
    yield from _findings_of_topic_rules(rule)


def governance_findings(
    keystore: CheckedKeystore, governance: Governance, file: str, vendors: Sequence[Vendor]
) -> Iterator[Finding]:
    """Yield findings about topics and discovery that a governance document leaves unprotected.

    ``file`` is the document's path, ``vendors`` are the vendors that nodes may use.
    """
    domains = governance.domains().closed()

    for rule in governance.domain_access_rules:
        subject = f"domain {rule.domains}"
        for kind, text in _rule_findings(rule, vendors):
            # A template may choose open topics, but none chooses lost messages or a rule without
            # effect.
            flaw = kind in (SIGNED_PAYLOAD, UNREACHABLE_TOPIC_RULE)
            by = (
                ""
                if flaw
                else keystore.accepted_by(kind, _ChosenByTemplate(kind, text, domains, vendors))
            )
            yield kind.found(subject, text, file, accepted=by)
        for part in rule.domains.ranges:
            kind = GOVERNANCE_DOMAIN_RANGE if part.last is not None else GOVERNANCE_OPEN_RANGE
            for problem in _domain_problems(DomainSet((part,))):
                yield kind.found(subject, f"the range {problem}", file)


def _unauthenticated_kind_and_text(
    rule: DomainRule, vendors: Sequence[Vendor]
) -> tuple[FindingKind, str]:
    """Return the kind and the text of the finding about participants without a certificate."""
    kind = UNAUTHENTICATED_KEPT_OUT
    clauses: dict[str, list[str]] = {}
    for vendor in vendors or TESTED:
        if vendor.traits.ignores_unauthenticated:
            clause = "they are still refused"
        elif rule.rtps_protection_kind is ProtectionKind.NONE:
            kind, clause = UNAUTHENTICATED, _clause_on_topics_of_unauthenticated(rule, vendor)
        elif vendor.traits.refuses_open_rtps:
            kind, clause = (
                UNAUTHENTICATED,
                "the document is refused, as RTPS messages are protected",
            )
        else:
            clause = "they are kept out, as RTPS messages are protected"
        clauses.setdefault(clause, []).append(vendor.title)
    return kind, "; ".join(
        f"on {' and '.join(joined_titles(titles))} {clause}" for clause, titles in clauses.items()
    )


def _clause_on_topics_of_unauthenticated(rule: DomainRule, vendor: Vendor) -> str:
    """Return a clause on the topics that participants without a certificate can use on a vendor."""
    opened = [
        topic_rule.topic_expression
        for topic_rule in rule.topic_access_rules
        if is_open_to_unauthenticated(rule, topic_rule, vendor)
    ]
    if not opened:
        return "they reach no topic, because every topic has access control or protection"
    return f"anybody can read and write {names_text(opened)}"


def _findings_of_domain_rule(
    rule: DomainRule, vendors: Sequence[Vendor]
) -> Iterator[tuple[FindingKind, str]]:
    for attribute, text in _open_attributes(rule):
        kind = _OPEN_KINDS[attribute]
        if kind is UNAUTHENTICATED:
            kind, reach = _unauthenticated_kind_and_text(rule, vendors)
            text = f"{text}: {reach}"
        yield kind, text


def _open_attributes(rule: DomainRule | TopicRule) -> Iterator[tuple[str, str]]:
    """Yield the name and a description of each attribute of `_OPEN_KINDS` with an open value."""
    for attribute in attributes(type(rule)):
        if attribute.name in _OPEN_KINDS and attribute.is_open(rule):
            value = json.dumps(attribute.open) if attribute.is_flag else attribute.open
            yield attribute.name, f"{attribute.name} is {value}"


def _findings_of_topic_rules(rule: DomainRule) -> Iterator[tuple[FindingKind, str]]:
    expressions = [topic_rule.topic_expression for topic_rule in rule.topic_access_rules]
    if not any(covers(expression, ROS_DISCOVERY_TOPIC) for expression in expressions):
        yield NO_TOPIC_RULE, f"no topic rule matches {ROS_DISCOVERY_TOPIC}"
    elif "*" not in expressions:
        of_ros = all(any(covers(wide, topic) for wide in expressions) for topic in _ROS_TOPICS)
        yield NO_OTHER_TOPIC_RULE if of_ros else NO_TOPIC_RULE, "there is no rule for *"
    names = Names(expressions)
    first = {expression: index for index, expression in reversed([*enumerate(expressions)])}
    for index, topic in enumerate(rule.topic_access_rules):
        yield from _findings_of_topic_rule(rule, topic)
        same = topic.topic_expression
        covering = chain([same], islice(names.covering(same), 1))
        hiding = min((e for e in covering if first[e] < index), key=first.__getitem__, default=None)
        if hiding is not None:
            yield (
                UNREACHABLE_TOPIC_RULE,
                f"the rule for {hiding} comes before the rule for {topic.topic_expression}",
            )


def _findings_of_topic_rule(
    rule: DomainRule, topic: TopicRule
) -> Iterator[tuple[FindingKind, str]]:
    name = topic.topic_expression
    open_for = [
        word
        for word, controlled in (
            ("read", topic.enable_read_access_control),
            ("write", topic.enable_write_access_control),
        )
        if not controlled
    ]
    if open_for:
        yield NO_ACCESS_CONTROL, f"every participant may {' and '.join(open_for)} {name}"
    levels = (
        rule.rtps_protection_kind,
        topic.metadata_protection_kind,
        topic.data_protection_kind,
    )
    if all(level in _UNPROTECTED_KINDS for level in levels):
        yield NOT_AUTHENTIC, f"messages of {name} are neither signed nor encrypted"
    elif all(level in (*_UNPROTECTED_KINDS, *_SIGNED_KINDS) for level in levels):
        yield NO_ENCRYPTION, f"messages of {name} are only signed"
    if topic.data_protection_kind in _SIGNED_KINDS:
        yield SIGNED_PAYLOAD, f"data_protection_kind is {topic.data_protection_kind} for {name}"
    for attribute, text in _open_attributes(topic):
        yield _OPEN_KINDS[attribute], f"{text} for {name}"


def governance_copy_findings(keystore: CheckedKeystore) -> Iterator[Finding]:
    """Yield a finding if somebody changed the readable copy of the governance."""
    xml = keystore.root / GOVERNANCE_XML
    if keystore.edits.governance:
        text = "governance.xml differs from the content of governance.p7s"
        yield XML_DIFFERS.found("governance", text, str(xml))


def _content(message: bytes) -> bytes:
    """Return the signed content, or b"" if it cannot be read (reported elsewhere)."""
    try:
        return plain(smime.parse(message).document)
    except SrosError:
        return b""
