"""Keystores with one thing broken each: how, what two DDS do, and what `sros check` says.

The enclave /base publishes /chatter and is broken, /arm hears it and is sound.  ``cyclone`` and
``fast`` tell what becomes of /base: refused (it does not start), denied (it cannot publish),
unmatched (it starts, and nobody hears it), matched, crashed; ``..._says`` is a part of what the
vendor logs.  Runs of Cyclone DDS 0.10.2 and 11.0.1, and Fast DDS 2.9.1; ``later`` is what Fast DDS
2.6.12, 2.14 and 3 do, where that differs, and ``with_timer`` what 2.6.12 and 3.2.5 alone do.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.keystore.layout import REQUIRED_FILES
from sros_tool.pki import smime
from sros_tool.pki.certificates import Issuer, common_name, issue_ca, pem, validity_of
from sros_tool.pki.keys import key_pem, load_key
from sros_tool.validity import Window, iso
from tests.checks.bench import DAY, Bench, new_key
from tests.support.raw_pki import key as raw_key
from tests.support.raw_pki import pem as as_pem
from tests.support.raw_pki import private_der

MATCHED, UNMATCHED, DENIED, REFUSED = "matched", "unmatched", "denied", "refused"
CRASHED = "crashed"
BASE = "enclaves/base"
HOUR = timedelta(hours=1)
Public = ec.EllipticCurvePublicKey | rsa.RSAPublicKey | ed25519.Ed25519PublicKey


@dataclass(frozen=True)
class Breakage:
    """One way to break the keystore, what is seen of it, and the finding that names it."""

    name: str
    work: Callable[[Bench], object]
    fast: str
    cyclone: str
    finding: str
    fast_says: str = ""
    cyclone_says: str | tuple[str, ...] = ""  # a tuple: one of them
    race: str = ""
    """What a Fast DDS that does not match does at other times."""
    zone: str = "UTC"
    later: str = ""
    with_timer: str = ""
    shared: bool = False
    """Whether the other enclave has its part of what is broken; else it is that of a sound one."""

    def on_fast(self, vendor: Vendor) -> tuple[str, str]:
        """Return what a release of Fast DDS does, and a part of what it logs."""
        if vendor is Vendor.FAST_2_9:
            return self.fast, self.fast_says
        if self.with_timer and vendor.traits.drops_expired:
            return self.with_timer, ""
        as_before = vendor is Vendor.FAST_2_6 and self.name in AS_BEFORE_ON_FAST_2_6
        return self.fast if as_before else (self.later or self.fast), ""

    def on_cyclone(self, vendor: Vendor) -> tuple[str, str | tuple[str, ...]]:
        """Return what a release of Cyclone DDS does, and a part of what it logs."""
        known = (self.cyclone, self.cyclone_says)
        return ON_CYCLONE_11.get(self.name, known) if vendor is Vendor.CYCLONE_11 else known


# ── the ways ───────────────────────────────────────────────────────────────────────────────


def leaf(bench: Bench, begin: timedelta, end: timedelta) -> None:
    """Another certificate for the same key and subject."""
    old = bench.certificate()
    issuer = Issuer(bench.authority("identity"), bench.key("identity"))
    public = old.public_key()
    assert isinstance(public, ec.EllipticCurvePublicKey)
    made = issuer.issue(old.subject, public, Window(bench.now + begin, bench.now + end))
    bench.path(f"{BASE}/cert.pem").write_bytes(pem(made))


def own(bench: Bench, name: str) -> None:
    """Give /base a copy of a shared file, so that the other enclave keeps its own."""
    path = bench.path(f"{BASE}/{name}")
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data)


def expired_authority(bench: Bench, role: str) -> None:
    """The CA's certificate for the same key, but over; what it signs is signed anew."""
    old = bench.authority(role)
    past = Window(bench.now - 9 * DAY, bench.now - DAY)
    bench.trust(role, issue_ca(bench.key(role), old.subject, past))
    if role == "permissions":
        sign_again(bench)


def sign_again(bench: Bench) -> None:
    for file in (f"{BASE}/permissions.p7s", "enclaves/governance.p7s"):
        bench.sign(file, lambda text: text)


def write_key(bench: Bench, data: bytes) -> None:
    bench.path(f"{BASE}/key.pem").write_bytes(data)


def encrypted_key(bench: Bench) -> None:
    key = load_key(bench.path(f"{BASE}/key.pem").read_bytes(), "key.pem")
    write_key(bench, key_pem(key, "secret"))


def tamper(bench: Bench, name: str, old: bytes, new: bytes) -> None:
    own(bench, name)
    path = bench.path(f"{BASE}/{name}")
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))


def signed_by_another(bench: Bench, name: str) -> None:
    certificate, key = bench.foreign()
    own(bench, name)
    document = bench.document(f"{BASE}/{name}").encode()
    bench.path(f"{BASE}/{name}").write_bytes(smime.sign(document, certificate, key))


def unsigned(bench: Bench, name: str) -> None:
    own(bench, name)
    bench.path(f"{BASE}/{name}").write_text(bench.document(f"{BASE}/{name}"))


def window(bench: Bench, begin: timedelta, end: timedelta) -> None:
    """Another validity for the permissions of /base."""

    def edit(text: str) -> str:
        head, _, rest = text.partition("<not_before>")
        tail = rest.partition("</not_after>")[2]
        first, last = iso(bench.now + begin), iso(bench.now + end)
        return f"{head}<not_before>{first}</not_before><not_after>{last}</not_after>{tail}"

    bench.sign(f"{BASE}/permissions.p7s", edit)


def borrowed(bench: Bench) -> None:
    shutil.copy(bench.path("enclaves/arm/permissions.p7s"), bench.path(f"{BASE}/permissions.p7s"))


def without(name: str) -> Callable[[Bench], object]:
    return lambda bench: bench.unlink(f"{BASE}/{name}")


def other_identity_ca(bench: Bench) -> None:
    """Everything of /base is of another identity CA, and consistent."""
    certificate, key = bench.foreign()
    own(bench, "identity_ca.cert.pem")
    bench.path(f"{BASE}/identity_ca.cert.pem").write_bytes(pem(certificate))
    bench.issue(by=(certificate, key))


def revoked_by_peers(bench: Bench) -> None:
    """The list stands in the keystore and at the other enclave only."""
    bench.revoke(bench.certificate().serial_number)
    bench.unlink(f"{BASE}/crl.pem")


def leaf_key(bench: Bench, data: bytes, public: Public, digest: bool = True) -> None:
    old, authority = bench.certificate(), bench.authority("identity")
    made = (
        x509.CertificateBuilder(
            authority.subject, old.subject, public, 4711, validity_of(old).not_before,
            validity_of(old).not_after,
        )
        .add_extension(x509.BasicConstraints(False, None), critical=True)
        .sign(bench.key("identity"), hashes.SHA256() if digest else hashes.SHA384())
    )  # fmt: skip
    bench.path(f"{BASE}/cert.pem").write_bytes(pem(made))
    write_key(bench, data)


def ed25519_key(bench: Bench) -> None:
    key = ed25519.Ed25519PrivateKey.generate()
    data = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    leaf_key(bench, data, key.public_key())


def elliptic_key(curve: ec.EllipticCurve) -> Callable[[Bench], object]:
    def work(bench: Bench) -> None:
        key = ec.generate_private_key(curve)
        leaf_key(bench, key_pem(key), key.public_key())

    return work


def rsa_key(bench: Bench) -> None:
    key = rsa.generate_private_key(65537, 3072)
    leaf_key(bench, key_pem(key), key.public_key())


def pss_key_alone(bench: Bench) -> None:
    """A key for RSA-PSS alone in key.pem, where cert.pem is for an RSA key of any use."""
    leaf_key(bench, as_pem(*private_der("rsa2048 5", "pss")), raw_key("rsa2048 5").public_key())


def sha384(bench: Bench) -> None:
    key = load_key(bench.path(f"{BASE}/key.pem").read_bytes(), "key.pem")
    leaf_key(bench, key_pem(key), key.public_key(), digest=False)


def intermediate(bench: Bench) -> None:
    """The permissions CA is one that another CA issued; everything is signed by it."""
    is_ca = (x509.BasicConstraints(True, None), True)
    root_key = new_key()
    root = issue_ca(root_key, common_name("root CA"), Window(bench.now - DAY, bench.now + DAY))
    made, key = bench.new_authority(is_ca, issuer=(root.subject, root_key))
    bench.trust("permissions", made)
    for file in (f"{BASE}/permissions.p7s", "enclaves/governance.p7s"):
        document = bench.document(file).encode()
        bench.path(file).write_bytes(smime.sign(document, made, key))


def only_certifies(bench: Bench) -> None:
    """The permissions CA may issue certificates and lists, as RFC 5280 has it, and sign nothing."""
    usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
    made, key = bench.new_authority((x509.BasicConstraints(True, None), True), (usage, True))
    bench.trust("permissions", made)
    for file in (
        f"{BASE}/permissions.p7s", "enclaves/arm/permissions.p7s", "enclaves/governance.p7s",
    ):  # fmt: skip
        document = bench.document(file).encode()
        bench.path(file).write_bytes(smime.sign(document, made, key))


def many_topics(text: str) -> str:
    """As much as makes 64 KB together with a certificate, but not alone."""
    topics = "".join(f"<topic>rt/{'long_' * 8}{index}</topic>" for index in range(1015))
    return text.replace("</topics>", f"{topics}</topics>", 1)


def deny_reading(text: str) -> str:
    rule = (
        "<deny_rule><domains><id>0</id></domains>"
        "<subscribe><topics><topic>rt/chatter</topic></topics></subscribe></deny_rule>"
    )
    return text.replace("<allow_rule>", f"{rule}<allow_rule>", 1)


def expired_grant_first(text: str) -> str:
    begin, end = text.index("<grant"), text.index("</grant>") + len("</grant>")
    old = text[begin:end]
    first, last = old.index("<not_before>"), old.index("</validity>")
    past = "<not_before>2020-01-01T00:00:00Z</not_before>"
    past += "<not_after>2021-01-01T00:00:00Z</not_after>"
    return text[:begin] + old[:first] + past + old[last:] + text[begin:]


def dangling(bench: Bench) -> None:
    bench.unlink(f"{BASE}/permissions_ca.cert.pem").symlink_to("../../public/gone.pem")


def as_folder(bench: Bench) -> None:
    bench.unlink(f"{BASE}/key.pem").mkdir()


PERMISSIONS, GOVERNANCE = "permissions.p7s", "governance.p7s"

ROWS = (
    # name, way, Fast DDS, Cyclone DDS, finding, what Fast DDS logs, what Cyclone DDS logs
    Breakage(
        "leaf expired", lambda b: leaf(b, -9 * HOUR, -HOUR), REFUSED, REFUSED,
        "enclave.certificate-expired", "", "certificate has expired",
    ),
    Breakage(
        "leaf not yet valid", lambda b: leaf(b, HOUR, DAY), REFUSED, REFUSED,
        "enclave.certificate-not-yet-valid", "", "certificate is not yet valid",
    ),
    Breakage(
        "leaf of another CA", lambda b: b.issue(by=b.foreign()), REFUSED, REFUSED,
        "enclave.certificate-issuer", "", "unable to get local issuer certificate",
    ),
    Breakage(
        "leaf revoked", lambda b: b.revoke(b.certificate().serial_number), REFUSED, REFUSED,
        "enclave.revoked", "", "certificate revoked",
    ),
    Breakage(
        "CRL expired", lambda b: b.revoke(begin=b.now - 9 * DAY, end=b.now - DAY), REFUSED,
        REFUSED, "enclave.crl-expired", "", "CRL has expired",
    ),
    Breakage(
        "CRL garbage", lambda b: b.path(f"{BASE}/crl.pem").write_text("x"), REFUSED, REFUSED,
        "enclave.crl-malformed", "", "Failed to read CRL",
    ),
    Breakage(
        "CRL of another issuer", lambda b: b.revoke(by=b.foreign()), REFUSED, REFUSED,
        "enclave.crl-issuer", "", "unable to get certificate CRL",
    ),
    Breakage(
        "CRL of a place", lambda b: b.revoke(scope="http://example.org/crl"), REFUSED, REFUSED,
        "enclave.crl-partial", "", "ifferent CRL scope",
    ),
    Breakage(
        "identity CA expired", lambda b: expired_authority(b, "identity"), REFUSED, REFUSED,
        "enclave.ca-expired", "", "certificate has expired",
    ),
    Breakage(
        "permissions CA expired", lambda b: expired_authority(b, "permissions"), REFUSED, REFUSED,
        "enclave.ca-expired", "", "certificate verify error",
    ),
    Breakage(
        "key of another enclave", lambda b: write_key(b, key_pem(new_key())), REFUSED, UNMATCHED,
        "enclave.key-mismatch", "Error verifying private key", "",
    ),
    Breakage(
        "key garbage", lambda b: write_key(b, b"x"), REFUSED, REFUSED,
        "enclave.key-malformed", "Error obtaining private key", "Failed to parse",
    ),
    Breakage(
        "key encrypted", encrypted_key, REFUSED, REFUSED,
        "enclave.key-encrypted", "Error obtaining private key", "Failed to parse",
    ),
    Breakage(
        "governance tampered", lambda b: tamper(b, GOVERNANCE, b"ENCRYPT", b"NONE"), REFUSED,
        REFUSED, "enclave.signature", "", "digest failure",
    ),
    Breakage(
        "governance signed by another CA", lambda b: signed_by_another(b, GOVERNANCE), REFUSED,
        REFUSED, "enclave.signature", "", "certificate verify error",
    ),
    Breakage(
        "permissions tampered", lambda b: tamper(b, PERMISSIONS, b"rt/chatter", b"rt/chitter"),
        REFUSED, REFUSED, "enclave.signature", "", "digest failure",
    ),
    Breakage(
        "permissions signed by another CA", lambda b: signed_by_another(b, PERMISSIONS), REFUSED,
        REFUSED, "enclave.signature", "", "certificate verify error",
    ),
    Breakage(
        "governance unsigned", lambda b: unsigned(b, GOVERNANCE), REFUSED, REFUSED,
        "enclave.not-signed", "", "no content type",
    ),
    Breakage(
        "permissions unsigned", lambda b: unsigned(b, PERMISSIONS), REFUSED, REFUSED,
        "enclave.not-signed", "", "no content type",
    ),
    Breakage(
        "permissions expired", lambda b: window(b, -9 * DAY, -2 * DAY), REFUSED, REFUSED,
        "enclave.permissions-expired", "", "validity period expired",
    ),
    Breakage(
        "permissions of the future", lambda b: window(b, 2 * DAY, 9 * DAY), REFUSED, REFUSED,
        "enclave.permissions-not-yet-valid", "", "validity period has not started",
    ),
    Breakage(
        "permissions of another subject", borrowed, REFUSED, REFUSED,
        "enclave.permissions-subject", "", "Subject name is invalid",
    ),
    Breakage(
        "domain not in governance", lambda b: b.governance(("<id>0</id>", "<id>7</id>")), DENIED,
        REFUSED, "enclave.governance-domain", "", "Could not find domain 0 in governance",
    ),
    Breakage(
        "governance malformed", lambda b: b.governance(("topic_rule>", "topic_role>")), REFUSED,
        REFUSED, "enclave.governance-malformed", "Expected topic_rule", "Can not parse",
    ),
    Breakage(
        "permissions malformed", lambda b: b.permissions(("publish>", "write>")), REFUSED,
        REFUSED, "enclave.permissions-malformed", "Expected publish", "Can not parse",
    ),
    *(
        Breakage(
            f"{name} missing", without(name), REFUSED, REFUSED, "enclave.file-missing", "",
            "File could not be found",
        )
        for name in REQUIRED_FILES
    ),
    Breakage(
        "publish denied", lambda b: b.permissions(("rt/chatter", "rt/chitter")), DENIED, DENIED,
        "enclave.stale-permissions",
    ),
    Breakage(
        "peers of different CAs", other_identity_ca, UNMATCHED, UNMATCHED,
        "keystore.authorities-differ",
    ),
    Breakage(
        "revoked at its peers", revoked_by_peers, UNMATCHED, UNMATCHED, "enclave.crl-missing",
        shared=True,
    ),
)  # fmt: skip
"""The rows of the error table, each."""

MORE = (
    Breakage(
        "relies on default ALLOW",
        lambda b: b.permissions(("rt/chatter", "rt/chitter"), ("<default>DENY", "<default>ALLOW")),
        DENIED, MATCHED, "portable.default-allow",
    ),
    Breakage(
        "this hour in UTC, host in Los Angeles", lambda b: window(b, -HOUR, DAY), REFUSED, MATCHED,
        "enclave.permissions-local-time", zone="America/Los_Angeles",
    ),
    Breakage(
        "permissions of 63 KB", lambda b: b.sign(f"{BASE}/{PERMISSIONS}", many_topics),
        UNMATCHED, MATCHED, "portable.document-size", race=CRASHED, later=MATCHED,
    ),
    Breakage("Ed25519 key", ed25519_key, UNMATCHED, REFUSED, "portable.key-algorithm"),
    Breakage(
        "P-384 key", elliptic_key(ec.SECP384R1()), MATCHED, REFUSED, "portable.key-algorithm",
        "", "algorithm unknown",
    ),
    Breakage(
        "P-521 key", elliptic_key(ec.SECP521R1()), MATCHED, REFUSED, "portable.key-algorithm",
        "", "algorithm unknown",
    ),
    Breakage(
        "RSA 3072 key", rsa_key, MATCHED, REFUSED, "portable.key-algorithm",
        "", "algorithm unknown",
    ),
    Breakage(
        "RSA-PSS key for an RSA certificate", pss_key_alone, REFUSED, REFUSED,
        "enclave.key-mismatch", "Error verifying private key", "private key has not supported type",
    ),
    Breakage(
        "a certificate for 300 years", lambda b: b.issue(after=b.now + 300 * 365 * DAY),
        MATCHED, MATCHED, "portable.refused", race=CRASHED, with_timer=REFUSED,
    ),
    Breakage("leaf signed with SHA-384", sha384, REFUSED, MATCHED, "portable.signature-hash"),
    Breakage(
        "denial of the other direction", lambda b: b.sign(f"{BASE}/{PERMISSIONS}", deny_reading),
        MATCHED, DENIED, "portable.deny-blocks-topic",
    ),
    Breakage(
        "range of domains without min",
        lambda b: b.permissions(("<id>0</id>", "<id_range><max>5</max></id_range>")),
        MATCHED, CRASHED, "portable.domain-range",
    ),
    Breakage(
        "a topic without text", lambda b: b.permissions(("<topics>", "<topics><topic></topic>")),
        REFUSED, CRASHED, "portable.empty-topic", "Expected topic name",
    ),
    Breakage(
        "blanks lost on the way", lambda b: tamper(b, PERMISSIONS, b"  <", b" <"), REFUSED,
        REFUSED, "enclave.signature", "", "digest failure",
    ),
    Breakage(
        "no topic rule for the topic",
        lambda b: b.governance(("<topic_expression>*", "<topic_expression>rt/other")),
        DENIED, DENIED, "governance.no-topic-rule", "", "Could not find rt/chatter topic",
    ),
    Breakage(
        "strangers where messages are signed",
        lambda b: b.governance(("participants>false", "participants>true")),
        MATCHED, MATCHED, "governance.unauthenticated", later=REFUSED, shared=True,
    ),
    Breakage(
        "permissions CA below a root", intermediate, REFUSED, REFUSED, "portable.intermediate",
        "", "certificate verify error",
    ),
    Breakage(
        "permissions CA that only certifies", only_certifies, REFUSED, REFUSED,
        "portable.ca-purpose", "", "unsuitable certificate purpose", later=MATCHED, shared=True,
    ),
    Breakage(
        "link to nothing", dangling, REFUSED, REFUSED, "enclave.link-dangling",
        "", "File could not be found",
    ),
    Breakage(
        "a folder in place of the key", as_folder, REFUSED, REFUSED, "enclave.file-no-file",
        "Error obtaining private key",
        ("read from failed", "seek to end failed"),  # the latter where the folder is in memory
    ),
    Breakage(
        "an empty certificate", lambda b: b.path(f"{BASE}/cert.pem").write_bytes(b""), REFUSED,
        REFUSED, "enclave.file-empty", "", "Failed to parse certificate",
    ),
    Breakage(
        "an expired grant before the valid one",
        lambda b: b.sign(f"{BASE}/{PERMISSIONS}", expired_grant_first),
        MATCHED, REFUSED, "portable.several-grants", "", "validity period expired",
    ),
    Breakage(
        "rules for another domain", lambda b: b.permissions(("<id>0</id>", "<id>7</id>")),
        UNMATCHED, REFUSED, "enclave.permissions-domain", "", "participant denied by default rule",
    ),
    Breakage(
        "no default", lambda b: b.permissions(("<default>DENY</default>", "")), REFUSED, MATCHED,
        "portable.refused", "Expected tag default",
    ),
    Breakage(
        "a grant without a name", lambda b: b.permissions((' name="/base"', "")), REFUSED,
        MATCHED, "portable.grant-name", "Attribute name is required",
    ),
    Breakage(
        "blanks in the subject", lambda b: b.permissions(("CN=/base", "CN = /base")), REFUSED,
        REFUSED, "portable.subject", "", "Subject name is invalid", later=MATCHED,
    ),
)  # fmt: skip
"""What the table does not know."""

AS_BEFORE_ON_FAST_2_6 = {"permissions of 63 KB", "blanks in the subject"}
"""What Fast DDS 2.6.12 does as 2.9.1, and not as 2.14."""
NOT_FOUND = "signer certificate not found"
ON_CYCLONE_11 = {
    "permissions CA expired": (UNMATCHED, ""),
    "governance signed by another CA": (REFUSED, NOT_FOUND),
    "permissions signed by another CA": (REFUSED, NOT_FOUND),
    "denial of the other direction": (MATCHED, ""),
    "permissions CA below a root": (UNMATCHED, ""),
    "permissions CA that only certifies": (MATCHED, ""),
    "blanks in the subject": (MATCHED, ""),
}
"""What Cyclone DDS 11.0.1 does otherwise than 0.10, and a part of what it logs."""

HARMLESS = (
    Breakage(
        "line ends of a mail program", lambda b: tamper(b, PERMISSIONS, b"\r\n", b"\n"), MATCHED,
        MATCHED, "",
    ),
    Breakage(
        "a byte order mark before the headers",
        lambda b: tamper(b, PERMISSIONS, b"MIME-Version", b"\xef\xbb\xbfMIME-Version"),
        MATCHED, MATCHED, "",
    ),
)  # fmt: skip
"""Damage that looks worse than it is: both vendors take it, and so there is no finding."""
