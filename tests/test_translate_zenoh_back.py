"""Zenoh rules in ROS terms: the inverse of what sros writes, and never more than they allow."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sros_tool.files import policies_dir
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import ALLOW, DENY
from sros_tool.policy.patterns import covers
from sros_tool.policy.rights import Right
from sros_tool.translate_zenoh.rights import chunks_of, remote_rights, rights_in_rules, ros_names
from sros_tool.zenoh.access import AccessControl
from sros_tool.zenoh.configuration import Configuration, Mode
from sros_tool.zenoh.document import parse_configuration
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


def test_a_wildcard_without_denied_names_comes_back_as_it_was_stated() -> None:
    policy = read_policy(policies_dir() / "mobile_robot.xml")
    (recorder,) = (of for of in policy.enclaves if of.path.endswith("/recorder"))
    control = AccessControl((remote_rights(recorder, 0),))
    text = Configuration(Mode.ROUTER, ("tls/a:1",), (), control).render()
    access = parse_configuration(text, "router.json5").access
    wide = Right(recorder.path, ALLOW, "subscribe", "/*")
    denied = Right(recorder.path, DENY, "subscribe", "/front_camera/*")
    rights = rights_in_rules(access).domains
    assert {right for right in rights if right.right == "subscribe" and "*" in right.name} == {
        wide,
        denied,
    }
    # Rules that allow one name more, or less, are not what sros writes for these two.
    (rule,) = (
        rule
        for rule in access.rules
        if "0/from$*/**/$*::$*/*/**" in rule.key_expressions
        and "egress" in rule.flows
        and "put" in rule.messages
    )
    for keys in (rule.key_expressions[:-1], (*rule.key_expressions, "0/front_camera/x/*/*")):
        rules = tuple(replace(r, key_expressions=keys) if r is rule else r for r in access.rules)
        assert denied not in rights_in_rules(replace(access, rules=rules)).domains
