"""Checks of the files with which processes run: older ones, revoked, expired, or replaceable."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from math import isfinite
from zoneinfo import ZoneInfo

from cryptography import x509

from sros_tool.checks.kind import ERROR, WARNING, Finding, FindingKind
from sros_tool.dds.decision.moments import read_moment
from sros_tool.dds.decision.vendors import Moments, Vendor
from sros_tool.dds.permissions import Grant, parse_permissions
from sros_tool.errors import SrosError
from sros_tool.faults import Fault
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    LEDGER,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
)
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.reader import Keystore
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificates, subject_text, validity_of
from sros_tool.pki.crl import SUPERSEDED, load_crl
from sros_tool.runtime.process_files import ProcessEnclave
from sros_tool.runtime.processes import Process, plain
from sros_tool.runtime.rmw import vendor_of
from sros_tool.runtime.variables import KEYSTORE, STRATEGY
from sros_tool.validity import Window, iso, parse_iso

PROCESS_OUTDATED = FindingKind(
    "runtime.process-outdated",
    WARNING,
    "a process that started before its enclave's files changed",
    "A running participant does not notice changed certificates, permissions or revocation lists.",
    "Fast DDS 2.14.5, Cyclone DDS 0.10.2 (read at the start).",
    "Restart the process.",
)
PROCESS_REVOKED = FindingKind(
    "runtime.process-revoked",
    ERROR,
    "a process of a revoked enclave",
    "It keeps its certificate until it ends. Processes that started before the revocation list "
    "changed still communicate with it.",
    "Fast DDS 2.14.5, Cyclone DDS 0.10.2 (read at the start).",
    "Stop it, and restart the processes that started before the revocation.",
)
PROCESS_WITHOUT_FILES = FindingKind(
    "runtime.process-without-files",
    WARNING,
    "a process whose enclave is not there any more",
    "It runs with files that were removed since it started, and does not start again. Where the "
    "ledger is not, as on a robot, sros cannot tell whether the enclave was revoked.",
    "rcl 9 (rcl/src/rcl/security.c); ran with ROS 2 Jazzy.",
    "Stop it if its enclave was revoked; otherwise bring the enclave back, and restart it.",
)
PROCESS_EXPIRED = FindingKind(
    "runtime.process-expired",
    ERROR,
    "a process whose certificate, permissions or CA has expired",
    "Processes that start, or find it, from now on refuse it.",
    "DDS-Security 1.1, 8.3.2.8 and 9.4.1.3.2.2; Fast DDS 2.14.5, Cyclone DDS 0.10.2 (read at the "
    "start).",
    "Renew the enclave (`sros renew ROOT NAME`), bring it here, and restart the process.",
)
PROCESS_LOCAL_TIME = FindingKind(
    "runtime.process-local-time",
    ERROR,
    "a process whose permissions Fast DDS refuses in its time zone",
    'Fast DDS reads their dates in the local time of the process, and says "Not found the '
    'identity subject name in permissions file".',
    "Fast DDS 2.9.1 and 2.14.5 (mktime); measured.",
    "Run `sros renew ROOT NAME`, or start the process with TZ=UTC.",
    vendors=(Vendor.FAST,),
)
PROCESS_REPLACEABLE = FindingKind(
    "runtime.process-files-replaceable",
    WARNING,
    "a process whose enclave other users can replace",
    "Whoever can write to a folder of the keystore decides with which files the process starts "
    "the next time.",
    "POSIX.1-2017, rename() and unlink(): they need only the right to write to the folder.",
    "Take the right to write from others: `chmod go-w FOLDER`.",
)
PROCESS_NOT_SEEN = FindingKind(
    "runtime.process-not-seen",
    WARNING,
    "processes that could not be looked at",
    "They may be nodes, also open or revoked ones. That nothing else is found says nothing about "
    "them.",
    "proc(5), ptrace(2) (PTRACE_MODE_READ_FSCREDS).",
    "Run it as root: `sudo sros check runtime`.",
)

_NEW_AUTHORITY = Fault.CA_EXPIRED.remedy_in_export("").format(root="ROOT")
"""The remedy where a CA has expired, and nothing can be renewed with it."""
_MOST_LEDGER = 64 * 1024 * 1024
_LOADED_BY_ZENOH = (IDENTITY_CA_FILE, CERTIFICATE_FILE, KEY_FILE)


def file_findings(process: Process, *, now: datetime, zone: tzinfo) -> Iterator[Finding]:
    """Yield the findings about the files with which a process runs."""
    enclave = process.enclave
    if enclave is None:
        return
    name = plain(enclave.name, LONGEST_PATH)
    if enclave.problem:
        text = f"its enclave cannot be looked at: {enclave.problem}"
        yield PROCESS_NOT_SEEN.found(process.label, text)
        return
    newer = list(_newer(process, enclave))
    loaded = _loaded(enclave, newer, process.started)
    if revoked := loaded.revoked:
        yield PROCESS_REVOKED.found(process.label, f"the certificate of {name} was {revoked}")
    elif not enclave.is_there or len(enclave.lacking) == len(_required(enclave)):
        if not unsecured_because(process):
            text = f"{name} in '{plain(enclave.keystore, LONGEST_PATH)}' has no files"
            unknown = f"; {loaded.unknown}" if loaded.unknown else ""
            yield PROCESS_WITHOUT_FILES.found(process.label, f"{text}{unknown}")
        return
    elif newer:
        text = f"it started at {iso(process.started)}; {', '.join(newer)} of {name} changed later"
        yield PROCESS_OUTDATED.found(process.label, text)
    ends = {what: each.not_after for what, each in loaded.windows.items() if each.not_after < now}
    if ends:
        expired = ", ".join(f"{what} at {iso(end)}" for what, end in ends.items())
        remedy = _NEW_AUTHORITY if ends.keys() & set(_AUTHORITIES.values()) else ""
        yield PROCESS_EXPIRED.found(process.label, f"of {name} expired: {expired}", remedy=remedy)
    yield from _local_time(process, loaded, now, zone)
    if enclave.writable:
        yield PROCESS_REPLACEABLE.found(process.label, plain_path(enclave.writable))
    yield from _unread_files(process, enclave)


def _required(enclave: ProcessEnclave) -> Sequence[str]:
    return [each.name for each in enclave.files if each.name not in (CRL_FILE, KEY_URI_FILE)]


def _newer(process: Process, enclave: ProcessEnclave) -> Iterator[str]:
    """Yield the names of the files that changed, or were removed, since a process started."""
    files = enclave.files
    if process.is_zenoh:
        files = tuple(each for each in files if each.name in _LOADED_BY_ZENOH)
        files += (process.configuration,) if process.configuration else ()
    newer = [e.name for e in files if e.changed and e.changed > process.started]
    gone = [each for each in enclave.lacking if any(each == file.name for file in files)]
    yield from (plain_path(each) for each in newer)
    yield from (f"{each} (removed)" for each in gone)
    if not newer and not gone:
        moved = [path for path, moment in enclave.moved.items() if moment > process.started]
        yield from (f"'{plain_path(each)}' (moved, or its mode)" for each in moved[:1])


def _unread_files(process: Process, enclave: ProcessEnclave) -> Iterator[Finding]:
    unread = [f"{each.name} ({each.problem})" for each in enclave.files if each.problem]
    if unread:
        text = f"its files cannot be looked at: {', '.join(unread)}"
        yield PROCESS_NOT_SEEN.found(process.label, text)


@dataclass(frozen=True, slots=True)
class _Loaded:
    """What a process loaded at its start, as far as it is known now.

    ``windows`` maps what it loaded to its validity, and ``grant`` is in its permissions.
    ``revoked`` says when and why its certificate was revoked, as a clause, or is ""; ``unknown``
    why that is not known.
    """

    windows: Mapping[str, Window]
    grant: Grant | None = None
    revoked: str = ""
    unknown: str = ""


def _loaded(enclave: ProcessEnclave, newer: Sequence[str], started: datetime) -> _Loaded:
    """Return what a process loaded: what unchanged files say, and what the ledger has of others."""
    windows: dict[str, Window] = {}
    changed = {each.split()[0] for each in newer}
    certificate = next(iter(certificates_in(enclave, CERTIFICATE_FILE)), None)
    entries, unknown = _entries(enclave)
    before = [each for each in entries if each.time <= iso(started)]
    serial = 0
    if certificate and CERTIFICATE_FILE not in changed:
        serial = certificate.serial_number
        windows["its certificate"] = validity_of(certificate)
    elif recorded := _last(before, "certificate"):
        serial = int(recorded.serial or "0", 16)
        windows |= _recorded_window("its certificate", recorded)
    grant = None
    if PERMISSIONS_FILE not in changed:
        grant = _grant(enclave, subject_text(certificate.subject)) if certificate else None
        with suppress(SrosError, ValueError):
            windows |= {"its permissions": grant.validity} if grant else {}
    elif recorded := _last(before, "permissions"):
        windows |= _recorded_window("its permissions", recorded)
    for file, what in _AUTHORITIES.items():
        found = () if file in changed else certificates_in(enclave, file)
        issuers = [e for e in found if certificate and e.subject == certificate.issuer]
        valid = [validity_of(each) for each in issuers or found]
        if valid:
            windows[what] = max(valid, key=lambda window: window.not_after)
    return _Loaded(windows, grant, _revoked(enclave, entries, serial), unknown)


_AUTHORITIES = {
    IDENTITY_CA_FILE: "the certificate of its identity CA",
    PERMISSIONS_CA_FILE: "the certificate of its permissions CA",
}


def _last(entries: Sequence[Entry], what: str) -> Entry | None:
    return next((each for each in reversed(entries) if each.what == what), None)


def _recorded_window(what: str, entry: Entry) -> Mapping[str, Window]:
    with suppress(SrosError, ValueError):
        return {what: Window(parse_iso(entry.not_before), parse_iso(entry.not_after))}
    return {}


def _revoked(enclave: ProcessEnclave, entries: Sequence[Entry], serial: int) -> str:
    """Return when and why a certificate was revoked, by the ledger or the list, as a clause."""
    for each in entries:
        if each.what == "revocation" and each.serial and int(each.serial, 16) == serial:
            return f"revoked at {plain_path(each.time)} ({plain(each.reason)})"
    if not serial and entries:
        last = [each for each in entries if each.what in ("certificate", "revocation")][-1:]
        if last and last[0].what == "revocation" and last[0].reason != SUPERSEDED:
            return f"revoked at {plain_path(last[0].time)} ({plain(last[0].reason)})"
    with suppress(SrosError):
        data = enclave.file(CRL_FILE).data
        for entry in load_crl(data, CRL_FILE).revoked if data else ():
            if serial and entry.serial == serial:
                return f"revoked at {iso(entry.date)} ({entry.reason})"
    return ""


def _entries(enclave: ProcessEnclave) -> tuple[Sequence[Entry], str]:
    """Return what the ledger records of an enclave, and why it cannot be asked, as a clause."""
    if enclave.here is None:
        return (), "its keystore is not at this path here"
    ledger = enclave.here / LEDGER
    try:
        size = ledger.stat().st_size
    except OSError:
        return (), "its keystore has no ledger"
    if size > _MOST_LEDGER:
        return (), f"the ledger of its keystore has more than {_MOST_LEDGER // 1024**2} MiB"
    try:
        entries = Keystore(enclave.here).ledger_with("enclave", enclave.name).entries
    except SrosError as error:
        return (), f"the ledger of its keystore cannot be read: {error.what}"
    return [each for each in entries if each.enclave == enclave.name], ""


def certificates_in(enclave: ProcessEnclave, file: str) -> tuple[x509.Certificate, ...]:
    """Return the certificates of a file, or none if it is not there or cannot be read."""
    data = enclave.file(file).data
    with suppress(SrosError):
        found = load_certificates(data, file) if data else ()
        for each in found:
            validity_of(each)  # an error for dates that no DDS accepts
        return found
    return ()


def _grant(enclave: ProcessEnclave, subject: str) -> Grant | None:
    data = enclave.file(PERMISSIONS_FILE).data
    with suppress(SrosError):
        return parse_permissions(smime.parse(data).document).grant_of(subject) if data else None
    return None


def _local_time(
    process: Process, loaded: _Loaded, now: datetime, zone: tzinfo
) -> Iterator[Finding]:
    """Yield a finding if Fast DDS reads the dates of permissions as passed, or still to come."""
    grant = loaded.grant
    window = loaded.windows.get("its permissions")
    if not grant or not window or not window.contains(now):
        return
    if vendor_of(process.rmw) is not Vendor.FAST:
        return
    own = _zone(process.environment.get("TZ", ""), zone)
    begin, end = (read_moment(Moments.LOCAL, e, own) for e in (grant.not_before, grant.not_after))
    if begin is None or end is None or begin <= int(now.timestamp()) <= end:
        return
    read = " to ".join(
        iso(datetime.fromtimestamp(each, UTC)) if isfinite(each) else "never"
        for each in (begin, end)
    )
    text = f"they are valid from {grant.not_before} to {grant.not_after}, which it reads as {read}"
    yield PROCESS_LOCAL_TIME.found(process.label, text)


_POSIX_ZONE = re.compile(r"(?:[A-Za-z]{3,}|<[^>]+>)([+-]?)(\d{1,2})(?::(\d\d))?\Z", re.ASCII)


def _zone(text: str, otherwise: tzinfo) -> tzinfo:
    """Return the time zone that TZ names, or ``otherwise``; an unknown one is UTC, as for libc."""
    if not text:
        return otherwise
    name = text.removeprefix(":")
    if found := _POSIX_ZONE.match(name):
        west = timedelta(hours=int(found[2]), minutes=int(found[3] or 0))
        if west < timedelta(days=1):
            return timezone(west if found[1] == "-" else -west)
    try:
        return ZoneInfo(name.partition("zoneinfo/")[2] or name)
    except (ValueError, OSError, LookupError):
        return UTC


def unsecured_because(process: Process) -> str:
    """Return why a process that asks for security runs without it, as a clause, or ""."""
    environment, enclave = process.environment, process.enclave
    if environment.get(STRATEGY) == "Enforce" or (enclave and enclave.problem):
        return ""
    if enclave is None:
        return f"{KEYSTORE} is not set"
    moments = [each for each in enclave.moved.values() if each > process.started]
    if enclave.is_there and not enclave.lacking:
        return ""
    if moments:  # its files may have been there
        return ""
    what = f"has no {', '.join(enclave.lacking)}" if enclave.is_there else "is not there"
    keystore = plain(enclave.keystore, LONGEST_PATH)
    return f"{plain(enclave.name, LONGEST_PATH)} in '{keystore}' {what}"


def plain_path(text: str) -> str:
    """Return a text with a path in it so that it can be taken for nothing else in a message."""
    return "".join(each if each.isprintable() else "?" for each in text[:LONGEST_PATH])


LONGEST_PATH = 300
