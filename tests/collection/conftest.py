"""What tests with Ansible leave to the tests after them."""

from __future__ import annotations

import sys

import pytest


@pytest.fixture(autouse=True)
def own_intern(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take back the slower `sys.intern` of Ansible, which every path of the process would use.

    For this, and as Ansible is large, tests import what needs it only when they run.
    """
    monkeypatch.setattr(sys, "intern", sys.intern)
