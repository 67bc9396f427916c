"""A scene tells of every name, overlaps nowhere, and stays readable when there is much."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from sros_tool.names import NODE_SERVICES
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import DENY
from sros_tool.policy.rights import policy_rights
from sros_tool.report import pages
from sros_tool.report.compose import PictureSource, compose, overlay
from sros_tool.report.layout import Scene, scenes_of, side_card
from sros_tool.report.picture import Picture, SourceTitle
from tests.report.pictures import group, large_policy, mobile_robot, picture_of, source_of


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Picture:
    path = tmp_path_factory.mktemp("large") / "large.xml"
    path.write_text(large_policy(10, 10, 10))
    return compose(
        PictureSource(SourceTitle("large.xml", "policy"), policy_rights(read_policy(path)))
    )


def check(scene: Scene) -> None:
    """Cards do not overlap, stay on the paper, and links end at the edges of their cards."""
    for column in range(3):
        cards = sorted((c for c in scene.cards if c.column == column), key=lambda c: c.y)
        for above, below in itertools.pairwise(cards):
            assert above.y + above.height < below.y, (above, below)
    for card in scene.cards:
        assert card.y >= 0 and card.x >= 0
        assert card.y + card.height <= scene.height and card.x + card.width <= scene.width
    boxes = {card.id: card for card in scene.cards}
    for link in scene.links:
        source, target = boxes[link.source], boxes[link.target]
        assert source.column + 1 == target.column
        assert source.y <= link.y1 <= source.y + source.height
        assert target.y <= link.y2 <= target.y + target.height


def test_every_name_is_drawn_counted_or_left_out_once() -> None:
    picture = mobile_robot()
    for scene in scenes_of(picture):
        check(scene)
        drawn = [name for card in scene.cards if card.role == "names" for name in card.members]
        notes = [note for card in scene.cards for note in card.notes if "own:" in note]
        counted = sum(
            int(word) for note in notes for word in note.replace(",", "").split() if word.isdigit()
        )
        further = [
            note
            for card in scene.cards
            if any("own:" in other for other in card.notes)
            for note in card.notes
            if note.split()[-1].startswith("action") and "own:" not in note
        ]
        counted += sum(int(note.split()[0]) for note in further)
        assert len(drawn) == len({(c.kind, n) for c in scene.cards for n in c.members if c.kind})
        assert len(drawn) + counted == scene.shown
        assert scene.shown + scene.hidden == len(picture.names)


def test_arrowheads_at_a_card_do_not_overlap_and_notes_fit_on_it() -> None:
    scene = scenes_of(mobile_robot())[0]
    ends: dict[str, list[int]] = {}
    for link in scene.links:
        ends.setdefault(link.target, []).append(link.y2)
    assert max(map(len, ends.values())) > 10
    for target, places in ends.items():
        gaps = [below - above for above, below in itertools.pairwise(sorted(places))]
        assert min(gaps, default=99) >= 7, target
    card = side_card("s/a", 0, "a", ["subscribes to 1234567 names (A)"], ["/a"], "/")
    assert card.notes == ("subscribes to 1234567 names", "(A)")


def test_the_one_who_reads_everything_is_told_by_a_letter_and_its_denial_by_a_line() -> None:
    scene = scenes_of(mobile_robot())[0]
    assert [(o.enclave, o.right) for o in scene.onlookers] == [
        ("/mobile_robot/recorder", "subscribe")
    ]
    recorder = "l/mobile_robot/recorder"
    reads = [e for e in scene.links if recorder == e.target and "subscribe" in e.rights]
    assert [str(link.qualifier) for link in reads] == ["DENY"]
    tagged = {name for card in scene.cards if "A" in card.tags for name in card.members}
    assert "/cmd_vel" in tagged
    assert "/front_camera/image_raw" not in tagged


def test_an_enclave_with_few_wildcards_keeps_its_lines(tmp_path: Path) -> None:
    picture = picture_of(
        tmp_path,
        {
            "/a": group("topics", "publish", *(f"/t{n}" for n in range(5))),
            "/b": group("topics", "subscribe", "/*"),
        },
    )
    scene = scenes_of(picture)[0]
    assert not scene.onlookers
    assert len(scene.links) == 2  # five topics with the same rights are one card


def test_a_hundred_enclaves_are_folded_into_their_groups(large: Picture) -> None:
    assert len(large.enclaves) == 101
    assert len(large.names) == 1000
    scenes = scenes_of(large)
    for scene in scenes:
        check(scene)
        assert len(scene.cards) < 60, scene.id
    overview, *groups = scenes
    assert {c.members for c in overview.cards if c.role == "group" and len(c.members) > 1} == {
        tuple(f"/robot{r}/part{p}" for p in range(10)) for r in range(10)
    }
    assert [scene.title for scene in groups] == ["/fleet", *(f"/robot{r}" for r in range(10))]
    inside = next(scene for scene in groups if scene.title == "/robot4")
    enclaves = {c.members[0] for c in inside.cards if c.role == "enclave"}
    assert enclaves == {f"/robot4/part{p}" for p in range(10)}
    outside = {c.lines[0] for c in inside.cards if c.role == "group"}
    assert outside == {"/fleet", "/robot3", "/robot5"}


def test_what_cannot_be_folded_is_joined_by_its_senders_and_says_so(tmp_path: Path) -> None:
    # Every name is heard by a set of listeners of its own, so that no two are alike.
    heard: dict[str, list[str]] = {f"/l{bit}": [] for bit in range(7)}
    for number in range(1, 120):
        for bit in range(7):
            if number >> bit & 1:
                heard[f"/l{bit}"].append(f"/ns/t{number}")
    said = {"/s": group("topics", "publish", *(f"/ns/t{n}" for n in range(1, 120)))}
    said |= {path: group("topics", "subscribe", *names) for path, names in heard.items()}
    said["/l0"] += group("topics", "subscribe", "/ns/t2", qualifier="DENY")
    scene = scenes_of(picture_of(tmp_path, said))[0]
    check(scene)
    cards = [card for card in scene.cards if card.kind]
    assert sorted(len(card.members) for card in cards) == [1, 118]
    joined = max(cards, key=lambda card: len(card.members))
    assert joined.lines == ("/ns/…",)
    assert joined.notes == ("118 topics; each line is for some of them",)
    denied = [link for link in scene.links if link.qualifier is DENY]
    assert [(link.source != joined.id, link.target) for link in denied] == [(True, "l/l0")]


def test_what_one_enclave_has_alone_is_drawn_where_there_is_little(tmp_path: Path) -> None:
    own = {"/a": group("topics", "publish", "/x") + group("topics", "subscribe", "/y")}
    scene = scenes_of(picture_of(tmp_path, own))[0]
    assert [card.members for card in scene.cards if card.kind] == [("/x",), ("/y",)]
    notes = [note for card in scene.cards for note in card.notes]
    assert notes == ["nobody may subscribe", "nobody may publish"]


def test_a_service_of_every_node_that_an_enclave_may_call_by_name_is_drawn_whole(
    tmp_path: Path,
) -> None:
    served = group("services", "reply", *(f"/guardian/{service}" for service in NODE_SERVICES))
    enclaves = {
        "/watchdog": served,
        "/tuner": group("services", "request", "/guardian/set_parameters"),
        "/look": group("services", "request", "/guardian/list_*"),
    }
    picture = picture_of(tmp_path, enclaves)
    scene = (scenes := scenes_of(picture))[0]
    of = {card.members: card for card in scene.cards if card.kind}
    called, listed = of["/guardian/set_parameters",], of["/guardian/list_parameters",]
    assert {(link.source, link.target) for link in scene.links} == {
        ("s/tuner", called.id),
        (called.id, "l/watchdog"),
        ("s/look", listed.id),
    }
    assert (called.notes, listed.notes) == ((), ("served by /watchdog",))
    ties = pages._page_data(picture, scenes, picture)["ties"]
    assert {tie["common"] for tie in ties if tie["right"] == "reply"} == {True, False}


def test_what_differs_is_never_folded_into_an_enclave(tmp_path: Path) -> None:
    def said(*more: str) -> dict[str, str]:
        return {
            f"/e{n}": group("topics", "publish", f"/own{n}", *(more if n == 3 else ()))
            for n in range(30)
        }

    old = source_of(tmp_path, said("/x"), "old.xml")
    new = source_of(tmp_path, said(), "new.xml")
    scene = scenes_of(overlay(old, new, "change"))[0]
    assert [c.members for c in scene.cards if c.kind] == [("/x",)]
    assert sum("own: 1 topic" in card.notes for card in scene.cards) == 30


def test_an_empty_policy_has_a_picture(tmp_path: Path) -> None:
    picture = picture_of(tmp_path, {"/a": ""})
    scene = scenes_of(picture)[0]
    check(scene)
    assert not scene.links
