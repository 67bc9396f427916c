"""Small policies drawn by hypothesis, and an oracle that knows only DDS topics and fnmatch."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase

from hypothesis import strategies as st

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant, Permissions, portability_problems
from sros_tool.names import dds_names
from sros_tool.policy.model import RIGHTS, Enclave, Group, Policy, Profile, Profiles, Qualifier
from sros_tool.policy.patterns import Names
from sros_tool.policy.rights import KIND_OF
from sros_tool.translate import permissions_for
from sros_tool.validity import window

EXACT = ("x", "y", "sub/x", "/x", "/ns/x", "~/p", "/ns/n/p", "fib", "/ns/fib", "fib/_action/status")
WILD = ("*", "/*", "/ns/*", "~/*", "x*", "?", "/[xy]", "sub/?", "/n?/*", "fib/_action/*", "/*/_*/*")
ACTION_PARTS = tuple(f"fib/_action/{end}" for end in ("send_goal", "get_result", "cancel_goal"))
KINDS = tuple(RIGHTS)

names = st.sampled_from(EXACT + WILD + ACTION_PARTS)
exact_names = st.sampled_from(EXACT + ACTION_PARTS)


def groups(
    name: st.SearchStrategy[str], qualifier: st.SearchStrategy[Qualifier]
) -> st.SearchStrategy[Group]:
    def rights(kind: str) -> st.SearchStrategy[Group]:
        first, second = RIGHTS[kind]
        said = st.one_of(
            st.tuples(st.tuples(st.just(first), qualifier)),
            st.tuples(st.tuples(st.just(second), qualifier)),
            st.tuples(st.tuples(st.just(first), qualifier), st.tuples(st.just(second), qualifier)),
        )
        found = st.lists(name, min_size=1, max_size=4, unique=True).map(tuple)
        return st.builds(Group, st.just(kind), said, found)

    return st.sampled_from(KINDS).flatmap(rights)


def policies(
    name: st.SearchStrategy[str] = names,
    qualifier: st.SearchStrategy[Qualifier] = st.sampled_from(Qualifier),  # noqa: B008
) -> st.SearchStrategy[Policy]:
    profile = st.builds(
        Profile,
        st.sampled_from(("/", "/ns")),
        st.sampled_from(("n", "m")),
        st.lists(groups(name, qualifier), max_size=3).map(tuple),
    )
    block = st.lists(profile, min_size=1, max_size=2).map(lambda made: Profiles(tuple(made)))
    enclave = st.builds(
        Enclave, st.sampled_from(("/a", "/b")), st.lists(block, min_size=1, max_size=2).map(tuple)
    )
    found = st.lists(enclave, min_size=1, max_size=2, unique_by=lambda each: each.path)
    return st.builds(Policy, found.map(tuple))


# ── what DDS makes of them ─────────────────────────────────────────────────────────────────

_ABSOLUTE = ("/x", "/y", "/z", "/ns/x", "/ns/y", "/sub/x", "/ns/sub/x", "/fib", "/ns/fib")
_NODES = ("/n/p", "/ns/n/p", "/ns/m/p", "/m/q", "/ns")
EVERYTHING = frozenset(
    (direction, topic)
    for name in _ABSOLUTE + _NODES
    for right in KIND_OF
    for direction, topics in zip(
        ("publish", "subscribe"), dds_names(right, name), strict=True
    )
    for topic in topics
)  # fmt: skip


def grant_of(policy: Policy, path: str) -> Grant:
    enclave = policy.enclave(path) or Enclave(path, ())
    validity = window(datetime(2026, 1, 1, tzinfo=UTC), timedelta(days=1))
    domains = DomainSet.of((0, 0))
    return permissions_for(enclave, subject="CN=x", validity=validity, domains=domains).grants[0]


def listed(policy: Policy, path: str, *, allow: bool) -> frozenset[tuple[str, str]]:
    """The pairs of direction and DDS topic as the permissions list them."""
    return frozenset(
        (direction, topic)
        for rule in grant_of(policy, path).rules
        if rule.allow is allow
        for direction in ("publish", "subscribe")
        for criteria in getattr(rule, direction)
        for topic in criteria.topics
    )


def meant(policy: Policy, path: str, *, allow: bool) -> frozenset[tuple[str, str]]:
    """Which pairs of `EVERYTHING` the rules of one qualifier match."""
    expressions = listed(policy, path, allow=allow)
    return frozenset(
        (direction, topic)
        for direction, topic in EVERYTHING
        if any(way == direction and fnmatchcase(topic, wide) for way, wide in expressions)
    )


def effective(policy: Policy, path: str) -> frozenset[tuple[str, str]]:
    """Which pairs of `EVERYTHING` DDS lets through."""
    return meant(policy, path, allow=True) - meant(policy, path, allow=False)


PATHS = ("/a", "/b")
DOMAINS = DomainSet.of((42, 42))


def portable_permissions(now: datetime) -> st.SearchStrategy[Permissions]:
    """What sros makes of drawn policies, where it is in the portable profile and allows anything.

    Sets of characters are in it, though a note advises against them: vendors read plain ones alike.
    """

    def made(policy: Policy, path: str) -> Permissions:
        enclave = policy.enclave(path) or Enclave(path, ())
        validity = window(now, timedelta(days=90))
        return permissions_for(enclave, subject=f"CN={path}", validity=validity, domains=DOMAINS)

    def fits(permissions: Permissions) -> bool:
        notes = portability_problems(permissions, 0, lambda names: Names(names).overlaps)
        allows = any(rule.allow for rule in permissions.grants[0].rules)
        return allows and all(identity == "portable.character-set" for identity, _ in notes)

    return st.builds(made, policies(), st.sampled_from(PATHS)).filter(fits)
