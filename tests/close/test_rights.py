"""Who may do what by the policy of a closed robot, as `sros close` shows it."""

from __future__ import annotations

from pathlib import Path

from sros_tool.close.rights import access_lines
from sros_tool.names import PARAMETER_SERVICES
from sros_tool.policy.document import read_policy
from tests.support.harness import policy_text, publish, subscribe


def test_wildcards_and_denials_count_in_what_is_shown(tmp_path: Path) -> None:
    text = policy_text({
        "/a": publish("/odom"),
        "/b": subscribe("/odom"),
        "/look": subscribe("/*"),
        "/mute": publish("/tf") + publish("/tf").replace("ALLOW", "DENY"),
        "/pan": subscribe("/camera/*"),
        "/not": subscribe("/*") + subscribe("/odom").replace("ALLOW", "DENY"),
    })  # fmt: skip
    (tmp_path / "p.xml").write_text(text)
    lines = access_lines(read_policy(tmp_path / "p.xml"), tmp_path)
    assert lines == [
        "topic /tf: nobody -> /look, /not",
        "topic /odom: /a -> /b, /look",
        "topic /*: in part /a -> /look, /not",
        "topic /camera/*: nobody -> /look, /not, /pan",
    ]


def test_all_who_may_move_the_robot_are_shown_first(tmp_path: Path) -> None:
    """The first lines are what most users read, and a name that is left out there may drive."""
    drivers = {f"/d{number}": publish("/cmd_vel", "/image") for number in range(6)}
    names = tuple(f"/a{number}" for number in range(30))
    others = {"/base": subscribe("/cmd_vel", "/image"), "/x": publish(*names), "/y": publish("/z*")}
    (tmp_path / "p.xml").write_text(policy_text(drivers | others))
    lines = access_lines(read_policy(tmp_path / "p.xml"), tmp_path)
    assert lines[:2] == [
        "topic /cmd_vel: /d0, /d1, /d2, /d3, /d4, /d5 -> /base",
        "topic /image: /d0, /d1, /d2 and 3 more -> /base",
    ]
    assert lines[-1] == "and 13 more lines"


def test_a_right_to_pose_as_every_node_is_shown(tmp_path: Path) -> None:
    for node, shown in (("n", []), ("*", ["service /*/set_parameters: nobody -> /a"])):
        served = '<services reply="ALLOW"><service>~/set_parameters</service></services>'
        text = policy_text({"/a": publish("/rosout") + served})
        (tmp_path / "p.xml").write_text(text.replace('node="n"', f'node="{node}"'))
        assert access_lines(read_policy(tmp_path / "p.xml"), tmp_path) == shown


def test_what_tells_most_is_shown_before_parameter_services(tmp_path: Path) -> None:
    """A misspelled name has nobody at its other end; a parameter client calls six services."""

    def services(right: str, *names: str) -> str:
        listed = "".join(f"<service>/camera/{name}</service>" for name in names)
        return f'<services {right}="ALLOW">{listed}</services>'

    goal = '<actions {}="ALLOW"><action>/deliver</action></actions>'
    called = services("request", *PARAMETER_SERVICES)
    enclaves = {
        "/camera": services("reply", "calibrate", *PARAMETER_SERVICES) + goal.format("execute"),
        "/lamp": subscribe("/misson_state") + services("request", "get_parameters"),
        "/planner": publish("/mission_state") + called + goal.format("call"),
        "/view": subscribe("/mission_state") + services("request", "calibrate"),
    }
    (tmp_path / "p.xml").write_text(policy_text(enclaves))
    assert access_lines(read_policy(tmp_path / "p.xml"), tmp_path) == [
        "topic /misson_state: nobody -> /lamp",
        "action /deliver: /planner -> /camera",
        "topic /mission_state: /planner -> /view",
        "service /camera/calibrate: /view -> /camera",
        "5 parameter services of /camera: /planner -> /camera",
        "service /camera/get_parameters: /lamp, /planner -> /camera",
    ]
