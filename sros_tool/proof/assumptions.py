"""The assumptions under which two sides are compared, and what is not compared on purpose.

A side is a policy, a keystore or permissions.  A policy states no governance and, except for robots
of a fleet, no domains.  Permissions state no governance.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from hashlib import sha256

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance
from sros_tool.dds.permissions import Permissions
from sros_tool.fleet.enclaves import robot_of
from sros_tool.proof.protection import limits_crossing, states_routers, strict_protection
from sros_tool.proof.sources import ALL_DOMAINS, AccessSource
from sros_tool.translate import governance_for
from sros_tool.zenoh.configuration import Mode


def completed(side: AccessSource, other: AccessSource) -> AccessSource:
    """Return a side with the domains and access control that it does not state itself.

    Enclaves of robots are for the domain of their robot.  A side without a governance gets access
    control of everything, in its own domains and those of the other side.
    """
    domains = domains_of_robots(side, other)
    permissions = _certified_as(side, other)
    if domains:
        permissions = {
            name: _for_domain(each, domains[name]) if name in domains else each
            for name, each in permissions.items()
        }
    if side.governance:
        return replace(side, permissions=permissions)
    own = DomainSet.of(*((domain, domain) for domain in domains.values()))
    if side.kind != "policy":
        own = _granted(side)
    governance = _controlling(other.governance, own)
    if governance is None:
        known = DomainSet((*own.ranges, *_granted(other).ranges)).closed()
        open_ended = {"policy"} >= {side.kind, other.kind}
        governance = governance_for(strict_protection(), ALL_DOMAINS if open_ended else known)
    return replace(side, permissions=permissions, governance=governance)


def _certified_as(side: AccessSource, other: AccessSource) -> Mapping[str, Permissions]:
    """Return the permissions of a side; those of a policy get the subjects of the other side.

    If the other side is a keystore with unique subjects, enclaves that only the policy has get a
    unique subject, too.
    """
    if side.kind != "policy" or other.kind == "policy":
        return side.permissions
    unique = other.later is not None and other.later.unique_subject
    found = {}
    for name, permissions in side.permissions.items():
        subject = other.subject_of(name)
        if not subject and unique:
            subject = f"CN={name},OU={sha256(name.encode()).hexdigest()}"
        grants = permissions.grants
        if subject:
            grants = tuple(grant._replace(subject=subject) for grant in grants)
        found[name] = Permissions(grants)
    return found


def domains_of_robots(side: AccessSource, other: AccessSource) -> dict[str, int]:
    """Map enclaves to the ROS domain of their robot, if the fleet states one."""
    robots = side.fleet or other.fleet
    if side.kind != "policy" or robots is None:
        return {}
    robots_of = ((name, robot_of(robots, name)) for name in side.permissions)
    return {
        name: robot.domain
        for name, robot in robots_of
        if robot is not None and robot.domain is not None
    }


def _for_domain(permissions: Permissions, domain: int) -> Permissions:
    only = DomainSet.of((domain, domain))
    return Permissions(
        tuple(
            grant._replace(rules=tuple(rule._replace(domains=only) for rule in grant.rules))
            for grant in permissions.grants
        )
    )


def _granted(side: AccessSource) -> DomainSet:
    """Return the domains for which the permissions have rules; empty for a policy.

    A policy fits any domain.
    """
    if side.kind == "policy":
        return DomainSet(())
    return DomainSet(
        tuple(
            part
            for permissions in side.permissions.values()
            for grant in permissions.grants
            for rule in grant.rules
            for part in rule.domains.ranges
        )
    ).closed()


def _controlling(governance: Governance | None, more: DomainSet) -> Governance | None:
    """Return a governance with access control of everything, also for the domains ``more``."""
    if governance is None:
        return None
    strict = governance_for(strict_protection(), more).domain_access_rules[0]

    def controlling(rule: DomainRule) -> DomainRule:
        topics = tuple(
            replace(topic_rule, enable_read_access_control=True, enable_write_access_control=True)
            for topic_rule in rule.topic_access_rules
        )
        if not any(topic.topic_expression == "*" for topic in topics):
            topics += strict.topic_access_rules
        return replace(
            rule,
            allow_unauthenticated_participants=False,
            enable_join_access_control=True,
            topic_access_rules=topics,
        )

    rules = tuple(map(controlling, governance.domain_access_rules))
    missing = [domain for domain in more if domain not in governance.domains().closed()]
    if missing:
        rules += (replace(strict, domains=DomainSet.of(*((domain, domain) for domain in missing))),)
    return Governance(rules)


# ── in words ───────────────────────────────────────────────────────────────────────────────


def assumptions(base: AccessSource, head: AccessSource) -> tuple[str, ...]:
    """Return, as clauses, what is assumed about a side that does not state everything."""
    return tuple(_assumed(base, head))


def _assumed(base: AccessSource, head: AccessSource) -> Iterator[str]:
    if "zenoh" not in (base.kind, head.kind):
        if base.governance is None and head.governance is None:
            yield "both are signed with the same governance, which controls all access"
        elif base.governance is None:
            yield (
                "BASE is signed with access control of everything, and with encryption unless it "
                "demands another protection"
            )
        elif head.governance is None:
            yield (
                "HEAD is signed with access control of everything, and protects no less than BASE"
            )
    for name, side, other in (("BASE", base, "HEAD"), ("HEAD", head, "BASE")):
        against = head if side is base else base
        if side.kind != "policy" or against.kind == "policy":
            continue
        if domains_of_robots(side, against).keys() < side.permissions.keys():
            whose = "its enclaves without a robot" if side.fleet else "it"
            yield f"{name} names no domains: for {whose}, the domains of {other} count"
        if against.zenoh is not None:
            yield f"{name} has the Zenoh settings that sros writes"


def left_out(base: AccessSource, head: AccessSource) -> tuple[str, ...]:
    """Return the parts that are not compared on purpose, in words."""
    return tuple(_left_out(base, head))


def _left_out(base: AccessSource, head: AccessSource) -> Iterator[str]:
    yield "dates"
    sides = (("BASE", base), ("HEAD", head))
    if "zenoh" in (base.kind, head.kind):
        if {base.kind, head.kind} != {"zenoh"}:
            yield "what DDS permits"
    else:
        yield "partitions other than the default one"
    if {base.kind, head.kind} & {"keystore", "enclave"}:
        yield "who holds which key"
    if any(
        file.document.mode is Mode.CLIENT for _, side in sides for file in side.zenoh_files.values()
    ):
        yield "what clients of Zenoh let their router do"
    for name, side in sides:
        other = head if side is base else base
        if side.trusts is not None and other.trusts is None:
            yield f"the CAs and revocation lists of {name}"
        if side.later is not None and other.later is None:
            yield f"what {name} gives to enclaves that are created later"
        if limits_crossing(side) and not states_routers(other):
            yield f"what {name} lets cross between Zenoh routers"
        if side.zenoh_files and not other.zenoh_files:
            yield f"where the Zenoh processes of {name} listen and connect"
        if side.scope is not None and other.scope is None:
            yield f"enclaves that {name} does not have"
    if base.protections is not None and head.governance is None and head.kind != "policy":
        yield "the protection of messages, of which HEAD says nothing"
