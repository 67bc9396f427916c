"""Translation between ROS policies and Zenoh access control, without adding or losing rights.

`translate` does the same for DDS. Key expressions, messages and tokens are as in rmw_zenoh
(ros2/rmw_zenoh, docs/design.md). `rights_in_rules` reads the rules that sros writes. For other
rules, the result can be too wide, because a ROS ``*`` also matches slashes, but is never too
narrow. `rights_of_subjects` reads rules that sros did not write: a name is in the result only if
the rules allow every key of this name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import NamedTuple

from sros_tool.errors import DocumentError, InvalidNameError, PolicyError
from sros_tool.names import check_enclave_name, expression_problem, is_expression
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    RIGHTS,
    Enclave,
    Group,
    Policy,
    Profile,
    Profiles,
    Source,
)
from sros_tool.policy.patterns import (
    ComparisonLimit,
    Names,
    TooManyNames,
    covers,
    listed_expressions,
    overlap,
)
from sros_tool.policy.rights import (
    KIND_OF,
    RIGHT_ORDER,
    NodeName,
    Right,
    join_actions,
    nodes_of,
    parts,
    placed_rights,
)
from sros_tool.translate_zenoh.graph import announced_names, graph_rules
from sros_tool.zenoh.access import (
    AccessControl,
    AccessRule,
    AclRule,
    AclSubject,
    Enforcement,
    Flow,
    Message,
    RemoteRights,
    joined,
)
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.document import ConfigurationDocument
from sros_tool.zenoh.key_expressions import ANY_CHUNKS, ANY_PART, canonical, includes, intersects
from sros_tool.zenoh.releases import RELEASES
from sros_tool.zenoh.subtraction import (
    MOST_EXPRESSIONS,
    CannotSubtract,
    Chunks,
    Difference,
    subtract_all,
)

_TYPE = ("$*::$*", "*")
"""The type and its hash at the end of the keys of topics and services, which rules do not check.

Every type contains "::", which no part of a ROS name contains.  So a wildcard in a name never
matches a part of the type, and keys below the key of a name are never keys of another name.
"""
_IN_TYPES = "::"
_UNTYPED = ("*", "*")
"""The type and its hash in rules that sros did not write."""
ANY_TYPE = "any::type/hash"
"""An example of a type and its hash; the rules of sros decide alike for all types."""
_BELOW_TOPICS = (ANY_CHUNKS,) if any(release.below_topics for release in RELEASES) else ()
_CHUNKS_BELOW = {"publish": _BELOW_TOPICS, "subscribe": _BELOW_TOPICS}
"""Right → chunks that a release of rmw_zenoh adds to the keys of the right."""
_ADVANCED = f"@adv/{ANY_CHUNKS}"
"""The end of the keys for the history of a topic (TRANSIENT_LOCAL), below the topic's key."""
_M = Message
_IN, _OUT = Flow.INGRESS, Flow.EGRESS
_DATA, _HISTORY = False, True
_ASKED_MESSAGES = (_M.DECLARE_SUBSCRIBER, _M.QUERY, _M.DECLARE_LIVELINESS_SUBSCRIBER)
_OFFERED_MESSAGES = (_M.PUT, _M.DECLARE_QUERYABLE, _M.LIVELINESS_TOKEN)
_MESSAGES: dict[str, tuple[tuple[Flow, tuple[Message, ...], bool], ...]] = {
    "publish": (
        (_IN, (_M.PUT, _M.DELETE, _M.REPLY), _DATA),
        (_OUT, (_M.DECLARE_SUBSCRIBER,), _DATA),
        (_IN, _OFFERED_MESSAGES, _HISTORY),
        (_OUT, _ASKED_MESSAGES, _HISTORY),
    ),
    "subscribe": (
        (_IN, (_M.DECLARE_SUBSCRIBER,), _DATA),
        (_OUT, (_M.PUT, _M.DELETE, _M.REPLY), _DATA),
        (_IN, _ASKED_MESSAGES, _HISTORY),
        (_OUT, _OFFERED_MESSAGES, _HISTORY),
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
"""The messages of each right, from the view of the process that enforces the right.

The messages are on the key of the name, or with `_HISTORY`, on the keys of its history.
"""


class StatedRight(NamedTuple):
    """A right to a topic or service, or a denial, with the place that states it."""

    right: Right
    source: Source


def stated_rights(enclave: Enclave) -> tuple[StatedRight, ...]:
    """Return the rights of an enclave with absolute names, and with actions split into their parts.

    The parts of an action are its topics and services.
    """
    return tuple(
        StatedRight(part, placed.source)
        for placed in placed_rights(enclave)
        for part in parts(placed.right)
    )


def remote_rights(enclave: Enclave, domain: int) -> RemoteRights:
    """Return the rights that a process gives to the processes of ``enclave`` in a ROS domain.

    `remote_of` does the same for several domains.
    """
    return remote_of(enclave.path, {domain: stated_rights(enclave)}, nodes_of(enclave))


def remote_of(
    enclave: str,
    stated_rights: Mapping[int, Sequence[StatedRight]],
    nodes: Collection[NodeName] = (),
) -> RemoteRights:
    """Return the rights that every process gives to the processes of an enclave.

    ``stated_rights`` maps ROS domains to the enclave's rights.  ``nodes`` are nodes that the
    enclave may announce (`graph_rules`).  The result includes the graph tokens, which every node
    needs.

    Raises:
        PolicyError: Zenoh rules cannot express a right; the error names the place of the right.
    """
    rules: list[AccessRule] = []
    differences: dict[tuple[Flow, tuple[Message, ...]], list[Difference]] = {}
    for domain, rights in stated_rights.items():
        of_names = [named.right for named in rights]
        rules += graph_rules(enclave, domain, of_names, nodes)
        for right, keys, difference in _allowed_keys(domain, rights):
            below = tuple([f"{key}/{_ADVANCED}" for key in keys])
            for flow, messages, history in _MESSAGES[right] if keys else ():
                rules.append(AccessRule(flow, messages, below if history else keys))
                if difference:
                    of = difference.keys_below(_ADVANCED) if history else difference
                    differences.setdefault((flow, messages), []).append(of)
    return RemoteRights(
        enclave, joined(rules), {place: tuple(of) for place, of in differences.items()}
    )


def domains_of(control: AccessControl) -> set[int]:
    """Return the ROS domains in which processes may ask for graph tokens, as all nodes do."""
    asked = {
        tuple(key.split("/"))
        for remote in control.remotes
        for rule in remote.rules
        if _M.LIVELINESS_QUERY in rule.messages
        for key in rule.key_expressions
    }
    return {int(key[1]) for key in asked if len(key) == 3 and key[1].isdecimal()}


def stated_names(rules: Iterable[AccessRule]) -> list[tuple[str, str]]:
    """Return the sorted pairs (right, name) that are stated by rules which `remote_of` made.

    Names with wildcards have the form of Zenoh.
    """
    marks = {of[0][:2]: right for right, of in _MESSAGES.items()}
    return sorted(
        {
            (marks[rule.flow, rule.messages], _name_in(key))
            for rule in rules
            if (rule.flow, rule.messages) in marks
            for key in rule.key_expressions
        }
    )


def _name_in(key: str) -> str:
    """Return the name in the key expression of a right, without domain, type and hash."""
    chunks = untyped(key).split("/")[1:]
    # In canonical form, "**" for what is below stands after type and hash.
    last = chunks[-1:] if chunks[-1] == ANY_CHUNKS else []
    name = chunks[: len(chunks) - len(last) - len(_UNTYPED)]
    return "/".join(["", *name, *last])


def untyped(key: str) -> str:
    """Return the key expression of a right in the form of other tools, with wildcards for the type.

    A part below the key of the topic is left out.
    """
    for below in ((), (ANY_CHUNKS,)):
        end = "/".join(("", *_TYPE, *below))
        if key.endswith(end):
            return canonical((*key.removesuffix(end).split("/"), *_UNTYPED))
    return key


def rights_given_to_router(router: str, own_rights: RemoteRights) -> RemoteRights:
    """Return the rights that a process with ``own_rights`` gives to its router.

    A router forwards messages, so it may send what the process may receive, and receive what the
    process may send.
    """
    return own_rights.mirrored(router)


def crossing_rules(names: Iterable[str], domains: Iterable[int]) -> tuple[AccessRule, ...]:
    """Return rules that allow all messages about topics and services with these names."""
    place = Source("crossing", 0)
    rights = [
        StatedRight(Right("", ALLOW, right, name), place)
        for name in names
        for of in (RIGHTS["topics"], RIGHTS["services"])
        for right in of
    ]
    return remote_of("/", dict.fromkeys(domains, rights)).rules


# ── names and denials ──────────────────────────────────────────────────────────────────────


_EXACT_NAMES = re.compile(r"(?:/[^/#$*?\[]+)+")
"""Matches absolute names without wildcards, single or joined, that are valid as Zenoh keys."""
_NO_KEY = re.compile(r"[#$]|//|/\Z")
"""Matches text that Zenoh keys must not contain."""


def _allowed_keys(
    domain: int, stated_rights: Iterable[StatedRight]
) -> Iterator[tuple[str, tuple[str, ...], Difference | None]]:
    """Yield each right with its allowed key expressions, and the same keys as a `Difference`.

    The key expressions leave out denied names.  The difference is None if no name has wildcards.

    Raises:
        PolicyError: Zenoh cannot express a name, or a name without its denied part.
    """
    allowed: dict[str, dict[str, Source]] = {}
    denied: dict[str, dict[str, Source]] = {}
    for (_, qualifier, right, name), source in stated_rights:
        side = allowed if qualifier is ALLOW else denied
        side.setdefault(right, {}).setdefault(name, source)
    for right, places in sorted(allowed.items()):
        end = "/".join(("", *_TYPE, *_CHUNKS_BELOW.get(right, ())))
        never = denied.get(right, {})
        if not never and _EXACT_NAMES.fullmatch("".join(places)):
            yield right, tuple([f"{domain}{name}{end}" for name in places]), None
            continue
        for name, place in (*places.items(), *never.items()):
            if _NO_KEY.search(name):
                raise _untranslatable_name_error(name, place)
        denials = Names(never)
        exact = {
            tuple(name[1:].split("/"))
            for name in places
            if not is_expression(name) and not denials.overlaps(name)
        }
        wild = {name: place for name, place in places.items() if is_expression(name)}
        difference = Difference(str(domain), end, _chunks_of_names(wild), _chunks_of_names(never))
        names = _with_keys_below(exact | _names_of(difference, right, wild, never))
        keys = tuple([canonical((str(domain), *name)) + end for name in names])
        # Exact names that are now part of a wildcard's expression also belong to the difference.
        full_difference = difference._replace(allowed=difference.allowed | exact.difference(names))
        yield right, keys, full_difference if wild else None


def _chunks_of_names(places: Mapping[str, Source]) -> frozenset[Chunks]:
    """Return the chunks of the key expressions that match the names in ``places``."""
    return frozenset(
        chunks
        for name, place in places.items()
        for listed_name in _names_of_expression(name, place)
        for chunks in chunks_of(listed_name)
    )


def _names_of(
    difference: Difference, right: str, allowed: Mapping[str, Source], denied: Mapping[str, Source]
) -> frozenset[Chunks]:
    """Return the names in a difference, as chunks of key expressions.

    ``allowed`` and ``denied`` map the difference's names to the places that state them, for errors.

    Raises:
        PolicyError: the names cannot be expressed, or take more than `MOST_EXPRESSIONS`.
    """
    try:
        return difference.names()
    except CannotSubtract:
        pass
    for (wide, place), (name, denying) in product(sorted(allowed.items()), sorted(denied.items())):
        try:
            subtract_all(_chunks_of_names({wide: place}), _chunks_of_names({name: denying}))
        except CannotSubtract as error:
            if error.denied:
                why = "for text between two wildcards there is no such list"
                raise _untranslatable_denial_error(right, name, denying, wide, place, why) from None
    why = f"that takes more than {MOST_EXPRESSIONS} key expressions here"
    wide, place = min(allowed.items(), key=lambda item: (len(item[0]), item[0]))
    for name, denying in denied.items():
        if overlap(name, wide):
            raise _untranslatable_denial_error(right, name, denying, wide, place, why)
    raise _too_many_error(wide, place)


def _untranslatable_denial_error(
    right: str, denied: str, denying: Source, wide: str, allowing: Source, why: str
) -> PolicyError:
    allows = (
        f"line {allowing.line} of '{allowing.file}' allows" if allowing.line else "the rights allow"
    )
    return PolicyError(
        f"{denying}: DENY {right} {denied} cannot be expressed in Zenoh, because {allows} {wide}",
        "In Zenoh, a query or a put with a wildcard bypasses a rule that denies only some of its "
        f"names. So sros lists the names that remain allowed, but {why}.",
        f"List the names to {right} in place of {wide}.",
    )


def _with_keys_below(names: frozenset[Chunks] | set[Chunks]) -> set[Chunks] | frozenset[Chunks]:
    """Return the same names, with a single expression for a name and all names below it."""
    below = ("*", ANY_CHUNKS)
    if not any(name[-1] == ANY_CHUNKS for name in names):
        return names
    complete_names = {name for name in names if (*name, *below) in names}
    return names - complete_names - {(*name, *below) for name in complete_names} | {
        (*name, ANY_CHUNKS) for name in complete_names
    }


def _names_of_expression(name: str, place: Source) -> list[str]:
    """Return the names of an expression: a name for each choice of its ``?`` and character sets.

    Raises:
        PolicyError: the names take more than `MOST_EXPRESSIONS`.
    """
    try:
        names = listed_expressions(name, MOST_EXPRESSIONS)
    except TooManyNames:
        names = []
    if not 0 < sum(map(_number_of_chunks, names)) <= MOST_EXPRESSIONS:
        raise _too_many_error(name, place)
    return names


def _untranslatable_name_error(name: str, place: Source) -> PolicyError:
    return PolicyError(
        f"{place}: the name {name} cannot be expressed in Zenoh",
        "A key of Zenoh has no '#' and no '$', and no empty part.",
        "Use a name that is valid in ROS.",
    )


def _too_many_error(name: str, place: Source) -> PolicyError:
    return PolicyError(
        f"{place}: the name {name} cannot be expressed in Zenoh",
        "Zenoh key expressions have no '?' and no sets of characters, so sros lists the names that "
        f"{name} may match: here more than {MOST_EXPRESSIONS} key expressions.",
        "Write only the names that the robot uses, or use '*'.",
    )


def _number_of_chunks(name: str) -> int:
    """Return a lower bound for the number of results of `chunks_of`; each ``*`` can double it."""
    stars_within = len(re.findall(r"(?<=[^/*])\*+(?=[^/*])", name))
    return 1 << stars_within


def chunks_of(name: str) -> list[Chunks]:
    """Return the chunks of the key expressions that together match the ROS names of ``name``.

    ``name`` is absolute, with ``*`` as its only wildcard.  A ``*`` of a policy also matches "/". So
    a star next to a slash becomes ``**``, and a star within a part of a name needs two expressions.
    `_number_of_chunks` shows in advance whether the result would be too large.
    """
    if "*" not in name:
        return [tuple(name[1:].split("/"))]
    while "**" in name:
        name = name.replace("**", "*")
    if name.startswith("*"):  # a namespace with a wildcard: the star can also match nothing
        rest = name[1:]
        return (chunks_of(rest) if rest.startswith("/") else []) + chunks_of(f"/{name}")
    expressions: list[list[str]] = [[]]
    for begin, *later_parts in (part.split("*") for part in name[1:].split("/")):
        expressions = [
            before + part
            for before in expressions
            for part in _chunks_of_part([begin, *later_parts])
        ]
    return [tuple(canonical(chunks).split("/")) for chunks in expressions]


def _chunks_of_part(texts: list[str]) -> list[list[str]]:
    """Return the key expressions that match a part of a name, each as a list of chunks.

    ``texts`` are the texts between the stars of the part.
    """
    if texts == ["", ""]:
        return [["*", ANY_CHUNKS]]
    first, *later_texts = texts
    expressions: list[list[str]] = [[first]]
    for number, text in enumerate(later_texts):
        if number == 0 and not first:
            expressions = [[ANY_CHUNKS, ANY_PART + text]]
        elif number == len(later_texts) - 1 and not text:
            expressions = [
                [*chunks[:-1], chunks[-1] + ANY_PART, ANY_CHUNKS] for chunks in expressions
            ]
        else:
            within = [[*chunks[:-1], chunks[-1] + ANY_PART + text] for chunks in expressions]
            across = [
                [*chunks[:-1], chunks[-1] + ANY_PART, ANY_CHUNKS, ANY_PART + text]
                for chunks in expressions
            ]
            expressions = within + across
    return expressions


# ── Zenoh rules in ROS terms ────────────────────────────────────────────────────────────

_RIGHT_OF_MESSAGE = {
    (Flow.INGRESS, Message.PUT): "publish",
    (Flow.EGRESS, Message.PUT): "subscribe",
    (Flow.INGRESS, Message.QUERY): "request",
    (Flow.EGRESS, Message.QUERY): "reply",
}
"""Direction and kind of a message → right that the message uses."""
_WILD_CHUNKS = ("*", ANY_CHUNKS)
_TYPE_AND_HASH = 2
_MOST_ANY_CHUNKS = 6
"""Maximum number of ``**`` in a key expression; every ``**`` doubles the number of names."""


@dataclass(frozen=True, slots=True)
class RightsInRules:
    """The rights that rules give to processes, by the common name of their certificate.

    ``domains`` maps each right to the ROS domains in its keys; None stands for a wildcard.
    ``enclaves`` are the common names in the rules.  ``left_out`` are the key expressions that match
    no ROS topic or service, sorted.
    """

    domains: Mapping[Right, frozenset[int | None]]
    enclaves: frozenset[str]
    left_out: tuple[str, ...]


class RouterLinks(NamedTuple):
    """The links between the routers of a Zenoh network, and the rights that may pass over them.

    ``router_of`` maps an enclave to the router that it connects to, and a router to itself.
    ``passing`` maps a router to the rights that it gives to other routers.
    """

    router_of: Mapping[str, str]
    passing: Mapping[str, Collection[Right]]


def rights_in_rules(access: Enforcement) -> RightsInRules:
    """Return the rights that access control gives to enclaves, with their ROS domains.

    Subjects without a common name are not enclaves, and are left out.
    """
    domains: dict[Right, set[int | None]] = {}
    left_out: set[str] = set()
    names: set[str] = set()
    for subject in access.subjects:
        for enclave in subject.cert_common_names or ():
            names.add(enclave)
            rules = access.rules_of(subject.id)
            differences = _differences_in(rules, enclave)
            for (_, of_domain), rights in differences.items():
                for stated in rights:
                    domains.setdefault(stated, set()).add(of_domain)
            for rule in rules:
                for right, key in _right_keys(rule):
                    qualifier, domain = ALLOW if rule.allows else DENY, _domain_of(key)
                    if domain is not None and (right, domain) in differences:
                        continue
                    of_key = ros_names(key)
                    for name in of_key:
                        stated = Right(enclave, qualifier, right, name)
                        domains.setdefault(stated, set()).add(domain)
                    left_out |= set() if of_key else {key}
    in_domains = {right: frozenset(of_right) for right, of_right in domains.items()}
    return RightsInRules(in_domains, frozenset(names), tuple(sorted(left_out)))


def _domain_of(key: str) -> int | None:
    """Return the ROS domain in a key expression; None for a wildcard."""
    chunk = key.partition("/")[0]
    return int(chunk) if _DOMAIN.fullmatch(chunk) and chunk != "*" else None


_NOWHERE = Source("", 0)


def _differences_in(
    rules: Sequence[AclRule], enclave: str
) -> Mapping[tuple[str, int], Sequence[Right]]:
    """Map (right, domain) to the rights and denials behind rules that only allow.

    The names are read from the rules for graph tokens. These names count only if sros would list
    exactly the key expressions of the rules for these names. Without this step, each key expression
    would be read as a separate ROS name, which matches more names: ``$*b$*/**`` has the b in the
    first part, but ``/*b*`` in any part.
    """
    keys: dict[tuple[str, int], set[str]] = {}
    denied = set()
    for rule in rules:
        for right, key in _right_keys(rule):
            if (domain := _domain_of(key)) is not None:
                keys.setdefault((right, domain), set()).add(key)
                denied |= set() if rule.allows else {(right, domain)}
    differences = {}
    for (right, domain), of_right in keys.items():
        named = announced_names(rules, enclave, domain, right)
        stated = [
            Right(enclave, ALLOW if allows else DENY, right, name)
            for allows, of in named.items()
            for name in of
        ]
        if not named[False] or (right, domain) in denied:
            continue
        with suppress(PolicyError):
            places = (StatedRight(right_or_denial, _NOWHERE) for right_or_denial in stated)
            written = {key for _, of, _ in _allowed_keys(domain, places) for key in of}
            if written == of_right:
                differences[right, domain] = stated
    return differences


def _right_keys(rule: AclRule) -> Iterator[tuple[str, str]]:
    """Yield pairs of a right and a key expression of the right to which a rule applies."""
    for (flow, message), right in _RIGHT_OF_MESSAGE.items():
        if flow in rule.flows and message in rule.messages:
            # Keys with @adv are for the history of a topic, and belong to the same right.
            yield from ((right, key) for key in rule.key_expressions if "/@adv" not in key)


def ros_names(key: str) -> tuple[str, ...]:
    """Return the ROS names, perhaps with wildcards, for a key expression; () if no name fits.

    The first chunk is the ROS domain, and the last two are the type and its hash.
    """
    chunks = _without_type(untyped(key).split("/")[1:])
    if chunks.count(ANY_CHUNKS) > _MOST_ANY_CHUNKS or any(
        chunk.startswith("@") for chunk in chunks
    ):
        return ()
    names = [""]
    for chunk in chunks:
        if chunk == ANY_CHUNKS:
            # "**" can match no chunk; a preceding ROS star already includes what "**" matches.
            names += [f"{name}/*" for name in names if not name.endswith("*")]
        else:
            names = [f"{name}/{chunk.replace(ANY_PART, '*')}" for name in names]
    valid = sorted({name for name in names if name and not expression_problem(name)})
    return tuple(
        name for name in valid if not any(wide != name and covers(wide, name) for wide in valid)
    )


def _without_type(chunks: list[str]) -> list[str]:
    """Return the chunks of the name, without type and hash, which can be wildcards.

    The expression is in canonical form, in which ``*`` stands before ``**``.
    """
    end = len(chunks)
    while end and chunks[end - 1] in _WILD_CHUNKS:
        end -= 1
    wild = chunks[end:]
    if wild.count("*") >= _TYPE_AND_HASH:
        kept = wild.count("*") - _TYPE_AND_HASH
        return [*chunks[:end], *["*"] * kept, *[ANY_CHUNKS] * wild.count(ANY_CHUNKS)]
    if wild:
        return chunks[:end] + wild if ANY_CHUNKS in wild else chunks[:-_TYPE_AND_HASH]
    return chunks[:-_TYPE_AND_HASH]


# ── rules that others wrote, in ROS terms ───────────────────────────────────────────────────

_BELOW_KEYS = "@adv"
_MOST_NAMES = 65536
_EVERY_NAME = ("*", *_UNTYPED, ANY_CHUNKS)
_DOMAIN = re.compile(r"\*|0|[1-9][0-9]{0,2}")
"""Matches the first chunk of a key of rmw_zenoh: a ROS domain or a wildcard."""


def name_of_key(key: str) -> tuple[str, str]:
    """Return the domain and the ROS name in a key or key expression of rmw_zenoh.

    The name is "" for keys of the graph, and for other keys without a topic or service.
    """
    domain, _, rest = key.partition("/")
    chunks = rest.partition(f"/{_BELOW_KEYS}")[0].split("/")
    end = next(
        (at for at, chunk in enumerate(chunks) if _IN_TYPES in chunk), len(chunks) - len(_UNTYPED)
    )
    if domain.startswith("@") or end <= 0:
        return domain, ""
    return domain, "/" + "/".join(chunks[:end])


@dataclass(frozen=True, slots=True)
class _DecidingMessage:
    """The message that decides whether a remote process has a right, and other needed messages."""

    flow: Flow
    message: Message
    needs: tuple[tuple[Flow, Message], ...]


_DECIDING_MESSAGES = {
    "publish": _DecidingMessage(_IN, _M.PUT, ((_OUT, _M.DECLARE_SUBSCRIBER),)),
    "subscribe": _DecidingMessage(_OUT, _M.PUT, ((_IN, _M.DECLARE_SUBSCRIBER),)),
    "request": _DecidingMessage(_IN, _M.QUERY, ((_OUT, _M.REPLY),)),
    "reply": _DecidingMessage(_OUT, _M.QUERY, ((_IN, _M.DECLARE_QUERYABLE), (_IN, _M.REPLY))),
}
"""Right → deciding message, from the view of the process that has the rules."""


@dataclass(frozen=True, slots=True)
class StatedName:
    """A right to a ROS name, perhaps with wildcards.

    ``lacks`` are messages that the right also needs, but that the rules do not allow.
    """

    right: str
    name: str
    domain: str
    lacks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RightsOfSubject:
    """The rights that rules give to the processes that match a subject.

    ``names`` are the common names of the processes' certificates; None stands for any name.  With
    ``self_limiting``, the rights belong to the process that has the rules, and this process can
    ignore the rules.  ``unsaid`` are pairs of a right and a key that no ROS name expresses exactly;
    ``denied`` are pairs of a right and a denied key.
    """

    subject: str
    names: tuple[str, ...] | None
    self_limiting: bool
    rights: tuple[StatedName, ...]
    unsaid: tuple[tuple[str, str], ...]
    denied: tuple[tuple[str, str], ...]


def rights_of_subjects(document: ConfigurationDocument) -> tuple[RightsOfSubject, ...]:
    """Return the ROS rights that a configuration gives to its subjects, in the order of the file.

    Raises:
        DocumentError: there are too many wildcards to compare.
    """
    access, limit = document.access, ComparisonLimit()
    if not access.enabled:
        rules = (AclRule("", True, tuple(Flow), tuple(Message), ("**",)),)
        return (_rights_of_subject("", None, False, rules, limit),)
    self_limiting = is_self_limiting(document)
    return tuple(
        _rights_of_subject(
            subject.id, subject.cert_common_names, self_limiting, _rules(access, subject), limit
        )
        for subject in access.subjects
        if access.rules_of(subject.id) or access.allows_by_default
    )


def is_self_limiting(document: ConfigurationDocument) -> bool:
    """Return whether a session's rules name no process, so that no other process enforces them."""
    access = document.access
    used = [subject for subject in access.subjects if access.rules_of(subject.id)]
    return (
        document.mode is not Mode.ROUTER
        and bool(used)
        and not any(subject.is_named() for subject in used)
    )


def _rules(access: Enforcement, subject: AclSubject) -> tuple[AclRule, ...]:
    rules = access.rules_of(subject.id)
    if not access.allows_by_default:
        return rules
    return (*rules, AclRule("", True, tuple(Flow), tuple(Message), ("**",)))


def _rights_of_subject(
    subject: str,
    names: tuple[str, ...] | None,
    self_limiting: bool,
    rules: Sequence[AclRule],
    limit: ComparisonLimit,
) -> RightsOfSubject:
    of_subject: list[StatedName] = []
    unsaid: list[tuple[str, str]] = []
    denied: list[tuple[str, str]] = []

    def keys(flow: Flow, message: Message, *, allows: bool = True) -> list[str]:
        seen = flow.opposite() if self_limiting else flow
        stated = (
            untyped(key)
            for rule in rules
            if rule.allows is allows and seen in rule.flows and message in rule.messages
            for key in rule.key_expressions
        )
        return [key for key in dict.fromkeys(stated) if _BELOW_KEYS not in key.split("/")]

    for right, place in _DECIDING_MESSAGES.items():
        allowed = keys(place.flow, place.message)
        taken = keys(place.flow, place.message, allows=False)
        needed = [
            (message, _PrefixIndex(keys(flow, message), limit)) for flow, message in place.needs
        ]
        names_of = _AllowedNames(allowed, taken, limit)
        for domain, name in names_of.stated():
            lacks = tuple(
                message.value
                for message, other_keys in needed
                if not all(other_keys.any(key, includes) for key in _keys_of(domain, name))
            )
            of_subject.append(StatedName(right, name, domain, lacks))
        unsaid += [(right, key) for key in names_of.keys_without_name()]
        denied += [(right, key) for key in taken]
    order = sorted(
        of_subject, key=lambda stated: (RIGHT_ORDER[stated.right], stated.name, stated.domain)
    )
    return RightsOfSubject(
        subject, names, self_limiting, tuple(order), tuple(unsaid), tuple(denied)
    )


@lru_cache(maxsize=_MOST_NAMES)
def _keys_of(domain: str, name: str) -> tuple[str, ...]:
    if _number_of_chunks(name) > _MOST_NAMES:
        raise DocumentError(
            f"the Zenoh rules for {name} cannot be compared",
            f"Its wildcards stand for more than {_MOST_NAMES} key expressions.",
            "Use fewer wildcards in this name.",
        )
    return tuple(canonical((domain, *chunks, *_UNTYPED)) for chunks in chunks_of(name))


class _PrefixIndex:
    """An index of expressions by the text before the first wildcard."""

    def __init__(self, expressions: Iterable[str], limit: ComparisonLimit) -> None:
        self._limit = limit
        self._by_begin: dict[str, list[str]] = {}
        for expression in expressions:
            # "/**" and "/*" can match nothing, and "$*" a part of a chunk, so the text before them
            # ends earlier.
            self._by_begin.setdefault(expression.partition("*")[0].rstrip("$/"), []).append(
                expression
            )

    def any(self, text: str, holds: Callable[[str, str], bool]) -> bool:
        """Return whether ``holds(expression, text)`` for any expression that may match the text."""
        for end in range(len(text) + 1):
            for expression in self._by_begin.get(text[:end], ()):
                if holds(expression, text):
                    return True
                self._limit.spend(len(expression) + len(text))
        return False


class _AllowedNames:
    """The ROS names in the allowed key expressions, without denied names."""

    def __init__(
        self, allowed: Sequence[str], denied: Sequence[str], limit: ComparisonLimit
    ) -> None:
        self._allowed = allowed
        self._denied = denied
        self._limit = limit
        self._including = _PrefixIndex(allowed, limit)
        self._stated_keys: list[str] = []

    def stated(self) -> list[tuple[str, str]]:
        """Return pairs of domain and name, without names that another name of the domain covers."""
        sound = dict.fromkeys(
            (domain, name)
            for key in self._allowed
            for domain, name in _candidate_names(key)
            if not expression_problem(name) and self._is_sound(domain, name)
        )
        self._stated_keys = [key for domain, name in sound for key in _keys_of(domain, name)]
        names: dict[str, list[str]] = {}
        for domain, name in sound:
            names.setdefault(domain, []).extend([name] if "*" in name else [])
        wild = {domain: _PrefixIndex(of, self._limit) for domain, of in names.items()}
        return [
            (domain, name)
            for domain, name in sound
            if not wild[domain].any(
                name, lambda wide, narrow: wide != narrow and covers(wide, narrow)
            )
        ]

    def _is_sound(self, domain: str, name: str) -> bool:
        return all(
            self._including.any(key, includes)
            and not any(intersects(denied, key) for denied in self._denied)
            for key in _keys_of(domain, name)
        )

    def keys_without_name(self) -> list[str]:
        """Return the key expressions that the names do not express completely."""
        stated_names = _PrefixIndex(dict.fromkeys(self._stated_keys), self._limit)
        return [
            key
            for key in self._allowed
            if not all(stated_names.any(piece, includes) for piece in _topic_keys(key))
        ]


def _candidate_names(key: str) -> Iterator[tuple[str, str]]:
    """Yield pairs of domain and name that may express a key expression, or a part of it."""
    domain, *chunks = key.split("/")
    if domain == ANY_CHUNKS:
        domain, chunks = "*", [ANY_CHUNKS, *chunks]
    if not _DOMAIN.fullmatch(domain) or not chunks:
        return
    if chunks[-1] != ANY_CHUNKS:
        yield from ((domain, name) for name in _ros_names_in(chunks[: -len(_UNTYPED)]))
        return
    body = chunks[:-1]
    for dropped in range(len(_UNTYPED) + 1):
        base = body[: len(body) - dropped]
        if dropped > len(body) or set(body[len(base) :]) - {"*"}:
            break
        yield from ((domain, name) for name in _ros_names_in(base))
        yield from ((domain, f"{name}/*") for name in _ros_names_in(base) or [""])


def _ros_names_in(chunks: Sequence[str]) -> list[str]:
    """Return the ROS names for chunks; there are several, because a ROS ``*`` also matches "/"."""
    if not chunks:
        return []
    text = "/".join(chunks)
    joined = text.replace("$*/**/$*", "*").replace("**/$*", "*").replace("*/**", "*")
    separate = text.replace("**/", "")
    names = (name.replace("$*", "*").replace("**", "*") for name in (joined, text, separate))
    return list(dict.fromkeys(f"/{name}" for name in names))


def _topic_keys(key: str) -> list[str]:
    """Return expressions for exactly the keys of topics and services that ``key`` includes."""
    domain, *chunks = key.split("/")
    if domain == ANY_CHUNKS:
        domain, chunks = "*", [ANY_CHUNKS, *chunks]
    if not chunks or chunks[-1] != ANY_CHUNKS:
        return [canonical((domain, *chunks))]
    base = chunks[:-1]
    if tuple(base[-len(_UNTYPED) :]) == _UNTYPED:
        base = base[: -len(_UNTYPED)]
    below = canonical((domain, *base, *_EVERY_NAME))
    return [canonical((domain, *base, *_UNTYPED)), below] if base else [below]


# ── as a policy ────────────────────────────────────────────────────────────────────────────


def enclaves_of_subject(rights: RightsOfSubject) -> tuple[str, ...]:
    """Return the enclaves for which a subject stands, or ().

    If a session limits itself, the id of its subject is the enclave's name: zenoh_security_tools
    uses the node's name for both.
    """
    named = rights.names or ((f"/{rights.subject}",) if rights.self_limiting else ())
    return tuple(name for name in named if _is_enclave(name))


def _is_enclave(name: str) -> bool:
    try:
        return check_enclave_name(name) == name
    except InvalidNameError:
        return False


def policy_of(subjects: Iterable[RightsOfSubject]) -> Policy:
    """Return a policy that gives the enclaves of subjects their rights, and never more.

    Rules name no nodes, so the node of a profile is the last part of the enclave's name.  All names
    are absolute.
    """
    rights: dict[str, set[Right]] = {}
    for subject in subjects:
        for enclave in enclaves_of_subject(subject):
            rights.setdefault(enclave, set()).update(
                Right(enclave, ALLOW, stated.right, stated.name) for stated in subject.rights
            )
    return Policy(
        tuple(_enclave(name, join_actions(of)) for name, of in sorted(rights.items()) if of)
    )


def _enclave(name: str, rights: Iterable[Right]) -> Enclave:
    names: dict[str, list[str]] = {}
    for right in sorted(rights, key=lambda right: (RIGHT_ORDER[right.right], right.name)):
        names.setdefault(right.right, []).append(right.name)
    groups = tuple(
        Group(KIND_OF[action], ((action, ALLOW),), tuple(of)) for action, of in names.items()
    )
    node = name.rpartition("/")[2] or "node"
    return Enclave(name, (Profiles((Profile("/", node, groups),)),))
