"""Robots of one fleet in different ROS domains: no answer connects them across domains."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.harness import policy_text, publish, sros


def subscribe(*names: str) -> str:
    """Return a group of topics to subscribe to, as XML."""
    return publish(*names).replace("publish", "subscribe")


FLEET = """
[groups]
forklifts = {}
pickers = {}
north = { domain = 10 }
south = { domain = 20 }
[robots]
f01 = { groups = ["forklifts", "north"] }
f02 = { groups = ["forklifts", "south"] }
p01 = { groups = ["pickers", "north"] }
p02 = { groups = ["pickers", "south"] }
"""
POLICY = policy_text(
    {
        "/{robot:forklifts}/guard": publish("/hall/estop") + subscribe("/plan"),
        "/{robot:pickers}/wheels": subscribe("/hall/estop"),
        "/{robot:pickers}/eye": publish("/hall/seen"),
        "/desk": publish("/plan") + subscribe("/hall/seen"),
    }
)


@pytest.fixture(scope="module")
def halls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("halls")
    (folder / "p.xml").write_text(POLICY)
    (folder / "f.toml").write_text(FLEET)
    sros("create_keystore", "ks", "--domain", "10,20", cwd=folder).ok()
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", "--fleet", "f.toml", cwd=folder).ok()
    sros("zenoh", "ks", cwd=folder).ok()
    return folder


SOURCES = (("ks",), ("ks", "--vendor", "zenoh"), ("--policy", "p.xml", "--fleet", "f.toml"))


@pytest.mark.parametrize("source", SOURCES)
def test_information_stays_in_a_domain_except_through_an_enclave_of_both(
    halls: Path, source: tuple[str, ...]
) -> None:
    def reached(*words: str) -> dict[str, set[str]]:
        asked = sros("explain", *source, "--reach", *words, "--json", cwd=halls).ok()
        answer = json.loads(asked.out)
        ways = ("influences", "learns_from")
        return {way: {each["enclave"] for each in answer[way]} - {"/router"} for way in ways}

    assert reached("/p01/wheels") == {
        "influences": set(),
        "learns_from": {"/f01/guard", "/desk", "/p01/eye", "/p02/eye"},
    }
    assert reached("/p01/wheels", "--domain", "10") == {
        "influences": set(),
        "learns_from": {"/f01/guard", "/desk", "/p01/eye"},
    }
    assert reached("/desk", "--domain", "20")["influences"] == {"/f02/guard", "/p02/wheels"}
    asked = sros("explain", *source, "--reach", "/p01/wheels", "--domain", "20", cwd=halls)
    assert asked.status == 2 and "has no rights in" in asked.err and "domain 20" in asked.err


def test_who_may_do_it_in_which_domain(halls: Path) -> None:
    def said(*words: str, **env: str) -> list[str]:
        asked = sros("explain", "ks", "--who", "publish", *words, cwd=halls, env=env)
        return asked.ok().out.splitlines()

    guards = ["/f01/guard  in domain 10", "/f02/guard  in domain 20"]
    few = ": 1 in domain 10, 1 in domain 20"
    assert said("/hall/estop") == [*guards, f"2 of 8 enclaves may publish topic /hall/estop{few}"]
    assert said("/hall/estop", ROS_DOMAIN_ID="10") == said("/hall/estop")  # not only there
    assert said("/hall/estop", "--domain", "10") == [
        "/f01/guard",
        "1 of 8 enclaves may publish topic /hall/estop in domain 10",
    ]
    assert said("/plan") == ["/desk", "1 of 8 enclaves may publish topic /plan"]
    router = "/router  in domain 10,20"
    assert said("/hall/estop", "--vendor", "zenoh")[:-1] == [*guards, router]
    asked = sros("explain", "ks", "--who", "publish", "/plan", "--json", cwd=halls).ok()
    outcomes = {each["enclave"]: each["domains"] for each in json.loads(asked.out)["enclaves"]}
    assert outcomes["/desk"] == "10,20" and outcomes["/p01/eye"] is None
