"""Finds the lines of a policy from which a rule of signed permissions came."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from sros_tool.dds.decision import Verb
from sros_tool.keystore.ledger import read_ledger
from sros_tool.names import dds_names, expand
from sros_tool.policy.model import Enclave, Group, Profile, Qualifier, Source
from sros_tool.policy.rights import Right


@dataclass(frozen=True, slots=True)
class Origin:
    """A name in a policy that stands for a rule: where it is written, how, and what it says.

    ``group`` and ``profile`` are those that it stands in; ``right`` is the policy's word.
    """

    source: Source
    qualifier: Qualifier
    right: str
    name: str
    group: Group
    profile: Profile

    def __str__(self) -> str:
        """As ``robot.xml:12: ALLOW publish chatter``."""
        return f"{self.source}: {self.qualifier.value} {self.right} {self.name}"


class Provenance(StrEnum):
    """How signed permissions and a policy file hang together."""

    SAME = "same"
    """They were made from the file as it is now."""
    CHANGED = "changed"
    """They were made from another file, or the file has changed since."""
    UNKNOWN = "unknown"
    """The ledger does not know what they were made from."""
    PLANNED = "planned"
    """The policy was asked itself; nothing is signed."""


def provenance(root: Path, signed: bytes, policy: Enclave) -> Provenance:
    """Whether ``policy`` is what the ledger of a keystore says that ``signed`` was made from."""
    digest = recorded_policy(root, signed)
    if not digest:
        return Provenance.UNKNOWN
    return Provenance.SAME if digest == policy.digest else Provenance.CHANGED


def recorded_policy(root: Path, signed: bytes) -> str:
    """The SHA-256 of the policy that signed permissions were made from, or ""."""
    digest = hashlib.sha256(signed).hexdigest()
    found = (e.policy for e in reversed(read_ledger(root)) if e.sha256 == digest)
    return next(found, "")


def origins(
    enclave: Enclave, verb: Verb, expression: str, qualifier: Qualifier
) -> tuple[Origin, ...]:
    """The names of an enclave's policy that stand for a DDS ``expression`` of signed permissions.

    Several nodes of an enclave may have the same right, so there may be several.
    """
    return tuple(
        each
        for each in _names(enclave)
        if each.qualifier is qualifier and expression in _topics(each, verb)
    )


def origins_of(enclave: Enclave, right: Right) -> tuple[Origin, ...]:
    """The names of an enclave's policy that state a right or denial."""
    return tuple(
        each
        for each in _names(enclave)
        if (each.qualifier, each.right) == (right.qualifier, right.right)
        and expand(each.name, each.profile.ns, each.profile.node) == right.name
    )


def _names(enclave: Enclave) -> Iterator[Origin]:
    for profile in enclave.all_profiles():
        for group in profile.groups:
            for index, name in enumerate(group.names):
                source = group.source_of(index)
                for right, qualifier in group.rights:
                    yield Origin(source, qualifier, right, name, group, profile)


def _topics(origin: Origin, verb: Verb) -> tuple[str, ...]:
    fqn = expand(origin.name, origin.profile.ns, origin.profile.node)
    names = dds_names(origin.right, fqn)
    return names.publish if verb is Verb.PUBLISH else names.subscribe
