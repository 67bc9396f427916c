"""A DDS that enforces security: find the machine's own, or bring Debian's Cyclone DDS."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from tools import apt
from tools.steps import CHECKOUT, LOG, VENV, output_of, root_prefix, say

UNPACKED = CHECKOUT / ".dds"
"""Where the package looks for a DDS before it asks the system."""

PACKAGE = r"libddsc0\w*"
"""Cyclone DDS 0.10 with its security plugins: libddsc0debian, libddsc0t64, or as it comes."""

_VARIABLE = "SROS_CYCLONEDDS_DIR"

_ASK = (
    "from sros_tool.runtime.cyclone_library import load_cyclone;print(load_cyclone().plugins or '')"
)


def provide(python: Path, lock: int | None) -> str | None:
    """Make sure of a DDS with security plugins; the folder of its plugins, None without one.

    Nothing here fails: without a DDS the commands still run, and explain what they miss.
    """
    plugins = plugins_found_by(python)
    if plugins is None and UNPACKED.exists():
        # Of another machine, or damaged: the package would prefer it to what apt may bring.
        shutil.rmtree(UNPACKED)
        plugins = plugins_found_by(python)
    if plugins is not None:
        return plugins

    missing = "no DDS that enforces security on this machine"
    if not apt.available():
        say(f"{missing}, and no apt to bring one; going on without")
        return None
    tried = []
    if root_prefix() is not None:
        say(f"{missing}: bringing Cyclone DDS through apt")
        apt.install(PACKAGE, lock)
        plugins = plugins_found_by(python)
        tried.append("apt-get install")
    if plugins is None:
        say(f"{missing}: unpacking Cyclone DDS under {UNPACKED.name}/, without root")
        plugins = _unpack(python, lock)
        tried.append("apt-get download")
    if plugins is None:
        say(f"no DDS that enforces security came by {' or '.join(tried)} (see {LOG}); going on")
    return plugins


def chosen_by_user() -> bool:
    """Whether a variable names the DDS to use, so that nothing else is to be brought."""
    return bool(os.environ.get(_VARIABLE))


def plugins_found_by(python: Path, folder: Path | None = None) -> str | None:
    """Where the package, asked in a process of its own, finds the security plugins.

    ``folder`` makes it look there and nowhere else.
    """
    env = dict(os.environ)
    if folder is not None:
        env[_VARIABLE] = str(folder)
    return (output_of([python, "-c", _ASK], env) or "").strip() or None


def _unpack(python: Path, lock: int | None) -> str | None:
    with tempfile.TemporaryDirectory(prefix="dds-", dir=VENV) as staging:
        whole = Path(staging, "whole")
        whole.mkdir()
        if not apt.unpack(PACKAGE, whole, lock) or plugins_found_by(python, whole) is None:
            return None
        whole.rename(UNPACKED)
    return plugins_found_by(python)
