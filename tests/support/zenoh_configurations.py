"""Zenoh configurations in the shapes that others write."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def self_limiting(
    node: str = "talker",
    *,
    publish: Sequence[str] = ("chatter",),
    subscribe: Sequence[str] = (),
    request: Sequence[str] = (),
    reply: Sequence[str] = (),
    end: str = "/**",
) -> str:
    """A session file as zenoh_security_tools writes it for a node: a whole configuration dumped.

    Its later versions end the keys of topics with two chunks, for type and hash.
    """
    sides: tuple[tuple[Sequence[str], list[str], list[str]], ...] = (
        (reply, ["query"], ["ingress"]),
        (reply, ["declare_queryable", "reply"], ["egress"]),
        (request, ["query"], ["egress"]),
        (request, ["declare_queryable", "reply"], ["ingress"]),
        (publish, ["put"], ["egress"]),
        (publish, ["declare_subscriber"], ["ingress"]),
        (subscribe, ["declare_subscriber"], ["egress"]),
        (subscribe, ["put"], ["ingress"]),
    )
    rules: list[dict[str, Any]] = [
        {
            "id": f"rule_{number}",
            "messages": messages,
            "flows": flows,
            "permission": "allow",
            "key_exprs": [f"0/{each}{end}" for each in names],
        }
        for number, (names, messages, flows) in enumerate(sides)
        if names
    ]
    graph = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber", "reply"]
    rules.append(
        {
            "id": "liveliness_tokens",
            "messages": graph,
            "flows": ["ingress", "egress"],
            "permission": "allow",
            "key_exprs": ["@ros2_lv/0/**"],
        }
    )
    files = ("private_key", "certificate")
    paths = {f"{side}_{what}": f"/ks/{what}" for side in ("listen", "connect") for what in files}
    document = {
        "id": None,
        "metadata": None,
        "mode": "peer",
        "connect": {"timeout_ms": None, "endpoints": ["tls/localhost:7447"]},
        "listen": {"timeout_ms": None, "endpoints": ["tls/localhost:0"]},
        "scouting": {
            "timeout": None,
            "multicast": {"enabled": False, "address": None},
            "gossip": {"enabled": True, "target": {"router": ["router", "peer"]}},
        },
        "transport": {
            "unicast": {"max_links": 1},
            "link": {
                "protocols": ["tls"],
                "tls": {
                    "root_ca_certificate": "/ks/ca",
                    "enable_mtls": True,
                    "verify_name_on_connect": False,
                    "close_link_on_expiration": None,
                    **paths,
                },
            },
            "shared_memory": {"enabled": True, "mode": "lazy"},
        },
        "adminspace": {"enabled": False, "permissions": {"read": True, "write": False}},
        "namespace": None,
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [
                {"id": "router", "interfaces": None, "cert_common_names": None},
                {"id": node, "interfaces": None, "cert_common_names": None},
            ],
            "policies": [
                {"id": None, "rules": ["liveliness_tokens"], "subjects": ["router"]},
                {"id": None, "rules": [each["id"] for each in rules], "subjects": [node]},
            ],
        },
    }
    return json.dumps(document, indent=2)


def denying() -> str:
    """A router that denies something inside of what it allows, in part by no ROS name."""
    rule = {"messages": ["put"], "flows": ["ingress"]}
    return json.dumps(
        {
            "mode": "router",
            "access_control": {
                "enabled": True,
                "default_permission": "deny",
                "rules": [
                    {**rule, "id": "yes", "permission": "allow", "key_exprs": ["0/*/*/*"]},
                    {**rule, "id": "no", "permission": "deny", "key_exprs": ["0/a/*/*"]},
                ],
                "subjects": [{"id": "s", "cert_common_names": ["/talker"]}],
                "policies": [{"rules": ["yes", "no"], "subjects": ["s"]}],
            },
        }
    )


def with_rmw_zenoh(prefix: Path, version: str) -> dict[str, str]:
    """The variable of an ament prefix that has a version of rmw_zenoh_cpp."""
    for path, text in (
        ("ament_index/resource_index/rmw_typesupport/rmw_zenoh_cpp", ""),
        (
            "rmw_zenoh_cpp/package.xml",
            '<?xml version="1.0"?>\n<?xml-model href="package_format3.xsd"?>\n'
            f'<package format="3">\n  <version>{version}</version>\n</package>\n',
        ),
    ):
        file = prefix / "share" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return {"AMENT_PREFIX_PATH": str(prefix)}
