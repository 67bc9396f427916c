"""Enclaves that are broken in one way each, with real keys and signatures.

Each entry of `BREAKAGES` takes the folder of a working enclave of a keystore and breaks it.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509

from sros_tool.files import policies_dir
from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.pki import smime
from sros_tool.pki.certificates import Issuer, common_name, issue_ca, load_certificate, pem
from sros_tool.pki.crl import RevocationEntry, sign_crl
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.policy.document import read_policy
from sros_tool.validity import Window, iso

DAY = timedelta(days=1)
ENCLAVE = "/talker_listener/talker"
OTHER = "/talker_listener/listener"


def make_keystore(root: Path, now: datetime) -> Path:
    """The keystore of talker and listener, as ``sros create_keystore`` makes it by default."""
    create_keystore(root, template=load_template("development"), now=now - 10 * DAY)
    policy = read_policy(policies_dir() / "talker_listener.xml")
    generate_artifacts(root, policies=[policy], now=now - 10 * DAY)
    return root


class Enclave:
    """The folder of an enclave, and what is needed to sign for it anew."""

    def __init__(self, root: Path, name: str = ENCLAVE) -> None:
        self.root = root
        self.folder = root / "enclaves" / name.lstrip("/")
        self.now = datetime.now(UTC).replace(microsecond=0)
        self.key = load_key((self.folder / "key.pem").read_bytes(), "key")
        self.certificate = load_certificate((self.folder / "cert.pem").read_bytes(), "cert")

    def authority(self, role: str) -> tuple[x509.Certificate, PrivateKey]:
        """Certificate and key of the identity or permissions CA."""
        certificate = load_certificate(
            (self.root / f"public/{role}_ca.cert.pem").read_bytes(), role
        )
        return certificate, load_key((self.root / f"private/{role}_ca.key.pem").read_bytes(), role)

    def write(self, name: str, data: bytes) -> None:
        """Replace a file of the enclave; where it is a link, the link and not what it leads to."""
        path = self.folder / name
        path.unlink(missing_ok=True)
        path.write_bytes(data)

    def reissue(self, begin: timedelta, end: timedelta) -> None:
        """A certificate for another window."""
        certificate, key = self.authority("identity")
        window = Window(self.now + begin, self.now + end)
        wide = issue_ca(
            key, certificate.subject, Window(self.now - 400 * DAY, self.now + 400 * DAY)
        )
        issued = Issuer(wide, key).issue(self.certificate.subject, self.key.public_key(), window)
        self.write("cert.pem", pem(issued))

    def document(self, name: str) -> bytes:
        """The XML in a signed document."""
        return smime.parse((self.folder / f"{name}.p7s").read_bytes()).document

    def resign(self, name: str, document: bytes) -> None:
        """Sign a document by the permissions CA."""
        certificate, key = self.authority("permissions")
        self.write(f"{name}.p7s", smime.sign(document, certificate, key))

    def replaced(self, name: str, old: str, new: str) -> None:
        """Sign a document in which ``old`` became ``new``."""
        document = self.document(name)
        assert old.encode() in document, (old, document)
        self.resign(name, document.replace(old.encode(), new.encode()))

    def validity(self, begin: datetime, end: datetime) -> None:
        """Sign the permissions for another window."""
        document = self.document("permissions").decode()
        head, _, rest = document.partition("<validity>")
        _, _, tail = rest.partition("</validity>")
        window = f"<not_before>{iso(begin)}</not_before><not_after>{iso(end)}</not_after>"
        self.resign("permissions", f"{head}<validity>{window}</validity>{tail}".encode())

    def crl(self, *revoked: int, begin: timedelta = -DAY, end: timedelta = 30 * DAY) -> None:
        """A revocation list."""
        certificate, key = self.authority("identity")
        made = sign_crl(
            certificate,
            key,
            [RevocationEntry(serial, self.now - DAY) for serial in revoked],
            number=1,
            this_update=self.now + begin,
            next_update=self.now + end,
        )
        self.write("crl.pem", made)


def _foreign_ca(enclave: Enclave) -> tuple[x509.Certificate, PrivateKey]:
    key = generate_key()
    window = Window(enclave.now - DAY, enclave.now + DAY)
    return issue_ca(key, common_name("a foreign CA"), window), key


def _wrong_ca(enclave: Enclave) -> None:
    certificate, key = _foreign_ca(enclave)
    window = Window(enclave.now - DAY, enclave.now + DAY)
    issued = Issuer(certificate, key).issue(
        enclave.certificate.subject, enclave.key.public_key(), window
    )
    enclave.write("cert.pem", pem(issued))


def _ca_expired(enclave: Enclave) -> None:
    certificate, key = enclave.authority("identity")
    window = Window(enclave.now - 30 * DAY, enclave.now - DAY)
    enclave.write("identity_ca.cert.pem", pem(issue_ca(key, certificate.subject, window)))


def _foreign_signature(enclave: Enclave) -> None:
    certificate, key = _foreign_ca(enclave)
    document = enclave.document("permissions")
    enclave.write("permissions.p7s", smime.sign(document, certificate, key))


def _tampered(name: str) -> Callable[[Enclave], None]:
    def tamper(enclave: Enclave) -> None:
        data = (enclave.folder / f"{name}.p7s").read_bytes()
        assert b"true" in data or b"chatter" in data
        enclave.write(f"{name}.p7s", data.replace(b"true", b"TRUE").replace(b"chatter", b"chattel"))

    return tamper


def _other_key(enclave: Enclave) -> None:
    enclave.write("key.pem", (Enclave(enclave.root, OTHER).folder / "key.pem").read_bytes())


def _other_permissions(enclave: Enclave) -> None:
    other = Enclave(enclave.root, OTHER).folder / "permissions.p7s"
    enclave.write("permissions.p7s", other.read_bytes())


def _dangling(enclave: Enclave) -> None:
    (enclave.folder / "identity_ca.cert.pem").unlink()
    (enclave.folder / "identity_ca.cert.pem").symlink_to("nowhere.pem")


BREAKAGES: dict[str, Callable[[Enclave], None]] = {
    "certificate expired": lambda e: e.reissue(-30 * DAY, -DAY),
    "certificate not yet valid": lambda e: e.reissue(DAY, 30 * DAY),
    "certificate of another CA": _wrong_ca,
    "certificate garbage": lambda e: e.write("cert.pem", b"no certificate\n"),
    "revoked": lambda e: e.crl(e.certificate.serial_number),
    "crl expired": lambda e: e.crl(begin=-30 * DAY, end=-DAY),
    "crl garbage": lambda e: e.write("crl.pem", b"no list\n"),
    "ca expired": _ca_expired,
    "key of another enclave": _other_key,
    "key garbage": lambda e: e.write("key.pem", b"no key\n"),
    "key encrypted": lambda e: e.write("key.pem", key_pem(e.key, "secret")),
    "governance tampered": _tampered("governance"),
    "permissions tampered": _tampered("permissions"),
    "permissions of another CA": _foreign_signature,
    "governance unsigned": lambda e: e.write("governance.p7s", e.document("governance")),
    "permissions unsigned": lambda e: e.write("permissions.p7s", e.document("permissions")),
    "permissions expired": lambda e: e.validity(e.now - 30 * DAY, e.now - 2 * DAY),
    "permissions not yet valid": lambda e: e.validity(e.now + 2 * DAY, e.now + 30 * DAY),
    "permissions of another enclave": _other_permissions,
    "domain not in governance": lambda e: e.replaced("governance", "<id>0</id>", "<id>7</id>"),
    "permissions malformed": lambda e: e.replaced("permissions", "<validity>", "<vanity>"),
    "permissions without default": lambda e: e.replaced(
        "permissions", "<default>DENY</default>", ""
    ),
    "governance malformed": lambda e: e.replaced("governance", "ENCRYPT", "ENCIPHER"),
    "file missing": lambda e: (e.folder / "permissions.p7s").unlink(),
    "link to nothing": _dangling,
    "file empty": lambda e: e.write("key.pem", b""),
}
