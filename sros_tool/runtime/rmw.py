"""The RMWs of ROS 2: their middleware, how to recognise it, and which RMWs are installed.

To add a vendor to sros, add its rules in `sros_tool.dds.decision.vendors`, its row in `MIDDLEWARE`
here, and its log texts in `sros_tool.runtime.vendor_log`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sros_tool.dds.decision.vendors import Vendor

RMW = "RMW_IMPLEMENTATION"
"""The variable that names the RMW of a process."""
DEFAULT_RMW = "rmw_fastrtps_cpp"
"""The RMW that ROS 2 Jazzy uses if the variable is not set."""

CYCLONE_EXPLAINS = {
    "CYCLONEDDS_URI": "<CycloneDDS><Domain><Tracing><Category>fatal,error,warning,trace</Category>"
    "<OutputFile>stderr</OutputFile></Tracing></Domain></CycloneDDS>"
}
"""Variables that make Cyclone DDS log, in its trace, why it denies a topic."""


@dataclass(frozen=True, slots=True)
class Middleware:
    """A middleware that ROS 2 can use, and how to recognise it.

    ``rmw`` is part of the names of its RMWs, and the names of its shared libraries start with one
    of ``libraries``.  ``vendor`` is its DDS vendor, None if it is not DDS; ``explains`` are
    variables that make it log why it denies a topic.
    """

    name: str
    rmw: str
    libraries: tuple[str, ...] = ()
    vendor: Vendor | None = None
    explains: Mapping[str, str] = field(default_factory=dict)


MIDDLEWARE = (
    Middleware("Fast DDS", "rmw_fastrtps", ("libfastdds.so", "libfastrtps.so"), Vendor.FAST),
    Middleware("Cyclone DDS", "rmw_cyclonedds", ("libddsc",), Vendor.CYCLONE, CYCLONE_EXPLAINS),
    Middleware("Connext", "rmw_connext", ("libnddsc.so",), Vendor.CONNEXT),
    Middleware("OpenDDS", "rmw_opendds", (), Vendor.OPENDDS),
    Middleware("Zenoh", "rmw_zenoh", ("libzenohc.so",)),
)

_RMW_INDEX = "share/ament_index/resource_index/rmw_typesupport"
_NOT_AN_RMW = "rmw_implementation"


def middleware_of(rmw: str) -> Middleware | None:
    """Return the middleware of an RMW, or None if sros does not know the RMW."""
    return next((each for each in MIDDLEWARE if each.rmw in rmw), None)


def vendor_of(rmw: str) -> Vendor | None:
    """Return the DDS vendor of an RMW, or None if it is unknown or does not use DDS."""
    found = middleware_of(rmw)
    return found.vendor if found else None


def rmw_implementations(environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the RMWs in the ament index, starting with the one that rclpy would use.

    Searches the prefixes in AMENT_PREFIX_PATH, and the prefix of this Python, which wheels use.
    """
    prefixes = [*environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    found = {
        file.name
        for prefix in prefixes
        if prefix
        for file in Path(prefix, _RMW_INDEX).glob("*")
        if file.name != _NOT_AN_RMW
    }
    preferred = environment.get(RMW) or DEFAULT_RMW
    return tuple(sorted(found, key=lambda name: (name != preferred, name)))


def vendor_here(environment: Mapping[str, str]) -> tuple[Vendor, str]:
    """Return the DDS vendor of this machine, and the reason as a short text.

    It is the vendor of $RMW_IMPLEMENTATION, else of an installed RMW, else Fast DDS.
    """
    named = environment.get(RMW, "")
    if vendor := vendor_of(named):
        return vendor, f"{RMW} is {named}"
    for rmw in rmw_implementations(environment):
        if vendor := vendor_of(rmw):
            return vendor, f"{rmw} is installed here"
    return Vendor.FAST, "the default of ROS 2 Jazzy"
