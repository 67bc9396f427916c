"""What security costs, measured over a real DDS; short, so that numbers are plausible only."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.demo.cost import Effort
from sros_tool.demo.program import DemoOptions, run_demo
from sros_tool.demo.scenarios.governance import GOVERNANCE
from tests.integration.enforcing import BACKENDS, enforcing_backend

pytestmark = pytest.mark.dds


@pytest.mark.parametrize("backend", BACKENDS)
def test_each_kind_is_measured_by_the_same_program(backend: str, tmp_path: Path) -> None:
    enforcing_backend(backend)
    options = DemoOptions(
        backend=backend,
        scenarios=(GOVERNANCE,),
        only=("under none",),
        effort=Effort((64, 65536), 0.05, 1),
        keep=tmp_path / "kept",
    )
    result = run_demo(options, datetime.now(UTC), lambda _line: None)
    assert result.as_expected
    cost = result.cost
    assert cost is not None
    assert cost.kinds == ("unsecured", "none", "sign", "encrypt")
    for kind in cost.kinds:
        assert 0.01 < cost.first[kind] < 20
        small, large = cost.of(kind, 64), cost.of(kind, 65536)
        assert 1e-6 < small.latency < 0.5
        assert small.rate > 20
        assert large.rate * 65536 > small.rate * 64
