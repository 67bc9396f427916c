"""Turns what was denied in logs into a policy for a person to accept."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from sros_tool.errors import UsageError
from sros_tool.graph.common import CommonParts
from sros_tool.graph.denials import Denial, Proposal, nodes_served
from sros_tool.graph.fold import Right
from sros_tool.graph.learn import Learned, LearnedProfile, groups_of
from sros_tool.names import check_enclave_name, is_expression
from sros_tool.notes import Note
from sros_tool.policy.model import Policy
from sros_tool.policy.patterns import covers
from sros_tool.policy.rights import profile_rights

ANY_NODE = ("/", "*")
"""The namespace and node of a profile that is not about a particular node."""


_OTHER = (
    "not proposed, as these nodes are not in the policy under that name; start them as it says "
    "(--ros-args -r __node:=NAME -r __ns:=NAMESPACE), or, if the node is right, give it a profile "
    "with --node /NAMESPACE/NAME: {}"
)
_WHOLE = (
    "what every node needs is proposed as a whole, rather than one right after each restart, as "
    "the profile has nothing of it: {}"
)
_SEVERAL = Note(
    "log.several-enclaves",
    "the log names several enclaves, and each denial counts for the one that its process named "
    "last; check that processes without a label of their own did not write at the same time",
)


NODE_PARTS = ("common/node.xml", "common/node/parameters.xml")
"""What a node that is denied anything of them most likely lacks as a whole; the widest first."""


def as_learned(
    proposal: Proposal,
    enclave: str,
    node: tuple[str, str] | None,
    policy: Policy | None,
    common: CommonParts | None = None,
) -> Learned:
    """The proposed rights as profiles.

    ``enclave`` is for denials of which the log does not name it, ``node`` (namespace and name) the
    profile; without it, that of the node whose own services were denied, or else the only profile
    of that enclave in ``policy``, or one for any node: DDS asks for the enclave alone.  A node
    that the policy does not have under that name gets nothing, and a note.  With ``common``, a
    node that has nothing of what every node needs gets all of it.  Raises `UsageError` where an
    enclave is needed.
    """
    profiles, others, wholes = [], dict[str, str](), dict[str, str]()
    for path, rights in sorted(_by_enclave(proposal, enclave).items()):
        present = _profiles(policy, path)
        for place, denied in sorted(_by_place(rights, node, present).items()):
            if present and node is None and place not in (ANY_NODE, *present):
                there = ", ".join(sorted(map(_fqn, present)))
                others[_fqn(place)] = f"enclave {path} has {there}"
                continue
            has = present.get(place, frozenset())
            parts = _whole_parts(denied, place, has, common) if common else ()
            given = common.given(parts, *place) if common else frozenset[Right]()
            if parts:
                wholes[_fqn(place)] = ", ".join(parts)
            groups = groups_of(denied - given, *place)
            profiles.append(LearnedProfile(path, *place, denied | given, parts, groups))
    notes = [
        Note(name, text.format("; ".join(f"{who}: {what}" for who, what in found.items())))
        for name, text, found in (
            ("log.other-node", _OTHER, others),
            ("log.common-part", _WHOLE, wholes),
        )
        if found
    ]
    return Learned(tuple(profiles), (*_notes(proposal), *notes))


def _by_enclave(proposal: Proposal, enclave: str) -> dict[str, frozenset[Right]]:
    """The rights by enclave: the log may name an enclave that is also given."""
    found: dict[str, frozenset[Right]] = {}
    for named, rights in proposal.rights.items():
        if not (named or enclave):
            raise UsageError(
                "the log does not say in which enclave the node ran",
                "It would, with the line 'Found security directory' of rcl.",
                "Name it with --enclave.",
            )
        path = check_enclave_name(named or enclave)
        found[path] = found.get(path, frozenset()) | rights
    return found


def _by_place(
    rights: frozenset[Right],
    node: tuple[str, str] | None,
    present: Mapping[tuple[str, str], frozenset[Right]],
) -> dict[tuple[str, str], frozenset[Right]]:
    """The rights by the namespace and name of the profile that they belong to."""
    if node is not None:
        return {node: rights}
    own = nodes_served((each.right, each.name) for each in rights)
    found: dict[tuple[str, str], set[Right]] = {}
    (only,) = present if len(present) == 1 else (None,)
    (one,) = own if len(own) == 1 else (None,)
    rest = only or (_place(one, present) if one and not present else ANY_NODE)
    for each in rights:
        served = nodes_served([(each.right, each.name)])
        found.setdefault(_place(served[0], present) if served else rest, set()).add(each)
    return {place: frozenset(some) for place, some in found.items()}


def _place(fqn: str, present: Iterable[tuple[str, str]]) -> tuple[str, str]:
    """The profile of a node: the one that is there for it, perhaps with a wildcard."""
    ns, _, name = fqn.rpartition("/")
    return next((each for each in present if covers(_fqn(each), fqn)), (ns or "/", name))


def _fqn(place: tuple[str, str]) -> str:
    return f"{place[0].rstrip('/')}/{place[1]}"


def _whole_parts(
    denied: frozenset[Right],
    place: tuple[str, str],
    has: frozenset[Right],
    common: CommonParts,
) -> tuple[str, ...]:
    """The part of which something was denied to a node that has nothing of it."""
    if is_expression(place[1]):
        return ()
    for part in NODE_PARTS:
        if part in common.rights:
            given = common.given([part], *place)
            if given & denied and not given & has:
                return (part,)
    return ()


def _profiles(policy: Policy | None, path: str) -> dict[tuple[str, str], frozenset[Right]]:
    """What each profile of an enclave says, by its namespace and node."""
    enclave = policy.enclave(path) if policy else None
    found: dict[tuple[str, str], frozenset[Right]] = {}
    for each in enclave.all_profiles() if enclave else ():
        rights = frozenset(Right(r.right, r.name) for r in profile_rights(path, each))
        found[each.ns, each.node] = found.get((each.ns, each.node), frozenset()) | rights
    return found


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
