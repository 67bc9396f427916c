"""Graph tokens of rmw_zenoh: the entities that a node may announce by its rights, and their names.

A node, publisher, subscription, server or client is announced by a liveliness token
``@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME[/TOPIC/TYPE/HASH/QOS]``, in which
names have ``%`` for ``/`` (ros2/rmw_zenoh, docs/design.md).  A process removes an undeclared entity
from its graph by session, node, namespace and name, and ignores the enclave (graph_cache.cpp).  So
a rule has to check all names in a token.

A name is one chunk of a token, so in a token ``$*`` means the same as ``*`` in ROS.  A denial is
exact, too, because processes read a wildcard in a token as plain text, which is no name of a node
or topic.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from string import ascii_lowercase
from typing import NamedTuple

from sros_tool.names import NODE_SERVICES, is_expression
from sros_tool.policy.model import ALLOW
from sros_tool.policy.patterns import Names, TooManyNames, covers, listed_expressions, overlap
from sros_tool.policy.rights import CHANGING_NODES, NodeName, Right, denied_nodes, nodes_of_rights
from sros_tool.wording import first_few
from sros_tool.zenoh.access import AccessRule, AclRule, Flow, Message
from sros_tool.zenoh.key_expressions import (
    ANY_CHUNKS,
    ANY_PART,
    KeyExpressions,
    canonical,
    includes,
    names_of,
)

GRAPH = "@ros2_lv"
_NODE, _NAME = "NN", 9
_ENTITY_KIND_OF_RIGHT = {"publish": "MP", "subscribe": "MS", "reply": "SS", "request": "SC"}
"""Right → kind of entity, as in tokens, that a node with this right may announce."""
_MOST_TOKENS = 4096
"""Maximum number of key expressions for the tokens of a right of an enclave."""
_EVERY_KIND = "*"
_ANNOUNCING_MESSAGES = (Message.LIVELINESS_TOKEN,)
_ASKING_MESSAGES = (Message.LIVELINESS_QUERY, Message.DECLARE_LIVELINESS_SUBSCRIBER)
_ANY_NODE = NodeName("*", "*")
_LETTER = "[a-zA-Z0-9_]"
"""Matches any character of a ROS name."""


class AnnouncedNodes(NamedTuple):
    """The nodes that an enclave may announce: ``allowed`` without ``denied``.

    Nodes have the form of tokens: ``DOMAIN/NAMESPACE/NAME``, with ``%`` for ``/`` in names.
    """

    allowed: tuple[str, ...]
    denied: tuple[str, ...]


def announced_nodes(rules: Iterable[AccessRule], enclave: str) -> AnnouncedNodes:
    """Return the nodes that an enclave may announce by the rules from `graph_rules`."""
    nodes: dict[bool, list[str]] = {True: [], False: []}
    for rule in rules:
        if rule.messages == _ANNOUNCING_MESSAGES:
            own_chunks = [_NODE if rule.allows else _EVERY_KIND, _token_form(enclave)]
            for key in rule.key_expressions:
                chunks = key.split("/")
                if chunks[0] == GRAPH and chunks[5:7] == own_chunks:
                    nodes[rule.allows].append("/".join((chunks[1], *chunks[7:9])))
    return AnnouncedNodes(tuple(nodes[True]), tuple(nodes[False]))


def announced_names(
    rules: Iterable[AclRule], enclave: str, domain: int, right: str
) -> dict[bool, tuple[str, ...]]:
    """Map True and False to the names that rules of `graph_rules` allow and deny to an enclave.

    The names are names of topics or services, for one ``right`` in one ``domain``.
    """
    names: dict[bool, dict[str, None]] = {True: {}, False: {}}
    begin, of_right = [GRAPH, str(domain)], [_ENTITY_KIND_OF_RIGHT[right], _token_form(enclave)]
    for rule in rules:
        for key in rule.key_expressions if _ANNOUNCING_MESSAGES[0] in rule.messages else ():
            chunks = key.split("/")
            if chunks[:2] == begin and chunks[5:7] == of_right and len(chunks) > _NAME:
                names[rule.allows][_ros_name_of_chunk(chunks[_NAME])] = None
    return {allows: tuple(of) for allows, of in names.items()}


def _ros_name_of_chunk(part: str) -> str:
    """Return the ROS name for a chunk of a token, the inverse of `_token_form`."""
    return part.replace(ANY_PART, "*").replace("%", "/")


def nodes_in_rules(rules: Iterable[AccessRule], enclave: str) -> tuple[NodeName, ...]:
    """Return the nodes that rules of `graph_rules` let an enclave announce, ignoring denials."""
    nodes = map(_node_of, announced_nodes(rules, enclave).allowed)
    return tuple(dict.fromkeys(nodes))


def _node_of(chunks: str) -> NodeName:
    """Return the node for ``chunks``, which have the form DOMAIN/NAMESPACE/NAME as in tokens."""
    _, ns, name = map(_ros_name_of_chunk, chunks.split("/"))
    return NodeName(ns, name)


def graph_rules(
    enclave: str, domain: int, rights: Iterable[Right], nodes: Iterable[NodeName]
) -> Iterator[AccessRule]:
    """Yield the rules for the graph tokens of an enclave's processes.

    The processes may see all tokens.  Under the name of their own enclave, the processes may
    announce the topics and services in ``rights``, the nodes in ``nodes``, and the nodes whose own
    services (such as set_parameters) they may offer. Such a node does not count if all its own
    services are denied. If neither ``nodes`` nor ``rights`` gives a node, the processes may
    announce any node. The expression for seeing tokens is exactly the expression in the requests of
    rmw_zenoh.
    """
    rights, nodes = tuple(rights), tuple(nodes)
    offering, without = nodes_of_rights(rights), denied_nodes(rights)
    left = [node for node in offering if not any(map(node.is_within, without))]
    known = dict.fromkeys((*nodes, *left))
    tokens = _Tokens(enclave, domain, known if known or offering else [_ANY_NODE])
    allowed, denied = tokens.keys_of_rights(rights)
    # A denial is left out if it only concerns nodes in ``nodes``, which may be announced.
    denied += tokens.keys_of_nodes_and_endpoints(
        [
            denial
            for denial in without
            if any(map(denial.overlaps, left)) or not any(map(denial.overlaps, nodes))
        ]
    )
    whole_domain = f"{GRAPH}/{domain}/{ANY_CHUNKS}"
    if allowed:
        yield AccessRule(Flow.INGRESS, _ANNOUNCING_MESSAGES, allowed)
    if denied:
        yield AccessRule(Flow.INGRESS, _ANNOUNCING_MESSAGES, denied, allows=False)
    yield AccessRule(Flow.EGRESS, _ANNOUNCING_MESSAGES, (whole_domain,))
    yield AccessRule(Flow.INGRESS, _ASKING_MESSAGES, (whole_domain,))
    yield AccessRule(Flow.EGRESS, _ASKING_MESSAGES, (whole_domain,))


class _Tokens:
    """The graph tokens of an enclave in a ROS domain."""

    def __init__(self, enclave: str, domain: int, nodes: Iterable[NodeName]) -> None:
        self._begin = f"{GRAPH}/{domain}/*/*/*"
        self._enclave = _token_form(enclave)
        self._nodes = _token_names(nodes)
        self._of_names = {
            f"{'' if ns == '%' else ns}%{name}": f"{ns}/{name}"
            for ns, _, name in (place.partition("/") for place in self._nodes)
            if "*" not in ns + name
        }

    def keys_of_rights(self, rights: Iterable[Right]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return two tuples of key expressions: allowed tokens, and denied tokens among these."""
        sides: dict[bool, dict[str, dict[str, None]]] = {True: {}, False: {}}
        for _, qualifier, right, name in rights:
            sides[qualifier is ALLOW].setdefault(right, {})[name] = None
        allowed = [self._key(_NODE, node) for node in self._nodes]
        denied: list[str] = []
        for right, names in sides[True].items():
            without = dict.fromkeys(
                e
                for name in sides[False].get(right, ())
                for e in _expressions_with_only_stars(name)
            )
            stated = dict.fromkeys(
                expression for name in names for expression in _expressions_with_only_stars(name)
            )
            if without:
                never = Names(without)
                stated = {n: None for n in stated if is_expression(n) or not never.overlaps(n)}
            wild = [expression for expression in stated if is_expression(expression)]
            allowed += self._announcing_keys(right, stated)
            denied += [
                self._key(_ENTITY_KIND_OF_RIGHT[right], "*/*", part, ANY_CHUNKS)
                for name in without
                if any(overlap(wide, name) for wide in wild)
                for part in _token_chunks(name)
            ]
        return tuple(allowed), tuple(denied)

    def keys_of_nodes_and_endpoints(self, nodes: Sequence[NodeName]) -> tuple[str, ...]:
        """Return key expressions for nodes, and for all endpoints that these nodes can have."""
        named = (
            # "$*" can match nothing, but the namespace "/*" does not include the namespace "/".
            NodeName(f"/{_LETTER}*", node.name)
            if node.ns == "/*" and NodeName("/", node.name) not in nodes
            else node
            for node in nodes
        )
        return tuple(self._key(_EVERY_KIND, place, ANY_CHUNKS) for place in _token_names(named))

    def _announcing_keys(self, right: str, names: Mapping[str, None]) -> list[str]:
        """Return key expressions for the tokens of names, for each node that may use a name."""
        parts = [part for name in names for part in _token_chunks(name)]
        owners = {part: self._owner(right, part) for part in parts}
        everybody = self._nodes
        if len(everybody) * sum(not owner for owner in owners.values()) > _MOST_TOKENS:
            everybody = ("*/*",)
        return [
            self._key(_ENTITY_KIND_OF_RIGHT[right], node, part, ANY_CHUNKS)
            for part, owner in owners.items()
            for node in ((owner,) if owner else everybody)
        ]

    def _owner(self, right: str, part: str) -> str:
        """Return the node to which a service such as set_parameters belongs; "" for other names."""
        node, _, service = part.rpartition("%")
        return self._of_names.get(node, "") if right == "reply" and service in NODE_SERVICES else ""

    def _key(self, kind: str, node: str, *rest: str) -> str:
        return "/".join((self._begin, kind, self._enclave, node, *rest))


def _expressions_with_only_stars(name: str) -> list[str]:
    """Return expressions that together match ``name``, with ``*`` as their only wildcard.

    The result is empty if there would be too many.
    """
    try:
        return listed_expressions(name, _MOST_TOKENS)
    # The keys of such a name cannot be listed either, so the right is refused elsewhere.
    except TooManyNames:
        return []


def _token_chunks(name: str) -> tuple[str, ...]:
    """Return the token chunks that together match a name.

    There are two chunks if the name begins with ``*/``, because the star can match nothing.
    """
    if name.startswith("*"):
        rest = name.lstrip("*")
        return (*([_token_form(rest)] if rest.startswith("/") else []), _token_form(f"/*{rest}"))
    return (_token_form(name),)


def _token_names(nodes: Iterable[NodeName]) -> tuple[str, ...]:
    """Return the namespaces and names of nodes in the form of tokens."""
    places = (
        f"{_token_form(ns)}/{_token_form(name)}"
        for node in nodes
        for ns in _expressions_with_only_stars(node.ns)
        for name in _expressions_with_only_stars(node.name)
        if "/" not in name
    )
    return tuple(dict.fromkeys(places))


def _token_form(name: str) -> str:
    """Return a name in the form of tokens, with ``%`` for ``/``."""
    return canonical((name.replace("/", "%").replace("*", ANY_PART) or "%",))


# ── nodes of several enclaves ──────────────────────────────────────────────────────────────


class SharedNodes(NamedTuple):
    """Nodes that several enclaves may announce; these enclaves can remove each other's nodes."""

    enclaves: tuple[str, ...]
    """The enclaves that may announce all nodes in `nodes`."""
    others: tuple[str, ...]
    """Other enclaves, which may announce some of the nodes."""
    nodes: tuple[str, ...]
    """The full names of the nodes, perhaps with wildcards."""

    def __str__(self) -> str:
        """Return a clause about the first enclave: ``it may announce node /n, and so may /b``."""
        text = f"it may announce {'nodes' if len(self.nodes) > 1 else 'node'} "
        text += first_few(self.nodes, _MOST_SHOWN)
        if more := self.enclaves[1:]:
            text += f", and so may {first_few(more, _MOST_SHOWN)}"
        if self.others:
            text += f"; some of these are nodes of {first_few(self.others, _MOST_SHOWN)}, too"
        return text


_MOST_SHOWN = 6


def shared_nodes(announced: Mapping[str, AnnouncedNodes]) -> Iterator[SharedNodes]:
    """Yield the nodes that several enclaves may announce.

    ``announced`` maps each enclave to the nodes that it may announce.  Nodes with names that
    change with every start (`CHANGING_NODES`) do not count.
    """
    owners: dict[str, list[str]] = {}
    wide: dict[AnnouncedNodes, list[str]] = {}
    for enclave, (allowed, denied) in announced.items():
        lasting = [node for node in allowed if not _CHANGING_NODE.search(node)]
        never = KeyExpressions(denied)
        for node in lasting:
            if not _is_wide(node) and not never.include(node):
                owners.setdefault(node, []).append(enclave)
        if wildcards := tuple(filter(_is_wide, lasting)):
            wide.setdefault(AnnouncedNodes(wildcards, denied), []).append(enclave)
    together: dict[tuple[str, ...], list[str]] = {}
    for node, enclaves in owners.items():
        if len(enclaves) > 1:
            together.setdefault(tuple(enclaves), []).append(node)
    for enclaves_of_nodes, nodes in together.items():
        yield SharedNodes(enclaves_of_nodes, (), _full_names(nodes))
    in_order, groups = sorted(owners), list(wide.items())
    nearby = _with_the_same_beginning([nodes for nodes, _ in groups])
    already_named: dict[str, set[str]] = {}
    for number, (nodes_of_group, group) in enumerate(groups):
        other_owners = {
            owner: None
            for node in _included_nodes(nodes_of_group, in_order)
            for owner in owners[node]
            if owner not in group and owner not in already_named.get(group[0], ())
        }
        for nodes_of_other, other in (groups[later] for later in sorted(nearby.get(number, ()))):
            if _have_common(nodes_of_group, nodes_of_other):
                other_owners |= dict.fromkeys(other)
        for other_enclave in other_owners:
            already_named.setdefault(other_enclave, set()).update(group)
        if other_owners or (len(group) > 1 and _have_common(nodes_of_group, nodes_of_group)):
            yield SharedNodes(
                tuple(group), tuple(other_owners), _full_names(nodes_of_group.allowed)
            )


_CHANGING_NODE = re.compile("[/%](?:" + "|".join(CHANGING_NODES) + ")[^/]*[*]")


def _is_wide(node: str) -> bool:
    return "*" in node


def _included_nodes(nodes: AnnouncedNodes, sorted_nodes: Sequence[str]) -> Iterator[str]:
    """Yield the nodes without wildcards in ``sorted_nodes`` that are in the set ``nodes``."""
    never = KeyExpressions(nodes.denied)
    for wide in nodes.allowed:
        begin = _begin(wide)
        for node in sorted_nodes[bisect_left(sorted_nodes, begin) :]:
            if not node.startswith(begin):
                break
            if includes(wide, node) and not never.include(node):
                yield node


def _with_the_same_beginning(groups: Sequence[AnnouncedNodes]) -> Mapping[int, set[int]]:
    """Map the index of each group to the later groups whose nodes may begin with the same text."""
    begins = sorted(
        {(_begin(node), at) for at, nodes in enumerate(groups) for node in nodes.allowed}
    )
    nearby: dict[int, set[int]] = {}
    for place, (begin, at) in enumerate(begins):
        for longer, other in begins[place + 1 :]:
            if not longer.startswith(begin):
                break
            if at != other:
                nearby.setdefault(min(at, other), set()).add(max(at, other))
    return nearby


def _have_common(first: AnnouncedNodes, second: AnnouncedNodes) -> bool:
    """Return whether any node is in both groups."""
    left, right = (names_of(nodes.allowed) - names_of(nodes.denied) for nodes in (first, second))
    return not (left & right).is_empty()


def _begin(node: str) -> str:
    """Return the text of an expression before the first wildcard."""
    return node.partition("*")[0].rstrip("$")


def _full_names(nodes: Iterable[str]) -> tuple[str, ...]:
    """Return the full names of nodes, without nodes that another node's wildcards include."""
    parts = map(_node_of, nodes)
    names = dict.fromkeys("/".join((ns.rstrip("/").removeprefix("*"), name)) for ns, name in parts)
    return tuple(
        name for name in names if not any(covers(wide, name) for wide in names if wide != name)
    )


# ── an example ─────────────────────────────────────────────────────────────────────────────


def example_token(
    domain: int,
    enclave: str,
    key_expressions: Iterable[str],
    passes: Callable[[str], bool] = lambda _: True,
) -> str:
    """Return an example of an enclave's node token, preferably a token that may pass.

    A token may pass if ``key_expressions`` include the token and ``passes`` returns True for it.
    """
    begin = f"{GRAPH}/{domain}/"
    places = [
        key.split("/")[7:]
        for key in key_expressions
        if key.startswith(begin) and key.split("/")[5:7] == [_NODE, _token_form(enclave)]
    ]
    tokens = [
        "/".join(
            (
                f"{begin}zid/0/0",
                _NODE,
                _token_form(enclave),
                _example_chunk(name, ns),
                _example_chunk(name, node),
            )
        )
        for name in ("node", *ascii_lowercase)
        for ns, node in places or [["%", "node"]]
    ]
    return next(filter(passes, tokens), tokens[0])


def _example_chunk(name: str, part: str) -> str:
    """Return an example for a chunk of a token's key expression.

    The example is ``name`` if the chunk ``part`` is only a wildcard; otherwise it is the chunk
    without its wildcards.
    """
    return name if part == "*" else part.replace(ANY_PART, "")
