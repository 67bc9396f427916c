"""From a policy to what DDS enforces, and back: nothing is added, and nothing is lost."""

from __future__ import annotations

from dataclasses import fields
from datetime import UTC, datetime, timedelta
from itertools import combinations, product
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.dds.decision.access import Access, AccessVerb, GovernedDomain, Outcome
from sros_tool.dds.decision.expressions import matches
from sros_tool.dds.decision.vendors import Style, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, TopicRule, attributes
from sros_tool.dds.permissions import Criteria, Permissions, Rule
from sros_tool.keystore.issuing.proof import example_topics
from sros_tool.names import ROS_DISCOVERY_TOPIC, dds_names, expand
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    RIGHTS,
    DomainProtection,
    Enclave,
    Group,
    Level,
    NamedProtection,
    Profile,
    Profiles,
    Qualifier,
    TopicProtection,
)
from sros_tool.policy.patterns import covers
from sros_tool.translate import governance_for, needed_expressions, permissions_for, ros_rights
from sros_tool.validity import window
from tests.support.drawn_policies import drawn_groups

DOMAINS = DomainSet.parse("0,7")
BEGIN = datetime(2026, 1, 1, tzinfo=UTC)
VALIDITY = window(BEGIN, timedelta(days=2))
NOW = BEGIN + timedelta(days=1)
NAMES = (
    "x",
    "/x",
    "~/x",
    "~",
    "*",
    "/*",
    "a/b",
    "/a/*",
    "x?",
    "[ab]",
    "fib",
    "/fib/_action/status",
)


profiles = st.builds(
    Profile,
    st.sampled_from(("/", "/ns", "/ns/deep")),
    st.sampled_from(("n", "m", "*")),
    st.lists(drawn_groups(st.sampled_from(NAMES)), max_size=3).map(tuple),
)
blocks = st.lists(profiles, min_size=1, max_size=2).map(lambda made: Profiles(tuple(made)))
enclaves = st.builds(Enclave, st.just("/e"), st.lists(blocks, min_size=1, max_size=2).map(tuple))


def topics(rules: list[Rule], direction: str) -> set[str]:
    found: list[Criteria] = [each for rule in rules for each in getattr(rule, direction)]
    return {topic for each in found for topic in each.topics}


def expected(enclave: Enclave, qualifier: Qualifier) -> tuple[set[str], set[str]]:
    publish, subscribe = set[str](), set[str]()
    for profile in enclave.all_profiles():
        for group in profile.groups:
            for right, said in group.rights:
                for name in group.names if said is qualifier else ():
                    names = dds_names(right, expand(name, profile.ns, profile.node))
                    publish.update(names.publish)
                    subscribe.update(names.subscribe)
    return publish, subscribe


def made(enclave: Enclave) -> Permissions:
    return permissions_for(enclave, subject="CN=/e", validity=VALIDITY, domains=DOMAINS)


@given(enclaves)
def test_permissions_say_what_the_policy_says_and_discovery(enclave: Enclave) -> None:
    (grant,) = made(enclave).grants
    for qualifier in (ALLOW, DENY):
        rules = [rule for rule in grant.rules if rule.allow is (qualifier is ALLOW)]
        publish, subscribe = expected(enclave, qualifier)
        own = {ROS_DISCOVERY_TOPIC} if qualifier is ALLOW else set()
        assert topics(rules, "publish") == publish | own
        assert topics(rules, "subscribe") == subscribe | own


@given(enclaves)
def test_permissions_stay_in_the_portable_profile(enclave: Enclave) -> None:
    (grant,) = made(enclave).grants
    assert [rule.allow for rule in grant.rules] in ([True], [False, True]), "denials come first"
    assert grant.default_allow is False
    assert all(rule.domains == DOMAINS for rule in grant.rules)
    for rule in grant.rules:
        for each in (*rule.publish, *rule.subscribe):
            assert each.topics
            assert not each.partitions
            assert list(each.topics) == sorted(set(each.topics))
        assert len(rule.publish) <= 1, "Cyclone DDS reads the last list of topics only"
        assert len(rule.subscribe) <= 1


@given(enclaves)
def test_the_rights_of_a_rule_are_its_topics(enclave: Enclave) -> None:
    """Folded back into services and actions, a rule still names each of its topics, and no more."""
    for rule in made(enclave).grants[0].rules:
        told = {"publish": set[str](), "subscribe": set[str]()}
        for each in ros_rights(rule):
            assert each.qualifier is (ALLOW if rule.allow else DENY)
            if each.kind == "dds":
                told[each.right].add(each.name)
                continue
            names = dds_names(each.right, each.name)
            told["publish"].update(names.publish)
            told["subscribe"].update(names.subscribe)
        assert told["publish"] == topics([rule], "publish")
        assert told["subscribe"] == topics([rule], "subscribe")


# ── large documents ────────────────────────────────────────────────────────────────────────

PIECES = ["a", "b", "/", "*", "?", "**", "[ab]", "[!a]", "[^a]", "[[:alpha:]]"]
expressions = st.lists(st.sampled_from(PIECES), min_size=1, max_size=4).map(
    lambda pieces: "rt/" + "".join(pieces)
)
TOPICS = ["rt/" + "".join(each) for size in range(4) for each in product("ab/]", repeat=size)]


@given(st.frozensets(expressions, max_size=8))
def test_needed_expressions_match_the_same_names_for_every_vendor(listed: frozenset[str]) -> None:
    needed = needed_expressions(listed)
    assert needed <= listed
    for style, topic in product(Style, TOPICS):
        before, after = (
            any(matches(style, each, topic) for each in some) for some in (listed, needed)
        )
        assert before == after, (style, topic)


@pytest.mark.parametrize(
    ("listed", "needed"),
    [
        ("rt/a rt/b", "rt/a rt/b"),
        ("rt/a rt/* rq/aRequest", "rt/* rq/aRequest"),
        ("rt/a/* rt/a/b/* rt/a/b rt/b", "rt/a/* rt/a/b/* rt/b"),
        ("rt/?* rt/*? rt/ab", "rt/*? rt/?*"),
        ("rt/[ab] rt/a rt/c", "rt/[ab] rt/c"),
        ("rt/[^a] rt/b rt/a", "rt/[^a] rt/a rt/b"),  # Cyclone DDS matches a, Fast DDS b
        ("rt/[[:alpha:]] rt/a", "rt/[[:alpha:]] rt/a"),
    ],
)
def test_needed_expressions(listed: str, needed: str) -> None:
    assert needed_expressions(set(listed.split())) == set(needed.split())


@given(enclaves)
def test_a_large_document_decides_as_a_small_one(enclave: Enclave) -> None:
    """Every vendor decides the same for every name, whether or not names are left out."""
    full = made(enclave)
    with patch("sros_tool.translate.LARGE_BYTES", 0):
        short = made(enclave)
    listed = {each for grant in full.grants for rule in grant.rules for each in all_topics(rule)}
    names = set(example_topics(listed)) | {
        name for each in listed for name in example_topics([each])
    }
    for vendor in Vendor:
        governed = GovernedDomain(vendor, governance_for(DomainProtection(), DOMAINS), 7)
        one, other = (Access(governed, each, "CN=/e", moment=NOW) for each in (full, short))
        assert one.join().outcome is other.join().outcome is Outcome.ALLOWED
        for name, verb in product(names, ("publish", "subscribe")):
            before, after = (each.decide(AccessVerb(verb), name).outcome for each in (one, other))
            assert before is after, (vendor, verb, name)


def test_only_a_large_document_leaves_names_out() -> None:
    """A smaller one can be read next to its policy."""
    names = tuple(f"/sensors/{'very_' * 5}long_{number}" for number in range(800))
    for few, expected in ((100, 102), (800, 2)):
        group = Group("topics", (("publish", ALLOW),), ("/sensors/*", *names[:few]))
        enclave = Enclave("/e", (Profiles((Profile("/", "n", (group,)),)),))
        (rule,) = made(enclave).grants[0].rules
        assert len(rule.publish[0].topics) == expected


def all_topics(rule: Rule) -> set[str]:
    return topics([rule], "publish") | topics([rule], "subscribe")


def test_services_and_actions_are_told_as_such() -> None:
    said = (("call", ALLOW), ("execute", ALLOW))
    enclave = Enclave(
        "/e",
        (
            Profiles(
                (
                    Profile("/", "n", (Group("actions", said, ("fib",)),)),
                    Profile("/", "n", (Group("services", (("request", ALLOW),), ("add",)),)),
                )
            ),
        ),
    )
    rights = {
        (each.kind, each.right, each.name) for each in ros_rights(made(enclave).grants[0].rules[0])
    }
    assert rights - {
        ("dds", "publish", ROS_DISCOVERY_TOPIC),
        ("dds", "subscribe", ROS_DISCOVERY_TOPIC),
    } == {
        ("actions", "call", "/fib"),
        ("actions", "execute", "/fib"),
        ("services", "request", "/add"),
    }


# ── governance ─────────────────────────────────────────────────────────────────────────────

topic_protections = st.builds(
    TopicProtection,
    st.sampled_from((Level.NONE, Level.SIGN, Level.ENCRYPT)),
    st.sampled_from(Level),
    *[st.booleans()] * 4,
)
WIDER = ("/cmd_vel", "/cmd_*", "/camera/*", "/camera/image", "/*", "*", "/camera/ima?e", "/fib")
named = st.builds(
    NamedProtection, st.sampled_from(sorted(RIGHTS)), st.sampled_from(WIDER), topic_protections
)
protections = st.builds(
    DomainProtection,
    default=topic_protections,
    named=st.lists(named, max_size=6, unique_by=lambda each: (each.kind, each.name)).map(tuple),
)


def decided(rules: tuple[TopicRule, ...], topic: str) -> TopicRule:
    """The rule that DDS takes: the first that matches (fnmatch, * crosses /)."""
    return next(rule for rule in rules if covers(rule.topic_expression, topic))


@given(protections)
def test_no_topic_rule_is_hidden_by_a_wider_one(protection: DomainProtection) -> None:
    (rule,) = governance_for(protection, DOMAINS).domain_access_rules
    rules = rule.topic_access_rules
    assert rules[-1].topic_expression == "*", "a topic without a rule cannot be created"
    for earlier, later in combinations(rules, 2):
        wide, narrow = earlier.topic_expression, later.topic_expression
        assert not covers(wide, narrow) or covers(narrow, wide)
    unmatched = decided(rules, "nothing/of/ros")
    assert str(unmatched.data_protection_kind) == str(protection.default.data)
    for each in protection.named:
        if "*" in each.name or "?" in each.name:
            continue
        for right in RIGHTS[each.kind]:
            names = dds_names(right, each.name)
            for topic in (*names.publish, *names.subscribe):
                found = decided(rules, topic)
                assert found.topic_expression == topic
                assert str(found.metadata_protection_kind) == str(each.protection.metadata)
                assert found.enable_read_access_control == each.protection.read_access_control


@pytest.mark.parametrize(
    ("rule", "protection", "others"),
    [(DomainRule, DomainProtection, {"default", "named"}), (TopicRule, TopicProtection, set())],
)
def test_each_attribute_is_made_from_a_field_of_its_own(
    rule: type[DomainRule | TopicRule],
    protection: type[DomainProtection | TopicProtection],
    others: set[str],
) -> None:
    terms = [each.term for each in attributes(rule)]
    assert len(set(terms)) == len(terms)
    assert set(terms) | others == {each.name for each in fields(protection)}
