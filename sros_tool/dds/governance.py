"""The governance document of DDS Security: what a domain protects, and its XML.

Names are those of the specification (DDS-Security 1.1, 9.4.1.2 and the schema
omg_shared_ca_governance of 20170901).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any
from xml.sax.saxutils import escape

from lxml import etree

from sros_tool.dds.domains import DomainSet, domain_lines, read_domains
from sros_tool.dds.permissions import XSI
from sros_tool.errors import DocumentError
from sros_tool.xml import parse, tag_of

SCHEMA = "http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_governance.xsd"


class Protection(StrEnum):
    """A protection kind; data protection knows only the first three."""

    NONE = "NONE"
    SIGN = "SIGN"
    ENCRYPT = "ENCRYPT"
    SIGN_WITH_ORIGIN_AUTHENTICATION = "SIGN_WITH_ORIGIN_AUTHENTICATION"
    ENCRYPT_WITH_ORIGIN_AUTHENTICATION = "ENCRYPT_WITH_ORIGIN_AUTHENTICATION"


DATA_PROTECTIONS = (Protection.NONE, Protection.SIGN, Protection.ENCRYPT)


@dataclass(frozen=True, slots=True)
class TopicRule:
    """How the topics that match an expression are protected."""

    topic_expression: str
    enable_discovery_protection: bool
    enable_liveliness_protection: bool
    enable_read_access_control: bool
    enable_write_access_control: bool
    metadata_protection_kind: Protection
    data_protection_kind: Protection


@dataclass(frozen=True, slots=True)
class DomainRule:
    """How some domains are protected; the first topic rule that matches a topic decides."""

    domains: DomainSet
    allow_unauthenticated_participants: bool
    enable_join_access_control: bool
    discovery_protection_kind: Protection
    liveliness_protection_kind: Protection
    rtps_protection_kind: Protection
    topic_access_rules: tuple[TopicRule, ...]


@dataclass(frozen=True, slots=True)
class Governance:
    """A governance document; the first domain rule that names a domain decides."""

    domain_access_rules: tuple[DomainRule, ...]

    def domains(self) -> DomainSet:
        """All domains that some rule names."""
        return DomainSet(tuple(p for r in self.domain_access_rules for p in r.domains.ranges))


Fields = tuple[tuple[str, type], ...]

# The elements between <domains> and <topic_access_rules>, and those of a topic rule, in order.
_DOMAIN_FIELDS: Fields = (
    ("allow_unauthenticated_participants", bool),
    ("enable_join_access_control", bool),
    ("discovery_protection_kind", Protection),
    ("liveliness_protection_kind", Protection),
    ("rtps_protection_kind", Protection),
)
_TOPIC_FIELDS: Fields = (
    ("topic_expression", str),
    ("enable_discovery_protection", bool),
    ("enable_liveliness_protection", bool),
    ("enable_read_access_control", bool),
    ("enable_write_access_control", bool),
    ("metadata_protection_kind", Protection),
    ("data_protection_kind", Protection),
)


def render_governance(governance: Governance) -> bytes:
    """The document as XML in UTF-8, with its elements in the order of the schema."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<dds xmlns:xsi="{XSI}" xsi:noNamespaceSchemaLocation="{SCHEMA}">',
        "  <domain_access_rules>",
    ]
    for rule in governance.domain_access_rules:
        lines.append("    <domain_rule>")
        lines += [f"      {line}" for line in domain_lines(rule.domains)]
        lines += [f"      {line}" for line in _field_lines(rule, _DOMAIN_FIELDS)]
        lines.append("      <topic_access_rules>")
        for topic in rule.topic_access_rules:
            lines.append("        <topic_rule>")
            lines += [f"          {line}" for line in _field_lines(topic, _TOPIC_FIELDS)]
            lines.append("        </topic_rule>")
        lines += ["      </topic_access_rules>", "    </domain_rule>"]
    lines += ["  </domain_access_rules>", "</dds>", ""]
    return "\n".join(lines).encode()


def _field_lines(value: object, fields: Fields) -> list[str]:
    lines = []
    for name, kind in fields:
        content = getattr(value, name)
        text = ("true" if content else "false") if kind is bool else escape(str(content))
        lines.append(f"<{name}>{text}</{name}>")
    return lines


def parse_governance(data: bytes, name: str = "the governance document") -> Governance:
    """Read a governance document; raises `DocumentError` where it is not one."""
    root = parse(data, name)
    parent = root.find("domain_access_rules")
    if root.tag != "dds" or parent is None:
        raise DocumentError(
            f"{name} is not a governance document", "<dds><domain_access_rules> is missing."
        )
    try:
        return Governance(tuple(_read_domain_rule(child) for child in parent))
    except DocumentError as error:
        raise DocumentError(f"{name} is malformed", f"{error}.", error.remedy) from error


def _read_domain_rule(element: etree._Element) -> DomainRule:
    domains, topics = element.find("domains"), element.find("topic_access_rules")
    if element.tag != "domain_rule" or domains is None or topics is None:
        raise DocumentError("a <domain_rule> lacks its <domains> or its <topic_access_rules>")
    for topic in topics:
        if topic.tag != "topic_rule":
            raise DocumentError(f"<topic_access_rules> holds an unknown element <{tag_of(topic)}>")
    rules = tuple(TopicRule(**_read_fields(topic, _TOPIC_FIELDS)) for topic in topics)
    return DomainRule(
        domains=read_domains(domains),
        topic_access_rules=rules,
        **_read_fields(element, _DOMAIN_FIELDS),
    )


def _read_fields(element: etree._Element, fields: Fields) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, kind in fields:
        text = element.findtext(name)
        if text is None:
            raise DocumentError(f"a <{tag_of(element)}> lacks its <{name}>")
        values[name] = _read_value(text.strip(), name, kind)
    return values


def _read_value(text: str, name: str, kind: type) -> object:
    if kind is bool:
        if text.lower() not in ("true", "false", "1", "0"):
            raise DocumentError(f"<{name}> holds {text!r}, which is neither true nor false")
        return text.lower() in ("true", "1")
    if kind is Protection:
        try:
            return Protection(text.upper())
        except ValueError as error:
            raise DocumentError(f"<{name}> holds {text!r}, which is no protection kind") from error
    return text
