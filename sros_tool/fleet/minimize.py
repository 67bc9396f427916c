"""Minimizing one policy for many robots: what one robot used, its line gives to all of them.

Observations name robots, and the policy has placeholders.  Each observed right becomes the right
that the policy states for it, with its placeholders, so that `sros_tool.policy.minimize` narrows
the policy as it is.  Before that, a name that begins with ``{namespace}`` gets a "/" in front, as
absolute names have (`absolute`).  The result is proven for the robots (`check_narrowed`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from sros_tool.errors import PolicyError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.model import Robot
from sros_tool.names import is_expression
from sros_tool.policy.minimize import MinimizedPolicy
from sros_tool.policy.model import ALLOW, Enclave, Policy, Profile
from sros_tool.policy.patterns import covers
from sros_tool.policy.placeholders import fill, has_placeholder, parts_of, placeholders_of
from sros_tool.policy.rights import Right, Rules, parts, policy_rights, unfolded

_NAMESPACE = "{namespace"


def absolute(policy: Policy) -> Policy:
    """Return a policy in which names that begin with ``{namespace}`` begin with a "/"."""
    return _renamed(policy, lambda name: f"/{name}" if name.startswith(_NAMESPACE) else name)


def as_written(text: str) -> str:
    """Return names of `absolute`, or a text with them, as a policy has them."""
    return text.replace(f"/{_NAMESPACE}", _NAMESPACE)


def written(policy: Policy) -> Policy:
    """Undo `absolute`."""
    return _renamed(policy, as_written)


def _renamed(policy: Policy, change: Callable[[str], str]) -> Policy:
    def profile(each: Profile) -> Profile:
        groups = (replace(one, names=tuple(map(change, one.names))) for one in each.groups)
        return replace(each, ns=change(each.ns), groups=tuple(groups))

    def enclave(each: Enclave) -> Enclave:
        blocks = (replace(one, profiles=tuple(map(profile, one.profiles))) for one in each.profiles)
        return replace(each, profiles=tuple(blocks))

    return replace(policy, enclaves=tuple(map(enclave, policy.enclaves)))


def with_placeholders(policy: FleetPolicy, observed: Iterable[Right]) -> frozenset[Right]:
    """Return observed rights as a policy states them, in the names of `absolute`.

    A right that the policy does not state keeps its name; one of no enclave of the policy also its
    enclave.
    """
    found: set[Right] = set()
    for path, rights in _by_enclave(observed).items():
        if path in policy:
            found.update(_stated(policy, path, unfolded(rights)))
        else:
            found.update(rights)
    return frozenset(found)


def unobserved_robots(policy: FleetPolicy, observed: Iterable[Right]) -> dict[str, list[str]]:
    """Map the paths that were observed for some robots to the other robots, in their order."""
    seen = _by_enclave(observed)
    missing: dict[str, list[str]] = defaultdict(list)
    some = {policy.stated(path)[0].path for path in seen if path in policy}
    for path in policy:
        enclave, robot = policy.stated(path)
        if robot and enclave.path in some and path not in seen:
            missing[enclave.path].append(robot.name)
    return missing


def check_narrowed(policy: FleetPolicy, result: MinimizedPolicy, observed: Iterable[Right]) -> None:
    """Check that no robot gets more, and that none loses what was observed of it.

    Raises:
        PolicyError: a wildcard of the policy means something else for another robot.
    """
    after = FleetPolicy(written(result.policy), policy.fleet)
    seen = _by_enclave(observed)
    replaced = {use.enclave for use in result.uses if use.wide}
    for path in policy:
        if path not in seen and policy.stated(path)[0].path not in replaced:
            continue
        allowed, rest = (policy_rights(Policy((each[path],))) for each in (policy, after))
        before, now = Rules(allowed), Rules(rest)
        wrong = [each for each in rest if each.qualifier is ALLOW and not before.cover(each)]
        used = (e for e in unfolded(seen.get(path, ())) if before.allow(path, e.right, e.name))
        wrong += (each for each in used if not now.cover(each))
        if wrong:
            raise PolicyError(
                "the policy cannot be narrowed for all robots at once",
                f"A wildcard does not mean the same for each, so it is unclear who may {wrong[0]}.",
                "Write the names that the robots use in its place.",
            )


def _by_enclave(observed: Iterable[Right]) -> dict[str, list[Right]]:
    found: dict[str, list[Right]] = defaultdict(list)
    for each in observed:
        if each.qualifier is ALLOW:
            found[each.enclave].append(each)
    return found


def _stated(policy: FleetPolicy, path: str, observed: Iterable[Right]) -> Iterator[Right]:
    """Yield what is observed of an enclave as the policy states it; only parts of actions."""
    enclave, robot = policy.stated(path)
    policy[path]  # which has a bounded number of names
    stated = [e for e in policy_rights(absolute(Policy((enclave,)))) if e.qualifier is ALLOW]
    exact: dict[tuple[str, str], list[Right]] = defaultdict(list)
    for each in stated:
        for name in _names(policy, each.name, robot):
            for part, own in zip(parts(each), parts(each._replace(name=name)), strict=True):
                exact[own.right, own.name].append(part)
    rules = Rules(stated)
    wide = [(used, name, some) for (used, name), some in exact.items() if is_expression(name)]
    for right in observed:
        same = exact.get((right.right, right.name), [])
        same = (
            same
            or [
                each
                for name in _likely(right.name, robot)
                if rules.cover(each := Right(enclave.path, ALLOW, right.right, name))
            ][:1]
        )
        # A wildcard for each robot, such as /{robots}/*, stays.
        same = same or [
            part
            for used, name, some in wide
            if used == right.right and covers(name, right.name)
            for part in some
        ]
        yield from same or [right._replace(enclave=enclave.path)]


def _names(policy: FleetPolicy, name: str, robot: Robot | None) -> Iterable[str]:
    """Return the names of a robot that a name of `absolute` stands for."""
    if not has_placeholder(name):
        return (name,)
    found = parts_of(as_written(name))
    if robot:
        found = fill(found, robot.name, robot.namespace)
    several = placeholders_of(found)
    if not several:
        return ("".join(map(str, found)),)
    return [
        "".join(map(str, fill(found, each.name, each.namespace, plural=True)))
        for each in policy.fleet.members(several[0].group)
    ]


def _likely(name: str, robot: Robot | None) -> Iterator[str]:
    """Yield a name of a robot with placeholders where its namespace and its name are."""
    if robot:

        def named(text: str) -> str:
            return "/".join("{robot}" if each == robot.name else each for each in text.split("/"))

        inside = f"/{_NAMESPACE}}}{named(name.removeprefix(robot.namespace.rstrip('/')))}"
        if robot.namespace != "/" and name.startswith(f"{robot.namespace}/"):
            yield inside
        yield named(name)
        if robot.namespace == "/":
            yield name
            yield inside
    yield name
