"""Ten years of a keystore of 200 enclaves (four of 8 in the short form), whose clock is given."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from sros_tool.errors import KeystoreError
from sros_tool.keystore import describe as history_of_keystores
from sros_tool.keystore.describe import HistoryStatus, history
from sros_tool.keystore.expiry import Threshold, survey
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.template import load_template
from sros_tool.parallel import map_slices
from sros_tool.pki.certificates import issued_by, validity_of
from sros_tool.pki.crl import load_crl, signed_by
from sros_tool.policy.document import read_policy
from sros_tool.validity import Window
from tests.support.children import LONG
from tests.support.harness import certificate, policy_text, publish, topics_of
from tests.support.long_form import sometimes

BEGIN = datetime(2026, 1, 31, 12, 30, tzinfo=UTC)
MONTH = timedelta(days=30)
YEARS = 10 if LONG else 4
MONTHS = 12 * YEARS + 2
DUE = Threshold(remaining=timedelta(days=40))
TEMPLATE = replace(
    load_template("production"),
    authority_validity=timedelta(days=(YEARS // 2 + 1) * 365),  # they have to be replaced once
    certificate_validity=timedelta(days=330),
    permissions_validity=timedelta(days=270),
    revocation_validity=timedelta(days=150),
)
ENCLAVES, CHANGED = (200, 3) if LONG else (8, 1)  # of which so many get new rights each month
HALF = 6 * YEARS
ROTATION = {
    HALF: RotationStage.DISTRIBUTE,
    HALF + 3: RotationStage.REISSUE,
    HALF + 8: RotationStage.RETIRE,
}
REVOKED = {*range(1, MONTHS + 1, 6), HALF + 2, HALF + 5}  # so there is one in every stage
PERSONAL = ("cert.pem", "permissions.p7s", "key.pem")
COMMON = ("identity_ca.cert.pem", "permissions_ca.cert.pem", "governance.p7s")


# ── everything verifies, and nothing that is served has ended ──────────────────────────────


Signature = tuple[tuple[int, int, int], ...]
"""What tells files from others that took their place: every write makes a new one."""


def signature(folder: Path, files: Sequence[str]) -> Signature:
    found = []
    for file in files:
        try:
            status = os.stat(f"{folder}/{file}")
            found.append((status.st_ino, status.st_mtime_ns, status.st_size))
        except FileNotFoundError:
            found.append((0, 0, 0))
    return tuple(found)


@dataclass(frozen=True)
class Life:
    """The serial number of an enclave's certificate, and the time in which its files hold."""

    serial: int
    windows: list[Window]


class Verified:
    """Enclaves whose files were checked in full, and the time in which these hold.

    What has not changed since verifies still, as long as none of it ends; so a month costs only
    what changed in it.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._common: Signature = ()
        self._common_life: list[Window] = []
        self._known: dict[str, tuple[Signature, Life]] = {}
        self.in_full = 0

    def problems(self, names: Sequence[str], now: datetime) -> list[str]:
        """What is wrong with the enclaves at ``now``."""
        first = enclave_path(self._root, names[0])
        common = signature(first, COMMON)
        if common != self._common:
            self._known.clear()
            self._common, self._common_life = common, _lives(first)
        found = [f"{life}" for life in self._common_life if not life.contains(now)]
        crl = OpenedKeystore(self._root).revocation_list
        if crl:
            (authority, *_) = OpenedKeystore(self._root).certificates_of("identity_ca")
            assert signed_by(crl.list, authority)
            if not Window(crl.this_update, crl.next_update).contains(now):
                found.append("crl.pem")
        revoked = {each.serial for each in crl.revoked} if crl else set()
        changed = {}
        for name in names:
            own = signature(enclave_path(self._root, name), PERSONAL)
            if name not in self._known or self._known[name][0] != own:
                changed[name] = own
                continue
            life = self._known[name][1]
            found += [f"{name}: {each}" for each in life.windows if not each.contains(now)]
            if crl and not (enclave_path(self._root, name) / "crl.pem").exists():
                found.append(f"{name}: no crl.pem")
            if life.serial in revoked:
                found.append(f"{name}: revoked")
        self.in_full += len(changed)
        for name, (life, problems) in self._check(list(changed), now).items():
            self._known[name] = (changed[name], life)
            found += problems
        return found

    def _check(self, names: list[str], now: datetime) -> dict[str, tuple[Life, list[str]]]:
        def work(share: Sequence[str]) -> dict[str, tuple[Life, list[str]]]:
            found = {}
            for name in share:
                folder = enclave_path(self._root, name)
                state = open_enclave(folder, now=now, domain=0)
                assert state.certificate
                assert state.permissions
                windows = [validity_of(state.certificate)]
                windows += [grant.validity for grant in state.permissions.grants]
                for file in (*COMMON, "crl.pem"):  # all have the very files that are looked at once
                    path = folder / file
                    assert not path.exists() or path.resolve() == self._real(file), path
                problems = [f"{name}: {problem}" for problem in state.problems]
                found[name] = (Life(state.certificate.serial_number, windows), problems)
            return found

        return {name: each for _, found in map_slices(names, work) for name, each in found.items()}

    def _real(self, file: str) -> Path:
        place = {"crl.pem": "public/identity_ca.crl.pem", "governance.p7s": "enclaves/" + file}
        return (self._root / place.get(file, f"public/{file}")).resolve()


def _lives(folder: Path) -> list[Window]:
    """Of the CAs, and of the list that the file of the identity CAs carries in a rotation."""
    identity, permissions = ((folder / file).read_bytes() for file in COMMON[:2])
    lives = [
        validity_of(each)
        for data in (identity, permissions)
        for each in x509.load_pem_x509_certificates(data)
    ]
    if b"X509 CRL" in identity:
        found = load_crl(identity, "in it")
        lives.append(Window(found.this_update, found.next_update))
    return lives


def check_history(root: Path, now: datetime) -> dict[str, int]:
    """The ledger explains every file, and nothing that is served has ended or is revoked."""
    found = history(OpenedKeystore(root), now=now)
    assert not found.unexplained
    counts = dict.fromkeys(HistoryStatus, 0)
    for item in found.entries:
        counts[item.status] += 1
        if item.path.startswith("retired/"):
            assert item.status is HistoryStatus.RETIRED
        elif item.path and not item.path.startswith("revoked/"):
            assert item.status is HistoryStatus.CURRENT, (item, now)
        assert item.status is not HistoryStatus.CURRENT or item.path, item
    return {str(status): count for status, count in counts.items()}


# ── nobody who was revoked is accepted ─────────────────────────────────────────────────────


@dataclass(frozen=True)
class Thief:
    """A certificate of an enclave at the moment when it was revoked, and where it is kept."""

    path: Path
    certificate: x509.Certificate


def refusal(root: Path, thief: Thief, now: datetime) -> str:
    """Why whoever trusts all CAs of the keystore, as Fast DDS does, refuses a thief; or ""."""
    trusted = OpenedKeystore(root).certificates_of("identity_ca")
    issuers = [each for each in trusted if issued_by(thief.certificate, each)]
    if not issuers:
        return "not trusted"
    lists = [
        each for each in OpenedKeystore(root).revocation_lists if signed_by(each.list, issuers[0])
    ]
    if any(each.revokes(thief.certificate.serial_number) for each in lists):
        return "revoked"
    return "" if validity_of(thief.certificate).contains(now) else "ended"


OPENSSL_SAYS = {
    "revoked": "certificate revoked",
    "ended": "certificate has expired",
    "not trusted": "unable to get local issuer certificate",
}


def ask_openssl(root: Path, names: Sequence[str], thieves: Sequence[Thief], now: datetime) -> None:
    """OpenSSL accepts all enclaves and refuses all thieves, for the reason that is expected."""
    public = root / "public"
    at = ["-attime", int(now.timestamp())]
    verify: list[object] = ["verify", "-x509_strict", *at]
    verify += ["-crl_check", "-CAfile", public / "identity_ca.cert.pem"]
    verify += ["-CRLfile", public / "identity_ca.crl.pem"]
    own = [enclave_path(root, name) / "cert.pem" for name in names]
    said = subprocess.run(["openssl", *map(str, [*verify, *own])], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    assert said.stdout.count(": OK\n") == len(own)
    for thief in thieves:
        words = ["openssl", *map(str, [*verify, thief.path])]
        said = subprocess.run(words, capture_output=True, text=True)
        assert OPENSSL_SAYS[refusal(root, thief, now)] in said.stderr, (said, now)
    signed = ["governance.p7s", "permissions.p7s"]
    authority = public / "permissions_ca.cert.pem"
    for document in signed:
        smime = ["smime", "-verify", "-text", *at, "-CAfile", authority]
        smime += ["-in", enclave_path(root, names[0]) / document]
        said = subprocess.run(["openssl", *map(str, smime)], capture_output=True, text=True)
        assert said.returncode == 0, said.stderr


# ── years ──────────────────────────────────────────────────────────────────────────────────


def remember_digests(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is in a file that nobody replaced since last month is known."""
    known: dict[Path, tuple[Signature, list[str]]] = {}
    compute = history_of_keystores._ledger_digests

    def remembered(path: Path) -> list[str]:
        now = signature(path.parent, [path.name])
        if path not in known or known[path][0] != now:
            known[path] = (now, compute(path))
        return known[path][1]

    monkeypatch.setattr(history_of_keystores, "_ledger_digests", remembered)


def permit(root: Path, names: list[str], version: int, now: datetime) -> None:
    file = root.with_suffix(".xml")
    file.write_text(policy_text({name: publish(f"/v{version}{name}") for name in names}))
    generate_artifacts(root, policies=[read_policy(file)], now=now)


@sometimes("years of a keystore")
def test_years(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Nobody pulls the plug here, and 500 flushes of the disk would wait for everybody's files.
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    remember_digests(monkeypatch)
    chance = random.Random(11)
    root = tmp_path / "ks"
    names = [f"/fleet/robot_{number}" for number in range(ENCLAVES)]
    create_keystore(root, template=TEMPLATE, now=BEGIN)
    create_enclaves(root, names, now=BEGIN)
    verified = Verified(root)
    rights: dict[str, str] = {}
    thieves: list[Thief] = []
    refused: Counter[tuple[RotationStage, str]] = Counter()
    longest = renewed = 0
    for month in range(1, MONTHS + 1):
        now = BEGIN + month * MONTH
        # What the last month left behind has lasted until now.
        assert not verified.problems(names, now), now
        if month in ROTATION:
            assert rotate_ca(root, now=now).stage is ROTATION[month]
        renewed += len(renew(root, now=now, expiring=DUE).names("renewed"))
        changed = chance.sample(names, CHANGED)
        permit(root, changed, month, now)
        rights |= {name: f"rt/v{month}{name}" for name in changed}
        if month in REVOKED:
            gone = chance.choice(names)
            stolen = tmp_path / f"stolen{month}.pem"
            shutil.copy(enclave_path(root, gone) / "cert.pem", stolen)
            thieves.append(Thief(stolen, certificate(stolen)))
            assert not refusal(root, thieves[-1], now)  # so far it is as good as any
            told = revoke(root, [gone], now=now, reason="keyCompromise")
            assert len(told.restart) == ENCLAVES - 1
            assert not told.remarks
            create_enclaves(root, [gone], now=now)  # made anew, with what a node needs and no more
            rights.pop(gone, None)
        if min(
            each.next_update for each in OpenedKeystore(root).revocation_lists
        ) - now < timedelta(days=70):
            refresh_crl(root, now=now)
        assert not verified.problems(names, now), now
        check_history(root, now)
        stage = read_rotation(OpenedKeystore(root)).stage
        for thief in thieves:
            why = refusal(root, thief, now)
            assert why, (thief, now)
            refused[stage, why] += 1
        crl = OpenedKeystore(root).revocation_list
        assert crl
        longest = max(longest, len(crl.revoked))
        if month % 12 == 0 or month in ROTATION or month - 2 in ROTATION:
            ask_openssl(root, names, thieves, now)
    end = BEGIN + MONTHS * MONTH
    assert not Verified(root).problems(names, end)  # all anew
    for name, topic in rights.items():
        assert topic in topics_of(enclave_path(root, name)), name
    assert {stage for stage, why in refused if why == "revoked"} == {
        RotationStage.NONE,
        RotationStage.DISTRIBUTE,
        RotationStage.REISSUE,
    }
    assert refused[RotationStage.NONE, "not trusted"]
    assert refused[RotationStage.NONE, "ended"]
    counts = check_history(root, end)
    assert counts["current"] == 2 * ENCLAVES + 5  # and two CAs, governance, settings, the list
    assert counts["retired"] == 2
    assert counts["revoked"] >= 2 * len(thieves)
    assert counts["expired"] > ENCLAVES * 2 * YEARS
    assert renewed > ENCLAVES * YEARS
    # The list lost what had ended; the ledger has it all.
    known = {
        each.serial for each in OpenedKeystore(root).ledger.entries if each.what == "revocation"
    }
    assert {f"{thief.certificate.serial_number:x}" for thief in thieves} <= known
    assert longest < len(known) / 2
    assert verified.in_full > ENCLAVES * YEARS, verified.in_full


def test_without_renewal_the_checks_of_years_would_fail(tmp_path: Path) -> None:
    """The positive twin of "nothing has ended" is that an end is seen."""
    root = tmp_path / "ks"
    create_keystore(root, template=TEMPLATE, now=BEGIN)
    create_enclaves(root, ["/a", "/b"], now=BEGIN)
    revoke(root, ["/b"], now=BEGIN)
    early = Verified(root)
    for days, expected in (
        (100, []),
        (151, ["crl.pem"]),
        (271, ["crl.pem", "permissions.p7s"]),
        (331, ["cert.pem", "crl.pem", "permissions.p7s"]),
    ):
        now = BEGIN + timedelta(days=days)
        found = open_enclave(enclave_path(root, "/a"), now=now).problems
        # What was checked once is found to end by its dates alone, as all else that ends.
        assert not early.problems(["/a"], BEGIN)
        assert bool(early.problems(["/a"], now)) == bool(expected), days
        assert sorted({problem.file for problem in found}) == expected, days
        (life,), _ = survey(OpenedKeystore(root))
        assert life.is_due(Threshold(remaining=timedelta(0)), now) == (days > 270)
    late = BEGIN + timedelta(days=400)
    with pytest.raises(AssertionError):
        check_history(root, late)
    renew(root, ["/a"], now=late)
    refresh_crl(root, now=late)
    assert not early.problems(["/a"], late)
    assert early.in_full == 2
    check_history(root, late)
    after = BEGIN + timedelta(days=7 * 365)
    with pytest.raises(KeystoreError, match=r"CA .* is not valid now"):
        renew(root, ["/a"], now=after)
