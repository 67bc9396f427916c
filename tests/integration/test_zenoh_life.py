"""What running Zenoh processes do while their keystore changes: what has to be restarted, and not.

The verbs are real, the sessions too; a process keeps the files that it read when it started.
"""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import some

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
POLICY = policy_text(
    {
        "/talker": publish("/chatter", "/more"),
        "/listener": publish("/chatter", "/extra").replace("publish", "subscribe"),
        "/other": publish("/extra"),
    }
)
MODES = pytest.mark.parametrize("mode", some(["client", "peer"], 1))


def play(what: str, folder: Path, mode: str) -> Any:
    """Make a keystore for a port of its own, and return what was observed."""
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        endpoint = f"localhost:{free.getsockname()[1]}"
    (folder / "policy.xml").write_text(POLICY)
    sros("create_keystore", folder / "ks", "--template", "production").ok()
    sros("generate_artifacts", "-k", folder / "ks", "-p", folder / "policy.xml").ok()
    sros("zenoh", folder / "ks", "--endpoint", endpoint, "--mode", mode).ok()
    from tests.integration.zenoh_life import PLAYS
    from tests.integration.zenoh_world import observed_apart

    return observed_apart(lambda: PLAYS[what](folder / "ks"))


@MODES
def test_other_rights_reach_the_processes_that_are_named_and_no_others(
    mode: str, tmp_path: Path
) -> None:
    seen = play("rights", tmp_path, mode)
    everybody = ["/listener", "/other", "/router", "/talker"]
    assert seen == {
        "before": [True, False],
        "restart": ["/listener", "/router"] if mode == "client" else everybody,
        "none restarted": True,
        "listener alone": False,
        "both": mode == "client",  # in peer mode the talker itself still denies it
        "listed": [True, False],
    }


@MODES
def test_a_renewal_asks_nobody_to_restart_and_disturbs_nobody(mode: str, tmp_path: Path) -> None:
    assert play("renewal", tmp_path, mode) == {
        "before": True,
        "restart": [],
        "after": True,
        "restarted": True,
    }


@MODES
def test_a_revoked_enclave_has_no_rights_once_the_named_processes_were_restarted(
    mode: str, tmp_path: Path
) -> None:
    named = {"client": ["/router"], "peer": ["/listener", "/other", "/router"]}
    assert play("revocation", tmp_path, mode) == {
        "before": True,
        "restart": named[mode],
        "none restarted": True,
        "others": [True, True],
        "router restarted": mode == "peer",  # past the router, until the listener is restarted
        "listed restarted": False,
        "connects": True,  # Zenoh has no revocation list
        "with its old files": False,
    }


@MODES
def test_a_rotation_of_the_cas_disturbs_nobody_and_ends_the_old_ones(
    mode: str, tmp_path: Path
) -> None:
    assert play("rotation", tmp_path, mode) == {
        "0": [True],
        **{each: [True] * 4 for each in ("distribute", "reissue", "retire")},
        "with the old CA": False,
        "again": True,
    }
