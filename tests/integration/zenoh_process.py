"""Processes that open a Zenoh session as rmw_zenoh_cpp and its router do: by the environment alone.

    python -P tests/integration/zenoh_process.py router|node|say|hear

They print "open", "closed" or "no configuration", and run until they are ended.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress

KEY = "0/chatter/std_msgs::msg::dds_::String_/RIHS01_" + "0" * 64
SESSION, ROUTER = "ZENOH_SESSION_CONFIG_URI", "ZENOH_ROUTER_CONFIG_URI"
OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
DEFAULT = '{mode: "peer", scouting: {multicast: {enabled: false}}}'
"""In the place of the default configuration of rmw_zenoh_cpp: plain, and without any rule."""


def configuration(kind: str) -> object:
    """The configuration of a process; rmw_zenoh_cpp ignores a pair that Zenoh does not take."""
    import zenoh

    uri = os.environ.get(ROUTER if kind == "router" else SESSION)
    config = zenoh.Config.from_file(uri) if uri else zenoh.Config.from_json5(DEFAULT)
    for pair in os.environ.get(OVERRIDE, "").split(";"):
        key, _, value = pair.partition("=")
        if key and value:
            with suppress(zenoh.ZError):
                config.insert_json5(key, value)
    if kind != "router":  # as written, it would wait for a router that refuses it for ever
        config.insert_json5("connect/timeout_ms", "4000")
    return config


def process(kind: str) -> None:
    """Open a session; say or hear something until the process is ended."""
    import zenoh

    try:
        config = configuration(kind)
    except zenoh.ZError:
        print("no configuration", flush=True)
        return
    try:
        session = zenoh.open(config)  # type: ignore[arg-type]
    except zenoh.ZError:
        print("closed", flush=True)
        return
    print("open", flush=True)
    kept = []
    if kind == "hear":
        kept.append(session.declare_subscriber(KEY, lambda _: print("heard", flush=True)))
    while True:
        time.sleep(0.1)
        if kind == "say":
            session.put(KEY, "x")


if __name__ == "__main__":
    process(sys.argv[1])
    os._exit(0)  # threads of a session that hangs would keep the process
