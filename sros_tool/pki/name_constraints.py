"""Name constraints of CAs (RFC 5280, 4.2.1.10) as OpenSSL 3.0 applies them (v3_ncons.c)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from urllib.parse import urlsplit

from cryptography import x509
from cryptography.x509.oid import NameOID

from sros_tool.pki import der
from sros_tool.pki.certificates import extension, is_self_issued, subject_text
from sros_tool.pki.names import canonical
from sros_tool.pki.tolerant_extensions import UnreadableName

_IA5_MAIL = der.encode(der.OID, der.encode_oid(NameOID.EMAIL_ADDRESS.dotted_string)) + b"\x16"
_HOST = re.compile(r"(?!.*(?:\.-|-\.))\w(?:[\w-]*\w)?(?:\.[\w-]*\w)+", re.ASCII)
"""A common name that OpenSSL takes for a host: it has a dot."""


def name_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    """Yield the names in a chain that a CA above them does not allow."""
    for place, certificate in enumerate(chain):
        if place and is_self_issued(certificate):
            continue
        for authority in chain[place + 1 :]:
            constraints = extension(authority, x509.NameConstraints)
            if constraints is None:
                continue
            for name in _names(certificate, leaf=not place):
                if not _is_allowed(name, constraints):
                    yield (
                        f"the nameConstraints of {subject_text(authority.subject)} do not allow "
                        f"the names of {subject_text(certificate.subject)}"
                    )


def _names(certificate: x509.Certificate, *, leaf: bool) -> Iterator[x509.GeneralName | None]:
    """Yield the names of a certificate that constraints apply to; None for an unreadable one."""
    subject = certificate.subject
    if subject.rdns:
        yield x509.DirectoryName(subject)
    for text in subject.get_attributes_for_oid(NameOID.EMAIL_ADDRESS):
        readable = _IA5_MAIL in subject.public_bytes() and str(text.value).isascii()
        yield x509.RFC822Name(str(text.value)) if readable else None
    names = tuple(extension(certificate, x509.SubjectAlternativeName) or ())
    yield from (None if isinstance(name, UnreadableName) else name for name in names)
    if leaf and not any(isinstance(each, x509.DNSName) for each in names):
        for common in subject.get_attributes_for_oid(NameOID.COMMON_NAME):
            host = str(common.value).rstrip("\0")
            if _HOST.fullmatch(host):
                yield x509.DNSName(host)


def _is_allowed(name: x509.GeneralName | None, constraints: x509.NameConstraints) -> bool:
    if name is None:
        return False
    permitted = [
        each for each in constraints.permitted_subtrees or () if isinstance(each, type(name))
    ]
    excluded = [
        each for each in constraints.excluded_subtrees or () if isinstance(each, type(name))
    ]
    if not (permitted or excluded):
        return True
    try:
        return (not permitted or any(_within(name, each) for each in permitted)) and not any(
            _within(name, each) for each in excluded
        )
    except ValueError:
        return False


def _within(name: x509.GeneralName, base: x509.GeneralName) -> bool:
    """Return whether a name is in the subtree ``base``; raise `ValueError` if undecided."""
    if isinstance(name, x509.DirectoryName) and isinstance(base, x509.DirectoryName):
        parts = canonical(base.value)
        return canonical(name.value)[: len(parts)] == parts
    if isinstance(name, x509.IPAddress) and isinstance(base, x509.IPAddress):
        return name.value.version == base.value.version and name.value in base.value  # type: ignore[operator]
    if isinstance(name, x509.DNSName) and isinstance(base, x509.DNSName):
        text, end = name.value.lower(), base.value.lower()
        return not end or text == end or text.endswith(end if end[0] == "." else f".{end}")
    if isinstance(name, x509.RFC822Name) and isinstance(base, x509.RFC822Name):
        return _mail_within(name.value, base.value)
    if isinstance(name, x509.UniformResourceIdentifier) and isinstance(
        base, x509.UniformResourceIdentifier
    ):
        return _host_within(urlsplit(name.value).netloc.partition(":")[0], base.value)
    raise ValueError("OpenSSL supports no constraint of this kind")


def _mail_within(text: str, base: str) -> bool:
    local, at, host = text.rpartition("@")
    if not at:
        raise ValueError("not a mail address")
    base_local, base_at, base_host = base.rpartition("@")
    if not base_at and base[:1] == ".":
        return len(text) > len(base) and text.lower().endswith(base.lower())
    if base_local and base_local != local:
        return False
    return base_host.lower() == host.lower()


def _host_within(host: str, base: str) -> bool:
    if not host:
        raise ValueError("an address without a host")
    if base[:1] == ".":
        return len(host) > len(base) and host.lower().endswith(base.lower())
    return host.lower() == base.lower()
