"""The folders of the files that ship with sros: policies and keystore templates.

In a wheel they are inside the package; in a checkout they are at the top of the repository.
"""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def _shipped(name: str) -> Path:
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def policies_dir() -> Path:
    """Return the folder of the example policies and the common files that they include."""
    return _shipped("policies")


def templates_dir() -> Path:
    """Return the folder of the keystore templates, one TOML file each."""
    return _shipped("keystore_templates")


def unpacked_dds_dir() -> Path:
    """Return the folder of a checkout for the Cyclone DDS that ``./dev`` unpacks without apt."""
    return _PACKAGE.parent / ".dds"
