"""Fleet files: what they state, and what is refused with the key and what to write."""

from __future__ import annotations

import pytest

from sros_tool.errors import DocumentError
from sros_tool.fleet.fleet_file import parse_fleet, render_fleet
from sros_tool.fleet.robots import Fleet, Robot
from tests.support.long_form import ONLY_LONG

TEXT = """
enclaves = ["/{robot}/base", "/fleet{namespace:carriers}/arm"]
[groups.carriers]
domain = 5
namespace = "/warehouse/{robot}"
address = "{robot}.example.com"
[groups.empty]
[robots.r7]
groups = ["carriers", "new"]
[robots.r1]
groups = ["carriers"]
namespace = "/"
domain = 7
address = "fe80::1"
user = "ros"
[robots]
lone = {}
"""


def fleet(text: str = TEXT) -> Fleet:
    return parse_fleet(text.encode(), "the file")


def test_values_of_a_group_are_defaults_of_its_robots() -> None:
    found = fleet()
    assert dict(found.robots) == {
        "lone": Robot("lone", "/lone", None, "lone"),
        "r1": Robot("r1", "/", 7, "fe80::1", "ros", ("carriers",)),
        "r7": Robot("r7", "/warehouse/r7", 5, "r7.example.com", "", ("carriers", "new")),
    }
    assert list(found.robots) == sorted(found.robots)
    assert dict(found.groups) == {"carriers": ("r1", "r7"), "empty": (), "new": ("r7",)}
    assert found.enclaves == ("/{robot}/base", "/fleet{namespace:carriers}/arm")
    assert found.members("new") == (found.robot("r7"),)
    assert [each.name for each in found.members("")] == ["lone", "r1", "r7"]


def test_a_robot_can_differ_from_its_group_in_whether_it_may_renew() -> None:
    found = fleet(
        '[groups.g]\nrenewal = "allowed"\nrenewal_grace = "30d"\n[robots]\n'
        'a = { groups = ["g"] }\nb = { groups = ["g"], renewal = "refused" }\nc = {}'
    )
    values = [(robot.renewal, robot.renewal_grace) for robot in found.robots.values()]
    assert values == [("allowed", "30d"), ("refused", "30d"), ("", "")]
    assert parse_fleet(render_fleet(found).encode(), "it") == found


@pytest.mark.parametrize("name", ["r 7", "<r7/>", "a/b", "{robot}", "r7'", "*", "7r", ""])
@pytest.mark.parametrize("of", ["robots", "groups"])
def test_a_name_is_one_part_of_a_ros_name(name: str, of: str) -> None:
    with pytest.raises(DocumentError, match=f"the file: {of} has .* which is not valid"):
        fleet(f'[robots.r]\n[{of}."{name}"]\n')


@pytest.mark.parametrize("name", ["all", "ungrouped", "_meta", "localhost"])
@pytest.mark.parametrize("of", ["robots", "groups"])
def test_a_name_means_nothing_else_in_an_inventory(name: str, of: str) -> None:
    """In every play, a robot `localhost` would be the machine at home."""
    with pytest.raises(DocumentError, match=rf"{of} has '{name}'.*means something else"):
        fleet(f"[robots.r]\n[{of}.{name}]\n")
    with pytest.raises(DocumentError, match=rf"r\.groups has '{name}'.*means something else"):
        fleet(f"[robots.r]\ngroups = ['{name}']\n")


@pytest.mark.parametrize("name", ["r7", "_", "a__b", "a" * 64])
def test_names(name: str) -> None:
    """ROS takes two underscores, too."""
    read = fleet(f'[robots.{name}]\nnamespace = "/hall/{name}"')
    assert read.robots[name].namespace == f"/hall/{name}"


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ('namespace = "r7"', "start with '/'"),
        ('namespace = "/a//b"', "contains '//'"),
        ('namespace = "/a/"', "ends with '/'"),
        ('namespace = "/*"', "other than letters"),
        ('namespace = "/{robot}"', "other than letters"),
        ('namespace = "/a\\n"', "other than letters"),
        ('namespace = "/\u0663"', "starts with a digit"),
        ('namespace = ""', "empty"),
        (f'namespace = "/{"a" * 245}"', "more than 245"),
        ("namespace = 7", "not a text"),
        ("domain = -1", "0 to 230"),
        ("domain = 231", "0 to 230"),
        ("domain = true", "0 to 230"),
        ('domain = "7"', "0 to 230"),
        ('address = "-oProxyCommand=x"', "host name"),
        ('address = "a b"', "host name"),
        ('address = "$(id)"', "host name"),
        ('address = "a..b"', "host name"),
        ('address = "fe80::1%eth0;id"', "zone"),
        ('address = ""', "host name"),
        ('user = "-l"', "account"),
        ('user = "a@b"', "account"),
        ('router = "r.local"', "HOST:PORT"),
        ('router = "r.local:0"', "HOST:PORT"),
        ('router = "r.local:7447;x"', "HOST:PORT"),
        ("router = 7447", "not a text"),
        ('router = "r.local:7447"\ncrossing = ["fleet"]', "start with '/'"),
        ('router = "r.local:7447"\ncrossing = ["/a b"]', "crossing has '/a b'"),
        ('router = "r.local:7447"\ncrossing = "/fleet"', "list of names"),
        ('crossing = ["/fleet"]', "only through a router, and the robot has none"),
        ('renewal = "yes"', "neither allowed nor refused"),
        ("renewal = true", "not a text"),
        ('renewal_grace = "30"', "and one of s, m, h, d, w, y"),
        ('groups = "carriers"', "list of names"),
        ("groups = [1]", "list of names"),
        ('groups = ["a/b"]', "not valid"),
        (f"groups = {[f'g{i}' for i in range(33)]}", "more than 32"),
        ("domian = 7", "robots.r.domian is not a known key"),
        ('"\\u001b[2J" = 7', "not a known key"),
    ],
)
def test_a_value_that_is_not_valid(line: str, problem: str) -> None:
    with pytest.raises(DocumentError) as caught:
        fleet(f"[robots.r]\n{line}\n")
    assert "the file: robots.r" in str(caught.value)
    assert problem in str(caught.value)
    assert "\x1b" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no robot"),
        ("[robots]", "no robot"),
        ("robots = 7", "not a table"),
        ("[[robots]]", "not a table"),
        ("[robots]\nr = 7", "robots.r is not a table"),
        ("[robot.r]", "robot is not a known key"),
        ("[robots.r", "not valid TOML"),
        ("\xff", "not valid TOML"),
        ("[groups.g]\ndomain = 500\n[robots.r]", "groups.g.domain"),
        ('[groups.g]\nuser = "-x"\n[robots.r]', "groups.g.user"),
        ("[groups.g]\ngroups = []\n[robots.r]", "groups.g.groups is not a known key"),
        (f'[groups.g]\nnamespace = "{"/{robot}" * 40}"\n[robots.{"r" * 64}]\ngroups = ["g"]',
         "more than 245"),
        ("[groups.g]\ndomain = 1\n[groups.h]\ndomain = 2\n[robots.r]\ngroups = ['h', 'g']",
         "gets its domain from two groups"),
        ("[robots.r]\n[groups.r]", "'r' is a robot and a group"),
        ("[robots.r]\n[robots.a]\ngroups = ['r']", "'r' is a robot and a group"),
        ("enclaves = [\n" + '"/{robot}",\n' * 1001 + "]\n[robots.r]", "more than 1000 names"),
        (f"enclaves = {[f'/{{robot}}/e{i}' for i in range(101)]}\n[robots]\n"
         + "".join(f"r{i} = {{}}\n" for i in range(10_000)), "1010000 enclaves, more than 1000000"),
        ('enclaves = ["/base"]\n[robots.r]', "no placeholder"),
        ('routers = "/router"\n[robots.r]', "no placeholder"),
        ("routers = 7\n[robots.r]", "not a text"),
        ('routers = "/{robot:a}/router"\n[robots.r]\nrouter = "r:7447"',
         "not name an enclave of the robot r"),
        ('enclaves = ["/{robots}"]\n[robots.r]', "write {robot}"),
        ('enclaves = ["/{robot:a}/{robot:b}"]\n[robots.r]', "different groups"),
        ('enclaves = ["{robot}"]\n[robots.r]', "does not start with '/'"),
        ('enclaves = ["/{robot}*"]\n[robots.r]', "wildcard"),
        pytest.param(
            "[robots]\n" + "".join(f"r{i} = {{}}\n" for i in range(100_001)), "more than 100000",
            marks=ONLY_LONG,
        ),
    ],
)  # fmt: skip
def test_a_file_that_is_not_valid(text: str, problem: str) -> None:
    with pytest.raises(DocumentError) as caught:
        fleet(text)
    assert problem in str(caught.value)


def test_a_value_of_two_groups_is_settled_by_the_robot_or_if_they_agree() -> None:
    text = "[groups.g]\ndomain = 1\n[groups.h]\ndomain = {}\n[robots.r]\ngroups = ['h', 'g']\n{}"
    assert fleet(text.format(1, "")).robot("r").domain == 1
    assert fleet(text.format(2, "domain = 3")).robot("r").domain == 3


def test_an_unknown_robot_or_group_names_near_ones() -> None:
    with pytest.raises(DocumentError, match=r"no robot 'r8'.* r1, r7"):
        fleet().robot("r8")
    with pytest.raises(DocumentError, match=r"no group 'carrier'.* carriers"):
        fleet().members("carrier")
