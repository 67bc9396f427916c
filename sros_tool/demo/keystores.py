"""Create the keystores of a scenario: its own, a foreign one with another CA, and forged ones.

A keystore of the user is only read.  The keys of its CAs are not copied: a forgery that needs a
signature of a CA uses the key in place, and is skipped if the key cannot be loaded.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant
from sros_tool.demo.casting import CastMember, UserKeystore, enclave_grant, node_names
from sros_tool.demo.forger import Forge, KeystoreCopy, UncastError, Undefended, folder_name_of
from sros_tool.demo.scenarios.model import (
    DENIED_TOPIC,
    FOREIGN,
    OWN,
    Identity,
    KeystoreChoice,
    Party,
    Row,
    Scenario,
    SoundKeystore,
)
from sros_tool.demo.scenarios.zenoh_forger import start_network, zenoh_variables
from sros_tool.errors import SrosError
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
from sros_tool.keystore.layout import ROUTER_FILE, enclave_path
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.template import Template
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.stacks import ProbeEnclave
from sros_tool.runtime.variables import DOMAIN
from sros_tool.validity import Window
from sros_tool.zenoh.configuration import Mode


@dataclass(frozen=True)
class KeystoreSpec:
    """The inputs for creating keystores: ROS topic (absolute), domains, template, and time.

    ``endpoint`` is the endpoint of a Zenoh router.
    """

    topic: str
    domains: DomainSet
    template: Template
    now: datetime
    endpoint: str = "localhost:7447"


@dataclass(frozen=True)
class KeystoreSet:
    """The keystores of a scenario, unforged and forged, and the enclave of each part.

    ``missing`` has the error for each keystore that could not be made.  If there is a ``user``
    keystore, the scenario's own keystore is a copy of it: the copy and its forgeries have the cast
    of ``user``, the other keystores have ``cast``.  With a ``router``, the name of an enclave, the
    processes run on Zenoh.  ``copies`` has the forged keystores.
    """

    keystores: Mapping[KeystoreChoice, Path]
    cast: Mapping[str, str] = field(default_factory=dict)
    missing: Mapping[KeystoreChoice, Exception] = field(default_factory=dict)
    user: UserKeystore | None = None
    router: str = ""
    copies: Mapping[KeystoreChoice, KeystoreCopy] = field(default_factory=dict)

    def topic(self, party: Party, topic: str) -> str:
        """Return the ROS topic, service or action of a party; ``topic`` is the demo's topic."""
        user = self._user_of(party.identity)
        name = user.topic_of(party, topic) if user else party.topic or topic
        return f"{name}_in_the_open" if party.other_topic else name

    def enclave(self, identity: Identity) -> str:
        """Return the enclave that an identity uses.

        Raises:
            KeyError: no enclave is cast for the identity's part.
        """
        part = identity.enclave
        return part if part.startswith("/") else self._cast(identity)[part]

    def environment(self, identity: Identity, domain: int) -> Mapping[str, str]:
        """Return the ROS_SECURITY_* variables and ROS_DOMAIN_ID for a process of an identity.

        On Zenoh, return the variables with which rmw_zenoh uses the enclave's files.
        """
        if identity.keystore is None:
            return {DOMAIN: str(domain)}
        root = self.keystores[identity.keystore]
        name = self.enclave(identity)
        if self.router:
            router = (enclave_path(root, name) / ROUTER_FILE).exists()
            return zenoh_variables(
                root, name, domain, router=router, ignores_rules=identity.ignores_rules
            )
        return secured_environment(root, name, domain) | dict(identity.variables)

    def announced_enclave(self, party: Party) -> str:
        """Return the enclave that a party announces to others, or ""."""
        if party.announced:
            return self.enclave(Identity(OWN, party.announced))
        return self.enclave(party.identity) if party.identity.keystore is not None else ""

    def issue_short_lived(self, identity: Identity, lifetime: int, elapsed: float) -> float:
        """Issue an enclave a certificate that expires soon; return the seconds until its expiry.

        ``lifetime`` is the validity in seconds, and ``elapsed`` the time since the keystores were
        made. The result can differ from ``lifetime``, because certificates have whole seconds.
        """
        assert identity.keystore is not None
        copy = self.copies[identity.keystore]
        now = copy.now + timedelta(seconds=elapsed)
        expiry = (now + timedelta(seconds=lifetime)).replace(microsecond=0)
        copy.reissue(identity.enclave, Window(now - timedelta(days=1), expiry))
        return (expiry - now).total_seconds()

    def change(self, identity: Identity, forge: Forge) -> None:
        """Apply ``forge`` to the keystore of an identity."""
        assert identity.keystore is not None
        forge(self.copies[identity.keystore])

    def node_names(self, party: Party) -> tuple[str, ...]:
        """Return absolute names for a party's ROS nodes that the party's enclave allows."""
        return node_names(party.role, self._grant(party.identity))

    def members(self, rows: Iterable[Row], *, on_ros: bool) -> tuple[CastMember, ...]:
        """Return the cast members of the scenario's own keystore that these rows use, in order."""
        cast = self._cast(Identity(OWN))
        nodes: dict[str, set[str]] = {}
        for row in rows:
            for party in row.parties:
                part = party.identity.enclave
                if party.identity.keystore is OWN and part in cast:
                    nodes.setdefault(part, set()).update(self.node_names(party) if on_ros else ())
        why = self.user.why if self.user else {}
        return tuple(
            CastMember(part, cast[part], tuple(sorted(nodes[part])), why.get(part, ""))
            for part in cast
            if part in nodes
        )

    def probe(self, topic: str, domain: int) -> ProbeEnclave:
        """Return a probe that finds out whether a DDS enforces security."""
        environment = self.environment(Identity(OWN, "talker"), domain)
        return ProbeEnclave(environment, topic, DENIED_TOPIC)

    def why_inapplicable(self, row: Row) -> str:
        """Return why a row does not apply to this keystore, or "".

        A row does not apply if no enclave fits one of its parts, or if the only attacker is an
        enclave whose permissions allow the attack.
        """
        for party in row.parties:
            identity = party.identity
            part = identity.enclave
            if (
                self._user_of(identity) is not None
                and not part.startswith("/")
                and part not in self._cast(identity)
            ):
                return str(UncastError(part))
            if isinstance(error := self._missing(party), UncastError):
                return str(error)
        if self.user is not None and (enclave := self.user.permitted_enclave(row)):
            return f"only {enclave} could play the attacker, and its permissions allow the attack"
        return ""

    def problem(self, row: Row) -> str:
        """Return why a row cannot run (a keystore that could not be created), or ""."""
        return next((str(e) for party in row.parties if (e := self._missing(party))), "")

    def _missing(self, party: Party) -> Exception | None:
        choice = party.identity.keystore
        return None if choice is None else self.missing.get(choice)

    def _grant(self, identity: Identity) -> Grant | None:
        if identity.keystore is None:
            return None
        return enclave_grant(self.keystores[identity.keystore], self.enclave(identity))

    def _user_of(self, identity: Identity) -> UserKeystore | None:
        """Return the user's keystore if the identity's keystore is a copy, else None."""
        created_new = isinstance(identity.keystore, Undefended)
        if identity.keystore in (None, FOREIGN) or created_new:
            return None
        return self.user

    def _cast(self, identity: Identity) -> Mapping[str, str]:
        user = self._user_of(identity)
        return self.cast if user is None else user.cast


def create_keystores(
    folder: Path, scenario: Scenario, spec: KeystoreSpec, user: UserKeystore | None = None
) -> KeystoreSet:
    """Create all keystores of a scenario in ``folder``.

    The own keystore is a copy of the ``user`` keystore, if given.  If a forgery cannot be made,
    only the rows that use it are skipped.

    Raises:
        KeystoreError, OSError: a keystore could not be made.
    """
    keystores: dict[KeystoreChoice, Path] = {
        OWN: folder / "keystore",
        FOREIGN: folder / "another_keystore",
    }
    create_scenario_keystore(keystores[FOREIGN], scenario, spec)
    if user is None:
        create_scenario_keystore(keystores[OWN], scenario, spec)
    else:
        user.copy(keystores[OWN])
    missing: dict[KeystoreChoice, Exception] = {}
    copies: dict[KeystoreChoice, KeystoreCopy] = {}
    for choice in _forgeries_of(scenario):
        root = keystores[choice] = folder / "forged" / folder_name_of(choice)
        try:
            copies[choice] = _forge(choice, root, keystores, scenario, spec, user)
        except (SrosError, OSError) as error:
            missing[choice] = error
    return KeystoreSet(keystores, scenario.cast, missing, user, scenario.router, copies)


def create_scenario_keystore(root: Path, scenario: Scenario, spec: KeystoreSpec) -> None:
    """Create a keystore with the enclaves of a scenario."""
    create_keystore(root, template=spec.template, domains=spec.domains, now=spec.now)
    if scenario.policy is not None:
        generate_artifacts(root, policies=[scenario.policy(spec.topic)], now=spec.now)
    if scenario.unpermitted:
        create_enclaves(root, scenario.unpermitted, now=spec.now)
    if scenario.router:
        start_network(root, scenario.router, spec.endpoint, Mode.PEER, spec.now)


def _forgeries_of(scenario: Scenario) -> list[Forge | Undefended]:
    """Return the different forgeries that the rows of a scenario use."""
    used: list[KeystoreChoice | None] = [
        party.identity.keystore for row in scenario.rows for party in row.parties
    ]
    chosen = dict.fromkeys(used)
    return [
        forgery
        for forgery in chosen
        if forgery is not None and not isinstance(forgery, SoundKeystore)
    ]


def _forge(
    choice: Forge | Undefended,
    root: Path,
    keystores: Mapping[KeystoreChoice, Path],
    scenario: Scenario,
    spec: KeystoreSpec,
    user: UserKeystore | None,
) -> KeystoreCopy:
    """Create a forged keystore in ``root``."""
    cast, keyring = scenario.cast, IN_KEYSTORE
    if isinstance(choice, Undefended):
        weakened = replace(spec, template=choice.template(spec.template))
        create_scenario_keystore(root, scenario, weakened)
        forge = choice.forge
    else:
        root.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(keystores[OWN], root, symlinks=True)
        forge = choice
        if user is not None:
            cast, keyring = user.cast, user.keyring()
    domain = next(iter(spec.domains))
    foreign = keystores[FOREIGN]
    copy = KeystoreCopy(
        root, foreign, cast, spec.topic, domain, spec.now, keyring, scenario.router, spec.endpoint
    )
    forge(copy)
    return copy
