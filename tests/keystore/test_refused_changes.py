"""Changes after which vendors would refuse enclaves that they accept: nothing is written.

The CAs are made by OpenSSL, as those of companies.  The vendors' own answers to such keystores are
in `tests.integration`.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import TESTED, Vendor, joined_titles
from sros_tool.errors import KeystoreError
from sros_tool.keystore.issuing.acceptance import refusals, refuse_stopping_nodes
from sros_tool.keystore.layout import CRL, enclave_path, list_enclaves
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.template import load_template
from sros_tool.keystore.transaction import Transaction
from sros_tool.wording import enumerated
from tests.support.children import run
from tests.support.harness import Ended, copy_of, sros

CA, SIGNS = "basicConstraints=critical,CA:TRUE", "keyCertSign,digitalSignature"
PSS = ("-sigopt", "rsa_padding_mode:pss", "-sigopt", "rsa_pss_saltlen:-1")
RSA = ("-newkey", "rsa:2048")
EC = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1")
ALL = tuple(vendor.value for vendor in TESTED)


def now() -> datetime:
    return datetime.now(UTC)


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """CAs and their keys: some without cRLSign, one of them below a root, one signed with PSS."""
    folder = tmp_path_factory.mktemp("pki")

    def make(name: str, *words: str, usage: str = f"{SIGNS},cRLSign") -> None:
        extensions = ("-addext", CA, "-addext", f"keyUsage=critical,{usage}")
        out = ("-keyout", f"{name}.key", "-out", f"{name}.pem", "-subj", f"/O=Corp/CN={name}")
        run(["openssl", "req", "-x509", "-days", "900", "-nodes", *words, *extensions, *out],
            cwd=folder)  # fmt: skip

    make("good", *EC)
    make("good RSA", *RSA)
    policies = ("-addext", "certificatePolicies=critical,1.2.3.4")
    names = ("-addext", "nameConstraints=critical,permitted;DNS:corp.example")
    make("critical extensions", *EC, *policies, *names)
    make("P-384", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:secp384r1")
    make("no lists", *EC, usage=SIGNS)
    make("PSS", *RSA, *PSS)
    make("below", *EC, "-CA", "good.pem", "-CAkey", "good.key", usage=SIGNS)
    chain = (folder / "below.pem").read_bytes() + (folder / "good.pem").read_bytes()
    (folder / "below.pem").write_bytes(chain)
    return folder


def created(pki: Path, name: str, root: Path, role: str = "identity") -> Ended:
    place = (f"--{role}-ca", pki / f"{name}.pem", f"--{role}-key", pki / f"{name}.key")
    return sros("create_keystore", root, "--template", "production", *place)


@pytest.fixture
def corporate(pki: Path, tmp_path: Path) -> Path:
    """A keystore with an identity CA that may not sign revocation lists, and its enclaves."""
    root = tmp_path / "ks"
    created(pki, "no lists", root).ok()
    sros("create_enclave", root, "/a", "/b", "/lost").ok()
    return root


def refused_by(root: Path, name: str) -> set[Vendor]:
    files = {path.name: path.read_bytes() for path in enclave_path(root, name).iterdir()}
    files.pop("key.pem", None)
    return set(refusals(name, files, now()))


def contents(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in root.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("name", ["no lists", "below"])
def test_an_identity_ca_that_may_not_sign_lists_is_said_when_it_is_imported(
    name: str, pki: Path, tmp_path: Path
) -> None:
    said = created(pki, name, tmp_path / "ks").ok().err
    assert "note [portable.revocation-list]" in said
    assert f"CN={name}" in said and "cRLSign" in said and "sros revoke" in said
    assert "cRLSign" not in created(pki, name, tmp_path / "other", "permissions").err


@pytest.mark.parametrize(
    "words",
    [
        ("revoke", "{}", "/lost"),
        ("revoke", "{}", "/lost", "--dry-run"),
        ("crl", "{}", "--refresh"),
        ("renew", "{}", "/a", "--revoke-old"),
        ("update_keystore", "{}", "--set", "permissions.validity=90d", "--revoke-old"),
    ],
)
def test_a_list_that_every_vendor_refuses_is_not_signed(
    words: tuple[str, ...], corporate: Path
) -> None:
    before = contents(corporate)
    ended = sros(*(word.format(corporate) for word in words))
    assert ended.status == 2, ended
    assert "could not start in /a, /b" in ended.err
    titles = enumerated(joined_titles(vendor.title for vendor in TESTED))
    assert f"{titles} refuse their new files" in ended.err
    assert "cRLSign" in ended.err and "Nothing was changed." in ended.err
    remedy = f"sros rotate_ca {corporate} --identity --identity-key URI --finish"
    assert remedy in ended.err
    assert contents(corporate) == before


def test_what_the_refusal_says_to_do_shuts_the_enclave_out(corporate: Path) -> None:
    key = f"file:{corporate.parent / 'new.key'}"
    sros("rotate_ca", corporate, "--identity", "--identity-key", key, "--finish").ok()
    sros("revoke", corporate, "/lost").ok()
    assert [refused_by(corporate, name) for name in list_enclaves(corporate)] == [set(), set()]


def test_during_a_rotation_the_old_ca_has_to_go_first(corporate: Path) -> None:
    key = ("--identity-key", f"file:{corporate.parent / 'new.key'}")
    sros("rotate_ca", corporate, "--identity", *key, "--next").ok()
    ended = sros("revoke", corporate, "/lost")
    assert ended.status == 2 and "cRLSign" in ended.err, ended
    assert f"sros rotate_ca {corporate} --finish" in ended.err
    sros("rotate_ca", corporate, "--finish").ok()
    sros("revoke", corporate, "/lost").ok()
    assert refused_by(corporate, "/a") == set()


def test_a_first_list_shuts_out_nobody_who_has_a_certificate_of_the_old_ca(
    corporate: Path,
) -> None:
    """Fast DDS 2.9.1 was seen to stop matching such a process; with cRLSign it goes on."""
    key = ("--identity-key", f"file:{corporate.parent / 'new.key'}")
    sros("rotate_ca", corporate, "--identity", *key, "--next").ok()
    sros("rotate_ca", corporate, "--next").ok()
    before = contents(corporate)
    ended = sros("revoke", corporate, "/lost")
    assert ended.status == 2 and "cRLSign" in ended.err and "would refuse" in ended.err, ended
    assert f"sros rotate_ca {corporate} --finish" in ended.err
    assert contents(corporate) == before
    sros("revoke", corporate, "/lost", "--allow-refusal", "all-fastdds").ok()
    sros("crl", corporate, "--refresh").ok()


def test_the_user_may_name_the_vendors_on_which_nodes_stop(corporate: Path) -> None:
    allowed = [word for vendor in ALL for word in ("--allow-refusal", vendor)]
    ended = sros("revoke", corporate, "/lost", *allowed[:-2])
    assert "nodes on Cyclone DDS 11.0 could not start in /a, /b" in ended.err and ended.status == 2
    assert "add --allow-refusal cyclonedds-11." in ended.err
    products = "--allow-refusal all-fastdds --allow-refusal all-cyclonedds."
    assert f"add {products}" in sros("revoke", corporate, "/lost").err
    assert (
        "Cyclone DDS 11.0 refuses their new files" in ended.err and "Fast DDS 2.14" not in ended.err
    )
    said = sros("revoke", corporate, "/lost", *allowed).ok().err
    assert "Cyclone DDS 11.0 refuses /a, /b from now on" in said
    assert refused_by(corporate, "/a") == set(TESTED)
    # Nothing that runs today stops any more, so the list can be signed again.
    sros("crl", corporate, "--refresh").ok()


@pytest.mark.parametrize("name", ["good", "good RSA", "critical extensions"])
def test_a_good_ca_is_taken_and_revokes(name: str, pki: Path, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    notes = re.findall(r"note \[(.*?)\]", created(pki, name, root).ok().err)
    assert notes == ["keystore.own-list"], "nothing is said against the CA"
    sros("create_enclave", root, "/a", "/lost").ok()
    sros("revoke", root, "/lost").ok()
    assert refused_by(root, "/a") == set()


def test_a_permissions_ca_may_have_a_larger_key(pki: Path, tmp_path: Path) -> None:
    """Cyclone DDS asks for small keys of identities and their CA alone."""
    root = tmp_path / "ks"
    assert "note [" not in created(pki, "P-384", root, "permissions").ok().err
    sros("create_enclave", root, "/a").ok()
    assert refused_by(root, "/a") == set()
    assert "key-algorithm" not in sros("check", root).out
    assert "Cyclone" in created(pki, "P-384", tmp_path / "other").ok().err


@pytest.mark.parametrize("role", ["identity", "permissions"])
def test_a_ca_signed_with_pss_is_said_for_the_vendors_that_refuse_it(
    role: str, pki: Path, tmp_path: Path
) -> None:
    said = created(pki, "PSS", tmp_path / "ks", role).ok().err
    assert "Fast DDS refuses" in said and "PSS" in said
    assert "Cyclone DDS accepts" in said


# ── the evaluation itself ──────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sound") / "ks"
    create_keystore(root, template=load_template("production"), now=now())
    create_enclaves(root, ["/a", "/b", "/b/c"], now=now())
    return root


def _break_list(transaction: Transaction, other: Path) -> None:
    revoke(other, ["/b"], now=now())
    transaction.write(CRL, (other / CRL).read_bytes())
    for name in ("a", "b", "b/c"):
        up = "../" * (name.count("/") + 2)
        transaction.link(f"enclaves/{name}/crl.pem", f"{up}{CRL}")


def _break_permissions(transaction: Transaction, other: Path) -> None:
    signed = (enclave_path(other, "/a") / "permissions.p7s").read_bytes()
    transaction.write("enclaves/a/permissions.p7s", signed)


def _break_governance(transaction: Transaction, other: Path) -> None:
    signed = (other / "enclaves/governance.p7s").read_bytes()
    transaction.write("enclaves/governance.p7s", signed)


def _touch(transaction: Transaction, _other: Path) -> None:
    for file in ("enclaves/a/permissions.p7s", "enclaves/governance.p7s"):
        transaction.write(file, transaction.read(file))
    transaction.remove("enclaves/b/cert.pem")


def _to_token(transaction: Transaction, _other: Path) -> None:
    """What only Fast DDS can use, as whoever asks for it is told."""
    transaction.write("enclaves/a/key.p11", b"pkcs11:token=t;object=o\n")
    transaction.remove("enclaves/a/key.pem")


@pytest.mark.parametrize("dry_run", [False, True])
@pytest.mark.parametrize(
    ("stage", "stopped"),
    [
        (_break_list, "/a, /b, /b/c"),
        (_break_permissions, "/a"),
        (_break_governance, "/a, /b, /b/c"),
        (_touch, ""),
        (_to_token, ""),
    ],
)
def test_what_is_staged_is_evaluated(
    stage: Callable[[Transaction, Path], None],
    stopped: str,
    dry_run: bool,
    sound: Path,
    tmp_path: Path,
) -> None:
    root, other = tmp_path / "ks", tmp_path / "other"
    copy_of(sound, root)
    create_keystore(other, template=load_template("production"), now=now())
    create_enclaves(other, ["/a", "/b"], now=now())
    with Transaction(root, dry_run=dry_run) as transaction:
        stage(transaction, other)
        if not stopped:
            assert refuse_stopping_nodes(transaction, now()) == ()
            return
        with pytest.raises(KeystoreError) as refusal:
            refuse_stopping_nodes(transaction, now())
        assert f"start in {stopped} of" in refusal.value.what
        (note, *_) = refuse_stopping_nodes(transaction, now(), allowed=TESTED)
        assert note.text.startswith(f"{TESTED[0].title} refuses {stopped} from now on")


def test_an_enclave_that_was_broken_before_hides_no_other_one(sound: Path, tmp_path: Path) -> None:
    """Enclaves of the same kind are evaluated by one of them: by one that starts today."""
    root, other = tmp_path / "ks", tmp_path / "other"
    copy_of(sound, root)
    create_keystore(other, template=load_template("production"), now=now())
    shutil.copy(enclave_path(root, "/b") / "permissions.p7s", enclave_path(root, "/a"))
    with Transaction(root) as transaction:
        _break_governance(transaction, other)
        with pytest.raises(KeystoreError, match="start in /a, /b, /b/c of"):
            refuse_stopping_nodes(transaction, now())


def test_a_revoked_enclave_that_is_put_back_keeps_nobody_from_signing_a_list(
    sound: Path, tmp_path: Path
) -> None:
    """Twin: enclaves that were not revoked stop a change that lets vendors refuse them."""
    root, kept = tmp_path / "ks", tmp_path / "kept"
    copy_of(sound, root)
    copy_of(enclave_path(root, "/a"), kept)
    sros("revoke", root, "/a").ok()
    copy_of(kept, enclave_path(root, "/a"))
    for file in root.glob("enclaves/**/crl.pem"):
        file.unlink()
    create_keystore(other := tmp_path / "other", template=load_template("production"), now=now())
    create_enclaves(other, ["/b"], now=now())
    with Transaction(root, dry_run=True) as transaction:
        _break_list(transaction, other)
        with pytest.raises(KeystoreError, match=r"start in /b, /b/c of"):
            refuse_stopping_nodes(transaction, now())
    ended = sros("crl", root, "--refresh").ok()
    assert (
        "note [keystore.revoked-put-back]: revoked certificates of /a are in the keystore"
        in ended.err
    )
    assert (enclave_path(root, "/b") / "crl.pem").read_bytes() == (root / CRL).read_bytes()


def test_a_list_that_comes_back_from_a_robot_is_signed_again(sound: Path, tmp_path: Path) -> None:
    """A keystore from a backup knows of a revocation only by the list that a robot still has."""
    root, backup = tmp_path / "ks", tmp_path / "backup"
    copy_of(sound, backup)
    copy_of(sound, root)
    sros("revoke", root, "/a").ok()
    shutil.copy(root / "enclaves/b/crl.pem", backup / CRL)
    ended = sros("crl", backup, "--refresh").ok()
    assert (
        "note [keystore.revoked-put-back]: revoked certificates of /a are in the keystore"
        in ended.err
    )
    sros("revoke", backup, "/a").ok()
    (revoked,) = json.loads(sros("crl", backup, "--json").ok().out)["revoked"]
    assert revoked["enclave"] == "/a"


def test_a_dry_run_says_what_it_did_not_keep(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twin: without the limit, what it would do is refused."""
    root, other = tmp_path / "ks", tmp_path / "other"
    copy_of(sound, root)
    create_keystore(other, template=load_template("production"), now=now())
    with Transaction(root, dry_run=True) as transaction:
        _break_governance(transaction, other)
        with pytest.raises(KeystoreError):
            refuse_stopping_nodes(transaction, now())
    monkeypatch.setattr("sros_tool.keystore.transaction._MOST_KEPT", 100)
    with Transaction(root, dry_run=True) as transaction:
        _break_governance(transaction, other)
        (note,) = refuse_stopping_nodes(transaction, now())
        assert note.text.startswith("sros did not check enclaves/governance.p7s against the ")
