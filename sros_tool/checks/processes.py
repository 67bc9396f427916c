"""Checks of running ROS 2 processes: their security, their neighbors and their enclave files."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from enum import StrEnum
from math import isfinite
from pathlib import Path
from zoneinfo import ZoneInfo

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from sros_tool.checks.connections import (
    CONNECTING_TIME,
    connection_findings,
    connections_between,
    lost_memory_findings,
    with_time_to_connect,
)
from sros_tool.checks.environment import (
    OWN_CONFIGURATION,
    PROCESS_OPEN,
    is_zenoh,
    value_text,
    variables_without_enable,
    why_configuration_is_open,
    why_no_access_control,
)
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.vulnerabilities import vulnerability_metrics
from sros_tool.dds.advisories import Advisory
from sros_tool.dds.decision.grants import read_date
from sros_tool.dds.decision.vendors import FAST_DDS, DateRule, Vendor
from sros_tool.dds.permissions import Grant, parse_permissions
from sros_tool.errors import SrosError
from sros_tool.faults import KEY_MADE_ON_ROBOT, ORIGINAL_KEYSTORE, Fault
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    LEDGER,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    ROUTER_FILE,
    SESSION_FILE,
    enclave_path,
    search_enclaves,
)
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.settings import LENGTHEN_PERMISSIONS
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificates, subject_text, validity_of
from sros_tool.pki.crl import SUPERSEDED, load_crl
from sros_tool.prometheus import Metric, Sample
from sros_tool.runtime.environment import (
    OVERRIDE,
    ROUTER_URI,
    SESSION_URI,
    override_pairs,
    zenoh_environment,
)
from sros_tool.runtime.processes import (
    Process,
    ProcessEnclave,
    RunningProcesses,
    domain_text,
    plain,
)
from sros_tool.runtime.rmw import DEFAULT_RMW, RMW, vendor_of
from sros_tool.runtime.variables import DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY
from sros_tool.validity import Window, elapsed, iso, parse_iso
from sros_tool.wording import counted, enumerated, first_few
from sros_tool.xml import read_bytes
from sros_tool.zenoh.document import ZenohEndpoint
from sros_tool.zenoh.json5 import Json5Error, parse_json5

PROCESS_OUTDATED = FindingKind(
    "runtime.process-outdated",
    WARNING,
    "a process that started before its enclave's files changed",
    "A running participant does not notice changed certificates, permissions or revocation lists.",
    "Fast DDS 2.14.5, Cyclone DDS 0.10.2 (they read the files when they start).",
    "Restart the process. If its enclave lost rights that the program uses, first install a "
    "version of the program that does not use them, or sign the earlier policy again.",
)
PROCESS_REVOKED = FindingKind(
    "runtime.process-revoked",
    ERROR,
    "a process of a revoked enclave",
    "A running process keeps its certificate. Processes that started before the revocation list "
    "changed still communicate with this process.",
    "Fast DDS 2.14.5, Cyclone DDS 0.10.2 (they read the files when they start).",
    "Stop the process, and restart all processes that started before the revocation.",
)
PROCESS_WITHOUT_FILES = FindingKind(
    "runtime.process-without-files",
    WARNING,
    "a process whose enclave is not there any more",
    "The process runs with files that were removed since it started, and could not start again. "
    "Without the ledger, as on a robot, sros cannot tell whether the enclave was revoked.",
    "rcl 9 (rcl/src/rcl/security.c); tested with ROS 2 Jazzy.",
    (
        "Stop the process if its enclave was revoked; otherwise bring the enclave back, and "
        "restart the process."
    ),
)
PROCESS_EXPIRED = FindingKind(
    "runtime.process-expired",
    ERROR,
    "a process whose certificate, permissions or CA has expired",
    "A process that starts now, or that discovers this process now, refuses it.",
    "DDS-Security 1.1, 8.3.2.8 and 9.4.1.3.2.2; Fast DDS 2.14.5, Cyclone DDS 0.10.2 (they read "
    "the files when they start).",
    "Renew the enclave (`sros renew KEYSTORE ENCLAVE`), bring it here, and restart the process.",
)
PROCESS_LOCAL_TIME = FindingKind(
    "runtime.process-local-time",
    ERROR,
    "a process whose permissions Fast DDS refuses in the time zone of the process",
    'Fast DDS reads the dates of permissions in the local time of the process, and says "Not '
    'found the identity subject name in permissions file".',
    "Fast DDS 2.6 to 3.6 (mktime); tested.",
    "Start the process with TZ=UTC, or renew the enclave (`sros renew KEYSTORE ENCLAVE`). "
    f"{LENGTHEN_PERMISSIONS}",
    vendors=FAST_DDS,
)
PROCESS_REPLACEABLE = FindingKind(
    "runtime.process-files-replaceable",
    WARNING,
    "a process whose enclave other users can replace",
    "Anyone who can write to a folder of the keystore, or owns a link on the way to it, decides "
    "which files the process loads at its next start.",
    "POSIX.1-2017, rename() and unlink(): they need only the right to write to the folder.",
    "Remove the write permission of other users: `chmod go-w FOLDER`; if it is a link, start the "
    "process with the real path of the keystore.",
)
PROCESS_KEY_READABLE = FindingKind(
    "runtime.process-key-readable",
    ERROR,
    "a process whose private key others can read",
    "Anyone who can read the key can act as the enclave. Neither rcl nor DDS checks file modes.",
    "rcl 9, Fast DDS 2.14.5 and Cyclone DDS 0.10.2 check no modes.",
    "Run `chmod 600` on the key. If others had access, give the enclave another key in the "
    f"{ORIGINAL_KEYSTORE}: `sros renew KEYSTORE ENCLAVE --new-key --revoke-old`. Then export the "
    f"enclave again, if the process runs from an export.{KEY_MADE_ON_ROBOT}",
)
PROCESS_NOT_SEEN = FindingKind(
    "runtime.process-not-seen",
    WARNING,
    "processes that sros could not examine",
    "Such processes may be nodes, even open or revoked ones. The other findings do not cover them.",
    "proc(5), ptrace(2) (PTRACE_MODE_READ_FSCREDS).",
    'Run the check as root, outside of containers: `sudo "$(command -v sros)" check runtime`.',
)
ROOT_IS_NOT_ENOUGH = (
    "Being root is not enough here: the processes are in another container or user namespace, or "
    "sros lacks the capability CAP_SYS_PTRACE. Run the check on the host, outside of containers."
)

_EXPIRED_CA_REMEDY = Fault.CA_EXPIRED.remedy_in_export("").format(root="KEYSTORE")
"""Remedy for an expired CA, which can no longer renew anything."""
_MOST_LEDGER = 64 * 1024 * 1024
_MOST_LEDGERS = 2 * _MOST_LEDGER
"""Maximum number of ledger bytes to read: of one process, and of all processes of a user."""
_FIRST_OF_RANGES = 2**16
"""The first user id that may be one of many of the same person, who has a range (subuid(5))."""
_LOADED_BY_ZENOH = (IDENTITY_CA_FILE, CERTIFICATE_FILE, KEY_FILE)


def _file_findings(
    process: Process, ledgers: _Ledgers, *, now: datetime, zone: tzinfo
) -> Iterator[Finding]:
    """Yield findings about the enclave files with which a process runs."""
    enclave = process.enclave
    if enclave is None:
        return
    name = plain(enclave.name, _LONGEST_PATH)
    if enclave.problem:
        text = f"its enclave cannot be examined: {enclave.problem}"
        yield PROCESS_NOT_SEEN.found(process.label, text)
        return
    newer = list(newer_files(process, enclave))
    # If the order is unknown, the process most likely loaded the newer files.
    changed = () if why_order_is_unknown(process) else newer
    loaded = _loaded_files(enclave, changed, process, ledgers)
    if revoked := loaded.revoked:
        yield PROCESS_REVOKED.found(process.label, f"the certificate of {name} was {revoked}")
    elif not enclave.is_there or len(enclave.missing_files) == len(_required_files(enclave)):
        if not _why_unsecured(process):
            text = f"{name} in '{plain(enclave.keystore, _LONGEST_PATH)}' has no files"
            unknown = f"; {loaded.unknown}" if loaded.unknown else ""
            yield PROCESS_WITHOUT_FILES.found(process.label, f"{text}{unknown}")
        return
    elif newer:
        text = _changed_text(process, f"{', '.join(newer)} of {name}")
        yield PROCESS_OUTDATED.found(process.label, text)
    ends = {
        document: window.not_after
        for document, window in loaded.windows.items()
        if window.not_after < now
    }
    if ends:
        expired = ", ".join(f"{document} at {iso(end)}" for document, end in ends.items())
        remedy = _EXPIRED_CA_REMEDY if ends.keys() & set(_AUTHORITIES.values()) else ""
        yield PROCESS_EXPIRED.found(
            process.label, f"in {name}, these have expired: {expired}", remedy=remedy
        )
    yield from _local_time_findings(process, loaded, now, zone)
    if enclave.writable:
        yield PROCESS_REPLACEABLE.found(process.label, _plain_path(enclave.writable))
    mode = enclave.file(KEY_FILE).mode
    if mode & 0o077:
        path = _plain_path(str(enclave_path(Path(enclave.keystore), enclave.name) / KEY_FILE))
        yield PROCESS_KEY_READABLE.found(process.label, f"the mode of '{path}' is {mode:04o}")
    yield from _unread_file_findings(process, enclave)


def _changed_text(process: Process, files: str) -> str:
    """Return a clause that files changed, or may have changed, since a process started."""
    if why := why_order_is_unknown(process):
        return f"{why}, so it is not known whether {files} changed after its start"
    return f"it started at {iso(process.started)}; {files} changed later"


def why_order_is_unknown(process: Process) -> str:
    """Return why times of files do not show changes since the start of a process; "" if they do."""
    advanced = process.clock_advance
    return (
        f"the clock was set forward by {elapsed(advanced)} while the process ran"
        if advanced
        else ""
    )


def _required_files(enclave: ProcessEnclave) -> Sequence[str]:
    return [file.name for file in enclave.files if file.name not in (CRL_FILE, KEY_URI_FILE)]


PLACE_OR_MODE = "(its place or mode)"
"""The text of `newer_files` after a file or folder that has the same content as before."""


def newer_files(process: Process, enclave: ProcessEnclave) -> Iterator[str]:
    """Yield the names of the files that changed, or were removed, since a process started.

    The key's file does not count, because the certificate shows which key was loaded. If only the
    key's file changed, then either its mode or place changed, or no process can start, because the
    key does not fit the certificate.
    """
    files = enclave.files
    if process.is_zenoh:
        files = tuple(file for file in files if file.name in _LOADED_BY_ZENOH)
        files += (process.configuration,) if process.configuration else ()
    newer = [
        file.name
        for file in files
        if file.changed and file.changed > process.started and file.name not in _KEY_FILES
    ]
    gone = [name for name in enclave.missing_files if any(name == file.name for file in files)]
    yield from (_plain_path(file) for file in newer)
    yield from (f"{file} (removed)" for file in gone)
    if not newer and not gone:
        moved = [path for path, moment in enclave.moved.items() if moment > process.started]
        yield from (f"'{_plain_path(file)}' {PLACE_OR_MODE}" for file in moved[:1])


def may_lack_list(
    process: Process, enclave: ProcessEnclave, *, same_revocations: bool = False
) -> bool:
    """Return whether a process may have loaded another revocation list, or other CAs.

    The process has loaded the present list and CAs if, since its start, no file of the enclave
    changed except its certificate, permissions and governance. ``same_revocations`` says that all
    lists since the start of the process revoke the same certificates, so that a changed list does
    not matter.
    """
    moved = any(moment > process.started for moment in enclave.moved.values())
    same_files = _OWN_FILES | ({CRL_FILE} if same_revocations else set())
    return moved or not {*newer_files(process, enclave)} <= same_files


_KEY_FILES = (KEY_FILE, KEY_URI_FILE)
_OWN_FILES = {CERTIFICATE_FILE, PERMISSIONS_FILE, GOVERNANCE_FILE}


def _unread_file_findings(process: Process, enclave: ProcessEnclave) -> Iterator[Finding]:
    unread = [f"{file.name} ({file.problem})" for file in enclave.files if file.problem]
    if unread:
        text = f"its files cannot be read: {', '.join(unread)}"
        yield PROCESS_NOT_SEEN.found(process.label, text)


@dataclass(frozen=True, slots=True)
class _LoadedFiles:
    """The certificates and permissions that a process loaded at its start.

    ``windows`` maps a description, such as "its certificate", to a validity.  ``grant`` is the
    grant in the loaded permissions.  ``revoked`` is a clause that says when and why the
    certificate was revoked, or "".  ``unknown`` is a clause that says why the ledger could not
    be read, or "".
    """

    windows: Mapping[str, Window]
    grant: Grant | None = None
    revoked: str = ""
    unknown: str = ""


def _loaded_files(
    enclave: ProcessEnclave, newer_files: Sequence[str], process: Process, ledgers: _Ledgers
) -> _LoadedFiles:
    """Return the validities and rights of the files that a process loaded.

    Those of files that were replaced since (``newer_files``) come from the ledger.
    """
    windows: dict[str, Window] = {}
    changed = {file.split()[0] for file in newer_files}
    certificate = next(iter(_certificates_in(enclave, CERTIFICATE_FILE)), None)
    entries, unknown = ledgers.entries(enclave, process.user)
    before = [entry for entry in entries if entry.time <= iso(process.started)]
    serial = 0
    if certificate and CERTIFICATE_FILE not in changed:
        serial = certificate.serial_number
        windows["its certificate"] = validity_of(certificate)
    elif recorded := _last_entry(before, "certificate"):
        serial = int(recorded.serial or "0", 16)
        windows |= _recorded_window("its certificate", recorded)
    grant = None
    if PERMISSIONS_FILE not in changed:
        grant = _grant(enclave, subject_text(certificate.subject)) if certificate else None
        with suppress(SrosError, ValueError):
            windows |= {"its permissions": grant.validity} if grant else {}
    elif recorded := _last_entry(before, "permissions"):
        windows |= _recorded_window("its permissions", recorded)
    for file, authority in _AUTHORITIES.items():
        certificates = () if file in changed else _certificates_in(enclave, file)
        issuers = [e for e in certificates if certificate and e.subject == certificate.issuer]
        valid = [validity_of(issuer) for issuer in issuers or certificates]
        if valid:
            windows[authority] = max(valid, key=lambda window: window.not_after)
    return _LoadedFiles(windows, grant, _revocation_clause(enclave, entries, serial), unknown)


_AUTHORITIES = {
    IDENTITY_CA_FILE: "the certificate of its identity CA",
    PERMISSIONS_CA_FILE: "the certificate of its permissions CA",
}


def _last_entry(entries: Sequence[Entry], kind: str) -> Entry | None:
    return next((entry for entry in reversed(entries) if entry.what == kind), None)


def _recorded_window(description: str, entry: Entry) -> Mapping[str, Window]:
    with suppress(SrosError, ValueError):
        return {description: Window(parse_iso(entry.not_before), parse_iso(entry.not_after))}
    return {}


def _revocation_clause(enclave: ProcessEnclave, entries: Sequence[Entry], serial: int) -> str:
    """Return a clause that says when and why a certificate was revoked, or "".

    The ledger and the enclave's revocation list are searched for the serial number.  If ``serial``
    is 0 (not known), the last of ``entries`` on a certificate or a revocation decides.
    """
    for entry in entries:
        if entry.what == "revocation" and entry.serial and int(entry.serial, 16) == serial:
            return f"revoked at {_plain_path(entry.time)} ({plain(entry.reason)})"
    if not serial and entries:
        last = [entry for entry in entries if entry.what in ("certificate", "revocation")][-1:]
        if last and last[0].what == "revocation" and last[0].reason != SUPERSEDED:
            return f"revoked at {_plain_path(last[0].time)} ({plain(last[0].reason)})"
    with suppress(SrosError):
        data = enclave.file(CRL_FILE).data
        for revoked in load_crl(data, CRL_FILE).revoked if data else ():
            if serial and revoked.serial == serial:
                return f"revoked at {iso(revoked.date)} ({revoked.reason})"
    return ""


class _Ledgers:
    """The ledgers of the keystores that processes name, as far as they are read.

    Any user can start processes that name a ledger of their own.  So sros limits the total size of
    the ledgers that it reads for the processes of one user.
    """

    def __init__(self) -> None:
        self._read: dict[int, int] = defaultdict(int)

    def entries(self, enclave: ProcessEnclave, user: int) -> tuple[Sequence[Entry], str]:
        """Return an enclave's entries, and a clause that says why they cannot be read, or "".

        ``user`` is the user whose process names the ledger.
        """
        if enclave.local_keystore is None:
            return (), "its keystore is not at this path here"
        try:
            size = (enclave.local_keystore / LEDGER).stat().st_size
        except OSError:
            return (), "its keystore has no ledger"
        if size > _MOST_LEDGER:
            return (), f"the ledger of its keystore has more than {_MOST_LEDGER // 1024**2} MiB"
        user = min(user, _FIRST_OF_RANGES)
        if self._read[user] + size > _MOST_LEDGERS:
            most = _MOST_LEDGERS // 1024**2
            return (), (
                f"the ledger of its keystore was not read, because sros reads at most {most} MiB "
                "of ledgers for the processes of a user"
            )
        self._read[user] += size
        try:
            entries = (
                OpenedKeystore(enclave.local_keystore).ledger_with("enclave", enclave.name).entries
            )
        except SrosError as error:
            return (), f"the ledger of its keystore cannot be read: {error.what}"
        return [entry for entry in entries if entry.enclave == enclave.name], ""


def _certificates_in(enclave: ProcessEnclave, file: str) -> tuple[x509.Certificate, ...]:
    """Return the certificates in a file; none if the file is missing or unreadable."""
    data = enclave.file(file).data
    with suppress(SrosError):
        certificates = load_certificates(data, file) if data else ()
        for certificate in certificates:
            validity_of(certificate)  # raises an error for dates that no DDS accepts
        return certificates
    return ()


def _grant(enclave: ProcessEnclave, subject: str) -> Grant | None:
    data = enclave.file(PERMISSIONS_FILE).data
    with suppress(SrosError):
        return parse_permissions(smime.parse(data).document).grant_of(subject) if data else None
    return None


def _local_time_findings(
    process: Process, loaded_files: _LoadedFiles, now: datetime, zone: tzinfo
) -> Iterator[Finding]:
    """Yield a finding if permissions are valid in UTC, but not as Fast DDS reads them.

    Fast DDS reads the dates of permissions in local time.
    """
    grant = loaded_files.grant
    window = loaded_files.windows.get("its permissions")
    if not grant or not window or not window.contains(now):
        return
    if vendor_of(process.rmw) is not Vendor.FAST:
        return
    process_zone = _parse_zone(process.environment.get("TZ", ""), zone)
    begin, end = (
        read_date(DateRule.LOCAL, e, process_zone) for e in (grant.not_before, grant.not_after)
    )
    if begin is None or end is None or begin <= int(now.timestamp()) <= end:
        return
    read = " to ".join(
        iso(datetime.fromtimestamp(moment, UTC)) if isfinite(moment) else "never"
        for moment in (begin, end)
    )
    text = f"its permissions are valid from {grant.not_before} to {grant.not_after}, "
    text += f"which the process reads as {read}"
    yield PROCESS_LOCAL_TIME.found(process.label, text)


_POSIX_ZONE = re.compile(r"(?:[A-Za-z]{3,}|<[^>]+>)([+-]?)(\d{1,2})(?::(\d\d))?\Z", re.ASCII)


def _parse_zone(text: str, otherwise: tzinfo) -> tzinfo:
    """Return the time zone that ``text``, a value of TZ, names, or ``otherwise`` if it is empty.

    An unknown time zone is UTC, as in libc.
    """
    if not text:
        return otherwise
    name = text.removeprefix(":")
    if match := _POSIX_ZONE.match(name):
        west = timedelta(hours=int(match[2]), minutes=int(match[3] or 0))
        if west < timedelta(days=1):
            return timezone(west if match[1] == "-" else -west)
    try:
        return ZoneInfo(name.partition("zoneinfo/")[2] or name)
    except (ValueError, OSError, LookupError):
        return UTC


def _why_unsecured(process: Process) -> str:
    """Return why a process that requests security runs unsecured, as a clause, or "".

    The result is also "" if sros cannot know whether the process runs unsecured.
    """
    environment, enclave = process.environment, process.enclave
    if environment.get(STRATEGY) == "Enforce" or (enclave and enclave.problem):
        return ""
    if enclave is None:
        return f"{KEYSTORE} is not set"
    moments = [moment for moment in enclave.moved.values() if moment > process.started]
    if enclave.is_there and not enclave.missing_files:
        return ""
    if moments:  # its files may have been complete at its start
        return ""
    fault = f"has no {', '.join(enclave.missing_files)}" if enclave.is_there else "is not there"
    keystore = plain(enclave.keystore, _LONGEST_PATH)
    return f"{plain(enclave.name, _LONGEST_PATH)} in '{keystore}' {fault}"


def _plain_path(text: str) -> str:
    """Return a path from another process without the characters that could fake a message."""
    return "".join(
        character if character.isprintable() else "?" for character in text[:_LONGEST_PATH]
    )


_LONGEST_PATH = 300


DAEMON_UNSECURED = FindingKind(
    "runtime.daemon-unsecured",
    WARNING,
    "the ros2 daemon runs without security",
    "`ros2 topic list` and other commands ask the daemon. The daemon cannot see secured nodes, so "
    "the graph seems empty.",
    "ros2cli 0.32 (daemon); it keeps the environment in which it was started.",
    "Run `ros2 daemon stop`; the next command starts it again, with this environment.",
)
DAEMON_OTHER = FindingKind(
    "runtime.daemon-differs",
    WARNING,
    "the ros2 daemon runs with another keystore or enclave",
    "`ros2 topic list` and other commands ask the daemon, and show only what the daemon's "
    "enclave may see.",
    "ros2cli 0.32 (daemon); it keeps the environment in which it was started.",
    "Run `ros2 daemon stop`; the next command starts it again, with this environment.",
)
PROCESS_UNSECURED = FindingKind(
    "runtime.process-unsecured",
    WARNING,
    "a node without security next to secured nodes",
    "Unless the governance allows unauthenticated participants, this node and the secured nodes do "
    "not see each other.",
    "DDS-Security 1.1, 9.4.1.2 (allow_unauthenticated_participants is false).",
    "Restart it with `sros run KEYSTORE ENCLAVE -- COMMAND...`.",
)
PROCESS_RUNS_UNSECURED = FindingKind(
    "runtime.process-runs-unsecured",
    ERROR,
    "a node that runs open although security is enabled",
    "The ROS_SECURITY_STRATEGY of the node is not exactly `Enforce`, so rcl starts the node "
    "unsecured if its enclave, or a file of the enclave, is missing. Then everybody on the "
    "network hears the node and can send to it.",
    "rcl 9 (rcl/src/rcl/security.c), rmw_dds_common (security.cpp); tested with ROS 2 Jazzy.",
    "Stop it, and start it with `sros run KEYSTORE ENCLAVE -- COMMAND...`.",
)
MIXED_VENDORS = FindingKind(
    "runtime.mixed-vendors",
    WARNING,
    "secured processes on different RMWs",
    "Secured nodes on different DDS vendors do not communicate (in the tested versions), and do "
    "not report it.",
    "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; tested.",
    "Use the same RMW for all secured nodes that communicate.",
)

PROCESS_PERMISSIVE = FindingKind(
    "runtime.process-permissive",
    WARNING,
    "a process that starts without security if its enclave is missing",
    "The ROS_SECURITY_STRATEGY of the process is not exactly `Enforce`: if its enclave, or a "
    "file of the enclave, is missing, the process starts unsecured.",
    "rcl 9 (rcl/src/rcl/security.c); tested with ROS 2 Jazzy.",
    "Restart it with `sros run KEYSTORE ENCLAVE -- COMMAND...`.",
)
PROCESS_WITHOUT_RCL = FindingKind(
    "runtime.process-without-rcl",
    WARNING,
    "a program that uses a DDS without rcl, in the environment of a secured node",
    "Only rcl reads ROS_SECURITY_ENABLE and the other variables: unless the program itself secures "
    "its participants, everybody on the network hears it and can send to it.",
    "rcl 9 (rcl/src/rcl/security.c); Cyclone DDS 0.10.2, tested.",
    "Find out whether the program secures its participants; "
    "if not, stop it, or keep it out of the network of the robot.",
)
PROCESS_RMW_UNKNOWN = FindingKind(
    "runtime.process-rmw-unknown",
    ERROR,
    "a process on an RMW that sros does not know to enforce security",
    "With other RMWs, ROS_SECURITY_ENABLE=true may change nothing: then everybody on the network "
    "hears the process and can send to it.",
    "rmw 7 (rmw_security_options_t): each RMW decides what it does with the enclave.",
    "Restart it on an RMW that enforces security according to `sros doctor`.",
)
PROCESS_OTHER_KEYSTORE = FindingKind(
    "runtime.process-other-keystore",
    WARNING,
    "a secured process among processes of another keystore",
    (
        "The process trusts other CAs than the other processes of its domain, so it does not "
        "communicate with them, and neither side reports this."
    ),
    "DDS-Security 1.1, 8.3.2.8; Fast DDS 2.14.5 and Cyclone DDS 0.10.2, tested.",
    "Start all processes of a domain with one keystore, or give each keystore its own domain.",
)
PROCESS_OTHER_FOLDER = FindingKind(
    "runtime.process-other-folder",
    WARNING,
    "a process that runs in an enclave from another folder",
    "The process loaded a copy of the enclave's files. Files that are delivered here, such as a "
    "revocation list, do not reach the process, not even after a restart.",
    "rcl 9 (rcl/src/rcl/security.c): ROS_SECURITY_KEYSTORE names the folder.",
    "Stop the process, start it from the folder that gets new files (`sros run KEYSTORE ENCLAVE -- "
    "COMMAND...`), and remove the copy.",
)
PROCESS_COPIED_ENCLAVE = FindingKind(
    "runtime.process-copied-enclave",
    WARNING,
    "two processes that run in one enclave from different folders",
    "Whoever has a copy of an enclave's files has all its rights. Files that are delivered to one "
    "folder, such as a revocation list, do not reach processes from the other folder.",
    "rcl 9 (rcl/src/rcl/security.c): ROS_SECURITY_KEYSTORE names the folder.",
    "Stop the process that you did not start, and replace the key of the enclave, unless you have "
    "done so since (docs/howto/rotate.md, A key in wrong hands). If you started both processes, "
    "start them from one folder, and remove the copy.",
)
ZENOH_UNREAD = FindingKind(
    "runtime.zenoh-process-unread",
    WARNING,
    "a Zenoh process whose configuration sros cannot read",
    "Zenoh reads what sros cannot read, such as YAML, and a process without an RMW chooses its "
    "configuration itself. sros does not know whether the process enforces anything.",
    "Zenoh 1.10.2, tested.",
    "Write the configuration as JSON5 objects, or start the process with the configuration of its "
    f"enclave. {OWN_CONFIGURATION}",
)
ZENOH_CHANGED = FindingKind(
    "runtime.zenoh-process-changed",
    WARNING,
    "a Zenoh process with other settings than sros sets for its enclave",
    "Zenoh reads the file that a variable names, and then applies ZENOH_CONFIG_OVERRIDE. So "
    "each of the two can let strangers in, whatever the files of the enclave say.",
    "rmw_zenoh_cpp (zenoh_config.cpp); Zenoh 1.10.2, tested.",
    "Find out who changed the file or set the variables, undo this, and restart the process. "
    f"{OWN_CONFIGURATION}",
)
PROCESS_ELSEWHERE = FindingKind(
    "runtime.process-elsewhere",
    NOTE,
    "a node in another network namespace",
    "The node cannot reach the nodes of this network, and is compared only with nodes of its own "
    "network.",
    "network_namespaces(7).",
    "Run `sros check runtime` in that network, too, or find out whether the node is meant to be "
    "there.",
    prominent=True,
)
PROCESS_FURTHER_DOMAIN = FindingKind(
    "runtime.process-further-domain",
    NOTE,
    "a process that is also in a domain other than the one that it names",
    "A program can join further domains, as domain_bridge does, and can leave security out there. "
    "sros does not see whether it did.",
    "rclpy (Context.init), rclcpp (InitOptions::set_domain_id); tested with ROS 2 Jazzy.",
    "Look for open nodes in that domain, without ROS_SECURITY_ENABLE: `sros generate_policy "
    "open.xml --domain NUMBER --dry-run`.",
    prominent=True,
)

CONTAINER_ALONE = FindingKind(
    "runtime.container-alone",
    NOTE,
    "sros examined only the processes of this container",
    "sros runs in a PID namespace, from which the other processes of the machine cannot be seen.",
    "pid_namespaces(7).",
    "Run `sros check runtime` on the machine itself, too.",
    prominent=True,
)
NOT_SECURED = FindingKind(
    "runtime.not-secured",
    NOTE,
    "security is not enabled here: nodes start open",
    "Everybody on the network hears these nodes and can send to them. The absence of other "
    "findings says nothing about their security.",
    "rcl 9 (rcl/src/rcl/security.c); tested with ROS 2 Jazzy.",
    "Start nodes with `sros run KEYSTORE ENCLAVE -- COMMAND...`, or set the variables with "
    '`eval "$(sros env KEYSTORE ENCLAVE)"`.',
    prominent=True,
)
NODE_OPEN = FindingKind(
    "runtime.node-open",
    WARNING,
    "a node that runs open in a domain without secured nodes",
    "Everybody on the network hears the node and can send to it.",
    "rcl 9 (rcl/src/rcl/security.c); tested with ROS 2 Jazzy.",
    "Restart it with `sros run KEYSTORE ENCLAVE -- COMMAND...`, or end it if nobody needs it.",
)

_MOST_NODES = 20


class Security(StrEnum):
    """Whether sros sees that a process runs secured."""

    SECURED = "secured"
    OPEN = "open"
    UNKNOWN = "unknown"


def _security_of(process: Process) -> Security:
    """Return the security with which a process runs."""
    if process.asks_for_security and process.other_dds:
        return Security.UNKNOWN
    if process.is_zenoh:
        if process.configuration and process.configuration.problem:
            return Security.UNKNOWN
        try:
            if _why_zenoh_is_open(process):
                return Security.OPEN
            return Security.UNKNOWN if [*_zenoh_changes(process)] else Security.SECURED
        except SrosError:
            return Security.UNKNOWN
    if not process.asks_for_security:
        return Security.OPEN
    if process.is_without_rcl or (process.enclave and process.enclave.problem):
        return Security.UNKNOWN
    if vendor_of(process.rmw) is None:
        return Security.UNKNOWN
    return Security.OPEN if _why_unsecured(process) else Security.SECURED


def security_counts_text(running: RunningProcesses) -> str:
    """Return how many processes run secured and open, as a clause; "" without any process.

    If the enclaves of secured processes are in several folders, the clause names the folders.
    """
    security = [(node, _security_of(node)) for node in running.processes if not node.is_daemon]
    counts = Counter(of_node for _, of_node in security)
    texts = [f"{counts[Security.SECURED]} secured", f"{counts[Security.OPEN]} open"]
    if unknown := counts[Security.UNKNOWN]:
        texts.append(f"{unknown} perhaps open")
    unseen = ""
    if running.unseen or running.hidden:
        number = "others" if running.hidden else counted(len(running.unseen), "other")
        unseen = f" ({number} could not be examined)"
    if not (counts or unseen):
        return ""
    secured = [node for node, of_node in security if of_node is Security.SECURED]
    folders = Counter(map(_folder_of, secured))
    names = {_folder_of(node): _keystore_text(node) for node in secured}
    numbers = [f"{names[folder]} ({number})" for folder, number in folders.most_common()]
    whence = f"; secured from {enumerated(numbers)}" if len(numbers) > 1 else ""
    return f"processes that use ROS 2, DDS or Zenoh: {', '.join(texts)}{unseen}{whence}"


def unjudged_connections_text(running: RunningProcesses, now: datetime) -> str:
    """Return a clause on secured processes that may still be connecting; "" without any.

    These are processes with shared memory of Fast DDS, whose connections sros can see later.
    """
    connecting = [node for node in running.processes if node.own_ports and node.asks_for_security]
    judged = {node.pid for node in with_time_to_connect(connecting, now)}
    if young := [node for node in connecting if node.pid not in judged]:
        number = counted(len(young), "process", "processes")
        seconds = CONNECTING_TIME.seconds
        return f"connections of {number} are not judged yet: started less than {seconds} s ago"
    return ""


def process_findings(
    environment: Mapping[str, str],
    running: RunningProcesses,
    *,
    now: datetime,
    zone: tzinfo,
    finding_per_node: bool = False,
) -> Iterator[Finding]:
    """Yield findings about running processes, compared with the environment of this shell.

    ``now`` is the time on the clock of this machine, and ``zone`` is its time zone.  If security
    is not enabled here, all open nodes share one finding, unless ``finding_per_node`` is set.
    """
    is_secured_here = environment.get(ENABLE) == "true"
    own_domain = ("", domain_text(environment.get(DOMAIN, "")))
    nodes = [process for process in running.processes if not process.is_daemon]
    security = {node.pid: _security_of(node) for node in nodes}
    secured = [node for node in nodes if security[node.pid] is Security.SECURED]
    closed = {_network_and_domain(node) for node in nodes if node.asks_for_security}
    closed |= {own_domain} if is_secured_here else set()
    open_nodes: list[Process] = []
    ledgers = _Ledgers()
    for process in running.processes:
        if process.is_daemon:
            # Each domain has its own daemon; commands ask the daemon of their domain.
            if is_secured_here and _network_and_domain(process) == own_domain:
                yield from _daemon_findings(process, environment)
            continue
        if process.further_domains:
            yield PROCESS_FURTHER_DOMAIN.found(process.label, further_domains_text(process))
        yield from zenoh_findings(process)
        yield from lost_memory_findings([process])
        if process.asks_for_security:
            yield from _file_findings(process, ledgers, now=now, zone=zone)
            yield from _unsecured_findings(process)
            if process.is_without_rcl and not process.is_zenoh:
                text = f"it runs {_domain_text(process)} with {ENABLE}=true"
                yield PROCESS_WITHOUT_RCL.found(process.label, text)
            if others := [f"'{_plain_path(path)}'" for path in process.other_dds]:
                text = f"it runs {_domain_text(process)}, and also uses "
                yield PROCESS_WITHOUT_RCL.found(process.label, text + first_few(others, 3))
            if vendor_of(process.rmw) is None and not process.is_zenoh:
                text = f"it runs {_domain_text(process)} on {plain(process.rmw)}"
                yield PROCESS_RMW_UNKNOWN.found(process.label, text)
        elif security[process.pid] is Security.OPEN:
            if _network_and_domain(process) in closed:
                value = process.environment.get(ENABLE)
                stated = f"{ENABLE} '{plain(value)}', not 'true'" if value else f"no {ENABLE}"
                text = f"{_domain_text(process)}, with {stated}"
                yield PROCESS_UNSECURED.found(process.label, text)
            else:
                open_nodes.append(process)
    yield from _unsecured_node_findings(environment, open_nodes, finding_per_node=finding_per_node)
    starts_nodes = is_secured_here and bool(environment.get(ENCLAVE))
    yield from _mixed_vendor_findings(secured, environment if starts_nodes else None)
    yield from _other_keystore_findings(secured, environment if is_secured_here else None)
    root = Path(environment[KEYSTORE]) if is_secured_here and environment.get(KEYSTORE) else None
    perhaps_secured = (node for node in nodes if security[node.pid] is not Security.OPEN)
    for _, processes in group_by_authorities(perhaps_secured):
        yield from _copied_enclave_findings(processes, root)
    for _, processes in group_by_authorities(secured):
        connections = connections_between(with_time_to_connect(processes, now))
        yield from connection_findings(connections.missing)
    if root:
        copies = (node for node in nodes if node.enclave and has_other_files(node.enclave, root))
        yield from other_folder_findings(copies, root)
    yield from _different_security_findings(nodes, security)
    yield from _unseen_process_findings(running)


def _network_and_domain(process: Process) -> tuple[str, str]:
    """Return the network and the ROS domain of a process, which neighbors share."""
    return process.network, process.domain


def _domain_text(process: Process) -> str:
    network = " of another network namespace" if process.network else ""
    return f"in domain {process.domain}{network}"


def further_domains_text(process: Process) -> str:
    """Return a clause on the further domains of a process."""
    further = enumerated([*map(str, process.further_domains)])
    noun = "domain" if len(process.further_domains) == 1 else "domains"
    return f"its ports show that it is also in {noun} {further}"


def _daemon_findings(process: Process, environment: Mapping[str, str]) -> Iterator[Finding]:
    if not process.asks_for_security:
        text = f"{ENABLE} is not 'true' in its environment"
        yield DAEMON_UNSECURED.found(process.label, text)
        return
    differing = [
        name
        for name in (KEYSTORE, ENCLAVE)
        if process.environment.get(name, "") != environment.get(name, "")
    ]
    if differing:
        text = (
            f"{', '.join(differing)} {'differs' if len(differing) == 1 else 'differ'} from "
            "this environment"
        )
        yield DAEMON_OTHER.found(process.label, text)


# ── open ───────────────────────────────────────────────────────────────────────────────────


def _unsecured_findings(process: Process) -> Iterator[Finding]:
    if process.is_zenoh or process.environment.get(STRATEGY) == "Enforce":
        return
    if why := _why_unsecured(process):
        text = f"running without security, as {STRATEGY} is not 'Enforce': {why}"
        yield PROCESS_RUNS_UNSECURED.found(process.label, text)
    elif process.enclave and not process.enclave.problem:
        yield PROCESS_PERMISSIVE.found(
            process.label, value_text(_shown_variables(process.environment), STRATEGY)
        )


def _shown_variables(environment: Mapping[str, str]) -> Mapping[str, str]:
    return {name: plain(value) for name, value in environment.items() if name == STRATEGY}


def _why_zenoh_is_open(process: Process) -> str:
    """Return why a process of rmw_zenoh has no access control, as a clause, or "".

    Raises:
        SrosError: sros cannot read the configuration of the process.
    """
    variable = ROUTER_URI if process.is_router else SESSION_URI
    text = process.environment.get(variable, "")
    if process.configuration is None:
        return f"{variable} is not set"
    return why_configuration_is_open(
        process.configuration.data, _plain_path(text), process.environment.get(OVERRIDE, "")
    )


_MOST_KEYS = 5
_HARMLESS_OVERRIDES = (
    *("connect/timeout_ms", "connect/exit_on_failure", "connect/retry", "open", "timestamping"),
    *("queries_default_timeout", "qos", "stats", "transport/link/rx", "transport/link/tx"),
    *("transport/unicast/open_timeout", "transport/unicast/accept_timeout"),
    *("transport/unicast/accept_pending", "transport/unicast/max_sessions"),
)
"""Zenoh settings that, with all settings below them, do not change whom a process hears."""


def _zenoh_changes(process: Process) -> Iterator[str]:
    """Yield, as clauses, the settings of a Zenoh process that sros does not set for its enclave.

    Settings that are known to be harmless are left out; paths, too, if the enclave is not known.

    Raises:
        SrosError: the enclave is in a place that cannot be given to Zenoh.
    """
    enclave, environment = process.enclave, process.environment
    folder = enclave_path(Path(enclave.keystore), enclave.name) if enclave else Path("/")
    files = (folder / name for name in (IDENTITY_CA_FILE, CERTIFICATE_FILE, KEY_FILE))
    own = dict(override_pairs(zenoh_environment({}, *files)[OVERRIDE]))
    overrides = {
        "/".join(filter(None, key.split("/"))): value
        for key, value in override_pairs(environment.get(OVERRIDE, ""))
    }
    if enclave:
        variable = ROUTER_URI if process.is_router else SESSION_URI
        path = folder / (ROUTER_FILE if process.is_router else SESSION_FILE)
        uri = environment.get(variable, "")
        if uri not in ("", str(path)):
            yield f"{variable} names '{_plain_path(uri)}', not '{_plain_path(str(path))}'"
    else:
        own = {key: overrides.get(key, "") for key in own}
    others = [
        _plain_path(key)
        for key, value in overrides.items()
        if own.get(key) != value and not _is_harmless_override(key, value)
    ]
    if others:
        yield f"{OVERRIDE} sets {first_few(others, _MOST_KEYS)}"


def _is_harmless_override(key: str, value: str) -> bool:
    """Return whether a setting leaves a process of rmw_zenoh as closed as its enclave's files."""
    if key == "connect/endpoints":
        with suppress(Json5Error):
            endpoints = parse_json5(value)
            return isinstance(endpoints, list) and all(
                isinstance(text, str)
                and ZenohEndpoint(text).is_encrypted()
                and not ZenohEndpoint(text).options
                for text in endpoints
            )
    return any(f"{key}/".startswith(f"{name}/") for name in _HARMLESS_OVERRIDES)


def zenoh_findings(process: Process) -> Iterator[Finding]:
    """Yield a finding if a Zenoh process perhaps does not enforce the files of its enclave."""
    if not process.is_zenoh:
        return
    configuration = process.configuration
    if configuration and configuration.problem:
        named = (
            f"'{_plain_path(configuration.name)}'" if configuration.name else "its configuration"
        )
        yield ZENOH_UNREAD.found(process.label, f"{named} cannot be read: {configuration.problem}")
        return
    if configuration and configuration.changed is None:
        named = f"'{_plain_path(configuration.name)}'"
        yield ZENOH_UNREAD.found(process.label, f"{named} is not there any more")
        return
    try:
        why = _why_zenoh_is_open(process)
        changes = "; ".join(_zenoh_changes(process))
    except SrosError as error:
        yield ZENOH_UNREAD.found(process.label, _plain_path(str(error)))
        return
    if why and process.asks_for_security:
        yield PROCESS_OPEN.found(process.label, why)
    elif changes and not why:
        yield ZENOH_CHANGED.found(process.label, changes)
    elif (
        configuration
        and configuration.changed
        and configuration.changed > process.started
        and not process.asks_for_security
    ):
        text = _changed_text(process, _plain_path(configuration.name))
        yield PROCESS_OUTDATED.found(process.label, text)


def _is_open(environment: Mapping[str, str]) -> bool:
    """Return whether DDS Security is off and rmw_zenoh has no session file either."""
    if environment.get(ENABLE) == "true":
        return False
    return not is_zenoh(environment) or bool(why_no_access_control(environment, SESSION_URI))


def _unsecured_node_findings(
    environment: Mapping[str, str], nodes: Sequence[Process], *, finding_per_node: bool
) -> Iterator[Finding]:
    """Yield findings about running open nodes.

    If the environment requests no security, one finding is about the environment, and names the
    nodes; with ``finding_per_node``, there is one for each node instead.
    """
    is_set = environment.get(ENABLE) not in (None, "", "false")
    asks = is_set or variables_without_enable(environment)
    if asks or not _is_open(environment):
        for node in nodes:
            if not node.network:  # nodes in other networks have a finding of their own
                yield NODE_OPEN.found(node.label, f"it runs {_domain_text(node)}")
        return
    if finding_per_node:
        for node in nodes:
            yield NOT_SECURED.found(node.label, f"it runs open {_domain_text(node)}")
        return
    running = f"; open nodes: {_first_nodes(nodes)}" if nodes else ""
    yield NOT_SECURED.found(ENABLE, value_text(environment, ENABLE) + running)


def _first_nodes(nodes: Sequence[Process]) -> str:
    return first_few([f"{node.label} {_domain_text(node)}" for node in nodes], _MOST_NODES)


# ── next to each other ─────────────────────────────────────────────────────────────────────


def _group_by_network_and_domain(
    processes: Iterable[Process],
) -> Mapping[tuple[str, str], list[Process]]:
    groups: dict[tuple[str, str], list[Process]] = defaultdict(list)
    for process in processes:
        groups[_network_and_domain(process)].append(process)
    return groups


def _mixed_vendor_findings(
    secured: Sequence[Process], environment: Mapping[str, str] | None
) -> Iterator[Finding]:
    """Yield a finding for each network and domain with secured processes of several RMWs.

    ``environment`` is the environment of this shell if it enables security, otherwise None.
    """
    places = dict(_group_by_network_and_domain(secured))
    own_domain = ("", domain_text(environment.get(DOMAIN, ""))) if environment is not None else None
    if own_domain:
        places.setdefault(own_domain, [])
    for place, processes in places.items():
        rmws: dict[str, list[str]] = {}
        for process in processes:
            rmws.setdefault(plain(process.rmw), []).append(process.label)
        if environment is not None and place == own_domain:
            named = environment.get(RMW) or DEFAULT_RMW
            rmws.setdefault(named, []).append("this environment")
        if len({"_".join(rmw.split("_")[:2]) for rmw in rmws}) > 1:
            text = "; ".join(f"{rmw}: {', '.join(of[:3])}" for rmw, of in sorted(rmws.items()))
            yield MIXED_VENDORS.found("RMWs", text)


def _other_keystore_findings(
    secured: Sequence[Process], environment: Mapping[str, str] | None
) -> Iterator[Finding]:
    """Yield findings about DDS processes that trust another identity CA than their neighbors.

    The expected CA is the CA of most neighbors; in the network and domain of ``environment``, the
    expected CA is the one of the enclave in ``environment``.
    """
    own_domain = ("", domain_text(environment.get(DOMAIN, ""))) if environment is not None else None
    own_keys = _authority_keys_here(environment) if environment is not None else frozenset()
    for place, processes in _group_by_network_and_domain(secured).items():
        groups = group_by_authorities(process for process in processes if not process.is_zenoh)
        if own_keys and place == own_domain:
            main = f"this environment has '{plain((environment or {})[KEYSTORE], _LONGEST_PATH)}'"
            other_groups = [group for keys, group in groups if not keys & own_keys]
        else:
            if len(groups) < 2:
                continue
            (_, largest), *more = sorted(groups, key=lambda pair: -len(pair[1]))
            main = f"{largest[0].label} {_domain_text(largest[0])} has '{_keystore(largest[0])}'"
            other_groups = [group for _, group in more]
        for process in (process for group in other_groups for process in group):
            text = f"it has keystore '{_keystore(process)}', but {main}"
            yield PROCESS_OTHER_KEYSTORE.found(process.label, text)


def _copied_enclave_findings(
    processes: Sequence[Process], original: Path | None
) -> Iterator[Finding]:
    """Yield a finding for each process whose enclave another process loaded from another folder.

    The name of an enclave shows that it is the same, and so does the key, because a copy can have
    another name.  ``processes`` trust the same identity CA.  Without an ``original`` keystore, the
    folder with the most processes counts as the original.
    """
    numbers = Counter(map(_folder_of, processes))

    def rank(process: Process) -> tuple[bool, int, int]:
        is_original = original and process.enclave and _is_inside(process.enclave, original)
        return (not is_original, -numbers[_folder_of(process)], process.pid)

    first: dict[object, Process] = {}
    for process in sorted(processes, key=rank):
        assert process.enclave
        name = _enclave_name(process.enclave)
        marks = [name, *_public_keys(_certificates_in(process.enclave, CERTIFICATE_FILE))]
        for other in [first.setdefault(mark, process) for mark in marks]:
            assert other.enclave
            if other.enclave.folders[-1:] != process.enclave.folders[-1:]:
                other_name = _enclave_name(other.enclave)
                text = (
                    f"it runs in {name} from {_keystore_text(process)}, and {other.label}"
                    f"{f' in {other_name}' * (other_name != name)} from {_keystore_text(other)}"
                )
                yield PROCESS_COPIED_ENCLAVE.found(process.label, text)
                break


def _is_inside(enclave: ProcessEnclave, keystore: Path) -> bool:
    """Return whether an enclave is in a keystore, and its name does not lead out of it."""
    return ".." not in enclave.name.split("/") and enclave.is_in_keystore(keystore)


def _enclave_name(enclave: ProcessEnclave) -> str:
    return plain(f"/{enclave.name.strip('/')}", _LONGEST_PATH)


def _folder_of(process: Process) -> object:
    """Return a value that is the same for all processes whose enclaves are in one folder."""
    enclave = process.enclave
    return enclave and (enclave.folders[:1] or enclave.keystore)


def _keystore_text(process: Process) -> str:
    """Return which keystore a secured process uses, also if this shell sees another one there."""
    if not process.enclave:
        return "an unknown folder"
    is_elsewhere = process.enclave.is_there and not process.enclave.local_keystore
    return f"'{_keystore(process)}'{' of its own file system' * is_elsewhere}"


def other_folder_findings(processes: Iterable[Process], folder: Path) -> Iterator[Finding]:
    """Yield a finding for each of ``processes``, which run in enclaves of other folders."""
    for process in processes:
        assert process.enclave
        root = _plain_path(process.enclave.keystore)
        other = f"'{root}' of its own file system" if root == str(folder) else f"'{root}'"
        name = _enclave_name(process.enclave)
        text = f"it runs in {name} from {other}, not from '{folder}'"
        yield PROCESS_OTHER_FOLDER.found(process.label, text)


def has_other_files(enclave: ProcessEnclave, root: Path) -> bool:
    """Return whether ``root`` also has the enclave, with other files than the process loaded.

    False if this cannot be found out.
    """
    with suppress(SrosError, OSError):
        place = enclave_path(root, check_enclave_name(f"/{enclave.name.strip('/')}"))
        if (
            enclave.is_in_keystore(root)
            or not enclave.is_there
            or not (place / CERTIFICATE_FILE).exists()
        ):
            return False
        for name in (CERTIFICATE_FILE, PERMISSIONS_FILE, GOVERNANCE_FILE, CRL_FILE):
            has, loaded = (place / name).exists(), enclave.file(name)
            present = read_bytes(place / name, "file of the enclave") if has else b""
            if not loaded.problem and present != loaded.data:
                return True
    return False


def _keystore(process: Process) -> str:
    return plain(process.environment.get(KEYSTORE, ""), _LONGEST_PATH)


_PublicKeys = frozenset[bytes]
"""Public keys of identity CAs, as bytes in DER."""


def group_by_authorities(processes: Iterable[Process]) -> list[tuple[_PublicKeys, list[Process]]]:
    """Group processes by a common identity CA; leave out processes whose CA is not known."""
    groups: list[tuple[_PublicKeys, list[Process]]] = []
    for process in processes:
        keys = _public_keys(
            _certificates_in(process.enclave, IDENTITY_CA_FILE) if process.enclave else ()
        )
        if keys:
            together = [process]
            for of, group in [group for group in groups if group[0] & keys]:
                groups.remove((of, group))
                keys, together = keys | of, [*group, *together]
            groups.append((keys, together))
    return groups


def _authority_keys_here(environment: Mapping[str, str]) -> _PublicKeys:
    """Return the public keys of the identity CAs of the enclave that an environment names.

    Without such a name, the first enclave of the keystore counts.
    """
    root = Path(environment.get(KEYSTORE, ""))
    name = environment.get(ENCLAVE) or next(iter(search_enclaves(root)[0]), "/")
    folder = enclave_path(root, name)
    with suppress(SrosError):  # other findings say what is wrong there
        file = folder / IDENTITY_CA_FILE
        return _public_keys(load_certificates(read_bytes(file, "CA certificate"), str(file)))
    return frozenset()


def _public_keys(certificates: Iterable[x509.Certificate]) -> _PublicKeys:
    keys = set()
    for certificate in certificates:
        with suppress(ValueError, UnsupportedAlgorithm):
            keys.add(certificate.public_key().public_bytes(*_PUBLIC_KEY_FORM))
    return frozenset(keys)


_PUBLIC_KEY_FORM = (Encoding.DER, PublicFormat.SubjectPublicKeyInfo)


def _different_security_findings(
    nodes: Sequence[Process], security: Mapping[int, Security]
) -> Iterator[Finding]:
    for node in nodes:
        if node.network:
            where = f"in domain {node.domain} of the network namespace {node.network}"
            text = f"{security[node.pid]}, {where}"
            yield PROCESS_ELSEWHERE.found(node.label, text)


def _unseen_process_findings(running: RunningProcesses) -> Iterator[Finding]:
    """Yield a finding for each node that could not be examined, and a finding with their number."""
    remedy = ROOT_IS_NOT_ENOUGH if running.is_run_by_root else ""
    for process in running.unseen:
        if process.uses_ros:
            text = f"it uses ROS 2, but cannot be examined: {process.why}"
            yield PROCESS_NOT_SEEN.found(process.label, text, remedy=remedy)
    doubtful = [process for process in running.unseen if not process.uses_ros]
    reasons = [running.hidden] if running.hidden else []
    if doubtful:
        processes = first_few([f"{process.label} ({process.why})" for process in doubtful], 3)
        may_be = "may be a node" if len(doubtful) == 1 else "may be nodes"
        reasons.append(f"{processes} {may_be}, but cannot be examined")
    if running.is_in_container:
        text = (
            f"{len(running.processes)} of them "
            f"{'uses' if len(running.processes) == 1 else 'use'} ROS 2"
        )
        yield CONTAINER_ALONE.found("processes", text)
    if reasons:
        yield PROCESS_NOT_SEEN.found("processes", "; ".join(reasons), remedy=remedy)


# ── metrics ────────────────────────────────────────────────────────────────────────────────


def runtime_metrics(
    environment: Mapping[str, str],
    running: RunningProcesses,
    *,
    now: datetime,
    zone: tzinfo,
    advisories: Sequence[Advisory] | None = None,
) -> tuple[Metric, ...]:
    """Return the metrics of the running processes, compared with the environment of this shell.

    ``advisories`` are the known vulnerabilities; None means the advisories that ship with sros.
    """
    security = Counter(_security_of(process) for process in running.processes)
    findings = process_findings(environment, running, now=now, zone=zone)
    kinds = Counter((finding.severity, finding.id) for finding in findings)
    return (
        Metric(
            "sros_processes",
            "Number of processes that use ROS 2, by security (secured, open or unknown).",
            tuple(Sample(security[level], {"security": level.value}) for level in Security),
        ),
        Metric(
            "sros_processes_not_seen",
            "Number of processes that sros could not examine, and that may be nodes.",
            (Sample(len(running.unseen) + bool(running.hidden)),),
        ),
        Metric(
            "sros_process_findings",
            "Number of findings of `sros check runtime` about processes, by the id of their kind.",
            tuple(
                Sample(number, {"severity": severity.word, "id": identity})
                for (severity, identity), number in sorted(kinds.items())
            ),
        ),
        *vulnerability_metrics(running, advisories),
        Metric(
            "sros_processes_examined_timestamp_seconds",
            "When the processes were examined, in seconds since 1970.",
            (Sample(int(now.timestamp())),),
        ),
    )
