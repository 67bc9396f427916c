"""Find weaker protection on one side of a comparison: of messages, of trust, at routers.

A side without a governance, such as a policy, stands for a strict governance, so a keystore with a
looser governance protects less.  A policy never lowers the protection of a keystore.

Two enclaves at the same Zenoh router exchange all that their rights allow.  Enclaves at two routers
exchange only names that both routers let pass. So more names pass if ``crossing`` gets wider, if a
router is removed, or if an enclave moves to the router of another enclave.

This module reads no files.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

from sros_tool.automata import NameSet, SearchLimit
from sros_tool.dds.decision.expressions import names_of
from sros_tool.dds.decision.vendors import Style
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, ProtectionKind, TopicRule
from sros_tool.keystore.comparison import Effect, SettingChange, attribute_changes, compare_settings
from sros_tool.keystore.fleet import with_routers_of_robots
from sros_tool.keystore.template import load_template
from sros_tool.policy.model import ALLOW, DomainProtection, Level, StatedProtection
from sros_tool.policy.rights import KIND_OF, Right, parts
from sros_tool.proof.sources import AT, KEYSTORE_ITSELF, AccessSource, Trust
from sros_tool.proof.worlds import ROS_TOPICS, names_of_expression, valid_topics
from sros_tool.proof.zenoh_settings import looser_settings
from sros_tool.translate import contradictions, governance_for, protected_topics
from sros_tool.wording import counted, serial_text
from sros_tool.zenoh.configuration import ZenohNetwork


@lru_cache(maxsize=1)
def strict_protection() -> DomainProtection:
    """Return the protection of the template production, which replaces a missing governance.

    Whole RTPS messages only have to be signed, as in the template development, because their
    content is encrypted separately.
    """
    return replace(load_template("production").protection, rtps=Level.SIGN)


def _demanded_governance(
    stated_protections: Sequence[StatedProtection], domains: DomainSet
) -> Governance:
    """Return the weakest governance that a policy allows: strict, except for stated levels.

    If a policy states both levels for a name, the stronger level counts.
    """
    (rule,) = governance_for(strict_protection(), domains).domain_access_rules
    (rule_for_all,) = rule.topic_access_rules
    kinds = {Level.SIGN: ProtectionKind.NONE, Level.ENCRYPT: ProtectionKind.ENCRYPT}
    topics = {
        (right.level, topic): replace(
            rule_for_all,
            topic_expression=topic,
            metadata_protection_kind=ProtectionKind.NONE,
            data_protection_kind=kinds[right.level],
        )
        for level in (Level.ENCRYPT, Level.SIGN)
        for right in stated_protections
        if right.level is level
        for topic in protected_topics(right.kind, right.name)
    }
    return Governance((replace(rule, topic_access_rules=(*topics.values(), rule_for_all)),))


def _payload_governance(governance: Governance) -> Governance:
    """Return a governance in which the protection of data is the strongest of all layers."""

    def strongest_kind(domain: DomainRule, topic: TopicRule) -> TopicRule:
        kinds = (
            topic.data_protection_kind,
            topic.metadata_protection_kind,
            domain.rtps_protection_kind,
        )
        names = [kind.value.partition("_")[0] for kind in kinds]
        strongest = max(names, key=("NONE", "SIGN", "ENCRYPT").index)
        return replace(topic, data_protection_kind=ProtectionKind(strongest))

    return Governance(
        tuple(
            replace(
                rule,
                topic_access_rules=tuple(
                    strongest_kind(rule, topic_rule) for topic_rule in rule.topic_access_rules
                ),
            )
            for rule in governance.domain_access_rules
        )
    )


def contradiction(side: AccessSource) -> str:
    """Return a clause with two policy lines that demand different protection of a name, or ""."""
    for protection, other in contradictions(side.protections or ()):
        places = (
            side.shown_source(stated_protection.source) for stated_protection in (other, protection)
        )
        return (
            f'{next(places)}: {other} has protect="{other.word}", and {protection} has '
            f'protect="{protection.word}" at {next(places)}'
        )
    return ""


def _looser_change(key: str, before: str, after: str, meaning: str) -> SettingChange:
    return SettingChange(Effect.LOOSER, key, before, after, meaning)


def less_protection(
    old: AccessSource, new: AccessSource, limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield the settings whose protection is weaker in ``new`` than in ``old``."""
    if "zenoh" in (old.kind, new.kind):
        pass  # a Zenoh configuration has no governance to compare
    elif old.governance and new.governance:
        yield from _looser_governance(old.governance, new.governance, limit)
    elif new.governance:
        least = _demanded_governance(old.protections or (), new.governance.domains().closed())
        yield from _looser_governance(least, _payload_governance(new.governance), limit)
    if old.authorities is not None and new.authorities is not None:
        for role, fingerprint in sorted(new.authorities - old.authorities):
            yield _looser_change(
                f"{role} CA {fingerprint[:16]}...",
                "unknown",
                "trusted",
                "anyone who has its key can become any enclave"
                if role == "identity"
                else "anyone who has its key can give any right",
            )
    yield from _unrevoked_certificates(old, new)
    yield from _changed_certificates(old, new)
    if old.kind == new.kind == "keystore" and old.zenoh is not None and new.zenoh is None:
        text = "nothing enforces any more what these files enforced"
        yield _looser_change("Zenoh files", "present", "missing", text)
    if old.routers and not {*new.routers} <= {*old.routers}:
        text = "anyone who poses as the router can read and change everything that it forwards"
        before, after = (", ".join(side.routers) for side in (old, new))
        yield _looser_change("Zenoh router", before, after, text)
    if new.zenoh_files:
        yield from looser_settings(old.zenoh_files, new.zenoh_files)
    if old.protections and new.protections is not None:
        yield from _dropped_statements(old, new, limit)
    yield from _weaker_for_later_enclaves(old, new, limit)


def _weaker_for_later_enclaves(
    old: AccessSource, new: AccessSource, limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield changes by which enclaves that are created later get less protection."""
    if old.later is None or new.later is None:
        return
    domains = DomainSet.of((0, 0))
    before, after = (
        governance_for(template.protection, domains) for template in (old.later, new.later)
    )
    changes = [
        *compare_settings(old.later, new.later, AT),
        *_looser_governance(before, after, limit),
    ]
    for change in changes:
        if change.effect is Effect.LOOSER and not change.key.endswith("validity"):
            yield replace(change, key=f"later enclaves: {change.key}")
    if old.fleet and new.fleet:
        for name, robot in new.fleet.robots.items():
            known = old.fleet.robots.get(name)
            if known and known.domain is not None and known.domain != robot.domain:
                domain = "all of the keystore" if robot.domain is None else str(robot.domain)
                there = "all domains of the keystore" if robot.domain is None else "the new domain"
                yield _looser_change(
                    f"later enclaves: domain of robot {name}",
                    str(known.domain),
                    domain,
                    f"permissions that are signed later for this robot are valid in {there}",
                )


def _changed_certificates(old: AccessSource, new: AccessSource) -> Iterator[SettingChange]:
    """Yield a change for each enclave whose certificate has another enclave's name or key."""
    names = {enclave.key: enclave.name for enclave in old.certified.values()}
    for enclave, new_one in new.certified.items():
        before = names.get(new_one.key, enclave)
        old_one = old.certified.get(enclave)
        if new_one.name not in (before, old_one.name if old_one else enclave):
            key, text = (
                f"certificate of {enclave}",
                f"anyone who has its key can act as {new_one.name}",
            )
            yield _looser_change(key, before, new_one.name, text)


def _unrevoked_certificates(old: AccessSource, new: AccessSource) -> Iterator[SettingChange]:
    """Yield a change for each certificate that enclaves refuse in ``old`` but accept in ``new``."""
    if old.trusts is None or new.trusts is None:
        return
    all_revoked = frozenset(entry for trust in old.trusts.values() for entry in trust.revoked)
    trusted: dict[int, list[str]] = defaultdict(list)

    @lru_cache(maxsize=8)  # most enclaves have the same lists, so this is cached
    def lost_revocations(before: frozenset[tuple[str, int]], after: Trust) -> list[int]:
        gone = before - after.revoked
        return sorted(serial for authority, serial in gone if authority in after.authorities)

    for name in sorted(new.trusts):
        if old.scope is None or new.scope is not None or name in old.scope:
            before = old.trusts[name].revoked if name in old.trusts else all_revoked
            for serial in lost_revocations(before, new.trusts[name]):
                trusted[serial].append(name)
    for serial in sorted(trusted)[:_MOST_SERIALS]:
        names = [name for name in trusted[serial] if name != KEYSTORE_ITSELF] or [KEYSTORE_ITSELF]
        who = (
            f"{names[0]} again trusts" if len(names) == 1 else f"{len(names)} enclaves again trust"
        )
        text = f"{who} anyone who has the key of this certificate"
        yield _looser_change(f"certificate {serial_text(serial)}", "revoked", "trusted", text)
    if (more := len(trusted) - _MOST_SERIALS) > 0:
        text = "enclaves again trust anyone who has a key of these certificates"
        yield _looser_change(counted(more, "more certificate"), "revoked", "trusted", text)


_MOST_SERIALS = 20


def _looser_governance(
    old: Governance, new: Governance, limit: SearchLimit
) -> Iterator[SettingChange]:
    pairs = dict.fromkeys(
        (rule, new_rule)
        for rule in old.domain_access_rules
        for new_rule in new.domain_access_rules
        if any(domain in new_rule.domains.closed() for domain in rule.domains.closed())
    )
    for rule, other in pairs:
        for change in attribute_changes(rule, other, "protection", ""):
            if change.effect is Effect.LOOSER:
                yield change
        for style in Style:
            yield from _looser_topics(rule, other, style, limit)


def _looser_topics(
    old: DomainRule, new: DomainRule, style: Style, limit: SearchLimit
) -> Iterator[SettingChange]:
    for before, had in _topics_by_protection(old, style):
        for after, has in _topics_by_protection(new, style):
            changes = [
                change
                for change in attribute_changes(before, after, "protection", "{}")
                if change.effect is Effect.LOOSER
            ]
            shared = had & has
            if not changes:
                continue
            topic = shared.example(limit)
            if topic is None:
                continue
            if topic not in ROS_TOPICS:
                topic = (shared & ROS_TOPICS).example(limit) or topic
            for change in changes:
                yield replace(change, meaning=change.meaning.replace("{}", f"DDS topic {topic}"))


def _topics_by_protection(rule: DomainRule, style: Style) -> list[tuple[TopicRule, NameSet]]:
    """Return pairs of a protection (a topic rule without expression) and all topics with it."""
    rules = [
        (names_of(style, (topic_rule.topic_expression,)), replace(topic_rule, topic_expression="*"))
        for topic_rule in rule.topic_access_rules
    ]
    return [
        (kind, NameSet.first((names, topic_rule == kind) for names, topic_rule in rules))
        for kind in dict.fromkeys(topic_rule for _, topic_rule in rules)
    ]


def _dropped_statements(
    old: AccessSource, new: AccessSource, limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield a change for each name for which ``new`` demands less protection than ``old``.

    An enclave that no longer demands a protection counts, even if other enclaves still demand it:
    users may merge the enclave without the others.
    """
    later = dict.fromkeys(new.protections or ())
    changed = [protection for protection in old.protections or () if protection not in later]
    allowed = defaultdict[str, list[Right]](list)
    for right in new.rights if changed else ():
        if right.qualifier is ALLOW:
            allowed[right.enclave].append(right)
    for protection in changed:
        enough = [
            statement
            for statement in later
            if (statement.level, protection.level) != (Level.SIGN, Level.ENCRYPT)
        ]
        names = _set_of_names((protection.name,)) - _set_of_names(
            _names_of_kind(enough, protection.kind)
        )
        example = names.example(limit)
        if example is not None:
            valid = names & _ABSOLUTE_NAMES
            name = example if example in _ABSOLUTE_NAMES else valid.example(limit) or example
            signed = name in _set_of_names(_names_of_kind(later, protection.kind))
            key, what = f"protect {protection}", f"{protection.kind.removesuffix('s')} {name}"
            meaning = f"the policy no longer demands this for {what}"
        else:
            lost = _topics_lost_at_enclave(protection, enough, allowed[protection.enclave])
            topic = lost.example(limit)
            if topic is None:
                continue
            own = (statement for statement in later if statement.enclave == protection.enclave)
            signed = topic in _topics((stated.kind, stated.name) for stated in own)
            key = f"protect {protection} of {protection.enclave}"
            meaning = (
                "the enclave no longer demands this; other enclaves do, but users who merge this "
                "enclave without them lose the protection"
            )
        yield _looser_change(key, protection.word, "sign" if signed else "nothing", meaning)


def _topics_lost_at_enclave(
    protection: StatedProtection, enough: Iterable[StatedProtection], rights: Iterable[Right]
) -> NameSet:
    """Return the DDS topics that an enclave may still use without a protection that it demanded.

    ``rights`` are allowed to the enclave.
    """
    allowed = ((KIND_OF[part.right], part.name) for right in rights for part in parts(right))
    own = ((stated.kind, stated.name) for stated in enough if stated.enclave == protection.enclave)
    return (_topics([(protection.kind, protection.name)]) & _topics(allowed)) - _topics(own)


def _topics(names: Iterable[tuple[str, str]]) -> NameSet:
    """Return the DDS topics of names with their kinds, such as "actions"."""
    return _set_of_names({topic for kind, name in names for topic in protected_topics(kind, name)})


def _names_of_kind(stated_protections: Iterable[StatedProtection], kind: str) -> list[str]:
    return [right.name for right in stated_protections if right.kind == kind]


def _set_of_names(names: Iterable[str]) -> NameSet:
    return NameSet.union(map(names_of_expression, names))


_ABSOLUTE_NAMES = valid_topics("", "")
"""All absolute ROS names."""


_ALL_NAMES = names_of_expression("*")


def limits_crossing(side: AccessSource) -> bool:
    """Return whether settings or fleet of a side limit the names that pass between routers."""
    network = _network(side, side)
    return network is not None and _routers_limit_names(network)


def states_routers(side: AccessSource) -> bool:
    """Return whether settings or fleet of a side state the routers, and names that pass them."""
    return _network(side, side) is not None


def added_crossing(
    old: AccessSource, new: AccessSource, limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield the changes of settings and fleet file that let more names pass between Zenoh routers.

    The changes are from ``old`` to ``new``.
    """
    before, after = _network(old, new), _network(new, old)
    if before is None or not _routers_limit_names(before):
        return
    if after is None:
        if new.later is not None and new.zenoh_files:
            meaning = "it is not known what passes between routers"
            yield _looser_change("Zenoh settings", "limit crossing", "missing", meaning)
        return
    kept = {*before.router_names()} & {*after.router_names()}
    for router in sorted(kept):
        old_crossing, new_crossing = (
            _crossing_of_router(before, router),
            _crossing_of_router(after, router),
        )
        if old_crossing != new_crossing and (
            name := _newly_passing_name(old_crossing, new_crossing, limit)
        ):
            meaning = f"{name} may pass between this router and others"
            yield _looser_change(
                f"crossing of router {router}",
                _crossing_text(old_crossing),
                _crossing_text(new_crossing),
                meaning,
            )
    yield from _looser_router_moves(before, after, {*new.permissions, *new.certified, *kept}, limit)


def _looser_router_moves(
    before: ZenohNetwork, after: ZenohNetwork, enclaves: set[str], limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield a change for each move to another router that lets more names of an enclave pass.

    Enclaves that move from the same router to the same router count once.
    """
    places: dict[tuple[str, str], str] = {}
    for enclave in sorted(enclaves):
        places.setdefault(
            (_router_name_of(before, enclave), _router_name_of(after, enclave)), enclave
        )
    for (old_router, new_router), enclave in places.items():
        if old_router == new_router:
            continue
        for old_place, later in places:
            if old_place == old_router:
                continue
            has = () if later == new_router else _crossing_of_both(after, new_router, later)
            if name := _newly_passing_name(
                _crossing_of_both(before, old_router, old_place), has, limit
            ):
                crossing = _crossing_text(_crossing_of_both(before, old_router, old_place))
                yield _looser_change(
                    f"router of {enclave}",
                    f"{old_router}, passing on {crossing}",
                    new_router,
                    f"{name} may pass between this enclave and the enclaves of router {old_place}",
                )
                break


def looser_router_rules(
    old: AccessSource, new: AccessSource, limit: SearchLimit
) -> Iterator[SettingChange]:
    """Yield changes of routers' rules that allow other routers more than in ``old``.

    A removed router counts only if the settings do not state the new routers of its enclaves.
    """
    if new.routers and not (states_routers(old) and states_routers(new)):
        for router in sorted({*old.passing} - {*new.routers}):
            meaning = "enclaves of this router may now connect to the same router as other enclaves"
            yield _looser_change(f"router {router} of Zenoh", "present", "missing", meaning)
    routers: dict[tuple[str, str], list[str]] = defaultdict(list)
    for router in sorted(old.passing.keys() & new.passing.keys()):
        had = old.passing[router]
        for right in sorted(new.passing[router] - had):
            if right.enclave not in old.passing:
                continue
            known = [r.name for r in had if r[:-1] == right[:-1]]
            if name := _newly_passing_name(((right.name,), tuple(known)), ((right.name,),), limit):
                routers[router, right.enclave].append(name)
    for (router, other), names in routers.items():
        yield _looser_change(
            f"rules of router {router} for router {other}",
            "without",
            f"with {names[0]}",
            f"{names[0]} may pass between these routers",
        )


_Crossing = tuple[tuple[str, ...], ...]
"""Lists of expressions; a name may pass if it matches an expression of every list."""


def _newly_passing_name(before: _Crossing, after: _Crossing, limit: SearchLimit) -> str:
    """Return a name that may pass by ``after`` but not by ``before``; "" if there is none."""
    names = _passing_names(after) - _passing_names(before)
    return (names & _ABSOLUTE_NAMES).example(limit) or names.example(limit) or ""


@lru_cache(maxsize=1024)
def _passing_names(crossing: _Crossing) -> NameSet:
    """Return the names that match every list of a crossing; all names if it has no list."""
    names = _ALL_NAMES
    for expressions in crossing:
        names &= NameSet.union(map(names_of_expression, expressions))
    return names


def _crossing_of_router(network: ZenohNetwork, router: str) -> _Crossing:
    """Return the limits that the network and a robot's router set for what leaves the robot."""
    own_expressions = next(
        (known.crossing for known in network.routers if known.name == router), ()
    )
    return tuple(dict.fromkeys(filter(None, (network.crossing, own_expressions))))


def _crossing_of_both(network: ZenohNetwork, first_router: str, second_router: str) -> _Crossing:
    return tuple(
        dict.fromkeys(
            (
                *_crossing_of_router(network, first_router),
                *_crossing_of_router(network, second_router),
            )
        )
    )


def _router_name_of(network: ZenohNetwork, enclave: str) -> str:
    return enclave if enclave in network.router_names() else network.router_of(enclave).name


def _crossing_text(crossing: _Crossing) -> str:
    return " within ".join(",".join(expressions) for expressions in crossing) or "everything"


def _routers_limit_names(network: ZenohNetwork) -> bool:
    return bool(network.routers) and any(
        (network.crossing, *(router.crossing for router in network.routers))
    )


def _network(side: AccessSource, other: AccessSource) -> ZenohNetwork | None:
    """Return the Zenoh network of a side, or None if neither side states routers.

    The source of the network is the settings of the side, or else the fleet of the side together
    with the settings of the other side.
    """
    if side.later is not None:
        return side.later.zenoh
    if side.kind != "policy" or side.fleet is None:
        return None
    settings = other.later.zenoh if other.later else ZenohNetwork()
    return with_routers_of_robots(settings, other.fleet, side.fleet) if settings else None
