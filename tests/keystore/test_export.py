"""Exports of several enclaves, and their verification on the robot."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from ansible_collections.sros.fleet.plugins.module_utils.verification import verify
from sros_tool.checks.keystores.arrival import verify_arrival
from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.cli.common import chosen_enclaves
from sros_tool.dds.domains import DomainSet
from sros_tool.errors import DocumentError, KeystoreError, SrosError
from sros_tool.files import policies_dir, staged_file
from sros_tool.keystore.delivery import export
from sros_tool.keystore.delivery.archive import unpack
from sros_tool.keystore.delivery.export import (
    ExportSelection,
    distribute,
    included_keys_notes,
    pack_enclaves,
    select_enclaves_to_export,
)
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.keystore.transaction import KeystoreLock
from sros_tool.pki.certificates import digest, load_certificate
from sros_tool.pki.crl import load_crl
from sros_tool.policy.document import read_policy
from tests.support.harness import copy_of, create_request, policy_text, publish, snapshot, sros

NOW = datetime.now(UTC)
NAMES = ("/arm/camera", "/arm/gripper", "/armada", "/base")
BORN = "/arm/eye"


@pytest.fixture(scope="session")
def made_fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore with four enclaves, and a fifth whose key is on its robot."""
    folder = tmp_path_factory.mktemp("fleet")
    domains = DomainSet.of((5, 6))
    template = load_template("production")
    create_keystore(folder / "ks", template=template, domains=domains, now=NOW)
    create_enclaves(folder / "ks", NAMES, now=NOW)
    made = create_request(folder / "robot", BORN)
    sign_request(folder / "ks", made.file.read_bytes(), now=NOW)
    return folder / "ks"


@pytest.fixture
def fleet(made_fleet: Path, tmp_path: Path) -> Path:
    return copy_of(made_fleet, tmp_path / "ks")


@pytest.fixture
def arrived(made_fleet: Path, tmp_path: Path) -> Path:
    distribute(OpenedKeystore(made_fleet), ["/arm/camera", "/base"], tmp_path / "robot", now=NOW)
    return tmp_path / "robot"


def test_an_older_list_does_not_replace_a_newer_one(fleet: Path, tmp_path: Path) -> None:
    """Also not with --force: the keystore may come from a backup."""
    refresh_crl(fleet, now=NOW)
    backup, robot = copy_of(fleet, tmp_path / "backup"), tmp_path / "robot"
    revoke(fleet, ["/armada"], now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    with pytest.raises(
        KeystoreError, match=r"is a newer .* number 2; the keystore has the number 1"
    ):
        distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True)
    (robot / "enclaves/base/crl.pem").unlink()
    assert distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True).changes


def test_a_list_with_a_later_number_does_not_lose_a_revocation(fleet: Path, tmp_path: Path) -> None:
    """A keystore from a backup may have signed more lists than the lost keystore."""
    robot, backup = tmp_path / "robot", copy_of(fleet, tmp_path / "backup")
    renew(fleet, ["/armada"], now=NOW)  # the backup does not know this certificate
    revoke(fleet, ["/armada"], now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    for name in ("/arm/camera", "/arm/gripper"):
        revoke(backup, [name], now=NOW)
    crl, before = robot / "enclaves/base/crl.pem", snapshot(robot)
    for lacking in (2, 1):
        with pytest.raises(KeystoreError, match=rf"{crl}' revokes {lacking} certificates? that"):
            distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True)
        assert snapshot(robot) == before
        if lacking == 2:
            revoke(backup, ["/armada"], now=NOW)
    for _ in range(2):  # the first one takes the list over
        refresh_crl(backup, now=NOW, crl=crl.read_bytes())
    assert distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True).changes
    lost = load_crl(before["enclaves/base/crl.pem"][1], "lost").revoked
    assert all(load_crl(crl.read_bytes(), "new").revokes(entry.serial) for entry in lost)


def test_what_another_export_wrote_meanwhile_is_compared(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, backup = tmp_path / "robot", copy_of(fleet, tmp_path / "backup")
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    revoke(fleet, ["/armada"], now=NOW)
    revoke(backup, ["/arm/camera"], now=NOW)
    acquire = KeystoreLock.acquire

    def acquire_late(lock: KeystoreLock) -> None:
        monkeypatch.undo()
        distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW, force=True)
        acquire(lock)

    monkeypatch.setattr(KeystoreLock, "acquire", acquire_late)
    with pytest.raises(KeystoreError, match="revokes 1 certificate that the keystore's"):
        distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True)


def test_an_archive_that_another_export_wrote_meanwhile_stays(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backup, target = copy_of(fleet, tmp_path / "backup"), tmp_path / "robot.tar.gz"
    for name in ("/armada", "/arm/camera"):  # once without an archive, once with one
        revoke(fleet, [name], now=NOW)

        def stage_late(*words: Any, **more: Any) -> Any:
            monkeypatch.undo()
            distribute(OpenedKeystore(fleet), ["/base"], target, now=NOW, force=True)
            return staged_file(*words, **more)

        monkeypatch.setattr(export, "staged_file", stage_late)
        with pytest.raises(KeystoreError, match=r"another process has just written '.*/robot"):
            distribute(OpenedKeystore(backup), ["/base"], target, now=NOW, force=True)
        present = target.read_bytes()
        assert not distribute(OpenedKeystore(fleet), ["/base"], target, now=NOW).changes
        revoke(backup, [name], now=NOW)
        refresh_crl(backup, now=NOW)
    assert target.read_bytes() == present


def test_a_revocation_during_an_export_comes_to_all_enclaves_of_it(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    revoke(fleet, ["/armada"], now=NOW)
    read = export._files_of

    def read_and_revoke(*arguments: Any) -> Any:
        files = read(*arguments)
        if (fleet / "enclaves/base").exists():
            revoke(fleet, ["/base"], now=NOW)
        return files

    monkeypatch.setattr(export, "_files_of", read_and_revoke)
    names = ("/arm/camera", "/arm/gripper")
    distribute(OpenedKeystore(fleet), names, tmp_path / "robot", now=NOW)
    lists = {(tmp_path / f"robot/enclaves{name}/crl.pem").read_bytes() for name in names}
    assert lists == {(fleet / "public/identity_ca.crl.pem").read_bytes()}


def test_a_new_enclave_gets_no_older_list_than_its_neighbor(fleet: Path, tmp_path: Path) -> None:
    robot, backup = tmp_path / "robot", copy_of(fleet, tmp_path / "backup")
    revoke(fleet, ["/armada"], now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    with pytest.raises(KeystoreError, match=r"base/crl.pem' is a newer revocation list"):
        distribute(OpenedKeystore(backup), ["/arm/camera"], robot, now=NOW)
    assert distribute(OpenedKeystore(fleet), ["/arm/camera"], robot, now=NOW).changes


def test_the_list_of_the_second_ca_is_taken_over_at_once(fleet: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    refresh_crl(fleet, now=NOW)
    for _ in range(2):
        rotate_ca(fleet, roles=("identity",), now=NOW)
    backup = copy_of(fleet, tmp_path / "backup")
    for _ in range(9):
        refresh_crl(fleet, now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    refresh_crl(backup, now=NOW, crl=(robot / "enclaves/base/identity_ca.cert.pem").read_bytes())
    refresh_crl(backup, now=NOW, crl=(robot / "enclaves/base/crl.pem").read_bytes())
    assert distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True).changes


def test_a_list_of_another_ca_is_not_taken_over(fleet: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    create_keystore(other, template=load_template("production"), now=NOW)
    refresh_crl(other, now=NOW)
    with pytest.raises(KeystoreError, match="no identity CA of the keystore signed"):
        refresh_crl(fleet, now=NOW, crl=(other / "public/identity_ca.crl.pem").read_bytes())


def test_an_expired_certificate_may_leave_the_list(fleet: Path, tmp_path: Path) -> None:
    robot, later = tmp_path / "robot", NOW + timedelta(days=400)
    revoke(fleet, ["/armada"], now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    renew(fleet, ["/base"], now=later)
    for _ in range(2):  # an entry stays until it was on a list after the expiry (RFC 5280, 3.3)
        refresh_crl(fleet, now=later)
    assert not OpenedKeystore(fleet).revocation_lists[0].revoked
    assert distribute(OpenedKeystore(fleet), ["/base"], robot, now=later, force=True).changes


def test_an_archive_is_compared_as_a_folder_is(fleet: Path, tmp_path: Path) -> None:
    backup, target = copy_of(fleet, tmp_path / "backup"), tmp_path / "robot.tar.gz"
    revoke(fleet, ["/armada"], now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], target, now=NOW)
    present = target.read_bytes()
    for damaged in (False, True):
        with pytest.raises(KeystoreError, match="cannot be compared" if damaged else "is a newer"):
            distribute(OpenedKeystore(backup), ["/base"], target, now=NOW, force=True)
        assert target.read_bytes() == present
        present = present[:-9]
        target.write_bytes(present)


def test_a_replaced_ca_does_not_replace_the_one_after_it(fleet: Path, tmp_path: Path) -> None:
    """Even with --force: the robot would trust everybody again who was revoked since the backup."""
    backup, robot = copy_of(fleet, tmp_path / "backup"), tmp_path / "robot"
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    for _ in RotationStage.DISTRIBUTE, RotationStage.REISSUE, RotationStage.RETIRE:
        rotate_ca(fleet, allow_unconfirmed=True, now=NOW)
    refresh_crl(fleet, now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW, force=True)
    before = snapshot(robot)
    with pytest.raises(KeystoreError, match="has a later identity CA than the keystore's") as said:
        distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True)
    assert snapshot(robot) == before
    removal = re.search("`rm (.*)`", said.value.remedy)
    assert removal
    for path in removal[1].split():
        Path(path).unlink()
    assert distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True).changes
    assert not (robot / "enclaves/base/crl.pem").exists(), "no list of a CA that is not trusted"
    assert all(enclave.loadable for enclave in verify_arrival(robot, now=NOW).enclaves)
    (robot / "enclaves/base/identity_ca.cert.pem").write_text("damaged")
    assert distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True).changes


@pytest.mark.parametrize("hours", [-1, 0, 1])
def test_files_of_another_keystore_are_not_replaced(
    hours: int, fleet: Path, tmp_path: Path
) -> None:
    """Its names are equal, and either may be older: the robot would lose CAs, list and peers."""
    other, robot = tmp_path / "other", tmp_path / "robot"
    revoke(fleet, ["/armada"], now=NOW)
    distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW)
    made, late = NOW + timedelta(hours=hours), NOW + timedelta(hours=2)
    create_keystore(other, template=load_template("production"), now=made)
    create_enclaves(other, ["/base"], now=made)
    before = snapshot(robot)
    for target in (robot, tmp_path / "robot.tar.gz"):
        if target != robot:
            distribute(OpenedKeystore(fleet), ["/base"], target, now=NOW)
        with pytest.raises(KeystoreError) as said:
            distribute(OpenedKeystore(other), ["/base"], target, now=late, force=True)
        for keystore in (fleet, other):
            data = (keystore / "public/identity_ca.cert.pem").read_bytes()
            assert f"(SHA-256 {digest(load_certificate(data, 'CA'))[:8]})" in said.value.why
    assert snapshot(robot) == before
    for path in robot.rglob("*_ca.cert.pem"):
        path.unlink()  # as the remedy says
    assert distribute(OpenedKeystore(other), ["/base"], robot, now=late, force=True).changes


def test_no_ca_is_trusted_again_after_a_rotation_of_one_role(fleet: Path, tmp_path: Path) -> None:
    """Nor with a backup that knows the later CA, but still trusts the earlier one."""
    robot, backup = tmp_path / "robot", tmp_path / "backup"
    for hours in range(3):
        rotate_ca(fleet, roles=("identity",), now=NOW + timedelta(hours=hours))
        distribute(OpenedKeystore(fleet), ["/base"], robot, now=NOW, force=hours > 0)
        if hours == 1:
            copy_of(fleet, backup)
    with pytest.raises(KeystoreError, match="has a later identity CA than the keystore's"):
        distribute(OpenedKeystore(backup), ["/base"], robot, now=NOW, force=True)


@pytest.mark.parametrize("kept", ["key.pem", "request.pem"])
def test_a_certificate_for_an_earlier_key_of_the_robot_is_not_exported(
    kept: str, fleet: Path, tmp_path: Path
) -> None:
    """The robot has another key since the backup, in a file or on a token."""
    robot, backup = tmp_path / "robot", copy_of(fleet, tmp_path / "backup")
    made = create_request(robot, BORN)
    sign_request(fleet, made.file.read_bytes(), now=NOW, renew=True)
    place = robot / "enclaves/arm/eye"
    distribute(OpenedKeystore(fleet), [BORN], robot, now=NOW, keyless=True)
    if kept != "key.pem":
        (place / "key.pem").unlink()
        (place / "key.p11").write_text("pkcs11:token=robot;object=eye\n")
    before = snapshot(robot)
    with pytest.raises(KeystoreError, match="the certificate is not for the key in"):
        distribute(OpenedKeystore(backup), [BORN], robot, now=NOW, keyless=True, force=True)
    assert snapshot(robot) == before
    renew(fleet, [BORN], now=NOW)
    assert distribute(OpenedKeystore(fleet), [BORN], robot, now=NOW, keyless=True, force=True)
    for file in {"key.pem", "key.p11", "request.pem"} & set(os.listdir(place)):
        (place / file).unlink()  # a copy without the key
    assert distribute(OpenedKeystore(backup), [BORN], robot, now=NOW, keyless=True, force=True)


def test_an_export_with_keyless_says_which_private_keys_it_has(fleet: Path, tmp_path: Path) -> None:
    """Its name reads as if it left all keys out."""
    keystore = OpenedKeystore(fleet)
    (said,) = included_keys_notes(keystore, [BORN, "/base"])
    assert "the export has /base with its private key: " in said.text
    assert not list(included_keys_notes(keystore, [BORN]))
    for words, noted in ((("--all",), False), (("--all", "--keyless"), True)):
        for target in ("-", "robot"):
            ended = sros("distribute_key", fleet, *words, target, "--dry-run", cwd=tmp_path).ok()
            assert ("export.keys-included" in ended.err) == noted


# ── selection ──────────────────────────────────────────────────────────────────────────────


def select(root: Path, names: list[str], patterns: list[str], every: bool) -> ExportSelection:
    keystore = OpenedKeystore(root)
    chosen = chosen_enclaves(keystore, names, ["*"] if every else patterns, [])
    return select_enclaves_to_export(keystore, chosen, names, keyless=False)


@pytest.mark.parametrize(
    ("names", "patterns", "every", "chosen", "left_out"),
    [
        (["/base"], [], False, ["/base"], []),
        (["/base", "/base"], [], False, ["/base"], []),
        ([], ["/arm/*"], False, ["/arm/camera", "/arm/gripper"], [BORN]),
        ([], ["/arm*"], False, ["/arm/camera", "/arm/gripper", "/armada"], [BORN]),
        (["/base"], ["/arm/c*", "/arm/*"], False, ["/base", "/arm/camera", "/arm/gripper"], [BORN]),
        ([], [], True, list(NAMES), [BORN]),
        ([], ["*"], False, list(NAMES), [BORN]),
        ([BORN], [], False, [BORN], []),
    ],
)
def test_selection(
    names: list[str],
    patterns: list[str],
    every: bool,
    chosen: list[str],
    left_out: list[str],
    made_fleet: Path,
) -> None:
    found = select(made_fleet, names, patterns, every)
    assert found == ExportSelection(tuple(chosen), tuple(left_out))


@pytest.mark.parametrize(
    ("patterns", "why"),
    [(["/leg/*"], "matches '/leg/*'"), ([BORN], "not in keystore"), ([""], "matches")],
)
def test_an_empty_selection_is_refused(patterns: list[str], why: str, made_fleet: Path) -> None:
    with pytest.raises(KeystoreError) as caught:
        select(made_fleet, [], patterns, every=False)
    assert why in str(caught.value)


def test_several_enclaves_are_exported_completely_or_not_at_all(
    fleet: Path, tmp_path: Path
) -> None:
    before = snapshot(tmp_path)
    for wrong, why in ((BORN, "made on its robot"), ("/none", "does not exist")):
        for target in ("out", "out.tar.gz"):
            with pytest.raises(KeystoreError, match=why):
                distribute(OpenedKeystore(fleet), ["/base", wrong], tmp_path / target, now=NOW)
    (fleet / "enclaves/base/permissions.p7s").unlink()
    with pytest.raises(KeystoreError, match="no process would run"):
        distribute(OpenedKeystore(fleet), ["/arm/camera", "/base"], tmp_path / "out", now=NOW)
    assert set(snapshot(tmp_path)) == set(before) - {"ks/enclaves/base/permissions.p7s"}


def test_an_archive_of_another_kind_is_refused(fleet: Path, tmp_path: Path) -> None:
    """A folder robot.tar would be no archive, and a folder "-" is not standard output."""
    policy = policies_dir() / "talker_listener.xml"
    (robots := tmp_path / "fleet.toml").write_text("[robots]\nr1 = {}\n")
    sros("generate_artifacts", "-k", fleet, "-p", policy, "--fleet", robots).ok()
    before = snapshot(tmp_path)
    for words, said in (
        (("distribute_key", fleet, "--all", "robot.tar"), "Name an archive FILE.tar.gz, or a fol"),
        (("fleet", "publish", fleet, "pub.tgz"), "'pub.tgz' would become a folder, not an archive"),
        (("fleet", "publish", fleet, "-"), "Releases are published in a folder"),
    ):
        ended = sros(*words, cwd=tmp_path)
        assert ended.status == 2 and said in ended.err, ended
    assert snapshot(tmp_path) == before


def test_folder_archive_and_pipe_hold_the_same(fleet: Path, tmp_path: Path) -> None:
    names = ["/base", "/arm/camera"]
    distribute(OpenedKeystore(fleet), names, tmp_path / "out", now=NOW)
    distribute(OpenedKeystore(fleet), names, tmp_path / "out.tgz", now=NOW)
    packed = pack_enclaves(OpenedKeystore(fleet), names[::-1], now=NOW)
    assert packed.data == (tmp_path / "out.tgz").read_bytes()
    files = unpack(packed.data)
    assert tuple(files) == packed.paths
    assert files == {
        str(path.relative_to(tmp_path / "out")): path.read_bytes()
        for path in (tmp_path / "out").rglob("*")
        if path.is_file()
    }


def test_a_lost_key_does_not_count_as_a_key_on_a_robot(fleet: Path, tmp_path: Path) -> None:
    (fleet / "enclaves/base/key.pem").unlink()
    with pytest.raises(KeystoreError, match=r"key\.pem: missing"):
        distribute(OpenedKeystore(fleet), ["/base"], tmp_path / "out", now=NOW)


# ── verification on the robot ──────────────────────────────────────────────────────────────


def test_an_unchanged_export_has_no_findings(arrived: Path) -> None:
    arrival = verify_arrival(arrived, now=NOW, domain=5)
    assert not arrival.findings
    assert [(each.name, each.loadable, each.domains) for each in arrival.enclaves] == [
        ("/arm/camera", True, "5-6"),
        ("/base", True, "5-6"),
    ]
    until = arrival.enclaves[0].valid_until
    assert until
    assert until - NOW > timedelta(days=179)
    one = verify_arrival(arrived / "enclaves/arm/camera", now=NOW)
    assert (one.kind, [each.name for each in one.enclaves]) == ("enclave", ["/arm/camera"])
    assert not one.findings
    assert arrival.verified_folder(NOW, None).ok


def _mix_up(robot: Path) -> None:
    enclaves = robot / "enclaves"
    (enclaves / "base").rename(enclaves / "spare")


def _other_ca(robot: Path) -> None:
    root = robot.parent / "other"
    create_keystore(root, template=load_template("production"), now=NOW)
    create_enclaves(root, ["/zebra"], now=NOW)
    distribute(OpenedKeystore(root), ["/zebra"], robot.parent / "more", now=NOW)
    shutil.copytree(robot.parent / "more/enclaves/zebra", robot / "enclaves/zebra")


def _edit(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))


FINDINGS: dict[str, tuple[Callable[[Path], object], str, str, str]] = {
    "a file is missing": (
        lambda robot: (robot / "enclaves/base/permissions.p7s").unlink(),
        *("/base", "permissions.p7s", "missing"),
    ),
    "another key": (
        lambda robot: shutil.copy(
            robot / "enclaves/arm/camera/key.pem", robot / "enclaves/base/key.pem"
        ),
        *("/base", "key.pem", "not the key of cert.pem"),
    ),
    "tampered permissions": (
        lambda robot: _edit(robot / "enclaves/base/permissions.p7s", b"rt/rosout", b"rt/rosin"),
        *("/base", "permissions.p7s", "does not match"),
    ),
    "a key that others read": (
        lambda robot: (robot / "enclaves/base/key.pem").chmod(0o644),
        *("/base", "key.pem", "0644"),
    ),
    "a key that the group reads": (
        lambda robot: (robot / "enclaves/base/key.pem").chmod(0o640),
        *("/base", "key.pem", "0640"),
    ),
    "a folder that all can change": (
        lambda robot: (robot / "enclaves/base").chmod(0o777),
        *("", "enclaves/base", "everybody can change"),
    ),
    "another name": (_mix_up, "/spare", "cert.pem", "the name of another enclave"),
    "another CA": (_other_ca, "/zebra", "identity_ca.cert.pem", "do not trust the same CAs"),
    "a link that leads out": (
        lambda robot: (robot / "enclaves/base/notes").symlink_to("/etc/hostname"),
        *("", "enclaves/base/notes", "link to a file outside of the keystore"),
    ),
    "a folder that is elsewhere": (
        lambda robot: (robot / "enclaves/more").symlink_to("/etc"),
        *("", "enclaves/more", "link to a file outside of the keystore"),
    ),
    "a key too many": (
        lambda robot: shutil.copy(robot / "enclaves/base/key.pem", robot / "enclaves/ca.key.pem"),
        *("", "enclaves/ca.key.pem", "private key"),
    ),
    "an answer that is not here yet": (
        lambda robot: create_request(robot, "/late"),
        *("/late", "request.pem", "certificate is missing"),
    ),
}


@pytest.mark.parametrize("case", FINDINGS)
def test_findings(case: str, arrived: Path) -> None:
    spoil, enclave, file, text = FINDINGS[case]
    spoil(arrived)
    arrival = verify_arrival(arrived, now=NOW)
    assert not arrival.verified_folder(NOW, None).ok
    found = [
        each
        for each in arrival.findings
        if (arrival.enclave_of(each), arrival.file_of(each)) == (enclave, file)
    ]
    assert any(text in f"{each.kind.title}: {each.text}" for each in found), arrival.findings
    others = {arrival.enclave_of(each) for each in arrival.findings} - {enclave, ""}
    assert not others, arrival.findings
    good = next(each for each in arrival.enclaves if each.name == "/arm/camera")
    assert good.loadable


@pytest.mark.parametrize(
    ("days", "text"), [(-2, "not valid before"), (190, "expired"), (1900, "expired")]
)
def test_another_moment(days: int, text: str, arrived: Path) -> None:
    arrival = verify_arrival(arrived, now=NOW + timedelta(days=days))
    assert any(text in each.text for each in arrival.findings)
    assert not any(each.loadable for each in arrival.enclaves)


def test_a_certificate_that_is_not_for_the_key_on_a_token(fleet: Path, tmp_path: Path) -> None:
    """No token is opened; the request, which has its key, shows it."""
    robot, place = tmp_path / "robot", tmp_path / "robot/enclaves/arm/eye"
    distribute(OpenedKeystore(fleet), [BORN], robot, now=NOW, keyless=True)
    (place / "key.p11").write_text("pkcs11:token=robot;object=eye\n")
    for made_in in (fleet, tmp_path / "other"):
        if made_in != fleet:
            create_request(made_in, BORN)
        shutil.copy(made_in / "enclaves/arm/eye/request.pem", place)
        found = {finding.id for finding in verify_arrival(robot, now=NOW).findings}
        assert ("enclave.token-key" in found) is (made_in != fleet)
        for program in ("sros", "none"):
            verified = verify(str(robot), [BORN], [program])
            assert verified["ok"] is (made_in == fleet), verified


def test_another_domain(arrived: Path) -> None:
    findings = verify_arrival(arrived, now=NOW, domain=7).findings
    assert any("for domain 5-6, not for 7" in each.text for each in findings)


def test_a_copy_of_the_whole_keystore_has_ca_keys(fleet: Path) -> None:
    arrival = verify_arrival(fleet, now=NOW)
    findings = arrival.findings
    keys = [each for each in findings if each.id == "keystore.home-or-robot"]
    (said,) = keys
    assert "private/identity_ca.key.pem, private/permissions_ca.key.pem" in said.text
    assert said.remedy.startswith("On the keystore machine, keep the CA keys, and run")
    # The enclave whose key is on its robot is no finding at home.
    assert [each.name for each in arrival.enclaves if each.key_on_robot] == [BORN]
    assert not [each for each in findings if each not in keys]
    # The enclave's links lead to other folders of the same keystore.
    assert not verify_arrival(fleet / "enclaves/base", now=NOW).findings


def test_keys_of_revoked_enclaves_are_kept_at_home(fleet: Path) -> None:
    """One finding in words for both places, and nothing for who checks it as what it is."""
    revoke(fleet, ["/base"], now=NOW)
    (said,) = verify_arrival(fleet, now=NOW).findings
    assert "revoked/" in said.text
    assert "elete" not in said.remedy
    kinds = {each.id for each in keystore_findings(OpenedKeystore(fleet), Circumstances(NOW))}
    assert not kinds & {"keystore.home-or-robot", "keystore.ca-key-on-robot"}


@pytest.mark.parametrize("looks", ["public", "private", "sros.toml", "whole"])
def test_an_export_that_looks_like_home_is_found_with_its_ca_key(
    fleet: Path, tmp_path: Path, looks: str
) -> None:
    robot = tmp_path / "robot"
    distribute(OpenedKeystore(fleet), ["/base", "/armada"], robot, now=NOW)
    for name in ("public", "private", "sros.toml", "ledger.jsonl", "ledger.p7s"):
        if looks in (name, "whole") or name == "private":
            source = fleet / name
            copy = shutil.copytree if source.is_dir() else shutil.copy
            copy(source, robot / name)
    verified = {each.id for each in verify_arrival(robot, now=NOW).findings}
    checked = {
        each.id: each.remedy
        for each in keystore_findings(OpenedKeystore(robot), Circumstances(NOW))
    }
    assert "keystore.home-or-robot" in verified & set(checked)
    assert "keep the CA keys" in checked["keystore.home-or-robot"]
    if looks in ("public", "sros.toml", "whole"):
        assert "copy the keystore again with its links" in checked["keystore.home-or-robot"]


def test_no_remedy_for_a_ca_key_may_lose_it(fleet: Path, tmp_path: Path) -> None:
    distribute(OpenedKeystore(fleet), ["/base"], tmp_path / "robot", now=NOW)
    shutil.copy(fleet / "private/identity_ca.key.pem", tmp_path / "robot/enclaves/base")
    (said,) = verify_arrival(tmp_path / "robot", now=NOW).findings
    assert said.id == "keystore.ca-key-on-robot"
    assert said.remedy.startswith("Make sure that the keystore")


def test_a_revoked_enclave_on_the_robot_is_a_finding(fleet: Path, tmp_path: Path) -> None:
    distribute(OpenedKeystore(fleet), ["/base", "/armada"], tmp_path / "robot", now=NOW)
    revoke(fleet, ["/base"], now=NOW)
    distribute(OpenedKeystore(fleet), ["/armada"], tmp_path / "robot", now=NOW)
    crl = tmp_path / "robot/enclaves/armada/crl.pem"
    (finding,) = verify_arrival(tmp_path / "robot", now=NOW).findings
    assert finding.id == "keystore.enclave-revoked"
    shutil.copy(crl, tmp_path / "robot/enclaves/base")
    (finding,) = verify_arrival(tmp_path / "robot", now=NOW).findings
    assert "revoked" in finding.text


@pytest.mark.parametrize("path", ["none", "empty", "ks/enclaves", "ks/sros.toml", "loose"])
def test_what_is_neither_keystore_nor_enclave(path: str, fleet: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    shutil.copytree(fleet / "enclaves/base", tmp_path / "loose")
    with pytest.raises(DocumentError):
        verify_arrival(tmp_path / path, now=NOW)


def test_verifying_changes_nothing(arrived: Path) -> None:
    (arrived / ".sros-transaction/new").mkdir(parents=True)
    before = snapshot(arrived)
    (finding,) = verify_arrival(arrived, now=NOW).findings
    assert "interrupted" in finding.text
    assert snapshot(arrived) == before


def test_an_update_replaces_the_files_of_an_earlier_export(fleet: Path, tmp_path: Path) -> None:
    distribute(OpenedKeystore(fleet), ["/base"], tmp_path / "robot", now=NOW)
    (tmp_path / "p.xml").write_text(policy_text({"/base": publish("new")}))
    generate_artifacts(fleet, policies=[read_policy(tmp_path / "p.xml")], now=NOW)
    renew(fleet, ["/base"], now=NOW)
    with pytest.raises(SrosError, match="other versions"):
        distribute(OpenedKeystore(fleet), ["/base", "/armada"], tmp_path / "robot", now=NOW)
    distribute(OpenedKeystore(fleet), ["/base", "/armada"], tmp_path / "robot", now=NOW, force=True)
    assert not verify_arrival(tmp_path / "robot", now=NOW).findings
    assert not [path for path in os.listdir(tmp_path / "robot") if path.startswith(".")]


def test_an_enclave_that_the_keystore_lost_is_named(keystore: Path, tmp_path: Path) -> None:
    robot = tmp_path / "the robot"
    distribute(OpenedKeystore(keystore), ["/a", "/b"], robot, now=NOW)
    sros("revoke", keystore, "/a").ok()
    ended = sros("distribute_key", keystore, "--all", robot, "--force").ok()
    assert f"'{robot}' also has enclave /a" in ended.err
    subprocess.run(["sh", "-c", re.findall(r"rm -r [^`]*", ended.err)[0]], check=True)
    assert not (robot / "enclaves/a").exists()
    again = sros("distribute_key", keystore, "--all", robot, "--force", "--json").ok()
    assert json.loads(again.out)["notes"] == []


@pytest.mark.parametrize("file", ["public/identity_ca.cert.pem", "enclaves/a/cert.pem"])
def test_no_export_has_a_private_key_beside_that_of_its_enclave(
    file: str, keystore: Path, tmp_path: Path
) -> None:
    """Where a key was appended to a certificate, the robot would get it."""
    with (keystore / file).open("ab") as certificates:
        certificates.write((keystore / "private/identity_ca.key.pem").read_bytes())
    for target in ("robot", "robot.tar.gz"):
        ended = sros("distribute_key", keystore, "/a", tmp_path / target)
        assert (ended.status, "contains a private key" in ended.err) == (2, True), ended
        assert not (tmp_path / target).exists()
