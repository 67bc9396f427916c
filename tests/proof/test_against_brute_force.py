"""What is decided for all names is what name by name decides, with the engine of each vendor."""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import lru_cache
from itertools import count, permutations

from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.dds.decision.vendors import TESTED
from sros_tool.names import dds_names, expand
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    PROTECT,
    RIGHTS,
    Enclave,
    Group,
    Level,
    Policy,
    Profile,
    Profiles,
    Source,
)
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import KIND_OF
from sros_tool.proof.decide import Witness, decide
from sros_tool.proof.requirements import (
    Apart,
    AtMost,
    Must,
    Nobody,
    NotBoth,
    NothingBut,
    Only,
    Protected,
    Requirement,
    Widest,
    dropped_requirements,
)
from sros_tool.proof.system import policy_system
from tests.proof.brute_force import TOPICS, Finite, breaches, finite
from tests.support.children import LONG
from tests.support.long_form import SEED as DRAWN

NOW = datetime(2027, 1, 1, tzinfo=UTC)
COUNT = int(os.environ.get("SROS_REQUIREMENTS", "4000" if LONG else "10"))
SEED = os.environ.get("SROS_REQUIREMENTS_SEED", DRAWN)
OF_EACH = 40 if LONG else 10
"""Requirements for each policy: to try all names of a policy takes longer than to decide."""
ENCLAVES = ("/e", "/f", "/e/g", "/h")
"""Cyclone DDS takes the permissions of ``/e/g`` for those of ``/e``, too."""
NAMES = (
    "/a", "/b", "/a/b", "/ab", "/abc", "/b/a", "/c", "/*", "/a*", "/*b", "/a/*", "/?", "/a?",
    "/[ab]", "/[!a]*", "/a*b", "/*/b", "/?/?", "*b", "/b*a", "/[a-c]b", "/ca", "/a/_action/*",
)  # fmt: skip
ACTION_PARTS = (
    "/a/_action/send_goal",
    "/a/_action/cancel_goal",
    "/*/_action/get_*",
    "/?/_action/*",
)
PATTERNS = (*NAMES, "*", "/??", "/[bc]*", "*/a", "/*a*", "/c/*")
SOURCE = Source("r.toml", 1)
"""Where every requirement here stands."""


def draw_policy(draw: random.Random) -> Policy:
    """Some enclaves with few rights and denials to names that often meet."""
    protect = draw.choice((None, Level.SIGN, Level.ENCRYPT))
    enclaves = ENCLAVES[: draw.randint(2, 4)]
    return Policy(tuple(draw_enclave(draw, each, protect) for each in enclaves))


def draw_enclave(draw: random.Random, path: str, protect: Level | None) -> Enclave:
    groups = []
    for _ in range(draw.randint(1, 4)):
        right = draw.choice(("publish", "subscribe") * 3 + tuple(KIND_OF))
        qualifier = DENY if draw.random() < 0.25 else ALLOW
        some = ACTION_PARTS if right in ("request", "reply") and draw.random() < 0.6 else NAMES
        names = tuple(dict.fromkeys(draw.choices(some, k=draw.randint(1, 2))))
        # One policy says one level: two for one name contradict each other.
        says = protect if draw.random() < 0.4 else None
        groups.append(Group(KIND_OF[right], ((right, qualifier),), names, says))
    return Enclave(path, (Profiles((Profile("/", "node", tuple(groups)),)),))


def draw_requirement(draw: random.Random) -> Requirement:
    def some(of: tuple[str, ...], most: int = 2) -> tuple[str, ...]:
        return tuple(dict.fromkeys(draw.choices(of, k=draw.randint(1, most))))

    enclaves = (*ENCLAVES, *ENCLAVES, "*", "/[ef]")
    excepted = (f"!{draw.choice(ENCLAVES)}",) if draw.random() < 0.2 else ()
    right = draw.choice(("publish", "subscribe") * 2 + tuple(KIND_OF))
    rights = ((right, some(PATTERNS)),)
    kind = draw.choice((Only, Nobody, Must, AtMost, Widest, NothingBut, NotBoth, Protected, Apart))
    if kind is Only:
        return Only(source=SOURCE, rights=rights, enclaves=some(enclaves) + excepted)
    if kind is Nobody:
        return Nobody(source=SOURCE, rights=rights)
    if kind is Must:
        return Must(source=SOURCE, rights=rights, enclave=draw.choice(ENCLAVES))
    if kind is AtMost:
        if draw.random() < 0.5:
            rights = ((draw.choice(("call", "execute")), some(("/a", "/?", "/*"))),)
        return AtMost(source=SOURCE, rights=rights, most=draw.randint(1, 2))
    if kind is Widest:
        return Widest(source=SOURCE, rights=rights, enclaves=some(enclaves))
    if kind is NothingBut:
        allowed = tuple((right, some(PATTERNS)) for right in some(tuple(KIND_OF)))
        return NothingBut(source=SOURCE, rights=allowed, enclaves=some(enclaves) + excepted)
    if kind is NotBoth:
        other = ((draw.choice(tuple(KIND_OF)), some(PATTERNS)),)
        return NotBoth(source=SOURCE, first=rights, second=other)
    if kind is Protected:
        names = tuple((draw.choice(tuple(RIGHTS)), each) for each in some(PATTERNS))
        return Protected(source=SOURCE, names=names, level=draw.choice(tuple(PROTECT.values())))
    through = some(enclaves, 1) if draw.random() < 0.3 else ()
    return Apart(
        source=SOURCE, sources=some(enclaves) + excepted, targets=some(enclaves), through=through
    )


def stated(policy: Policy) -> dict[tuple[str, bool], frozenset[str]]:
    """The topics that each enclave may write, and read, without a wildcard."""
    found: dict[tuple[str, bool], set[str]] = {}
    for enclave in policy.enclaves:
        found[enclave.path, True], found[enclave.path, False] = set(), set()
        for profile in enclave.all_profiles():
            for group in profile.groups:
                for right, qualifier in group.rights:
                    for name in group.names:
                        if qualifier is ALLOW and not set("*?[").intersection(name):
                            topics = dds_names(right, name)
                            found[enclave.path, True].update(topics.publish)
                            found[enclave.path, False].update(topics.subscribe)
    return {place: frozenset(topics) for place, topics in found.items()}


def levels(policy: Policy) -> Callable[[str], int]:
    """How well a topic is protected, by what the policy says of the names that it has there.

    The default template encrypts everything else.
    """
    signed = {
        topic
        for enclave in policy.enclaves
        for profile in enclave.all_profiles()
        for group in profile.groups
        if group.protect is Level.SIGN
        for name in group.names
        for right in RIGHTS[group.kind]
        for side in dds_names(right, expand(name, "/", ""))
        for topic in side
    }
    return lru_cache(None)(lambda topic: 1 if any(matches(e, topic) for e in signed) else 2)


def cases() -> Iterator[tuple[int, Policy, list[Requirement]]]:
    """Yield policies, each with several requirements."""
    for number in count():
        draw = random.Random(f"{SEED}.{number}")
        yield number, draw_policy(draw), [draw_requirement(draw) for _ in range(OF_EACH)]


def test_every_decision_is_that_of_brute_force() -> None:
    seen: Counter[tuple[str, str, bool]] = Counter()
    different: list[str] = []
    implied = 0
    for number, policy, requirements in cases():
        system, protected = policy_system(policy, Circumstances(NOW)), levels(policy)
        implications = [
            (old, new)
            for old, new in permutations(requirements, 2)
            if not dropped_requirements([old], [new])
        ]
        for world in system.worlds:
            # The links of Zenoh are always encrypted.
            level = (lambda _: 2) if world.title == "Zenoh" else protected
            small = finite(world.enclaves, stated(policy), world.confirm_own, level)
            small = small.lending() if "Cyclone" in world.title else small
            broken = []
            for requirement in requirements:
                witness = decide(requirement, world).witness
                different += disagreements(number, requirement, world.title, witness, small)
                seen[world.title, requirement.KIND, witness is not None] += 1
                broken += [requirement] if witness else []
            implied += len(implications)
            for old, new in implications:
                if old in broken and new not in broken:
                    different.append(f"{number}, {world.title}: {new} does not imply {old}")
        # ``COUNT`` requirements in all, and more where no policy was for Zenoh.
        if number + 1 >= COUNT // OF_EACH and any(title == "Zenoh" for title, _, _ in seen):
            break
    assert different == []
    assert len({title for title, _, _ in seen}) == len(TESTED) + 1  # and Zenoh
    if LONG:
        assert min(seen.values()) > COUNT / 1000
        assert implied > COUNT / 100
    print(seen)


def disagreements(
    number: int, requirement: Requirement, world: str, witness: Witness | None, small: Finite
) -> Iterator[str]:
    """Where a decision differs from that of brute force.

    Only short names are tried there: a longer witness was confirmed by the engine itself.
    """
    found = list(breaches(requirement, small))
    if found and witness is None:
        yield f"{number}, {world}: {requirement} breaks by {found[0]}"
    if witness is None:
        return
    if isinstance(requirement, Apart):
        length = min(map(len, found), default=len(ENCLAVES) + 1)
        if len(witness.uses) > 2 * (length - 1):
            yield f"{number}, {world}: {requirement} has a chain of {length}, and not {witness}"
        return
    for uses in (witness.uses, *witness.others):
        if not all(use.topic in TOPICS for use in uses):
            continue
        is_allowed = all(small.may(use.enclave, use.writes, use.topic) for use in uses)
        if (uses[0].name,) not in found or not (
            isinstance(requirement, Must | Protected) or is_allowed
        ):
            yield f"{number}, {world}: {requirement} does not break by {uses}"
