"""The access of all enclaves of a policy or keystore, on each DDS vendor and on Zenoh.

The access on one vendor, or on Zenoh, is called a world.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from itertools import product
from pathlib import Path
from shlex import quote

from sros_tool.automata import NameSet
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.dds.decision.access import Access, AccessVerb, GovernedDomain
from sros_tool.dds.decision.expressions import matches
from sros_tool.dds.decision.grants import other_fitting_enclaves
from sros_tool.dds.decision.vendors import TESTED, Style, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, TopicRule, parse_governance
from sros_tool.dds.permissions import Grant
from sros_tool.errors import KeystoreError, PolicyError, SrosError, UsageError
from sros_tool.explain.answer import Evaluator
from sros_tool.fleet.expansion import read_policy_for
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.fleet import checked_fleet
from sros_tool.keystore.layout import (
    PERMISSIONS_FILE,
    ROUTER_FILE,
    enclave_names,
    enclave_path,
    enclaves_of_closed_robot,
    has_zenoh_files,
    is_keystore,
)
from sros_tool.keystore.participant import JoinContext, LoadedEnclave, deciding_enclave
from sros_tool.keystore.protection import governance_with_stated_protections
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import FOREIGN_GRANT, RELAY, load_rights, load_zenoh_rights
from sros_tool.keystore.template import DEFAULT_TEMPLATE, Template, load_template
from sros_tool.names import ROS_DISCOVERY_TOPIC, is_expression
from sros_tool.policy.document import files_of_policies, join_policies, refuse_fallbacks
from sros_tool.policy.model import (
    ALLOW,
    PROTECT,
    Enclave,
    Level,
    Policy,
    Qualifier,
    Source,
    StatedProtection,
    stated_protections,
)
from sros_tool.policy.rights import Right, placed_rights, policy_rights
from sros_tool.proof.decide import Use
from sros_tool.proof.sources import UNCERTAIN
from sros_tool.proof.worlds import (
    LONGEST,
    Crossing,
    TopicAccess,
    World,
    any_allows,
    dds_access,
    domains_of,
    enforced_access,
    names_of_expression,
    ros_access,
    topics_of,
    zenoh_messages,
)
from sros_tool.translate import permissions_for, protected_topics
from sros_tool.translate_zenoh.rights import remote_rights, stated_rights
from sros_tool.validity import window
from sros_tool.zenoh.access import AccessControl, Enforcement

_ZENOH = "zenoh"
"""Name of the Zenoh world."""
WORLDS = (*(vendor.value for vendor in TESTED), _ZENOH)
"""The worlds that are decided: the tested vendors, and Zenoh."""
_ASSUMED_VALIDITY = timedelta(days=365)
"""Assumed validity of permissions that are not signed yet."""
_TOPICS_OF_EVERY_NODE = ((True, ROS_DISCOVERY_TOPIC), (False, ROS_DISCOVERY_TOPIC))
"""Topics without which no ROS 2 node starts on DDS, as pairs: whether the node writes, topic."""


@dataclass(frozen=True, slots=True)
class System:
    """The worlds of a policy or keystore.

    ``file`` is the path, ``rights`` are the allowed rights as stated, and ``places`` finds the
    places that state rights. ``is_keystore`` says that the source is a keystore or an export, and
    ``is_export`` that it is an export, which may lack enclaves of its keystore. ``left_out`` is the
    reason why there is no Zenoh world, if Zenoh cannot enforce the policy, or if an export lacks
    the router's file. ``fleet`` returns the
    robots of the policy or keystore, or None. ``is_package`` says that a review tries the policy of
    a package in a namespace that users could choose.
    """

    file: str
    worlds: tuple[World, ...]
    places: Places
    rights: frozenset[Right]
    left_out: SrosError | None = None
    fleet: Callable[[], Fleet | None] = lambda: None
    is_export: bool = False
    is_keystore: bool = False
    is_package: bool = False


def load_system(
    path: Path | Sequence[Path], at: Circumstances, template: Template | None = None
) -> System:
    """Return the worlds of policies, or of a keystore with its signed documents.

    Args:
        path: the keystore; or policies and folders of policies, which count as one policy.
        at: the moment, the time zone of robots, the ROS domain (for a keystore, None stands for all
            domains), the fleet, and the vendors of the wanted worlds, from `WORLDS`. A keystore
            without Zenoh configurations has no Zenoh world, and neither has an export without the
            file of a router, unless only Zenoh is wanted.
        template: the template of the keystore for which a policy is meant.

    Raises:
        DocumentError: a file cannot be read, there is no policy, two policies state the same
            enclave, or only Zenoh is wanted and cannot enforce the policy.
        KeystoreError: the keystore cannot be read, or its Zenoh rules are not known.
        UsageError: a template was given for a keystore.
    """
    paths = [path] if isinstance(path, Path) else path
    if len(paths) == 1 and is_keystore(paths[0]):
        if template:
            raise UsageError(
                f"'{paths[0]}' is a keystore, which has its own governance",
                "A template is for a policy that is not signed yet.",
                "Leave --template out, or check the policy.",
            )
        return _keystore_system(at.keystore(paths[0]), at)
    files = [file for path in paths for file in files_of_policies(path)]
    if not files:
        raise PolicyError(
            "requirements need a policy, and there is no policy", "", "Name a policy."
        )
    policy = join_policies([read_policy_for(file, at.fleet) for file in files])
    return replace(policy_system(policy, at, template), fleet=lambda: at.fleet)


# ── a policy ───────────────────────────────────────────────────────────────────────────────


def policy_system(policy: Policy, at: Circumstances, template: Template | None = None) -> System:
    """Return the worlds of a policy as if the policy were signed now, for its ROS domain or 0.

    The governance is the template's, with the protection that the policy states added.  Without a
    template, a name has exactly the protection that the policy states for it, and all other names
    have the protection of the default template.

    Raises:
        PolicyError: the policy uses the fallback of an include, or only Zenoh is wanted and cannot
            enforce the policy.
    """
    refuse_fallbacks(policy)
    domain = at.domain or 0
    domains = DomainSet.of((domain, domain))
    rights = frozenset(right for right in policy_rights(policy) if right.qualifier is ALLOW)
    stated = _stated_topics([enclave.path for enclave in policy.enclaves], rights)
    protections = stated_protections(policy.enclaves)
    protection = (template or load_template(DEFAULT_TEMPLATE)).protection
    governance = governance_with_stated_protections(protection, protections, domain)
    demanded = None if template else _demanded_topics(protections)
    subjects = {enclave.path: f"CN={enclave.path}" for enclave in policy.enclaves}
    unique = template is not None and template.unique_subject
    signed = {
        enclave.path: permissions_for(
            enclave,
            subject=subjects[enclave.path],
            validity=window(at.now, _ASSUMED_VALIDITY),
            domains=domains,
        )
        for enclave in policy.enclaves
    }
    worlds = []
    for vendor in TESTED:
        if not at.vendors or vendor.value in at.vendors:
            governed = GovernedDomain(vendor, governance, domain)
            access = {
                name: (Access(governed, permissions, subjects[name], moment=at.now),)
                for name, permissions in signed.items()
            }
            granted = {} if unique else {name: (subject,) for name, subject in subjects.items()}
            fitting_others = other_fitting_enclaves(vendor.traits, subjects, granted)
            worlds.append(
                _dds_world(vendor, access, stated, demanded=demanded, fitting_others=fitting_others)
            )
    left_out = None
    if not at.vendors or _ZENOH in at.vendors:
        try:
            remotes = tuple(remote_rights(enclave, domain) for enclave in policy.enclaves)
            worlds.append(_planned_zenoh(policy, AccessControl(remotes), domain, stated))
        except SrosError as error:
            if at.vendors:
                raise
            left_out = error
    return System(policy.file, tuple(worlds), Places.index_of_policy(policy), rights, left_out)


def _planned_zenoh(
    policy: Policy, control: AccessControl, domain: int, stated_access: Mapping[str, TopicAccess]
) -> World:
    """Return the Zenoh world with the rules that sros would write for a policy.

    Only ROS names are decided, because the rules have the same meaning as the policy only for ROS
    names.
    """
    rules = {remote.common_name: AccessControl((remote,)) for remote in control.remotes}

    def confirm(enclave: str, writes: bool, topic: str) -> bool:
        messages = zenoh_messages(topic, domain, writes=writes)
        own_rules = rules.get(enclave)
        return (
            own_rules is not None
            and bool(messages)
            and all(own_rules.allows(enclave, *e) for e in messages)
        )

    access = {enclave.path: ros_access(stated_rights(enclave)) for enclave in policy.enclaves}
    return World("Zenoh", access, confirm=confirm, stated_access=stated_access)


def _dds_world(
    vendor: Vendor,
    access: Mapping[str, Sequence[Access]],
    stated_access: Mapping[str, TopicAccess],
    *,
    title: str = "",
    idle: Collection[str] = (),
    demanded: Mapping[Level, NameSet] | None = None,
    fitting_others: Mapping[str, Sequence[str]] | None = None,
) -> World:
    """Return the world of a vendor.

    Args:
        vendor: the vendor.
        access: for each enclave, the access by its possible documents; a permission in any of them
            counts.
        stated_access: the topics that rights name without wildcards, by enclave.
        title: the title of the world; "" for the vendor's.
        idle: the enclaves without valid permissions.
        demanded: for each level, the topics for which a policy states the level; None for a
            keystore.
        fitting_others: for each enclave, other enclaves whose permissions it can present.
    """

    def confirm(enclave: str, writes: bool, topic: str) -> bool:
        verb = AccessVerb.PUBLISH if writes else AccessVerb.SUBSCRIBE
        return any(
            possible_access.decide(verb, topic).outcome.ok
            for possible_access in access.get(enclave, ())
        )

    def topics(accesses: Sequence[Access]) -> TopicAccess:
        topic_accesses = [dds_access(possible_access) for possible_access in accesses]
        if len(topic_accesses) == 1:
            return topic_accesses[0]
        writes, reads = ([getattr(e, side) for e in topic_accesses] for side in ("writes", "reads"))
        return TopicAccess(NameSet.union(writes), NameSet.union(reads))

    all_accesses = [possible_access for accesses in access.values() for possible_access in accesses]
    weak = _weaker_topics(all_accesses)
    opened = [
        names
        for possible_access in all_accesses
        if (names := possible_access.topics_of_unauthenticated()) is not None
    ]
    if demanded is not None:
        weak[Level.ENCRYPT] |= demanded[Level.SIGN]
    return World(
        title or vendor.title,
        {name: topics(accesses) for name, accesses in access.items()},
        confirm=confirm,
        stated_access=stated_access,
        weak=weak,
        demanded=None if demanded is None else NameSet.union(demanded.values()),
        needed=_TOPICS_OF_EVERY_NODE,
        idle=idle,
        fitting_others=fitting_others or {},
        longest=vendor.traits.longest_topic_name or LONGEST,
        open_topics=NameSet.union(dict.fromkeys(opened)) if opened else None,
    )


_RANK = {Level.NONE: 0, Level.SIGN: 1, Level.ENCRYPT: 2}


def _weaker_topics(access: Iterable[Access]) -> dict[Level, NameSet]:
    """Map levels to the topics that the governance of any enclave protects less than the level."""
    different = dict.fromkeys(enclave_access.protection() for enclave_access in access)
    return {
        level: NameSet.union(
            NameSet.first(
                (names, _strongest_protection(domain, rule) < rank) for names, domain, rule in rules
            )
            for rules in different
        )
        for level, rank in _RANK.items()
    }


def _demanded_topics(protections: Iterable[StatedProtection]) -> dict[Level, NameSet]:
    """Map each protection level to the topics for which a policy states this level."""
    topics: dict[Level, list[str]] = {level: [] for level in PROTECT.values()}
    for protection in protections:
        topics[protection.level] += protected_topics(protection.kind, protection.name)
    return {
        level: NameSet.union(map(names_of_expression, topic)) for level, topic in topics.items()
    }


def _strongest_protection(domain: DomainRule, rule: TopicRule) -> int:
    """Return the rank of the strongest protection of data, submessages or whole messages."""
    kinds = (
        domain.rtps_protection_kind,
        rule.metadata_protection_kind,
        rule.data_protection_kind,
    )
    return max(_RANK[Level(kind.value.partition("_")[0])] for kind in kinds)


def _stated_topics(enclaves: Iterable[str], rights: Iterable[Right]) -> dict[str, TopicAccess]:
    """Map enclaves to the topics that their rights name without wildcards.

    The topics that every node needs are included.
    """
    topics_of_enclave: dict[str, tuple[set[str], set[str]]] = {
        enclave: (set(), set()) for enclave in enclaves
    }
    for right in rights:
        if right.enclave in topics_of_enclave and not is_expression(right.name):
            for writes, topic in topics_of(right):
                topics_of_enclave[right.enclave][not writes].add(topic)
    for writes, topic in _TOPICS_OF_EVERY_NODE:
        for topics in topics_of_enclave.values():
            topics[not writes].add(topic)
    return {name: TopicAccess(*map(NameSet, topics)) for name, topics in topics_of_enclave.items()}


# ── a keystore ─────────────────────────────────────────────────────────────────────────────


_MOST_DOMAINS = 20
_MOST_GOVERNANCES = 4


_WHY_UNKNOWN = {
    FOREIGN_GRANT: "Permissions are not secret: whoever has the key of an enclave can use all "
    "permissions that have a grant for this enclave.",
    RELAY: "A process with a changed program can use whatever its peers allow.",
}
"""Ids of notes → why the rights in a keystore are not known."""


def _keystore_system(keystore: OpenedKeystore, at: Circumstances) -> System:
    """Return the worlds of a keystore.

    For each vendor, there is a world for each group of domains with the same rules.  The signed
    documents of an enclave decide, even if its key is missing or its files could not be loaded: the
    robot may have other files.  Permissions that become valid later count as valid.  The governance
    of each enclave counts for all enclaves.  Enclaves in hidden folders are included.

    Raises:
        KeystoreError: documents cannot be read, or differ too much to decide.
    """
    root = keystore.root
    names = enclave_names(root, hidden=True)
    source = load_rights(keystore, hidden=True)
    for note in source.notes:
        if note.id in _WHY_UNKNOWN:
            raise KeystoreError(
                f"the rights in keystore '{root}' are not known: {note.text.rstrip('.')}",
                _WHY_UNKNOWN[note.id],
                "Sign permissions with one grant for each enclave, with create_permission or "
                "generate_artifacts.",
            )
    rights = frozenset(right for right in source.rights if right.qualifier is ALLOW)
    stated = _stated_topics(names, rights)
    loaded = {name: deciding_enclave(keystore, name, moment=at.now) for name in names}
    for name, enclave in loaded.items():
        if (
            not enclave.permissions
            and (file := enclave_path(root, name) / PERMISSIONS_FILE).exists()
        ):
            raise KeystoreError(
                f"the rights of enclave {name} are not known: '{file}' cannot be read",
                "",
                f"`sros check {quote(str(root))}` shows what is wrong with it.",
            )
    documents = {enclave.governance for enclave in loaded.values()} - {b""}
    if names and not documents:
        raise KeystoreError(
            f"keystore '{root}' has no governance that can be read",
            "Without a governance, it is not known which topics are protected and need rights.",
            f"`sros check {quote(str(root))}` shows what is wrong with it.",
        )
    if len(documents) > _MOST_GOVERNANCES:
        raise KeystoreError(
            f"keystore '{root}' has more than {_MOST_GOVERNANCES} different governances",
            "",
            f"`sros check {quote(str(root))}` shows them. A keystore must have only one.",
        )
    listed = {
        rule.domains
        for document in documents
        for rule in parse_governance(document).domain_access_rules
    }
    grants = {name: document.grants for name, document in source.documents.items()}
    granted = {
        rule.domains
        for grants_of_enclave in grants.values()
        for grant in grants_of_enclave
        for rule in grant.rules
    }
    domains = (at.domain,) if at.domain is not None else DomainSet.one_of_each_kind(listed, granted)
    domains = domains or (0,)
    if len(domains) > _MOST_DOMAINS:
        raise KeystoreError(
            f"the rights in keystore '{root}' differ between more than {_MOST_DOMAINS} ROS domains",
            "",
            "Name one with --domain.",
        )
    subjects = {name: enclave.subject for name, enclave in loaded.items() if enclave.subject}
    granting = {
        name: [grant.subject for grant in grants_of_enclave]
        for name, grants_of_enclave in grants.items()
    }
    moments = {
        name: (at.now, *_later_moments(name, grants.get(name, ()), at.now)) for name in names
    }
    worlds = []
    for vendor, number in product(TESTED, domains):
        if at.vendors and vendor.value not in at.vendors:
            continue
        title = vendor.title if len(domains) == 1 else f"{vendor.title} in domain {number}"
        access: dict[str, tuple[Access, ...]] = {}
        idle = []
        for name, enclave in loaded.items():
            now = Evaluator(vendor, enclave, JoinContext(number, at.now, at.zone)).access
            if now is not None and len(moments[name]) == len(documents) == 1:
                access[name] = (now,)
                continue
            if now is None:
                idle.append(name)
            # Readers and writers also enforce rights by their own governance.
            possible = (
                _without_faults(enclave, grants.get(name, ()), document) for document in documents
            )
            accesses = (
                Evaluator(vendor, loaded_enclave, JoinContext(number, moment, at.zone)).access
                for loaded_enclave, moment in product(possible, moments[name])
            )
            access[name] = tuple(
                possible_access for possible_access in accesses if possible_access is not None
            )
        fitting_others = other_fitting_enclaves(vendor.traits, subjects, granting)
        worlds.append(
            _dds_world(
                vendor, access, stated, title=title, idle=idle, fitting_others=fitting_others
            )
        )
    for first in range(0, len(worlds), len(domains)):
        _link_domains(worlds[first : first + len(domains)])  # the worlds of one vendor
    is_export, left_out = not keystore.has_all_enclaves, None
    if _ZENOH in at.vendors or (not at.vendors and has_zenoh_files(root, hidden=True)):
        left_out = _missing_router_error(root, names) if is_export else None
        if left_out and at.vendors:
            raise left_out
        on_zenoh = [] if left_out else list(_zenoh_worlds(keystore, at.domain, stated))
        _link_domains(on_zenoh)
        worlds += on_zenoh
    for world in worlds if is_export else ():
        world.away = enclaves_of_closed_robot(root).elsewhere
    files = {name: str(enclave_path(root, name) / PERMISSIONS_FILE) for name in names}
    places = {
        name: [Place(r, Source(files[name], 0)) for r in source.rights if r.enclave == name]
        for name in names
    }
    return System(
        str(root),
        tuple(worlds),
        Places(places),
        rights,
        left_out,
        fleet=partial(checked_fleet, keystore),
        is_export=is_export,
        is_keystore=True,
    )


def _missing_router_error(export: Path, names: Iterable[str]) -> KeystoreError | None:
    """Return the error that no enclave of an export has the file of a router, or None."""
    if any((enclave_path(export, name) / ROUTER_FILE).is_file() for name in names):
        return None
    return KeystoreError(
        f"nothing was decided for Zenoh, because export '{export}' has no {ROUTER_FILE}",
        "Only this file shows which rights Zenoh enforces.",
        "Check the keystore that the export comes from, or name a DDS vendor with --vendor.",
    )


def _link_domains(worlds: Sequence[World]) -> None:
    """Set `elsewhere` of the worlds of a vendor, or of Zenoh: the worlds of other ROS domains."""
    for world in worlds:
        world.elsewhere = tuple(other_world for other_world in worlds if other_world is not world)


def _without_faults(
    enclave: LoadedEnclave, grants: Sequence[Grant], governance: bytes
) -> LoadedEnclave:
    """Return an enclave whose files have no fault, so that only its permissions decide."""
    subject = enclave.subject or next((grant.subject for grant in grants), "")
    return enclave._replace(subject=subject, governance=governance, state=None)


_MOST_MOMENTS = 10


def _later_moments(enclave: str, grants: Iterable[Grant], moment: datetime) -> tuple[datetime, ...]:
    """Return a moment inside the validity of each grant that becomes valid later.

    Raises:
        KeystoreError: there are too many moments to decide for all.
    """
    validities = []
    for grant in grants:
        with suppress(UsageError):  # a validity that ends before it begins
            validities.append(grant.validity)
    later = (validity for validity in validities if moment < validity.not_before)
    moments = {
        validity.not_before + (validity.not_after - validity.not_before) / 2 for validity in later
    }
    if len(moments) > _MOST_MOMENTS:
        raise KeystoreError(
            f"the permissions of enclave {enclave} become valid at more than {_MOST_MOMENTS}"
            " different times",
            "",
            "Sign them again with create_permission or generate_artifacts.",
        )
    return tuple(sorted(moments))


def _zenoh_worlds(
    keystore: OpenedKeystore, domain: int | None, stated_access: Mapping[str, TopicAccess]
) -> Iterator[World]:
    """Yield the worlds of Zenoh, one for each domain.

    Only rules that other processes enforce on a session count, because a session can ignore its own
    rules. Routers in the settings are part of the network, but requirements do not apply to
    routers, which pass on the messages of their enclaves.

    Raises:
        KeystoreError: there are no Zenoh configurations, or their effect is unclear.
    """
    root, source = keystore.root, load_zenoh_rights(keystore, hidden=True)
    for note in source.notes:
        if note.id in UNCERTAIN:
            raise KeystoreError(
                f"it is not known what Zenoh enforces in keystore '{root}': "
                f"{note.text.rstrip('.')}",
                "",
                "Write the Zenoh files again (`sros zenoh`), or name a DDS vendor with --vendor.",
            )
    enforcers = source.enforcers
    domains = (domain,) if domain is not None else domains_of(enforcers) or (0,)
    rules = {
        name: source.configurations[enclave_path(root, name) / ROUTER_FILE].access
        for name in (source.routers if source.links else ())
    }
    network = keystore.settings.zenoh if keystore.settings else None
    routers = {*source.routers}.intersection(network.router_names() if network else ())
    named = {name for enforcer in enforcers for name in enforcer.names()}
    for zenoh_domain in domains:
        title = "Zenoh" if len(domains) == 1 else f"Zenoh in domain {zenoh_domain}"
        crossing = Crossing(source.links.router_of, rules, zenoh_domain) if source.links else None
        names = {*stated_access, *named} - routers
        yield _zenoh_world(title, enforcers, names, zenoh_domain, stated_access, crossing)


def _zenoh_world(
    title: str,
    enforcers: Sequence[Enforcement],
    names: Iterable[str],
    domain: int,
    stated_access: Mapping[str, TopicAccess],
    crossing: Crossing | None,
) -> World:
    """Return the Zenoh world of a domain, with the enclaves ``names``."""

    def confirm(enclave: str, writes: bool, topic: str) -> bool:
        return any_allows(enforcers, enclave, domain, topic, writes=writes)

    no_topics = TopicAccess(NameSet(), NameSet())
    return World(
        title,
        {name: enforced_access(enforcers, name, domain) for name in names},
        confirm=confirm,
        stated_access={name: stated_access.get(name, no_topics) for name in names},
        crossing=crossing,
    )


# ── where rights are stated ────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class Place:
    """A right, with the line that states it; line 0 stands for the permissions of an enclave."""

    right: Right
    source: Source


class Places:
    """An index of stated rights: it finds the right that allows or denies a use of a topic."""

    def __init__(self, stated: Mapping[str, Iterable[Place]]) -> None:
        """Create an index of rights by enclave."""
        self._stated_topics = stated
        self._by_enclave: dict[str, list[tuple[bool, str, Place]]] = {}

    @classmethod
    def index_of_policy(cls, policy: Policy) -> Places:
        """Return the index of the rights in a policy, with their lines."""
        return cls({enclave.path: _StatedRights(enclave) for enclave in policy.enclaves})

    def find(self, use: Use, qualifier: Qualifier = ALLOW) -> Place | None:
        """Return a right that allows (or denies) a use, preferably without wildcards, or None."""
        topics = self._by_enclave.get(use.enclave)
        if topics is None:
            places = self._stated_topics.get(use.enclave, ())
            topics = self._by_enclave[use.enclave] = [
                (*topic, place) for place in places for topic in topics_of(place.right)
            ]
        best = None
        for writes, topic, place in topics:
            if writes is not use.writes or place.right.qualifier is not qualifier:
                continue
            if topic == use.topic:
                return place
            if best is None and is_expression(topic) and matches(Style.FNMATCH, topic, use.topic):
                best = place
        return best


class _StatedRights:
    """The rights and denials of an enclave in a policy; every iteration computes them again."""

    def __init__(self, enclave: Enclave) -> None:
        self._enclave = enclave

    def __iter__(self) -> Iterator[Place]:
        for placed in placed_rights(self._enclave):
            yield Place(placed.right, placed.source)
