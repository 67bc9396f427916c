"""The host: its RMWs, its clock, and the processes that run on it already."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sros_tool.checks.kind import ERROR, WARNING, Finding, Kind, by_id
from sros_tool.checks.runtimes.setting import Process, Setting
from sros_tool.keystore.enclave import enclave_path
from sros_tool.runtime.environment import DOMAIN, ENABLE, ENCLAVE, KEYSTORE
from sros_tool.validity import iso

RMW = "RMW_IMPLEMENTATION"

RMW_NOT_INSTALLED = Kind(
    "runtime.rmw-not-installed",
    ERROR,
    "RMW_IMPLEMENTATION names an RMW that is not installed",
    "No node starts.",
    "rmw_implementation 2.15 (functions.cpp).",
    "Install it, or choose one that is there.",
)
RMW_INSECURE = Kind(
    "runtime.rmw-without-security",
    ERROR,
    "an RMW that does not enforce DDS Security",
    "It was built without, or is not on DDS; nodes fail, or run unsecured.",
    "Found by trying (`sros doctor`); rmw_zenoh reads none of the files of an enclave.",
    "Use an RMW of which `sros doctor` says that it enforces security.",
)
CLOCK_BEHIND = Kind(
    "runtime.clock-behind",
    ERROR,
    "the clock of this host is behind",
    "Files of the keystore were written in the future. Certificates may not be valid yet, and "
    "expired ones may seem valid.",
    "RFC 5280, 6.1.3 (the current time); robots without a battery for their clock.",
    "Set the clock before nodes start, for instance by chrony with makestep.",
)
DAEMON_UNSECURED = Kind(
    "runtime.daemon-unsecured",
    WARNING,
    "the daemon of ros2 runs without security",
    "`ros2 topic list` and others ask it, and it sees nothing of a secured robot, so the graph "
    "seems empty.",
    "ros2cli 0.32 (daemon); it keeps the environment in which it was started.",
    "Run `ros2 daemon stop`; it is started anew by the next command, with this environment.",
)
DAEMON_OTHER = Kind(
    "runtime.daemon-differs",
    WARNING,
    "the daemon of ros2 runs with another keystore or enclave",
    "`ros2 topic list` and others ask it, and show what that enclave sees.",
    "ros2cli 0.32 (daemon); it keeps the environment in which it was started.",
    "Run `ros2 daemon stop`.",
)
PROCESS_UNSECURED = Kind(
    "runtime.process-unsecured",
    WARNING,
    "a node that runs without security beside secured ones",
    "It and the secured nodes do not see each other.",
    "DDS-Security 1.1, 9.4.1.2 (allow_unauthenticated_participants is false).",
    "Start it with `sros run ROOT NAME -- COMMAND...`.",
)
PROCESS_OUTDATED = Kind(
    "runtime.process-outdated",
    WARNING,
    "a process that runs with older files of its enclave",
    "A running participant does not notice changed certificates, permissions or revocation lists.",
    "Fast DDS 2.14.5, Cyclone DDS 0.10.2 (read at the start).",
    "Restart it.",
)
MIXED_VENDORS = Kind(
    "runtime.mixed-vendors",
    WARNING,
    "secured processes on different RMWs",
    "Vendors do not talk to each other securely on these versions, and say nothing about it.",
    "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Use one RMW per robot.",
)

KINDS = by_id(
    RMW_NOT_INSTALLED, RMW_INSECURE, CLOCK_BEHIND, DAEMON_UNSECURED, DAEMON_OTHER,
    PROCESS_UNSECURED, PROCESS_OUTDATED, MIXED_VENDORS,
)  # fmt: skip

DEFAULT_RMW = "rmw_fastrtps_cpp"
_NOT_DDS = ("rmw_zenoh", "rmw_email", "rmw_iceoryx")
_DAEMON = ("_ros2_daemon", "ros2cli.daemon", "ros2-daemon")
_TOLERANCE = timedelta(minutes=2)
_LOADED = ("cert.pem", "permissions.p7s", "governance.p7s", "crl.pem", "identity_ca.cert.pem")


def check_host(setting: Setting) -> Iterator[Finding]:
    """The RMW that nodes would use, the clock, and what runs."""
    yield from _rmw(setting)
    yield from _clock(setting)
    yield from _processes(setting)


def _rmw(setting: Setting) -> Iterator[Finding]:
    chosen = setting.environment.get(RMW, "")
    if chosen and setting.rmws and chosen not in setting.rmws:
        text = f"{RMW} is {chosen}; there are {', '.join(setting.rmws)}"
        yield RMW_NOT_INSTALLED.found(RMW, text)
    if not is_secured(setting.environment):
        return
    used = chosen or DEFAULT_RMW
    if used.startswith(_NOT_DDS):
        yield RMW_INSECURE.found(used, f"{used} is not on DDS")
    elif used in setting.insecure_rmws:
        yield RMW_INSECURE.found(used, setting.insecure_rmws[used])


def _clock(setting: Setting) -> Iterator[Finding]:
    root = setting.environment.get(KEYSTORE, "")
    if not root or not Path(root).is_dir():
        return
    files = [each for name in ("ledger.jsonl", "enclaves/*.p7s", "enclaves/**/cert.pem")
             for each in Path(root).glob(name)]  # fmt: skip
    newest = max((each.stat().st_mtime for each in files if each.exists()), default=0.0)
    written = datetime.fromtimestamp(newest, UTC)
    clock = setting.clock or setting.now
    if written > clock + _TOLERANCE:
        text = f"it says {iso(clock)}, and '{root}' was written at {iso(written)}"
        yield CLOCK_BEHIND.found("clock", text)


def _processes(setting: Setting) -> Iterator[Finding]:
    secured_here = is_secured(setting.environment)
    rmws: dict[str, list[str]] = {}
    for process in setting.processes:
        environment = process.environment
        if _is_daemon(process):
            # Each domain has a daemon of its own; commands ask that of theirs.
            if secured_here and _domain(environment) == _domain(setting.environment):
                yield from _daemon(process, setting.environment)
        elif is_secured(environment):
            rmws.setdefault(environment.get(RMW) or DEFAULT_RMW, []).append(process.told)
            yield from _outdated(process)
        elif secured_here and _is_node_beside(process, setting.environment):
            text = f"it is in domain {_domain(environment)}, and {ENABLE} is not 'true' for it"
            yield PROCESS_UNSECURED.found(process.told, text)
    if secured_here:
        rmws.setdefault(setting.environment.get(RMW) or DEFAULT_RMW, []).append("this environment")
    if len({_vendor(rmw) for rmw in rmws}) > 1:
        text = "; ".join(f"{rmw}: {', '.join(users[:3])}" for rmw, users in sorted(rmws.items()))
        yield MIXED_VENDORS.found("RMWs", text)


def _daemon(process: Process, wanted: Mapping[str, str]) -> Iterator[Finding]:
    if not is_secured(process.environment):
        text = f"{ENABLE} is not 'true' for {process.told}"
        yield DAEMON_UNSECURED.found(process.told, text)
        return
    differing = [
        name
        for name in (KEYSTORE, ENCLAVE)
        if process.environment.get(name, "") != wanted.get(name, "")
    ]
    if differing:
        text = f"it has another {', '.join(differing)}"
        yield DAEMON_OTHER.found(process.told, text)


def _outdated(process: Process) -> Iterator[Finding]:
    root, name = process.environment.get(KEYSTORE, ""), process.environment.get(ENCLAVE, "")
    if not (root.startswith("/") and name.startswith("/")):
        return
    folder = enclave_path(Path(root), name)
    newer = [
        file
        for file in _LOADED
        if (folder / file).exists()
        and datetime.fromtimestamp((folder / file).stat().st_mtime, UTC) > process.started
    ]
    if newer:
        text = f"it runs since {iso(process.started)}; {', '.join(newer)} of {name} are newer"
        yield PROCESS_OUTDATED.found(process.told, text)


def is_secured(environment: Mapping[str, str]) -> bool:
    """Whether security is on."""
    return environment.get(ENABLE) == "true"


def _is_daemon(process: Process) -> bool:
    return any(mark in word for word in process.command for mark in _DAEMON)


def _is_node_beside(process: Process, environment: Mapping[str, str]) -> bool:
    """Whether a process is a node in the same domain, as far as its command tells."""
    return "--ros-args" in process.command and _domain(process.environment) == _domain(environment)


def _domain(environment: Mapping[str, str]) -> str:
    return environment.get(DOMAIN) or "0"


def _vendor(rmw: str) -> str:
    return "_".join(rmw.split("_")[:2])
