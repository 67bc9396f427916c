"""Every verb that reads or changes a folder, run on folders that were made hostile."""

from __future__ import annotations

import os
import random
import shutil
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from unittest import mock

from tests.fuzz.corpus import Corpus
from tests.fuzz.mutations import Mutator
from tests.support.harness import Ended, copy_of, sros

READING = (
    "list_enclaves {ks}",
    "list_enclaves {ks} --json",
    "inspect {ks}",
    "inspect {ks} --json",
    "inspect {ks} --history --json",
    "inspect {ks}/enclaves/a",
    "inspect {ks}/enclaves/a/cert.pem",
    "inspect {ks}/enclaves/a/permissions.p7s --json",
    "inspect {ks}/enclaves/governance.p7s",
    "inspect {ks}/public/identity_ca.cert.pem",
    "check {ks} --severity note --strict",
    "check {ks} --json --domain 0 --policy {root}/policy.xml",
    "check {ks}/enclaves/a",
    "check {robot}",
    "check {export}",
    "check --needs-renewal 30d {ks}",
    "check --needs-renewal 66% {ks} --json",
    "explain {ks} --who publish /chatter",
    "explain {ks} --who call /x --json",
    "explain {ks} /a publish /chatter --all-vendors",
    "explain {ks} /a join --policy {root}/policy.xml --json",
    "explain {export} /a subscribe /chatter",
    "explain {ks} --reach /a",
    "explain {ks} --log {root}/log",
    "explain --log {root}/log {ks} /a --json",
    "view {ks} --json",
    "view {ks} --format svg --all",
    "view {ks} --format mermaid",
    "view {root}/policy.xml {ks}",
    "view {root}/observation.json",
    "verify {export}",
    "verify {ks}",
    "env {ks} /a",
    "crl {ks}",
    "zenoh {ks} --check",
    "env {ks} /a --rmw rmw_zenoh_cpp",
    "env {ks} /router --rmw rmw_zenoh_cpp --json",
    "inspect {ks}/enclaves/a/session.p7s",
    "explain {ks} /a publish /chatter --vendor zenoh",
    "check {ks}/enclaves/router/router.json5 --json",
    "crl {ks} --json",
    "rotate_ca {ks}",
    "rotate_ca {ks} --status --json",
    "diff_policy {root}/policy.xml {ks}",
    "minimize_policy {root}/policy.xml --observed {root}/observation.json",
    "-vv inspect {ks}",
)
WRITING = (
    "create_enclave {ks} /new",
    "create_enclave {ks} /a",
    "create_permission {ks} /a {root}/policy.xml",
    "generate_artifacts -k {ks} -p {root}/policy.xml",
    "renew {ks} /a",
    "renew {ks} /b/c --new-key --revoke-old",
    "renew {ks} --all-expiring 100y",
    "revoke {ks} /a",
    "crl {ks} --refresh",
    "rotate_ca {ks} --next",
    "rotate_ca {ks} --finish",
    "distribute_key {ks} --all {out}/export",
    "distribute_key {ks} /a {out}/a.tar.gz",
    "create_request /other {robot}",
    "create_request /r {robot}",
    "sign_request {ks} {root}/request.pem --renew -o {out}/answer.tar.gz",
    "import {robot} {root}/answer.tar.gz",
    "create_keystore {out}/ks --template {ks}/sros.toml",
    "create_keystore {out}/ks --identity-ca {ks}/public/identity_ca.cert.pem "
    "--identity-key file:{ks}/private/identity_ca.key.pem",
    "create_keystore {out}/ks --encrypt-ca-keys",
    "zenoh {ks}",
    "zenoh {ks} --mode peer --listen 0.0.0.0:7447",
    "zenoh {ks} --off",
    "merge_policy {root}/policy.xml {root}/shipped.xml",
)
NEIGHBORS = {
    "list_enclaves {ks}",
    "list_enclaves {ks} --json",
    "inspect {ks}",
    "inspect {ks} --json",
    "explain {ks} --who call /x --json",
    "view {ks} --json",
    "view {ks} --format mermaid",
}
"""The lines that show every enclave, whatever is wrong with another one."""

CLOCKS = (
    *(datetime(year, 1, 1, tzinfo=UTC) for year in (1, 2, 1949, 1950, 1970, 2038, 2049, 2262)),
    datetime(2050, 1, 1, tzinfo=UTC),
    datetime(9999, 1, 1, tzinfo=UTC),
    datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC),
)
_NAMES = ("new\nline", "‮abc", "\udcff", "-x", "x" * 255, "a b", "$(x)", "é", ".hidden", "*")


@contextmanager
def at(moment: datetime) -> Iterator[None]:
    """Set the clock of the command line."""

    with mock.patch("sros_tool.cli.common._clock", lambda: moment):
        yield


class UnexpectedError(Exception):
    """What a verb said is a defect, or says too little."""


@dataclass
class Trial:
    """A line to run in a copy of the corpus, the changes before it, the clock and variables."""

    line: str
    changes: list[tuple[str, str, Callable[[Path], object]]]
    moment: datetime | None = None
    environment: dict[str, str | None] = field(default_factory=dict)

    def __str__(self) -> str:
        changes = "; ".join(f"{what} {path}" for path, what, _ in self.changes)
        return f"{self.line}  [{changes}] at {self.moment} with {self.environment}"


class Folders:
    """Draws lines with hostile folders, and runs them in the folder ``place``."""

    def __init__(self, corpus: Corpus, place: Path) -> None:
        self._corpus = corpus
        self._place = place
        self._paths = sorted(
            str(path.relative_to(corpus.root))
            for path in corpus.root.rglob("*")
            if not path.is_dir() or path.is_symlink()
        )
        self._folders = sorted({str(Path(path).parent) for path in self._paths} - {"."})
        self._mutators: dict[str, Mutator] = {}

    def draw(self, dice: random.Random) -> Trial:
        line = dice.choice(READING) if dice.random() < 0.7 else dice.choice(WRITING)
        near = [path for path in self._paths if path.partition("/")[0] in line] or self._paths
        changes = [self._change(near, dice) for _ in range(dice.choice((1, 1, 1, 2, 4)))]
        moment = dice.choice(CLOCKS) if dice.random() < 0.1 else None
        environment: dict[str, str | None] = {}
        if dice.random() < 0.05:
            secret = dice.choice(("x" * 2000, "\udcff", "‮", "the passphrase", "a\nb"))
            environment["SROS_CA_PASSPHRASE"] = secret
        elif dice.random() < 0.1:
            path = self._place / dice.choice(self._paths)
            if all("pipe" not in what for _, what, _ in changes):  # a pipe is waited for
                environment["SROS_CA_PASSPHRASE_FILE"] = str(path)
        return Trial(line, changes, moment, environment)

    def _change(
        self, near: list[str], dice: random.Random
    ) -> tuple[str, str, Callable[[Path], object]]:
        path = dice.choice(near)
        if dice.random() < 0.7:
            data = self._mutated(path, dice)
            return path, "mutated", lambda place: _replaced(place).write_bytes(data)
        if dice.random() < 0.2:
            path = dice.choice(self._folders)
        what = dice.choice(list(CHANGES))
        other = dice.choice(self._paths)
        if what == "content of another":
            data = (self._corpus.root / other).read_bytes()
            return path, f"{what}, {other},", lambda place: _replaced(place).write_bytes(data)
        if what == "odd name":
            name = dice.choice(_NAMES)
            return path, f"{what} {name!r}", lambda place: place.rename(place.with_name(name))
        return path, what, CHANGES[what]

    def _mutated(self, path: str, dice: random.Random) -> bytes:
        if path not in self._mutators:
            data = (self._corpus.root / path).read_bytes()
            self._mutators[path] = Mutator([data], self._corpus.key, self._corpus.sign)
        return self._mutators[path].draw(dice)

    def run(self, trial: Trial) -> Ended:
        """Run a line; raise `UnexpectedError` for a defect."""
        root = self._place
        shutil.rmtree(root, ignore_errors=True)
        copy_of(self._corpus.root, root)
        (root / "out").mkdir()
        for path, _, change in trial.changes:
            with suppress(OSError, ValueError):
                change(root / path)
        places: Mapping[str, Path] = {
            "ks": root / "ks",
            "root": root,
            "robot": root / "robot",
            "export": root / "export",
            "out": root / "out",
        }
        words = [word.format(**places) for word in trial.line.split()]
        environment = {"SROS_DEBUG": "1", **trial.environment}
        if trial.moment:
            with at(trial.moment):
                ended = sros(*words, env=environment)
        else:
            ended = sros(*words, env=environment)
        self._judge(trial, ended)
        return ended

    def _judge(self, trial: Trial, ended: Ended) -> None:
        if "defect of sros" in ended.err or "Traceback" in ended.err:
            raise UnexpectedError(ended.err)
        if ended.status not in (0, 1, 2):
            raise UnexpectedError(f"status {ended.status}: {ended.err}")
        if ended.status and not (ended.out + ended.err).strip():
            raise UnexpectedError("it failed and said nothing")
        own = all(
            path.startswith("ks/enclaves/a/") and "odd name" not in what
            for path, what, _ in trial.changes
        )
        if own and trial.line in NEIGHBORS and "/b/c" not in ended.out and not trial.moment:
            raise UnexpectedError(f"/b/c is not shown: {ended.out} {ended.err}")


def _replaced(place: Path) -> Path:
    """Remove what is at a path, so that a link is not written through."""
    if place.is_symlink() or not place.is_dir():
        place.unlink(missing_ok=True)
    else:
        shutil.rmtree(place)
    return place


def _socket(place: Path) -> None:
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind(str(_replaced(place)))


def _large(place: Path) -> None:
    with _replaced(place).open("wb") as file:
        file.truncate(1 << 40)


def _deep(place: Path) -> None:
    _replaced(place)
    for _ in range(60):
        place.mkdir()
        place = place / "enclaves"


CHANGES: Mapping[str, Callable[[Path], object]] = {
    "removed": _replaced,
    "empty": lambda place: _replaced(place).write_bytes(b""),
    "a folder": lambda place: _replaced(place).mkdir(),
    "deep folders": _deep,
    "a pipe": lambda place: os.mkfifo(_replaced(place)),
    "a socket": _socket,
    "of a terabyte": _large,
    "a link to itself": lambda place: _replaced(place).symlink_to(place),
    "a broken link": lambda place: _replaced(place).symlink_to("nowhere"),
    "a link to its folder": lambda place: _replaced(place).symlink_to("."),
    "a link above": lambda place: _replaced(place).symlink_to("../.."),
    "a link to a device": lambda place: _replaced(place).symlink_to("/dev/zero"),
    "closed": lambda place: place.chmod(0),
    "open to all": lambda place: place.chmod(0o777),
    "old": lambda place: os.utime(place, (0, -(10**9))),
    "binary": lambda place: _replaced(place).write_bytes(bytes(range(256)) * 20),
    "content of another": _replaced,
    "odd name": _replaced,
}
