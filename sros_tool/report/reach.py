"""What rights really reach: wildcards become the known names that they match, denials count first.

Known are the exact names that any right of any source says.  An action is told as one name; a
right to some of its parts, as a recorder has that subscribes to ``/*``, leads there all the same.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence

from sros_tool.names import is_expression
from sros_tool.policy.model import ALLOW, DENY, Qualifier
from sros_tool.policy.patterns import covers, literal_prefix, matches, overlap
from sros_tool.policy.rights import KIND_OF, Right, folded, parts, unfolded
from sros_tool.report.picture import Edge

_INSIDE = "/_action/"
_NO_ACTION = Right("", ALLOW, "call", "")
_WHOLE: dict[str, frozenset[tuple[str, str]]] = {
    right: frozenset(
        (part.right, part.name.removeprefix(_INSIDE))
        for part in parts(_NO_ACTION._replace(right=right))
    )
    for right in ("call", "execute")
}
_Found = dict[Qualifier, set[str]]


class Known:
    """The exact names that rights say: of topics and services, and which of them are actions."""

    def __init__(self, rights: Iterable[Right]) -> None:
        rights = frozenset(rights)
        found: dict[str, set[str]] = defaultdict(set)
        for part in unfolded(rights):
            if not is_expression(part.name):
                found[part.kind].add(part.name)
        self.actions = frozenset(
            each.name
            for each in folded(rights)
            if each.kind == "actions" and not is_expression(each.name)
        )
        self._names = {kind: sorted(names) for kind, names in found.items()}
        self._matched: dict[tuple[str, str], tuple[str, ...]] = {}
        self._open: dict[str, list[str]] = defaultdict(list)
        for part in sorted(unfolded(rights)):
            if is_expression(part.name) and not self.reached(part.kind, part.name):
                self._open[part.kind].append(part.name)

    def reached(self, kind: str, name: str) -> tuple[str, ...]:
        """The known topics, services or actions that a name means: itself, if it is no wildcard."""
        if not is_expression(name):
            return (name,)
        key = (kind, name)
        if key not in self._matched:
            self._matched[key] = tuple(self._matching(kind, name))
        return self._matched[key]

    def drawn(self, right: Right) -> tuple[str, ...]:
        """The names to which a right leads: known ones, and wildcards that reach none of those.

        An ALLOW leads to such a wildcard where they have names in common, a DENY where nothing
        of it is left.
        """
        if not is_expression(right.name):
            return (right.name,)
        meets = covers if right.qualifier is DENY else overlap
        wild = (each for each in self._open[right.kind] if meets(right.name, each))
        return tuple(dict.fromkeys((*self.reached(right.kind, right.name), *wild)))

    def _matching(self, kind: str, expression: str) -> Iterable[str]:
        if kind == "actions":
            return sorted(each for each in self.actions if matches(expression, each))
        names, prefix = self._names.get(kind, ()), literal_prefix(expression)
        found = []
        for name in names[bisect_left(names, prefix) :]:
            if not name.startswith(prefix):
                break
            if matches(expression, name):
                found.append(name)
        return found


def edges_of(rights: Iterable[Right], known: Known, common: Sequence[Right] = ()) -> list[Edge]:
    """Every right and denial as edges to the names that it reaches; unsorted.

    A wildcard that reaches no known name leads to a name of its own.  ``common`` are the rights
    that every node needs, of whatever enclave.
    """
    topics: dict[tuple[str, str, str, str], _Found] = defaultdict(lambda: defaultdict(set))
    for each in unfolded(rights):
        by = each.name if is_expression(each.name) else ""
        for reached in known.drawn(each):
            # A wildcard that is drawn itself is said by its own name.
            said = "" if reached == by else by
            topics[each.enclave, each.kind, each.right, reached][each.qualifier].add(said)
    whole: dict[tuple[str, str, Qualifier], dict[tuple[str, str], set[str]]] = defaultdict(dict)
    edges = []
    for (enclave, kind, right, name), found in topics.items():
        qualifier = DENY if DENY in found else ALLOW
        action, inside, part = name.rpartition(_INSIDE)
        if inside and (action in known.actions or is_expression(action)):
            whole[enclave, action, qualifier][right, part] = found[qualifier]
            continue
        edges.append(
            Edge(
                enclave,
                kind,
                name,
                right,
                qualifier,
                _by(found[qualifier]),
                common=qualifier is ALLOW and _is_common(right, name, common),
            )
        )
    for (enclave, action, qualifier), members in whole.items():
        edges += _action_edges(enclave, action, qualifier, members)
    return edges


def _action_edges(
    enclave: str,
    action: str,
    qualifier: Qualifier,
    members: dict[tuple[str, str], set[str]],
) -> Iterable[Edge]:
    """One edge for all of an action's parts, and one for each right to some of them."""
    remaining = dict(members)
    for right, needed in _WHOLE.items():
        if needed <= members.keys():
            whole = {each for part in needed for each in members[part]}
            yield Edge(enclave, "actions", action, right, qualifier, _by(whole, action=True))
            for part in needed:
                remaining.pop(part, None)
    rest: dict[str, dict[str, set[str]]] = defaultdict(dict)
    for (right, inside), names in remaining.items():
        rest[right][inside] = names
    for right, found in rest.items():
        by = _by({each for said in found.values() for each in said})
        yield Edge(enclave, "actions", action, right, qualifier, by, tuple(sorted(found)))


def _by(names: set[str], *, action: bool = False) -> tuple[str, ...]:
    """The expressions among ``names``, or none where the name is also said by itself."""
    if "" in names:
        return ()
    return tuple(
        sorted({each.rpartition(_INSIDE)[0] or each if action else each for each in names})
    )


def _is_common(right: str, name: str, common: Sequence[Right]) -> bool:
    return any(
        right == each.right and KIND_OF[right] == each.kind and matches(each.name, name)
        for each in common
    )
