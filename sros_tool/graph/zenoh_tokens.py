"""The observer process on Zenoh, which reads the ROS graph from the tokens of rmw_zenoh.

``python -P -m sros_tool.graph.zenoh_tokens FD PERIOD`` writes the same output as the observer on
DDS (`sros_tool.graph.observation`), with the DDS topics of the same ROS names. The process needs no
RMW: it takes the configuration from the variables of rmw_zenoh, and announces nothing.

A token is ``@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME``, with
``/TOPIC/TYPE/HASH/QOS`` at its end for a publisher, subscription, service or client; "/" in a name
is "%" (ros2/rmw_zenoh, docs/design.md).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zenoh

from sros_tool.graph.observation import PUBLISH, SUBSCRIBE, Reading, report_graph, send
from sros_tool.names import dds_names

NODE = "NN"
"""The kind of a token that announces a node."""
_RIGHTS = {"MP": "publish", "MS": "subscribe", "SS": "reply", "SC": "request"}
_CONNECT_MS = "5000"
_DEFAULTS: Mapping[bool, Mapping[str, Any]] = {
    True: {"mode": "router", "listen": {"endpoints": ["tcp/localhost:7447"]}},
    False: {
        "mode": "peer",
        "listen": {"endpoints": ["tcp/localhost:0"]},
        "connect": {"endpoints": ["tcp/localhost:7447"]},
    },
}
"""Defaults of rmw_zenoh that matter for observers, for a router (True) and a session (False)."""


def configuration(variables: Mapping[str, str], *, router: bool = False) -> zenoh.Config:
    """Return the configuration that the variables of rmw_zenoh choose.

    Raises:
        zenoh.ZError, OSError: a file or a value is not valid.
    """
    uri = variables.get(f"ZENOH_{'ROUTER' if router else 'SESSION'}_CONFIG_URI", "")
    if uri:
        config = zenoh.Config.from_json5(Path(uri).read_text(encoding="utf-8"))
    else:
        unsecured = {"scouting": {"multicast": {"enabled": False}}, **_DEFAULTS[router]}
        config = zenoh.Config.from_json5(json.dumps(unsecured))
    for pair in filter(None, variables.get("ZENOH_CONFIG_OVERRIDE", "").split(";")):
        name, _, value = pair.partition("=")
        config.insert_json5(name, value)
    return config


class _TokenObserver:
    """An observer of the live tokens of a domain."""

    def __init__(self, session: zenoh.Session, domain: str) -> None:
        self._tokens: set[str] = set()
        # Kept, because an unused session closes.
        self._session, graph = session, session.liveliness()
        self._kept = graph.declare_subscriber(f"@ros2_lv/{domain}/**", self._change, history=True)

    def _change(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        (self._tokens.add if alive else self._tokens.discard)(str(sample.key_expr))

    def snapshot(self) -> Reading:
        """Return nodes and endpoints in the form of the observer on DDS."""
        nodes, endpoints = set(), set()
        for token in tuple(self._tokens):
            chunks = token.split("/")
            if len(chunks) < 9:
                continue
            session, kind = f"zenoh-{chunks[2]}", chunks[5]
            enclave, ns = (chunk.replace("%", "/") or "/" for chunk in chunks[6:8])
            if kind == NODE:
                nodes.add((session, enclave, ns, chunks[8]))
            elif kind in _RIGHTS and len(chunks) > 9:
                topics = dds_names(_RIGHTS[kind], chunks[9].replace("%", "/"))
                for way, names in ((PUBLISH, topics.publish), (SUBSCRIBE, topics.subscribe)):
                    endpoints |= {(session, ns, chunks[8], name, way) for name in names}
        return Reading([node[1:] for node in sorted(nodes)], sorted(endpoints))


def main() -> int:
    """Report the graph until standard input is closed; return the exit status."""
    report, period = os.fdopen(int(sys.argv[1]), "w", buffering=1), float(sys.argv[2])
    zenoh.init_log_from_env_or("error")
    try:
        config = configuration(os.environ)
        config.insert_json5("connect/timeout_ms", _CONNECT_MS)
        observer = _TokenObserver(zenoh.open(config), os.environ.get("ROS_DOMAIN_ID") or "0")
    except (zenoh.ZError, OSError) as error:
        send(report, {"failed": "session", "reason": str(error).partition(" at /")[0]})
        return 1
    try:
        send(report, {"ready": "rmw_zenoh_cpp"})
        report_graph(observer, report, period, ordered=True)
    except BrokenPipeError:
        pass
    return 0


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # without waiting for the threads of the open session
