"""Renewing and revoking, stopped at every step and at random moments: whole, or not done."""

from __future__ import annotations

import os
import shutil
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.faults import Fault
from sros_tool.keystore.describe import history
from sros_tool.keystore.layout import enclave_path, list_enclaves
from sros_tool.keystore.lifecycle.create import create_enclaves
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from tests.integration.kills import Moments, Server, server
from tests.support.harness import check_whole, copy_of, remains
from tests.support.long_form import ONLY_LONG, few_steps, some

__all__ = ["server"]

NOW = datetime.now(UTC)
LATER = NOW + timedelta(hours=1)
KILLS = 5


@dataclass(frozen=True)
class Seen:
    """What DDS could load at a moment: enclaves with their certificates, and the list's number."""

    enclaves: tuple[tuple[str, bytes], ...]
    crl: int

    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.enclaves)


def see(root: Path) -> Seen:
    """Check what must hold at any moment, and tell what is there."""
    check_whole(root)
    loadable = []
    lists = set()
    for name in list_enclaves(root):
        folder = enclave_path(root, name)
        if not (folder / "cert.pem").exists():
            moves = (folder / "cert.pem").is_symlink()  # and the rest of the folder with it
            assert moves or not (folder / "key.pem").exists(), name
            continue
        # The first list may be a link to nothing for a moment: ROS 2 does without it, as before.
        no_list_yet = {Fault.CRL_LEFT_OUT} if not (folder / "crl.pem").exists() else set[Fault]()
        assert {e.fault for e in open_enclave(folder, now=LATER).problems} <= no_list_yet, name
        loadable.append((name, (folder / "cert.pem").read_bytes()))
        lists.add((folder / "crl.pem").read_bytes() if (folder / "crl.pem").exists() else b"")
    assert len(lists) == 1, "some refuse the revoked, others do not"
    crl = OpenedKeystore(root).revocation_list
    assert lists == {(root / "public/identity_ca.crl.pem").read_bytes() if crl else b""}
    return Seen(tuple(loadable), crl.number if crl else 0)


def settled(root: Path) -> Seen:
    """As `see`, when all is done: nothing is left behind, and the ledger knows everything."""
    assert not remains(root.parent)
    assert not history(OpenedKeystore(root), now=LATER).unexplained
    for folder, folders, files in os.walk(root / "enclaves"):
        assert folders or files, f"{folder} is empty"
        assert all(Path(folder, file).exists() for file in files)
    return see(root)


def revoke_once(root: Path) -> None:
    """As a person does: who runs it again is told when it was done already."""
    try:
        revoke(root, ["/x/y", "/b"], now=LATER)
    except KeystoreError as error:
        assert "was revoked at" in str(error)


VERBS: dict[str, Callable[[Path], object]] = {
    "renew": lambda root: renew(root, ["/a", "/x/y"], now=LATER),
    "renew with new keys": lambda root: renew(root, ["/a", "/x/y"], now=LATER, new_key=True),
    "revoke": revoke_once,
    "refresh": lambda root: refresh_crl(root, now=LATER),
}


@pytest.fixture
def life(keystore: Path) -> Path:
    """A keystore with the enclaves /a, /b, /c and /x/y."""
    create_enclaves(keystore, ["/c", "/x/y"], now=NOW)
    return keystore


def check_end(verb: str, before: Seen, after: Seen) -> None:
    if verb.startswith("renew"):
        assert after.names() == before.names()
        assert after.crl == before.crl
        changed = {
            name
            for (name, old), (_, new) in zip(before.enclaves, after.enclaves, strict=True)
            if old != new
        }
        assert changed == {"/a", "/x/y"}
    elif verb == "revoke":
        assert after.names() == ("/a", "/c")
        assert after.crl == 1
    else:
        assert after.enclaves == before.enclaves
        assert after.crl in (1, 2)  # who runs it again gets one more


STEPS = {"open"} | {
    f"os.{name}" for name in ("chmod", "link", "mkdir", "remove", "rename", "rmdir", "symlink")
}
DIED = 99


def in_child(verb: Callable[[], object], at: int = 0) -> tuple[int, int]:
    """Run a verb in a forked process, which stops before step ``at``; its status and its steps.

    A step is an audit event of a change to the file system.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        count = 0

        def step(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal count
            if event not in STEPS:
                return
            if event == "open" and not (
                isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            ):
                return
            count += 1
            if count == at:
                os._exit(DIED)

        status = 1
        try:
            sys.addaudithook(step)
            verb()
            os.write(writer, str(count).encode())
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        said = pipe.read()
    _, ended = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(ended), int(said or 0)


def copy(source: Path, target: Path) -> Path:
    if target.exists():
        shutil.rmtree(target)
    return copy_of(source, target)


@pytest.mark.parametrize("verb", some([*VERBS], 2))
def test_death_at_every_step(
    verb: str, life: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    before = settled(life)
    work = tmp_path / "work" / "ks"
    work.parent.mkdir()
    copy(life, work)
    status, steps = in_child(lambda: VERBS[verb](work))
    assert status == 0
    check_end(verb, before, settled(work))
    outcomes = set()
    for step in few_steps(range(1, steps + 1)):
        copy(life, work)
        assert in_child(lambda: VERBS[verb](work), step) == (DIED, 0), step
        now = see(work)
        outcomes.add(now == before)
        if now != before:
            check_end(verb, before, now)
        VERBS[verb](work)
        check_end(verb, before, settled(work))
    assert outcomes == {True, False}
    assert steps > 30


# ── real processes ─────────────────────────────────────────────────────────────────────────


@ONLY_LONG
@pytest.mark.parametrize("verb", ["renew", "revoke"])
def test_killed_at_random_moments(verb: str, server: Server, life: Path, tmp_path: Path) -> None:
    words: dict[str, tuple[object, ...]] = {
        "renew": ("/a", "/x/y", "--new-key"),
        "revoke": ("/x/y", "/b"),
    }
    work = tmp_path / "work" / "ks"
    work.parent.mkdir()
    before = settled(life)
    copy(life, work)
    moments = Moments(KILLS, 6, server.run(verb, work, *words[verb]))
    for pause in moments:
        copy(life, work)
        killed = server.kill(pause, verb, work, *words[verb])
        now = see(work)
        if now != before:
            check_end(verb, before, now)
        moments.tell(killed=killed, done=now != before)
        VERBS["renew with new keys" if verb == "renew" else verb](work)
        check_end(verb, before, settled(work))
