"""Twenty robots through Ansible: a complete CA rotation under live Cyclone DDS nodes, and kills.

Only in the long form of the tests: it takes many minutes.
"""

from __future__ import annotations

import json
import os
import random
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sros_tool.keystore.lifecycle.create import create_keystore
from sros_tool.keystore.template import load_template
from sros_tool.runtime.events import EventKind, read_events
from tests.integration.robots import CHECKOUT, MISSING, Fleet, Robot, end_all, fleet, names
from tests.integration.test_ansible import assert_current
from tests.support.children import LONG, wait_for
from tests.support.harness import policy_text, publish, sros

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(not LONG, reason="only in the long form"),
    pytest.mark.skipif(bool(MISSING), reason=f"not here: {', '.join(MISSING)}"),
    pytest.mark.skipif(os.getuid() != 0, reason="an sshd changes users as root"),
]

ROBOTS = names(20)
TALKERS, LISTENERS = ("r1", "r2"), ("r3", "r4")
DOMAIN = 73
UNIT = "base.service"
ENOUGH = 3
SILENCE = 20.0


@pytest.fixture(scope="module")
def twenty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """Twenty robots, four of which run a node of Cyclone DDS."""
    folder = tmp_path_factory.mktemp("fleet")
    keystore = folder / "keystore"
    hear = '<topics subscribe="ALLOW"><topic>chatter</topic></topics>'
    rights = {"/{robot:talkers}/base": publish("chatter"), "/{robot:listeners}/base": hear}
    (folder / "policy.xml").write_text(policy_text(rights))
    create_keystore(keystore, template=load_template("production"), now=datetime.now(UTC))
    sros("update_keystore", keystore, "--domain", DOMAIN, "--allow-looser").ok()
    robots = "".join(
        f'{name} = {{groups = ["{"listeners" if name in LISTENERS else "talkers"}"]}}\n'
        for name in ROBOTS
    )
    (folder / "fleet.toml").write_text(f"[robots]\n{robots}")
    words = ("-p", folder / "policy.xml", "--fleet", folder / "fleet.toml")
    sros("generate_artifacts", "-k", keystore, *words).ok()
    with fleet(folder, keystore) as made:
        for name in ROBOTS:
            robot = made.add(name)
            made.variables[name] = {
                "sros_units": [{"name": UNIT, "enclaves": [f"/{name}/base"]}],
            }
            if name in (*TALKERS, *LISTENERS):
                write_unit(robot)
        yield made


def write_unit(robot: Robot) -> None:
    """Write what `systemctl` starts: a talker or a listener in the robot's enclave."""
    environment = {
        "PYTHONPATH": str(CHECKOUT),
        "ROS_SECURITY_KEYSTORE": str(robot.keystore),
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_ENCLAVE_OVERRIDE": f"/{robot.name}/base",
        "ROS_DOMAIN_ID": str(DOMAIN),
    }
    role = "talker" if robot.name in TALKERS else "listener"
    words = [sys.executable, "-m", "sros_tool.demo.cyclone_node", role, "--topic", "/chatter"]
    words += ["--text", f"from {robot.name};", "--period", "0.2", "--report", str(report(robot))]
    assignments = "".join(
        f"export {key}={shlex.quote(each)}\n" for key, each in environment.items()
    )
    unit = robot.folder / "units" / UNIT
    unit.write_text(f"#!/bin/sh\n{assignments}exec {shlex.join(words)}\n")
    unit.chmod(0o755)


def report(robot: Robot) -> Path:
    return robot.folder / "report.jsonl"


def start_node(made: Fleet, robot: Robot) -> None:
    before = ready(robot)
    command = [*made.inside, str(robot.folder / "bin/systemctl"), "restart", UNIT]
    subprocess.run(command, check=True)
    wait_for(lambda: ready(robot) > before, f"the node of {robot.name}")


def ready(robot: Robot) -> int:
    path = report(robot)
    events = read_events(path) if path.exists() else []
    return sum(event.kind is EventKind.READY for event in events)


def heard(made: Fleet, listener: str, talker: str) -> int:
    events = read_events(report(made.robots[listener]))
    return sum(
        event.kind is EventKind.HEARD and event.text.startswith(f"from {talker};")
        for event in events
    )


def hears(made: Fleet, listener: str, talker: str, *, expected: bool = True) -> bool:
    """Return whether a listener hears a talker from now on; longer awaited where expected."""
    enough = heard(made, listener, talker) + ENOUGH
    end = time.monotonic() + (300 if expected else SILENCE)
    while heard(made, listener, talker) < enough:
        if time.monotonic() > end:
            return False
        time.sleep(0.1)
    return True


def assert_all_talk(made: Fleet) -> None:
    for listener in LISTENERS:
        for talker in TALKERS:
            assert hears(made, listener, talker), (listener, talker)


def issuing(made: Fleet) -> list[str]:
    status = json.loads(sros("rotate_ca", made.keystore, "--status", "--json").ok().out)
    return [each["sha256"] for each in status["authorities"] if each["state"] == "issuing"]


def stage(made: Fleet) -> str:
    status = sros("rotate_ca", made.keystore, "--status", "--json").ok().out
    return str(json.loads(status)["stage"])


def note(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


def kill_at_random(made: Fleet, play: str, times: int, within: float, **variables: object) -> None:
    """Begin a play some times, and kill it with all its processes here at a random moment."""
    for _ in range(times):
        process = made.begin(play, **variables)
        moment = random.uniform(1, within)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            end_all(process)
            note(f"killed {play} after {moment:.1f} s, keystore at {stage(made)}")
        else:
            process.communicate()
            note(f"{play} ended within {moment:.1f} s")


def test_twenty_robots(twenty: Fleet) -> None:
    made = twenty
    note("first delivery, killed, and one robot off line")
    made.stop("r20")
    kill_at_random(made, "deliver", 3, 25)
    done = made.play("deliver", status=2)
    assert "lost on the way: r20." in done.text
    made.start("r20")
    assert made.play("deliver").changed == {"r20"}
    assert_current(made, *ROBOTS)
    assert not made.play("deliver").changed
    for name in (*TALKERS, *LISTENERS):
        start_node(made, made.robots[name])
    assert_all_talk(made)

    note("rotation: a robot off line stops it, before anybody is restarted")
    old = issuing(made)
    made.stop("r19")
    done = made.play("rotate", status=2, sros_replace_ca=old)
    assert "The rotation does not go on, because r19 did not" in done.text
    assert stage(made) == "distribute"
    made.start("r19")

    note("distribute: a robot that is not restarted yet talks with those that are")
    broken = made.robots["r4"].folder / "bin/systemctl"
    script = broken.read_text()
    broken.write_text("#!/bin/sh\nexit 1\n")
    before = ready(made.robots["r1"])
    variables: dict[str, Any] = {
        "sros_replace_ca": old,
        "sros_stage": "distribute",
        "sros_serial": "100%",
    }
    made.play("rotation_stage", status=2, **variables)
    assert ready(made.robots["r1"]) > before
    assert_all_talk(made)
    broken.write_text(script)
    kill_at_random(made, "rotation_stage", 3, 60, **variables)
    made.play("rotation_stage", **variables)
    assert not made.play("rotation_stage", **variables).changed
    assert stage(made) == "distribute"
    assert_all_talk(made)

    note("reissue: a robot that is not restarted is cut off until it is")
    broken.write_text("#!/bin/sh\nexit 1\n")
    variables["sros_stage"] = "reissue"
    made.play("rotation_stage", status=2, **variables)
    assert stage(made) == "reissue"
    assert all(hears(made, "r3", talker) for talker in TALKERS)
    assert not any(hears(made, "r4", talker, expected=False) for talker in TALKERS)
    broken.write_text(script)
    made.play("rotation_stage", **variables)
    assert_all_talk(made)

    note("the rest, killed at random moments")
    kill_at_random(made, "rotate", 4, 60, sros_replace_ca=old)
    made.play("rotate", sros_replace_ca=old)
    assert stage(made) == "none"
    assert not set(issuing(made)) & set(old)
    assert_current(made, *ROBOTS)
    assert_all_talk(made)
    assert not made.play("rotate", sros_replace_ca=old).changed

    note("revocation of a talker that runs: it is heard no more, the others are")
    made.play("revoke", sros_revoke=["r2"])
    assert all(hears(made, each, "r1") for each in LISTENERS)
    assert not any(hears(made, each, "r2", expected=False) for each in LISTENERS)
    assert ready(made.robots["r2"])
    assert not made.play("revoke", sros_revoke=["r2"]).changed
    note("done")
