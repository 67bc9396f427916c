"""The keystores that a scenario plays in: its own, a stranger's, and forged copies of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.model import FOREIGN, OWN, Identity, Scenario
from sros_tool.demo.policies import DENIED_TOPIC
from sros_tool.keystore import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.template import Template
from sros_tool.runtime.environment import DOMAIN, secured_environment
from sros_tool.runtime.stacks import ProbeEnclave

PROBED = "talker"
"""The part whose enclave is used to find out whether a DDS enforces security."""


@dataclass(frozen=True)
class Scenery:
    """Where the keystores are, by label, and which enclave plays which part.

    ``missing`` has the reason for which a keystore could not be made.
    """

    keystores: Mapping[str, Path]
    cast: Mapping[str, str] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)

    def enclave(self, part: str) -> str:
        """The enclave that plays a part, or that is named itself.  Raises `KeyError`."""
        return part if part.startswith("/") else self.cast[part]

    def environment(self, identity: Identity, domain: int) -> Mapping[str, str]:
        """The ROS_SECURITY_* variables and ROS_DOMAIN_ID of a process with that identity."""
        if not identity.keystore:
            return {DOMAIN: str(domain)}
        root = self.keystores[identity.keystore]
        secured = secured_environment(root, self.enclave(identity.enclave), domain)
        return secured | dict(identity.variables)

    def probe(self, topic: str, domain: int) -> ProbeEnclave:
        """What to ask a DDS in order to find out whether it enforces security."""
        environment = self.environment(Identity(OWN, PROBED), domain)
        return ProbeEnclave(environment, topic, DENIED_TOPIC)

    def problem(self, identities: Iterable[Identity]) -> str:
        """Why a party with one of these identities cannot take part, or ""."""
        for identity in identities:
            if identity.keystore in self.missing:
                return self.missing[identity.keystore]
            part = identity.enclave
            if part and not part.startswith("/") and part not in self.cast:
                return f"the keystore has no enclave for the part of the {part}"
        return ""


def build_scenery(
    folder: Path,
    scenario: Scenario,
    topic: str,
    domains: DomainSet,
    template: Template,
    now: datetime,
) -> Scenery:
    """Create both keystores of a scenario in ``folder``, for an absolute ``topic``.

    Raises what the keystore raises: `KeystoreError` and `OSError` among them.
    """
    keystores = {OWN: folder / "keystore", FOREIGN: folder / "another_keystore"}
    for root in keystores.values():
        make_keystore(root, scenario, topic, domains, template, now)
    return Scenery(keystores, scenario.cast)


def make_keystore(
    root: Path,
    scenario: Scenario,
    topic: str,
    domains: DomainSet,
    template: Template,
    now: datetime,
) -> None:
    """A keystore with the enclaves of a scenario."""
    create_keystore(root, template=template, domains=domains, now=now)
    if scenario.policy is not None:
        generate_artifacts(root, policies=[scenario.policy(topic)], now=now)
    if scenario.unpermitted:
        create_enclaves(root, scenario.unpermitted, now=now)
