"""The help of every verb fits a terminal of 80 columns."""

from __future__ import annotations

import re
from importlib import import_module

import pytest
from click.testing import CliRunner

from sros_tool.cli.program import FAMILIES, program
from tests.support.harness import sros
from tests.support.tables import for_every

VERBS = {name: verb for family in FAMILIES.values() for name, verb in family.items()}


def help_of(*words: str, width: int = 80) -> str:
    runner = CliRunner(env={"COLUMNS": str(width)})
    done = runner.invoke(program, [*words, "--help"], prog_name="sros")
    assert done.exit_code == 0
    return done.output


@pytest.mark.parametrize("width", [80, 200])
@for_every(["", *VERBS])
def test_no_line_of_a_help_is_longer_than_80_columns(verb: str, width: int) -> None:
    lines = help_of(*filter(None, [verb]), width=width).splitlines()
    assert [line for line in lines if len(line) > 80] == [], f"in `sros {verb} --help`"


@for_every(["", "fleet", "agent"])
def test_a_group_without_arguments_prints_its_help(verb: str) -> None:
    """With whole sentences, also where they need two lines, and on standard error."""
    words = list(filter(None, [verb]))
    ended = sros(*words)
    assert (ended.status, ended.out) == (2, "")
    assert ended.err == sros(*words, "--help").ok().out
    assert len(ended.err.splitlines()) > 10
    assert not re.search(r"(?m)^  \w+  .*\.\.\.$", ended.err), "a sentence was cut"


@for_every(VERBS)
def test_no_word_of_an_option_is_broken(verb: str) -> None:
    """A line that ends with a hyphen would cut an option such as --revoke-old in two."""
    lines = help_of(verb).splitlines()
    assert [line for line in lines if line.endswith("-") and line.split()[-1] != "-"] == []


def test_every_verb_of_a_module_is_in_one_family() -> None:
    homes: dict[str, set[str]] = {}
    for family, verbs in FAMILIES.items():
        for verb in verbs.values():
            homes.setdefault(verb.module, set()).add(family)
    assert {name: families for name, families in homes.items() if len(families) > 1} == {}


@for_every(VERBS)
def test_the_summary_of_a_verb_is_one_sentence_that_fits_its_line(verb: str) -> None:
    assert VERBS[verb].help[-1] in ".?"
    module = import_module(f"sros_tool.cli.{VERBS[verb].module}")
    assert getattr(module, VERBS[verb].attribute or verb).help
