"""The layout of a picture in three columns: senders left, names in the middle, listeners right.

SVG and the page use the same scene; Graphviz and Mermaid use the cards of the scene, but place the
cards themselves. Lengths are in pixels at normal text size; x grows to the right and y downwards.

The layout has three layers, after Sugiyama: each column is ordered by the barycenters of the
neighbors, and each card is placed as near to its neighbors as the other cards allow (with the
pool-adjacent-violators algorithm).  The same input always gives the same layout.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from textwrap import wrap
from typing import NamedTuple

from sros_tool.policy.model import ALLOW, Qualifier
from sros_tool.report.picture import (
    SENDS,
    Bundle,
    Edge,
    Lack,
    OverlaySide,
    Picture,
    Tie,
    WireLevel,
    bundled_names,
    is_plain,
    joined_by_senders,
    lack_text,
)
from sros_tool.wording import counted

_SIDE_WIDTH, _NAMES_WIDTH, _GUTTER = 184, 330, 110
LINE, PAD, SMALL = 16, 7, 14
"""Height of a text line, padding of a card, and height of a note line, in pixels."""
_GAP, _LEAD, _TOP, MARGIN = 9.0, 24.0, 34.0, 14
_SIDE_LETTERS, _NAMES_LETTERS, _NOTE_LETTERS = 20, 35, 27  # letters per line on a card
_TIP, _MOST_TIPS = 8, 20  # height of an arrowhead in pixels; the most that a card makes room for
_ONLOOKER_LINES, _ONLOOKER_SHARE = 8, 0.3  # onlookers exceed both limits
_MOST_ONLOOKERS = 26  # one for each letter
_FEW_BUNDLES, _MOST_BUNDLES = 24, 80  # above: private names are only counted; bundles are joined
_MOST_ENCLAVES = 40  # above this number, groups are drawn
_MOST_NAMES, _SHOWN_NAMES = 8, 4  # a card lists up to 8 names; if there are more, the first 4
_SWEEPS = 24

KIND_NAMES = {"topics": "topic", "services": "service", "actions": "action", "dds": "DDS topic"}
_LEVEL_NAMES = {
    WireLevel.ENCRYPT: "encrypted",
    WireLevel.SIGN: "signed, readable",
    WireLevel.NONE: "not protected",
    WireLevel.UNKNOWN: "protection unknown",
}
ONLOOKERS = {
    "publish": "also published by",
    "subscribe": "also subscribed by",
    "request": "also called by",
    "reply": "also served by",
    "call": "also called by",
    "execute": "also executed by",
}
_REACHES = {
    "publish": "publishes",
    "subscribe": "subscribes to",
    "request": "calls",
    "reply": "serves",
    "call": "calls",
    "execute": "executes",
}
_COMMON_NAME_NOTES = {
    "topics": "used by every node",
    "services": "served by every node",
    "actions": "used by every node",
    "dds": "used by every node",
}
"""The note on cards of names that every node may use, where these rights are not drawn."""
OWN, OTHERS = "own:", ("other of", "others of")
"""Words on cards that the legend explains."""
_SENDERS, _LISTENERS = "may publish or call", "may subscribe or serve"
_NAMES = "topics, services, actions"


def level_name(picture: Picture, level: WireLevel) -> str:
    """Return the text for a level of protection in a picture."""
    if level is WireLevel.SIGN and picture.has_least_levels:
        return "at least signed"
    return _LEVEL_NAMES[level]


class Head(NamedTuple):
    """The heading of a column; its ``anchor`` ("start", "middle" or "end") is at ``x``."""

    x: int
    anchor: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Cards and the links between them; all lengths and positions are in pixels.

    ``shown`` is the number of names that are drawn, or counted on the card of the only enclave with
    rights to them. ``hidden`` is the number of names that are left out, because all rights to these
    names are rights that every node needs.
    """

    id: str
    title: str
    width: int
    height: int = 0
    cards: tuple[Card, ...]
    links: tuple[Link, ...]
    frames: tuple[Frame, ...] = ()
    onlookers: tuple[Onlooker, ...] = ()
    heads: tuple[Head, ...]
    hidden: int = 0
    shown: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """A rectangle with text: an enclave, a group of enclaves, or a bundle of names.

    ``role`` is "enclave", "group" or "names".  ``column`` counts from 0, names are in odd columns;
    an enclave that sends and listens has a card on both sides.  A card in the focus of the picture
    is ``chosen``.  ``lines`` is the text, ``notes`` smaller text below.  ``members`` are all
    enclaves or names of the card.  Only cards of names have ``kind``, ``level``, ``lacks`` and
    ``tags``: the letters of onlookers, which are nodes with rights to many of the names.  Only
    cards of enclaves have ``group``.
    """

    id: str
    role: str
    column: int
    x: int = 0
    y: int = 0
    width: int = 0
    height: int
    lines: tuple[str, ...]
    notes: tuple[str, ...]
    members: tuple[str, ...]
    kind: str = ""
    level: WireLevel = WireLevel.UNKNOWN
    group: str = ""
    tags: str = ""
    chosen: bool = False
    lacks: Lack = Lack.NOTHING


@dataclass(frozen=True, slots=True)
class Link:
    """An arrow from the right edge of one card to the left edge of another card.

    ``source`` and ``target`` are the ids of the cards, ``y1`` and ``y2`` the y of the ends.
    ``rights`` is the label, such as publish; ``wildcard`` says that only wildcards give the right,
    ``violates`` that the right breaks a requirement, ``differs`` that similar units lack the right.
    """

    source: str
    target: str
    y1: int
    y2: int
    rights: tuple[str, ...]
    qualifier: Qualifier
    level: WireLevel
    wildcard: bool
    mark: OverlaySide
    violates: bool = False
    differs: bool = False


INFLUENCE = ("influence",)
"""The label of an arrow between a drawn enclave and enclaves that are not drawn."""


class Onlooker(NamedTuple):
    """An enclave with rights to very many names: their cards show a letter (``tag``), not lines."""

    tag: str
    enclave: str
    right: str


@dataclass(frozen=True, slots=True)
class Frame:
    """The title and the area of a group of enclaves."""

    title: str
    x: int
    y: int
    width: int
    height: int


DrawnAs = Mapping[tuple[str, str], Sequence[str]]
"""Kind and text of a drawn name → the real names behind the drawn name."""


def scenes_of(
    picture: Picture, *, with_places: bool = True, drawn_as: DrawnAs | None = None
) -> tuple[Scene, ...]:
    """Return the scenes of a picture, the overview first.

    With few enclaves, the first scene leaves out the rights that every node needs, and the second
    scene has everything.  With many enclaves, the first scene has the groups and the links between
    them, and each group has another scene with its neighbors.

    Args:
        picture: the picture.
        with_places: whether cards get a y and groups get frames; formats with a layout engine need
            neither.
        drawn_as: the real names behind drawn names; only real names are counted.
    """
    groups = {enclave.path: enclave.group for enclave in picture.enclaves}
    titles = sorted(set(groups.values()))
    essential = essential_edges(picture.edges)
    if len(groups) <= _MOST_ENCLAVES or len(titles) < 2 or len(titles) > len(groups) // 2:
        scenes = [
            _scene(
                picture, "essential", "Overview", essential, str, drawn_as, with_places=with_places
            )
        ]
        if len(essential) < len(picture.edges):
            title = "With what every node needs"
            scenes.append(
                _scene(picture, "all", title, picture.edges, str, drawn_as, with_places=with_places)
            )
        return tuple(scenes)
    # Group ids begin with a colon; enclave names never do.
    outside = {path: f":{group}" for path, group in groups.items()}
    overview = outside.__getitem__
    scenes = [
        _scene(
            picture, "essential", "Overview", essential, overview, drawn_as, with_places=with_places
        )
    ]
    for title in titles:

        def owner(path: str, title: str = title) -> str:
            return path if groups[path] == title else outside[path]

        touched = {(e.kind, e.name) for e in essential if groups[e.enclave] == title}
        edges = [edge for edge in essential if (edge.kind, edge.name) in touched]
        scenes.append(
            _scene(
                picture, f"group {title}", title, edges, owner, drawn_as, with_places=with_places
            )
        )
    return tuple(scenes)


def essential_edges(edges: Iterable[Edge]) -> list[Edge]:
    """Return the edges without rights that every node needs.

    If an enclave may call a service by its exact name, the rights to serve this service stay.
    """
    edges = tuple(edges)
    called = {
        edge.name
        for edge in edges
        if (edge.right, edge.qualifier) == ("request", ALLOW) and not edge.by
    }
    return [
        edge for edge in edges if not edge.common or (edge.right == "reply" and edge.name in called)
    ]


def _scene(
    picture: Picture,
    scene_id: str,
    title: str,
    edges: Sequence[Edge],
    owner: Callable[[str], str],
    drawn_as: DrawnAs | None,
    *,
    with_places: bool,
) -> Scene:
    members: dict[str, list[str]] = defaultdict(list)
    for enclave in picture.enclaves:
        members[owner(enclave.path)].append(enclave.path)
    everybody: dict[tuple[str, str], set[str]] = defaultdict(set)
    for edge in picture.edges:
        everybody[edge.kind, edge.name].add(owner(edge.enclave))
    draft = _Draft(picture, edges, owner, members, everybody)
    scene = draft.scene(scene_id, title)
    scene = with_positions(scene, 3) if with_places else scene
    shown = _count_real_names({(edge.kind, edge.name) for edge in edges}, drawn_as or {})
    hidden = (
        _count_real_names({(name.kind, name.name) for name in picture.names}, drawn_as or {})
        - shown
    )
    return replace(scene, hidden=hidden, shown=shown)


def _count_real_names(names: Iterable[tuple[str, str]], drawn_as: DrawnAs) -> int:
    """Return the number of different real names behind drawn names."""
    return len(
        {(kind, real) for kind, name in names for real in drawn_as.get((kind, name), (name,))}
    )


class _Draft:
    """The builder of a scene before placement, with its cards and links.

    A node of the scene is an enclave, or ":" and a group.  ``members`` maps each node to its
    enclaves; ``everybody`` maps each name to the nodes with any right to the name, drawn or not.
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
        self._groups = {enclave.path: enclave.group for enclave in picture.enclaves}
        self._notes = enclave_notes(picture)
        bundles = bundled_names(picture.names, edges, owner)
        self._looking = _onlookers(bundles)
        self._tags = {side: chr(ord("A") + n) for n, side in enumerate(self._looking)}
        self._own: dict[str, list[Bundle]] = defaultdict(list)
        self._bundles: list[Bundle] = []
        for bundle in bundles:
            alone = self._only_node(bundle) if len(bundles) > _FEW_BUNDLES else ""
            if alone:
                self._own[alone].append(bundle)
            else:
                self._bundles.append(bundle)
        if len(self._bundles) > _MOST_BUNDLES:
            self._bundles = list(joined_by_senders(self._bundles))
        self._ties: list[LinkedTie] = []
        for number, bundle in enumerate(self._bundles):
            for tie in bundle.ties:
                if not self._is_onlooker(tie):
                    side, names = f"{'s' if tie.sends else 'l'}{tie.node}", f"n{number}"
                    self._ties.append((side, names, tie) if tie.sends else (names, side, tie))

    def _is_onlooker(self, tie: Tie) -> bool:
        """Return whether a right is drawn as a letter on the card of the name, not as a line."""
        return is_plain(tie) and (tie.node, tie.right) in self._looking

    def _only_node(self, bundle: Bundle) -> str:
        """Return the only enclave or group, except onlookers, with a right to the names, or ""."""
        looking = {tie.node for tie in bundle.ties if self._is_onlooker(tie)}
        drawn = {tie.node for tie in bundle.ties if not self._is_onlooker(tie)}
        if not all(map(is_plain, bundle.ties)) or bundle.protection.open_access_text(bundle.kind):
            return ""
        nodes = {node for name in bundle.names for node in self._everybody[bundle.kind, name]}
        nodes -= looking - drawn
        return nodes.pop() if len(nodes) == 1 else ""

    def scene(self, scene_id: str, title: str) -> Scene:
        """Return the scene before placement: without y, frames and the number of names."""
        cards = {card.id: card for card in self._cards()}
        width = 2 * (MARGIN + _SIDE_WIDTH + _GUTTER) + _NAMES_WIDTH
        return Scene(
            id=scene_id,
            title=title,
            width=width,
            cards=tuple(cards.values()),
            links=tuple(links_of(cards, self._ties)),
            onlookers=tuple(
                Onlooker(tag, node, right) for (node, right), tag in self._tags.items()
            ),
            heads=(
                Head(MARGIN, "start", _SENDERS),
                Head(width // 2, "middle", _NAMES),
                Head(width - MARGIN, "end", _LISTENERS),
            ),
        )

    # ── cards ──────────────────────────────────────────────────────────────────────────────

    def _cards(self) -> Iterable[Card]:
        sides = {end for ends in self._ties for end in ends[:2] if end[0] in "sl"}
        sides |= {f"{'s' if SENDS[right] else 'l'}{node}" for node, right in self._looking}
        # The scene of a group has all enclaves of the group, but only neighbors with links.
        inner = {node for node in self._members if not node.startswith(":")}
        idle = (inner or set(self._members)) - {side[1:] for side in sides}
        sides |= {f"s{node}" for node in idle}
        for side in sorted(sides):
            first = side[0] == "s" or f"s{side[1:]}" not in sides
            yield self._side_card(side, is_first=first)
        for number, bundle in enumerate(self._bundles):
            yield self._names_card(number, bundle)

    def _side_card(self, side: str, *, is_first: bool) -> Card:
        """Return the card of a sender or receiver.

        The ``is_first`` card of an enclave also counts the names that no other enclave uses.
        """
        node, sends = side[1:], side[0] == "s"
        members = tuple(self._members[node])
        is_group = node.startswith(":")
        notes = [counted(len(members), "enclave")] if is_group else []
        if is_group:
            label = node[1:]
        else:
            group = self._groups[node].rstrip("/") + "/"
            label = node.removeprefix(group) or node
        if is_first and (own_rights := self._own.get(node)):
            notes += _own_text(own_rights)
        notes += self._notes.get(node, ())
        notes += [
            f"{reach} {counted(self._looking[node, right], 'name')} ({tag})"
            for (tagged, right), tag in self._tags.items()
            for reach in (_REACHES[right],)
            if tagged == node and SENDS[right] is sends
        ]
        card = side_card(
            side, 0 if sends else 2, label, notes, members, "" if is_group else self._groups[node]
        )
        x = MARGIN if sends else MARGIN + _SIDE_WIDTH + _NAMES_WIDTH + 2 * _GUTTER
        return replace(card, x=x, width=_SIDE_WIDTH)

    def _names_card(self, number: int, bundle: Bundle) -> Card:
        drawn = {tie.node for tie in bundle.ties}
        hidden = {
            node for name in bundle.names for node in self._everybody[bundle.kind, name]
        } - drawn
        tags = {self._tags[tie.node, tie.right] for tie in bundle.ties if self._is_onlooker(tie)}
        x = MARGIN + _SIDE_WIDTH + _GUTTER
        notes = (_COMMON_NAME_NOTES[bundle.kind],) if hidden else ()
        if bundle.kind == "services" and len(hidden) == 1:
            notes = (f"served by {hidden.pop().removeprefix(':')}",)
        card = names_card(f"n{number}", bundle, 1, notes)
        return replace(card, x=x, width=_NAMES_WIDTH, tags="".join(sorted(tags)))


def _onlookers(bundles: Sequence[Bundle]) -> dict[tuple[str, str], int]:
    """Map onlookers (enclave or group, and right) to the number of their names.

    An onlooker, such as ("/recorder", "subscribe"), has wildcards for so many names that the lines
    of the onlooker would hide all other lines.
    """
    reached: dict[tuple[str, str], list[Bundle]] = defaultdict(list)
    wild: dict[tuple[str, str], int] = defaultdict(int)
    for bundle in bundles:
        ties = {(tie.node, tie.right): tie.by for tie in bundle.ties if tie.qualifier is ALLOW}
        for key, by in ties.items():
            reached[key].append(bundle)
            wild[key] += bool(by)
    most = max(_ONLOOKER_LINES, _ONLOOKER_SHARE * len(bundles))
    looking = [
        (key, sum(len(bundle.names) for bundle in bundles))
        for key, bundles in sorted(reached.items())
        if len(bundles) > most and 2 * wild[key] > len(bundles)
    ]
    return dict(looking[:_MOST_ONLOOKERS])


# ── text on cards ───────────────────────────────────────────────────────────────────────


def _own_text(own_bundles: Iterable[Bundle]) -> list[str]:
    """Return lines like ``own: 3 topics, 2 services`` for names that only one enclave uses."""
    kinds, lacks = Counter[str](), Counter[Lack]()
    for bundle in own_bundles:
        kinds[bundle.kind] += len(bundle.names)
        lacks[bundle.lacks] += len(bundle.names)
    counts = [counted(number, KIND_NAMES[kind]) for kind, number in kinds.items()]
    lines = [f"{OWN} {', '.join(counts[:2])}"]
    lines += [", ".join(counts[2:])] if counts[2:] else []
    sides = (Lack.SENDER, Lack.RECEIVER)
    return [*lines, *(f"{lacks[side]} without a {side}" for side in sides if lacks[side])]


def _names_title(bundle: Bundle) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the text lines and notes on the card of a bundle of names."""
    kind, names = KIND_NAMES[bundle.kind], bundle.names
    if bundle.partial:
        return (f"{_common_namespace(names)}/…",), (
            f"{counted(len(names), kind)}; each line is for some of them",
        )
    if len(names) <= _MOST_NAMES:
        return names, ()
    expressions = sorted({expression for tie in bundle.ties for expression in tie.by})
    if expressions and all(tie.by for tie in bundle.ties):
        return tuple(expressions[:_MOST_NAMES]), (f"reaches {counted(len(names), kind)}",)
    return names[:_SHOWN_NAMES], (f"and {len(names) - _SHOWN_NAMES} more {kind}s",)


def enclave_notes(picture: Picture) -> Mapping[str, tuple[str, ...]]:
    """Map enclaves to the notes on their cards."""
    return {
        enclave.path: (enclave.note,) * bool(enclave.note)
        + ("never observed",) * (not enclave.observed)
        for enclave in picture.enclaves
    }


def side_card(
    card: str,
    column: int,
    label: str,
    notes: Sequence[str],
    members: Iterable[str],
    group: str = "",
) -> Card:
    """Return the card of an enclave, or of several enclaves, without x, y and width.

    ``card`` is the id of the card, and ``label`` names the enclave or enclaves. ``group`` is the
    group of a single enclave; "" for several enclaves.
    """
    lines = _wrapped_name(label, _SIDE_LETTERS)
    notes = [line for note in notes for line in wrap(note, _NOTE_LETTERS, break_on_hyphens=False)]
    return Card(
        id=card,
        role="enclave" if group else "group",
        column=column,
        height=_height_of(lines, notes),
        lines=lines,
        notes=tuple(notes),
        members=tuple(members),
        group=group,
    )


def names_card(card: str, bundle: Bundle, column: int, more: tuple[str, ...] = ()) -> Card:
    """Return the card of a bundle, without x, y and width; ``more`` are additional notes."""
    titles, notes = _names_title(bundle)
    lines = tuple(line for title in titles for line in _wrapped_name(title, _NAMES_LETTERS))
    notes += more
    if is_open := bundle.protection.open_access_text(bundle.kind):
        notes += (is_open,)
    if bundle.lacks:
        notes += (lack_text(bundle.kind, bundle.lacks),)
    return Card(
        id=card,
        role="names",
        column=column,
        height=_height_of(lines, notes),
        lines=lines,
        notes=notes,
        members=bundle.names,
        kind=bundle.kind,
        level=bundle.protection.level,
        lacks=bundle.lacks,
    )


def _height_of(lines: Sequence[str], notes: Sequence[str]) -> int:
    """Return the height of a card with these text lines and notes, in pixels."""
    return 2 * PAD + LINE * len(lines) + SMALL * len(notes)


def _common_namespace(names: Sequence[str]) -> str:
    """Return the innermost namespace that contains all names; "" for the root."""
    common_parts = []
    for parts in zip(*(name.split("/")[:-1] for name in names), strict=False):
        if len(set(parts)) > 1:
            break
        common_parts.append(parts[0])
    return "/".join(common_parts)


def _wrapped_name(text: str, letters: int) -> tuple[str, ...]:
    """Split ``text`` into lines of at most ``letters`` characters, at slashes or underscores.

    A word is split only if it is longer than a line.
    """
    lines = []
    while len(text) > letters:
        second = len(text) - len(text.lstrip()) + 1
        cut = max(text.rfind("/", second, letters), text.rfind("_", second, letters - 1))
        cut = cut if cut > 0 else letters - 1
        if text[cut] == "_":
            cut += 1
        lines.append(text[:cut])
        text = "  " + text[cut:]
    return (*lines, text)


# ── positions ──────────────────────────────────────────────────────────────────────────

LinkedTie = tuple[str, str, Tie]
"""The ids of two cards, in the direction of the arrow, and a right that their link shows."""


def links_of(cards: Mapping[str, Card], ties: Iterable[LinkedTie]) -> list[Link]:
    """Return links for rights, without positions; equally drawn rights share a link."""
    groups: dict[tuple[str, str, Qualifier, bool, OverlaySide, bool, bool], set[str]]
    groups = defaultdict(set)
    for source, target, tie in ties:
        marks = tie.mark, tie.violates, tie.differs
        groups[source, target, tie.qualifier, bool(tie.by), *marks].add(tie.right)
    return [
        Link(
            source,
            target,
            0,
            0,
            tuple(sorted(rights)),
            qualifier,
            (cards[source] if cards[source].role == "names" else cards[target]).level,
            wildcard,
            mark,
            *more,
        )
        for (source, target, qualifier, wildcard, mark, *more), rights in sorted(groups.items())
    ]


def with_positions(scene: Scene, columns: int) -> Scene:
    """Return a scene with the positions of all cards, links and frames, in ``columns`` columns."""
    lines = sorted({(link.source, link.target) for link in scene.links})
    tips = Counter(link.target for link in scene.links)
    cards = _stacked_cards(
        [_with_room_for_tips(tips[c.id], c) for c in scene.cards], lines, columns
    )
    return replace(
        scene,
        height=max((card.y + card.height for card in cards.values()), default=0) + MARGIN,
        cards=tuple(cards.values()),
        links=_links_with_ends(cards, scene.links),
        frames=tuple(_frames_of(cards.values())),
    )


def _with_room_for_tips(tips: int, card: Card) -> Card:
    """Return the card, high enough for this number of arrowheads below each other."""
    needed = 2 * PAD + _TIP * (min(tips, _MOST_TIPS) - 1)
    return replace(card, height=max(card.height, needed))


def _stacked_cards(
    cards: Iterable[Card], lines: Sequence[tuple[str, str]], columns: int
) -> dict[str, Card]:
    """Return the cards with their y, by id, in the order of column and y.

    Cards of names are in odd columns; ``lines`` are pairs of ids in neighboring columns.
    """
    by_id = {card.id: card for card in cards}
    items: list[list[ColumnItem]] = [[] for _ in range(columns)]
    for card in by_id.values():
        items[card.column].append(ColumnItem(card.id, card.height, card.group))
    ordered = order_columns(items, lines)
    tops = _card_tops(ordered, lines)
    return {
        item.id: replace(by_id[item.id], y=round(tops[item.id]))
        for column in ordered
        for item in column
    }


def _links_with_ends(cards: Mapping[str, Card], links: Sequence[Link]) -> tuple[Link, ...]:
    """Return the links with their ends spread along the edges of the cards."""
    ports: dict[tuple[str, bool], list[tuple[float, int]]] = defaultdict(list)
    for number, link in enumerate(links):
        for near, far, out in (
            (link.source, link.target, True),
            (link.target, link.source, False),
        ):
            ports[near, out].append((cards[far].y + cards[far].height / 2, number))
    where: dict[tuple[int, bool], int] = {}
    for (card, out), ends in ports.items():
        box = cards[card]
        step = min(14.0, (box.height - 2 * PAD) / max(1, len(ends) - 1))
        first = box.y + box.height / 2 - step * (len(ends) - 1) / 2
        for place, (_, number) in enumerate(sorted(ends)):
            where[number, out] = round(first + place * step)
    return tuple(
        replace(link, y1=where[number, True], y2=where[number, False])
        for number, link in enumerate(links)
    )


def _card_tops(
    columns: Sequence[Sequence[ColumnItem]], lines: Sequence[tuple[str, str]]
) -> dict[str, float]:
    """Map cards to their y.

    The tallest column is placed first, as tight as possible. In the other columns, each card is
    placed near the cards to which lines connect it.
    """
    extent = [_column_height(column) for column in columns]
    tallest = max(range(len(columns)), key=lambda number: (extent[number], number % 2 == 1))
    tops: dict[str, float] = {}
    height = {item.id: item.height for column in columns for item in column}
    near: dict[str, list[str]] = defaultdict(list)
    for first_id, second_id in lines:
        near[first_id].append(second_id)
        near[second_id].append(first_id)
    for number in sorted(range(len(columns)), key=lambda number: abs(number - tallest)):
        wanted_middles = {}
        for item in columns[number] if number != tallest else ():
            centers = [tops[end] + height[end] / 2 for end in near[item.id] if end in tops]
            wanted_middles[item.id] = sum(centers) / len(centers) if centers else extent[tallest]
        lead = 0 if number % 2 else _LEAD
        tops |= place_column(columns[number], wanted_middles, _GAP, _TOP, lead)
    return tops


def _column_height(column: Sequence[ColumnItem]) -> float:
    groups = len({item.group for item in column})
    return sum(item.height + _GAP for item in column) + _LEAD * groups


def _frames_of(cards: Iterable[Card]) -> Iterable[Frame]:
    """Yield a frame around the cards of each group in a column of enclaves."""
    groups: dict[tuple[int, str], list[Card]] = defaultdict(list)
    for card in cards:
        if card.role != "names":
            groups[card.column, card.group].append(card)
    for (_, title), members in groups.items():
        if not all(card.role == "group" for card in members):
            top, bottom = members[0].y - 24, members[-1].y + members[-1].height + 6
            yield Frame(title, members[0].x - 6, top, members[0].width + 12, bottom - top)


class ColumnItem(NamedTuple):
    """An item of a column with its height; items of one ``group`` stay together."""

    id: str
    height: float
    group: str = ""


def order_columns(
    columns: Sequence[Sequence[ColumnItem]], lines: Sequence[tuple[str, str]]
) -> list[list[ColumnItem]]:
    """Return the items of all columns in an order with few crossings of lines.

    ``lines`` are pairs of ids of items in neighboring columns.  The order is the one with the
    fewest crossings among several sweeps.
    """
    near: dict[str, list[str]] = {item.id: [] for column in columns for item in column}
    for first_id, second_id in lines:
        near[first_id].append(second_id)
        near[second_id].append(first_id)
    current = [list(column) for column in columns]
    best, fewest = [list(column) for column in current], _crossings(current, lines)
    inner, outer = range(1, len(columns), 2), range(0, len(columns), 2)
    for sweep in range(_SWEEPS):
        for moved in (*inner, *(outer if sweep % 2 else reversed(outer))):
            current[moved] = _sort_by_barycenter(current[moved], near, _relative_positions(current))
        crossings = _crossings(current, lines)
        if crossings < fewest:
            best, fewest = [list(column) for column in current], crossings
    return best


def _relative_positions(columns: Sequence[Sequence[ColumnItem]]) -> dict[str, float]:
    """Map items to their relative position in their column, from 0 to 1."""
    return {
        item.id: (number + 0.5) / len(column)
        for column in columns
        for number, item in enumerate(column)
    }


def _sort_by_barycenter(
    column: Sequence[ColumnItem],
    neighbors: Mapping[str, Sequence[str]],
    places: Mapping[str, float],
) -> list[ColumnItem]:
    center = {
        item.id: (
            sum(places[neighbor] for neighbor in neighbors[item.id]) / len(neighbors[item.id])
            if neighbors[item.id]
            else places[item.id]
        )
        for item in column
    }
    groups: dict[str, list[float]] = {}
    for item in column:
        groups.setdefault(item.group, []).append(center[item.id])
    middle = {group: sum(positions) / len(positions) for group, positions in groups.items()}
    return sorted(
        column, key=lambda item: (middle[item.group], item.group, center[item.id], item.id)
    )


def _crossings(columns: Sequence[Sequence[ColumnItem]], lines: Sequence[tuple[str, str]]) -> int:
    """Return the number of line crossings between neighboring columns."""
    side = {item.id: number for number, column in enumerate(columns) for item in column}
    place = {item.id: n for column in columns for n, item in enumerate(column)}
    total = 0
    for first in range(len(columns) - 1):
        pairs = []
        for first_id, second_id in lines:
            if side[first_id] > side[second_id]:
                first_id, second_id = second_id, first_id
            if side[first_id] == first:
                pairs.append((place[first_id], place[second_id]))
        total += _inversions([end for _, end in sorted(pairs)], len(columns[first + 1]))
    return total


def _inversions(ends: Sequence[int], size: int) -> int:
    """Return how many pairs of ``ends`` are in decreasing order, computed with a Fenwick tree.

    All ``ends`` are less than ``size``.
    """
    tree = [0] * (size + 1)
    crossings = 0
    for count, end in enumerate(ends):
        at, before = end + 1, 0
        while at:
            before += tree[at]
            at -= at & -at
        crossings += count - before
        at = end + 1
        while at <= size:
            tree[at] += 1
            at += at & -at
    return crossings


def place_column(
    column: Sequence[ColumnItem],
    wanted_positions: Mapping[str, float],
    gap: float,
    top: float,
    lead: float = 0,
) -> dict[str, float]:
    """Map items to y positions near their ``wanted_positions``, without overlaps.

    Items keep their order, with ``gap`` between items, and no item is above ``top``.  The first
    item of each group has ``lead`` more space above it.  All lengths are in pixels.
    """
    offsets, at, group = [], 0.0, None
    for item in column:
        at += lead if item.group != group else 0
        group = item.group
        offsets.append(at)
        at += item.height + gap
    # Without the offsets, it is isotonic regression: least squares with increasing values.
    blocks: list[list[float]] = []
    for item, offset in zip(column, offsets, strict=True):
        target = wanted_positions.get(item.id, 0.0) - item.height / 2 - offset
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
