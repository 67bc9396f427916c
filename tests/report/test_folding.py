"""Equal robots, namespaces and enclaves are drawn as one, and what differs stands alone."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.fleet.robots import Robot
from sros_tool.names import NODE_SERVICES
from sros_tool.policy.model import ALLOW, DENY
from sros_tool.policy.rights import Right
from sros_tool.report.compose import PictureSource, compose, overlay
from sros_tool.report.focus import focused_picture
from sros_tool.report.folding import Folding
from sros_tool.report.picture import Picture, PicturedFinding, SourceTitle
from tests.report.pictures import group, picture_of, source_of
from tests.support.harness import policy_text, sros

ROBOTS = [f"r{number}" for number in range(1, 13)]


def fleet(more: dict[str, str] | None = None) -> dict[str, str]:
    """A robot of two enclaves for each name, a dispatcher of all, and what is ``more``."""
    enclaves = {}
    for name in ROBOTS:
        enclaves[f"/{name}/base"] = group(
            "topics", "publish", f"/{name}/odom", f"/fleet/{name}_state"
        )
        enclaves[f"/{name}/nav"] = group("topics", "subscribe", f"/{name}/odom", f"/{name}/goal")
    enclaves["/dispatcher"] = group("topics", "publish", *(f"/{name}/goal" for name in ROBOTS))
    enclaves["/dispatcher"] += group("topics", "subscribe", "/fleet/*")
    for path, text in (more or {}).items():
        enclaves[path] = enclaves.get(path, "") + text
    return enclaves


def drawn(folding: Folding) -> set[tuple[str, str, str]]:
    return {(edge.enclave, edge.right, edge.name) for edge in folding.picture.edges}


def test_equal_robots_are_one_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folding = Folding.of(picture_of(tmp_path, fleet()))
    (equal,) = folding.equal
    assert (equal.label, equal.what, equal.members) == ("{r1…r12}", "namespace", tuple(ROBOTS))
    assert drawn(folding) == {
        ("/{r1…r12}/base", "publish", "/{r1…r12}/odom"),
        ("/{r1…r12}/base", "publish", "/fleet/{r1…r12}_state"),
        ("/{r1…r12}/nav", "subscribe", "/{r1…r12}/odom"),
        ("/{r1…r12}/nav", "subscribe", "/{r1…r12}/goal"),
        ("/dispatcher", "publish", "/{r1…r12}/goal"),
        ("/dispatcher", "subscribe", "/fleet/{r1…r12}_state"),
    }
    assert folding.enclaves["/{r1…r12}/nav"] == tuple(f"/{name}/nav" for name in ROBOTS)
    names = folding.names["topics", "/fleet/{r1…r12}_state"]
    assert names == tuple(f"/fleet/{name}_state" for name in ROBOTS)
    (scene,) = folding.scenes()
    assert scene.shown == 3 * len(ROBOTS) and scene.hidden == 0
    assert {frame.title for frame in scene.frames} == {"/", "r1 … r12: 12 equal namespaces"}
    assert not folding.different


@pytest.mark.parametrize(
    ("path", "rights", "more", "fewer"),
    [
        ("/r5/base", group("topics", "publish", "/r5/x"), "/r5/base publish /r5/x", ""),
        ("/dispatcher", group("topics", "publish", "/r5/odom"), "/dispatcher publish /r5/odom", ""),
        (
            "/dispatcher",
            group("topics", "subscribe", "/fleet/r5_state", qualifier="DENY"),
            "/dispatcher DENY subscribe /fleet/r5_state",
            "/dispatcher subscribe /fleet/r5_state",
        ),
        ("/r5/arm", group("topics", "publish", "/r5/x"), "enclave /r5/arm", ""),
    ],
)
def test_a_robot_that_differs_stands_alone_and_says_in_what(
    tmp_path: Path, path: str, rights: str, more: str, fewer: str
) -> None:
    folding = Folding.of(picture_of(tmp_path, fleet({path: rights})))
    (equal,) = folding.equal
    assert set(equal.members) == set(ROBOTS) - {"r5"}
    (different,) = folding.different
    assert (different.unit, different.usual) == ("r5", "{r1…r12}")
    assert different.more == (more,) and different.fewer == ((fewer,) if fewer else ())
    marked = {(e.enclave, e.name) for e in folding.picture.edges if e.differs}
    assert len(marked) == 1
    assert {enclave.path for enclave in folding.picture.enclaves} >= {"/r5/base", "/{r1…r12}/base"}
    assert any(link.differs for scene in folding.scenes() for link in scene.links)


def test_what_every_node_needs_makes_nothing_alike(tmp_path: Path) -> None:
    """A battery has parameters as cameras have, and is no camera that differs."""
    sensors = {
        name: group("topics", "publish", f"/{name}/image", f"/{name}/info", f"/{name}/state")
        for name in ("left_camera", "right_camera")
    }
    sensors["battery"] = group("topics", "publish", "/charge")
    enclaves = {
        f"/{name}": own
        + group("topics", "publish", "/rosout", "/parameter_events")
        + group("services", "reply", *(f"/{name}/{service}" for service in NODE_SERVICES))
        for name, own in sensors.items()
    }
    folding = Folding.of(picture_of(tmp_path, enclaves))
    assert [units.members for units in folding.equal] == [("left_camera", "right_camera")]
    assert not folding.different


@pytest.mark.parametrize("more", ["/parameter_*", "/left/*", "/left/more"])
def test_units_are_equal_only_in_all_their_rights(tmp_path: Path, more: str) -> None:
    """Also if a wildcard matches only names of both, or a focus does not draw the right."""
    own = {
        f"/{name}/gripper": group("topics", "publish", "/parameter_events", "/both")
        for name in ("left", "right")
    }
    equal = compose(source := source_of(tmp_path, own))
    assert Folding.of(equal).equal
    assert Folding.of(focused_picture(equal, [source], ["/both"])).equal
    unlike = own | {"/left/gripper": own["/left/gripper"] + group("topics", "publish", more)}
    picture = compose(source := source_of(tmp_path, unlike))
    assert not Folding.of(picture).equal
    focused = focused_picture(picture, [source], ["/both"])
    assert not Folding.of(focused).equal
    before, after = (
        source_of(
            tmp_path,
            {
                path: own[path] + group("topics", "publish", wild)
                for path, wild in zip(own, wilds, strict=True)
            },
        )
        for wilds in (("/parameter_*", "/param*"), ("/param*", "/parameter_*"))
    )
    assert not Folding.of(overlay(before, after, "change")).equal


def test_robots_that_name_each_other_are_equal_by_how_many(tmp_path: Path) -> None:
    enclaves = {
        f"/{name}/nav": group("topics", "publish", f"/{name}/pose")
        + group("topics", "subscribe", *(f"/{name}/pose" for name in ROBOTS))
        for name in ROBOTS
    }
    assert drawn(Folding.of(picture_of(tmp_path, enclaves))) == {
        ("/{r1…r12}/nav", "publish", "/{r1…r12}/pose"),
        ("/{r1…r12}/nav", "subscribe", "/{r1…r12}/pose"),
        ("/{r1…r12}/nav", "subscribe", "/{11 others of r1…r12}/pose"),
    }
    # All report to one of them, which is drawn by its own name.
    leader = {f"/{name}/nav": group("topics", "publish", "/r3/inbox") for name in ROBOTS}
    leader["/r3/nav"] += group("topics", "subscribe", "/r3/inbox")
    folding = Folding.of(picture_of(tmp_path, leader))
    assert ("/{r1…r12}/nav", "publish", "/r3/inbox") in drawn(folding)
    assert "/r3/nav" in {enclave.path for enclave in folding.picture.enclaves}


def test_equal_units_may_name_one_of_another_kind(tmp_path: Path) -> None:
    others = {f"/e{n}/follower": group("topics", "subscribe", "/r2/odom") for n in range(1, 4)}
    others |= {f"/s{n}/arm": group("topics", "publish", f"/s{n}/pose") for n in range(1, 9)}
    others |= {f"/v{n}/viewer": group("topics", "subscribe", "/s2/pose") for n in range(1, 4)}
    folding = Folding.of(picture_of(tmp_path, fleet(others)))
    label = "/{1 of r1…r12}/odom"
    assert ("/{e1…e3}/follower", "subscribe", label) in drawn(folding)
    assert "/r2/odom" in folding.names["topics", label]
    assert ("/{v1…v3}/viewer", "subscribe", "/{1 of s1…s8}/pose") in drawn(folding)


def test_robots_of_a_fleet_whose_namespaces_have_other_names(tmp_path: Path) -> None:
    colors = {"r1": "red", "r2": "green", "r3": "blue"}
    enclaves = {
        f"/{name}/base": group("topics", "publish", f"/{color}/odom", f"/{name}/state")
        for name, color in colors.items()
    }
    robots = {f"/{name}/base": Robot(name, f"/{color}") for name, color in colors.items()}
    folding = Folding.of(picture_of(tmp_path, enclaves), robots)
    assert {name for _, _, name in drawn(folding)} == {"/{red…blue}/odom", "/{r1…r3}/state"}
    assert folding.names["topics", "/{red…blue}/odom"] == ("/red/odom", "/green/odom", "/blue/odom")


def test_enclaves_of_other_names_and_labels_in_names_are_not_folded(tmp_path: Path) -> None:
    folding = Folding.of(
        picture_of(
            tmp_path,
            {f"/{name}": group("topics", "publish", f"/{name}_{name}x") for name in ("a", "b")},
        )
    )
    assert {name for _, _, name in drawn(folding)} == {"/a_ax", "/b_bx"}
    hostile = PictureSource(
        SourceTitle("x", "permissions"),
        frozenset(Right(f"/{name}", ALLOW, "publish", f"/{name}/{{a…b}}") for name in ("a", "b")),
    )
    assert not Folding.of(compose(hostile)).equal


def literal(folding: Folding, picture: Picture) -> None:
    """Every edge is drawn, and no drawn edge stands for one that is not there."""
    real = {(e.enclave, e.right, str(e.qualifier), e.name) for e in picture.edges}
    shown = Counter[tuple[str, str, str, str]]()
    for edge in folding.picture.edges:
        owners = folding.enclaves.get(edge.enclave, (edge.enclave,))
        names = folding.names.get((edge.kind, edge.name), (edge.name,))
        of_others = " other" in edge.name or " of " in edge.name
        for number, owner in enumerate(owners):
            pairs = names if of_others or len(names) != len(owners) else (names[number],)
            for name in pairs:
                key = owner, edge.right, str(edge.qualifier), name
                shown[key] += key in real
                assert key in real or of_others, (edge, key)
    assert set(shown) >= real, real - set(shown)


OWNERS = st.sampled_from([f"/{name}/{part}" for name in ("a", "b", "c") for part in ("x", "y")])
NAMES = st.sampled_from(
    ["/t", "/a/t", "/b/t", "/c/t", "/a/u", "/b/u", "/c/u", "/a_v", "/b_v", "/c_v", "/*", "/a/*"]
)


@given(
    st.frozensets(
        st.builds(
            Right,
            st.one_of(OWNERS, st.just("/boss")),
            st.sampled_from([ALLOW, ALLOW, DENY]),
            st.sampled_from(["publish", "subscribe"]),
            NAMES,
        ),
        max_size=8,
    ),
    st.sampled_from(["/x", "/y"]),
)
def test_what_is_drawn_is_exactly_what_is_there(rights: frozenset[Right], part: str) -> None:
    """Also of robots that all have the same at first, and then something of their own."""
    base = {Right(f"/{name}{part}", ALLOW, "publish", f"/{name}/t") for name in ("a", "b", "c")}
    picture = compose(PictureSource(SourceTitle("x", "policy"), rights | base))
    literal(Folding.of(picture), picture)


def test_robots_that_were_perhaps_observed_are_not_drawn_as_observed(tmp_path: Path) -> None:
    seen = {path: rights for path, rights in fleet().items() if "/r5/" not in path}
    lost = PicturedFinding("graph.unknown-enclave", "note", "nodes without a known enclave")
    observation = replace(source_of(tmp_path, seen, "seen.xml"), findings=(lost,))
    picture = overlay(source_of(tmp_path, fleet()), observation, "use")
    notes = {e.path: e.note for e in Folding.of(picture).picture.enclaves}
    assert notes["/r5/base"].endswith("perhaps observed")
    assert notes["/{r1…r12}/base"] == ""


def test_names_without_the_other_side_are_marked_everywhere(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(
        policy_text(
            {
                "/a": group("topics", "publish", "/lost", "/used")
                + group("services", "request", "/nobody")
                + group("actions", "execute", "/idle"),
                "/b": group("topics", "subscribe", "/used", "/silent"),
            }
        )
    )
    picture = json.loads(sros("view", policy, "--json").ok().out)
    assert {name["name"]: name["lacks"] for name in picture["names"]} == {
        "/idle": "sender",
        "/lost": "receiver",
        "/nobody": "receiver",
        "/silent": "sender",
        "/used": "",
    }
    svg = sros("view", policy, "--format", "svg").ok().out
    said = ("publish", "subscribe", "serve", "call")
    assert all(f'<text class="small lack" x="32" y="34">nobody may {e}<' in svg for e in said)
    assert svg.count('class="card names lacking"') == 4
    assert "nobody may send it, or nobody may receive it" in svg
    open_to_all = sros("view", policy, "--template", "sros2", "--json").ok().out
    assert {name["lacks"] for name in json.loads(open_to_all)["names"]} == {
        "",
        "sender",
        "receiver",
    }


def test_the_verb_says_what_is_drawn_as_one(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text(fleet({"/r5/base": group("topics", "publish", "/r5/x")})))
    ended = sros("view", policy, "--format", "svg").ok()
    assert ended.err == (
        "r1 … r12: 11 equal namespaces are drawn as one\n"
        "r5 differs from r1 … r12: it has /r5/base publish /r5/x\n"
    )
    assert "{r1…r12}: each of 11 namespaces, which are equal except for their names" in ended.out
    assert "that are drawn as one do not have this right" in ended.out
    assert "r1 … r12: 11 equal namespaces are drawn as one" in sros("view", policy).ok().out
    focus = sros("view", policy, "--focus", "/r5/odom", "--format", "svg").ok()
    assert "/r5/nav" in focus.out and "in focus" in focus.out
