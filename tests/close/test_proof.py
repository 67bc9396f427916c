"""What proves that a robot is closed: nodes that are not seen, and names that moved."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from sros_tool.close import proof
from sros_tool.close.acceptance import Acceptance
from sros_tool.close.nodes import MovedEndpoint
from sros_tool.close.proof import (
    _proof_of_connections,
    _proof_of_requirements,
    _proof_of_silence,
    _with_possible_cause,
)
from sros_tool.close.robot import Shell
from sros_tool.close.state import CONNECTED, Proof
from sros_tool.close.talk import (
    _abandoned_names,
    _endpoint_texts,
    _endpoints_without_peer,
    _unseen_text,
    _without_counterpart,
)
from sros_tool.explain.audit import DeniedRight
from sros_tool.graph.observation import Endpoint, Observation, make_observation
from sros_tool.keystore.expiry import Lifetime
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right
from sros_tool.runtime.processes import Process, ProcessEnclave, RunningProcesses, UnseenProcess
from sros_tool.validity import Window
from tests.checks.test_connections import robot
from tests.close.test_assignment import node
from tests.support.harness import policy_text, publish


def test_a_name_that_moved_leaves_nobody_alone() -> None:
    """Or /base never hears /cmd_vel again, and the proof says that everything talks."""
    old, new = Endpoint("rt/cmd_vel", "publish"), Endpoint("rt/nav/cmd_vel", "publish")
    heard = Endpoint("rt/cmd_vel", "subscribe")
    planner = replace(node("planner", ns="/nav"), endpoints=frozenset({new}))
    base = replace(node("base"), endpoints=frozenset({heard}))
    joystick = replace(node("joystick"), endpoints=frozenset({old}))
    seen, moved = (
        make_observation([planner, base]),
        {MovedEndpoint("/planner", "/nav/planner", old, new)},
    )
    alone = "/base subscribe /cmd_vel, which is /nav/cmd_vel now"
    assert _abandoned_names(seen, seen, moved, ()) == [alone]
    assert not _abandoned_names(seen, make_observation([planner, base, joystick]), moved, ())
    right = Right("/base", ALLOW, "subscribe", "/cmd_vel")
    denied = DeniedRight(right, ("/base",), "no rule", False, False, (heard,))
    assert not _abandoned_names(seen, seen, moved, [denied])


def test_names_that_are_left_out_are_not_counted_as_nodes() -> None:
    """The list of nodes may end in "and 1 more" itself."""
    used = [("/a", Endpoint(f"rt/t{number}", "publish")) for number in range(5)]
    assert _endpoint_texts(used) == ["/a publish /t0, /t1, /t2 and 2 more names"]


def test_a_moved_node_is_left_alone_if_nobody_is_at_its_new_name() -> None:
    """The old publisher may have another listener; the node itself is nobody, either."""
    old, new = Endpoint("rt/wheel", "subscribe"), Endpoint("rt/safe/wheel", "subscribe")
    sends, own = old._replace(direction="publish"), new._replace(direction="publish")
    tracks, diary = (
        replace(node(name), endpoints=frozenset({endpoint}))
        for name, endpoint in (("tracks", sends), ("diary", old))
    )
    before = make_observation([tracks, diary, replace(node("guard"), endpoints=frozenset({old}))])
    guard = replace(node("guard", ns="/safe"), endpoints=frozenset({new, own}))
    moved = [MovedEndpoint("/guard", "/safe/guard", old, new)]
    now = make_observation([tracks, diary, guard])
    alone = ["/safe/guard subscribe /safe/wheel"]
    assert _endpoints_without_peer(before, now, moved, ()) == alone
    other = replace(node("other"), endpoints=frozenset({own}))
    assert not _endpoints_without_peer(before, make_observation([*now.nodes, other]), moved, ())
    silent = make_observation([diary])
    assert not _endpoints_without_peer(silent, now, moved, ()), "nobody talked to it before"
    right = Right("/guard", ALLOW, "subscribe", "/safe/wheel")
    denied = DeniedRight(right, ("/safe/guard",), "no rule", False, False, (new,))
    assert not _endpoints_without_peer(before, now, moved, [denied])


@pytest.mark.parametrize(
    ("statuses", "holds"),
    [
        ((0,), True),
        ((0, 0), True),
        ((0, 2), None),
        ((2, 0), None),
        ((2, 1), False),
        ((0, 1), False),
    ],
)
def test_requirements_hold_if_they_hold_here_and_elsewhere(
    statuses: tuple[int, ...], holds: bool | None, tmp_path: Path
) -> None:
    """The first status is of the export, the second of the enclaves of other machines, too."""
    answers = iter(statuses)
    required = tmp_path / "required.toml"
    (tmp_path / "enclaves").mkdir()
    (tmp_path / "enclaves" / "governance.p7s").touch()
    required.write_text('[[nobody]]\npublish = ["/cmd_vel"]\n')
    robot: Any = SimpleNamespace(
        requirements=required,
        close_command="sros close robot",
        export=tmp_path,
        policy=tmp_path / "policy.xml",
        rights_source="keystore",
        not_here=["/laptop"] * (len(statuses) > 1),
        shell=SimpleNamespace(
            check=lambda *_: next(answers),
            run=lambda *_: (1, '{"findings": [{"line": 7, "text": "no enclave /x"}]}', ""),
        ),
    )
    said = _proof_of_requirements(robot, str)
    assert said.holds is holds
    weak = "; but with 1 warning that a requirement protects less than it states, the first: line 7"
    assert (f"{weak}: no enclave /x" in said.reason) is bool(holds)
    assert said.acceptances == [Acceptance.REQUIREMENTS] * (holds is None)
    required.unlink()
    said = _proof_of_requirements(robot, str)
    assert (
        said.acceptances == [Acceptance.REQUIREMENTS]
        and f"{required} is missing; restore it" in said.reason
    )


def test_a_demand_for_an_enclave_that_the_export_lacks_is_judged_by_the_keystore(
    tmp_path: Path,
) -> None:
    required = tmp_path / "required.toml"
    (tmp_path / "enclaves").mkdir()
    (tmp_path / "enclaves" / "governance.p7s").touch()
    required.write_text('[[must]]\npublish = ["/cmd_vel"]\nenclave = "/pendant"\n')
    answers = {f"{tmp_path}": 0, "keystore": 1}
    robot: Any = SimpleNamespace(
        requirements=required,
        export=tmp_path,
        rights_source="keystore",
        not_here=[],
        shell=SimpleNamespace(check=lambda place, *_: answers[place]),
    )
    assert _proof_of_requirements(robot, str).holds is False


OF_OTHERS = 9
"""The id of a process that trusts the robot's CA, but may not belong to the robot."""
FOREIGN = 10
"""The id of a process that trusts another CA."""
STOLEN = 11
"""The id of a process with other files; its certificate is revoked, as those of higher ids are."""
OF_ROS, UNKNOWN = 20, 21
"""The ids of processes that cannot be examined; the command of the first shows that it uses ROS."""


@pytest.mark.parametrize(
    ("processes", "not_here", "holds", "says"),
    [
        (robot(1, 2, 3), (), True, "3 processes of Fast DDS, each with all others"),
        (robot(1, 2, 3), ("/laptop",), True, "; sros cannot see processes on other machines"),
        (robot(1, 2, 3, deaf=[(1, 2)]), (), False, "do not hear each other; restart process 1"),
        (
            [*robot(1, 2), replace(robot(3)[0], own_ports=frozenset())],
            (),
            None,
            "sros cannot see whether process 3 (node3) in /node hears the others, because",
        ),
        (
            [*robot(1, 2), replace(robot(3)[0], lost_memory=True)],
            (),
            False,
            "process 3 (node3) in /node has lost its shared memory",
        ),
        (
            [replace(process, lost_memory=True) for process in robot(1, 2)],
            (),
            False,
            "process 1 (node1) in /node, process 2 (node2) in /node have lost their shared memory",
        ),
        (robot(1, 2, OF_OTHERS), (), True, "3 processes of Fast DDS, each with all others"),
        (
            robot(1, 2, OF_OTHERS, deaf=[(1, OF_OTHERS)]),
            (),
            None,
            "process 9 (node9) may also belong to the robot: process 1 (node1) in "
            "/node and process 9 (node9) in /node do not hear each other",
        ),
        (
            [*robot(1, 2), replace(robot(OF_OTHERS)[0], own_ports=frozenset())],
            (),
            None,
            "sros cannot see whether process 9 (node9) in /node hears the others",
        ),
        (robot(1, 2, FOREIGN, deaf=[(1, FOREIGN)]), (), True, "2 processes of Fast DDS"),
        (robot(1, 2, STOLEN, deaf=[(1, STOLEN)]), (), True, "2 processes of Fast DDS"),
        (robot(12, 13, OF_OTHERS, deaf=[(12, OF_OTHERS)]), (), None, "process 9 (node9) may also"),
        ([replace(process, own_ports=frozenset()) for process in robot(1, 2)], (), None, None),
        (robot(1), (), None, None),
        (
            robot(1, 2, OF_ROS),
            (),
            None,
            "sros cannot see whether process 20 (node20) hears the others, because it could not be "
            "examined: run the proof as root",
        ),
        (robot(1, OF_ROS), (), None, "process 20 (node20) hears the others"),
        (robot(1, 2, OF_ROS, deaf=[(1, 2)]), (), False, "do not hear each other"),
        (robot(1, 2, UNKNOWN), (), True, "; without processes that sros could not examine"),
    ],
)
def test_processes_that_have_not_connected_fail_the_proof(
    processes: list[Process],
    not_here: tuple[str, ...],
    holds: bool | None,
    says: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where sros sees no connections, it proves nothing, and `close` says so.

    A process of a user who cannot read the files only claims to run in an enclave, so it makes the
    proof neither hold nor fail.  Shared memory of another user shows an unexamined process of
    Fast DDS.
    """
    monkeypatch.setattr(proof, "_SHARED_MEMORY", tmp_path)
    in_domain = [
        replace(process, enclave=ProcessEnclave(f"/export{process.pid}", "/node"))
        for process in processes
        if process.pid < OF_ROS
    ]
    unseen = [
        UnseenProcess(process.pid, process.command, "hidden", process.pid == OF_ROS)
        for process in processes
        if process.pid >= OF_ROS
    ]
    running: Any = SimpleNamespace(
        in_domain=in_domain,
        processes=RunningProcesses(unseen=tuple(unseen)),
        secured=[
            (process, process.enclave)
            for process in in_domain
            if process.pid not in (FOREIGN, STOLEN)
        ],
        may_use_files=lambda process: process.pid not in (OF_OTHERS, FOREIGN),
        revokes=[process.enclave for process in in_domain if process.pid >= STOLEN].__contains__,
    )
    monkeypatch.setattr(
        proof,
        "group_by_authorities",
        lambda processes: [("ca", [each for each in processes if each.pid != FOREIGN])],
    )
    monkeypatch.setattr(proof, "RunningRobot", lambda *_: running)
    monkeypatch.setattr(proof, "wait_until", lambda *_: running)
    shell = SimpleNamespace(now=lambda: datetime.now(UTC))
    closed: Any = SimpleNamespace(shell=shell, not_here=not_here)
    proofs = [*_proof_of_connections(closed)]
    assert [said.holds for said in proofs] == [holds] * (says is not None)
    assert (says or "") in "".join(said.reason for said in proofs)
    for said in proofs:
        is_unseen = said.holds is None
        assert said.acceptances[-1:] == [Acceptance.CONNECTIONS] * is_unseen
        assert (Acceptance.UNEXAMINED in said.acceptances) is ("not be examined" in said.reason)
    if UNKNOWN in {process.pid for process in processes}:
        (tmp_path / "fastrtps_port7410").touch()
        running.secured = [
            (replace(process, user=os.geteuid() + 1), enclave)
            for process, enclave in running.secured
        ]
        (said,) = _proof_of_connections(closed)
        text = f"processes of user {os.geteuid()} with shared memory of Fast DDS hear the others"
        assert (said.holds, text in said.reason) == (None, True)


def test_a_node_that_others_do_not_see_on_zenoh_needs_its_enclave_in_its_command() -> None:
    variables = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
    process = Process(1, ("python3", "talk"), variables, datetime.now(UTC))
    now: Any = SimpleNamespace(secured=[(process, ProcessEnclave("/export", "/talker"))])
    unseen = _unseen_text(now, "/talker", "/talker")
    assert (
        "add `--ros-args --enclave /talker` at the end of the command of process 1 (talk)" in unseen
    )


def test_expired_files_are_named_with_the_keystore_that_renews_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The observer of the proof has expired as all others have, and cannot look at the robot."""
    now = datetime.now(UTC)
    ended, lasting = (Window(now - timedelta(9), now + timedelta(days)) for days in (-1, 1))
    expired = {"export": ["/s", "/sros_observer"], "keystore": ["/s", "/sros_observer", "/away"]}

    def survey(keystore: OpenedKeystore) -> object:
        names = expired[keystore.root.name]
        found = [Lifetime(name, lasting, ended) for name in names]
        return [*found, Lifetime("/later", lasting, lasting)], ()

    monkeypatch.setattr(proof, "survey", survey)
    robot: Any = SimpleNamespace(
        export=tmp_path / "export",
        keystore=tmp_path / "keystore",
        not_here=(),
        close_command="sros close robot",
        shell=SimpleNamespace(check=lambda *_: 1, now=lambda: now),
    )
    robot.export.mkdir()
    told, state = [], cast(Any, None)
    for change in (robot.keystore.mkdir, lambda: expired.update(keystore=[]), robot.keystore.rmdir):
        change()
        (said,) = proof.proofs_of(robot, state, 0)
        assert said.holds is False
        told.append(said.reason)
    then = f"run `sros close robot`, and restart all processes together: {robot.export}"
    begin = "the files of /s, /sros_observer have expired; "
    assert told[:2] == [
        f"{begin}run `sros renew {robot.keystore} /s /sros_observer`, and then {then}",
        f"{begin}{then}",
    ]
    assert f"{begin}renew them where the keystore is (`sros renew KEYSTORE --all" in told[2]

    def check_and_renew(*_: str) -> int:
        expired["export"] = []
        return 0

    robot.shell.check, robot.policy = check_and_renew, tmp_path / "policy.xml"
    (said,) = proof.proofs_of(robot, state, 0)
    assert said.holds is False, "nothing but the files was examined"


def test_listeners_of_what_nobody_may_send_any_more_are_named(tmp_path: Path) -> None:
    """Twin: another enclave may send it; where a DENY refuses it, the DENY is what is new."""
    hears = '<topics subscribe="ALLOW"><topic>/depth</topic></topics>'
    denies = f'{publish("/*")}<topics publish="DENY"><topic>/depth</topic></topics>'
    gone = Right("/altimeter", ALLOW, "publish", "/depth")
    robot: Any = SimpleNamespace(rights_source=tmp_path / "policy.xml")
    for own, other, alone in (
        (publish("/depth_m"), "", True),
        (denies, "", True),
        (publish("/depth_m"), publish("/depth"), False),
    ):
        enclaves = {"/altimeter": own, "/autopilot": hears, "/other": other}
        robot.rights_source.write_text(policy_text(enclaves))
        named = "/autopilot may subscribe /depth, but no enclave may publish it any more"
        assert _without_counterpart(robot, [gone]) == [named] * alone, own


@pytest.mark.parametrize("is_settled", [True, False])
def test_an_observer_that_did_not_see_everything_proves_no_silence(is_settled: bool) -> None:
    """A stranger that keeps changing the graph hides no open node behind a green proof."""
    value = {"nodes": [], "notes": [], "settled": is_settled}
    proof = _proof_of_silence(robot_beside_graph(value), Observation(), hears=True)
    assert proof.holds is (True if is_settled else None)


def test_a_listener_finds_what_writes_openly_under_the_name_of_a_tool() -> None:
    """Any program can have a node `_ros2cli_...`."""
    text = "left out, although these nodes write, ...: /_ros2cli_7 (publish topic /cmd_vel)"
    note = {"id": "graph.tool-writes", "text": text}
    value = {"nodes": [], "notes": [note], "settled": True}
    proof = _proof_of_silence(robot_beside_graph(value), Observation(), hears=True)
    assert proof.fails and "`ros2`: /_ros2cli_7 (publish topic /cmd_vel)" in proof.reason
    for holds in (True, False, None):
        told = _with_possible_cause(proof, [Proof(CONNECTED, holds, "")])
        assert ("a process that has not connected may" in "".join(told.details)) is (holds is False)


def robot_beside_graph(*values: dict[str, Any], **environment: str) -> Any:
    """Return a robot whose shell reads these JSON values, one for each listener."""
    left = iter(values)
    shell = SimpleNamespace(read_json=lambda _, without=(): (1, next(left)))
    shell.environment = environment
    return SimpleNamespace(folder=Path("robot"), domain=0, shell=shell)


@pytest.mark.parametrize(
    ("variables", "is_narrow"),
    [
        ({}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT", "ROS_LOCALHOST_ONLY": "0"}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "subnet"}, True),
        ({"ROS_LOCALHOST_ONLY": "1"}, True),
        ({"CYCLONEDDS_URI": "", "ROS_DISCOVERY_SERVER": ""}, False),
        *(({name: "x"}, True) for name in ("CYCLONEDDS_URI", "FASTRTPS_DEFAULT_PROFILES_FILE")),
        ({"FASTDDS_ENVIRONMENT_FILE": "x"}, True),
        ({"ROS_LOCALHOST_ONLY": "1", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, True),
        ({"ROS_LOCALHOST_ONLY": "1", "RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}, False),
    ],
)
def test_a_listener_that_sees_only_this_machine_is_not_the_only_one(
    variables: dict[str, str], is_narrow: bool
) -> None:
    """The second one sees other machines, but, on Cyclone DDS, not the nodes on this one."""
    nothing: dict[str, Any] = {"nodes": [], "notes": [], "settled": True}
    open_node = nothing | {"nodes": [{"namespace": "/far", "name": "open"}]}
    for seen, holds in (
        ([nothing, nothing], True),
        ([nothing, open_node], not is_narrow),
        ([open_node, nothing], False),
        ([nothing, nothing | {"settled": False}], None if is_narrow else True),
    ):
        proof = _proof_of_silence(robot_beside_graph(*seen, **variables), Observation(), hears=True)
        assert proof.holds is holds, seen


def test_a_verb_without_variables_leaves_them_as_they_were() -> None:
    variables, said = {"ROS_LOCALHOST_ONLY": "1", "HOME": "/home"}, list[str]()

    def run(words: Sequence[str], _: bool) -> tuple[int, str, str]:
        assert [*variables] == ["HOME"]
        return 0, f'{{"seen": "{words[0]}"}}', ""

    shell = Shell(run, said.append, variables, lambda: datetime.now(UTC), UTC)
    assert shell.read_json(["audit"], ["ROS_LOCALHOST_ONLY"]) == (0, {"seen": "audit"})
    assert said == ["+ env -u ROS_LOCALHOST_ONLY sros audit"]
    assert variables == {"ROS_LOCALHOST_ONLY": "1", "HOME": "/home"}


@pytest.mark.parametrize(
    ("has_keystore", "remedy"), [(True, "`sros close r` removes"), (False, "rm -r")]
)
def test_a_key_of_another_machine_in_the_export_fails_the_proof(
    has_keystore: bool, remedy: str, tmp_path: Path
) -> None:
    key = tmp_path / "export/enclaves/laptop/key.pem"
    key.parent.mkdir(parents=True)
    robot: Any = SimpleNamespace(
        export=tmp_path / "export",
        keystore=tmp_path if has_keystore else tmp_path / "gone",
        policy=tmp_path / "policy.xml",
        not_here={"/laptop"},
        close_command="sros close r",
        export_words=list,
        enclaves_outside_policy=list,
        shell=SimpleNamespace(check=lambda *_: 0, read_json=lambda _: (0, {"changes": []})),
    )
    assert proof._proof_of_files(robot, (), str).holds
    key.touch()
    said = proof._proof_of_files(robot, (), str)
    assert said.fails and "export has the private keys of /laptop, which" in said.reason
    assert remedy in said.reason
