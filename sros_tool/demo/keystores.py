"""A keystore of the user's: who in it plays which part, and a copy of those enclaves to play with.

The original is only read.  The keys of its CAs are not copied; forgeries that need a signature of
the CA ask for it where the key lies, and are left out where it does not.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import permutations
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant
from sros_tool.demo.forger import FORGERIES, REMOVALS, Bench, copy_keystore
from sros_tool.demo.model import FOREIGN, OWN, Identity, Party, Role, Row, Scenario, Status
from sros_tool.demo.nodes.names import enclave_grant, may, node_names, topics_of_its_own
from sros_tool.demo.policies import DENIED_TOPIC, SERVICE
from sros_tool.demo.records import CastMember
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.layout import ENCLAVES, PERMISSIONS, PRIVATE, ROLES, ca_key, list_enclaves
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.reader import load_ca_certificate, load_governance, load_settings
from sros_tool.keystore.template import Template
from sros_tool.names import dds_names
from sros_tool.runtime.environment import DOMAIN, secured_environment
from sros_tool.runtime.stacks import ProbeEnclave


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


_RIGHTS = {
    Role.TALKER: "publish",
    Role.LISTENER: "subscribe",
    Role.SERVER: "reply",
    Role.CLIENT: "request",
}

PROBED = "talker"
"""The part whose enclave is used to find out whether a DDS enforces security."""


@dataclass(frozen=True)
class Scenery:
    """Where the keystores are, by label, and which enclave plays which part.

    ``missing`` has the reason for which a keystore could not be made; ``casts`` the parts of
    those keystores that have other enclaves than the rest; ``services`` the name of the service
    in the keystores in which it has another one.  ``guessed`` says that its own keystore is the
    user's, whose enclaves were given the parts that their rights fit best.
    """

    keystores: Mapping[str, Path]
    cast: Mapping[str, str] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)
    casts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    services: Mapping[str, str] = field(default_factory=dict)
    guessed: bool = False

    def topic(self, party: Party, topic: str) -> str:
        """The ROS name that a party speaks on, where the topic of the demo is ``topic``."""
        name = party.topic or topic
        if name == SERVICE:
            name = self.services.get(party.identity.keystore, name)
        return f"{name}_in_the_open" if party.aside else name

    def enclave(self, identity: Identity) -> str:
        """The enclave of an identity.  Raises `KeyError` where nobody plays its part."""
        part = identity.enclave
        return part if part.startswith("/") else self._cast(identity)[part]

    def environment(self, identity: Identity, domain: int) -> Mapping[str, str]:
        """The ROS_SECURITY_* variables and ROS_DOMAIN_ID of a process with that identity."""
        if not identity.keystore:
            return {DOMAIN: str(domain)}
        root = self.keystores[identity.keystore]
        secured = secured_environment(root, self.enclave(identity), domain)
        return secured | dict(identity.variables)

    def node_names(self, party: Party) -> tuple[str, ...]:
        """Return the absolute names of a party's ROS nodes: those that its enclave allows."""
        identity = party.identity
        grant = None
        if identity.keystore:
            grant = enclave_grant(self.keystores[identity.keystore], self.enclave(identity))
        return node_names(party.role, grant)

    def members(self, rows: Iterable[Row], *, on_ros: bool) -> tuple[CastMember, ...]:
        """Return who plays in its own keystore in these rows, in the order of the cast."""
        nodes: dict[str, set[str]] = {}
        for row in rows:
            for party in row.parties:
                part = party.identity.enclave
                if party.identity.keystore == OWN and part in self._cast(party.identity):
                    nodes.setdefault(part, set()).update(self.node_names(party) if on_ros else ())
        cast = self._cast(Identity(OWN))
        return tuple(
            CastMember(part, cast[part], tuple(sorted(nodes[part])))
            for part in cast
            if part in nodes
        )

    def probe(self, topic: str, domain: int) -> ProbeEnclave:
        """What to ask a DDS in order to find out whether it enforces security."""
        environment = self.environment(Identity(OWN, PROBED), domain)
        return ProbeEnclave(environment, topic, DENIED_TOPIC)

    def problem(self, row: Row, topic: str) -> str:
        """Why a row cannot be played on the ROS topic ``topic``, or ""."""
        for party in row.parties:
            identity = party.identity
            part = identity.enclave
            if part and not part.startswith("/") and part not in self._cast(identity):
                return f"the keystore has no enclave for the part of the {part}"
            if identity.keystore in self.missing:
                return self.missing[identity.keystore]
        if self.guessed and row.expected is Status.REFUSED:
            for party in row.parties:
                if party.intruder and party.identity.keystore == OWN:
                    return self._granted(party, topic)
        return ""

    def _granted(self, party: Party, topic: str) -> str:
        """That a party has the very right that its row wants to be denied, or ""."""
        right = _RIGHTS[party.role]
        name = self.topic(party, topic)
        grant = enclave_grant(self.keystores[OWN], self.enclave(party.identity))
        topics = dds_names(right, name)
        if grant is None or not all(
            may(grant, verb, each)
            for verb in ("publish", "subscribe")
            for each in getattr(topics, verb)
        ):
            return ""
        enclave, part = self.enclave(party.identity), party.identity.enclave
        return (
            f"no enclave fits the part of the {part} better than {enclave}, and its permissions"
            f" allow to {right} {name}"
        )

    def _cast(self, identity: Identity) -> Mapping[str, str]:
        return self.casts.get(identity.keystore, self.cast)


@dataclass(frozen=True)
class Setting:
    """What keystores are made for: an absolute ``topic``, ``domains``, a template, a moment."""

    topic: str
    domains: DomainSet
    template: Template
    now: datetime


def build_scenery(
    folder: Path, scenario: Scenario, setting: Setting, given: GivenKeystore | None = None
) -> Scenery:
    """Create the keystores of a scenario in ``folder``: its own, a stranger's, and forged ones.

    Its own is a copy of the one that is ``given``, if any.

    Raises what the keystore raises: `KeystoreError` and `OSError` among them; a forgery that
    cannot be made, only leaves out the rows in which it is used.
    """
    keystores = {OWN: folder / "keystore", FOREIGN: folder / "another_keystore"}
    make_keystore(keystores[FOREIGN], scenario, setting)
    if given is None:
        make_keystore(keystores[OWN], scenario, setting)
        scenery = Scenery(keystores, scenario.cast)
    else:
        given.copy(keystores[OWN])
        of_its_own = {OWN, *FORGERIES}
        casts = dict.fromkeys(of_its_own, given.cast)
        services = dict.fromkeys(of_its_own, given.service or SERVICE)
        scenery = Scenery(
            keystores, scenario.cast, casts=casts, services=services, guessed=given.guessed
        )
    return _with_forgeries(scenery, folder, scenario, setting, given)


def make_keystore(root: Path, scenario: Scenario, setting: Setting) -> None:
    """A keystore with the enclaves of a scenario."""
    create_keystore(root, template=setting.template, domains=setting.domains, now=setting.now)
    if scenario.policy is not None:
        generate_artifacts(root, policies=[scenario.policy(setting.topic)], now=setting.now)
    if scenario.unpermitted:
        create_enclaves(root, scenario.unpermitted, now=setting.now)


def _with_forgeries(
    scenery: Scenery,
    folder: Path,
    scenario: Scenario,
    setting: Setting,
    given: GivenKeystore | None,
) -> Scenery:
    """The scenery with the forged keystores that the rows of the scenario ask for."""
    keystores, missing = dict(scenery.keystores), dict(scenery.missing)
    asked = {party.identity.keystore for row in scenario.rows for party in row.parties}
    asked |= {f"protection {kind}" for kind in scenario.measured}
    for label in sorted(asked - set(keystores) - {""}):
        root = folder / "forged" / label.replace(" ", "_").replace(",", "")
        bench = Bench(
            root,
            keystores[FOREIGN],
            scenery.casts.get(label, scenery.cast),
            setting.topic,
            next(iter(setting.domains)),
            setting.now,
            given.keyring() if given and label in FORGERIES else IN_KEYSTORE,
        )
        try:
            if label in FORGERIES:
                copy_keystore(keystores[OWN], root)
                FORGERIES[label](bench)
            else:
                removal = REMOVALS[label]
                weakened = replace(setting, template=removal.weakened(setting.template))
                make_keystore(root, scenario, weakened)
                removal.forge(bench)
        except SrosError as error:
            missing[label] = str(error)
        except KeyError as error:
            missing[label] = f"the keystore has no enclave for the part of the {error.args[0]}"
        keystores[label] = root
    return replace(scenery, keystores=keystores, missing=missing)
