"""The benchmark of renewing many enclaves, and its floor: only the same cryptography and files.

Renewing verifies the replaced files: the new certificate keeps the key of the old one, and the new
permissions keep the old rights.  Without verifying the two signatures, whoever can write to an
enclave's folder could get any key certified and any rights signed.  The floor is measured with and
without verifying.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from benchmarks.floor import sizes_of

ROUNDS = 3
RENEWED = ("cert.pem", "permissions.p7s", "permissions.xml")


@dataclass(frozen=True)
class Renewal:
    """The seconds of sros, of the floor, and of the floor without verifying."""

    taken: float
    floor: float
    unchecked: float


def measure_renewal(folder: Path, count: int) -> Renewal:
    """Measure renewing ``count`` enclaves, and replacing files of the same number and sizes."""
    from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
    from sros_tool.keystore.lifecycle.renew import renew
    from sros_tool.keystore.template import load_template

    now = datetime.now(UTC)
    root = folder / "renewal"
    names = [f"/robot{index}/part" for index in range(count)]
    create_keystore(root, template=load_template("production"), now=now)
    create_enclaves(root, names, now=now)
    sizes = sizes_of(root / "enclaves/robot0/part")
    files = [(name, size) for name, size in sizes if name in RENEWED and isinstance(size, int)]
    places = [folder / "renewal floor", folder / "renewal floor, unchecked"]
    for place in places:
        for index in range(count):
            (place / str(index)).mkdir(parents=True)
            for name, size in files:
                (place / str(index) / name).write_bytes(b"o" * size)
    os.sync()
    times: list[tuple[float, float, float]] = []
    for day in range(
        1, ROUNDS + 1
    ):  # in turns, so that a busy moment does not affect only one of them
        later = now + timedelta(days=day)
        times.append(
            (
                _seconds(lambda later=later: renew(root, names, now=later)),  # type: ignore[misc]
                _seconds(lambda: replace_files(places[0], files, count, check=True)),
                _seconds(lambda: replace_files(places[1], files, count, check=False)),
            )
        )
    taken, floor, unchecked = (statistics.median(each) for each in zip(*times, strict=True))
    return Renewal(taken, floor, unchecked)


def replace_files(folder: Path, files: list[tuple[str, int]], count: int, *, check: bool) -> None:
    """Issue for each enclave a certificate for an existing key, sign once, and replace ``files``.

    With ``check``, certificate and permissions are read, and two signatures verified.  All files
    are flushed once before the first one is renamed.  The work is spread over the cores as sros
    does it.
    """
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    from sros_tool.parallel import map_slices
    from sros_tool.pki.certificates import Issuer, common_name, issue_ca, pem
    from sros_tool.pki.keys import generate_key
    from sros_tool.validity import window

    key = generate_key()
    validity = window(datetime.now(UTC), timedelta(days=365))
    authority = issue_ca(key, common_name("floor"), validity)
    issuer, public = Issuer(authority, key), generate_key().public_key()
    name, algorithm = common_name("/floor/enclave"), ec.ECDSA(hashes.SHA256())
    old, signed = issuer.issue(name, public, validity), key.sign(b"x" * 200, algorithm)
    payload = {file: b"x" * size for file, size in files}
    spare = "{}/.{}.new".format

    def write(share: Sequence[int]) -> None:
        for index in share:
            place = os.path.join(folder, str(index))
            if check:
                for file in ("cert.pem", "permissions.p7s"):
                    with open(os.path.join(place, file), "rb", buffering=0) as there:
                        there.readall()
                old.verify_directly_issued_by(authority)
                authority.public_key().verify(signed, b"x" * 200, algorithm)  # type: ignore[union-attr, arg-type, call-arg]
            pem(issuer.issue(name, public, validity))
            key.sign(b"x" * 200, algorithm)
            for file, _ in files:
                handle = os.open(spare(place, file), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
                os.write(handle, payload[file])
                os.close(handle)

    def rename(share: Sequence[int]) -> None:
        for index in share:
            place = os.path.join(folder, str(index))
            for file, _ in files:
                os.replace(spare(place, file), os.path.join(place, file))

    map_slices(range(count), write)
    os.sync()
    map_slices(range(count), rename)


def _seconds(action: Callable[[], object]) -> float:
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin
