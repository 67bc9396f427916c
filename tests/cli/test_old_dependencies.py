"""A package that sros needs and that is missing or too old is named, in place of a defect."""

from __future__ import annotations

import importlib.metadata
from importlib.metadata import PackageNotFoundError

import pytest

from sros_tool.policy import document
from tests.support.harness import sros

NEEDED = [
    "click>=8.1",
    "cryptography>=41.0.7",
    "lxml>=5.0",
    "eclipse-zenoh>=1.10; extra == 'zenoh'",
]
NEW = {"click": "8.1.6", "cryptography": "50.0.2", "lxml": "5.2.1"}
DEFECT = "this is a defect of sros"


@pytest.mark.parametrize(
    ("installed", "error", "said"),
    [
        (
            {**NEW, "cryptography": "38.0.4"},
            AttributeError,
            "cryptography 41.0.7 or newer, and version",
        ),
        ({**NEW, "cryptography": ""}, ImportError, "cryptography 41.0.7 or newer, and none is"),
        ({**NEW, "click": "8.0.9"}, AttributeError, "click 8.1 or newer, and version 8.0.9"),
        ({**NEW, "lxml": "4.10"}, ImportError, "lxml 5.0 or newer"),
        (NEW, AttributeError, DEFECT),
        ({**NEW, "lxml": "4.10"}, KeyError, DEFECT),
    ],
)
def test_it_is_named(
    installed: dict[str, str],
    error: type[Exception],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def version(name: str) -> str:
        if not installed[name]:
            raise PackageNotFoundError(name)
        return installed[name]

    def fail(*_: object) -> None:
        raise error("x")

    monkeypatch.setattr(importlib.metadata, "requires", lambda _: NEEDED)
    monkeypatch.setattr(importlib.metadata, "version", version)
    monkeypatch.setattr(document, "read_policy", fail)
    words = ("ks", "--policy", "p.xml", "--", "true", "--ros-args", "-r", "__node:=n")
    ended = sros("run", *words)
    assert ended.status == 2 and said in ended.err, ended
    assert said == DEFECT or DEFECT not in ended.err
