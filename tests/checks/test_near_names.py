"""Which names are taken for typing errors of another one, and which are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.checks.kind import Finding
from sros_tool.checks.policies.policy import policy_file_findings
from sros_tool.files import policies_dir
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.spelling import NearNames
from tests.checks.policy_cases import services, topics

NEAR = [
    ("/griper/set", "/gripper/set"),
    ("/scan", "/scans"),
    ("/scan", "/sacn"),
    ("/front/scan", "/front/scam"),
    ("/cmd_vel", "/cmdvel"),
    ("/cmd_vel", "/Cmd_Vel"),
    ("/arm/joint_states", "/arm/joint_state"),
]
DIFFERENT = [
    ("/r1/grip", "/r2/grip"),
    ("/camera1/image", "/camera12/image"),
    ("/arm_l/state", "/arm_r/state"),
    ("/wheel_fl", "/wheel_fr"),
    ("/x_min", "/x_max"),
    ("/left/image", "/right/image"),
    ("/light/start", "/light/state"),
    ("/scan", "/front/scan"),
    ("/grip", "/drive"),
    ("/scan", "/scan"),
]


@pytest.mark.parametrize(("one", "other"), NEAR)
def test_near(one: str, other: str) -> None:
    assert NearNames([one, "/x"]).similar_names(other) == [one]
    assert NearNames([other, "/x"]).similar_names(one) == [other]


@pytest.mark.parametrize(("one", "other"), DIFFERENT)
def test_different(one: str, other: str) -> None:
    assert NearNames([one]).similar_names(other) == []
    assert NearNames([other]).similar_names(one) == []


@pytest.mark.parametrize(
    ("one", "other", "near"),
    [
        ("/gripper/home", "/left/gripper/home", True),
        ("/gripper/home", "/cell/left/gripper/home", True),
        ("/home", "/left/home", False),
        ("/r1/gripper/home", "/r2/gripper/home", False),
        ("/gripper/home", "/left_gripper/home", False),
        ("/gripper/home", "/gripper/home", False),
    ],
)
def test_a_namespace_more_or_less(one: str, other: str, near: bool) -> None:
    assert NearNames([one, "/x/y"]).same_name_elsewhere(other) == [one] * near
    assert NearNames([other, "/x/y"]).same_name_elsewhere(one) == [other] * near


OTHER = '</profile><profile ns="/" node="_b">'


def findings(path: Path, content: str) -> dict[str, Finding]:
    path.write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/a"><profiles><profile ns="/" '
        f'node="_a">{content}</profile></profiles></enclave></enclaves></policy>'
    )
    return {each.id: each for each in policy_file_findings(path)}


def found(path: Path, content: str) -> dict[str, str]:
    return {identity: each.text for identity, each in findings(path, content).items()}


CALL = '<actions call="ALLOW"><action>pick</action></actions>'
EXECUTE = CALL.replace("call", "execute")
AN_ACTION = 'as an action: <actions {}="ALLOW"><action>pick</action></actions>.'


@pytest.mark.parametrize(
    ("asking", "offering", "text", "remedy"),
    [
        (CALL, services("reply", "pick"), "a service of this name (reply)", "p.xml:1 " + AN_ACTION),
        (services("request", "pick"), EXECUTE, "an action of this name (execute)", AN_ACTION),
        (
            topics("subscribe", "pick"),
            services("reply", "pick"),
            "a service of this name (reply)",
            "same kind",
        ),
    ],
)
def test_another_kind_is_meant(
    asking: str, offering: str, text: str, remedy: str, tmp_path: Path
) -> None:
    said = findings(tmp_path / "p.xml", asking + OTHER + offering)["policy.name-misspelt"]
    assert f"; /a offers {text}, which no enclave uses" in said.text
    right = "call" if "request" in asking else "execute"
    assert remedy.format(right) in said.remedy
    same = found(tmp_path / "p.xml", asking + offering)
    assert "policy.name-misspelt" not in same, "of one node"


def test_a_name_in_another_namespace(tmp_path: Path) -> None:
    file, (one, other) = tmp_path / "p.xml", ("/gripper/home", "/left/gripper/home")
    said = found(file, services("request", one) + OTHER + services("reply", other))
    assert said == {
        "policy.name-misspelt": f"no enclave may reply {one}; perhaps you mean {other} (reply)"
    }
    said = found(file, services("request", one) + OTHER + topics("publish", other))
    assert set(said) == {"policy.no-counterpart"}, "of another kind"
    assert "/left" not in said["policy.no-counterpart"]
    said = found(file, services("request", "*calibrate") + OTHER + services("reply", other))
    text = "no enclave may reply a name that /*calibrate matches"
    assert said["policy.no-counterpart"] == text
    both = services("reply", other) + services("request", other)
    assert set(found(file, services("request", one) + OTHER + both)) == {"policy.no-counterpart"}


@pytest.mark.parametrize(
    ("heard", "sent", "warns"),
    [
        ("/cmd_vel", ["cmd_vel"], True),
        ("/cmd_vel", ["/nav/cmd_vel"], True),
        ("/a/cmd_vel", ["/cmd_vel"], True),
        ("/cmd_vel", ["/nav/cmd_vel", "/ui/cmd_vel"], False),
        ("/cmd_vel", ["cmd_vel", "/ui/cmd_vel"], False),
        ("/r1/cmd_vel", ["cmd_vel"], False),
    ],
)
def test_one_part_in_another_namespace(
    heard: str, sent: list[str], warns: bool, tmp_path: Path
) -> None:
    """Where several names may be meant, or both have a namespace, they are named in a note."""
    other = OTHER.replace('ns="/"', 'ns="/nav"')
    said = found(tmp_path / "p.xml", topics("subscribe", heard) + other + topics("publish", *sent))
    kind = "policy.name-misspelt" if warns else "policy.no-counterpart"
    names = (name if name.startswith("/") else f"/nav/{name}" for name in sent)
    meant = " or ".join(f"{name} (publish)" for name in names)
    text = f"no enclave may publish {heard}; perhaps you mean {meant}"
    assert said == {kind: text}


def test_a_name_with_a_counterpart_is_no_typing_error(tmp_path: Path) -> None:
    used = topics("publish", "scan") + topics("subscribe", "scan")
    assert set(found(tmp_path / "p.xml", used + topics("subscribe", "scam"))) == {
        "policy.no-counterpart"
    }
    assert found(tmp_path / "p.xml", used + topics("publish", "scam")) == {}
    heard = topics("subscribe", "front/image") + topics("subscribe", "frnt/image")
    said = found(tmp_path / "p.xml", topics("publish", "front/image", "rear/image") + OTHER + heard)
    near = "no enclave may publish /frnt/image; perhaps you mean /front/image (publish)"
    assert said["policy.no-counterpart"] == near


def test_the_shipped_policies_have_none() -> None:
    for file in policies_dir().rglob("*.xml"):
        ids = {each.id for each in policy_file_findings(file)}
        assert not ids & {"policy.name-misspelt", "policy.side-mistaken", SEVERAL}, file


SEVERAL = "policy.several-servers"


def sides(path: Path, server: str, client: str, kind: str = "policy.side-mistaken") -> list[str]:
    """Return the texts of findings about sides; both nodes are in enclaves of their own."""
    profiles = (
        f'<enclave path="/{name}"><profiles>\n<profile ns="/" node="_{name}">{content}</profile>'
        "</profiles></enclave>"
        for name, content in (("server", server), ("client", client))
    )
    path.write_text(f'<policy version="0.2.0"><enclaves>{"".join(profiles)}</enclaves></policy>')
    said = [each for each in policy_file_findings(path) if each.id == kind]
    return [f"{each.line}: {each.text} {each.remedy}" for each in said]


def test_sides_that_are_mistaken_for_each_other(tmp_path: Path) -> None:
    file, use = tmp_path / "p.xml", services("request", "_server/home")
    right = services("reply", "~/home")
    assert sides(file, right, use) == []
    assert sides(file, right, "") == []
    (own,) = sides(file, services("request", "~/home"), use)
    assert own.startswith("2: the node may request service /_server/home, a name of its own that")
    assert own.endswith('Write reply="ALLOW" for it.')
    (foreign,) = sides(file, right, foreign_server := services("reply", "_server/home"))
    assert foreign.startswith("3: the node may reply service /_server/home, under the name of a")
    assert foreign.endswith('Write request="ALLOW" for it.')
    assert sides(file, right, foreign_server, SEVERAL) == []
    assert "p.xml:2" in foreign and "nobody may request it" in foreign
    both = services("reply", "_server/home") + use
    assert sides(file, right, both) == [], "a second server"
    assert sides(file, topics("subscribe", "~/goal"), "") == [], "of topics, this is usual"


EXECUTE = '<actions execute="ALLOW"><action>{}</action></actions>'
PART = services("reply", "_server/go/_action/send_goal")


@pytest.mark.parametrize(
    ("server", "other", "found"),
    [
        (services("reply", "~/home"), services("reply", "_server/home"), True),
        (services("reply", "~/*"), services("reply", "_server/home"), True),
        (services("reply", "/clear"), services("reply", "/clear"), True),
        (EXECUTE.format("~/go"), EXECUTE.format("_server/go"), True),
        (EXECUTE.format("~/go"), PART, True),
        (services("reply", "~/home"), services("reply", "*"), False),
        (services("reply", "*"), services("reply", "/clear"), False),
        (services("reply", "~/home"), services("reply", "~/home"), False),
        (services("reply", "~/stop"), services("reply", "_server/home"), False),
        (
            services("reply", "~/home"),
            services("reply", "_server/home") + services("reply", "_server/*", qualifier="DENY"),
            False,
        ),
        # "policy.other-nodes-parameters" is about these.
        (services("reply", "~/*"), services("reply", "_server/set_parameters"), False),
    ],
)
def test_two_servers_of_a_service(tmp_path: Path, server: str, other: str, found: bool) -> None:
    """Twins: each serves its own names, or the names of a wildcard; also if somebody calls."""
    used = services("request", "/_server/home", "/clear")
    used += EXECUTE.format("/_server/go").replace("execute", "call")
    assert len(sides(tmp_path / "p.xml", server + used, other, SEVERAL)) == found


@pytest.mark.parametrize(("groups", "found"), [(("", ""), 2), ((":g1", ":g2"), 0)])
def test_two_servers_on_one_robot_of_a_fleet(
    tmp_path: Path, groups: tuple[str, str], found: int
) -> None:
    """Twin: robots in other ROS domains may have servers, and nodes, with the same names."""
    file = tmp_path / "p.xml"
    offer = services("reply", "/clear")
    enclaves = (
        f'<enclave path="/{{robot{group}}}/{name}"><profiles><profile ns="/" node="n">{offer}'
        "</profile></profiles></enclave>"
        for group, name in zip(groups, "ab", strict=True)
    )
    file.write_text(f'<policy version="0.2.0"><enclaves>{"".join(enclaves)}</enclaves></policy>')
    fleet = Fleet.of(Robot(f"r{n}", "/", n, groups=(f"g{n}",)) for n in (1, 2))
    seen = [of.id for of in policy_file_findings(file, fleet=fleet)]
    assert (seen.count(SEVERAL), seen.count("policy.node-in-two-enclaves")) == (found, found)
