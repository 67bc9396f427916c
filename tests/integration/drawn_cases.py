"""Signed documents and questions drawn by hypothesis, from few names so that much of it meets.

The documents are written as XML text, since vendors differ in how they read it: besides what sros
writes itself there are orders, spaces, dates, subjects and values that no careful author would use.
"""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

from hypothesis import strategies as st

from tests.dds.decision_documents import allow, criteria, deny, grant, permissions, topic_rule
from tests.dds.xml_forms import GOVERNANCE, PERMISSIONS
from tests.integration.vendor_oracle import Case, Question
from tests.integration.vendor_rows import domain_rule, governance

Text = st.SearchStrategy[str]

HERE, ELSEWHERE = 42, 7
SUBJECTS = (
    "CN=/t", "CN=/t", "CN=/t", "CN=/t,O=x", "OU=1f,CN=/t", "CN=/t,OU=y+O=x", "street=s,CN=/t",
    "emailAddress=a,CN=/t",
)  # fmt: skip
ZONES = ("UTC", "UTC", "Asia/Tokyo", "America/Los_Angeles", "Europe/Berlin", "Asia/Kolkata")

NAMES = ("rt/a", "rt/b", "rt/ab", "rt/a/b", "rt/c", "rq/aRequest", "rt/]", "rt/-")
EXPRESSIONS = (
    *NAMES, "*", "rt/*", "rt/?", "rt/a*", "*/b", "?t/a", "rt/[ab]", "rt/[!ab]", "rt/[a-c]", "rt/??",
    "rt/*b", "rt?a", "r*a", "**", "rt/*/*", "rq/*Request",
)  # fmt: skip
ODD_EXPRESSIONS = (
    "rt/[^a]", "rt/[a", "rt/[]a]", "rt/[[:alpha:]]", "rt/[ab]b", "rt[!x]a", "rt[/]a", "rt/[!a-b]",
    "rt/[b-a]", "rt/[a-]", "rt/[-a]", "rt/\\a", " rt/a ", "rt/a]", "rt/[a]*", "[*", "rt/[!]]",
    "rt/[c-a]*", "rt/A", "rt/[]]", "rt/[!]a]", "rt/[]-a]", "rt/[a\\]]", "rt/[?]", "rt/[*]",
    "rt/[z-", "rt/[a-", "rt/[!a-", "rt/[a-b", "rt/[[.a.]b]", "rt/[[=a=]b]", "rt/[[.a.]-c]",
    "rt/[[.",    "rt/[[:x:]a]", "rt/[a[:x:]]", "rt/[[.ab.]b]",
)  # fmt: skip
ODD_NAMES = (
    "rt/*", "rt/[ab]", "*", "rt/a b", "rt/[a", "rt/\\a", "rt/[z-",
    *(f"rt/{'n' * n}" for n in (248, 249)),
)  # fmt: skip
PARTITIONS = ((), (), ("p1",), ("p2",), ("p1", "p2"), ("*",), ("",), ("p*",), ("p?", "q"))
ASKED_PARTITIONS = ((), (), ("p1",), ("p2",), ("p1", "p2"), ("",), ("q",), ("p*",), ("p1", ""))
DOMAINS = (
    "<id>42</id>", "<id>42</id>", "<id>42</id>", "<id>7</id>", "<id>7</id><id>42</id>",
    "<id_range><min>40</min><max>50</max></id_range>",
    "<id_range><min>43</min><max>50</max></id_range>",
    "<id>7</id><id_range><min>0</min><max>230</max></id_range>",
)  # fmt: skip
ODD_DOMAINS = (
    "<id_range><min>42</min></id_range>",
    "<id_range><min>40</min></id_range>",
    "<id_range><max>50</max></id_range>",
    "<id_range><max>40</max></id_range>",
    "<id_range><min>50</min><max>40</max></id_range>",
    "<id> 42 </id>",
    "<id>042</id>",
    "<id>231</id><id>42</id>",
    "<id>230</id><id>42</id>",
    "<id>x</id>",
    "<id/>",
    "",
    "<id>-1</id>",
    "<id>42x</id>",
    "<id_range/>",
    "<id>+42</id>",
    "<id>0x2a</id>",
    "<id_range><max>50</max><min>40</min></id_range>",
    "<id>4294967338</id>",
    "<id>1000</id><id>42</id>",
)


@st.composite
def moments(draw: st.DrawFn, now: datetime) -> tuple[str, str]:
    """Two dates, often not far from now, in the forms of XML."""
    return draw(_moment(now, (-2000, -20, -20, -5, -1, 1))), draw(
        _moment(now, (2000, 20, 20, 5, 1, -1))
    )


@st.composite
def _moment(draw: st.DrawFn, now: datetime, hours: tuple[int, ...]) -> str:
    at = now + timedelta(hours=draw(st.sampled_from(hours)), minutes=20)
    offset = draw(st.sampled_from(("", "Z", "Z", "+09:00", "-08:00", "+05:30", "+00:00")))
    if offset not in ("", "Z"):
        hour, minute = (int(part) for part in offset.split(":"))
        at = at.astimezone(timezone(timedelta(hours=hour, minutes=minute)))
    fraction = draw(st.sampled_from(("", "", "", "", ".5", ".123456")))
    return f"{at:%Y-%m-%dT%H:%M:%S}{fraction}{offset}"


ODD_DATES = (
    "2030-01-01", "2030", "9999-12-31T23:59:59Z", "2400-01-01T00:00:00Z", "1969-12-31T23:59:59Z",
    "2030-02-30T00:00:00", "2030-13-01T00:00:00", "2030-01-01 00:00:00", "2030-01-01T24:00:00",
    "tomorrow", "", " 2030-01-01T00:00:00 ", "2030-01-01T00:00:00+15:00", "2030-1-1T0:0:0",
    "20300101T000000", "2030-01-01T00:00", "1970-01-01T00:00:00", "2030-01-01T00:00:60",
    "2262-04-12T00:00:00Z", "2030-01-01T00:00:00Zx", "+2030-01-01T00:00:00", "2030-01-01T00:00:00z",
)  # fmt: skip
ODD_SUBJECTS = (
    "CN = /t", "/CN=/t", "CN=/t/admin", "CN=/t, O=x", "O=x,CN=/t", "O=x, CN=/t", " CN=/t ", "cn=/t",
    "CN=/u", "", "CN=t", "CN=/t,O=x,OU=1f", "CN=/t|O=x", "OU=1f, CN=/t", "CN=/t,", "CN=/t,CN=/u",
    'CN="/t', 'CN="/t"', "O=", "a,O=", "O,=",
    "CN=/t,X=", "=CN=/t", "CN=/t,O=", "O=,CN=/t", "CN=\\/t", "CN=/t,O=x+OU=y", "CN=/t,OU=y+O=x",
    "STREET=s,CN=/t", "CN=/t,,O=x", "CN=", "CN=/t,x",
)  # fmt: skip


def odds(usual: tuple[str, ...], odd: tuple[str, ...], share: int = 8) -> Text:
    """Mostly one of ``usual``, once in ``share`` one of ``odd``."""
    return st.integers(1, share).flatmap(
        lambda number: st.sampled_from(odd if number == share else usual)
    )


@st.composite
def topics(draw: st.DrawFn) -> str:
    verb = draw(st.sampled_from(("publish", "publish", "subscribe")))
    topics = draw(st.lists(odds(EXPRESSIONS, ODD_EXPRESSIONS, 10), min_size=1, max_size=3))
    return criteria(verb, *topics, partitions=draw(st.sampled_from(PARTITIONS)))


@st.composite
def rules(draw: st.DrawFn) -> str:
    make = draw(st.sampled_from((allow, allow, deny)))
    said = draw(st.lists(topics(), min_size=1, max_size=3))
    return make(*said, domains=draw(odds(DOMAINS, ODD_DOMAINS, 30)))


@st.composite
def grants(draw: st.DrawFn, subject: str, now: datetime) -> str:
    begin, end = "2020-01-01T00:00:00Z", "2036-01-01T00:00:00Z"
    match draw(st.integers(1, 24)):
        case 1:
            end = draw(st.sampled_from(ODD_DATES))
        case 2:
            begin = draw(st.sampled_from(ODD_DATES))
        case number if number < 9:
            begin, end = draw(moments(now))
    name = draw(odds((subject,), (*ODD_SUBJECTS, "CN=/u", "CN=/u"), 6))
    return grant(
        *draw(st.lists(rules(), min_size=draw(st.sampled_from((0, 1, 1, 1))), max_size=4)),
        subject=name,
        begin=begin,
        end=end,
        name=' name="t"',
        default=draw(
            st.sampled_from(("<default>DENY</default>",) * 4 + ("<default>ALLOW</default>",))
        ),
    )


@st.composite
def governances(draw: st.DrawFn) -> bytes:
    def topic_rules() -> str:
        expressions = odds(EXPRESSIONS + ("*",) * 8, ODD_EXPRESSIONS)
        open_or_not = st.sampled_from((True, True, False))
        some = st.builds(topic_rule, expressions, read=open_or_not, write=open_or_not)
        last = draw(st.sampled_from((topic_rule("*"),) * 6 + ("",)))
        return "".join((*draw(st.lists(some, min_size=1, max_size=3)), last))

    if draw(st.integers(1, 3)) > 1:
        return governance()
    made = [
        domain_rule(
            topic_rules(),
            draw(
                odds(
                    (*DOMAINS, *("<id_range><min>0</min><max>230</max></id_range>",) * 6),
                    ODD_DOMAINS,
                )
            ),
            strangers=draw(st.sampled_from((False, False, True))),
            join=draw(st.sampled_from((True, True, False))),
            rtps=draw(st.sampled_from(("NONE", "NONE", "SIGN", "ENCRYPT"))),
        )
        for _ in range(draw(st.sampled_from((1, 1, 2))))
    ]
    return governance(*made)


# ── damage to the text ─────────────────────────────────────────────────────────────────────

PERMISSION_DAMAGE = (
    ("<default>DENY</default>", ""),
    ("<default>DENY</default>", "<default>deny</default>"),
    ("<default>DENY</default>", "<default> DENY </default>"),
    ("<default>DENY</default>", "<default/>"),
    ("<default>DENY</default>", "<default>DENY</default><default>ALLOW</default>"),
    (' name="t"', ""),
    (' name="t"', ' name=""'),
    (' name="t"', ' name="t" more="x"'),
    ("<allow_rule>", "<!-- a remark --><allow_rule>"),
    ("<allow_rule>", "<extra/><allow_rule>"),
    ("allow_rule>", "ALLOW_RULE>"),
    ("publish>", "Publish>"),
    ("topic>", "Topic>"),
    ("<topics>", "<topics><!-- a remark -->"),
    ("</topics>", "<topic/></topics>"),
    ("</topics>", "</topics><topics><topic>rt/c</topic></topics>"),
    ("<grant", "<extra/><grant"),
    ("<not_before>", "<not_before>\n  "),
    ("</validity>", "</validity><validity/>"),
    ("<topic>rt", "<topic>\n rt"),
    ("<domains>", "<domains><!-- all -->"),
    ("dds>", "DDS>"),
    ("</domains>", "</domains><relay><topics><topic>rt/r</topic></topics></relay>"),
    (
        "</topics></publish>",
        "</topics><data_tags><tag><name>n</name><value>v</value></tag></data_tags></publish>",
    ),
    ("</permissions>", "</permissions><permissions/>"),
    ("<?xml", "\n<?xml"),
    ("<?xml", "\ufeff<?xml"),
    ("UTF-8", "ISO-8859-1"),
    ("<allow_rule>", "<allow_rule><domains><id>7</id></domains>"),
    ("<publish>", "<publish><partitions><partition>p1</partition></partitions>"),
    ("</dds>", ""),
    ("<dds>", '<dds xmlns="urn:x">'),
    ("rt/a<", "rt/&#97;<"),
    ("rt/a<", "<![CDATA[rt/a]]><"),
    ("rt/a<", "rt/<!-- x -->a<"),
    ("</domains>", "</domains><publish/>"),
    ("<allow_rule>", "<allow_rule/><allow_rule>"),
    *PERMISSIONS,
)
GOVERNANCE_DAMAGE = (
    (">false<", ">FALSE<"),
    (">false<", ">0<"),
    (">true<", ">1<"),
    (">true<", "> true <"),
    (">true<", ">yes<"),
    (">NONE<", ">none<"),
    (">NONE<", "> NONE <"),
    (">NONE<", ">SOME<"),
    (">NONE<", "><"),
    ("<allow_unauthenticated_participants>false</allow_unauthenticated_participants>", ""),
    ("<enable_join_access_control>true</enable_join_access_control>", ""),
    ("<rtps_protection_kind>NONE</rtps_protection_kind>", ""),
    ("<data_protection_kind>NONE</data_protection_kind>", ""),
    ("<enable_liveliness_protection>false</enable_liveliness_protection>", ""),
    ("<topic_expression>*", "<topic_expression> *"),
    ("<topic_expression>*<", "<topic_expression><"),
    ("<topic_rule>", "<extra/><topic_rule>"),
    ("topic_rule>", "Topic_Rule>"),
    ("<domain_rule>", "<!-- x --><domain_rule>"),
    ("</topic_access_rules>", "</topic_access_rules><extra/>"),
    ("</dds>", ""),
    ("<dds>", '<dds xmlns="urn:x">'),
    ("<topic_access_rules>", "<topic_access_rules/><topic_access_rules>"),
    ("<domain_access_rules>", "<domain_access_rules><domain_rule/>"),
    (">NONE</data", ">SIGN_WITH_ORIGIN_AUTHENTICATION</data"),
    (">NONE</rtps", ">SIGN_WITH_ORIGIN_AUTHENTICATION</rtps"),
    ("<domains>", "<domains/><domains>"),
    ("<?xml", " <?xml"),
    *GOVERNANCE,
)


@st.composite
def damaged(
    draw: st.DrawFn, document: bytes, table: tuple[tuple[str, str], ...], share: int
) -> bytes:
    """The document; once in ``share`` with one thing replaced, once or everywhere."""
    if draw(st.integers(1, share)) < share:
        return document
    old, new = draw(st.sampled_from(table))
    return document.decode().replace(old, new, draw(st.sampled_from((1, -1)))).encode()


@st.composite
def cases(draw: st.DrawFn, now: datetime) -> Case:
    """A case of one to four questions; with a peer where rules speak of other domains."""
    subject = draw(st.sampled_from(SUBJECTS))
    some = draw(
        st.lists(grants(subject, now), min_size=1, max_size=draw(st.sampled_from((1, 1, 2, 3))))
    )
    granted = draw(damaged(permissions(*some), PERMISSION_DAMAGE, 4))
    governed = draw(damaged(draw(governances()), GOVERNANCE_DAMAGE, 8))
    asked = st.builds(
        Question,
        st.sampled_from(("publish", "publish", "subscribe")),
        odds(NAMES, ODD_NAMES, 20),
        st.sampled_from(ASKED_PARTITIONS),
    )
    questions = draw(st.lists(asked, min_size=1, max_size=4, unique_by=_end))
    return Case(
        governed,
        granted,
        tuple(questions),
        subject,
        draw(st.sampled_from((HERE,) * 9 + (ELSEWHERE,))),
        draw(st.sampled_from(ZONES)),
        peer=draw(st.integers(1, 6)) == 6 and not any(map(_wild, questions)),
    )


def _end(question: Question) -> tuple[str, str]:
    return question.verb, question.topic


def _wild(question: Question) -> bool:
    """Whether a peer in the same partitions would not match: wildcards never match each other."""
    return "*" in "".join(question.partitions)
