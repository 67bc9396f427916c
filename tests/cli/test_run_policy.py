"""`sros run --policy`: the enclave of a process is the one in which the policy has its node."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from sros_tool.cli.common import now
from sros_tool.enclave_environment import other_node_notes
from sros_tool.keystore.reader import OpenedKeystore
from tests.support.harness import Ended, forked, sros

SHOW = "import json, os, sys; print(json.dumps([dict(os.environ), sys.argv]))"
POLICY = """<policy version="0.2.0"><enclaves>
<enclave path="/line/talker"><profiles>
  <profile ns="/" node="talker"><topics publish="ALLOW"><topic>/chatter</topic></topics></profile>
  <profile ns="/left/arm" node="talker"><topics publish="ALLOW"><topic>/a</topic></topics></profile>
  <profile ns="/left" node="hidden"><services reply="ALLOW"><service>~/get_parameters</service>
  </services></profile>
</profiles></enclave>
<enclave path="/line/listener"><profiles>
  <profile ns="/" node="listener"><topics subscribe="ALLOW"><topic>/a</topic></topics></profile>
  <profile ns="/" node="both"><topics subscribe="ALLOW"><topic>/a</topic></topics></profile>
</profiles></enclave>
<enclave path="/line/other"><profiles>
  <profile ns="/" node="both"><topics subscribe="ALLOW"><topic>/a</topic></topics></profile>
</profiles></enclave>
<enclave path="/wild"><profiles>
  <profile ns="/" node="wild_*"><topics subscribe="ALLOW"><topic>/a</topic></topics></profile>
</profiles></enclave>
</enclaves></policy>"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore in ``ks`` and its policy in ``p.xml``; only read."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "p.xml").write_text(POLICY)
    forked("generate_artifacts", "-k", folder / "ks", "-p", folder / "p.xml").ok()
    return folder


def run(made: Path, *ros_args: str, root: tuple[object, ...] | None = None) -> Ended:
    words = (made / "ks",) if root is None else root
    command = (sys.executable, "-c", SHOW, "--ros-args", *ros_args)
    env = {**os.environ, "ROS_SECURITY_KEYSTORE": str(made / "ks")}
    return forked("run", *words, "--policy", made / "p.xml", "--", *command, env=env)


@pytest.mark.parametrize(
    ("ros_args", "enclave"),
    [
        (("-r", "__node:=talker"), "/line/talker"),
        (("-r", "__node:=talker", "-r", "__ns:=/left/arm"), "/line/talker"),
        (("--remap", "__ns:=/", "--remap", "__node:=listener"), "/line/listener"),
        # The first rule that matches counts; that of the namespace is for the new name.
        (("-r", "__node:=talker", "-r", "talker:__ns:=/left/arm"), "/line/talker"),
        (("-r", "__node:=listener", "-r", "x:__ns:=/left", "-r", "__ns:=/"), "/line/listener"),
        (("-r", "x:__node:=talker", "-r", "__node:=talker"), "/line/talker"),
        (("-r", "__node:=talker", "-r", "x:__node:=listener"), "/line/talker"),
        (("-r", "/a:=/b", "-r", "__name:=talker", "-r", "__node:=listener"), "/line/talker"),
    ],
)
def test_the_enclave_is_that_of_the_node(
    made: Path, ros_args: tuple[str, ...], enclave: str
) -> None:
    environment, words = json.loads(run(made, *ros_args).ok().out)
    assert environment["ROS_SECURITY_ENCLAVE_OVERRIDE"] == enclave
    assert environment["ROS_SECURITY_STRATEGY"] == "Enforce"
    assert words[-2:] == ["--enclave", enclave]


def test_the_keystore_may_come_from_the_environment(made: Path) -> None:
    environment, _ = json.loads(run(made, "-r", "__node:=talker", root=()).ok().out)
    assert environment["ROS_SECURITY_ENCLAVE_OVERRIDE"] == "/line/talker"


@pytest.mark.parametrize(
    ("ros_args", "why"),
    [
        ((), "names no node"),
        (
            ("-r", "talker:__node:=listener"),
            "/listener if its own name is talker, else it keeps its own name. Name the enclave: "
            "`sros run KEYSTORE /line/listener -- COMMAND`",
        ),
        (
            ("-r", "talker:__node:=talker", "-r", "__node:=listener"),
            "/talker if its own name is talker, else /listener. Name the enclave: `sros run "
            "KEYSTORE ENCLAVE ",
        ),
        (("-r", "__node:=talker", "-r", "talker:__ns:=/left", "-r", "__ns:=/"), "/left/talker in"),
        (("-r", "__ns:=/left"), "names no node"),
        (
            ("-r", "listener:/a:=/b"),
            "names no node. The policy assigns enclaves to node names, and `--ros-args -r "
            "__node:=NAME` sets the name. If the process has the node /listener (a remapping "
            "rule names it), run `sros run KEYSTORE /line/listener -- COMMAND`.",
        ),
        (("-r", "both:/a:=/b"), "in an enclave of its own"),
        (
            ("-r", "__node:=talker", "-r", "__ns:=/left/arm/"),
            "ends with '/'. ROS starts no node in it. Write `-r __ns:=/left/arm`.",
        ),
        (("--", "-r", "__node:=talker"), "names no node"),
        (("-p", "__node:=talker"), "names no node"),
        (("-r", "__node:="), "names no node"),
        (("-r", "__node:=nobody"), "has the node /nobody in no enclave"),
        (("-r", "__node:=talker", "-r", "__ns:=/left"), "node /left/talker in no enclave"),
        (
            ("-r", "__node:=hidden"),
            "in the policy: /left/hidden. Name the namespace: `-r __ns:=/left`",
        ),
        (("-r", "__node:=taker"), "Perhaps you mean /talker"),
        (("-r", "__node:=wild_7"), "as in /wild_*, count only for the node of `ros2 launch`."),
        (
            ("-r", "__node:=wilde"),
            'Give the node a profile in exactly one enclave: `<profile ns="/" node="wilde">`',
        ),
        (("-r", "__node:=both"), "in 2 enclaves: /line/listener, /line/other"),
        (("-r", "__node:=\x1b[2Jtalker"), "\\x1b[2Jtalker in no enclave"),
    ],
)
def test_what_is_in_no_single_enclave_is_not_started(
    made: Path, ros_args: tuple[str, ...], why: str
) -> None:
    ended = run(made, *ros_args)
    assert (ended.status, ended.out) == (2, "")
    assert why in ended.err and "\x1b" not in ended.err and ended.err.count("\n") == 1


def test_a_node_that_the_permissions_lack_is_named_before_it_starts(
    made: Path, tmp_path: Path
) -> None:
    export = tmp_path / "export"  # which has no ledger with the nodes that offer no service
    sros("distribute_key", made / "ks", "/line/talker", export).ok()
    for root, ros_args, missed in (
        (made / "ks", "-r __ns:=/right", "a node in the namespace /right"),
        (made / "ks", "-r __node:=hidden -r __ns:=/right", "the node /right/hidden"),
        (made / "ks", "-r __node:=other", "a node with the name other"),
        (made / "ks", "-r __node:=talker -r __ns:=/left/arm", ""),
        (made / "ks", "-r __node:=hidden", "no namespace"),
        (made / "ks", "-r talker:__ns:=/right -r __ns:=/right", "the node /right/talker"),
        (made / "ks", "-r x:__node:=y -r __node:=other", "a node with the name y"),
        (made / "ks", "-r talker:__ns:=/right", ""),  # it may be for a node that is not there
        (export, "-r x:__node:=hidden -r __node:=hidden", "no namespace"),
        (made / "ks", "", ""),  # it may be /talker
        (made / "ks", "-r __ns:=/left", ""),
        (export, "-r __node:=hidden -r __ns:=/right", "the node /right/hidden"),
        (export, "-r __node:=talker -r __ns:=/left/arm", ""),
        (export, "-r __ns:=/right", ""),
        (export, "-r __node:=other", ""),
        (export, "-r __node:=hidden", "no namespace"),
        (export, "", ""),
    ):
        words = ("true", "--ros-args", *ros_args.split())
        notes = other_node_notes(OpenedKeystore(root), "/line/talker", words, now=now())
        said = [note.text for note in notes]
        start = "the command names" if missed == "no namespace" else "the command starts"
        assert [text.startswith(f"{start} {missed}, ") for text in said] == [True] * bool(missed)


def test_a_policy_and_an_enclave_exclude_each_other(made: Path) -> None:
    ended = run(made, "-r", "__node:=talker", root=(made / "ks", "/line/talker"))
    assert ended.status == 2 and "--policy and the enclave /line/talker exclude" in ended.err


def test_a_policy_that_cannot_be_read_starts_nothing(made: Path, tmp_path: Path) -> None:
    bomb = '<!DOCTYPE p [<!ENTITY a "aaaa">]><policy version="0.2.0">&a;</policy>'
    for number, text in enumerate(("", "<policy", bomb)):
        (tmp_path / f"{number}.xml").write_text(text)
        words = ("--policy", tmp_path / f"{number}.xml", "--", "touch", tmp_path / "ran")
        ended = forked("run", made / "ks", *words, "--ros-args", "-r", "__node:=talker")
        assert ended.status == 2 and "Traceback" not in ended.err, text
    assert not (tmp_path / "ran").exists()
