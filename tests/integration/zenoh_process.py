"""Processes that open a Zenoh session as rmw_zenoh_cpp and its router do: by the environment alone.

    python -P tests/integration/zenoh_process.py world KEYSTORE
    python -P tests/integration/zenoh_process.py router|node|say|hear

`world` starts the others with `sros run` in a network of its own where it may, and prints what
happened as JSON.  The others print "open", "closed" or "no configuration", and end when their
standard input does.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

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


def wait_for_end(ended: threading.Event) -> None:
    """Set the event when the standard input ends."""
    sys.stdin.read()
    ended.set()


def process(kind: str) -> None:
    """Open a session; say or hear something until the standard input ends."""
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
    ended = threading.Event()
    threading.Thread(target=wait_for_end, args=(ended,), daemon=True).start()
    kept = []
    if kind == "hear":
        kept.append(session.declare_subscriber(KEY, lambda _: print("heard", flush=True)))
    while not ended.wait(0.1):
        if kind == "say":
            session.put(KEY, "x")
    session.close()  # type: ignore[no-untyped-call]


@contextmanager
def started(
    keystore: Path, enclave: str, kind: str, *without: str, **inherited: str
) -> Iterator[subprocess.Popen[str]]:
    """A process of an enclave, started by `sros run`, and then without some variables."""
    unset = [word for name in without for word in ("-u", name)]
    command = [sys.executable, "-P", "-m", "sros_tool", "run", str(keystore), enclave, "--rmw"]
    command += ["rmw_zenoh_cpp", "--", "env", *unset, sys.executable, "-P", __file__, kind]
    with subprocess.Popen(
        command,
        env={**os.environ, **inherited},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as child:
        try:
            yield child
        finally:
            child.kill()


def line(child: subprocess.Popen[str]) -> str:
    """The next line that a process prints, or "" if it has ended."""
    assert child.stdout
    return child.stdout.readline().strip()


def world(keystore: Path) -> dict[str, object]:
    """What happens in and without the environment that sros gives."""
    found: dict[str, object] = {}
    with ExitStack() as stack:
        enter = stack.enter_context
        found["router"] = line(enter(started(keystore, "/router", "router")))
        hear = enter(started(keystore, "/listener", "hear"))
        found["hear"] = line(hear)
        opening = 'access_control/enabled=false;transport/link/tls/root_ca_certificate="/none"'
        say = enter(started(keystore, "/talker", "say", ZENOH_CONFIG_OVERRIDE=opening))
        found["say"] = line(say)
        found["heard"] = line(hear)
        for what, enclave, kind, without in (
            ("node", "/talker", "node", ()),
            ("node without override", "/talker", "node", (OVERRIDE,)),
            ("node without either", "/talker", "node", (OVERRIDE, SESSION)),
            ("node of the router", "/router", "node", ()),
            ("router of a node", "/talker", "router", ()),
        ):
            found[what] = line(enter(started(keystore, enclave, kind, *without)))
    with started(keystore, "/router", "router", OVERRIDE) as child:
        found["router without override"] = line(child)
    return found


if __name__ == "__main__":
    if sys.argv[1] != "world":
        process(sys.argv[1])
        os._exit(0)  # threads of a session that hangs would keep the process
    from sros_tool.runtime.netns import enter_isolation, try_isolation

    if try_isolation().isolated:
        enter_isolation()
    print(json.dumps(world(Path(sys.argv[2]))), flush=True)
