"""Write docs/man/sros.1, the manual page of the program with all its verbs, from their help.

`python -m tools.man_page` writes it; the wheel has it as share/man/man1/sros.1, where `man` finds
it for a program that is on the path.
"""

from __future__ import annotations

from collections.abc import Iterator

import click

from tools.steps import CHECKOUT
from tools.verbs import families

PAGE = CHECKOUT / "docs" / "man" / "sros.1"

_BEGINNING = """\
.\\" Made by python -m tools.man_page; do not edit.
.TH SROS 1 "" sros "Security for ROS 2 robots"
.SH NAME
sros \\- security toolkit for ROS 2 robots
.SH SYNOPSIS
.B sros
.I VERB
[OPTIONS] [ARGUMENTS]
"""
_END = """\
.SH EXIT STATUS
0 for yes or done, 1 for no, denied, different or findings, 2 if sros could not answer or do it.
"""


def page() -> str:
    """Return the text of docs/man/sros.1."""
    lines = [_BEGINNING]
    for family, verbs in families():
        lines.append(f".SH {family.upper()}\n")
        for name, command in verbs.items():
            lines += _verb(f"sros {name}", command)
    return "".join([*lines, _END])


def _verb(name: str, command: click.Command) -> Iterator[str]:
    # Click keeps the help option that a command first has, also for those who call it later.
    context = click.Context(command, info_name=name, help_option_names=["-h", "--help"])
    yield f".SS {_roff(' '.join([name, *command.collect_usage_pieces(context)]))}\n"
    for part in (command.help or "").replace("\b", "").split("\n\n"):
        yield f"{_roff(part)}\n.PP\n"
    for option in command.params:
        if isinstance(option, click.Option) and (record := option.get_help_record(context)):
            yield f".TP\n.B {_roff(record[0])}\n{_roff(record[1])}\n"
    if command.epilog:
        example = "\n".join(map(_line, command.epilog.replace("\b", "").strip().splitlines()))
        yield f".PP\n.nf\n{example}\n.fi\n"
    if isinstance(command, click.Group):
        for part, each in command.commands.items():
            yield from _verb(f"{name} {part}", each)


def _roff(text: str) -> str:
    return _line(" ".join(text.split()))


def _line(line: str) -> str:
    """Return a line in which nothing is a command or an escape of roff."""
    return "\\&" + line.replace("\\", "\\e").replace("-", "\\-")


if __name__ == "__main__":
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page(), "utf-8")
