"""Run the commands of the documentation's pages, and compare their output with the page's.

A page is run from its top to its end, in a new folder and a network of its own.  In a fence whose
first line begins with "$ ", each such line is a command (continued after a backslash), and the
lines up to the next one are its output; in a fence marked ``sh``, each line is a command.  What the
page does not show stands in comments before the fence:

    <!-- run: COMMANDS -->          run first, as often nothing of the page does what it presupposes
    <!-- file: NAME -->             the fence is the content of this file
    <!-- not run: REASON -->        no command of the next fence is run
    <!-- not run (WORDS): REASON -->  those that begin with WORDS are not
    <!-- terminal: NAME -->         the last command of the fence goes on until the next fence of
                                    this terminal, or the end of the page, as if stopped by Ctrl-C;
                                    a fence without a command is more of its output

In the output, "..." stands for any text, on a line of its own for any lines.  Moments, digests,
durations and the path of the folder are not compared.  A command without output on the page must
succeed.  ``ros2`` is a program that does nothing where ROS 2 is not installed.

`python -m tests.support.pages --write PAGE...` writes what is printed into pages where it differs.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sros_tool.runtime.netns import enter_isolation, try_isolation
from tests.support.children import PATIENCE
from tests.support.harness import Running, forked

PROJECT = Path(__file__).resolve().parents[2]
HOME = "/home/robot"
"""The folder in which the commands of a page seem to run."""

_COMMENT = re.compile(
    r"<!-- (run|file|terminal|not run(?: \((?P<words>.+?)\))?):\s(?P<text>.+)-->\s*", re.DOTALL
)
_SHELL = set("|&;<>()$`*?~\\\n=")
_ANY = "..."
_SHA_256 = re.compile(r"\b[0-9a-f]{64}\b")


class PageError(AssertionError):
    """What a page says is not so."""


@dataclass(frozen=True)
class Command:
    """A command of a page; ``line`` (from 0) is that after it, where its output begins."""

    text: str
    line: int
    output: tuple[str, ...]


@dataclass(frozen=True)
class Block:
    """A fence with the comments before it, or a comment ``run`` as commands without output."""

    line: int
    language: str
    lines: tuple[str, ...]
    file: str = ""
    terminal: str = ""
    skipped: tuple[str, ...] = ()

    @property
    def commands(self) -> tuple[Command, ...]:
        """The commands that are to be run."""
        found = self._written()
        return tuple(each for each in found if not each.text.startswith(self.skipped))

    def _written(self) -> Iterator[Command]:
        if self.file:
            return
        if self.language in ("sh", "bash"):
            for number, line in enumerate(self.lines):
                if line.split("#")[0].strip():
                    yield Command(line, self.line + number + 1, ())
        elif self.lines and self.lines[0].startswith("$ "):
            starts = [n for n, line in enumerate(self.lines) if line.startswith("$ ")]
            for start, stop in zip(starts, [*starts[1:], len(self.lines)], strict=True):
                end = start + 1
                while self.lines[end - 1].endswith("\\"):
                    end += 1
                text = "\n".join(self.lines[start:end])[2:]
                yield Command(text, self.line + end, self.lines[end:stop])


def blocks(text: str) -> Iterator[Block]:
    """Yield the fences and the hidden commands of a page, in order."""
    lines = text.splitlines()
    number = 0
    file = terminal = ""
    skipped: list[str] = []
    while number < len(lines):
        line = lines[number]
        if line.startswith("<!--"):
            start = number
            while not lines[number].rstrip().endswith("-->"):
                number += 1
            comment = "\n".join(lines[start : number + 1])
            number += 1
            if not re.match(r"<!--\s*(run|file|terminal|not)\b", comment):
                continue
            if not (found := _COMMENT.fullmatch(comment)):
                raise PageError(f"line {start + 1}: a comment that is not understood: {comment}")
            value = found["text"].strip()
            match found[1]:
                case "run":
                    yield Block(start + 1, "sh", tuple(value.splitlines()))
                case "file":
                    file = value
                case "terminal":
                    terminal = value
                case _:
                    skipped.append(found["words"] or "")
            continue
        if line.startswith("```"):
            start = number + 1
            number = lines.index("```", start)
            body = tuple(lines[start:number])
            yield Block(start, line[3:].strip(), body, file, terminal, tuple(skipped))
            file, terminal, skipped = "", "", []
        number += 1


def alike(line: str) -> str:
    """Return a line without what differs between two runs."""
    line = re.sub(r"\d{4}-\d\d-\d\d([T ]\d\d:\d\d:\d\dZ?)?", "<moment>", line)
    line = re.sub(r"\b(\d+ (h|min|s) )+ago\b", "<age>", line)
    line = re.sub(r"(<age>|\bconfirmed)  +", r"\1  ", line)  # the width of the column of ages
    line = re.sub(r"\b[0-9a-f]{7,64}\b(\.\.\.)?", "<digest>", line)
    line = re.sub(r"\b\d+(\.\d+)? (s|ms|bytes|B|kB|MB)\b", r"<number> \2", line)
    return line.rstrip()


def fits(expected: tuple[str, ...], said: str, *, begun: bool = False) -> bool:
    """Return whether what was said is what a page shows; if ``begun``, it may go on."""
    pattern = ""
    for line in expected:
        if line.strip() == _ANY:
            pattern += r"(?:.*\n)*?"
        else:
            parts = alike(line).split(_ANY)
            pattern += r"[^\n]*?".join(map(re.escape, parts)) + "\n"
    text = "".join(f"{alike(line)}\n" for line in said.splitlines())
    return (re.match if begun else re.fullmatch)(pattern, text) is not None


@dataclass
class _Terminal:
    process: subprocess.Popen[bytes] | Running
    output: Path
    folder: Path
    shown: tuple[str, ...] = ()

    def said(self) -> str:
        return self.output.read_text("utf-8", "replace").replace(str(self.folder), HOME)

    def wait(self, more: tuple[str, ...], where: str) -> None:
        """Wait until the lines of the page have come."""
        self.shown += more
        end = time.monotonic() + PATIENCE
        while not fits(self.shown, _whole_lines(self.said()), begun=True):
            if self.process.poll() is not None or time.monotonic() > end:
                wanted = "\n".join(self.shown)
                raise PageError(f"{where}\nexpected:\n{wanted}\nsaid:\n{self.said()}")
            time.sleep(0.05)

    def stop(self) -> None:
        """Stop the process as Ctrl-C does."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            raise PageError("a program did not end on Ctrl-C") from None


def _whole_lines(text: str) -> str:
    return text[: text.rfind("\n") + 1]


@dataclass
class _Run:
    """A run of a page in a folder; ``written`` maps lines to the output that was printed."""

    folder: Path
    page: str
    write: bool
    cwd: Path = field(init=False)
    env: dict[str, str] = field(init=False)
    terminals: dict[str, _Terminal] = field(default_factory=dict)
    written: dict[int, tuple[int, list[str]]] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    """What was printed in place of each SHA-256 of the page, for commands that name it."""

    def __post_init__(self) -> None:
        self.cwd = self.folder / "home"
        self.cwd.mkdir()
        programs = self.folder / "bin"
        programs.mkdir()
        _script(programs / "sros", f'exec {shlex.quote(sys.executable)} -m sros_tool "$@"')
        _script(programs / "python", f'exec {shlex.quote(sys.executable)} "$@"')
        path = os.environ["PATH"]
        if not any((Path(each) / "ros2").exists() for each in path.split(":")):
            _script(programs / "ros2", "")
        kept = (
            "LANG",
            "LC_ALL",
            "LD_LIBRARY_PATH",
            "TMPDIR",
            "USER",
            "AMENT_PREFIX_PATH",
            "SROS_CYCLONEDDS_DIR",
        )
        self.env = {
            **{name: os.environ[name] for name in kept if name in os.environ},
            "PATH": f"{programs}:{path}",
            "HOME": str(self.cwd),
            "PYTHONPATH": os.pathsep.join([str(PROJECT), *filter(None, sys.path)]),
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def block(self, block: Block) -> None:
        if block.file:
            if "" not in block.skipped:
                target = self.cwd / block.file
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_text("\n".join(block.lines) + "\n", "utf-8")
            return
        commands = block.commands
        if block.terminal and block.terminal in self.terminals:
            if not commands:
                self.terminals[block.terminal].wait(block.lines, f"{self.page}:{block.line}")
                return
            self.terminals.pop(block.terminal).stop()
        for number, command in enumerate(commands):
            if block.terminal and number == len(commands) - 1:
                self.start(block.terminal, command)
            else:
                self.command(command)

    def start(self, name: str, command: Command) -> None:
        output = self.folder / f"{name}.log"
        words = _simple(command.text)
        with output.open("wb") as log:
            if words and words[0] == "sros":
                process: subprocess.Popen[bytes] | Running = Running(
                    *words[1:], env=self.env, cwd=self.cwd, write_to=output, together=True
                )
            else:
                process = subprocess.Popen(
                    ["bash", "-c", f"exec {command.text}"],
                    cwd=self.cwd,
                    env=self.env,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
        self.terminals[name] = _Terminal(process, output, self.folder / "home")
        self.terminals[name].wait(command.output, f"{self.page}:{command.line}: {command.text}")

    def command(self, command: Command) -> None:
        status, said = self.execute(_SHA_256.sub(self._this_time, command.text))
        said = said.replace(str(self.cwd), HOME)
        where = f"{self.page}:{command.line}: $ {command.text}"
        if "Traceback (most recent call last)" in said:
            raise PageError(f"{where}\n{said}")
        if not command.output:
            if status:
                raise PageError(f"{where}\nended with status {status}:\n{said}")
        elif not fits(command.output, said):
            if self.write:
                lines = said.splitlines() or ["(nothing)"]
                self.written[command.line] = (len(command.output), lines)
                return
            expected = "\n".join(command.output)
            raise PageError(f"{where}\nexpected:\n{expected}\nsaid (status {status}):\n{said}")
        self.digests |= dict(
            zip(_SHA_256.findall("\n".join(command.output)), _SHA_256.findall(said), strict=False)
        )

    def _this_time(self, digest: re.Match[str]) -> str:
        return self.digests.get(digest[0], digest[0])

    def execute(self, text: str) -> tuple[int, str]:
        words = _simple(text)
        if words and words[0] == "sros":
            ended = forked(
                *words[1:], env=self.env, first=lambda: os.chdir(self.cwd), together=True
            )
            return ended.status, ended.out
        state = self.folder / "state"
        script = f"{text}\n_status=$?; env -0 > {state}; pwd > {state}.cwd; exit $_status"
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=self.cwd,
            env=self.env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=PATIENCE,
            check=False,
        )
        if state.exists():
            pairs = state.read_bytes().decode().split("\0")
            self.env = dict(each.split("=", 1) for each in pairs if each)
            self.env.pop("_", None)
            self.cwd = Path(Path(f"{state}.cwd").read_text("utf-8").strip())
            state.unlink()
        return done.returncode, done.stdout.decode("utf-8", "replace")


def _script(path: Path, text: str) -> None:
    path.write_text(f"#!/bin/sh\n{text}\n", "utf-8")
    path.chmod(0o755)


def _simple(text: str) -> list[str]:
    """Return the words of a command that needs no shell, or none."""
    try:
        words = shlex.split(text, comments=True)
        bare = shlex.shlex(re.sub(r"'[^']*'", "''", text), punctuation_chars=True)
        bare.commenters = "#"
        plain = not any(set(token) & _SHELL for token in _unquoted(bare))
    except ValueError:
        return []
    return words if plain else []


def _unquoted(tokens: shlex.shlex) -> Iterator[str]:
    tokens.whitespace_split = False
    tokens.wordchars += "-./@,:%+={}[]"
    for token in tokens:
        yield re.sub(r"^\S*=", "", token) if token.startswith("--") else token


def run_page(page: Path, folder: Path, *, write: bool = False) -> None:
    """Run a page in ``folder``, in this process, which must not be used afterwards.

    Raises:
        PageError: What the page says is not so.
    """
    text = page.read_text("utf-8")
    if try_isolation().isolated:
        enter_isolation()
    run = _Run(folder, page.name, write)
    os.chdir(run.cwd)
    try:
        for block in blocks(text):
            run.block(block)
        while run.terminals:
            run.terminals.popitem()[1].stop()
    finally:
        for terminal in run.terminals.values():
            if terminal.process.poll() is None:
                os.killpg(terminal.process.pid, signal.SIGKILL)
    if write and run.written:
        lines = text.splitlines()
        for start, (length, new) in sorted(run.written.items(), reverse=True):
            lines[start : start + length] = new
        page.write_text("\n".join(lines) + "\n", "utf-8")


def outcome_of(page: Path, folder: Path, *, write: bool = False) -> str:
    """Run a page in a forked process; return what is wrong, or nothing."""
    read, end = os.pipe()
    child = os.fork()
    if child == 0:
        wrong = "ended without a result"
        try:
            os.close(read)
            run_page(page, folder, write=write)
            wrong = ""
        except PageError as error:
            wrong = str(error)
        except BaseException:
            wrong = traceback.format_exc()
        finally:
            with os.fdopen(end, "wb") as pipe:
                pipe.write(wrong.encode())
            os._exit(0)
    os.close(end)
    with os.fdopen(read, "rb") as pipe:
        wrong = pipe.read().decode()
    _, status = os.waitpid(child, 0)
    return wrong or ("" if status == 0 else f"the page's process ended with {status}")


def main(arguments: list[str]) -> int:
    """Run pages; return 1 if one of them is wrong."""
    write = "--write" in arguments
    status = 0
    for name in (each for each in arguments if each != "--write"):
        with tempfile.TemporaryDirectory(prefix="sros-page-", dir="/dev/shm") as folder:
            wrong = outcome_of(Path(name).resolve(), Path(folder), write=write)
        print(f"{name}: {wrong or 'ok'}", flush=True)
        status |= bool(wrong)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
