"""Which options of ``sros explain`` go together."""

from __future__ import annotations

import click

from sros_tool.errors import UsageError

_IGNORED = {
    "": ("infrastructure",),
    "--who": ("infrastructure", "policy", "all_vendors"),
    "--reach": ("kind", "vendor", "all_vendors", "moment", "domain", "time_zone"),
    "--log": ("infrastructure", "kind", "policy", "vendor", "all_vendors"),
}
"""The options that have no meaning in each way of asking, by the names of their parameters."""


def refuse_ignored(mode: str) -> None:
    """Raise `UsageError` for an option that would change nothing."""
    context = click.get_current_context()
    for parameter in context.command.params:
        name = parameter.name or ""
        if name in _IGNORED[mode] and context.params[name]:
            option = parameter.opts[0]
            said = f"{mode} takes no {option}" if mode else f"{option} goes with --reach only"
            raise UsageError(said, "", "Leave it out.")
