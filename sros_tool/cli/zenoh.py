"""The verb that writes the configurations of Zenoh for the enclaves of a keystore."""

from __future__ import annotations

import os
from pathlib import Path

import click

from sros_tool.cli.common import (
    KEYSTORE_VARIABLE,
    PATH,
    complete_file,
    domain_of,
    dry_run_option,
    json_option,
    keyring,
    keystore_from_environment,
    now,
    print_closed,
    print_json,
    print_notes,
    print_plan,
    print_restart,
    ros_domain,
    visible,
)
from sros_tool.cli.progress import progress
from sros_tool.cli.written import changes_json, notes_json
from sros_tool.errors import UsageError

_DONE = {"create": "wrote", "replace": "replaced", "remove": "removed"}


@click.command(
    "zenoh",
    epilog="""\b
Example:
  $ sros create_enclave keystore /router
  $ sros generate_artifacts -k keystore -p policy.xml
  $ sros zenoh keystore policy.xml
  wrote keystore/enclaves/router/router.json5
  wrote keystore/enclaves/talker/session.json5

Exit status: 0 written, or up to date; with --check 1 if a file is missing or
out of date; 2 if it could not be done, such as for a policy that Zenoh cannot
enforce.""",
)
@click.argument(
    "words",
    metavar="[ROOT] POLICY...",
    nargs=-1,
    required=True,
    shell_complete=lambda _ctx, _parameter, incomplete: complete_file(incomplete),
)
@click.option(
    "-o", "--output", type=PATH, metavar="DIR", help="Write below DIR, not into the keystore."
)
@click.option(
    "--router", default="/router", show_default=True, metavar="NAME", help="Enclave of the router."
)
@click.option(
    "--endpoint",
    default="localhost:7447",
    show_default=True,
    metavar="HOST:PORT",
    help="Where the router listens, and all others connect.",
)
@click.option(
    "--mode",
    type=click.Choice(["peer", "client"]),
    default="peer",
    show_default=True,
    help="peer: sessions also connect to each other. client: to the router alone.",
)
@click.option("--domain", metavar="ID", help="The ROS domain; by default $ROS_DOMAIN_ID.")
@click.option("--check", "only_check", is_flag=True, help="Write nothing; say what is out of date.")
@dry_run_option
@json_option
def zenoh(
    words: tuple[str, ...],
    output: Path | None,
    router: str,
    endpoint: str,
    mode: str,
    domain: str | None,
    only_check: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Write the files that make Zenoh enforce the policies, for nodes on rmw_zenoh.

    Every enclave of the policies gets session.json5, and the router's enclave router.json5, each
    with the same document signed next to it. The permissions of the enclaves have to be those of
    the policies.
    """
    from sros_tool.keystore.lifecycle.zenoh import ZenohNetwork, write_zenoh_files
    from sros_tool.keystore.reader import open_keystore
    from sros_tool.policy.document import read_policy
    from sros_tool.runtime.environment import choose_domain
    from sros_tool.zenoh.configuration import Mode, is_endpoint

    if not is_endpoint(endpoint):
        raise UsageError(
            f"--endpoint {endpoint!r} is not HOST:PORT",
            "",
            "Write for example localhost:7447, 192.168.1.2:7447 or [::1]:7447.",
        )
    wanted = domain_of(domain)
    if wanted is None:
        wanted = ros_domain()
    root, policy_files = _root_and_policies(words)
    policies = [read_policy(path) for path in policy_files]
    chosen = choose_domain(open_keystore(root).domains, wanted, root)
    with progress("translating"):
        result = write_zenoh_files(
            root,
            policies,
            ZenohNetwork(router, endpoint, Mode(mode), chosen),
            now=now(),
            output=output,
            keyring=keyring(),
            dry_run=dry_run or only_check,
        )
    # A document and the signed one next to it are written together.
    documents = [each for each in result.changes if each.path.endswith(".json5")]
    changed = {each.path for each in documents}
    if as_json:
        print_json(
            {
                "keystore": str(root),
                "folder": str(result.folder),
                "dry_run": dry_run or only_check,
                "router": router,
                "endpoint": endpoint,
                "mode": mode,
                "domain": chosen,
                "files": [
                    {
                        "enclave": name,
                        "path": str(result.folder / path),
                        "current": path not in changed,
                    }
                    for name, path in result.files.items()
                ],
                "restart": list(result.restart),
                "changes": changes_json(result.folder, result.changes),
                "notes": notes_json(result.notes),
            }
        )
    elif only_check:
        for each in documents:
            click.echo(visible(f"out of date: {result.folder / each.path}"))
    elif dry_run:
        print_plan(result.folder, result.changes)
    else:
        for each in documents:
            click.echo(visible(f"{_DONE[each.action]} {result.folder / each.path}"))
    if not documents:
        click.echo("the files of Zenoh are up to date", err=True)
    if not (dry_run or only_check):
        print_closed(result.folder, result.changes)
        print_restart(result.restart)
    print_notes(result.notes)
    if only_check and documents:
        raise SystemExit(1)


def _root_and_policies(words: tuple[str, ...]) -> tuple[Path, list[Path]]:
    """Return the keystore, which may also be that of the environment, and the policy files."""
    paths = [PATH.convert(each, None, None) for each in words]
    if os.environ.get(KEYSTORE_VARIABLE) and not paths[0].is_dir():
        return keystore_from_environment(), paths
    if len(paths) < 2:
        raise UsageError(
            "zenoh takes a keystore and one or more policies",
            "",
            f"Name both, or set {KEYSTORE_VARIABLE}.",
        )
    return paths[0], paths[1:]
