"""Translation of ROS policies to access control of Zenoh: never more rights, and none lost.

The second translation next to `translate`.  Key expressions, messages and tokens are those of
rmw_zenoh (ros2/rmw_zenoh, docs/design.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product

from sros_tool.errors import PolicyError
from sros_tool.names import expand, expression_problem
from sros_tool.policy.model import ALLOW, Enclave, Source
from sros_tool.policy.patterns import covers, overlap
from sros_tool.policy.rights import Right, parts
from sros_tool.zenoh.access import (
    AccessControl,
    AccessRule,
    Flow,
    Message,
    RemoteRights,
    joined,
)
from sros_tool.zenoh.key_expressions import ANY_CHUNKS, ANY_PART, canonical

_ANY_TYPE = ("*", "*")
"""The type and its hash, with which the keys of topics and services end: rules do not check it."""
_ADVANCED = ("@adv", ANY_CHUNKS)
"""What belongs to a topic with history (TRANSIENT_LOCAL), below its key."""
_GRAPH = "@ros2_lv"
_MOST_NAMES = 64
"""Most names that a set of characters in a name is listed as."""

_M = Message
_IN, _OUT = Flow.INGRESS, Flow.EGRESS
_DATA, _HISTORY = False, True
_ASKED = (_M.DECLARE_SUBSCRIBER, _M.QUERY, _M.DECLARE_LIVELINESS_SUBSCRIBER)
_OFFERED = (_M.PUT, _M.DECLARE_QUERYABLE, _M.LIVELINESS_TOKEN)
_MESSAGES: dict[str, tuple[tuple[Flow, tuple[Message, ...], bool], ...]] = {
    "publish": (
        (_IN, (_M.PUT, _M.DELETE, _M.REPLY), _DATA),
        (_OUT, (_M.DECLARE_SUBSCRIBER,), _DATA),
        (_IN, _OFFERED, _HISTORY),
        (_OUT, _ASKED, _HISTORY),
    ),
    "subscribe": (
        (_IN, (_M.DECLARE_SUBSCRIBER,), _DATA),
        (_OUT, (_M.PUT, _M.DELETE, _M.REPLY), _DATA),
        (_IN, _ASKED, _HISTORY),
        (_OUT, _OFFERED, _HISTORY),
    ),
    "request": (
        (_IN, (_M.QUERY,), _DATA),
        (_OUT, (_M.REPLY, _M.DECLARE_QUERYABLE), _DATA),
    ),
    "reply": (
        (_IN, (_M.REPLY, _M.DECLARE_QUERYABLE), _DATA),
        (_OUT, (_M.QUERY,), _DATA),
    ),
}
"""The messages of each right, as seen from a process to which the enclave that has it connects.

Each on the key of the name, or on the keys of its history below.
"""


@dataclass(frozen=True, slots=True)
class StatedRight:
    """A right to one topic or service, or its denial, and where the policy states it."""

    right: Right
    source: Source


def stated_rights(enclave: Enclave) -> tuple[StatedRight, ...]:
    """Return the rights of an enclave with absolute names, each action as its parts."""
    return tuple(
        StatedRight(part, group.source_of(index))
        for profile in enclave.all_profiles()
        for group in profile.groups
        for index, name in enumerate(group.names)
        for right, qualifier in group.rights
        for part in parts(
            Right(enclave.path, qualifier, right, expand(name, profile.ns, profile.node))
        )
    )


def remote_rights(enclave: Enclave, domain: int) -> RemoteRights:
    """Return what a process allows to processes of ``enclave`` in a ROS domain: `remote_of`."""
    return remote_of(enclave.path, {domain: stated_rights(enclave)})


def remote_of(enclave: str, stated: Mapping[int, Iterable[StatedRight]]) -> RemoteRights:
    """Return what a process allows to processes of an enclave with rights ``stated`` by ROS domain.

    That includes the graph, which every node needs: to announce nodes, topics and services under
    the name of its own enclave, and to see those of all others.

    Raises:
        PolicyError: a right is one that rules of Zenoh cannot state; the text names the place.
    """
    rules: list[AccessRule] = []
    for domain, rights in stated.items():
        rules += _graph_rules(enclave, domain)
        for right, name in _allowed_names(rights):
            for chunks in chunks_of(name):
                key = canonical((str(domain), *chunks, *_ANY_TYPE))
                history = canonical((str(domain), *chunks, *_ANY_TYPE, *_ADVANCED))
                rules += [
                    AccessRule(flow, messages, (history if below else key,))
                    for flow, messages, below in _MESSAGES[right]
                ]
    return RemoteRights(enclave, joined(rules))


def _graph_rules(enclave: str, domain: int) -> Iterator[AccessRule]:
    """Yield the rules for liveliness tokens: a token names the enclave, and nobody else's passes.

    The right to ask has to be for exactly the expression that rmw_zenoh asks for.
    """
    everything = f"{_GRAPH}/{domain}/**"
    # Session, node, number of the entity, kind; then the enclave, with % for each slash.
    own = f"{_GRAPH}/{domain}/*/*/*/*/{enclave.replace('/', '%')}/**"
    yield AccessRule(_IN, (_M.LIVELINESS_TOKEN,), (own,))
    yield AccessRule(_OUT, (_M.LIVELINESS_TOKEN,), (everything,))
    asking = (_M.LIVELINESS_QUERY, _M.DECLARE_LIVELINESS_SUBSCRIBER)
    yield AccessRule(_IN, asking, (everything,))
    yield AccessRule(_OUT, asking, (everything,))


def domains_of(control: AccessControl) -> set[int]:
    """Return the ROS domains in which rules let processes ask for the graph, as every node does."""
    asked = {
        tuple(key.split("/"))
        for remote in control.remotes
        for rule in remote.rules
        if _M.LIVELINESS_QUERY in rule.messages
        for key in rule.key_expressions
    }
    return {int(key[1]) for key in asked if len(key) == 3 and key[1].isdecimal()}


def control_of_router(remotes: Mapping[str, RemoteRights]) -> AccessControl:
    """Return what the router enforces: the rights of every enclave, by the enclave's name."""
    return AccessControl(tuple(remotes[each] for each in sorted(remotes)))


def control_of_session(
    enclave: str, router: str, remotes: Mapping[str, RemoteRights], *, direct: bool
) -> AccessControl:
    """Return what a process of ``enclave`` enforces.

    The enclave ``router`` may send and get what the enclave itself may get and send: it passes on
    what others said.  With ``direct`` connections, every other enclave has its own rights, too.
    """
    own = tuple(each.mirrored() for each in remotes[enclave].rules)
    known = dict(remotes) if direct else {}
    known[router] = RemoteRights(router, joined(own))
    return AccessControl(tuple(known[each] for each in sorted(known)))


# ── names and denials ──────────────────────────────────────────────────────────────────────


def _allowed_names(stated: Iterable[StatedRight]) -> Iterator[tuple[str, str]]:
    """Yield each allowed right with its name, in order, after the denials were taken away.

    Raises:
        PolicyError: a denial takes away a part of a name with wildcards, or a name cannot be said.
    """
    allowed: dict[tuple[str, str], Source] = {}
    denied: dict[str, dict[str, Source]] = {}
    for each in stated:
        if each.right.qualifier is ALLOW:
            allowed.setdefault((each.right.right, each.right.name), each.source)
        else:
            denied.setdefault(each.right.right, {}).setdefault(each.right.name, each.source)
    for (right, wide), place in sorted(allowed.items()):
        for name in _listed_names(wide, place):
            without = denied.get(right, {})
            if any(name == each or covers(each, name) for each in without):
                continue
            for other, source in without.items():
                if overlap(other, name):
                    raise _exception_in_wildcard(right, name, place, other, source)
            yield right, name


def _exception_in_wildcard(
    right: str, name: str, place: Source, denied: str, source: Source
) -> PolicyError:
    where = f"line {place.line} of '{place.file}' allows" if place.line else "they allow"
    return PolicyError(
        f"{source}: DENY {right} {denied} cannot be said to Zenoh, because {where} {name}",
        "A denial inside a wildcard does not hold in Zenoh: it lets through whoever asks or "
        "publishes with a wildcard.",
        f"List the names to {right} in place of {name}.",
    )


def _listed_names(name: str, place: Source) -> list[str]:
    """Return the names of an expression without its sets of characters: one for each choice.

    Raises:
        PolicyError: it has a ``?`` or a set that excludes, or there would be more than 64 names.
    """
    pieces: list[list[str]] = []
    rest = name
    while rest:
        begin, bracket, after = rest.partition("[")
        members, _, rest = after.partition("]")
        pieces.append([begin])
        if bracket:
            if members.startswith("!"):
                raise _cannot_be_said(name, place)
            pieces.append(sorted(_members(members)))
    if "?" in "".join(each for piece in pieces for each in piece):
        raise _cannot_be_said(name, place)
    count = 1
    for piece in pieces:
        count *= len(piece)
    if count > _MOST_NAMES:
        raise _cannot_be_said(name, place)
    names = ["".join(each) for each in product(*pieces)]
    # A choice such as "/" next to another one is no name of ROS, so nothing is lost.
    return [each for each in names if each == name or not expression_problem(each)]


def _members(text: str) -> set[str]:
    found: set[str] = set()
    at = 0
    while at < len(text):
        if text[at + 1 : at + 2] == "-" and at + 2 < len(text):
            found |= set(map(chr, range(ord(text[at]), ord(text[at + 2]) + 1)))
            at += 3
        else:
            found.add(text[at])
            at += 1
    return found


def _cannot_be_said(name: str, place: Source) -> PolicyError:
    return PolicyError(
        f"{place}: the name {name} cannot be said to Zenoh",
        "A key expression of Zenoh has no '?' and no set of characters, and sets are listed as at "
        f"most {_MOST_NAMES} names.",
        "List the names, or use '*'.",
    )


def chunks_of(name: str) -> list[tuple[str, ...]]:
    """Return the chunks of the key expressions that together match the ROS names of ``name``.

    ``name`` is absolute, with ``*`` as its only wildcard.  A ``*`` of a policy also matches "/", so
    it becomes ``**`` where it stands next to a slash, and two expressions within a part of a name.
    """
    while "**" in name:
        name = name.replace("**", "*")
    if name.startswith("*"):  # a namespace with a wildcard: the star may also stand for nothing
        rest = name[1:]
        return (chunks_of(rest) if rest.startswith("/") else []) + chunks_of(f"/{name}")
    found: list[list[str]] = [[]]
    for begin, *others in (part.split("*") for part in name[1:].split("/")):
        found = [before + each for before in found for each in _chunks_of_part([begin, *others])]
    return [tuple(canonical(each).split("/")) for each in found]


def _chunks_of_part(texts: list[str]) -> list[list[str]]:
    """Return the chunks for one part of a name, whose stars stand between ``texts``."""
    if texts == ["", ""]:
        return [["*", ANY_CHUNKS]]
    first, *others = texts
    found: list[list[str]] = [[first]]
    for number, text in enumerate(others):
        if number == 0 and not first:
            found = [[ANY_CHUNKS, ANY_PART + text]]
        elif number == len(others) - 1 and not text:
            found = [[*each[:-1], each[-1] + ANY_PART, ANY_CHUNKS] for each in found]
        else:
            within = [[*each[:-1], each[-1] + ANY_PART + text] for each in found]
            across = [
                [*each[:-1], each[-1] + ANY_PART, ANY_CHUNKS, ANY_PART + text] for each in found
            ]
            found = within + across
    return found
