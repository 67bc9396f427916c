"""Who may sign and which CAs are taken, by vendor, as the rows have it from the vendors."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.explain.evaluator import Evaluator
from sros_tool.explain.question import ask
from sros_tool.keystore.participant import JoinContext, load_enclave
from tests.dds.decision_documents import allow, governance, grant, permissions, publish, subscribe
from tests.dds.signer_rows import NOW, YES, Row, rows, write_enclave


@pytest.mark.parametrize("row", rows(), ids=lambda row: row.name)
def test_each_vendor(row: Row, tmp_path: Path) -> None:
    granted = permissions(grant(allow(publish("*"), subscribe("*"))))
    write_enclave(row, tmp_path / "t", "CN=/t", governance(), granted)
    material = load_enclave("/t", tmp_path / "t", at=NOW)
    expected = {
        Vendor.FAST_2_9: row.fast,
        Vendor.FAST: row.later,
        Vendor.CYCLONE: row.cyclone,
    }
    for vendor, answer in expected.items():
        problems = [str(each) for each in material.problems(vendor.traits)]
        assert (not problems) == (answer == YES), (vendor, problems)
        said = Evaluator(vendor, material, JoinContext(42, NOW)).answer(ask("join"))
        assert said.allowed == (answer == YES), (vendor, said)
