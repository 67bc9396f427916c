"""Whatever is broken in a keystore or a policy, it is told as a finding, and never as a crash."""

from __future__ import annotations

import random
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.policies.policy import policy_file_findings
from sros_tool.errors import KeystoreError
from sros_tool.files import policies_dir
from sros_tool.keystore.reader import OpenedKeystore
from tests.checks.bench import DAY, Bench
from tests.support.children import LONG
from tests.support.harness import copy_of
from tests.support.long_form import some

pytest_plugins = ["tests.checks.sound_keystore"]

ROUNDS = 120 if LONG else 15


def damage(path: Path, chance: random.Random) -> None:
    """Do something to a file that a disk, an editor or a careless copy could do."""
    data = path.read_bytes()
    match chance.randrange(7):
        case 0:
            path.unlink()
        case 1:
            path.write_bytes(b"")
        case 2:
            path.write_bytes(data[: chance.randrange(len(data) + 1)])
        case 3:
            index = chance.randrange(len(data) or 1)
            path.write_bytes(data[:index] + bytes([chance.randrange(256)]) + data[index + 1 :])
        case 4:
            path.write_bytes(chance.randbytes(50))
        case 5:
            path.unlink()
            path.mkdir()
        case 6:
            path.unlink()
            path.symlink_to(chance.choice(["/nowhere", path.name, "..", "/etc/hostname"]))


@pytest.mark.parametrize("seed", some(range(4), 2))
def test_damaged_keystores(seed: int, bench: Bench, tmp_path: Path) -> None:
    chance = random.Random(seed)
    if seed % 2:
        bench.revoke(1)
    told = 0
    for number in range(ROUNDS):
        copy = tmp_path / f"ks{number}"
        copy_of(bench.root, copy)
        files = sorted(p for p in copy.rglob("*") if p.is_file() and not p.is_symlink())
        for path in chance.sample(files, chance.choice([1, 1, 2, 4])):
            damage(path, chance)
        try:
            found = keystore_findings(OpenedKeystore(copy), Circumstances(bench.now))
        except KeystoreError as error:
            assert "is not a valid keystore" in str(error)
            continue
        told += bool(found)  # not every byte of every file matters
        shutil.rmtree(copy)
    assert told > ROUNDS / 2


@pytest.mark.parametrize("seed", range(3))
def test_damaged_policies(seed: int, tmp_path: Path) -> None:
    chance = random.Random(seed)
    data = (policies_dir() / "talker_listener.xml").read_bytes()
    shutil.copytree(policies_dir() / "common", tmp_path / "common")
    file = tmp_path / "policy.xml"
    broken = 0
    for _ in range(ROUNDS):
        text = bytearray(data)
        for _ in range(chance.choice([1, 2, 8])):
            begin = chance.randrange(len(text))
            text[begin : begin + chance.choice([0, 1, 20])] = chance.choice(
                [b"", b"<", b"*", b"\xff", b"ALLOW", b"DENY", b"/", b'"', b"<topic>", b"&x;"]
            )
        file.write_bytes(text)
        broken += bool(list(policy_file_findings(file)))
    assert broken > ROUNDS / 2


PERMISSIONS = (
    (("<not_before>", "<not_before>9999-12-31T23:59:59Z</not_before><!--"),
     ("</not_before>\n", "</not_before>-->\n")),
    (("<not_after>", "<not_after>0001-01-01T00:00:00Z</not_after><!--"),
     ("</not_after>\n", "</not_after>-->\n")),
    (("<id>0</id>", "<id>999999</id>"),),
    (("<id>0</id>", "<id_range><min>9</min><max>3</max></id_range>"),),
    (("<topic>rt/rosout</topic>", "<topic>[</topic><topic>[]</topic><topic>[!]</topic>"),),
    (("<topic>rt/rosout</topic>", "<topic></topic><topic>*?*[a-</topic>"),),
    (("CN=/base", "nonsense"),),
    (("CN=/base", ""),),
)  # fmt: skip


def test_a_ca_that_is_valid_until_dates_end(bench: Bench) -> None:
    certificate, _ = bench.new_authority(until=datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC))
    bench.trust("identity", certificate)
    assert keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))


@pytest.mark.parametrize("changes", PERMISSIONS)
def test_odd_permissions(changes: tuple[tuple[str, str], ...], bench: Bench) -> None:
    bench.permissions(*changes)
    assert keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
    assert keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now + 9999 * DAY))


@pytest.mark.parametrize(
    "changes",
    [
        (("<id>0</id>", "<id_range><min>9</min><max>3</max></id_range>"),),
        (("<topic_expression>*<", "<topic_expression>[<"),),
        (("<topic_expression>*<", "<topic_expression><"),),
    ],
)
def test_odd_governance(changes: tuple[tuple[str, str], ...], bench: Bench) -> None:
    bench.governance(*changes)
    assert keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
