"""The part of a picture around a name or enclave: who influences it, and whom it influences.

Who may use a name, and who influences whom, is decided by `sros_tool.reach` for all names that
rights and governance allow, known or not.  Between two enclaves, the picture has the known names by
which information goes from the first enclave to the second; without a known name, it has one
example.

The layout has a column for each hop, and names between two columns. Information goes from left to
right: senders are to the left of a name in the focus, and receivers to the right. Enclaves further
away than the drawn hops share a card.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance
from sros_tool.errors import UsageError
from sros_tool.keystore.selection import likely_names
from sros_tool.names import ACTION_SEPARATOR, dds_names, is_expression
from sros_tool.policy.model import ALLOW, DENY, PEER_RIGHT
from sros_tool.policy.patterns import matches, overlap
from sros_tool.policy.rights import Right
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, HopPath, Network, path_text, unguarded_topics
from sros_tool.report.compose import PictureSource, edge_order, namespace_of, protection_of
from sros_tool.report.layout import (
    INFLUENCE,
    MARGIN,
    Card,
    Head,
    Link,
    LinkedTie,
    Scene,
    enclave_notes,
    links_of,
    names_card,
    side_card,
    with_positions,
)
from sros_tool.report.picture import (
    Bundle,
    Edge,
    Focus,
    Influence,
    Name,
    OverlaySide,
    Picture,
    Tie,
    WireLevel,
    bundled_names,
    is_question,
    joined_by_senders,
)
from sros_tool.wording import counted, enumerated

_ENCLAVE = "enclave"
_WORDS_OF_KIND = {
    "topics": ("publish", "publisher", "subscribe to"),
    "services": ("call", "caller", "serve"),
    "actions": ("call action", "caller", "execute"),
    "dds": ("publish DDS topic", "publisher", "subscribe to"),
}
"""Kind of name → verb of senders, noun for senders, verb of receivers."""
_TOPIC_RIGHTS = ("publish", "subscribe")
_COMMANDING_SERVICES = ("send_goal", "cancel_goal")
_MOST_NAMED = 3  # maximum number of enclaves that a sentence names; more are counted


def focused_picture(
    picture: Picture, sources: Sequence[PictureSource], words: Sequence[str], routers: int = 0
) -> Picture:
    """Return the part of a picture connected to the names or enclaves in ``words``.

    Args:
        picture: a picture of ``sources``.
        words: absolute ROS names, perhaps with wildcards; DDS topics; paths of enclaves.
        routers: number of Zenoh routers. With several routers, the answers say that they ignore the
            limits on what passes between routers.

    Raises:
        UsageError: nothing in the sources has such a name.
    """
    system = _System(picture, sources)
    focused_names = dict.fromkeys(meant for word in words for meant in system.names_meant(word))
    focuses = tuple(system.focus(kind, name) for kind, name in focused_names)
    if routers > 1:
        left_out = f"; what passes between the {routers} Zenoh routers is not considered"
        focuses = tuple(replace(focus, sentence=f"{focus.sentence}{left_out}") for focus in focuses)
    if system.is_partial:
        scope = f"for the enclaves in {picture.title} alone: "
        focuses = tuple(replace(focus, sentence=f"{scope}{focus.sentence}") for focus in focuses)
    picture = system.with_shortest_paths(replace(picture, focus=focuses))
    flow = FocusFlow.of(picture)
    edges = tuple(edge for edge in picture.edges if flow.has(edge))
    enclaves = {edge.enclave for edge in edges} | flow.before.keys() | flow.after.keys()
    names = {(edge.kind, edge.name) for edge in edges}
    return replace(
        picture,
        enclaves=tuple(enclave for enclave in picture.enclaves if enclave.path in enclaves),
        names=tuple(name for name in picture.names if (name.kind, name.name) in names),
        edges=edges,
        findings=tuple(e for e in picture.findings if not e.enclave or e.enclave in enclaves),
        validities=tuple(e for e in picture.validities if not e.enclave or e.enclave in enclaves),
    )


# ── what a picture with a focus draws ──────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class FocusFlow:
    """The flow of information to and from the names in a focus, in stages.

    ``own`` are the enclaves in the focus, and ``targets`` the names in the focus (kind and name).
    ``before`` maps an enclave to the number of hops to the focus: 1 for an enclave in the focus, or
    that may send to a target. ``after`` maps an enclave to the number of hops from the focus: 1 for
    an enclave that may receive from a target.

    ``stages`` maps a name to its columns.  Targets, and names that an enclave in the focus writes,
    have column 0.  Columns to the left count the hops of the reading enclaves; columns to the right
    count the hops of the writing enclaves, as negative numbers.
    """

    own: frozenset[str]
    targets: frozenset[tuple[str, str]]
    before: Mapping[str, int]
    after: Mapping[str, int]
    stages: Mapping[tuple[str, str], tuple[int, ...]]

    @classmethod
    def of(cls, picture: Picture) -> FocusFlow:
        """Return the flow of information of a picture that has a focus."""
        focused = frozenset(focus.name for focus in picture.focus if focus.kind == _ENCLAVE)
        focused_names = [
            (focus.kind, focus.name) for focus in picture.focus if focus.kind != _ENCLAVE
        ]
        targets = frozenset(
            (name.kind, name.name)
            for name in picture.names
            for kind, asked in focused_names
            if name.kind == kind and (name.name == asked or overlap(asked, name.name))
        )
        before: dict[str, int] = {}
        after: dict[str, int] = {}
        for focus in picture.focus:
            for hops_of, near, far in (
                (
                    before,
                    (focus.name,) if focus.name in focused else focus.senders,
                    focus.influencing,
                ),
                (after, focus.receivers, focus.influenced),
            ):
                for enclave, hops in (
                    *((enclave, 1) for enclave in near),
                    *((enclave.enclave, enclave.hops) for enclave in far),
                ):
                    hops_of[enclave] = min(hops, hops_of.get(enclave, hops))
        for edge in picture.edges:
            # Enclaves that are denied a target, or use a part of it, belong to the focus, too.
            if (edge.kind, edge.name) in targets:
                (before if edge.sends else after).setdefault(edge.enclave, 1)
        flow = cls(focused, targets, before, after, {})
        ends = defaultdict[tuple[str, str], tuple[set[int], set[int]]](lambda: (set(), set()))
        for edge in picture.edges:
            for side in (0, 1):
                ends[edge.kind, edge.name][side].update(flow._stages(edge)[side])
        stages = {
            key: tuple(sorted((sent & received) | ({0} if key in targets else set())))
            for key, (sent, received) in ends.items()
        }
        return replace(flow, stages={key: stage for key, stage in stages.items() if stage})

    def ends(self, edge: Edge, stage: int) -> tuple[bool, bool]:
        """Return whether lines to the name, and from the name, are drawn in column ``stage``."""
        if stage not in self.stages.get((edge.kind, edge.name), ()):
            return False, False
        before, after = self._stages(edge)
        return stage in before, stage in after

    def has(self, edge: Edge) -> bool:
        """Return whether a right is a part of the flow in any column."""
        return any(
            any(self.ends(edge, stage)) for stage in self.stages.get((edge.kind, edge.name), ())
        )

    def _stages(self, edge: Edge) -> tuple[set[int], set[int]]:
        """Return the columns where the edge's enclave may write, and may read, the edge's name."""
        writes: set[int] = set()
        reads: set[int] = set()
        before, after = self.before.get(edge.enclave, 0), self.after.get(edge.enclave, 0)
        if (edge.kind, edge.name) in self.targets and (before if edge.sends else after) == 1:
            (writes if edge.sends else reads).add(0)
        if edge.qualifier is not ALLOW or edge.name in OF_EVERY_NODE:
            return writes, reads
        if _may_write(edge):
            writes |= {before - 1} if before > 1 else set()
            writes |= {-after} if after else set()
            writes |= {0} if edge.enclave in self.own else set()
        if _may_read(edge):
            reads |= {before} if before else set()
            reads |= {1 - after} if after else set()
        return writes, reads


def _may_write(edge: Edge) -> bool:
    """Return whether information goes from the enclave of an edge to its name."""
    if edge.right in _TOPIC_RIGHTS:
        return edge.sends
    return not (edge.right == "request" and is_question(edge))


def _may_read(edge: Edge) -> bool:
    """Return whether information goes from the name of an edge to its enclave."""
    if edge.right in _TOPIC_RIGHTS:
        return not edge.sends
    return not (edge.right == "reply" and is_question(edge))


# ── answers ────────────────────────────────────────────────────────────────────────────────


class _System:
    """The rights and governance of the sources from which a picture was composed."""

    def __init__(self, picture: Picture, sources: Sequence[PictureSource]) -> None:
        self._picture = picture
        known = [source for source in sources if source.origin.kind != "observation"]
        self.is_partial = bool(known) and all(source.is_partial for source in known)
        enclaves = {enclave.path for enclave in picture.enclaves}
        in_domains: dict[DomainSet | None, list[Right]] = defaultdict(list)
        for source in sources:
            for domains, rights in (source.in_domains or {None: source.rights}).items():
                in_domains[domains] += (right for right in rights if right.enclave in enclaves)
        self._rights = [right for rights in in_domains.values() for right in rights]
        self._domains = {enclave.path: enclave.domains for enclave in picture.enclaves}
        self._governance: Governance | None = next(
            (source.governance for source in reversed(sources) if source.governance), None
        )
        everybody = sorted(enclaves)
        opened = tuple(unguarded_topics(self._governance)) if self._governance else ()
        self._by_permissions = Network(in_domains)
        self._direct = Network(in_domains, unguarded=opened, everybody=everybody)
        self._network = Network(
            in_domains,
            excluded=OF_EVERY_NODE,
            questions=QUESTIONS,
            unguarded=opened,
            everybody=everybody,
        )
        self._known = {(name.kind, name.name) for name in picture.names}
        self._paths: list[HopPath] = []

    def names_meant(self, word: str) -> Iterator[tuple[str, str]]:
        """Yield kind and name of every name or enclave that ``word`` can mean.

        An exact name counts if a right states it, or if the wildcard of a right matches it.

        Raises:
            UsageError: there is no such name or enclave.
        """
        enclaves = [enclave.path for enclave in self._picture.enclaves]
        kinds = [_ENCLAVE] * (word in enclaves)
        kinds += [name.kind for name in self._picture.names if name.name == word]
        if not kinds:
            kinds = [
                kind
                for kind in _WORDS_OF_KIND
                if any(_overlaps_word(right, kind, word) for right in self._rights)
            ]
        if not kinds:
            known = (*enclaves, *(name.name for name in self._picture.names))
            meant = likely_names(word, known)
            raise UsageError(
                f"no name and no enclave in '{self._picture.title}' is called {word!r}",
                "--focus takes a topic, service or action such as /cmd_vel, or an enclave.",
                f"Perhaps you mean {' or '.join(meant)}." if meant else "",
            )
        for kind in kinds:
            yield kind, word

    def focus(self, kind: str, name: str) -> Focus:
        """Return the users of a name and who influences them, or the influences of an enclave."""
        if kind == _ENCLAVE:
            influencing = self._influences(self._network.influencers_of({name}))
            influenced = self._influences(self._network.influenced_by({name}), 0)
            sentence = (
                f"{name} can influence {_counted_influences(influenced, 1)}, "
                f"and {_counted_influences(influencing, 2)} can influence it"
            )
            return Focus(kind, name, sentence, (), (), influencing, influenced)
        topics = tuple(_command_topics(kind, name))
        senders, receivers = (
            frozenset(user for topic in topics for user in self._direct.users(side, topic))
            for side in ("publish", "subscribe")
        )
        influencing = self._influences(self._network.influencers_of(senders))
        open_to_all = senders != frozenset(
            user for topic in topics for user in self._by_permissions.users("publish", topic)
        )
        sentence = _sentence(
            kind,
            name,
            senders,
            receivers,
            influencing,
            open_to_all=open_to_all,
            partial=self.is_partial,
        )
        if not is_expression(name) and (kind, name) not in self._known:
            sentence = f"no right states {name} itself, but wildcards match it: {sentence}"
        domains = {self._domains.get(user, "") for user in senders | receivers} - {""}
        if len(domains) > 1:
            sentence += "; these enclaves are in different ROS domains ("
            sentence += (
                f"{enumerated(sorted(domains))}), and reach only enclaves of their own domain"
            )
        return Focus(
            kind, name, sentence, tuple(sorted(senders)), tuple(sorted(receivers)), influencing
        )

    def _influences(
        self, paths: Mapping[str, HopPath], earlier_hops: int = 1
    ) -> tuple[Influence, ...]:
        """Return the influences of the enclaves in ``paths``, sorted by hops.

        ``earlier_hops`` is added to the number of hops on each path.
        """
        self._paths += paths.values()
        influences = (
            Influence(enclave, earlier_hops + len(path), path_text(path))
            for enclave, path in paths.items()
        )
        return tuple(sorted(influences, key=lambda influence: (influence.hops, influence.enclave)))

    def with_shortest_paths(self, picture: Picture) -> Picture:
        """Return a picture with all names of shortest paths, even names that no right states."""
        allowed = [edge for edge in picture.edges if edge.qualifier is ALLOW]
        drawn = {
            (edge.enclave, edge.kind, edge.name, fits)
            for edge in allowed
            for fits in (_may_write, _may_read)
            if fits(edge)
        }
        added = set()
        for hop in {hop for path in self._paths for hop in path}:
            for enclave, right, stated, fits in (
                (hop.source, hop.right, hop.stated_by_source, _may_write),
                (hop.target, PEER_RIGHT[hop.right], hop.stated_by_target, _may_read),
            ):
                if (enclave, hop.kind, hop.name, fits) not in drawn:
                    by = () if stated == hop.name else (stated,)
                    added.add(Edge(enclave, hop.kind, hop.name, right, ALLOW, by))
        for focus in picture.focus:
            if focus.kind != _ENCLAVE and not is_expression(focus.name):
                added |= set(self._edges_by_wildcard(focus.kind, focus.name))
        new = {(edge.kind, edge.name) for edge in added} - self._known
        names = (*picture.names, *(self._name_with_protection(*key) for key in new))
        return replace(
            picture,
            edges=tuple(sorted((*picture.edges, *added), key=edge_order)),
            names=tuple(sorted(names, key=lambda name: (name.kind, name.name))),
        )

    def _edges_by_wildcard(self, kind: str, name: str) -> Iterator[Edge]:
        """Yield the rights to a name that only wildcards match."""
        if (kind, name) in self._known:
            return
        by_right: dict[tuple[str, str], list[Right]] = defaultdict(list)
        for right in self._rights:
            if right.kind == kind and matches(right.name, name):
                by_right[right.enclave, right.right].append(right)
        for (enclave, verb), rights in by_right.items():
            qualifier = DENY if any(right.qualifier is DENY for right in rights) else ALLOW
            by = sorted({right.name for right in rights if right.qualifier is qualifier})
            yield Edge(enclave, kind, name, verb, qualifier, tuple(by))

    def _name_with_protection(self, kind: str, name: str) -> Name:
        protection = protection_of(self._governance, kind, name)
        return Name(kind, name, namespace_of(name), protection, is_expression(name))


def _overlaps_word(right: Right, kind: str, word: str) -> bool:
    return right.kind == kind and right.qualifier is ALLOW and overlap(right.name, word)


def _command_topics(kind: str, name: str) -> Iterator[str]:
    """Yield the DDS topics of a name by which a sender can command its receivers.

    Leaves out requests of services that only answer questions.
    """
    if kind == "dds":
        yield name
    elif kind == "actions":
        for command in _COMMANDING_SERVICES:
            yield from dds_names("request", f"{name}{ACTION_SEPARATOR}{command}").publish
    else:
        yield from dds_names("publish" if kind == "topics" else "request", name).publish


def _sentence(
    kind: str,
    name: str,
    senders: Collection[str],
    receivers: Collection[str],
    influencing: Sequence[Influence],
    *,
    open_to_all: bool,
    partial: bool,
) -> str:
    """Return a sentence on who may use a name, and how many enclaves influence its senders.

    With ``partial``, there may be other enclaves, so no enclave is said to be the only one.
    """
    sends, sender, receives = _WORDS_OF_KIND[kind]
    who = "every enclave" if open_to_all else _enclaves_text(senders, partial=partial)
    text = f"{who} may {sends} {name}"
    text += ", which the governance leaves open" if open_to_all else ""
    text += f"; {_enclaves_text(receivers, partial=partial)} may {receives} it"
    if open_to_all or not senders:
        return text
    sender_text = f"the {sender}" if len(senders) == 1 else f"these {sender}s"
    near = sum(influence.hops == 2 for influence in influencing)
    if not influencing:
        return f"{text}; no other enclave influences {sender_text}"
    s = "s" if len(influencing) == 1 else ""
    far = " directly" if near == len(influencing) else f", {near} of them directly"
    return f"{text}; {counted(len(influencing), 'other enclave')} influence{s} {sender_text}{far}"


def _counted_influences(influences: Sequence[Influence], direct: int) -> str:
    """Return the number of enclaves in words, and how many of them are direct.

    ``direct`` is the number of hops of a direct influence.
    """
    near = sum(influence.hops == direct for influence in influences)
    text = counted(len(influences), "enclave") if influences else "no enclave"
    return text if near == len(influences) else f"{text} ({near} directly)"


def _enclaves_text(enclaves: Collection[str], *, partial: bool) -> str:
    """Return the paths of a few enclaves, or the number of many enclaves, in words."""
    if not enclaves:
        return "no enclave"
    if len(enclaves) > _MOST_NAMED:
        return counted(len(enclaves), "enclave")
    alone = len(enclaves) == 1 and not partial
    return ("only " if alone else "") + enumerated(sorted(enclaves))


HOPS = 2
"""Default number of hops to draw."""
_MOST_ENCLAVES = 24  # if a column has more, groups are drawn; with more groups, one card
_MOST_BUNDLES = 40  # if a stage has more, names with the same senders are joined
_GUTTER, _LETTER, _SMALL_LETTER = 76, 7.4, 6.2
_UNUSED_WIDTH = {"names": 66, "enclave": 24, "group": 24}
"""Width on a card besides its text, in pixels."""


def flow_scene(picture: Picture, hops: int = HOPS, *, with_places: bool = True) -> Scene:
    """Return the scene of a picture with a focus.

    Args:
        picture: a picture with a focus.
        hops: number of hops to draw to the left and to the right, at least 1.
        with_places: whether cards get a y and groups get frames; formats with a layout engine need
            neither.
    """
    draft = _Draft(picture, FocusFlow.of(picture), hops)
    cards = draft.cards_in_columns()
    names = {name for card in cards.values() if card.kind for name in card.members}
    scene = Scene(
        id="focus",
        title=", ".join(dict.fromkeys(focus.name for focus in picture.focus)),
        width=max((card.x + card.width for card in cards.values()), default=200) + MARGIN,
        cards=tuple(cards.values()),
        links=tuple(draft.links(cards)),
        heads=tuple(draft.heads(cards)),
        shown=len(names),
    )
    return with_positions(scene, draft.columns) if with_places else scene


class _Stage(NamedTuple):
    """Bundles of names in a ``column``, and the rights of enclaves on both sides of the column.

    Each entry of ``bundles`` is a bundle, the rights of enclaves to its left, and to its right.
    """

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
        self._nodes = self._card_ids()
        self._stages = [self._stage(stage) for stage in range(1 - self._right, self._left)]

    def _column_of(self, is_before_focus: bool, hop: int) -> int:
        middle = self._first + 2 * self._left - 1
        return middle + (1 - 2 * hop if is_before_focus else 2 * hop - 1)

    def _card_ids(self) -> Mapping[tuple[bool, str], str]:
        """Map pairs (whether before the focus, enclave) to the id of the card with the enclave."""
        nodes = {}
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
                        is_folded = len(groups) > _MOST_ENCLAVES
                        node = f":{hop}" if is_folded else f":{hop} {self._groups[path]}"
                    nodes[before, path] = node
        return nodes

    def _stage(self, stage: int) -> _Stage:
        edges: tuple[list[Edge], list[Edge]] = ([], [])
        for edge in self._picture.edges:
            for side, fits in enumerate(self._flow.ends(edge, stage)):
                if fits:
                    edges[side].append(edge)
        # The node's name begins with its side, so that one call of
        # `bundled_names` can handle both sides.
        sides = [
            [replace(e, enclave=f"{'lr'[n]}{self._node(n, stage, e.enclave)}") for e in drawn]
            for n, drawn in enumerate(edges)
        ]
        used = [{(edge.kind, edge.name) for edge in side} for side in sides]
        on_stage = used[0] | used[1] if stage == 0 else used[0] & used[1]
        kept = [edge for side in sides for edge in side if (edge.kind, edge.name) in on_stage]
        bundles: Iterable[Bundle] = bundled_names(self._picture.names, kept)
        bundles = joined_by_senders(bundles) if len(tuple(bundles)) > _MOST_BUNDLES else bundles
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
        """Return the id of an enclave's card, left (``side`` 0) or right of a column of names."""
        before = stage > 0 or (stage == 0 and side == 0)
        return f"{'s' if before else 'l'}{self._nodes[before, enclave]}"

    # ── cards ──────────────────────────────────────────────────────────────────────────────

    def cards_in_columns(self) -> dict[str, Card]:
        """Map ids to all cards, which have x and width but no y."""
        cards = [*self._side_cards(), *self._further_cards(), *self._names_cards()]
        widths = [0] * self.columns
        for card in cards:
            widths[card.column] = max(widths[card.column], _width(card))
        after = list(accumulate((w + _GUTTER if w else 0 for w in widths), initial=MARGIN))
        return {
            card.id: replace(card, x=after[card.column], width=widths[card.column])
            for card in cards
        }

    def _side_cards(self) -> Iterator[Card]:
        members: dict[tuple[bool, str], list[str]] = defaultdict(list)
        for (before, path), node in self._nodes.items():
            members[before, node].append(path)
        noted = enclave_notes(self._picture)
        for (before, node), paths in sorted(members.items()):
            side = self._hops_on_side(before)
            group, notes = "", []
            if node[0] == ":":
                label = node.partition(" ")[2] or counted(len(paths), "enclave")
                notes = [counted(len(paths), "enclave")] if " " in node else []
            else:
                group = self._groups[node]
                label = node.removeprefix(group.rstrip("/") + "/") or node
                notes = list(noted.get(node, ()))
            column = self._column_of(before, side[paths[0]])
            card = f"{'s' if before else 'l'}{node}"
            yield replace(
                side_card(card, column, label, notes, sorted(paths), group),
                chosen=node in self._flow.own,
            )

    def _further_cards(self) -> Iterator[Card]:
        for before, paths in zip((True, False), self._further, strict=True):
            if paths:
                side = self._hops_on_side(before)
                most = max(side[path] for path in paths)
                hops = f"over up to {self._hops_to_focus(before, most)} hops"
                notes = ["directly" if most <= (2 if before else 1) else hops]
                # An enclave can be before and after the focus.
                if twice := sum((not before, path) in self._nodes for path in paths):
                    notes.append(f"{twice} also {'after' if before else 'before'} the focus")
                column = 1 if before else self.columns - 2  # one column before the outermost one
                card = "s:" if before else "l:"
                yield side_card(card, column, f"{len(paths)} more", notes, paths)

    def _names_cards(self) -> Iterator[Card]:
        for stage in self._stages:
            for number, (bundle, _, _) in enumerate(stage.bundles):
                card = names_card(f"n{stage.column} {number}", bundle, stage.column)
                chosen = any((bundle.kind, name) in self._flow.targets for name in bundle.names)
                yield replace(card, chosen=chosen)

    # ── links and heads ────────────────────────────────────────────────────────────────────

    def links(self, cards: Mapping[str, Card]) -> list[Link]:
        """Return all links, without the positions of their ends."""
        ties: list[LinkedTie] = []
        for stage in self._stages:
            for number, (_, left, right) in enumerate(stage.bundles):
                names = f"n{stage.column} {number}"
                ties += ((tie.node, names, tie) for tie in left)
                ties += ((names, tie.node, tie) for tie in right)
        return [*links_of(cards, ties), *self._further_links(cards)]

    def _further_links(self, cards: Mapping[str, Card]) -> Iterator[Link]:
        """Yield links between the outermost drawn cards and the card of enclaves further away."""
        for before, paths in zip((True, False), self._further, strict=True):
            if not paths:
                continue
            last = self._column_of(before, self._hops)
            near = {
                path for path, hop in self._hops_on_side(before).items() if hop == self._hops
            } & self._enclaves_with_further_neighbors(before)
            for card in cards.values():
                if card.column == last and not near.isdisjoint(card.members):
                    ends = ("s:", card.id) if before else (card.id, "l:")
                    yield Link(*ends, 0, 0, INFLUENCE, ALLOW, WireLevel.UNKNOWN, False, _BOTH)

    def _hops_to_focus(self, is_before_focus: bool, hop: int) -> int:
        """Return the number of hops to show for ``hop``.

        Before the focus, enclaves that are themselves in the focus have hop 1, so the number is
        less by one.
        """
        return hop - 1 if is_before_focus and self._flow.own else hop

    def _hops_on_side(self, is_before_focus: bool) -> Mapping[str, int]:
        return self._flow.before if is_before_focus else self._flow.after

    def _enclaves_with_further_neighbors(self, is_before_focus: bool) -> set[str]:
        """Return the enclaves at the last drawn hop that share a name with further enclaves."""
        stage = self._hops if is_before_focus else -self._hops
        return {e.enclave for e in self._picture.edges if any(self._flow.ends(e, stage))}

    def heads(self, cards: Mapping[str, Card]) -> Iterator[Head]:
        """Yield the heading of each column."""
        kinds = {focus.kind for focus in self._picture.focus}
        sends, receives = "in focus" if _ENCLAVE in kinds else "1 hop before", "1 hop after"
        if len(kinds) == 1 and _ENCLAVE not in kinds:
            publish, _, subscribe = _WORDS_OF_KIND[kinds.pop()]
            sends, receives = f"may {publish}", f"may {subscribe.removesuffix(' to')}"
        texts = {
            self._column_of(before, hop): text
            for before, near, far, most in (
                (True, sends, "before", self._left),
                (False, receives, "after", self._right),
            )
            for hop in range(1, most + 1)
            for number in (counted(self._hops_to_focus(before, hop), "hop"),)
            for text in (near if hop == 1 else f"{number} {far}",)
        }
        for column, text in texts.items():
            card = next((card for card in cards.values() if card.column == column), None)
            if card:
                yield Head(card.x + card.width // 2, "middle", text)


_BOTH = OverlaySide.BOTH


def _width(card: Card) -> int:
    """Return the width that a card needs for its text, in pixels."""
    widest = max((len(line) for line in card.lines), default=0) * _LETTER
    small = max((len(note) for note in card.notes), default=0) * _SMALL_LETTER
    return max(96, round(max(widest, small) + _UNUSED_WIDTH[card.role]))
