"""The permissions document of DDS Security: grants, rules, their XML, and its portable form.

Names follow the specification (DDS-Security 1.1, 9.4.1.3 and the schema
omg_shared_ca_permissions of 20170901).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import combinations
from typing import NamedTuple

from lxml import etree

from sros_tool.dds.domains import DomainRange, DomainSet
from sros_tool.errors import DocumentError, Note
from sros_tool.validity import Window, iso, parse_iso
from sros_tool.wording import first_few
from sros_tool.xml import escape, parse, quoted, require_child, tag_of

_SCHEMA = "http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_permissions.xsd"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
MAX_SIGNED_BYTES = 60 * 1024
"""Largest signed permissions, in bytes, with which handshakes of Fast DDS 2.6 and 2.9 finish.

A message of the handshake must fit into one UDP datagram of 64 KB, with the certificate, the
signature and the participant's data.  Tested with Fast DDS 2.9.1 on one network interface: with an
EC certificate of 0.6 KB, 63,129 bytes work and 63,189 do not; with an RSA certificate of 0.9 KB,
62,579 work and 62,854 do not.  The remaining bytes are room for longer certificates and more
interfaces.
"""
LARGE_BYTES = MAX_SIGNED_BYTES - 6 * 1024
"""Size in bytes from which an unsigned document is written as short as possible.

The difference to `MAX_SIGNED_BYTES` is room for the signature and its certificate.
"""
TOPIC_LINE_BYTES = len("            <topic></topic>\r\n")
"""Number of bytes that a topic adds to an indented signed document, without the topic's name."""


class Criteria(NamedTuple):
    """The topics and partitions of a ``<publish>`` or ``<subscribe>`` in a rule.

    Without partitions, the default partition is meant; in a deny rule, the vendor decides
    (`sros_tool.dds.decision.vendors.DenyPartitions`).  ``data_tags`` are pairs of name and value.
    """

    topics: tuple[str, ...]
    partitions: tuple[str, ...] = ()
    data_tags: tuple[tuple[str, str], ...] = ()


class Rule(NamedTuple):
    """An allow or deny rule for some domains."""

    allow: bool
    domains: DomainSet
    publish: tuple[Criteria, ...] = ()
    subscribe: tuple[Criteria, ...] = ()
    relay: tuple[Criteria, ...] = ()
    order: tuple[str, ...] = ()
    """The direction of each of the rule's criteria, in document order.

    If empty, the order is publish, subscribe, relay.
    """

    def criteria_of(self, directions: Sequence[str]) -> Iterator[tuple[str, Criteria]]:
        """Yield pairs of direction and criteria in document order, only for ``directions``."""
        criteria = {each: iter(getattr(self, each)) for each in directions}
        order = self.order or [each for each in directions for _ in getattr(self, each)]
        for direction in order:
            if direction in criteria:
                yield direction, next(criteria[direction])


class Grant(NamedTuple):
    """The rights and the validity of a subject; dates are written as in the document.

    ``default_allow`` says whether access is allowed if no rule matches.
    """

    name: str
    subject: str
    not_before: str
    not_after: str
    rules: tuple[Rule, ...]
    default_allow: bool = False
    default_empty: bool = False
    """Whether ``<default>`` is empty, which crashes Cyclone DDS."""
    default_first: bool = False
    """Whether ``<default>`` stands before a rule; Fast DDS then ignores the rules after it."""

    @property
    def validity(self) -> Window:
        """The validity of the grant by the standard: a date without a zone is in UTC.

        Raises:
            DocumentError: a date has a form that only some vendors read.
        """
        try:
            return Window(parse_iso(self.not_before), parse_iso(self.not_after))
        except ValueError as error:
            text = f"{self.not_before!r} or {self.not_after!r} is not an XML date and time"
            raise DocumentError(text) from error

    def domains(self) -> DomainSet:
        """Return the domains in which at least one rule allows something."""
        allowed = (rule.domains.closed() for rule in self.rules if rule.allow)
        return DomainSet.of(
            *(
                (part.first or 0, part.last or 0)
                for domain_set in allowed
                for part in domain_set.ranges
            )
        )


class Permissions(NamedTuple):
    """A permissions document."""

    grants: tuple[Grant, ...]

    def grant_of(self, subject: str) -> Grant | None:
        """Return the first grant for a subject, or None."""
        return next((grant for grant in self.grants if grant.subject == subject), None)


def grant(name: str, subject: str, validity: Window, rules: tuple[Rule, ...]) -> Grant:
    """Return a grant that all vendors read alike: dates in UTC, default DENY."""
    return Grant(name, subject, iso(validity.not_before), iso(validity.not_after), rules)


# ── writing ────────────────────────────────────────────────────────────────────────────────


def render_permissions(permissions: Permissions) -> bytes:
    """Return the document as XML in UTF-8, with its elements in the order of the schema.

    A document that would have `LARGE_BYTES` or more is not indented.
    """
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<dds xmlns:xsi="{XSI}" xsi:noNamespaceSchemaLocation="{_SCHEMA}">',
        "  <permissions>",
    ]
    for grant in permissions.grants:
        lines += [
            f"    <grant name={quoted(grant.name)}>",
            f"      <subject_name>{escape(grant.subject)}</subject_name>",
            "      <validity>",
            f"        <not_before>{escape(grant.not_before)}</not_before>",
            f"        <not_after>{escape(grant.not_after)}</not_after>",
            "      </validity>",
        ]
        for rule in grant.rules:
            _write_rule(lines, rule)
        default = "ALLOW" if grant.default_allow else "DENY"
        lines += [f"      <default>{default}</default>", "    </grant>"]
    lines += ["  </permissions>", "</dds>", ""]
    document = "\n".join(lines).encode()
    # Signing replaces each line feed by CR LF.
    if len(document) + document.count(b"\n") < LARGE_BYTES:
        return document
    return "\n".join([line.lstrip(" ") for line in lines]).encode()


def _write_rule(lines: list[str], rule: Rule) -> None:
    tag = "allow_rule" if rule.allow else "deny_rule"
    lines += [f"      <{tag}>", *(f"        {line}" for line in domain_lines(rule.domains))]
    for name, all_criteria in (
        ("publish", rule.publish),
        ("subscribe", rule.subscribe),
        ("relay", rule.relay),
    ):
        for criteria in all_criteria:
            lines.append(f"        <{name}>")
            _write_list(lines, "topic", criteria.topics)
            if criteria.partitions:
                _write_list(lines, "partition", criteria.partitions)
            if criteria.data_tags:
                lines.append("          <data_tags>")
                for key, value in criteria.data_tags:
                    lines.append(
                        f"            <tag><name>{escape(key)}</name>"
                        f"<value>{escape(value)}</value></tag>"
                    )
                lines.append("          </data_tags>")
            lines.append(f"        </{name}>")
    lines.append(f"      </{tag}>")


def _write_list(lines: list[str], item: str, texts: tuple[str, ...]) -> None:
    lines.append(f"          <{item}s>")
    lines += [f"            <{item}>{escape(text)}</{item}>" for text in texts]
    lines.append(f"          </{item}s>")


# ── reading ────────────────────────────────────────────────────────────────────────────────


def parse_permissions(data: bytes, name: str = "the permissions document") -> Permissions:
    """Return the permissions document in ``data``; ``name`` is its name in errors.

    Raises:
        DocumentError: ``data`` is not a permissions document.
    """
    root = parse(data, name, as_bytes=True)
    parent = require_child(root, "permissions", name, "permissions")
    try:
        return Permissions(tuple(_read_grant(child) for child in parent))
    except DocumentError as error:
        raise DocumentError(f"{name} is malformed", f"{error}.", error.remedy) from error


def _read_grant(element: etree._Element) -> Grant:
    if element.tag != "grant":
        raise DocumentError(f"<permissions> holds an unknown element <{tag_of(element)}>")
    subject = not_before = not_after = default = None
    rules = []
    default_first = False
    for child in element:
        match child.tag:
            case "subject_name":
                subject = child.text or ""
            case "validity":
                not_before, not_after = child.findtext("not_before"), child.findtext("not_after")
            case "allow_rule" | "deny_rule":
                rules.append(_read_rule(child))
                default_first = default is not None
            case "default":
                default = (child.text or "").strip()
            case _:
                raise DocumentError(f"<grant> holds an unknown element <{tag_of(child)}>")
    if subject is None or not_before is None or not_after is None:
        raise DocumentError("a <grant> lacks its <subject_name> or its <validity>")
    if default not in ("ALLOW", "DENY"):
        raise DocumentError("a <grant> lacks its <default> of ALLOW or DENY")
    for moment in (not_before, not_after):
        try:
            parse_iso(moment)
        except ValueError as error:
            raise DocumentError(f"{moment!r} is not an XML date and time") from error
    return Grant(
        element.get("name", ""),
        subject,
        not_before,
        not_after,
        tuple(rules),
        default == "ALLOW",
        default_first=default_first,
    )


def _read_rule(element: etree._Element) -> Rule:
    domains = None
    criteria: dict[str, list[Criteria]] = {"publish": [], "subscribe": [], "relay": []}
    for child in element:
        if child.tag == "domains":
            domains = read_domains(child)
        elif child.tag in criteria:
            criteria[tag_of(child)].append(_read_criteria(child))
        else:
            raise DocumentError(f"<{tag_of(element)}> holds an unknown element <{tag_of(child)}>")
    if domains is None:
        raise DocumentError(f"<{tag_of(element)}> lacks its <domains>")
    return Rule(
        element.tag == "allow_rule",
        domains,
        tuple(criteria["publish"]),
        tuple(criteria["subscribe"]),
        tuple(criteria["relay"]),
    )


def _read_criteria(element: etree._Element) -> Criteria:
    topics: tuple[str, ...] = ()
    partitions: tuple[str, ...] = ()
    tags: tuple[tuple[str, str], ...] = ()
    for child in element:
        match child.tag:
            case "topics":
                topics += tuple(xml_element.text or "" for xml_element in child)
            case "partitions":
                partitions += tuple(xml_element.text or "" for xml_element in child)
            case "data_tags":
                tags += tuple(
                    (xml_element.findtext("name") or "", xml_element.findtext("value") or "")
                    for xml_element in child
                )
            case _:
                raise DocumentError(
                    f"<{tag_of(element)}> holds an unknown element <{tag_of(child)}>"
                )
    if not topics:
        raise DocumentError(f"<{tag_of(element)}> names no topic")
    return Criteria(topics, partitions, tags)


# ── the domains of a rule ──────────────────────────────────────────────────────────────────


def domain_lines(domains: DomainSet) -> list[str]:
    """Return the lines of a ``<domains>`` element, with single ids and ranges."""
    lines = ["<domains>"]
    for part in domains.ranges:
        if part.first == part.last:
            lines.append(f"  <id>{part.first}</id>")
            continue
        low = "" if part.first is None else f"<min>{part.first}</min>"
        high = "" if part.last is None else f"<max>{part.last}</max>"
        lines.append(f"  <id_range>{low}{high}</id_range>")
    return [*lines, "</domains>"]


def read_domains(element: etree._Element) -> DomainSet:
    """Read a ``<domains>`` element without sorting or joining its ranges."""
    ranges = []
    for child in element:
        if child.tag == "id":
            domain = _number(child)
            ranges.append(DomainRange(domain, domain))
        elif child.tag == "id_range":
            low, high = child.find("min"), child.find("max")
            if low is None and high is None:
                raise DocumentError("an <id_range> has neither <min> nor <max>")
            ranges.append(
                DomainRange(
                    None if low is None else _number(low), None if high is None else _number(high)
                )
            )
        else:
            raise DocumentError(f"<domains> holds an unknown element <{tag_of(child)}>")
    if not ranges:
        raise DocumentError("<domains> names no domain")
    return DomainSet(tuple(ranges))


def _number(element: etree._Element) -> int:
    text = (element.text or "").strip()
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise DocumentError(f"<{tag_of(element)}> holds {text!r}, which is not a domain id")
    return int(text)


def size_of_topic(topic: str) -> int:
    """Return the size of a topic in bytes; surrogates stand for bytes that were not UTF-8."""
    return len(topic.encode(errors="surrogateescape"))


# ── the portable profile ───────────────────────────────────────────────────────────────────

_MOST_SHOWN = 3
_LONGEST_TOPIC = 251  # longest DDS topic name, in bytes
# Parts of an enclave name; a longer name has too many subsets of parts to compare.
_MOST_NAME_PARTS = 8


def document_notes(label: str, permissions: Permissions, signed_bytes: int) -> Iterator[Note]:
    """Yield notes on permissions that are too large or not portable; ``label`` names the document.

    ``signed_bytes`` is the size of the signed document.
    """
    for identity, fact in portability_problems(permissions, signed_bytes):
        yield Note(identity, f"{label}: {fact}{_CONSEQUENCES[identity]}")


_CONSEQUENCES = {
    "portable.document-size": f"; with {MAX_SIGNED_BYTES} or more, Fast DDS 2.6 and 2.9 may "
    "never finish the handshake. Remove rights that are never used, or use wildcards (`sros "
    "minimize_policy POLICY --observed OBSERVED` shows how), or split the enclave.",
    "portable.long-name": f"; on Fast DDS no peer matches a topic of more than "
    f"{_LONGEST_TOPIC} bytes. Use shorter namespaces and names.",
    "portable.deny-blocks-topic": " on Cyclone DDS, which refuses the topic as a whole; Fast "
    "DDS denies only the named direction. What no rule allows is denied anyway, so perhaps the "
    "deny rule can be removed.",
    "portable.character-set": ". Vendors agree on sets such as [ab], but not on all sets. On * and "
    "?, they always agree.",
}


OverlapTest = Callable[[str], bool]
"""A function that returns whether an expression and some other expressions share a name."""


def _textual_overlap_test(names: Sequence[str]) -> OverlapTest:
    """Return a function that returns whether an expression and any of ``names`` match.

    The match is textual: one of the two, as a pattern, has to match the text of the other.
    """
    return lambda name: any(
        fnmatchcase(other_name, name) or fnmatchcase(name, other_name) for other_name in names
    )


def portability_problems(
    permissions: Permissions,
    signed_bytes: int,
    overlap_test_of: Callable[[Sequence[str]], OverlapTest] = _textual_overlap_test,
) -> Iterator[tuple[str, str]]:
    """Yield id and clause for each part of a document that vendors read differently.

    ``overlap_test_of(expressions)`` returns a function that returns whether an expression and any
    of ``expressions`` match a common name.
    """
    if signed_bytes >= MAX_SIGNED_BYTES:
        yield "portable.document-size", f"the signed permissions have {signed_bytes} bytes"
    for grant in permissions.grants:
        too_long = [
            topic
            for rule in grant.rules
            for criteria in (*rule.publish, *rule.subscribe)
            for topic in criteria.topics
            if size_of_topic(topic) > _LONGEST_TOPIC
            and not any(character in topic for character in "*?[")
        ]
        if too_long:
            name, size = too_long[0][:60], size_of_topic(too_long[0])
            yield "portable.long-name", f"{name}... has {size} bytes"
        allowed = [r for r in grant.rules if r.allow]
        denied = [r for r in grant.rules if not r.allow]
        for direction, other in (("publish", "subscribe"), ("subscribe", "publish")):
            blocked = _blocked_by_denials(
                [t for r in denied for t in _topics(getattr(r, direction))],
                {t for r in denied for t in _topics(getattr(r, other))},
                overlap_test_of([t for r in allowed for t in _topics(getattr(r, other))]),
            )
            if blocked:
                kept_from = "subscribing to" if other == "subscribe" else "publishing on"
                yield (
                    "portable.deny-blocks-topic",
                    f"a deny rule to {direction} {_topics_text(blocked)} also keeps the enclave "
                    f"from {kept_from} the same topics",
                )
        sets = [t for r in grant.rules for c in (*r.publish, *r.subscribe) for t in c.topics]
        sets = sorted({topic for topic in sets if "[" in topic})
        if sets:
            yield "portable.character-set", f"a [set] of characters is in {_topics_text(sets)}"


def _topics(criteria: Iterable[Criteria]) -> tuple[str, ...]:
    return tuple(topic for criterion in criteria for topic in criterion.topics)


def _blocked_by_denials(
    denied: list[str], denied_too: set[str], is_allowed: OverlapTest
) -> list[str]:
    """Of the expressions ``denied`` in one direction, return those allowed in the other direction.

    ``is_allowed`` says what is allowed there. Expressions in ``denied_too``, which are denied
    in both directions, are left out.
    """
    return [
        expression
        for expression in denied
        if expression not in denied_too and is_allowed(expression)
    ]


_MAX_PARTS_FOR_SEARCH = 20
"""Number of distinct name parts up to which searching all names for the parts is faster.

With more parts, comparing all pairs of names is faster.
"""


def name_notes(names: Iterable[str], new: Iterable[str]) -> Iterator[Note]:
    """Yield a note on enclaves with plain subjects that Cyclone DDS mistakes for each other.

    ``names`` are all enclaves; only pairs with an enclave in ``new`` are reported.
    """
    new_names = set(new)
    # If Cyclone DDS mistakes one name for another, one has all parts of the other.
    parts = {part for name in new_names for part in name.strip("/").split("/")}
    if len(parts) <= _MAX_PARTS_FOR_SEARCH:
        names = new_names.union(name for name in names if any(part in name for part in parts))
    pairs = [pair for pair in mistaken_names(names) if not new_names.isdisjoint(pair)]
    if pairs:
        yield Note(
            "portable.enclave-names",
            f"Cyclone DDS 0.10 mistakes {pairs_text(pairs)}, if the first enclave presents the "
            "permissions of the second one. These permissions are public, and their subject "
            "contains all parts of the first enclave's name. Rename an enclave so that its path "
            "has a part that the other path lacks, such as /robot_admin.",
        )


def mistaken_names(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the sorted pairs (a, b) of enclaves where Cyclone DDS gives enclave a the rights of b.

    Cyclone DDS only checks that the subject of the permissions has every part of the certificate's
    subject.  So the permissions of ``/robot/admin`` fit the certificate of ``/robot``.
    """
    parts_of = {name: frozenset(name.strip("/").split("/")) for name in names}
    by_parts: dict[frozenset[str], list[str]] = {}
    for name, parts in parts_of.items():
        by_parts.setdefault(parts, []).append(name)
    return sorted(
        {
            (inner, outer)
            for outer, parts in parts_of.items()
            if len(parts) <= _MOST_NAME_PARTS
            for inner in _names_within(parts, by_parts)
            if inner != outer
        }
    )


def pairs_text(pairs: Sequence[tuple[str, str]]) -> str:
    """Return the first pairs in words, such as "/robot for /robot/admin and 2 more"."""
    return first_few([f"{inner} for {outer}" for inner, outer in pairs], _MOST_SHOWN)


def _names_within(
    parts: frozenset[str], by_parts: Mapping[frozenset[str], list[str]]
) -> Iterator[str]:
    for size in range(1, len(parts) + 1):
        for subset in combinations(sorted(parts), size):
            yield from by_parts.get(frozenset(subset), ())


def _topics_text(topics: list[str]) -> str:
    return first_few(topics, _MOST_SHOWN)
