"""Changing a keystore, stopped at every step and at random moments: the old one, or the new one."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.errors import UsageError
from sros_tool.faults import Fault
from sros_tool.keystore.describe import history
from sros_tool.keystore.layout import enclave_path, list_enclaves
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.update import update_keystore
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.settings import present_settings
from sros_tool.keystore.template import load_template
from tests.integration.kills import Moments, Server, server
from tests.integration.test_kill_life import DIED, copy, in_child
from tests.support.harness import check_enclave_whole, check_whole, remains
from tests.support.long_form import ONLY_LONG, few_steps

__all__ = ["server"]

NOW = datetime.now(UTC)
LATER = NOW + timedelta(hours=1)
KILLS = 4
PRODUCTION = load_template("production")

State = tuple[str, str, tuple[tuple[int, int], ...], int]


def see(root: Path, *, may_lack_list: bool = True) -> State:
    """Check what must hold at any moment, and tell which keystore it is.

    With ``may_lack_list``, the first revocation list may still be a link to nothing: ROS 2 then
    does without a list, as with the keystore of before, which had none.

    The name of its settings, what its governance protects, parts of the subject and days of the
    permissions of each enclave, and the number of its revocation list.
    """
    for path in root.glob("private/*.pem"):
        # One that is on its way out may be a broken link for a moment.
        assert not path.exists() or path.stat().st_mode & 0o777 == 0o600, path
    enclaves = []
    for name in list_enclaves(root):
        check_enclave_whole(enclave_path(root, name))
        state = open_enclave(enclave_path(root, name), now=LATER)
        faults = {problem.fault for problem in state.problems}
        assert faults <= ({Fault.CRL_LEFT_OUT} if may_lack_list else set()), name
        assert state.certificate
        assert state.grant
        days = (state.grant.validity.not_after - LATER).days + 1
        enclaves.append((len(state.certificate.subject.rdns), days))
    present, crl = present_settings(OpenedKeystore(root)), OpenedKeystore(root).revocation_list
    assert present.written
    rtps = present.governance.domain_access_rules[0].rtps_protection_kind
    return present.written.name, rtps, tuple(enclaves), crl.number if crl else 0


def settled(root: Path) -> State:
    """As `see`, when all is done: nothing is left behind, and the ledger knows everything."""
    assert not remains(root.parent)
    check_whole(root)
    assert not history(OpenedKeystore(root), now=LATER).unexplained
    assert not present_settings(OpenedKeystore(root)).edits
    now = see(root, may_lack_list=False)
    one = ("ca",) if now[0] == "sros2" else ("identity_ca", "permissions_ca")
    assert tuple(sorted(OpenedKeystore(root).authority_files)) == one
    return now


def update(root: Path) -> None:
    """As a person does: who runs it again is told when it was done already."""
    try:
        update_keystore(root, PRODUCTION, now=LATER, revoke_old=True)
    except UsageError as error:
        assert "nothing changes" in str(error)


@pytest.fixture
def life(tmp_path: Path) -> Path:
    root = tmp_path / "ks"
    create_keystore(root, template=load_template("sros2"), now=NOW)
    create_enclaves(root, ["/a", "/x/y"], now=NOW)
    own = root / "enclaves/a/governance.p7s"
    data = own.read_bytes()
    own.unlink()
    own.write_bytes(data)  # a copy in place of the link
    return root


def test_death_at_every_step(life: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From one CA to two files, with other governance, certificates, permissions and a list."""
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    before = settled(life)
    work = tmp_path / "work" / "ks"
    work.parent.mkdir()
    run: Callable[[], object] = lambda: update(work)  # noqa: E731
    copy(life, work)
    status, steps = in_child(run)
    assert status == 0
    expected = settled(work)
    assert before == ("sros2", "SIGN", ((1, 3650), (1, 3650)), 0)
    assert expected == ("production", "ENCRYPT", ((2, 180), (2, 180)), 1)
    outcomes = set()
    for step in few_steps(range(1, steps + 1)):
        copy(life, work)
        assert in_child(run, step) == (DIED, 0), step
        now = see(work)
        assert now in (before, expected), step
        outcomes.add(now == before)
        update(work)
        assert settled(work) == expected, step
    assert outcomes == {True, False}
    assert steps > 30


@ONLY_LONG
def test_killed_at_random_moments(server: Server, life: Path, tmp_path: Path) -> None:
    work = tmp_path / "work" / "ks"
    work.parent.mkdir()
    before = settled(life)
    words = ("update_keystore", work, "--template", "production", "--revoke-old")
    copy(life, work)
    moments = Moments(KILLS, 9, server.run(*words))
    expected = settled(work)
    for pause in moments:
        copy(life, work)
        killed = server.kill(pause, *words)
        now = see(work)
        assert now in (before, expected)
        moments.tell(killed=killed, done=now == expected)
        update(work)
        assert settled(work) == expected
