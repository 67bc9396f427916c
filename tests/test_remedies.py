"""Every command of sros that a message of sros names can be run: verbs, options and arguments."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import sros_tool
from sros_tool.checks.keystores.issued import STALE
from sros_tool.cli.common import KEYSTORE_VARIABLE
from sros_tool.cli.program import program
from sros_tool.explain.log import explain_log
from sros_tool.faults import Fault, remedy_in_original_keystore
from sros_tool.keystore.layout import remedy_in_closed_robot
from tests.explain.broken import make_keystore
from tests.explain.test_log import LOGS
from tests.support.harness import sros
from tests.support.tables import for_every

PACKAGE = Path(sros_tool.__file__).parent
AS_ROOT = 'sudo "$(command -v sros)"'
"""How root starts the program of this shell, which may be in a virtual environment."""
FILLED_IN = re.compile(r"\{[\w.]*\}")
QUOTED = re.compile(r"`(?:[^`]*(?:&& |sudo |\$\())?(sros [^`]+?)(?:\)\")?`")
OPTIONAL = re.compile(r"\[.*?\]|\.\.\.")


def text_of(node: ast.AST) -> str | None:
    """Return the text of a string; what is filled in later is the word `value`."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return FILLED_IN.sub("value", node.value) if "{" in node.value else node.value
    if isinstance(node, ast.JoinedStr):
        parts = (
            text_of(each) if isinstance(each, ast.Constant) else "value" for each in node.values
        )
        return "".join(each or "" for each in parts)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = text_of(node.left), text_of(node.right)
        return None if left is None and right is None else (left or "value") + (right or "value")
    return None


def named_commands() -> Iterator[tuple[str, str]]:
    """Yield every command of sros in backquotes, with its place."""
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text()
        for node in ast.walk(ast.parse(source)) if QUOTED.search(source) else ():
            text = (text_of(node) or "").replace(AS_ROOT, "sudo sros")
            assert "`sudo sros" not in (text_of(node) or ""), f"{path}: root may lack sros"
            if not text or "sros " not in text:
                continue
            for command in QUOTED.findall(text):
                if not re.search(r"-\w*value|valuevalue", command):  # an option filled in later
                    yield command, f"{path.relative_to(PACKAGE)}:{getattr(node, 'lineno', 0)}"


def check_parses(command: str) -> None:
    """Fail unless the program takes a command's verb, options and arguments."""
    words = shlex.split(OPTIONAL.sub("", re.split(r" (?:\|\|?|&&) ", command)[0]))[1:]
    # The options of help are those that the first context of a verb has.
    with program.make_context("sros", [words[0]], resilient_parsing=True) as parent:
        verb = program.get_command(parent, words[0]) if not words[0].startswith("-") else program
        assert verb is not None, f"there is no verb {words[0]}"
        if all(word.startswith("-") for word in words[1:]):  # the name of a verb, or of an option
            options = {"--help", *(name for each in verb.params for name in each.opts)}
            assert options.issuperset(words[1:]), f"{verb.name} has no {words[1:]}"
        else:
            verb.make_context(words[0], words[1:], parent=parent)


def test_every_named_command_is_one_of_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    # A message may leave the keystore out, as its reader may: then the environment names it.
    monkeypatch.setenv(KEYSTORE_VARIABLE, "keystore")
    commands = dict(named_commands())
    assert len(commands) > 100 and "sros check runtime" in commands
    wrong = []
    for command, place in commands.items():
        try:
            check_parses(command)
        except click.UsageError as error:
            wrong.append(f"{place}: `{command}`: {error.format_message()}")
        except AssertionError as error:
            wrong.append(f"{place}: `{command}`: {error}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("command", ["sros rotate value", "sros renew --al", "sros renew a --al"])
def test_a_command_that_is_none_is_noticed(command: str) -> None:
    with pytest.raises((click.UsageError, AssertionError)):
        check_parses(command)


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from datetime import UTC, datetime

    return make_keystore(tmp_path_factory.mktemp("whole") / "ks", datetime.now(UTC))


DENIALS = (
    "rt/parameter_events topic not found in allow rule.",
    "ros_discovery_info topic not found in allow rule. -> check_create_datawriter",
    "rt/chatter topic not found in allow rule. -> check_create_datareader",
    "rq/add_two_intsRequest topic not found in allow rule. -> check_create_datawriter",
    "rr/go/_action/get_resultReply topic not found in allow rule. -> check_create_datareader",
    "rq/add_two_intsRequest topic denied by deny rule.",
    "odd-name topic not found in allow rule. -> check_create_datawriter",
)


@pytest.mark.parametrize("line", DENIALS)
def test_a_denied_topic_names_a_question_that_can_be_asked(line: str, keystore: Path) -> None:
    log = f"[rcl]: Found security directory: {keystore}/enclaves/talker_listener/talker\n{line}\n"
    (found,) = explain_log(log, lambda _: None, lambda _: pytest.fail(line), str(keystore))
    commands = re.findall("`(sros .+?)`", found.remedy)
    assert commands
    for command in commands:
        asked = sros(*shlex.split(command)[1:])
        assert asked.status in (0, 1), (command, asked)


@for_every(sorted(LOGS.glob("*.log")), lambda log: log.name)
def test_every_remedy_for_a_log_is_a_command(log: Path, keystore: Path) -> None:
    for found in explain_log(log.read_text(), lambda _: None, lambda _: pytest.fail("")):
        for command in re.findall("`(sros .+?)`", found.remedy):
            check_parses(command)


def test_a_remedy_in_a_folder_of_close_names_close(tmp_path: Path) -> None:
    """It also names the keystore there, unless that was brought to another machine."""
    export, keystore = tmp_path / "export", tmp_path / "keystore"
    for folder in (export, keystore / "private"):
        folder.mkdir(parents=True)
    for file in ("processes.json", "policy.xml", "observed.json", "keystore/private/key"):
        (tmp_path / file).touch()
    close = f"run `sros close {tmp_path}`"
    sign = STALE.remedy
    in_export = Fault.FILE_MISSING.remedy_in_export("permissions.p7s")
    renew = remedy_in_original_keystore("Renew it: `sros renew KEYSTORE ENCLAVE`.")
    for remedy, said in (
        (in_export.format(root="KEYSTORE", enclave="/a"), f"Run `sros close {tmp_path}`. If `s"),
        (renew, f"Renew it: `sros renew {keystore} ENCLAVE`. Then {close}."),
        ("export them again (`sros distribute_key K E TARGET --force`), or", f"{close}, or"),
        ("Run `sros zenoh KEYSTORE`, export again, and", f"zenoh {keystore}`, {close}, and"),
        ("from an export, export their enclaves again first", f"an export, {close} first"),
        (sign, f"Run `sros close {tmp_path}`; `sros diff_policy` shows all differences."),
        (remedy_in_original_keystore(sign), f"Run `sros close {tmp_path}`; `sros diff_policy` sh"),
    ):
        for root in (export, keystore):
            mended = remedy_in_closed_robot(root, remedy)
            assert said in mended and mended.count("sros close") == 1
        assert remedy_in_closed_robot(tmp_path, remedy) == remedy
    for gone in ("observed.json", "keystore/private/key"):  # an office has no observation
        (kept := tmp_path / gone).rename(tmp_path / "gone")
        assert remedy_in_closed_robot(export, renew) == renew
        (tmp_path / "gone").rename(kept)
