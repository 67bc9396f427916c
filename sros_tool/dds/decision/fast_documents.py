"""How Fast DDS reads signed documents (its GovernanceParser and PermissionsParser over TinyXML-2).

The order of elements is compulsory, texts keep their blanks, and words are written in one way.
What stands behind the last element that it looks for goes unread.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TypeVar

from lxml import etree

from sros_tool.dds.decision.answers import Outcome
from sros_tool.dds.decision.elements import UnreadableError, elements_of, name_of, root_of
from sros_tool.dds.domains import DomainRange, DomainSet
from sros_tool.dds.governance import (
    DATA_PROTECTIONS,
    DomainRule,
    Governance,
    Protection,
    TopicRule,
)
from sros_tool.dds.permissions import Criteria, Grant, Permissions, Rule

_INTEGER = re.compile(r"\s*(?:0[xX]([0-9a-fA-F]+)|([+-]?\d+))", re.ASCII)
_TRUE, _FALSE = ("true", "True", "TRUE"), ("false", "False", "FALSE")
Read = TypeVar("Read")


def read_governance(xml: bytes) -> Governance:
    """Its governance; raises `UnreadableError`."""
    parent = _top(xml, "domain_access_rules")
    if parent.getnext() is not None or (parent.tail or "").strip():
        # A comment counts as well.
        raise UnreadableError("something stands behind <domain_access_rules>")
    return Governance(tuple(_domain_rule(each) for each in _all(parent, "domain_rule")))


def read_permissions(xml: bytes) -> Permissions:
    """Its permissions; raises `UnreadableError`."""
    return Permissions(tuple(_grant(each) for each in _all(_top(xml, "permissions"), "grant")))


def _top(xml: bytes, name: str) -> etree._Element:
    root = root_of(xml)
    if name_of(root) != "dds":
        raise UnreadableError("its root is not <dds>")
    children = elements_of(root)
    if not children:
        outcome = Outcome.CRASHES if name == "permissions" else Outcome.REFUSED
        raise UnreadableError("<dds> is empty", outcome)
    if name_of(children[0]) != name:
        raise UnreadableError(f"<dds> does not begin with <{name}>")
    return children[0]


def _all(parent: etree._Element, name: str) -> list[etree._Element]:
    """The children, all of one name, at least one."""
    children = elements_of(parent)
    if not children or any(name_of(child) != name for child in children):
        raise UnreadableError(f"<{name_of(parent)}> needs <{name}> elements and nothing else")
    return children


class _Sequence:
    """The child elements of one, taken in order."""

    def __init__(self, element: etree._Element) -> None:
        self._name = name_of(element)
        self._children = elements_of(element)
        self._index = 0

    def next(self, name: str) -> etree._Element:
        """The next child, which must have this name."""
        if self._index == len(self._children) or name_of(self._children[self._index]) != name:
            raise UnreadableError(f"<{self._name}> lacks <{name}> in its place")
        self._index += 1
        return self._children[self._index - 1]

    def rest(self) -> list[etree._Element]:
        """The children not taken yet."""
        return self._children[self._index :]

    def while_named(self, *names: str) -> list[etree._Element]:
        """The children up to the first that has none of these names."""
        found = []
        while self._index < len(self._children):
            if name_of(self._children[self._index]) not in names:
                break
            found.append(self._children[self._index])
            self._index += 1
        return found

    def end(self) -> None:
        """Nothing may follow."""
        if self.rest():
            raise UnreadableError(f"<{self._name}> holds too much: <{name_of(self.rest()[0])}>")


# ── texts ──────────────────────────────────────────────────────────────────────────────────


def _text(element: etree._Element) -> str | None:
    """The text before the first child element or inner comment; None if there are only blanks."""
    if element.text and element.text.strip():
        return element.text
    for child in element:
        if not isinstance(child, etree._Comment):
            return None
        if child.tail and child.tail.strip():
            return child.tail
    return None


def _required(element: etree._Element) -> str:
    text = _text(element)
    if text is None:
        raise UnreadableError(f"<{name_of(element)}> is empty")
    return text


def _number(element: etree._Element) -> int:
    found = _INTEGER.match(_required(element))
    if not found:
        raise UnreadableError(f"<{name_of(element)}> holds no number")
    return (int(found[1], 16) if found[1] else int(found[2])) % 2**32


def _flag(element: etree._Element) -> bool:
    text = _required(element)
    if found := _INTEGER.match(text):
        return int(found[1], 16) != 0 if found[1] else int(found[2]) != 0
    if text not in _TRUE + _FALSE:
        raise UnreadableError(f"<{name_of(element)}> holds {text!r} instead of true or false")
    return text in _TRUE


def _kind(element: etree._Element) -> Protection:
    text = _required(element)
    if text not in list(Protection):
        raise UnreadableError(f"<{name_of(element)}> holds {text!r}, which is no protection kind")
    return Protection(text)


def _data_kind(element: etree._Element) -> Protection:
    kind = _kind(element)
    if kind not in DATA_PROTECTIONS:
        raise UnreadableError(f"<{name_of(element)}> holds {kind}, which is for metadata only")
    return kind


def _domains(element: etree._Element) -> DomainSet:
    ranges = []
    for child in elements_of(element):
        match name_of(child):
            case "id":
                number = _number(child)
                ranges.append(DomainRange(number, number))
            case "id_range":
                ranges.append(_range(child))
            case other:
                raise UnreadableError(f"<domains> holds <{other}>")
    if not ranges:
        raise UnreadableError("<domains> is empty")
    return DomainSet(tuple(ranges))


def _range(element: etree._Element) -> DomainRange:
    ends = elements_of(element)
    if ends and name_of(ends[0]) == "max":
        return DomainRange(None, _number(ends[0]))
    if not ends or name_of(ends[0]) != "min":
        raise UnreadableError("<id_range> begins with neither <min> nor <max>")
    first = _number(ends[0])
    bounded = len(ends) > 1 and name_of(ends[1]) == "max"
    return DomainRange(first, _number(ends[1]) if bounded else None)


# ── governance ─────────────────────────────────────────────────────────────────────────────


def _domain_rule(element: etree._Element) -> DomainRule:
    take = _Sequence(element)

    def field(name: str, read: Callable[[etree._Element], Read]) -> Read:
        return read(take.next(name))

    rule = DomainRule(
        domains=field("domains", _domains),
        allow_unauthenticated_participants=field("allow_unauthenticated_participants", _flag),
        enable_join_access_control=field("enable_join_access_control", _flag),
        discovery_protection_kind=field("discovery_protection_kind", _kind),
        liveliness_protection_kind=field("liveliness_protection_kind", _kind),
        rtps_protection_kind=field("rtps_protection_kind", _kind),
        topic_access_rules=field(
            "topic_access_rules", lambda each: tuple(map(_topic_rule, _all(each, "topic_rule")))
        ),
    )
    take.end()
    return rule


def _topic_rule(element: etree._Element) -> TopicRule:
    take = _Sequence(element)
    expression = _text(take.next("topic_expression"))
    if expression is None:
        raise UnreadableError("<topic_expression> is empty", Outcome.CRASHES)

    def field(name: str, read: Callable[[etree._Element], Read]) -> Read:
        return read(take.next(name))

    rule = TopicRule(
        topic_expression=expression,
        enable_discovery_protection=field("enable_discovery_protection", _flag),
        enable_liveliness_protection=field("enable_liveliness_protection", _flag),
        enable_read_access_control=field("enable_read_access_control", _flag),
        enable_write_access_control=field("enable_write_access_control", _flag),
        metadata_protection_kind=field("metadata_protection_kind", _kind),
        data_protection_kind=field("data_protection_kind", _data_kind),
    )
    take.end()
    return rule


# ── permissions ────────────────────────────────────────────────────────────────────────────


def _grant(element: etree._Element) -> Grant:
    name = element.get("name")
    if name is None:
        raise UnreadableError("a <grant> has no name")
    take = _Sequence(element)
    subject = _required(take.next("subject_name"))
    not_before, not_after = _validity(take.next("validity"))
    rules = tuple(_rule(each) for each in take.while_named("allow_rule", "deny_rule"))
    default = _required(take.next("default"))
    if default not in ("ALLOW", "DENY"):
        raise UnreadableError(f"<default> holds {default!r}")
    return Grant(name, subject, not_before, not_after, rules, default == "ALLOW")


def _validity(element: etree._Element) -> tuple[str, str]:
    take = _Sequence(element)
    begin = _required(take.next("not_before"))
    end = _text(take.next("not_after"))
    if end is None:
        raise UnreadableError("<not_after> is empty", Outcome.CRASHES)
    return begin, end


def _rule(element: etree._Element) -> Rule:
    take = _Sequence(element)
    domains = _domains(take.next("domains"))
    verbs: dict[str, list[Criteria]] = {"publish": [], "subscribe": [], "relay": []}
    for child in take.while_named(*verbs):
        verbs[name_of(child)].append(_criteria(child))
    take.end()
    return Rule(
        name_of(element) == "allow_rule",
        domains,
        tuple(verbs["publish"]),
        tuple(verbs["subscribe"]),
        tuple(verbs["relay"]),
    )


def _criteria(element: etree._Element) -> Criteria:
    topics: list[str] = []
    partitions: list[str] = []
    for child in elements_of(element):
        match name_of(child):
            case "topics":
                topics += [_required(each) for each in _all(child, "topic")]
            case "partitions":
                partitions += [_partition(each) for each in _all(child, "partition")]
            case "data_tags":
                pass
            case other:
                raise UnreadableError(f"<{name_of(element)}> holds <{other}>")
    return Criteria(tuple(topics), tuple(partitions))


def _partition(element: etree._Element) -> str:
    text = _text(element)
    if text is None and len(element):
        raise UnreadableError("<partition> holds something else than text")
    return text or ""
