"""Tests that act as several users: who can, and who also reaches this checkout."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

import sros_tool

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as several users")


def open_to_all(folder: Path) -> bool:
    """Return whether users other than root can enter a folder and all folders above it."""
    folder = folder.resolve()
    return all(path.stat().st_mode & stat.S_IXOTH for path in (folder, *folder.parents))


as_users_of_sros = pytest.mark.skipif(
    os.geteuid() != 0 or not open_to_all(Path(sros_tool.__file__).parent),
    reason="only root, in a checkout that other users can enter (/root is none), can run sros "
    "as several users",
)
"""For verbs that another user runs, who then reads templates and policies of the package."""
