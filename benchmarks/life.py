"""Renewing many enclaves, beside its floor: the same cryptography and files, with nothing else."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from benchmarks.floor import sizes_of

RENEWED = ("cert.pem", "permissions.p7s", "permissions.xml")


def measure_renewal(folder: Path, count: int) -> tuple[float, float]:
    """Seconds that it takes to renew ``count`` enclaves of a keystore, and the floor of that."""
    from sros_tool.keystore import create_enclaves, create_keystore
    from sros_tool.keystore.renew import renew
    from sros_tool.keystore.template import load_template

    now = datetime.now(UTC)
    root = folder / "renewal"
    names = [f"/robot{index}/part" for index in range(count)]
    create_keystore(root, template=load_template("production"), now=now)
    create_enclaves(root, names, now=now)
    sizes = sizes_of(root / "enclaves/robot0/part")
    files = [(name, size) for name, size in sizes if name in RENEWED and isinstance(size, int)]
    place = folder / "renewal floor"
    for index in range(count):
        (place / str(index)).mkdir(parents=True)
        for name, size in files:
            (place / str(index) / name).write_bytes(b"o" * size)
    os.sync()
    taken = _seconds(lambda: renew(root, names, now=now + timedelta(days=1)))
    return taken, _seconds(lambda: replace_files(place, files, count))


def replace_files(folder: Path, files: list[tuple[str, int]], count: int) -> None:
    """Per enclave: a certificate for a key that exists, one signature, and files replaced.

    One flush makes all of it last, and comes before the first file gets its name.
    """
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    from sros_tool.pki.certificates import Issuer, common_name, issue_ca, pem
    from sros_tool.pki.keys import generate_key
    from sros_tool.validity import window

    key = generate_key()
    validity = window(datetime.now(UTC), timedelta(days=365))
    issuer = Issuer(issue_ca(key, common_name("floor"), validity), key)
    public = generate_key().public_key()
    name, algorithm = common_name("/floor/enclave"), ec.ECDSA(hashes.SHA256())
    payload = {file: b"x" * size for file, size in files}
    spare = "{}/.{}.new".format
    for index in range(count):
        pem(issuer.issue(name, public, validity))
        key.sign(b"x" * 200, algorithm)
        place = os.path.join(folder, str(index))
        for file, _ in files:
            handle = os.open(spare(place, file), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            os.write(handle, payload[file])
            os.close(handle)
    os.sync()
    for index in range(count):
        place = os.path.join(folder, str(index))
        for file, _ in files:
            os.replace(spare(place, file), os.path.join(place, file))


def _seconds(action: Callable[[], object]) -> float:
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin
