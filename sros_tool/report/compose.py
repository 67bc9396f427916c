"""Compose the picture of one source, or the overlay of two, from rights and governance.

A wildcard is replaced by the known names that it matches, and denials override permissions.  Known
names are the exact names in the rights of all sources.  A wildcard that would then be invisible,
such as a wildcard whose known names are all denied, is drawn as a name.  An action is shown as one
name, even if a right is for only some parts of the action, such as the right of a recorder that
subscribes to ``/*``.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from sros_tool.dds.decision.access import is_open_to_unauthenticated
from sros_tool.dds.decision.vendors import TESTED
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, TopicRule
from sros_tool.keystore.layout import is_original_keystore
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import compared_enclaves
from sros_tool.names import ACTION_SEPARATOR, dds_names, is_expression
from sros_tool.policy.model import ALLOW, DENY, RIGHTS, Policy, Qualifier, StatedProtection
from sros_tool.policy.node_basics import NodeRights
from sros_tool.policy.patterns import Names, covers, literal_prefix, matches, overlap
from sros_tool.policy.rights import (
    RIGHT_ORDER,
    Right,
    compare,
    join_actions,
    order,
    parts,
    placed_rights,
    split_actions,
)
from sros_tool.reach import DomainRights
from sros_tool.report.picture import (
    UNKNOWN,
    Edge,
    Lack,
    Name,
    Overlay,
    OverlayDifference,
    OverlaySide,
    Picture,
    PicturedEnclave,
    PicturedFinding,
    Protection,
    Requirements,
    SourceTitle,
    Spelling,
    Statement,
    UnreadUnits,
    Validity,
    WireLevel,
)
from sros_tool.translate import protected_topics

_OVERLAYS = {
    "use": Overlay("use", "allowed, never observed", "observed, not allowed"),
    "change": Overlay("change", "removed", "added"),
    "drift": Overlay("drift", "only in the policy", "only in what was signed"),
    "worlds": Overlay("worlds", "not in the Zenoh rules", "only in the Zenoh rules"),
}
"""The kinds of comparisons of two sources, by name, with their labels."""
_TOPIC_RIGHTS = ("publish", "subscribe")


@dataclass(frozen=True, slots=True)
class PictureSource:
    """The content of one source of a picture.

    ``origin`` is the title and kind of the source, ``rights`` are its rights and denials. ``nodes``
    maps paths of enclaves to names of nodes; ``enclaves`` has the enclaves with data of their
    certificates; ``scope`` has the paths of the enclaves that the source describes, None for all.
    ``protections`` are the protection levels that a policy states, and ``policy`` is that policy.
    ``keystore`` is the keystore from which the source was read; ``revoked`` are revoked enclaves
    that it no longer has, and ``unread`` units of the keystore that were only compared with other
    units. ``in_domains`` has the rights by ROS domain; empty if the source states no domains.
    """

    origin: SourceTitle
    rights: frozenset[Right]
    nodes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    enclaves: tuple[PicturedEnclave, ...] = ()
    governance: Governance | None = None
    validities: tuple[Validity, ...] = ()
    findings: tuple[PicturedFinding, ...] = ()
    scope: frozenset[str] | None = None
    protections: tuple[StatedProtection, ...] = ()
    policy: Policy | None = None
    keystore: OpenedKeystore | None = None
    revoked: tuple[str, ...] = ()
    unread: tuple[UnreadUnits, ...] = ()
    in_domains: DomainRights = field(default_factory=dict)

    @property
    def is_export(self) -> bool:
        """Whether the source is an export, which may lack enclaves of its keystore."""
        return self.keystore is not None and not is_original_keystore(self.keystore.root)

    @property
    def is_partial(self) -> bool:
        """Whether the system may have enclaves that are not in the source."""
        return self.is_export or self.origin.kind in ("enclave", "permissions")

    def with_title(self, title: str) -> PictureSource:
        """Return a copy with another title."""
        return replace(self, origin=self.origin._replace(title=title))

    def only_for(self, enclaves: Collection[str]) -> PictureSource:
        """Return a copy without the rights, nodes and certificates of all other enclaves."""
        return replace(
            self,
            rights=frozenset(right for right in self.rights if right.enclave in enclaves),
            nodes={path: names for path, names in self.nodes.items() if path in enclaves},
            enclaves=tuple(enclave for enclave in self.enclaves if enclave.path in enclaves),
        )

    def moved_to_homes(self, homes: Mapping[str, str]) -> PictureSource:
        """Return a copy with the rights and nodes of each enclave moved to ``homes[enclave]``."""
        nodes: dict[str, set[str]] = defaultdict(set)
        for path, names in self.nodes.items():
            nodes[homes.get(path, path)].update(names)
        rights = (
            right._replace(enclave=homes.get(right.enclave, right.enclave)) for right in self.rights
        )
        sorted_nodes = {path: tuple(sorted(names)) for path, names in nodes.items()}
        return replace(self, rights=frozenset(rights), nodes=sorted_nodes)


_NO_HOSTS: Mapping[str, str] = MappingProxyType({})


def compose(first_source: PictureSource, hosts: Mapping[str, str] = _NO_HOSTS) -> Picture:
    """Return the picture of one source.

    ``hosts`` maps paths of enclaves, or of their namespaces, to names of hosts.
    """
    rights = first_source.rights
    known, edges = _with_all_wildcards(rights, lambda known: _edges_of(rights, known))
    stated = dict.fromkeys(join_actions(rights), OverlaySide.BOTH)
    return _picture((first_source,), edges, stated, known, hosts)


def overlay(
    first_source: PictureSource,
    second_source: PictureSource,
    kind: str,
    hosts: Mapping[str, str] = _NO_HOSTS,
) -> Picture:
    """Return a picture that compares two sources; ``kind`` is a key of `_OVERLAYS`."""
    sources: tuple[PictureSource, ...] = (first_source, second_source)
    scope = compared_enclaves(*((source.origin.kind, source.scope) for source in sources))
    if scope is not None:
        sources = tuple(source.only_for(scope) for source in sources)
    rights = [source.rights for source in sources]

    def marked_edges(known_names: KnownNames) -> list[Edge]:
        sides = [_edges_of(side_rights, known_names) for side_rights in rights]
        return _marked_rights(*sides, allowed_by=kind == "use")

    known, edges = _with_all_wildcards(rights[0] | rights[1], marked_edges)
    normal = [join_actions(own) for own in rights]
    stated = {
        right: OverlaySide.BOTH
        if right in normal[0] and right in normal[1]
        else (OverlaySide.FIRST if right in normal[0] else OverlaySide.SECOND)
        for right in normal[0] | normal[1]
    }
    unseen: frozenset[str] = frozenset()
    # Nodes without a known enclave may be those of an enclave that seems unobserved.
    is_unclear = any(finding.id == "graph.unknown-enclave" for finding in second_source.findings)
    if kind == "use":
        unseen = frozenset(right.enclave for right in rights[0] - rights[1])
        unseen -= {right.enclave for right in rights[1]}
        observed = NamesOfRights(rights[1])
        edges = [_neutral_edge(edge, unseen, observed) for edge in edges]
    picture = _picture(sources, edges, stated, known, hosts)
    return replace(
        picture,
        overlay=_OVERLAYS[kind],
        differences=_unused_rights(edges) if kind == "use" else _overlay_differences(*rights),
        enclaves=tuple(
            replace(e, observed=is_unclear, note="perhaps observed" * is_unclear)
            if e.path in unseen
            else e
            for e in picture.enclaves
        ),
    )


def with_requirements(picture: Picture, requirements: Requirements) -> Picture:
    """Return a picture in which the rights that break requirements are marked.

    Such rights are added if the picture lacks their names, for instance because only wildcards
    match the names.
    """
    broken = {
        (use.enclave, use.kind, use.name, use.right): use
        for violation in requirements.violations
        for use in violation.uses
    }
    edges, violated = [], set()
    for edge in picture.edges:
        key = (edge.enclave, edge.kind, edge.name, edge.right)
        violates = key in broken and edge.qualifier is ALLOW
        edges.append(replace(edge, violates=True, common=False) if violates else edge)
        violated |= {key} if violates else set()
    for key, use in broken.items():
        if key not in violated:
            by = (use.by,) if use.by else ()
            edges.append(Edge(use.enclave, use.kind, use.name, use.right, ALLOW, by, violates=True))
    known = {(name.kind, name.name) for name in picture.names}
    new = {(edge.kind, edge.name) for edge in edges} - known
    names = [Name(kind, name, namespace_of(name), UNKNOWN) for kind, name in new]
    paths = {enclave.path for enclave in picture.enclaves}
    return replace(
        picture,
        requirements=requirements,
        edges=tuple(sorted((e for e in edges if e.enclave in paths), key=edge_order)),
        names=tuple(sorted((*picture.names, *names), key=lambda name: (name.kind, name.name))),
    )


def _nodes_of(sources: Iterable[PictureSource]) -> dict[str, tuple[str, ...]]:
    """Map enclaves to their nodes in all ``sources``, sorted."""
    nodes: dict[str, set[str]] = defaultdict(set)
    for source in sources:
        for path, names in source.nodes.items():
            nodes[path].update(names)
    return {path: tuple(sorted(names)) for path, names in nodes.items()}


def union(sources: Sequence[PictureSource]) -> PictureSource:
    """Return one source with the rights and nodes of several observations."""
    title = " and ".join(source.origin.title for source in sources)
    return PictureSource(
        SourceTitle(title, "observation"),
        frozenset(right for source in sources for right in source.rights),
        _nodes_of(sources),
        findings=tuple(finding for source in sources for finding in source.findings),
    )


def _picture(
    sources: Sequence[PictureSource],
    edges: Iterable[Edge],
    stated_rights: Mapping[Right, OverlaySide],
    known_names: KnownNames,
    hosts: Mapping[str, str],
) -> Picture:
    edges = tuple(sorted(edges, key=edge_order))
    governance = next(
        (source.governance for source in reversed(sources) if source.governance), None
    )
    drawn = _senders_and_receivers(edges)

    def sides(kind: str, name: str) -> Sequence[bool]:
        known = known_names.matching_names(kind, name) if is_expression(name) else ()
        # A known name that is not drawn is a part of an action, which has both sides.
        of_known = [drawn.get((kind, known_name), (True, True)) for known_name in known]
        return [any(ends) for ends in zip(drawn[kind, name], *of_known, strict=True)]

    stated = next((source.protections for source in reversed(sources) if source.protections), ())
    demanded = _DemandedProtection(() if governance else stated)
    names = sorted({(edge.kind, edge.name) for edge in edges})
    policy = sources[0].policy if len(sources) == 1 else None
    spellings = _spellings(policy) if policy else {}
    return Picture(
        title=" and ".join(source.origin.title for source in sources),
        origins=tuple(source.origin for source in sources),
        enclaves=_enclaves(sources, stated_rights, known_names, hosts),
        names=tuple(
            Name(
                kind,
                name,
                namespace_of(name),
                protection := demanded.protection(kind, name)
                or protection_of(governance, kind, name),
                is_expression(name),
                _lacking_side(protection, *sides(kind, name)),
                spellings.get((kind, name), Spelling.UNKNOWN),
            )
            for kind, name in names
        ),
        edges=edges,
        validities=tuple(
            sorted({validity for source in sources for validity in source.validities})
        ),
        findings=tuple(dict.fromkeys(finding for source in sources for finding in source.findings)),
        exports=tuple(source.origin.title for source in sources if source.is_export),
        revoked=tuple(sorted({name for source in sources for name in source.revoked})),
        unread=tuple(units for source in sources for units in source.unread),
        join_needs_right=governance is not None
        and all(rule.enable_join_access_control for rule in governance.domain_access_rules),
        has_least_levels=governance is None,
    )


def _spellings(policy: Policy) -> Mapping[tuple[str, str], Spelling]:
    """Map kind and name to how a policy writes the name."""
    relative: dict[tuple[str, str], set[bool]] = defaultdict(set)
    for enclave in policy.enclaves:
        for placed in placed_rights(enclave):
            right = placed.right
            relative[right.kind, right.name].add(not placed.written.startswith("/"))
    spelling = {frozenset({False}): Spelling.ABSOLUTE, frozenset({True}): Spelling.RELATIVE}
    return {name: spelling.get(frozenset(forms), Spelling.BOTH) for name, forms in relative.items()}


def _senders_and_receivers(edges: Iterable[Edge]) -> Mapping[tuple[str, str], list[bool]]:
    """Map kind and name to two flags: whether any enclave may send, and any may receive."""
    allowed: dict[tuple[str, str], list[bool]] = defaultdict(lambda: [False, False])
    for edge in edges:
        if edge.qualifier is ALLOW:
            # A publisher of feedback serves the action; a subscriber to feedback is a client.
            sends = edge.sends != (edge.kind == "actions" and edge.right in _TOPIC_RIGHTS)
            allowed[edge.kind, edge.name][0 if sends else 1] = True
    return allowed


def _lacking_side(protection: Protection, sends: bool, receives: bool) -> Lack:
    """Return the side of a name (senders or receivers) on which no enclave is allowed."""
    if sends and not receives and protection.read_control:
        return Lack.RECEIVER
    if receives and not sends and protection.write_control:
        return Lack.SENDER
    return Lack.NOTHING


def edge_order(edge: Edge) -> tuple[str, int, str, str, tuple[str, ...], str]:
    """Return the sort key of a drawn right."""
    right = RIGHT_ORDER[edge.right]
    return edge.enclave, right, edge.name, edge.qualifier, edge.parts, edge.mark


def _enclaves(
    sources: Sequence[PictureSource],
    stated_rights: Mapping[Right, OverlaySide],
    known_names: KnownNames,
    hosts: Mapping[str, str],
) -> tuple[PicturedEnclave, ...]:
    described = {enclave.path: enclave for source in sources for enclave in source.enclaves}
    statements: dict[str, list[Statement]] = defaultdict(list)
    for right in sorted(stated_rights, key=order):
        reaches = len(known_names.matching_names(right.kind, right.name))
        statements[right.enclave].append(
            Statement(
                right.qualifier, right.right, right.kind, right.name, reaches, stated_rights[right]
            )
        )
    nodes, domains = _nodes_of(sources), _domains_of(sources)
    return tuple(
        replace(
            described.get(path, PicturedEnclave(path, "")),
            group=group_of(path, hosts),
            nodes=nodes.get(path, ()),
            domains=domains.get(path, ""),
            statements=tuple(statements.get(path, ())),
        )
        for path in sorted({*described, *statements, *nodes})
    )


def _domains_of(sources: Sequence[PictureSource]) -> dict[str, str]:
    """Map enclaves to the ROS domains of their rights in any source, as text.

    The text is "" for an enclave with a right that holds in every domain.
    """
    ranges: dict[str, list[tuple[int, int]]] = defaultdict(list)
    everywhere: set[str] = set()
    for domains, rights in (item for source in sources for item in source.in_domains.items()):
        enclaves = {right.enclave for right in rights}
        if domains is None:
            everywhere |= enclaves
            continue
        for enclave in enclaves:
            ranges[enclave] += ((part.first or 0, part.last or 0) for part in domains.ranges)
    known = {enclave: str(DomainSet.of(*pairs)) for enclave, pairs in ranges.items()}
    return known | dict.fromkeys(everywhere, "")


def group_of(enclave: str, hosts: Mapping[str, str]) -> str:
    """Return the host of an enclave, or its namespace if the host is not known."""
    place = enclave
    while place:
        if place in hosts:
            return hosts[place]
        place = place.rpartition("/")[0]
    return hosts.get("/", namespace_of(enclave))


def namespace_of(name: str) -> str:
    """Return the namespace of a name: the part before its last slash, or "/" if that is empty."""
    return name.rpartition("/")[0] or "/"


# ── overlays of two sources ────────────────────────────────────────────────────────────


def _marked_rights(
    first: Iterable[Edge], second: Iterable[Edge], *, allowed_by: bool
) -> list[Edge]:
    """Return the rights of both sources, marked with the source that has them.

    Args:
        first: drawn rights of the first source.
        second: drawn rights of the second source.
        allowed_by: for a right of both sources, show the wildcards of the first source only.
            Without it, wildcards are shown if only wildcards give the right in both sources.
    """
    sides = [{_edge_identity(edge): edge for edge in side} for side in (first, second)]
    edges = []
    for key in {**sides[0], **sides[1]}:
        left, right = sides[0].get(key), sides[1].get(key)
        if left and right:
            by = tuple(sorted({*left.by, *right.by})) if left.by and right.by else ()
            edges.append(left if allowed_by else replace(left, by=by))
        elif left:
            edges.append(replace(left, mark=OverlaySide.FIRST))
        elif right:
            edges.append(replace(right, mark=OverlaySide.SECOND))
    return edges


def _neutral_edge(edge: Edge, unseen: frozenset[str], observed: NamesOfRights) -> Edge:
    """Return ``edge``, marked BOTH if it is unknown whether the right was used.

    This is the case for a denial, for an enclave in ``unseen``, and for a wildcard drawn as a name
    that matches a name in ``observed``.
    """
    neutral = edge.qualifier is not ALLOW or edge.enclave in unseen
    neutral = neutral or (is_expression(edge.name) and observed.has_match(edge))
    return replace(edge, mark=OverlaySide.BOTH) if neutral else edge


def _edge_identity(edge: Edge) -> tuple[object, ...]:
    return edge.enclave, edge.kind, edge.name, edge.right, edge.qualifier, edge.parts


def _overlay_differences(
    first_rights: frozenset[Right], second_rights: frozenset[Right]
) -> tuple[OverlayDifference, ...]:
    difference = compare(first_rights, second_rights)
    return tuple(
        OverlayDifference(
            OverlaySide.FIRST if sign == "-" else OverlaySide.SECOND,
            str(right),
            tuple(
                f"the other side has it as part of {cover.describe()}"
                for cover in difference.covered.get(right, ())
            ),
        )
        for sign, right in difference.lines()
    )


def _unused_rights(edges: Iterable[Edge]) -> tuple[OverlayDifference, ...]:
    """Return rights that were allowed but never observed, or observed but not allowed.

    Rights that every node needs are left out.  The names that a wildcard matches are only counted,
    because a recorder of all topics has too many.
    """
    differences: dict[tuple[OverlaySide, Right], tuple[str, ...]] = {}
    reached: dict[Right, list[bool]] = defaultdict(list)
    for edge in sorted(edges, key=edge_order):
        for name in edge.by:
            right = Right(edge.enclave, edge.qualifier, edge.right, name)
            reached[right].append(edge.mark is OverlaySide.FIRST and not edge.common)
        if edge.mark is not OverlaySide.BOTH and not edge.common and not edge.by:
            right = Right(edge.enclave, edge.qualifier, edge.right, edge.name)
            differences[edge.mark, right] = ()
    for right, unused in reached.items():
        if any(unused):
            were = "was" if sum(unused) == 1 else "were"
            which = f"{sum(unused)} of the {len(unused)} names"
            if len(unused) == 1:
                which = "the only name"
            note = f"{which} that it matches {were} never observed"
            differences[OverlaySide.FIRST, right] = (note,)
    return tuple(
        OverlayDifference(mark, str(right), notes)
        for (mark, right), notes in sorted(differences.items(), key=lambda item: order(item[0][1]))
    )


class NamesOfRights:
    """The exact names of rights, by enclave and right."""

    def __init__(self, rights: Collection[Right]) -> None:
        self._names: dict[tuple[str, str], list[str]] = defaultdict(list)
        for right in split_actions(rights) | join_actions(rights):
            if not is_expression(right.name):
                self._names[right.enclave, right.right].append(right.name)

    def has_match(self, edge: Edge) -> bool:
        """Return whether a wildcard drawn as a name matches a name of its enclave and right."""
        names = self._names.get((edge.enclave, edge.right), ())
        return any(matches(edge.name, name) for name in names)


# ── names that rights match ─────────────────────────────────────────────────────────────


def _with_all_wildcards(
    rights: Collection[Right], edges_of: Callable[[KnownNames], list[Edge]]
) -> tuple[KnownNames, list[Edge]]:
    """Return the names to draw, and edges to these names that show every wildcard.

    Edges to known names do not show a wildcard if all matched names are denied, or if the enclave
    also has rights to these exact names.  Such a wildcard is drawn as a name.
    """
    known = KnownNames(rights)
    edges = edges_of(known)
    by = {
        Right(edge.enclave, edge.qualifier, right, text)
        for edge in edges
        for right in (edge.right, *_RIGHTS_IN.get(edge.right, ()))
        for text in edge.by
    }
    drawn = {(edge.enclave, edge.right, edge.name) for edge in edges}
    unseen = [
        right
        for right in join_actions(rights)
        if is_expression(right.name)
        and right not in by
        and (right.enclave, right.right, right.name) not in drawn
    ]
    if unseen:
        known = KnownNames(rights, unseen)
        edges = edges_of(known)
    return known, edges


class KnownNames:
    """The exact names of topics, services and actions that appear in rights.

    ``wildcards`` are rights whose wildcards are drawn as names, even if known names match.
    """

    def __init__(self, rights: Iterable[Right], wildcards: Iterable[Right] = ()) -> None:
        rights = frozenset(rights)
        known: dict[str, set[str]] = defaultdict(set)
        for part in split_actions(rights):
            if not is_expression(part.name):
                known[part.kind].add(part.name)
        self.actions = frozenset(
            right.name
            for right in join_actions(rights)
            if right.kind == "actions" and not is_expression(right.name)
        )
        self._names = {kind: sorted(names) for kind, names in known.items()}
        self._matched: dict[tuple[str, str], tuple[str, ...]] = {}
        wild: dict[str, list[str]] = defaultdict(list)
        chosen = split_actions(wildcards)
        for part in sorted(split_actions(rights)):
            if is_expression(part.name) and (
                part in chosen or not self.matching_names(part.kind, part.name)
            ):
                wild[part.kind].append(part.name)
        self._open = {kind: _DrawnWildcards(names) for kind, names in wild.items()}

    def matching_names(self, kind: str, name: str) -> tuple[str, ...]:
        """Return the exact names of this kind that an expression matches."""
        if not is_expression(name):
            return (name,)
        key = (kind, name)
        if key not in self._matched:
            self._matched[key] = tuple(self._matching_names(kind, name))
        return self._matched[key]

    def names_to_draw(self, right: Right) -> tuple[str, ...]:
        """Return the names to draw for a right: exact names, and wildcards that are drawn as names.

        A wildcard is drawn for each ALLOW that overlaps it, and for each DENY that covers it.
        """
        if not is_expression(right.name):
            return (right.name,)
        opened = self._open.get(right.kind)
        wild = opened.names_to_draw(right.qualifier, right.name) if opened else ()
        return (*self.matching_names(right.kind, right.name), *wild)

    def _matching_names(self, kind: str, expression: str) -> Iterable[str]:
        if kind == "actions":
            return sorted(action for action in self.actions if matches(expression, action))
        names, prefix = self._names.get(kind, ()), literal_prefix(expression)
        fitting = []
        for name in names[bisect_left(names, prefix) :]:
            if not name.startswith(prefix):
                break
            if matches(expression, name):
                fitting.append(name)
        return fitting


class _DrawnWildcards:
    """The wildcards in rights that are drawn as names."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = Names(names)
        self._drawn: dict[tuple[Qualifier, str], tuple[str, ...]] = {}

    def names_to_draw(self, qualifier: Qualifier, name: str) -> tuple[str, ...]:
        """Return the wildcards that ``name`` overlaps (ALLOW), or that it covers (DENY)."""
        key = (qualifier, name)
        if key not in self._drawn:
            meeting = self._names.overlapping(name)
            self._drawn[key] = tuple(
                wildcard for wildcard in meeting if qualifier is not DENY or covers(name, wildcard)
            )
        return self._drawn[key]


_NO_ACTION = Right("", ALLOW, "call", "")
_PARTS_OF_WHOLE_ACTION: dict[str, frozenset[tuple[str, str]]] = {
    right: frozenset(
        (part.right, part.name.removeprefix(ACTION_SEPARATOR))
        for part in parts(_NO_ACTION._replace(right=right))
    )
    for right in ("call", "execute")
}
_RIGHTS_IN = {right: {part for part, _ in whole} for right, whole in _PARTS_OF_WHOLE_ACTION.items()}
"""Maps a right to a whole action to the rights to its topics and services."""
_Found = dict[Qualifier, set[str]]


def _edges_of(rights: Collection[Right], known_names: KnownNames) -> list[Edge]:
    """Return an edge from each right or denial to each matching name, unsorted.

    A wildcard that matches no known name, or would be invisible, is drawn as a name.
    """
    nodes = NodeRights(rights)
    topics: dict[tuple[str, str, str, str], _Found] = defaultdict(lambda: defaultdict(set))
    for stated in split_actions(rights):
        by = stated.name if is_expression(stated.name) else ""
        for reached in known_names.names_to_draw(stated):
            # A wildcard drawn as a name is treated like an exact name.
            wild = "" if reached == by else by
            topics[stated.enclave, stated.kind, stated.right, reached][stated.qualifier].add(wild)
    whole: dict[tuple[str, str, Qualifier], dict[tuple[str, str], set[str]]] = defaultdict(dict)
    edges = []
    for (enclave, kind, right, name), by_qualifier in topics.items():
        qualifier = DENY if DENY in by_qualifier else ALLOW
        action, inside, part = name.rpartition(ACTION_SEPARATOR)
        if inside and (action in known_names.actions or is_expression(action)):
            whole[enclave, action, qualifier][right, part] = by_qualifier[qualifier]
            continue
        wildcards = _wildcards_used(by_qualifier[qualifier])
        common = qualifier is ALLOW and all(
            nodes.needs(Right(enclave, qualifier, right, text)) for text in wildcards or (name,)
        )
        edges.append(Edge(enclave, kind, name, right, qualifier, wildcards, common=common))
    for (enclave, action, qualifier), members in whole.items():
        edges += _action_edges(enclave, action, qualifier, members)
    return edges


def _action_edges(
    enclave: str,
    action: str,
    qualifier: Qualifier,
    members: dict[tuple[str, str], set[str]],
) -> Iterable[Edge]:
    """Yield an edge for a right to the whole action, or edges for rights to parts of the action."""
    remaining = dict(members)
    for right, needed in _PARTS_OF_WHOLE_ACTION.items():
        if needed <= members.keys():
            whole = {member for part in needed for member in members[part]}
            yield Edge(
                enclave, "actions", action, right, qualifier, _wildcards_used(whole, action=True)
            )
            for part in needed:
                remaining.pop(part, None)
    rest: dict[str, dict[str, set[str]]] = defaultdict(dict)
    for (right, inside), names in remaining.items():
        rest[right][inside] = names
    for right, halves in rest.items():
        by = _wildcards_used({text for names in halves.values() for text in names})
        yield Edge(enclave, "actions", action, right, qualifier, by, tuple(sorted(halves)))


def _wildcards_used(names: set[str], *, action: bool = False) -> tuple[str, ...]:
    """Return the wildcards in ``names``; () if it contains "", which stands for the exact name."""
    if "" in names:
        return ()
    return tuple(
        sorted({name.rpartition(ACTION_SEPARATOR)[0] or name if action else name for name in names})
    )


# ── protection ──────────────────────────────────────────────────────────────────────────


def protection_of(governance: Governance | None, kind: str, name: str) -> Protection:
    """Return the weakest protection among the DDS topics of a name, by the first domain rule.

    The result is `UNKNOWN` without a domain rule.

    The protection of whole RTPS messages protects every topic in them.  A topic without a rule
    counts as not protected: vendors refuse it.  Access counts as controlled if all domain rules
    control access to all these topics, as in `sros_tool.reach`.  Topics that are open to
    participants without an identity on any tested vendor count as not controlled.
    """
    if governance is None or not governance.domain_access_rules:
        return UNKNOWN
    domain = governance.domain_access_rules[0]
    topics = _topics_of_name(kind, name)
    protections = [
        _protection_by_rules(domain, rule) for topic in topics for rule in _rules_of(domain, topic)
    ]
    anywhere = [
        (access, rule)
        for access in governance.domain_access_rules
        for topic in topics
        for rule in _rules_of(access, topic)
    ]
    strangers = any(
        is_open_to_unauthenticated(access, rule, vendor)
        for access, rule in anywhere
        for vendor in TESTED
    )
    weakest = min(
        protections,
        key=lambda protection: _LEVEL_ORDER.index(protection.level),
        default=Protection(WireLevel.NONE),
    )
    return replace(
        weakest,
        read_control=not strangers and all(rule.enable_read_access_control for _, rule in anywhere),
        write_control=not strangers
        and all(rule.enable_write_access_control for _, rule in anywhere),
        strangers=strangers,
    )


_LEVEL_ORDER = list(WireLevel)


class _DemandedProtection:
    """The protection that a policy demands for names, for pictures without a governance."""

    def __init__(self, stated_protections: Iterable[StatedProtection]) -> None:
        topics_of: dict[WireLevel, list[str]] = defaultdict(list)
        for protection in stated_protections:
            topics = protected_topics(protection.kind, protection.name)
            topics_of[WireLevel(protection.word)] += topics
        self._names = {level: Names(topics) for level, topics in topics_of.items()}

    def protection(self, kind: str, name: str) -> Protection | None:
        """Return the weakest protection demanded for the topics of a name, or None."""
        levels = (
            [self._level_of_topic(topic) for topic in _topics_of_name(kind, name)]
            if self._names
            else []
        )
        least = min(levels, key=_LEVEL_ORDER.index, default=WireLevel.UNKNOWN)
        return None if least is WireLevel.UNKNOWN else Protection(least)

    def _level_of_topic(self, topic: str) -> WireLevel:
        covering = [level for level, names in self._names.items() if names.cover(topic)]
        return max(covering, key=_LEVEL_ORDER.index, default=WireLevel.UNKNOWN)


def _topics_of_name(kind: str, name: str) -> tuple[str, ...]:
    """Return the DDS topics of a ROS name; of kind "dds", the name is itself a topic."""
    if kind == "dds":
        return (name,)
    topics = (dds_names(right, name) for right in RIGHTS[kind])
    return tuple(
        dict.fromkeys(
            topic for endpoints in topics for topic in endpoints.publish + endpoints.subscribe
        )
    )


def _rules_of(domain: DomainRule, topic: str) -> Iterator[TopicRule]:
    """Yield the governance rule of a topic; for a wildcard, all rules that can apply."""
    for rule in domain.topic_access_rules:
        if overlap(rule.topic_expression, topic):
            yield rule
            if covers(rule.topic_expression, topic):
                return


def _protection_by_rules(domain: DomainRule, rule: TopicRule) -> Protection:
    data, metadata = rule.data_protection_kind, rule.metadata_protection_kind
    rtps = domain.rtps_protection_kind
    return Protection(
        max((_level_of_kind(kind) for kind in (data, metadata, rtps)), key=_LEVEL_ORDER.index),
        str(data),
        str(metadata),
        str(rtps),
    )


def _level_of_kind(kind: str) -> WireLevel:
    return WireLevel(str(kind).partition("_")[0].lower())
