"""The governance document of DDS Security: the protection of domains and topics, and its XML.

Names follow the specification (DDS-Security 1.1, 9.4.1.2 and the schema
omg_shared_ca_governance of 20170901).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field, fields
from enum import StrEnum
from typing import Any, NamedTuple

from lxml import etree

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import XSI, domain_lines, read_domains
from sros_tool.errors import DocumentError
from sros_tool.values import shows
from sros_tool.xml import escape, parse, require_child, tag_of

_SCHEMA = "http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_governance.xsd"


class ProtectionKind(StrEnum):
    """The protection of messages; ``..._WITH_ORIGIN_AUTHENTICATION`` also proves the writer."""

    NONE = "NONE"
    SIGN = "SIGN"
    ENCRYPT = "ENCRYPT"
    SIGN_WITH_ORIGIN_AUTHENTICATION = "SIGN_WITH_ORIGIN_AUTHENTICATION"
    ENCRYPT_WITH_ORIGIN_AUTHENTICATION = "ENCRYPT_WITH_ORIGIN_AUTHENTICATION"


_DATA_KINDS = (ProtectionKind.NONE, ProtectionKind.SIGN, ProtectionKind.ENCRYPT)
Value = bool | ProtectionKind


class Attribute(NamedTuple):
    """An attribute of domain rules or topic rules, declared by the metadata of the rule's field.

    All code that reads, writes, describes or compares rules iterates over `attributes`, in the
    order of the schema and of the fields.  So a new attribute needs only a new field.

    ``name`` is the name of the XML element and of the rule's field; ``term`` is the field of
    `sros_tool.policy.model` that is translated into the attribute.  ``values`` are the allowed
    values.  ``open`` is the value without protection; ``portable`` is a protecting value that all
    vendors enforce alike. ``default`` is the value if a document lacks the element; None if the
    schema requires the element.
    """

    name: str
    term: str
    values: tuple[Value, ...]
    open: Value
    portable: Value
    default: Value | None = None

    @property
    def is_flag(self) -> bool:
        """Whether the attribute is a boolean; otherwise it is a protection kind."""
        return isinstance(self.open, bool)

    def is_open(self, rule: DomainRule | TopicRule) -> bool:
        """Return whether ``rule`` has the attribute's open value, which protects nothing."""
        return bool(getattr(rule, self.name) == self.open)


def _flag(term: str, *, protects: bool = True) -> dict[str, Any]:
    """Return the field metadata of an attribute with the values true and false.

    ``protects`` is the value that protects.
    """
    values = (False, True)
    return {"term": term, "values": values, "open": not protects, "portable": protects}


def _protection_kind(
    term: str, values: tuple[ProtectionKind, ...] = tuple(ProtectionKind)
) -> dict[str, Any]:
    """Return the field metadata of an attribute whose value is a protection kind."""
    kinds = {"open": ProtectionKind.NONE, "portable": ProtectionKind.ENCRYPT}
    return {"term": term, "values": values, **kinds}


@dataclass(frozen=True, slots=True)
class TopicRule:
    """The protection of the topics that match an expression."""

    topic_expression: str
    """The expression for the DDS topics that the rule protects."""
    enable_discovery_protection: bool = field(metadata=_flag("discovery"))
    """Whether discovery of the topic is protected."""
    enable_liveliness_protection: bool = field(metadata=_flag("liveliness"))
    """Whether liveliness of the topic's endpoints is protected."""
    enable_read_access_control: bool = field(metadata=_flag("read_access_control"))
    """Whether permissions decide who may read."""
    enable_write_access_control: bool = field(metadata=_flag("write_access_control"))
    """Whether permissions decide who may write."""
    metadata_protection_kind: ProtectionKind = field(metadata=_protection_kind("metadata"))
    """Protection of submessages, as in DDS-Security 1.1."""
    data_protection_kind: ProtectionKind = field(metadata=_protection_kind("data", _DATA_KINDS))
    """Protection of the payload: ``NONE``, ``SIGN`` or ``ENCRYPT``."""


@shows(
    "allow_unauthenticated_participants",
    "enable_join_access_control",
    "discovery_protection_kind",
    "liveliness_protection_kind",
    "rtps_protection_kind",
)
@dataclass(frozen=True, slots=True)
class DomainRule:
    """The protection of some domains; for a topic, the first matching topic rule applies."""

    domains: DomainSet
    allow_unauthenticated_participants: bool = field(
        metadata=_flag("allow_unauthenticated_participants", protects=False)
    )
    """Whether participants without a certificate may join."""
    enable_join_access_control: bool = field(metadata=_flag("join_access_control"))
    """Whether permissions decide who may join."""
    discovery_protection_kind: ProtectionKind = field(metadata=_protection_kind("discovery"))
    """Protection of discovery, as in DDS-Security 1.1."""
    liveliness_protection_kind: ProtectionKind = field(metadata=_protection_kind("liveliness"))
    """Protection of liveliness messages, as in DDS-Security 1.1."""
    rtps_protection_kind: ProtectionKind = field(metadata=_protection_kind("rtps"))
    """Protection of whole RTPS messages, as in DDS-Security 1.1."""
    topic_access_rules: tuple[TopicRule, ...]


def _declared_attributes(rule: type[DomainRule | TopicRule]) -> tuple[Attribute, ...]:
    return tuple(
        Attribute(
            attribute_field.name,
            **attribute_field.metadata,
            default=None if attribute_field.default is MISSING else attribute_field.default,
        )
        for attribute_field in fields(rule)
        if attribute_field.metadata
    )


_ATTRIBUTES: dict[type, tuple[Attribute, ...]] = {
    rule: _declared_attributes(rule) for rule in (DomainRule, TopicRule)
}


def attributes(rule: type[DomainRule | TopicRule]) -> tuple[Attribute, ...]:
    """Return the attributes of domain rules or of topic rules, in the order of the schema."""
    return _ATTRIBUTES[rule]


def attribute_values(rule_class: type[DomainRule | TopicRule], *, protect: bool) -> dict[str, Any]:
    """Map the names of a rule's attributes to values.

    With ``protect``, these are the portable values; otherwise, the open values.
    """
    return {
        attribute.name: attribute.portable if protect else attribute.open
        for attribute in attributes(rule_class)
    }


class Governance(NamedTuple):
    """A governance document; for a domain, the first domain rule that lists it applies."""

    domain_access_rules: tuple[DomainRule, ...]

    def domains(self) -> DomainSet:
        """Return the domains of all rules."""
        return DomainSet(tuple(p for r in self.domain_access_rules for p in r.domains.ranges))


# ── writing ────────────────────────────────────────────────────────────────────────────────


def render_governance(governance: Governance) -> bytes:
    """Return the document as XML in UTF-8, with its elements in the order of the schema."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<dds xmlns:xsi="{XSI}" xsi:noNamespaceSchemaLocation="{_SCHEMA}">',
        "  <domain_access_rules>",
    ]
    for rule in governance.domain_access_rules:
        lines.append("    <domain_rule>")
        lines += [f"      {line}" for line in domain_lines(rule.domains)]
        lines += [f"      {line}" for line in _attribute_lines(rule)]
        lines.append("      <topic_access_rules>")
        for topic in rule.topic_access_rules:
            lines.append("        <topic_rule>")
            expression = escape(topic.topic_expression)
            lines.append(f"          <topic_expression>{expression}</topic_expression>")
            lines += [f"          {line}" for line in _attribute_lines(topic)]
            lines.append("        </topic_rule>")
        lines += ["      </topic_access_rules>", "    </domain_rule>"]
    lines += ["  </domain_access_rules>", "</dds>", ""]
    return "\n".join(lines).encode()


def _attribute_lines(rule: DomainRule | TopicRule) -> Iterator[str]:
    for attribute in attributes(type(rule)):
        value = getattr(rule, attribute.name)
        # Vendors refuse elements that they do not know, so an attribute with its default is left
        # out.
        if attribute.default is None or value != attribute.default:
            text = json.dumps(value) if attribute.is_flag else str(value)
            yield f"<{attribute.name}>{text}</{attribute.name}>"


# ── reading ────────────────────────────────────────────────────────────────────────────────


def parse_governance(data: bytes, name: str = "the governance document") -> Governance:
    """Return the governance document in ``data``; ``name`` is its name in errors.

    Raises:
        DocumentError: ``data`` is not a governance document.
    """
    root = parse(data, name, as_bytes=True)
    parent = require_child(root, "domain_access_rules", name, "governance")
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
    rules = tuple(
        TopicRule(topic_expression=_text(topic, "topic_expression"), **_read(topic, TopicRule))
        for topic in topics
    )
    return DomainRule(
        domains=read_domains(domains),
        topic_access_rules=rules,
        **_read(element, DomainRule),
    )


def _read(element: etree._Element, rule: type[DomainRule | TopicRule]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for attribute in attributes(rule):
        if attribute.default is not None and element.find(attribute.name) is None:
            values[attribute.name] = attribute.default
            continue
        text = _text(element, attribute.name)
        if attribute.is_flag:
            if text.lower() not in ("true", "false", "1", "0"):
                raise DocumentError(
                    f"<{attribute.name}> holds {text!r}, which is neither true nor false"
                )
            values[attribute.name] = text.lower() in ("true", "1")
        elif text.upper() in ProtectionKind.__members__:
            values[attribute.name] = ProtectionKind(text.upper())
        else:
            raise DocumentError(
                f"<{attribute.name}> holds {text!r}, which is not a protection kind"
            )
    return values


def _text(element: etree._Element, name: str) -> str:
    text = element.findtext(name)
    if text is None:
        raise DocumentError(f"a <{tag_of(element)}> lacks its <{name}>")
    return text.strip()
