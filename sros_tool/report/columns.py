"""Places things in columns: an order with few crossings of lines, and heights without overlap.

A layered layout of three layers, after Sugiyama: the order of each column follows the barycentre
of its neighbours, and the heights are those nearest to them that leave everybody's room (found by
pooling adjacent violators).  It depends on nothing but its input.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

_SWEEPS = 24


@dataclass(frozen=True, slots=True)
class Item:
    """Something of a ``height`` in a column; items of one ``group`` stand together."""

    id: str
    height: float
    group: str = ""


def ordered(
    left: Sequence[Item],
    middle: Sequence[Item],
    right: Sequence[Item],
    lines: Sequence[tuple[str, str]],
) -> tuple[list[Item], list[Item], list[Item]]:
    """The items of the three columns in an order with few crossings.

    ``lines`` are pairs of ids, each of neighbouring columns.  Of all sweeps the best is kept.
    """
    near: dict[str, list[str]] = {item.id: [] for item in (*left, *middle, *right)}
    for one, other in lines:
        near[one].append(other)
        near[other].append(one)
    columns = [list(left), list(middle), list(right)]
    best, fewest = [list(column) for column in columns], _crossings(columns, lines)
    for sweep in range(_SWEEPS):
        outer = (0, 2) if sweep % 2 else (2, 0)
        for moved in (1, *outer):
            places = _places(columns)
            columns[moved] = _by_barycentre(columns[moved], near, places)
        crossings = _crossings(columns, lines)
        if crossings < fewest:
            best, fewest = [list(column) for column in columns], crossings
    return best[0], best[1], best[2]


def _places(columns: Sequence[Sequence[Item]]) -> dict[str, float]:
    """Where each item stands in its column, from 0 to 1."""
    return {
        item.id: (number + 0.5) / len(column)
        for column in columns
        for number, item in enumerate(column)
    }


def _by_barycentre(
    column: Sequence[Item], near: Mapping[str, Sequence[str]], places: Mapping[str, float]
) -> list[Item]:
    centre = {
        item.id: (
            sum(places[each] for each in near[item.id]) / len(near[item.id])
            if near[item.id]
            else places[item.id]
        )
        for item in column
    }
    groups: dict[str, list[float]] = {}
    for item in column:
        groups.setdefault(item.group, []).append(centre[item.id])
    middle = {group: sum(found) / len(found) for group, found in groups.items()}
    return sorted(
        column, key=lambda item: (middle[item.group], item.group, centre[item.id], item.id)
    )


def _crossings(columns: Sequence[Sequence[Item]], lines: Sequence[tuple[str, str]]) -> int:
    """How often lines cross, counted between each pair of neighbouring columns."""
    side = {item.id: number for number, column in enumerate(columns) for item in column}
    place = {item.id: n for column in columns for n, item in enumerate(column)}
    total = 0
    for first in (0, 1):
        pairs = []
        for one, other in lines:
            if side[one] > side[other]:
                one, other = other, one
            if side[one] == first:
                pairs.append((place[one], place[other]))
        total += _inversions([end for _, end in sorted(pairs)], len(columns[first + 1]))
    return total


def _inversions(ends: Sequence[int], size: int) -> int:
    """How many pairs stand the wrong way round, by a Fenwick tree."""
    tree = [0] * (size + 1)
    found = 0
    for seen, end in enumerate(ends):
        at, before = end + 1, 0
        while at:
            before += tree[at]
            at -= at & -at
        found += seen - before
        at = end + 1
        while at <= size:
            tree[at] += 1
            at += at & -at
    return found


def heights(
    column: Sequence[Item], wanted: Mapping[str, float], gap: float, top: float, lead: float = 0
) -> dict[str, float]:
    """The upper edge of each item: near to what is ``wanted`` for its centre, and without overlap.

    Items keep their order and stand ``gap`` apart, none above ``top``; the first of each group
    has ``lead`` more room above it.
    """
    offsets, at, group = [], 0.0, None
    for item in column:
        at += lead if item.group != group else 0
        group = item.group
        offsets.append(at)
        at += item.height + gap
    # Without the offsets it is least squares under "each not above the one before".
    blocks: list[list[float]] = []
    for item, offset in zip(column, offsets, strict=True):
        target = wanted.get(item.id, 0.0) - item.height / 2 - offset
        blocks.append([max(target, top), 1])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            mean, count = blocks.pop()
            before = blocks[-1]
            before[0] = (before[0] * before[1] + mean * count) / (before[1] + count)
            before[1] += count
    shifts = [mean for mean, count in blocks for _ in range(int(count))]
    return {
        item.id: shift + offset for item, offset, shift in zip(column, offsets, shifts, strict=True)
    }
