"""The size of signed permissions, measured with a temporary key."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import MAX_SIGNED_BYTES, render_permissions
from sros_tool.errors import Note
from sros_tool.fleet.expansion import (
    FleetPolicy,
    check_narrowed,
    unobserved_robots,
    with_absolute_names,
    with_names_as_written,
    with_placeholders,
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
    moved_to_enclaves,
    nodes_not_as_observed,
    propose_wildcards,
)
from sros_tool.policy.model import ALLOW, DENY, Enclave, Group, Policy
from sros_tool.policy.node_basics import node_basics
from sros_tool.policy.rights import Right, Rules, policy_rights
from sros_tool.translate import permissions_for
from sros_tool.validity import window
from sros_tool.values import DryRun, FileChanges, Notes, shows
from sros_tool.wording import enumerated, first_few

_MOST_SHOWN = 5
"""Maximum number of robots that a note names."""
_BYTES_PER_LINE = len("<topic></topic>\r\n")


class SizeEstimator:
    """An estimator for the size of signed permissions; it signs with a temporary key.

    The estimate can be wrong by less than 100 bytes, because the lengths of CA names and signatures
    vary.
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
    """Return the size in bytes of a right in large permissions.

    A right takes one line for each DDS topic.  In smaller permissions, a right takes more, because
    the lines are indented.
    """
    names = dds_names(right.right, right.name)
    return sum(_BYTES_PER_LINE + len(name) for name in (*names.publish, *names.subscribe))


# ── of a minimized policy ──────────────────────────────────────────────────────────────────

_SIZE_MARGIN = 256
"""Number of bytes kept free below the size limit, as lengths of CA names and signatures vary."""


class PermissionsBytes(NamedTuple):
    """Size of the signed permissions in bytes."""

    before: int
    """Size before the policy was minimized."""
    after: int
    """Size after the policy was minimized."""
    limit: int = MAX_SIGNED_BYTES
    """Size from which Fast DDS 2.6 and 2.9 refuse permissions."""


@shows(spread=("use",))
class MinimizedEnclave(NamedTuple):
    """An enclave of a minimized policy."""

    use: EnclaveUse
    """The enclave's rights, and the rights that were observed."""
    bytes: PermissionsBytes
    """Size of the signed permissions."""
    proposals: tuple[WildcardProposal, ...]
    """Wildcards that would make the permissions smaller than ``bytes.limit``."""


class PolicyMinimization(NamedTuple):
    """A policy reduced to the observed rights."""

    policy: Path
    """POLICY, as given on the command line."""
    output: Path | None
    """The written file; null if none was written."""
    enclaves: Sequence[MinimizedEnclave]
    """The enclaves of the policy."""
    is_as_observed: bool
    """False if the policy and the observations differ, so that --fail-on difference exits with 1.
    Then the enclaves or the notes name what differs."""
    dry_run: DryRun
    changes: FileChanges
    notes: Notes


class Minimization(NamedTuple):
    """A policy reduced to the observed rights, and the result for each enclave.

    ``document`` is the reduced policy as XML.
    """

    document: bytes
    enclaves: Sequence[MinimizedEnclave]
    notes: Sequence[Note]
    is_as_observed: bool
    """Whether the policy and the observations have the same enclaves, robots and rights."""
    differences: Sequence[str] = ()
    """What differs, as clauses; empty if `is_as_observed`."""


def minimized_policy(
    file: Path,
    observed: Iterable[Path],
    fleet: Fleet | None = None,
    *,
    strict: bool = False,
    output: Path | None = None,
) -> Minimization:
    """Return the policy in a file without the rights that were never observed.

    Args:
        file: the policy.
        observed: policies or permissions with the observed rights.
        fleet: the robots for which placeholders of the policies stand.  A right that was observed
            on one robot stays for all robots; sizes are computed for the robot with the longest
            path.
        strict: remove rights that were not observed even if every node needs them.
        output: the file to which the caller will write the policy.

    Raises:
        PolicyError: a policy cannot be read, or would change by being written.
    """
    policy = read_policy(file, placeholders=fleet is not None)
    sources = [load_rights(path, fleet) for path in observed]
    used = frozenset(right for source in sources for right in source.rights)
    notes = [note for source in sources for note in source.notes]
    policies = [source.policy for source in sources if source.policy]
    robots = FleetPolicy(policy, fleet) if fleet else None
    gaps: list[Note] = []
    if robots:
        observed_rights = with_placeholders(robots, used)
        gaps += _robot_notes(unobserved_robots(robots, used))
    else:
        moved = [moved_to_enclaves(of_source, policy.nodes()) for of_source in policies]
        policies = [of_source for of_source, _ in moved]
        of_documents = (source.rights for source in sources if not source.policy)
        observed_rights = frozenset().union(*of_documents, *map(policy_rights, policies))
        for path, homes in sorted({k: v for _, moves in moved for k, v in moves.items()}.items()):
            (gaps if len({*homes.values()}) > 1 else notes).append(_note_on_moved(path, homes))
    stated = with_absolute_names(policy)
    result = minimize(stated, observed_rights, () if strict else _node_basics())
    if robots:
        check_narrowed(robots, result, used)
    gaps += _scope_notes(policy, result, observed_rights, () if robots else policies)
    if not robots:
        gaps += _node_notes(stated, policies, result, strict=strict)
    narrowed = with_names_as_written(result.policy)
    document = checked_text(narrowed, output, "narrowed", placeholders=fleet is not None)
    enclaves = _measured_enclaves(stated, result, observed_rights, fleet)
    differences = [*_differences(result, gaps)]
    return Minimization(document, enclaves, [*notes, *gaps], not differences, differences)


_DIFFERENCES = {
    "minimize.divided-process": "nodes of one process that the policy has in several enclaves",
    "minimize.enclave-never-observed": "enclaves that were never observed",
    "minimize.enclave-not-in-policy": "enclaves that the policy lacks",
    "minimize.node-differs": "the rights of a node",
    "minimize.node-never-observed": "a node that was never observed",
    "minimize.observed-denial": "a DENY of an observed file",
    "minimize.robot-never-observed": "an enclave that was not observed for every robot",
}
"""What differs, for each note on a difference."""


def _differences(result: MinimizedPolicy, gaps: Iterable[Note]) -> Iterator[str]:
    """Yield what differs, as clauses; ``gaps`` are notes on differences."""
    changed = [use.enclave for use in result.uses if use.observed_at_all and use.differing()]
    if changed:
        yield f"the rights of {first_few(changed, _MOST_SHOWN)}"
    for id_ in dict.fromkeys(note.id for note in gaps):
        yield f"{_DIFFERENCES[id_]} (note {id_})"


def _note_on_moved(path: str, homes: Mapping[str, str]) -> Note:
    """Return a note on an observed enclave; ``homes`` are the enclaves of its nodes in the policy.

    The policy may have the nodes in several enclaves.
    """
    nodes = f"the node{'s' * (len(homes) > 1)} {enumerated(list(homes))}"
    places = sorted({*homes.values()})
    if len(places) == 1:
        text = (
            f"The rights observed in enclave {path} count for {places[0]}, because the policy has "
            f"{nodes} there."
        )
        return Note("minimize.enclave-of-node", text)
    text = (
        f"{nodes} were observed in one process, but the policy has them in {enumerated(places)}. "
        "A process runs in only one enclave, so this is a difference, even if the rights of each "
        "node are those of its enclave. If these nodes always run in one process, put them into "
        "one enclave (`sros merge_policy EMPTY POLICY --enclave ENCLAVE`, with --node for each), "
        "and use the result as POLICY. Otherwise, observe them in a process for each enclave."
    )
    return Note("minimize.divided-process", text)


def _node_basics() -> Sequence[Group]:
    """Return the rights that every node needs, as groups of a profile."""
    profiles = (profile for enclave in node_basics().enclaves for profile in enclave.all_profiles())
    return [group for profile in profiles for group in profile.groups]


def _node_notes(
    policy: Policy, observed: Iterable[Policy], result: MinimizedPolicy, *, strict: bool
) -> Iterator[Note]:
    """Yield notes on nodes whose rights in the policy differ from the observed rights.

    Differences that the comparison of the whole enclave shows are left out.
    """
    of_enclaves = {use.enclave: set(use.differing()) for use in result.uses}
    differing = nodes_not_as_observed(policy, observed, () if strict else _node_basics())
    for path, nodes in differing.items():
        shown = of_enclaves.get(path, set())
        for use in nodes:
            if not use.observed_at_all:
                yield Note(
                    "minimize.node-never-observed",
                    f"the node {use.enclave} of enclave {path} was never observed.",
                )
                continue
            lacking = {right._replace(enclave=path) for right in use.not_allowed} - shown
            unused = {right._replace(enclave=path) for right in use.differing()} - shown - lacking
            for text, rights in (
                ("has rights that the node never used, or used only in part", unused),
                ("lacks rights that the node used", lacking),
            ):
                if rights:
                    names = first_few(sorted(right.describe() for right in rights), _MOST_SHOWN)
                    yield Note(
                        "minimize.node-differs",
                        f"the profile of the node {use.enclave} {text}: {names}. The comparison of "
                        f"enclave {path} does not show this, because of the enclave's other nodes.",
                    )


def _robot_notes(unobserved: Mapping[str, Sequence[str]]) -> Iterator[Note]:
    for path, robots in unobserved.items():
        text = (
            f"{path} was never observed for {first_few(robots, _MOST_SHOWN)}: rights that only "
            f"{'this robot uses' if len(robots) == 1 else 'these robots use'} are removed, too."
        )
        yield Note("minimize.robot-never-observed", text)


def _scope_notes(
    policy: Policy, result: MinimizedPolicy, observed: Set[Right], sources: Sequence[Policy]
) -> Iterator[Note]:
    """Yield notes on what only the policy or only the observations have.

    ``sources`` are the observed policies, for the names of nodes.
    """
    unseen = [use.enclave for use in result.uses if not use.observed_at_all]
    if unseen:
        text = f"these enclaves were never observed, so they do not change: {', '.join(unseen)}."
        yield Note("minimize.enclave-never-observed", text)
    unknown = sorted(
        {right.enclave for right in observed} - {enclave.path for enclave in policy.enclaves}
    )
    moved = _enclaves_of_moved_nodes(policy, sources, unknown)
    for (ns, namespace), paths in moved.items():
        text = (
            f"these enclaves were observed, but the policy lacks them: {', '.join(paths)}. It has "
            f"nodes of these names in the namespace {ns}. If they are the same nodes, first put "
            f"them into {namespace} with `sros merge_policy EMPTY POLICY --namespace {namespace}` "
            "(EMPTY is a policy without enclaves), and use the result as POLICY."
        )
        yield Note("minimize.enclave-not-in-policy", text)
    of_moved = {path for paths in moved.values() for path in paths}
    if unknown := [path for path in unknown if path not in of_moved]:
        text = (
            f"these enclaves were observed, but the policy lacks them: {', '.join(unknown)}. If "
            "the policy has their nodes in another enclave, write that enclave into path= of the "
            "observed file. If it has them in several enclaves, write the name of one node there."
        )
        yield Note("minimize.enclave-not-in-policy", text)
    rules, stated = Rules(observed), Rules(policy_rights(policy))
    denied = [
        f"{right}"
        for right in sorted(observed)
        if right.qualifier is DENY
        and rules.overlaps(right._replace(qualifier=ALLOW))
        and not stated.cover(right)
    ]
    if denied:
        text = (
            "rights that an observed file allows count as used, even if the file also denies them: "
            f"{first_few(denied, _MOST_SHOWN)}."
        )
        yield Note("minimize.observed-denial", text)


def _enclaves_of_moved_nodes(
    policy: Policy, observed: Sequence[Policy], unknown: Iterable[str]
) -> dict[tuple[str, str], list[str]]:
    """Return the ``unknown`` enclaves whose nodes ``policy`` has, but outside of a namespace.

    The keys have the namespace of the nodes in the policy, and the one to put them into. A node of
    the policy that was observed under its own name is another instance, and does not count.
    """
    seen = {node for each in observed for nodes in each.nodes().values() for node in nodes}
    stated = {node for nodes in policy.nodes().values() for node in nodes}
    found: dict[tuple[str, str], list[str]] = {}
    for path in unknown:
        nodes = {node for each in observed for node in each.nodes().get(path, ())}
        pairs = (
            (other.rpartition("/")[0] or "/", node.removesuffix(other))
            for node in sorted(nodes - stated)
            for other in sorted(stated - seen, key=len, reverse=True)
            if node.endswith(other)
        )
        if not nodes & stated and (pair := next(pairs, None)):
            found.setdefault(pair, []).append(path)
    return found


def _measured_enclaves(
    policy: Policy, result: MinimizedPolicy, observed: Set[Right], fleet: Fleet | None
) -> list[MinimizedEnclave]:
    """Return the enclaves of a minimized policy with their sizes."""
    estimator = SizeEstimator()
    enclaves = []
    for before, after, use in zip(
        policy.enclaves, result.policy.enclaves, result.uses, strict=True
    ):
        was, now = (Policy((enclave,)) for enclave in (before, after))
        size = estimator.signed_bytes(_longest_enclave(was, fleet))
        # Without this, another signature of equal permissions could show another size.
        if policy_rights(was) == policy_rights(now):
            sizes = PermissionsBytes(size, size)
        else:
            sizes = PermissionsBytes(size, estimator.signed_bytes(_longest_enclave(now, fleet)))
        proposals: tuple[WildcardProposal, ...] = ()
        if sizes.after > MAX_SIGNED_BYTES - _SIZE_MARGIN:
            proposals = propose_wildcards(
                after.path,
                policy_rights(result.policy),
                policy_rights(policy) | observed,
                needed=sizes.after - MAX_SIGNED_BYTES + _SIZE_MARGIN,
                size=right_bytes,
            )
        enclaves.append(MinimizedEnclave(use, sizes, proposals))
    return enclaves


def _longest_enclave(policy: Policy, fleet: Fleet | None) -> Enclave:
    """Return the only enclave of a policy, expanded for the robot with the longest enclave path."""
    robots = FleetPolicy(with_names_as_written(policy), fleet) if fleet else None
    return robots[max(robots, key=len)] if robots else policy.enclaves[0]
