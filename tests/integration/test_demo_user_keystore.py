"""Users' own keystores and scenarios, over a real DDS."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.demo.backend import RCLPY
from sros_tool.demo.casting import open_user_keystore
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.errors import SrosError
from sros_tool.files import policies_dir
from tests.demo.test_demo_keystores import HEARS, ROBOT, make_keystore
from tests.demo.weak_robots import OTHERS, WEAK, WIDEST, Place
from tests.integration.enforcing import BACKENDS, enforcing_backend
from tests.integration.test_demo_attacks import needs_isolation
from tests.support.children import LONG
from tests.support.harness import policy_text, publish, snapshot, sros
from tests.support.long_form import ONLY_LONG, some, sometimes

pytestmark = pytest.mark.dds


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    root = tmp_path / "robot"
    sros("create_keystore", root, "--template", "production").ok()
    sros("generate_artifacts", "-k", root, "-p", policies_dir() / "mobile_robot.xml").ok()
    return root


def test_who_plays_which_part_in_a_robot(robot: Path, tmp_path: Path) -> None:
    user = open_user_keystore(robot, "/cmd_vel", ATTACKS, datetime.now(UTC))
    assert user.topic == "/cmd_vel"
    assert user.cast["talker"] == "/mobile_robot/velocity_mux"
    assert user.cast["listener"] == "/mobile_robot/base"
    assert user.cast["guest"] not in (user.cast["talker"], user.cast["listener"])
    assert {"server", "client"} <= set(user.cast)
    assert user.template.unique_subject
    user.copy(tmp_path / "copy")
    copied = set(snapshot(tmp_path / "copy"))
    assert not [path for path in copied if "ca.key" in path]
    talker = "enclaves/mobile_robot/velocity_mux/key.pem"
    assert copied >= {talker, "public/identity_ca.cert.pem", "enclaves/governance.p7s"}
    assert "enclaves/mobile_robot/teleop/key.pem" not in copied or "/mobile_robot/teleop" in (
        user.cast.values()
    )
    with pytest.raises(SrosError, match="no two enclaves"):
        open_user_keystore(robot, "/no_such_topic", ATTACKS, datetime.now(UTC))


@sometimes("a robot under attack")
@needs_isolation
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_robot_under_attack(backend: str, robot: Path) -> None:
    """Each enclave of a robot is attacked with what its own permissions leave out."""
    enforcing_backend(backend)
    before = snapshot(robot)
    words = some(
        ["a talker listens", "a listener publishes", "was not given", "poses as", "injects"], 1
    )
    only = [argument for word in words for argument in ("--only", word)]
    ended = sros(
        *("demo", "--backend", backend, "--scenario", "attacks", "--keystore", robot, "--json"),
        *only,
    )
    assert ended.status == 0, ended
    assert snapshot(robot) == before
    shown = json.loads(ended.out)
    assert [row["name"] for row in shown["rows"] if row["observed"] == "skipped"] == []
    assert len(shown["rows"]) >= 2 * len(words)
    cast = {each["part"]: each for each in shown["scenarios"][0]["cast"]}
    parts = {"talker", "listener", "guest", "server", "client"}
    assert parts <= set(cast) if LONG else cast
    for each in cast.values():
        assert each["enclave"].startswith("/mobile_robot/")
        assert bool(each["nodes"]) is (backend == RCLPY)


@needs_isolation
def test_a_right_that_nobody_else_has_to_lack_is_open_until_it_is_accepted(tmp_path: Path) -> None:
    both = f"{publish('/image')}{HEARS}"
    root = make_keystore(tmp_path, {"/a": both, "/b": both, "/c": publish("/x")})
    name = "a talker listens"
    words = ("--scenario", "attacks", "--keystore", root, "--only", name, "--accept-open", name)
    ended = sros("demo", "--backend", "cyclone", *words).ok()
    assert "the permissions of /a allow it to subscribe /image" in ended.out
    assert "accepted with --accept-open" in ended.out


ODD = ("/odd/expired", "/odd/foreign", "/odd/gone", "/odd/signed", "/odd/wild")


@sometimes("many weaknesses of one keystore")
@needs_isolation
def test_weaknesses_of_one_keystore_are_each_named_and_nothing_else(tmp_path: Path) -> None:
    rights = ROBOT | {name: publish(f"/t{place}") for place, name in enumerate(ODD)}
    root = make_keystore(tmp_path, rights)
    foreign = make_keystore(tmp_path, rights, name="foreign")
    expected = {"/odd/expired", "/odd/foreign", "/odd/signed"}
    broken = {f"{name} {OTHERS}" for name in expected}
    for victim, name in (
        ("/odd/wild", "one enclave that may do everything"),
        ("/odd/expired", "an expired certificate"),
        ("/odd/foreign", "a certificate of another CA"),
        ("/odd/signed", "permissions of another CA"),
        ("/odd/wild", "revocation lists not delivered"),
        ("/odd/wild", "nothing protected"),
    ):
        WEAK[name].weaken(Place(root, foreign, victim, "/odd/gone"))
        broken |= set(WEAK[name].broken)
    sound = ("an unsecured node injects", "a talker listens", "permissions edited")
    words = [word for name in (OTHERS, *broken, *sound) for word in ("--only", name)]
    before = snapshot(root)
    ended = sros(
        *("demo", "--backend", "cyclone", "--scenario", "attacks", "--keystore", root, "--json"),
        *words,
    )
    assert snapshot(root) == before
    rows = {row["name"]: row for row in json.loads(ended.out)["rows"]}
    assert {name for name, row in rows.items() if not row["as_expected"]} == broken, rows
    assert set(sound) <= set(rows)
    assert {name for name, row in rows.items() if row["open_here"]} == set(WIDEST)
    assert ended.status == 1


@needs_isolation
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", [pytest.param(each, marks=ONLY_LONG) for each in ("", *WEAK)])
def test_a_weak_robot_fails_in_the_rows_of_its_weakness(
    backend: str, name: str, robot: Path, tmp_path: Path
) -> None:
    """All attacks that keep their defenses, in a robot of ROS nodes; a sound one fails in none."""
    enforcing = enforcing_backend(backend)
    victim, other = "/mobile_robot/teleop", "/mobile_robot/monitor"
    broken: set[str] = set()
    if name:
        weak = WEAK[name]
        sros("create_keystore", foreign := tmp_path / "others", "--template", "production").ok()
        sros("create_enclave", foreign, victim).ok()
        weak.weaken(Place(robot, foreign, victim, other))
        broken = weak.broken_on(enforcing)
    names = [row.name for row in ATTACKS.rows if not row.defence_removed] + [
        OTHERS,
        "the widest enclave",
    ]
    words = [word for each in names for word in ("--only", each)]
    ended = sros(
        *("demo", "--backend", backend, "--scenario", "attacks", "--keystore", robot, "--json"),
        *words,
    )
    assert ended.out, ended
    rows = {row["name"]: row for row in json.loads(ended.out)["rows"]}
    joining = {each for each in rows if OTHERS in each}
    assert bool(joining) is bool(name and WEAK[name].joins)
    assert {each for each, row in rows.items() if not row["as_expected"]} == broken | joining
    assert ended.status == bool(broken | joining)


@sometimes("a robot without the keys of its authorities")
@needs_isolation
def test_a_robot_without_the_keys_of_its_authorities(robot: Path) -> None:
    """What needs a signature of the CA is skipped with the reason, and so nothing is proved."""
    shutil.move(robot / "private", robot.parent / "offline")
    before = snapshot(robot)
    words = ("publishes a topic that it was not", "old permissions put back", "permissions edited")
    only = [argument for word in words for argument in ("--only", word)]
    ended = sros(
        *("demo", "--backend", "cyclone", "--scenario", "attacks", "--keystore", robot),
        *("--topic", "/cmd_vel", "--json", *only),
    )
    assert ended.status == 2, ended
    assert snapshot(robot) == before
    shown = json.loads(ended.out)
    assert shown["scenarios"][0]["keystore"]["not_tried"] == [
        "old permissions put back after renewal",
        "old permissions put back after revocation",
    ]
    rows = {row["name"]: row for row in shown["rows"]}
    assert rows["permissions edited"]["observed"] == "not let in"
    assert rows["an enclave publishes a topic that it was not given"]["observed"] == "refused"
    skipped = rows["old permissions put back"]
    assert skipped["observed"] == "skipped"
    assert "the key of the" in skipped["detail"]
    assert all(row["as_expected"] for row in rows.values())


OFF = """description = "nothing is protected"
[authorities]
layout = "separate"
validity = "1y"
[certificates]
validity = "1y"
[permissions]
validity = "1y"
default = "node_basics"
[protection]
rtps = "NONE"
discovery = "NONE"
liveliness = "NONE"
allow_unauthenticated_participants = true
join_access_control = false
[protection.default]
data = "NONE"
metadata = "NONE"
read_access_control = false
write_access_control = false
discovery = false
liveliness = false
"""


@sometimes("what a keystore opens by itself", 1 / 2)
@needs_isolation
def test_what_a_keystore_opens_by_itself_fails_until_it_is_accepted_by_name(
    tmp_path: Path,
) -> None:
    rights = {"/a": publish("/image"), "/b": HEARS, "/c": publish("/x")}
    (tmp_path / "off.toml").write_text(OFF)
    weak = make_keystore(tmp_path, rights, tmp_path / "off.toml")
    wire, spy = "payload read on the wire", "an unsecured node listens"
    words = ("--only", wire, "--only", spy, "--only", "topic names read")
    attack = ("demo", "--backend", "cyclone", "--scenario", "attacks", *words)
    ended = sros(*attack, "--keystore", weak, "--accept-open", wire)
    assert ended.status == 1, ended
    assert f"open  {wire} " in ended.out and f"OPEN  {spy} " in ended.out
    assert "open  topic names read in the handshake" in ended.out


SCENARIO = """policy = "robot.xml"
party = [
    { name = "camera", role = "talker", enclave = "/arm/camera", topic = "/image" },
    { name = "viewer", role = "listener", enclave = "/arm/viewer", topic = "/image" },
    { name = "stranger", role = "talker", enclave = "/arm/viewer", topic = "/image" },
    { name = "spy", role = "listener", topic = "/image" },
]

[[row]]
name = "a spy does not see the camera"
claim = { listener = "spy", talker = "camera", expected = "not heard" }
control = { listener = "viewer", talker = "camera", expected = "heard" }

[[row]]
name = "a viewer does not send images"
claim = { party = "stranger", expected = "refused" }
control = { listener = "viewer", talker = "camera", expected = "heard" }

[[row]]
name = "what is wrong is told"
claim = { party = "stranger", expected = "started" }
"""


@sometimes("a scenario of a user")
def test_a_scenario_of_a_user(tmp_path: Path) -> None:
    policy = policy_text({"/arm/camera": publish("/image"), "/arm/viewer": HEARS})
    (tmp_path / "robot.xml").write_text(policy)
    (tmp_path / "mine.toml").write_text(SCENARIO)
    ended = sros("demo", "--backend", "cyclone", "--scenario", tmp_path / "mine.toml", "--json")
    shown = json.loads(ended.out)
    assert [row["observed"] for row in shown["rows"]] == ["not heard", "refused", "refused"]
    assert [row["as_expected"] for row in shown["rows"]] == [True, True, False]
    assert ended.status == 1
    loaded = {f"{library['product']} {library['version']}" for library in shown["libraries"]}
    assert shown["dds"] in loaded, "what the processes had mapped"
    assert shown["vulnerabilities"].count("which the processes loaded") == len(loaded)
