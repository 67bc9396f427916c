"""Wildcards against the very functions that the vendors call: glibc's, and Cyclone DDS' own."""

from __future__ import annotations

import ctypes
import platform
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sros_tool.automata import Letters
from sros_tool.dds.decision import expressions as vendor_expressions
from sros_tool.dds.decision.expressions import ExpressionIndex, matches
from sros_tool.dds.decision.vendors import Style
from tests.support.children import LONG

NOESCAPE = 2  # <fnmatch.h> of glibc
PIECES = [*"abx]-[!^*?1:/", "[a-c]", "[!a]", "[^a]", "[[:digit:]]", "[[:alpha:]", "[[:foo:]]"]
expressions = st.lists(st.sampled_from(PIECES), min_size=1, max_size=6).map("".join)
names = st.text(alphabet="abx]-[!^1/", max_size=5)


def fnmatch(expression: str, name: str) -> bool:
    return bool(ctypes.CDLL(None).fnmatch(expression.encode(), name.encode(), NOESCAPE) == 0)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="Fast DDS asks the C library")
@settings(max_examples=5000 if LONG else 60)
@given(expressions, names)
@example("rt/[^a-c]", "rt/x")
@example("[[:digit:]]", "1")
@example("[a", "[a")
@example("[]a]", "]")
@example("[a-]", "-")
@example("[x[:foo:]]", "x")
def test_fnmatch_is_that_of_glibc(expression: str, name: str) -> None:
    assert matches(Style.FNMATCH, expression, name) == fnmatch(expression, name)


@pytest.fixture(scope="module")
def cyclone() -> ctypes.CDLL:
    plugins = sorted(Path("/usr/lib").glob("*/libddsc0*/libdds_security_ac.so"))
    if not plugins:
        pytest.skip("Cyclone DDS with its security plugins is not installed")
    library = ctypes.CDLL(str(plugins[0]))
    library.ac_fnmatch.restype = ctypes.c_bool
    return library


@settings(max_examples=5000 if LONG else 60)
@given(expressions, names)
@example("rt/[ab]-x", "rt/q")
@example("[ab]", "]")
@example("[]", "]")
@example("[!]", "a]")
@example("[a-]", "a")
def test_cyclone_matches_as_its_plugin(cyclone: ctypes.CDLL, expression: str, name: str) -> None:
    expected = cyclone.ac_fnmatch(expression.encode(), name.encode())
    assert matches(Style.CYCLONE, expression, name) == expected


@given(st.lists(expressions, max_size=8), names)
def test_positions_are_those_of_one_after_the_other(texts: list[str], name: str) -> None:
    found = list(ExpressionIndex(Style.FNMATCH, texts).matching(name))
    assert found == [i for i, text in enumerate(texts) if matches(Style.FNMATCH, text, name)]


def test_both_ways_takes_the_name_for_an_expression_too() -> None:
    assert ExpressionIndex(Style.FNMATCH, ["rt/open"], both_ways=True).first("rt/o*") == 0
    assert ExpressionIndex(Style.FNMATCH, ["rt/open"]).first("rt/o*") is None


@pytest.mark.parametrize("part", ["[", "[-a", "[a", "[!a", "[]", "[a-", "[[:x:]"])
def test_many_unclosed_sets_take_linear_time(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A permissions document of a few kilobytes took half a minute."""
    read = 0

    def counted(text: str, index: int) -> tuple[Letters | None, bool, int]:
        nonlocal read
        read += 1
        return token(text, index)

    token = vendor_expressions._token
    monkeypatch.setattr(vendor_expressions, "_token", counted)
    expression = part * 1000 + "[=]=]"
    assert matches(Style.FNMATCH, expression, expression) in (True, False)
    assert 0 < read < 4 * len(expression)
