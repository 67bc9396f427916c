"""Each finding about keystores comes about where it should, and not in a sound keystore."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.checks.keystores.documents import TIME_WINDOW
from sros_tool.checks.keystores.files import INTERRUPTED
from sros_tool.checks.keystores.issued import OLD_PERMISSIONS, OLDER_LIST
from sros_tool.checks.keystores.keystore import keystore_findings, with_joined_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import NOTE, Finding
from sros_tool.dds.decision.vendors import FAST_DDS, joined_titles
from sros_tool.faults import remedy_in_original_keystore
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.lifecycle.create import create_keystore
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import pem
from sros_tool.pki.keys import key_pem, load_key
from sros_tool.policy.document import read_policy
from sros_tool.validity import iso
from tests.checks.bench import SECRET, Bench, new_key
from tests.checks.keystore_cases import CASES, STRANGER, also_trusted, give_away
from tests.support.harness import copy_of, policy_text, publish, snapshot, sros
from tests.support.long_form import some
from tests.support.users import as_root

pytest_plugins = ["tests.checks.sound_keystore"]

NOW = datetime.now(UTC)


def ids(bench: Bench) -> set[str]:
    options = {"now": bench.now, **bench.options}
    only = options.pop("only_enclaves", None)
    found = keystore_findings(
        OpenedKeystore(bench.checked), Circumstances(**options), only_enclaves=only
    )
    return {each.id for each in found}


def test_nothing_in_a_sound_keystore(bench: Bench) -> None:
    assert ids(bench) == set()
    bench.options["policies"] = (read_policy(bench.root.with_name("policy.xml")),)
    bench.options["domain"] = 0
    assert ids(bench) == set()


def test_nothing_in_a_sound_export(bench: Bench) -> None:
    bench.export()
    assert ids(bench) == set()


def test_nothing_in_a_sound_list(bench: Bench) -> None:
    bench.revoke(99)
    assert ids(bench) <= {"keystore.not-in-ledger"}


def test_permissions_of_another_enclave_are_no_earlier_ones(bench: Bench) -> None:
    CASES["enclave.permissions-subject"](bench)
    assert "enclave.old-permissions" not in ids(bench)


def test_exported_enclaves_of_two_keystores(bench: Bench) -> None:
    robot = bench.export()
    assert "keystore.authorities-differ" not in ids(bench)
    authority, _ = bench.foreign()
    (robot / "enclaves/arm/permissions_ca.cert.pem").write_bytes(pem(authority))
    assert "keystore.authorities-differ" in ids(bench)


def test_a_remedy_that_needs_ca_keys_is_for_the_original_keystore(bench: Bench) -> None:
    CASES["enclave.stale-permissions"](bench)
    CASES["enclave.xml-differs"](bench)

    def remedy(kind: str = "enclave.stale-permissions") -> str:
        options = {"now": bench.now, **bench.options}
        found = keystore_findings(OpenedKeystore(bench.checked), Circumstances(**options))
        return next(each.remedy for each in found if each.id == kind)

    assert f"`sros generate_artifacts -k {bench.root} -p POLICY_FILE`" in remedy()
    bench.path("fleet.toml").write_text("[robots.r1]\n")
    assert "-p POLICY_FILE --fleet FLEET_FILE`" in remedy()
    sign = f"create_permission {bench.root} /base POLICY_FILE --fleet FLEET_FILE`."
    assert remedy("enclave.xml-differs").endswith(sign)
    bench.path("fleet.toml").unlink()
    bench.export()
    told = remedy()
    assert told.startswith(
        "In the keystore that has the CA keys: Run `sros generate_artifacts -k K"
    )
    assert told.endswith("Then export the enclave again.")
    (bench.checked / "enclaves/base/permissions.xml").write_text("<dds/>")
    assert remedy("enclave.xml-differs").startswith("Delete permissions.xml: exports do not")


def test_the_remedy_of_an_interrupted_change_changes_nothing_else(tmp_path: Path) -> None:
    sros("create_keystore", root := tmp_path / "ks", "--template", "production").ok()
    sros("create_enclave", root, "/a").ok()
    before = snapshot(root)
    (root / ".sros-transaction").mkdir(0o700)
    command = INTERRUPTED.remedy.split("`")[1].replace("KEYSTORE", str(root))
    assert "no enclave needs to be renewed" in sros(*command.split()[1:]).ok().err
    assert snapshot(root) == before


def test_a_remedy_that_is_an_export_says_so_once() -> None:
    told = remedy_in_original_keystore(OLDER_LIST.remedy)
    assert told.lower().count("export the enclave again") == 1


def test_dates_that_are_not_valid_in_every_time_zone_have_a_remedy_that_helps(
    bench: Bench,
) -> None:
    """Under a young CA, an earlier not_before is not possible; later, a new one does not help."""
    permissions = open_enclave(bench.path("enclaves/base"), now=bench.now).permissions
    assert permissions
    validity = permissions.grants[0].validity
    wait = f"Wait until {iso(validity.not_before + timedelta(hours=12))}: then they are valid"
    for now, said in (
        (validity.not_before + timedelta(hours=11), wait),
        (validity.not_after - timedelta(hours=13), f"(`sros renew {bench.checked} /"),
    ):
        options = {"now": now, **bench.options}
        found = keystore_findings(OpenedKeystore(bench.checked), Circumstances(**options))
        remedies = [each.remedy for each in found if each.id == TIME_WINDOW.id]
        assert remedies and all(said in remedy for remedy in remedies), remedies
        assert all(("not_before" in remedy) == (said == wait) for remedy in remedies)


@pytest.mark.parametrize("expected", some([*CASES], 60))
def test_found(expected: str, bench: Bench) -> None:
    """Twin: `test_nothing_in_a_sound_keystore`."""
    CASES[expected](bench)
    assert expected in ids(bench)


# ── who can replace a keystore ─────────────────────────────────────────────────────────────

INNER = ("enclaves", "enclaves/base", "public", "private", "public/identity_ca.cert.pem")


@pytest.mark.parametrize("name", INNER)
@pytest.mark.parametrize("group", [STRANGER, None])
def test_what_a_group_can_change(name: str, group: int | None, bench: Bench) -> None:
    """Twin: a folder that only the private group of its owner can change."""
    path = bench.path(name)
    if group is not None:
        if os.geteuid() != 0:
            pytest.skip("only root can give a folder to another group")
        os.chown(path, -1, group)
    path.chmod(path.stat().st_mode | 0o020)
    assert ("keystore.others-write" in ids(bench)) is (group is not None)


@pytest.mark.parametrize(
    ("name", "mode", "found"),
    [
        ("..", 0o777, {"keystore.replaceable"}),
        ("../..", 0o777, {"keystore.replaceable"}),
        ("..", 0o1777, set()),  # as /tmp: only the owner of the keystore can rename it
        ("..", 0o755, set()),
        (".", 0o777, {"keystore.world-writable"}),
        (".", 0o1777, {"keystore.world-writable"}),
        ("enclaves", 0o1777, {"keystore.world-writable"}),
        ("enclaves/base", 0o1777, {"keystore.world-writable"}),
    ],
)
def test_what_everybody_can_change(
    name: str, mode: int, found: set[str], bench: Bench, tmp_path: Path
) -> None:
    bench.path(name).chmod(mode)
    for only in (None, ["base"]):
        bench.options["only_enclaves"] = only and ["/base"]
        assert {each for each in ids(bench) if each != "keystore.folder-open"} == found
    tmp_path.chmod(0o700)


@as_root
def test_a_keystore_of_another_user_is_one_finding(bench: Bench) -> None:
    for parent, folders, files in os.walk(bench.root):
        for each in (parent, *(os.path.join(parent, name) for name in (*folders, *files))):
            os.chown(each, STRANGER, STRANGER, follow_symlinks=False)
    assert ids(bench) == {"keystore.foreign-owner"}
    os.chown(bench.path("public"), 65531, -1)
    assert ids(bench) == {"keystore.foreign-owner", "keystore.others-write"}


@as_root
def test_an_export_may_belong_to_the_user_of_the_nodes(bench: Bench, tmp_path: Path) -> None:
    """`sros close` asks root to give the export to this user."""
    sros("distribute_key", bench.root, "--all", tmp_path / "export").ok()
    for keystore, is_export in ((bench.root, False), (tmp_path / "export", True)):
        give_away(keystore)
        found = keystore_findings(OpenedKeystore(keystore), Circumstances(bench.now))
        (remedy,) = (each.remedy for each in found if each.id == "keystore.foreign-owner")
        assert (f"If this is user {STRANGER}, change nothing" in remedy) is is_export
    # Next to the list of processes of `sros close`, it is as ordered; twins: another user, no
    # user, a folder or a list of a stranger, a folder that everybody can change.
    (tmp_path / "policy.xml").touch()
    listed = tmp_path / "processes.json"
    for user, owner, author, mode, is_found in (
        (STRANGER, 0, 0, 0o755, False),
        (1, 0, 0, 0o755, True),
        (float("inf"), 0, 0, 0o755, True),
        (STRANGER, STRANGER, 0, 0o755, True),
        (STRANGER, 0, STRANGER, 0o755, True),
        (STRANGER, 0, 0, 0o1777, True),
    ):
        process = {"enclave": "/base", "user": user}
        listed.write_text(json.dumps({"processes": [process], "not_here": []}))
        os.chown(listed, author, -1)
        os.chown(tmp_path, owner, -1)
        tmp_path.chmod(mode)
        found = keystore_findings(OpenedKeystore(tmp_path / "export"), Circumstances(bench.now))
        assert ("keystore.foreign-owner" in {each.id for each in found}) is is_found
    os.chown(tmp_path, 0, -1)


def test_a_link_to_the_keystore_that_others_own(bench: Bench) -> None:
    bench.checked = bench.root.with_name("link")
    bench.checked.symlink_to(bench.root)
    assert ids(bench) == set()
    give_away(bench.checked)
    assert ids(bench) == {"keystore.replaceable"}


@pytest.mark.parametrize(("mode", "found"), [(0o600, False), (0o640, True), (0o604, True)])
def test_a_ca_key_elsewhere_that_others_can_read(mode: int, found: bool, tmp_path: Path) -> None:
    places = {role: f"file:{tmp_path / role}.pem" for role in ("identity", "permissions")}
    template = load_template("production")
    root = tmp_path / "ks"
    create_keystore(root, template=template, now=NOW, keyring=Keyring(places=places))
    (tmp_path / "permissions.pem").chmod(mode)
    shown = {
        (each.id, each.file) for each in keystore_findings(OpenedKeystore(root), Circumstances(NOW))
    }
    wanted = {("keystore.key-readable", str(tmp_path / "permissions.pem"))} if found else set()
    plain = {("keystore.ca-key-plain", place.removeprefix("file:")) for place in places.values()}
    assert shown == wanted | plain


@pytest.mark.parametrize(
    ("key", "exported", "replaced_by"),
    [
        ("enclaves/base/key.pem", False, "`sros renew {root} /base --new-key --revoke-old`"),
        ("enclaves/base/key.pem", True, "`sros renew KEYSTORE /base --new-key --revoke-old`"),
        ("private/identity_ca.key.pem", False, "`sros rotate_ca {root} --finish --delete-old-key`"),
    ],
)
def test_a_key_that_others_may_have_copied_is_to_be_replaced(
    bench: Bench, key: str, exported: bool, replaced_by: str
) -> None:
    """chmod helps nothing against a copy."""
    if exported:
        bench.export()
    (bench.checked / key).chmod(0o644)
    found = keystore_findings(OpenedKeystore(bench.checked), Circumstances(bench.now))
    (readable,) = (each for each in found if each.id == "keystore.key-readable")
    assert readable.remedy.startswith(f"Run `chmod 600 {bench.checked / key}`. If others may have")
    assert f": {replaced_by.format(root=bench.checked)}. Then export the" in readable.remedy
    assert "that has the CA keys: `" in readable.remedy or not exported
    assert ("If the key was made on its robot, revoke" in readable.remedy) == exported


@pytest.mark.parametrize("file", ["cert.pem", "permissions.p7s", "identity_ca.cert.pem"])
def test_a_key_in_a_file_that_others_may_read(bench: Bench, file: str) -> None:
    """A program that wants certificate and key in one file makes a user append the key."""
    folder = bench.path("enclaves/base")
    path, data = folder / file, (folder / file).read_bytes()
    path.unlink()  # perhaps a link
    path.write_bytes(data + (folder / "key.pem").read_bytes())
    found = keystore_findings(OpenedKeystore(bench.checked), Circumstances(bench.now))
    shown = {each.id for each in found if each.file == str(path)}
    assert shown >= {"keystore.key-readable", "keystore.stray-key"}


@pytest.mark.parametrize(("mode", "noted"), [(0o755, False), (0o1777, False), (0o777, True)])
def test_a_new_keystore_that_others_can_replace_is_noted(
    mode: int, noted: bool, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    folder.chmod(mode)
    for words in (("create_keystore", "a"), ("generate_artifacts", "-e", "/x", "-k", "other")):
        made = sros(*words, cwd=folder).ok()
        assert ("keystore.replaceable" in made.err) is noted, made
        assert (str(folder) in made.err) is noted
    assert ("keystore.replaceable" in sros("verify", folder / "other").out) is noted


(LATER,) = joined_titles(vendor.title for vendor in FAST_DDS if vendor.traits.refuses_open_rtps)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((), f"on {LATER} the document is refused"),
        ((("rtps_protection_kind>ENCRYPT", "rtps_protection_kind>NONE"),), "they reach no topic"),
        (
            (
                ("rtps_protection_kind>ENCRYPT", "rtps_protection_kind>NONE"),
                ("read_access_control>true", "read_access_control>false"),
                ("write_access_control>true", "write_access_control>false"),
                ("metadata_protection_kind>ENCRYPT", "metadata_protection_kind>NONE"),
                ("data_protection_kind>ENCRYPT", "data_protection_kind>NONE"),
                ("discovery_protection_kind>ENCRYPT", "discovery_protection_kind>NONE"),
            ),
            f"on {LATER} anybody can read and write *",
        ),
    ],
)
def test_what_strangers_reach_is_said(
    changes: tuple[tuple[str, str], ...], words: str, bench: Bench
) -> None:
    bench.governance(("participants>false", "participants>true"))
    bench.sign("enclaves/governance.p7s", lambda text: _present(text, changes))
    found = keystore_findings(OpenedKeystore(bench.checked), Circumstances(bench.now))
    assert words in next(each.text for each in found if each.id == "governance.unauthenticated")


def _present(text: str, changes: tuple[tuple[str, str], ...]) -> str:
    for old, new in changes:
        text = text.replace(old, new)
    return text


def moved_out(bench: Bench, key: Path) -> Path:
    """Move the key of the identity CA out of the keystore, whose settings name it."""
    bench.path("private/identity_ca.key.pem").rename(key)
    settings, names = bench.path("sros.toml"), f'[authorities]\nidentity_key = "file:{key}"'
    settings.write_text(settings.read_text().replace("[authorities]", names))
    return key


def test_a_ca_key_outside_of_the_keystore_is_checked(bench: Bench, tmp_path: Path) -> None:
    plain, mismatch = "keystore.ca-key-plain", "keystore.ca-key-mismatch"
    pem = key_pem(bench.key("identity"))
    key = moved_out(bench, tmp_path / "key.pem")
    assert not {plain, mismatch} & ids(bench)
    key.write_bytes(pem)
    assert plain in ids(bench)
    key.write_bytes(key_pem(new_key()))
    assert mismatch in ids(bench)
    key.unlink()  # kept offline
    assert not {plain, mismatch, "keystore.file-unreadable"} & ids(bench)
    # A copy that was left in the keystore can be taken with it; another key cannot do anything.
    copy = bench.path("private/identity_ca.key.pem")
    copy.write_bytes(pem)
    assert plain in ids(bench)
    copy.write_bytes(key_pem(new_key()))
    assert not {plain, mismatch} & ids(bench)


@pytest.mark.parametrize("role", ["identity", "permissions"])
@pytest.mark.parametrize("folder", ["public", "enclaves/base"])
def test_a_ca_that_was_added_is_found_and_not_exported(
    folder: str, role: str, bench: Bench, tmp_path: Path
) -> None:
    also_trusted(bench, f"{folder}/{role}_ca.cert.pem")
    assert "keystore.unknown-authority" in ids(bench)
    assert f"UNKNOWN {role} CA: " in sros("inspect", bench.root).out
    refused = sros("distribute_key", bench.root, "/base", tmp_path / "robot")
    assert refused.status == 2 and "has a CA that the keystore does not know" in refused.err
    assert not (tmp_path / "robot").exists()


def test_an_added_ca_is_shown_although_the_other_ca_is_damaged(bench: Bench) -> None:
    also_trusted(bench, "public/permissions_ca.cert.pem")
    bench.path("public/identity_ca.cert.pem").write_bytes(b"damaged")
    assert "UNKNOWN permissions CA: " in sros("inspect", bench.root).out


def test_a_ca_that_was_added_is_noted_by_changes_and_replaced(bench: Bench) -> None:
    assert sros("inspect", bench.root).ok()
    also_trusted(bench, "public/identity_ca.cert.pem")
    assert sros("inspect", bench.root).status == 1
    secret = {"SROS_CA_PASSPHRASE": SECRET}
    assert "note [keystore.unknown-authority]" in sros("renew", bench.root, "/base", env=secret).err
    refused = sros("rotate_ca", bench.root, "--next", env=secret)
    assert refused.status == 2 and "which the keystore does not know" in refused.err
    done = sros("rotate_ca", bench.root, "--finish", env=secret).ok()
    assert "unknown-authority" not in done.err and "keystore.unknown-authority" not in ids(bench)


@pytest.mark.parametrize("file", ["enclaves/base/permissions.p7s", "enclaves/governance.p7s"])
def test_an_earlier_document_is_not_exported(file: str, bench: Bench, tmp_path: Path) -> None:
    earlier, secret = bench.path(file).read_bytes(), {"SROS_CA_PASSPHRASE": SECRET}
    looser = ("--set", "protection.discovery=NONE", "--allow-looser")
    (tmp_path / "policy.xml").write_text(policy_text({"/base": publish("x")}))
    sros("create_permission", bench.root, "/base", tmp_path / "policy.xml", env=secret).ok()
    sros("update_keystore", bench.root, *looser, env=secret).ok()
    words = ("distribute_key", bench.root, "/base", tmp_path / "robot")
    sros(*words, "--dry-run").ok()
    bench.path(file).write_bytes(earlier)
    refused = sros(*words)
    assert refused.status == 2 and "is older than the last signed " in refused.err


def test_an_earlier_revocation_list_is_not_exported(bench: Bench, tmp_path: Path) -> None:
    """And a renewal notes it."""
    kind = "keystore.revocation-list-lacks"
    CASES[kind](bench)
    words = ("distribute_key", bench.root, "/base", tmp_path / "robot")
    assert "keystore.enclave-revoked" in ids(bench)
    assert "lacks revoked certificates of /gone" in sros(*words).err
    shutil.rmtree(bench.path("enclaves/gone"))
    secret = {"SROS_CA_PASSPHRASE": SECRET}
    for renew in (("/base",), ("--all-expiring", "1d")):
        noted = sros("renew", bench.root, *renew, "--dry-run", env=secret).ok().err
        assert f"[{kind}]: the revocation list lacks revoked certificates of /gone:" in noted
    sros("crl", bench.root, "--refresh", env=secret).ok()
    assert kind not in sros("renew", bench.root, "/base", "--dry-run", env=secret).ok().err
    assert kind not in ids(bench)
    sros(*words).ok()


@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_remedy_for_few_rounds_runs(elsewhere: bool, bench: Bench, tmp_path: Path) -> None:
    kind = "keystore.ca-key-few-rounds"
    CASES[kind](bench)
    key = bench.path("private/identity_ca.key.pem")
    if elsewhere:
        key = moved_out(bench, tmp_path / "the key.pem")
    (found,) = (
        each
        for each in keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
        if each.id == kind
    )
    command = found.remedy.removeprefix("Run `").removesuffix("`.")
    secrets = "pkcs8 -passin env:SECRET -passout env:SECRET"
    subprocess.run(
        ["sh", "-c", command.replace("pkcs8", secrets)],
        env={**os.environ, "SECRET": SECRET},
        check=True,
    )
    assert kind not in ids(bench)
    assert load_key(key.read_bytes(), "", lambda: SECRET)
    assert key.stat().st_mode & 0o777 == 0o600


def mount_as_secret(enclave: Path, version: str) -> None:
    """Put the files of an enclave behind links, as Kubernetes mounts a Secret."""
    (enclave / version).mkdir()
    (enclave / "..data").symlink_to(version)
    for file in sorted(each for each in enclave.iterdir() if each.name[0] != "."):
        (enclave / version / file.name).write_bytes(file.read_bytes())
        file.unlink()
        file.symlink_to(f"..data/{file.name}")


def test_a_secret_that_kubernetes_mounts_hides_no_enclave(bench: Bench, tmp_path: Path) -> None:
    """Its hidden folder has the files of the enclave itself; any other one is an enclave."""
    robot = tmp_path / "robot"
    sros("distribute_key", bench.root, "/base", robot).ok()
    enclave = robot / "enclaves/base"
    mount_as_secret(enclave, "..2026_11_23_10_00_00.123")
    listed = sros("list_enclaves", robot).ok()
    assert (listed.out, listed.err) == ("/base\n", "")
    mounted = enclave / "..2026_11_23_10_00_00.123"
    mounted.chmod(0o700)
    (mounted / "key.pem").chmod(0o600)
    assert [
        each
        for each in keystore_findings(OpenedKeystore(robot), Circumstances(NOW))
        if each.severity is not NOTE
    ] == []
    (enclave / "..2025_11_23_10_00_00.123").mkdir()
    (enclave / "..2025_11_23_10_00_00.123/cert.pem").write_bytes(b"")
    listed = sros("list_enclaves", robot).ok()
    assert "/base/..2025_11_23_10_00_00.123" in listed.err
    found = keystore_findings(OpenedKeystore(robot), Circumstances(NOW))
    hidden = [each.subject for each in found if each.id == "keystore.hidden-enclave"]
    assert hidden == ["/base/..2025_11_23_10_00_00.123"]


def test_enclaves_in_hidden_folders_are_named_where_enclaves_are_listed(bench: Bench) -> None:
    copy_of(bench.path("enclaves/base"), bench.path("enclaves/.h"))
    ended = sros("list_enclaves", bench.root).ok()
    assert "/.h" not in ended.out.splitlines()
    assert "not listed, but loaded by DDS: 1 enclave in a hidden folder: /.h" in ended.err
    assert json.loads(sros("list_enclaves", bench.root, "--json").ok().out)["hidden"] == ["/.h"]


def test_a_remedy_for_several_enclaves_names_all_of_them() -> None:
    remedy = "Run `sros renew ks {}`; `sros explain ks {} join` says more."
    names = ("/a", "/b", "/c", "/d")
    found = [
        Finding(OLD_PERMISSIONS, name, "same", own_remedy=remedy.format(name, name))
        for name in names
    ]
    for number, shown in ((1, "/a"), (2, "/a /b"), (4, "ENCLAVE...")):
        (named,) = with_joined_findings(found[:number])
        assert named.remedy == remedy.format(shown, "/a"), named
