"""The rights of a closed robot: who may use a name, and requirements that added rights break."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.close.robot import MOST_NAMES, REQUIREMENTS, TEMPLATE
from sros_tool.errors import SrosError
from sros_tool.files import policies_dir
from sros_tool.graph.learn import common_parts
from sros_tool.keystore.layout import CLOSED_POLICY
from sros_tool.keystore.template import load_template
from sros_tool.names import PARAMETER_SERVICES, is_expression, moves_robot
from sros_tool.policy.document import read_policy
from sros_tool.policy.merge import merge_into
from sros_tool.policy.model import ALLOW, DENY, RIGHTS, Policy
from sros_tool.policy.node_basics import NodeRights
from sros_tool.policy.patterns import overlap
from sros_tool.policy.rights import Right, Rules, is_of_one_node, policy_rights
from sros_tool.proof.findings import decide_all
from sros_tool.proof.requirements import Requirement, RightsRequirement, read_requirements
from sros_tool.proof.suggestions import names_to_protect, suggest
from sros_tool.proof.system import policy_system
from sros_tool.wording import counted, first_few

_NODE_PARTS = ("common/node.xml", "common/rclcpp_node.xml", "common/rclpy_node.xml")
_MOST_LINES = 20
"""Number of lines that are shown; the others are counted."""
_KINDS_IN_ORDER = ("actions", "topics", "services")
"""The kinds of names, with those first that do most."""


def access_lines(policy: Policy, folder: Path, others: frozenset[Right] = frozenset()) -> list[str]:
    """Return a line for each name that somebody may use: its senders and its receivers.

    The parameter services of a node are one line if the same enclaves may use them.
    ``folder`` is the folder of the closed robot, and ``others`` are the signed rights of enclaves
    that the policy does not have.  Names are left out
    if they are only used as every node uses them (the common parts).  Names that move the robot
    come first, with all of their senders, and then names that nobody may send or serve.
    """
    sides = _users_by_name(policy, folder, others)
    names_in_order = sorted(
        sides,
        key=lambda use: (
            not moves_robot(use[1]),
            not _waits_in_vain(use[0], use[1], sides[use]),
            not all(sides[use]),
            _KINDS_IN_ORDER.index(use[0]),
            use[1],
        ),
    )
    names_by_line: dict[tuple[str, str], list[str]] = {}
    for kind, name in names_in_order:
        node, _, last = name.rpartition("/")
        is_parameter_service = kind == "services" and node and last in PARAMETER_SERVICES
        subject = node if is_parameter_service else f"{kind.removesuffix('s')} {name}"
        users = " -> ".join(side.text(whole=moves_robot(name)) for side in sides[kind, name])
        names_by_line.setdefault((subject, users), []).append(name)
    lines = [
        f"{_subject_text(subject, names)}: {users}"
        for (subject, users), names in names_by_line.items()
    ]
    surplus = len(lines) - _MOST_LINES
    return [
        *lines[:_MOST_LINES],
        *([f"and {counted(surplus, 'more line')}"] if surplus > 0 else []),
    ]


def _subject_text(subject: str, names: Sequence[str]) -> str:
    """Return the subject of a line; the parameter services of a node are one subject."""
    if not subject.startswith("/"):
        return subject
    return (
        f"service {names[0]}"
        if len(names) == 1
        else f"{len(names)} parameter services of {subject}"
    )


def _waits_in_vain(kind: str, name: str, sides: Sequence[_Users]) -> bool:
    """Return whether enclaves may receive or call a name that nobody may send or serve.

    Such a name is often misspelled.
    """
    sends, receives = sides
    waiting, offering = (receives, sends) if kind == "topics" else (sends, receives)
    return bool(waiting) and not offering and not is_expression(name)


class _Users(NamedTuple):
    """The enclaves that may use a name; ``in_part`` may use only some names of a wildcard.

    ``in_part`` is empty if an enclave may use the whole wildcard.
    """

    enclaves: Sequence[str]
    in_part: Sequence[str]

    def __bool__(self) -> bool:
        return bool(self.enclaves)

    def text(self, *, whole: bool) -> str:
        """Return the enclaves as text, all of them if ``whole``."""
        names = self.enclaves or self.in_part
        if not names:
            return "nobody"
        shown = ", ".join(names) if whole else first_few(names, MOST_NAMES)
        return shown if self.enclaves else f"in part {shown}"


def _users_by_name(
    policy: Policy, folder: Path, others: frozenset[Right]
) -> Mapping[tuple[str, str], Sequence[_Users]]:
    """Map each kind and name to its users: one `_Users` for each right of the kind.

    Ordinary uses are left out.  The arguments are those of `access_lines`.
    """
    rights, of_nodes = policy_rights(policy) | others, NodeRights(others)
    rules, enclaves = Rules(rights), sorted({right.enclave for right in rights})
    allowed = {right for right in rights if right.qualifier is ALLOW}
    ordinary = ordinary_uses(policy, folder)
    ordinary |= {(use.enclave, use.right, use.name) for use in others if of_nodes.needs(use)}
    expressions = {right for right in allowed if is_expression(right.name)}

    def may(enclave: str, right: str, name: str) -> bool:
        if rules.allow(enclave, right, name):
            return True
        # If some names are denied, the wildcard still allows the others.
        is_allowed = Right(enclave, ALLOW, right, name) in expressions
        return is_allowed and not rules.cover(Right(enclave, DENY, right, name))

    def side(right: str, name: str) -> _Users:
        users = [enclave for enclave in enclaves if may(enclave, right, name)]
        in_part = {
            other.enclave
            for other in (allowed if is_expression(name) and not users else ())
            if other.right == right
            and overlap(other.name, name)
            and may(other.enclave, right, other.name)
        }
        return _Users(users, sorted(in_part))

    return {
        (kind, name): [side(right, name) for right in RIGHTS[kind]]
        for kind, name in {
            (right.kind, right.name)
            for right in allowed
            if right.kind in RIGHTS and (right.enclave, right.right, right.name) not in ordinary
        }
    }


def ordinary_uses(policy: Policy, folder: Path) -> set[tuple[str, str, str]]:
    """Return enclave, right and name for the rights that the common parts give to every node."""
    common = common_parts(folder, policies_dir())
    parts = [part for part in _NODE_PARTS if part in common.rights]
    return {
        (enclave.path, right.right, right.name)
        for enclave in policy.enclaves
        for profile in enclave.all_profiles()
        for right in common.included_rights(parts, profile.ns, profile.node)
        if is_of_one_node(right.name)
    }


def requirements_broken_by(folder: Path, addition: str, moment: datetime) -> list[Requirement]:
    """Return the requirements in the ``folder`` of a closed robot that more rights would break.

    ``addition`` is the policy document with these rights.  Empty if the folder has no requirements,
    or the policy with the addition cannot be decided.
    """
    file, path = folder / REQUIREMENTS, folder / CLOSED_POLICY
    if not file.exists():
        return []
    try:
        needed, template = read_requirements(file), load_template(TEMPLATE)
        merged = merge_into(path, read_policy(path, addition.encode())).document

        def broken_requirements(policy: Policy) -> dict[Requirement, None]:
            decided = decide_all(needed, policy_system(policy, Circumstances(moment), template))
            return dict.fromkeys(violation.requirement for violation in decided.violations)

        if after := broken_requirements(read_policy(path, merged)):
            before = broken_requirements(read_policy(path))
            return [requirement for requirement in after if requirement not in before]
    except SrosError:
        pass
    return []


def names_without_requirement(folder: Path, signed: Iterable[Right], moment: datetime) -> list[str]:
    """Return the names in the policy of a closed robot that a requirement can protect only now.

    sros would propose a requirement for such a name now, but not for the ``signed`` rights: for
    example, a topic had a publisher, and now also has a subscriber.  No requirement in the
    ``folder`` names it.  Empty if that cannot be decided.
    """
    policy = read_policy(folder / CLOSED_POLICY)
    stated = _names_in(read_requirements(folder / REQUIREMENTS))
    names = {
        name
        for name in names_to_protect(policy_rights(policy)) - names_to_protect(signed)
        if not any(overlap(name, other) for other in stated)
    }
    if not names:
        return []
    try:
        system = policy_system(policy, Circumstances(moment), load_template(TEMPLATE))
        return sorted(names & _names_in(suggest(system.rights, system.worlds).requirements))
    except SrosError:  # too many wildcards
        return []


def _names_in(requirements: Iterable[Requirement]) -> set[str]:
    return {
        name
        for requirement in requirements
        if isinstance(requirement, RightsRequirement)
        for _, names in requirement.rights
        for name in names
    }
