"""The state of a keystore as metrics: expiry of its files, and numbers of findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime

from sros_tool.checks.kind import Finding, Severity
from sros_tool.errors import SrosError
from sros_tool.keystore.expiry import Lifetime, survey
from sros_tool.keystore.layout import (
    CRL_FILE,
    GOVERNANCE_P7S,
    IDENTITY_CA_FILE,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    ROLES,
)
from sros_tool.keystore.reader import Keystore
from sros_tool.pki.certificates import validity_of
from sros_tool.pki.crl import load_crl
from sros_tool.prometheus import Metric, Sample

_KINDS = "certificate, permissions, governance, crl, identity_ca or permissions_ca"


@dataclass(frozen=True, slots=True)
class Expiry:
    """The moment when a file expires; ``enclave`` is "" for a file that all enclaves share."""

    kind: str
    enclave: str
    moment: datetime


def keystore_metrics(
    keystore: Keystore, findings: Iterable[Finding], *, now: datetime, each_enclave: bool = True
) -> tuple[Metric, ...]:
    """Return the metrics of a keystore, or of an export for a robot.

    Args:
        keystore: the keystore.
        findings: the result of `keystore_findings`.
        now: the moment for which the findings were made.
        each_enclave: also give the expiry of each enclave's files, not only the earliest.

    Raises:
        KeystoreError: the path is not a keystore, or some enclaves cannot be listed.
    """
    lifetimes, unreadable = survey(keystore)
    expiries = [*_shared(keystore), *_of_enclaves(keystore, lifetimes)]
    earliest: dict[str, datetime] = {}
    for expiry in expiries:
        earliest[expiry.kind] = min(expiry.moment, earliest.get(expiry.kind, expiry.moment))
    place = {"keystore": str(keystore.root.absolute())}
    severities = Counter(finding.severity for finding in findings)
    kinds = Counter((finding.severity, finding.id) for finding in findings)
    return (
        Metric(
            "sros_examined_timestamp_seconds",
            "When the keystore was examined, in seconds since 1970.",
            (Sample(_seconds(now), place),),
        ),
        Metric(
            "sros_enclaves",
            "Number of enclaves in the keystore.",
            (Sample(len(keystore.names), place),),
        ),
        Metric(
            "sros_unreadable_enclaves",
            "Number of enclaves whose certificate or permissions cannot be read.",
            (Sample(len(unreadable), place),),
        ),
        Metric(
            "sros_earliest_expiry_timestamp_seconds",
            f"The first expiry of all files of a kind ({_KINDS}), in seconds since 1970.",
            tuple(
                Sample(_seconds(moment), {**place, "kind": kind})
                for kind, moment in earliest.items()
            ),
        ),
        Metric(
            "sros_expiry_timestamp_seconds",
            f"The expiry of a file by its kind ({_KINDS}), in seconds since 1970; "
            "without enclave for a file that all share.",
            tuple(
                Sample(
                    _seconds(expiry.moment),
                    {**place, "kind": expiry.kind, "enclave": expiry.enclave},
                )
                for expiry in expiries
                if each_enclave or not expiry.enclave
            ),
        ),
        Metric(
            "sros_findings",
            "Number of findings of `sros check` by severity (error, warning or note).",
            tuple(
                Sample(severities[severity], {**place, "severity": severity.word})
                for severity in sorted(Severity, reverse=True)
            ),
        ),
        Metric(
            "sros_findings_of_kind",
            "Number of findings of `sros check` by the id of their kind.",
            tuple(
                Sample(number, {**place, "severity": severity.word, "id": identity})
                for (severity, identity), number in sorted(kinds.items())
            ),
        ),
    )


def _shared(keystore: Keystore) -> Iterator[Expiry]:
    """Yield the expiry of the files that all enclaves share; unreadable files are left out."""
    for role in ROLES:
        with suppress(SrosError):
            for certificate in keystore.authority(role)[:1]:
                yield Expiry(f"{role}_ca", "", validity_of(certificate).not_after)
    if (keystore.root / GOVERNANCE_P7S).exists():
        # It names no moment: it is valid for as long as the CA that signed it.
        with suppress(SrosError):
            authority = keystore.ca_certificate(PERMISSIONS)
            keystore.governance_by(authority)
            yield Expiry("governance", "", validity_of(authority).not_after)
    with suppress(SrosError):
        if crl := keystore.revocation_list:
            yield Expiry("crl", "", crl.next_update)


def _of_enclaves(keystore: Keystore, lifetimes: Iterable[Lifetime]) -> Iterator[Expiry]:
    for lifetime in lifetimes:
        yield Expiry("certificate", lifetime.name, lifetime.certificate.not_after)
        yield Expiry("permissions", lifetime.name, lifetime.permissions.not_after)
        if not keystore.is_home:
            yield from _exported(keystore, lifetime.name)


def _exported(keystore: Keystore, name: str) -> Iterator[Expiry]:
    """Yield the expiry of an exported enclave's copies of the shared files."""
    folder = keystore.folder(name)
    for file in (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE):
        with suppress(SrosError):
            moment = validity_of(keystore.certificate(folder / file)).not_after
            yield Expiry(file.removesuffix(".cert.pem"), name, moment)
    if (folder / CRL_FILE).exists():
        with suppress(SrosError):
            crl = load_crl(keystore.read(folder / CRL_FILE, "revocation list"), CRL_FILE)
            yield Expiry("crl", name, crl.next_update)


def _seconds(moment: datetime) -> int:
    return int(moment.timestamp())
