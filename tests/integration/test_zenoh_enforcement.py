"""Any access control lets through what sros says: real routers with ALLOW, DENY and subjects."""

from __future__ import annotations

import json
import os
import socket
import sys
from pathlib import Path

import pytest

from tests.support.children import LONG, run
from tests.support.harness import sros

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
WORLD = Path(__file__).with_name("zenoh_enforcement.py")


def test_real_routers_decide_as_sros_says(tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks").ok()
    for each in ("/router", "/talker", "/listener"):
        sros("create_enclave", tmp_path / "ks", each).ok()
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    done = run(
        [sys.executable, "-P", WORLD, tmp_path / "ks", port, 40 if LONG else 4],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        patience=3600.0,
    )
    worlds = json.loads(done.stdout)
    assert [each for world in worlds for each in world["different"]] == []
    happened, decisions = (sum(each[what] for each in worlds) for what in ("happened", "decisions"))
    assert 0.25 < happened / decisions < 0.85
