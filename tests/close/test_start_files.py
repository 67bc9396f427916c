"""The commands that `sros close` writes for processes."""

from __future__ import annotations

from pathlib import Path

from sros_tool.close.processes import ClosedProcess
from sros_tool.close.start_files import commands_elsewhere


def test_commands_for_other_machines_leave_out_launches_and_containers() -> None:
    process = ClosedProcess("/e", 7, ("/opt/run", "a b"), "/opt", 0, "", "program")
    launched = process._replace(launch=("ros2", "launch", "p", "f"))
    contained = process._replace(container="c0ffee")
    assert [*commands_elsewhere([launched, contained], Path("/robot"))] == []
    assert [*commands_elsewhere([launched, process, contained], Path("/robot"))] == [
        "",
        "# On other machines; FOLDER is what `sros distribute_key` wrote:",
        "# cd /opt && sros run FOLDER /e -- /opt/run 'a b'",
    ]
