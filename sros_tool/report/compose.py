"""Composes a picture of one source, or of two laid over each other; nothing here reads a file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from sros_tool.dds.governance import Governance
from sros_tool.names import is_expression
from sros_tool.policy.diff import compare
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import RIGHT_ORDER, Right, folded, order
from sros_tool.report.picture import (
    Difference,
    Edge,
    Enclave,
    Finding,
    Mark,
    Name,
    Origin,
    Overlay,
    Picture,
    Statement,
    Validity,
)
from sros_tool.report.protection import protection_of
from sros_tool.report.reach import Known, edges_of

OVERLAYS = {
    "use": Overlay("use", "allowed, never observed", "observed, not allowed"),
    "change": Overlay("change", "removed", "added"),
    "drift": Overlay("drift", "only in the policy", "only in what was signed"),
}
"""What two sources mean together, by what was laid over what."""


@dataclass(frozen=True, slots=True)
class Source:
    """What was read of one source.

    ``nodes`` are the nodes of each enclave, ``enclaves`` what is known of their certificates;
    ``scope`` are the enclaves of which the source can speak, None for all.
    """

    origin: Origin
    rights: frozenset[Right]
    nodes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    enclaves: tuple[Enclave, ...] = ()
    governance: Governance | None = None
    validities: tuple[Validity, ...] = ()
    findings: tuple[Finding, ...] = ()
    scope: frozenset[str] | None = None


@dataclass(frozen=True, slots=True)
class Context:
    """What is known beside the sources.

    ``common`` are the rights that every node needs; ``hosts`` says which host an enclave runs on,
    by the enclave or by the namespace that it is in.
    """

    common: Sequence[Right] = ()
    hosts: Mapping[str, str] = field(default_factory=dict)


def compose(first: Source, context: Context = Context()) -> Picture:
    """The picture of one source."""
    known = Known(first.rights)
    edges = edges_of(first.rights, known, context.common)
    stated = dict.fromkeys(folded(first.rights), Mark.BOTH)
    return _picture((first,), edges, stated, known, context)


def union(sources: Sequence[Source]) -> Source:
    """Several observations as one source."""
    nodes: dict[str, set[str]] = defaultdict(set)
    for source in sources:
        for path, found in source.nodes.items():
            nodes[path].update(found)
    title = " and ".join(source.origin.title for source in sources)
    return Source(
        Origin(title, "observation"),
        frozenset(right for source in sources for right in source.rights),
        {path: tuple(sorted(found)) for path, found in nodes.items()},
        findings=tuple(each for source in sources for each in source.findings),
    )


def overlay(first: Source, second: Source, kind: str, context: Context = Context()) -> Picture:
    """The picture of two sources; ``kind`` is a key of `OVERLAYS`."""
    scope = first.scope if second.scope is None else second.scope
    rights = [
        frozenset(each for each in side.rights if scope is None or each.enclave in scope)
        for side in (first, second)
    ]
    known = Known(rights[0] | rights[1])
    sides = [edges_of(each, known, context.common) for each in rights]
    edges = _marked(*sides, allowed_by=kind == "use")
    normal = [folded(each) for each in rights]
    stated = {
        right: Mark.BOTH
        if right in normal[0] and right in normal[1]
        else (Mark.FIRST if right in normal[0] else Mark.SECOND)
        for right in normal[0] | normal[1]
    }
    unseen: frozenset[str] = frozenset()
    if kind == "use":
        unseen = frozenset(each.enclave for each in rights[0] - rights[1])
        unseen -= {each.enclave for each in rights[1]}
        edges = [_neutral(edge, unseen) for edge in edges]
    picture = _picture((first, second), edges, stated, known, context)
    return replace(
        picture,
        overlay=OVERLAYS[kind],
        differences=_unused(edges) if kind == "use" else _changed(*rights),
        enclaves=tuple(replace(e, observed=e.path not in unseen) for e in picture.enclaves),
    )


def _picture(
    sources: Sequence[Source],
    edges: Iterable[Edge],
    stated: Mapping[Right, Mark],
    known: Known,
    context: Context,
) -> Picture:
    edges = tuple(sorted(edges, key=_edge_order))
    governance = next((each.governance for each in reversed(sources) if each.governance), None)
    names = sorted({(edge.kind, edge.name) for edge in edges})
    return Picture(
        title=" and ".join(each.origin.title for each in sources),
        origins=tuple(each.origin for each in sources),
        enclaves=_enclaves(sources, stated, known, context),
        names=tuple(
            Name(
                kind,
                name,
                namespace_of(name),
                protection_of(governance, kind, name),
                is_expression(name),
            )
            for kind, name in names
        ),
        edges=edges,
        validities=tuple(sorted({each for source in sources for each in source.validities})),
        findings=tuple(dict.fromkeys(each for source in sources for each in source.findings)),
    )


def _edge_order(edge: Edge) -> tuple[str, int, str, str, tuple[str, ...], str]:
    right = RIGHT_ORDER[edge.right]
    return edge.enclave, right, edge.name, edge.qualifier, edge.parts, edge.mark


def namespace_of(name: str) -> str:
    """The namespace of a name: what stands before its last part."""
    return name.rpartition("/")[0] or "/"


def group_of(enclave: str, hosts: Mapping[str, str]) -> str:
    """The host of an enclave where it is known, else the namespace that the enclave is in."""
    place = enclave
    while place:
        if place in hosts:
            return hosts[place]
        place = place.rpartition("/")[0]
    return hosts.get("/", namespace_of(enclave))


# ── enclaves ───────────────────────────────────────────────────────────────────────────────


def _enclaves(
    sources: Sequence[Source], stated: Mapping[Right, Mark], known: Known, context: Context
) -> tuple[Enclave, ...]:
    described = {each.path: each for source in sources for each in source.enclaves}
    statements: dict[str, list[Statement]] = defaultdict(list)
    for right in sorted(stated, key=order):
        reaches = len(known.reached(right.kind, right.name))
        statements[right.enclave].append(
            Statement(right.qualifier, right.right, right.kind, right.name, reaches, stated[right])
        )
    nodes: dict[str, set[str]] = defaultdict(set)
    for source in sources:
        for path, found in source.nodes.items():
            nodes[path].update(found)
    return tuple(
        replace(
            described.get(path, Enclave(path, "")),
            group=group_of(path, context.hosts),
            nodes=tuple(sorted(nodes.get(path, ()))),
            statements=tuple(statements.get(path, ())),
        )
        for path in sorted({*described, *statements, *nodes})
    )


# ── one over the other ─────────────────────────────────────────────────────────────────────


def _marked(first: Iterable[Edge], second: Iterable[Edge], *, allowed_by: bool) -> list[Edge]:
    """The edges of both sides, each with where it stands.

    What both have is reached by a wildcard only if both say so; with ``allowed_by``, if the first
    does: what was observed always has a name of its own.
    """
    sides = [{_identity(edge): edge for edge in side} for side in (first, second)]
    found = []
    for key in {**sides[0], **sides[1]}:
        one, other = sides[0].get(key), sides[1].get(key)
        if one and other:
            both = tuple(sorted({*one.by, *other.by})) if one.by and other.by else ()
            found.append(one if allowed_by else replace(one, by=both))
        elif one:
            found.append(replace(one, mark=Mark.FIRST))
        elif other:
            found.append(replace(other, mark=Mark.SECOND))
    return found


def _neutral(edge: Edge, unseen: frozenset[str]) -> Edge:
    """A denial is never observed, and of an enclave that was not observed nothing is known."""
    neutral = edge.qualifier is not ALLOW or edge.enclave in unseen
    return replace(edge, mark=Mark.BOTH) if neutral else edge


def _identity(edge: Edge) -> tuple[object, ...]:
    return edge.enclave, edge.kind, edge.name, edge.right, edge.qualifier, edge.parts


def _changed(first: frozenset[Right], second: frozenset[Right]) -> tuple[Difference, ...]:
    difference = compare(first, second)
    return tuple(
        Difference(
            Mark.FIRST if sign == "-" else Mark.SECOND,
            str(right),
            tuple(
                f"the other has it by {each.told()}" for each in difference.covered.get(right, ())
            ),
        )
        for sign, right in difference.lines()
    )


def _unused(edges: Iterable[Edge]) -> tuple[Difference, ...]:
    """What was allowed and never observed, without what every node needs; and the other way.

    What wildcards reach is counted: a recorder of everything would fill pages.
    """
    found: dict[tuple[Mark, Right], tuple[str, ...]] = {}
    reached: dict[Right, list[bool]] = defaultdict(list)
    for edge in sorted(edges, key=_edge_order):
        for name in edge.by:
            right = Right(edge.enclave, edge.qualifier, edge.right, name)
            reached[right].append(edge.mark is Mark.FIRST and not edge.common)
        if edge.mark is not Mark.BOTH and not edge.common and not edge.by:
            right = Right(edge.enclave, edge.qualifier, edge.right, edge.name)
            found[edge.mark, right] = ()
    for right, unused in reached.items():
        if any(unused):
            told = f"{sum(unused)} of the {len(unused)} names that it reaches were never observed"
            found[Mark.FIRST, right] = (told,)
    return tuple(
        Difference(mark, str(right), notes)
        for (mark, right), notes in sorted(found.items(), key=lambda each: order(each[0][1]))
    )
