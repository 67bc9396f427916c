"""When the enclaves of a keystore expire, and which of them are due for renewal."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509

from sros_tool.dds.permissions import Grant
from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.keystore.layout import enclave_folder, list_enclaves
from sros_tool.keystore.reader import read_granted
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, subject_text, validity_of
from sros_tool.validity import BACKDATE, Window, iso, parse_duration
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Lifetime:
    """When what an enclave consists of ends, and how much of its life is over."""

    name: str
    certificate: Window
    permissions: Window

    def ends(self) -> datetime:
        """The earlier of both ends."""
        return min(self.certificate.not_after, self.permissions.not_after)

    def due(self, threshold: Threshold, now: datetime) -> bool:
        """Whether it is to be renewed by ``threshold``."""
        if threshold.remaining is not None:
            return self.ends() - now <= threshold.remaining
        assert threshold.elapsed is not None
        return any(
            _elapsed(each, now) >= threshold.elapsed
            for each in (self.certificate, self.permissions)
        )


@dataclass(frozen=True, slots=True)
class Threshold:
    """When a thing is to be renewed: at so much ``remaining``, or ``elapsed`` (0 to 1) of it."""

    remaining: timedelta | None = None
    elapsed: float | None = None


@dataclass(frozen=True, slots=True)
class Credentials:
    """What an enclave has: a certificate, and the grant that DDS reads, neither verified yet.

    ``digest`` is the SHA-256 of the signed permissions.
    """

    name: str
    certificate: x509.Certificate
    signed: smime.SignedDocument
    digest: str
    grant: Grant

    def lifetime(self) -> Lifetime:
        """When both end."""
        return Lifetime(self.name, validity_of(self.certificate), self.grant.validity)


@dataclass(frozen=True, slots=True)
class UnreadableEnclave:
    """An enclave of which nobody can tell when it ends, and why."""

    name: str
    error: SrosError


def _elapsed(validity: Window, now: datetime) -> float:
    """How much of a life is over, from 0 to 1; the time by which it was back-dated is no life."""
    begin = validity.not_before
    if validity.not_after - begin > BACKDATE:
        begin += BACKDATE
    return (now - begin) / (validity.not_after - begin)


def parse_threshold(text: str) -> Threshold:
    """Read ``30d`` (that much is left) or ``66%`` (that much is over)."""
    match = re.fullmatch(r"(\d{1,3})%", text.strip(), re.ASCII)
    if not match:
        return Threshold(remaining=parse_duration(text))
    if int(match[1]) > 100:
        raise UsageError(f"{text!r} is more than all of a lifetime")
    return Threshold(elapsed=int(match[1]) / 100)


def lifetimes(root: Path) -> tuple[Lifetime, ...]:
    """When each enclave of a keystore ends, in the order of names.

    Raises one `KeystoreError` that names every enclave that cannot be read.
    """
    found, unreadable = survey(root)
    refuse_unreadable(unreadable, "read")
    return found


def survey(root: Path) -> tuple[tuple[Lifetime, ...], tuple[UnreadableEnclave, ...]]:
    """As `lifetimes`, with those that cannot be read beside those that can."""
    found, unreadable = [], []
    for name in list_enclaves(root):
        try:
            found.append(read_credentials(root, name).lifetime())
        except SrosError as error:
            unreadable.append(UnreadableEnclave(name, error))
    return tuple(found), tuple(unreadable)


def refuse_unreadable(unreadable: tuple[UnreadableEnclave, ...], verb: str) -> None:
    """Raise one error that names every one of the enclaves, if there are any."""
    if len(unreadable) == 1:
        raise unreadable[0].error
    if unreadable:
        names = ", ".join(each.name for each in unreadable)
        told = " ".join(f"{each.error.what}." for each in unreadable)
        raise KeystoreError(
            f"{len(unreadable)} enclaves cannot be {verb}: {names}",
            f"{told} Nothing was changed.",
            "Mend or revoke them, or name those that are meant.",
        )


def read_credentials(root: Path, name: str) -> Credentials:
    """What an enclave has; raises `KeystoreError` where that is not to be read."""
    folder = root / enclave_folder(name)
    try:
        path = folder / "cert.pem"
        certificate = load_certificate(read_bytes(path, "certificate"), f"'{path}'")
        subject = subject_text(certificate.subject)
        granted = read_granted(folder / "permissions.p7s", subject)
    except SrosError as error:
        raise KeystoreError(
            f"enclave {name} cannot be read: {error.what}",
            error.why,
            error.remedy or f"See `sros inspect {folder}`.",
        ) from error
    if granted.grant is None:
        raise KeystoreError(
            f"the permissions of enclave {name} have no grant for {subject}",
            "They belong to another certificate.",
            f"Sign them anew with `sros create_permission {root} {name} POLICY_FILE`.",
        )
    return Credentials(name, certificate, granted.signed, granted.digest, granted.grant)


def describe_lifetime(lifetime: Lifetime, now: datetime) -> str:
    """In words: which part ends first, and when."""
    first = (
        "certificate"
        if lifetime.certificate.not_after <= lifetime.permissions.not_after
        else "permissions"
    )
    word = "ended" if lifetime.ends() < now else "until"
    return f"{lifetime.name}  {first} {word} {iso(lifetime.ends())}"
