"""The verbs as a person or a script uses them: what they do, print and return."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool import __version__
from sros_tool.cli.program import FAMILIES
from sros_tool.files import policies_dir
from sros_tool.keystore.layout import PRIVATE, REQUIRED_FILES
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.template import load_template
from sros_tool.pki import smime
from sros_tool.pki.certificates import common_name, issue_ca, pem
from sros_tool.pki.keys import generate_key
from sros_tool.runtime.environment import REFUSING, render_refusal
from sros_tool.runtime.variables import DOMAIN
from sros_tool.validity import Window
from tests.support.children import run, wait_for
from tests.support.harness import (
    Running,
    check_dry_run,
    check_whole,
    copy_of,
    forked,
    policy_text,
    publish,
    remains,
    snapshot,
    sros,
    topics_of,
)
from tests.support.long_form import some

VERBS = [name for family in FAMILIES.values() for name in family]
PROGRAM = [sys.executable, "-m", "sros_tool"]


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that are started elsewhere find the package, too."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))


# ── help ───────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_helps_with_an_example(verb: str) -> None:
    said = sros(verb, "--help").ok().out
    assert f"Usage: sros {verb}" in said
    assert f"$ sros {verb}" in said


@pytest.mark.parametrize("verb", VERBS)
def test_hyphens_are_underscores(verb: str) -> None:
    assert sros(verb.replace("_", "-"), "-h").ok().out == sros(verb, "-h").out


@pytest.mark.parametrize(
    ("alias", "verb"),
    [
        ("create_key", "create_enclave"),
        ("list_keys", "list_enclaves"),
        ("list-keys", "list_enclaves"),
        ("export_enclave", "distribute_key"),
    ],
)
def test_aliases(alias: str, verb: str) -> None:
    assert sros(alias, "-h").ok().out == sros(verb, "-h").out


def test_help_and_version() -> None:
    said = sros("--help").ok().out
    assert all(verb in said for verb in VERBS)
    git = subprocess.run(
        ["git", "rev-parse", "--short=10", "HEAD"],
        cwd=policies_dir(),
        capture_output=True,
        text=True,
    )
    commit = rf"\+g{git.stdout.strip()}(\.dirty)?" if git.returncode == 0 else ""
    said = sros("--version").ok().out
    assert re.fullmatch(rf"sros {re.escape(__version__)}{commit}\n", said)
    assert sros().status == 2


@pytest.mark.parametrize(
    "line",
    [
        "check {none}",
        "check keystore {none}",
        "check policy {none}",
        "check policy {empty}",
        "check {none} --needs-renewal 30d",
        "check {keystore} --policy {none}",
        "crl {none}",
        "diff_policy {none} {keystore}",
        "diff_policy {keystore} {none}",
        "diff_policy {file} {keystore}",
        "distribute_key {keystore} /none {none}",
        "env {keystore} /none",
        "explain {none} /a publish /chatter",
        "explain {keystore} /none publish /chatter",
        "explain {keystore} --who fly /chatter",
        "explain {none} --who publish /chatter",
        "explain {none} --reach /a",
        "explain {keystore} --log {none}",
        "explain /a publish /chatter --policy {file}",
        "inspect {none}",
        "inspect {file}",
        "inspect {none} --history",
        "list_enclaves {none}",
        "merge_policy {none} {file}",
        "minimize_policy {file} --observed {file}",
        "policies none.xml --copy {none}",
        "rotate_ca {none}",
        "run {keystore} /none -- true",
        "verify {none}",
        "verify {file}",
        "view {none}",
        "view {file}",
    ],
)
def test_what_could_not_be_asked_is_not_no(line: str, keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "file.xml").write_text("broken")
    (tmp_path / "empty").mkdir()
    places = {name: tmp_path / name for name in ("none", "empty")}
    places |= {"file": tmp_path / "file.xml", "keystore": keystore}
    ended = sros(*line.format_map(places).split())
    assert ended.status == 2, ended
    assert ended.err.count("\n") == 1, ended


# ── what scripts of ros2/sros2 rely on ─────────────────────────────────────────────────────


def test_messages_of_ros2(keystore: Path, tmp_path: Path) -> None:
    ended = sros("create_keystore", keystore)
    assert ended.status == 2
    assert ended.err.startswith(f"Unable to create keystore: keystore '{keystore}' already exists")
    ended = sros("list_enclaves", tmp_path / "none")
    assert ended.status == 2
    assert ended.err.startswith(
        f"Unable to list enclaves: '{tmp_path / 'none'}' is not a valid keystore"
    )
    assert sros("list_enclaves", keystore).ok().out == "/a\n/b\n"


def test_a_folder_that_is_no_keystore_leads_to_the_one_that_was_meant(keystore: Path) -> None:
    inside, misspelt = keystore / "enclaves", keystore.with_name(f"{keystore.name}x")
    for path, said in (
        (inside, f"It is a folder in the keystore '{keystore}': name that keystore."),
        (misspelt, f"It does not exist. Perhaps you mean '{keystore}'."),
        (keystore.with_name("other"), "if you have none yet, make one with `sros create_keystore "),
    ):
        assert said in sros("list_enclaves", path).err
        assert said in sros("explain", path, "/a", "publish", "/x").err
    for verb in (("create_keystore", inside), ("generate_artifacts", "-k", inside, "-e", "/a")):
        ended = sros(*verb)
        assert ended.status == 2 and f"is in the keystore '{keystore}'. Two k" in ended.err, ended


def test_the_layout_is_that_of_ros2(keystore: Path) -> None:
    for name in REQUIRED_FILES:
        assert (keystore / "enclaves/a" / name).is_file()
    assert os.readlink(keystore / "enclaves/a/governance.p7s") == "../governance.p7s"
    link = os.readlink(keystore / "enclaves/a/identity_ca.cert.pem")
    assert link == "../../public/identity_ca.cert.pem"


def test_a_keystore_that_ros2_made(tmp_path: Path) -> None:
    """One CA without key identifiers, no sros.toml, and files that are open to all."""
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "sros2").ok()
    (root / "sros.toml").unlink()
    for path in root.rglob("*"):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)
    sros("create_enclave", root, "/talker").ok()
    sros("env", root, "/talker").ok()
    assert "rt/*" in topics_of(root / "enclaves/talker")
    assert json.loads(sros("inspect", root, "--json").ok().out)["template"] is None


# ── roots ──────────────────────────────────────────────────────────────────────────────────

ROOTS = {
    "relative": "ks2",
    "with a slash at the end": "ks2/",
    "with dots": "./x/../ks2",
    "deep": "one/two/three",
    "spaces and quotes": 'it\'s a "key" store $HOME `x`;&',
    "line break": "key\nstore",
    "not ASCII": "schlüssel-\u202eerots",
    "not UTF-8": os.fsdecode(b"ks-\xff\xfe"),
    "a hyphen in front": "./-ks",
    "a pattern": "k[s]*?",
    "a percent sign": "100%d",
    "a comma": "a,b|c=d",
    "long": "x" * 200,
}


@pytest.mark.parametrize("name", some([*ROOTS], 2))
def test_root_with_any_name(name: str, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    root = ROOTS[name]
    sros("create_keystore", root, cwd=tmp_path).ok()
    sros("create_enclave", root, "/robot/arm", cwd=tmp_path).ok()
    sros("generate_artifacts", "-k", root, "-e", "/robot", cwd=tmp_path).ok()
    assert sros("list_enclaves", root, cwd=tmp_path).ok().out.split() == ["/robot", "/robot/arm"]
    sros("inspect", root, cwd=tmp_path).ok()
    sros("distribute_key", root, "/robot", "out", cwd=tmp_path).ok()
    check_whole(tmp_path / root)
    assert not remains(tmp_path)
    # What the shell is told is what the file system knows.
    told = tmp_path / "told"
    told.touch()
    Running("env", root, "/robot/arm", cwd=tmp_path, write_to=told).end().ok()
    script = 'eval "$(cat told)"; test -f "$ROS_SECURITY_KEYSTORE/enclaves/robot/arm/key.pem"'
    run(["sh", "-c", script], cwd=tmp_path)


@pytest.mark.parametrize("shell", ["sh", "bash", "zsh", "fish"])
def test_a_shell_that_evaluates_a_refusal_starts_no_node(shell: str, tmp_path: Path) -> None:
    """An empty text would evaluate well, and the next command run unsecured, even with set -e."""
    if not shutil.which(shell):
        pytest.skip(f"there is no {shell}")
    form = "fish" if shell == "fish" else "sh"
    ended = sros("env", tmp_path / "none", "/a", "--format", form)
    assert ended.status != 0
    status = "$status" if shell == "fish" else "$?"
    names = "$ROS_SECURITY_ENABLE $ROS_SECURITY_STRATEGY [$ROS_SECURITY_KEYSTORE]"
    env = {**os.environ, "ROS_SECURITY_KEYSTORE": "/srv/earlier"}
    script = "eval $argv[1]" if shell == "fish" else 'eval "$1"'
    words = [ended.out] if shell == "fish" else [shell, ended.out]
    done = run([shell, "-c", f'{script}; echo "{status} {names}"', *words], env=env)
    assert done.stdout.split() == ["1", "true", "Enforce", "[]"]
    if shell != "fish":
        run([shell, "-c", f"set -e; {script}; echo more", *words], env=env, status=1)
        bare = run([shell, "-c", f'eval $1; echo "$? {names}"', *words], env=env)
        assert bare.stdout == done.stdout


def test_a_file_with_a_refusal_starts_no_node(tmp_path: Path) -> None:
    def said(form: str) -> str:
        return sros("env", tmp_path / "none", "/a", "--format", form).out

    assert json.loads(said("json")) == REFUSING
    assert json.loads(sros("env", tmp_path / "none", "/a", "--json").out)["variables"] == REFUSING
    assert dict(line.split("=") for line in said("docker").splitlines()) == REFUSING
    unit = said("systemd").splitlines()
    assert unit == [f'Environment="{k}={v}"' for k, v in REFUSING.items()] + [
        "ExecStartPre=/bin/false"
    ]


@pytest.mark.parametrize(
    ("words", "form"),
    [
        ("env", "sh"),
        ("env {ks}", "sh"),
        ("env {ks} /a /b", "sh"),
        ("env {ks} /a --bogus", "sh"),
        ("env {ks} /a --format csh", "sh"),
        ("env {ks} /a --domain", "sh"),
        ("env {ks} /a --domain 7", "sh"),
        ("env --bogus {ks} /a --format fish", "fish"),
        ("env --bogus {ks} /a --format=docker", "docker"),
        ("env --bogus {ks} /a --format json", "json"),
    ],
)
def test_wrong_words_are_refused_in_the_form_too(words: str, form: str, keystore: Path) -> None:
    ended = sros(*words.format(ks=keystore).split())
    assert (ended.status, ended.out) == (2, render_refusal(form)), ended


def test_help_and_completion_of_env_print_no_refusal(keystore: Path) -> None:
    assert "ROS_SECURITY_STRATEGY=Enforce;" not in sros("env", "--help").ok().out
    env = {"_SROS_COMPLETE": "bash_complete", "COMP_WORDS": f"sros env {keystore} --f"}
    completed = sros(env={**env, "COMP_CWORD": "3"})
    assert completed.out.split(",")[-1].split() == ["--format"], completed


def test_rcl_starts_no_node_with_a_refusal(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    node = "import rclpy; rclpy.init(); print('RUNS')"
    script = f'eval "$1"; {shlex.join((sys.executable, "-c", node))}'
    refused = sros("env", tmp_path / "none", "/a").out
    for text, runs in ((refused, False), ("unset ROS_SECURITY_ENABLE", True)):
        done = run(["sh", "-c", script, "sh", text], status=None)
        assert ("RUNS" in done.stdout) is runs, done


def test_root_is_the_working_folder_and_was_not_empty(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    sros("create_keystore", ".", cwd=tmp_path).ok()
    sros("create_enclave", ".", "/a", cwd=tmp_path).ok()
    assert (tmp_path / "notes.txt").read_text() == "mine"
    check_whole(tmp_path)
    assert not remains(tmp_path)


def test_root_from_the_environment(tmp_path: Path) -> None:
    env = {"ROS_SECURITY_KEYSTORE": str(tmp_path / "ks")}
    (tmp_path / "p.xml").write_text(policy_text({"/a": publish("x")}))
    sros("generate_artifacts", "-e", "/a", env=env).ok()
    sros("create_enclave", "/b", "/c", env=env).ok()
    sros("create_permission", "/b", tmp_path / "p.xml", env=env)
    sros("create_permission", "/a", tmp_path / "p.xml", env=env).ok()
    assert sros("list_enclaves", env=env).ok().out.split() == ["/a", "/b", "/c"]
    assert str(tmp_path / "ks") in sros("env", "/a", env=env).ok().out
    sros("distribute_key", "/a", tmp_path / "out", env=env).ok()


@pytest.mark.parametrize("umask", [0o000, 0o077])
def test_modes_under_any_umask(umask: int, tmp_path: Path) -> None:
    before = os.umask(umask)
    try:
        sros("create_keystore", tmp_path / "ks").ok()
        sros("create_enclave", tmp_path / "ks", "/a").ok()
        sros("distribute_key", tmp_path / "ks", "/a", tmp_path / "out.tar.gz").ok()
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out.tar.gz").stat().st_mode) == 0o600
    for path in (tmp_path / "ks").rglob("*"):
        if not path.is_symlink():
            mode = stat.S_IMODE(path.stat().st_mode)
            assert not mode & 0o022, path
            secret = path.name.endswith("key.pem") or path.name in ("private", "enclaves", "a")
            assert not (secret and mode & 0o077), path


# ── dry runs ───────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "line",
    [
        "create_keystore new",
        "create_keystore deep/new --template production",
        "create_enclave ks /c /d",
        "create_permission ks /a p.xml",
        "generate_artifacts -k ks -e /c -p p.xml",
        "generate_artifacts -k something -e /c -p p.xml",
        "distribute_key ks /a out",
        "distribute_key ks /a out.tar.gz",
    ],
)
def test_a_dry_run_tells_what_the_verb_then_does(line: str, keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text({"/a": publish("new"), "/e": publish("new")}))
    check_dry_run(line, tmp_path, "-v")


def test_a_dry_run_of_copying_policies_copies_none(tmp_path: Path) -> None:
    assert "mine" in sros("policies", "--copy", "mine", "--dry-run", cwd=tmp_path).ok().out
    assert snapshot(tmp_path) == {}


# ── single verbs ───────────────────────────────────────────────────────────────────────────


def test_create_keystore_names_its_choice_and_what_is_open(tmp_path: Path) -> None:
    ended = sros("create_keystore", tmp_path / "1").ok()
    assert "template development" in ended.out
    assert "create_permission" in ended.err
    ended = sros("create_keystore", tmp_path / "2", "--template", "production").ok()
    assert ended.err == ""
    ended = sros("create_keystore", tmp_path / "3", "--template", "sros2").ok()
    assert "--ca-layout separate" in ended.err


def test_create_keystore_by_options(tmp_path: Path) -> None:
    words = ["--domain", "3,1,10-12", "--ca-layout", "single", "--ca-validity", "2y"]
    words += ["--validity", "90d", "--permissions-validity", "300h"]
    sros("create_keystore", tmp_path / "ks", *words).ok()
    sros("create_enclave", tmp_path / "ks", "/a").ok()
    described = json.loads(sros("inspect", tmp_path / "ks", "--json").ok().out)
    (enclave,) = described["enclaves"]
    assert enclave["domains"] == "1,3,10-12"
    assert enclave["loadable"] is True
    # As `verify` says it: that of the permissions, which is before that of the certificate.
    verified = json.loads(sros("verify", tmp_path / "ks", "--json").out)["enclaves"][0]
    assert enclave["expires"] == verified["valid_until"] < enclave["valid_until"]
    for place in ("ks", "ks/enclaves/a"):
        shown = sros("inspect", tmp_path / place).ok().out
        assert f"expires {enclave['expires']}" in shown
    assert f"certificate expires {enclave['valid_until']}\n" in shown
    assert (
        described["authorities"]["identity"]["subject"]
        == (described["authorities"]["permissions"]["subject"])
    )
    assert (tmp_path / "ks/private/identity_ca.key.pem").is_symlink()


def test_a_document_without_the_signature_that_was_asked_for_is_a_no(
    keystore: Path, tmp_path: Path
) -> None:
    clear, signed = keystore / "enclaves/governance.xml", keystore / "enclaves/governance.p7s"
    authority = keystore / "public/permissions_ca.cert.pem"
    assert sros("inspect", signed, "--ca", authority).status == 0
    assert sros("inspect", clear).status == 0
    refused = sros("inspect", clear, "--ca", authority)
    assert refused.status == 1 and "not signed" in refused.out
    signed.write_bytes(clear.read_bytes())
    assert sros("inspect", signed).status == 1
    for path in (keystore, authority, keystore / "enclaves/a", keystore / "enclaves/a/key.pem"):
        assert sros("inspect", path).status == 0 or path.is_dir()
        ignored = sros("inspect", path, "--ca", authority)
        assert ignored.status == 2 and "--ca applies only to signed documents" in ignored.err


def test_create_permission_replaces_and_says_so(keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text({"/a": publish("new"), "/b": publish("new")}))
    key = (keystore / "enclaves/a/key.pem").read_bytes()
    ended = sros("create_permission", keystore, "/a", tmp_path / "p.xml").ok()
    assert ended.out == "replaced the permissions of enclave /a\n"
    again = sros("create_permission", keystore, "/a", tmp_path / "p.xml").ok()
    assert again.out == "signed the permissions of enclave /a again, with the same rights\n"
    assert topics_of(keystore / "enclaves/a") == {"rt/new", "ros_discovery_info"}
    assert "rt/new" not in topics_of(keystore / "enclaves/b")
    assert (keystore / "enclaves/a/key.pem").read_bytes() == key


def test_generate_artifacts_tells_each_enclave(keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text({"/a": publish("new"), "/c": publish("new")}))
    (keystore / "enclaves/b/governance.p7s").unlink()
    ended = sros("generate_artifacts", "-k", keystore, "-e", "/b", "/d", "-p", tmp_path / "p.xml")
    assert set(ended.ok().out.splitlines()) == {
        "replaced the permissions of enclave /a",
        "completed enclave /b",
        "created enclave /c",
        "created enclave /d",
    }
    assert (keystore / "enclaves/b/governance.p7s").exists()


def test_lost_permissions_are_said_to_be_replaced_by_the_default_ones(keystore: Path) -> None:
    sros("create_enclave", keystore, "/c").ok()  # never has other rights than the default ones
    for name in "ac":
        (keystore / f"enclaves/{name}/permissions.p7s").unlink()
    ended = sros("create_enclave", keystore, "/a", "/c").ok()
    assert ended.out == "completed enclave /a\ncompleted enclave /c\n"
    assert "no longer the rights of its policy" in ended.err
    assert f"`sros create_permission {keystore} /a POLICY`" in ended.err and "/c" not in ended.err


def test_a_lost_certificate_is_issued_for_the_same_key(keystore: Path) -> None:
    folder = keystore / "enclaves/a"
    (folder / "cert.pem").unlink()
    before = (folder / "permissions.p7s").read_bytes()
    sros("create_enclave", keystore, "/a").ok()
    assert (folder / "permissions.p7s").read_bytes() == before
    check_whole(keystore)
    sros("env", keystore, "/a").ok()


def test_list_enclaves_as_json(keystore: Path) -> None:
    listed = json.loads(sros("list_enclaves", keystore, "--json").ok().out)
    named = {"enclaves": ["/a", "/b"], "hidden": []}
    assert listed == {"version": 1, "keystore": str(keystore), **named}


def test_exports_repeat_byte_by_byte(keystore: Path, tmp_path: Path) -> None:
    for name in ("1", "2"):
        sros("distribute_key", keystore, "/a", tmp_path / name).ok()
        sros("distribute_key", keystore, "/a", tmp_path / f"{name}.tar.gz").ok()
        time.sleep(0.01)
    assert snapshot(tmp_path / "1") == snapshot(tmp_path / "2")
    assert (tmp_path / "1.tar.gz").read_bytes() == (tmp_path / "2.tar.gz").read_bytes()
    exported = snapshot(tmp_path / "1")
    assert not [path for path, (mode, _) in exported.items() if stat.S_ISLNK(mode)]
    assert not [path for path in exported if PRIVATE in path or "/b" in path]
    ca_keys = [path.read_bytes().strip() for path in (keystore / PRIVATE).glob("*.key.pem")]
    files = [path.read_bytes() for path in (tmp_path / "1").rglob("*") if path.is_file()]
    assert ca_keys and not [key for key in ca_keys for file in files if key in file]
    shutil.rmtree(keystore)
    (tmp_path / "robot").mkdir()
    # As on a robot; Python's own way differs between its minor versions.
    run(["tar", "-xzf", tmp_path / "1.tar.gz", "-C", tmp_path / "robot"])
    assert snapshot(tmp_path / "robot").keys() == exported.keys()
    for place in ("robot", "1"):
        sros("env", tmp_path / place, "/a").ok()
    key = tmp_path / "robot/enclaves/a/key.pem"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600


def test_an_export_grows_and_is_replaced_on_request_only(keystore: Path, tmp_path: Path) -> None:
    target = tmp_path / "out"
    sros("distribute_key", keystore, "/a", target).ok()
    sros("distribute_key", keystore, "/b", target).ok()
    assert sros("list_enclaves", target).ok().out.split() == ["/a", "/b"]
    assert "already up to date" in sros("distribute_key", keystore, "/a", target).ok().err
    (tmp_path / "p.xml").write_text(policy_text({"/a": publish("new")}))
    sros("create_permission", keystore, "/a", tmp_path / "p.xml").ok()
    before = snapshot(target)
    assert sros("distribute_key", keystore, "/a", target).status == 2
    assert snapshot(target) == before
    assert "replaced" in sros("distribute_key", keystore, "/a", target, "--force").ok().err
    assert "rt/new" in topics_of(target / "enclaves/a")
    assert not remains(tmp_path)


INSPECTED = {
    "": "keystore",
    "enclaves/a": "enclave",
    "enclaves/a/cert.pem": "certificate",
    "enclaves/a/key.pem": "private key",
    "enclaves/a/permissions.p7s": "permissions",
    "enclaves/a/permissions.xml": "permissions",
    "enclaves/governance.p7s": "governance",
    "enclaves/governance.xml": "governance",
    "public/identity_ca.cert.pem": "certificate",
}


@pytest.mark.parametrize("path", INSPECTED)
def test_inspect(path: str, keystore: Path) -> None:
    described = json.loads(sros("inspect", keystore / path, "--json").ok().out)
    assert described["kind"] == INSPECTED[path]
    said = sros("inspect", keystore / path).ok().out
    assert "BEGIN" not in said, "keys are not shown"
    if path.endswith(".p7s"):
        assert described["signature_verified"] is True
    if path.endswith("a/permissions.p7s"):
        (grant,) = described["grants"]
        assert grant["rules"][0]["rights"]["topics"] == {"publish": ["/old_a"]}
        assert "publish topics: /old_a" in said


def test_inspect_shows_trouble(keystore: Path, tmp_path: Path) -> None:
    document = keystore / "enclaves/a/permissions.p7s"
    document.write_bytes(document.read_bytes().replace(b"old_a", b"new_a"))
    for path in (document, keystore / "enclaves/a", keystore):
        ended = sros("inspect", path)
        assert ended.status == 1
        assert "does not match" in ended.out
    other = keystore / "public/identity_ca.cert.pem"
    assert sros("inspect", keystore / "enclaves/b/permissions.p7s", "--ca", other).status == 1
    shutil.copy(keystore / "enclaves/b/permissions.p7s", tmp_path)
    assert "not verified" in sros("inspect", tmp_path / "permissions.p7s").ok().out


@pytest.mark.parametrize("ends", [timedelta(days=1), timedelta(days=-1)])
def test_inspect_with_a_ca_that_has_expired(
    ends: timedelta, keystore: Path, tmp_path: Path
) -> None:
    now, key = datetime.now(UTC), generate_key()
    ca = issue_ca(key, common_name("CA"), Window(now - timedelta(days=9), now + ends))
    document = (keystore / "enclaves/governance.xml").read_bytes()
    (tmp_path / "ca.pem").write_bytes(pem(ca))
    (tmp_path / "governance.p7s").write_bytes(smime.sign(document, ca, key))
    ended = sros("inspect", tmp_path / "governance.p7s", "--ca", tmp_path / "ca.pem")
    assert ended.status == (0 if ends > timedelta() else 1), ended
    assert ("CN=CA expired at" in ended.out) is (ends < timedelta())


@pytest.mark.parametrize(
    "date", ["9999-12-31T23:59:59-14:00", "0001-01-01T00:00:00+14:00", "2020-02-30T00:00:00", ""]
)
def test_inspect_of_a_date_at_the_end_of_time(date: str, keystore: Path, tmp_path: Path) -> None:
    document = (keystore / "enclaves/a/permissions.xml").read_text()
    start, end = document.index("<not_after>"), document.index("</not_after>")
    (tmp_path / "p.xml").write_text(document[:start] + f"<not_after>{date}" + document[end:])
    ended = sros("inspect", tmp_path / "p.xml")
    assert ended.status == 2
    assert "defect" not in ended.err


def test_policies_are_listed_and_copied(tmp_path: Path) -> None:
    listed = sros("policies").ok().out
    assert "/talker_listener/talker" in listed
    as_json = json.loads(sros("policies", "--json").ok().out)["policies"]
    assert len(as_json) == len(listed.splitlines())
    sros("policies", "--copy", tmp_path / "mine").ok()
    assert snapshot(tmp_path / "mine") == snapshot(policies_dir())
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", tmp_path / "mine/fibonacci.xml").ok()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion(shell: str) -> None:
    assert "_SROS_COMPLETE" in sros("completion", shell).ok().out


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("env {} /", "/a /b"),
        ("explain {} /a pub", "publish"),
        ("explain {} /a publish /old", "/old_a /old_b"),
        ("explain {} --who publish /old", "/old_a /old_b"),
        ("explain {} /a publish /x", ""),
        ("explain {}/nothing /a publish /", ""),
        ("create_k", "create_keystore"),
        ("create-", "create-keystore create-enclave create-permission create-request"),
        ("export", "export_enclave"),
        ("nope", ""),
    ],
)
def test_completion_of_words(words: str, wanted: str, keystore: Path) -> None:
    line = "sros " + words.replace("{}", str(keystore))
    environment = {
        **os.environ,
        "_SROS_COMPLETE": "bash_complete",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split()) - 1),
    }
    ended = forked(env=environment)
    assert ended.out.replace("plain,", "").split() == wanted.split(), ended


@pytest.mark.parametrize("words", ["env {} /", "explain {} /"])
def test_no_completion_is_a_command(words: str, keystore: Path) -> None:
    """Bash would run it with the rest of the line."""
    for name in ("$(reboot)", "`reboot`"):
        copy_of(keystore / "enclaves/a", keystore / "enclaves" / name)
    line = "sros " + words.replace("{}", str(keystore))
    number = str(len(line.split(" ")) - 1)
    environment = {"_SROS_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": number}
    found = forked(env={**os.environ, **environment}).out
    assert "plain,/a\n" in found
    assert "reboot" not in found


# ── env and run ────────────────────────────────────────────────────────────────────────────


def variables(keystore: Path, domain: int = 0) -> dict[str, str]:
    return {
        "ROS_SECURITY_KEYSTORE": str(keystore),
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_ENCLAVE_OVERRIDE": "/a",
        "ROS_DOMAIN_ID": str(domain),
    }


def test_env_says_that_a_distribution_is_none(keystore: Path) -> None:
    note = "note [distribution.unknown]: ROS_DISTRO is 'jazy', which sros does not know"
    assert note in sros("env", keystore, "/a", env={"ROS_DISTRO": "jazy"}).ok().err
    assert note not in sros("env", keystore, "/a", env={"ROS_DISTRO": "jazzy"}).ok().err


def test_env_in_every_form(keystore: Path) -> None:
    wanted = variables(keystore)
    assert json.loads(sros("env", keystore, "/a", "--json").ok().out)["variables"] == wanted
    assert json.loads(sros("env", keystore, "/a", "--format", "json").ok().out) == wanted
    docker = sros("env", keystore, "/a", "--format", "docker").ok().out
    assert dict(line.split("=", 1) for line in docker.splitlines()) == wanted
    for form, start in (("sh", "export "), ("fish", "set -gx "), ("systemd", "Environment=")):
        said = sros("env", keystore, "/a", "--format", form).ok().out
        assert len(said.splitlines()) == len(wanted)
        assert all(line.startswith(start) for line in said.splitlines())


@pytest.mark.parametrize("mode", some([0o644, 0o640, 0o604, 0o620], 2))
def test_no_process_starts_with_a_key_that_others_can_read(mode: int, keystore: Path) -> None:
    key = keystore / "enclaves/a/key.pem"
    key.chmod(mode)
    marker = keystore.parent / "ran"
    refused = sros("run", keystore, "/a", "--", "touch", marker)
    assert refused.status == 2, refused
    assert f"'{key}' is {mode:04o}" in refused.err
    assert "To run the process nevertheless, add --accept-readable-key." in refused.err
    observer = sros("audit", "p.xml", "--keystore", keystore, "--enclave", "/a")
    assert observer.status == 2 and "Run `chmod 600" in observer.err
    assert "--accept-readable-key" not in observer.err, "this verb has no such option"
    assert sros("env", keystore, "/a").out == render_refusal("sh")
    accepted = sros("env", keystore, "/a", "--accept-readable-key", "--json").ok()
    assert json.loads(accepted.out)["variables"] == variables(keystore)
    forked("run", keystore, "/a", "--accept-readable-key", "--", "touch", marker).ok()
    marker.unlink()
    export = keystore.parent / "export"
    sros("distribute_key", keystore, "/b", export).ok()
    (export / "enclaves/b/key.pem").chmod(mode)
    of_export = sros("run", export, "/b", "--", "true").err  # it has no CA keys
    assert "CA keys: `sros renew KEYSTORE /b --new-key --revoke-old`. Then export" in of_export
    fix, replace = re.findall("`(.+?)`", refused.err)
    run(["sh", "-c", fix])
    forked("run", keystore, "/a", "--", "touch", marker).ok()
    assert marker.exists()
    sros(*shlex.split(replace)[1:]).ok()


@pytest.mark.parametrize("place", ["", "enclaves", "enclaves/a"])
def test_no_process_starts_with_files_that_others_can_replace(place: str, keystore: Path) -> None:
    folder = keystore / place
    before = stat.S_IMODE(folder.stat().st_mode)
    folder.chmod(before | 0o022)
    marker = keystore.parent / "ran"
    command = (keystore, "/a", "--", "touch", marker)
    refused = sros("run", *command)
    assert (refused.status, marker.exists()) == (2, False)
    assert f"'{folder}': its mode is {before | 0o022:04o}, so everybody can write" in refused.err
    assert sros("env", keystore, "/a").out == render_refusal("sh")
    forked("run", "--accept-readable-key", *command).ok()
    marker.unlink()
    run(["sh", "-c", re.findall("`(chmod .+?)`", refused.err)[0]])
    forked("run", *command).ok()
    assert marker.exists()


def test_the_command_names_no_other_enclave(keystore: Path) -> None:
    marker = keystore.parent / "ran"
    command = ("--", "touch", marker, "--ros-args")
    for option in ("--enclave", "-e"):
        refused = sros("run", keystore, "/a", *command, option, "/other")
        assert (refused.status, marker.exists()) == (2, False)
        assert (
            "the command names the enclave /other, but sros would run the command in /a"
            in refused.err
        )


def test_permissions_that_fast_dds_takes_for_expired_here_start_nothing(tmp_path: Path) -> None:
    """Fast DDS reads dates in local time: in Tokyo, the last nine hours have passed."""
    words = ("--permissions-validity", "5h", "--template", "development")
    sros("create_keystore", tmp_path / "ks", *words).ok()
    sros("create_enclave", tmp_path / "ks", "/a").ok()
    fast, cyclone = ({"RMW_IMPLEMENTATION": f"rmw_{n}_cpp"} for n in ("fastrtps", "cyclonedds"))
    for zone in ("Asia/Tokyo", "Australia/Sydney"):
        refused = sros("env", tmp_path / "ks", "/a", env={**fast, "TZ": zone})
        assert (refused.status, refused.out) == (2, render_refusal("sh"))
        assert "cannot run in enclave /a in this time zone" in refused.err
        assert "`TZ=UTC`" in refused.err and "--set permissions.validity=2d" in refused.err
        sros("env", tmp_path / "ks", "/a", env={**cyclone, "TZ": zone}).ok()
    for zone in ("UTC", "America/Los_Angeles"):
        sros("env", tmp_path / "ks", "/a", env={**fast, "TZ": zone}).ok()


def test_env_of_a_path_that_a_form_cannot_hold(tmp_path: Path) -> None:
    root = tmp_path / "a\nb"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/a").ok()
    for form in ("docker", "systemd"):
        assert sros("env", root, "/a", "--format", form).status == 2
    shown = json.loads(sros("env", root, "/a", "--json").ok().out)
    assert shown["variables"] == variables(root)


@pytest.mark.parametrize(
    ("domains", "option", "environment", "chosen"),
    [
        ("0,7", None, None, "0"),
        ("0,7", "7", None, "7"),
        ("0,7", None, "7", "7"),
        ("0,7", "0", "7", "0"),
        ("0,7", None, "", "0"),
        ("5-9", None, None, "5"),
        ("5-9", None, "6", "6"),
        ("230", None, None, "230"),
    ],
)
def test_the_domain_of_a_process(
    domains: str, option: str | None, environment: str | None, chosen: str, tmp_path: Path
) -> None:
    sros("create_keystore", tmp_path / "ks", "--domain", domains).ok()
    sros("create_enclave", tmp_path / "ks", "/a").ok()
    words = ["--domain", option] if option else []
    env = {"ROS_DOMAIN_ID": environment}
    said = sros("env", tmp_path / "ks", "/a", *words, "--json", env=env).ok().out
    assert json.loads(said)["variables"]["ROS_DOMAIN_ID"] == chosen


def test_the_domain_of_a_process_is_one_that_its_permissions_allow(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--domain", "7").ok()
    sros("create_enclave", root, "/a").ok()
    permissions = (root / "enclaves/a/permissions.p7s").read_bytes()
    sros("update_keystore", root, "--domain", "0,7", "--allow-looser").ok()
    assert json.loads(sros("env", root, "/a", "--json").ok().out)["variables"][DOMAIN] == "0"
    (root / "enclaves/a/permissions.p7s").write_bytes(permissions)
    assert json.loads(sros("env", root, "/a", "--json").ok().out)["variables"][DOMAIN] == "7"
    assert sros("env", root, "/a", "--domain", "0").status == 2


SHOW = """
import json, os, signal
ignored = [s for s in signal.Signals if signal.getsignal(s) == signal.SIG_IGN]
print(json.dumps([dict(os.environ), os.getcwd(), [i.name for i in ignored]]))
"""


def test_run_executes_in_exactly_that_environment(keystore: Path, tmp_path: Path) -> None:
    forked("run", "ks", "/a", "--", "env", "-i", "sh", "-c", "true", cwd=tmp_path).ok()
    wrong = {"ROS_SECURITY_ENABLE": "false", "ROS_SECURITY_KEYSTORE": "/nowhere", "MINE": "1"}
    environment = {**os.environ, **wrong}
    command = [*PROGRAM, "run", "ks", "/a", "--", sys.executable, "-c", SHOW]
    seen, folder, ignored = json.loads(run(command, cwd=tmp_path, env=environment).stdout)
    wanted = {**environment, **variables(keystore)}
    # Python sets them for itself: without a locale, or with the wheels of ROS in its environment.
    for name in ("LC_CTYPE", "LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"):
        seen.pop(name, None)
        wanted.pop(name, None)
    assert seen == wanted
    assert folder == str(tmp_path)
    # Those that the new Python itself ignores; a command without Python sees none.
    assert set(ignored) <= {"SIGPIPE", "SIGXFSZ"}
    words = ("run", "ks", "/a", "--", "grep", "SigIgn", "/proc/self/status")
    said = forked(*words, cwd=tmp_path).ok().out
    assert int(said.split()[1], 16) == 0


def test_run_names_the_enclave_of_a_ros_node(keystore: Path, tmp_path: Path) -> None:
    node = tmp_path / "lib/arm/driver"
    for path, text in ((tmp_path / "share/arm/package.xml", "<package/>"), (node, "echo $*")):
        path.parent.mkdir(parents=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
    node.chmod(0o755)
    done = forked("run", keystore, "/a", "--", node, "--fast").ok()
    assert done.out == "--fast --ros-args --enclave /a\n"
    assert done.err.startswith("added --ros-args --enclave /a, so that the ROS graph shows")
    words = (node, "--ros-args", "-r", "__ns:=/other")
    done = forked("run", "--no-ros-args", keystore, "/a", "--", *words).ok()
    assert done.out == "--ros-args -r __ns:=/other\n"
    assert done.err.startswith("note [run.other-node]: the command starts a node in the namespace")


@pytest.mark.parametrize(
    ("words", "out", "status"),
    [
        (["--", "sh", "-c", "exit 7"], "", 7),
        (["--", "sh", "-c", "echo $1", "sh", "--"], "--\n", 0),
        (["echo", "x"], "x\n", 0),
        (["--", "echo", "--domain", "9"], "--domain 9\n", 0),
        (["--", "printf", "%s", "--help"], "--help", 0),
        (["--", "echo", "--", "-x"], "-- -x\n", 0),
        (["--", "sh", "-c", "kill -TERM $$"], "", -signal.SIGTERM),
        (["--", "./here"], "here\n", 0),
    ],
)
def test_run_hands_everything_on(
    words: list[str], out: str, status: int, keystore: Path, tmp_path: Path
) -> None:
    (tmp_path / "here").write_text("#!/bin/sh\necho here\n")
    (tmp_path / "here").chmod(0o755)
    ended = forked("run", keystore, "/a", *words, cwd=tmp_path)
    assert (ended.status, ended.out) == (status, out), ended


def test_a_reader_that_goes_away_is_no_trouble(keystore: Path) -> None:
    script = '"$@" | head -c 1'
    command = ["sh", "-c", script, "sh", *PROGRAM, "run", str(keystore), "/a", "--", "yes"]
    ended = run(command)
    assert (ended.stdout, ended.stderr) == ("y", "")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_polite_end_leaves_nothing(number: signal.Signals, keystore: Path) -> None:
    before = snapshot(keystore.parent)
    names = [f"/n{index}" for index in range(400)]
    process = Running("create_enclave", keystore, *names)
    wait_for(lambda: remains(keystore), "the stage of a transaction")
    process.send_signal(number)
    ended = process.end()
    assert ended.status == (143 if number == signal.SIGTERM else 130)
    assert "Traceback" not in ended.err
    assert snapshot(keystore.parent) == before


def test_the_root_of_the_file_system_is_no_keystore() -> None:
    for words in (("create_keystore", "/"), ("generate_artifacts", "-k", "/", "-e", "/a")):
        ended = sros(*words)
        assert ended.status == 2, ended
        assert "root of the file system" in ended.err


def test_a_clock_behind_the_keystore_is_said_of_what_seems_valid(tmp_path: Path) -> None:
    root, behind = tmp_path / "ks", "of this machine shows"
    create_keystore(root, template=load_template("development"), now=datetime.now(UTC))
    create_enclaves(root, ["/a"], now=datetime.now(UTC))
    asked = (
        ("explain", root, "/a", "join"),
        ("inspect", root),
        ("renew", root, "--all-expiring", "30d"),
    )
    due = ("check", root, "--needs-renewal", "30d")
    for words in (*asked, due):
        assert behind not in sros(*words).ok().err
    assert "keystore.clock-behind" not in sros("check", root).out
    later = datetime.now(UTC) + timedelta(days=2)
    create_enclaves(root, ["/b"], now=later)
    for words in (*asked, due):
        assert behind in sros(*words).err
    assert sros(*due).status == 2
    assert "keystore.clock-behind" in sros("check", root).out
    # Or the clock was ahead at the last change, which an entry with the right time ends.
    said = sros("crl", root, "--refresh").err
    assert "If it is right, it was ahead at the last change" in said
    assert f"`sros check {root}` names them; renew them." in said
    assert f"`sros renew {root} /b`" in sros("check", root).out
    assert behind not in sros(*due).ok().err
    create_enclaves(root, ["/c"], now=later)
    (root / "ledger.jsonl").unlink()
    assert behind not in sros(*asked[0]).ok().err
