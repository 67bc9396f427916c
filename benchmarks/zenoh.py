"""Benchmarks of the Zenoh files of a keystore, their floor, and their sizes."""

from __future__ import annotations

import os
import shutil
import statistics
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.inputs import enclaves_policy

Figure = tuple[str, float, float | None, str, bool, str]
"""The task, its value, the floor, the limit, whether it is kept, and the unit."""


def zenoh_files(folder: Path, enclaves: int, rules: int, rounds: int) -> list[Figure]:
    """Measure making the files of a keystore with this number of enclaves, and rules in each.

    The floor reads each certificate and permissions, verifies a signature of each, signs each
    document, and writes files of the same sizes.
    """
    from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
    from sros_tool.keystore.lifecycle.update import set_zenoh
    from sros_tool.keystore.template import load_template
    from sros_tool.policy.document import read_policy
    from sros_tool.zenoh.configuration import Mode, ZenohNetwork

    now = datetime.now(UTC)

    def keystore(name: str, count: int) -> Path:
        root, file = folder / name, folder / f"{name}.xml"
        file.write_text(enclaves_policy(count, rules))
        create_keystore(root, template=load_template("production"), now=now)
        generate_artifacts(root, policies=[read_policy(file)], now=now)
        return root

    # A copy for each round: after the removal of files, ext4 takes longer to make others.
    made_once = keystore("on_zenoh", enclaves)
    roots = [folder / f"on_zenoh_{index}" for index in range(rounds)]
    for root in roots:
        shutil.copytree(made_once, root, symlinks=True)
    os.sync()
    taken, floors = [], []
    for index, root in enumerate(roots):
        taken.append(_seconds(lambda root=root: set_zenoh(root, ZenohNetwork(), now=now)))  # type: ignore[misc]
        files = sorted((root / "enclaves").rglob("*.json5"))
        sizes = [each.stat().st_size for each in files]
        place = folder / f"zenoh floor {index}"
        begin = time.perf_counter()
        _floor(root, sizes, place)
        floors.append(time.perf_counter() - begin)
    made, floor = statistics.median(taken), statistics.median(floors)
    task = f"Zenoh files of {enclaves} enclaves, client mode"
    found: list[Figure] = [(task, made, floor, "2 s", made < 2, "s")]
    found.append(("... size of the router's, in MB", max(sizes) / 1e6, None, "-", True, "MB"))
    found.append(("... size of a session's, in kB", min(sizes) / 1e3, None, "-", True, "kB"))
    peers = ZenohNetwork(mode=Mode.PEER)
    for count in (enclaves // 20, enclaves // 10):
        root = keystore(f"peers_{count}", count)
        seconds = _seconds(lambda root=root: set_zenoh(root, peers, now=now))  # type: ignore[misc]
        size = sum(each.stat().st_size for each in (root / "enclaves").rglob("*.json5"))
        found.append((f"Zenoh files of {count} enclaves, peer mode", seconds, None, "-", True, "s"))
        found.append(("... size of all, in MB", size / 1e6, None, "-", True, "MB"))
    return found


def _floor(root: Path, sizes: list[int], place: Path) -> None:
    """Do the cryptography and the files alone, on all cores as sros does."""
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    from sros_tool.parallel import map_slices
    from sros_tool.pki.keys import generate_key

    key, algorithm = generate_key(), ec.ECDSA(hashes.SHA256())
    signed = key.sign(b"x" * 200, algorithm)
    folders = [each.parent for each in (root / "enclaves").rglob("permissions.p7s")]
    place.mkdir()

    def read(share: object) -> None:
        for folder in share:  # type: ignore[attr-defined]
            for file in ("cert.pem", "permissions.p7s"):
                (folder / file).read_bytes()
            key.public_key().verify(signed, b"x" * 200, algorithm)

    map_slices(folders, read)
    for index, size in enumerate(sizes):
        key.sign(b"x" * 200, algorithm)
        for end in (".json5", ".p7s"):
            (place / f"{index}{end}").write_bytes(b"x" * size)
    os.sync()


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
