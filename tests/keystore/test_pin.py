"""With a pinned CA, a robot accepts only answers that this CA signed, the first one included."""

from __future__ import annotations

import re
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.checks.keystores.arrival import verify_arrival
from sros_tool.errors import KeystoreError, PkiError
from sros_tool.keystore.delivery import robot as delivered
from sros_tool.keystore.delivery.archive import pack, unpack
from sros_tool.keystore.delivery.robot import import_answer, read_pinned_cas, seal
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.issuing import authority as authorities
from sros_tool.keystore.issuing.authority import load_authority
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
from sros_tool.keystore.layout import PERMISSIONS, SEAL
from sros_tool.keystore.lifecycle.create import create_keystore
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import digest
from tests.support.children import run
from tests.support.harness import certificate, create_request, snapshot, sros

NOW = datetime.now(UTC)
NAME, FOLDER = "/arm/camera", "enclaves/arm/camera"


def made(folder: Path, name: str, template: str = "production") -> Path:
    create_keystore(folder / name, template=load_template(template), now=NOW)
    return folder / name


@pytest.fixture(params=["production", "sros2"])
def home(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return made(tmp_path, "home", request.param)


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    create_request(tmp_path / "robot", NAME)
    return tmp_path / "robot"


def answer_of(home: Path, robot: Path) -> bytes:
    return sign_request(home, (robot / FOLDER / "request.pem").read_bytes(), now=NOW).archive


def pin(home: Path, role: str = "permissions") -> frozenset[str]:
    return frozenset({digest(certificate(home / f"public/{role}_ca.cert.pem"))})


def test_only_the_pinned_ca_is_accepted(home: Path, robot: Path, tmp_path: Path) -> None:
    evil = made(tmp_path, "evil")
    answers = answer_of(home, robot), answer_of(evil, robot)
    before = snapshot(robot)
    with pytest.raises(KeystoreError, match="not signed by the pinned CA"):
        import_answer(robot, answers[1], now=NOW, pinned=pin(home))
    assert snapshot(robot) == before
    assert import_answer(robot, answers[0], now=NOW, pinned=pin(home)).first
    # The permission to move to other CAs does not disable the pin.
    with pytest.raises(KeystoreError, match="not signed by the pinned CA"):
        import_answer(robot, answers[1], now=NOW, pinned=pin(home), force=True)
    import_answer(robot, answers[1], now=NOW, pinned=pin(evil), force=True)


def test_the_identity_ca_does_not_vouch_for_the_permissions(robot: Path, tmp_path: Path) -> None:
    """An attacker keeps the certificate, and replaces permissions, governance and their CA."""
    home, evil = made(tmp_path, "home"), made(tmp_path, "evil", "development")
    genuine = unpack(answer_of(home, robot))
    forged = unpack(answer_of(evil, robot))
    files = {path: data for path, data in forged.items() if path != SEAL}
    for file in ("cert.pem", "identity_ca.cert.pem"):
        files[f"{FOLDER}/{file}"] = genuine[f"{FOLDER}/{file}"]
    subject = certificate(home / FOLDER / "cert.pem").subject.rfc4514_string()
    files = resigned(evil, files, subject)
    authority = load_authority(
        OpenedKeystore(evil), PERMISSIONS, OpenedKeystore(evil).template, IN_KEYSTORE, NOW
    )
    archive = pack({SEAL: seal(files, 1, authority), **files})
    before = snapshot(robot)
    with pytest.raises(KeystoreError, match="signs only the certificate"):
        import_answer(robot, archive, now=NOW, pinned=pin(home, "identity"))
    with pytest.raises(KeystoreError, match=digest(authority.certificate)):
        import_answer(robot, archive, now=NOW, pinned=pin(home))
    assert snapshot(robot) == before
    # The forgery is good: without a pin it is accepted.
    import_answer(robot, archive, now=NOW)
    assert not verify_arrival(robot, now=NOW).findings


def resigned(home: Path, files: dict[str, bytes], subject: str) -> dict[str, bytes]:
    """Return files with permissions for ``subject``, signed by a keystore's permissions CA."""
    text = (home / FOLDER / "permissions.xml").read_text()
    text = re.sub(r"<subject_name>[^<]*", f"<subject_name>{subject}", text)
    text = re.sub(r"<not_after>[^<]*", "<not_after>2027-01-01T00:00:00Z", text)
    wanted = home / "wanted.xml"
    wanted.write_text(text)
    words = ["smime", "-sign", "-text", "-in", wanted]
    words += ["-signer", home / "public/permissions_ca.cert.pem"]
    words += ["-inkey", home / "private/permissions_ca.key.pem"]
    message = subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True)
    return {**files, f"{FOLDER}/permissions.p7s": message.stdout}


def test_after_a_rotation_the_new_ca_is_pinned(robot: Path, tmp_path: Path) -> None:
    home = made(tmp_path, "home")
    old = pin(home)
    for stage in (RotationStage.DISTRIBUTE, RotationStage.REISSUE, RotationStage.RETIRE):
        rotate_ca(home, stage, now=NOW)
    archive = answer_of(home, robot)
    with pytest.raises(KeystoreError, match="not signed by the pinned CA"):
        import_answer(robot, archive, now=NOW, pinned=old)
    import_answer(robot, archive, now=NOW, pinned=pin(home))


# ── the program ────────────────────────────────────────────────────────────────────────────


def openssl_fingerprint(path: Path) -> str:
    words = ["openssl", "x509", "-in", str(path), "-noout", "-fingerprint", "-sha256"]
    return run(words).stdout.strip()


def test_all_commands_print_the_same_fingerprint(tmp_path: Path) -> None:
    home, robot = tmp_path / "home", tmp_path / "robot"
    created = sros("create_keystore", home, "--template", "production").ok().out
    (told,) = re.findall(r"permissions CA SHA-256 ([0-9a-f]{64})", created)
    ca = home / "public/permissions_ca.cert.pem"
    assert (
        read_pinned_cas(openssl_fingerprint(ca))
        == read_pinned_cas(told)
        == read_pinned_cas(str(ca))
        == pin(home)
    )
    assert "identity CA SHA-256 " + next(iter(pin(home, "identity"))) in created
    sros("create_request", NAME, robot).ok()
    request = robot / FOLDER / "request.pem"
    signed = sros("sign_request", home, request, "-o", tmp_path / "answer.tgz").ok().out
    assert f"sros import answer.tgz DIR --ca {told}\n" in signed
    assert signed.count("SHA-256") == 2
    for wrong in ("0" * 64, told.replace(told[0], "f" if told[0] != "f" else "e")):
        refused = sros("import", tmp_path / "answer.tgz", robot, "--ca", wrong)
        assert refused.status == 2
        assert refused.err.count("\n") == 1
        assert told in refused.err
    unclear = sros("import", tmp_path / "answer.tgz", robot, "--ca", told[:-1])
    assert (unclear.status, "64 hexadecimal digits" in unclear.err) == (2, True)
    without = sros("import", tmp_path / "answer.tgz", robot, "--dry-run").ok()
    assert "would create" in without.out
    done = sros("import", tmp_path / "answer.tgz", robot, "--ca", ca).ok().out
    assert f"SHA-256 {told}" in done
    assert "not verified" not in done


def test_without_a_pin_the_fingerprints_to_compare_are_printed(tmp_path: Path) -> None:
    home, robot = made(tmp_path, "home"), tmp_path / "robot"
    sros("create_request", NAME, robot).ok()
    request = robot / FOLDER / "request.pem"
    sros("sign_request", home, request, "-o", tmp_path / "answer.tgz").ok()
    said = sros("import", tmp_path / "answer.tgz", robot).ok().out
    assert next(iter(pin(home))) in said
    assert next(iter(pin(home, "identity"))) in said
    assert "without --ca, import does not verify the CAs" in said


def test_an_answer_of_a_weak_ca_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the places that refuse it is opened in turn: create, sign_request, and import."""
    files = ("-keyout", tmp_path / "ca.key", "-out", tmp_path / "ca.pem")
    kind = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:secp224r1", "-nodes", "-days", "99")
    extensions = ("-addext", "keyUsage=critical,keyCertSign,cRLSign,digitalSignature")
    run(["openssl", "req", "-x509", *kind, "-subj", "/CN=weak", *extensions, *files])
    home, robot = tmp_path / "home", tmp_path / "robot"
    place = ("--identity-ca", tmp_path / "ca.pem", "--identity-key", tmp_path / "ca.key")
    assert "weak key" in sros("create_keystore", home, *place).err
    with monkeypatch.context() as opened:
        opened.setattr(authorities, "weakness", lambda _: "")
        sros("create_keystore", home, *place).ok()
    assert "The key is weak: EC secp224r1" in sros("rotate_ca", home, "--same-key").err
    create_request(robot, NAME)
    request, now = (robot / FOLDER / "request.pem").read_bytes(), datetime.now(UTC)
    with pytest.raises(KeystoreError, match="weak cryptography"):
        sign_request(home, request, now=now)
    with monkeypatch.context() as opened:
        opened.setattr(delivered, "weaknesses", lambda _: ())
        packed = sign_request(home, request, now=now).archive
    before = snapshot(robot)
    with pytest.raises(PkiError, match="CN=weak has a weak key, EC secp224r1"):
        import_answer(robot, packed, now=now)
    assert snapshot(robot) == before
    monkeypatch.setattr(delivered, "weaknesses", lambda _: ())
    import_answer(robot, packed, now=now)
    assert "CN=weak has a weak key" in sros("verify", robot).out
    assert "keystore.weak-cryptography" in sros("check", home).out
