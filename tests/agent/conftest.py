"""The home of the robots in these tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.agent.releases import Home, make_home


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """A keystore and the releases of its robot r1."""
    return make_home(tmp_path_factory.mktemp("home"))


@pytest.fixture
def robot(home: Home, tmp_path: Path) -> Path:
    """The security folder of r1, as it was first delivered."""
    return home.robot(tmp_path)
