"""Several routers on real Zenoh, each on a host of its own: what passes between them, and not."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.children import run
from tests.support.harness import policy_text, publish, sros, subscribe

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
WORLD = Path(__file__).with_name("zenoh_hosts.py")
CALL = '<services request="ALLOW"><service>/add</service></services>'


POLICY = policy_text(
    {
        "/r1/talker": publish("/chatter", "/inner"),
        "/r1/client": CALL,
        "/r2/listener": subscribe("/chatter", "/inner", "/secret"),
        "/r2/near": publish("/secret", "/status", "/inner"),
        "/r2/server": CALL.replace("request", "reply"),
        "/desk": subscribe("/chatter", "/status"),
    }
)
ROUTERS = ("--router", "/r1/router=10.9.0.2:7447", "--router", "/r2/router=10.9.0.3:7447")
CROSSING = [word for name in ("/chatter", "/add", "/status") for word in ("--cross", name)]


def play(what: str, folder: Path, *options: str) -> Any:
    """Write the files of the network, and return what was observed on the hosts."""
    (folder / "policy.xml").write_text(POLICY)
    sros("create_keystore", folder / "ks", "--template", "production").ok()
    sros("generate_artifacts", "-k", folder / "ks", "-p", folder / "policy.xml").ok()
    sros("zenoh", folder / "ks", *options).ok()
    done = run(
        [sys.executable, "-P", WORLD, what, folder / "ks"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    observed = json.loads(done.stdout)
    if isinstance(observed, str):
        pytest.skip(observed)
    return observed


def test_what_may_cross_arrives_and_nothing_else(tmp_path: Path) -> None:
    observed = play("routers", tmp_path, "--endpoint", "10.9.0.1:7447", *ROUTERS, *CROSSING)
    assert observed.pop("listener") == [
        "again",
        "ignores_rules/chatter",  # a router's key has the rights of all that is behind the router
        "near/inner",
        "near/secret",
        "talker/chatter",
    ]
    assert observed.pop("ignores_rules") == [
        f"ignores_rules/{own}" for own in ("chatter", "inner", "secret", "status")
    ]
    assert all(observed.values()), observed
    assert len(observed) == 8


def test_the_example_of_the_help_for_another_host_works(tmp_path: Path) -> None:
    options = ("--endpoint", "10.9.0.1:7447", "--listen", "[::]:7447")
    assert play("one_router", tmp_path, *options) == {"heard": True}
