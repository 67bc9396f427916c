"""What an enclave trusts: certificates, lists and files, written as folders; sound bases of it."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from xml.sax.saxutils import escape

from tests.dds.decision_documents import allow, grant, permissions, publish, subscribe, topic_rule
from tests.integration.vendor_rows import domain_rule, governance
from tests.support.raw_pki import (
    AUTHORITY_KEY,
    SUBJECT_KEY,
    Certificate,
    Entry,
    Extension,
    Message,
    Name,
    RevocationList,
    Signer,
    authority_key,
    basic_constraints,
    integer,
    key_usage,
    name,
    name_der,
    pem,
    private_der,
    purposes,
    subject_key,
)

TOPIC = "rt/a"
DOMAIN = 0
GOVERNANCE = governance(domain_rule())

# ── a trust ────────────────────────────────────────────────────────────────────────────────

IDENTITY, PERMISSIONS, LEAF, PEER = "identity", "permissions", "leaf", "peer"
ISSUER, SIGNING_CA = f"{IDENTITY} 0", f"{PERMISSIONS} 0"
"""The names of the certificates that issue and that sign."""


@dataclass
class SignerPlan:
    """A signer of a document; ``certificate`` names one of the trust."""

    certificate: str = SIGNING_CA
    key: str = ""
    options: dict[str, object] = field(default_factory=dict)


@dataclass
class MessagePlan:
    """How a document is signed; ``certificates`` are put into the message."""

    signers: list[SignerPlan] = field(default_factory=lambda: [SignerPlan()])
    certificates: list[str] = field(default_factory=lambda: [SIGNING_CA])
    lists: list[str] = field(default_factory=list)
    options: dict[str, object] = field(default_factory=dict)


Edit = Callable[[bytes], bytes]
Part = str | bytes
"""The name of a certificate or list of the trust, or bytes as they are."""


@dataclass
class Trust:
    """All certificates, lists and files of an enclave and of a sound peer.

    ``above`` names who issues a certificate; ``files`` lists the parts of CA files, of cert.pem and
    of crl.pem; ``edits`` change the text of a file, ``part_edits`` that of one part of it.
    """

    certificates: dict[str, Certificate]
    above: dict[str, str]
    files: dict[str, list[Part]]
    lists: dict[str, RevocationList] = field(default_factory=dict)
    messages: dict[str, MessagePlan] = field(default_factory=dict)
    edits: dict[str, list[Edit]] = field(default_factory=dict)
    part_edits: dict[tuple[str, int], list[Edit]] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    """Labels of PEM other than CERTIFICATE, by the name of the certificate."""
    grants: list[str] | None = None
    """The subjects of the grants; None: that of the certificate, as OpenSSL prints it."""
    key_form: str = "pkcs8"
    key: str = ""
    """The key in key.pem, where it is not that of the certificate."""
    aliases: dict[str, bytes] = field(default_factory=dict)
    governance: bytes = GOVERNANCE
    on_token: bool = False
    """Whether key.p11 names the key, on a token, in place of key.pem."""
    one_authority: bool = False
    """Whether one CA has both jobs."""

    # ── changes ──

    def below(self, who: str) -> list[str]:
        return [each for each, issuer in self.above.items() if issuer == who and each != who]

    def change(self, who: str, **values: object) -> None:
        self.certificates[who] = replace(self.certificates[who], **values)  # type: ignore[arg-type]

    def rename(self, who: str, subject: Name, *, links: bool = True) -> None:
        """Give a certificate another subject, and with ``links`` to those that name it."""
        old = self.certificates[who]
        own = self.above[who] == who
        self.change(who, subject=subject, **({"issuer": subject} if own else {}))
        if links:
            for each in self.below(who):
                self.change(each, issuer=subject)
            for each, found in self.lists.items():
                if found.issuer == old.subject and found.signing == old.key:
                    self.lists[each] = replace(found, issuer=subject)

    def rekey(self, who: str, label: str) -> None:
        """Give a certificate another key, with which it signs what it has signed."""
        old = self.certificates[who]
        values: dict[str, object] = {"key": label}
        if self.above[who] == who:
            values["signing"] = label
        self.change(who, **values)
        if any(each.dotted == SUBJECT_KEY for each in old.extensions):
            self.certificates[who] = self.certificates[who].with_extension(subject_key(label))
        for each in [*self.below(who), *([who] if self.above[who] == who else [])]:
            self.change(each, signing=label)
            if any(found.dotted == AUTHORITY_KEY for found in self.certificates[each].extensions):
                linked = self.certificates[each].with_extension(authority_key(label))
                self.certificates[each] = linked
        for each, found in self.lists.items():
            if found.issuer == old.subject and found.signing == old.key:
                self.lists[each] = replace(found, signing=label)

    def edit(self, file: str, edit: Edit) -> None:
        self.edits.setdefault(file, []).append(edit)

    # ── files ──

    def write(self, own: Path, peer: Path, now: datetime) -> None:
        """Write the folders of the enclave and of its peer."""
        written = self.contents(now)
        own.mkdir(parents=True)
        peer.mkdir(parents=True)
        for file, data in written.items():
            (own / file).write_bytes(data)
        if self.on_token:
            (own / "key.p11").write_bytes(written["key.p11"].replace(b"{folder}", bytes(own)))
            (own / "pin").write_text("1234")
            (own / "pin").chmod(0o600)
        for file in (f"{IDENTITY}_ca.cert.pem", f"{PERMISSIONS}_ca.cert.pem", "crl.pem"):
            if file in written:
                (peer / file).write_bytes(written[file])
        certificate = self.certificates[PEER]
        (peer / "cert.pem").write_bytes(pem("CERTIFICATE", certificate.der(now)))
        (peer / "key.pem").write_bytes(pem(*private_der(certificate.key)))
        for file, document in (
            ("governance.p7s", self.governance),
            ("permissions.p7s", _permissions([openssl_text(certificate.subject)])),
        ):
            (peer / file).write_bytes(self._signed(MessagePlan(), document, now))

    def contents(self, now: datetime) -> dict[str, bytes]:
        """Return the files of the enclave."""
        leaf = self.certificates[LEAF]
        found = {
            file: b"".join(self._part(file, place, part, now) for place, part in enumerate(parts))
            for file, parts in self.files.items()
        }
        if self.on_token:
            found["key.p11"] = token_uri(self.key or leaf.key).encode() + b"\n"
        else:
            found["key.pem"] = pem(*private_der(self.key or leaf.key, self.key_form))
        subjects = self.grants if self.grants is not None else [openssl_text(leaf.subject)]
        for file, document in (
            ("governance.p7s", self.governance),
            ("permissions.p7s", _permissions(subjects)),
        ):
            found[file] = self._signed(self.messages.get(file, MessagePlan()), document, now)
        for file, edits in self.edits.items():
            for edit in edits:
                if file in found:
                    found[file] = edit(found[file])
        return found

    def _part(self, file: str, place: int, part: Part, now: datetime) -> bytes:
        if isinstance(part, bytes):
            data = part
        elif part in self.lists:
            data = pem("X509 CRL", self.lists[part].der(now))
        else:
            label = self.labels.get(part, "CERTIFICATE")
            der = self.certificates[part].der(now)
            data = pem(label, der + self.aliases.get(part, b""))
        for edit in self.part_edits.get((file, place), ()):
            data = edit(data)
        return data

    def _signed(self, plan: MessagePlan, document: bytes, now: datetime) -> bytes:
        signers = tuple(
            Signer(
                self.certificates[each.certificate],
                each.key or self.certificates[each.certificate].key,
                **each.options,  # type: ignore[arg-type]
            )
            for each in plan.signers
        )
        inside = tuple(self.certificates[each] for each in plan.certificates)
        lists = tuple(self.lists[each] for each in plan.lists)
        return Message(signers, inside, lists, **plan.options).write(document, now)  # type: ignore[arg-type]


def token_uri(key: str) -> str:
    """Return where a key lies on the token that `tests.integration.trust.replies` makes.

    `Trust.write` puts the enclave's folder in it, where the PIN lies.
    """
    label = key.replace(" ", "-")
    return f"pkcs11:token=robot-{label};object={label};type=private?pin-source=file:{{folder}}/pin"


def _permissions(subjects: Iterable[str]) -> bytes:

    rule = allow(publish("*"), subscribe("*"), domains=f"<id>{DOMAIN}</id>")
    return permissions(*(grant(rule, subject=escape(each)) for each in subjects))


# ── names as OpenSSL prints them ───────────────────────────────────────────────────────────

RFC2253, ONELINE = 0x1110317, 0x82021F
ESCAPES_MSB = 4


@cache
def _libcrypto() -> ctypes.CDLL:
    library = ctypes.CDLL("libcrypto.so.3")
    pointer = ctypes.c_void_p
    for each in ("d2i_X509_NAME", "BIO_new", "BIO_s_mem", "X509_NAME_oneline"):
        getattr(library, each).restype = pointer
    library.d2i_X509_NAME.argtypes = [pointer, pointer, ctypes.c_long]
    library.BIO_new.argtypes = [pointer]
    library.X509_NAME_print_ex.argtypes = [pointer, pointer, ctypes.c_int, ctypes.c_ulong]
    library.BIO_read.argtypes = [pointer, ctypes.c_char_p, ctypes.c_int]
    library.X509_NAME_oneline.argtypes = [pointer, ctypes.c_char_p, ctypes.c_int]
    library.BIO_free.argtypes = [pointer]
    library.X509_NAME_free.argtypes = [pointer]
    return library


def openssl_text(of: Name, flags: int = RFC2253) -> str:
    """Return a name as OpenSSL prints it: by these flags, or with 0 as X509_NAME_oneline does."""
    library, data = _libcrypto(), name_der(of)
    at = ctypes.cast(ctypes.create_string_buffer(data, len(data)), ctypes.c_void_p)
    read = library.d2i_X509_NAME(None, ctypes.byref(at), len(data))
    if not read:
        library.ERR_clear_error()  # a process that is forked would take it for an error of its own
        return ""
    text = ctypes.create_string_buffer(5000)
    if flags:
        out = library.BIO_new(library.BIO_s_mem())
        library.X509_NAME_print_ex(out, read, 0, flags)
        size = library.BIO_read(out, text, 5000)
        found = text.raw[: max(size, 0)]
        library.BIO_free(out)
    else:
        library.X509_NAME_oneline(read, text, 5000)
        found = text.value
    library.X509_NAME_free(read)
    shown = found.decode("utf-8", "replace")
    return re.sub(r"[\0-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]", "?", shown)  # XML cannot hold these


# ── bases ──────────────────────────────────────────────────────────────────────────────────

CERTIFIES = ("keyCertSign", "cRLSign")
EVERYTHING = ("digitalSignature", *CERTIFIES)


def authority(
    subject: str, label: str, serial: int, *usages: str, above: Certificate | None = None,
    length: int | None = None, plain: bool = False, more: tuple[Extension, ...] = (),
) -> Certificate:  # fmt: skip
    issuer, signing = (above.subject, above.key) if above else (name(subject), label)
    extensions: tuple[Extension, ...] = (basic_constraints(True, length),)
    if usages:
        extensions += (key_usage(*usages),)
    if not plain:
        extensions += (subject_key(label), authority_key(signing))
    return Certificate(name(subject), issuer, label, signing, serial, extensions + more)


def _leaf(
    subject: str, label: str, above: Certificate, serial: int, *, plain: bool = False,
    more: tuple[Extension, ...] = (),
) -> Certificate:  # fmt: skip
    extensions: tuple[Extension, ...] = (basic_constraints(False),)
    if not plain:
        usage = key_usage("digitalSignature")
        extensions += (usage, subject_key(label), authority_key(above.key))
    return Certificate(name(subject), above.subject, label, above.key, serial, extensions + more)


def _trust(
    identity: list[Certificate],
    signing: list[Certificate],
    leaf: str = "CN=/t",
    key: str = "p256 8",
    *,
    plain: bool = False,
    more: tuple[Extension, ...] = (),
    peer: str = "CN=/peer",
    peer_key: str = "p256 9",
) -> Trust:
    """Return the trust with chains of CAs, the one that issues or signs first."""
    certificates = {f"{IDENTITY} {place}": each for place, each in enumerate(identity)}
    certificates |= {f"{PERMISSIONS} {place}": each for place, each in enumerate(signing)}
    above = {}
    for role, chain in ((IDENTITY, identity), (PERMISSIONS, signing)):
        for place in range(len(chain)):
            above[f"{role} {place}"] = f"{role} {min(place + 1, len(chain) - 1)}"
    certificates[LEAF] = _leaf(leaf, key, identity[0], 1001, plain=plain, more=more)
    certificates[PEER] = _leaf(peer, peer_key, identity[0], 1002, plain=plain, more=more)
    above |= {LEAF: ISSUER, PEER: ISSUER}
    files: dict[str, list[Part]] = {
        f"{IDENTITY}_ca.cert.pem": [f"{IDENTITY} {place}" for place in range(len(identity))],
        f"{PERMISSIONS}_ca.cert.pem": [f"{PERMISSIONS} {place}" for place in range(len(signing))],
        "cert.pem": [LEAF],
    }
    return Trust(certificates, above, files)


IDENTITY_FILE, PERMISSIONS_FILE = f"{IDENTITY}_ca.cert.pem", f"{PERMISSIONS}_ca.cert.pem"


def own() -> Trust:
    return _trust(
        [authority("CN=sros identity CA", "p256 0", 11, *EVERYTHING)],
        [authority("CN=sros permissions CA", "p256 1", 12, *EVERYTHING)],
    )


def sros2() -> Trust:
    ca = authority("CN=sros2CA", "p256 0", 21, length=1, plain=True)
    made = _trust([ca], [ca], plain=True)
    made.one_authority = True
    return made


def corporate_rsa() -> Trust:
    subject = "C=DE,O=Example GmbH,OU=IT Security,CN=Example {} CA"
    more = (purposes("1.3.6.1.5.5.7.3.1", "1.3.6.1.5.5.7.3.2"),)
    return _trust(
        [authority(subject.format("Robot"), "rsa2048 0", 0xA1B2C3D4E5F60718, *CERTIFIES)],
        [authority(subject.format("Signing"), "rsa2048 1", 0xA1B2C3D4E5F60719, *EVERYTHING)],
        more=more,
    )


def corporate_ec() -> Trust:
    subject = "DC=com,DC=example,O=Example,CN=Example {} CA"
    return _trust(
        [authority(subject.format("Device"), "p256 0", 2**80 + 5, *CERTIFIES, length=0)],
        [authority(subject.format("Policy"), "p256 1", 2**80 + 6, *EVERYTHING, length=0)],
        "O=Example,OU=Robots,CN=/t", peer="O=Example,OU=Robots,CN=/peer",
    )  # fmt: skip


def _chain(role: str, number: int, *usages: str) -> list[Certificate]:
    root = authority(f"O=Example,CN={role} root", f"p256 {number}", number + 30, *EVERYTHING)
    below = authority(
        f"O=Example,CN={role} intermediate", f"p256 {number + 1}", number + 40, *usages,
        above=root, length=0,
    )  # fmt: skip
    return [below, root]


def signing_intermediate() -> Trust:
    made = _trust(
        [authority("O=Example,CN=identity CA", "p256 0", 11, *CERTIFIES)],
        _chain("permissions", 2, *EVERYTHING),
    )
    made.files[PERMISSIONS_FILE].reverse()
    return made


def issuing_intermediate() -> Trust:
    """The only base that Cyclone DDS refuses: it takes no identity CA below another."""
    ca = authority("O=Example,CN=permissions CA", "p256 1", 12, *EVERYTHING)
    return _trust(_chain("identity", 4, *CERTIFIES), [ca])


def two_authorities() -> Trust:
    made = own()
    for number, (role, file) in enumerate(
        ((IDENTITY, IDENTITY_FILE), (PERMISSIONS, PERMISSIONS_FILE))
    ):
        other = f"{role} other"
        subject = f"CN=other {role} CA"
        made.certificates[other] = authority(
            subject, f"p256 {number + 2}", 50 + number, *EVERYTHING
        )
        made.above[other] = other
        made.files[file].append(other)
    return made


def rsa_keys() -> Trust:
    made = _trust(
        [authority("CN=identity CA,O=x", "rsa2048 0", 61, *EVERYTHING)],
        [authority("CN=permissions CA,O=x", "p256 1", 62, *EVERYTHING)],
        key="rsa2048 2", peer_key="rsa2048 3",
    )  # fmt: skip
    made.key_form = "traditional"
    return made


def renewed() -> Trust:
    made = own()
    for role, file in ((IDENTITY, IDENTITY_FILE), (PERMISSIONS, PERMISSIONS_FILE)):
        old, now = f"{role} other", f"{role} 0"
        made.certificates[old] = replace(made.certificates[now], serial=71, days=(-60, 10))
        made.above[old] = old
        made.files[file] = [now, old]
    return made


def rotated() -> Trust:
    made = renewed()
    for number, role in enumerate((IDENTITY, PERMISSIONS)):
        made.rekey(f"{role} other", f"p256 {number + 4}")
    return made


def list_of(trust: Trust, who: str, *serials: int, number: int = 3) -> RevocationList:
    ca = trust.certificates[who]
    extensions = (Extension("2.5.29.20", integer(number)), authority_key(ca.key))
    return RevocationList(ca.subject, ca.key, tuple(map(Entry, serials)), extensions)


def with_list() -> Trust:
    made = own()
    made.lists["list 0"] = list_of(made, ISSUER, 5, 77)
    made.files["crl.pem"] = ["list 0"]
    return made


def on_token() -> Trust:
    made = own()
    made.on_token = True
    return made


def free_topics() -> Trust:
    """No access control: neither of the domain nor of topics."""
    made = own()
    rule = topic_rule(read=False, write=False)
    made.governance = governance(domain_rule(rule, join=False))
    return made


BASES: dict[str, Callable[[], Trust]] = {
    "own": own,
    "sros2": sros2,
    "corporate RSA": corporate_rsa,
    "corporate EC": corporate_ec,
    "signing intermediate": signing_intermediate,
    "issuing intermediate": issuing_intermediate,
    "two CAs": two_authorities,
    "RSA keys": rsa_keys,
    "renewed": renewed,
    "rotated": rotated,
    "with a list": with_list,
    "on a token": on_token,
    "free topics": free_topics,
}
