"""Which robots a stage of a CA rotation would cut off, by what they confirmed that they have."""

from __future__ import annotations

from pathlib import Path

from sros_tool.keystore.fleet import checked_fleet
from sros_tool.keystore.fleet_status import fleet_status
from sros_tool.keystore.layout import IDENTITY
from sros_tool.keystore.lifecycle.rotation.state import Rotation, RotationStage
from sros_tool.keystore.reader import authority_files

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
