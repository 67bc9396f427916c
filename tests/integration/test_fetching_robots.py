"""A fleet that fetches through everything that happens to robots, with live Cyclone DDS nodes.

Only in the long form of the tests: it takes many minutes.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.integration.fetching_robots import (
    HOME_ADDRESS,
    MISSING,
    Home,
    fetching_robots,
    fill,
    killed_at_random,
)
from tests.support.children import wait_for
from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import ONLY_LONG

pytestmark = [
    ONLY_LONG,
    pytest.mark.dds,
    pytest.mark.skipif(bool(MISSING), reason=f"not here: {', '.join(MISSING)}"),
    pytest.mark.skipif(os.getuid() != 0, reason="namespaces with addresses are made by root"),
]

ASLEEP, FULL, KILLED, RESTORED, STOLEN, LIAR, LATE = "r2", "r3", "r4", "r5", "r6", "r7", "r8"
NUMBER = 10
GENERATE = "generate_artifacts -k keystore -p policy.xml --fleet fleet.toml"


def write_policy(folder: Path, *more: str) -> None:
    hear = '<topics subscribe="ALLOW"><topic>/chatter</topic></topics>'
    rights = {"/{robot}/base": publish("/chatter", *more), "/{robot}/lift": hear}
    (folder / "policy.xml").write_text(policy_text(rights))


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Home]:
    write_policy(tmp_path)
    names = [f"r{number}" for number in range(1, NUMBER + 1)]
    (tmp_path / "fleet.toml").write_text(
        "[robots]\n" + "".join(f"{name} = {{}}\n" for name in names)
    )
    for line in (
        "create_keystore keystore --template production",
        GENERATE,
        "crl keystore --refresh",
        "fleet publish keystore srv/pub",
    ):
        sros(*line.split(), cwd=tmp_path).ok()
    (tmp_path / "srv/inbox").mkdir()
    with fetching_robots(tmp_path, NUMBER, small=FULL) as made:
        for robot in made.robots.values():
            if robot.name != KILLED:
                robot.start(behind="2d" if robot.name == LATE else "")
        yield made


def test_robots_that_fetch(home: Home) -> None:
    """First delivery, changed policy, renewal, revocation, and rotation of both CAs.

    One robot is asleep, one has a full disk, one is killed again and again, one has its disk
    restored, one sends the message of another, one is stolen, and one has the clock of two days
    ago.  No other one waits for them, and none is ever called current that is not.
    """
    robots = home.robots
    every = list(robots)
    with killed_at_random(robots[KILLED]) as rounds:
        states = home.until_current([name for name in every if name != LATE])
        assert states[LATE] == "never"
        assert "set the clock" in (robots[LATE].folder / "agent.log").read_text()
        robots[LATE].stop()
        robots[LATE].start()
        home.until_current(every)

        robots[RESTORED].stop()
        backup = shutil.copytree(robots[RESTORED].keystore, home.folder / "backup")
        robots[RESTORED].start()

        robots[ASLEEP].signal(signal.SIGSTOP)
        make_room = fill(robots[FULL].disk)
        write_policy(home.folder, "status")
        home.sros(*GENERATE.split()).ok()
        home.publish()
        states = home.until_current([name for name in every if name not in (ASLEEP, FULL)])
        assert states[ASLEEP] == states[FULL] == "earlier"
        robots[ASLEEP].signal(signal.SIGCONT)
        make_room()
        home.until_current(every)

        home.sros("renew", "keystore", "--all").ok()
        home.publish()
        home.until_current(every)

        robots[RESTORED].stop()
        shutil.rmtree(robots[RESTORED].keystore)
        shutil.copytree(backup, robots[RESTORED].keystore)
        said = message_of(home, RESTORED)
        robots[RESTORED].start()
        wait_for(lambda: message_of(home, RESTORED) != said, "a message of the restored robot")
        home.until_current(every)

        assert put_for_another(home) == "403"
        robots[LIAR].stop()
        inbox = home.folder / "srv/inbox"
        shutil.copy(inbox / "r1/confirmation.p7s", inbox / LIAR)
        refused = home.sros("fleet", "collect", "keystore", "srv/inbox")
        assert refused.status == 1 and LIAR in refused.out, refused
        robots[LIAR].start()
        home.until_current(every)

        home.sros("revoke", "keystore", "--robot", STOLEN).ok()
        home.publish()
        others = [name for name in every if name != STOLEN]
        states = home.until_current(others)
        assert states[STOLEN] == "revoked"

        robots[ASLEEP].signal(signal.SIGSTOP)
        home.sros("rotate_ca", "keystore", "--next").ok()
        home.publish()
        states = home.until_current([name for name in others if name != ASLEEP])
        assert states[ASLEEP] == "earlier"
        refused = home.sros("rotate_ca", "keystore", "--next")
        assert refused.status == 2 and ASLEEP in refused.err, refused
        robots[ASLEEP].signal(signal.SIGCONT)
        home.until_current(others)
        for _ in ("reissue", "retire"):
            home.sros("rotate_ca", "keystore", "--next").ok()
            home.publish()
            home.until_current(others)
    assert all(rounds), f"killed and ended rounds: {rounds}"
    assert home.lies == []


def message_of(home: Home, robot: str) -> bytes:
    return (home.folder / f"srv/inbox/{robot}/confirmation.p7s").read_bytes()


def put_for_another(home: Home) -> str:
    """Return the status that nginx answers a robot which writes the message of another one."""
    liar = home.robots[LIAR]
    place = liar.keystore / f"enclaves/{LIAR}/base"
    answered = subprocess.run(
        [
            *(*liar.machine.enter, "curl", "-s", "-o", "/dev/null", "-w", "%{http_code}"),
            *("--cacert", home.folder / "etc/server.cert.pem"),
            *("--cert", place / "cert.pem", "--key", place / "key.pem"),
            *("-T", home.folder / "fleet.toml"),
            f"https://{HOME_ADDRESS}/inbox/r1/confirmation.p7s",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    return answered.stdout
