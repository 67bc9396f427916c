"""Replaces a file as a whole: readers find the old content or the new, never a part."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from pathlib import Path


def replace_file(path: Path, data: bytes) -> None:
    """Let the file at ``path`` hold ``data``, on the disk when this returns.

    A file that exists keeps its mode and, where that is allowed, its owner; a symbolic link stays
    and its target changes.  A device or a pipe (``/dev/null``) is written to, and never replaced.
    Raises `OSError` if the folder cannot be written; then nothing changed.
    """
    target = Path(os.path.realpath(path))
    spare = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        present = target.stat()
    except FileNotFoundError:
        present = None
    if present and not stat.S_ISREG(present.st_mode) and not stat.S_ISDIR(present.st_mode):
        target.write_bytes(data)
        return
    handle = os.open(spare, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            if present:
                with contextlib.suppress(PermissionError):
                    os.fchown(handle, present.st_uid, present.st_gid)
                os.fchmod(handle, present.st_mode & 0o7777)
            file.write(data)
            file.flush()
            os.fsync(handle)
        spare.replace(target)
    except BaseException:
        spare.unlink(missing_ok=True)
        raise
    folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
