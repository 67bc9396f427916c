"""SIGTERM and Ctrl-C end a verb wherever it is, in real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.children import finish, importing, python, wait_for
from tests.support.long_form import some

STATUS = {signal.SIGTERM: 143, signal.SIGINT: 130}
WAITING = {
    "explain": "explain --log {}",
    "generate_policy": "generate_policy --enclave /e --node /n --from-log {}",
}


@pytest.mark.parametrize("number", some([*STATUS], 1), ids=lambda each: each.name)
@pytest.mark.parametrize("verb", WAITING)
def test_a_verb_that_waits_for_its_input_ends(
    verb: str, number: signal.Signals, tmp_path: Path
) -> None:
    pipe = tmp_path / "log"
    os.mkfifo(pipe)
    writer = os.open(pipe, os.O_RDWR)  # otherwise the reader would find the end of the file
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "sros_tool", *WAITING[verb].format(pipe).split()],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=importing(),
        )
        wait_for(lambda: _reads(process.pid, pipe), "the pipe is read", process)
        process.send_signal(number)
        ended = finish(process, status=STATUS[number])
    finally:
        os.close(writer)
    assert "Traceback" not in ended.stderr
    assert ended.stdout == ""


def _reads(process: int, pipe: Path) -> bool:
    folder = Path(f"/proc/{process}/fd")
    try:
        return str(pipe) in {os.readlink(each) for each in folder.iterdir()}
    except OSError:
        return False  # a descriptor was closed meanwhile


BUSY = """
import os, re, signal, sys
import sros_tool.cli.program as program

def work(*words, **more):
    print("busy", flush=True)
    {work}

program.program.main = work
sys.argv = ["sros", "check"]
from sros_tool.cli import main
main()
"""
LOOPS = {
    "a regular expression": 're.match("(a|aa)+$", "a" * 100 + "b")',
    "Python": "while True: pass",
    "a lock": "import fcntl; fcntl.flock(os.open(sys.executable, 0), fcntl.LOCK_EX); "
    "fcntl.flock(os.open(sys.executable, 0), fcntl.LOCK_EX)",
}


@pytest.mark.parametrize("number", STATUS, ids=lambda each: each.name)
@pytest.mark.parametrize("loop", LOOPS)
def test_a_loop_without_end_ends(loop: str, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", BUSY.format(work=LOOPS[loop])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=importing(),
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "busy\n"
    process.send_signal(number)
    ended = finish(process, status=STATUS[number])
    assert ended.stderr == ("" if number == signal.SIGTERM else "sros: interrupted\n")


IMPORTING = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, *_):
        if name == "sros_tool.cli.program":
            os.kill(os.getpid(), signal.{name})

sys.meta_path.insert(0, Interrupt())
from sros_tool.cli import main
main()
"""


@pytest.mark.parametrize("number", STATUS, ids=lambda each: each.name)
def test_a_signal_while_modules_are_imported(number: signal.Signals) -> None:
    ended = python("-c", IMPORTING.format(name=number.name), status=STATUS[number])
    assert ended.stderr == ("" if number == signal.SIGTERM else "sros: interrupted\n")
