"""An import that is stopped at every step and at random moments: the robot has all of it, or none.

A robot is not attended, so what a killed import leaves must neither keep the old enclave from
running nor the next import from going through.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.checks.keystores.arrival import verify_arrival
from sros_tool.keystore.delivery.robot import import_answer
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.reader import open_enclave
from sros_tool.keystore.template import load_template
from tests.integration.kills import Moments, Server, server
from tests.integration.test_kill_life import DIED, copy, in_child
from tests.support.harness import create_request, remains, snapshot
from tests.support.long_form import ONLY_LONG, few_steps

__all__ = ["server"]

NOW = datetime.now(UTC)
LATER = NOW + timedelta(hours=1)
NAME, FOLDER = "/arm/camera", "enclaves/arm/camera"
KILLS = 5


@pytest.fixture(params=["the first", "a renewal"])
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, bytes]:
    """A robot, and the answer that it is to import."""
    home, folder = tmp_path / "home", tmp_path / "robot"
    create_keystore(home, template=load_template("production"), now=NOW)
    create_enclaves(home, ["/lost"], now=NOW)
    wanted = create_request(folder, NAME).file.read_bytes()
    answer = sign_request(home, wanted, now=NOW).archive
    if request.param == "a renewal":
        import_answer(folder, answer, now=NOW)
        revoke(home, ["/lost"], now=LATER)  # so that crl.pem is among what is new
        answer = sign_request(home, wanted, now=LATER, renew=True).archive
    return folder, answer


def see(robot: Path, before: Path) -> bool:
    """Whether the answer is in place as a whole, after nothing else was found than before."""
    now, then = robot / FOLDER, before / FOLDER
    key = now / "key.pem"
    assert key.read_bytes() == (then / "key.pem").read_bytes()
    assert key.stat().st_mode & 0o777 == 0o600
    files = {path.name: path.read_bytes() for path in now.iterdir() if path.exists()}
    old = {path.name: path.read_bytes() for path in then.iterdir()}
    if files == old:
        return False
    assert files.keys() >= old.keys()
    assert not open_enclave(now, now=LATER).problems
    return True


def settled(robot: Path) -> dict[str, tuple[int, bytes]]:
    """All that is there, when all is done."""
    assert not remains(robot.parent)
    assert not verify_arrival(robot, now=LATER).findings
    return snapshot(robot)


def test_death_at_every_step(
    robot: tuple[Path, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    folder, answer = robot
    work = tmp_path / "work" / "robot"
    work.parent.mkdir()

    def run() -> object:
        return import_answer(work, answer, now=LATER)

    copy(folder, work)
    status, steps = in_child(run)
    assert status == 0
    expected = settled(work)
    outcomes = set()
    for step in few_steps(range(1, steps + 1)):
        copy(folder, work)
        assert in_child(run, step) == (DIED, 0), step
        outcomes.add(see(work, folder))
        run()
        assert settled(work) == expected, step
    assert outcomes == {True, False}
    assert steps > 10


@ONLY_LONG
def test_killed_at_random_moments(
    server: Server, robot: tuple[Path, bytes], tmp_path: Path
) -> None:
    folder, answer = robot
    sent = tmp_path / "answer.tgz"
    sent.write_bytes(answer)
    work = tmp_path / "work" / "robot"
    work.parent.mkdir()
    copy(folder, work)
    moments = Moments(KILLS, 7, server.run("import", sent, work))
    expected = settled(work)
    for pause in moments:
        copy(folder, work)
        killed = server.kill(pause, "import", sent, work)
        moments.tell(killed=killed, done=see(work, folder))
        import_answer(work, answer, now=LATER)
        assert settled(work) == expected
