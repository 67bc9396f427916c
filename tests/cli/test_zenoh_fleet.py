"""Robots of a fleet file with Zenoh routers of their own, from the file to the robot."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sros_tool.fleet.fleet_file import parse_fleet, render_fleet
from sros_tool.keystore.template import parse_template
from sros_tool.zenoh.configuration import ZenohNetwork, ZenohRouter
from tests.support.harness import policy_text, publish, sros

POLICY = policy_text(
    {
        "/{robot}/base": publish("/fleet/{robot}", "/scan"),
        "/hall/{robot}": publish("/scan").replace("publish", "subscribe"),
        "/office": publish("/fleet/*", "/scan").replace("publish", "subscribe"),
    }
)
FLEET = """
[groups.carriers]
router = "{robot}.local:7447"
crossing = ["/fleet/{robot}"]
[robots]
r1 = { groups = ["carriers"] }
r2 = { groups = ["carriers"], router = "10.0.0.2:7448", crossing = [] }
r3 = {}
"""
R1 = ZenohRouter("/r1/router", ("r1.local:7447",), (), ("/r1/*", "/hall/r1"), ("/fleet/r1",))
R2 = ZenohRouter("/r2/router", ("10.0.0.2:7448",), (), ("/r2/*", "/hall/r2"))


def generate(root: Path, fleet: str) -> str:
    """Generate what a fleet file asks for, and return what is said about it."""
    (root.parent / "policy.xml").write_text(POLICY)
    (root.parent / "fleet.toml").write_text(fleet)
    files = ("-p", root.parent / "policy.xml", "--fleet", root.parent / "fleet.toml")
    return sros("generate_artifacts", "-k", root, *files).ok().err


@pytest.fixture
def keystore(tmp_path: Path) -> Path:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    assert "fleet.no-zenoh-network" in generate(root, FLEET)
    sros("zenoh", root, "--endpoint", "office:7447").ok()
    return root


def network(root: Path) -> ZenohNetwork:
    zenoh = parse_template((root / "sros.toml").read_text(), "").zenoh
    assert zenoh
    return zenoh


def connects(root: Path, enclave: str, file: str = "session.json5") -> list[str]:
    document = json.loads((root / "enclaves" / enclave / file).read_text())
    return [endpoint.removeprefix("tls/") for endpoint in document["connect"]["endpoints"]]


def heard_by(root: Path, enclave: str, topic: str) -> str:
    answer = sros("explain", root, enclave, "publish", topic, "--vendor", "zenoh").ok().out
    return next(line for line in answer.splitlines() if "heard by" in line).split(maxsplit=2)[2]


def test_each_robot_has_the_router_of_its_file(keystore: Path) -> None:
    assert network(keystore).routers == (R1, R2)
    sessions = ("r1/base", "hall/r1", "r2/base", "hall/r2", "r3/base", "office")
    one, two, office = "r1.local:7447", "10.0.0.2:7448", "office:7447"
    assert [connects(keystore, each) for each in sessions] == [
        *([one], [one], [two], [two]),
        *([office], [office]),
    ]
    assert connects(keystore, "r2/router", "router.json5") == [office, one]
    # The router of r1 passes on /fleet/r1 alone; that of r2 whatever both ends may.
    assert heard_by(keystore, "/r1/base", "/scan") == "/hall/r1"
    assert heard_by(keystore, "/r1/base", "/fleet/r1") == "/office"
    assert heard_by(keystore, "/r2/base", "/scan") == "/hall/r2, /hall/r3, /office"
    sros("zenoh", keystore, "--check").ok()


def test_the_router_belongs_to_the_robot(keystore: Path, tmp_path: Path) -> None:
    listed = sros("list_enclaves", keystore, "--robot", "r1").ok().out.split()
    assert listed == ["/hall/r1", "/r1/base", "/r1/router"]
    assert "/r3/router" not in sros("list_enclaves", keystore).ok().out
    sros("distribute_key", keystore, "--robot", "r1", tmp_path / "r1").ok()
    assert (tmp_path / "r1/enclaves/r1/router/router.json5").exists()
    report = sros("fleet", "report", tmp_path / "r1", "--robot", "r1").ok().out
    (tmp_path / "r1.json").write_text(report)
    sros("fleet", "confirm", keystore, "--robot", "r1", tmp_path / "r1.json").ok()
    assert sros("fleet", "status", keystore, "--robot", "r1").out.startswith("1 robot: 1 current")
    sros("env", tmp_path / "r1", "/r1/router", "--rmw", "rmw_zenoh_cpp").ok()


def test_the_network_follows_the_fleet_file(keystore: Path) -> None:
    moved = FLEET.replace("r3 = {}", 'r3 = { router = "r3.local:7447" }').replace("7448", "7449")
    generate(keystore, moved)
    names = [(router.name, router.endpoints[0]) for router in network(keystore).routers]
    assert names == [
        ("/r1/router", "r1.local:7447"),
        ("/r2/router", "10.0.0.2:7449"),
        ("/r3/router", "r3.local:7447"),
    ]
    assert connects(keystore, "r3/base") == ["r3.local:7447"]
    gone = generate(keystore, FLEET.replace('r1 = { groups = ["carriers"] }', ""))
    assert "r1 is no longer in the fleet, but its earlier enclaves /hall/r1, /r1/base, " in gone
    assert network(keystore).routers == (R2,)
    assert connects(keystore, "r1/base") == ["office:7447"]
    assert not (keystore / "enclaves/r1/router/router.json5").exists()
    sros("zenoh", keystore, "--router", "/extra/router=extra:7447", "--mode", "client").ok()
    assert [router.name for router in network(keystore).routers] == ["/extra/router", "/r2/router"]


def test_a_robot_that_loses_its_router_alone_is_named(keystore: Path) -> None:
    one = FLEET.replace('r1 = { groups = ["carriers"] }', "r1 = {}")
    noted = generate(keystore, one)
    assert "note [fleet.left-router]: the robot r1 has no Zenoh router any more" in noted
    assert f"`sros revoke {keystore} /r1/router`" in noted
    assert "fleet.left-enclaves" not in noted and "robot r2 has no" not in noted
    assert network(keystore).routers == (R2,)
    # So is the last router of a fleet.
    noted = generate(keystore, "robots = { r1 = {}, r2 = {}, r3 = {} }")
    assert "the robot r2 has no Zenoh router any more: its enclave /r2/router stays" in noted
    assert "fleet.left-enclaves" not in noted
    sros("revoke", keystore, "/r1/router", "/r2/router").ok()


def test_a_revoked_robot_has_no_router(keystore: Path) -> None:
    revoked = sros("revoke", keystore, "--robot", "r1").ok()
    assert "/r1/router is no longer a router" in revoked.err
    sros("zenoh", keystore).ok()
    assert network(keystore).routers == (R2,)
    assert "/r1/router" not in sros("list_enclaves", keystore).ok().out


@pytest.mark.parametrize("value", ["/r1/router=", "/r1/router=elsewhere:7447"])
def test_the_fleet_file_alone_says_where_the_router_of_a_robot_is(
    keystore: Path, value: str
) -> None:
    refused = sros("zenoh", keystore, "--router", value)
    assert refused.status == 2
    assert "sets the router of r1" in refused.err
    assert network(keystore).routers == (R1, R2)
    edited = (keystore / "sros.toml").read_text().replace("r1.local", "r9.local")
    (keystore / "sros.toml").write_text(edited)
    again = (keystore.parent / "fleet.toml").read_text().replace("7448", "7450")
    (keystore.parent / "fleet.toml").write_text(again)
    files = ("-p", keystore.parent / "policy.xml", "--fleet", keystore.parent / "fleet.toml")
    refused = sros("generate_artifacts", "-k", keystore, *files)
    assert refused.status == 2
    assert "edited by hand" in refused.err


def test_a_fleet_with_routers_is_read_as_it_was_written() -> None:
    text = FLEET.replace("[groups", 'enclaves = ["/{robot}/x"]\nrouters = "/z/{robot}"\n[groups', 1)
    fleet = parse_fleet(text.encode(), "the file")
    assert fleet.enclaves == ("/{robot}/x", "/z/{robot}")
    assert parse_fleet(render_fleet(fleet).encode(), "it") == fleet
