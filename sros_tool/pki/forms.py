"""The form of a certificate: what it has in common with others that one CA issued alike.

Certificates of one form differ in their names, keys, serial numbers and dates alone.  It is read
from their DER, in a tenth of the time that reading a certificate in full takes.
"""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from typing import NamedTuple

from cryptography.x509.oid import ExtensionOID

from sros_tool.errors import PkiError
from sros_tool.pki import der, pem

_EXTENSIONS = 0xA3
_LONGEST_SERIAL = 20
_TIME = re.compile(r"\d{14}Z", re.ASCII)
_NETSCAPE_TYPE = "2.16.840.1.113730.1.1"
_JUDGED = {
    der.encode_oid(oid)
    for oid in (
        ExtensionOID.AUTHORITY_KEY_IDENTIFIER.dotted_string,
        ExtensionOID.BASIC_CONSTRAINTS.dotted_string,
        ExtensionOID.CERTIFICATE_POLICIES.dotted_string,
        ExtensionOID.CRL_DISTRIBUTION_POINTS.dotted_string,
        ExtensionOID.EXTENDED_KEY_USAGE.dotted_string,
        ExtensionOID.INHIBIT_ANY_POLICY.dotted_string,
        ExtensionOID.KEY_USAGE.dotted_string,
        ExtensionOID.POLICY_CONSTRAINTS.dotted_string,
        _NETSCAPE_TYPE,
    )
}
"""The extensions whose values OpenSSL judges, apart from names."""
_UNUSUAL = re.compile(rb"[^A-Za-z0-9/_]")


class CertificateForm(NamedTuple):
    """The form of a certificate file, and of the certificate's own parts those that are asked for.

    ``common`` is equal for files that differ in the own parts of their certificates alone.
    ``validity`` is the period in DER.
    """

    common: tuple[object, ...]
    serial: int
    validity: bytes


def read_form(data: bytes) -> CertificateForm | None:
    """Return the form of the first certificate in a PEM file; None if it is an unusual one."""
    with suppress(PkiError, ValueError, IndexError, StopIteration):
        blocks = list(pem.blocks(data))
        first = next(each for each in blocks if each.label in pem.CERTIFICATES)
        around = tuple((each.label, each.headers) for each in blocks)
        form = _form(first.content)
        return form._replace(common=(*around, *form.common))
    return None


def holds_at(form: CertificateForm, now: datetime) -> bool | None:
    """Return whether a certificate is valid at the time ``now``; None if that cannot be read."""
    times = _times(form.validity)
    return times and times[0] <= now.astimezone(UTC).strftime("%Y%m%d%H%M%SZ") <= times[1]


@lru_cache(maxsize=256)  # certificates that were issued together share it
def _times(validity: bytes) -> tuple[str, str] | None:
    """Return when a period begins and ends, as a GeneralizedTime (RFC 5280, 4.1.2.5)."""
    with suppress(PkiError, ValueError):
        begin, end = map(_time, der.children(validity))
        return begin, end
    return None


def _time(value: der.Value) -> str:
    text = value.content.decode("ascii")
    if value.tag == der.UTC_TIME:
        text = f"{'20' if text < '50' else '19'}{text}"
    if not _TIME.fullmatch(text):
        raise ValueError("not a time in UTC")
    return text


def _form(certificate: bytes) -> CertificateForm:
    (whole,) = der.children(certificate)
    signed, signature_algorithm, _ = der.children(whole.content)
    parts = der.children(signed.content)
    version = parts.pop(0).whole if parts[0].tag == der.CONTEXT_0 else b""
    serial, algorithm, issuer, validity, subject, key, *more = parts
    key_algorithm, key_bits = der.children(key.content)
    number = der.integer(serial)
    common = (
        *(version, algorithm.whole, signature_algorithm.whole, issuer.whole),
        *(key_algorithm.whole, len(key_bits.content)),
        *(number > 0, len(serial.content) > _LONGEST_SERIAL),
        _form_of_name(subject.content),
        *map(_form_of_extensions, more),
    )
    return CertificateForm(common, number, validity.content)


def _form_of_name(name: bytes) -> tuple[object, ...]:
    """Return the kinds of the attributes of a name, by RDN, and its unusual characters."""
    kinds: list[object] = []
    unusual: set[bytes] = set()
    for part in der.children(name):
        for attribute in der.children(part.content):
            kind, value = der.children(attribute.content)
            kinds.append((kind.content, value.tag))
            unusual.update(_UNUSUAL.findall(value.content))
        kinds.append(None)
    return (*kinds, frozenset(unusual))


def _form_of_extensions(part: der.Value) -> tuple[object, ...]:
    if part.tag != _EXTENSIONS:
        return (part.whole,)
    (extensions,) = der.children(part.content)
    return tuple(
        each.whole if kind.content in _JUDGED else (kind.content, len(rest) > 1)
        for each in der.children(extensions.content)
        for kind, *rest in (der.children(each.content),)
    )
