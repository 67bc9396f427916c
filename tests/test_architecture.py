"""The floors of docs/architecture.md hold: who imports whom, and where rclpy may be."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[1]
PACKAGE = PROJECT / "sros_tool"

FLOORS = {
    1: {"errors", "faults", "names", "validity", "values"}
    | {"xml", "files", "parallel", "resources"},
    2: {"pki", "policy", "dds"},
    3: {"translate"},
    4: {"keystore", "graph", "runtime"},
    5: {"checks", "explain", "demo", "report"},
    6: {"api", "cli"},
    7: {"__init__", "__main__"},
}
FLOOR_OF = {room: floor for floor, rooms in FLOORS.items() for room in rooms}

# Where a process of its own runs the nodes of rclpy. Nothing else may need ROS.
ROS_ROOMS = {"graph", "demo"}
ROS_MODULES = {"runtime/probe_child.py"}


def imported(source: str, module: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """Line and absolute name of each import in the text of `module`; also inside functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = module[: len(module) - node.level] if node.level else ()
            origin = ".".join((*above, *([node.module] if node.module else [])))
            yield from ((node.lineno, f"{origin}.{name.name}") for name in node.names)


def misplaced(source: str, path: str) -> list[str]:
    """Imports that the module `path`, relative to the package, may not have."""
    parts = ("sros_tool", *Path(path).with_suffix("").parts)
    room = parts[1]
    found = []
    for line, name in imported(source, parts):
        first, *rest = name.split(".")
        if first == "rclpy" and room not in ROS_ROOMS and path not in ROS_MODULES:
            found.append(f"{path}:{line} imports rclpy")
        if first != "sros_tool" or not rest or rest[0] == room or rest[0] == "__version__":
            continue
        # Rooms on one floor do not know each other, but for the small modules at the bottom.
        if FLOOR_OF[rest[0]] >= FLOOR_OF[room] and FLOOR_OF[room] != 1:
            found.append(f"{path}:{line} imports {name}, which is not below it")
        elif FLOOR_OF[rest[0]] > FLOOR_OF[room]:
            found.append(f"{path}:{line} imports {name}, which is above it")
    return found


MODULES = sorted(str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py"))


def test_every_room_has_a_floor() -> None:
    assert {Path(module).with_suffix("").parts[0] for module in MODULES} == set(FLOOR_OF)


def test_nothing_imports_from_above_or_beside() -> None:
    assert [
        line for module in MODULES for line in misplaced((PACKAGE / module).read_text(), module)
    ] == []


@pytest.mark.parametrize(
    ("source", "path", "found"),
    [
        ("from sros_tool.errors import SrosError", "policy/model.py", []),
        ("from sros_tool.policy.document import read", "policy/model.py", []),
        ("from .reader import read", "policy/model.py", []),
        ("from sros_tool import translate", "keystore/enclave.py", []),
        ("import rclpy.node", "demo/ros_node.py", []),
        (
            "from sros_tool.keystore.layout import Keystore",
            "policy/model.py",
            ["sros_tool.keystore.layout.Keystore"],
        ),
        (
            "def late():\n    import sros_tool.cli.program",
            "demo/runner.py",
            ["sros_tool.cli.program"],
        ),
        ("from ..cli import program", "demo/runner.py", ["sros_tool.cli.program"]),
        ("from sros_tool import dds", "policy/model.py", ["sros_tool.dds"]),
        ("from sros_tool.pki import keys", "errors.py", ["sros_tool.pki.keys"]),
        ("import rclpy", "runtime/stacks.py", ["rclpy"]),
        ("from rclpy.node import Node", "cli/observing.py", ["rclpy"]),
    ],
)
def test_the_search_sees_what_is_misplaced_and_only_that(
    source: str, path: str, found: list[str]
) -> None:
    lines = misplaced(source, path)
    assert len(lines) == len(found)
    assert all(name in line for line, name in zip(lines, found, strict=True))


CLOCKS = {"datetime.now", "datetime.utcnow", "datetime.today", "date.today", "time.time"}
CLOCK_ROOM = {"cli/common.py", "api.py"}
"""`now`, `_moment`, and the offset of a machine whose zone has no name."""


def clocks(source: str) -> list[int]:
    """The lines that ask what time it is."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute)
        and f"{ast.unparse(node.value).rpartition('.')[2]}.{node.attr}" in CLOCKS
    ]


def test_only_the_command_line_and_the_api_ask_the_clock() -> None:
    found = {module for module in MODULES if clocks((PACKAGE / module).read_text())}
    assert found == CLOCK_ROOM
    assert clocks("import datetime\nnow = datetime.datetime.now") == [2]
    assert clocks("time.monotonic(); now()") == []


def test_the_modules_that_may_need_ros_are_the_ones_that_do() -> None:
    users = {
        module
        for module in MODULES
        for _, name in imported((PACKAGE / module).read_text(), ("sros_tool", *Path(module).parts))
        if name.split(".")[0] == "rclpy"
    }
    assert not ROS_MODULES - users
    assert {Path(module).parts[0] for module in users - ROS_MODULES} == ROS_ROOMS


def test_the_documentation_has_the_same_floors() -> None:
    text = (PROJECT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"^\| ([1-6]) \| (.+?) \|", text, re.MULTILINE)
    told = {
        room.removesuffix("/").removesuffix(".py"): int(floor)
        for floor, rooms in rows
        for room in re.findall(r"`([^`]+)`", rooms)
    }
    assert told == {room: floor for room, floor in FLOOR_OF.items() if not room.startswith("__")}
