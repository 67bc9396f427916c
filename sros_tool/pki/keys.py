"""Generation, loading and PEM encoding (PKCS#8) of private keys."""

from __future__ import annotations

from collections.abc import Callable

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes

from sros_tool.errors import PkiError

PrivateKey = ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey
PublicKey = ec.EllipticCurvePublicKey | rsa.RSAPublicKey


def generate_key() -> ec.EllipticCurvePrivateKey:
    """Generate an EC prime256v1 key, which every DDS vendor accepts (DDS-Security 1.1, 9.3.1)."""
    return ec.generate_private_key(ec.SECP256R1())


def key_pem(key: PrivateKey, passphrase: str | None = None) -> bytes:
    """Return the key as PKCS#8 PEM, encrypted if a passphrase is given.

    Enclave keys are never encrypted: no RMW can supply a passphrase.
    """
    protection: serialization.KeySerializationEncryption = serialization.NoEncryption()
    if passphrase:
        protection = serialization.BestAvailableEncryption(passphrase.encode())
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, protection
    )


def load_key(pem: bytes, name: str, passphrase: Callable[[], str] | None = None) -> PrivateKey:
    """Return the EC or RSA key of a PEM file; ``name`` names the file in errors.

    ``passphrase`` is called if the key is encrypted.

    Raises:
        PkiError: the key cannot be read, is encrypted and ``passphrase`` is None or wrong, or is
            neither an EC nor an RSA key.
    """
    try:
        key = serialization.load_pem_private_key(pem, None)
    except TypeError as error:
        if passphrase is None:
            raise PkiError(
                f"the private key {name} is protected by a passphrase",
                "It is encrypted, so it cannot be used without the passphrase.",
                "Decrypt it with `openssl pkey -in KEY -out KEY.plain`.",
            ) from error
        key = _decrypted(pem, name, passphrase())
    except (ValueError, UnsupportedAlgorithm) as error:
        raise PkiError(
            f"the private key {name} cannot be read",
            "It is not a PEM private key, or it is damaged.",
            "Restore it from a backup.",
        ) from error
    if not isinstance(key, (ec.EllipticCurvePrivateKey, rsa.RSAPrivateKey)):
        raise PkiError(
            f"the private key {name} is neither an elliptic-curve nor an RSA key",
            "DDS Security accepts EC prime256v1 and RSA 2048.",
            "Use a key of one of these kinds.",
        )
    return key


def _decrypted(pem: bytes, name: str, passphrase: str) -> PrivateKeyTypes:
    try:
        return serialization.load_pem_private_key(pem, passphrase.encode())
    except (ValueError, TypeError) as error:
        raise PkiError(
            f"the private key {name} cannot be decrypted",
            "The passphrase is wrong.",
            "Try again with the right passphrase.",
        ) from error


def algorithm(key: object) -> str:
    """Return the algorithm of a key as text, such as ``EC secp256r1`` or ``RSA 2048``."""
    if isinstance(key, (ec.EllipticCurvePrivateKey, ec.EllipticCurvePublicKey)):
        return f"EC {key.curve.name}"
    if isinstance(key, (rsa.RSAPrivateKey, rsa.RSAPublicKey)):
        return f"RSA {key.key_size}"
    return type(key).__name__.lstrip("_").removesuffix("PublicKey")
