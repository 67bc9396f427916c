"""The RMWs of ROS 2: the middleware below each, how it is recognised, and which are installed.

A vendor is added to sros by its rules in `sros_tool.dds.decision.vendors`, its row in `MIDDLEWARE`
here, and its texts in `sros_tool.runtime.vendor_log`.
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
"""The RMW of ROS 2 Jazzy where the variable is not set."""

CYCLONE_EXPLAINS = {
    "CYCLONEDDS_URI": "<CycloneDDS><Domain><Tracing><Category>fatal,error,warning,trace</Category>"
    "<OutputFile>stderr</OutputFile></Tracing></Domain></CycloneDDS>"
}
"""Variables that make Cyclone DDS say why it denies a topic, which only its trace does."""


@dataclass(frozen=True, slots=True)
class Middleware:
    """What ROS 2 runs on, and how it is recognised.

    ``rmw`` occurs in the names of its RMWs, and the names of its shared libraries start with one
    of ``libraries``.  ``vendor`` is the one whose decisions it makes, None where it is not DDS;
    ``explains`` are the variables that make it log why it denies a topic.
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
    """Return what an RMW runs on, or None where sros does not know the RMW."""
    return next((each for each in MIDDLEWARE if each.rmw in rmw), None)


def vendor_of(rmw: str) -> Vendor | None:
    """Return the DDS vendor below an RMW, or None where there is none or sros does not know it."""
    found = middleware_of(rmw)
    return found.vendor if found else None


def rmw_implementations(environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the RMWs in the ament index, the one that rclpy would take first.

    Read from the prefixes in AMENT_PREFIX_PATH, and from the prefix of this Python, in which the
    wheels install theirs.
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
    """Return the vendor of this machine, and in a few words why it is that one.

    It is the vendor of $RMW_IMPLEMENTATION, else of the RMW that is installed, else Fast DDS.
    """
    named = environment.get(RMW, "")
    if vendor := vendor_of(named):
        return vendor, f"{RMW} is {named}"
    for rmw in rmw_implementations(environment):
        if vendor := vendor_of(rmw):
            return vendor, f"{rmw} is installed here"
    return Vendor.FAST, "the default of ROS 2 Jazzy"
