"""Fixtures for all tests."""

from __future__ import annotations

import gc
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from hypothesis import HealthCheck, settings, strategies

from sros_tool.pki import keys
from tests.support.children import LONG
from tests.support.harness import (
    copy_of,
    environment,
    policy_text,
    publish,
    restore_environment,
    sros,
)
from tests.support.long_form import SEED

POLICY = policy_text({"/a": publish("old_a"), "/b": publish("old_b")})

# How long an example takes says something of the machine, not of what is tested.
settings.register_profile(
    "sros",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    max_examples=1000 if LONG else 5,
)
settings.load_profile("sros")

MEMORY = Path("/dev/shm")
ROOM = 1 << 30
"""Bytes that have to be free in memory for the folders of the tests."""


def use_memory_for_folders() -> None:
    """Have pytest make the tests' folders in memory, where there is room and programs may run.

    Thousands of keystores are copied, changed and removed: on a disk, most of the time is waiting.
    """
    try:
        found = os.statvfs(MEMORY)
    except OSError:
        return
    may_run = os.access(MEMORY, os.W_OK | os.X_OK) and not found.f_flag & os.ST_NOEXEC
    if may_run and found.f_bavail * found.f_frsize > ROOM:
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))
        # For what the program itself makes for a moment, and flushes, in these processes.
        tempfile.tempdir = str(MEMORY)


use_memory_for_folders()

SLOWEST = (
    "test_revoke_in_rotation_on_dds",
    "test_life_on_dds",
    "test_rotate_on_dds",
    "test_update_on_dds",
    "test_generate_policy",
    "test_demo_attacks",
    "test_nodes_fit_their_enclaves",
)
"""Modules that take minutes, mostly waiting: begun first, so that none is waited for at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slowest modules."""
    rank = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_report_header() -> str:
    """Say by what a run can be repeated."""
    return f"what is drawn: SROS_SEED={SEED}"


# Importing and collecting the tests makes millions of objects, of which hardly any is garbage.
gc.disable()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Take what stays until the end from the garbage collector, which looked at it every time.

    What Hypothesis knows of characters is computed here, before the tests run in processes.
    """
    if any(item.get_closest_marker("hypothesis") for item in session.items):
        strategies.text().validate()
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)  # hardly anything that a test makes is garbage in a circle
    gc.enable()


for variable in list(os.environ):
    # Tests do not depend on the ROS environment of whoever runs them.
    if variable.startswith(("ROS_SECURITY_", "ROS_DOMAIN_ID")):
        del os.environ[variable]

for each in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    # Whoever starts the tests in the background may have had them ignored, and children inherit it.
    if signal.getsignal(each) is signal.SIG_IGN:
        signal.signal(each, signal.SIG_DFL)


_BEFORE = pytest.StashKey[tuple[dict[bytes, bytes], str]]()


def _surroundings() -> tuple[dict[bytes, bytes], str]:
    """Return the environment and the working folder."""
    try:
        folder = os.getcwd()
    except FileNotFoundError:
        folder = "a folder that was removed"
    return environment(), folder


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Remember the environment and the working folder before anything is made for a test."""
    item.stash[_BEFORE] = _surroundings()
    return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """Fail a test that leaves another environment or working folder to the tests after it."""
    result = yield
    variables, folder = item.stash[_BEFORE]
    now, there = _surroundings()
    if (now, there) == (variables, folder):
        return result
    changed = {name for name in variables.keys() | now if variables.get(name) != now.get(name)}
    restore_environment(variables)
    os.chdir(folder)
    left = [*sorted(map(os.fsdecode, changed)), *({there} - {folder})]
    pytest.fail(f"it leaves variables or a working folder of its own: {', '.join(left)}")


@pytest.fixture(scope="session", autouse=True)
def decrypt_each_key_once() -> Iterator[None]:
    """A passphrase is slow to try, and most tests use copies of the same encrypted keys."""
    decrypt = keys._decrypted_key
    known: dict[tuple[bytes, str], PrivateKeyTypes] = {}

    def decrypted(pem: bytes, name: str, passphrase: str) -> PrivateKeyTypes:
        if (pem, passphrase) not in known:
            known[pem, passphrase] = decrypt(pem, name, passphrase)
        return known[pem, passphrase]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keys, "_decrypted_key", decrypted)
        patch.setattr(keys, "_P", 1)  # of five, so that making an encrypted key is no slower either
        yield


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
    return copy_of(made_keystore, tmp_path / "ks")


@pytest.fixture
def free_umask() -> Iterator[None]:
    """A process that hides nothing by itself."""
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.fixture
def strict_umask() -> Iterator[None]:
    """A process whose files only its user can read, as under systemd's ``UMask=0077``."""
    before = os.umask(0o077)
    yield
    os.umask(before)
