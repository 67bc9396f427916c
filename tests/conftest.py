"""Fixtures for all tests."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.support.children import LONG
from tests.support.harness import policy_text, publish, sros

POLICY = policy_text({"/a": publish("old_a"), "/b": publish("old_b")})

# How long an example takes says something of the machine, not of what is tested.
settings.register_profile(
    "sros",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    max_examples=1000 if LONG else 50,
)
settings.load_profile("sros")

for each in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    # Whoever starts the tests in the background may have had them ignored, and children inherit it.
    if signal.getsignal(each) is signal.SIG_IGN:
        signal.signal(each, signal.SIG_DFL)


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
