"""Governance and permissions as Fast DDS reads them, with its parser TinyXML-2 9.

The parser accepts much that XML forbids: ``--`` in a comment, a lone ``&``, control characters,
``]]>`` in a text, a second root.  The parser works on bytes, and ignores declared encodings,
namespaces and entities.

Fast DDS demands the elements in order, keeps blanks in texts, accepts only one spelling of a
keyword, and ignores content after the last expected element.
"""

from __future__ import annotations

import re
from typing import Any

from sros_tool.dds.decision.elements import NodeMark, UnreadableError, XmlElement, decoded
from sros_tool.dds.domains import DomainRange, DomainSet
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

_BLANKS = " \t\n\v\f\r"
_BYTE_ORDER_MARK = "\xef\xbb\xbf"
_DEEPEST = 99  # nesting of elements
_NAME = "[A-Za-z_:\x80-\xff][A-Za-z0-9_:.\x80-\xff-]*+"
_VALUE = "(?:\"[^\"]*\"|'[^']*')"
_ATTRIBUTE = f"({_NAME})[{_BLANKS}]*=[{_BLANKS}]*({_VALUE})"
_TAG = re.compile(f"<[{_BLANKS}]*(/?)({_NAME})((?:[{_BLANKS}]*{_ATTRIBUTE})*+)[{_BLANKS}]*(/?)>")
_ATTRIBUTES = re.compile(_ATTRIBUTE)
_TEXT = re.compile(f"[{_BLANKS}]*([^<]*)<")
_LINE_END = re.compile("\r\n?|\n\r?")
_SPECIAL = (("<?", "?>"), ("<!--", "-->"), ("<![CDATA[", "]]>"), ("<!", ">"))
_ENTITIES = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}
_REFERENCE = re.compile("&(?:#x?([^;]*)|(quot|amp|apos|lt|gt));")


def read(xml: bytes) -> XmlElement:
    """Return the first element of a document; raise `UnreadableError` if TinyXML-2 refuses it.

    A text is decoded as UTF-8; invalid bytes become surrogates.
    """
    return _Reader(xml).root()


class _Reader:
    def __init__(self, xml: bytes) -> None:
        # Signed documents have CR LF line ends; each character stands for one byte.
        canonical = xml.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n").decode("latin-1")
        self._read_text = (
            canonical.partition("\0")[0].lstrip(_BLANKS).removeprefix(_BYTE_ORDER_MARK)
        )
        self._index = 0

    def root(self) -> XmlElement:
        document = XmlElement("")
        if not self._read_text:
            raise self._error("it is empty")
        self._read_into(document)
        if not document.elements:
            raise self._error("it has no element")
        return document.elements[0]

    def _error(self, why: str) -> UnreadableError:
        line = self._read_text.count("\r\n", 0, self._index) + 1
        return UnreadableError(f"its XML is malformed: {why} (line {line})")

    def _read_into(self, document: XmlElement) -> None:
        text = self._read_text
        stack = [document]
        while match := _TEXT.match(text, self._index):
            children = stack[-1].children
            if match[1]:
                self._need_more(match.end())
                children.append(_plain(match[0][:-1]))
            self._index = match.end() - 1
            if text[match.end() : match.end() + 1] in ("?", "!"):
                self._take_special(stack)
                continue
            tag = _TAG.match(text, self._index)
            if not tag:
                raise self._error("a tag is malformed")
            self._index = tag.end()
            closing, name, closed = tag[1], tag[2], tag[6]
            if closing and not closed:
                if len(stack) == 1:
                    return  # TinyXML-2 reads nothing after the root
                if stack.pop().name != decoded(name):
                    raise self._error(f"</{name}> closes another element")
                continue
            element = XmlElement(decoded(name), self._attributes(tag[3]) if tag[3] else {})
            children.append(element)
            if not closed:
                stack.append(element)
                if len(stack) > _DEEPEST:
                    raise self._error("its elements are nested too deeply")
        if len(stack) > 1:
            raise self._error(f"<{stack[-1].name}> is not closed")
        if text[self._index :].strip(_BLANKS):
            raise self._error("it ends with text")

    def _need_more(self, index: int) -> None:
        if index >= len(self._read_text):
            raise self._error("it ends with <")

    def _take_special(self, stack: list[XmlElement]) -> None:
        """Read a declaration, a comment, CDATA, or anything else after ``<?`` or ``<!``."""
        text, children = self._read_text, stack[-1].children
        begin, end = next(marks for marks in _SPECIAL if text.startswith(marks[0], self._index))
        start = self._index + len(begin)
        stop = text.find(end, start)
        if stop < 0:
            raise self._error(f"{begin} is not closed")
        self._index = stop + len(end)
        if begin == "<?":
            if len(stack) > 1 or any(child is not NodeMark.DECLARATION for child in children):
                raise self._error("a processing instruction follows the prolog")
            children.append(NodeMark.DECLARATION)
        elif begin == "<![CDATA[":
            children.append(decoded(_LINE_END.sub("\n", text[start:stop])))
        else:
            children.append(NodeMark.COMMENT if begin == "<!--" else NodeMark.OTHER)

    def _attributes(self, text: str) -> dict[str, str]:
        attributes = {}
        for name, value in _ATTRIBUTES.findall(text):
            if name in attributes:
                raise self._error(f"the attribute {name} is given twice")
            attributes[name] = _plain(value[1:-1])
        return {decoded(name): value for name, value in attributes.items()}


def _plain(text: str) -> str:
    """Return the text before the first NUL, with normalized line ends and resolved references."""
    if "&" not in text:
        return decoded(_LINE_END.sub("\n", text) if "\r" in text or "\n" in text else text)
    # TinyXML-2 overwrites the text in place: for a lone "&" it writes nothing, so the character
    # that was at that position stays.
    written = list(text)
    place = index = 0
    while index < len(text):
        taken, into = text[index], text[index]
        if taken in "\r\n":
            taken, into = _LINE_END.match(text, index)[0], "\n"  # type: ignore[index]
        elif taken == "&":
            match = _REFERENCE.match(text, index)
            character = _referenced_character(match) if match else None
            if match and character is not None:
                taken, into = match[0], character
            elif text[index + 1 :] == "#":
                into = ""
            elif text[index + 1 : index + 2] != "#":
                into = written[place]
        written[place : place + len(into)] = into
        place += len(into)
        index += len(taken)
    return decoded("".join(written[:place]).partition("\0")[0])


def _referenced_character(match: re.Match[str]) -> str | None:
    """Return the character of a reference such as ``&amp;``; None for a malformed reference."""
    if match[2]:
        return _ENTITIES[match[2]]
    # TinyXML-2 reads the digits backwards, from the last one to the mark before them.
    base, mark = (16, "x") if match[0][2] == "x" else (10, "#")
    digits = match[1].rpartition(mark)[2]
    if not re.fullmatch("[0-9a-fA-F]*" if base == 16 else "[0-9]*", digits):
        return None
    # 30 digits are as far too large as more digits.
    return _utf8(int(digits.lstrip("0")[:30] or "0", base))


def _utf8(number: int) -> str:
    if number < 0x80:
        return chr(number)
    for length, limit, head in ((2, 0x800, 0xC0), (3, 0x10000, 0xE0), (4, 0x200000, 0xF0)):
        if number < limit:
            rest = [0x80 | number >> 6 * place & 0x3F for place in range(length - 1)]
            return "".join(map(chr, [head | number >> 6 * (length - 1), *reversed(rest)]))
    return ""


_INTEGER = re.compile(r"\s*(?:0[xX]([0-9a-fA-F]+)|([+-]?\d+))", re.ASCII)
_TRUE, _FALSE = ("true", "True", "TRUE"), ("false", "False", "FALSE")


def read_governance(xml: bytes) -> Governance:
    """Return the governance in ``xml``; raise `UnreadableError` if Fast DDS refuses it."""
    root = read(xml)
    parent = _first_child(root, "domain_access_rules")
    if root.children[-1] is not parent:
        # Even a comment there is refused.
        raise UnreadableError("something follows <domain_access_rules>")
    return Governance(
        tuple(_read_domain_rule(element) for element in _children_named(parent, "domain_rule"))
    )


def read_permissions(xml: bytes) -> Permissions:
    """Return the permissions in ``xml``; raise `UnreadableError` if Fast DDS refuses them."""
    return Permissions(
        tuple(
            _read_grant(element)
            for element in _children_named(_first_child(read(xml), "permissions"), "grant")
        )
    )


def _first_child(root: XmlElement, name: str) -> XmlElement:
    if root.name != "dds":
        raise UnreadableError("its root is not <dds>")
    children = root.elements
    if not children:
        raise UnreadableError("<dds> is empty", missing=name == "permissions")
    if children[0].name != name:
        raise UnreadableError(f"<dds> does not begin with <{name}>")
    return children[0]


def _children_named(parent: XmlElement, name: str) -> list[XmlElement]:
    """Return the children of ``parent``, all of which must be named ``name``.

    Raises:
        UnreadableError: there are no children, or a child has another name.
    """
    children = parent.elements
    if not children or any(child.name != name for child in children):
        raise UnreadableError(f"<{parent.name}> needs <{name}> elements and nothing else")
    return children


class _Sequence:
    """The child elements of an element, to be read in order."""

    def __init__(self, element: XmlElement) -> None:
        self._name = element.name
        self._children = element.elements
        self._index = 0

    def is_next(self, name: str) -> bool:
        """Return whether the next child has this name."""
        return self._index < len(self._children) and self._children[self._index].name == name

    def next(self, name: str) -> XmlElement:
        """Return the next child and advance; raise `UnreadableError` if it has another name."""
        if not self.is_next(name):
            if rest := self.rest():
                raise UnreadableError(
                    f"<{self._name}> has <{rest[0].name}> where <{name}> is expected"
                )
            raise UnreadableError(f"<{self._name}> lacks <{name}> at its end")
        self._index += 1
        return self._children[self._index - 1]

    def rest(self) -> list[XmlElement]:
        """Return the children that were not read yet, without advancing."""
        return self._children[self._index :]

    def while_named(self, *names: str) -> list[XmlElement]:
        """Return the next children while their names are in ``names``, and advance past them."""
        elements = []
        while self._index < len(self._children):
            if self._children[self._index].name not in names:
                break
            elements.append(self._children[self._index])
            self._index += 1
        return elements

    def end(self) -> None:
        """Raise `UnreadableError` if there is another child."""
        if self.rest():
            raise UnreadableError(f"<{self._name}> contains an unexpected <{self.rest()[0].name}>")


# ── texts ──────────────────────────────────────────────────────────────────────────────────


def _read_text(element: XmlElement) -> str | None:
    """Return the first node of an element apart from comments; None if that node is not text."""
    for child in element.children:
        if child is not NodeMark.COMMENT:
            return child if isinstance(child, str) else None
    return None


def _read_required_text(element: XmlElement) -> str:
    text = _read_text(element)
    if text is None:
        raise UnreadableError(f"<{element.name}> is empty")
    return text


def _read_first_text(element: XmlElement) -> str:
    """Return the text of a number or flag; the text must be the first node of the element.

    Raises:
        UnreadableError: the first node is not text, but for instance a comment.
    """
    first = element.children[0] if element.children else None
    if not isinstance(first, str):
        raise UnreadableError(f"<{element.name}> does not begin with its value")
    return first


def _read_number(element: XmlElement) -> int:
    match = _INTEGER.match(_read_first_text(element))
    if not match:
        raise UnreadableError(f"<{element.name}> does not hold a number")
    return _integer(match) % 2**32


def _integer(match: re.Match[str]) -> int:
    """Return a number as sscanf reads it: too large numbers become the largest 64-bit number."""
    if match[1]:
        return min(int(match[1], 16), 2**64 - 1)
    digits = match[2].lstrip("+-").lstrip("0")
    number = int(digits or "0") if len(digits) <= 20 else 2**64
    return min(number, 2**64 - 1) if match[2][0] != "-" or number >= 2**64 else -number


def _read_flag(element: XmlElement) -> bool:
    text = _read_first_text(element)
    if match := _INTEGER.match(text):
        return _integer(match) != 0
    if text not in _TRUE + _FALSE:
        raise UnreadableError(f"<{element.name}> holds {text!r} instead of true or false")
    return text in _TRUE


def _read_value(element: XmlElement, attribute: Attribute) -> Value:
    if attribute.is_flag:
        return _read_flag(element)
    text = _read_required_text(element)
    if text not in list(ProtectionKind):
        raise UnreadableError(f"<{element.name}> holds {text!r}, which is not a protection kind")
    if text not in attribute.values:
        raise UnreadableError(
            f"<{element.name}> holds {text}, but payloads cannot have origin authentication"
        )
    return ProtectionKind(text)


def _read_domains(element: XmlElement) -> DomainSet:
    ranges = []
    for child in element.elements:
        match child.name:
            case "id":
                number = _read_number(child)
                ranges.append(DomainRange(number, number))
            case "id_range":
                ranges.append(_read_range(child))
            case other:
                raise UnreadableError(f"<domains> holds an unexpected <{other}>")
    if not ranges:
        raise UnreadableError("<domains> is empty")
    return DomainSet(tuple(ranges))


def _read_range(element: XmlElement) -> DomainRange:
    limits = element.elements
    if limits and limits[0].name == "max":
        return DomainRange(None, _read_number(limits[0]))
    if not limits or limits[0].name != "min":
        raise UnreadableError("<id_range> begins with neither <min> nor <max>")
    first = _read_number(limits[0])
    bounded = len(limits) > 1 and limits[1].name == "max"
    return DomainRange(first, _read_number(limits[1]) if bounded else None)


# ── governance ─────────────────────────────────────────────────────────────────────────────


def _read_domain_rule(element: XmlElement) -> DomainRule:
    take = _Sequence(element)
    domains = _read_domains(take.next("domains"))
    values = _values(take, DomainRule)
    rules = tuple(
        map(_read_topic_rule, _children_named(take.next("topic_access_rules"), "topic_rule"))
    )
    take.end()
    return DomainRule(domains=domains, topic_access_rules=rules, **values)


def _read_topic_rule(element: XmlElement) -> TopicRule:
    take = _Sequence(element)
    expression = _read_text(take.next("topic_expression"))
    if expression is None:
        raise UnreadableError("<topic_expression> is empty", missing=True)
    rule = TopicRule(topic_expression=expression, **_values(take, TopicRule))
    take.end()
    return rule


def _values(sequence: _Sequence, rule: type[DomainRule | TopicRule]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for attribute in attributes(rule):
        left_out = attribute.default is not None and not sequence.is_next(attribute.name)
        values[attribute.name] = (
            attribute.default if left_out else _read_value(sequence.next(attribute.name), attribute)
        )
    return values


# ── permissions ────────────────────────────────────────────────────────────────────────────


def _read_grant(element: XmlElement) -> Grant:
    name = element.attributes.get("name")
    if name is None:
        raise UnreadableError("a <grant> has no name")
    take = _Sequence(element)
    subject = _read_required_text(take.next("subject_name"))
    not_before, not_after = _read_validity(take.next("validity"))
    rules = tuple(
        _read_rule(xml_element) for xml_element in take.while_named("allow_rule", "deny_rule")
    )
    default = _read_required_text(take.next("default"))
    if default not in ("ALLOW", "DENY"):
        raise UnreadableError(f"<default> holds {default!r} instead of ALLOW or DENY")
    return Grant(name, subject, not_before, not_after, rules, default == "ALLOW")


def _read_validity(element: XmlElement) -> tuple[str, str]:
    take = _Sequence(element)
    begin = _read_required_text(take.next("not_before"))
    end = _read_text(take.next("not_after"))
    if end is None:
        raise UnreadableError("<not_after> is empty", missing=True)
    return begin, end


def _read_rule(element: XmlElement) -> Rule:
    take = _Sequence(element)
    domains = _read_domains(take.next("domains"))
    verbs: dict[str, list[Criteria]] = {"publish": [], "subscribe": [], "relay": []}
    for child in take.while_named(*verbs):
        verbs[child.name].append(_read_criteria(child))
    take.end()
    return Rule(
        element.name == "allow_rule",
        domains,
        tuple(verbs["publish"]),
        tuple(verbs["subscribe"]),
        tuple(verbs["relay"]),
    )


def _read_criteria(element: XmlElement) -> Criteria:
    topics: list[str] = []
    partitions: list[str] = []
    for child in element.elements:
        match child.name:
            case "topics":
                topics += [
                    _read_required_text(xml_element)
                    for xml_element in _children_named(child, "topic")
                ]
            case "partitions":
                partitions += [
                    _read_partition(xml_element)
                    for xml_element in _children_named(child, "partition")
                ]
            case "data_tags":
                pass
            case other:
                raise UnreadableError(f"<{element.name}> holds an unexpected <{other}>")
    return Criteria(tuple(topics), tuple(partitions))


def _read_partition(element: XmlElement) -> str:
    text = _read_text(element)
    if text is None and element.children:
        raise UnreadableError("<partition> holds something other than text")
    return text or ""
