"""What one side of a comparison lets enclaves do that the other one does not, for all names.

Each vendor's rules are compared as sets of topics, and each name that is reported was confirmed by
the decision of that vendor on this name.  Nothing is reported only if no name at all is added.

This module reads no files.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice

from sros_tool.automata import NameSet, SearchLimit
from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.dds.decision.matching import matches, names_of
from sros_tool.dds.decision.vendors import MEASURED, Style, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, TopicRule
from sros_tool.dds.permissions import Grant
from sros_tool.errors import DocumentError
from sros_tool.keystore.comparison import Effect, SettingChange, attribute_changes
from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
from sros_tool.names import ROS_DISCOVERY_TOPIC, is_expression
from sros_tool.policy.model import ALLOW, Source
from sros_tool.policy.protection import Level
from sros_tool.policy.rights import Right
from sros_tool.policy.stated import StatedProtection
from sros_tool.proof.access import domains_of, enforced_access, is_enforced
from sros_tool.proof.sources import ALL_DOMAINS, AT, KEYSTORE_ITSELF, AccessSource, Trust
from sros_tool.proof.worlds import named, valid_topics
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, Hop, HopPath, Network, unguarded
from sros_tool.topics import SERVICE_ENDS, dds_names
from sros_tool.translate import governance_for

_VERBS = (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)
_ZENOH = "Zenoh"
_JOIN = "join"


@dataclass(frozen=True, slots=True)
class Gain:
    """Something that enclaves may do on one side only.

    ``action`` is publish, subscribe, request, reply, call or execute; write or read for a DDS
    ``topic`` that no stated right gives; or join.  ``right`` is the right that gives it, at
    ``source``, if one is stated.  ``name`` is an example: a name for which it is so.  ``denied``
    is where the other side denies it.  ``worlds`` are the vendors that decide so, ``domains``
    examples of domains.
    """

    enclaves: tuple[str, ...]
    action: str
    right: Right | None
    name: str
    topic: str
    source: Source | None
    denied: Right | None
    denied_at: Source | None
    worlds: tuple[str, ...]
    domains: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class NewReach:
    """An enclave that another one can influence on one side only, by a shortest path."""

    source: str
    target: str
    path: HopPath


@dataclass(frozen=True, slots=True)
class Growth:
    """What HEAD adds to BASE, and what it removes; true if it adds anything or protects less.

    ``reach`` has at most 10,000 pairs; ``reach_unknown`` says why it was not followed, if so.
    ``worlds`` are what was decided.
    """

    added: tuple[Gain, ...]
    removed: tuple[Gain, ...]
    reach: tuple[NewReach, ...]
    reach_unknown: str
    lost: tuple[SettingChange, ...]
    """The protection that is less; `SettingChange` says what it was and what it is."""
    gained: tuple[SettingChange, ...]
    """The protection that is more, as the change that would undo it."""
    worlds: tuple[str, ...]

    def __bool__(self) -> bool:
        return bool(self.added or self.lost)


def compare_access(base: AccessSource, head: AccessSource) -> Growth:
    """Return what ``head`` gives that ``base`` does not, and the reverse.

    Raises:
        DocumentError: it cannot be decided: for too many wildcards, or permissions that a vendor
            does not accept.
    """
    limit = SearchLimit()
    scope = None
    if base.scope is None or head.scope is None:
        scope = head.scope if base.scope is None else base.scope
    worlds = _worlds(base, head)
    added = tuple(_gains(base, head, worlds, scope, limit))
    removed = tuple(_gains(head, base, worlds, scope, limit))
    sides = (_edges(base), _edges(head)) if added and scope is None else ({}, {})
    unknown = "only some enclaves are compared" if scope is not None else ""
    if None in sides:
        unknown = f"there are more than {_MOST_HOPS:,} hops between enclaves"
    return Growth(
        added,
        removed,
        tuple(islice(_new_reach(*sides), _MOST_REACH)),
        unknown,
        tuple(dict.fromkeys(_loosened(base, head, limit))),
        tuple(
            replace(e, effect=Effect.TIGHTER) for e in dict.fromkeys(_loosened(head, base, limit))
        ),
        tuple(each.title for each in worlds),
    )


# ── worlds ─────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Access:
    """What an enclave may do in one world and domain: sets of topics, and decisions to confirm."""

    topics: Mapping[AccessVerb, NameSet]
    decide: Callable[[AccessVerb, str], bool]
    joins: bool


_NO_ACCESS = _Access(dict.fromkeys(_VERBS, NameSet()), lambda verb, topic: False, joins=False)


@dataclass(frozen=True, slots=True)
class _World:
    """A vendor, or Zenoh, with the domains that are compared there."""

    title: str
    style: Style
    domains: tuple[int, ...]
    access: Callable[[AccessSource, str, int], _Access]
    longest: int | None = None


def _worlds(base: AccessSource, head: AccessSource) -> list[_World]:
    found = []
    if "zenoh" not in (base.kind, head.kind):
        governances = _governances(base, head)
        domains = _domains(base, head, governances.values())
        for vendor in MEASURED:
            by_side = _of_vendor(vendor, governances)
            longest = vendor.traits.longest_topic_name
            found.append(_World(vendor.title, vendor.traits.style, domains, by_side, longest))
    if base.zenoh is not None or head.zenoh is not None:
        domains = domains_of((*base.enforcers, *head.enforcers)) or (0,)
        found.append(_World(_ZENOH, Style.FNMATCH, domains, _on_zenoh(base, head)))
    return found


def _governances(base: AccessSource, head: AccessSource) -> dict[int, Governance]:
    """Return the governance of each side, by its id: that of the other one if it has none."""
    strict = governance_for(load_template(DEFAULT_TEMPLATE).protection, ALL_DOMAINS)
    of = base.governance or head.governance or strict
    return {id(base): of, id(head): head.governance or of}


def _domains(
    base: AccessSource, head: AccessSource, governances: Iterable[Governance]
) -> tuple[int, ...]:
    """Return one domain of each kind: between two of them, all have the same rules as the first."""
    listed = {rule.domains for each in governances for rule in each.domain_access_rules}
    granted = {
        rule.domains
        for side in (base, head)
        for each in side.permissions.values()
        for grant in each.grants
        for rule in grant.rules
    }
    return DomainSet.one_of_each_kind(listed, granted)


def _of_vendor(
    vendor: Vendor, governances: Mapping[int, Governance]
) -> Callable[[AccessSource, str, int], _Access]:
    def access(side: AccessSource, enclave: str, domain: int) -> _Access:
        permissions = side.permissions.get(enclave)
        if permissions is None:
            return _NO_ACCESS
        subject = permissions.grants[0].subject if permissions.grants else ""
        found = Access(vendor, governances[id(side)], permissions, subject, domain=domain, at=AT)
        if found.join().reason in ("no-grant", "malformed") or found.join().outcome == "crashes":
            raise DocumentError(
                f"the permissions of {enclave} in '{side.shown}' cannot be compared",
                found.join().text,
                "Sign them again.",
            )
        return _Access(
            {verb: found.topics(verb) for verb in _VERBS},
            lambda verb, topic: found.decide(verb, topic).outcome.ok,
            found.join().outcome.ok,
        )

    return access


def _on_zenoh(*sides: AccessSource) -> Callable[[AccessSource, str, int], _Access]:
    """Return the access that rules of Zenoh give, or for a side without them its rights."""
    stated = _of_rights({id(each): each.rights for each in sides if each.zenoh is None})

    def access(side: AccessSource, enclave: str, domain: int) -> _Access:
        if side.zenoh is None:
            return stated(side, enclave, domain)
        if enclave == side.router:
            return _NO_ACCESS
        found = enforced_access(side.enforcers, enclave, domain)

        def decide(verb: AccessVerb, topic: str) -> bool:
            writes = verb is AccessVerb.PUBLISH
            return is_enforced(side.enforcers, enclave, domain, topic, writes=writes)

        writes, reads = (each & _ROS_TOPICS for each in (found.writes, found.reads))
        topics = {AccessVerb.PUBLISH: writes, AccessVerb.SUBSCRIBE: reads}
        joins = any(enclave in each.names() for each in side.enforcers)
        return _Access(topics, decide, joins=joins)

    return access


def _of_rights(
    rights: Mapping[int, Collection[Right]],
) -> Callable[[AccessSource, str, int], _Access]:
    """Return the access that rights in ROS terms give, by the id of a side."""
    by_enclave = {side: _by_enclave(some) for side, some in rights.items()}

    def access(side: AccessSource, enclave: str, _: int) -> _Access:
        own = by_enclave[id(side)].get(enclave, ())
        allowed, denied = (
            {
                verb: [
                    topic
                    for right in own
                    if (right.qualifier is ALLOW) is allows
                    for topic in _topics_of(right)[verb]
                ]
                for verb in _VERBS
            }
            for allows in (True, False)
        )

        def decide(verb: AccessVerb, topic: str) -> bool:
            def any_of(some: Iterable[str]) -> bool:
                return any(matches(Style.FNMATCH, each, topic) for each in some)

            return any_of(allowed[verb]) and not any_of(denied[verb])

        def topics(verb: AccessVerb) -> NameSet:
            given = names_of(Style.FNMATCH, allowed[verb]) - names_of(Style.FNMATCH, denied[verb])
            return given & _ROS_TOPICS

        return _Access({verb: topics(verb) for verb in _VERBS}, decide, joins=bool(own))

    return access


def _by_enclave(rights: Iterable[Right]) -> dict[str, list[Right]]:
    found: dict[str, list[Right]] = defaultdict(list)
    for each in sorted(rights):
        found[each.enclave].append(each)
    return found


def _topics_of(right: Right) -> dict[AccessVerb, tuple[str, ...]]:
    """Return the DDS topics of a right that it writes and reads, as expressions."""
    if right.kind == "dds":
        return {verb: (right.name,) if right.right == verb else () for verb in _VERBS}
    names = dds_names(right.right, right.name)
    return {AccessVerb.PUBLISH: names.publish, AccessVerb.SUBSCRIBE: names.subscribe}


# ── rights ─────────────────────────────────────────────────────────────────────────────────


def _gains(
    old: AccessSource,
    new: AccessSource,
    worlds: Sequence[_World],
    scope: Collection[str] | None,
    limit: SearchLimit,
) -> Iterator[Gain]:
    """Yield what ``new`` gives that ``old`` does not: the same in several worlds once."""
    found: dict[tuple[object, ...], tuple[Gain, set[str], set[int]]] = {}
    for gain in _each_gain(old, new, worlds, scope, limit):
        key = gain.enclaves[0], gain.action, gain.right, gain.name or gain.topic
        _, seen, domains = found.setdefault(key, (gain, set(), set()))
        seen.update(gain.worlds)
        domains.update(gain.domains)
    order = [each.title for each in worlds]
    together: dict[Gain, list[str]] = {}
    for gain, seen, domains in found.values():
        one = replace(
            gain,
            worlds=tuple(each for each in order if each in seen),
            domains=tuple(sorted(domains)),
        )
        # What the governance gives, it gives to many.
        alike = one if one.right else replace(one, enclaves=())
        together.setdefault(alike, []).extend(gain.enclaves)
    for gain, enclaves in together.items():
        yield replace(gain, enclaves=tuple(dict.fromkeys(enclaves)))


def _each_gain(
    old: AccessSource,
    new: AccessSource,
    worlds: Sequence[_World],
    scope: Collection[str] | None,
    limit: SearchLimit,
) -> Iterator[Gain]:
    stated = _Stated(old, new)
    names = set(new.permissions) | {each.enclave for each in new.rights}
    names.update(*(each.names() for each in new.enforcers))
    for enclave in sorted(names if scope is None else names.intersection(scope)):
        for world in worlds:
            if _same(old, new, enclave, world):
                continue
            for domain in world.domains:
                before, after = (world.access(side, enclave, domain) for side in (old, new))
                found = False
                for verb in _VERBS:
                    more = after.topics[verb] - before.topics[verb]
                    if enclave not in old.permissions:
                        more -= NameSet((ROS_DISCOVERY_TOPIC,))  # every participant has it
                    for gain in stated.gains(enclave, verb, more, world, domain, limit):
                        if not after.decide(verb, gain.topic) or before.decide(verb, gain.topic):
                            raise AssertionError(f"{gain} is not what {world.title} decides")
                        found = True
                        yield gain
                if not found and after.joins and not before.joins:
                    yield Gain(
                        (enclave,), _JOIN, None, "", "", None, None, None, (world.title,), (domain,)
                    )


def _same(old: AccessSource, new: AccessSource, enclave: str, world: _World) -> bool:
    """Return whether an enclave certainly has the same access on both sides."""
    if world.title == _ZENOH:
        return None not in (old.zenoh, new.zenoh) and old.enforcers == new.enforcers
    if old.governance and new.governance and old.governance != new.governance:
        return False
    one, other = old.permissions.get(enclave), new.permissions.get(enclave)
    if one is None or other is None:
        return one is other
    return [_without_name(each) for each in one.grants] == [
        _without_name(each) for each in other.grants
    ]


def _without_name(grant: Grant) -> Grant:
    return replace(grant, name="")


class _Stated:
    """The rights that two sides state, to say which one gives what ``new`` adds."""

    def __init__(self, old: AccessSource, new: AccessSource) -> None:
        self._old, self._new = old, new
        self._examples: dict[tuple[str, AccessVerb, str], list[str]] = defaultdict(list)
        rights = new.rights if new.zenoh is None else new.rights | new.zenoh
        earlier = old.rights if old.zenoh is None else old.rights | old.zenoh
        self._allowed = _by_enclave(each for each in rights if each.qualifier is ALLOW)
        self._denied = _by_enclave(each for each in earlier if each.qualifier is not ALLOW)

    def gains(
        self,
        enclave: str,
        verb: AccessVerb,
        more: NameSet,
        world: _World,
        domain: int,
        limit: SearchLimit,
    ) -> Iterator[Gain]:
        """Yield a gain for each right that is stated for some of ``more``, and for the rest."""
        allowed = [(each, _topics_of(each)[verb]) for each in self._allowed.get(enclave, ())]
        denials = self._denied.get(enclave, ())
        denied = names_of(world.style, (e for each in denials for e in _topics_of(each)[verb]))
        for right, topics in allowed:
            for expression in topics:
                own = more & names_of(world.style, (expression,))
                topic = self._example(own, (enclave, verb, expression), world, limit)
                if topic is None:
                    continue
                gain = self._gain(enclave, verb, right, expression, topic, world, domain)
                yield gain
                if gain.denied and is_expression(expression):
                    # Perhaps there is more than a denial that is gone.
                    topic = self._example(own - denied, (enclave, verb, expression), world, limit)
                    if topic is not None:
                        yield self._gain(enclave, verb, right, expression, topic, world, domain)
                break
        stated = names_of(world.style, (each for _, topics in allowed for each in topics))
        topic = self._example(more - stated, (enclave, verb, "*"), world, limit)
        if topic is not None:
            yield self._gain(enclave, verb, None, topic, topic, world, domain)

    def _example(
        self, names: NameSet, key: tuple[str, AccessVerb, str], world: _World, limit: SearchLimit
    ) -> str | None:
        """Return an example, the same one as in another world if it is one here, too."""
        for topic in self._examples[key]:
            if topic in names and (world.longest is None or len(topic.encode()) <= world.longest):
                return topic
        found = _example(names, key[2], world, limit)
        if found is not None:
            self._examples[key].append(found)
        return found

    def _gain(
        self,
        enclave: str,
        verb: AccessVerb,
        right: Right | None,
        expression: str,
        topic: str,
        world: _World,
        domain: int,
    ) -> Gain:
        denied = next(
            (
                each
                for each in self._denied.get(enclave, ())
                if any(matches(world.style, text, topic) for text in _topics_of(each)[verb])
            ),
            None,
        )
        name, action = topic, "write" if verb is AccessVerb.PUBLISH else "read"
        if right:
            at = expression.find(right.name)  # a name in permissions can be empty
            end = len(expression) - at - len(right.name)
            name, action = topic[at : len(topic) - end], right.right
        return Gain(
            (enclave,),
            action,
            right,
            name,
            topic,
            self._new.source_of(right) if right else None,
            denied,
            self._old.source_of(denied) if denied else None,
            (world.title,),
            (domain,),
        )


def _example(names: NameSet, expression: str, world: _World, limit: SearchLimit) -> str | None:
    """Return a topic of a set that an expression covers: one of a ROS name if there is any."""
    if not is_expression(expression):
        return expression if expression in names else None
    found = names.example(limit, longest=world.longest)
    if found is None or found in _ROS_TOPICS:
        return found
    return (names & _ROS_TOPICS).example(limit, longest=world.longest) or found


_ROS_TOPICS = NameSet.union(
    valid_topics(begin, end) for begin, end in (("rt", ""), *SERVICE_ENDS.items())
)
"""The topics of all valid ROS names."""


# ── reach ──────────────────────────────────────────────────────────────────────────────────


_Edges = Mapping[str, Mapping[str, Hop]]
"""By source and target: a hop from one enclave to another."""
_MOST_REACH = 10_000
_MOST_HOPS = 200_000


def _new_reach(before: _Edges | None, after: _Edges | None) -> Iterator[NewReach]:
    """Yield whom enclaves can influence after and not before, over new hops; none if unknown."""
    if before is None or after is None:
        return
    changed = {
        source for source, of in after.items() if not of.keys() <= before.get(source, {}).keys()
    }
    backwards: dict[str, dict[str, Hop]] = defaultdict(dict)
    for source, of in after.items():
        for target, hop in of.items():
            backwards[target][source] = hop
    sources = changed.union(*(_reached(backwards, each) for each in sorted(changed)))
    for source in sorted(sources):
        known = _reached(before, source).keys()
        found = _reached(after, source)
        for target in sorted(found.keys() - known - {source}):
            path: list[Hop] = []
            at = target
            while at != source:
                path.insert(0, found[at])
                at = found[at].source
            yield NewReach(source, target, tuple(path))


def _edges(side: AccessSource) -> _Edges | None:
    """Return all hops, or None if there are too many to follow them."""
    network = _network(side)
    found: dict[str, Mapping[str, Hop]] = {}
    left = _MOST_HOPS
    for each in network.enclaves:
        found[each] = {hop.target: hop for hop in network.hops(each)}
        left -= len(found[each])
        if left < 0:
            return None
    return found


def _reached(edges: _Edges, start: str) -> dict[str, Hop]:
    """Return the enclaves that hops lead to, each with the last hop of a shortest path."""
    found: dict[str, Hop] = {}
    row = [start]
    for here in row:
        for there, hop in edges.get(here, {}).items():
            if there not in found and there != start:
                found[there] = hop
                row.append(there)
    return found


def _network(side: AccessSource) -> Network:
    rights = side.zenoh if side.kind == "zenoh" and side.zenoh is not None else side.rights
    return Network(
        rights,
        without=OF_EVERY_NODE,
        questions=QUESTIONS,
        unguarded=unguarded(side.governance) if side.governance else (),
        everybody=sorted(side.permissions),
    )


# ── protection ─────────────────────────────────────────────────────────────────────────────


def _loosened(old: AccessSource, new: AccessSource, limit: SearchLimit) -> Iterator[SettingChange]:
    """Yield what is protected less in ``new`` than in ``old``."""
    if old.governance and new.governance:
        yield from _looser_governance(old.governance, new.governance, limit)
    if old.authorities is not None and new.authorities is not None:
        for role, each in sorted(new.authorities - old.authorities):
            yield SettingChange(
                Effect.LOOSER,
                f"{role} CA {each[:16]}...",
                "unknown",
                "trusted",
                "whoever has its key can become any enclave"
                if role == "identity"
                else "whoever has its key can give any right",
            )
    yield from _trusted_again(old, new)
    if old.kind == new.kind == "keystore" and old.zenoh is not None and new.zenoh is None:
        text = "nothing enforces on Zenoh what its files enforced"
        yield SettingChange(Effect.LOOSER, "files of Zenoh", "present", "missing", text)
    if old.router and new.router and old.router != new.router:
        text = "whoever plays the router reads and changes all that passes"
        yield SettingChange(Effect.LOOSER, "router of Zenoh", old.router, new.router, text)
    if old.protections and new.protections is not None:
        yield from _no_longer_stated(old.protections, new.protections, limit)


def _trusted_again(old: AccessSource, new: AccessSource) -> Iterator[SettingChange]:
    """Yield the certificates that enclaves refuse in ``old``, and not in ``new``."""
    if old.trusts is None or new.trusts is None:
        return
    all_revoked = frozenset(each for trust in old.trusts.values() for each in trust.revoked)
    again: dict[int, list[str]] = defaultdict(list)

    @lru_cache(maxsize=8)  # most enclaves have the same lists
    def lost(before: frozenset[tuple[str, int]], after: Trust) -> list[int]:
        gone = before - after.revoked
        return sorted(serial for authority, serial in gone if authority in after.authorities)

    for name in sorted(new.trusts):
        if old.scope is None or new.scope is not None or name in old.scope:
            before = old.trusts[name].revoked if name in old.trusts else all_revoked
            for serial in lost(before, new.trusts[name]):
                again[serial].append(name)
    for serial in sorted(again)[:_MOST_SERIALS]:
        names = [each for each in again[serial] if each != KEYSTORE_ITSELF] or [KEYSTORE_ITSELF]
        who = f"{names[0]} trusts" if len(names) == 1 else f"{len(names)} enclaves trust"
        text = f"{who} whoever has its key again"
        yield SettingChange(Effect.LOOSER, f"certificate {serial:x}", "revoked", "trusted", text)
    if (more := len(again) - _MOST_SERIALS) > 0:
        text = "enclaves trust whoever has their keys again"
        yield SettingChange(Effect.LOOSER, f"{more} certificates more", "revoked", "trusted", text)


_MOST_SERIALS = 20


def _looser_governance(
    old: Governance, new: Governance, limit: SearchLimit
) -> Iterator[SettingChange]:
    pairs = dict.fromkeys(
        (one, other)
        for one in old.domain_access_rules
        for other in new.domain_access_rules
        if any(each in other.domains.closed() for each in one.domains.closed())
    )
    for one, other in pairs:
        for each in attribute_changes(one, other, "protection", ""):
            if each.effect is Effect.LOOSER:
                yield each
        for style in Style:
            yield from _looser_topics(one, other, style, limit)


def _looser_topics(
    old: DomainRule, new: DomainRule, style: Style, limit: SearchLimit
) -> Iterator[SettingChange]:
    for before, had in _by_protection(old, style):
        for after, has in _by_protection(new, style):
            changes = [
                each
                for each in attribute_changes(before, after, "protection", "{}")
                if each.effect is Effect.LOOSER
            ]
            both = had & has
            if not changes:
                continue
            topic = both.example(limit)
            if topic is None:
                continue
            if topic not in _ROS_TOPICS:
                topic = (both & _ROS_TOPICS).example(limit) or topic
            for each in changes:
                yield replace(each, meaning=each.meaning.replace("{}", f"DDS topic {topic}"))


def _by_protection(rule: DomainRule, style: Style) -> list[tuple[TopicRule, NameSet]]:
    """Return each protection of topics, as a rule without its expression, and all its topics."""
    rules = [
        (names_of(style, (each.topic_expression,)), replace(each, topic_expression="*"))
        for each in rule.topic_access_rules
    ]
    return [
        (kind, NameSet.first((names, each == kind) for names, each in rules))
        for kind in dict.fromkeys(each for _, each in rules)
    ]


def _no_longer_stated(
    old: Iterable[StatedProtection], new: Iterable[StatedProtection], limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield the names whose protection one policy demands, and the other one less or not."""
    later = tuple(new)
    for each in old:
        enough = [
            other.name
            for other in later
            if other.kind == each.kind and (other.level, each.level) != (Level.SIGN, Level.ENCRYPT)
        ]
        names = _named((each.name,)) - _named(enough)
        found = names.example(limit)
        if found is not None:
            valid = names & _ABSOLUTE
            name = found if found in _ABSOLUTE else valid.example(limit) or found
            less = "sign" if name in _named(_signed(later, each.kind)) else "nothing"
            yield SettingChange(
                Effect.LOOSER,
                f"protect {each}",
                each.word,
                less,
                f"the policy no longer demands it of {each.kind.removesuffix('s')} {name}",
            )


def _signed(stated: Iterable[StatedProtection], kind: str) -> list[str]:
    return [each.name for each in stated if each.kind == kind]


def _named(names: Iterable[str]) -> NameSet:
    return NameSet.union(map(named, names))


_ABSOLUTE = valid_topics("", "")
"""All absolute ROS names."""
