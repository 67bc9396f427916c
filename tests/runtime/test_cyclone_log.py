"""The log of Cyclone DDS in processes that fork."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sros_tool.runtime.cyclone import CycloneLog


def exit_of_child_that_holds(folder: Path, *, instead: bool) -> int:
    """Return 0 if a fork's log is a file, 1 if it is a folder that has its number ``instead``."""
    child = os.fork()
    if child == 0:
        status = 70
        try:
            number = CycloneLog()._file
            if instead:
                os.dup2(os.open(folder, os.O_RDONLY), number)
            inner = os.fork()
            if inner == 0:
                os._exit(int(stat.S_ISDIR(os.fstat(number).st_mode)))
            status = os.waitstatus_to_exitcode(os.waitpid(inner, 0)[1])
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_fork_leaves_a_file_alone_that_has_the_number_of_a_closed_log(tmp_path: Path) -> None:
    assert exit_of_child_that_holds(tmp_path, instead=True) == 1
    assert exit_of_child_that_holds(tmp_path, instead=False) == 0
