"""A picture with a focus: who may use a name, who influences these, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from sros_tool.keystore.rights import load_rights
from sros_tool.policy.model import ALLOW, DENY
from sros_tool.policy.rights import Right
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, Network
from sros_tool.report.compose import PictureSource, compose
from sros_tool.report.focus import FocusFlow, flow_scene, focused_picture
from sros_tool.report.formats import _link_text, render_dot, render_mermaid
from sros_tool.report.picture import Picture, SourceTitle
from tests.report.pictures import HOSTILE, MOBILE_ROBOT, group, hostile_permissions, source_of
from tests.support.harness import policy_text, sros

MUX = "/mobile_robot/velocity_mux"


def seen(folder: Path, enclaves: dict[str, str], *words: str) -> Picture:
    source = source_of(folder, enclaves)
    return focused_picture(compose(source), [source], words)


def value(*words: object) -> dict[str, Any]:
    picture = json.loads(sros("view", *words, "--json").ok().out)
    assert isinstance(picture, dict)
    return picture


CHAIN = {
    "/web": group("topics", "publish", "/goal", "/web/log"),
    "/planner": group("topics", "subscribe", "/goal") + group("topics", "publish", "/plan"),
    "/mux": group("topics", "subscribe", "/plan") + group("topics", "publish", "/cmd_vel"),
    "/base": group("topics", "subscribe", "/cmd_vel") + group("topics", "publish", "/odom"),
    "/recorder": group("topics", "subscribe", "/*"),
    "/camera": group("topics", "publish", "/image"),
}


def test_the_answer_is_a_sentence_and_only_what_leads_to_the_name_is_drawn(tmp_path: Path) -> None:
    picture = seen(tmp_path, CHAIN, "/cmd_vel")
    assert picture.headlines == (
        "only /mux may publish /cmd_vel; /base and /recorder may subscribe to it; "
        "2 other enclaves influence the publisher, 1 of them directly",
    )
    assert {name.name for name in picture.names} == {"/cmd_vel", "/plan", "/goal"}
    assert "/camera" not in {enclave.path for enclave in picture.enclaves}
    scene = flow_scene(picture)
    check_flow(scene_columns := {c.id: c.column for c in scene.cards}, picture)
    assert scene_columns["s/planner"] < scene_columns["s/mux"] < scene_columns["l/base"]
    (link,) = (link for link in scene.links if link.source == "s:")
    assert _link_text(picture, link) == "influence over names that are not drawn"
    further = next(card for card in scene.cards if card.id == "s:")
    assert (further.members, further.notes) == (("/web",), ("over up to 3 hops",))
    assert "s/web" in {card.id for card in flow_scene(picture, 3).cards}


def check_flow(columns: dict[str, int], picture: Picture) -> None:
    scene = flow_scene(picture)
    for card in scene.cards:
        assert card.x + card.width <= scene.width and card.y + card.height <= scene.height
    for link in scene.links:
        assert columns[link.source] + 1 == columns[link.target]
        assert link.y1 > 0 and link.y2 > 0
    assert [card.members for card in scene.cards if card.chosen] == [("/cmd_vel",)]


def test_an_enclave_is_a_focus_with_both_directions(tmp_path: Path) -> None:
    picture = seen(tmp_path, CHAIN, "/planner")
    assert picture.headlines == (
        "/planner can influence 3 enclaves (2 directly), and 1 enclave can influence it",
    )
    # Headings count hops from the enclave, as its answer does: /web influences it directly.
    heads = sorted(flow_scene(picture).heads, key=lambda head: head.x)
    assert [head.text for head in heads] == [
        *("1 hop before", "in focus", "1 hop after", "2 hops after"),
    ]
    (answer,) = picture.focus
    assert {influence.enclave for influence in answer.influenced} == {"/mux", "/base", "/recorder"}
    assert [influence.path for influence in answer.influencing] == [
        "/web -publish /goal-> /planner"
    ]
    assert "/image" not in {name.name for name in picture.names}


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("/odom", "only /base may publish /odom; only /recorder may subscribe to it; 3 other"),
        ("/image", "only /camera may publish /image; only /recorder may subscribe to it; no"),
        (
            "/unknown",
            "no right states /unknown itself, but wildcards match it: no enclave may publish "
            "/unknown; only /recorder may subscribe to it",
        ),
        ("/web/*", "only /web may publish /web/*; only /recorder may subscribe to it; no other"),
    ],
)
def test_names_with_and_without_wildcards(tmp_path: Path, word: str, sentence: str) -> None:
    picture = seen(tmp_path, CHAIN, word)
    assert picture.headlines[0].startswith(sentence)
    flow_scene(picture)


def test_denials_of_the_name_are_drawn(tmp_path: Path) -> None:
    denied = CHAIN | {
        "/recorder": CHAIN["/recorder"] + group("topics", "subscribe", "/cmd*", qualifier="DENY")
    }
    picture = seen(tmp_path, denied, "/cmd_vel")
    assert "only /base may subscribe" in picture.headlines[0]
    assert [
        (str(link.qualifier), link.target)
        for link in flow_scene(picture).links
        if link.qualifier is DENY
    ] == [("DENY", "l/recorder")]


def test_services_and_actions_say_who_calls_and_who_answers(tmp_path: Path) -> None:
    enclaves = {
        "/client": group("services", "request", "/reset", "/server/get_parameters"),
        "/server": group("services", "reply", "/reset", "/server/get_parameters")
        + group("actions", "call", "/dock"),
        "/dock": group("actions", "execute", "/dock"),
        "/half": group("services", "request", "/dock/_action/send_goal"),
    }
    picture = seen(tmp_path, enclaves, "/reset", "/dock")
    assert [(focus.kind, focus.senders, focus.receivers) for focus in picture.focus] == [
        ("services", ("/client",), ("/server",)),
        ("enclave", (), ()),
        ("actions", ("/half", "/server"), ("/dock",)),
    ]
    # A question to a node is no influence on it, its answer is one.
    asked = {"/client": enclaves["/client"], "/server": enclaves["/server"]}
    asked["/client"] = group("services", "request", "/server/get_parameters")
    (answer,) = seen(tmp_path, asked, "/server").focus
    assert answer.influencing == ()
    assert [influence.enclave for influence in answer.influenced] == ["/client"]


def test_what_the_governance_leaves_open_is_open_to_all(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text(CHAIN))
    template = tmp_path / "open.toml"
    shipped = (MOBILE_ROBOT.parent.parent / "keystore_templates/production.toml").read_text()
    rule = '\n[[protection.topic]]\nnames = ["/cmd_vel"]\nwrite_access_control = false\n'
    template.write_text(shipped + rule)
    answers = value(policy, "--template", template, "--focus", "/cmd_vel")["focus"]
    assert answers[0]["sentence"].startswith(
        "every enclave may publish /cmd_vel, which the governance leaves open; "
    )
    assert len(answers[0]["senders"]) == len(CHAIN)


def test_a_wildcard_pair_without_a_known_name_is_drawn_with_an_example(tmp_path: Path) -> None:
    enclaves = {
        "/a": group("topics", "publish", "/x/*", "/x/one"),
        "/b": group("topics", "subscribe", "/*/two", "/other/two")
        + group("topics", "publish", "/z/z"),
    }
    (answer,) = (picture := seen(tmp_path, enclaves, "/z/z")).focus
    assert [influence.enclave for influence in answer.influencing] == ["/a"]
    assert ("/a", "publish") in {(edge.enclave, edge.right) for edge in picture.edges}


ENCLAVES = st.sampled_from(["/a", "/b", "/c", "/d"])
NAMES = st.sampled_from(["/x", "/y", "/x/z", "/x/*", "/*", "/?", "/n/get_state"])
RIGHTS = st.frozensets(
    st.builds(
        Right,
        ENCLAVES,
        st.sampled_from([ALLOW, ALLOW, ALLOW, DENY]),
        st.sampled_from(["publish", "subscribe", "request", "reply", "call", "execute"]),
        NAMES,
    ),
    min_size=3,
    max_size=14,
)


@given(RIGHTS, st.sampled_from(["/x", "/y", "/a"]))
def test_every_enclave_of_an_answer_is_drawn_and_linked(
    rights: frozenset[Right], word: str
) -> None:
    """Each enclave at a hop has a link to the next one, and the numbers are those of the reach."""
    source = PictureSource(SourceTitle("x", "policy"), rights)
    picture = compose(source)
    known = {each.path for each in picture.enclaves} | {each.name for each in picture.names}
    if word not in known:
        return
    picture = focused_picture(picture, [source], [word])
    flow = FocusFlow.of(picture)
    network = Network(rights, excluded=OF_EVERY_NODE, questions=QUESTIONS)
    for focus in picture.focus:
        starts = {focus.name} if focus.kind == "enclave" else set(focus.senders)
        far = {path: len(hops) + 1 for path, hops in network.influencers_of(starts).items()}
        assert {influence.enclave: influence.hops for influence in focus.influencing} == far
    scene = flow_scene(picture, 9)
    drawn = {(card.id[0] == "s", path) for card in scene.cards for path in card.members}
    assert drawn >= {(True, path) for path in flow.before} | {(False, path) for path in flow.after}
    linked = {end for link in scene.links for end in (link.source, link.target)}
    for path, hops in flow.before.items():
        if hops > 1:
            assert f"s{path}" in linked
    for link in scene.links:
        columns = {card.id: card.column for card in scene.cards}
        assert columns[link.source] + 1 == columns[link.target]


def test_what_is_not_there_is_refused_with_a_likely_name() -> None:
    ended = sros("view", MOBILE_ROBOT, "--focus", "cmd_vel")
    assert ended.status == 2
    assert "no name and no enclave in 'mobile_robot.xml' is called 'cmd_vel'" in ended.err
    assert "Perhaps you mean /cmd_vel" in ended.err
    assert sros("view", MOBILE_ROBOT, "--hops", "3").status == 2
    assert "\x1b" not in sros("view", MOBILE_ROBOT, "--focus", "/x\x1b[2J\n").err


def test_every_format_has_the_answer(tmp_path: Path) -> None:
    picture = seen(tmp_path, CHAIN, "/cmd_vel")
    scene = flow_scene(picture, with_places=False)
    assert "only /mux may publish /cmd_vel" in render_dot(picture, scene)
    assert "only /mux may publish /cmd_vel" in render_mermaid(picture, scene)
    ended = sros("view", MOBILE_ROBOT, "--focus", "/cmd_vel", "--format", "svg").ok()
    assert f"only {MUX} may publish /cmd_vel" in ended.err
    words = " ".join(etree.fromstring(ended.out.encode()).itertext())
    assert f"only {MUX} may publish /cmd_vel" in words and "2 HOPS BEFORE" in words


def test_an_export_may_lack_enclaves(keystore: Path, tmp_path: Path) -> None:
    """An enclave is not said to be the only one, where others may be elsewhere."""
    robot, page = tmp_path / "robot", tmp_path / "page.html"
    sros("distribute_key", keystore, "/a", robot).ok()
    (right, *_) = [right for right in load_rights(robot).rights if right.right == "publish"]
    for source, alone in ((keystore, True), (robot, False), (robot / "enclaves/a", False)):
        asked = ("view", source, "--focus", right.name)
        ended = sros(*asked, "--format", "markdown").ok()
        for text in (ended.err, ended.out):
            assert (f"only /a may publish {right.name}" in text.replace("\\", "")) is alone
            assert (f"for the enclaves in {source.name} alone: /a may" in text) is not alone
            assert ("is an export, which may lack enclaves" in text) is (source == robot)
    sros("view", robot, "-o", page).ok()
    assert "is an export, which may lack enclaves" in page.read_text()
    assert json.loads(sros("view", robot, "--json").ok().out)["exports"] == ["robot"]


def test_hostile_names_can_be_a_focus(tmp_path: Path) -> None:
    path = tmp_path / "hostile.xml"
    path.write_text(hostile_permissions())
    for form in ("svg", "mermaid", "html"):
        shown = sros("view", path, "--focus", f"/{HOSTILE[0]}", "--format", form).ok()
        assert "<script>window.broken" not in shown.out
    etree.fromstring(sros("view", path, "--focus", HOSTILE[2], "--format", "svg").ok().out.encode())


def test_a_column_with_many_enclaves_has_groups(tmp_path: Path) -> None:
    enclaves = {
        f"/r{n}/part{m}": group("topics", "publish", "/status") for n in range(5) for m in range(8)
    }
    enclaves["/office"] = group("topics", "subscribe", "/status") + group("topics", "publish", "/x")
    scene = flow_scene(seen(tmp_path, enclaves, "/x"))
    groups = [card for card in scene.cards if card.role == "group"]
    assert [len(card.members) for card in groups] == [8] * 5
    assert sum(link.target.startswith("n") for link in scene.links) == 5 + 1


def test_what_breaks_a_requirement_is_red_and_said(tmp_path: Path) -> None:
    denied = group("topics", "publish", "/cmd_arm").replace("ALLOW", "DENY")
    enclaves = CHAIN | {"/web": group("topics", "publish", "/goal", "/cmd*") + denied}
    policy, wanted = tmp_path / "robot.xml", tmp_path / "robot.toml"
    policy.write_text(policy_text(enclaves))
    only = '[[only]]\npublish = ["/cmd_vel"]\nenclaves = ["/mux"]\n'
    only += '[[must]]\nenclave = "/mux"\npublish = ["/cmd_vel"]\n'
    # What an enclave must and may not is said, and never drawn as a right that it has.
    wanted.write_text(only + '[[must]]\nenclave = "/web"\npublish = ["/cmd_arm"]\n')
    shown_picture = value(policy, "--requirements", wanted)
    said = [violation["short"] for violation in shown_picture["requirements"]["violations"]]
    assert said[1:] == ["/web may not publish /cmd_arm"]
    of_web = [edge for edge in shown_picture["edges"] if edge["enclave"] == "/web"]
    drawn = [e["qualifier"] for e in of_web if (e["name"], e["right"]) == ("/cmd_arm", "publish")]
    assert drawn == ["DENY"]
    wanted.write_text(only)
    shown_picture = value(policy, "--requirements", wanted)
    assert shown_picture["requirements"]["hold"] == 1
    (violation,) = shown_picture["requirements"]["violations"]
    line = 1 + policy.read_text().split("/cmd*")[0].count("\n")
    text = f"{policy.name}:{line}: /web: may publish /cmd_vel by /cmd*, but "
    assert violation["text"].startswith(text)
    assert violation["short"] == "/web may publish /cmd_vel by /cmd*"
    (finding,) = (
        finding for finding in shown_picture["findings"] if finding["id"].startswith("requirement.")
    )
    assert (finding["enclave"], finding["severity"]) == ("/web", "error")
    assert finding["text"].startswith(f"{policy.name}:{line}: may publish /cmd_vel")
    assert [(e["enclave"], e["name"]) for e in shown_picture["edges"] if e["violates"]] == [
        ("/web", "/cmd_vel")
    ]
    shown = sros("view", policy, "--requirements", wanted, "--format", "svg").ok()
    assert f"Violated: {text}" in shown.err
    assert shown.out.count('class="link unknown wild violates"') == 1
    assert "breaks a requirement" in shown.out
    policy.write_text(policy_text(CHAIN))
    held = sros("view", policy, "--requirements", wanted, "--format", "svg").ok()
    assert "2 requirements hold" in held.err and "2 requirements hold." in held.out
    assert 'class="link unknown violates"' not in held.out
    refused = sros("view", policy, policy, "--requirements", wanted)
    assert (refused.status, refused.out) == (2, "")
