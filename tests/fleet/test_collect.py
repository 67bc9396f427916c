"""What home takes in from an inbox: verified messages, and renewals that the fleet file allows."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID

from sros_tool.errors import DocumentError, KeystoreError
from sros_tool.folders import Folder
from sros_tool.keystore import transaction
from sros_tool.keystore.confirmation import (
    MAX_BYTES,
    MESSAGE_FILE,
    Confirmation,
    ReceivedConfirmation,
    last_confirmation,
    refusals,
    render_confirmation,
    store_confirmation,
)
from sros_tool.keystore.delivery import collect as collecting
from sros_tool.keystore.delivery.collect import (
    CollectedInbox,
    CollectedMessage,
    CollectedRequest,
    _DecidedRequest,
    collect,
)
from sros_tool.keystore.delivery.publish import age_clause
from sros_tool.keystore.delivery.publish import publish as publish_releases
from sros_tool.keystore.delivery.published import read_published, releases_in
from sros_tool.keystore.delivery.release import seal_releases
from sros_tool.keystore.delivery.signing import certify_requests, sign_request
from sros_tool.keystore.fleet import recorded_fleet
from sros_tool.keystore.fleet_status import fleet_status
from sros_tool.keystore.issuing.authority import load_authority
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import IDENTITY, PERMISSIONS, PUBLISHED, key_on_robot
from sros_tool.keystore.ledger import LATER_RELEASE, RESTORED, certificate_entry
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revocation_list import LostRecords
from sros_tool.keystore.lifecycle.revoke import restore_revocations, revoke
from sros_tool.keystore.reader import OpenedKeystore, read_certificate
from sros_tool.pki import smime
from sros_tool.pki.certificates import Issuer, key_digest, make_request, validity_of
from sros_tool.pki.crl import SUPERSEDED, RevocationEntry, load_crl, sign_crl
from sros_tool.pki.keys import PrivateKey, generate_key, load_key
from sros_tool.validity import BACKDATE, iso, parse_iso
from sros_tool.wording import capitalized
from sros_tool.xml import read_bytes
from tests.dds.signer_rows import signed_by
from tests.support.harness import copy_of, create_request, policy_text, publish, sros
from tests.support.messages import key_of, said_by, signed_message
from tests.support.users import as_root

ROBOTS = ("r1", "r2", "r3")
FLEET = """
[groups.renewing]
renewal = "allowed"
renewal_grace = "30d"
[robots]
r1 = { groups = ["renewing"] }
r2 = { groups = ["renewing"], renewal_grace = "1d" }
r3 = {}
"""
NOW = datetime.now(UTC).replace(microsecond=0) + timedelta(days=1)
"""After everything that the tests make, however long they take."""
DUE = NOW + timedelta(days=150)
"""More than half of the validity of permissions (180 days) is over."""
LATE = NOW + timedelta(days=365 + 9, hours=12)
"""Certificates (365 days) expired ten days ago."""


@dataclass
class Home:
    """A keystore with a fleet, an export for each robot, and an inbox."""

    folder: Path
    sequence: int = 0

    @property
    def root(self) -> Path:
        return self.folder / "ks"

    @property
    def inbox(self) -> Path:
        return self.folder / "inbox"

    def run(self, *words: object) -> None:
        sros(*words, cwd=self.folder).ok()

    def key(self, robot: str, enclave: str) -> PrivateKey:
        return key_of(self.folder / robot, enclave)

    def request(self, robot: str, enclave: str = "", key: PrivateKey | None = None) -> str:
        """Return a request for renewal, with the key of the robot's enclave or another one."""
        enclave = enclave or f"/{robot}/base"
        return make_request(key or self.key(robot, enclave), enclave).decode()

    def said(self, robot: str, now: datetime, **changed: object) -> Confirmation:
        """Return what the agent of a robot confirms, with the next sequence number."""
        self.sequence += 1
        values = {"sequence": self.sequence, **changed}
        return said_by(self.folder / robot, robot, now, **values)

    def message(self, robot: str, now: datetime, enclave: str = "", **changed: object) -> bytes:
        """Return the message of a robot, signed with the key of one of its enclaves."""
        said = self.said(robot, now, **changed)
        return signed_message(self.folder / robot, enclave or f"/{robot}/base", said)

    def put(self, robot: str, message: bytes, now: datetime = NOW) -> Path:
        """Put a message into the folder of a robot at ``now``, as a web server does."""
        file = self.inbox / robot / MESSAGE_FILE
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(message)
        os.utime(file, (now.timestamp(),) * 2)
        return file

    def send(self, robot: str, now: datetime = NOW, enclave: str = "", **changed: object) -> Path:
        return self.put(robot, self.message(robot, now, enclave, **changed), now)

    def collect(self, now: datetime = NOW, **options: object) -> CollectedInbox:
        return collect(self.root, self.inbox, now=now, **options)  # type: ignore[arg-type]

    def outcomes(self, now: datetime = NOW) -> dict[str, str]:
        return {robot.robot: robot.outcome for robot in self.collect(now).robots}

    def of(self, robot: str, now: datetime = NOW, **options: object) -> CollectedMessage:
        """Collect; return what was done with the message of a robot."""
        found = self.collect(now, **options)
        return next(message for message in found.robots if message.robot == robot)

    def kept(self, robot: str) -> int | None:
        """Return the sequence number of the message that is kept of a robot."""
        last = last_confirmation(OpenedKeystore(self.root), robot)
        return last.message.sequence if last and last.message else None

    def alternated(self, robot: str) -> datetime | None:
        """Return when messages of a robot last came from two computers in turn."""
        last = last_confirmation(OpenedKeystore(self.root), robot)
        return last.message.alternated if last and last.message else None

    def certificate(self, enclave: str) -> x509.Certificate:
        return OpenedKeystore(self.root).certificate_of(enclave)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """A keystore and the exports of its robots; only to be copied."""
    home = Home(tmp_path_factory.mktemp("collect"))
    (home.folder / "fleet.toml").write_text(FLEET)
    rights = {path: publish("/{robot}/x") for path in ("/{robot}/base", "/{robot}/arm")}
    (home.folder / "policy.xml").write_text(policy_text(rights))
    home.run("create_keystore", "ks", "--template", "production")
    home.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    for robot in ROBOTS:
        home.run("distribute_key", "ks", "--robot", robot, robot)
    home.inbox.mkdir()
    return home


@pytest.fixture
def home(made: Home, tmp_path: Path) -> Home:
    return Home(copy_of(made.folder, tmp_path / "home"))


@as_root
def test_what_root_writes_into_a_keystore_belongs_to_its_owner(home: Home) -> None:
    """Otherwise the timers of the owner could not read it."""
    for path in (home.root, *home.root.rglob("*")):
        os.chown(path, 65533, 65533, follow_symlinks=False)
    for _ in ("new releases", "only a timestamp"):
        home.run("fleet", "publish", "ks", "pub")
    home.send("r1")
    home.put("r2", b"damaged", NOW)
    assert home.outcomes() == {"r1": "kept", "r2": "refused", "r3": "missing"}
    others = [path for path in home.root.rglob("*") if path.lstat().st_uid != 65533]
    assert not others, others


# ── messages ───────────────────────────────────────────────────────────────────────────────


def test_messages_are_kept_once_each(home: Home) -> None:
    assert home.outcomes() == dict.fromkeys(ROBOTS, "missing")
    home.send("r1")
    home.send("r2")
    assert home.outcomes() == {"r1": "kept", "r2": "kept", "r3": "missing"}
    assert (home.kept("r1"), home.kept("r2"), home.kept("r3")) == (1, 2, None)
    assert home.outcomes() == {"r1": "unchanged", "r2": "unchanged", "r3": "missing"}
    home.send("r1")
    found = home.collect()
    assert [robot.outcome for robot in found.robots] == ["kept", "unchanged", "missing"]
    assert found.complete and found.robots[0].enclave == "/r1/base"
    last = last_confirmation(OpenedKeystore(home.root), "r1")
    assert last and last.confirmation.sequence == 3 and last.time <= NOW


def test_two_at_once(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody keeps an earlier message, or signs again, while another process takes them in."""
    monkeypatch.setattr(transaction, "_LOCK_SECONDS", 0.0)
    (home.folder / "said").write_bytes(render_confirmation(home.said("r1", NOW, sequence=None)))
    home.send("r1")
    kept = store_confirmation
    refused = []

    def meanwhile(keystore: OpenedKeystore, received: ReceivedConfirmation) -> str:
        assert home.collect(dry_run=True).complete
        with pytest.raises(KeystoreError, match="is busy"):
            home.collect()
        ended = sros("fleet", "confirm", "ks", "said", "--robot", "r1", cwd=home.folder)
        refused.append((ended.status, "is busy" in ended.err))
        return kept(keystore, received)

    with monkeypatch.context() as patched:
        patched.setattr(collecting, "store_confirmation", meanwhile)
        assert home.of("r1").outcome == "kept"
    assert refused == [(2, True)]
    assert home.of("r1").outcome == "unchanged" and not [*home.root.rglob(".sros-lock")]
    home.run("fleet", "confirm", "ks", "said", "--robot", "r1")


def test_an_inbox_that_is_moved_away_meanwhile(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    def meanwhile(keystore: OpenedKeystore, received: ReceivedConfirmation) -> str:
        home.inbox.rename(home.folder / "elsewhere")
        return store_confirmation(keystore, received)

    home.send("r1")
    monkeypatch.setattr(collecting, "store_confirmation", meanwhile)
    assert home.of("r1").outcome == "kept"


def test_the_verb_says_what_it_did(home: Home) -> None:
    now = datetime.now(UTC)
    home.send("r1", now)
    home.send("r2", now, requests=(home.request("r2"),))
    home.put("r3", home.message("r1", now))
    (home.inbox / "r9\x1b").mkdir()
    before = (
        sorted((home.root / "confirmed").glob("*")) if (home.root / "confirmed").exists() else []
    )
    ended = sros("fleet", "collect", "ks", "inbox", "--dry-run", cwd=home.folder)
    assert ended.status == 1 and not (home.root / "confirmed").exists() and not before
    ended = sros("fleet", "collect", "ks", "inbox", cwd=home.folder)
    lines = ended.out.splitlines()
    assert ended.status == 1
    assert lines[0] == "3 robots: 2 kept, 1 refused; 1 request: 1 not due"
    assert lines[1] == "r3: refused: it is signed by /r1/base, an enclave of r1"
    assert lines[2].startswith("/r2/base: not due: it can be renewed from ")
    assert "1 name in 'inbox' is not in the fleet" in ended.err and "\x1b" not in ended.err
    home.send("r3", now)
    home.send("r2", now)
    shutil.rmtree(home.inbox / "r9\x1b")
    ended = sros("fleet", "collect", "ks", "inbox", "--json", cwd=home.folder)
    assert ended.status == 0
    assert [robot["outcome"] for robot in json.loads(ended.out)["robots"]] == [
        "unchanged", "kept", "kept",
    ]  # fmt: skip


def test_a_message_with_two_signatures_or_a_weak_one_proves_nothing(home: Home) -> None:
    said = render_confirmation(home.said("r1", NOW))
    base, arm = (
        (read_certificate(home.folder / f"r1/enclaves{name}/cert.pem"), home.key("r1", name))
        for name in ("/r1/base", "/r1/arm")
    )
    for message, why in (
        (signed_by(base, also=arm)(said), "it lacks the signer's certificate, or does not have"),
        (signed_by(base, "-md", "sha1")(said), "it has a weak signature, with SHA1"),
    ):
        home.put("r1", message)
        assert home.of("r1").why.startswith(why)
    home.put("r1", signed_by(base)(said))
    assert home.of("r1").outcome == "kept"


def test_a_robot_cannot_answer_for_another_one(home: Home) -> None:
    """Neither with its key and the other's name, nor with the other's words, nor from its place."""
    certificate = home.folder / "r2/enclaves/r2/base/cert.pem"
    named_r1 = render_confirmation(home.said("r1", NOW))
    of_r2 = smime.sign(named_r1, read_certificate(certificate), home.key("r2", "/r2/base"))
    home.put("r1", of_r2)
    assert home.of("r1").why == "it is signed by /r2/base, an enclave of r2"
    home.put("r1", home.message("r2", NOW))
    assert home.of("r1").why == "it is signed by /r2/base, an enclave of r2"
    home.put("r2", of_r2)
    assert home.of("r2").why == "it is the confirmation of another robot, r1"
    # The certificate of r1 is no secret: with it, and the key of r2.
    stolen = read_certificate(home.folder / "r1/enclaves/r1/base/cert.pem")
    home.put("r1", smime.sign(named_r1, stolen, home.key("r2", "/r2/base")))
    assert home.of("r1").why == "its signature does not match its content"
    assert home.kept("r1") is None and home.kept("r2") is None
    home.put("r1", smime.sign(named_r1, stolen, home.key("r1", "/r1/base")))
    assert home.of("r1").outcome == "kept"
    home.run("revoke", "ks", "/r2/base", "--reason", "key_compromise")
    time = OpenedKeystore(home.root).entries_of("revocation")[-1].time
    home.put("r1", of_r2)
    for owner in ("an enclave of r2", "which belongs to no robot"):
        assert home.of("r1").why == (
            f"it is signed with a revoked certificate of /r2/base, {owner} (revoked at {time}, "
            "keyCompromise): a computer that has this key sends messages in the place of r1"
        )
        (home.folder / "fleet.toml").write_text("[robots]\nr1 = {}\nr3 = {}\n")
        home.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")


def test_a_stranger_with_a_long_name_is_refused_in_a_short_line(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever can write into the inbox chooses the subject of the certificate."""
    name = x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, "a\x1b[2J")
    key = generate_key()
    stranger = (
        x509.CertificateBuilder(x509.Name([name] * 1000), x509.Name([name] * 1000))
        .public_key(key.public_key())
        .serial_number(5)
        .not_valid_before(NOW)
        .not_valid_after(LATE)
        .sign(key, hashes.SHA256())
    )
    home.put("r1", smime.sign(render_confirmation(home.said("r1", NOW)), stranger, key))
    said = sros("fleet", "collect", "ks", "inbox", cwd=home.folder).out
    assert "r1: refused: no identity CA of the keystore issued its certificate: " in said
    assert len(said) < 600 and "\x1b" not in said
    assert "keystore_is_lost" not in said
    monkeypatch.setattr("sros_tool.keystore.delivery.collect.restored_at", lambda _: iso(NOW))
    home.put("r2", smime.sign(render_confirmation(home.said("r2", NOW)), stranger, key))
    said = sros("fleet", "collect", "ks", "inbox", cwd=home.folder).out
    assert (
        "the CA was replaced after the backup of the keystore: see docs/howto/keystore_is" in said
    )


def test_an_older_message_in_a_second_inbox(home: Home) -> None:
    """As of a robot that moved to a web server: its last message stays its state."""
    first = home.send("r1").read_bytes()
    home.send("r1")
    assert home.of("r1").outcome == "kept"
    home.put("r1", first)
    path = home.inbox / "r1/confirmation.p7s"
    os.utime(path, (path.stat().st_mtime - 90,) * 2)
    done = home.collect()
    (older,) = (robot for robot in done.robots if robot.robot == "r1")
    assert older.outcome == "older" and home.kept("r1") == 2 and done.complete
    (note,) = (note for note in done.notes if note.id == "fleet.older-message")
    assert note.text.startswith(f"an older message of r1 lies in '{home.inbox}'")
    assert not refusals(OpenedKeystore(home.root))
    # It has to be authentic; one that is not is refused, however old.
    path.write_bytes(home.message("r2", NOW))
    os.utime(path, (path.stat().st_mtime - 90,) * 2)
    assert home.of("r1").outcome == "refused" and "r1" in refusals(OpenedKeystore(home.root))
    path.write_bytes(first)
    os.utime(path, (path.stat().st_mtime - 90,) * 2)
    assert home.of("r1").outcome == "older" and "r1" in refusals(OpenedKeystore(home.root)), (
        "as before"
    )


def test_two_computers_with_the_keys_of_a_robot_are_noted(home: Home) -> None:
    """Also in the status, until a day after the last message with an earlier release."""
    home.run("fleet", "publish", "ks", "pub")
    last = read_published(OpenedKeystore(home.root)).number
    for release, is_noted, is_shown in (
        *((last + 1, False, False), (last, True, False)),  # nobody published the first one
        *((last - 1, True, True), (last, False, True)),
    ):
        home.send("r1", release=release)
        collected = home.collect()
        (message,) = (each for each in collected.robots if each.robot == "r1")
        assert ("two computers have its keys" in "".join(message.remarks)) == is_noted
        assert collected.complete != (is_noted and is_shown), "so that the service fails"
        (r1,) = fleet_status(OpenedKeystore(home.root), ["r1"]).robots
        assert any("Two computers" in text for text in r1.problems or ()) == is_shown
    home.send("r1", NOW + timedelta(days=2), release=last - 1)
    assert not home.collect(NOW + timedelta(days=2), restored=["r1"]).robots[0].remarks
    (r1,) = fleet_status(OpenedKeystore(home.root), ["r1"]).robots
    assert not r1.problems, "--restored explains it"


def test_two_computers_that_are_alike_are_seen_by_their_starts(home: Home) -> None:
    """As by a copied disk: no start of a computer comes back after another one."""
    first, second, other = ("1" * 64, "2" * 64, "3" * 64)
    for boot, is_seen in (
        *((first, False), (first, False), (None, False), (second, False), (second, False)),
        *((first, True), (other, True), (second, True)),
    ):
        home.send("r1", boot=boot)
        collected = home.collect()
        (message,) = (each for each in collected.robots if each.robot == "r1")
        is_earlier = any("came from an earlier start" in text for text in message.remarks)
        assert is_earlier == (is_seen and boot != other)
        assert collected.complete != is_earlier, "so that the service fails"
        status = fleet_status(OpenedKeystore(home.root), ["r1"])
        (r1,) = status.robots
        problems = "".join(r1.problems or ())
        assert ("one_robot.md: Same name, new hardware)" in problems) == is_seen, boot
        assert (status.unconfirmed == ("r1",)) == is_seen, "no stage of a rotation"
        assert not (is_seen and r1.is_settled)
    folder = home.root / "enclaves/r1/base"
    (folder / "key.pem").rename(folder / "request.pem")
    (r1,) = fleet_status(OpenedKeystore(home.root), ["r1"]).robots
    assert "one_robot.md: Keys that are made on the robot)" in "".join(r1.problems or ())
    later = NOW + timedelta(days=2)
    home.send("r1", later, boot=second)
    home.collect(later)
    (r1,) = fleet_status(OpenedKeystore(home.root), ["r1"]).robots
    assert not r1.problems, "only the last day counts"


def test_no_file_with_an_early_time_ends_the_alarm_of_two_computers(home: Home) -> None:
    """Nor if an earlier release of sros took the last message, without noting when."""
    boots = ("1" * 64, "2" * 64)
    for boot in boots:
        home.send("r1", boot=boot)
        home.collect()
    record = home.root / "confirmed/r1.json"
    value = json.loads(record.read_text())
    assert value["message"].pop("collected") == iso(NOW)
    record.write_text(json.dumps(value))
    for written in (NOW - timedelta(days=9), NOW):
        home.put("r1", home.message("r1", NOW, boot=boots[0]), written)
        home.collect()
        (r1,) = fleet_status(OpenedKeystore(home.root), ["r1"]).robots
        assert any("Two computers" in text for text in r1.problems or ()), written


@pytest.mark.parametrize(
    ("new_key", "revoke_old", "restored"),
    [(True, True, False), (True, False, False), (False, True, False), (True, True, True)],
)
def test_new_keys_end_the_alarm_of_two_computers(
    home: Home, monkeypatch: pytest.MonkeyPatch, *, new_key: bool, revoke_old: bool, restored: bool
) -> None:
    """Unless the earlier certificates are valid, or the other computer has the key, too.

    After a restore, the ledger may lack earlier certificates: the problem says when it ends, which
    only the first message with new keys does not delay.
    """
    if restored:
        for module in ("delivery.collect", "fleet_status"):
            monkeypatch.setattr(f"sros_tool.keystore.{module}.restored_at", lambda _: iso(NOW))
    boots = ("1" * 64, "2" * 64)
    for boot in (*boots, boots[0]):
        home.send("r1", boot=boot)
        home.collect()
    alternated = home.alternated("r1")
    later = NOW + timedelta(hours=1)
    names = [name for name in OpenedKeystore(home.root).names if name.startswith("/r1/")]
    renew(home.root, names, new_key=new_key, revoke_old=revoke_old, now=later)
    shutil.copytree(home.root / "enclaves/r1", home.folder / "r1/enclaves/r1", dirs_exist_ok=True)
    later += timedelta(hours=1)
    is_explained = new_key and revoke_old
    if is_explained and not restored:
        home.sequence = 0  # the clock of the old computer was ahead
    for boot, is_seen in ((boots[1], not is_explained), (boots[0], not is_explained or restored)):
        home.send("r1", later, boot=boot)
        remarks = "".join(home.of("r1", later).remarks)
        assert ("two computers seem to have its keys" in remarks) == is_seen
        (r1,) = fleet_status(OpenedKeystore(home.root), ["r1"]).robots
        assert r1.is_doubtful == (not is_explained or restored)
        since = later if is_seen else alternated if restored else None
        assert home.alternated("r1") == since
        end = f"until a message comes after {iso(since + timedelta(days=1))}." if since else "?"
        assert any(end in text for text in r1.problems or ()) == restored
        said = sros("fleet", "status", "ks", cwd=home.folder).out
        why = "two computers seem to have the keys of r1, so sros does not know whether the list"
        assert (why in said) == (revoke_old and r1.is_doubtful), said
    if restored:
        sros("rotate_ca", "ks", "--next", cwd=home.folder).ok()
        refused = sros("rotate_ca", "ks", "--next", cwd=home.folder).err
        assert "Two computers seem to have the keys of r1, so their confirmations" in refused
        reason = "two computers seem to have the keys of r1, so their confirmations do not count"
        told = sros("rotate_ca", "ks", "--status", cwd=home.folder).out
        assert f"not confirmed by r1, r2, r3: see `sros fleet status`\n{reason}\n" in told
        assert f"r3 yet; {reason}\n" in sros("fleet", "status", "ks", cwd=home.folder).out
        go_on = ("rotate_ca", "ks", "--next", "--allow-unconfirmed", "--dry-run")
        said = sros(*go_on, cwd=home.folder).ok().err
        assert "have not confirmed the stage before: r2, r3. They" in said
        assert f". {capitalized(reason)}: if they lack the files of the stage" in said


@pytest.mark.parametrize("before", ["", "rotated", "restored", "shown"])
def test_a_new_computer_begins_again_after_one_whose_clock_was_ahead(
    home: Home, before: str
) -> None:
    """It made its own keys. No message with an earlier key counts, nor one from an earlier time.

    Of a certificate that only a release showed after a restore, nobody knows the time of issue.
    """
    now = datetime.now(UTC)
    names = ["/r1/arm", "/r1/base"]
    if before == "rotated":
        home.run("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
        home.run("distribute_key", "ks", "--robot", "r1", "r1", "--force")
    elif before == "restored":
        lost = LostRecords(OpenedKeystore(home.root), now)
        restore_revocations(home.root, lost, shown_by=LATER_RELEASE, now=now)
    old = home.message("r1", now)
    home.sequence = 10**9
    home.send("r1", now)
    assert home.of("r1", now).outcome == "kept"
    now += timedelta(hours=1)
    backup = copy_of(home.root, home.folder / "backup")
    revoke(home.root, names, now=now)
    for name in names:
        request = create_request(home.folder / "new", name).file.read_bytes()
        sign_request(home.root, request, only_enclaves=[name], now=now)
    shutil.copytree(home.root / "enclaves/r1", home.folder / "new/enclaves/r1", dirs_exist_ok=True)
    shutil.rmtree(home.folder / "r1")
    (home.folder / "new").rename(home.folder / "r1")
    if before == "shown":
        lost = LostRecords(OpenedKeystore(home.root), now)
        lost.add_certificate(home.certificate("/r1/base"))
        shutil.rmtree(home.root)
        backup.rename(home.root)
        renew(home.root, names, new_key=True, revoke_old=True, now=now)
        restore_revocations(home.root, lost, now=now)
    home.sequence = 0
    early = home.message("r1", now - timedelta(minutes=1))
    now += timedelta(hours=1)
    good = home.message("r1", now)
    outcomes = []
    for message in (old, early, good, old, early):
        home.put("r1", message, now)
        outcomes.append(home.of("r1", now).outcome)
    of_early = "refused" if before in ("restored", "shown") else "kept"
    of_good = "refused" if before == "shown" else "kept"
    assert outcomes == ["refused", of_early, of_good, "refused", "refused"]


def test_no_file_with_an_early_time_brings_an_old_message_back(home: Home) -> None:
    """Not even if the clock of the robot is behind, and the robot got new keys."""
    home.send("r1")
    home.collect()
    later = NOW + timedelta(hours=1)
    names = [name for name in OpenedKeystore(home.root).names if name.startswith("/r1/")]
    renew(home.root, names, new_key=True, revoke_old=True, now=later)
    shutil.copytree(home.root / "enclaves/r1", home.folder / "r1/enclaves/r1", dirs_exist_ok=True)
    old, new = (home.message("r1", NOW - timedelta(hours=1)) for _ in range(2))
    later += timedelta(hours=1)
    outcomes = []
    for message in (new, old):
        home.put("r1", message, NOW)
        outcomes.append(home.of("r1", later).outcome)
    assert outcomes == ["kept", "refused"]


def test_requests_of_strangers_neither_speak_for_sros_nor_fill_the_terminal(home: Home) -> None:
    names = ("Run it", "/r1/base\x1b[2J", *(f"/r1/x{number}" for number in range(200)))
    home.send(
        "r1", requests=tuple(make_request(home.key("r1", "/r1/base"), n).decode() for n in names)
    )
    said = sros("fleet", "collect", "ks", "inbox", cwd=home.folder).out.splitlines()
    assert said[2] == "a request of r1: refused: 'Run it' is not a valid enclave name"
    assert "'/r1/base\\x1b[2J' is not a valid" in said[3]
    assert len(said) == 53 and said[-1] == "and 152 more requests, see --json"


def test_an_expired_certificate_counts_only_with_the_key_of_now(home: Home) -> None:
    """A computer that was replaced long ago, and its key, say nothing of the robot any more."""
    early, late = NOW + timedelta(days=9), LATE
    shutil.copytree(home.folder / "r1", home.folder / "r1_old")
    home.run("renew", "ks", "/r1/base", "/r1/arm", "--new-key")
    said = home.said("r1", early, sequence=10)
    home.put("r1", signed_message(home.folder / "r1_old", "/r1/base", said), early)
    assert home.of("r1", early).outcome == "kept", "it was not revoked"
    said = home.said("r1", late, sequence=11)
    home.put("r1", signed_message(home.folder / "r1_old", "/r1/base", said), late)
    refused = home.of("r1", late)
    assert refused.outcome == "refused"
    assert refused.why.endswith(" ago, and /r1/base has another key now")
    home.send("r2", late)
    assert home.of("r2", late).outcome == "kept", "it has the same key as ever"


def test_a_message_that_was_replayed(home: Home) -> None:
    first = home.send("r1").read_bytes()
    last = home.send("r1").read_bytes()
    assert home.of("r1").outcome == "kept"
    home.put("r1", first)
    refused = home.of("r1")
    home.put("r1", last)  # whoever has the inbox can put back what was accepted
    assert home.of("r1").outcome == "unchanged" and "r1" in refusals(OpenedKeystore(home.root))
    assert (
        refused.outcome == "refused"
        and "not higher than 2" in refused.why
        and "two computers have" in refused.why
    )
    assert "--restored r1" in refused.why and home.kept("r1") == 2
    # Another message with the same number, and one after somebody confirmed without a number.
    home.send("r1", sequence=2)
    assert home.of("r1").outcome == "refused"
    (home.folder / "said").write_bytes(render_confirmation(home.said("r1", NOW, sequence=None)))
    home.run("fleet", "confirm", "ks", "said", "--robot", "r1")
    home.put("r1", first)
    assert home.of("r1").outcome == "refused" and home.kept("r1") == 2
    assert home.of("r1", restored=("r1",)).outcome == "kept" and home.kept("r1") == 1
    assert not refusals(OpenedKeystore(home.root))
    with pytest.raises(DocumentError, match="no robot 'r9'"):
        home.collect(restored=("r9",))


def test_a_certificate_that_proves_nothing(home: Home) -> None:
    """One of an enclave that was revoked, of another CA, and of this CA but not in the ledger."""
    document = render_confirmation(home.said("r1", NOW))
    own, key = home.certificate("/r1/base"), home.key("r1", "/r1/base")
    authority = read_certificate(home.root / "public/identity_ca.cert.pem")
    of_authority = load_key((home.root / "private/identity_ca.key.pem").read_bytes(), "it")
    issuer = Issuer(authority, of_authority)
    forged = issuer.issue(own.subject, key.public_key(), validity_of(own))
    home.put("r1", smime.sign(document, forged, key))
    assert (
        "is not in the ledger of the keystore, though the keystore's identity CA"
        in home.of("r1").why
    )
    home.run("create_keystore", "other")
    home.run("create_enclave", "other", "/r1/base")
    foreign = home.folder / "other/enclaves/r1/base"
    foreign_key = key_of(home.folder / "other", "/r1/base")
    home.put("r1", smime.sign(document, read_certificate(foreign / "cert.pem"), foreign_key))
    assert home.of("r1").why.startswith("no identity CA of the keystore issued its certificate")
    home.put("r1", smime.sign(document, own, key))
    assert home.of("r1").outcome == "kept"
    home.send("r1")
    home.run("revoke", "ks", "/r1/base")
    assert "or another computer that has earlier keys" in home.of("r1").why and home.kept("r1") == 1
    home.send("r1", enclave="/r1/arm")
    assert home.of("r1").outcome == "kept"


def test_a_message_that_was_accepted_before_its_certificate_was_revoked(home: Home) -> None:
    """It fails no run, and is noted; a message that was first seen afterwards is refused."""
    home.send("r1")
    home.send("r2")
    assert home.collect().complete
    home.run("renew", "ks", "--robot", "r1", "--revoke-old")
    ended = sros("fleet", "collect", "ks", "inbox", cwd=home.folder).ok()
    assert ended.out.splitlines() == [
        "3 robots: 2 unchanged, 1 without a message (or delivered by hand)",
        "r1: its certificate was revoked after this message was accepted",
    ]
    home.send("r1")
    assert home.of("r1").outcome == "refused" and home.kept("r1") == 1


def refuse_state_of_r2(folder: Folder, path: str) -> os.stat_result | None:
    if path.startswith("r2"):
        raise PermissionError(errno.EACCES, "Permission denied", path)
    return state_of(folder, path)


state_of = Folder.state


def test_a_revoked_robot_that_is_still_in_the_fleet(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its messages do not count, and fail no run; nor does what it said before."""
    home.send("r2")
    home.send("r3")
    assert home.collect().complete
    home.run("revoke", "ks", "/r2/base")
    home.send("r2")
    assert home.of("r2").outcome == "refused", "of its other enclave a message would be taken"
    home.run("revoke", "ks", "/r2/arm")
    home.send("r3", requests=None)
    for message in (home.message("r2", NOW), b"hostile"):
        home.put("r2", message)
        ended = sros("fleet", "collect", "ks", "inbox", cwd=home.folder)
        assert ended.status == 0, ended
        assert "1 revoked" in ended.out.splitlines()[0]
        assert "r2: revoked: all its enclaves were revoked; its message does not count" in ended.out
    shutil.rmtree(home.inbox / "r2")
    assert (home.of("r2").outcome, home.of("r2").why) == ("revoked", "")
    with monkeypatch.context() as patched:
        patched.setattr(Folder, "state", refuse_state_of_r2)  # as of a dead network mount
        home.send("r3")
        assert [robot.outcome for robot in home.collect().robots] == ["missing", "revoked", "kept"]
    found = json.loads(sros("fleet", "status", "ks", "--json", cwd=home.folder).out)
    assert found["robots"][1]["state"] == "revoked" and "r2" not in found["overdue"]
    fleet = home.folder / "fleet.toml"
    fleet.write_text(re.sub("r2 = .*", "", fleet.read_text()))
    home.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    home.put("r2", b"hostile")
    (note,) = home.collect().notes
    assert note.id == "fleet.revoked-in-inbox" and "has messages of r2, not" in note.text


def test_a_certificate_of_the_ca_that_a_rotation_replaces(home: Home) -> None:
    home.send("r3")
    assert home.of("r3").outcome == "kept"
    home.run("renew", "ks", "/r3/base", "--revoke-old")
    home.run("rotate_ca", "ks", "--next")
    home.run("rotate_ca", "ks", "--next", "--allow-unconfirmed")
    home.send("r1")
    assert home.of("r1").outcome == "kept", "the old CA is still trusted"
    home.run("rotate_ca", "ks", "--next", "--allow-unconfirmed")
    known = home.of("r1")
    assert (known.outcome, known.enclave, known.sequence) == ("unchanged", "/r1/base", 2)
    assert "missed the rotation" in known.remarks[0]
    home.send("r1")
    assert home.of("r1").outcome == "refused" and "missed the rotation" in home.of("r1").why
    home.put("r1", home.message("r1", NOW, "/r1/base").replace(b"r1", b"r2", 1))
    assert "it missed" not in home.of("r1").why
    home.put("r2", home.message("r1", NOW))
    assert home.of("r2").why.startswith("no identity CA of the keystore"), "of another robot"
    assert home.of("r3").remarks == ["its certificate was revoked after this message was accepted"]
    home.send("r3")
    assert "or another computer that has earlier keys" in home.of("r3").why


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda data: b"", "not an S/MIME signed message"),
        (lambda data: b"{}", "not an S/MIME signed message"),
        (lambda data: data[: len(data) // 2], "one signed part followed by one signature"),
        (lambda data: data.replace(b'"r1"', b'"r2"'), "does not match its content"),
        (lambda data: bytes(range(256)), "programs read in different ways"),
    ],
)
def test_a_damaged_message(home: Home, change: Callable[[bytes], bytes], why: str) -> None:
    message = home.message("r1", NOW)
    home.put("r1", change(message))
    home.send("r2")
    found = home.collect()
    assert [robot.outcome for robot in found.robots] == ["refused", "kept", "missing"]
    assert why in found.robots[0].why
    home.put("r1", message)
    assert home.of("r1").outcome == "kept"


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"sequence": None}, "no sequence number"),
        ({"files": {"../../etc/passwd": "0" * 64}}, "is not a confirmation"),
    ],
)
def test_a_signed_message_that_is_none(home: Home, changed: dict[str, object], why: str) -> None:
    home.send("r1", NOW, "", **changed)
    assert why in home.of("r1").why


# ── a keystore that was restored ──


def lose_revocations(home: Home) -> str:
    """Revoke r2 and an enclave of after the backup, restore the backup; return the list of r1."""
    backup = copy_of(home.root, home.folder / "backup")
    home.run("create_enclave", "ks", "/r3/later")
    home.run("revoke", "ks", "/r3/later", "/r2/base", "--reason", "key_compromise")
    home.run("distribute_key", "ks", "--robot", "r1", "r1", "--force")
    shutil.rmtree(home.root)
    backup.rename(home.root)
    return (home.folder / "r1/enclaves/r1/base/crl.pem").read_text()


def test_what_only_robots_know_to_be_revoked_is_revoked_again(home: Home) -> None:
    """Also in the run that takes in a request of the revoked robot."""
    crl, known = lose_revocations(home), [*(home.root / "revoked").glob("*")]
    home.send("r2", DUE, requests=(home.request("r2"), home.request("r2", "/r2/arm")))
    assert home.of("r2", DUE, dry_run=True).requests[0].outcome == "renewed", "nobody says it"
    home.send("r1", DUE, crl=crl, requests=(home.request("r1"),))
    before = home.collect(DUE, dry_run=True)
    assert not known and not (home.root / "revoked").exists()
    found = home.collect(DUE)
    for inbox in (before, found):
        (note,) = (note for note in inbox.notes if note.id == "fleet.revocations-restored")
        assert "r1 has a revocation list" in note.text and "/r2/base" in note.text
        requests = {of.enclave: of.outcome for robot in inbox.robots for of in robot.requests}
        assert requests == {"/r1/base": "renewed", "/r2/base": "refused", "/r2/arm": "refused"}
    lost, now = load_crl(crl.encode(), "r1"), OpenedKeystore(home.root).revocation_list
    assert now and now.number > lost.number
    assert {of[:1] + of[2:] for of in now.revoked} == {of[:1] + of[2:] for of in lost.revoked}
    assert len(now.revoked) == 2 and not (home.root / "enclaves/r2/base").exists()
    marks = OpenedKeystore(home.root).ledger_with("what", RESTORED).entries
    numbers = [entry.number for entry in marks if entry.what == RESTORED]
    assert numbers == [int(DUE.timestamp())], "no answer had it before"
    found_kinds = set(re.findall(r"\[(keystore\.\S+)\]", sros("check", "ks", cwd=home.folder).out))
    assert found_kinds == {"keystore.clock-behind"}  # the messages are from later than now
    again = home.collect(DUE)
    assert not again.changes and not again.notes
    assert "was revoked" in again.robots[1].remarks[0] and not again.robots[1].requests
    home.run("inspect", "ks", "--history")
    assert sros("fleet", "status", "ks", "--json", cwd=home.folder).status == 1


def test_what_the_ca_signed_counts_in_a_message_that_does_not(home: Home) -> None:
    """Its certificate can be revoked then, and vouches for nothing; its list revokes."""
    backup = copy_of(home.root, home.folder / "backup")
    for robot in ("r2", "r3"):
        home.run("revoke", "ks", "--robot", robot)
    home.run("create_enclave", "ks", "/r2/base")
    home.run("renew", "ks", "/r1/base")
    for robot in ("r1", "r2"):
        home.run("distribute_key", "ks", "--robot", robot, robot, "--force")
    later = home.certificate("/r1/base")
    crl = (home.folder / "r1/enclaves/r1/base/crl.pem").read_text()
    home.send("r1", crl=crl, requests=(home.request("r1"),))
    home.send("r2")
    shutil.rmtree(home.root)
    backup.rename(home.root)
    for notes in (["fleet.revocations-restored", "fleet.certificates-restored"], []):
        found = home.collect()
        assert found.robots[0].outcome == "refused" and "ledger" in found.robots[0].why
        assert not found.robots[0].requests and not found.not_signed
        assert [note.id for note in found.notes] == notes
    assert not (home.root / "enclaves/r2/base").exists()
    assert "restored from a backup" in sros("revoke", "ks", "/r1/base", cwd=home.folder).err
    crl_at_home = OpenedKeystore(home.root).revocation_list
    assert crl_at_home and crl_at_home.revokes(later.serial_number)
    status = sros("fleet", "status", "ks", cwd=home.folder).out
    assert re.search("r2 +revoked .* sign its requests again, or revoke it", status), status
    assert re.search("r3 +revoked .* take it out of the fleet file", status)
    assert "lacks enclaves of r2, whose certificates stay valid. If the robot of such" in status
    _, r2, r3 = fleet_status(OpenedKeystore(home.root)).robots
    assert r3.is_settled and not r2.is_settled


def test_a_robot_with_a_certificate_that_the_keystore_lost_is_not_settled(home: Home) -> None:
    """Nothing was revoked, and a robot can leave files out of its later messages."""
    for made in ("ks", *ROBOTS):
        shutil.rmtree(home.folder / made)
    generate = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    home.run(*generate, "--robot", "r3")
    home.run("create_enclave", "ks", "/r1/base")
    backup = copy_of(home.root, home.folder / "backup")
    home.run(*generate)
    for robot in ROBOTS:
        home.run("distribute_key", "ks", "--robot", robot, robot)
    home.send("r1", enclave="/r1/arm")
    home.send("r2")
    shutil.rmtree(home.root)
    backup.rename(home.root)
    home.collect()
    for robot in ("r1", "r3"):
        home.run("distribute_key", "ks", "--robot", robot, robot, "--force")
    shutil.rmtree(home.folder / "r1/enclaves/r1/arm")
    home.send("r1")
    home.send("r3")
    home.collect()
    status = fleet_status(OpenedKeystore(home.root))
    assert [(of.state, of.is_settled, of.mended) for of in status.robots] == [
        ("current", False, False),
        ("none", False, False),
        ("current", True, True),
    ]
    shown = sros("fleet", "status", "ks", cwd=home.folder).out
    assert "lacks enclaves of r1, r2, whose certificates stay valid" in shown
    assert len(re.findall("sign its requests again, or revoke it", shown)) == 2, shown


def test_a_certificate_of_a_revoked_robot_is_revoked_when_it_becomes_known(home: Home) -> None:
    backup = copy_of(home.root, home.folder / "backup")
    home.run("renew", "ks", "/r2/base")
    home.run("distribute_key", "ks", "--robot", "r2", "r2", "--force")
    later = home.certificate("/r2/base")
    shutil.rmtree(home.root)
    backup.rename(home.root)
    home.run("revoke", "ks", "--robot", "r2")
    home.send("r2")
    assert home.of("r2").outcome == "revoked"
    crl = OpenedKeystore(home.root).revocation_list
    assert crl and crl.revokes(later.serial_number)
    assert home.of("r2").outcome == "revoked" and not home.collect().notes


def test_a_weak_key_is_not_certified(home: Home) -> None:
    for exponent, outcome in ((3, "refused"), (65537, "renewed")):
        key = rsa.generate_private_key(exponent, 2048)
        home.send("r1", DUE, requests=(home.request("r1", key=key),))
        (request,) = home.of("r1", DUE).requests
        assert request.outcome == outcome, request
        assert ("of the request of r1 is weak" in request.why) == (outcome == "refused")


def test_a_certificate_that_was_replaced_after_the_backup(home: Home) -> None:
    """Its enclave stays, and gets another one, for its key only if that was not replaced."""
    backup = copy_of(home.root, home.folder / "backup")
    home.run("renew", "ks", "/r1/base", "--revoke-old")
    home.run("renew", "ks", "/r2/base", "--new-key", "--revoke-old")
    home.run("distribute_key", "ks", "--robot", "r1", "r1", "--force")
    crl = (home.folder / "r1/enclaves/r1/base/crl.pem").read_text()
    shutil.rmtree(home.root)
    backup.rename(home.root)
    home.send("r1", crl=crl)
    found = home.collect()
    assert "not in the ledger" in found.robots[0].why, "of its new certificate nothing is known"
    note = next(note for note in found.notes if note.id == "fleet.replaced-after-backup")
    assert f"`sros renew {home.root} /r1/base`" in note.text
    assert f"`sros renew {home.root} /r2/base --new-key --revoke-old`" in note.text
    assert "was revoked" in sros("renew", home.root, "/r2/base").err
    home.run("renew", "ks", "/r1/base")
    home.run("renew", "ks", "/r2/base", "--new-key", "--revoke-old")
    crl_at_home = OpenedKeystore(home.root).revocation_list
    assert crl_at_home and not crl_at_home.revokes(home.certificate("/r1/base").serial_number)
    assert not home.collect().notes


def test_a_key_that_was_revoked_after_the_backup_vouches_for_no_other(home: Home) -> None:
    """The publishing folder shows it, before anybody has read it with --restored."""
    home.run("fleet", "publish", "ks", "pub")
    backup = copy_of(home.root, home.folder / "backup")
    home.run("renew", "ks", "/r1/base", "--new-key", "--revoke-old")
    home.run("fleet", "publish", "ks", "pub")
    shutil.rmtree(home.root)
    backup.rename(home.root)
    before = home.certificate("/r1/base")
    home.send("r1", DUE, requests=(home.request("r1", key=generate_key()),))
    found = home.of("r1", DUE)
    assert (found.outcome, found.requests[0].outcome) == ("kept", "refused")
    assert f"`sros fleet publish {home.root} {home.folder}/pub --restored`" in found.requests[0].why
    assert home.certificate("/r1/base") == before


@pytest.mark.parametrize(("revoked", "is_replaced"), [(-1, True), (1, False)])
def test_a_key_that_a_revoked_key_vouched_for(home: Home, revoked: int, is_replaced: bool) -> None:
    """The list that revoked the vouching key comes later; ``revoked`` is in days since then."""
    old, authority = (
        home.certificate("/r1/base"),
        OpenedKeystore(home.root).ca_certificate(IDENTITY),
    )
    home.send("r1", DUE, requests=(home.request("r1", key=generate_key()),))
    assert home.of("r1", DUE).requests[0].outcome == "renewed"
    later, new = DUE + timedelta(days=2), home.certificate("/r1/base")
    key = load_key((home.root / "private/identity_ca.key.pem").read_bytes(), "the CA's key")
    entry = RevocationEntry(old.serial_number, DUE + timedelta(days=revoked), SUPERSEDED)
    crl = sign_crl(authority, key, [entry], number=99, this_update=DUE, next_update=LATE)
    home.send("r2", later, crl=crl.decode())
    texts = {note.id: note.text for note in home.collect(later).notes}
    step = "/r1/base --revoke-old`. If the key of a request was revoked, first make a new key"
    assert (step in texts.get("fleet.replaced-after-backup", "")) == is_replaced
    keystore = OpenedKeystore(home.root)
    assert keystore.revocation_list
    assert keystore.revocation_list.revokes(new.serial_number) == is_replaced
    key_of_new = certificate_entry(DUE, "certificate", new, "/r1/base").key
    assert KnownKeys(keystore).is_revoked(key_of_new) == is_replaced


@pytest.mark.parametrize(
    ("waits", "command"),
    [(False, "distribute_key ks --robot NAME FOLDER --force"), (True, "publish ks PUB --restored")],
)
def test_the_verb_names_the_next_step(home: Home, waits: bool, command: str) -> None:
    """Only where robots are to get new files, and nothing published them.

    Nor is a robot that the backup lacks called a robot that left the fleet.
    """
    crl, now = lose_revocations(home), datetime.now(UTC)
    (home.folder / "inbox/r9").mkdir()
    if waits:
        lost = LostRecords(OpenedKeystore(home.root), now)
        restore_revocations(home.root, lost, shown_by=LATER_RELEASE, now=now)
    home.send("r1", now)
    said = sros("fleet", "collect", "ks", "inbox", cwd=home.folder).err
    assert "bring them" not in said
    added = "read: r9. Perhaps a robot was added after the backup of the keystore: put it"
    assert (added in said) is waits and ("r9. If a robot left the fleet" in said) is not waits
    home.send("r1", now, crl=foreign_list(home) + crl)
    said = sros("fleet", "collect", "ks", "inbox", cwd=home.folder).err
    assert f"bring them to the robots: `sros {'fleet ' * waits}{command}`" in said and added in said
    # Where nothing was published, no publication would ever end this refusal.
    (home.folder / "fleet.toml").write_text("[robots]\nr1 = {}\nr3 = {}\nr9 = {}\n")
    generate = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    refused = sros(*generate, cwd=home.folder).err
    assert ("create /r9/base, /r9/arm with new keys, but a robot may have" in refused) is waits


def foreign_list(home: Home) -> str:
    """Return a revocation list of another keystore, with an enclave of the same name."""
    home.run("create_keystore", "other")
    home.run("create_enclave", "other", "/r2/base")
    home.run("revoke", "other", "/r2/base")
    return (home.folder / "other/public/identity_ca.crl.pem").read_text()


def test_a_list_of_another_keystore_revokes_nothing(home: Home) -> None:
    foreign = foreign_list(home)
    home.send("r1", crl=foreign)
    found = home.collect()
    assert found.robots[0].outcome == "kept" and not found.notes
    home.send("r1", crl=9 * foreign)
    assert "not a text with revocation lists" in home.of("r1").why
    home.send("r1", crl=foreign.replace("\n-----END", "\nAAAA\n-----END"))
    assert home.of("r1").outcome == "kept"
    assert OpenedKeystore(home.root).revocation_list is None


def test_a_list_is_not_lost_while_the_ca_cannot_sign(home: Home) -> None:
    crl, key = lose_revocations(home), home.root / "private/identity_ca.key.pem"
    home.send("r1", crl=crl, requests=(home.request("r1"),))
    key.rename(home.folder / "key.pem")
    found = home.collect(DUE)
    assert "r1 has a revocation list" in found.not_signed
    assert [request.outcome for request in found.robots[0].requests] == ["not_signed"]
    (home.folder / "key.pem").rename(key)
    found = home.collect(DUE)
    assert not found.not_signed and found.notes
    assert [request.outcome for request in found.robots[0].requests] == ["renewed"]


# ── the inbox ──────────────────────────────────────────────────────────────────────────────


def link_to_file(file: Path) -> None:
    file.rename(file.with_name("other"))
    file.symlink_to("other")


def link_to_folder(file: Path) -> None:
    file.parent.rename(file.parent.with_name("elsewhere"))
    file.parent.symlink_to("elsewhere")


def pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def door(file: Path) -> None:
    file.unlink()
    os.chdir(file.parent)  # the path of a socket is short
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind(file.name)


def folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def huge(file: Path) -> None:
    with file.open("r+b") as opened:
        opened.truncate(MAX_BYTES + 1)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (link_to_file, "not a regular file"),
        (link_to_folder, "is a symbolic link"),
        (pipe, "not a regular file"),
        (door, "not a regular file"),
        (folder, "not a regular file"),
        (huge, "more than 4 MiB"),
    ],
)
def test_a_hostile_inbox(
    home: Home, spoil: Callable[[Path], None], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(home.folder)
    spoil(home.send("r1"))
    home.send("r2")
    found = home.collect()
    assert [robot.outcome for robot in found.robots] == ["refused", "kept", "missing"]
    assert why in found.robots[0].why


def test_an_inbox_that_is_none(home: Home) -> None:
    home.inbox.rmdir()
    ended = sros("fleet", "collect", "ks", "inbox", cwd=home.folder)
    assert ended.status == 2 and "'inbox' cannot be opened" in ended.err


_CHECK, _SILENT = "check its clock", "find out why"
_DAYS = 5 * 24 * 60
_AGES = (
    # In minutes: how far the clocks of the robot and the server are ahead, how long the message was
    # held back, how long it then waited in the inbox, and the age that counts; then what to do if
    # it may be 15 minutes old.
    *((0, server, 0, 0, 0, "") for server in (-60, 0, 60)),
    *((0, server, 40, 0, 40, _SILENT if server < 0 else _CHECK) for server in (-60, 0, 60)),
    *((0, server, 0, 40, 40, _CHECK if server > 0 else _SILENT) for server in (-60, 0, 60)),
    *((-30, server, 0, 0, 30, _CHECK) for server in (-60, 0, 60)),
    *((-_DAYS, server, 0, 0, _DAYS, _CHECK) for server in (-60, 0, 60)),
    *((-30, server, 40, 0, 70, _SILENT if server < 0 else _CHECK) for server in (-60, 0, 60)),
    *((30, server, 0, 0, 0, _CHECK) for server in (-60, 0, 60)),
    (30, 0, 0, 40, 40, _SILENT),
    # With two wrong clocks, a message can look newer, but not by more than the robot's is ahead.
    *((30, server, 0, 40, 10, "") for server in (-60, 60)),
    *((30, server, 40, 0, 10, "") for server in (-60, 0, 60)),
)


def test_the_age_of_a_message_by_three_clocks(home: Home) -> None:
    """Only a robot whose clock is ahead can look newer, if its messages were also held back."""
    minute = timedelta(minutes=1)
    found = []
    for number, (robot, server, held, waited, _, _) in enumerate(_AGES):
        start = NOW + number * timedelta(hours=3)
        for sent, came, seen in ((0, 0, 0), (5, 5 + held, 5 + held + waited)):
            file = home.send("r1", start + (sent + robot) * minute)
            os.utime(file, ((start + (came + server) * minute).timestamp(),) * 2)
            now = start + seen * minute
            assert home.of("r1", now).outcome == "kept"
        status = fleet_status(OpenedKeystore(home.root), ["r1"], now)
        (r1,) = status.with_overdue(now, 15 * minute).robots
        assert r1.confirmed and (r1.state == "offline") == bool(r1.to_do)
        age = (now - r1.confirmed) // minute
        found.append((robot, server, held, waited, age, r1.to_do))
    assert found == list(_AGES)


@pytest.mark.parametrize("seconds", [2**40, -(2**40)])
def test_a_message_whose_file_has_a_time_of_no_year(home: Home, seconds: int) -> None:
    os.utime(home.send("r1"), (seconds, seconds))
    home.send("r2")
    assert home.outcomes() == {"r1": "kept", "r2": "kept", "r3": "missing"}
    last = last_confirmation(OpenedKeystore(home.root), "r1")
    assert last and last.time <= NOW


def test_remarks_on_clocks(home: Home) -> None:
    home.send("r1")
    assert home.of("r1").remarks == []
    home.send("r1", time=NOW + timedelta(hours=2))
    assert home.of("r1").remarks == ["its clock is 2 h ahead"]
    home.send("r1", LATE)
    (remark,) = home.of("r1", LATE).remarks
    assert remark.startswith("its certificate expired 10 d") and home.kept("r1") == 3


# ── renewal ────────────────────────────────────────────────────────────────────────────────


def test_renewals_are_signed_in_one_change(home: Home) -> None:
    before = {name: home.certificate(name) for name in ("/r1/base", "/r1/arm", "/r2/base")}
    rights = (home.root / "enclaves/r1/base/permissions.xml").read_text()
    home.send("r1", DUE, requests=(home.request("r1"), home.request("r1", "/r1/arm")))
    home.send("r2", DUE, requests=(home.request("r2"),))
    home.send("r3", DUE, requests=(home.request("r3"),))
    head = (home.root / "ledger.p7s").read_bytes()
    dry = home.collect(DUE, dry_run=True)
    assert (home.root / "ledger.p7s").read_bytes() == head and home.kept("r1") is None
    found = home.collect(DUE)
    assert [robot.requests for robot in found.robots] == [robot.requests for robot in dry.robots]
    outcomes = [[request.outcome for request in robot.requests] for robot in found.robots]
    assert outcomes == [["renewed", "renewed"], ["renewed"], ["not_allowed"]]
    assert not found.complete and 'renewal = "allowed"' in found.robots[2].requests[0].why
    issued = [entry for entry in OpenedKeystore(home.root).ledger.entries if entry.time > iso(NOW)]
    assert len({entry.time for entry in issued}) == 1
    assert sorted(entry.enclave for entry in issued if entry.what == "certificate") == sorted(
        before
    )
    for name, old in before.items():
        new = home.certificate(name)
        assert new.public_key() == old.public_key() and new != old
        assert validity_of(new).not_after > validity_of(old).not_after
    after = (home.root / "enclaves/r1/base/permissions.xml").read_text()
    assert without_times(after) == without_times(rights) and after != rights
    # The agent repeats its request until it has the answer: nothing is signed again.
    home.send("r1", DUE, requests=(home.request("r1"),))
    (request,) = home.of("r1", DUE).requests
    assert request.outcome == "answered" and home.certificate("/r1/base") != before["/r1/base"]
    # Also when the new certificate is due again, and the robot still has not fetched it.
    (request,) = home.of("r1", DUE + timedelta(days=150)).requests
    assert (request.outcome, request.why) == (
        "answered",
        "the robot has not fetched its new certificate yet",
    )
    installed = "r1/enclaves/r1/base/cert.pem"
    shutil.copy(home.root / installed.removeprefix("r1/"), home.folder / installed)
    home.send("r1", DUE, requests=(home.request("r1"),))
    (request,) = home.of("r1", DUE).requests
    assert request.outcome == "not_due"


def test_the_ledger_tells_when_a_life_began(home: Home) -> None:
    """Also of a certificate of another CA, whose validity began when it was made."""
    keystore = OpenedKeystore(home.root)
    renewals = collecting._Renewals(keystore, recorded_fleet(keystore), NOW)
    made = [*renewals._issued_validities("/r1/base")]
    for validity, when in made:
        assert when and when == validity.not_before + BACKDATE
    assert len(made) == 2
    forgetful = home.root / "ledger.jsonl"
    forgetful.write_text("")
    keystore = OpenedKeystore(home.root)
    renewals = collecting._Renewals(keystore, recorded_fleet(keystore), NOW)
    made = [*renewals._issued_validities("/r1/base")]
    assert [when for _, when in made] == [None, None]


def without_times(text: str) -> list[str]:
    return [line for line in text.splitlines() if "<not_" not in line and "<subject" not in line]


def refused(home: Home, robot: str, now: datetime = DUE, signer: str = "", **sent: object) -> str:
    """Return why the only request of a robot's message was refused; nothing is signed."""
    head = (home.root / "ledger.p7s").read_bytes()
    home.send(robot, now, signer, **sent)
    *_, request = home.of(robot, now).requests
    assert request.outcome == "refused", request
    assert (home.root / "ledger.p7s").read_bytes() == head
    assert home.kept(robot) == home.sequence, "the message itself is good"
    return request.why


def test_requests_that_are_refused(home: Home) -> None:
    new = generate_key()
    of_r2 = home.request("r2")
    assert refused(home, "r1", requests=(of_r2,)) == "/r2/base is an enclave of r2"
    named_r2 = home.request("r2", key=home.key("r1", "/r1/base"))
    assert refused(home, "r1", requests=(named_r2,)) == "/r2/base is an enclave of r2"
    stranger = make_request(new, "/dispatcher").decode()
    assert refused(home, "r1", requests=(stranger,)) == "/dispatcher is not an enclave of a robot"
    twice = "the message has another request for this enclave"
    assert refused(home, "r1", requests=(of_r2, named_r2)) == twice
    kept = copy_of(home.root / "enclaves/r1/arm", home.folder / "kept")
    home.run("revoke", "ks", "/r1/arm")
    gone = home.request("r1", "/r1/arm")
    assert "or it was revoked" in refused(home, "r1", requests=(gone,))
    copy_of(kept, home.root / "enclaves/r1/arm")
    assert refused(home, "r1", requests=(gone,)) == "its current certificate was revoked"
    garbage = "-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n-----END CERTIFICATE REQUEST-----\n"
    assert "cannot be read" in refused(home, "r1", requests=(garbage,))


def test_only_an_enclave_itself_vouches_for_its_new_key(home: Home) -> None:
    """Who has the key of one enclave of a robot does not get the rights of another one."""
    new = generate_key()
    request = home.request("r1", "/r1/arm", new)
    why = refused(home, "r1", requests=(request,))
    assert "new key" in why and "/r1/base" in why
    home.send("r1", DUE, "/r1/arm", requests=(request,))
    (done,) = home.of("r1", DUE).requests
    assert done.outcome == "renewed" and done.key_sha256 == key_digest(new.public_key())
    assert home.certificate("/r1/arm").public_key() == new.public_key()
    assert key_on_robot(home.root / "enclaves/r1/arm")


@pytest.mark.parametrize("change", ["renew", "revoke"])
def test_a_key_that_is_revoked_while_its_request_waits_vouches_for_no_other(
    home: Home, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Collecting waits for a change that runs, and examined the request before."""
    words = ("--new-key", "--revoke-old") if change == "renew" else ()
    original = certify_requests

    def after_the_change(*arguments: Any, **options: Any) -> Any:
        if not changed:
            changed.append(sros(change, home.root, "/r1/base", *words).ok())
        return original(*arguments, **options)

    changed: list[Any] = []
    monkeypatch.setattr(collecting, "certify_requests", after_the_change)
    home.send("r1", DUE, requests=(home.request("r1", key=generate_key()),))
    (done,) = home.of("r1", DUE).requests
    assert done.outcome == "refused" and "was changed while its request was exam" in done.why
    assert (home.root / "enclaves/r1/base/key.pem").exists() is (change == "renew")


def test_a_key_that_was_replaced_vouches_for_no_other(home: Home) -> None:
    """Its certificate is still valid, and a copy of it may be in a backup."""
    home.send("r1", DUE, requests=(home.request("r1", key=generate_key()),))
    assert home.of("r1", DUE).requests[0].outcome == "renewed"
    later = DUE + timedelta(days=95)
    for key in (generate_key(), home.key("r1", "/r1/base")):
        why = refused(home, "r1", later, requests=(home.request("r1", key=key),))
        assert "an earlier key signed it" in why


def test_the_grace_after_expiry(home: Home) -> None:
    home.send("r1", LATE, requests=(home.request("r1"),))
    home.send("r2", LATE, requests=(home.request("r2"),))
    found = home.collect(LATE)
    assert [robot.requests[0].outcome for robot in found.robots[:2]] == ["renewed", "refused"]
    assert "renewal_grace of r2 (1d)" in found.robots[1].requests[0].why
    renew(home.root, ["/r2/arm"], now=LATE)
    arm = "enclaves/r2/arm/cert.pem"
    shutil.copy(home.root / arm, home.folder / "r2" / arm)
    why = refused(home, "r2", LATE, "/r2/arm", requests=(home.request("r2"),))
    assert "renewal_grace of r2 (1d)" in why, "also where a valid enclave asks for it"


def test_one_request_that_cannot_be_signed_stops_no_other(home: Home) -> None:
    """Two robots ask for the same key: neither of them gets it, and the third robot is renewed."""
    (home.root / "enclaves/r1/base/permissions.p7s").write_bytes(b"damaged")
    home.send("r1", DUE, requests=(home.request("r1"),))
    home.send("r2", DUE, requests=(home.request("r2"),))
    found = home.collect(DUE)
    assert [robot.requests[0].outcome for robot in found.robots[:2]] == ["refused", "renewed"]


def test_one_request_that_cannot_be_signed_does_not_make_as_many_changes_as_robots(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[list[str]] = []

    def certify(*_: object, only_enclaves: list[str], **_more: object) -> SimpleNamespace:
        tried.append(only_enclaves)
        if "/r33/base" in only_enclaves:
            raise KeystoreError("it is the key of another enclave")
        return SimpleNamespace(notes=(), changes=())

    monkeypatch.setattr(collecting, "certify_requests", certify)
    taken: list[Any] = []
    for number in range(64):
        request: Any = SimpleNamespace(pem=b"", name=f"/r{number}/base")
        judged = _DecidedRequest(CollectedRequest(request.name, "", "renewed", ""), request)
        taken.append(SimpleNamespace(requests=[judged]))
    collecting._sign(
        home.root, taken, now=DUE, allow_refusal=(), keyring=IN_KEYSTORE, dry_run=False
    )
    outcomes = [message.requests[0].result.outcome for message in taken]
    assert outcomes == ["refused" if number == 33 else "renewed" for number in range(64)]
    signed = [only for only in tried if "/r33/base" not in only]
    assert sum(map(len, signed)) == 63 and len(tried) == 13


def test_cas_that_cannot_sign(home: Home) -> None:
    home.send("r1", DUE, requests=(home.request("r1"),))
    for key in (home.root / "private").glob("*.key.pem"):
        key.rename(home.folder / key.name)
    found = home.collect(DUE)
    assert found.robots[0].outcome == "kept" and home.kept("r1") == 1
    assert found.robots[0].requests[0].outcome == "not_signed" and found.not_signed
    for key in home.folder.glob("*.key.pem"):
        key.rename(home.root / "private" / key.name)
    assert home.of("r1", DUE).requests[0].outcome == "renewed", "the same message is enough"


def test_what_was_renewed_is_published_at_once(home: Home) -> None:
    """The status compares what the robot has installed with what was published last."""
    home.run("renew", "ks", "/r1/base")
    ended = sros("fleet", "collect", "ks", "inbox", "--publish", "pub", "--json", cwd=home.folder)
    said = json.loads(ended.out)["published"]
    published = {"folder": "pub", "robots": [*ROBOTS], "refused": [], "altered": []}
    assert ended.status == 0 and said == published
    number = read_published(OpenedKeystore(home.root)).robots["r1"].release.number
    home.send("r1", datetime.now(UTC), release=number - 1)
    ended = sros("fleet", "collect", "ks", "inbox", "--publish", "pub", cwd=home.folder).ok()
    assert "unchanged: 3 robots" in ended.out
    status = json.loads(sros("fleet", "status", "ks", "--json", cwd=home.folder).out)
    found = {robot["robot"]: (robot["release"], robot["published"]) for robot in status["robots"]}
    assert found["r1"] == (number - 1, number) and found["r3"][0] is None
    text = sros("fleet", "status", "ks", cwd=home.folder).out
    assert f"reports release {number - 1}; release {number} is published" in text
    home.run("renew", "ks", "/r1/base")
    home.send("r1", datetime.now(UTC), release=number)
    ended = sros("fleet", "collect", "ks", "inbox", "--publish", "ks", cwd=home.folder)
    assert ended.status == 2 and "1 kept" in ended.out, "what was collected stays"
    (home.folder / "file").touch()
    ended = sros("fleet", "collect", "ks", "inbox", "--publish", "file/pub", cwd=home.folder)
    assert ended.status == 2 and "1 unchanged" in ended.out
    assert "Nothing was changed" not in ended.err, "a message may have been kept"
    assert "not published yet" in sros("fleet", "status", "ks", cwd=home.folder).out


def read_no_archive(path: Path, label: str, **limits: Any) -> bytes:
    """Read a file, except an archive, as if its mode were 0."""
    if label == "archive":
        raise DocumentError(f"unable to read '{path}'")
    return read_bytes(path, label, **limits)


def test_a_publishing_folder_that_lost_its_files_is_not_in_order(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    home.run("fleet", "publish", "ks", "pub")
    published = read_published(OpenedKeystore(home.root))
    for robot in ROBOTS:
        home.send(robot, datetime.now(UTC), release=published.number)
    home.run("fleet", "collect", "ks", "inbox")
    status = ("fleet", "status", "ks")
    sros(*status, cwd=home.folder).ok()
    check = ("check", "ks", "--include", "keystore.publication-unseen")
    sros(*check, cwd=home.folder).ok()
    pub, archive = home.folder / "pub", published.robots["r2"].release.path("r2")
    pub.rename(home.folder / "elsewhere")
    for fail_on, exit_status in (("delivery", 1), ("unmended", 1), ("seen", 0)):
        ended = sros(*status, "--fail-on", fail_on, cwd=home.folder)
        assert f"'{pub}', is not on this machine, or cannot be read: it is" in ended.out
        assert ended.status == exit_status
    checked = sros(*check, cwd=home.folder)
    assert f"'{pub}', is not on this machine" in checked.out and checked.status == 1
    metrics = sros(*status, "--prometheus", cwd=home.folder).out
    assert all(
        re.search(rf"(?m)^sros_fleet_{end}$", metrics) for end in ("complete{.*} 0", "seen{.*} 1")
    )
    (home.folder / "elsewhere").rename(pub)
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "tuf", None)
        ended = sros(*status, cwd=home.folder)
        assert "package tuf is not installed: it is not known" in ended.out and ended.status == 1
        checked = sros(*check, cwd=home.folder)
        assert "package tuf is not installed" in checked.out and checked.status == 1
    targets = next((pub / "metadata").glob("*.targets.json"))
    targets.rename(home.folder / "kept")
    for verb in (status, check):
        assert f"lacks metadata/{targets.name}" in sros(*verb, cwd=home.folder).out
    (home.folder / "kept").rename(targets)
    publish = ("fleet", "publish", "ks", str(pub))
    command = f"`sros {' '.join(publish)}`"
    data = (pub / archive).read_bytes()
    for changed in (data[:-1] + bytes([data[-1] ^ 1]), data + b"x"):
        (pub / archive).write_bytes(changed)
        ended = sros(*status, cwd=home.folder)
        clause = "has an archive that is changed or cannot be read"
        assert f"'{pub}' {clause}: {archive}. Run {command}" in ended.out
        assert ended.status == 1
    (pub / archive).write_bytes(data)
    with monkeypatch.context() as unreadable:
        unreadable.setattr("sros_tool.keystore.delivery.published.read_bytes", read_no_archive)
        assert f"{clause}: targets" in sros(*status, cwd=home.folder).out
    (pub / archive).unlink()
    ended = sros(*status, cwd=home.folder)
    lacks = f"'{pub}' lacks {archive}, which robots fetch"
    assert f"{lacks}. Run {command}, which puts this right, or" in ended.out
    assert ended.status == 1
    other = next(path for path in pub.glob("targets/robots/*.tar.gz") if ".r1." in path.name)
    kept = other.read_bytes()
    other.write_bytes(b"altered")
    both = f"{lacks}; the published files do not verify: '{pub}' {clause}: "
    assert both in sros(*status, cwd=home.folder).out
    other.write_bytes(kept)
    ended = sros("fleet", "collect", "ks", "inbox", "--publish", pub, cwd=home.folder)
    assert ended.status == 1 and f"archives in '{pub}' were missing or changed: r2." in ended.err
    for fail_on, exit_status in (("delivery", 1), ("unmended", 0)):
        shown = sros(*status, "--fail-on", fail_on, cwd=home.folder)
        assert "than published or foreign: robots/r2.tar.gz (last seen" in shown.out
        assert shown.status == exit_status
    metrics = sros(*status, "--prometheus", cwd=home.folder).out
    assert re.search(r"^sros_fleet_publication_altered\{.*\} 1$", metrics, re.MULTILINE)
    for part in pub.iterdir():
        shutil.rmtree(part, ignore_errors=True)
    found = sros(*status, cwd=home.folder).out
    assert (
        f"metadata/timestamp.json, which robots fetch. Run {command}, which puts this right, or"
        in found
    )
    refused = sros(*publish, cwd=home.folder)
    assert (
        "if the keystore was restored, first repeat the revocations that were made" in refused.err
    )
    collect = ("fleet", "collect", "ks", "inbox", "--publish", str(pub))
    refused = sros(*collect, cwd=home.folder)
    assert f"add --new-folder to {command}" in refused.err, "no option of collect"
    assert refused.err.startswith("Unable to finish collecting: '") and refused.status == 2
    sros(*publish, "--new-folder", cwd=home.folder).ok()
    assert "lacks" not in sros(*status, cwd=home.folder).out


def test_messages_that_show_later_releases_refuse_a_new_folder(home: Home) -> None:
    """A robot that was revoked after the backup would get a release again."""
    home.run("fleet", "publish", "ks", "pub")
    later = read_published(OpenedKeystore(home.root)).number + 1
    home.send("r1", datetime.now(UTC), release=later)
    ended = sros("fleet", "collect", "ks", "inbox", cwd=home.folder).ok()
    assert ended.out == "3 robots: 1 kept, 2 without a message (or delivered by hand)\n"
    (home.folder / "pub").rename(home.folder / "lost")
    for folder in ("pub", "stick"):
        publish = ("fleet", "publish", "ks", folder, "--new-folder")
        refused = sros(*publish, cwd=home.folder)
        assert refused.status == 2
        assert f"r1 says that it has release {later}, which the keystore 'ks' never" in refused.err
        assert "run `sros revoke ks --robot r1`" in refused.err
    copy_of(home.root, home.folder / "copy")
    home.run("revoke", "copy", "--robot", "r1")  # a stolen robot may claim any number
    home.run("fleet", "publish", "copy", "other", "--new-folder")
    sros(*publish, "--restored", cwd=home.folder).ok()


def test_a_restored_keystore_without_releases_never_brings_back_a_ca_that_was_replaced(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the certificates of robots, which the seals of their releases list, show the CA."""
    backup, now = copy_of(home.root, home.folder / "backup"), DUE
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: now)
    rotate = ("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    home.run(*rotate)
    home.run("fleet", "publish", "ks", "pub")
    seals = {each.robot: each.seal.decode() for each in releases_in(home.folder / "pub", 3)}
    for robot in ("r1", "r2"):
        home.run("distribute_key", "ks", "--robot", robot, robot, "--force")
        home.send(robot, now, seal=seals[robot])
    (home.folder / "inbox/r2").rename(home.folder / "late")
    for path in (home.root, home.folder / "pub"):
        shutil.rmtree(path)
    backup.rename(home.root)
    now += timedelta(minutes=1)
    (note, *_) = home.collect(now).notes
    assert "Its identity CA was replaced after the backup." in note.text
    publish = ("fleet", "publish", "ks", "pub", "--restored", "--new-folder")
    refused = sros(*publish, cwd=home.folder)
    assert (refused.status, (home.folder / "pub").exists()) == (2, False), refused
    assert "(`sros rotate_ca ks --identity --finish --allow-unconfirmed`)" in refused.err
    now += timedelta(minutes=1)
    home.run(*rotate)
    (home.folder / "late").rename(home.folder / "inbox/r2")
    assert "identity CA" not in "".join(note.text for note in home.collect(now).notes)
    sros(*publish, cwd=home.folder).ok()


def test_only_the_seal_of_a_later_release_keeps_a_keystore_from_publishing(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot can invent a number; the office would never publish again."""
    publish, now = ("fleet", "publish", "ks", "pub"), datetime.now(UTC)
    home.run(*publish)
    backup = copy_of(home.root, home.folder / "backup")
    shutil.copytree(home.folder / "pub", home.folder / "pub of the backup")
    home.run("renew", "ks", "/r1/base")
    said = sros("crl", "ks", "--refresh", cwd=home.folder).err
    assert "robots that fetch get the changed files after `sros fleet publish ks PUB`" in said
    home.run(*publish)
    number = read_published(OpenedKeystore(home.root)).robots["r1"].release.number
    lost_list = (home.root / "enclaves/r1/base/crl.pem").read_text()
    releases = {release.number: release for release in releases_in(home.folder / "pub", 3)}
    seal = releases[number].seal.decode()
    for path in (home.root, home.folder / "pub"):
        shutil.rmtree(path)
    backup.rename(home.root)
    (home.folder / "pub of the backup").rename(home.folder / "pub")
    forged = seal.replace(f"number {number}", "number 999999")
    for sent in (forged, "x", releases[min(releases)].seal.decode(), None):
        more = {} if sent is None else {"seal": sent}
        home.send("r1", now, release=10**12, **more)
        now += timedelta(minutes=1)
        assert not home.collect(now).notes
    home.run(*publish)
    # A lost list explains no seal: whoever sends the list first would let the rights come back.
    home.send("r3", now, crl=lost_list)
    assert [note.id for note in home.collect(now).notes] == ["fleet.revocations-restored"]
    home.send("r2", DUE, seal=seal, requests=(home.request("r2"),))
    found = home.collect(DUE, dry_run=True), home.collect(DUE)
    for inbox in found:
        (note,) = (note.text for note in inbox.notes)
        assert note.startswith("r2 has a release that the keystore sealed but does not know: ")
        (request,) = inbox.robots[1].requests
        assert request.outcome == "refused" and "rights that were taken away" in request.why
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: DUE)
    status = sros("fleet", "status", "ks", cwd=home.folder)
    assert "the keystore is older than its robots" in status.out and status.status == 1
    exported = sros("distribute_key", "ks", "--robot", "r2", "old", cwd=home.folder)
    assert "note [export.older-keystore]: the keystore is older than its robots" in exported.err
    checked = sros("check", "ks", cwd=home.folder)
    assert checked.status == 1 and "keystore.older-than-robots" in checked.out
    for command in (publish, ("renew", "ks", "--all-expiring", "30d")):
        refused = sros(*command, cwd=home.folder)
        assert refused.status == 2
        assert "the keystore 'ks' is older than its robots" in refused.err
    assert not home.collect(DUE).notes, "it is said once"
    publish_releases(home.root, home.folder / "pub", now=DUE, restored=True)
    publish_releases(home.root, home.folder / "pub", now=DUE)
    home.send("r3", DUE, seal=seal)
    assert not home.collect(DUE).notes, "the restore is known"
    # The seal of a release that was published while the clock was far ahead.
    keystore = OpenedKeystore(home.root)
    authority = load_authority(keystore, PERMISSIONS, keystore.template, IN_KEYSTORE, DUE)
    *_, last = sorted(releases_in(home.folder / "pub", 3), key=lambda release: release.number)
    new = {"enclaves/r3/base/permissions.p7s": b"unknown"}
    sealed = [(last.robot, 10**10, last.files), ("r3", number := 10**11, {**last.files, **new})]
    of_killed_run, ahead = seal_releases(sealed, authority)
    for minute, (signed, noted) in enumerate(
        ((of_killed_run, False), (ahead, True), (ahead, False)), 1
    ):
        home.send("r3", DUE + timedelta(minutes=minute), seal=signed.decode())
        assert bool(home.collect(DUE).notes) is noted
    assert OpenedKeystore(home.root).ledger.next_number() > number, "robots refuse a lower number"


def test_a_seal_shows_an_enclave_that_was_revoked_by_a_lost_ca(home: Home) -> None:
    """The published folder is lost, and the keystore cannot verify the list of the lost CA."""
    now = datetime.now(UTC)
    home.run("fleet", "publish", "ks", "pub")
    backup = copy_of(home.root, home.folder / "backup")
    rotate = ("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    home.run(*rotate)
    home.run("fleet", "publish", "ks", "pub")
    number = read_published(OpenedKeystore(home.root)).robots["r1"].release.number
    last = [release for release in releases_in(home.folder / "pub", 3) if release.number == number]
    releases = {release.robot: release.files for release in last}
    keystore = OpenedKeystore(home.root)
    authority = load_authority(keystore, PERMISSIONS, keystore.template, IN_KEYSTORE, NOW)
    files = {path.replace("base", "other"): data for path, data in releases["r3"].items()}
    sealed = [("r1", number, releases["r1"]), ("r3", number, files)]
    seals = dict(zip(("r1", "r3"), seal_releases(sealed, authority), strict=True))
    for path in (home.root, home.folder / "pub"):
        shutil.rmtree(path)
    backup.rename(home.root)
    # A message of another robot already shows the restore; then, the number shows nothing new.
    for robot, signed in seals.items():
        home.send(robot, now, seal=signed.decode())
        notes = [note.text for note in home.collect(now).notes]
        assert any("/r3/base may have been revoked" in note for note in notes) is (robot == "r3")
    lines = (home.root / "ledger.jsonl").read_bytes()
    home.send("r3", now + timedelta(minutes=1), seal=seals["r3"].decode())
    home.collect(now)
    assert (home.root / "ledger.jsonl").read_bytes() == lines, "it is recorded once"
    home.run(*rotate)
    publish = ("fleet", "publish", "ks", "pub", "--restored", "--new-folder")
    refused = sros(*publish, cwd=home.folder)
    assert refused.status == 2 and "/r3/base may have been revoked or removed" in refused.err
    assert "/r1" not in refused.err and "/r2" not in refused.err
    home.run("renew", "ks", "/r3/base", "--new-key", "--revoke-old")
    home.run(*publish)


def test_a_late_message_from_before_a_published_restore_shows_no_other_restore(home: Home) -> None:
    """Status would call the keystore older than its robots, though nothing is to publish."""
    home.run("fleet", "publish", "ks", "pub")
    backup = copy_of(home.root, home.folder / "backup")
    home.run("renew", "ks", "/r1/base")
    home.run("distribute_key", "ks", "--robot", "r1", "r1", "--force")
    later = home.certificate("/r1/base")
    home.run("fleet", "publish", "ks", "pub")
    *_, last = sorted(releases_in(home.folder / "pub", 3), key=lambda release: release.number)
    seal = last.seal.decode()
    for path in (home.root, home.folder / "pub"):
        shutil.rmtree(path)
    backup.rename(home.root)
    home.send("r2", seal=seal)
    assert [note.id for note in home.collect().notes] == ["fleet.later-release"]
    publish_releases(home.root, home.folder / "pub", now=NOW, restored=True, new_folder=True)
    kept = copy_of(home.root, home.folder / "kept")
    for sent in (seal, None):
        shutil.rmtree(home.root)
        copy_of(kept, home.root)
        assert not age_clause(OpenedKeystore(home.root))
        home.send("r1", seal=sent)
        assert "not in the ledger" in home.of("r1").why
        keystore = OpenedKeystore(home.root)
        assert bool(age_clause(keystore)) is not bool(sent), "without a seal, it may be later"
        serials = {entry.serial for entry in keystore.ledger_with("what", "certificate").entries}
        assert f"{later.serial_number:x}" in serials


def test_a_new_key_that_a_robot_reports_before_the_list_is_not_revoked(home: Home) -> None:
    """The enclave was revoked, and created again with a key of its robot; no list has this key."""
    backup = copy_of(home.root, home.folder / "backup")
    old = home.certificate("/r2/base")
    home.run("revoke", "ks", "/r2/base")
    home.run("create_enclave", "ks", "/r2/base")
    new = home.certificate("/r2/base")
    for robot in ("r1", "r2"):
        home.run("distribute_key", "ks", "--robot", robot, robot, "--force")
    home.send("r2")
    crl = (home.folder / "r1/enclaves/r1/base/crl.pem").read_text()
    shutil.rmtree(home.root)
    backup.rename(home.root)
    assert "not in the ledger" in home.of("r2").why
    home.send("r1", crl=crl)
    home.collect()
    now = OpenedKeystore(home.root).revocation_list
    assert now and now.revokes(old.serial_number) and not now.revokes(new.serial_number)


def test_what_was_published_expires(home: Home) -> None:
    """Robots then refuse it: a fleet whose files are all current is not in order."""
    status = ("fleet", "status", "ks")
    home.run("fleet", "publish", "ks", "pub", "--root-validity", "2d", "--timestamp-validity", "3d")
    number = read_published(OpenedKeystore(home.root)).number
    for robot in ROBOTS:
        home.send(robot, datetime.now(UTC), release=number)
    home.run("fleet", "collect", "ks", "inbox")
    ended = sros(*status, "--json", cwd=home.folder).ok()
    published = json.loads(ended.out)["publication"]
    left = parse_iso(published["expires"]) - datetime.now(UTC)
    assert published["accepted"] and timedelta(days=1.9) < left < timedelta(days=2), "the root's"
    file = home.root / PUBLISHED
    recorded = json.loads(file.read_text())
    for until, said in (
        (iso(datetime.now(UTC) - timedelta(days=3)), "the published files expired 3 d ago"),
        (None, "the expiry of the published files is not known"),
    ):
        file.write_text(json.dumps({**recorded, "until": until}))
        ended = sros(*status, cwd=home.folder)
        assert ended.status == 1 and "3 robots: 3 current" in ended.out
        assert said in ended.out and f"`sros fleet publish ks {home.folder}/pub`" in ended.out
        assert ended.out.count("`sros fleet publish") == 1
        text = sros(*status, "--prometheus", cwd=home.folder).out
        sample = "sros_fleet_publication_expiry_timestamp_seconds{"
        assert (sample in text) == bool(until) and "sros_fleet_root_expiry_timestamp_" in text
    file.write_text(json.dumps({**recorded, "until": until, "root_until": "2026-01-01T00:00:00Z"}))
    ended = sros(*status, cwd=home.folder)
    assert f"`sros fleet publish ks {home.folder}/pub --root-key FILE`" in ended.out
    home.run("renew", "ks", "/r1/base")
    robots = json.loads(sros(*status, "--json", cwd=home.folder).out)["robots"]
    assert {robot["robot"]: robot["to_do"] for robot in robots}["r1"] == "publish"
    table = sros("fleet", "status", "ks", cwd=home.folder).out
    assert table.count("sros fleet publish") == 1, "not again below the table"
    file.write_text(json.dumps(recorded))
    table = sros("fleet", "status", "ks", cwd=home.folder).out
    assert f"\npublish: `sros fleet publish ks {home.folder}/pub`\n" in table
