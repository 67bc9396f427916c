"""Governance and permissions as Cyclone DDS 0.10 reads them, with its own XML parser.

In this parser (ddsrt/src/xmlparser.c), names consist of ASCII letters, digits, ``_ - :``.
Comments, processing instructions and ``<!...>`` are skipped between any two tokens.  An element
contains either elements or a single text.

The case of tags, the order of elements, and blanks around texts do not matter.  If an element is
repeated, its last occurrence counts.  An unknown element or attribute makes the document malformed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from sros_tool.dds.decision.elements import UnreadableError, XmlElement, decoded
from sros_tool.dds.domains import MAX_DOMAIN, DomainRange, DomainSet
from sros_tool.dds.governance import (
    Attribute,
    DomainRule,
    Governance,
    ProtectionKind,
    TopicRule,
    Value,
    attributes,
)
from sros_tool.dds.permissions import Criteria, Grant, Permissions, Rule

_BLANKS = " \t\v\r\n"
_CDATA = "<![CDATA["
_SHORTEST_TEXT = len(_CDATA) - 2  # if fewer bytes are left, Cyclone DDS does not look for more text
_DEEPEST = (
    # Levels of nested elements; a deeper document has unknown elements, and is refused for them.
    200
)
_NAME = re.compile("[A-Za-z][A-Za-z0-9_:-]*")
_SKIPPED = re.compile(
    rf"(?:[{_BLANKS}]++|<!--.*?-->|<\?(?:.*?\?>|.*)|<!(?!--|\[CDATA\[)(?:[^>]*>|.*))*+", re.DOTALL
)
_QUOTES = {'"': '"', "'": "'", "\xe2\x80\x9c": "\xe2\x80\x9d", "\xe2\x80\x98": "\xe2\x80\x99"}
_REFERENCE = re.compile("&(.{0,15}?;)?", re.DOTALL)
_NUMBER = re.compile(rf"#(?:x[{_BLANKS}\f]*([+-]?(?:0[xX])?[0-9a-fA-F]+)|[{_BLANKS}\f]*([+-]?\d+))")
_ENTITIES = {"lt": "<", "gt": ">", "amp": "&", "apos": "'", "quot": '"'}


def read(xml: bytes) -> XmlElement:
    """Return the root of a document; raise `UnreadableError` if Cyclone DDS refuses it.

    Texts are stripped of surrounding blanks and decoded as UTF-8; invalid bytes become surrogates.
    """
    return _Reader(xml).root()


class _Reader:
    def __init__(self, xml: bytes) -> None:
        self._text = xml.decode("latin-1").partition("\0")[0]  # each character stands for one byte
        self._index = 0

    def root(self) -> XmlElement:
        root = self._element(0)
        self._skip()
        if self._index < len(self._text):
            raise self._error("something follows the root element")
        return root

    def _error(self, why: str) -> UnreadableError:
        line = self._text.count("\n", 0, self._index) + 1
        return UnreadableError(f"its XML is malformed: {why} (line {line})")

    def _skip(self) -> None:
        match = _SKIPPED.match(self._text, self._index)
        self._index = match.end() if match else self._index
        if self._text.startswith("<!--", self._index):
            raise self._error("a comment is not closed")

    def _take(self, mark: str) -> bool:
        is_next = self._text.startswith(mark, self._index)
        self._index += len(mark) if is_next else 0
        return is_next

    def _name(self) -> str:
        match = _NAME.match(self._text, self._index)
        if not match:
            raise self._error("a name is malformed")
        self._index = match.end()
        return match[0]

    def _string(self) -> str:
        for begin, end in _QUOTES.items():
            if self._take(begin):
                stop = self._text.find(end, self._index)
                if stop < 0:
                    raise self._error("a quoted text is not closed")
                text = self._text[self._index : stop]
                self._index = stop + len(end)
                return self._unescaped(text)
        raise self._error("the value of an attribute is missing or not in quotation marks")

    def _element(self, depth: int) -> XmlElement:
        self._skip()
        if depth > _DEEPEST:
            raise self._error("its elements are nested too deeply")
        if self._text.startswith(_CDATA, self._index) or not self._take("<"):
            raise self._error("an element was expected")
        element = XmlElement(self._name())
        self._skip()
        while _NAME.match(self._text, self._index):
            name = self._name()
            self._skip()
            if not self._take("="):
                raise self._error(f"the attribute {name} has no value")
            self._skip()
            element.attributes[name] = decoded(self._string())
            self._skip()
        if self._take("/>"):
            return element
        if not self._take(">"):
            raise self._error(f"<{element.name}> does not end")
        self._content(element, depth)
        self._skip()
        closed = self._take("/>") or (self._take("</") and self._name() == element.name)
        if not closed or not self._take(">"):
            raise self._error(f"<{element.name}> is not closed")
        return element

    def _content(self, element: XmlElement, depth: int) -> None:
        start = self._index
        if not self._opens():
            self._index = start
            if text := self._content_text():
                element.children.append(text)
            return
        while self._opens():
            element.children.append(self._element(depth + 1))

    def _opens(self) -> bool:
        """Return whether the next token begins an element.

        Raises:
            UnreadableError: the token is malformed.
        """
        self._skip()
        text, index = self._text, self._index
        if text[index : index + 1] == "<" and not text.startswith(_CDATA, index):
            closes = text[index + 1 : index + 2] == "/"
            if not _NAME.match(text, index + 1 + closes):
                raise self._error("a name is malformed")
            return not closes
        if text.startswith(tuple(_QUOTES), index):  # Cyclone DDS skips a quoted text here
            self._string()
            self._index = index
        return False

    def _content_text(self) -> str:
        text, done, pending = self._text, "", ""
        while True:
            stop = text.find("<", self._index)
            stop = len(text) if stop < 0 else stop
            pending += text[self._index : stop]
            self._index = stop
            if self._take(_CDATA):
                stop = text.find("]]>", self._index)
                if stop < 0:
                    raise self._error("a CDATA is not closed")
                if stop > self._index:
                    done += self._unescaped(pending) + text[self._index : stop]
                    pending = ""
                self._index = stop + len("]]>")
            if text[self._index : self._index + 1] == "<":
                if not text.startswith("<!--", self._index):
                    break
                stop = text.find("-->", self._index + len("<!--"))
                if stop < 0:
                    raise self._error("a comment is not closed")
                self._index = stop + len("-->")
            if len(text) - self._index < _SHORTEST_TEXT:
                break
        content = (done + self._unescaped(pending)).strip(_BLANKS)
        return decoded(content.partition("\0")[0])

    def _unescaped(self, text: str) -> str:
        return _REFERENCE.sub(self._referenced_character, text) if "&" in text else text

    def _referenced_character(self, match: re.Match[str]) -> str:
        word = (match[1] or "").removesuffix(";")
        if word in _ENTITIES:
            return _ENTITIES[word]
        number = _NUMBER.fullmatch(word)
        if number:
            code = (int(number[1], 16) if number[1] else int(number[2])) % 2**32
            if code <= 0x10FFFF:
                return chr(code).encode("utf-8", "surrogatepass").decode("latin-1")
        raise self._error(f"&{word} is not a character reference")


_SCHEMA_ATTRIBUTES = ("xmlns:xsi", "xsi:nonamespaceschemalocation")
_IGNORED_TAGS = ("relay", "value", "name", "tag", "data_tags")
_MATCHES_NOTHING = "["
"""An expression that matches no name: a set of characters without a closing bracket."""
_LONGEST_NUMBER = 4000
"""Maximum number of digits that are converted; a 64-bit number has at most 20."""
_INTEGER = re.compile(r"[+-]?(?:0[xX][0-9a-fA-F]*|0[0-7]*|[1-9]\d*)\Z", re.ASCII)


def _names(rule: type[DomainRule | TopicRule]) -> tuple[str, ...]:
    return tuple(attribute.name for attribute in attributes(rule))


# The allowed child elements by element; other elements contain only text.
_DOMAINS = {"domains": ("id", "id_range"), "id_range": ("min", "max")}
_GOVERNANCE = _DOMAINS | {
    "dds": ("domain_access_rules",),
    "domain_access_rules": ("domain_rule",),
    "domain_rule": ("domains", "topic_access_rules", *_names(DomainRule)),
    "topic_access_rules": ("topic_rule",),
    "topic_rule": ("topic_expression", *_names(TopicRule)),
}
_RULE = ("domains", "publish", "subscribe")
_PERMISSIONS = _DOMAINS | {
    "dds": ("permissions",),
    "permissions": ("grant",),
    "grant": ("subject_name", "validity", "allow_rule", "deny_rule", "default"),
    "validity": ("not_before", "not_after"),
    "allow_rule": _RULE,
    "deny_rule": _RULE,
    "publish": ("topics", "partitions"),
    "subscribe": ("topics", "partitions"),
    "topics": ("topic",),
    "partitions": ("partition",),
}


def read_governance(xml: bytes) -> Governance:
    """Return the governance in ``xml``; raise `UnreadableError` if Cyclone DDS refuses it."""
    dds = _Node.root(xml, _GOVERNANCE, ())
    parent = dds.last("domain_access_rules")
    rules = parent.all("domain_rule") if parent else []
    if not rules:
        raise UnreadableError("it has no <domain_rule>")
    return Governance(tuple(_read_domain_rule(rule) for rule in rules))


def read_permissions(xml: bytes) -> Permissions:
    """Return the permissions in ``xml``; raise `UnreadableError` if Cyclone DDS refuses them.

    Three kinds of content are accepted, although Cyclone DDS crashes in decisions that use such
    content.  A ``<topic>`` without text is read as "".  A rule without domains is read with a range
    that is open at both ends.  A ``<default>`` may be empty.
    """
    dds = _Node.root(xml, _PERMISSIONS, _IGNORED_TAGS)
    parent = dds.last("permissions")
    grants = parent.all("grant") if parent else []
    if not grants:
        raise UnreadableError("it has no <grant>")
    return Permissions(tuple(_read_grant(grant) for grant in grants))


class _Node:
    """An XML element and its known child elements."""

    def __init__(
        self,
        element: XmlElement,
        grammar: Mapping[str, tuple[str, ...]],
        skipped: tuple[str, ...],
    ) -> None:
        self.tag = element.name.lower()
        self.attribute = element.attributes.get("name")
        self.text = "".join(child for child in element.children if isinstance(child, str))
        _check_attributes(element, self.tag)
        if self.text and self.tag in grammar:
            raise UnreadableError(f"<{self.tag}> holds text, but may hold only elements")
        self._children = []
        for child in element.elements:
            tag = child.name.lower()
            if tag in skipped:
                _check_skipped(child)
            elif tag in grammar.get(self.tag, ()):
                self._children.append(_Node(child, grammar, skipped))
            else:
                raise UnreadableError(f"<{self.tag}> holds an unexpected <{child.name}>")

    @classmethod
    def root(
        cls, xml: bytes, grammar: Mapping[str, tuple[str, ...]], skipped: tuple[str, ...]
    ) -> _Node:
        if b"\0" in xml:
            raise UnreadableError("it contains a NUL, and Cyclone DDS reads only up to there")
        root = read(xml)
        if root.name.lower() != "dds":
            raise UnreadableError("its root is not <dds>")
        return cls(root, grammar, skipped)

    def all(self, *tags: str) -> list[_Node]:
        return [child for child in self._children if child.tag in tags]

    def last(self, tag: str) -> _Node | None:
        nodes = self.all(tag)
        return nodes[-1] if nodes else None


def _check_attributes(element: XmlElement, tag: str) -> None:
    for name in element.attributes:
        if name.lower() not in _SCHEMA_ATTRIBUTES and (name, tag) != ("name", "grant"):
            raise UnreadableError(f"<{tag}> has the unexpected attribute {name!r}")


def _check_skipped(element: XmlElement) -> None:
    _check_attributes(element, "")
    for xml_element in element.elements:
        _check_skipped(xml_element)


# ── values ─────────────────────────────────────────────────────────────────────────────────


def _read_number(node: _Node) -> int:
    if not node.text:
        return 0
    if not _INTEGER.match(node.text):
        raise UnreadableError(f"<{node.tag}> holds {node.text!r}, which is not a number")
    sign, digits = ("-", node.text[1:]) if node.text[0] == "-" else ("", node.text.lstrip("+"))
    if len(digits) > _LONGEST_NUMBER:
        raise UnreadableError(f"<{node.tag}> holds a number of {len(digits)} digits: far too large")
    octal = len(digits) > 1 and digits[0] == "0" and digits[1] not in "xX"
    if digits in ("0x", "0X"):
        return 0
    number = int(sign + digits, 8 if octal else 0)
    if not -(2**63) <= number < 2**63:
        raise UnreadableError(f"<{node.tag}> holds {number}, which is far too large")
    # Cyclone DDS truncates the number to 32 bits before it checks the range.
    number = (number + 2**31) % 2**32 - 2**31
    if not 0 <= number <= MAX_DOMAIN:
        raise UnreadableError(
            f"<{node.tag}> holds {number}, which is not between 0 and {MAX_DOMAIN}"
        )
    return number


def _read_flag(node: _Node) -> bool:
    word = node.text.lower()
    if word not in ("", "true", "false", "0", "1"):
        raise UnreadableError(f"<{node.tag}> holds {node.text!r} instead of true or false")
    return word in ("true", "1")


def _read_value(node: _Node, attribute: Attribute) -> Value:
    if attribute.is_flag:
        return _read_flag(node)
    if node.text and node.text not in attribute.values:
        raise UnreadableError(
            f"<{node.tag}> holds {node.text!r}, which is not one of its protection kinds"
        )
    # For a kind without text, Cyclone DDS uses 0, which stands for the strongest kind.
    return ProtectionKind(node.text or str(attribute.values[-1]))


def _read_domains(node: _Node | None) -> DomainSet:
    if node is None:
        return DomainSet((DomainRange(None, None),))
    ranges = []
    for child in node.all("id", "id_range"):
        if child.tag == "id":
            number = _read_number(child)
            ranges.append(DomainRange(number, number))
            continue
        ends = [child.last("min"), child.last("max")]
        first, last = (None if end is None else _read_number(end) for end in ends)
        ranges.append(DomainRange(first, last))
    return DomainSet(tuple(ranges))


# ── governance ─────────────────────────────────────────────────────────────────────────────


def _read_domain_rule(node: _Node) -> DomainRule:
    domains, topics = node.last("domains"), node.last("topic_access_rules")
    if domains is None:
        raise UnreadableError("a <domain_rule> lacks its <domains>")
    read = _read_domains(domains)
    if not read.ranges:
        raise UnreadableError("<domains> is empty")
    for part in read.ranges:
        if part.first is None:
            raise UnreadableError("an <id_range> lacks its <min>")
        if part.last is not None and part.last < part.first:
            raise UnreadableError("an <id_range> has a <max> below its <min>")
    rules = topics.all("topic_rule") if topics else []
    if not rules:
        raise UnreadableError("a <domain_rule> has no topic rules")
    return DomainRule(
        domains=read,
        topic_access_rules=tuple(_read_topic_rule(rule) for rule in rules),
        **_read_values(node, DomainRule),
    )


def _read_topic_rule(node: _Node) -> TopicRule:
    expression = node.last("topic_expression")
    return TopicRule(
        topic_expression=expression.text if expression else "", **_read_values(node, TopicRule)
    )


def _read_values(node: _Node, rule: type[DomainRule | TopicRule]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for attribute in attributes(rule):
        child = node.last(attribute.name)
        if child is None and attribute.default is None:
            raise UnreadableError(f"a <{node.tag}> lacks its <{attribute.name}>")
        values[attribute.name] = (
            attribute.default if child is None else _read_value(child, attribute)
        )
    return values


# ── permissions ────────────────────────────────────────────────────────────────────────────


def _read_grant(node: _Node) -> Grant:
    subject, validity = node.last("subject_name"), node.last("validity")
    begin = validity.last("not_before") if validity else None
    end = validity.last("not_after") if validity else None
    if not (subject and subject.text and begin and begin.text and end and end.text):
        raise UnreadableError("a <grant> lacks its <subject_name> or its <validity>")
    rules = tuple(_read_rule(child) for child in node.all("allow_rule", "deny_rule"))
    default = node.last("default")
    word = None if default is None else default.text
    return Grant(
        name=node.attribute or "",
        subject=subject.text,
        not_before=begin.text,
        not_after=end.text,
        rules=rules,
        default_allow=word == "ALLOW",
        default_empty=word == "",
    )


def _read_rule(node: _Node) -> Rule:
    publish, subscribe = (
        tuple(_read_criteria(child) for child in node.all(verb))
        for verb in ("publish", "subscribe")
    )
    order = tuple(child.tag for child in node.all("publish", "subscribe"))
    return Rule(
        node.tag == "allow_rule",
        _read_domains(node.last("domains")),
        publish,
        subscribe,
        order=() if order == tuple(sorted(order)) else order,
    )


def _read_criteria(node: _Node) -> Criteria:
    topics, partitions = node.last("topics"), node.last("partitions")
    return Criteria(
        tuple(topic.text for topic in topics.all("topic")) if topics else (),
        # An empty list of partitions matches no partition, not even the default partition.
        tuple(partition.text for partition in partitions.all("partition")) or (_MATCHES_NOTHING,)
        if partitions
        else (),
    )
