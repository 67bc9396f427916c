"""The bugs that were demonstrated in ros2/sros2, by their numbers; sros has none of them."""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from sros_tool.files import policies_dir
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.merge import merge_into
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right, policy_rights
from tests.support.harness import (
    Ended,
    policy_text,
    publish,
    snapshot,
    sros,
    topics_of,
    with_includes,
)

A = Path("enclaves/a")


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def refused(ended: Ended) -> str:
    """What the program said when it refused: one paragraph."""
    assert ended.status == 2, ended
    assert ended.err.count("\n") == 1, ended.err
    assert "Traceback" not in ended.err
    assert "defect" not in ended.err
    return ended.err


def test_bug_1_create_enclave_again_keeps_the_restriction(keystore: Path) -> None:
    before = snapshot(keystore)
    ended = sros("create_enclave", keystore, "/a").ok()
    assert "unchanged: 1 enclave: /a" in ended.err
    assert snapshot(keystore) == before
    sros("generate_artifacts", "-k", keystore, "-e", "/a", "/new").ok()
    assert "rt/*" not in topics_of(keystore / A)
    assert "rt/*" in topics_of(keystore / "enclaves/new"), "it would be seen if it were there"


def test_bug_2_nothing_wider_is_signed_on_the_way_to_a_policy(
    keystore: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every version of permissions that is ever written is the one that was asked for."""
    seen: list[bytes] = []
    write = os.write

    def watch(handle: int, data: bytes) -> int:
        seen.append(bytes(data))
        return write(handle, data)

    present = (keystore / "enclaves/a/permissions.p7s").read_bytes()  # looked at in a copy
    monkeypatch.setattr(os, "write", watch)
    policy = written(tmp_path / "p.xml", policy_text({"/new": publish("x"), "/a": publish("x")}))
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    documents = [data for data in seen if b"subject_name" in data and data != present]
    plain = [data for data in documents if data.startswith(b"<?xml")]
    assert len(plain) == 2, "permissions.xml of two enclaves; permissions.p7s is evaluated, too"
    assert len(documents) >= 4
    assert all(b"rt/x" in data and b"rt/*" not in data for data in documents)
    seen.clear()
    sros("create_enclave", keystore, "/open").ok()
    assert any(b"rt/*" in data for data in seen)


def test_bug_3_private_keys_are_closed(tmp_path: Path, free_umask: None) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/a", "/b/c").ok()
    sros("distribute_key", root, "/a", tmp_path / "out").ok()
    keys = [path for path in tmp_path.rglob("*key.pem") if not path.is_symlink()]
    assert len(keys) == 5
    for key in keys:
        assert stat.S_IMODE(key.stat().st_mode) == 0o600, key
        assert stat.S_IMODE(key.parent.stat().st_mode) == 0o700, key


@pytest.mark.parametrize("verb", ["create_keystore", "create_enclave", "generate_artifacts"])
@pytest.mark.parametrize("gone", [["*.key.pem"], ["identity_ca.key.pem"], ["*"]])
def test_bug_4_an_offline_ca_key_is_not_replaced(
    verb: str, gone: list[str], keystore: Path
) -> None:
    for pattern in gone:
        for path in (keystore / "private").glob(pattern):
            path.unlink()
    before = snapshot(keystore)
    words = {
        "create_keystore": ["create_keystore", keystore],
        "create_enclave": ["create_enclave", keystore, "/new"],
        "generate_artifacts": ["generate_artifacts", "-k", keystore, "-e", "/new"],
    }
    refused(sros(*words[verb]))
    assert snapshot(keystore) == before
    shutil.rmtree(keystore / "private")
    shutil.rmtree(keystore / "enclaves")
    before = snapshot(keystore)
    refused(sros("create_keystore", keystore))
    assert snapshot(keystore) == before


@pytest.mark.parametrize("name", ["../../z", "/../../z", "/a/../../z", "/a/./b", "/..", "z", "/z/"])
def test_bug_5_names_do_not_leave_the_keystore(name: str, keystore: Path, tmp_path: Path) -> None:
    before = snapshot(tmp_path)
    policy = written(tmp_path / "p.xml", policy_text({name: publish("x")}))
    for words in (
        ["create_enclave", keystore, name],
        ["create_permission", keystore, name, policy],
        ["generate_artifacts", "-k", keystore, "-e", name],
        ["generate_artifacts", "-k", keystore, "-p", policy],
        ["distribute_key", keystore, name, tmp_path / "out"],
        ["env", keystore, name],
        ["run", keystore, name, "--", "true"],
    ):
        refused(sros(*words))
    policy.unlink()
    assert snapshot(tmp_path) == before


POINTER = 'xpointer="xpointer(/profile/topic)"'

WAYS_IN = {
    "text": (f'<xi:include href="inside.xml" parse="text" {POINTER}/>', "plain text"),
    "text in a name": (
        '<topic><xi:include href="inside.xml" parse="text"/></topic>',
        "not a valid",
    ),
    "entity": ("<topic>&e;</topic>", "document type"),
    "entity in an attribute": ('<topic xml:base="&i;">x</topic>', "document type"),
    "outside": (f'<xi:include href="../secret.xml" {POINTER}/>', "leaves the folder"),
    "link": (f'<xi:include href="link.xml" {POINTER}/>', "leaves the folder"),
    "encoded": (f'<xi:include href="%2e%2e/secret.xml" {POINTER}/>', "leaves the folder"),
    "URL": (f'<xi:include href="file:inside.xml" {POINTER}/>', "leaves the folder"),
}


@pytest.mark.parametrize("way", WAYS_IN)
def test_bug_6_no_other_file_gets_into_permissions(
    way: str, keystore: Path, tmp_path: Path
) -> None:
    item, why = WAYS_IN[way]
    secret = written(tmp_path / "secret.xml", "<profile><topic>secret</topic></profile>")
    folder = tmp_path / "policies"
    folder.mkdir()
    shutil.copy(secret, folder / "inside.xml")
    (folder / "link.xml").symlink_to(secret)
    head = (
        f'<!DOCTYPE policy [<!ENTITY e SYSTEM "{secret}"><!ENTITY i "x">]>' if "&" in item else ""
    )

    def policy(item: str, head: str = "") -> Path:
        text = policy_text({"/a": f'<topics publish="ALLOW">{item}</topics>'})
        return written(folder / "p.xml", head + with_includes(text))

    before = snapshot(keystore)
    assert why in refused(sros("create_permission", keystore, "/a", policy(item, head)))
    assert snapshot(keystore) == before
    inside = policy(f'<xi:include href="inside.xml" {POINTER}/>')
    sros("create_permission", keystore, "/a", inside).ok()
    assert "rt/secret" in topics_of(keystore / A)


BOTH = '<topics publish="ALLOW" subscribe="ALLOW"><topic>both</topic></topics>'


def test_bug_7_what_is_merged_keeps_its_direction(tmp_path: Path) -> None:
    file = written(tmp_path / "file.xml", policy_text({"/a": BOTH}))
    seen = read_policy(
        written(tmp_path / "seen.xml", policy_text({"/a": publish("heard", "both")}))
    )
    merged = written(file, merge_into(file, seen).document.decode())
    assert policy_rights(read_policy(merged)) == {
        Right("/a", ALLOW, right, name)
        for right, name in (
            ("publish", "/both"),
            ("subscribe", "/both"),
            ("publish", "/heard"),
        )
    }


def test_bug_8_a_policy_with_metadata_survives(tmp_path: Path) -> None:
    text = policy_text({"/a": BOTH}).replace(
        "</profiles>", "<metadata><who>me</who></metadata></profiles>"
    )
    file = written(tmp_path / "file.xml", text)
    before = read_policy(file)
    assert "me" in before.enclaves[0].profiles[0].metadata
    file.write_bytes(policy_xml(before))
    assert read_policy(file) == before
    seen = read_policy(written(tmp_path / "seen.xml", policy_text({"/a": publish("x")})))
    file.write_bytes(merge_into(file, seen).document)
    assert (
        read_policy(file).enclaves[0].profiles[0].metadata
        == before.enclaves[0].profiles[0].metadata
    )


@pytest.mark.parametrize("role", ["identity", "permissions"])
def test_bug_9_a_ca_key_of_another_keystore_is_refused(
    role: str, keystore: Path, tmp_path: Path
) -> None:
    sros("create_keystore", tmp_path / "other").ok()
    shutil.copy(tmp_path / f"other/private/{role}_ca.key.pem", keystore / "private")
    before = snapshot(keystore)
    said = refused(sros("create_enclave", keystore, "/new"))
    assert "do not belong together" in said
    assert snapshot(keystore) == before


@pytest.mark.parametrize("domain", ["99999", "231", " 7 ", "-1", "7-3", "", "a", "0x7", "7,", "٧"])
def test_bug_10_domains_that_cannot_be_are_refused(domain: str, tmp_path: Path) -> None:
    refused(sros("create_keystore", tmp_path / "ks", "--domain", domain))
    if domain:
        environment = {"ROS_DOMAIN_ID": domain}
        refused(sros("create_keystore", tmp_path / "ks", env=environment))
    assert not list(tmp_path.iterdir())


def test_bug_10_an_enclave_for_another_domain_is_refused(keystore: Path, tmp_path: Path) -> None:
    seven = {"ROS_DOMAIN_ID": "7"}
    before = snapshot(keystore)
    for words in (
        ["create_enclave", keystore, "/new"],
        ["generate_artifacts", "-k", keystore, "-e", "/new"],
        ["env", keystore, "/a"],
        ["run", keystore, "/a", "--", "true"],
    ):
        assert "domain 0" in refused(sros(*words, env=seven))
    assert snapshot(keystore) == before
    sros("create_keystore", tmp_path / "seven", env=seven).ok()
    sros("create_enclave", tmp_path / "seven", "/new", env=seven).ok()
    document = (tmp_path / "seven/enclaves/new/permissions.xml").read_text()
    assert "<id>7</id>" in document


def test_bug_11_included_parts_outlive_their_documents(tmp_path: Path) -> None:
    """lxml crashes when nodes that came from an include are moved; ours never are."""
    for depth in range(20):
        inner = f'<xi:include href="p{depth + 1}.xml" xpointer="xpointer(/profile/*)"/>'
        written(
            tmp_path / f"p{depth}.xml",
            '<profile xmlns:xi="http://www.w3.org/2001/XInclude">'
            f"{publish(f'x{depth}')}{inner if depth < 19 else ''}</profile>",
        )
    text = policy_text(
        {f"/e{n}": '<xi:include href="p0.xml" xpointer="xpointer(/profile/*)"/>' for n in range(50)}
    )
    text = with_includes(text)
    child = os.fork()
    if child == 0:
        policy = read_policy(written(tmp_path / "p.xml", text))
        written(tmp_path / "out.xml", policy_xml(policy).decode())
        os._exit(len(read_policy(tmp_path / "out.xml").enclaves[49].profiles[0].profiles[0].groups))
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 20


def test_bug_12_an_enclave_given_twice_is_refused(keystore: Path, tmp_path: Path) -> None:
    once = policy_text({"/a": publish("one")})
    extra = once[once.index("<enclave path") : once.index("</enclaves>")].replace("one", "two")
    twice = written(tmp_path / "p.xml", once.replace("</enclaves>", extra + "</enclaves>"))
    other = written(tmp_path / "other.xml", once.replace("one", "two"))
    first = written(tmp_path / "first.xml", once)
    before = snapshot(keystore)
    for words in (
        ["create_permission", keystore, "/a", twice],
        ["generate_artifacts", "-k", keystore, "-p", twice],
        ["generate_artifacts", "-k", keystore, "-p", first, other],
        ["generate_artifacts", "-k", keystore, "-p", other, first],
    ):
        refused(sros(*words))
    assert snapshot(keystore) == before
    sros("generate_artifacts", "-k", keystore, "-p", first, first).ok()
    assert "rt/one" in topics_of(keystore / A)


@pytest.mark.parametrize("repeat", [True, False], ids=["-e A -e B", "-e A B"])
def test_bug_13_every_enclave_and_policy_counts(
    repeat: bool, keystore: Path, tmp_path: Path
) -> None:
    one = written(tmp_path / "1.xml", policy_text({"/p1": publish("x")}))
    two = written(tmp_path / "2.xml", policy_text({"/p2": publish("x")}))
    between = {"-e": ["-e"], "-p": ["-p"]} if repeat else {"-e": [], "-p": []}
    words = ["-e", "/e1", *between["-e"], "/e2", "-p", one, *between["-p"], two]
    sros("generate_artifacts", "-k", keystore, *words).ok()
    listed = sros("list_enclaves", keystore).ok().out.split()
    assert listed == ["/a", "/b", "/e1", "/e2", "/p1", "/p2"]


def test_bug_13_a_typo_makes_no_keystore(keystore: Path, tmp_path: Path) -> None:
    before = snapshot(tmp_path)
    said = refused(sros("generate_artifacts", "-k", tmp_path / "kss", "-e", "/a"))
    assert "'ks'" in said
    assert snapshot(tmp_path) == before
    sros("generate_artifacts", "-k", tmp_path / "something", "-e", "/a").ok()


def test_bug_14_the_root_enclave_is_listed_by_its_name(keystore: Path, tmp_path: Path) -> None:
    sros("create_enclave", keystore, "/").ok()
    assert sros("list_enclaves", keystore).ok().out.split() == ["/", "/a", "/b"]
    sros("env", keystore, "/").ok()
    sros("distribute_key", keystore, "/", tmp_path / "out").ok()
    assert sros("list_enclaves", tmp_path / "out").ok().out.split() == ["/"]


def _latin_1(keystore: Path, folder: Path) -> list[str | Path]:
    policy = folder / "latin-1.xml"
    policy.write_bytes(policy_text({"/a": publish("caf\xe9")}).encode("latin-1"))
    return ["create_permission", keystore, "/a", policy]


def _malformed(keystore: Path, folder: Path) -> list[str | Path]:
    return ["create_permission", keystore, "/a", written(folder / "p.xml", "<policy")]


def _missing_enclave(keystore: Path, folder: Path) -> list[str | Path]:
    policy = written(folder / "p.xml", policy_text({"/c": publish("x")}))
    return ["create_permission", keystore, "/c", policy]


def _root_is_a_file(keystore: Path, folder: Path) -> list[str | Path]:
    return ["create_keystore", written(folder / "file", "")]


def _dangling(keystore: Path, folder: Path) -> list[str | Path]:
    (folder / "dangling").symlink_to("nowhere")
    return ["create_keystore", folder / "dangling"]


def _corrupt_key(keystore: Path, folder: Path) -> list[str | Path]:
    written(keystore / "private/identity_ca.key.pem", "-----BEGIN PRIVATE KEY-----\nx")
    return ["create_enclave", keystore, "/c"]


TRACEBACKS: dict[str, Callable[[Path, Path], list[str | Path]]] = {
    "missing policy": lambda ks, folder: ["create_permission", ks, "/a", folder / "no.xml"],
    "malformed policy": _malformed,
    "missing enclave": _missing_enclave,
    "a quote in the name": lambda ks, _: ["create_enclave", ks, "/it's"],
    "latin-1": _latin_1,
    "KEYSTORE is a file": _root_is_a_file,
    "KEYSTORE is a dangling link": _dangling,
    "corrupt CA key": _corrupt_key,
}


@pytest.mark.parametrize("case", TRACEBACKS)
def test_bug_15_trouble_is_told_in_one_paragraph(case: str, keystore: Path, tmp_path: Path) -> None:
    words = TRACEBACKS[case](keystore, tmp_path)
    before = snapshot(tmp_path)
    refused(sros(*words))
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    "groups",
    [
        '<topics publish="ALLOW"><topic></topic></topics>',
        '<topics publish="ALLOW"><topic> </topic></topics>',
        '<topics publish="ALLOW"><topic>a b</topic></topics>',
        '<topics publish="ALLOW"><topic>~x</topic></topics>',
        "<topics><topic>x</topic></topics>",
        '<topics publish="ALLOW"/>',
    ],
)
def test_bug_16_rules_that_can_match_nothing_are_refused(
    groups: str, keystore: Path, tmp_path: Path
) -> None:
    policy = written(tmp_path / "p.xml", policy_text({"/a": groups}))
    before = snapshot(keystore)
    refused(sros("create_permission", keystore, "/a", policy))
    assert snapshot(keystore) == before


# 17 is in integration/test_kill.py: eight real processes at once.


def test_bug_18_a_bad_enclave_in_the_middle_leaves_nothing(keystore: Path, tmp_path: Path) -> None:
    before = snapshot(keystore)
    names = ["/c", "/d", "/b/permissions?", "/e"]
    refused(sros("create_enclave", keystore, *names))
    # One that is only found to be bad when it is its turn:
    (keystore / "enclaves/b/key.pem").unlink()
    broken = snapshot(keystore)
    policy = written(
        tmp_path / "p.xml", policy_text(dict.fromkeys(["/a", "/b", "/c"], publish("x")))
    )
    assert "/b" in refused(sros("generate_artifacts", "-k", keystore, "-p", policy))
    assert snapshot(keystore) == broken
    assert before.keys() - broken.keys() == {"enclaves/b/key.pem"}


def test_bug_19_a_name_too_long_for_a_certificate_is_refused(
    keystore: Path, tmp_path: Path
) -> None:
    longest = "/" + "n" * 63
    before = snapshot(keystore)
    assert "64" in refused(sros("create_enclave", keystore, longest + "n"))
    assert snapshot(keystore) == before
    sros("create_enclave", keystore, longest).ok()
    assert sros("env", keystore, longest).ok()


def test_bug_20_the_output_does_not_depend_on_the_rmw(keystore: Path, tmp_path: Path) -> None:
    policy = policies_dir() / "talker_listener.xml"
    documents = set()
    for rmw in (None, "rmw_connextdds", "rmw_fastrtps_cpp", "nonsense"):
        root = tmp_path / str(rmw)
        env = {"RMW_IMPLEMENTATION": rmw}
        sros("create_keystore", root, env=env).ok()
        sros("generate_artifacts", "-k", root, "-p", policy, env=env).ok()
        folder = root / "enclaves/talker_listener/talker"
        text = (folder / "permissions.xml").read_text()
        text = re.sub(r"<not_(before|after)>.*?<", "<", text)
        documents.add((text, (root / "enclaves/governance.xml").read_text()))
    assert len(documents) == 1


def test_bug_20_a_deployed_keystore_can_be_listed_and_run(keystore: Path, tmp_path: Path) -> None:
    sros("distribute_key", keystore, "/a", tmp_path / "out").ok()
    assert not (tmp_path / "out/private").exists()
    assert sros("list_enclaves", tmp_path / "out").ok().out.split() == ["/a"]
    sros("env", tmp_path / "out", "/a").ok()


def test_bug_21_a_node_in_a_namespace_logs_to_rosout_and_has_all_its_services(
    keystore: Path, tmp_path: Path
) -> None:
    shutil.copytree(policies_dir() / "common", tmp_path / "common")
    include = '<xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/>'
    text = policy_text({"/a": include}).replace('ns="/"', 'ns="/robot/arm"')
    policy = written(tmp_path / "p.xml", with_includes(text))
    sros("create_permission", keystore, "/a", policy).ok()
    topics = topics_of(keystore / A)
    assert "rt/rosout" in topics
    assert "rq/robot/arm/n/get_type_descriptionRequest" in topics
    assert "rr/robot/arm/n/get_type_descriptionReply" in topics
    assert not [topic for topic in topics if "arm/rosout" in topic]
