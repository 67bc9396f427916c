"""The grammar of names, their expansion, and what they are called in DDS."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool import names
from sros_tool.errors import InvalidNameError
from sros_tool.names import (
    check_enclave_name,
    check_namespace,
    dds_names,
    expand,
    expression_problem,
    is_expression,
    moves_robot,
)

ENCLAVE = re.compile(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+", re.ASCII)
token = st.from_regex(r"\A[A-Za-z_][A-Za-z0-9_]{0,5}\Z")
absolute = st.lists(token, min_size=1, max_size=4).map(lambda parts: "/" + "/".join(parts))
# Close to names, so that the borders of the grammar are met more often than by any text.
nearly = st.text(alphabet="aZ_09/~*?[]!-^:. \n\u200bé", max_size=8) | st.text(max_size=8)


@given(nearly | absolute)
def test_an_enclave_name_is_that_or_an_error(name: str) -> None:
    valid = ENCLAVE.fullmatch(name) is not None and len(name) <= 64
    if valid:
        assert check_enclave_name(name) == name
    else:
        with pytest.raises(InvalidNameError):
            check_enclave_name(name)


@given(nearly)
def test_any_text_is_judged(text: str) -> None:
    problem = expression_problem(text)
    assert problem == "" or problem.endswith(".")
    if not problem:
        assert re.fullmatch(r"[A-Za-z0-9_/~*?\[\]!-]+", text)
        assert not re.search(r"\s|//|/\Z|\[\^|\[:", text)
        assert is_expression(text) == any(letter in text for letter in "*?[")


@given(absolute)
def test_what_ros_has_is_accepted(name: str) -> None:
    assert expression_problem(name) == ""
    assert expression_problem(name[1:]) == ""
    assert expression_problem("~" + name) == ""
    assert fnmatchcase(name, name), "a plain name stands for itself alone"


@given(absolute, absolute | st.just("/"), token)
def test_expansion(name: str, ns: str, node: str) -> None:
    prefix = ns.rstrip("/")
    assert expand(name, ns, node) == name
    assert expand(name[1:], ns, node) == prefix + name
    assert expand("~" + name, ns, node) == f"{prefix}/{node}{name}"
    assert expand("~", ns, node) == f"{prefix}/{node}"
    assert "//" not in expand(name[1:], ns, node)


@pytest.mark.parametrize(
    ("given_ns", "ns"),
    [("", "/"), ("/", "/"), ("/a", "/a"), ("/a/", "/a"), ("/a/b", "/a/b"), ("/*", "/*")],
)
def test_namespaces(given_ns: str, ns: str) -> None:
    assert check_namespace(given_ns) == ns


@pytest.mark.parametrize(
    "ns", ["a", "//", "/a//", "/" + "a" * 245, "~", "~/a", "/a b", " /a", "/1", "/..", "/a\n"]
)
def test_no_namespaces(ns: str) -> None:
    with pytest.raises(InvalidNameError):
        check_namespace(ns)


@pytest.mark.parametrize(
    "name",
    ["[a]", "[a-c]", "[!a-c]x", "[abc]", "[a-c0-9]", "/[xy]/z", "~/[a-z]*", "?", "1*", "/a/*", "~"],
)
def test_wildcards_that_vendors_read_alike(name: str) -> None:
    assert expression_problem(name) == ""


@pytest.mark.parametrize(
    "name",
    [
        "[",
        "]",
        "a]",
        "[a",
        "[]",
        "[!]",
        "[!",
        "[]a]",
        "[^a]",
        "[[:digit:]]",
        "[:a:]",
        "[z-a]",
        "[9-0]",
        "[a-cz-x]",
        "[a b]",
        "[-a]",
        "[a-]",
        "[a--b]",
        "a!b",
        "a-b",
        "{a}",
        "a|b",
        "\\*",
    ],
)
def test_wildcards_that_are_refused(name: str) -> None:
    assert expression_problem(name)


# The table of ros2/sros2 (facts of the format), written out.
ACTION_REQUESTS = {
    f"rq/x/_action/{name}Request" for name in ("send_goal", "cancel_goal", "get_result")
}
ACTION_REPLIES = {
    f"rr/x/_action/{name}Reply" for name in ("send_goal", "cancel_goal", "get_result")
}
ACTION_TOPICS = {f"rt/x/_action/{name}" for name in ("feedback", "status")}
TABLE: dict[str, tuple[set[str], set[str]]] = {
    "publish": ({"rt/x"}, set()),
    "subscribe": (set(), {"rt/x"}),
    "request": ({"rq/xRequest"}, {"rr/xReply"}),
    "reply": ({"rr/xReply"}, {"rq/xRequest"}),
    "call": (ACTION_REQUESTS, ACTION_REPLIES | ACTION_TOPICS),
    "execute": (ACTION_REPLIES | ACTION_TOPICS, ACTION_REQUESTS),
}


@pytest.mark.parametrize("right", TABLE)
def test_names_in_dds(right: str) -> None:
    names = dds_names(right, "/x")
    assert (set(names.publish), set(names.subscribe)) == TABLE[right]
    assert len(names.publish) == len(set(names.publish))


def test_what_moves_a_robot_is_the_same_in_the_page() -> None:
    pattern = names._MOVES.pattern.replace("(^|/)", r"(^|\/)").replace(r"\Z", "$")
    table = Path(__file__).parent.parent / "web/src/table.js"
    assert f"const MOVES = /{pattern}/;\n" in table.read_text()
    assert moves_robot("/a/cmd_vel") and moves_robot("/arm/joint_commands")
    assert not moves_robot("/commands_seen") and not moves_robot("/my_cmd_vel")
