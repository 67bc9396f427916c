"""Processes of an export that read the variables of `sros run` as rmw_zenoh_cpp does open.

Only those do.
"""

from __future__ import annotations

import os
import shutil
import socket
import sys
from functools import partial
from pathlib import Path

import pytest

from tests.integration.zenoh_process import OVERRIDE, SESSION
from tests.support.children import apart, wait_for
from tests.support.harness import Running, policy_text, publish, sros
from tests.support.long_form import ONLY_LONG, sometimes

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
PROCESS = Path(__file__).with_name("zenoh_process.py")


class Started(Running):
    """A process of an enclave, started by `sros run`, and then without some variables."""

    def __init__(
        self, keystore: Path, enclave: str, kind: str, *without: str, **inherited: str
    ) -> None:
        unset = [word for name in without for word in ("-u", name)]
        command = ["env", *unset, sys.executable, "-P", PROCESS, kind]
        words = ("run", keystore, enclave, "--rmw", "rmw_zenoh_cpp", "--", *command)
        super().__init__(*words, env={**os.environ, **inherited})
        self._read = 0

    def line(self) -> str:
        """Return the next line that the process prints, or "" if it has ended."""
        wait_for(lambda: self.out.count("\n") > self._read or self.poll() is not None, "a line")
        lines = self.out.splitlines()[self._read :]
        self._read += 1
        return lines[0] if lines else ""


def world(keystore: Path) -> dict[str, object]:
    """What happens in and without the environment that sros gives."""
    found: dict[str, object] = {}
    sessions: list[Started] = []

    def start(*words: str, **inherited: str) -> Started:
        sessions.append(Started(keystore, *words, **inherited))
        return sessions[-1]

    found["router"] = start("/router", "router").line()
    hear = start("/listener", "hear")
    found["hear"] = hear.line()
    opening = 'access_control/enabled=false;transport/link/tls/root_ca_certificate="/none"'
    found["say"] = start("/talker", "say", ZENOH_CONFIG_OVERRIDE=opening).line()
    found["heard"] = hear.line()
    for what, enclave, kind, without in (
        ("node", "/talker", "node", ()),
        ("node without override", "/talker", "node", (OVERRIDE,)),
        ("node without either", "/talker", "node", (OVERRIDE, SESSION)),
        ("node of the router", "/router", "node", ()),
        ("router of a node", "/talker", "router", ()),
    ):
        found[what] = start(enclave, kind, *without).line()
    for each in sessions:
        each.kill()
        each.wait()
    found["router without override"] = start("/router", "router", OVERRIDE).line()
    return found


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
    assert apart(partial(world, robot)) == {
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
