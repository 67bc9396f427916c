"""Checks of a Zenoh configuration, as rmw_zenoh reads it for a router or a session."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations, islice, product
from pathlib import Path
from typing import Annotated, NamedTuple

from sros_tool.checks.kind import ERROR, WARNING, Finding, FindingKind
from sros_tool.errors import DocumentError
from sros_tool.policy.patterns import ComparisonLimit
from sros_tool.translate_zenoh.rights import RightsOfSubject, is_self_limiting
from sros_tool.values import DryRun, FileChange, Notes, Words
from sros_tool.wording import counted, first_few
from sros_tool.xml import read_bytes
from sros_tool.zenoh.access import PROPERTIES, AclRule, AclSubject, Enforcement, Flow, Message
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.document import (
    ENCRYPTED,
    ConfigurationDocument,
    UnreadConfigurationError,
    parse_configuration,
)
from sros_tool.zenoh.key_expressions import includes, intersects, widest_expression

_TESTED_SOURCE = "Zenoh 1.10.2, tested."
_WRITE_BY_SROS_REMEDY = "Let `sros zenoh` write the files: rules for each enclave, by its name."

MALFORMED = FindingKind(
    "zenoh.malformed",
    ERROR,
    "a configuration that Zenoh does not accept",
    "No session opens with it, and no router starts.",
    "Zenoh 1.10.2 (commons/zenoh-config), tested.",
    "Correct the file.",
)
UNREAD = FindingKind(
    "zenoh.unread",
    WARNING,
    "a configuration that Zenoh may accept, and sros does not read",
    "Zenoh also reads YAML, TOML, and lists in place of objects, whose meaning depends on its "
    "version. So sros does not know whether the configuration enforces anything.",
    "Zenoh 1.10.2 (commons/zenoh-config), tested.",
    "Write it as JSON5 objects into a file whose name ends with .json5.",
)
UNKNOWN_SETTING = FindingKind(
    "zenoh.unknown-setting",
    ERROR,
    "a setting that Zenoh does not have",
    "Zenoh refuses the whole file, so that no session opens and no router starts. The name is "
    "misspelled, or belongs to another version of Zenoh.",
    "Zenoh 1.10.2 (commons/zenoh-config), tested.",
    "Correct the name, or remove the setting.",
)
ROUTER_WITHOUT_RULES = FindingKind(
    "zenoh.router-without-rules",
    ERROR,
    "a router without access control",
    "The router forwards everything between all connected processes: anyone with a certificate of "
    "the CA can publish, hear, call and serve everything.",
    _TESTED_SOURCE,
    _WRITE_BY_SROS_REMEDY,
)
SESSION_WITHOUT_RULES = FindingKind(
    "zenoh.session-without-rules",
    ERROR,
    "a session without access control",
    "Anyone who impersonates the router, or who connects to the session directly in peer mode, "
    "can read everything that the session publishes and send it anything. The rules of the real "
    "router do not apply.",
    _TESTED_SOURCE,
    _WRITE_BY_SROS_REMEDY,
)
DEFAULT_ALLOW = FindingKind(
    "zenoh.default-allow",
    ERROR,
    "access control that allows what no rule denies",
    "A query or a put with a wildcard bypasses a deny rule, and if a process matches two subjects, "
    "a name is denied only if both subjects deny it.",
    _TESTED_SOURCE,
    'Write "default_permission": "deny", and use only allow rules.',
)
NOTHING_ALLOWED = FindingKind(
    "zenoh.nothing-allowed",
    WARNING,
    "access control under which no message passes",
    "The default is to deny, and no entry of `policies` gives a subject a rule: sessions open, "
    "but Zenoh drops every message without a log line.",
    _TESTED_SOURCE,
    _WRITE_BY_SROS_REMEDY,
)
EVERYBODY = FindingKind(
    "zenoh.subject-of-everybody",
    ERROR,
    "a subject that applies to everybody",
    "A subject matches any value of a property that it does not state. Interfaces and protocols "
    "are not identities, and a process chooses its own zid. So the rules apply to everyone who "
    "gets a connection.",
    "Zenoh 1.9 (authorization.rs); tested with 1.10.2.",
    'Name each enclave by "cert_common_names".',
)
SELF_LIMITING = FindingKind(
    "zenoh.self-limiting",
    ERROR,
    "a session whose rules no other process enforces",
    "No rule names another process: the rules state only what this process itself may do. Any "
    "other process with a certificate of the CA can publish to it, and read from it.",
    "zenoh_security_tools writes such files; Zenoh 1.10.2, tested.",
    _WRITE_BY_SROS_REMEDY,
)
DENY_IN_WILDCARD = FindingKind(
    "zenoh.deny-in-wildcard",
    ERROR,
    "a deny rule that a wildcard bypasses",
    "A rule applies to a message only if it covers the whole key expression of the message. A "
    "put, a query or a subscription with a wildcard is wider than the deny rule, so it is allowed, "
    "and reaches the denied names.",
    "Zenoh 1.5.1, 1.6.2 and 1.10.2, tested.",
    "Allow the intended names, and remove the deny rule.",
)
DENY_OVERRULED = FindingKind(
    "zenoh.deny-overruled",
    ERROR,
    "a deny rule without effect, because another subject of the access control allows the name",
    "If a process matches two subjects, one of them is enough to allow a message.",
    "Zenoh 1.6.2 and 1.10.2, tested.",
    "Put each certificate common name into one subject only, and use only allow rules.",
)
OVERLAPPING = FindingKind(
    "zenoh.overlapping-subjects",
    WARNING,
    "subjects that match the same process",
    "Such a process has the rights of both subjects; up to Zenoh 1.5.1, by chance, the rights of "
    "one "
    "subject only.",
    "Zenoh 1.5.1 (issue 2137 of zenoh) and 1.10.2, tested.",
    "Put each certificate common name into one subject only.",
)
UNUSED = FindingKind(
    "zenoh.unused",
    WARNING,
    "a rule or a subject without effect",
    "No entry of `policies` names the rule or subject, so it neither allows nor denies anything.",
    "Zenoh 1.9 (authorization.rs).",
    "Name the rule or subject in `policies`, or remove it.",
)
PLAIN_ENDPOINT = FindingKind(
    "zenoh.plain-endpoint",
    ERROR,
    "an endpoint without TLS",
    "Messages there are neither encrypted nor authenticated: everybody on the network can read "
    "them, and gets a connection without a certificate.",
    _TESTED_SOURCE,
    "Write tls/HOST:PORT.",
)
ENDPOINT_REFUSED = FindingKind(
    "zenoh.endpoint-refused",
    ERROR,
    "an endpoint of a protocol that the configuration excludes",
    "Zenoh does not start if it has to listen at the endpoint, and never connects to it.",
    _TESTED_SOURCE,
    "Change the endpoint, or transport/link/protocols.",
)
PROTOCOLS_OPEN = FindingKind(
    "zenoh.protocols-open",
    WARNING,
    "protocols without encryption are not excluded",
    "Zenoh also uses an endpoint tcp/... that is added (for instance by ZENOH_CONFIG_OVERRIDE) or "
    "that another process names.",
    _TESTED_SOURCE,
    'Write "protocols": ["tls"] in transport/link.',
)
NO_MUTUAL_TLS = FindingKind(
    "zenoh.no-mutual-tls",
    ERROR,
    "a listener that asks for no certificate",
    "Everybody gets a connection without a certificate, so rules cannot require a certificate "
    "common name.",
    _TESTED_SOURCE,
    'Write "enable_mtls": true in transport/link/tls.',
)
NAME_NOT_VERIFIED = FindingKind(
    "zenoh.name-not-verified",
    ERROR,
    "a session that accepts anybody as its router",
    "The session does not compare the endpoint's host with the certificate, and trusts the public "
    "CAs of the web as well as its own CA. Without rules that require a name, the owner of any "
    "certificate of these CAs can impersonate the router.",
    "Zenoh 1.9 (TLS link) and 1.10.2 (its log).",
    "Name the router in the subjects of access control, or set verify_name_on_connect and give the "
    "router a certificate for its host.",
)
EXPIRED_STAYS = FindingKind(
    "zenoh.expired-stays",
    WARNING,
    "a connection outlives its certificate",
    "After the certificate of a process has expired, its connections stay open until the "
    "process ends.",
    _TESTED_SOURCE,
    'Write "close_link_on_expiration": true in transport/link/tls.',
)
SHARED_MEMORY = FindingKind(
    "zenoh.shared-memory",
    WARNING,
    "shared memory between the processes of a host",
    "Messages of more than 3 KB lie there unencrypted, even with TLS, and stay there after both "
    "processes have ended.",
    _TESTED_SOURCE,
    'Write "enabled": false in transport/shared_memory; Zenoh\'s default is true.',
)
MULTICAST = FindingKind(
    "zenoh.multicast",
    WARNING,
    "multicast scouting",
    "Everybody on the network learns, without a certificate, of each process and its endpoints, "
    "and can answer a session that looks for a router.",
    _TESTED_SOURCE,
    'Write "enabled": false in scouting/multicast; Zenoh\'s default is true.',
)
ADMIN_SPACE = FindingKind(
    "zenoh.admin-space",
    WARNING,
    "Zenoh's admin space",
    "Anyone who can read the admin space sees sessions, connections and the configuration; anyone "
    "who can write to it can change them.",
    _TESTED_SOURCE,
    'Write "enabled": false in adminspace.',
)

_LINK, _TLS, _ACCESS = "transport/link", "transport/link/tls", "access_control"
_WILDCARD_MESSAGES = frozenset(Message) - {Message.REPLY, Message.LIVELINESS_TOKEN}
"""The messages that can name a key with wildcards."""
_MOST_SHOWN = 3
_MOST_PAIRS = 1000
"""Maximum number of pairs of subjects that are counted."""
_COMPARISON_COST = 20
"""Cost of comparing two subjects, in characters, the unit of `ComparisonLimit`."""


def configuration_findings(path: Path) -> Iterator[Finding]:
    """Yield the findings in a Zenoh configuration; an unreadable file is a finding, too."""
    data = read_bytes(path, "Zenoh configuration")
    try:
        document = parse_configuration(data, str(path))
    except UnreadConfigurationError as error:
        yield UNREAD.found(str(path), f"{error.what}. {error.why}", str(path))
        return
    except DocumentError as error:
        yield MALFORMED.found(str(path), str(error), str(path))
        return
    yield from document_findings(document)


def document_findings(document: ConfigurationDocument) -> Iterator[Finding]:
    """Yield the findings in a configuration."""
    for setting in document.unknown:
        yield _finding_at(
            document, UNKNOWN_SETTING, setting, f"Zenoh up to 1.10 has no setting {setting}"
        )
    yield from _link_findings(document)
    yield from _open_feature_findings(document)
    if not document.access.enabled:
        kind = ROUTER_WITHOUT_RULES if document.mode is Mode.ROUTER else SESSION_WITHOUT_RULES
        yield _finding_at(document, kind, f"{_ACCESS}/enabled", "access_control is off")
        return
    yield from _rule_findings(document)
    yield from _subject_findings(document)
    yield from _denial_findings(document)


def _finding_at(
    document: ConfigurationDocument, kind: FindingKind, path: str, text: str
) -> Finding:
    return kind.found(document.mode.value, text, document.name, document.line_of(path))


# ── connections ────────────────────────────────────────────────────────────────────────────


def _link_findings(document: ConfigurationDocument) -> Iterator[Finding]:
    endpoint_kinds = (("listen", document.listen), ("connect", document.connect))
    for kind, endpoints in endpoint_kinds:
        for endpoint in endpoints:
            allowed = document.protocols is None or endpoint.protocol in document.protocols
            if not allowed:
                text = (
                    f"{kind} has {endpoint.text}, but the protocols are {_protocols_text(document)}"
                )
                yield _finding_at(document, ENDPOINT_REFUSED, f"{kind}/endpoints", text)
            elif not endpoint.is_encrypted():
                default = "" if f"{kind}/endpoints" in document.lines else ", by default"
                text = f"{kind} has {endpoint.text}{default}"
                yield _finding_at(document, PLAIN_ENDPOINT, f"{kind}/endpoints", text)
    if not any(
        endpoint.is_encrypted() for _, endpoints in endpoint_kinds for endpoint in endpoints
    ):
        return
    if document.protocols is None or set(document.protocols) - ENCRYPTED:
        text = f"the protocols are {_protocols_text(document)}"
        yield _finding_at(document, PROTOCOLS_OPEN, f"{_LINK}/protocols", text)
    for endpoint in document.listen:
        if endpoint.is_encrypted() and not endpoint.option("enable_mtls", document.tls.mutual):
            text = f"it listens at {endpoint.text}, and enable_mtls is off"
            yield _finding_at(document, NO_MUTUAL_TLS, f"{_TLS}/enable_mtls", text)
    yield from _router_name_findings(document)
    closing = "close_link_on_expiration"
    for endpoint in (*document.listen, *document.connect):
        if endpoint.is_encrypted() and not endpoint.option(
            closing, document.tls.closes_on_expiration
        ):
            text = f"{closing} is off for {endpoint.text}"
            yield _finding_at(document, EXPIRED_STAYS, f"{_TLS}/{closing}", text)
            break


def _router_name_findings(document: ConfigurationDocument) -> Iterator[Finding]:
    """Yield a finding if anybody with an accepted certificate can act as the router."""
    unverified = [
        endpoint
        for endpoint in document.connect
        if endpoint.is_encrypted()
        and not endpoint.option("verify_name_on_connect", document.tls.verifies_name)
    ]
    access = document.access
    if unverified and (
        not access.enabled or access.allows_by_default or _allowing_subjects_of_everybody(document)
    ):
        text = f"verify_name_on_connect is off for {unverified[0].text}"
        yield _finding_at(document, NAME_NOT_VERIFIED, f"{_TLS}/verify_name_on_connect", text)


def _protocols_text(document: ConfigurationDocument) -> str:
    return "not limited" if document.protocols is None else ", ".join(document.protocols) or "none"


def _open_feature_findings(document: ConfigurationDocument) -> Iterator[Finding]:
    for kind, on, path in (
        (SHARED_MEMORY, document.shared_memory, "transport/shared_memory"),
        (MULTICAST, document.multicast, "scouting/multicast"),
    ):
        if on:
            stated = "on" if f"{path}/enabled" in document.lines else "on, by default"
            yield _finding_at(document, kind, f"{path}/enabled", f"{path} is {stated}")
    if document.adminspace and (document.adminspace_readable or document.adminspace_writable):
        can = "it can be written" if document.adminspace_writable else "it can be read"
        yield _finding_at(
            document, ADMIN_SPACE, "adminspace/enabled", f"adminspace is on, and {can}"
        )


# ── access control ─────────────────────────────────────────────────────────────────────────


def _rule_findings(document: ConfigurationDocument) -> Iterator[Finding]:
    access = document.access
    if access.allows_by_default:
        text = "default_permission is allow"
        yield _finding_at(document, DEFAULT_ALLOW, f"{_ACCESS}/default_permission", text)
    elif not any(rule.allows for s in access.subjects for rule in access.rules_of(s.id)):
        text = "no subject has a rule that allows anything"
        yield _finding_at(document, NOTHING_ALLOWED, f"{_ACCESS}/policies", text)
        return
    used = {rule.id for subject in access.subjects for rule in access.rules_of(subject.id)}
    unused = [(f"rule {rule.id}", rule.line) for rule in access.rules if rule.id not in used]
    unused += [
        (f"subject {subject.id}", subject.line)
        for subject in access.subjects
        if not access.rules_of(subject.id)
    ]
    for name, line in unused:
        yield UNUSED.found(name, f"no entry of policies names {name}", document.name, line)


def _allowing_subjects_of_everybody(document: ConfigurationDocument) -> list[AclSubject]:
    """Return the subjects that apply to everybody, and have an allow rule."""
    access = document.access
    return [
        subject
        for subject in access.subjects
        if not subject.is_named()
        and (access.allows_by_default or any(rule.allows for rule in access.rules_of(subject.id)))
    ]


def _subject_findings(document: ConfigurationDocument) -> Iterator[Finding]:
    access = document.access
    open_to_all = _allowing_subjects_of_everybody(document)
    if open_to_all and is_self_limiting(document):
        subjects = "subject" if len(open_to_all) == 1 else "subjects"
        text = f"no certificate common name in the {subjects} {_ids_text(open_to_all)}"
        yield SELF_LIMITING.found(document.mode.value, text, document.name, open_to_all[0].line)
    else:
        for subject in open_to_all:
            text = f"subject {subject.id} states {_described_subject(subject)}, and has allow rules"
            yield EVERYBODY.found(f"subject {subject.id}", text, document.name, subject.line)
    pairs = list(islice(_overlapping_subjects(access.subjects), _MOST_PAIRS + 1))
    if pairs:
        first, second = pairs[0]
        least = "at least " if len(pairs) > _MOST_PAIRS else ""
        further = f"; so can {least}{counted(len(pairs) - 1, 'more pair')}" if pairs[1:] else ""
        text = f"subjects {first.id} and {second.id} can match the same process{further}"
        yield OVERLAPPING.found(f"subject {second.id}", text, document.name, second.line)


def _overlapping_subjects(
    subjects: Sequence[AclSubject],
) -> Iterator[tuple[AclSubject, AclSubject]]:
    limit = ComparisonLimit()
    kinds: dict[tuple[str, ...], list[AclSubject]] = {}
    for subject in subjects:  # subjects with the same properties match the same processes
        stated = tuple(name for name in PROPERTIES if getattr(subject, name) is not None)
        kinds.setdefault(stated, []).append(subject)
    for kind, other_kind in combinations(kinds.values(), 2):
        for pair in product(kind, other_kind):
            if pair[0].overlaps(pair[1]):
                yield pair
            else:
                limit.spend(_COMPARISON_COST)


def _ids_text(subjects: Sequence[AclSubject]) -> str:
    return first_few([subject.id for subject in subjects], _MOST_SHOWN)


def _described_subject(subject: AclSubject) -> str:
    stated = [name for name in PROPERTIES if getattr(subject, name) is not None]
    return f"only {' and '.join(stated)}" if stated else "no property"


def _denial_findings(document: ConfigurationDocument) -> Iterator[Finding]:
    """Yield a finding for each denial that some messages can circumvent."""
    access, limit = document.access, ComparisonLimit()
    reported: set[tuple[str, str]] = set()
    for subject in access.subjects:
        denials = [rule for rule in access.rules_of(subject.id) if not rule.allows]
        if not denials:
            continue
        limit.spend(_COMPARISON_COST * len(access.subjects))
        overlapping = [other for other in access.subjects if other.overlaps(subject)]
        for rule in denials:
            for kind, text in (
                (DENY_IN_WILDCARD, _wildcard_circumvention_clause(rule, subject, access, limit)),
                (DENY_OVERRULED, _overruling_subject_clause(rule, overlapping, access, limit)),
            ):
                if text and (kind.id, rule.id) not in reported:
                    reported.add((kind.id, rule.id))
                    yield kind.found(f"rule {rule.id}", text, document.name, rule.line)


def _wildcard_circumvention_clause(
    rule: AclRule, subject: AclSubject, access: Enforcement, limit: ComparisonLimit
) -> str:
    """Return how a message with a wildcard circumvents a denial, or "" if none can."""
    rules = access.rules_of(subject.id)
    for flow, message in product(rule.flows, rule.messages):
        if message not in _WILDCARD_MESSAGES:
            continue
        applying = _rules_for(rules, flow, message)
        denied = _keys(applying, allows=False)
        for key in rule.key_expressions:
            if access.allows_by_default:
                passing = [(widest_expression(key), "the default")]
            else:
                passing = [
                    (wide, f"rule {allowing.id}")
                    for allowing in applying
                    if allowing.allows
                    for wide in allowing.key_expressions
                    if _values_intersect(wide, key, limit)
                ]
            for wide, by in passing:
                if not any(includes(denied_expression, wide) for denied_expression in denied):
                    return (
                        f"{flow} {message} of {key} is denied, but {by} allows {message} of {wide}"
                    )
    return ""


def _overruling_subject_clause(
    rule: AclRule, other_subjects: Sequence[AclSubject], access: Enforcement, limit: ComparisonLimit
) -> str:
    """Return a clause on one of ``other_subjects`` that allows what ``rule`` denies, or ""."""
    for other, flow, message in product(other_subjects, rule.flows, rule.messages):
        other_rules = _rules_for(access.rules_of(other.id), flow, message)
        denied, allowed = _keys(other_rules, allows=False), _keys(other_rules, allows=True)
        for key in rule.key_expressions:
            if access.allows_by_default:
                passing = [key]
            else:
                passing = [
                    key if includes(wide, key) else wide
                    for wide in allowed
                    if _values_intersect(wide, key, limit)
                ]
            for passed in passing:
                if not any(includes(wide, passed) for wide in denied):
                    return f"subject {other.id} allows {flow} {message} of {passed}"
    return ""


def _rules_for(rules: Iterable[AclRule], flow: Flow, message: Message) -> list[AclRule]:
    return [rule for rule in rules if flow in rule.flows and message in rule.messages]


def _keys(rules: Iterable[AclRule], *, allows: bool) -> list[str]:
    return [key for rule in rules if rule.allows is allows for key in rule.key_expressions]


def _values_intersect(first: str, second: str, limit: ComparisonLimit) -> bool:
    limit.spend(len(first) + len(second))
    return intersects(first, second)


# ── what is printed of a configuration ──────────────────────────────────────────────────────

VERBS = {"publish": "publish", "subscribe": "subscribe", "request": "call", "reply": "serve"}
"""Right to a name → verb in text output; only rights that Zenoh rules can give."""

Verb = Annotated[str, Words(VERBS.values()), "The right."]


class AllowedName(NamedTuple):
    """A right to a ROS name."""

    right: Verb
    name: str
    """The topic or service, perhaps with wildcards."""
    domain: str
    """The ROS domain, perhaps with wildcards."""
    lacks: Sequence[str]
    """Kinds of messages that the right needs, but that are not allowed."""


class KeyRight(NamedTuple):
    """A right to a Zenoh key."""

    right: Verb
    key: str
    """A key expression of Zenoh."""


class SubjectRights(NamedTuple):
    """The rights of a subject of access control."""

    id: str | None
    """Id of the subject; null without access control."""
    names: Sequence[str] | None
    """The common names of the subject's certificates; null for everybody."""
    own: bool
    """Whether these are the rights of the process itself, which no other process enforces."""
    rights: Sequence[AllowedName]
    """Rights of the subject."""
    unsaid: Sequence[KeyRight]
    """Rights to Zenoh keys that no ROS name expresses exactly."""
    denied: Sequence[KeyRight]
    """Denied Zenoh keys; a message with a wildcard may bypass a denial."""


class ReadConfiguration(NamedTuple):
    """The rights that an existing configuration gives to each subject."""

    file: str
    """Path of the configuration, as given on the command line."""
    mode: Mode
    """How the process takes part in the network."""
    enforced: bool
    """Whether access control is on."""
    subjects: Sequence[SubjectRights]
    """Subjects of the rules, with their rights."""
    findings: Sequence[Finding]
    """The findings that are warnings or errors."""
    output: Path | None
    """The policy that was written, or null."""
    dry_run: DryRun
    changes: Sequence[FileChange]
    """The files that were written or, with ``--dry-run``, would be."""
    notes: Notes


def subject_rights(rights: RightsOfSubject) -> SubjectRights:
    """Return the rights of a subject as the JSON output has them."""
    return SubjectRights(
        rights.subject or None,
        rights.names,
        rights.self_limiting,
        [AllowedName(VERBS[r.right], r.name, r.domain, r.lacks) for r in rights.rights],
        unsaid=[KeyRight(VERBS[right], key) for right, key in rights.unsaid],
        denied=[KeyRight(VERBS[right], key) for right, key in rights.denied],
    )
