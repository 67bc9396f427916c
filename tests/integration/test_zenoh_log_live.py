"""What real Zenoh sessions log is explained."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import pytest

from sros_tool.explain.log import explain_log
from tests.support.children import run
from tests.support.harness import sros

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
WORLD = Path(__file__).with_name("zenoh_logging.py")


def test_the_log_of_real_sessions(tmp_path: Path) -> None:
    for name in ("ks", "foreign"):
        sros("create_keystore", tmp_path / name).ok()
        for each in ("/router", "/talker", "/other"):
            sros("create_enclave", tmp_path / name, each).ok()
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    done = run(
        [sys.executable, "-P", WORLD, tmp_path / "ks", tmp_path / "foreign", port],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "RUST_LOG": "zenoh=trace",
            "NO_COLOR": "1",
        },
    )

    def no_context(_: object) -> object:
        raise AssertionError("no enclave is examined")

    found = explain_log(done.stdout, lambda _: None, no_context)  # type: ignore[arg-type]
    # Both sides of each refusal are in this one log.
    assert {each.id for each in found} == {
        "zenoh-peer-no-certificate",
        "zenoh-no-certificate",
        "zenoh-foreign-ca",
        "zenoh-not-tls",
        "zenoh-tcp-to-tls",
        "zenoh-no-subject",
        "zenoh-dropped",
    }
    dropped = [each for each in found if each.id == "zenoh-dropped"]
    assert {each.enclave for each in dropped} == {"/talker"}
    assert any("/talker may not publish /secret" in each.cause for each in dropped)
    assert all(each.zenoh for each in found)
