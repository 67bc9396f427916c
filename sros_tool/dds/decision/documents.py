"""How each vendor reads governance and permissions, and which documents it refuses."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from sros_tool.dds.decision import cyclone, elements, fastdds
from sros_tool.dds.decision.answers import Refusal
from sros_tool.dds.decision.elements import UnreadableError
from sros_tool.dds.decision.vendors import DocumentReader, Vendor
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Permissions, parse_permissions
from sros_tool.errors import DocumentError

_Document = TypeVar("_Document", Governance, Permissions)


def _standard_governance(xml: bytes) -> Governance:
    elements.check_governance(xml)
    return parse_governance(xml, "governance")


def _standard_permissions(xml: bytes) -> Permissions:
    elements.check_permissions(xml)
    return parse_permissions(xml, "permissions")


_READERS = {
    DocumentReader.STANDARD: (_standard_governance, _standard_permissions),
    DocumentReader.FAST: (fastdds.read_governance, fastdds.read_permissions),
    DocumentReader.CYCLONE: (cyclone.read_governance, cyclone.read_permissions),
}


def read_governance_as(vendor: Vendor, xml: bytes) -> Governance | Refusal:
    """Return the governance as ``vendor`` reads it from ``xml``, or its refusal."""
    return _read(vendor, "governance", _READERS[vendor.traits.reader][0], xml)


def read_permissions_as(vendor: Vendor, xml: bytes) -> Permissions | Refusal:
    """Return the permissions as ``vendor`` reads them from ``xml``, or its refusal."""
    return _read(vendor, "permissions", _READERS[vendor.traits.reader][1], xml)


def _read(
    vendor: Vendor, what: str, read: Callable[[bytes], _Document], xml: bytes
) -> _Document | Refusal:
    try:
        return read(xml)
    except UnreadableError as error:
        return error.refusal(vendor.title, what)
    except DocumentError as error:
        return Refusal("malformed", f"{vendor.title}: {error}")
