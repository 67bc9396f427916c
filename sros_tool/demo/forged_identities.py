"""Forged identities: wrong dates, wrong keys, revoked, copied; each on a copy of a keystore."""

from __future__ import annotations

import os
from datetime import timedelta
from pathlib import Path

from sros_tool.demo.bench import KEY, PERMISSIONS, Bench
from sros_tool.demo.forged_permissions import signed_by_the_ca
from sros_tool.errors import UnavailableError
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.layout import CRL, REQUIRED_FILES
from sros_tool.keystore.revoke import revoke
from sros_tool.pki.certificates import validity_of
from sros_tool.validity import Window

_NOBODY = 65534
_DAY, _MINUTE = timedelta(days=1), timedelta(minutes=1)
STOLEN = "/stolen"
"""Where a copy of an enclave from before its revocation is kept."""


def in_date(bench: Bench) -> None:
    """The talker's certificate issued anew, from yesterday to tomorrow."""
    bench.reissue("talker", Window(bench.now - _DAY, bench.now + _DAY))


def expired(bench: Bench) -> None:
    """An authority issues nothing from before its own time: the first minute that it may."""
    start = validity_of(bench.authorities().identity.certificate).not_before
    bench.reissue("talker", Window(start, start + _MINUTE))


def not_yet_valid(bench: Bench) -> None:
    """The talker's certificate issued anew, from tomorrow on."""
    bench.reissue("talker", Window(bench.now + _DAY, bench.now + 2 * _DAY))


def key_of_another(bench: Bench) -> None:
    """The talker's certificate with the guest's key."""
    bench.put("talker", KEY, bench.read("guest", KEY))


def _revoke(bench: Bench, part: str) -> None:
    """Revoke an enclave, and issue it anew for the same subject, as its owner would go on."""
    folder = bench.folder(part)
    before = {name: bench.read(part, name) for name in REQUIRED_FILES}
    revoke(bench.root, [bench.cast[part]], now=bench.now, keyring=bench.keyring)
    folder.mkdir(mode=0o700, exist_ok=True)
    for name, data in before.items():
        bench.put(part, name, data)
    bench.reissue(part, Window(bench.now - _DAY, bench.now + _DAY), new_key=True)
    bench.put(part, "crl.pem", (bench.root / CRL).read_bytes())


def talker_revoked(bench: Bench) -> None:
    """The talker was revoked, and issued anew."""
    _revoke(bench, "talker")


def guest_revoked(bench: Bench) -> None:
    """The guest was revoked, and issued anew."""
    _revoke(bench, "guest")


def not_delivered_of_the_talker(bench: Bench) -> None:
    """The talker was revoked, and the listener was not told."""
    _revocation_not_delivered(bench, "talker")


def not_delivered_of_the_guest(bench: Bench) -> None:
    """The copy has permissions from before rights were taken away."""
    now = bench.read("guest", PERMISSIONS)
    signed_by_the_ca(bench)
    before = bench.read("guest", PERMISSIONS)
    bench.put("guest", PERMISSIONS, now)
    _revocation_not_delivered(bench, "guest")
    (enclave_path(bench.root, STOLEN) / PERMISSIONS).write_bytes(before)


def _revocation_not_delivered(bench: Bench, part: str) -> None:
    before = {name: bench.read(part, name) for name in REQUIRED_FILES}
    _revoke(bench, part)
    copy = enclave_path(bench.root, STOLEN)
    copy.mkdir(mode=0o700)
    for name, data in before.items():
        (copy / name).touch(0o600)
        (copy / name).write_bytes(data)
    (bench.folder("listener") / "crl.pem").unlink()


def stolen(bench: Bench) -> None:
    """Another user of the machine copies the files that he can read, and no others."""
    if os.geteuid() != 0:
        raise UnavailableError("only root can try it as another user of this machine")
    folder = bench.folder("talker")
    inside = str(folder.relative_to(bench.root))
    names = [file.name for file in folder.iterdir()]
    copied = _read_as_nobody(bench.root, [f"{inside}/{name}" for name in names])
    for name, data in zip(names, copied, strict=True):
        if data is None:
            (folder / name).unlink()
        else:
            bench.put("talker", name, data)


def _read_as_nobody(root: Path, files: list[str]) -> list[bytes | None]:
    """What a user without any rights can read below a folder, by the modes that lie below it."""
    kept: list[bytes | None] = []
    place = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for file in files:
            read_end, write_end = os.pipe()
            child = os.fork()
            if child == 0:
                status = 1
                try:
                    os.setgroups([])
                    os.setgid(_NOBODY)
                    os.setuid(_NOBODY)
                    descriptor = os.open(file, os.O_RDONLY, dir_fd=place)
                    with os.fdopen(write_end, "wb") as answer:
                        answer.write(os.read(descriptor, 1 << 20))
                    status = 0
                finally:
                    os._exit(status)
            os.close(write_end)
            with os.fdopen(read_end, "rb") as answer_of_child:
                data = answer_of_child.read()
            _, ended = os.waitpid(child, 0)
            kept.append(data if ended == 0 else None)
    finally:
        os.close(place)
    return kept


def readable_for_all(bench: Bench) -> None:
    """What a careless copy leaves behind, and what was standard with ros2/sros2."""
    for path in [bench.root, *bench.root.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)
    stolen(bench)
