"""Each finding about the runtime comes about where it should, and not in a sound state."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest

from sros_tool.checks import processes, runtime
from sros_tool.checks.environment import security_clauses
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingFilter
from sros_tool.checks.processes import (
    may_lack_list,
    security_counts_text,
    unjudged_connections_text,
)
from sros_tool.checks.runtime import RuntimeState
from sros_tool.keystore.layout import CERTIFICATE_FILE, CRL_FILE
from sros_tool.runtime.processes import (
    LoadedFile,
    MappedLibrary,
    Process,
    ProcessEnclave,
    ProcessTable,
    RunningProcesses,
    UnseenProcess,
)
from sros_tool.runtime.rmw import RMW
from sros_tool.zenoh.json5 import MOST_BYTES
from tests.checks import zenoh_cases
from tests.checks.bench import DAY, SECRET, Bench
from tests.checks.runtime_cases import (
    CASES,
    DOMAIN,
    ENABLE,
    ENCLAVE,
    KEYSTORE,
    OVERRIDE,
    SESSION,
    SOUND,
    STRATEGY,
    TLS,
    changed,
    having,
    on_zenoh,
    running,
    seen,
    session_written_since,
    sound_state,
    with_processes,
)
from tests.support.children import wait_for
from tests.support.harness import sros

pytest_plugins = ["tests.checks.sound_keystore"]

SPELLING = {
    *("enable-misspelt", "strategy-misspelt", "not-enforced", "not-enabled", "keystore-unset"),
    "variable-misspelt",
}


def runtime_findings(state: RuntimeState) -> list[Finding]:
    return runtime.runtime_findings(seen(state))


def ids(state: RuntimeState) -> set[str]:
    return {each.id for each in runtime_findings(state)}


@pytest.fixture
def sound_one(bench: Bench) -> RuntimeState:
    """A host whose keystore is an export, without keys of CAs."""
    state = SOUND(sound_state(bench), bench)
    for index in range(len(state.running.processes)):
        state = changed(index, environment=state.environment)(state, bench)
    return state


def test_nothing_in_a_sound_setting(sound_one: RuntimeState) -> None:
    assert ids(sound_one) == set()


@pytest.mark.parametrize("variables", [{}, {ENABLE: "false", KEYSTORE: "/ks"}, {ENABLE: ""}])
def test_nothing_but_that_nothing_is_secured(variables: dict[str, str]) -> None:
    environment = {"PATH": "/usr/bin", "ROS_DISTRO": "jazzy", **variables}
    (found,) = runtime_findings(RuntimeState(environment, datetime.now(UTC)))
    assert (found.id, found.severity) == ("runtime.not-secured", NOTE)
    assert "running" not in found.text


def test_without_security_each_open_node_is_named(sound_one: RuntimeState, bench: Bench) -> None:
    node = replace(sound_one.running.processes[0], environment={DOMAIN: "3"})
    nodes = tuple(replace(node, pid=pid) for pid in range(100, 130))
    state = with_processes(replace(sound_one, environment={}), *nodes)
    (found,) = runtime_findings(state)
    assert found.text.startswith(
        "ROS_SECURITY_ENABLE is not set; open nodes: process 100 (talker) in domain 3, "
    )
    assert found.text.endswith("process 119 (talker) in domain 3 and 10 more")
    for severity, shown in ((None, True), (NOTE, True), (WARNING, False), (ERROR, False)):
        chosen = FindingFilter(severity=severity).choose([found])
        assert bool(chosen.shown) is shown
        assert not chosen.fails(WARNING)


def test_the_first_line_counts_what_runs_open(sound_one: RuntimeState) -> None:
    (secured,) = sound_one.running.processes[:1]
    opened = replace(secured, environment={})
    on_email = {**secured.environment, "RMW_IMPLEMENTATION": "rmw_email_cpp"}
    email = replace(secured, environment=on_email, libraries=frozenset({"librcl"}))
    daemon = replace(opened, command=("/bin/python", "/bin/_ros2_daemon"))
    unseen = UnseenProcess(7, ("x",), "it is of another user", False)
    begin = "processes that use ROS 2, DDS or Zenoh: "
    for nodes, more, text in (
        ((secured, secured), {}, f"{begin}2 secured, 0 open"),
        ((secured, opened, email, daemon), {}, f"{begin}1 secured, 1 open, 1 perhaps open"),
        ((), {"unseen": (unseen,)}, f"{begin}0 secured, 0 open (1 other could not be examined)"),
        ((), {"hidden": "x"}, f"{begin}0 secured, 0 open (others could not be examined)"),
        ((daemon,), {}, ""),
    ):
        assert security_counts_text(RunningProcesses(nodes, **more)) == text


@pytest.mark.parametrize("written", ["7", "07", "0x7", "7abc", "4294967303"])
def test_an_open_node_is_next_to_secured_ones_however_its_domain_is_written(
    sound_one: RuntimeState, written: str
) -> None:
    secured = sound_one.running.processes[0]
    secured = replace(secured, environment={**secured.environment, DOMAIN: "7"})
    opened = replace(secured, pid=99, environment={DOMAIN: written})
    state = with_processes(replace(sound_one, environment={}), secured, opened)
    assert "runtime.process-unsecured" in ids(state)


def test_the_name_of_a_process_cannot_be_taken_for_another_one(sound_one: RuntimeState) -> None:
    name = f"x) in domain 0, process 1 (y\x1b[2J{'z' * 500}"
    node = Process(7, (name,), {DOMAIN: "all, 4"}, sound_one.now, libraries=frozenset({"librcl"}))
    (found,) = runtime_findings(with_processes(replace(sound_one, environment={}), node))
    text = found.text.partition("open nodes: ")[2]
    assert text == f"process 7 (x? in domain 0? process 1 ?y??2J{'z' * 8}) in domain 'all? 4'"


def test_a_session_file_of_zenoh_is_security_without_ros_variables(
    sound_one: RuntimeState, bench: Bench
) -> None:
    unset = dict.fromkeys((ENABLE, STRATEGY, KEYSTORE, ENCLAVE))
    assert ids(with_processes(on_zenoh(**unset)(sound_one, bench))) == set()
    without_file = with_processes(on_zenoh(**unset, **{SESSION: None})(sound_one, bench))
    assert ids(without_file) == {"runtime.not-secured"}


@pytest.mark.parametrize("expected", CASES)
def test_found(expected: str, sound_one: RuntimeState, bench: Bench) -> None:
    """Twin: `test_nothing_in_a_sound_setting`."""
    state = sound_one
    if expected in ("runtime.clock-behind", "runtime.process-outdated"):
        bench.root = Path(sound_one.environment[KEYSTORE])
        (bench.root / "ledger.jsonl").touch()
        begin = sound_one.now.timestamp() - 9
        for path in bench.root.rglob("*"):
            os.utime(path, (begin, begin))
        assert expected not in ids(sound_one)
    assert expected in ids(CASES[expected](state, bench))


def test_processes_that_may_still_connect_are_counted(
    sound_one: RuntimeState, bench: Bench
) -> None:
    """The absence of the finding on their connections proves nothing yet."""
    state = CASES["runtime.process-not-connected"](sound_one, bench)
    nodes = [*state.running.processes]
    for seconds, text in ((29, "connections of 2 processes are not judged yet"), (30, "")):
        young = [replace(node, started=state.now - timedelta(seconds=seconds)) for node in nodes]
        said = unjudged_connections_text(RunningProcesses(tuple(young)), state.now)
        assert said.startswith(text) and bool(said) is bool(text)


def test_the_same_files_in_another_folder_are_no_other_files(
    sound_one: RuntimeState, bench: Bench
) -> None:
    """Its twin with another governance is among the cases.

    If the enclave runs from both folders, the process from the copy is found.
    """
    expected = "runtime.process-copied-enclave"
    both = seen(CASES[expected](sound_one, bench))
    thief, node = both.running.processes[:2]
    copy, own = (process.environment[KEYSTORE] for process in (thief, node))
    (found,) = (each for each in runtime_findings(both) if each.id == expected)
    assert found.subject == thief.label
    assert found.text == f"it runs in /base from '{copy}', and {node.label} from '{own}'"
    counts = security_counts_text(both.running)
    assert counts.endswith(f"3 secured, 0 open; secured from '{own}' (2) and '{copy}' (1)")
    assert not ids(running(0, **{KEYSTORE: copy})(sound_one, bench))


def test_a_thief_neither_hides_by_a_name_nor_accuses_the_robot_by_its_number_of_processes(
    sound_one: RuntimeState, bench: Bench
) -> None:
    """Without security in this shell, the number decides."""
    kind = "runtime.process-copied-enclave"
    thief, node, _ = CASES[kind](sound_one, bench).running.processes
    own, copy = node.environment[KEYSTORE], Path(thief.environment[KEYSTORE])
    (copy / "enclaves/base").rename(copy / "enclaves/other")
    outside = f"{'/..' * 99}{copy}/enclaves/other"

    def found_in(state: RuntimeState) -> list[tuple[str, str]]:
        findings = runtime_findings(seen(state))
        return [(each.subject, each.text) for each in findings if each.id == kind]

    for keystore, name in ((f"{copy}", "/other"), (own, outside)):
        stolen = {**thief.environment, KEYSTORE: keystore, ENCLAVE: name}
        thieves = [replace(thief, pid=pid, environment=stolen) for pid in (5, 6)]
        state = with_processes(sound_one, *thieves, node)
        without_rcl = replace(node, libraries=frozenset({"libfastrtps"}))
        ((subject, text),) = found_in(state)
        assert found_in(with_processes(state, *thieves, without_rcl)) == [(subject, text)]
        assert subject == ", ".join(process.label for process in thieves)
        assert text.endswith(f", and {node.label} in /base from '{own}'")
        more = found_in(replace(state, environment={}))
        assert [subject for subject, _ in more] == [node.label]


def test_the_first_line_names_folders_that_have_one_path_or_none(
    sound_one: RuntimeState, bench: Bench
) -> None:
    """A container can have another folder at the same path; Zenoh needs no keystore."""
    (node, *_) = seen(sound_one).running.processes
    own = node.environment[KEYSTORE]
    assert node.enclave
    elsewhere = replace(node.enclave, folders=((0, 1), (0, 2)), local_keystore=None)
    counts = security_counts_text(RunningProcesses((node, node, replace(node, enclave=elsewhere))))
    assert counts.endswith(f"; secured from '{own}' (2) and '{own}' of its own file system (1)")
    unset = dict.fromkeys((ENABLE, STRATEGY, KEYSTORE, ENCLAVE))
    zenoh = seen(on_zenoh(**unset)(sound_one, bench)).running.processes[0]
    assert security_counts_text(RunningProcesses((zenoh,))).endswith("1 secured, 0 open")
    counts = security_counts_text(RunningProcesses((node, zenoh)))
    assert counts.endswith(f"; secured from '{own}' (1) and an unknown folder (1)")


def test_nothing_on_zenoh_with_a_session_file(sound_one: RuntimeState, bench: Bench) -> None:
    assert ids(on_zenoh()(sound_one, bench)) == {"zenoh.unsigned"}
    other_router = {OVERRIDE: 'connect/endpoints=["tls/robot:7447"];transport/link/tx/lease=9'}
    found = ids(on_zenoh(**other_router)(sound_one, bench))
    assert not found & {"runtime.zenoh-overridden", "runtime.zenoh-process-changed"}


@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        (
            OVERRIDE,
            'access_control/default_permission="allow";listen/endpoints=["tcp/127.0.0.1:7449"];'
            'transport/link/protocols=["tcp","tls"];//mode="peer";connect/timeout_ms=-1',
            f"{OVERRIDE} sets access_control/default_permission, listen/endpoints, "
            "transport/link/protocols, mode",
        ),
        (OVERRIDE, f'{TLS}/root_ca_certificate="/x"', f"{OVERRIDE} sets {TLS}/root_ca_certificate"),
        (OVERRIDE, 'connect/endpoints=["tcp/a:1"]', f"{OVERRIDE} sets connect/endpoints"),
        (OVERRIDE, 'connect/endpoints={client:["tcp/a:1"]}', f"{OVERRIDE} sets connect/endpoints"),
        (SESSION, "{}/of/another.json5", f"{SESSION} names '{{}}/of/another.json5', not '"),
    ],
)
def test_a_zenoh_process_with_other_settings_than_those_of_its_enclave_is_named(
    sound_one: RuntimeState, bench: Bench, variable: str, value: str, said: str
) -> None:
    place = bench.root.parent
    (place / "of").mkdir()
    (place / "of/another.json5").write_text(json.dumps(zenoh_cases.sound()))
    changed = running(0, **{variable: value.replace("{}", str(place))})
    state = seen(changed(on_zenoh()(sound_one, bench), bench))
    (found,) = (
        each for each in runtime_findings(state) if each.id == "runtime.zenoh-process-changed"
    )
    assert said.replace("{}", str(place)) in found.text and "timeout" not in found.text


def test_a_session_file_that_changed_since_the_start(sound_one: RuntimeState, bench: Bench) -> None:
    assert "runtime.process-outdated" not in ids(on_zenoh()(sound_one, bench))
    assert "runtime.process-outdated" in ids(session_written_since(sound_one, bench))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("open.yaml", "mode: client\n"),
        ("open.yml", "mode: client\n"),
        ("sequence.json5", '["client"]'),
        ("sequences.json5", "{mode: 'client', transport: [[]]}"),
        ("large.json5", "{}"),
        ("open.toml", 'mode = "client"\n'),
        ("pipe.json5", None),
    ],
)
def test_what_zenoh_reads_and_sros_does_not_is_not_called_malformed(
    name: str, text: str | None, sound_one: RuntimeState, bench: Bench, tmp_path: Path
) -> None:
    """Whether it enforces anything is not known, and said so."""
    if text is None:
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).write_text(text + " " * MOST_BYTES * name.startswith("large"))
    unset = dict.fromkeys((ENABLE, STRATEGY, KEYSTORE, ENCLAVE))
    change = on_zenoh(**unset, **{SESSION: str(tmp_path / name)})
    state = change(sound_one, bench)
    ids_found = ids(replace(state, running=RunningProcesses()))
    assert ids_found == {"runtime.zenoh-unread"}


def test_zenoh_reads_no_file_of_another_ending(
    sound_one: RuntimeState, bench: Bench, tmp_path: Path
) -> None:
    for name in ("session.json", "session.conf", "session", ".json5", "session.JSON5"):
        (tmp_path / name).write_text(json.dumps(zenoh_cases.sound()))
        found = ids(on_zenoh(**{SESSION: str(tmp_path / name)})(sound_one, bench))
        assert ("runtime.zenoh-file-not-found" in found) is (name != "session.json")


@pytest.mark.parametrize(
    ("variables", "text", "expected"),
    [
        ({}, "{mode: 'client'", "zenoh.malformed"),
        ({}, "{}", "zenoh.session-without-rules"),
        ({OVERRIDE: "mode"}, None, "runtime.zenoh-no-certificate"),
        ({OVERRIDE: "mode=client"}, None, "zenoh.malformed"),
        ({OVERRIDE: "mode/x=1"}, None, "zenoh.malformed"),
        ({OVERRIDE: "=1;;x;a/b/c/d/e/f/g/h/i/j/k/l=1"}, None, "zenoh.malformed"),
        ({OVERRIDE: 'listen/endpoints=["tcp/[::]:7447"]'}, None, "zenoh.endpoint-refused"),
        (
            {OVERRIDE: 'listen/endpoints=["tcp/[::]:7447"];transport/link/protocols=null'},
            None,
            "zenoh.plain-endpoint",
        ),
        ({OVERRIDE: 'access_control/default_permission="allow"'}, None, "zenoh.default-allow"),
        ({OVERRIDE: "transport/shared_memory/enabled=true"}, None, "zenoh.shared-memory"),
    ],
)
def test_what_an_override_makes_of_a_session_file(
    variables: dict[str, str],
    text: str | None,
    expected: str,
    sound_one: RuntimeState,
    bench: Bench,
) -> None:
    assert expected in ids(on_zenoh(text, **variables)(sound_one, bench))


def test_what_keeps_the_enclave_from_loading_is_found_too(sound_one: RuntimeState) -> None:
    root = Path(sound_one.environment[KEYSTORE])
    (root / "enclaves/base/permissions.p7s").unlink()
    missing, outdated = runtime_findings(sound_one)
    assert (missing.id, outdated.id) == ("enclave.file-missing", "runtime.process-outdated")
    assert "permissions.p7s" in missing.text
    assert "permissions.p7s (removed)" in outdated.text


def test_a_process_whose_start_the_clock_does_not_tell(
    sound_one: RuntimeState, bench: Bench
) -> None:
    set_forward = {"started": datetime(2000, 1, 1, tzinfo=UTC), "clock_advance": 25 * DAY / 24}
    (found,) = runtime_findings(changed(0, **set_forward)(sound_one, bench))
    assert found.id == "runtime.process-outdated"
    assert found.text.startswith(
        "the clock was set forward by 1 d 1 h while the process ran, so it is not known whether "
    )


def test_a_process_of_a_revoked_enclave_whose_files_are_gone(bench: Bench) -> None:
    """Where the keystore is, its ledger tells what the process has loaded."""
    state = sound_state(bench)
    sros("revoke", bench.root, "/base", env={"SROS_CA_PASSPHRASE": SECRET}).ok()
    assert "runtime.process-revoked" in ids(state)


def test_the_ledgers_of_all_processes_of_a_user_are_bounded(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any user can start a thousand processes that name a large ledger, and hide no one else's."""
    enclave = ProcessEnclave(str(bench.root), "/base", local_keystore=bench.root)
    size = (bench.root / "ledger.jsonl").stat().st_size
    monkeypatch.setattr(processes, "_MOST_LEDGERS", 2 * size + 1)
    ledgers = processes._Ledgers()
    for user, are_read in (
        *((1000, True), (1000, True), (1000, False), (1001, True)),
        *((100_000, True), (100_001, True), (100_002, False)),  # ids of one user's containers
    ):
        entries, unknown = ledgers.entries(enclave, user)
        assert bool(entries) == are_read, user
        assert ("MiB of ledgers for the processes of a user" in unknown) != are_read


@pytest.mark.parametrize(
    ("name", "moved", "lacks"),
    [
        (CERTIFICATE_FILE, False, False),
        (CERTIFICATE_FILE, True, True),
        (CRL_FILE, False, True),
        ("", True, True),
        ("", False, False),
    ],
)
def test_a_process_that_may_have_loaded_another_list(name: str, moved: bool, lacks: bool) -> None:
    """Of a folder that was moved since, nobody knows which list the process found there."""
    begin = datetime.now(UTC)
    later = begin + timedelta(seconds=1)
    files = (LoadedFile(name, later),) if name else ()
    enclave = ProcessEnclave("/ks", "/a", files, moved={"/ks": later} if moved else {})
    assert may_lack_list(Process(1, ("node",), {}, begin), enclave) is lacks


def test_the_daemon_of_another_domain_is_not_asked(sound_one: RuntimeState, bench: Bench) -> None:
    unsecured = running(1, ROS_SECURITY_ENABLE=None)(sound_one, bench)
    assert ids(unsecured) == {"runtime.daemon-unsecured"}
    assert ids(running(1, ROS_DOMAIN_ID="3")(unsecured, bench)) == set()


def test_the_domain_is_told_whatever_the_enclave(bench: Bench) -> None:
    state = sound_state(bench)
    assert not ids(state) - {"runtime.ca-key-present"}
    wrong = having(**{DOMAIN: "7", ENCLAVE: "/nobody"})(state, bench)
    assert ids(wrong) >= {"runtime.domain-not-governed", "runtime.enclave-not-found"}


def test_a_robot_whose_clock_is_behind(sound_one: RuntimeState) -> None:
    behind = replace(sound_one, now=sound_one.now - 400 * DAY)
    assert "enclave.certificate-not-yet-valid" in ids(behind)
    assert "runtime.clock-behind" in ids(behind)
    plain = replace(behind, environment={})
    assert "runtime.clock-behind" in ids(plain), "the processes name the keystore"


@pytest.mark.parametrize(("zone", "found"), [("America/Los_Angeles", True), ("UTC", False)])
def test_the_time_zone_of_the_host(zone: str, found: bool, sound_one: RuntimeState) -> None:
    """Twenty hours before it was signed is within the back-dating, in UTC."""
    early = replace(sound_one, now=sound_one.now - timedelta(hours=20), zone=ZoneInfo(zone))
    assert ("enclave.permissions-local-time" in ids(early)) == found


def test_an_rmw_that_was_tried(sound_one: RuntimeState) -> None:
    tried = replace(sound_one, insecure_rmws={"rmw_fastrtps_cpp": "no security libraries"})
    (found,) = runtime_findings(tried)
    assert (found.id, found.text) == ("runtime.rmw-without-security", "no security libraries")
    other = replace(sound_one, insecure_rmws={"rmw_cyclonedds_cpp": "no plugins"})
    assert ids(other) == set()


@pytest.mark.parametrize("name", ["ROS_SECURITY_ROOT_DIRECTORY", "ros_security_enable"])
def test_variables_of_old_and_in_small_letters(
    name: str, sound_one: RuntimeState, bench: Bench
) -> None:
    assert ids(having(**{name: "x"})(sound_one, bench)) == {"runtime.variable-misspelt"}


def test_an_open_node_is_found_next_to_a_secured_one_from_a_shell_without_security(
    sound_one: RuntimeState,
) -> None:
    secured = sound_one.running.processes[0]
    open_node = replace(secured, pid=9, environment={"ROS_DOMAIN_ID": "0"})
    shell = replace(sound_one, environment={"PATH": "/usr/bin"})
    both = {"runtime.process-unsecured", "runtime.not-secured"}
    assert ids(with_processes(shell, secured, open_node)) == both
    alone = {"runtime.not-secured"}
    elsewhere = replace(open_node, environment={"ROS_DOMAIN_ID": "1"})
    assert ids(with_processes(shell, secured, elsewhere)) == alone
    assert ids(with_processes(shell, open_node)) == alone


def test_real_processes_are_read(tmp_path: Path) -> None:
    environment = {**os.environ, ENCLAVE: "/sros_test_of_processes"}
    (tmp_path / "librcl.so").write_bytes(b"x" * 4096)
    script = (
        "import mmap, time; file = open('librcl.so', 'rb');"
        "loaded = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ); time.sleep(600)"
    )
    command = [sys.executable, "-c", script]
    before = datetime.now(UTC) - timedelta(seconds=0.1)  # the kernel counts hundredths
    child = subprocess.Popen(command, env=environment, cwd=tmp_path)
    try:

        def mine() -> Any:
            listed = (
                each
                for each in ProcessTable().look(datetime.now(UTC)).processes
                if each.pid == child.pid
            )
            return next((e for e in listed if e.environment.get(ENCLAVE)), None)

        found = wait_for(mine, "the process with its environment")
        assert found is not None
        assert found.environment[ENCLAVE] == "/sros_test_of_processes"
        assert found.command[1] == "-c"
        assert before < found.started < datetime.now(UTC) + timedelta(seconds=0.1)
        assert found.libraries == {"librcl"}
        assert os.getpid() not in {
            each.pid for each in ProcessTable().look(datetime.now(UTC)).processes
        }
    finally:
        child.kill()
        child.wait()


@pytest.mark.parametrize(
    ("variables", "told"),
    [
        ({}, set()),
        ({"ENABLE": "false"}, set()),
        ({"ENABLE": "True"}, {"enable-misspelt"}),
        ({"ENABLE": "1", "STRATEGY": "Enforce"}, {"enable-misspelt"}),
        ({"ENABLE": "true", "STRATEGY": "enforce"}, {"strategy-misspelt", "keystore-unset"}),
        ({"ENABLE": "true"}, {"not-enforced", "keystore-unset"}),
        ({"ENABLE": "true", "STRATEGY": "Enforce"}, {"keystore-unset"}),
        ({"STRATEGY": "ENFORCE"}, {"strategy-misspelt", "not-enabled"}),
    ],
)
def test_spelling(variables: dict[str, str], told: set[str]) -> None:
    named = {f"ROS_SECURITY_{name}": value for name, value in variables.items()}
    found = {each.removeprefix("runtime.") for each in ids(RuntimeState(named, datetime.now(UTC)))}
    assert found & SPELLING == told


@pytest.mark.parametrize(
    ("variables", "arguments", "unsecured"),
    [
        ({"STRATEGY": "Permissive"}, [], False),
        ({"STRATEGY": "Permissive", "ENCLAVE_OVERRIDE": "/gone"}, [], True),
        ({"STRATEGY": "enforce", "ENCLAVE_OVERRIDE": "/gone"}, [], True),
        ({"STRATEGY": "Enforce", "ENCLAVE_OVERRIDE": "/gone"}, [], False),
        ({"STRATEGY": "Permissive", "ENCLAVE_OVERRIDE": ""}, [], True),
        ({"STRATEGY": "Permissive", "ENCLAVE_OVERRIDE": ""}, ["--enclave", "{name}"], False),
        ({"STRATEGY": "Permissive", "ENCLAVE_OVERRIDE": ""}, ["-e", "/gone"], True),
        ({"STRATEGY": "Permissive", "KEYSTORE": ""}, [], True),
        ({"STRATEGY": "Permissive", "KEYSTORE": "relative"}, [], False),
    ],
)
def test_a_node_that_asks_for_security_and_runs_without(
    variables: dict[str, str], arguments: list[str], unsecured: bool, sound_one: RuntimeState
) -> None:
    node = sound_one.running.processes[0]
    name = node.environment[ENCLAVE]
    changed = replace(
        node,
        environment={
            **node.environment,
            **{f"ROS_SECURITY_{key}": value for key, value in variables.items()},
        },
        command=(*node.command, *(each.format(name=name) for each in arguments)),
    )
    state = with_processes(sound_one, changed)
    assert ("runtime.process-runs-unsecured" in ids(state)) is unsecured


FAST, CYCLONE_DDS, OF_SDK = (
    MappedLibrary("Fast DDS", "2.14.6", "/opt/ros/jazzy/lib/libfastrtps.so.2.14.6"),
    MappedLibrary("Cyclone DDS", "0.10.5", "/opt/ros/jazzy/lib/libddsc.so.0.10.5"),
    MappedLibrary("Cyclone DDS", "", "/opt/sdk/lib/libddsc.so"),
)


@pytest.mark.parametrize(
    ("rmw", "mapped", "other"),
    [
        ("rmw_fastrtps_cpp", (FAST,), None),
        ("rmw_fastrtps_cpp", (FAST, OF_SDK), OF_SDK),
        ("rmw_cyclonedds_cpp", (FAST, CYCLONE_DDS), FAST),
        ("rmw_cyclonedds_cpp", (CYCLONE_DDS, OF_SDK), OF_SDK),
    ],
)
def test_rcl_does_not_secure_the_dds_of_an_sdk(
    rmw: str,
    mapped: tuple[MappedLibrary, ...],
    other: MappedLibrary | None,
    sound_one: RuntimeState,
) -> None:
    node = sound_one.running.processes[0]
    libraries = frozenset({"librcl", *(Path(each.path).name.split(".")[0] for each in mapped)})
    environment = {**node.environment, RMW: rmw}
    node = replace(node, environment=environment, libraries=libraries, dds=mapped)
    found = runtime_findings(with_processes(sound_one, node))
    texts = [each.text for each in found if each.id == "runtime.process-without-rcl"]
    unsecured = f"it runs in domain 0, and also uses '{other and other.path}'"
    assert texts == ([unsecured] if other else [])


@pytest.mark.parametrize(("hours", "unsecured"), [(1, True), (-1, False)])
def test_a_node_whose_folder_was_another_one_at_its_start_may_run_secured(
    hours: int, unsecured: bool, sound_one: RuntimeState
) -> None:
    folder = Path(sound_one.environment[KEYSTORE], "enclaves/base")
    (folder / "permissions.p7s").unlink()
    os.utime(folder, (0, 0))  # its last change is not that a file was removed
    node = sound_one.running.processes[0]
    environment = {**node.environment, STRATEGY: "Permissive"}
    started = datetime.now(UTC) + timedelta(hours=hours)
    state = with_processes(sound_one, replace(node, environment=environment, started=started))
    assert ("runtime.process-runs-unsecured" in ids(state)) is unsecured


def test_a_missing_enclave_says_what_the_strategy_makes_of_it(sound_one: RuntimeState) -> None:
    for strategy, unsecured in (("Enforce", False), ("Permissive", True)):
        environment = {**sound_one.environment, ENCLAVE: "/gone", "ROS_SECURITY_STRATEGY": strategy}
        found = runtime_findings(replace(sound_one, environment=environment))
        (missing,) = [each for each in found if each.id == "runtime.enclave-not-found"]
        assert ("RUN UNSECURED" in missing.text) is unsecured


def test_what_no_enclave_leads_to_is_of_a_severity_that_is_shown(sound_one: RuntimeState) -> None:
    """Permissive runs unsecured, which is worse than not starting under Enforce."""
    found = {
        strategy: {
            each.id: each.severity
            for each in runtime_findings(
                replace(
                    sound_one,
                    environment={
                        **{k: v for k, v in sound_one.environment.items() if k != ENCLAVE},
                        "ROS_SECURITY_STRATEGY": strategy,
                    },
                )
            )
        }
        for strategy in ("Enforce", "Permissive")
    }
    assert found["Enforce"]["runtime.enclave-unset"] is WARNING
    assert found["Permissive"]["runtime.unsecured-without-enclave"] is ERROR
    assert "runtime.unsecured-without-enclave" not in found["Enforce"]


CYCLONE, PROFILES = "CYCLONEDDS_URI", "FASTRTPS_DEFAULT_PROFILES_FILE"
ON_ZENOH = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
WITH_KEY = 'transport/link/tls/connect_private_key="/key.pem"'


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({}, ""),
        ({"ROS_SECURITY_KEYSTORE": "/ks", "ROS_SECURITY_ENABLE": "True"}, ""),
        ({"ROS_SECURITY_ENABLE": "true"}, "ROS_SECURITY_ENABLE is set"),
        ({CYCLONE: "<General><Tracing/></General>"}, ""),
        ({CYCLONE: "<CycloneDDS><Domain><DDSSecurity>"}, f"{CYCLONE} has security"),
        ({CYCLONE: "<General>${MORE}</General>"}, f"{CYCLONE} cannot be read"),
        ({CYCLONE: "file://plain,secured"}, f"{CYCLONE} has security"),
        ({CYCLONE: "plain"}, ""),
        ({PROFILES: "plain"}, ""),
        ({PROFILES: "secured"}, f"{PROFILES} has security"),
        ({PROFILES: "none"}, f"{PROFILES} cannot be read"),
        ({PROFILES: "hidden"}, f"{PROFILES} has security"),
        ({"FASTDDS_ENVIRONMENT_FILE": "secured"}, "FASTDDS_ENVIRONMENT_FILE has security"),
        ({"FASTDDS_ENVIRONMENT_FILE": "hidden"}, "FASTDDS_ENVIRONMENT_FILE has security"),
        ({**ON_ZENOH, PROFILES: "secured"}, ""),
        ({**ON_ZENOH, SESSION: "session"}, ""),
        ({**ON_ZENOH, SESSION: "plain"}, f"{SESSION} cannot be read"),
        ({**ON_ZENOH, "ZENOH_CONFIG_OVERRIDE": WITH_KEY}, "ZENOH_CONFIG_OVERRIDE has security"),
        (
            {**ON_ZENOH, SESSION: "session", "ZENOH_CONFIG_OVERRIDE": WITH_KEY},
            f"{SESSION} with ZENOH_CONFIG_OVERRIDE has security",
        ),
        ({**ON_ZENOH, SESSION: "password"}, f"{SESSION} has security"),
    ],
)
def test_what_secures_the_nodes_of_a_shell(
    tmp_path: Path, variables: dict[str, str], said: str
) -> None:
    for name, text in (
        ("plain", "<!-- no security --><profiles/>"),
        ("secured", "<Security> dds.sec.auth.plugin FASTDDS_DEFAULT_PROFILES_FILE"),
        (
            "session",
            '{transport: {auth: {usrpwd: {user: null}}}, connect: {endpoints: ["tcp/a:1"]}}',
        ),
        ("hidden", "<name>d&#100;s.sec</name> FASTDDS_DEFAULT\\u005fPROFILES"),
        ("password", '{transport: {auth: {usrpwd: {user: "me"}}}}'),
    ):
        (tmp_path / name).write_text(text)
    found = [*security_clauses(variables, tmp_path)]
    assert len(found) == bool(said)
    assert all(clause.startswith(said) for clause in found)
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").symlink_to("secured")
    at_last = "'DEFAULT_FASTRTPS_PROFILES.xml' in this folder has security"
    assert (at_last in security_clauses(variables, tmp_path)) != (
        ON_ZENOH.items() <= variables.items()
    )
