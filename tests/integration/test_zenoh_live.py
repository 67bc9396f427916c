"""The written files enforce the policy on real Zenoh, between sessions like those of rmw_zenoh."""

from __future__ import annotations

import re
import socket
from pathlib import Path
from typing import Any

import pytest

from tests.support.harness import policy_text, publish, sros, subscribe

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh

POLICY = policy_text(
    {
        "/talker": publish("/chatter"),
        "/keeper": publish("/secret", "/map"),
        "/listener": subscribe("/chatter", "/secret", "/map"),
        "/server": '<services reply="ALLOW"><service>/add</service></services>',
        "/client": '<services request="ALLOW"><service>/add</service></services>',
        "/wide": '<services reply="ALLOW"><service>/*</service></services>'
        '<services reply="DENY"><service>/denied/*</service></services>',
        "/other": publish("/elsewhere") + subscribe("/elsewhere", "/chatter/*"),
    }
)


@pytest.fixture(scope="module")
def keystores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two keystores with the same enclaves, of different CAs."""
    folder = tmp_path_factory.mktemp("zenoh")
    # Each node has the name of its enclave.
    named = re.sub(r'(path="/(\w+)"><profiles><profile ns="/" node=)"n"', r'\1"\2"', POLICY)
    (folder / "policy.xml").write_text(named)
    for name in ("ks", "foreign"):
        sros("create_keystore", folder / name, "--template", "production").ok()
        sros("create_enclave", folder / name, "/router").ok()
        sros("generate_artifacts", "-k", folder / name, "-p", folder / "policy.xml").ok()
    return folder


def play(what: str, folder: Path, mode: str = "peer") -> Any:
    """Write the files, for a port of this world's own, and return what was observed."""
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        endpoint = f"localhost:{free.getsockname()[1]}"
    for name in ("ks", "foreign"):
        sros("zenoh", folder / name, "--endpoint", endpoint, "--mode", mode).ok()
    from tests.integration.zenoh_world import PLAYS, observed_apart

    return observed_apart(lambda: PLAYS[what](folder / "ks", folder / "foreign"))


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_who_may_communicates_and_nobody_else(keystores: Path, mode: str) -> None:
    assert play("secured", keystores, mode) == {
        "heard": ["_buf/0a1b", "_buf_cpu", "chatter", "keeper"],
        "overheard": [],
        "executed": ["client"],
        "answered": ["server"],
        "nodes": ["guest", "other", "talker"],
        "graph": ["guest", "other", "server", "talker"],
        "announced": ["other MP %elsewhere", "server SS %add"],
        "erased": False,
        "history": ["map"],
        "same_enclave": ["twin"],
    }


def test_without_the_rules_each_of_these_attacks_succeeds(keystores: Path) -> None:
    observed = play("open", keystores)
    attacks = {"other", "wildcard", "wildcards", "talker", "forged image", "strayed"}
    assert set(observed["heard"]) >= attacks
    overheard = {"chatter", "keeper", "server", "_buf_cpu", "_buf/0a1b", "astray"}
    assert set(observed["overheard"]) >= overheard
    assert "other" in observed["executed"]
    assert "thief" in observed["answered"]
    assert {"spoofed", "denied"} <= {*observed["nodes"]}
    assert {"other MP %chatter", "other SS %add"} <= {*observed["announced"]}
    assert observed["erased"]


def test_only_a_certificate_of_the_keystore_gets_a_connection(keystores: Path) -> None:
    assert play("entrances", keystores, "client") == {
        "ours": True,
        "foreign": False,
        "none": False,
        "tcp": False,
        "ours again": True,
        "without paths": False,
    }


def test_sessions_wait_for_their_router_and_find_it_again(keystores: Path) -> None:
    assert play("starting", keystores, "client") == {
        "opened before the router": False,
        "all opened": True,
        "heard": True,
        "heard after the router's restart": True,
    }


def test_another_enclave_cannot_play_the_router(keystores: Path) -> None:
    assert play("routers", keystores, "client") == {"/other": False, "/router": True}


def test_zenoh_decides_as_sros_says(keystores: Path) -> None:
    observed = play("decisions", keystores, "client")
    assert observed["different"] == {"put": {}, "query": {}, "reply": {}}
    assert min(observed["happened"].values()) > 20
