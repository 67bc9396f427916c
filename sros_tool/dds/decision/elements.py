"""XML elements in the form that vendors' parsers return, and parsers by the standard's schemas.

Source: DDS-Security 1.1, the schemas omg_shared_ca_permissions and omg_shared_ca_governance of
20170901.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import Enum, auto

from lxml import etree

from sros_tool.dds.decision.access import Outcome, Refusal
from sros_tool.dds.decision.vendors import VendorTraits
from sros_tool.dds.governance import DomainRule, Governance, TopicRule, attributes, parse_governance
from sros_tool.dds.permissions import Permissions, parse_permissions
from sros_tool.xml import tag_of


def decoded(text: str) -> str:
    """Return ``text``, whose characters stand for bytes, decoded as UTF-8.

    Invalid bytes become surrogates.
    """
    return text if text.isascii() else text.encode("latin-1").decode("utf-8", "surrogateescape")


class UnreadableError(Exception):
    """Raised with the reason that a vendor does not accept a document.

    ``missing`` says that content is missing from the document; this makes some releases crash
    (`VendorTraits.crashes_on_missing_content`).
    """

    def __init__(self, text: str, *, missing: bool = False) -> None:
        super().__init__(text)
        self.missing = missing

    def refusal(self, traits: VendorTraits, document: str) -> Refusal:
        """Return this error as a `Refusal` of the vendor with these traits."""
        crashes = self.missing and traits.crashes_on_missing_content
        how, outcome = ("crashes on", Outcome.CRASHES) if crashes else ("refuses", Outcome.REFUSED)
        return Refusal("malformed", f"{traits.title} {how} the {document}: {self}.", outcome)


class NodeMark(Enum):
    """A node that is neither an element nor text."""

    COMMENT = auto()
    DECLARATION = auto()
    """An XML declaration, or any processing instruction."""
    OTHER = auto()
    """``<!...>``"""


@dataclass(slots=True)
class XmlElement:
    """An XML element; ``children`` has its nodes in order, with text and CDATA as strings.

    ``name`` and the names of ``attributes`` keep their namespace prefixes, as written.
    """

    name: str
    attributes: dict[str, str] = field(default_factory=dict)
    children: list[XmlElement | str | NodeMark] = field(default_factory=list)

    @property
    def elements(self) -> list[XmlElement]:
        """The child elements."""
        return [child for child in self.children if isinstance(child, XmlElement)]


def _attributes(rule: type[DomainRule | TopicRule]) -> str:
    return "".join(
        f"{attribute.name}," if attribute.default is None else f"({attribute.name},)?"
        for attribute in attributes(rule)
    )


# Maps an element to its allowed children, as a regular expression over names with a comma after
# each; other elements contain text.
_DOMAINS = {
    "domains": "(id,|id_range,)+",
    "id_range": "min,(max,)?|max,",
}
_RULE = "domains,(publish,)*(subscribe,)*(relay,)*"
# The schema allows these elements in any order, each at most once.
_CRITERIA = "(?!.*(?:^|,)(\\w+,).*\\1)(?=.*topics,)(topics,|partitions,|data_tags,)*"
_PERMISSIONS = _DOMAINS | {
    "dds": "permissions,",
    "permissions": "(grant,)+",
    "grant": "subject_name,validity,(allow_rule,|deny_rule,)*default,",
    "validity": "not_before,not_after,",
    "allow_rule": _RULE,
    "deny_rule": _RULE,
    "publish": _CRITERIA,
    "subscribe": _CRITERIA,
    "relay": _CRITERIA,
    "topics": "(topic,)+",
    "partitions": "(partition,)+",
    "data_tags": "(tag,)+",
    "tag": "name,value,",
}
_GOVERNANCE = _DOMAINS | {
    "dds": "domain_access_rules,",
    "domain_access_rules": "(domain_rule,)+",
    "domain_rule": f"domains,{_attributes(DomainRule)}topic_access_rules,",
    "topic_access_rules": "(topic_rule,)+",
    "topic_rule": f"topic_expression,{_attributes(TopicRule)}",
}

_NUMBER = r"\s*\+?\d+\s*"
_FLAG = r"\s*(true|false|0|1)\s*"
_DATE = r"\s*-?\d{4,}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:\d\d)?\s*"
_TEXTS = {
    "id": _NUMBER,
    "min": _NUMBER,
    "max": _NUMBER,
    "not_before": _DATE,
    "not_after": _DATE,
    "default": "ALLOW|DENY",
} | {
    attribute.name: _FLAG if attribute.is_flag else "|".join(map(str, attribute.values))
    for rule in (DomainRule, TopicRule)
    for attribute in attributes(rule)
}
_EVERYWHERE = "{http://www.w3.org/2001/XMLSchema-instance}"


def read_permissions(xml: bytes) -> Permissions:
    """Return the permissions in ``xml``; raise `UnreadableError` for an invalid document."""
    _check(_root(xml), "dds", _PERMISSIONS)
    return parse_permissions(xml, "permissions")


def read_governance(xml: bytes) -> Governance:
    """Return the governance in ``xml``; raise `UnreadableError` for an invalid document."""
    _check(_root(xml), "dds", _GOVERNANCE)
    return parse_governance(xml, "governance")


def _root(xml: bytes) -> etree._Element:
    """Return the root element; spaces and line ends may precede the XML declaration."""
    parser = etree.XMLParser(
        remove_pis=True, resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False
    )
    try:
        root: etree._Element = etree.fromstring(xml.lstrip(), parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise UnreadableError(f"it is not well-formed XML ({error})") from error
    return root


def _check(element: etree._Element, name: str, grammar: dict[str, str]) -> None:
    if element.tag != name:
        raise UnreadableError(f"its root is not <{name}>")
    children = [child for child in element if isinstance(child.tag, str)]
    text = "".join([element.text or "", *(child.tail or "" for child in element)])
    attributes = [
        str(attribute) for attribute in element.attrib if not str(attribute).startswith(_EVERYWHERE)
    ]
    if attributes != (["name"] if name == "grant" else []):
        raise UnreadableError(f"<{name}> does not have the expected attributes")
    if name not in grammar:
        if children or not re.fullmatch(_TEXTS.get(name, "(?s:.*)"), text, re.ASCII):
            raise UnreadableError(f"<{name}> holds an unexpected value, {text!r}")
        return
    names = "".join(f"{tag_of(child)}," for child in children)
    if text.strip() or not re.fullmatch(grammar[name], names):
        raise UnreadableError(f"<{name}> does not have the expected elements in the expected order")
    for child in children:
        _check(child, tag_of(child), grammar)
