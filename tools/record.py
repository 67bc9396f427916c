"""The record of a finished setup, and its comparison with the current state."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from tools.steps import CHECKOUT, VENV

PYTHON = VENV / "bin" / "python"
PYPROJECT = CHECKOUT / "pyproject.toml"

LIVE_ROS = ("ros-std-srvs==5.3.6", "ros-test-msgs==2.0.3")
"""Interfaces that only the tests of a live ROS graph use; built for the rclpy wheels."""

UNFINISHED = VENV / "sros-setup.unfinished"
"""The mark file that exists while an installer runs; an environment with it is not trusted."""

_RECORD = VENV / "sros-setup.json"
_SURROUNDINGS = ("PYTHONPATH", "AMENT_PREFIX_PATH", "CONDA_PREFIX")


@dataclass(frozen=True)
class Record:
    """The state that a finished setup found and installed.

    ``base`` is the interpreter of the environment; ``ros_around`` says whether it has the rclpy of
    a sourced ROS 2.  ``dds`` is the folder of Cyclone DDS' security plugins; ``rmw`` is the DDS
    library of the sourced ROS 2 if it enforces security.
    """

    checkout: str = ""
    base: str = ""
    version: str = ""
    requirements: str = ""
    surroundings: str = ""
    ros_around: bool = False
    groups: list[str] = field(default_factory=list)
    distributions: list[str] = field(default_factory=list)
    dds: str | None = None
    rmw: str | None = None


def read_record() -> Record:
    """Return the record of the last setup, or an empty one if it is missing or not trusted."""
    try:
        found = Record(**json.loads(_RECORD.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return Record()
    return Record() if UNFINISHED.exists() else found


def write_record(record: Record) -> None:
    """Write the record of a finished setup atomically."""
    staged = _RECORD.with_suffix(".new")
    staged.write_text(json.dumps(asdict(record), indent=1), encoding="utf-8")
    staged.replace(_RECORD)


def current() -> Record:
    """Return the record of this checkout and interpreter, with nothing installed yet."""
    requirements = PYPROJECT.read_bytes() + repr(LIVE_ROS).encode()
    around = repr([os.environ.get(name) for name in _SURROUNDINGS]).encode()
    return Record(
        checkout=str(CHECKOUT),
        base=str(base_interpreter()),
        version=platform.python_version(),
        requirements=hashlib.sha256(requirements).hexdigest(),
        surroundings=hashlib.sha256(around).hexdigest(),
    )


def base_interpreter() -> Path:
    """Return the Python of this process, outside of any virtual environment."""
    real = Path(sys.executable).resolve()
    if real.is_relative_to(VENV):
        return Path(getattr(sys, "_base_executable", sys.executable)).resolve()
    return real


def holds(record: Record, now: Record, groups: list[str]) -> bool:
    """Return whether a recorded setup is still valid and has all ``groups``."""
    same = replace(
        now,
        ros_around=record.ros_around,
        groups=record.groups,
        distributions=record.distributions,
        dds=record.dds,
        rmw=record.rmw,
    )
    return record == same and set(groups) <= set(record.groups) and whole(record)


def difference(record: Record, now: Record) -> str | None:
    """Return why the environment must be created again, or None if it can be used."""
    if record.checkout != now.checkout:
        return f"this checkout was moved here from {record.checkout}"
    if (record.base, record.version) != (now.base, now.version):
        return f"Python {record.version} ({record.base}) was replaced by {now.version} ({now.base})"
    if record.ros_around != now.ros_around:
        return f"a ROS 2 with rclpy is {'now' if now.ros_around else 'no longer'} sourced"
    if not PYTHON.exists():
        return "the Python in .venv is missing"
    return None


def whole(record: Record) -> bool:
    """Return whether the environment still has everything that the setup installed."""
    packages = _site_packages(record.version)
    return PYTHON.exists() and all((packages / name).exists() for name in record.distributions)


def _site_packages(version: str) -> Path:
    return VENV / "lib" / f"python{version.rpartition('.')[0]}" / "site-packages"


def distributions_now() -> list[str]:
    """Return the names of the metadata folders of all distributions in the environment."""
    return sorted(path.name for path in VENV.glob("lib/python3.*/site-packages/*.dist-info"))
