"""The expiry of a keystore's enclaves, and the threshold for their renewal."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from cryptography import x509

from sros_tool.dds.permissions import Grant
from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.keystore.layout import CERTIFICATE_FILE, enclaves_of_closed_robot, remedy_in_keystore
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import Template
from sros_tool.parallel import map_slices
from sros_tool.pki import smime
from sros_tool.pki.certificates import subject_text, validity_of
from sros_tool.validity import Window, iso, parse_duration, time_of_file
from sros_tool.values import shows
from sros_tool.wording import capitalized, counted, first_few

IF_EXPIRED = "If files that processes loaded have expired, restart all processes together."
ONE_BY_ONE = f"restart the processes one by one; meanwhile, all of them communicate. {IF_EXPIRED}"
"""Text on restarting processes one by one, or together if they loaded files that have expired.

A process that loaded expired files communicates, if at all, only with peers that it met before;
restarted processes and this process refuse each other (Fast DDS 2.14.6 and 3.6.2, tested).
"""


class Threshold(NamedTuple):
    """The threshold at which an enclave is due for renewal.

    At most one field is set: ``remaining``, the time until expiry, or ``elapsed``, the elapsed
    fraction of the validity (0 to 1).  If neither is set, an enclave is due when one of its files
    expires soon (`Window.expires_soon_from`).
    """

    remaining: timedelta | None = None
    elapsed: float | None = None


def renewal_command(root: Path, *names: str) -> str:
    """Return the command that renews ``names``, and all enclaves that expire soon."""
    words = ("sros", "renew", str(root), *names, "--all-expiring", "soon")
    return " ".join(map(quote, words))


class Lifetime(NamedTuple):
    """The validity of an enclave's certificate and of its permissions."""

    name: str
    certificate: Window
    permissions: Window
    written_at: datetime | None = None
    """When the certificate was written to this keystore; the elapsed fraction counts from then.

    A CA service may date certificates differently from sros, which back-dates them.
    """

    def first_expiry(self) -> datetime:
        """Return the earlier expiry of certificate and permissions."""
        return min(self.certificate.not_after, self.permissions.not_after)

    def is_due(self, threshold: Threshold, now: datetime) -> bool:
        """Return whether the enclave is due for renewal at ``now``."""
        if threshold.remaining is not None:
            return self.first_expiry() - now <= threshold.remaining
        if threshold.elapsed is None:
            validities = self.certificate, self.permissions
            return any(validity.expires_soon_from() < now for validity in validities)
        return any(
            _elapsed_fraction(validity, now, made) >= threshold.elapsed
            for validity, made in ((self.certificate, self.written_at), (self.permissions, None))
        )


class Credentials(NamedTuple):
    """The certificate of an enclave, and the grant that DDS reads; neither is verified.

    ``signed`` is the permissions document with the grant.  ``digest`` is the SHA-256 of
    ``permissions.p7s`` in hexadecimal.  ``written_at`` is when the certificate was written to this
    keystore.
    """

    name: str
    certificate: x509.Certificate
    signed: smime.SignedDocument
    digest: str
    grant: Grant
    written_at: datetime | None

    def lifetime(self) -> Lifetime:
        """Return the validity of the certificate and of the grant."""
        return Lifetime(
            self.name, validity_of(self.certificate), self.grant.validity, self.written_at
        )


class UnreadableEnclave(NamedTuple):
    """An enclave whose certificate or permissions cannot be read, and the reason."""

    name: str
    error: SrosError


class DueEnclave(NamedTuple):
    """An enclave that is due for renewal, and when its files expire."""

    enclave: str
    """The enclave."""
    certificate_until: datetime
    """Expiry of the certificate, in UTC."""
    permissions_until: datetime
    """Expiry of the permissions, in UTC."""


class EnclaveProblem(NamedTuple):
    """An enclave whose expiry cannot be read."""

    enclave: str
    """The enclave."""
    problem: str
    """Why the expiry cannot be read."""


@shows("file", "until", "command")
class DueFile(NamedTuple):
    """A file that enclaves or robots share, and that expires within the given time."""

    file: str
    """The file: `CA`, `identity CA`, `permissions CA`, `revocation list`, `root metadata` or
    `published metadata`.
    """
    until: datetime
    """Expiry of the file, in UTC."""
    command: str
    """The command that replaces or renews the file."""
    is_renewed_by_publishing: bool = False

    def line(self, now: datetime) -> str:
        """Return a line that says when the file expires, and how to renew it."""
        word = "expired" if self.until < now else "until"
        return f"{self.file}  {word} {iso(self.until)}: {self.command}"


class FileProblem(NamedTuple):
    """A shared file whose expiry cannot be read."""

    file: str
    """The file: `CAs`, `revocation list` or `publication`."""
    problem: str
    """Why the expiry cannot be read."""


class SharedExpiry(NamedTuple):
    """The files of a keystore that enclaves or robots share, by whether they are due.

    ``published`` are files that `sros fleet publish` renews in time, without the user.
    """

    due: tuple[DueFile, ...]
    published: tuple[DueFile, ...]
    unreadable: tuple[FileProblem, ...]

    def published_text(self) -> str:
        """Return a clause on what `sros fleet publish` renews, with its expiry; "" for nothing."""
        shown = ", ".join(f"{each.file} until {iso(each.until)}" for each in self.published)
        return f"{shown} (renewed by `sros fleet publish`)" if shown else ""


class ExpiringEnclaves(NamedTuple):
    """The enclaves and the shared files of a keystore that are due for renewal."""

    enclaves: Sequence[DueEnclave]
    """Enclaves that are due, with their expiry."""
    unreadable: Sequence[EnclaveProblem]
    """Enclaves whose expiry cannot be read."""
    short_lived: Sequence[DueEnclave]
    """Short-lived enclaves, which ``sros renew`` renews only by name, with their expiry."""
    files: Sequence[DueFile]
    """CAs, revocation list and published metadata that are due."""
    unreadable_files: Sequence[FileProblem]
    """Shared files whose expiry cannot be read."""
    published: Sequence[DueFile]
    """Published metadata that ``sros fleet publish`` renews in time; it is not counted as due."""


def expiring_enclaves(renewals: ExpiryCheck, shared: SharedExpiry) -> ExpiringEnclaves:
    """Return the value that ``--json`` prints for what is due for renewal."""

    def due_enclave_values(lifetimes: Sequence[Lifetime]) -> list[DueEnclave]:
        return [
            DueEnclave(
                lifetime.name, lifetime.certificate.not_after, lifetime.permissions.not_after
            )
            for lifetime in lifetimes
        ]

    return ExpiringEnclaves(
        due_enclave_values(renewals.due),
        [EnclaveProblem(enclave.name, str(enclave.error)) for enclave in renewals.unreadable],
        due_enclave_values(renewals.short_lived),
        shared.due,
        shared.unreadable,
        shared.published,
    )


def parse_threshold(text: str) -> Threshold:
    """Parse a threshold: ``30d`` of remaining time, ``66%`` of elapsed validity, or ``soon``.

    Raises:
        UsageError: ``text`` is neither "soon", a duration nor a percentage up to 100.
    """
    if text.strip() == "soon":
        return Threshold()
    match = re.fullmatch(r"(\d{1,3})%", text.strip(), re.ASCII)
    if not match:
        return Threshold(remaining=parse_duration(text))
    if int(match[1]) > 100:
        raise UsageError(f"{text!r} is more than 100% of the validity")
    return Threshold(elapsed=int(match[1]) / 100)


def survey(keystore: OpenedKeystore) -> tuple[tuple[Lifetime, ...], tuple[UnreadableEnclave, ...]]:
    """Return the lifetimes of the readable enclaves, and the unreadable enclaves.

    All cores read the files of enclaves at the same time.
    """
    keystore.check()

    def read(name: str) -> Lifetime | UnreadableEnclave:
        try:
            return read_credentials(keystore, name).lifetime()
        except SrosError as error:
            return UnreadableEnclave(name, error)

    slices = map_slices(keystore.names, lambda names: list(map(read, names)))
    results = [result for _, part in slices for result in part]
    return (
        tuple(result for result in results if isinstance(result, Lifetime)),
        tuple(result for result in results if isinstance(result, UnreadableEnclave)),
    )


class ExpiryCheck(NamedTuple):
    """The enclaves of a keystore, by whether they are due for renewal."""

    due: tuple[Lifetime, ...]
    unreadable: tuple[UnreadableEnclave, ...]
    lasting: int
    """Number of readable enclaves that are not in `short_lived`."""
    short_lived: tuple[Lifetime, ...]
    """Enclaves that are renewed only by name (`enclaves_renewed_by_name`)."""
    moment: datetime

    def short_lived_text(self) -> str:
        """Return a clause that names short-lived enclaves, with their expiry; "" without any."""
        shown = [describe_lifetime(lifetime, self.moment) for lifetime in self.short_lived]
        enclaves = counted(len(shown), "short-lived enclave")
        return f"{enclaves} (renewed only by name): {first_few(shown, 3)}" if shown else ""


def enclaves_renewed_by_name(
    keystore: OpenedKeystore, settings: Template, names: Iterable[str]
) -> list[str]:
    """Return the short-lived enclaves among ``names``, except those of a closed robot's processes.

    The enclave of a person expires unless somebody renews it by name; a robot must keep running.
    """
    short_lived = [name for name in names if settings.longest_validity(name) is not None]
    own = enclaves_of_closed_robot(keystore.root).here if short_lived else ()
    return [name for name in short_lived if name not in own]


def due_enclaves(
    keystore: OpenedKeystore, threshold: Threshold, moment: datetime, settings: Template
) -> ExpiryCheck:
    """Return the enclaves of a keystore, grouped by whether they are due for renewal."""
    lifetimes, unreadable = survey(keystore)
    names = [lifetime.name for lifetime in lifetimes]
    by_name = {*enclaves_renewed_by_name(keystore, settings, names)}
    short_lived = tuple(lifetime for lifetime in lifetimes if lifetime.name in by_name)
    lasting = [lifetime for lifetime in lifetimes if lifetime.name not in by_name]
    due = tuple(lifetime for lifetime in lasting if lifetime.is_due(threshold, moment))
    return ExpiryCheck(due, unreadable, len(lasting), short_lived, moment)


def refuse_unreadable(
    unreadable: tuple[UnreadableEnclave, ...], verb: str, *, takes_names: bool = True
) -> None:
    """Raise an error that names all ``unreadable`` enclaves, if there are any.

    ``verb`` is a past participle for the message, such as "renewed".  ``takes_names`` says whether
    the user could run the command for only the other enclaves.
    """
    if len(unreadable) == 1:
        raise unreadable[0].error
    if unreadable:
        names = ", ".join(enclave.name for enclave in unreadable)
        alike: dict[str, list[str]] = {}  # reasons that differ only in the enclave's name
        for enclave in unreadable:
            what = enclave.error.what
            alike.setdefault(what.replace(enclave.name, ""), []).append(what)
        reasons = " ".join(
            f"{capitalized(whats[0])}{f' ({len(whats)} such enclaves)' if whats[1:] else ''}."
            for whats in alike.values()
        )
        first = unreadable[0]
        how = f" For {first.name}: {first.error.remedy}" if first.error.remedy else ""
        others = ", or name the other enclaves in the command" * takes_names
        raise KeystoreError(
            f"{len(unreadable)} enclaves cannot be {verb}: {names}",
            f"{reasons} Nothing was changed.",
            f"Repair or revoke them{others}.{how}",
        )


def read_credentials(keystore: OpenedKeystore, name: str) -> Credentials:
    """Return the certificate and the grant of an enclave, without verifying them.

    Raises:
        KeystoreError: a file is missing or cannot be read, or no grant is for the certificate.
    """
    try:
        certificate = keystore.certificate_of(name)
        subject = subject_text(certificate.subject)
        granted = keystore.signed_grant(name, subject)
    except SrosError as error:
        raise KeystoreError(
            f"enclave {name} cannot be read: {error.what}",
            error.why,
            error.remedy or f"See `sros inspect {quote(str(keystore.folder(name)))}`.",
        ) from error
    if granted.grant is None:
        raise KeystoreError(
            f"the permissions of enclave {name} have no grant for {subject}",
            "They belong to another certificate.",
            "Sign them again. "
            + remedy_in_keystore(
                keystore.root, f"`sros create_permission KEYSTORE {name} POLICY_FILE`."
            ),
        )
    written_at = None
    with suppress(OSError):
        written_at = time_of_file((keystore.folder(name) / CERTIFICATE_FILE).stat().st_mtime)
    return Credentials(name, certificate, granted.signed, granted.digest, granted.grant, written_at)


def describe_lifetime(lifetime: Lifetime, now: datetime) -> str:
    """Return a line that says whether certificate or permissions expire first, and when."""
    first = (
        "certificate"
        if lifetime.certificate.not_after <= lifetime.permissions.not_after
        else "permissions"
    )
    word = "expired" if lifetime.first_expiry() < now else "until"
    return f"{lifetime.name}  {first} {word} {iso(lifetime.first_expiry())}"


def _elapsed_fraction(validity: Window, now: datetime, made_at: datetime | None) -> float:
    """Return the fraction of a validity that is over; more than 1 after the expiry.

    The validity counts from ``made_at``, or else from the first date without its back-dating.
    """
    return 1 - (validity.not_after - now) / validity.lifetime(made_at)
