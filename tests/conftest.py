"""Fixtures for all tests."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadScopeScheduling  # type: ignore[import-untyped]

from tests.support.children import LONG
from tests.support.harness import policy_text, publish, sros

STARTED_ONCE = (
    "test_generate_policy.py",
    "test_demo_run.py",
    "test_policies_live.py",
    "test_nodes_fit_their_enclaves.py",
)
"""Files whose tests share many processes that are started once."""

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


class _Scheduling(LoadScopeScheduling):  # type: ignore[misc]
    """Gives each worker one test after the other, but what shares a fixture to one worker."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return file if file.endswith(STARTED_ONCE) else nodeid


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Schedule so with ``--dist loadscope``."""
    return _Scheduling(config, log) if config.getvalue("dist") == "loadscope" else None


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
