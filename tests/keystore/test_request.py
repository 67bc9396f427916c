"""Keys created on the robot: requests, answers, and what each side refuses."""

from __future__ import annotations

import gzip
import io
import os
import re
import stat
import tarfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from cryptography.x509.oid import NameOID

from sros_tool.checks.keystores.arrival import verify_arrival
from sros_tool.errors import DocumentError, KeystoreError, PkiError, PolicyError, SrosError
from sros_tool.keystore.delivery.archive import (
    MAX_MEMBER,
    MAX_UNPACKED,
    ArchiveLimits,
    pack,
    unpack,
)
from sros_tool.keystore.delivery.robot import create_requests, import_answer
from sros_tool.keystore.delivery.signing import SignedRequests, certify_requests, sign_request
from sros_tool.keystore.describe import history
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import SEAL, list_enclaves
from sros_tool.keystore.ledger import REPORTED, certificate_entry
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, create_permission
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revocation_list import LostRecords
from sros_tool.keystore.lifecycle.revoke import refresh_crl, restore_revocations, revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import (
    common_name,
    key_digest,
    load_request,
    make_request,
    validity_of,
)
from sros_tool.pki.keys import generate_key, key_pem, load_key
from sros_tool.policy.document import read_policy
from tests.support.children import run
from tests.support.harness import (
    certificate,
    copy_of,
    create_request,
    policy_text,
    publish,
    remains,
    snapshot,
    sros,
    topics_of,
)
from tests.support.long_form import some

NOW = datetime.now(UTC)
LATER = NOW + timedelta(days=30)
NAME, FOLDER = "/arm/camera", "enclaves/arm/camera"
SENT = {"cert.pem", "identity_ca.cert.pem", "permissions_ca.cert.pem"} | {
    "governance.p7s",
    "permissions.p7s",
}
INSTALLED = SENT | {SEAL}


@pytest.fixture(scope="session")
def made_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("home") / "ks"
    create_keystore(root, template=load_template("production"), now=NOW)
    create_enclaves(root, ["/base"], now=NOW)
    return root


@pytest.fixture
def home(made_home: Path, tmp_path: Path) -> Path:
    return copy_of(made_home, tmp_path / "ks")


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    create_request(tmp_path / "robot", NAME)
    return tmp_path / "robot"


def request_of(robot: Path) -> bytes:
    return (robot / FOLDER / "request.pem").read_bytes()


def sign(home: Path, robot: Path, now: datetime = NOW, *, renew: bool = False) -> SignedRequests:
    return sign_request(home, request_of(robot), now=now, renew=renew)


# ── on the robot: the request ──────────────────────────────────────────────────────────────


def test_the_key_of_a_request_stays_on_the_robot(robot: Path, free_umask: None) -> None:
    files = snapshot(robot)
    assert set(files) == {
        "enclaves",
        "enclaves/arm",
        *(f"{FOLDER}{file}" for file in ("", "/key.pem", "/request.pem")),
    }
    assert stat.S_IMODE(files[f"{FOLDER}/key.pem"][0]) == 0o600
    assert stat.S_IMODE(files[FOLDER][0]) == 0o700
    request = x509.load_pem_x509_csr(request_of(robot))
    assert request.is_signature_valid
    assert request.subject == common_name(NAME)
    assert isinstance(request.signature_hash_algorithm, hashes.SHA256)
    key = request.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    assert key.curve.name == "secp256r1"


def test_openssl_reads_a_request_and_agrees_about_the_key(robot: Path, tmp_path: Path) -> None:
    made = create_request(tmp_path / "other", "/x")
    run(["openssl", "req", "-in", made.file, "-verify", "-noout"])
    script = "openssl req -in $0 -pubkey -noout | openssl pkey -pubin -outform DER | sha256sum"
    said = run(["sh", "-c", script, made.file])
    assert said.stdout.split()[0] == made.key


def test_no_key_is_replaced(robot: Path) -> None:
    before = snapshot(robot)
    for names in ([NAME], ["/other", NAME]):
        with pytest.raises(KeystoreError, match=f"{NAME} already has a key in"):
            create_requests(robot, names)
    assert snapshot(robot) == before
    create_request(robot, "/other")
    create_request(robot, NAME, again=True)
    after = snapshot(robot)
    assert after[f"{FOLDER}/key.pem"] == before[f"{FOLDER}/key.pem"]
    assert after[f"{FOLDER}/request.pem"] != before[f"{FOLDER}/request.pem"]
    with pytest.raises(SrosError, match="does not exist"):
        create_request(robot, "/third", again=True)


def test_a_dry_run_creates_nothing(tmp_path: Path) -> None:
    made = create_requests(tmp_path / "robot", [NAME], dry_run=True)
    assert [change.path for change in made.changes] == [
        f"{FOLDER}/key.pem",
        f"{FOLDER}/request.pem",
    ]
    assert not (tmp_path / "robot").exists()


def _certificate_alone(robot: Path) -> None:
    (robot / FOLDER).mkdir(parents=True)
    (robot / FOLDER / "cert.pem").touch()


def _link_for_a_folder(robot: Path) -> None:
    robot.mkdir()
    robot.with_name("elsewhere").mkdir()
    (robot / "enclaves").symlink_to("../elsewhere")


BAD_PLACES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a keystore with CAs": (lambda robot: (robot / "private").mkdir(parents=True), "with CAs"),
    "a file": (Path.touch, "the operating system"),
    "a link for a folder": (_link_for_a_folder, "symbolic link"),
    "a certificate without its key": (_certificate_alone, "no key"),
}


@pytest.mark.parametrize("case", BAD_PLACES)
def test_folders_where_no_request_can_be_made(case: str, tmp_path: Path) -> None:
    make, why = BAD_PLACES[case]
    make(tmp_path / "robot")
    before = snapshot(tmp_path)
    with pytest.raises((SrosError, OSError)) as caught:
        create_request(tmp_path / "robot", NAME)
    assert why in str(caught.value) or isinstance(caught.value, OSError)
    assert snapshot(tmp_path) == before


# ── at the keystore: signing ───────────────────────────────────────────────────────────────


def test_signing_records_everything_but_the_key(home: Path, robot: Path) -> None:
    signed = sign(home, robot)
    assert NAME in list_enclaves(home)
    folder = home / FOLDER
    assert {path.name for path in folder.iterdir()} == SENT | {"permissions.xml", "request.pem"}
    assert os.readlink(folder / "identity_ca.cert.pem") == ("../../../public/identity_ca.cert.pem")
    assert os.readlink(folder / "governance.p7s") == "../../governance.p7s"
    assert all(path.exists() for path in folder.iterdir())
    issued = certificate(folder / "cert.pem")
    issued.verify_directly_issued_by(certificate(home / "public/identity_ca.cert.pem"))
    subject = issued.subject
    assert len(subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)) == 1
    assert key_digest(issued.public_key()) == signed.keys[NAME]  # type: ignore[arg-type]
    entries = [entry for entry in OpenedKeystore(home).ledger.entries if entry.enclave == NAME]
    assert [entry.what for entry in entries] == ["certificate", "permissions", "answer"]
    assert not history(OpenedKeystore(home), now=NOW).unexplained
    with tarfile.open(fileobj=io.BytesIO(signed.archive)) as tar:
        names = {member.name for member in tar if member.isfile()}
        assert names == {SEAL, *(f"{FOLDER}/{file}" for file in SENT)}
        assert {(each.uid, each.uname, each.mtime) for each in tar} == {(0, "", 0)}
    assert pack(unpack(signed.archive)) == signed.archive
    assert b"PRIVATE" not in b"".join(unpack(signed.archive).values())


def test_the_rights_are_those_of_the_policy_and_a_renewal_keeps_them(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    (tmp_path / "p.xml").write_text(policy_text({NAME: publish("image")}))
    policy = read_policy(tmp_path / "p.xml")
    other = create_request(robot, "/arm/other").file.read_bytes()
    sign_request(home, other, now=NOW)
    assert topics_of(home / "enclaves/arm/other") == topics_of(home / "enclaves/base")
    sign_request(home, request_of(robot), now=NOW, policy=policy)
    assert topics_of(home / FOLDER) == {"rt/image", "ros_discovery_info"}
    first = certificate(home / FOLDER / "cert.pem")
    sign(home, robot, LATER, renew=True)
    assert topics_of(home / FOLDER) == {"rt/image", "ros_discovery_info"}
    second = certificate(home / FOLDER / "cert.pem")
    assert validity_of(second).not_after - validity_of(first).not_after == timedelta(days=30)
    assert second.public_key() == first.public_key()
    entries = [
        entry for entry in OpenedKeystore(home).ledger.entries if entry.what == "permissions"
    ]
    assert entries[-1].policy == entries[-2].policy != ""


def test_without_a_policy_the_rights_are_the_default_of_the_template(
    home: Path, robot: Path
) -> None:
    sign(home, robot)
    assert "rt/*" not in topics_of(home / FOLDER)
    assert "rt/rosout" in topics_of(home / FOLDER)


def test_a_request_for_an_existing_enclave_is_refused(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    sign(home, robot)
    thief = create_request(tmp_path / "thief", NAME)
    before = snapshot(home)
    steps = f"already exists.*`sros revoke .* {NAME}`.* --enclave.* -p POLICY_FILE.*--fleet"
    with pytest.raises(KeystoreError, match=steps):
        sign_request(home, thief.file.read_bytes(), now=NOW)
    with pytest.raises(KeystoreError, match=r"already exists.*add --renew\."):
        sign_request(home, request_of(robot), now=NOW)
    base = create_request(tmp_path / "thief", "/base")
    with pytest.raises(
        KeystoreError, match=r"has another key.* -p POLICY_FILE.* Leave --renew out"
    ):
        sign_request(home, base.file.read_bytes(), now=NOW, renew=True)
    assert snapshot(home) == before
    (note,) = sign_request(home, thief.file.read_bytes(), now=NOW, renew=True).notes
    assert note.id == "request.new-key"
    assert f"`sros renew {home} {NAME} --revoke-old`" in note.text
    with pytest.raises(KeystoreError, match=f"{NAME} --revoke-old`"):
        renew(home, [NAME], now=LATER, new_key=True, revoke_old=True)
    ended = validity_of(certificate(home / FOLDER / "cert.pem")).not_after
    with pytest.raises(KeystoreError, match=f"is for an earlier key.*add --enclave {NAME}"):
        sign_request(home, request_of(robot), now=ended, renew=True)
    (note,) = sign_request(
        home, request_of(robot), now=ended, renew=True, only_enclaves=[NAME]
    ).notes
    assert note.text == f"{NAME}: requested a new key. The certificate of the old key has expired."


def test_other_commands_handle_an_enclave_whose_key_is_on_its_robot(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    sign(home, robot)
    (tmp_path / "p.xml").write_text(policy_text({NAME: publish("new"), "/base": publish("new")}))
    create_permission(home, [NAME], read_policy(tmp_path / "p.xml"), now=NOW)
    assert topics_of(home / FOLDER) == {"rt/new", "ros_discovery_info"}
    assert create_enclaves(home, [NAME], now=NOW).kept == (NAME,)
    before = certificate(home / FOLDER / "cert.pem")
    with pytest.raises(KeystoreError, match="not in this keystore"):
        renew(home, [NAME], now=LATER, new_key=True)
    renew(home, [NAME], now=LATER)
    assert certificate(home / FOLDER / "cert.pem").public_key() == before.public_key()
    import_answer(robot, sign(home, robot, LATER, renew=True).archive, now=LATER)
    assert topics_of(robot / FOLDER) == {"rt/new", "ros_discovery_info"}
    assert not (home / FOLDER / "key.pem").exists()


def test_a_revoked_key_is_not_certified_again(home: Path, robot: Path) -> None:
    sign(home, robot)
    revoke(home, [NAME], now=NOW)
    assert not (home / FOLDER).exists()
    assert list_enclaves(home) == ("/base",)
    with pytest.raises(KeystoreError, match=r"the key of the request for .* was revoked"):
        sign(home, robot)


def test_a_revoked_enclave_comes_back_only_if_it_is_named(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    """Who stole the robot can make another key, and choose what the request says."""
    sign(home, robot)
    revoke(home, [NAME], now=NOW)
    create_request(tmp_path / "second", NAME)
    request = request_of(tmp_path / "second")
    before = snapshot(home)
    for attempt in (sign_request, certify_requests):
        with pytest.raises(KeystoreError, match=f"enclave {NAME} was revoked") as caught:
            attempt(home, request, now=NOW)
        assert f"--enclave {NAME}" in str(caught.value)
    with pytest.raises(KeystoreError, match="not for /base"):
        sign_request(home, request, now=NOW, only_enclaves=["/base"])
    assert snapshot(home) == before
    both = request + make_request(generate_key(), "/base")
    for revoked, asked in (
        ((), f"give only its request, and add --enclave {NAME}."),
        (["/base"], f"add --enclave {NAME} --enclave /base."),
    ):
        if revoked:
            revoke(home, revoked, now=NOW)
        with pytest.raises(KeystoreError, match=asked):
            certify_requests(home, both, now=NOW)
    signed = sign_request(home, request, now=NOW, only_enclaves=[NAME])
    assert "keystore.revoked-before" in {each.id for each in signed.notes}


def test_a_policy_asks_for_a_request_where_the_revoked_key_was_made_on_a_robot(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    sign(home, robot)
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({NAME: publish("a"), "/base": publish("b")}))
    for revoked, ways in (
        ([NAME], ["sign_request"]),
        (["/base"], ["generate_artifacts", "sign_request"]),
    ):
        revoke(home, revoked, now=NOW)
        refused = sros("generate_artifacts", "-k", home, "-p", policy)
        assert refused.status == 2, refused
        commands = re.findall("`sros ((?:gen|sign).+?)`", refused.err)
        assert [command.split()[0] for command in commands] == ways
    values = {"POLICY_FILE": policy, "-": create_request(tmp_path / "second", NAME).file}
    for command in commands[::-1]:
        sros(*(values.get(word, word) for word in command.split())).ok()
    assert not (home / FOLDER / "key.pem").exists()


def test_rights_that_an_enclave_had_are_not_lost_in_silence(home: Path, tmp_path: Path) -> None:
    """The refusal of another key says to revoke the enclave, and to repeat the command."""
    (tmp_path / "p.xml").write_text(policy_text({"/base": publish("a")}))
    policy = read_policy(tmp_path / "p.xml")
    request = create_request(tmp_path / "new", "/base").file.read_bytes()
    default, stated = home, copy_of(home, tmp_path / "stated")
    create_permission(stated, ["/base"], policy, now=NOW)
    for root, given, lost in (
        (default, None, False),
        (copy_of(stated, tmp_path / "again"), policy, False),
        (stated, None, True),
    ):
        revoke(root, ["/base"], now=NOW)
        done = sign_request(root, request, policy=given, only_enclaves=["/base"], now=NOW)
        assert ("request.default-rights" in {note.id for note in done.notes}) == lost


def test_a_restored_keystore_revokes_only_the_earlier_key_of_new_hardware(
    home: Path, tmp_path: Path
) -> None:
    """A message of the robot showed the certificate that was issued after the backup."""
    backup = copy_of(home, tmp_path / "backup")
    earlier = OpenedKeystore(home).certificate_of("/base")
    revoke(home, ["/base"], now=NOW)
    request = create_request(tmp_path / "new", "/base").file.read_bytes()
    sign_request(home, request, now=NOW, only_enclaves=["/base"])
    later = OpenedKeystore(home).certificate_of("/base")
    with pytest.raises(KeystoreError, match="has another key"):
        sign_request(backup, request, now=NOW, renew=True)
    forgotten = LostRecords(OpenedKeystore(backup), NOW)
    assert forgotten.add_certificate(later, REPORTED)
    restore_revocations(backup, forgotten, now=NOW)

    done = revoke(copy_of(backup, tmp_path / "revoked"), ["/base"], now=NOW)
    assert "revoke.later-keys" in {note.id for note in done.notes}
    with pytest.raises(KeystoreError, match="add --renew"):
        sign_request(backup, request, now=NOW)
    sign_request(backup, request, now=NOW, renew=True)
    assert not (backup / "enclaves/base/key.pem").exists()
    renew(backup, ["/base"], now=LATER, revoke_old=True)
    known = KnownKeys(OpenedKeystore(backup))
    keys = [certificate_entry(NOW, "certificate", each).key for each in (earlier, later)]
    assert [known.is_revoked(key) for key in keys] == [True, False]


def test_a_restored_keystore_keeps_the_key_of_new_hardware_that_it_certified_again_first(
    home: Path, tmp_path: Path
) -> None:
    """Changes from after the backup are repeated before the publishing folder shows them."""
    backup = copy_of(home, tmp_path / "backup")
    request = create_request(tmp_path / "new", "/base").file.read_bytes()
    options: dict[str, Any] = {"renew": True, "replace_keys": True, "only_enclaves": ["/base"]}
    certify_requests(home, request, now=NOW, **options)
    renew(home, ["/base"], now=NOW, revoke_old=True)
    later, crl = OpenedKeystore(home).certificate_of("/base"), home / "public/identity_ca.crl.pem"
    certify_requests(backup, request, now=LATER, **options)
    forgotten = LostRecords(OpenedKeystore(backup), LATER)
    assert forgotten.add(crl.read_bytes()) and forgotten.add_certificate(later, REPORTED)
    restore_revocations(backup, forgotten, now=LATER)
    key = certificate_entry(NOW, "certificate", later).key
    assert not KnownKeys(OpenedKeystore(backup)).is_revoked(key)


def other_subject(
    key: ec.EllipticCurvePrivateKey, *parts: tuple[x509.ObjectIdentifier, str]
) -> bytes:
    name = x509.Name([x509.NameAttribute(oid, text) for oid, text in parts])
    builder = x509.CertificateSigningRequestBuilder().subject_name(name)
    return builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM)


def request_with(key: ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey, name: str = NAME) -> bytes:
    return make_request(key, name)


def ed25519_request() -> bytes:
    builder = x509.CertificateSigningRequestBuilder().subject_name(common_name(NAME))
    return builder.sign(ed25519.Ed25519PrivateKey.generate(), None).public_bytes(Encoding.PEM)


def with_another_key() -> bytes:
    """Return a request with the public key of another party, so that its signature fails."""
    mine, theirs = generate_key(), generate_key()
    request = x509.load_pem_x509_csr(make_request(mine, NAME)).public_bytes(Encoding.DER)
    form = (Encoding.X962, PublicFormat.UncompressedPoint)
    old, new = (key.public_key().public_bytes(*form) for key in (mine, theirs))
    forged = x509.load_der_x509_csr(request.replace(old, new))
    return forged.public_bytes(Encoding.PEM)


_CN, _OU = NameOID.COMMON_NAME, NameOID.ORGANIZATIONAL_UNIT_NAME

BAD_REQUESTS: dict[str, tuple[Callable[[], bytes], str]] = {
    "nothing": (lambda: b"", "cannot be read"),
    "garbage": (lambda: os.urandom(500), "cannot be read"),
    "too much": (lambda: make_request(generate_key(), NAME) + b"x" * 70000, "cannot be read"),
    "a key that was not signed with": (with_another_key, "is not valid"),
    "P-384": (
        lambda: request_with(ec.generate_private_key(ec.SECP384R1())),
        "key of EC secp384r1",
    ),
    "RSA 1024": (
        lambda: request_with(rsa.generate_private_key(65537, 1024)),
        "key of RSA 1024",
    ),
    "Ed25519": (ed25519_request, "key of Ed25519"),
    "a relative name": (lambda: request_with(generate_key(), "camera"), "not a valid enclave"),
    "dots": (lambda: request_with(generate_key(), "/../x"), "not a valid enclave"),
    "a wildcard": (lambda: request_with(generate_key(), "/*"), "not a valid enclave"),
    "two requests": (
        lambda: request_with(generate_key()) + request_with(generate_key(), "/base"),
        "several requests",
    ),
    "its private key": (
        lambda: request_with(key := generate_key()) + key_pem(key),
        "has a private key next to it",
    ),
    "no name": (lambda: other_subject(generate_key()), "an empty subject"),
    "more than a name": (
        lambda: other_subject(generate_key(), (_OU, "0123"), (_CN, NAME)),
        "is for CN=/arm/camera,OU=0123",
    ),
    "two names": (
        lambda: other_subject(generate_key(), (_CN, "/base"), (_CN, NAME)),
        "is for CN",
    ),
}


@pytest.mark.parametrize("case", BAD_REQUESTS)
def test_requests_that_are_refused(case: str, home: Path) -> None:
    make, why = BAD_REQUESTS[case]
    before = snapshot(home)
    with pytest.raises(SrosError) as caught:
        sign_request(home, make(), now=NOW)
    assert why in str(caught.value)
    assert snapshot(home) == before


def test_a_request_of_openssl_with_rsa_works(home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "robot" / FOLDER
    folder.mkdir(parents=True)
    command = ["openssl", "req", "-new", "-newkey", "rsa:2048", "-noenc"]
    command += ["-subj", r"/CN=\/arm\/camera"]
    command += ["-keyout", str(folder / "key.pem"), "-out", str(folder / "request.pem")]
    run(command)
    import_answer(tmp_path / "robot", sign(home, tmp_path / "robot").archive, now=NOW)
    assert verify_arrival(tmp_path / "robot", now=NOW).enclaves[0].loadable


def test_a_key_for_pss_alone_gets_no_certificate(home: Path, tmp_path: Path) -> None:
    """No DDS loads such a key next to a certificate, which states an RSA key of any use."""
    folder = tmp_path / "robot" / FOLDER
    folder.mkdir(parents=True)
    key, request = folder / "key.pem", folder / "request.pem"
    run(["openssl", "genpkey", "-algorithm", "RSA-PSS", "-out", str(key)])
    subject = ["-subj", r"/CN=\/arm\/camera"]
    run(["openssl", "req", "-new", "-key", str(key), *subject, "-out", str(request)])
    with pytest.raises(PkiError, match="for RSA-PSS alone"):
        sign_request(home, request.read_bytes(), now=NOW)
    with pytest.raises(PkiError, match="for RSA-PSS alone"):
        create_request(tmp_path / "robot", NAME, again=True)
    request.write_bytes(make_request(load_key(key.read_bytes(), "drawn"), NAME))
    archive = sign(home, tmp_path / "robot").archive
    with pytest.raises(PkiError, match="for RSA-PSS alone"):
        import_answer(tmp_path / "robot", archive, now=NOW)


def test_a_policy_without_the_enclave_is_refused(home: Path, robot: Path, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text({"/x": publish("y")}))
    with pytest.raises(PolicyError, match="unable to find enclave /arm/camera"):
        sign_request(home, request_of(robot), now=NOW, policy=read_policy(tmp_path / "p.xml"))
    names = (*(f"/x{number}" for number in range(9)), "/arm/cameras")
    (tmp_path / "p.xml").write_text(policy_text(dict.fromkeys(names, publish("y"))))
    with pytest.raises(PolicyError, match=r"The policy has 10 enclaves, such as /arm/cameras\.$"):
        sign_request(home, request_of(robot), now=NOW, policy=read_policy(tmp_path / "p.xml"))


def test_the_answer_appears_with_the_keystore_or_not_at_all(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    before = snapshot(tmp_path)
    for answer in (tmp_path / "no/a.tar.gz", tmp_path / "ks"):
        with pytest.raises((SrosError, OSError)):
            sign_request(home, request_of(robot), now=NOW, answer=answer)
        assert snapshot(tmp_path) == before
    target = tmp_path / "a.tar.gz"
    signed = sign_request(home, request_of(robot), now=NOW, answer=target)
    assert target.read_bytes() == signed.archive
    assert not [path for path in snapshot(tmp_path) if ".a.tar.gz" in path]
    before = snapshot(tmp_path)
    with pytest.raises(KeystoreError, match="already exists"):
        sign_request(home, request_of(robot), now=NOW, renew=True, answer=target)
    assert snapshot(tmp_path) == before
    sign_request(home, request_of(robot), now=NOW, renew=True, answer=target, force=True)


def test_an_answer_that_the_robot_would_reject_is_not_written(home: Path, robot: Path) -> None:
    revoke(home, ["/base"], now=NOW)
    sign_request(home, request_of(robot), now=NOW, dry_run=True)
    refresh_crl(home, now=NOW + timedelta(days=365))
    before = snapshot(home)
    crl = (home / "public/identity_ca.crl.pem").read_bytes()
    with pytest.raises(KeystoreError, match=r"the robot would reject.*crl\.pem"):
        sign_request(home, request_of(robot), now=NOW)
    (home / "public/identity_ca.crl.pem").write_bytes(crl[:200])
    with pytest.raises(PkiError, match=r"revocation list .* cannot be read"):
        sign_request(home, request_of(robot), now=NOW)
    (home / "public/identity_ca.crl.pem").write_bytes(crl)
    assert snapshot(home) == before


# ── on the robot: the answer ───────────────────────────────────────────────────────────────


def test_an_answer_completes_the_enclave(home: Path, robot: Path, free_umask: None) -> None:
    key = (robot / FOLDER / "key.pem").read_bytes()
    signed = sign(home, robot)
    before = snapshot(robot)
    planned = import_answer(robot, signed.archive, now=NOW, dry_run=True)
    assert {each.path for each in planned.changes} == {f"{FOLDER}/{file}" for file in INSTALLED}
    assert snapshot(robot) == before
    done = import_answer(robot, signed.archive, now=NOW)
    assert done.changes == planned.changes
    assert done.first
    assert (robot / FOLDER / "key.pem").read_bytes() == key
    present = {path.name for path in (robot / FOLDER).iterdir()}
    assert present == INSTALLED | {"key.pem", "request.pem"}
    arrival = verify_arrival(robot, now=NOW)
    assert not arrival.findings
    assert arrival.enclaves[0].valid_until == done.until
    assert not import_answer(robot, signed.archive, now=NOW).changes
    assert not remains(robot)


def test_the_root_enclave_can_be_requested(home: Path, tmp_path: Path) -> None:
    made = create_request(tmp_path / "robot", "/")
    answer = sign_request(home, made.file.read_bytes(), now=NOW).archive
    import_answer(tmp_path / "robot", answer, now=NOW)
    assert not verify_arrival(tmp_path / "robot", now=NOW).findings
    assert not verify_arrival(tmp_path / "robot/enclaves", now=NOW).findings


def test_an_answer_carries_the_revocation_list(home: Path, robot: Path) -> None:
    first = sign(home, robot).archive
    import_answer(robot, first, now=NOW)
    revoke(home, ["/base"], now=LATER)
    import_answer(robot, sign(home, robot, LATER, renew=True).archive, now=LATER)
    listed = x509.load_pem_x509_crl((robot / FOLDER / "crl.pem").read_bytes())
    assert len(listed) == 1
    assert not verify_arrival(robot, now=LATER).findings


def test_an_older_answer_needs_force(home: Path, robot: Path) -> None:
    old = sign(home, robot).archive
    refresh_crl(home, now=LATER)
    import_answer(robot, sign(home, robot, LATER, renew=True).archive, now=LATER)
    before = snapshot(robot)
    with pytest.raises(KeystoreError, match="older than the installed one"):
        import_answer(robot, old, now=LATER)
    assert snapshot(robot) == before
    import_answer(robot, old, now=LATER, force=True)
    assert not (robot / FOLDER / "crl.pem").exists()


def test_an_answer_with_a_replaced_ca_needs_force(home: Path, robot: Path, tmp_path: Path) -> None:
    """Also if the numbers of a restored keystore went on, and the other CA is the same."""
    import_answer(robot, sign(home, robot).archive, now=NOW)
    backup = copy_of(home, tmp_path / "backup")
    rotate_ca(home, roles=("identity",), now=LATER, finish=True)
    import_answer(robot, sign(home, robot, LATER, renew=True).archive, now=LATER)
    for _ in range(9):
        refresh_crl(backup, now=LATER)
    before, old = snapshot(robot), sign(backup, robot, LATER, renew=True).archive
    with pytest.raises(KeystoreError, match="goes back to an earlier identity CA"):
        import_answer(robot, old, now=LATER)
    assert snapshot(robot) == before
    import_answer(robot, old, now=LATER, force=True)


def test_an_older_ca_of_a_rotation_is_not_said_to_come_from_a_backup(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    """A robot cannot tell an existing CA, to which the keystore rotates, from a replaced one."""
    import_answer(robot, sign(home, robot).archive, now=NOW)
    other = tmp_path / "other"
    create_keystore(other, template=load_template("production"), now=NOW - timedelta(days=9))
    existing = {"identity": (other / "public/identity_ca.cert.pem").read_bytes()}
    key = Keyring(places={"identity": f"file:{other}/private/identity_ca.key.pem"})
    rotate_ca(home, roles=("identity",), now=LATER, existing=existing, new_keys=key)
    answer = sign(home, robot, LATER, renew=True).archive
    with pytest.raises(KeystoreError, match=r"may come from a backup.*If this CA is right"):
        import_answer(robot, answer, now=LATER)
    import_answer(robot, answer, now=LATER, force=True)


def test_an_answer_with_another_list_of_the_same_number_needs_force(
    home: Path, robot: Path, tmp_path: Path
) -> None:
    create_enclaves(home, ["/stolen"], now=NOW)
    backup = copy_of(home, tmp_path / "backup")
    revoke(home, ["/stolen"], now=NOW)
    import_answer(robot, sign(home, robot).archive, now=NOW)
    refresh_crl(backup, now=NOW)
    renew(backup, ["/stolen"], now=NOW)
    before, other = snapshot(robot), sign(backup, robot, LATER).archive
    with pytest.raises(KeystoreError, match="has an older revocation list"):
        import_answer(robot, other, now=LATER)
    assert snapshot(robot) == before
    refresh_crl(backup, now=LATER)
    later = sign(backup, robot, LATER, renew=True).archive
    (note,) = import_answer(robot, later, now=LATER).notes
    assert (note.id, "revokes 1 certificate that the new list lacks" in note.text) == (
        "import.list-lacks",
        True,
    )


def test_an_answer_of_another_keystore_needs_force(home: Path, robot: Path, tmp_path: Path) -> None:
    import_answer(robot, sign(home, robot).archive, now=NOW)
    create_keystore(tmp_path / "evil", template=load_template("production"), now=NOW)
    evil = sign(tmp_path / "evil", robot).archive
    other = create_request(robot, "/other")
    answer = sign_request(tmp_path / "evil", other.file.read_bytes(), now=NOW).archive
    before = snapshot(robot)
    for each in (evil, answer):
        with pytest.raises(KeystoreError, match="another keystore"):
            import_answer(robot, each, now=NOW)
    assert snapshot(robot) == before
    import_answer(robot, evil, now=NOW, force=True)


def test_an_answer_is_for_the_key_of_its_request(home: Path, robot: Path, tmp_path: Path) -> None:
    archive = sign(home, robot).archive
    create_request(tmp_path / "twin", NAME)
    before = snapshot(tmp_path)
    with pytest.raises(PkiError, match="does not belong to the enclave's key"):
        import_answer(tmp_path / "twin", archive, now=NOW)
    create_request(tmp_path / "empty", "/else")
    for place in ("empty", "none"):
        with pytest.raises(KeystoreError, match="no key of enclave /arm/camera"):
            import_answer(tmp_path / place, archive, now=NOW)
    with pytest.raises(KeystoreError, match="with CAs"):
        import_answer(home, archive, now=NOW)
    assert (
        snapshot(tmp_path / "twin").items()
        <= {path.removeprefix("twin/"): value for path, value in before.items()}.items()
    )


@pytest.mark.parametrize("days", [-2, 400])
def test_an_answer_outside_its_validity_is_refused(days: int, home: Path, robot: Path) -> None:
    archive = sign(home, robot).archive
    with pytest.raises(PkiError, match=r"expired|not valid before"):
        import_answer(robot, archive, now=NOW + timedelta(days=days))


Files = dict[str, bytes]


def rebuilt(files: Files, *extra: tuple[tarfile.TarInfo, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for path, data in files.items():
            entry = tarfile.TarInfo(path)
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
        for entry, data in extra:
            tar.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def member(
    name: str, kind: bytes = tarfile.REGTYPE, target: str = "", data: bytes = b"x"
) -> tuple[tarfile.TarInfo, bytes]:
    entry = tarfile.TarInfo(name)
    entry.type, entry.linkname = kind, target
    entry.size = len(data) if kind == tarfile.REGTYPE else 0
    return entry, data


def changed(files: Files, file: str, old: bytes, new: bytes) -> bytes:
    path = f"{FOLDER}/{file}"
    assert old in files[path]
    return rebuilt({**files, path: files[path].replace(old, new)})


def without(files: Files, path: str) -> bytes:
    return rebuilt({name: data for name, data in files.items() if name != path})


def test_no_more_is_unpacked_than_an_archive_states() -> None:
    archive = gzip.compress(bytes(2000))[:-4] + bytes(4)
    with pytest.raises(DocumentError, match="damaged"):
        unpack(archive, ArchiveLimits(packed=1000, unpacked=1000, members=1))


def of_one_header(kind: bytes, data: bytes) -> bytes:
    """Return an archive whose entry says more about the next one than its name."""
    entry, _ = member("x", kind)
    entry.size = len(data)
    return rebuilt({}, (entry, data), member("y"))


@pytest.mark.parametrize(
    ("archive", "said"),
    [
        (of_one_header(tarfile.XHDTYPE, b"12 a=1234567\n" * 100), "a header of 1300 bytes"),
        (of_one_header(tarfile.XGLTYPE, b"12 a=1234567\n"), "not a regular file"),
        (of_one_header(tarfile.GNUTYPE_LONGNAME, b"y" * 1025), "a header of 1025 bytes"),
        (of_one_header(tarfile.GNUTYPE_SPARSE, b"x"), "not a regular file"),
        # The map of this sparse file ends early: whoever reads the map finds it damaged.
        (
            of_one_header(tarfile.XHDTYPE, b"22 GNU.sparse.major=1\n22 GNU.sparse.minor=0\n"),
            "a sparse file",
        ),
    ],
)
def test_an_archive_makes_no_work_by_what_it_says_of_its_files(archive: bytes, said: str) -> None:
    """An archive of 39 KB took 30 seconds and 1 GB, one of 260 KB two minutes and 7 GB."""
    with pytest.raises(DocumentError, match=said):
        unpack(archive)


def sparse(files: Files) -> bytes:
    entry, data = member(f"{FOLDER}/crl.pem")
    entry.pax_headers = {
        "GNU.sparse.major": "0", "GNU.sparse.minor": "1", "GNU.sparse.name": f"{FOLDER}/crl.pem",
        "GNU.sparse.realsize": str(1 << 40), "GNU.sparse.map": "0,1", "GNU.sparse.numblocks": "1",
    }  # fmt: skip
    return rebuilt(files, (entry, data))


CERT = f"{FOLDER}/cert.pem"
TAMPERED: dict[str, tuple[Callable[[Files], bytes], str]] = {
    "nothing": (lambda files: b"", "not a .tar.gz"),
    "garbage": (lambda files: os.urandom(999), "not a .tar.gz"),
    "cut short": (lambda files: pack(files)[:-100], "not a .tar.gz"),
    "a bit flipped": (
        lambda files: (raw := bytearray(pack(files))).__setitem__(900, raw[900] ^ 1) or bytes(raw),
        "",
    ),
    "more behind it": (lambda files: pack(files) + pack(files), "after its end"),
    "a bomb": (lambda files: gzip.compress(bytes(MAX_UNPACKED + 1)), "unpacks to more"),
    "a huge file": (
        lambda files: rebuilt(files, member("x", data=bytes(MAX_MEMBER + 1))),
        f"{MAX_MEMBER + 1} bytes",
    ),
    "a sparse file": (sparse, "not a regular file"),
    "many files": (
        lambda files: rebuilt(files, *(member(f"x{n}") for n in range(300))),
        "more than 200 entries",
    ),
    "a path out": (lambda files: rebuilt(files, member("../../etc/cron.d/x")), "'../../etc/cron"),
    "an absolute path": (lambda files: rebuilt(files, member("/etc/passwd")), "etc/passwd"),
    "dots within": (
        lambda files: rebuilt(files, member(f"{FOLDER}/../x/cert.pem")),
        "not the answer for one",
    ),
    "a key": (lambda files: rebuilt(files, member(f"{FOLDER}/key.pem")), "key.pem"),
    "a CA key": (lambda files: rebuilt(files, member("private/ca.key.pem")), "ca.key.pem"),
    "a second enclave": (
        lambda files: rebuilt(files, member("enclaves/base/cert.pem")),
        "not the answer for one",
    ),
    "a file of another enclave": (
        lambda files: rebuilt(files, member("enclaves/base/permissions.p7s")),
        "enclaves/base",
    ),
    "a link": (
        lambda files: rebuilt(files, member(f"{FOLDER}/crl.pem", tarfile.SYMTYPE, "/etc/shadow")),
        "not a regular file",
    ),
    "a hard link": (
        lambda files: rebuilt(files, member(f"{FOLDER}/crl.pem", tarfile.LNKTYPE, CERT)),
        "not a regular file",
    ),
    "a device": (lambda files: rebuilt(files, member("x", tarfile.CHRTYPE)), "not a regular file"),
    "a FIFO": (lambda files: rebuilt(files, member("x", tarfile.FIFOTYPE)), "not a regular file"),
    "a name twice": (lambda files: rebuilt(files, member(CERT)), "twice"),
    "no certificate": (lambda files: without(files, CERT), "not the answer"),
    "no permissions": (
        lambda files: without(files, f"{FOLDER}/permissions.p7s"),
        "it lacks permissions.p7s",
    ),
    "no seal": (lambda files: without(files, SEAL), f"it lacks {SEAL}"),
    "other permissions": (
        lambda files: changed(files, "permissions.p7s", b"rt/rosout", b"rt/cmd_ve"),
        "does not match",
    ),
    "another governance": (
        lambda files: changed(files, "governance.p7s", b"ENCRYPT", b"NONE"),
        "does not match",
    ),
    "a further CA": (
        lambda files: rebuilt(
            {
                **files,
                f"{FOLDER}/identity_ca.cert.pem": files[f"{FOLDER}/identity_ca.cert.pem"]
                + files[f"{FOLDER}/permissions_ca.cert.pem"],
            }
        ),
        "differ from the signed list",
    ),
    "another enclave's name": (
        lambda files: rebuilt(
            {path.replace("arm/camera", "arm/other"): data for path, data in files.items()}
        ),
        "",
    ),
}


@pytest.mark.parametrize("case", some(list(TAMPERED), 6))
def test_a_tampered_answer_changes_nothing(
    case: str, home: Path, robot: Path, tmp_path: Path
) -> None:
    tamper, why = TAMPERED[case]
    archive = sign(home, robot).archive
    create_request(robot, "/arm/other")
    bad = tamper(unpack(archive))
    before = snapshot(tmp_path)
    with pytest.raises(SrosError) as caught:
        import_answer(robot, bad, now=NOW)
    assert why in str(caught.value)
    assert snapshot(tmp_path) == before
    import_answer(robot, archive, now=NOW)


def test_an_earlier_governance_in_an_answer_is_refused(home: Path, robot: Path) -> None:
    """An earlier governance has a valid signature; only the signed file list excludes it."""
    files = unpack(sign(home, robot).archive)
    earlier = home.parent / "earlier"
    copy_of(home, earlier)
    again = unpack(sign(earlier, robot, renew=True).archive)
    path = f"{FOLDER}/governance.p7s"
    resigned = files[path].replace(b'micalg="sha-256"', b"micalg=sha-256")
    assert resigned != files[path]
    with pytest.raises(PkiError, match="differ from the signed list"):
        import_answer(robot, rebuilt({**files, path: resigned}), now=NOW)
    mixed = {**again, SEAL: files[SEAL]}
    with pytest.raises(PkiError, match="differ from the signed list"):
        import_answer(robot, rebuilt(mixed), now=NOW)


def test_a_repacked_answer_is_accepted(home: Path, robot: Path) -> None:
    """The positive twin: the content counts, not the way it was packed."""
    import_answer(robot, rebuilt(unpack(sign(home, robot).archive)), now=NOW)
    assert not verify_arrival(robot, now=NOW).findings


def test_the_request_kept_in_the_keystore_can_be_signed_again(home: Path, robot: Path) -> None:
    sign(home, robot)
    kept = (home / FOLDER / "request.pem").read_bytes()
    assert load_request(kept, "kept").public_key == load_request(request_of(robot), "").public_key
    import_answer(robot, sign_request(home, kept, now=NOW, renew=True).archive, now=NOW)
