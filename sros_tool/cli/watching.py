"""The option ``--watch`` of `check runtime`: reports each change among the processes once."""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from sros_tool.cli.common import local_zone, now
from sros_tool.terminal import echo, echo_lines, visible_json
from sros_tool.values import versioned

if TYPE_CHECKING:
    from sros_tool.checks.registry import FindingFilter
    from sros_tool.runtime.processes import RunningProcesses

_SECONDS = 2.0
"""Time between two looks at the processes."""
_AGAIN = timedelta(minutes=1)
"""Time after which unchanged processes are judged again, because files expire."""
_ENDING = (signal.SIGINT, signal.SIGTERM)


def watch_processes(
    environment: Mapping[str, str], selection: FindingFilter, *, as_json: bool
) -> None:
    """Report what changes among the findings about processes, until SIGINT or SIGTERM."""
    from sros_tool.checks.news import FindingNews
    from sros_tool.checks.processes import process_findings
    from sros_tool.runtime.processes import ProcessTable

    table, news, zone = ProcessTable(), FindingNews(), local_zone(environment)
    judged: tuple[RunningProcesses, datetime] | None = None
    # Blocked, they come only where they are waited for: no line is cut off.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        echo("watching the processes of this machine until SIGINT (Ctrl-C) or SIGTERM", err=True)
        while True:
            moment = now()
            running = table.look(moment)
            if judged is None or judged[0] != running or moment - judged[1] >= _AGAIN:
                judged = running, moment
                found = process_findings(
                    environment, running, now=moment, zone=zone, one_by_one=True
                )
                for change in news.changes(selection.choose(found).shown, moment):
                    if as_json:
                        line = json.dumps(versioned(change), ensure_ascii=False)
                        echo_lines(visible_json(line))
                    else:
                        echo(str(change))
            if signal.sigtimedwait(_ENDING, _SECONDS):
                return
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
