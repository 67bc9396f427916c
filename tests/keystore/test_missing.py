"""What is said of an enclave that is not there: the one that may be meant, or those that are."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.keystore.missing import likely, no_such_enclave

THERE = ("/mobile_robot/base", "/mobile_robot/teleop", "/mobile_robot/velocity_mux", "/arm/base")


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("velocity_mux", ("/mobile_robot/velocity_mux",)),
        ("/velocity_mux", ("/mobile_robot/velocity_mux",)),
        ("mobile_robot/teleop", ("/mobile_robot/teleop",)),
        ("/mobile_robot/telop", ("/mobile_robot/teleop",)),
        ("/telop", ("/mobile_robot/teleop",)),
        ("/base", ("/arm/base", "/mobile_robot/base")),
        ("/mobile_robot", ()),
        ("/camera", ()),
        ("/", ()),
        ("", ()),
    ],
)
def test_who_may_be_meant(name: str, meant: tuple[str, ...]) -> None:
    assert likely(name, THERE) == meant


def test_the_error_names_who_may_be_meant_and_does_not_say_to_make_it() -> None:
    text = str(no_such_enclave(Path("robot"), "/telop", THERE))
    assert text == (
        "enclave /telop does not exist in keystore 'robot'. Perhaps /mobile_robot/teleop is meant."
    )


def test_where_nobody_is_meant_the_error_says_who_is_there() -> None:
    text = str(no_such_enclave(Path("robot"), "/camera", [*THERE, "/x", "/y"]))
    assert "/x and 1 more. Make it with `sros create_enclave robot /camera`." in text


def test_a_name_that_could_not_be_made_is_told_so() -> None:
    assert "does not start with '/'" in str(no_such_enclave(Path("robot"), "camera", THERE))
