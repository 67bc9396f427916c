"""Identity certificates from a CA service: what is asked, what is taken, and what is refused."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes

import sros_tool
from sros_tool.api import check
from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.keystore.confirmation import MESSAGE_FILE
from sros_tool.keystore.delivery.collect import collect
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.issuing import ca_service
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.lifecycle.rotate import renew_identity_ca, rotate_ca
from sros_tool.keystore.lifecycle.update import update_keystore
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import common_name, issue_ca, make_request, pem, validity_of
from sros_tool.pki.crl import RevocationEntry, sign_crl
from sros_tool.pki.keys import generate_key, key_pem
from sros_tool.validity import Window, parse_iso
from sros_tool.wording import serial_text
from tests.support.harness import certificate, copy_of, policy_text, publish, snapshot, sros
from tests.support.messages import key_of, said_by, signed_message

DAY = timedelta(days=1)


def now() -> datetime:
    """The real time, which the program of the CA service takes, too."""
    return datetime.now(UTC).replace(microsecond=0)


CA_KEY = generate_key()
CA = issue_ca(CA_KEY, common_name("head office"), Window(now() - DAY, now() + 900 * DAY))
TEMPLATE = replace(load_template("production"), certificate_validity=90 * DAY, unique_subject=False)
SHA256 = hashes.SHA256()
SERVICE = Keyring(places={"identity": "issuer:test"})

Install = Callable[[str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Make a script the program of the CA service; it logs what it is asked for."""
    return installs(tmp_path, monkeypatch)


def installs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Return a function that makes a script the program of the CA service."""
    programs = folder / "bin"
    programs.mkdir()
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")

    def install(script: str) -> None:
        program = programs / "sros-issuer-test"
        log = f'echo "$SROS_ENCLAVE $SROS_SUBJECT $SROS_NOT_AFTER" >>{folder}/asked\n'
        program.write_text(f"#!/bin/sh\nset -e\n{log}{script}\n")
        program.chmod(0o755)

    return install


def office(tmp_path: Path, days: int = 30) -> str:
    """The script of a CA service that issues what it is asked for."""
    (tmp_path / "ca.key").write_bytes(key_pem(CA_KEY))
    (tmp_path / "ca.pem").write_bytes(pem(CA))
    (tmp_path / "extensions").write_text("basicConstraints = critical, CA:FALSE\n")
    return (
        f"exec openssl x509 -req -CA {tmp_path}/ca.pem -CAkey {tmp_path}/ca.key -days {days} "
        f"-set_serial 0x$(openssl rand -hex 15) -extfile {tmp_path}/extensions"
    )


@pytest.fixture(scope="module")
def made_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the keystore ``site`` and what the CA service was asked; only to be copied."""
    folder = tmp_path_factory.mktemp("service")
    with pytest.MonkeyPatch.context() as patched:
        installs(folder, patched)(office(folder))
        root = folder / "site"
        create_keystore(
            root, template=TEMPLATE, now=now(), keyring=SERVICE, imported_cas={"identity": pem(CA)}
        )
        create_enclaves(root, ["/talker", "/listener"], now=now())
    return folder


@pytest.fixture
def site(made_site: Path, tmp_path: Path, install: Install) -> Path:
    install(office(tmp_path))
    shutil.copy(made_site / "asked", tmp_path)
    return copy_of(made_site / "site", tmp_path / "site")


def test_the_service_issues_and_the_permissions_ca_signs(
    site: Path, tmp_path: Path, install: Install
) -> None:
    assert not list((site / "private").glob("identity*"))
    first = certificate(site / "enclaves/talker/cert.pem")
    assert first.issuer == CA.subject and validity_of(first).not_after < now() + 31 * DAY
    asked = [line.split() for line in (tmp_path / "asked").read_text().splitlines()]
    assert sorted(words[:2] for words in asked) == [
        ["/listener", "CN=/listener"],
        ["/talker", "CN=/talker"],
    ]
    assert abs(parse_iso(asked[0][2]) - now() - 90 * DAY) < DAY
    # Robots keep their keys, and do not know the unique part of a subject.
    robot = make_request(generate_key(), "/arm")
    assert sign_request(site, robot, now=now()).names("created") == ("/arm",)
    renewed = renew(site, ["/arm"], now=now())  # by the request that is kept
    assert renewed.names("renewed") == ("/arm",)
    assert [note.id for note in renewed.notes] == ["service.expires-early"]
    assert not check(site)
    before = snapshot(site)
    with pytest.raises(KeystoreError, match="its subject is CN=/arm; it should be CN=/arm,OU="):
        update_keystore(site, replace(TEMPLATE, unique_subject=True), now=now())
    assert snapshot(site) == before


def made(
    subject: x509.Name, public: Any, *, key: Any = CA_KEY, issuer: x509.Certificate = CA,
    serial: int = 0, days: int = 30, begin: int = -1, ca: bool = False,
    digest: Any = SHA256,
) -> bytes:  # fmt: skip
    builder = x509.CertificateBuilder(
        issuer.subject, subject, public, serial or secrets.randbits(120),
        now() + begin * DAY, now() + days * DAY,
    ).add_extension(x509.BasicConstraints(ca, None), critical=True)  # fmt: skip
    return pem(builder.sign(key, digest))


OTHER = generate_key()
ANSWERS: dict[str, tuple[Callable[[x509.Name, Any], bytes], str]] = {
    "another key": (lambda s, k: made(s, OTHER.public_key()), "it is for another key"),
    "another CA": (lambda s, k: made(s, k, key=OTHER), "its issuer is another CA named CN=head"),
    "another name": (
        lambda s, k: made(common_name("/listener"), k),
        "its subject is CN=/listener; it should be CN=/talker",
    ),
    "two names": (
        lambda s, k: made(x509.Name([*s, *common_name("/listener")]), k),
        "CN=/listener,CN=/talker.*; it should be CN=/talker",
    ),
    "a CA": (lambda s, k: made(s, k, ca=True), "it is a CA certificate"),
    "longer": (lambda s, k: made(s, k, days=91), "later than the requested"),
    "expired": (lambda s, k: made(s, k, begin=-9, days=-1), "not now"),
    "not yet valid": (lambda s, k: made(s, k, begin=1), "not now"),
    "weak": (lambda s, k: made(s, k, digest=hashes.SHA224()), "has a weak signature"),
    "a long serial": (lambda s, k: made(s, k, serial=1 << 159), "more than 159 bits"),
    "a serial of before": (
        lambda s, k: made(s, k, serial=7),
        "serial number that another certificate has",
    ),
    "no certificate": (lambda s, k: b"welcome\n", "it is not a PEM certificate"),
    "no bytes": (lambda s, k: b"", "it is not a PEM certificate"),
    "much": (lambda s, k: made(s, k) + b"x" * 70_000, "wrote more than 65536 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("case", ANSWERS)
def test_another_certificate_than_was_asked_for_is_refused(
    case: str, site: Path, tmp_path: Path, install: Install
) -> None:
    present = certificate(site / "enclaves/talker/cert.pem")
    answer, words = ANSWERS[case]
    install(f"cat {tmp_path}/answer")
    company = x509.NameAttribute(x509.NameOID.ORGANIZATION_NAME, "Company")
    wider = x509.Name([*present.subject, company])
    good = made(wider, present.public_key(), serial=7)
    (tmp_path / "answer").write_bytes(good + pem(CA))
    assert renew(site, ["/talker"], now=now()).names("renewed") == (
        "/talker",
    )  # others' parts stay
    assert (site / "enclaves/talker/cert.pem").read_bytes() == good
    (tmp_path / "answer").write_bytes(answer(present.subject, present.public_key()))
    before = snapshot(site)
    with pytest.raises(KeystoreError, match=words) as refused:
        renew(site, ["/talker"], now=now())
    assert "Nothing was changed" in str(refused.value) and "/talker" in str(refused.value)
    assert snapshot(site) == before


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("echo the quota is used up >&2; exit 3", "ended with status 3: the quota is used up"),
        ("exit 1", "`sros-issuer-test` ended with status 1. Nothing was changed"),
        ("yes", "wrote more than 65536 bytes"),
        ("yes | head -c 3000000 >&2; echo last >&2; exit 4", "status 4: y y .* y last. Nothing"),
        ("setsid sleep 1 & sleep 100", "did not end within 0.3 seconds"),
    ],
)
def test_a_program_that_fails_changes_nothing(
    script: str, words: str, site: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "sleep" in script:
        monkeypatch.setattr(ca_service, "_MOST_SECONDS", 0.3)
    install(script)
    before = snapshot(site)
    with pytest.raises(KeystoreError, match=words):
        renew(site, now=now(), names=["/talker", "/listener"])
    assert snapshot(site) == before


def test_without_the_program_nothing_is_issued_and_a_dry_run_does_not_ask(
    site: Path, tmp_path: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "asked").unlink()
    before = snapshot(site)
    planned = renew(site, ["/talker"], now=now(), dry_run=True)
    assert [note.id for note in planned.notes] == ["service.not-asked"]
    assert not (tmp_path / "asked").exists()
    (tmp_path / "bin/sros-issuer-test").unlink()
    with pytest.raises(KeystoreError, match="no program `sros-issuer-test` on the PATH"):
        renew(site, ["/talker"], now=now())
    monkeypatch.chdir(tmp_path)
    install(office(tmp_path))
    monkeypatch.setenv("PATH", "bin:/usr/bin:/bin")  # of whoever made the current folder
    with pytest.raises(KeystoreError, match="no program"):
        renew(site, ["/talker"], now=now())
    assert snapshot(site) == before


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may act for others")
def test_the_keystore_of_another_user_does_not_name_the_service(site: Path) -> None:
    os.chown(site, 1, 1)
    os.chown(site / "private/permissions_ca.key.pem", 1, 1)
    with pytest.raises(KeystoreError, match="of user 1 names the CA service 'issuer:test'"):
        renew(site, ["/talker"], now=now())
    assert renew(site, ["/talker"], now=now(), keyring=SERVICE).names("renewed")


def listed(*serials: int, number: int = 1, key: Any = CA_KEY, days: float = 30) -> bytes:
    revoked = [RevocationEntry(serial, now()) for serial in serials]
    end = now() + days * DAY
    return sign_crl(CA, key, revoked, number=number, this_update=now() - 2 * DAY, next_update=end)


def test_the_service_signs_the_revocation_list(site: Path) -> None:
    serial = certificate(site / "enclaves/talker/cert.pem").serial_number
    others = 4711  # of another site
    before = snapshot(site)
    for crl, words in (
        (b"", rf"only this service signs .*: {serial_text(serial)}. Give the list of the service "),
        (listed(others), f"It does not revoke {serial_text(serial)}"),
        (listed(serial, key=OTHER), "did not sign it"),
        (listed(serial, days=-1), "not now"),
        (listed(serial, number=0), "Its number is 0, and has to be higher than 0"),
    ):
        with pytest.raises(KeystoreError, match=words):
            revoke(site, ["/talker"], now=now(), crl=crl)
        assert snapshot(site) == before
    revoke(site, ["/talker"], now=now(), crl=listed(serial, others, number=5))
    assert (site / "enclaves/listener/crl.pem").resolve() == site / "public/identity_ca.crl.pem"
    assert (site / f"revoked/{serial:x}/cert.pem").exists()
    with pytest.raises(KeystoreError, match="Its number is 5, and has to be higher than 5"):
        refresh_crl(site, now=now(), crl=listed(serial, number=5))
    with pytest.raises(KeystoreError, match=f"It does not revoke {serial_text(serial)}"):
        refresh_crl(site, now=now(), crl=listed(others, number=6))
    mine = certificate(site / "enclaves/listener/cert.pem").serial_number
    with pytest.raises(KeystoreError, match="could not start in /listener"):
        refresh_crl(site, now=now(), crl=listed(serial, mine, number=6))
    refresh_crl(site, now=now(), crl=listed(serial, number=6, days=0.5))
    present = OpenedKeystore(site).revocation_list
    assert present and present.number == 6
    (ends,) = (found for found in check(site) if found.id == "keystore.revocation-list-ends")
    assert f"sros crl {site} --refresh --crl FILE" in ends.remedy


def test_a_later_certificate_of_the_service_for_the_same_key(site: Path, tmp_path: Path) -> None:
    def renewed(name: str, key: Any = CA_KEY, days: int = 2000) -> bytes:
        return pem(issue_ca(key, common_name(name), Window(now() - DAY, now() + days * DAY)))

    before, later = snapshot(site), renewed("head office")
    for issued, words in (
        (b"", "with --identity-ca FILE"),
        (renewed("another office"), "another name or key"),
        (renewed("head office", OTHER), "another name or key"),
        (renewed("head office", days=800), "expire before the old one"),
        (made(CA.subject, CA_KEY.public_key()), "cannot be the identity CA"),
        (b"x", "cannot be read"),
    ):
        with pytest.raises(SrosError, match=words):
            renew_identity_ca(site, now=now(), issued=issued)
        assert snapshot(site) == before
    (tmp_path / "later.pem").write_bytes(later)
    sros("rotate_ca", site, "--same-key", "--identity-ca", tmp_path / "later.pem").ok()
    assert (site / "enclaves/talker/identity_ca.cert.pem").read_bytes() == later
    assert not [found for found in check(site) if found.severity > "note"]
    create_enclaves(site, ["/arm"], now=now())
    serial = certificate(site / "enclaves/talker/cert.pem").serial_number
    revoke(site, ["/talker"], now=now(), crl=listed(serial, days=300))
    assert not [found for found in check(site) if found.severity > "note"]
    assert sros("rotate_ca", site, "--identity-ca", tmp_path / "later.pem", "--next").status == 2
    own = tmp_path / "own"
    create_keystore(own, template=TEMPLATE, now=now())
    with pytest.raises(UsageError, match="sros issues the certificate of this"):
        renew_identity_ca(own, now=now(), issued=later)


def test_python_takes_a_service_and_the_list_that_it_signed(
    tmp_path: Path, install: Install
) -> None:
    install(office(tmp_path))
    made = sros_tool.create_keystore(
        tmp_path / "site",
        TEMPLATE,
        identity_ca=tmp_path / "ca.pem",
        identity_key="issuer:test",
        now=now(),
    )
    sros_tool.create_enclaves(made, ["/talker", "/listener"])
    first = certificate(made.path / "enclaves/talker/cert.pem")
    assert first.issuer == CA.subject
    with pytest.raises(sros_tool.KeystoreError, match="only this service signs revocation lists"):
        sros_tool.revoke(made, ["/talker"])
    with pytest.raises(sros_tool.DocumentError, match=r"none\.pem"):
        sros_tool.revoke(made, ["/talker"], crl=tmp_path / "none.pem")
    (tmp_path / "list.pem").write_bytes(listed(first.serial_number))
    assert sros_tool.revoke(made, ["/talker"], crl=tmp_path / "list.pem").restart == ("/listener",)


def test_what_a_service_cannot_do_is_refused(site: Path, tmp_path: Path) -> None:
    before = snapshot(site)
    with pytest.raises(KeystoreError, match="cannot revoke earlier certificates"):
        renew(site, ["/talker"], now=now(), revoke_old=True)
    with pytest.raises(UsageError, match="Replace only the permissions CA"):
        rotate_ca(site, now=now())
    assert snapshot(site) == before
    rotate_ca(site, now=now(), roles=["permissions"], finish=True)
    assert not OpenedKeystore(site).ledger.gaps
    for template, imported, words in (
        (TEMPLATE, {}, "with --identity-ca FILE"),
        (replace(TEMPLATE, separate_authorities=False), {"identity": pem(CA)}, "layout separate"),
    ):
        with pytest.raises(SrosError, match=words):
            create_keystore(
                tmp_path / "new",
                template=template,
                now=now(),
                keyring=SERVICE,
                imported_cas=imported,
            )
    with pytest.raises(UsageError, match="not the name of a CA service"):
        Keyring(places={"identity": "issuer:../evil"})
    own = tmp_path / "own"
    create_keystore(own, template=TEMPLATE, now=now())
    create_enclaves(own, ["/talker"], now=now())
    with pytest.raises(UsageError, match="Leave --crl out"):
        revoke(own, ["/talker"], now=now(), crl=listed(1))


def test_a_later_list_of_the_service_that_a_robot_sends_stops_no_renewal(
    tmp_path: Path, install: Install
) -> None:
    """Everybody may have it, also with certificates of other sites alone."""
    install(office(tmp_path))
    root, then = tmp_path / "site", now() + 20 * DAY
    create_keystore(
        root, template=TEMPLATE, now=now(), keyring=SERVICE, imported_cas={"identity": pem(CA)}
    )
    (tmp_path / "fleet.toml").write_text(
        '[groups.some]\nrenewal = "allowed"\n[robots]\n'
        'r1 = { groups = ["some"] }\nr2 = { groups = ["some"] }\n'
    )
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}/base": publish("/x")}))
    stated = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", root, *stated).ok()
    for robot, crl in (("r1", listed(4711, number=7, days=300).decode()), ("r2", None)):
        folder, enclave = tmp_path / robot, f"/{robot}/base"
        sros("distribute_key", root, "--robot", robot, folder).ok()
        request = make_request(key_of(folder, enclave), enclave).decode()
        said = said_by(folder, robot, then, crl=crl, requests=(request,))
        (tmp_path / "inbox" / robot).mkdir(parents=True)
        message = tmp_path / "inbox" / robot / MESSAGE_FILE
        message.write_bytes(signed_message(folder, enclave, said))
    found = collect(root, tmp_path / "inbox", now=then)
    assert [robot.requests[0].outcome for robot in found.robots] == ["renewed", "renewed"]
    assert "fleet.later-list" in [note.id for note in found.notes]
    mine = certificate(root / "enclaves/r1/base/cert.pem").serial_number
    said = said_by(tmp_path / "r2", "r2", then, sequence=2, crl=listed(mine, number=8).decode())
    message.write_bytes(signed_message(tmp_path / "r2", "/r2/base", said))
    (note,) = collect(root, tmp_path / "inbox", now=then).notes
    assert note.text.startswith("r1, r2 have a revocation list, signed by the CA service")
