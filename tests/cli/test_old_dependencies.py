"""A package that sros needs and that is missing or too old is named, in place of a defect."""

from __future__ import annotations

import importlib.metadata
import re
from importlib.metadata import PackageNotFoundError
from pathlib import Path

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


NEWER = re.compile(
    r"\.(not_valid_(before|after)|(last|next)_update|revocation_date)_utc|public_key_algorithm_oid|"
    r"PublicKeyAlgorithmOID|NoArgsIsHelpError|\(click\.ParamType\["
)
"""What cryptography 41 and click 8.1 do not have."""


def test_nothing_is_used_that_the_oldest_packages_do_not_have() -> None:
    assert NEWER.search("certificate.not_valid_after_utc") and NEWER.search(
        "(click.ParamType[int])"
    )
    users = {
        str(path)
        for folder in ("sros_tool", "tests")
        for path in Path(folder).rglob("*.py")
        if NEWER.search(path.read_text()) and path.name != Path(__file__).name
    }
    assert users == {"sros_tool/pki/tolerant.py"}  # it gives these names to its own certificates
