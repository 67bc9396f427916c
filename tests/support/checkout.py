"""The checkout from which the tests run, and the files of it that git knows."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]


def known_files(*pathspecs: str) -> list[str]:
    """Return the files that git knows and that exist; skip the test if git knows none."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--", *pathspecs],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode:
        pytest.skip("git does not know this checkout")
    return [name for name in listed.stdout.split("\0")[:-1] if (CHECKOUT / name).is_file()]
