"""Rounds of the agent: what it installs, restarts, remembers, asks for and sends."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from sros_tool.agent.agent import Machine, Round, run_round
from sros_tool.agent.fetch import ClientCertificate, FetchError, FetchProblem
from sros_tool.agent.inbox import RefusedError
from sros_tool.agent.running import Systemd
from sros_tool.agent.settings import (
    AgentSettings,
    Unit,
    make_agent_folder,
    read_settings,
    write_settings,
)
from sros_tool.agent.state import agent_lock, agent_status, read_state
from sros_tool.errors import DocumentError, KeystoreError, UnavailableError
from sros_tool.keystore.confirmation import (
    Confirmation,
    RobotClock,
    RunningFiles,
    is_mended,
    parse_confirmation,
)
from sros_tool.keystore.delivery.release import Release
from sros_tool.keystore.expiry import read_credentials
from sros_tool.keystore.issuing.keyring import no_secrets
from sros_tool.keystore.layout import CRL_FILE, KEY_FILE, REQUIRED_FILES
from sros_tool.keystore.reader import OpenedKeystore, read_certificate
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificates, load_request, pem, validity_of
from sros_tool.pki.crl import load_crl, load_crls, sign_crl
from sros_tool.pki.keys import load_key
from sros_tool.runtime.processes import (
    LoadedFile,
    Process,
    ProcessEnclave,
    RunningProcesses,
    UnseenProcess,
)
from sros_tool.validity import BACKDATE, Window, iso
from tests.agent import published
from tests.agent.releases import NAMES, Home, files_of, moment, release_of
from tests.agent.test_install import content, has
from tests.keystore.test_transaction import DIED, in_child, run_out_of_space
from tests.support.children import LONG
from tests.support.harness import copy_of, sros
from tests.support.long_form import few_steps


@dataclass
class Robot:
    """A robot with its agent, whose source, processes and units are data."""

    folder: Path
    inbox: Path
    release: Release | FetchError | None = None
    started: dict[str, datetime] = field(default_factory=dict)
    """When the process of an enclave started; it has none if it is not here."""
    unseen: bool = False
    clock: RobotClock = RobotClock.SYNCHRONIZED
    boot: str = "first"
    user: int = 0
    """The user of the processes."""
    mode: int = 0o600
    """The mode of the key that the processes see, perhaps in a file system of their own."""
    enclaves: Path | None = None
    """The folder with the enclaves that the processes see; None for that of the robot."""
    restarted: bool = False
    settings: AgentSettings = field(init=False)
    patience: float = 0.0
    starting: int = 0
    """Number of looks after a restart that do not see the processes yet."""
    looked: list[datetime] = field(default_factory=list)
    """The time of each look at the processes."""
    asked: list[int] = field(default_factory=list)
    """The number of the installed release in each question to the source."""
    systemctl: list[str] = field(default_factory=list)
    """The units that were restarted."""
    signers: list[x509.Certificate] = field(default_factory=list)
    """Further certificates that may have signed a message."""
    refused: Sequence[str] = ()
    """The enclaves whose certificates the source refuses."""
    tried: list[str] = field(default_factory=list)
    """The enclaves as which the robot asked the source."""

    def __post_init__(self) -> None:
        self.inbox.mkdir()
        self.settings = AgentSettings("r1", "/nowhere", str(self.inbox))
        make_agent_folder(self.folder)
        write_settings(self.folder, self.settings)

    def round(self, now: datetime | None = None) -> Round:
        """Run a round."""
        machine = Machine(
            now or moment(),
            UTC,
            no_secrets,
            look=self.running,
            systemd=FakeSystemd(self),
            fetch=self.fetch,
            clock=lambda: self.clock,
            boot=lambda: self.boot,
            restarted=self.restarted,
            patience=self.patience,
        )
        return run_round(self.folder, self.settings, machine)

    def fetch(self, _state: Path, _source: str, robot: str, **more: object) -> Release | None:
        assert robot == "r1"
        self.asked.append(int(str(more["installed"])))
        if isinstance(certificate := more["client_certificate"], ClientCertificate):
            place = certificate.certificate.parent
            self.tried.append(f"/{place.relative_to(self.folder / 'enclaves')}")
            if self.tried[-1] in self.refused:
                raise FetchError(FetchProblem.REFUSED, "the source refuses this robot")
        if isinstance(self.release, FetchError):
            raise self.release
        fresh = self.release and self.release.number != more["installed"]
        return self.release if fresh else None

    def running(self, now: datetime) -> RunningProcesses:
        self.looked.append(now)
        started = self.started
        if self.systemctl and self.starting:
            self.starting, started = self.starting - 1, {}
        unseen = (UnseenProcess(9, ("x",), "it is closed", uses_ros=False),) if self.unseen else ()
        return RunningProcesses(tuple(map(self.process, started)), unseen)

    def process(self, name: str) -> Process:
        place = self.folder / f"enclaves{name}"
        files = tuple(
            LoadedFile(
                file,
                datetime.fromtimestamp((place / file).stat().st_ctime, UTC),
                mode=self.mode if file == KEY_FILE else 0o644,
            )
            for file in (*REQUIRED_FILES, CRL_FILE)
            if (place / file).exists()
        )
        environment = {
            "ROS_SECURITY_ENABLE": "true",
            "ROS_SECURITY_KEYSTORE": str(self.folder),
            "ROS_SECURITY_STRATEGY": "Enforce",
        }
        here, is_there = self.folder, place.is_dir()
        seen = (self.enclaves / name[1:]) if self.enclaves else place
        states = [path.stat() for path in (here, seen) if path.exists()]
        folders = tuple((state.st_dev, state.st_ino) for state in states)
        enclave = ProcessEnclave(
            str(here), name, files, is_there=is_there, local_keystore=here, folders=folders
        )
        started, user = self.started[name], self.user
        return Process(1, ("node",), environment, started, user=user, enclave=enclave)

    def revocation_list(self, name: str = "/r1/a") -> str:
        return (self.folder / f"enclaves{name}" / CRL_FILE).read_text()

    def message(self) -> Confirmation:
        """Return the last message, whose signature is verified."""
        signed = smime.parse((self.inbox / "r1/confirmation.p7s").read_bytes())
        own = map(read_certificate, sorted(self.folder.rglob("enclaves/**/cert.pem")))
        for signer in (*own, *self.signers):
            try:
                signed.verify(signer)
            except Exception:
                continue
            return parse_confirmation(signed.text, "the message")
        raise AssertionError("no enclave of the robot signed it")


class FakeSystemd(Systemd):
    """Units that restart at once, or not."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def active_units(self) -> frozenset[str]:
        return frozenset({"sros@r1-b.service"})

    def restart(self, unit: str) -> None:
        if unit == "bad.service":
            raise UnavailableError("`systemctl restart bad.service` failed", "It is bad.")
        self._robot.systemctl.append(unit)
        name = {"sros@r1-b.service": "/r1/b", "a.service": "/r1/a"}.get(unit)
        if name:
            self._robot.started[name] = moment() + timedelta(seconds=1)


@pytest.fixture
def r1(home: Home, tmp_path: Path) -> Robot:
    """The robot r1 with its agent, which has not run yet; home published what was delivered."""
    return Robot(home.robot(tmp_path), tmp_path / "inbox", release=home.first)


# ── the round ──────────────────────────────────────────────────────────────────────────────


def test_rounds_follow_what_home_publishes(home: Home, r1: Robot) -> None:
    done = r1.round()
    assert (done.release, done.fetched, done.sent) == (1, True, True)
    assert not (done.changed or done.removed or done.restart or done.problems), done
    first = r1.message()
    assert first.release == 1 and first.clock is RobotClock.SYNCHRONIZED and first.requests == ()
    assert first.running == dict.fromkeys(NAMES, RunningFiles.NOT_SEEN)
    assert first.problems == () and first.restart == () and first.dds
    own = validity_of(read_certificate(r1.folder / "enclaves/r1/a/cert.pem"))
    assert first.expiry and first.expiry["/r1/a"].certificate == own.not_after
    assert first.expiry["/r1/a"].permissions
    r1.release = home.revoked
    done = r1.round()
    assert done.changed == NAMES and done.release == 3 and has(r1.folder, home.revoked)
    second = r1.message()
    assert second.release == 3 and first.sequence and second.sequence
    assert second.sequence > first.sequence
    assert second.files["enclaves/r1/a/crl.pem"]
    r1.boot = "second"
    r1.round()
    assert first.boot == second.boot != r1.message().boot
    assert r1.asked == [0, 1, 3]
    sros("agent", "status", r1.folder).ok()
    end = validity_of(read_certificate(r1.folder / "enclaves/r1/a/cert.pem")).not_after
    early = agent_status(r1.folder, now=moment() - timedelta(days=2), oldest=timedelta(days=1))
    unreached = early.problems[0]
    assert not early.well, "when the source was reached is not known by such a clock"
    assert unreached.startswith("The agent did not reach the source and the inbox within --max-age")
    late = agent_status(r1.folder, now=end + timedelta(minutes=1), oldest=timedelta(days=9999))
    assert not late.well
    assert sum("expired" in problem for problem in late.problems) == len(NAMES)
    folder = r1.folder / "enclaves/r1/a"
    key = (folder / "key.pem").read_bytes()
    (folder / "key.pem").unlink()
    (lacks,) = agent_status(r1.folder, now=moment(), oldest=timedelta(days=1)).problems
    assert lacks.startswith("/r1/a could not start: key.pem")
    (folder / "key.pem").write_bytes(key)
    (folder / "key.pem").chmod(0o644)
    (readable,) = agent_status(r1.folder, now=moment(), oldest=timedelta(days=1)).problems
    assert "enclaves/r1/a/key.pem" in readable
    crl = (folder / "crl.pem").read_bytes()
    (folder / "crl.pem").unlink()
    both = agent_status(r1.folder, now=moment(), oldest=timedelta(days=1)).problems
    assert readable == both[0] and both[1].startswith("Files of /r1/a were changed")
    (folder / "key.pem").chmod(0o600)
    (changed,) = agent_status(r1.folder, now=moment(), oldest=timedelta(days=1)).problems
    assert changed.startswith("Files of /r1/a were changed after the last round"), (
        "as with an older list"
    )
    (folder / "crl.pem").write_bytes(crl)
    (folder / "request.pem").touch()
    for remove, path in ((os.remove, folder / "cert.pem"), (shutil.rmtree, folder)):
        remove(path)
        (gone,) = agent_status(r1.folder, now=moment(), oldest=timedelta(days=1)).problems
        assert gone == "/r1/a had a certificate in the last round of the agent, and has none now."


def test_a_server_that_refuses_one_certificate_of_the_robot(
    home: Home, r1: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as that of an enclave whose next certificate the robot is about to fetch."""
    sent: list[Path] = []

    def send(*_words: object, client_certificate: ClientCertificate, **_more: object) -> None:
        sent.append(client_certificate.certificate)
        if len(sent) == 1:
            raise RefusedError("the inbox does not accept the message")

    monkeypatch.setattr("sros_tool.agent.agent.send", send)
    r1.settings = replace(r1.settings, source="https://home/pub", inbox="https://home/inbox")
    r1.round()
    first, *others = NAMES
    assert r1.tried == [first] and len(sent) == 2 and sent[0] != sent[1]
    r1.release, r1.refused = home.renewed, [first]
    done = r1.round()
    assert (done.release, done.sent, done.problems) == (2, True, ())
    assert r1.tried[1:] == [first, others[0]]
    r1.refused, r1.tried[:] = NAMES, []
    (problem,) = r1.round().problems
    assert problem == "The source refuses this robot." and sorted(r1.tried) == sorted(NAMES)

    # A key that does not belong to its certificate, or is damaged, is not offered.
    r1.refused, r1.release = [], None
    keys = {name: r1.folder / f"enclaves{name}/key.pem" for name in NAMES}
    last = NAMES[-1]
    for name, changed in {first: keys[last].read_bytes(), last: b"damaged"}.items():
        saved = keys[name].read_bytes()
        keys[name].write_bytes(changed)
        r1.tried[:] = []
        (problem,) = r1.round().problems
        assert problem.startswith(f"{name} could not start: key.pem: "), problem
        assert r1.tried and r1.tried != [name]
        keys[name].write_bytes(saved)


def test_a_server_that_refuses_a_robot_without_a_certificate(home: Home, r1: Robot) -> None:
    """Such as one whose enclaves were removed, to make keys of its own."""
    r1.settings = replace(r1.settings, source="https://home/pub")
    for place in (r1.folder / "enclaves").glob("**/cert.pem"):
        place.unlink()
    r1.release = FetchError(FetchProblem.REFUSED, "the source refuses this robot")
    said = [each for each in r1.round().problems if "refuses this robot" in each]
    assert len(said) == 1 and "which has no certificate to identify itself with" in said[0], said
    assert "sros distribute_key KEYSTORE --robot r1 FOLDER --force" in said[0]
    r1.release = FetchError(FetchProblem.UNREACHABLE, "it does not answer")
    assert "It does not answer." in r1.round().problems


def test_enclaves_that_the_release_does_not_have(home: Home, r1: Robot) -> None:
    """Those of another robot go in the next round; what was brought since the release stays."""
    r1.round()
    shutil.copytree(r1.folder / "enclaves/r1/a", r1.folder / "enclaves/r2/x")
    r1.release = FetchError(FetchProblem.UNREACHABLE, "x", "")
    (problem,) = (each for each in r1.round().problems if "Release 1 of r1" in each)
    assert "does not have /r2/x, which is here, perhaps from another robot" in problem
    r1.release = home.first
    since = r1.folder / "enclaves/r1/since/cert.pem"
    since.parent.mkdir()
    since.write_bytes(home.renewed.files["enclaves/r1/a/cert.pem"])
    damaged = r1.folder / "enclaves/r1/damaged/cert.pem"
    for number, removed in enumerate((("/r2/x",), (), ("/r1/damaged",), (), ())):
        if number == 2:  # sorts before the newer one
            damaged.parent.mkdir()
            damaged.write_text("damaged")
        if number == 3:
            (r1.folder / ".agent/release.p7s").write_bytes(b"damaged")
        if number == 4:  # so that the release is installed in part, again and again
            shutil.rmtree(r1.folder / "enclaves/r1/b")
        done = r1.round()
        assert done.removed == removed and not (r1.folder / "enclaves/r2/x").exists()
        (problem,) = (each for each in done.problems if "newer" in each)
        assert problem.startswith("/r1/since is newer than release 1") and since.exists()
    assert r1.round().removed == () and since.exists()
    r1.release = home.revoked
    done = r1.round()
    assert done.removed == ("/r1/since",) and not any("newer" in each for each in done.problems)
    (problem,) = (each for each in r1.round().problems if "another robot, somebody" in each)
    assert "lacks them: /r1/damaged, /r1/since, /r2/x. If they" in problem
    late = "\n".join(r1.round(moment() + timedelta(days=1, minutes=1)).problems)
    assert "lacks them: /r1/since, /r2/x. If they" in late, "for a day, if it had no certificate"


def test_an_enclave_of_another_robot_that_is_newer_than_the_release(
    home: Home, r1: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is no enclave to publish, signs no message, and identifies the robot last."""
    r1.settings = replace(r1.settings, source="https://home/pub")
    r1.round()
    taken = r1.folder / "enclaves/q2/x"
    shutil.copytree(r1.folder / "enclaves/r1/a", taken)
    renewed = home.renewed.files["enclaves/r1/a/cert.pem"]
    (taken / "cert.pem").write_bytes(renewed)
    r1.tried[:] = []
    done = r1.round()
    (problem,) = (each for each in done.problems if "/q2/x" in each)
    assert "another robot: /q2/x. Release 1 lacks them, and their paths do not name r1." in problem
    assert "remove enclaves/q2/x here" in problem and not is_mended(problem)
    assert done.sent and r1.tried == [NAMES[0]]
    monkeypatch.setattr("sros_tool.agent.agent._MOST_CERTIFICATES", 2)
    r1.refused, r1.tried[:] = NAMES, []
    assert r1.round().fetched and r1.tried == [NAMES[0], "/q2/x"], "not all are of the release"
    signed = smime.parse((r1.inbox / "r1/confirmation.p7s").read_bytes())
    signer = signed.signer()
    assert signer and pem(signer) != renewed
    for key in (r1.folder / "enclaves/r1").glob("*/key.pem"):
        key.unlink()
    done = r1.round()
    assert not done.sent and any("No enclave of this robot's release" in x for x in done.problems)


def test_an_enclave_brought_in_place_of_all_that_the_release_has_signs(
    home: Home, r1: Robot
) -> None:
    r1.round()
    brought = r1.folder / "enclaves/r1/new"
    shutil.move(r1.folder / "enclaves/r1/a", brought)
    (brought / "cert.pem").write_bytes(home.renewed.files["enclaves/r1/a/cert.pem"])
    for name in ("b", "c"):
        shutil.rmtree(r1.folder / "enclaves/r1" / name)
    done = r1.round()
    assert done.sent and any("/r1/new is newer than release 1" in each for each in done.problems)


def test_a_removed_enclave_is_named_until_its_certificate_is_revoked_or_a_release_has_it(
    home: Home, r1: Robot
) -> None:
    r1.round()
    copied = "lacks them: /r2/x. If they belong to another robot, somebody may have copied"
    path, present = "enclaves/r2/x", files_of(home.root)
    own = {file: data for file, data in present.items() if file.startswith("enclaves/r1/a/")}
    taken = {file.replace("enclaves/r1/a", path): data for file, data in own.items()}
    for source, release in (
        (next((home.root / "revoked").iterdir()), home.revoked),
        (r1.folder / "enclaves/r1/a", home.release(present | taken)),
    ):
        shutil.copytree(source, r1.folder / path, dirs_exist_ok=True)
        assert r1.round().removed == ("/r2/x",)
        (problem,) = r1.round(moment() + timedelta(days=30)).problems
        assert copied in problem and not is_mended(problem)
        r1.release = release
        assert not any(copied in problem for problem in r1.round().problems)


@pytest.mark.parametrize("seal", ["there", "gone"])
def test_a_copied_enclave_is_named_also_if_a_later_release_removes_it(
    seal: str, home: Home, r1: Robot
) -> None:
    r1.round()
    if seal == "gone":  # whoever copied the enclave can remove it, too
        (r1.folder / ".agent/release.p7s").unlink()
    shutil.copytree(next((home.root / "revoked").iterdir()), r1.folder / "enclaves/r2/x")
    left = {path: data for path, data in home.renewed.files.items() if "/r1/c/" not in path}
    r1.release = home.release(left)
    assert set(r1.round().removed) == {"/r1/c", "/r2/x"}
    (problem,) = r1.round().problems
    names = "/r1/c, /r2/x" if seal == "gone" else "/r2/x"
    assert (
        f"lacks them: {names}. If they belong to another robot, somebody may have copied" in problem
    )


def test_what_somebody_damaged_is_installed_again(home: Home, r1: Robot) -> None:
    r1.round()
    (r1.folder / ".agent/release.p7s").write_bytes(b"damaged")
    (r1.folder / "enclaves/r1/c/permissions.p7s").unlink()
    assert r1.round().changed == ("/r1/c",), "also without the list of what is installed"
    (r1.folder / "enclaves/r1/a/permissions.p7s").unlink()
    shutil.rmtree(r1.folder / "enclaves/r1/b")
    done = r1.round()
    assert done.changed == ("/r1/a",), "the key of /r1/b is gone, and only here"
    (problem,) = (problem for problem in done.problems if "/r1/b does not get the files" in problem)
    bring = "`sros distribute_key KEYSTORE --robot r1 DIR --force`"
    assert "is not on this robot. A release has no keys" in problem and bring in problem
    changed = "1 file of the release was changed or missing here, and replaced: enclaves/r1/a/p"
    assert sum(changed in problem for problem in done.problems) == 1
    shutil.copytree(r1.folder / "enclaves/r1/a", r1.folder / "enclaves/r1/b")
    (problem,) = (each for each in r1.round().problems if "/r1/b does not get the files" in each)
    assert bring in problem, "it has another key"
    assert "another computer replaced this one, switch this computer off" in problem
    assert "wrong hands" not in problem, "it is this robot's own"
    shutil.rmtree(r1.folder / "enclaves/r1/b")
    other, copy = home.root.parent / "other", home.root.parent / "r2"
    shutil.copytree(home.root, other, symlinks=True)
    sros("create_enclave", other, "/r2/a").ok()
    sros("distribute_key", other, "/r2/a", copy).ok()
    (copy / "enclaves/r2/a/crl.pem").unlink()  # it is later than that of the release
    shutil.copytree(copy / "enclaves/r2/a", r1.folder / "enclaves/r1/b")
    (problem,) = (each for each in r1.round().problems if "/r1/b does not get the files" in each)
    assert "is of /r2/a: if its key was here, too, it was in wrong hands: `sros renew" in problem
    assert r1.message().release == 1
    assert has(r1.folder, home.first, ("/r1/a", "/r1/c"))
    assert any(changed in problem for problem in r1.message().problems or ()), "for a day"
    late = r1.round(moment() + timedelta(days=1, minutes=1)).problems
    assert not any(changed in problem for problem in late)
    assert sros("agent", "status", r1.folder).status == 1


def test_a_later_change_does_not_hide_that_the_revocation_list_was_removed(
    home: Home, r1: Robot
) -> None:
    """Each file is named for a day, the gravest first."""
    r1.release, start = home.revoked, moment()
    r1.round()
    files = ("b/crl.pem", "a/permissions.p7s", "a/governance.p7s", "a/cert.pem")
    for hours, file in enumerate(files):
        (r1.folder / "enclaves/r1" / file).unlink()
        (problem,) = r1.round(start + timedelta(hours=hours)).problems
        names = "enclaves/r1/b/crl.pem" + (", enclaves/r1/a/governance.p7s, " if hours > 1 else "")
        assert f"replaced: {names}" in problem and is_mended(problem)
    assert problem.startswith(f"From {iso(start)} to {iso(start + timedelta(hours=3))}, 4 files")
    assert "/a/cert.pem and 1 more. Find out" in problem and r1.message().problems == (problem,)
    (problem,) = r1.round(start + timedelta(hours=24.5)).problems
    assert "crl.pem" not in problem and ", 3 files" in problem


def test_what_somebody_damaged_is_named_also_if_a_later_release_replaces_it(
    home: Home, r1: Robot
) -> None:
    r1.round()
    path = "enclaves/r1/b/permissions.p7s"
    (r1.folder / path).write_bytes(b"damaged")
    for file, data in files_of(home.root).items():
        if file.startswith("enclaves/r1/a/"):
            (r1.folder / file).write_bytes(data)  # brought by hand, and published then
    r1.release = home.revoked
    done = r1.round()
    assert (done.release, done.changed) == (3, ("/r1/b", "/r1/c"))
    changed = f"1 file of the release was changed or missing here, and replaced: {path}. Find"
    assert sum(changed in problem for problem in done.problems) == 1
    (problem,) = (problem for problem in r1.round().problems if changed in problem)
    assert is_mended(problem), "for a day"


def test_only_what_was_written_is_named_as_replaced(home: Home, r1: Robot) -> None:
    """An enclave that does not get the files of the release gets its revocation list."""
    r1.release = home.revoked
    r1.round()
    place = r1.folder / "enclaves/r1/a"
    shutil.copytree(r1.folder / "enclaves/r1/b", place, dirs_exist_ok=True)
    before = content(place)
    done = r1.round()
    assert any("/r1/a does not get the files" in problem for problem in done.problems)
    r1.release = home.release({**home.revoked.files, **list_again(home, 9)}, 4)
    done = r1.round()
    assert "/r1/a" in done.changed and content(place).keys() == before.keys()
    written = [file for file, data in content(place).items() if data != before[file]]
    assert written == ["crl.pem"], "the others are still those of /r1/b"
    assert not any("changed or missing" in problem for problem in done.problems)
    assert "changed or missing" not in sros("agent", "status", r1.folder).out


def test_a_list_of_an_enclave_that_keeps_its_files_is_named_as_replaced(
    home: Home, r1: Robot
) -> None:
    r1.release = home.revoked
    r1.round()
    place = r1.folder / "enclaves/r1/a"
    shutil.copytree(r1.folder / "enclaves/r1/b", place, dirs_exist_ok=True)
    (place / "crl.pem").unlink()
    r1.release = home.release({**home.revoked.files, **list_again(home, 9)}, 4)
    (problem,) = (each for each in r1.round().problems if "changed or missing" in each)
    assert "1 file of" in problem and "replaced: enclaves/r1/a/crl.pem. Find" in problem


def list_again(home: Home, number: int, root: Path | None = None) -> dict[str, bytes]:
    """Return a later, empty revocation list of home, or of the CA in ``root``, for `NAMES`."""
    root = root or home.root
    authority = read_certificate(root / "public/identity_ca.cert.pem")
    key = load_key((root / "private/identity_ca.key.pem").read_bytes(), "CA")
    start = moment() + timedelta(hours=3) - BACKDATE
    end = moment() + timedelta(days=9)
    crl = sign_crl(authority, key, (), number=number, this_update=start, next_update=end)
    return {f"enclaves{name}/crl.pem": crl for name in NAMES}


@dataclass(frozen=True)
class ByHand:
    """What home made hour by hour: a release, what was brought by hand then, and a later release.

    Each has another revocation list, and other files of /r1/a, with a new key in what was brought.
    """

    root: Path
    installed: Release
    brought: Path
    later: Release


@pytest.fixture(scope="module")
def by_hand(home: Home, tmp_path_factory: pytest.TempPathFactory) -> ByHand:
    folder = tmp_path_factory.mktemp("by_hand")
    root = copy_of(home.root, folder / "home")
    renewed = []
    for hours, words in enumerate((["/r1/a"], ["/r1/a", "--new-key"], ["/r1/a", "/r1/b"]), start=2):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                "sros_tool.cli.common._clock", lambda hours=hours: moment() + timedelta(hours=hours)
            )
            sros("renew", root, *words, "--revoke-old").ok()
            sros("zenoh", root, "--mode", "client" if hours == 3 else "peer").ok()
            if hours == 3:
                sros("distribute_key", root, *NAMES, folder / "brought").ok()
        renewed.append(files_of(root))
    installed, _, later = renewed
    for path, data in installed.items():
        if "/session." in path and "/r1/a/" not in path:  # they have no date of their own
            (folder / "brought" / path).write_bytes(data)
    return ByHand(
        root,
        home.release(installed, 4),
        folder / "brought",
        home.release(later, 6),
    )


def brought(r1: Robot, by_hand: ByHand) -> Path:
    """Bring the files by hand after the first release was installed, and publish the later one."""
    r1.release = by_hand.installed
    assert not r1.round().problems
    shutil.copytree(by_hand.brought, r1.folder, dirs_exist_ok=True)
    r1.release = by_hand.later
    return r1.folder / "enclaves/r1"


def test_what_the_keystore_made_between_two_releases_is_not_named_as_changed(
    by_hand: ByHand, r1: Robot
) -> None:
    brought(r1, by_hand)
    done = r1.round()
    assert done.release == 6 and done.changed == NAMES
    assert not done.problems, "the lists of all, and the files of /r1/a, are of the keystore"


def of_stranger(folder: Path) -> Path:
    """Return a keystore whose CAs have the names of those of home."""
    sros("generate_artifacts", "-k", folder / "stranger", "-e", "/r1/a").ok()
    return folder / "stranger"


CHANGED: dict[str, tuple[str, Callable[[ByHand, Home, Path], bytes | None]]] = {
    "an older list": ("b/crl.pem", lambda _, home, __: home.revoked.files["enclaves/r1/b/crl.pem"]),
    "an older list, too": (
        "b/crl.pem",
        lambda by_hand, home, _: (
            (by_hand.brought / "enclaves/r1/b/crl.pem").read_bytes()
            + home.revoked.files["enclaves/r1/b/crl.pem"]
        ),
    ),
    "an older list next to a new certificate": (
        "a/crl.pem",
        lambda _, home, __: home.revoked.files["enclaves/r1/a/crl.pem"],
    ),
    "no list next to a new certificate": ("a/crl.pem", lambda *_: None),
    "a damaged list": ("b/crl.pem", lambda *_: b"damaged"),
    "a list of another CA": (
        "b/crl.pem",
        lambda _, home, folder: list_again(home, 7, of_stranger(folder))["enclaves/r1/b/crl.pem"],
    ),
    "older permissions": (
        "a/permissions.p7s",
        lambda _, home, __: home.first.files["enclaves/r1/a/permissions.p7s"],
    ),
    "new permissions of another enclave": (
        "b/permissions.p7s",
        lambda by_hand, *_: (by_hand.brought / "enclaves/r1/a/permissions.p7s").read_bytes(),
    ),
    "permissions of another CA": (
        "a/permissions.p7s",
        lambda _, __, folder: (of_stranger(folder) / "enclaves/r1/a/permissions.p7s").read_bytes(),
    ),
    "an older certificate": (
        "a/cert.pem",
        lambda _, home, __: home.first.files["enclaves/r1/a/cert.pem"],
    ),
    "a certificate of another CA": (
        "a/cert.pem",
        lambda _, __, folder: (of_stranger(folder) / "enclaves/r1/a/cert.pem").read_bytes(),
    ),
    "a new certificate of another enclave": (
        "b/cert.pem",
        lambda by_hand, *_: (by_hand.brought / "enclaves/r1/a/cert.pem").read_bytes(),
    ),
    "a Zenoh configuration next to a new certificate": ("a/session.json5", lambda *_: b"{}"),
    "governance next to a new certificate": ("a/governance.p7s", lambda *_: b"damaged"),
    "another CA next to a new certificate": (
        "a/identity_ca.cert.pem",
        lambda by_hand, _, folder: (
            (by_hand.root / "public/identity_ca.cert.pem").read_bytes()
            + (of_stranger(folder) / "public/identity_ca.cert.pem").read_bytes()
        ),
    ),
}


@pytest.mark.parametrize("what", CHANGED)
def test_what_a_stranger_changed_between_two_releases_is_named(
    what: str, by_hand: ByHand, home: Home, r1: Robot, tmp_path: Path
) -> None:
    """Also if the keystore's own files were brought before: an earlier or a forged one is named."""
    place, (file, make) = brought(r1, by_hand), CHANGED[what]
    data = make(by_hand, home, tmp_path)
    (place / file).unlink()
    if data is not None:
        (place / file).write_bytes(data)
    (problem,) = (each for each in r1.round().problems if "changed or missing" in each)
    named = re.findall(r"enclaves/r1/(\w/[\w.]+\w)", problem)
    needs_it = ["a/permissions.p7s", "a/session.json5"] if file == "a/cert.pem" else []
    assert named == [file, *needs_it], "at most the first three"


@pytest.mark.parametrize("is_asked_for", [True, False])
def test_a_removed_enclave_with_a_new_key_is_not_named_as_damaged(
    is_asked_for: bool, home: Home, r1: Robot, tmp_path: Path
) -> None:
    """docs/howto/rotate.md: its folder is removed, and its key made on the robot."""
    r1.round()
    root, place = tmp_path / "home", r1.folder / "enclaves/r1/b"
    copy_of(home.root, root)
    for file in place.iterdir() if is_asked_for else [place / "permissions.p7s"]:
        file.unlink()
    if is_asked_for:
        sros("create_request", "/r1/b", r1.folder).ok()
        (root / "enclaves/r1/b/key.pem").unlink()
        sros("sign_request", root, place / "request.pem", "--no-answer", "--renew").ok()
    r1.release = release_of(files_of(root), 4, home.authority)
    done = r1.round()
    assert "/r1/b" in done.changed
    assert any("changed or missing" in problem for problem in done.problems) != is_asked_for


REFUSED = {
    FetchProblem.UNREACHABLE: "cannot be reached",
    FetchProblem.EXPIRED: "expired",
    FetchProblem.ROLLED_BACK: "older",
}


@pytest.mark.parametrize("problem", REFUSED)
def test_a_source_that_fails_keeps_no_confirmation_back(
    problem: FetchProblem, home: Home, r1: Robot
) -> None:
    r1.round()
    before = content(r1.folder / "enclaves")
    r1.release = FetchError(problem, f"it {REFUSED[problem]}")
    done = r1.round(moment() + timedelta(days=30))
    assert not done.fetched and done.sent and content(r1.folder / "enclaves") == before
    problems = r1.message().problems
    assert problems and REFUSED[problem] in problems[0]
    r1.release = home.revoked
    done = r1.round(moment() + timedelta(days=30))
    assert done.changed == NAMES and not done.problems, "it goes on where it was"


def test_an_inbox_that_fails_keeps_no_installation_back(home: Home, r1: Robot) -> None:
    r1.round()
    r1.inbox.rename(r1.inbox.with_name("away"))
    r1.release = home.revoked
    done = r1.round()
    assert not done.sent and done.changed == NAMES
    assert any("cannot be written into" in problem for problem in done.problems)
    r1.inbox.with_name("away").rename(r1.inbox)
    assert r1.round().sent and r1.message().release == 3


def test_two_releases_with_one_number_are_refused(home: Home, r1: Robot) -> None:
    r1.release = home.renewed
    r1.round()
    (r1.folder / "enclaves/r1/a/cert.pem").unlink()  # so that it asks again
    before = content(r1.folder / "enclaves")
    r1.release = home.release(home.revoked.files, 2)
    done = r1.round()
    assert any("has the number 2 of the installed release" in problem for problem in done.problems)
    assert content(r1.folder / "enclaves") == before
    r1.release = home.renewed
    assert r1.round().changed == ("/r1/a",)


def test_an_older_release_is_refused_also_without_a_state(home: Home, r1: Robot) -> None:
    r1.release = home.renewed
    r1.round()
    path = r1.folder / ".agent/state.json"
    whole = json.loads(path.read_text())
    damaged: list[object] = [[], None, {**whole, "due": ["x"]}, {**whole, "more": 1}]
    damaged += [{key: whole[key] for key in whole if key != left_out} for left_out in whole]
    damaged += [{**whole, key: {}} for key in whole]
    damaged += [{**whole, key: True} for key in whole]
    damaged += [{**whole, key: 10**12} for key in ("release", "accepted", "sequence")]
    damaged += [{**whole, "replaced": {"/r1/a": seconds}} for seconds in (-1e300, 10**400)]
    for value in damaged:
        path.write_text(json.dumps(value))
        assert read_state(r1.folder).accepted == 2, value
    path.write_text(json.dumps({**whole, "more": 1}))
    assert read_state(r1.folder).release == 2, "another version of sros wrote it"
    path.write_text("damaged")
    assert read_state(r1.folder).accepted == 2
    path.write_text(json.dumps({**whole, "latest": "0001-01-01T00:00:00Z"}))
    r1.release = home.first
    done = r1.round()
    assert any("older than release 2" in problem for problem in done.problems)
    assert has(r1.folder, home.renewed)


def test_a_revocation_list_that_home_may_have_lost_is_sent(home: Home, r1: Robot) -> None:
    """Not with each message, but where home does not publish what is here."""
    r1.release = home.revoked
    for _ in range(2):
        r1.round()
        assert r1.message().crl is None
    mine = r1.revocation_list()
    for other in (home.release(home.renewed.files), FetchError(FetchProblem.ROLLED_BACK, "x", "")):
        r1.release = other
        r1.round()
        assert r1.message().crl == mine
    r1.release = home.release(home.revoked.files, 12)
    r1.round()
    assert r1.message().crl is None


def test_the_list_of_the_second_ca_in_a_rotation_is_sent_too(
    home: Home, r1: Robot, tmp_path: Path
) -> None:
    """Home may have lost what was revoked before the stage at which the new CA issues."""
    r1.release = home.revoked
    r1.round()
    revoked = {e.serial for e in load_crl(r1.revocation_list().encode(), "it").revoked}
    root = copy_of(home.root, tmp_path / "home")
    for number in (4, 5):
        sros("rotate_ca", root, "--identity", "--next").ok()
        r1.release = release_of(files_of(root), number, home.authority)
        assert "/r1/b" in r1.round().changed
    assert not load_crl(r1.revocation_list("/r1/b").encode(), "it").revoked, "of the new CA"
    r1.release = FetchError(FetchProblem.ROLLED_BACK, "x", "")
    r1.round()
    lists = load_crls((r1.message().crl or "").encode(), "it")
    assert [each.number for each in lists if revoked <= {e.serial for e in each.revoked}]
    assert len(lists) == 2


def test_a_revocation_list_that_is_replaced_by_one_that_revokes_less_is_sent(
    home: Home, r1: Robot, tmp_path: Path
) -> None:
    """As by a home that was restored from a backup, and has revoked something else since."""
    r1.release = home.revoked
    r1.round()
    mine = r1.revocation_list()
    root = copy_of(home.root, tmp_path / "home")
    sros("crl", root, "--refresh").ok()
    r1.release = release_of(files_of(root), 4, home.authority)
    r1.round()
    assert r1.message().crl is None, "the new list has the same entries"
    number = load_crl(mine.encode(), "it").number
    before = r1.revocation_list()
    for later in (5, 6):
        other = sign_crl(
            read_certificate(root / "public/identity_ca.cert.pem"),
            load_key((root / "private/identity_ca.key.pem").read_bytes(), "it"),
            (),
            number=number + later,
            this_update=moment() - timedelta(hours=1),
            next_update=moment() + timedelta(days=90),
        )
        lists = {path: other for path in home.revoked.files if path.endswith(CRL_FILE)}
        r1.release = home.release({**home.revoked.files, **lists}, later)
        for _ in range(2):
            assert not r1.round().problems
            assert r1.message().crl == before, "also after further releases"
    r1.round(moment() + timedelta(days=40))
    assert r1.message().crl is None
    r1.release = FetchError(FetchProblem.ROLLED_BACK, "x", "")
    r1.round(moment() + timedelta(days=40))
    assert r1.message().crl == other.decode(), "also a list that revokes nothing has a number"


def test_a_disk_of_yesterday_goes_on(home: Home, r1: Robot, tmp_path: Path) -> None:
    r1.round()
    yesterday = tmp_path / "yesterday"
    copy_of(r1.folder, yesterday)
    r1.release = home.revoked
    r1.round()
    last = r1.message().sequence
    shutil.rmtree(r1.folder)
    copy_of(yesterday, r1.folder)
    done = r1.round(moment() + timedelta(minutes=5))
    assert done.changed == NAMES and has(r1.folder, home.revoked)
    now = r1.message().sequence
    assert last and now and now > last, "home takes it"


def test_a_round_names_what_no_process_could_start_with_and_what_others_can_change(
    r1: Robot,
) -> None:
    (r1.folder / "enclaves/r1/a/key.pem").unlink()
    (r1.folder / "enclaves/r1/b").chmod(0o777)
    (r1.folder / "enclaves/r1/c/key.pem").chmod(0o644)
    r1.release = None
    r1.round()
    key, *others = r1.message().problems or ()
    start, folder = sorted(others)
    assert start == "/r1/a could not start: key.pem: missing."
    assert folder.startswith("enclaves/r1/b: a file or folder that everybody can change")
    assert key.startswith("enclaves/r1/c/key.pem: a private key that others can read")


def test_a_key_that_others_could_read_is_named_until_it_is_revoked(home: Home, r1: Robot) -> None:
    r1.round()
    key = r1.folder / "enclaves/r1/a/key.pem"
    for release in (home.renewed, None):
        key.chmod(0o644)
        if release is None:
            (r1.folder / "enclaves/r1/a/permissions.p7s").unlink()
        r1.release = release or r1.release
        problems = r1.round().problems
        assert key.stat().st_mode & 0o777 == 0o600
        assert "others could read 1 private key: enclaves/r1/a/key.pem" in problems[0]
        assert "If the key was made on its robot, revoke the enclave" in problems[0]
    (problem,) = r1.round(moment() + timedelta(days=30)).problems
    assert "others could read" in problem and not is_mended(problem)
    present = key.read_bytes()
    another = (r1.folder / "enclaves/r1/b/key.pem").read_bytes()
    for now in (b"damaged", b"", another):  # the copy can still be used
        key.write_bytes(now)
        assert any("others could read" in problem for problem in r1.round().problems)
    key.write_bytes(present)
    key.chmod(0o644)
    left = {path: data for path, data in home.renewed.files.items() if "/r1/a/" not in path}
    r1.release = home.release(left)
    assert any("others could read" in problem for problem in r1.round().problems)
    assert not key.exists()


# ── the clock ──────────────────────────────────────────────────────────────────────────────


def test_a_clock_that_is_behind_is_said_and_nothing_restarts(home: Home, r1: Robot) -> None:
    r1.settings = replace(r1.settings, restart=True)
    r1.round()
    r1.started = {"/r1/b": moment() - timedelta(hours=1)}
    r1.release = home.revoked
    done = r1.round(datetime(2020, 1, 1, tzinfo=UTC))
    assert any("is at least" in problem and "behind" in problem for problem in done.problems)
    assert done.changed == NAMES, "verified by the latest moment that has certainly passed"
    assert "/r1/b" in done.restart and not r1.systemctl
    message = r1.message()
    assert message.clock is RobotClock.BEHIND and message.time.year == 2020
    assert message.sequence and message.sequence > moment().timestamp() - 1000
    done = r1.round()
    assert r1.systemctl == ["sros@r1-b.service"] and done.restart == ()


def test_a_clock_before_the_first_certificates_is_said(r1: Robot) -> None:
    """Nothing was verified yet, but the certificates are not valid on that day."""
    r1.release = None
    (problem,) = r1.round(moment() - timedelta(days=9)).problems
    assert problem.startswith("The clock shows") and problem.endswith("; set the clock.")
    assert "the certificates of this robot are valid only from" in problem
    assert r1.message().clock is RobotClock.BEHIND
    assert r1.round().problems == ()


def test_on_a_wrong_clock_nothing_is_installed_that_is_not_valid_then(
    home: Home, r1: Robot
) -> None:
    """A clock that was never right: no document tells what has passed."""
    before = content(r1.folder / "enclaves")
    r1.release = home.revoked
    for _ in range(2):
        done = r1.round(datetime(2020, 1, 1, tzinfo=UTC))
        assert not done.changed and content(r1.folder / "enclaves") == before
        assert any("not valid before" in problem for problem in done.problems)
    assert r1.round().changed == NAMES


def test_permissions_prove_time_as_certificates_do(home: Home, r1: Robot) -> None:
    """A release that brings only new permissions, before and after it is installed."""
    path = "enclaves/r1/a/permissions.p7s"
    r1.round()
    early = read_state(r1.folder).latest
    r1.release = home.release({**home.first.files, path: home.renewed.files[path]})
    for changed, said in (((), "the published release was made at"), (("/r1/a",), "")):
        done = r1.round(early + timedelta(minutes=5) if early and not changed else None)
        assert done.changed == changed and said in "".join(done.problems[:1]), done.problems
    r1.release = None
    assert early
    problems = r1.round(early + timedelta(minutes=5)).problems
    assert "but verified documents are valid only from" in problems[0], problems


def test_a_grant_of_another_enclave_proves_no_time(home: Home, r1: Robot) -> None:
    path = "enclaves/r1/a/permissions.p7s"
    document = smime.parse(home.renewed.files[path]).document
    begin, end = document.index(b"<grant "), document.index(b"</permissions>")
    other = document[begin:end].replace(b"/r1/a", b"/x")
    other = re.sub(rb"<not_before>\d+", b"<not_before>2030", other)
    document = document[:end] + other + document[end:]
    signed = smime.sign(document, home.authority.certificate, home.authority.key)
    r1.release = home.release({**home.renewed.files, path: signed})
    assert not r1.round().problems
    latest = read_state(r1.folder).latest
    assert latest and latest.year < 2030


def test_a_clock_at_home_that_was_ahead_locks_no_robot_out(home: Home, r1: Robot) -> None:
    """What is not valid yet proves no time, by which all that is published would have expired."""
    r1.release = home.revoked
    early = validity_of(read_certificate(r1.folder / "enclaves/r1/b/cert.pem")).not_before
    done = r1.round(early + timedelta(minutes=5))
    assert any("/r1/a does not get the files" in problem for problem in done.problems)
    assert done.changed, "the revocation list"
    wrong = " behind, unless the clock of the keystore machine was ahead"
    status = agent_status(r1.folder, now=early + timedelta(minutes=5), oldest=timedelta(days=1))
    assert wrong in done.problems[0] and wrong in status.problems[0], "or the clock here is wrong"
    assert r1.message().clock is RobotClock.BEHIND
    latest = read_state(r1.folder).latest
    assert latest and latest <= early + timedelta(minutes=5)
    assert r1.round(early + timedelta(minutes=6)).changed == ()
    assert r1.round().changed == ("/r1/a",)


# ── restarts ───────────────────────────────────────────────────────────────────────────────


def test_a_restart_is_due_until_the_processes_were_seen_with_the_new_files(
    home: Home, r1: Robot
) -> None:
    r1.round()
    r1.started = {"/r1/a": moment() - timedelta(hours=1), "/r1/b": moment() - timedelta(hours=1)}
    r1.unseen = True
    r1.release = home.revoked
    done = r1.round()
    assert done.restart == NAMES, "of /r1/c nothing is known"
    assert done.unseen == ("/r1/c",) == read_state(r1.folder).unseen
    said = sros("agent", "status", r1.folder).out
    assert f"or if no such process runs, confirm this: `sros agent run {r1.folder}" in said
    message = r1.message()
    assert message.restart == NAMES and message.running == {
        "/r1/a": RunningFiles.EARLIER,
        "/r1/b": RunningFiles.EARLIER,
        "/r1/c": RunningFiles.NOT_SEEN,
    }
    later = moment() + timedelta(seconds=1)
    r1.started |= {"/r1/a": later}
    assert r1.round().restart == ("/r1/b", "/r1/c")
    assert r1.message().running == {
        "/r1/a": RunningFiles.CURRENT,
        "/r1/b": RunningFiles.EARLIER,
        "/r1/c": RunningFiles.NOT_SEEN,
    }
    r1.unseen = False
    done = r1.round()
    assert done.restart == ("/r1/b",), "all are seen, and nothing runs in /r1/c"
    assert not done.unseen and "--restarted" not in sros("agent", "status", r1.folder).out
    (r1.folder / ".agent/state.json").unlink()
    assert r1.round().restart == ("/r1/b",), "what is seen is known without the state"
    r1.started["/r1/b"] = later
    assert r1.round().restart == ()


def test_other_permissions_leave_the_revocation_list_in_force(home: Home, r1: Robot) -> None:
    """A process that started before them has the list, if it started after the list came."""
    r1.unseen, r1.release = True, home.revoked
    r1.round()
    assert r1.message().crl_restart is None, "the list is due wherever a restart is"
    r1.restarted = True
    r1.round()
    r1.restarted, r1.started = False, {"/r1/b": moment() + timedelta(seconds=0.02)}
    time.sleep(0.04)
    r1.release = home.release({**home.revoked.files, **governance_again(home)}, 4)
    for running in ("/r1/b",), ():
        r1.started = {name: r1.started[name] for name in running}
        assert r1.round().restart == ("/r1/b",)
        assert r1.message().crl_restart == ()
    r1.started = {"/r1/b": moment() - timedelta(hours=1)}
    r1.round()
    assert r1.message().crl_restart is None, "a process that started before the list lacks it"
    r1.started = {}
    (r1.folder / "enclaves/r1/b" / CRL_FILE).write_text("x")
    r1.release = None
    r1.round()
    assert r1.message().crl_restart is None


@pytest.mark.parametrize("seen", [True, False])
def test_a_list_that_was_signed_again_is_lacked_by_no_process(
    seen: bool, home: Home, r1: Robot, tmp_path: Path
) -> None:
    """But a list that revokes something else is, and a process from before the first list."""
    r1.release, r1.unseen = home.revoked, not seen
    r1.round()
    r1.restarted = True
    r1.round()
    r1.restarted = False
    time.sleep(0.04)
    if seen:
        r1.started = {"/r1/b": datetime.now(UTC)}
    time.sleep(0.04)
    root = copy_of(home.root, tmp_path / "home")
    sros("crl", root, "--refresh").ok()
    r1.release = release_of(files_of(root), 4, home.authority)
    assert "/r1/b" in r1.round(datetime.now(UTC)).restart
    assert r1.message().crl_restart == ()
    if seen:
        r1.started = {"/r1/b": moment() - timedelta(hours=1)}
        r1.round(datetime.now(UTC))
        assert r1.message().crl_restart is None
    sros("renew", root, "/r1/c", "--revoke-old").ok()
    r1.release = release_of(files_of(root), 5, home.authority)
    r1.round(datetime.now(UTC))
    assert r1.message().crl_restart is None


@pytest.mark.parametrize("user", [0, 1])
def test_a_process_of_an_enclave_that_was_removed_has_no_new_list(r1: Robot, user: int) -> None:
    """It accepts whom its files let in; another user can only claim to run there."""
    r1.round()
    r1.release, r1.restarted, r1.user = None, True, user
    # No message can name an enclave of a process that has no valid name.
    r1.started = dict.fromkeys(("/r1/c", "/no name"), moment() + timedelta(seconds=1))
    shutil.rmtree(r1.folder / "enclaves/r1/c")
    done, said = r1.round(), r1.message()
    assert not done.restart and any("/r1/c in " in problem for problem in done.problems)
    assert said.restart == (("/r1/c",) if user == 0 else ()) and said.crl_restart is None


def test_a_look_at_the_processes_has_its_own_time(r1: Robot) -> None:
    """A process seems to start earlier by what passes between the time and the look."""
    before, now = time.monotonic(), moment()
    r1.started["/r1/base"] = now
    r1.round(now)
    passed = timedelta(seconds=time.monotonic() - before)
    (looked,) = r1.looked
    assert now < looked <= now + passed


def test_a_clock_that_was_set_makes_no_process_newer_than_files(home: Home, r1: Robot) -> None:
    """On a robot without a battery for its clock, nodes start before the clock is set."""
    r1.round()
    r1.release = home.revoked
    r1.started = {"/r1/a": moment() - timedelta(minutes=1)}
    assert r1.round().restart == ("/r1/a",)
    set_forward = timedelta(hours=1)
    r1.started["/r1/a"] += set_forward  # by the clock of now; the files are an hour old then
    assert r1.round(moment() + set_forward).restart == r1.message().restart == ("/r1/a",)
    assert r1.message().crl_restart is None
    r1.started["/r1/a"] = moment() + set_forward + timedelta(seconds=1)
    assert not r1.round(moment() + set_forward).restart


@pytest.mark.parametrize("how", ["restart of the machine", "somebody says so"])
def test_a_restart_of_all_ends_what_cannot_be_seen(how: str, home: Home, r1: Robot) -> None:
    r1.round()
    r1.unseen = True
    r1.started = {"/r1/a": moment() - timedelta(hours=1)}
    r1.release = home.revoked
    assert r1.round().restart == NAMES == r1.round().restart
    if how == "restart of the machine":
        r1.boot = "second"
    else:
        r1.restarted = True
    assert r1.round().restart == ("/r1/a",), "what is seen counts more"
    r1.release = home.release({**home.revoked.files, **governance_again(home)}, 4)
    r1.restarted = False
    assert r1.round().restart == ("/r1/a", "/r1/b")


@pytest.mark.parametrize("ended", ["by a word", "by a process", "by a look at all", "by a start"])
def test_files_that_somebody_else_changed_make_a_restart_due(
    ended: str, home: Home, r1: Robot
) -> None:
    """Nobody saw that a process has the first files, nor those that were delivered by hand."""
    r1.unseen, r1.release = True, None
    assert r1.round().restart == NAMES
    r1.restarted = True
    assert not r1.round().restart
    r1.restarted = False
    for path, data in governance_again(home).items():
        (r1.folder / path).write_bytes(data)
    for _ in range(2):
        done = r1.round()
        assert done.restart == done.unseen == ("/r1/b",) == r1.message().restart
    if ended == "by a start":  # of the machine: but what changes since then is another matter
        r1.boot = "second"
        (r1.folder / "enclaves/r1/a" / CRL_FILE).write_text("x")
        assert r1.round().restart == ("/r1/a",)
        return
    r1.restarted = ended == "by a word"
    r1.unseen = ended != "by a look at all"
    r1.started = {"/r1/b": moment() + timedelta(seconds=1)} if ended == "by a process" else {}
    assert not r1.round().restart
    r1.restarted, r1.unseen, r1.started = False, True, {}
    assert not r1.round().restart


def test_a_start_that_cannot_be_told_ends_no_restart(r1: Robot) -> None:
    """The files may have changed since the start that is known again.  Twin: "by a start"."""
    r1.unseen, r1.release, r1.restarted = True, None, True
    for r1.boot in ("first", ""):
        r1.round()
    r1.restarted = False
    (r1.folder / "enclaves/r1/a" / CRL_FILE).write_text("x")
    for r1.boot in ("", "second", "", "second"):
        assert r1.round().restart == ("/r1/a",), r1.boot
    r1.boot = "third"
    assert not r1.round().restart


def test_a_process_may_have_started_with_the_list_that_a_round_replaces(
    home: Home, r1: Robot
) -> None:
    r1.unseen, r1.restarted, r1.release = True, True, home.revoked
    for _ in range(2):
        assert r1.round().sent and not r1.message().crl_restart
    r1.restarted = False
    (r1.folder / "enclaves/r1/b" / CRL_FILE).write_text("x")
    done, said = r1.round(), r1.message()
    assert done.changed == done.restart == said.restart == ("/r1/b",) and said.crl_restart is None


def governance_again(home: Home) -> dict[str, bytes]:
    """Return the governance of /r1/b, signed again."""
    path = "enclaves/r1/b/governance.p7s"
    document = smime.parse(home.revoked.files[path]).document
    return {path: home.authority.sign(document, "the governance")}


def test_units_restart_in_their_order(home: Home, r1: Robot) -> None:
    units = (Unit("bad.service", ("/r1/c",)), Unit("a.service", ("/r1/a",)))
    r1.settings = replace(r1.settings, restart=True, units=units)
    r1.round()
    r1.started = {name: moment() - timedelta(hours=1) for name in NAMES}
    r1.release = home.revoked
    done = r1.round()
    assert r1.systemctl == ["a.service", "sros@r1-b.service"] and done.restart == ("/r1/c",)
    assert done.restarted == [units[1], Unit("sros@r1-b.service", ("/r1/b",))]
    assert any("bad.service" in problem for problem in done.problems)
    assert not r1.round().restarted
    assert r1.systemctl == ["a.service", "sros@r1-b.service"], "what is done is not done again"


def test_a_unit_restarts_once_for_each_change_of_its_files(home: Home, r1: Robot) -> None:
    """Also if its processes cannot be seen, or another one in the enclave goes on to run."""
    r1.settings = replace(r1.settings, restart=True, units=(Unit("c.service", ("/r1/c",)),))
    r1.unseen = r1.restarted = True
    r1.started = {"/r1/a": moment() - timedelta(hours=1)}
    r1.round()
    r1.restarted, r1.systemctl = False, []
    r1.release = home.revoked
    for _ in range(2):
        assert r1.round().restart == ("/r1/a", "/r1/c")
        assert r1.systemctl == ["c.service", "sros@r1-b.service"]
    r1.started["/r1/c"] = moment() - timedelta(hours=1)
    r1.round()
    assert r1.systemctl == ["c.service", "sros@r1-b.service"]
    (r1.folder / "enclaves/r1/c/permissions.p7s").write_text("x")
    r1.round()
    assert r1.systemctl[2:] == ["c.service"]


def test_a_process_that_cannot_read_the_key_restarts_nothing_and_ends_no_restart(
    home: Home, r1: Robot
) -> None:
    """Any user can start a program that names the folder and an enclave."""
    r1.settings = replace(r1.settings, restart=True, units=(Unit("a.service", ("/r1/a",)),))
    r1.round()
    r1.systemctl, r1.user = [], r1.folder.stat().st_uid + 1
    r1.started = {"/r1/a": moment() - timedelta(hours=1)}
    assert r1.round().restart == ("/r1/a",) and not r1.systemctl
    claimed, r1.started, r1.unseen = r1.started, {}, True
    assert r1.round().restart == ("/r1/a",) and not r1.systemctl, "no files are new"
    r1.started, r1.unseen = claimed, False
    r1.mode = 0o644  # of a key that the process itself has mounted over the robot's
    assert r1.round().restart == ("/r1/a",) and not r1.systemctl
    key = r1.folder / "enclaves/r1/a" / KEY_FILE
    key.chmod(0o644)
    r1.enclaves = r1.inbox.parent / "own"
    (r1.enclaves / "r1/a").mkdir(parents=True)
    r1.round()
    assert not r1.systemctl
    r1.enclaves = None
    r1.round()
    assert r1.systemctl, "whoever can read the key may run there"
    key.chmod(0o600)
    r1.systemctl = []
    r1.unseen, r1.release = True, home.revoked
    r1.started = {"/r1/a": moment() + timedelta(hours=1)}
    r1.settings = replace(r1.settings, restart=False)
    assert "/r1/a" in r1.round().restart
    r1.user = 0
    assert "/r1/a" not in r1.round().restart


@pytest.mark.parametrize("patience", [0.0, 60.0])
def test_a_round_waits_until_restarted_processes_are_seen(
    patience: float, home: Home, r1: Robot
) -> None:
    """A process of /r1/c, which is not a node, is never seen, and not waited for."""
    units = (Unit("a.service", ("/r1/a",)), Unit("script.service", ("/r1/c",)))
    r1.settings = replace(r1.settings, restart=True, units=units)
    r1.round()
    r1.started = {name: moment() - timedelta(hours=1) for name in ("/r1/a", "/r1/b")}
    r1.release, r1.unseen, r1.starting, r1.patience = home.revoked, True, 2, patience
    r1.looked.clear()
    done = r1.round()
    assert len(r1.systemctl) == 3
    assert done.restart == (("/r1/c",) if patience else NAMES)
    assert len(r1.looked) <= 4


def test_no_unit_restarts_that_could_not_start_or_must_not(home: Home, r1: Robot) -> None:
    units = (Unit("a.service", ("/r1/a",)), Unit("c.service", ("/r1/c",)))
    r1.settings = replace(r1.settings, restart=True, units=units, restart_if=("false",))
    r1.round()
    r1.started = dict.fromkeys(NAMES, moment() - timedelta(hours=1))
    r1.release = home.revoked
    done = r1.round()
    assert done.restart == done.waiting == r1.message().waiting == NAMES and not r1.systemctl
    (r1.folder / "enclaves/r1/a/key.pem").unlink()
    done = r1.round()
    assert done.restart == NAMES and done.waiting == r1.message().waiting == NAMES[1:]
    r1.settings = replace(r1.settings, restart_if=("/no/command",))
    why = "did not start or end: [Errno 2] No such file or directory: '/no/command'."
    assert any(problem.endswith(why) for problem in r1.round().problems)
    r1.settings = replace(r1.settings, restart_if=("true",))
    done = r1.round()
    assert r1.systemctl == ["c.service", "sros@r1-b.service"]
    assert any("a.service is not restarted" in problem for problem in done.problems)
    assert not done.waiting and r1.message().waiting is None


def test_what_systemctl_says_is_printed_as_it_is(tmp_path: Path) -> None:
    """But no character that a terminal obeys, and that no message may have."""
    command = tmp_path / "systemctl"
    command.write_text("#!/bin/sh\nprintf \"See 'status a' [1].\\n\\033[2J\" >&2; exit 1\n")
    command.chmod(0o755)
    with pytest.raises(UnavailableError, match=r"failed\. See 'status a' \[1\]\. \?\[2J\.\Z"):
        Systemd((str(command),)).restart("a.service")
    command.write_text("#!/bin/sh\necho 'a: Interactive authentication required.' >&2; exit 1\n")
    with pytest.raises(UnavailableError, match=r"required\. Let .* a polkit rule \(docs/fetching"):
        Systemd((str(command),)).restart("a.service")


def test_what_is_wrong_with_processes_is_confirmed(r1: Robot) -> None:
    r1.started = {"/r1/a": moment() + timedelta(seconds=1)}
    process = r1.process("/r1/a")
    permissive = {**process.environment, "ROS_SECURITY_STRATEGY": "Permissive"}
    outside = replace(process, enclave=replace(process.enclave, name="/of/others", keystore="/x"))  # type: ignore[type-var]
    running = RunningProcesses((replace(process, environment=permissive), outside))
    r1.running = lambda now: running  # type: ignore[method-assign]
    (problem,) = r1.round().problems
    assert problem.startswith("process 1 (node):") and r1.message().problems == (problem,)


def test_a_secured_node_in_another_network_namespace_is_no_problem(r1: Robot) -> None:
    """As in a container without the network of the host, which `sros check runtime` notes."""
    r1.started = {"/r1/a": moment() + timedelta(seconds=1)}
    node = replace(r1.process("/r1/a"), network="net:[1]")
    r1.running = lambda now: RunningProcesses((node,))  # type: ignore[method-assign]
    assert r1.round().problems == ()
    node = replace(node, environment={**node.environment, "ROS_SECURITY_STRATEGY": "Permissive"})
    assert len(r1.round().problems) == 1


def test_a_process_from_another_folder_never_has_the_present_files(
    r1: Robot, tmp_path: Path
) -> None:
    """As of a node that was started from an older copy: a revocation list never reaches it."""
    r1.round()
    r1.started = {"/r1/a": moment() + timedelta(seconds=1)}
    process = r1.process("/r1/a")
    copy = copy_of(r1.folder, tmp_path / "copy")
    state = copy.stat()
    assert process.enclave
    found = replace(
        process.enclave,
        keystore=str(copy),
        name="r1/a/",
        local_keystore=copy,
        folders=((state.st_dev, state.st_ino),),
    )
    r1.settings = replace(r1.settings, restart=True, units=(Unit("a.service", ("/r1/a",)),))
    for enclave in (
        found,
        replace(found, keystore=str(r1.folder), local_keystore=None),
    ):  # in a container
        running = RunningProcesses((process, replace(process, enclave=enclave)))
        r1.running = lambda now, seen=running: seen  # type: ignore[method-assign, misc]
        done = r1.round()
        (problem,) = r1.message().problems or ()
        assert "/r1/a from '" in problem and f"not from '{r1.folder}'" in problem
        assert r1.message().restart == ("/r1/a",) and not done.restart and not r1.systemctl
        assert (r1.message().running or {})["/r1/a"] is RunningFiles.EARLIER
    hidden = replace(found, folders=(), problem="Permission denied")
    r1.running = lambda now: RunningProcesses((replace(process, enclave=hidden),))  # type: ignore[method-assign]
    (r1.folder / "enclaves/r1/a/permissions.p7s").unlink()
    assert r1.round().restart == ("/r1/a",), "it may have files of before"


# ── renewal ────────────────────────────────────────────────────────────────────────────────


def late_in_life(r1: Robot) -> datetime:
    validity = validity_of(read_certificate(r1.folder / "enclaves/r1/a/cert.pem"))
    return validity.not_after - (validity.not_after - validity.not_before) / 4


def test_renewal_is_asked_for_in_the_last_third_of_a_certificate(home: Home, r1: Robot) -> None:
    assert r1.round().requests == 0
    done = r1.round(late_in_life(r1))
    assert done.requests == 3
    requests = [load_request(text.encode(), "it") for text in r1.message().requests or ()]
    assert [request.name for request in requests] == list(NAMES)
    own = read_certificate(r1.folder / "enclaves/r1/a/cert.pem")
    assert requests[0].public_key == own.public_key()


def test_the_life_of_a_certificate_begins_when_it_was_made() -> None:
    """Its validity begins a day earlier, which would be all the life of one for an hour."""
    made = datetime(2027, 1, 2, tzinfo=UTC)
    assert Window(made - BACKDATE, made + timedelta(hours=1)).lifetime() == timedelta(hours=1)
    assert Window(made, made + timedelta(hours=4)).lifetime() == timedelta(hours=4)  # another CA's
    longer = Window(made, made + timedelta(hours=30))
    assert longer.lifetime() == timedelta(hours=6)
    assert longer.lifetime(made + timedelta(minutes=1)) == timedelta(hours=29, minutes=59)
    for wrong in (made - timedelta(days=9), made + timedelta(days=9)):
        assert timedelta(hours=6) <= longer.lifetime(wrong) <= timedelta(hours=30)


def test_how_long_a_certificate_has_been_here_tells_when_it_was_made(home: Home, r1: Robot) -> None:
    """As of one of another CA, whose validity began when it was made."""
    file = r1.folder / "enclaves/r1/a/cert.pem"
    for strange in (-1e12, 1e12):  # of no year
        os.utime(file, (strange, strange))
        assert r1.round(late_in_life(r1)).requests == 3
    validity = validity_of(read_certificate(file))
    third = validity.not_after - (validity.not_after - validity.not_before) / 3
    now = third + timedelta(minutes=1)
    os.utime(file, ((validity.not_before + BACKDATE).timestamp(),) * 2)
    assert "/r1/a" not in asked_for(r1, now)
    os.utime(file, (validity.not_before.timestamp(),) * 2)
    assert "/r1/a" in asked_for(r1, now)


def asked_for(robot: Robot, now: datetime) -> list[str]:
    robot.round(now)
    return [load_request(text.encode(), "it").name for text in robot.message().requests or ()]


def test_a_new_key_waits_beside_the_present_one(r1: Robot) -> None:
    """A message asks for one enclave, which signs it; every hour it is another."""
    r1.settings = replace(r1.settings, new_key=True)
    now = late_in_life(r1)
    keys = {name: (r1.folder / f"enclaves{name}/key.pem").read_bytes() for name in NAMES}
    asked: dict[str, object] = {}
    for hour in (0, 1, 2, 3):
        r1.round(now + timedelta(hours=hour))
        (text,) = r1.message().requests or ()
        request = load_request(text.encode(), "it")
        own = read_certificate(r1.folder / f"enclaves{request.name}/cert.pem")
        smime.parse((r1.inbox / "r1/confirmation.p7s").read_bytes()).verify(own)
        assert request.public_key != own.public_key()
        assert asked.setdefault(request.name, request.public_key) == request.public_key
    assert set(asked) == set(NAMES)
    assert keys == {name: (r1.folder / f"enclaves{name}/key.pem").read_bytes() for name in NAMES}
    waiting = list((r1.folder / ".agent/new-keys").iterdir())
    assert len(waiting) == 3 and all(path.stat().st_mode & 0o777 == 0o600 for path in waiting)


def test_a_new_key_is_asked_for_before_the_keystore_machine_renews_the_present_one(
    made_publisher: published.Home, tmp_path: Path
) -> None:
    """With the template production, its timer issues certificates again after 150 of 365 days."""
    folder = tmp_path / "robot"
    sros("distribute_key", made_publisher.root, "--robot", "r1", folder).ok()
    robot = Robot(folder, tmp_path / "inbox")
    permissions = read_credentials(OpenedKeystore(folder), "/r1/base").lifetime().permissions
    made, day = permissions.not_before + BACKDATE, timedelta(days=1)
    assert permissions.expires_soon_from() == made + 150 * day
    for new_key, expected in ((True, [0, 1, 1]), (False, [0, 0, 0])):
        robot.settings = replace(robot.settings, new_key=new_key)
        assert [robot.round(made + days * day).requests for days in (107, 109, 150)] == expected


# ── death and full disks ───────────────────────────────────────────────────────────────────


@pytest.fixture
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that dies takes nothing with it that the system was given."""
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    monkeypatch.setattr(os, "fsync", lambda _: None)


def certificate_of(release: Release) -> x509.Certificate:
    """Return the certificate of /r1/a in a release."""
    (certificate,) = load_certificates(release.files["enclaves/r1/a/cert.pem"], "it")
    return certificate


@pytest.mark.usefixtures("no_waiting_for_the_disk")
@pytest.mark.parametrize("instead", [None, run_out_of_space], ids=["killed", "full disk"])
def test_a_round_that_ends_anywhere_is_ended_by_the_next(
    instead: Callable[..., object] | None, home: Home, r1: Robot, tmp_path: Path
) -> None:
    r1.round()
    r1.started = {"/r1/a": moment() - timedelta(hours=1)}
    before, inbox = tmp_path / "before", tmp_path / "inbox-before"
    copy_of(r1.folder, before)
    shutil.copytree(r1.inbox, inbox)
    r1.release = home.revoked

    def fresh() -> None:
        for place, kept in ((r1.folder, before), (r1.inbox, inbox)):
            shutil.rmtree(place)
            copy_of(kept, place)

    fresh()
    r1.signers += map(certificate_of, (home.first, home.renewed))
    status, steps = in_child(r1.round)
    assert status == 0 and steps[-1] > 40
    earlier = 0
    for step in few_steps(steps):
        fresh()
        if instead is None:
            assert in_child(r1.round, step)[0] == DIED, step
        else:
            assert in_child(r1.round, step, instead)[0] == 0, step
        assert any(has(r1.folder, each) for each in (home.first, home.revoked)) or instead
        earlier += not has(r1.folder, home.revoked)
        last = r1.message().sequence
        done = r1.round(moment() + timedelta(minutes=5))
        assert has(r1.folder, home.revoked) and not done.problems, (step, done)
        assert done.restart == ("/r1/a",), f"the restart is not forgotten, at {step}"
        now = r1.message().sequence
        assert last and now and now > last
        assert sorted(os.listdir(r1.folder)) == [".agent", "enclaves"]
    assert earlier or (instead and not LONG)


def test_the_status_after_a_round_that_could_not_write_it(r1: Robot) -> None:
    def is_well() -> tuple[bool, str]:
        status = agent_status(r1.folder, now=moment(), oldest=timedelta(days=1))
        return status.well, " ".join(status.problems)

    r1.round()
    r1.round()
    assert is_well() == (True, "")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("sros_tool.agent.agent.write_state", run_out_of_space)
        r1.round()
    well, why = is_well()
    assert not well and "The last round could not write" in why
    r1.round()
    assert is_well() == (True, "")


# ── settings ───────────────────────────────────────────────────────────────────────────────


def test_settings_are_read_as_written(r1: Robot) -> None:
    assert read_settings(r1.folder) == r1.settings
    odd = AgentSettings(
        "r1",
        "https://fleet.example/pub?x='\"",
        "/in box\\",
        authorities=("0" * 64,),
        tls_ca="/etc/ca.pem",
        new_key=True,
        restart=True,
        restart_if=("/bin/true", "a b"),
        systemctl=("systemctl", "--user"),
        units=(Unit("a.service", ("/r1/a", "/r1/b")), Unit("b.service", ("/r1/b",))),
    )
    write_settings(r1.folder, odd)
    assert read_settings(r1.folder) == odd


WRONG = (
    "", "robot = 1", 'robot = "r1"', "robot = [", "x = 1",
    'robot = "../r1"\nfrom = "/a"\ninbox = "/b"', 'robot = "r1"\nfrom = "a"\ninbox = "/b"',
    'robot = "r1"\nfrom = "ftp://a"\ninbox = "/b"',
    'robot = "r1"\nfrom = "/a"\ninbox = "/b"\nauthorities = ["x"]',
    'robot = "r1"\nfrom = "/a"\ninbox = "/b"\nsystemctl = []',
    'robot = "r1"\nfrom = "/a"\ninbox = "/b"\n[[unit]]\nname = "-x.service"\nenclaves = []\nx = 1',
    'robot = "r1"\nfrom = "/a"\ninbox = "/b"\n[[unit]]\nname = "x"\nenclaves = ["/a"]',
    'robot = "r1"\nfrom = "/a"\ninbox = "/b"\n[[unit]]\nname = "x.service"\nenclaves = ["a"]',
)  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_wrong_settings_are_refused(text: str, r1: Robot) -> None:
    (r1.folder / ".agent/agent.toml").write_text(text)
    with pytest.raises(DocumentError, match=r"agent\.toml"):
        read_settings(r1.folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs files of another user")
@pytest.mark.parametrize("of_others", ["", ".agent", ".agent/agent.toml"])
def test_settings_that_others_can_change_are_not_used(of_others: str, r1: Robot) -> None:
    os.chown(r1.folder / of_others, 1000, 1000)
    with pytest.raises(KeystoreError, match=r"belongs to|can change.*`sudo chown -h root "):
        read_settings(r1.folder)


def test_one_agent_at_a_time(r1: Robot) -> None:
    with (
        agent_lock(r1.folder),
        pytest.raises(KeystoreError, match="another agent"),
        agent_lock(r1.folder),
    ):
        pass
    assert sros("agent", "run", r1.folder, "--once").status in (1, 2)
