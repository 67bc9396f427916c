"""A keystore of the user's: who in it plays which part, and a copy of those enclaves to play with.

The original is only read.  The keys of its CAs are not copied; forgeries that need a signature of
the CA ask for it where the key lies, and are left out where it does not.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant, Rule, parse_permissions
from sros_tool.demo.model import Scenario
from sros_tool.demo.policies import SERVICE
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.authority import load_ca_certificate
from sros_tool.keystore.create import list_enclaves
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.keyring import Keyring
from sros_tool.keystore.layout import ENCLAVES, PERMISSIONS, PRIVATE, ROLES, ca_key
from sros_tool.keystore.open import load_governance, load_settings
from sros_tool.keystore.template import Template
from sros_tool.pki import smime
from sros_tool.policy.patterns import matches

_EVERY_NODE = ("rt/rosout", "rt/parameter_events", "rt/clock", "ros_discovery_info")
_WILD = set("*?[")


@dataclass(frozen=True)
class GivenKeystore:
    """A keystore to be attacked: where it is, its template, its domains, and its cast.

    ``topic`` is the ROS topic that is attacked, ``service`` the ROS service, "" without one.
    """

    root: Path
    template: Template
    domains: DomainSet
    cast: Mapping[str, str]
    topic: str
    service: str

    def copy(self, target: Path) -> None:
        """Copy the enclaves of the cast, with their modes and links, but no key of a CA."""
        folders = {f"{ENCLAVES}{name}" for name in self.cast.values()}
        shutil.copytree(self.root, target, symlinks=True, ignore=_all_but(self.root, folders))

    def keyring(self) -> Keyring:
        """Where the keys of the CAs are: at home, or where the settings of the keystore say."""
        at_home = {role: self.root.absolute() / ca_key(role) for role in ROLES}
        places = {role: f"file:{path}" for role, path in at_home.items() if path.exists()}
        return Keyring(places=places)


def open_given(root: Path, topic: str, scenario: Scenario) -> GivenKeystore:
    """Look into a keystore; ``topic`` is the ROS topic to attack, "" for one that fits.

    Raises `KeystoreError` where it is none, or where nobody may talk to anybody.
    """
    names = list_enclaves(root)
    domains = load_governance(root, load_ca_certificate(root, PERMISSIONS)).domains()
    rights = {name: grants for name in names if (grants := _grants(root, name))}
    template = load_settings(root)
    # Whatever is made beside it has keys of its own.
    template = replace(template, identity_key="", permissions_key="")
    wanted = f"rt{topic}" if topic else ""
    if set(scenario.cast.values()) <= set(names):
        cast = dict(scenario.cast)
        chosen = wanted or _first_topic(rights, cast)
    else:
        cast, chosen = _cast(rights, wanted)
    if not chosen:
        raise KeystoreError(
            f"no two enclaves of keystore '{root}' talk on {topic or 'a topic'}",
            "An attack on it needs one enclave that may publish a topic and another one that may"
            " subscribe it, by a name without wildcards.",
            "Name the topic with --topic, or attack a keystore made by the demo.",
        )
    service = _service(rights, cast) if "server" in cast else ""
    return GivenKeystore(root, template, domains, cast, chosen.removeprefix("rt"), service)


def _cast(rights: Mapping[str, Grant], wanted: str) -> tuple[dict[str, str], str]:
    """A talker, a listener and a guest on one topic, the most telling ones first."""
    best: tuple[int, dict[str, str], str] = (-1, {}, "")
    for topic in [wanted] if wanted else sorted(each for each in _topics(rights) if "rt/" in each):
        talkers = [name for name in rights if _may(rights[name], "publish", topic)]
        listeners = [name for name in rights if _may(rights[name], "subscribe", topic)]
        pair = next(((t, s) for t in talkers for s in listeners if t != s), None)
        if pair is None:
            continue
        cast = dict(zip(("talker", "listener"), pair, strict=True))
        guests = [name for name in rights if name not in pair]
        guests.sort(key=lambda name: name in talkers or name in listeners)
        if guests:
            cast["guest"] = guests[0]
        inside = [(g, a) for g, a in permutations(rights, 2) if _within(g, a)]
        lent = next(((g, a) for g, a in inside if a in talkers and g not in talkers), None)
        if lent and not set(lent) & set(pair):
            cast["guest"], cast["admin"] = lent
        score = len(cast) + (cast.get("guest") not in talkers)
        if score > best[0]:
            best = (score, cast, topic)
    _, cast, topic = best
    if cast:
        cast |= _serving(rights)
    return cast, topic


def _serving(rights: Mapping[str, Grant]) -> dict[str, str]:
    """A server and a client of one service, if there are any."""
    for server, client in permutations(rights, 2):
        for topic in _names(rights[server], "publish"):
            if topic.startswith("rr/") and topic.endswith("Reply") and "/_action/" not in topic:
                request = f"rq{topic[2:].removesuffix('Reply')}Request"
                if "parameter" not in topic and _may(rights[client], "publish", request):
                    return {"server": server, "client": client}
    return {}


def _service(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    """The service that the server of a cast offers and its client calls."""
    for topic in _names(rights[cast["server"]], "publish"):
        name = topic[2:].removesuffix("Reply")
        if topic == f"rr{name}Reply" and _may(
            rights[cast["client"]], "publish", f"rq{name}Request"
        ):
            return name
    return SERVICE


def _first_topic(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    own = [topic for topic in _names(rights[cast["talker"]], "publish") if topic[:3] == "rt/"]
    return next((t for t in own if _may(rights[cast["listener"]], "subscribe", t)), "")


def _within(short: str, long: str) -> bool:
    """Whether the name of an enclave is contained in another's, by its parts."""
    return set(short.strip("/").split("/")) < set(long.strip("/").split("/"))


def _topics(rights: Mapping[str, Grant]) -> set[str]:
    return {topic for grant in rights.values() for topic in _names(grant, "publish")}


def _names(grant: Grant, verb: str) -> Iterator[str]:
    """The names without wildcards that a grant allows, apart from those of every node."""
    for rule in grant.rules:
        for topic in _expressions(rule, verb) if rule.allow else ():
            private = topic.startswith("rt/_") or "/_action/" in topic
            if topic not in _EVERY_NODE and not private and not set(topic) & _WILD:
                yield topic


def _may(grant: Grant, verb: str, topic: str) -> bool:
    """Whether the first rule that speaks of a topic allows it, as the vendors decide."""
    for rule in grant.rules:
        if any(matches(expression, topic) for expression in _expressions(rule, verb)):
            return rule.allow
    return False


def _expressions(rule: Rule, verb: str) -> Iterator[str]:
    for criteria in rule.publish if verb == "publish" else rule.subscribe:
        yield from criteria.topics


def _grants(root: Path, name: str) -> Grant | None:
    """The first grant of an enclave; None where its permissions cannot be read."""
    try:
        signed = (enclave_path(root, name) / "permissions.p7s").read_bytes()
        grants = parse_permissions(smime.parse(signed).document).grants
    except (SrosError, OSError):
        return None
    return grants[0] if grants else None


def _all_but(root: Path, folders: set[str]) -> Callable[[str, list[str]], set[str]]:
    """What `shutil.copytree` leaves out: keys of CAs, and enclaves without a part."""
    wanted = {root / folder for folder in folders}
    on_the_way = {parent for folder in wanted for parent in folder.parents} | wanted

    def left_out(parent: str, names: list[str]) -> set[str]:
        if Path(parent) == root:
            return {name for name in names if name == PRIVATE or name.startswith(".")}
        inside = Path(parent).relative_to(root).parts[0] == ENCLAVES
        paths = {name: Path(parent, name) for name in names}
        return {
            name
            for name, path in paths.items()
            if inside and path.is_dir() and path not in on_the_way
        }

    return left_out
