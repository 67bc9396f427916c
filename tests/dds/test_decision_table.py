"""How the vendors really decide, row by row: one document, one question, every vendor's answer.

The answers of Fast DDS and Cyclone DDS were observed on the real libraries; where those are
installed, tests/integration/test_differential.py asks them again.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta
from zoneinfo import ZoneInfo

import pytest

from sros_tool.dds.decision.access import AccessVerb, Outcome, Refusal
from sros_tool.dds.decision.vendors import Vendor
from tests.dds.decision_documents import (
    NOW,
    access_of,
    allow,
    criteria,
    deny,
    governance,
    grant,
    permissions,
    publish,
    subscribe,
    topic_rule,
)
from tests.support.tables import for_every

WORDS = {
    "yes": Outcome.ALLOWED,
    "no": Outcome.DENIED,
    "peer": Outcome.PEER_DENIES,
    "refused": Outcome.REFUSED,
    "crash": Outcome.CRASHES,
}
HERE, THERE = "<id>42</id>", "<id>7</id>"
A, B = publish("rt/a"), publish("rt/b")
DEFAULT_ALLOW = "<default>ALLOW</default>"
OPENED = governance(topic_rule("rt/open", read=False, write=False), topic_rule())


@dataclass(frozen=True)
class Row:
    """``answers`` are those of the standard, Fast DDS 2.14, Fast DDS 2.9.1 and Cyclone DDS."""

    name: str
    permissions: bytes
    answers: str
    topic: str = "rt/a"
    verb: AccessVerb = AccessVerb.PUBLISH
    partitions: tuple[str, ...] = ()
    governance: bytes = governance()
    zone: str = "UTC"
    domain: int = 42
    subject: str = "CN=/t"


def one(*rules: str) -> bytes:
    return permissions(grant(*rules))


def moment(hours: float, offset: str = "Z") -> str:
    shift = timedelta(hours=float(offset[:3])) if offset != "Z" else timedelta()
    return (NOW + timedelta(hours=hours) + shift).strftime(f"%Y-%m-%dT%H:%M:%S{offset}")


def window(begin: str, end: str) -> bytes:
    return permissions(grant(allow(A), begin=begin, end=end))


def pattern(expression: str, topic: str, answers: str) -> Row:
    return Row(f"{expression!r} for {topic}", one(allow(publish(expression))), answers, topic)


EVERYWHERE = publish("*", partitions=("*",))
IN_P1 = publish("rt/a", partitions=("p1",))
TWO_LISTS = (
    "<publish><topics><topic>rt/a</topic></topics><topics><topic>rt/b</topic></topics></publish>"
)
PAST = (moment(-48), moment(-24))
HOUR = (moment(-1), moment(1))
OPEN_TOP = "<id_range><max>50</max></id_range>"
OPEN_END = "<id_range><min>40</min></id_range>"
WHOLE = "<id_range><min>42</min></id_range>"
READER = AccessVerb.SUBSCRIBE

ROWS = [
    pattern("rt/*", "rt/a/b/c", "yes yes yes yes"),
    pattern("rt/a?b", "rt/a/b", "yes yes yes yes"),
    pattern("rt/[a-c]", "rt/b", "yes yes yes yes"),
    pattern("rt/[!a-c]", "rt/x", "yes yes yes yes"),
    pattern("rt/[!a-c]", "rt/b", "no no no no"),
    pattern("rt[/]a", "rt/a", "yes yes yes yes"),
    pattern("rt/[^a-c]", "rt/x", "yes yes yes no"),
    pattern("rt/[^a-c]", "rt/b", "no no no yes"),
    pattern("rt/[[:digit:]]", "rt/7", "yes yes yes no"),
    pattern("rt/[ab]_x", "rt/a_x", "yes yes yes yes"),
    # Cyclone DDS takes what follows the bracket for a range that begins with it.
    pattern("rt/[ab]-x", "rt/q", "no no no yes"),
    pattern(" rt/a ", "rt/a", "no no no yes"),
    pattern("rt/A", "rt/a", "no no no no"),
    Row("deny, then allow", one(deny(A), allow(A)), "no no no no"),
    Row("allow, then deny", one(allow(A), deny(A)), "yes yes yes yes"),
    Row("no rule", one(allow(B)), "no no no no"),
    Row("the other direction", one(allow(A)), "no no no no", verb=READER),
    Row(
        "a writer denied, a reader allowed",
        one(deny(publish("rt/s")), allow(subscribe("rt/*"))),
        "yes yes yes no",
        "rt/s",
        READER,
    ),
    Row(
        "relaying denied, reading allowed",
        one(deny(criteria("relay", "rt/a")), allow(subscribe("rt/a"))),
        "yes peer peer yes",
        verb=READER,
    ),
    Row(
        "relaying denied, writing allowed",
        one(deny(criteria("relay", "rt/a")), allow(A)),
        "yes yes yes yes",
    ),
    Row(
        "relaying denied behind reading",
        one(allow(subscribe("rt/a")), deny(criteria("relay", "rt/a"))),
        "yes yes yes yes",
        verb=READER,
    ),
    Row("denied elsewhere", one(deny(A, domains=THERE), allow(A)), "yes no no yes"),
    Row("allowed elsewhere", one(allow(A, domains=THERE), allow(B)), "no peer peer no"),
    Row("all allowed elsewhere", one(allow(A, domains=THERE)), "refused peer peer refused"),
    Row("two lists of topics: the first", one(allow(TWO_LISTS)), "refused yes yes no"),
    Row("two lists of topics: the last", one(allow(TWO_LISTS)), "refused yes yes yes", "rt/b"),
    Row(
        "default ALLOW beside a rule",
        permissions(grant(allow(B), default=DEFAULT_ALLOW)),
        "yes no no yes",
    ),
    Row(
        "default ALLOW beside a denial",
        permissions(grant(deny(B), default=DEFAULT_ALLOW)),
        "yes refused refused yes",
    ),
    Row(
        "default ALLOW alone",
        permissions(grant(default=DEFAULT_ALLOW)),
        "yes refused refused yes",
    ),
    Row("default missing", permissions(grant(allow(A), default="")), "refused refused refused yes"),
    Row(
        "default before the rules",
        permissions(grant(DEFAULT_ALLOW, allow(A), default="")),
        "refused refused refused yes",
    ),
    Row(
        "rule in a partition, then one without: without",
        one(allow(IN_P1), allow(A)),
        "yes no no yes",
    ),
    Row(
        "rule in a partition, then one without: in it",
        one(allow(IN_P1), allow(A)),
        "yes yes yes yes",
        partitions=("p1",),
    ),
    Row("a partition without a rule", one(allow(A)), "no no no no", partitions=("p1",)),
    Row(
        "one of two partitions",
        one(allow(IN_P1)),
        "no no no no",
        partitions=("p1", "p2"),
    ),
    Row(
        "partitions of another topic of the rule",
        one(allow(IN_P1, B)),
        "no yes yes no",
        "rt/b",
        partitions=("p1",),
    ),
    Row(
        "denied in p1, all else allowed everywhere: in p1 and p2",
        one(deny(IN_P1), allow(EVERYWHERE)),
        "no no no no",
        partitions=("p1", "p2"),
    ),
    Row(
        "denied in p1, all else allowed everywhere: in p2",
        one(allow(subscribe("rt/a")), deny(IN_P1), allow(EVERYWHERE)),
        "yes no no yes",
        partitions=("p2",),
    ),
    # Cyclone DDS takes a denial without partitions for one of the default partition.
    Row(
        "denied, all else allowed everywhere: in p2",
        one(allow(subscribe("rt/a")), deny(A), allow(EVERYWHERE)),
        "no no no yes",
        partitions=("p2",),
    ),
    Row(
        "denied in p1, then everything: in p2",
        one(deny(IN_P1), allow(publish("*"))),
        "no no no no",
        partitions=("p2",),
    ),
    Row(
        "denied in p1 for writers of another topic, then everything: in p2",
        one(deny(publish("rt/b", partitions=("p1",))), allow(publish("*", partitions=("*",)))),
        "yes yes yes yes",
        partitions=("p2",),
    ),
    Row(
        "an expired grant, then a valid one",
        permissions(grant(allow(A), begin=PAST[0], end=PAST[1]), grant(allow(A))),
        "refused yes yes refused",
    ),
    Row(
        "a grant elsewhere, then one here",
        permissions(grant(allow(B, domains=THERE)), grant(allow(A))),
        "refused no no refused",
    ),
    Row(
        "subject 'CN = /t'",
        permissions(grant(allow(A), subject="CN = /t")),
        "yes yes refused refused",
    ),
    Row(
        "subject '/CN=/t'",
        permissions(grant(allow(A), subject="/CN=/t")),
        "refused refused refused yes",
    ),
    Row(
        "subject 'CN=/t,O=x'",
        permissions(grant(allow(A), subject="CN=/t,O=x")),
        "refused refused refused yes",
    ),
    Row(
        "subject 'CN=/t/admin'",
        permissions(grant(allow(A), subject="CN=/t/admin")),
        "refused refused refused yes",
    ),
    Row(
        "subject in another order",
        permissions(grant(allow(A), subject="O=x,CN=/t")),
        "refused yes refused yes",
        subject="CN=/t,O=x",
    ),
    Row(
        "subject with a kind twice",
        permissions(grant(allow(A), subject="OU=a,OU=b")),
        "yes refused yes refused",
        subject="OU=a,OU=b",
    ),
    Row(
        "subject with spaces after commas",
        permissions(grant(allow(A), subject="CN=/t, O=x")),
        "yes yes yes refused",
        subject="CN=/t,O=x",
    ),
    Row("in date", window(moment(-48), moment(48)), "yes yes yes yes"),
    Row("expired", window(*PAST), "refused refused refused refused"),
    Row("not yet valid", window(moment(24), moment(48)), "refused refused refused refused"),
    Row("this hour, host in UTC", window(*HOUR), "yes yes yes yes"),
    Row(
        "this hour, host in Los Angeles",
        window(*HOUR),
        "yes refused refused yes",
        zone="America/Los_Angeles",
    ),
    Row("this hour, host in Tokyo", window(*HOUR), "yes refused refused yes", zone="Asia/Tokyo"),
    Row(
        "this hour with its offset",
        window(moment(-1, "+09:00"), moment(1, "+09:00")),
        "yes refused refused yes",
    ),
    Row(
        "expired by its offset",
        window(moment(-30, "+09:00"), moment(-1, "+09:00")),
        "refused yes yes refused",
    ),
    Row("date only", window("2020-01-01", "2037-01-01"), "refused yes yes refused"),
    Row(
        "until 9999", window("2020-01-01T00:00:00Z", "9999-12-31T23:59:59Z"), "yes yes yes refused"
    ),
    Row("from 42 on, permissions", one(allow(A, domains=WHOLE)), "yes yes yes yes"),
    Row("from 40 on, permissions", one(allow(A, domains=OPEN_END)), "yes peer peer refused"),
    Row("up to 50, permissions", one(allow(A, domains=OPEN_TOP)), "yes yes yes crash"),
    Row(
        "a rule, then one up to 50",
        one(allow(A), deny(B, domains=OPEN_TOP)),
        "yes yes yes crash",
    ),
    Row(
        "two rules, then one up to 50",
        one(allow(A), allow(B), deny(B, domains=OPEN_TOP)),
        "yes yes yes yes",
    ),
    Row(
        "up to 240, permissions",
        one(allow(A, domains="<id_range><min>40</min><max>240</max></id_range>")),
        "yes yes yes refused",
    ),
    Row(
        "from 40 on, governance",
        one(allow(A)),
        "yes no no refused",
        governance=governance(domains=OPEN_END),
    ),
    Row(
        "up to 50, governance",
        one(allow(A)),
        "yes yes yes refused",
        governance=governance(domains=OPEN_TOP),
    ),
    Row(
        "not in governance",
        one(allow(A)),
        "refused no no refused",
        governance=governance(domains=THERE),
    ),
    Row(
        "not in governance: join",
        one(allow(A)),
        "refused yes yes refused",
        "",
        AccessVerb.JOIN,
        governance=governance(domains=THERE),
    ),
    Row(
        "no topic rule for it",
        one(allow(A)),
        "no no no no",
        governance=governance(topic_rule("rt/b")),
    ),
    Row(
        "no topic rules",
        one(allow(A)),
        "refused refused refused refused",
        governance=governance(topic_rule()).replace(topic_rule().encode(), b""),
    ),
    Row("an open topic", one(allow(B)), "yes yes yes yes", "rt/open", governance=OPENED),
    Row(
        "an open topic, joining denied to peers",
        one(allow(A, domains=THERE)),
        "peer peer peer peer",
        "rt/open",
        governance=OPENED,
    ),
    Row("a topic named *", one(allow(B)), "no yes yes no", "*", governance=OPENED),
    Row("a topic named rt/op*", one(allow(B)), "no yes yes no", "rt/op*", governance=OPENED),
    Row("a topic with a dash in its name", one(allow(publish("*"))), "yes yes yes no", "rt/a-b"),
    Row(
        "strangers, and RTPS signed",
        one(allow(A)),
        "yes refused yes yes",
        governance=governance(unauthenticated=True, rtps="SIGN"),
    ),
    Row(
        "strangers, and RTPS open",
        one(allow(A)),
        "yes yes yes yes",
        governance=governance(unauthenticated=True, rtps="NONE"),
    ),
    Row(
        "joining free, only a denial: an open topic",
        one(deny(B)),
        "yes refused refused yes",
        "rt/open",
        governance=governance(
            topic_rule("rt/open", read=False, write=False), topic_rule(), join=False
        ),
    ),
    Row(
        "joining free, only a denial: a closed one",
        one(deny(B)),
        "no refused refused no",
        governance=governance(join=False),
    ),
    Row("an empty topic before it", one(allow(publish("", "rt/a"))), "yes refused refused crash"),
    Row("an empty topic behind it", one(allow(publish("rt/a", ""))), "yes refused refused yes"),
    Row(
        "an empty topic behind one that matches in other partitions",
        one(allow(publish("rt/a", "", partitions=("p1",)))),
        "no refused refused no",
    ),
    Row(
        "an empty default behind the rule",
        permissions(grant(allow(A), default="<default/>")),
        "refused refused refused yes",
    ),
    Row(
        "an empty default that is asked for",
        permissions(grant(allow(B), default="<default/>")),
        "refused refused refused crash",
    ),
    Row(
        "an empty list of topics",
        one(allow("<publish><topics/></publish>")),
        "refused refused refused no",
    ),
    Row(
        "a grant without a name",
        permissions(grant(allow(A), name="")),
        "refused refused refused yes",
    ),
    Row("an unknown element", one(allow(A), "<surprise/>"), "refused refused refused refused"),
    Row(
        "tags in capitals",
        one(allow(A)).replace(b"allow_rule", b"ALLOW_RULE"),
        "refused refused refused yes",
    ),
    Row(
        "a comment behind the permissions",
        one(allow(A)).replace(b"</dds>", b"<!-- --></dds>"),
        "yes yes yes yes",
    ),
    Row(
        "a comment behind the governance",
        one(allow(A)),
        "yes refused refused yes",
        governance=governance().replace(b"</dds>", b"<!-- --></dds>"),
    ),
]

ASKED = (Vendor.STANDARD, Vendor.FAST, Vendor.FAST_2_9, Vendor.CYCLONE)


@pytest.mark.parametrize("vendor", ASKED)
@for_every(ROWS, lambda row: row.name)
def test_row(row: Row, vendor: Vendor) -> None:
    found = access_of(
        vendor,
        row.governance,
        row.permissions,
        row.subject,
        domain=row.domain,
        at=NOW,
        zone=ZoneInfo(row.zone),
    )
    if isinstance(found, Refusal):
        answer = found.decision()
    else:
        answer = found.decide(row.verb, row.topic, row.partitions)
    expected = WORDS[row.answers.split()[ASKED.index(vendor)]]
    assert answer.outcome is expected, answer


def test_every_answer_occurs_for_the_vendors_that_can_give_it() -> None:
    given = [{row.answers.split()[column] for row in ROWS} for column in range(4)]
    assert all({"yes", "no", "refused"} <= words for words in given)
    assert [column for column in range(4) if "crash" in given[column]] == [3]
