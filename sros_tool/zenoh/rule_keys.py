"""The keys of access-control rules: allowed names without denied names, and shared keys."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from sros_tool.zenoh.key_expressions import (
    ANY_CHUNKS,
    KeyExpressions,
    TooManyExpressions,
    canonical,
    common,
    intersects,
)
from sros_tool.zenoh.subtraction import CannotSubtract, Chunks, covers, meet, subtract_all

_MANY, _FEW = 65536, 1024


class Difference(NamedTuple):
    """The keys of allowed names without the keys of denied names.

    A key is the chunk ``begin``, the name, and ``end``: "", or "/" and further chunks.
    """

    begin: str
    end: str
    allowed: frozenset[Chunks]
    denied: frozenset[Chunks]

    def names(self) -> frozenset[Chunks]:
        """Return key expressions for the names that are left.

        Raises:
            CannotSubtract: no or too many key expressions: see `subtract_all`.
        """
        return subtract_all(self.allowed, self.denied)

    def below(self, end: str) -> Difference:
        """Return the keys with ``end`` behind each key of this difference."""
        return self._replace(end=f"{self.end}/{end}")

    def include(self, name: str) -> bool:
        """Return whether the difference has a name without wildcards, such as ``robot/chatter``."""
        return _searched(self.allowed).include(name) and not _searched(self.denied).include(name)

    def include_all(self, begin: str, name: Chunks, end: str) -> bool:
        """Return whether the difference has all keys of an expression; False may be wrong."""
        return (
            begin == self.begin
            and _common_end(end, self.end) == end
            and any(covers(expression, name) for expression in self.allowed)
            and not any(meet(expression, name) for expression in self.denied)
        )

    def common(self, other: Difference) -> list[str]:
        """Return key expressions for the keys that both differences have.

        Raises:
            CannotSubtract: no or too many key expressions: see `subtract_all`.
            TooManyExpressions: the shared allowed names take too many key expressions.
        """
        end = _common_end(self.end, other.end)
        if self.begin != other.begin or end is None:
            return []
        names = subtract_all(_common(self.allowed, other.allowed), self.denied | other.denied)
        return [canonical((self.begin, *name)) + end for name in names]


def _common_end(one: str, other: str) -> str | None:
    """Return what two endings share, or None; "/**" in one includes the other."""
    end, longer = sorted((one, other), key=len)
    return end if longer in (end, f"{end}/{ANY_CHUNKS}") else None


@lru_cache(maxsize=_FEW)
def _searched(expressions: frozenset[Chunks]) -> KeyExpressions:
    return KeyExpressions("/".join(chunks) for chunks in expressions)


@lru_cache(maxsize=_FEW)
def _common(some: frozenset[Chunks], others: frozenset[Chunks]) -> frozenset[Chunks]:
    """Return expressions for what some expressions and others match."""
    if some == others:
        return some
    return frozenset(
        tuple(expression.split("/"))
        for first in some
        for second in others
        for expression in common("/".join(first), "/".join(second))
    )


class RuleKeys:
    """The keys that the key expressions of a rule include.

    ``plain`` are keys of a single name, with wildcards only in the type, in its hash and behind it.
    ``tokens`` are graph tokens with wildcards; ``differences`` are all other keys.  ``is_plain``
    says that there are only plain keys.
    """

    def __init__(self, expressions: frozenset[str], made_of: tuple[Difference, ...]) -> None:
        """Sort the key expressions by kind.

        ``made_of`` are the set differences that the expressions write out; () if unknown.
        """
        wide = [expression for expression in expressions if "*" in _ENDS.sub("", expression)]
        self.plain = expressions.difference(wide)
        self.tokens = KeyExpressions(
            expression for expression in wide if expression.startswith("@")
        )
        self.differences = made_of or _differences(wide)
        self.is_plain = not wide and not made_of
        self._has_plain_tokens = any(expression.startswith("@") for expression in self.plain)

    def include(self, key: str) -> bool:
        """Return whether the differences of the rule have all keys of an expression."""
        begin, name, end = _parted(key)
        chunks = tuple(name.split("/"))
        return any(difference.include_all(begin, chunks, end) for difference in self.differences)

    def common(self, other: RuleKeys) -> tuple[str, ...]:
        """Return expressions that together include the keys of both, and no others, sorted.

        Raises:
            TooManyExpressions: there are too many.
        """
        shared = self.plain & other.plain
        if self.is_plain and other.is_plain:
            return _in_order(shared) if shared else ()
        if self._plain_may_be_in(other):
            shared |= _plain_in(self.plain, other)
        if other._plain_may_be_in(self):
            shared |= _plain_in(other.plain, self)
        if self.tokens.all and other.tokens.all:
            shared |= _common_of_tokens(self.tokens, other.tokens)
        if self.differences and other.differences:
            shared |= _common_of_differences(self.differences, other.differences)
        return _in_order(shared) if shared else ()

    def _plain_may_be_in(self, wide: RuleKeys) -> bool:
        return bool(
            (self.plain and wide.differences) or (self._has_plain_tokens and wide.tokens.all)
        )


@lru_cache(maxsize=_MANY)
def _in_order(expressions: frozenset[str]) -> tuple[str, ...]:
    return tuple(sorted(expressions))


@lru_cache(maxsize=_MANY)
def keys_of(expressions: frozenset[str], made_of: tuple[Difference, ...] = ()) -> RuleKeys:
    """Return the keys that expressions include; equal arguments give the same object (a cache)."""
    return RuleKeys(expressions, made_of)


_TYPE = "/$*::$*/*"
"""Any type with its hash, which follow the name in a key."""
_ENDS = re.compile(rf"{re.escape(_TYPE)}(?:/\*\*)?(?:/@adv/\*\*)?\Z")


def _parted(expression: str) -> tuple[str, str, str]:
    """Return the parts of a key expression before, in and after the name."""
    begin, _, rest = expression.partition("/")
    name, of_type, below = rest.partition(_TYPE)
    return begin, name, of_type + below


def _differences(expressions: Iterable[str]) -> tuple[Difference, ...]:
    """Return the keys of expressions that are not graph tokens."""
    names: dict[tuple[str, str], set[Chunks]] = {}
    for expression in expressions:
        if not expression.startswith("@"):
            begin, name, end = _parted(expression)
            names.setdefault((begin, end), set()).add(tuple(name.split("/")))
    return tuple(
        Difference(*place, frozenset(of), frozenset()) for place, of in sorted(names.items())
    )


@lru_cache(maxsize=_MANY)
def _plain_in(plain: frozenset[str], wide: RuleKeys) -> frozenset[str]:
    keys: set[str] = set()
    for key in plain:
        begin, name, end = _parted(key)
        if begin.startswith("@"):
            keys.update([key] if wide.tokens.include(key) else _common_with_all(key, wide.tokens))
            continue
        for difference in wide.differences:
            common_end = _common_end(end, difference.end)
            if begin == difference.begin and common_end is not None and difference.include(name):
                keys.add(f"{begin}/{name}{common_end}")
    return frozenset(keys)


@lru_cache(maxsize=_MANY)
def _common_of_differences(
    some: tuple[Difference, ...], others: tuple[Difference, ...]
) -> frozenset[str]:
    try:
        shared = [key for first in some for second in others for key in first.common(second)]
    except CannotSubtract:
        raise TooManyExpressions from None
    return frozenset(shared)


@lru_cache(maxsize=_MANY)
def _common_of_tokens(one: KeyExpressions, other: KeyExpressions) -> frozenset[str]:
    if one.all == other.all:
        return one.all
    shared = {token for token in one.all if other.include(token)}
    not_included = [token for token in one.all if token not in shared]
    for token in other.all if not_included else ():
        if one.include(token):
            shared.add(token)
        else:
            # Tokens of `one` that `other` includes are shared as they are.
            overlapping = (wide for wide in not_included if intersects(token, wide))
            shared.update(*(common(token, wide) for wide in overlapping))
    return frozenset(KeyExpressions(shared).needed())


@lru_cache(maxsize=_MANY)
def _common_with_all(key: str, wide: KeyExpressions) -> tuple[str, ...]:
    return tuple(shared for token in wide.all for shared in common(key, token))
