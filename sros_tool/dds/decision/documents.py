"""Governance and permissions as each vendor reads them, and the documents that vendors refuse."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import lru_cache
from typing import TypeVar

from sros_tool.dds.decision.access import Refusal
from sros_tool.dds.decision.vendors import DocumentReader, Vendor
from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.dds.governance import (
    DomainRule,
    Governance,
    TopicRule,
    attributes,
    parse_governance,
    render_governance,
)
from sros_tool.dds.permissions import Permissions, render_permissions
from sros_tool.errors import DocumentError

_Document = TypeVar("_Document", Governance, Permissions)


def _readers(
    reader: DocumentReader,
) -> tuple[Callable[[bytes], Governance], Callable[[bytes], Permissions]]:
    """Return the vendor's parsers for governance and permissions."""
    match reader:
        case DocumentReader.FAST:
            from sros_tool.dds.decision import fastdds

            return fastdds.read_governance, fastdds.read_permissions
        case DocumentReader.CYCLONE:
            from sros_tool.dds.decision import cyclone

            return cyclone.read_governance, cyclone.read_permissions
    from sros_tool.dds.decision import elements

    return elements.read_governance, elements.read_permissions


def read_governance_as(vendor: Vendor, xml: bytes) -> Governance | Refusal:
    """Return the governance as ``vendor`` reads ``xml``, or the vendor's refusal."""
    return _read(vendor, "governance", _readers(vendor.traits.reader)[0], xml)


def read_permissions_as(vendor: Vendor, xml: bytes) -> Permissions | Refusal:
    """Return the permissions as ``vendor`` reads ``xml``, or the vendor's refusal."""
    return _read(vendor, "permissions", _readers(vendor.traits.reader)[1], xml)


def _read(
    vendor: Vendor, label: str, parse: Callable[[bytes], _Document], xml: bytes
) -> _Document | Refusal:
    from sros_tool.dds.decision.elements import UnreadableError

    try:
        return parse(xml)
    except UnreadableError as error:
        return error.refusal(vendor.traits, label)
    except DocumentError as error:
        return Refusal("malformed", f"{vendor.title}: {error}")


# ── documents that all vendors read alike ──────────────────────────────────────────────────


@lru_cache(maxsize=8)  # all enclaves of a keystore have the same governance
def canonical_governance(document: bytes) -> Governance | None:
    """Return the governance in a document; None unless it has exactly the bytes that sros writes.

    All vendors read such a document alike.
    """
    with suppress(DocumentError):
        governance = parse_governance(document)
        if is_plain_governance(governance) and _is_written(render_governance(governance), document):
            return governance
    return None


def are_canonical_permissions(permissions: Permissions, document: bytes) -> bool:
    """Return whether ``document`` has exactly the bytes that sros writes for ``permissions``.

    All vendors read such a document alike.
    """
    written = is_plain_permissions(permissions)
    return written and _is_written(render_permissions(permissions), document)


def _is_written(written: bytes, document: bytes) -> bool:
    return document.replace(b"\r\n", b"\n").strip(b"\n") == written.strip(b"\n")


def is_plain_governance(governance: Governance) -> bool:
    """Return whether all vendors read the texts, values and domains of a governance alike."""
    texts = []
    for rule in governance.domain_access_rules:
        if not (_are_plain_domains(rule.domains) and rule.topic_access_rules):
            return False
        rules: tuple[DomainRule | TopicRule, ...] = (rule, *rule.topic_access_rules)
        if not all(_has_valid_values(rule) for rule in rules):
            return False
        texts += [topic.topic_expression for topic in rule.topic_access_rules]
    return bool(texts) and all(texts) and _are_plain(texts)


def _has_valid_values(rule: DomainRule | TopicRule) -> bool:
    return all(
        getattr(rule, attribute.name) in attribute.values for attribute in attributes(type(rule))
    )


def is_plain_permissions(permissions: Permissions) -> bool:
    """Return whether all vendors read the texts and domains of permissions alike."""
    texts = []
    for grant in permissions.grants:
        if not (grant.name and grant.rules):
            return False
        texts += [grant.name, grant.subject, grant.not_before, grant.not_after]
        for rule in grant.rules:
            if rule.relay or not _are_plain_domains(rule.domains):
                return False
            for criteria in (*rule.publish, *rule.subscribe):
                if criteria.partitions or criteria.data_tags or not all(criteria.topics or ("",)):
                    return False
                texts += criteria.topics
    return _are_plain(texts)


def _are_plain_domains(domains: DomainSet) -> bool:
    ends = [end for part in domains.ranges for end in (part.first, part.last)]
    return bool(ends) and all(end is not None and end <= MAX_DOMAIN for end in ends)


def _are_plain(texts: Iterable[str]) -> bool:
    joined = f"|{'|'.join(texts)}|"
    has_special_characters = (
        "| " in joined or " |" in joined or any(character in joined for character in _MARKUP)
    )
    return joined.isascii() and joined.isprintable() and not has_special_characters


_MARKUP = '&<>"'
