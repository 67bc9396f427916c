"""What is wrong with the enclaves that are installed on a robot, as the robot reports it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from sros_tool.checks.keystores.files import KEY_READABLE, check_files
from sros_tool.checks.keystores.opened import CheckedKeystore
from sros_tool.checks.kind import ERROR
from sros_tool.errors import SrosError
from sros_tool.keystore.confirmation import COULD_NOT_START
from sros_tool.keystore.layout import enclave_path, waits_for_answer
from sros_tool.keystore.participant import evaluated
from sros_tool.keystore.reader import FilesReadOnce, OpenedEnclave, OpenedKeystore, open_enclave
from sros_tool.wording import first_few

_MOST_NAMED = 2


class InstalledEnclave(NamedTuple):
    """An enclave on the robot, and a clause on why no process could start in it, or ""."""

    state: OpenedEnclave
    problem: str

    def permissions_until(self) -> datetime | None:
        """Return when its permissions expire; None if that is not known."""
        with suppress(SrosError):
            return self.state.grant.validity.not_after if self.state.grant else None
        return None


def open_installed(
    folder: Path, names: Iterable[str], *, now: datetime
) -> dict[str, InstalledEnclave]:
    """Return the enclaves ``names`` in the security folder ``folder`` that can be looked at."""
    opened, files = {}, FilesReadOnce()
    for name in names:
        place = enclave_path(folder, name)
        with suppress(SrosError, OSError):
            state = open_enclave(place, now=now, files=files)
            evaluation = evaluated(name, place, state, moment=now)
            opened[name] = InstalledEnclave(evaluation.state, "; ".join(evaluation.problems_here))
    return opened


def unusable_sentences(enclaves: Mapping[str, InstalledEnclave]) -> Iterator[str]:
    """Yield a sentence for each enclave in which no process could start."""
    for name, enclave in enclaves.items():
        if enclave.problem:
            yield f"{name} {COULD_NOT_START}: {enclave.problem}."


def exposed_sentences(folder: Path, now: datetime) -> Iterator[str]:
    """Yield sentences on files that others can read or change, as `sros verify` finds them."""
    paths: dict[tuple[str, str], list[str]] = {}
    try:
        for finding in check_files(CheckedKeystore(OpenedKeystore(folder), now, on_robot=True)):
            if finding.severity >= ERROR:
                path = os.path.relpath(finding.file, folder)
                paths.setdefault((finding.kind.title, finding.text), []).append(path)
    except (SrosError, OSError) as error:
        yield f"The modes of the files in '{folder}' cannot be checked: {error}"
    for (title, text), files in paths.items():
        yield f"{first_few(files, _MOST_NAMED)}: {title}: {text}."


def exposed_keys(folder: Path, now: datetime) -> frozenset[str]:
    """Return the paths, in ``folder``, of private keys that others can read, as far as known."""
    keys = set()
    with suppress(SrosError, OSError):
        for finding in check_files(CheckedKeystore(OpenedKeystore(folder), now, on_robot=True)):
            if finding.kind is KEY_READABLE:
                keys.add(os.path.relpath(finding.file, folder))
    return frozenset(keys)


def installed_sentences(folder: Path, names: Sequence[str], now: datetime) -> Iterator[str]:
    """Yield sentences on all that is wrong with the enclaves ``names`` and with the folder."""
    answered = [name for name in names if not waits_for_answer(enclave_path(folder, name))]
    yield from unusable_sentences(open_installed(folder, answered, now=now))
    yield from exposed_sentences(folder, now)
