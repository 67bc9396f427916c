"""Findings about several keystores and exports whose enclaves do not trust each other."""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path

from sros_tool.checks.targets import Circumstances, path_findings
from tests.support.harness import copy_of, sros

FOUND = {"keystore.strangers"}
AT = Circumstances(datetime.now(UTC))


def strangers(*paths: Path, at: Circumstances = AT) -> list[str]:
    return [each.text for each in path_findings(paths, at) if each.id in FOUND]


def test_keystores_and_their_exports_are_strangers(keystore: Path, tmp_path: Path) -> None:
    other, export = tmp_path / "other", tmp_path / "export"
    sros("create_keystore", other).ok()
    sros("create_enclave", other, "/a").ok()
    sros("distribute_key", keystore, "/a", export).ok()
    (text,) = strangers(keystore, other, export)
    assert text == (
        f"nodes of {keystore}, {export} do not communicate with nodes of {other}: not both of "
        "them trust the other's identity CA and permissions CA"
    )
    assert strangers(keystore, export) == strangers(keystore, keystore / "enclaves/a") == []
    assert strangers(other) == strangers(keystore / "enclaves/a/cert.pem", other) == []
    (text,) = strangers(
        export / "enclaves/a", other / "enclaves/a", at=Circumstances(AT.now, vendors=("zenoh",))
    )
    assert text.endswith("the other's identity CA")
    assert "keystore.strangers" in sros("check", "keystore", export, other).out
    export.rename(tmp_path / "keystore")  # the word names the folder, and no family of checks
    assert "keystore.strangers" in sros("check", "keystore", "other", cwd=tmp_path).out


def test_enclaves_in_a_rotation_are_strangers_after_two_stages(
    keystore: Path, tmp_path: Path
) -> None:
    stages = [keystore]
    for number in range(1, 4):
        stages.append(copy_of(stages[-1], tmp_path / f"stage{number}"))
        sros("rotate_ca", stages[-1], "--permissions", "--next").ok()
    for one, other in combinations(range(4), 2):
        assert bool(strangers(stages[one], stages[other])) is (other - one > 1), (one, other)
