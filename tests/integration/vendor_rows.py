"""What was found out about the vendors, row by row: small documents, and what each vendor answers.

``YES`` is created and matched with a peer that may do everything.  The answers are those of Fast
DDS 2.9.1 and Cyclone DDS 0.10; what Fast DDS 2.14.5 and Cyclone DDS 11.0 do otherwise stands in
``later`` and ``cyclone_11``, what Fast DDS 3 does otherwise than
2.14.5 in ``fast_3``, and 2.6.12 otherwise than 2.9.1 in ``fast_2_6``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from tests.dds.decision_documents import allow, criteria, deny, grant, permissions, topic_rule
from tests.integration.vendor_oracle import Case, Question

YES, NO, PEER_DENIES, REFUSED = "matched", "denied", "unmatched", "refused"
CRASHES, INVALID = "crashed", "invalid"
PEERS_CRASH = "peer crashed"

DENY, ALLOW = "<default>DENY</default>", "<default>ALLOW</default>"


@dataclass(frozen=True)
class Row:
    """One document, one question; ``fast`` and ``cyclone`` are the answers."""

    name: str
    case: Case
    fast: str
    cyclone: str
    later: str = ""
    cyclone_11: str = ""
    fast_3: str = ""
    fast_2_6: str = ""


# ── governance ─────────────────────────────────────────────────────────────────────────────


def domain_rule(
    topics: str = topic_rule(),
    domains: str = "<id_range><min>0</min><max>230</max></id_range>",
    strangers: bool = False,
    join: bool = True,
    rtps: str = "NONE",
) -> str:
    return f"""<domain_rule><domains>{domains}</domains>
<allow_unauthenticated_participants>{str(strangers).lower()}</allow_unauthenticated_participants>
<enable_join_access_control>{str(join).lower()}</enable_join_access_control>
<discovery_protection_kind>NONE</discovery_protection_kind>
<liveliness_protection_kind>NONE</liveliness_protection_kind>
<rtps_protection_kind>{rtps}</rtps_protection_kind>
<topic_access_rules>{topics}</topic_access_rules></domain_rule>"""


def governance(*rules: str) -> bytes:
    inside = "".join(rules or (domain_rule(),))
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    return f"{head}<dds><domain_access_rules>{inside}</domain_access_rules></dds>\n".encode()


OPEN = governance()


# ── rows ───────────────────────────────────────────────────────────────────────────────────


def ask(
    document: bytes,
    topic: str = "rt/a",
    verb: str = "publish",
    partitions: tuple[str, ...] = (),
    governed: bytes = OPEN,
    zone: str = "UTC",
    domain: int = 42,
    subject: str = "CN=/t",
) -> Case:
    question = Question(verb, topic, partitions)
    return Case(governed, document, (question,), subject, domain, zone, peer=True)


def matching() -> list[Row]:
    """Whether an expression matches a name, one row each."""
    table = [
        ("rt/a", "rt/a", YES, YES),
        ("rt/*", "rt/a/b/c", YES, YES),
        ("*", "rt/a", YES, YES),
        ("rt/?", "rt/a", YES, YES),
        ("rt/a?b", "rt/a/b", YES, YES),
        ("rt/[a-c]", "rt/b", YES, YES),
        ("rt/[!a-c]", "rt/x", YES, YES),
        ("rt/[!a-c]", "rt/b", NO, NO),
        ("rt[/]a", "rt/a", YES, YES),
        ("rt[!x]a", "rt/a", YES, YES),
        ("rt/[^a-c]", "rt/x", YES, NO),
        ("rt/[^a-c]", "rt/b", NO, YES),
        ("rt/[[:digit:]]", "rt/7", YES, NO),
        (" rt/a ", "rt/a", NO, YES),
        ("rt/A", "rt/a", NO, NO),
        ("rt/a*b", "rt/ab", YES, YES),
        ("rt/*x*y", "rt/1x2x3y", YES, YES),
    ]
    return [
        Row(
            f"{expression} matches {name}",
            ask(permissions(grant(allow(criteria("publish", expression)))), name),
            fast,
            cyclone,
        )
        for expression, name, fast, cyclone in table
    ]


def rules() -> list[Row]:
    """Order, directions, domains, partitions and defaults of rules."""
    a, b = criteria("publish", "rt/a"), criteria("publish", "rt/b")
    both = criteria("publish", "*") + criteria("subscribe", "*")
    there = "<id>7</id>"
    denied_writer = permissions(grant(deny(criteria("publish", "rt/s")), allow(both)))
    one_way = permissions(
        grant(deny(criteria("publish", "rt/s")), allow(criteria("subscribe", "rt/*")))
    )
    in_p1 = criteria("publish", "rt/a", partitions=("p1",))
    two_lists = a.replace("</publish>", "") + b.replace("<publish>", "")
    everywhere = allow(criteria("publish", "*", partitions=("*",)))
    denied_default = permissions(grant(deny(a), everywhere))
    denied_in_p1 = permissions(grant(deny(in_p1), everywhere))
    # With reading free Cyclone DDS asks about endpoints only, not about the topic before them.
    readable = governance(domain_rule(topic_rule(read=False)))
    only_denied = permissions(grant(deny(b), default=ALLOW))
    table: list[tuple[Any, ...]] = [
        ("allowed", ask(permissions(grant(allow(a)))), YES, YES),
        ("not named", ask(permissions(grant(allow(b)))), NO, NO),
        ("the other direction", ask(permissions(grant(allow(a))), verb="subscribe"), NO, NO),
        ("deny, then allow", ask(permissions(grant(deny(a), allow(a)))), NO, NO),
        ("allow, then deny", ask(permissions(grant(allow(a), deny(a)))), YES, YES),
        ("denied writer, then everything: writer", ask(denied_writer, "rt/s"), NO, NO),
        (
            "deny rule for another domain",
            ask(permissions(grant(deny(a, domains=there), allow(a)))),
            NO,
            YES,
        ),
        (
            "allow rule for another domain, and one for this",
            ask(permissions(grant(allow(a, domains=there), allow(b)))),
            PEER_DENIES,
            NO,
        ),
        (
            "allow rule for another domain only",
            ask(permissions(grant(allow(a, domains=there)))),
            PEER_DENIES,
            REFUSED,
        ),
        (
            "two lists of topics: the first",
            ask(permissions(grant(allow(two_lists)))),
            YES,
            NO,
        ),
        (
            "two lists of topics: the last",
            ask(permissions(grant(allow(two_lists))), "rt/b"),
            YES,
            YES,
        ),
        ("default ALLOW beside a rule", ask(permissions(grant(allow(b), default=ALLOW))), NO, YES),
        ("default ALLOW after denials", ask(only_denied), REFUSED, YES),
        ("default ALLOW after denials: denied", ask(only_denied, "rt/b"), REFUSED, NO),
        ("default ALLOW without rules", ask(permissions(grant(default=ALLOW))), REFUSED, YES),
        ("no default", ask(permissions(grant(allow(a), default=""))), REFUSED, YES),
        ("default first", ask(permissions(grant(DENY, allow(a), default=""))), REFUSED, YES),
        (
            "rule in a partition, then one without: without",
            ask(permissions(grant(allow(in_p1), allow(a)))),
            NO,
            YES,
        ),
        (
            "rule in a partition, then one without: in it",
            ask(permissions(grant(allow(in_p1), allow(a))), partitions=("p1",)),
            YES,
            YES,
        ),
        (
            "in a partition that no rule names",
            ask(permissions(grant(allow(a))), partitions=("p1",)),
            NO,
            NO,
        ),
        (
            "deny in a partition, then everything: in another",
            ask(
                permissions(
                    grant(deny(in_p1), allow(criteria("publish", "*", partitions=("*",)))),
                ),
                partitions=("p2",),
            ),
            NO,
            NO,
        ),
        (
            "an empty topic",
            ask(permissions(grant(allow(criteria("publish", "", "rt/a"))))),
            REFUSED,
            CRASHES,
        ),
        (
            "an empty topic behind the one that matches",
            ask(permissions(grant(allow(criteria("publish", "rt/a", ""))))),
            REFUSED,
            YES,
        ),
        (
            "an empty topic in a rule behind the one that matches",
            ask(permissions(grant(allow(a), allow(criteria("subscribe", "", "rt/b"))))),
            REFUSED,
            YES,
            "",
            CRASHES,
        ),
        ("denied writer, then allowed reader", ask(one_way, "rt/s", "subscribe"), YES, NO, "", YES),
        (
            "relaying denied, then reading allowed: reading",
            ask(
                permissions(
                    grant(deny(criteria("relay", "rt/a")), allow(criteria("subscribe", "rt/a")))
                ),
                verb="subscribe",
            ),
            PEER_DENIES,
            YES,
        ),
        (
            "deny without partitions, then everything: in a partition",
            ask(denied_default, partitions=("p2",), governed=readable),
            NO,
            YES,
        ),
        (
            "deny without partitions, then everything: in none",
            ask(denied_default, governed=readable),
            NO,
            NO,
        ),
        (
            "deny in a partition, then everything: in another, topics free",
            ask(denied_in_p1, partitions=("p2",), governed=readable),
            NO,
            YES,
        ),
        (
            "deny in a partition, then everything: there and in another, topics free",
            ask(denied_in_p1, partitions=("p1", "p2"), governed=readable),
            NO,
            NO,
        ),
        ("a grant without a name", ask(permissions(grant(allow(a), name=""))), REFUSED, YES),
        ("an unknown element", ask(permissions(grant(allow(a), "<extra/>"))), REFUSED, REFUSED),
        ("no topics", ask(permissions(grant(allow("<publish><topics/></publish>")))), REFUSED, NO),
    ]
    return [Row(*row) for row in table]


def grants(now: datetime) -> list[Row]:
    """Which grant is taken: subjects, domains and time."""
    a = allow(criteria("publish", "rt/a"))

    def moment(hours: float, offset: str = "Z") -> str:
        shift = timedelta(hours=float(offset[:3])) if offset != "Z" else timedelta()
        return (now + timedelta(hours=hours) + shift).strftime(f"%Y-%m-%dT%H:%M:%S{offset}")

    def only(begin: str, end: str) -> bytes:
        return permissions(grant(a, begin=begin, end=end))

    hour = moment(-1), moment(1)
    past = {"begin": moment(-48), "end": moment(-24)}
    return [
        Row(
            "subject with spaces",
            ask(permissions(grant(a, subject="CN = /t"))),
            REFUSED,
            REFUSED,
            YES,
            YES,
        ),
        Row("subject after a slash", ask(permissions(grant(a, subject="/CN=/t"))), REFUSED, YES),
        Row(
            "subject with more parts", ask(permissions(grant(a, subject="CN=/t,O=x"))), REFUSED, YES
        ),
        Row("another subject", ask(permissions(grant(a, subject="CN=/u"))), REFUSED, REFUSED),
        Row(
            "a name with more parts",
            ask(permissions(grant(a, subject="CN=/t/admin"))),
            REFUSED,
            YES,
        ),
        Row("valid", ask(only(moment(-48), moment(48))), YES, YES),
        Row("expired", ask(only(**past)), REFUSED, REFUSED),
        Row("not yet valid", ask(only(moment(24), moment(48))), REFUSED, REFUSED),
        Row(
            "an expired grant, then a valid one",
            ask(permissions(grant(a, **past), grant(a))),
            YES,
            REFUSED,
        ),
        Row(
            "a grant for another domain, then one for this",
            ask(
                permissions(
                    grant(allow(criteria("publish", "rt/b"), domains="<id>7</id>")), grant(a)
                )
            ),
            NO,
            REFUSED,
        ),
        Row("this hour in UTC, host in UTC", ask(only(*hour)), YES, YES),
        Row(
            "this hour in UTC, host in Los Angeles",
            ask(only(*hour), zone="America/Los_Angeles"),
            REFUSED,
            YES,
        ),
        Row("this hour in UTC, host in Tokyo", ask(only(*hour), zone="Asia/Tokyo"), REFUSED, YES),
        Row(
            "this hour with its offset, host in UTC",
            ask(only(moment(-1, "+09:00"), moment(1, "+09:00"))),
            REFUSED,
            YES,
        ),
        Row(
            "expired by its offset, host in UTC",
            ask(only(moment(-30, "+09:00"), moment(-1, "+09:00"))),
            YES,
            REFUSED,
        ),
        Row("a date only", ask(only("2020-01-01", "2037-01-01")), YES, REFUSED),
        Row(
            "until the year 9999",
            ask(only("2020-01-01T00:00:00Z", "9999-12-31T23:59:59Z")),
            YES,
            REFUSED,
        ),
        Row(
            "an offset behind Z",
            ask(permissions(grant(a, end=f"{(now + timedelta(days=9)):%Y-%m-%dT%H:%M:%S}Z12:00"))),
            YES,
            YES,
        ),
    ]


def subjects() -> list[Row]:
    """How the subject of a grant is compared, by the text of an identity's subject."""
    a = allow(criteria("publish", "rt/a"))
    pair, street, beyond = "CN=/t,OU=y+O=x", "street=s,CN=/t", "CN=/größe"
    table = [
        ('CN="/t', "CN=/t", REFUSED, REFUSED, YES),
        ("O=", "CN=/t", REFUSED, REFUSED, YES),
        ("a,O=", "CN=/t", REFUSED, REFUSED, YES),
        ("CN=/t,X=", "CN=/t,O=x", REFUSED, REFUSED, YES),
        ("CN=/t,X=", "CN=/t", REFUSED, YES, ""),
        (pair, pair, YES, YES, ""),
        ("CN=/t,O=x+OU=y", pair, REFUSED, REFUSED, ""),
        (street, street, YES, YES, ""),
        ("STREET=s,CN=/t", street, REFUSED, REFUSED, ""),
        (beyond, beyond, YES, REFUSED, ""),
        ("CN=/gr\\C3\\B6\\C3\\9Fe", beyond, REFUSED, YES, ""),
        ("CN=a\\,b", "CN=a\\, b", REFUSED, REFUSED, "", YES),
        ("CN=a\\,  b", "CN=a\\, b", YES, REFUSED, REFUSED, YES),
        ("CN=/t, ", "CN=/t,O=x", CRASHES, REFUSED, REFUSED),
    ]
    return [
        Row(
            f"a grant for {granted}, the identity {subject}",
            ask(permissions(grant(a, subject=granted)), subject=subject),
            fast,
            cyclone,
            *later,
        )
        for granted, subject, fast, cyclone, *later in table
    ]


def missing() -> list[Row]:
    """Documents that lack what the vendors' parsers take for granted."""
    granted = permissions(grant(allow(criteria("publish", "rt/a"))))
    nameless = governance(domain_rule(topic_rule(expression="")))
    endless = permissions(grant(allow(criteria("publish", "rt/a")), end=""))
    return [
        Row(
            "a topic rule without text",
            ask(granted, governed=nameless),
            CRASHES,
            CRASHES,
            fast_3=REFUSED,
            fast_2_6=REFUSED,
        ),
        Row("no end of validity", ask(endless), CRASHES, REFUSED, fast_3=REFUSED, fast_2_6=REFUSED),
        Row(
            "nothing in permissions",
            ask(b"<dds></dds>"),
            CRASHES,
            REFUSED,
            fast_3=REFUSED,
            fast_2_6=REFUSED,
        ),
    ]


def names() -> list[Row]:
    """Names of topics at the limit."""
    everything = permissions(grant(allow(criteria("publish", "*"))))
    unclosed = permissions(grant(allow(criteria("publish", "rt/[z-"))))
    listed = [f"rt/{'long_' * 8}{number}" for number in range(975)]
    large = permissions(grant(allow(criteria("publish", *listed, "rt/a"))))
    assert 59_500 < len(large) < 59_800, "signed, it is just below the limit"
    return [
        Row("the last name of permissions of 60 KB", ask(large), YES, YES),
        Row("a name of 251 characters", ask(everything, f"rt/{'n' * 248}"), YES, YES),
        Row("a name of 252 characters", ask(everything, f"rt/{'n' * 249}"), PEER_DENIES, YES),
        Row("a set that ends in an open range", ask(unclosed, "rt/[z-"), NO, INVALID),
        Row("a hyphen in a name", ask(everything, "rt/a-b"), YES, INVALID, "", YES),
        Row("a # in a name", ask(everything, "rt/a#b"), YES, INVALID),
    ]


def forms() -> list[Row]:
    """XML as the vendors' parsers read it: a text of permissions in place of another."""
    a = "<topic>rt/a</topic>"
    table = [
        ("two hyphens in a comment", "<dds>", "<!-- ---- topics ---- --><dds>", YES, YES),
        ("a comment before a number", ">42<", "><!-- c -->42<", REFUSED, YES),
        ("a comment behind a number", ">42<", ">42<!-- c --><", YES, YES),
        ("a comment before a topic", a, "<topic><!-- c -->rt/a</topic>", YES, YES),
        ("a processing instruction", "<grant", "<?pi?><grant", REFUSED, YES),
        ("CDATA", a, "<topic><![CDATA[rt/a]]></topic>", YES, YES),
        ("CDATA behind a line break", a, "<topic>\n<![CDATA[rt/a]]></topic>", YES, YES),
        ("CDATA behind text", a, "<topic>r<![CDATA[t/a]]></topic>", NO, YES),
        ("a lone &", a, f"<topic>rt/x&y</topic>{a}", YES, REFUSED),
        ("an unknown entity", a, f"<topic>rt/&x;</topic>{a}", YES, REFUSED),
        ("a reference to NUL", a, "<topic>rt/a&#0;b</topic>", YES, YES),
        ("a control character", a, f"<topic>rt/\x01</topic>{a}", YES, YES),
        ("]]> in a text", a, f"<topic>rt/]]></topic>{a}", YES, YES),
        ("a second root", "</dds>", "</dds><dds/>", YES, REFUSED),
        ("text before the root", "<dds>", "text <dds>", YES, REFUSED),
        ("text behind the root", "</dds>", "</dds> text", REFUSED, REFUSED),
        (
            "a prefix that is not declared",
            "<dds>",
            '<dds xsi:noNamespaceSchemaLocation="x">',
            YES,
            YES,
        ),
        ("an unknown encoding", "UTF-8", "nothing-8", YES, YES),
        ("a NUL at the end", "</dds>", "</dds>\0", YES, REFUSED),
        ("a date over two lines", "-01T", "-\n01T", YES, REFUSED),
        ("a document type", "<dds>", "<!DOCTYPE dds><dds>", YES, YES),
        ("a blank in a closing tag", "</topic>", "</topic >", YES, REFUSED),
    ]
    document = permissions(grant(allow(criteria("publish", "rt/a")))).decode()
    return [
        Row(name, ask(document.replace(old, new).encode()), fast, cyclone)
        for name, old, new, fast, cyclone in table
    ]


def domains() -> list[Row]:
    """Domain ids and ranges, in permissions and in governance."""

    def allowed(text: str) -> Case:
        return ask(permissions(grant(allow(criteria("publish", "rt/a"), domains=text))))

    def governed(text: str) -> Case:
        document = permissions(grant(allow(criteria("publish", "rt/a"))))
        return ask(document, governed=governance(domain_rule(domains=text)))

    def digits(text: str) -> Case:
        document = permissions(grant(allow(criteria("publish", "rt/a"), domains=text)))
        return ask(document, domain=0)

    low, high = "<id_range><min>40</min></id_range>", "<id_range><max>50</max></id_range>"
    just = "<id_range><min>42</min></id_range>"
    both = "<id_range><min>40</min><max>50</max></id_range>"
    return [
        Row("permissions for 40 to 50", allowed(both), YES, YES),
        Row("permissions from 40 on", allowed(low), PEER_DENIES, REFUSED),
        Row("permissions from 42 on", allowed(just), YES, YES),
        Row("permissions up to 50", allowed(high), YES, CRASHES),
        Row("permissions for 0x", digits("<id>0x</id>"), YES, YES),
        Row("permissions for 0xg", digits("<id>0xg</id>"), YES, REFUSED),
        Row("governance for 40 to 50", governed(both), YES, YES),
        Row("governance from 40 on", governed(low), NO, REFUSED),
        Row("governance from 42 on", governed(just), YES, YES),
        Row("governance up to 50", governed(high), YES, REFUSED),
        Row("governance for another domain", governed("<id>7</id>"), NO, REFUSED),
    ]


def governances() -> list[Row]:
    """Topic rules, and what the domain rule says about joining."""
    a = permissions(grant(allow(criteria("publish", "rt/a"))))
    b = permissions(grant(allow(criteria("publish", "rt/b"))))
    nothing = permissions(grant(deny(criteria("publish", "rt/x"))))

    def topics(*rules: str, join: bool = True) -> bytes:
        return governance(domain_rule("".join(rules), join=join))

    elsewhere = permissions(grant(allow(criteria("publish", "rt/x"), domains="<id>7</id>")))
    high = b"<domains><id_range><max>50</max></id_range></domains>"
    up_to = a.replace(b"<domains><id>42</id></domains>", high)
    no_rule = permissions(grant(), grant(allow(criteria("publish", "rt/a"))))

    def unprotected(*, read: bool = False, write: bool = False) -> str:
        rule = topic_rule(read=read, write=write, data="NONE")
        return rule.replace("<metadata_protection_kind>ENCRYPT", "<metadata_protection_kind>NONE")

    free = unprotected()
    opened = topics(topic_rule("rt/open", read=False, write=False), topic_rule())
    shut = topics(topic_rule(), topic_rule("rt/open", read=False, write=False))
    some = topics(topic_rule("rt/open", read=False, write=False), topic_rule("rt/a"))
    return [
        Row("an open topic", ask(b, "rt/open", governed=opened), YES, YES),
        Row("an open topic behind a rule for all", ask(b, "rt/open", governed=shut), NO, NO),
        Row("a topic without a rule", ask(a, "rt/z", governed=some), NO, NO),
        # With a topic that is free, Cyclone DDS starts without a look at the rules: its peers look.
        Row(
            "a free topic, domains up to 50",
            ask(up_to, "rt/open", governed=opened),
            YES,
            PEERS_CRASH,
        ),
        Row("domains up to 50 beside a free topic", ask(up_to, governed=opened), YES, CRASHES),
        Row(
            "a free topic, a rule without domains",
            ask(up_to.replace(high, b""), "rt/open", governed=opened),
            REFUSED,
            PEERS_CRASH,
        ),
        Row(
            "a free topic, an empty default",
            ask(elsewhere.replace(b">DENY<", b"><"), "rt/open", governed=opened),
            REFUSED,
            PEERS_CRASH,
        ),
        Row("a topic named *", ask(b, "*", governed=opened), YES, INVALID),
        Row("a topic named rt/op*", ask(b, "rt/op*", governed=opened), YES, INVALID),
        Row(
            "refused by peers, a topic without protection",
            ask(elsewhere, governed=topics(free)),
            PEER_DENIES,
            YES,
        ),
        # Peers ask for rights in the participant's own direction alone.
        Row(
            "refused by peers, an unprotected topic that all may write",
            ask(elsewhere, governed=topics(unprotected(read=True))),
            PEER_DENIES,
            YES,
        ),
        Row(
            "refused by peers, an unprotected topic that all may read",
            ask(elsewhere, verb="subscribe", governed=topics(unprotected(write=True))),
            PEER_DENIES,
            YES,
        ),
        Row(
            "refused by peers, an unprotected topic that all may read: writing",
            ask(elsewhere, governed=topics(unprotected(write=True))),
            NO,
            NO,
        ),
        Row(
            "a grant without rules before one for this, an unprotected topic",
            ask(no_rule, verb="subscribe", governed=topics(unprotected(write=True))),
            REFUSED,
            YES,
        ),
        Row(
            "refused by peers, a topic with protection",
            ask(
                elsewhere,
                governed=topics(free, join=True).replace(
                    b"data_protection_kind>NONE", b"data_protection_kind>SIGN"
                ),
            ),
            PEER_DENIES,
            PEER_DENIES,
        ),
        *(
            Row(
                f"refused by peers, a topic without protection, {kind} empty",
                ask(
                    elsewhere,
                    governed=topics(free).replace(f"{kind}>NONE".encode(), f"{kind}>".encode()),
                ),
                REFUSED,
                PEER_DENIES,
            )
            for kind in ("rtps_protection_kind", "metadata_protection_kind", "data_protection_kind")
        ),
        Row("no topic rules", ask(a, governed=topics()), REFUSED, REFUSED),
        Row(
            "strangers, and messages signed",
            ask(a, governed=governance(domain_rule(strangers=True, rtps="SIGN"))),
            YES,
            YES,
            REFUSED,
            fast_2_6=REFUSED,
        ),
        Row(
            "joining free, no allow rule",
            ask(
                nothing,
                "rt/open",
                governed=topics(
                    topic_rule("rt/open", read=False, write=False), topic_rule(), join=False
                ),
            ),
            REFUSED,
            YES,
        ),
        Row(
            "joining free, no allow rule: a closed topic",
            ask(nothing, governed=topics(topic_rule(), join=False)),
            REFUSED,
            NO,
        ),
    ]


def rows() -> list[Row]:
    """All rows; those about time are made for this moment."""
    made: list[Callable[[], list[Row]]] = [
        matching, rules, domains, governances, subjects, missing, names, forms,
    ]  # fmt: skip
    return [row for part in made for row in part()] + grants(datetime.now(UTC))
