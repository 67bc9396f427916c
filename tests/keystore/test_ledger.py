"""The ledger lists everything that was issued, and the history shows its current state."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import hashes

from sros_tool.errors import KeystoreError
from sros_tool.keystore.describe import HistoryStatus, history
from sros_tool.keystore.layout import LEDGER
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.lifecycle.create import (
    create_enclaves,
    create_keystore,
    create_permission,
    generate_artifacts,
)
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.keystore.transaction import Transaction
from sros_tool.policy.document import read_policy
from tests.support.harness import certificate, policy_text, publish, snapshot, sros

NOW = datetime(2026, 6, 1, tzinfo=UTC)


def made(root: Path, *names: str, template: str = "production") -> Path:
    create_keystore(root, template=load_template(template), now=NOW)
    create_enclaves(root, names, now=NOW)
    return root


def told(root: Path) -> list[tuple[str, str]]:
    return [(entry.what, entry.enclave) for entry in OpenedKeystore(root).ledger.entries]


@pytest.mark.parametrize(
    ("template", "authorities"), [("production", 2), ("development", 2), ("sros2", 1)]
)
def test_every_command_records_what_it_issues(
    template: str, authorities: int, tmp_path: Path
) -> None:
    root = made(tmp_path / "ks", "/a", "/b", template=template)
    both = [("certificate", "/a"), ("permissions", "/a")]
    expected = [("ca", "")] * authorities + [("governance", ""), ("settings", "")] + both
    expected += [("certificate", "/b"), ("permissions", "/b")]
    assert told(root) == expected
    create_enclaves(root, ["/a"], now=NOW)  # nothing to do
    assert told(root) == expected
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("x")}))
    generate_artifacts(root, policies=[read_policy(policy)], now=NOW)
    renew(root, ["/a"], now=NOW)
    revoke(root, ["/b"], now=NOW)
    refresh_crl(root, now=NOW)
    expected += [("permissions", "/a"), *both, ("revocation", "/b"), ("crl", ""), ("crl", "")]
    assert told(root) == expected


def test_entries_describe_the_files_in_the_keystore(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    by_kind = {entry.what: entry for entry in OpenedKeystore(root).ledger.entries}
    issued = certificate(root / "enclaves/a/cert.pem")
    entry = by_kind["certificate"]
    assert entry.sha256 == issued.fingerprint(hashes.SHA256()).hex()
    assert int(entry.serial, 16) == issued.serial_number
    assert entry.subject == issued.subject.rfc4514_string()
    assert (entry.time, entry.not_after) == ("2026-06-01T00:00:00Z", "2027-06-01T00:00:00Z")
    for what, file in (("permissions", "a/permissions.p7s"), ("governance", "governance.p7s")):
        message = (root / "enclaves" / file).read_bytes()
        assert by_kind[what].sha256 == hashlib.sha256(message).hexdigest()
    assert by_kind["permissions"].not_after == "2026-11-28T00:00:00Z"


def test_a_renewal_keeps_the_digest_of_the_policy(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("x")}))
    read = read_policy(policy)
    generate_artifacts(root, policies=[read], now=NOW)
    renew(root, ["/a"], now=NOW)
    renew(root, ["/a", "/b"], now=NOW, new_key=True)
    digests = [
        entry.policy for entry in OpenedKeystore(root).ledger.entries if entry.what == "permissions"
    ]
    default, own = digests[0], read.enclaves[0].digest
    assert default
    assert own
    assert default != own
    assert digests == [default, default, own, own, own, default]


def test_without_new_documents_the_ledger_does_not_change(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    before = snapshot(root)
    renew(root, ["/a"], now=NOW, dry_run=True)
    revoke(root, ["/a"], now=NOW, dry_run=True)
    with pytest.raises(KeystoreError):
        revoke(root, ["/a", "/missing"], now=NOW)
    with Transaction(root) as transaction:
        transaction.commit()
    assert snapshot(root) == before


def test_the_history_names_what_was_signed_from_a_policy(keystore: Path, tmp_path: Path) -> None:
    policy = tmp_path / "policy.xml"
    policy.write_text(policy_text({"/a": publish("old_a"), "/b": publish("old_b")}))
    listed = ("inspect", keystore, "--history", "--policy", policy)
    found = sros(*listed).ok()
    words = [line.split() for line in found.out.splitlines()]
    assert [(line[1], line[3]) for line in words] == [("permissions", "/a"), ("permissions", "/b")]
    assert found.err.startswith(
        f"permissions of 2 enclaves were signed from the current '{policy}';"
    )
    assert len(json.loads(sros(*listed, "--json").out)["entries"]) == 2
    policy.write_text(f"{policy.read_text()}<!-- changed -->")
    assert (sros(*listed).status, sros(*listed).out) == (1, "")
    assert sros("inspect", keystore, "--policy", policy).status == 2


REVOCATION = '{"time":"x","what":"revocation"}'
"""A line that names no certificate."""


@pytest.mark.parametrize(
    "line",
    ["{", "[]", "3", '{"unknown": 1}', '{"time": "x"}', "\xff", REVOCATION, f"{REVOCATION} "],
)
def test_a_damaged_ledger_is_reported_and_kept(line: str, tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    with (root / LEDGER).open("a", encoding="latin-1") as file:
        file.write(line + "\n")
    before = snapshot(root)
    assert OpenedKeystore(root).ledger.gaps[0] == "line 7 is not an entry"
    ended = sros("inspect", root, "--history")
    assert (ended.status, ended.err) == (1, ""), ended
    assert "LEDGER DAMAGED  line 7 is not an entry" in ended.out
    assert snapshot(root) == before


def test_a_missing_newline_at_the_end_is_added(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    ledger = root / LEDGER
    ledger.write_bytes(ledger.read_bytes().removesuffix(b"\n"))
    before = OpenedKeystore(root).ledger.entries
    renew(root, ["/a"], now=NOW)
    assert OpenedKeystore(root).ledger.entries[: len(before)] == before
    assert len(OpenedKeystore(root).ledger.entries) == len(before) + 2


def test_a_keystore_without_a_ledger_gets_one(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    (root / LEDGER).unlink()
    assert OpenedKeystore(root).ledger.entries == ()
    assert len(history(OpenedKeystore(root), now=NOW).unexplained) == 5
    with pytest.raises(KeystoreError, match="not certain that"):
        renew(root, ["/a"], now=NOW)
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("x")}))
    create_permission(root, ["/a"], read_policy(policy), now=NOW)
    renew(root, ["/a"], now=NOW)
    both = [("certificate", "/a"), ("permissions", "/a")]
    assert told(root) == [("gap", ""), ("permissions", "/a"), *both]
    assert history(OpenedKeystore(root), now=NOW).unexplained == (
        "enclaves/governance.p7s",
        "public/identity_ca.cert.pem",
        "public/permissions_ca.cert.pem",
    )


# ── history ────────────────────────────────────────────────────────────────────────────────


def statuses(root: Path, now: datetime) -> dict[tuple[str, str], list[str]]:
    found: dict[tuple[str, str], list[str]] = {}
    for item in history(OpenedKeystore(root), now=now).entries:
        found.setdefault((item.entry.what, item.entry.enclave), []).append(str(item.status))
    return found


def test_every_item_has_its_status(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", "/c")
    later = NOW + timedelta(days=90)
    renew(root, ["/a", "/b"], now=later)
    revoke(root, ["/b"], now=later)
    assert statuses(root, later) == {
        ("ca", ""): ["current"] * 2,
        ("governance", ""): ["current"],
        ("settings", ""): ["current"],
        ("certificate", "/a"): ["superseded", "current"],
        ("permissions", "/a"): ["superseded", "current"],
        ("certificate", "/b"): ["revoked", "revoked"],
        ("permissions", "/b"): ["superseded", "revoked"],
        ("certificate", "/c"): ["current"],
        ("permissions", "/c"): ["current"],
        ("revocation", "/b"): ["revoked"] * 2,
        ("crl", ""): ["current"],
    }
    end = NOW + timedelta(days=181)  # the first permissions expired, but no certificate
    found = statuses(root, end)
    assert found["permissions", "/a"] == ["expired", "current"]
    assert found["permissions", "/c"] == ["expired"]
    assert found["certificate", "/a"] == ["superseded", "current"]
    paths = {item.path for item in history(OpenedKeystore(root), now=end).entries}
    assert "enclaves/a/cert.pem" in paths
    assert any(path.startswith("revoked/") for path in paths)


def test_files_without_an_entry_are_listed(tmp_path: Path) -> None:
    root, other = made(tmp_path / "ks", "/a", "/b"), made(tmp_path / "other", "/a")
    assert history(OpenedKeystore(root), now=NOW).unexplained == ()
    for file in ("cert.pem", "permissions.p7s"):
        (root / "enclaves/a" / file).write_bytes((other / "enclaves/a" / file).read_bytes())
    (root / "enclaves/b/cert.pem").write_bytes(b"no certificate")
    assert history(OpenedKeystore(root), now=NOW).unexplained == (
        "enclaves/a/cert.pem",
        "enclaves/a/permissions.p7s",
        "enclaves/b/cert.pem",
    )
    ended = sros("inspect", root, "--history")
    assert ended.status == 1
    assert ended.out.splitlines()[-3] == "NOT IN THE LEDGER  enclaves/a/cert.pem"


def test_history_as_text_and_json(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/a", "/b").ok()
    sros("revoke", root, "/b", "--reason", "key_compromise").ok()
    lines = sros("inspect", root, "--history").ok().out.splitlines()
    assert len(lines) == len(OpenedKeystore(root).ledger.entries) == 10
    assert [line.split()[1:3] for line in lines[:5]] == [
        ["ca", "current"],
        ["ca", "current"],
        ["governance", "current"],
        ["settings", "current"],
        ["certificate", "current"],
    ]
    assert "keyCompromise" in lines[8]
    document = json.loads(sros("inspect", root, "--history", "--json").ok().out)
    assert set(document) == {"version", "kind", "path", "entries", "unexplained", "gaps"}
    assert len(document["entries"]) == 10
    assert {*document["entries"][3]} == {*Entry._fields, "status", "path"}
    assert {entry["status"] for entry in document["entries"]} <= set(HistoryStatus)
    assert document["unexplained"] == []


def test_history_needs_a_keystore(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file"):
        ended = sros("inspect", path, "--history")
        assert (ended.status, "is not a valid keystore" in ended.err) == (2, True), ended
