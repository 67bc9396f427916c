"""The fleet that a keystore records decides who gets which keys, so nobody else can change it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from sros_tool.fleet import enclaves
from sros_tool.fleet.model import Fleet, Robot
from sros_tool.keystore.fleet import left_enclaves
from tests.support.harness import Ended, policy_text, publish, snapshot, sros

FLEET = "[robots]\na = {}\na_arm = {}\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    sros("create_keystore", folder / "ks").ok()
    generate(folder, "/{robot}").ok()
    return folder


def generate(folder: Path, path: str) -> Ended:
    (folder / "fleet.toml").write_text(FLEET)
    (folder / "policy.xml").write_text(policy_text({path: publish("x")}))
    words = ("-p", folder / "policy.xml", "--fleet", folder / "fleet.toml")
    return sros("generate_artifacts", "-k", folder / "ks", *words)


def test_a_forged_record_does_not_hide_an_edit(made: Path, tmp_path: Path) -> None:
    """A line that fits into the chain, but that no head signs, says nothing of the fleet."""
    root = tmp_path / "ks"
    shutil.copytree(made / "ks", root, symlinks=True)
    sros("distribute_key", root, "--robot", "a", tmp_path / "before").ok()
    file, ledger = root / "fleet.toml", root / "ledger.jsonl"
    file.write_text(file.read_text().replace('"/{robot}"', '"/{robot}", "/{robot}_arm"'))
    lines = ledger.read_bytes().splitlines()
    forged = json.loads(next(each for each in lines if b'"what":"fleet"' in each))
    forged["sha256"] = sha256(file.read_bytes()).hexdigest()
    forged["previous"] = sha256(lines[-1]).hexdigest()
    line = json.dumps(forged, separators=(",", ":")).encode()
    ledger.write_bytes(b"\n".join([*lines, line]) + b"\n")
    ended = sros("distribute_key", root, "--robot", "a", tmp_path / "out")
    assert (ended.status, "is not certainly the one" in ended.err) == (2, True), ended
    assert not (tmp_path / "out").exists()
    file.unlink()
    ended = sros("distribute_key", root, "--robot", "a", tmp_path / "out")
    assert (ended.status, "is missing" in ended.err) == (2, True), ended


def test_no_enclave_belongs_to_two_robots(made: Path) -> None:
    """Paths of two policies can give one enclave to two robots; one would get the other's key."""
    before = snapshot(made / "ks")
    ended = generate(made, "/{robot}_arm")
    assert (ended.status, "/a_arm would belong to two robots" in ended.err) == (2, True), ended
    assert snapshot(made / "ks") == before


def test_paths_of_earlier_policies_count(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is written can be read again."""
    monkeypatch.setattr(enclaves, "MAX_PATTERNS", 1)
    before = snapshot(made / "ks")
    ended = generate(made, "/{robot}/other")
    assert (ended.status, "2 paths with a placeholder" in ended.err) == (2, True), ended
    assert snapshot(made / "ks") == before


def test_enclaves_that_are_left_are_found_in_one_pass(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not every name is compared with every path."""
    looked = 0
    candidates = enclaves._candidates

    def counted(*arguments: Any) -> Iterator[Robot]:
        nonlocal looked
        looked += 1
        return candidates(*arguments)

    monkeypatch.setattr(enclaves, "_candidates", counted)
    paths = [f"/e{number}/{{robot}}" for number in range(30)]
    before = Fleet.of([Robot("a", "/a"), Robot("b", "/b")], enclaves=["/{robot}", *paths])
    assert not list(left_enclaves(made / "ks", before, before))
    (note,) = left_enclaves(made / "ks", before, Fleet.of([Robot("b", "/b")], enclaves=paths))
    assert "the robot a is no longer in the fleet: /a stay" in note.text
    assert looked <= 2 * len(before.enclaves)
