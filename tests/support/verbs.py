"""The verbs of the program, those of a group such as ``fleet status`` one by one."""

from __future__ import annotations

from collections.abc import Mapping

import click

from sros_tool.cli.program import FAMILIES, VerbEntry, program

ENTRIES: Mapping[str, VerbEntry] = {
    name: entry for family in FAMILIES.values() for name, entry in family.items()
}
"""What ``sros --help`` lists."""


def _commands() -> dict[str, click.Command]:
    found: dict[str, click.Command] = {}
    for name in ENTRIES:
        command = program.get_command(click.Context(program), name)
        assert command
        if isinstance(command, click.Group):
            found |= {f"{name} {part}": each for part, each in command.commands.items()}
        else:
            found[name] = command
    return found


COMMANDS: Mapping[str, click.Command] = _commands()
"""The commands of all verbs by their words."""


def module_of(verb: str) -> str:
    """Return the name of the module of a verb."""
    return f"sros_tool.cli.{ENTRIES[verb.split()[0]].module}"
