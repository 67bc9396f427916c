"""Rotating CAs: every stage is whole, openssl agrees, and killed means run it again."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Self

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa

from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.keystore.delivery.export import distribute
from sros_tool.keystore.delivery.rollback import retired_authorities
from sros_tool.keystore.issuing import keyring
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.known_keys import (
    removed_enclaves,
    revoked_entries,
    unknown_authorities,
    unlisted_revocations,
)
from sros_tool.keystore.layout import FLEET_ROOT, REVOKED, ROTATION, enclave_path, list_enclaves
from sros_tool.keystore.lifecycle import rotate
from sros_tool.keystore.lifecycle.change import KeystoreChange
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.lifecycle.rotate import RotationStep, renew_identity_ca, rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage, retired_key_path, rotation_status
from sros_tool.keystore.lifecycle.update import update_keystore
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import common_name, digest, pem, validity_of
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem
from sros_tool.policy.document import read_policy
from tests.keystore.test_transaction import DIED, in_child
from tests.support import made_by_ros2
from tests.support.harness import (
    check_enclave_whole,
    copy_of,
    made_once,
    policy_text,
    publish,
    remains,
    snapshot,
    sros,
)
from tests.support.long_form import ONLY_LONG, few_steps, some

NOW = datetime.now(UTC)
STAGES = (RotationStage.DISTRIBUTE, RotationStage.REISSUE, RotationStage.RETIRE)
NAMES = ("/a", "/a/inner", "/b")


@pytest.fixture(params=[pytest.param("development", marks=ONLY_LONG), "production", "sros2"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return make(tmp_path, request.param)


@pytest.fixture
def separate(tmp_path: Path) -> Path:
    return make(tmp_path, "production")


def make(folder: Path, template: str) -> Path:
    policy = folder / "policy.xml"
    policy.write_text(policy_text({name: publish(f"t{name}") for name in NAMES}))

    def make(root: Path) -> None:
        create_keystore(root, template=load_template(template), now=NOW)
        generate_artifacts(root, policies=[read_policy(policy)], now=NOW)

    return made_once(folder / "ks", make, template)


def check(root: Path, now: datetime = NOW) -> None:
    """Every enclave can be loaded by its first CA alone (Cyclone DDS); openssl agrees for some."""
    assert not remains(root.parent)
    names = list_enclaves(root)
    for name in names:
        assert open_enclave(enclave_path(root, name), now=now).problems == (), name
        check_enclave_whole(enclave_path(root, name))
    for name in some(names, 1):
        folder = enclave_path(root, name)
        identity, permissions = (folder / f"{r}_ca.cert.pem" for r in ("identity", "permissions"))
        openssl("verify", "-x509_strict", "-CAfile", identity, folder / "cert.pem")
        for document in ("permissions", "governance"):
            signed = folder / f"{document}.p7s"
            openssl("smime", "-verify", "-text", "-in", signed, "-CAfile", permissions)
    for path in (*root.glob("private/*.pem"), *root.glob("retired/*.key.pem")):
        assert path.is_symlink() or path.stat().st_mode & 0o777 == 0o600, path


ACCEPTED: set[tuple[object, ...]] = set()
"""What openssl accepted: its words, and in place of the files their contents."""


def openssl(*words: object) -> None:
    asked = tuple(each.read_bytes() if isinstance(each, Path) else each for each in words)
    if asked in ACCEPTED:
        return
    done = subprocess.run(["openssl", *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, (words, done.stderr)
    ACCEPTED.add(asked)


def states(root: Path) -> list[tuple[str, str, int]]:
    found = rotation_status(OpenedKeystore(root), now=NOW).authorities
    return [(each.roles[0], each.state, each.enclaves) for each in found]


# ── the stages ─────────────────────────────────────────────────────────────────────────────


def test_every_stage_is_whole(root: Path) -> None:
    files = sorted({path.resolve().name[: -len(".cert.pem")] for path in root.glob("public/*")})
    old = {file: OpenedKeystore(root).certificates_of(file) for file in files}
    rights = {name: (enclave_path(root, name) / "permissions.xml").read_bytes() for name in NAMES}
    roles = ["identity", "permissions"] if len(files) == 2 else ["identity"]
    assert states(root) == [(role, "issuing", 3) for role in roles]

    step = rotate_ca(root, now=NOW)
    assert (step.stage, sorted(step.files)) == (RotationStage.DISTRIBUTE, files)
    check(root)
    assert states(root) == [
        state for role in roles for state in ((role, "issuing", 3), (role, "next", 0))
    ]
    both = {file: OpenedKeystore(root).certificates_of(file) for file in files}
    assert all(both[file][0] == old[file][0] for file in files)

    rotate_ca(root, now=NOW)
    check(root)
    assert states(root) == [
        state for role in roles for state in ((role, "issuing", 3), (role, "old", 0))
    ]
    assert all(OpenedKeystore(root).certificates_of(file) == both[file][::-1] for file in files)
    assert len(list(root.glob("retired/*.key.pem"))) == len(files)

    rotate_ca(root, now=NOW)
    check(root)
    assert states(root) == [(role, "issuing", 3) for role in roles]
    assert all(OpenedKeystore(root).certificates_of(file) == both[file][1:] for file in files)
    assert not (root / ROTATION).exists()
    assert sorted(path.name.split(".")[1] for path in root.glob("retired/*")) == sorted(
        ["cert", "key"] * len(files)
    )
    for name in NAMES:  # rights stay, word for word
        assert (enclave_path(root, name) / "permissions.xml").read_bytes() == rights[name]


def test_two_commands_that_go_on_together_begin_one_stage(
    separate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one waits for the first, and would cut off what has not been restarted."""

    class Late(KeystoreChange):
        def __enter__(self) -> Self:
            monkeypatch.undo()
            rotate_ca(separate, now=NOW)
            return super().__enter__()

    monkeypatch.setattr(rotate, "KeystoreChange", Late)
    with pytest.raises(KeystoreError, match="has just reached the stage distribute"):
        rotate_ca(separate, now=NOW)
    assert rotate_ca(separate, now=NOW).stage == RotationStage.REISSUE


def test_the_keystore_can_be_used_at_every_stage(root: Path) -> None:
    for index, stage in enumerate(STAGES):
        rotate_ca(root, stage, now=NOW)
        create_enclaves(root, [f"/new{index}"], now=NOW)
        sros("renew", root, "/a").ok()
        sros("inspect", root).ok()
        check(root)


def test_the_ledger_has_everything(separate: Path) -> None:
    for _ in STAGES:
        rotate_ca(separate, now=NOW)
    entries = OpenedKeystore(separate).ledger.entries
    assert [e.what for e in entries].count("ca") == 4
    known = {entry.sha256 for entry in entries}
    for file in ("identity_ca", "permissions_ca"):
        assert digest(OpenedKeystore(separate).certificates_of(file)[0]) in known
    last = {e.enclave: e for e in entries if e.what == "permissions"}
    first = {e.enclave: e for e in reversed(entries) if e.what == "permissions"}
    assert all(last[name].policy == first[name].policy != "" for name in NAMES)
    assert all(last[name].sha256 != first[name].sha256 for name in NAMES)


@pytest.mark.parametrize("role", ["identity", "permissions"])
def test_one_ca_alone(role: str, separate: Path) -> None:
    other = {"identity": "permissions", "permissions": "identity"}[role]
    (separate / f"private/{other}_ca.key.pem").unlink()  # it is not needed
    before = OpenedKeystore(separate).certificates_of(f"{other}_ca")
    for _ in STAGES:
        rotate_ca(separate, roles=[role], now=NOW)
        check(separate)
    assert OpenedKeystore(separate).certificates_of(f"{other}_ca") == before


def test_names_of_new_cas(separate: Path) -> None:
    """Fast DDS compares the name of the permissions CA with that of the peer."""
    rotate_ca(separate, now=NOW)
    old, new = OpenedKeystore(separate).certificates_of("permissions_ca")
    assert old.subject == new.subject
    assert old.public_key() != new.public_key()
    old, new = OpenedKeystore(separate).certificates_of("identity_ca")
    assert old.subject != new.subject


def test_all_at_once_from_every_stage(root: Path, tmp_path: Path) -> None:
    for steps in range(3):
        copy = copy_of(root, tmp_path / f"copy{steps}")
        for _ in range(steps):
            rotate_ca(copy, now=NOW)
        step = rotate_ca(copy, finish=True, now=NOW)
        assert step.stage is RotationStage.RETIRE
        check(copy)
        assert {standing for _, standing, _ in states(copy)} == {"issuing"}
        assert OpenedKeystore(copy).certificates_of(step.files[0]) != OpenedKeystore(
            root
        ).certificates_of(step.files[0])
        assert not (copy / ROTATION).exists()
        assert not list(copy.glob("private/next_*"))


def test_a_ca_that_is_not_valid_yet_is_not_replaced(separate: Path) -> None:
    """Its successor would begin no earlier, and no node could start with it."""
    before, early = snapshot(separate), NOW - timedelta(days=30)
    for change in (
        lambda: rotate_ca(separate, finish=True, now=early),
        lambda: create_enclaves(separate, ["/c"], now=early),
    ):
        with pytest.raises(KeystoreError, match="wait until the CA is valid"):
            change()
    assert snapshot(separate) == before


def test_an_expired_ca_is_replaced(separate: Path) -> None:
    later = NOW + timedelta(days=6 * 365)
    with pytest.raises(KeystoreError, match="not valid now"):
        create_enclaves(separate, ["/c"], now=later)
    rotate_ca(separate, finish=True, now=later)
    check_at = [open_enclave(enclave_path(separate, name), now=later) for name in NAMES]
    assert all(state.problems == () for state in check_at)
    create_enclaves(separate, ["/c"], now=later)


@pytest.mark.parametrize(
    ("days", "identity", "permissions"),
    [
        (5 * 365 - 91, "", ""),
        (5 * 365 - 89, "--same-key", "--next"),
        (6 * 365,) + ("--finish",) * 2,
    ],
)
def test_the_status_says_when_it_is_time(
    days: int, identity: str, permissions: str, separate: Path
) -> None:
    remarks = rotation_status(OpenedKeystore(separate), now=NOW + timedelta(days=days)).remarks
    wanted = [text for text in (identity, permissions) if text]
    assert len(remarks) == len(wanted)
    assert all(text in remark for text, remark in zip(wanted, remarks, strict=True))


@pytest.mark.parametrize("kind", ["without identifiers", "RSA"])
def test_what_fast_dds_cannot_tell_apart_is_said(kind: str, separate: Path) -> None:
    """ros2/sros2 makes CAs without identifiers; Fast DDS 2.9.1 was run with those."""
    rotate_ca(separate, now=NOW)
    rotate_ca(separate, now=NOW)
    fast = rotation_status(OpenedKeystore(separate), now=NOW).remarks[1]
    assert fast.startswith("Fast DDS: restart the processes one by one")
    foreign = foreign_ca(kind)
    path = separate / "public/permissions_ca.cert.pem"
    path.write_bytes(path.read_bytes() + foreign)
    fast = rotation_status(OpenedKeystore(separate), now=NOW).remarks[1]
    assert fast.startswith("Fast DDS: the old permissions CA has ")
    assert fast.endswith("Restart all processes together.")


def foreign_ca(kind: str) -> bytes:
    private = rsa.generate_private_key(65537, 2048) if kind == "RSA" else generate_key()
    name = common_name("sros2CA")
    return pem(
        x509.CertificateBuilder(
            issuer_name=name,
            subject_name=name,
            public_key=private.public_key(),
            serial_number=7,
            not_valid_before=NOW,
            not_valid_after=NOW + timedelta(days=9),
        ).sign(private, hashes.SHA256())
    )


def test_same_key(separate: Path) -> None:
    later = NOW + timedelta(hours=12)
    before = snapshot(separate / "enclaves")
    (old,) = OpenedKeystore(separate).certificates_of("identity_ca")
    renew_identity_ca(separate, now=later)
    (new,) = OpenedKeystore(separate).certificates_of("identity_ca")
    assert (new.subject, new.public_key()) == (old.subject, old.public_key())
    assert validity_of(new).not_after > validity_of(old).not_after
    assert snapshot(separate / "enclaves") == before
    check(separate, later)


def test_an_existing_ca_replaces_one_only_with_its_key(separate: Path, tmp_path: Path) -> None:
    """And a permissions CA only one of its name: Fast DDS refuses peers with another."""
    before, other = snapshot(separate), tmp_path / "other"
    sros("create_keystore", other, "--template", "production").ok()
    rotate = ("rotate_ca", separate, "--finish")
    ca, key = "public/{}_ca.cert.pem", "private/{}_ca.key.pem"
    for role, of_key, more, why in (
        ("identity", "", (), "needs the key of this CA. Name it with --identity-key"),
        ("identity", "permissions", (), "does not fit its key"),
        ("identity", "identity", ("--permissions",), "no effect without --identity"),
        ("permissions", "permissions", (), "cannot replace the permissions CA"),
    ):
        named = (f"--{role}-key", f"file:{other / key.format(of_key)}") if of_key else ()
        ended = sros(*rotate, f"--{role}-ca", other / ca.format(role), *named, *more)
        assert ended.status == 2 and why in ended.err, ended
    assert snapshot(separate) == before
    named = ("--identity-key", f"file:{other / key.format('identity')}")
    sros(*rotate, "--identity", "--identity-ca", other / ca.format("identity"), *named).ok()
    (now,) = OpenedKeystore(separate).certificates_of("identity_ca")
    assert pem(now) == (other / ca.format("identity")).read_bytes()
    rotate_ca(separate, roles=["permissions"], now=NOW)
    with pytest.raises(UsageError, match="stage distribute of a rotation to another CA"):
        rotate_ca(separate, now=NOW, existing={"identity": pem(now)})


def test_robots_never_take_the_ca_that_comes_next_for_one_that_was_replaced(root: Path) -> None:
    """As for a CA that was imported today: what sros makes is valid from a day ago."""
    early = NOW - timedelta(hours=3)
    before = [ca for role in ("identity", "permissions") for ca in trusted_by(root, role)]
    rotate_ca(root, now=early)
    for role in ("identity", "permissions"):
        old = [ca for ca in trusted_by(root, role) if ca in before]
        assert old and not retired_authorities(old, trusted_by(root, role))


def test_no_existing_ca_that_robots_would_take_for_a_replaced_one(
    separate: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    create_keystore(other, template=load_template("production"), now=NOW - timedelta(days=1))
    ca = {"identity": (other / "public/identity_ca.cert.pem").read_bytes()}
    key = Keyring(places={"identity": f"file:{other}/private/identity_ca.key.pem"})
    rotate = partial(rotate_ca, separate, roles=["identity"], now=NOW, existing=ca, new_keys=key)
    without_fetching = rotate(dry_run=True)
    assert without_fetching.stage is RotationStage.DISTRIBUTE
    (note,) = (note for note in without_fetching.notes if note.id == "rotation.older-ca")
    assert "the first `sros import` on each robot needs --force" in note.text
    (separate / FLEET_ROOT).parent.mkdir(exist_ok=True)
    (separate / FLEET_ROOT).touch()
    with pytest.raises(KeystoreError, match="is valid from an earlier time than the identity CA"):
        rotate()


def trusted_by(root: Path, role: str) -> Sequence[x509.Certificate]:
    return OpenedKeystore(root).authority(role)


def test_same_key_is_not_for_a_ca_that_signs_permissions(tmp_path: Path) -> None:
    root = make(tmp_path, "sros2")
    before = snapshot(root)
    with pytest.raises(KeystoreError, match="cannot be renewed with the same key"):
        renew_identity_ca(root, now=NOW)
    assert snapshot(root) == before


# ── old keys, and keys elsewhere ───────────────────────────────────────────────────────────


@pytest.mark.parametrize("when", [RotationStage.REISSUE, RotationStage.RETIRE])
def test_the_old_key_is_deleted_when_asked(when: RotationStage, root: Path) -> None:
    refused(lambda: rotate_ca(root, now=NOW, delete_old_key=True), root, "deletes no key")
    for stage in STAGES:
        step = rotate_ca(root, stage, now=NOW, delete_old_key=stage is when)
        if stage is when:
            assert "deletes the old key" in str(step.notes)
        elif when is RotationStage.RETIRE:  # revocations need the key until then
            again = sros("rotate_ca", root, "--to", stage, "--delete-old-key")
            assert again.status == 2 and f"already at the stage {stage}" in again.err, again
    assert not list(root.glob("retired/*.key.pem"))
    check(root)


def test_keys_in_files_elsewhere(tmp_path: Path) -> None:
    def places(name: str) -> Keyring:
        return Keyring(
            places={r: f"file:{tmp_path}/{name}_{r}" for r in ("identity", "permissions")}
        )

    root = tmp_path / "ks"
    create_keystore(root, template=load_template("production"), now=NOW, keyring=places("old"))
    create_enclaves(root, NAMES, now=NOW)
    before = snapshot(tmp_path)
    with pytest.raises(KeystoreError, match="--identity-key"):
        rotate_ca(root, now=NOW)
    with pytest.raises(KeystoreError, match=r"the key at 'file:.*old_identity' belongs"):
        rotate_ca(root, now=NOW, new_keys=places("old"))
    assert snapshot(tmp_path) == before
    rotate_ca(root, now=NOW, new_keys=places("new"))
    check(root)
    for says in ("needs it until the stage retire", "nothing needs it any more: delete it"):
        refused(lambda: rotate_ca(root, now=NOW, delete_old_key=True), root, "outside of the key")
        step = rotate_ca(root, now=NOW)
        assert step.kept_elsewhere == tuple(places("old").places.values())
        told = next(note.text for note in step.notes if "identity CA" in note.text)
        assert "does not delete" in told
        assert says in told
        check(root)
    assert (tmp_path / "old_identity").exists()
    create_enclaves(root, ["/later"], now=NOW)
    check(root)
    assert not list(root.glob("private/*.pem"))
    assert not list(root.glob("retired/*.key.pem"))


def test_the_note_on_a_lost_old_key_names_where_it_belongs(separate: Path) -> None:
    key = separate / "private/identity_ca.key.pem"
    kept = key.rename(separate.parent / "kept.pem")
    refused(lambda: rotate_ca(separate, now=NOW), separate, f"The current key is not at '{key}'")
    kept.rename(key)
    rotate_ca(separate, now=NOW)
    key.rename(kept)
    step = rotate_ca(separate, now=NOW)
    assert not step.kept_elsewhere
    (note,) = (note.text for note in step.notes if "the old key of the identity CA" in note.text)
    assert "is missing; until the stage retire, `sros revoke` needs it at" in note
    place = Path(note.split("'")[1])
    assert not place.exists()
    refused(lambda: revoke(separate, [NAMES[0]], now=NOW), separate, place.name)
    kept.rename(place)
    revoke(separate, [NAMES[0]], now=NOW)
    notes = str(rotate_ca(separate, now=NOW, delete_old_key=True).notes)
    assert "deletes the old key of the identity CA" in notes and not place.exists()


def test_from_the_keystore_to_elsewhere(tmp_path: Path) -> None:
    root = make(tmp_path, "sros2")
    place = f"file:{tmp_path}/ca.key"
    elsewhere = Keyring(places={"identity": place, "permissions": place})
    for stage in STAGES:
        rotate_ca(root, stage, now=NOW, new_keys=elsewhere)
        check(root)
    assert not [path for path in root.glob("private/*") if path.name]
    create_enclaves(root, ["/later"], now=NOW)
    check(root)


@pytest.mark.parametrize("outside", [(), ("identity",), ("identity", "permissions")])
def test_an_encrypted_key_has_an_encrypted_successor(
    outside: Collection[str], tmp_path: Path
) -> None:
    def keyring(number: int, *, encrypt: bool = False) -> Keyring:
        places = {role: f"file:{tmp_path}/{role}{number}.key.pem" for role in outside}
        return Keyring(lambda what: "open, sesame", places, encrypt)

    def make(root: Path) -> None:
        locked = keyring(1, encrypt=True)
        create_keystore(root, template=load_template("production"), now=NOW, keyring=locked)

    make(root := tmp_path / "ks")
    opened = replace(keyring(1), places={})
    create_enclaves(root, NAMES, now=NOW, keyring=opened)
    mistyped = replace(opened, secrets=lambda what: "open, sesamy")
    refused(lambda: rotate_ca(root, now=NOW, keyring=mistyped, new_keys=keyring(2)), root, "decr")
    for _ in STAGES:
        rotate_ca(root, now=NOW, keyring=opened, new_keys=keyring(2))
        keys = [path for path in tmp_path.rglob("*.key.pem") if path.parent.name != "enclaves"]
        assert len(keys) == 4
        assert all(b"ENCRYPTED" in path.read_bytes() for path in keys)
    create_enclaves(root, ["/later"], now=NOW, keyring=opened)
    check(root)


def test_a_new_key_that_is_protected_less_is_said(tmp_path: Path) -> None:
    """A file that the user made becomes the key of the new CA as it is."""
    root, plain = tmp_path / "ks", tmp_path / "plain.pem"
    locked = Keyring(lambda what: "open, sesame", {"identity": f"file:{tmp_path}/old"}, True)
    create_keystore(root, template=load_template("production"), now=NOW, keyring=locked)
    plain.write_bytes(key_pem(generate_key()))
    new = replace(locked, places={"identity": f"file:{plain}"})
    step = rotate_ca(root, now=NOW, keyring=locked, new_keys=new, dry_run=True)
    (told,) = (note.text for note in step.notes if note.id == "keystore.new-key-plain")
    assert "has no passphrase, but the current key has one" in told
    (tmp_path / "old").rename(tmp_path / "away")
    new = Keyring(locked.secrets, {"identity": f"file:{tmp_path}/new"})
    step = rotate_ca(root, now=NOW, keyring=locked, new_keys=new, roles=["identity"])
    (told,) = (note.text for note in step.notes if note.id == "keystore.new-key-plain")
    assert "sros cannot see" in told
    assert (tmp_path / "new").exists()


def test_a_key_on_a_token_is_made_after_refusals_and_without_the_old_passphrase(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def create(place: str, *_: object, **__: object) -> PrivateKey:
        made.append(place)
        return generate_key()

    monkeypatch.setattr(keyring, "holds_token_key", lambda *_, **__: False)
    monkeypatch.setattr(keyring, "create_token_key", create)
    root = tmp_path / "ks"
    locked = Keyring(lambda what: "open, sesame", {"identity": f"file:{tmp_path}/old"}, True)
    create_keystore(root, template=load_template("production"), now=NOW, keyring=locked)
    on_token = Keyring(places={"identity": "pkcs11:token=robots;object=next"})
    rotate = partial(rotate_ca, root, roles=["identity"], now=NOW, new_keys=on_token)
    refused(lambda: rotate(delete_old_key=True), root, "deletes no key")
    assert not made
    rotate()
    assert made == [on_token.places["identity"]]


# ── revocation ─────────────────────────────────────────────────────────────────────────────


def test_revocation_lists_go_along(separate: Path) -> None:
    revoke(separate, ["/b"], now=NOW)
    numbers = []
    for stage in STAGES:
        rotate_ca(separate, stage, now=NOW)
        check(separate)
        crl = OpenedKeystore(separate).revocation_list
        assert crl
        numbers.append(crl.number)
        text = (separate / "public/identity_ca.cert.pem").read_text()
        assert text.count("BEGIN X509 CRL") == (0 if stage is RotationStage.RETIRE else 1)
        folder = enclave_path(separate, "/a")
        ca, own = folder / "identity_ca.cert.pem", folder / "crl.pem"
        openssl("verify", "-crl_check", "-CAfile", ca, "-CRLfile", own, folder / "cert.pem")
    assert numbers == sorted(numbers)
    assert numbers[0] < numbers[1]


def test_a_revoked_certificate_of_a_ca_that_is_gone_is_not_of_a_trusted_one(
    separate: Path,
) -> None:
    """Also if all happens in one second, so that the times in the ledger do not tell."""
    revoke(separate, ["/b"], now=NOW)
    (certificate,) = (e for e in revoked_entries(OpenedKeystore(separate)) if e.serial)
    assert (certificate.what, certificate.enclave) == ("certificate", "/b")
    rotate_ca(separate, finish=True, now=NOW)
    assert not [e for e in revoked_entries(OpenedKeystore(separate)) if e.serial]
    shutil.rmtree(separate / "revoked")
    assert not [e for e in revoked_entries(OpenedKeystore(separate)) if e.serial]
    revoke(separate, ["/a"], now=NOW)
    assert {e.enclave for e in revoked_entries(OpenedKeystore(separate)) if e.serial} == {"/a"}


def test_the_renewal_of_a_ca_brings_no_removed_enclave_of_an_earlier_ca_back(
    separate: Path,
) -> None:
    def removed() -> list[str]:
        return [*removed_enclaves(OpenedKeystore(separate), NOW)]

    shutil.rmtree(enclave_path(separate, "/b"))
    days = [NOW + timedelta(days=day) for day in range(1, 4)]
    renew_identity_ca(separate, now=days[0])
    assert removed() == ["/b"], "its certificate is of this key"
    rotate_ca(separate, finish=True, now=days[1])
    assert not removed()
    renew_identity_ca(separate, now=days[2])
    assert not removed()


def test_a_ledger_that_begins_after_its_ca_has_the_certificates_from_before_its_renewal(
    separate: Path,
) -> None:
    for file in ("ledger.jsonl", "ledger.p7s"):
        (separate / file).unlink()
    create_enclaves(separate, ["/late"], now=NOW)
    shutil.rmtree(enclave_path(separate, "/late"))
    renew_identity_ca(separate, now=NOW + timedelta(days=1))
    assert [*removed_enclaves(OpenedKeystore(separate), NOW)] == ["/late"]
    (separate / "public/identity_ca.cert.pem").unlink()
    assert [*removed_enclaves(OpenedKeystore(separate), NOW)] == ["/late"], "nothing tells the CA"


@pytest.mark.parametrize("stage", STAGES[:2])
def test_a_ledger_that_was_lost_before_a_stage_learns_which_ca_is_replaced(
    separate: Path, tmp_path: Path, stage: RotationStage
) -> None:
    """Else the remedy for its loss adds CAs that `check` calls unknown, and robots keep the old."""
    distribute(OpenedKeystore(separate), ["/a"], tmp_path / "out", now=NOW)
    for before in STAGES[: STAGES.index(stage)]:
        rotate_ca(separate, before, now=NOW)
    for file in ("ledger.jsonl", "ledger.p7s"):
        (separate / file).unlink()
    generate_artifacts(separate, policies=[read_policy(tmp_path / "policy.xml")], now=NOW)
    create_enclaves(separate, ["/late"], now=NOW)
    shutil.rmtree(enclave_path(separate, "/late"))
    for later in STAGES[STAGES.index(stage) :]:
        assert [*removed_enclaves(OpenedKeystore(separate), NOW)] == ["/late"], "of the old CA"
        rotate_ca(separate, later, now=NOW)
        assert not unknown_authorities(OpenedKeystore(separate), "identity")
    assert not removed_enclaves(OpenedKeystore(separate), NOW)
    distribute(OpenedKeystore(separate), ["/a"], tmp_path / "out", force=True, now=NOW)


def test_what_the_old_ca_issued_during_a_rotation_and_was_revoked_keeps_no_export(
    separate: Path, tmp_path: Path
) -> None:
    """Its list is gone with the CA; no certificate says that it is of the CA that came next."""
    rotate_ca(separate, now=NOW)
    later = NOW + timedelta(minutes=1)
    create_enclaves(separate, ["/late"], now=later)
    revoke(separate, ["/late"], now=later)
    (folder,) = (separate / "revoked").iterdir()
    rotate_ca(separate, finish=True, now=later)
    distribute(OpenedKeystore(separate), ["/a"], tmp_path / "out", now=later)
    assert not unlisted_revocations(OpenedKeystore(separate), later)
    shutil.copy(enclave_path(separate, "/a") / "cert.pem", folder / "cert.pem")
    assert unlisted_revocations(OpenedKeystore(separate), later) == ["/late"], "another certificate"
    refresh_crl(separate, now=later)
    assert not unlisted_revocations(OpenedKeystore(separate), later), "as the remedy says"


def lists_of(root: Path) -> list[tuple[str, set[int]]]:
    """The subject of each issuer of a list that DDS reads, and the serial numbers on the list."""
    return [
        (each.list.issuer.rfc4514_string(), {one.serial for one in each.revoked})
        for each in OpenedKeystore(root).revocation_lists
    ]


def revoked_by_all(root: Path, old: Path) -> None:
    """By every CA that is trusted, OpenSSL refuses ``old`` and accepts the enclaves."""
    public = root / "public"
    for path in (public / "identity_ca.crl.pem", public / "identity_ca.cert.pem"):
        # The CA file has both CAs, and the list of the second one; the first one's is crl.pem.
        assert b"X509 CRL" in path.read_bytes()
    words = ["verify", "-crl_check", "-CAfile", public / "identity_ca.cert.pem"]
    words += ["-CRLfile", public / "identity_ca.crl.pem"]
    for name in list_enclaves(root):
        openssl(*words, enclave_path(root, name) / "cert.pem")
    refused = subprocess.run(["openssl", *map(str, [*words, old])], capture_output=True, text=True)
    assert "certificate revoked" in refused.stderr, refused


@pytest.mark.parametrize(
    "earlier", some([False, True], 1), ids=lambda each: "not the first" if each else "the first"
)
def test_a_revocation_in_between(earlier: bool, root: Path, tmp_path: Path) -> None:
    """While both CAs are trusted, both revoke: what an enclave had of either is refused."""
    create_enclaves(root, ["/c", "/d"], now=NOW)
    old = {
        name: Path(shutil.copy(enclave_path(root, name) / "cert.pem", tmp_path / name[1:]))
        for name in ("/c", "/d")
    }
    serials = {name: serial_of(path) for name, path in old.items()}
    public = root / "public"
    if earlier:
        create_enclaves(root, ["/e"], now=NOW)
        revoke(root, ["/e"], now=NOW)
    rotate_ca(root, RotationStage.DISTRIBUTE, now=NOW)
    assert not revoke(root, ["/c"], now=NOW).remarks
    if (public / "identity_ca.cert.pem").is_symlink():
        assert (public / "identity_ca.cert.pem").resolve() == (public / "ca.cert.pem").resolve()
    check(root)
    (_, first), (_, second) = lists_of(root)
    assert serials["/c"] in first
    assert not second  # the new CA has issued nothing yet
    numbers = [each.number for each in OpenedKeystore(root).revocation_lists]
    assert rotate_ca(root, now=NOW).stage is RotationStage.REISSUE  # all is there that it needs
    check(root)
    assert [each.number for each in OpenedKeystore(root).revocation_lists] == [
        numbers[1] + 1,
        numbers[0],
    ]
    new = Path(shutil.copy(enclave_path(root, "/d") / "cert.pem", tmp_path / "new"))
    assert not revoke(root, ["/d"], now=NOW).remarks
    check(root)
    (_, first), (_, second) = lists_of(root)
    assert {serials["/d"], serial_of(new)} <= first
    assert {serials["/c"], serials["/d"], serial_of(new)} <= second
    for path in (*old.values(), new):
        revoked_by_all(root, path)
    refresh_crl(root, now=NOW)
    assert lists_of(root) == [(_subject(root), first), (_subject(root, 1), second)]
    rotate_ca(root, RotationStage.RETIRE, now=NOW)
    check(root)
    ((_, third),) = lists_of(root)
    assert third == first


def _subject(root: Path, index: int = 0) -> str:
    file = next(iter(OpenedKeystore(root).authority_files))
    return OpenedKeystore(root).certificates_of(file)[index].subject.rfc4514_string()


def serial_of(path: Path) -> int:
    return x509.load_pem_x509_certificate(path.read_bytes()).serial_number


@pytest.mark.parametrize("how", some(["deleted", "another", "elsewhere"], 1))
def test_without_the_old_key_revoking_waits_for_the_end(
    how: str, separate: Path, tmp_path: Path
) -> None:
    """Fast DDS would accept what the old CA has issued, which nobody could revoke."""
    create_enclaves(separate, ["/c", "/d"], now=NOW)
    revoke(separate, ["/c"], now=NOW)
    rotate_ca(separate, RotationStage.DISTRIBUTE, now=NOW)
    rotate_ca(separate, RotationStage.REISSUE, now=NOW, delete_old_key=how == "deleted")
    if how != "deleted":
        kept = separate / retired_key_path(
            OpenedKeystore(separate).certificates_of("identity_ca")[1]
        )
        assert kept.exists()
        kept.write_bytes(key_pem(generate_key()))
        if how == "elsewhere":
            kept.unlink()
    before = snapshot(separate)
    refused = sros("revoke", separate, "/d")
    assert refused.status == 2
    assert refused.err.count("\n") == 1
    assert "the key of the old identity CA" in refused.err
    assert f"rotate_ca {separate} --to retire" in refused.err
    assert snapshot(separate) == before
    carried = lists_of(separate)[1]
    done = sros("revoke", separate, "/d", "--until-retired").ok()
    assert "Fast DDS accepts the revoked certificates that the CA issued" in done.err
    assert lists_of(separate)[1] == carried
    refreshed = sros("crl", separate, "--refresh").ok()
    assert "was not signed again" in refreshed.err
    check(separate)
    rotate_ca(separate, RotationStage.RETIRE, now=NOW)
    assert "was not signed" not in sros("crl", separate, "--refresh").ok().err
    check(separate)


def test_an_old_key_outside_of_the_keystore_is_found_again(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    places = {role: f"file:{tmp_path / role}.key" for role in ("identity", "permissions")}
    create_keystore(
        root, template=load_template("production"), keyring=Keyring(places=places), now=NOW
    )
    create_enclaves(root, ["/a", "/b"], now=NOW)
    old = Path(shutil.copy(root / "enclaves/b/cert.pem", tmp_path / "old.pem"))
    new = Keyring(places={role: f"{place}2" for role, place in places.items()})
    rotate_ca(root, RotationStage.DISTRIBUTE, new_keys=new, now=NOW)
    rotate_ca(root, RotationStage.REISSUE, now=NOW)
    assert not revoke(root, ["/b"], now=NOW).remarks
    revoked_by_all(root, old)


def test_revoking_while_the_next_key_is_away(separate: Path) -> None:
    """The new CA has issued nothing: the list it needs is distributed by the next stage."""
    rotate_ca(separate, now=NOW)
    key = separate / "private/next_identity_ca.key.pem"
    key.rename(separate.parent / "away")
    assert not revoke(separate, ["/b"], now=NOW).remarks
    assert len(lists_of(separate)) == 1
    (separate.parent / "away").rename(key)
    assert rotate_ca(separate, now=NOW).stage is RotationStage.DISTRIBUTE
    assert len(lists_of(separate)) == 2
    check(separate)
    assert rotate_ca(separate, now=NOW).stage is RotationStage.REISSUE
    check(separate)
    assert rotate_ca(separate, now=NOW).stage is RotationStage.RETIRE
    check(separate)


# ── stopped, repeated, refused ─────────────────────────────────────────────────────────────


def test_a_stage_can_be_repeated(root: Path) -> None:
    for stage in STAGES:
        rotate_ca(root, stage, now=NOW)
        before = snapshot(root)
        assert rotate_ca(root, stage, now=NOW).changes == ()
        assert snapshot(root) == before


def shape(root: Path) -> tuple[object, ...]:
    """What a keystore is, apart from keys and signatures, which are never the same."""
    files = {path for path in snapshot(root) if not path.startswith("retired/")}
    kept = sorted(path.name.split(".", 1)[1] for path in root.glob("retired/*"))
    return (
        frozenset(files),
        tuple(kept),
        tuple(states(root)),
        len(OpenedKeystore(root).ledger.entries),
    )


@pytest.mark.parametrize("stage", some([*STAGES, None], 1))
def test_death_at_every_step(stage: RotationStage | None, tmp_path: Path) -> None:
    """Killed at any step, and run again: the same end state (None is all stages at once)."""
    base = make(tmp_path, "production")
    for before in STAGES[: STAGES.index(stage) if stage else 0]:
        rotate_ca(base, before, now=NOW)
    work = tmp_path / "work"

    def fresh() -> Path:
        shutil.rmtree(work, ignore_errors=True)
        return copy_of(base, work)

    def verb(root: Path) -> Callable[[], RotationStep]:
        return lambda: rotate_ca(root, stage, now=NOW, finish=stage is None)

    status, steps = in_child(verb(fresh()))
    assert status == 0
    wanted, start = shape(work), shape(base)
    for step in few_steps(steps):
        root = fresh()
        assert in_child(verb(root), step)[0] == DIED, step
        for name in NAMES:
            assert open_enclave(enclave_path(root, name), now=NOW).problems == (), (step, name)
            check_enclave_whole(enclave_path(root, name))
        rotation_status(OpenedKeystore(root), now=NOW)
        if stage is not None or shape_after_tidy(root) == start:
            verb(root)()
        assert shape(root) == wanted, step
        assert not remains(tmp_path)


def shape_after_tidy(root: Path) -> tuple[object, ...]:
    from sros_tool.keystore.transaction import recover_keystore

    recover_keystore(root)
    return shape(root)


def test_dry_run_changes_nothing_and_says_what_would(root: Path) -> None:
    for stage in STAGES:
        before = snapshot(root)
        would = rotate_ca(root, stage, now=NOW, dry_run=True)
        assert snapshot(root) == before
        done = rotate_ca(root, stage, now=NOW)
        pattern = [(each.action, each.path) for each in would.changes]
        actual = [(each.action, each.path) for each in done.changes]
        assert pattern == actual


def refused(call: Callable[[], object], root: Path, match: str) -> None:
    before = snapshot(root)
    with pytest.raises(SrosError, match=match):
        call()
    assert snapshot(root) == before


def test_refusals(separate: Path, tmp_path: Path) -> None:
    refused(lambda: rotate_ca(separate, RotationStage.REISSUE, now=NOW), separate, "distribute")
    rotate_ca(separate, now=NOW)
    refused(lambda: rotate_ca(separate, RotationStage.RETIRE, now=NOW), separate, "reissue")
    refused(lambda: renew_identity_ca(separate, now=NOW), separate, "under way")
    rotate_ca(separate, now=NOW)
    refused(lambda: rotate_ca(separate, RotationStage.DISTRIBUTE, now=NOW), separate, "is over")
    (separate / ROTATION).write_text("{}")
    refused(lambda: rotate_ca(separate, now=NOW), separate, "cannot be continued")


def test_one_ca_for_both_jobs_is_replaced_for_both(tmp_path: Path) -> None:
    root = make(tmp_path, "sros2")
    with pytest.raises(UsageError, match="both roles"):
        rotate_ca(root, roles=["identity"], now=NOW)


def test_an_enclave_of_another_ca_stops_everything(separate: Path, tmp_path: Path) -> None:
    create_keystore(tmp_path / "other", template=load_template("production"), now=NOW)
    create_enclaves(tmp_path / "other", ["/b"], now=NOW)
    foreign = enclave_path(tmp_path / "other", "/b") / "cert.pem"
    shutil.copy(foreign, enclave_path(separate, "/b") / "cert.pem")
    rotate_ca(separate, now=NOW)
    refused(lambda: rotate_ca(separate, now=NOW), separate, "enclave /b cannot be moved")


def test_a_revoked_certificate_that_cannot_be_read_stops_a_rotation(separate: Path) -> None:
    """Any enclave could have its key, which a new CA would make valid again."""
    unreadable = separate / REVOKED / "ab/cert.pem"
    unreadable.parent.mkdir(parents=True)
    unreadable.write_text("")
    rotate_ca(separate, now=NOW)
    refused(lambda: rotate_ca(separate, now=NOW), separate, "cannot be read")


def test_a_ca_ends_before_the_old_one_only_if_it_was_chosen(tmp_path: Path) -> None:
    template = replace(load_template("production"), authority_validity=timedelta(days=3650))
    root = tmp_path / "ks"
    create_keystore(root, template=template, now=NOW)
    update_keystore(root, replace(template, authority_validity=timedelta(days=90)), now=NOW)
    shutil.copytree(root, other := tmp_path / "other")
    (note,) = rotate_ca(root, now=NOW).notes
    assert (note.id, "is 90d" in note.text) == ("keystore.ca-expires-earlier", True)
    for done in (
        rotate_ca(root, now=NOW, finish=True),
        rotate_ca(other, now=NOW, validity=timedelta(days=90)),
    ):
        assert note.id not in {each.id for each in done.notes}


def test_no_default_replaces_a_ca_by_one_that_ends_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A keystore of ros2/sros2 has no settings that could choose it, until sros takes it over."""
    root, taken_over = tmp_path / "ks", tmp_path / "taken over"
    made_by_ros2.make(taken_over, "/a", now=NOW)
    rotate_ca(taken_over, now=NOW, validity=timedelta(days=7300), finish=True)
    noted = rotate_ca(taken_over, now=NOW).notes
    assert "keystore.ca-expires-earlier" in {each.id for each in noted}
    monkeypatch.setattr(made_by_ros2, "VALIDITY", timedelta(days=7300))
    made_by_ros2.make(root, "/a", now=NOW)
    refused(lambda: rotate_ca(root, now=NOW), root, "expire before the old")


def test_exports_can_be_replaced_during_a_rotation(separate: Path, tmp_path: Path) -> None:
    """A robot's folder gets its enclaves one after the other."""
    distribute(OpenedKeystore(separate), ["/a", "/b"], tmp_path / "robot", now=NOW)
    for stage in STAGES:
        rotate_ca(separate, stage, now=NOW)
        for name in ("/a", "/b"):
            distribute(OpenedKeystore(separate), [name], tmp_path / "robot", now=NOW, force=True)
            folder = enclave_path(tmp_path / "robot", name)
            assert open_enclave(folder, now=NOW).problems == ()


# ── the verb ───────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("before", ["new", "same key", "replaced"])
def test_nothing_is_retired_that_nothing_replaced(before: str, separate: Path) -> None:
    if before == "same key":
        sros("rotate_ca", separate, "--same-key").ok()
    if before == "replaced":
        sros("rotate_ca", separate, "--finish", "--identity", "--delete-old-key").ok()
    ended = sros("rotate_ca", separate, "--to", "retire")
    assert ended.status == (0 if before == "replaced" else 2), ended
    if before != "replaced":
        assert "no CA of keystore" in ended.err
        (command,) = re.findall("`sros (.+?)`", ended.err)
        sros(*command.split()).ok()


def test_the_verb(separate: Path) -> None:
    told = json.loads(sros("rotate_ca", separate, "--json").ok().out)
    assert (told["stage"], told["next"], told["enclaves"]) == ("none", "distribute", 3)
    assert sros("rotate-ca", separate, "--next").ok().out == (
        "distributed the new CA next to the old one: identity_ca, permissions_ca\n"
    )
    told = json.loads(sros("inspect", separate / "public/identity_ca.cert.pem", "--json").ok().out)
    assert [each["is_ca"] for each in told["further"]] == [True]
    told = json.loads(sros("rotate_ca", separate, "--status", "--json").ok().out)
    assert [(each["state"], each["enclaves"]) for each in told["authorities"]] == [
        ("issuing", 3),
        ("next", 0),
    ] * 2
    assert "Cyclone DDS" in sros("rotate_ca", separate, "--to", "reissue").ok().err
    assert "nothing is left to do" in sros("rotate_ca", separate, "--to", "reissue").ok().err
    assert sros("rotate_ca", separate, "--finish").ok().out.startswith("retired the old CA")
    again = sros("rotate_ca", separate, "--to", "retire").ok()
    assert "nothing is left to do: the last rotation is complete" in again.err
    assert sros("rotate_ca", separate, "--same-key").ok().out.startswith("renewed the identity CA")
    assert sros("rotate_ca", separate, "--next", "--finish").status == 2
    assert sros("rotate_ca", separate, "--same-key", "--permissions").status == 2
