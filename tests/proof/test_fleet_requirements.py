"""Requirements with placeholders: for each robot of a fleet, and proposals with them."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.errors import DocumentError
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.proof.findings import decide_all
from sros_tool.proof.requirements import Requirement, demand, parse_requirements
from sros_tool.proof.suggestions import render_requirements, suggest
from sros_tool.proof.system import load_system
from tests.proof.test_review import Change
from tests.support.harness import policy_text, publish, sros

FLEET = Fleet.of(
    [
        Robot("r1", "/hall/r1", groups=("carriers",)),
        Robot("r2", "/hall/r2", groups=("carriers",)),
        Robot("arm", "/"),
    ],
    ("carriers", "nobody"),
)
EACH = """\
[[only]]
name = "{robot} drives alone"
why = "in {namespace}"
publish = ["{namespace}/cmd_vel"]
enclaves = ["/{robot}/mux"]
"""
FROM_OTHERS = """\
[[apart]]
from = ["/{robots}/*", "!/{robot:carriers}/*"]
to = ["/{robot}/base"]
"""
ONE_LIST = """\
[[nobody]]
publish = ["{namespaces}/stop", "/{robots:carriers}/*/stop", "/plain"]
"""
BOTH = """\
[[not_both]]
first = { publish = ["{namespace}/a"] }
second = { call = ["{namespace}/b"] }
[[must]]
enclave = "/{robot}/mux"
call = ["{namespace}/b"]
"""


def read(text: str, fleet: Fleet | None = FLEET) -> tuple[Requirement, ...]:
    return parse_requirements(text.encode(), "r.toml", lambda: fleet)


def test_a_table_with_a_robot_is_a_requirement_for_each() -> None:
    each = read(EACH)
    assert [demand(one) for one in each] == [
        "only /arm/mux may publish /cmd_vel",
        "only /r1/mux may publish /hall/r1/cmd_vel",
        "only /r2/mux may publish /hall/r2/cmd_vel",
    ]
    assert [one.robot for one in each] == ["arm", "r1", "r2"]
    assert (each[1].name, each[1].why) == ("r1 drives alone", "in /hall/r1")
    assert [demand(one) for one in read(BOTH)][:2] == [
        "nobody may both publish /a and call action /b",
        "nobody may both publish /hall/r1/a and call action /hall/r1/b",
    ]
    assert demand(read(BOTH)[-1]) == "/r2/mux has to be able to call action /hall/r2/b"


def test_words_have_the_values_of_the_group_that_the_names_have() -> None:
    text = EACH.replace("{robot}", "{robot:carriers}").replace(
        "{namespace}", "{namespace:carriers}"
    )
    assert [(one.name, one.why) for one in read(text)] == [
        ("r1 drives alone", "in /hall/r1"),
        ("r2 drives alone", "in /hall/r2"),
    ]


def test_names_of_several_robots_are_in_one_requirement() -> None:
    (one,) = read(ONE_LIST)
    names = "/stop, /hall/r1/stop, /hall/r2/stop, /r1/*/stop, /r2/*/stop, /plain"
    assert dict(getattr(one, "rights"))["publish"] == tuple(names.split(", "))  # noqa: B009
    assert [demand(each) for each in read(FROM_OTHERS)] == [
        "/{other}/* of all other robots must not influence /r1/base",
        "/{other}/* of all other robots must not influence /r2/base",
    ]


def test_the_other_robots_are_named_as_such_only_where_the_list_is_that() -> None:
    cases = {
        '["/{robots:carriers}/*", "!/{robot:carriers}/*"]': "/{other}/* of the other robots of "
        "carriers",
        '["/desk", "{namespaces}/x", "!{namespace:carriers}/x"]': "/desk, /{other}/x of all other "
        "robots",
        '["/{robots}/*", "!/{robot:carriers}/mux"]': "/arm/*, /r1/*, /r2/* (but not /r1/mux)",
        '["/{robots}/*", "/{robots}/mux", "!/{robot:carriers}/*"]': "/{other}/* of all other "
        "robots, /arm/mux, /r1/mux, /r2/mux (but not /r1/*)",
    }
    for sources, said in cases.items():
        first = read(f'[[apart]]\nfrom = {sources}\nto = ["/x"]')[0]
        assert demand(first) == f"{said} must not influence /x"


WRONG = {
    '[[nobody]]\npublish = ["/{robbot}/x"]': "r.toml:2: '/{robbot}/x' is not valid in publish",
    '[[nobody]]\npublish = ["/{robot}*/x"]': "A wildcard is in the same part as {robot}",
    '[[nobody]]\npublish = ["/x}"]': "It has a brace outside of a placeholder",
    '[[nobody]]\npublish = ["{namespace}"]': "'/' is not valid in publish",
    '[[nobody]]\npublish = ["/{robot:carrier}/x"]': "r.toml:2: the fleet has no group 'carrier'",
    '[[nobody]]\npublish = ["/{robots:nobody}/x"]': "{robots:nobody} stands for no robot",
    '[[must]]\nenclave = "/{robots}/x"\ncall = ["/x"]': "It stands for several names",
    '[[only]]\npublish = ["/{robot:nobody}"]\nenclaves = ["/{robot:carriers}"]': "no robot",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_placeholder_without_a_value_is_an_error(text: str) -> None:
    with pytest.raises(DocumentError) as caught:
        read(text)
    assert WRONG[text] in str(caught.value)


def test_one_table_is_about_one_group() -> None:
    fleet = Fleet.of([Robot("a", "/a", groups=("one",)), Robot("b", "/b", groups=("two",))])
    text = '[[only]]\npublish = ["/{robot:one}"]\nenclaves = ["/{robot:two}"]'
    with pytest.raises(DocumentError, match=r"\{robot:one} and \{robot:two} are of different"):
        read(text, fleet)


POLICY = policy_text(
    {
        "/{robot}/mux": publish("{namespace}/cmd_vel"),
        "/{robot}/base": '<topics subscribe="ALLOW"><topic>{namespace}/cmd_vel</topic></topics>',
        "/{robot:carriers}/lift": publish("{namespace}/lift"),
        "/desk": '<topics subscribe="ALLOW"><topic>{namespaces:carriers}/lift</topic></topics>',
    }
)
FILE = """\
[robots]
r1 = { groups = ["carriers"] }
r2 = { groups = ["carriers"] }
r3 = {}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "robot.xml").write_text(POLICY)
    (tmp_path / "fleet.toml").write_text(FILE)
    (tmp_path / "r.toml").write_text(EACH)
    return tmp_path


def test_proposals_for_a_fleet_demand_what_those_for_its_robots_demand(folder: Path) -> None:
    from sros_tool.fleet.fleet_file import read_fleet

    fleet = read_fleet(folder / "fleet.toml")
    system = load_system(
        folder / "robot.xml", Circumstances(datetime(2027, 1, 1, tzinfo=UTC), fleet=fleet)
    )
    each, folded = (suggest(system.rights, system.worlds, of) for of in (None, fleet))
    text = render_requirements(folded.requirements, ["robot.xml"])
    assert "# only /{robot}/mux may publish {namespace}/cmd_vel\n" in text
    assert "# only /{robot:carriers}/lift may publish {namespace:carriers}/lift\n" in text
    filled = read(text, fleet)
    assert sorted(map(demand, filled)) == sorted(map(demand, each.requirements))
    assert decide_all(filled, system).violations == ()
    assert each.comments == folded.comments == []


def test_what_is_not_proposed_for_a_fleet_is_said_once(folder: Path) -> None:
    wide = POLICY.replace("/lift</topic>", "/lift</topic><topic>{namespace}/cmd_*</topic>", 1)
    (folder / "robot.xml").write_text(wide)
    suggested = sros("check", "robot.xml", "--fleet", "fleet.toml", "--suggest", cwd=folder).ok()
    assert [line for line in suggested.out.splitlines() if line.startswith("# not")] == [
        "# not proposed: that only some enclaves may publish {namespace:carriers}/cmd_vel "
        "(stated for 1 enclave, but others may do so by a wildcard, a DENY applies, or nobody has "
        "the other side)"
    ]


def test_a_finding_for_all_robots_is_shown_once(folder: Path) -> None:
    words = ("--requirements", "r.toml", "--include", "requirement.*")
    of_policy = ("check", "robot.xml", "--fleet", "fleet.toml")
    assert sros(*of_policy, *words, cwd=folder).status == 0
    wide = POLICY.replace("/lift</topic>", "/lift</topic><topic>{namespace}/cmd_*</topic>", 1)
    (folder / "robot.xml").write_text(wide)
    ended = sros(*of_policy, *words, cwd=folder)
    assert (ended.status, ended.out.count("requirement.violated")) == (1, 1), ended.out
    assert "only /r1/mux may publish /r1/cmd_vel: in /r1" in ended.out
    assert "the same for 1 more robot: r2" in ended.out
    (folder / "moves.toml").write_text('[[only]]\npublish = ["cmd_vel"]\nenclaves = ["//mux"]\n')
    ended = sros(*of_policy, "--requirements", "moves.toml", "--namespace", "/r1", cwd=folder)
    assert (
        'To keep /mux out of /r1, as the requirement says, write path="/mux/{robot}" in the '
        'policy. In a copy of the requirement, list "//mux/{robot}", and write {namespace}/ before '
        "its names." in ended.out
    )
    panel = '<enclave path="/op/{robot}/ui"><profiles><profile ns="{namespace}" node="ui">'
    panel += publish("{namespace}/light") + "</profile></profiles></enclave></enclaves>"
    (folder / "panel.xml").write_text(POLICY.replace("</enclaves>", panel))
    of_panel = ("check", "panel.xml", *of_policy[2:], *words[2:], "--requirements")
    every = [word for robot in ("r1", "r2", "r3") for word in ("--namespace", f"/{robot}")]
    table = '[[only]]\npublish = ["{}light"]\nenclaves = ["//op/{}ui"]\n'
    (folder / "light.toml").write_text(table.format("", ""))
    ended = sros(*of_panel, "light.toml", *every, cwd=folder)
    assert (
        'to allow this on each robot, list "//op/{robot}/ui" in a copy of the requirement, and '
        "write {namespace}/ before its names." in ended.out
    )
    (folder / "light.toml").write_text(table.format("{namespace}/", "{robot}/"))
    assert "requirement.violated" not in sros(*of_panel, "light.toml", *every, cwd=folder).out
    of_one = sros("check", "robot.xml", "--requirements", "r.toml", cwd=folder)
    assert "stands for" in of_one.err or "Without a fleet" in of_one.err
    keys = ("-k", "ks", "-p", "robot.xml", "--fleet", "fleet.toml")
    sros("generate_artifacts", *keys, cwd=folder).ok()
    ended = sros("check", "ks", *words, cwd=folder)
    assert (ended.status, ended.out.count("requirement.violated")) == (1, 1), ended.out
    assert "the same for 1 more robot: r2" in ended.out
    edited = folder / "ks/fleet.toml"
    edited.write_text(edited.read_text().replace("r2 =", "r4 ="))
    hidden = sros("check", "ks", *words, cwd=folder)
    assert (hidden.status, "is not the file that sros wrote" in hidden.err) == (2, True), hidden
    edited.write_text(edited.read_text().replace("r4 =", "r2 ="))
    one = sros("check", "ks", *words, "--json", cwd=folder)
    assert one.out.count('"requirement.violated"') == 2


CHAINS = """\
[[apart]]
from = ["/*/mux", "!/{robot}/*"]
to = ["/{robot}/base"]
"""


def test_findings_about_two_robots_name_the_one_that_differs(folder: Path) -> None:
    wide = POLICY.replace("<topic>{namespace}/cmd_vel</topic></topics>", "<topic>/*/cmd_vel</topic>"
                          "</topics>")  # fmt: skip
    (folder / "robot.xml").write_text(wide)
    (folder / "r.toml").write_text(CHAINS)
    words = ("--requirements", "r.toml", "--include", "requirement.violated")
    ended = sros("check", "robot.xml", "--fleet", "fleet.toml", *words, cwd=folder)
    said = [line.strip() for line in ended.out.splitlines()]
    first, second = (line for line in said if ": influences " in line)
    assert first.startswith("/r2/mux: influences /r1/base: "), first
    assert second.startswith("/r1/mux: influences /r2/base: "), second
    assert [line for line in said if "the same" in line] == ["the same for 1 more robot: r3"]
    assert said.index("the same for 1 more robot: r3") > said.index(second)


def test_a_review_fills_in_the_fleet_of_each_commit(tmp_path: Path) -> None:
    change = Change(tmp_path)
    change.base = ""
    change.commit({"robot.xml": POLICY, "fleet.toml": FILE, "r.toml": EACH + FROM_OTHERS})
    words = ("--policy", "robot.xml", "--fleet", "fleet.toml", "--requirements", "r.toml")
    change.commit({"fleet.toml": FILE.replace('r2 = { groups = ["carriers"] }\n', "")})
    left = change.review(*words)
    assert "requirements robot.xml: nothing found" in left.out, left
    assert "requirements-before" not in left.out
    change.commit({"fleet.toml": FILE.replace('r2 = { groups = ["carriers"] }', "r2 = {}")})
    moved = change.review(*words)
    assert "requirements-before robot.xml: 1 requirement dropped" in moved.out, moved.out
    change.commit({"fleet.toml": '[robots]\nr3 = { groups = ["carriers"] }\n', "r.toml": EACH})
    of_group = change.review(*words)
    assert "requirements-before robot.xml: 4 requirements dropped" in of_group.out, of_group.out
    change.commit({"fleet.toml": FILE, "r.toml": EACH})
    assert "; the same for 1 more robot: r2" in change.review(*words).out
    dropped = change.review(*words)
    assert "requirements-before robot.xml: 2 requirements dropped" in dropped.out, dropped.out
