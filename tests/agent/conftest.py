"""The home of the robots in these tests."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.agent import published
from tests.agent.releases import Home, make_home
from tests.support.harness import policy_text, publish


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """A keystore and the releases of its robot r1."""
    return make_home(tmp_path_factory.mktemp("home"))


@pytest.fixture
def robot(home: Home, tmp_path: Path) -> Path:
    """The security folder of r1, as it was first delivered."""
    return home.robot(tmp_path)


@pytest.fixture(scope="session")
def made_publisher(tmp_path_factory: pytest.TempPathFactory) -> published.Home:
    """A home that has published the first releases of r1, r2 and r5; only to be copied."""
    home = published.Home(tmp_path_factory.mktemp("publisher"), datetime.now(UTC))
    (home.folder / "fleet.toml").write_text("[robots.r1]\n[robots.r2]\n[robots.r5]\n")
    (home.folder / "policy.xml").write_text(policy_text({"/{robot}/base": publish("x")}))
    home.run("create_keystore", "ks", "--template", "production")
    home.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    assert home.publish().names("published") == ["r1", "r2", "r5"]
    return home


@pytest.fixture
def publisher(made_publisher: published.Home, tmp_path: Path) -> published.Home:
    """A home of one's own that has published the first releases of r1, r2 and r5."""
    return made_publisher.copy(tmp_path / "publisher")
