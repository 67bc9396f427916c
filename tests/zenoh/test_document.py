"""Zenoh configurations are read with Zenoh's defaults; what Zenoh refuses is refused."""

from __future__ import annotations

import json
import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from sros_tool.errors import DocumentError
from sros_tool.zenoh.access import Flow, Message
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.document import (
    ConfigurationDocument,
    UnreadConfigurationError,
    parse_configuration,
)
from tests.support.children import LONG, apart
from tests.support.long_form import some

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
    "mode is 'Peer', which is none of: router, peer, client": {"mode": "Peer"},
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
    "are not allowed in a key": control(rules=[{**RULE, "key_exprs": ["a?"]}]),
    "a wildcard has to be": control(rules=[{**RULE, "key_exprs": ["a*"]}]),
    "rules has the id 'r' twice": control(rules=[RULE, RULE]),
    "subjects has the id 's' twice": control(subjects=[SUBJECT, SUBJECT]),
    "cert_common_names is empty": control(subjects=[{"id": "s", "cert_common_names": []}]),
    "has an empty value": control(subjects=[{"id": "s", "usernames": [" "]}]),
    "unknown protocol 'TLS'": control(subjects=[{"id": "s", "link_protocols": ["TLS"]}]),
    "'0A', which is not a session id": control(subjects=[{"id": "s", "zids": ["0A"]}]),
    "cert_names is not a setting": control(subjects=[{"id": "s", "cert_names": ["a"]}]),
    "names 'q', which is not in rules": control(policies=[{**POLICY, "rules": ["q"]}]),
    "names 'q', which is not in subjects": control(policies=[{**POLICY, "subjects": ["q"]}]),
    "subjects is missing or empty": control(policies=[{**POLICY, "subjects": []}]),
}


@pytest.mark.parametrize(("problem", "value"), some([*REFUSED.items()], 12))
def test_refused_as_by_zenoh(problem: str, value: Any) -> None:
    with pytest.raises(DocumentError, match=problem):
        read(value)
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    document = value if isinstance(value, str) else json.dumps(
        value | {"mode": value.get("mode", "client")}
        | ({"scouting": {"multicast": {"enabled": False}}} if "access_control" in value else {})
    )  # fmt: skip

    def take() -> None:
        config = zenoh.Config.from_json5(document)
        if "access_control" in value:  # some of it is looked at when a session opens
            config.insert_json5("mode", '"peer"')
            config.insert_json5("listen/endpoints", "[]")
            zenoh.open(config).close()

    def is_refused() -> bool:
        try:
            take()
        except zenoh.ZError:
            return True
        return False

    # Threads of a session would lack in what other tests fork.
    assert apart(is_refused) if "access_control" in value else is_refused()


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
        config = zenoh.Config.from_json5(json.dumps(value | settings))
        apart(lambda config=config: zenoh.open(config).close())  # type: ignore[misc]


def test_a_short_file_that_means_too_much() -> None:
    many = [str(each) for each in range(1, 4000)]
    subject = {"id": "s", "cert_common_names": many, "usernames": many}
    with pytest.raises(DocumentError, match=r"combine to .* rules; sros reads at most"):
        read(control(subjects=[subject]))


def test_settings_by_their_order_are_not_read() -> None:
    """Zenoh accepts a list, too; nobody writes that, and its meaning depends on the version."""
    with pytest.raises(UnreadConfigurationError, match="is a list, which sros does not read"):
        read("[]")


def test_a_file_that_is_too_large_or_no_text(tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match="more than 16 MiB"):
        parse_configuration(b" " * (16 * 1024**2 + 1), "file")
    with pytest.raises(DocumentError, match="is not UTF-8"):
        parse_configuration(b"{}\xff", "file")


# ── documents as people write them ─────────────────────────────────────────────────────────

PLACES = ((), ("access_control",), ("transport",), ("transport", "link", "tls"), ("listen",))
"""Objects that may be written as lists of their values."""


def drawn_document(draw: random.Random) -> dict[str, Any]:
    """Settings of which each is often there, and sometimes wrong."""

    def some(value: Any, *others: Any) -> Any:
        return draw.choice([value] * 4 + list(others))

    name = some("/talker", "/a\\b", "/é", "/a\u2028b", "/y/n")
    rule = {**RULE, "key_exprs": [some("0/chatter/**", "0/$*::$*/*", "0/a//b")]}
    subject = {"id": "s", "cert_common_names": [name]}
    settings: dict[str, Any] = {
        "mode": some("client", "peer", "router", "yes", None),
        "listen": {"endpoints": some(["tls/localhost:7447"], {"router": ["tls/a:1"]}, "tls/a:1")},
        "transport": {"link": {"tls": {"enable_mtls": some(True, False, "yes", None)}}},
        "adminspace": {"enabled": some(False, "no", 1)},
        "metadata": {"n": some(1, 1.5, "0x1f"), "of": some("a#b", "a: b", "")},
        "access_control": {
            "enabled": some(True, False, "on"),
            "default_permission": some("deny", "allow", "Deny"),
            "rules": [rule],
            "subjects": [subject],
            "policies": [POLICY],
        },
    }
    for key in draw.sample(sorted(settings), draw.randint(0, 3)):
        del settings[key]
    if draw.random() < 0.15:
        *parents, last = draw.choice(PLACES[1:])
        inner: Any = settings
        for each in parents:
            inner = inner.get(each, {})
        if last in inner:
            inner[last] = list(inner[last].values())
    return settings


def in_json5(value: Any, draw: random.Random) -> str:
    """A value in JSON5, in one of its many forms."""
    space = draw.choice(["", " ", "\n", "\t", "/* x */", "// y\n"])
    comma = draw.choice(["", ","])
    if isinstance(value, dict):
        names = (each if draw.random() < 0.5 else f"'{each}'" for each in value)
        inner = (
            f"{space}{name}:{in_json5(each, draw)}"
            for name, each in zip(names, value.values(), strict=True)
        )
        return f"{{{','.join(inner)}{comma if value else ''}}}{space}"
    if isinstance(value, list):
        return f"[{','.join(in_json5(e, draw) for e in value)}{comma if value else ''}]"
    if isinstance(value, str) and draw.random() < 0.5:
        letters = (draw.choice([e, f"\\x{ord(e):02x}"]) if ord(e) < 128 else e for e in value)
        return "'" + "".join(rf"\{e}" if e == "\\" else e for e in letters) + "'"
    return json.dumps(value, ensure_ascii=draw.random() < 0.5)


def in_yaml(value: Any, draw: random.Random) -> str:
    return str(yaml.safe_dump(value, default_flow_style=draw.choice([True, False, None])))


def drawn_file(draw: random.Random) -> tuple[str, str]:
    """The ending of a file's name, and a text that its language may have."""
    document: Any = drawn_document(draw)
    if draw.random() < 0.05:
        document = [None, None, document.get("mode")]
    if draw.random() < 0.1:
        return ".toml", draw.choice(['mode = "client"\n', json.dumps(document)])
    ending = draw.choice([".json5", ".json5", ".json", ".yaml", ".yaml", ".yml"])
    if (ending in (".yaml", ".yml")) is (draw.random() < 0.85):
        forms: list[Callable[[Any, random.Random], str]] = [in_yaml, lambda e, _: json.dumps(e)]
        forms += [lambda e, _: json.dumps(e, ensure_ascii=False, indent="\t")]
    else:
        forms = [in_json5]
    begin = draw.choice(["", "", "", "\ufeff", "\n", "---\n", "# x\n", "// x\n"])
    return ending, begin + draw.choice(forms)(document, draw)


def test_files_are_read_as_zenoh_reads_them_or_called_unread(tmp_path: Path) -> None:
    """Whatever Zenoh accepts has its meaning, or sros says that it does not read it."""
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    looked_at = ("mode", "listen/endpoints", "transport/link/tls", "access_control")

    def theirs(path: Path) -> dict[str, Any] | None:
        try:
            config = zenoh.Config.from_file(str(path))
        except zenoh.ZError:
            return None
        return {each: json.loads(config.get_json(each)) for each in looked_at}

    draw = random.Random(20261)
    outcomes: Counter[str] = Counter()
    for _ in range(20_000 if LONG else 600):
        ending, text = drawn_file(draw)
        path = tmp_path / f"file{ending}"
        path.write_bytes(text.encode())
        meant = theirs(path)
        try:
            found = parse_configuration(path.read_bytes(), str(path))
        except UnreadConfigurationError:
            outcomes["unread" if meant else "unread and refused"] += 1
            continue
        except DocumentError as error:
            opened = meant and meant["access_control"]["enabled"]  # refused when a session opens
            assert meant is None or opened, (text, str(error))
            outcomes["refused"] += 1
            continue
        outcomes["read"] += 1
        assert meant is not None, text
        control = meant["access_control"]
        assert found.mode.value == (meant["mode"] or "peer"), text
        assert found.tls.mutual is bool(meant["transport/link/tls"]["enable_mtls"]), text
        assert found.access.enabled is control["enabled"], text
        assert found.access.allows_by_default is (control["default_permission"] == "allow"), text
        names = [each["cert_common_names"] for each in control["subjects"] or ()]
        assert [list(e.cert_common_names or ()) for e in found.access.subjects] == names, text
        keys = [each["key_exprs"] for each in control["rules"] or ()]
        assert [list(each.key_expressions) for each in found.access.rules] == keys, text
    assert min(outcomes[each] for each in ("read", "refused", "unread")) > 50, outcomes
