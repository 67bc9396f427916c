"""Policies in the shapes that are found in public, with names of our own, have their rights."""

from __future__ import annotations

from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from lxml import etree

from sros_tool.dds.domains import DomainSet
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.translate import permissions_for
from sros_tool.validity import Window

Topics = dict[str, set[tuple[str, str, str]]]
"""Each enclave's DDS topics, with ALLOW or DENY and publish or subscribe."""

_SERVICE = {"request": ("rq", "rr"), "reply": ("rr", "rq")}
_ENDS = {"rq": "Request", "rr": "Reply"}


def _enclave(path: str, *profiles: str) -> str:
    block = f"<profiles>{''.join(profiles)}</profiles>"
    enclave = f'<enclave path="{path}">{block}</enclave>'
    return f'<policy version="0.2.0"><enclaves>{enclave}</enclaves></policy>'


def _one_enclave(ns: str, one: str, other: str) -> str:
    return _enclave(
        f"/{one}",
        f'<profile ns="{ns}" node="{one}"><topics publish="ALLOW"><topic>level</topic></topics>'
        '<services reply="ALLOW"><service>~/get_parameters</service></services></profile>',
        f'<profile ns="{ns}" node="{other}"><topics subscribe="ALLOW"><topic>level</topic></topics>'
        '<actions call="ALLOW"><action>fill</action></actions></profile>',
    )


def _root_enclave(ns: str, one: str, _other: str) -> str:
    star = '<topics publish="ALLOW"><topic>*</topic><topic>*/*</topic></topics>'
    return _enclave("/", f'<profile node="{one}" ns="{ns}">{star}</profile>')


def _denied_otherwise(ns: str, one: str, other: str) -> str:
    return _enclave(
        f"/{other}",
        f'<profile ns="{ns}" node="{one}">'
        '<topics publish="ALLOW" subscribe="ALLOW"><topic>swarm/level</topic></topics>'
        '<topics publish="DENY" subscribe="DENY"><topic>**</topic></topics></profile>',
    )


_YEAR = Window(datetime(2026, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC))
_ROBOTS = (
    ("/", "gauge", "display"),
    ("/plant/", "mixer_3", "panel"),
    ("/a/b", "camera", "recorder"),
    ("/left_arm", "gripper", "planner"),
)


def _read_independently(file: Path) -> Topics:
    """Return what ros2/sros2 signs for a policy, read with libxml2's own XInclude."""
    tree: Any = etree.parse(str(file))
    tree.xinclude()
    found: Topics = defaultdict(set)
    for profile in tree.iter("profile"):
        parent = profile.getparent().getparent()
        at = profile.get("ns").rstrip("/") + "/"
        found[parent.get("path")] |= {
            (qualifier, way, topic)
            for group in profile
            for right, qualifier in group.attrib.items()
            if right in ("publish", "subscribe", "request", "reply", "call", "execute")
            for item in group
            for way, topic in _signed(right, _full(item.text, at, profile.get("node")))
        }
    return found


def _full(name: str, at: str, node: str) -> str:
    if name[0] == "~":
        return f"{at}{node}/{name[1:].lstrip('/')}"
    return name if name[0] == "/" else at + name


def _signed(right: str, name: str) -> set[tuple[str, str]]:
    if right in ("publish", "subscribe"):
        return {(right, f"rt{name}")}
    if right in _SERVICE:
        written, read = _SERVICE[right]
        topics = {"publish": written, "subscribe": read}
        return {(way, f"{start}{name}{_ENDS[start]}") for way, start in topics.items()}
    service, topic = ("request", "subscribe") if right == "call" else ("reply", "publish")
    inside = f"{name}/_action/"
    return {
        pair
        for part in ("send_goal", "cancel_goal", "get_result")
        for pair in _signed(service, inside + part)
    } | {(topic, f"rt{inside}{part}") for part in ("feedback", "status")}


def _signed_by_sros(policy: Policy, window: Window) -> Topics:
    found: Topics = {}
    for enclave in policy.enclaves:
        domains = DomainSet.of((0, 0))
        permissions = permissions_for(enclave, subject="CN=x", validity=window, domains=domains)
        found[enclave.path] = {
            ("ALLOW" if rule.allow else "DENY", way, topic)
            for rule in permissions.grants[0].rules
            for way in ("publish", "subscribe")
            for criteria in getattr(rule, way)
            for topic in criteria.topics
            if topic != "ros_discovery_info"
        }
    return found


@pytest.mark.parametrize("robot", _ROBOTS, ids=lambda robot: str(robot[1]))
@pytest.mark.parametrize("shape", [_one_enclave, _root_enclave, _denied_otherwise])
def test_a_policy_has_its_rights(shape: Any, robot: tuple[str, str, str], tmp_path: Path) -> None:
    file = tmp_path / "policy.xml"
    file.write_text(shape(*robot))
    assert _signed_by_sros(read_policy(file), _YEAR) == _read_independently(file)
