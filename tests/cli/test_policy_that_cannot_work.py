"""A policy whose nodes cannot start is said in one paragraph, also when it is signed."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from sros_tool.files import policies_dir
from tests.support.harness import sros

NODES = ("arm", "base", "camera", "drive", "grip", "head")


def write_policy(path: Path, nodes: tuple[str, ...] = NODES, more: str = "") -> Path:
    enclaves = "\n".join(
        f'<enclave path="/{node}"><profiles>\n<profile ns="/" node="{node}">\n'
        f'<topics publish="ALLOW"><topic>{node}/state</topic></topics>\n{more}\n'
        "</profile></profiles></enclave>"
        for node in nodes
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<policy version="0.2.0"><enclaves>\n{enclaves}\n</enclaves></policy>\n')
    return path


# ── the copy of the common part ────────────────────────────────────────────────────────────


def test_the_policies_are_copied_to_a_new_or_an_existing_folder(tmp_path: Path) -> None:
    sros("policies", "--copy", cwd=tmp_path).ok()
    assert (tmp_path / "policies/common/node.xml").is_file()
    here = tmp_path / "here"
    here.mkdir()
    (here / "robot.xml").write_text("mine")
    assert "copied" in sros("policies", "--copy", ".", cwd=here).ok().out
    assert (here / "common/node/types.xml").is_file()
    assert (here / "robot.xml").read_text() == "mine"
    assert "nothing to copy" in sros("policies", "--copy", ".", cwd=here).ok().out


def test_a_folder_named_common_gets_the_common_parts_alone(tmp_path: Path) -> None:
    sros("policies", "--copy", "common", cwd=tmp_path).ok()
    assert (tmp_path / "common/node.xml").is_file()
    assert not (tmp_path / "common/common").exists()
    assert not (tmp_path / "common/talker_listener.xml").exists()
    (tmp_path / "common/node.xml").unlink()
    (tmp_path / "common/own.xml").write_text("mine")
    planned = sros("policies", "--copy", "common", "--dry-run", "--json", cwd=tmp_path).ok()
    assert [each["path"] for each in json.loads(planned.out)["changes"]] == ["common/node.xml"]
    sros("policies", "--copy", "common", cwd=tmp_path).ok()
    assert (tmp_path / "common/node.xml").is_file()
    assert (tmp_path / "common/own.xml").read_text() == "mine"


def test_nothing_is_copied_over_a_file_that_differs(tmp_path: Path) -> None:
    (tmp_path / "common").mkdir()
    (tmp_path / "common/node.xml").write_text("mine")
    ended = sros("policies", "--copy", "common", cwd=tmp_path)
    assert ended.status == 2
    assert "'common/node.xml' differs" in ended.err
    assert [each.name for each in (tmp_path / "common").iterdir()] == ["node.xml"]
    (tmp_path / "file").write_text("")
    assert "is not a folder" in sros("policies", "--copy", "file", cwd=tmp_path).err


# ── one paragraph ──────────────────────────────────────────────────────────────────────────


def fixed(policy: Path, said: str) -> None:
    """Do what the paragraph says: its command, and its line in every profile."""
    (include,) = set(re.findall(r"<xi:include [^>]*/>", " ".join(said.split())))
    for command in re.findall("`(sros .+?)`", " ".join(said.split())):
        sros(*shlex.split(command)[1:], cwd=policy.parent).ok()
    text = policy.read_text()
    policy.write_text(re.sub(r"(<profile ns.*?>)", lambda start: start[1] + include, text))


def test_nodes_without_the_common_part_are_one_paragraph_with_one_mend(tmp_path: Path) -> None:
    policy = write_policy(tmp_path / "robot.xml")
    ended = sros("check", "robot.xml", cwd=tmp_path)
    assert ended.status == 1
    lines = ended.out.splitlines()
    assert len(lines) <= 12, ended.out
    assert "6 nodes lack rights that every node needs" in lines[0]
    assert "24 errors" in ended.err
    kinds = ("no-rosout", "no-parameter-events", "no-parameter-services", "no-type-description")
    assert all(f"policy.{kind}" in ended.out for kind in kinds)
    document = json.loads(sros("check", "robot.xml", "--json", cwd=tmp_path).out)
    (cause,) = document["causes"]
    assert len(document["findings"]) == 24
    assert sorted(cause["findings"]) == list(range(24))
    markdown = sros("check", "robot.xml", "--format", "markdown", cwd=tmp_path).out
    assert markdown.count("**error**") == 1
    before = policy.read_text()
    fixed(policy, ended.out)
    assert sros("check", "--strict", "robot.xml", cwd=tmp_path).ok().out == ""
    by_hand = policy.read_text()
    for between in (" ", "\n "):  # a start tag in one line, and in two
        policy.write_text(before.replace(" node=", f"{between}node="))
        (command,) = re.findall("`(sed .+?)`", sros("check", "robot.xml", cwd=tmp_path).out)
        subprocess.run(shlex.split(command), cwd=tmp_path, check=True)
        assert policy.read_text() == by_hand.replace(" node=", f"{between}node=")
    policy.write_text(before.replace("\n", ""))  # sed would edit the first profile alone, each time
    said = sros("check", "robot.xml", cwd=tmp_path).out
    assert "6 nodes lack rights that every node needs" in said and "`sed " not in said


def test_an_older_common_part_that_is_included_is_replaced(tmp_path: Path) -> None:
    policy = write_policy(tmp_path / "robot.xml", ("arm", "base"))
    fixed(policy, sros("check", "robot.xml", cwd=tmp_path).out)
    whole = (tmp_path / "common/node.xml").read_text()
    for gone, title in ((("types",), "may not offer ~"), (("types", "logging"), "lacks rights")):
        lines = [each for each in whole.splitlines() if not any(f"/{x}.xml" in each for x in gone)]
        (tmp_path / "common/node.xml").write_text("\n".join(lines))
        said = " ".join(sros("check", "robot.xml", cwd=tmp_path).out.split())
        assert title in said and "Put this line" not in said and "put this line" not in said
    (command,) = set(re.findall("`mv common (.+?) && (sros .+?)`", said))
    (tmp_path / "common").rename(tmp_path / command[0])
    sros(*shlex.split(command[1])[1:], cwd=tmp_path).ok()
    sros("check", "robot.xml", cwd=tmp_path).ok()


def test_a_cause_of_which_a_finding_is_left_out_is_not_one_paragraph(tmp_path: Path) -> None:
    write_policy(tmp_path / "robot.xml", ("arm",))
    whole = sros("check", "robot.xml", cwd=tmp_path)
    assert "a node lacks rights that every node needs" in whole.out
    part = sros("check", "robot.xml", "--exclude", "policy.no-rosout", cwd=tmp_path)
    assert "common part [" not in part.out
    assert len(part.out.splitlines()) == 9


def test_the_parameters_of_every_node_are_not_opened_by_a_remedy(tmp_path: Path) -> None:
    """With node="*", an author does not name the node."""
    topics = '<topics publish="ALLOW"><topic>/x</topic></topics>'
    for node, named in (("*", True), ("eye", False)):
        (tmp_path / "robot.xml").write_text(
            '<policy version="0.2.0"><enclaves><enclave path="/eye"><profiles>'
            f'<profile ns="/" node="{node}">{topics}</profile>'
            "</profiles></enclave></enclaves></policy>"
        )
        text = " ".join(sros("check", "robot.xml", cwd=tmp_path).out.split())
        assert ("First write the name of the node in place of '*'" in text) is named
        remedies = sros("check", "robot.xml", "--json", cwd=tmp_path).out
        assert ("First write the name" in remedies) is named


def test_a_profile_for_any_node_next_to_nodes_needs_nothing(tmp_path: Path) -> None:
    """`generate_policy --from-log` writes one where an enclave has several nodes."""
    policy = write_policy(tmp_path / "robot.xml", ("arm",))
    lacking = sros("check", "robot.xml", "--json", cwd=tmp_path).out
    shared = '<profile ns="/" node="*"><topics publish="ALLOW"><topic>x</topic></topics></profile>'
    policy.write_text(policy.read_text().replace("</profile>", f"</profile>{shared}", 1))
    assert sros("check", "robot.xml", "--json", cwd=tmp_path).out == lacking


def test_nodes_that_lack_less_are_counted(tmp_path: Path) -> None:
    log = '<topics publish="ALLOW"><topic>/rosout</topic></topics>'
    policy = write_policy(tmp_path / "robot.xml", ("arm", "base"))
    policy.write_text(policy.read_text().replace("<topics", f"{log}<topics", 1))
    said = " ".join(sros("check", "robot.xml", cwd=tmp_path).out.split())
    assert "publish /rosout (1 nodes)" not in said
    assert "publish /rosout (1 node)" in said
    fixed(policy, said)
    sros("check", "robot.xml", cwd=tmp_path).ok()


# ── when it is signed ──────────────────────────────────────────────────────────────────────


def signing(policy: str) -> list[list[str]]:
    return [
        ["generate_artifacts", "-k", "ks", "-p", policy],
        ["create_permission", "ks", "/arm", "/base", policy],
    ]


@pytest.mark.parametrize("dry_run", [False, True])
def test_a_policy_that_cannot_work_is_said_when_it_is_signed(tmp_path: Path, dry_run: bool) -> None:
    write_policy(tmp_path / "robot.xml", ("arm", "base"))
    sros("generate_artifacts", "-k", "ks", "-e", "/arm", "/base", cwd=tmp_path).ok()
    planned = ["--dry-run"] if dry_run else []
    for words in signing("robot.xml"):
        ended = sros(*words, *planned, cwd=tmp_path).ok()
        assert ended.err.count("2 nodes lack rights that every node needs") == 1
        assert "lack" not in ended.out
        document = json.loads(sros(*words, "--json", *planned, cwd=tmp_path).ok().out)
        notes = [each["text"] for each in document["notes"] if each["id"].startswith("policy.")]
        assert len(notes) == 1 and "2 nodes lack rights that every node needs" in notes[0]
    fixed(tmp_path / "robot.xml", ended.err)
    for words in signing("robot.xml"):
        assert "lack" not in sros(*words, *planned, cwd=tmp_path).ok().err


def test_only_what_is_signed_is_said(tmp_path: Path) -> None:
    write_policy(tmp_path / "robot.xml", ("arm", "base"))
    sros("generate_artifacts", "-k", "ks", "-e", "/arm", cwd=tmp_path).ok()
    ended = sros("create_permission", "ks", "/arm", "robot.xml", cwd=tmp_path).ok()
    assert "a node lacks rights that every node needs" in ended.err
    assert "/arm may not" in ended.err and "/base" not in ended.err


def test_a_policy_for_a_fleet_is_said_once_when_it_is_signed(tmp_path: Path) -> None:
    policy = write_policy(tmp_path / "robot.xml", ("arm",))
    policy.write_text(policy.read_text().replace('path="/', 'path="/{robot}/'))
    (tmp_path / "fleet.toml").write_text("[robots]\n" + "".join(f"r{n} = {{}}\n" for n in range(9)))
    words = ("generate_artifacts", "-k", "ks", "-p", "robot.xml", "--fleet", "fleet.toml")
    ended = sros(*words, cwd=tmp_path).ok()
    assert "a node lacks rights that every node needs" in ended.err


def test_more_than_a_few_kinds_of_findings_are_counted(tmp_path: Path) -> None:
    more = '<topics publish="ALLOW"><topic>/*</topic></topics>'
    wrong = '<services request="ALLOW"><service>/tf</service><service>/a*</service></services>'
    write_policy(tmp_path / "robot.xml", ("arm", "base"), more + wrong)
    ended = sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", cwd=tmp_path).ok()
    assert "warnings: see `sros check robot.xml`" in ended.err


# ── in a keystore ──────────────────────────────────────────────────────────────────────────


def test_a_keystore_is_checked_with_its_policy_and_without(tmp_path: Path) -> None:
    policy = write_policy(tmp_path / "robot.xml")
    sros("create_keystore", "ks", "--template", "production", cwd=tmp_path).ok()
    sign = ("generate_artifacts", "-k", "ks", "-p", "robot.xml")
    sros(*sign, cwd=tmp_path).ok()
    for strict in ((), ("--strict",)):
        alone = sros("check", "ks", *strict, cwd=tmp_path)
        assert alone.status == 1
        assert "6 enclaves in which no ordinary ROS 2 node" in alone.out
        assert "`sros generate_artifacts -k ks -p POLICY_FILE`" in alone.out
        assert len(alone.out.splitlines()) <= 10
        both = sros("check", "ks", "--policy", "robot.xml", *strict, cwd=tmp_path)
        assert both.status == 1
        assert "6 nodes lack rights that every node needs" in both.out
        assert "ordinary node" not in both.out
        assert len(both.out.splitlines()) <= 10
    one = sros("check", "ks/enclaves/arm", "--policy", "robot.xml", cwd=tmp_path)
    assert "a node lacks rights that every node needs" in one.out
    fixed(policy, both.out)
    sros(*sign, cwd=tmp_path).ok()
    sros("check", "ks", cwd=tmp_path).ok()
    sros("check", "ks", "--policy", "robot.xml", "--strict", cwd=tmp_path).ok()


def test_a_keystore_of_an_earlier_distribution_has_no_type_descriptions(tmp_path: Path) -> None:
    parts = ("logging", "parameters", "time")
    include = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="common/node/{}.xml" '
    more = "".join(include.format(part) + 'xpointer="xpointer(/profile/*)"/>' for part in parts)
    sros("policies", "--copy", "common", cwd=tmp_path).ok()
    write_policy(tmp_path / "robot.xml", ("arm",), more)
    sros("create_keystore", "ks", "--template", "production", cwd=tmp_path).ok()
    sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", cwd=tmp_path).ok()
    sros("check", "ks", "--distro", "humble", cwd=tmp_path).ok()
    assert "no node may offer ~/get_type_description" in sros("check", "ks", cwd=tmp_path).out


def test_nothing_is_said_of_enclaves_of_the_shipped_policies(tmp_path: Path) -> None:
    files = sorted(policies_dir().glob("*.xml"))
    sros("create_keystore", tmp_path / "ks", "--template", "production").ok()
    signed = sros("generate_artifacts", "-k", tmp_path / "ks", "-p", *files).ok()
    found = json.loads(sros("check", tmp_path / "ks", "--json").out)["findings"]
    assert not {each["id"] for each in found} & {"enclave.node-cannot-start"}
    assert "[policy.no" not in signed.err


def test_a_node_of_two_enclaves_counts_once(tmp_path: Path) -> None:
    profile = '<profiles><profile ns="/" node="n"/></profiles>'
    enclaves = "".join(f'<enclave path="{path}">{profile}</enclave>' for path in ("/a", "/b"))
    file = tmp_path / "policy.xml"
    file.write_text(f'<policy version="0.2.0"><enclaves>{enclaves}</enclaves></policy>')
    said = sros("check", file).out
    assert "a node lacks rights that every node needs" in said and "nodes)" not in said
