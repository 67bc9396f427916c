"""What escapes the earlier requirements by a change.

Nodes leave the enclaves that a requirement restricts, enclaves gain access by an exception for any
package, a name loses its other side, its users get a new name, or a robot moves to another
namespace.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from sros_tool.checks.kind import Finding
from sros_tool.checks.requirements import DROPPED, VIOLATED
from sros_tool.errors import DocumentError
from sros_tool.fleet.robots import Fleet
from sros_tool.names import expand, is_expression
from sros_tool.policy.model import ALLOW, PEER_RIGHT, Enclave
from sros_tool.policy.patterns import Names, common_name, covers, overlap
from sros_tool.policy.rights import (
    KIND_OF,
    NodeName,
    Right,
    RightsDifference,
    goal_right,
    is_of_every_node,
    join_actions,
    nodes_of,
    parts,
    rights_without_counterpart,
    split_actions,
)
from sros_tool.proof.decide import (
    patterns_of_any_package,
    restricted_enclaves,
    rights_that_need_a_peer,
)
from sros_tool.proof.findings import decide_all, requirement_findings
from sros_tool.proof.requirements import (
    AtMost,
    Must,
    Nobody,
    NotBoth,
    NothingBut,
    Only,
    Requirement,
    RightNames,
    Widest,
    dropped_requirements,
    enclaves_of,
    names_demanded_by,
    names_of,
    patterns_of_enclaves,
    similarity_to,
)
from sros_tool.proof.sources import AccessSource
from sros_tool.proof.system import System
from sros_tool.wording import first_few

MOST_NAMESPACES = 20
"""Number of namespaces in which a review tries requirements."""


@dataclass(frozen=True, slots=True)
class RobotMoves:
    """The robots whose namespaces HEAD changes.

    ``namespaces`` maps their old to their new namespaces; ``fleet`` is the fleet of BASE with the
    new namespaces.  ``clauses`` say why a requirement does not follow its robot; ``followed`` maps
    requirements that do to what they were.
    """

    namespaces: Mapping[str, str] = field(default_factory=dict)
    fleet: Fleet | None = None
    clauses: dict[Requirement, str] = field(default_factory=dict)
    followed: dict[Requirement, Requirement] = field(default_factory=dict)

    @classmethod
    def between(cls, before: Fleet | None, after: Fleet | None) -> RobotMoves:
        """Return the moves from one fleet to another; none if they contradict each other."""
        if before is None or after is None:
            return cls()
        robots = [
            robot._replace(namespace=after.robots.get(robot.name, robot).namespace)
            for robot in before.robots.values()
        ]
        pairs = [(before.robots[robot.name].namespace, robot.namespace) for robot in robots]
        moved = {old: new for old, new in pairs if old != new}
        is_clear = all(moved.get(old, old) == new for old, new in pairs)
        return cls(moved, Fleet.of(robots, before.groups)) if is_clear else cls()

    def new_name(self, name: str) -> str:
        """Return a name or namespace of BASE as it is after the move of its robot."""
        old = name
        while old:
            if old in self.namespaces:
                return self.namespaces[old].rstrip("/") + name.removeprefix(old) or "/"
            old = old.rpartition("/")[0]
        return self.namespaces.get("/", "") + name

    def before(self, requirement: Requirement) -> Requirement:
        """Return a requirement as BASE has it."""
        return self.followed.get(requirement, requirement)

    def follow(
        self,
        earlier: Sequence[Requirement],
        moved: Sequence[Requirement],
        requirements: Iterable[Requirement],
        system: System,
    ) -> list[Requirement]:
        """Return ``earlier``, with the requirements that follow their robots as in ``moved``.

        A requirement of BASE that HEAD does not demand follows its robot, unless HEAD still has
        rights to the names, or the enclaves, of the robot's old namespace.
        """
        if len(earlier) != len(moved):
            return [*earlier]
        dropped = {gone.requirement for gone in dropped_requirements(earlier, requirements)}
        result: list[Requirement] = []
        for old, new in zip(earlier, moved, strict=True):
            clause = _old_names_clause(old, new, system) if old in dropped and old != new else ""
            if clause:
                self.clauses[old] = (
                    f"; its robot has another namespace now, but {clause}. Remove this from the "
                    "policy, or demand the same for the old name"
                )
            follows = old in dropped and not clause
            if follows:
                self.followed[new] = old
            result.append(new if follows else old)
        return result


def _old_names_clause(old: Requirement, new: Requirement, system: System) -> str:
    """Return a clause if something in HEAD has a name that only ``old`` has, or ""."""
    enclaves = {*enclaves_of(old)}.difference(enclaves_of(new))
    for enclave in sorted({right.enclave for right in system.rights}) if enclaves else ():
        if any(overlap(enclave, name) for name in enclaves):
            return f"the enclave {enclave} still exists"
    if isinstance(old, Must | NothingBut | Widest):  # these do not restrict who may use a name
        return ""
    names = {*names_of(old)}.difference(names_of(new))
    stated = (
        right
        for right in system.rights
        if right.qualifier is ALLOW and not is_expression(right.name)
        if any(overlap(right.name, name) for name in names)
    )
    if right := min(stated, default=None):
        return f"{right.enclave} may still {right.right} {right.name}"
    if isinstance(old, Only | Nobody | AtMost | NotBoth):
        for finding in requirement_findings([old], system):
            if finding.kind is VIOLATED:
                return f"{finding.subject} {finding.text}"
    return ""


def lost_restriction_findings(
    earlier: Sequence[Requirement],
    requirements: Sequence[Requirement],
    before: AccessSource,
    after: AccessSource,
    robot_moves: RobotMoves,
) -> Iterator[Finding]:
    """Yield a finding for each node that moves to an enclave that a requirement does not restrict.

    Before the move, the requirement and a similar one of ``earlier`` restricted its enclave.  A
    node in the old namespace of a robot may follow the robot, or keep its name: both count.
    """
    new_enclaves = _enclaves_by_node(after.enclaves.values())
    moves = [
        (node, old - new_enclaves[node], new_enclaves[node] - old)
        for follow in (robot_moves.new_name, str)
        for node, old in _enclaves_by_node(before.enclaves.values(), follow).items()
        if new_enclaves.get(node, old) - old
    ]
    new_paths = {path: robot_moves.new_name(path) for path in before.enclaves}
    similar_requirements = similarity_to(earlier)
    for requirement in requirements if moves else ():
        reported: dict[NodeName, set[str]] = defaultdict(set)
        # The namespaces of a fleet are known, and its policies name the enclaves in them.
        for ns in ("/",) if after.fleet else namespaces_of_patterns(requirement):
            now_restricted = restricted_enclaves(requirement, after.enclaves, ns)
            was_restricted = [
                {path for path, new in new_paths.items() if not restricted.isdisjoint((path, new))}
                for restricted in restricted_enclaves(
                    requirement, {*new_paths, *new_paths.values()}, ns
                )
            ]
            left = [
                (node, old & was, at, new - now)
                for at, (was, now) in enumerate(zip(was_restricted, now_restricted, strict=True))
                for node, old, new in moves
                if old & was and new - now
            ]
            required = [
                restricted_enclaves(robot_moves.before(similar), before.enclaves, ns)
                for similar in (similar_requirements(requirement) if left else ())
            ]
            left = [move for move in left if any(move[1] & was[move[2]] for was in required)]
            for node, _, _, outside in left:
                if outside <= reported[node]:
                    continue
                reported[node] |= outside
                place = requirement.source
                name, to = expand("~", *node), first_few(sorted(outside), 3)
                where = "enclave" if len(outside) == 1 else "enclaves"
                text = f"node {name} moves to {where} {to}, where the requirement does not apply"
                text += f" for users in namespace {ns}" if ns != "/" else ""
                remedy = "Let the requirement apply to the enclave, or approve this in the review."
                yield DROPPED.found(str(requirement), text, place.file, place.line, remedy)


def access_by_name_findings(
    earlier: Sequence[Requirement],
    requirements: Sequence[Requirement],
    before: AccessSource,
    after: AccessSource,
    system: System,
) -> Iterator[Finding]:
    """Yield a finding for each enclave that gains access only by `patterns_of_any_package`.

    The owner of the requirement has to see such an enclave.
    """
    similar_requirements = similarity_to(requirements)
    old, new = split_actions(before.rights), split_actions(after.rights)
    gained = {right for right in old ^ new if _is_gained(right, new)}
    # As they were before: the change may also name its own enclaves in them.
    whole = {
        of_name: requirement
        for requirement in earlier
        if isinstance(requirement, Only)
        and patterns_of_any_package(requirement)
        and similar_requirements(requirement)
        for of_name in _of_single_names(_about_rights(replace(requirement, unmoved=()), gained))
    }
    reported: set[tuple[Requirement, str]] = set()
    for requirement, steps in decide_all([*whole], system).by_name:
        wanted = split_actions(
            Right("", ALLOW, right, name) for right, names in requirement.rights for name in names
        )
        for step in steps:
            enclave, patterns = step.use.enclave, patterns_of_any_package(whole[requirement])
            if enclave in patterns and enclave in before.enclaves:
                continue  # an earlier change named this enclave of the package
            is_new = any(
                own.enclave == enclave
                and own.right == right.right
                and overlap(own.name, right.name)
                and not _is_allowed(enclave, own, right.name, old)
                for own in gained
                for right in wanted
            )
            if is_new and (whole[requirement], enclave) not in reported:
                reported.add((whole[requirement], enclave))
                text = step.text()
                example = Right("", ALLOW, step.use.right, step.use.name)
                if all(_is_allowed(enclave, of, of.name, old) for of in split_actions([example])):
                    ((word, (name,)),) = requirement.rights
                    text = f"{enclave} may {word} more names that match {name}"
                remedy = "Approve this in the review."
                if enclave in patterns:
                    text += (
                        f": this enclave is new, and the requirement allows /{enclave} whatever "
                    )
                    text += "package it belongs to"
                else:
                    matching = [name for name in patterns if covers(name, enclave)]
                    written = [f"/{name}" if name[0] == "/" else name for name in matching]
                    text += ": new access, which the requirement allows only by "
                    text += f"{first_few(written, 3)}, which enclaves of any package can match"
                    remedy += " No approval is needed if an earlier change already listed the "
                    remedy += "enclave in the requirement by its own name."
                place = step.source or similar_requirements(whole[requirement])[0].source
                subject = str(whole[requirement])
                yield DROPPED.found(subject, text, place.file, place.line, remedy)


def _of_single_names(requirement: Only) -> Iterator[Only]:
    """Yield the requirement for each of its names alone."""
    for right, names in requirement.rights:
        yield from (replace(requirement, rights=((right, (name,)),)) for name in names)


def _is_allowed(enclave: str, gained: Right, name: str, old: Collection[Right]) -> bool:
    """Return whether ``old`` rights of an enclave give what a gained right gives of ``name``.

    False can be wrong if only several of the old rights together give it.
    """
    known = [of for of in old if (of.enclave, of.right) == (enclave, gained.right)]
    return any(
        of.qualifier is ALLOW and (covers(of.name, name) or covers(of.name, gained.name))
        for of in known
    ) and not any(
        of.qualifier is not ALLOW and overlap(of.name, name) and overlap(of.name, gained.name)
        for of in known
    )


def _about_rights(requirement: Only, rights: Iterable[Right]) -> Only:
    """Return a requirement without the names that ``rights`` are not about."""
    known = Names.by_key((right.right, right.name) for right in rights)

    def is_known(word: str, name: str) -> bool:
        own = parts(Right("", ALLOW, word, name))
        return any(part.right in known and known[part.right].overlaps(part.name) for part in own)

    left = (
        (word, tuple(name for name in names if is_known(word, name)))
        for word, names in requirement.rights
    )
    return replace(requirement, rights=tuple((word, names) for word, names in left if names))


_GONE_REMEDY = (
    "If the name was changed, change it in the requirement, too. In any case, a reviewer has to "
    "approve this (`--dropped-requirements allow`)."
)


def rights_with_new_peers(before: Collection[Right], after: Collection[Right]) -> set[str]:
    """Return the rights, such as publish, whose names a change may rename.

    The change gives the other side, here subscribe, to more names.
    """
    first, second = split_actions(before), split_actions(after)
    gained = {right.right for right in first ^ second if _is_gained(right, second)}
    goals = {right: goal_right(Right("", ALLOW, right, "")).right for right in PEER_RIGHT}
    return {right for right, goal in goals.items() if PEER_RIGHT[goal] in gained}


def unanswered_requirement_findings(
    earlier: Sequence[Requirement],
    requirements: Sequence[Requirement],
    before: Collection[Right],
    after: Collection[Right],
) -> Iterator[Finding]:
    """Yield a finding for each kept requirement about a name whose other side HEAD removes.

    For example, HEAD renames a service at its server, and the requirement has the old name. A
    `Nobody` that replaces a limit counts only if HEAD adds such an other side under another name.
    Wildcards that match the name are no other side, such as the wildcard of a recorder, unless
    HEAD writes a wildcard in place of a removed right.
    """
    first, second = split_actions(before), split_actions(after)
    removed, added = first - second, second - first
    changed_enclaves = {(right.enclave, right.right) for right in removed}
    changed_names = {(right.right, right.name) for right in removed}
    replacing = {
        right
        for right in added
        if (right.enclave, right.right) in changed_enclaves
        or (right.right, right.name) in changed_names
    }

    def without_wildcards(rights: Iterable[Right], counting: Collection[Right]) -> set[Right]:
        return {
            right
            for right in rights
            if right.qualifier is not ALLOW or not is_expression(right.name) or right in counting
        }

    similar_requirements = similarity_to(earlier)
    compared = requirements if removed or added else ()
    renamed = rights_with_new_peers(before, after)

    def peers_of(requirement: Requirement) -> dict[Right, Right]:
        return {
            goal_right(Right("", ALLOW, right, name)): Right("", ALLOW, PEER_RIGHT[right], name)
            for right, name in rights_that_need_a_peer(requirement)
        }

    asked = {of: peers_of(of) for of in compared if similar_requirements(of)}
    asked_before = {of: peers_of(of) for of in earlier} if compared else {}
    difference = RightsDifference(tuple(removed), tuple(added), {})
    candidates = {right for peers in (*asked.values(), *asked_before.values()) for right in peers}
    unanswered = {
        *rights_without_counterpart(
            without_wildcards(first, removed),
            without_wildcards(second, replacing),
            difference,
            candidates,
        )
    }
    # HEAD may demand the same about wider names, or forbid the names.
    for old, peers in asked_before.items():
        lost = {right: peer for right, peer in peers.items() if right in unanswered}
        for requirement in compared if lost else ():
            names = names_demanded_by([requirement], old)
            asked.setdefault(requirement, {}).update(
                (right, peer)
                for right, peer in lost.items()
                if peer.name in names
                if not isinstance(requirement, Nobody) or right.right in renamed
            )
    for requirement, peers in asked.items():
        lost_texts = [
            f"{peer.right} {peer.kind.removesuffix('s')} {peer.name}"
            for right, peer in peers.items()
            if right in unanswered
        ]
        if lost_texts:
            place = requirement.source
            text = f"HEAD removes the last stated right to {first_few(lost_texts, 3)}, "
            if isinstance(requirement, Nobody):
                text += "perhaps because of a new name, which the requirement does not restrict"
            else:
                text += "without which the requirement protects nothing"
            yield DROPPED.found(str(requirement), text, place.file, place.line, _GONE_REMEDY)


def renamed_requirement_findings(
    earlier: Sequence[Requirement],
    requirements: Sequence[Requirement],
    before: Collection[Right],
    after: Collection[Right],
) -> Iterator[Finding]:
    """Yield a finding for each kept limit whose users HEAD probably gives a new name.

    The requirement still protects the earlier name, which keeps its other side: for example, HEAD
    renames a topic, and one subscriber keeps the earlier name.
    """
    first, second = join_actions(before), join_actions(after)
    stated = {(right.right, right.name) for right in second if right.qualifier is ALLOW}

    new_names: dict[tuple[str, str], set[str]] = defaultdict(set)
    for right in second - first:
        if right.qualifier is ALLOW and not is_of_every_node(right.name):
            new_names[right.enclave, right.right].add(right.name)
    renamed: dict[tuple[str, str], set[str]] = defaultdict(set)
    for right in first - second:
        is_gone = right.qualifier is ALLOW and (right.right, right.name) not in stated
        if is_gone and (PEER_RIGHT[right.right], right.name) in stated:
            renamed[right.right, right.name] |= new_names[right.enclave, right.right]
    similar_requirements = similarity_to(earlier)
    for requirement in requirements if any(renamed.values()) else ():
        if not isinstance(requirement, Only | AtMost | NotBoth):
            continue
        lost = {
            f"{right} {KIND_OF[right].removesuffix('s')} {name} (perhaps now {new})": None
            for right, name in rights_that_need_a_peer(requirement)
            for new in sorted(renamed.get((right, name), ()))
            if dropped_requirements([_with_new_name(requirement, right, name, new)], requirements)
        }
        if lost and similar_requirements(requirement):
            place = requirement.source
            text = f"HEAD removes the last stated right to {first_few([*lost], 3)}, "
            text += "and the requirement does not restrict the new name"
            yield DROPPED.found(str(requirement), text, place.file, place.line, _GONE_REMEDY)


def _with_new_name(
    requirement: Only | AtMost | NotBoth, right: str, name: str, new: str
) -> Requirement:
    """Return the same requirement about the ``new`` name instead of ``name``."""

    def renamed(rights: RightNames) -> RightNames:
        return tuple(
            (word, tuple(new if (word, of) == (right, name) else of for of in names))
            for word, names in rights
        )

    if isinstance(requirement, NotBoth):
        first, second = renamed(requirement.first), renamed(requirement.second)
        return replace(requirement, first=first, second=second)
    return replace(requirement, rights=renamed(requirement.rights))


def _is_gained(right: Right, later: Collection[Right]) -> bool:
    """Return whether a changed right gives access: an ALLOW in ``later``, or a lost DENY."""
    return (right.qualifier is ALLOW) == (right in later)


def namespaces_of_patterns(requirement: Requirement) -> list[str]:
    """Return namespaces in which a requirement may apply to other enclaves than in ``/``.

    They are in the patterns of enclaves that do not move with the namespace, and follow ``/``.

    Raises:
        DocumentError: there are more namespaces than a review tries.
    """
    namespaces = dict.fromkeys(["/"])
    if requirement.is_relative and requirement.elsewhere:
        moved = patterns_of_enclaves(requirement.elsewhere)
        fixed = (name for name in patterns_of_enclaves(requirement) if name in moved)
        namespaces |= dict.fromkeys(namespaces_in(fixed))
    if len(namespaces) > MOST_NAMESPACES + 1:
        raise DocumentError(
            f"the enclaves of a requirement name more than {MOST_NAMESPACES} namespaces: "
            f"{requirement}",
            "So it is not known whether the requirement holds in each of them.",
            "Name fewer namespaces there, or name the namespaces of the robots with --namespace.",
        )
    return [*namespaces]


def namespaces_in(names: Iterable[str]) -> Iterator[str]:
    """Yield the namespaces of names, and of a name that matches each expression."""
    for expression in names:
        parts = (common_name([expression, "/*/*"]) or "").split("/")[:-1]
        yield from ("/".join(parts[:end]) for end in range(2, len(parts) + 1))


def _enclaves_by_node(
    enclaves: Iterable[Enclave], new_name: Callable[[str], str] = str
) -> dict[NodeName, set[str]]:
    nodes: dict[NodeName, set[str]] = {}
    for enclave in enclaves:
        for node in nodes_of(enclave):
            node = node._replace(ns=new_name(node.ns))
            nodes.setdefault(node, set()).add(enclave.path)
    return nodes
