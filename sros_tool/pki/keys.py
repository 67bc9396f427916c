"""Generation, loading and PEM encoding (PKCS#8) of private keys."""

from __future__ import annotations

import base64
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TypeGuard

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import dsa, ec, rsa
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes

from sros_tool.errors import PkiError
from sros_tool.pki import der
from sros_tool.pki import pem as pem_file
from sros_tool.pki.distinguished_names import reading
from sros_tool.pki.tolerant import UnknownKey
from sros_tool.wording import capitalized

PrivateKey = ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey
PublicKey = ec.EllipticCurvePublicKey | rsa.RSAPublicKey

LONGEST_PASSPHRASE = 1023
"""Longest passphrase of a private key, in bytes."""


def generate_key() -> ec.EllipticCurvePrivateKey:
    """Generate an EC prime256v1 key, which every DDS vendor accepts (DDS-Security 1.1, 9.3.1)."""
    return ec.generate_private_key(ec.SECP256R1())


def key_pem(key: PrivateKey, passphrase: str | None = None) -> bytes:
    """Return the key as PKCS#8 PEM, encrypted if a passphrase is given.

    Enclave keys are never encrypted: no RMW can supply a passphrase.
    """
    form, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    if passphrase is None:
        return key.private_bytes(serialization.Encoding.PEM, form, plain)
    return _encrypted(key.private_bytes(serialization.Encoding.DER, form, plain), passphrase)


# OWASP Password Storage Cheat Sheet (2025); a larger _N exceeds the memory that OpenSSL allows.
_N, _R, _P = 2**14, 8, 5
_PBES2, _SCRYPT = "1.2.840.113549.1.5.13", "1.3.6.1.4.1.11591.4.11"
_AES_256_CBC = "2.16.840.1.101.3.4.1.42"


def _encrypted(key: bytes, passphrase: str) -> bytes:
    """Return a PKCS#8 key, given in DER, as encrypted PEM (PBES2 with scrypt and AES-256-CBC).

    `cryptography` can read this form, but cannot write it: its own encryption uses 2048 rounds of
    PBKDF2, with which passphrases are quickly guessed.  Source: RFC 5958, 3; RFC 8018, 6.2 and A.4;
    RFC 7914, 7.
    """
    import textwrap  # most verbs write no key

    from cryptography.hazmat.primitives.ciphers import Cipher
    from cryptography.hazmat.primitives.ciphers.algorithms import AES
    from cryptography.hazmat.primitives.ciphers.modes import CBC
    from cryptography.hazmat.primitives.kdf.scrypt import Scrypt
    from cryptography.hazmat.primitives.padding import PKCS7

    salt, start = os.urandom(16), os.urandom(16)
    secret = Scrypt(salt, 32, _N, _R, _P).derive(_as_bytes(passphrase))
    padder, encryptor = PKCS7(128).padder(), Cipher(AES(secret), CBC(start)).encryptor()
    content = encryptor.update(padder.update(key) + padder.finalize()) + encryptor.finalize()
    numbers = map(der.encode_integer, (_N, _R, _P))
    scrypt = _algorithm_identifier(
        _SCRYPT, der.encode(der.SEQUENCE, der.encode(der.OCTET_STRING, salt), *numbers)
    )
    cipher = _algorithm_identifier(_AES_256_CBC, der.encode(der.OCTET_STRING, start))
    scheme = _algorithm_identifier(_PBES2, der.encode(der.SEQUENCE, scrypt, cipher))
    encrypted_key = der.encode(der.SEQUENCE, scheme, der.encode(der.OCTET_STRING, content))
    lines = textwrap.wrap(base64.b64encode(encrypted_key).decode(), 64)
    kind = "ENCRYPTED PRIVATE KEY-----"
    return "\n".join((f"-----BEGIN {kind}", *lines, f"-----END {kind}", "")).encode()


def _algorithm_identifier(oid: str, parameters: bytes) -> bytes:
    return der.encode(der.SEQUENCE, der.encode(der.OID, der.encode_oid(oid)), parameters)


def holds_private_key(data: bytes) -> bool:
    """Return whether ``data`` has a PEM private key of any kind, encrypted or not (RFC 7468)."""
    return b"PRIVATE KEY-----" in data


def load_key(pem: bytes, label: str, passphrase: Callable[[], str] | None = None) -> PrivateKey:
    """Return the EC or RSA key in a PEM file; ``label`` names the file in errors.

    ``passphrase`` is called if the key is encrypted.

    Raises:
        PkiError: the key cannot be read; the key is encrypted, and ``passphrase`` is None or
            returns a wrong one; the key is neither EC nor RSA; or OpenSSL would need so long for
            the key that the process seems to hang.
    """
    key = load_any_key(pem, label, passphrase)
    if not isinstance(key, (ec.EllipticCurvePrivateKey, rsa.RSAPrivateKey)):
        raise PkiError(
            f"the private key {label} is neither an elliptic-curve nor an RSA key",
            "DDS Security accepts EC prime256v1 and RSA 2048.",
            "Use a key of one of these kinds.",
        )
    return key


def load_enclave_key(pem: bytes, label: str) -> PrivateKey:
    """Return the key of an enclave, as `load_key`, for which the keystore can issue a certificate.

    Raises:
        PkiError: as `load_key`, or the key is for RSA-PSS alone.
    """
    key = load_key(pem, label)
    if is_key_for_pss(pem):
        raise PkiError(
            f"the private key {label} is an RSA key for RSA-PSS alone",
            "No DDS vendor loads it next to a certificate of the keystore.",
            "Make another key with `sros create_request`, in another folder.",
        )
    return key


def load_any_key(
    pem: bytes, label: str, passphrase: Callable[[], str] | None = None
) -> PrivateKeyTypes:
    """Return the private key in a PEM file, even of a kind that DDS Security does not allow.

    ``label`` and ``passphrase`` are as in `load_key`.

    Raises:
        PkiError: as `load_key`, except for the kind of the key.
    """
    pem = _key_block(pem, label)
    if _TRADITIONAL_HEADER in pem or _ENCRYPTED.match(pem):
        if passphrase is None:
            raise PkiError(
                f"the private key {label} is protected by a passphrase",
                "It is encrypted, so it cannot be used without the passphrase.",
                "Decrypt it with `openssl pkey -in KEY -out KEY.plain`.",
            )
        _check_derivation(pem, label)
        key = _decrypted_key(pem, label, passphrase())
    else:
        try:
            key = serialization.load_pem_private_key(pem, None, unsafe_skip_rsa_key_validation=True)
        except Exception as error:  # may have one of many classes: see `reading`
            raise _unreadable_key_error(label) from error
    return _validated(key, label) if isinstance(key, rsa.RSAPrivateKey) else key


def is_key_for_pss(pem: bytes) -> bool:
    """Return whether the first key of a PEM file is only for RSA-PSS (RFC 4055, 1.2)."""
    with suppress(PkiError, ValueError):
        block = next(pem_file.blocks(_key_block(pem, "")))
        _, identifier, *_ = der.children(der.first_value(block.content).content)
        return (
            identifier.tag == der.SEQUENCE
            and der.first_value(identifier.content).content == _OID_RSA_PSS
        )
    return False


_OID_RSA_PSS = der.encode_oid("1.2.840.113549.1.1.10")


def check_key(content: bytes, label: str = "") -> None:
    """Raise an error unless ``content`` (DER) is a private key of the kind that ``label`` names."""
    if len(content) > _MAX_BYTES:
        raise ValueError("too large")
    data, _ = der.split(content)
    if der.first_part(data)[0] != der.INTEGER:
        raise ValueError("an encrypted key, which `cryptography` 41 would try to decrypt")
    key = serialization.load_der_private_key(data, None, unsafe_skip_rsa_key_validation=True)
    if not isinstance(key, _KEY_CLASSES.get(label, object)):
        raise ValueError("a key of another algorithm than its label says")


def _unreadable_key_error(label: str, reason: str = "") -> PkiError:
    reason = reason or "it is not a PEM private key, or it is damaged"
    why = f"{capitalized(reason)}."
    return PkiError(f"the private key {label} cannot be read", why, "Restore it from a backup.")


def _key_block(data: bytes, label: str) -> bytes:
    """Return the private key that OpenSSL reads first in a PEM file, as a standard PEM block.

    ``label`` names the file in errors.
    """
    damaged = False
    try:
        for block in pem_file.blocks(data):
            if len(block.content) > _MAX_BYTES and block.label in _PRIVATE_KEY_LABELS:
                raise PkiError(
                    f"the private key {label} is too large",
                    f"It has more than {_MAX_BYTES // 1024} KiB. "
                    "An RSA key of 4096 bits has 4 KiB.",
                    "Use an EC prime256v1 key, or an RSA key of 2048 bits.",
                )
            if block.label in KEY_LABELS and not block.headers:
                # OpenSSL passes over a damaged key.
                with suppress(Exception):
                    check_key(block.content, block.label)
                    break
                damaged = True
            elif block.label in _PRIVATE_KEY_LABELS:
                break
        else:
            raise _unreadable_key_error(
                label, "" if damaged else pem_file.missing_block_reason(data, "PRIVATE KEY")
            )
    except PkiError as error:
        raise error if error.why else _unreadable_key_error(label, error.what) from error
    encrypted = block.headers.startswith(_TRADITIONAL_HEADER)
    if block.headers and not encrypted:
        raise _unreadable_key_error(
            label, "it has other PEM headers than those of an encrypted key"
        )
    pem_label, der_key = block.label, block.content
    # OpenSSL ignores bytes after the key, and reads the key even if the label names another form.
    if not encrypted:
        with suppress(PkiError):
            der_key, _ = der.split(block.content)
            kinds = [part.tag for part in der.children(der.first_value(der_key).content)]
            if kinds[:2] == [der.INTEGER, der.SEQUENCE]:
                pem_label = KEY_LABELS[0]
    begin = [f"-----BEGIN {pem_label}-----".encode(), *block.headers.splitlines()]
    content = base64.b64encode(der_key)
    lines = [content[start : start + 64] for start in range(0, len(content), 64)]
    end = f"-----END {pem_label}-----\n".encode()
    return b"\n".join([*begin, *([b""] if encrypted else []), *lines, end])


KEY_LABELS = ("PRIVATE KEY", "RSA PRIVATE KEY", "EC PRIVATE KEY", "DSA PRIVATE KEY")
"""The PEM labels of unencrypted private keys; a header can still say that the key is encrypted."""
_KEY_CLASSES: dict[str, type] = {
    "RSA PRIVATE KEY": rsa.RSAPrivateKey,
    "EC PRIVATE KEY": ec.EllipticCurvePrivateKey,
    "DSA PRIVATE KEY": dsa.DSAPrivateKey,
}
_PRIVATE_KEY_LABELS = (*KEY_LABELS, "ENCRYPTED PRIVATE KEY")
_TRADITIONAL_HEADER = b"Proc-Type: 4,ENCRYPTED"
_MAX_BYTES = 16 * 1024
_MAX_RSA_BITS = 4096
_MAX_ROUNDS = 2_000_000
# Limits of N * r, in units of 128 bytes, and of N * r * p.
_MAX_SCRYPT_MEMORY, _MAX_SCRYPT_WORK = 2**19, 2**22
_ENCRYPTED = re.compile(rb"-----BEGIN ENCRYPTED PRIVATE KEY-----([^-]*)")


def _validated(key: rsa.RSAPrivateKey, label: str) -> rsa.RSAPrivateKey:
    """Validate an RSA key that was loaded without validation, and return it.

    Raises:
        PkiError: the key is invalid, or so large that validation would take minutes.
    """
    if key.key_size > _MAX_RSA_BITS:
        raise PkiError(
            f"the private key {label} has {key.key_size} bits",
            f"sros uses RSA keys of at most {_MAX_RSA_BITS} bits.",
            "Use an EC prime256v1 key, or an RSA key of 2048 bits.",
        )
    try:
        return key.private_numbers().private_key()
    except ValueError as error:
        raise _unreadable_key_error(label) from error


_INITIAL_VALUE = re.compile(rb"^DEK-Info: *([^,\s]*),([0-9A-Fa-f]*)", re.MULTILINE)
_IV_LENGTH_IN_HEX_DIGITS = {b"DES-CBC": 16, b"DES-EDE3-CBC": 16}
"""Maps a cipher with 64-bit blocks to the hexadecimal digits of its initialization vector.

Source: RFC 1421, 4.6.1.3.
"""


def _check_derivation(pem: bytes, label: str) -> None:
    """Raise `PkiError` if testing one passphrase of an encrypted key takes hours or gigabytes.

    Source: RFC 5958, 3; RFC 8018, A; RFC 7914, 7.
    """
    if (match := _INITIAL_VALUE.search(pem)) and len(match[2]) < _IV_LENGTH_IN_HEX_DIGITS.get(
        match[1], 32
    ):
        raise _unreadable_key_error(label)  # `cryptography` would panic
    for block in _ENCRYPTED.findall(pem):
        try:
            scrypt, numbers = _derivation_cost(block)
        except (ValueError, PkiError) as error:
            raise _unreadable_key_error(label) from error
        if scrypt:
            allowed = (
                math.prod(numbers[:2]) <= _MAX_SCRYPT_MEMORY
                and math.prod(numbers[:3]) <= _MAX_SCRYPT_WORK
            )
        else:
            allowed = all(number <= _MAX_ROUNDS for number in numbers)
        if not allowed or min(numbers, default=0) < 0:
            raise PkiError(
                f"the private key {label} takes too long to decrypt",
                f"Its file requires {max(numbers)} rounds to try a passphrase.",
                "Encrypt it again with `openssl pkcs8 -topk8 -scrypt -in KEY -out KEY.new`.",
            )


def _derivation_cost(block: bytes) -> tuple[bool, list[int]]:
    """Return whether the key of a PEM block is derived by scrypt, and the cost parameters.

    For scrypt, the parameters are N, r and p. For any other function, the first parameter is the
    number of rounds.

    Raises:
        ValueError, PkiError: the block is damaged.
    """
    scheme = der.first_value(der.first_value(base64.b64decode(block)).content).content
    scrypt = der.encode(der.OID, der.encode_oid(_SCRYPT)) in scheme
    return scrypt, list(_integers(scheme))


# For PBKDF2 with SHA-256, by the OWASP Password Storage Cheat Sheet (2025).
_FEWEST_SAFE_ROUNDS = 600_000
_LEAST_SCRYPT_WORK = 2**17  # N * r * p of `openssl pkcs8 -scrypt`


def few_rounds_clause(pem: bytes) -> str:
    """Return a clause that says why an encrypted key's passphrase is quick to guess, or "".

    Source: RFC 8018, 4.2; OpenSSL 3.0, openssl-pkcs8 (2048 rounds) and PEM_write_bio_PrivateKey
    (one round of MD5).
    """
    if _TRADITIONAL_HEADER in pem:
        return "trying a passphrase takes one round of MD5"
    for block in _ENCRYPTED.findall(pem):
        try:
            scrypt, numbers = _derivation_cost(block)
        except (ValueError, PkiError):
            continue  # `load_key` reports it
        if scrypt and math.prod(numbers[:3]) < _LEAST_SCRYPT_WORK:
            work = ", ".join(map(str, numbers[:3]))
            return f"trying a passphrase takes scrypt with N, r, p = {work}"
        if not scrypt and numbers and numbers[0] < _FEWEST_SAFE_ROUNDS:
            return f"trying a passphrase takes {numbers[0]} rounds"
    return ""


def _integers(data: bytes, depth: int = 3) -> Iterator[int]:
    """Yield the integers in ``data`` in order, also from sequences nested up to ``depth``."""
    for value in der.children(data):
        if value.tag == der.INTEGER:
            yield der.integer(value)
        elif value.tag == der.SEQUENCE and depth:
            yield from _integers(value.content, depth - 1)


def _decrypted_key(pem: bytes, label: str, passphrase: str) -> PrivateKeyTypes:
    secret = _as_bytes(passphrase)
    with reading(
        f"the private key {label} cannot be decrypted",
        "The passphrase is wrong, or the file is damaged.",
        "Try again with the right passphrase.",
    ):
        return serialization.load_pem_private_key(pem, secret, unsafe_skip_rsa_key_validation=True)


def _as_bytes(passphrase: str) -> bytes:
    """Return the bytes of a passphrase, which may be invalid UTF-8 in an environment variable."""
    secret = passphrase.encode("utf-8", "surrogateescape")
    if len(secret) > LONGEST_PASSPHRASE:
        raise PkiError(
            "the passphrase is too long",
            f"It has {len(secret)} bytes, and OpenSSL accepts at most {LONGEST_PASSPHRASE}.",
            "Choose a shorter one.",
        )
    return secret


def is_weak(key: object) -> bool:
    """Return whether a public key is weak: RSA below 2048 bits, or EC below 256 bits.

    Source: NIST SP 800-57 part 1, 5.6; DDS-Security 1.1, 9.3.1.
    """
    if isinstance(key, rsa.RSAPublicKey):
        return key.key_size < 2048
    return isinstance(key, ec.EllipticCurvePublicKey) and key.key_size < 256


_SMALL_PRIMES = tuple(n for n in range(2, 168) if all(n % d for d in range(2, math.isqrt(n) + 1)))
_FERMAT_ROUNDS = 100


def key_problem(key: PublicKey) -> str:
    """Return a clause that says why a key from an untrusted request must not be certified, or "".

    Sources: NIST SP 800-56B rev. 2, 6.2 (exponents); CA/Browser Forum, Baseline Requirements,
    6.1.1.3 and 6.1.6 (close primes, ROCA: CVE-2017-15361).
    """
    if not isinstance(key, rsa.RSAPublicKey):
        return ""
    numbers = key.public_numbers()
    if not (1 << 16 < numbers.e < 1 << 256 and numbers.e % 2):
        shown = numbers.e if numbers.e < 1 << 64 else "very large"
        return f"its public exponent, {shown}, is not an odd number from 65537 to 2^256"
    modulus = numbers.n
    if any(modulus % prime == 0 for prime in _SMALL_PRIMES):
        return "its modulus has a small factor"
    if all(
        modulus % prime in {pow(65537, power, prime) for power in range(prime)}
        for prime in _SMALL_PRIMES[1:]
    ):
        return "its modulus can be factored: a faulty chip made it (ROCA)"
    root = math.isqrt(modulus)
    for middle in range(root + 1, root + 1 + _FERMAT_ROUNDS):
        square = middle * middle - modulus
        if math.isqrt(square) ** 2 == square:
            return "its modulus can be factored: its primes are too close"
    return ""


def is_portable(key: object) -> TypeGuard[PublicKey]:
    """Return whether a key is public and of a kind that every DDS vendor accepts."""
    if isinstance(key, rsa.RSAPublicKey):
        return key.key_size == 2048
    return isinstance(key, ec.EllipticCurvePublicKey) and key.curve.name == "secp256r1"


def algorithm(key: object) -> str:
    """Return the algorithm of a key as text, such as ``EC secp256r1`` or ``RSA 2048``."""
    if isinstance(key, (ec.EllipticCurvePrivateKey, ec.EllipticCurvePublicKey)):
        return f"EC {key.curve.name}"
    if isinstance(key, (rsa.RSAPrivateKey, rsa.RSAPublicKey)):
        return f"RSA {key.key_size}"
    if isinstance(key, UnknownKey):
        return "an algorithm that is not known"
    return type(key).__name__.lstrip("_").removesuffix("PublicKey")
