"""The verbs of the program by family, with their commands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import click

from sros_tool.cli.program import FAMILIES, program


def families() -> Iterator[tuple[str, Mapping[str, click.Command]]]:
    """Yield each family of verbs, in the order of ``sros --help``."""
    for family, verbs in FAMILIES.items():
        commands = {name: program.get_command(click.Context(program), name) for name in verbs}
        yield family, {name: command for name, command in commands.items() if command}
