"""Casting: choose enclaves of a keystore for the parts of a scenario, and their node names.

Both depend on the signed permissions.  A ROS node offers standard services under its name
(parameters, types), and an enclave made from a policy allows these only for the nodes in that
policy: a node with another name fails at start.  So a node gets a name that its enclave allows.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant, Rule, parse_permissions
from sros_tool.demo.scenarios.model import Role, Scenario
from sros_tool.demo.scenarios.policies import SERVICE
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.authorities.keyring import Keyring
from sros_tool.keystore.layout import (
    ENCLAVES,
    PRIVATE,
    ROLES,
    ca_key,
    enclave_path,
    list_enclaves,
)
from sros_tool.keystore.reader import governance_of, load_settings
from sros_tool.keystore.template import Template
from sros_tool.names import ACTION_SEPARATOR, NODE_SERVICES
from sros_tool.pki import smime
from sros_tool.policy.patterns import matches
from sros_tool.topics import dds_names, service_of

_TOPICS_OF_EVERY_NODE = ("rt/rosout", "rt/parameter_events", "rt/clock", "ros_discovery_info")
_NODE_MARK = ("rr", f"/{NODE_SERVICES[0]}Reply")
_WILD = set("*?[")


@dataclass(frozen=True)
class CastMember:
    """An enclave of the user's keystore with its part, and the names of its ROS nodes on rclpy."""

    part: str
    enclave: str
    nodes: tuple[str, ...] = ()


@dataclass(frozen=True)
class UserKeystore:
    """A user's keystore to attack, with its template, domains, and cast.

    ``topic`` is the attacked ROS topic, ``service`` the attacked ROS service ("": none).
    ``guessed`` says that the cast was chosen by the rights of the enclaves, not by their names.
    """

    root: Path
    template: Template
    domains: DomainSet
    cast: Mapping[str, str]
    topic: str
    service: str
    guessed: bool

    def copy(self, target: Path) -> None:
        """Copy the keystore with modes and links, but only the cast's enclaves and no CA keys."""
        folders = {f"{ENCLAVES}{name}" for name in self.cast.values()}
        shutil.copytree(self.root, target, symlinks=True, ignore=_all_but(self.root, folders))

    def keyring(self) -> Keyring:
        """Return the keyring of the CA keys: in the keystore if there, else as its settings say."""
        inside = {role: self.root.absolute() / ca_key(role) for role in ROLES}
        places = {role: f"file:{path}" for role, path in inside.items() if path.exists()}
        return Keyring(places=places)


def open_user_keystore(root: Path, topic: str, scenario: Scenario) -> UserKeystore:
    """Read a keystore and cast its enclaves for the ROS topic ``topic`` ("": any).

    Raises:
        KeystoreError: ``root`` is not a keystore, or no two enclaves may talk to each other.
    """
    names = list_enclaves(root)
    domains = governance_of(root).domains()
    rights = {name: grants for name in names if (grants := enclave_grant(root, name))}
    template = load_settings(root)
    # A keystore created from this template gets new CA keys, not the user's.
    template = replace(template, identity_key="", permissions_key="")
    wanted = f"rt{topic}" if topic else ""
    guessed = not set(scenario.cast.values()) <= set(names)
    if not guessed:
        cast = dict(scenario.cast)
        chosen = wanted or _first_topic(rights, cast)
    else:
        cast, chosen = _best_cast(rights, wanted)
    if not chosen:
        raise KeystoreError(
            f"no two enclaves of keystore '{root}' may talk on {topic or 'a topic'}",
            "An attack needs an enclave that may publish a topic (named without wildcards), and"
            " another enclave that may subscribe to it.",
            "Name the topic with --topic, or attack a keystore that `sros demo --keep` made.",
        )
    service = _service(rights, cast) if "server" in cast else ""
    topic = chosen.removeprefix("rt")
    return UserKeystore(root, template, domains, cast, topic, service, guessed)


def _best_cast(rights: Mapping[str, Grant], wanted: str) -> tuple[dict[str, str], str]:
    """Return the most useful cast (talker, listener, guest) and its DDS topic.

    An enclave that may only publish, or only subscribe, is more useful than one that may do both.
    """
    best: tuple[int, dict[str, str], str] = (-1, {}, "")
    for topic in [wanted] if wanted else sorted(each for each in _topics(rights) if "rt/" in each):
        talkers = {name for name in rights if allows(rights[name], "publish", topic)}
        listeners = {name for name in rights if allows(rights[name], "subscribe", topic)}
        pair = next(
            (
                (talker, listener)
                for talker in _single_purpose_first(rights, talkers, listeners)
                for listener in _single_purpose_first(rights, listeners, talkers)
                if talker != listener
            ),
            None,
        )
        if pair is None:
            continue
        cast = dict(zip(("talker", "listener"), pair, strict=True))
        guests = [name for name in rights if name not in pair]
        guests.sort(key=lambda name: (name in talkers) + (name in listeners))
        if guests:
            cast["guest"] = guests[0]
        nested = [(g, a) for g, a in permutations(rights, 2) if _within(g, a)]
        lent = next(((g, a) for g, a in nested if a in talkers and g not in talkers), None)
        if lent and not set(lent) & set(pair):
            cast["guest"], cast["admin"] = lent
        both = talkers & listeners
        score = len(cast) + (cast.get("guest") not in talkers) - len(both & set(pair))
        if score > best[0]:
            best = (score, cast, topic)
    _, cast, topic = best
    if cast:
        cast |= _serving(rights)
    return cast, topic


def _single_purpose_first(
    rights: Mapping[str, Grant], chosen: set[str], others: set[str]
) -> list[str]:
    """Return ``chosen`` in the order of ``rights``, with those also in ``others`` at the end."""
    return sorted((name for name in rights if name in chosen), key=lambda name: name in others)


def _serving(rights: Mapping[str, Grant]) -> dict[str, str]:
    """Return server and client of one service, if any; prefer a client that may not serve."""
    found: dict[str, str] = {}
    for server, client in permutations(rights, 2):
        for topic in _application_topics(rights[server], "publish"):
            service, begin = service_of(topic)
            if begin == "rr" and ACTION_SEPARATOR not in service:
                request = dds_names("request", service).publish[0]
                if "parameter" not in topic and allows(rights[client], "publish", request):
                    found = {"server": server, "client": client}
                    if not allows(rights[client], "publish", topic):
                        return found
    return found


def _service(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    """Return the service that the server of a cast offers and its client calls."""
    for topic in _application_topics(rights[cast["server"]], "publish"):
        name, begin = service_of(topic)
        requests = dds_names("request", name).publish[0]
        if begin == "rr" and allows(rights[cast["client"]], "publish", requests):
            return name
    return SERVICE


def _first_topic(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    own = [
        topic
        for topic in _application_topics(rights[cast["talker"]], "publish")
        if topic[:3] == "rt/"
    ]
    return next((t for t in own if allows(rights[cast["listener"]], "subscribe", t)), "")


def _within(short: str, long: str) -> bool:
    """Return whether ``long`` has all path components of ``short``, and more."""
    return set(short.strip("/").split("/")) < set(long.strip("/").split("/"))


def _topics(rights: Mapping[str, Grant]) -> set[str]:
    return {topic for grant in rights.values() for topic in _application_topics(grant, "publish")}


def _all_but(root: Path, folders: set[str]) -> Callable[[str, list[str]], set[str]]:
    """Return the ``ignore`` of `shutil.copytree` that skips CA keys and other enclaves."""
    wanted = {root / folder for folder in folders}
    kept = {parent for folder in wanted for parent in folder.parents} | wanted

    def left_out(parent: str, names: list[str]) -> set[str]:
        if Path(parent) == root:
            return {name for name in names if name == PRIVATE or name.startswith(".")}
        inside = Path(parent).relative_to(root).parts[0] == ENCLAVES
        paths = {name: Path(parent, name) for name in names}
        return {
            name for name, path in paths.items() if inside and path.is_dir() and path not in kept
        }

    return left_out


def enclave_grant(root: Path, enclave: str) -> Grant | None:
    """Return the first grant of an enclave, or None if its permissions cannot be read."""
    try:
        signed = (enclave_path(root, enclave) / "permissions.p7s").read_bytes()
        grants = parse_permissions(smime.parse(signed).document).grants
    except (SrosError, OSError):
        return None
    return grants[0] if grants else None


def allows(grant: Grant, verb: str, topic: str) -> bool:
    """Return whether a grant allows ``verb`` (publish or subscribe) on a DDS topic.

    The first rule that names the topic decides, as with the vendors.  A topic that no rule
    names is denied.
    """
    for rule in grant.rules:
        if any(matches(expression, topic) for expression in _expressions(rule, verb)):
            return rule.allow
    return False


def _application_topics(grant: Grant, verb: str) -> Iterator[str]:
    """Yield the application's DDS topics that a grant allows by a name without wildcards.

    Topics of every node, hidden topics and topics of actions are left out.
    """
    for topic in _allowed(grant, verb):
        private = topic.startswith("rt/_") or ACTION_SEPARATOR in topic
        if topic not in _TOPICS_OF_EVERY_NODE and not private:
            yield topic


def is_node_allowed(grant: Grant, node: str) -> bool:
    """Return whether a grant allows all standard services of the node ``node`` (absolute)."""
    names = (dds_names("reply", f"{node}/{service}") for service in NODE_SERVICES)
    return all(
        all(allows(grant, "publish", topic) for topic in each.publish)
        and all(allows(grant, "subscribe", topic) for topic in each.subscribe)
        for each in names
    )


def nodes_named(grant: Grant) -> Iterator[str]:
    """Yield the absolute names of the nodes whose standard services a grant names and allows."""
    kind, service = _NODE_MARK
    for topic in _allowed(grant, "publish"):
        if topic.startswith(kind) and topic.endswith(service):
            node = topic.removeprefix(kind).removesuffix(service)
            if is_node_allowed(grant, node):
                yield node


def _allowed(grant: Grant, verb: str) -> Iterator[str]:
    for rule in grant.rules:
        for topic in _expressions(rule, verb) if rule.allow else ():
            if not set(topic) & _WILD:
                yield topic


def _expressions(rule: Rule, verb: str) -> Iterator[str]:
    for criteria in rule.publish if verb == "publish" else rule.subscribe:
        yield from criteria.topics


DEFAULT_NODE_NAMES: Mapping[Role, tuple[str, ...]] = {
    Role.TALKER: ("talker",),
    Role.LISTENER: ("listener",),
    Role.OBSERVER: ("observer",),
    Role.SERVER: ("server",),
    Role.CLIENT: ("client",),
    Role.ACTION_SERVER: ("action_server",),
    Role.ACTION_CLIENT: ("action_client",),
    Role.COMPOSED: ("talker", "listener", "server"),
}
"""The default names of the nodes of each role, in the namespace /."""


def node_names(role: Role, grant: Grant | None) -> tuple[str, ...]:
    """Return the absolute names of a role's nodes under a grant (None: without security).

    A node keeps its default name if the grant allows it.  Otherwise it gets the most similar node
    name in the grant; if there is no such name, it keeps its default name.
    """
    wanted = [f"/{name}" for name in DEFAULT_NODE_NAMES[role]]
    if grant is None:
        return tuple(wanted)
    kept = {name for name in wanted if is_node_allowed(grant, name)}
    named = [*dict.fromkeys(nodes_named(grant))]
    free = [name for name in named if name not in kept]
    return tuple(_names(wanted, kept, free, named))


def _names(
    wanted: Sequence[str], kept: set[str], free: list[str], named: Sequence[str]
) -> Iterator[str]:
    for name in wanted:
        if name in kept or not named:
            yield name
            continue
        # With more nodes than names, two nodes share a name: DDS allows that in a process.
        alike = [each for each in free if name[1:] in each.lower()]
        chosen = (alike or free or named)[0]
        if chosen in free:
            free.remove(chosen)
        yield chosen


def naming_arguments(role: Role, names: Sequence[str]) -> list[str]:
    """Return the ``--ros-args`` that give the nodes of a role these absolute names."""
    rules: list[str] = []
    for default, name in zip(DEFAULT_NODE_NAMES[role], names, strict=True):
        namespace, _, node = name.rpartition("/")
        if node != default:
            rules += ["-r", f"{default}:__node:={node}"]
        if namespace:
            # rcl looks up the namespace under the new name of the node.
            rules += ["-r", f"{node}:__ns:={namespace}"]
    return ["--ros-args", *rules, "--"] if rules else []
