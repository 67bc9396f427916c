"""Permissions are proven to match their policy; otherwise nothing is written."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Criteria, Grant, Permissions, Rule, parse_permissions
from sros_tool.errors import KeystoreError
from sros_tool.files import policies_dir
from sros_tool.keystore.issuing import enclave as writer_of_enclaves
from sros_tool.keystore.issuing import proof
from sros_tool.keystore.issuing.proof import (
    differences,
    example_topics,
    prove,
    signed_expressions,
    stated_expressions,
)
from sros_tool.names import ROS_DISCOVERY_TOPIC
from sros_tool.pki import smime
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave, Policy, Qualifier
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import Rules, policy_rights
from sros_tool.translate import permissions_for
from sros_tool.validity import Window
from tests.policy.drawn_policies import policies
from tests.support.harness import policy_text, publish, snapshot, sros
from tests.support.long_form import some

NOW = datetime(2026, 11, 21, tzinfo=UTC)
DOMAINS = DomainSet.parse("0,10-19")
WINDOW = Window(NOW, NOW + timedelta(days=90))
ASKED = (Vendor.STANDARD, Vendor.FAST, Vendor.FAST_2_9)
FILES = sorted(policies_dir().glob("*.xml")) + sorted(policies_dir().glob("defaults/*.xml"))


def permissions_of(enclave: Enclave) -> Permissions:
    return permissions_for(enclave, subject="CN=/x", validity=WINDOW, domains=DOMAINS)


@pytest.mark.parametrize("file", some(FILES, 2), ids=lambda file: file.stem)
def test_shipped_policies_are_proven(file: Path) -> None:
    for enclave in read_policy(file).enclaves:
        made = permissions_of(enclave)
        assert signed_expressions(made, DOMAINS) == stated_expressions(enclave)
        assert differences(enclave, made, DOMAINS, ASKED) == []


@given(policies())
def test_equal_expressions_give_equal_decisions(policy: Policy) -> None:
    """Equal sets of expressions mean equal decisions of the engine, for random policies."""
    for enclave in policy.enclaves:
        made = permissions_of(enclave)
        assert signed_expressions(made, DOMAINS) == stated_expressions(enclave)
        assert differences(enclave, made, DOMAINS, ASKED) == []


@given(policies())
def test_stated_expressions_allow_what_the_policy_allows(policy: Policy) -> None:
    """The DDS expressions of the proof allow exactly the topics that the policy allows."""
    rules = Rules(policy_rights(policy))
    for enclave in policy.enclaves:
        stated = stated_expressions(enclave)
        for topic in example_topics(stated.all()):
            if topic.startswith("rt/") and len(topic) > 3:
                for verb in ("publish", "subscribe"):
                    allowed = rules.allow(enclave.path, verb, topic[2:])
                    assert stated.allows(verb, topic) == allowed, (verb, topic)


@given(policies())
def test_the_short_form_of_a_large_document_is_proven(policy: Policy) -> None:
    for enclave in policy.enclaves:
        with patch("sros_tool.translate.LARGE_BYTES", 0):
            made = permissions_of(enclave)
        prove(enclave, made, DOMAINS)
        assert differences(enclave, made, DOMAINS, ASKED) == []


SHORT = '<topics publish="ALLOW"><topic>/x/*</topic><topic>/x/a</topic><topic>/x/b*</topic>'


@pytest.mark.parametrize(
    ("more", "signed", "same"),
    [
        ("", "rt/x/*", True),
        ("", "rt/x/* rt/x/a", True),
        ("", "rt/x/a rt/x/b*", False),
        ("<topic>/y</topic>", "rt/x/*", False),
        ("<topic>/y/*</topic>", "rt/x/*", False),
        ("<topic>/x*</topic>", "rt/x/*", False),
        ("<topic>/x*</topic>", "rt/x*", True),
        ("<topic>/[xy]/*</topic>", "rt/[xy]/*", True),
        ("<topic>/[xy]/*</topic>", "rt/x/*", False),
    ],
)
def test_only_what_a_wildcard_matches_is_left_out(
    more: str, signed: str, same: bool, tmp_path: Path
) -> None:
    enclave = of_text(f"{SHORT}{more}</topics>", tmp_path)
    (full,) = permissions_of(enclave).grants[0].rules
    topics = (*signed.split(), ROS_DISCOVERY_TOPIC)
    rule = full._replace(publish=(Criteria(topics),))
    made = only_grant(permissions_of(enclave), lambda grant: grant._replace(rules=(rule,)))
    with nullcontext() if same else pytest.raises(KeystoreError, match="would not match"):
        prove(enclave, made, DOMAINS)


def test_the_short_form_is_proven_without_asking_the_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asking takes minutes for a large document."""
    enclave = of_text(f"{SHORT}</topics>", tmp_path)
    monkeypatch.setattr("sros_tool.translate.LARGE_BYTES", 0)
    made = permissions_of(enclave)
    monkeypatch.setattr(proof, "differences", lambda *_: pytest.fail("the engine was asked"))
    assert "rt/x/a" not in made.grants[0].rules[0].publish[0].topics
    prove(enclave, made, DOMAINS)


# ── errors are found ───────────────────────────────────────────────────────────────────────


def of_text(groups: str, tmp_path: Path) -> Enclave:
    file = tmp_path / "p.xml"
    file.write_text(policy_text({"/x": groups}))
    return read_policy(file).enclaves[0]


GROUPS = (
    '<topics publish="ALLOW" subscribe="DENY"><topic>/a</topic><topic>/b/*</topic></topics>'
    '<topics publish="DENY"><topic>/b/secret</topic></topics>'
    '<services request="ALLOW"><service>/add</service></services>'
    '<actions execute="ALLOW"><action>/go</action></actions>'
)


def only_grant(made: Permissions, change: Callable[[Grant], Grant]) -> Permissions:
    return Permissions((change(made.grants[0]),))


def rules(change: Callable[[tuple[Rule, ...]], tuple[Rule, ...]]) -> Callable[[Grant], Grant]:
    return lambda grant: grant._replace(rules=change(grant.rules))


def topics(rule: Rule, side: str, change: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Rule:
    (criteria,) = getattr(rule, side)
    return rule._replace(**{side: (Criteria(change(criteria.topics)),)})  # type: ignore[arg-type]


WRONG: dict[str, Callable[[Grant], Grant]] = {
    "denials behind permissions": rules(lambda r: r[::-1]),
    "denials lost": rules(lambda r: r[1:]),
    "permissions lost": rules(lambda r: (r[0], r[1]._replace(publish=()))),
    "a topic more": rules(lambda r: (r[0], topics(r[1], "publish", lambda t: (*t, "rt/more")))),
    "a wildcard more": rules(lambda r: (r[0], topics(r[1], "publish", lambda t: (*t, "rt/*")))),
    "a topic less": rules(lambda r: (r[0], topics(r[1], "publish", lambda t: t[1:]))),
    "directions swapped": rules(
        lambda r: (r[0], r[1]._replace(publish=r[1].subscribe, subscribe=r[1].publish))
    ),
    "allowed turned into denied": rules(lambda r: (r[0], r[1]._replace(allow=False))),
    "half a service": rules(
        lambda r: (
            r[0],
            topics(r[1], "subscribe", lambda t: tuple(x for x in t if x != "rr/addReply")),
        )
    ),
    "a domain less": rules(lambda r: tuple(x._replace(domains=DomainSet.parse("0")) for x in r)),
    "default ALLOW": lambda grant: grant._replace(default_allow=True),
    "in a partition": rules(
        lambda r: (r[0], r[1]._replace(publish=(r[1].publish[0]._replace(partitions=("p",)),)))
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_permissions_are_found(wrong: str, tmp_path: Path) -> None:
    enclave = of_text(GROUPS, tmp_path)
    made = permissions_of(enclave)
    prove(enclave, made, DOMAINS)
    changed = only_grant(made, WRONG[wrong])
    with pytest.raises(KeystoreError, match="would not match the policy"):
        prove(enclave, changed, DOMAINS)


@pytest.mark.parametrize("count", [1, 400])
def test_a_vendor_that_matches_a_wildcard_differently_is_found(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matchers are compared for small and for large documents."""
    names = [f"/t{number}" for number in range(count)]
    assert proof.is_matched_as_meant("rt/robot[0-9]/*")
    prove(enclave := of_text(publish(*names, "/a[bc]"), tmp_path), permissions_of(enclave), DOMAINS)
    monkeypatch.setattr(proof, "dds_matches", lambda _, expression, name: expression == name)
    proof.is_matched_as_meant.cache_clear()
    asked: list[Enclave] = []

    def differences(policy: Enclave, *_: object) -> list[object]:
        asked.append(policy)
        return []

    monkeypatch.setattr(proof, "differences", differences)
    prove(enclave, permissions_of(enclave), DOMAINS)
    proof.is_matched_as_meant.cache_clear()
    assert asked == [enclave], "the engine has the last word"


def test_equivalent_permissions_of_another_form_are_accepted(tmp_path: Path) -> None:
    enclave = of_text(publish("/a", "/b"), tmp_path)
    made = permissions_of(enclave)

    def split(all_rules: tuple[Rule, ...]) -> tuple[Rule, ...]:
        (rule,) = all_rules
        (criteria,) = rule.publish
        one = rule._replace(publish=(Criteria(criteria.topics[:1]),))
        deny_nothing = rule._replace(allow=False, publish=(Criteria(("rt/nobody",)),), subscribe=())
        return (one, deny_nothing, rule._replace(publish=(Criteria(criteria.topics[1:]),)))

    changed = only_grant(made, rules(split))
    assert signed_expressions(changed, DOMAINS) is None
    prove(enclave, changed, DOMAINS)


def test_example_topics() -> None:
    found = example_topics(["rt/a", "rt/b/*", "rt/*/c", "rq/*Request"])
    assert "rt/a" in found
    assert "rt/b/c" in found
    for wanted, others in (
        ("rt/b/*", ["rt/*/c"]),
        ("rt/*/c", ["rt/b/*"]),
        ("rq/*Request", []),
    ):
        assert any(
            matches(wanted, name) and not any(matches(each, name) for each in others)
            for name in found
        ), wanted
    known = ["rt/a", "rt/b/*", "rt/*/c", "rq/*Request"]
    assert any(not any(matches(each, name) for each in known) for name in found)


@given(st.lists(st.sampled_from(["rt/a", "rt/*", "rt/a*", "rt/?", "rt/[ab]", "*"]), max_size=4))
def test_example_topics_distinguish_every_wildcard(expressions: list[str]) -> None:
    found = example_topics(expressions)
    for one in {each for each in expressions if "*" in each}:
        assert any(matches(one, name) for name in found)


# ── use by commands ────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("count", [1, 6])
def test_permissions_that_fail_the_proof_are_not_written(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Permissions without the deny rules, or with additional rights, are not written."""
    policy = tmp_path / "robot.xml"
    groups = '<topics publish="ALLOW"><topic>/a/*</topic></topics>'
    groups += '<topics publish="DENY"><topic>/a/secret</topic></topics>'
    policy.write_text(policy_text({f"/robot{number}": groups for number in range(count)}))
    keystore = tmp_path / "ks"
    sros("create_keystore", keystore).ok()
    before = snapshot(keystore)

    def forgetful(enclave: Enclave, **rest: object) -> Permissions:
        made = permissions_for(enclave, **rest)  # type: ignore[arg-type]
        kept = tuple(rule for rule in made.grants[0].rules if rule.allow)
        return Permissions((made.grants[0]._replace(rules=kept),))

    def greedy(enclave: Enclave, **rest: object) -> Permissions:
        made = permissions_for(enclave, **rest)  # type: ignore[arg-type]
        all_rules = made.grants[0].rules
        wide = topics(all_rules[-1], "publish", lambda t: (*t, "rt/*"))
        return Permissions((made.grants[0]._replace(rules=(*all_rules[:-1], wide)),))

    for wrong in (forgetful, greedy):
        monkeypatch.setattr(writer_of_enclaves, "permissions_for", wrong)
        found = sros("generate_artifacts", "-k", keystore, "-p", policy)
        assert found.status == 2
        assert "would not match the policy" in found.err
        assert "rt/" in found.err
        assert snapshot(keystore) == before
    monkeypatch.undo()
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()


def test_the_signed_permissions_are_the_proven_ones(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({"/robot": GROUPS}))
    sros("create_keystore", tmp_path / "ks").ok()
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", policy).ok()
    signed = smime.parse((tmp_path / "ks/enclaves/robot/permissions.p7s").read_bytes())
    made = parse_permissions(signed.document)
    (enclave,) = read_policy(policy).enclaves
    assert differences(enclave, made, DomainSet.parse("0"), ASKED) == []
    assert Qualifier.DENY in {right.qualifier for right in policy_rights(read_policy(policy))}
