"""Parts of what ``--json`` prints that many verbs have: files that change, notes, a dry run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from sros_tool.errors import Note
from sros_tool.values import Words

FILE_ACTIONS = Words(("create", "replace", "remove", "close", "adopt", "send"))


class FileChange(NamedTuple):
    """A file that was written or, with ``--dry-run``, would be."""

    action: Annotated[str, FILE_ACTIONS]
    """What is done with the file; ``close``: a private key or a folder of keys that other users
    could open is closed to them; ``adopt``: a keystore of ros2/sros2 gets its settings and ledger.
    """
    path: str
    """The file; for ``send``, its path in the archive on standard output."""


NamedKeystore = Annotated[Path, "The keystore, as it was named."]
DryRun = Annotated[bool, "Whether nothing was changed, because of `--dry-run`."]
FileChanges = Annotated[
    Sequence[FileChange], "The files that were written or, with `--dry-run`, would be."
]
Notes = Annotated[Sequence[Note], "Notes, which text output prints on standard error."]


class PlannedFiles(NamedTuple):
    """What would be written."""

    changes: FileChanges
    notes: Notes
    dry_run: Literal[True] = True
    """Nothing was written."""


def file_change(path: Path, *, existed: bool) -> tuple[FileChange]:
    """Return the change of a single file."""
    return (FileChange("replace" if existed else "create", str(path)),)
