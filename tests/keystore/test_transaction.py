"""A transaction is whole or did not happen, at whatever step the process is stopped."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

import pytest

from sros_tool import folders
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.folders import Folder
from sros_tool.keystore import transaction as transactions
from sros_tool.keystore.delivery.export import distribute
from sros_tool.keystore.layout import (
    CRL,
    LOCK,
    REQUIRED_FILES,
    REVOKED,
    STAGE,
    enclave_folder,
    is_keystore,
)
from sros_tool.keystore.lifecycle import change
from sros_tool.keystore.lifecycle.create import (
    create_enclaves,
    create_keystore,
    create_permission,
    generate_artifacts,
)
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.keystore.transaction import Change, Changes, KeystoreLock, Transaction
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from tests.support.children import some_steps
from tests.support.harness import (
    check_whole,
    copy_of,
    policy_text,
    publish,
    remains,
    snapshot,
    topics_of,
)
from tests.support.long_form import some

NOW = datetime.now(UTC)
TEMPLATE = load_template("development")
DISCOVERY = "ros_discovery_info"

# Every way in which the keystore's code changes a file system, and waits for it.
PRIMITIVES = (
    "chmod",
    "fchmod",
    "fsync",
    "link",
    "mkdir",
    "open",
    "rename",
    "replace",
    "rmdir",
    "symlink",
    "unlink",
    "write",
)
DIED, REFUSED = 99, 98


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that dies takes nothing with it that the system was given."""
    monkeypatch.setattr(folders, "flush_file_system", lambda _: None)
    monkeypatch.setattr(os, "fsync", lambda _: None)


class Steps:
    """Counts the steps of a process, and does something else in place of one of them."""

    def __init__(self, at: int, instead: Callable[[str, tuple[Any, ...]], object]) -> None:
        self.count = 0
        self.staged = 0
        self._at = at
        self._instead = instead

    def install(self) -> None:
        for name in PRIMITIVES:
            setattr(os, name, self._counting(name, getattr(os, name)))
        folders.flush_file_system = self._counting("flush", folders.flush_file_system)
        folders.exchange = self._counting("exchange", folders.exchange)

    def _counting(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def primitive(*arguments: Any, **options: Any) -> Any:
            self.count += 1
            if name == "flush" and not self.staged:
                self.staged = self.count
            if self.count == self._at:
                self._instead(name, (real, *arguments))
            return real(*arguments, **options)

        return primitive


def die(name: str, call: tuple[Any, ...]) -> NoReturn:
    """Stop at once; of a file that is being written, half is there."""
    if name == "write":
        real, handle, data = call
        real(handle, bytes(data)[: len(data) // 2])
    os._exit(DIED)


def run_out_of_space(name: str, call: tuple[Any, ...]) -> None:
    if name == "open" and not call[2] & (os.O_WRONLY | os.O_RDWR):
        return  # nothing is written
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), name)


def in_child(
    verb: Callable[[], object],
    at: int = 0,
    instead: Callable[[str, tuple[Any, ...]], object] = die,
) -> tuple[int, Sequence[int]]:
    """Run a verb in a forked process; its exit status, and the steps that are worth a look.

    All from the end of the staging on are, and of those before it every third; see `some_steps`.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        steps = Steps(at, instead)
        status = 1
        try:
            write = os.write
            steps.install()
            try:
                verb()
                status = 0
            except (SrosError, OSError):
                status = REFUSED
            write(writer, f"{steps.staged} {steps.count}".encode())
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        said = pipe.read()
    _, status = os.waitpid(child, 0)
    staged, count = map(int, said.split() or (0, 0))
    steps_of_interest = [*range(1, staged, 3), *range(max(staged, 1), count + 1)]
    return os.waitstatus_to_exitcode(status), some_steps(steps_of_interest)


# ── scenarios ──────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Scenario:
    """A verb on a folder ``w`` with a keystore; the topics of its enclaves before and after."""

    verb: Callable[[Path], object]
    before: dict[str, str]
    after: dict[str, str]
    prepare: Callable[[Path], object] = lambda _: None
    keystore: str = "ks"


def policy(folder: Path) -> Policy:
    path = folder / "policy.xml"
    path.write_text(
        policy_text({name: publish(topic) for name, topic in NEW.items() if name != "/spare"})
    )
    return read_policy(path)


OLD = {"/a": "old_a", "/b": "old_b"}
NEW = {"/a": "new_a", "/b": "new_b", "/c/d": "new_d", "/a/inner": "new_e"}


def no_root(w: Path) -> None:
    shutil.rmtree(w / "ks")


def empty_root(w: Path) -> None:
    no_root(w)
    (w / "ks").mkdir()


def lost_permissions(w: Path) -> None:
    for name in ("permissions.p7s", "permissions.xml", "governance.p7s"):
        (w / "ks/enclaves/b" / name).unlink()


def links_elsewhere(w: Path) -> None:
    """Somebody keeps documents in a folder of his own, and links to them in two ways."""
    folder = w / "ks/enclaves/a"
    (w / "elsewhere").mkdir()
    (folder / "permissions.p7s").rename(w / "elsewhere/a.p7s")
    (folder / "permissions.p7s").symlink_to("../../../elsewhere/a.p7s")
    (folder / "permissions.xml").rename(w / "elsewhere/a.xml")
    (folder / "permissions.xml").symlink_to(w.with_name("prepared") / "elsewhere/a.xml")


def export(w: Path) -> None:
    distribute(OpenedKeystore(w / "ks"), ["/a"], w / "out", now=NOW)
    create_permission(w / "ks", ["/a"], policy(w), now=NOW)


SCENARIOS = {
    "generate_artifacts": Scenario(
        lambda w: generate_artifacts(w / "ks", policies=[policy(w)], now=NOW), OLD, NEW
    ),
    "create_permission": Scenario(
        lambda w: create_permission(w / "ks", ["/a"], policy(w), now=NOW),
        OLD,
        {**OLD, "/a": "new_a"},
    ),
    "create_enclave": Scenario(
        lambda w: create_enclaves(w / "ks", ["/c", "/c/d"], now=NOW),
        OLD,
        {**OLD, "/c": "*", "/c/d": "*"},
    ),
    "revoke": Scenario(lambda w: revoke(w / "ks", ["/b"], now=NOW), OLD, {"/a": "old_a"}),
    "completion": Scenario(
        lambda w: create_enclaves(w / "ks", ["/b"], now=NOW),
        {"/a": "old_a"},
        {"/a": "old_a", "/b": "*"},
        lost_permissions,
    ),
    "links": Scenario(
        lambda w: create_permission(w / "ks", ["/a"], policy(w), now=NOW),
        OLD,
        {**OLD, "/a": "new_a"},
        links_elsewhere,
    ),
    "create_keystore": Scenario(
        lambda w: create_keystore(w / "ks", template=TEMPLATE, now=NOW), {}, {}, no_root
    ),
    "create_keystore, parents missing": Scenario(
        lambda w: create_keystore(w / "x/y/ks", template=TEMPLATE, now=NOW),
        {},
        {},
        no_root,
        "x/y/ks",
    ),
    "create_keystore, empty root": Scenario(
        lambda w: create_keystore(w / "ks", template=TEMPLATE, now=NOW), {}, {}, empty_root
    ),
    "generate_artifacts, no root": Scenario(
        lambda w: generate_artifacts(w / "ks", policies=[policy(w)], now=NOW, create=TEMPLATE),
        {},
        NEW,
        no_root,
    ),
    "generate_artifacts, empty root": Scenario(
        lambda w: generate_artifacts(w / "ks", policies=[policy(w)], now=NOW, create=TEMPLATE),
        {},
        NEW,
        empty_root,
    ),
    "distribute_key": Scenario(
        lambda w: distribute(OpenedKeystore(w / "ks"), ["/a"], w / "out", now=NOW, force=True),
        {"/a": "old_a"},
        {"/a": "new_a"},
        export,
        "out",
    ),
}


def seen(keystore: Path) -> dict[str, str]:
    """The enclaves whose files are all there, with the one topic that tells their policy."""
    found = {}
    for name in ("/a", "/a/inner", "/b", "/c", "/c/d"):
        folder = keystore / enclave_folder(name)
        if all((folder / file).exists() for file in REQUIRED_FILES):
            topics = topics_of(folder) - {DISCOVERY}
            found[name] = "*" if "rt/*" in topics else ",".join(sorted(topics)).removeprefix("rt/")
    return found


def dangling(keystore: Path) -> list[Path]:
    """Links that lead nowhere, beside those in a stage and in folders that were moved away."""
    return [
        Path(parent, name)
        for parent, folders, files in os.walk(keystore)
        for name in (*folders, *files)
        if STAGE not in parent and REVOKED not in parent and not Path(parent, name).exists()
    ]


def check_moment(scenario: Scenario, w: Path, prepared: Path) -> None:
    """What must hold at any moment: every enclave is as before or as after, and so are all."""
    keystore = w / scenario.keystore
    gone = scenario.before.keys() - scenario.after
    for path in dangling(keystore):
        if path.name == "crl.pem" and not (keystore / CRL).exists():
            continue  # the link is there before the first revocation list
        # Any other one is of a path that was not there before, or is removed.
        assert STAGE in os.readlink(path), path
        removed = {keystore / enclave_folder(name) / "cert.pem" for name in gone}
        assert path in removed or not (prepared / path.relative_to(w)).exists(), path
    folders = [keystore / enclave_folder(name) for name in scenario.before.keys() - gone]
    if scenario.keystore != "out":
        check_whole(keystore)
    assert all((folder / "key.pem").exists() for folder in folders)
    visible = seen(keystore)
    existing = {name: topic for name, topic in visible.items() if name in scenario.before}
    wanted = {name: scenario.after[name] for name in scenario.before if name not in gone}
    assert existing in (scenario.before, wanted), existing
    new = {name: topic for name, topic in visible.items() if name not in scenario.before}
    assert new.items() <= scenario.after.items(), new
    if new:
        assert existing == wanted, "new enclaves appeared before the existing ones changed"


def check_done(scenario: Scenario, w: Path) -> None:
    """What must hold after the verb was run to its end."""
    assert not remains(w), remains(w)
    keystore = w / scenario.keystore
    assert is_keystore(keystore)
    assert seen(keystore) == scenario.after
    assert not dangling(keystore)
    if scenario.keystore != "out":
        check_whole(keystore)


def again(scenario: Scenario, w: Path) -> None:
    """Run the verb again, which may find that it is done already."""
    try:
        scenario.verb(w)
    except KeystoreError as error:
        done = "already exists" if not scenario.before else "was revoked at"
        assert done in str(error), error


class Stage:
    """Makes the folder of a scenario afresh, as often as it is needed."""

    def __init__(self, scenario: Scenario, made_keystore: Path, folder: Path) -> None:
        self.prepared = folder / "prepared"
        self.prepared.mkdir()
        copy_of(made_keystore, self.prepared / "ks")
        policy(self.prepared)
        scenario.prepare(self.prepared)
        self._work = folder / "work"

    def fresh(self) -> Path:
        if self._work.exists():
            shutil.rmtree(self._work)
        return copy_of(self.prepared, self._work)


@pytest.fixture
def stage(name: str, made_keystore: Path, tmp_path: Path) -> Stage:
    stage = Stage(SCENARIOS[name], made_keystore, tmp_path)
    SCENARIOS[name].verb(stage.fresh())  # reads what is cached, so that all runs take equal steps
    return stage


WHOLE = ("generate_artifacts", "create_keystore")
"""A keystore that changes, and one that appears."""


@pytest.mark.parametrize(
    "name", [*WHOLE, *some([name for name in SCENARIOS if name not in WHOLE], 1)]
)
def test_death_at_every_step(name: str, stage: Stage) -> None:
    scenario = SCENARIOS[name]
    w = stage.fresh()
    status, steps = in_child(lambda: scenario.verb(w))
    assert status == 0
    check_done(scenario, w)
    assert steps[-1] > 12
    outcomes = set()
    for step in steps:
        w = stage.fresh()
        assert in_child(lambda w=w: scenario.verb(w), step) == (DIED, []), step  # type: ignore[misc]
        check_moment(scenario, w, stage.prepared)
        outcomes.add(str(seen(w / scenario.keystore)))
        again(scenario, w)
        check_done(scenario, w)
    assert len(outcomes) > (scenario.before != scenario.after)


@pytest.mark.parametrize(
    "name", some(["generate_artifacts", "generate_artifacts, empty root", "revoke"], 1)
)
def test_death_while_recovering_from_death(name: str, stage: Stage) -> None:
    scenario = SCENARIOS[name]
    _, steps = in_child(lambda: scenario.verb(stage.fresh()))
    for first in steps[-60::17]:
        w = stage.fresh()
        in_child(lambda w=w: scenario.verb(w), first)  # type: ignore[misc]
        stopped = w.with_name("stopped")
        w.rename(stopped)
        for second in range(1, 36, 3):
            copy_of(stopped, w)
            in_child(lambda w=w: again(scenario, w), second)  # type: ignore[misc]
            check_moment(scenario, w, stage.prepared)
            again(scenario, w)
            check_done(scenario, w)
            shutil.rmtree(w)
        shutil.rmtree(stopped)


@pytest.mark.parametrize("name", some([*SCENARIOS], 1))
def test_no_space_at_every_step(name: str, stage: Stage) -> None:
    """An error leaves everything as it was, byte by byte; or else the verb succeeds."""
    scenario = SCENARIOS[name]
    before = snapshot(stage.prepared)
    w = stage.fresh()
    _, steps = in_child(lambda: scenario.verb(w))
    refused = 0
    for number, step in enumerate((*steps, *range(1, 60))):
        if number >= len(steps) and refused > 3:
            break  # the drawn steps were enough
        w = stage.fresh()
        status, _ = in_child(lambda w=w: scenario.verb(w), step, run_out_of_space)  # type: ignore[misc]
        assert status in (0, REFUSED), step
        if status == 0:
            check_done(scenario, w)
        else:
            refused += 1
            assert snapshot(w) == before, step
    assert refused > 3


def cannot_exchange(monkeypatch: pytest.MonkeyPatch, *, hard_links: bool) -> list[str]:
    """Make the file system one without an exchange of names; what was asked of it instead."""
    asked: list[str] = []

    def refuse(source: object, *_: object, **__: object) -> None:
        asked.append(str(source))
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(folders, "exchange", lambda *_: False)
    if not hard_links:
        monkeypatch.setattr(os, "link", refuse)
    return asked


@pytest.mark.parametrize(
    ("name", "hard_links"),
    some(
        [(n, link) for n in ("create_permission", "completion", "links") for link in (True, False)],
        1,
    ),
)
def test_death_without_exchange(
    name: str, hard_links: bool, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    cannot_exchange(monkeypatch, hard_links=hard_links)
    test_death_at_every_step(name, stage)


# ── several at once ────────────────────────────────────────────────────────────────────────


def fork(verb: Callable[[], object]) -> int:
    child = os.fork()
    if child:
        return child
    try:
        verb()
        os._exit(0)
    except SrosError:
        os._exit(REFUSED)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(1)


def join(children: list[int]) -> list[int]:
    return [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]


def test_concurrent_additions_all_count(keystore: Path) -> None:
    names = [f"/n{index}" for index in range(6)]
    add = [lambda name=name: create_enclaves(keystore, [name], now=NOW) for name in names]
    assert join([fork(each) for each in add]) == [0] * 6
    check_whole(keystore)
    assert not remains(keystore.parent)
    assert all((keystore / enclave_folder(name) / "permissions.p7s").is_file() for name in names)


@pytest.mark.parametrize("root", some(["missing", "empty", "deep/er"], 1))
def test_only_one_of_many_makes_the_keystore(root: str, tmp_path: Path) -> None:
    """generate_artifacts, too, makes no second CA in a keystore that another one just made."""
    target = tmp_path / root
    if root == "empty":
        target.mkdir()
    verbs = [
        lambda: create_keystore(target, template=TEMPLATE, now=NOW),
        lambda: generate_artifacts(target, enclaves=["/a"], now=NOW, create=TEMPLATE),
    ]
    barrier, go = os.pipe()

    def wait_and(verb: Callable[[], object]) -> None:
        os.close(go)
        os.read(barrier, 1)
        verb()

    children = [fork(lambda verb=verbs[i % 2]: wait_and(verb)) for i in range(8)]  # type: ignore[misc]
    os.close(go)
    os.close(barrier)
    statuses = join(children)
    assert set(statuses) <= {0, REFUSED}
    assert statuses[::2].count(0) <= 1
    assert 0 in statuses
    check_whole(target)
    assert not remains(tmp_path)


@pytest.mark.parametrize("verb", ["create_keystore", "generate_artifacts"])
def test_no_second_ca_where_another_process_was_faster(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In an empty folder that exists, the keystore of the other one is not written over."""
    root = tmp_path / "ks"
    root.mkdir()
    after: dict[str, tuple[int, bytes]] = {}

    def be_slow(*arguments: Any, **options: Any) -> Transaction:
        monkeypatch.setattr(change, "Transaction", Transaction)
        create_keystore(root, template=TEMPLATE, now=NOW)
        after.update(snapshot(tmp_path))
        return Transaction(*arguments, **options)

    monkeypatch.setattr(change, "Transaction", be_slow)
    with pytest.raises(KeystoreError, match="already exists"):
        if verb == "create_keystore":
            create_keystore(root, template=TEMPLATE, now=NOW)
        else:
            generate_artifacts(root, enclaves=["/a"], now=NOW, create=TEMPLATE)
    assert after
    assert snapshot(tmp_path) == after


def test_a_transaction_waits_for_another(keystore: Path) -> None:
    ready, go = os.pipe()  # forked before, for a fork would share the lock

    def follow() -> None:
        os.read(ready, 1)
        create_enclaves(keystore, ["/late"], now=NOW)

    child = fork(follow)
    with Transaction(keystore) as held:
        held.write("enclaves/x.pem", b"x")
        os.write(go, b".")
        time.sleep(0.1)
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
        held.commit()
    assert join([child]) == [0]
    assert (keystore / "enclaves/x.pem").read_bytes() == b"x"
    assert (keystore / "enclaves/late/key.pem").exists()


def test_a_busy_keystore_is_told(keystore: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transactions, "_LOCK_SECONDS", 0.05)
    with Transaction(keystore):
        before = snapshot(keystore)
        with pytest.raises(KeystoreError, match="is busy"), Transaction(keystore):
            pass
        assert snapshot(keystore) == before
    assert not remains(keystore)


def test_a_lock_file_that_was_removed_before_it_was_locked_is_no_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process that held the lock removes the file, and a third process makes another one."""
    lock, file = folders.try_lock, tmp_path / LOCK
    removed: list[Path] = []

    def lose_the_first(handle: int) -> bool:
        if not removed:
            removed.append(file)
            file.unlink()
        return lock(handle)

    monkeypatch.setattr(transactions, "try_lock", lose_the_first)
    with Folder(tmp_path) as folder:
        held = KeystoreLock(folder).acquire()
        assert (removed, file.exists()) == ([file], True)
        held.release()


def test_stale_stages_beside_a_keystore_are_removed_and_those_in_use_are_not(
    tmp_path: Path,
) -> None:
    stale, other = tmp_path / ".k[s]*.sros-12345678", tmp_path / ".ks.sros-12345678"
    for folder in (stale, other):
        (folder / "private").mkdir(parents=True)
        (folder / "private/ca.key.pem").write_text("secret")
    used = tmp_path / ".k[s]*.sros-87654321"
    used.mkdir()
    with Folder(used) as in_use:
        assert folders.try_lock(in_use.handle(""))
        create_keystore(tmp_path / "k[s]*", template=TEMPLATE, now=NOW)
    assert not stale.exists()
    assert used.exists()
    assert other.exists(), "the name of a keystore is not a pattern"


def test_a_stage_that_was_removed_before_it_was_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = folders.try_lock
    removed: list[Path] = []

    def lose_the_first(handle: int) -> bool:
        if not removed:
            removed.append(Path(os.readlink(f"/proc/self/fd/{handle}")))
            removed[0].rmdir()
        return lock(handle)

    monkeypatch.setattr(folders, "try_lock", lose_the_first)
    create_keystore(tmp_path / "ks", template=TEMPLATE, now=NOW)
    assert removed
    check_whole(tmp_path / "ks")
    assert not remains(tmp_path)


# ── what is written ────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_keys_are_private_from_the_first_byte(
    umask: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "ks"
    modes: dict[str, int] = {}
    write = os.write

    def note_mode(handle: int, data: bytes) -> int:
        if b"PRIVATE KEY" in bytes(data):
            path = os.readlink(f"/proc/self/fd/{handle}")
            modes[path] = os.fstat(handle).st_mode & 0o777
            folders = Path(path).relative_to(tmp_path).parents
            assert any((tmp_path / each).stat().st_mode & 0o077 == 0 for each in folders)
        return write(handle, data)

    before = os.umask(umask)
    try:
        monkeypatch.setattr(os, "write", note_mode)
        create_keystore(root, template=TEMPLATE, now=NOW)
        create_enclaves(root, ["/a", "/b/c"], now=NOW)
    finally:
        os.umask(before)
    assert len(modes) == 4
    assert set(modes.values()) == {0o600}
    for folder in (root / "private", root / "enclaves", root / "enclaves/a", root / "enclaves/b"):
        assert folder.stat().st_mode & 0o777 == 0o700
    assert root.stat().st_mode & 0o777 == 0o755
    check_whole(root)


def test_an_error_after_staging_leaves_nothing(keystore: Path) -> None:
    before = snapshot(keystore.parent)
    with pytest.raises(RuntimeError), Transaction(keystore) as changing:
        changing.write("enclaves/a/key.pem", b"new", private=True)
        changing.write("enclaves/new/key.pem", b"new", private=True)
        raise RuntimeError
    assert snapshot(keystore.parent) == before


def test_a_dry_run_tells_the_changes_and_makes_none(keystore: Path) -> None:
    before = snapshot(keystore.parent)
    with Transaction(keystore, dry_run=True) as changing:
        changing.write("enclaves/a/key.pem", b"new", private=True)
        changing.write("enclaves/new/key.pem", b"new", private=True)
        changing.commit()
    assert [(change.action, change.path) for change in changing.changes] == [
        ("replace", "enclaves/a/key.pem"),
        ("create", "enclaves/new/key.pem"),
    ]
    assert snapshot(keystore.parent) == before


def test_nothing_is_written_through_a_link(keystore: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (keystore / "enclaves/link").symlink_to(outside)
    with pytest.raises(KeystoreError, match="symbolic link"):
        create_enclaves(keystore, ["/link", "/link/below"], now=NOW)
    assert not list(outside.iterdir())
    assert not remains(keystore)


def test_an_interrupted_transaction_of_a_stranger_writes_nowhere_else(
    keystore: Path, tmp_path: Path
) -> None:
    """A keystore may come from an archive, with a stage and links that somebody made up."""
    outside = tmp_path / "outside"
    (keystore / "enclaves").rename(outside)
    (keystore / "enclaves").symlink_to(outside)
    made_up_stage(keystore, "after", [])
    staged = keystore / STAGE / "added/enclaves"
    staged.mkdir()
    (staged / "cert.pem").write_text("mine")
    before = snapshot(tmp_path)
    with pytest.raises(KeystoreError, match="symbolic link"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert snapshot(tmp_path) == before
    (keystore / "enclaves").unlink()
    outside.rename(keystore / "enclaves")
    create_enclaves(keystore, ["/new"], now=NOW)
    assert (keystore / "enclaves/cert.pem").exists(), "it is completed where it may be"


@pytest.mark.parametrize(
    "path",
    [
        "../outside.pem",
        "/etc/outside.pem",
        "enclaves/../../x.pem",
        "enclaves//a.pem",
        "enclaves/authorized_keys",
        ".ssh/a.pem",
        f"{STAGE}/x.pem",
        "",
    ],
)
@pytest.mark.parametrize("live", ["before", "after"])
def test_a_list_of_files_that_a_stranger_made_up_moves_nothing(
    path: str, live: str, keystore: Path
) -> None:
    made_up_stage(keystore, live, [[path, "", ""]])
    (keystore / STAGE / live / transactions.staged_name(path)).write_text("mine")
    before = snapshot(keystore.parent)
    with pytest.raises(KeystoreError, match=r"not a file of a keystore.*restore"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert snapshot(keystore.parent) == before


@pytest.mark.parametrize(
    ("path", "target", "to", "why"),
    [
        ("enclaves/a/cert.pem", None, "enclaves/b", "would move to"),
        ("enclaves/a/cert.pem", None, "revoked/../private", "would move to"),
        ("enclaves/a/key.pem", None, "revoked/1a", "would move to"),
        ("private/cert.pem", None, "revoked/1a", "would move to"),
        ("enclaves/a/cert.pem", "../../../outside.pem", "", "lead out of the keystore"),
        ("enclaves/a/cert.pem", "/etc/outside.pem", "", "lead out of the keystore"),
    ],
)
def test_a_list_of_files_moves_no_folder_elsewhere_and_makes_no_link_that_leads_out(
    path: str, target: str | None, to: str, why: str, keystore: Path
) -> None:
    made_up_stage(keystore, "after", [[path, "", target, to]])
    before = snapshot(keystore)
    with pytest.raises(KeystoreError, match=rf"{why}.*restore"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert snapshot(keystore) == before


def test_a_list_of_files_leads_through_no_link(keystore: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    (keystore / "enclaves/a").rename(outside)
    (keystore / "enclaves/a").symlink_to(outside)
    made_up_stage(keystore, "after", [["enclaves/a/new.pem", None, ""]])
    number = transactions.staged_name("enclaves/a/new.pem")
    (keystore / STAGE / "after" / number).write_text("mine")
    before = snapshot(tmp_path)
    with pytest.raises(KeystoreError, match="symbolic link"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"version": 4, "moves": []}', '{"version": 3}'])
def test_a_list_of_files_that_cannot_be_read_is_told(text: str, keystore: Path) -> None:
    made_up_stage(keystore, "after", [])
    (keystore / STAGE / transactions.MANIFEST).write_text(text)
    before = snapshot(keystore)
    with pytest.raises(KeystoreError, match="can be neither completed nor undone"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert snapshot(keystore) == before


@pytest.mark.parametrize("mode", [0o710, 0o701])
def test_a_stage_that_others_can_open_is_refused(mode: int, keystore: Path) -> None:
    made_up_stage(keystore, "after", [])
    (keystore / STAGE).chmod(mode)
    before = snapshot(keystore)
    with pytest.raises(KeystoreError, match=r"not an interrupted change of yours.*may open it"):
        create_enclaves(keystore, ["/new"], now=NOW)
    assert snapshot(keystore) == before


def made_up_stage(keystore: Path, live: str, moves: list[list[str | None]]) -> None:
    for name in ("before", "after", "added"):
        (keystore / STAGE / name).mkdir(parents=True)
    (keystore / STAGE).chmod(0o700)
    (keystore / STAGE / "live").symlink_to(live)
    text = json.dumps({"version": 2, "moves": moves})
    (keystore / STAGE / transactions.MANIFEST).write_text(text)


@pytest.mark.parametrize(
    ("live", "folder"),
    [("new", "new"), ("old", "old"), ("new", None), ("/etc", None), (None, "new"), (None, "x")],
)
def test_a_stage_of_an_unknown_format_is_refused_and_not_touched(
    live: str | None, folder: str | None, keystore: Path
) -> None:
    stage = keystore / STAGE
    stage.mkdir(mode=0o700)
    if folder:
        (stage / folder / "enclaves/a").mkdir(parents=True)
        (stage / folder / "enclaves/a/cert.pem").write_bytes(b"another")
    if live:
        (stage / "live").symlink_to(live)
    before = snapshot(keystore)
    for verb in (
        lambda: create_enclaves(keystore, ["/new"], now=NOW),
        lambda: transactions.recover_keystore(keystore),
    ):
        with pytest.raises(KeystoreError, match=r"this version of sros.*version of sros that"):
            verb()
        assert snapshot(keystore) == before


def test_a_keystore_is_not_made_at_a_path_that_ends_in_the_parent(tmp_path: Path) -> None:
    with pytest.raises(KeystoreError, match=r"ends in '\.\.'"):
        create_keystore(tmp_path / "missing/..", template=TEMPLATE, now=NOW)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_a_link_is_replaced_and_not_followed(keystore: Path, tmp_path: Path) -> None:
    outside = tmp_path / "elsewhere.p7s"
    (keystore / "enclaves/a/permissions.p7s").rename(outside)
    (keystore / "enclaves/a/permissions.p7s").symlink_to(outside)
    before = outside.read_bytes()
    create_permission(keystore, ["/a"], policy(tmp_path), now=NOW)
    assert outside.read_bytes() == before
    assert seen(keystore)["/a"] == "new_a"
    check_whole(keystore)


@pytest.mark.parametrize("verb", ["create_keystore", "create_permission", "without hard links"])
def test_content_is_on_the_disk_before_its_name(
    verb: str, keystore: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power failure may lose what was not flushed, also where a kill does not."""
    calls: list[str] = []

    def note(module: object, name: str) -> None:
        real = getattr(module, name)

        def noting(*arguments: Any, **options: Any) -> Any:
            first = arguments[0]  # a name, or the descriptor of a folder
            where = os.readlink(f"/proc/self/fd/{first}") if isinstance(first, int) else first
            calls.append(f"{name} {where}")
            return real(*arguments, **options)

        monkeypatch.setattr(module, name, noting)

    if verb == "without hard links":
        cannot_exchange(monkeypatch, hard_links=False)
    note(folders, "flush_file_system")
    note(folders, "exchange")
    for name in ("rename", "replace"):
        note(os, name)
    if verb == "create_keystore":
        create_keystore(tmp_path / "new", template=TEMPLATE, now=NOW)
    else:
        create_permission(keystore, ["/a"], policy(tmp_path), now=NOW)
    moved = [call.split()[0] for call in calls]
    assert moved[0] == "flush_file_system"
    assert ("rename" if verb == "create_keystore" else "replace") in moved
    if verb == "without hard links":
        copies = calls.index(f"flush_file_system {keystore / STAGE / 'before'}")
        link = "replace spare"
        assert not [call for call in calls[:copies] if call.startswith(link)]
        assert [call for call in calls[copies:] if call.startswith(link)]


def test_changes_are_those_that_were_added() -> None:
    """Those in a row are kept together, also across what forked workers did."""
    paths = ["sros.toml", "ledger.jsonl", "enclaves/a/key.pem", "enclaves/a/cert.pem"]
    paths += ["enclaves/b/key.pem", "enclaves/b/cert.pem", "enclaves/a/crl.pem"]
    changes, other = Changes(), Changes()
    assert changes == ()
    for path in paths[:4]:
        changes.add("create", path)
    mark = changes.mark()
    changes.add("create", "enclaves/a/permissions.xml")
    assert [run.names for run in changes.added_since(mark)] == [("permissions.xml",)]
    for path in paths[4:]:
        other.add("replace", path)
    changes.extend(other.added_since(0))
    expected = [Change("create", path) for path in (*paths[:4], "enclaves/a/permissions.xml")]
    expected += [Change("replace", path) for path in paths[4:]]
    assert changes == expected
    assert [changes[index] for index in range(-len(expected), 0)] == expected
    assert (changes[1:3], len(changes)) == (tuple(expected[1:3]), len(expected))
    with pytest.raises(IndexError):
        changes[len(expected)]
