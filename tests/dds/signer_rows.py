"""Who may sign, and which CA files are taken: enclaves made each in one way, and what vendors do.

``YES`` is started and matched with an enclave made in the same way, ``REFUSED`` not started.  Runs
of Fast DDS 2.9.1, Fast DDS 2.14.5, Cyclone DDS 0.10.2 and 11.0.1.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, padding, rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.name import _ASN1Type
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from sros_tool.dds.decision.vendors import CYCLONE_DDS, Vendor
from sros_tool.pki import smime
from sros_tool.pki.certificates import common_name, parse_subject, pem
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key

YES, REFUSED, CRASHED, UNMATCHED = "matched", "refused", "crashed", "unmatched"
PSS = padding.PSS(padding.MGF1(hashes.SHA256()), padding.PSS.DIGEST_LENGTH)
NOW = datetime.now(UTC).replace(microsecond=0)
DAY = timedelta(days=1)
Pair = tuple[x509.Certificate, PrivateKey]
Digest = hashes.SHA256 | hashes.SHA384 | hashes.SHA512

SIGNS, CERTIFIES = "signs", "certifies"
"""The keyUsages digitalSignature, and keyCertSign with cRLSign."""


def authority(
    name: str,
    usage: str | None = f"{SIGNS} {CERTIFIES}",
    *,
    by: Pair | None = None,
    key: PrivateKey | None = None,
    days: tuple[int, int] = (-30, 30),
    purpose: x509.ObjectIdentifier | None = None,
    digest: Digest | None = None,
    serial: int | None = None,
    is_ca: bool | None = True,
    identifiers: bool = True,
    lists: bool = True,
    pss: bool = False,
    also: x509.ExtensionType | None = None,
) -> Pair:
    """A certificate for CAs (or with ``is_ca`` false another) and its key.

    ``is_ca`` None is none of both; without ``lists`` it may not sign revocation lists.  ``also`` is
    another extension, which is critical.
    """
    key = key or generate_key()
    issuer, signing = by or (None, key)
    public = key.public_key()
    builder = x509.CertificateBuilder(
        issuer.subject if issuer else common_name(name),
        common_name(name),
        public,
        serial or x509.random_serial_number(),
        NOW + days[0] * DAY,
        NOW + days[1] * DAY,
    )
    if is_ca is not None:
        builder = builder.add_extension(x509.BasicConstraints(is_ca, None), critical=True)
    if also is not None:
        builder = builder.add_extension(also, critical=True)
    if usage is not None:
        signs, certifies = SIGNS in usage.split(), CERTIFIES in usage.split()
        lists = lists and certifies
        flags = x509.KeyUsage(signs, False, False, False, False, certifies, lists, False, False)
        builder = builder.add_extension(flags, critical=True)
    if purpose:
        builder = builder.add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    if identifiers:
        above = issuer.public_key() if issuer else public
        builder = builder.add_extension(
            x509.SubjectKeyIdentifier.from_public_key(public), critical=False
        ).add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(above),  # type: ignore[arg-type]
            critical=False,
        )
    return builder.sign(signing, digest or hashes.SHA256(), rsa_padding=PSS if pss else None), key


def signed_by(pair: Pair, *options: str, also: Pair | None = None) -> Callable[[bytes], bytes]:
    """How documents are signed; with options or a second signer by ``openssl smime``."""

    def sign(document: bytes) -> bytes:
        if not options and not also:
            return smime.sign(document, *pair)
        with TemporaryDirectory() as folder:
            command = ["openssl", "smime", "-sign", "-text", *options]
            for number, each in enumerate(filter(None, (pair, also))):
                signer = Path(folder, f"{number}.pem")
                signer.write_bytes(pem(each[0]) + key_pem(each[1]))
                command += ["-signer", str(signer)]
            return subprocess.run(command, input=document, check=True, capture_output=True).stdout

    return sign


@dataclass(frozen=True)
class Revocation:
    """A revocation list of a CA; it may name the enclave, or have only changes of another list."""

    by: Pair
    days: tuple[int, int] = (-1, 5)
    names_enclave: bool = False
    changes: bool = False
    digest: Digest = field(default_factory=hashes.SHA256)

    def pem(self, enclave: x509.Certificate) -> bytes:
        authority, key = self.by
        builder = x509.CertificateRevocationListBuilder(
            authority.subject, NOW + self.days[0] * DAY, NOW + self.days[1] * DAY
        ).add_extension(x509.CRLNumber(2), critical=False)
        if self.changes:
            builder = builder.add_extension(x509.DeltaCRLIndicator(1), critical=True)
        serial = enclave.serial_number if self.names_enclave else 4711
        entry = x509.RevokedCertificateBuilder(serial, NOW - DAY).build()
        made = builder.add_revoked_certificate(entry).sign(key, self.digest)
        return made.public_bytes(Encoding.PEM)


@dataclass(frozen=True)
class Made:
    """How the enclaves of a row are made.

    ``issuer`` issues their certificates with ``digest``, ``sign`` signs their documents; the CA
    files consist of ``identity`` and ``permissions``, in that order.  ``lists`` are in ``crl.pem``,
    and ``lists_of_identity`` behind the certificates of ``identity``.
    """

    sign: Callable[[bytes], bytes] | None = None
    permissions: tuple[Pair, ...] = ()
    issuer: Pair | None = None
    identity: tuple[Pair, ...] = ()
    own_signer: bool = False
    """Every enclave signs its own permissions, with the key of its identity."""
    digest: Digest = field(default_factory=hashes.SHA256)
    lists: tuple[Revocation, ...] = ()
    lists_of_identity: tuple[Revocation, ...] = ()
    pss: bool = False
    """The certificates of enclaves are signed with RSA-PSS."""
    named: x509.Name | None = None
    """The issuer that they name; else the subject of their CA."""
    edit: Callable[[Path], object] | None = None
    """What is done to the files of an enclave at last."""
    key: Callable[[], PrivateKey | ed25519.Ed25519PrivateKey] = generate_key


@dataclass(frozen=True)
class Row:
    """What Fast DDS 2.9.1, its other releases, and Cyclone DDS 0.10 do with one."""

    name: str
    made: Made
    fast: str
    later: str
    cyclone: str

    def answer(self, vendor: Vendor) -> str:
        """Return what a vendor does."""
        if vendor in CYCLONE_DDS:
            others = ON_CYCLONE_11 if vendor is Vendor.CYCLONE_11 else {}
            return others.get(self.name, self.cyclone)
        return self.fast if vendor is Vendor.FAST_2_9 else self.later


ON_CYCLONE_11 = {
    "-nocerts": YES,
    "a CA for clientAuth": YES,
    "a CA for serverAuth": YES,
    "a CA that only certifies": YES,
    "a leaf below the CA signs": REFUSED,
    "a renewed CA of the same key and serial number": YES,
    "an expired CA": YES,
    "an intermediate that may sign signs, the CA alone in the file": REFUSED,
    "an intermediate without keyUsage signs, the CA alone in the file": REFUSED,
    "intermediate (may sign) and root": YES,
    "intermediate (no keyUsage) and root": YES,
    "intermediate (only certifies) and root": YES,
    "intermediate alone": YES,
    "one CA for both jobs, the enclave signs for itself": REFUSED,
    "root and intermediate that may sign, which signs": REFUSED,
    "two signers, the CA and a leaf below": REFUSED,
}
"""What Cyclone DDS 11.0.1 does otherwise than 0.10."""


def write_enclave(
    row: Row, folder: Path, subject: str | x509.Name, governance: bytes, permissions: bytes
) -> None:
    """All files of an enclave as the row has them made."""
    made = row.made
    issuer = made.issuer or ROOT
    key = made.key()
    name = parse_subject(subject) if isinstance(subject, str) else subject
    certificate = (
        x509.CertificateBuilder(
            made.named or issuer[0].subject,
            name,
            key.public_key(),
            x509.random_serial_number(),
            NOW - DAY,
            NOW + DAY,
        )
        .add_extension(x509.BasicConstraints(False, None), critical=True)
        .sign(issuer[1], made.digest, rsa_padding=PSS if made.pss else None)
    )
    sign = made.sign or signed_by(made.permissions[0] if made.permissions else SIGNER)
    folder.mkdir()
    plain = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (folder / "key.pem").write_bytes(plain)
    (folder / "cert.pem").write_bytes(pem(certificate))
    for role, pairs in (
        ("identity", made.identity or (issuer,)),
        ("permissions", made.permissions or (SIGNER,)),
    ):
        data = b"".join(pem(each) for each, _ in pairs)
        if role == "identity":
            data += b"".join(each.pem(certificate) for each in made.lists_of_identity)
        (folder / f"{role}_ca.cert.pem").write_bytes(data)
    if made.lists:
        data = b"".join(each.pem(certificate) for each in made.lists)
        (folder / "crl.pem").write_bytes(data)
    (folder / "governance.p7s").write_bytes(sign(governance))
    if made.own_signer:
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        sign = signed_by((certificate, key))
    (folder / "permissions.p7s").write_bytes(sign(permissions))
    if made.edit:
        made.edit(folder)


IDENTITY, PERMISSIONS, LEAF, KEY = (
    "identity_ca.cert.pem", "permissions_ca.cert.pem", "cert.pem", "key.pem"
)  # fmt: skip


def replaced(name: str, old: bytes, new: bytes) -> Callable[[Path], object]:
    """How the bytes ``old`` become ``new`` in a file; b"" is its start."""

    def edit(folder: Path) -> None:
        data = (folder / name).read_bytes()
        assert old in data
        (folder / name).write_bytes(data.replace(old, new) if old else new + data)

    return edit


def appended(name: str, data: bytes) -> Callable[[Path], object]:
    """How bytes are appended to a file."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes() + data)


def short_key(folder: Path) -> None:
    """Write the key as older OpenSSL does: SEC 1, behind the parameters of its curve."""
    key = load_key((folder / KEY).read_bytes(), KEY)
    plain = key.private_bytes(Encoding.PEM, PrivateFormat.TraditionalOpenSSL, NoEncryption())
    parameters = b"-----BEGIN EC PARAMETERS-----\nBggqhkjOPQMBBw==\n-----END EC PARAMETERS-----\n"
    (folder / KEY).write_bytes(parameters + plain)


ROOT = authority("identity CA")
SIGNER = authority("permissions CA")


def rows() -> list[Row]:
    """All rows, with CAs made for this moment."""
    expired = authority("old CA", days=(-30, -1))
    certifying = authority("permissions CA", CERTIFIES)
    below_plain = authority("sub CA", None, by=SIGNER)
    below_certifying = authority("sub CA", CERTIFIES, by=SIGNER)
    below_both = authority("sub CA", by=SIGNER)
    leaf = authority("leaf", SIGNS, by=SIGNER, is_ca=False)
    renewed = authority("permissions CA", key=SIGNER[1])
    same_serial = authority("permissions CA", key=SIGNER[1], serial=SIGNER[0].serial_number)
    other = authority("other CA")
    with_rsa = authority("permissions CA", key=rsa.generate_private_key(65537, 2048))
    identity_below_plain = authority("identity sub CA", None, by=ROOT)
    identity_below = authority("identity sub CA", CERTIFIES, by=ROOT)
    purposes = {
        "serverAuth": ExtendedKeyUsageOID.SERVER_AUTH,
        "clientAuth": ExtendedKeyUsageOID.CLIENT_AUTH,
    }
    chained = (below_plain, below_certifying, below_both)
    return [
        Row("the permissions CA signs", Made(), YES, YES, YES),
        Row("a stranger signs", Made(signed_by(other)), REFUSED, REFUSED, REFUSED),
        Row("a leaf below the CA signs", Made(signed_by(leaf)), YES, REFUSED, YES),
        Row(
            "an intermediate without keyUsage signs, the CA alone in the file",
            Made(signed_by(below_plain)), YES, REFUSED, YES,
        ),
        Row(
            "an intermediate that may sign signs, the CA alone in the file",
            Made(signed_by(below_both)), YES, REFUSED, YES,
        ),
        Row(
            "an intermediate that only certifies signs, the CA alone in the file",
            Made(signed_by(below_certifying)), REFUSED, REFUSED, REFUSED,
        ),
        Row(
            "one CA for both jobs, the enclave signs for itself",
            Made(permissions=(ROOT,), own_signer=True), YES, REFUSED, YES,
        ),
        Row("opaque", Made(signed_by(SIGNER, "-nodetach")), YES, YES, YES),
        Row("-nocerts", Made(signed_by(SIGNER, "-nocerts")), REFUSED, YES, REFUSED),
        *(
            Row(
                f"signed with {digest}",
                Made(signed_by(with_rsa, "-md", digest), (with_rsa,)), YES, YES, YES,
            )
            for digest in ("md5", "sha224", "sha512-256", "sha3-256")
        ),
        Row("without attributes", Made(signed_by(SIGNER, "-noattr")), YES, YES, YES),
        Row(
            "two signers, both are the CA", Made(signed_by(SIGNER, also=SIGNER)), YES, YES, YES
        ),
        Row(
            "two signers, the CA and a leaf below", Made(signed_by(SIGNER, also=leaf)),
            YES, REFUSED, YES,
        ),
        Row(
            "two signers, both in the file of the CA",
            Made(signed_by(SIGNER, also=other), (SIGNER, other)), YES, YES, REFUSED,
        ),
        Row(
            "two signers, the CA and a stranger", Made(signed_by(SIGNER, also=other)),
            REFUSED, REFUSED, REFUSED,
        ),
        Row(
            "a CA that only certifies", Made(permissions=(certifying,)), REFUSED, YES, REFUSED
        ),
        *(
            Row(
                f"a CA for {name}",
                Made(permissions=(authority("permissions CA", purpose=purpose),)),
                REFUSED, YES, REFUSED,
            )
            for name, purpose in purposes.items()
        ),
        Row(
            "a CA for emailProtection",
            Made(
                permissions=(
                    authority("CA", purpose=ExtendedKeyUsageOID.EMAIL_PROTECTION),
                )
            ),
            YES, YES, YES,
        ),
        Row(
            "a CA that signs and does not certify",
            Made(permissions=(authority("permissions CA", SIGNS),)), YES, REFUSED, YES,
        ),
        Row(
            "a CA without keyUsage and identifiers",
            Made(permissions=(authority("permissions CA", None, identifiers=False),)),
            YES, YES, YES,
        ),
        Row(
            "a valid CA and an expired one, which signs",
            Made(signed_by(expired), (SIGNER, expired)), REFUSED, YES, REFUSED,
        ),
        Row(
            "an expired CA and a valid one, which signs",
            Made(signed_by(SIGNER), (expired, SIGNER)), YES, REFUSED, REFUSED,
        ),
        Row("an expired CA", Made(permissions=(expired,)), REFUSED, REFUSED, REFUSED),
        Row(
            "a renewed CA and the old one of the same key, which signs",
            Made(signed_by(SIGNER), (renewed, SIGNER)), REFUSED, YES, REFUSED,
        ),
        Row(
            "the old CA, which signs, and a renewed one of the same key",
            Made(signed_by(SIGNER), (SIGNER, renewed)), YES, YES, YES,
        ),
        Row(
            "a renewed CA of the same key alone", Made(signed_by(SIGNER), (renewed,)),
            REFUSED, REFUSED, REFUSED,
        ),
        Row(
            "a renewed CA of the same key and serial number",
            Made(signed_by(SIGNER), (same_serial,)), REFUSED, YES, REFUSED,
        ),
        Row(
            "root and intermediate that only certifies, which signs",
            Made(signed_by(below_certifying), (SIGNER, below_certifying)), REFUSED, YES, REFUSED,
        ),
        Row(
            "root and intermediate that may sign, which signs",
            Made(signed_by(below_both), (SIGNER, below_both)), YES, YES, YES,
        ),
        *(
            Row(
                f"intermediate ({name}) and root", Made(permissions=(each, SIGNER)), fast, later,
                REFUSED,
            )
            for each, name, fast, later in zip(
                chained,
                ("no keyUsage", "only certifies", "may sign"),
                (YES, REFUSED, YES),
                (REFUSED, YES, YES),
                strict=True,
            )
        ),
        Row(
            "intermediate alone", Made(permissions=(below_both,)), REFUSED, REFUSED, REFUSED
        ),
        *(
            Row(
                f"permissions CA with {digest.name}",
                Made(permissions=(authority("permissions CA", digest=digest),)),
                REFUSED, REFUSED, YES,
            )
            for digest in (hashes.SHA384(), hashes.SHA512())
        ),
        *(
            Row(
                f"identity CA with {digest.name}",
                Made(issuer=authority("identity CA", digest=digest)),
                REFUSED, REFUSED, YES,
            )
            for digest in (hashes.SHA384(), hashes.SHA512())
        ),
        Row("a leaf with sha384", Made(digest=hashes.SHA384()), REFUSED, REFUSED, YES),
        Row(
            "two identity CAs, the first issues", Made(issuer=ROOT, identity=(ROOT, other)),
            YES, YES, YES,
        ),
        Row(
            "two identity CAs, the second issues", Made(issuer=ROOT, identity=(other, ROOT)),
            YES, YES, REFUSED,
        ),
        Row(
            "an expired identity CA and a valid one, which issues",
            Made(issuer=ROOT, identity=(expired, ROOT)), YES, REFUSED, REFUSED,
        ),
        Row(
            "identity intermediate and root",
            Made(issuer=identity_below, identity=(identity_below, ROOT)), YES, YES, REFUSED,
        ),
        Row(
            "identity intermediate without keyUsage and root",
            Made(issuer=identity_below_plain, identity=(identity_below_plain, ROOT)),
            YES, REFUSED, REFUSED,
        ),
        Row(
            "identity intermediate alone", Made(issuer=identity_below), REFUSED, REFUSED, REFUSED
        ),
        Row(
            "root and identity intermediate, which issues",
            Made(issuer=identity_below, identity=(ROOT, identity_below)), YES, YES, REFUSED,
        ),
        *list_rows(other, identity_below),
        *certificate_rows(),
        *file_rows(),
    ]  # fmt: skip


def list_rows(other: Pair, below: Pair) -> list[Row]:
    """Rows with revocation lists; ``other`` is another CA, ``below`` one that `KEYSTORE` issued."""
    no_lists = authority("identity CA", lists=False)
    below_no_lists = authority("identity sub CA", by=ROOT, lists=False)
    expired = Revocation(ROOT, (-5, -1))
    return [
        Row("a list", Made(lists=(Revocation(ROOT),)), YES, YES, YES),
        Row(
            "a list with sha512", Made(lists=(Revocation(ROOT, digest=hashes.SHA512()),)),
            YES, YES, YES,
        ),
        *(
            Row(f"a list that {name}", Made(lists=(each,)), REFUSED, REFUSED, REFUSED)
            for name, each in {
                "names the enclave": Revocation(ROOT, names_enclave=True),
                "has expired": expired,
                "is of the future": Revocation(ROOT, (1, 5)),
                "is of another CA": Revocation(other),
                "has only changes": Revocation(ROOT, changes=True),
            }.items()
        ),
        Row(
            "a list of a CA without cRLSign",
            Made(issuer=no_lists, lists=(Revocation(no_lists),)), REFUSED, REFUSED, REFUSED,
        ),
        Row(
            "the second list is of the CA", Made(lists=(Revocation(other), Revocation(ROOT))),
            REFUSED, REFUSED, REFUSED,
        ),
        Row(
            "the second list has expired", Made(lists=(Revocation(ROOT), expired)), YES, YES, YES
        ),
        Row("a list in the CA file", Made(lists_of_identity=(Revocation(ROOT),)), YES, YES, YES),
        *(
            Row(
                f"a list in the CA file that {name}", Made(lists_of_identity=(each,)),
                REFUSED, REFUSED, YES,
            )
            for name, each in {
                "names the enclave": Revocation(ROOT, names_enclave=True),
                "has expired": expired,
                "is of another CA": Revocation(other),
            }.items()
        ),
        Row(
            "a list of another CA, and that of the CA in its file",
            Made(lists=(Revocation(other),), lists_of_identity=(Revocation(ROOT),)),
            YES, YES, REFUSED,
        ),
        Row(
            "two identity CAs, the second issues, with its list",
            Made(issuer=ROOT, identity=(other, ROOT), lists=(Revocation(ROOT),)),
            YES, YES, REFUSED,
        ),
        Row(
            "intermediate and root, with the list of the intermediate",
            Made(issuer=below, identity=(below, ROOT), lists=(Revocation(below),)),
            YES, YES, REFUSED,
        ),
        Row(
            "intermediate and root, with the list of the root",
            Made(issuer=below, identity=(below, ROOT), lists=(Revocation(ROOT),)),
            REFUSED, REFUSED, REFUSED,
        ),
        Row(
            "intermediate without cRLSign and root, with its list",
            Made(
                issuer=below_no_lists, identity=(below_no_lists, ROOT),
                lists=(Revocation(below_no_lists),),
            ),
            REFUSED, REFUSED, REFUSED,
        ),
    ]  # fmt: skip


def certificate_rows() -> Iterator[Row]:
    """Certificates as companies issue them."""
    rsa_key = rsa.generate_private_key(65537, 2048)
    pss = authority("identity CA", key=rsa_key, pss=True)
    pkcs = authority("identity CA", key=rsa_key)
    yield Row("an identity CA with RSA-PSS", Made(issuer=pss), REFUSED, REFUSED, YES)
    yield Row("a permissions CA with RSA-PSS", Made(permissions=(pss,)), REFUSED, REFUSED, YES)
    yield Row("a leaf with RSA-PSS", Made(issuer=pkcs, pss=True), REFUSED, REFUSED, YES)
    both = Made(issuer=ROOT, identity=(authority("other CA", key=rsa_key, pss=True), ROOT))
    yield Row("a CA with RSA-PSS before the one that issues", both, YES, CRASHED, REFUSED)
    twin = authority("identity CA", identifiers=False)
    plain = authority("identity CA", identifiers=False)
    both = Made(issuer=plain, identity=(twin, plain))
    yield Row("another CA of the same name before it", both, REFUSED, REFUSED, REFUSED)
    old = authority("identity CA", is_ca=None)
    yield Row("a CA without basicConstraints", Made(issuer=old), YES, REFUSED, YES)
    silent = authority("identity CA", None, is_ca=None)
    yield Row("a CA that says nothing of it", Made(issuer=silent), REFUSED, REFUSED, REFUSED)
    for usage, later in ((f"{SIGNS} {CERTIFIES}", REFUSED), (None, YES)):
        signer = authority("permissions CA", usage, is_ca=None)
        name = f"a permissions CA without basicConstraints, {usage or 'without keyUsage'}"
        yield Row(name, Made(permissions=(signer,)), YES, later, YES)
    policy = x509.PolicyInformation(x509.ObjectIdentifier("1.2.3.4"), None)
    policies = authority("identity CA", also=x509.CertificatePolicies([policy]))
    yield Row("a CA with critical policies", Made(issuer=policies), YES, YES, YES)
    for excluded, answer in (("/t", REFUSED), ("robot.example", YES)):
        base = x509.DirectoryName(common_name(excluded))
        constraints = x509.NameConstraints(None, [base])
        made = Made(issuer=authority("identity CA", also=constraints))
        yield Row(f"nameConstraints that exclude CN={excluded}", made, answer, answer, answer)
    kind = _ASN1Type.PrintableString
    text = x509.NameAttribute(NameOID.COMMON_NAME, " IDENTITY  ca", kind)
    named = Made(named=x509.Name([text]))
    yield Row("an issuer in other letters, blanks and string type", named, YES, YES, YES)
    young = Made(key=ed25519.Ed25519PrivateKey.generate)
    yield Row("an Ed25519 key", young, UNMATCHED, UNMATCHED, REFUSED)


def file_rows() -> Iterator[Row]:
    """PEM as it comes out of templates, mail and other programs."""
    begin, end = b"-----BEGIN CERTIFICATE-----\n", b"-----END CERTIFICATE-----\n"
    for name, edit in {
        "an indented CA file": replaced(IDENTITY, b"-----BEGIN", b"  -----BEGIN"),
        "text glued before a certificate": replaced(LEAF, b"-----BEGIN", b"cert: -----BEGIN"),
        "PEM headers": replaced(PERMISSIONS, begin, begin + b"Subject: x\n\n"),
        "PEM headers in a key": replaced(KEY, b"KEY-----\nM", b"KEY-----\nSubject: x\n\nM"),
        "a key in quotes": replaced(KEY, b"", b'"'),
    }.items():
        yield Row(name, Made(edit=edit), REFUSED, REFUSED, REFUSED)
    for name, edit in {
        "CR LF": replaced(IDENTITY, b"\n", b"\r\n"),
        "a byte order mark": replaced(IDENTITY, b"", b"\xef\xbb\xbf"),
        "no line break at the end": replaced(LEAF, end, end.strip()),
        "text before a certificate": replaced(PERMISSIONS, b"", b"Certificate:\n    Data:\n"),
        "X509 CERTIFICATE": replaced(LEAF, b" CERTIFICATE", b" X509 CERTIFICATE"),
        "a key behind the parameters of its curve": short_key,
        "a key in a CA file": appended(PERMISSIONS, key_pem(generate_key())),
    }.items():
        yield Row(name, Made(edit=edit), YES, YES, YES)
    damaged = appended(PERMISSIONS, begin + b"MIIB\n" + end)
    yield Row("a damaged second CA", Made(edit=damaged), REFUSED, REFUSED, YES)
    trusted = replaced(IDENTITY, b" CERTIFICATE", b" TRUSTED CERTIFICATE")
    yield Row("TRUSTED CERTIFICATE", Made(edit=trusted), YES, YES, REFUSED)
