"""Rights and denials with absolute names: reading them from policies, and comparing them.

Two documents have the same meaning if their rights in normal form are equal.  An action consists of
three services and two topics (ROS 2 design "Actions"): `split_actions` splits an action into these
parts, `join_actions` joins the parts again.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain
from typing import Annotated, NamedTuple

from sros_tool.names import (
    ACTION_PARTS,
    ACTION_SEPARATOR,
    GOAL,
    NODE_SERVICES,
    DdsNames,
    action_part,
    dds_names,
    expand,
    is_expression,
)
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    OFFERING_RIGHT,
    PEER_RIGHT,
    RIGHTS,
    Enclave,
    Group,
    Policy,
    Profile,
    Qualifier,
    Source,
)
from sros_tool.policy.patterns import ComparisonLimit, Names, covers, matches, overlap
from sros_tool.values import Words, shows
from sros_tool.wording import first_few

KIND_OF = {right: kind for kind, pair in RIGHTS.items() for right in pair}
"""Right → the kind of its names, such as topics for publish."""

KindOfName = Annotated[str, Words((*RIGHTS, "dds"))]

RIGHT_ORDER = {right: number for number, right in enumerate(KIND_OF)}
"""Right → position in lists: publish, subscribe, request, reply, call, execute."""

_ACTION_RIGHT = {"request": "call", "reply": "execute"}
"""Right to use or offer a service → the same right to a whole action."""


@shows("enclave", "qualifier", "kind", "right", "name")
class Right(NamedTuple):
    """A right or a denial of one enclave for one name.

    A name without a leading "/" is a DDS topic that is not a ROS name, which occurs only in
    permissions that sros did not write.
    """

    enclave: str
    """Path of the enclave."""
    qualifier: Qualifier
    """Whether the rule allows or denies."""
    right: Annotated[str, Words(KIND_OF)]
    """The right, as policies write it: publish, subscribe, request, reply, call or execute."""
    name: str
    """The absolute ROS name, perhaps with wildcards."""

    @property
    def kind(self) -> KindOfName:
        """Kind of the name; ``dds`` is a DDS topic without a ROS name."""
        return KIND_OF[self.right] if self.name.startswith("/") else "dds"

    @property
    def topics(self) -> DdsNames:
        """The DDS topics of the right, to publish and to subscribe, perhaps with wildcards."""
        if self.kind != "dds":
            return dds_names(self.right, self.name)
        writes = self.right == "publish"
        return DdsNames((self.name,) if writes else (), () if writes else (self.name,))

    def peer_right(self, enclave: str) -> Right:
        """Return the right that a peer enclave needs, such as subscribe for publish."""
        return self._replace(enclave=enclave, right=PEER_RIGHT[self.right])

    def __str__(self) -> str:
        """Return text such as ``/talker ALLOW publish topic /chatter``."""
        return f"{self.enclave} {self.qualifier.value} {self.describe()}"

    def describe(self) -> str:
        """Return text such as ``publish topic /chatter``."""
        item = "DDS topic" if self.kind == "dds" else self.kind.removesuffix("s")
        return f"{self.right} {item} {self.name}"


def order(right: Right) -> tuple[str, int, str, str]:
    """Return a sort key: by enclave, then kind and right, then name."""
    return right.enclave, RIGHT_ORDER[right.right], right.name, right.qualifier


GroupRights = tuple[tuple[str, Qualifier], ...]
"""The rights of a group with their qualifiers, in the order of `RIGHTS`."""


def group_rights(rights: Iterable[tuple[str, Qualifier]]) -> Iterator[GroupRights]:
    """Yield the rights of each group for a name: two groups if a right is allowed and denied."""
    ordered = sorted(rights, key=lambda right: (RIGHT_ORDER[right[0]], right[1]))
    if len({right for right, _ in ordered}) == len(ordered):
        yield tuple(ordered)
        return
    for qualifier in Qualifier:
        yield tuple(pair for pair in ordered if pair[1] is qualifier)


def policy_rights(policy: Policy) -> frozenset[Right]:
    """Return all rights in a policy, with absolute names."""
    return frozenset(
        right
        for enclave in policy.enclaves
        for profile in enclave.all_profiles()
        for right in profile_rights(enclave.path, profile)
    )


class PlacedRight(NamedTuple):
    """A right with its place in a policy; ``written`` is the name in the form of the policy."""

    right: Right
    written: str
    source: Source
    group: Group
    profile: Profile


def placed_rights(enclave: Enclave) -> Iterator[PlacedRight]:
    """Yield each right and denial of an enclave with its place, in document order."""
    for profile in enclave.all_profiles():
        for group in profile.groups:
            for index, written in enumerate(group.names):
                name, source = expand(written, profile.ns, profile.node), group.source_of(index)
                for right, qualifier in group.rights:
                    stated = Right(enclave.path, qualifier, right, name)
                    yield PlacedRight(stated, written, source, group, profile)


def profile_rights(enclave: str, profile: Profile) -> Iterator[Right]:
    """Yield the rights in a profile of an enclave, with absolute names."""
    ns, node = profile.ns, profile.node
    for group in profile.groups:
        for name in group.names:
            fqn = expand(name, ns, node)
            for right, qualifier in group.rights:
                yield Right(enclave, qualifier, right, fqn)


# ── actions and their parts ────────────────────────────────────────────────────────────────


def parts(right: Right) -> tuple[Right, ...]:
    """Return the rights to an action's five topics and services.

    For a right to anything else, the result has only this right.
    """
    part_rights = ACTION_PARTS.get(right.right)
    if part_rights is None:
        return (right,)
    return tuple(
        Right(right.enclave, right.qualifier, part, right.name + end) for part, end in part_rights
    )


def action_right(right: str, name: str) -> tuple[str, str]:
    """Return the right to an action, and its name, for a right to a part of the action.

    Other pairs of ``right`` and ``name`` are returned unchanged.  Subscriptions are also returned
    unchanged, because watching an action does not need the right to command it.
    """
    action, part = action_part(name)
    for whole, of in ACTION_PARTS.items():
        if right != "subscribe" and (right, f"{ACTION_SEPARATOR}{part}") in of:
            return whole, action
    return right, name


def split_actions(rights: Iterable[Right]) -> frozenset[Right]:
    """Return the rights with every action split into its topics and services."""
    return frozenset(part for right in rights for part in parts(right))


def join_actions(rights: Iterable[Right]) -> frozenset[Right]:
    """Return the rights in normal form: the five parts of an action are joined into one right."""
    remaining = set(split_actions(rights))
    actions = [
        Right(
            right.enclave,
            right.qualifier,
            _ACTION_RIGHT[right.right],
            right.name.removesuffix(GOAL),
        )
        for right in remaining
        if right.right in _ACTION_RIGHT and right.name.endswith(GOAL) and right.name.startswith("/")
    ]
    complete = [right for right in actions if right.name and remaining.issuperset(parts(right))]
    for right in complete:
        remaining.difference_update(parts(right))
    return frozenset(remaining.union(complete))


def goal_right(right: Right) -> Right:
    """Return the right to the service for goals, for a right to an action; else ``right``."""
    if right.kind != "actions":
        return right
    name = f"{right.name}{GOAL}"
    return next(part for part in parts(right) if part.name == name)


# ── queries ────────────────────────────────────────────────────────────────────────────────


class Rules:
    """A set of rights with fast queries: exact names by lookup, wildcards by matching."""

    def __init__(self, rights: Iterable[Right]) -> None:
        self._stated = split_actions(rights)
        names: dict[_EnclaveRight, list[str]] = defaultdict(list)
        for enclave, qualifier, right, name in sorted(self._stated):
            names[enclave, qualifier, right].append(name)
        limit = ComparisonLimit()
        self._names = {place: Names(place_names, limit) for place, place_names in names.items()}

    def cover(self, right: Right) -> bool:
        """Return whether the set covers all of ``right``, an ALLOW or a DENY."""
        return all(self._covering_right(part) for part in parts(right))

    def covering_rights(self, right: Right) -> tuple[Right, ...]:
        """Return the rights that together cover ``right``; () if part of it is not covered."""
        covering = [self._covering_right(part) for part in parts(right)]
        return tuple(dict.fromkeys(filter(None, covering))) if all(covering) else ()

    def overlaps(self, right: Right) -> bool:
        """Return whether a right of the set has a name in common with ``right``."""
        return any(self._names_of(part).overlaps(part.name) for part in parts(right))

    def overlapping(self, right: Right) -> tuple[Right, ...]:
        """Return the rights of the set that have a name in common with ``right``."""
        return tuple(
            Right(*part[:3], name)
            for part in parts(right)
            for name in self._names_of(part).overlapping(part.name)
        )

    def allow(self, enclave: str, right: str, name: str) -> bool:
        """Return whether the set allows ``name`` completely and denies no part of ``name``."""
        for part in parts(Right(enclave, ALLOW, right, name)):
            allowed = self._names.get((enclave, ALLOW, part.right))
            denied = self._names.get((enclave, DENY, part.right))
            if not allowed or not allowed.cover(part.name):
                return False
            if denied and denied.overlaps(part.name):
                return False
        return True

    def _names_of(self, part: Right) -> Names:
        return self._names.get(part[:3], _NO_NAMES)

    def _covering_right(self, part: Right) -> Right | None:
        if part in self._stated:
            return part
        wide = next(self._names_of(part).covering(part.name), None)
        return Right(*part[:3], wide) if wide else None


_NO_NAMES = Names(())
_EnclaveRight = tuple[str, Qualifier, str]


class RightsDifference(NamedTuple):
    """The rights that only one of two sides has, in normal form and sorted.

    ``covered`` maps a right to the wildcards of the other side that cover this right, unless the
    other side denies a part of it.
    """

    only_first: tuple[Right, ...]
    only_second: tuple[Right, ...]
    covered: Mapping[Right, tuple[Right, ...]]

    def __bool__(self) -> bool:
        return bool(self.only_first or self.only_second)

    def lines(self) -> list[tuple[str, Right]]:
        """Return the different rights, with "-" for the first side and "+" for the second side."""
        lines = [("-", right) for right in self.only_first] + [("+", e) for e in self.only_second]
        return sorted(lines, key=lambda line: (*order(line[1]), line[0] == "+"))

    def without(self, enclaves: Collection[str]) -> RightsDifference:
        """Return the difference without the rights of some enclaves."""
        only_first, only_second = (
            tuple(right for right in side if right.enclave not in enclaves)
            for side in (self.only_first, self.only_second)
        )
        return RightsDifference(only_first, only_second, self.covered)


def renamed_enclaves(
    first_rights: Iterable[Right], second_rights: Iterable[Right]
) -> dict[str, str]:
    """Map enclaves that only ``first_rights`` have to their new names in ``second_rights``.

    An enclave counts as renamed if an enclave that is only in ``second_rights`` has the same
    rights, and no other enclave has these rights.
    """
    before, after = (_rights_by_enclave(side) for side in (first_rights, second_rights))
    gone: dict[frozenset[Right], list[str]] = defaultdict(list)
    new: dict[frozenset[Right], list[str]] = defaultdict(list)
    for enclave in before.keys() - after.keys():
        gone[frozenset(before[enclave])].append(enclave)
    for enclave in after.keys() - before.keys():
        new[frozenset(after[enclave])].append(enclave)
    return {
        names[0]: new[rights][0]
        for rights, names in gone.items()
        if len(names) == len(new.get(rights, ())) == 1
    }


def _rights_by_enclave(rights: Iterable[Right]) -> dict[str, set[Right]]:
    """Map each enclave to its rights, in which "" replaces the path of the enclave."""
    by_enclave: dict[str, set[Right]] = defaultdict(set)
    for right in rights:
        by_enclave[right.enclave].add(right._replace(enclave=""))
    return by_enclave


def compare(
    first_rights: Iterable[Right],
    second_rights: Iterable[Right],
    scope: frozenset[str] | None = None,
) -> RightsDifference:
    """Compare two sets of rights of the enclaves in ``scope`` (None: all enclaves).

    An action counts as its services and topics.  A right that only one side states is no difference
    if it is covered by wildcards that both sides state, because large permissions leave such rights
    out.  There is one exception: if one side has a whole action that the other side lacks, the
    parts of this action that the other side states are differences, too.
    """
    first, second = (
        join_actions(right for right in side if scope is None or right.enclave in scope)
        for side in (first_rights, second_rights)
    )
    common = Rules(split_actions(first) & split_actions(second) if first != second else ())
    first_only, second_only = first - second, second - first
    gone, new = (
        {right for right in side if not common.cover(right)} for side in (first_only, second_only)
    )
    only_first, only_second = (
        tuple(sorted(rights, key=order))
        for rights in (
            gone | first_only & split_actions(new),
            new | second_only & split_actions(gone),
        )
    )
    covered: dict[Right, tuple[Right, ...]] = {}
    for rights, side in ((only_first, second), (only_second, first)):
        rules = Rules(side if rights else ())
        stated = {part: right for right in side for part in parts(right)} if rights else {}
        for right in rights:
            denied = right.qualifier is ALLOW and rules.overlaps(right._replace(qualifier=DENY))
            if not denied and (by := rules.covering_rights(right)):
                covered[right] = tuple(sorted({stated[part] for part in by}, key=order))
    return RightsDifference(only_first, only_second, covered)


# ── the nodes of an enclave ────────────────────────────────────────────────────────────────

CHANGING_NODES = (
    "transform_listener_impl_",
    "launch_ros_",
    "rqt_gui_py_node_",
    "rqt_gui_cpp_node_",
    "_ros2cli_",
    "_sros_observer_",
)
"""Beginnings of node names that end with an address or process id, which changes at every start."""
_CHANGING_NODE = re.compile(r"(?:/[^/*?\[]+)*/(?:" + "|".join(CHANGING_NODES) + r")\*")
_SERVED_BY_EVERY_NODE = frozenset(f"~/{service}" for service in NODE_SERVICES)


class NodeName(NamedTuple):
    """Namespace and name of a node, perhaps with wildcards."""

    ns: str
    name: str

    def is_within(self, wider: NodeName) -> bool:
        """Return whether ``wider`` includes all nodes that this name means."""
        in_root = (wider.ns, self.ns) == ("/*", "/")
        return covers(wider.ns, self.ns) and covers(wider.name, self.name) and not in_root

    def overlaps(self, other: NodeName) -> bool:
        """Return whether any node matches both names."""
        return overlap(self.ns, other.ns) and overlap(self.name, other.name)


def nodes_of(enclave: Enclave) -> tuple[NodeName, ...]:
    """Return the nodes of an enclave, by the profiles of its policy."""
    return tuple(dict.fromkeys(map(node_of, enclave.all_profiles())))


def nodes_not_shown(enclave: Enclave) -> tuple[NodeName, ...]:
    """Return the nodes of a policy's enclave that cannot be derived from its permissions.

    `nodes_of_rights` derives nodes from the services that every node offers, unless these services
    are denied (`denied_nodes`).
    """
    profiles = tuple(enclave.all_profiles())
    rights = {right for profile in profiles for right in profile_rights(enclave.path, profile)}
    gone = denied_nodes(rights)
    return tuple(
        dict.fromkeys(
            node
            for profile, node in ((profile, node_of(profile)) for profile in profiles)
            if not any(map(_offers_node_services, profile.groups)) or any(map(node.is_within, gone))
        )
    )


def node_of(profile: Profile) -> NodeName:
    """Return namespace and name of the node of a profile."""
    ns = profile.ns.strip("/")
    # A namespace that begins with a wildcard does not need a "/" before it.
    return NodeName(ns if ns.startswith("*") else f"/{ns}", profile.node)


def is_of_one_node(name: str) -> bool:
    """Return whether a name, such as of a service, has no wildcard in place of its node.

    Only a node of `CHANGING_NODES` has one.  With any other wildcard, an enclave can pose as nodes
    of other enclaves.
    """
    node = name.rpartition("/")[0]
    return not is_expression(node) or bool(_CHANGING_NODE.fullmatch(node))


def _offers_node_services(group: Group) -> bool:
    return ("reply", ALLOW) in group.rights and not _SERVED_BY_EVERY_NODE.isdisjoint(group.names)


def nodes_of_rights(rights: Iterable[Right]) -> tuple[NodeName, ...]:
    """Return the nodes whose standard services an enclave may offer by its rights.

    Denials are ignored; `denied_nodes` returns the nodes that denials take away.
    """
    nodes = (
        node
        for _, qualifier, right, name in rights
        if right == "reply" and qualifier is ALLOW
        for full_name in _full_names(name)
        for node in _nodes(full_name)
    )
    return tuple(dict.fromkeys(nodes))


def denied_nodes(rights: Iterable[Right]) -> tuple[NodeName, ...]:
    """Return the nodes for which rules allow standard services, and other rules deny all of them.

    Nodes that may offer any of their standard services are left out.  If a denial matches some of
    the nodes that a wildcard allows, the result has all nodes that the denial matches.
    """
    allowed: dict[str, None] = {}
    denied: dict[str, None] = {}
    for _, qualifier, right, name in rights:
        if right == "reply":
            (allowed if qualifier is ALLOW else denied)[name] = None
    if not denied:
        return ()
    offering = {
        service: Names(node for name in allowed for node in _full_names(name, service))
        for service in NODE_SERVICES
    }
    never = Names(denied)

    def offers_none(node: str) -> bool:
        return all(
            never.cover(f"{node}/{service}")
            for service, nodes in offering.items()
            if nodes.overlaps(node)
        )

    candidates = {
        node if covers(without, node) else without: None
        for service, nodes in offering.items()
        for name in denied
        for without in _texts_before(name, f"/{service}")
        for node in nodes.overlapping(without)
    }
    gone = filter(offers_none, candidates)
    return tuple(dict.fromkeys(node for full_name in gone for node in _nodes(full_name)))


def _full_names(name: str, service: str = "") -> Iterator[str]:
    """Yield the full names of nodes, perhaps with wildcards, whose standard services match a name.

    With ``service``, only nodes that offer this service by the name are returned.
    """
    node, _, last = name.rpartition("/")
    if last in NODE_SERVICES and service in ("", last):
        yield node
    if name.endswith("*"):
        yield name
        yield name.removesuffix("/*")


def _texts_before(name: str, end: str) -> Iterator[str]:
    """Yield expressions for the texts that match ``name`` after ``end`` is added."""
    if not is_expression(name):
        if name.endswith(end):
            yield name.removesuffix(end)
        return
    for at in range(1, len(name)):
        # A star can match the end of the text and the beginning of ``end``.
        if matches(name[at:], end):
            yield name[: at + 1] if name[at] == "*" else name[:at]


def _nodes(name: str) -> Iterator[NodeName]:
    """Yield the nodes whose full name matches ``name``.

    A ``*`` can also match the "/" between namespace and node name.
    """
    ns, _, last = name.rpartition("/")
    if last:
        yield NodeName(ns or "/", last)
    for at, letter in enumerate(last):
        if letter == "*":
            yield NodeName(f"{ns}/{last[: at + 1]}", last[at:])


def nodes_as_text(nodes: Iterable[NodeName]) -> str:
    """Return nodes as text for the ledger: "NAMESPACE NAME", separated by commas."""
    return ", ".join(f"{node.ns} {node.name}" for node in nodes)


def nodes_from_text(text: str) -> tuple[NodeName, ...]:
    """Parse a text that `nodes_as_text` returned."""
    pairs = (node.partition(" ") for node in text.split(", ") if node)
    return tuple(NodeName(ns, name) for ns, _, name in pairs)


def rights_without_counterpart(
    first_rights: Collection[Right],
    second_rights: Collection[Right],
    difference: RightsDifference,
    candidates: Collection[Right] | None = None,
) -> list[Right]:
    """Return the ``candidates`` whose counterpart was in ``first_rights``, and is gone.

    By default, the candidates are the ``second_rights``.

    An example is a right to subscribe to a topic that no enclave may publish any more, because the
    right to publish it is gone or denied.  Another example is a right to publish a topic to which
    no enclave may subscribe any more.  A right with a wildcard counts if no counterpart has a
    matching name.  Names that every node offers, such as its parameter services, need no
    counterpart.
    """
    reduced = [right for right in difference.only_first if right.qualifier is not DENY]
    reduced += (right for right in difference.only_second if right.qualifier is DENY)
    touched = Names.by_key((right.right, right.name) for right in reduced)
    asked = [
        right
        for right in (second_rights if candidates is None else candidates)
        if (other := PEER_RIGHT[right.right]) in touched
        and right.qualifier is not DENY
        and touched[other].overlaps(right.name)
        and (right.right in OFFERING_RIGHT or not is_of_every_node(right.name))
    ]
    if not asked:
        return []
    names = {(PEER_RIGHT[e.right], e.name) for e in asked if not is_expression(e.name)}
    before, after = _allowed_pairs(first_rights, names), _allowed_pairs(second_rights, names)
    others_before, others_after = (
        _allowed_names(side, touched) for side in (first_rights, second_rights)
    )
    lost = before - after
    lost |= {
        (other, right.name)
        for right in asked
        if is_expression(right.name)
        and right.right not in ("call", "execute")
        and others_before[other := PEER_RIGHT[right.right]].overlaps(right.name)
        and not others_after[other].overlaps(right.name)
    }
    return sorted(right for right in asked if (PEER_RIGHT[right.right], right.name) in lost)


def new_names_in_wildcards(
    first_rights: Collection[Right], second_rights: Collection[Right], difference: RightsDifference
) -> list[Right]:
    """Return the rights to new names that wildcards of both sides give without a change.

    A name is new if only ``second_rights`` have it without a wildcard.  Rights to subscribe, which
    influence no other enclave, are left out, as are rights that the enclave also has by name, and
    names that every node offers.
    """
    known = {(right.kind, right.name) for right in first_rights}
    new = {
        (right.kind, right.name)
        for right in difference.only_second
        if right.qualifier is not DENY
        and not is_expression(right.name)
        and not is_of_every_node(right.name)
    } - known
    if not new:
        return []
    kept = {*first_rights}.intersection(second_rights)
    wide: dict[tuple[str, str], list[Right]] = defaultdict(list)
    for right in kept:
        if right.qualifier is not DENY and right.right != "subscribe" and is_expression(right.name):
            wide[right.kind, right.name].append(right)
    wildcards, rules, named = Names.by_key(wide), Rules(second_rights), {*second_rights}
    reached = {
        right._replace(name=name)
        for kind, name in new
        if kind in wildcards
        for wildcard in wildcards[kind].covering(name)
        for right in wide[kind, wildcard]
        if rules.allow(right.enclave, right.right, name)
    }
    return sorted(reached - named)


def _allowed_names(rights: Iterable[Right], words: Iterable[str]) -> dict[str, Names]:
    """Map each right in ``words`` to the names for which some enclave has an ALLOW."""
    allowed = split_actions(right for right in rights if right.qualifier is not DENY)
    return {
        word: Names(sorted(right.name for right in allowed if right.right == word))
        for word in words
    }


def is_of_every_node(name: str) -> bool:
    """Return whether every node offers a name: it publishes the topic, or serves the service."""
    return name in ("/rosout", "/parameter_events") or name.rpartition("/")[2] in NODE_SERVICES


def _allowed_pairs(
    rights: Collection[Right], names: Iterable[tuple[str, str]]
) -> set[tuple[str, str]]:
    """Return the pairs (right, name) that the rights allow to at least one enclave."""
    rules, enclaves = Rules(rights), defaultdict[str, set[str]](set)
    for right in rights:
        if right.qualifier is not DENY:
            enclaves[_name_or_wildcard(right.name)].add(right.enclave)
    return {
        (word, name)
        for word, name in names
        if any(
            rules.allow(enclave, word, name)
            for enclave in chain(enclaves[_name_or_wildcard(name)], enclaves["*"])
        )
    }


def _name_or_wildcard(name: str) -> str:
    """Return a name; for a part of an action, the action's name; for a wildcard, "*"."""
    return "*" if is_expression(name) else name.partition(ACTION_SEPARATOR)[0]


def lost_counterpart_text(right: Right, when: str = "any more") -> str:
    """Return a clause on a right without a counterpart; ``when`` ends it."""
    other = PEER_RIGHT[right.right]
    other = {"reply": "serve", "subscribe": "subscribe to"}.get(other, other)
    return f"{right.enclave} may {right.right} {right.name}, but no enclave may {other} it {when}"


def lost_counterparts_text(rights: Iterable[Right], when: str = "any more") -> str:
    """Return a sentence on some rights without a counterpart; ``when`` ends each clause."""
    clauses = [lost_counterpart_text(right, when) for right in sorted(rights)]
    return f"{first_few(clauses, _MOST_SHOWN, '; ', ', and ')}."


_MOST_SHOWN = 3
