"""Rights lead to the names that they really reach, and denials count first."""

from __future__ import annotations

from pathlib import Path

from sros_tool.policy.model import ALLOW, DENY
from tests.report.pictures import edge, edges, group, mobile_robot, picture_of


def test_a_wildcard_leads_to_the_known_names_that_it_matches(tmp_path: Path) -> None:
    picture = picture_of(
        tmp_path,
        {
            "/camera": group("topics", "publish", "/camera/image", "/camera/info", "/status"),
            "/viewer": group("topics", "subscribe", "/camera/*"),
        },
    )
    assert edges(picture, "/viewer") == {
        ("subscribe", "/camera/image", "ALLOW"),
        ("subscribe", "/camera/info", "ALLOW"),
    }
    assert edge(picture, "/viewer", "subscribe", "/camera/info").by == ("/camera/*",)
    statement = next(e for e in picture.enclaves if e.path == "/viewer").statements[0]
    assert (statement.name, statement.reaches) == ("/camera/*", 2)


def test_a_name_that_is_also_said_by_itself_is_not_by_a_wildcard_only(tmp_path: Path) -> None:
    picture = picture_of(tmp_path, {"/a": group("topics", "publish", "/x", "/*")})
    assert edge(picture, "/a", "publish", "/x").by == ()


def test_a_denial_counts_before_every_allow(tmp_path: Path) -> None:
    picture = picture_of(
        tmp_path,
        {
            "/a": group("topics", "publish", "/camera/image", "/scan"),
            "/b": group("topics", "subscribe", "/*")
            + group("topics", "subscribe", "/camera/*", qualifier="DENY"),
        },
    )
    assert edges(picture, "/b") == {
        ("subscribe", "/camera/image", "DENY"),
        ("subscribe", "/scan", "ALLOW"),
    }


def test_a_wildcard_that_reaches_nothing_known_is_drawn_itself(tmp_path: Path) -> None:
    picture = picture_of(
        tmp_path,
        {
            "/a": group("topics", "publish", "/image/*"),
            "/b": group("topics", "subscribe", "/*"),
            "/c": group("topics", "subscribe", "/image/*", qualifier="DENY"),
            "/d": group("topics", "subscribe", "/image/raw*", qualifier="DENY"),
        },
    )
    assert edge(picture, "/a", "publish", "/image/*").by == ()
    assert edge(picture, "/b", "subscribe", "/image/*").by == ("/*",)
    assert edge(picture, "/c", "subscribe", "/image/*").qualifier is DENY
    # What denies only some of it leaves the rest, so it leads to a name of its own.
    assert ("subscribe", "/image/*", "DENY") not in edges(picture, "/d")
    assert next(n for n in picture.names if n.name == "/image/*").wildcard


def test_an_action_is_one_name_also_for_who_has_some_of_its_parts(tmp_path: Path) -> None:
    picture = picture_of(
        tmp_path,
        {
            "/server": group("actions", "execute", "/dock"),
            "/client": group("services", "request", "/*") + group("topics", "subscribe", "/dock/*"),
            "/recorder": group("topics", "subscribe", "/*"),
        },
    )
    assert {name.name for name in picture.names} == {"/dock"}
    # All parts of an action, by whatever wildcards, are the action.
    call = edge(picture, "/client", "call", "/dock")
    assert (call.qualifier, call.parts) == (ALLOW, ())
    recorder = edge(picture, "/recorder", "subscribe", "/dock")
    assert (recorder.parts, recorder.by) == (("feedback", "status"), ("/*",))


def test_what_every_node_needs_is_told_apart() -> None:
    picture = mobile_robot()
    assert edge(picture, "/mobile_robot/lidar", "publish", "/rosout").common
    assert not edge(picture, "/mobile_robot/lidar", "publish", "/scan").common
    # To ask for another node's parameters is nobody's need.
    asked = edge(picture, "/mobile_robot/monitor", "request", "/lidar_driver/get_parameters")
    assert not asked.common
    assert asked.by == ("/*/get_parameters",)
