"""The RMWs of ROS 2: their middleware, how to recognize it, and which RMWs are installed.

To add a vendor to sros, add its rules in `sros_tool.dds.decision.vendors`, its row in `MIDDLEWARE`
here, and its log texts in `sros_tool.runtime.log_texts`.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.distributions import ROS_DISTRO, Distribution, sourced_distribution
from sros_tool.errors import SrosError

RMW = "RMW_IMPLEMENTATION"
"""The variable that names the RMW of a process."""
DEFAULT_RMW = "rmw_fastrtps_cpp"
"""The RMW that ROS 2 Jazzy uses if the variable is not set."""


def denial_trace_variables(stream: str) -> dict[str, str]:
    """Return variables that make Cyclone DDS log, to stderr or stdout, why it denies a topic."""
    return {
        "CYCLONEDDS_URI": "<CycloneDDS><Domain><Tracing>"
        "<Category>fatal,error,warning,trace</Category>"
        f"<OutputFile>{stream}</OutputFile></Tracing></Domain></CycloneDDS>"
    }


class Middleware(NamedTuple):
    """A middleware that ROS 2 can use, and how to recognize it.

    ``rmw`` is a part of the names of the RMWs, and ``libraries`` are the beginnings of names of
    shared libraries. ``vendor`` is the DDS vendor, or None for another middleware;
    ``trace_variables`` are environment variables that make the middleware log why it denies a
    topic.  The library ``rmw_library`` has the text ``open_build`` only if it was built without DDS
    Security.
    """

    name: str
    rmw: str
    libraries: tuple[str, ...] = ()
    vendor: Vendor | None = None
    trace_variables: Mapping[str, str] = MappingProxyType({})
    rmw_library: str = ""
    open_build: bytes = b""


MIDDLEWARE = (
    Middleware(
        "Fast DDS",
        "rmw_fastrtps",
        ("libfastdds.so", "libfastrtps.so"),
        Vendor.FAST,
        rmw_library="librmw_fastrtps_shared_cpp.so",
        open_build=b"have the security libraries",
    ),
    Middleware(
        "Cyclone DDS",
        "rmw_cyclonedds",
        ("libddsc",),
        Vendor.CYCLONE,
        denial_trace_variables("stderr"),
        rmw_library="librmw_cyclonedds_cpp.so",
        open_build=b"does not have security support enabled",
    ),
    Middleware("Connext", "rmw_connext", ("libnddsc.so",), Vendor.CONNEXT),
    Middleware("OpenDDS", "rmw_opendds", (), Vendor.OPENDDS),
    Middleware("Zenoh", "rmw_zenoh", ("libzenohc.so",)),
)

_RMW_INDEX = "share/ament_index/resource_index/rmw_typesupport"
_NOT_AN_RMW = "rmw_implementation"


def middleware_of(rmw: str) -> Middleware | None:
    """Return the middleware of an RMW, or None if sros does not know the RMW."""
    return next((middleware for middleware in MIDDLEWARE if middleware.rmw in rmw), None)


def vendor_of(rmw: str) -> Vendor | None:
    """Return the DDS vendor of an RMW, or None if the RMW is unknown or does not use DDS."""
    middleware = middleware_of(rmw)
    return middleware.vendor if middleware else None


def rmw_implementations(environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the RMWs in the ament index, starting with the RMW that rclpy would use.

    Searches the prefixes in AMENT_PREFIX_PATH, and the prefix of this Python, which wheels use.
    """
    names = {
        file.name
        for prefix in _prefixes(environment)
        for file in Path(prefix, _RMW_INDEX).glob("*")
        if file.name != _NOT_AN_RMW
    }
    preferred = environment.get(RMW) or DEFAULT_RMW
    return tuple(sorted(names, key=lambda name: (name != preferred, name)))


def default_rmw(environment: Mapping[str, str]) -> str:
    """Return the RMW that nodes use in an environment; "" if that is not known."""
    return environment.get(RMW) or next(iter(rmw_implementations(environment)), "")


def _prefixes(environment: Mapping[str, str]) -> list[str]:
    paths = environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [prefix for prefix in (*paths, sys.prefix) if prefix]


def package_version(rmw: str, environment: Mapping[str, str]) -> tuple[int, int, int] | None:
    """Return the version of an installed RMW by its package.xml; None if it is unknown."""
    from sros_tool.xml import parse, read_bytes

    for prefix in _prefixes(environment):
        if not Path(prefix, _RMW_INDEX, rmw).exists():
            continue
        path = Path(prefix, "share", rmw, "package.xml")
        with suppress(SrosError):
            text = parse(read_bytes(path, "package"), str(path)).findtext("version") or ""
            if numbers := _VERSION.fullmatch(text.strip()):
                return int(numbers[1]), int(numbers[2]), int(numbers[3])
        return None
    return None


_VERSION = re.compile(r"(\d{1,9})\.(\d{1,9})\.(\d{1,9})", re.ASCII)


def chosen_rmw(named: str | None, environment: Mapping[str, str]) -> str:
    """Return the RMW that a process will use; "" if several are possible.

    ``named`` is the RMW that the user chose.  Without it, the result is $RMW_IMPLEMENTATION, or the
    only installed RMW, which rmw_implementation then loads.
    """
    if named or environment.get(RMW):
        return named or environment[RMW]
    installed = rmw_implementations(environment)
    return installed[0] if len(installed) == 1 else ""


def built_without_security(rmw: str, environment: Mapping[str, str]) -> bool:
    """Return whether an installed RMW surely has no DDS Security, without starting it.

    Only a library that was built without DDS Security has the error message for nodes that ask for
    security (rmw_fastrtps of Jazzy, participant.cpp; rmw_cyclonedds of Jazzy, rmw_node.cpp). False
    proves nothing: only `sros doctor` tests whether an RMW enforces security.
    """
    middleware = middleware_of(rmw)
    if not (middleware and middleware.open_build):
        return False
    for prefix in _prefixes(environment):
        if Path(prefix, _RMW_INDEX, rmw).exists():
            try:
                with Path(prefix, "lib", middleware.rmw_library).open("rb") as file:
                    return middleware.open_build in file.read(_MOST_BYTES)
            except OSError:
                return False
    return False


def no_security_text(rmw: str) -> str:
    """Return a sentence on an RMW that `built_without_security` names."""
    return f"{rmw} is built without security here: with it, no node starts in an enclave"


_MOST_BYTES = 16 * 1024 * 1024


def vendor_here(
    environment: Mapping[str, str], distribution: Distribution | None = None
) -> tuple[Vendor, str]:
    """Return the DDS vendor of this machine, and the reason as a short text.

    $RMW_IMPLEMENTATION decides on the vendor; if it is not set, an installed RMW decides, or else
    the vendor is Fast DDS.  The release is the release that $ROS_DISTRO ships.  With
    ``distribution``, it is the release that this distribution ships, and installed RMWs do not
    count.  The text also warns if the RMW was built without DDS Security, or if the release was not
    tested.
    """
    named = environment.get(RMW, "")
    rmw, why = "", ""
    if vendor_of(named):
        rmw, why = named, f"{RMW} is {named}"
    elif distribution is None:  # installed RMWs say nothing about another distribution
        rmw = next(filter(vendor_of, rmw_implementations(environment)), "")
        why = f"{rmw} is installed here" if rmw else ""
    why += _lacks_security(rmw, environment) if distribution is None else ""
    vendor = vendor_of(rmw) or Vendor.FAST
    distribution = distribution or sourced_distribution(environment.get(ROS_DISTRO))
    shipped = distribution.shipped_product(vendor.traits.product) if distribution else None
    if distribution is None or shipped is None:
        return vendor, why or "the default of ROS 2 Jazzy"
    return shipped.vendor, ", ".join(filter(None, (why, distribution.reason_for(shipped.vendor))))


def chosen_vendor(
    named: str | None, distribution: Distribution | None, environment: Mapping[str, str]
) -> tuple[Vendor, str]:
    """Return the vendor of a name such as ``cyclonedds``, or else `vendor_here`, with the reason.

    With a distribution, the vendor has the rules of the release that the distribution ships.

    Raises:
        UsageError: the distribution does not ship that vendor.
    """
    if not named:
        return vendor_here(environment, distribution)
    if not distribution:
        return Vendor(named), "as asked"
    vendor = distribution.shipped_vendor_product(Vendor(named)).vendor
    return vendor, distribution.reason_for(vendor)


def shipped_vendor(rmw: str, environment: Mapping[str, str]) -> Vendor | None:
    """Return the vendor of an RMW, with the rules of the release that $ROS_DISTRO ships.

    If the distribution is unknown or does not ship the vendor, the result is that of `vendor_of`.
    The result is None if the RMW has no known vendor.
    """
    vendor, distribution = vendor_of(rmw), sourced_distribution(environment.get(ROS_DISTRO))
    shipped = (
        distribution.shipped_product(vendor.traits.product) if vendor and distribution else None
    )
    return shipped.vendor if shipped else vendor


def _lacks_security(rmw: str, environment: Mapping[str, str]) -> str:
    if not built_without_security(rmw, environment):
        return ""
    return ", built without security: it enforces nothing"
