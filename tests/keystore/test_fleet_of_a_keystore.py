"""The fleet that a keystore records decides who gets which keys, so nobody else can change it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from sros_tool.cli.common import now
from sros_tool.fleet import robots
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.keystore.fleet import left_enclaves, lost_enclaves, recorded_fleet
from sros_tool.keystore.layout import list_enclaves
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.validity import iso
from tests.support.harness import Ended, copy_of, policy_text, publish, snapshot, sros

FLEET = "[robots]\na = {}\na_arm = {}\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    sros("create_keystore", folder / "ks").ok()
    generate(folder, "/{robot}").ok()
    return folder


def generate(folder: Path, path: str) -> Ended:
    (folder / "fleet.toml").write_text(FLEET)
    (folder / "policy.xml").write_text(policy_text({path: publish("x")}))
    words = ("-p", folder / "policy.xml", "--fleet", folder / "fleet.toml")
    return sros("generate_artifacts", "-k", folder / "ks", *words)


def forge_line(root: Path, **values: str) -> None:
    """Add a line to the ledger that fits into the chain, but that no head signs."""
    ledger = root / "ledger.jsonl"
    lines = ledger.read_bytes().splitlines()
    values = {"time": iso(now()), **values, "previous": sha256(lines[-1]).hexdigest()}
    line = json.dumps(values, separators=(",", ":")).encode()
    ledger.write_bytes(b"\n".join([*lines, line]) + b"\n")


def test_a_forged_record_does_not_hide_an_edit(made: Path, tmp_path: Path) -> None:
    """A line that fits into the chain, but that no head signs, says nothing of the fleet."""
    root = tmp_path / "ks"
    copy_of(made / "ks", root)
    sros("distribute_key", root, "--robot", "a", tmp_path / "before").ok()
    file = root / "fleet.toml"
    file.write_text(file.read_text().replace('"/{robot}"', '"/{robot}", "/{robot}_arm"'))
    forge_line(root, what="fleet", sha256=sha256(file.read_bytes()).hexdigest())
    ended = sros("distribute_key", root, "--robot", "a", tmp_path / "out")
    assert (ended.status, "is perhaps not the file that sros wrote" in ended.err) == (2, True), (
        ended
    )
    assert not (tmp_path / "out").exists()
    file.unlink()
    ended = sros("distribute_key", root, "--robot", "a", tmp_path / "out")
    assert (ended.status, "is missing" in ended.err) == (2, True), ended


def test_the_folder_of_a_robot_gets_no_enclave_of_another_one(made: Path, tmp_path: Path) -> None:
    (tmp_path / ".agent").mkdir()
    (tmp_path / ".agent/agent.toml").write_text('robot = "a"\n')
    refused = sros("distribute_key", made / "ks", "--robot", "a_arm", tmp_path, "--force")
    assert "is the folder of robot a, and /a_arm belongs to a_arm" in refused.err
    sros("distribute_key", made / "ks", "--robot", "a", tmp_path, "--force").ok()


def test_enclaves_of_another_robot_in_the_folder_are_named(tmp_path: Path) -> None:
    """They stay, and the command that removes them removes no enclave below them."""
    root, folder = tmp_path / "ks", tmp_path / "robot"
    sros("create_keystore", root).ok()
    (tmp_path / "fleet.toml").write_text(
        '[robots]\nhall = {namespace="/hall"}\ncart = {namespace="/hall/cart"}\n'
    )
    (tmp_path / "policy.xml").write_text(policy_text({"{namespace}": publish("x")}))
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", root, *words).ok()
    alone = sros("distribute_key", root, "--robot", "hall", folder)
    assert "another-robot" not in alone.ok().err
    before = snapshot(folder / "enclaves/hall")
    for _ in range(2):
        said = sros("distribute_key", root, "--robot", "cart", folder, "--force").ok().err
        assert f"[export.of-another-robot]: '{folder}' also has /hall of robot hall" in said
        assert before.items() <= snapshot(folder / "enclaves/hall").items()
    command = re.search("`(rm .*?)`", said)
    assert command
    subprocess.run(command[1], shell=True, check=True)
    assert list_enclaves(folder) == ("/hall/cart",)
    said = sros("distribute_key", root, "--robot", "cart", folder, "--force").ok().err
    assert "another-robot" not in said


def test_no_enclave_belongs_to_two_robots(made: Path) -> None:
    """Paths of two policies can give one enclave to two robots; one would get the other's key."""
    before = snapshot(made / "ks")
    ended = generate(made, "/{robot}_arm")
    assert (ended.status, "/a_arm would belong to two robots" in ended.err) == (2, True), ended
    assert snapshot(made / "ks") == before


def test_paths_of_earlier_policies_count(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is written can be read again."""
    monkeypatch.setattr(robots, "MAX_PATTERNS", 1)
    before = snapshot(made / "ks")
    ended = generate(made, "/{robot}/other")
    assert (ended.status, "2 paths with a placeholder" in ended.err) == (2, True), ended
    assert snapshot(made / "ks") == before


def test_enclaves_that_are_left_are_found_in_one_pass(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not every name is compared with every path."""
    looked = 0
    candidates = robots._possible_robots

    def counted(*arguments: Any) -> Iterator[Robot]:
        nonlocal looked
        looked += 1
        return candidates(*arguments)

    monkeypatch.setattr(robots, "_possible_robots", counted)
    paths = [f"/e{number}/{{robot}}" for number in range(30)]
    before = Fleet.of([Robot("a", "/a"), Robot("b", "/b")], enclaves=["/{robot}", *paths])
    assert lost_enclaves(OpenedKeystore(made / "ks"), before, before, now()) == ([], [])
    after = Fleet.of([Robot("b", "/b")], enclaves=paths)
    (note,), (entry,) = lost_enclaves(OpenedKeystore(made / "ks"), before, after, now())
    assert "the robot a is no longer in the fleet, but its earlier enclave /a stay" in note.text
    assert (entry.what, entry.enclave, entry.reason) == ("left", "/a", "a")
    assert looked <= 2 * len(before.enclaves)
    before = Fleet.of([Robot("old", "/a")], enclaves=["{namespace}"])
    after = Fleet.of([Robot("new", "/a")], enclaves=["{namespace}"])
    assert lost_enclaves(OpenedKeystore(made / "ks"), before, after, now()) == ([], [])


@pytest.fixture(scope="module")
def unknown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a keystore whose fleet does not record all enclaves of the robot r3."""
    folder = tmp_path_factory.mktemp("unknown")
    (folder / "fleet.toml").write_text("[robots.r3]\n[robots.r30]\n")
    (folder / "policy.xml").write_text(policy_text({"/{robot}/a": publish("x")}))
    words = ("-p", folder / "policy.xml", "--fleet", folder / "fleet.toml")
    sros("generate_artifacts", "-k", folder / "ks", *words).ok()
    others = ("/r3", "/r3/deep/er", "/desk/r3", "/desk", "/r30/b", "/r3_b")
    sros("create_enclave", folder / "ks", *others).ok()
    return folder


def of_robot(root: Path, robot: str) -> dict[str, Any]:
    said = sros("fleet", "status", root, "--robot", robot, "--json").out
    (found,) = json.loads(said)["robots"]
    return dict(found)


def test_what_an_earlier_change_left_is_named_when_a_robot_leaves(unknown: Path) -> None:
    before = recorded_fleet(OpenedKeystore(unknown / "ks"))
    after = Fleet.of([Robot("r30", "/r30")], enclaves=before.enclaves)
    (note,), _ = lost_enclaves(OpenedKeystore(unknown / "ks"), before, after, now())
    assert "but its earlier enclaves /r3, /r3/a, /r3/deep/er stay valid" in note.text


def test_an_uncertain_line_on_a_robot_that_left_counts_until_rights_are_stated(
    unknown: Path, tmp_path: Path
) -> None:
    """What is uncertain leaves nothing to be renewed in silence, and ends with stated rights."""
    root = copy_of(unknown / "ks", tmp_path / "ks")
    for what, enclave in (("left", "/desk"), ("left", "/r3_b"), ("revocation", "/r3_b")):
        forge_line(root, what=what, enclave=enclave, reason="r9", serial="7")
    fleet = recorded_fleet(OpenedKeystore(root))
    assert left_enclaves(OpenedKeystore(root), fleet) == {"/desk": "r9", "/r3_b": "r9"}
    policy = policy_text({"/desk": publish("x"), "/{robot}/a": publish("x")})
    (tmp_path / "policy.xml").write_text(policy)
    words = ("-p", tmp_path / "policy.xml", "--fleet", unknown / "fleet.toml")
    sros("generate_artifacts", "-k", root, *words).ok()
    assert left_enclaves(OpenedKeystore(root), fleet) == {"/r3_b": "r9"}
    sros("revoke", root, "/r3_b").ok()
    sros("create_enclave", root, "/r3_b").ok()
    assert not left_enclaves(OpenedKeystore(root), fleet)


def test_what_lies_below_a_robot_is_revoked_with_it(unknown: Path, tmp_path: Path) -> None:
    """No enclave of a stolen robot goes on in silence because no policy of the fleet has it."""
    root = tmp_path / "ks"
    copy_of(unknown / "ks", root)
    before = of_robot(root, "r3")
    assert before["enclaves"] == 1
    assert before["unrecorded"] == ["/r3", "/r3/deep/er"]
    assert before["sharing_name"] == ["/desk/r3"]
    ended = sros("revoke", root, "--robot", "r3").ok()
    gone = {line for line in ended.out.splitlines() if line.startswith("revoked enclave ")}
    assert gone == {f"revoked enclave {name}" for name in ("/r3", "/r3/a", "/r3/deep/er")}
    assert (
        "are also revoked, although the fleet does not record them: /r3, /r3/deep/er." in ended.err
    ), ended
    assert "contains the name of a robot that you revoke are still valid: /desk/r3." in ended.err, (
        ended
    )
    assert f"sros revoke {root} /desk/r3`" in ended.err, ended
    left = json.loads(sros("list_enclaves", root, "--json").out)["enclaves"]
    assert left == ["/desk", "/desk/r3", "/r30/a", "/r30/b", "/r3_b"]
    after = of_robot(root, "r3")
    assert after["revoked"] == ["/r3", "/r3/a", "/r3/deep/er"]
    assert (after["enclaves"], after["unrecorded"]) == (0, [])
    assert after["sharing_name"] == ["/desk/r3"]
    said = sros("fleet", "status", root, "--robot", "r3").out
    assert (
        "1 enclave in other folders, with the robot's name in the path, but not recorded in the "
        "fleet: " in said
    ), said


def test_the_other_computer_of_a_revoked_robot_is_named(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    robot = 'namespace = "/r1", domain = '
    (tmp_path / "fleet.toml").write_text(
        f"[robots]\na = {{{robot}1}}\nb = {{{robot}1}}\nelsewhere = {{{robot}2}}\n"
    )
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}": publish("x")}))
    sros("create_keystore", root, "--domain", "1,2").ok()
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", root, *words).ok()
    said = sros("revoke", root, "--robot", "a", "--dry-run").ok().err
    assert "The enclaves of b are still valid, and use the namespace /r1" in said
    assert f"`sros revoke {root} --robot b`" in said
    for robots_words in (("--robot", "a", "--robot", "b"), ("--robot", "elsewhere")):
        assert "still valid" not in sros("revoke", root, *robots_words, "--dry-run").ok().err


def test_a_robot_with_a_lost_enclave_is_not_revoked_already(tmp_path: Path) -> None:
    """The certificate of an enclave whose folder was removed is still valid."""
    root, policy = tmp_path / "ks", tmp_path / "policy.xml"
    (tmp_path / "fleet.toml").write_text("[robots]\nr1 = {}\n")
    policy.write_text(policy_text({"/{robot}/a": publish("x"), "/{robot}/b": publish("y")}))
    sros("create_keystore", root).ok()
    words = ("-p", policy, "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", root, *words).ok()
    sros("revoke", root, "/r1/a").ok()
    shutil.rmtree(root / "enclaves/r1/b")
    refused = sros("revoke", root, "--robot", "r1")
    assert refused.status == 2 and "has no enclave" in refused.err, refused


def test_what_is_left_below_a_robot_is_revoked_later(unknown: Path, tmp_path: Path) -> None:
    """Also when all enclaves that the fleet records are revoked already."""
    root = tmp_path / "ks"
    copy_of(unknown / "ks", root)
    sros("revoke", root, "/r3/a").ok()
    assert "revoked enclave /r3/deep/er" in sros("revoke", root, "--robot", "r3").ok().out
    before = snapshot(root)
    ended = sros("revoke", root, "--robot", "r3").ok()
    assert ended.err.startswith("/r3/a was revoked before: nothing to do."), ended
    assert "are still valid: /desk/r3." in ended.err and ended.out == "", ended
    found = json.loads(sros("revoke", root, "/r3/a", "/r3", "--json").ok().out)
    assert (found["enclaves"], found["changes"], snapshot(root)) == ([], [], before)
    assert sros("revoke", root, "/r3/a", "/desk").ok().out == "revoked enclave /desk\n"
    for crl in (root / "public").glob("*crl*"):
        crl.unlink()
    assert sros("revoke", root, "/r3/a").status == 2, "no list says so any more"


@pytest.mark.parametrize("no_answer", [False, True], ids=["answer", "no answer"])
def test_a_request_that_is_signed_for_a_fleet_is_recorded(
    made: Path, no_answer: bool, tmp_path: Path
) -> None:
    """The enclave is that of its robot from then on, in its domain."""
    root = tmp_path / "ks"
    copy_of(made / "ks", root)
    sros("create_request", "/cams/a", tmp_path / "robot").ok()
    (tmp_path / "fleet.toml").write_text(FLEET)
    (tmp_path / "policy.xml").write_text(policy_text({"/cams/{robot}": publish("x")}))
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    request = tmp_path / "robot/enclaves/cams/a/request.pem"
    how = ("--no-answer",) if no_answer else ("-o", tmp_path / "answer.tgz")
    sros("sign_request", root, request, *words, *how).ok()
    assert sros("list_enclaves", root, "--robot", "a").ok().out.split() == ["/a", "/cams/a"]
    assert of_robot(root, "a")["unrecorded"] == []
    sros("revoke", root, "--robot", "a").ok()
    assert not (root / "enclaves/cams/a").exists()


def test_requests_for_robots_that_the_keystore_does_not_know(made: Path, tmp_path: Path) -> None:
    """They are signed, and one note says that no `--robot` chooses the enclaves."""
    root, robots = tmp_path / "ks", ("new", "other")
    copy_of(made / "ks", root)
    for robot in robots:
        sros("create_request", f"/{robot}", tmp_path / "robot").ok()
    (tmp_path / "fleet.toml").write_text("".join(f"[robots.{robot}]\n" for robot in robots))
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}": publish("x")}))
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    requests = tmp_path / "requests.pem"
    files = (tmp_path / f"robot/enclaves/{robot}/request.pem" for robot in robots)
    requests.write_text("".join(file.read_text() for file in files))
    said = sros("sign_request", root, requests, *words, "--no-answer").ok().err
    assert said.count("note [fleet.unrecorded-enclaves]") == 1
    assert "which robot has /new, /other: its fleet does not have the robot" in said
    sros("create_request", "/a/fork", tmp_path / "lift").ok()
    lifts = "[groups]\nlifts = {}\n[robots]\n"
    (tmp_path / "was.toml").write_text(f"{lifts}a = {{}}\n")
    (tmp_path / "lifts.toml").write_text(f'{lifts}a = {{ groups = ["lifts"] }}\n')
    (tmp_path / "lifts.xml").write_text(policy_text({"/{robot:lifts}/fork": publish("x")}))
    (tmp_path / "all.xml").write_text(policy_text({"/{robot}": publish("x")}))
    of_lifts = ("-p", tmp_path / "lifts.xml", "--fleet", tmp_path / "lifts.toml")
    before = ("-p", tmp_path / "all.xml", "--fleet", tmp_path / "was.toml")
    sros("generate_artifacts", "-k", tmp_path / "groups", *before).ok()
    request = tmp_path / "lift/enclaves/a/fork/request.pem"
    told = sros("sign_request", tmp_path / "groups", request, *of_lifts, "--no-answer").ok().err
    assert "which robot has /a/fork: its fleet has the robot in other groups. So" in told
    sros("revoke", root, "/new").ok()
    refused = sros("generate_artifacts", "-k", root, *words)
    assert "remove the folder of each enclave on the robot (its key" in refused.err
    folder = tmp_path / "robot/enclaves/new"
    sign = ("sign_request", root, folder / "request.pem", "--no-answer", *words)
    assert "On the robot, remove the enclave's folder" in sros(*sign, "--enclave", "/new").err
    shutil.rmtree(folder)
    sros("create_request", "/new", tmp_path / "robot").ok()
    sros(*sign, "--enclave", "/new").ok()
    assert "key-made-here" not in sros("generate_artifacts", "-k", root, *words).ok().err
    (tmp_path / "more.xml").write_text(policy_text({"/{robot}/more": publish("x")}))
    more = ("-p", tmp_path / "more.xml", "--fleet", tmp_path / "fleet.toml")
    for dry_run in (["--dry-run"], []):
        told = sros("generate_artifacts", "-k", root, *more, "--robot", "new", *dry_run).ok().err
        assert told.count("note [enclave.key-made-here]") == 1
        assert "makes the key of /new/more, but its robot made all other keys. To" in told
        assert f"revoke it with `sros revoke {root} /new/more`, run `sros create_req" in told
    sros("revoke", root, "/new/more").ok()
    sros("create_request", "/new/more", tmp_path / "robot").ok()
    request = tmp_path / "robot/enclaves/new/more/request.pem"
    sros("sign_request", root, request, "--no-answer", *more, "--enclave", "/new/more").ok()
    again = sros("generate_artifacts", "-k", root, *more, "--robot", "new").ok()
    assert "key-made-here" not in again.err and "unchanged: 1 enclave: /new/more" in again.err


def test_many_enclaves_are_counted_with_the_next_step(tmp_path: Path) -> None:
    """What to do next is not lost behind a line for each of them; -v and JSON have them all."""
    (tmp_path / "fleet.toml").write_text("".join(f"[robots.r{n}]\n" for n in range(21)))
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}": publish("x")}))
    root = tmp_path / "ks"
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    ended = sros("generate_artifacts", "-k", root, *words).ok()
    some = "/r0, /r1, /r10, /r11, /r12 and 16 more (-v lists all)"
    assert ended.out.endswith(f"\ncreated 21 enclaves: {some}\n")
    assert (
        f"to export these enclaves: `sros distribute_key {root} --robot NAME FOLDER`" in ended.err
    )
    assert sros("renew", root, "--all").ok().out == f"renewed 21 enclaves: {some}\n"
    every = [f"renewed enclave {name}" for name in list_enclaves(root)]
    assert sros("renew", root, "--all", "-v").ok().out.splitlines() == every
    assert len(json.loads(sros("renew", root, "--all", "--json").ok().out)["enclaves"]) == 21
    assert sros("revoke", root, "/r0").ok().out == "revoked enclave /r0\n"
    left = "/r1, /r10, /r11, /r12, /r13 and 16 more (-v lists all)"
    sros("create_enclave", root, "/spare").ok()
    assert sros("revoke", root, "--all").ok().out == f"revoked 21 enclaves: {left}\n"


def test_a_robot_with_keys_of_its_own_gets_all_files_after_a_rotation(
    made: Path, tmp_path: Path
) -> None:
    """One of its two enclaves made its key on the robot, and it missed the rotation."""
    root, robot = copy_of(made / "ks", tmp_path / "ks"), tmp_path / "robot"
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}/own": publish("x")}))
    words = ("-p", tmp_path / "policy.xml", "--fleet", made / "fleet.toml")
    sros("generate_artifacts", "-k", root, *words).ok()
    sros("revoke", root, "/a/own").ok()
    sros("distribute_key", root, "/a", robot).ok()
    sros("create_request", "/a/own", robot).ok()
    request = robot / "enclaves/a/own/request.pem"
    sros("sign_request", root, request, "--no-answer", *words, "--enclave", "/a/own").ok()
    assert "key-made-here" not in sros("generate_artifacts", "-k", root, *words).ok().err
    copy = tmp_path / "copy"
    for target in (robot, copy):
        said = sros("distribute_key", root, "--robot", "a", target, "--force").ok().err
        assert "/a/own: without its key, which was made on its robot and stays there" in said
        assert "[export.keys-included]" not in said
        assert (target / "enclaves/a/own/cert.pem").exists()
    sros("rotate_ca", root, "--finish", "--allow-unconfirmed").ok()

    for name, why in (
        ("/a", "contains enclaves that trust a replaced CA of this keystore"),
        ("/a/own", "Add --keyless"),
    ):
        refused = sros("distribute_key", root, name, robot, "--force")
        assert (refused.status, why in refused.err) == (2, True), refused
    sros("sign_request", root, request, "--renew", "-o", answer := tmp_path / "a.tar.gz").ok()
    refused = sros("import", answer, robot)
    assert "is not from a CA that this robot trusts" in refused.err
    assert "sros distribute_key KEYSTORE --robot NAME FOLDER --force" in refused.err

    sros("distribute_key", root, "--robot", "a", robot, "--force").ok()
    assert sros("verify", robot).out.count("  loadable in domain") == 2


def test_names_that_differ_only_in_case_are_noted(tmp_path: Path) -> None:
    """When the fleet is recorded, and at each publication."""
    pytest.importorskip("tuf")
    root, pub = tmp_path / "ks", tmp_path / "pub"
    (tmp_path / "fleet.toml").write_text("[robots.r7]\n[robots.R7]\n[robots.r8]\n")
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}": publish("x")}))
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    note = "note [fleet.similar-names]: robots whose names differ only in upper and lower case: "
    assert f"{note}R7 and r7. DNS" in sros("generate_artifacts", "-k", root, *words).ok().err
    assert note in sros("fleet", "publish", root, pub, "--dry-run").ok().err
    (tmp_path / "fleet.toml").write_text('[robots.r7]\n[robots.r8]\nrenewal_grace = "9d"\n')
    planned = sros("generate_artifacts", "-k", root, *words, "--dry-run").ok().err
    assert "[fleet.renewal]: r8 can request renewal for a longer time" in planned
    assert note not in sros("generate_artifacts", "-k", root, *words).ok().err
    assert note not in sros("fleet", "publish", root, pub, "--dry-run").ok().err
