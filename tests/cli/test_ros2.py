"""`ros2 security`: a parser as ros2cli makes it leads to sros, with every word as it was typed."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from sros_tool.cli.ros2 import SecurityCommand
from tests.support.harness import Ended, sros


def ros2(*words: object) -> Ended:
    """Run `ros2 security` as ros2cli does: parse what is known, then have the verb's words added.

    Source: ros2cli 0.32, ``add_subparsers_on_demand`` and ``main``.
    """
    given = ["security", *map(str, words)]
    root = argparse.ArgumentParser(prog="ros2")
    root.add_argument("--use-python-default-buffering", action="store_true")
    commands = root.add_subparsers(required=False)
    commands.dest = " command"
    parser = commands.add_parser("security")
    extension = SecurityCommand()
    parser.set_defaults(_command=extension)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        extension.add_arguments(parser, "ros2 security", argv=None)
        try:
            args = root.parse_args(given)
            status = args._command.main(parser=root, args=args)
        except SystemExit as end:
            status = end.code
    return Ended(status, out.getvalue(), err.getvalue())


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (("--version",), 0),
        (("-h",), 0),
        ((), 2),
        (("create_keystore", "--help"), 0),
        (("policies", "--list"), 2),
        (("-v", "policies"), 0),
        (("policies", "--json"), 0),
        (("check", "keystore", "/nowhere", "--", "-x"), 2),
        (("list_enclaves", "/nowhere"), 2),
        (("creat_keystore",), 2),
        (("run", "ks", "/a", "--", "true", "--help"), 2),
    ],
)
def test_output_and_status_are_those_of_sros(words: tuple[str, ...], status: int) -> None:
    found, expected = ros2(*words), sros(*words)
    assert found.status == expected.status == status, found
    for text, wanted in ((found.out, expected.out), (found.err, expected.err)):
        assert text.replace("ros2 security", "sros") == wanted


def test_a_keystore_of_a_workspace(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    assert ros2("create_keystore", root).ok().out.startswith(f"created keystore '{root}'")
    ros2("create_enclave", root, "/talker").ok()
    assert ros2("list_enclaves", root).ok().out == "/talker\n"
    refused = ros2("create_enclave", root, "talker")
    assert refused.status == 2 and refused.err.startswith("Unable to create enclave: ")


def completions(*words: str) -> list[str]:
    """The completions of the last word, with the completers of argcomplete replaced."""
    parser = argparse.ArgumentParser()
    SecurityCommand().add_arguments(parser, "ros2 security")
    (action,) = (each for each in parser._actions if each.dest == "words")
    given = SimpleNamespace(words=list(words[:-1]))
    found: list[str] = action.completer(words[-1], given)  # type: ignore[attr-defined]
    return found


def test_completion_is_that_of_sros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("argcomplete")
    sros("create_keystore", tmp_path / "ks").ok()
    sros("create_enclave", tmp_path / "ks", "/talker").ok()
    monkeypatch.chdir(tmp_path)
    assert completions("create_") == [
        "create_keystore", "create_enclave", "create_permission", "create_request",
    ]  # fmt: skip
    assert "--template" in completions("create_keystore", "--t")
    assert "production" in completions("create_keystore", "ks2", "--template", "pro")
    assert completions("run", "ks", "/t") == ["/talker"]
    assert os.path.join("ks", "") in completions("run", "k")
