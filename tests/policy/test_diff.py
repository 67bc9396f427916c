"""Two policies differ just if DDS would be told something else."""

from __future__ import annotations

from hypothesis import given

from sros_tool.policy.model import ALLOW, DENY, Policy
from sros_tool.policy.rights import Right, Rules, compare, policy_rights
from tests.policy.drawn_policies import PATHS, listed, policies


def right(name: str, word: str = "publish", enclave: str = "/a") -> Right:
    return Right(enclave, ALLOW, word, name)


@given(policies(), policies())
def test_empty_just_if_the_permissions_list_the_same(first: Policy, second: Policy) -> None:
    same = all(
        listed(first, path, allow=allow) == listed(second, path, allow=allow)
        for path in PATHS
        for allow in (True, False)
    )
    assert bool(compare(policy_rights(first), policy_rights(second))) is not same


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
