"""The keystores that a scenario plays in: its own, a stranger's, and forged copies of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.bench import Bench, copy_keystore
from sros_tool.demo.forgeries import FORGERIES, REMOVALS
from sros_tool.demo.given import GivenKeystore
from sros_tool.demo.granted import enclave_grant, may
from sros_tool.demo.model import FOREIGN, OWN, Identity, Party, Role, Row, Scenario, Status
from sros_tool.demo.node_names import node_names
from sros_tool.demo.policies import DENIED_TOPIC, SERVICE
from sros_tool.demo.records import CastMember
from sros_tool.errors import SrosError
from sros_tool.keystore import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.keyring import IN_KEYSTORE
from sros_tool.keystore.template import Template
from sros_tool.names import dds_names
from sros_tool.runtime.environment import DOMAIN, secured_environment
from sros_tool.runtime.stacks import ProbeEnclave

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
