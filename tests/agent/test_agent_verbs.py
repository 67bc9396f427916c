"""The verbs of the agent, from what home publishes to what it takes in, with every part real."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from sros_tool.agent import install
from sros_tool.keystore.reader import read_certificate
from sros_tool.pki.certificates import validity_of
from sros_tool.runtime.processes import ProcessTable, RunningProcesses, UnseenProcess
from tests.cli.test_json import Seen
from tests.support.harness import Ended, copy_of, policy_text, publish, snapshot, sros

FLEET = """
[groups.renewing]
renewal = "allowed"
[robots]
r1 = { groups = ["renewing"] }
r2 = {}
"""
NAMES = ("/r1/a", "/r1/b")


@dataclass
class World:
    """A keystore with a fleet, what it publishes, the folder of r1, and an inbox."""

    folder: Path
    monkeypatch: pytest.MonkeyPatch

    def run(self, *words: object) -> Ended:
        return sros(*words, cwd=self.folder)

    def go_to(self, moment: datetime) -> None:
        """Set the clock of home and of the robot."""
        self.monkeypatch.setattr("sros_tool.cli.common._clock", lambda: moment)

    def agent(self, *words: object) -> Ended:
        return self.run("agent", "run", "robot", "--once", *words)

    def collected(self) -> dict[str, Any]:
        """Return what home takes in of r1."""
        said = json.loads(self.run("fleet", "collect", "ks", "inbox", "--json").out)
        return next(robot for robot in said["robots"] if robot["robot"] == "r1")

    def status(self) -> dict[str, Any]:
        said = json.loads(self.run("fleet", "status", "ks", "--json").out)
        return next(robot for robot in said["robots"] if robot["robot"] == "r1")


INIT = (
    *("agent", "init", "robot", "--robot", "r1", "--from", "pub", "--inbox", "inbox"),
    *("--root", "pub/metadata/1.root.json"),
)
UNIT = ("--restart", "--unit", "a.service=/r1/a", "--systemctl", "true")
CLOSED = RunningProcesses((), (UnseenProcess(9, ("x",), "it is closed", uses_ros=False),))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keystore, published, and the robot's folder before its agent; only to be copied."""
    folder = tmp_path_factory.mktemp("agent")
    (folder / "fleet.toml").write_text(FLEET)
    names = {f"/{{robot}}/{name}": publish("/x") for name in ("a", "b")}
    (folder / "p.xml").write_text(policy_text(names))
    for words in (
        "generate_artifacts -k ks -p p.xml --fleet fleet.toml",
        "distribute_key ks --robot r1 robot",
        "fleet publish ks pub",
    ):
        sros(*words.split(), cwd=folder).ok()
    (folder / "inbox").mkdir()
    return folder


@pytest.fixture
def world(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    copy_of(prepared, tmp_path / "world")
    yield World(tmp_path / "world", monkeypatch)


def test_init_with_force_keeps_what_is_not_given(world: World) -> None:
    world.run(*INIT, *UNIT, "--restart-if", "true").ok()
    settings = world.folder / "robot/.agent/agent.toml"
    before = settings.read_text()
    ca = ("--ca", "ks/public/permissions_ca.cert.pem")
    kept = "--robot, --from, --inbox, --restart, --restart-if, --systemctl, --unit, --root"
    assert f"kept the earlier {kept}\n" in world.run("agent", "init", "robot", *ca, "--force").out
    authorities = next(
        line for line in settings.read_text().splitlines(keepends=True) if "author" in line
    )
    assert settings.read_text().replace(authorities, "") == before
    assert world.agent().ok().out.startswith("release "), "the root metadata stays, too"
    anew = ("--no-restart", "--restart-if", "", "--unit", "b.service=/r1/b", "--json")
    said = json.loads(world.run("agent", "init", "robot", *anew, "--force").ok().out)
    assert said["kept"] == ["--robot", "--from", "--inbox", "--ca", "--systemctl", "--root"]
    text = settings.read_text()
    assert authorities in text and "restart = false" in text and "b.service" in text
    assert "restart_if" not in text and "a.service" not in text
    settings.write_text("robot = 1")
    refused = world.run("agent", "init", "robot", "--force")
    assert refused.status == 2 and "--robot" in refused.err
    assert "kept" not in world.run(*INIT, "--force").ok().out


def test_from_home_to_the_robot_and_back(world: World) -> None:
    world.monkeypatch.setattr(ProcessTable, "look", lambda *_: CLOSED)
    seen = Seen()
    planned = world.run(*INIT, *UNIT, "--dry-run", "--json").ok()
    assert not (world.folder / "robot/.agent").exists()
    made = world.run(*INIT, *UNIT, "--json").ok()
    assert json.loads(planned.out)["changes"] == json.loads(made.out)["changes"]
    again = world.run(*INIT)
    assert again.status == 2 and "already has an agent" in again.err
    for ended in (planned, made):
        seen.check("agent init", ended)
    assert world.run("agent", "status", "robot").status == 1, "it has not run yet"
    first = world.agent("--restarted").ok()
    said, sent = first.out.splitlines()
    assert said.startswith("release ") and said.endswith(": nothing changed")
    assert sent == "message sent"
    assert world.collected()["outcome"] == "kept"
    assert world.status()["state"] == "current"
    world.run("revoke", "ks", "--robot", "r2").ok()
    world.run("fleet", "publish", "ks", "pub").ok()
    assert world.status()["state"] != "current"
    second = world.agent("--json").ok()
    seen.check("agent run", second)
    value = json.loads(second.out)
    assert value["restarted"] == [{"name": "a.service", "enclaves": ["/r1/a"]}]
    assert value["changed"] == [*NAMES] and value["sent"] and not value["problems"]
    assert (world.folder / "robot/enclaves/r1/a/crl.pem").exists()
    assert world.collected()["outcome"] == "kept"
    status = world.run("agent", "status", "robot", "--json")
    seen.check("agent status", status)
    for verb in ("agent init", "agent run", "agent status"):
        assert seen.unseen(verb) == []
    assert json.loads(status.out)["release"] == value["release"] > int(said.split()[1].rstrip(":"))
    world.run("verify", "robot").ok()


def test_renewal_without_anybody_at_the_robot(world: World) -> None:
    world.run(*INIT).ok()
    world.agent().ok()
    certificate = world.folder / "robot/enclaves/r1/a/cert.pem"
    before = read_certificate(certificate)
    validity = validity_of(before)
    late = validity.not_after - (validity.not_after - validity.not_before) / 4
    world.go_to(late)
    world.run("renew", "ks", "/r1/b").ok()
    world.run("fleet", "publish", "ks", "pub").ok()
    asked = world.agent()
    assert "asked for renewal of 1 enclave" in asked.out, asked
    took = world.collected()
    assert [request["outcome"] for request in took["requests"]] == ["renewed"], took
    world.go_to(late + timedelta(minutes=10))
    world.run("fleet", "publish", "ks", "pub").ok()
    done = world.agent()
    assert "changed 1 enclave" in done.out, done
    after = read_certificate(certificate)
    assert validity_of(after).not_before > validity.not_before
    assert after.public_key() == before.public_key()
    assert "asked for" not in done.out
    world.run("verify", "robot").ok()


def test_what_is_said_restarted_has_no_files_of_the_same_round(world: World) -> None:
    """They came after the restart, so that its processes have the files of before."""
    world.monkeypatch.setattr(ProcessTable, "look", lambda *_: CLOSED)
    world.run(*INIT).ok()
    world.agent("--restarted").ok()
    world.run("renew", "ks", "/r1/a").ok()
    world.run("fleet", "publish", "ks", "pub").ok()
    early = world.agent("--restarted").ok().out
    assert "that this round installed: files of /r1/a\nrestart due: /r1/a\n" in early
    assert "restart" not in world.agent("--restarted").ok().out
    world.run("renew", "ks", "/r1/a").ok()
    world.run("fleet", "publish", "ks", "pub").ok()
    waits = "the agent itself restarts /r1/a in the first round in which"
    restarts = "\nrestarted a.service (/r1/a)\nrestart due: /r1/a\n"
    for command, text in (("false", waits), ("true", restarts)):
        world.run(*INIT, *UNIT, "--force", "--restart-if", command).ok()
        assert text in world.agent().ok().out
        shown = world.run("agent", "status", "robot")
        assert shown.status == 1 and (waits in shown.out) == (text == waits)


def test_a_robot_that_was_away_for_a_month_goes_on(world: World) -> None:
    world.run(*INIT).ok()
    world.agent().ok()
    before = snapshot(world.folder / "robot/enclaves")
    world.go_to(datetime.now(UTC) + timedelta(days=30))
    frozen = world.agent()
    assert frozen.status == 1 and "expired" in frozen.err and "set the clock" in frozen.err
    assert "message sent" in frozen.out
    assert snapshot(world.folder / "robot/enclaves") == before
    world.run("renew", "ks", "/r1/a").ok()
    world.run("fleet", "publish", "ks", "pub").ok()
    assert "changed 1 enclave" in world.agent().ok().out


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--robot", "../r1"), "not the name of a robot"),
        (("--from", "ftp://x"), "neither a URL"),
        (("--unit", "camera.service"), "names no enclave"),
        (("--unit", "camera=/r1/a"), "not the name of a service"),
        (("--ca", "x"), "neither a certificate file nor"),
        (("--root", "ks/sros.toml"), "not the root metadata"),
        (("--systemctl", ""), "systemctl is empty"),
        (("--restart-if", "test 'a"), "--restart-if is not a command"),
    ],
)
def test_wrong_options_set_up_nothing(words: tuple[str, ...], why: str, world: World) -> None:
    option, value = words
    given = dict(zip(INIT[3::2], INIT[4::2], strict=True)) | {option: value}
    refused = world.run(*INIT[:3], *(word for pair in given.items() for word in pair))
    assert refused.status == 2 and why in refused.err, refused
    assert len(refused.err.splitlines()) == 1
    assert not (world.folder / "robot/.agent/agent.toml").exists()
    assert world.agent().status == 2


def test_a_robot_that_trusts_no_ca_gets_no_agent(world: World) -> None:
    (world.folder / "empty").mkdir()
    words = [word if word != "robot" else "empty" for word in INIT]
    assert "has no permissions CA" in world.run(*words).err
    world.run(*words, "--ca", "0" * 64).ok()


def test_what_was_reached_before_is_nothing_of_another_source(world: World) -> None:
    world.run(*INIT).ok()
    world.agent("--restarted").ok()
    (world.folder / "pub").rename(world.folder / "moved")
    assert world.agent().status == 1
    assert "/pub': No such file" in world.run("agent", "status", "robot").out
    moved = [word.replace("pub", "moved") for word in INIT]
    world.run(*moved, "--force").ok()
    lines = world.run("agent", "status", "robot").out.splitlines()
    assert lines[1] == f"source reached never: {world.folder / 'moved'}"
    assert len(lines) == 4 and lines[3].startswith("The agent did not reach the source and the in")
    world.agent().ok()
    assert re.search("source reached .* ago: ", world.run("agent", "status", "robot").out)


def test_a_release_of_which_an_enclave_lacks_its_key(world: World) -> None:
    world.run(*INIT).ok()
    shutil.rmtree(world.folder / "robot/enclaves/r1/b")
    said = world.agent().out.splitlines()[0]
    assert re.fullmatch("release [0-9]+, not yet complete: nothing changed", said)
    assert re.search(
        "^robot r1: release [0-9]+, not yet", world.run("agent", "status", "robot").out
    )


def test_a_full_disk_with_room_for_the_revocation_list(world: World) -> None:
    """The list is installed once; what --restarted counts for is said, too."""
    world.monkeypatch.setattr(ProcessTable, "look", lambda *_: CLOSED)
    world.run(*INIT).ok()
    world.agent("--restarted").ok()
    for words in ("revoke ks --robot r2", "renew ks --robot r1", "fleet publish ks pub"):
        world.run(*words.split()).ok()
    write = install._write_changes

    def fill(folder: Path, changes: Collection[install._Change]) -> None:
        if any(not path.endswith("/crl.pem") for change in changes for path in change.write):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(folder, changes)

    could_not = "not count for files that this round could not install yet: files of /r1/a, /r1/b"
    with world.monkeypatch.context() as patched:
        patched.setattr(install, "_write_changes", fill)
        for option, said, counts in (
            ([], "only the revocation lists of 2 enclaves were installed", ""),
            (["--restarted"], "nothing changed", could_not),
        ):
            ended = world.agent(*option)
            assert ended.out.splitlines()[0].endswith(said), ended.out
            assert counts in ended.out and "No space left on device" in ended.err
    assert "that this round installed: files of /r1/a, /r1/b" in world.agent("--restarted").out


def test_a_folder_of_another_robot_gets_no_agent(world: World) -> None:
    """Nor advice to publish with --restored, because both releases have the same number."""
    world.run(*INIT).ok()
    world.agent("--restarted").ok()
    other = [word if word != "r1" else "r2" for word in INIT]
    before = snapshot(world.folder / "robot/.agent")
    refused = world.run(*other, "--force")
    assert refused.status == 2 and "has the enclaves of robot r1, not of r2" in refused.err
    assert snapshot(world.folder / "robot/.agent") == before
    settings = world.folder / "robot/.agent/agent.toml"
    settings.write_text(settings.read_text().replace('"r1"', '"r2"'))
    ended = world.agent()
    assert "has the files of robot r1, and its agent is set up for r2" in ended.err
    assert "--restored" not in ended.err


def test_a_keystore_with_its_cas_gets_no_release(world: World) -> None:
    words = [word if word != "robot" else "ks" for word in INIT]
    world.run(*words).ok()
    before = snapshot(world.folder / "ks/enclaves")
    ended = world.run("agent", "run", "ks", "--once")
    assert ended.status == 1 and "is a keystore with CAs" in ended.err
    assert snapshot(world.folder / "ks/enclaves") == before


@pytest.mark.skipif(os.geteuid() != 0, reason="needs a folder of another user")
def test_root_is_no_agent_of_another_user(world: World) -> None:
    world.run(*INIT).ok()
    os.chown(world.folder / "robot", 1000, 1000)
    ended = world.agent()
    assert ended.status == 2 and "belongs to user" in ended.err
