"""Places a scene: draws up its cards, orders and places them, and ties them by links."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace

from sros_tool.policy.model import ALLOW, Qualifier
from sros_tool.report.columns import Item, heights, ordered
from sros_tool.report.fold import Bundle, Tie, coarsened, fold
from sros_tool.report.picture import SENDS, Edge, Mark, Picture
from sros_tool.report.scene import (
    GUTTER,
    LINE,
    NAMES_WIDTH,
    PAD,
    SIDE_WIDTH,
    SMALL,
    Card,
    Frame,
    Link,
    Onlooker,
    Scene,
)
from sros_tool.report.wording import COMMON, REACHES, counted, names_title, own_text, wrapped

_GAP, _LEAD, _TOP, _MARGIN = 9.0, 24.0, 34.0, 14
_SIDE_LETTERS, _NAMES_LETTERS = 20, 35
_LEAST_LINES, _MOST_LINES, _MOST_ONLOOKERS = 8, 0.3, 26
_FEW_BUNDLES, _MOST_BUNDLES = 24, 80


class Placing:
    """Places one scene: draws up its cards, orders and places them, and ties them.

    ``members`` are the enclaves behind each node of the scene, ``everybody`` the nodes that have
    any right to a name, drawn or not.
    """

    def __init__(
        self,
        picture: Picture,
        edges: Sequence[Edge],
        owner: Callable[[str], str],
        members: Mapping[str, Sequence[str]],
        everybody: Mapping[tuple[str, str], Set[str]],
    ) -> None:
        self._members = members
        self._everybody = everybody
        self._groups = {each.path: each.group for each in picture.enclaves}
        self._unseen = {each.path for each in picture.enclaves if not each.observed}
        bundles = fold(picture.names, edges, owner)
        self._looking = _onlookers(bundles)
        self._tags = {side: chr(ord("A") + n) for n, side in enumerate(self._looking)}
        self._own: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
        self._bundles: list[Bundle] = []
        for bundle in bundles:
            alone = self._alone(bundle) if len(bundles) > _FEW_BUNDLES else ""
            if alone:
                self._own[alone][bundle.kind] += len(bundle.names)
            else:
                self._bundles.append(bundle)
        if len(self._bundles) > _MOST_BUNDLES:
            self._bundles = list(coarsened(self._bundles))
        self._ties: dict[tuple[str, str, Qualifier, bool, Mark], set[str]] = defaultdict(set)
        for number, bundle in enumerate(self._bundles):
            for tie in bundle.ties:
                if not self._looks(tie):
                    side, names = f"{'s' if tie.sends else 'l'}{tie.node}", f"n{number}"
                    ends = (side, names) if tie.sends else (names, side)
                    self._ties[(*ends, tie.qualifier, bool(tie.by), tie.mark)].add(tie.right)

    def _looks(self, tie: Tie) -> bool:
        """Whether the tie is told by a letter, and not by a line."""
        plain = tie.qualifier is ALLOW and tie.mark is Mark.BOTH
        return plain and (tie.node, tie.right) in self._looking

    def _alone(self, bundle: Bundle) -> str:
        """The only node that has to do with these names, onlookers aside; "" if there are more."""
        looking = {tie.node for tie in bundle.ties if self._looks(tie)}
        told = {tie.node for tie in bundle.ties if not self._looks(tie)}
        if any(tie.qualifier is not ALLOW or tie.mark is not Mark.BOTH for tie in bundle.ties):
            return ""
        nodes = {each for name in bundle.names for each in self._everybody[bundle.kind, name]}
        nodes -= looking - told
        return nodes.pop() if len(nodes) == 1 else ""

    def scene(self, name: str, title: str) -> Scene:
        """The scene, without its count of names."""
        cards = {card.id: card for card in self._cards()}
        columns: list[list[Item]] = [[], [], []]
        for card in cards.values():
            columns[card.column].append(Item(card.id, card.height, card.group))
        lines = sorted({ends[:2] for ends in self._ties})
        placed = ordered(columns[0], columns[1], columns[2], lines)
        tops = _tops(placed, lines)
        cards = {key: replace(card, y=round(tops[key])) for key, card in cards.items()}
        bottom = max((card.y + card.height for card in cards.values()), default=0)
        return Scene(
            id=name,
            title=title,
            width=2 * (_MARGIN + SIDE_WIDTH + GUTTER) + NAMES_WIDTH,
            height=bottom + _MARGIN,
            cards=tuple(cards[item.id] for column in placed for item in column),
            links=self._links(cards),
            frames=tuple(_frames(placed, cards)),
            onlookers=tuple(
                Onlooker(tag, node, right) for (node, right), tag in self._tags.items()
            ),
        )

    # ── cards ──────────────────────────────────────────────────────────────────────────────

    def _cards(self) -> Iterable[Card]:
        sides = {end for key in self._ties for end in key[:2] if end[0] in "sl"}
        sides |= {f"{'s' if SENDS[right] else 'l'}{node}" for node, right in self._looking}
        # Of a group, all enclaves are shown; of its surroundings, only who has to do with it.
        inner = {node for node in self._members if not node.startswith(":")}
        idle = (inner or set(self._members)) - {side[1:] for side in sides}
        sides |= {f"s{node}" for node in idle}
        for side in sorted(sides):
            first = side[0] == "s" or f"s{side[1:]}" not in sides
            yield self._side_card(side, first=first)
        for number, bundle in enumerate(self._bundles):
            yield self._names_card(number, bundle)

    def _side_card(self, side: str, *, first: bool) -> Card:
        """An enclave or group on one side; what it has alone is told on the ``first`` only."""
        node, sends = side[1:], side[0] == "s"
        members = tuple(self._members[node])
        is_group = node.startswith(":")
        notes = [counted(len(members), "enclave")] if is_group else []
        if is_group:
            label = node[1:]
        else:
            group = self._groups[node].rstrip("/") + "/"
            label = node.removeprefix(group) or node
        if first and (own := self._own.get(node)):
            notes += own_text(own)
        notes += ["never observed"] if node in self._unseen else []
        notes += [
            f"{reach} {counted(self._looking[node, right], 'name')}: see {tag}"
            for (other, right), tag in self._tags.items()
            for reach in (REACHES[right],)
            if other == node and SENDS[right] is sends
        ]
        lines = wrapped(label, _SIDE_LETTERS)
        return Card(
            id=side,
            role="group" if is_group else "enclave",
            column=0 if sends else 2,
            x=_MARGIN if sends else _MARGIN + SIDE_WIDTH + NAMES_WIDTH + 2 * GUTTER,
            y=0,
            width=SIDE_WIDTH,
            height=2 * PAD + LINE * len(lines) + SMALL * len(notes),
            lines=lines,
            notes=tuple(notes),
            members=members,
            group="" if is_group else self._groups[node],
        )

    def _names_card(self, number: int, bundle: Bundle) -> Card:
        titles, notes = names_title(bundle)
        lines = tuple(line for title in titles for line in wrapped(title, _NAMES_LETTERS))
        drawn = {tie.node for tie in bundle.ties}
        if len(self._everybody[bundle.kind, bundle.names[0]] - drawn):
            notes = (*notes, COMMON[bundle.kind])
        tags = "".join(
            sorted({self._tags[tie.node, tie.right] for tie in bundle.ties if self._looks(tie)})
        )
        return Card(
            id=f"n{number}",
            role="names",
            column=1,
            x=_MARGIN + SIDE_WIDTH + GUTTER,
            y=0,
            width=NAMES_WIDTH,
            height=2 * PAD + LINE * len(lines) + SMALL * len(notes),
            lines=lines,
            notes=notes,
            members=bundle.names,
            kind=bundle.kind,
            level=bundle.protection.level,
            tags=tags,
        )

    # ── links ──────────────────────────────────────────────────────────────────────────────

    def _links(self, cards: dict[str, Card]) -> tuple[Link, ...]:
        """Links with their ends spread over the edges of the cards, so that they do not meet."""
        keys = sorted(self._ties)
        ports: dict[tuple[str, bool], list[tuple[float, int]]] = defaultdict(list)
        for number, (source, target, *_) in enumerate(keys):
            for here, there, out in ((source, target, True), (target, source, False)):
                ports[here, out].append((cards[there].y + cards[there].height / 2, number))
        where: dict[tuple[int, bool], int] = {}
        for (card, out), found in ports.items():
            box = cards[card]
            step = min(14.0, (box.height - 2 * PAD) / max(1, len(found) - 1))
            first = box.y + box.height / 2 - step * (len(found) - 1) / 2
            for place, (_, number) in enumerate(sorted(found)):
                where[number, out] = round(first + place * step)
        return tuple(
            Link(
                source,
                target,
                where[number, True],
                where[number, False],
                tuple(sorted(self._ties[key])),
                qualifier,
                (cards[source] if cards[source].role == "names" else cards[target]).level,
                wildcard,
                mark,
            )
            for number, key in enumerate(keys)
            for source, target, qualifier, wildcard, mark in (key,)
        )


def _onlookers(bundles: Sequence[Bundle]) -> dict[tuple[str, str], int]:
    """Who reaches so much by wildcards that its lines would hide all others, and how many names.

    By node and right, such as ("/recorder", "subscribe").
    """
    reached: dict[tuple[str, str], list[Bundle]] = defaultdict(list)
    wild: dict[tuple[str, str], int] = defaultdict(int)
    for bundle in bundles:
        ties = {(tie.node, tie.right): tie.by for tie in bundle.ties if tie.qualifier is ALLOW}
        for key, by in ties.items():
            reached[key].append(bundle)
            wild[key] += bool(by)
    most = max(_LEAST_LINES, _MOST_LINES * len(bundles))
    looking = [
        (key, sum(len(bundle.names) for bundle in found))
        for key, found in sorted(reached.items())
        if len(found) > most and 2 * wild[key] > len(found)
    ]
    return dict(looking[:_MOST_ONLOOKERS])  # there are no more letters


def _tops(columns: Sequence[Sequence[Item]], lines: Sequence[tuple[str, str]]) -> dict[str, float]:
    """The upper edges of all cards: the tallest column stands close, the others beside it."""
    extent = [_extent(column) for column in columns]
    tallest = max(range(3), key=lambda number: (extent[number], number == 1))
    tops = heights(columns[tallest], {}, _GAP, _TOP, _LEAD if tallest != 1 else 0)
    height = {item.id: item.height for column in columns for item in column}
    order = {1: (0, 2), 0: (1, 2), 2: (1, 0)}[tallest]
    for number in order:
        wanted = {}
        for item in columns[number]:
            ends = [b if a == item.id else a for a, b in lines if item.id in (a, b)]
            centres = [tops[end] + height[end] / 2 for end in ends if end in tops]
            wanted[item.id] = sum(centres) / len(centres) if centres else extent[tallest]
        tops |= heights(columns[number], wanted, _GAP, _TOP, _LEAD if number != 1 else 0)
    return tops


def _extent(column: Sequence[Item]) -> float:
    groups = len({item.group for item in column})
    return sum(item.height + _GAP for item in column) + _LEAD * groups


def _frames(columns: Sequence[Sequence[Item]], cards: dict[str, Card]) -> Iterable[Frame]:
    for column in (columns[0], columns[2]):
        groups: dict[str, list[Card]] = defaultdict(list)
        for item in column:
            groups[item.group].append(cards[item.id])
        for title, found in groups.items():
            if all(card.role == "group" for card in found):
                continue
            top, bottom = found[0].y - 24, found[-1].y + found[-1].height + 6
            yield Frame(title, found[0].x - 6, top, SIDE_WIDTH + 12, bottom - top)
