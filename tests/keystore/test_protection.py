"""What policies demand becomes the protection of a keystore: enough for each name, never less."""

from __future__ import annotations

import random
from itertools import product

import pytest

from sros_tool.dds.governance import TopicRule
from sros_tool.errors import PolicyError
from sros_tool.keystore.protection import (
    governance_for_all,
    unfulfilled_protections,
    with_stated_protections,
)
from sros_tool.policy.model import (
    DomainProtection,
    Level,
    NamedProtection,
    Source,
    StatedProtection,
    TopicProtection,
)
from sros_tool.policy.patterns import matches
from sros_tool.translate import contradictions, protected_topics

KINDS = ("topics", "services", "actions")
NAMES = ["/" + "/".join(part) for n in (1, 2) for part in product("abc", repeat=n)]
PATTERNS = [*NAMES, "/*", "/a/*", "/*/b", "/a*", "/b/?", "/c/[ab]", "/?/a"]
TOPICS = [each for kind in KINDS for name in NAMES for each in protected_topics(kind, name)]
FLAGS = ("enable_read_access_control", "enable_write_access_control")
OPEN = TopicProtection(Level.NONE, Level.NONE)


def stated(name: str, level: Level, kind: str = "topics", line: int = 1) -> StatedProtection:
    return StatedProtection("/e", kind, name, level, Source("p.xml", line))


def strength(kind: str) -> int:
    return ["NONE", "SIGN", "ENCRYPT"].index(kind.partition("_")[0])


def rules_by_topic(protection: DomainProtection) -> dict[str, TopicRule]:
    rules = governance_for_all(protection).domain_access_rules[0].topic_access_rules
    return {
        topic: next(rule for rule in rules if matches(rule.topic_expression, topic))
        for topic in TOPICS
    }


def drawn(source: random.Random) -> tuple[DomainProtection, list[StatedProtection]]:
    def topic() -> TopicProtection:
        data = source.choice([Level.NONE, Level.SIGN, Level.ENCRYPT])
        flags = (source.random() < 0.5, source.random() < 0.5)
        return TopicProtection(data, source.choice(list(Level)), *flags)

    def place() -> tuple[str, str]:
        return source.choice(KINDS), source.choice(PATTERNS)

    rtps = source.choice([Level.NONE, Level.NONE, Level.SIGN, Level.ENCRYPT])
    named = tuple(NamedProtection(*place(), topic()) for _ in range(source.randrange(4)))
    levels = [Level.SIGN, Level.ENCRYPT]
    demands = []
    for _ in range(source.randrange(1, 4)):
        kind, name = place()
        demands.append(stated(name, source.choice(levels), kind))
    return DomainProtection(rtps=rtps, default=topic(), named=named), demands


def test_each_name_gets_what_is_demanded_and_keeps_what_it_had() -> None:
    """Against every name up to a length: 60 drawn settings and policies."""
    raised = refused = 0
    for seed in range(60):
        before, demands = drawn(random.Random(seed))
        try:
            after = with_stated_protections(before, demands)
        except PolicyError:
            refused += 1
            continue
        raised += after != before
        old, new = rules_by_topic(before), rules_by_topic(after)
        for topic in TOPICS:
            one, other = old[topic], new[topic]
            assert strength(one.data_protection_kind) <= strength(other.data_protection_kind)
            assert strength(one.metadata_protection_kind) <= strength(
                other.metadata_protection_kind
            )
            assert all(getattr(one, each) == getattr(other, each) for each in FLAGS), seed
            has = max(
                map(
                    strength,
                    (other.data_protection_kind, other.metadata_protection_kind, after.rtps),
                )
            )
            for each in demands:
                expressions = protected_topics(each.kind, each.name)
                if any(matches(expression, topic) for expression in expressions):
                    assert has >= strength(each.level), (seed, topic)
        assert with_stated_protections(after, demands) == after, seed
        assert not list(unfulfilled_protections(governance_for_all(after), demands))
    assert raised > 10
    assert refused > 3


@pytest.mark.parametrize(
    ("one", "other", "kind"),
    [
        ("/scan", "/scan", "topics"),
        ("/camera/*", "/camera/front", "topics"),
        ("/*/scan", "/robot/*", "topics"),
        ("/arm/*", "/arm", "actions"),
    ],
)
def test_one_name_has_one_protection(one: str, other: str, kind: str) -> None:
    said = [stated(one, Level.SIGN, line=3), stated(other, Level.ENCRYPT, kind, line=9)]
    assert list(contradictions(said)) == [(said[0], said[1])]
    with pytest.raises(PolicyError, match=r"p\.xml:9: .*encrypt.* at p\.xml:3") as found:
        with_stated_protections(DomainProtection(), said)
    assert "one governance" in str(found.value)
    with_stated_protections(DomainProtection(), [said[0], stated("/elsewhere", Level.ENCRYPT)])


def test_settings_that_meet_a_demand_in_some_names_are_refused() -> None:
    named = (NamedProtection("topics", "/camera/*", OPEN),)
    settings = DomainProtection(rtps=Level.NONE, named=named)
    with pytest.raises(PolicyError, match=r"already protect topic /camera/\*"):
        with_stated_protections(settings, [stated("/*/image", Level.ENCRYPT)])
    raised = with_stated_protections(settings, [stated("/*", Level.ENCRYPT)])
    assert raised.named[0].protection.data is Level.ENCRYPT


def test_the_domain_can_protect_enough() -> None:
    settings = DomainProtection(rtps=Level.ENCRYPT, default=OPEN)
    assert with_stated_protections(settings, [stated("/scan", Level.ENCRYPT)]) == settings
    signed = DomainProtection(rtps=Level.SIGN, default=OPEN)
    assert with_stated_protections(signed, [stated("/scan", Level.SIGN)]) == signed
    assert with_stated_protections(signed, [stated("/scan", Level.ENCRYPT)]) != signed


def test_many_names_take_no_longer_for_each() -> None:
    import time

    said = [stated(f"/robot{number}/cmd_vel", Level.ENCRYPT) for number in range(2000)]
    began = time.process_time()
    assert len(with_stated_protections(DomainProtection(default=OPEN), said).named) == 2000
    assert time.process_time() - began < 20
