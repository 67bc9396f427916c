"""The export with the enclaves of this machine."""

from __future__ import annotations

import stat
from collections.abc import Sequence
from datetime import datetime

from sros_tool.close.robot import OBSERVER, LocalRobot
from sros_tool.folders import Folder
from sros_tool.keystore.layout import KEY_FILES, enclave_folder, enclave_path, list_enclaves
from sros_tool.keystore.reader import FilesReadOnce, OpenedKeystore, open_enclave
from sros_tool.keystore.selection import revocation_of
from sros_tool.values import FileChange


def enclaves_to_export(robot: LocalRobot) -> Sequence[str]:
    """Return the words that select the enclaves of this machine."""
    if not robot.not_here:
        return ("--all",)
    names = {OBSERVER} | robot.keystore_enclaves() | robot.policy_enclaves()
    return sorted(names - robot.not_here)


def enclaves_without_origin(robot: LocalRobot) -> list[str]:
    """Return the enclaves of the export that the keystore does not have any more."""
    return sorted({*list_enclaves(robot.export)} - {*list_enclaves(robot.keystore)})


def remove_enclaves(robot: LocalRobot) -> list[FileChange]:
    """Remove from the export enclaves that the keystore revoked, or of other machines."""
    keystore = OpenedKeystore(robot.keystore)
    revoked_enclaves = [
        name for name in enclaves_without_origin(robot) if revocation_of(keystore, name)
    ]
    removed = dict.fromkeys(revoked_enclaves, "its enclave was revoked")
    for name in robot.not_here.intersection(list_enclaves(robot.export)):
        if any((enclave_path(robot.keystore, name) / file).exists() for file in KEY_FILES):
            removed[name] = "its enclave belongs to another machine"
    with Folder(robot.export) as export:
        for inside in map(enclave_folder, removed):
            for entry in (f"{inside}/{name}" for name in export.names(inside)):
                if not stat.S_ISDIR(export.mode(entry)):
                    export.unlink(entry)
        for inside in sorted(map(enclave_folder, removed), reverse=True):  # inner ones first
            if not export.names(inside):
                export.rmdir(inside)
    paths = {str(enclave_path(robot.export, name)): why for name, why in removed.items()}
    for path, why in paths.items():
        robot.shell.say(f"removed {path}: {why}")
    return [FileChange("remove", path) for path in paths]


def valid_until(robot: LocalRobot) -> datetime | None:
    """Return when the first enclave of the export expires; None if one cannot be read."""
    if not robot.export.exists():
        return None
    now, files = robot.shell.now(), FilesReadOnce()
    moments = [
        open_enclave(enclave_path(robot.export, name), now=now, files=files).valid_until()
        for name in list_enclaves(robot.export)
    ]
    return min(filter(None, moments), default=None) if all(moments) else None
