"""A configuration is JSON in which each rule has a line, and reads back as it was."""

from __future__ import annotations

import json
import random
from itertools import product

import pytest

from sros_tool.zenoh.access import AccessControl, AccessRule, Flow, Message, Remote, RemoteRights
from sros_tool.zenoh.configuration import Configuration, Mode, RenderedReader, parse_rendered
from sros_tool.zenoh.document import parse_configuration

PUT = (Message.PUT, Message.DELETE)
RIGHTS = RemoteRights(
    '/a"\\\n',
    (
        AccessRule(Flow.INGRESS, PUT, ("0/b/*/*", '0/"/**')),
        AccessRule(Flow.EGRESS, PUT, ("0/\u00e9",)),
    ),
)


SAME = (RIGHTS, RemoteRights("/b", RIGHTS.rules), RemoteRights("/c", ()))


@pytest.mark.parametrize("remotes", [(), (RIGHTS,), SAME])
@pytest.mark.parametrize("mode", Mode)
def test_it_reads_back_as_it_was(mode: Mode, remotes: tuple[RemoteRights, ...]) -> None:
    control, revoked = AccessControl(remotes), "2026-11-25T00:00:00Z" if remotes else ""
    written = Configuration(mode, ("tls/a:1",), ("tls/b:2",), control, revoked)
    data = written.render()
    assert parse_rendered(data, "file") == written
    control = json.loads(data)["access_control"]
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    assert len(control["rules"]) == min(len(remotes), 1) * len(RIGHTS.rules)
    for rule in control["rules"]:
        lines = [line for line in data.decode().splitlines() if json.dumps(rule["id"]) in line]
        assert len(lines) == (3 if remotes is SAME else 2), "a rule, and its policies"


def test_another_text_of_the_same_configuration_is_not_one_that_sros_writes() -> None:
    control = AccessControl((RIGHTS, RemoteRights("/b", RIGHTS.rules)))
    data = Configuration(Mode.PEER, (), ("tls/b:2",), control).render()
    reader = RenderedReader()
    assert reader.read(data)
    for old, new in (
        (b'"mode": "peer"', b'"mode":  "peer"'),
        (b'"enable_mtls": true', b'"enable_mtls": false'),
        (b'"default_permission": "deny"', b'"default_permission": "allow"'),
        (b'"permission": "allow"', b'"permission": "never"'),
        (b'["ingress"]', b'["ingress", "egress"]'),
        (b'"subjects": ["/b"]', b'"subjects": ["/b", "/c"]'),
        (b'"cert_common_names": ["/b"]', b'"cert_common_names": []'),
        (b"\n }\n}\n", b'\n },\n "namespace": "x"\n}\n'),
    ):
        assert old in data
        assert reader.read(data.replace(old, new, 1)) is None, old
    twice = Configuration(Mode.PEER, (), (), AccessControl((RIGHTS, RIGHTS))).render()
    assert reader.read(twice) is None


def test_it_decides_like_what_is_read_from_its_file() -> None:
    draw = random.Random(4)
    keys = (
        "0/a/*/*",
        "0/b/*/*",
        "0/**",
        "0/a$*/x/y",
        "0/*/x/*",
        *(f"0/{i}/x/y" for i in range(20)),
    )

    def rules() -> tuple[AccessRule, ...]:
        places = product(Flow, (PUT, (Message.QUERY,)))
        return tuple(
            AccessRule(flow, messages, tuple(draw.sample(keys, draw.choice((1, 2, 20)))), allows)
            for flow, messages in places
            for allows in (True, False)
            if draw.random() < (0.7 if allows else 0.2)
        )

    allowed = 0
    for _ in range(20):
        remotes = tuple(RemoteRights(name, of) for name in ("/a", "/b") if (of := rules()))
        control = AccessControl(remotes)
        data = Configuration(Mode.PEER, (), ("tls/b:2",), control).render()
        assert parse_rendered(data, "file").access_control == control
        other = parse_configuration(data, "file").access
        for name, flow, message, key in product(
            ("/a", "/b", "/c", None), Flow, (Message.PUT, Message.QUERY), (*keys[:6], "0/ax/x/y")
        ):
            decision = control.decide(Remote(name), flow, message, key)
            assert decision == other.decide(Remote(name), flow, message, key)
            allowed += decision.allowed
            for rule in decision.rules:
                assert control.key_expressions_of(rule) == other.key_expressions_of(rule)
    assert allowed > 50
