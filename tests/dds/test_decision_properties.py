"""What holds of the decisions of every vendor, whatever the documents."""

from __future__ import annotations

from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from sros_tool.dds.decision.access import (
    _REASONS,
    Access,
    Decision,
    GovernedDomain,
    Outcome,
    Refusal,
)
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Criteria, Permissions, Rule
from tests.dds.decision_documents import NOW
from tests.dds.drawn_documents import Case, cases, documents
from tests.support.children import LONG

LETTERS = st.sampled_from(["rt/a", "rt/b", "rt/*", "rt/[ab]"])


def decisions(vendor: Vendor, case: Case) -> list[Decision]:
    access = case.access(vendor)
    if isinstance(access, Refusal):
        return [access.decision() for _ in case.questions]
    return [access.decide(*question) for question in case.questions]


@given(cases(), st.sampled_from(Vendor))
def test_every_question_has_an_answer_with_its_reason(case: Case, vendor: Vendor) -> None:
    for answer in decisions(vendor, case):
        assert answer.reason in _REASONS
        assert answer.text.startswith(vendor.title)
        assert answer.text.endswith(".")
        if answer.reason in ("allow-rule", "deny-rule") and answer.expression is not None:
            assert answer.rule is not None
            assert answer.grant is not None


@given(cases(portable=True))
def test_vendors_agree_within_the_portable_profile(case: Case) -> None:
    answers = {vendor: decisions(vendor, case) for vendor in Vendor}
    outcomes = {vendor: [each.outcome for each in found] for vendor, found in answers.items()}
    assert all(found == outcomes[Vendor.STANDARD] for found in outcomes.values())


def test_portable_cases_are_worth_asking() -> None:
    outcomes = [
        answer.outcome for case in documents(3, 300) for answer in decisions(Vendor.STANDARD, case)
    ]
    assert {Outcome.ALLOWED, Outcome.DENIED, Outcome.REFUSED} <= set(outcomes)


@given(cases(), st.sampled_from(Vendor), LETTERS, st.booleans())
def test_an_allow_rule_at_the_end_takes_no_right_away(
    case: Case, vendor: Vendor, topic: str, publish: bool
) -> None:
    governance = read_governance_as(vendor, case.governance_xml)
    permissions = read_permissions_as(vendor, case.permissions_xml)
    if isinstance(governance, Refusal) or isinstance(permissions, Refusal):
        return
    criteria = (Criteria((topic,), ("*",)),)
    rule = Rule(
        True,
        DomainSet.of((case.domain, case.domain)),
        publish=criteria if publish else (),
        subscribe=() if publish else criteria,
    )
    more = Permissions(
        tuple(each._replace(rules=(*each.rules, rule)) for each in permissions.grants)
    )
    governed = GovernedDomain(vendor, governance, case.domain)
    for question in case.questions:
        before, after = (
            Access(governed, each, case.subject, moment=NOW, zone=ZoneInfo(case.zone)).decide(
                *question
            )
            for each in (permissions, more)
        )
        assert after.outcome.ok or not before.outcome.ok


@pytest.mark.parametrize("document", ["permissions", "governance"])
def test_the_standard_reads_what_its_schema_allows(document: str) -> None:
    path = Path(__file__).parent.parent / "schemas" / f"dds_{document}.xsd"
    schema = etree.XMLSchema(etree.parse(path, etree.XMLParser(no_network=True)))
    seen = set()
    for case in documents(7, 5000 if LONG else 300):
        xml = case.permissions_xml if document == "permissions" else case.governance_xml
        read = read_permissions_as if document == "permissions" else read_governance_as
        if b"<!DOCTYPE" in xml:
            continue  # sros takes none
        try:
            root = etree.fromstring(xml)
        except etree.XMLSyntaxError:
            assert isinstance(read(Vendor.STANDARD, xml), Refusal)
            continue
        if any(not grant.xpath("allow_rule|deny_rule") for grant in root.iter("grant")):
            continue  # the schema in use here asks for a rule where that of the standard does not
        if any(len(each.text or "") > 9 for each in root.iter("id")):
            continue  # sros reads no such numbers
        for moment in (*root.iter("not_before"), *root.iter("not_after")):
            moment.text = (moment.text or "").strip()  # libxml2 forgets to collapse blanks
        valid = schema.validate(root)
        seen.add(valid)
        assert valid == (not isinstance(read(Vendor.STANDARD, xml), Refusal)), xml
    assert seen == {True, False}
