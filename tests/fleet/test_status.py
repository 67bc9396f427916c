"""Status of a fleet: true after each thing that happens to robots, with real exports."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from sros_tool.agent.running import EnclaveProcesses
from sros_tool.agent.state import AgentState, write_state
from sros_tool.checks.keystores.files import KEY_READABLE
from sros_tool.checks.processes import PROCESS_KEY_READABLE
from sros_tool.cli import fleet as fleet_verbs
from sros_tool.cli.fleet import (
    ComparedFleet,
    _fleet_facts,
    _joined_durations,
    _lines,
    _remedies,
    _robot_names,
)
from sros_tool.keystore.confirmation import (
    LOW_SEQUENCE,
    MESSAGE_FILE,
    READABLE_KEYS,
    REPLACED_FILES,
    LibraryUse,
    RobotClock,
    RobotDds,
    RobotLibrary,
    RunningFiles,
    parse_confirmation,
    problem_rank,
    refusals,
    store_refusals,
)
from sros_tool.keystore.fleet_metrics import fleet_metrics
from sros_tool.keystore.fleet_status import FleetStatus, State, _KeystoreRecords, fleet_status
from sros_tool.keystore.layout import ENCLAVES, REFUSED
from sros_tool.keystore.reader import OpenedKeystore, read_certificate
from sros_tool.keystore.template import Template
from sros_tool.pki.certificates import digest, validity_of
from sros_tool.runtime.processes import boot_id
from sros_tool.validity import iso, parse_iso
from tests.keystore.test_confirmation import DDS, LIBRARY, hostile
from tests.support.harness import Ended, copy_of, policy_text, publish, sros
from tests.support.messages import said_by, signed_message

ROBOTS = ("r1", "r2", "r3")
NO_NODE = ("--exclude", "enclave.node-cannot-start")
POLICY = policy_text({"/{robot}/base": publish("/{robot}/x"), "/dispatcher": publish("/y")})
SOUND_DDS = RobotDds(
    (RobotLibrary(LIBRARY["product"], LIBRARY["version"], LIBRARY["path"], LibraryUse.PROCESS),), 0
)
SHARED = ("governance", "identity_ca", "permissions_ca")


@dataclass
class Field:
    """A keystore with a fleet, and a folder for each robot."""

    folder: Path
    sequence: int = 0

    @property
    def root(self) -> Path:
        return self.folder / "ks"

    def run(self, *words: object, status: int = 0) -> Ended:
        """Run the program; the keystore is the first word after the verb."""
        ended = sros(*words, cwd=self.folder)
        assert ended.status == status, ended
        return ended

    def deliver(self, *robots: str, **changed: object) -> None:
        """Export the enclaves of robots to them, and confirm what they have then."""
        for robot in robots:
            self.run("distribute_key", "ks", "--robot", robot, robot, "--force")
            self.confirm(robot, **changed)

    def report(self, robot: str, *words: str, **processes: Any) -> dict[str, Any]:
        """Return what the robot reports if sros sees ``processes`` there; without them, nothing."""
        states = {f"/{robot}/base": RunningFiles.NOT_SEEN}
        seen = EnclaveProcesses(states, states, states, (), False, (), SOUND_DDS)
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(fleet_verbs, "_processes_here", lambda *_: seen._replace(**processes))
            said = self.run("fleet", "report", robot, "--robot", robot, *words).out
        found: dict[str, Any] = json.loads(said)
        return found

    def confirm(self, robot: str, *words: str, **changed: object) -> Ended:
        """Confirm what a robot has, with a sound DDS and with ``changed`` values."""
        said = self.report(robot, *words)
        (self.folder / "said.json").write_text(json.dumps(said | {"dds": DDS} | changed))
        return self.run("fleet", "confirm", "ks", "said.json", "--robot", robot)

    def send(self, robot: str, **changed: object) -> Ended:
        """Let the agent of a robot say what it has, with ``changed`` values, and take it in."""
        self.sequence += 1
        folder, now = self.folder / robot, datetime.now(UTC)
        values = {"sequence": self.sequence, "dds": SOUND_DDS, **changed}
        message = signed_message(folder, f"/{robot}/base", said_by(folder, robot, now, **values))
        place = self.folder / "inbox" / robot
        place.mkdir(parents=True, exist_ok=True)
        (place / MESSAGE_FILE).write_bytes(message)
        return sros("fleet", "collect", "ks", "inbox", cwd=self.folder)

    def age(self, robot: str, by: timedelta) -> None:
        """Let the last confirmation of a robot be older."""
        kept = self.root / "confirmed" / f"{robot}.json"
        value = json.loads(kept.read_text())
        value["received"] = iso(parse_iso(value["received"]) - by)
        kept.write_text(json.dumps(value))

    def status(self) -> dict[str, Any]:
        """Return what is where; the exit status says whether all of it is as it should be."""
        ended = sros("fleet", "status", "ks", "--json", cwd=self.folder)
        found: dict[str, Any] = json.loads(ended.out)
        good = (
            (each["state"] in ("current", "none") and not each["problems"])
            or (each["state"], each["enclaves"]) == ("revoked", 0)
            for each in found["robots"]
        )
        assert found["complete"] == (all(good) and not (found["older"] or found["edited"]))
        assert ended.status == (0 if found["complete"] else 1)
        found["robots"] = {each["robot"]: each for each in found["robots"]}
        return found

    def states(self) -> dict[str, str]:
        """Return the state of each robot."""
        return {name: each["state"] for name, each in self.status()["robots"].items()}

    def pending(self, robot: str) -> dict[str, tuple[str, str]]:
        """Return what a robot lacks, or has too much, by kind: its state, and what to do."""
        found = self.status()["robots"][robot]["pending"]
        return {each["kind"]: (each["state"], each["action"]) for each in found}

    def issued(self, what: str, enclave: str) -> list[str]:
        """Return when what an enclave has was issued."""
        entries = OpenedKeystore(self.root).ledger.entries
        return [each.time for each in entries if (each.what, each.enclave) == (what, enclave)]


@pytest.fixture(scope="module")
def delivered(tmp_path_factory: pytest.TempPathFactory) -> Field:
    """A fleet in which every robot has confirmed what it should have; only to be copied."""
    field = Field(tmp_path_factory.mktemp("fleet"))
    (field.folder / "fleet.toml").write_text("".join(f"[robots.{each}]\n" for each in ROBOTS))
    (field.folder / "policy.xml").write_text(POLICY)
    field.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    assert field.states() == dict.fromkeys(ROBOTS, "never")
    field.deliver(*ROBOTS)
    return field


@pytest.fixture
def field(delivered: Field, tmp_path: Path) -> Field:
    return Field(copy_of(delivered.folder, tmp_path / "field"))


def test_a_fleet_that_has_all_it_should_have(field: Field) -> None:
    found = field.status()
    assert found["counts"] == {"current": 3}
    assert (found["stage"], found["unassigned"]) == ("complete", 1)
    said = field.run("fleet", "status", "ks").out
    assert "\n1 enclave belongs to no robot, so no confirmation covers it: /dispatcher\n" in said
    assert found["robots"]["r1"]["pending"] == []
    assert found["robots"]["r1"]["files"]["permissions"] == {"current": 1}
    assert field.run("fleet", "status", "ks").out.splitlines()[0] == "3 robots: 3 current"
    rows = field.run("fleet", "status", "ks", "--all").out
    assert re.findall(r"\n(\w+) +current +\d+ \w+ ago\n", rows.replace("\n", "\n\n")) == [*ROBOTS]
    refused = field.run("fleet", "status", "ks", "--all", "--json", status=2)
    assert "--all is for the table of robots" in refused.err
    field.run("fleet", "status", "ks", "--max-age", "1h")
    kept = field.root / "confirmed/r1.json"
    kept.write_text(
        json.dumps({**json.loads(kept.read_text()), "received": "2020-01-01T00:00:00Z"})
    )
    lines = field.run("fleet", "status", "ks", "--max-age", "1h", status=1).out.splitlines()
    assert lines[0] == "3 robots: 2 current, 1 offline"
    assert lines[-2].startswith("r1 ") and lines[-1].startswith("r2, r3  current ")
    late = json.loads(field.run("fleet", "status", "ks", "--max-age", "1h", "--json", status=1).out)
    assert (late["overdue"], late["complete"]) == (["r1"], False)
    field.run("fleet", "status", "ks")
    (field.root / "confirmed/notes.txt").write_text("mine")
    said = field.run("check", "keystore", "ks", "--severity", "note", *NO_NODE).out
    assert "confirmed/notes.txt" in said and "r1.json" not in said
    assert "fleet.toml" not in said


def test_a_robot_that_was_not_reached(field: Field) -> None:
    (first,) = field.issued("permissions", "/r1/base")
    field.run("renew", "ks", "--robot", "r1", "--robot", "r2")
    field.deliver("r2")
    assert field.states() == {"r1": "earlier", "r2": "current", "r3": "current"}
    assert field.pending("r1") == dict.fromkeys(
        ("certificate", "permissions"), ("earlier", "deliver")
    )
    assert {each["since"] for each in field.status()["robots"]["r1"]["pending"]} == {first}
    said = field.run("fleet", "status", "ks", status=1).out
    assert "3 robots: 2 current, 1 earlier" in said
    assert f"earlier certificate, permissions of {first}" in said and "\nr2 " not in said
    assert said.count("\ndeliver: ") == 1 and "\nrestart: " not in said
    assert "\ndeliver: `sros distribute_key ks --robot r1 FOLDER --force`, bring FOLDER to" in said
    field.run("renew", "ks", "--robot", "r3")
    said = field.run("fleet", "status", "ks", status=1).out
    assert said.count("\ndeliver: ") == 1 and "distribute_key ks --robot NAME FOLDER" in said


def test_a_robot_that_was_restored_from_a_backup(field: Field) -> None:
    shutil.copytree(field.folder / "r1", field.folder / "backup")
    field.run("renew", "ks", "/r1/base", "--revoke-old")
    field.deliver(*ROBOTS)
    assert field.states() == dict.fromkeys(ROBOTS, "current")
    shutil.rmtree(field.folder / "r1")
    (field.folder / "backup").rename(field.folder / "r1")
    field.confirm("r1")
    assert field.states() == {"r1": "revoked", "r2": "current", "r3": "current"}
    assert field.pending("r1") == {
        "certificate": ("revoked", "deliver"),
        "permissions": ("earlier", "deliver"),
        "crl": ("missing", "deliver"),
    }


def test_a_robot_that_got_the_files_of_another_one(field: Field) -> None:
    shutil.rmtree(field.folder / "r1")
    shutil.copytree(field.folder / "r2", field.folder / "r1")
    field.confirm("r1")
    assert field.states() == {"r1": "another", "r2": "current", "r3": "current"}
    found = field.status()["robots"]["r1"]["pending"]
    theirs = [each for each in found if each["robot"] == "r2"]
    assert {each["action"] for each in theirs} == {"remove"} and len(theirs) == 5
    assert {each["state"] for each in found if each not in theirs} == {"missing"}
    place = field.folder / "r1" / ENCLAVES  # now its own name, with the other's identity
    (place / "r2").rename(place / "r1")
    field.confirm("r1")
    assert field.pending("r1") == dict.fromkeys(
        ("certificate", "permissions"), ("another", "deliver")
    )
    said = field.run("fleet", "status", "ks", status=1).out
    assert "2 files of r2" in said and "1 foreign files" in said
    page = field.run("fleet", "status", "ks", "--html", "--robot", "r1", status=1).out
    assert "then deliver to both" in page and "<dt>deliver</dt>" in page


def test_files_of_another_enclave_of_the_robot_are_none_of_another_robot(field: Field) -> None:
    policy = policy_text({"/{robot}/base": publish("/x"), "/{robot}/arm": publish("/z")})
    (field.folder / "policy.xml").write_text(policy)
    field.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    field.deliver("r1")
    place = field.folder / "r1" / ENCLAVES / "r1"
    shutil.copytree(place / "base", place / "arm", dirs_exist_ok=True)
    field.confirm("r1")
    robot = field.status()["robots"]["r1"]
    assert (robot["state"], robot["to_do"]) == ("different", "deliver")
    assert {each["enclave"] for each in robot["pending"]} == {"/r1/base"}


def test_a_robot_without_a_key_that_fits(field: Field) -> None:
    """Its confirmed files are current, and no process would start with them."""
    for robot in ("r1", "r2"):
        (field.folder / robot / ENCLAVES / robot / "base/key.pem").unlink()
    other = field.folder / "r3" / ENCLAVES / "r3/base/key.pem"
    (field.folder / "r2" / ENCLAVES / "r2/base/key.pem").write_bytes(other.read_bytes())
    (field.folder / "r2" / ENCLAVES / "r2/base/key.pem").chmod(0o600)
    other.write_text("damaged")
    for robot in ROBOTS:
        field.confirm(robot)
    assert field.states() == dict.fromkeys(ROBOTS, "unusable")
    for name, found in field.status()["robots"].items():
        (problem,) = found["problems"]
        assert problem.startswith(f"/{name}/base could not start: key.pem: "), problem
        assert found["to_do"] == "deliver"
    assert "could not start: key.pem: missing" in field.run("fleet", "status", "ks", status=1).out
    field.deliver(*ROBOTS)
    assert field.states() == dict.fromkeys(ROBOTS, "current")
    field.send("r1", problems=["/r1/base could not start: permissions.p7s: expired."], restart=[])
    found = field.status()["robots"]["r1"]
    assert (found["state"], found["to_do"]) == ("unusable", "look into it")


COPIES = (
    "The files in /pub are older than files that this robot has seen. X.",
    "Release 4 is older than release 6, which this robot has installed before. X.",
    "Release 4 is not sealed by a CA that this robot trusts. X.",
)


@pytest.mark.parametrize("problem", COPIES)
def test_a_robot_whose_server_has_an_old_copy(problem: str, field: Field) -> None:
    """Waiting never helps, and nothing shows that the keystore is old."""
    field.run("fleet", "publish", "ks", "pub")
    field.run("renew", "ks", "--robot", "r1")
    field.run("fleet", "publish", "ks", "pub")
    field.send("r1", problems=[problem], release=1)
    found = field.status()["robots"]["r1"]
    assert (found["state"], found["to_do"]) == ("earlier", "check its server")
    assert found["problems"] == [problem] and field.status()["older"] is None
    field.deliver("r1")
    field.send("r1", problems=[problem], release=2, restart=["/r1/base"])
    found = field.status()["robots"]["r1"]
    assert (found["state"], found["to_do"]) == ("restart", "check its server")
    assert "was restored" in field.run("fleet", "publish", "ks", "pub", "--restored", status=2).err


def test_what_a_robot_says_is_neither_an_error_nor_a_word_of_sros(field: Field) -> None:
    """Its text differs from that of another robot by a duration that is not there."""
    field.send("r1", problems=["a 5 s b"])
    field.send("r2", problems=["a  b"])
    said = field.run("fleet", "status", "ks", status=1).out
    assert "it reports: a 5 s b\n" in said and "it reports: a  b\n" in said
    field.send("r1", problems=["Publish with --restored."])
    assert "it reports: Publish with --rest" in field.run("fleet", "status", "ks", status=1).out


def test_the_gravest_problem_of_a_robot_is_shown_and_the_number_of_the_others(
    field: Field,
) -> None:
    """Whatever another robot reports, with --robot all are shown."""
    key = f"Until 2026-11-29T12:00:00Z{READABLE_KEYS}1 private key: x."
    mended = f"1 file was {REPLACED_FILES}x."
    field.send("r1", problems=[mended, "a", "b", "c", key])
    field.send("r2", problems=[f"{KEY_READABLE.title} {number}" for number in range(50)])
    ended = field.run("fleet", "status", "ks", status=1).out
    assert f"  it reports: {key}; 4 more problems, see --robot\n" in ended
    ended = field.run("fleet", "status", "ks", "--robot", "r1", status=1).out
    lines = "".join(f"  it reports: {problem}\n" for problem in (key, "a", "b", "c", mended))
    assert f"\nr1:\n{lines}" in ended and ended.count(key) == 1
    page = field.run("fleet", "status", "ks", "--robot", "r1", "--html", status=1).out
    page = re.sub('<span class="id">(.*?)</span>', r"\1", page)
    assert all(f"it reports: {problem}" in page for problem in (key, "a", "b", "c", mended))
    words = "word " * 199 + "end"
    field.send("r3", problems=[words])
    row = f"it reports: {'word ' * 37}...; more: --robot r3\n"
    assert row in field.run("fleet", "status", "ks", status=1).out
    assert words in field.run("fleet", "status", "ks", "--robot", "r3", status=1).out
    field.send("r1", problems=["a", key], restart=["/r1/base"])
    said = field.run("fleet", "status", "ks", status=1).out
    assert re.search(rf"(?m)^r1 +restart due .* look into it +it reports: {re.escape(key)};", said)
    copied = (KEY_READABLE.title, PROCESS_KEY_READABLE.title, key)
    assert {*map(problem_rank, copied)} == {0} and problem_rank(mended) == 2


def test_a_web_server_cannot_keep_the_keystore_busy_with_archives(field: Field) -> None:
    field.run("fleet", "publish", "ks", "pub")
    path = field.folder / "pub/metadata/timestamp.json"
    value = json.loads(path.read_text())
    value["signed"]["version"] += 1  # nobody signed it
    path.write_text(json.dumps(value))
    folder = field.folder / "pub/targets/robots"
    archive = next(folder.iterdir())
    for number in range(650 - 3):
        (folder / f"{number:064}.r1.tar.gz").hardlink_to(archive)
    field.run("renew", "ks", "/r1/base")
    (folder / f"{'f' * 64}.r1.tar.gz").hardlink_to(archive)
    refused = field.run("renew", "ks", "/r1/base", status=2).err
    assert "pub/targets/robots' has more than 650 archives" in refused
    assert len(refused.splitlines()) == 1


def test_a_clock_that_is_behind_the_confirmations(field: Field) -> None:
    """No robot would ever be offline, and nobody knows whether a list is in force."""
    field.run("revoke", "ks", "--robot", "r3")
    field.deliver("r1", "r2", restart=[])
    assert field.status()["robots"]["r1"]["crl_in_force"]
    for robot in ("r1", "r2"):
        field.age(robot, -timedelta(days=2))
    ended = sros("fleet", "status", "ks", "--json", cwd=field.folder)
    found = json.loads(ended.out)
    assert ended.status == 1 and not found["complete"]
    assert "behind the last confirmation, of " in found["clock"]
    assert not any(robot["crl_in_force"] for robot in found["robots"])
    said = field.run("fleet", "status", "ks", status=1).out.splitlines()[1]
    assert said.startswith("the clock of this machine shows ") and said.endswith("Set the clock")


def test_files_of_a_robot_that_others_can_read_or_change(field: Field) -> None:
    place = field.folder / "r1" / ENCLAVES / "r1/base"
    place.chmod(0o777)
    (place / "permissions.p7s").chmod(0o666)
    (place / "key.pem").chmod(0o644)
    field.confirm("r1")
    found = field.status()["robots"]["r1"]
    folder, key, permissions = sorted(found["problems"], key=lambda text: text.partition(":")[0])
    assert folder.startswith("enclaves/r1/base: a file or folder that everybody can change: its mo")
    assert permissions.startswith("enclaves/r1/base/permissions.p7s: a file or folder that everyb")
    shown = "enclaves/r1/base/key.pem: a private key that others can read: its mode is 0644. Run `"
    assert key.startswith(shown) and "`chmod 600`" in key and "--revoke-old`" in key
    assert "If the key was made on its robot, revoke the enclave" in key
    assert found["to_do"] == "look into it"


def test_files_that_the_keystore_never_issued(field: Field) -> None:
    with (field.folder / "r1" / ENCLAVES / "r1/base/permissions.p7s").open("a") as file:
        file.write("\n")
    field.confirm("r1")
    assert field.pending("r1") == {"permissions": ("unknown", "deliver")}
    kept = field.root / ENCLAVES / "r2/base/permissions.p7s"
    kept.write_bytes(kept.read_bytes().replace(b"<publish>", b"<subscribe>"))
    assert field.pending("r2") == {"permissions": ("broken", "deliver")}
    kept.unlink()
    assert field.pending("r2") == {"permissions": ("broken", "deliver")}
    crl = f"{ENCLAVES}/r1/base/crl.pem"
    (field.folder / "r1" / crl).write_text("of a keystore that was lost")
    field.confirm("r1")
    shown = field.run("fleet", "status", "ks", "--robot", "r1", status=1).out
    assert f"  find out who signed {crl}: unknown\n" in shown, "nobody is told to remove it"


def test_a_robot_that_was_revoked(field: Field) -> None:
    field.run("revoke", "ks", "--robot", "r3")
    assert field.states() == {"r1": "missing", "r2": "missing", "r3": "revoked"}
    assert field.pending("r1") == {"crl": ("missing", "deliver")}
    assert field.pending("r3") == dict.fromkeys(
        ("certificate", "permissions", *SHARED), ("revoked", "remove")
    )
    lines = field.run("fleet", "status", "ks", "--robot", "r3").out.splitlines()
    (line,) = (
        line for line in lines if "only somebody at the robot can remove these files" in line
    )
    assert line.startswith("  5 files of its revoked enclaves")
    assert not any("remove enclaves/" in line for line in lines)
    field.deliver("r1", "r2")
    assert field.states() == {"r1": "current", "r2": "current", "r3": "revoked"}
    (field.root / "confirmed/r3.json").unlink()
    assert field.states() == {"r1": "current", "r2": "current", "r3": "revoked"}
    said = field.run("fleet", "status", "ks").out
    assert (
        "3 robots: 2 current, 1 revoked" in said
        and "r3      revoked  -          take it out of the fleet file" in said
    )
    revoked = {name: each["revoked"] for name, each in field.status()["robots"].items()}
    assert revoked == {"r1": [], "r2": [], "r3": ["/r3/base"]}
    assert "1 enclave revoked" in field.run("fleet", "status", "ks", "--robot", "r3").out


def test_until_when_a_revocation_is_needed(field: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    assert field.status()["revoked_until"] is None
    field.run("renew", "ks", "/r3/base", "--revoke-old")
    certificate = read_certificate(field.root / ENCLAVES / "r3/base/cert.pem")
    field.run("revoke", "ks", "--robot", "r3")
    until = validity_of(certificate).not_after
    assert field.status()["revoked_until"] == iso(until), "of the last one, not of the first"
    said = field.run("fleet", "status", "ks", status=1).out
    assert (
        f"; no robot needs the list after {until:%Y-%m-%d}, when the revoked certificates have "
        "expired\n" in said
    )
    field.run("update_keystore", "ks", "--set", "certificates.validity=90d")
    field.run("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    field.run("create_enclave", "ks", "/short")
    field.run("revoke", "ks", "/short")
    assert field.status()["revoked_until"] == iso(until), "robots may still trust the earlier CA"
    field.deliver("r1", "r2", restart=[])
    field.run("create_enclave", "ks", "/short")
    certificate = read_certificate(field.root / ENCLAVES / "short/cert.pem")
    field.run("revoke", "ks", "/short")
    end = validity_of(certificate).not_after
    assert field.status()["revoked_until"] == iso(end), "robots wait, and trust only the new CA"
    with monkeypatch.context() as patched:
        patched.setattr(_KeystoreRecords, "age_clause", "it was restored")
        assert fleet_status(OpenedKeystore(field.root)).revoked_until == until
    field.confirm("r1", restart=["/r1/base"])
    assert field.status()["revoked_until"] == iso(until), "a process may trust the earlier CA"
    (field.root / "ledger.jsonl").unlink()
    assert field.status()["revoked_until"] is None, "nobody knows"
    assert (
        "sros does not know until when robots need the list, because"
        in field.run("fleet", "status", "ks", status=1).out
    )


def test_a_revoked_robot_comes_back_by_the_commands_that_errors_name(field: Field) -> None:
    made = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    field.run("revoke", "ks", "--robot", "r3")
    for refused in (made, ("distribute_key", "ks", "/r3/base", "r3")):
        said = field.run(*refused, status=2).err
        command = said.rpartition("`sros ")[2].rpartition("`")[0]
        named = {"POLICY_FILE": "policy.xml", "FLEET_FILE": "fleet.toml"}
        words = [named.get(word, word) for word in command.split()]
        assert "created enclave /r3/base" in field.run(*words).out, command
        field.run("revoke", "ks", "/r3/base")


def test_a_changed_policy(field: Field) -> None:
    (field.folder / "policy.xml").write_text(POLICY.replace("/y", "/z").replace("}/x", "}/new"))
    field.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    field.deliver("r2")
    assert field.states() == {"r1": "earlier", "r2": "current", "r3": "earlier"}
    assert field.pending("r1") == {"permissions": ("earlier", "deliver")}


def test_a_policy_that_changes_for_others_leaves_a_robot_current(field: Field) -> None:
    """Another comment, another robot, other rights of an enclave that is on none of them."""
    robots = field.folder / "fleet.toml"
    for text, fleet in (
        (f"<!-- comment -->{POLICY}", robots.read_text()),
        (POLICY.replace("/y", "/z"), f"{robots.read_text()}[robots.r4]\n"),
    ):
        (field.folder / "policy.xml").write_text(text)
        robots.write_text(fleet)
        field.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
        assert {field.states()[each] for each in ROBOTS} == {"current"}
    assert field.states()["r4"] == "never"


def test_a_rotation_goes_on_when_every_robot_has_confirmed_its_stage(field: Field) -> None:
    for now, then in (("distribute", "before"), ("reissue", "distribute"), ("complete", "reissue")):
        said = field.run("rotate_ca", "ks", "--next").err
        assert ("/dispatcher belongs to no robot" in said) == (now != "complete")
        found = field.status()
        assert found["stage"] == now
        assert {each["stage"] for each in found["robots"].values()} == {then}
        assert field.states() == dict.fromkeys(ROBOTS, "earlier")
        field.deliver("r1", "r3")
        if now != "complete":
            step = "--next" if now == "distribute" else "--finish"
            refused = field.run("rotate_ca", "ks", step, status=2).err
            assert f"confirmed the stage {now}: r2. " in refused
            assert field.status()["stage"] == now
            told = json.loads(field.run("rotate_ca", "ks", "--status", "--json").out)
            assert told["unconfirmed"] == ["r2"]
            assert "not confirmed by r2: see" in field.run("rotate_ca", "ks", "--status").out
        field.deliver("r2")
        if now == "distribute":
            field.confirm("r2", restart=["/r2/base"])
            assert ": r2. " in field.run("rotate_ca", "ks", "--next", status=2).err
            said = field.run("fleet", "status", "ks", status=1).out
            assert "CA rotation: distribute; not confirmed by r2 yet" in said
            field.confirm("r2", restart=[])
            said = field.run("fleet", "status", "ks", status=0).out
            assert "CA rotation: distribute; confirmed by all 3 robots\n" in said
        assert field.states() == dict.fromkeys(ROBOTS, "current")
        assert {each["stage"] for each in field.status()["robots"].values()} == {now}


def test_a_rotation_goes_on_without_robots_if_that_is_chosen(field: Field) -> None:
    refused = field.run("rotate_ca", "ks", "--finish", status=2).err
    assert "several stages together would cut off every robot: r1, r2, r3. " in refused
    assert "confirm the files" not in refused and "add --allow-unconfirmed" in refused
    assert "does not accept a published release" in refused
    alone = ("rotate_ca", "ks", "--finish", "--identity")
    refused = field.run(*alone, status=2).err
    assert "several stages" in refused and "published" not in refused, "releases are sealed as ever"
    field.run("fleet", "publish", "ks", "pub")
    said = field.run(*alone, "--allow-unconfirmed", "--dry-run").err
    assert "refuses all later releases" not in said
    assert "give the server both CAs with their revocation lists" in said
    field.run("rotate_ca", "ks", "--next", "--identity")
    field.deliver("r1", "r3")
    words = ("rotate_ca", "ks", "--to", "reissue", "--allow-unconfirmed")
    cut_off = "these robots have not confirmed the stage before: r2. They {} cut off from robots"
    assert cut_off.format("would be") in field.run(*words, "--dry-run").err
    ended = field.run(*words, "--json")
    assert json.loads(ended.out)["cut_off"] == ["r2"]
    assert cut_off.format("are") in ended.err
    (field.root / "fleet.toml").write_text("[robots.r1]\n")
    assert "is not the file that sros wrote" in field.run("rotate_ca", "ks", "--next", status=2).err
    told = field.run("rotate_ca", "ks", "--status").out
    assert "it is not known which robots confirmed this stage: " in told
    told = field.run("rotate_ca", "ks", "--status", "--json").out
    assert json.loads(told)["unconfirmed"] is None


def test_a_robot_that_missed_a_stage_gets_its_files_by_hand(field: Field) -> None:
    """It refuses what the new CA seals, whether it is off, on, or its message is refused."""

    def to_do() -> str:
        found: str = field.status()["robots"]["r2"]["to_do"]
        return found

    field.run("fleet", "publish", "ks", "pub")
    for robot in ROBOTS:
        field.send(robot, release=1)
    field.run("rotate_ca", "ks", "--next")
    assert "\nrobots accept" in field.run("fleet", "publish", "ks", "pub").out
    assert to_do() == "wait: it fetches"
    certificates = f"{ENCLAVES}/r2/base/identity_ca.cert.pem: earlier of "
    shown = field.run("fleet", "status", "ks", "--robot", "r2", status=1).out
    assert f"\n  {certificates}" in shown, "nobody has to bring it"
    field.deliver("r1")
    field.send("r1", release=1)
    said = field.run("rotate_ca", "ks", "--next", "--allow-unconfirmed").err
    assert (
        "refuses all later releases: run `sros distribute_key ks --robot NAME FOLDER --force`"
        in said
    )
    assert to_do() == "wait: it fetches", "the published release is that of the earlier stage"
    places = [
        said.index(text)
        for text in ("first publish", "confirmed the stage before: r", "all processes together")
    ]
    assert places == sorted(places), "what comes first is said first"
    told = field.run("fleet", "publish", "ks", "pub").out
    assert "the permissions CA (as their last messages say): r2, r3. Bring" in told
    assert "\nrobots that trust this CA accept these files until" in told
    assert to_do() == "deliver"
    refused = "Release 3 is not sealed by a CA that this robot trusts: it is not."
    field.send("r2", release=1, problems=(refused,))
    assert to_do() == "deliver"
    said = field.run("fleet", "status", "ks", "--robot", "r2", status=1).out
    assert "does not trust the CA that seals releases: fetching does not change this" in said
    assert f"\n  deliver {certificates}" in said
    for days in (1 / 24, 2):
        field.age("r2", timedelta(days=days))
        assert to_do() == "deliver"
    field.run("rotate_ca", "ks", "--next", "--allow-unconfirmed")
    field.run("fleet", "publish", "ks", "pub")
    field.send("r2", release=1)
    assert field.states()["r2"] == "refused" and to_do() == "deliver"


def test_new_enclaves_of_a_fleet_that_fetches_need_their_keys(field: Field) -> None:
    field.run("fleet", "publish", "ks", "pub")
    with (field.folder / "fleet.toml").open("a") as file:
        file.write("[robots.r4]\n")
    said = field.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    assert "\ncreated enclave /r4/base\n" in f"\n{said.out}"
    assert "no release has the keys of new enclaves; bring them by hand, also to robots" in said.err


def test_a_robot_that_was_off_during_a_rotation_has_missed_it(field: Field) -> None:
    """It sent nothing new, and a web server may refuse it: its last message counts on."""
    field.run("fleet", "publish", "ks", "pub")
    field.send("r2", release=1)
    field.run("rotate_ca", "ks", "--same-key")
    field.run("fleet", "publish", "ks", "pub")
    said = field.run("fleet", "status", "ks", "--robot", "r2", status=1).out
    assert "an identity CA that was replaced" not in said, "its key still counts"
    for _ in range(3):
        field.run("rotate_ca", "ks", "--identity", "--next", "--allow-unconfirmed")
        field.run("fleet", "publish", "ks", "pub")
        field.run("fleet", "collect", "ks", "inbox")

    def shown() -> tuple[str, str]:
        found = field.status()["robots"]["r2"]
        return found["state"], found["to_do"]

    assert shown() == ("earlier", "wait, else deliver")
    field.age("r2", timedelta(hours=1))
    assert shown() == ("earlier", "deliver")
    said = field.run("fleet", "status", "ks", "--robot", "r2", status=1).out
    assert "a web server that checks certificates refuses the robot; " in said
    field.deliver("r2")
    assert field.states()["r2"] == "current"


def test_a_restart_that_is_due(field: Field) -> None:
    """The files are current, but processes run with those of before: that is not green."""
    assert field.status()["robots"]["r1"]["restart"] is None, "not said"
    field.confirm("r1", restart=["/r1/base"])
    field.confirm("r2", restart=[])
    assert field.states() == {"r1": "restart", "r2": "current", "r3": "current"}
    robots = field.status()["robots"]
    assert [robots[name]["restart"] for name in ROBOTS] == [["/r1/base"], [], None]
    told = field.run("fleet", "status", "ks", status=1).out
    assert "3 robots: 2 current, 1 restart due" in told
    assert "not known whether processes of /r1/base have loaded the" in told
    page = field.run("fleet", "status", "ks", "--html", status=1).out
    assert "not known whether processes of /r1/base have loaded the" in page


def test_a_report_says_which_restarts_are_due_if_all_processes_were_seen(field: Field) -> None:
    """Or if somebody says that all were restarted; then the revocation list can be in force."""
    now, before = ({"/r1/base": state} for state in (RunningFiles.CURRENT, RunningFiles.EARLIER))
    no_new_list = {"states": before, "list_states": now}
    due = ["/r1/base"]
    for words, processes, restart, crl_restart in (
        ((), {}, None, None),
        ((), {"complete": True}, None, None),  # perhaps another machine than the robot
        ((), {"complete": True, "states": now, "list_states": now}, [], []),
        (("--restarted",), {}, [], []),
        ((), {"states": now, "list_states": now}, None, None),  # another one may be unseen
        ((), {"states": before, "list_states": before}, due, None),
        (("--restarted",), {"states": before, "list_states": before}, due, due),
        (("--restarted",), no_new_list, due, []),
        ((), {"elsewhere": ("/r1/base",), "complete": True}, due, due),
    ):
        said = field.report("r1", *words, **processes)
        assert (said.get("restart"), said.get("crl_restart")) == (restart, crl_restart)
    said = field.report("r1", problems=("process 7 (talker): its enclave has no files",))
    assert said["problems"] == ["process 7 (talker): its enclave has no files."]
    field.run("revoke", "ks", "--robot", "r3")
    for words, state, in_force in (((), "current", False), (("--restarted",), "current", True)):
        field.run("distribute_key", "ks", "--robot", "r1", "r1", "--force")
        field.confirm("r1", *words)
        robot = field.status()["robots"]["r1"]
        assert (robot["state"], robot["crl_in_force"]) == (state, in_force)


def test_files_that_are_replaced_during_a_report_are_not_reported_as_loaded(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = field.folder / "r1" / ENCLAVES / "r1/base/permissions.p7s"
    before, look = hashlib.sha256(file.read_bytes()).hexdigest(), fleet_verbs._processes_here

    def replace_and_look(*words: Any) -> EnclaveProcesses:
        file.write_bytes(b"new")
        return look(*words)

    monkeypatch.setattr(fleet_verbs, "_processes_here", replace_and_look)
    said = json.loads(field.run("fleet", "report", "r1", "--robot", "r1").out)
    assert said["files"][f"{ENCLAVES}/r1/base/permissions.p7s"] == before


def test_other_permissions_leave_the_list_in_force(field: Field) -> None:
    """Only on robots whose list changed, or that do not say what changed, is it not in force."""
    field.run("revoke", "ks", "--robot", "r3")
    for name, changed in (
        ("r1", {"restart": ["/r1/base"], "crl_restart": []}),
        ("r2", {"restart": ["/r2/base"]}),
    ):
        field.run("distribute_key", "ks", "--robot", name, name, "--force")
        field.send(name, **{"restart": (), **changed})
    robots = field.status()["robots"]
    assert [robots[name]["state"] for name in ("r1", "r2")] == ["restart", "restart"]
    assert [robots[name]["crl_in_force"] for name in ("r1", "r2")] == [True, False]
    field.send("r1", restart=["/r1/base"], crl_restart=["/r1/base"])
    assert not field.status()["robots"]["r1"]["crl_in_force"]


def test_a_robot_that_fetches_is_offline_after_a_day(field: Field) -> None:
    """A robot that confirms by plays is not, unless somebody asks for it."""
    hours = timedelta(hours=1)
    field.send("r1", release=0, problems=("the disk is full",))
    assert field.states() == dict.fromkeys(ROBOTS, "current")
    for robot in ("r1", "r2"):
        field.age(robot, 23 * hours)
    assert field.states() == dict.fromkeys(ROBOTS, "current")
    for robot in ("r1", "r2"):
        field.age(robot, 2 * hours)
    found = field.status()
    assert field.states() == {"r1": "offline", "r2": "current", "r3": "current"}
    assert (found["overdue"], found["complete"]) == (["r1"], False)
    assert [found["robots"][robot]["fetches"] for robot in ROBOTS] == [True, False, False]
    assert found["robots"]["r1"]["release"] == 0
    lines = field.run("fleet", "status", "ks", status=1).out.splitlines()
    assert lines[0] == "3 robots: 2 current, 1 offline"
    (line,) = (line for line in lines if line.startswith("r1 "))
    assert line.split(maxsplit=2)[1] == "offline" and "it reports: the disk is full" in line
    said = field.run("fleet", "status", "ks", "--max-age", "7d", status=1).out
    assert "3 robots: 3 current" in said and "look into it" in said
    page = field.run("fleet", "status", "ks", "--html", status=1).out
    assert "the disk is full" in page and "offline" in page
    # What is worse stays, and what is pending is still known.
    field.run("revoke", "ks", "--robot", "r1")
    field.run("renew", "ks", "--robot", "r2")
    assert field.states()["r1"] == "revoked"
    field.send("r2")
    field.age("r2", 25 * hours)
    assert field.states()["r2"] == "offline" and field.pending("r2")["certificate"][0] == "earlier"


def test_messages_that_were_held_back_are_as_old_as_they_say(field: Field) -> None:
    """Whoever has the inbox could hand out one of them each day, long after the robot is gone."""
    hours, now = timedelta(hours=1), datetime.now(UTC).replace(microsecond=0)
    field.send("r1", time=now - 23 * hours)
    assert field.states()["r1"] == "current"
    field.send("r1", time=now - 25 * hours)
    found = field.status()
    assert (found["overdue"], found["robots"]["r1"]["state"]) == (["r1"], "offline")
    assert found["robots"]["r1"]["to_do"] == "check its clock", "it was heard just now"
    field.run("fleet", "status", "ks", "--max-age", "7d")
    field.send("r1", time=now - 25 * hours, clock=RobotClock.BEHIND, problems=("it is behind",))
    found = field.status()
    assert (found["overdue"], found["complete"]) == (["r1"], False)
    robot = found["robots"]["r1"]
    assert (robot["state"], robot["to_do"]) == ("offline", "check its clock")
    shown = field.run("fleet", "status", "ks", status=1).out
    assert "offline  1 d 1 h ago  check its clock  it reports: it is behind" in shown
    assert robot["confirmed"] == robot["clock"] < robot["received"]
    field.age("r1", 26 * hours)
    robot = field.status()["robots"]["r1"]
    assert (robot["state"], robot["to_do"]) == ("offline", "find out why")
    (field.root / "confirmed/r2.json").unlink()
    field.confirm("r2", time=iso(now - 25 * hours))
    field.send("r1", time=now + 25 * hours)
    assert field.states() == {**dict.fromkeys(ROBOTS, "current"), "r1": "offline"}
    for ahead, to_do in ((hours / 2, "look into it"), (25 * hours, "check its clock")):
        field.send("r1", time=now + ahead, problems=("The metadata in x has expired.",))
        assert field.status()["robots"]["r1"]["to_do"] == to_do


def test_a_report_does_not_replace_a_later_confirmation(field: Field) -> None:
    earlier = field.folder / "earlier.json"
    earlier.write_text(field.run("fleet", "report", "r1", "--robot", "r1").out)
    said, hour = json.loads(earlier.read_text()), timedelta(hours=1)
    before = {"time": iso(parse_iso(said["time"]) - hour)}
    earlier.write_text(json.dumps(said | before))
    refused = field.run("fleet", "confirm", "ks", "earlier.json", "--robot", "r1", status=2).err
    assert "is older than the robot's last confirmation" in refused
    # The clock of the robot was ahead when it confirmed last.
    field.confirm("r2", time=iso(parse_iso(said["time"]) + 9 * hour))
    field.confirm("r2")


def test_a_robot_that_is_ahead_of_a_restored_keystore(field: Field) -> None:
    field.run("crl", "ks", "--refresh")
    field.run("fleet", "publish", "ks", "pub")
    field.deliver(*ROBOTS)
    backup = copy_of(field.root, field.folder / "backup")
    field.run("crl", "ks", "--refresh")
    field.run("fleet", "publish", "ks", "pub")
    release = field.status()["robots"]["r1"]["published"]
    field.run("distribute_key", "ks", "--robot", "r1", "r1", "--force")
    shutil.rmtree(field.root)
    backup.rename(field.root)
    field.send("r1", release=release)
    for to_do in ("publish", "wait: it fetches"):
        robot = field.status()["robots"]["r1"]
        assert (robot["state"], robot["to_do"]) == ("unknown", to_do)
        said = f"it says that it has release {release}, from after the backup of the keystore"
        assert said in robot["notes"][0]
        table = field.run("fleet", "status", "ks", status=1).out
        assert "\npublish: " not in table, "the line above the table has the options"
        field.run("fleet", "publish", "ks", "pub", *(["--restored"] if to_do == "publish" else []))


def test_what_publishing_renews_is_no_reason_to_fail(field: Field) -> None:
    """But expired metadata is, and so is root metadata whose key is elsewhere."""
    field.run("fleet", "publish", "ks", "pub")
    check = ("check", "ks", "--needs-renewal")
    for words in (("30d",), ("30d", "--at", "3d"), ("2y",)):
        told = field.run(*check, *words).err
        assert "not counted: " in told and ("root metadata until" in told) == (words == ("2y",))
    (field.root / "private/fleet_root.pem").rename(field.folder / "root.pem")
    field.run(*check, "30d")
    command = f": sros fleet publish ks {field.folder}/pub --root-key FILE\n"
    due = field.run(*check, "2y", status=1).out
    assert due.startswith("root metadata  until ") and due.endswith(command)
    path = field.root / "published.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"until": "2026-01-01T00:00:00Z"}))
    due = field.run(*check, "30d", status=1).out
    assert due == (
        "published metadata  expired 2026-01-01T00:00:00Z: "
        f"sros fleet publish ks {field.folder}/pub\n"
    )


def test_a_robot_whose_certificate_a_restored_keystore_lacks(field: Field) -> None:
    """The row says the cause and the command, whether it fetches or not."""
    field.run("fleet", "publish", "ks", "pub")
    backup = copy_of(field.root, field.folder / "backup")
    field.run("renew", "ks", "/r1/base", "--new-key")
    field.deliver("r1")
    shutil.rmtree(field.root)
    backup.rename(field.root)
    shutil.rmtree(field.folder / "pub")

    def row() -> str:
        said = field.run("fleet", "status", "ks", status=1).out
        return next(line for line in said.splitlines() if line.startswith("r1 "))

    command = "`sros distribute_key ks --robot NAME FOLDER --force`"
    field.confirm("r1")
    assert "find out why" in row() and command not in row(), "not known to be restored"
    field.run("fleet", "publish", "ks", "pub", "--restored", "--new-folder")
    why = "perhaps the keystore issued this after the backup from which it was restored."
    assert "unknown files" in row() and why in row() and command in row()
    (field.root / "confirmed/r1.json").unlink()
    why = "the keystore was restored, and lacks what it issued after the backup."
    assert field.send("r1").status == 1
    field.run("fleet", "publish", "ks", "pub", "--restored")
    assert "message refused" in row() and why in row() and command in row()
    field.deliver("r1")
    field.send("r1", release=0)
    assert field.states()["r1"] == "current"


def test_a_restore_does_not_explain_a_damaged_file(field: Field) -> None:
    """Nor files that the keystore knows; it may explain only intact, unknown ones."""
    field.run("crl", "ks", "--refresh")
    field.run("fleet", "publish", "ks", "pub")
    field.deliver("r2")
    earlier = copy_of(field.folder / "r2", field.folder / "earlier")
    field.run("crl", "ks", "--refresh")
    backup = copy_of(field.root, field.folder / "backup")
    field.run("renew", "ks", "/r3/base")
    field.run("fleet", "publish", "ks", "pub")
    field.deliver("r3")
    lost = (field.folder / "r3/enclaves/r3/base/permissions.p7s").read_bytes()
    shutil.rmtree(field.root)
    backup.rename(field.root)
    field.run("fleet", "publish", "ks", "pub", "--restored")
    field.deliver(*ROBOTS)
    signed = field.folder / "r1/enclaves/r1/base/permissions.p7s"
    signed.write_bytes(signed.read_bytes().replace(b"<publish>", b"<publish> ", 1))
    shutil.rmtree(field.folder / "r2")
    earlier.rename(field.folder / "r2")
    (field.folder / "r3/enclaves/r3/base/permissions.p7s").write_bytes(lost)
    for robot in ROBOTS:
        field.confirm(robot)
    told = field.run("fleet", "status", "ks", status=1).out
    rows = {line.split()[0]: line for line in told.splitlines()}
    reported = "it reports: /r1/base could not start: permissions.p7s: its signature does not match"
    assert rows["r1"].partition("find out why")[2].strip().startswith(reported), rows["r1"]
    assert "restored" not in rows["r1"] + rows["r2"]
    assert "earlier" in rows["r2"] and "perhaps the keystore issued this" in rows["r3"]


def test_certificates_that_a_restored_keystore_lacks(field: Field) -> None:
    """Neither a wrong name nor a list in force hides that such certificates are valid."""
    field.run("fleet", "publish", "ks", "pub")
    field.run("revoke", "ks", "--robot", "r3")
    backup = copy_of(field.root, field.folder / "backup")
    field.run("create_enclave", "ks", "/desk")
    shutil.rmtree(field.root)
    backup.rename(field.root)
    missing = (["/desk"], ["/r9/base"], ["--robot", "r9"], ["--match", "/r9/*"])

    def refusals() -> list[str]:
        return [field.run("revoke", "ks", *words, status=2).err for words in missing]

    def status() -> str:
        return sros("fleet", "status", "ks", cwd=field.folder).out

    lost, fact = "that it lacks: they are valid until", "no list revokes certificates that were"
    rotate = "(`sros rotate_ca ks --identity --next` for each stage; docs/howto/keystore_is_lost.md"
    assert not any("rotate_ca" in refusal for refusal in refusals())
    shutil.rmtree(field.folder / "pub")
    before = status()
    field.run("fleet", "publish", "ks", "pub", "--restored", "--new-folder")
    assert all(lost in refusal and rotate in refusal for refusal in refusals())
    assert "/base" in refusals()[1].partition("If the name is wrong: perhaps you mean /r1")[2]
    assert fact not in before and status().count(fact) == 1
    assert field.status()["restored"]
    field.run("rotate_ca", "ks", "--identity", "--next")
    assert fact in status()
    field.run("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    assert fact not in status() and field.status()["restored"] is None
    assert not any("rotate_ca" in refusal for refusal in refusals())


def test_what_an_agent_mended_does_not_fail_a_job_that_asks_so(field: Field) -> None:
    mended = "1 file of the release was changed or missing here, and replaced: x."
    for problems, status in (((mended,), 0), ((mended, f"x{READABLE_KEYS}1 key"), 1)):
        field.send("r1", problems=problems)
        found = field.status()
        assert (found["complete"], found["mended"]) == (False, not status)
        field.run("fleet", "status", "ks", "--fail-on", "unmended", status=status)
        told = field.run("fleet", "status", "ks", "--prometheus", status=1).out
        assert f'\nsros_fleet_mended{{keystore="{field.root}"}} {1 - status}\n' in told
        labels = f'keystore="{field.root}",robot="r1"'
        assert f"\nsros_fleet_agent_problems{{{labels}}} {status}\n" in told
        assert f"\nsros_fleet_agent_mended{{{labels}}} 1\n" in told
    field.send("r1", problems=(mended,), restart=["/r1/base"])
    field.run("fleet", "status", "ks", "--fail-on", "unmended", status=1)
    field.run("fleet", "publish", "ks", "pub")
    field.send("r1", problems=(mended,))
    (field.folder / "pub").rename(field.folder / "away")
    for kinds, status in ((["unmended"], 1), (["seen"], 1), (["unmended", "seen"], 0)):
        words = [word for kind in kinds for word in ("--fail-on", kind)]
        field.run("fleet", "status", "ks", *words, status=status)


def test_a_fleet_file_that_was_edited_is_not_believed(field: Field) -> None:
    path = field.root / "fleet.toml"
    path.write_text(path.read_text().replace("[robots.r3]", "").replace("r3 = {}", ""))
    found = field.status()
    assert len(found["robots"]) == 2 and "is not the file that sros wrote" in found["edited"]
    told = field.run("fleet", "status", "ks", status=1).out
    assert (
        "2 robots: 2 current (perhaps not all robots)\nperhaps not all robots are shown: the"
        in told
    )


def test_a_damaged_ledger_is_not_blamed_on_the_fleet_file(field: Field) -> None:
    """Its remedy would sign everything again, and record the damage for good."""
    ledger = field.root / "ledger.jsonl"
    lines = ledger.read_text().splitlines(keepends=True)
    ledger.write_text("".join([*lines[:5], *lines[6:]]))
    restore = (
        "Restore ledger.jsonl and ledger.p7s from the same backup. Without a backup, state all"
    )
    told = field.run("fleet", "status", "ks", status=1).out
    assert f"the ledger has lines that are missing or were changed. {restore}" in told
    assert restore in field.run("renew", "ks", "--robot", "r1", status=2).err
    found = field.run("check", "ks", status=1).out
    assert "keystore.ledger-damaged" in found and "keystore.fleet-edited" not in found
    words = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    for dry_run in (["--dry-run"], []):
        said = field.run(*words, *dry_run).err
        assert "restore ledger.jsonl and ledger.p7s from it, and repeat the change" in said
    assert "ledger" not in field.run("renew", "ks", "--all").err, "the damage is recorded now"


def test_a_revoked_robot_of_which_only_a_copied_list_knows(field: Field) -> None:
    """A list that was taken from a robot, as after a backup was restored."""
    backup, crl = copy_of(field.root, field.folder / "backup"), "public/identity_ca.crl.pem"
    field.run("revoke", "ks", "--robot", "r3")
    field.run("renew", "ks", "/r2/base", "--new-key", "--revoke-old")
    copy_of(field.root, field.folder / "later")
    shutil.rmtree(field.root)
    backup.rename(field.root)
    shutil.copy(field.folder / "later" / crl, field.root / crl)
    assert "/r2/base --new-key --revoke-old`" in field.run("renew", "ks", "/r2/base", status=2).err
    field.run("revoke", "ks", "--robot", "r3")
    robot = field.status()["robots"]["r3"]
    assert (robot["state"], robot["revoked"]) == ("revoked", ["/r3/base"])
    entries = (field.root / "ledger.jsonl").read_text().splitlines()
    assert sum('"revocation"' in entry for entry in entries) == 1, "without /r2/base"


def test_a_rotation_waits_for_robots_that_are_offline(field: Field) -> None:
    field.run("rotate_ca", "ks", "--next")
    field.deliver(*ROBOTS)
    field.send("r1")
    field.age("r1", timedelta(hours=25))
    refused = field.run("rotate_ca", "ks", "--next", status=2).err
    assert "not every robot has confirmed the stage distribute: r1. " in refused
    field.send("r1", running={"/r1/base": RunningFiles.EARLIER})
    assert ": r1. " in field.run("rotate_ca", "ks", "--next", status=2).err
    field.send("r1", running={"/r1/base": RunningFiles.CURRENT})
    field.run("rotate_ca", "ks", "--next")


def test_a_revocation_list_is_in_force_after_the_restart(field: Field) -> None:
    def in_force() -> list[bool | None]:
        return [field.status()["robots"][robot]["crl_in_force"] for robot in ROBOTS]

    assert in_force() == [None, None, None], "nothing was revoked yet"
    field.run("revoke", "ks", "/dispatcher")
    assert in_force() == [False, False, False]
    said = field.run("fleet", "status", "ks", status=1).out
    assert (
        "\nthe revocation list is in force on 0 of 3 robots; no robot needs the list after " in said
    )
    field.deliver("r1", "r2")
    field.send("r2", running={"/r2/base": RunningFiles.EARLIER, "/r9/base": RunningFiles.EARLIER})
    assert in_force() == [False, False, False], "r1 does not say which processes it has"
    said = field.run("fleet", "status", "ks", status=1).out
    assert "on 0 of 3 robots; 2 of these 3 robots have the list, but perhaps not all" in said
    field.confirm("r1", restart=["/r1/removed"])
    assert in_force() == [False, False, False], "a process of an enclave that the robot had"
    assert field.states()["r1"] == "restart"
    field.confirm("r1", restart=[])
    assert in_force() == [True, False, False]
    said = field.run("fleet", "status", "ks", status=1).out
    assert "1 of 3 robots (not on r2, r3); 1 of the other 2 robots has the list, but" in said
    found = field.status()["robots"]["r2"]
    assert (found["state"], found["restart"]) == ("restart", ["/r2/base"])
    assert found["running"] == {"/r2/base": "earlier"}
    field.send("r2", running={"/r2/base": RunningFiles.NOT_SEEN})
    assert in_force() == [True, True, False]
    said = field.run("fleet", "status", "ks", status=1).out
    assert "\nthe revocation list is in force on 2 of 3 robots (not on r3); no robot" in said
    field.age("r2", timedelta(days=2))
    assert in_force() == [True, False, False]
    text = field.run("fleet", "status", "ks", "--prometheus", status=1).out
    assert [value for _, value in samples(text, "sros_fleet_revocation_list_in_force")] == [1, 0, 0]
    field.deliver("r3", restart=[])
    field.send("r2", running={"/r2/base": RunningFiles.CURRENT})
    said = field.run("fleet", "status", "ks").out
    assert (
        "\nthe revocation list is in force on all 3 robots; no robot needs the list after " in said
    )
    said = field.run("fleet", "status", "ks", "--robot", "r3").out
    assert "\nthe revocation list is in force on 1 robot; no robot needs the list after " in said
    rights = {f"/{{robot}}/{name}": publish("/{robot}/x") for name in ("base", "new")}
    (field.folder / "more.xml").write_text(policy_text(rights))
    field.run("generate_artifacts", "-k", "ks", "-p", "more.xml", "--fleet", "fleet.toml")
    assert in_force() == [True, True, True], "nothing runs in an enclave that a robot does not have"
    enclaves = field.folder / "r1" / ENCLAVES
    (copy_of(enclaves / "r1/base", enclaves / "x") / "crl.pem").write_text("of before")
    field.confirm("r1", restart=[])
    field.confirm("r2", restart=[], files={}, certificates={})
    assert in_force() == [False, False, True], "an enclave of another list, and no enclave"


def test_a_list_whose_ca_was_replaced_is_missed_until_nothing_trusts_the_ca(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robots with the files of before the rotation have no list, and let the revoked one in."""

    def said() -> tuple[str, list[float]]:
        ended = sros("fleet", "status", "ks", cwd=field.folder).out
        text = sros("fleet", "status", "ks", "--prometheus", cwd=field.folder).out
        values = [value for _, value in samples(text, "sros_fleet_revocation_list_in_force")]
        return next((line for line in ended.splitlines() if " replaced CA" in line), ""), values

    field.run("revoke", "ks", "--robot", "r3")
    field.run("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    text, values = said()
    assert text.startswith("r1, r2 may still trust a replaced CA, and accept its revoked cert")
    assert "); the present" in text and values == [0, 0]
    with monkeypatch.context() as patched:
        patched.setattr(_KeystoreRecords, "age_clause", "it was restored")
        status = fleet_status(OpenedKeystore(field.root))
        assert not status.trusting_replaced, "a later list may revoke of the new CA, too"
    field.deliver("r1", restart=[])
    field.send("r1", running={"/r1/base": RunningFiles.CURRENT})
    assert said()[0].startswith("r2 may still") and said()[1] == [1, 0]
    field.age("r1", timedelta(days=2))
    assert said()[0].startswith("r2 may still") and said()[1] == [0, 0], "r1 is only offline"
    field.deliver("r2", restart=[])
    assert said() == ("", []) and field.status()["revoked_until"] is None


def test_an_earlier_list_that_revokes_the_same_stays_in_force(field: Field) -> None:
    """Also if it was signed again twice, but not if something was revoked since, or it expired."""

    def in_force() -> list[bool | None]:
        return [field.status()["robots"][robot]["crl_in_force"] for robot in ROBOTS]

    field.run("crl", "ks", "--refresh")
    field.deliver("r3", restart=[])
    field.run("revoke", "ks", "/dispatcher")
    field.deliver("r1", restart=[])
    field.run("crl", "ks", "--refresh")
    field.deliver("r2", restart=[])
    assert in_force() == [True, True, False]
    field.run("crl", "ks", "--refresh")
    assert in_force() == [True, True, False]
    keystore = OpenedKeystore(field.root)
    later = datetime.now(UTC) + timedelta(days=4000)
    found = fleet_status(keystore).with_overdue(later)
    assert not any(robot.crl_in_force for robot in found.robots), "it has expired"
    copied = copy_of(field.root, field.folder / "copy")
    field.run("revoke", "ks", "/r3/base")
    assert in_force() == [False, False, None]
    (copied / "public/identity_ca.crl.pem").write_bytes(
        (field.root / "public/identity_ca.crl.pem").read_bytes()
    )
    copied_status = fleet_status(OpenedKeystore(copied))
    assert not copied_status.robots[0].crl_in_force, "its ledger does not know what is revoked"


def test_a_list_that_the_keystore_does_not_export_is_not_in_force(field: Field) -> None:
    field.run("revoke", "ks", "/dispatcher")
    (field.root / ENCLAVES / "r1/base/crl.pem").unlink()
    field.deliver("r1", "r2", restart=[])
    robots = field.status()["robots"]
    assert [robots[name]["crl_in_force"] for name in ("r1", "r2")] == [False, True]


def test_a_list_that_revokes_nobody_is_not_said_to_be_in_force(field: Field) -> None:
    field.run("crl", "ks", "--refresh")
    field.deliver(*ROBOTS, restart=[])
    field.run("renew", "ks", "/r1/base")
    said = field.run("fleet", "status", "ks", status=1).out
    assert "revocation list" not in said and "1 earlier" in said


def test_expiry_on_robots_is_that_of_the_files_that_they_have(field: Field) -> None:
    """Home renewed; the robot that was not reached still has what expires earlier."""

    def expiry() -> dict[str, dict[str, str]]:
        return {name: robot["expiry"] for name, robot in field.status()["robots"].items()}

    before = expiry()
    ledger = {entry.sha256: entry.not_after for entry in OpenedKeystore(field.root).ledger.entries}
    first = digest(read_certificate(field.folder / "r1/enclaves/r1/base/cert.pem"))
    assert before["r1"] == before["r2"] and before["r1"]["certificate"] == ledger[first]
    field.run("update_keystore", "ks", "--set", "certificates.validity=30d")
    field.run("renew", "ks", "--robot", "r1", "--robot", "r2")
    field.deliver("r2")
    after = expiry()
    assert after["r1"] == before["r1"] and after["r3"] == before["r3"]
    assert after["r2"]["certificate"] < before["r2"]["certificate"]
    assert after["r2"]["permissions"] <= after["r2"]["certificate"]
    text = field.run("fleet", "status", "ks", "--prometheus", status=1).out
    seconds = dict(samples(text, "sros_fleet_expiry_timestamp_seconds", "robot", "kind"))
    assert seconds["r2", "certificate"] == parse_iso(after["r2"]["certificate"]).timestamp()
    assert len(seconds) == 6


def test_robots_with_files_that_expire_soon_are_named(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    status = fleet_status(OpenedKeystore(field.root))
    kind, end = min(status.robots[0].expiry.items(), key=lambda item: item[1])
    lines = {
        days: [*_fleet_facts(ComparedFleet(end - timedelta(days=days), status, [], []))]
        for days in (31, 24)
    }
    assert not any("expiry" in line for line in lines[31])
    (line,) = (line for line in lines[24] if "expiry" in line)
    assert f"{end:%Y-%m-%d} (r1, {kind}); 3 robots have files that expire within 30 days: " in line
    assert line.endswith("--all-expiring soon`, then deliver")

    def command(status: FleetStatus) -> str:
        lines = _fleet_facts(ComparedFleet(end - timedelta(days=1), status, [], []))
        return next(line.partition("within 30 days: ")[2] for line in lines if "expiry" in line)

    robots = [replace(robot, files={}, has_release=True) for robot in status.robots]
    assert "new files are published; " in command(replace(status, robots=tuple(robots)))
    monkeypatch.setattr(
        Template, "longest_validity", lambda _, name: timedelta(1) if name != "/r2/base" else None
    )
    named = "`sros renew ks /r1/base /r3/base --all-expiring soon`, then deliver"
    assert command(fleet_status(OpenedKeystore(field.root))).replace(str(field.root), "ks") == named
    monkeypatch.setattr("sros_tool.keystore.fleet.publish_command", lambda _: "publish")
    for fetching, bring in (
        (0, "deliver"),
        (2, "publish, and deliver to the robots that do not fetch"),
        (3, "publish"),
    ):
        robots = [
            replace(robot, fetches=place < fetching, to_do="renew")
            for place, robot in enumerate(status.robots)
        ]
        given = replace(status, robots=tuple(robots))
        assert command(given).endswith(f"soon`, then {bring}")
        assert _remedies(given, {"renew"})["renew"].endswith(f"soon`, then {bring}")


def test_a_robot_whose_files_have_expired_is_not_in_order(field: Field) -> None:
    """Whether or not the keystore has renewed them."""
    status = fleet_status(OpenedKeystore(field.root))
    kind, end = min(status.robots[0].expiry.items(), key=lambda item: item[1])
    before = status.with_overdue(end - timedelta(seconds=1))
    assert before.complete and before.counts == {State.CURRENT: 3}
    late = end + timedelta(minutes=17)
    expired = status.with_overdue(late)
    assert not expired.complete and expired.counts == {State.EXPIRED: 3}
    assert {robot.to_do for robot in expired.robots} == {"renew"}
    lines = [*_lines(ComparedFleet(late, expired, [], []), (), apart=False, findings=False)]
    assert lines[0] == "3 robots: 3 expired"
    since = rf"first file that expired on a robot: {end:%Y-%m-%d}[^ ]* \(r1, {kind}\)"
    assert re.match(
        f"{since}; files of 2 more robots have expired or expire within 30 days: ", lines[1]
    )
    assert f"{kind} expired 17 min ago" in lines[-1]
    field.run("renew", "ks", "--robot", "r1")
    renewed = fleet_status(OpenedKeystore(field.root), ["r1"]).with_overdue(late)
    assert [(robot.state, robot.to_do) for robot in renewed.robots] == [("expired", "deliver")]


def test_a_robot_whose_certificates_have_all_expired_cannot_fetch(field: Field) -> None:
    """Neither a robot whose other files have expired, nor a robot that does not fetch."""
    field.run("fleet", "publish", "ks", "pub")
    field.send("r1", release=1)
    before = fleet_status(OpenedKeystore(field.root), ["r1", "r2"])
    end = before.robots[0].expiry["certificate"]
    assert [robot.locked_out_from for robot in before.robots] == [end, None]
    field.run("renew", "ks", "/r1/base")
    field.run("fleet", "publish", "ks", "pub")
    status = fleet_status(OpenedKeystore(field.root), ["r1"])
    late = end + timedelta(minutes=1)
    heard = replace(status.robots[0], received=late, clock=late)
    assert heard.locked_out_from == end
    for until, to_do in ((end, "wait, else deliver"), (late + timedelta(1), "wait: it fetches")):
        robot = replace(heard, locked_out_from=until)
        (found,) = replace(status, robots=(robot,), publication=None).with_overdue(late).robots
        assert (found.state, found.to_do) == ("expired", to_do)


def test_a_robot_fetches_with_any_of_its_certificates(field: Field) -> None:
    """Also with one of an enclave that it should not have; one that nobody issued may be valid."""
    path, surplus = f"{ENCLAVES}/r1/base/cert.pem", f"{ENCLAVES}/r1/old/cert.pem"
    last = validity_of(read_certificate(field.root / path)).not_after
    earlier = field.report("r1")["certificates"][path]
    field.run("update_keystore", "ks", "--set", "certificates.validity=90d")
    field.run("renew", "ks", "/r1/base")
    field.deliver("r1")
    said = field.report("r1")
    for other, locked_out_from in ((earlier, last), ([64 * "0"], None)):
        field.send(
            "r1",
            files={**said["files"], surplus: 64 * "1"},
            certificates={**said["certificates"], surplus: other},
        )
        (robot,) = fleet_status(OpenedKeystore(field.root), ["r1"]).robots
        assert robot.locked_out_from == locked_out_from


def samples(text: str, metric: str, *labels: str) -> list[tuple[tuple[str, ...], float]]:
    """Return the values of a metric, with some of their labels."""
    return [
        (tuple(sample.labels[label] for label in labels), sample.value)
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.name == metric
    ]


@pytest.mark.parametrize(
    ("hours", "text"), [(2, "r1: its clock is 2 h ahead"), (-49, "r1: its clock is 2 d 1 h behind")]
)
def test_a_clock_that_is_wrong(field: Field, hours: int, text: str) -> None:
    said = json.loads(field.run("fleet", "report", "r1", "--robot", "r1").out)
    moment = parse_iso(said["time"])
    assert field.confirm("r1", time=iso(moment + timedelta(seconds=20))).err == ""
    # A second may pass between the report and its receipt.
    wrong = moment + timedelta(hours=hours, seconds=30 if hours > 0 else 0)
    (field.root / "confirmed/r1.json").unlink()
    assert text in field.confirm("r1", time=iso(wrong)).err
    found = field.status()["robots"]["r1"]
    assert found["state"] == "current"
    assert text.removeprefix("r1: ") in found["notes"][0]
    received: datetime = parse_iso(found["received"])
    assert abs(received - moment) < timedelta(hours=1)
    assert "\nr1     current" in field.run("fleet", "status", "ks").out
    limited = field.run("fleet", "status", "ks", "--max-age", "1h", status=1).out
    age = r"\d s" if hours > 0 else "2 d 1 h"
    assert re.search(rf"\nr1 +offline +{age} ago +check its clock +its clock is 2 ", limited)


def test_a_hostile_confirmation_is_refused_and_changes_nothing(field: Field) -> None:
    kept = field.root / "confirmed/r1.json"
    before = kept.read_bytes()
    other = field.run("fleet", "report", "r2", "--robot", "r2").out.encode()
    file = field.folder / "said.json"
    options: tuple[tuple[str, ...], ...] = ((), ("--json",), ("--dry-run",))
    for number, (name, data) in enumerate([*hostile(), ("of another robot", other)]):
        file.write_bytes(data)
        words = ("ks", file, "--robot", "r1", *options[number % 3])
        ended = sros("fleet", "confirm", *words, cwd=field.folder)
        assert (ended.status, ended.out) == (2, ""), name
        assert ended.err.isascii() and ended.err.strip().isprintable(), name
        assert kept.read_bytes() == before, name
    for robot in ("../r1", "r9", "\x1b[2J"):
        ended = sros("fleet", "confirm", "ks", file, "--robot", robot, cwd=field.folder)
        assert ended.status == 2 and ended.err.strip().isprintable()
    assert sorted(each.name for each in kept.parent.iterdir()) == ["r1.json", "r2.json", "r3.json"]


def test_a_kept_confirmation_that_was_damaged_counts_as_none(field: Field) -> None:
    for text in ("{", "[]", '{"received": "\x1b", "confirmation": {}}', "\x1b[2J" * 100):
        (field.root / "confirmed/r1.json").write_text(text)
        found = field.status()["robots"]["r1"]
        assert found["state"] == "never" and "cannot be used" in found["notes"][0]
        assert "\x1b" not in field.run("fleet", "status", "ks", status=1).out
    (field.root / "confirmed/r1.json").write_bytes((field.root / "confirmed/r2.json").read_bytes())
    assert field.states()["r1"] == "never"
    (field.root / "confirmed").rename(field.folder / "elsewhere")
    (field.root / "confirmed").symlink_to(field.folder / "elsewhere")
    (field.folder / "said.json").write_text(field.run("fleet", "report", "r1", "--robot", "r1").out)
    refused = field.run("fleet", "confirm", "ks", "said.json", "--robot", "r1", status=2)
    assert "is a symbolic link" in refused.err


def test_fifty_robots_of_which_the_same_is_to_be_said_share_a_line(field: Field) -> None:
    (field.folder / "fleet.toml").write_text("".join(f"[robots.r{n}]\n" for n in range(1, 51)))
    field.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    field.run("renew", "ks", "--robot", "r1")
    field.deliver("r20")
    lines = field.run("fleet", "status", "ks", status=1).out.splitlines()
    assert lines[0] == "50 robots: 3 current, 1 earlier, 46 never confirmed"
    assert lines[4].endswith("  each: 1 enclave")
    assert [re.split("  +", line)[:4] for line in lines[3:6]] == [
        ["r1", "earlier", re.split("  +", lines[3])[2], "deliver"],
        ["r4 to r19, r21 to r50 (46 robots)", "never confirmed", "-", "deliver"],
        ["r2, r3, r20", "current", re.split("  +", lines[5])[2]],
    ]
    found = field.status()["robots"]
    assert len(found) == 50 and found["r50"]["state"] == "never"


def test_robots_are_named_by_group_and_by_neighbors_of_one_name() -> None:
    pickers = [f"p{number}" for number in range(1, 41)]
    everybody, groups = ["dispatcher", *pickers], {"pickers": pickers, "none": []}
    assert _robot_names(pickers, everybody, groups) == "pickers (all 40)"
    assert _robot_names(everybody, everybody, groups) == "pickers (all 40), dispatcher (41 robots)"
    some = _robot_names(everybody[:6], everybody, groups)
    assert some == "dispatcher, p1 to p5 (6 robots)"
    left = [name for name in pickers[:12] if name != "p5"]
    assert _robot_names(left, left) == "p1 to p4, p6 to p12 (11 robots)"


def test_texts_that_differ_in_durations_are_one() -> None:
    texts = {"p1": "it is 3 min 28 s late at {robot}", "p2": "it is 59 s late at {robot}"}
    assert _joined_durations(texts) == "it is 59 s to 3 min 28 s late at {robot}"
    assert _joined_durations({"p1": texts["p1"]}) == "it is 3 min 28 s late at p1"
    assert _joined_durations(dict.fromkeys(texts, texts["p2"])) == "it is 59 s late at {robot}"


def test_robots_that_differ_in_their_names_share_a_line(field: Field) -> None:
    field.deliver(*ROBOTS)
    for robot in ("r1", "r2"):
        field.send(robot, running={f"/{robot}/base": RunningFiles.EARLIER})
    *rows, command = field.run("fleet", "status", "ks", status=1).out.splitlines()[3:]
    assert command.startswith("restart: ") and "`sros agent run FOLDER --once` there" in command
    columns = [re.split("  +", row) for row in rows]
    text = "processes of /{robot}/base have not loaded the installed files"
    assert [row[:2] + row[3:] for row in columns] == [
        ["r1, r2", "restart due", "restart", text],
        ["r3", "current"],
    ]
    field.send("r2", running={"/r2/base": RunningFiles.CURRENT})
    assert text.format(robot="r1") in field.run("fleet", "status", "ks", status=1).out
    field.send("r1", restart=["/r1/base"], waiting=["/r1/base", "/r1/other"])
    said = field.run("fleet", "status", "ks", status=1).out
    assert "; its agent restarts /r1/base once the command of --restart-if exits with 0" in said
    assert field.status()["robots"]["r1"]["waiting"] == ["/r1/base"]


def test_what_is_to_be_done_for_robots_that_do_not_fetch_what_is_published(field: Field) -> None:
    """They may be off; a release has no key, a server may refuse them, and a copy may be old."""

    def said() -> dict[str, tuple[str, str]]:
        rows = field.run("fleet", "status", "ks", status=1).out.splitlines()[3:]
        columns = (re.split("  +", row) for row in rows if row.startswith("r"))
        return {row[0]: (row[3], row[4]) for row in columns if row[0] in ROBOTS}

    field.run("fleet", "publish", "ks", "pub")
    for robot in ROBOTS:
        field.send(robot, release=0)
    bring = "`sros distribute_key ks --robot NAME FOLDER --force`"
    assert bring in field.run("renew", "ks", "/r1/base", "--new-key").err
    field.run("renew", "ks", "/r2/base")
    err = field.run("renew", "ks", "/r3/base", "--revoke-old").err
    assert "Only then give the revocation list to the web server" in err and bring not in err
    field.run("fleet", "publish", "ks", "pub")
    rows = said()
    assert rows["r1"][0] == "deliver" and "lacks the key of /r1/base: releases" in rows["r1"][1]
    assert "is published" not in rows["r1"][1], "no other enclave waits for it"
    refused = "a web server that checks certificates refuses the robot"
    waits = "1 revoked certificate: the new one waits for the robot"
    assert rows["r3"][0] == "wait, else deliver"
    assert rows["r3"][1].startswith(f"{waits}; {refused}; ")
    for refused_now, to_do in (
        ({"r3": LOW_SEQUENCE}, "find out why"),
        ({"r3": "it is damaged"}, "wait, else deliver"),
        ({}, "wait, else deliver"),
    ):
        keystore = OpenedKeystore(field.root)
        store_refusals(keystore, refusals(keystore), refused_now, now=datetime.now(UTC))
        assert said()["r3"][0] == to_do
    assert rows["r2"][0] == "wait: it fetches"
    kept = field.root / "confirmed/r2.json"
    value = json.loads(kept.read_text())
    value["confirmation"]["problems"] = ["Make room on the disk."]
    kept.write_text(json.dumps(value))
    assert said()["r2"][0] == "look into it"
    for robot in ("r2", "r3"):
        field.age(robot, timedelta(minutes=31))
    silent = said()["r2"]
    assert silent[0] == "check whether it is on" and silent[1].startswith("it reports: Make room")
    field.age("r2", timedelta(days=1))
    assert said()["r2"] == ("find out why", silent[1].replace("31 min", "1 d")), "offline"
    field.age("r2", timedelta(days=-1))
    value = json.loads(kept.read_text())
    value["confirmation"]["problems"] = []
    kept.write_text(json.dumps(value))
    page = field.run("fleet", "status", "ks", "--html", status=1).out
    assert page.count(">check whether it is on</td>") == 1
    field.age("r2", timedelta(minutes=-62))
    field.send("r1", files={}, certificates={})
    kept = field.root / "confirmed/r2.json"
    value = json.loads(kept.read_text())
    kept.write_text(
        json.dumps({**value, "confirmation": {**value["confirmation"], "time": value["received"]}})
    )
    rows = said()
    assert rows["r1"][0] == "deliver" and "lacks the key" in rows["r1"][1], "it has no file"
    assert rows["r2"][0] == "check its server" and "its agent has an old copy." in rows["r2"][1]
    assert rows["r3"][0] == "deliver"
    metrics = field.run("fleet", "status", "ks", "--prometheus", status=1).out
    assert re.search(r'agent_problems\{.*robot="r2"\} 1', metrics)
    gone = "/r2/base does not get the files of the release: the key of enclave /r2/base is not on "
    gone += "this robot."
    field.send("r2", release=0, problems=(gone,))
    assert said()["r2"][0] == "deliver"


def test_a_robot_that_says_it_has_a_release_that_was_never_published(field: Field) -> None:
    """Its files are right, which it can say as well."""
    field.send("r2", release=1)
    assert field.states()["r2"] == "later", "nothing was published"
    field.run("revoke", "ks", "/dispatcher")
    field.run("fleet", "publish", "ks", "pub")
    field.deliver(*ROBOTS)
    number = field.status()["robots"]["r2"]["published"]
    for robot, claimed in (("r1", number), ("r2", number + 1), ("r3", number)):
        field.send(robot, release=claimed, restart=())
    found = field.status()["robots"]
    assert [found[name]["state"] for name in ROBOTS] == ["current", "later", "current"]
    assert [found[name]["crl_in_force"] for name in ROBOTS] == [True, False, True]
    rows = field.run("fleet", "status", "ks", status=1).out
    assert "3 robots: 2 current, 1 claims a later release" in rows
    assert re.search(r"\nr2 +claims a later release +.* ago +find out why +reports release ", rows)
    field.age("r2", timedelta(days=2))
    assert field.states()["r2"] == "later"
    (field.root / "published.json").unlink()
    assert field.states() == {"r1": "current", "r2": "later", "r3": "current"}
    field.run("rotate_ca", "ks", "--next")
    field.deliver(*ROBOTS)
    field.send("r2", release=number + 1)
    assert ": r2. " in field.run("rotate_ca", "ks", "--next", status=2).err
    field.send("r2", release=number)
    field.run("rotate_ca", "ks", "--next")


def test_a_robot_whose_last_message_was_refused_is_not_current(field: Field) -> None:
    field.run("rotate_ca", "ks", "--next")
    field.deliver(*ROBOTS)
    field.send("r1")
    assert field.states()["r1"] == "current"
    file = field.folder / "inbox/r1" / MESSAGE_FILE
    good = file.read_bytes()
    file.write_bytes(good[:-1000])
    field.run("fleet", "collect", "ks", "inbox", status=1)
    found = field.status()["robots"]["r1"]
    assert (
        found["state"] == "refused"
        and "its last message has been refused since" in found["notes"][0]
    )
    file.unlink()
    field.run("fleet", "collect", "ks", "inbox")
    rows = field.run("fleet", "status", "ks", status=1).out
    assert re.search(r"\nr1 +message refused +.* ago +find out why +its last message", rows), rows
    assert ": r1. " in field.run("rotate_ca", "ks", "--next", status=2).err
    kept = field.root / REFUSED
    kept.write_bytes(kept.read_bytes()[:-3])
    for verb in (("fleet", "status", "ks"), ("fleet", "collect", "ks", "inbox")):
        assert f"'ks/{REFUSED}' is damaged. " in field.run(*verb, status=2).err
    kept.unlink()
    field.send("r1")
    assert field.states()["r1"] == "current"
    field.run("rotate_ca", "ks", "--next")
    assert "[keystore." not in sros("check", "ks", cwd=field.folder).out


def test_a_refused_message_counts_also_in_a_worse_state(field: Field) -> None:
    field.run("rotate_ca", "ks", "--next")
    field.deliver(*ROBOTS)
    permissions = field.folder / "r1/enclaves/r1/base/permissions.p7s"
    permissions.write_bytes(permissions.read_bytes() + b"\n")
    field.send("r1")
    assert field.states()["r1"] == "unknown"
    field.run("rotate_ca", "ks", "--next", "--dry-run")
    file = field.folder / "inbox/r1" / MESSAGE_FILE
    file.write_bytes(file.read_bytes()[:-1000])
    field.run("fleet", "collect", "ks", "inbox", status=1)
    assert field.states()["r1"] == "unknown"
    assert ": r1. " in field.run("rotate_ca", "ks", "--next", "--dry-run", status=2).err


def test_home_is_older_than_its_robots(field: Field) -> None:
    """By what a robot has, and by what is published next to the keystore."""

    def in_force() -> set[bool]:
        return {robot["crl_in_force"] for robot in field.status()["robots"].values()}

    field.run("crl", "ks", "--refresh")
    field.deliver(*ROBOTS, restart=[])
    field.run("fleet", "publish", "ks", "pub")
    assert in_force() == {True}
    backup = copy_of(field.root, field.folder / "backup")
    assert "may lack" not in field.run("renew", "ks", "--all").err
    field.deliver(*ROBOTS)
    field.run("fleet", "publish", "ks", "pub")
    assert field.status()["older"] is None
    kept = field.folder / "kept"
    for away in (False, True):
        shutil.rmtree(field.root)
        copy_of(backup, field.root)
        if away:
            (field.folder / "pub").rename(kept)
            assert (
                "\nthe keystore is older" not in sros("fleet", "status", "ks", cwd=field.folder).out
            )
            assert field.send("r1").status == 1
        rows = field.run("fleet", "status", "ks", status=1).out
        why = "robots have files that it signed" if away else "'.*/pub' has later releases"
        assert (
            " (compared with a keystore that is older than its robots)\n"
            in rows[: rows.index("\n") + 1]
        )
        command = rf"`sros fleet publish ks {field.folder}/pub --restored`"
        assert re.search(rf"the keystore is older than its robots: {why}.*{command}", rows), rows
        assert not field.status()["complete"] and in_force() == {False}
        assert "ledger may lack cert" in field.run("renew", "ks", "--all", "--dry-run").err
    kept.rename(field.folder / "pub")
    field.run("fleet", "publish", "ks", "pub", "--restored")
    assert field.status()["older"] is None
    (field.folder / "less.xml").write_text(POLICY.replace("/y", "/z"))
    less = ("generate_artifacts", "-k", "ks", "-p", "less.xml", "--fleet", "fleet.toml")
    assert "/dispatcher: the rights that it lost still work at least until" in field.run(*less).err
    timestamp = field.folder / "pub/metadata/timestamp.json"
    for damaged in (b'{"signed": {"version": 9999999999}}', b"[]", b"x", b"{" * 9999):
        timestamp.write_bytes(damaged)
        assert field.status()["older"] is None, "anybody can write this"


def test_a_robot_with_other_files_than_the_release_that_it_has(field: Field) -> None:
    """It cannot wait for what is published already."""
    field.run("fleet", "publish", "ks", "pub")
    number = field.status()["robots"]["r1"]["published"]
    field.run("renew", "ks", "/r1/base")
    field.send("r1", release=number)
    assert "not published yet" in field.run("fleet", "status", "ks", status=1).out
    field.run("fleet", "publish", "ks", "pub")
    number = field.status()["robots"]["r1"]["published"]
    field.send("r1", release=number)
    rows = field.run("fleet", "status", "ks", status=1).out
    assert f"its files differ from the published release {number}" in rows
    assert field.status()["robots"]["r1"]["to_do"] == "find out why"


MAPS_A_LIBRARY = """
import mmap, sys
with open(sys.argv[1], "rb") as file:
    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
print("mapped", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def only_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Yield the library that the only process has loaded that sros and the module can see.

    The processes of other tests come and go between two looks.
    """
    library = tmp_path / "libfastrtps.so.2.14.5"
    library.write_bytes(b"library")
    words = [sys.executable, "-IS", "-c", MAPS_A_LIBRARY, str(library)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout and process.stdout.readline() == b"mapped\n"
        listed = os.listdir

        def only_this(folder: Any = ".") -> list[str]:
            return [str(process.pid)] if str(folder) == "/proc" else listed(folder)

        monkeypatch.setattr(os, "listdir", only_this)
        yield str(library)


def test_the_module_on_the_robot_confirms_the_same(field: Field, only_process: str) -> None:
    parts = "ansible_collections/sros/fleet/plugins/module_utils/exports.py"
    spec = importlib.util.spec_from_file_location("exports", Path(__file__).parents[2] / parts)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    robot = field.folder / "r1"
    files = {
        str(path.relative_to(robot)): path.read_bytes()
        for path in robot.rglob("*")
        if path.is_file()
    }
    said = json.loads(field.run("fleet", "report", "r1", "--robot", "r1").out)
    assert said.pop("problems") == [], "the module does not look for them"
    made = module.confirmation("r1", files, parse_iso(said["time"]).timestamp(), [], [])
    assert parse_confirmation(json.dumps(made).encode(), "it").dds
    assert made.pop("restart") == made.pop("crl_restart") == [], (
        "sros does not know which processes were restarted"
    )
    assert {**made, "dds": 0} == {**said, "dds": 0}
    for dds in (made["dds"], said["dds"]):
        loaded = [each for each in dds["libraries"] if each["seen"] == "process"]
        assert [(each["product"], each["version"], each["path"]) for each in loaded] == [
            ("Fast DDS", "2.14.5", only_process)
        ]
    (robot / ".agent").mkdir()
    for boot, due in ((boot_id(), ["/r1/base"]), ("of an earlier start", None)):
        write_state(robot, AgentState(due=("/r1/base",), boot=boot))
        said = json.loads(field.run("fleet", "report", "r1", "--robot", "r1").out)
        assert said.get("restart") == due
        assert "crl_restart" not in said, "nobody looked whether they have the list that is here"
        words = ("fleet", "report", "r1", "--robot", "r1", "--restarted")
        said = json.loads(field.run(*words).out)
        assert (said["restart"], said["crl_restart"]) == ([], []), "also those that an agent noted"
    write_state(robot, AgentState(due=("/r1/base",), boot=boot_id()))
    now = {"/r1/base": RunningFiles.CURRENT}
    said = field.report("r1", complete=True, states=now, list_states=now)
    assert (said["restart"], said.get("crl_restart")) == (["/r1/base"], None), "files may differ"


OLD = {**LIBRARY, "product": "Fast DDS", "version": "2.14.5", "path": "/a/libfastrtps.so.2.14.5"}
MENDED = {**OLD, "version": "2.14.6"}
NOT_SEEN = "runtime.robots-dds-unknown"
FOUND = frozenset({NOT_SEEN})


@pytest.mark.parametrize(
    ("library", "unseen", "outdated", "text"),
    [
        (OLD, 0, ["r1"], "2.x; loaded by processes of r1; in '/a/lib"),
        ({**OLD, "seen": "installed"}, 0, ["r1"], "installed, but not loaded, on r1; in '/a/"),
        (MENDED, 0, [], "17 known vulnerabilities"),
        ({**OLD, "path": "/usr/lib/libfastrtps.so.2.14.5"}, 0, [], "27 known vulnerabilities"),
        ({**OLD, "version": ""}, 0, [], "does not show the version, loaded by processes of r1"),
        (None, 0, [], "none seen on r1"),
        (LIBRARY, 7, [], "some processes of r1 could not be examined"),
    ],
)
def test_the_dds_of_a_robot(
    field: Field, library: dict[str, str] | None, unseen: int, outdated: list[str], text: str
) -> None:
    assert "DDS" not in field.run("fleet", "status", "ks").out
    libraries = [library] if library else []
    field.confirm("r1", dds={"libraries": libraries, "unseen": unseen})
    first, *_, last = field.run("fleet", "status", "ks").out.splitlines()
    assert first == "3 robots: 3 current"
    if outdated:  # advice: the files are delivered, and nobody can upgrade all robots at once
        assert last.startswith("a later release fixes known vulnerabilities in the DDS of r1; ")
    else:
        assert "on the DDS of robots: 1 " in last
    chosen = ("fleet", "status", "ks", "--fail-on", "vulnerabilities")
    field.run(*chosen, status=1 if outdated else 0)
    assert "exclude each other" in field.run(*chosen, "--no-advisories", status=2).err
    of_robot = ("--robot", "r1")
    assert text in field.run(*chosen, *of_robot, status=1 if outdated else 0).out
    assert field.run("fleet", "status", "ks", *of_robot).out.splitlines()[-1] == last, "the sum"
    assert "DDS" not in field.run("fleet", "status", "ks", "--no-advisories").out
    found = json.loads(field.run("fleet", "status", "ks", "--json").out)
    assert (found["complete"], found["outdated_dds"]) == (True, outdated)
    assert text in " ".join(finding["text"] for finding in found["findings"])
    assert found["robots"][0]["dds"] == {"libraries": libraries, "unseen": unseen}
    numbers = field.run("fleet", "status", "ks", "--prometheus").out
    known = re.findall(r'vulnerabilities\{.*robot="r1".*seen="(\w+)"\} (\d+)', numbers)
    unknown = re.findall(r'dds_unknown\{.*robot="r1"\} (\d+)', numbers)
    is_known = bool(library and library["version"])
    assert (bool(known), unknown) == (is_known, ["0" if is_known else "1"])


def test_a_robot_decides_about_no_number_of_series(field: Field) -> None:
    """Or each of its messages fills the database of Prometheus with series of its own."""
    versions = ["2.14.5", *(f"2.{minor}.0" for minor in range(40, 99))]
    libraries = [{**OLD, "version": version, "path": f"/{version}"} for version in versions]
    field.confirm("r1", dds={"libraries": libraries, "unseen": 0})
    numbers = field.run("fleet", "status", "ks", "--prometheus").out
    series = re.findall(r'vulnerabilities\{.*robot="r1",(.*)', numbers)
    assert series == ['product="Fast DDS",seen="process"} 27']


def test_an_earlier_confirmation_does_not_name_the_dds(field: Field) -> None:
    kept = field.root / "confirmed/r1.json"
    value = json.loads(kept.read_text())
    del value["confirmation"]["dds"]
    kept.write_text(json.dumps(value))
    assert (
        "findings on the DDS of robots: 1 note; `sros fleet status"
        in field.run("fleet", "status", "ks").out
    )
    ended = field.run("fleet", "status", "ks", "--robot", "r1", "--fail-on", "vulnerabilities")
    assert f"[{NOT_SEEN}]" in ended.out and "not reported by r1" in ended.out


def test_newer_advisories_judge_what_robots_reported(field: Field, tmp_path: Path) -> None:
    package = {"name": "github.com/eclipse-cyclonedds/cyclonedds"}
    events = [{"introduced": "0"}, {"fixed": "11.0.2"}]
    affected = {"package": package, "ranges": [{"type": "SEMVER", "events": events}]}
    listed = {"package": package, "versions": ["11.0.1", "11.0", "v12.0.0-rc1"]}
    path = tmp_path / "newer.json"
    path.write_text(json.dumps({"id": "CVE-2030-12345", "affected": [affected, listed]}))
    field.run("fleet", "status", "ks")
    ended = field.run("fleet", "status", "ks", "--advisories", path)
    assert "1 known vulnerability (" in ended.out and "r1, r2, r3; in '" in ended.out
    assert "CVE-2030-12345" in ended.out
    assert "that do not consist of" in ended.err and "11.0, v12.0.0-rc1" in ended.err


def test_the_alerts_of_the_page_name_metrics_that_are_written(field: Field) -> None:
    page = (Path(__file__).parents[2] / "docs/fleet.md").read_text()
    (rules,) = re.findall(r"```yaml\n(groups:.*?)```", page, re.DOTALL)
    alerts = [rule["expr"] for rule in yaml.safe_load(rules)["groups"][0]["rules"]]
    named = {name for alert in alerts for name in re.findall(r"sros_\w+", alert)}
    metrics = fleet_metrics(fleet_status(OpenedKeystore(field.root)), now=datetime.now(UTC))
    assert len(named) == len(alerts) == 12 and named <= {metric.name for metric in metrics}


def test_metrics_and_the_page(field: Field) -> None:
    renamed = field.root.rename(field.folder / "<b>ks")
    field.run("renew", renamed, "/r1/base")
    text = field.run("fleet", "status", renamed, "--prometheus", status=1).out
    samples = {
        (each.name, each.labels.get("robot", ""), each.labels.get("state", "")): each.value
        for family in text_string_to_metric_families(text)
        for each in family.samples
    }
    assert samples["sros_fleet_robots", "", "current"] == 2
    assert samples["sros_fleet_robot_state", "r1", "earlier"] == 1
    assert samples["sros_fleet_clock_ahead_seconds", "r2", ""] < 60
    field.run("fleet", "status", renamed, "--prometheus", "-o", "x.prom", "--dry-run", status=1)
    assert not (field.folder / "x.prom").exists()
    field.run("fleet", "status", renamed, "--prometheus", "-o", "x.prom", status=1)
    assert "sros_fleet_robots" in (field.folder / "x.prom").read_text()
    page = field.run("fleet", "status", renamed, "--html", status=1).out
    assert (
        '>earlier certificate, permissions of <span class="id">2' in page
        and "&lt;b&gt;ks" in page
        and "<b>ks" not in page
    )
    renamed = renamed.rename(field.root)
    field.confirm("r1", dds={"libraries": [OLD], "unseen": 0})
    page = field.run("fleet", "status", renamed, "--html", status=1).out
    number = "Fast DDS 2.14.5: 27 known vulnerabilities (15 affect all processes; "
    summary = page.partition(f"<summary>{number}")[2].partition("</summary>")[0]
    fixed = "10 fixed in 2.14.6, 17 not fixed in any known release 2.x"
    assert summary.endswith(f"), {fixed}; loaded by processes of r1")
    for words in ("--json --html", "--json -o x.json", "--prometheus -o x.txt"):
        field.run("fleet", "status", renamed, *words.split(), status=2)
