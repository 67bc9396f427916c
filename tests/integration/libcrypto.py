"""Calls of the libcrypto that the DDS vendors load: what OpenSSL itself reads and accepts."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache

STRICT, CHECK_SS_SIGNATURE, POLICY_CHECK, CRL_CHECK = 0x20, 0x4000, 0x80, 0x4

_POINTERS = (
    "X509_STORE_new", "X509_STORE_CTX_new", "d2i_X509", "OPENSSL_sk_new_null", "BIO_new_mem_buf",
    "PEM_X509_INFO_read_bio", "PEM_read_bio_X509", "PEM_read_bio_X509_AUX", "OPENSSL_sk_value",
    "PEM_read_bio_PrivateKey", "PEM_read_bio_X509_CRL",
)  # fmt: skip
_FREE = ("X509_free", "X509_CRL_free", "EVP_PKEY_free", "X509_STORE_free", "X509_STORE_CTX_free",
         "OPENSSL_sk_free", "BIO_free")  # fmt: skip


class _Info(ctypes.Structure):
    """The start of an ``X509_INFO``."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("certificate", "crl", "key")]


class Libcrypto:
    """The functions of libcrypto that DDS vendors call; raises `OSError` without libcrypto."""

    def __init__(self) -> None:
        self._library = library = ctypes.CDLL("libcrypto.so.3")
        pointer = ctypes.c_void_p
        for name in _POINTERS:
            getattr(library, name).restype = pointer
        for name in _FREE:
            getattr(library, name).argtypes = [pointer]
        library.d2i_X509.argtypes = [pointer, pointer, ctypes.c_long]
        library.i2d_X509.argtypes = library.i2d_X509_CRL.argtypes = [pointer, pointer]
        library.BIO_new_mem_buf.argtypes = [ctypes.c_char_p, ctypes.c_int]
        for name in _POINTERS[5:7] + _POINTERS[7:8] + _POINTERS[9:]:
            getattr(library, name).argtypes = [pointer, pointer, pointer, ctypes.c_char_p]
        library.OPENSSL_sk_value.argtypes = [pointer, ctypes.c_int]
        library.OPENSSL_sk_num.argtypes = [pointer]
        for name in ("X509_STORE_add_cert", "OPENSSL_sk_push", "X509_STORE_add_crl"):
            getattr(library, name).argtypes = [pointer, pointer]
        library.X509_STORE_CTX_init.argtypes = [pointer] * 4
        library.X509_STORE_CTX_set_flags.argtypes = [pointer, ctypes.c_ulong]
        library.X509_STORE_CTX_set_default.argtypes = [pointer, ctypes.c_char_p]
        library.X509_check_purpose.argtypes = [pointer, ctypes.c_int, ctypes.c_int]
        for name in ("X509_verify_cert", "X509_STORE_CTX_get_error"):
            getattr(library, name).argtypes = [pointer]

    def fault(
        self,
        start: bytes,
        trusted: Sequence[bytes],
        others: Sequence[bytes] = (),
        *,
        flags: int = 0,
        documents: bool = False,
        lists: Sequence[bytes] = (),
    ) -> int:
        """Return the error of ``X509_verify_cert``, or 0 if it accepts; -1 for no certificate.

        With ``documents``, for the purpose that signers of S/MIME need.  ``lists`` are revocation
        lists in PEM; -1 if one cannot be read.
        """
        library = self._library
        loaded = [self._load(each) for each in (start, *trusted, *others)]
        try:
            if not all(loaded):
                return -1
            store, context = library.X509_STORE_new(), library.X509_STORE_CTX_new()
            untrusted = library.OPENSSL_sk_new_null()
            for place, each in enumerate(loaded[1:]):
                if place < len(trusted):
                    library.X509_STORE_add_cert(store, each)
                else:
                    library.OPENSSL_sk_push(untrusted, each)
            for crl in (self._read("PEM_read_bio_X509_CRL", each) for each in lists):
                if not crl:
                    return -1
                library.X509_STORE_add_crl(store, crl)
                library.X509_CRL_free(crl)
            library.X509_STORE_CTX_init(context, store, loaded[0], untrusted)
            if documents:
                library.X509_STORE_CTX_set_default(context, b"smime_sign")
            library.X509_STORE_CTX_set_flags(context, flags)
            accepted = library.X509_verify_cert(context) == 1
            error = library.X509_STORE_CTX_get_error(context)
            library.X509_STORE_CTX_free(context)
            library.X509_STORE_free(store)
            library.OPENSSL_sk_free(untrusted)
            return 0 if accepted else int(error) or -2
        finally:
            for each in filter(None, loaded):
                library.X509_free(each)
            library.ERR_clear_error()

    def has_invalid_extensions(self, data: bytes) -> bool:
        """Return whether an extension of a certificate, in DER, is invalid (EXFLAG_INVALID).

        Such a certificate is taken for no issuer, so that another of its name may be found.
        """
        loaded = self._load(data)
        try:
            return bool(self._library.X509_check_purpose(loaded, -1, 0) != 1)
        finally:
            self._library.X509_free(loaded)
            self._library.ERR_clear_error()

    def _load(self, data: bytes) -> int | None:
        at = ctypes.cast(ctypes.create_string_buffer(data, len(data)), ctypes.c_void_p)
        loaded: int | None = self._library.d2i_X509(None, ctypes.byref(at), len(data))
        return loaded

    def certificate(self, pem: bytes, *, trusted: bool) -> bytes | None:
        """Return in DER the certificate that ``PEM_read_bio_X509`` reads (or ``..._X509_AUX``)."""
        name = "PEM_read_bio_X509_AUX" if trusted else "PEM_read_bio_X509"
        found = self._read(name, pem)
        try:
            return self._encoded("i2d_X509", found) if found else None
        finally:
            self._library.X509_free(found)

    def reads_key(self, pem: bytes) -> bool:
        """Return whether ``PEM_read_bio_PrivateKey`` reads a key, with an empty passphrase."""
        found = self._read("PEM_read_bio_PrivateKey", pem)
        self._library.EVP_PKEY_free(found)
        return bool(found)

    def authorities(self, pem: bytes) -> list[bytes] | None:
        """Return in DER the certificates that ``PEM_X509_INFO_read_bio`` reads, or None."""
        found = self._read("PEM_X509_INFO_read_bio", pem)
        if not found:
            return None
        library = self._library
        items = [
            _Info.from_address(library.OPENSSL_sk_value(found, place))
            for place in range(library.OPENSSL_sk_num(found))
        ]
        return [self._encoded("i2d_X509", each.certificate) for each in items if each.certificate]

    def _read(self, name: str, pem: bytes) -> int | None:
        library = self._library
        stream = library.BIO_new_mem_buf(pem, len(pem))
        found: int | None = getattr(library, name)(stream, None, None, b"")
        library.BIO_free(stream)
        library.ERR_clear_error()
        return found

    def _encoded(self, name: str, value: int) -> bytes:
        function = getattr(self._library, name)
        size = function(value, None)
        buffer = ctypes.create_string_buffer(size)
        at = ctypes.c_void_p(ctypes.addressof(buffer))
        function(value, ctypes.byref(at))
        return buffer.raw


@cache
def libcrypto() -> Libcrypto | None:
    """The libcrypto of this system, or None."""
    try:
        return Libcrypto()
    except OSError:
        return None
