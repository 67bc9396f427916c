"""The Ansible collection, over real sshds: first delivery, and what comes after it.

One fleet goes through its life, in the order of these tests; each test says what it leaves.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator

import pytest

from tests.integration.robots import MISSING, Fleet, fleet, names
from tests.support.harness import snapshot, sros

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(bool(MISSING), reason=f"not here: {', '.join(MISSING)}"),
    pytest.mark.skipif(os.getuid() != 0, reason="an sshd changes users as root"),
]

ROBOTS = names(3)


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """Three robots, with two enclaves each; the second one has no OpenSSL, but sros."""
    folder = tmp_path_factory.mktemp("fleet")
    keystore = folder / "keystore"
    sros("create_keystore", keystore).ok()
    sros("create_enclave", keystore, *(f"/{name}/{each}" for name in ROBOTS for each in "ab")).ok()
    with fleet(folder, keystore) as made:
        for name in ROBOTS:
            made.add(name)
            made.variables[name] = {
                "sros_patterns": [f"/{name}/*"],
                "sros_units": [
                    {"name": "a.service", "enclaves": [f"/{name}/a"]},
                    {"name": "b.service", "enclaves": [f"/{name}/b"]},
                ],
            }
        made.variables["all"] = {"sros_serial": "100%", "sros_confirm": False}
        yield made


def home_files(made: Fleet, name: str) -> dict[str, bytes]:
    """Return the files that a robot should have, as an export gives them."""
    target = made.folder / "exports" / name
    shutil.rmtree(target, ignore_errors=True)
    sros("distribute_key", made.keystore, "--match", f"/{name}/*", target, "--keyless").ok()
    return {path: content for path, (_, content) in snapshot(target).items()}


def assert_current(made: Fleet, *which: str) -> None:
    """Assert that robots have the files of home and nothing else, closed to others."""
    for name in which:
        found = snapshot(made.robots[name].keystore)
        assert {path: content for path, (_, content) in found.items()} == home_files(made, name)
        for path, (mode, _) in found.items():
            wanted = 0o600 if path.endswith("key.pem") else 0o644
            assert mode & 0o777 == (wanted if path.endswith((".pem", ".p7s")) else 0o700), path
        beside = os.listdir(made.robots[name].keystore.parent)
        assert set(beside) <= {"keystore", ".keystore.sros-lock"}, beside


def test_first_delivery(three: Fleet) -> None:
    """Whoever is off line is named, and comes later; the second time nothing changes."""
    three.stop("r3")
    seen = three.play("deliver", "--check", "--diff", "-v")
    assert seen.changed == {"r1", "r2"}
    assert "PRIVATE" not in seen.text
    assert "+a private key" in seen.text
    assert not three.robots["r1"].keystore.exists()

    done = three.play("deliver", "-v", status=2)
    assert done.changed == {"r1", "r2"}
    assert "Not reached, or lost on the way: r3." in done.text
    assert "PRIVATE" not in done.text
    assert_current(three, "r1", "r2")

    three.start("r3")
    assert three.play("deliver").changed == {"r3"}
    assert_current(three, *ROBOTS)
    assert not three.play("deliver").changed
    # No process can have run before.
    assert [robot.restarts() for robot in three.robots.values()] == [[], [], []]
