"""The decision engine against the vendors themselves: what it says is what they do.

First row by row what was found out about them, then documents drawn in two ways: such as people
write, with one oddity at most, and such as nobody would.  How many of each: $SROS_DIFFERENTIAL
(15, in the long form 2000); from which seed: $SROS_DIFFERENTIAL_SEED (1).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from datetime import UTC, datetime
from enum import Enum
from random import Random
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from sros_tool.dds.decision.access import AccessVerb, Outcome, Refusal
from sros_tool.dds.decision.vendors import CYCLONE_DDS, FAST_DDS, TESTED, Vendor, VendorTraits
from sros_tool.dds.governance import render_governance
from sros_tool.dds.permissions import Permissions, render_permissions
from sros_tool.keystore.template import load_template, template_names
from sros_tool.translate import governance_for
from tests.dds.decision_documents import access_of
from tests.dds.drawn_documents import Case as Drawn
from tests.dds.drawn_documents import documents, portable_documents
from tests.integration.drawn_cases import cases as drawn_cases
from tests.integration.fastdds import fastdds_vendor, openssl
from tests.integration.kept.replies import kept_replies
from tests.integration.vendor_oracle import (
    Case,
    Question,
    Reply,
    Workshop,
    ask_cyclone,
    ask_fastdds,
    cyclone_vendor,
    with_patience,
)
from tests.integration.vendor_rows import CRASHES, PEERS_CRASH, REFUSED, Row, rows
from tests.policy.drawn_policies import DOMAINS, EVERYTHING, portable_permissions
from tests.support.children import LONG
from tests.support.long_form import some

pytestmark = pytest.mark.dds

COUNT = int(os.environ.get("SROS_DIFFERENTIAL", "2000" if LONG else "15"))
SEED = int(os.environ.get("SROS_DIFFERENTIAL_SEED", "1"))
PORTION = 500
"""So many drawn documents are asked about within a quarter of an hour, also on a busy machine."""
Draw = Callable[[int, int, datetime], list[Case]]
Asked = tuple[list[Case], list[str], datetime]
QUESTIONS = sorted(EVERYTHING)
ASK = {fastdds_vendor(): ask_fastdds, cyclone_vendor(): ask_cyclone}


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return Workshop(tmp_path_factory.mktemp("workshop"))


@pytest.mark.parametrize("vendor", ASK)
def test_every_row_of_what_is_known(vendor: Vendor, workshop: Workshop) -> None:
    table = rows()
    replies = ask(vendor, workshop, [row.case for row in table], datetime.now(UTC))
    at = datetime.now(UTC)
    wrong = []
    for row, reply in zip(table, replies, strict=True):
        expected = answer_of(row, vendor)
        observed = reply.answers[0] if reply.end == "joined" else reply.end
        if observed != expected:
            wrong.append(f"{row.name}: {vendor.title} answers {observed}, not {expected}")
        wrong += [f"{row.name}: {text}" for text in disagreements(vendor, row.case, reply, at)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("vendor", TESTED)
def test_the_engine_says_what_the_rows_say(vendor: Vendor) -> None:
    """Where only one Fast DDS is at hand, what another was seen to do stands in the rows."""
    assert not list(contradictions(vendor))
    assert any(row.later for row in rows())


def answer_of(row: Row, vendor: Vendor) -> str:
    columns = {
        Vendor.FAST_2_6: row.fast_2_6 or row.fast,
        Vendor.FAST_2_9: row.fast,
        Vendor.FAST: row.later or row.fast,
        Vendor.FAST_3_2: row.fast_3 or row.later or row.fast,
        Vendor.FAST_3_6: row.fast_3 or row.later or row.fast,
        Vendor.CYCLONE: row.cyclone,
        Vendor.CYCLONE_11: row.cyclone_11 or row.cyclone,
    }
    return columns[vendor]


EQUIVALENT = {
    *(
        (each, "deny_partitions") for each in FAST_DDS
    ),  # the first rule that names the topic decides
    *((each, "crashes_on_empty_texts") for each in FAST_DDS),  # its reader refuses these
    *((each, "relays_count_for_readers") for each in CYCLONE_DDS),  # its reader passes over them
    *((each, "crashes_on_missing_content") for each in CYCLONE_DDS),  # its reader refuses these
    *((each, "governance_both_ways") for each in CYCLONE_DDS),  # no name of a topic has wildcards
    *((each, "trims_texts") for each in CYCLONE_DDS),  # its reader has done that
    *((each, "asks_both_directions") for each in FAST_DDS),  # a topic is not created for itself
}
"""Rules that make no difference to documents as the vendor reads them."""
NOT_OF_DOCUMENTS = {
    "product",
    "tested",
    "reader",
    "signers",
    "reads_first_authority",
    "reads_lists_of_authorities",
    "verifies_authorities",
    "verifies_policies",
    "reads_trusted_certificates",
    "ignores_unauthenticated",
    "controls_unauthenticated",
    "reads_files_as_text",
    "hashes",
    "keys",
    "reads_tokens",
    "crashes_on_empty_subject",
    "drops_expired",
    "expiry_overflows",
}
"""Rules about what is around the documents: `test_signers_on_dds`, `test_subjects_on_dds`,
`test_stranger_on_dds`, `test_broken_keystores`, `test_drawn_trust` and `test_key_on_token` tell."""


@pytest.mark.parametrize("vendor", some([*ASK], 1))
def test_some_row_tells_every_rule(vendor: Vendor, monkeypatch: pytest.MonkeyPatch) -> None:
    """With any one of its rules another, the engine would contradict what the vendor does."""
    rules = vendor.traits
    unnoticed = set()
    for name, other in others(rules):
        monkeypatch.setattr(vendor, "traits", replace(rules, **{name: other}))
        if next(contradictions(vendor), None) is None:
            unnoticed.add((vendor, name))
    monkeypatch.setattr(vendor, "traits", rules)
    assert not list(contradictions(vendor))
    assert unnoticed == {each for each in EQUIVALENT if each[0] is vendor}


def others(rules: VendorTraits) -> Iterator[tuple[str, Any]]:
    """Each rule by which vendors decide, with everything else that it could be."""
    for rule in fields(rules):
        value = getattr(rules, rule.name)
        if rule.name in NOT_OF_DOCUMENTS:
            continue
        if isinstance(value, bool):
            yield rule.name, not value
        elif isinstance(value, Enum):
            yield from ((rule.name, each) for each in type(value) if each is not value)


def contradictions(vendor: Vendor) -> Iterator[str]:
    """Yield where the engine says something else than the rows."""
    for row in rows():
        answer = answer_of(row, vendor)
        ended = answer in (REFUSED, CRASHES, PEERS_CRASH)
        reply = Reply(answer) if ended else Reply("joined", (answer,))
        at = datetime.now(UTC)
        for text in disagreements(vendor, row.case, reply, at):
            yield f"{row.name}: {text}"


def draw_sensible(count: int, number: int, now: datetime) -> list[Case]:
    """Cases as people write documents, with one oddity at most."""
    return [asked_of(each, place) for place, each in enumerate(documents(number, count, now=now))]


def asked_of(drawn: Drawn, place: int) -> Case:
    """The case that asks a library what was drawn for the engine; every sixth has a peer."""
    questions = tuple(
        Question(*asked) for asked in drawn.questions if asked[0] is not AccessVerb.JOIN
    )
    return apart(
        Case(
            drawn.governance_xml,
            drawn.permissions_xml,
            questions,
            drawn.subject,
            drawn.domain,
            drawn.zone,
            peer=place % 6 == 0,
        )
    )


def draw_odd(count: int, number: int, now: datetime) -> list[Case]:
    """So many different cases, always the same ones for a seed and a moment."""
    found: dict[Case, None] = {}

    @seed(number)
    @settings(
        max_examples=3 * count // 2,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(drawn_cases(now))
    def collect(case: Case) -> None:
        found[apart(case)] = None

    collect()
    return list(found)[:count]


def draw_portable(count: int, number: int, now: datetime) -> list[Case]:
    """Cases of the portable profile: documents, and what sros makes of drawn policies."""
    drawn = list(portable_documents(number, (count + 1) // 2, now=now))
    random = Random(number)

    @seed(number)
    @settings(
        max_examples=count,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(portable_permissions(now), st.sampled_from(template_names()))
    def collect(permissions: Permissions, template: str) -> None:
        governance = governance_for(load_template(template).protection, DOMAINS)
        asked = [(AccessVerb(verb), topic, ()) for verb, topic in random.sample(QUESTIONS, 5)]
        drawn.append(
            Drawn(
                render_governance(governance),
                render_permissions(permissions),
                permissions.grants[0].subject,
                next(iter(DOMAINS)),
                random.choice(("UTC", "Asia/Tokyo", "America/Los_Angeles")),
                tuple(asked),
            )
        )

    collect()
    return [asked_of(each, place) for place, each in enumerate(drawn[:count])]


def apart(case: Case) -> Case:
    """With a peer, one question a topic: a participant's writer would match its own reader."""
    if not case.peer:
        return case
    first = {each.topic: each for each in reversed(case.questions)}
    return replace(case, questions=tuple(first.values()))


@pytest.mark.parametrize("draw", [draw_sensible, draw_odd])
@pytest.mark.parametrize("vendor", ASK)
def test_drawn_documents(vendor: Vendor, draw: Draw, workshop: Workshop) -> None:
    wrong: list[tuple[str, Case]] = []
    replies: list[Reply] = []
    different_elsewhere = False
    other = Vendor.FAST if vendor in CYCLONE_DDS else Vendor.CYCLONE
    for start in range(0, COUNT, PORTION):
        # Dates are drawn around now, a quarter of an hour from it at least.
        now = datetime.now(UTC).replace(microsecond=0)
        drawn = draw(min(PORTION, COUNT - start), SEED + start, now)
        assert len(drawn) > 0.9 * min(PORTION, COUNT - start)
        answered = ask(vendor, workshop, drawn, now)
        replies += answered
        wrong += [
            (text, case)
            for case, reply in zip(drawn, answered, strict=True)
            for text in disagreements(vendor, case, reply, now)
        ]
        different_elsewhere |= any(
            text
            for case, reply in zip(drawn, answered, strict=True)
            for text in disagreements(other, case, reply, now)
        )
    counts = f"{len(replies)} documents, {summary(replies)}; {len(wrong)} disagreements"
    print(f"{vendor.title}: {counts}")
    assert not wrong, "\n".join(f"{text}\n{shown(case)}" for text, case in wrong[:3])
    # What is compared tells the vendors apart, so that it would also tell a wrong engine.
    assert different_elsewhere
    said = Counter(answer for reply in replies for answer in (reply.end, *reply.answers))
    assert all(said[word] > COUNT / 50 for word in ("joined", "refused", "created", "denied"))


@pytest.mark.parametrize("vendor", some([*ASK], 1))
def test_the_portable_profile_is_what_all_vendors_decide_alike(
    vendor: Vendor, workshop: Workshop
) -> None:
    """Each library is compared with the standard, so that all of them decide the same."""
    now = datetime.now(UTC).replace(microsecond=0)
    drawn = draw_portable(max(COUNT // 3, 6), SEED, now)
    replies = ask(Vendor.STANDARD, workshop, drawn, now, of=vendor)
    wrong = [
        f"{vendor.title}: {text}\n{shown(case)}"
        for case, reply in zip(drawn, replies, strict=True)
        for text in disagreements(Vendor.STANDARD, case, reply, now)
    ]
    print(f"{vendor.title}: {len(drawn)} portable, {summary(replies)}; {len(wrong)} disagreements")
    assert not wrong, "\n".join(wrong[:3])
    said = Counter(answer for reply in replies for answer in reply.answers)
    assert said["created"] + said["matched"] and said["denied"]


KEPT = (
    (Vendor.FAST_2_6, "fast-2.6.12"),
    (Vendor.FAST, "fast-2.14.6"),
    (Vendor.FAST_3_2, "fast-3.2.5"),
    (Vendor.FAST_3_6, "fast-3.6.2"),
    (Vendor.CYCLONE_11, "cyclone-11.0.1"),
)
"""Releases whose replies were kept; where one is not at hand, they are all that is known of it."""


@pytest.fixture(scope="module")
def asked_cases(workshop: Workshop) -> Asked:
    """The cases whose replies are kept, their forms, and the moment for which they were made."""
    now = datetime.now(UTC).replace(microsecond=0)
    cases = [row.case for row in rows()] + draw_sensible(15, 1, now) + draw_odd(15, 1, now)
    return cases, [workshop.form(case) for case in cases], now


@pytest.mark.parametrize(("vendor", "stack"), [kept for kept in KEPT if kept[0] not in ASK])
def test_what_a_release_that_is_not_at_hand_replied(
    vendor: Vendor, stack: str, asked_cases: Asked
) -> None:
    cases, forms, now = asked_cases
    kept = kept_replies(f"{stack}-{openssl()}", forms)
    if not any(kept):
        pytest.skip(f"no replies are kept of {vendor.title} with {openssl()}")
    wrong = [
        f"{text}\n{shown(case)}"
        for case, reply in zip(cases, kept, strict=True)
        if reply
        for text in disagreements(vendor, case, Reply(reply[0], reply[2:], reply[1]), now)
    ]
    assert not wrong, "\n".join(wrong[:3])
    assert len(cases) - kept.count(None) > 0.9 * len(cases)


def ask(
    vendor: Vendor, workshop: Workshop, asked: list[Case], at: datetime, of: Vendor | None = None
) -> list[Reply]:
    """Ask the library of a vendor, or ``of`` another one, for longer where a match is missing."""
    library = ASK[of or vendor]
    return with_patience(
        lambda some, seconds: library(workshop, some, at_once=6, seconds=seconds),
        asked,
        lambda place, reply: any(disagreements(vendor, asked[place], reply, at)),
    )


# ── comparing ──────────────────────────────────────────────────────────────────────────────

EXPECTED = {
    Outcome.ALLOWED: ("created", "matched"),
    Outcome.DENIED: ("denied", "invalid"),
    Outcome.PEER_DENIES: ("created", "unmatched"),
}


def disagreements(vendor: Vendor, case: Case, reply: Reply, at: datetime) -> Iterator[str]:
    """Where the engine says something else than the vendor did."""
    access = access_of(
        vendor,
        case.governance,
        case.permissions,
        case.subject,
        domain=case.domain,
        at=at,
        zone=ZoneInfo(case.zone),
    )
    if isinstance(access, Refusal):
        if reply.end not in ("refused", "crashed") or (reply.end == "crashed") is not (
            access.outcome is Outcome.CRASHES
        ):
            yield f"the engine says {access}, {vendor.title} {reply}"
        return
    join = access.join()
    decisions = [
        access.decide(AccessVerb(each.verb), each.topic, each.partitions) for each in case.questions
    ]
    if reply.end == "peer crashed":
        if not any(each.hits_peers for each in (join, *decisions)):
            yield f"the engine foresees no crash of the peer: {join}, {decisions}"
        return
    if reply.end == "crashed":
        if not any(
            each.outcome is Outcome.CRASHES and not each.hits_peers for each in (join, *decisions)
        ):
            yield f"the engine foresees no crash: {join}, {decisions}"
        return
    if (join.outcome is Outcome.REFUSED) is not (reply.end == "refused"):
        yield f"to join, the engine says {join}, {vendor.title} {reply}"
        return
    if reply.end != "joined":
        if reply.end != "refused":
            yield f"{vendor.title} answers {reply}"
        return
    for question, decision, answer in zip(case.questions, decisions, reply.answers, strict=True):
        # Without a peer, nobody crashes.
        expected = ("created",) if decision.hits_peers else EXPECTED.get(decision.outcome, ())
        if answer not in expected:
            yield f"to {question}, the engine says {decision}, {vendor.title} {answer}; {reply.log}"


def summary(replies: Sequence[Reply]) -> str:
    counted = Counter(answer for reply in replies for answer in reply.answers or (reply.end,))
    return ", ".join(f"{number} {word}" for word, number in sorted(counted.items()))


def shown(case: Case) -> str:
    """A case for whoever has to find out."""
    head = f"{case.subject} on domain {case.domain} in {case.zone}, peer {case.peer}"
    return f"{head}\n{case.governance!r}\n{case.permissions!r}"
