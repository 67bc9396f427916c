"""What arrives on real Zenoh is what `zenoh.delivery` says, for random rules and links."""

from __future__ import annotations

import json
import os
import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.children import LONG, run
from tests.support.harness import policy_text, publish, sros

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
DELIVERIES = Path(__file__).with_name("zenoh_deliveries.py")
POLICY = policy_text({"/talker": publish("/chatter"), "/listener": publish("/chatter")})


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore with Zenoh files, whose access control the worlds replace."""
    folder = tmp_path_factory.mktemp("zenoh")
    (folder / "policy.xml").write_text(POLICY)
    sros("create_keystore", folder / "ks", "--template", "production").ok()
    sros("create_enclave", folder / "ks", "/router").ok()
    sros("generate_artifacts", "-k", folder / "ks", "-p", folder / "policy.xml").ok()
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        endpoint = f"localhost:{free.getsockname()[1]}"
    sros("zenoh", folder / "ks", folder / "policy.xml", "--endpoint", endpoint).ok()
    return folder / "ks"


def deliveries(keystore: Path, talker: str, listener: str, seed: int, count: int) -> Any:
    """Return what a world of real sessions observed, in modes and with rules of a seed."""
    done = run(
        [sys.executable, "-P", DELIVERIES, keystore, talker, listener, seed, count],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    return json.loads(done.stdout)


MIXED = [("client", "peer"), ("peer", "client")]


@pytest.mark.parametrize(
    ("talker", "listener"), [("client", "client"), ("peer", "peer"), *(MIXED if LONG else [])]
)
@pytest.mark.parametrize("seed", range(1, 6) if LONG else [1])
def test_what_arrives_is_what_the_engine_says(
    keystore: Path, talker: str, listener: str, seed: int
) -> None:
    observed = deliveries(keystore, talker, listener, seed, 250 if LONG else 80)
    assert not any(observed["different"].values()), observed["different"]
    # Both sides were up, and each kind of delivery was both allowed and dropped.
    assert min(observed["arrived"].values()) >= 5, observed["arrived"]
    assert min(observed["dropped"].values()) >= 5, observed["dropped"]
