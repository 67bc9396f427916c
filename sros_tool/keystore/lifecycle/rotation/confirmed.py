"""Which robots a stage of a CA rotation would cut off, by what they confirmed that they have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from sros_tool.errors import Note
from sros_tool.fleet.enclaves import robot_of
from sros_tool.keystore.fleet import checked_fleet, load_fleet
from sros_tool.keystore.fleet_status import fleet_status
from sros_tool.keystore.layout import IDENTITY
from sros_tool.keystore.lifecycle.rotation.state import Rotation, RotationStage
from sros_tool.keystore.reader import authority_files

_SHOWN = 5
_ISSUED = {IDENTITY: ("certificate",), "permissions": ("permissions", "governance")}
"""What the CA of each role issues, by the kinds of `fleet_status`."""


def robots_cut_off(root: Path, rotation: Rotation, to: RotationStage) -> tuple[str, ...]:
    """Return the names of the robots that the stage ``to`` would cut off from the others; sorted.

    Those are the robots that have enclaves and have not confirmed the stage before: that they trust
    the new CA, and then that they also have what it issued.  None is cut off without a fleet, or by
    the first stage.

    Raises:
        KeystoreError: the file of the fleet is not the one that sros wrote last.
    """
    if to is RotationStage.DISTRIBUTE or checked_fleet(root) is None:
        return ()
    stages = list(RotationStage)
    robots = [each for each in fleet_status(root).robots if each.enclaves]
    if stages.index(to) - stages.index(rotation.stage) > 1:
        return tuple(each.robot for each in robots)  # stages that no robot was ever at
    roles = {role for each in rotation.replacements for role in authority_files(root)[each.file]}
    needed = {f"{role}_ca" for role in roles}
    if rotation.stage is RotationStage.REISSUE:
        needed.update(kind for role in roles for kind in _ISSUED[role])
    return tuple(
        each.robot
        for each in robots
        if each.received is None
        or any(file.kind in needed and not file.surplus for file in each.pending)
    )


def of_no_robot(root: Path, names: Iterable[str]) -> Iterator[Note]:
    """Yield a note on enclaves that belong to no robot of a fleet, so that nobody confirms them."""
    fleet = load_fleet(root)
    found = [each for each in names if robot_of(fleet, each) is None] if fleet else []
    if found:
        more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        verb = "belongs" if len(found) == 1 else "belong"
        yield Note(
            "keystore.of-no-robot",
            f"{', '.join(found[:_SHOWN])}{more} {verb} to no robot, so nothing says whether this "
            "stage is there: see to it before the next one.",
        )
