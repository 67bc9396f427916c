"""The verb that prints the completion script of a shell."""

from __future__ import annotations

import click

from sros_tool.errors import UnavailableError


@click.command(
    "completion",
    epilog="""\b
Example:
  $ sros completion bash > ~/.local/share/bash-completion/completions/sros""",
)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the script with which SHELL completes verbs, options, enclaves and templates."""
    from click.shell_completion import get_completion_class

    from sros_tool.cli.program import program

    kind = get_completion_class(shell)
    if kind is None:
        raise UnavailableError(f"there is no completion for {shell}")
    click.echo(kind(program, {}, "sros", "_SROS_COMPLETE").source())
