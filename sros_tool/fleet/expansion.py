"""One policy for many robots, whose placeholders are filled in from a fleet.

Values are filled into the names of a policy that was read, and every name is checked again by the
grammar of a policy, so that no value can add an element, a right or a wildcard.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sros_tool.errors import DocumentError, InvalidNameError, PolicyError, SrosError
from sros_tool.fleet.robots import (
    MAX_ENCLAVES,
    Fleet,
    Robot,
    group_of,
    path_for,
    unrecorded_enclaves,
)
from sros_tool.names import check_enclave_name, check_namespace, expression_problem, is_expression
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import ALLOW, Enclave, Group, Policy, Profile, Source, with_profiles
from sros_tool.policy.patterns import covers
from sros_tool.policy.placeholders import Parts, fill, has_placeholder, parts_of, placeholders_of
from sros_tool.policy.rights import Right, Rules, parts, policy_rights, split_actions
from sros_tool.wording import first_few

if TYPE_CHECKING:
    from sros_tool.policy.minimize import MinimizedPolicy

_MOST_NAMES = 200_000  # per enclave: a signed document cannot have more


class FleetPolicy(Mapping[str, Enclave]):
    """The enclaves of a policy for a fleet, by path; an enclave is expanded when it is read.

    ``fleet`` has the robots.  ``patterns`` are the paths with a placeholder, as `Fleet` has them.
    ``protects`` says whether the policy states the protection of a name.
    """

    def __init__(self, policy: Policy, fleet: Fleet, robots: Collection[str] = ()) -> None:
        """Compute the paths of all enclaves.

        Args:
            policy: a policy that was read with its placeholders.
            fleet: the robots.
            robots: keep only the enclaves of these robots; empty keeps all enclaves.

        Raises:
            PolicyError: a path is not valid for a robot, two enclaves have the same path, or a
                group is not one of the fleet; with file and line.
            DocumentError: the fleet has no such robot.
        """
        for name in robots:
            fleet.robot(name)
        self._policy = policy
        self.fleet = fleet
        self._of: dict[str, tuple[Enclave, Robot | None]] = {}
        self._names: dict[tuple[str, Source], tuple[str, ...]] = {}
        self.patterns = tuple(
            enclave.path for enclave in policy.enclaves if has_placeholder(enclave.path)
        )
        self.protects = any(
            group.protect
            for enclave in policy.enclaves
            for profile in enclave.all_profiles()
            for group in profile.groups
        )
        for enclave in policy.enclaves:
            for path, robot in self._paths(enclave):
                if robots and (robot is None or robot.name not in robots):
                    continue
                if path in self._of:
                    raise _duplicate_path_error(path, enclave, self._of[path][0])
                self._of[path] = enclave, robot
            if len(self._of) > MAX_ENCLAVES:
                raise PolicyError(
                    f"{enclave.source}: the policy gives more than {MAX_ENCLAVES} enclaves",
                    "",
                    "Divide the fleet or the policy.",
                )

    def __getitem__(self, path: str) -> Enclave:
        return self._expanded_enclave(path, *self._of[path])

    def __contains__(self, path: object) -> bool:
        return path in self._of

    def __iter__(self) -> Iterator[str]:
        return iter(self._of)

    def __len__(self) -> int:
        return len(self._of)

    def stated_enclave(self, path: str) -> tuple[Enclave, Robot | None]:
        """Return the policy's enclave, with placeholders, for a path, and the robot of the path.

        The robot is None for a path that the policy states without a placeholder.
        """
        return self._of[path]

    def paths_without_robot(self) -> list[str]:
        """Return the paths that the policy states without a placeholder."""
        return [e.path for e in self._policy.enclaves if not has_placeholder(e.path)]

    def policy(self) -> Policy:
        """Return the policy with all enclaves expanded; raise `PolicyError` if there are none."""
        if not self._of:
            raise PolicyError(f"'{self._policy.file}': the policy has no enclave for this fleet")
        return replace(self._policy, enclaves=tuple(self.values()))

    def for_one_robot(self) -> Policy:
        """Return the policy with every enclave expanded only for the first robot."""
        first: dict[int, str] = {}
        for path, (enclave, _) in self._of.items():
            first.setdefault(id(enclave), path)
        return replace(self._policy, enclaves=tuple(self[path] for path in first.values()))

    @property
    def file(self) -> str:
        """The path of the policy file."""
        return self._policy.file

    def _paths(self, enclave: Enclave) -> Iterator[tuple[str, Robot | None]]:
        if not has_placeholder(enclave.path):
            yield enclave.path, None
            return
        parts = parts_of(enclave.path)
        for robot in self._group_members(group_of(parts), enclave.source):
            try:
                yield check_enclave_name(path_for(parts, robot)), robot
            except InvalidNameError as error:
                raise PolicyError(
                    f"{enclave.source}: for the robot {robot.name}, {error.what}",
                    error.why,
                    error.remedy,
                ) from error

    def _group_members(self, group: str, source: Source) -> tuple[Robot, ...]:
        try:
            return self.fleet.members(group)
        except DocumentError as error:
            raise PolicyError(f"{source}: {error.what}", error.why, error.remedy) from error

    def _expanded_enclave(self, path: str, enclave: Enclave, robot: Robot | None) -> Enclave:
        count = 0

        def filled_profile(profile: Profile) -> Profile:
            nonlocal count
            ns, node = (self._filled_name(text, robot) for text in (profile.ns, profile.node))
            if has_placeholder(profile.ns):
                ns = check_namespace(ns)  # a name in the root namespace can be empty
            groups = []
            for unfilled in profile.groups:
                group = self._group(unfilled, robot, _MOST_NAMES - count)
                count += len(group.names)
                if count > _MOST_NAMES:
                    raise PolicyError(
                        f"{profile.source}: the enclave {path} has more than {_MOST_NAMES} names",
                        "",
                        "Divide the enclave, or name fewer robots, such as those of a group.",
                    )
                if group.names:
                    groups.append(group)
            return replace(profile, ns=ns, node=node, groups=tuple(groups))

        return replace(enclave.with_profiles(filled_profile), path=path)

    def _filled_name(self, text: str, robot: Robot | None) -> str:
        if robot is None or not has_placeholder(text):
            return text
        return "".join(map(str, fill(parts_of(text), robot.name, robot.namespace)))

    def _group(self, group: Group, robot: Robot | None, maximum: int) -> Group:
        """Return the group with its names filled in for a robot; the result can have no names.

        Once it has more than ``maximum`` names, the rest is left out.
        """
        if not any(map(has_placeholder, group.names)):
            return group
        names: list[str] = []
        lines: list[int] = []
        for index, name in enumerate(group.names):
            filled = self._filled_names(
                self._filled_name(name, robot), name, group.source_of(index)
            )
            names += filled
            lines += group.lines[index : index + 1] * len(filled)
            if len(names) > maximum:
                break
        return replace(group, names=tuple(names), lines=tuple(lines))

    def _filled_names(self, name: str, written: str, source: Source) -> tuple[str, ...]:
        """Return the different names that a name expands to: one name, or one for each robot.

        ``written`` is the name as the policy states it, before a robot was filled in.
        """
        if not has_placeholder(name):
            if name != written and (problem := _name_problem(name)):
                raise _invalid_name_error(name, problem, source)
            return (name,)
        key = name, source
        names = self._names.get(key)
        if names is None:
            parts = parts_of(name)
            names = tuple(dict.fromkeys(self._names_for_robots(parts, source)))
            if name == written:  # without a placeholder, a name is the same for all robots
                self._names[key] = names
        return names

    def _names_for_robots(self, parts: Parts, source: Source) -> Iterator[str]:
        for robot in self._group_members(placeholders_of(parts)[0].group, source):
            name = "".join(map(str, fill(parts, robot.name, robot.namespace, plural=True)))
            if problem := _name_problem(name):
                raise _invalid_name_error(name, problem, source)
            yield name


def check_chosen_robots(
    policies: Sequence[FleetPolicy], fleet: Fleet, robots: Collection[str]
) -> None:
    """Raise `PolicyError` if the policies lack a chosen robot, or some of its enclaves.

    ``policies`` are all policies of the fleet, expanded only for the chosen ``robots``.
    """
    owners = {policy.stated_enclave(path)[1] for policy in policies for path in policy}
    patterns = [pattern for policy in policies for pattern in policy.patterns]
    written = [path for policy in policies for path in policy.paths_without_robot()]
    lost = unrecorded_enclaves(fleet.with_enclaves(patterns), written, robots)
    for name, (below, naming) in lost.items():
        has_enclave = fleet.robots[name] in owners
        if left_out := below if has_enclave else (*below, *naming):
            raise PolicyError(
                f"--robot {name} would leave out {first_few(left_out, 5)}",
                "A path without a placeholder belongs to no robot.",
                "Write the path with {robot}, or {robot:GROUP} for the robots of a group in the "
                "fleet file, or leave out --robot.",
            )
        if not has_enclave:
            raise PolicyError(
                f"the policies have no enclave for the robot {name}",
                "They have neither an enclave path with {robot}, nor one with {robot:GROUP} for a "
                "group of this robot.",
                "Choose another robot, correct the robot's groups in the fleet file, or name the "
                "policy that has its enclaves.",
            )


def read_policy_for(path: Path, fleet: Fleet | None) -> Policy:
    """Return the policy in a file; with a fleet, its placeholders are filled in.

    Raises:
        DocumentError: as `read_policy` and `FleetPolicy` raise it.
    """
    if fleet is None:
        return read_policy(path)
    return FleetPolicy(read_policy(path, placeholders=True), fleet).policy()


def fleet_with_enclaves(fleet: Fleet, files: Iterable[Path]) -> Fleet:
    """Return the fleet with the enclave paths of policies; unreadable policies are left out.

    Use the result only to show which robot an enclave belongs to.
    """
    patterns: list[str] = []
    for file in files:
        with suppress(SrosError):
            patterns += FleetPolicy(read_policy(file, placeholders=True), fleet).patterns
    return fleet.with_enclaves(patterns)


def _name_problem(name: str) -> str:
    return "It is a namespace, not a name." if name == "/" else expression_problem(name)


def _invalid_name_error(name: str, problem: str, source: Source) -> PolicyError:
    return PolicyError(f"{source}: with the values of the fleet, {name!r} is not valid", problem)


def _duplicate_path_error(path: str, enclave: Enclave, other: Enclave) -> PolicyError:
    remedy = "Write paths that differ, for example with {robot} in front."
    if other is not enclave and has_placeholder(enclave.path) and has_placeholder(other.path):
        remedy = (
            "If robots differ, put them into groups, and write one enclave for each group, with "
            "the group in its path: {robot:GROUP}."
        )
    return PolicyError(
        f"{enclave.source}: the enclave {path} is defined twice",
        "The same element gives this path for another robot, too."
        if other is enclave
        else f"The other definition is at {other.source}.",
        remedy,
    )


# ── what is left to a fleet ───────────────────────────────────────────────────────────────────


_NAMESPACE_PLACEHOLDER = "{namespace"


def with_absolute_names(policy: Policy) -> Policy:
    """Return the policy with "/" before each name that begins with ``{namespace}``.

    A namespace begins with "/", so such names are absolute; the added "/" shows it.
    """
    return _with_changed_names(
        policy, lambda name: f"/{name}" if name.startswith(_NAMESPACE_PLACEHOLDER) else name
    )


def as_written(text: str) -> str:
    """Return names in a text as the policy file has them: the reverse of `with_absolute_names`."""
    return text.replace(f"/{_NAMESPACE_PLACEHOLDER}", _NAMESPACE_PLACEHOLDER)


def with_names_as_written(policy: Policy) -> Policy:
    """Return the policy with names as its file has them: the reverse of `with_absolute_names`."""
    return _with_changed_names(policy, as_written)


def _with_changed_names(policy: Policy, change: Callable[[str], str]) -> Policy:
    def renamed(profile: Profile) -> Profile:
        groups = (replace(group, names=tuple(map(change, group.names))) for group in profile.groups)
        return replace(profile, ns=change(profile.ns), groups=tuple(groups))

    return with_profiles(policy, renamed)


def with_placeholders(policy: FleetPolicy, observed: Iterable[Right]) -> frozenset[Right]:
    """Return observed rights, in which placeholders replace the names of robots.

    Names have the form of `with_absolute_names`.  A right that the policy does not state keeps its
    name; if the policy does not have its enclave, the right also keeps the enclave.
    """
    expanded: set[Right] = set()
    for path, rights in _rights_by_enclave(observed).items():
        if path in policy:
            expanded.update(_rights_as_stated(policy, path, split_actions(rights)))
        else:
            expanded.update(rights)
    return frozenset(expanded)


def unobserved_robots(policy: FleetPolicy, observed: Iterable[Right]) -> dict[str, list[str]]:
    """Map enclave paths with placeholders to the robots for which they were not observed.

    Only paths that were observed for another robot are included; robots are in the order of the
    fleet.
    """
    observed_rights = _rights_by_enclave(observed)
    missing: dict[str, list[str]] = defaultdict(list)
    stated_enclaves = {
        policy.stated_enclave(path)[0].path for path in observed_rights if path in policy
    }
    for path in policy:
        enclave, robot = policy.stated_enclave(path)
        if robot and enclave.path in stated_enclaves and path not in observed_rights:
            missing[enclave.path].append(robot.name)
    return missing


def check_narrowed(policy: FleetPolicy, result: MinimizedPolicy, observed: Iterable[Right]) -> None:
    """Check that a narrowed policy adds no right and removes no observed right, for any robot.

    Raises:
        PolicyError: a wildcard of the policy means something else for another robot.
    """
    after = FleetPolicy(with_names_as_written(result.policy), policy.fleet)
    observed_rights = _rights_by_enclave(observed)
    replaced = {use.enclave for use in result.uses if use.wildcards}
    for path in policy:
        if path not in observed_rights and policy.stated_enclave(path)[0].path not in replaced:
            continue
        allowed, narrowed = (policy_rights(Policy((side[path],))) for side in (policy, after))
        before, now = Rules(allowed), Rules(narrowed)
        wrong = [
            right for right in narrowed if right.qualifier is ALLOW and not before.cover(right)
        ]
        used = (
            e
            for e in split_actions(observed_rights.get(path, ()))
            if before.allow(path, e.right, e.name)
        )
        wrong += (right for right in used if not now.cover(right))
        if wrong:
            raise PolicyError(
                "the policy cannot be narrowed for all robots together",
                "A wildcard matches different names on different robots, so it is unclear which "
                f"enclaves may {wrong[0].describe()}.",
                "Replace the wildcard by the names that the robots use.",
            )


def _rights_by_enclave(observed: Iterable[Right]) -> dict[str, list[Right]]:
    by_enclave: dict[str, list[Right]] = defaultdict(list)
    for right in observed:
        if right.qualifier is ALLOW:
            by_enclave[right.enclave].append(right)
    return by_enclave


def _rights_as_stated(policy: FleetPolicy, path: str, observed: Iterable[Right]) -> Iterator[Right]:
    """Yield the observed rights of an enclave as the policy states them.

    A right to an action is yielded as rights to its parts.
    """
    enclave, robot = policy.stated_enclave(path)
    policy[path]  # raises an error if there are too many names
    rights = policy_rights(with_absolute_names(Policy((enclave,))))
    stated = [right for right in rights if right.qualifier is ALLOW]
    exact: dict[tuple[str, str], list[Right]] = defaultdict(list)
    for right in stated:
        for name in _expanded_names(policy, right.name, robot):
            for part, own_part in zip(parts(right), parts(right._replace(name=name)), strict=True):
                exact[own_part.right, own_part.name].append(part)
    rules = Rules(stated)
    wide = [(used, name, rights) for (used, name), rights in exact.items() if is_expression(name)]
    for right in observed:
        same = exact.get((right.right, right.name), [])
        same = (
            same
            or [
                general_right
                for name in _forms_with_placeholders(right.name, robot)
                if rules.cover(general_right := Right(enclave.path, ALLOW, right.right, name))
            ][:1]
        )
        # Keep a wildcard for each robot, such as /{robots}/*.
        same = same or [
            part
            for used, name, rights in wide
            if used == right.right and covers(name, right.name)
            for part in rights
        ]
        yield from same or [right._replace(enclave=enclave.path)]


def _expanded_names(policy: FleetPolicy, name: str, robot: Robot | None) -> Iterable[str]:
    """Return the names that a name with placeholders stands for, for one robot.

    The name has the form of `with_absolute_names`. ``robot`` None stands for an enclave of no
    robot.
    """
    if not has_placeholder(name):
        return (name,)
    parts = parts_of(as_written(name))
    if robot:
        parts = fill(parts, robot.name, robot.namespace)
    several = placeholders_of(parts)
    if not several:
        return ("".join(map(str, parts)),)
    return [
        "".join(map(str, fill(parts, member.name, member.namespace, plural=True)))
        for member in policy.fleet.members(several[0].group)
    ]


def _forms_with_placeholders(name: str, robot: Robot | None) -> Iterator[str]:
    """Yield forms of a name in which placeholders replace the robot's name or namespace."""
    if robot:

        def with_named_placeholder(text: str) -> str:
            of_robot = "{robot}"  # noqa: RUF027 - a placeholder of policies
            return "/".join(of_robot if part == robot.name else part for part in text.split("/"))

        relative = name.removeprefix(robot.namespace.rstrip("/"))
        inside = f"/{_NAMESPACE_PLACEHOLDER}}}{with_named_placeholder(relative)}"
        if robot.namespace != "/" and name.startswith(f"{robot.namespace}/"):
            yield inside
        yield with_named_placeholder(name)
        if robot.namespace == "/":
            yield name
            yield inside
    yield name
