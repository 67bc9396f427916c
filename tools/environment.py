"""The virtual environment of the checkout: created, filled, and created again if damaged.

A record in it lists what a finished setup installed; a mark file shows an interrupted setup.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import importlib.util
import os
import platform
import shutil
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from threading import Thread

from tools import apt
from tools.record import (
    LIVE_ROS,
    PYPROJECT,
    PYTHON,
    UNFINISHED,
    Record,
    current,
    difference,
    distributions_now,
    whole,
)
from tools.steps import (
    APT_LOG,
    CHECKOUT,
    LOG,
    VENV,
    SetupError,
    log_tail,
    output_of,
    root_prefix,
    say,
    succeeds,
)

GROUPS = ("package", "test", "ros", "ros-test")
"""All groups of packages, in the order of installation."""

ROS_GROUPS = ("ros", "ros-test")
"""Groups that are left out if a sourced ROS 2 has rclpy, or if no wheel fits."""

INSTALLER = "uv>=0.8,<1"
"""What installs packages in a sixth of pip's CPU time; where it cannot, pip does."""

_UV_VARIABLES = {
    "cert": "SSL_CERT_FILE",
    "constraint": "UV_CONSTRAINT",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "index-url": "UV_DEFAULT_INDEX",
    "no-cache-dir": "UV_NO_CACHE",
    "trusted-host": "UV_INSECURE_HOST",
}
"""Settings of pip that choose where packages come from, with uv's variable for each."""

_WITHOUT_EFFECT = {
    "break-system-packages",
    "default-timeout",
    "disable-pip-version-check",
    "no-input",
    "progress-bar",
    "retries",
    "root-user-action",
    "timeout",
    "user",
}
"""Settings of pip that change nothing of what gets into .venv."""

_PLACES = ("global", "install", ":env:")
"""Where a setting of `pip install` can come from; the last one holds."""

_UV = PYTHON.with_name("uv")

_TITLES = {
    "package": "sros and its dependencies",
    "test": "the dependencies of the tests",
    "ros": "rclpy of ROS 2 Jazzy",
    "ros-test": "the interfaces for tests of live ROS",
}


def prepare(
    groups: list[str], record: Record, lock: int, *, meanwhile: Callable[[], None]
) -> Record:
    """Create the environment if needed, and install ``groups`` of `GROUPS`; return the record.

    ``meanwhile`` runs in a thread while the groups are installed, and has ended at the return.
    After an error or Ctrl-C nobody waits for it: its installer keeps ``lock`` as long as it runs.

    Raises:
        SetupError: something cannot be installed; its text has the end of the log.
    """
    now = current()
    if record.surroundings == now.surroundings and record.base == now.base:
        now = replace(now, ros_around=record.ros_around)
    else:
        now = replace(now, ros_around=_has_rclpy(now))
    if not _usable(record, now):
        _make(now, lock)
        record = Record()
    else:
        LOG.unlink(missing_ok=True)
        LOG.with_name(APT_LOG).unlink(missing_ok=True)
    is_current = (
        record.requirements == now.requirements
        and record.surroundings == now.surroundings
        and whole(record)
    )
    if not is_current:
        record = Record()
    done = list(record.groups)
    with _unfinished():
        others = _started(meanwhile)
        for group in groups:
            if group not in done and _install(group, now, lock):
                done.append(group)
        others.result()
    return replace(
        now,
        groups=done,
        distributions=distributions_now(),
        dds=record.dds,
        rmw=record.rmw,
    )


def _started(work: Callable[[], None]) -> Future[None]:
    """Start ``work`` in a thread that does not outlive the program; return its future result."""
    result: Future[None] = Future()

    def run() -> None:
        try:
            work()
        except BaseException as error:
            result.set_exception(error)
        else:
            result.set_result(None)

    Thread(target=run, daemon=True).start()
    return result


def _usable(record: Record, now: Record) -> bool:
    """Return whether .venv can be used; raise `SetupError` for a user's .venv that does not fit."""
    if not VENV.exists():
        return False
    if UNFINISHED.exists():
        say("the last setup was interrupted: creating .venv again")
        return False
    if record.checkout:
        reason = difference(record, now)
        if reason:
            say(f"{reason}: creating .venv again")
        return reason is None
    answer = output_of([PYTHON, "-I", "-c", "import platform; print(platform.python_version())"])
    if not (VENV / "pyvenv.cfg").exists() or answer is None:
        say("the Python in .venv does not start: creating .venv again")
        return False
    if answer.strip() != now.version or output_of([PYTHON, "-m", "pip", "--version"]) is None:
        raise SetupError(
            f"{VENV} was not created by ./dev, and Python {now.version} cannot use it (it has"
            f" Python {answer.strip()}, or no pip). Remove or rename it, then run this command"
            " again."
        )
    say("using the existing .venv")
    return True


@contextlib.contextmanager
def _unfinished() -> Iterator[None]:
    """Mark the environment while it changes; only a killed setup leaves the mark behind."""
    UNFINISHED.touch()
    try:
        yield
    except SetupError:
        UNFINISHED.unlink()
        raise
    UNFINISHED.unlink()


def _make(now: Record, lock: int) -> None:
    _make_sure_of_venv(now, lock)
    if VENV.is_symlink() or VENV.is_file():
        VENV.unlink()
    elif VENV.exists():
        # Without this file Python does not take a half removed .venv for an environment.
        (VENV / "pyvenv.cfg").unlink(missing_ok=True)
        shutil.rmtree(VENV)
    VENV.mkdir()
    UNFINISHED.touch()
    say(f"creating .venv with Python {now.version}")
    command = [now.base, "-I", "-m", "venv", str(VENV)]
    if now.ros_around:
        # The rclpy of a sourced ROS needs the system's numpy and yaml.
        command.append("--system-site-packages")
    if not succeeds(command, env=_quiet_environment(), keep_open=lock):
        raise SetupError(f"cannot create a virtual environment in {VENV}. {log_tail()}")


def _make_sure_of_venv(now: Record, lock: int) -> None:
    if _has_venv():
        return
    package = f"python{now.version.rpartition('.')[0]}-venv"
    if now.base.startswith("/usr/bin/") and root_prefix() is not None and apt.available():
        say(f"this Python has no venv and ensurepip: installing {package} with apt")
        apt.install(package.replace(".", r"\."), lock)
        importlib.invalidate_caches()
        if _has_venv():
            return
    raise SetupError(
        f"Python {now.version} ({now.base}) comes without venv and ensurepip, which create the"
        " virtual environment for sros. On Debian and Ubuntu install them"
        f" with 'sudo apt-get update && sudo apt-get install {package}' and run this again; or name"
        " another Python that has them: PYTHON=/path/to/python3 ./dev …"
    )


def _has_venv() -> bool:
    return all(importlib.util.find_spec(name) for name in ("venv", "ensurepip"))


def _install(group: str, now: Record, lock: int) -> bool:
    """Install one group; return False to try again next time.  Raises `SetupError`."""
    optional = group in ROS_GROUPS
    if optional and (now.ros_around or not _rclpy_fits(group, now)):
        return True
    say(f"installing {_TITLES[group]}")
    wanted, quiet = _requirements(group), _quiet_environment()
    settings = None if now.ros_around else _uv_settings()  # uv never looks at packages outside
    if settings is not None and _has_uv(lock):
        command = [str(_UV), "pip", "install", "--python", str(PYTHON), *wanted]
        if succeeds(command, env=quiet | settings, keep_open=lock):
            return True
    if succeeds(_pip_install(wanted), env=quiet, keep_open=lock):
        return True
    if not optional:
        raise SetupError(f"pip cannot install {_TITLES[group]}. {log_tail()}")
    say(f"{_TITLES[group]} cannot be installed (see {LOG}); continuing without it")
    return False


def _pip_install(words: Sequence[str]) -> list[str]:
    # Python compiles what is imported, which is a small part of what is installed.
    options = ["--progress-bar=off", "--no-compile"]
    return [str(PYTHON), "-m", "pip", "install", *options, *words]


def _has_uv(lock: int) -> bool:
    """Return whether uv is in .venv, after trying to install it, but never to build it."""
    words = ["--only-binary=:all:", INSTALLER]
    return _UV.exists() or succeeds(_pip_install(words), env=_quiet_environment(), keep_open=lock)


@functools.cache
def _uv_settings() -> dict[str, str] | None:
    """Return variables that tell uv what the user told pip; None if uv cannot be told all."""
    listed = output_of([PYTHON, "-m", "pip", "config", "list"], _quiet_environment())
    if listed is None:
        return None
    # A setting is that of the environment, else of the command, else of all commands.
    found: dict[str, tuple[int, str]] = {}
    for line in listed.splitlines():
        place, _, setting = line.partition("=")[0].rpartition(".")
        if setting in _WITHOUT_EFFECT or place not in _PLACES:
            continue
        value = str(ast.literal_eval(line.partition("=")[2]))
        found[setting] = max(found.get(setting, (-1, "")), (_PLACES.index(place), value))
    if not found.keys() <= _UV_VARIABLES.keys():
        return None
    settings = {"UV_INDEX_STRATEGY": "unsafe-best-match"}  # as pip: the best of all indexes
    for setting, (_, value) in found.items():
        separator = "," if setting == "find-links" else " "
        settings[_UV_VARIABLES[setting]] = separator.join(value.split())
    return settings


def _requirements(group: str) -> list[str]:
    """Return what pip installs; extras are listed singly, so that sros is not built again."""
    if group == "package":
        return ["--editable", str(CHECKOUT)]
    if group == "ros-test":
        return list(LIVE_ROS)
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    return list(project["optional-dependencies"][group])


def _rclpy_fits(group: str, now: Record) -> bool:
    minor = int(now.version.split(".")[1])
    system = f"{platform.machine()} with {platform.libc_ver()[0] or 'another libc'}"
    if system == "x86_64 with glibc" and 10 <= minor <= 13:
        return True
    if group == "ros":
        say(f"no rclpy wheel fits Python {now.version} on {system}; continuing without rclpy")
    return False


def _quiet_environment() -> dict[str, str]:
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    env |= {"PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_NO_INPUT": "1", "PIP_USER": "0"}
    # Without this the ROS wheels start every Python of the environment twice.
    return env | {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}


def _has_rclpy(now: Record) -> bool:
    """Return whether the interpreter has a working rclpy in this shell's environment."""
    if output_of([now.base, "-c", "import rclpy.node"]) is not None:
        return True
    if output_of([now.base, "-c", "import importlib.util as u; assert u.find_spec('rclpy')"]) == "":
        say(f"the rclpy of the sourced ROS 2 does not work with Python {now.version} ({now.base})")
    return False
