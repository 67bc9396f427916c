"""Installing a release on a robot: what is verified, what stays, and that it is whole or not."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from subprocess import PIPE

import pytest

from sros_tool.agent.install import Installation, install_release
from sros_tool.errors import KeystoreError
from sros_tool.keystore.delivery.release import Release
from sros_tool.keystore.layout import ca_certificate_path, ca_key_path
from sros_tool.keystore.lifecycle.create import create_permission
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.reader import read_certificate
from sros_tool.pki import smime
from sros_tool.pki.certificates import digest, make_request
from sros_tool.pki.crl import load_crl, sign_crl
from sros_tool.pki.keys import generate_key, load_key
from sros_tool.policy.document import read_policy
from tests.agent.releases import NAMES, Home, authority_of, files_of, moment, release_of
from tests.keystore.test_transaction import DIED, in_child, run_out_of_space
from tests.keystore.test_transaction import REFUSED as GIVEN_UP
from tests.support.children import LONG, apart, some_steps
from tests.support.harness import copy_of, policy_text, publish, sros

A, B, C = (f"enclaves{name}" for name in NAMES)


def install(folder: Path, release: Release, **more: object) -> Installation:
    return install_release(folder, release, "r1", now=moment(), **more)  # type: ignore[arg-type]


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def has(folder: Path, release: Release, names: tuple[str, ...] = NAMES) -> bool:
    """Return whether the folder has exactly the files of a release for these enclaves."""
    wanted = {path: data for path, data in release.files.items() if in_one_of(path, names)}
    present = content(folder)
    return wanted == {
        path: data
        for path, data in present.items()
        if in_one_of(path, names) and not path.endswith("key.pem")
    }


def in_one_of(path: str, names: tuple[str, ...]) -> bool:
    return path.rpartition("/")[0] in {f"enclaves{name}" for name in names}


def inodes(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_ino for path in folder.rglob("*")}


def test_what_changed_is_installed_and_nothing_else_is_touched(home: Home, robot: Path) -> None:
    before = inodes(robot)
    due: list[str] = []
    done = install(robot, home.renewed, before=due.extend)
    assert done.changed == ("/r1/a",) == tuple(due)
    assert not done.removed and not done.kept and done.latest
    assert has(robot, home.renewed)
    after = inodes(robot)
    renewed = {f"{A}/cert.pem", f"{A}/permissions.p7s"}
    assert {path for path in before if before[path] != after[path]} == renewed
    assert os.listdir(robot) == ["enclaves"]
    assert (robot / A / "key.pem").stat().st_mode & 0o777 == 0o600
    again = install(robot, home.renewed, installed=2)
    assert again == Installation(latest=done.latest, made=again.made) and inodes(robot) == after
    sros("verify", robot).ok()


def test_a_revocation_list_comes_to_all(home: Home, robot: Path) -> None:
    assert install(robot, home.revoked).changed == NAMES
    assert all((robot / place / "crl.pem").is_file() for place in (A, B, C))
    sros("verify", robot).ok()


VIEW = """
set -e
mkdir -p {spare}/own {spare}/box
mount --bind {robot}/enclaves/r1/b {spare}/own
mount --bind {robot}/enclaves/r1/c {spare}/box
mount -t tmpfs none {robot}/enclaves
mkdir -p {robot}/enclaves/r1/b
mount --bind {spare}/own {robot}/enclaves/r1/b
echo ready
while read line; do
    (cd / && ls {robot}/enclaves/r1 && sha256sum < {robot}/enclaves/r1/b/key.pem
    ls {robot}/enclaves/r1/b | wc -l && ls {spare}/box | wc -l) | tr '\\n' ' '
    echo
done
"""


@pytest.mark.skipif(not shutil.which("unshare"), reason="unshare is needed")
def test_units_and_containers_keep_their_view_through_many_installations(
    home: Home, robot: Path, tmp_path: Path
) -> None:
    """A unit of `sros units` sees one enclave alone, a container the folder of another one."""
    key = (robot / B / "key.pem").read_bytes()
    governance = smime.parse(home.first.files[f"{A}/governance.p7s"]).document
    script = VIEW.format(robot=robot, spare=tmp_path / "spare")
    user = [] if os.geteuid() == 0 else ["--map-root-user"]
    command = ["unshare", *user, "--mount", "sh", "-c", script]
    with subprocess.Popen(command, stdin=PIPE, stdout=PIPE, text=True) as unit:
        assert unit.stdin and unit.stdout
        if unit.stdout.readline() != "ready\n":
            pytest.skip("mount namespaces are not allowed here")

        def seen() -> str:
            assert unit.stdin and unit.stdout
            unit.stdin.write("\n")
            unit.stdin.flush()
            return unit.stdout.readline()

        full = seen()
        assert full == f"b {hashlib.sha256(key).hexdigest()}  - 6 6 \n"
        for number in range(10, 60 if LONG else 20):
            signed = home.authority.sign(governance, "the governance")  # again, so other bytes
            files = {**home.first.files, f"{A}/governance.p7s": signed}
            assert install(robot, home.release(files, number)).changed == ("/r1/a",)
        assert seen() == full
        assert install(robot, home.revoked).changed == NAMES
        assert seen() == full.replace("6 6", "7 7"), "the revocation list comes into both"
        unit.stdin.close()


REFUSED: dict[str, tuple[Callable[[Home], Release], str]] = {
    "another robot's": (lambda home: home.release(home.renewed.files, robot="r2"), "for robot r2"),
    "an older number": (lambda home: home.first, "older than release 2"),
    "another keystore's": (
        lambda home: Release("r1", 9, home.renewed.files, home.first.seal),
        "is not sealed by a CA that this robot trusts",
    ),
    "changed files": (
        lambda home: Release(
            "r1", 3, {**home.revoked.files, f"{A}/crl.pem": b"x"}, home.revoked.seal
        ),
        "is not sealed by a CA that this robot trusts",
    ),
    "an older list": (lambda home: home.release(home.renewed.files), "is older than the list here"),
    "another list of the same number": (
        lambda home: home.release({**home.revoked.files, f"{A}/crl.pem": list_of_nobody(home)}),
        "is older than the list here",
    ),
}


def list_of_nobody(home: Home, later: int = 0) -> bytes:
    """Return a list that revokes nobody, as a keystore from before the revocation signs it.

    Its number is by ``later`` higher than that of the list that has the revocation.
    """
    present = load_crl(home.revoked.files[f"{A}/crl.pem"], "of /r1/a")
    return sign_crl(
        read_certificate(home.root / ca_certificate_path("identity")),
        load_key((home.root / ca_key_path("identity")).read_bytes(), "CA"),
        (),
        number=present.number + later,
        this_update=present.this_update,
        next_update=present.next_update,
    )


@pytest.mark.parametrize("name", REFUSED)
def test_a_release_that_is_not_for_here_changes_nothing(name: str, home: Home, robot: Path) -> None:
    install(robot, home.revoked)
    before = content(robot)
    made, why = REFUSED[name]
    with pytest.raises(KeystoreError, match=why):
        install(robot, made(home), installed=2)
    assert content(robot) == before
    right = install(robot, home.release(home.revoked.files), installed=2)
    again = install(robot, home.revoked)
    assert right == Installation(latest=again.latest, made=again.made), "the right one is taken"


def test_the_release_of_a_robot_with_other_enclaves_takes_no_key(home: Home, robot: Path) -> None:
    """As after `agent init` with the name of another robot; the folder of that one is `robot`."""
    other = robot.parent / "other"
    shutil.copytree(robot, other)
    for name in ("a", "b", "c"):
        (other / f"enclaves/r1/{name}").rename(other / f"enclaves/r1/{name}{name}")
    sros("create_request", "/r1/new", other).ok()
    before = content(other)
    with pytest.raises(KeystoreError, match="has none of the enclaves that this") as refused:
        install(other, home.renewed)
    assert content(other) == before
    assert "/r1/aa, /r1/bb and /r1/cc, the release" in str(refused.value), "not /r1/new"
    assert install(robot, home.renewed).changed == ("/r1/a",)


def test_a_robot_that_waits_for_its_first_answer_takes_a_release(
    home: Home, tmp_path: Path
) -> None:
    """No certificate is here yet, so the release without this enclave takes nothing away."""
    sros("create_request", "/r1/new", tmp_path / "waits").ok()
    before = content(tmp_path / "waits")
    pinned = frozenset({digest(home.authority.certificate)})
    kept = install(tmp_path / "waits", home.renewed, pinned=pinned).kept
    assert set(kept) == set(NAMES) and all("is not on this robot" in why for why in kept.values())
    assert content(tmp_path / "waits") == before


def test_another_keystore_with_the_same_names_is_refused(
    home: Home, robot: Path, tmp_path: Path
) -> None:
    sros("generate_artifacts", "-k", tmp_path / "other", "-e", *NAMES).ok()
    other = authority_of(tmp_path / "other")
    theirs = release_of(files_of(tmp_path / "other"), 9, other)
    for installed in (2, 10):  # their numbers say nothing about ours
        with pytest.raises(KeystoreError, match=r"^release 9 is not sealed by") as refused:
            install(robot, theirs, installed=installed)
        told = str(refused.value)
        assert ("also older than release 10" in told) == (installed == 10)
        assert "comes from another keystore" in told and "--restored" not in told
    shutil.rmtree(robot / "enclaves")
    with pytest.raises(KeystoreError, match="trusts no permissions CA yet"):
        install(robot, theirs)
    with pytest.raises(KeystoreError, match="trusts no permissions CA yet"):
        install(robot, theirs, pinned=frozenset({digest(home.authority.certificate)}))
    done = install(robot, theirs, pinned=frozenset({digest(other.certificate)}))
    assert set(done.kept) == set(NAMES), "trusted, and without keys"
    assert "is not on this robot" in done.kept["/r1/a"]
    assert not (robot / "enclaves").exists()


def spoil_key(folder: Path) -> None:
    (folder / A / "key.pem").unlink()


def other_key(folder: Path) -> None:
    shutil.copy(folder / B / "key.pem", folder / A / "key.pem")


def folder_in_the_way(folder: Path) -> None:
    (folder / A / "cert.pem").unlink()
    (folder / A / "cert.pem").mkdir()


def link_elsewhere(folder: Path) -> None:
    shutil.move(folder / A, folder.parent / "elsewhere")
    (folder / A).symlink_to(folder.parent / "elsewhere")


def pipe(folder: Path) -> None:
    (folder / A / "permissions.p7s").unlink()
    os.mkfifo(folder / A / "permissions.p7s")


def unreadable_ca(folder: Path) -> None:
    (folder / A / "permissions_ca.cert.pem").write_text("mine")
    (folder / A / "key.pem").write_text("mine")


@pytest.mark.parametrize(
    "spoil", [spoil_key, other_key, folder_in_the_way, link_elsewhere, pipe, unreadable_ca]
)
def test_a_bad_enclave_keeps_nothing_from_the_others(
    spoil: Callable[[Path], None], home: Home, robot: Path
) -> None:
    spoil(robot)
    done = install(robot, home.revoked)
    assert set(done.kept) == {"/r1/a"}, done
    assert done.kept["/r1/a"].isprintable()
    assert has(robot, home.revoked, ("/r1/b", "/r1/c"))
    assert {"/r1/b", "/r1/c"} <= set(done.changed)
    if spoil in (spoil_key, other_key):  # its files are there, and can have the list
        assert (robot / A / "crl.pem").read_bytes() == home.revoked.files[f"{A}/crl.pem"]
        assert (robot / A / "cert.pem").read_bytes() == home.first.files[f"{A}/cert.pem"]
        nobody = list_of_nobody(home, later=1)
        install(robot, home.release({**home.revoked.files, f"{A}/crl.pem": nobody}))
        assert (robot / A / "crl.pem").read_bytes() == nobody


@pytest.mark.skipif(os.geteuid() != 0, reason="needs files of another user")
def test_files_of_another_user_keep_nothing_from_the_others(home: Home, robot: Path) -> None:
    """As the owner of the folder, in which root made an enclave's files its own."""
    with tempfile.TemporaryDirectory() as name:  # pytest's own folders are closed to others
        robot = copy_of(robot, Path(name) / "robot")
        for path in (robot.parent, robot, *robot.rglob("*")):
            os.chown(path, 1000, 1000)
        (robot / A / "permissions.p7s").chmod(0o600)
        os.chown(robot / A / "permissions.p7s", 0, 0)
        os.chown(robot / B, 0, 0)
        (robot / B).chmod(0o755)

        def as_owner() -> tuple[list[str], list[str]]:
            os.setgroups([])
            os.setresgid(1000, 1000, 0)
            os.setresuid(1000, 1000, 0)
            done = install(robot, home.revoked)
            os.setresuid(0, 0, 0)
            os.setresgid(0, 0, 0)
            return sorted(done.kept), list(done.changed)

        kept, changed = apart(as_owner)
        assert kept == ["/r1/a", "/r1/b"]
        assert "/r1/c" in changed and has(robot, home.revoked, ("/r1/c",))


def test_an_enclave_that_home_could_not_mean_keeps_its_files(home: Home, robot: Path) -> None:
    """Sealed, but not usable: what would not start is not installed."""
    before, later = content(robot), moment() + timedelta(days=3650)
    late = install_release(robot, home.release(home.revoked.files), "r1", now=later)
    assert set(late.kept) == set(NAMES), "nothing of it is valid then"
    assert content(robot) == before, "nor is its list"
    files = dict(home.revoked.files)
    files[f"{B}/permissions.p7s"] = files[f"{C}/permissions.p7s"]
    del files[f"{C}/governance.p7s"]
    done = install(robot, home.release(files))
    assert set(done.kept) == {"/r1/b", "/r1/c"}
    assert has(robot, home.revoked, ("/r1/a",))
    assert not install(robot, home.release(home.revoked.files)).kept


def test_an_enclave_that_the_release_does_not_have_goes(home: Home, robot: Path) -> None:
    sros("create_request", "/r1/new", robot).ok()
    (robot / C / "notes.txt").write_text("mine")
    files = {path: data for path, data in home.renewed.files.items() if in_one_of(path, ("/r1/a",))}
    done = install(robot, home.release(files))
    assert done.removed == ("/r1/b", "/r1/c")
    assert not (robot / B).exists() and os.listdir(robot / C) == ["notes.txt"]
    assert (robot / "enclaves/r1/new/key.pem").exists(), "it waits for its answer"


def test_what_a_play_brought_meanwhile_is_not_taken_back(home: Home, robot: Path) -> None:
    """Home renewed an enclave and delivered it, and did not publish it yet."""
    assert install(robot, home.revoked).changed == NAMES
    done = install(robot, home.release({**home.revoked.files, **older_a(home)}))
    assert set(done.kept) == {"/r1/a"} and "newer files than the release" in done.kept["/r1/a"]
    before, _, after = done.kept["/r1/a"].partition("`sros generate_artifacts`")
    assert "renew" not in before and "`sros renew KEYSTORE --all`" in after
    assert has(robot, home.revoked)
    (robot / A / "permissions.p7s").write_text("mine")
    done = install(robot, home.release({**home.revoked.files, **older_a(home)}))
    assert done.changed == ("/r1/a",), "files that no process can load are not newer"


@pytest.mark.parametrize("readable", [True, False])
def test_a_list_that_a_play_brings_during_the_installation_stays(
    home: Home, robot: Path, tmp_path: Path, *, readable: bool
) -> None:
    """The lists were compared before it came, and the older one would be written over it.

    A link out of the folder cannot be read, which is something else than a missing list.
    """
    newer, outside = list_of_nobody(home, later=1), tmp_path / "newer.pem"
    outside.write_bytes(newer)

    def bring(_: object) -> None:
        path = robot / A / "crl.pem"
        path.unlink(missing_ok=True)
        path.write_bytes(newer) if readable else path.symlink_to(outside)

    done = install(robot, home.revoked, before=bring)
    assert set(done.kept) == {"/r1/a"} and "changed meanwhile" in done.kept["/r1/a"]
    assert (robot / A / "crl.pem").read_bytes() == newer
    assert has(robot, home.revoked, NAMES[1:])


def test_permissions_that_a_play_brought_are_not_taken_back(
    home: Home, robot: Path, tmp_path: Path
) -> None:
    """They fit the same certificate, and may have lost a right since."""
    root, later = copy_of(home.root, tmp_path / "home"), moment() + timedelta(hours=2)
    policy = tmp_path / "policy.xml"
    policy.write_text(policy_text({"/r1/b": publish("x")}))
    create_permission(root, ["/r1/b"], read_policy(policy), now=later)
    brought = release_of(files_of(root), 4, home.authority)
    assert install_release(robot, brought, "r1", now=later).changed == NAMES
    done = install_release(robot, home.release(home.revoked.files), "r1", now=later)
    assert set(done.kept) == {"/r1/b"} and "the grant in the release" in done.kept["/r1/b"]
    assert has(robot, brought)


def test_an_enclave_does_not_trust_a_replaced_ca_again(
    home: Home, robot: Path, tmp_path: Path
) -> None:
    """A keystore from before the rotation renews its certificates, and publishes."""
    root, backup = (copy_of(home.root, tmp_path / name) for name in ("home", "backup"))
    rotate_ca(root, roles=["identity"], now=moment() + timedelta(hours=2), finish=True)
    late = moment() + timedelta(hours=4)
    later = release_of(files_of(root), 4, home.authority)
    assert install_release(robot, later, "r1", now=late).changed == NAMES
    renew(backup, ["/r1/a"], now=moment() + timedelta(hours=3))
    done = install_release(robot, home.release(files_of(backup)), "r1", now=late)
    assert all("goes back to the identity CA" in done.kept[name] for name in NAMES)
    assert all("rotate_ca KEYSTORE --identity --finish" in done.kept[name] for name in NAMES)
    assert has(robot, later)


@pytest.mark.parametrize(("template", "options"), [("sros2", ""), ("production", " --permissions")])
def test_a_pinned_ca_that_was_replaced_is_not_trusted_again(
    template: str, options: str, tmp_path: Path
) -> None:
    """A keystore with one CA for both roles refuses to replace it for one role."""
    root, robot = tmp_path / "home", tmp_path / "robot"
    sros("create_keystore", root, "--template", template).ok()
    sros("create_enclave", root, "/r1/a").ok()
    authority = authority_of(root)
    earlier = release_of(files_of(root, ("/r1/a",)), 1, authority)
    roles = ["permissions"] if options else ["identity", "permissions"]
    rotate_ca(root, roles=roles, now=moment() + timedelta(hours=2), finish=True)
    sros("distribute_key", root, "/r1/a", robot).ok()
    pinned, late = frozenset({digest(authority.certificate)}), moment() + timedelta(hours=4)
    done = install_release(robot, earlier, "r1", now=late, pinned=pinned)
    assert f"`sros rotate_ca KEYSTORE{options} --finish" in done.kept["/r1/a"]


def test_the_list_of_the_second_ca_is_not_replaced_by_an_older_one(
    home: Home, robot: Path, tmp_path: Path
) -> None:
    """In a rotation, it is in the file of the CAs."""
    root, backup = (copy_of(home.root, tmp_path / name) for name in ("home", "backup"))
    for _ in range(2):
        rotate_ca(root, roles=["identity"], now=moment())
    sros("revoke", root, "/r1/b").ok()
    names = ("/r1/a", "/r1/c")
    install_release(robot, release_of(files_of(root, names), 4, home.authority), "r1", now=moment())
    before = content(robot)
    with pytest.raises(KeystoreError, match="is older than the list here"):
        install_release(robot, release_of(files_of(backup), 5, home.authority), "r1", now=moment())
    assert content(robot) == before


def older_a(home: Home) -> dict[str, bytes]:
    """Return the files of /r1/a as first delivered, with the current revocation list."""
    return {path: data for path, data in home.first.files.items() if in_one_of(path, ("/r1/a",))}


def test_a_new_enclave_with_a_key_of_this_robot_and_its_next_key(
    home: Home, robot: Path, tmp_path: Path
) -> None:
    """A new key is installed together with its certificate only."""
    root, place = tmp_path / "home", robot / "enclaves/r1/d"
    copy_of(home.root, root)
    names = (*NAMES, "/r1/d")

    def signed(request: Path, number: int, *options: str) -> Release:
        sros("sign_request", root, request, "-o", tmp_path / f"{number}.tgz", *options).ok()
        return release_of(files_of(root, names), number, authority_of(root))

    sros("create_request", "/r1/d", robot).ok()
    born = (place / "key.pem").read_bytes()
    due: list[str] = []
    done = install(robot, signed(place / "request.pem", 10), before=due.extend)
    assert "/r1/d" in done.changed and "/r1/d" not in due, "nothing ran in it"
    key = generate_key()
    (tmp_path / "request.pem").write_bytes(make_request(key, "/r1/d"))
    release = signed(tmp_path / "request.pem", 11, "--renew")
    assert set(install(robot, release).kept) == {"/r1/d"}, "the key is not known here"
    assert (place / "key.pem").read_bytes() == born
    done = install(robot, release, new_keys={"/r1/d": key})
    assert done.changed == ("/r1/d",) and not done.kept
    assert (place / "key.pem").read_bytes() != born
    assert (place / "key.pem").stat().st_mode & 0o777 == 0o600
    sros("verify", robot).ok()


@pytest.fixture
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that dies takes nothing with it that the system was given."""
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    monkeypatch.setattr(os, "fsync", lambda _: None)


def copy(home: Home, folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return home.robot(folder)


@pytest.mark.usefixtures("no_waiting_for_the_disk")
def test_an_installation_that_is_killed_is_whole_or_did_not_happen(
    home: Home, tmp_path: Path
) -> None:
    """At every step of it; the next installation ends it."""
    work = tmp_path / "work"
    folder = copy(home, work)
    status, steps = in_child(lambda: install(folder, home.revoked))
    assert status == 0 and steps[-1] > 40
    outcomes = set()
    for step in some_steps(steps):
        folder = copy(home, work)
        ended, _ = in_child(lambda folder=folder: install(folder, home.revoked), step)  # type: ignore[misc]
        assert ended == DIED, step
        whole = [has(folder, release) for release in (home.first, home.revoked)]
        assert any(whole), f"neither before nor after at step {step}"
        outcomes.add(whole.index(True))
        assert not install(folder, home.revoked).kept
        assert has(folder, home.revoked) and os.listdir(folder) == ["enclaves"]
    assert outcomes == {0, 1}


@pytest.mark.usefixtures("no_waiting_for_the_disk")
def test_a_full_disk_leaves_all_or_takes_the_lists_alone(home: Home, tmp_path: Path) -> None:
    work = tmp_path / "work"
    folder = copy(home, work)
    _, steps = in_child(lambda: install(folder, home.revoked))
    listed = 0
    for step in some_steps(steps):
        folder = copy(home, work)
        ended, _ = in_child(
            lambda folder=folder: install(folder, home.revoked),  # type: ignore[misc]
            step,
            run_out_of_space,
        )
        if ended == 0:
            continue
        assert ended == GIVEN_UP, step
        assert (folder / A / "cert.pem").read_bytes() == home.first.files[f"{A}/cert.pem"]
        lists = [(folder / place / "crl.pem").exists() for place in (A, B, C)]
        assert len(set(lists)) == 1, "all or none"
        listed += all(lists)
        assert os.listdir(folder) == ["enclaves"]
        assert not install(folder, home.revoked).kept and has(folder, home.revoked)
    assert listed, "there was room for the lists"
