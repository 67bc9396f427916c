"""The verb that lists and copies the policies that ship with sros."""

from __future__ import annotations

import shutil
from pathlib import Path

import click

from sros_tool.cli.common import PATH, dry_run_option, json_option, print_json
from sros_tool.errors import UsageError


@click.command(
    "policies",
    epilog="""\b
Example:
  $ sros policies
  add_two_ints.xml     /add_two_ints/client, /add_two_ints/server
  ...
  $ sros policies --copy my_policies
  copied the policies to 'my_policies'""",
)
@click.option(
    "--copy",
    "target",
    type=PATH,
    metavar="DIR",
    help="Copy them to the new folder DIR, to start your own from.",
)
@json_option
@dry_run_option
def policies(target: Path | None, as_json: bool, dry_run: bool) -> None:
    """List the policies that ship with sros, with their enclaves, or copy them."""
    from sros_tool.policy import read_policy
    from sros_tool.resources import policies_dir

    source = policies_dir()
    if target is not None:
        if target.exists():
            raise UsageError(f"'{target}' already exists", "", "Name a folder that does not.")
        if dry_run:
            click.echo(f"would copy the policies to '{target}'")
            return
        shutil.copytree(source, target)
        click.echo(f"copied the policies to '{target}'")
        return
    found = {path: read_policy(path) for path in sorted(source.glob("*.xml"))}
    if as_json:
        print_json(
            [
                {"file": str(path), "enclaves": [each.path for each in policy.enclaves]}
                for path, policy in found.items()
            ]
        )
        return
    width = max(len(path.name) for path in found)
    for path, policy in found.items():
        click.echo(f"{path.name:{width}}  {', '.join(each.path for each in policy.enclaves)}")
    click.echo(f"they are in '{source}'", err=True)
