"""How Fast DDS reads signed documents (its GovernanceParser and PermissionsParser).

The order of elements is compulsory, texts keep their blanks, and words are written in one way.
What stands behind the last element that it looks for goes unread.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TypeVar

from sros_tool.dds.decision import tinyxml
from sros_tool.dds.decision.answers import Outcome
from sros_tool.dds.decision.elements import Element, Mark, UnreadableError
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
    root = tinyxml.read(xml)
    parent = _first(root, "domain_access_rules")
    if root.children[-1] is not parent:
        # A comment counts as well.
        raise UnreadableError("something stands behind <domain_access_rules>")
    return Governance(tuple(_domain_rule(each) for each in _all(parent, "domain_rule")))


def read_permissions(xml: bytes) -> Permissions:
    """Its permissions; raises `UnreadableError`."""
    return Permissions(
        tuple(_grant(each) for each in _all(_first(tinyxml.read(xml), "permissions"), "grant"))
    )


def _first(root: Element, name: str) -> Element:
    if root.name != "dds":
        raise UnreadableError("its root is not <dds>")
    children = root.elements
    if not children:
        outcome = Outcome.CRASHES if name == "permissions" else Outcome.REFUSED
        raise UnreadableError("<dds> is empty", outcome)
    if children[0].name != name:
        raise UnreadableError(f"<dds> does not begin with <{name}>")
    return children[0]


def _all(parent: Element, name: str) -> list[Element]:
    """The children, all of one name, at least one."""
    children = parent.elements
    if not children or any(child.name != name for child in children):
        raise UnreadableError(f"<{parent.name}> needs <{name}> elements and nothing else")
    return children


class _Sequence:
    """The child elements of one, taken in order."""

    def __init__(self, element: Element) -> None:
        self._name = element.name
        self._children = element.elements
        self._index = 0

    def next(self, name: str) -> Element:
        """The next child, which must have this name."""
        if self._index == len(self._children) or self._children[self._index].name != name:
            raise UnreadableError(f"<{self._name}> lacks <{name}> in its place")
        self._index += 1
        return self._children[self._index - 1]

    def rest(self) -> list[Element]:
        """The children not taken yet."""
        return self._children[self._index :]

    def while_named(self, *names: str) -> list[Element]:
        """The children up to the first that has none of these names."""
        found = []
        while self._index < len(self._children):
            if self._children[self._index].name not in names:
                break
            found.append(self._children[self._index])
            self._index += 1
        return found

    def end(self) -> None:
        """Nothing may follow."""
        if self.rest():
            raise UnreadableError(f"<{self._name}> holds too much: <{self.rest()[0].name}>")


# ── texts ──────────────────────────────────────────────────────────────────────────────────


def _text(element: Element) -> str | None:
    """The text that stands first, comments aside; None if something else does, or nothing."""
    for child in element.children:
        if child is not Mark.COMMENT:
            return child if isinstance(child, str) else None
    return None


def _required(element: Element) -> str:
    text = _text(element)
    if text is None:
        raise UnreadableError(f"<{element.name}> is empty")
    return text


def _first_text(element: Element) -> str:
    """The text of a number or a flag, before which not even a comment may stand."""
    first = element.children[0] if element.children else None
    if not isinstance(first, str):
        raise UnreadableError(f"<{element.name}> does not begin with its value")
    return first


def _number(element: Element) -> int:
    found = _INTEGER.match(_first_text(element))
    if not found:
        raise UnreadableError(f"<{element.name}> holds no number")
    return (int(found[1], 16) if found[1] else int(found[2])) % 2**32


def _flag(element: Element) -> bool:
    text = _first_text(element)
    if found := _INTEGER.match(text):
        return int(found[1], 16) != 0 if found[1] else int(found[2]) != 0
    if text not in _TRUE + _FALSE:
        raise UnreadableError(f"<{element.name}> holds {text!r} instead of true or false")
    return text in _TRUE


def _kind(element: Element) -> Protection:
    text = _required(element)
    if text not in list(Protection):
        raise UnreadableError(f"<{element.name}> holds {text!r}, which is no protection kind")
    return Protection(text)


def _data_kind(element: Element) -> Protection:
    kind = _kind(element)
    if kind not in DATA_PROTECTIONS:
        raise UnreadableError(f"<{element.name}> holds {kind}, which is for metadata only")
    return kind


def _domains(element: Element) -> DomainSet:
    ranges = []
    for child in element.elements:
        match child.name:
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


def _range(element: Element) -> DomainRange:
    ends = element.elements
    if ends and ends[0].name == "max":
        return DomainRange(None, _number(ends[0]))
    if not ends or ends[0].name != "min":
        raise UnreadableError("<id_range> begins with neither <min> nor <max>")
    first = _number(ends[0])
    bounded = len(ends) > 1 and ends[1].name == "max"
    return DomainRange(first, _number(ends[1]) if bounded else None)


# ── governance ─────────────────────────────────────────────────────────────────────────────


def _domain_rule(element: Element) -> DomainRule:
    take = _Sequence(element)

    def field(name: str, read: Callable[[Element], Read]) -> Read:
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


def _topic_rule(element: Element) -> TopicRule:
    take = _Sequence(element)
    expression = _text(take.next("topic_expression"))
    if expression is None:
        raise UnreadableError("<topic_expression> is empty", Outcome.CRASHES)

    def field(name: str, read: Callable[[Element], Read]) -> Read:
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


def _grant(element: Element) -> Grant:
    name = element.attributes.get("name")
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


def _validity(element: Element) -> tuple[str, str]:
    take = _Sequence(element)
    begin = _required(take.next("not_before"))
    end = _text(take.next("not_after"))
    if end is None:
        raise UnreadableError("<not_after> is empty", Outcome.CRASHES)
    return begin, end


def _rule(element: Element) -> Rule:
    take = _Sequence(element)
    domains = _domains(take.next("domains"))
    verbs: dict[str, list[Criteria]] = {"publish": [], "subscribe": [], "relay": []}
    for child in take.while_named(*verbs):
        verbs[child.name].append(_criteria(child))
    take.end()
    return Rule(
        element.name == "allow_rule",
        domains,
        tuple(verbs["publish"]),
        tuple(verbs["subscribe"]),
        tuple(verbs["relay"]),
    )


def _criteria(element: Element) -> Criteria:
    topics: list[str] = []
    partitions: list[str] = []
    for child in element.elements:
        match child.name:
            case "topics":
                topics += [_required(each) for each in _all(child, "topic")]
            case "partitions":
                partitions += [_partition(each) for each in _all(child, "partition")]
            case "data_tags":
                pass
            case other:
                raise UnreadableError(f"<{element.name}> holds <{other}>")
    return Criteria(tuple(topics), tuple(partitions))


def _partition(element: Element) -> str:
    text = _text(element)
    if text is None and element.children:
        raise UnreadableError("<partition> holds something else than text")
    return text or ""
