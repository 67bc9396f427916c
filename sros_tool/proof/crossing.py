"""Find names that pass between Zenoh routers on one side of a comparison only.

Two enclaves at the same router exchange all that their rights allow.  At two routers they exchange
only names that both routers let cross.  So more names pass if ``crossing`` gets wider, if a router
is removed, or if an enclave moves to the router of another one.

This module reads no files.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from functools import lru_cache

from sros_tool.automata import NameSet, SearchLimit
from sros_tool.keystore.comparison import Effect, SettingChange
from sros_tool.keystore.fleet import with_routers_of_robots
from sros_tool.proof.sources import AccessSource
from sros_tool.proof.worlds import named, valid_topics
from sros_tool.zenoh.configuration import ZenohNetwork

_ALL = named("*")
_ABSOLUTE = valid_topics("", "")


def limits_crossing(side: AccessSource) -> bool:
    """Return whether the settings or the fleet of a side limit which names cross."""
    network = _network(side, side)
    return network is not None and _routers_limit_names(network)


def states_routers(side: AccessSource) -> bool:
    """Return whether settings or fleet of a side name the routers, and what crosses there."""
    return _network(side, side) is not None


def added_crossing(
    old: AccessSource, new: AccessSource, limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield the changes of settings and fleet file that let more names pass between Zenoh routers.

    More names pass in ``new`` than in ``old``.
    """
    before, after = _network(old, new), _network(new, old)
    if before is None or not _routers_limit_names(before):
        return
    if after is None:
        if new.later is not None and new.zenoh_files:
            meaning = "what passes between routers is not known"
            yield SettingChange(
                Effect.LOOSER, "Zenoh settings", "limit crossing", "missing", meaning
            )
        return
    kept = {*before.router_names()} & {*after.router_names()}
    for router in sorted(kept):
        one, other = _expressions(before, router), _expressions(after, router)
        if one != other and (name := _more(one, other, limit)):
            meaning = f"{name} may pass between this router and others"
            yield SettingChange(
                Effect.LOOSER, f"crossing of router {router}", _text(one), _text(other), meaning
            )
    yield from _moved(before, after, {*new.permissions, *new.certified, *kept}, limit)


def _moved(
    before: ZenohNetwork, after: ZenohNetwork, enclaves: set[str], limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield moves of enclaves to another router that lets more of their names pass."""
    places: dict[tuple[str, str], str] = {}
    for enclave in sorted(enclaves):
        places.setdefault((_router(before, enclave), _router(after, enclave)), enclave)
    for (one, other), enclave in places.items():
        if one == other:
            continue
        for there, later in places:
            if there == one:
                continue
            has = () if later == other else _both(after, other, later)
            if name := _more(_both(before, one, there), has, limit):
                crossing = _text(_both(before, one, there))
                yield SettingChange(
                    Effect.LOOSER,
                    f"router of {enclave}",
                    f"{one}, where {crossing} crosses",
                    other,
                    f"{name} may pass between this enclave and enclaves that were at {there}",
                )
                break


def looser_router_rules(
    old: AccessSource, new: AccessSource, limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield changes of routers' rules that allow other routers more than in ``old``.

    A removed router counts only if the settings do not say which router its enclaves connect to
    now.
    """
    if new.routers and not (states_routers(old) and states_routers(new)):
        for router in sorted({*old.passing} - {*new.routers}):
            meaning = "its enclaves may now be at the same router as others"
            yield SettingChange(
                Effect.LOOSER, f"router {router} of Zenoh", "present", "missing", meaning
            )
    routers: dict[tuple[str, str], list[str]] = defaultdict(list)
    for router in sorted(old.passing.keys() & new.passing.keys()):
        had = old.passing[router]
        for right in sorted(new.passing[router] - had):
            if right.enclave not in old.passing:
                continue
            known = [r.name for r in had if r[:-1] == right[:-1]]
            if name := _more(((right.name,), tuple(known)), ((right.name,),), limit):
                routers[router, right.enclave].append(name)
    for (router, other), names in routers.items():
        yield SettingChange(
            Effect.LOOSER,
            f"rules of router {router} for router {other}",
            "without",
            f"with {names[0]}",
            "it may pass between them",
        )


_Crossing = tuple[tuple[str, ...], ...]
"""Lists of expressions; a name crosses if it matches an expression of every list."""


def _more(before: _Crossing, after: _Crossing, limit: SearchLimit) -> str:
    """Return a name that crosses by ``after`` but not by ``before``; "" if there is none."""
    names = _names(after) - _names(before)
    return (names & _ABSOLUTE).example(limit) or names.example(limit) or ""


@lru_cache(maxsize=1024)
def _names(crossing: _Crossing) -> NameSet:
    names = _ALL
    for expressions in crossing:
        names &= NameSet.union(map(named, expressions))
    return names


def _expressions(network: ZenohNetwork, router: str) -> _Crossing:
    own = next((each.crossing for each in network.routers if each.name == router), ())
    return tuple(dict.fromkeys(filter(None, (network.crossing, own))))


def _both(network: ZenohNetwork, one: str, other: str) -> _Crossing:
    return tuple(dict.fromkeys((*_expressions(network, one), *_expressions(network, other))))


def _router(network: ZenohNetwork, enclave: str) -> str:
    return enclave if enclave in network.router_names() else network.router_of(enclave).name


def _text(crossing: _Crossing) -> str:
    return " within ".join(",".join(expressions) for expressions in crossing) or "everything"


def _routers_limit_names(network: ZenohNetwork) -> bool:
    return bool(network.routers) and any(
        (network.crossing, *(router.crossing for router in network.routers))
    )


def _network(side: AccessSource, other: AccessSource) -> ZenohNetwork | None:
    """Return the Zenoh network of a side, or None if neither side says anything about routers.

    The settings of the side state it; else its fleet, with the settings of the other side.
    """
    if side.later is not None:
        return side.later.zenoh
    if side.kind != "policy" or side.fleet is None:
        return None
    settings = other.later.zenoh if other.later else ZenohNetwork()
    return with_routers_of_robots(settings, other.fleet, side.fleet) if settings else None
