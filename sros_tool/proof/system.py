"""The worlds of a policy or a keystore: what its enclaves may do with each vendor, and on Zenoh."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path

from sros_tool.automata import NameSet
from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.dds.decision.vendors import MEASURED, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, TopicRule
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.explain.evaluator import Evaluator, JoinContext, load_enclave
from sros_tool.explain.zenoh import ZenohEvaluator
from sros_tool.fleet.expansion import read_policy_for
from sros_tool.fleet.model import Fleet
from sros_tool.keystore.layout import (
    PERMISSIONS_FILE,
    enclave_names,
    enclave_path,
    has_zenoh_files,
    is_keystore,
)
from sros_tool.keystore.protection import with_stated
from sros_tool.keystore.rights import load_rights
from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
from sros_tool.names import ROS_DISCOVERY_TOPIC, is_expression
from sros_tool.policy.model import ALLOW, Policy, Source
from sros_tool.policy.protection import Level
from sros_tool.policy.rights import Right, policy_rights
from sros_tool.policy.stated import stated_protections
from sros_tool.proof.access import KeysAs, dds_access, ros_access, zenoh_access, zenoh_message
from sros_tool.proof.places import Place, Places, topics_of
from sros_tool.proof.worlds import LONGEST, TopicAccess, World
from sros_tool.translate import governance_for, permissions_for
from sros_tool.translate_zenoh import remote_rights, stated_rights
from sros_tool.validity import window
from sros_tool.zenoh.access import AccessControl, Flow, Message
from sros_tool.zenoh.enforcement import Remote

_ZENOH = "zenoh"
"""The world that is no vendor of DDS."""
WORLDS = (*(each.value for each in MEASURED), _ZENOH)
"""The worlds that are decided: the measured vendors, and Zenoh."""
_PLANNED = timedelta(days=365)
"""The assumed validity of permissions that are not signed yet."""
_OF_EVERY_NODE = ((True, ROS_DISCOVERY_TOPIC), (False, ROS_DISCOVERY_TOPIC))
"""Without these topics no node of ROS 2 starts on DDS."""


@dataclass(frozen=True, slots=True)
class System:
    """The worlds of a policy or a keystore, which is ``file``.

    ``rights`` are those that are allowed, as they are stated; ``places`` say where.  ``left_out``
    says why Zenoh was left out, if it cannot carry out the policy.
    """

    file: str
    worlds: tuple[World, ...]
    places: Places
    rights: frozenset[Right]
    left_out: SrosError | None = None


def load_system(
    path: Path,
    *,
    at: datetime,
    zone: tzinfo = UTC,
    domain: int | None = None,
    fleet: Fleet | None = None,
    world: str = "",
) -> System:
    """Return the worlds of a policy file, or of a keystore as it is signed.

    ``world`` is the only one that is wanted, of `WORLDS`; "" stands for all.  A keystore without
    configurations of Zenoh has no world of Zenoh.

    Raises:
        DocumentError: the file cannot be read, or only Zenoh is wanted and cannot carry it out.
        KeystoreError: the keystore cannot be read, or has no configurations of Zenoh that decide.
    """
    if is_keystore(path):
        return _keystore_system(path, at, zone, domain, world)
    return policy_system(read_policy_for(path, fleet), at=at, domain=domain or 0, world=world)


# ── a policy ───────────────────────────────────────────────────────────────────────────────


def policy_system(policy: Policy, *, at: datetime, domain: int = 0, world: str = "") -> System:
    """Return the worlds of a policy as it would be signed at ``at``.

    The governance is that of the default template, raised as the policy says.

    Raises:
        PolicyError: only Zenoh is wanted, and it cannot carry out the policy.
    """
    domains = DomainSet.of((domain, domain))
    rights = frozenset(each for each in policy_rights(policy) if each.qualifier is ALLOW)
    stated = _stated([each.path for each in policy.enclaves], rights)
    protection = load_template(DEFAULT_TEMPLATE).protection
    protection = with_stated(protection, stated_protections(policy.enclaves))
    governance = governance_for(protection, domains)
    signed = {
        each.path: permissions_for(
            each,
            subject=f"CN={each.path}",
            validity=window(at, _PLANNED),
            domains=domains,
        )
        for each in policy.enclaves
    }
    worlds = []
    for vendor in MEASURED:
        if world in ("", vendor.value):
            access = {
                name: Access(vendor, governance, each, f"CN={name}", domain=domain, at=at)
                for name, each in signed.items()
            }
            worlds.append(_dds_world(vendor, access, stated))
    left_out = None
    if world in ("", _ZENOH):
        try:
            remotes = tuple(remote_rights(each, domain) for each in policy.enclaves)
            worlds.append(_planned_zenoh(policy, AccessControl(remotes), domain, stated))
        except SrosError as error:
            if world:
                raise
            left_out = error
    return System(policy.file, tuple(worlds), Places.of_policy(policy), rights, left_out)


def _planned_zenoh(
    policy: Policy, control: AccessControl, domain: int, stated: Mapping[str, TopicAccess]
) -> World:
    """Return the world of Zenoh with the rules for a policy, which say exactly its rights.

    The names are those of ROS: only for them are the rules those of the policy.
    """
    rules = {each.common_name: AccessControl((each,)) for each in control.remotes}

    def allows(name: str, flow: Flow, message: Message, key: str) -> bool:
        return name in rules and rules[name].allows(name, flow, message, key)

    found = {each.path: ros_access(stated_rights(each)) for each in policy.enclaves}
    return World("Zenoh", found, confirm=_on_zenoh(allows, domain), stated=stated)


def _on_zenoh(
    allows: Callable[[str, Flow, Message, str], bool], domain: int
) -> Callable[[str, bool, str], bool]:
    def confirm(enclave: str, writes: bool, topic: str) -> bool:
        messages = zenoh_message(topic, domain, writes=writes)
        return bool(messages) and all(allows(enclave, *each) for each in messages)

    return confirm


def _dds_world(
    vendor: Vendor, access: Mapping[str, Access | None], stated: Mapping[str, TopicAccess]
) -> World:
    """Return the world of a vendor; an enclave without access takes no part."""

    def confirm(enclave: str, writes: bool, topic: str) -> bool:
        verb = AccessVerb.PUBLISH if writes else AccessVerb.SUBSCRIBE
        own = access.get(enclave)
        return own is not None and own.decide(verb, topic).outcome.ok

    nothing = TopicAccess(NameSet(), NameSet())
    running = [each for each in access.values() if each is not None]
    return World(
        vendor.title,
        {name: dds_access(each) if each else nothing for name, each in access.items()},
        confirm=confirm,
        stated=stated,
        weak=_weak(running),
        needed=_OF_EVERY_NODE,
        longest=vendor.traits.longest_topic_name or LONGEST,
    )


_RANK = {Level.NONE: 0, Level.SIGN: 1, Level.ENCRYPT: 2}


def _weak(access: Iterable[Access]) -> dict[Level, NameSet]:
    """Map levels to the topics that are protected less, by the governance of some enclave."""
    different = dict.fromkeys(each.protection() for each in access)
    return {
        level: NameSet.union(
            NameSet.first((names, _rank(domain, rule) < rank) for names, domain, rule in rules)
            for rules in different
        )
        for level, rank in _RANK.items()
    }


def _rank(domain: DomainRule, rule: TopicRule) -> int:
    """Return the strongest protection of messages: as a whole, of submessages, or of the data."""
    kinds = (
        domain.rtps_protection_kind,
        rule.metadata_protection_kind,
        rule.data_protection_kind,
    )
    return max(_RANK[Level(each.value.partition("_")[0])] for each in kinds)


def _stated(enclaves: Iterable[str], rights: Iterable[Right]) -> dict[str, TopicAccess]:
    """Map enclaves to the topics that their rights name without wildcards."""
    found: dict[str, tuple[set[str], set[str]]] = {each: (set(), set()) for each in enclaves}
    for right in rights:
        if right.enclave in found and not is_expression(right.name):
            for writes, topic in topics_of(right):
                found[right.enclave][not writes].add(topic)
    for writes, topic in _OF_EVERY_NODE:
        for topics in found.values():
            topics[not writes].add(topic)
    return {name: TopicAccess(*map(NameSet, topics)) for name, topics in found.items()}


# ── a keystore ─────────────────────────────────────────────────────────────────────────────


def _keystore_system(
    root: Path, at: datetime, zone: tzinfo, domain: int | None, world: str
) -> System:
    names = enclave_names(root)
    source = load_rights(root)
    rights = frozenset(each for each in source.rights if each.qualifier is ALLOW)
    stated = _stated(names, rights)
    loaded = {name: load_enclave(name, enclave_path(root, name), at=at) for name in names}
    if domain is None:
        known = (each.domains for each in loaded.values() if each.domains)
        domain = next((each.ranges[0].first or 0 for each in known if each.ranges), 0)
    context = JoinContext(domain, at, zone)
    worlds = []
    for vendor in MEASURED:
        if world in ("", vendor.value):
            access = {
                name: Evaluator(vendor, each, context).access for name, each in loaded.items()
            }
            worlds.append(_dds_world(vendor, access, stated))
    if world == _ZENOH or (not world and has_zenoh_files(root)):
        worlds.append(_zenoh_world(root, at, domain, stated))
    files = {name: str(enclave_path(root, name) / PERMISSIONS_FILE) for name in names}
    places = {
        name: [Place(each, Source(files[name], 0)) for each in rights if each.enclave == name]
        for name in names
    }
    return System(str(root), tuple(worlds), Places(places), rights)


def _zenoh_world(root: Path, at: datetime, domain: int, stated: Mapping[str, TopicAccess]) -> World:
    """Return the world of Zenoh as the router enforces it: a session obeys only if it wants to.

    Raises:
        KeystoreError: there are no configurations of Zenoh, or the router's opens no session.
    """
    router = ZenohEvaluator(root, at=at, domain=domain).router
    if router.process is None:
        raise KeystoreError(
            f"what Zenoh enforces in keystore '{root}' is not known",
            f"{router.problem}.",
            "Name a vendor of DDS with --vendor to decide for it alone.",
        )
    rules = router.process.access

    def access(name: str) -> TopicAccess:
        def passing(flow: Flow, message: Message, of: KeysAs) -> NameSet:
            return rules.passing(Remote(name), flow, message, of)

        return zenoh_access(passing, domain)

    def allows(name: str, flow: Flow, message: Message, key: str) -> bool:
        return rules.decide(Remote(name), flow, message, key).allowed

    found = {name: access(name) for name in stated if name != router.enclave}
    return World("Zenoh", found, confirm=_on_zenoh(allows, domain), stated=stated)
