"""Folders that others wrote, or can write: nothing in them leads a verb of root elsewhere.

Run as root, these tests act as three parties: root, the owner of the folder, and a stranger.  Run
as another user, they act as that user alone.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import shutil
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import pytest

import sros_tool
from sros_tool.checks.keystores.arrival import verify_arrival
from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.errors import DocumentError, KeystoreError, SrosError
from sros_tool.files import _follow_own_links, replace_file, staged_file
from sros_tool.folders import Folder
from sros_tool.keystore import transaction as transactions
from sros_tool.keystore.delivery.export import distribute
from sros_tool.keystore.delivery.robot import create_requests
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.layout import LOCK, STAGE
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.keystore.transaction import staged_name
from sros_tool.runtime.processes import FileReader, Process, ProcessRoot, with_files
from sros_tool.xml import read_bytes, why_unreadable
from tests.conftest import MEMORY, POLICY
from tests.support.children import run
from tests.support.harness import copy_of, create_request, snapshot, sros
from tests.support.users import as_root

NOW = datetime.now(UTC)
OWNER, STRANGER = 65533, 65532


def give(path: Path, user: int) -> None:
    """Make a user the owner of a folder and of everything in it."""
    os.chown(path, user, user, follow_symlinks=False)
    if path.is_dir() and not path.is_symlink():
        for each in path.iterdir():
            give(each, user)


def in_process_of(user: int, work: Callable[[], object]) -> str:
    """Do work in a process of another user; return the text of its SrosError or OSError, or ""."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        said = "a defect"
        try:
            os.setgroups([])
            os.setgid(user)
            os.setuid(user)
            work()
            said = ""
        except (SrosError, OSError) as error:
            said = str(error)
        finally:
            os.write(writer, said.encode())
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        said = pipe.read()
    os.waitpid(child, 0)
    return said


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """Files that nothing in a keystore may reach."""
    folder = tmp_path / "outside"
    folder.mkdir()
    for name in ("shadow", staged_name("enclaves/a/cert.pem"), "enclaves"):
        (folder / name).write_text("precious")
    return folder


# ── the stage of a transaction ─────────────────────────────────────────────────────────────


def stage(keystore: Path, live: str = "after") -> Path:
    folder = keystore / STAGE
    folder.mkdir(mode=0o700)
    for name in ("before", "after", "added"):
        (folder / name).mkdir()
    (folder / "live").symlink_to(live)
    (folder / "manifest.json").write_text('{"version": 2, "moves": []}')
    return folder


def to_link(folder: Path, target: Path) -> None:
    folder.rmdir()
    folder.symlink_to(target)


def manifest(folder: Path, *moves: list[str | None]) -> None:
    (folder / "manifest.json").write_text(json.dumps({"version": 2, "moves": moves}))


def replace_by_link(path: Path, target: str | Path) -> None:
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink()
    path.symlink_to(target)


def earlier_format(folder: Path, outside: Path) -> None:
    replace_by_link(folder / "added", outside)
    (folder / "added").rename(folder / "new")
    (folder / "removed").write_text(f"{outside}/shadow\n../../outside/shadow\n")


def after_as_link(folder: Path, outside: Path) -> None:
    replace_by_link(folder / "after", outside)
    manifest(folder, ["enclaves/a/cert.pem", None, ""])


def before_as_link(folder: Path, outside: Path) -> None:
    replace_by_link(folder / "before", outside)
    replace_by_link(folder / "live", "before")
    manifest(folder, ["enclaves/a/cert.pem", "", None])


def list_as_pipe(folder: Path, outside: Path) -> None:
    (folder / "manifest.json").unlink()
    os.mkfifo(folder / "manifest.json")


def added(path: str) -> Callable[[Path, Path], None]:
    def make(folder: Path, outside: Path) -> None:
        (folder / "added" / path).parent.mkdir()
        (folder / "added" / path).write_text("mine")

    return make


MADE_UP: dict[str, Callable[[Path, Path], None]] = {
    "the format of an earlier version": earlier_format,
    "added is a link": lambda s, o: replace_by_link(s / "added", o),
    "added leads to a link": lambda s, o: (s / "added/enclaves").symlink_to(o),
    "after is a link": after_as_link,
    "before is a link": before_as_link,
    "live leads elsewhere": lambda s, o: replace_by_link(s / "live", o),
    "the list is a link": lambda s, o: replace_by_link(s / "manifest.json", o / "shadow"),
    "the list is a pipe": list_as_pipe,
    "a path out of the keystore": lambda s, o: manifest(s, ["../outside/shadow", "", None]),
    "an absolute path": lambda s, o: manifest(s, [f"{o}/shadow", "", None]),
    "a file that no keystore has": added("enclaves/authorized_keys"),
    "a folder that no keystore has": added(".ssh/id.pem"),
    "a link out of the keystore": lambda s, o: manifest(
        s, ["enclaves/a/key.pem", None, f"{o}/shadow"]
    ),
    "a pipe": lambda s, o: os.mkfifo(s / "after" / staged_name("enclaves/a/cert.pem")),
}


@pytest.mark.parametrize("name", MADE_UP)
def test_a_made_up_stage_moves_and_deletes_nothing(
    name: str, keystore: Path, outside: Path, tmp_path: Path
) -> None:
    MADE_UP[name](stage(keystore), outside)
    before = snapshot(tmp_path)
    verbs: list[Callable[[], object]] = [
        lambda: create_enclaves(keystore, ["/new"], now=NOW),
        lambda: renew(keystore, ["/a"], now=NOW),
        lambda: revoke(keystore, ["/a"], now=NOW),
    ]
    for verb in verbs:
        with pytest.raises(KeystoreError):
            verb()
        assert snapshot(tmp_path) == before


@pytest.mark.parametrize("name", MADE_UP)
def test_no_verb_is_recommended_over_a_made_up_stage(
    name: str, keystore: Path, outside: Path
) -> None:
    MADE_UP[name](stage(keystore), outside)
    found = keystore_findings(OpenedKeystore(keystore), Circumstances(NOW))
    (of_stage,) = [each for each in found if Path(each.file).name == STAGE]
    assert of_stage.kind.id == "keystore.transaction-not-ours"
    assert "create_enclave" not in of_stage.kind.remedy


@as_root
@pytest.mark.parametrize("part", ["", "added", "after", "added/enclaves/x.pem"])
def test_a_stage_of_another_user_is_refused(part: str, keystore: Path, tmp_path: Path) -> None:
    folder = stage(keystore)
    (folder / "added/enclaves").mkdir()
    (folder / "added/enclaves/x.pem").write_text("mine")
    os.chown(folder / part, STRANGER, STRANGER)
    before = snapshot(tmp_path)
    with pytest.raises(KeystoreError, match=f"belongs to user {STRANGER}"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert snapshot(tmp_path) == before


def test_a_stage_that_others_can_open_is_refused(keystore: Path) -> None:
    stage(keystore).chmod(0o755)
    with pytest.raises(KeystoreError, match="Other users"):
        create_enclaves(keystore, ["/new"], now=NOW)


# ── root in the folder of somebody else ────────────────────────────────────────────────────


@as_root
def test_what_root_makes_belongs_to_the_owner_of_the_keystore(reachable: Path) -> None:
    keystore = reachable
    give(keystore, OWNER)
    create_enclaves(keystore, ["/by_root/inner"], now=NOW)
    renew(keystore, ["/a"], now=NOW, new_key=True)
    revoke(keystore, ["/b"], now=NOW)
    for parent, folders, files in os.walk(keystore):
        for name in (*folders, *files):
            state = os.lstat(os.path.join(parent, name))
            assert (state.st_uid, state.st_gid) == (OWNER, OWNER), name
    assert not in_process_of(OWNER, lambda: create_enclaves(keystore, ["/own"], now=NOW))
    assert (keystore / "enclaves/own/key.pem").stat().st_uid == OWNER


@as_root
def test_what_each_verb_of_root_makes_belongs_to_the_owner(keystore: Path, tmp_path: Path) -> None:
    keys, robot, request = tmp_path / "keys", tmp_path / "robot", tmp_path / "request.pem"
    for folder in (keys, robot):
        folder.mkdir()
    (tmp_path / "policy.xml").write_text(POLICY)
    give(tmp_path, OWNER)
    sros("create_request", "/r", robot).ok()
    shutil.copy(robot / "enclaves/r/request.pem", request)
    for verb in (
        "create_permission ks /b policy.xml",
        "generate_artifacts -k ks -p policy.xml",
        "renew ks /a --revoke-old",
        "crl ks --refresh",
        "rotate_ca ks --same-key",
        "sign_request ks request.pem -o answer.tar.gz",
        "import answer.tar.gz robot",
        "distribute_key ks /a robot",
        f"rotate_ca ks --next --identity-key file:{keys}/i.pem --permissions-key file:{keys}/p.pem",
        "rotate_ca ks --next",
        "rotate_ca ks --next",
        f"rotate_ca ks --finish --identity-key file:{keys}/2.pem --permissions-key "
        f"file:{keys}/3.pem",
    ):
        sros(*verb.split(), cwd=tmp_path).ok()
        for folder in (keystore, robot, keys):
            for path in (folder, *folder.rglob("*")):
                state = path.lstat()
                assert (state.st_uid, state.st_gid) == (OWNER, OWNER), (verb, path)
    assert len(list(keys.iterdir())) == 4


@as_root
def test_a_ca_key_is_not_left_to_the_owner_of_another_folder(keystore: Path, sticky: Path) -> None:
    give(keystore, OWNER)
    os.chown(sticky, STRANGER, STRANGER)
    place = f"file:{sticky}/key.pem"
    sros("rotate_ca", keystore, "--next", "--identity", "--identity-key", place).ok()
    assert (sticky / "key.pem").stat().st_uid == 0


@as_root
def test_root_completes_what_the_owner_was_killed_in(keystore: Path) -> None:
    folder = stage(keystore)
    (folder / "added/enclaves/x").mkdir(parents=True)
    (folder / "added/enclaves/x/request.pem").write_text("staged")
    give(keystore, OWNER)
    create_enclaves(keystore, ["/new"], now=NOW)
    assert (keystore / "enclaves/x/request.pem").read_text() == "staged"
    assert not (keystore / STAGE).exists()


@pytest.fixture
def reachable(made_keystore: Path) -> Iterator[Path]:
    """A keystore that every user can reach: pytest closes its own folders whenever it starts."""
    with TemporaryDirectory(dir=MEMORY if os.access(MEMORY, os.W_OK) else None) as folder:
        Path(folder).chmod(0o755)
        yield copy_of(made_keystore, Path(folder, "ks"))


# ── the lock ───────────────────────────────────────────────────────────────────────────────


@as_root
def test_nobody_else_can_block_the_writers(reachable: Path) -> None:
    """The reader of a keystore locks all that he can open, and its owner writes on."""
    keystore = reachable
    keystore.chmod(0o755)
    ready, go = os.pipe()
    done, end = os.pipe()

    def block() -> None:
        import fcntl

        for name in (".", LOCK, "private", "public", "enclaves"):
            with suppress(OSError):
                fcntl.flock(os.open(keystore / name, os.O_RDONLY), fcntl.LOCK_EX)
        os.write(go, b".")
        os.close(end)
        os.read(done, 1)

    child = os.fork()
    if child == 0:
        with suppress(BaseException):
            os.setgid(STRANGER)
            os.setuid(STRANGER)
            block()
        os._exit(0)
    os.read(ready, 1)
    create_enclaves(keystore, ["/new"], now=NOW)  # is not busy
    os.close(end)
    os.waitpid(child, 0)
    assert (keystore / "enclaves/new/key.pem").exists()
    assert not (keystore / LOCK).exists()


def test_a_lock_file_that_is_a_link_is_not_followed(keystore: Path, outside: Path) -> None:
    (keystore / LOCK).symlink_to(outside / "new")
    with pytest.raises(KeystoreError, match="is in the way"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert not (outside / "new").exists()


@pytest.mark.parametrize("kind", ["link", "folder", "pipe", "socket"])
def test_what_is_in_the_way_of_the_lock_is_named(kind: str, keystore: Path) -> None:
    before = snapshot(keystore)
    path = keystore / LOCK
    if kind == "link":
        path.symlink_to("gone")
    elif kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        os.mknod(path, stat.S_IFSOCK | 0o600)
    with pytest.raises(KeystoreError, match=r"is in the way.* remove this file"):
        create_enclaves(keystore, ["/new"], now=NOW)
    path.rmdir() if kind == "folder" else path.unlink()
    assert snapshot(keystore) == before
    create_enclaves(keystore, ["/new"], now=NOW)


@as_root
def test_a_lock_file_with_two_names_changes_no_owner(keystore: Path, outside: Path) -> None:
    os.link(outside / "shadow", keystore / LOCK)
    give(keystore, OWNER)
    os.chown(outside / "shadow", 0, 0)
    create_enclaves(keystore, ["/new"], now=NOW)
    assert (outside / "shadow").stat().st_uid == 0
    assert (outside / "shadow").read_text() == "precious"


@as_root
@pytest.mark.parametrize("left", [LOCK, STAGE, f"{STAGE}/added"])
def test_what_a_killed_run_of_root_left_is_said_and_ended_by_root(
    left: str, reachable: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root is killed between making a file or folder and giving it to the owner."""
    monkeypatch.setattr(transactions, "_LOCK_SECONDS", 0.0)
    keystore = reachable
    (keystore / STAGE).mkdir(mode=0o700)
    give(keystore, OWNER)
    path = keystore / left
    if left == LOCK:
        path.touch(mode=0o600)
    elif left == STAGE:
        give(path, 0)
    else:
        path.mkdir(mode=0o700)
    said = in_process_of(OWNER, lambda: create_enclaves(keystore, ["/new"], now=NOW))
    assert f"'{path}' is in the way" in said and "run the command once as root" in said
    assert "It belongs to user root, whose run" in said
    create_enclaves(keystore, ["/new"], now=NOW)
    assert in_process_of(OWNER, lambda: create_enclaves(keystore, ["/other"], now=NOW)) == ""


def test_a_file_system_without_locks_is_said_and_nothing_stays(
    keystore: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_handle: int, _operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", refuse)
    around, handles = sorted(os.listdir(keystore.parent)), len(os.listdir("/proc/self/fd"))
    for words in (("create_enclave", keystore, "/new"), ("create_keystore", f"{keystore}2")):
        said = sros(*words).err
        assert "cannot be locked" in said and "Use a folder on a local disk" in said
    assert sorted(os.listdir(keystore.parent)) == around
    assert len(os.listdir("/proc/self/fd")) == handles


def test_the_lock_is_of_one_holder_at_a_time(keystore: Path) -> None:
    with Folder(keystore) as one, Folder(keystore) as two:
        first = transactions.KeystoreLock(one).acquire()
        with pytest.raises(KeystoreError, match="is busy"):
            transactions.KeystoreLock(two).acquire(wait=0.0)
        first.release()
        transactions.KeystoreLock(two).acquire(wait=0.0).release()
    assert not (keystore / LOCK).exists()


def test_releasing_a_lock_leaves_the_lock_of_the_next_holder(
    keystore: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process locks as soon as the file of the first is gone."""
    unlink = Folder.unlink
    taken: list[transactions.KeystoreLock] = []

    def unlink_then_another_locks(folder: Folder, path: str, **options: bool) -> None:
        unlink(folder, path, **options)
        if not taken:
            taken.append(transactions.KeystoreLock(two).acquire(wait=0.0))

    with Folder(keystore) as one, Folder(keystore) as two:
        first = transactions.KeystoreLock(one).acquire()
        monkeypatch.setattr(Folder, "unlink", unlink_then_another_locks)
        first.release()
        assert (keystore / LOCK).exists()
        taken[0].release()
    assert not (keystore / LOCK).exists()


def test_a_lock_that_a_full_disk_holds_once_is_released(
    keystore: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unlink = Folder.unlink
    refused: list[str] = []

    def refuse_once(folder: Folder, path: str, **options: bool) -> None:
        if not refused:
            refused.append(path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
        unlink(folder, path, **options)

    with Folder(keystore) as one:
        first = transactions.KeystoreLock(one).acquire()
        monkeypatch.setattr(Folder, "unlink", refuse_once)
        first.release()
    assert refused == [LOCK]
    assert not (keystore / LOCK).exists()


# ── outputs in a sticky folder ─────────────────────────────────────────────────────────────


@pytest.fixture
def sticky(tmp_path: Path) -> Path:
    """A folder like /tmp."""
    folder = tmp_path / "sticky"
    folder.mkdir()
    folder.chmod(0o1777)
    return folder


@as_root
def test_an_output_does_not_follow_the_link_of_another_user(sticky: Path, outside: Path) -> None:
    (sticky / "out.xml").symlink_to(outside / "shadow")
    os.chown(sticky / "out.xml", STRANGER, STRANGER, follow_symlinks=False)
    replace_file(sticky / "out.xml", b"new")
    assert (outside / "shadow").read_text() == "precious"
    assert not (sticky / "out.xml").is_symlink()
    assert (sticky / "out.xml").read_bytes() == b"new"


@as_root
def test_an_output_does_not_follow_a_chain_to_the_link_of_another_user(
    sticky: Path, outside: Path, tmp_path: Path
) -> None:
    (sticky / "evil").symlink_to(outside / "shadow")
    os.chown(sticky / "evil", STRANGER, STRANGER, follow_symlinks=False)
    (tmp_path / "own").symlink_to(sticky / "evil")
    replace_file(tmp_path / "own", b"new")
    assert (outside / "shadow").read_text() == "precious"


@as_root
def test_an_output_is_not_left_to_the_owner_of_a_file_that_waited_there(sticky: Path) -> None:
    waiting = sticky / "out.xml"
    waiting.write_text("")
    waiting.chmod(0o666)
    os.chown(waiting, STRANGER, STRANGER)
    replace_file(waiting, b"new")
    assert waiting.stat().st_uid == 0
    assert not waiting.stat().st_mode & 0o022


@as_root
def test_an_output_is_not_written_to_the_pipe_of_another_user(sticky: Path) -> None:
    os.mkfifo(sticky / "out.xml")
    os.chown(sticky / "out.xml", STRANGER, STRANGER)
    with pytest.raises(PermissionError, match="pipe of another user"):
        replace_file(sticky / "out.xml", b"new")


def test_an_output_to_a_pipe_does_not_follow_a_link_that_took_its_place(
    tmp_path: Path, outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.xml"
    os.mkfifo(path)
    follow = _follow_own_links

    def followed(given: Path) -> tuple[Path, bool]:
        found = follow(given)
        looked = given.stat()
        given.unlink()
        given.symlink_to(outside / "shadow")
        monkeypatch.setattr("sros_tool.files._file_state", lambda _path, follow: looked)
        return found

    monkeypatch.setattr("sros_tool.files._follow_own_links", followed)
    with pytest.raises(OSError, match="replaced by another file"):
        replace_file(path, b"new")
    assert (outside / "shadow").read_text() == "precious"


def test_an_archive_that_waited_there_is_not_read_into_memory(keystore: Path, sticky: Path) -> None:
    with (sticky / "robot.tar.gz").open("wb") as file:
        file.truncate(1 << 42)
    with pytest.raises(KeystoreError, match="already exists, with other content"):
        distribute(OpenedKeystore(keystore), ["/a"], sticky / "robot.tar.gz", now=NOW)


def test_an_output_follows_a_link_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "real.xml").write_text("old")
    (tmp_path / "link.xml").symlink_to("real.xml")
    replace_file(tmp_path / "link.xml", b"new")
    assert (tmp_path / "link.xml").is_symlink()
    assert (tmp_path / "real.xml").read_bytes() == b"new"


def test_an_output_goes_to_the_standard_output(keystore: Path) -> None:
    ended = sros("list_enclaves", keystore, "--json")
    assert ended.status == 0
    replace_file(Path("/dev/null"), b"new")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_a_file_with_a_key_that_a_killed_process_left_is_removed_by_the_next(
    tmp_path: Path,
) -> None:
    child = os.fork()
    if child == 0:
        with staged_file(tmp_path / "robot.tar.gz", b"PRIVATE KEY"):
            os._exit(0)
    os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 1
    (tmp_path / ".robot.tar.gz.sros-of.somebody").symlink_to("nowhere")
    with staged_file(tmp_path / "robot.tar.gz", b"in use"):
        with staged_file(tmp_path / "robot.tar.gz", b"new") as put_in_place:
            put_in_place()
        assert len(list(tmp_path.iterdir())) == 3, "the one in use, the link, and the new one"
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        ".robot.tar.gz.sros-of.somebody",
        "robot.tar.gz",
    ]


_BELOW_A_LINK: dict[str, Callable[[Folder], object]] = {
    "read": lambda folder: folder.read("link/file"),
    "names": lambda folder: folder.names("link"),
    "create": lambda folder: os.close(folder.create("link/new", 0o600)),
    "open_private": lambda folder: os.close(folder.open_private("link/file")),
    "symlink": lambda folder: folder.symlink("nowhere", "link/new"),
    "mkdir": lambda folder: folder.mkdir("link/new", 0o700),
    "rename": lambda folder: folder.rename("own", "link/new"),
    "link": lambda folder: folder.link("own", "link/new"),
    "unlink": lambda folder: folder.unlink("link/file"),
    "remove_tree": lambda folder: folder.remove_tree("link/inner"),
}


def test_a_file_is_read_through_links_that_stay_in_the_folder(tmp_path: Path) -> None:
    top = tmp_path / "top"
    for name in ("a/b", "far/deep/below"):
        (top / name).mkdir(parents=True)
    for path in ("top/far/file", "top/far/deep/file", "top/file", "file", "top/a/file"):
        (tmp_path / path).write_text(path)
    (top / "a/link").symlink_to(top / "far/deep")
    targets = {
        "../file": "top/a/file",
        "../../file": "top/file",
        "../../../file": None,
        "../link/file": "top/far/deep/file",
        "../link/../file": "top/far/file",
        "../../far/deep/below/../file": "top/far/deep/file",
        str(top / "file"): "top/file",
        str(tmp_path / "file"): None,
        "/file": None,
    }
    with Folder(top) as folder:
        for target, expected in targets.items():
            (top / "a/b/link").symlink_to(target)
            if expected:
                assert folder.read_inside("a/b/link").decode() == expected
            else:
                with pytest.raises(KeystoreError, match="is a link out of"):
                    folder.read_inside("a/b/link")
            (top / "a/b/link").unlink()
        assert folder.read_inside("a/link/file") == b"top/far/deep/file"
        for missing in ("a/b/link", "a/none/file"):
            with pytest.raises(FileNotFoundError):
                folder.read_inside(missing)


@pytest.mark.parametrize("operation", _BELOW_A_LINK.values(), ids=_BELOW_A_LINK)
def test_no_operation_goes_through_a_link(
    operation: Callable[[Folder], object], tmp_path: Path
) -> None:
    (tmp_path / "outside/inner").mkdir(parents=True)
    (tmp_path / "outside/file").write_text("content")
    (tmp_path / "opened").mkdir()
    (tmp_path / "opened/own").write_text("own")
    (tmp_path / "opened/link").symlink_to(tmp_path / "outside")
    before = snapshot(tmp_path)
    with (
        Folder(tmp_path / "opened") as folder,
        pytest.raises(KeystoreError, match="opened/link' is a symbolic link"),
    ):
        operation(folder)
    assert snapshot(tmp_path) == before


# ── keys that only root can read ───────────────────────────────────────────────────────────


def _named_in_settings(keystore: Path, role: str, key: Path) -> None:
    text = (keystore / "sros.toml").read_text()
    place = f'{role}_key = "file:{key}"'
    (keystore / "sros.toml").write_text(text.replace("[authorities]", f"[authorities]\n{place}"))


def _linked(keystore: Path, role: str, key: Path) -> None:
    (keystore / f"private/{role}_ca.key.pem").unlink()
    (keystore / f"private/{role}_ca.key.pem").symlink_to(key)


@as_root
@pytest.mark.parametrize("lead", [_named_in_settings, _linked])
@pytest.mark.parametrize("role", ["identity", "permissions"])
def test_the_keystore_of_another_user_does_not_sign_with_a_key_of_root(
    lead: Callable[[Path, str, Path], None], role: str, keystore: Path, tmp_path: Path
) -> None:
    own = tmp_path / "of root"
    copy_of(keystore, own)
    key = own / f"private/{role}_ca.key.pem"
    lead(keystore, role, key)
    give(keystore, OWNER)
    before = snapshot(tmp_path)
    with pytest.raises(KeystoreError, match="belongs to another user") as caught:
        create_enclaves(keystore, ["/new"], now=NOW)
    assert f"SROS_{role.upper()}_KEY" in caught.value.remedy
    assert snapshot(tmp_path) == before
    named = Keyring(places={role: f"file:{key}"})
    create_enclaves(keystore, ["/new"], now=NOW, keyring=named)


@pytest.mark.parametrize("finish", [True, False])
def test_a_rotation_copies_no_file_from_outside(
    finish: bool, keystore: Path, outside: Path
) -> None:
    """The copy of the old key would belong to the owner of the keystore."""
    key = keystore / "private/identity_ca.key.pem"
    good = key.read_bytes()
    if not finish:
        rotate_ca(keystore, now=datetime.now(UTC), roles=("identity",))
    key.unlink()
    key.symlink_to(outside / "shadow")
    with pytest.raises(SrosError):
        rotate_ca(keystore, now=datetime.now(UTC), roles=("identity",), finish=finish)
    assert not (keystore / "retired").exists()
    key.unlink()
    key.write_bytes(good)
    rotate_ca(keystore, now=datetime.now(UTC), roles=("identity",), finish=finish)
    assert list((keystore / "retired").glob("*.key.pem"))


@pytest.mark.parametrize("whole", [True, False])
def test_revoking_copies_no_file_that_a_link_leads_to_meanwhile(
    whole: bool, keystore: Path, outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = keystore / "enclaves/a/key.pem"
    key.unlink()
    key.symlink_to(outside / "shadow")
    if not whole:
        (key.parent / "notes.txt").touch()  # then file by file is moved
    scandir = os.scandir

    def before(path: Path) -> Any:
        """Show the enclave's folder as it was a moment before: with files, and no link."""
        if path != key.parent:
            return scandir(path)
        mode = SimpleNamespace(st_mode=0o600)
        file = {"is_symlink": lambda: False, "is_file": lambda: True, "stat": lambda: mode}
        return nullcontext([SimpleNamespace(name=entry.name, **file) for entry in scandir(path)])

    with monkeypatch.context() as patched:
        patched.setattr(os, "scandir", before)
        with nullcontext() if whole else pytest.raises(KeystoreError, match="is a link out of"):
            revoke(keystore, ["/a"], now=NOW)
    assert (keystore / "revoked").exists() == whole
    assert not list(keystore.glob("revoked/*/key.pem"))


@pytest.mark.parametrize("file", ["key.pem", "identity_ca.cert.pem", "governance.p7s"])
@pytest.mark.parametrize("name", ["robot", "robot.tar.gz"])
def test_an_export_follows_no_link_out_of_the_keystore(
    file: str, name: str, keystore: Path, tmp_path: Path
) -> None:
    path = keystore / "enclaves/a" / file
    shutil.copy(path, tmp_path / file)
    path.unlink()
    path.symlink_to(tmp_path / file)
    with pytest.raises(KeystoreError, match="is a link out of"):
        distribute(OpenedKeystore(keystore), ["/a"], tmp_path / name, now=NOW)
    assert not (tmp_path / name).exists()
    path.unlink()
    shutil.copy(tmp_path / file, path)
    distribute(OpenedKeystore(keystore), ["/a"], tmp_path / name, now=NOW)


def test_an_export_reads_no_file_that_a_link_leads_to_meanwhile(
    keystore: Path, outside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = keystore / "enclaves/a/permissions.p7s"

    read = OpenedKeystore.enclave

    def opened(*words: Any, **options: Any) -> Any:
        state = read(*words, **options)
        path.unlink()
        path.symlink_to(outside / "shadow")
        return state

    monkeypatch.setattr(OpenedKeystore, "enclave", opened)
    with pytest.raises(KeystoreError, match="is a link out of"):
        distribute(OpenedKeystore(keystore), ["/a"], tmp_path / "robot", now=NOW)


def test_a_ca_key_in_the_file_of_its_certificate_does_not_leave(
    keystore: Path, tmp_path: Path
) -> None:
    key = (keystore / "private/identity_ca.key.pem").read_bytes()
    distribute(OpenedKeystore(keystore), ["/a"], tmp_path / "robot", now=NOW)
    with (keystore / "public/identity_ca.cert.pem").open("ab") as file:
        file.write(key)
    with pytest.raises(KeystoreError, match="contains a private key"):
        distribute(OpenedKeystore(keystore), ["/a"], tmp_path / "other", now=NOW)
    assert not (tmp_path / "other").exists()
    request = create_request(tmp_path / "born", "/born").file.read_bytes()
    with pytest.raises(KeystoreError, match="contains a private key"):
        sign_request(keystore, request, now=NOW)
    robot = tmp_path / "robot"
    assert not verify_arrival(robot, now=NOW).findings
    with (robot / "enclaves/a/identity_ca.cert.pem").open("ab") as file:
        file.write(key)
    found = {each.kind.id for each in verify_arrival(robot, now=NOW).findings}
    assert "keystore.ca-key-on-robot" in found


@as_root
@pytest.mark.parametrize("dry_run", [False, True])
@pytest.mark.parametrize("verb", ["create_keystore", "create_request", "distribute"])
def test_no_key_is_left_to_the_owner_of_a_folder_that_waited_there(
    verb: str, dry_run: bool, keystore: Path, sticky: Path
) -> None:
    waiting = sticky / "waiting"
    waiting.mkdir()
    os.chown(waiting, STRANGER, STRANGER)
    with pytest.raises(KeystoreError, match=f"belongs to user {STRANGER}"):
        if verb == "create_keystore":
            template = load_template("development")
            create_keystore(waiting, template=template, now=NOW, dry_run=dry_run)
        elif verb == "create_request":
            create_requests(waiting, ["/a"], dry_run=dry_run)
        else:
            distribute(OpenedKeystore(keystore), ["/a"], waiting, now=NOW, dry_run=dry_run)
    assert not list(waiting.iterdir())
    sticky.chmod(0o755)  # only root can make a folder there, so it is meant for its owner
    distribute(OpenedKeystore(keystore), ["/a"], waiting, now=NOW)


@as_root
@pytest.mark.parametrize("below", ["", "/robot", "/a.tar.gz"])
def test_no_key_goes_where_the_link_of_another_user_leads(
    below: str, keystore: Path, sticky: Path, tmp_path: Path
) -> None:
    link, elsewhere = sticky / "link", tmp_path / "elsewhere"
    elsewhere.mkdir()
    link.symlink_to(elsewhere)
    os.chown(link, STRANGER, STRANGER, follow_symlinks=False)
    with pytest.raises(KeystoreError, match=f"is a link of another user.*user {STRANGER}, who"):
        distribute(OpenedKeystore(keystore), ["/a"], Path(f"{link}{below}"), now=NOW)
    assert not list(elsewhere.iterdir())
    os.chown(link, 0, 0, follow_symlinks=False)
    distribute(OpenedKeystore(keystore), ["/a"], Path(f"{link}{below}"), now=NOW)


@as_root
@pytest.mark.parametrize("owner", [STRANGER, 0])
def test_a_link_of_another_user_on_the_way_to_the_keystore_is_named(
    owner: int, keystore: Path, tmp_path: Path
) -> None:
    """Also if the keystore there belongs to the user of the link."""
    (shared := tmp_path / "shared").mkdir()
    (link := shared / "ks").symlink_to(keystore)
    os.chown(link, owner, owner, follow_symlinks=False)
    os.chown(keystore, owner, owner)
    refused = f"'{link}': it is a link of user {STRANGER}. Whoever" in sros("env", link, "/a").err
    assert refused is bool(owner)
    state = {"KEYSTORE": str(link), "ENABLE": "true", "ENCLAVE_OVERRIDE": "/a"}
    environment = {f"ROS_SECURITY_{name}": value for name, value in state.items()}
    process = Process(1, (), environment, NOW)
    root = os.open("/", os.O_PATH | os.O_DIRECTORY)
    try:
        enclave = with_files(process, ProcessRoot(root, FileReader()), "/").enclave
    finally:
        os.close(root)
    assert enclave
    assert (enclave.writable == f"'{link}': it is a link of another user") is bool(owner)
    found = json.loads(sros("check", link, "--json").out)["findings"]
    of_link = [(each["id"], each["remedy"]) for each in found if each["subject"] == str(link)]
    named = "keystore.replaceable", f"Run `sudo chown -h root {link}`."
    assert (named in of_link) is bool(owner)


# ── files that grow, wait, or have no end ──────────────────────────────────────────────────


def test_no_module_of_the_working_folder_is_run(tmp_path: Path) -> None:
    """A folder such as /tmp, where others can write, or one that was unpacked."""
    mark = tmp_path / "ran"
    for name in ("json", "ctypes"):
        text = f"import os\nos.close(os.open({str(mark)!r}, os.O_CREAT))\nraise SystemExit(9)\n"
        (tmp_path / f"{name}.py").write_text(text)
    env = {k: v for k, v in os.environ.items() if not k.startswith("ROS_")}
    env["PYTHONPATH"] = str(Path(sros_tool.__file__).parents[1])
    doctor = ("-m", "sros_tool", "doctor")
    program = tmp_path / "bin/sros"  # as pip writes it
    program.parent.mkdir()
    program.write_text("import sys\nfrom sros_tool.cli import main\nsys.exit(main())\n")
    run([sys.executable, program, "doctor"], cwd=tmp_path, env=env, status=None)
    assert not mark.exists()
    run([sys.executable, *doctor], cwd=tmp_path, env=env, status=None)
    assert mark.exists()


def test_the_name_of_a_file_becomes_no_command_in_a_remedy(keystore: Path) -> None:
    folder = keystore / "private" / "x'; touch owned; '"
    folder.mkdir()
    copied = folder / "$(touch owned).pem"
    shutil.copy(keystore / "private/identity_ca.key.pem", copied)
    copied.chmod(0o644)
    findings = verify_arrival(keystore, now=NOW, domain=None, zone=UTC).findings
    (remedy,) = {
        each.remedy
        for each in findings
        if each.file == str(copied) and each.kind.id == "keystore.key-readable"
    }
    command = remedy.removeprefix("Run `").partition("`. If others may")[0]
    assert shlex.split(command) == ["chmod", "600", str(copied)]
    odd = keystore.parent / "x; touch owned; '; touch owned; '"  # unquoted, or in quotes
    keystore.rename(odd)
    (odd / "enclaves/a").chmod(0o777)
    for name, damage in (("key.pem", b""), ("cert.pem", b"x"), ("governance.p7s", b"x")):
        (odd / "enclaves/a" / name).write_bytes(damage)
    (odd / "public/identity_ca.cert.pem").unlink()
    found_there = [
        *keystore_findings(OpenedKeystore(odd), Circumstances(NOW)),
        *verify_arrival(odd, now=NOW).findings,
    ]
    commands = [each for found in found_there for each in re.findall("`(.+?)`", found.remedy)]
    with_name = [shlex.split(each) for each in commands if "touch" in each]
    assert len({words[0] for words in with_name}) >= 2, commands
    assert [words for words in with_name if "touch" in words or "owned" in words] == []


def test_a_file_of_the_kernel_is_not_read(keystore: Path) -> None:
    """Some of them, such as /proc/kmsg, wait for their next line; all of them have no size."""
    assert Path("/proc/self/environ").read_bytes()
    assert read_bytes(Path("/proc/self/environ"), "file") == b""
    certificate = keystore / "enclaves/a/cert.pem"
    certificate.unlink()
    certificate.symlink_to("/proc/kmsg")
    found = {
        each.kind.id for each in keystore_findings(OpenedKeystore(keystore), Circumstances(NOW))
    }
    assert {"enclave.file-empty", "enclave.file-unreadable"} & found


def test_a_file_that_became_a_pipe_meanwhile_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "file")
    (tmp_path / "before").write_text("a regular file")
    monkeypatch.setattr(Path, "stat", lambda _self: os.stat(tmp_path / "before"))
    with pytest.raises(DocumentError, match="is not a regular file"):
        read_bytes(tmp_path / "file", "policy")


def test_a_folder_that_cannot_be_entered_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the file, whose mode may be right; root can enter every folder."""
    (folder := tmp_path / "enclaves").mkdir()
    file = folder / "governance.p7s"
    monkeypatch.setattr(os, "access", lambda path, _mode: path != folder)
    barred = f"The folder '{folder}' cannot be entered: Permission denied."
    assert why_unreadable(file, errno.EACCES) == barred
    assert why_unreadable(file, errno.EIO) == "Input/output error."
    monkeypatch.setattr(os, "access", lambda _path, _mode: True)
    assert why_unreadable(file, errno.EACCES) == "Permission denied."
