"""The folder of a robot's enclaves: changed wholly or not at all, and hostile until then."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path
from subprocess import PIPE
from typing import Any, TypeAlias

import pytest

from ansible_collections.sros.fleet.plugins.module_utils import places
from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.module_utils.places import Place
from sros_tool.runtime.processes import boot_id

OLD = {"enclaves/a/cert.pem": b"old", "enclaves/a/key.pem": b"key"}
NEW = {"enclaves/a/cert.pem": b"new", "enclaves/b/c/cert.pem": b"other"}

Play: TypeAlias = Callable[[dict[str, bytes], set[str]], dict[str, Any]]


@pytest.fixture
def place(tmp_path: Path) -> Place:
    """A folder that has the files OLD, in /dev/shm or /tmp, where others may make files."""
    made = Place(str(tmp_path / "etc/keystore"))
    install(made, OLD)
    return made


def install(place: Place, files: dict[str, bytes]) -> None:
    with place.locked():
        place.prepare(files)
        place.replace()
        place.discard()


def beside(place: Place) -> set[str]:
    return set(os.listdir(Path(place.path).parent)) - {"keystore", ".keystore.sros-lock"}


def test_the_files_of_a_folder_are_replaced(place: Place) -> None:
    assert place.read() == OLD
    assert place.is_closed()
    key = Path(place.path, "enclaves/a/key.pem")
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    key.chmod(0o644)
    assert not place.is_closed()
    install(place, NEW)
    assert place.read() == NEW
    assert place.is_closed()
    assert not beside(place)


def test_the_folder_of_an_agent_stays(place: Place) -> None:
    agent = Path(place.path, ".agent/metadata")
    agent.mkdir(parents=True)
    (agent / "root.json").write_text("trusted")
    assert place.read() == OLD and place.is_closed()
    install(place, NEW)
    assert place.read() == NEW and place.is_closed()
    assert (agent / "root.json").read_text() == "trusted"
    (Path(place.path) / "enclaves/.agent").mkdir()
    with pytest.raises(RefusedError, match="not a file of an enclave"):
        place.read()


def test_what_somebody_else_put_there_gives_way(place: Place) -> None:
    """Where a file or folder belongs, something else can have appeared since it was read."""
    top = Path(place.path, "enclaves")
    (top / "a/cert.pem").unlink()
    (top / "a/cert.pem").mkdir()
    (top / "a/key.pem").unlink()
    (top / "a/key.pem").symlink_to("/etc/hostname")
    (top / "b").symlink_to("/etc")
    install(place, {**NEW, "enclaves/a/key.pem": b"new key"})
    assert place.read() == {**NEW, "enclaves/a/key.pem": b"new key"}
    assert place.is_closed()
    assert not beside(place)


def test_what_appears_during_a_change_gives_way(place: Place) -> None:
    """After what is too much was removed; the change is ended by whoever comes next."""
    place.prepare(NEW)
    os.rename(place.stage, place._beside("apply"))
    top = Path(place.path, "enclaves")
    (top / "a/cert.pem").unlink()
    (top / "a/cert.pem").mkdir()
    (top / "b").symlink_to("/etc")
    with place.locked():
        assert place.read() == {**NEW, "enclaves/a/key.pem": b"key"}
    assert not beside(place)


class Killed(BaseException):
    pass


def test_killed_at_any_step_it_becomes_old_or_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And whoever comes next finds it whole, with nothing next to it."""
    rename, remove = os.rename, shutil.rmtree
    seen = set()
    for number in range(12):
        place = Place(str(tmp_path / str(number) / "keystore"))
        install(place, {**OLD, "enclaves/left/cert.pem": b"left"})
        left = number

        def step() -> None:
            nonlocal left
            if left == 0:
                raise Killed
            left -= 1

        def renamed(old: str, new: str, **folders: int | None) -> None:
            step()
            rename(old, new, **folders)

        def removed(path: str) -> None:
            step()
            remove(path)

        with monkeypatch.context() as patch:
            patch.setattr(os, "rename", renamed)
            patch.setattr(shutil, "rmtree", removed)
            try:
                with place.locked():
                    place.prepare(NEW)
                    place.replace()
            except Killed:
                seen.add("killed")
            else:
                seen.add("ended")
            decided = place.is_pending()
        with place.locked():
            present = place.read()
        assert not beside(place)
        assert not place.is_pending()
        seen.add("new" if present == NEW else "old")
        assert present == NEW or (set(present) == {*OLD, "enclaves/left/cert.pem"} and not decided)
    assert seen == {"killed", "ended", "old", "new"}


@pytest.mark.skipif(not shutil.which("unshare"), reason="unshare is needed")
def test_a_process_that_sees_one_enclave_goes_on_to_see_only_that(place: Place) -> None:
    """A systemd unit mounts the folder of its enclave over an empty one, as here."""
    before = {**OLD, "enclaves/b/cert.pem": b"other"}
    install(place, before)
    top = place.path + "/enclaves"
    view = (
        f"mkdir -p {top}.view && mount --bind {top}/a {top}.view && mount -t tmpfs none {top} &&"
        f" mkdir {top}/a && mount --bind {top}.view {top}/a && echo ready && read line &&"
        f" cd / && ls {top} && cat {top}/a/*"
    )
    user = [] if os.getuid() == 0 else ["--map-root-user"]
    command = ["unshare", *user, "--mount", "sh", "-c", view]
    with subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True) as unit:
        assert unit.stdin
        assert unit.stdout
        if unit.stdout.readline() != "ready\n":
            pytest.skip("mount namespaces are not allowed here")
        Path(place.path, "enclaves.view").rmdir()
        install(place, {**before, "enclaves/b/cert.pem": b"new", "enclaves/c/cert.pem": b"c"})
        seen, _ = unit.communicate("\n")
    assert seen == "a\noldkey"


def test_restarts_that_are_due_are_remembered(place: Place) -> None:
    assert place.due.read() == []
    place.set_due(["/b", "/a"])
    assert Place(place.path).due.read() == ["/a", "/b"]
    place.set_due([])
    assert place.due.read() == []
    place.delivered.write(["/a"])
    assert (place.due.read(), place.delivered.read()) == ([], ["/a"])
    place.delivered.write([])
    assert not beside(place)
    for bad in (b"", b"{", b"[1]", b'["a"]', b'["/a/../b"]', b"[" * 100_000):
        Path(place.path).with_name(".keystore.sros-restart").write_bytes(bad)
        with pytest.raises(RefusedError):
            place.due.read()


def test_what_is_no_enclave_is_refused(place: Place) -> None:
    """The folder may have another purpose, and it would be removed."""
    top = Path(place.path)
    for path in ("README", "private/identity_ca.key.pem", "enclaves/a/id_rsa", "enclaves/x y/a"):
        file = top / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("x")
        with pytest.raises(RefusedError, match="not a file of an enclave"):
            place.read()
        file.unlink()
        if file.parent not in (top, top / "enclaves/a"):
            file.parent.rmdir()
    (top / "enclaves/a/crl.pem").symlink_to("/etc/shadow")
    with pytest.raises(RefusedError, match="not a file of an enclave"):
        place.read()
    (top / "enclaves/a/crl.pem").unlink()
    (top / "enclaves/l").symlink_to("/etc")
    with pytest.raises(RefusedError, match="not a file of an enclave"):
        place.read()
    (top / "enclaves/l").unlink()
    os.mkfifo(top / "enclaves/a/crl.pem")
    with pytest.raises(RefusedError, match="not a file of an enclave"):
        place.read()


def test_a_way_that_others_can_change_is_refused(tmp_path: Path) -> None:
    real = tmp_path / "real"
    real.mkdir()
    (tmp_path / "link").symlink_to(real)
    Place(str(tmp_path / "link/keystore"))  # a link of one's own
    (real / "keystore").symlink_to(tmp_path)
    with pytest.raises(RefusedError, match="symbolic link"):
        Place(str(real / "keystore"))
    with pytest.raises(RefusedError, match="cannot be '/'"):
        Place("/")
    (tmp_path / "file").touch()
    with pytest.raises(RefusedError, match="not a folder"):
        Place(str(tmp_path / "file/keystore"))
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(RefusedError, match="too many links"):
        Place(str(tmp_path / "loop/keystore"))
    real.chmod(0o777)
    with pytest.raises(RefusedError, match="Others can write"):
        Place(str(real / "other"))
    real.chmod(0o755)
    if os.getuid() == 0:
        os.chown(real, 65534, 65534)
        with pytest.raises(RefusedError, match="belongs to another user"):
            Place(str(real / "other"))
        real.chmod(0o1777)
        with pytest.raises(RefusedError, match="belongs to another user"):
            Place(str(real / "other"))


def test_a_folder_to_which_others_can_add_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In /tmp somebody else could leave what looks like an interrupted change, or a parent."""
    shared = tmp_path / "shared"
    own = shared / "own"
    own.mkdir(parents=True)
    shared.chmod(0o1777)
    for path in ("keystore", "new/keystore"):
        with pytest.raises(RefusedError, match=r"Others can write to .*shared"):
            Place(str(shared / path))
    install(Place(str(own / "keystore")), OLD)  # nobody else can replace a folder of one's own

    place = Place(str(own / "new/keystore"))
    make = os.makedirs

    def make_open(path: str, *words: object, **options: object) -> None:
        make(path, exist_ok=True)
        os.chmod(path, 0o1777)

    monkeypatch.setattr(os, "makedirs", make_open)
    with pytest.raises(RefusedError, match=r"Others can write to .*new"), place.locked():
        pass


@pytest.mark.skipif(os.getuid() != 0, reason="only root reads the files of others")
def test_a_hard_link_to_a_file_of_somebody_else_is_not_read(tmp_path: Path) -> None:
    """Its copy would be given to the owner of the enclaves."""
    place = Place(str(tmp_path / "keystore"), "nobody")
    install(place, OLD)
    secret, link = tmp_path / "secret", Path(place.path, "enclaves/a/request.pem")
    secret.write_text("secret")
    secret.chmod(0o644)
    link.hardlink_to(secret)
    with pytest.raises(RefusedError, match=r"request.pem' may be a hard link"):
        place.read()
    secret.unlink()
    assert place.read()["enclaves/a/request.pem"] == b"secret", "all users could read it"
    link.chmod(0o600)
    with pytest.raises(RefusedError, match=r"request.pem' may be a hard link"):
        place.read()
    link.unlink()
    link.hardlink_to(Path(place.path, "enclaves/a/key.pem"))
    assert place.read()["enclaves/a/request.pem"] == b"key", "a link of its owner's own"
    link.parent.chmod(0o777)
    with pytest.raises(RefusedError, match="may be a hard link"):
        place.read()


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_the_owner_gets_the_files(tmp_path: Path) -> None:
    place = Place(str(tmp_path / "keystore"), "nobody")
    install(place, OLD)
    assert place.is_closed()
    assert {os.lstat(each).st_uid for each in Path(place.path).rglob("*")} == {65534}
    assert not Place(place.path).is_closed()
    with pytest.raises(RefusedError, match="no user"):
        Place(place.path, "no such user")


@pytest.fixture
def play(place: Place, monkeypatch: pytest.MonkeyPatch) -> Play:
    """Return a function that brings files; the second argument are enclaves with equal trust."""
    module = pytest.importorskip("ansible_collections.sros.fleet.plugins.modules.enclaves")
    verified = {"by": "openssl", "ok": True, "problems": [], "remarks": []}
    monkeypatch.setattr(module, "verify", lambda *_: verified)
    asked = {"robot": "r1", "verifier": ["sros"], "replace_authorities": False}

    def bring(files: dict[str, bytes], same: set[str]) -> dict[str, Any]:
        result: dict[str, Any] = module._install(place, place.read(), files, asked, 0.0, same=same)
        return result

    return bring


def test_processes_of_a_folder_that_was_lost_have_to_be_restarted(place: Place, play: Play) -> None:
    """They still have the files of before.  Twin: an enclave that is new has no processes."""

    def deliver(files: dict[str, bytes]) -> list[str]:
        due: list[str] = play(files, set())["restart"]
        place.set_due([])
        return due

    assert deliver(OLD) == []
    assert place.delivered.read() == ["/a"], "also where nothing changes"
    assert deliver(NEW) == ["/a"]
    shutil.rmtree(place.path)
    changed = {**NEW, "enclaves/b/c/cert.pem": b"changed", "enclaves/d/cert.pem": b"new"}
    assert deliver(changed) == ["/a", "/b/c"]


def test_processes_that_may_lack_the_revocation_list_are_remembered(
    place: Place, play: Play
) -> None:
    """Whoever lacks only its own new documents has the list; also another list that is equal."""

    def deliver(same: set[str], **changed: bytes) -> list[list[str]]:
        named = {f"enclaves/a/{name}": content for name, content in changed.items()}
        files = place.read() | {path.replace("_", "."): data for path, data in named.items()}
        said = play(files, same)["confirmation"]
        return [said["restart"], said["crl_restart"]]

    assert deliver(set(), crl_pem=b"list") == [["/a"], ["/a"]]
    assert deliver({"/a"}, permissions_p7s=b"1") == [["/a"], ["/a"]], "the process still lacks it"
    place.set_due([])
    assert deliver({"/a"}, permissions_p7s=b"2") == [["/a"], []]
    assert deliver({"/a"}, crl_pem=b"equal") == [["/a"], []]
    install(place, place.read() | {"enclaves/a/crl.pem": b"by an earlier version"})
    assert place.crl_due(place.read()) == ["/a"]
    assert deliver(set(), crl_pem=b"equal") == [["/a"], ["/a"]], "as it may have restarted before"
    place.set_due([])
    assert not [name for name in beside(place) if "trusting" in name]


def test_restarts_that_an_agent_noted_are_due(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may have brought files since the last play, and its processes are not restarted yet."""
    files, path = place.read(), Path(place.path, ".agent/state.json")
    assert place.agent_due(files) == []
    path.parent.mkdir()
    for state, due in (
        ({"due": ["/a", "/b"], "boot": boot_id()}, ["/a", "/b"]),
        ({"due": ["/a"], "boot": ""}, ["/a"]),
        ({"due": [], "boot": boot_id()}, []),
        ({"due": ["/b"], "boot": "of an earlier start"}, []),
        ({"due": ["b"], "boot": boot_id()}, ["/a"]),
        ([], ["/a"]),
    ):
        path.write_text(json.dumps(state))
        assert place.agent_due(files) == due, state
    module = pytest.importorskip("ansible_collections.sros.fleet.plugins.modules.enclaves")
    said = module._confirmation(place, {"robot": "r1"}, files, 0.0)
    assert said["restart"] == said["crl_restart"] == ["/a"]
    path.write_text(json.dumps({"due": ["/b"], "boot": "perhaps of an earlier start"}))
    monkeypatch.setattr(places, "_BOOT_ID", "/nowhere")
    assert place.agent_due(files) == ["/b"]
