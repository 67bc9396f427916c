"""A keystore to be broken: signs anything with its CAs, and issues any certificate."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, pem, validity_of
from sros_tool.pki.crl import RevocationEntry, last_update, next_update, sign_crl
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key

SECRET = "open, sesame"
DAY = timedelta(days=1)


def name_of(*parts: tuple[str, str]) -> x509.Name:
    oids = {"CN": NameOID.COMMON_NAME, "OU": NameOID.ORGANIZATIONAL_UNIT_NAME}
    return x509.Name([x509.NameAttribute(oids[kind], text) for kind, text in reversed(parts)])


@dataclass
class Bench:
    """``options`` are further arguments for the check; a case may change ``checked``."""

    root: Path
    now: datetime
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.checked = self.root

    def path(self, name: str) -> Path:
        return self.root / name

    # ── CAs ────────────────────────────────────────────────────────────────────────────────

    def key(self, role: str) -> PrivateKey:
        return _unlocked(self.path(f"private/{role}_ca.key.pem").read_bytes())

    def authority(self, role: str) -> x509.Certificate:
        return load_certificate(self.path(f"public/{role}_ca.cert.pem").read_bytes(), role)

    def new_authority(
        self,
        *extensions: tuple[x509.ExtensionType, bool],
        curve: ec.EllipticCurve | None = None,
        digest: hashes.SHA256 | hashes.SHA384 | None = None,
        issuer: tuple[x509.Name, PrivateKey] | None = None,
        common_name: str = "new CA",
        until: datetime | None = None,
    ) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
        key = ec.generate_private_key(curve or ec.SECP256R1())
        name = name_of(("CN", common_name))
        by, signing = issuer or (name, key)
        builder = x509.CertificateBuilder(
            by, name, key.public_key(), 4711, self.now - DAY, until or self.now + 1000 * DAY
        )
        for extension, critical in extensions:
            builder = builder.add_extension(extension, critical)
        return builder.sign(signing, digest or hashes.SHA256()), key

    def trust(self, role: str, certificate: x509.Certificate) -> None:
        self.path(f"public/{role}_ca.cert.pem").write_bytes(pem(certificate))

    def adopt(self, role: str, authority: tuple[x509.Certificate, PrivateKey]) -> None:
        """Take another CA, and issue or sign everything again with it."""
        certificate, key = authority
        self.trust(role, certificate)
        self.path(f"private/{role}_ca.key.pem").write_bytes(key_pem(key, SECRET))
        if role == "identity":
            for serial, name in enumerate(("base", "arm"), start=12345):
                self.issue(name, by=authority, serial=serial)
            return
        for path in (self.path("enclaves/governance.p7s"), *self.root.glob("enclaves/*/perm*.p7s")):
            self.sign(str(path.relative_to(self.root)), lambda text: text, xml=False)

    # ── signed documents ───────────────────────────────────────────────────────────────────

    def document(self, file: str) -> str:
        signed = smime.parse(self.path(file).read_bytes())
        return signed.document.decode().replace("\r\n", "\n")

    def sign(self, file: str, edit: Callable[[str], str], *, xml: bool = True) -> None:
        """Edit what a signed document says, and sign it again."""
        document = edit(self.document(file)).encode()
        message = smime.sign(document, self.authority("permissions"), self.key("permissions"))
        self.path(file).write_bytes(message)
        if xml:
            self.path(file).with_suffix(".xml").write_bytes(document)

    def permissions(self, *changes: tuple[str, str], name: str = "base", xml: bool = True) -> None:
        """Replace texts of an enclave's permissions; each has to be there."""
        self.sign(f"enclaves/{name}/permissions.p7s", lambda text: _changed(text, changes), xml=xml)

    def governance(self, *changes: tuple[str, str]) -> None:
        """Replace texts of the governance; each has to be there."""
        self.sign("enclaves/governance.p7s", lambda text: _changed(text, changes))

    # ── enclaves ───────────────────────────────────────────────────────────────────────────

    def certificate(self, name: str = "base") -> x509.Certificate:
        return load_certificate(self.path(f"enclaves/{name}/cert.pem").read_bytes(), name)

    def issue(
        self,
        name: str = "base",
        *,
        subject: x509.Name | None = None,
        serial: int = 12345,
        after: datetime | None = None,
        is_ca: bool = False,
        by: tuple[x509.Certificate, PrivateKey] | None = None,
        key: PrivateKey | None = None,
        digest: hashes.SHA256 | hashes.SHA384 | None = None,
    ) -> None:
        """Give an enclave another certificate, and its permissions to its subject."""
        old = self.certificate(name)
        subject = subject or old.subject
        ca, ca_key = by or (self.authority("identity"), self.key("identity"))
        certificate = (
            x509.CertificateBuilder(
                ca.subject,
                subject,
                key.public_key() if key else old.public_key(),
                serial,
                validity_of(old).not_before,
                after or validity_of(old).not_after,
            )
            .add_extension(x509.BasicConstraints(is_ca, None), critical=True)
            .sign(ca_key, digest or hashes.SHA256())
        )
        self.path(f"enclaves/{name}/cert.pem").write_bytes(pem(certificate))
        if key:
            self.path(f"enclaves/{name}/key.pem").write_bytes(key_pem(key))
        if subject != old.subject:
            texts = (old.subject.rfc4514_string(), subject.rfc4514_string())
            self.permissions(texts, name=name)

    def revoke(
        self,
        *serials: int,
        by: tuple[x509.Certificate, PrivateKey] | None = None,
        begin: datetime | None = None,
        end: datetime | None = None,
        linked: bool = True,
        scope: str = "",
    ) -> None:
        """Put a revocation list in place; with ``scope``, one of a place with this URI."""
        ca, key = by or (self.authority("identity"), self.key("identity"))
        data = sign_crl(
            ca,
            key,
            [RevocationEntry(serial, self.now - DAY) for serial in serials],
            number=1,
            this_update=begin or self.now - DAY,
            next_update=end or self.now + 1000 * DAY,
        )
        if scope:
            data = _with_scope(data, key, scope)
        self.path("public/identity_ca.crl.pem").write_bytes(data)
        for name in ("base", "arm") if linked else ():
            link = self.path(f"enclaves/{name}/crl.pem")
            link.symlink_to("../../public/identity_ca.crl.pem")

    def foreign(self) -> tuple[x509.Certificate, PrivateKey]:
        """Another CA."""
        return self.new_authority((x509.BasicConstraints(True, None), True))

    def unlink(self, name: str) -> Path:
        path = self.path(name)
        path.unlink()
        return path

    def export(self) -> Path:
        """A robot's copy of the enclaves, which is checked in place of the keystore."""
        target = self.root.with_name("robot")
        shutil.copytree(self.path("enclaves"), target / "enclaves", symlinks=False)
        for name in ("governance.xml", "governance.p7s"):
            (target / "enclaves" / name).unlink()
        for name in ("base", "arm"):
            (target / "enclaves" / name / "permissions.xml").unlink()
        self.checked = target
        return target


@cache
def _with_scope(data: bytes, key: PrivateKey, uri: str) -> bytes:
    """Return a revocation list without entries that is only of the place ``uri``."""
    like = x509.load_pem_x509_crl(data)
    scope = x509.IssuingDistributionPoint(
        [x509.UniformResourceIdentifier(uri)], None, False, False, None, False, False
    )
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(like.issuer)
        .last_update(last_update(like))
        .add_extension(scope, critical=True)
    )
    expiry = next_update(like)
    assert expiry
    signed = builder.next_update(expiry).sign(key, hashes.SHA256())
    return signed.public_bytes(serialization.Encoding.PEM)


def _unlocked(data: bytes) -> PrivateKey:
    return load_key(data, "a CA key", lambda: SECRET)


def _changed(text: str, changes: tuple[tuple[str, str], ...]) -> str:
    for old, new in changes:
        assert old in text, (old, text)
        text = text.replace(old, new)
    return text


def new_key() -> ec.EllipticCurvePrivateKey:
    return generate_key()
