"""Reading one state of a keystore while another process may change it.

A change takes effect for each file at the same moment, but who reads several files reads them one
after another: the permissions of before, say, and the revocation list of after.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from sros_tool.errors import SrosError
from sros_tool.keystore.layout import LEDGER, SETTINGS
from sros_tool.keystore.reader import Keystore

_MOST_READS = 5

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")
Opened = TypeVar("Opened", Path, Keystore)


def of_one_state(
    read: Callable[Concatenate[Opened, Arguments], Result],
) -> Callable[Concatenate[Opened, Arguments], Result]:
    """Return ``read``, a function of a keystore, so that it reads again what was changed meanwhile.

    A keystore that is changed all the time is read five times; what the last one returns or raises
    counts.
    """

    @wraps(read)
    def read_again(opened: Opened, *arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        root = opened.root if isinstance(opened, Keystore) else opened
        for _ in range(_MOST_READS - 1):
            before = _state(root)
            try:
                result = read(opened, *arguments, **named)
            except SrosError:
                if _state(root) == before:
                    raise
            else:
                if _state(root) == before:
                    return result
            if isinstance(opened, Keystore):
                opened.forget()
        return read(opened, *arguments, **named)

    return read_again  # type: ignore[return-value]  # mypy knows the name of the first argument


def _state(root: Path) -> object:
    """Return what each change of a keystore changes: the ledger gets another file."""
    found: list[tuple[int, int, int] | None] = []
    for name in (LEDGER, SETTINGS):
        try:
            state = os.stat(root / name)  # noqa: PTH116 - the link of a change under way, too
        except OSError:
            found.append(None)
        else:
            found.append((state.st_ino, state.st_size, state.st_mtime_ns))
    return found
