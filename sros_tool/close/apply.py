"""Restart the systemd units of a robot with security."""

from __future__ import annotations

from sros_tool.close.drop_ins import DROP_IN, SYSTEMD, drop_ins_of, restart_units
from sros_tool.close.proof import proofs_of
from sros_tool.close.robot import LocalRobot
from sros_tool.close.state import CloseState, current_state
from sros_tool.runtime.units import unit_changes, write_units
from sros_tool.values import FileChange
from sros_tool.xml import read_bytes

_RESTART_SECONDS = 30.0
"""How long processes that sros restarted may take until they run in their enclaves."""


def apply(robot: LocalRobot, prepared: CloseState, *, dry_run: bool) -> CloseState:
    """Restart the systemd units that do not run in their enclaves, with drop-ins.

    Proves that the robot is closed, if nothing is left to do by hand.
    """
    robot.shell.check_open()
    observed = prepared.observed
    paths = [f"{unit}.d/{DROP_IN}" for unit in sorted(observed.units)]
    files = {path: read_bytes(robot.start / "units" / path, "unit").decode() for path in paths}
    drop_ins_of(robot, observed)
    changes = unit_changes(SYSTEMD, files, force=True)
    for path, action in changes.items():
        robot.shell.say(f"{'would ' if dry_run else ''}{action} {SYSTEMD / path}")
    if not dry_run:
        write_units(SYSTEMD, files, changes)
    secured = prepared.secured
    unsecured = [process for process in observed.processes if not secured.get(process.enclave)]
    open_units = observed._replace(processes=unsecured).units
    restart_units(robot, observed, open_units, changed=bool(changes), dry_run=dry_run)
    done = [FileChange(action, str(SYSTEMD / path)) for path, action in changes.items()]
    by_hand = dry_run or prepared.pending_by_hand
    proofs = () if by_hand else proofs_of(robot, prepared, _RESTART_SECONDS)
    total = [*prepared.changes, *done]
    if not proofs:
        return prepared._replace(changes=total)
    now = current_state(robot, robot.read_policy())
    return prepared._replace(proofs=proofs, changes=total, secured=now.secured, new=now.new)
