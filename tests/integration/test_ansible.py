"""The Ansible collection, over real sshds: first delivery, and what comes after it.

One fleet goes through its life, in the order of these tests; each test says what it leaves.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.template import load_template
from tests.integration.robots import FAKETIME, MISSING, Fleet, fleet, names
from tests.support.children import LONG
from tests.support.harness import policy_text, publish, snapshot, sros, topics_of
from tests.support.long_form import ONLY_LONG, drawn, sometimes

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(bool(MISSING), reason=f"not here: {', '.join(MISSING)}"),
    pytest.mark.skipif(os.getuid() != 0, reason="an sshd changes users as root"),
]

BREAKS = "a robot breaks half way, and changed rights arrive"
ROBOTS = [name for name in names(3) if name != "r2" or drawn(BREAKS, 1 / 8)]
"""The second one is for the test in which it breaks."""
ARMS = '{groups = ["arms"]}'
FLEET = "[robots]\n" + "".join(f"{name} = {ARMS if name == 'r1' else '{}'}\n" for name in ROBOTS)
RIGHTS = {"/{robot}/a": publish("a"), "/{robot}/b": publish("b")}


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """Two or three robots, with two enclaves each, of which one of r1 expires in ten days."""
    folder = tmp_path_factory.mktemp("fleet")
    keystore = folder / "keystore"
    earlier = datetime.now(UTC) - timedelta(days=355)
    create_keystore(keystore, template=load_template("production"), now=earlier)
    create_enclaves(keystore, ["/r1/a"], now=earlier)
    (folder / "fleet.toml").write_text(FLEET)
    (folder / "policy.xml").write_text(policy_text(RIGHTS))
    words = ("-p", folder / "policy.xml", "--fleet", folder / "fleet.toml")
    sros("generate_artifacts", "-k", keystore, *words).ok()
    with fleet(folder, keystore) as made:
        for name in ROBOTS:
            made.add(name)
            made.variables[name] = {
                "sros_units": [
                    {"name": "a.service", "enclaves": [f"/{name}/a"]},
                    {"name": "b.service", "enclaves": [f"/{name}/b"]},
                ],
            }
        made.variables["all"] = {"sros_confirm": False}
        made.extra = {"sros_serial": "100%"}
        yield made


def home_files(made: Fleet, name: str) -> dict[str, bytes]:
    """Return the files that a robot should have, as an export gives them."""
    target = made.folder / "exports" / name
    shutil.rmtree(target, ignore_errors=True)
    sros("distribute_key", made.keystore, "--robot", name, target, "--keyless").ok()
    return {path: content for path, (_, content) in snapshot(target).items()}


def assert_current(made: Fleet, *which: str, own: str = "") -> None:
    """Assert that robots have the files of home and nothing else, closed to others.

    The folder ``own`` also has a key that was made on the robot, with its request.
    """
    for name in which:
        found = snapshot(made.robots[name].keystore)
        files = {path: content for path, (_, content) in found.items()}
        if own:
            files = {
                path: content
                for path, content in files.items()
                if path not in (f"{own}/key.pem", f"{own}/request.pem")
            }
        assert files == home_files(made, name)
        for path, (mode, _) in found.items():
            wanted = 0o600 if path.endswith("key.pem") else 0o644
            assert mode & 0o777 == (wanted if path.endswith((".pem", ".p7s")) else 0o700), path
        beside = os.listdir(made.robots[name].keystore.parent)
        due = {".keystore.sros-restart", ".keystore.sros-trusting"} if own else set()
        assert set(beside) - due == {"keystore", ".keystore.sros-lock", ".keystore.sros-delivered"}


def restarts(made: Fleet) -> list[list[str]]:
    """Return the units that were restarted on each robot since the last call."""
    return [robot.restarts() for robot in made.robots.values()]


def test_first_delivery_and_renewal(three: Fleet) -> None:
    """What expires is renewed; whoever is off line is named at the end."""
    three.stop("r3")
    before = (three.keystore / "enclaves/r1/a/cert.pem").read_bytes()
    done = three.play("renew", "--diff", "-v", status=2)
    assert done.changed == {"localhost", *ROBOTS[:-1]}
    assert "Not reached, or lost on the way: r3." in done.text
    assert "PRIVATE" not in done.text
    assert "+a private key" in done.text
    assert (three.keystore / "enclaves/r1/a/cert.pem").read_bytes() != before
    assert_current(three, *ROBOTS[:-1])
    assert restarts(three) == [[] for _ in ROBOTS], "no process can have run before"
    three.start("r3")


@ONLY_LONG
def test_a_wrong_clock(three: Fleet) -> None:
    """Whose clock is wrong cannot verify: nothing is installed, and nothing changes elsewhere."""
    if not FAKETIME:
        pytest.skip("libfaketime is needed")
    wrong = {"LD_PRELOAD": FAKETIME, "FAKETIME": "-400d"}
    robot = three.robots["r3"]
    robot.environment |= wrong
    three.stop("r3")
    three.start("r3")
    done = three.play("renew", status=2)
    assert not done.changed
    assert re.search("The clock of this robot is (399|400) days, [0-9:]+ behind", done.text)
    assert "certificate is not yet valid" in done.text
    assert "The earlier files stay." in done.text
    assert not robot.keystore.exists()
    three.stop("r3")
    for name in wrong:
        del robot.environment[name]
    three.start("r3")


@sometimes(BREAKS)
def test_changed_rights_and_a_robot_that_breaks_half_way(three: Fleet) -> None:
    """A unit that does not start ends the play; the next run restarts what still has to be."""
    variables: dict[str, Any] = {
        "sros_policies": [str(three.folder / "policy.xml")],
        "sros_fleet": str(three.folder / "fleet.toml"),
    }
    (three.folder / "policy.xml").write_text(policy_text(RIGHTS | {"/{robot}/b": publish("new")}))
    systemctl = three.robots["r2"].folder / "bin/systemctl"
    script = systemctl.read_text()
    systemctl.write_text("#!/bin/sh\nexit 1\n")
    done = three.play("change", status=2, **variables)
    assert {"localhost", "r1", "r2", "r3"} >= done.changed > {"localhost"}
    assert done.recap["r2"]["failed"] == 1
    due = three.robots["r2"].keystore.with_name(".keystore.sros-restart")
    assert "/r2/b" in json.loads(due.read_text())
    systemctl.write_text(script)

    done = three.play("change", **variables)
    assert "localhost" not in done.changed
    assert "r2" in done.changed
    assert_current(three, *ROBOTS)
    first, second, third = restarts(three)
    assert set(first) == {"b.service"}, "perhaps twice, because the play was stopped"
    assert second == ["b.service"], "the rights of the others are the same"
    assert third == []
    for name in ROBOTS:
        folder = three.robots[name].keystore / f"enclaves/{name}/b"
        assert topics_of(folder) == {"rt/new", "ros_discovery_info"}


@ONLY_LONG
def test_keys_that_are_made_on_the_robot(three: Fleet) -> None:
    """The private key never leaves; a delivery before the request is answered keeps it."""
    three.variables["r1"]["sros_own_keys"] = ["/r1/own"]
    policy = three.folder / "own.xml"
    policy.write_text(policy_text({"/{robot:arms}/own": publish("own")}))
    fleet_file = str(three.folder / "fleet.toml")
    done = three.play("requests", sros_policies=[str(policy)], sros_fleet=fleet_file)
    assert done.changed == {"localhost", "r1"}
    key = three.robots["r1"].keystore / "enclaves/r1/own/key.pem"
    made = key.read_bytes()
    assert made not in b"".join(content for _, content in snapshot(three.keystore).values())
    assert_current(three, *ROBOTS, own="enclaves/r1/own")
    sros("verify", three.robots["r1"].keystore).ok()
    assert restarts(three) == [[], [], []]


@sometimes("what follows a revocation")
def test_revocation(three: Fleet) -> None:
    """All others get the list, once; the revoked robot is left alone."""
    done = three.play("revoke", sros_revoke=["r3"])
    assert done.changed == {"localhost", *ROBOTS[:-1]}
    assert done.recap["r3"]["changed"] == done.recap["r3"]["failed"] == 0
    assert "Revoked: /r3/a, /r3/b." in " ".join(done.text.split())
    assert_current(three, *ROBOTS[:-1], own="enclaves/r1/own" if LONG else "")
    for name in ROBOTS[:-1]:
        assert (three.robots[name].keystore / f"enclaves/{name}/a/crl.pem").exists()
    restarted = [["a.service", "b.service"] for _ in ROBOTS[:-1]]
    assert restarts(three) == [*restarted, []]
    if not LONG:
        return
    done = three.play("revoke", sros_revoke=["r3"], sros_restarted=True)
    assert done.changed == {"r1"}, "the process of /r1/own, which no unit runs, was restarted"


@ONLY_LONG
def test_what_robots_confirm(three: Fleet) -> None:
    """A robot without sros says exactly what sros would say of its folder."""
    done = three.play("status", sros_hosts="r1:r2", sros_confirm=True)
    assert not done.changed
    assert "3 robots: 2 current, 1 revoked" in done.text
    status = json.loads(sros("fleet", "status", three.keystore, "--json").out)
    assert status["complete"]
    states = {each["robot"]: each["state"] for each in status["robots"]}
    assert states == {"r1": "current", "r2": "current", "r3": "revoked"}
    kept = json.loads((three.keystore / "confirmed/r1.json").read_text())["confirmation"]
    said = sros("fleet", "report", three.robots["r1"].keystore, "--robot", "r1").ok()
    by_sros = {**json.loads(said.out), "time": kept["time"]}
    own, others = (
        {each["path"]: each["version"] for each in confirmed.pop("dds")["libraries"]}
        for confirmed in (by_sros, kept)
    )
    for path in own.keys() & others.keys():  # processes come and go
        assert others[path] in (own[path], ""), "a wheel's version is only in its metadata"
    for due in ("restart", "crl_restart"):
        assert kept.pop(due) == [], "which sros does not know"
    assert by_sros.pop("problems") == [], "which the play tells by failing"
    assert by_sros == kept
