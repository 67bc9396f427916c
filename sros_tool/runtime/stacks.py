"""Which DDS stacks and RMWs are here, and which of them really enforce security.

Each is tried in a process of its own, in an enclave made by sros: a name or a version says
nothing about how a library was built.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from sros_tool.runtime.cyclone_library import INSTALL_ADVICE
from sros_tool.runtime.events import Kind, read_events
from sros_tool.runtime.netns import end_with_parent
from sros_tool.runtime.probing import ProbeRun, Verdict, judge
from sros_tool.runtime.security_log import CYCLONE_EXPLAINS, plain_text

PROBE_SECONDS = 60.0

_RMW_INDEX = "share/ament_index/resource_index/rmw_typesupport"
_NOT_AN_RMW = "rmw_implementation"
ROS_ADVICE = (
    "The ROS 2 packages of Ubuntu (ros-jazzy-ros-base) have DDS Security built in; the wheels on"
    " PyPI do not."
)
_STATUS_TIMEOUT = 5.0


@dataclass(frozen=True)
class ProbeEnclave:
    """The secured environment to probe in, and what its permissions say about two ROS topics.

    ``environment`` holds the ROS_SECURITY_* variables and ROS_DOMAIN_ID of an enclave that may
    publish ``allowed`` and neither publish nor subscribe ``denied``.
    """

    environment: Mapping[str, str]
    allowed: str
    denied: str


@dataclass(frozen=True)
class Stack:
    """One DDS or RMW, and whether it enforces security (None: it could not be tried).

    ``kind`` is "cyclone" (the libddsc that sros speaks with), "rmw" (under rclpy) or "cyclonedds"
    (the Python package).  ``evidence`` says what was tried and seen.
    """

    name: str
    kind: str
    dds: str
    version: str
    where: str
    present: bool
    enforces: bool | None
    evidence: str
    advice: str = ""
    rmw: str = ""


def survey(probe: ProbeEnclave) -> tuple[Stack, ...]:
    """Every stack that sros knows how to look for, also those that are not here."""
    return (*rclpy_stacks(probe), cyclone_stack(probe), cyclonedds_package_stack(probe))


def rclpy_stacks(probe: ProbeEnclave) -> Iterator[Stack]:
    """One stack per RMW that is installed, rclpy's choice first; each is tried when asked for."""
    if importlib.util.find_spec("rclpy") is None:
        yield _without_rclpy()
        return
    for name in rmw_implementations(os.environ) or ("",):
        yield _probe_rmw(probe, name)


def rmw_implementations(environment: Mapping[str, str]) -> tuple[str, ...]:
    """The RMWs in the ament index, the one that rclpy would take first.

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
    preferred = environment.get("RMW_IMPLEMENTATION") or "rmw_fastrtps_cpp"
    return tuple(sorted(found, key=lambda name: (name != preferred, name)))


def cyclone_stack(probe: ProbeEnclave) -> Stack:
    """The Cyclone DDS that sros itself speaks with."""
    run = _run_probe("cyclone", probe, {})
    verdict = judge(run, probe.allowed, probe.denied)
    dds, version, where = _identity(run)
    absent = not version and any("cannot find Cyclone DDS" in event.text for event in run.events)
    if absent:
        verdict = Verdict(None, verdict.evidence.removeprefix("could not be tried: "))
    return Stack(
        "Cyclone DDS (libddsc)",
        "cyclone",
        dds or "Cyclone DDS",
        version,
        where,
        not absent,
        verdict.enforces,
        verdict.evidence,
        "" if verdict.enforces else INSTALL_ADVICE,
    )


def cyclonedds_package_stack(probe: ProbeEnclave) -> Stack:
    """The Python package ``cyclonedds``, which brings a libddsc of its own."""
    spec = importlib.util.find_spec("cyclonedds")
    if spec is None:
        return _absent("cyclonedds (Python package)", "cyclonedds", "Cyclone DDS")
    run = _run_probe("cyclonedds", probe, {})
    verdict = judge(run, probe.allowed, probe.denied)
    dds, version, where = _identity(run)
    if verdict.enforces is None and where and not _has_plugins(Path(where)):
        verdict = Verdict(
            False,
            "a secured participant fails, and no libdds_security_*.so comes with it."
            f" {verdict.evidence.partition(': ')[2]}",
        )
    return Stack(
        "cyclonedds (Python package)",
        "cyclonedds",
        dds or "Cyclone DDS",
        version or _package_version("cyclonedds"),
        where or str(spec.origin or ""),
        True,
        verdict.enforces,
        verdict.evidence,
        "" if verdict.enforces else "sros does not need it: it speaks with libddsc itself.",
    )


def _probe_rmw(probe: ProbeEnclave, rmw: str) -> Stack:
    variables = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # leaves nothing in shared memory
    variables |= {"RMW_IMPLEMENTATION": rmw} if rmw else {}
    variables |= CYCLONE_EXPLAINS if rmw.startswith("rmw_cyclonedds") else {}
    run = _run_probe("rclpy", probe, variables)
    verdict = judge(run, probe.allowed, probe.denied)
    dds, version, where = _identity(run)
    return Stack(
        f"rclpy with {rmw or 'its default RMW'}",
        "rmw",
        dds,
        version,
        where,
        True,
        verdict.enforces,
        verdict.evidence,
        "" if verdict.enforces else ROS_ADVICE,
        rmw,
    )


def _without_rclpy() -> Stack:
    installed = sorted(Path("/opt/ros").glob("*/setup.sh"))
    stack = _absent("rclpy", "rmw", "")
    if not installed:
        return stack
    advice = f"ROS 2 is installed but not set up in this shell: run `. {installed[-1]}` first."
    return Stack(**{**vars(stack), "advice": advice})


def _absent(name: str, kind: str, dds: str) -> Stack:
    return Stack(name, kind, dds, "", "", False, None, "")


def _run_probe(kind: str, probe: ProbeEnclave, extra: Mapping[str, str]) -> ProbeRun:
    with TemporaryDirectory(prefix="sros-probe-") as folder:
        report, log = Path(folder, "report.jsonl"), Path(folder, "log.txt")
        environment = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith("ROS_SECURITY_")
        }
        environment |= {**probe.environment, **extra, "ROS_LOG_DIR": folder}
        command = [sys.executable, "-m", "sros_tool.runtime.probe_child", kind, str(report)]
        with log.open("wb") as output:
            process = subprocess.Popen(
                [*command, probe.allowed, probe.denied],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment,
                start_new_session=True,
                preexec_fn=end_with_parent,
            )
            status = _wait(process)
        printed = plain_text(log.read_text(encoding="utf-8", errors="replace"))
        return ProbeRun(tuple(read_events(report)), printed, status)


def _wait(process: subprocess.Popen[bytes]) -> int | None:
    try:
        return process.wait(PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(_STATUS_TIMEOUT)


def _identity(run: ProbeRun) -> tuple[str, str, str]:
    for event in run.events:
        if event.kind is Kind.SEEN and event.text.count("\n") == 2:
            name, version, where = event.text.split("\n")
            return name, version, where
    return "", "", ""


def _has_plugins(library: Path) -> bool:
    return any(library.parent.glob("**/libdds_security_auth*.so*"))


def _package_version(name: str) -> str:
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)
    return ""
