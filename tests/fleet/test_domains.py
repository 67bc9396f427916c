"""Robots of one fleet in different ROS domains: no answer connects them across domains."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.support.harness import copy_of, policy_text, publish, snapshot, sros, subscribe

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
    for domain, enclave in (("10", "/f01/guard"), ("20", "/f02/guard")):
        for words in ((), ("--domain", domain)):
            asked = sros("explain", "ks", enclave, "publish", "/hall/estop", *words, cwd=halls)
            named = f"yes: {enclave} may publish topic /hall/estop in domain {domain}, on "
            assert asked.ok().out.startswith(named), asked
        asked = sros("explain", "ks", "--all-vendors", enclave, "publish", "/hall/estop", cwd=halls)
        assert asked.ok().out.startswith(
            f"may {enclave} publish topic /hall/estop in domain {domain}?"
        )
    assert said("/plan") == ["/desk", "1 of 8 enclaves may publish topic /plan"]
    router = "/router  in domain 10,20"
    assert said("/hall/estop", "--vendor", "zenoh")[:-1] == [*guards, router]
    asked = sros("explain", "ks", "--who", "publish", "/plan", "--json", cwd=halls).ok()
    outcomes = {each["enclave"]: each["domains"] for each in json.loads(asked.out)["enclaves"]}
    assert outcomes["/desk"] == "10,20" and outcomes["/p01/eye"] is None


REQUIREMENTS = """
[[apart]]
from = ["/f02/*"]
to = ["/p01/*"]
[[apart]]
from = ["/p02/*"]
to = ["/f01/*"]
[[must]]
enclave = "/p01/wheels"
subscribe = ["/hall/estop"]
[[must]]
enclave = "/p02/wheels"
subscribe = ["/nothing"]
"""


def test_requirements_hold_in_the_domains_of_each_enclave(halls: Path) -> None:
    (halls / "r.toml").write_text(REQUIREMENTS)

    def broken(*source: str) -> list[str]:
        words = ("--requirements", "r.toml", "--include", "requirement.*", "--json")
        checked = json.loads(sros("check", *source, *words, cwd=halls).out)
        return sorted(each["text"].partition(", but")[0] for each in checked["findings"])

    chain = "/p02/eye -publish /hall/seen-> /desk -publish /plan-> /f01/guard"
    for vendor in ("fastdds", "zenoh"):
        assert broken("ks", "--vendor", vendor) == [
            f"influences /f01/guard: {chain}",
            "may not subscribe /nothing",
        ]
    # A policy says no domains, and counts as being for a single one.
    across = "influences /p01/wheels: /f02/guard -publish /hall/estop-> /p01/wheels"
    assert across in broken("p.xml", "--fleet", "f.toml")


def test_nodes_of_different_robots_may_have_the_same_name(halls: Path) -> None:
    words = ("check", "ks", "--policy", "p.xml", "--include", "policy.node-in-two-enclaves")
    assert sros(*words, cwd=halls).ok().out == sros(*words, "--fleet", "f.toml", cwd=halls).out
    for fleet in ((), ("--fleet", "f.toml")):
        counted = sros("metrics", "ks", "--policy", "p.xml", *fleet, cwd=halls).ok().out
        assert "sros_findings_of_kind" in counted and "node-in-two-enclaves" not in counted


def test_new_reach_stays_in_a_domain(halls: Path) -> None:
    (halls / "base.xml").write_text(POLICY.replace("/hall/estop", "/hall/stop", 1))
    words = ("base.xml", "p.xml", "--fleet", "f.toml", "--json")
    compared = json.loads(sros("diff_policy", "--no-new-access", *words, cwd=halls).out)
    reach = {(each["source"], each["target"]) for each in compared["reach"]}
    guards = {pair for pair in reach if pair[0].endswith("/guard")}
    assert guards == {("/f01/guard", "/p01/wheels"), ("/f02/guard", "/p02/wheels")}


ALIKE = (
    "[groups]\npickers = {}\nforklifts = {}\n[robots]\n"
    + "".join(
        f'p{n} = {{ groups = ["pickers"], domain = {10 + n // 4 * 10} }}\n' for n in range(1, 7)
    )
    + "".join(f'f{n} = {{ groups = ["forklifts"], domain = 10 }}\n' for n in range(1, 4))
)


def test_robots_of_other_domains_and_groups_are_neither_equal_nor_different(
    tmp_path: Path,
) -> None:
    of_all = {"eye": publish("{namespace}/scan"), "pilot": subscribe("{namespace}/scan")}
    of_all["pilot"] += publish("{namespace}/cmd")
    enclaves = {
        f"/{{robot:{group}}}/{name}": text
        for group in ("pickers", "forklifts")
        for name, text in of_all.items()
    }
    odd = {"/p2/wheels": subscribe("/p2/cmd"), "/{robot:forklifts}/fork": subscribe("/up")}
    (tmp_path / "p.xml").write_text(policy_text(enclaves | odd))
    (tmp_path / "f.toml").write_text(ALIKE)

    def said(*focus: str) -> list[str]:
        words = ("p.xml", "--fleet", "f.toml", *focus, "-o", f"{len(focus)}.svg")
        return sros("view", *words, cwd=tmp_path).ok().err.splitlines()

    shown = json.loads(sros("view", "p.xml", "--fleet", "f.toml", "--json", cwd=tmp_path).ok().out)
    (note,) = [each for each in shown["findings"] if each["id"] == "view.domains"]
    assert "different ROS domains (10 and 20)" in note["text"]
    lines = said()
    assert "p1 … p3: 2 equal robots in domain 10 are drawn as one" in lines
    assert "p4 … p6: 3 equal robots in domain 20 are drawn as one" in lines
    assert "f1 … f3: 3 equal robots in domain 10 are drawn as one" in lines
    # A robot is compared with those of its group and domain.
    (different,) = [line for line in lines if "differs" in line]
    assert different.startswith("p2 differs from p1 … p3: it has enclave /p2/wheels")
    assert not [line for line in said("--focus", "/p5/cmd") if "differs" in line]
    focused = said("--focus", "/p5/scan", "--focus", "/up")
    assert not [line for line in focused if "differs" in line]


def test_a_process_of_several_domains_is_told_of_them(halls: Path) -> None:
    for name, words, said in (("/desk", (), True), ("/desk", ("--domain", "20"), False)):
        ended = sros("env", "ks", name, *words, cwd=halls).ok()
        assert ("may run in any of the domains 10,20, and runs in 10" in ended.err) is said
    assert "several" not in sros("env", "ks", "/f02/guard", cwd=halls).ok().err


def test_a_process_in_a_wrong_domain_gets_the_domain_of_its_enclave(halls: Path) -> None:
    for domain, said in ((30, "Set ROS_DOMAIN_ID to 20, or add"), (10, "10, only in domain 20. ")):
        ended = sros("env", "ks", "/f02/guard", "--domain", domain, cwd=halls)
        assert ended.status == 2 and said in ended.err


def test_a_name_that_nobody_has_leads_to_that_of_the_robot(halls: Path) -> None:
    asked = ("explain", "ks", "--who", "publish")
    ended = sros(*asked, "/north/estop", cwd=halls)
    assert (
        ended.status == 1
        and "some enclaves may publish /hall/estop: perhaps the right name" in ended.err
    )
    for words in (("/nothing",), ("/plan", "--robot", "p01"), ("/x/plan", "--robot", "p01")):
        ended = sros(*asked, *words, cwd=halls)
        assert ended.status == 1 and "perhaps" not in ended.err, ended


MOVED = FLEET.replace('"pickers", "north"', '"pickers", "south"')


@pytest.mark.parametrize(
    ("keystore", "name", "words", "noted"),
    [
        ("new", "/p02/eye", ("-p", "literal.xml", "--fleet", "f.toml"), True),
        ("new", "/p02/eye", ("-p", "p.xml", "--fleet", "f.toml"), False),
        ("ks", "/p03/eye", (), True),
        ("ks", "/p02/new", ("-p", "new.xml", "--fleet", "f.toml"), False),
    ],
)
def test_a_request_that_gets_the_domains_of_all_robots_is_noted(
    halls: Path, tmp_path: Path, keystore: str, name: str, words: tuple[str, ...], *, noted: bool
) -> None:
    (halls / "literal.xml").write_text(POLICY.replace("/{robot:pickers}/eye", "/p02/eye"))
    (halls / "new.xml").write_text(NEW)
    sros("create_request", name, tmp_path / "robot").ok()
    if not (halls / "new").exists():
        sros("create_keystore", "new", "--domain", "10,20", cwd=halls).ok()
    request = tmp_path / f"robot/enclaves{name}/request.pem"
    sign = ("sign_request", keystore, request, "--dry-run")
    signed = sros(*sign, "--enclave", name, *words, cwd=halls).ok()
    said = f"[request.all-domains]: {name} belongs to no robot of the fleet, so its permissions"
    assert (said in signed.err) is noted


NEW = POLICY.replace("/{robot:pickers}/eye", "/{robot:pickers}/new")
"""A policy whose robots are known to the keystore, but not with this enclave path."""


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("name", ["/p01/wheels", "/p01/new"])
@pytest.mark.parametrize("verb", ["sign_request", "create_permission"])
def test_permissions_are_for_the_domain_in_the_fleet_file(
    tmp_path: Path, verb: str, name: str, *, recorded: bool
) -> None:
    """The domain does not depend on whether the keystore records the robot already."""
    files = {"f.toml": FLEET, "moved.toml": MOVED, "new.xml": NEW, "p.xml": POLICY}
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    words: tuple[str, ...] = ("--domain", "10,20")
    sros("create_keystore", "ks", *words, cwd=tmp_path).ok()
    if recorded:
        words = ("-k", "ks", "-p", "p.xml", "--fleet", "f.toml", "--robot", "p01")
        sros("generate_artifacts", *words, cwd=tmp_path).ok()
    if verb == "sign_request":
        sros("create_request", name, "robot", cwd=tmp_path).ok()
        if recorded and name == "/p01/wheels":
            sros("revoke", "ks", name, cwd=tmp_path).ok()
        request = f"robot/enclaves{name}/request.pem"
        words = ("ks", request, "--enclave", name, "-p", "new.xml", "-o", "answer.tgz")
    else:
        if not (recorded and name == "/p01/wheels"):
            sros("create_enclave", "ks", name, cwd=tmp_path).ok()
        words = ("ks", name, "new.xml")
    before = snapshot(tmp_path / "ks")
    if recorded:
        refused = sros(verb, *words, "--fleet", "moved.toml", cwd=tmp_path)
        said = "has the robot p01 in domain 20, but the keystore's fleet has it in domain 10"
        assert (refused.status, said in refused.err) == (2, True), refused
        assert snapshot(tmp_path / "ks") == before
    fleet = "ks/fleet.toml" if recorded else "f.toml"
    sros(verb, *words, "--fleet", fleet, cwd=tmp_path).ok()
    permissions = tmp_path / f"ks/enclaves{name}/permissions.xml"
    assert re.findall("<domains>(.*?)</domains>", re.sub(r"\s", "", permissions.read_text())) == [
        "<id>10</id>"
    ]
    # Nothing is lost when the fleet is recorded, and check knows the robot from the fleet file.
    words = ("--fleet", "f.toml", "--json")
    checked = json.loads(sros("check", "ks", "--policy", "new.xml", *words, cwd=tmp_path).out)
    assert "enclave.permissions-domains" not in {each["id"] for each in checked["findings"]}
    if name == "/p01/wheels" or not recorded:
        made = sros("generate_artifacts", "-k", "ks", "-p", "new.xml", *words, cwd=tmp_path)
        assert "loses" not in made.ok().err and '"domain 20"' not in made.out


def test_check_wants_the_domain_that_the_keystore_has_for_a_robot(tmp_path: Path) -> None:
    """As create_permission gives it, also if the fleet file has moved the robot since."""
    files = {"f.toml": FLEET, "moved.toml": MOVED, "p.xml": POLICY, "new.xml": NEW}
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    sros("create_keystore", "ks", "--domain", "10,20", cwd=tmp_path).ok()
    words = ("-k", "ks", "-p", "p.xml", "--fleet", "f.toml", "--robot", "p01")
    sros("generate_artifacts", *words, cwd=tmp_path).ok()
    sros("create_enclave", "ks", "/p01/new", cwd=tmp_path).ok()
    for fleet in ("f.toml", "moved.toml"):
        checked = sros("check", "ks", "--policy", "new.xml", "--fleet", fleet, cwd=tmp_path)
        assert "are for domain 10,20, but its robot is in domain 10\n" in checked.out, fleet


def test_the_domains_of_a_robot_that_left_are_shown_with_their_cause(
    halls: Path, tmp_path: Path
) -> None:
    """Without the fleet file, the robot's domain is unknown; the remedy is not to sign again."""
    folder = copy_of(halls, tmp_path / "halls")
    (folder / "f.toml").write_text(re.sub("p01 = .*\n", "", FLEET))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", "--fleet", "f.toml", cwd=folder).ok()
    shown = sros("check", "ks", cwd=folder).out
    assert "Enclaves of p01: /p01/eye, /p01/wheels. Other robots still accept" in shown
    assert "found: permissions and governance for different domains (2 times)" in " ".join(
        shown.split()
    )
    assert "Revoke the enclaves with" in shown and "Sign both" not in shown
    alone = sros("check", "ks", "--exclude", "keystore.robot-left", cwd=folder).out
    assert "Sign both for the same domains" in alone, "nothing is hidden without its cause"


@pytest.mark.parametrize("verb", ["sign_request", "create_permission"])
@pytest.mark.parametrize(
    ("recorded", "stated"),
    [("p01 = {}", "p01 = { domain = 10 }"), ("p01 = { domain = 10 }", "p01 = {}")],
)
def test_the_only_domain_of_a_keystore_may_be_stated_or_not(
    tmp_path: Path, verb: str, recorded: str, stated: str
) -> None:
    (tmp_path / "p.xml").write_text(policy_text({"/{robot}/wheels": publish("/speed")}))
    (tmp_path / "f.toml").write_text(f"[robots]\n{recorded}\n")
    (tmp_path / "stated.toml").write_text(f"[robots]\n{stated}\n")
    sros("create_keystore", "ks", "--domain", "10", cwd=tmp_path).ok()
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", "--fleet", "f.toml", cwd=tmp_path).ok()
    words: tuple[str, ...] = ("ks", "/p01/wheels", "p.xml")
    if verb == "sign_request":
        sros("revoke", "ks", "/p01/wheels", cwd=tmp_path).ok()
        sros("create_request", "/p01/wheels", "robot", cwd=tmp_path).ok()
        request = "robot/enclaves/p01/wheels/request.pem"
        words = ("ks", request, "--enclave", "/p01/wheels", "-p", "p.xml", "-o", "answer.tgz")
    sros(verb, *words, "--fleet", "stated.toml", cwd=tmp_path).ok()


def test_an_enclave_that_has_its_robots_domain_already_needs_no_policy(tmp_path: Path) -> None:
    """Its request was signed for the fleet file before the keystore recorded the robot."""
    south = FLEET.replace('["pickers", "north"] }\np02', '["pickers", "south"] }\np02')
    without = FLEET.replace('p01 = { groups = ["pickers", "north"] }\n', "")
    for file, text in {"f.toml": FLEET, "without.toml": without, "south.toml": south}.items():
        (tmp_path / file).write_text(text)
    (tmp_path / "p.xml").write_text(POLICY)
    eye = policy_text({"/{robot:pickers}/eye": publish("/hall/seen")})
    (tmp_path / "eye.xml").write_text(eye)
    (tmp_path / "rest.xml").write_text(POLICY.replace("/{robot:pickers}/eye", "/eye"))
    sros("create_keystore", "ks", "--domain", "10,20", cwd=tmp_path).ok()
    generate = ("generate_artifacts", "-k", "ks", "-p")
    sros(*generate, "p.xml", "--fleet", "without.toml", cwd=tmp_path).ok()
    sros("create_request", "/p01/eye", "robot", cwd=tmp_path).ok()
    request = "robot/enclaves/p01/eye/request.pem"
    words = ("ks", request, "-p", "eye.xml", "--fleet", "f.toml", "-o", "answer.tgz")
    sros("sign_request", *words, cwd=tmp_path).ok()
    refused = sros(*generate, "rest.xml", "--fleet", "south.toml", cwd=tmp_path)
    assert (refused.status, "permissions for domain 10." in refused.err) == (2, True)
    sros(*generate, "rest.xml", "--fleet", "f.toml", cwd=tmp_path).ok()
