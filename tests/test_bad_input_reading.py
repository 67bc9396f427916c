"""Hostile input to the verbs that read ends in time, in one paragraph, and steers no terminal."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from lxml import etree

from sros_tool.cli.common import MAX_LOG
from sros_tool.dds.decision.expressions import matches
from sros_tool.dds.decision.vendors import Style
from sros_tool.terminal import visible, visible_json
from tests.support.children import PATIENCE
from tests.support.harness import copy_of, policy_text, publish, snapshot, sros
from tests.support.long_form import some
from tests.test_bad_input import NOT_FILES, check_refused, check_unchanged

ESCAPES = ("\x1b", "\x9b", "\x07", "\u202e")
DENIED = "rt/secret topic not found in allow rule. Writer is not allowed"
POLICY = policy_text({"/a": publish("good")})


@pytest.fixture(autouse=True)
def in_time() -> Iterator[None]:
    """What takes longer than this has been made to hang, even on a busy machine."""

    def too_long(*_: object) -> None:
        raise AssertionError("it hangs")

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(int(PATIENCE))
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


# ── files ──────────────────────────────────────────────────────────────────────────────────

READERS: dict[str, Callable[[Path, Path], list[object]]] = {
    "check --needs-renewal": lambda path, _: ["check", path, "--needs-renewal", "30d"],
    "check --policy": lambda path, keystore: ["check", keystore, "--policy", path],
    "explain --policy": lambda path, _: ["explain", "--policy", path, "/a", "publish", "/good"],
    "explain": lambda path, _: ["explain", path, "/a", "publish", "/good"],
    "view": lambda path, _: ["view", path],
    "view --observed": lambda path, keystore: ["view", keystore, "--observed", path],
    "demo --scenario": lambda path, _: ["demo", "--scenario", path],
    "demo --keystore": lambda path, _: ["demo", "--scenario", "attacks", "--keystore", path],
    "import --ca": lambda path, _: ["import", path, path.with_name("robot"), "--ca", path],
    "crl": lambda path, _: ["crl", path],
}


@pytest.mark.parametrize(
    ("verb", "kind"),
    some([(verb, kind) for verb in READERS for kind in NOT_FILES if kind != "below a file"], 40),
)
def test_file(verb: str, kind: str, keystore: Path, tmp_path: Path) -> None:
    path = tmp_path / ("file.toml" if verb == "demo --scenario" else "file.xml")
    NOT_FILES[kind][0](path)
    before = snapshot(tmp_path)
    check_refused(sros(*READERS[verb](path, keystore)), "")
    check_unchanged(tmp_path, before)


# ── logs ───────────────────────────────────────────────────────────────────────────────────


def _huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(MAX_LOG + 1)


NOT_LOGS: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "does not exist"),
    "a folder": (Path.mkdir, "directory"),
    "/dev/zero": (lambda path: path.symlink_to("/dev/zero"), "neither a file nor a pipe"),
    "too large": (_huge, "too large"),
    "a link to itself": (lambda path: path.symlink_to(path), ""),
}
NOT_LOGS["a pipe without a writer"] = (os.mkfifo, "nobody writes to")
LOG_VERBS = {
    "explain": ["explain", "--log"],
    "generate_policy": ["generate_policy", "--enclave", "/e", "--node", "/n", "--from-log"],
}


@pytest.mark.parametrize("verb", LOG_VERBS)
@pytest.mark.parametrize("kind", NOT_LOGS)
def test_what_is_no_log(
    verb: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sros_tool.cli.common._WRITER_TIMEOUT", 0.2)
    make, why = NOT_LOGS[kind]
    make(tmp_path / "log")
    check_refused(sros(*LOG_VERBS[verb], tmp_path / "log"), why)


@pytest.mark.parametrize("late", [False, True])
def test_a_named_pipe_whose_writer_comes(
    late: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The writer opens the pipe after sros, which found nobody; then it may write at once."""
    monkeypatch.setattr("sros_tool.cli.common._WRITER_TIMEOUT", PATIENCE)
    pipe = tmp_path / "log"
    os.mkfifo(pipe)

    def write() -> None:
        with pipe.open("wb", buffering=0) as stream:  # waits for the reader
            if late:
                time.sleep(0.2)
            stream.write(DENIED.encode())

    writer = threading.Thread(target=write)
    writer.start()
    ended = sros("explain", "--log", pipe)
    writer.join()
    assert "secret" in ended.out, ended


@pytest.mark.parametrize("log", ["-", "/dev/zero"])
def test_a_log_without_end(log: str) -> None:
    """It must neither be waited for, nor fill the memory."""
    with Path("/dev/zero").open("rb") as endless:
        ended = subprocess.run(
            [sys.executable, "-m", "sros_tool", "explain", "--log", log],
            stdin=endless,
            capture_output=True,
            text=True,
            check=False,
        )
    assert (ended.returncode, ended.stdout) == (2, "")
    assert f"the log '{log}' is" in ended.stderr


@pytest.mark.parametrize("verb", LOG_VERBS)
def test_a_log_from_a_pipe(verb: str, tmp_path: Path) -> None:
    """As ``--log <(journalctl)`` gives it."""
    reading, writing = os.pipe()
    os.write(writing, DENIED.encode())
    os.close(writing)
    try:
        ended = sros(*LOG_VERBS[verb], f"/dev/fd/{reading}")
    finally:
        os.close(reading)
    assert "secret" in ended.out, ended


LOGS: dict[str, Callable[[], str]] = {
    "one long word": lambda: "a" * 1_000_000,
    "one long word with marks": lambda: ("a" * 100 + ".-" * 200_000 + "\n") * 3,
    "a label that never ends": lambda: "[" + "-1" * 300_000 + "\na" + " " * 300_000,
    "many denials": lambda: "\n".join(
        f"rt/t{n} topic not found in allow rule" for n in range(8000)
    ),
    "many odd denials": lambda: "\n".join(
        f"rt/t;{n}! topic not found in allow rule" for n in range(8000)
    ),
    "an error stack without end": lambda: (
        "Failed to parse certificate: \n" * 2 + "(code: 145) " * 9
    ),
    "continued for ever": lambda: "x\n" + "(code: 1) Failed to parse certificate: \n" * 100_000,
    "one mark again and again": lambda: "Failed to parse certificate: " * 100_000,
}
"""Logs of a megabyte, each made only when it is tried."""


@pytest.mark.parametrize(
    ("verb", "case"), some([(verb, case) for verb in LOG_VERBS for case in LOGS], 2)
)
def test_a_log_that_takes_long(verb: str, case: str, tmp_path: Path) -> None:
    (tmp_path / "log").write_text(f"{LOGS[case]()}\n{DENIED}\n")
    ended = sros(*LOG_VERBS[verb], tmp_path / "log")
    assert "secret" in ended.out, ended.err
    assert "Traceback" not in ended.err


def test_a_topic_with_marks_is_told_by_its_lines(tmp_path: Path) -> None:
    lines = ["rt/a-b topic denied by deny rule", "about rt/a-b", "about rt/a-bc, rt/a", ""]
    (tmp_path / "log").write_text("\n".join(lines))
    ended = sros("explain", "--log", tmp_path / "log", "--json")
    assert [(each["line"], each["count"]) for each in json.loads(ended.out)["findings"]] == [(1, 2)]


# ── names that steer a terminal ────────────────────────────────────────────────────────────


def check_tame(text: str) -> None:
    assert not [each for each in ESCAPES if each in text], text


def test_a_log_with_escapes(tmp_path: Path) -> None:
    evil = "rt/\x1b]0;evil\x07\x9b2J\u202ex topic not found in allow rule. create publisher"
    (tmp_path / "log").write_text(evil)
    told = sros("explain", "--log", tmp_path / "log")
    assert "\\x1b]0;evil\\x07\\x9b2J\\u202ex" in told.out
    document = sros("explain", "--log", tmp_path / "log", "--json").out
    proposed = sros("generate_policy", "--from-log", tmp_path / "log")
    for text in (told.out, document, proposed.out, proposed.err):
        check_tame(text)
    assert "\x9b2J\u202ex" in json.loads(document)["findings"][0]["text"]


@pytest.mark.parametrize(
    "line",
    [
        "check {policy}",
        "check {broken}",
        "check {policy} --json",
        "view {broken}",
        "explain --policy {broken} /a publish /x",
        "explain --policy {policy} /a publish /good",
        "explain --policy {policy} /a publish /other",
        "explain {keystore} --reach {evil}",
        "inspect {evil}",
        "demo --scenario {evil}",
    ],
)
def test_a_file_name_with_escapes(line: str, keystore: Path, tmp_path: Path) -> None:
    evil = tmp_path / "p\x1b]0;x\x07\x9b2J\u202e.xml"
    broken = evil.with_suffix(".broken.xml")
    evil.write_text(POLICY)
    broken.write_text("<policy")
    named = {"policy": evil, "broken": broken, "keystore": keystore, "evil": "/\x1b\x9b\u202e"}
    ended = sros(*(word.format(**named) for word in line.split()))
    check_tame(ended.out + ended.err)
    assert "\\x1b" in ended.out + ended.err or "\\u001b" in ended.out, "it was not even named"


ODD = "x\x1b]0;x\x07\x9b2J\u202e\nok: nothing found"
"""A name that steers a terminal, and forges a line."""


@pytest.mark.parametrize(
    "line",
    [
        "list_enclaves ks",
        "verify ks",
        "check ks --format markdown",
        "inspect ks",
        "metrics ks",
        "view ks --format dot",
        "view ks --format svg",
        "view ks --format mermaid",
        "view ks --format html",
        "view router.json5 --format svg",
        "view router.json5 --format dot",
        "zenoh --from router.json5",
        "complete ks /",
    ],
)
def test_a_folder_with_escapes(line: str, keystore: Path, tmp_path: Path) -> None:
    """Enclaves and common names with escapes steer no terminal, also by way of a file."""
    odd = keystore / "enclaves" / ODD
    copy_of(keystore / "enclaves/a", odd)
    router = {
        "mode": "router",
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {
                    "id": "r",
                    "permission": "allow",
                    "flows": ["ingress"],
                    "messages": ["put", "delete", "reply"],
                    "key_exprs": ["0/good/*/*"],
                }
            ],
            "subjects": [{"id": "s", "cert_common_names": [ODD, "/b"]}],
            "policies": [{"rules": ["r"], "subjects": ["s"]}],
        },
    }
    (tmp_path / "router.json5").write_text(json.dumps(router))
    if line == "complete ks /":
        words = {
            "_SROS_COMPLETE": "bash_complete",
            "COMP_WORDS": "sros env ks /",
            "COMP_CWORD": "3",
        }
        ended = sros(cwd=tmp_path, env=words)
        assert "plain,/a" in ended.out, ended
    else:
        ended = sros(*line.split(), cwd=tmp_path)
    assert "defect" not in ended.err, ended.err
    check_tame(ended.out + ended.err)
    assert not re.search("^ok: nothing", ended.out + ended.err, re.MULTILINE)
    if line.endswith("svg"):
        etree.fromstring(ended.out.encode())


def test_visible() -> None:
    assert visible("a\tb\nc é 漢") == "a\tb\nc é 漢"
    assert visible("\r\x1b[1m\x7f\x85\u2066") == "\\x0d\\x1b[1m\\x7f\\x85\\u2066"
    value = {"a\x9b": "\x7f\u202e\x1b"}
    document = visible_json(json.dumps(value, ensure_ascii=False))
    check_tame(document)
    assert json.loads(document) == value


# ── patterns ───────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("style", Style)
def test_many_stars(style: Style) -> None:
    stars, name = "*a" * 40 + "*b", "a" * 250
    assert not matches(style, stars, name)
    assert matches(style, stars, name + "b")


@pytest.mark.parametrize("question", ["/a publish {name} --all-vendors", "--reach /a"])
def test_many_stars_in_a_policy(question: str, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text({"/a": publish("/" + "*a" * 30 + "*b")}))
    words = question.format(name="/" + "a" * 200).split()
    ended = sros("explain", "--policy", tmp_path / "p.xml", *words)
    assert ended.status in (0, 1)
    assert "Traceback" not in ended.err
    for verb in ("check", "view"):
        assert sros(verb, tmp_path / "p.xml").status in (0, 1)


# ── places to write to ─────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("option", ["--summary", "--report"])
def test_demo_refuses_a_place_before_it_runs(option: str, tmp_path: Path) -> None:
    words = ["demo", "--scenario", "governance", "--only", "nothing is named so"]
    check_refused(sros(*words, option, tmp_path / "none" / "page"), "Its folder does not exist.")
    with_folder = sros(*words, option, tmp_path)
    check_refused(with_folder, "It is a folder.")
    check_refused(sros(*words, option, ""), "the path is empty")
    (tmp_path / "mine").write_text("precious")
    check_refused(sros(*words, option, tmp_path / "mine"), "already exists")
    assert (tmp_path / "mine").read_text() == "precious"
    for_all = [*words, "--force", option, tmp_path / "mine"]
    assert "already exists" not in sros(*for_all).err


def test_view_refuses_a_place_that_is_not_there(keystore: Path, tmp_path: Path) -> None:
    check_refused(sros("view", keystore, "-o", tmp_path / "none" / "p"), "does not exist")
    told = sros("view", keystore, "-o", tmp_path / "a\x1b[2J\x9b.html").ok()
    check_tame(told.err)
    assert "\\x1b[2J\\x9b.html" in told.err


@pytest.mark.parametrize("line", ["check {}", "check {} --sarif"])
def test_a_folder_that_is_gone(line: str, keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    command = f'cd {tmp_path}/gone && rmdir {tmp_path}/gone && exec "$0" -m sros_tool '
    ended = subprocess.run(
        ["/bin/sh", "-c", command + line.format(keystore), sys.executable],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "the working directory no longer exists" in ended.stderr


# ── TOML ───────────────────────────────────────────────────────────────────────────────────

TOMLS = {
    "nested lists": ("a=" + "[\n" * 4000 + "]\n" * 4000, "nested too deeply"),
    "nested tables": ("\n".join(["x=["] + ["{a=["] * 2000), "nested too deeply"),
    "a key of many dots": ("a" + ".a" * 50_000 + "=1", "longer than"),
    "a number of many digits": ("domain=" + "9" * 4400, "longer than"),
    "a number of many digits in lines": ("domain=" + "9" * 3990, ""),
    "too long": ("# x\n" * 100_000, "longer than 256"),
    "no such day": ("title=2027-02-30", ""),
    "a null byte in a path": ('policy="a\\u0000b"', ""),
}


@pytest.fixture
def recursion_of_a_program() -> Iterator[None]:
    """The limit that a program starts with; Hypothesis raises that of the tests' process."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(1000)
    yield
    sys.setrecursionlimit(limit)


@pytest.mark.parametrize("verb", ["demo --scenario", "demo --template", "view {} --template"])
@pytest.mark.parametrize("case", TOMLS)
@pytest.mark.usefixtures("recursion_of_a_program")
def test_toml(verb: str, case: str, tmp_path: Path) -> None:
    text, why = TOMLS[case]
    (tmp_path / "hostile.toml").write_text(text)
    (tmp_path / "policy.xml").write_text(POLICY)
    words = verb.format(tmp_path / "policy.xml").split()
    check_refused(sros(*words, tmp_path / "hostile.toml"), why)


@pytest.mark.parametrize("line", ["check NAME", "check NAME --format sarif", "check NAME --json"])
def test_a_file_name_that_is_not_utf8(line: str, tmp_path: Path) -> None:
    """Reports name it by visible escapes, and stay valid JSON: byte 0x9b is CSI to terminals."""
    name = tmp_path / os.fsdecode(b"a\x9b2J\xff.xml")
    name.write_text(policy_text({"/e": publish("x")}))
    result = sros(*(str(name) if word == "NAME" else word for word in line.split()))
    assert "defect" not in result.err, result.err
    assert not any("\udc80" <= each <= "\udcff" for each in result.out)
    if line != "check NAME":
        assert json.loads(result.out)


def test_view_of_a_name_that_is_not_utf8(tmp_path: Path) -> None:
    """It is drawn, with another character in place of the byte."""
    name = tmp_path / os.fsdecode(b"a\xff.xml")
    name.write_text(policy_text({"/e": publish("x")}))
    result = sros("view", str(name), "-o", str(tmp_path / "view.html"))
    assert result.status == 0, result.err
    assert (tmp_path / "view.html").read_bytes().decode("utf-8")


def test_a_line_feed_in_a_file_name_forges_no_line(tmp_path: Path) -> None:
    name = tmp_path / "x.xml\n\nok: 3 targets, nothing found"
    name.write_text("<policy>")
    found = sros("check", name)
    assert found.status != 0
    assert not [line for line in found.out.splitlines() if line.startswith("ok:")]
    assert "\\x0a\\x0aok" in found.out


def test_permissions_in_place_of_the_governance_are_named(keystore: Path) -> None:
    shutil.copy(keystore / "enclaves/a/permissions.p7s", keystore / "enclaves/governance.p7s")
    for words in (("inspect", keystore), ("inspect", keystore, "--json")):
        ended = sros(*words)
        assert "it is a permissions document" in ended.out
        assert not ended.err
