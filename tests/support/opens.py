"""How often a program opens each file of a folder, as the system counts it (inotify(7)).

A file that is reached by several links is one file, under the name that it has in its folder.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

_OPEN, _CREATE, _MOVED_TO, _IS_FOLDER = 0x20, 0x100, 0x80, 0x40000000
_CLOSED = 0x18
"""Events between two openings, without which the system reports both as one."""
_EVENT = struct.Struct("iIII")
_LARGEST = 1 << 16
_LIBC = ctypes.CDLL(None, use_errno=True)


def can_count() -> bool:
    """Return whether the system has inotify, and lets this process use it."""
    try:
        handle = _LIBC.inotify_init1(os.O_CLOEXEC)
    except (AttributeError, OSError):
        return False
    if handle >= 0:
        os.close(handle)
    return bool(handle >= 0)


def count_opens(root: Path, work: Callable[[], object]) -> Counter[str]:
    """Return how often each file below ``root`` is opened while ``work`` runs, by relative path."""
    watch = _Watch(Path(os.path.realpath(root)))
    with ThreadPoolExecutor(1) as reader:
        counted = reader.submit(watch.read)
        try:
            work()
        finally:
            watch.stop()
        return counted.result()  # raises what ended the counting early


class _Watch:
    """The events of all folders below ``root``."""

    def __init__(self, root: Path) -> None:
        self._opened: Counter[str] = Counter()
        self._root = root
        self._handle = _LIBC.inotify_init1(os.O_CLOEXEC)
        self._folders: dict[int, str] = {}
        self._end = root / ".counted"
        for folder, _, _ in os.walk(root):
            self._add(folder)

    def _add(self, folder: str) -> None:
        events = _OPEN | _CLOSED | _CREATE | _MOVED_TO
        watch = _LIBC.inotify_add_watch(self._handle, os.fsencode(folder), events)
        if watch < 0 and ctypes.get_errno() in (errno.ENOENT, errno.ENOTDIR):
            return  # a folder of a change that was there for a moment
        assert watch >= 0, f"inotify_add_watch: {os.strerror(ctypes.get_errno())}"
        self._folders[watch] = folder

    def stop(self) -> None:
        """Have `read` end after the events until now."""
        self._end.touch()
        self._end.unlink()

    def read(self) -> Counter[str]:
        """Return how often each file was opened until `stop`."""
        while True:
            events = os.read(self._handle, _LARGEST)
            place = 0
            while place < len(events):
                watch, mask, _, length = _EVENT.unpack_from(events, place)
                begin = place + _EVENT.size
                name = os.fsdecode(events[begin : begin + length].rstrip(b"\0"))
                place = begin + length
                path = os.path.join(self._folders[watch], name)
                if path == os.fspath(self._end):
                    os.close(self._handle)
                    return self._opened
                if mask & _IS_FOLDER:
                    if mask & (_CREATE | _MOVED_TO):
                        self._add(path)
                elif mask & _OPEN:
                    self._opened[os.path.relpath(path, self._root)] += 1
