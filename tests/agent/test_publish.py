"""What home publishes: who gets what, with which keys, and that it is whole at every moment."""

from __future__ import annotations

import errno
import gzip
import hashlib
import json
import os
import re
import shutil
import stat
import tarfile
from collections.abc import Callable
from contextlib import nullcontext, suppress
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from tuf.api.metadata import Metadata, Root

from sros_tool.agent.fetch import FetchError, FetchProblem
from sros_tool.cli.fleet import _published_lines
from sros_tool.errors import DocumentError, KeystoreError, SrosError
from sros_tool.folders import Folder
from sros_tool.keystore import transaction
from sros_tool.keystore.delivery import publish as publishing
from sros_tool.keystore.delivery import published
from sros_tool.keystore.delivery.archive import stated_size
from sros_tool.keystore.delivery.export import ReleasedEnclave
from sros_tool.keystore.delivery.export import released_enclave as evaluate
from sros_tool.keystore.delivery.publish import PublishedFleet, publish
from sros_tool.keystore.delivery.published import MetadataExpiry, PublishedRelease, read_published
from sros_tool.keystore.delivery.release import (
    Release,
    pack_release,
    read_release,
    seal_problem,
    seal_releases,
)
from sros_tool.keystore.delivery.repository import (
    MetadataComposer,
    Roots,
    load_signer,
    new_key,
    read_present,
)
from sros_tool.keystore.delivery.role_keys import RoleKeys
from sros_tool.keystore.delivery.signing import certify_requests, sign_request
from sros_tool.keystore.fleet_status import fleet_status
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.known_keys import KnownKeys, restored_at
from sros_tool.keystore.layout import CRL, FLEET, ca_key_path, fleet_key_path
from sros_tool.keystore.layout import ROLES as ROLES_OF_CAS
from sros_tool.keystore.ledger import LATER_RELEASE, PUBLISHING, Entry
from sros_tool.keystore.lifecycle.change import KeystoreChange
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revocation_list import LostRecords
from sros_tool.keystore.lifecycle.revoke import restore_revocations, revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import key_digest, load_request, validity_of
from sros_tool.pki.crl import load_crl
from sros_tool.validity import iso
from tests.agent.published import DAY, LATER, ROLES, Home, Thief
from tests.support.harness import copy_of, create_request, policy_text, snapshot, sros
from tests.support.harness import publish as allow_publish
from tests.support.long_form import few_steps


def archives(publisher: Home) -> dict[str, bytes]:
    """Return the archives in the publishing folder by the names of robots, the newest of each."""
    found = {}
    for path in sorted((publisher.pub / "targets/robots").iterdir(), key=os.path.getmtime):
        digest, robot = path.name.split(".")[:2]
        found[robot] = path.read_bytes()
        assert hashlib.sha256(found[robot]).hexdigest() == digest
    return found


def _number(path: Path) -> int:
    return read_release(path.read_bytes()).number


def numbers(publisher: Home) -> dict[str, int]:
    return {robot: read_release(data).number for robot, data in archives(publisher).items()}


# ── who gets what ──────────────────────────────────────────────────────────────────────────


def forget_publishing(root: Path) -> None:
    """Remove what a keystore has since it published first, except from its ledger."""
    for path in (*root.glob("fleet_root.json"), *root.glob("private/fleet_*")):
        path.unlink()
    (root / "published.json").unlink()


def test_only_what_changes_is_published_again(publisher: Home) -> None:
    before, old = archives(publisher), numbers(publisher)
    assert not publisher.publish().names("published")
    publisher.run("renew", "ks", "/r1/base")
    assert publisher.publish().names("published") == ["r1"]
    after, new = archives(publisher), numbers(publisher)
    assert {robot for robot in after if after[robot] != before[robot]} == {"r1"}
    assert new["r1"] > old["r1"]
    for file in (publisher.root / "enclaves/r2/base").iterdir():
        os.utime(file)  # another time, and the same content
    modes = set()
    for _ in range(2):
        assert not publisher.publish().names("published")
        assert archives(publisher) == after
        modes.add((publisher.root / "published.json").stat().st_mode)
    assert len(modes) == 1


def test_no_private_key_is_published(publisher: Home, strict_umask: None) -> None:
    """Everything else can be read by all users, as by the account of a web server."""
    shutil.rmtree(publisher.pub)
    made = publisher.folder / "new"
    now = publisher.now + LATER
    publish(publisher.root, made / "pub", now=now, rotate=("timestamp", "root"), new_folder=True)
    modes = {path.stat().st_mode & 0o777 for path in (made, *made.rglob("*"))}
    assert modes == {0o755, 0o644}
    (made / "pub").rename(publisher.pub)
    secrets = [path.read_bytes() for path in publisher.root.rglob("*.pem") if "key" in path.name]
    secrets += [path.read_bytes() for path in (publisher.root / "private").glob("fleet_*")]
    assert len(secrets) == 9
    bodies = [b"".join(secret.split(b"\n")[1:-2]) for secret in secrets]
    for path in publisher.pub.rglob("*.json"):
        assert b"PRIVATE" not in path.read_bytes()
    for data in archives(publisher).values():
        for content in read_release(data).files.values():
            assert b"PRIVATE" not in content
            assert not any(body in content.replace(b"\n", b"") for body in bodies)
    for path in (publisher.root / "private").iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_revoked_robots_lose_their_release_and_others_learn_of_it(publisher: Home) -> None:
    robot, other = publisher.robot("r1"), publisher.robot("r2")
    robot.gets()
    assert "/r2/base" in other.gets().enclaves()
    publisher.run("revoke", "ks", "--robot", "r1")
    result = publisher.publish()
    assert (result.names("removed"), result.names("published")) == (["r1"], ["r2", "r5"])
    said = "\n".join(_published_lines(result, publisher.now))
    kept = list(publisher.pub.glob("targets/robots/*.r1.tar.gz"))
    assert kept and ": r1 (their files are removed after two days)" in said
    robot.refuses(FetchProblem.NOT_FOR_ROBOT)
    release = other.gets()
    assert release.enclaves()["/r2/base"]["crl.pem"]
    (publisher.folder / "fleet.toml").write_text("[robots.r5]\n")
    publisher.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    assert publisher.publish().names("removed") == ["r2"]
    other.refuses(FetchProblem.NOT_FOR_ROBOT)
    publisher.robot("r5").gets()


def test_one_bad_enclave_keeps_no_other_robot_from_a_revocation(publisher: Home) -> None:
    bad = publisher.root / "enclaves/r1/base/permissions.p7s"
    kept = bad.read_bytes()
    publisher.run("revoke", "ks", "--robot", "r5")
    bad.write_bytes(b"x")
    before = publisher.robot("r1").gets()
    result = publisher.publish()
    assert (result.names("refused"), result.names("published")) == (["r1"], ["r2"])
    assert publisher.robot("r1").gets() == before
    assert publisher.robot("r2").gets().enclaves()["/r2/base"]["crl.pem"]
    bad.write_bytes(kept)
    assert publisher.publish().names("published") == ["r1"]


def test_an_expired_enclave_still_gets_the_revocation_list(publisher: Home) -> None:
    publisher.run("revoke", "ks", "--robot", "r5")
    result = publisher.publish(after=200 * DAY)
    assert result.names("published") == ["r1", "r2"]
    assert {note.id for note in result.notes} >= {"fleet.release-not-valid"}
    robot = publisher.robot(pinned_at=publisher.now - 200 * DAY)
    assert robot.gets().enclaves()["/r1/base"]["crl.pem"]


def evaluations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list that gets the name of each enclave that is evaluated from now on."""
    evaluated: list[str] = []

    def released_enclave(keystore: OpenedKeystore, name: str, now: datetime) -> ReleasedEnclave:
        evaluated.append(name)
        return evaluate(keystore, name, now)

    monkeypatch.setattr(publishing, "released_enclave", released_enclave)
    return evaluated


def test_a_revocation_evaluates_one_enclave_of_those_that_stay(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluated = evaluations(monkeypatch)
    publisher.run("revoke", "ks", "--robot", "r5")
    assert publisher.publish().names("published") == ["r1", "r2"]
    assert len(evaluated) == 1
    for name in ("r1", "r2"):
        assert publisher.robot(name).gets().enclaves()[f"/{name}/base"]["crl.pem"]


def test_what_else_changed_with_a_revocation_is_evaluated(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A changed file, a later version of sros, and the expiry of what was evaluated."""
    publisher.run("revoke", "ks", "--robot", "r5")
    evaluated = evaluations(monkeypatch)
    publisher.run("renew", "ks", "/r2/base")
    publisher.publish()
    assert sorted(evaluated) == ["/r1/base", "/r2/base"]
    for days, version in ((1, "later"), (200, "later")):
        monkeypatch.setattr(publishing, "__version__", version)
        publisher.run("crl", "ks", "--refresh")
        evaluated.clear()
        assert publisher.publish(after=days * DAY).names("published") == ["r1", "r2"]
        assert sorted(evaluated) == ["/r1/base", "/r2/base"]


def test_a_revoked_enclave_that_is_put_back_is_refused(publisher: Home) -> None:
    """Its files were evaluated before, and the list with another enclave."""
    kept = publisher.copy(publisher.folder.with_name("kept")).root / "enclaves/r5"
    publisher.run("revoke", "ks", "--robot", "r5")
    copy_of(kept, publisher.root / "enclaves/r5")
    (publisher.root / "enclaves/r5/base/crl.pem").symlink_to("../../../public/identity_ca.crl.pem")
    result = publisher.publish()
    assert (result.names("published"), result.names("refused")) == (["r1", "r2"], ["r5"])
    assert "revoked" in next(robot.why for robot in result.robots if robot.why)


def test_an_earlier_revocation_list_is_not_published(publisher: Home) -> None:
    publisher.run("revoke", "ks", "--robot", "r5")
    (publisher.root / CRL).unlink()
    result = publisher.publish()
    assert (result.names("published"), result.names("refused")) == ([], ["r1", "r2"])


@pytest.mark.parametrize("damage", ["changed", "missing", "link"])
@pytest.mark.parametrize("is_renewed", [False, True])
def test_a_damaged_archive_is_published_again(
    publisher: Home, damage: str, is_renewed: bool
) -> None:
    """Robots and programs that copy folders do not follow a link to the right content."""
    assert not publisher.publish().notes
    (archive,) = (publisher.pub / "targets/robots").glob("*.r2.tar.gz")
    data = archive.read_bytes()
    if damage == "changed":
        archive.write_bytes(data[:-9] + bytes([data[-9] ^ 1]) + data[-8:])
    else:
        archive.rename(publisher.folder / "elsewhere")
    if damage == "link":
        archive.symlink_to(publisher.folder / "elsewhere")
    problem = FetchProblem.NOT_SIGNED if damage == "changed" else FetchProblem.UNREACHABLE
    publisher.robot("r2").refuses(problem)
    publisher.run("renew", "ks", "/r2/base" if is_renewed else "/r1/base")
    result = publisher.publish()
    assert "r2" in result.names("published")
    assert [note.id for note in result.notes] == ["fleet.archive-damaged"]
    assert publisher.robot("r2").gets().number > read_release(data).number
    assert_shown_for_a_day(publisher, result, "robots/r2.tar.gz")


@pytest.mark.parametrize("whole", [False, True])
def test_a_folder_that_went_back_is_published_again_and_shown(publisher: Home, whole: bool) -> None:
    """With all its files, or only the timestamp; each time, one run shows it, and the next not.

    The earlier timestamp does not hide that an archive was altered.
    """
    earlier = publisher.kept("earlier")
    publisher.run("renew", "ks", "/r1/base")
    publisher.publish()
    if whole:
        shutil.rmtree(publisher.pub)
        earlier.rename(publisher.pub)
    else:
        shutil.copy(earlier / "metadata/timestamp.json", publisher.pub / "metadata")
        release = read_published(OpenedKeystore(publisher.root)).robots["r1"].release
        (publisher.pub / release.path("r1")).write_text("altered")
    result = publisher.publish()
    damaged = [] if whole else ["fleet.archive-damaged"]
    assert [note.id for note in result.notes] == [*damaged, "fleet.metadata-older"]
    altered = [] if whole else ["robots/r1.tar.gz"]
    assert_shown_for_a_day(publisher, result, *altered, "metadata/timestamp.json")
    publisher.robot().gets()


ROOT, NEXT_ROOT = "metadata/1.root.json", "metadata/2.root.json"
ALTERED: dict[str, tuple[str, bytes | str, bool]] = {
    "the root of another keystore after the last root": (NEXT_ROOT, b"foreign root", True),
    "no metadata after the last root": (NEXT_ROOT, b"x", True),
    "a folder after the last root": (NEXT_ROOT, "folder", True),
    "a folder for the last root": (ROOT, "folder", False),
    "a link after the last root": (NEXT_ROOT, "link", True),
    "a pipe after the last root": (NEXT_ROOT, "pipe", True),
    "the root of another keystore for the first root": (ROOT, b"foreign root", False),
    "no first root": (ROOT, "missing", False),
    "a link for the first root": (ROOT, "link", False),
    "another timestamp": ("metadata/timestamp.json", b"{}", True),
    "no timestamp": ("metadata/timestamp.json", "missing", True),
    "a folder for the timestamp": ("metadata/timestamp.json", "folder", True),
    "no metadata": ("metadata", "missing", True),
    "another snapshot": ("metadata/*.snapshot.json", b"{}", True),
    "no list of targets": ("metadata/*.targets.json", "missing", True),
    "a folder for a list of archives": ("metadata/*.robots-*.json", "folder", True),
    "a folder in the way of the next timestamp": ("metadata/.timestamp.json.new", "folder", False),
}
"""Maps alterations of a publishing folder to the file, its new content, and whether robots can
fetch nothing until it is put right.
"""


def alter(file: Path, content: bytes | str) -> None:
    """Put other content in the place of a file, or nothing, or what is no file."""
    if file.is_dir():
        shutil.rmtree(file)
    file.unlink(missing_ok=True)
    if content == "folder":
        (file / "inside").mkdir(parents=True)
    elif content == "link":
        file.symlink_to("timestamp.json")
    elif content == "pipe":
        os.mkfifo(file)
    elif isinstance(content, bytes):
        file.write_bytes(content)


def test_altered_metadata_is_put_right_and_shown(publisher: Home) -> None:
    """Also for new robots; what was foreign is renamed, so that the next run finds nothing."""
    publisher.publish()
    robots = [publisher.robot("r2") for _ in ALTERED]
    root = (publisher.pub / ROOT).read_bytes()
    keys = {role: load_signer(new_key(), role) for role in ROLES}
    foreign = Roots()
    foreign.add(keys, [keys["root"]], publisher.now + DAY)
    ((_, foreign_root),) = foreign.files()
    for robot, (case, (name, content, stops_robots)) in zip(robots, ALTERED.items(), strict=True):
        content = foreign_root if content == b"foreign root" else content
        for file in [*publisher.pub.glob(name)] or [publisher.pub / name]:
            alter(file, content)
        with pytest.raises(FetchError) if stops_robots else nullcontext():
            robot.fetch()
        status = fleet_status(OpenedKeystore(publisher.root)).publication
        altered = [] if name.endswith(".new") else [name if "root" in name else "metadata"]
        assert status and bool(status.refused or status.lacks) == bool(altered), case
        result = publisher.publish()
        assert result.altered == altered, case
        assert result.is_complete(publisher.now) == (not altered), case
        assert robot.gets() == publisher.robot("r2").gets(), case
        assert (publisher.pub / ROOT).read_bytes() == root, case
        assert result.root_sha256 == hashlib.sha256(root).hexdigest(), case
        status = fleet_status(OpenedKeystore(publisher.root)).publication
        assert status and {*altered} <= status.altered.keys(), case
        assert not (status.refused or status.lacks), case
    assert publisher.publish().is_complete(publisher.now)


def test_a_root_that_waits_for_the_next_rotation(publisher: Home) -> None:
    """Robots read it only after the rotation, which takes it and the one before it away."""
    robot, metadata = publisher.robot(), publisher.pub / "metadata"
    for number in (2, 3):
        (metadata / f"{number}.root.json").write_bytes(b"foreign")
    result = publisher.publish(rotate=("timestamp",))
    assert result.altered == ["metadata/2.root.json", "metadata/3.root.json"]
    assert [file.name for file in metadata.glob("*.foreign")]
    robot.gets()
    assert publisher.publish().is_complete(publisher.now)
    (metadata / "2.root.json").unlink()
    assert publisher.publish().altered == ["metadata/2.root.json"]


def test_altered_metadata_is_put_right_only_in_the_last_folder(publisher: Home) -> None:
    """Elsewhere, the keystore does not know that the metadata was its own."""
    publisher.publish()
    (publisher.pub / "metadata/timestamp.json").write_bytes(b"{}")
    other = publisher.kept("other")
    with pytest.raises(KeystoreError, match="did not write"):
        publish(publisher.root, other, now=publisher.now)
    assert publisher.publish().altered == ["metadata"]


def test_a_forged_later_timestamp_keeps_new_enclaves_waiting_only_for_publishing(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks as if the keystore was restored, until publishing has put the metadata right."""
    publisher.publish()
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    with (publisher.folder / "fleet.toml").open("a") as fleet:
        fleet.write("[robots.r9]\n")
    timestamp = publisher.pub / "metadata/timestamp.json"
    forged = json.loads(timestamp.read_bytes())
    forged["signed"]["version"] += 1
    timestamp.write_text(json.dumps(forged))
    generate = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    refused = sros(*generate, cwd=publisher.folder)
    remedy = re.search(r"First run `sros (fleet publish [^`]+)`, which puts", refused.err)
    assert refused.status == 2 and remedy, refused.err
    assert sros(*remedy[1].split(), cwd=publisher.folder).status == 1
    assert "created enclave /r9/base" in publisher.run(*generate).out


@pytest.mark.parametrize("content", ["x", "[]", "{}", '{"roots": 5}', '{"roots": [{}]}'])
def test_damaged_root_metadata_in_the_keystore(publisher: Home, content: str) -> None:
    (publisher.root / "fleet_root.json").write_text(content)
    for words in (("publish", "ks", "pub"), ("status", "ks")):
        refused = sros("fleet", *words, cwd=publisher.folder)
        assert refused.status == 2 and "fleet_root.json' is damaged" in refused.err
        assert "publish to another folder" in refused.err


def assert_shown_for_a_day(publisher: Home, result: PublishedFleet, *files: str) -> None:
    """Assert that a run which published files again ends with 1, and the status has the files."""
    assert result.altered == [*files] and not result.is_complete(publisher.now)
    for hours, is_shown in ((1, True), (22, True), (2, False)):
        done = publisher.publish(after=timedelta(hours=hours))
        assert not done.altered and done.is_complete(publisher.now)
        status = fleet_status(OpenedKeystore(publisher.root)).with_overdue(publisher.now)
        assert status.publication and sorted(status.publication.altered) == sorted(files) * is_shown


def test_a_private_key_in_a_file_that_would_be_published(publisher: Home) -> None:
    cert = publisher.root / "enclaves/r1/base/cert.pem"
    cert.write_bytes(cert.read_bytes() + (cert.parent / "key.pem").read_bytes())
    result = publisher.publish()
    assert result.names("refused") == ["r1"]
    assert b"PRIVATE" not in b"".join(read_release(archives(publisher)["r1"]).files.values())


def test_a_dry_run_writes_nothing(publisher: Home) -> None:
    publisher.run("renew", "ks", "/r1/base")
    before = snapshot(publisher.folder)
    assert publisher.publish(dry_run=True).names("published") == ["r1"]
    assert snapshot(publisher.folder) == before
    assert publisher.publish().names("published") == ["r1"]


NEXT_STEPS = (
    ("renew", "ks", "/r1/base", "--revoke-old"),
    ("renew", "ks", "/r1/base"),
    ("update_keystore", "ks", "--domain", "1", "--allow-looser"),
    ("generate_artifacts", "-k", "ks", "-p", "more.xml", "--fleet", "fleet.toml"),
    ("revoke", "ks", "/r5/base"),
    ("rotate_ca", "ks", "--next"),
    ("rotate_ca", "ks", "--status"),
)
"""Changes of a keystore, one after the other."""


def test_next_steps_name_publishing_where_the_keystore_publishes(publisher: Home) -> None:
    exports = publisher.folder / "exports"
    copy_of(publisher.root, exports / "ks")
    (exports / "ks/fleet_root.json").unlink()
    shutil.copy(publisher.folder / "fleet.toml", exports)
    for folder in (publisher.folder, exports):
        (folder / "more.xml").write_text(policy_text({"/{robot}/base": allow_publish("x", "y")}))
    for words in NEXT_STEPS:
        done = sros(*words, cwd=publisher.folder)
        assert "`sros fleet publish ks PUB`" in done.err + done.out, (words, done)
        other = sros(*words, cwd=exports)
        assert done.status == other.status
        assert "fleet publish" not in other.err + other.out
        assert "export" in other.err + other.out or "generate_artifacts" in words


def test_the_ledger_has_what_was_published(publisher: Home) -> None:
    entries = [
        each for each in OpenedKeystore(publisher.root).ledger.entries if each.what == "release"
    ]
    lines = sorted(
        f"{hashlib.sha256(data).hexdigest()}  {robot}\n"
        for robot, data in archives(publisher).items()
    )
    (entry,) = entries
    assert entry.sha256 == hashlib.sha256("".join(lines).encode()).hexdigest()
    assert numbers(publisher) == dict.fromkeys(("r1", "r2", "r5"), entry.number)
    assert "release" in publisher.run("inspect", "ks", "--history").out


# ── whole at every moment ──────────────────────────────────────────────────────────────────


class _Killed(BaseException):
    pass


def test_a_kill_at_any_write_leaves_whole_metadata(
    made_publisher: Home, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """New releases and new keys of three roles: robots get the old release, or the new one."""
    put = publishing._put_file

    def publish_killed(at: int) -> int:
        """Publish, killed ``at`` a write, and again; return the number of writes before."""
        home = made_publisher.copy(tmp_path / f"at{at}")
        home.run("renew", "ks", "/r1/base")
        robot, writes = home.robot(), 0
        old = robot.gets()

        def killed(folder: Folder, path: str, data: bytes) -> None:
            nonlocal writes
            if writes == at:
                raise _Killed
            put(folder, path, data)
            writes += 1

        with monkeypatch.context() as patched, suppress(_Killed):
            patched.setattr(publishing, "_put_file", killed)
            home.publish(rotate=("timestamp", "snapshot", "targets", "root"))
        then, written = robot.gets(), writes
        assert home.robot().gets() == then
        assert then == old or then.number > old.number
        home.publish()
        assert not [*(home.root / "private").glob("*before*")]
        assert robot.gets() == home.robot().gets() != old
        shutil.rmtree(home.folder)
        return written

    whole = publish_killed(at=100)
    assert whole >= 6
    for at in few_steps(range(whole)):
        assert publish_killed(at) == at


def test_a_kill_after_the_keystore_changed_keeps_the_number(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    publisher.run("renew", "ks", "/r1/base")
    with monkeypatch.context() as patched:
        patched.setattr(publishing._Publication, "write", _raise_killed)
        with pytest.raises(_Killed):
            publisher.publish()
    number = read_published(OpenedKeystore(publisher.root)).robots["r1"].release.number
    assert not publisher.publish().names("published")
    assert publisher.robot().gets().number == number


@pytest.mark.parametrize("changed", ["", "renew", "revoke", "nothing, on Zenoh"])
@pytest.mark.parametrize("is_lost", [False, True])
def test_a_kill_before_the_keystore_knows_its_first_releases(
    publisher: Home, is_lost: bool, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_lost:
        forget_publishing(publisher.root)
    if "Zenoh" in changed:
        publisher.run("zenoh", "ks")
    shutil.rmtree(publisher.pub)
    with monkeypatch.context() as patched:
        patched.setattr(publishing._Publication, "compose", _raise_killed)
        with pytest.raises(_Killed):
            publisher.publish(new_folder=is_lost)
    killed = archives(publisher)
    assert killed and not [*publisher.pub.glob("metadata/*")]
    if changed in ("renew", "revoke"):
        publisher.run(changed, "ks", "/r1/base")
    publisher.publish(new_folder=is_lost)
    publisher.robot("r2").gets()


def test_a_disk_that_is_full_after_the_keystore_changed(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    put, robot = publishing._put_file, publisher.robot()
    before = robot.gets()

    def full(folder: Folder, path: str, data: bytes) -> None:
        if path.startswith("metadata/"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
        put(folder, path, data)

    publisher.run("renew", "ks", "/r1/base")
    with monkeypatch.context() as patched:
        patched.setattr(publishing, "_put_file", full)
        with pytest.raises(KeystoreError, match=r"No space left on device\. Robots find either"):
            publisher.publish()
    assert robot.gets() == before
    publisher.publish()
    assert robot.gets().number > before.number


def _raise_killed(*_words: object) -> None:
    raise _Killed


def test_old_files_stay_for_a_while(publisher: Home) -> None:
    def count() -> int:
        return len([*publisher.pub.rglob("*.r1.tar.gz")])

    publisher.run("renew", "ks", "/r1/base")
    publisher.publish(after=10 * DAY)
    assert count() == 2
    publisher.publish(after=DAY)
    assert count() == 2
    publisher.publish(after=DAY)
    assert count() == 1
    assert not [*publisher.pub.rglob("1.snapshot.json")]
    assert [*publisher.pub.rglob("1.root.json")]
    publisher.robot().gets()


def test_many_files_that_nothing_names(publisher: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    """As whoever can write to the folder makes them, and a full disk leaves them."""
    monkeypatch.setattr(publishing, "_MOST_SUPERSEDED", 2)
    names = ["targets/robots/.x.tar.gz.new", "metadata/.9.snapshot.json.new"]
    names += [f"targets/robots/{number:064}.r9.tar.gz" for number in range(2)]
    for name in names:
        (publisher.pub / name).touch()
    for run in range(9):
        there = [name for name in names if (publisher.pub / name).exists()]
        assert there == names or run > 1
        publisher.publish(after=3 * DAY)
        assert len(read_published(OpenedKeystore(publisher.root)).superseded) <= 2
    assert not there


def test_two_at_once(publisher: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transaction, "_LOCK_SECONDS", 0.0)
    with Folder(publisher.pub) as folder:
        lock = transaction.KeystoreLock(folder).acquire()
        try:
            with pytest.raises(KeystoreError, match="is busy"):
                publisher.publish()
        finally:
            lock.release()
    publisher.publish()


def test_a_run_that_waited_for_another_sees_what_that_one_published(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    publisher.run("renew", "ks", "--robot", "r1")
    publisher.now += LATER

    def publish_first() -> None:
        assert publisher.publish(after=timedelta()).names("published") == ["r1"]

    while_waiting(monkeypatch, "publishing folder", publish_first)
    assert publisher.publish(after=timedelta()).names("published") == []


@pytest.mark.parametrize("place", ["publishing folder", "keystore"])
def test_no_fleet_counts_that_was_edited_while_a_run_waited(
    publisher: Home, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    publisher.run("renew", "ks", "--robot", "r1")
    before = archives(publisher)

    def edit() -> None:
        with (publisher.root / FLEET).open("a") as file:
            file.write("[robots.r9]\n")

    while_waiting(monkeypatch, place, edit)
    with pytest.raises(KeystoreError, match=r"/fleet\.toml' "):
        publisher.publish()
    assert archives(publisher) == before


def while_waiting(monkeypatch: pytest.MonkeyPatch, place: str, act: Callable[[], None]) -> None:
    """Let ``act`` run once before the lock on ``place`` is acquired."""
    acquire = transaction.KeystoreLock.acquire

    def act_first(lock: transaction.KeystoreLock) -> transaction.KeystoreLock:
        if lock._what == place:
            monkeypatch.setattr(transaction.KeystoreLock, "acquire", acquire)
            act()
        return acquire(lock)

    monkeypatch.setattr(transaction.KeystoreLock, "acquire", act_first)


# ── keys and times ─────────────────────────────────────────────────────────────────────────


def test_a_root_key_that_is_kept_elsewhere(publisher: Home) -> None:
    safe = publisher.folder / "safe.pem"
    (publisher.root / "private/fleet_root.pem").rename(safe)
    robot = publisher.robot()
    publisher.publish()
    for wrong in (None, publisher.root / "private/fleet_targets.pem", publisher.folder / "none"):
        with pytest.raises(KeystoreError):
            publisher.publish(rotate=("timestamp",), root_key=wrong)
    publisher.publish(rotate=("timestamp", "root"), root_key=safe)
    robot.gets()
    assert not [*publisher.folder.glob("safe.pem.*")]
    publisher.publish(rotate=("snapshot",), root_key=safe)
    robot.gets()
    assert not (publisher.root / "private/fleet_root.pem").exists()


@pytest.mark.parametrize("after", ["write_new_key_outside", "stage", "release", "keep_changes"])
def test_a_killed_rotation_of_a_root_key_elsewhere_recovers(
    publisher: Home, monkeypatch: pytest.MonkeyPatch, after: str
) -> None:
    """Before the keystore names the new key, it is dropped; from then on, it takes its place."""
    safe, spare = (publisher.folder / name for name in ("safe.pem", "safe.pem.new"))
    (publisher.root / "private/fleet_root.pem").rename(safe)
    robot, old = publisher.robot(), safe.read_bytes()
    owner = RoleKeys if after == "write_new_key_outside" else publishing._Publication
    done = getattr(owner, after)

    def killed(*words: object) -> None:
        done(*words)
        raise _Killed

    with monkeypatch.context() as patched:
        patched.setattr(owner, after, killed)
        with pytest.raises(_Killed):
            publisher.publish(rotate=("root",), root_key=safe)
    made = spare.read_bytes() if after != "release" else b""
    before = snapshot(publisher.folder)
    publisher.publish(root_key=safe, dry_run=True)
    assert snapshot(publisher.folder) == before
    publisher.publish(root_key=safe)
    assert safe.read_bytes() == (made if after == "keep_changes" else old)
    assert not spare.exists()
    publisher.publish(rotate=("root",), root_key=safe)
    assert robot.gets() and safe.read_bytes() not in (old, made)


def test_a_file_that_is_no_key_next_to_the_root_key_stays(publisher: Home) -> None:
    safe, note = (publisher.folder / name for name in ("safe.pem", "safe.pem.new"))
    (publisher.root / "private/fleet_root.pem").rename(safe)
    note.write_text("mine")
    publisher.publish(rotate=("timestamp",), root_key=safe)
    with pytest.raises(KeystoreError, match=r"safe\.pem\.new' is in the way"):
        publisher.publish(rotate=("root",), root_key=safe)
    assert note.read_text() == "mine"
    note.unlink()
    publisher.publish(rotate=("root",), root_key=safe)


def test_a_first_root_key_that_is_made_elsewhere(publisher: Home) -> None:
    shutil.rmtree(publisher.pub)
    for name in ("fleet_root.json", "published.json"):
        (publisher.root / name).unlink()
    with pytest.raises(KeystoreError, match=r"no fleet_root\.json"):
        publisher.publish()
    for path in (publisher.root / "private").glob("fleet_*"):
        path.unlink()
    safe = publisher.folder / "safe.pem"
    assert publisher.publish(root_key=safe).names("published") == ["r1", "r2", "r5"]
    assert stat.S_IMODE(safe.stat().st_mode) == 0o600
    publisher.robot().gets()
    publisher.publish(rotate=("root",), root_key=safe)


def test_check_knows_the_files_and_who_may_read_the_keys(publisher: Home) -> None:
    publisher.publish(rotate=("timestamp",))
    found = sros("check", "ks", "--severity", "note", cwd=publisher.folder)
    assert "unknown-file" not in found.out and "fleet_" not in found.out
    (publisher.root / "private/fleet_targets.pem").chmod(0o644)
    assert "fleet_targets.pem" in sros("check", "ks", cwd=publisher.folder).out
    (publisher.root / "fleet_roots.json").touch()
    found = sros("check", "ks", "--severity", "note", cwd=publisher.folder)
    assert "fleet_roots.json" in found.out


def test_a_key_that_was_lost(publisher: Home) -> None:
    targets, snapshot = (publisher.root / f"private/fleet_{e}.pem" for e in ("targets", "snapshot"))
    before = targets.read_bytes(), snapshot.read_bytes()
    targets.write_bytes(before[1])
    snapshot.write_bytes(before[0])
    with pytest.raises(
        KeystoreError, match="--rotate-key targets --rotate-key snapshot of"
    ) as both:
        publisher.publish()
    assert f"'{targets}' is not the targets key and '{snapshot}' is not the" in str(both.value)
    targets.write_bytes(before[0])
    snapshot.unlink()
    with pytest.raises(KeystoreError, match="--rotate-key snapshot"):
        publisher.publish()
    publisher.publish(rotate=("snapshot",))
    publisher.robot().gets()


def test_what_is_about_to_expire_is_renewed(publisher: Home) -> None:
    robot = publisher.robot()
    publisher.publish(after=DAY)
    assert publisher.publish(after=DAY).versions["snapshot"] == 1
    assert publisher.publish(after=2 * DAY).versions["snapshot"] == 2
    assert publisher.publish(after=50 * DAY).versions["targets"] == 2
    assert publisher.publish(after=250 * DAY).root.name == "2.root.json"
    robot.gets()
    (publisher.root / "private/fleet_root.pem").unlink()
    notes = publisher.publish(after=250 * DAY).notes
    assert [note.id for note in notes] == ["fleet.root-expires"]
    robot.gets()
    quick = MetadataExpiry(timestamp=timedelta(hours=1))
    publisher.publish(expiry=quick)
    robot.refuses(FetchProblem.EXPIRED, now=publisher.now + timedelta(hours=2))
    end = publisher.publish().expires["root"]
    for left, said in ((DAY / 2, f"accept these files until {iso(end)}"), (-DAY, "refuse these")):
        done = publisher.publish(after=end - publisher.now - left)
        *_, line = _published_lines(done, publisher.now)
        assert said in line and "/pub --root-key FILE`" in line and done.expires["root"] == end
        assert done.is_complete(publisher.now) == (left > timedelta(0))
    assert f"the root metadata expired at {iso(end)}, and robots refuse" in done.notes[0].text
    assert "--root-key FILE" in robot.refuses(FetchProblem.EXPIRED).remedy


# ── folders and keystores that are not what they should be ─────────────────────────────────


def test_a_keystore_that_was_restored(publisher: Home) -> None:
    backup = publisher.folder / "backup"
    copy_of(publisher.root, backup)
    earlier = {path: path.read_bytes() for path in publisher.pub.glob("targets/robots/*")}
    publisher.run("revoke", "ks", "--robot", "r5")
    publisher.publish()
    robot = publisher.robot()
    latest = robot.gets().number
    listed = OpenedKeystore(publisher.root).revocation_list
    assert listed
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    with pytest.raises(KeystoreError, match="restored from a backup"):
        publisher.publish()
    robot.gets()
    # What a timer renews meanwhile has the numbers of what came after the backup.
    publisher.run("renew", "ks", "--all")
    assert OpenedKeystore(publisher.root).ledger.next_number() > latest
    with pytest.raises(KeystoreError, match="restored from a backup"):
        publisher.publish()
    archives = publisher.folder / "archives"
    (publisher.pub / "targets/robots").rename(archives)
    with pytest.raises(KeystoreError, match="which revocations the keystore lacks"):
        publisher.publish(restored=True)
    (publisher.pub / "targets/robots").mkdir()
    # Whoever can write to the folder has earlier archives, with an earlier revocation list.
    for path in archives.iterdir():
        of_robot = (data for before, data in earlier.items() if before.name[64:] == path.name[64:])
        (publisher.pub / f"targets/robots/{path.name}").write_bytes(next(of_robot))
    with pytest.raises(KeystoreError, match="which revocations the keystore lacks"):
        publisher.publish(restored=True)
    shutil.rmtree(publisher.pub / "targets/robots")
    archives.rename(publisher.pub / "targets/robots")
    planned = publisher.publish(restored=True, dry_run=True)
    done = publisher.publish(restored=True)
    assert planned.names("published") == done.names("published") == ["r1", "r2"]
    assert [note.id for note in done.notes] == ["fleet.revocations-restored"]
    shown = sros("inspect", publisher.root, "--history").out
    assert "  restored     incomplete  from a backup; entries may" in shown
    assert "/r5/base" in done.notes[0].text and not (publisher.root / "enclaves/r5/base").exists()
    release = robot.gets()
    assert release.number > latest
    (own,) = (data for path, data in release.files.items() if path.endswith("crl.pem"))
    assert load_crl(own, "it").number > listed.number
    assert load_crl(own, "it").revoked[0].serial == listed.revoked[0].serial
    assert not publisher.publish().names("published")


@pytest.mark.parametrize("revoked_first", [True, False])
def test_revoking_after_a_restore_covers_certificates_of_after_the_backup(
    publisher: Home, revoked_first: bool
) -> None:
    """A thief keeps the files that the robot fetched after the backup."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    publisher.run("renew", "ks", "--all")
    publisher.publish()
    stolen = OpenedKeystore(publisher.root).certificate_of("/r5/base")
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    revoke = ("revoke", "ks", "--robot", "r5")
    if revoked_first:
        publisher.run(*revoke)
    done = publisher.publish(restored=True)
    assert [note.id for note in done.notes] == ["fleet.certificates-restored"]
    if not revoked_first:
        said = publisher.run(*revoke).err
        noticed = "the keystore was restored from a backup (sros noticed it at 2"
        assert f"may lack earlier certificates: {noticed}" in said
        assert "their CA is replaced (`sros rotate_ca`)" in said
    publisher.run("renew", "ks", "--all")
    publisher.publish()
    release = publisher.robot("r1").gets()
    (crl,) = (data for path, data in release.files.items() if path.endswith("crl.pem"))
    listed = load_crl(crl, "of r1")
    assert listed.revokes(stolen.serial_number)
    own = release.files["enclaves/r1/base/cert.pem"]
    assert not listed.revokes(x509.load_pem_x509_certificate(own).serial_number)
    assert "[keystore." not in sros("check", "ks", cwd=publisher.folder).out
    # Whatever is unknown ends with the CA.
    publisher.run("rotate_ca", "ks", "--finish", "--allow-unconfirmed")
    assert "restored" not in publisher.run("revoke", "ks", "/r2/base").err


@pytest.mark.parametrize("topics", [("x",), ("x", "horn")])
def test_renewing_the_rights_of_a_backup_is_said_until_a_policy_is_signed(
    publisher: Home, topics: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A renewal gives them a later date than the rights that were signed after the backup."""
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    note, folder = "keystore.rights-of-backup", publisher.folder
    sign = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    backup = copy_of(publisher.root, folder / "backup")
    (folder / "policy.xml").write_text(policy_text({"/{robot}/base": allow_publish(*topics)}))
    publisher.run("renew", "ks", "--all")
    publisher.run(*sign)
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    publisher.publish(restored=True)
    noticed = publisher.now
    publisher.now += timedelta(minutes=1)
    said = publisher.run("renew", "ks", "--all").err
    assert f"[{note}]: /r1/base, /r2/base, /r5/base have the rights of the backup: " in said
    assert f"noticed it at {iso(noticed)}), and no policy was signed since" in said
    assert "`sros generate_artifacts -k ks -p POLICY_FILE --fleet FLEET_FILE`" in said
    assert [each.id for each in publisher.publish().notes] == [note]
    publisher.run("rotate_ca", "ks", "--permissions", "--finish", "--allow-unconfirmed")
    assert note in publisher.run("renew", "ks", "/r1/base").err, "a new CA states no policy"
    said = publisher.run(*sign).err
    assert ("unchanged" in said) is (topics == ("x",))
    publisher.run("rotate_ca", "ks", "--permissions", "--finish", "--allow-unconfirmed")
    assert note not in publisher.run("renew", "ks", "--all").err
    assert note not in {each.id for each in publisher.publish().notes}
    lines = len(OpenedKeystore(publisher.root).ledger.entries)
    publisher.run(*sign)
    assert len(OpenedKeystore(publisher.root).ledger.entries) == lines, "it is said once"


def test_what_shows_the_same_restore_again_does_not_change_its_time(publisher: Home) -> None:
    root = publisher.root
    for _ in range(2):
        backup = copy_of(root, publisher.folder / "backup")
        publisher.run("renew", "ks", "--all")
        publisher.publish()
        shutil.rmtree(root)
        backup.rename(root)
        publisher.now += timedelta(minutes=1)
        noticed = publisher.now
        for shown_by in (LATER_RELEASE, "", PUBLISHING, ""):
            if shown_by == PUBLISHING:
                publisher.publish(restored=True)
            else:
                lost = LostRecords(OpenedKeystore(root), publisher.now)
                lost.later_number = 10**9 * bool(shown_by)
                restore_revocations(root, lost, shown_by=shown_by, now=publisher.now)
            assert restored_at(OpenedKeystore(root)) == iso(noticed)
            publisher.now += timedelta(minutes=1)
    publisher.run("rotate_ca", "ks", "--finish", "--allow-unconfirmed")
    assert not restored_at(OpenedKeystore(root))
    publisher.now += timedelta(minutes=1)
    lost, again = LostRecords(OpenedKeystore(root), publisher.now), ("/r1/base",)
    restore_revocations(root, lost, shown_by="", perhaps_revoked=again, now=publisher.now)
    assert restored_at(OpenedKeystore(root)) == iso(publisher.now), "the restores before the new CA"


@pytest.mark.parametrize("hours", [23, 25])
def test_settings_that_a_restored_keystore_has_lost(publisher: Home, hours: int) -> None:
    """The twin differs by less than a day, as if the clock had been wrong."""
    setting = ("update_keystore", "ks", "--set", f"certificates.validity={90 * 24 - hours}h")
    publisher.run("update_keystore", "ks", "--set", "certificates.validity=90d")
    backup = copy_of(publisher.root, publisher.folder / "backup")
    publisher.run(*setting)
    publisher.run("renew", "ks", "--all")
    publisher.run("renew", "ks", "/r1/base", "--revoke-old")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    with pytest.raises(KeystoreError, match="nothing can be published"):
        publisher.publish(restored=True)
    publisher.run("renew", "ks", "/r1/base")
    notes = {note.id: note.text for note in publisher.publish(restored=True).notes}
    assert ("fleet.settings-restored" in notes) is (hours > 24)
    if hours > 24:
        assert "a new one would be valid for 90d" in notes["fleet.settings-restored"]
        assert "`sros update_keystore ks --set" in notes["fleet.settings-restored"].replace(
            str(publisher.root), "ks"
        )


@pytest.mark.parametrize("renewed_first", [True, False])
def test_a_key_that_was_replaced_after_the_backup_is_not_certified_again(
    publisher: Home, renewed_first: bool
) -> None:
    """The restored keystore has only this key; whose certificate alone was replaced keeps its."""
    publisher.publish()  # the keystore records the folder
    backup = copy_of(publisher.root, publisher.folder / "backup")
    publisher.run("renew", "ks", "/r1/base", "--revoke-old")
    publisher.run("renew", "ks", "/r2/base", "--new-key", "--revoke-old")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    shown = sros("crl", publisher.root).ok().err.splitlines()
    assert shown[0] == "the keystore knows of no revocation" and "may lack later" in shown[1]
    (note,) = json.loads(sros("crl", publisher.root, "--json").ok().out)["notes"]
    assert note["id"] == "crl.older-keystore" and note["text"] in shown[1]
    command = f"First run `sros fleet publish {publisher.root} {publisher.pub} --restored`"
    assert command in sros("renew", publisher.root, "/r2/base").err
    rotation = sros("rotate_ca", publisher.root, "--identity", "--finish", "--allow-unconfirmed")
    assert f"`sros revoke {publisher.root} /r1/base /r2/base`" in rotation.err, (
        "refused where CAs differ"
    )
    if renewed_first:
        publisher.pub.rename(publisher.folder / "server")
        publisher.run("renew", "ks", "--all")
        (publisher.folder / "server").rename(publisher.pub)
    stolen = OpenedKeystore(publisher.root).certificate_of("/r2/base")
    repeated = False
    for dry_run in (True, False, False):
        if renewed_first or dry_run:
            what = "`sros renew .* /r2/base --new-key --revoke-old`"
        else:
            what = "`sros renew [^ ]* /r1/base`.*`sros renew [^ ]* /r2/base --new-key --revoke"
        with pytest.raises(KeystoreError, match=what) as refused:
            publisher.publish(restored=True, dry_run=dry_run)
        done = "The keystore was changed already: it has recorded what" in str(refused.value)
        assert done == (not dry_run and not repeated)
        repeated = not dry_run
    crl = OpenedKeystore(publisher.root).revocation_list
    assert crl and crl.revokes(stolen.serial_number)
    assert "key of enclave /r2/base was revoked" in sros("renew", publisher.root, "/r2/base").err
    renew(publisher.root, ["/r1/base"], now=publisher.now)
    renew(publisher.root, ["/r2/base"], new_key=True, revoke_old=True, now=publisher.now)
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]


def test_a_publishing_folder_teaches_nothing_that_the_cas_did_not_sign(publisher: Home) -> None:
    """A certificate of another CA, one that is recorded already, and files that are no archives."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    publisher.run("renew", "ks", "/r1/base")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    publisher.run("create_keystore", "other")
    publisher.run("create_enclave", "other", "/r2/base")
    certificate = (publisher.folder / "other/enclaves/r2/base/cert.pem").read_bytes()
    own = (publisher.root / "enclaves/r5/base/cert.pem").read_bytes()
    folder = publisher.pub / "targets/robots"
    for content in (certificate, own):
        files = {"enclaves/r2/base/cert.pem": content}
        (seal,) = seal_releases([("r2", 1, files)], publisher.permissions_ca())
        data = pack_release(Release("r2", 1, files, seal))
        (folder / f"{hashlib.sha256(data).hexdigest()}.r2.tar.gz").write_bytes(data)
    unreadable = [f"{digest}.r5.tar.gz" for digest in (f"{0:064x}", f"{1:064x}")]
    unreadable.append(f"{hashlib.sha256(b'x').hexdigest()}.r5.tar.gz")  # as its name says
    for name in (unreadable[0], unreadable[2]):
        (folder / name).write_bytes(b"x")
    (folder / unreadable[1]).mkdir()
    before = len(OpenedKeystore(publisher.root).ledger.entries)
    done = publisher.publish(restored=True)
    (unread,) = (note.text for note in done.notes if note.id == "fleet.archives-not-read")
    assert all(name in unread for name in unreadable), unread
    added = OpenedKeystore(publisher.root).ledger.entries[before:]
    assert [(entry.what, entry.enclave) for entry in added] == [
        ("restored", ""),
        ("certificate", "/r1/base"),
        ("release", ""),
    ]


def test_a_keystore_that_was_restored_from_before_its_keys_were_replaced(publisher: Home) -> None:
    """Robots know the new root, so what the keys in the backup sign would be refused by all."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    robot = publisher.robot()
    publisher.publish(rotate=("timestamp",))
    robot.gets()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    foreign = publisher.pub / "metadata/3.root.json"
    forged = Metadata[Root].from_file(str(foreign.with_name("2.root.json")))
    thief = load_signer(new_key(), "the key of a thief")
    forged.signed.version = 3
    forged.signed.add_key(thief.public_key, "root")
    forged.sign(thief)
    forged.to_file(str(foreign))
    roots = Roots(json.loads((publisher.root / "fleet_root.json").read_text())["roots"])
    roots.add_later_versions(publisher.pub)
    assert roots.last.version == 2, "the key of 2 did not sign 3"
    with pytest.raises(KeystoreError, match=r"timestamp key .* was published last. A later copy"):
        publisher.publish()
    foreign.unlink()
    assert publisher.publish(rotate=("timestamp",)).root.name == "3.root.json"
    assert robot.gets() == publisher.robot().gets()


def test_replaced_keys_of_publishing_that_only_robots_know(publisher: Home) -> None:
    """The publishing folder is lost, too, so robots refuse what the keys of the backup sign."""
    backup, robot = copy_of(publisher.root, publisher.folder / "backup"), publisher.robot()
    publisher.publish(rotate=("timestamp",))
    robot.gets()
    shutil.rmtree(publisher.root)
    shutil.rmtree(publisher.pub)
    backup.rename(publisher.root)
    key = publisher.root / fleet_key_path("timestamp")
    lost = key.rename(publisher.folder / "key")
    for dry_run in (True, False):
        with pytest.raises(SrosError) as refused:
            publisher.publish(restored=True, new_folder=True, dry_run=dry_run)
        assert "root metadata up to version 1, and nothing in" in refused.value.remedy
    lost.rename(key)
    notes = {n.id: n.text for n in publisher.publish(restored=True, new_folder=True).notes}
    assert "the root metadata up to version 1, and nothing in" in notes["fleet.root-not-seen"]
    assert "--rotate-key" in robot.refuses(FetchProblem.NOT_SIGNED).remedy
    (known,) = robot.state.rglob("root_history/2.root.json")
    shutil.copy(known, publisher.pub / "metadata")
    publisher.publish(rotate=("timestamp",))
    assert robot.gets() == publisher.robot().gets()


def test_a_keystore_that_was_restored_from_before_all_robots_were_revoked(
    publisher: Home,
) -> None:
    """Nothing is published any more, so no release has a later number."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    for robot in ("r1", "r2", "r5"):
        publisher.run("revoke", "ks", "--robot", robot)
    publisher.publish()
    assert publisher.publish(after=timedelta(days=60)).names("published") == []
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    for said in (False, True):
        with pytest.raises(KeystoreError, match="published again without r1, r2, r5, and"):
            publisher.publish(restored=said)
    for robot in ("r1", "r2", "r5"):
        publisher.run("revoke", "ks", "--robot", robot)
    publisher.publish()


@pytest.mark.parametrize("revoked", [False, True])
def test_a_keystore_that_was_restored_from_before_a_robot_was_removed(
    publisher: Home, revoked: bool
) -> None:
    """The other robots got nothing new: it left the fleet, or their releases were refused."""
    publisher.run("renew", "ks", "/r5/base")
    publisher.publish()
    backup = copy_of(publisher.root, publisher.folder / "backup")
    fleet = publisher.folder / "fleet.toml"
    change = {
        False: "generate_artifacts -k ks -p policy.xml --fleet fleet.toml",
        True: "revoke ks --robot r5",
    }[revoked].split()
    before = fleet.read_text()
    fleet.write_text(before if revoked else before.replace("[robots.r5]\n", ""))
    publisher.run(*change)
    broken = [*publisher.root.glob("enclaves/r[12]/base/permissions.p7s")] if revoked else []
    for path in broken:
        path.write_bytes(b"x")
    assert publisher.publish().names("published") == []
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    for said in (False, True):
        with pytest.raises(KeystoreError, match="published again without r5, and") as refused:
            publisher.publish(restored=said)
        assert "`sros revoke" in refused.value.remedy and "restored" not in refused.value.remedy
    publisher.run(*change)
    assert "r5" not in publisher.publish().names("published")
    publisher.robot("r1").gets()
    publisher.robot("r5").refuses(FetchProblem.NOT_FOR_ROBOT)


def test_a_robot_that_left_the_fleet_does_not_come_back_with_a_restored_keystore(
    publisher: Home,
) -> None:
    backup = copy_of(publisher.root, publisher.folder / "backup")
    (publisher.folder / "fleet.toml").write_text("[robots.r1]\n[robots.r2]\n")
    change = ["generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml"]
    publisher.run(*change)
    publisher.run("renew", "ks", "/r1/base")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    with pytest.raises(KeystoreError, match="later releases of r1 than the keystore"):
        publisher.publish()
    with pytest.raises(KeystoreError, match="/r5/base may have been revoked or removed"):
        publisher.publish(restored=True)
    publisher.run("revoke", "ks", "/r5/base")
    publisher.run(*change)
    assert publisher.publish(restored=True).names("published") == ["r1", "r2"]


@pytest.mark.parametrize("number", ["1" * 5000, "1" * 30, 10**12, 10**9, 0, -1, "1e3", "true"])
def test_a_number_in_the_list_of_what_is_published_that_was_never_given(
    publisher: Home, number: int | str
) -> None:
    path = publisher.root / "published.json"
    kept = path.read_text()
    known = str(read_published(OpenedKeystore(publisher.root)).number)
    path.write_text(kept.replace(f'"number": {known}', f'"number": {number}', 1))
    before = snapshot(publisher.folder)
    with pytest.raises(DocumentError, match=r"published\.json' is damaged"):
        publisher.publish()
    assert snapshot(publisher.folder) == before
    path.write_text(kept.replace('"timestamp": 1', f'"timestamp": {number}', 1))
    if number != 10**9:
        with pytest.raises(DocumentError, match=r"published\.json' is damaged"):
            publisher.publish()
    path.write_text(kept)
    assert not publisher.publish().names("published")


@pytest.mark.parametrize("number", [10**12 - 1, 10**12, 10**30, "many", None, True, 0])
def test_a_thief_with_all_keys_who_counts_releases_up(publisher: Home, number: object) -> None:
    thief = Thief(publisher, publisher.pub, *ROLES)
    archive, _ = thief.archive("r1")
    thief.put("r1", archive, number)  # type: ignore[arg-type]
    before = snapshot(publisher.root)
    for said in (False, True):
        with pytest.raises(KeystoreError) as refused:
            publisher.publish(restored=said)
        assert len(str(refused.value).replace(str(publisher.folder), "")) < 500
    assert snapshot(publisher.root) == before


@pytest.mark.parametrize("version", [10**12 - 1, 10**12, 10**300])
def test_a_thief_with_all_keys_who_counts_versions_up(publisher: Home, version: int) -> None:
    thief = Thief(publisher, publisher.pub, *ROLES)
    thief.sign("timestamp", lambda _signed: None, version)
    before = snapshot(publisher.root)
    with pytest.raises(KeystoreError, match=r"too high|not a number from 1 to"):
        publisher.publish()
    assert snapshot(publisher.root) == before
    shutil.rmtree(publisher.pub)
    publisher.publish(new_folder=True)


def test_a_forged_timestamp_is_refused_without_unpacking_everything(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever runs the web server can write archives that unpack to much more."""
    publisher.publish()
    timestamp = publisher.pub / "metadata/timestamp.json"
    earlier = timestamp.read_bytes()
    publisher.publish()
    last = timestamp.read_bytes()
    for data, why in ((last, ""), (earlier, "has older metadata"), (last, "")):
        timestamp.write_bytes(data)
        publication = fleet_status(OpenedKeystore(publisher.root)).publication
        assert publication and why in publication.refused and bool(why) == bool(publication.refused)
    forged = json.loads(timestamp.read_bytes())
    forged["signed"]["version"] += 1
    timestamp.write_text(json.dumps(forged))
    for number in range(2):
        archive = gzip.compress(bytes(2**20 + number))
        name = f"{hashlib.sha256(archive).hexdigest()}.r1.tar.gz"
        (publisher.pub / "targets/robots" / name).write_bytes(archive)
    read: list[bytes] = []
    monkeypatch.setattr(published, "_MEAN_ARCHIVE_BYTES", 1024)
    monkeypatch.setattr(published, "read_release", read.append)
    publication = fleet_status(OpenedKeystore(publisher.root)).publication
    assert publication and "metadata that this keystore did not write" in publication.refused
    assert not publication.as_seen_at(publisher.now).is_in_order and not read
    ended = sros("fleet", "status", "ks", cwd=publisher.folder)
    assert "the published files do not verify" in ended.out and ended.status == 1
    with pytest.raises(KeystoreError, match=r"more than 0 MiB \(unpacked\) of archives") as refused:
        publisher.publish()
    assert "move" in refused.value.remedy and "--new-folder" in refused.value.remedy
    publisher.pub.rename(publisher.folder / "away")
    assert publisher.publish(new_folder=True).names("published") == ["r1", "r2", "r5"]


def test_damaged_archives_do_not_count_as_huge(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last bytes of an archive state its size; in a damaged archive, they state anything."""
    publisher.publish()
    first, *others = (publisher.pub / "targets/robots").glob("*.tar.gz")
    most = sum(stated_size(archive.read_bytes()) for archive in (first, *others))
    count = published._ARCHIVES_OF_FLEET + 3 * published._ARCHIVES_OF_ROBOT
    monkeypatch.setattr(published, "_MEAN_ARCHIVE_BYTES", most // count + 1)
    for archive in others:
        archive.write_bytes(archive.read_bytes() + b"x\n")
    timestamp = publisher.pub / "metadata/timestamp.json"
    forged = json.loads(timestamp.read_bytes())
    forged["signed"]["version"] += 1
    timestamp.write_text(json.dumps(forged))
    damaged = sorted(archive.name.split(".")[1] for archive in others)
    with pytest.raises(KeystoreError, match="metadata that this keystore did not write") as refused:
        publisher.publish(restored=True)
    assert refused.value.remedy.startswith("If the keystore was restored from a backup, first")
    assert (
        f"archives of these robots are missing or changed, too: {', '.join(damaged)}"
        in refused.value.why
    )
    result = publisher.publish()
    assert result.altered == [*(f"robots/{robot}.tar.gz" for robot in damaged), "metadata"]
    assert result.names("published") == damaged


def test_a_publishing_folder_that_was_lost(publisher: Home) -> None:
    """Versions go on, and archives come again under later numbers."""
    robot, before = publisher.robot(), numbers(publisher)
    publisher.publish(rotate=("timestamp",))
    robot.gets()
    shutil.rmtree(publisher.pub)
    kept = snapshot(publisher.root)
    for restored in (False, True):
        with pytest.raises(KeystoreError, match="has nothing that the keystore") as refused:
            publisher.publish(restored=restored)
        assert "--new-folder" in refused.value.remedy
    assert snapshot(publisher.root) == kept
    assert publisher.publish(new_folder=True).names("published") == ["r1", "r2", "r5"]
    assert all(number > before[robot] for robot, number in numbers(publisher).items())
    assert robot.gets() == publisher.robot().gets()
    assert not publisher.publish(new_folder=True).names("published")


def test_two_folders_in_turn(publisher: Home, tmp_path: Path) -> None:
    """Robots can fetch from each folder that was published, also where the last one is not here."""
    robot, stick, pub = publisher.robot(), tmp_path / "stick", publisher.pub
    publish(publisher.root, stick, now=publisher.now, new_folder=True)
    release = robot.gets(stick)
    result = publisher.publish()
    assert (result.names("kept"), result.notes) == (["r1", "r2", "r5"], ())
    assert robot.gets() == release
    publisher.run("renew", "ks", "/r1/base")
    assert publisher.publish().names("published") == ["r1"]
    pub.rename(tmp_path / "elsewhere")
    publish(publisher.root, stick, now=publisher.now + LATER)
    assert robot.gets(stick, now=publisher.now + LATER).number > release.number
    (tmp_path / "elsewhere").rename(pub)
    publisher.run("revoke", "ks", "--robot", "r1")
    assert publisher.publish(2 * LATER).names("removed") == ["r1"]
    publisher.robot("r2").gets()


def test_a_refused_robot_in_another_folder(publisher: Home, tmp_path: Path) -> None:
    """The metadata names no archive that is not there."""
    stick = tmp_path / "stick"
    publish(publisher.root, stick, now=publisher.now, new_folder=True)
    (publisher.root / "enclaves/r1/base/permissions.p7s").write_bytes(b"x")
    shutil.rmtree(stick)
    result = publisher.publish()
    assert [(robot.robot, robot.number) for robot in result.robots if robot.why] == [("r1", None)]
    publisher.robot("r1").refuses(FetchProblem.NOT_FOR_ROBOT)
    publisher.robot("r2").gets()


def test_a_publishing_folder_that_lost_metadata(publisher: Home) -> None:
    robot = publisher.robot()
    next(publisher.pub.glob("metadata/*.targets.json")).unlink()
    with pytest.raises(KeystoreError, match=r"targets\.json', which robots fetch, is") as refused:
        publisher.publish()
    assert f"remove '{publisher.pub}/metadata', and publish again with --new-folder" in str(
        refused.value
    )
    shutil.rmtree(publisher.pub / "metadata")
    publisher.publish(new_folder=True)
    robot.gets()


def test_what_the_timestamp_would_lead_to_is_not_there(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = publisher.robot().gets()
    publisher.run("renew", "ks", "/r1/base")
    put = publishing._put_file
    with monkeypatch.context() as patched:
        patched.setattr(
            publishing,
            "_put_file",
            lambda folder, path, data: path.endswith(".snapshot.json") or put(folder, path, data),
        )
        with pytest.raises(KeystoreError, match=r"lacks metadata/[0-9]+\.snapshot\.json, which"):
            publisher.publish()
    assert publisher.robot().gets() == before
    publisher.publish()
    assert publisher.robot().gets().number > before.number


@pytest.mark.parametrize("backup_published", [False, True])
def test_a_folder_without_metadata_has_releases_that_the_keystore_does_not_know(
    publisher: Home, backup_published: bool
) -> None:
    """Publishing there would bring back a robot that was revoked after the backup."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    if not backup_published:
        forget_publishing(backup)
    publisher.run("revoke", "ks", "--robot", "r5")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    if backup_published:
        shutil.rmtree(publisher.pub / "metadata")
    before = snapshot(publisher.root)
    for new_folder in (False, True):
        with pytest.raises(KeystoreError, match="has releases of r1, r2 that the") as refused:
            publisher.publish(new_folder=new_folder)
        remedy = refused.value.remedy
        words = ("fleet collect", "sros revoke", "/metadata'", "--restored --new-folder")
        assert [remedy.index(word) for word in words] == sorted(map(remedy.index, words))
        assert ("agent init --force" in remedy) is not backup_published
        shutil.rmtree(publisher.pub / "metadata", ignore_errors=True)
    assert snapshot(publisher.root) == before
    done = publisher.publish(restored=True, new_folder=True)
    assert done.notes[0].id == "fleet.revocations-restored" and "/r5/base" in done.notes[0].text
    publisher.robot().gets()
    publisher.robot("r5").refuses(FetchProblem.NOT_FOR_ROBOT)


def test_a_restore_in_which_nothing_shows_what_was_revoked_says_since_when(
    publisher: Home,
) -> None:
    """A robot that was stolen after the backup would be trusted without a word."""
    shutil.rmtree(publisher.pub)
    last = OpenedKeystore(publisher.root).ledger_file.last_time()
    assert last
    note, of_root = publisher.publish(restored=True, new_folder=True).notes
    assert (note.id, of_root.id) == ("fleet.revocations-not-shown", "fleet.root-not-seen")
    assert (
        f"which rights were taken away, after {iso(last)} (the last entry of the ledger)"
        in note.text
    )
    assert note.text.index("fleet collect ") < note.text.index("`sros revoke ")
    assert not publisher.publish().notes


@pytest.mark.parametrize("has_metadata", [False, True])
def test_a_restored_keystore_publishes_to_no_other_folder(
    publisher: Home, tmp_path: Path, has_metadata: bool
) -> None:
    """The last folder shows that it is older; a change of folder would hide that."""
    stick = tmp_path / "stick"
    if has_metadata:
        publish(publisher.root, stick, now=publisher.now, new_folder=True)
    publisher.publish()
    backup = copy_of(publisher.root, publisher.folder / "backup")
    publisher.run("revoke", "ks", "--robot", "r5")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    before = snapshot(publisher.root)
    for restored in (False, True):
        with pytest.raises(
            KeystoreError, match=r"'.*pub' has later releases of r1, r2 than"
        ) as refused:
            publish(
                publisher.root,
                stick,
                now=publisher.now,
                restored=restored,
                new_folder=not has_metadata,
            )
        assert f"`sros fleet publish {publisher.root} {publisher.pub}`" in refused.value.remedy
    assert snapshot(publisher.root) == before
    publisher.publish(restored=True)
    publish(publisher.root, stick, now=publisher.now, new_folder=not has_metadata)
    publisher.robot("r5").refuses(FetchProblem.NOT_FOR_ROBOT, stick)
    publisher.robot("r1").gets(stick)


def test_damaged_metadata_after_a_completed_restore_shows_no_other_restore(
    publisher: Home,
) -> None:
    """The folder still has releases of before; but what is lost in a second restore counts."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    publisher.run("revoke", "ks", "--robot", "r5")
    publisher.run("renew", "ks", "--all")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    publisher.publish(restored=True)
    second = copy_of(publisher.root, publisher.folder / "second")
    publisher.run("renew", "ks", "--all")
    publisher.publish()
    for file in publisher.pub.glob("metadata/*.robots-*.json"):
        file.write_bytes(file.read_bytes().replace(b'"length"', b'"lengtn"'))
    with pytest.raises(KeystoreError) as refused:
        publish(second, publisher.pub, now=publisher.now)
    assert "The keystore was restored" in refused.value.why
    assert "--restored" in refused.value.remedy
    assert publisher.publish().altered == ["metadata"]
    shutil.rmtree(publisher.pub / "metadata")
    with pytest.raises(KeystoreError, match="sealed but does not know"):
        publish(second, publisher.pub, now=publisher.now, new_folder=True)
    assert publisher.publish(new_folder=True).names("published") == ["r1", "r2"]


def test_all_unknown_releases_in_a_folder_without_metadata_revoke(publisher: Home) -> None:
    """Also if the last one is of another copy of the keystore, which revoked nothing."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    copy = copy_of(publisher.root, publisher.folder / "copy")
    for _ in range(2):
        publisher.run("renew", copy, "--all")
    publisher.run("fleet", "publish", copy, "other", "--new-folder")
    publisher.run("revoke", "ks", "--robot", "r5")
    publisher.publish()
    shutil.copytree(
        publisher.folder / "other/targets", publisher.pub / "targets", dirs_exist_ok=True
    )
    shutil.rmtree(publisher.pub / "metadata")
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    done = publisher.publish(restored=True, new_folder=True)
    assert done.notes[0].id == "fleet.revocations-restored" and "/r5/base" in done.notes[0].text


def test_releases_of_a_later_ca_in_a_folder_without_metadata(publisher: Home) -> None:
    backup = copy_of(publisher.root, publisher.folder / "backup")
    forget_publishing(backup)
    publisher.run("rotate_ca", "ks", "--finish", "--allow-unconfirmed")
    shutil.rmtree(publisher.pub / "metadata")
    publisher.publish(new_folder=True)  # the ledger has the releases of the earlier CA
    shutil.rmtree(publisher.pub)
    publisher.publish(new_folder=True)
    shutil.rmtree(publisher.pub / "metadata")
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    for restored in (False, True):
        with pytest.raises(KeystoreError, match=r"no CA of .* sealed: r1, r2, r5\."):
            publisher.publish(restored=restored, new_folder=True)


def test_keystore_and_folder_that_were_lost(publisher: Home) -> None:
    """What home gave after the backup, and nobody there knows, is never given twice."""
    backup = copy_of(publisher.root, publisher.folder / "backup")
    robot = publisher.robot()
    for _ in range(3):
        publisher.run("renew", "ks", "--all")
        publisher.publish()
    latest = robot.gets()
    shutil.rmtree(publisher.pub)
    for again in (False, True):
        shutil.rmtree(publisher.root)
        copy_of(backup, publisher.root)
        if again:  # numbers would come to those of the first home
            (publisher.root / "published.json").unlink()
        publisher.run("revoke", "ks", "--robot", "r5")
        publisher.publish(restored=True, new_folder=True)
        publisher.run("renew", "ks", "--all")
        publisher.publish()
        release = robot.gets()
        assert release.number > latest.number + 1000 * (not again), "in one step"
        latest = release
        publisher.robot("r5").refuses(FetchProblem.NOT_FOR_ROBOT)
        assert [e.what for e in OpenedKeystore(publisher.root).ledger.entries].count(
            "restored"
        ) == 1
        shutil.rmtree(publisher.pub)


def test_keystore_and_folder_from_one_backup(publisher: Home) -> None:
    """Robots have seen later versions of metadata that the restored releases do not change."""
    fleet, places = publisher.folder / "fleet.toml", (publisher.root, publisher.pub)
    generate = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    with_all, backups = fleet.read_text(), list[Path]()
    for text in ("[robots.r1]\n", with_all):  # without r2 and r5, one list of robots is empty
        backups = [
            copy_of(place, publisher.folder / f"{len(text)}{place.name}") for place in places
        ]
        fleet.write_text(text)
        publisher.run(*generate)
        publisher.publish()
    robot = publisher.robot()
    robot.gets()
    for place, backup in zip(places, backups, strict=True):
        shutil.rmtree(place)
        backup.rename(place)
    publisher.publish()  # the timestamp gets the version that the robot has seen
    robot.refuses(FetchProblem.ROLLED_BACK)
    publisher.publish(restored=True, new_folder=True)
    robot.gets()


@pytest.mark.parametrize("at", ["metadata", "targets", "targets/robots", "metadata/timestamp.json"])
def test_links_and_pipes_in_a_publishing_folder_lead_nowhere(publisher: Home, at: str) -> None:
    place, kept = publisher.pub / at, publisher.folder / "kept"
    place.rename(kept)
    outside = publisher.folder / "outside"
    outside.mkdir()
    for is_link in (True, False):
        if is_link:
            place.symlink_to(outside)
        else:
            os.mkfifo(place)
        with pytest.raises((KeystoreError, OSError)):
            publisher.publish()
        place.unlink()
    assert not [*outside.iterdir()]
    kept.rename(place)
    publisher.publish()


def test_metadata_that_cannot_be_read_is_not_called_that_of_another(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_folder: Folder, path: str, **_: object) -> bytes:
        raise PermissionError(errno.EACCES, "Permission denied", path)

    monkeypatch.setattr(Folder, "read", refuse)
    with pytest.raises(KeystoreError, match=r"the metadata in '.*' cannot be read. .* denied"):
        read_present(publisher.pub, Roots())


def test_the_folder_of_another_keystore(publisher: Home) -> None:
    forget_publishing(publisher.root)
    before = snapshot(publisher.folder)
    with pytest.raises(KeystoreError, match="did not write"):
        publisher.publish()
    assert snapshot(publisher.folder) == before


def test_damaged_metadata_and_lists_are_said(publisher: Home) -> None:
    for path in (publisher.pub / "metadata/1.targets.json", publisher.root / "published.json"):
        kept = path.read_bytes()
        endless = b'{"robots": {}, "versions": {"timestamp": 1e999}}'
        for damaged in (b"", b"{}", b"[" * 100_000, b'{"robots": [1]}', endless):
            path.write_bytes(damaged)
            with pytest.raises((KeystoreError, DocumentError)):
                publisher.publish()
        path.write_bytes(kept)
    publisher.publish()


def test_restored_is_refused_where_nothing_shows_a_restore(publisher: Home) -> None:
    """As where a web server has an old copy: it mends nothing, and marks the ledger."""
    ledger = (publisher.root / "ledger.jsonl").read_bytes()
    with pytest.raises(KeystoreError, match=r"nothing shows that the keystore .* was restored"):
        publisher.publish(restored=True)
    assert (publisher.root / "ledger.jsonl").read_bytes() == ledger
    backup = copy_of(publisher.root, publisher.folder / "backup")
    publisher.publish()  # only the timestamp is later
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]


@pytest.mark.parametrize(
    ("roles", "has_key"),
    [(("identity",), False), (("permissions",), True), (ROLES_OF_CAS, False), (ROLES_OF_CAS, True)],
)
def test_a_restored_keystore_never_brings_back_a_ca_that_was_replaced(
    publisher: Home, roles: tuple[str, ...], has_key: bool
) -> None:
    """The CA may have been replaced because somebody has its key; one refusal names each CA."""
    keys = {role: publisher.folder / f"later_{role}.key.pem" for role in roles}

    def authorities() -> dict[str, bytes]:
        files = read_release(archives(publisher)["r1"]).files
        return {role: files[f"enclaves/r1/base/{role}_ca.cert.pem"] for role in roles}

    def replace_cas(existing: dict[str, bytes]) -> None:
        publisher.now += LATER
        rotate_ca(
            publisher.root,
            roles=roles,
            now=publisher.now,
            finish=True,
            new_keys=Keyring(places={role: f"file:{keys[role]}" for role in existing}),
            existing=existing,
            allow_unconfirmed=True,
        )

    backup = copy_of(publisher.root, publisher.folder / "backup")
    replace_cas({})
    publisher.publish()
    for role, key in keys.items():
        shutil.copy(publisher.root / ca_key_path(role), key)
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    later = authorities()
    before = snapshot(publisher.folder)
    names = " and ".join(f"the {role} CA" for role in roles)
    with pytest.raises(KeystoreError, match=rf"{names} (was|were) replaced after") as said:
        publisher.publish(restored=True)
    flags = f" --{roles[0]}" if len(roles) == 1 else ""
    assert f"`sros rotate_ca {publisher.root}{flags} --finish" in said.value.remedy
    assert " ".join(f"--{each}-ca FILE --{each}-key PLACE" for each in roles) in said.value.remedy
    assert ("by hand" in said.value.remedy) is ("permissions" in roles)
    assert snapshot(publisher.folder) == before
    replace_cas(later if has_key else {})
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]
    assert (authorities() == later) is has_key


def test_a_rotation_names_all_revoked_enclaves_of_a_backup_at_once(publisher: Home) -> None:
    backup = copy_of(publisher.root, publisher.folder / "backup")
    revoke(publisher.root, ["/r2/base", "/r5/base"], now=publisher.now)
    for robot in ("r2", "r5"):
        copy_of(backup / f"enclaves/{robot}", publisher.root / f"enclaves/{robot}")
    before = snapshot(publisher.root)
    rotate = ("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    said = sros(*rotate, cwd=publisher.folder).err
    assert "/r2/base, /r5/base cannot be moved to the new CA" in said
    assert "`sros revoke ks /r2/base /r5/base`" in said
    assert "`sros renew ks /r2/base /r5/base --new-key --revoke-old`" in said
    assert snapshot(publisher.root) == before
    publisher.run("revoke", "ks", "/r2/base", "/r5/base")
    publisher.run(*rotate)


@pytest.mark.parametrize("has_new_ca", [True, False])
def test_a_robot_that_began_to_make_its_keys_after_the_backup_keeps_its_key(
    publisher: Home, has_new_ca: bool
) -> None:
    """The backup has an earlier key of the enclave, and the command for it would make another."""
    rotate = ("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    policy = ("-p", "policy.xml", "--fleet", "fleet.toml", "--enclave", "/r2/base")
    backup = copy_of(publisher.root, publisher.folder / "backup")
    request = create_request(publisher.folder / "robot", "/r2/base").file
    sign = ("sign_request", "ks", request, "--no-answer")
    if has_new_ca:
        publisher.run("revoke", "ks", "--robot", "r2")
        publisher.run(*sign, *policy)
        publisher.run(*rotate)
    else:
        data = request.read_bytes()
        certify_requests(publisher.root, data, renew=True, replace_keys=True, now=publisher.now)
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    if has_new_ca:
        publisher.run(*rotate)
    with pytest.raises(KeystoreError, match=r"keys of /r2/base were replaced") as refused:
        publisher.publish(restored=True)
    root = publisher.root
    remedy = refused.value.remedy
    assert remedy.startswith("If a robot made its key, sign its request again, with `sros sign_req")
    assert f"REQUEST --no-answer --renew`, and run `sros renew {root} /r2/base --revoke" in remedy
    said = sros(*sign, "--renew", cwd=publisher.folder)
    assert ("has another key in keystore" in said.err) is has_new_ca
    if has_new_ca:
        assert "`sros revoke ks /r2/base`" in said.err and "with --enclave /r2/base" in said.err
        publisher.run("revoke", "ks", "--robot", "r2")
        publisher.run(*sign, *policy)
    else:
        publisher.run("renew", "ks", "/r2/base", "--revoke-old")
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]
    certificate = OpenedKeystore(root).certificate_of("/r2/base")
    wanted = load_request(request.read_bytes(), "it").public_key
    assert certificate.public_key() == wanted


@pytest.mark.parametrize("roles", [("--identity",), ("--identity", "--permissions")])
@pytest.mark.parametrize("is_replaced", [True, False])
def test_a_key_that_was_replaced_after_a_rotation_is_not_certified_again(
    publisher: Home, is_replaced: bool, roles: tuple[str, ...]
) -> None:
    """The new certificate is from a CA that the keystore has lost, as is what that CA revoked."""

    def rotate() -> None:
        rotate_ca(
            publisher.root,
            roles=["identity"],
            finish=True,
            allow_unconfirmed=True,
            now=publisher.now,
        )

    def replace() -> None:
        renew(
            publisher.root,
            ["/r2/base"],
            new_key=is_replaced,
            revoke_old=is_replaced,
            now=publisher.now,
        )

    publisher.publish()
    backup = copy_of(publisher.root, publisher.folder / "backup")
    rotate()
    publisher.publish()
    replace()
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    rotate()
    if is_replaced:
        for _ in range(2):
            with pytest.raises(KeystoreError, match="after the backup, the keys of /r2/base"):
                publisher.publish(restored=True)
        replace()
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]


def test_a_key_that_was_replaced_is_found_where_all_certificates_begin_at_a_fixed_date(
    publisher: Home,
) -> None:
    root, name = publisher.root, "/r2/base"
    validity = f"certificates.validity={iso(publisher.now - DAY / 2)}/90d"
    publisher.run("update_keystore", "ks", "--set", validity)

    def replace(*, revoke_old: bool = False) -> None:
        renew(root, [name], new_key=True, revoke_old=revoke_old, now=publisher.now)
        begins.add(validity_of(OpenedKeystore(root).certificate_of(name)).not_before)

    begins: set[datetime] = set()
    replace()
    publisher.publish()
    backup = copy_of(root, publisher.folder / "backup")
    replace()
    publisher.publish()
    shutil.rmtree(root)
    backup.rename(root)
    with pytest.raises(KeystoreError, match=f"the keys of {name} were replaced"):
        publisher.publish(restored=True)
    publisher.now += LATER
    replace(revoke_old=True)
    assert len(begins) == 1
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]


_ORDERS = [
    "restored, generate!, sign, generate",
    "generate!, restored, sign, generate",
    "name, restored!, old!, generate old!, sign again, old, restored",
    "name, restored!, sign again, restored, old",
    "name, new, restored!, sign again, old, restored",
    "lost, generate, collect, restored!, sign again, old, restored",
    "lost, generate, restored, collect, old!, deliver!, sign again, old",
    "lost, seen, generate!, sign, generate, restored",
    "lost, seen, name, collect, restored!, sign again, old, restored",
]
"""Commands of an operator after a restore; ``!`` stands for a refusal.

After "seen", only the seal of another robot has shown that the keystore was restored.
"""


@pytest.mark.parametrize("order", _ORDERS)
def test_a_restored_keystore_replaces_no_key_that_a_robot_made(
    publisher: Home, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot came after the backup; only its release and its requests have its keys.

    A message shows only the certificate of one enclave.
    """
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    root, fleet, names = publisher.root, publisher.folder / "fleet.toml", ["/r9/arm", "/r9/base"]
    policy = ("-p", "policy.xml", "--fleet", "fleet.toml")
    generate = ("generate_artifacts", "-k", "ks", *policy)
    rights = {f"/{{robot}}/{each}": allow_publish("x") for each in ("arm", "base")}
    (publisher.folder / "policy.xml").write_text(policy_text(rights))
    publisher.run(*generate)
    publisher.publish()  # so that the backup records the folder
    backup = copy_of(root, publisher.folder / "backup")
    fleet.write_text(f"{fleet.read_text()}[robots.r9]\n")
    sent = publisher.folder / "requests"
    requests = [create_request(publisher.folder / "r9", each).file for each in names]
    sent.write_bytes(b"".join(request.read_bytes() for request in requests))
    sign = ("sign_request", "ks", sent, "--no-answer")
    publisher.run(*sign, *policy)
    publisher.run(*generate)
    publisher.publish()
    later = OpenedKeystore(root).certificate_of(names[1])
    shutil.rmtree(root)
    backup.rename(root)
    lost = order.startswith("lost")
    if lost:
        shutil.rmtree(publisher.pub)

    request_again = f"sign its request again, with `sros sign_request {root} REQUEST --no-answer"
    mend = f"{request_again} --renew`, and run `sros renew {root} /r9/arm /r9/base --revoke-old`"
    commands = {
        "restored": ("fleet", "publish", "ks", "pub", "--restored", *["--new-folder"] * lost),
        "generate": generate,
        "generate old": (*generate, "--revoke-old"),
        "name": (*generate, "-e", *names),
        "new": ("renew", "ks", *names, "--new-key", "--revoke-old"),
        "deliver": ("distribute_key", "ks", "--robot", "r9", "r9", "--force"),
        "old": ("renew", "ks", *names, "--revoke-old"),
        "sign": (*sign, *policy),
        "sign again": (*sign, "--renew"),
    }
    keys = [key_digest(load_request(file.read_bytes(), "it").public_key) for file in requests]
    made = set[str]()
    for step in order.removeprefix("lost, ").split(", "):
        publisher.now += LATER
        if step in ("collect", "seen"):
            shown = LostRecords(OpenedKeystore(root), publisher.now)
            if step == "collect":
                shown.add_certificate(later)
            reason = LATER_RELEASE * (step == "seen")
            restored = restore_revocations(root, shown, shown_by=reason, now=publisher.now)
            for note in (note.text for note in restored.notes):
                assert mend in note and "other keys for /r9/arm, /r9/base than the keystore" in note
            assert len(restored.notes) == (step == "collect")
            continue
        done = sros(*commands[step.removesuffix("!")], cwd=publisher.folder)
        assert done.status == (2 if step.endswith("!") else 0), (step, done.err)
        if step.endswith("!") and "generate" not in step:
            assert mend.replace(str(root), "ks") in done.err, (step, done.err)
        for name in names:
            if (root / f"enclaves{name}/key.pem").exists():
                certificate = OpenedKeystore(root).certificate_of(name)
                made.add(key_digest(certificate.public_key()))  # type: ignore[arg-type]
    assert not [*root.glob("enclaves/r9/*/key.pem")]
    publisher.publish()
    files = read_release(archives(publisher)["r9"]).files
    for name, key in zip(names, keys, strict=True):
        certificate = x509.load_pem_x509_certificate(files[f"enclaves{name}/cert.pem"])
        assert key_digest(certificate.public_key()) == key  # type: ignore[arg-type]
    known = KnownKeys(OpenedKeystore(root))
    assert not any(map(known.is_revoked, keys)) and all(map(known.is_revoked, made))


def test_a_restored_keystore_makes_no_keys_for_a_robot_that_a_lost_ca_certified(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ledger never records the certificates of this robot: only releases show its enclave."""
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    root, policy = publisher.root, ("-p", "policy.xml", "--fleet", "fleet.toml")
    rotate = ("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    generate = ("generate_artifacts", "-k", "ks", *policy)
    (publisher.folder / "policy.xml").write_text(policy_text({"/{robot}/arm": allow_publish("x")}))
    publisher.run(*generate)
    publisher.publish()
    backup = copy_of(root, publisher.folder / "backup")
    publisher.run(*rotate)
    fleet = publisher.folder / "fleet.toml"
    fleet.write_text(f"{fleet.read_text()}[robots.r9]\n")
    request = create_request(publisher.folder / "r9", "/r9/arm").file
    sign = ("sign_request", "ks", request, "--no-answer", *policy)
    publisher.run(*sign)
    publisher.run(*generate)
    publisher.run("renew", "ks", "/r1/base", "--new-key", "--revoke-old")
    publisher.publish()
    shutil.rmtree(root)
    backup.rename(root)
    publisher.now += LATER
    publisher.run(*rotate)
    restore = ("fleet", "publish", "ks", "pub", "--restored")
    new_key = ("renew", "ks", "/r1/base", "--new-key", "--revoke-old")
    for command, status in (((), 0), (restore, 2), (new_key, 0), (restore, 0)):
        if command:
            assert sros(*command, cwd=publisher.folder).status == status
        refused = sros(*generate, cwd=publisher.folder)
        assert (refused.status, (root / "enclaves/r9").exists()) == (2, False), refused
        assert "would create /r9/arm" in refused.err or "lacks /r9/arm, which got" in refused.err
    publisher.run(*sign)
    publisher.run(*generate)
    assert [*root.glob("enclaves/r9/*/*.pem")] and not [*root.glob("enclaves/r9/*/key.pem")]


def test_a_restored_keystore_names_a_stolen_robot_only_to_be_revoked(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The later identity CA, which alone lists the theft, is lost with the keystore."""
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    root, fleet = publisher.root, publisher.folder / "fleet.toml"
    rotate = ("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    backup, with_all = copy_of(root, publisher.folder / "backup"), fleet.read_text()
    publisher.run("renew", "ks", "--all", "--new-key", "--revoke-old")
    publisher.run(*rotate)
    publisher.publish()  # which leaves an archive of r2
    publisher.run("revoke", "ks", "--robot", "r2")
    fleet.write_text(with_all.replace("[robots.r2]\n", ""))
    publisher.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    publisher.publish()
    shutil.rmtree(root)
    backup.rename(root)
    publisher.now += LATER
    publisher.run(*rotate)
    refused = sros("fleet", "publish", "ks", "pub", "--restored", cwd=publisher.folder)
    assert refused.status == 2
    commands = re.findall(r"`(sros (?:renew|revoke) ks .*?)`", refused.err)
    assert [command for command in commands if "/r2/base" in command] == [
        "sros revoke ks /r2/base",
        "sros renew ks /r2/base --new-key --revoke-old",
    ], refused
    publisher.run(*commands[-2].split()[1:])
    fleet.write_text(with_all.replace("[robots.r2]\n", ""))
    publisher.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    publisher.run(*next(each for each in commands if "--new-key" in each).split()[1:])
    assert publisher.publish(restored=True).names("published") == ["r1", "r5"]


def test_a_restored_keystore_makes_no_other_key_for_a_router(publisher: Home) -> None:
    """No policy names its enclave."""
    root, fleet = publisher.root, publisher.folder / "fleet.toml"
    generate = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    publisher.run("zenoh", "ks", "--endpoint", "office.local:7447")
    publisher.publish()
    backup = copy_of(root, publisher.folder / "backup")
    fleet.write_text(f"{fleet.read_text()}[robots.r9]\nrouter = 'r9.local:7447'\n")
    publisher.run(*generate)
    publisher.publish()
    shutil.rmtree(root)
    backup.rename(root)
    publisher.publish(restored=True)
    refused = sros(*generate, "-e", "/r9/base", cwd=publisher.folder)
    assert "lacks /r9/router, which got certificates after the last backup" in refused.err
    assert "FLEET_FILE` (for a router, without -p and --fleet)." in refused.err
    publisher.run(*generate, "-e", "/r9/base", "/r9/router")


def test_a_later_key_of_a_robot_is_certified_again_as_publishing_advises(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Publishing records the certificate of this key, so that `revoke` would revoke the key."""
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    root, name = publisher.root, "/r2/base"
    files = [create_request(publisher.folder / each, name).file for each in ("first", "second")]
    first, second = (file.read_bytes() for file in files)
    revoke(root, [name], now=publisher.now)
    sign_request(root, first, only_enclaves=[name], now=publisher.now)
    publisher.publish()
    backup = copy_of(root, publisher.folder / "backup")
    sign_request(root, second, renew=True, now=publisher.now)
    publisher.publish()
    shutil.rmtree(root)
    backup.rename(root)
    with pytest.raises(KeystoreError, match=f"the keys of {name} were replaced") as said:
        publisher.publish(restored=True)
    mend, _, _ = said.value.remedy.partition(" The keystore was changed already: ")
    commands = re.findall(r"`sros ([^`]+)`", mend)
    earlier = [command.replace("REQUEST", str(files[0])).split() for command in commands]
    newest = key_digest(load_request(second, "it").public_key)
    assert "agent run" in mend and f" is {newest}" in sros(*earlier[0], cwd=publisher.folder).err
    assert "Do none of this for robots that were stolen or removed: revoke them." in mend
    another = f"the keystore has another key of enclave {name} than its robot"
    assert another in sros(*earlier[1], cwd=publisher.folder).err
    for command in commands:
        publisher.run(*command.replace("REQUEST", str(files[1])).split())
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]
    known = KnownKeys(OpenedKeystore(root))
    keys = (key_digest(load_request(each, "it").public_key) for each in (first, second))
    assert [known.is_revoked(key) for key in keys] == [True, False]


def test_a_revoked_key_that_a_robot_made_is_replaced_on_the_robot(publisher: Home) -> None:
    """The certificate was renewed with --revoke-old after the backup, and the key stayed."""
    root, name = publisher.root, "/r2/base"
    files = [create_request(publisher.folder / each, name).file for each in ("first", "second")]
    revoke(root, [name], now=publisher.now)
    sign_request(root, files[0].read_bytes(), only_enclaves=[name], now=publisher.now)
    publisher.publish()
    backup = copy_of(root, publisher.folder / "backup")
    renew(root, [name, "/r1/base"], revoke_old=True, now=publisher.now)
    lost = LostRecords(OpenedKeystore(backup), publisher.now)
    lost.add((root / "public/identity_ca.crl.pem").read_bytes())
    shutil.rmtree(root)
    backup.rename(root)
    done = restore_revocations(root, lost, now=publisher.now)
    (note,) = (each.text for each in done.notes if each.id == "fleet.replaced-after-backup")
    renewal = f"run `sros renew {root} /r1/base --new-key --revoke-old`"
    assert f"new certificates: {renewal}. For keys that were made on the robot, first" in note
    assert f"`sros renew {root} {name} --revoke-old`" in note, "the same as when publishing"
    _, *revoked = sros("crl", root, cwd=publisher.folder).out.splitlines()
    assert {line.split()[-1] for line in revoked} == {name, "/r1/base"}
    with pytest.raises(KeystoreError, match="was revoked"):
        sign_request(root, files[0].read_bytes(), renew=True, now=publisher.now)
    sign_request(root, files[1].read_bytes(), renew=True, now=publisher.now)
    renew(root, [name], revoke_old=True, now=publisher.now)


@pytest.mark.parametrize(
    "way", ["sign the present policy", "renew", "renewed before", "with the certificates"]
)
def test_a_right_that_was_taken_away_after_the_backup_does_not_come_back_in_silence(
    publisher: Home, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)

    def sign(*topics: str) -> None:
        text = policy_text({"/{robot}/base": allow_publish(*topics)})
        (publisher.folder / "policy.xml").write_text(text)
        publisher.run("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")

    sign("x", "cmd")
    publisher.publish()
    backup = copy_of(publisher.root, publisher.folder / "backup")
    sign("x")
    if way == "with the certificates":
        publisher.run("renew", "ks", "--all", "--revoke-old")
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    again = ("renew", "ks", "/r1/base", "/r2/base", "/r5/base")
    if way == "renewed before":  # nobody has named the rights yet
        publisher.run("renew", "ks", "--all")
    for _ in range(1 + (way == "with the certificates")):
        with pytest.raises(KeystoreError, match=r"rights of /r1/base, .* were taken away") as said:
            publisher.publish(restored=True)
        assert "(/{robot}/base: publish topic /cmd (all 3 robots))" in str(said.value)
        assert len(f"{said.value.what} {said.value.why}".replace(str(publisher.pub), "pub")) < 400
        assert f"`sros {' '.join(again)}`".replace(" ks ", f" {publisher.root} ") in str(said.value)
        assert "is older than its robots" in sros("renew", publisher.root, "--all").err
        with pytest.raises(KeystoreError, match="restored from a backup"):
            publisher.publish()
        if way == "with the certificates" and "certificates of /r1/base" in str(said.value):
            assert "If the enclaves are to have" not in str(said.value)
            publisher.run(*again)  # as the error advises: it agrees to no right yet
    if way == "renew":  # other signatures agree to no right
        sign("x", "cmd", "y")
        publisher.run("rotate_ca", "ks", "--finish", "--allow-unconfirmed")
        with pytest.raises(KeystoreError, match=r"rights of /r1/base, .* were taken away"):
            publisher.publish(restored=True)
        publisher.run(*again)
    else:
        sign("x")
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]
    publisher.now += LATER
    publisher.run("renew", "ks", "--all")
    history = publisher.run("inspect", "ks", "--history").out.splitlines()
    last = [line for line in history if line.startswith(iso(publisher.now))]
    assert last and not any("renewed by name" in line for line in last)


def test_what_a_restored_keystore_cannot_know_is_not_published_in_silence(
    publisher: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lost archive, another governance, another domain, and enclaves of only one side."""
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    publisher.publish()
    backup = copy_of(publisher.root, publisher.folder / "backup")
    update = ("update_keystore", "ks", "--allow-looser", "--set", "protection.rtps=SIGN")
    publisher.run(*update, "--domain", "7")
    publisher.publish()
    number = numbers(publisher)["r2"]
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    shutil.rmtree(publisher.root / "enclaves/r5/base")
    (lost,) = (p for p in publisher.pub.glob("targets/robots/*.r2.tar.gz") if _number(p) == number)
    lost.write_bytes(b"x")
    for dry_run in (True, False):
        with pytest.raises(KeystoreError, match="the governance was changed") as refused:
            publisher.publish(restored=True, dry_run=dry_run)
    assert "rtps_protection_kind SIGN" in refused.value.what
    lacking = "lacks /r5/base, which robots have. If a robot made the key of such an enclave, sign"
    before, _, after = refused.value.remedy.partition(lacking)
    assert "sign_request" in after and "generate_artifacts" in after and "Sign" not in before
    assert "were taken away, or may have been (" in refused.value.what
    assert "/r2/base: not known, because the archive of the last release" in refused.value.what
    assert "/r1/base: domain 0" in str(refused.value).replace("/{robot}/base", "/r1/base")
    publisher.run("rotate_ca", "ks", "--finish", "--allow-unconfirmed")
    with pytest.raises(KeystoreError, match="the governance was changed"):
        publisher.publish(restored=True)
    publisher.run(*update)
    with pytest.raises(KeystoreError, match=r"the governance was changed .*7"):
        publisher.publish(restored=True)
    publisher.run(*update, "--domain", "7")
    with pytest.raises(KeystoreError, match="rights of /r2/base were taken") as refused:
        publisher.publish(restored=True)
    assert "governance" not in str(refused.value)
    publisher.run("renew", "ks", "/r2/base")
    done = publisher.publish(restored=True)
    assert [(e.change, e.enclave) for e in done.later] == [("missing", "/r5/base")]
    (note,) = (note.text for note in done.notes if note.id == "fleet.changed-after-backup")
    assert lacking in note and len(note.split()) < 70, note


@pytest.mark.parametrize(
    ("roles", "lags"), [(("--identity",), False), (("--identity",), True), ((), False)]
)
@pytest.mark.parametrize("kept", [True, False])
def test_an_enclave_that_was_revoked_after_the_backup_is_not_published_again(
    publisher: Home,
    roles: tuple[str, ...],
    lags: bool,
    kept: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A CA that the keystore has lost revoked it: the identity CA, or both CAs were replaced.

    Archives in the folder may still show the revoked certificate (``kept``), and the robot may have
    got no release since (``lags``).
    """
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: publisher.now)
    name = "/r5/arm"
    rotation = ("rotate_ca", *roles, "--finish", "--allow-unconfirmed")

    def run(verb: str, *words: str) -> None:
        publisher.now += LATER
        publisher.run(verb, "ks", *words)

    policy = policy_text({"/{robot}/base": allow_publish("x"), "/{robot}/arm": allow_publish("y")})
    (publisher.folder / "policy.xml").write_text(policy)
    sign = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--fleet", "fleet.toml")
    publisher.run(*sign)
    publisher.publish()
    backup = copy_of(publisher.root, publisher.folder / "backup")
    stolen = key_digest(OpenedKeystore(publisher.root).certificate_of(name).public_key())  # type: ignore[arg-type]
    run(*rotation)
    publisher.publish()
    if lags:
        run("renew", name)
        (publisher.root / "enclaves/r5/base/permissions.p7s").write_bytes(b"x")
    run("revoke", name)
    names = publisher.publish().names("refused")
    assert names == ["r5"] * lags
    if not kept:
        last = {read_release(data).number for data in archives(publisher).values()}
        lasting = {"r5": min(numbers(publisher).values())} if lags else {}
        for path in (publisher.pub / "targets/robots").iterdir():
            robot = path.name.split(".")[1]
            if _number(path) != lasting.get(robot, max(last)):
                path.unlink()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    with pytest.raises(KeystoreError, match="replaced after the backup"):
        publisher.publish(restored=True)
    run(*rotation)
    for _ in range(2):
        with pytest.raises(KeystoreError, match=r"/r5/arm.* may have been revoked") as refused:
            publisher.publish(restored=True)
        run("renew", name)  # with the key that may have been revoked
    assert f"sros revoke {publisher.root}" in refused.value.remedy
    run("revoke", name)
    for enclave in ("/r5/base",) * lags:
        run("renew", enclave, "--new-key", "--revoke-old")
    assert publisher.publish(restored=True).names("published") == ["r1", "r2", "r5"]
    release = read_release(archives(publisher)["r5"])
    assert [*release.enclaves()] == ["/r5/base"]
    assert KnownKeys(OpenedKeystore(publisher.root)).is_revoked(stolen)


@pytest.mark.parametrize("steps", [(0, 1), (1, 3)])
def test_a_restored_keystore_does_not_leave_a_later_stage_of_a_rotation(
    publisher: Home, steps: tuple[int, int]
) -> None:
    """It lacks the new CA, or still trusts the old one."""

    def rotate(times: int) -> None:
        for _ in range(times):
            publisher.now += LATER
            rotate_ca(publisher.root, roles=["identity"], now=publisher.now, allow_unconfirmed=True)

    rotate(steps[0])
    backup = copy_of(publisher.root, publisher.folder / "backup")
    rotate(steps[1] - steps[0])
    publisher.publish()
    shutil.rmtree(publisher.root)
    backup.rename(publisher.root)
    with pytest.raises(KeystoreError, match="the identity CA was replaced after the backup"):
        publisher.publish(restored=True)


def test_a_clock_that_was_set_back(publisher: Home) -> None:
    """Its own ledger lies in the future: nothing that is published now has the right dates."""
    before = snapshot(publisher.pub)
    with pytest.raises(KeystoreError, match=r"30 d behind the last entry of the ledger, of "):
        publisher.publish(-timedelta(days=30, hours=1))
    assert snapshot(publisher.pub) == before
    today = publisher.now + timedelta(days=30)
    change = KeystoreChange(publisher.root, now=today - timedelta(hours=5))
    with change:
        change.entries.append(Entry(iso(today), "x"))
        change.record()
        assert any("the clock of this machine shows" in note.text for note in change.notes)
    wrong = today - timedelta(hours=5)
    with KeystoreChange(publisher.root, now=wrong) as change:  # as by a timer that renews
        change.entries.append(Entry(iso(wrong), "x"))
        change.record()
        change.finish()
    assert "h 59 min behind" in OpenedKeystore(publisher.root).ledger_file.clock_clause(wrong)
    status = fleet_status(OpenedKeystore(publisher.root))
    assert not status.with_overdue(publisher.now + timedelta(days=30, minutes=30)).clock
    behind = status.with_overdue(publisher.now)
    assert "30 d behind" in behind.clock and not behind.complete
    with KeystoreChange(publisher.root, now=wrong) as change:  # as `crl --refresh` writes
        change.entries.append(Entry(iso(wrong), "crl"))
        change.record()
        change.finish()
    assert not OpenedKeystore(publisher.root).ledger_file.clock_clause(wrong)
    (publisher.root / "ledger.jsonl").write_text("damaged")
    assert not OpenedKeystore(publisher.root).ledger_file.clock_clause(publisher.now)


def test_keystore_and_folder_in_one_another(publisher: Home) -> None:
    for pub in (publisher.root / "pub", publisher.folder, publisher.root):
        with pytest.raises(KeystoreError, match="overlap"):
            publishing.publish(publisher.root, pub, now=publisher.now)
    assert not (publisher.root / "pub").exists()


def test_what_is_refused_leaves_no_folder(publisher: Home, tmp_path: Path) -> None:
    publisher.publish()
    other = tmp_path / "a" / "b"
    with pytest.raises(KeystoreError, match="has nothing that the keystore"):
        publishing.publish(publisher.root, other, now=publisher.now)
    assert not other.parent.exists()


# ── releases ───────────────────────────────────────────────────────────────────────────────


def test_releases_that_are_none(publisher: Home) -> None:
    authority = publisher.permissions_ca()
    good = {"enclaves/r1/base/cert.pem": b"x"}

    def read(files: dict[str, bytes], robot: str = "r1") -> Release:
        (seal,) = seal_releases([(robot, 1, files)], authority)
        return read_release(pack_release(Release(robot, 1, files, seal)))

    assert seal_problem(read(good), [authority.certificate]) == ""
    assert seal_problem(read(good), [])
    for path in (
        "enclaves/r1/base/key.pem",
        "enclaves/r1/base/key.p11",
        "enclaves/../cert.pem",
        "/enclaves/r1/cert.pem",
        "private/cert.pem",
        "enclaves/r1/base/cert.pem/..",
        "enclavesr1/cert.pem",
    ):
        with pytest.raises(DocumentError):
            read({**good, path: b"x"})
    for robot in ("", "../r1", "r1\nnumber 9"):
        with pytest.raises(DocumentError):
            read(good, robot)
    headers = tarfile.TarInfo("x")
    headers.type, headers.size = tarfile.GNUTYPE_LONGNAME, 2
    nested = gzip.compress((headers.tobuf() + bytes(512)) * 5000)  # each names the next one
    for data in (b"", b"x", nested, pack_release(Release("r1", 1, good, b"x"))):
        with pytest.raises(SrosError):
            read_release(data)


def test_a_snapshot_of_a_thief_is_not_what_the_timestamp_names(publisher: Home) -> None:
    thief = Thief(publisher, publisher.pub, "snapshot")
    version = thief.present("snapshot").signed.version
    thief.sign(
        "snapshot", lambda snapshot: setattr(snapshot, "unrecognized_fields", {"x": 1}), version
    )
    with pytest.raises(KeystoreError, match="metadata that this keystore did not write"):
        publisher.publish()


def test_bins_grow_with_the_fleet(publisher: Home) -> None:
    """Robots accept the lists of ten times as many robots, and names of earlier bins stay."""
    robot = publisher.robot()
    robot.gets()
    keystore = OpenedKeystore(publisher.root)
    roots = Roots(json.loads((publisher.root / "fleet_root.json").read_text())["roots"])
    private = publisher.root / "private"
    signers = {
        role: [load_signer((private / f"fleet_{role}.pem").read_bytes(), role)]
        for role in ("targets", "snapshot", "timestamp")
    }
    releases = {name: each.release for name, each in read_published(keystore).robots.items()}
    sizes = []
    for count in (60, 300, 1200, 300):
        present = read_present(publisher.pub, roots)
        more = {f"x{number}": PublishedRelease(1, "0" * 64, 1) for number in range(count)}
        composer = MetadataComposer(
            present, signers, known={}, expiry=MetadataExpiry(), now=publisher.now
        )
        for path, data in composer.compose(releases | more).files:
            (publisher.pub / path).write_bytes(data)
        now = read_present(publisher.pub, roots)
        assert now.releases() == releases | more
        sizes.append(len(now.bins))
        assert robot.gets()
    assert sizes == [2, 16, 64, 64]
    # A keystore from a backup knows too low versions, also of the names that are not in use.
    nothing = read_present(publisher.folder / "nothing", roots)
    composer = MetadataComposer(
        nothing,
        signers,
        known=dict.fromkeys(composer.versions, 0),
        least=int(publisher.now.timestamp()),
        expiry=MetadataExpiry(),
        now=publisher.now,
    )
    for path, data in composer.compose(releases | more).files:
        (publisher.pub / path).write_bytes(data)
    assert robot.gets()
