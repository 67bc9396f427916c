"""How each vendor reads governance and permissions: what it takes and what it refuses."""

from __future__ import annotations

from sros_tool.dds.decision import cyclone, elements, fastdds
from sros_tool.dds.decision.answers import Refusal
from sros_tool.dds.decision.elements import UnreadableError
from sros_tool.dds.decision.vendors import TRAITS, Vendor
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Permissions, parse_permissions
from sros_tool.errors import DocumentError

_PERMISSIONS = "permissions"
_GOVERNANCE = "governance"


def read_permissions_as(vendor: Vendor, xml: bytes) -> Permissions | Refusal:
    """The permissions that ``vendor`` finds in ``xml``, or why it refuses them.

    The standard's reading, also taken for vendors without one of their own here, is its schema's.
    """
    try:
        match vendor:
            case Vendor.FAST | Vendor.FAST_2_9:
                return fastdds.read_permissions(xml)
            case Vendor.CYCLONE:
                return cyclone.read_permissions(xml)
            case _:
                elements.check_permissions(xml)
                return parse_permissions(xml, _PERMISSIONS)
    except UnreadableError as error:
        return error.refusal(TRAITS[vendor].title, _PERMISSIONS)
    except DocumentError as error:
        return Refusal("malformed", f"{TRAITS[vendor].title}: {error}")


def read_governance_as(vendor: Vendor, xml: bytes) -> Governance | Refusal:
    """The governance that ``vendor`` finds in ``xml``, or why it refuses it."""
    try:
        match vendor:
            case Vendor.FAST | Vendor.FAST_2_9:
                return fastdds.read_governance(xml)
            case Vendor.CYCLONE:
                return cyclone.read_governance(xml)
            case _:
                elements.check_governance(xml)
                return parse_governance(xml, _GOVERNANCE)
    except UnreadableError as error:
        return error.refusal(TRAITS[vendor].title, _GOVERNANCE)
    except DocumentError as error:
        return Refusal("malformed", f"{TRAITS[vendor].title}: {error}")
