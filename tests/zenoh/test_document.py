"""Configurations of Zenoh are read with Zenoh's defaults; what Zenoh refuses is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sros_tool.errors import DocumentError
from sros_tool.zenoh.access import Flow, Message
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.document import ConfigurationDocument, parse_configuration

RULE = {"id": "r", "permission": "allow", "messages": ["put"], "key_exprs": ["a"]}
SUBJECT = {"id": "s", "cert_common_names": ["/talker"]}
POLICY = {"rules": ["r"], "subjects": ["s"]}


def read(value: object) -> ConfigurationDocument:
    text = value if isinstance(value, str) else json.dumps(value)
    return parse_configuration(text.encode(), "file.json5")


def control(**changes: Any) -> dict[str, Any]:
    sections = {"rules": [RULE], "subjects": [SUBJECT], "policies": [POLICY]}
    return {"access_control": {"enabled": True, **sections, **changes}}


def test_defaults_are_those_of_zenoh() -> None:
    document = read("{}")
    assert document.mode is Mode.PEER
    assert [each.text for each in document.listen] == ["tcp/[::]:0"]
    assert document.protocols is None
    assert (document.multicast, document.gossip, document.shared_memory) == (True, True, True)
    assert not document.adminspace
    tls = document.tls
    assert (tls.mutual, tls.verifies_name, tls.closes_on_expiration) == (False, True, False)
    assert not document.access.enabled


def test_everything_that_is_read() -> None:
    document = read(
        {
            "mode": "router",
            "listen": {"endpoints": {"router": ["tls/[::]:7447#enable_mtls=false;x=1"]}},
            "connect": {"endpoints": ["tcp/robot.local:1?rel=1"]},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "transport": {
                "shared_memory": {"enabled": False},
                "link": {
                    "protocols": ["tls"],
                    "tls": {
                        "enable_mtls": True,
                        "verify_name_on_connect": False,
                        "close_link_on_expiration": True,
                        "root_ca_certificate": "/ca.pem",
                        "listen_private_key_base64": "x",
                    },
                },
            },
            "adminspace": {"enabled": True, "permissions": {"read": False, "write": True}},
            "namespace": "robot",
            **control(default_permission="allow"),
        }
    )
    assert document.mode is Mode.ROUTER
    (listen,), (connect,) = document.listen, document.connect
    assert (listen.protocol, listen.address) == ("tls", "[::]:7447")
    assert dict(listen.options) == {"enable_mtls": "false", "x": "1"}
    assert (connect.protocol, connect.address) == ("tcp", "robot.local:1")
    assert document.protocols == ("tls",)
    assert document.tls.named == ("root_ca_certificate", "listen_private_key")
    tls = document.tls
    assert (tls.mutual, tls.verifies_name, tls.closes_on_expiration) == (True, False, True)
    assert (document.multicast, document.gossip, document.shared_memory) == (False, False, False)
    assert document.adminspace
    assert (document.adminspace_readable, document.adminspace_writable) == (False, True)
    assert document.namespace == "robot"
    access = document.access
    assert (access.enabled, access.allows_by_default) == (True, True)
    assert access.rules[0].flows == tuple(Flow)
    assert access.rules[0].messages == (Message.PUT,)
    assert access.subjects[0].cert_common_names == ("/talker",)


def test_endpoints_of_another_mode_are_none_of_this_one() -> None:
    assert read('{mode:"peer",listen:{endpoints:{router:["tls/a:1"]}}}').listen == ()


def test_settings_that_zenoh_does_not_know() -> None:
    document = read("{acces_control:{}, transport:{link:{tls:{client_auth:true}}}}")
    assert document.unknown == ("acces_control", "transport/link/tls/client_auth")


def test_lines() -> None:
    document = read('{\n mode: "peer",\n scouting: {\n  multicast: {\n   enabled: true}}}')
    assert document.line_of("scouting/multicast/enabled") == 5
    assert document.line_of("scouting/gossip/enabled") == 3
    assert document.line_of("transport/link") == 1


REFUSED: dict[str, Any] = {
    "is not JSON5. Line 2": "{\n!}",
    "mode is 'Peer', and none of: router, peer, client": {"mode": "Peer"},
    "listen is not an object": {"listen": None},
    "listen/endpoints is not a list": {"listen": {"endpoints": "tls/a:1"}},
    "listen/endpoints is null": {"listen": {"endpoints": None}},
    "has 'bogus', which is not PROTOCOL/ADDRESS": {"connect": {"endpoints": ["bogus"]}},
    "enabled is neither true nor false": {"transport": {"shared_memory": {"enabled": None}}},
    "enable_mtls is neither": {"transport": {"link": {"tls": {"enable_mtls": "true"}}}},
    "protocols is not a list": {"transport": {"link": {"protocols": "tls"}}},
    "default_permission is 'Allow'": control(default_permission="Allow"),
    "is on without the list 'rules'": control(rules=None),
    "x is not a setting that sros knows": control(x=1),
    "id is missing": control(rules=[{**RULE, "id": " "}]),
    "id is not a text": control(rules=[{**RULE, "id": 1}]),
    "permission is 'yes'": control(rules=[{**RULE, "permission": "yes"}]),
    "has no 'permission'": control(rules=[{**RULE, "permission": None}]),
    "has no 'messages'": control(rules=[{**RULE, "messages": None}]),
    "messages is empty": control(rules=[{**RULE, "messages": []}]),
    "messages is 'publish'": control(rules=[{**RULE, "messages": ["publish"]}]),
    "flows is empty": control(rules=[{**RULE, "flows": []}]),
    "key_exprs is missing or empty": control(rules=[{**RULE, "key_exprs": []}]),
    "it begins or ends with '/'": control(rules=[{**RULE, "key_exprs": ["/a"]}]),
    "has to be written '\\*/\\*\\*'": control(rules=[{**RULE, "key_exprs": ["**/*"]}]),
    "has to be written 'a/\\*'": control(rules=[{**RULE, "key_exprs": ["a/$*"]}]),
    "no characters of a key": control(rules=[{**RULE, "key_exprs": ["a?"]}]),
    "a wildcard has to be": control(rules=[{**RULE, "key_exprs": ["a*"]}]),
    "rules has the id 'r' twice": control(rules=[RULE, RULE]),
    "subjects has the id 's' twice": control(subjects=[SUBJECT, SUBJECT]),
    "cert_common_names is empty": control(subjects=[{"id": "s", "cert_common_names": []}]),
    "has an empty value": control(subjects=[{"id": "s", "usernames": [" "]}]),
    "'TLS', which is no protocol": control(subjects=[{"id": "s", "link_protocols": ["TLS"]}]),
    "'0A', which is no id": control(subjects=[{"id": "s", "zids": ["0A"]}]),
    "cert_names is not a setting": control(subjects=[{"id": "s", "cert_names": ["a"]}]),
    "names 'q', which rules has not": control(policies=[{**POLICY, "rules": ["q"]}]),
    "names 'q', which subjects has not": control(policies=[{**POLICY, "subjects": ["q"]}]),
    "subjects is missing or empty": control(policies=[{**POLICY, "subjects": []}]),
}


@pytest.mark.parametrize(("problem", "value"), REFUSED.items())
def test_refused_as_by_zenoh(problem: str, value: Any) -> None:
    with pytest.raises(DocumentError, match=problem):
        read(value)
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    document = value if isinstance(value, str) else json.dumps(
        value | {"mode": value.get("mode", "client")}
        | ({"scouting": {"multicast": {"enabled": False}}} if "access_control" in value else {})
    )  # fmt: skip
    with pytest.raises(zenoh.ZError):
        config = zenoh.Config.from_json5(document)
        if "access_control" in value:  # some of it is looked at when a session opens
            config.insert_json5("mode", '"peer"')
            config.insert_json5("listen/endpoints", "[]")
            zenoh.open(config).close()


def test_what_is_accepted_with_access_control_opens() -> None:
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    settings = {
        "mode": "peer",
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}},
    }
    for value in (
        control(),
        control(rules=[], subjects=[], policies=[]),
        control(rules=[{**RULE, "flows": None}], subjects=[{"id": "s", "usernames": None}]),
    ):
        assert read(value).access.enabled
        zenoh.open(zenoh.Config.from_json5(json.dumps(value | settings))).close()


def test_a_short_file_that_means_too_much() -> None:
    many = [str(each) for each in range(1, 4000)]
    subject = {"id": "s", "cert_common_names": many, "usernames": many}
    with pytest.raises(DocumentError, match=r"stand for .* rules; sros reads at most"):
        read(control(subjects=[subject]))


def test_settings_by_their_order_are_not_read() -> None:
    """Zenoh accepts a list, too; nobody writes that, and its meaning depends on the version."""
    with pytest.raises(DocumentError, match="is not an object with settings"):
        read("[]")


def test_a_file_that_is_too_large_or_no_text(tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match="more than 16 MiB"):
        parse_configuration(b" " * (16 * 1024**2 + 1), "file")
    with pytest.raises(DocumentError, match="is not UTF-8"):
        parse_configuration(b"{}\xff", "file")
