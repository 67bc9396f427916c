"""A network for each row: a namespace that lives as long as what was started in it.

Only for a process that is already in a network of its own and has one thread (`isolated`): to
enter a namespace and to come back changes the calling thread alone (setns(2)).
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

from sros_tool.runtime.netns import enter_isolation

_CLONE_NEWNET = 0x40000000
_HERE = "/proc/thread-self/ns/net"


class RowNetwork:
    """Where the processes and the capture of a row live; the host's network where not ``own``."""

    def __init__(self, *, own: bool) -> None:
        self.own = own
        self._there = self._back = -1
        if not own:
            return
        self._back = os.open(_HERE, os.O_RDONLY | os.O_CLOEXEC)
        try:
            enter_isolation()
            self._there = os.open(_HERE, os.O_RDONLY | os.O_CLOEXEC)
        finally:
            _enter(self._back)

    @contextmanager
    def entered(self) -> Iterator[None]:
        """What is started or opened in this context belongs to the network of the row."""
        if not self.own:
            yield
            return
        _enter(self._there)
        try:
            yield
        finally:
            _enter(self._back)

    def close(self) -> None:
        """Let go of it; the kernel removes it with the last process and socket in it."""
        for descriptor in (self._there, self._back):
            if descriptor >= 0:
                os.close(descriptor)
        self._there = self._back = -1


def _enter(descriptor: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if library.setns(descriptor, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"setns: {os.strerror(number)}")
