"""Whose enclave is whose, from the paths with placeholders."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sros_tool.fleet import robots
from sros_tool.fleet.robots import Fleet, Robot, _possible_robots, enclaves_of, robot_of

ROBOTS = (
    Robot("r1", "/r1", groups=("carriers",)),
    Robot("r10", "/hall/r10"),
    Robot("r1_base", "/hall/r10/deep"),
    Robot("top", "/"),
)
PATHS = (
    "/{robot}/base",
    "/{robot}/base/{robot}",
    "/x_{robot}",
    "/{robot:carriers}/arm",
    "/at{namespace}/cam",
    "{namespace}/lidar",
    "/named{namespace}/{robot}_imu",
)
FLEET = Fleet.of(ROBOTS, enclaves=PATHS)


def test_the_enclaves_of_each_robot() -> None:
    assert enclaves_of(FLEET, ROBOTS[0]) == (
        "/at/r1/cam", "/named/r1/r1_imu", "/r1/arm", "/r1/base", "/r1/base/r1", "/r1/lidar",
        "/x_r1",
    )  # fmt: skip
    assert enclaves_of(FLEET, ROBOTS[3]) == (
        "/at/cam", "/lidar", "/named/top_imu", "/top/base", "/top/base/top", "/x_top",
    )  # fmt: skip


def test_each_of_them_leads_back_to_its_robot() -> None:
    for robot in ROBOTS:
        for path in enclaves_of(FLEET, robot):
            assert robot_of(FLEET, path) == robot, path


@pytest.mark.parametrize(
    "path",
    [
        "/r10/arm", "/r2/base", "/r1/base/r10", "/r1", "/", "", "/other/base", "/r1/bas", "/x_",
        "/at/hall/cam", "/r1/base/", "/r1\n/base", "/named/r1/r10_imu",
    ],
)  # fmt: skip
def test_other_enclaves_are_of_no_robot(path: str) -> None:
    assert robot_of(FLEET, path) is None


def test_the_robot_of_one_enclave_among_many_patterns_is_found_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    many = Fleet.of(
        [Robot(f"r{i}", f"/r{i}") for i in range(1000)],
        enclaves=[f"/{{robot}}/node{i}" for i in range(1000)],
    )
    tried = []

    def counted(fleet: Fleet, pattern: robots._Pattern, enclave: str) -> Iterator[Robot]:
        tried.append(pattern)
        return _possible_robots(fleet, pattern, enclave)

    monkeypatch.setattr(robots, "_possible_robots", counted)
    for i in range(1000):
        found = robot_of(many, f"/r{i}/node{999 - i}")
        assert found and found.name == f"r{i}"
    assert len(tried) == 1000
