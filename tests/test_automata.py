"""Sets of names against brute force over all short names, with wildcards of each kind."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool import automata
from sros_tool.automata import ANY_LETTER, Automaton, Letters, NameSet, SearchLimit
from sros_tool.dds.decision.expressions import matches, names_of
from sros_tool.dds.decision.vendors import Style
from sros_tool.errors import DocumentError
from sros_tool.zenoh.key_expressions import expression_problem, includes
from sros_tool.zenoh.key_expressions import names_of as keys_of

Right = Callable[[str], bool]
Drawn = tuple[NameSet, Right]
"""A set, and whether a name belongs there."""

DDS_NAMES = ["".join(letters) for n in range(5) for letters in product("ab-]/", repeat=n)]
DDS_PIECES = [*"ab/*?", "*", "[ab]", "[!a]", "[a-b]", "[!-a]", "[]a]", "[^b]", "[[:alpha:]]"]
EXPRESSIONS = st.lists(st.sampled_from(DDS_PIECES), min_size=1, max_size=4).map("".join)
KEYS = [
    "/".join(chunks)
    for n in range(1, 4)
    for chunks in product(["a", "b", "ab", "@a", "a@", "ba"], repeat=n)
]
KEY_EXPRESSIONS = (
    st.lists(
        st.sampled_from(["a", "b", "@a", "*", "**", "$*a", "a$*", "a$*b", "$*@", "$*b$*", "@$*"]),
        min_size=1,
        max_size=4,
    )
    .map("/".join)
    .filter(lambda text: not expression_problem(text))
)


def one_of(style: Style, some: list[str]) -> Drawn:
    return names_of(style, some), lambda name: any(matches(style, each, name) for each in some)


def in_order(rules: list[tuple[Drawn, bool]], otherwise: bool) -> Drawn:
    def right(name: str) -> bool:
        return next((kept for (_, has), kept in rules if has(name)), otherwise)

    return NameSet.first(((names, kept) for (names, _), kept in rules), otherwise), right


def drawn(leaves: st.SearchStrategy[Drawn]) -> st.SearchStrategy[Drawn]:
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.tuples(inner, inner).map(lambda two: (two[0][0] | two[1][0], either(*two))),
            st.tuples(inner, inner).map(lambda two: (two[0][0] & two[1][0], both(*two))),
            st.tuples(inner, inner).map(lambda two: (two[0][0] - two[1][0], only(*two))),
            inner.map(lambda one: (~one[0], lambda name: not one[1](name))),
            st.tuples(st.lists(st.tuples(inner, st.booleans()), max_size=4), st.booleans()).map(
                lambda made: in_order(*made)
            ),
        ),
        max_leaves=5,
    )


def either(one: Drawn, other: Drawn) -> Right:
    return lambda name: one[1](name) or other[1](name)


def both(one: Drawn, other: Drawn) -> Right:
    return lambda name: one[1](name) and other[1](name)


def only(one: Drawn, other: Drawn) -> Right:
    return lambda name: one[1](name) and not other[1](name)


def leaves_of(style: Style) -> st.SearchStrategy[Drawn]:
    return st.lists(EXPRESSIONS, max_size=3).map(lambda some: one_of(style, some))


def check(names: NameSet, right: Right, every: list[str]) -> None:
    inside = [name for name in every if right(name)]
    assert [name for name in every if name in names] == inside
    found = names.example()
    assert names.is_empty() is (found is None)
    if found is None:
        assert not inside
    else:
        assert found in names
        assert right(found)
        if found not in names.stated() and inside:
            assert len(found) <= min(map(len, inside))


@pytest.mark.parametrize("style", Style)
def test_wildcards_of_dds_against_every_short_name(style: Style) -> None:
    @given(drawn(leaves_of(style)))
    def tried(one: Drawn) -> None:
        check(*one, DDS_NAMES)

    tried()


def test_wildcards_of_zenoh_against_every_short_key() -> None:
    @given(
        st.lists(KEY_EXPRESSIONS, min_size=1, max_size=3),
        st.lists(KEY_EXPRESSIONS, max_size=3),
    )
    def tried(some: list[str], others: list[str]) -> None:
        def right(key: str) -> bool:
            return any(includes(each, key) for each in some) and not any(
                includes(each, key) for each in others
            )

        names = keys_of(some) - keys_of(others)
        assert [key for key in KEYS if key in names] == [key for key in KEYS if right(key)]
        found = names.example()
        assert (found is not None) if any(map(right, KEYS)) else (found is None or right(found))
        if found is not None:
            assert right(found)
            assert not expression_problem(found) or "*" not in found

    tried()


def test_a_name_that_was_given_comes_before_shorter_ones() -> None:
    names = names_of(Style.FNMATCH, ["rt/*", "rt/chatter", "rt/cmd_vel"])
    assert names.example() == "rt/chatter"
    assert (names - NameSet(["rt/chatter", "rt/cmd_vel"])).example() == "rt/"


def test_a_name_that_nobody_has_stated_is_found() -> None:
    wide, narrow = (names_of(Style.CYCLONE, [each]) for each in ("rt/arm_*", "rt/arm_[a-z]*"))
    assert (wide - narrow).example() == "rt/arm_"
    assert (wide - narrow - NameSet(["rt/arm_"])).example() == "rt/arm_A"
    assert (narrow - wide).is_empty()
    assert not (wide - narrow).is_empty()


def test_many_exact_names_may_be_missing_in_a_wildcard() -> None:
    missing = ["".join(each) for n in range(4) for each in product("ab/_", repeat=n)]
    names = names_of(Style.FNMATCH, ["*"]) - NameSet(missing)
    assert names.example() == "c"
    few = NameSet([], [Automaton.sequence([Letters.of("ab")] * 3)]) - NameSet(missing)
    assert few.is_empty()


def test_the_length_of_names_counts_in_bytes() -> None:
    names = NameSet([], [Automaton.sequence([Letters.of("äö"), ANY_LETTER])])
    assert names.example() == "äa"
    assert names.example(longest=3) == "äa"
    assert names.example(longest=2) is None
    assert NameSet(["ää"]).example(longest=3) is None


def test_a_set_that_takes_too_many_steps_is_refused() -> None:
    wide = names_of(Style.FNMATCH, ["*[ab]" + "?" * 20])
    both = names_of(Style.FNMATCH, ["*a" + "?" * 20, "*b" + "?" * 20])
    with pytest.raises(DocumentError, match="too many wildcards"):
        (wide - both).example(SearchLimit(50_000))


def test_ten_thousand_names_take_no_search() -> None:
    many = [f"rt/robot_{number}/x" for number in range(10_000)]
    limit = SearchLimit(0)
    one, other = NameSet(many), NameSet(many[:-1])
    assert (other - one).is_empty(limit)
    assert (one - other).example(limit) == many[-1]
    wide = NameSet([*many, "rt/q"]) | names_of(Style.FNMATCH, ["rt/robot_*"])
    assert (one - wide).is_empty(limit)
    assert (wide & one & other).example(limit) == many[0]


def test_equal_wildcards_take_no_search() -> None:
    wild = [f"rt/{number}*x*?" for number in range(40)]
    names = names_of(Style.FNMATCH, wild) - names_of(Style.FNMATCH, [*wild, "rt/y*"])
    assert names.is_empty(SearchLimit(2 * len(wild)))  # to compare each with the others


def test_looking_at_thousands_of_wildcards_counts() -> None:
    wild = names_of(Style.FNMATCH, [f"rt/*x{i}" for i in range(900)])
    none = names_of(Style.FNMATCH, ["rt/y?"])
    with pytest.raises(DocumentError, match="too many wildcards"):
        (none - wild).is_empty(SearchLimit(50))
    many = names_of(Style.FNMATCH, [f"rt/x{i}*" for i in range(9000)])
    with pytest.raises(DocumentError, match="too many wildcards"):
        (none - many).is_empty()


def test_wildcards_with_other_beginnings_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A set that has thousands of them, below all names, is searched for each of them alone."""
    sizes: list[int] = []
    machine = automata._ParallelAutomata

    def counted(some: tuple[automata.Automaton, ...]) -> automata._ParallelAutomata:
        sizes.append(len(some))
        return machine(some)

    monkeypatch.setattr(automata, "_machine", counted)
    expressions = [f"rt/t{i}/*" for i in range(200)]
    for everything in ("*", "?*"):
        allowed = names_of(Style.FNMATCH, [everything]) & names_of(Style.FNMATCH, expressions)
        own = allowed & names_of(Style.FNMATCH, ["rt/t7/*"])
        assert own.example() == "rt/t7/"
        assert (allowed - names_of(Style.FNMATCH, expressions)).is_empty()
    assert max(sizes) <= 2
