"""What Zenoh logs where connections are refused and messages dropped.

    python -P tests/integration/zenoh_logging.py KEYSTORE FOREIGN PORT

RUST_LOG says how much.  The process enters a network of its own where it may.
"""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

import zenoh

from sros_tool.runtime.netns import enter_isolation, try_isolation
from tests.integration.zenoh_enforcement import configuration, opened
from tests.integration.zenoh_world import key, text, until

RULES = (
    ("in", "ingress", ["put"]),
    ("out", "egress", ["declare_subscriber"]),
)
CONTROL = {
    "enabled": True,
    "default_permission": "deny",
    "rules": [
        {
            "id": name,
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": ["0/chatter/*/*"],
        }
        for name, flow, messages in RULES
    ],
    "subjects": [{"id": "talker", "cert_common_names": ["/talker"]}],
    "policies": [{"rules": ["in", "out"], "subjects": ["talker"]}],
}


def main() -> None:
    keystore, foreign, port = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    if try_isolation().isolated:
        enter_isolation()
    zenoh.init_log_from_env_or("trace")
    endpoint = f"tls/127.0.0.1:{port}"
    router = opened(
        configuration(
            keystore,
            "/router",
            mode="router",
            listen={"endpoints": [endpoint]},
            access_control=CONTROL,
        )
    )
    hurried = {"endpoints": [endpoint], "timeout_ms": 1500, "exit_on_failure": True}
    without = configuration(keystore, "/talker", connect=hurried)
    tls = without["transport"]["link"]["tls"]
    tls["enable_mtls"] = False
    for name in [each for each in tls if each.startswith(("listen_", "connect_"))]:
        del tls[name]
    plain = {**hurried, "endpoints": [endpoint.replace("tls", "tcp")]}
    for refused in (
        without,
        configuration(foreign, "/talker", connect=hurried),
        {"mode": "client", "connect": plain, "scouting": {"multicast": {"enabled": False}}},
    ):
        with contextlib.suppress(zenoh.ZError):
            opened(refused).close()
    patient = {**hurried, "timeout_ms": 60_000}
    opened(configuration(keystore, "/other", connect=patient)).close()
    talker = opened(configuration(keystore, "/talker", connect=patient))
    heard: set[str] = set()
    kept = router.declare_subscriber(key("/chatter"), lambda each: heard.add(text(each)))

    def send() -> None:
        talker.put(key("/secret"), "denied")
        talker.put(key("/chatter"), "allowed")  # after it, on the same connection

    assert until(lambda: "allowed" in heard, send)
    kept.undeclare()
    talker.close()
    router.close()
    sys.stdout.flush()
    os._exit(0)  # threads of a session that hangs would keep the process


if __name__ == "__main__":
    main()
