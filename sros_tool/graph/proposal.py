"""Turns what was denied in logs into a policy for a person to accept."""

from __future__ import annotations

from collections.abc import Sequence

from sros_tool.errors import UsageError
from sros_tool.graph.denials import Denial, Proposal
from sros_tool.graph.learn import Learned, LearnedProfile, groups_of
from sros_tool.names import check_enclave_name
from sros_tool.notes import Note
from sros_tool.policy.model import Policy

ANY_NODE = ("/", "*")
"""The namespace and node of a profile that is not about a particular node."""


_SEVERAL = Note(
    "log.several-enclaves",
    "the log names several enclaves, and each denial counts for the one that its process named "
    "last; check that processes without a label of their own did not write at the same time",
)


def as_learned(
    proposal: Proposal, enclave: str, node: tuple[str, str] | None, policy: Policy | None
) -> Learned:
    """The proposed rights as profiles.

    ``enclave`` is for denials of which the log does not name it, ``node`` (namespace and name) the
    profile; without it, the only profile of that enclave in ``policy``, or else one for any node:
    DDS asks for the enclave alone.  Raises `UsageError` where an enclave is needed.
    """
    profiles = []
    for named, rights in sorted(proposal.rights.items()):
        if not (named or enclave):
            raise UsageError(
                "the log does not say in which enclave the node ran",
                "It would, with the line 'Found security directory' of rcl.",
                "Name it with --enclave.",
            )
        path = check_enclave_name(named or enclave)
        ns, name = node or _only_profile(policy, path) or ANY_NODE
        profiles.append(LearnedProfile(path, ns, name, rights, (), groups_of(rights, ns, name)))
    return Learned(_joined(profiles), _notes(proposal))


def _joined(profiles: Sequence[LearnedProfile]) -> tuple[LearnedProfile, ...]:
    """One profile for each place: the log may name an enclave that is also given."""
    found: dict[tuple[str, str, str], LearnedProfile] = {}
    for each in profiles:
        place = each.enclave, each.ns, each.node
        rights = each.rights | (found[place].rights if place in found else frozenset())
        found[place] = LearnedProfile(*place, rights, (), groups_of(rights, each.ns, each.node))
    return tuple(found[place] for place in sorted(found))


def _only_profile(policy: Policy | None, path: str) -> tuple[str, str] | None:
    enclave = policy.enclave(path) if policy else None
    places = {(each.ns, each.node) for each in enclave.all_profiles()} if enclave else set()
    return places.pop() if len(places) == 1 else None


def _notes(proposal: Proposal) -> tuple[Note, ...]:
    texts = {
        "log.unclear": (
            proposal.unclear,
            "not proposed, as the log does not tell whether these were to be published or "
            "subscribed: {}",
        ),
        "log.denied-by-rule": (
            proposal.by_rule,
            "not proposed, as a DENY in the policy refuses these, and allowing them would not "
            "help: {}",
        ),
        "log.of-a-peer": (
            proposal.remote,
            "not proposed, as these were denied to a peer, whose enclave the log does not name: {}",
        ),
        "log.no-ros-name": (
            proposal.foreign,
            "not proposed, as a policy has no words for these topics: {}",
        ),
    }
    several = len(proposal.rights) > 1
    return (_SEVERAL,) * several + tuple(
        Note(name, text.format(", ".join(dict.fromkeys(map(_shown, denials)))))
        for name, (denials, text) in texts.items()
        if denials
    )


def _shown(denial: Denial) -> str:
    return f"{denial.direction} {denial.topic}".strip() + (
        f" in {denial.enclave}" if denial.enclave else ""
    )
