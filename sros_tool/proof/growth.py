"""Find access that HEAD grants and BASE does not, and the reverse, for all names.

The rules of each vendor are compared as sets of topics.  The vendor's decision on each reported
name confirms the result.  If nothing is found, there is no such access for any name.

A policy states no governance and, except for robots of a fleet, no domains; permissions state no
governance.  If a side does not state these, the comparison assumes them, and names its assumptions.

This module reads no files.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from itertools import chain, islice, product, takewhile
from typing import Annotated, NamedTuple

from sros_tool.automata import NameSet, SearchLimit
from sros_tool.dds.decision.access import Access, AccessVerb, GovernedDomain
from sros_tool.dds.decision.expressions import ExpressionIndex, matches, names_of
from sros_tool.dds.decision.grants import (
    ComparisonCrash,
    certified_text,
    other_fitting_enclaves,
    same_subject,
)
from sros_tool.dds.decision.vendors import TESTED, Style, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance
from sros_tool.dds.permissions import Grant, Permissions, Rule
from sros_tool.errors import DocumentError, Note
from sros_tool.fleet.robots import robot_of
from sros_tool.keystore.comparison import Effect, SettingChange
from sros_tool.keystore.rights import SourceKind, compared_enclaves, rights_grouped_by_domains
from sros_tool.names import ROS_DISCOVERY_TOPIC, is_expression, node_of_service, service_of
from sros_tool.policy.model import ALLOW, DENY, Profile, Qualifier, Source
from sros_tool.policy.namespaces import ChangedForm, changed_forms, undenied_name
from sros_tool.policy.patterns import literal_prefix
from sros_tool.policy.rights import (
    KIND_OF,
    Right,
    Rules,
    join_actions,
    node_of,
    nodes_of,
    order,
    parts,
    profile_rights,
    renamed_enclaves,
    split_actions,
)
from sros_tool.proof.protection import (
    added_crossing,
    contradiction,
    less_protection,
    limits_crossing,
    looser_router_rules,
    states_routers,
    strict_protection,
)
from sros_tool.proof.sources import ALL_DOMAINS, AT, AccessSource
from sros_tool.proof.worlds import ROS_TOPICS, any_allows, domains_of, enforced_access, valid_topics
from sros_tool.proof.zenoh_settings import unknown_settings
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, Hop, HopPath, Network, unguarded_topics
from sros_tool.translate import governance_for, grant_rights
from sros_tool.values import Words, shows
from sros_tool.zenoh.configuration import Mode

_VERBS = (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)
_ZENOH = "Zenoh"
_JOIN = "join"


@shows(
    *("enclaves", "action", "right", "name", "topic", "place", "denied_by", "denied_at"),
    *("worlds", "domains"),
)
@dataclass(frozen=True, slots=True)
class Gain:
    """Access that enclaves have on only one side of a comparison.

    ``name`` and ``domains`` are examples.
    """

    enclaves: tuple[str, ...]
    """The enclaves that have the access."""
    action: Annotated[str, Words((*KIND_OF, "write", "read", "join"))]
    """The operation; ``write`` and ``read`` are for a DDS topic that no right states."""
    right: Right | None
    """The right that gives the access, or null if no right states it. If a vendor accepts the
    permissions of another enclave for ``enclaves``, too, this is a right of that other enclave.
    """
    name: str
    """Example of a ROS name with the access; empty for ``join``."""
    topic: str
    """DDS topic of the example name; empty for ``join``."""
    source: Source | None
    denied: Right | None
    denied_at: Source | None
    """File and line of the denial on the other side, or null."""
    worlds: tuple[str, ...]
    """The DDS vendors, or Zenoh, that allow the access."""
    domains: tuple[int, ...]
    """Example ROS domains with the access: one for each group of domains with the same rules."""

    @property
    def place(self) -> Source | None:
        """File and line of the right; null if the right is not in a policy."""
        return self.source

    @property
    def denied_by(self) -> Right | None:
        """The right that denies the name on the other side; null if no right denies it."""
        return self.denied


@dataclass(frozen=True, slots=True)
class NewReach:
    """A pair of enclaves: the source can influence the target on one side only."""

    source: str
    """The enclave that influences."""
    target: str
    """The enclave that is influenced."""
    path: HopPath
    """A shortest path."""


class LostProtection(NamedTuple):
    """A protection that is weaker in HEAD."""

    key: str
    """Name of the protected setting, topic or certificate."""
    before: str
    """The protection in BASE."""
    after: str
    """The protection in HEAD."""
    meaning: str
    """Consequence of the weaker protection."""


class GainedProtection(NamedTuple):
    """A protection that is stronger in HEAD."""

    key: str
    """Name of the protected setting, topic or certificate."""
    before: str
    """The protection in BASE."""
    after: str
    """The protection in HEAD."""


class NewNode(NamedTuple):
    """A node that HEAD assigns to an enclave of BASE, so that its process gets more rights there.

    `sros run --policy` and `ros2 launch --secured` start a node in the enclave that the policy
    assigns to it.
    """

    node: str
    """Full name of the node, perhaps with wildcards."""
    enclave: str
    """The enclave that has the node in HEAD, and not in BASE."""
    moved_from: str
    """An enclave that had the node in BASE, and no longer has it; empty if there is none."""
    rights: tuple[Right, ...]
    """Rights of the enclave that the node did not have in BASE.

    Rights that every node needs come last. If a right is new only because HEAD lacks a DENY of
    BASE, its name is an example.
    """
    place: Source
    """File and line of the node in HEAD."""


class DroppedDenial(NamedTuple):
    """A DENY of BASE with some names that HEAD neither allows nor denies.

    The missing DENY gives no access, but users who merge the policy with others may rely on it.
    """

    denial: Right
    """The denied right, of the enclave that lacks the denial in HEAD."""
    name: str
    """Example of a name that is no longer denied; empty if HEAD denies none of the names."""
    moved_from: str
    """The enclave that denied the name in BASE, if HEAD moves its node to another enclave;
    otherwise empty.
    """


@shows(
    *("new_access", "worlds", "domains", "assumed", "left_out", "not_compared", "added", "reach"),
    *("reach_known", "new_nodes", "elsewhere", "less_protection", "dropped_denials", "removed"),
    *("more_protection",),
)
@dataclass(frozen=True, slots=True)
class Growth:
    """Access and protection that HEAD adds and removes.

    In a condition, the value is True if HEAD adds access or protects less.  ``reach_unknown`` says
    why ``reach`` is not known, or is "".  ``other_domain`` is the one of ``domains`` that stands
    for every domain that no robot has, if both sides are policies; otherwise it is None.
    """

    added: tuple[Gain, ...]
    """Access that HEAD grants and BASE does not."""
    removed: tuple[Gain, ...]
    """Access that BASE grants and HEAD does not."""
    reach: tuple[NewReach, ...]
    """Enclaves that another enclave can influence in HEAD, and not in BASE; at most 10,000 pairs.
    """
    reach_unknown: str
    lost: tuple[SettingChange, ...]
    """The settings that protect less in HEAD."""
    gained: tuple[SettingChange, ...]
    """The settings that protect more in HEAD, as changes from HEAD back to BASE."""
    worlds: tuple[str, ...]
    """The compared DDS vendors, and Zenoh if a side has Zenoh rules."""
    domains: tuple[int, ...]
    """The compared ROS domains: one for each group of domains with the same rules."""
    assumed: tuple[str, ...]
    """Assumptions about a side that does not state everything, such as a policy."""
    left_out: tuple[str, ...]
    """Parts that the comparison leaves out on purpose."""
    not_compared: tuple[str, ...]
    """Parts that could not be compared. If there are any, and nothing is new, this is an error
    with exit status 2.
    """
    new_nodes: tuple[NewNode, ...]
    """Nodes that HEAD assigns to an enclave of BASE, and that thereby get more rights."""
    dropped_denials: tuple[DroppedDenial, ...]
    """Denials that HEAD drops or narrows, without allowing their names; this is not new access."""
    elsewhere: tuple[ChangedForm, ...]
    """Rights of HEAD that are new only for users who put the node into another namespace, because
    the name became absolute or relative; empty for a fleet, whose namespaces are known.
    """
    other_domain: int | None

    @property
    def new_access(self) -> bool:
        """Whether HEAD adds access, or protects anything less."""
        return bool(self)

    @property
    def reach_known(self) -> bool:
        """Whether ``reach`` is known: false if a side has only some enclaves, or if there are too
        many hops between enclaves.
        """
        return not self.reach_unknown

    @property
    def less_protection(self) -> list[LostProtection]:
        """The protections that are weaker in HEAD."""
        return [
            LostProtection(change.key, change.before, change.after, change.meaning)
            for change in self.lost
        ]

    @property
    def more_protection(self) -> list[GainedProtection]:
        """The protections that are stronger in HEAD."""
        return [GainedProtection(change.key, change.after, change.before) for change in self.gained]

    def __bool__(self) -> bool:
        return bool(self.added or self.lost or self.new_nodes or self.elsewhere)

    def without_renames(self, renamed: Mapping[str, str]) -> Growth:
        """Return this growth without access that only comes from the new names of enclaves.

        ``renamed`` is the result of `renamed_between`. If no other access is added, then no
        influence is added either.
        """
        names = {*renamed, *renamed.values()}

        def is_no_rename(gain: Gain) -> bool:
            is_own_right = gain.right is not None and gain.enclaves == (gain.right.enclave,)
            return not is_own_right or gain.enclaves[0] not in names or gain.denied is not None

        added, removed = (
            tuple(filter(is_no_rename, gains)) for gains in (self.added, self.removed)
        )
        reach = self.reach
        if not added:
            reach = tuple(new for new in reach if names.isdisjoint((new.source, new.target)))
        return replace(self, added=added, removed=removed, reach=reach)


def renamed_between(base: AccessSource, head: AccessSource) -> dict[str, str]:
    """Map enclaves of BASE to the enclaves of HEAD with the same rights under a new name.

    Both enclaves have the same permissions except for the subject. If a side has Zenoh rules, which
    are not compared, no enclave counts as renamed.
    """
    if base.zenoh is not None or head.zenoh is not None:
        return {}

    def rules(side: AccessSource, enclave: str) -> list[tuple[Rule, ...]]:
        known = side.permissions.get(enclave)
        return [grant.rules for grant in known.grants] if known else []

    return {
        old: new
        for old, new in renamed_enclaves(base.rights, head.rights).items()
        if rules(base, old) and rules(base, old) == rules(head, new)
    }


class ComparedSide(NamedTuple):
    """A side of the comparison."""

    path: str
    """Path or revision of the side, as named on the command line."""
    kind: SourceKind
    """Kind of the side, such as policy or keystore."""
    enclaves: Sequence[str] | None
    """The enclaves of the side, if only some enclaves are compared; null for all."""
    notes: Sequence[Note]
    """Notes on the side."""

    @staticmethod
    def of(source: AccessSource) -> ComparedSide:
        """Return a source in the form that ``--json`` prints."""
        enclaves = None if source.scope is None else sorted(source.scope)
        return ComparedSide(source.shown, source.kind, enclaves, source.notes)


@shows(spread=("growth",))
class NewAccess(NamedTuple):
    """The access that B (HEAD) adds to A (BASE)."""

    base: ComparedSide
    """The side BASE."""
    head: ComparedSide
    """The side HEAD."""
    growth: Growth


def compare_access(base: AccessSource, head: AccessSource) -> Growth:
    """Return the access that ``head`` adds to ``base``, and the access that ``head`` removes.

    A policy counts as signed, with a governance that controls all access.  If BASE is a policy,
    each name for which it demands no protection counts as encrypted: a keystore HEAD that does not
    encrypt the name has lost protection. If HEAD is a policy, no protection of a keystore BASE
    counts as lost.  A policy is for the domains of the other side; enclaves of a fleet's robots are
    for the domain of their robot.

    Raises:
        DocumentError: the comparison cannot be decided, because there are too many wildcards or
            permissions that a vendor does not accept.  If nothing else is new, contradictory
            demands of protection and unknown Zenoh settings are errors, too.
    """
    limit = SearchLimit()
    scope = compared_enclaves((base.kind, base.scope), (head.kind, head.scope))
    partial = base.scope is not None or head.scope is not None
    before, after = (
        _with_default_domains_and_governance(base, head),
        _with_default_domains_and_governance(head, base),
    )
    worlds = _compared_worlds(before, after)
    added = tuple(_gains(before, after, worlds, scope, limit))
    lost = tuple(dict.fromkeys(_lost_protection(base, head, limit, rules=not added)))
    new_nodes = tuple(_new_nodes(base, head, limit))
    changed = () if head.fleet else changed_forms(base.enclaves.values(), head.enclaves.values())
    elsewhere, dropped_elsewhere = [], []
    for form in changed:
        if form.right.qualifier is ALLOW:
            elsewhere.append(form._replace(place=head.shown_source(form.place)))
        else:
            dropped_elsewhere.append(DroppedDenial(form.right, form.example_elsewhere(), ""))
    unclear = tuple(_not_compared_clauses(base, head))
    if unclear and not (added or lost or new_nodes or elsewhere):
        raise DocumentError(
            f"'{head.shown}' cannot be compared: {unclear[0]}",
            "In all other parts, no access is new, and no protection is lost.",
        )
    sides: tuple[_Edges | None, ...] = ({}, {})
    if added and not partial:
        sides = tuple(
            _hops_between_enclaves(source, _fitting_pairs(source, worlds))
            for source in (before, after)
        )
    unknown = "only some enclaves are compared" if partial else ""
    if None in sides:
        unknown = f"there are more than {_MOST_HOPS:,} hops between enclaves"
    gained = dict.fromkeys(_lost_protection(head, base, limit, rules=False))
    domains = sorted({domain for world in worlds for domain in world.domains})
    other_domain = None
    if {base.kind, head.kind} == {"policy"}:
        own = {*_domains_of_robots(base, head).values(), *_domains_of_robots(head, base).values()}
        other_domain = next((domain for domain in domains if domain not in own), None)
    return Growth(
        added,
        tuple(_gains(after, before, worlds, scope, limit)),
        tuple(islice(_new_reach(*sides), _MOST_REACH)),
        unknown,
        lost,
        tuple(replace(change, effect=Effect.TIGHTER) for change in gained),
        tuple(world.title for world in worlds),
        tuple(domains),
        tuple(_assumptions(base, head)),
        tuple(_left_out_texts(base, head)),
        unclear,
        new_nodes,
        (*_dropped_denials(base, head), *dropped_elsewhere),
        tuple(elsewhere),
        other_domain,
    )


def _lost_protection(
    old: AccessSource, new: AccessSource, limit: SearchLimit, *, rules: bool
) -> Iterator[SettingChange]:
    """Yield changes that make ``new`` protect less than ``old``, or let more names pass.

    With ``rules``, rules between Zenoh routers are also compared, except where new rights caused
    the change.
    """
    yield from less_protection(old, new, limit)
    crossing = tuple(added_crossing(old, new, limit))
    yield from crossing or (looser_router_rules(old, new, limit) if rules else ())


def _not_compared_clauses(base: AccessSource, head: AccessSource) -> Iterator[str]:
    """Yield clauses on parts of HEAD that could not be compared."""
    if fault := contradiction(head):
        yield f"HEAD contradicts itself: {fault}"
    yield from unknown_settings(base.zenoh_files, head.zenoh_files)
    if "zenoh" in (base.kind, head.kind):
        return
    for side, vendor in product((base, head), TESTED):
        for name, certified in side.certified.items():
            if name in side.permissions and not _permissions_fit(
                vendor, side, name, certified.subject
            ):
                yield (
                    f"on {vendor.title} the permissions of {name} in '{side.shown}' do not fit its "
                    "certificate, so it is not certain what this enclave can do"
                )


def _permissions_fit(vendor: Vendor, side: AccessSource, enclave: str, subject: str) -> bool:
    """Return whether a vendor accepts the permissions of an enclave for a certificate's subject."""
    text = certified_text(vendor.traits, subject)
    with suppress(ComparisonCrash):
        return any(
            same_subject(vendor.traits.subjects, grant.subject.strip(), text)
            for grant in side.permissions[enclave].grants
        )
    return False


# ── worlds ─────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Access:
    """The access of an enclave in one world and domain.

    ``topics`` are the allowed topics; ``decide`` decides on a single topic. ``joins`` says whether
    a process of the enclave may join the domain.
    """

    topics: Mapping[AccessVerb, NameSet]
    decide: Callable[[AccessVerb, str], bool]
    joins: bool


_NO_ACCESS = _Access(dict.fromkeys(_VERBS, NameSet()), lambda verb, topic: False, joins=False)


_AccessOf = Callable[[AccessSource, str, int], _Access]
"""Function that returns the access of an enclave: from the side, the enclave and the domain."""
_FittingOthers = Callable[[AccessSource, str], tuple[str, ...]]
"""Function that returns the enclaves whose permissions also fit an enclave's certificate."""


@dataclass(frozen=True, slots=True)
class _World:
    """A DDS vendor, or Zenoh, with the domains in which access is compared.

    ``style`` is the way in which the vendor matches wildcards. ``longest`` is the length in bytes
    of the longest topic name (None: no limit).
    """

    title: str
    style: Style
    domains: tuple[int, ...]
    access: _AccessOf
    fitting_others: _FittingOthers = lambda side, enclave: ()
    longest: int | None = None


def _compared_worlds(base: AccessSource, head: AccessSource) -> list[_World]:
    worlds = []
    if "zenoh" not in (base.kind, head.kind):
        domains = _domains(base, head)
        for vendor in TESTED:
            fitting_others = _fitting_others(vendor, base, head)
            access = _access_on_vendor(vendor, fitting_others)
            traits = vendor.traits
            worlds.append(
                _World(
                    vendor.title,
                    traits.style,
                    domains,
                    access,
                    fitting_others,
                    traits.longest_topic_name,
                )
            )
    if base.zenoh is not None or head.zenoh is not None:
        worlds.append(
            _World(_ZENOH, Style.FNMATCH, _zenoh_domains(base, head), _access_on_zenoh(base, head))
        )
    return worlds


def _zenoh_domains(base: AccessSource, head: AccessSource) -> tuple[int, ...]:
    """Return one domain for each group of domains with the same Zenoh rules.

    Domains of sides without Zenoh rules are included.
    """
    domains: set[DomainSet] = set()
    for side, other in ((base, head), (head, base)):
        domains.update(DomainSet.of((e, e)) for e in _domains_of_robots(side, other).values())
        if side.zenoh is None and side.kind != "policy":
            domains.update(domain_set.closed() for domain_set in _domains_of_grants(side))
    return domains_of((*base.enforcers, *head.enforcers), domains) or (0,)


def _domains(base: AccessSource, head: AccessSource) -> tuple[int, ...]:
    """Return one domain for each group of domains with the same rules."""
    governances = (source.governance for source in (base, head) if source.governance)
    listed = {rule.domains for governance in governances for rule in governance.domain_access_rules}
    return DomainSet.one_of_each_kind(listed, _domains_of_grants(base) | _domains_of_grants(head))


def _domains_of_grants(side: AccessSource) -> set[DomainSet]:
    """Return the sets of domains for which permissions have rules."""
    return {
        rule.domains
        for permissions in side.permissions.values()
        for grant in permissions.grants
        for rule in grant.rules
    }


def _fitting_others(vendor: Vendor, *sides: AccessSource) -> _FittingOthers:
    by_side = {}
    for side in sides:
        granted = {
            name: [grant.subject for grant in permissions.grants]
            for name, permissions in side.permissions.items()
        }
        subjects = {name: side.subject_of(name) for name in granted}
        certified = {name: subject for name, subject in subjects.items() if subject}
        by_side[id(side)] = other_fitting_enclaves(vendor.traits, certified, granted)
    return lambda side, enclave: by_side[id(side)].get(enclave, ())


def _access_on_vendor(vendor: Vendor, fitting_others: _FittingOthers) -> _AccessOf:
    def access_by(
        side: AccessSource, governance: Governance, enclave: str, subject: str, at: int
    ) -> Access:
        """Return the access that an enclave's permissions give to a certificate with a subject.

        Permissions that do not fit the certificate count as if they did; `_not_compared_clauses`
        reports them.
        """
        granted = (grant.subject for grant in side.permissions[enclave].grants[:1])
        subject = subject if _permissions_fit(vendor, side, enclave, subject) else next(granted, "")
        governed = GovernedDomain(vendor, governance, at)
        access = Access(governed, side.permissions[enclave], subject, moment=AT)
        if access.join().reason in ("no-grant", "malformed") or access.join().outcome == "crashes":
            raise DocumentError(
                f"the permissions of {enclave} in '{side.shown}' cannot be compared",
                access.join().text,
                "Sign them again.",
            )
        return access

    def access(side: AccessSource, enclave: str, domain: int) -> _Access:
        governance = side.governance
        if enclave not in side.permissions or governance is None:
            return _NO_ACCESS
        subject = side.subject_of(enclave)
        usable = [
            access_by(side, governance, name, subject, domain)
            for name in (enclave, *fitting_others(side, enclave))
        ]
        return _joined_access(usable)

    return access


def _access_on_zenoh(base: AccessSource, head: AccessSource) -> _AccessOf:
    """Return a function that returns the access of an enclave on Zenoh.

    The rules in the Zenoh files of a side decide; for a side without such files, its rights.
    """
    stated = {
        id(side): _access_by_rights(side, _domains_of_robots(side, other))
        for side, other in ((base, head), (head, base))
        if side.zenoh is None
    }

    def access(side: AccessSource, enclave: str, domain: int) -> _Access:
        if side.zenoh is None:
            return stated[id(side)](enclave, domain)
        if enclave in side.routers:
            return _NO_ACCESS
        enforced = enforced_access(side.enforcers, enclave, domain)

        def decide(verb: AccessVerb, topic: str) -> bool:
            writes = verb is AccessVerb.PUBLISH
            return any_allows(side.enforcers, enclave, domain, topic, writes=writes)

        writes, reads = (names & ROS_TOPICS for names in (enforced.writes, enforced.reads))
        topics = {AccessVerb.PUBLISH: writes, AccessVerb.SUBSCRIBE: reads}
        joins = any(enclave in enforcer.names() for enforcer in side.enforcers)
        return _Access(topics, decide, joins=joins)

    return access


def _access_by_rights(
    side: AccessSource, robots: Mapping[str, int]
) -> Callable[[str, int], _Access]:
    """Return a function that maps an enclave and a domain to the access by ROS rights.

    ``robots`` maps enclaves of a policy to the domain of their robot, if the fleet states one.
    """
    by_enclave = _rights_by_enclave(side.rights)

    def rights_in(enclave: str, domain: int) -> Collection[Right]:
        if side.kind == "policy":
            elsewhere = robots.get(enclave, domain) != domain
            return () if elsewhere else by_enclave.get(enclave, ())
        grants = side.permissions[enclave].grants if enclave in side.permissions else ()
        return [
            right
            for grant in grants
            for right in grant_rights(enclave, _grant_in_domain(grant, domain))
        ]

    def access(enclave: str, domain: int) -> _Access:
        own_rights = rights_in(enclave, domain)
        allowed, denied = (
            {
                verb: [
                    topic
                    for right in own_rights
                    if (right.qualifier is ALLOW) is allows
                    for topic in getattr(right.topics, verb)
                ]
                for verb in _VERBS
            }
            for allows in (True, False)
        )

        def decide(verb: AccessVerb, topic: str) -> bool:
            def matches_any(patterns: Iterable[str]) -> bool:
                return any(matches(Style.FNMATCH, pattern, topic) for pattern in patterns)

            return matches_any(allowed[verb]) and not matches_any(denied[verb])

        def topics(verb: AccessVerb) -> NameSet:
            granted = names_of(Style.FNMATCH, allowed[verb]) - names_of(Style.FNMATCH, denied[verb])
            return granted & ROS_TOPICS

        return _Access({verb: topics(verb) for verb in _VERBS}, decide, joins=bool(own_rights))

    return access


def _grant_in_domain(grant: Grant, domain: int) -> Grant:
    rules = (rule for rule in grant.rules if domain in rule.domains.closed())
    return grant._replace(rules=tuple(rules))


def _rights_by_enclave(rights: Iterable[Right]) -> dict[str, list[Right]]:
    by_enclave: dict[str, list[Right]] = defaultdict(list)
    for right in sorted(rights):
        by_enclave[right.enclave].append(right)
    return by_enclave


# ── rights ─────────────────────────────────────────────────────────────────────────────────


def _gains(
    old: AccessSource,
    new: AccessSource,
    worlds: Sequence[_World],
    scope: Collection[str] | None,
    limit: SearchLimit,
) -> Iterator[Gain]:
    """Yield the access that only ``new`` gives; equal access in several worlds is merged."""
    gains: dict[tuple[object, ...], tuple[Gain, set[str], set[int]]] = {}
    for gain in _each_gain(old, new, worlds, scope, limit):
        key = gain.enclaves[0], gain.action, gain.right, gain.name or gain.topic
        _, worlds_of_gain, domains = gains.setdefault(key, (gain, set(), set()))
        worlds_of_gain.update(gain.worlds)
        domains.update(gain.domains)
    order = [world.title for world in worlds]
    together: dict[Gain, list[str]] = {}
    for gain, worlds_of_gain, domains in gains.values():
        joined_gain = replace(
            gain,
            worlds=tuple(world for world in order if world in worlds_of_gain),
            domains=tuple(sorted(domains)),
        )
        # Access that the governance gives is joined for all enclaves.
        same = joined_gain if joined_gain.right else replace(joined_gain, enclaves=())
        together.setdefault(same, []).extend(gain.enclaves)
    for gain, enclaves in together.items():
        yield replace(gain, enclaves=tuple(dict.fromkeys(enclaves)))


def _each_gain(
    old: AccessSource,
    new: AccessSource,
    worlds: Sequence[_World],
    scope: Collection[str] | None,
    limit: SearchLimit,
) -> Iterator[Gain]:
    stated = _StatedRights(old, new)
    names = set(new.permissions) | {right.enclave for right in new.rights}
    names.update(*(enforcer.names() for enforcer in new.enforcers))
    for enclave in sorted(names if scope is None else names.intersection(scope)):
        for world in worlds:
            if _has_same_access(old, new, enclave, world):
                continue
            for domain in world.domains:
                before, after = (world.access(side, enclave, domain) for side in (old, new))
                gained_topics = {verb: after.topics[verb] - before.topics[verb] for verb in _VERBS}
                gained = False
                place = _PlaceOfEnclave(enclave, world, domain, limit)
                for gain in _added_gains(stated, place, gained_topics, (before, after)):
                    gained = True
                    yield gain
                if not gained and after.joins and not before.joins:
                    yield Gain(
                        (enclave,), _JOIN, None, "", "", None, None, None, (world.title,), (domain,)
                    )


@dataclass(frozen=True, slots=True)
class _PlaceOfEnclave:
    """An enclave in a domain of a world, and the limit on the search for its added access."""

    enclave: str
    world: _World
    domain: int
    limit: SearchLimit


def _added_gains(
    stated_rights: _StatedRights,
    place: _PlaceOfEnclave,
    topics: Mapping[AccessVerb, NameSet],
    sides: tuple[_Access, _Access],
) -> Iterator[Gain]:
    """Yield `Gain` values for ``topics``, which an enclave may use only after a change."""
    before, after = sides
    for verb in _VERBS:
        gained_topics = topics[verb]
        if not before.joins:
            gained_topics -= NameSet((ROS_DISCOVERY_TOPIC,))  # every participant has this topic
        for gain in stated_rights.gains(place, verb, gained_topics):
            if not after.decide(verb, gain.topic) or before.decide(verb, gain.topic):
                raise AssertionError(f"{gain} is not what {place.world.title} decides")
            yield gain


class AccessByVendors:
    """A comparison of the access that DDS vendors derive from the same documents.

    Only names that ROS 2 can have, or that documents state without wildcards, are compared.
    """

    def __init__(self, source: AccessSource) -> None:
        self._stated = _StatedRights(source, source)

    def gained_topics(
        self,
        enclave: str,
        before: Sequence[Access],
        after: Sequence[Access],
        vendor: Vendor,
        domain: int,
        names: Collection[str],
    ) -> Iterator[Gain]:
        """Yield the topics that an enclave may use by ``after``, but not by ``before``.

        ``after`` has the permissions that fit the enclave's certificate by the rules of ``vendor``,
        ``before`` the permissions that fit the certificate by the rules of another vendor.
        ``names`` are the names that the permissions state without wildcards.

        Raises:
            DocumentError: there are too many wildcards to decide the access.
        """
        world = _World(
            vendor.title,
            vendor.traits.style,
            (domain,),
            lambda side, enclave, domain: _NO_ACCESS,
            longest=vendor.traits.longest_topic_name,
        )
        sides = _joined_access(before), _joined_access(after)
        topics = {}
        for verb in _VERBS:
            old, new = (
                NameSet.union([access.ruled_topics(verb) for access in usable])
                for usable in (before, after)
            )
            exact = (
                name
                for name in (*names, ROS_DISCOVERY_TOPIC)
                if sides[1].decide(verb, name) and not sides[0].decide(verb, name)
            )
            gained = NameSet() if old == new else (new - old) & ROS_TOPICS
            topics[verb] = gained | NameSet(exact)
        place = _PlaceOfEnclave(enclave, world, domain, SearchLimit())
        yield from _added_gains(self._stated, place, topics, sides)


def _joined_access(accesses: Sequence[Access]) -> _Access:
    """Return the joint access by several permissions that an enclave can use."""
    return _Access(
        {verb: NameSet.union([access.topics(verb) for access in accesses]) for verb in _VERBS},
        lambda verb, topic: any(access.decide(verb, topic).outcome.ok for access in accesses),
        any(access.join().outcome.ok for access in accesses),
    )


def _has_same_access(old: AccessSource, new: AccessSource, enclave: str, world: _World) -> bool:
    """Return whether an enclave has the same access on both sides; False may be wrong."""
    if world.title == _ZENOH:
        return None not in (old.zenoh, new.zenoh) and old.enforcers == new.enforcers
    if old.governance != new.governance:
        return False
    names = (enclave, *world.fitting_others(old, enclave))
    return (
        names == (enclave, *world.fitting_others(new, enclave))
        and old.subject_of(enclave) == new.subject_of(enclave)
        and all(
            _same_grants(old.permissions.get(name), new.permissions.get(name)) for name in names
        )
    )


def _same_grants(permissions: Permissions | None, other: Permissions | None) -> bool:
    if permissions is None or other is None:
        return permissions is other
    unnamed, other_unnamed = (
        [grant._replace(name="") for grant in side.grants] for side in (permissions, other)
    )
    return unnamed == other_unnamed


class _Denials:
    """The rights that deny an enclave to write, or to read; ``names`` are all denied names."""

    def __init__(self, rights: Sequence[Right], verb: AccessVerb, style: Style) -> None:
        pairs = [(right, text) for right in rights for text in getattr(right.topics, verb)]
        self._rights = [right for right, _ in pairs]
        self._index = ExpressionIndex(style, (text for _, text in pairs))
        self.names = names_of(style, (text for _, text in pairs))

    def first_denial(self, topic: str) -> Right | None:
        """Return the first right that denies a topic, or None."""
        at = self._index.first(topic)
        return None if at is None else self._rights[at]


class _StatedRights:
    """An index of both sides' stated rights: it finds the right that gives an added access."""

    def __init__(self, old: AccessSource, new: AccessSource) -> None:
        self._old, self._new = old, new
        self._old_sources: _Sources = {}
        self._new_sources: _Sources = {}
        self._examples: dict[tuple[str, AccessVerb, str], list[str]] = defaultdict(list)
        self._found: dict[tuple[object, ...], list[Gain]] = {}
        self._denials_of: dict[tuple[str, AccessVerb, Style], _Denials] = {}
        rights = new.rights if new.zenoh is None else new.rights | new.zenoh
        earlier = old.rights if old.zenoh is None else old.rights | old.zenoh
        self._allowed = _rights_by_enclave(right for right in rights if right.qualifier is ALLOW)
        self._denied = _rights_by_enclave(
            right for right in earlier if right.qualifier is not ALLOW
        )
        topics = {topic for right in rights for side in right.topics for topic in side}
        self._exact = sorted(topic for topic in topics if not is_expression(topic))

    def gains(
        self, place: _PlaceOfEnclave, verb: AccessVerb, added_names: NameSet
    ) -> Iterator[Gain]:
        """Yield the access that an enclave gains to the topics ``added_names``.

        Yields a `Gain` for each right of the policy that covers some of these topics, and a `Gain`
        for the topics that no right covers.
        """
        enclave, world = place.enclave, place.world
        fitting_others = world.fitting_others(self._new, enclave)
        # Cached, because several domains often add the same access.
        key = enclave, fitting_others, verb, added_names, world.style, world.longest
        if key not in self._found:
            self._found[key] = list(self._searched_gains(place, verb, added_names))
        for gain in self._found[key]:
            yield replace(gain, worlds=(world.title,), domains=(place.domain,))

    def _searched_gains(
        self, place: _PlaceOfEnclave, verb: AccessVerb, added_names: NameSet
    ) -> Iterator[Gain]:
        enclave, world = place.enclave, place.world
        allowed = [
            (right, getattr(right.topics, verb))
            for name in (enclave, *world.fitting_others(self._new, enclave))
            for right in self._allowed.get(name, ())
        ]
        denied = self._denials(enclave, verb, world.style)
        for right, topics in allowed:
            for expression in topics:
                own_names = added_names & names_of(world.style, (expression,))
                topic = self._example(own_names, verb, expression, place)
                if topic is None:
                    continue
                gain = self._gain(place, verb, right, expression, topic)
                yield gain
                if gain.denied and is_expression(expression):
                    # Besides names whose denial is gone, the right may add others.
                    topic = self._example(own_names - denied.names, verb, expression, place)
                    if topic is not None:
                        yield self._gain(place, verb, right, expression, topic)
                break
        stated = names_of(world.style, (topic for _, topics in allowed for topic in topics))
        topic = self._example(added_names - stated, verb, "*", place)
        if topic is not None:
            yield self._gain(place, verb, None, topic, topic)

    def _denials(self, enclave: str, verb: AccessVerb, style: Style) -> _Denials:
        key = enclave, verb, style
        if key not in self._denials_of:
            self._denials_of[key] = _Denials(self._denied.get(enclave, ()), verb, style)
        return self._denials_of[key]

    def _example(
        self, names: NameSet, verb: AccessVerb, expression: str, place: _PlaceOfEnclave
    ) -> str | None:
        """Return an example topic in ``names``, or None.

        The example of another world comes first, then a topic that a rule states, then any topic.
        """
        longest, known = place.world.longest, self._examples[place.enclave, verb, expression]
        example = _example(names, expression, place.world, place.limit)
        if example is None:
            return None
        for topic in chain(known, self._likely_topics(expression)):
            if topic in names and (longest is None or len(topic.encode()) <= longest):
                known += [topic] if topic not in known else []
                return topic
        known.append(example)
        return example

    def _likely_topics(self, expression: str) -> Iterator[str]:
        """Yield some exact topics of the new rights that begin with the fixed part of an
        expression.

        Topics of services that belong to every node come last.
        """
        prefix = literal_prefix(expression)
        if prefix != expression:
            first = bisect_left(self._exact, prefix)
            near = islice(self._exact, first, first + _MAX_LIKELY_TOPICS)
            fitting = takewhile(lambda topic: topic.startswith(prefix), near)
            yield from sorted(
                fitting, key=lambda topic: bool(node_of_service(service_of(topic)[0]))
            )

    def _gain(
        self,
        place: _PlaceOfEnclave,
        verb: AccessVerb,
        right: Right | None,
        expression: str,
        topic: str,
    ) -> Gain:
        denied = self._denials(place.enclave, verb, place.world.style).first_denial(topic)
        name, action = topic, "write" if verb is AccessVerb.PUBLISH else "read"
        if right:
            at = expression.find(right.name)  # a name in permissions may be empty
            end = len(expression) - at - len(right.name)
            name, action = topic[at : len(topic) - end], right.right
        return Gain(
            (place.enclave,),
            action,
            right,
            name,
            topic,
            _source_of_right(self._new_sources, self._new, right),
            denied,
            _source_of_right(self._old_sources, self._old, denied),
            (place.world.title,),
            (place.domain,),
        )


_MAX_LIKELY_TOPICS = 100
"""Maximum number of stated topics that are tried as an example."""

_Sources = dict[str, dict[Right, Source]]
"""Cache that maps enclaves and rights to the file and line that states the right."""


def _source_of_right(known: _Sources, side: AccessSource, right: Right | None) -> Source | None:
    if right is None:
        return None
    if right.enclave not in known:
        known[right.enclave] = side.sources_of(right.enclave)
    return known[right.enclave].get(right)


def _example(names: NameSet, expression: str, world: _World, limit: SearchLimit) -> str | None:
    """Return a topic in ``names``, preferably with a ROS name; None if ``names`` is empty.

    ``expression`` covers all of ``names``. Without wildcards, it is the only possible topic.
    """
    if not is_expression(expression):
        return expression if expression in names else None
    example = names.example(limit, longest=world.longest)
    if example is None or example in ROS_TOPICS:
        return example
    return (names & ROS_TOPICS).example(limit, longest=world.longest) or example


# ── reach ──────────────────────────────────────────────────────────────────────────────────


_Edges = Mapping[str, Mapping[str, Callable[[], Hop]]]
"""Source enclave → target enclave → function that returns a hop between both."""
_MOST_REACH = 10_000
_MOST_HOPS = 200_000


def _new_reach(before: _Edges | None, after: _Edges | None) -> Iterator[NewReach]:
    """Yield pairs of enclaves of which the first influences the second only in ``after``.

    Yields nothing if ``before`` or ``after`` is not known (None).
    """
    if before is None or after is None:
        return
    changed = {
        source for source, of in after.items() if not of.keys() <= before.get(source, {}).keys()
    }
    backwards: dict[str, list[str]] = defaultdict(list)
    for source, of in after.items():
        for target in of:
            backwards[target].append(source)
    sources = changed.union(*(_predecessors(backwards, name) for name in sorted(changed)))
    for source in sorted(sources):
        known = _predecessors(before, source).keys()
        reached = _predecessors(after, source)
        for target in sorted(reached.keys() - known - {source}):
            path: list[Hop] = []
            at = target
            while at != source:
                path.insert(0, after[reached[at]][at]())
                at = reached[at]
            yield NewReach(source, target, tuple(path))


def _fitting_pairs(side: AccessSource, worlds: Iterable[_World]) -> Iterator[tuple[str, str]]:
    """Yield pairs of enclaves; the first can use the permissions of the second in a world."""
    worlds = tuple(worlds)
    for enclave in side.permissions:
        fitting_others = (
            holder for world in worlds for holder in world.fitting_others(side, enclave)
        )
        yield from ((enclave, holder) for holder in dict.fromkeys(fitting_others))


def _hops_between_enclaves(
    side: AccessSource, fitting_pairs: Iterable[tuple[str, str]]
) -> _Edges | None:
    """Return all hops between enclaves, or None if there are too many to follow.

    An enclave with the permissions of another enclave counts as a further enclave, without the
    denials in its own permissions.
    """
    rights = side.zenoh if side.kind == "zenoh" and side.zenoh is not None else side.rights
    names_by_holder: dict[str, list[str]] = defaultdict(list)
    real: dict[str, str] = {}
    for enclave, holder in fitting_pairs:
        name = f"{enclave} by {holder}"
        real[name] = enclave
        names_by_holder[holder].append(name)
    usable = {}
    left = _MOST_HOPS
    for domains, group in rights_grouped_by_domains(
        rights, side.permissions, side.key_domains
    ).items():
        left -= sum(
            len(names_by_holder[right.enclave])
            for right in group
            if right.enclave in names_by_holder
        )
        if left < 0:
            return None
        more_rights = (
            right._replace(enclave=name)
            for right in group
            for name in names_by_holder.get(right.enclave, ())
        )
        usable[domains] = group.union(more_rights)
    network = Network(
        usable,
        excluded=OF_EVERY_NODE,
        questions=QUESTIONS,
        unguarded=unguarded_topics(side.governance) if side.governance else (),
        everybody=sorted(side.permissions),
    )
    edges: dict[str, dict[str, Callable[[], Hop]]] = defaultdict(dict)
    left = _MOST_HOPS
    for enclave in network.enclaves:
        source = real.get(enclave, enclave)
        known = {enclave}
        for reached, hop in network.links(enclave, known):
            known.add(reached)
            target = real.get(reached, reached)
            if target != source and target not in edges[source]:
                edges[source][target] = partial(_hop_between, hop, source, target)
                left -= 1
        if left < 0:
            return None
    return edges


def _hop_between(hop: Callable[[], Hop], source: str, target: str) -> Hop:
    """Return the result of ``hop``, with ``source`` and ``target`` as the enclaves of the hop."""
    return hop()._replace(source=source, target=target)


def _predecessors(neighbors: Mapping[str, Iterable[str]], start: str) -> dict[str, str]:
    """Map the enclaves that can be reached from ``start`` to their predecessors on the way."""
    reached: dict[str, str] = {}
    row = [start]
    for enclave_here in row:
        for neighbor in neighbors.get(enclave_here, ()):
            if neighbor not in reached and neighbor != start:
                reached[neighbor] = enclave_here
                row.append(neighbor)
    return reached


# ── nodes ──────────────────────────────────────────────────────────────────────────────────


def _new_nodes(before: AccessSource, after: AccessSource, limit: SearchLimit) -> Iterator[NewNode]:
    """Yield the nodes that policies assign to another enclave, which has more rights.

    Two kinds of nodes are left out: the only node of an enclave, which may be renamed, and a node
    whose name a wildcard of the enclave already matched.
    """
    old_nodes, new_nodes = _enclaves_of_nodes(before, after), _enclaves_of_nodes(after, before)
    assigned = []
    for node, robots in sorted(new_nodes.items()):
        for robot, profiles in sorted(robots.items()):
            earlier = _enclaves_near(old_nodes.get(node, {}), robot).keys()
            left = earlier - _enclaves_near(robots, robot).keys()
            assigned += [
                (node, path, profiles[path], earlier, left)
                for path in sorted((profiles.keys() & before.enclaves.keys()) - earlier)
                if not any(map(node_of(profiles[path]).is_within, nodes_of(before.enclaves[path])))
            ]
    if not assigned:  # a large fleet has many rights, so they are not read in vain
        return
    old_rights, new_rights = map(_rights_by_enclave, (before.rights, after.rights))
    for node, path, profile, earlier, left in assigned:
        had = [old_rights.get(enclave, ()) for enclave in earlier]
        own_rights = [*profile_rights(path, profile)]
        if gained := _gained_rights(had or [own_rights], new_rights.get(path, ()), limit):
            full = f"/{'/'.join(node)}".replace("//", "/")
            place = after.shown_source(profile.source)
            yield NewNode(full, path, min(left, default=""), gained, place)


def _gained_rights(
    had: Sequence[Collection[Right]], rights: Collection[Right], limit: SearchLimit
) -> tuple[Right, ...]:
    """Return the ``rights`` of an enclave that ``had`` does not include; see `NewNode.rights`.

    ``had`` has the rights of several enclaves. Rights that every node needs, such as to its own
    services, come last.
    """
    known, now = [_allowed_names(enclave) for enclave in had], _allowed_names(rights)
    stated = Rules(right for enclave in had for right in enclave)
    enclaves = {right.enclave for enclave in had for right in enclave}
    gained: dict[Right, None] = {}
    for right in rights:
        for part in parts(right) if right.qualifier is ALLOW else ():
            if any(stated.allow(enclave, part.right, part.name) for enclave in enclaves):
                continue  # this test is faster than automata
            had_names = NameSet.union(names.get(part.right, NameSet()) for names in known)
            new_names = now[part.right] & names_of(Style.FNMATCH, (part.name,)) & _ROS_NAMES
            example = (new_names - had_names).example(limit)
            if example is None:
                continue
            covered = any(stated.cover(part._replace(enclave=enclave)) for enclave in enclaves)
            only_denied = is_expression(part.name) and covered
            gained[part._replace(name=example) if only_denied else right] = None
            break

    def importance(right: Right) -> tuple[object, ...]:
        of_every_node = right.name in OF_EVERY_NODE or node_of_service(right.name) != ""
        return of_every_node, *order(right)

    return tuple(sorted(gained, key=importance))


_ROS_NAMES = valid_topics("", "")


def _allowed_names(rights: Iterable[Right]) -> dict[str, NameSet]:
    """Map each kind of right, such as publish, to the names that ``rights`` allow in the end."""
    names: dict[tuple[str, Qualifier], list[str]] = defaultdict(list)
    for _, qualifier, right, name in split_actions(rights):
        names[right, qualifier].append(name)
    allowed, denied = (
        {
            right: names_of(Style.FNMATCH, texts)
            for (right, of), texts in names.items()
            if of is each
        }
        for each in (ALLOW, DENY)
    )
    return {right: known - denied.get(right, NameSet()) for right, known in allowed.items()}


# ── denials ────────────────────────────────────────────────────────────────────────────────


def _dropped_denials(before: AccessSource, after: AccessSource) -> Iterator[DroppedDenial]:
    """Yield denials that ``after`` drops or narrows, and denials that a moved node left behind."""
    denials = {right for right in split_actions(before.rights) if right.qualifier is DENY}
    if not denials:
        return
    stated = Rules(after.rights)
    left = {right.enclave for right in after.rights} | after.permissions.keys()
    owed = defaultdict(set, {"": {denial for denial in denials if denial.enclave in left}})
    old_nodes, new_nodes = _enclaves_of_nodes(before, after), _enclaves_of_nodes(after, before)
    for node, robots in old_nodes.items():
        for robot, profiles in robots.items():
            now = _enclaves_near(new_nodes.get(node, {}), robot).keys()
            new = now - _enclaves_near(robots, robot).keys()
            for path, old_path in product(new, profiles.keys() - now):
                rights = split_actions(profile_rights(path, profiles[old_path]))
                owed[old_path].update(right for right in rights if right.qualifier is DENY)
    for old_path, denied in owed.items():
        names = {part: undenied_name(part, stated) for part in denied}
        for right in sorted(join_actions(part for part, name in names.items() if name)):
            part = parts(right)[0]
            name = (names[part] or "").removesuffix(part.name.removeprefix(right.name))
            yield DroppedDenial(right, name if stated.overlaps(right) else "", old_path)


_Node = tuple[str, str]
_EnclavesByRobot = dict[str, dict[str, Profile]]


def _enclaves_of_nodes(side: AccessSource, other: AccessSource) -> dict[_Node, _EnclavesByRobot]:
    """Map namespace and name of each node in policies to its enclaves, with the node's profile.

    The enclaves are grouped by robot ("": no robot), because robots may have nodes of the same
    name.
    """
    fleet = side.fleet or other.fleet
    nodes: dict[_Node, _EnclavesByRobot] = {}
    for path, enclave in side.enclaves.items():
        robot = robot_of(fleet, path) if fleet else None
        for profile in enclave.all_profiles():
            robots = nodes.setdefault((profile.ns.strip("/"), profile.node), {})
            profiles = robots.setdefault(robot.name if robot else "", {})
            others = profiles[path].groups if path in profiles else ()
            profiles[path] = replace(profile, groups=(*others, *profile.groups))
    return nodes


def _enclaves_near(robots: _EnclavesByRobot, robot: str) -> dict[str, Profile]:
    """Return the enclaves of a node that belong to ``robot`` or to no robot; for "", return all."""
    near = (robots.get("", {}), robots.get(robot, {})) if robot else robots.values()
    return {path: profile for profiles in near for path, profile in profiles.items()}


# ── what a side does not state ─────────────────────────────────────────────────────────────


def _with_default_domains_and_governance(side: AccessSource, other: AccessSource) -> AccessSource:
    """Return a side, with default domains and a default governance if the side states none.

    Enclaves of robots are for the domain of their robot.  A side without a governance gets access
    control of everything, in the domains of both sides.
    """
    domains = _domains_of_robots(side, other)
    permissions = _permissions_with_subjects(side, other)
    if domains:
        permissions = {
            name: _permissions_for_domain(certified, domains[name])
            if name in domains
            else certified
            for name, certified in permissions.items()
        }
    if side.governance:
        return replace(side, permissions=permissions)
    own_domains = DomainSet.of(*((domain, domain) for domain in domains.values()))
    if side.kind != "policy":
        own_domains = _certified_domains(side)
    if other.governance:
        governance = _with_access_control(other.governance, own_domains)
    else:
        known = DomainSet((*own_domains.ranges, *_certified_domains(other).ranges)).closed()
        open_ended = {"policy"} >= {side.kind, other.kind}
        governance = governance_for(strict_protection(), ALL_DOMAINS if open_ended else known)
    return replace(side, permissions=permissions, governance=governance)


def _permissions_with_subjects(
    side: AccessSource, other: AccessSource
) -> Mapping[str, Permissions]:
    """Return the permissions of a side; a policy gets the certificate subjects of the other side.

    If the other side is a keystore with unique subjects, enclaves that are only in the policy also
    get a unique subject.
    """
    if side.kind != "policy" or other.kind == "policy":
        return side.permissions
    unique = other.later is not None and other.later.unique_subject
    certified = {}
    for name, permissions in side.permissions.items():
        subject = other.subject_of(name)
        if not subject and unique:
            subject = f"CN={name},OU={sha256(name.encode()).hexdigest()}"
        grants = permissions.grants
        if subject:
            grants = tuple(grant._replace(subject=subject) for grant in grants)
        certified[name] = Permissions(grants)
    return certified


def _domains_of_robots(side: AccessSource, other: AccessSource) -> dict[str, int]:
    """Map enclaves to the ROS domain of their robot, if the fleet states one."""
    robots = side.fleet or other.fleet
    if side.kind != "policy" or robots is None:
        return {}
    robots_of = ((name, robot_of(robots, name)) for name in side.permissions)
    return {
        name: robot.domain
        for name, robot in robots_of
        if robot is not None and robot.domain is not None
    }


def _permissions_for_domain(permissions: Permissions, domain: int) -> Permissions:
    only = DomainSet.of((domain, domain))
    return Permissions(
        tuple(
            grant._replace(rules=tuple(rule._replace(domains=only) for rule in grant.rules))
            for grant in permissions.grants
        )
    )


def _certified_domains(side: AccessSource) -> DomainSet:
    """Return the domains for which the permissions have rules; empty for a policy.

    A policy fits any domain.
    """
    if side.kind == "policy":
        return DomainSet(())
    return DomainSet(
        tuple(part for domains in _domains_of_grants(side) for part in domains.ranges)
    ).closed()


def _with_access_control(governance: Governance, more_domains: DomainSet) -> Governance:
    """Return ``governance`` with control of all access, also in ``more_domains``."""
    strict = governance_for(strict_protection(), more_domains).domain_access_rules[0]

    def rule_with_control(rule: DomainRule) -> DomainRule:
        topics = tuple(
            replace(topic_rule, enable_read_access_control=True, enable_write_access_control=True)
            for topic_rule in rule.topic_access_rules
        )
        if not any(topic.topic_expression == "*" for topic in topics):
            topics += strict.topic_access_rules
        return replace(
            rule,
            allow_unauthenticated_participants=False,
            enable_join_access_control=True,
            topic_access_rules=topics,
        )

    rules = tuple(map(rule_with_control, governance.domain_access_rules))
    missing = [domain for domain in more_domains if domain not in governance.domains().closed()]
    if missing:
        rules += (replace(strict, domains=DomainSet.of(*((domain, domain) for domain in missing))),)
    return Governance(rules)


def _assumptions(base: AccessSource, head: AccessSource) -> Iterator[str]:
    """Yield clauses on assumptions about a side that does not state everything."""
    if "zenoh" not in (base.kind, head.kind):
        if base.governance is None and head.governance is None:
            yield "both are signed with the same governance, which controls all access"
        elif base.governance is None:
            yield (
                "BASE is signed with a governance that controls all access, and encrypts all names "
                "for which BASE demands no other protection"
            )
        elif head.governance is None:
            yield (
                "HEAD is signed with a governance that controls all access, and protects no less "
                "than BASE"
            )
    for name, side, other in (("BASE", base, "HEAD"), ("HEAD", head, "BASE")):
        against = head if side is base else base
        if side.kind != "policy" or against.kind == "policy":
            continue
        if _domains_of_robots(side, against).keys() < side.permissions.keys():
            whose = f"the enclaves of {name} without a robot" if side.fleet else name
            yield f"{name} names no domains, so the domains of {other} count for {whose}"
        if against.zenoh is not None:
            yield f"{name} has the Zenoh settings that sros writes"


def _left_out_texts(base: AccessSource, head: AccessSource) -> Iterator[str]:
    """Yield clauses on the parts that are left out of the comparison on purpose."""
    yield "dates"
    sides = (("BASE", base), ("HEAD", head))
    if "zenoh" in (base.kind, head.kind):
        if {base.kind, head.kind} != {"zenoh"}:
            yield "what DDS permits"
    else:
        yield "partitions other than the default one"
    if {base.kind, head.kind} & {"keystore", "enclave"}:
        yield "who holds which key"
    if any(
        file.document.mode is Mode.CLIENT for _, side in sides for file in side.zenoh_files.values()
    ):
        yield "what Zenoh clients let their router do"
    for name, side in sides:
        other = head if side is base else base
        if side.trusts is not None and other.trusts is None:
            yield f"the CAs and revocation lists of {name}"
        if side.later is not None and other.later is None:
            yield f"what {name} gives to enclaves that are created later"
        if limits_crossing(side) and not states_routers(other):
            yield f"what {name} lets pass between Zenoh routers"
        if side.zenoh_files and not other.zenoh_files:
            yield f"where the Zenoh processes of {name} listen and connect"
        if side.scope is not None and other.scope is None:
            yield f"enclaves that {name} does not have"
    if base.protections is not None and head.governance is None and head.kind != "policy":
        yield "the protection of messages, which HEAD does not state"
