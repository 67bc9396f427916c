"""A keystore of the user's: who in it plays which part, and a copy of those enclaves to play with.

The original is only read.  The keys of its CAs are not copied; forgeries that need a signature of
the CA ask for it where the key lies, and are left out where it does not.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant
from sros_tool.demo.granted import enclave_grant, may, topics_of_its_own
from sros_tool.demo.model import Scenario
from sros_tool.demo.policies import SERVICE
from sros_tool.errors import KeystoreError
from sros_tool.keystore.authority import load_ca_certificate
from sros_tool.keystore.create import list_enclaves
from sros_tool.keystore.keyring import Keyring
from sros_tool.keystore.layout import ENCLAVES, PERMISSIONS, PRIVATE, ROLES, ca_key
from sros_tool.keystore.open import load_governance, load_settings
from sros_tool.keystore.template import Template


@dataclass(frozen=True)
class GivenKeystore:
    """A keystore to be attacked: where it is, its template, its domains, and its cast.

    ``topic`` is the ROS topic that is attacked, ``service`` the ROS service, "" without one.
    ``guessed`` says that the cast was chosen by the rights of its enclaves, not by their names.
    """

    root: Path
    template: Template
    domains: DomainSet
    cast: Mapping[str, str]
    topic: str
    service: str
    guessed: bool

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
    rights = {name: grants for name in names if (grants := enclave_grant(root, name))}
    template = load_settings(root)
    # Whatever is made beside it has keys of its own.
    template = replace(template, identity_key="", permissions_key="")
    wanted = f"rt{topic}" if topic else ""
    guessed = not set(scenario.cast.values()) <= set(names)
    if not guessed:
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
    topic = chosen.removeprefix("rt")
    return GivenKeystore(root, template, domains, cast, topic, service, guessed)


def _cast(rights: Mapping[str, Grant], wanted: str) -> tuple[dict[str, str], str]:
    """A talker, a listener and a guest on one topic, the most telling ones first.

    Who may only publish, or only subscribe, tells more than who may do both.
    """
    best: tuple[int, dict[str, str], str] = (-1, {}, "")
    for topic in [wanted] if wanted else sorted(each for each in _topics(rights) if "rt/" in each):
        talkers = {name for name in rights if may(rights[name], "publish", topic)}
        listeners = {name for name in rights if may(rights[name], "subscribe", topic)}
        pair = next(
            (
                (talker, listener)
                for talker in _pure_first(rights, talkers, listeners)
                for listener in _pure_first(rights, listeners, talkers)
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
        inside = [(g, a) for g, a in permutations(rights, 2) if _within(g, a)]
        lent = next(((g, a) for g, a in inside if a in talkers and g not in talkers), None)
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


def _pure_first(rights: Mapping[str, Grant], chosen: set[str], others: set[str]) -> list[str]:
    """Those ``chosen``, in the order of ``rights``, with those at the end that are in both."""
    return sorted((name for name in rights if name in chosen), key=lambda name: name in others)


def _serving(rights: Mapping[str, Grant]) -> dict[str, str]:
    """A server and a client of one service, if any; rather a client that may not serve, too."""
    found: dict[str, str] = {}
    for server, client in permutations(rights, 2):
        for topic in topics_of_its_own(rights[server], "publish"):
            if topic.startswith("rr/") and topic.endswith("Reply") and "/_action/" not in topic:
                request = f"rq{topic[2:].removesuffix('Reply')}Request"
                if "parameter" not in topic and may(rights[client], "publish", request):
                    found = {"server": server, "client": client}
                    if not may(rights[client], "publish", topic):
                        return found
    return found


def _service(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    """The service that the server of a cast offers and its client calls."""
    for topic in topics_of_its_own(rights[cast["server"]], "publish"):
        name = topic[2:].removesuffix("Reply")
        if topic == f"rr{name}Reply" and may(rights[cast["client"]], "publish", f"rq{name}Request"):
            return name
    return SERVICE


def _first_topic(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    own = [
        topic
        for topic in topics_of_its_own(rights[cast["talker"]], "publish")
        if topic[:3] == "rt/"
    ]
    return next((t for t in own if may(rights[cast["listener"]], "subscribe", t)), "")


def _within(short: str, long: str) -> bool:
    """Whether the name of an enclave is contained in another's, by its parts."""
    return set(short.strip("/").split("/")) < set(long.strip("/").split("/"))


def _topics(rights: Mapping[str, Grant]) -> set[str]:
    return {topic for grant in rights.values() for topic in topics_of_its_own(grant, "publish")}


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
