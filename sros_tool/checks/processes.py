"""Checks of the running processes: open, with older files, revoked, expired, or among strangers."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, tzinfo
from enum import StrEnum
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from sros_tool.checks.environment import (
    OWN_CONFIGURATION,
    PROCESS_OPEN,
    asks_in_vain,
    enforces_nothing,
    is_zenoh,
    open_because,
    value_text,
)
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.process_files import (
    LONGEST_PATH,
    PROCESS_NOT_SEEN,
    PROCESS_OUTDATED,
    certificates_in,
    file_findings,
    plain_path,
    unsecured_because,
)
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import IDENTITY_CA_FILE, enclave_path, search_enclaves
from sros_tool.pki.certificates import load_certificates
from sros_tool.prometheus import Metric, Sample
from sros_tool.runtime.environment import (
    NO_CONFIGURATION,
    OVERRIDE,
    ROUTER_URI,
    SESSION_URI,
)
from sros_tool.runtime.processes import Process, RunningProcesses, plain
from sros_tool.runtime.rmw import DEFAULT_RMW, RMW
from sros_tool.runtime.variables import DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY
from sros_tool.validity import iso
from sros_tool.wording import first_few
from sros_tool.xml import read_bytes

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
MIXED_VENDORS = FindingKind(
    "runtime.mixed-vendors",
    WARNING,
    "secured processes on different RMWs",
    "In these versions, secured nodes on different DDS vendors do not communicate, and do not "
    "report it.",
    "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Use the same RMW for all secured nodes that communicate.",
)

PROCESS_PERMISSIVE = FindingKind(
    "runtime.process-permissive",
    WARNING,
    "a process that is secured now, and would start without security",
    "Its ROS_SECURITY_STRATEGY is not exactly `Enforce`: when its enclave or a file of it is "
    "missing, it starts unsecured.",
    "rcl 9 (rcl/src/rcl/security.c); ran with ROS 2 Jazzy.",
    "Start it with `sros run ROOT NAME -- COMMAND...`.",
)
PROCESS_OTHER_KEYSTORE = FindingKind(
    "runtime.process-other-keystore",
    WARNING,
    "a secured process among those of another keystore",
    "They trust other CAs, so they do not communicate, and do not report it.",
    "DDS-Security 1.1, 8.3.2.8; Fast DDS 2.14.5 and Cyclone DDS 0.10.2, measured.",
    "Start all processes of a domain with one keystore, or give each keystore its own domain.",
)
ZENOH_UNREAD = FindingKind(
    "runtime.zenoh-process-unread",
    WARNING,
    "a process of Zenoh whose configuration sros cannot read",
    "Zenoh reads more forms than sros, such as YAML, and a process without an RMW chooses its "
    "configuration itself. It may enforce nothing: whether it does is not known.",
    "Zenoh 1.10.2, measured.",
    "Write the configuration as JSON5 objects, or start the process with the one of its enclave. "
    f"{OWN_CONFIGURATION}",
)
PROCESS_ELSEWHERE = FindingKind(
    "runtime.process-elsewhere",
    NOTE,
    "a node in another network namespace",
    "It is not next to the nodes of this network, and is compared only with those next to it.",
    "network_namespaces(7).",
    "Run `sros check runtime` in that network, too, or look whether they are meant to be there.",
    prominent=True,
)

CONTAINER_ALONE = FindingKind(
    "runtime.container-alone",
    NOTE,
    "only the processes of this container were looked at",
    "sros runs in a PID namespace, from which the other processes of the machine cannot be seen.",
    "pid_namespaces(7).",
    "Run `sros check runtime` on the machine itself, too.",
    prominent=True,
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
NODE_OPEN = FindingKind(
    "runtime.node-open",
    WARNING,
    "a node that runs open in a domain without secured nodes",
    "Everybody on the network hears it and can send to it.",
    "rcl 9 (rcl/src/rcl/security.c); ran with ROS 2 Jazzy.",
    "Start it with `sros run ROOT NAME -- COMMAND...`, or end it if nobody needs it.",
)

_MOST_NODES = 20


class Security(StrEnum):
    """The security with which a process runs, as far as it can be seen."""

    SECURED = "secured"
    OPEN = "open"
    UNKNOWN = "unknown"


def _security_of(process: Process) -> Security:
    """Return the security with which a process runs."""
    if process.is_zenoh:
        if process.configuration and process.configuration.problem:
            return Security.UNKNOWN
        try:
            return Security.OPEN if _zenoh_opening(process) else Security.SECURED
        except SrosError:
            return Security.UNKNOWN
    if not process.asks_for_security:
        return Security.OPEN
    if process.enclave and process.enclave.problem:
        return Security.UNKNOWN
    return Security.OPEN if unsecured_because(process) else Security.SECURED


def process_findings(
    environment: Mapping[str, str],
    running: RunningProcesses,
    *,
    now: datetime,
    zone: tzinfo,
    one_by_one: bool = False,
) -> Iterator[Finding]:
    """Yield the findings about running processes, from the place of an environment.

    ``now`` is the time on the clock of this machine, and ``zone`` its time zone.  If
    ``one_by_one``, each open node is a finding where security is not enabled, and else one of all.
    """
    is_secured_here = environment.get(ENABLE) == "true"
    here = ("", environment.get(DOMAIN) or "0")
    nodes = [each for each in running.processes if not each.is_daemon]
    security = {each.pid: _security_of(each) for each in nodes}
    secured = [each for each in nodes if security[each.pid] is Security.SECURED]
    closed = {_place(each) for each in nodes if each.asks_for_security}
    closed |= {here} if is_secured_here else set()
    open_nodes: list[Process] = []
    for process in running.processes:
        if process.is_daemon:
            # Each domain has its own daemon; commands ask the daemon of their domain.
            if is_secured_here and _place(process) == here:
                yield from _daemon(process, environment)
            continue
        yield from _zenoh(process)
        if process.asks_for_security:
            yield from file_findings(process, now=now, zone=zone)
            yield from _unsecured(process)
        elif security[process.pid] is Security.OPEN:
            if _place(process) in closed:
                text = f"{_where(process)}, with {ENABLE} not 'true'"
                yield PROCESS_UNSECURED.found(process.label, text)
            else:
                open_nodes.append(process)
    yield from _not_secured(environment, open_nodes, one_by_one=one_by_one)
    starts_nodes = is_secured_here and bool(environment.get(ENCLAVE))
    yield from _mixed_vendors(secured, environment if starts_nodes else None)
    yield from _other_keystores(secured, environment if is_secured_here else None)
    yield from _elsewhere(nodes, security)
    yield from _not_seen(running)


def _place(process: Process) -> tuple[str, str]:
    """Return the network and the domain of a process: whoever has the same ones is next to it."""
    return process.network, process.environment.get(DOMAIN) or "0"


def _where(process: Process) -> str:
    there = " of another network namespace" if process.network else ""
    return f"in domain {process.domain}{there}"


def _daemon(process: Process, wanted: Mapping[str, str]) -> Iterator[Finding]:
    if not process.asks_for_security:
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


# ── open ───────────────────────────────────────────────────────────────────────────────────


def _unsecured(process: Process) -> Iterator[Finding]:
    if process.is_zenoh or process.environment.get(STRATEGY) == "Enforce":
        return
    if why := unsecured_because(process):
        text = f"running without security, as {STRATEGY} is not 'Enforce': {why}"
        yield PROCESS_RUNS_UNSECURED.found(process.label, text)
    elif process.enclave and not process.enclave.problem:
        yield PROCESS_PERMISSIVE.found(
            process.label, value_text(_shown(process.environment), STRATEGY)
        )


def _shown(environment: Mapping[str, str]) -> Mapping[str, str]:
    return {name: plain(value) for name, value in environment.items() if name == STRATEGY}


def _zenoh_opening(process: Process) -> str:
    """Return why a process of Zenoh enforces nothing, as a clause, or "".

    Raises:
        SrosError: sros cannot read its configuration.
    """
    variable = ROUTER_URI if process.is_router else SESSION_URI
    text = process.environment.get(variable, "")
    if text == NO_CONFIGURATION:
        return ""
    if process.configuration is None:
        return f"{variable} is not set"
    return open_because(
        process.configuration.data, plain_path(text), process.environment.get(OVERRIDE, "")
    )


def _zenoh(process: Process) -> Iterator[Finding]:
    if not process.is_zenoh:
        return
    configuration = process.configuration
    if configuration and configuration.problem:
        named = f"'{plain_path(configuration.name)}'" if configuration.name else "its configuration"
        yield ZENOH_UNREAD.found(process.label, f"{named} cannot be read: {configuration.problem}")
        return
    if configuration and configuration.changed is None:
        named = f"'{plain_path(configuration.name)}'"
        yield ZENOH_UNREAD.found(process.label, f"{named} is not there any more")
        return
    try:
        why = _zenoh_opening(process)
    except SrosError as error:
        yield ZENOH_UNREAD.found(process.label, plain_path(str(error)))
        return
    if why and process.asks_for_security:
        yield PROCESS_OPEN.found(process.label, why)
    elif (
        configuration
        and configuration.changed
        and configuration.changed > process.started
        and not process.asks_for_security
    ):
        text = f"it started at {iso(process.started)}; {plain_path(configuration.name)} "
        yield PROCESS_OUTDATED.found(process.label, f"{text}changed later")


def _is_open(environment: Mapping[str, str]) -> bool:
    """Return whether security is off, and a session file of rmw_zenoh does not replace it."""
    if environment.get(ENABLE) == "true":
        return False
    return not is_zenoh(environment) or bool(enforces_nothing(environment, SESSION_URI))


def _not_secured(
    environment: Mapping[str, str], nodes: Sequence[Process], *, one_by_one: bool
) -> Iterator[Finding]:
    """Yield the open nodes that run; in one finding where the variables ask for no security."""
    asks = environment.get(ENABLE) not in (None, "", "false") or asks_in_vain(environment)
    if asks or not _is_open(environment):
        for each in nodes:
            if not each.network:  # the others are named as such, with their security
                yield NODE_OPEN.found(each.label, f"it runs {_where(each)}")
        return
    if one_by_one:
        for each in nodes:
            yield NOT_SECURED.found(each.label, f"it runs open {_where(each)}")
        return
    running = f"; running without it: {_some(nodes)}" if nodes else ""
    yield NOT_SECURED.found(ENABLE, value_text(environment, ENABLE) + running)


def _some(nodes: Sequence[Process]) -> str:
    return first_few([f"{node.label} {_where(node)}" for node in nodes], _MOST_NODES)


# ── next to each other ─────────────────────────────────────────────────────────────────────


def _by_place(processes: Iterable[Process]) -> Mapping[tuple[str, str], list[Process]]:
    found: dict[tuple[str, str], list[Process]] = defaultdict(list)
    for each in processes:
        found[_place(each)].append(each)
    return found


def _mixed_vendors(
    secured: Sequence[Process], environment: Mapping[str, str] | None
) -> Iterator[Finding]:
    """Yield a finding for each network and domain with secured processes of several RMWs.

    ``environment`` is this one if it asks for security, and else None.
    """
    places = dict(_by_place(secured))
    here = ("", environment.get(DOMAIN) or "0") if environment is not None else None
    if here:
        places.setdefault(here, [])
    for place, processes in places.items():
        rmws: dict[str, list[str]] = {}
        for each in processes:
            rmws.setdefault(plain(each.rmw), []).append(each.label)
        if environment is not None and place == here:
            named = environment.get(RMW) or DEFAULT_RMW
            rmws.setdefault(named, []).append("this environment")
        if len({"_".join(rmw.split("_")[:2]) for rmw in rmws}) > 1:
            text = "; ".join(f"{rmw}: {', '.join(of[:3])}" for rmw, of in sorted(rmws.items()))
            yield MIXED_VENDORS.found("RMWs", text)


def _other_keystores(
    secured: Sequence[Process], environment: Mapping[str, str] | None
) -> Iterator[Finding]:
    """Yield the processes of DDS that trust another identity CA than most next to them.

    In the place of ``environment``, they trust another one than its enclave.
    """
    here = ("", environment.get(DOMAIN) or "0") if environment is not None else None
    own = _authorities_here(environment) if environment is not None else frozenset()
    for place, processes in _by_place(secured).items():
        groups = _by_authorities(each for each in processes if not each.is_zenoh)
        if own and place == here:
            main = f"this environment has '{plain((environment or {})[KEYSTORE], LONGEST_PATH)}'"
            others = [group for keys, group in groups if not keys & own]
        else:
            if len(groups) < 2:
                continue
            (_, largest), *more = sorted(groups, key=lambda each: -len(each[1]))
            main = f"{largest[0].label} {_where(largest[0])} has '{_keystore(largest[0])}'"
            others = [group for _, group in more]
        for process in (each for group in others for each in group):
            text = f"it has keystore '{_keystore(process)}', and {main}"
            yield PROCESS_OTHER_KEYSTORE.found(process.label, text)


def _keystore(process: Process) -> str:
    return plain(process.environment.get(KEYSTORE, ""), LONGEST_PATH)


_Keys = frozenset[bytes]
"""The public keys of identity CAs."""


def _by_authorities(processes: Iterable[Process]) -> list[tuple[_Keys, list[Process]]]:
    """Group processes that trust a common identity CA; those whose CA is not known are left out."""
    groups: list[tuple[_Keys, list[Process]]] = []
    for process in processes:
        keys = _keys(certificates_in(process.enclave, IDENTITY_CA_FILE) if process.enclave else ())
        if keys:
            together = [process]
            for of, group in [each for each in groups if each[0] & keys]:
                groups.remove((of, group))
                keys, together = keys | of, [*group, *together]
            groups.append((keys, together))
    return groups


def _authorities_here(environment: Mapping[str, str]) -> _Keys:
    """Return the identity CAs of the enclave that an environment names, or else of the first."""
    root = Path(environment.get(KEYSTORE, ""))
    name = environment.get(ENCLAVE) or next(iter(search_enclaves(root)[0]), "/")
    folder = enclave_path(root, name)
    with suppress(SrosError):  # other findings say what is wrong there
        file = folder / IDENTITY_CA_FILE
        return _keys(load_certificates(read_bytes(file, "CA certificate"), str(file)))
    return frozenset()


def _keys(certificates: Iterable[x509.Certificate]) -> _Keys:
    found = set()
    for each in certificates:
        with suppress(ValueError, UnsupportedAlgorithm):
            found.add(each.public_key().public_bytes(*_FORM))
    return frozenset(found)


_FORM = (Encoding.DER, PublicFormat.SubjectPublicKeyInfo)


def _elsewhere(nodes: Sequence[Process], security: Mapping[int, Security]) -> Iterator[Finding]:
    for each in nodes:
        if each.network:
            text = f"{security[each.pid]}, in domain {each.domain} of {each.network}"
            yield PROCESS_ELSEWHERE.found(each.label, text)


def _not_seen(running: RunningProcesses) -> Iterator[Finding]:
    """Yield what could not be looked at: nodes by their names, and the number of the others."""
    for each in running.unseen:
        if each.speaks:
            text = f"it speaks ROS 2, and cannot be looked at: {each.why}"
            yield PROCESS_NOT_SEEN.found(each.label, text)
    others = [each for each in running.unseen if not each.speaks]
    reasons = [running.hidden] if running.hidden else []
    if others:
        why = ", ".join(sorted({each.why for each in others})[:3])
        count = f"{len(others)} processes" if len(others) > 1 else others[0].label
        reasons.append(f"{count}, of which it is not known whether they are nodes ({why})")
    if running.container:
        text = f"{len(running.processes)} of them speak ROS 2"
        yield CONTAINER_ALONE.found("processes", text)
    if reasons:
        yield PROCESS_NOT_SEEN.found("processes", "; ".join(reasons))


# ── metrics ───────────────────────────────────────────────────────────────────────────────


def runtime_metrics(
    environment: Mapping[str, str], running: RunningProcesses, *, now: datetime, zone: tzinfo
) -> tuple[Metric, ...]:
    """Return the metrics of the processes that run, from the place of an environment."""
    security = Counter(_security_of(each) for each in running.processes)
    findings = process_findings(environment, running, now=now, zone=zone)
    kinds = Counter((each.severity, each.id) for each in findings)
    return (
        Metric(
            "sros_processes",
            "Number of processes that speak ROS 2 by their security (secured, open or unknown).",
            tuple(Sample(security[each], {"security": each.value}) for each in Security),
        ),
        Metric(
            "sros_processes_not_seen",
            "Number of processes that could not be looked at, which may be nodes.",
            (Sample(len(running.unseen) + bool(running.hidden)),),
        ),
        Metric(
            "sros_process_findings",
            "Number of findings of `sros check runtime` about processes by the id of their kind.",
            tuple(
                Sample(number, {"severity": severity.word, "id": identity})
                for (severity, identity), number in sorted(kinds.items())
            ),
        ),
        Metric(
            "sros_processes_examined_timestamp_seconds",
            "When the processes were examined, in seconds since 1970.",
            (Sample(int(now.timestamp())),),
        ),
    )
