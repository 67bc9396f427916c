"""A long ledger has sealed parts: nothing is believed of a part that is not the one sealed.

Only who reads all lines needs the sealed parts; the index answers all others without them.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.keystore import ledger as ledger_module
from sros_tool.keystore import rights
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.describe import history
from sros_tool.keystore.layout import LEDGER, LEDGER_HEAD, LEDGER_INDEX, ledger_part
from sros_tool.keystore.ledger import LedgerFile
from sros_tool.keystore.lifecycle.create import create_enclaves
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import make_request
from sros_tool.pki.keys import generate_key, load_key
from tests.keystore.test_ledger_index import check_answers, is_indexed
from tests.keystore.test_transaction import DIED, in_child
from tests.support.harness import check_whole, copy_of, remains, snapshot, sros
from tests.support.long_form import few_steps, some

NOW = datetime.now(UTC) + timedelta(hours=1)
CHECK = ("check", "keystore", "--fail-on", "error", "--exclude", "enclave.node-cannot-start")


def index_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have also a short ledger indexed, and never one that is not long yet sealed."""
    monkeypatch.setattr(ledger_module, "_INDEX_FROM_LINES", 1)
    monkeypatch.setattr(ledger_module, "_LINES_PER_LOOKUP", 0)
    monkeypatch.setattr(ledger_module, "_SEAL_FROM_BYTES", 1 << 30)


@pytest.fixture(scope="module")
def sealed(made_keystore: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore whose ledger has two sealed parts; the first one has all but a renewal."""
    root = tmp_path_factory.mktemp("sealed") / "ks"
    copy_of(made_keystore, root)
    with pytest.MonkeyPatch.context() as patched:
        index_all(patched)
        for sealed_from in (1, 1 << 30, 1, 1 << 30):
            patched.setattr(ledger_module, "_SEAL_FROM_BYTES", sealed_from)
            renew(root, ["/a"], now=NOW)
    return root


@pytest.fixture
def root(sealed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of ``sealed``, to be changed."""
    index_all(monkeypatch)
    return copy_of(sealed, tmp_path / "ks")


def parts(root: Path) -> list[str]:
    return sorted(path.name for path in root.glob("ledger.*.jsonl"))


def change_line(part: Path) -> None:
    part.write_bytes(part.read_bytes().replace(b'"/a"', b'"/x"', 1))


def cut(part: Path) -> None:
    part.write_bytes(b"".join(part.read_bytes().splitlines(keepends=True)[:-1]))


def empty(part: Path) -> None:
    part.write_bytes(b"")


def add_line(part: Path) -> None:
    part.write_bytes(part.read_bytes() + b"{}\n")


def exchange(part: Path) -> None:
    other = part.with_name(ledger_part(2 if part.name == ledger_part(1) else 1))
    first, second = part.read_bytes(), other.read_bytes()
    part.write_bytes(second)
    other.write_bytes(first)


def take_from_another(part: Path) -> None:
    """Put the sealed part of a keystore with other CAs there."""
    other = part.parents[1] / "other"
    sros("create_keystore", other).ok()
    create_enclaves(other, ["/a", "/b"], now=NOW)
    part.write_bytes((other / LEDGER).read_bytes())


BROKEN: dict[str, Callable[[Path], None]] = {
    "missing": Path.unlink,
    "changed": change_line,
    "cut off": cut,
    "empty": empty,
    "with a line more": add_line,
    "exchanged": exchange,
    "another keystore's": take_from_another,
}


def test_parts_are_sealed_and_read_as_one_ledger(root: Path) -> None:
    assert parts(root) == [ledger_part(1), ledger_part(2), ledger_part(3)]
    assert os.readlink(root / LEDGER) == ledger_part(3)
    sealed = {name: (root / name).read_bytes() for name in parts(root)[:2]}
    check_answers(root)
    create_enclaves(root, ["/new"], now=NOW)
    revoke(root, ["/b"], now=NOW)
    assert is_indexed(root)
    check_answers(root)
    whole = OpenedKeystore(root).ledger
    assert (whole.gaps, whole.certain) == ((), whole.entries)
    assert len(whole.entries) == whole.lines
    assert [entry.number for entry in whole.entries if entry.what == "sealed"] == [1, 2]
    assert {name: (root / name).read_bytes() for name in sealed} == sealed
    assert not history(OpenedKeystore(root), now=NOW).unexplained
    sros(*CHECK, root).ok()


def test_without_its_sealed_parts_changes_go_on(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = load_key((root / "enclaves/b/key.pem").read_bytes(), "of the test")
    revoke(root, ["/b"], now=NOW)
    archive = tmp_path / "archive"
    archive.mkdir()
    for name in (ledger_part(1), ledger_part(2)):
        shutil.move(root / name, archive / name)
    renew(root, ["/a"], now=NOW, new_key=True, revoke_old=True)
    create_enclaves(root, ["/new"], now=NOW)
    with monkeypatch.context() as patched:  # as of very many enclaves
        patched.setattr(ledger_module, "_LINES_PER_LOOKUP", 1 << 30)
        patched.setattr(rights, "_MOST_LOOKUPS", 1)
        done = renew(root, ["/new", "/a"], now=NOW, revoke_old=True)
        assert (len(done.outcomes), done.revoked) == (2, 2)
    shutil.rmtree(root / "revoked")
    with pytest.raises(KeystoreError, match="was revoked"):
        sign_request(root, make_request(key, "/other"), now=NOW)
    (root / LEDGER_INDEX).unlink()
    # Now nobody knows whether the key was revoked: there is no answer, least of all "no".
    before = snapshot(root)
    for asked in (key, generate_key()):
        with pytest.raises(KeystoreError, match=f"{ledger_part(2)}, a sealed part .* is missing"):
            sign_request(root, make_request(asked, "/other"), now=NOW)
    assert snapshot(root) == before
    shutil.copytree(archive, root, dirs_exist_ok=True)
    with pytest.raises(KeystoreError, match="was revoked"):
        sign_request(root, make_request(key, "/other"), now=NOW)
    sign_request(root, make_request(generate_key(), "/other"), now=NOW)
    assert is_indexed(root)
    check_answers(root)
    assert OpenedKeystore(root).ledger.gaps == ()


@pytest.mark.parametrize(
    ("number", "case"), some([(1 + i % 2, case) for i, case in enumerate(BROKEN)], 3)
)
def test_a_part_that_was_not_sealed_is_noticed(case: str, number: int, root: Path) -> None:
    part = root / ledger_part(number)
    sound = {name: (root / name).read_bytes() for name in parts(root)}
    BROKEN[case](part)
    found = sros(*CHECK, root)
    assert found.status == 1
    said = re.findall(r"(ledger\.000[12]\.jsonl).*sealed", found.out)
    assert len(said) == 1, found
    assert said[0] == ledger_part(number) or case == "exchanged"
    renew(root, ["/a"], now=NOW)
    revoke(root, ["/b"], now=NOW)
    (root / LEDGER_INDEX).unlink()
    before = snapshot(root)
    for change in (renew, revoke):
        with pytest.raises(KeystoreError, match="sealed"):
            change(root, ["/a"], now=NOW)
    assert snapshot(root) == before
    for name in (ledger_part(1), ledger_part(2)):
        (root / name).write_bytes(sound[name])
    renew(root, ["/a"], now=NOW)
    check_answers(root)
    assert OpenedKeystore(root).ledger.gaps == ()


def test_death_at_every_step_of_sealing(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ledger_module, "_SEAL_FROM_BYTES", 1)

    def change(keystore: Path) -> None:
        renew(keystore, ["/a"], now=NOW)

    work = tmp_path / "work"
    lines = OpenedKeystore(root).ledger.lines
    (root / LEDGER_INDEX).unlink()  # it is made again first; then saved with the new lines
    copy_of(root, work)
    status, steps = in_child(lambda: change(work))
    assert status == 0
    assert len(parts(work)) == 4
    done = set()
    for step in few_steps(steps):
        shutil.rmtree(work)
        copy_of(root, work)
        assert in_child(lambda: change(work), step)[0] in (DIED, 0)
        ledger = OpenedKeystore(work).ledger
        assert ledger.gaps == (), step
        assert ledger.lines in (lines, lines + 3), step
        done.add(ledger.lines)
        change(work)
        check_whole(work)
        assert not remains(work) and (work / LEDGER_INDEX).exists()
        check_answers(work)
        assert OpenedKeystore(work).ledger.gaps == ()
    assert len(done) == 2


def count_whole(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Note each question for which all lines are read, because no index answers it."""
    whole: list[str] = []
    lines = LedgerFile._lines

    def read_all(file: LedgerFile, *given: Any) -> Any:
        whole.append("all")
        return lines(file, *given)

    monkeypatch.setattr(LedgerFile, "_lines", read_all)
    return whole


def test_a_damaged_index_is_made_again_at_once(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that is damaged where its state does not show it."""
    import sqlite3
    from contextlib import closing

    revoke(root, ["/b"], now=NOW)
    whole = count_whole(monkeypatch)
    for statement in (
        "UPDATE buckets SET names = x'00'",
        "UPDATE buckets SET postings = x''",
        "DELETE FROM lines",
        "UPDATE lines SET line = x'7b7d'",
    ):
        with closing(sqlite3.connect(root / LEDGER_INDEX)) as connection, connection:
            connection.execute(statement)
        create_enclaves(root, ["/spare"], now=NOW)
        revoke(root, ["/spare"], now=NOW)
        assert whole == [], statement
        assert is_indexed(root)
    check_answers(root)


def test_a_copy_without_the_link_goes_on(root: Path, tmp_path: Path) -> None:
    copied = copy_of(root, tmp_path / "copied")
    (copied / LEDGER).unlink()
    shutil.copy(copied / ledger_part(3), copied / LEDGER)
    before = (copied / LEDGER_HEAD).read_bytes()
    check_answers(copied)
    renew(copied, ["/a"], now=NOW)
    assert not (copied / LEDGER).is_symlink()
    check_answers(copied)
    assert OpenedKeystore(copied).ledger.gaps == ()
    # The copy is put back as it was, next to the part that it became.
    (copied / LEDGER).replace(copied / ledger_part(3))
    shutil.copy(root / ledger_part(3), copied / LEDGER)
    (copied / LEDGER_HEAD).write_bytes(before)
    assert f"{ledger_part(3)} is a later part" in str(OpenedKeystore(copied).ledger.gaps)


def test_a_link_elsewhere_is_not_followed(root: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside.jsonl"
    shutil.copy(root / ledger_part(3), outside)
    (root / LEDGER).unlink()
    (root / LEDGER).symlink_to(outside)
    with pytest.raises(KeystoreError, match="cannot be read"):
        renew(root, ["/a"], now=NOW)
    (root / LEDGER).unlink()
    (root / LEDGER).symlink_to(ledger_part(3))
    renew(root, ["/a"], now=NOW)


def test_a_last_part_with_another_name_loses_no_line(root: Path) -> None:
    (root / ledger_part(3)).rename(root / ledger_part(9))
    (root / LEDGER).unlink()
    (root / LEDGER).symlink_to(ledger_part(9))
    revoke(root, ["/b"], now=NOW)
    assert os.readlink(root / LEDGER) == ledger_part(3)
    ledger = OpenedKeystore(root).ledger
    assert ledger.gaps == ()
    assert [entry.enclave for entry in ledger.entries if entry.what == "revocation"][:1] == ["/b"]
    check_answers(root)


def put_ledger_back(root: Path, earlier: Path) -> None:
    """Put the ledger of the copy ``earlier`` back, and forget the files of revoked enclaves."""
    for name in (LEDGER_HEAD, LEDGER_INDEX, ledger_part(3)):
        shutil.copy(earlier / name, root / name)
    (root / LEDGER).unlink()
    (root / LEDGER).symlink_to(ledger_part(3))
    shutil.rmtree(root / "revoked")


def test_what_an_earlier_ledger_lacks_is_not_forgotten(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The revocation list knows the certificate, and later parts are not written over."""
    key = load_key((root / "enclaves/b/key.pem").read_bytes(), "of the test")
    earlier = copy_of(root, tmp_path / "earlier")
    revoke(root, ["/b"], now=NOW)
    put_ledger_back(root, earlier)
    with pytest.raises(KeystoreError, match="was revoked"):
        sign_request(root, make_request(key, "/other"), now=NOW)
    with pytest.raises(KeystoreError, match="enclave /b was revoked"):
        sign_request(root, make_request(generate_key(), "/b"), now=NOW)
    sign_request(root, make_request(generate_key(), "/other"), now=NOW)

    earlier = copy_of(root, tmp_path / "later")
    monkeypatch.setattr(ledger_module, "_SEAL_FROM_BYTES", 1)
    create_enclaves(root, ["/c"], now=NOW)
    revoke(root, ["/c"], now=NOW)
    assert len(parts(root)) == 5
    put_ledger_back(root, earlier)
    for later in (5, 4):
        before = snapshot(root)
        for sealed_from in (1, 1 << 30):
            monkeypatch.setattr(ledger_module, "_SEAL_FROM_BYTES", sealed_from)
            with pytest.raises(KeystoreError, match=f"{ledger_part(later)}' is a later part"):
                create_enclaves(root, ["/d"], now=NOW)
        assert snapshot(root) == before
        damaged = (
            f"{ledger_part(later)} is a later part of the ledger, so an earlier ledger was put back"
        )
        asking = (CHECK, ("verify",), ("inspect",), ("inspect", "--history"))
        for asked in asking:
            found = sros(*asked, root)
            assert (found.status, damaged in found.out) == (1, True), found
        (root / ledger_part(later)).unlink()
    sros(*CHECK, root).ok()
    assert not [asked for asked in asking if "later part" in sros(*asked, root).out]
    create_enclaves(root, ["/d"], now=NOW)


def test_an_index_of_another_version_is_made_again_first(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The head states a root that this version never makes; the chain proves the lines."""
    whole = count_whole(monkeypatch)
    assert OpenedKeystore(root).ledger.gaps == ()
    assert whole == ["all"]
    monkeypatch.setattr(ledger_module._Head, "index_root", property(lambda _: "0" * 64))
    create_enclaves(root, ["/spare"], now=NOW)
    assert whole == ["all"]
    monkeypatch.undo()
    assert is_indexed(root)
    # A line that was changed is not in the new index: there is none, and the fault is recorded.
    part = root / ledger_part(3)
    part.write_bytes(part.read_bytes().replace(b'"/spare"', b'"/other"', 1))
    (root / LEDGER_INDEX).unlink()
    create_enclaves(root, ["/more"], now=NOW)
    assert not is_indexed(root)
    assert any("changed" in gap for gap in OpenedKeystore(root).ledger.gaps)


def test_an_index_is_proven_by_the_reading_that_it_was_made_of(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever can write to the keystore could show other lines to one of two readings."""
    every_line, readings = LedgerFile._every_line, 0

    def other_lines_first(file: LedgerFile, *given: Any) -> Any:
        nonlocal readings
        readings += 1
        is_first = readings == 1
        for line in every_line(file, *given):
            yield line.replace(b'"enclave":"/b"', b'"enclave":"/x"') if is_first else line

    (root / LEDGER_INDEX).unlink()
    monkeypatch.setattr(ledger_module._Head, "index_root", property(lambda _: "0" * 64))
    monkeypatch.setattr(LedgerFile, "_every_line", other_lines_first)
    create_enclaves(root, ["/spare"], now=NOW)
    monkeypatch.undo()
    assert readings > 1
    assert is_indexed(root)
    assert OpenedKeystore(root).ledger_file.recorded_enclaves() == ["/a", "/b", "/spare"]
