"""The permissions document of DDS Security: grants, rules, and their XML.

Names follow the specification (DDS-Security 1.1, 9.4.1.3 and the schema
omg_shared_ca_permissions of 20170901).
"""

from __future__ import annotations

from lxml import etree

from sros_tool.dataclass import dataclass
from sros_tool.dds.domain_elements import domain_lines, read_domains
from sros_tool.dds.domains import DomainSet
from sros_tool.errors import DocumentError
from sros_tool.validity import Window, iso, parse_iso
from sros_tool.xml import escape, parse, quoted, require_child, tag_of

_SCHEMA = "http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_permissions.xsd"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
MAX_SIGNED_BYTES = 60 * 1024
"""Size in bytes from which signed permissions may keep Fast DDS 2.9 from finishing a handshake.

A message of the handshake must fit into one UDP datagram of 64 KB, with the certificate, the
signature and the participant's data.  Measured on Fast DDS 2.9.1 with one network interface:
63,129 bytes work and 63,189 do not for an EC certificate of 0.6 KB; for an RSA certificate of
0.9 KB, 62,579 and 62,854.  The rest is room for longer certificates and more interfaces.
"""
LARGE_BYTES = MAX_SIGNED_BYTES - 6 * 1024
"""Size in bytes from which a document, before it is signed, is written as short as possible.

The difference is room for the signature and its certificate.
"""
TOPIC_LINE_BYTES = len("            <topic></topic>\r\n")
"""Size in bytes that a topic adds to a signed document, without its name, if it is indented."""


@dataclass(frozen=True, slots=True)
class Criteria:
    """The topics of a rule; no partitions means the default partition."""

    topics: tuple[str, ...]
    partitions: tuple[str, ...] = ()
    data_tags: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Rule:
    """An allow or deny rule for some domains."""

    allow: bool
    domains: DomainSet
    publish: tuple[Criteria, ...] = ()
    subscribe: tuple[Criteria, ...] = ()
    relay: tuple[Criteria, ...] = ()


@dataclass(frozen=True, slots=True)
class Grant:
    """The rights and the validity of one subject; dates are kept as written in the document."""

    name: str
    subject: str
    not_before: str
    not_after: str
    rules: tuple[Rule, ...]
    default_allow: bool = False
    default_empty: bool = False
    """Whether ``<default>`` is empty; Cyclone DDS crashes on that."""
    default_first: bool = False
    """Whether ``<default>`` stands before a rule; Fast DDS ignores what follows it."""

    @property
    def validity(self) -> Window:
        """The validity of the grant by the standard: a date without a zone is in UTC.

        Raises `DocumentError` if a date is of a form that only some vendors read.
        """
        try:
            return Window(parse_iso(self.not_before), parse_iso(self.not_after))
        except ValueError as error:
            text = f"{self.not_before!r} or {self.not_after!r} is not an XML date and time"
            raise DocumentError(text) from error

    def domains(self) -> DomainSet:
        """Return the domains in which some rule allows something."""
        allowed = (each.domains.closed() for each in self.rules if each.allow)
        return DomainSet.of(
            *((part.first or 0, part.last or 0) for each in allowed for part in each.ranges)
        )


@dataclass(frozen=True, slots=True)
class Permissions:
    """A permissions document."""

    grants: tuple[Grant, ...]

    def grant_of(self, subject: str) -> Grant | None:
        """Return the first grant for a subject, or None."""
        return next((each for each in self.grants if each.subject == subject), None)


def grant(name: str, subject: str, validity: Window, rules: tuple[Rule, ...]) -> Grant:
    """Return a grant of the portable profile: dates in UTC, default DENY."""
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
    for each in permissions.grants:
        lines += [
            f"    <grant name={quoted(each.name)}>",
            f"      <subject_name>{escape(each.subject)}</subject_name>",
            "      <validity>",
            f"        <not_before>{escape(each.not_before)}</not_before>",
            f"        <not_after>{escape(each.not_after)}</not_after>",
            "      </validity>",
        ]
        for rule in each.rules:
            _write_rule(lines, rule)
        default = "ALLOW" if each.default_allow else "DENY"
        lines += [f"      <default>{default}</default>", "    </grant>"]
    lines += ["  </permissions>", "</dds>", ""]
    document = "\n".join(lines).encode()
    # A line feed becomes CR LF when the document is signed.
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
    """Return the permissions document in ``data``, which errors call ``name``.

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
                topics += tuple(each.text or "" for each in child)
            case "partitions":
                partitions += tuple(each.text or "" for each in child)
            case "data_tags":
                tags += tuple(
                    (each.findtext("name") or "", each.findtext("value") or "") for each in child
                )
            case _:
                raise DocumentError(
                    f"<{tag_of(element)}> holds an unknown element <{tag_of(child)}>"
                )
    if not topics:
        raise DocumentError(f"<{tag_of(element)}> names no topic")
    return Criteria(topics, partitions, tags)
