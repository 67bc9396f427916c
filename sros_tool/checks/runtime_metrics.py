"""The running processes as metrics: how many are secured, and with which findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from datetime import datetime, tzinfo

from sros_tool.checks.processes import Security, process_findings, security_of
from sros_tool.prometheus import Metric, Sample
from sros_tool.runtime.processes import RunningProcesses


def runtime_metrics(
    environment: Mapping[str, str], running: RunningProcesses, *, now: datetime, zone: tzinfo
) -> tuple[Metric, ...]:
    """Return the metrics of the processes that run, from the place of an environment."""
    security = Counter(security_of(each) for each in running.processes)
    findings = process_findings(environment, running, now=now, zone=zone)
    kinds = Counter((each.severity, each.id) for each in findings)
    return (
        Metric(
            "sros_processes",
            "Number of processes that speak ROS 2 by their security (secured, open or unknown).",
            tuple(Sample(security[each], {"security": each.value}) for each in Security),
        ),
        Metric(
            "sros_processes_not_seen",
            "Number of processes that could not be looked at, which may be nodes.",
            (Sample(len(running.unseen) + bool(running.hidden)),),
        ),
        Metric(
            "sros_process_findings",
            "Number of findings of `sros check runtime` about processes by the id of their kind.",
            tuple(
                Sample(number, {"severity": severity.word, "id": identity})
                for (severity, identity), number in sorted(kinds.items())
            ),
        ),
        Metric(
            "sros_processes_examined_timestamp_seconds",
            "When the processes were examined, in seconds since 1970.",
            (Sample(int(now.timestamp())),),
        ),
    )
