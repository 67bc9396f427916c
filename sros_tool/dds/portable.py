"""The portable profile: what every vendor decides alike, and remarks on what lies outside it.

Each remark rests on a difference between vendors that was measured on Fast DDS 2.9.1 and 2.14.5
and on Cyclone DDS 0.10.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from itertools import combinations

from sros_tool.dds.permissions import MAX_SIGNED_BYTES, Criteria, Permissions
from sros_tool.notes import Note

_MANY = 3
_LONGEST_NAME = 8  # parts; longer enclave names are not compared, the subsets would be too many


def document_notes(what: str, permissions: Permissions, signed_bytes: int) -> Iterator[Note]:
    """Remarks on one permissions document; ``what`` names it, ``signed_bytes`` is its size."""
    if signed_bytes >= MAX_SIGNED_BYTES:
        yield Note(
            "portable.document-size",
            f"{what}: the signed permissions have {signed_bytes} bytes; from {MAX_SIGNED_BYTES} "
            "on, the DDS handshake breaks and the node hears nobody. Use wildcards, or split the "
            "enclave.",
        )
    for grant in permissions.grants:
        allowed = [r for r in grant.rules if r.allow]
        denied = [r for r in grant.rules if not r.allow]
        for direction, other in (("publish", "subscribe"), ("subscribe", "publish")):
            blocked = _blocked(
                [t for r in denied for t in _topics(getattr(r, direction))],
                {t for r in denied for t in _topics(getattr(r, other))},
                [t for r in allowed for t in _topics(getattr(r, other))],
            )
            if blocked:
                yield Note(
                    "portable.deny-blocks-topic",
                    f"{what}: denying to {direction} {_some(blocked)} also keeps the enclave from "
                    f"{'subscribing' if other == 'subscribe' else 'publishing'} there on Cyclone "
                    "DDS, which refuses the topic as a whole; Fast DDS allows it. What no rule "
                    "allows is denied anyway, so the denial may be needless.",
                )
        sets = [t for r in grant.rules for c in (*r.publish, *r.subscribe) for t in c.topics]
        sets = sorted({topic for topic in sets if "[" in topic})
        if sets:
            yield Note(
                "portable.character-set",
                f"{what}: {_some(sets)} uses a [set] of characters. Vendors read plain sets alike, "
                "but only * and ? are part of the portable profile.",
            )


def _topics(criteria: Iterable[Criteria]) -> tuple[str, ...]:
    return tuple(topic for each in criteria for topic in each.topics)


def _blocked(denied: list[str], denied_too: set[str], allowed: list[str]) -> list[str]:
    """The denied expressions that share a name with one allowed in the other direction."""
    return [
        expression
        for expression in denied
        if expression not in denied_too
        and any(fnmatchcase(a, expression) or fnmatchcase(expression, a) for a in allowed)
    ]


def name_notes(names: Iterable[str], new: Iterable[str]) -> Iterator[Note]:
    """A remark on enclaves of which Cyclone DDS takes one for the other.

    It compares the parts of two subjects as sets, one way: the identity ``/robot`` fits the
    permissions of ``/robot/admin``.  ``names`` are all enclaves, ``new`` those just added.
    """
    parts_of = {name: frozenset(name.strip("/").split("/")) for name in names}
    by_parts: dict[frozenset[str], list[str]] = {}
    for name, parts in parts_of.items():
        by_parts.setdefault(parts, []).append(name)
    fresh = set(new)
    pairs = sorted(
        {
            (inner, outer)
            for outer, parts in parts_of.items()
            if len(parts) <= _LONGEST_NAME
            for inner in _contained(parts, by_parts)
            if inner != outer and (inner in fresh or outer in fresh)
        }
    )
    if pairs:
        shown = ", ".join(f"{inner} as {outer}" for inner, outer in pairs[:_MANY])
        more = f" and {len(pairs) - _MANY} more" if len(pairs) > _MANY else ""
        yield Note(
            "portable.enclave-names",
            f"Cyclone DDS 0.10 accepts the identity of {shown}{more}, if it presents that other "
            "enclave's (public) permissions, because all parts of its name occur there. Choose "
            "names none of which is made of parts of another, such as /robot_admin.",
        )


def _contained(
    parts: frozenset[str], by_parts: Mapping[frozenset[str], list[str]]
) -> Iterator[str]:
    for size in range(1, len(parts) + 1):
        for subset in combinations(sorted(parts), size):
            yield from by_parts.get(frozenset(subset), ())


def _some(topics: list[str]) -> str:
    shown = ", ".join(topics[:_MANY])
    return f"{shown} and {len(topics) - _MANY} more" if len(topics) > _MANY else shown
