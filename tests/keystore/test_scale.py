"""A keystore of very many enclaves: 10,000 in the long form of the tests, 45 otherwise.

In the long form, all cores share the work.  What must not grow with the keystore is counted in
folders that are read, not in seconds.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.inputs import fleet_file, fleet_policy
from sros_tool.keystore.describe import HistoryStatus, history
from sros_tool.keystore.layout import enclave_names
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.validity import parse_iso
from tests.support.children import LONG
from tests.support.harness import sros

ROBOTS = 100 if LONG else 3
EACH = 100 if LONG else 15
MANY = ROBOTS * EACH


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scale")
    policy, robots = folder / "policy.xml", folder / "fleet.toml"
    policy.write_text(fleet_policy(EACH, 5))
    robots.write_text(fleet_file(ROBOTS))
    made = folder / "ks"
    done = sros("generate_artifacts", "-k", made, "-p", policy, "--fleet", robots).ok()
    assert f"created {MANY} enclaves: " in done.out
    again = sros("generate_artifacts", "-k", made, "-p", policy, "--fleet", robots).ok()
    assert f"unchanged: {MANY} enclaves" in again.err
    assert again.out == ""
    return made


_listed: list[str] | None = None


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    if _listed is not None and event == "os.scandir":
        _listed.append(str(arguments[0]))


@contextmanager
def folders_read() -> Iterator[list[str]]:
    """Note the folders whose content is listed by this process."""
    global _listed
    if not hasattr(sys, "_scale_hook"):
        sys.addaudithook(_hook)
        sys._scale_hook = True  # type: ignore[attr-defined]
    _listed = []
    try:
        yield _listed
    finally:
        _listed = None


def test_all_of_them_are_there_and_sound(root: Path) -> None:
    names = enclave_names(root)
    assert len(names) == MANY
    assert sros("list_enclaves", root).ok().out.splitlines() == list(names)
    ledger = OpenedKeystore(root).ledger
    assert ledger.gaps == ()
    assert ledger.lines >= 2 * MANY
    bare = ("--exclude", "enclave.node-cannot-start")  # the policy leaves out the common part
    sros("check", "keystore", root, "--fail-on", "error", *bare).ok()
    who = sros("explain", root, "--who", "publish", "/r2/topic_0").ok()
    allowed = [line for line in who.out.splitlines() if line.startswith("/r2/")]
    assert len(allowed) == EACH, who


def test_one_enclave_costs_what_one_costs(root: Path, tmp_path: Path) -> None:
    """Neither a question nor an export lists the folders of other enclaves."""
    for words in (
        ("explain", root, "/r1/part_3", "publish", "/r1/topic_0"),
        ("distribute_key", root, "/r1/part_3", tmp_path / "robot"),
        ("distribute_key", root, "--robot", "r2", tmp_path / "r2"),
    ):
        with folders_read() as listed:
            sros(*words).ok()
        others = [each for each in listed if f"{root / 'enclaves/r3'}/" in f"{each}/"]
        assert others == [], words
    with folders_read() as listed:
        sros("list_enclaves", root).ok()
    of_robot = [each for each in listed if f"{root / 'enclaves/r3'}/" in f"{each}/"]
    assert len(of_robot) == EACH + 1


def test_revoking_a_robot_and_renewing_the_others(root: Path) -> None:
    """Run last: it changes the keystore."""
    before = {
        name: (root / f"enclaves{name}/cert.pem").read_bytes() for name in enclave_names(root)
    }
    sros("revoke", root, "--robot", "r1").ok()
    rest = enclave_names(root)
    assert [name for name in before if name not in rest] == [n for n in before if "/r1/" in n]
    assert all((root / f"enclaves{name}/crl.pem").is_symlink() for name in rest)
    found = OpenedKeystore(root).revocation_list
    assert found
    assert len(found.revoked) == EACH
    done = sros("renew", root, "--all-expiring", "100y").ok()
    assert f"renewed {len(rest)} enclaves: " in done.out
    assert all((root / f"enclaves{name}/cert.pem").read_bytes() != before[name] for name in rest)
    made = history(
        OpenedKeystore(root), now=parse_iso(OpenedKeystore(root).ledger.entries[-1].time)
    )
    assert (made.gaps, made.unexplained) == ((), ())
    current = [e for e in made.entries if e.status is HistoryStatus.CURRENT and e.entry.enclave]
    assert len(current) == 2 * len(rest)
