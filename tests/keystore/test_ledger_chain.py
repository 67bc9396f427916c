"""Lines of the ledger that are missing or changed are noticed, and never stop a revocation."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.layout import LEDGER, LEDGER_HEAD
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.lifecycle.rotate import renew_identity_ca, rotate_ca
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, make_request
from sros_tool.pki.keys import generate_key, load_key
from tests.support.children import run
from tests.support.harness import certificate, copy_of, policy_text, publish, sros

NOW = datetime.now(UTC)
FIRST = 5  # before the first certificate: two CAs, governance, settings; it is the fifth


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore whose enclave /a was renewed, so that its ledger alone has the first one."""
    root = tmp_path_factory.mktemp("chain") / "ks"
    create_keystore(root, template=load_template("production"), now=NOW)
    create_enclaves(root, ["/a", "/b"], now=NOW)
    renew(root, ["/a"], now=NOW)
    return root


@pytest.fixture
def root(made_once: Path, tmp_path: Path) -> Path:
    return copy_of(made_once, tmp_path / "ks")


def lines_of(root: Path) -> list[bytes]:
    return (root / LEDGER).read_bytes().splitlines()


def put(root: Path, lines: list[bytes]) -> None:
    (root / LEDGER).write_bytes(b"".join(line + b"\n" for line in lines))


def revoked(root: Path) -> set[int]:
    found = OpenedKeystore(root).revocation_list
    return {each.serial for each in found.revoked} if found else set()


def _edit(lines: list[bytes]) -> list[bytes]:
    lines[FIRST - 1] = lines[FIRST - 1].replace(b'"/a"', b'"/x"')
    return lines


def _edit_and_chain_again(lines: list[bytes]) -> list[bytes]:
    from sros_tool.keystore.ledger import _sha256

    lines = _edit(lines)
    for index in range(FIRST, len(lines)):
        entry = json.loads(lines[index])
        entry["previous"] = _sha256(lines[index - 1])
        lines[index] = json.dumps(entry, separators=(",", ":")).encode()
    return lines


TAMPERED: dict[str, Callable[[list[bytes]], list[bytes]]] = {
    "a line edited": _edit,
    "a line edited, and all after it chained again": _edit_and_chain_again,
    "a line removed": lambda lines: lines[: FIRST - 1] + lines[FIRST:],
    "the first line removed": lambda lines: lines[1:],
    "the last line cut off": lambda lines: lines[:-1],
    "all but one cut off": lambda lines: lines[:1],
    "all cut off": lambda _: [],
    "two lines exchanged": lambda lines: [lines[1], lines[0], *lines[2:]],
    "a line repeated": lambda lines: [*lines, lines[-1]],
    "a line added": lambda lines: [*lines, b'{"time":"x","what":"certificate"}'],
    "not text": lambda lines: [*lines[: FIRST - 1], b"\xff{", *lines[FIRST:]],
    "an empty line": lambda lines: [*lines[:FIRST], b"", *lines[FIRST:]],
    "a number for a name": lambda lines: [*lines, b'{"time":"x","what":"ca","enclave":3}'],
    "no serial number": lambda lines: [*lines, b'{"time":"x","what":"certificate","serial":"z"}'],
    "a long serial number": lambda lines: [
        *lines, b'{"time":"x","what":"certificate","enclave":"/a","serial":"' + b"f" * 41 + b'"}'
    ],
    "deep": lambda lines: [*lines, b"[" * 100_000],
    "the chain taken out": lambda lines: [re.sub(rb',"previous":"\w+"', b"", x) for x in lines],
}  # fmt: skip


@pytest.mark.parametrize("case", TAMPERED)
def test_a_changed_ledger_is_noticed_and_revoking_goes_on(case: str, root: Path) -> None:
    ledger = OpenedKeystore(root).ledger
    assert (ledger.gaps, len(ledger.certain)) == ((), ledger.lines)
    put(root, TAMPERED[case](lines_of(root)))
    gaps = OpenedKeystore(root).ledger.gaps
    assert gaps
    present = certificate(root / "enclaves/a/cert.pem").serial_number
    done = revoke(root, ["/a"], now=NOW)
    assert present in revoked(root)
    assert any(gaps[0] in remark.text and "stay valid" in remark.text for remark in done.remarks)
    # What the new head signs hides nothing of it.
    assert gaps[0] in OpenedKeystore(root).ledger.gaps
    renew(root, ["/b"], now=NOW, new_key=True) if "/b" in certain(root) else None
    assert gaps[0] in OpenedKeystore(root).ledger.gaps


def test_who_certifies_a_key_is_told_that_the_ledger_may_lack_revocations(root: Path) -> None:
    def kinds(name: str) -> set[str]:
        signed = sign_request(root, make_request(generate_key(), name), now=NOW)
        return {note.id for note in signed.notes}

    assert "ledger.may-lack-revocations" not in kinds("/whole")
    put(root, lines_of(root)[:-1])
    assert "ledger.may-lack-revocations" in kinds("/cut")
    assert "ledger.may-lack-revocations" in kinds("/later")


def certain(root: Path) -> set[str]:
    return {
        each.enclave for each in OpenedKeystore(root).ledger.certain if each.what == "permissions"
    }


def test_what_sros_says_of_a_changed_ledger(root: Path) -> None:
    quiet = sros("check", root, "--include", "keystore.ledger-*").ok()
    assert "ledger" not in quiet.out
    put(root, lines_of(root)[:-1])
    text = "1 line is missing at its end"
    for words in (("inspect", root), ("inspect", root, "--history"), ("check", root)):
        ended = sros(*words)
        assert (ended.status, text in ended.out) == (1, True), ended
    ended = sros("revoke", root, "/a").ok()
    assert text in ended.err
    assert "rotate_ca" in ended.err


def test_a_whole_ledger_revokes_everything_and_says_nothing(root: Path) -> None:
    issued = [each for each in OpenedKeystore(root).ledger.entries if each.what == "certificate"]
    wanted = {int(each.serial, 16) for each in issued if each.enclave == "/a"}
    assert len(wanted) == 2
    assert revoke(root, ["/a"], now=NOW).remarks == ()
    assert revoked(root) == wanted


def test_the_head_is_signed_by_a_ca(root: Path, tmp_path: Path) -> None:
    """OpenSSL agrees, and neither another key nor another text is accepted."""
    authority = root / "public/identity_ca.cert.pem"
    words = ["openssl", "smime", "-verify", "-in", root / LEDGER_HEAD, "-CAfile", authority]
    assert f"lines {len(lines_of(root))}" in run([*map(str, words), "-text"]).stdout
    folder = root / "enclaves/b"
    own = load_certificate((folder / "cert.pem").read_bytes(), "")
    key = load_key((folder / "key.pem").read_bytes(), "")
    document = smime.parse((root / LEDGER_HEAD).read_bytes()).document
    (root / LEDGER_HEAD).write_bytes(smime.sign(document, own, key))
    assert "no CA of this keystore signed it" in OpenedKeystore(root).ledger.gaps[0]
    shutil.copy(root / "enclaves/governance.p7s", root / LEDGER_HEAD)
    assert "is not the signed end" in OpenedKeystore(root).ledger.gaps[0]
    (root / LEDGER_HEAD).unlink()
    assert "is missing" in OpenedKeystore(root).ledger.gaps[0]


def test_who_takes_chain_and_head_away_is_noticed(root: Path) -> None:
    put(root, TAMPERED["the chain taken out"](lines_of(root)))
    (root / LEDGER_HEAD).unlink()
    ledger = OpenedKeystore(root).ledger
    assert ledger.gaps and not ledger.certain
    create_enclaves(root, ["/new"], now=NOW)
    assert OpenedKeystore(root).ledger.gaps[0] == ledger.gaps[0]


def test_a_reader_during_a_commit_and_a_link_in_the_way(root: Path, tmp_path: Path) -> None:
    """While a transaction ends the file is a link; a writer, which holds the lock, follows none."""
    (root / LEDGER).rename(tmp_path / "moved")
    (root / LEDGER).symlink_to(tmp_path / "moved")
    assert OpenedKeystore(root).ledger.gaps == ()
    with pytest.raises(KeystoreError, match="cannot be read"):
        renew(root, ["/a"], now=NOW)


def test_new_cas_leave_the_gaps_behind(root: Path) -> None:
    put(root, _edit(lines_of(root)))
    assert OpenedKeystore(root).ledger.gaps
    renew_identity_ca(root, now=NOW)  # with the same key, what was issued before stays valid
    assert OpenedKeystore(root).ledger.gaps
    rotate_ca(root, now=NOW, finish=True)
    ledger = OpenedKeystore(root).ledger
    assert ledger.gaps == ()
    assert {each.enclave for each in ledger.certain if each.what == "certificate"} == {"/a", "/b"}
    put(root, lines_of(root)[:-1])
    assert OpenedKeystore(root).ledger.gaps


@pytest.mark.parametrize("put_back", [True, False], ids=["older", "none"])
def test_an_older_revocation_list_brings_nothing_back(put_back: bool, root: Path) -> None:
    file = root / "public/identity_ca.crl.pem"
    refresh_crl(root, now=NOW)
    older = file.read_bytes()
    done = revoke(root, ["/a"], now=NOW)
    assert done.remarks == ()
    wanted = revoked(root)
    assert len(wanted) == 2
    assert refresh_crl(root, now=NOW).remarks == ()
    file.write_bytes(older) if put_back else file.unlink()
    (remark,) = refresh_crl(root, now=NOW).remarks
    assert "2 revocations that it lacked were added again" in remark.text
    assert revoked(root) == wanted


def test_a_revoked_certificate_that_the_ledger_lost_is_revoked_again(root: Path) -> None:
    first = certificate(root / "enclaves/a/cert.pem").serial_number
    revoke(root, ["/a"], now=NOW)
    for path in (root / LEDGER, root / "public/identity_ca.crl.pem"):
        path.unlink()
    (root / "revoked/not a number").mkdir()
    (root / "revoked/not a number/cert.pem").write_text("no certificate")
    create_enclaves(root, ["/a"], now=NOW)
    second = certificate(root / "enclaves/a/cert.pem").serial_number
    revoke(root, ["/a"], now=NOW)
    assert revoked(root) >= {first, second}


def test_a_huge_ledger_and_a_pipe_are_refused(tmp_path: Path) -> None:
    """A sparse file takes no space on the disk, and would take all memory."""
    (tmp_path / LEDGER).touch()
    os.truncate(tmp_path / LEDGER, 1 << 40)
    with pytest.raises(KeystoreError, match="too large"):
        _ = OpenedKeystore(tmp_path).ledger
    (tmp_path / LEDGER).unlink()
    os.mkfifo(tmp_path / LEDGER)
    with pytest.raises(KeystoreError, match="not a regular file"):
        _ = OpenedKeystore(tmp_path).ledger


@pytest.mark.parametrize("case", TAMPERED)
def test_reading_some_entries_proves_the_chain_of_all(case: str, root: Path) -> None:
    wanted = ("enclave", "/b")

    def some() -> None:
        every, found = OpenedKeystore(root).ledger, OpenedKeystore(root).ledger_with(*wanted)
        for entries, those in ((every.entries, found.entries), (every.certain, found.certain)):
            expected = [each for each in entries if each.enclave == "/b"]
            assert [each for each in those if each.enclave == "/b"] == expected
        assert (found.gaps, found.lines) == (every.gaps, every.lines)

    some()
    assert len(OpenedKeystore(root).ledger_with(*wanted).entries) < len(
        OpenedKeystore(root).ledger.entries
    )
    put(root, TAMPERED[case](lines_of(root)))
    some()
    revoke(root, ["/a"], now=NOW)  # which records what is wrong
    some()


def test_a_line_in_another_form_is_read_as_ever(root: Path) -> None:
    """A line that was written by hand, or by an earlier version, need not have the form of ours."""
    before = OpenedKeystore(root).ledger.entries
    spaced = [json.dumps(json.loads(line)).encode() for line in lines_of(root)]
    put(root, [re.sub(rb', "previous": "[0-9a-f]+"', b"", line) for line in spaced])
    (root / LEDGER_HEAD).unlink()
    assert [each._replace(previous="") for each in before] == list(
        OpenedKeystore(root).ledger.entries
    )
    put(root, [*lines_of(root)[:4], b'{"time":"x","what":"certificate","serial":"000"}'])
    assert len(OpenedKeystore(root).ledger.entries) == 4


def test_a_ledger_of_many_lines_that_sros_did_not_write(root: Path) -> None:
    """They are one fault, not as many as lines."""
    lines = lines_of(root)
    put(root, [*lines[:3], *([b""] * 5000), *lines[3:], b"nonsense"])
    ledger = OpenedKeystore(root).ledger
    assert len(ledger.entries) == len(lines)
    assert ledger.gaps[0] == "lines 4 to 5003 are not entries"
    put(root, [*lines, *([b'{"time":"x","what":"ca"}'] * 5000)])
    first, last = len(lines) + 1, len(lines) + 5000
    (text, of_head) = OpenedKeystore(root).ledger.gaps
    assert text == f"lines {first} to {last} were added by another program"
    assert of_head == f"line {first} was added by another program"
    assert f"line {len(lines) + 5001} is not an entry" in ledger.gaps
    assert len(ledger.gaps) <= 4


@pytest.mark.parametrize("limit", ["_MOST_LINES", "_MOST_BYTES"])
def test_a_ledger_over_the_limit_says_how_to_go_on(
    limit: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = {
        "_MOST_LINES": OpenedKeystore(root).ledger.lines,
        "_MOST_BYTES": (root / LEDGER).stat().st_size,
    }
    with monkeypatch.context() as patch:
        patch.setattr(f"sros_tool.keystore.ledger.{limit}", size[limit])
        assert not OpenedKeystore(root).ledger.gaps
        patch.setattr(f"sros_tool.keystore.ledger.{limit}", size[limit] - 1)
        for work in (
            lambda: OpenedKeystore(root).ledger,
            lambda: create_enclaves(root, ["/new"], now=NOW),
        ):
            with pytest.raises(KeystoreError, match="too large") as refused:
                work()
        assert f"`sros rotate_ca {root} --next`" in refused.value.remedy
    # What the error says to do.
    for name in (LEDGER, LEDGER_HEAD):
        (root / name).rename(tmp_path / f"archived {name}")
    policy = tmp_path / "policy.xml"
    policy.write_text(policy_text({"/a": publish("x"), "/b": publish("x")}))
    sros("generate_artifacts", "-k", root, "-p", policy).ok()
    before = load_certificate((root / "public/identity_ca.cert.pem").read_bytes(), "")
    for _ in range(3):  # distribute, switch, retire
        sros("rotate_ca", root, "--next").ok()
    assert load_certificate((root / "public/identity_ca.cert.pem").read_bytes(), "") != before
    assert OpenedKeystore(root).ledger.gaps == ()
    revoke(root, ["/a"], now=NOW)
