"""Zenoh rules in ROS terms: the inverse of what sros writes, and never more than they allow."""

from __future__ import annotations

import pytest

from sros_tool.policy.patterns import covers
from sros_tool.translate_zenoh.rights import chunks_of, ros_names
from sros_tool.zenoh.key_expressions import canonical


@pytest.mark.parametrize(
    "name",
    ["/chatter", "/a/b/c", "/*", "/cam*", "/*cam", "/cam/*", "/*/cam", "/a*/b", "/a/*/b", "/a*b*"],
)
def test_the_name_that_was_translated_comes_back(name: str) -> None:
    keys = [canonical(("0", *chunks, "*", "*")) for chunks in chunks_of(name)]
    found = {each for key in keys for each in ros_names(key)}
    assert name in found
    assert all(each == name or covers(name, each) for each in found)


@pytest.mark.parametrize(
    ("key", "names"),
    [
        ("0/chatter/std_msgs::msg::dds_::String_/RIHS01_00", "/chatter"),
        ("0/chatter/**", "/chatter /chatter/*"),
        ("0/**/cam/*/*", "/*/cam /cam"),
        ("0/a/**/b/*/*", "/a/*/b /a/b"),
        ("0/" + "**/a/" * 9 + "*/*", ""),
        ("0/**", "/*"),
        ("*/chatter/*/*", "/chatter"),
        ("0/*/chatter/*/*", "/*/chatter"),
        ("0/chatter/*", ""),
        ("0/a/b", ""),
        ("@ros2_lv/0/**", ""),
        ("0", ""),
        ("0/@adv/*/*", ""),
        ("0/9lives/*/*", ""),
    ],
)
def test_key_expressions_of_others(key: str, names: str) -> None:
    assert ros_names(key) == tuple(names.split())
