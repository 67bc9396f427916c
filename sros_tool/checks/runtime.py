"""Checks of environment variables, of the host, and of running processes."""

from __future__ import annotations

import difflib
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path

from sros_tool.checks.keystores.keystore import joined, keystore_findings
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.zenoh_environment import (
    PROCESS_OPEN,
    enforces_nothing,
    is_zenoh,
    named_files,
    zenoh_environment_findings,
)
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import parse_governance
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    IDENTITY,
    PERMISSIONS,
    ca_key,
    enclave_path,
    is_keystore,
    refuse_earlier,
    search_enclaves,
)
from sros_tool.pki import smime
from sros_tool.runtime.environment import enclave_argument
from sros_tool.runtime.rcl_security import choose_loadable
from sros_tool.runtime.rmw import DEFAULT_RMW, RMW
from sros_tool.runtime.variables import DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY, domain_from
from sros_tool.runtime.zenoh_environment import ROUTER_URI, SESSION_URI
from sros_tool.validity import iso
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Process:
    """A running process: its command, environment, and start time.

    ``has_loaded`` is whether it has loaded the libraries of ROS 2 or of a DDS.
    """

    pid: int
    command: tuple[str, ...]
    environment: Mapping[str, str]
    started: datetime
    has_loaded: bool = False

    @property
    def is_node(self) -> bool:
        """Whether it runs ROS nodes."""
        return self.has_loaded or "--ros-args" in self.command

    @property
    def label(self) -> str:
        """Its name in messages, such as "process 4711 (talker)"."""
        program = Path(self.command[0]).name if self.command else "?"
        return f"process {self.pid} ({_plain(program)})"


@dataclass(frozen=True, slots=True)
class RuntimeState:
    """The input of the runtime checks: environment, clock, RMWs and processes.

    ``now`` is the moment to check for; ``clock`` is the host's clock, or None if it is ``now``.
    ``rmws`` are the installed RMWs; ``insecure_rmws`` maps tried RMWs that do not enforce security
    to the observed result.  ``zone`` is the host's time zone.
    """

    environment: Mapping[str, str]
    now: datetime
    zone: tzinfo = UTC
    processes: tuple[Process, ...] = ()
    rmws: tuple[str, ...] = ()
    insecure_rmws: Mapping[str, str] = field(default_factory=dict)
    clock: datetime | None = None


def _plain(text: str) -> str:
    """Return a text that a process chose, so that it can be taken for nothing else in a message."""
    return re.sub(r"[^\w.+/ -]", "?", text[:_LONGEST])


_LONGEST = 40


def running_processes(now: datetime, proc: Path = Path("/proc")) -> Iterator[Process]:
    """Yield the processes whose environment this user may read, except this process.

    ``now`` is the time on the clock of this machine.
    """
    ticks = os.sysconf("SC_CLK_TCK")
    begin = now - timedelta(seconds=time.clock_gettime(time.CLOCK_BOOTTIME))
    for folder in sorted(proc.glob("[0-9]*"), key=lambda each: int(each.name)):
        if int(folder.name) == os.getpid():
            continue
        with suppress(OSError, ValueError, IndexError):
            environment = dict(
                word.split("=", 1) for word in _words(folder / "environ") if "=" in word
            )
            # The command may hold spaces and parentheses; numbers follow the last parenthesis.
            numbers = (folder / "stat").read_text().rpartition(")")[2].split()
            started = begin + timedelta(seconds=int(numbers[19]) / ticks)
            command = tuple(_words(folder / "cmdline"))
            has_loaded = bool(_LIBRARIES.search((folder / "maps").read_text(errors="replace")))
            yield Process(int(folder.name), command, environment, started, has_loaded)


def _words(path: Path) -> list[str]:
    text = path.read_bytes().decode("utf-8", "replace")
    return [word for word in text.split("\0") if word]


RMW_NOT_INSTALLED = FindingKind(
    "runtime.rmw-not-installed",
    ERROR,
    "RMW_IMPLEMENTATION names an RMW that is not installed",
    "No node starts.",
    "rmw_implementation 2.15 (functions.cpp).",
    "Install it, or set RMW_IMPLEMENTATION to an installed RMW.",
)
RMW_INSECURE = FindingKind(
    "runtime.rmw-without-security",
    ERROR,
    "an RMW that does not enforce DDS Security",
    "The RMW was built without security, or does not use DDS. Nodes fail, or run unsecured.",
    "Found by a test (`sros doctor`).",
    "Use an RMW that enforces security according to `sros doctor`.",
)
CLOCK_BEHIND = FindingKind(
    "runtime.clock-behind",
    ERROR,
    "the clock of this host is behind",
    "The keystore's files were written later than the clock shows. Certificates may not be valid "
    "yet, and expired ones may seem valid.",
    "RFC 5280, 6.1.3 (the current time); robots without a battery for their clock.",
    "Set the clock before nodes start, for instance by chrony with makestep.",
)
DAEMON_UNSECURED = FindingKind(
    "runtime.daemon-unsecured",
    WARNING,
    "the ros2 daemon runs without security",
    "`ros2 topic list` and other commands ask the daemon. It cannot see secured nodes, so the "
    "graph seems empty.",
    "ros2cli 0.32 (daemon); it keeps the environment in which it was started.",
    "Run `ros2 daemon stop`; the next command starts it again, with this environment.",
)
DAEMON_OTHER = FindingKind(
    "runtime.daemon-differs",
    WARNING,
    "the ros2 daemon runs with another keystore or enclave",
    "`ros2 topic list` and other commands ask the daemon, and show only what its enclave may see.",
    "ros2cli 0.32 (daemon); it keeps the environment in which it was started.",
    "Run `ros2 daemon stop`; the next command starts it again, with this environment.",
)
PROCESS_UNSECURED = FindingKind(
    "runtime.process-unsecured",
    WARNING,
    "a node without security next to secured nodes",
    "This node and the secured nodes do not see each other.",
    "DDS-Security 1.1, 9.4.1.2 (allow_unauthenticated_participants is false).",
    "Start it with `sros run ROOT NAME -- COMMAND...`.",
)
PROCESS_RUNS_UNSECURED = FindingKind(
    "runtime.process-runs-unsecured",
    ERROR,
    "a node that asks for security and runs without it",
    "Its ROS_SECURITY_STRATEGY is not exactly `Enforce`, so rcl starts it unsecured where its "
    "enclave or a file of it is missing: everybody on the network hears it and can send to it.",
    "rcl 9 (rcl/src/rcl/security.c), rmw_dds_common (security.cpp); ran with ROS 2 Jazzy.",
    "Stop it, and start it with `sros run ROOT NAME -- COMMAND...`.",
)
PROCESS_OUTDATED = FindingKind(
    "runtime.process-outdated",
    WARNING,
    "a process that started before its enclave's files changed",
    "A running participant does not notice changed certificates, permissions or revocation lists.",
    "Fast DDS 2.14.5, Cyclone DDS 0.10.2 (read at the start).",
    "Restart the process.",
)
MIXED_VENDORS = FindingKind(
    "runtime.mixed-vendors",
    WARNING,
    "secured processes on different RMWs",
    "In these versions, secured nodes on different DDS vendors do not communicate, and do not "
    "report it.",
    "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Use the same RMW for all secured nodes that communicate.",
)

NOT_SECURED = FindingKind(
    "runtime.not-secured",
    NOTE,
    "security is not enabled here: nodes start open",
    "Everybody on the network hears these nodes and can send to them. That nothing else is found "
    "here says nothing about their security.",
    "rcl 9 (rcl/src/rcl/security.c); ran with ROS 2 Jazzy.",
    "Start nodes with `sros run ROOT NAME -- COMMAND...`, or set the variables with "
    '`eval "$(sros env ROOT NAME)"`.',
    prominent=True,
)

_MOST_NODES = 20
_NOT_DDS = ("rmw_email", "rmw_iceoryx")
_ZENOH_ROUTER = "rmw_zenohd"
_DAEMON = ("_ros2_daemon", "ros2cli.daemon", "ros2-daemon")
_LIBRARIES = re.compile(r"/lib(?:rcl|ddsc|fastrtps|fastdds)\.so")
_TOLERANCE = timedelta(minutes=2)
_LOADED = ("cert.pem", "permissions.p7s", "governance.p7s", "crl.pem", "identity_ca.cert.pem")


def _check_host(state: RuntimeState) -> Iterator[Finding]:
    """Yield findings about the RMW, the clock, and the running processes."""
    yield from _rmw(state)
    yield from zenoh_environment_findings(state.environment)
    yield from _clock(state)
    yield from _processes(state)


def _rmw(state: RuntimeState) -> Iterator[Finding]:
    chosen = state.environment.get(RMW, "")
    if chosen and state.rmws and chosen not in state.rmws:
        text = f"{RMW} is {chosen}; installed: {', '.join(state.rmws)}"
        yield RMW_NOT_INSTALLED.found(RMW, text)
    if not _is_secured(state.environment):
        return
    used = chosen or DEFAULT_RMW
    if used.startswith(_NOT_DDS):
        yield RMW_INSECURE.found(used, f"{used} does not use DDS")
    elif used in state.insecure_rmws:
        yield RMW_INSECURE.found(used, state.insecure_rmws[used])


def _clock(state: RuntimeState) -> Iterator[Finding]:
    root = state.environment.get(KEYSTORE, "")
    if not root or not Path(root).is_dir():
        return
    files = [each for name in ("ledger.jsonl", "enclaves/*.p7s", "enclaves/**/cert.pem")
             for each in Path(root).glob(name)]  # fmt: skip
    newest = max((each.stat().st_mtime for each in files if each.exists()), default=0.0)
    written = datetime.fromtimestamp(newest, UTC)
    clock = state.clock or state.now
    if written > clock + _TOLERANCE:
        text = f"the clock shows {iso(clock)}, but '{root}' was written at {iso(written)}"
        yield CLOCK_BEHIND.found("clock", text)


def _processes(state: RuntimeState) -> Iterator[Finding]:
    secured_here = _is_secured(state.environment)
    secured = [each.environment for each in state.processes if _is_secured(each.environment)]
    domains = {_domain(each) for each in [*secured, *([state.environment] if secured_here else [])]}
    open_nodes: list[str] = []
    rmws: dict[str, list[str]] = {}
    for process in state.processes:
        environment = process.environment
        if _is_daemon(process):
            # Each domain has its own daemon; commands ask the daemon of their domain.
            if secured_here and _domain(environment) == _domain(state.environment):
                yield from _daemon(process, state.environment)
        elif _is_secured(environment):
            rmws.setdefault(environment.get(RMW) or DEFAULT_RMW, []).append(process.label)
            yield from _outdated(process)
            yield from _runs_unsecured(process)
            yield from _zenoh_process(process)
        elif process.is_node and _domain(environment) in domains:
            text = f"in domain {_plain(_domain(environment))}, with {ENABLE} not 'true'"
            yield PROCESS_UNSECURED.found(process.label, text)
        elif process.is_node and _is_open(environment):
            open_nodes.append(f"{process.label} in domain {_plain(_domain(environment))}")
    yield from _not_secured(state.environment, open_nodes)
    if secured_here:
        rmws.setdefault(state.environment.get(RMW) or DEFAULT_RMW, []).append("this environment")
    if len({_vendor(rmw) for rmw in rmws}) > 1:
        text = "; ".join(f"{rmw}: {', '.join(users[:3])}" for rmw, users in sorted(rmws.items()))
        yield MIXED_VENDORS.found("RMWs", text)


def _daemon(process: Process, wanted: Mapping[str, str]) -> Iterator[Finding]:
    if not _is_secured(process.environment):
        text = f"{ENABLE} is not 'true' in the environment of {process.label}"
        yield DAEMON_UNSECURED.found(process.label, text)
        return
    differing = [
        name
        for name in (KEYSTORE, ENCLAVE)
        if process.environment.get(name, "") != wanted.get(name, "")
    ]
    if differing:
        text = f"{', '.join(differing)} differ from this environment"
        yield DAEMON_OTHER.found(process.label, text)


def _outdated(process: Process) -> Iterator[Finding]:
    if is_zenoh(process.environment):
        loaded = [path for _, path in named_files(process.environment) if path.is_absolute()]
        text = ", ".join(str(each) for each in loaded if _is_newer(each, process.started))
        if text:
            yield PROCESS_OUTDATED.found(
                process.label, f"it started at {iso(process.started)}; {text} changed later"
            )
        return
    root, name = process.environment.get(KEYSTORE, ""), process.environment.get(ENCLAVE, "")
    if not (root.startswith("/") and name.startswith("/")):
        return
    folder = enclave_path(Path(root), name)
    newer = [file for file in _LOADED if _is_newer(folder / file, process.started)]
    if newer:
        text = f"it started at {iso(process.started)}; {', '.join(newer)} of {name} changed later"
        yield PROCESS_OUTDATED.found(process.label, text)


def _is_newer(path: Path, started: datetime) -> bool:
    with suppress(OSError, ValueError):
        return datetime.fromtimestamp(path.stat().st_mtime, UTC) > started
    return False


def _zenoh_process(process: Process) -> Iterator[Finding]:
    is_router = any(_ZENOH_ROUTER in Path(word).name for word in process.command[:3])
    if is_zenoh(process.environment) and (is_router or "--ros-args" in process.command):
        variable = ROUTER_URI if is_router else SESSION_URI
        if why := enforces_nothing(process.environment, variable):
            yield PROCESS_OPEN.found(process.label, why)


def _runs_unsecured(process: Process) -> Iterator[Finding]:
    environment = process.environment
    root = environment.get(KEYSTORE, "")
    if not process.is_node or (root and not Path(root).is_absolute()):
        return
    with suppress(SrosError):  # with Enforce it did not start, or its files are gone since
        choice = choose_loadable(environment, enclave_argument(process.command))
        if choice.enclave is None:
            yield PROCESS_RUNS_UNSECURED.found(process.label, choice.note)


def _is_secured(environment: Mapping[str, str]) -> bool:
    """Return whether security is on."""
    return environment.get(ENABLE) == "true"


def _is_open(environment: Mapping[str, str]) -> bool:
    """Return whether security is off, and a session file of rmw_zenoh does not replace it."""
    if _is_secured(environment):
        return False
    return not is_zenoh(environment) or bool(enforces_nothing(environment, SESSION_URI))


def _not_secured(environment: Mapping[str, str], nodes: list[str]) -> Iterator[Finding]:
    """Yield a finding, with the open nodes that run, unless the variables ask for security."""
    asks = environment.get(ENABLE) not in (None, "", "false") or _asks_in_vain(environment)
    if asks or not _is_open(environment):
        return
    more = f" and {len(nodes) - _MOST_NODES} more" if len(nodes) > _MOST_NODES else ""
    running = f"; running without it: {', '.join(nodes[:_MOST_NODES])}{more}" if nodes else ""
    yield NOT_SECURED.found(ENABLE, _value(environment, ENABLE) + running)


def _is_daemon(process: Process) -> bool:
    return any(mark in word for word in process.command for mark in _DAEMON)


def _domain(environment: Mapping[str, str]) -> str:
    return environment.get(DOMAIN) or "0"


def _vendor(rmw: str) -> str:
    return "_".join(rmw.split("_")[:2])


_RCL = "rcl 9 (rcl/src/rcl/security.c); ran with ROS 2 Jazzy."
_NAME_IT = (
    "Start each process with `sros run ROOT NAME -- COMMAND...`, or set its enclave in the launch "
    "file."
)
_ENV = '`eval "$(sros env ROOT NAME)"` sets all variables.'

ENABLE_MISSPELT = FindingKind(
    "runtime.enable-misspelt",
    ERROR,
    "ROS_SECURITY_ENABLE is neither true nor false",
    "Only the exact value `true` enables security. With any other value every node runs "
    "unsecured, and does not report it.",
    _RCL,
    f"Write ROS_SECURITY_ENABLE=true. {_ENV}",
)
NOT_ENABLED = FindingKind(
    "runtime.not-enabled",
    WARNING,
    "security is configured but not enabled",
    "Without ROS_SECURITY_ENABLE=true every node runs unsecured, whatever the other variables are.",
    _RCL,
    f"Write ROS_SECURITY_ENABLE=true, or unset the other variables. {_ENV}",
)
MISSPELT = FindingKind(
    "runtime.variable-misspelt",
    ERROR,
    "a misspelt or obsolete variable, which ROS 2 ignores",
    "The name looks like a typo, or an old name, of a variable that rcl reads. rcl ignores it "
    "without a message.",
    _RCL,
    "Correct the name.",
)
STRATEGY_MISSPELT = FindingKind(
    "runtime.strategy-misspelt",
    ERROR,
    "ROS_SECURITY_STRATEGY is neither Enforce nor Permissive",
    "Only the exact value `Enforce` enforces security. With any other value a node whose enclave "
    "is missing runs unsecured.",
    _RCL,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_ENV}",
)
NOT_ENFORCED = FindingKind(
    "runtime.not-enforced",
    WARNING,
    "security is enabled but not enforced",
    "A node runs unsecured if its enclave or one of its files is missing, even if it logs that it "
    "found a security directory.",
    _RCL,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_ENV}",
)
KEYSTORE_UNSET = FindingKind(
    "runtime.keystore-unset",
    ERROR,
    "security is enabled, but ROS_SECURITY_KEYSTORE is not set",
    'With Enforce no node starts (rcl says "error not set"); without Enforce every node runs '
    "unsecured.",
    _RCL,
    f"Set ROS_SECURITY_KEYSTORE. {_ENV}",
)
KEYSTORE_NOT_FOUND = FindingKind(
    "runtime.keystore-not-found",
    ERROR,
    "ROS_SECURITY_KEYSTORE is not a keystore",
    "With Enforce no node starts; without Enforce every node runs unsecured.",
    _RCL,
    f"Correct the path. {_ENV}",
)
KEYSTORE_RELATIVE = FindingKind(
    "runtime.keystore-relative",
    WARNING,
    "ROS_SECURITY_KEYSTORE is a relative path",
    "Each process resolves the path in its working directory, so a service, for instance, looks "
    "in another folder.",
    _RCL,
    f"Write the absolute path. {_ENV}",
)
ENCLAVE_NOT_FOUND = FindingKind(
    "runtime.enclave-not-found",
    ERROR,
    "the enclave is not in the keystore",
    "With Enforce the node does not start; without Enforce it runs unsecured. Names are "
    "case-sensitive.",
    _RCL,
    "Correct the name, or create the enclave with `sros create_enclave`.",
)
NO_ENCLAVE = FindingKind(
    "runtime.enclave-unset",
    WARNING,
    "ROS_SECURITY_ENCLAVE_OVERRIDE is not set",
    "A process without `--ros-args --enclave NAME` uses the enclave /, which the keystore does "
    "not have, and does not start.",
    _RCL,
    _NAME_IT,
)
UNSECURED_WITHOUT_ENCLAVE = FindingKind(
    "runtime.unsecured-without-enclave",
    ERROR,
    "ROS_SECURITY_ENCLAVE_OVERRIDE is not set, and nodes run unsecured",
    "A process without `--ros-args --enclave NAME` uses the enclave /, which the keystore does "
    "not have. It runs UNSECURED, because ROS_SECURITY_STRATEGY is not exactly `Enforce`.",
    _RCL,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_NAME_IT}",
)
DOMAIN_MALFORMED = FindingKind(
    "runtime.domain-malformed",
    ERROR,
    "ROS_DOMAIN_ID is not a valid domain id",
    "Nodes do not start; if the value has a leading zero, they read it as octal and join another "
    "domain.",
    "rcl 9 (rcl/src/rcl/domain_id.c: strtoul with base 0); Cyclone DDS refuses domains above 230.",
    "Write one whole number from 0 to 230, without leading zeros.",
)
DOMAIN_NOT_GOVERNED = FindingKind(
    "runtime.domain-not-governed",
    ERROR,
    "the keystore does not cover this domain",
    'No node starts: Fast DDS says "Not found topic access rule for topic ros_discovery_info", '
    'Cyclone DDS "Could not find domain in governance".',
    "DDS-Security 1.1, 9.4.1.2; measured.",
    "Set ROS_DOMAIN_ID to a domain of the keystore, or make a keystore for this domain with `sros "
    "create_keystore --domain`.",
)
CA_KEY_HERE = FindingKind(
    "runtime.ca-key-present",
    NOTE,
    "nodes use the keystore that holds the CA keys",
    "An attacker who takes over a node can create any enclave, with any rights.",
    "ROS 2 design, ROS 2 Security Enclaves; NIST SP 800-57 part 1, 6.",
    "Run nodes with an export (`sros distribute_key`), and keep this keystore elsewhere.",
)

_READ = (
    ENABLE, STRATEGY, KEYSTORE, ENCLAVE, DOMAIN, "RMW_IMPLEMENTATION", "ROS_SECURITY_LOG_FILE",
    "ROS_SECURITY_LOG_VERBOSITY", "ROS_SECURITY_LOG_PUBLISH",
)  # fmt: skip
_OLD = {
    "ROS_SECURITY_ROOT_DIRECTORY": KEYSTORE,
    "ROS_SECURITY_NODE_DIRECTORY": ENCLAVE,
    "ROS_SECURITY_LOOKUP_TYPE": ENCLAVE,
}
_CLOSE = 0.88


def _check_variables(state: RuntimeState) -> Iterator[Finding]:
    """Yield findings about the environment variables and the enclave that they name."""
    environment = state.environment
    yield from _spelling(environment)
    if environment.get(ENABLE) != "true":
        return
    if environment.get(STRATEGY) != "Enforce" and environment.get(STRATEGY) in (
        None, "", "Permissive",
    ):  # fmt: skip
        yield NOT_ENFORCED.found(STRATEGY, _value(environment, STRATEGY))
    domain: int | None = None
    try:
        domain = domain_from(environment) or 0
    except SrosError as error:
        yield DOMAIN_MALFORMED.found(DOMAIN, error.what, remedy=error.remedy)
    text = environment.get(KEYSTORE, "")
    if not text:
        yield KEYSTORE_UNSET.found(KEYSTORE, _value(environment, KEYSTORE))
        return
    root = Path(text)
    if not root.is_absolute():
        yield KEYSTORE_RELATIVE.found(KEYSTORE, _value(environment, KEYSTORE))
    if not is_keystore(root):
        missing = "does not exist" if not root.exists() else "has no enclaves folder with content"
        remedy = ""
        try:
            refuse_earlier(root)
        except KeystoreError as error:
            missing, remedy = f"is not read. {error.why}".rstrip("."), error.remedy
        yield KEYSTORE_NOT_FOUND.found(KEYSTORE, f"'{root}' {missing}", remedy=remedy)
        return
    yield from _enclave(state, root, domain)


def _asks_in_vain(environment: Mapping[str, str]) -> list[str]:
    """Return the variables that configure security, where nothing says whether to enable it."""
    if ENABLE in environment:
        return []
    return [name for name in (STRATEGY, KEYSTORE, ENCLAVE) if environment.get(name)]


def _spelling(environment: Mapping[str, str]) -> Iterator[Finding]:
    enable, strategy = environment.get(ENABLE), environment.get(STRATEGY)
    if enable not in (None, "", "true", "false"):
        yield ENABLE_MISSPELT.found(ENABLE, _value(environment, ENABLE))
    elif named := _asks_in_vain(environment):
        yield NOT_ENABLED.found(
            ENABLE,
            f"{' and '.join(named)} {'is' if len(named) == 1 else 'are'} set, and {ENABLE} is not",
        )
    if strategy not in (None, "", "Enforce", "Permissive"):
        yield STRATEGY_MISSPELT.found(STRATEGY, _value(environment, STRATEGY))
    for name in sorted(environment):
        if name in _READ or not name.upper().startswith(("ROS", "RMW")):
            continue
        close = difflib.get_close_matches(name.upper(), _READ, n=1, cutoff=_CLOSE)
        meant = _OLD.get(name) or (close[0] if close else "")
        if meant:
            yield MISSPELT.found(name, f"{name} is set; ROS 2 reads {meant}")


def _enclave(state: RuntimeState, root: Path, domain: int | None) -> Iterator[Finding]:
    names, wanted = set(search_enclaves(root)[0]), state.environment.get(ENCLAVE, "")
    governed = _governed(root)
    if governed and domain is not None and domain not in governed:
        text = f"the governance of '{root}' is for domain {governed}, not for {domain}"
        yield DOMAIN_NOT_GOVERNED.found(DOMAIN, text)
        domain = None  # so that it is not reported again for the enclave
    for role in (IDENTITY, PERMISSIONS):
        if (root / ca_key(role)).exists():
            yield CA_KEY_HERE.found(KEYSTORE, f"'{root / ca_key(role)}' exists")
            break
    if not wanted and "/" not in names:
        enforced = state.environment.get(STRATEGY) == "Enforce"
        kind = NO_ENCLAVE if enforced else UNSECURED_WITHOUT_ENCLAVE
        yield kind.found(ENCLAVE, f"'{root}' has no enclave /")
        return
    name = wanted or "/"
    if name not in names and not enclave_path(root, name).is_dir():
        close = difflib.get_close_matches(name, names, n=1)
        hint = f"; it has {close[0]}" if close else ""
        enforced = state.environment.get(STRATEGY) == "Enforce"
        effect = "" if enforced else f"; nodes RUN UNSECURED, as {STRATEGY} is not 'Enforce'"
        yield ENCLAVE_NOT_FOUND.found(ENCLAVE, f"'{root}' has no enclave {name}{hint}{effect}")
        return
    found = keystore_findings(root, now=state.now, zone=state.zone, domain=domain, only=(name,))
    for each in found:
        if each.id == "enclave.governance-domain":
            yield DOMAIN_NOT_GOVERNED.found(DOMAIN, each.text, each.file)
        else:
            yield each


def _governed(root: Path) -> DomainSet | None:
    """Return the domains of a keystore's governance, or None if it cannot be read."""
    try:
        signed = smime.parse(read_bytes(root / GOVERNANCE_P7S, "governance document"))
        return parse_governance(signed.document).domains().closed()
    except SrosError:  # reported for the enclave, which has its own copy in an export
        return None


def _value(environment: Mapping[str, str], name: str) -> str:
    value = environment.get(name)
    return f"{name} is not set" if value is None else f"{name} is {value!r}"


def runtime_findings(state: RuntimeState) -> list[Finding]:
    """Return all findings in an environment and on its host."""
    return joined([*_check_variables(state), *_check_host(state)])
