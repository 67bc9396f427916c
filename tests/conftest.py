"""Fixtures for all tests."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from harness import policy_text, publish, sros

STARTED_ONCE = ("learned", "shown")
"""Fixtures that start many processes for many tests, which therefore share a worker."""

POLICY = policy_text({"/a": publish("old_a"), "/b": publish("old_b")})


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep on one worker what shares an expensive fixture."""
    for item in items:
        for name in STARTED_ONCE:
            if name in getattr(item, "fixturenames", ()):
                item.add_marker(pytest.mark.xdist_group(f"{item.path.stem}.{name}"))


@pytest.fixture(autouse=True)
def no_ros_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests do not depend on the ROS environment of whoever runs them."""
    for name in list(os.environ):
        if name.startswith(("ROS_SECURITY_", "ROS_DOMAIN_ID")):
            monkeypatch.delenv(name)


@pytest.fixture(scope="session")
def made_keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore with the enclaves /a and /b, restricted by a policy; only to be copied."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "policy.xml").write_text(POLICY)
    sros("create_keystore", folder / "ks").ok()
    sros("generate_artifacts", "-k", folder / "ks", "-p", folder / "policy.xml").ok()
    return folder / "ks"


@pytest.fixture
def keystore(made_keystore: Path, tmp_path: Path) -> Path:
    """A keystore of one's own with the enclaves /a and /b, restricted by a policy."""
    return Path(shutil.copytree(made_keystore, tmp_path / "ks", symlinks=True))


@pytest.fixture
def free_umask() -> Iterator[None]:
    """A process that hides nothing by itself."""
    before = os.umask(0)
    yield
    os.umask(before)
