"""Signed permissions outside of the portable profile: where vendors read or decide differently."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from math import isfinite

from sros_tool.checks.keystores.enclaves import grant_of
from sros_tool.checks.keystores.opened import OpenedEnclave
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, Kind, by_id
from sros_tool.checks.policies.portability import outside_findings
from sros_tool.dds.decision.moments import read_moment
from sros_tool.dds.decision.vendors import Moments
from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.dds.permissions import Criteria, Grant, Rule
from sros_tool.policy.patterns import covers, overlap
from sros_tool.validity import iso

SEVERAL_GRANTS = Kind(
    "portable.several-grants",
    WARNING,
    "several grants in one document",
    "For a subject, Fast DDS takes the first grant that is in date, Cyclone DDS the first one "
    "alone; Cyclone DDS also takes one whose subject only contains the wanted one.",
    "Fast DDS 2.14.5 (Permissions.cpp), Cyclone DDS 0.10.2; measured.",
    "Write one grant in one document for each enclave.",
)
DEFAULT_ALLOW = Kind(
    "portable.default-allow",
    WARNING,
    "a grant that allows by default",
    "Fast DDS never looks at <default>, and denies; Cyclone DDS allows whatever no rule names.",
    "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Write <default>DENY</default>, and allow what is meant.",
)
ALLOW_RULES = Kind(
    "portable.several-allow-rules",
    NOTE,
    "several allow rules in one grant",
    "Fast DDS decides by the first rule whose topic matches, and then by its partitions; Cyclone "
    "DDS goes on to a rule in which both match.",
    "Fast DDS 2.14.5 (Permissions.cpp), Cyclone DDS 0.10.2; measured.",
    "Put all topics into one allow rule.",
    vendors=("fastdds", "fastdds-2.9"),
)
PARTITIONS = Kind(
    "portable.partitions",
    WARNING,
    "partitions in a rule",
    "Fast DDS ignores them in denials, and denies where an allow rule matches the topic and not "
    "the partition; Cyclone DDS goes on searching. ROS 2 uses the default partition only.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Leave partitions out.",
)
DOMAIN_RANGE = Kind(
    "portable.domain-range",
    ERROR,
    "a range of domains that vendors read differently",
    "Without <max> it means one domain alone; without <min> Cyclone DDS crashes; domains above 230 "
    "it refuses.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Write <id>, or <min> and <max> up to 230.",
)
GRANT_NAME = Kind(
    "portable.grant-name",
    WARNING,
    "a grant without a name",
    "Fast DDS refuses the document; Cyclone DDS takes it.",
    "omg_shared_ca_permissions.xsd; Fast DDS 2.14.5; measured.",
    'Write <grant name="...">.',
    vendors=("fastdds", "fastdds-2.9"),
)
SUBJECT = Kind(
    "portable.subject",
    WARNING,
    "a subject that vendors compare differently",
    "Cyclone DDS splits subjects at commas, slashes and bars, and compares characters beyond ASCII "
    "in their escaped form; Fast DDS 2.9 takes spaces around = for part of the name.",
    "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Write it as RFC 4514 does, CN=/name, without , | and quotes in the name.",
)
TIME_FORMAT = Kind(
    "portable.time-format",
    WARNING,
    "a moment that vendors read differently",
    "Fast DDS drops the offset and reads local time; Cyclone DDS refuses dates without a time, and "
    "years from 2263 on.",
    "DDS-Security 1.1, 9.4.1.3.2.2; Fast DDS 2.14.5 (mktime), Cyclone DDS 0.10.2; measured.",
    "Write CCYY-MM-DDThh:mm:ssZ.",
)
TIME_WINDOW = Kind(
    "portable.validity-window",
    WARNING,
    "a validity that begins or ends within hours, in some time zones",
    "Fast DDS reads the dates of permissions in the host's local time: they begin up to 12 hours "
    "late in the west, and end up to 14 hours early in the east.",
    "Fast DDS 2.9.1 and 2.14.5 (mktime); measured in Los Angeles and Tokyo.",
    "Sign them with a beginning 14 hours back or more, as sros does, and renew them in time.",
    vendors=("fastdds", "fastdds-2.9"),
)
LOCAL_TIME = Kind(
    "enclave.permissions-local-time",
    ERROR,
    "permissions that Fast DDS refuses in the time zone of this host",
    'It reads their dates in local time, and says "Not found the identity subject name in '
    'permissions file".',
    "Fast DDS 2.9.1 and 2.14.5 (mktime); measured.",
    "Run `sros renew ROOT NAME`, or let the host run in UTC.",
    vendors=("fastdds", "fastdds-2.9"),
)
CHARACTER_CLASS = Kind(
    "portable.character-class",
    WARNING,
    "a [class] of characters that vendors read differently",
    "Cyclone DDS takes [^...] and [[:class:]] for plain characters; Fast DDS negates and knows "
    "classes. Spaces around a name Cyclone DDS drops, and Fast DDS does not.",
    "Fast DDS 2.14.5 (fnmatch), Cyclone DDS 0.10.2; measured.",
    "Use * or ?, or write the names out.",
)
EMPTY_TOPIC = Kind(
    "portable.empty-topic",
    ERROR,
    "a <topic> without text",
    "Cyclone DDS crashes as soon as it comes to it; Fast DDS refuses the document.",
    "Cyclone DDS 0.10.2 (a fault in create_topic), Fast DDS 2.9.1; measured.",
    "Remove it.",
)
NO_EFFECT = Kind(
    "permissions.deny-without-effect",
    ERROR,
    "a deny rule behind an allow rule for the same topic",
    "The first rule that matches decides, so the denial takes nothing away.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Put deny rules first, as sros does.",
)
UNREACHABLE = Kind(
    "permissions.unreachable-rule",
    WARNING,
    "a topic of a rule that an earlier rule decides",
    "The first rule that matches decides, so this one is never reached.",
    "DDS-Security 1.1, 9.4.1.3; Fast DDS 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Remove it, or put the narrower rule first.",
)
DOMAINS = Kind(
    "enclave.permissions-domains",
    WARNING,
    "permissions and governance for different domains",
    "In a domain that only one of them names, no node of the enclave gets through.",
    "DDS-Security 1.1, 9.4.1.2 and 9.4.1.3; measured.",
    "Sign both for the same domains: `sros create_permission` takes those of the governance.",
)

KINDS = by_id(
    SEVERAL_GRANTS, DEFAULT_ALLOW, ALLOW_RULES, PARTITIONS, DOMAIN_RANGE, GRANT_NAME, SUBJECT,
    TIME_FORMAT, TIME_WINDOW, LOCAL_TIME, CHARACTER_CLASS, EMPTY_TOPIC, NO_EFFECT, UNREACHABLE,
    DOMAINS,
)  # fmt: skip

_MOMENT = re.compile(r"(\d{4})-\d\d-\d\dT\d\d:\d\d:\d\dZ\Z")
_SUBJECT = re.compile(
    r"(?:[A-Za-z0-9.]+=[^,|\"\s/][^,|\"]*|CN=/[^,|\"\s]*)(?:,(?! )[A-Za-z0-9.]+=[^,|\"/]+)*\Z"
)
_LAST_YEAR = 2262
_WEST, _EAST = timedelta(hours=12), timedelta(hours=14)
_DIRECTIONS = ("publish", "subscribe")


def check_documents(enclave: OpenedEnclave) -> Iterator[Finding]:
    """The permissions of an enclave, whoever signed them."""
    permissions = enclave.state.permissions
    if permissions is None:
        return
    name, file = enclave.name, enclave.file("permissions.p7s")
    yield from outside_findings(permissions, enclave.state.permissions_bytes, name, file)
    if len(permissions.grants) > 1:
        yield SEVERAL_GRANTS.found(name, f"it has {len(permissions.grants)}", file)
    for grant in permissions.grants:
        yield from _form(grant, name, file)
    if own := grant_of(enclave):
        yield from _times(enclave, own, file)
        yield from _order(own, name, file)
        yield from _domains(enclave, own, file)


def domain_problems(domains: DomainSet) -> Iterator[str]:
    """What vendors read differently in a set of domains."""
    for part in domains.ranges:
        if part.first is None or part.last is None:
            yield f"{part} has one end only"
        elif part.last > MAX_DOMAIN:
            yield f"{part} goes beyond {MAX_DOMAIN}"


def _form(grant: Grant, name: str, file: str) -> Iterator[Finding]:
    if not grant.name:
        yield GRANT_NAME.found(name, f"the grant for {grant.subject} has none", file)
    if not (_SUBJECT.match(grant.subject) and grant.subject.isascii()):
        yield SUBJECT.found(name, f"the subject is {grant.subject!r}", file)
    if grant.default_allow:
        yield DEFAULT_ALLOW.found(name, "its default is ALLOW", file)
    for moment in (grant.not_before, grant.not_after):
        match = _MOMENT.match(moment)
        if not match or int(match[1]) > _LAST_YEAR:
            yield TIME_FORMAT.found(name, f"it says {moment!r}", file)
    if sum(rule.allow for rule in grant.rules) > 1:
        yield ALLOW_RULES.found(name, "it has more than one", file)
    problems = [text for rule in grant.rules for text in domain_problems(rule.domains)]
    for problem in dict.fromkeys(problems):
        yield DOMAIN_RANGE.found(name, f"the range {problem}", file)
    criteria = [each for rule in grant.rules for each in (*rule.publish, *rule.subscribe)]
    if any(each.partitions for each in criteria):
        yield PARTITIONS.found(name, "its rules name partitions", file)
    if any(not topic.strip() for each in criteria for topic in each.topics):
        yield EMPTY_TOPIC.found(name, "it names a topic without a name", file)
    odd = sorted({t for each in criteria for t in each.topics if _is_odd(t)})
    if odd:
        yield CHARACTER_CLASS.found(name, f"it says {', '.join(map(repr, odd[:3]))}", file)


def _is_odd(topic: str) -> bool:
    return "[^" in topic or "[:" in topic or topic != topic.strip()


def _times(enclave: OpenedEnclave, grant: Grant, file: str) -> Iterator[Finding]:
    now, window = enclave.keystore.now, grant.validity
    if not window.contains(now):
        return
    text = f"they are valid from {grant.not_before} to {grant.not_after}"
    begin, end = (
        read_moment(Moments.LOCAL, each, enclave.keystore.zone)
        for each in (grant.not_before, grant.not_after)
    )
    if begin is None or end is None:
        return  # which is told by the form of the dates
    if not begin <= int(now.timestamp()) <= end:
        here = f"in {enclave.keystore.zone} Fast DDS takes that for {_utc(begin)} to {_utc(end)}"
        yield LOCAL_TIME.found(enclave.name, f"{text}, and {here}", file)
    elif now - _WEST < window.not_before or now + _EAST > window.not_after:
        yield TIME_WINDOW.found(enclave.name, f"{text}, and now it is {iso(now)}", file)


def _utc(seconds: float) -> str:
    return iso(datetime.fromtimestamp(seconds, UTC)) if isfinite(seconds) else "never"


def _order(grant: Grant, name: str, file: str) -> Iterator[Finding]:
    for index, rule in enumerate(grant.rules):
        if not index:
            continue
        for direction in _DIRECTIONS:
            earlier = [
                (before, topic)
                for before in grant.rules[:index]
                for topic in _topics(getattr(before, direction))
                if _share_domains(before, rule)
            ]
            for topic in _topics(getattr(rule, direction)):
                by = [(b, t) for b, t in earlier if b.allow is not rule.allow and covers(t, topic)]
                meets = [t for b, t in earlier if b.allow and overlap(t, topic)]
                if not rule.allow and meets:
                    text = f"it denies to {direction} {topic} after allowing {meets[0]}"
                    yield NO_EFFECT.found(name, text, file)
                elif rule.allow and by:
                    text = f"it allows to {direction} {topic} after denying {by[0][1]}"
                    yield UNREACHABLE.found(name, text, file)


def _share_domains(one: Rule, other: Rule) -> bool:
    return any(domain in other.domains.closed() for domain in one.domains.closed())


def _topics(criteria: tuple[Criteria, ...]) -> list[str]:
    return [topic for each in criteria for topic in each.topics]


def _domains(enclave: OpenedEnclave, grant: Grant, file: str) -> Iterator[Finding]:
    governed = enclave.state.domains()
    if governed is None:
        return
    allowed = DomainSet.of(
        *(
            (part.first or 0, part.last or 0)
            for rule in grant.rules
            if rule.allow
            for part in rule.domains.closed().ranges
        )
    )
    if allowed != governed:
        text = f"the permissions are for domain {allowed or 'none'}, the governance for {governed}"
        yield DOMAINS.found(enclave.name, text, file)
