"""Run the program in tests, and check the keystores that it writes."""

from __future__ import annotations

import gc
import io
import os
import shutil
import signal
import stat
import sys
import threading
import traceback
from collections.abc import Callable, Hashable, Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, NoReturn

from cryptography import x509
from cryptography.hazmat.primitives import serialization

from sros_tool.cli import main
from sros_tool.dds.permissions import parse_permissions
from sros_tool.keystore.delivery.robot import NewRequest, create_requests
from sros_tool.keystore.layout import LEDGER_INDEX, LOCK, REQUIRED_FILES
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.template import load_template
from sros_tool.pki import smime
from tests.support.children import Forked

STAGES = (".sros-transaction", ".sros-")

_KEPT: dict[Hashable, Path] = {}
"""Keystores that were made in this process, by how they were made; only to be copied."""


def made_once(root: Path, make: Callable[[Path], object], *how: Hashable) -> Path:
    """Make a keystore at ``root``; another one of the same ``how`` is a copy, with the same CAs."""
    key = (make.__qualname__, make.__module__, *how)
    if key not in _KEPT:
        make(root)
        kept = root.parents[1] / f"kept-{len(_KEPT)}"
        _KEPT[key] = copy_of(root, kept)
    else:
        copy_of(_KEPT[key], root)
    return root


def keystore_of(
    root: Path, *names: str, now: datetime, template: str = "production", **more: object
) -> Path:
    """Make a keystore with enclaves, once for each template and changes of it."""

    def make(root: Path) -> None:
        choices = replace(load_template(template), **more)  # type: ignore[arg-type]
        create_keystore(root, template=choices, now=now)
        create_enclaves(root, names, now=now)

    return made_once(root, make, names, now, template, *more.items())


def copy_of(source: Path, target: Path) -> Path:
    """Copy a folder of small files, with links, modes and times; in half the time of `shutil`."""
    target.parent.mkdir(parents=True, exist_ok=True)
    _copy_folder(os.fspath(source), os.fspath(target))
    return target


def _copy_folder(source: str, target: str) -> None:
    with os.scandir(source) as listing:
        entries = list(listing)  # before the copy is made, which may be in the folder
    os.mkdir(target)
    for entry in entries:
        copy = f"{target}/{entry.name}"
        if entry.is_symlink():
            os.symlink(os.readlink(entry.path), copy)
        elif entry.is_dir():
            _copy_folder(entry.path, copy)
        else:
            _copy_file(entry, copy)
    shutil.copystat(source, target)


def _copy_file(entry: os.DirEntry[str], copy: str) -> None:
    state = entry.stat()
    reading = os.open(entry.path, os.O_RDONLY | os.O_NONBLOCK)
    writing = os.open(copy, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        while data := os.read(reading, 1 << 20):
            os.write(writing, data)
        os.fchmod(writing, stat.S_IMODE(state.st_mode))
        os.utime(writing, ns=(state.st_atime_ns, state.st_mtime_ns))
    finally:
        os.close(reading)
        os.close(writing)


def environment() -> dict[bytes, bytes]:
    """Return a copy of the environment, in bytes because decoding them takes longer."""
    return dict(os.environ._data)  # type: ignore[attr-defined]


def restore_environment(variables: Mapping[bytes, bytes]) -> None:
    """Make the environment what `environment` returned before."""
    now = environment()
    for name in now.keys() - variables.keys():
        del os.environ[os.fsdecode(name)]
    for name, text in variables.items():
        if now.get(name) != text:
            os.environ[os.fsdecode(name)] = os.fsdecode(text)


@dataclass(frozen=True)
class Ended:
    """The exit status and the output of a run of the program."""

    status: int
    out: str
    err: str

    def ok(self) -> Ended:
        """Return self; fail unless the program succeeded."""
        assert self.status == 0, self
        return self


def sros(
    *arguments: object, env: Mapping[str, str | None] | None = None, cwd: Path | None = None
) -> Ended:
    """Run the program in this process; a value None in ``env`` unsets the variable.

    It executes no command, which would take the place of the tests: a test fails where it would.
    """
    executed: list[object] = []

    def execute(*command: object) -> NoReturn:
        executed.append(command)
        raise SystemExit

    words = [str(argument) for argument in arguments]
    variables = environment()
    before = os.getcwd(), sys.argv, signal.getsignal(signal.SIGTERM), os.execve
    out = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)
    err = io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace", write_through=True)
    try:
        for name, value in (env or {}).items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if cwd:
            os.chdir(cwd)
        sys.argv = ["sros", *words]
        os.execve = execute  # type: ignore[assignment]
        with redirect_stdout(out), redirect_stderr(err):
            try:
                main(words)
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else 1
    finally:
        restore_environment(variables)
        os.chdir(before[0])
        sys.argv = before[1]
        signal.signal(signal.SIGTERM, before[2])
        os.execve = before[3]
    assert not executed, f"a command was executed: {executed}"
    said = [stream.buffer.getvalue().decode(errors="replace") for stream in (out, err)]
    return Ended(status, *said)


def forked(
    *arguments: object,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    first: Callable[[], object] | None = None,
    together: bool = False,
) -> Ended:
    """Run the program in a forked process in ``cwd``, which calls ``first`` before it.

    The command of ``sros run`` then takes the place of that process.

    Nothing is imported again, so this is faster than a new process.  If ``together``, ``out`` has
    both outputs in their order.
    """
    out, err = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        words = [str(argument) for argument in arguments]
        _become_program(words, env, cwd, first, out[1], out[1] if together else err[1])
    os.close(out[1])
    os.close(err[1])
    said: list[str] = []
    reader = threading.Thread(target=lambda: said.append(_read(err[0])))
    reader.start()
    text = _read(out[0])
    reader.join()
    _, status = os.waitpid(child, 0)
    return Ended(os.waitstatus_to_exitcode(status), text, *said)


class Running(Forked):
    """A forked run of the program, at which a test can look and which it can send signals.

    It leads a session of its own, and calls ``first`` before the program.  Its standard input is
    the file ``read_from``, and its standard output goes to the file ``write_to``, if any; if
    ``together``, its errors, too.
    """

    def __init__(
        self,
        *arguments: object,
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        first: Callable[[], object] | None = None,
        read_from: Path = Path(os.devnull),
        write_to: Path | None = None,
        together: bool = False,
    ) -> None:
        words = [str(argument) for argument in arguments]
        self._out, self._err = TemporaryFile(), TemporaryFile()  # noqa: SIM115 - live as long

        def begin() -> None:
            os.setsid()
            # As Python has it at its start, whatever the tests have made of it.
            signal.signal(signal.SIGINT, signal.default_int_handler)
            if first:
                first()

        def work() -> int:
            out = os.open(write_to, os.O_WRONLY) if write_to else self._out.fileno()
            err = out if together else self._err.fileno()
            _become_program(words, None, cwd, begin, out, err, read_from)

        super().__init__(work, env=dict(env or os.environ), errors=Path(os.devnull))

    @property
    def out(self) -> str:
        """What it has written to standard output so far."""
        return _content(self._out)

    @property
    def err(self) -> str:
        """What it has written to standard error so far."""
        return _content(self._err)

    def end(self) -> Ended:
        """Wait until it ends by itself; return its exit status and its output."""
        status = self.wait()
        return Ended(status, self.out, self.err)


def _content(file: IO[bytes]) -> str:
    """The content of a file of which another process moves the position."""
    descriptor = file.fileno()
    return os.pread(descriptor, os.fstat(descriptor).st_size, 0).decode(errors="replace")


def _become_program(
    words: list[str],
    env: Mapping[str, str] | None,
    cwd: Path | None,
    first: Callable[[], object] | None,
    out: int,
    err: int,
    read_from: Path = Path(os.devnull),
) -> NoReturn:
    status = 70
    gc.freeze()  # files of the tests, collected here, would close those of the program by number
    try:
        for descriptor, source in ((0, os.open(read_from, os.O_RDONLY)), (1, out), (2, err)):
            os.dup2(source, descriptor)
        os.closerange(3, 1024)
        sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w")
        if env is not None:
            os.environ.clear()
            os.environ.update(env)
        if cwd:
            os.chdir(cwd)
        if first:
            first()
        sys.argv = ["sros", *words]
        main(words)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):
                stream.flush()
        os._exit(status)


def _read(descriptor: int) -> str:
    with open(descriptor, "rb") as pipe:
        return pipe.read().decode(errors="replace")


def create_request(folder: Path, name: str, *, again: bool = False) -> NewRequest:
    """Create the key of one enclave on a robot, and return the signing request for the key."""
    (request,) = create_requests(folder, [name], again=again).requests
    return request


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Map every path below a folder to its mode, and its bytes or the target of the link."""
    found: dict[str, tuple[int, bytes]] = {}
    left = [""]
    while left:
        below = left.pop()
        with os.scandir(folder / below) as listing:
            for entry in listing:
                mode = entry.stat(follow_symlinks=False).st_mode
                content = b""
                if stat.S_ISLNK(mode):
                    content = os.fsencode(os.readlink(entry.path))
                elif stat.S_ISREG(mode):
                    content = _bytes_of(entry.path)
                elif stat.S_ISDIR(mode):
                    left.append(f"{below}{entry.name}/")
                found[below + entry.name] = (mode, content)
    return found


def _bytes_of(path: str) -> bytes:
    with open(path, "rb", buffering=0) as file:
        return file.read()


def remains(folder: Path) -> list[str]:
    """Return the stages of transactions that were left below a folder.

    The index of a long ledger is no such stage.
    """
    return [
        os.path.relpath(os.path.join(parent, name), folder)
        for parent, folders, files in os.walk(folder)
        for name in (*folders, *files)
        if ".sros-" in os.path.relpath(os.path.join(parent, name), folder) and name != LEDGER_INDEX
    ]


def check_dry_run(line: str, folder: Path, *more: str) -> int:
    """Compare what a dry run says with the files that the run changes; return how many these are.

    ``line`` is run in the folder; ``more`` are options of the dry run.
    """
    before = snapshot(folder)
    said = sros(*line.split(), "--dry-run", *more, cwd=folder).ok().out
    assert snapshot(folder) == before
    sros(*line.split(), cwd=folder).ok()
    after = snapshot(folder)
    assert not remains(folder)
    done = {
        path: "create" if path not in before else "replace" if path in after else "remove"
        for path in before.keys() | after.keys()
        if not stat.S_ISDIR((after.get(path) or before[path])[0])
        and before.get(path) != after.get(path)
    }
    plan = (text for text in said.splitlines() if not text.startswith("would revoke enclave "))
    told = [text.split(" ", 2)[1:] for text in plan]
    assert {path: action for action, path in told} == done
    assert len(told) == len(done)
    return len(done)


def topics_of(enclave: Path) -> frozenset[str]:
    """Return the DDS topics of an enclave's signed permissions, as DDS would load them."""
    signed, authority = (enclave / name for name in ("permissions.p7s", "permissions_ca.cert.pem"))
    return _topics(_document(signed.read_bytes(), authority.read_bytes()))


def certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def check_whole(keystore: Path) -> None:
    """Assert what must hold for a keystore at any moment, before anything is tidied up."""
    for parent, folders, files in os.walk(keystore):
        folders[:] = [name for name in folders if name != STAGES[0]]
        for name in files:
            path = os.path.join(parent, name)
            if name == LOCK:
                continue
            assert not os.path.exists(path) or os.stat(path).st_size, f"{path} is empty"
        if all(os.path.exists(os.path.join(parent, name)) for name in REQUIRED_FILES):
            check_enclave_whole(Path(parent))
    for key in keystore.glob("private/*"):
        name = key.name.replace(".key.", ".cert.")
        check_pair(key, keystore / "public" / name)


def check_enclave_whole(enclave: Path) -> None:
    """Assert that every file of an enclave exists and fits the others."""
    check_pair(enclave / "key.pem", enclave / "cert.pem")
    authority = (enclave / "identity_ca.cert.pem").read_bytes()
    _check_issued((enclave / "cert.pem").read_bytes(), authority)
    authority = (enclave / "permissions_ca.cert.pem").read_bytes()
    for name in ("permissions", "governance"):
        document = _document((enclave / f"{name}.p7s").read_bytes(), authority)
        clear = enclave / f"{name}.xml"
        if clear.exists():
            assert clear.read_bytes() == document.replace(b"\r\n", b"\n"), clear


def check_pair(key: Path, cert: Path) -> None:
    """Assert that only the owner can read a private key, and that it fits the certificate."""
    assert key.stat().st_mode & 0o777 == 0o600, key
    assert _fit(key.read_bytes(), cert.read_bytes()), key


# The same files are checked after every step of a long series: each content is checked once.


@cache
def _fit(key: bytes, cert: bytes) -> bool:
    loaded = serialization.load_pem_private_key(key, None)
    return loaded.public_key() == x509.load_pem_x509_certificate(cert).public_key()


@cache
def _check_issued(cert: bytes, authority: bytes) -> None:
    issuer = x509.load_pem_x509_certificate(authority)
    x509.load_pem_x509_certificate(cert).verify_directly_issued_by(issuer)


@cache
def _document(signed: bytes, authority: bytes) -> bytes:
    message = smime.parse(signed)
    message.verify(x509.load_pem_x509_certificate(authority))
    return message.document


@cache
def _topics(permissions: bytes) -> frozenset[str]:
    return frozenset(
        topic
        for grant in parse_permissions(permissions).grants
        for rule in grant.rules
        for criteria in (*rule.publish, *rule.subscribe)
        for topic in criteria.topics
    )


def policy_text(enclaves: Mapping[str, str]) -> str:
    """Return a policy in which each enclave has one node with the given groups of XML."""
    bodies = "".join(
        f'<enclave path="{path}"><profiles><profile ns="/" node="n">{groups}</profile></profiles>'
        "</enclave>"
        for path, groups in enclaves.items()
    )
    return f'<policy version="0.2.0"><enclaves>{bodies}</enclaves></policy>'


def may(right: str, *names: str) -> str:
    """Return a group of a policy that allows a right."""
    kind = {"publish": "topic", "subscribe": "topic", "request": "service", "reply": "service"}
    item = kind.get(right, "action")
    inside = "".join(f"<{item}>{each}</{item}>" for each in names)
    return f'<{item}s {right}="ALLOW">{inside}</{item}s>'


def publish(*names: str) -> str:
    """Return a group of topics to publish, as XML."""
    topics = "".join(f"<topic>{name}</topic>" for name in names)
    return f'<topics publish="ALLOW">{topics}</topics>'


def subscribe(*names: str) -> str:
    """Return a group of topics to subscribe to, as XML."""
    return publish(*names).replace("publish", "subscribe", 1)


def with_includes(policy: str) -> str:
    """Return a policy's text that declares the prefix xi of XInclude."""
    return policy.replace("<policy", '<policy xmlns:xi="http://www.w3.org/2001/XInclude"', 1)
