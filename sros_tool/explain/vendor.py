"""Which vendor's decision counts on this machine, by its RMW."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sros_tool.dds.decision import Vendor
from sros_tool.runtime.stacks import rmw_implementations

_BY_RMW = (
    ("fastrtps", Vendor.FAST),
    ("cyclonedds", Vendor.CYCLONE),
    ("connext", Vendor.CONNEXT),
    ("opendds", Vendor.OPENDDS),
)


@dataclass(frozen=True, slots=True)
class Choice:
    """A vendor, and in a few words why it was chosen."""

    vendor: Vendor
    why: str


def vendor_here(environment: Mapping[str, str]) -> Choice:
    """The vendor of $RMW_IMPLEMENTATION, else of the RMW that is installed, else Fast DDS 2.14."""
    named = environment.get("RMW_IMPLEMENTATION", "")
    if vendor := _vendor_of(named):
        return Choice(vendor, f"RMW_IMPLEMENTATION is {named}")
    for rmw in rmw_implementations(environment):
        if vendor := _vendor_of(rmw):
            return Choice(vendor, f"{rmw} is installed here")
    return Choice(Vendor.FAST, "what ROS 2 Jazzy uses unless told otherwise")


def _vendor_of(rmw: str) -> Vendor | None:
    return next((vendor for part, vendor in _BY_RMW if part in rmw), None)
