"""Two policies differ just if DDS would be told something else."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest
from hypothesis import given

from sros_tool.names import ACTION_SERVICES, GOAL
from sros_tool.policy.model import ALLOW, DENY, Policy
from sros_tool.policy.rights import Right, Rules, compare, policy_rights
from tests.policy.drawn_policies import PATHS, listed, meant, policies
from tests.support.harness import policy_text, publish, sros, subscribe

GOALS = f"/f{GOAL}"


def right(name: str, word: str = "publish", enclave: str = "/a") -> Right:
    return Right(enclave, ALLOW, word, name)


@given(policies(), policies())
def test_empty_only_if_dds_is_told_the_same(first: Policy, second: Policy) -> None:
    both = list(product(PATHS, (True, False)))
    difference = compare(policy_rights(first), policy_rights(second))
    if all(listed(first, p, allow=a) == listed(second, p, allow=a) for p, a in both):
        assert not difference
    if not difference:
        assert all(meant(first, p, allow=a) == meant(second, p, allow=a) for p, a in both)


@pytest.mark.parametrize(
    ("first", "second", "lines"),
    [
        (["publish /x", "publish /*"], ["publish /*"], []),
        (["publish /x", "publish /*"], ["publish /y", "publish /*"], []),
        (["publish /x"], ["publish /*"], ["+ publish /*", "- publish /x"]),
        (["publish /x", "publish /*"], ["publish /x"], ["- publish /*"]),
        (["publish /x", "subscribe /*"], ["subscribe /*"], ["- publish /x"]),
        (["publish /x/y", "publish /x/*"], ["publish /x/?", "publish /x/*"], []),
        (["publish /**"], ["publish /*"], ["+ publish /*", "- publish /**"]),
        (
            ["call /f", "subscribe /*"],
            [*(f"request /f/_action/{each}" for each in ACTION_SERVICES), "subscribe /*"],
            [],
        ),
        (["call /f", "subscribe /*"], ["subscribe /*"], ["- call /f"]),
        (["call /f"], [f"request {GOALS}"], [f"+ request {GOALS}", "- call /f"]),
    ],
)
def test_what_a_wildcard_of_both_covers_is_no_difference(
    first: list[str], second: list[str], lines: list[str]
) -> None:
    one, other = ([right(*each.split()[::-1]) for each in side] for side in (first, second))
    found = compare(one, other).lines()
    assert [f"{sign} {each.right} {each.name}" for sign, each in found] == lines


def test_a_denial_does_not_cover_a_permission() -> None:
    denied = Right("/a", DENY, "publish", "/*")
    assert compare([right("/x"), denied], [denied]).only_first == (right("/x"),)


@given(policies(), policies())
def test_the_other_way_round_it_is_the_same(first: Policy, second: Policy) -> None:
    one, other = policy_rights(first), policy_rights(second)
    there, back = compare(one, other), compare(other, one)
    assert there.only_first == back.only_second
    assert there.covered == back.covered
    for covered, by in there.covered.items():
        assert Rules(by).cover(covered)


def test_lines_are_in_the_order_of_people() -> None:
    difference = compare(
        [right("/x"), right("/z", "call"), right("/y", enclave="/b")],
        [right("/x", "subscribe"), Right("/a", DENY, "publish", "/x")],
    )
    assert [f"{sign} {each}" for sign, each in difference.lines()] == [
        "- /a ALLOW publish topic /x",
        "+ /a DENY publish topic /x",
        "+ /a ALLOW subscribe topic /x",
        "- /a ALLOW call action /z",
        "- /b ALLOW publish topic /y",
    ]


def test_only_what_is_in_scope_is_compared() -> None:
    assert not compare([right("/x"), right("/y", enclave="/b")], [right("/x")], frozenset({"/a"}))


def test_wildcards_of_the_other_side_are_told() -> None:
    wide = [right("/*", "request"), right("/*", "subscribe")]
    difference = compare([right("/f", "call"), right("/x")], wide)
    assert difference.covered == {right("/f", "call"): (wide[1], wide[0])}
    whole = right("/*", "call")
    assert compare([right(GOALS, "request")], [whole]).covered == {
        right(GOALS, "request"): (whole,)
    }
    denied = Right("/a", DENY, "subscribe", "/f/_action/*")
    assert compare([right("/f", "call")], [*wide, denied]).covered == {}


def test_a_right_without_its_other_side_is_named(tmp_path: Path) -> None:
    reader = {"/b": subscribe("/x", "/never"), "/recorder": subscribe("/*")}
    for name, topics in (("a.xml", ("/x",)), ("b.xml", ("/y",)), ("c.xml", ("/y", "/*"))):
        (tmp_path / name).write_text(policy_text({"/a": publish(*topics), **reader}))
    renamed = sros("diff_policy", "a.xml", "b.xml", cwd=tmp_path)
    lost = "! /b may subscribe /x, but no enclave may publish it any more"
    assert [line for line in renamed.out.splitlines() if line.startswith("!")] == [lost]
    assert renamed.status == 1
    widened = sros("diff_policy", "a.xml", "c.xml", cwd=tmp_path).out
    assert "!" not in widened, "the recorder only listens, and the wildcard of /a is new"
    denial = '<topics publish="DENY"><topic>/x</topic></topics>'
    (tmp_path / "d.xml").write_text(policy_text({"/a": publish("/x") + denial, **reader}))
    assert f"\n{lost}\n" in sros("diff_policy", "a.xml", "d.xml", cwd=tmp_path).out
    assert "!" not in sros("diff_policy", "d.xml", "b.xml", cwd=tmp_path).out
    for name, topic in (("e.xml", "/arm/state"), ("f.xml", "/arm/status")):
        (tmp_path / name).write_text(
            policy_text({"/a": publish(topic), "/b": subscribe("/*/state")})
        )
    lost = "! /b may subscribe /*/state, but no enclave may publish it any more"
    assert f"\n{lost}\n" in sros("diff_policy", "e.xml", "f.xml", cwd=tmp_path).out


def test_a_new_name_that_a_wildcard_of_another_enclave_allows_is_named(tmp_path: Path) -> None:
    """A package renames its motor command, and a winch may publish the new name already."""
    denial = '<topics publish="DENY"><topic>/winch_stop</topic></topics>'
    winch = {"/winch": publish("/winch_*") + denial, "/recorder": subscribe("/*")}
    for topic in ("motor", "winch_speed", "winch_stop"):
        rights = {"/motor": subscribe(f"/{topic}"), **winch}
        (tmp_path / f"{topic}.xml").write_text(policy_text(rights))
    warned = {
        topic: [
            line
            for line in sros("diff_policy", "motor.xml", f"{topic}.xml", cwd=tmp_path).out.split(
                "\n"
            )
            if line.startswith("!")
        ]
        for topic in ("winch_speed", "winch_stop")
    }
    line = "! /winch may publish /winch_speed, a new name, by a wildcard"
    assert warned == {"winch_speed": [line], "winch_stop": []}


def test_a_right_that_loses_its_last_user_is_named(tmp_path: Path) -> None:
    """Nobody hears an emergency stop any more; what every node offers needs no user."""
    services = "".join(f"<service>{name}</service>" for name in ("/a/set_parameters", "/grab"))
    offered = publish("/stop", "/rosout") + f'<services reply="ALLOW">{services}</services>'
    used = subscribe("/stop", "/rosout") + f'<services request="ALLOW">{services}</services>'
    for name, rights in (("a.xml", used), ("b.xml", publish("/x")), ("c.xml", subscribe("/*"))):
        (tmp_path / name).write_text(policy_text({"/a": offered, "/b": rights}))
    lost = [
        "! /a may reply /grab, but no enclave may request it any more",
        "! /a may publish /stop, but no enclave may subscribe to it any more",
    ]
    for name, expected in (("b.xml", lost), ("c.xml", lost[:1])):
        said = sros("diff_policy", "a.xml", name, cwd=tmp_path).out.splitlines()
        assert sorted(line for line in said if line.startswith("!")) == sorted(expected)


def test_an_example_is_a_name_of_the_policy(tmp_path: Path) -> None:
    driven = {"/b": subscribe("/f1/cmd_vel", "/f12/scan")}
    (tmp_path / "a.xml").write_text(policy_text(driven))
    (tmp_path / "b.xml").write_text(policy_text(driven | {"/a": publish("/f*/cmd_vel")}))
    ended = sros("diff_policy", "--no-new-access", "a.xml", "b.xml", cwd=tmp_path)
    assert "/a publish topic /f*/cmd_vel" in ended.out and "such as /f1/cmd_vel" in ended.out
