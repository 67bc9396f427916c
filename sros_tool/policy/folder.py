"""The policies in a folder and below it: no file that may be a policy is left out in silence."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

from sros_tool.errors import DocumentError
from sros_tool.xml import parse, read_bytes

_MOST_FILES = 10_000
_LOOKED_AT = 256 * 1024
"""Bytes of a file with another name of which it is looked whether it is a policy."""


def policy_files(folder: Path) -> Iterator[Path]:
    """Yield the policies in a folder and below it, sorted, without fragments for includes.

    Raises:
        DocumentError: a file is perhaps a policy, but cannot be read, is no XML, or has another
            ending than ``.xml``; a link leads to a folder, or there are too many files.
    """
    for count, path in enumerate(_files_below(folder)):
        if count >= _MOST_FILES:
            raise DocumentError(
                f"'{folder}' has more than {_MOST_FILES} files", "", "Name a policy in it."
            )
        if is_policy(path.name, _content(path), f"'{path}'"):
            yield path


def is_policy(name: str, content: bytes, shown: str) -> bool:
    """Return whether the file ``name`` of a folder is a policy; errors name it as ``shown``.

    Raises:
        DocumentError: that is not certain, or only its name says that it is none.
    """
    if name.lower().endswith(".xml"):
        return parse(content, shown, instructions=True).tag == "policy"
    begin = content[:_LOOKED_AT].replace(b"\0", b"")  # of UTF-16, too
    if begin.lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n").startswith(b"<") and b"<policy" in begin:
        raise DocumentError(
            f"{shown} looks like a policy, but its name does not end with .xml",
            "A policy in a folder that is not read would not count.",
            "Name it .xml, or move it out of the folder.",
        )
    return False


def _files_below(folder: Path) -> Iterator[Path]:
    """Yield the regular files in a folder and below it, sorted; links to folders are refused."""

    def fail(error: OSError) -> None:
        raise DocumentError(f"'{error.filename}' cannot be read", str(error.strerror)) from error

    for parent, folders, files in os.walk(folder, onerror=fail):
        folders[:] = sorted(name for name in folders if name != ".git")  # no file of a repository
        for each in (Path(parent, name) for name in folders):
            if each.is_symlink():
                raise DocumentError(
                    f"'{each}' is a link to a folder, and not followed",
                    "The policies in it would not count.",
                    "Name that folder itself, or remove the link.",
                )
        for path in (Path(parent, name) for name in sorted(files)):
            try:
                mode = path.stat().st_mode
            except OSError as error:
                raise DocumentError(f"'{path}' cannot be read", str(error.strerror)) from error
            if stat.S_ISREG(mode):
                yield path


def _content(path: Path) -> bytes:
    if path.suffix.lower() == ".xml":
        return read_bytes(path, "policy file")
    try:
        with path.open("rb") as file:
            return file.read(_LOOKED_AT)
    except OSError as error:
        raise DocumentError(f"'{path}' cannot be read", str(error.strerror)) from error
