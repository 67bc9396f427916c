"""Processes of an export that read the variables of `sros run` as rmw_zenoh_cpp does open.

Only those do.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import sys
from pathlib import Path

import pytest

from tests.support.children import run
from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import ONLY_LONG, sometimes

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
PROCESS = Path(__file__).with_name("zenoh_process.py")


@pytest.mark.parametrize(
    ("mode", "name"),
    [
        pytest.param("client", "ks", marks=ONLY_LONG),
        pytest.param("peer", "ks", marks=sometimes("the environment of a peer")),
        ("client", 'a|b="c" \\d=é\n#$x\u2028'),
    ],
)
def test_a_session_opens_with_the_environment_and_not_without(
    mode: str, name: str, tmp_path: Path
) -> None:
    root, policy, robot = tmp_path / "home", tmp_path / "policy.xml", tmp_path / name
    subscribe = publish("/chatter").replace("publish", "subscribe")
    policy.write_text(policy_text({"/talker": publish("/chatter"), "/listener": subscribe}))
    sros("create_keystore", root).ok()
    sros("generate_artifacts", "-k", root, "-p", policy).ok()
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        endpoint = f"localhost:{free.getsockname()[1]}"
    sros("zenoh", root, "--mode", mode, "--endpoint", endpoint).ok()
    sros("distribute_key", root, "--all", robot).ok()
    shutil.rmtree(root)
    done = run(
        [sys.executable, "-P", PROCESS, "world", robot],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert json.loads(done.stdout) == {
        "router": "open",
        "hear": "open",
        "say": "open",
        "heard": "heard",
        "node": "open",
        "node without override": "closed",
        "node without either": "open",  # the default of rmw_zenoh_cpp: nothing keeps it closed
        "node of the router": "no configuration",
        "router of a node": "no configuration",
        "router without override": "closed",
    }
