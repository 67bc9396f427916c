"""A plugin with which pytest imports the modules of tests, and makes no tests of what they have."""

from __future__ import annotations

import gc

gc.disable()  # this process ends soon, and the syntax trees of the tests are no garbage


def pytest_pycollect_makeitem() -> list[object]:
    """Say that nothing in a module is a test."""
    return []
