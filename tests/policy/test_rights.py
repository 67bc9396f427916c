"""Rights are compared as sets of absolute names; wildcards mean what DDS takes them for."""

from __future__ import annotations

from fnmatch import fnmatchcase
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.policy.model import ALLOW, DENY, Policy
from sros_tool.policy.patterns import covers, overlap
from sros_tool.policy.rights import (
    Right,
    Rules,
    compare,
    join_actions,
    parts,
    policy_rights,
    rights_without_counterpart,
    split_actions,
)
from sros_tool.translate import grant_rights
from tests.policy.drawn_policies import PATHS, effective, grant_of, policies

WORDS = [
    "/" + "".join(letters)
    for size in range(1, 5)
    for letters in product("ab/", repeat=size)
]  # fmt: skip
expressions = st.lists(
    st.sampled_from(["a", "b", "/", "*", "?", "[ab]", "[!a]", "[a-b]"]), min_size=1, max_size=5
).map(lambda pieces: "/" + "".join(pieces))


@pytest.mark.parametrize(
    ("wide", "narrow", "is_covered"),
    [
        ("/*", "/a", True),
        ("/*", "/a/b", True),
        ("/a", "/a", True),
        ("/a", "/*", False),
        ("/*", "/a*", True),
        ("/a*", "/*", False),
        ("/?", "/*", False),
        ("/*", "/?", True),
        ("/?", "/[ab]", True),
        ("/[ab]", "/?", False),
        ("/[a-c]", "/[ab]", True),
        ("/*a*", "/[ab]", False),
        ("/????", "/[ab]", False),
        ("/a*b*", "/a?xb*", True),
        ("/*", "rq/xRequest", False),
    ],
)
def test_covers(wide: str, narrow: str, is_covered: bool) -> None:
    assert covers(wide, narrow) is is_covered


@given(expressions, expressions)
def test_covering_and_overlapping_are_true_of_every_name(one: str, other: str) -> None:
    first = {word for word in WORDS if fnmatchcase(word, one)}
    second = {word for word in WORDS if fnmatchcase(word, other)}
    if covers(one, other):
        assert second <= first
    if first & second:
        assert overlap(one, other)
    assert overlap(one, other) == overlap(other, one)


@given(policies())
def test_permissions_tell_the_same_rights_as_their_policy(policy: Policy) -> None:
    for path in PATHS:
        own = {right for right in policy_rights(policy) if right.enclave == path}
        assert join_actions(grant_rights(path, grant_of(policy, path))) == join_actions(own)


@given(policies())
def test_folding_changes_no_right(policy: Policy) -> None:
    rights = policy_rights(policy)
    assert split_actions(join_actions(rights)) == split_actions(rights)
    assert join_actions(join_actions(rights)) == join_actions(rights)


@given(policies())
def test_rules_answer_as_dds_does(policy: Policy) -> None:
    rules = Rules(policy_rights(policy))
    for path in PATHS:
        for direction, topic in effective(policy, path):
            if topic.startswith("rt/"):
                assert rules.allow(path, direction, topic[2:])


def test_an_action_is_told_once() -> None:
    action = Right("/a", ALLOW, "call", "/fib")
    status = Right("/a", ALLOW, "subscribe", "/fib/_action/status")
    assert join_actions([action, status]) == {action}
    assert join_actions(parts(action)) == {action}
    assert join_actions(parts(action)[1:]) == frozenset(parts(action)[1:])


def test_a_denied_action_is_denied_by_its_parts() -> None:
    rules = Rules(
        [Right("/a", ALLOW, "call", "/*"), Right("/a", DENY, "request", "/fib/_action/send_goal")]
    )
    assert not rules.allow("/a", "call", "/fib")
    assert rules.allow("/a", "call", "/other")
    assert not rules.allow("/b", "call", "/other")


def test_what_is_denied_in_part_is_not_allowed() -> None:
    stated = ((ALLOW, "/arm/*"), (DENY, "/arm/stop"))
    rules = Rules([Right("/a", word, "publish", name) for word, name in stated])
    assert not rules.allow("/a", "publish", "/arm/*")
    assert not rules.allow("/a", "publish", "/arm/st*")
    assert rules.allow("/a", "publish", "/arm/move*")


@pytest.mark.parametrize(
    ("other_publisher", "is_wildcard_unanswered"), [("/arm/x", True), ("/base/x", False)]
)
def test_rights_whose_other_side_is_gone(
    other_publisher: str, is_wildcard_unanswered: bool
) -> None:
    """A denial waits for nobody, and a wildcard is answered by any name that it matches."""
    lost = Right("/base", ALLOW, "publish", "/base/odom")
    name = Right("/map", ALLOW, "subscribe", "/base/odom")
    wildcard = Right("/all", ALLOW, "subscribe", "/base/*")
    after = [
        Right("/other", ALLOW, "publish", other_publisher),
        name,
        wildcard,
        Right("/deaf", DENY, "subscribe", "/base/odom"),
    ]
    before = [lost, *after]
    unanswered = rights_without_counterpart(before, after, compare(before, after))
    assert unanswered == sorted([name, *([wildcard] if is_wildcard_unanswered else [])])


def test_a_new_denial_takes_nothing_from_a_wildcard_that_never_had_another_side() -> None:
    allowed = Right("/a", ALLOW, "publish", "/*motor_cmd")
    after = [allowed, Right("/b", DENY, "subscribe", "/*motor_cmd")]
    for before in ([allowed], [allowed._replace(qualifier=DENY)]):
        assert rights_without_counterpart(before, after, compare(before, after)) == []


def test_a_right_reads_as_people_say_it() -> None:
    assert str(Right("/a", ALLOW, "publish", "/x")) == "/a ALLOW publish topic /x"
    assert str(Right("/a", DENY, "call", "/x")) == "/a DENY call action /x"
    assert str(Right("/a", ALLOW, "publish", "raw")) == "/a ALLOW publish DDS topic raw"
