"""Drawn governance and permissions documents with questions, to ask real vendors and the engine.

Everything on which a decision rests is drawn: rules and their order, wildcards, sets, partitions,
domains and ranges, validity in zones, several grants, subjects, defaults, access control switched
off, and now and then one of the oddities over which vendors' parsers differ.  Dates are drawn
around the current moment, whole hours and 15 minutes off it, so that no zone and no slow machine
brings a vendor near the edge of a window.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from random import Random
from zoneinfo import ZoneInfo

from hypothesis import strategies as st

from sros_tool.dds.decision.access import Access, AccessVerb, Refusal
from sros_tool.dds.decision.vendors import Vendor
from tests.dds.decision_documents import NOW, access_of
from tests.dds.drawn_words import (
    DOMAINS,
    NEAR,
    ODD_TOPICS,
    ODDITIES,
    PARTITION_EXPRESSIONS,
    PARTITIONS,
    SETS,
    SUBJECTS,
    TOPICS,
    WILDCARDS,
    ZONES,
)
from tests.dds.xml_forms import GOVERNANCE, PERMISSIONS

FORMS = ("form",) * 20
"""So often in place of an oddity a form of XML over which parsers differ."""
Question = tuple[AccessVerb, str, tuple[str, ...]]


@dataclass(frozen=True)
class Case:
    """Two documents, whose identity asks what, where, and in which zone its host is."""

    governance_xml: bytes
    permissions_xml: bytes
    subject: str
    domain: int
    zone: str
    questions: tuple[Question, ...]

    def access(self, vendor: Vendor) -> Access | Refusal:
        """Return what a vendor makes of the documents."""
        return access_of(
            vendor,
            self.governance_xml,
            self.permissions_xml,
            self.subject,
            domain=self.domain,
            at=NOW,
            zone=ZoneInfo(self.zone),
        )


def documents(seed: int, count: int, *, now: datetime = NOW) -> Iterator[Case]:
    """``count`` cases, the same for the same ``seed`` and ``now``."""
    random = Random(seed)
    for _ in range(count):
        yield draw_case(random, now)


def portable_documents(seed: int, count: int, *, now: datetime = NOW) -> Iterator[Case]:
    """Cases of the portable profile alone, which all vendors decide alike."""
    random = Random(seed)
    for _ in range(count):
        yield draw_case(random, now, portable=True)


def cases(*, portable: bool = False, now: datetime = NOW) -> st.SearchStrategy[Case]:
    """The same as a hypothesis strategy."""
    randoms = st.randoms(use_true_random=False)
    return randoms.map(lambda random: draw_case(random, now, portable=portable))


def draw_case(random: Random, now: datetime, *, portable: bool = False) -> Case:
    """One case."""
    return _Draw(random, now, portable).case()


class _Draw:
    def __init__(self, random: Random, now: datetime, portable: bool) -> None:
        self.random = random
        self.now = now
        self.portable = portable
        self.domain = random.choice(DOMAINS) if random.random() < 0.3 else 42
        self.subject = random.choice(SUBJECTS)
        # One oddity at most, so that what decides is clear.
        self.odd = "" if portable or random.random() < 0.7 else random.choice((*ODDITIES, *FORMS))

    def chance(self, probability: float) -> bool:
        return self.random.random() < probability

    def seldom(self, probability: float) -> bool:
        """Something outside of the portable profile."""
        return not self.portable and self.chance(probability)

    def case(self) -> Case:
        grants = [self.grant(index) for index in range(self.grants())]
        return Case(
            self.governance(),
            self.document("permissions", "".join(grants)),
            self.subject,
            self.domain,
            "UTC" if self.chance(0.6) else self.random.choice(ZONES),
            tuple(self.questions()),
        )

    def grants(self) -> int:
        return self.random.choice((2, 3)) if self.seldom(0.25) else 1

    def document(self, root: str, content: str) -> bytes:
        comment = "<!-- drawn -->" if self.odd == "comment" else ""
        after = "<!-- behind -->" if self.odd == f"comment behind {root}" else ""
        text = (
            f'<?xml version="1.0" encoding="UTF-8"?>\n{comment}<dds>{comment}'
            f"<{root}>{comment}{content}</{root}>{after}</dds>\n"
        )
        if self.odd == "form":
            forms = PERMISSIONS if root == "permissions" else GOVERNANCE
            old, new = self.random.choice([form for form in forms if form[0] in text])
            text = text.replace(old, new, self.random.choice((1, -1)))
        return text.encode()

    # ── questions ──────────────────────────────────────────────────────────────────────────

    def questions(self) -> Iterator[Question]:
        yield AccessVerb.JOIN, "", ()
        for _ in range(self.random.randint(3, 7)):
            verb = self.random.choice((AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE))
            topic = self.random.choice(ODD_TOPICS if self.seldom(0.04) else TOPICS)
            few = self.random.sample(PARTITIONS, self.random.choice((1, 1, 2)))
            yield verb, topic, tuple(few) if self.seldom(0.25) else ()

    # ── governance ─────────────────────────────────────────────────────────────────────────

    def governance(self) -> bytes:
        rules = []
        if self.chance(0.15):
            rules.append(self.domain_rule(f"<id>{self.domain + 1}</id>"))
        listed = "<id>9</id>" if self.seldom(0.04) else self.domain_set(self.seldom(0.05))
        rules.append(self.domain_rule(listed))
        if self.chance(0.1):
            rules.append(self.domain_rule(f"<id>{self.domain}</id>"))
        return self.document("domain_access_rules", "".join(rules))

    def domain_rule(self, domains: str) -> str:
        rtps = self.random.choice(("NONE", "SIGN", "ENCRYPT"))
        unauthenticated = self.chance(0.1) and (rtps == "NONE" or not self.portable)
        fields = [
            f"<domains>{domains}</domains>",
            self.flag("allow_unauthenticated_participants", unauthenticated),
            self.flag("enable_join_access_control", not self.seldom(0.2)),
            "<discovery_protection_kind>ENCRYPT</discovery_protection_kind>",
            "<liveliness_protection_kind>SIGN</liveliness_protection_kind>",
            f"<rtps_protection_kind>{rtps}</rtps_protection_kind>",
        ]
        if self.odd == "governance order":
            fields[3:5] = reversed(fields[3:5])
        if self.odd == "missing kind":
            del fields[4]
        if self.odd == "unknown in governance":
            fields.append("<surprise>1</surprise>")
        rules = [self.topic_rule() for _ in range(self.random.choice((0, 0, 1, 2)))]
        if not self.seldom(0.1):
            rules.append(self.topic_rule("*"))
        if not rules and self.odd != "no topic rules":
            rules.append(self.topic_rule("rt/*"))
        listed = f"<topic_access_rules>{''.join(rules)}</topic_access_rules>"
        return f"<domain_rule>{''.join(fields)}{listed}</domain_rule>"

    def flag(self, name: str, value: bool) -> str:
        words = ("true", "1") if value else ("false", "0")
        word = "TRUE" if value and self.odd == "TRUE" else words[self.chance(0.1)]
        if self.odd == "spaced flag":
            word = f" {word} "
        return f"<{name}>{word}</{name}>"

    def topic_rule(self, expression: str = "") -> str:
        data = self.random.choice(("NONE", "SIGN", "ENCRYPT"))
        text = expression or self.expression(0.5)
        if self.odd == "spaced governance":
            text = f" {text} "
        # Without access control in one direction, Cyclone DDS checks topics no longer.
        controlled = 0.9 if self.portable else 0.75
        both = self.chance(controlled)
        return (
            f"<topic_rule><topic_expression>{text}</topic_expression>"
            + self.flag("enable_discovery_protection", self.chance(0.5))
            + self.flag("enable_liveliness_protection", self.chance(0.5))
            + self.flag("enable_read_access_control", both or self.chance(0.5))
            + self.flag("enable_write_access_control", both or self.chance(0.5))
            + "<metadata_protection_kind>NONE</metadata_protection_kind>"
            + f"<data_protection_kind>{data}</data_protection_kind></topic_rule>"
        )

    # ── permissions ────────────────────────────────────────────────────────────────────────

    def grant(self, index: int) -> str:
        count = self.random.choice((0, 0, 1, 2))
        rules = [self.rule(allow=self.chance(0.7)) for _ in range(count)]
        if self.portable or self.chance(0.8):
            rules.append(self.rule(allow=True))
        if self.portable:
            rules = sorted(rules, key=lambda rule: rule.startswith("<allow"))
        default = f"<default>{'ALLOW' if self.seldom(0.2) else 'DENY'}</default>"
        if self.odd == "no default":
            default = ""
        if self.odd == "empty default":
            default = "<default></default>"
        if self.odd == "spaced default":
            default = default.replace(">A", "> A").replace(">D", "> D")
        body = [f"<subject_name>{self.granted()}</subject_name>", self.validity(), *rules, default]
        if self.odd == "default first":
            body = [body[0], body[1], default, *rules]
        if self.odd == "validity first":
            body[:2] = reversed(body[:2])
        if self.odd == "unknown in grant":
            body.insert(2, "<surprise/>")
        if self.odd == "unknown behind default":
            body.append("<surprise/>")
        name = "" if self.odd == "no name" else f' name="g{index}"'
        name += ' id="1"' if self.odd == "attribute" else ""
        return f"<grant{name}>{''.join(body)}</grant>"

    def granted(self) -> str:
        subject = self.subject
        if self.odd == "spaced subject":
            return f" {subject} "
        if not self.seldom(0.2):
            return subject
        return self.random.choice(
            (
                subject.replace("=", " = "),
                subject.replace(",", ", "),
                ",".join(reversed(subject.split(","))),
                "/" + subject,
                subject + ",O=y",
                subject + "/more",
                subject.rpartition(",")[2],
                "CN=/other",
                "cn" + subject[2:],
                "O=x,CN=/robot",
                "CN=/u/t",
            )
        )

    def validity(self) -> str:
        begin = self.moment(-self.random.choice((24 * 800, 24 * 30)))
        end = self.moment(self.random.choice((24 * 30, 24 * 4000)))
        if self.seldom(0.3):
            if self.chance(0.5):
                begin = self.moment(self.random.choice(NEAR))
            else:
                end = self.moment(self.random.choice(NEAR))
        if self.odd == "date only":
            begin = begin[:10]
        if self.odd == "end without time":
            end = end[:10]
        if self.odd == "far end":
            end = "9999-12-31T23:59:59Z"
        if self.odd == "fraction":
            begin = begin[:19] + ".25" + begin[19:]
        if self.odd == "short date":
            begin = begin[:16] + begin[19:]
        if self.odd == "spaced date":
            begin = f" {begin} "
        return f"<validity><not_before>{begin}</not_before><not_after>{end}</not_after></validity>"

    def moment(self, hours: int) -> str:
        moment = (self.now + timedelta(hours=hours, minutes=15)).replace(second=0, microsecond=0)
        if self.seldom(0.2):
            zone = timezone(timedelta(hours=self.random.choice((-8, -5, 1, 5.5, 9, 12))))
            return moment.astimezone(zone).isoformat(timespec="seconds")
        text = moment.strftime("%Y-%m-%dT%H:%M:%S")
        return text if self.seldom(0.1) else text + "Z"

    def rule(self, *, allow: bool) -> str:
        criteria = [
            self.criteria(verb, allow)
            for verb in ("publish", "subscribe")
            for _ in range(2 if self.seldom(0.1) else 1)
            if self.chance(0.75)
        ]
        if self.portable and not allow:
            # A denial in one direction closes the topic in both on Cyclone DDS.
            listed = self.topics(False)
            criteria = [f"<{verb}>{listed}</{verb}>" for verb in ("publish", "subscribe")]
        if self.seldom(0.05):
            criteria.append(self.criteria("relay", allow))
        domains = f"<domains>{self.domain_set(self.seldom(0.12))}</domains>"
        if self.odd == "no domains":
            domains = ""
        if self.odd == "unknown in rule":
            criteria.append("<surprise/>")
        if self.odd == "empty criteria":
            criteria.append("<publish></publish>")
        tag = "allow_rule" if allow else "deny_rule"
        if self.odd == "capitals":
            tag = tag.upper()
        return f"<{tag}>{domains}{''.join(criteria)}</{tag}>"

    def criteria(self, verb: str, allow: bool) -> str:
        lists = self.topics(True)
        if self.odd == "two topics lists":
            lists += self.topics(True)
        if self.odd == "empty topics list":
            lists = "<topics></topics>"
        if self.odd == "empty topic":
            lists = lists.replace("</topics>", "<topic></topic></topics>")
        if self.odd == "unknown in criteria":
            lists += "<surprise/>"
        if self.odd == "data tags":
            lists += "<data_tags><tag><name>a</name><value>b</value></tag></data_tags>"
        if self.seldom(0.2):
            few = self.random.sample(PARTITION_EXPRESSIONS, self.random.choice((1, 1, 2)))
            named = "".join(f"<partition>{each}</partition>" for each in few)
            if self.odd == "empty partitions":
                named = ""
            lists += f"<partitions>{named}</partitions>"
        return f"<{verb}>{lists}</{verb}>"

    def topics(self, wild: bool) -> str:
        listed = [self.expression(0.45 if wild else 0) for _ in range(self.random.randint(1, 3))]
        if self.odd == "spaced topic":
            listed[0] = f" {listed[0]}\n"
        return f"<topics>{''.join(f'<topic>{each}</topic>' for each in listed)}</topics>"

    def expression(self, wild: float) -> str:
        if not self.chance(wild):
            return self.random.choice(TOPICS)
        return self.random.choice(SETS if self.seldom(0.3) else WILDCARDS)

    def domain_set(self, other: bool) -> str:
        """A set with the domain, or with ``other`` most likely without it."""
        domain = self.domain
        if self.odd == "max only":
            return f"<id_range><max>{domain + 3}</max></id_range>"
        if self.odd == "big max":
            return f"<id_range><min>{max(domain - 3, 0)}</min><max>240</max></id_range>"
        if self.odd == "hexadecimal":
            return f"<id>{domain:#x}</id>"
        if self.odd == "wide id":
            return f"<id>{2**32 + domain}</id>"
        if self.odd == "empty id":
            return "<id></id>"
        if self.odd == "spaced id":
            return f"<id> {domain} </id>"
        if other:
            return self.random.choice(
                (
                    f"<id>{domain + 1}</id>",
                    f"<id_range><min>{domain + 1}</min><max>{domain + 9}</max></id_range>",
                    f"<id_range><min>{max(domain - 2, 0)}</min></id_range>",
                    f"<id_range><min>{domain}</min></id_range>",
                )
            )
        return self.random.choice(
            (
                f"<id>{domain}</id>",
                f"<id>{domain}</id>",
                f"<id>{domain + 5}</id><id>{domain}</id>",
                f"<id_range><min>{max(domain - 3, 0)}</min><max>{domain + 3}</max></id_range>",
                f"<id_range><min>0</min><max>{max(domain, 1)}</max></id_range>",
            )
        )
