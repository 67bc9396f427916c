"""How each finding about the runtime comes about: what is changed in a sound state."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from sros_tool.checks.runtime import RuntimeState
from sros_tool.dds.permissions import parse_permissions
from sros_tool.pki import smime
from sros_tool.pki.certificates import pem
from sros_tool.runtime.processes import (
    FileReader,
    MappedLibrary,
    MemoryPort,
    Process,
    ProcessRoot,
    RunningProcesses,
    UnseenProcess,
    with_files,
)
from sros_tool.validity import parse_iso
from tests.checks import zenoh_cases
from tests.checks.bench import DAY, SECRET, Bench
from tests.support import zenoh_configurations
from tests.support.harness import sros

Change = Callable[[RuntimeState, Bench], RuntimeState]

ENABLE, STRATEGY = "ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY"
KEYSTORE, ENCLAVE = "ROS_SECURITY_KEYSTORE", "ROS_SECURITY_ENCLAVE_OVERRIDE"
DOMAIN, RMW = "ROS_DOMAIN_ID", "RMW_IMPLEMENTATION"
UNSECURED = {DOMAIN: "0"}
SESSION, OVERRIDE = "ZENOH_SESSION_CONFIG_URI", "ZENOH_CONFIG_OVERRIDE"
TLS = "transport/link/tls"
PATHS = (
    "root_ca_certificate",
    *(
        f"{side}_{what}"
        for side in ("listen", "connect")
        for what in ("private_key", "certificate")
    ),
)

FILES = {
    "ca_certificate": "identity_ca.cert.pem",
    "private_key": "key.pem",
    "certificate": "cert.pem",
}


def sound_state(bench: Bench) -> RuntimeState:
    """A host on which everything is as `sros env` sets it, with a node and the daemon running."""
    environment = {
        KEYSTORE: str(bench.root),
        ENABLE: "true",
        STRATEGY: "Enforce",
        ENCLAVE: "/base",
        DOMAIN: "0",
        RMW: "rmw_fastrtps_cpp",
        "ROS_DISTRO": "jazzy",
        "ROS_VERSION": "2",
        "ROS_PYTHON_VERSION": "3",
        "ROS_LOG_DIR": "/var/log/ros",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "ROS_SECURITY_LOG_FILE": "/var/log/ros/security.log",
        "PATH": "/usr/bin",
    }
    started = bench.now + timedelta(hours=1)
    node = Process(7, ("/usr/bin/talker", "--ros-args"), environment, started)
    daemon = Process(8, ("python3", "-c", "from ros2cli.daemon import main"), environment, started)
    rmws = ("rmw_fastrtps_cpp", "rmw_cyclonedds_cpp", "rmw_zenoh_cpp")
    return with_processes(RuntimeState(environment, started, rmws=rmws), node, daemon)


def with_processes(state: RuntimeState, *processes: Process) -> RuntimeState:
    """The state with other processes."""
    return replace(state, running=replace(state.running, processes=processes))


def seen(state: RuntimeState) -> RuntimeState:
    """The state with the files that its processes name, as they are now."""
    handle = os.open("/", os.O_PATH)
    root = ProcessRoot(handle, FileReader())
    try:
        filled = [with_files(each, root, "") for each in state.running.processes]
    finally:
        os.close(handle)
    return with_processes(state, *filled)


def having(**variables: str | None) -> Change:
    """Variables set, or with None unset."""

    def change(state: RuntimeState, _: Bench) -> RuntimeState:
        environment = {**state.environment, **variables}
        return replace(state, environment={n: v for n, v in environment.items() if v is not None})

    return change


def running(index: int, **variables: str | None) -> Change:
    """The same for one of the processes."""

    def change(state: RuntimeState, bench: Bench) -> RuntimeState:
        process = state.running.processes[index]
        alone = replace(state, environment=process.environment)
        return changed(index, environment=having(**variables)(alone, bench).environment)(
            state, bench
        )

    return change


def changed(index: int, **fields: Any) -> Change:
    """One of the processes with other values."""

    def change(state: RuntimeState, _: Bench) -> RuntimeState:
        processes = list(state.running.processes)
        processes[index] = replace(processes[index], **fields)
        return with_processes(state, *processes)

    return change


def on_fast_dds(folder: str, version: str) -> Change:
    """A process that has mapped a release of Fast DDS; "" is one whose name does not show it."""
    path = f"{folder}/libfastrtps.so.{version}".rstrip(".")
    return changed(0, dds=(MappedLibrary("Fast DDS", version, path),))


def _written_in_the_future(state: RuntimeState, bench: Bench) -> RuntimeState:
    moment = (state.now + timedelta(days=3)).timestamp()
    os.utime(bench.path("ledger.jsonl"), (moment, moment))
    return state


def _for_lyrical(state: RuntimeState, bench: Bench) -> RuntimeState:
    words = ("update_keystore", bench.root, "--set", "distributions=kilted,lyrical")
    sros(*words, env={"SROS_CA_PASSPHRASE": SECRET}).ok()
    return having(**{KEYSTORE: str(bench.root)})(state, bench)


def _written_since(state: RuntimeState, bench: Bench) -> RuntimeState:
    return changed(0, started=state.now - timedelta(days=2))(state, bench)


def _at_the_end(state: RuntimeState, bench: Bench, **variables: str | None) -> RuntimeState:
    """An hour before the permissions expire."""
    grant = parse_permissions(smime.parse(_of(state, "permissions.p7s").read_bytes()).document)
    moment = parse_iso(grant.grants[0].not_after) - timedelta(hours=1)
    return replace(running(0, **variables)(state, bench), now=moment)


def _of(state: RuntimeState, file: str) -> Path:
    """A file of the enclave of the first process."""
    environment = state.running.processes[0].environment
    return Path(f"{environment[KEYSTORE]}/enclaves{environment[ENCLAVE]}", file)


def _revoked(state: RuntimeState, bench: Bench) -> RuntimeState:
    bench.revoke(bench.certificate().serial_number)
    shutil.copy(bench.path("public/identity_ca.crl.pem"), _of(state, "crl.pem"))
    return state


def _others_can_write(state: RuntimeState, _: Bench) -> RuntimeState:
    _of(state, "..").resolve().chmod(0o777)
    return state


def _others_can_read_the_key(state: RuntimeState, _: Bench) -> RuntimeState:
    _of(state, "key.pem").chmod(0o640)
    return state


def _among_strangers(state: RuntimeState, bench: Bench) -> RuntimeState:
    other = bench.root.parent / "of others"
    shutil.copytree(state.environment[KEYSTORE], other)
    (other / "enclaves/base/identity_ca.cert.pem").write_bytes(pem(bench.new_authority()[0]))
    return running(0, **{KEYSTORE: str(other)})(state, bench)


def _not_connected(state: RuntimeState, _: Bench) -> RuntimeState:
    """Two processes of one keystore, with ports in shared memory that the other has not mapped."""
    node = replace(state.running.processes[0], libraries=frozenset({"libfastrtps", "librcl"}))
    ports = [frozenset({MemoryPort(7411 + 2 * number, "00:1b", number)}) for number in (1, 2)]
    nodes = [
        replace(node, pid=number, own_ports=own, mapped_ports=own)
        for number, own in enumerate(ports, start=21)
    ]
    return replace(with_processes(state, *nodes), now=state.now + timedelta(minutes=1))


def _from_an_older_copy(state: RuntimeState, bench: Bench) -> RuntimeState:
    older = bench.root.parent / "older"
    shutil.copytree(state.environment[KEYSTORE], older)
    (older / "enclaves/base/governance.p7s").write_text("of before")
    return running(0, **{KEYSTORE: str(older)})(state, bench)


def _from_a_copy(state: RuntimeState, bench: Bench) -> RuntimeState:
    """The copy has the same files."""
    copy = shutil.copytree(state.environment[KEYSTORE], bench.root.parent / "copy")
    node = state.running.processes[0]
    thief = replace(node, pid=6, environment={**node.environment, KEYSTORE: str(copy)})
    return with_processes(state, thief, node, replace(node, pid=9))


def _unseen(state: RuntimeState, _: Bench) -> RuntimeState:
    unseen = UnseenProcess(9, ("/sbin/init",), "Permission denied", uses_ros=False)
    return replace(state, running=RunningProcesses(unseen=(unseen,)))


def _without_ca_keys(state: RuntimeState, bench: Bench) -> RuntimeState:
    return having(**{KEYSTORE: str(bench.export())})(state, bench)


def on_zenoh(text: str | None = None, **variables: str | None) -> Change:
    """Everything on rmw_zenoh_cpp, with an unsigned session file as sros writes it, or a text."""

    def change(state: RuntimeState, bench: Bench) -> RuntimeState:
        file = _of(state, "session.json5")
        file.write_text(json.dumps(zenoh_cases.sound()) if text is None else text)
        paths = {name: _of(state, FILES[name.partition("_")[2]]) for name in PATHS}
        stated = {
            RMW: "rmw_zenoh_cpp",
            SESSION: str(file),
            OVERRIDE: ";".join(f'{TLS}/{name}="{path}"' for name, path in paths.items()),
            **variables,
        }
        old = (state.now - timedelta(days=1)).timestamp()
        os.utime(file, (old, old))
        for index in range(len(state.running.processes)):
            state = running(index, **stated)(state, bench)
        return having(**stated)(state, bench)

    return change


def session_written_since(state: RuntimeState, bench: Bench) -> RuntimeState:
    return _written_since(on_zenoh()(state, bench), bench)


def old_rmw_zenoh(state: RuntimeState, bench: Bench) -> RuntimeState:
    installed = zenoh_configurations.with_rmw_zenoh(bench.root.parent / "ros", "0.2.2")
    return on_zenoh(None, **installed)(state, bench)


CASES: dict[str, Change] = {
    "runtime.enable-misspelt": having(**{ENABLE: "True"}),
    "runtime.not-enabled": having(**{ENABLE: None}),
    "runtime.not-secured": having(**dict.fromkeys((ENABLE, STRATEGY, KEYSTORE, ENCLAVE))),
    "runtime.variable-misspelt": having(ROS_SECURTY_ENABLE="true"),
    "runtime.strategy-misspelt": having(**{STRATEGY: "enforce"}),
    "runtime.not-enforced": having(**{STRATEGY: None}),
    "runtime.keystore-unset": having(**{KEYSTORE: None}),
    "runtime.keystore-not-found": having(**{KEYSTORE: "/nowhere/at/all"}),
    "runtime.keystore-relative": having(**{KEYSTORE: "keystore"}),
    "runtime.enclave-not-found": having(**{ENCLAVE: "/bass"}),
    "runtime.enclave-unset": having(**{ENCLAVE: None}),
    "runtime.unsecured-without-enclave": having(**{ENCLAVE: None, STRATEGY: "Permissive"}),
    "runtime.domain-malformed": having(**{DOMAIN: "010"}),
    "runtime.domain-not-governed": having(**{DOMAIN: "7"}),
    "runtime.ca-key-present": lambda state, bench: having(**{KEYSTORE: str(bench.root)})(
        state, bench
    ),
    "runtime.other-distribution": _for_lyrical,
    "runtime.rmw-not-installed": having(**{RMW: "rmw_connextdds"}),
    "runtime.rmw-without-security": having(**{RMW: "rmw_email_cpp"}),
    "runtime.clock-behind": _written_in_the_future,
    "runtime.daemon-unsecured": running(1, **{ENABLE: None}),
    "runtime.daemon-differs": running(1, **{ENCLAVE: "/arm"}),
    "runtime.process-unsecured": running(0, **{ENABLE: None}),
    "runtime.node-open": running(0, **{ENABLE: None, DOMAIN: "5"}),
    "runtime.process-runs-unsecured": running(0, **{STRATEGY: "Permissive", ENCLAVE: "/gone"}),
    "runtime.process-outdated": _written_since,
    "runtime.process-revoked": _revoked,
    "runtime.process-without-files": running(0, **{ENCLAVE: "/gone"}),
    "runtime.process-expired": lambda state, _: replace(state, now=state.now + 9000 * DAY),
    "runtime.process-permissive": running(0, **{STRATEGY: "Permissive"}),
    "runtime.process-without-rcl": changed(0, libraries=frozenset({"libddsc"})),
    "runtime.process-rmw-unknown": changed(0, libraries=frozenset({"librmw_email_cpp", "librcl"})),
    "runtime.process-other-keystore": _among_strangers,
    "runtime.process-not-connected": _not_connected,
    "runtime.process-lost-memory": changed(0, lost_memory=True),
    "runtime.process-other-folder": _from_an_older_copy,
    "runtime.process-copied-enclave": _from_a_copy,
    "runtime.process-local-time": lambda state, bench: _at_the_end(state, bench, TZ="Asia/Tokyo"),
    "runtime.process-files-replaceable": _others_can_write,
    "runtime.process-key-readable": _others_can_read_the_key,
    "runtime.process-elsewhere": changed(0, network="net:[1]"),
    "runtime.process-further-domain": changed(0, domains=frozenset({0, 92})),
    "runtime.process-not-seen": _unseen,
    "runtime.container-alone": lambda state, _: replace(
        state, running=replace(state.running, is_in_container=True)
    ),
    "runtime.zenoh-process-unread": on_zenoh("mode: client\n"),
    "runtime.zenoh-open": on_zenoh(**{SESSION: None}),
    "runtime.zenoh-file-not-found": on_zenoh(**{SESSION: "/nowhere/session.json5"}),
    "runtime.zenoh-too-old": old_rmw_zenoh,
    "runtime.zenoh-unread": on_zenoh("[]"),
    "runtime.zenoh-overridden": on_zenoh(
        **{OVERRIDE: 'connect/endpoints=["tls/a:1"];access_control/enabled=false'}
    ),
    "runtime.zenoh-no-certificate": on_zenoh(**{OVERRIDE: None}),
    "runtime.zenoh-process-changed": on_zenoh(**{OVERRIDE: 'mode="peer"'}),
    "runtime.zenoh-process-open": on_zenoh(**{OVERRIDE: "/access_control/enabled=false"}),
    "runtime.mixed-vendors": running(0, **{RMW: "rmw_cyclonedds_cpp"}),
    "runtime.known-vulnerabilities": on_fast_dds("/opt/ros/jazzy/lib", "2.14.5"),
    "runtime.package-vulnerabilities": on_fast_dds("/usr/lib/x86_64-linux-gnu", "2.14.5"),
    "runtime.vulnerabilities-unclear": on_fast_dds("/opt/ros/humble/lib", "2.6.12"),
    "runtime.dds-version-unknown": on_fast_dds("/opt/robot/lib", ""),
}
SOUND: Change = _without_ca_keys
