"""The portable profile: documents that every vendor reads alike, and notes on other documents.

Each note is about a difference between vendors that was measured on Fast DDS 2.9.1 and 2.14.5
and on Cyclone DDS 0.10.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import combinations

from sros_tool.dds.permissions import MAX_SIGNED_BYTES, Criteria, Permissions
from sros_tool.errors import Note
from sros_tool.wording import first_few

_SHOWN = 3
_LONGEST_TOPIC = 251  # bytes, of DDS names
_LONGEST_NAME = 8  # parts; a longer enclave name has too many subsets to compare


def document_notes(what: str, permissions: Permissions, signed_bytes: int) -> Iterator[Note]:
    """Yield notes on a permissions document named ``what``; ``signed_bytes`` is its size."""
    for identity, fact in outside(permissions, signed_bytes):
        yield Note(identity, f"{what}: {fact}{_CONSEQUENCES[identity]}")


_CONSEQUENCES = {
    "portable.document-size": f"; with {MAX_SIGNED_BYTES} or more, Fast DDS 2.9 may never "
    "finish the handshake. Remove rights that are never used, or use wildcards (`sros "
    "minimize_policy POLICY --observed OBSERVED` shows both), or split the enclave.",
    "portable.long-name": f"; on Fast DDS no peer matches a topic of more than "
    f"{_LONGEST_TOPIC} bytes. Use shorter namespaces and names.",
    "portable.deny-blocks-topic": " on Cyclone DDS, which refuses the topic as a whole; Fast "
    "DDS allows it. What no rule allows is denied anyway, so perhaps the denial can be removed.",
    "portable.character-set": ". Vendors read plain sets alike, but only * and ? are part of the "
    "portable profile.",
}


Meets = Callable[[str], bool]
"""Whether an expression and some of certain others match a common name."""


def _meets_text(names: Sequence[str]) -> Meets:
    """Return whether one expression matches the text of the other; other overlaps are missed."""
    return lambda name: any(fnmatchcase(each, name) or fnmatchcase(name, each) for each in names)


def outside(
    permissions: Permissions,
    signed_bytes: int,
    meets_some_of: Callable[[Sequence[str]], Meets] = _meets_text,
) -> Iterator[tuple[str, str]]:
    """Yield the id and a clause of a note for each part of a document outside of the profile.

    ``meets_some_of`` returns the function that says whether an expression and one of its arguments
    match a common name.
    """
    if signed_bytes >= MAX_SIGNED_BYTES:
        yield "portable.document-size", f"the signed permissions have {signed_bytes} bytes"
    for grant in permissions.grants:
        long = [
            topic
            for rule in grant.rules
            for criteria in (*rule.publish, *rule.subscribe)
            for topic in criteria.topics
            if len(topic.encode()) > _LONGEST_TOPIC and not any(each in topic for each in "*?[")
        ]
        if long:
            yield "portable.long-name", f"{long[0][:60]}... has {len(long[0].encode())} bytes"
        allowed = [r for r in grant.rules if r.allow]
        denied = [r for r in grant.rules if not r.allow]
        for direction, other in (("publish", "subscribe"), ("subscribe", "publish")):
            blocked = _blocked(
                [t for r in denied for t in _topics(getattr(r, direction))],
                {t for r in denied for t in _topics(getattr(r, other))},
                meets_some_of([t for r in allowed for t in _topics(getattr(r, other))]),
            )
            if blocked:
                kept_from = "subscribing" if other == "subscribe" else "publishing"
                yield (
                    "portable.deny-blocks-topic",
                    f"denying to {direction} {_some(blocked)} also keeps the enclave from "
                    f"{kept_from} there",
                )
        sets = [t for r in grant.rules for c in (*r.publish, *r.subscribe) for t in c.topics]
        sets = sorted({topic for topic in sets if "[" in topic})
        if sets:
            yield "portable.character-set", f"{_some(sets)} uses a [set] of characters"


def _topics(criteria: Iterable[Criteria]) -> tuple[str, ...]:
    return tuple(topic for each in criteria for topic in each.topics)


def _blocked(denied: list[str], denied_too: set[str], is_allowed: Meets) -> list[str]:
    """Return the denied expressions that share a name with one allowed in the other direction."""
    return [each for each in denied if each not in denied_too and is_allowed(each)]


def name_notes(names: Iterable[str], new: Iterable[str]) -> Iterator[Note]:
    """Yield a note on enclaves that Cyclone DDS mistakes for each other.

    ``names`` are all enclaves; a pair is reported if one of the two is in ``new``.
    """
    fresh = set(new)
    pairs = [pair for pair in mistaken_names(names) if not fresh.isdisjoint(pair)]
    if pairs:
        yield Note(
            "portable.enclave-names",
            f"Cyclone DDS 0.10 mistakes {some_pairs(pairs)}, if the first enclave presents the "
            "(public) permissions of the second, because all parts of its name occur there. "
            "Choose names that do not consist of parts of another name, such as /robot_admin.",
        )


def mistaken_names(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the sorted pairs of enclaves of which Cyclone DDS mistakes the first for the second.

    It checks only that every part of the first subject occurs in the second one: the permissions
    of ``/robot/admin`` fit the identity ``/robot``.
    """
    parts_of = {name: frozenset(name.strip("/").split("/")) for name in names}
    by_parts: dict[frozenset[str], list[str]] = {}
    for name, parts in parts_of.items():
        by_parts.setdefault(parts, []).append(name)
    return sorted(
        {
            (inner, outer)
            for outer, parts in parts_of.items()
            if len(parts) <= _LONGEST_NAME
            for inner in _contained(parts, by_parts)
            if inner != outer
        }
    )


def some_pairs(pairs: Sequence[tuple[str, str]]) -> str:
    """Return the first pairs in words: "/robot for /robot/admin and 2 more"."""
    return first_few([f"{inner} for {outer}" for inner, outer in pairs], _SHOWN)


def _contained(
    parts: frozenset[str], by_parts: Mapping[frozenset[str], list[str]]
) -> Iterator[str]:
    for size in range(1, len(parts) + 1):
        for subset in combinations(sorted(parts), size):
            yield from by_parts.get(frozenset(subset), ())


def _some(topics: list[str]) -> str:
    return first_few(topics, _SHOWN)
