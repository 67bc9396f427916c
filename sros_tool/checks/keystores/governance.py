"""The governance of a keystore: what it leaves open, and where vendors read it differently."""

from __future__ import annotations

from collections.abc import Iterator

from sros_tool.checks.keystores.documents import domain_problems
from sros_tool.checks.keystores.enclaves import plain, plain_file
from sros_tool.checks.keystores.opened import OpenedEnclave, OpenedKeystore
from sros_tool.checks.kind import ERROR, WARNING, Finding, Kind, by_id
from sros_tool.dds.governance import DomainRule, Governance, Protection, TopicRule
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import GOVERNANCE_XML
from sros_tool.pki import smime
from sros_tool.policy.patterns import covers
from sros_tool.translate import governance_for

_GOVERNANCE = "DDS-Security 1.1, 9.4.1.2"
_TEMPLATE = "Make a keystore by a template with more protection, such as production."

UNAUTHENTICATED = Kind(
    "governance.unauthenticated",
    ERROR,
    "participants without an identity may join",
    "What no rule of a topic controls or protects, they read and write: on Fast DDS 2.14, which "
    "refuses the document where whole messages are protected. Fast DDS 2.9 ignores it.",
    f"{_GOVERNANCE} (allow_unauthenticated_participants); measured.",
    "Set it to false.",
)
NO_JOIN_CONTROL = Kind(
    "governance.no-join-control",
    WARNING,
    "whoever is authenticated may join, whatever its permissions",
    "The permissions of a participant are not asked when it joins; vendors then decide "
    "differently on one without any.",
    f"{_GOVERNANCE} (enable_join_access_control); Fast DDS 2.14.5, Cyclone DDS 0.10.2.",
    "Set enable_join_access_control to true.",
)
NO_ACCESS_CONTROL = Kind(
    "governance.no-access-control",
    WARNING,
    "topics that everybody in the domain may read or write",
    "Permissions are not asked for these topics, so a policy for them does nothing.",
    f"{_GOVERNANCE} (enable_read_access_control, enable_write_access_control).",
    _TEMPLATE,
)
NO_ENCRYPTION = Kind(
    "governance.no-encryption",
    WARNING,
    "topics whose payload can be read on the wire",
    "Neither the payload, nor the submessage, nor the whole message is encrypted.",
    f"{_GOVERNANCE} (data_protection_kind, metadata_protection_kind, rtps_protection_kind).",
    _TEMPLATE,
)
SIGNED_PAYLOAD = Kind(
    "governance.signed-payload",
    WARNING,
    "topics of which Fast DDS loses messages",
    "Where the payload is only signed, Fast DDS leaves its padding out of the signature: a message "
    "whose serialized length is not a multiple of four is not accepted by the reader.",
    "Fast DDS 2.14.5, measured; corrected in its source in August 2026 (pull request 6498).",
    "Sign the submessage, with the payload in it (data NONE, metadata SIGN), or encrypt (data "
    "ENCRYPT).",
)
NOT_AUTHENTIC = Kind(
    "governance.no-authenticity",
    ERROR,
    "topics whose messages anybody can forge",
    "Nothing is signed: neither payload, nor submessage, nor the whole message.",
    f"{_GOVERNANCE} (rtps, metadata and data protection kinds).",
    _TEMPLATE,
)
DISCOVERY_OPEN = Kind(
    "governance.discovery-open",
    WARNING,
    "discovery without protection",
    "Who listens learns every node, topic and type, and who writes can make up others.",
    f"{_GOVERNANCE} (discovery_protection_kind, enable_discovery_protection).",
    _TEMPLATE,
)
LIVELINESS_OPEN = Kind(
    "governance.liveliness-open",
    WARNING,
    "liveliness without protection",
    "A stranger can keep a dead writer alive in the eyes of its readers.",
    f"{_GOVERNANCE} (liveliness_protection_kind, enable_liveliness_protection).",
    _TEMPLATE,
)
NO_TOPIC_RULE = Kind(
    "governance.no-topic-rule",
    ERROR,
    "topics for which there is no rule",
    "Where no topic rule matches, the endpoint cannot be made; without a rule for "
    "ros_discovery_info no node of ROS 2 starts.",
    f"{_GOVERNANCE}; Fast DDS 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Put a rule for * last.",
)
UNREACHABLE = Kind(
    "governance.unreachable-rule",
    WARNING,
    "a topic rule that an earlier one hides",
    "The first rule that matches a topic decides.",
    f"{_GOVERNANCE}; Fast DDS 2.14.5, Cyclone DDS 0.10.2.",
    "Put narrower rules first, as sros does.",
)
DOMAIN_RANGE = Kind(
    "governance.domain-range",
    ERROR,
    "a range of domains that vendors read differently",
    "Without <max> it means one domain alone; without <min>, or above 230, Cyclone DDS refuses "
    "the document.",
    "DDS-Security 1.1, 9.4.1.2; Fast DDS 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Write <id>, or <min> and <max> up to 230.",
)
DIFFERS = Kind(
    "governance.differs",
    ERROR,
    "enclaves with different governance",
    "Nodes that protect a topic differently do not match, and say nothing about it.",
    "DDS-Security 1.1, 8.4 (the protection attributes of both sides must agree).",
    "Replace the copy by a link to the governance of the keystore, or export the enclave again.",
)
XML_DIFFERS = Kind(
    "governance.xml-differs",
    WARNING,
    "governance.xml says something else than what is signed",
    "DDS loads governance.p7s. Somebody changed the readable copy, and it was never signed.",
    "rcl 9 (security.c).",
    "Restore it from governance.p7s (`sros inspect` shows it).",
)

KINDS = by_id(
    UNAUTHENTICATED, NO_JOIN_CONTROL, NO_ACCESS_CONTROL, NO_ENCRYPTION, SIGNED_PAYLOAD,
    NOT_AUTHENTIC, DISCOVERY_OPEN, LIVELINESS_OPEN, NO_TOPIC_RULE, UNREACHABLE, DOMAIN_RANGE,
    DIFFERS, XML_DIFFERS,
)  # fmt: skip

_SIGNING = (Protection.SIGN, Protection.SIGN_WITH_ORIGIN_AUTHENTICATION)
_NONE = (Protection.NONE,)


def check_governance(enclave: OpenedEnclave, *, alone: bool) -> Iterator[Finding]:
    """The governance that an enclave loads.

    It is told once for a keystore, by the first enclave; ``alone`` says that this one is not the
    first, and has a copy of its own that may differ.
    """
    governance = enclave.state.governance
    if governance is None:
        return
    file = enclave.file("governance.p7s")
    if alone:
        own, common = enclave.state.files["governance.p7s"], enclave.keystore.governance
        if common and own != common and _content(own) != _content(common):
            text = f"'{file}' is not the governance of the keystore"
            yield DIFFERS.found(enclave.name, text, file)
        return
    yield from governance_findings(enclave.keystore, governance, file)


def governance_findings(
    keystore: OpenedKeystore, governance: Governance, file: str
) -> Iterator[Finding]:
    """What a governance document leaves open; ``file`` is where it stands."""
    domains = governance.domains().closed()
    accepted = keystore.accepts(lambda s: governance == governance_for(s.protection, domains))
    for rule in governance.domain_access_rules:
        subject = f"domain {rule.domains}"
        for kind, text in (*_domain_rule(rule), *_topic_rules(rule)):
            # A template chooses what is open, but nobody chooses that messages are lost.
            chosen = "" if kind is SIGNED_PAYLOAD else accepted
            yield kind.found(subject, text, file, accepted=chosen)
        for problem in domain_problems(rule.domains):
            yield DOMAIN_RANGE.found(subject, f"the range {problem}", file)
    yield from _copy(keystore)


def _let_in(rule: DomainRule) -> str:
    """What comes of unauthenticated participants on Fast DDS 2.14, which heeds them; measured."""
    if rule.rtps_protection_kind is not Protection.NONE:
        return "with protected RTPS messages Fast DDS 2.14 refuses the document"
    hidden = rule.discovery_protection_kind is not Protection.NONE
    opened = [
        each.topic_expression
        for each in rule.topic_access_rules
        if not (each.enable_read_access_control or each.enable_write_access_control)
        and not (each.enable_discovery_protection and hidden)
        and each.metadata_protection_kind is Protection.NONE
        and each.data_protection_kind is Protection.NONE
    ]
    if not opened:
        return "every topic is controlled or protected, so on Fast DDS they reach none"
    return f"on Fast DDS 2.14 anybody reads and writes {', '.join(opened[:3])}"


def _domain_rule(rule: DomainRule) -> Iterator[tuple[Kind, str]]:
    if rule.allow_unauthenticated_participants:
        yield UNAUTHENTICATED, f"allow_unauthenticated_participants is true: {_let_in(rule)}"
    if not rule.enable_join_access_control:
        yield NO_JOIN_CONTROL, "enable_join_access_control is false"
    if rule.discovery_protection_kind is Protection.NONE:
        yield DISCOVERY_OPEN, "discovery_protection_kind is NONE"
    if rule.liveliness_protection_kind is Protection.NONE:
        yield LIVELINESS_OPEN, "liveliness_protection_kind is NONE"


def _topic_rules(rule: DomainRule) -> Iterator[tuple[Kind, str]]:
    expressions = [each.topic_expression for each in rule.topic_access_rules]
    if not any(covers(each, "ros_discovery_info") for each in expressions):
        yield NO_TOPIC_RULE, "none matches ros_discovery_info"
    elif "*" not in expressions:
        yield NO_TOPIC_RULE, "none is for *"
    for index, topic in enumerate(rule.topic_access_rules):
        yield from _topic_rule(rule, topic)
        hiding = next((e for e in expressions[:index] if covers(e, topic.topic_expression)), None)
        if hiding is not None:
            yield (
                UNREACHABLE,
                f"the rule for {topic.topic_expression} stands behind that for {hiding}",
            )


def _topic_rule(rule: DomainRule, topic: TopicRule) -> Iterator[tuple[Kind, str]]:
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
        yield NO_ACCESS_CONTROL, f"everybody may {' and '.join(open_for)} {name}"
    levels = (
        rule.rtps_protection_kind,
        topic.metadata_protection_kind,
        topic.data_protection_kind,
    )
    if all(level in _NONE for level in levels):
        yield NOT_AUTHENTIC, f"nothing protects {name}"
    elif all(level in (*_NONE, *_SIGNING) for level in levels):
        yield NO_ENCRYPTION, f"{name} is signed only"
    if topic.data_protection_kind in _SIGNING:
        yield SIGNED_PAYLOAD, f"data_protection_kind is {topic.data_protection_kind} for {name}"
    if not topic.enable_discovery_protection:
        yield DISCOVERY_OPEN, f"enable_discovery_protection is false for {name}"
    if not topic.enable_liveliness_protection:
        yield LIVELINESS_OPEN, f"enable_liveliness_protection is false for {name}"


def _copy(keystore: OpenedKeystore) -> Iterator[Finding]:
    xml, signed = keystore.root / GOVERNANCE_XML, keystore.governance
    if signed and xml.is_file() and plain_file(xml) != _content(signed):
        text = "governance.xml is not what governance.p7s holds"
        yield XML_DIFFERS.found("governance", text, str(xml))


def _content(message: bytes) -> bytes:
    """What is signed; b"" where that cannot be read, which is told elsewhere."""
    try:
        return plain(smime.parse(message).document)
    except SrosError:
        return b""
