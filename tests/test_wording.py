"""Numbers and lists in words."""

from __future__ import annotations

import pytest

from sros_tool.wording import counted, enumerated, first_few, perhaps_meant, serial_text


@pytest.mark.parametrize(
    ("number", "words"), [(0, "0 topics"), (1, "1 topic"), (2, "2 topics"), (1000, "1000 topics")]
)
def test_a_number_has_its_noun(number: int, words: str) -> None:
    assert counted(number, "topic") == words


@pytest.mark.parametrize(
    ("serial", "text"), [(0, "00"), (10, "0a"), (0xABC, "0abc"), (0xABCD, "abcd"), (-10, "-0a")]
)
def test_a_serial_number_is_as_openssl_prints_it(serial: int, text: str) -> None:
    assert serial_text(serial) == text


def test_a_noun_has_its_own_plural() -> None:
    assert counted(1, "policy", "policies") == "1 policy"
    assert counted(2, "policy", "policies") == "2 policies"


@pytest.mark.parametrize(
    ("most", "words"), [(1, "a and 2 more"), (2, "a, b and 1 more"), (3, "a, b, c"), (9, "a, b, c")]
)
def test_what_is_left_out_is_counted(most: int, words: str) -> None:
    assert first_few(["a", "b", "c"], most) == words


def test_clauses_have_their_own_separators() -> None:
    assert first_few(["a", "b", "c"], 2, "; ", "; and ") == "a; b; and 1 more"
    assert first_few(["a", "b", "c"], 1, noun="name") == "a and 2 more names"


@pytest.mark.parametrize(
    ("texts", "words"), [(["a"], "a"), (["a", "b"], "a and b"), (["a", "b", "c"], "a, b and c")]
)
def test_a_list_ends_in_and(texts: list[str], words: str) -> None:
    assert enumerated(texts) == words


@pytest.mark.parametrize(("names", "words"), [("a", "the"), ("ab", "one of them is the")])
def test_a_hint_says_whether_it_is_about_one_name(names: str, words: str) -> None:
    assert perhaps_meant(names) == f"perhaps {words} right name"
