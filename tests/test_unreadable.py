"""Keystores that the user cannot read in full: verbs that write refuse, verbs that read say it.

After one verb as root, or on a robot whose enclaves belong to several users, a folder or a file of
a keystore may be closed to the user of the next verb.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import list_enclaves
from sros_tool.keystore.lifecycle.renew import renew
from tests.conftest import POLICY
from tests.support.harness import Ended, copy_of, forked, snapshot, sros
from tests.support.long_form import some
from tests.support.users import as_users_of_sros
from tests.test_hostile_folders import NOW, OWNER, give

PARTS = (
    "enclaves",
    "enclaves/arm",
    "enclaves/a",
    "enclaves/a/cert.pem",
    "enclaves/a/key.pem",
    "enclaves/a/permissions.p7s",
)
FOLDERS = PARTS[:3]

# {k} is the keystore, {w} the folder that it is in.
WRITING = (
    "create_enclave {k} /new",
    "create_permission {k} /b {w}/policy.xml",
    "generate_artifacts -k {k} -p {w}/policy.xml",
    "renew {k} /b",
    "renew {k} --all-expiring 100y --dry-run",
    "revoke {k} /b",
    "crl {k} --refresh",
    "rotate_ca {k} --next",
    "rotate_ca {k} --finish",
    "rotate_ca {k} --same-key",
    "sign_request {k} {w}/request.pem -o {w}/answer.tar.gz",
)
NOT_NEEDED = {
    ("renew {k} /b", "enclaves/a/key.pem"),
    ("renew {k} /b", "enclaves/a/permissions.p7s"),
}
"""What the renewal of one enclave does not look at: key and permissions of another one."""
READING = (
    "list_enclaves {k}",
    "check {k}",
    "inspect {k}",
    "verify {k}",
    "explain {k} --who publish /old_b",
    "view {k} --format dot",
    "diff_policy {k} {w}/policy.xml",
)


@pytest.fixture(scope="module")
def made(made_keystore: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore with a namespace and a list, a policy and a request."""
    folder = tmp_path_factory.mktemp("whole")
    root = folder / "ks"
    copy_of(made_keystore, root)
    sros("create_enclave", root, "/arm/camera", "/old").ok()
    sros("revoke", root, "/old").ok()
    sros("create_request", "/robot", folder / "made").ok()
    shutil.copy(folder / "made/enclaves/robot/request.pem", folder / "request.pem")
    (folder / "policy.xml").write_text(POLICY)
    for file in ("request.pem", "policy.xml"):
        (folder / file).chmod(0o644)
    shutil.rmtree(folder / "made")
    return folder


@pytest.fixture
def place(made: Path) -> Iterator[Path]:
    """A copy of one's own of ``made``, which another user owns and can reach."""
    with TemporaryDirectory(dir=os.environ.get("PYTEST_DEBUG_TEMPROOT")) as folder:
        place = Path(folder)
        shutil.copytree(made, place, symlinks=True, dirs_exist_ok=True)
        give(place, OWNER)
        yield place


@pytest.fixture
def spare(made: Path, tmp_path: Path) -> Path:
    """Another copy of ``made``, which can be read."""
    return copy_of(made, tmp_path / "spare")


def words(verb: str, folder: Path) -> list[str]:
    return verb.format(k=folder / "ks", w=folder).split()


def as_owner(verb: str, folder: Path) -> Ended:
    """Run a verb as the owner of the keystore.

    What the verb imports was imported before: Python may be in a folder of root.
    """

    def become() -> None:
        os.setgroups([])
        os.setgid(OWNER)
        os.setuid(OWNER)

    return forked(*words(verb, folder), env=dict(os.environ), first=become)


@contextmanager
def closed(path: Path) -> Iterator[None]:
    """Have only root read a path for the time of a test."""
    before = path.stat()
    os.chown(path, 0, 0)
    path.chmod(0o700 if path.is_dir() else 0o600)
    yield
    os.chown(path, before.st_uid, before.st_gid)
    path.chmod(stat.S_IMODE(before.st_mode))


@as_users_of_sros
@pytest.mark.parametrize("verb", some(WRITING, 2))
def test_a_verb_that_writes_refuses_what_it_cannot_read(
    verb: str, place: Path, spare: Path
) -> None:
    sros(*words(verb, spare)).ok()
    before = snapshot(place)
    for part in PARTS:
        if (verb, part) in NOT_NEEDED:
            continue
        with closed(place / "ks" / part):
            ended = as_owner(verb, place)
        assert ended.status == 2, (part, ended)
        assert f"ks/{part}" in ended.err, (part, ended)
        assert snapshot(place) == before, part


@as_users_of_sros
def test_an_export_reads_the_enclaves_that_it_exports(place: Path) -> None:
    for part in PARTS:
        with closed(place / "ks" / part):
            ended = as_owner("distribute_key {k} /a {w}/robot --dry-run", place)
            other = as_owner("distribute_key {k} /b {w}/robot --dry-run", place)
        assert (ended.status == 2) == (part != "enclaves/arm"), (part, ended)
        assert (other.status == 2) == (part == "enclaves"), (part, other)
        for each in (ended, other):
            assert each.status == 0 or f"ks/{part}" in each.err, (part, each)


@as_users_of_sros
@pytest.mark.parametrize("verb", some(READING, 3))
def test_a_verb_that_reads_says_what_it_cannot_read(verb: str, place: Path, spare: Path) -> None:
    whole = sros(*words(verb, spare))
    for part in FOLDERS:
        with closed(place / "ks" / part):
            ended = as_owner(verb, place)
        # A verb that can show the rest reports the folder as a finding.
        assert ended.status == (1 if ended.out else 2), (part, ended)
        assert f"ks/{part}" in ended.out + ended.err, (part, ended)
    assert "cannot be read" not in whole.out + whole.err


@as_users_of_sros
def test_a_process_runs_next_to_enclaves_of_other_users(place: Path, spare: Path) -> None:
    """On a robot, each enclave may belong to the user of its process."""
    for verb in ("env {k} /b", "explain {k} /b publish /old_b"):
        sros(*words(verb, spare)).ok()
        with closed(place / "ks/enclaves/a"):
            as_owner(verb, place).ok()


def test_a_link_to_enclaves_elsewhere_is_not_skipped(keystore: Path, tmp_path: Path) -> None:
    (keystore / "enclaves/a").rename(tmp_path / "a")
    (keystore / "enclaves/a").symlink_to(tmp_path / "a")
    for refused in (lambda: list_enclaves(keystore), lambda: renew(keystore, ["/b"], now=NOW)):
        with pytest.raises(KeystoreError, match=r"enclaves/a.*link to a folder elsewhere"):
            refused()
    (keystore / "enclaves/a").unlink()
    (keystore / "enclaves/a").symlink_to("b")
    assert list_enclaves(keystore) == ("/b",)
    assert renew(keystore, ["/b"], now=NOW).names("renewed") == ("/b",)


@pytest.mark.parametrize("file", ["key.pem", "permissions.xml"])
def test_a_link_in_place_of_a_file_hides_no_other_enclave(
    file: str, keystore: Path, tmp_path: Path
) -> None:
    (keystore / "enclaves/a" / file).unlink()
    (keystore / "enclaves/a" / file).symlink_to(tmp_path)
    assert sros("list_enclaves", keystore).ok().out.split() == ["/a", "/b"]
    assert "/b" in sros("explain", keystore, "--who", "publish", "/old_b").out
