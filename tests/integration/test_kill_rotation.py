"""Rotating CAs, and revoking in between, stopped at random moments: the same end state."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.keystore.describe import history
from sros_tool.keystore.layout import enclave_path, list_enclaves
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation, rotation_status
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.template import load_template
from tests.integration.kills import Moments, Server, server
from tests.integration.test_kill_life import DIED, copy, in_child
from tests.support.harness import check_enclave_whole, remains
from tests.support.long_form import few_steps, some

__all__ = ["server"]

NOW = datetime.now(UTC)
LATER = NOW + timedelta(hours=1)
KILLS = 4
STAGES = (RotationStage.DISTRIBUTE, RotationStage.REISSUE, RotationStage.RETIRE)

State = tuple[tuple[str, ...], str, tuple[tuple[str, int], ...], tuple[int, ...]]


@pytest.fixture
def life(tmp_path: Path) -> Path:
    root = tmp_path / "ks"
    create_keystore(root, template=load_template("production"), now=NOW)
    create_enclaves(root, ["/a", "/b", "/c", "/x/y"], now=NOW)
    revoke(root, ["/c"], now=NOW)
    return root


def see(root: Path) -> State:
    """Check what must hold at any moment; enclaves, stage, who is on which CA, and the lists."""
    names = []
    for name in list_enclaves(root):
        folder = enclave_path(root, name)
        if (folder / "cert.pem").exists():
            check_enclave_whole(folder)
            assert not open_enclave(folder, now=LATER).problems, name
            names.append(name)
    for path in (*root.glob("private/*.pem"), *root.glob("retired/*.key.pem")):
        # One that is on its way out may be a broken link for a moment.
        assert not path.exists() or path.stat().st_mode & 0o777 == 0o600, path
    lists = tuple(len(each.revoked) for each in OpenedKeystore(root).revocation_lists)
    on = tuple(
        (each.state, each.enclaves)
        for each in rotation_status(OpenedKeystore(root), now=LATER).authorities
    )
    return tuple(names), str(read_rotation(OpenedKeystore(root)).stage), on, lists


def settled(root: Path) -> State:
    """As `see`, when all is done: nothing is left behind, and the ledger knows everything."""
    assert not remains(root.parent)
    assert not history(OpenedKeystore(root), now=LATER).unexplained
    return see(root)


def revoke_once(root: Path) -> None:
    """As a person does: who runs it again is told when it was done already."""
    try:
        revoke(root, ["/b"], now=LATER)
    except KeystoreError as error:
        assert "was revoked at" in str(error)


@pytest.mark.parametrize("stage", some(STAGES[:2], 1))
def test_death_at_every_step_of_revoking_between_stages(
    stage: RotationStage, life: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two lists change, and the file of the CAs: all at one moment."""
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    for each in STAGES[: STAGES.index(stage) + 1]:
        rotate_ca(life, each, now=NOW)
    before = settled(life)
    work = tmp_path / "work" / "ks"
    work.parent.mkdir()
    copy(life, work)
    status, steps = in_child(lambda: revoke_once(work))
    assert status == 0
    expected = settled(work)
    outcomes = set()
    for step in few_steps(range(1, steps + 1)):
        copy(life, work)
        assert in_child(lambda: revoke_once(work), step) == (DIED, 0), step
        now = see(work)
        assert now in (before, expected), step
        outcomes.add(now == before)
        revoke_once(work)
        assert settled(work) == expected
    assert outcomes == {True, False}


def test_every_stage_killed_at_random_moments(server: Server, life: Path, tmp_path: Path) -> None:
    work = tmp_path / "work" / "ks"
    work.parent.mkdir()
    for number, stage in enumerate(STAGES):
        if stage not in some(STAGES, 1):
            rotate_ca(life, stage, now=NOW)
            continue
        before = settled(life)
        copy(life, work)
        moments = Moments(KILLS, number, server.run("rotate_ca", work, "--to", stage))
        expected = settled(work)
        for pause in moments:
            copy(life, work)
            killed = server.kill(pause, "rotate_ca", work, "--to", stage)
            now = see(work)
            assert now in (before, expected), stage
            moments.tell(killed=killed, done=now == expected)
            server.run("rotate_ca", work, "--to", stage)
            assert settled(work) == expected, stage
        rotate_ca(life, stage, now=NOW)
