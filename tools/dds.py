"""A DDS that enforces security: find the machine's own, or install Debian's Cyclone DDS."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path

from tools import apt
from tools.steps import APT_LOG, CHECKOUT, VENV, output_of, root_prefix, say

UNPACKED = CHECKOUT / ".dds"
"""The folder where sros looks for a DDS before it asks the system."""

_ASK = """
from sros_tool.errors import UnavailableError
from sros_tool.runtime.cyclone import load_cyclone
try:
    print(load_cyclone().plugins or "")
except UnavailableError:
    print()
"""


def provide(python: Path, lock: int | None) -> str | None:
    """Provide Cyclone DDS with security plugins; return their folder, or None.

    Never raises: without a DDS the commands still run, and report what is missing.
    """
    plugins = plugins_found_by(python)
    if plugins is None:
        # Do not install a DDS only because an edited sros does not start.
        say("sros does not start, so it cannot look for a DDS; continuing")
        return None
    if not plugins and UNPACKED.exists():
        # From another machine, or damaged: sros would prefer it to a DDS that apt installs.
        shutil.rmtree(UNPACKED)
        plugins = plugins_found_by(python)
    if plugins:
        return plugins

    missing = "no DDS that enforces security on this machine"
    if not apt.available():
        say(f"{missing}, and no apt to install one; continuing without it")
        return None
    tried = []
    if root_prefix() is not None:
        say(f"{missing}: installing Cyclone DDS with apt")
        apt.install(apt.CYCLONE_DDS, lock)
        plugins = plugins_found_by(python)
        tried.append("apt-get install")
    if not plugins:
        say(f"{missing}: unpacking Cyclone DDS under {UNPACKED.name}/")
        plugins = _unpack(python, lock)
        tried.append("apt-get download")
    if not plugins:
        without = f"{' and '.join(tried)} brought no DDS that enforces security"
        say(f"{without} (see {VENV / APT_LOG}); continuing")
    return plugins or None


def enforced_by_ros(python: Path) -> str | None:
    """Return the DDS library of the sourced ROS 2 if it enforces security by `sros doctor`."""
    try:
        answer = json.loads(output_of([python, "-m", "sros_tool", "doctor", "--json"]) or "{}")
        enforcing = [stack for stack in answer["stacks"] if stack["enforces"]]
        return next((str(stack["where"]) for stack in enforcing if stack["kind"] == "rmw"), None)
    except (ValueError, KeyError, TypeError):
        return None


def plugins_found_by(python: Path, folder: Path | None = None) -> str | None:
    """Return the folder of the security plugins, "" without, or None if sros does not start.

    With ``folder``, only that folder is searched.
    """
    env = dict(os.environ)
    if folder is not None:
        env[apt.CHOSEN_DDS] = str(folder)
    answer = output_of([python, "-c", _ASK], env)
    return None if answer is None else answer.strip()


def _unpack(python: Path, lock: int | None) -> str | None:
    with tempfile.TemporaryDirectory(prefix="dds-", dir=VENV) as staging:
        whole = Path(staging, "whole")
        whole.mkdir()
        if not apt.unpack(apt.CYCLONE_DDS, whole, lock) or not plugins_found_by(python, whole):
            return None
        whole.rename(UNPACKED)
    return plugins_found_by(python)
