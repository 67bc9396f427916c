"""The log of Cyclone DDS: in processes that fork, and what its messages advise."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from types import SimpleNamespace
from typing import cast

from sros_tool.runtime.cyclone import CycloneLibrary, CycloneLog, Participant


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


def test_a_full_domain_without_multicast_says_how_to_have_more_participants() -> None:
    said = 'lo" is not multicast-capable', "Failed to find a free participant index for domain 7"
    library = SimpleNamespace(
        log=SimpleNamespace(messages=lambda: list(said)),
        api=SimpleNamespace(dds_strretcode=lambda _code: b"Error"),
    )
    participant = object.__new__(Participant)
    participant._library = cast(CycloneLibrary, library)
    error = participant._dds_error(-1, "cannot join domain 7")
    assert "<MaxAutoParticipantIndex>100" in error.remedy and "--backend rclpy" in error.remedy
    library.log.messages = lambda: ["no such interface"]
    assert participant._dds_error(-1, "cannot join domain 7").remedy == ""
