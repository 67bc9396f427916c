"""The expiry of what the enclaves of a keystore share: CAs, revocation list, published metadata."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from shlex import quote

from sros_tool.errors import SrosError
from sros_tool.keystore.delivery.published import read_published
from sros_tool.keystore.expiry import DueFile, FileProblem, SharedExpiry, Threshold
from sros_tool.keystore.layout import IDENTITY, fleet_key_path
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import is_ca_service
from sros_tool.pki.certificates import validity_of
from sros_tool.validity import AUTHORITY_SOON, soon_limit


def shared_expiry(
    keystore: OpenedKeystore, threshold: Threshold, now: datetime, clock: datetime
) -> SharedExpiry:
    """Return the shared files of a keystore that expire within the threshold; an export has none.

    Unless the threshold is a remaining time, these are the files that expire soon.  What
    publishing renews is due only if it has already expired by the clock, whatever ``now`` is.
    """
    files: list[tuple[DueFile, timedelta]] = []
    unreadable: list[FileProblem] = []
    readers = (("CAs", _authorities), ("revocation list", _lists), ("publication", _metadata))
    for name, read in readers if keystore.is_original else ():
        try:
            files += read(keystore, now)
        except SrosError as error:
            unreadable.append(FileProblem(name, str(error)))
    due: list[DueFile] = []
    published: list[DueFile] = []
    for file, soon in files:
        if file.until - now <= (soon if threshold.remaining is None else threshold.remaining):
            is_renewed = file.is_renewed_by_publishing and file.until > min(now, clock)
            (published if is_renewed else due).append(file)
    return SharedExpiry(tuple(due), tuple(published), tuple(unreadable))


_Files = Iterator[tuple[DueFile, timedelta]]
"""Files, each with the remaining time below which it expires soon."""


def _authorities(keystore: OpenedKeystore, now: datetime) -> _Files:
    for file, roles in keystore.authority_files.items():
        validity = validity_of(keystore.certificates_of(file)[0])
        name = "CA" if len(roles) > 1 else f"{roles[0]} CA"
        option = "--next" if now <= validity.not_after else "--finish"
        if IDENTITY in roles and _has_ca_service(keystore):
            option = "--same-key --identity-ca FILE"
        soon = soon_limit(validity.lifetime(), AUTHORITY_SOON)
        yield DueFile(name, validity.not_after, _command(keystore, "rotate_ca", option)), soon


def _lists(keystore: OpenedKeystore, now: datetime) -> _Files:
    option = "--refresh --crl FILE" if _has_ca_service(keystore) else "--refresh"
    command = _command(keystore, "crl", option)
    authorities = [file for file, _ in _authorities(keystore, now)]
    lists = sorted(keystore.revocation_lists, key=lambda crl: crl.next_update)
    for crl in lists[:1]:  # in a rotation, DDS needs both lists
        for authority in authorities[:1]:  # no list is valid longer than the identity CA
            command = authority.command if authority.until <= crl.next_update else command
        soon = crl.next_update - crl.expires_soon_from()
        yield DueFile("revocation list", crl.next_update, command), soon


def _metadata(keystore: OpenedKeystore, _: datetime) -> _Files:
    record = read_published(keystore)
    publish = _command(keystore, "fleet publish", quote(record.folder or "PUB"))
    if root_end := record.root_until:
        has_key = keystore.has(fleet_key_path("root"))
        command = publish if has_key else f"{publish} --root-key FILE"
        yield DueFile("root metadata", root_end, command, has_key), soon_limit(timedelta.max)
    if (end := record.until) and end != root_end:
        yield DueFile("published metadata", end, publish, True), soon_limit(timedelta.max)


def _has_ca_service(keystore: OpenedKeystore) -> bool:
    return is_ca_service(keystore.template.identity_key)


def _command(keystore: OpenedKeystore, verb: str, words: str) -> str:
    return f"sros {verb} {quote(str(keystore.root))} {words}"
