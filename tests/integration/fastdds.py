"""Programs that ask Debian's Fast DDS: built once for all workers, each in its own network."""

from __future__ import annotations

import fcntl
import shutil
import sys
from pathlib import Path

import pytest
from children import run

from sros_tool.runtime.netns import try_isolation

HERE = Path(__file__).parent
ISOLATED = """
import os, sys
from sros_tool.runtime.netns import end_with_parent, enter_isolation
enter_isolation()
os.execv(sys.argv[1], sys.argv[1:])
"""


def build(source: str, folder: Path) -> Path:
    """The program of a source that lies here; skips the test where it cannot be built.

    It is made in the run's common folder above ``folder``, which is a temporary one of the test's.
    """
    if not shutil.which("g++") or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("g++ and libfastrtps-dev are not installed")
    common = (each for each in folder.parents if each.parent.name.startswith("pytest-of-"))
    program = next(common, folder) / Path(source).stem
    with program.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            made = program.with_suffix(".new")
            run(["g++", "-std=c++17", "-O0", "-o", made, HERE / source, "-lfastrtps"])
            made.rename(program)
    return program


def isolated(*command: object) -> list[str]:
    """The command that runs another one in a network of its own, where there can be one."""
    words = [str(each) for each in command]
    return [sys.executable, "-c", ISOLATED, *words] if try_isolation().isolated else words
