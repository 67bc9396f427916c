"""Folds names that the same enclaves may use in the same way into one, which loses nothing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from sros_tool.policy.model import ALLOW, Qualifier
from sros_tool.policy.rights import RIGHT_ORDER
from sros_tool.report.picture import KINDS, SENDS, Edge, Mark, Name, Protection


@dataclass(frozen=True, slots=True, order=True)
class Tie:
    """What one enclave, or one group of them, may do with all names of a bundle."""

    node: str
    right: str
    qualifier: Qualifier
    by: tuple[str, ...]
    parts: tuple[str, ...]
    mark: Mark
    common: bool

    @property
    def sends(self) -> bool:
        """Whether the arrow leads from the enclave to the names."""
        return SENDS[self.right]


@dataclass(frozen=True, slots=True)
class Bundle:
    """Names of one kind and protection, sorted, and the ties that each of them has.

    Of a ``partial`` bundle, each tie is to some of the names only.
    """

    kind: str
    protection: Protection
    names: tuple[str, ...]
    ties: tuple[Tie, ...]
    partial: bool = False


def fold(
    names: Iterable[Name], edges: Iterable[Edge], owner: Callable[[str], str] = str
) -> tuple[Bundle, ...]:
    """The names that have an edge, in bundles, sorted by kind and first name.

    ``owner`` says what stands for an enclave: itself, or a group that it is folded into.
    """
    ties: dict[tuple[str, str], set[Tie]] = defaultdict(set)
    for edge in edges:
        ties[edge.kind, edge.name].add(
            Tie(
                owner(edge.enclave),
                edge.right,
                edge.qualifier,
                edge.by,
                edge.parts,
                edge.mark,
                edge.common,
            )
        )
    bundles: dict[tuple[str, Protection, frozenset[Tie]], list[str]] = defaultdict(list)
    for name in names:
        if found := ties.get((name.kind, name.name)):
            bundles[name.kind, name.protection, frozenset(found)].append(name.name)
    folded = (
        Bundle(kind, protection, tuple(sorted(members)), tuple(sorted(found, key=_order)))
        for (kind, protection, found), members in bundles.items()
    )
    return tuple(sorted(folded, key=lambda each: (KINDS.index(each.kind), each.names)))


def coarsened(bundles: Iterable[Bundle]) -> tuple[Bundle, ...]:
    """Bundles joined where the same nodes send, whoever listens; what is lost is who hears which.

    Denials and differences stay apart: they are what one looks for.
    """
    found: dict[tuple[object, ...], list[Bundle]] = defaultdict(list)
    for bundle in bundles:
        plain = all(t.qualifier is ALLOW and t.mark is Mark.BOTH for t in bundle.ties)
        senders = frozenset((tie.node, tie.right) for tie in bundle.ties if tie.sends)
        apart = None if plain and senders else bundle.ties
        found[bundle.kind, bundle.protection, senders, apart].append(bundle)
    return tuple(_joined(each) for each in found.values())


def _joined(bundles: Sequence[Bundle]) -> Bundle:
    ties = sorted({tie for bundle in bundles for tie in bundle.ties}, key=_order)
    names = sorted(name for bundle in bundles for name in bundle.names)
    partial = any(bundle.ties != bundles[0].ties for bundle in bundles)
    return Bundle(bundles[0].kind, bundles[0].protection, tuple(names), tuple(ties), partial)


def _order(tie: Tie) -> tuple[int, str, str, tuple[str, ...], tuple[str, ...], str, bool]:
    right = RIGHT_ORDER[tie.right]
    return right, tie.node, tie.qualifier, tie.by, tie.parts, tie.mark, tie.common
