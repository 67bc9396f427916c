"""What protection costs, measured over a real DDS; short, so that figures are plausible only."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.protecting import Effort, measure_protection
from tests.integration.enforcing import BACKENDS, enforcing_backend
from tests.support.long_form import sometimes

pytestmark = pytest.mark.dds


@sometimes("what protection costs")
@pytest.mark.parametrize("backend", BACKENDS)
def test_each_kind_is_measured_by_the_same_program(backend: str, tmp_path: Path) -> None:
    enforcing_backend(backend)
    measured = measure_protection(tmp_path, backend, Effort((64, 65536), 0.05, 1))
    assert list(measured) == ["unsecured", "none", "sign", "encrypt"]
    for exchange in measured.values():
        assert 0.01 < exchange.first < 20
        assert 1e-6 < exchange.latency[64] < 0.5
        assert exchange.rate[64] > 20
        assert exchange.rate[65536] * 65536 > exchange.rate[64] * 64
