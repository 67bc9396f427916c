"""merge_policy, diff_policy and minimize_policy, as somebody at a terminal meets them."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest

from benchmarks.inputs import enclaves_policy, topics_policy
from sros_tool.files import policies_dir, replace_file
from sros_tool.names import NODE_SERVICES
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import policy_rights
from tests.support.harness import (
    may,
    policy_text,
    publish,
    snapshot,
    sros,
    subscribe,
    with_includes,
)
from tests.support.long_form import sometimes

DENY = '<topics publish="DENY"><topic>cmd_vel</topic></topics>'
A = '<?xml version="1.0"?>\n<!-- mine -->\n' + policy_text({"/a": publish("x", "/cam/*") + DENY})
B = policy_text({"/a": publish("x", "y", "/cam/a", "cmd_vel"), "/b": publish("z")})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "a.xml").write_text(A)
    (tmp_path / "b.xml").write_text(B)
    monkeypatch.chdir(tmp_path)
    return tmp_path


# ── merge_policy ───────────────────────────────────────────────────────────────────────────

ADDED = ["/a ALLOW publish topic /y", "/b ALLOW publish topic /z"]
STILL = (
    "note [merge.still-denied]: /a DENY publish topic /cmd_vel stays, and overrides "
    "requested rights: publish topic /cmd_vel."
)


def test_a_merge_counts_what_every_node_needs_and_notes_a_shared_enclave(folder: Path) -> None:
    """Only the namespace was changed for the second instance, and not the path of its enclave."""
    node = policy_text({"/a": publish("z", "/rosout")})
    (folder / "left.xml").write_text(node.replace('ns="/"', 'ns="/left"'))
    said = sros("merge_policy", "a.xml", "left.xml").ok().err.splitlines()
    assert said[:3] == [
        "added 2 rights",
        "  /a ALLOW publish topic /left/z",
        "  and 1 right that every node needs",
    ]
    assert "note [merge.several-instances]: /a has the node n in /, /left: " in said[3]
    found = sros("check", "a.xml", "left.xml", "--include", "policy.several-instances").ok().err
    assert "nothing found (not shown: 1 note" in found


@pytest.mark.parametrize("node", ["*", "a*", "?", "_ros2cli_*"])
def test_only_a_right_of_one_node_is_one_that_every_node_needs(folder: Path, node: str) -> None:
    """By a wildcard, /light can pose as any node; only a tool's name ends with a process id."""
    served = "".join(f"<service>~/{service}</service>" for service in NODE_SERVICES)
    basics = f'{publish("/rosout")}<services reply="ALLOW">{served}</services>'
    text = policy_text({"/light": basics}).replace('node="n"', f'node="{node}"')
    (folder / "light.xml").write_text(text)
    said = sros("merge_policy", "a.xml", "light.xml", "-o", "o.xml").ok().err
    drawn = sros("view", "o.xml", "--format", "markdown").ok().out
    is_one = node == "_ros2cli_*"
    assert f"  and {'8 rights' if is_one else '1 right'} that every node needs" in said
    for service in NODE_SERVICES:
        assert (f"/light ALLOW reply service /{node}/{service}\n" in said) is not is_one
        assert (f"/{node}/{service}`" in drawn) is not is_one


def test_a_merge_notes_an_enclave_that_gets_nodes_of_another_policy(folder: Path) -> None:
    of_package = policy_text({"/a": publish("/p1", "/p2"), "/b": publish("/q")})
    of_package = of_package.replace('node="n"', 'node="driver"', 1).replace('"n"', '"other"')
    (folder / "package.xml").write_text(of_package)
    said = sros("merge_policy", "a.xml", "package.xml", "--in-place").ok().err.splitlines()
    (note,) = [line for line in said if "merge.shared-enclave" in line]
    assert "/a has the node /n, and now also the node /driver: each process" in note
    remedy = "`--node driver --enclave /NAME` (then merge the other nodes into the result in a"
    assert f"give one of them another enclave, in its policy or with {remedy}" in note
    # A later version of the same package is no surprise.
    (folder / "package.xml").write_text(of_package.replace("/p1", "/p3"))
    assert "merge.shared-enclave" not in sros("merge_policy", "a.xml", "package.xml").ok().err


def test_a_merge_notes_rights_of_another_version_or_program(folder: Path) -> None:
    for names, kept in ((("y", "x"), True), (("y",), False), (("x", "/cam/*"), False)):
        (folder / "b.xml").write_text(policy_text({"/a": publish(*names), "/b": publish("z")}))
        noted = sros("merge_policy", "a.xml", "b.xml").ok().err
        assert ("does not give: /a publish topic /cam/*. If they are of a later" in noted) is kept
        assert ("no longer runs, take them out" in noted) is kept
        assert ("another program with this node name, merge with" in noted) is kept
        assert ("merge.kept-rights" in noted) is kept  # a patch has only rights that are missing


def test_a_component_container_does_not_make_two_packages_one(folder: Path) -> None:
    """Twin: the next version of the package, with one more component."""
    basics = publish("/rosout")
    load = '<services reply="ALLOW"><service>~/_container/load_node</service></services>'
    for name, nodes in (("one", "a"), ("other", "b"), ("next", "a b")):
        own = (f'</profile><profile ns="/" node="{n}">{publish(n)}' for n in nodes.split())
        text = policy_text({"/pipeline": basics + load + "".join(own)})
        (folder / f"{name}.xml").write_text(text.replace('node="n"', 'node="container"'))
    noted = "/pipeline has the nodes /a, /container, and now also the node /b: each process"
    assert noted in sros("merge_policy", "one.xml", "other.xml").ok().err
    assert "shared-enclave" not in sros("merge_policy", "one.xml", "next.xml").ok().err


IN_TWO_ENCLAVES = ("gripper.xml", "water.xml", "--enclave", "/w")
SHARED = "note [merge.shared-enclave]: /valve already has a node /valve, and the merged policy"


def test_a_merge_notes_a_node_of_another_package_with_the_same_name(folder: Path) -> None:
    """Twins: the package again, its next version, what an audit found missing, another namespace.

    Rights that any node may have do not make two packages one.  Two enclaves do not hide that nodes
    have the same name, unless the policy had both before.
    """
    of_any = ("/rosout", "/diagnostics", "~/transition_event")
    for name, topics in (
        ("own", ("/x",)),
        ("gripper", ("pressure", "state", *of_any)),
        ("next", ("pressure", "status", *of_any)),
        ("water", ("flow", *of_any)),
        ("missing", ("flow",)),
    ):
        text = policy_text({"/valve" if name != "own" else "/own": publish(*topics)})
        (folder / f"{name}.xml").write_text(text.replace('node="n"', 'node="valve"'))
    (folder / "robot.xml").write_text(sros("merge_policy", "own.xml", "gripper.xml").ok().out)
    for words, said in (
        (("robot.xml", "water.xml"), True),
        (("own.xml", "gripper.xml", "water.xml"), True),
        (("robot.xml", "gripper.xml"), False),
        (("robot.xml", "next.xml"), False),
        (("robot.xml", "missing.xml"), False),
        (("robot.xml", "water.xml", "--namespace", "/left"), False),
        (("robot.xml", "water.xml", "--enclave", "/w", "--remap", "__node:=w"), False),
    ):
        err = sros("merge_policy", *words).ok().err
        assert (SHARED in err) == said, words
        assert ("If they are two versions of one program, ignore this note." in err) == said, words
    (folder / "two.xml").write_text(sros("merge_policy", *IN_TWO_ENCLAVES).ok().out)
    for words, said in (
        (IN_TWO_ENCLAVES, True),
        (("two.xml", *IN_TWO_ENCLAVES[1:]), False),
        (("two.xml", "a.xml"), False),
        ((*IN_TWO_ENCLAVES, "--remap", "__node:=w"), False),
        ((*IN_TWO_ENCLAVES, "--namespace", "/left"), False),
    ):
        text = "note [merge.node-in-two-enclaves]: the node /valve is now in /valve, /w, but names"
        err = sros("merge_policy", *words).ok().err
        assert (text in err) is said is ("node-in-two-enclaves" in err), words


def test_a_remedy_for_one_node_leaves_other_nodes_in_their_enclaves(folder: Path) -> None:
    """--enclave alone would give the panel's rights to the driver, and the DENY to the panel."""
    of_all = publish("/rosout")
    denied = '<topics subscribe="DENY"><topic>/*motor</topic></topics>'
    asks = '<services request="ALLOW"><service>driver/home</service></services>'

    def file(name: str, text: str, *nodes: str) -> None:
        for node in nodes:
            text = text.replace('node="n"', f'node="{node}"', 1)
        (folder / name).write_text(text)

    def noted(*words: str) -> dict[str, str]:
        err = sros("merge_policy", *words).ok().err
        return dict(re.findall(r"^note \[merge\.(.*?)\]: (.*)$", err, re.MULTILINE))

    file("winch.xml", policy_text({"/driver": publish("load") + of_all}), "driver")
    enclaves = {
        "/driver": publish("lift", "up") + of_all + denied,
        "/panel": publish("motor") + asks,
    }
    file("lift.xml", policy_text(enclaves), "driver", "panel")
    said = noted("winch.xml", "lift.xml")
    first, second = re.findall(r"`(.*?)`", said["shared-enclave"])
    assert first == "--node driver --enclave /NAME --remap driver:__node:=NAME"
    assert second == "--node panel --remap driver/home:=NAME/home"
    assert "joined-enclaves" not in said
    said = noted("winch.xml", "lift.xml", *first.split(), "-o", "one.xml")
    said |= noted("one.xml", "lift.xml", *second.split(), "-o", "two.xml")
    assert not {"joined-enclaves", "shared-enclave", "node-in-two-enclaves"} & said.keys()
    for enclave, answer in (("/NAME", 1), ("/panel", 0)):
        assert sros("explain", "two.xml", enclave, "publish", "/motor").status == answer
    file("kept.xml", policy_text({"/driver": publish("lift", "old") + of_all}), "driver")
    assert f"with `{first}` (then" in noted("kept.xml", "lift.xml")["kept-rights"]
    file("moved.xml", policy_text({"/d": publish("lift") + of_all}), "driver")
    twice = noted("moved.xml", "lift.xml")["node-in-two-enclaves"]
    assert "one program, merge with `--node driver --enclave /d` (then" in twice
    assert "with `--node panel` in place of these options)" in twice
    own = "With --enclave or --remap, merge lift.xml in a run of its own."
    assert own in noted("a.xml", "winch.xml", "lift.xml")["shared-enclave"]
    # Without --node, or with one node of several enclaves, it is perhaps not what was meant.
    for words, is_said in (
        (("lift.xml",), True),
        (("lift.xml", "--node", "driver"), False),
        (("lift.xml", "--node", "driver", "--node", "panel"), False),
        (("kept.xml",), False),
        (("kept.xml", "moved.xml", "--node", "driver"), True),
    ):
        said = noted("a.xml", *words, "--enclave", "/pipeline")
        assert ("joined-enclaves" in said) is is_said, words
    assert "Ignore this note if these nodes run in one process" in said["joined-enclaves"]


def test_the_nodes_of_a_package_are_merged_into_the_enclave_that_composes_them(
    folder: Path,
) -> None:
    (folder / "package.xml").write_text(
        policy_text({"/scanner": publish("image"), "/decoder": publish("code")}).replace(
            'node="n"', 'node="scanner"', 1
        )
    )
    words = ("--namespace", "/left", "--enclave", "/left/pipeline", "--json")
    found = json.loads(sros("merge_policy", "a.xml", "package.xml", *words).out)
    assert {right["enclave"] for right in found["added"]} == {"/left/pipeline"}
    assert {right["name"] for right in found["added"]} == {"/left/image", "/left/code"}
    (one,) = json.loads(
        sros("merge_policy", "a.xml", "package.xml", *words, "--node", "scanner").out
    )["added"]
    assert one["name"] == "/left/image"
    ended = sros("merge_policy", "a.xml", "package.xml", "--node", "scaner")
    assert ended.status == 2 and "--node scaner: no policy to merge has a node" in ended.err
    assert "of this name. They have n, scanner. Write the name" in ended.err
    ended = sros("merge_policy", "a.xml", "package.xml", "--enclave", "x y")
    assert ended.status == 2 and "is not a valid enclave name" in ended.err


def test_the_names_of_a_merged_policy_are_remapped(folder: Path) -> None:
    (folder / "cam.xml").write_text(policy_text({"/cam": publish("/image")}))
    words = ("merge_policy", "cam.xml", "cam.xml", "--remap")
    ended = sros(*words, "image:=/front/image", "--json", cwd=folder).ok()
    assert [right["name"] for right in json.loads(ended.out)["added"]] == ["/front/image"]
    nodes = policy_text({"/cam": publish("/image"), "/b": publish("state")})
    (folder / "cam.xml").write_text(nodes.replace('node="n"', 'node="cam"', 1))
    for more, said in (
        (
            ("imag:=/front/image",),
            "matches no name or node in the policies to merge. Perhaps the right name is /image, "
            "for example after an update of a package. Write",
        ),
        (("tate:=/s",), "Perhaps the right name is state, for"),  # `state` became longer
        (("cm:image:=/i",), "Perhaps the right name is cam, for"),
        (("xyz:=/i",), "They have topic /image, topic state. Perhaps an update of a package"),
        (("xyz:image:=/i",), "merge. They have cam, n. Perhaps an update of a package changed"),
        (
            ("cam:__node:=eye", "--remap", "cam:image:=/i"),
            "The rule cam:__node:=eye applies first. Write the node and the name as they are after "
            "that rule, as in eye:image:=/i, or leave out",
        ),
        (("image:=/one", "--remap", "image:=/two"), "The rule image:=/one applies first."),
        (("/state:=/s", "--remap", "__ns:=/l"), "The rule __ns:=/l applies first."),
        (("state:=/s", "--node", "cam"), "It is for n, which --node leaves out. Add --node n, or"),
    ):
        ended = sros(*words, *more, cwd=folder)
        assert (ended.status, said in ended.err) == (2, True), ended
    (folder / "robot.xml").write_text(policy_text({"/cam": publish("gap", "width_at_home")}))
    changed = policy_text({"/cam": publish("width_at_home", "opening") + may("reply", "widths")})
    (folder / "cam.xml").write_text(changed)  # the topic `width`, remapped to `gap`, is `opening`
    ended = sros("merge_policy", "robot.xml", "cam.xml", "--remap", "withd:=gap", cwd=folder)
    assert "Perhaps the right name is widths, for" in ended.err
    ended = sros("merge_policy", "robot.xml", "cam.xml", "--remap", "xyz:=gap", cwd=folder)
    assert "They have topic opening, topic width_at_home. Perhaps" in ended.err
    basics = may("reply", "~/set_parameters", "~/get_parameters") + publish("/rosout")
    (folder / "cam.xml").write_text(changed.replace("</profile>", f"{basics}</profile>"))
    ended = sros(*words, "motor:=/base/motor", cwd=folder)
    assert "have topic width_at_home, topic opening, service widths. Perhaps" in ended.err
    panel = policy_text({"/panel": publish("eye/lid", "/front/eye/park", "eyes/lid")})
    (folder / "cam.xml").write_text(panel)
    ended = sros(*words, "eye:__node:=left_eye", cwd=folder)
    assert "no node eye, and only use names below it: /front/eye/park and eye/lid." in ended.err
    advice = ended.err.split("`")[1].split()
    ended = sros(*words[:-1], *advice, "--json", cwd=folder).ok()
    names = {right["name"] for right in json.loads(ended.out)["added"]}
    assert names == {"/left_eye/lid", "/front/left_eye/park"}


def test_a_merge_that_takes_a_counterpart_away_says_so(folder: Path) -> None:
    """By another name, or by a DENY; twin: the merge that leaves the name.

    "Any more" is only said of what POLICY had before.
    """
    (folder / "cam.xml").write_text(policy_text({"/cam": publish("/image")}))
    (folder / "own.xml").write_text(policy_text({"/b": subscribe("/image")}))
    (folder / "both.xml").write_text(sros("merge_policy", "own.xml", "cam.xml").ok().out)
    denial = publish("/image").replace("ALLOW", "DENY")
    (folder / "deny.xml").write_text(policy_text({"/cam": denial}))
    lost = "note [merge.no-counterpart]: /b may subscribe /image, but no enclave may publish it "
    for words, said in (
        (
            ("own.xml", "cam.xml", "--remap", "image:=/front/image"),
            "in the result of this merge. If a",
        ),
        (("both.xml", "deny.xml"), "any more."),
        (("own.xml", "cam.xml"), ""),
        (("both.xml", "cam.xml", "--remap", "image:=/front/image"), ""),
    ):
        shown = sros("merge_policy", *words).ok().err
        assert (lost + said in shown) is bool(said) is ("no-counterpart" in shown), words


def test_many_rights_of_a_merge_are_folded_by_enclave(folder: Path) -> None:
    names = [f"/n{number:02}" for number in range(12)]
    (folder / "b.xml").write_text(policy_text({"/b": publish(*names), "/c": publish(*names)}))
    said = sros("merge_policy", "a.xml", "b.xml").ok().err.splitlines()
    few = "ALLOW publish topic /n00, ALLOW publish topic /n01 and 10 more"
    assert said[:-1] == ["added 24 rights (-v lists all)", f"  /b {few}", f"  /c {few}"]
    assert "  /c ALLOW publish topic /n11" in sros("merge_policy", "-v", "a.xml", "b.xml").ok().err


def test_merge_to_stdout(folder: Path) -> None:
    before = snapshot(folder)
    ended = sros("merge_policy", "a.xml", "b.xml").ok()
    assert "<!-- mine -->" in ended.out
    said = ["added 2 rights", *(f"  {right}" for right in ADDED), STILL]
    assert ended.err.splitlines()[:-1] == said
    assert snapshot(folder) == before
    rights = policy_rights(read_policy(Path("result.xml"), ended.out.encode()))
    assert rights == policy_rights(read_policy(Path("a.xml"))) | {
        right for right in policy_rights(read_policy(Path("b.xml"))) if str(right) in ADDED
    }


INCLUDE = '<xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/>'
WITH_INCLUDE = with_includes(policy_text({"/b": INCLUDE + DENY + publish("z", "/x/y")}))


def test_merge_keeps_the_include_of_a_common_part(folder: Path) -> None:
    shutil.copytree(policies_dir() / "common", folder / "other" / "common")
    other, command = folder / "other" / "b.xml", ("merge_policy", "a.xml", "other/b.xml")
    other.write_text(WITH_INCLUDE)
    spelt_out = sros(*command).ok()
    assert "include" not in spelt_out.out, "the folder has no common part"
    shutil.copytree(policies_dir() / "common", folder / "common")
    included = sros(*command).ok()
    assert included.out.count(INCLUDE) == 1 and "get_parameters" not in included.out
    assert "<topic>/x/y</topic>" in included.out and "<!-- mine -->" in included.out
    assert included.out.count('publish="DENY"') == 2, "also the denial that is added"
    assert included.err == spelt_out.err
    result = Path("a.xml")
    read = [
        policy_rights(read_policy(result, ended.out.encode())) for ended in (spelt_out, included)
    ]
    assert read[0] == read[1]
    assert "include" not in sros(*command, "-o", "other/c.xml").ok().out
    assert "include" not in Path("other/c.xml").read_text(), "for another folder"
    other.write_text(WITH_INCLUDE.replace("cmd_vel", "/rosout"))
    assert "include" not in sros(*command).ok().out, "a denial of what the part allows"
    (folder / "common/node/time.xml").write_text(f"<profile>{publish('/other')}</profile>")
    other.write_text(WITH_INCLUDE)
    assert "common/node.xml" not in sros(*command).ok().out, "another content"


def test_merge_in_place_keeps_mode_and_link(folder: Path) -> None:
    file = folder / "a.xml"
    file.chmod(0o640)
    (folder / "link.xml").symlink_to("a.xml")
    assert "replaced 'link.xml'" in sros("merge_policy", "link.xml", "b.xml", "--in-place").ok().err
    assert file.stat().st_mode & 0o777 == 0o640
    assert (folder / "link.xml").is_symlink()
    before, inode = file.read_bytes(), file.stat().st_ino
    ended = sros("merge_policy", "a.xml", "b.xml", "--in-place").ok()
    assert ended.err.splitlines() == ["no right was added", STILL]
    assert (file.read_bytes(), file.stat().st_ino) == (before, inode)


def test_merge_into_another_file(folder: Path) -> None:
    sros("merge_policy", "a.xml", "b.xml", "-o", "c.xml").ok()
    assert sros("diff_policy", "a.xml", "c.xml").out.splitlines() == [f"+ {r}" for r in ADDED]
    ended = sros("merge_policy", "a.xml", "b.xml", "-o", "c.xml")
    assert (ended.status, "already exists" in ended.err) == (2, True)
    assert (
        "replaced 'c.xml'" in sros("merge_policy", "a.xml", "b.xml", "-o", "c.xml", "--force").err
    )


def test_merge_of_several(folder: Path) -> None:
    (folder / "c.xml").write_text(policy_text({"/a": publish("w"), "/b": publish("z")}))
    ended = sros("merge_policy", "a.xml", "b.xml", "c.xml", "--json").ok()
    value = json.loads(ended.out)
    assert [right["name"] for right in value["added"]] == ["/y", "/z", "/w"]
    assert value["contradictions"][0]["denied"] == {
        "enclave": "/a",
        "qualifier": "DENY",
        "kind": "topics",
        "right": "publish",
        "name": "/cmd_vel",
    }
    assert value["output"] is None
    assert policy_rights(read_policy(Path("r.xml"), value["document"].encode()))


def test_json_of_a_file_that_is_not_utf_8(folder: Path) -> None:
    text = A.replace('"1.0"', '"1.0" encoding="ISO-8859-1"').replace("mine", "für mich")
    (folder / "a.xml").write_bytes(text.encode("latin-1"))
    assert (
        "für mich"
        in json.loads(sros("merge_policy", "a.xml", "b.xml", "--json").ok().out)["document"]
    )


def test_a_dry_run_writes_nothing(folder: Path) -> None:
    before = snapshot(folder)
    ended = sros("merge_policy", "a.xml", "b.xml", "--in-place", "--dry-run").ok()
    assert ended.out.splitlines() == [*(f"would add {r}" for r in ADDED), "would replace a.xml"]
    assert snapshot(folder) == before


@pytest.mark.parametrize("content", ["", "<policy", "<policy version='0.2.0'/>", "<profile/>"])
@pytest.mark.parametrize("bad", ["a.xml", "b.xml"])
def test_a_failing_merge_leaves_everything(folder: Path, bad: str, content: str) -> None:
    (folder / bad).write_text(content)
    before = snapshot(folder)
    ended = sros("merge_policy", "a.xml", "b.xml", "--in-place")
    assert ended.status == 2
    assert ended.err.startswith("Unable to merge policies: ")
    assert snapshot(folder) == before


@pytest.fixture
def failing_step(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    name = request.param

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, name, fail)
    yield
    monkeypatch.undo()


@pytest.mark.parametrize("failing_step", ["open", "fsync", "fchmod", "replace"], indirect=True)
def test_a_write_that_fails_leaves_the_file(folder: Path, failing_step: None) -> None:
    # One of the steps of writing fails, as it does on a full disk or in a closed folder.
    before = snapshot(folder)
    with pytest.raises(OSError, match="No space"):
        replace_file(folder / "a.xml", b"new")
    assert snapshot(folder) == before


def test_a_folder_that_cannot_be_written(folder: Path) -> None:
    command = [sys.executable, "-m", "sros_tool", "merge_policy", "a.xml", "b.xml", "--in-place"]
    if os.geteuid() == 0:  # who may write everywhere, unless that is taken from him
        command = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", *command]
        if not shutil.which("setpriv"):
            pytest.skip("root may write everywhere, and there is no setpriv")
    before = snapshot(folder)
    folder.chmod(0o555)
    try:
        ended = subprocess.run(command, capture_output=True, text=True)
    finally:
        folder.chmod(0o755)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert "Permission denied." in line
    assert snapshot(folder) == before


def test_includes_are_not_led_elsewhere(folder: Path) -> None:
    shutil.copytree(policies_dir(), folder / "robot")
    ended = sros("merge_policy", "robot/talker_listener.xml", "b.xml", "-o", "c.xml")
    assert (ended.status, "the relative includes" in ended.err) == (2, True)
    assert not (folder / "c.xml").exists()
    sros("merge_policy", "robot/talker_listener.xml", "b.xml", "-o", "robot/c.xml").ok()


def test_two_targets_are_one_too_many(folder: Path) -> None:
    assert sros("merge_policy", "a.xml", "b.xml", "--in-place", "-o", "c.xml").status == 2


# ── diff_policy ────────────────────────────────────────────────────────────────────────────


def test_diff_tells_in_ros_terms(folder: Path) -> None:
    ended = sros("diff_policy", "a.xml", "b.xml")
    assert ended.status == 1
    assert ended.out.splitlines() == [
        "- /a ALLOW publish topic /cam/*",
        "+ /a ALLOW publish topic /cam/a  (A has it as part of publish topic /cam/*)",
        "+ /a ALLOW publish topic /cmd_vel",
        "- /a DENY publish topic /cmd_vel",
        "+ /a ALLOW publish topic /y",
        "+ /b ALLOW publish topic /z",
    ]
    assert ended.err == "6 rights differ\n"


def test_diff_of_the_same(folder: Path) -> None:
    hint = "`sros minimize_policy a.xml --observed moved.xml` compares the rights of each node"
    for enclave, node, hinted in (("/n", "n", True), ("/n", "m", False), ("/a", "n", False)):
        moved = policy_text({enclave: publish("x")}).replace('node="n"', f'node="{node}"')
        (folder / "moved.xml").write_text(moved)
        assert (hint in sros("diff_policy", "a.xml", "moved.xml").err) is hinted
    ended = sros("diff_policy", "a.xml", "a.xml")
    assert (ended.status, ended.out) == (0, "")
    assert json.loads(sros("diff_policy", "a.xml", "a.xml", "--json").out)["equal"] is True


def test_diff_shows_a_renamed_enclave_as_one_line(folder: Path) -> None:
    """It still differs; twins: the enclave has another right, or only a part is compared."""
    (folder / "b.xml").write_text(policy_text({"/b": publish("x", "y")}))
    sros("create_keystore", "ks", cwd=folder).ok()
    sros("generate_artifacts", "-k", "ks", "-p", "b.xml", cwd=folder).ok()
    renamed = "~ enclave /b is now /c, with the same rights"
    for other, names, folded in (("b.xml", "xy", True), ("b.xml", "xyz", False), ("ks", "xy", True),
                                 ("ks/enclaves/b", "xy", False)):  # fmt: skip
        (folder / "c.xml").write_text(policy_text({"/c": publish(*names)}))
        ended = sros("diff_policy", other, "c.xml")
        assert (ended.status, renamed in ended.out) == (1, folded), ended
        assert ("- /b ALLOW publish topic /x" in ended.out) != folded, ended
        assert "rights" in ended.err and "differ\n" in ended.err


def test_an_enclave_without_rights_is_a_difference(folder: Path) -> None:
    rights = {"/a": publish("x")}
    (folder / "less.xml").write_text(policy_text(rights))
    (folder / "more.xml").write_text(policy_text({**rights, "/idle": ""}))
    added = sros("diff_policy", "less.xml", "more.xml")
    assert (added.status, added.out) == (1, "+ /idle, an enclave without rights\n")
    assert added.err == "1 enclave without rights, on one side only\n"
    value = json.loads(sros("diff_policy", "more.xml", "less.xml", "--json").out)
    assert not value["equal"] and value["enclaves"] == [{"only": "a", "enclave": "/idle"}]


def test_diff_with_a_keystore_and_its_parts(keystore: Path) -> None:
    same = keystore.parent / "same.xml"
    same.write_text(policy_text({"/a": publish("old_a"), "/b": publish("old_b")}))
    enclave = keystore / "enclaves" / "a"
    for other in (keystore, enclave, enclave / "permissions.p7s", enclave / "permissions.xml"):
        assert sros("diff_policy", same, other).status == 0
        assert sros("diff_policy", other, same).status == 0
    same.write_text(policy_text({"/a": publish("new_a"), "/b": publish("new_b")}))
    assert len(sros("diff_policy", same, keystore).out.splitlines()) == 4
    for other in (enclave, enclave / "permissions.p7s"):
        ended = sros("diff_policy", same, other)
        assert ended.out.splitlines() == [
            "+ /a ALLOW publish topic /old_a" if line == 1 else "- /a ALLOW publish topic /new_a"
            for line in (0, 1)
        ]
        assert "of /a" in ended.err


def test_signing_keeps_the_enclaves_that_the_policy_lacks(tmp_path: Path) -> None:
    for name, enclaves in (("ab", ("/a", "/b")), ("a", ("/a",))):
        (tmp_path / name).write_text(policy_text(dict.fromkeys(enclaves, publish("/x"))))
    sros("generate_artifacts", "-k", "ks", "-p", "ab", cwd=tmp_path).ok()
    kept = "B lacks /b: signing B does not change it; `sros revoke` takes away all rights of an "
    for sides, is_said in (("ks a", True), ("a ks", False), ("ab a", False), ("ks ab", False)):
        assert (kept in sros("diff_policy", *sides.split(), cwd=tmp_path).err) is is_said, sides


def test_diff_of_two_enclaves_compares_both(keystore: Path) -> None:
    a, b = (keystore / "enclaves" / name / "permissions.p7s" for name in "ab")
    assert len(sros("diff_policy", a, b).out.splitlines()) == 2


def test_equal_but_refused_by_dds_is_not_equal(keystore: Path) -> None:
    file = keystore / "enclaves" / "a" / "permissions.p7s"
    file.write_bytes(file.read_bytes().replace(b"old_a", b"new_a"))
    ended = sros("diff_policy", file, file)
    assert (ended.status, "DOES NOT VERIFY" in ended.err) == (1, True)


def test_diff_json(keystore: Path) -> None:
    policy = keystore.parent / "p.xml"
    policy.write_text(policy_text({"/a": publish("*")}))
    ended = sros("diff_policy", policy, keystore / "enclaves" / "a" / "permissions.xml", "--json")
    value = json.loads(ended.out)
    assert (ended.status, value["equal"], value["a"]["kind"]) == (1, False, "policy")
    assert value["b"]["enclaves"] == ["/a"]
    assert [note["id"] for note in value["b"]["notes"]] == ["rights.unsigned"]
    assert value["differences"][1] == {
        "only": "b",
        "enclave": "/a",
        "qualifier": "ALLOW",
        "kind": "topics",
        "right": "publish",
        "name": "/old_a",
        "covered_by": [
            {
                "enclave": "/a",
                "qualifier": "ALLOW",
                "kind": "topics",
                "right": "publish",
                "name": "/*",
            }
        ],
    }


@pytest.mark.parametrize("arguments", [(), ("a.xml",), ("a.xml", "b.xml", "b.xml")])
def test_wrong_usage(folder: Path, arguments: tuple[str, ...]) -> None:
    assert sros("diff_policy", *arguments).status == 2


def test_diff_with_what_is_no_policy(folder: Path) -> None:
    (folder / "c.xml").write_text("<nothing/>")
    ended = sros("diff_policy", "a.xml", "c.xml")
    assert (ended.status, ended.err.startswith("Unable to compare: ")) == (2, True)


# ── minimize_policy ────────────────────────────────────────────────────────────────────────


def test_minimize_tells_and_writes(folder: Path) -> None:
    ended = sros("minimize_policy", "a.xml", "--observed", "b.xml", "-o", "n.xml").ok()
    assert ended.out.splitlines()[:5] == [
        "/a: allowed 2, observed 2: 1.0x",
        "  wider than used",
        "    publish topic /cam/*  becomes  publish topic /cam/a",
        "  observed, and not allowed",
        "    publish topic /cmd_vel",
    ]
    assert "minimize.enclave-not-in-policy" in ended.err
    assert sros("diff_policy", "a.xml", "n.xml").out.splitlines() == [
        "- /a ALLOW publish topic /cam/*",
        "+ /a ALLOW publish topic /cam/a  (A has it as part of publish topic /cam/*)",
    ]


def test_a_node_that_was_observed_in_an_enclave_of_its_own(folder: Path) -> None:
    """`generate_policy --enclave-per-node` names it after the node; a policy has its own names."""
    profile = '<profile ns="/arm" node="driver"><topics publish="ALLOW"><topic>{}</topic></topics>'
    whole = '<policy version="0.2.0"><enclaves>{}</enclaves></policy>'
    enclave = f'<enclave path="{{}}"><profiles>{profile}</profile></profiles></enclave>'
    (folder / "own.xml").write_text(whole.format(enclave.format("/robot/arm", "/*")))
    (folder / "seen.xml").write_text(whole.format(enclave.format("/arm/driver", "/pose")))
    ended = sros("minimize_policy", "own.xml", "--observed", "seen.xml").ok()
    assert "publish topic /*  covered publish topic /pose" in ended.out
    assert (
        "The rights observed in enclave /arm/driver count for /robot/arm, because the policy has "
        "the node /arm/driver there." in ended.err
    )
    sros("view", "own.xml", "--observed", "seen.xml", "-o", "use.html").ok()
    assert "/arm/driver" not in {
        found["path"]
        for found in json.loads(
            sros("view", "own.xml", "--observed", "seen.xml", "--json").ok().out
        )["enclaves"]
    }
    two = enclave.format("/robot/arm", "/*") + enclave.format("/robot/other", "/*")
    (folder / "own.xml").write_text(whole.format(two))
    ended = sros("minimize_policy", "own.xml", "--observed", "seen.xml").ok()
    assert "minimize.enclave-not-in-policy" in ended.err


def test_nodes_that_were_observed_in_a_namespace_without_that_of_the_policy(folder: Path) -> None:
    """Twins: the policy's own nodes were observed, too, or a node has another name."""

    def text(**nodes: str) -> str:
        rules = {f"{ns}/{node}": publish("x") for node, ns in nodes.items()}
        text = policy_text(rules)
        for node, ns in nodes.items():
            text = text.replace('ns="/" node="n"', f'ns="{ns or "/"}" node="{node}"', 1)
        return text

    (folder / "package.xml").write_text(text(driver="", pilot=""))
    (folder / "empty.xml").write_text('<policy version="0.2.0"><enclaves/></policy>')
    (folder / "seen.xml").write_text(text(driver="/arm", pilot="/arm", lamp=""))
    words = ("minimize_policy", "package.xml", "--observed", "seen.xml")
    moved, other = [
        line for line in sros(*words).ok().err.splitlines() if "enclave-not-in-policy" in line
    ]
    assert "lacks them: /arm/driver, /arm/pilot. It has nodes of these names in the" in moved
    assert "in the namespace /. If" in moved and "lacks them: /lamp. If the policy" in other
    (merge,) = re.findall(r"`sros (.*?)`", moved)
    merge = merge.replace("EMPTY", "empty.xml").replace("POLICY", "package.xml")
    sros(*merge.split(), "-o", "arm.xml").ok()
    (folder / "seen.xml").write_text(text(driver="/arm", pilot="/arm"))
    same = ("minimize_policy", "arm.xml", "--observed", "seen.xml", "--fail-on", "difference")
    sros(*same).ok()
    (folder / "own.xml").write_text(text(driver="", pilot=""))
    assert "--namespace" not in sros(*words, "--observed", "own.xml").ok().err
    (folder / "seen.xml").write_text(text(drive="/arm", overpilot="/arm"))
    assert "--namespace" not in sros(*words).ok().err


def test_nodes_of_one_process_count_for_their_own_enclaves_in_the_policy(folder: Path) -> None:
    """The observed enclave may have the name of one of them, which the policy has for it alone."""
    own = {"one": publish("x"), "two": publish("y")}
    of_node = {f"/{node}": f'node="{node}">{rules}' for node, rules in own.items()}
    together = '</profile><profile ns="/" '.join(of_node.values())

    def file(name: str, enclaves: dict[str, str]) -> None:
        text = policy_text({path: f"@{rules}" for path, rules in enclaves.items()})
        (folder / name).write_text(text.replace('node="n">@', ""))

    words = ("minimize_policy", "robot.xml", "--observed", "seen.xml", "--fail-on", "difference")
    divided = "note [minimize.divided-process]: the nodes /one and /two were observed in one"
    moved = "count for /pipe, because the policy has the nodes /one and /two there."
    for stated, seen, status, said in (
        (of_node, {"/one": together}, 1, divided),
        ({"/one": of_node["/one"], "/b": of_node["/two"]}, {"/two": together}, 1, divided),
        ({"/pipe": together}, {"/one": together}, 0, moved),
        (of_node, of_node, 0, ""),
    ):
        file("robot.xml", stated)
        file("seen.xml", seen)
        ended = sros(*words)
        assert (ended.status, said in ended.err) == (status, True), seen
        assert ("so this is a difference" in ended.err) == bool(status)
        as_data = json.loads(sros(*words, "--json").out)
        assert as_data["is_as_observed"] is not bool(status)
        assert "not allowed" not in ended.out and "never observed;" not in ended.out
        assert ended.err.count("[") == bool(said), ended.err
        assert ("different: nodes of one process" in ended.err) == bool(status)
        view = sros("view", "robot.xml", "--observed", "seen.xml", "--json").ok()
        assert {edge["mark"] for edge in json.loads(view.out)["edges"]} == {"both"}, seen


def test_a_job_fails_where_the_policy_and_what_was_observed_differ(folder: Path) -> None:
    """As the page on continuous integration says, for which one of its steps is enough."""
    page = (Path(__file__).parents[2] / "docs/howto/ci.md").read_text()
    step = re.search(r"^ +sros (minimize_policy /tmp/user.xml .*)$", page, re.MULTILINE)
    assert step
    words = step[1].replace("/tmp/", "").split()
    (folder / "user.xml").write_text(policy_text({"/left/n": publish("/x", "/y/*")}))
    same = publish("/x", "/y/*")
    rights = "the rights of /left/n"
    unseen = "enclaves that were never observed (note minimize.enclave-never-observed)"
    lacking = "enclaves that the policy lacks (note minimize.enclave-not-in-policy)"
    for seen, differences, said in (
        ({"/left/n": same}, "", "/left/n: allowed"),
        ({"/left/n": publish("/y/*")}, rights, "never observed, and removed"),
        ({"/left/n": publish("/x", "/y/a")}, rights, "wider than used"),
        ({"/left/n": publish("/x", "/y/*", "/cmd_vel")}, rights, "observed, and not allowed"),
        ({"/right/n": same}, f"{unseen}; {lacking}", "never observed; not changed"),
        ({"/left/n": same, "/client": same}, lacking, "the policy lacks them: /client."),
        ({"/left/n": publish("/x"), "/client": same}, f"{rights}; {lacking}", "and removed"),
    ):
        (folder / "learned.xml").write_text(policy_text(seen))
        ended = sros(*words)
        status = int(bool(differences))
        assert (ended.status, said in ended.out + ended.err) == (status, True), seen
        last = ended.err.splitlines()[-1:]
        assert not differences or last == [f"different: {differences}"]
        assert "different: " not in sros(*words[:-2]).ok().err


@pytest.mark.parametrize("ns", ["", "/sub"])
def test_what_was_learned_in_a_namespace_is_compared_in_it(folder: Path, ns: str) -> None:
    """As the page on the policy of a package says, also for a node in a namespace of its own."""
    page = (Path(__file__).parents[2] / "docs/howto/package.md").read_text()
    merge, compare = re.findall(
        r"^\$ sros ((?:merge|diff)_policy .*\barm.xml.*)$",
        page.replace("/tmp/learned/", "learned/"),
        re.MULTILINE,
    )

    def write(name: str, *topics: str, below: str = "") -> None:
        text = policy_text({f"{below}{ns}/n": publish(*topics)})
        (folder / name).write_text(text.replace('ns="/"', f'ns="{below}{ns}"', 1))

    (folder / "policies").mkdir()
    (folder / "learned").mkdir()
    (folder / "learned/empty.xml").write_text('<policy version="0.2.0"><enclaves/></policy>')
    write("policies/gripper.xml", "width", "/tf")
    sros(*merge.split()).ok()
    for topics, out in (
        (("width", "/tf"), ""),
        (("width", "/width", "/tf"), f"+ /arm{ns}/n ALLOW publish topic /width\n"),
    ):
        write("learned/gripper.xml", *topics, below="/arm")
        ended = sros(*compare.split())
        assert (ended.status, ended.out) == (bool(out), out), ended


@pytest.mark.parametrize(
    ("seen", "status", "said"),
    [
        ({"one": "x", "two": "y x"}, 0, ""),
        ({"one": "x y"}, 1, "the node /two of enclave /n was never observed."),
        (
            {"one": "x", "two": "y"},
            1,
            "two has rights that the node never used, or used only in part:",
        ),
        ({"one": "x y", "two": "x y"}, 1, "/one lacks rights that the node used: publish topic /y"),
        ({"one": "x", "two": "x y", "six": "x"}, 1, "/six lacks rights that the node used:"),
        ({"one": "x", "two": "x y", "t_*": "x"}, 1, "/t_* lacks rights that the node used:"),
        ({"one": "x y", "two": "x y", "six_a": "x y z"}, 1, "/one lacks rights that the node"),
        ({"one": "x", "two": "x z", "six_a": "x y"}, 1, "/six_* has rights that the node never"),
        ({"one": "x", "two": "x y z"}, 1, "the node /six_* of enclave /n was never observed."),
        ({"one": "x", "two": "x y", "six_a": "z x", "six_b": "y"}, 1, "/six_a lacks rights"),
        ({"one": "x", "two": "x y", "six_a": "z", "six_b": "y"}, 0, ""),
    ],
)
def test_no_node_hides_the_difference_of_another(
    folder: Path, seen: dict[str, str], status: int, said: str
) -> None:
    def profiles(names: dict[str, str]) -> str:
        return '</profile><profile ns="/" node='.join(
            f'"{node}">' + publish(*topics.split()) for node, topics in names.items()
        )

    stated = {"one": "x", "two": "x y"}
    if "z" in f"{seen}":
        stated |= {"six_*": "y z"}
    for file, names in (("user.xml", stated), ("seen.xml", seen)):
        text = policy_text({"/n": profiles(names)})
        (folder / file).write_text(text.replace('node="n">', "node=", 1))
    words = ("minimize_policy", "user.xml", "--observed", "seen.xml", "--fail-on")
    ended = sros(*words, "difference")
    assert (ended.status, said in ended.err) == (status, True)
    sros(*words, "never").ok()


def test_minimize_with_permissions_and_several_observations(keystore: Path) -> None:
    policy = keystore.parent / "p.xml"
    policy.write_text(policy_text({"/a": publish("*"), "/b": publish("old_b", "more"), "/c": DENY}))
    observed = [keystore / "enclaves" / name / "permissions.p7s" for name in "ab"]
    ended = sros("minimize_policy", policy, "--observed", *observed, "--json").ok()
    value = json.loads(ended.out)
    by_name = {each["enclave"]: each for each in value["enclaves"]}
    # Known are old_a, old_b, more and cmd_vel, and of every node rosout, parameter_events, clock.
    assert by_name["/a"]["ratio"] == 7.0
    assert [right["name"] for right in by_name["/b"]["never_observed"]] == ["/more"]
    assert by_name["/c"]["observed_at_all"] is False
    assert by_name["/a"]["bytes"]["limit"] == 61440


def test_what_every_node_needs_stays_unless_strict(folder: Path) -> None:
    shutil.copytree(policies_dir(), folder / "robot")
    (folder / "seen.xml").write_text(policy_text({"/talker_listener/talker": publish("chatter")}))
    policy = "robot/talker_listener.xml"
    for more, kept in (((), True), (("--strict",), False)):
        sros("minimize_policy", policy, "--observed", "seen.xml", "-o", "n.xml", "--force", *more)
        narrowed = read_policy(folder / "n.xml").enclave("/talker_listener/talker")
        assert narrowed is not None
        names = {n for p in narrowed.all_profiles() for g in p.groups for n in g.names}
        assert ("/rosout" in names) is kept
        assert "chatter" in names


def test_a_document_that_is_too_large_gets_proposals(folder: Path) -> None:
    (folder / "big.xml").write_text(topics_policy(2000))
    ended = sros("minimize_policy", "big.xml", "--observed", "big.xml").ok()
    assert "TOO LARGE" in ended.out
    assert "publish topic /fleet/topic_*  in place of 2000 names" in ended.out
    assert "allows no other known name" in ended.out


def test_minimize_dry_run(folder: Path) -> None:
    before = snapshot(folder)
    ended = sros("minimize_policy", "a.xml", "--observed", "b.xml", "-o", "n.xml", "--dry-run")
    assert ended.ok().out.splitlines()[-1] == "would write n.xml"
    assert snapshot(folder) == before


def test_minimize_without_observation_is_wrong_usage(folder: Path) -> None:
    assert sros("minimize_policy", "a.xml").status == 2


# ── effort ─────────────────────────────────────────────────────────────────────────────────


def calls_of(work: Callable[[], object]) -> int:
    """How many functions are called by some work: its effort, however busy the machine is."""
    called = 0

    def count(_frame: FrameType, event: str, _argument: object) -> None:
        nonlocal called
        called += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(None)
    return called


@sometimes("the effort for large policies")
def test_four_times_as_large_policies_take_four_times_the_effort(folder: Path) -> None:
    """Sixteen times would be quadratic; what is there anyway makes it less than four."""
    policies: dict[str, Callable[[int], tuple[str, str]]] = {
        "enclaves": lambda n: (enclaves_policy(50 * n, 20), enclaves_policy(50 * n, 24)),
        "topics": lambda n: (topics_policy(1000 * n), topics_policy(1020 * n)),
    }
    for made in policies.values():
        for verb in ("diff_policy", "merge_policy"):
            effort = {}
            for times in (1, 4):
                for name, text in zip(("before", "after"), made(times), strict=True):
                    (folder / f"{name}.xml").write_text(text)
                effort[times] = calls_of(lambda: sros(verb, "before.xml", "after.xml"))  # noqa: B023
            assert effort[4] < 6 * effort[1], (verb, effort)
