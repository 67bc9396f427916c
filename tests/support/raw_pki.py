"""Write certificates, revocation lists, keys and signed messages as DER, in any form.

`cryptography` refuses to make most of what real PKIs get wrong, so everything is put together here
from values; only the signatures themselves are its own.  Keys are named by their kind and a number
("p256 1", "rsa2048 0"), and generated once.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cache, lru_cache
from typing import Any

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import dsa, ec, ed448, ed25519, padding, rsa
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)

from sros_tool.pki.der import encode, encode_oid

Key = Any  # any private key of `cryptography`

# ── values ─────────────────────────────────────────────────────────────────────────────────


def sequence(*parts: bytes) -> bytes:
    return encode(0x30, *parts)


def set_of(*parts: bytes) -> bytes:
    return encode(0x31, *sorted(parts))


def oid(dotted: str) -> bytes:
    return encode(0x06, encode_oid(dotted))


def integer(number: int) -> bytes:
    size = (number if number >= 0 else ~number).bit_length() // 8 + 1
    return encode(0x02, number.to_bytes(size, "big", signed=True))


def octets(content: bytes) -> bytes:
    return encode(0x04, content)


def bits(content: bytes, unused: int = 0) -> bytes:
    return encode(0x03, bytes([unused]), content)


def boolean(value: bool) -> bytes:
    return encode(0x01, b"\xff" if value else b"\0")


def tagged(number: int, *parts: bytes, constructed: bool = True) -> bytes:
    return encode((0xA0 if constructed else 0x80) | number, *parts)


def time_value(at: datetime, form: str = "") -> bytes:
    """Return a Time; ``form`` is "" (as RFC 5280 says), utc, generalized, or the text itself."""
    if form in ("", "utc") and (form or at.year < 2050):
        return encode(0x17, f"{at:%y%m%d%H%M%S}Z".encode())
    if form in ("", "generalized"):
        return encode(0x18, f"{at:%Y%m%d%H%M%S}Z".encode())
    return encode(0x18 if len(form) > 14 else 0x17, form.encode())


NULL = b"\x05\x00"

# ── names ──────────────────────────────────────────────────────────────────────────────────

UTF8, PRINTABLE, TELETEX, IA5, UNIVERSAL, BMP = 0x0C, 0x13, 0x14, 0x16, 0x1C, 0x1E
ATTRIBUTES = {
    "CN": "2.5.4.3", "SN": "2.5.4.4", "serialNumber": "2.5.4.5", "C": "2.5.4.6", "L": "2.5.4.7",
    "ST": "2.5.4.8", "street": "2.5.4.9", "O": "2.5.4.10", "OU": "2.5.4.11", "title": "2.5.4.12",
    "description": "2.5.4.13", "businessCategory": "2.5.4.15", "postalAddress": "2.5.4.16",
    "postalCode": "2.5.4.17", "telephoneNumber": "2.5.4.20", "name": "2.5.4.41", "GN": "2.5.4.42",
    "initials": "2.5.4.43", "generationQualifier": "2.5.4.44", "x500UniqueIdentifier": "2.5.4.45",
    "dnQualifier": "2.5.4.46", "pseudonym": "2.5.4.65", "role": "2.5.4.72",
    "organizationIdentifier": "2.5.4.97",
    "UID": "0.9.2342.19200300.100.1.1", "mail": "0.9.2342.19200300.100.1.3",
    "DC": "0.9.2342.19200300.100.1.25", "host": "0.9.2342.19200300.100.1.9",
    "emailAddress": "1.2.840.113549.1.9.1", "unstructuredName": "1.2.840.113549.1.9.2",
    "unstructuredAddress": "1.2.840.113549.1.9.8",
    "jurisdictionC": "1.3.6.1.4.1.311.60.2.1.3", "jurisdictionST": "1.3.6.1.4.1.311.60.2.1.2",
    "friendlyName": "1.2.840.113549.1.9.20", "unknown": "1.3.6.1.4.1.99999.1",
}  # fmt: skip


@dataclass(frozen=True)
class Attribute:
    """A type and a value of a name; ``tag`` is the type of its string."""

    type: str
    value: str
    tag: int = UTF8
    raw: bytes | None = None

    def der(self) -> bytes:
        content = self.raw
        if content is None:
            codec = {BMP: "utf-16-be", UNIVERSAL: "utf-32-be", UTF8: "utf-8"}.get(
                self.tag, "latin-1"
            )
            content = self.value.encode(codec, "replace")
        dotted = ATTRIBUTES.get(self.type, self.type)
        return sequence(oid(dotted), encode(self.tag, content))


Name = tuple[tuple[Attribute, ...], ...]


def name(text: str) -> Name:
    """Return the name "CN=x,O=y": attributes in this order, several in one RDN by "+"."""
    if not text:
        return ()
    return tuple(tuple(_attribute(each) for each in rdn.split("+")) for rdn in text.split(","))


def _attribute(text: str) -> Attribute:
    kind, _, value = text.partition("=")
    return Attribute(kind, value, PRINTABLE if kind == "C" else UTF8)


def name_der(of: Name) -> bytes:
    return sequence(*(set_of(*(each.der() for each in rdn)) for rdn in of))


# ── keys and signatures ────────────────────────────────────────────────────────────────────

_CURVES: dict[str, type[ec.EllipticCurve]] = {
    "p256": ec.SECP256R1, "p384": ec.SECP384R1, "p521": ec.SECP521R1, "p224": ec.SECP224R1,
    "p192": ec.SECP192R1, "k256": ec.SECP256K1, "bp256": ec.BrainpoolP256R1,
    "bp384": ec.BrainpoolP384R1,
}  # fmt: skip


@cache
def key(label: str) -> Key:
    """Return the key of a label: its kind and a number."""
    kind = label.split()[0]
    if kind in _CURVES:
        return ec.generate_private_key(_CURVES[kind]())
    if kind.startswith("rsa"):
        size, _, exponent = kind[3:].partition("e")
        return rsa.generate_private_key(int(exponent or 65537), int(size))
    if kind == "dsa":
        return dsa.generate_private_key(2048)
    if kind == "ed25519":
        return ed25519.Ed25519PrivateKey.generate()
    return ed448.Ed448PrivateKey.generate()


RSA, RSA_PSS, EC, ED25519, ED448 = (
    "1.2.840.113549.1.1.1", "1.2.840.113549.1.1.10", "1.2.840.10045.2.1", "1.3.101.112",
    "1.3.101.113",
)  # fmt: skip
DIGESTS: dict[str, tuple[str, type[hashes.HashAlgorithm]]] = {
    "md5": ("1.2.840.113549.2.5", hashes.MD5),
    "sha1": ("1.3.14.3.2.26", hashes.SHA1),
    "sha224": ("2.16.840.1.101.3.4.2.4", hashes.SHA224),
    "sha256": ("2.16.840.1.101.3.4.2.1", hashes.SHA256),
    "sha384": ("2.16.840.1.101.3.4.2.2", hashes.SHA384),
    "sha512": ("2.16.840.1.101.3.4.2.3", hashes.SHA512),
    "sha512-256": ("2.16.840.1.101.3.4.2.6", hashes.SHA512_256),
    "sha3-256": ("2.16.840.1.101.3.4.2.8", hashes.SHA3_256),
}
_RSA_SIGNATURES = {
    "md5": "1.2.840.113549.1.1.4", "sha1": "1.2.840.113549.1.1.5",
    "sha224": "1.2.840.113549.1.1.14", "sha256": "1.2.840.113549.1.1.11",
    "sha384": "1.2.840.113549.1.1.12", "sha512": "1.2.840.113549.1.1.13",
    "sha512-256": "1.2.840.113549.1.1.16", "sha3-256": "2.16.840.1.101.3.4.3.14",
}  # fmt: skip
_EC_SIGNATURES = {
    "sha1": "1.2.840.10045.4.1", "sha224": "1.2.840.10045.4.3.1",
    "sha256": "1.2.840.10045.4.3.2", "sha384": "1.2.840.10045.4.3.3",
    "sha512": "1.2.840.10045.4.3.4", "sha3-256": "2.16.840.1.101.3.4.3.10",
}  # fmt: skip
_MGF1 = "1.2.840.113549.1.1.8"


def digest_algorithm(digest: str) -> bytes:
    return sequence(oid(DIGESTS[digest][0]), NULL)


def sign(label: str, data: bytes, algorithm: str = "sha256") -> tuple[bytes, bytes]:
    """Return the AlgorithmIdentifier and the signature of ``data``.

    ``algorithm`` is a digest, or for RSA "pss DIGEST MGF-DIGEST SALT"; Ed25519 has its own.  What a
    kind of key does not know becomes SHA-256.
    """
    signer = key(label)
    if isinstance(signer, ed25519.Ed25519PrivateKey | ed448.Ed448PrivateKey):
        kind = ED25519 if isinstance(signer, ed25519.Ed25519PrivateKey) else ED448
        return sequence(oid(kind)), signer.sign(data)
    if isinstance(signer, dsa.DSAPrivateKey):
        return sequence(oid("2.16.840.1.101.3.4.3.2")), signer.sign(data, hashes.SHA256())
    words = algorithm.split()
    if isinstance(signer, rsa.RSAPrivateKey):
        if words[0] == "pss":
            return _pss(signer, data, words[1], words[2], int(words[3]))
        digest = words[0] if words[0] in _RSA_SIGNATURES else "sha256"
        chosen = DIGESTS[digest][1]()
        signature = signer.sign(data, padding.PKCS1v15(), chosen)
        return sequence(oid(_RSA_SIGNATURES[digest]), NULL), signature
    digest = words[1] if words[0] == "pss" else words[0]
    digest = digest if digest in _EC_SIGNATURES else "sha256"
    return sequence(oid(_EC_SIGNATURES[digest])), signer.sign(data, ec.ECDSA(DIGESTS[digest][1]()))


def _pss(
    signer: rsa.RSAPrivateKey, data: bytes, digest: str, masked: str, salt: int
) -> tuple[bytes, bytes]:
    mask = padding.MGF1(DIGESTS[masked][1]())
    signature = signer.sign(data, padding.PSS(mask, salt), DIGESTS[digest][1]())
    return pss_algorithm(digest, masked, salt), signature


def pss_algorithm(digest: str, masked: str, salt: int) -> bytes:
    parts = []
    if digest != "sha1":
        parts.append(tagged(0, digest_algorithm(digest)))
    if masked != "sha1":
        parts.append(tagged(1, sequence(oid(_MGF1), digest_algorithm(masked))))
    if salt != 20:
        parts.append(tagged(2, integer(salt)))
    return sequence(oid(RSA_PSS), sequence(*parts))


def public_info(label: str, form: str = "") -> bytes:
    """Return the SubjectPublicKeyInfo.

    ``form`` is "", compressed, explicit, pss, no parameters, or damaged: no point of the curve.
    """
    public = key(label).public_key()
    plain: bytes = public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if form == "damaged":
        return plain[:-1] + bytes([plain[-1] ^ 1])
    if isinstance(public, ec.EllipticCurvePublicKey):
        point = (
            PublicFormat.CompressedPoint if form == "compressed" else PublicFormat.UncompressedPoint
        )
        encoded = bits(public.public_bytes(Encoding.X962, point))
        if form == "compressed":
            return sequence(curve_algorithm(public.curve.name), encoded)
        if form == "explicit" and public.curve.name == "secp256r1":
            return sequence(sequence(oid(EC), explicit_p256()), encoded)
    if isinstance(public, rsa.RSAPublicKey) and form in ("pss", "no parameters"):
        inner = bits(public.public_bytes(Encoding.DER, PublicFormat.PKCS1))
        return sequence(sequence(oid(RSA_PSS if form == "pss" else RSA)), inner)
    return plain


_CURVE_IDS = {
    "secp256r1": "1.2.840.10045.3.1.7", "secp384r1": "1.3.132.0.34", "secp521r1": "1.3.132.0.35",
    "secp224r1": "1.3.132.0.33", "secp192r1": "1.2.840.10045.3.1.1", "secp256k1": "1.3.132.0.10",
    "brainpoolP256r1": "1.3.36.3.3.2.8.1.1.7", "brainpoolP384r1": "1.3.36.3.3.2.8.1.1.11",
}  # fmt: skip


def curve_algorithm(curve: str) -> bytes:
    return sequence(oid(EC), oid(_CURVE_IDS[curve]))


def explicit_p256() -> bytes:
    """Return the parameters of P-256, written out."""
    prime = 2**256 - 2**224 + 2**192 + 2**96 - 1
    b = 0x5AC635D8AA3A93E7B3EBBD55769886BC651D06B0CC53B0F63BCE3C3E27D2604B
    x = 0x6B17D1F2E12C4247F8BCE6E563A440F277037D812DEB33A0F4A13945D898C296
    y = 0x4FE342E2FE1A7F9B8EE7EB4A7C0F9E162BCE33576B315ECECBB6406837BF51F5
    order = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551
    return sequence(
        integer(1),
        sequence(oid("1.2.840.10045.1.1"), integer(prime)),
        sequence(octets((prime - 3).to_bytes(32, "big")), octets(b.to_bytes(32, "big"))),
        octets(b"\4" + x.to_bytes(32, "big") + y.to_bytes(32, "big")),
        integer(order),
        integer(1),
    )


def private_der(label: str, form: str = "pkcs8") -> tuple[str, bytes]:
    """Return the label of PEM and the DER of a private key: pkcs8, traditional, explicit or pss."""
    private = key(label)
    if form in ("explicit", "traditional explicit") and label.startswith("p256"):
        number = private.private_numbers()
        point = private.public_key().public_bytes(Encoding.X962, PublicFormat.UncompressedPoint)
        secret = octets(number.private_value.to_bytes(32, "big"))
        if form == "explicit":
            inner = sequence(integer(1), secret, tagged(1, bits(point)))
            algorithm = sequence(oid(EC), explicit_p256())
            return "PRIVATE KEY", sequence(integer(0), algorithm, octets(inner))
        parts = integer(1), secret, tagged(0, explicit_p256()), tagged(1, bits(point))
        return "EC PRIVATE KEY", sequence(*parts)
    if form == "traditional" and isinstance(
        private, ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey
    ):
        made = private.private_bytes(Encoding.DER, PrivateFormat.TraditionalOpenSSL, NoEncryption())
        kind = "EC" if isinstance(private, ec.EllipticCurvePrivateKey) else "RSA"
        return f"{kind} PRIVATE KEY", made
    if form == "pss" and isinstance(private, rsa.RSAPrivateKey):
        inner = private.private_bytes(
            Encoding.DER, PrivateFormat.TraditionalOpenSSL, NoEncryption()
        )
        return "PRIVATE KEY", sequence(integer(0), sequence(oid(RSA_PSS)), octets(inner))
    return "PRIVATE KEY", private.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())


# ── certificates ───────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Extension:
    """An extension of a certificate, a list or an entry of one."""

    dotted: str
    value: bytes
    critical: bool = False

    def der(self) -> bytes:
        flag = (boolean(True),) if self.critical else ()
        return sequence(oid(self.dotted), *flag, octets(self.value))


BASIC, USAGE, PURPOSES, SUBJECT_KEY, AUTHORITY_KEY, ALTERNATIVE = (
    "2.5.29.19", "2.5.29.15", "2.5.29.37", "2.5.29.14", "2.5.29.35", "2.5.29.17",
)  # fmt: skip
USAGES = (
    "digitalSignature", "nonRepudiation", "keyEncipherment", "dataEncipherment", "keyAgreement",
    "keyCertSign", "cRLSign", "encipherOnly", "decipherOnly",
)  # fmt: skip


def basic_constraints(ca: bool, length: int | None = None, *, critical: bool = True) -> Extension:
    parts: tuple[bytes, ...] = (boolean(True),) if ca else ()
    if length is not None:
        parts += (integer(length),)
    return Extension(BASIC, sequence(*parts), critical)


def key_usage(*usages: str, critical: bool = True) -> Extension:
    number = sum(0x8000 >> USAGES.index(each) for each in usages)
    content = number.to_bytes(2, "big").rstrip(b"\0")
    unused = (content[-1] & -content[-1]).bit_length() - 1 if content else 0
    return Extension(USAGE, bits(content, unused), critical)


def purposes(*dotted: str, critical: bool = False) -> Extension:
    return Extension(PURPOSES, sequence(*map(oid, dotted)), critical)


def key_identifier(label: str) -> bytes:
    return hashlib.sha1(public_info(label)[-65:]).digest()


def subject_key(label: str) -> Extension:
    return Extension(SUBJECT_KEY, octets(key_identifier(label)))


def authority_key(label: str) -> Extension:
    return Extension(AUTHORITY_KEY, sequence(tagged(0, key_identifier(label), constructed=False)))


@dataclass(frozen=True)
class Certificate:
    """A certificate to be; ``key`` and ``signing`` are labels of keys, days count from now."""

    subject: Name
    issuer: Name
    key: str
    signing: str
    serial: int
    extensions: tuple[Extension, ...] = ()
    algorithm: str = "sha256"
    days: tuple[float, float] = (-30, 30)
    times: tuple[str, str] = ("", "")
    version: int | None = 2
    key_form: str = ""
    spoil: str = ""
    """signature, outer algorithm, inner algorithm, trailing data, long length: what is wrong."""

    def der(self, now: datetime) -> bytes:
        """Return its DER: the same each time, although most signatures are random."""
        return _certificate_der(self, now)

    def _write(self, now: datetime) -> bytes:
        algorithm, _ = sign(self.signing, b"", self.algorithm)
        other = sequence(oid(_EC_SIGNATURES["sha384"]))
        begin, end = (
            time_value(now + timedelta(days=day), form)
            for day, form in zip(self.days, self.times, strict=True)
        )
        parts = [
            b"" if self.version is None else tagged(0, integer(self.version)),
            integer(self.serial), other if self.spoil == "inner algorithm" else algorithm,
            name_der(self.issuer),
            sequence(begin, end), name_der(self.subject), public_info(self.key, self.key_form),
        ]  # fmt: skip
        if self.extensions:
            parts.append(tagged(3, sequence(*(each.der() for each in self.extensions))))
        signed = sequence(*parts)
        spoilt = signed + b"x" if self.spoil == "signature" else signed
        algorithm, signature = sign(self.signing, spoilt, self.algorithm)
        made = sequence(
            signed, other if self.spoil == "outer algorithm" else algorithm, bits(signature)
        )
        if self.spoil == "long length":
            return b"\x30\x84" + len(made[4:]).to_bytes(4, "big") + made[4:]
        return made + b"\0" * 3 * (self.spoil == "trailing data")

    def with_extension(self, extension: Extension) -> Certificate:
        """Return it with this extension in place of the one of its kind, or added."""
        kept = tuple(each for each in self.extensions if each.dotted != extension.dotted)
        return replace(self, extensions=(*kept, extension))

    def without(self, dotted: str) -> Certificate:
        kept = tuple(each for each in self.extensions if each.dotted != dotted)
        return replace(self, extensions=kept)


@lru_cache(maxsize=4096)
def _certificate_der(certificate: Certificate, now: datetime) -> bytes:
    return certificate._write(now)


# ── revocation lists ───────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Entry:
    """A revoked certificate in a list."""

    serial: int
    days: float = -2
    extensions: tuple[Extension, ...] = ()


@dataclass(frozen=True)
class RevocationList:
    """A revocation list to be."""

    issuer: Name
    signing: str
    entries: tuple[Entry, ...] = ()
    extensions: tuple[Extension, ...] = ()
    algorithm: str = "sha256"
    days: tuple[float, float | None] = (-1, 20)
    version: int | None = 1
    damaged: bool = False

    def der(self, now: datetime) -> bytes:
        algorithm, _ = sign(self.signing, b"", self.algorithm)
        parts = [b"" if self.version is None else integer(self.version), algorithm]
        parts += [name_der(self.issuer), time_value(now + timedelta(days=self.days[0]))]
        if self.days[1] is not None:
            parts.append(time_value(now + timedelta(days=self.days[1])))
        if self.entries:
            rows = []
            for each in self.entries:
                row = [integer(each.serial), time_value(now + timedelta(days=each.days))]
                if each.extensions:
                    row.append(sequence(*(inner.der() for inner in each.extensions)))
                rows.append(sequence(*row))
            parts.append(sequence(*rows))
        if self.extensions:
            parts.append(tagged(0, sequence(*(each.der() for each in self.extensions))))
        signed = sequence(*parts)
        algorithm, signature = sign(self.signing, signed + b"x" * self.damaged, self.algorithm)
        return sequence(signed, algorithm, bits(signature))


# ── signed messages ────────────────────────────────────────────────────────────────────────

DATA, SIGNED_DATA = "1.2.840.113549.1.7.1", "1.2.840.113549.1.7.2"
CONTENT_TYPE, MESSAGE_DIGEST, SIGNING_TIME, CAPABILITIES = (
    "1.2.840.113549.1.9.3", "1.2.840.113549.1.9.4", "1.2.840.113549.1.9.5",
    "1.2.840.113549.1.9.15",
)  # fmt: skip


@dataclass(frozen=True)
class Signer:
    """One SignerInfo: a certificate, its key, and how it signs.

    ``attributes`` are: none, plain, or more; ``spoil`` damages the digest or the signature.
    """

    certificate: Certificate
    key: str
    digest: str = "sha256"
    algorithm: str = ""
    """How the key signs; "" is with the digest."""
    attributes: str = "plain"
    spoil: str = ""
    plain_algorithm: bool = False
    """Whether an RSA signature is said to be rsaEncryption, as OpenSSL does."""
    identified: str = "issuer"
    """By issuer and serial number, or by its key identifier."""

    def der(self, content: bytes, now: datetime) -> bytes:
        digest = hashlib.new(
            {"sha3-256": "sha3_256", "sha512-256": "sha512_256"}.get(self.digest, self.digest)
        )
        digest.update(content)
        value = digest.digest() if self.spoil != "digest" else digest.digest()[::-1]
        signed, attributes = content, b""
        if self.attributes != "none":
            rows = [
                sequence(oid(CONTENT_TYPE), set_of(oid(DATA))),
                sequence(oid(MESSAGE_DIGEST), set_of(octets(value))),
                sequence(oid(SIGNING_TIME), set_of(time_value(now))),
            ]
            if self.attributes == "no content type":
                rows.pop(0)
            elif self.attributes == "no digest":
                rows.pop(1)
            elif self.attributes == "no time":
                rows.pop(2)
            elif self.attributes == "capabilities":
                rows.append(
                    sequence(
                        oid(CAPABILITIES),
                        set_of(sequence(sequence(oid("2.16.840.1.101.3.4.1.42")))),
                    )
                )
            elif self.attributes == "future":
                rows[2] = sequence(oid(SIGNING_TIME), set_of(time_value(now + timedelta(days=900))))
            elif self.attributes == "twice":
                rows.append(rows[1])
            elif self.attributes == "unknown":
                rows.append(sequence(oid("1.2.3.4.5"), set_of(octets(b"x"))))
            elif self.attributes == "other type":
                rows[0] = sequence(oid(CONTENT_TYPE), set_of(oid(SIGNED_DATA)))
            inner = b"".join(rows if self.attributes == "unsorted" else sorted(rows))
            signed, attributes = encode(0x31, inner), encode(0xA0, inner)
        algorithm, signature = sign(self.key, signed, self.algorithm or self.digest)
        if self.spoil == "signature":
            signature = sign(self.key, signed + b"x", self.algorithm or self.digest)[1]
        if self.plain_algorithm and isinstance(key(self.key), rsa.RSAPrivateKey):
            algorithm = sequence(oid(RSA), NULL)
        if self.plain_algorithm and isinstance(key(self.key), ec.EllipticCurvePrivateKey):
            algorithm = sequence(oid(EC))
        if self.identified == "issuer":
            who = sequence(name_der(self.certificate.issuer), integer(self.certificate.serial))
            version = 1
        else:
            who = tagged(0, key_identifier(self.certificate.key), constructed=False)
            version = 3
        named = digest_algorithm(self.digest)
        if self.spoil == "named digest":
            named = digest_algorithm("sha512" if self.digest == "sha256" else "sha256")
        return sequence(integer(version), who, named, attributes, algorithm, octets(signature))


@dataclass(frozen=True)
class Message:
    """A signed document to be."""

    signers: tuple[Signer, ...]
    certificates: tuple[Certificate, ...]
    lists: tuple[RevocationList, ...] = ()
    form: str = "detached"
    """detached (multipart/signed), or opaque."""
    digests: tuple[str, ...] | None = None
    """The digestAlgorithms; None: those of the signers."""
    text: bool = True
    version: int = 1
    both: bool = False
    """Whether a detached message has its content inside, too."""

    def write(self, document: bytes, now: datetime) -> bytes:
        lines = document.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")
        content = b"Content-Type: text/plain\r\n\r\n" * self.text + lines
        digests = self.digests
        if digests is None:
            digests = tuple(dict.fromkeys(each.digest for each in self.signers))
        inside = tagged(0, octets(content)) if self.form != "detached" or self.both else b""
        parts = [
            integer(self.version), set_of(*map(digest_algorithm, digests)),
            sequence(oid(DATA), inside),
        ]  # fmt: skip
        if self.certificates:
            parts.append(encode(0xA0, *(each.der(now) for each in self.certificates)))
        if self.lists:
            parts.append(encode(0xA1, *(each.der(now) for each in self.lists)))
        parts.append(set_of(*(each.der(content, now) for each in self.signers)))
        message = sequence(oid(SIGNED_DATA), tagged(0, sequence(*parts)))
        encoded = base64.encodebytes(message).replace(b"\n", b"\r\n")
        if self.form != "detached":
            head = (
                b'MIME-Version: 1.0\r\nContent-Disposition: attachment; filename="smime.p7m"\r\n'
                b"Content-Type: application/x-pkcs7-mime; smime-type=signed-data; "
                b'name="smime.p7m"\r\nContent-Transfer-Encoding: base64\r\n\r\n'
            )
            return head + encoded + b"\r\n"
        boundary = b"----" + hashlib.sha256(content).hexdigest()[:32].upper().encode()
        return b"".join((
            b'MIME-Version: 1.0\r\nContent-Type: multipart/signed; protocol="application/'
            b'x-pkcs7-signature"; micalg="sha-256"; boundary="', boundary, b'"\r\n\r\n'
            b"This is an S/MIME signed message\r\n\r\n--", boundary, b"\r\n", content,
            b"\r\n--", boundary, b"\r\n"
            b'Content-Type: application/x-pkcs7-signature; name="smime.p7s"\r\n'
            b"Content-Transfer-Encoding: base64\r\n"
            b'Content-Disposition: attachment; filename="smime.p7s"\r\n\r\n',
            encoded, b"\r\n--", boundary, b"--\r\n\r\n",
        ))  # fmt: skip


# ── PEM ────────────────────────────────────────────────────────────────────────────────────


def pem(label: str, content: bytes, width: int = 64) -> bytes:
    encoded = base64.b64encode(content)
    lines = [encoded[start : start + width] for start in range(0, len(encoded), width)]
    return b"".join((
        b"-----BEGIN ", label.encode(), b"-----\n", b"\n".join(lines), b"\n-----END ",
        label.encode(), b"-----\n",
    ))  # fmt: skip
