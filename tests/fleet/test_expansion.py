"""One policy for many robots: what the placeholders give, and that no value adds a right."""

from __future__ import annotations

from pathlib import Path
from string import ascii_letters, digits
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sros_tool.errors import PolicyError, SrosError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.fleet_file import parse_fleet, render_fleet
from sros_tool.fleet.robots import Fleet, Robot, enclaves_of, name_problem, robot_of
from sros_tool.names import is_expression, namespace_problem
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.model import Policy
from tests.support.children import LONG

FLEET = Fleet.of(
    [
        Robot("r1", "/hall/r1", groups=("carriers",)),
        Robot("r2", "/hall/r2", groups=("carriers",)),
        Robot("arm", "/"),
    ],
    groups=("empty",),
)
HEAD = '<policy version="0.2.0"><enclaves>\n'
TAIL = "\n</enclaves></policy>"


def enclave(path: str, names: str, ns: str = "/", node: str = "n", right: str = "ALLOW") -> str:
    topics = "".join(f"<topic>{name}</topic>" for name in names.split())
    return (
        f'<enclave path="{path}"><profiles><profile ns="{ns}" node="{node}">'
        f'<topics publish="{right}">{topics}</topics></profile></profiles></enclave>'
    )


def expanded(text: str, fleet: Fleet = FLEET) -> Policy:
    policy = read_policy(Path("p.xml"), f"{HEAD}{text}{TAIL}".encode(), placeholders=True)
    return FleetPolicy(policy, fleet).policy()


def by_hand(*enclaves: str) -> Policy:
    return read_policy(Path("p.xml"), f"{HEAD}{''.join(enclaves)}{TAIL}".encode())


def test_one_enclave_for_each_robot_with_its_values() -> None:
    text = enclave("/{robot}/base", "{namespace}/odom ~/x /all/{robot}_state", "{namespace}", "b")
    assert expanded(text) == by_hand(
        enclave("/arm/base", "/odom ~/x /all/arm_state", "/", "b"),
        enclave("/r1/base", "/hall/r1/odom ~/x /all/r1_state", "/hall/r1", "b"),
        enclave("/r2/base", "/hall/r2/odom ~/x /all/r2_state", "/hall/r2", "b"),
    )


def test_the_robots_of_a_group() -> None:
    text = enclave(
        "/{robot:carriers}", "{robot}/x {robot:carriers}/y", "/a{namespace}/b", "{robot}"
    )
    assert expanded(text) == by_hand(
        enclave("/r1", "r1/x r1/y", "/a/hall/r1/b", "r1"),
        enclave("/r2", "r2/x r2/y", "/a/hall/r2/b", "r2"),
    )


def test_a_right_for_each_robot_is_said_once() -> None:
    text = enclave("/d", "{namespaces}/cmd {robots:carriers}/x /y {robots:empty}") + enclave(
        "/{robot:carriers}", "/from/{robot}/to/{robots:carriers}"
    )
    assert expanded(text) == by_hand(
        enclave("/d", "/cmd /hall/r1/cmd /hall/r2/cmd r1/x r2/x /y"),
        enclave("/r1", "/from/r1/to/r1 /from/r1/to/r2"),
        enclave("/r2", "/from/r2/to/r1 /from/r2/to/r2"),
    )


def test_lines_are_those_of_the_names() -> None:
    text = enclave("/d", "/a {robots}/x").replace("<topic>", "\n<topic>")
    (group,) = expanded(text).enclaves[0].all_profiles()[0].groups
    assert [group.source_of(i).line for i in range(4)] == [3, 4, 4, 4]


def test_robots_that_share_a_namespace_give_its_names_once() -> None:
    fleet = Fleet.of([Robot("a", "/x"), Robot("b", "/x")])
    assert expanded(enclave("/d", "{namespaces}/cmd"), fleet) == by_hand(enclave("/d", "/x/cmd"))


def test_a_group_without_robots_gives_no_name_and_no_enclave() -> None:
    text = enclave("/{robot:empty}/x", "/a") + enclave("/d", "{robots:empty}/x")
    (only,) = expanded(text).enclaves
    assert (only.path, only.all_profiles()[0].groups) == ("/d", ())
    with pytest.raises(PolicyError, match="no enclave for this fleet"):
        expanded(enclave("/{robot:empty}/x", "/a"))


def test_a_policy_without_placeholders_is_the_same() -> None:
    text = enclave("/a", "/x* y") + enclave("/b", "/z", right="DENY")
    assert expanded(text) == by_hand(text)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (enclave("/{robots}", "/x"), "write {robot}"),
        (enclave("/{robot:a}/{robot:b}", "/x"), "different groups"),
        (enclave("/d", "{robot}/x"), "write {robots}"),
        (enclave("/d", "{namespace:carriers}/x"), "write {namespaces:carriers}"),
        (enclave("/d", "/x", "{namespace}"), "does not say which one"),
        (enclave("/{robot}", "/x", "{namespaces}"), "only one can be here"),
        (enclave("/{robot}", "/x", node="{robots}"), "only one can be here"),
        (enclave("/{robot}", "/x", node="{namespace}"), "not a valid node name"),
        (
            enclave("/{robot}", "{robot:carriers}/x"),
            "write another enclave for the group, with {robot:carriers} in",
        ),
        (enclave("/{robot}", "{robots}/{robots:carriers}"), "several groups"),
        (enclave("/{robot}", "/{robot}*"), "same part"),
        (enclave("/{robot}", "/*{robot}/x"), "same part"),
        (enclave("/{robot}", "/{robot}_?"), "same part"),
        (enclave("/{robot}", "/[{robot}]"), "same part"),
        (enclave("/{robot}", "/[a/{robot}/b]"), "same part"),
        (enclave("/{robot}", "{namespace}*"), "same part"),
        (enclave("/{robot}", "{namespace}x"), "whole namespace"),
        (enclave("/{robot}", "/{namespace}/x"), "whole namespace"),
        (enclave("/{robot}", "{Robot}"), "not a placeholder"),
        (enclave("/{robot}", "{robot:}"), "not a placeholder"),
        (enclave("/{robot}", "{robot:a-b}"), "not a placeholder"),
        (enclave("/{robot}", "{{robot}}"), "brace"),
        (enclave("/{robot}", "{robot"), "brace"),
        (enclave("/{robot}", "robot}"), "brace"),
        (enclave("/{robot}", "{}"), "not a placeholder"),
        (enclave("{robot}/a", "/x"), "'{robot}/a' is not a valid enclave name"),
        (enclave("{robot}/a", "/x"), "Write '/{robot}/a'."),
        (enclave("/{robot}", "/x", "{robot}"), "Write '{namespace}' or '/{robot}'."),
        (enclave("/{robot}", "~{robot}"), "After '~'"),
        (enclave("/{robot}", "1{robot}"), "starts with a digit"),
        (enclave("{robot}", "/x"), "does not start with '/'"),
        (enclave("/{robot:none}", "/x"), "no group 'none'"),
        (enclave("/d", "{robots:none}"), "no group 'none'"),
        (enclave("/{robot}", "{namespace}"), "It is a namespace"),
        (enclave("/{robot}", "/x") + enclave("/r1", "/x"), "The other definition is at p.xml:2"),
        (
            enclave("/{robot}", "/x") + enclave("/{robot:carriers}", "/x"),
            "one enclave for each group",
        ),
        (enclave(f"/{{robot}}/{'a' * 60}", "/x"), "for the robot arm"),
    ],
)
def test_what_cannot_be_used_is_refused_with_file_and_line(text: str, problem: str) -> None:
    with pytest.raises(SrosError) as caught:
        expanded(text)
    assert problem in str(caught.value)
    assert str(caught.value).startswith("p.xml:2")


def test_two_robots_in_one_enclave() -> None:
    fleet = Fleet.of([Robot("a", "/x"), Robot("b", "/x")])
    with pytest.raises(PolicyError, match=r"defined twice.*for another robot"):
        expanded(enclave("{namespace}/base", "/y"), fleet)


def test_too_many_names_are_refused_before_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet.of(Robot(f"r{i}", f"/r{i}") for i in range(1000))
    text = enclave("/d", " ".join(f"{{robots}}/t{i}" for i in range(300)))
    made = FleetPolicy._filled_names
    count = 0

    def counted(*arguments: Any) -> tuple[str, ...]:
        nonlocal count
        names = made(*arguments)
        count += len(names)
        return names

    monkeypatch.setattr(FleetPolicy, "_filled_names", counted)
    with pytest.raises(PolicyError, match="more than 200000 names"):
        expanded(text, fleet)
    assert count == 201_000


# ── no value adds a right ──────────────────────────────────────────────────────────────────

CHARACTERS = f"{ascii_letters[:4]}{digits[:3]}_/*?[]{{}}<>&\"'~ \n:-!"
NAMES = st.text(CHARACTERS, max_size=8) | st.sampled_from(["r1", "r10", "_", "a_b", "robot"])
NAMESPACES = NAMES.map(lambda name: f"/{name}") | st.just("/")
TEMPLATES = st.sampled_from(
    ["{robot}/x", "/{robot}", "{namespace}/x", "~/{robot}_s", "/a/{robots}", "{namespaces}/y",
     "/*/{robot}/[a-c]?", "/{robot}/p/{robots}", "/plain", "/w*"]
)  # fmt: skip


@settings(max_examples=1000 if LONG else 30, deadline=None)
@given(
    robots=st.lists(st.tuples(NAMES, NAMESPACES), min_size=1, max_size=4, unique_by=lambda r: r[0]),
    names=st.lists(TEMPLATES, min_size=1, max_size=4, unique=True),
)
def test_a_value_is_refused_or_gives_the_structure_that_was_written(
    robots: list[tuple[str, str]], names: list[str]
) -> None:
    """Every name has the wildcards and parts of what was written, and there are no others."""
    toml = "".join(
        f"[robots.{quoted(name)}]\nnamespace = {quoted(namespace)}\n" for name, namespace in robots
    )
    valid = not any(name_problem(n) or namespace_problem(ns) for n, ns in robots)
    try:
        fleet = parse_fleet(toml.encode(), "it")
    except SrosError:
        assert not valid
        return
    assert valid
    assert parse_fleet(render_fleet(fleet).encode(), "it") == fleet
    policy = expanded(enclave("/{robot}/e", " ".join(names)), fleet)
    assert [each.path for each in policy.enclaves] == [f"/{name}/e" for name in fleet.robots]
    owned = fleet.with_enclaves(["/{robot}/e"])
    for each, robot in zip(policy.enclaves, fleet.robots.values(), strict=True):
        assert robot_of(owned, each.path) == robot
        assert enclaves_of(owned, robot) == (each.path,)
        ((profile,),) = [block.profiles for block in each.profiles]
        (group,) = profile.groups
        assert group.rights == (("publish", "ALLOW"),)
        wanted = []
        for name in names:
            own = name.replace("{robot}", robot.name).replace(
                "{namespace}", robot.namespace.removesuffix("/")
            )
            several = [
                own.replace("{robots}", r.name).replace(
                    "{namespaces}", r.namespace.removesuffix("/")
                )
                for r in (fleet.robots.values() if "s}" in name else [robot])
            ]
            wanted += list(dict.fromkeys(several))
            assert all(is_expression(one) == is_expression(name) for one in several)
        assert list(group.names) == wanted
    assert read_policy(Path("p.xml"), policy_xml(policy)) == policy


def quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'
