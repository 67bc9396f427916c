"""A disk that fills up under each verb that writes: the verb is done, or nothing has changed."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.conftest import POLICY
from tests.support.harness import check_enclave_whole, copy_of, forked, remains, snapshot, sros
from tests.support.long_form import some

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="mounts small disks; needs root")

NEW_ENCLAVES = POLICY.replace('path="/', 'path="/new')

VERBS = (
    "create_keystore new",
    "create_enclave ks /c",
    "create_permission ks /b policy.xml",
    "generate_artifacts -k ks -p new.xml",
    "generate_artifacts -k new -p new.xml",
    "renew ks /a --revoke-old",
    "revoke ks /a",
    "crl ks --refresh",
    "rotate_ca ks --same-key",
    "rotate_ca ks --next",
    "rotate_ca rotated --next",
    "rotate_ca rotated --finish",
    "distribute_key ks /a out",
    "distribute_key ks /a out.tar.gz",
    "create_request /s robot",
    "sign_request ks robot/enclaves/r/request.pem -o second.tar.gz --renew",
    "import answer.tar.gz robot",
    "zenoh ks",
    "create_permission zenoh /b policy.xml",
    "revoke zenoh /a",
    "policies --copy copied",
)


@pytest.fixture(scope="module")
def made(made_keystore: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the verbs work on; only to be copied."""
    folder = tmp_path_factory.mktemp("full")
    (folder / "policy.xml").write_text(POLICY)
    (folder / "new.xml").write_text(NEW_ENCLAVES)
    for name in ("ks", "rotated", "zenoh"):
        copy_of(made_keystore, folder / name)
    for verb in (
        "create_enclave ks /b",
        "create_enclave zenoh /b",
        "rotate_ca rotated --next",
        "zenoh zenoh --mode peer",
        "create_request /r robot",
        "sign_request ks robot/enclaves/r/request.pem -o answer.tar.gz",
    ):
        sros(*verb.split(), cwd=folder).ok()
    return folder


@contextmanager
def small_disk(folder: Path, blocks: int) -> Iterator[None]:
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"nr_blocks={blocks}", "small", folder], capture_output=True
    )
    if mounted.returncode:
        pytest.skip(f"nothing can be mounted here: {mounted.stderr.decode().strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


@pytest.mark.parametrize(
    ("verb", "free"), some([(verb, free) for verb in VERBS for free in (0, 1, 2, 5, 12, 25)], 8)
)
def test_full_disk(verb: str, free: int, made: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    words = verb.split()
    with small_disk(disk, 400):
        shutil.copytree(made, disk, symlinks=True, dirs_exist_ok=True)
        statistics = os.statvfs(disk)
        (disk / "filler").write_bytes(bytes((statistics.f_bavail - free) * statistics.f_bsize))
        before = snapshot(disk)
        ended = forked(*words, first=lambda: os.chdir(disk))
        if ended.status:
            assert os.strerror(errno.ENOSPC) in ended.err
            assert ended.err.count("\n") == 1, ended
            assert snapshot(disk) == before
            (disk / "filler").unlink()
            ended = forked(*words, first=lambda: os.chdir(disk))
        else:
            assert free
        assert ended.status == 0, ended
        assert not remains(disk)
        for key in disk.glob("*/enclaves/**/key.pem"):
            if key.with_name("cert.pem").exists():
                check_enclave_whole(key.parent)
