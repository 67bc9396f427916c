"""How each vendor reads governance and permissions: what it takes and what it refuses."""

from __future__ import annotations

from sros_tool.dds.decision.answers import Refusal
from sros_tool.dds.decision.vendors import TRAITS, Vendor
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Permissions, parse_permissions
from sros_tool.errors import DocumentError


def read_permissions_as(vendor: Vendor, xml: bytes) -> Permissions | Refusal:
    """The permissions that ``vendor`` finds in ``xml``, or why it refuses them."""
    try:
        return parse_permissions(xml, "the permissions document")
    except DocumentError as error:
        return Refusal("malformed", f"{TRAITS[vendor].title}: {error}")


def read_governance_as(vendor: Vendor, xml: bytes) -> Governance | Refusal:
    """The governance that ``vendor`` finds in ``xml``, or why it refuses it."""
    try:
        return parse_governance(xml, "the governance document")
    except DocumentError as error:
        return Refusal("malformed", f"{TRAITS[vendor].title}: {error}")
