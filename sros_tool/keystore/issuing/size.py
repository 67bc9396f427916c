"""The size of signed permissions, measured with a temporary key."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import MAX_SIGNED_BYTES, render_permissions
from sros_tool.errors import Note
from sros_tool.files import policies_dir
from sros_tool.fleet.expansion import (
    FleetPolicy,
    absolute,
    check_narrowed,
    unobserved_robots,
    with_placeholders,
    written,
)
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.rights import load_rights
from sros_tool.names import dds_names
from sros_tool.pki import smime
from sros_tool.pki.certificates import common_name, issue_ca, subject_text
from sros_tool.pki.keys import generate_key
from sros_tool.policy.document import checked_text, read_policy
from sros_tool.policy.minimize import (
    EnclaveUse,
    MinimizedPolicy,
    WildcardProposal,
    minimize,
    propose_wildcards,
)
from sros_tool.policy.model import Enclave, Group, Policy
from sros_tool.policy.rights import Right, policy_rights
from sros_tool.translate import permissions_for
from sros_tool.validity import window
from sros_tool.values import DryRun, FileChanges, Notes, shows
from sros_tool.wording import first_few

_SHOWN = 5
"""The number of robots that a note names."""
_LINE = len("<topic></topic>\r\n")


class SizeEstimator:
    """Estimator of the size of signed permissions, which signs them with a temporary key.

    The error is below 100 bytes: the name of the CA and the signature vary in length.
    """

    def __init__(self) -> None:
        self._key = generate_key()
        self._validity = window(datetime(2026, 1, 1, tzinfo=UTC), timedelta(days=365))
        self._certificate = issue_ca(
            self._key, common_name("sros permissions CA 00000000"), self._validity
        )

    def signed_bytes(self, enclave: Enclave) -> int:
        """Return the size in bytes of ``permissions.p7s`` for an enclave of a policy."""
        permissions = permissions_for(
            enclave,
            subject=subject_text(common_name(enclave.path)),
            validity=self._validity,
            domains=DomainSet.of((0, 0)),
        )
        return len(smime.sign(render_permissions(permissions), self._certificate, self._key))


def right_bytes(right: Right) -> int:
    """Return the size in bytes of one right in a large permissions document.

    It has one line per DDS topic.  In a smaller document the lines are indented as well.
    """
    names = dds_names(right.right, right.name)
    return sum(_LINE + len(name) for name in (*names.publish, *names.subscribe))


# ── of a minimized policy ──────────────────────────────────────────────────────────────────

_MARGIN = 256
"""Bytes kept free below the size limit: CA names and signatures vary in length."""


class PermissionsBytes(NamedTuple):
    """Size of the signed permissions."""

    before: int
    """Bytes before."""
    after: int
    """Bytes after."""
    limit: int = MAX_SIGNED_BYTES
    """Bytes that Fast DDS 2.9 no longer reads."""


@shows(spread=("use",))
class MinimizedEnclave(NamedTuple):
    """An enclave."""

    use: EnclaveUse
    """Its rights, and those that were observed."""
    bytes: PermissionsBytes
    """Size of the signed permissions."""
    proposals: tuple[WildcardProposal, ...]
    """Wildcards that would make permissions small enough."""


class PolicyMinimization(NamedTuple):
    """The rights of a policy that were observed in use."""

    policy: Path
    """POLICY, as it was named."""
    output: Path | None
    """The file that was written, or null."""
    enclaves: Sequence[MinimizedEnclave]
    """The enclaves of the policy."""
    dry_run: DryRun
    changes: FileChanges
    notes: Notes


class Minimization(NamedTuple):
    """A policy without the rights that were not observed, and what of each enclave was."""

    document: bytes
    enclaves: Sequence[MinimizedEnclave]
    notes: Sequence[Note]


def minimized_policy(
    file: Path,
    observed: Iterable[Path],
    fleet: Fleet | None = None,
    *,
    strict: bool = False,
    output: Path | None = None,
) -> Minimization:
    """Return the policy in a file without the rights that were never observed in use.

    Args:
        file: the policy.
        observed: policies or permissions with the rights that were observed.
        fleet: the robots that placeholders of the policies stand for.  What was observed of some
            stays for all robots of the same enclave, and sizes are those of the longest path.
        strict: also remove unused rights that every node needs.
        output: where the policy is going to be written.

    Raises:
        PolicyError: a policy cannot be read, or would change when it is written.
    """
    given = read_policy(file, placeholders=fleet is not None)
    sources = [load_rights(path, fleet) for path in observed]
    used = seen = frozenset(right for source in sources for right in source.rights)
    notes = [note for source in sources for note in source.notes]
    robots = FleetPolicy(given, fleet) if fleet else None
    if robots:
        seen = with_placeholders(robots, used)
        notes += _robot_notes(unobserved_robots(robots, used))
    stated = absolute(given)
    result = minimize(stated, seen, () if strict else _node_basics())
    if robots:
        check_narrowed(robots, result, used)
    notes += _scope_notes(given, result, seen)
    narrowed = written(result.policy)
    document = checked_text(narrowed, output, "narrowed", placeholders=fleet is not None)
    return Minimization(document, _measured(stated, result, seen, fleet), notes)


def _node_basics() -> Sequence[Group]:
    """Return the rights that every node needs, as groups of a profile."""
    basics = read_policy(policies_dir() / "defaults" / "node_basics.xml")
    profiles = (profile for enclave in basics.enclaves for profile in enclave.all_profiles())
    return [group for profile in profiles for group in profile.groups]


def _robot_notes(unobserved: Mapping[str, Sequence[str]]) -> Iterator[Note]:
    for path, robots in unobserved.items():
        text = (
            f"{path} was never observed for {first_few(robots, _SHOWN)}: what only these "
            "use is removed, too."
        )
        yield Note("minimize.robot-never-observed", text)


def _scope_notes(given: Policy, result: MinimizedPolicy, seen: Set[Right]) -> Iterator[Note]:
    unseen = [use.enclave for use in result.uses if not use.observed_at_all]
    if unseen:
        text = f"never observed, and therefore not changed: {', '.join(unseen)}."
        yield Note("minimize.enclave-never-observed", text)
    unknown = sorted(
        {right.enclave for right in seen} - {enclave.path for enclave in given.enclaves}
    )
    if unknown:
        text = f"observed, but not in the policy: {', '.join(unknown)}."
        yield Note("minimize.enclave-not-in-policy", text)


def _measured(
    given: Policy, result: MinimizedPolicy, seen: Set[Right], fleet: Fleet | None
) -> list[MinimizedEnclave]:
    """Return the enclaves of a minimized policy with their sizes."""
    estimator = SizeEstimator()
    measured = []
    for before, after, use in zip(given.enclaves, result.policy.enclaves, result.uses, strict=True):
        sizes = PermissionsBytes(
            *(estimator.signed_bytes(_longest(Policy((each,)), fleet)) for each in (before, after))
        )
        proposals: tuple[WildcardProposal, ...] = ()
        if sizes.after > MAX_SIGNED_BYTES - _MARGIN:
            proposals = propose_wildcards(
                after.path,
                policy_rights(result.policy),
                policy_rights(given) | seen,
                needed=sizes.after - MAX_SIGNED_BYTES + _MARGIN,
                size=right_bytes,
            )
        measured.append(MinimizedEnclave(use, sizes, proposals))
    return measured


def _longest(policy: Policy, fleet: Fleet | None) -> Enclave:
    """Return the only enclave of a policy, or the one of the robot with the longest path."""
    robots = FleetPolicy(written(policy), fleet) if fleet else None
    return robots[max(robots, key=len)] if robots else policy.enclaves[0]
