"""What only a terminal gets: progress that leaves nothing behind, and colors."""

from __future__ import annotations

import os
import pty
import re
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

from sros_tool.cli import common as showing
from sros_tool.cli import main
from sros_tool.files import policies_dir
from sros_tool.parallel import map_slices, tick
from sros_tool.terminal import Colored, echo, echo_document, visible_line
from tests.support.harness import sros

ERASE = "\r\x1b[K"
ESCAPE = "\x1b["


def on_terminal(work: Callable[[], object]) -> str:
    """Do work in a process whose standard output and error are a terminal; return what is there."""
    child, terminal = pty.fork()
    if child == 0:
        try:
            sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w")
            with suppress(SystemExit):
                work()
            sys.stdout.flush()
        finally:
            os._exit(0)
    said = b""
    while True:
        try:
            data = os.read(terminal, 4096)
        except OSError:  # the process has ended
            break
        if not data:
            break
        said += data
    os.close(terminal)
    os.waitpid(child, 0)
    return said.decode()


def until_drawn(label: str, total: int) -> None:
    """Work until the line was drawn twice, whatever the machine's speed."""
    with showing.progress(label, total) as step:
        assert step
        step("/a")
        line = showing._lines[0]
        for _ in range(2):
            line._drawn = False
            while not line._drawn:
                time.sleep(0.01)


def test_long_work_is_shown_and_leaves_no_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(showing, "_FIRST", 0.01)
    monkeypatch.setattr(showing, "_EVERY", 0.01)
    said = on_terminal(lambda: until_drawn("signing", 3))
    assert "signing 1 of 3 ... 0 s" in said
    assert said.endswith(ERASE)


def test_the_time_that_is_left_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_FIRST", "_EVERY", "_ESTIMATE_AFTER"):
        monkeypatch.setattr(showing, name, 0.01)

    def sign(names: Sequence[int]) -> None:
        for _ in names[:50]:
            tick()
        line = showing._lines[0]
        line._drawn = False
        while not line._drawn:
            time.sleep(0.01)

    def work() -> None:
        with showing.progress("signing"):
            time.sleep(0.02)
            map_slices(range(150), sign)

    said = on_terminal(work)
    assert re.search(r"signing 50 of 150 \.\.\. \d+ s, about \d+ s left", said), said
    assert [showing._duration_text(each) for each in (1.2, 119.4, 121, 3600)] == [
        "1 s", "119 s", "2 min", "60 min",
    ]  # fmt: skip


def test_no_page_is_written_to_a_terminal() -> None:
    """It has 150,000 characters; DOT, Mermaid and a file are shown."""
    policy = policies_dir() / "talker_listener.xml"
    said = on_terminal(lambda: main(["view", str(policy)]))
    assert "-o robot.html" in said and len(said) < 300
    assert "digraph" in on_terminal(lambda: main(["view", str(policy), "--format", "dot"]))


def test_short_work_shows_nothing() -> None:
    def work() -> None:
        with showing.progress("signing"):
            pass

    assert on_terminal(work) == ""


def test_a_question_is_not_overwritten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(showing, "_FIRST", 0.01)

    def work() -> None:
        with showing.progress("signing"), showing.without_progress():
            os.write(2, b"Passphrase: ")
            time.sleep(0.1)

    assert "signing" not in on_terminal(work).partition("Passphrase: ")[2]


def test_a_pipe_gets_no_progress(capfd: pytest.CaptureFixture[str]) -> None:
    with showing.progress("signing") as step:
        assert step is None
    assert capfd.readouterr() == ("", "")


def run(*words: object, no_color: str = "") -> str:
    def work() -> None:
        os.environ["NO_COLOR"] = no_color
        main([str(word) for word in words])

    return on_terminal(work)


def test_colors_are_for_terminals_and_can_be_turned_off(keystore: Path) -> None:
    (keystore / "enclaves/a/key.pem").chmod(0o644)
    for words, colored in (
        (("check", keystore), f"{ESCAPE}31m{ESCAPE}1merror"),
        (("verify", keystore), f"{ESCAPE}31m{ESCAPE}1merror"),
        (("explain", keystore, "/b", "publish", "/nope"), f"{ESCAPE}31m{ESCAPE}1mno{ESCAPE}0m:"),
    ):
        assert colored in run(*words)
        assert ESCAPE not in run(*words, no_color="1")
        ended = sros(*words)
        assert ESCAPE not in ended.out + ended.err


def test_a_document_is_exact_but_on_a_terminal(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    document = b"export A='\x1b]0;x\x07\x1b[31m\xff'\n"
    echo_document(document)
    echo_document(os.fsdecode(document[:21]))
    assert capsysbinary.readouterr().out == document + document[:21]
    shown = "export A='\\x1b]0;x\\x07\\x1b[31m\\xff'\r\n"
    assert on_terminal(lambda: echo_document(document)) == shown


def test_no_character_controls_a_terminal_or_reverses_a_name() -> None:
    controls = "\x00\x07\x08\r\n\x1b\x7f\x85\x9b"
    directions = "\u061c\u200e\u200f\u202a\u202e\u2066\u2069"
    for character in (*controls, *directions, "\u2028", "\u2029", "\udc9b", "\ud800", "\ufffe"):
        assert re.fullmatch(r"a\\(x|u..)[0-9a-f]{2}b", visible_line(f"a{character}b")), character
    assert visible_line("\tä中") == "\tä中"


def test_a_name_cannot_color_itself() -> None:
    said = on_terminal(lambda: echo("/a", Colored("no"), f"{ESCAPE}32myes\nforged"))
    assert said == f"/a{ESCAPE}31m{ESCAPE}1mno{ESCAPE}0m\\x1b[32myes\\x0aforged\r\n"
