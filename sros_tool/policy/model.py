"""The policy language of ROS: who may publish, subscribe, request, reply, call and execute.

Names follow SROS2 policy XML 0.2.0.  Values with the same statements are equal, even if they were
read from different files and lines (`Source`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, NamedTuple

from sros_tool.names import expand, is_expression
from sros_tool.values import Words, shows

VERSION = "0.2.0"

RIGHTS: dict[str, tuple[str, str]] = {
    "topics": ("publish", "subscribe"),
    "services": ("request", "reply"),
    "actions": ("call", "execute"),
}
"""Kind of names (topics, services, actions) → its two rights."""
PEER_RIGHT = {one: other for pair in RIGHTS.values() for one, other in (pair, pair[::-1])}
"""Right → the right that the peer needs, such as publish for subscribe."""
OFFERING_RIGHT = {"subscribe": "publish", "request": "reply", "call": "execute"}
"""Right to use a name → right to offer the name."""


class Qualifier(StrEnum):
    """Whether a rule allows or denies a right."""

    ALLOW = "ALLOW"
    DENY = "DENY"


ALLOW = Qualifier.ALLOW
DENY = Qualifier.DENY


class Source(NamedTuple):
    """The file and line from which a value was read."""

    file: str
    """Path of the file."""
    line: int
    """Line number, from 1; 0 if there is no line."""

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


_NOWHERE = Source("", 0)


@dataclass(frozen=True, slots=True)
class Group:
    """Names of one kind (topics, services or actions) that share the same rights and protection.

    ``rights`` are pairs of a right and its qualifier, in the order of `RIGHTS`.  ``names`` have the
    form in the policy: relative, private or absolute, perhaps with wildcards. ``protect`` is the
    minimum protection of messages with these names, or None. ``lines`` are the lines of the names
    in the file of ``source``; () if the names were not read from a single file.
    """

    kind: str
    rights: tuple[tuple[str, Qualifier], ...]
    names: tuple[str, ...]
    protect: Level | None = None
    source: Source = field(default=_NOWHERE, compare=False)
    lines: tuple[int, ...] = field(default=(), compare=False)

    def source_of(self, index: int) -> Source:
        """Return the file and line of the name at ``index``."""
        if index < len(self.lines):
            return Source(self.source.file, self.lines[index])
        return self.source


@dataclass(frozen=True, slots=True)
class Profile:
    """The rights of a node in its namespace."""

    ns: str
    node: str
    groups: tuple[Group, ...]
    source: Source = field(default=_NOWHERE, compare=False)

    @property
    def full_name(self) -> str:
        """The name of the node with its namespace, such as ``/left/gripper``."""
        return f"{self.ns.rstrip('/')}/{self.node}"


class Profiles(NamedTuple):
    """A set of profiles with its ``type`` attribute and its ``metadata`` (XML text or "")."""

    profiles: tuple[Profile, ...]
    type: str = ""
    metadata: str = ""


@dataclass(frozen=True, slots=True)
class Enclave:
    """The rights of the processes of an enclave.

    ``digest`` is the SHA-256 of the policy file with its includes, from which the enclave was read.
    """

    path: str
    profiles: tuple[Profiles, ...]
    source: Source = field(default=_NOWHERE, compare=False)
    digest: str = field(default="", compare=False)

    def all_profiles(self) -> tuple[Profile, ...]:
        """Return all profiles of the enclave, in document order."""
        return tuple(profile for block in self.profiles for profile in block.profiles)

    def with_profiles(self, change: Callable[[Profile], Profile]) -> Enclave:
        """Return the enclave with ``change`` applied to every profile."""
        blocks = (
            block._replace(profiles=tuple(map(change, block.profiles))) for block in self.profiles
        )
        return replace(self, profiles=tuple(blocks))


def policy_in_namespace(
    policy: Policy, namespace: str, unmoved: frozenset[str] = frozenset()
) -> Policy:
    """Return a policy with its enclaves and nodes below a namespace, such as ``/left``.

    Names that are written with a ``/`` at the beginning do not change.  An enclave in ``unmoved``
    keeps its path, unless another enclave gets this path.
    """
    paths = {enclave.path: below_namespace(enclave.path, namespace) for enclave in policy.enclaves}
    paths |= {path: path for path in paths.keys() & unmoved.difference(paths.values())}
    enclaves = (
        replace(
            enclave.with_profiles(
                lambda profile: replace(profile, ns=below_namespace(profile.ns, namespace))
            ),
            path=paths[enclave.path],
        )
        for enclave in policy.enclaves
    )
    return replace(policy, enclaves=tuple(enclaves))


def below_namespace(path: str, namespace: str) -> str:
    """Return the path of an enclave, or a namespace, with another namespace in front."""
    return f"{namespace.rstrip('/')}/{path.lstrip('/')}".rstrip("/") or "/"


def policy_in_enclave(policy: Policy, path: str) -> Policy:
    """Return a policy with all profiles in the enclave ``path``, for a process with all nodes."""
    blocks = tuple(block for enclave in policy.enclaves for block in enclave.profiles)
    enclaves = [replace(enclave, path=path, profiles=blocks) for enclave in policy.enclaves[:1]]
    return replace(policy, enclaves=tuple(enclaves))


def only_denials(profile: Profile) -> Profile:
    """Return a profile without its ALLOW."""
    groups = (
        replace(group, rights=tuple(pair for pair in group.rights if pair[1] is DENY))
        for group in profile.groups
    )
    return replace(profile, groups=tuple(group for group in groups if group.rights))


def policy_of_nodes(policy: Policy, nodes: Collection[str]) -> Policy:
    """Return a policy with only the rights of the named nodes, and the enclaves of these nodes.

    Denials for other nodes stay, because a denial applies to all nodes of an enclave.
    """

    def reduced(profile: Profile) -> Profile:
        return profile if profile.node in nodes else only_denials(profile)

    enclaves = []
    for enclave in policy.enclaves:
        if any(profile.node in nodes for profile in enclave.all_profiles()):
            blocks = (
                block._replace(profiles=tuple(p for p in map(reduced, block.profiles) if p.groups))
                for block in enclave.profiles
            )
            enclaves.append(replace(enclave, profiles=tuple(b for b in blocks if b.profiles)))
    return replace(policy, enclaves=tuple(enclaves))


def nodes_in_several_namespaces(
    enclaves: Iterable[Enclave],
) -> dict[tuple[str, str], tuple[Profile, ...]]:
    """Map each enclave and node with several namespaces to a profile for each namespace.

    Nodes whose names have wildcards are left out.  ``enclaves`` may have an enclave several times.
    """
    profiles_by_node: dict[tuple[str, str], dict[str, Profile]] = {}
    for enclave in enclaves:
        for profile in enclave.all_profiles():
            if profile.node and not is_expression(profile.node):
                profiles_by_node.setdefault((enclave.path, profile.node), {})[profile.ns] = profile
    return {key: tuple(by_ns.values()) for key, by_ns in profiles_by_node.items() if len(by_ns) > 1}


def nodes_in_several_enclaves(enclaves: Iterable[Enclave]) -> dict[str, dict[str, Source]]:
    """Map the full name of each node with several enclaves to these enclaves and their profiles.

    Nodes whose names have wildcards are left out.
    """
    places: dict[str, dict[str, Source]] = {}
    for enclave in enclaves:
        for profile in enclave.all_profiles():
            node = profile.full_name
            if profile.node and not is_expression(node):
                places.setdefault(node, {}).setdefault(enclave.path, profile.source)
    return {node: of_node for node, of_node in places.items() if len(of_node) > 1}


@dataclass(frozen=True, slots=True)
class Policy:
    """A policy with its includes resolved; each enclave path occurs once.

    ``fallbacks`` are the includes that used their fallback, with the path of the missing file.
    """

    enclaves: tuple[Enclave, ...]
    version: str = VERSION
    file: str = field(default="", compare=False)
    fallbacks: tuple[tuple[Source, str], ...] = field(default=(), compare=False)

    def enclave(self, path: str) -> Enclave | None:
        """Return the enclave with this path, or None."""
        return next((enclave for enclave in self.enclaves if enclave.path == path), None)

    def nodes(self) -> dict[str, tuple[str, ...]]:
        """Map each enclave to the full names of its nodes, sorted."""
        return {
            enclave.path: tuple(sorted({p.full_name for p in enclave.all_profiles()}))
            for enclave in self.enclaves
        }

    def enclaves_of_node(self, ns: str, node: str) -> tuple[Enclave, ...]:
        """Return the enclaves with a profile for the node ``node`` in the namespace ``ns``."""
        wanted = (ns.strip("/"), node)
        return tuple(
            enclave
            for enclave in self.enclaves
            if any(
                (profile.ns.strip("/"), profile.node) == wanted
                for profile in enclave.all_profiles()
            )
        )


def with_profiles(policy: Policy, change: Callable[[Profile], Profile]) -> Policy:
    """Return the policy with ``change`` applied to every profile."""
    return replace(
        policy, enclaves=tuple(enclave.with_profiles(change) for enclave in policy.enclaves)
    )


def with_groups(policy: Policy, change: Callable[[Group, Profile], Iterable[Group]]) -> Policy:
    """Return the policy with every group replaced by the groups that ``change`` returns."""

    def with_new_groups(profile: Profile) -> Profile:
        groups = tuple(new for group in profile.groups for new in change(group, profile))
        return replace(profile, groups=groups)

    return with_profiles(policy, with_new_groups)


# ── protection ─────────────────────────────────────────────────────────────────────────────


class Level(StrEnum):
    """Protection level of messages; ``..._WITH_ORIGIN_AUTHENTICATION`` also proves the writer."""

    NONE = "NONE"
    SIGN = "SIGN"
    ENCRYPT = "ENCRYPT"
    SIGN_WITH_ORIGIN_AUTHENTICATION = "SIGN_WITH_ORIGIN_AUTHENTICATION"
    ENCRYPT_WITH_ORIGIN_AUTHENTICATION = "ENCRYPT_WITH_ORIGIN_AUTHENTICATION"


PROTECT: dict[str, Level] = {"sign": Level.SIGN, "encrypt": Level.ENCRYPT}
"""Word in a policy → protection level."""


@dataclass(frozen=True, slots=True)
class TopicProtection:
    """The protection of a topic: payload, submessages, and access control."""

    data: Level = Level.ENCRYPT
    metadata: Level = Level.ENCRYPT
    read_access_control: bool = True
    write_access_control: bool = True
    discovery: bool = True
    liveliness: bool = True


class NamedProtection(NamedTuple):
    """The protection of topics, services or actions (``kind``) whose names match an expression."""

    kind: str
    name: str
    protection: TopicProtection

    def __str__(self) -> str:
        """Return kind and absolute name, such as "topic /camera/*"."""
        return f"{self.kind.removesuffix('s')} {expand(self.name, '/', '')}"


@dataclass(frozen=True, slots=True)
class DomainProtection:
    """The protection of a domain and of its names; ``default`` applies to unlisted names."""

    rtps: Level = Level.SIGN
    discovery: Level = Level.ENCRYPT
    liveliness: Level = Level.ENCRYPT
    allow_unauthenticated_participants: bool = False
    join_access_control: bool = True
    default: TopicProtection = TopicProtection()
    named: tuple[NamedProtection, ...] = ()


# ── stated protection ──────────────────────────────────────────────────────────────────────


@shows("enclave", "kind", "name", "level")
@dataclass(frozen=True, slots=True)
class StatedProtection:
    """The minimum protection that a policy requires for the matching names of one ``kind``.

    ``name`` is absolute; ``enclave`` and ``source`` are the place in a policy that states the
    protection.
    """

    enclave: str
    """Path of the enclave whose rules require the protection."""
    kind: Annotated[str, Words(RIGHTS)]
    """Kind of the names: topics, services or actions."""
    name: str
    """The absolute ROS name, perhaps with wildcards."""
    level: Level
    """The minimum protection level of messages."""
    source: Source = field(compare=False)

    def __str__(self) -> str:
        """Return kind and name, such as "topic /camera/*"."""
        return f"{self.kind.removesuffix('s')} {self.name}"

    @property
    def word(self) -> str:
        """The protection level as written in a policy."""
        return self.level.lower()


def stated_protections(enclaves: Iterable[Enclave]) -> tuple[StatedProtection, ...]:
    """Return the protection levels that enclaves require for names, in order, without duplicates.

    A level that an enclave states repeatedly for a name is returned once, with the first place.
    """
    protections: dict[StatedProtection, None] = {}
    for enclave in enclaves:
        for profile in enclave.all_profiles():
            for group in profile.groups:
                if group.protect is None:
                    continue
                for index, written in enumerate(group.names):
                    name, source = expand(written, profile.ns, profile.node), group.source_of(index)
                    statement = StatedProtection(
                        enclave.path, group.kind, name, group.protect, source
                    )
                    protections.setdefault(statement)
    return tuple(protections)
