"""Atomic replacement of a file, and a TOML parser with limits."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import stat
import tomllib
from pathlib import Path
from typing import Any

_LOG = logging.getLogger(__name__)


def replace_file(path: Path, data: bytes) -> None:
    """Atomically replace the content of the file at ``path`` with ``data``, and flush it to disk.

    Other processes read either the old content or the new one.  An existing file keeps its mode
    and, if permitted, its owner.  If ``path`` is a symbolic link, its target is replaced.  A device
    or a pipe (``/dev/null``) is written to, not replaced.

    Raises:
        OSError: the file cannot be written; the old content stays.
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
    _LOG.info("%s '%s', %d bytes", "replaced" if present else "wrote", target, len(data))


_LONGEST_LINE = 4000  # characters: the parser takes quadratic time for a key with many dots
_LONGEST_DOCUMENT = 256 * 1024  # characters


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML document.

    Raises:
        tomllib.TOMLDecodeError: the document is not TOML, too long, or nested too deeply.
    """
    if len(text) > _LONGEST_DOCUMENT:
        raise tomllib.TOMLDecodeError(f"it is longer than {_LONGEST_DOCUMENT // 1024} KiB")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > _LONGEST_LINE:
            raise tomllib.TOMLDecodeError(
                f"line {number} is longer than {_LONGEST_LINE} characters"
            )
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError as error:
        raise tomllib.TOMLDecodeError("it is nested too deeply") from error
    except ValueError as error:  # a number of thousands of digits, or a date that does not exist
        raise tomllib.TOMLDecodeError(str(error)) from error
