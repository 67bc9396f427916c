"""Several routers of a Zenoh network: settings, files, answers, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sros_tool.errors import UsageError
from sros_tool.keystore.template import parse_template, render_template
from sros_tool.zenoh.configuration import Mode, ZenohNetwork, ZenohRouter, check_network
from tests.support.harness import policy_text, publish, sros

POLICY = policy_text(
    {
        "/r1/talker": publish("/chatter", "/inner"),
        "/r1/near": publish("/inner").replace("publish", "subscribe"),
        "/r2/listener": publish("/chatter", "/inner").replace("publish", "subscribe"),
        "/desk": publish("/*").replace("publish", "subscribe"),
    }
)
ROUTERS = ("--router", "/r1/router=10.9.0.2:7447", "--router", "/r2/router=r2.local:7447")


@pytest.fixture
def keystore(tmp_path: Path) -> Path:
    (tmp_path / "policy.xml").write_text(POLICY)
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("generate_artifacts", "-k", root, "-p", tmp_path / "policy.xml").ok()
    sros("zenoh", root, "--endpoint", "desk:7447", *ROUTERS).ok()
    return root


def document(root: Path, path: str) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((root / "enclaves" / path).read_text())
    return loaded


def keys(root: Path, router: str, remote: str, message: str) -> set[tuple[str, str]]:
    """What a router lets another one send and get, as flows and names."""
    control = document(root, f"{router}/router.json5")["access_control"]
    (ids,) = (each["rules"] for each in control["policies"] if each["subjects"] == [remote])
    return {
        (rule["flows"][0], key.split("/")[1])
        for rule in control["rules"]
        if rule["id"] in ids and message in rule["messages"]
        for key in rule["key_exprs"]
        if "@adv" not in key
    }


def test_each_session_has_its_router_and_routers_connect_once(keystore: Path) -> None:
    endpoints = {
        path: document(keystore, path)["connect"]["endpoints"]
        for path in (
            "desk/session.json5",
            "r1/talker/session.json5",
            "r2/listener/session.json5",
            "router/router.json5",
            "r1/router/router.json5",
            "r2/router/router.json5",
        )
    }
    desk, one, two = "tls/desk:7447", "tls/10.9.0.2:7447", "tls/r2.local:7447"
    assert list(endpoints.values()) == [[desk], [one], [two], [], [desk], [desk, one]]
    assert sros("zenoh", keystore, "--check").ok().out == ""


def test_what_may_pass_is_what_both_ends_may(keystore: Path) -> None:
    assert keys(keystore, "r2/router", "/r1/router", "put") == {
        ("ingress", "chatter"),
        ("ingress", "inner"),
    }
    assert keys(keystore, "r1/router", "/r2/router", "put") == {
        ("egress", "chatter"),
        ("egress", "inner"),
    }
    sros("zenoh", keystore, "--cross", "/chatter").ok()
    assert keys(keystore, "r2/router", "/r1/router", "put") == {("ingress", "chatter")}
    answer = sros("explain", keystore, "/r1/talker", "publish", "/inner", "--vendor", "zenoh")
    assert "heard by  /r1/near\n" in answer.ok().out
    answer = sros("explain", keystore, "/r1/talker", "publish", "/chatter", "--vendor", "zenoh")
    assert "heard by  /desk, /r2/listener\n" in answer.ok().out
    sros("zenoh", keystore, "--cross", "").ok()
    answer = sros("explain", keystore, "/r1/talker", "publish", "/inner", "--vendor", "zenoh")
    assert "heard by  /desk, /r1/near, /r2/listener\n" in answer.ok().out
    assert '--cross "/chatter"' not in (keystore / "sros.toml").read_text()


def test_all_verbs_know_several_routers(keystore: Path) -> None:
    asked = sros("explain", keystore, "--who", "subscribe", "/inner", "--vendor", "zenoh").ok().out
    assert "6 of 7 enclaves may subscribe topic /inner" in asked  # with the routers
    reached = sros("explain", keystore, "--reach", "/r1/talker", "--vendor", "zenoh").ok().out
    assert "/r1/talker can influence 3 enclaves" in reached
    assert "router /r2/router at r2.local:7447 for /r2/*" in sros("inspect", keystore).ok().out
    sros("env", keystore, "/r1/router", "--rmw", "rmw_zenoh_cpp").ok()
    assert "zenoh" not in sros("check", keystore, "--exclude", "zenoh.shared-node").out
    sros("revoke", keystore, "/r1/talker").ok()
    assert keys(keystore, "r2/router", "/r1/router", "put") == set()
    made = sros("create_enclave", keystore, "/r1/new").ok()
    assert "/r1/router" in made.out + made.err
    assert document(keystore, "r1/new/session.json5")["connect"]["endpoints"] == [
        "tls/10.9.0.2:7447"
    ]
    sros("zenoh", keystore, "--check").ok()
    sros("zenoh", keystore, "--router", "/r2/router=").ok()
    assert not (keystore / "enclaves/r2/router/router.json5").exists()
    assert document(keystore, "r2/listener/session.json5")["connect"]["endpoints"] == [
        "tls/desk:7447"
    ]


def reached(root: Path, enclave: str) -> list[list[tuple[str, str, str]]]:
    """Whom an enclave influences (by the last hop) and learns from (by the first one)."""
    asked = sros("explain", root, "--reach", enclave, "--vendor", "zenoh", "--json").ok()
    answer = json.loads(asked.out)
    return [
        [
            (to["enclave"], to["path"][place]["right"], to["path"][place]["name"])
            for to in answer[of]
        ]
        for of, place in (("influences", -1), ("learns_from", 0))
    ]


def test_a_routers_key_reaches_its_own_enclaves_and_others_by_what_passes(
    keystore: Path,
) -> None:
    inner = ("publish", "/inner")
    chatter = ("publish", "/chatter")
    near, desk, listener = "/r1/near", "/desk", "/r2/listener"
    talker = [("/r1/talker", *chatter)]
    everybody = [(desk, *chatter), (near, *inner), (listener, *chatter)]
    assert reached(keystore, "/r1/router") == [everybody, talker]
    # Nobody behind it says anything: of what passes, it hears everything.
    assert reached(keystore, "/r2/router") == [[(listener, *chatter)], talker]
    sros("zenoh", keystore, "--cross", "/inner").ok()
    passing = [(desk, *inner), (near, *inner), (listener, *inner)]
    assert reached(keystore, "/r1/router") == [passing, talker]
    assert reached(keystore, "/r2/router")[1] == [("/r1/talker", *inner)]
    sros("zenoh", keystore, "--cross", "/elsewhere").ok()
    assert reached(keystore, "/r1/router") == [[(near, *inner)], talker]
    assert reached(keystore, "/r2/router") == [[(listener, *chatter)], []]
    assert reached(keystore, "/r1/talker") == [[(near, *inner)], []]


def test_settings_are_read_as_they_were_written(keystore: Path) -> None:
    template = parse_template((keystore / "sros.toml").read_text(), "")
    assert template.zenoh
    assert [router.name for router in template.zenoh.routers] == ["/r1/router", "/r2/router"]
    assert parse_template(render_template(template), "") == template


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--router", "/r3/router=localhost:7448", "--endpoint", "localhost:7447"),
         "cannot connect to each other"),
        (("--mode", "peer"), "client mode"),
        (("--router", "/other=r3.local:7447"), "the enclaves that connect to the router /other"),
        (("--router", "/r3/router="), "no further router /r3/router"),
        (("--router", "/r3/router=r3.local"), "HOST:PORT"),
        (("--router", "/router=r3.local:7447"), "enclaves that connect"),
        (("--router", "/r1/router"), "which is also zenoh.router"),
        (("--cross", "chatter"), "zenoh.crossing has 'chatter'"),
    ],
)  # fmt: skip
def test_what_cannot_work_is_refused_and_changes_nothing(
    keystore: Path, options: tuple[str, ...], text: str
) -> None:
    before = (keystore / "sros.toml").read_bytes()
    refused = sros("zenoh", keystore, *options)
    assert refused.status == 2
    assert text in " ".join(refused.err.split())
    assert (keystore / "sros.toml").read_bytes() == before


def test_one_reachable_router_of_two_is_enough() -> None:
    far, near = "r1.local:7447", "localhost:7447"
    router = ZenohRouter("/r1/router", (far,), (), ("/r1/*",))
    network = ZenohNetwork(routers=(router,))
    check_network(network)
    assert network.connects() == {"/router": (far,), "/r1/router": ()}
    hidden = ZenohRouter("/r1/router", (far,), (near,), ("/r1/*",))
    with pytest.raises(UsageError, match="cannot connect to each other"):
        ZenohNetwork(routers=(hidden,)).connects()
    with pytest.raises(UsageError):
        check_network(ZenohNetwork(mode=Mode.PEER, routers=(router,)))
