"""Columns: nothing overlaps, groups stay together, few lines cross."""

from __future__ import annotations

from itertools import combinations, pairwise

from hypothesis import given
from hypothesis import strategies as st

from sros_tool.report.layout import ColumnItem, _crossings, order_columns, place_column

ITEMS = st.lists(
    st.tuples(st.integers(20, 90), st.sampled_from("abc"), st.integers(-200, 900)), max_size=12
)


@given(ITEMS)
def test_items_keep_order_distance_and_the_top(
    drawn: list[tuple[int, str, int]],
) -> None:
    drawn.sort(key=lambda item: item[1])
    column = [ColumnItem(str(n), height, group) for n, (height, group, _) in enumerate(drawn)]
    wanted = {str(n): float(center) for n, (_, _, center) in enumerate(drawn)}
    tops = place_column(column, wanted, gap=10, top=30, lead=24)
    for before, after in pairwise(column):
        room = 10 + (24 if before.group != after.group else 0)
        assert tops[after.id] >= tops[before.id] + before.height + room - 1e-6
    assert all(top >= 30 - 1e-6 for top in tops.values())


def test_an_item_with_room_stands_where_it_is_wanted() -> None:
    column = [ColumnItem("a", 20), ColumnItem("b", 20)]
    tops = place_column(column, {"a": 100, "b": 300}, gap=10, top=0)
    assert tops == {"a": 90, "b": 290}


LINES = st.lists(
    st.one_of(
        st.tuples(st.integers(0, 5).map("l{}".format), st.integers(0, 7).map("m{}".format)),
        st.tuples(st.integers(0, 7).map("m{}".format), st.integers(0, 5).map("r{}".format)),
    ),
    unique=True,
    max_size=25,
)


@given(LINES)
def test_ordering_never_makes_more_crossings_and_counts_them_right(
    lines: list[tuple[str, str]],
) -> None:
    left, right = ([ColumnItem(f"{side}{n}", 20, "ab"[n % 2]) for n in range(6)] for side in "lr")
    left.sort(key=lambda item: item.group)
    right.sort(key=lambda item: item.group)
    middle = [ColumnItem(f"m{n}", 20) for n in range(8)]
    columns = order_columns([left, middle, right], lines)
    place = {item.id: number for column in columns for number, item in enumerate(column)}
    crossing = sum(
        (place[a] - place[c]) * (place[b] - place[d]) < 0
        for (a, b), (c, d) in combinations(lines, 2)
        if a[0] == c[0]
    )
    assert crossing == _crossings(columns, lines)
    assert crossing <= _crossings([left, middle, right], lines)
    for column in (columns[0], columns[2]):
        groups = [item.group for item in column]
        assert sum(one != other for one, other in pairwise(groups)) <= 1
