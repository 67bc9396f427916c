"""Lets every file that a transaction changes be reached through one link, before that is turned.

Each path first becomes a link to ``.sros-transaction/live/<number>``, which is still its old
content: a link that was prepared in ``before`` and the file change their places at one moment.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from sros_tool.keystore import filesystem
from sros_tool.keystore.parallel import in_shares
from sros_tool.keystore.stage import (
    BEFORE,
    LIVE,
    Move,
    bridge_text,
    number,
    seen_from_stage,
    turn,
)


def bridge(root: Path, stage: Path, moves: Sequence[Move]) -> None:
    """Let all that moves be reached through ``live``, which leads to ``before``."""
    if not moves:
        return
    os.mkdir(stage / BEFORE, 0o700)
    turn(stage, BEFORE)
    work = _Bridge(f"{root}", f"{stage}")
    if _can_exchange(stage):
        in_shares(moves, work.by_exchange)
        return
    # Both names at once, or a copy: for file systems that cannot exchange two names.
    copied = in_shares(moves, work.keep)
    if any(outcome for _, outcome in copied):
        filesystem.flush_file_system(stage / BEFORE)
    in_shares(moves, work.by_replacement)


def _can_exchange(stage: Path) -> bool:
    spare = f"{stage}/spare"
    os.symlink(BEFORE, spare)  # as `live`, so that it makes no difference which of them is
    can = filesystem.exchange(spare, f"{stage}/{LIVE}")
    os.unlink(spare)
    return can


class _Bridge:
    def __init__(self, root: str, stage: str) -> None:
        self._root = root
        self._stage = stage

    def by_exchange(self, moves: Sequence[Move]) -> None:
        root, before = self._root, f"{self._stage}/{BEFORE}"
        for move in moves:
            if move.before != "":
                self._keep_link(move)
                self._place(move)
                continue
            kept = f"{before}/{number(move.path)}"
            os.symlink(bridge_text(move.path), kept)
            if not filesystem.exchange(kept, f"{root}/{move.path}"):
                raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP), f"{root}/{move.path}")

    def keep(self, moves: Sequence[Move]) -> bool:
        """Give the old content a second name in the stage; whether it had to be copied."""
        copied = False
        for move in moves:
            if move.before != "":
                self._keep_link(move)
                continue
            real, kept = f"{self._root}/{move.path}", f"{self._stage}/{BEFORE}/{number(move.path)}"
            try:
                os.link(real, kept, follow_symlinks=False)
            except OSError:  # a file system, or an owner, that allows no hard links
                shutil.copy2(real, kept, follow_symlinks=False)
                copied = True
        return copied

    def by_replacement(self, moves: Sequence[Move]) -> None:
        for move in moves:
            self._place(move)

    def _keep_link(self, move: Move) -> None:
        if move.before:
            kept = f"{self._stage}/{BEFORE}/{number(move.path)}"
            os.symlink(seen_from_stage(move.path, move.before), kept)

    def _place(self, move: Move) -> None:
        real = f"{self._root}/{move.path}"
        if move.before is None:
            os.symlink(bridge_text(move.path), real)
            return
        spare = f"{self._stage}/spare.{os.getpid()}"
        os.symlink(bridge_text(move.path), spare)
        os.replace(spare, real)
