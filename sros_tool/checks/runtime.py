"""Checks of the runtime (variables, RMW, clock, processes), and changes of their findings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from enum import StrEnum
from pathlib import Path

from sros_tool.checks.environment import is_zenoh, variable_findings, zenoh_environment_findings
from sros_tool.checks.keystores.keystore import with_joined_findings
from sros_tool.checks.kind import ERROR, Finding, FindingKind
from sros_tool.checks.processes import PROCESS_NOT_SEEN, process_findings
from sros_tool.checks.vulnerabilities import vulnerability_findings
from sros_tool.dds.advisories import Advisory
from sros_tool.runtime.processes import MappedLibrary, RunningProcesses
from sros_tool.runtime.rmw import DEFAULT_RMW, RMW, vendor_of
from sros_tool.runtime.variables import ENABLE, KEYSTORE
from sros_tool.validity import iso, time_of_file


@dataclass(frozen=True, slots=True)
class RuntimeState:
    """The input of the runtime checks: environment, clock, RMWs and processes.

    ``now`` is the moment to check for; ``clock`` is the host's clock, or None if it is ``now``.
    ``rmws`` are the installed RMWs; ``insecure_rmws`` maps an RMW that was tested and does not
    enforce security to the result of the test.  ``zone`` is the host's time zone.  ``libraries``
    are installed DDS libraries, in addition to the libraries of the processes.  ``advisories`` are
    the known vulnerabilities; None means the advisories that ship with sros.
    """

    environment: Mapping[str, str]
    now: datetime
    zone: tzinfo = UTC
    running: RunningProcesses = field(default_factory=RunningProcesses)
    rmws: tuple[str, ...] = ()
    insecure_rmws: Mapping[str, str] = field(default_factory=dict)
    clock: datetime | None = None
    libraries: tuple[MappedLibrary, ...] = ()
    advisories: tuple[Advisory, ...] | None = None


RMW_NOT_INSTALLED = FindingKind(
    "runtime.rmw-not-installed",
    ERROR,
    "RMW_IMPLEMENTATION names an RMW that is not installed",
    "No node starts.",
    "rmw_implementation 2.15 (functions.cpp).",
    "Install this RMW, or set RMW_IMPLEMENTATION to an installed one.",
)
RMW_INSECURE = FindingKind(
    "runtime.rmw-without-security",
    ERROR,
    "an RMW that is not known to enforce DDS Security",
    "The RMW was built without security, or sros does not know whether it enforces security. "
    "Nodes fail, or run unsecured.",
    "Found by a test (`sros doctor`), or by the name of the RMW.",
    "Use an RMW that enforces security according to `sros doctor`.",
)
CLOCK_BEHIND = FindingKind(
    "runtime.clock-behind",
    ERROR,
    "the clock of this host is behind",
    "The keystore's files were written later than the clock shows. Certificates may not be valid "
    "yet, and expired ones may seem valid.",
    "RFC 5280, 6.1.3 (the current time); robots without a battery for their clock.",
    "Set the clock before nodes start, for instance by chrony with makestep.",
)
_TOLERANCE = timedelta(minutes=2)


def runtime_findings(state: RuntimeState) -> list[Finding]:
    """Return all findings about an environment and the host on which it is set."""
    environment = state.environment
    return with_joined_findings(
        [
            *variable_findings(environment, now=state.now, zone=state.zone),
            *_rmw_findings(state),
            *zenoh_environment_findings(environment),
            *_clock_findings(state),
            *process_findings(environment, state.running, now=state.now, zone=state.zone),
            *vulnerability_findings(state.running, state.libraries, state.advisories),
        ]
    )


def _rmw_findings(state: RuntimeState) -> Iterator[Finding]:
    chosen = state.environment.get(RMW, "")
    if chosen and state.rmws and chosen not in state.rmws:
        text = f"{RMW} is {chosen}; installed: {', '.join(state.rmws)}"
        yield RMW_NOT_INSTALLED.found(RMW, text)
    if state.environment.get(ENABLE) != "true":
        return
    used = chosen or DEFAULT_RMW
    if not (vendor_of(used) or is_zenoh(state.environment)):
        yield RMW_INSECURE.found(used, f"sros does not know that {used} enforces security")
    elif used in state.insecure_rmws:
        yield RMW_INSECURE.found(used, state.insecure_rmws[used])


def _clock_findings(state: RuntimeState) -> Iterator[Finding]:
    """Yield a finding if a keystore of this shell, or of a process, is newer than the clock."""
    clock = state.clock or state.now
    enclaves = (process.enclave for process in state.running.processes)
    used = (
        str(enclave.local_keystore) for enclave in enclaves if enclave and enclave.local_keystore
    )
    for root in dict.fromkeys((state.environment.get(KEYSTORE, ""), *used)):
        if not root or not Path(root).is_dir():
            continue
        files = [path for name in ("ledger.jsonl", "enclaves/*.p7s", "enclaves/**/cert.pem")
                 for path in Path(root).glob(name)]  # fmt: skip
        newest = max((file.stat().st_mtime for file in files if file.exists()), default=0.0)
        written = time_of_file(newest)
        if written > clock + _TOLERANCE:
            text = f"the clock shows {iso(clock)}, but '{root}' was written at {iso(written)}"
            yield CLOCK_BEHIND.found("clock", text)
            return


class ChangeKind(StrEnum):
    """How a finding changed since the previous check."""

    NEW = "new"
    CHANGED = "changed"
    OVER = "over"


@dataclass(frozen=True, slots=True)
class FindingChange:
    """A change of a finding about processes; ``--json`` prints each change as an object on its own
    line.
    """

    time: datetime
    """Time of the check that saw the change, in UTC."""
    change: ChangeKind
    """Whether the finding is new, has a new text (``changed``), or is resolved (``over``)."""
    finding: Finding
    """The finding that changed; of a resolved finding, its last form."""

    def __str__(self) -> str:
        """Return the change as one line of text."""
        finding = self.finding
        head = f"{iso(self.time)} {self.change}: {finding.subject}: {finding.severity.word}"
        return f"{head}: {finding.kind.title} [{finding.id}]: {finding.text}"


class PreviousFindings:
    """The findings of the last check, for comparison with those of the next check."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, str], Finding] = {}

    def changes(self, findings: Iterable[Finding], now: datetime) -> Iterator[FindingChange]:
        """Yield the changes since the last check; in the first check all findings are new.

        The number of unreadable processes changes all the time, so it is reported only once.
        """
        findings_by_key: dict[tuple[str, str], Finding] = {}
        for finding in findings:
            findings_by_key.setdefault((finding.id, finding.subject), finding)
        before, self._before = self._before, findings_by_key
        for key, finding in before.items():
            if key not in findings_by_key:
                yield FindingChange(now, ChangeKind.OVER, finding)
        for key, finding in findings_by_key.items():
            if key not in before:
                yield FindingChange(now, ChangeKind.NEW, finding)
            elif finding.text != before[key].text and finding.kind is not PROCESS_NOT_SEEN:
                yield FindingChange(now, ChangeKind.CHANGED, finding)
