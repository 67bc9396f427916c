"""The deployment commands as users and scripts call them, with pipes and terminals."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.children import run
from tests.support.harness import (
    Ended,
    Running,
    check_dry_run,
    copy_of,
    policy_text,
    publish,
    snapshot,
    sros,
    topics_of,
)
from tests.support.long_form import some

NAME, FOLDER = "/arm/camera", "enclaves/arm/camera"
PROGRAM = f"{sys.executable} -m sros_tool"


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes in other working directories import the package."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))


def shell(script: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    script = script.replace("sros ", f"{PROGRAM} ")
    return run(["bash", "-c", f"set -o pipefail; {script}"], cwd=cwd, status=None)


def written_to(path: Path, *words: str) -> Ended:
    """Run the program where ``path`` lies, with its standard output in this new file."""
    path.touch()
    return Running(*words, cwd=path.parent, write_to=path).end()


def signed_and_imported(
    request: Path, folder: Path, *, signing: str = "", importing: str = ""
) -> tuple[Ended, Ended]:
    """Run ``sros sign_request ks - <request | sros import - robot`` with options, in forks."""
    pipe = folder / "pipe"
    if not pipe.exists():
        os.mkfifo(pipe)
    words = ("sign_request", "ks", "-", *signing.split())
    signed = Running(*words, cwd=folder, read_from=request, write_to=pipe)
    imported = Running("import", "-", "robot", *importing.split(), cwd=folder, read_from=pipe)
    return signed.end(), imported.end()


def asked(tmp_path: Path, name: str = NAME) -> Path:
    sros("create_request", name, tmp_path / "robot").ok()
    return tmp_path / f"robot/enclaves{name}/request.pem"


# ── distribute_key ─────────────────────────────────────────────────────────────────────────


def test_exported_enclaves_are_listed(keystore: Path, tmp_path: Path) -> None:
    ended = sros("distribute_key", keystore, "/b", "/a", tmp_path / "out").ok()
    assert ended.out.splitlines() == [
        f"exported enclave /b to '{tmp_path / 'out'}'",
        f"exported enclave /a to '{tmp_path / 'out'}'",
    ]
    ended = sros("distribute_key", keystore, "--all", tmp_path / "out").ok()
    assert (ended.out, ended.err.count("already up to date")) == ("", 2)
    (tmp_path / "out/enclaves/b/permissions.p7s").unlink()
    ended = sros("distribute_key", keystore, "--all", tmp_path / "out", "--force").ok()
    assert ended.out == f"exported enclave /b to '{tmp_path / 'out'}'\n"
    assert f"enclave /a in '{tmp_path / 'out'}' is already up to date\n" in ended.err
    assert sros("list_enclaves", tmp_path / "out").ok().out == "/a\n/b\n"


def test_a_key_that_an_export_closes_to_others_is_named(keystore: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    sros("distribute_key", keystore, "/a", robot).ok()
    (robot / "enclaves/a" / "key.pem").chmod(0o644)
    for words in ((), ("--force",)):  # which changes nothing
        said = sros("distribute_key", keystore, "/a", robot, *words).ok().err
        assert f"[export.key-readable]: others can read '{robot}/enclaves/a/key.pem'" in said
    (robot / "enclaves/a" / "governance.p7s").write_text("x")
    said = sros("distribute_key", keystore, "/a", robot, "--force").ok().err
    assert stat.S_IMODE((robot / "enclaves/a" / "key.pem").stat().st_mode) == 0o600
    assert f"could open until now, and cannot open any more: {robot}/enclaves/a/key.pem" in said
    assert f"sros renew {keystore} ENCLAVE --new-key" in said


def test_a_host_by_patterns(keystore: Path, tmp_path: Path) -> None:
    sros("create_enclave", keystore, "/r1/x", "/r1/y/z", "/r2/x").ok()
    sros("distribute_key", keystore, "--match", "/r1/*", "--match", "/a", tmp_path / "1.tgz").ok()
    with_env = {"ROS_SECURITY_KEYSTORE": str(keystore)}
    sros("distribute_key", "--match", "/r1/*", "/a", tmp_path / "2", env=with_env).ok()
    (tmp_path / "1").mkdir()
    assert shell("tar -xzf 1.tgz -C 1", tmp_path).returncode == 0
    assert snapshot(tmp_path / "1") == snapshot(tmp_path / "2")
    assert sros("list_enclaves", tmp_path / "1").ok().out.split() == ["/a", "/r1/x", "/r1/y/z"]
    ended = sros("distribute_key", keystore, "--match", "/r3/*", tmp_path / "3")
    assert (ended.status, "matches '/r3/*'" in ended.err) == (2, True)
    assert not (tmp_path / "3").exists()


def test_unpacking_one_enclave_leaves_the_folders_of_others(keystore: Path, tmp_path: Path) -> None:
    sros("distribute_key", keystore, "--all", tmp_path / "robot").ok()
    before = (tmp_path / "robot/enclaves").stat()
    sros("distribute_key", keystore, "/a", tmp_path / "talker.tar.gz").ok()
    (command,) = re.findall(
        r"\$ (tar .*talker\.tar\.gz.*)  #", sros("distribute_key", "--help").out
    )
    command = command.replace("enclaves/talker", "enclaves/a").replace("/etc/robot", "robot")
    assert shell(command, tmp_path).returncode == 0
    after = (tmp_path / "robot/enclaves").stat()
    assert (after.st_ctime_ns, after.st_mtime_ns) == (before.st_ctime_ns, before.st_mtime_ns)
    assert (tmp_path / "robot/enclaves/a").stat().st_mtime == 0  # it was unpacked


def test_through_a_pipe_with_the_modes_of_keys(keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "robot").mkdir()
    ended = shell("sros distribute_key ks --all - | tar -xz -C robot", tmp_path)
    assert ended.returncode == 0, ended
    assert ended.stdout == ""
    assert "exported enclave /a to standard output" in ended.stderr
    assert stat.S_IMODE((tmp_path / "robot/enclaves/a/key.pem").stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "robot/enclaves/a").stat().st_mode) == 0o700
    assert sros("verify", tmp_path / "robot").ok().out.count("loadable in domain 0") == 2
    sros("distribute_key", keystore, "--all", tmp_path / "file.tgz").ok()
    written_to(tmp_path / "out", "distribute_key", "ks", "/a", "/b", "-").ok()
    assert (tmp_path / "out").read_bytes() == (tmp_path / "file.tgz").read_bytes()


def test_broken_and_empty_pipes(keystore: Path, tmp_path: Path) -> None:
    assert shell("sros distribute_key ks --all - | true", tmp_path).stderr.count("Traceback") == 0
    refused = written_to(tmp_path / "out", "distribute_key", "ks", "/none", "-")
    assert refused.status == 2
    assert (tmp_path / "out").read_bytes() == b""
    ended = Running(
        "distribute_key", "ks", "/a", "-", cwd=tmp_path, write_to=Path("/dev/full")
    ).end()
    assert (ended.status, ended.err.count("\n")) == (2, 1), ended
    assert "exported" not in ended.err
    assert "Nothing was changed" not in ended.err


@pytest.mark.parametrize(
    "words", [["distribute_key", "ks", "/a", "-"], ["sign_request", "ks", "r.pem", "-o", "-"]]
)
def test_no_archive_is_written_to_a_terminal(
    words: list[str], keystore: Path, tmp_path: Path
) -> None:
    shutil.copy(asked(tmp_path), tmp_path / "r.pem")
    before = snapshot(tmp_path)
    leader, follower = pty.openpty()
    ended = Running(*words, cwd=tmp_path, write_to=Path(os.ttyname(follower))).end()
    os.close(follower)
    os.close(leader)
    assert ended.status == 2
    assert "terminal" in ended.err
    assert snapshot(tmp_path) == before


def test_a_missing_target_is_refused(keystore: Path) -> None:
    ended = sros("distribute_key", keystore, "/a", "/b")
    assert ended.status == 2
    assert "no target is named" in ended.err
    assert not Path("/b").exists()


def test_a_dry_run_of_a_pipe(keystore: Path) -> None:
    said = sros("distribute_key", keystore, "/a", "-", "--dry-run").ok().out.splitlines()
    assert said[0] == "would send enclaves/a/cert.pem"
    assert len(said) == 6


# ── keys created on the robot ─────────────────────────────────────────────────────────────


def test_from_the_request_to_a_running_process(keystore: Path, tmp_path: Path) -> None:
    ended = sros("create_request", NAME, tmp_path / "robot").ok()
    digest = ended.out.splitlines()[1].split()[-1]
    request = tmp_path / "robot" / FOLDER / "request.pem"
    assert str(request) in ended.out
    assert "waits-for-answer" in sros("verify", tmp_path / "robot").out
    shutil.copy(request, tmp_path / "r.pem")
    (tmp_path / "p.xml").write_text(policy_text({NAME: publish("image")}))
    ended = sros("sign_request", keystore, "r.pem", "-p", "p.xml", cwd=tmp_path).ok()
    assert digest in ended.out
    assert "r.answer.tar.gz" in ended.out
    trusted = ended.out.splitlines()[1].split()[-1]
    ended = sros("import", tmp_path / "r.answer.tar.gz", tmp_path / "robot").ok()
    assert f"imported enclave {NAME}" in ended.out
    assert trusted in ended.out
    assert topics_of(tmp_path / "robot" / FOLDER) == {"rt/image", "ros_discovery_info"}
    ended_run = shell(f"sros run robot {NAME} -- printenv ROS_SECURITY_KEYSTORE", tmp_path)
    assert ended_run.stdout == f"{tmp_path / 'robot'}\n"
    sros("verify", tmp_path / "robot").ok()
    assert NAME in sros("list_enclaves", keystore).ok().out
    assert sros("inspect", keystore, "--history").ok().out.count(NAME) == 3
    assert f"{NAME}  key on its robot, expires" in sros("inspect", keystore).ok().out
    one = sros("inspect", keystore, NAME).ok().out
    assert one.splitlines()[0].endswith(f"{NAME}: key on its robot"), one
    folder = sros("inspect", tmp_path / "robot" / FOLDER).ok().out
    assert sros("inspect", tmp_path / "robot", NAME).ok().out == folder
    no_keystore = sros("inspect", tmp_path / "robot" / FOLDER, NAME)
    assert no_keystore.status == 2 and "is not a valid keystore" in no_keystore.err
    missing = sros("inspect", keystore, f"{NAME}s")
    assert missing.status == 2 and f"Perhaps you mean {NAME}." in missing.err
    ended = sros("distribute_key", keystore, NAME, tmp_path / "out")
    assert ended.status == 2
    assert "It was made on its robot and stays there" in ended.err
    (tmp_path / "robot" / FOLDER / "key.pem").unlink()
    again = f"make another key with `sros create_request {NAME} NEW_FOLDER`"
    for words in (("run", "robot", NAME, "--", "true"), ("verify", "robot")):
        lost = sros(*words, cwd=tmp_path)
        assert again in lost.out + lost.err and "distribute_key" not in lost.out + lost.err
    ended = sros("distribute_key", keystore, "--all", tmp_path / "out").ok()
    assert f"left out enclave {NAME}: its key was made on its robot" in ended.err


def test_one_pipe_from_the_request_to_the_answer(keystore: Path, tmp_path: Path) -> None:
    request = asked(tmp_path)
    line = f"cat {request} | sros sign_request ks - | sros import - robot"
    ended = shell(line, tmp_path)
    assert ended.returncode == 0, ended
    assert "imported enclave" in ended.stdout
    sros("verify", tmp_path / "robot").ok()
    refused, without_answer = signed_and_imported(request, tmp_path)
    assert "already exists" in refused.err
    assert "the answer is empty" in without_answer.err
    assert without_answer.status == 2
    for done in signed_and_imported(request, tmp_path, signing="--renew"):
        done.ok()


def test_roots_from_the_environment(keystore: Path, tmp_path: Path) -> None:
    robot = {"ROS_SECURITY_KEYSTORE": str(tmp_path / "robot")}
    sros("create_request", NAME, env=robot).ok()
    request = tmp_path / "robot" / FOLDER / "request.pem"
    home = {"ROS_SECURITY_KEYSTORE": str(keystore)}
    sros("sign_request", request, "-o", tmp_path / "answer.tgz", env=home).ok()
    sros("import", tmp_path / "answer.tgz", env=robot).ok()
    sros("verify", env=robot).ok()
    for words in (["create_request", NAME], ["import", "x"], ["verify"], ["sign_request", "x"]):
        ended = sros(*words, env={"ROS_SECURITY_KEYSTORE": None})
        assert (ended.status, "no keystore is named" in ended.err) == (2, True)


@pytest.mark.parametrize(
    "line",
    [
        "create_request /new robot",
        "create_request /new /newer elsewhere",
        "create_request /arm/camera robot --again",
        "sign_request ks r.pem",
        "sign_request ks r.pem -o a.tgz",
        "import good.tgz robot",
    ],
)
def test_a_dry_run_prints_what_the_command_does(line: str, keystore: Path, tmp_path: Path) -> None:
    request = asked(tmp_path)
    shutil.copy(request, tmp_path / "r.pem")
    copy_of(keystore, tmp_path / "twin")
    sros("sign_request", tmp_path / "twin", request, "-o", tmp_path / "good.tgz").ok()
    check_dry_run(line, tmp_path)


MISUSE: dict[str, tuple[str, str]] = {
    "no request": ("sign_request ks", "no keystore is named"),
    "two requests": ("sign_request ks r.pem r.pem", "takes"),
    "a request that is missing": ("sign_request ks no.pem", "does not exist"),
    "no keystore for it": ("sign_request no r.pem", "not a valid keystore"),
    "a policy that is missing": ("sign_request ks r.pem -p no.xml", "no.xml"),
    "nothing to renew": ("sign_request ks r.pem --renew", "Leave --renew out"),
    "a certificate for a request": ("sign_request ks ks/enclaves/a/cert.pem", "cannot be read"),
    "the answer in a missing folder": ("sign_request ks r.pem -o no/a.tgz", "'no': No such"),
    "a name that is none": ("create_request /new camera robot", "not a valid enclave name"),
    "an enclave as folder": ("create_request /r9/base /r9/arm", "no folder '/r9'"),
    "a key that is there": ("create_request /arm/camera robot", "has a key in 'robot'"),
    "a request in a keystore": ("create_request /c ks", "is a keystore with CAs"),
    "an answer that is missing": ("import no.tgz robot", "does not exist"),
    "an answer that is none": ("import r.pem robot", "not a .tar.gz"),
    "an export for an answer": ("import export.tgz robot", "key.pem"),
    "an answer in a keystore": ("import good.tgz ks", "with CAs"),
    "an answer elsewhere": ("import good.tgz elsewhere", "no key of enclave"),
    "verify nothing": ("verify no", "neither"),
    "verify at no moment": ("verify robot --at noon", "is not a date"),
    "verify at ''": ("verify robot --at ''", "is not a date"),
    "verify in no domain": ("verify robot --domain x", "not a domain id"),
    "verify in ''": ("verify robot --domain ''", "empty"),
    "an unknown option": ("verify robot --quick", "No such option"),
}


@pytest.mark.parametrize("case", some([*MISUSE], 8))
def test_misuse_is_reported_in_one_paragraph(case: str, keystore: Path, tmp_path: Path) -> None:
    line, why = MISUSE[case]
    request = asked(tmp_path)
    shutil.copy(request, tmp_path / "r.pem")
    sros("distribute_key", keystore, "/a", tmp_path / "export.tgz").ok()
    copy_of(keystore, tmp_path / "twin")
    sros("sign_request", tmp_path / "twin", request, "-o", tmp_path / "good.tgz").ok()
    before = snapshot(tmp_path)
    ended = sros(*(word.replace("''", "") for word in line.split()), cwd=tmp_path)
    assert ended.status == 2, ended
    assert ended.out == ""
    assert ended.err.count("\n") == 1
    assert why in ended.err
    assert "defect" not in ended.err
    assert snapshot(tmp_path) == before


# ── verify ─────────────────────────────────────────────────────────────────────────────────


def test_verify_reports_faults_and_sets_its_exit_status(keystore: Path, tmp_path: Path) -> None:
    sros("distribute_key", keystore, "/a", "/b", tmp_path / "out").ok()
    out = tmp_path / "out"
    assert sros("verify", out, "--domain", "0").ok().err == ""
    (out / "enclaves/a/key.pem").chmod(0o644)
    (out / "enclaves/b/cert.pem").unlink()
    (out / "enclaves/b/permissions.p7s").write_text("edited")
    ended = sros("verify", out)
    assert ended.status == 1
    assert "/b  NOT LOADABLE\n" in ended.out
    assert f"{out}/enclaves/b/cert.pem: error: a file that an enclave needs is miss" in ended.out
    # A robot's folder has no CA keys, so no remedy may need them.
    assert (
        "Export the enclave again from the keystore that has the CA keys: `sros distribute_key "
    ) in ended.out
    at_home = "TARGET --force`. If `sros check KEYSTORE` finds an error there, first do what it"
    assert ended.out.count(at_home) == 2, "both faults have one remedy"
    started = sros("run", out, "/b", "--domain", "0", "--", "true")
    assert started.status == 2 and started.err.count(at_home) == 1, started
    assert "no enclave is given" in sros("run", out, "--", "true").err
    assert f"{out}/enclaves/a/key.pem: error: a private key that others can read" in ended.out
    assert f"chmod 600 {out}/enclaves/a/key.pem`" in ended.out
    said = json.loads(sros("verify", out, "--json", "--at", "2026-12-24", "--domain", "7").out)
    assert (said["ok"], said["kind"], said["domain"]) == (False, "keystore", 7)
    assert said["at"] == "2026-12-24T00:00:00Z"
    assert [each["name"] for each in said["enclaves"]] == ["/a", "/b"]
    assert {"enclave", "file", "text"} == set(said["findings"][0])
    assert sros("verify", out / "enclaves/a", "--at", "2099-01-01").status == 1


def test_verify_at_home_says_which_keys_are_on_their_robots(keystore: Path, tmp_path: Path) -> None:
    sros("sign_request", keystore, asked(tmp_path), "-o", tmp_path / "a.tgz").ok()
    said = sros("verify", keystore)
    assert "/arm/camera  its key is on its robot: verify the enclave there\n" in said.out
    assert "/a  loadable" in said.out
    assert "camera/key.pem" not in said.out
    (home,) = [
        each
        for each in json.loads(sros("verify", keystore, "--json").out)["enclaves"]
        if each["name"] == "/arm/camera"
    ]
    assert (home["loadable"], home["key_on_robot"]) == (False, True)
    (keystore / "ledger.jsonl").unlink()  # as on a robot, where the key is lost
    lost = sros("verify", keystore)
    assert "/arm/camera  NOT LOADABLE\n" in lost.out and "camera/key.pem: error" in lost.out


def test_verify_of_an_archive_says_how_to_unpack_it(keystore: Path, tmp_path: Path) -> None:
    archive = tmp_path / "the robot.tar.gz"
    sros("distribute_key", keystore, "/a", archive).ok()
    refused = sros("verify", archive)
    assert refused.status == 2
    unpack, _, verify = re.findall("`(.+?)`", refused.err)[0].rpartition(" && ")
    assert shell(unpack, tmp_path).returncode == 0
    sros(*verify.split()[1:], cwd=tmp_path).ok()


def test_a_finding_outside_of_its_enclave_names_its_file_from_the_root(tmp_path: Path) -> None:
    out = tmp_path / "out"
    sros("create_keystore", tmp_path / "ks").ok()
    sros("create_enclave", tmp_path / "ks", "/listener", "/talker/listener").ok()
    sros("distribute_key", tmp_path / "ks", "/listener", "/talker/listener", out).ok()
    findings = json.loads(sros("verify", out, "--json").out)["findings"]
    assert "/listener" in {each["enclave"] for each in findings}
    assert not [each for each in findings if ".." in each["file"]]


# ── after a rotation or a revocation ───────────────────────────────────────────────────────


def test_a_robot_follows_a_rotation_of_the_cas_by_answers(keystore: Path, tmp_path: Path) -> None:
    asked_for = asked(tmp_path)
    for ended in signed_and_imported(asked_for, tmp_path):
        ended.ok()
    answer = tmp_path / "answer.tar.gz"
    for _stage in ("distribute", "reissue", "retire"):
        sros("rotate_ca", keystore, "--next").ok()
        answer.unlink(missing_ok=True)
        sros("sign_request", keystore, asked_for, "--renew", "-o", answer).ok()
        ended = sros("import", answer, tmp_path / "robot").ok()
        assert "not verified" not in ended.out
        sros("verify", tmp_path / "robot").ok()
    # A robot that missed the stages of the rotation cannot trust the new CAs.
    sros("rotate_ca", keystore, "--finish").ok()
    signed, refused = signed_and_imported(asked_for, tmp_path, signing="--renew")
    signed.ok()
    assert (refused.status, "has not signed it" in refused.err) == (2, True)
    for ended in signed_and_imported(asked_for, tmp_path, signing="--renew", importing="--force"):
        ended.ok()
    sros("verify", tmp_path / "robot").ok()


def test_a_revoked_enclave_asks_again_with_a_new_key(keystore: Path, tmp_path: Path) -> None:
    request = asked(tmp_path)
    sros("sign_request", keystore, request, cwd=tmp_path).ok()
    sros("revoke", keystore, NAME).ok()
    assert NAME not in sros("list_enclaves", keystore).ok().out
    ended = sros("sign_request", keystore, request, "-o", tmp_path / "again.tgz")
    assert "was revoked" in ended.err
    sros("create_request", NAME, tmp_path / "new").ok()
    new = tmp_path / "new" / FOLDER / "request.pem"
    ended = sros("sign_request", keystore, new, "-o", tmp_path / "new.tgz")
    assert ended.status == 2 and f"add --enclave {NAME}" in ended.err
    sros("sign_request", keystore, new, "-o", tmp_path / "new.tgz", "--enclave", NAME).ok()
    sros("import", tmp_path / "new.tgz", tmp_path / "new").ok()
    assert (tmp_path / "new" / FOLDER / "crl.pem").exists()
    sros("verify", tmp_path / "new").ok()
