"""Programs that ask Fast DDS: built once for all workers, each in its own network."""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.decision.vendors import FAST_DDS, Vendor
from sros_tool.runtime.netns import enter_isolation
from tests.support.children import Done, has_isolation, run

HERE = Path(__file__).parent
OWN_FASTDDS = os.environ.get("SROS_FASTDDS_PREFIX", "")
"""Where a Fast DDS with security of one's own is installed; without it, Debian's is asked."""


@cache
def fastdds_library() -> Path:
    """Return the library that is asked, under its full name, such as ``libfastdds.so.3.6.2``."""
    skip_without_fastdds()
    folders = [Path(OWN_FASTDDS, "lib")] if OWN_FASTDDS else [*Path("/usr/lib").glob("*-linux-gnu")]
    names = ("libfastdds.so", "libfastrtps.so")
    (library, *_) = (
        folder / name for folder in folders for name in names if (folder / name).exists()
    )
    return library.resolve()


def fastdds_version() -> str:
    """Return the version of the Fast DDS that is asked; skip the test without one."""
    return ".".join(fastdds_library().name.partition(".so.")[2].split(".")[:3])


@cache
def fastdds_vendor() -> Vendor:
    """Return the vendor that has the decisions of the Fast DDS that is asked."""
    if not OWN_FASTDDS:
        return Vendor.FAST_2_9
    series = fastdds_version().rpartition(".")[0]
    (vendor,) = (each for each in FAST_DDS if f"{each.release}.".startswith(f"{series}."))
    return vendor


@cache
def fastdds_stack() -> str:
    """The name under which the replies of this Fast DDS are kept; skips the test without it."""
    return f"fast-{fastdds_version()}-{openssl()}"


@cache
def openssl() -> str:
    """The series of OpenSSL of this system, which decides about certificates for all vendors."""
    library = ctypes.CDLL("libcrypto.so.3")
    library.OpenSSL_version.restype = ctypes.c_char_p
    name, version, *_ = library.OpenSSL_version(0).decode().lower().split()
    return f"{name}-{version.rpartition('.')[0]}"


def skip_without_fastdds() -> None:
    if not shutil.which("g++") or not Path(OWN_FASTDDS or "/usr", "include/fastdds").is_dir():
        pytest.skip("g++ and libfastrtps-dev are not installed")


def build(source: str, folder: Path) -> Path:
    """The program of a source that lies here; skips the test where it cannot be built.

    It is made in the run's common folder above ``folder``, which is a temporary one of the test's.
    """
    skip_without_fastdds()
    common = (each for each in folder.parents if each.parent.name.startswith("pytest-of-"))
    program = next(common, folder) / Path(source).stem
    with program.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            made = program.with_suffix(".new")
            run(["g++", "-std=c++17", "-O0", "-o", made, HERE / source, *_libraries()])
            made.rename(program)
    return program


def _libraries() -> list[str]:
    library = f"-l{fastdds_library().name.partition('.so')[0].removeprefix('lib')}"
    if not OWN_FASTDDS:
        return [library]
    include, lib = f"{OWN_FASTDDS}/include", f"{OWN_FASTDDS}/lib"
    # These tags come before $LD_LIBRARY_PATH, which may name another Fast DDS of that version.
    found = f"-Wl,-rpath,{lib},--disable-new-dtags"
    return [f"-I{include}", f"-L{lib}", found, library, "-lfastcdr"]


def run_isolated_program(*command: object, **more: Any) -> Done:
    """Run a program as `run` does, in a network of its own, where there can be one."""
    return run(command, preexec_fn=enter_isolation if has_isolation() else None, **more)
