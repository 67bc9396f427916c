"""The verbs that add enclaves and permissions to a keystore, and list what it has."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    SeveralValues,
    complete_keystore_and_enclave,
    complete_template,
    dry_run_option,
    json_option,
    keystore_from_environment,
    now,
    print_json,
    print_notes,
    print_plan,
    progress_bar,
    ros_domain,
    split_root,
)
from sros_tool.cli.secrets import keyring
from sros_tool.errors import UsageError

if TYPE_CHECKING:
    from sros_tool.keystore import Result


@click.command(
    "create_enclave",
    epilog="""\b
Example:
  $ sros create_enclave keystore /talker /listener
  created enclave /talker
  created enclave /listener""",
)
@click.argument(
    "words",
    metavar="[ROOT] NAME...",
    nargs=-1,
    required=True,
    shell_complete=complete_keystore_and_enclave,
)
@dry_run_option
def create_enclave(words: tuple[str, ...], dry_run: bool) -> None:
    """Create the enclaves NAME... in the keystore ROOT.

    An enclave that exists keeps its key and its permissions; a file that it lacks is added.
    """
    from sros_tool.keystore import create_enclaves

    root, names = split_root(words)
    if not names:
        raise UsageError("no enclave is named", "", "Name one or more, such as /talker.")
    with progress_bar(len(names)) as step:
        result = create_enclaves(
            root,
            names,
            now=now(),
            domain=ros_domain(),
            keyring=keyring(),
            dry_run=dry_run,
            progress=step,
        )
    _show(result, dry_run)


@click.command(
    "create_permission",
    epilog="""\b
Example:
  $ sros create_permission keystore /talker_listener/talker policy.xml
  replaced the permissions of enclave /talker_listener/talker""",
)
@click.argument(
    "words",
    metavar="[ROOT] NAME POLICY_FILE",
    nargs=-1,
    required=True,
    shell_complete=complete_keystore_and_enclave,
)
@dry_run_option
def create_permission(words: tuple[str, ...], dry_run: bool) -> None:
    """Give the enclave NAME the permissions that the policy in POLICY_FILE states for it."""
    from sros_tool.keystore import create_permission as create
    from sros_tool.policy import read_policy

    root, rest = split_root(words)
    if len(rest) != 2:
        raise UsageError("create_permission takes a keystore, an enclave and a policy file")
    name, file = rest
    result = create(
        root,
        name,
        read_policy(PATH.convert(file, None, None)),
        now=now(),
        domain=ros_domain(),
        keyring=keyring(),
        dry_run=dry_run,
    )
    _show(result, dry_run)


class _SeveralEnclavesAndPolicies(SeveralValues):
    several = ("-e", "--enclaves", "-p", "--policy-files")


@click.command(
    "generate_artifacts",
    cls=_SeveralEnclavesAndPolicies,
    epilog="""\b
Example:
  $ sros generate_artifacts -k keystore -e /spare -p talker_listener.xml mobile_robot.xml
  created enclave /spare
  created enclave /talker_listener/talker
  ...""",
)
@click.option("-k", "--keystore-root-path", type=PATH, help="The keystore; made if missing.")
@click.option("-e", "--enclaves", multiple=True, metavar="NAME...", help="Enclaves to create.")
@click.option(
    "-p",
    "--policy-files",
    multiple=True,
    type=PATH,
    metavar="FILE...",
    help="Policies whose enclaves to create, with their permissions.",
)
@click.option(
    "--template",
    "template_name",
    default="development",
    show_default=True,
    metavar="NAME|FILE",
    help="The choices to make a missing keystore by.",
    shell_complete=complete_template,
)
@dry_run_option
def generate_artifacts(
    keystore_root_path: Path | None,
    enclaves: tuple[str, ...],
    policy_files: tuple[Path, ...],
    template_name: str,
    dry_run: bool,
) -> None:
    """Create enclaves, and the permissions that policies state for them, all or nothing.

    Permissions that a policy states replace those that an enclave has.
    """
    from sros_tool.cli.create_keystore import say_new_keystore
    from sros_tool.keystore import generate_artifacts as generate
    from sros_tool.keystore.template import load_template
    from sros_tool.policy import read_policy

    root = keystore_root_path or keystore_from_environment()
    if not enclaves and not policy_files:
        raise UsageError(
            "neither an enclave nor a policy is named", "", "Give -e NAME... or -p FILE... ."
        )
    policies = [read_policy(path) for path in policy_files]
    template = load_template(template_name)
    total = len(enclaves) + sum(len(policy.enclaves) for policy in policies)
    with progress_bar(total) as step:
        result = generate(
            root,
            enclaves=enclaves,
            policies=policies,
            now=now(),
            domain=ros_domain(),
            create=template,
            keyring=keyring(),
            dry_run=dry_run,
            progress=step,
        )
    if result.new_keystore and not dry_run:
        click.echo(f"'{root}' is not a valid keystore, creating new keystore", err=True)
        say_new_keystore(root, template, result.domains)
    _show(result, dry_run)


def _show(result: Result, dry_run: bool) -> None:
    if dry_run:
        print_plan(result.root, result.changes)
    else:
        for names, text in (
            (result.created, "created enclave {}"),
            (result.changed, "replaced the permissions of enclave {}"),
            (result.completed, "completed enclave {}"),
        ):
            for name in names:
                click.echo(text.format(name))
    for name in result.kept:
        click.echo(f"enclave {name} already exists: left as it is", err=True)
    print_notes(result.notes)


@click.command(
    "list_enclaves",
    epilog="""\b
Example:
  $ sros list_enclaves keystore
  /listener
  /talker""",
)
@click.argument("root", type=PATH, required=False)
@json_option
def list_enclaves(root: Path | None, as_json: bool) -> None:
    """List the enclaves of the keystore ROOT, sorted."""
    from sros_tool.errors import KeystoreError
    from sros_tool.keystore.layout import enclave_names, is_keystore

    root = root or keystore_from_environment()
    if not is_keystore(root):
        raise KeystoreError(f"'{root}' is not a valid keystore")
    names = list(enclave_names(root))
    if as_json:
        print_json({"keystore": str(root), "enclaves": names})
        return
    for name in names:
        click.echo(name)
