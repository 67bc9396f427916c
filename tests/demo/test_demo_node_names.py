"""Nodes of the demo bear names that their enclave allows."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant
from sros_tool.demo.casting import (
    allows,
    is_node_allowed,
    naming_arguments,
    node_names,
    nodes_named,
)
from sros_tool.demo.scenarios.model import Role
from sros_tool.files import policies_dir
from sros_tool.names import NODE_SERVICES
from sros_tool.policy.document import read_policy
from sros_tool.translate import permissions_for
from sros_tool.validity import window
from tests.support.harness import policy_text, publish

NOW = datetime(2026, 1, 1, tzinfo=UTC)


def grant_of(file: Path, enclave: str) -> Grant:
    (found,) = (each for each in read_policy(file).enclaves if each.path == enclave)
    validity = window(NOW, timedelta(days=1))
    return permissions_for(
        found, subject="CN=/x", validity=validity, domains=DomainSet.of((0, 0))
    ).grants[0]


@pytest.mark.parametrize(
    ("file", "enclave", "role", "names"),
    [
        ("talker_listener.xml", "/talker_listener/talker", Role.TALKER, ["/talker"]),
        ("talker_listener.xml", "/talker_listener/talker", Role.OBSERVER, ["/talker"]),
        ("add_two_ints.xml", "/add_two_ints/client", Role.CLIENT, ["/add_two_ints_client"]),
        ("add_two_ints.xml", "/add_two_ints/client", Role.SERVER, ["/add_two_ints_client"]),
        ("fibonacci.xml", "/fibonacci/server", Role.ACTION_SERVER, ["/fibonacci_action_server"]),
        ("composition.xml", "/composition", Role.COMPOSED, ["/talker", "/listener", "/Server"]),
        ("talker_listener.xml", "/talker_listener/listener", Role.COMPOSED,
         ["/listener", "/listener", "/listener"]),
        ("mobile_robot.xml", "/mobile_robot/camera", Role.TALKER, ["/front_camera/driver"]),
        ("defaults/everything.xml", "/", Role.ACTION_CLIENT, ["/action_client"]),
        ("defaults/node_basics.xml", "/", Role.SERVER, ["/server"]),
    ],
)  # fmt: skip
def test_names(file: str, enclave: str, role: Role, names: list[str]) -> None:
    grant = grant_of(policies_dir() / file, enclave)
    found = node_names(role, grant)
    assert list(found) == names
    assert all(is_node_allowed(grant, name) for name in found)


def test_without_security_nodes_keep_their_names() -> None:
    assert node_names(Role.COMPOSED, None) == ("/talker", "/listener", "/server")
    assert naming_arguments(Role.COMPOSED, ("/talker", "/listener", "/server")) == []


def test_where_no_node_is_allowed_the_name_stays_and_dds_decides(tmp_path: Path) -> None:
    file = tmp_path / "policy.xml"
    file.write_text(policy_text({"/a": publish("chatter")}))
    grant = grant_of(file, "/a")
    assert allows(grant, "publish", "rt/chatter")
    assert not list(nodes_named(grant))
    assert node_names(Role.TALKER, grant) == ("/talker",)


def test_a_node_that_lacks_one_of_its_services_is_not_allowed() -> None:
    policy = (policies_dir() / "defaults/node_basics.xml").read_text()
    for service in NODE_SERVICES:
        line = f"<service>~/{service}</service>"
        assert line in policy


def test_arguments_that_rcl_understands() -> None:
    names = ("/robot/mouth", "/listener", "/Server")
    rules = [
        *("-r", "talker:__node:=mouth", "-r", "mouth:__ns:=/robot"),
        *("-r", "server:__node:=Server"),
    ]
    assert naming_arguments(Role.COMPOSED, names) == ["--ros-args", *rules, "--"]
