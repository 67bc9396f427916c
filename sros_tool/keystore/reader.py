"""Reads what a keystore says of itself: its choices, its governance, its domains."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Grant, parse_permissions
from sros_tool.errors import InvalidNameError, KeystoreError, SrosError, UsageError
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    PERMISSIONS,
    REVOKED,
    SETTINGS,
    ca_certificate,
    enclave_folder,
    list_enclaves,
)
from sros_tool.keystore.ledger import Entry, read_ledger
from sros_tool.keystore.template import Template, load_template, read_template
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, subject_text, validity_of
from sros_tool.validity import BACKDATE, Window, iso, parse_duration
from sros_tool.xml import read_bytes


def load_settings(root: Path) -> Template:
    """The choices that the keystore was made by; those of ros2/sros2 where it has none."""
    path = root / SETTINGS
    return read_template(path) if path.exists() else load_template("sros2")


def load_governance(root: Path, authority: x509.Certificate) -> Governance:
    """The governance that DDS loads, after its signature by the permissions CA was verified."""
    path = root / GOVERNANCE_P7S
    try:
        signed = smime.parse(read_bytes(path, "governance document"))
        signed.verify(authority)
        return parse_governance(signed.document, f"'{path}'")
    except SrosError as error:
        raise KeystoreError(
            f"the governance of keystore '{root}' cannot be used: {error.what}",
            error.why,
            error.remedy or f"Restore '{path}' from a backup; every enclave depends on it.",
        ) from error


def governance_of(root: Path) -> Governance:
    """The governance that DDS loads, by the permissions CA that lies in the keystore."""
    path = root / ca_certificate(PERMISSIONS)
    return load_governance(root, load_certificate(read_bytes(path, "certificate"), f"'{path}'"))


def check_domain(domains: DomainSet, domain: int | None, root: Path) -> None:
    """Raise `KeystoreError` if ``domain`` is given and the keystore is not made for it."""
    if domain is None or domain in domains:
        return
    raise KeystoreError(
        f"ROS_DOMAIN_ID is {domain}, but keystore '{root}' is for domain {domains} only",
        "A node that joins any other domain with it is refused by DDS.",
        f"Set ROS_DOMAIN_ID to {domains}, or make a keystore with --domain {domain}.",
    )


@dataclass(frozen=True, slots=True)
class Granted:
    """A signed permissions document, not verified yet, with its SHA-256.

    ``grant`` is the first that fits a subject, which is the one that DDS reads, or None.
    """

    signed: smime.SignedDocument
    digest: str
    grant: Grant | None


def read_granted(path: Path, subject: str) -> Granted:
    """Read what a ``permissions.p7s`` grants to a subject; raises where it is no such document."""
    message = read_bytes(path, "permissions document")
    signed = smime.parse(message)
    grants = parse_permissions(signed.document, f"'{path}'").grants
    grant = next((each for each in grants if each.subject == subject), None)
    return Granted(signed, hashlib.sha256(message).hexdigest(), grant)


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
class Standing:
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
class Unreadable:
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
    refuse(unreadable, "read")
    return found


def survey(root: Path) -> tuple[tuple[Lifetime, ...], tuple[Unreadable, ...]]:
    """As `lifetimes`, with those that cannot be read beside those that can."""
    found, unreadable = [], []
    for name in list_enclaves(root):
        try:
            found.append(read_standing(root, name).lifetime())
        except SrosError as error:
            unreadable.append(Unreadable(name, error))
    return tuple(found), tuple(unreadable)


def refuse(unreadable: tuple[Unreadable, ...], verb: str) -> None:
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


def read_standing(root: Path, name: str) -> Standing:
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
    return Standing(name, certificate, granted.signed, granted.digest, granted.grant)


def describe_lifetime(lifetime: Lifetime, now: datetime) -> str:
    """In words: which part ends first, and when."""
    first = (
        "certificate"
        if lifetime.certificate.not_after <= lifetime.permissions.not_after
        else "permissions"
    )
    word = "ended" if lifetime.ends() < now else "until"
    return f"{lifetime.name}  {first} {word} {iso(lifetime.ends())}"


_FEW = 5
"""So many enclaves are told before the rest is counted."""
_ALIKE = 0.75
"""The least likeness (`difflib`) of a slip of the keyboard: one letter of four, or two of eight."""


def no_such_enclave(root: Path, name: str, there: Collection[str]) -> SrosError:
    """The error for ``name``, which is none of the enclaves that are ``there``."""
    if revocation := _revocation(root, name):
        return _was_revoked(root, revocation)
    what = f"enclave {name} does not exist in keystore '{root}'"
    meant = likely(name, there)
    if meant:
        return KeystoreError(what, "", f"Perhaps {' or '.join(meant)} is meant.")
    try:
        check_enclave_name(name)
    except InvalidNameError as error:
        return error
    names = sorted(there)
    more = f" and {len(names) - _FEW} more" if len(names) > _FEW else ""
    why = f"It has {', '.join(names[:_FEW]) or 'none'}{more}."
    return KeystoreError(what, why, f"Make it with `sros create_enclave {root} {name}`.")


def _revocation(root: Path, name: str) -> Entry | None:
    """How the ledger says that an enclave was revoked, if nothing was issued for it since."""
    try:
        entries = read_ledger(root)
    except SrosError:
        return None  # that the enclave is missing is what counts here
    of_it = [e for e in entries if e.enclave == name and e.what in ("certificate", "revocation")]
    if not of_it or of_it[-1].what != "revocation":
        return None
    # Earlier certificates of it were revoked with it; the files are those of one.
    kept = (e for e in reversed(of_it) if e.serial and (root / REVOKED / e.serial).is_dir())
    return next(kept, of_it[-1])


def _was_revoked(root: Path, entry: Entry) -> SrosError:
    reason = "" if entry.reason in ("", "unspecified") else f" ({entry.reason})"
    folder = root / REVOKED / entry.serial
    return KeystoreError(
        f"enclave {entry.enclave} of keystore '{root}' was revoked at {entry.time}{reason}",
        f"Its files lie in '{folder}'." if folder.is_dir() else "",
        f"If it is needed again, make it anew with `sros create_enclave {root} {entry.enclave}`.",
    )


def likely(name: str, there: Collection[str]) -> tuple[str, ...]:
    """The enclaves that someone who wrote ``name`` may have meant, at most three.

    Those that end in it, for its beginning is what one leaves out; otherwise those whose last part
    is spelt alike.
    """
    end = "/" + name.strip("/")
    if end == "/":
        return ()
    found = [each for each in there if each.endswith(end)]
    if not found:
        last = {each: each.rpartition("/")[2] for each in there}
        alike = difflib.get_close_matches(
            end.rpartition("/")[2], set(last.values()), n=3, cutoff=_ALIKE
        )
        found = [each for each in there if last[each] in alike]
    return tuple(sorted(found)[:3])
