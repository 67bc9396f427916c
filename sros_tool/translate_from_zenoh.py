"""Translation of Zenoh's keys and access control back to ROS terms: what rules allow whom.

The third translation next to `translate` and `translate_zenoh`, for rules that others wrote.  Never
more rights: a name is given only if the rules allow every key that it stands for.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

from sros_tool.errors import DocumentError, InvalidNameError
from sros_tool.names import check_enclave_name, expression_problem
from sros_tool.policy.model import ALLOW, Enclave, Group, Policy, Profile, Profiles
from sros_tool.policy.patterns import ComparisonLimit, covers
from sros_tool.policy.rights import KIND_OF, RIGHT_ORDER, Right, folded
from sros_tool.translate_zenoh import chunks_of, number_of_chunks
from sros_tool.zenoh.access import AclRule, AclSubject, Enforcement, Flow, Message
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.document import ConfigurationDocument
from sros_tool.zenoh.key_expressions import ANY_CHUNKS, canonical, includes, intersects

_HISTORY = "@adv"
_OF_TYPE = ("*", "*")
"""The type and its hash, with which the keys of topics and services end."""
_MANY = 65536
_EVERY_NAME = ("*", *_OF_TYPE, ANY_CHUNKS)
_DOMAIN = re.compile(r"\*|0|[1-9][0-9]{0,2}")
"""The first part of a key of rmw_zenoh: what does not begin with a domain has no ROS name."""


def name_of_key(key: str) -> tuple[str, str]:
    """Return the domain and the ROS name in a key or key expression of rmw_zenoh.

    The name is "" for the graph, and for what is no key of a topic or a service.
    """
    domain, _, rest = key.partition("/")
    chunks = rest.partition(f"/{_HISTORY}")[0].split("/")
    if domain.startswith("@") or len(chunks) <= len(_OF_TYPE):
        return domain, ""
    return domain, "/" + "/".join(chunks[: -len(_OF_TYPE)])


@dataclass(frozen=True, slots=True)
class _Place:
    """A message that a right stands or falls with, and those without which it is of no use."""

    flow: Flow
    message: Message
    needs: tuple[tuple[Flow, Message], ...]


_IN, _OUT = Flow.INGRESS, Flow.EGRESS
_PLACES = {
    "publish": _Place(_IN, Message.PUT, ((_OUT, Message.DECLARE_SUBSCRIBER),)),
    "subscribe": _Place(_OUT, Message.PUT, ((_IN, Message.DECLARE_SUBSCRIBER),)),
    "request": _Place(_IN, Message.QUERY, ((_OUT, Message.REPLY),)),
    "reply": _Place(_OUT, Message.QUERY, ((_IN, Message.DECLARE_QUERYABLE), (_IN, Message.REPLY))),
}
"""The message of each right of a remote process, as the process sees it that has the rules."""


@dataclass(frozen=True, slots=True)
class StatedName:
    """A right to a ROS name, perhaps with wildcards; ``lacks`` are messages that it needs too."""

    right: str
    name: str
    domain: str
    lacks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RightsBehindRules:
    """What the rules allow to the processes that match a subject.

    ``names`` are the common names of their certificates, None for processes of any name.  With
    ``own`` it is what the process that has the rules may do itself, as long as it obeys them.
    ``unsaid`` are rights and keys that no ROS name states exactly, ``denied`` are denied ones.
    """

    subject: str
    names: tuple[str, ...] | None
    own: bool
    rights: tuple[StatedName, ...]
    unsaid: tuple[tuple[str, str], ...]
    denied: tuple[tuple[str, str], ...]


def rights_behind(document: ConfigurationDocument) -> tuple[RightsBehindRules, ...]:
    """Return what a configuration allows to whom, in ROS terms, in the order of its subjects.

    Raises:
        DocumentError: there are too many wildcards to compare.
    """
    access, limit = document.access, ComparisonLimit()
    if not access.enabled:
        rules = (AclRule("", True, tuple(Flow), tuple(Message), ("**",)),)
        return (_rights("", None, False, rules, limit),)
    own = is_self_limiting(document)
    return tuple(
        _rights(each.id, each.cert_common_names, own, _rules(access, each), limit)
        for each in access.subjects
        if access.rules_of(each.id) or access.allows_by_default
    )


def is_self_limiting(document: ConfigurationDocument) -> bool:
    """Return whether a session's rules name no other process, so that they bind only itself."""
    access = document.access
    used = [each for each in access.subjects if access.rules_of(each.id)]
    return (
        document.mode is not Mode.ROUTER
        and bool(used)
        and not any(each.is_named() for each in used)
    )


def _rules(access: Enforcement, subject: AclSubject) -> tuple[AclRule, ...]:
    rules = access.rules_of(subject.id)
    if not access.allows_by_default:
        return rules
    return (*rules, AclRule("", True, tuple(Flow), tuple(Message), ("**",)))


def _rights(
    subject: str,
    names: tuple[str, ...] | None,
    own: bool,
    rules: Sequence[AclRule],
    limit: ComparisonLimit,
) -> RightsBehindRules:
    found: list[StatedName] = []
    unsaid: list[tuple[str, str]] = []
    denied: list[tuple[str, str]] = []

    def keys(flow: Flow, message: Message, *, allows: bool = True) -> list[str]:
        seen = flow.opposite() if own else flow
        stated = (
            key
            for rule in rules
            if rule.allows is allows and seen in rule.flows and message in rule.messages
            for key in rule.key_expressions
        )
        return [each for each in dict.fromkeys(stated) if _HISTORY not in each.split("/")]

    for right, place in _PLACES.items():
        allowed = keys(place.flow, place.message)
        taken = keys(place.flow, place.message, allows=False)
        needed = [(message, _ByPrefix(keys(flow, message), limit)) for flow, message in place.needs]
        names_of = _Names(allowed, taken, limit)
        for domain, name in names_of.stated():
            lacks = tuple(
                message.value
                for message, others in needed
                if not all(others.any(key, includes) for key in _keys_of(domain, name))
            )
            found.append(StatedName(right, name, domain, lacks))
        unsaid += [(right, key) for key in names_of.unsaid()]
        denied += [(right, key) for key in taken]
    order = sorted(found, key=lambda each: (RIGHT_ORDER[each.right], each.name, each.domain))
    return RightsBehindRules(subject, names, own, tuple(order), tuple(unsaid), tuple(denied))


@lru_cache(maxsize=_MANY)
def _keys_of(domain: str, name: str) -> tuple[str, ...]:
    if number_of_chunks(name) > _MANY:
        raise DocumentError(
            f"the rules of Zenoh for {name} cannot be compared",
            f"Its wildcards stand for more than {_MANY} key expressions.",
            "Name it with fewer wildcards.",
        )
    return tuple(canonical((domain, *chunks, *_OF_TYPE)) for chunks in chunks_of(name))


class _ByPrefix:
    """Expressions by their text before the first wildcard, with which what they match begins."""

    def __init__(self, expressions: Iterable[str], limit: ComparisonLimit) -> None:
        self._limit = limit
        self._found: dict[str, list[str]] = {}
        for each in expressions:
            # "/**" and "/*" may stand for nothing, or for a part without the slash.
            self._found.setdefault(each.partition("*")[0].rstrip("$/"), []).append(each)

    def any(self, text: str, holds: Callable[[str, str], bool]) -> bool:
        """Return whether ``holds`` of an expression and ``text``, for one that may match it."""
        for end in range(len(text) + 1):
            for each in self._found.get(text[:end], ()):
                if holds(each, text):
                    return True
                self._limit.spend(len(each) + len(text))
        return False


class _Names:
    """The ROS names of key expressions that are allowed, without those that are denied."""

    def __init__(
        self, allowed: Sequence[str], denied: Sequence[str], limit: ComparisonLimit
    ) -> None:
        self._allowed = allowed
        self._denied = denied
        self._limit = limit
        self._including = _ByPrefix(allowed, limit)
        self._said: list[str] = []

    def stated(self) -> list[tuple[str, str]]:
        """Return the domains and names, without those that others of the same domain cover."""
        sound = dict.fromkeys(
            (domain, name)
            for key in self._allowed
            for domain, name in _candidates(key)
            if not expression_problem(name) and self._is_sound(domain, name)
        )
        self._said = [key for domain, name in sound for key in _keys_of(domain, name)]
        names: dict[str, list[str]] = {}
        for domain, name in sound:
            names.setdefault(domain, []).extend([name] if "*" in name else [])
        wild = {domain: _ByPrefix(of, self._limit) for domain, of in names.items()}
        return [
            (domain, name)
            for domain, name in sound
            if not wild[domain].any(name, lambda one, of: one != of and covers(one, of))
        ]

    def _is_sound(self, domain: str, name: str) -> bool:
        return all(
            self._including.any(key, includes)
            and not any(intersects(each, key) for each in self._denied)
            for key in _keys_of(domain, name)
        )

    def unsaid(self) -> list[str]:
        """Return the key expressions that the names leave out a part of."""
        said = _ByPrefix(dict.fromkeys(self._said), self._limit)
        return [
            key
            for key in self._allowed
            if not all(said.any(piece, includes) for piece in _pieces(key))
        ]


def _candidates(key: str) -> Iterator[tuple[str, str]]:
    """Yield domains and names that may state a key expression, or a part of it."""
    domain, *chunks = key.split("/")
    if domain == ANY_CHUNKS:
        domain, chunks = "*", [ANY_CHUNKS, *chunks]
    if not _DOMAIN.fullmatch(domain) or not chunks:
        return
    if chunks[-1] != ANY_CHUNKS:
        yield from ((domain, each) for each in _texts(chunks[: -len(_OF_TYPE)]))
        return
    body = chunks[:-1]
    for dropped in range(len(_OF_TYPE) + 1):
        base = body[: len(body) - dropped]
        if dropped > len(body) or set(body[len(base) :]) - {"*"}:
            break
        yield from ((domain, each) for each in _texts(base))
        yield from ((domain, f"{each}/*") for each in _texts(base) or [""])


def _texts(chunks: Sequence[str]) -> list[str]:
    """Return the names that chunks may be a part of: a wildcard of ROS also matches "/"."""
    if not chunks:
        return []
    text = "/".join(chunks)
    joined = text.replace("$*/**/$*", "*").replace("**/$*", "*").replace("*/**", "*")
    apart = text.replace("**/", "")
    found = (each.replace("$*", "*").replace("**", "*") for each in (joined, text, apart))
    return list(dict.fromkeys(f"/{each}" for each in found))


def _pieces(key: str) -> list[str]:
    """Return the expressions that together match the keys of topics and services in ``key``."""
    domain, *chunks = key.split("/")
    if domain == ANY_CHUNKS:
        domain, chunks = "*", [ANY_CHUNKS, *chunks]
    if not chunks or chunks[-1] != ANY_CHUNKS:
        return [canonical((domain, *chunks))]
    base = chunks[:-1]
    if tuple(base[-len(_OF_TYPE) :]) == _OF_TYPE:
        base = base[: -len(_OF_TYPE)]
    below = canonical((domain, *base, *_EVERY_NAME))
    return [canonical((domain, *base, *_OF_TYPE)), below] if base else [below]


# ── as a policy ────────────────────────────────────────────────────────────────────────────


def enclave_of(rights: RightsBehindRules) -> tuple[str, ...]:
    """Return the names of enclaves that a subject stands for: () if it has none.

    For a session that limits itself that is the id of the subject: zenoh_security_tools takes the
    name of the node, and the enclave of that name.
    """
    named = rights.names or ((f"/{rights.subject}",) if rights.own else ())
    return tuple(each for each in named if _is_enclave(each))


def _is_enclave(name: str) -> bool:
    try:
        return check_enclave_name(name) == name
    except InvalidNameError:
        return False


def policy_of(found: Iterable[RightsBehindRules]) -> Policy:
    """Return the policy that states the rights of subjects with names: all of them, or fewer.

    The node of each profile is the last part of the enclave's name, as rules name no nodes; all
    names are absolute.
    """
    rights: dict[str, set[Right]] = {}
    for each in found:
        for enclave in enclave_of(each):
            rights.setdefault(enclave, set()).update(
                Right(enclave, ALLOW, stated.right, stated.name) for stated in each.rights
            )
    return Policy(tuple(_enclave(name, folded(of)) for name, of in sorted(rights.items()) if of))


def _enclave(name: str, rights: Iterable[Right]) -> Enclave:
    names: dict[str, list[str]] = {}
    for each in sorted(rights, key=lambda each: (RIGHT_ORDER[each.right], each.name)):
        names.setdefault(each.right, []).append(each.name)
    groups = tuple(
        Group(KIND_OF[right], ((right, ALLOW),), tuple(of)) for right, of in names.items()
    )
    node = name.rpartition("/")[2] or "node"
    return Enclave(name, (Profiles((Profile("/", node, groups),)),))
