"""Proposes wildcards that make a document smaller and, as far as is known, grant nothing new."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from sros_tool.names import is_expression
from sros_tool.policy.model import ALLOW
from sros_tool.policy.patterns import compiled
from sros_tool.policy.rights import Right, Rules, order, parts, unfolded

_DIGITS = re.compile(r"\d+")
_FEWEST = 3  # names that are worth a wildcard


@dataclass(frozen=True, slots=True)
class Proposal:
    """A wildcard in place of names: ``saves`` bytes of the signed document.

    ``adds`` are the topics and services known from elsewhere that it would newly allow.  A safe
    proposal has none; it still allows names that nobody has used so far.
    """

    rule: Right
    replaces: tuple[Right, ...]
    adds: tuple[Right, ...]
    saves: int


def propose_wildcards(
    enclave: str,
    rights: Iterable[Right],
    known: Iterable[Right],
    *,
    needed: int,
    size: Callable[[Right], int],
) -> tuple[Proposal, ...]:
    """Wildcards by which the document of an enclave becomes ``needed`` bytes smaller, if possible.

    ``rights`` are the enclave's, ``known`` those of every enclave, ``size`` tells the bytes that a
    right takes.  Those that save most come first; such that grant something known are used only
    if the safe ones do not suffice.
    """
    own = [right for right in rights if right.enclave == enclave and right.qualifier is ALLOW]
    rules = Rules(own)
    foreign = _foreign(enclave, rules, known)
    candidates: dict[frozenset[Right], Proposal] = {}
    for rule, found in _candidates(own).items():
        other = candidates.get(frozenset(found))
        # Of wildcards that stand for the same names, the one that says most grants least.
        if other is None or len(rule.name) > len(other.rule.name):
            adds = tuple(sorted(_added(rule, foreign), key=order))
            saves = sum(map(size, found)) - size(rule)
            names = tuple(sorted(found, key=order))
            candidates[frozenset(found)] = Proposal(rule, names, adds, saves)
    best = sorted(
        candidates.values(), key=lambda each: (len(each.adds), -each.saves, order(each.rule))
    )
    chosen: list[Proposal] = []
    replaced: set[Right] = set()
    for each in best:
        if needed <= 0:
            break
        names = tuple(right for right in each.replaces if right not in replaced)
        saves = sum(map(size, names)) - size(each.rule)
        if len(names) < _FEWEST or saves <= 0:
            continue
        chosen.append(Proposal(each.rule, names, each.adds, saves))
        replaced.update(names)
        needed -= saves
    return tuple(chosen)


def _candidates(rights: Iterable[Right]) -> dict[Right, list[Right]]:
    """The wildcards that stand for several names of one right, with these."""
    found: dict[Right, list[Right]] = defaultdict(list)
    for right in rights:
        if right.name.startswith("/") and not is_expression(right.name):
            for expression in set(_wider(right.name)):
                found[right._replace(name=expression)].append(right)
    return {rule: names for rule, names in found.items() if len(names) >= _FEWEST}


def _wider(name: str) -> Iterator[str]:
    """A folder with all below it, never that of the root; and the name without its numbers."""
    tokens = name.split("/")[1:-1]
    for depth in range(1, len(tokens) + 1):
        yield "/" + "/".join((*tokens[:depth], "*"))
    numbers = list(_DIGITS.finditer(name))
    for number in numbers:
        yield f"{name[: number.start()]}*{name[number.end() :]}"
    if len(numbers) > 1:
        yield _DIGITS.sub("*", name)


def _foreign(enclave: str, own: Rules, known: Iterable[Right]) -> dict[str, list[str]]:
    """The known names by right (in parts of actions) that the enclave is not allowed."""
    by_service: dict[bool, set[str]] = {True: set(), False: set()}
    for part in unfolded(known):
        if not is_expression(part.name):
            by_service[part.right in ("request", "reply")].add(part.name)
    return {
        right: sorted(
            name
            for name in by_service[right in ("request", "reply")]
            if not own.cover(Right(enclave, ALLOW, right, name))
        )
        for right in ("publish", "subscribe", "request", "reply")
    }


def _added(rule: Right, foreign: dict[str, list[str]]) -> Iterator[Right]:
    for part in parts(rule):
        match = compiled(part.name).match
        for name in foreign[part.right]:
            if match(name):
                yield part._replace(name=name)
