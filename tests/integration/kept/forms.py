"""The form of the files that a vendor is asked about: the same whenever they are made alike.

Keys, serial numbers, random names, signatures and moments are new in every run.  A form has keys
and numbers by their order, a signature as the key that it fits, and a moment as its distance from
now.  Whatever cannot be told in this way stays as it is: the form is then a new one in every run,
and the vendor is asked.
"""

from __future__ import annotations

import re
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from hashlib import sha1
from pathlib import Path
from typing import Any

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    PublicFormat,
    load_der_private_key,
    load_der_public_key,
)

from sros_tool.errors import PkiError
from sros_tool.pki import der

FILES = (
    "identity_ca.cert.pem", "cert.pem", "key.pem", "crl.pem",
    "permissions_ca.cert.pem", "governance.p7s", "permissions.p7s",
)  # fmt: skip
"""The files of an enclave that vendors read."""

_BASE64 = re.compile(rb"(?:^[A-Za-z0-9+/]{4,76}\r?\n)*^[A-Za-z0-9+/]{2,76}={0,2}\r?\n", re.M)
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)")
_RANDOM = re.compile(
    r"(?<![0-9A-Za-z])(?:(?<= CA )|(?=[0-9]*[a-fA-F]))(?:[0-9a-f]{8,}|[0-9A-F]{8,})(?![0-9A-Za-z])"
)
_BOUNDARY = re.compile(rb'boundary="([^"\r\n]+)"')
_QUARTER = 900
_MESSAGE_DIGEST = der.encode(der.OID, der.encode_oid("1.2.840.113549.1.9.4"))
_LONGEST_NUMBER = 8
"""Bytes of a number that is not drawn at random."""

_HASHES: dict[str, hashes.HashAlgorithm] = {
    "2.16.840.1.101.3.4.2.1": hashes.SHA256(),
    "2.16.840.1.101.3.4.2.2": hashes.SHA384(),
    "2.16.840.1.101.3.4.2.3": hashes.SHA512(),
    "1.3.14.3.2.26": hashes.SHA1(),
    "1.2.840.10045.4.3.2": hashes.SHA256(),
    "1.2.840.10045.4.3.3": hashes.SHA384(),
    "1.2.840.10045.4.3.4": hashes.SHA512(),
    "1.2.840.113549.1.1.11": hashes.SHA256(),
    "1.2.840.113549.1.1.12": hashes.SHA384(),
    "1.2.840.113549.1.1.13": hashes.SHA512(),
}
"""Of a digest, or of a signature with it; RSA-PSS is not among them."""


def form_of(folders: Sequence[Path], now: datetime, made: datetime | None = None) -> str:
    """Return the form of enclaves that belong together; keys are counted through all of them.

    Moments are told by their distance from ``made``, if the enclaves were made then and signed
    until ``now``, and else from ``now``.
    """
    contents = tuple((name, _content(folder / name)) for folder in folders for name in FILES)
    if made is None:
        return _form(contents, now, now)
    known = _FORMS.get((contents, made))
    if known is None:
        known = _FORMS[contents, made] = _form(contents, made, now)
    return known


_Contents = tuple[tuple[str, bytes | str], ...]
_FORMS: dict[tuple[_Contents, datetime], str] = {}
"""The forms of enclaves that several vendors are asked about."""


def _form(contents: _Contents, made: datetime, now: datetime) -> str:
    writer = _Writer(made, now)
    for _, content in contents:
        if isinstance(content, bytes):
            writer.learn(content)
    return "\n".join(
        f"{name}: {writer.file(content) if isinstance(content, bytes) else content}"
        for name, content in contents
    )


def form_of_text(text: str, now: datetime) -> str:
    """Return the form of a document in clear."""
    return _Writer(now, now).text(text)


def _content(path: Path) -> bytes | str:
    """What is read from a path, or why nothing is."""
    try:
        return path.read_bytes()
    except OSError as error:
        return f"errno {error.errno}{', a link' if path.is_symlink() else ''}"


class _Writer:
    """Writes forms; knows the keys and the random words that came so far."""

    def __init__(self, made: datetime, now: datetime) -> None:
        self._made = made
        self._now = now
        self._keys: dict[bytes, Any] = {}
        self._names: dict[bytes, str] = {}
        self._words: dict[str, str] = {}
        self._texts: tuple[bytes, ...] = ()
        self._signer = b""
        """The key of the last signature, which is tried first for the next one."""

    # ── keys ───────────────────────────────────────────────────────────────────────────────

    def learn(self, content: bytes) -> None:
        """Count the keys in a file, public and private."""
        for _, _, data in _blobs(content):
            for info, key in _keys_in(data):
                if info in self._keys:
                    continue
                self._keys[info] = key
                algorithm, bits = _children(der.first_value(info))
                size = getattr(key, "key_size", "")
                name = f"{algorithm.content.hex()} {size} {len(self._keys)}"
                self._names[info] = f"<key {name}>"
                self._names[sha1(bits.content[1:]).digest()] = f"<identifier of {name}>"

    # ── files ──────────────────────────────────────────────────────────────────────────────

    def file(self, content: bytes) -> str:
        """Return the form of a file: text, in which encoded values are told by what they are."""
        self._texts = tuple(_signed_texts(content))
        told, start = [], 0
        for (begin, end), written, data in _blobs(content):
            told += [self.text(_decoded(content[start:begin])), f"<{written}>", self._blob(data)]
            start = end
        return repr("".join([*told, self.text(_decoded(content[start:]))]))

    def _blob(self, data: bytes) -> str:
        private = _private_key(data)
        if private is None:
            return self._value(der.first_value(data))
        info = private.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
        tags: list[str] = []
        _walk(der.first_value(data), lambda value: tags.append(f"{value.tag:02x}"))
        return f"<private part of {self._names.get(info)}: {' '.join(tags)}>"

    def text(self, text: str) -> str:
        """Return a text with its dates as distances, and what is random in it by its order."""
        dated = _DATE.sub(lambda found: self._moment(found[0], *map(int, found.groups())), text)
        return _RANDOM.sub(lambda found: self._word(found[0]), dated)

    def _word(self, word: str) -> str:
        return self._words.setdefault(word, f"<random {len(self._words) + 1}>")

    def _moment(self, written: str, *parts: int) -> str:
        """Tell a moment by its distance from now; one that is far away and fixed as it is."""
        try:
            at = datetime(*parts, tzinfo=UTC)  # type: ignore[misc, arg-type]
        except ValueError:
            return written
        seconds = 0 if self._made < at <= self._now else round((at - self._made).total_seconds())
        days = round(seconds / 86400)
        if abs(days) > 400 and abs(seconds - 86400 * days) > _QUARTER // 2:
            return f"<{written}, {'past' if seconds < 0 else 'to come'}>"
        quarters = round(seconds / _QUARTER)
        side = "after" if seconds > _QUARTER * quarters else "at"
        return f"<{side} {quarters} quarters of an hour>"

    # ── values ─────────────────────────────────────────────────────────────────────────────

    def _value(self, value: der.Value) -> str:
        known = self._names.get(value.whole) or self._names.get(value.content)
        if known:
            return known
        if value.tag in (der.UTC_TIME, der.GENERALIZED_TIME):
            return self._time(value)
        if value.tag == der.INTEGER and len(value.content) > _LONGEST_NUMBER:
            return self._word(value.content.hex())
        parts = _children(value)
        if value.tag & 0x20 and parts:
            return f"{value.tag:02x}({' '.join(self._parts(parts))})"
        inner = _inside(value)
        if inner:
            return f"{value.tag:02x}[{self._value(inner)}]"
        text = _printable(value.content)
        return f"{value.tag:02x}:{self.text(repr(text)) if text else value.content.hex()}"

    def _parts(self, parts: Sequence[der.Value]) -> Iterator[str]:
        """The values of a constructed one, in which a signature may be the last."""
        tags = [part.tag for part in parts]
        last = len(parts) - 1
        for place, part in enumerate(parts):
            if tags == [der.SEQUENCE, der.SEQUENCE, der.BIT_STRING] and place == last:
                yield self._signature(part.content[1:], parts[1], parts[0].whole)
            elif (
                tags[:1] == [der.INTEGER]
                and tags[-2:] == [der.SEQUENCE, der.OCTET_STRING]
                and (len(tags) in (5, 6) and place == last)
            ):
                yield self._signature_of_text(parts)
            elif place and parts[0].whole == _MESSAGE_DIGEST:
                yield self._digest(part)
            else:
                yield self._value(part)

    def _signature(self, signature: bytes, algorithm: der.Value, *signed: bytes) -> str:
        """Tell which key made a signature, if the algorithm is one that is known here."""
        parts = _children(algorithm)
        digest = _HASHES.get(der.decode_oid(parts[0])) if parts else None
        if digest is None:
            return signature.hex()
        for info, key in sorted(self._keys.items(), key=lambda each: each[0] != self._signer):
            if any(_fits(info, key, signature, each, digest.name) for each in signed):
                self._signer = info
                return f"<signature {self._word(signature.hex())} by {self._names[info]}>"
        return f"<signature {self._word(signature.hex())} by none of these keys>"

    def _signature_of_text(self, parts: Sequence[der.Value]) -> str:
        """Tell the signature of a SignerInfo: over its attributes, or over the text without any."""
        attributes = [part for part in parts if part.tag == der.CONTEXT_0]
        signed = tuple(der.encode(der.SET, each.content) for each in attributes) or self._texts
        return self._signature(parts[-1].content, parts[2], *signed)

    def _digest(self, value: der.Value) -> str:
        (digest,) = _children(value)[:1] or (value,)
        for text in self._texts:
            for algorithm in _HASHES.values():
                hashed = hashes.Hash(algorithm)
                hashed.update(text)
                if hashed.finalize() == digest.content:
                    return f"<{algorithm.name} of the text>"
        return f"<{len(digest.content)} bytes that are no digest of the text>"

    def _time(self, value: der.Value) -> str:
        text = value.content.decode("ascii", "replace")
        short = value.tag == der.UTC_TIME
        found = re.fullmatch(r"(\d{2}|\d{4})(\d\d)(\d\d)(\d\d)(\d\d)(\d\d)Z", text)
        if not found or (len(found[1]) == 2) is not short:
            return f"{value.tag:02x}:{text}"
        year, *rest = map(int, found.groups())
        if short:
            year += 1900 if year >= 50 else 2000
        return f"{value.tag:02x}:{self._moment(text, year, *rest)}"


def _decoded(data: bytes) -> str:
    return data.decode("utf-8", "backslashreplace")


# What several enclaves have, such as the certificate of their CA, is read once.


@lru_cache(1000)
def _blobs(content: bytes) -> list[tuple[tuple[int, int], str, bytes]]:
    """Return where DER stands in base64, how its lines are written, and the DER."""
    blobs = []
    for found in _BASE64.finditer(content):
        lines = found[0].splitlines()
        end = b"\r\n" if found[0].endswith(b"\r\n") else b"\n"
        try:
            data = b64decode(b"".join(lines), validate=True)
        except ValueError:
            continue
        canonical, width = b64encode(data), len(lines[0])
        written = (canonical[at : at + width] + end for at in range(0, len(canonical), width))
        if b"".join(written) == found[0] and data[:1] == b"\x30" and _is_whole(data):
            kind = f"width {width if len(lines) > 1 else 'of a line'}, {end!r}"
            blobs.append((found.span(), kind, data))
    return blobs


@lru_cache(1000)
def _keys_in(data: bytes) -> list[tuple[bytes, Any]]:
    """Return the public keys in an encoded value, with that of a private key, and their infos."""
    found: list[tuple[bytes, Any]] = []

    def look(value: der.Value) -> None:
        parts = _children(value) if value.tag == der.SEQUENCE else []
        if [part.tag for part in parts] != [der.SEQUENCE, der.BIT_STRING]:
            return
        with suppress(ValueError, UnsupportedAlgorithm):
            found.append((value.whole, load_der_public_key(value.whole)))

    private = _private_key(data)
    if private is None:
        _walk(der.first_value(data), look)
    else:
        encoding = Encoding.DER, PublicFormat.SubjectPublicKeyInfo
        look(der.first_value(private.public_key().public_bytes(*encoding)))
    return found


def _is_whole(data: bytes) -> bool:
    try:
        return len(der.children(data)) == 1
    except PkiError:
        return False


def _children(value: der.Value) -> list[der.Value]:
    return _parsed(value.content) if value.tag & 0x20 else []


@lru_cache(20_000)
def _parsed(content: bytes) -> list[der.Value]:
    try:
        return der.children(content)
    except PkiError:
        return []


def _inside(value: der.Value) -> der.Value | None:
    """The value that an OCTET STRING contains, if it is nothing but that."""
    nested = value.tag == der.OCTET_STRING and value.content[:1] in (b"\x30", b"\x04", b"\x03")
    return der.first_value(value.content) if nested and _is_whole(value.content) else None


def _walk(value: der.Value, look: Callable[[der.Value], None]) -> None:
    look(value)
    for part in _children(value):
        _walk(part, look)


def _printable(content: bytes) -> str:
    """The text of a value, or "" if it is none."""
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return ""
    return text if all(each.isprintable() or each in "\r\n\t" for each in text) else ""


@lru_cache(1000)
def _private_key(data: bytes) -> Any:
    try:
        return load_der_private_key(data, None, unsafe_skip_rsa_key_validation=True)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        return None


def _signed_texts(content: bytes) -> Iterator[bytes]:
    """Yield the text that lies beside its signature, as it stands and with the ends of mail."""
    found = _BOUNDARY.search(content)
    if not found:
        return
    parts = re.split(rb"\r?\n?--" + re.escape(found[1]) + rb"(?:--)?\r?\n", content)
    if len(parts) > 1:
        yield parts[1]
        yield re.sub(rb"\r?\n", b"\r\n", parts[1])


def _fits(info: bytes, key: Any, signature: bytes, signed: bytes, digest: str) -> bool:
    """Whether a key, whose encoding is ``info``, made a signature; each is verified once."""
    asked = info, signature, sha1(signed).digest(), digest
    if asked not in _FITTING:
        _FITTING[asked] = _verifies(key, signature, signed, _BY_NAME[digest])
    return _FITTING[asked]


_FITTING: dict[tuple[bytes, bytes, bytes, str], bool] = {}
_BY_NAME = {digest.name: digest for digest in _HASHES.values()}


def _verifies(key: Any, signature: bytes, signed: bytes, digest: hashes.HashAlgorithm) -> bool:
    try:
        if isinstance(key, ec.EllipticCurvePublicKey):
            key.verify(signature, signed, ec.ECDSA(digest))
        elif isinstance(key, rsa.RSAPublicKey):
            key.verify(signature, signed, padding.PKCS1v15(), digest)
        else:
            return False
    except (InvalidSignature, UnsupportedAlgorithm):
        return False
    return True
