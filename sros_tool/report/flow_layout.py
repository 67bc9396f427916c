"""The layout of a picture with a focus: a column for each hop, and names between two columns.

Information goes from left to right: names in the focus have the enclaves that may send to the left
of them, and those that may receive to the right.  Enclaves further away than the hops that are
drawn share one card.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import accumulate
from typing import NamedTuple

from sros_tool.policy.model import ALLOW, Qualifier
from sros_tool.report.focus import ENCLAVE, FocusFlow
from sros_tool.report.layout import (
    LISTENERS,
    MARGIN,
    SENDERS,
    SIDE_LETTERS,
    Card,
    Head,
    Link,
    Scene,
    bottom_of,
    enclave_notes,
    frames_of,
    height_of,
    linked,
    names_card,
    stacked,
    wrapped,
)
from sros_tool.report.picture import (
    Bundle,
    Edge,
    OverlaySide,
    Picture,
    Tie,
    WireLevel,
    coarsened,
    fold,
)
from sros_tool.wording import counted

HOPS = 2
"""The hops that are drawn unless a number is chosen."""
_MOST_ENCLAVES = 24  # with more in a column, groups are drawn; with as many groups, one card
_MOST_BUNDLES = 40  # with more at one stage, names with the same senders are joined
_GUTTER, _LETTER, _SMALL_LETTER = 76, 7.4, 6.2
_ROOM = {"names": 66, "enclave": 24, "group": 24}
"""The space on a card beside its text, in pixels."""


def flow_scene(picture: Picture, hops: int = HOPS, *, placed: bool = True) -> Scene:
    """Return the scene of a picture with a focus; without ``placed``, no y and no frames.

    Args:
        picture: a picture with a focus.
        hops: how far enclaves are drawn on both sides, from 1.
        placed: for formats that place cards themselves: without y and frames.
    """
    draft = _Draft(picture, FocusFlow.of(picture), hops)
    cards = draft.in_columns()
    links = draft.links(cards)
    names = {name for card in cards.values() if card.kind for name in card.members}
    scene = Scene(
        id="focus",
        title=", ".join(dict.fromkeys(each.name for each in picture.focus)),
        width=max((card.x + card.width for card in cards.values()), default=200) + MARGIN,
        height=0,
        cards=tuple(cards.values()),
        links=tuple(links),
        frames=(),
        onlookers=(),
        heads=tuple(draft.heads(cards)),
        shown=len(names),
    )
    if not placed:
        return scene
    cards = stacked(
        cards.values(), sorted({(link.source, link.target) for link in links}), draft.columns
    )
    return replace(
        scene,
        height=bottom_of(cards.values()),
        cards=tuple(cards.values()),
        links=linked(cards, links),
        frames=tuple(frames_of(cards.values())),
    )


class _Stage(NamedTuple):
    """Bundles of names in ``column``, with the ties of each to the left and to the right."""

    column: int
    bundles: tuple[tuple[Bundle, tuple[Tie, ...], tuple[Tie, ...]], ...]


class _Draft:
    """The builder of a scene with a focus."""

    def __init__(self, picture: Picture, flow: FocusFlow, hops: int) -> None:
        self._picture, self._flow, self._hops = picture, flow, hops
        self._groups = {enclave.path: enclave.group for enclave in picture.enclaves}
        self._further = tuple(
            tuple(sorted(path for path, far in side.items() if far > hops))
            for side in (flow.before, flow.after)
        )
        self._left = min(hops, max(flow.before.values(), default=1))
        self._right = min(hops, max(flow.after.values(), default=1))
        self._first = 2 if self._further[0] else 0
        self.columns = self._column_of(True, 1) + 2 * self._right + 1
        self.columns += 2 if self._further[1] else 0
        self._nodes = self._folded()
        self._stages = [self._stage(each) for each in range(1 - self._right, self._left)]

    def _column_of(self, before: bool, hop: int) -> int:
        middle = self._first + 2 * self._left - 1
        return middle + (1 - 2 * hop if before else 2 * hop - 1)

    def _folded(self) -> Mapping[tuple[bool, str], str]:
        """Map each drawn enclave, before or after the focus, to the node that represents it."""
        found = {}
        for before, side in ((True, self._flow.before), (False, self._flow.after)):
            columns: dict[int, list[str]] = defaultdict(list)
            for path, hop in side.items():
                if hop <= self._hops:
                    columns[hop].append(path)
            for hop, paths in columns.items():
                groups = {self._groups[path] for path in paths}
                for path in paths:
                    node = path
                    if len(paths) > _MOST_ENCLAVES:
                        whole = len(groups) > _MOST_ENCLAVES
                        node = f":{hop}" if whole else f":{hop} {self._groups[path]}"
                    found[before, path] = node
        return found

    def _stage(self, stage: int) -> _Stage:
        edges: tuple[list[Edge], list[Edge]] = ([], [])
        for edge in self._picture.edges:
            for side, fits in enumerate(self._flow.ends(edge, stage)):
                if fits:
                    edges[side].append(edge)
        # The mark of a side is in the name of the node, so that both fold together.
        sides = [
            [replace(e, enclave=f"{'lr'[n]}{self._node(n, stage, e.enclave)}") for e in found]
            for n, found in enumerate(edges)
        ]
        used = [{(each.kind, each.name) for each in side} for side in sides]
        both = used[0] | used[1] if stage == 0 else used[0] & used[1]
        kept = [each for side in sides for each in side if (each.kind, each.name) in both]
        bundles: Iterable[Bundle] = fold(self._picture.names, kept)
        bundles = coarsened(bundles) if len(tuple(bundles)) > _MOST_BUNDLES else bundles
        middle = self._first + 2 * self._left - 1
        return _Stage(
            middle - 2 * stage,
            tuple(
                (
                    bundle,
                    tuple(replace(t, node=t.node[1:]) for t in bundle.ties if t.node[0] == "l"),
                    tuple(replace(t, node=t.node[1:]) for t in bundle.ties if t.node[0] == "r"),
                )
                for bundle in bundles
            ),
        )

    def _node(self, side: int, stage: int, enclave: str) -> str:
        """Return the id of the card of an enclave on a side (0: left) of the names of a stage."""
        before = stage > 0 or (stage == 0 and side == 0)
        return f"{'s' if before else 'l'}{self._nodes[before, enclave]}"

    # ── cards ──────────────────────────────────────────────────────────────────────────────

    def in_columns(self) -> dict[str, Card]:
        """Return all cards by id, with x and width."""
        found = [*self._side_cards(), *self._further_cards(), *self._names_cards()]
        widths = [0] * self.columns
        for card in found:
            widths[card.column] = max(widths[card.column], _width(card))
        after = list(accumulate((w + _GUTTER if w else 0 for w in widths), initial=MARGIN))
        return {
            card.id: replace(card, x=after[card.column], width=widths[card.column])
            for card in found
        }

    def _side_cards(self) -> Iterator[Card]:
        members: dict[tuple[bool, str], list[str]] = defaultdict(list)
        for (before, path), node in self._nodes.items():
            members[before, node].append(path)
        noted = enclave_notes(self._picture)
        for (before, node), paths in sorted(members.items()):
            side = self._flow.before if before else self._flow.after
            group, notes = "", []
            if node[0] == ":":
                label = node.partition(" ")[2] or counted(len(paths), "enclave")
                notes = [counted(len(paths), "enclave")] if " " in node else []
            else:
                group = self._groups[node]
                label = node.removeprefix(group.rstrip("/") + "/") or node
                notes = list(noted.get(node, ()))
            lines = wrapped(label, SIDE_LETTERS)
            yield Card(
                id=f"{'s' if before else 'l'}{node}",
                role="group" if node[0] == ":" else "enclave",
                column=self._column_of(before, side[paths[0]]),
                x=0,
                y=0,
                width=0,
                height=height_of(lines, notes),
                lines=lines,
                notes=tuple(notes),
                members=tuple(sorted(paths)),
                group=group,
                chosen=node in self._flow.own,
            )

    def _further_cards(self) -> Iterator[Card]:
        for before, paths in zip((True, False), self._further, strict=True):
            if paths:
                side = self._flow.before if before else self._flow.after
                lines = (f"{len(paths)} more",)
                notes = (f"over up to {max(side[path] for path in paths)} hops",)
                yield Card(
                    id="s:" if before else "l:",
                    role="group",
                    column=1 if before else self.columns - 2,  # next to the last hop
                    x=0,
                    y=0,
                    width=0,
                    height=height_of(lines, notes),
                    lines=lines,
                    notes=notes,
                    members=paths,
                )

    def _names_cards(self) -> Iterator[Card]:
        for stage in self._stages:
            for number, (bundle, _, _) in enumerate(stage.bundles):
                card = names_card(f"n{stage.column} {number}", bundle, stage.column)
                chosen = any((bundle.kind, name) in self._flow.targets for name in bundle.names)
                yield replace(card, chosen=chosen)

    # ── links and heads ────────────────────────────────────────────────────────────────────

    def links(self, cards: Mapping[str, Card]) -> list[Link]:
        """Return all links, without the places of their ends."""
        found: dict[tuple[str, str, str, bool, str, bool, bool], set[str]] = defaultdict(set)
        for stage in self._stages:
            for number, (_, left, right) in enumerate(stage.bundles):
                names = f"n{stage.column} {number}"
                for ties, out in ((left, True), (right, False)):
                    for tie in ties:
                        ends = (tie.node, names) if out else (names, tie.node)
                        key = (
                            *ends,
                            tie.qualifier.value,
                            bool(tie.by),
                            tie.mark.value,
                            tie.violates,
                            tie.differs,
                        )
                        found[key].add(tie.right)
        links = [
            Link(
                source,
                target,
                0,
                0,
                tuple(sorted(rights)),
                Qualifier(qualifier),
                (cards[source] if cards[source].role == "names" else cards[target]).level,
                wildcard,
                OverlaySide(mark),
                *more,
            )
            for (source, target, qualifier, wildcard, mark, *more), rights in sorted(found.items())
        ]
        return [*links, *self._further_links(cards)]

    def _further_links(self, cards: Mapping[str, Card]) -> Iterator[Link]:
        """Yield a link for each card at the last hop, if a further enclave influences it."""
        for before, paths in zip((True, False), self._further, strict=True):
            if not paths:
                continue
            last = self._column_of(before, self._hops)
            near = {
                path for path, hop in self._side(before).items() if hop == self._hops
            } & self._next_to(before)
            for card in cards.values():
                if card.column == last and not near.isdisjoint(card.members):
                    ends = ("s:", card.id) if before else (card.id, "l:")
                    yield Link(*ends, 0, 0, ("influence",), ALLOW, WireLevel.UNKNOWN, False, _BOTH)

    def _side(self, before: bool) -> Mapping[str, int]:
        return self._flow.before if before else self._flow.after

    def _next_to(self, before: bool) -> set[str]:
        """Return the enclaves at the last hop with an edge to or from the enclaves beyond."""
        stage = self._hops if before else -self._hops
        return {e.enclave for e in self._picture.edges if any(self._flow.ends(e, stage))}

    def heads(self, cards: Mapping[str, Card]) -> Iterator[Head]:
        """Yield what each column has."""
        enclaves = any(each.kind == ENCLAVE for each in self._picture.focus)
        texts = {
            self._column_of(before, hop): text
            for before, near, far, most in (
                (True, "in focus" if enclaves else SENDERS, "hops before", self._left),
                (False, LISTENERS, "hops behind", self._right),
            )
            for hop in range(1, most + 1)
            for text in (near if hop == 1 else f"{hop} {far}",)
        }
        for column, text in texts.items():
            card = next((each for each in cards.values() if each.column == column), None)
            if card:
                yield Head(card.x + card.width // 2, "middle", text)


_BOTH = OverlaySide.BOTH


def _width(card: Card) -> int:
    """Return the width that the text on a card needs, in pixels."""
    widest = max((len(line) for line in card.lines), default=0) * _LETTER
    small = max((len(note) for note in card.notes), default=0) * _SMALL_LETTER
    return max(96, round(max(widest, small) + _ROOM[card.role]))
