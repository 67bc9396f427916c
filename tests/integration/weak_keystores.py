"""Keystores with one weakness each, and the rows of the attacks that must fail in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.demo import forger
from sros_tool.demo.backend import Backend
from sros_tool.demo.forger import Forge, KeystoreCopy
from sros_tool.demo.keystores import KeystoreSpec, create_scenario_keystore
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.model import Condition
from sros_tool.keystore.template import Template, load_template

DOMAIN = 7
SIGNED_BY_ITSELF = frozenset(
    {
        "permissions signed by the enclave itself",
        "permissions and governance signed by the enclave",
    }
)
"""Rows that fail only where an enclave is accepted as a signer."""


@dataclass(frozen=True)
class Weakness:
    """What is changed of a keystore that was made by the template production.

    ``broken`` are the rows that must fail in it, ``on_fast`` those on Fast DDS, where they differ;
    ``untried`` are those that it makes impossible.
    """

    broken: frozenset[str]
    template: Callable[[Template], Template] = lambda template: template
    forge: Forge | None = None
    on_fast: frozenset[str] | None = None
    untried: frozenset[str] = frozenset()

    def broken_on(self, backend: Backend) -> frozenset[str]:
        """The rows that must fail in it on a back end."""
        if backend.vendor is Condition.FAST and self.on_fast is not None:
            return self.on_fast
        return self.broken - (SIGNED_BY_ITSELF if backend.checks_signers else frozenset())


def _open_modes(bench: KeystoreCopy) -> None:
    for path in [bench.root, *bench.root.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)


WEAKNESSES: Mapping[str, Weakness] = {
    "one CA for both jobs": Weakness(
        SIGNED_BY_ITSELF,
        lambda template: replace(template, separate_authorities=False),
    ),
    "subjects that others contain": Weakness(
        frozenset(
            {
                "permissions borrowed from a longer enclave name",
                "old permissions put back after renewal",
            }
        ),
        lambda template: replace(template, unique_subject=False),
        on_fast=frozenset({"old permissions put back after renewal"}),
    ),
    "a guest with wildcard permissions": Weakness(
        frozenset(
            {
                "an enclave publishes a topic that it was not given",
                "an enclave hears a topic that it was not given",
                "an enclave calls a service that it was not given",
                "the widest enclave poses as the server",
            }
        ),
        forge=forger.guest_may_do_everything,
        # Permissions that the ledger does not have are not signed again.
        untried=frozenset({"old permissions put back after renewal"}),
    ),
    "nothing encrypted": Weakness(
        frozenset({"payload read on the wire", "packets of a secured talker changed"}),
        forger.unprotected,
    ),
    "files open to all users": Weakness(
        frozenset({"identity copied by another user of the robot"}), forge=_open_modes
    ),
}


def make_weak(folder: Path, weakness: Weakness, now: datetime) -> Path:
    """A keystore for the attacks with one weakness."""
    root = folder / "keystore"
    template = weakness.template(load_template("production"))
    spec = KeystoreSpec("/chatter", DomainSet.of((DOMAIN, DOMAIN)), template, now)
    create_scenario_keystore(root, ATTACKS, spec)
    if weakness.forge is not None:
        weakness.forge(KeystoreCopy(root, root, ATTACKS.cast, "/chatter", DOMAIN, now))
    return root
