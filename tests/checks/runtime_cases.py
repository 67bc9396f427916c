"""How each finding about the runtime comes about: what is changed in a sound state."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta

from sros_tool.checks.runtime import Process, RuntimeState
from tests.checks import zenoh_cases
from tests.checks.bench import Bench

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
    return RuntimeState(environment, started, processes=(node, daemon), rmws=rmws)


def having(**variables: str | None) -> Change:
    """Variables set, or with None unset."""

    def change(state: RuntimeState, _: Bench) -> RuntimeState:
        environment = {**state.environment, **variables}
        return replace(state, environment={n: v for n, v in environment.items() if v is not None})

    return change


def running(index: int, **variables: str | None) -> Change:
    """The same for one of the processes."""

    def change(state: RuntimeState, bench: Bench) -> RuntimeState:
        process = state.processes[index]
        alone = replace(state, environment=process.environment)
        changed = replace(process, environment=having(**variables)(alone, bench).environment)
        processes = list(state.processes)
        processes[index] = changed
        return replace(state, processes=tuple(processes))

    return change


def _written_in_the_future(state: RuntimeState, bench: Bench) -> RuntimeState:
    moment = (state.now + timedelta(days=3)).timestamp()
    os.utime(bench.path("ledger.jsonl"), (moment, moment))
    return state


def _written_since(state: RuntimeState, bench: Bench) -> RuntimeState:
    moment = (state.now + timedelta(minutes=1)).timestamp()
    os.utime(bench.path("enclaves/base/permissions.p7s"), (moment, moment))
    return state


def _without_ca_keys(state: RuntimeState, bench: Bench) -> RuntimeState:
    return having(**{KEYSTORE: str(bench.export())})(state, bench)


def on_zenoh(text: str | None = None, **variables: str | None) -> Change:
    """Everything on rmw_zenoh_cpp, with a session file as sros writes it, or one with a text."""

    def change(state: RuntimeState, bench: Bench) -> RuntimeState:
        file = bench.root.parent / "session.json5"
        file.write_text(json.dumps(zenoh_cases.sound()) if text is None else text)
        paths = {name: f"/{name}.pem" for name in PATHS}
        stated = {
            RMW: "rmw_zenoh_cpp",
            SESSION: str(file),
            OVERRIDE: ";".join(f'{TLS}/{name}="{path}"' for name, path in paths.items()),
            **variables,
        }
        old = (state.now - timedelta(days=1)).timestamp()
        os.utime(file, (old, old))
        for index in range(len(state.processes)):
            state = running(index, **stated)(state, bench)
        return having(**stated)(state, bench)

    return change


def session_written_since(state: RuntimeState, bench: Bench) -> RuntimeState:
    state = on_zenoh()(state, bench)
    moment = (state.now + timedelta(minutes=1)).timestamp()
    os.utime(state.environment[SESSION], (moment, moment))
    return state


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
    "runtime.rmw-not-installed": having(**{RMW: "rmw_connextdds"}),
    "runtime.rmw-without-security": having(**{RMW: "rmw_email_cpp"}),
    "runtime.clock-behind": _written_in_the_future,
    "runtime.daemon-unsecured": running(1, **{ENABLE: None}),
    "runtime.daemon-differs": running(1, **{ENCLAVE: "/arm"}),
    "runtime.process-unsecured": running(0, **{ENABLE: None}),
    "runtime.process-runs-unsecured": running(0, **{STRATEGY: "Permissive", ENCLAVE: "/gone"}),
    "runtime.process-outdated": _written_since,
    "runtime.zenoh-open": on_zenoh(**{SESSION: None}),
    "runtime.zenoh-file-not-found": on_zenoh(**{SESSION: "/nowhere/session.json5"}),
    "runtime.zenoh-overridden": on_zenoh(
        **{OVERRIDE: 'connect/endpoints=["tls/a:1"];access_control/enabled=false'}
    ),
    "runtime.zenoh-no-certificate": on_zenoh(**{OVERRIDE: None}),
    "runtime.zenoh-process-open": on_zenoh(**{OVERRIDE: "/access_control/enabled=false"}),
    "runtime.mixed-vendors": running(0, **{RMW: "rmw_cyclonedds_cpp"}),
}
SOUND: Change = _without_ca_keys
