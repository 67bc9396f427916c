"""The index of a long ledger is believed only if it is the one that the ledger's head states."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import struct
import sys
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.keystore import ledger as ledger_module
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.layout import LEDGER, LEDGER_HEAD, LEDGER_INDEX, LOCK
from sros_tool.keystore.ledger_index import IndexUpdate
from sros_tool.keystore.lifecycle.create import create_enclaves
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import make_request
from sros_tool.pki.crl import load_crl
from sros_tool.pki.keys import generate_key, load_key
from tests.support.harness import certificate, copy_of, remains, sros
from tests.support.long_form import some

NOW = datetime.now(UTC) + timedelta(hours=1)
QUESTIONS = [("enclave", "/a"), ("what", "settings"), ("what", "revocation"), ("enclave", "/none")]


@pytest.fixture
def root(keystore: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(ledger_module, "_INDEX_FROM_LINES", 1)
    monkeypatch.setattr(ledger_module, "_LINES_PER_LOOKUP", 0)
    renew(keystore, ["/a"], now=NOW)
    return keystore


def is_indexed(root: Path) -> bool:
    return OpenedKeystore(root).ledger_file.is_indexed


def check_answers(root: Path) -> None:
    """Compare what the index finds with the whole ledger."""
    whole = OpenedKeystore(root).ledger
    serials = [entry.serial for entry in whole.entries if entry.serial]
    for name, value in [*QUESTIONS, *(("serial", serial) for serial in serials)]:
        some = OpenedKeystore(root).ledger_with(name, value)
        assert [e for e in some.entries if getattr(e, name) == value] == [
            e for e in whole.entries if getattr(e, name) == value
        ]
        assert (some.gaps, some.lines) == (whole.gaps, whole.lines)
    assert OpenedKeystore(root).ledger_file.next_number() == whole.next_number()


def test_an_index_answers_as_the_whole_ledger_does(root: Path) -> None:
    assert is_indexed(root)
    check_answers(root)
    create_enclaves(root, ["/new"], now=NOW)
    revoke(root, ["/b"], now=NOW)
    renew(root, ["/a"], now=NOW, new_key=True, revoke_old=True)
    assert is_indexed(root)
    check_answers(root)
    with pytest.raises(KeystoreError, match="was revoked"):
        sign_request(root, make_request(generate_key(), "/b"), now=NOW)


def test_files_that_sqlite_looks_for_next_to_an_index_lead_nowhere(
    root: Path, tmp_path: Path
) -> None:
    """A journal that names another one would have SQLite remove the file with that name."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    name, magic = str(victim).encode(), bytes.fromhex("d9d505f920a163d7")
    size = (root / LEDGER_INDEX).stat().st_size
    head = magic + struct.pack(">IIIII", 0, 0, size // 4096, 512, 4096)
    tail = struct.pack(">I", 0x40000000 // 4096 + 1) + name
    tail += struct.pack(">II", len(name), sum(name)) + magic
    journal = root / f"{LEDGER_INDEX}-journal"
    journal.write_bytes(head.ljust(512, b"\0") + tail)
    for end in ("-wal", "-shm"):
        (root / f"{LEDGER_INDEX}{end}").symlink_to(victim)
    renew(root, ["/a"], now=NOW)
    assert victim.read_text() == "precious"
    assert not list(root.glob(f"{LEDGER_INDEX}-*"))
    assert is_indexed(root)


def test_a_second_revocation_reaches_the_others_and_reads_none_of_them(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create_enclaves(root, ["/c", "/d", "/e"], now=NOW)
    revoke(root, ["/b"], now=NOW)
    create_enclaves(root, ["/late"], now=NOW)
    read: list[str] = []
    ways = {"open", "os.listdir", "os.scandir"}
    monkeypatch.setattr(sys, "_index_hook", read.append, raising=False)

    def hook(event: str, what: tuple[object, ...]) -> None:
        if event in ways and (note := getattr(sys, "_index_hook", None)):
            note(str(what[0]))

    sys.addaudithook(hook)
    renew(root, ["/c"], now=NOW)
    result = revoke(root, ["/c"], now=NOW)
    monkeypatch.delattr(sys, "_index_hook")
    assert any("enclaves/c" in path for path in read)
    # One that stays is asked whether vendors take the new list.
    assert [path for path in read if "enclaves/d" in path or "enclaves/e" in path] == []
    assert result.restart == ("/a", "/d", "/e", "/late")
    for name in result.restart:
        listed = load_crl((root / f"enclaves{name}/crl.pem").read_bytes(), "").revoked
        assert len(listed) == 3
    with pytest.raises(KeystoreError, match="does not exist"):
        revoke(root, ["/none"], now=NOW)


def cut(index: Path) -> None:
    index.write_bytes(index.read_bytes()[:5000])


def overwrite(index: Path) -> None:
    index.write_bytes(b"no database\n" * 100)


def execute(*statements: str) -> Callable[[Path], None]:
    def change(index: Path) -> None:
        with closing(sqlite3.connect(index)) as connection, connection:
            for statement in statements:
                connection.execute(statement)

    return change


def lead_elsewhere(index: Path) -> None:
    index.rename(index.with_name("elsewhere"))
    index.symlink_to("elsewhere")


def open_to_others(index: Path) -> None:
    index.chmod(0o622)


FORGED: dict[str, Callable[[Path], None]] = {
    "missing": Path.unlink,
    "cut off": cut,
    "no database": overwrite,
    "a link": lead_elsewhere,
    "open to others": open_to_others,
    "without postings": execute("UPDATE buckets SET postings = x''"),
    "without buckets": execute("DELETE FROM buckets"),
    "other digests": execute("UPDATE state SET digests = zeroblob(length(digests))"),
    "a view": execute("ALTER TABLE state RENAME TO old", "CREATE VIEW state AS SELECT * FROM old"),
    "a trigger": execute("CREATE TRIGGER t AFTER INSERT ON state BEGIN DELETE FROM buckets; END"),
    "other types": execute("UPDATE buckets SET postings = 'text'"),
}


@pytest.mark.parametrize("forgery", some([*FORGED], 5))
def test_another_index_is_not_believed_and_made_again(forgery: str, root: Path) -> None:
    FORGED[forgery](root / LEDGER_INDEX)
    check_answers(root)
    renew(root, ["/a"], now=NOW)
    renew(root, ["/a"], now=NOW)
    assert is_indexed(root)
    assert not (root / LEDGER_INDEX).is_symlink()
    check_answers(root)


def test_an_index_of_an_earlier_state_is_not_believed(root: Path) -> None:
    """The revocation was forgotten by the index, and the key is not certified again."""
    key = load_key((root / "enclaves/b/key.pem").read_bytes(), "of the test")
    earlier = (root / LEDGER_INDEX).read_bytes()
    revoke(root, ["/b"], now=NOW)
    (root / LEDGER_INDEX).write_bytes(earlier)
    assert not is_indexed(root)
    shutil.rmtree(root / "revoked")
    for indexed in (False, True):
        with pytest.raises(KeystoreError, match="was revoked"):
            sign_request(root, make_request(key, "/other"), now=NOW)
        renew(root, ["/a"], now=NOW)
        assert is_indexed(root), indexed
    sign_request(root, make_request(generate_key(), "/other"), now=NOW)


def test_a_restored_keystore_has_its_own_index(root: Path, tmp_path: Path) -> None:
    backup = copy_of(root, tmp_path / "backup")
    renew(root, ["/a"], now=NOW)
    shutil.copy(root / LEDGER_INDEX, backup / LEDGER_INDEX)
    assert not is_indexed(backup)
    check_answers(backup)


def kill(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def kill_within(update: IndexUpdate, connection: sqlite3.Connection) -> None:
    connection.execute("DELETE FROM buckets")
    connection.commit()
    kill()


@pytest.mark.parametrize(("method", "killing"), [("save", kill), ("_write", kill_within)])
def test_a_kill_between_keystore_and_index_is_noticed(
    method: str, killing: Callable[..., None], root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = certificate(root / "enclaves/a/cert.pem").serial_number
    process = os.fork()
    if not process:
        monkeypatch.setattr(IndexUpdate, method, killing)
        renew(root, ["/a"], now=NOW)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == -signal.SIGKILL
    assert certificate(root / "enclaves/a/cert.pem").serial_number != before
    assert not is_indexed(root)
    check_answers(root)
    renew(root, ["/b"], now=NOW)
    assert is_indexed(root)
    check_answers(root)
    assert OpenedKeystore(root).ledger.gaps == ()
    assert not remains(root) and (root / LEDGER_INDEX).exists()


@pytest.mark.parametrize("end", [b"{}\n", b""])
def test_a_ledger_with_another_end_is_read_whole(end: bytes, root: Path) -> None:
    ledger = root / LEDGER
    lines = ledger.read_bytes().splitlines(keepends=True)
    ledger.write_bytes(b"".join(lines[: None if end else -1]) + end)
    assert not is_indexed(root)
    assert OpenedKeystore(root).ledger_with("enclave", "/a").gaps
    create_enclaves(root, ["/new"], now=NOW)
    assert any(entry.what == "gap" for entry in OpenedKeystore(root).ledger.entries)
    assert not is_indexed(root)


def test_a_changed_line_is_not_believed(root: Path) -> None:
    ledger = root / LEDGER
    data = ledger.read_bytes()
    first = data.index(b'"enclave":"/a"')
    ledger.write_bytes(data[:first] + b'"enclave":"/x"' + data[first + 14 :])
    assert is_indexed(root)
    assert OpenedKeystore(root).ledger_with("enclave", "/a").gaps
    assert OpenedKeystore(root).ledger.gaps


def test_a_short_ledger_has_no_index(keystore: Path) -> None:
    renew(keystore, ["/a"], now=NOW)
    assert not (keystore / LEDGER_INDEX).exists()
    assert b"sros ledger 1\r\n" in (keystore / LEDGER_HEAD).read_bytes()


def test_a_key_that_was_put_into_another_enclave_is_found_by_check(root: Path) -> None:
    """The ledger does not know it; the enclave that the ledger names still has to have it."""
    key = load_key((root / "enclaves/a/key.pem").read_bytes(), "of the test")
    with pytest.raises(KeystoreError, match="is the key of enclave /a"):
        sign_request(root, make_request(key, "/other"), now=NOW)
    renew(root, ["/a"], now=NOW, new_key=True)
    sign_request(root, make_request(key, "/other"), now=NOW)


def test_check_knows_the_index_and_the_lock_of_a_writer(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (LOCK, ".sros-other"):
        (root / name).touch()
    found = sros("check", root, "--severity", "note").out.splitlines()
    unknown = [line.partition(": ")[0] for line in found if "[keystore.unknown-file]" in line]
    assert unknown == [str(root / ".sros-other")] and (root / LEDGER_INDEX).exists()

    def as_the_writer_ends(path: str) -> os.stat_result:
        if Path(path).name == LOCK:
            (root / LOCK).unlink(missing_ok=True)
        return Path(path).lstat()

    monkeypatch.setattr("sros_tool.checks.keystores.files.os.lstat", as_the_writer_ends)
    assert "unknown-file" in sros("check", root, "--severity", "note").out
    assert not (root / LOCK).exists()
