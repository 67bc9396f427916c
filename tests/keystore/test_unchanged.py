"""Permissions that state what a policy says already stay byte for byte; all others are replaced."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.keystore.expiry import read_credentials
from sros_tool.keystore.ledger import REPORTED
from sros_tool.keystore.lifecycle.create import (
    Creation,
    create_enclaves,
    create_keystore,
    generate_artifacts,
)
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revocation_list import LostRecords
from sros_tool.keystore.lifecycle.revoke import restore_revocations, revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from tests.support.harness import (
    check_whole,
    copy_of,
    policy_text,
    publish,
    snapshot,
    sros,
    topics_of,
)

NOW = datetime.now(UTC).replace(microsecond=0)
DAY = timedelta(days=1)
NAMES = ("/a", "/b", "/c")
TEXT = policy_text({name: publish(f"{name}/x", f"{name}/y") for name in NAMES})
LEDGER = {"ledger.jsonl", "ledger.p7s"}
SIGNED = {"enclaves/a/permissions.p7s", "enclaves/a/permissions.xml", *LEDGER}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore and its policy; only to be copied."""
    folder = tmp_path_factory.mktemp("unchanged")
    (folder / "policy.xml").write_text(TEXT)
    create_keystore(folder / "ks", template=load_template("production"), now=NOW)
    state(folder)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "w")


def state(folder: Path, now: datetime = NOW, *, revoke_old: bool = False) -> Creation:
    """Have the keystore state the policy."""
    policy = read_policy(folder / "policy.xml")
    return generate_artifacts(folder / "ks", policies=[policy], now=now, revoke_old=revoke_old)


def written(folder: Path, work: Callable[[], object]) -> set[str]:
    """Return the files that are others after ``work``."""
    before = snapshot(folder / "ks")
    work()
    after = snapshot(folder / "ks")
    return {each for each in {*before, *after} if before.get(each) != after.get(each)}


def test_nothing_is_signed_again(folder: Path) -> None:
    words = ("generate_artifacts", "-k", "ks", "-p", "policy.xml")
    for text in (TEXT, f"<!-- another comment -->\n{TEXT}", TEXT.replace("\n", "\n  ")):
        (folder / "policy.xml").write_text(text)
        planned = sros(*words, "--dry-run", cwd=folder).ok()
        assert planned.out == "nothing would change\n"
        before = snapshot(folder / "ks")
        said = sros(*words, cwd=folder).ok().err
        assert snapshot(folder / "ks") == before
        assert said.splitlines()[0] == "unchanged: 3 enclaves: /a, /b, /c"
        assert "restart" not in said and "export" not in said
    told = json.loads(sros(*words, "--json", cwd=folder).ok().out)
    assert [(each["name"], each["outcome"]) for each in told["enclaves"]] == [
        (name, "kept") for name in NAMES
    ]
    assert (told["changes"], told["rights"], told["restart"]) == ([], [], [])
    # The lines of the policy are those of the rights, though its text is another.
    for text, provenance in ((TEXT, "same"), (f"<!-- a comment -->\n{TEXT}", "equal")):
        (folder / "policy.xml").write_text(text)
        asked = ("explain", "ks", "/a", "publish", "/a/x", "--policy", "policy.xml")
        ended = sros(*asked, cwd=folder).ok()
        assert "explain.policy" not in ended.err
        told = json.loads(sros(*asked, "--json", cwd=folder).ok().out)
        assert told["policy"]["provenance"] == provenance


def test_of_several_enclaves_those_are_signed_whose_rights_change(folder: Path) -> None:
    (folder / "policy.xml").write_text(TEXT.replace("/a/x", "/a/z"))
    results: list[Creation] = []
    assert written(folder, lambda: results.append(state(folder))) == SIGNED
    assert (results[0].changed, results[0].kept) == (("/a",), ("/b", "/c"))
    assert "rt/a/z" in topics_of(folder / "ks/enclaves/a")
    words = ("explain", "ks", "/a", "publish", "/a/x", "--policy", "policy.xml")
    (folder / "policy.xml").write_text(TEXT)
    assert "note [explain.policy-changed]" in sros(*words, cwd=folder).err
    assert state(folder).changed == ("/a",)
    check_whole(folder / "ks")


def test_the_order_and_the_text_of_rights_do_not_matter(folder: Path) -> None:
    (folder / "policy.xml").write_text(
        policy_text({name: publish(f"{name}/y", f"{name}/x") for name in reversed(NAMES)})
    )
    assert written(folder, lambda: state(folder)) == set()


def edit(folder: Path, file: str, change: Callable[[bytes], bytes]) -> None:
    path = folder / "ks/enclaves/a" / file
    path.write_bytes(change(path.read_bytes()))


def remove(folder: Path, file: str) -> None:
    (folder / "ks/enclaves/a" / file).unlink()


def link(folder: Path, file: str) -> None:
    """The file is elsewhere, where others may change it."""
    path = folder / "ks/enclaves/a" / file
    path.rename(folder / file)
    path.symlink_to(folder / file)


def put_back(folder: Path) -> None:
    """The same rights, but of a document before the latest one."""
    signed = folder / "ks/enclaves/a/permissions.p7s", folder / "ks/enclaves/a/permissions.xml"
    earlier = [each.read_bytes() for each in signed]
    sros("create_permission", "ks", "/a", "policy.xml", cwd=folder).ok()
    for path, content in zip(signed, earlier, strict=True):
        path.write_bytes(content)


def forget(folder: Path) -> None:
    """The ledger has lost its last line."""
    ledger = folder / "ks/ledger.jsonl"
    ledger.write_bytes(b"".join(ledger.read_bytes().splitlines(keepends=True)[:-1]))


def of_another(folder: Path) -> None:
    """The permissions of another keystore, with the same rights."""
    other = folder / "other"
    other.mkdir()
    (other / "policy.xml").write_text(TEXT)
    create_keystore(other / "ks", template=load_template("production"), now=NOW)
    state(other)
    for file in ("permissions.p7s", "permissions.xml"):
        (folder / "ks/enclaves/a" / file).write_bytes((other / "ks/enclaves/a" / file).read_bytes())


@pytest.mark.parametrize(
    "spoil",
    [
        lambda folder: edit(folder, "permissions.p7s", lambda data: data.replace(b"a/x", b"a/w")),
        lambda folder: edit(folder, "permissions.p7s", lambda data: data[:-200]),
        lambda folder: edit(folder, "permissions.p7s", lambda _: b""),
        lambda folder: edit(folder, "permissions.xml", lambda data: data.replace(b"a/x", b"a/w")),
        lambda folder: remove(folder, "permissions.xml"),
        lambda folder: link(folder, "permissions.p7s"),
        lambda folder: link(folder, "permissions.xml"),
        put_back,
        forget,
        of_another,
    ],
    ids=[
        "edited",
        "cut",
        "empty",
        "edited-xml",
        "no-xml",
        "link",
        "xml-link",
        "put-back",
        "forgotten",
        "foreign",
    ],
)
def test_what_is_not_the_latest_sound_document_is_signed_again(
    spoil: Callable[[Path], None], folder: Path
) -> None:
    spoil(folder)
    changed = written(folder, lambda: state(folder))
    assert changed >= {"enclaves/a/permissions.p7s", *LEDGER}
    assert topics_of(folder / "ks/enclaves/a") == {"rt/a/x", "rt/a/y", "ros_discovery_info"}
    check_whole(folder / "ks")
    assert not (folder / "ks/enclaves/a/permissions.p7s").is_symlink()
    assert state(folder).kept == NAMES


def test_missing_files_come_back_without_a_signature(folder: Path) -> None:
    remove(folder, "governance.p7s")
    results: list[Creation] = []
    assert written(folder, lambda: results.append(state(folder))) == {"enclaves/a/governance.p7s"}
    assert (results[0].completed, results[0].kept) == (("/a",), ("/b", "/c"))
    remove(folder, "permissions.p7s")
    results = []
    changed = written(folder, lambda: results.append(state(folder)))
    assert changed >= {"enclaves/a/permissions.p7s", *LEDGER}
    assert results[0].kept == ("/b", "/c")


def test_permissions_that_expire_soon_are_signed_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    validity = read_credentials(OpenedKeystore(folder / "ks"), "/a").lifetime().permissions
    length = validity.not_after - NOW
    assert state(folder, NOW + length * 0.6).kept == NAMES
    late = NOW + length * 0.7
    assert state(folder, late).changed == NAMES
    assert (
        read_credentials(OpenedKeystore(folder / "ks"), "/a").lifetime().first_expiry()
        > validity.not_after
    )
    assert state(folder, late).kept == NAMES
    # A longer validity would not make them last longer than their certificate.
    end = read_credentials(OpenedKeystore(folder / "ks"), "/a").lifetime().certificate.not_after
    assert state(folder, end - 20 * DAY).changed == NAMES
    assert read_credentials(OpenedKeystore(folder / "ks"), "/a").lifetime().first_expiry() == end
    assert state(folder, end - DAY).kept == NAMES
    with pytest.raises(KeystoreError, match="3 enclaves are not valid now: /a, /b, /c") as late_for:
        state(folder, end + DAY)
    assert late_for.value.remedy.endswith("/ks /a /b /c`.")
    renew(folder / "ks", ["/c"], now=end - DAY)
    fleet = Fleet.of([Robot("a", "/a")], enclaves=["/{robot}"])
    monkeypatch.setattr("sros_tool.keystore.lifecycle.create.load_fleet", lambda _: fleet)
    with pytest.raises(KeystoreError, match="2 enclaves are not valid now: /a, /b") as late_for:
        state(folder, end + DAY)
    assert late_for.value.remedy.endswith("/ks /b --robot a`.")


def test_a_chosen_validity_takes_effect(folder: Path) -> None:
    """Also if it is shorter than what is there."""
    settings = folder / "ks/sros.toml"
    text = settings.read_text()
    before, _, after = text.partition("[permissions]")
    assert 'validity = "180d"' in after
    after = after.replace('"180d"', '"30d"', 1)
    settings.write_text(f"{before}[permissions]{after}")
    assert state(folder).changed == NAMES
    assert (
        read_credentials(OpenedKeystore(folder / "ks"), "/a").lifetime().first_expiry()
        == NOW + 30 * DAY
    )
    assert state(folder, NOW + DAY).kept == NAMES


def test_renewed_and_rotated_enclaves_keep_theirs(folder: Path) -> None:
    root = folder / "ks"
    renew(root, ["/a"], now=NOW, revoke_old=True)
    assert written(folder, lambda: state(folder)) == set()
    rotate_ca(root, now=NOW, finish=True)
    assert written(folder, lambda: state(folder)) == set()
    for words in (("--set", "protection.default.data=SIGN"), ("--domain", "7")):
        sros("update_keystore", root, *words, "--allow-looser").ok()
    assert written(folder, lambda: state(folder, datetime.now(UTC))) == set()
    check_whole(root)


def test_old_certificates_are_revoked_where_other_permissions_fit_them(folder: Path) -> None:
    ended = sros("create_permission", "ks", "/a", "policy.xml", cwd=folder).ok()
    assert ended.out == "signed the permissions of enclave /a again, with the same rights\n"
    words = ("generate_artifacts", "-k", "ks", "-p", "policy.xml", "--revoke-old")
    planned = sros(*words, "--dry-run", cwd=folder).ok()
    assert "would revoke 1 earlier certificate\n" in planned.out + planned.err
    assert sros(*words, cwd=folder).ok().out == ended.out
    again = sros(*words, cwd=folder).ok()
    assert not again.out and "revoke" not in again.err
    assert state(folder, datetime.now(UTC)).kept == NAMES


def test_after_a_restore_certificates_are_replaced_once(folder: Path) -> None:
    """What the ledger lacks cannot fit a subject that the keystore chose after the restore."""
    root, backup = folder / "ks", copy_of(folder / "ks", folder / "backup")
    renew(root, ["/a"], now=NOW)
    lost = LostRecords(OpenedKeystore(backup), NOW)
    assert lost.add_certificate(OpenedKeystore(root).certificate_of("/a"), REPORTED)
    restore_revocations(backup, lost, now=NOW)
    renew(backup, ["/a"], now=NOW + DAY, revoke_old=True)
    root.rename(folder / "lost")
    backup.rename(root)
    first, second = (state(folder, NOW + n * DAY, revoke_old=True) for n in (2, 3))
    assert (first.changed, first.kept, second.kept) == (("/b", "/c"), ("/a",), NAMES)
    assert first.revoked == 2 and not second.revoked
    (note,) = (each.text for each in first.notes if each.id == "permissions.others-fit")
    assert note.startswith("/b, /c: the certificates are new") and "restored from a backup" in note


@pytest.mark.parametrize(
    ("first", "between"),
    [
        (True, ("renew", "ks", "/a")),
        (False, ("rotate_ca", "ks", "--identity", "--finish")),
        (True, ("rotate_ca", "ks", "--finish")),
    ],
    ids=["renewed", "new identity CA", "new CAs"],
)
def test_what_works_besides_is_revoked(first: bool, between: tuple[str, ...], folder: Path) -> None:
    """A right was taken away before or after that: its permissions fit what still works."""
    words = ("generate_artifacts", "-k", "ks", "-p", "policy.xml")
    wide = (folder / "policy.xml").read_text().replace("</topics>", "<topic>/w</topic></topics>", 1)
    (folder / "wide.xml").write_text(wide)
    sros("create_permission", "ks", "/a", "wide.xml", cwd=folder).ok()
    if first:
        sros(*words, cwd=folder).ok()
    sros(*between, cwd=folder).ok()
    if not first:
        sros(*words, cwd=folder).ok()
    assert "/a" in sros(*words, "--revoke-old", cwd=folder).ok().out


def test_a_revoked_enclave_that_was_put_back_is_refused(folder: Path) -> None:
    root, backup = folder / "ks", folder / "backup"
    copy_of(root / "enclaves/a", backup)
    revoke(root, ["/a"], now=NOW)
    with pytest.raises(KeystoreError, match="a policy names /a, revoked"):
        state(folder)
    copy_of(backup, root / "enclaves/a")
    before = snapshot(root)
    with pytest.raises(KeystoreError, match="the key of enclave /a was revoked"):
        state(folder)
    assert snapshot(root) == before


def test_enclaves_without_a_policy_are_as_before(folder: Path) -> None:
    create_enclaves(folder / "ks", ["/spare"], now=NOW)
    assert written(folder, lambda: create_enclaves(folder / "ks", ["/spare"], now=NOW)) == set()
    (folder / "policy.xml").write_text(policy_text({"/spare": publish("/s")}))
    assert state(folder).changed == ("/spare",)
    assert state(folder).kept == ("/spare",)
