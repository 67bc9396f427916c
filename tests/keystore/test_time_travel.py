"""Ten years of a keystore of 200 enclaves, in a minute: the clock is an argument."""

from __future__ import annotations

import random
import shutil
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from harness import policy_text, publish, topics_of

from sros_tool.errors import KeystoreError
from sros_tool.keystore import (
    create_enclaves,
    create_keystore,
    generate_artifacts,
    transaction,
)
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.history import Status, history
from sros_tool.keystore.parallel import in_shares
from sros_tool.keystore.renew import Threshold, lifetimes, renew
from sros_tool.keystore.revoke import read_crl, refresh_crl, revoke
from sros_tool.keystore.template import load_template
from sros_tool.keystore.verify import check_enclave
from sros_tool.policy import read_policy

BEGIN = datetime(2026, 1, 31, 12, 30, tzinfo=UTC)
MONTH = timedelta(days=30)
MONTHS = 122  # ten years
DUE = Threshold(remaining=timedelta(days=40))
TEMPLATE = replace(
    load_template("production"),
    authority_validity=timedelta(days=11 * 365),
    certificate_validity=timedelta(days=330),
    permissions_validity=timedelta(days=270),
    revocation_validity=timedelta(days=150),
)
ENCLAVES = 200


def problems(root: Path, names: list[str], now: datetime) -> list[str]:
    def work(share: Sequence[str]) -> list[str]:
        return [
            f"{name}: {problem}"
            for name in share
            for problem in check_enclave(enclave_path(root, name), now=now, domain=0).problems
        ]

    return [problem for _, found in in_shares(names, work) for problem in found]


def check_history(root: Path, now: datetime) -> dict[str, int]:
    """The ledger explains every file, and nothing that is served has ended or is revoked."""
    found = history(root, now=now)
    assert not found.unexplained
    counts = dict.fromkeys(Status, 0)
    for item in found.items:
        counts[item.status] += 1
        if item.path and not item.path.startswith("revoked/"):
            assert item.status is Status.CURRENT, (item, now)
        assert item.status is not Status.CURRENT or item.path, item
    return {str(status): count for status, count in counts.items()}


def permit(root: Path, names: list[str], version: int, now: datetime) -> None:
    file = root.with_suffix(".xml")
    file.write_text(policy_text({name: publish(f"/v{version}{name}") for name in names}))
    generate_artifacts(root, policies=[read_policy(file)], now=now)


def test_ten_years(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Nobody pulls the plug here, and 500 flushes of the disk would wait for everybody's files.
    monkeypatch.setattr(transaction, "_flush_file_system", lambda _: None)
    chance = random.Random(11)
    root = tmp_path / "ks"
    names = [f"/fleet/robot_{number}" for number in range(ENCLAVES)]
    create_keystore(root, template=TEMPLATE, now=BEGIN)
    create_enclaves(root, names, now=BEGIN)
    rights: dict[str, str] = {}
    thieves: list[tuple[Path, datetime]] = []
    renewed = 0
    for month in range(1, MONTHS + 1):
        now = BEGIN + month * MONTH
        # What the last month left behind has lasted until now.
        assert not problems(root, names, now), now
        renewed += len(renew(root, now=now, expiring=DUE).renewed)
        changed = chance.sample(names, 3)
        permit(root, changed, month, now)
        rights |= {name: f"rt/v{month}{name}" for name in changed}
        if month % 6 == 1:
            gone = chance.choice(names)
            stolen = tmp_path / f"stolen{month}"
            shutil.copytree(enclave_path(root, gone), stolen)
            thieves.append((stolen, now))
            told = revoke(root, [gone], now=now, reason="keyCompromise")
            assert len(told.restart) == ENCLAVES - 1
            create_enclaves(root, [gone], now=now)  # made anew, with what a node needs and no more
            rights.pop(gone, None)
            changed.append(gone)
        crl = read_crl(root)
        assert crl
        assert crl.next_update > now
        if crl.next_update - now < timedelta(days=70):
            refresh_crl(root, now=now)
        assert not problems(root, changed, now), now
        check_history(root, now)
    end = BEGIN + MONTHS * MONTH
    assert not problems(root, names, end)
    for name, topic in rights.items():
        assert topic in topics_of(enclave_path(root, name)), name
    for folder, _ in thieves:
        shutil.copy(root / "public/identity_ca.crl.pem", folder / "crl.pem")
        found = check_enclave(folder, now=end).problems
        assert "cert.pem: it is revoked by crl.pem" in map(str, found), folder
    counts = check_history(root, end)
    assert counts["current"] == 2 * ENCLAVES + 4  # and two CAs, governance and the list
    assert counts["revoked"] >= 2 * len(thieves)
    assert counts["expired"] > ENCLAVES * 2 * 11
    assert renewed > ENCLAVES * 12
    assert len(thieves) == 21


def test_without_renewal_the_checks_of_ten_years_would_fail(tmp_path: Path) -> None:
    """The positive twin of "nothing has ended" is that an end is seen."""
    root = tmp_path / "ks"
    create_keystore(root, template=TEMPLATE, now=BEGIN)
    create_enclaves(root, ["/a", "/b"], now=BEGIN)
    revoke(root, ["/b"], now=BEGIN)
    for days, expected in (
        (100, []),
        (151, ["crl.pem"]),
        (271, ["crl.pem", "permissions.p7s"]),
        (331, ["cert.pem", "crl.pem", "permissions.p7s"]),
    ):
        now = BEGIN + timedelta(days=days)
        found = check_enclave(enclave_path(root, "/a"), now=now).problems
        assert sorted({problem.file for problem in found}) == expected, days
        (life,) = lifetimes(root)
        assert life.due(Threshold(remaining=timedelta(0)), now) == (days > 270)
    late = BEGIN + timedelta(days=400)
    with pytest.raises(AssertionError):
        check_history(root, late)
    renew(root, ["/a"], now=late)
    refresh_crl(root, now=late)
    assert not problems(root, ["/a"], late)
    check_history(root, late)
    after = BEGIN + timedelta(days=12 * 365)
    with pytest.raises(KeystoreError, match=r"CA .* is not valid now"):
        renew(root, ["/a"], now=after)
