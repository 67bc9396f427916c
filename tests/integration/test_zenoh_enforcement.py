"""Any access control lets through what sros says: real routers with ALLOW, DENY and subjects."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from tests.support.children import LONG
from tests.support.harness import sros

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh


def test_real_routers_decide_as_sros_says(tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks").ok()
    for each in ("/router", "/talker", "/listener"):
        sros("create_enclave", tmp_path / "ks", each).ok()
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    from tests.integration.zenoh_enforcement import worlds
    from tests.integration.zenoh_world import observed_apart

    observed = observed_apart(lambda: worlds(tmp_path / "ks", port, 40 if LONG else 4))
    assert [each for world in observed for each in world["different"]] == []
    happened, decisions = (
        sum(each[what] for each in observed) for what in ("happened", "decisions")
    )
    assert 0.25 < happened / decisions < 0.85
