"""Who may sign and which CAs are taken, by vendor, as the rows have it from the vendors."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography import x509

from sros_tool.dds.decision.access import Outcome
from sros_tool.dds.decision.vendors import TESTED, Vendor
from sros_tool.explain.answer import Evaluator, ask
from sros_tool.keystore.participant import JoinContext, load_enclave
from tests.dds.decision_documents import allow, governance, grant, permissions, publish, subscribe
from tests.dds.signer_rows import (
    CRASHED,
    NOW,
    REFUSED,
    UNMATCHED,
    YES,
    Made,
    Row,
    rows,
    write_enclave,
)
from tests.support.long_form import some

OUTCOMES = {
    YES: Outcome.ALLOWED,
    REFUSED: Outcome.REFUSED,
    UNMATCHED: Outcome.PEER_DENIES,
    CRASHED: Outcome.CRASHES,
}


@pytest.mark.parametrize("row", some(rows(), 32), ids=lambda row: row.name)
def test_each_vendor(row: Row, tmp_path: Path) -> None:
    granted = permissions(grant(allow(publish("*"), subscribe("*"))))
    write_enclave(row, tmp_path / "t", "CN=/t", governance(), granted)
    material = load_enclave("/t", tmp_path / "t", moment=NOW)
    for vendor in TESTED:
        answer = row.answer(vendor)
        problems = [str(each) for each in material.problems(vendor.traits)]
        assert (not problems) == (answer == YES), (vendor, problems)
        said = Evaluator(vendor, material, JoinContext(42, NOW)).answer(ask("join"))
        assert said.outcome is OUTCOMES[answer], (vendor, said)


@pytest.mark.parametrize("granted", ["CN=/t", ""])
def test_an_empty_subject_crashes_fast_dds_before_it_reads_a_document(
    granted: str, tmp_path: Path
) -> None:
    document = permissions(grant(allow(publish("*"), subscribe("*")), subject=granted))
    made = Row("", Made(), "", "", "")
    write_enclave(made, tmp_path / "t", x509.Name([]), governance(), document)
    material = load_enclave("/t", tmp_path / "t", moment=NOW)
    for vendor in (Vendor.FAST, Vendor.FAST_2_9):
        said = Evaluator(vendor, material, JoinContext(42, NOW)).answer(ask("join"))
        assert said.outcome is Outcome.CRASHES, said
