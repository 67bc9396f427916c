"""The set of topics that a vendor allows has exactly those on which the vendor decides so."""

from __future__ import annotations

from collections import Counter

import pytest

from sros_tool.dds.decision.access import AccessVerb, Refusal
from sros_tool.dds.decision.vendors import TESTED, Vendor
from tests.dds.drawn_documents import documents
from tests.support.children import LONG
from tests.support.long_form import some

TOPICS = (
    "rt/a", "rt/b", "rt/ab", "rt/a/b", "rt/c", "rq/aRequest", "rt/]", "rt/-", "rt/]b", "a", "rt/",
    "rt/abc", "rt/a b", "rt/chatter", "rt/cmd_vel", "ros_discovery_info", "rr/aReply", "9", "rt/A",
)  # fmt: skip
VERBS = (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)


@pytest.mark.parametrize("vendor", some([*TESTED, Vendor.STANDARD], 2))
def test_a_topic_is_in_the_set_if_it_is_allowed(vendor: Vendor) -> None:
    seen: Counter[bool] = Counter()
    for case in documents(11, 4000 if LONG else 250):
        access = case.access(vendor)
        if isinstance(access, Refusal):
            continue
        asked = {topic for _, topic, *_ in case.questions if topic}
        for verb in VERBS:
            found = access.topics(verb)
            for topic in {*TOPICS, *asked}:
                if not set("*?[").intersection(topic) and len(topic) < 250:
                    allowed = access.decide(verb, topic).outcome.ok
                    assert (topic in found) is allowed, (case, verb, topic)
                    seen[allowed] += 1
    assert min(seen[True], seen[False]) > 1000
