"""Keystores with one weakness each, and the rows of the attacks that must fail in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.bench import Bench, Forge
from sros_tool.demo.forgeries import REMOVALS, in_clear
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenery import Setting, make_keystore
from sros_tool.keystore.template import Template, load_template

DOMAIN = 7


@dataclass(frozen=True)
class Weakness:
    """What is changed of a keystore that was made by the template production."""

    broken: frozenset[str]
    template: Callable[[Template], Template] = lambda template: template
    forge: Forge | None = None


def _open_modes(bench: Bench) -> None:
    for path in [bench.root, *bench.root.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)


WEAKNESSES: Mapping[str, Weakness] = {
    "one CA for both jobs": Weakness(
        frozenset(
            {
                "permissions signed by the enclave itself",
                "permissions and governance signed by itself",
            }
        ),
        lambda template: replace(template, separate_authorities=False),
    ),
    "subjects that others contain": Weakness(
        frozenset(
            {
                "permissions borrowed from a longer name",
                "old permissions put back after renewal",
            }
        ),
        lambda template: replace(template, unique_subject=False),
    ),
    "a guest with wildcard permissions": Weakness(
        frozenset(
            {
                "an enclave publishes a topic that it was not given",
                "an enclave hears a topic that it was not given",
                "an enclave calls a service that it was not given",
            }
        ),
        forge=REMOVALS["guest may do everything"].forge,
    ),
    "nothing encrypted": Weakness(frozenset({"payload read on the wire"}), in_clear),
    "files open to all users": Weakness(
        frozenset({"identity copied by another user of the robot"}), forge=_open_modes
    ),
}


def make_weak(folder: Path, weakness: Weakness, now: datetime) -> Path:
    """A keystore for the attacks with one weakness."""
    root = folder / "keystore"
    template = weakness.template(load_template("production"))
    setting = Setting("/chatter", DomainSet.of((DOMAIN, DOMAIN)), template, now)
    make_keystore(root, ATTACKS, setting)
    if weakness.forge is not None:
        weakness.forge(Bench(root, root, ATTACKS.cast, "/chatter", DOMAIN, now))
    return root
