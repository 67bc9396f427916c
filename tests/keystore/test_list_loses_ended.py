"""A revocation list loses what has ended, once it was on a list after its end (RFC 5280, 3.3)."""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.keystore.describe import HistoryStatus, history
from sros_tool.keystore.layout import LEDGER, enclave_path
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revocation_list import RevocationListSigner
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from tests.support.harness import certificate

NOW = datetime(2026, 6, 1, tzinfo=UTC)
DAY = timedelta(days=1)


def listed(root: Path) -> set[int]:
    crl = OpenedKeystore(root).revocation_list
    assert crl
    return {each.serial for each in crl.revoked}


def made(root: Path) -> tuple[Path, int]:
    """A keystore in which /a, whose certificate lives for 100 days, was revoked on the 10th."""
    template = replace(load_template("production"), certificate_validity=100 * DAY)
    create_keystore(root, template=template, now=NOW)
    create_enclaves(root, ["/a", "/b"], now=NOW)
    serial = certificate(enclave_path(root, "/a") / "cert.pem").serial_number
    revoke(root, ["/a"], now=NOW + 10 * DAY)
    return root, serial


@pytest.mark.parametrize("told_by", ["revocation", "certificate", "folder"])
def test_it_stays_until_it_was_on_a_list_after_its_end(
    told_by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if told_by == "certificate":  # as version 0.2 recorded a revocation, without the expiry
        revocations = RevocationListSigner.revocations
        monkeypatch.setattr(
            RevocationListSigner,
            "revocations",
            lambda *given: [entry._replace(not_after="") for entry in revocations(*given)],
        )
    root, serial = made(tmp_path / "ks")
    # As ros2/sros2 leaves it, the certificate that was put away tells; else only the ledger does.
    if told_by == "folder":
        (root / LEDGER).unlink()
    else:
        shutil.rmtree(root / "revoked")
    for days, there in ((50, True), (99, True), (110, True), (120, False), (130, False)):
        refresh_crl(root, now=NOW + days * DAY)
        assert (serial in listed(root)) is there, days


def test_revoking_another_drops_it_too_and_the_ledger_keeps_it(tmp_path: Path) -> None:
    root, serial = made(tmp_path / "ks")
    refresh_crl(root, now=NOW + 110 * DAY)
    late = NOW + 120 * DAY
    create_enclaves(root, ["/late"], now=late)
    other = certificate(enclave_path(root, "/late") / "cert.pem").serial_number
    revoke(root, ["/late"], now=late)
    assert serial not in listed(root)
    assert other in listed(root)
    assert f"{serial:x}" in {
        each.serial for each in OpenedKeystore(root).ledger.entries if each.what == "revocation"
    }
    (found,) = [
        item
        for item in history(OpenedKeystore(root), now=late).entries
        if item.entry.serial == f"{serial:x}" and item.entry.what == "certificate"
    ]
    assert found.status is HistoryStatus.REVOKED


def test_of_what_nobody_knows_the_end_stays(tmp_path: Path) -> None:
    root, serial = made(tmp_path / "ks")
    (root / LEDGER).unlink()
    (root / f"revoked/{serial:x}/cert.pem").unlink()
    for days in (110, 120, 130):
        refresh_crl(root, now=NOW + days * DAY)
    assert serial in listed(root)


@pytest.mark.parametrize("ahead", [(110,), (110, 120), (110, 120, 130)])
def test_a_clock_that_was_ahead_takes_no_revocation_away(
    ahead: tuple[int, ...], tmp_path: Path
) -> None:
    root, serial = made(tmp_path / "ks")
    for days in ahead:
        refresh_crl(root, now=NOW + days * DAY)
    revoke(root, ["/b"], now=NOW + 20 * DAY)
    assert serial in listed(root)
    assert len(listed(root)) == 2


@pytest.mark.parametrize("what", ["revoke", "renew"])
def test_a_certificate_is_revoked_that_only_a_clock_ahead_takes_for_expired(
    what: str, tmp_path: Path
) -> None:
    """The clock is right again later, and the certificate valid."""
    root, _ = made(tmp_path / "ks")
    serial = certificate(enclave_path(root, "/b") / "cert.pem").serial_number
    renew(root, ["/b"], now=NOW + 20 * DAY)
    ahead = NOW + 1500 * DAY
    if what == "renew":
        renew(root, ["/b"], revoke_old=True, now=ahead)
    else:
        revoke(root, ["/b"], now=ahead)
    assert serial in listed(root)
