"""Small governance and permissions documents for the tests of decisions, and what they give."""

from __future__ import annotations

from datetime import UTC, datetime, tzinfo
from functools import lru_cache

from sros_tool.dds.decision.access import Access, GovernedDomain, Refusal
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.vendors import Vendor, VendorTraits
from sros_tool.dds.governance import Governance
from sros_tool.dds.permissions import Permissions

NOW = datetime(2026, 6, 15, 12, 0, tzinfo=UTC)
SUBJECT = "CN=/t"


def topic_rule(
    expression: str = "*", *, read: bool = True, write: bool = True, data: str = "ENCRYPT"
) -> str:
    return f"""<topic_rule>
<topic_expression>{expression}</topic_expression>
<enable_discovery_protection>true</enable_discovery_protection>
<enable_liveliness_protection>true</enable_liveliness_protection>
<enable_read_access_control>{str(read).lower()}</enable_read_access_control>
<enable_write_access_control>{str(write).lower()}</enable_write_access_control>
<metadata_protection_kind>ENCRYPT</metadata_protection_kind>
<data_protection_kind>{data}</data_protection_kind>
</topic_rule>"""


def governance(
    *topic_rules: str,
    domains: str = "<id>42</id>",
    join: bool = True,
    unauthenticated: bool = False,
    rtps: str = "SIGN",
) -> bytes:
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<dds><domain_access_rules><domain_rule>
<domains>{domains}</domains>
<allow_unauthenticated_participants>{str(unauthenticated).lower()}</allow_unauthenticated_participants>
<enable_join_access_control>{str(join).lower()}</enable_join_access_control>
<discovery_protection_kind>ENCRYPT</discovery_protection_kind>
<liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
<rtps_protection_kind>{rtps}</rtps_protection_kind>
<topic_access_rules>{"".join(topic_rules) or topic_rule()}</topic_access_rules>
</domain_rule></domain_access_rules></dds>""".encode()


def criteria(verb: str, *topics: str, partitions: tuple[str, ...] = ()) -> str:
    named = "".join(f"<partition>{each}</partition>" for each in partitions)
    named = f"<partitions>{named}</partitions>" if partitions else ""
    listed = "".join(f"<topic>{each}</topic>" for each in topics)
    return f"<{verb}><topics>{listed}</topics>{named}</{verb}>"


def publish(*topics: str, partitions: tuple[str, ...] = ()) -> str:
    return criteria("publish", *topics, partitions=partitions)


def subscribe(*topics: str, partitions: tuple[str, ...] = ()) -> str:
    return criteria("subscribe", *topics, partitions=partitions)


def allow(*all_criteria: str, domains: str = "<id>42</id>") -> str:
    return f"<allow_rule><domains>{domains}</domains>{''.join(all_criteria)}</allow_rule>"


def deny(*all_criteria: str, domains: str = "<id>42</id>") -> str:
    return f"<deny_rule><domains>{domains}</domains>{''.join(all_criteria)}</deny_rule>"


def grant(
    *rules: str,
    subject: str = SUBJECT,
    begin: str = "2020-01-01T00:00:00Z",
    end: str = "2040-01-01T00:00:00Z",
    default: str = "<default>DENY</default>",
    name: str = ' name="g"',
) -> str:
    return f"""<grant{name}><subject_name>{subject}</subject_name>
<validity><not_before>{begin}</not_before><not_after>{end}</not_after></validity>
{"".join(rules)}{default}</grant>"""


def permissions(*grants: str) -> bytes:
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<dds><permissions>{"".join(grants)}</permissions></dds>""".encode()


@lru_cache(1000)
def _governance(vendor: Vendor, _: VendorTraits, xml: bytes) -> Governance | Refusal:
    """What a vendor reads: the same texts are asked about again and again."""
    return read_governance_as(vendor, xml)


@lru_cache(1000)
def _permissions(vendor: Vendor, _: VendorTraits, xml: bytes) -> Permissions | Refusal:
    return read_permissions_as(vendor, xml)


def access_of(
    vendor: Vendor,
    governance_xml: bytes,
    permissions_xml: bytes,
    subject: str = SUBJECT,
    *,
    domain: int,
    at: datetime,
    zone: tzinfo = UTC,
) -> Access | Refusal:
    """Return the access control by two documents as ``vendor`` reads them, or its refusal."""
    read = _governance(vendor, vendor.traits, governance_xml)
    if isinstance(read, Refusal):
        return read
    permissions_read = _permissions(vendor, vendor.traits, permissions_xml)
    if isinstance(permissions_read, Refusal):
        return permissions_read
    governed = GovernedDomain(vendor, read, domain)
    return Access(governed, permissions_read, subject, moment=at, zone=zone)
