"""The verb that gives a keystore its Zenoh network, and the files with which Zenoh enforces it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    dry_run_option,
    force_option,
    json_option,
    keyring,
    keystore_from_environment,
    now,
    output_option,
    print_closed,
    print_json,
    print_notes,
    print_plan,
    print_restart,
)
from sros_tool.cli.progress import progress
from sros_tool.cli.zenoh_from import show_from
from sros_tool.errors import UsageError
from sros_tool.terminal import echo

if TYPE_CHECKING:
    from sros_tool.keystore.template import Template
    from sros_tool.zenoh.network import ZenohNetwork

_DONE = {"create": "wrote", "replace": "replaced", "remove": "removed"}
_FOUND = {"create": "missing", "replace": "out of date", "remove": "no longer needed"}


@click.command(
    "zenoh",
    epilog="""\b
Example:
  $ sros zenoh keystore
  created enclave /router
  wrote keystore/enclaves/router/router.json5
  wrote keystore/enclaves/talker/session.json5
  $ sros zenoh keystore --mode peer --endpoint robot:7447 --listen [::]:7447
  $ sros zenoh keystore --check
  $ sros zenoh --from session.json5 -o policy.xml

Exit status: 0 written, or up to date; with --check 1 if a file is missing or
out of date; with --from 1 if the file is open or does not work; 2 if it could
not be done, such as for rights that Zenoh cannot enforce.""",
)
@click.argument("root", type=PATH, required=False)
@click.option("--router", metavar="NAME", help="Enclave of the router; usually /router.")
@click.option(
    "--endpoint",
    "endpoints",
    multiple=True,
    metavar="HOST:PORT",
    help="Where sessions connect to the router; usually localhost:7447. May be repeated.",
)
@click.option(
    "--listen",
    multiple=True,
    metavar="HOST:PORT",
    help="Where the router listens, if not at the endpoints. May be repeated.",
)
@click.option(
    "--mode",
    type=click.Choice(["client", "peer"]),
    help="client (usual): sessions connect to the router alone. peer: also to each other.",
)
@click.option("--domain", metavar="IDS", help="ROS domains; usually those of the keystore.")
@click.option("--off", is_flag=True, help="Remove the files, and keep none in step any more.")
@click.option(
    "--check", "only_check", is_flag=True, help="Write nothing; say what is missing or out of date."
)
@click.option(
    "--from",
    "existing",
    type=PATH,
    metavar="FILE",
    help="Say what an existing configuration of Zenoh allows whom, and where it is open.",
)
@output_option("With --from: write what it allows as a policy to FILE.")
@force_option
@dry_run_option
@json_option
def zenoh(
    root: Path | None,
    router: str | None,
    endpoints: tuple[str, ...],
    listen: tuple[str, ...],
    mode: str | None,
    domain: str | None,
    off: bool,
    only_check: bool,
    existing: Path | None,
    output: Path | None,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Write the files with which Zenoh enforces the rights of the keystore ROOT (rmw_zenoh).

    Every enclave gets session.json5, and the router's enclave router.json5, each with the same
    document signed next to it.  They state the rights of the signed permissions.  The choices are
    kept in the keystore's settings, and from then on every verb that changes the keystore keeps
    the files in step.
    """
    from sros_tool.keystore.layout import ZENOH_FILES, check_keystore
    from sros_tool.keystore.lifecycle.zenoh import set_zenoh
    from sros_tool.keystore.reader import load_settings
    from sros_tool.keystore.unchanged import of_one_state

    if existing:
        _refuse_with_from(root, router, *endpoints, *listen, mode, domain, off, only_check)
        raise SystemExit(show_from(existing, output, force=force, dry_run=dry_run, as_json=as_json))
    if output or force:
        raise UsageError("--output and --force are for --from only", "", "Leave them out.")
    root = root or keystore_from_environment()
    check_keystore(root)
    settings = load_settings(root)
    chosen = {
        "router": router,
        "endpoints": ",".join(endpoints),
        "listen": ",".join(listen),
        "mode": mode,
        "domains": _domains(domain),
    }
    given = {f"zenoh.{key}": text for key, text in chosen.items() if text}
    if off and given:
        raise UsageError("--off takes no other choice of the network", "", "Leave one of them out.")
    network = None if off else _network(settings, given)
    with progress("writing the files of Zenoh"):
        work = of_one_state(set_zenoh) if only_check else set_zenoh
        result = work(root, network, now=now(), keyring=keyring(), dry_run=dry_run or only_check)
    # A document and the signed one next to it are written together.
    actions = {
        each.path: each.action for each in result.changes if Path(each.path).name in ZENOH_FILES
    }
    changed = dict.fromkeys(map(_document, actions))
    if as_json:
        from sros_tool.keystore.lifecycle.shown import shown_zenoh

        print_json(shown_zenoh(result, network, changed, dry_run=dry_run or only_check))
    elif dry_run and not only_check:
        print_plan(root, result.changes)
    else:
        for name in result.created:
            echo(f"{'missing:' if only_check else 'created'} enclave {name}")
        for path in changed:
            action = actions.get(path, "replace")
            word = f"{_FOUND[action]}:" if only_check else _DONE[action]
            echo(f"{word} {root / path}")
    if not result.changes:
        echo("the files of Zenoh are up to date", err=True)
    if not (dry_run or only_check):
        print_closed(root, result.changes)
        print_restart(result.restart)
    print_notes(result.notes)
    if only_check and result.changes:
        raise SystemExit(1)


def _refuse_with_from(*given: object) -> None:
    if any(given):
        raise UsageError(
            "--from takes no keystore and no choice of the network",
            "It reads one configuration, and changes nothing.",
            "Leave them out.",
        )


def _network(settings: Template, given: dict[str, str]) -> ZenohNetwork:
    """Return the network of the settings, or the usual one, with the values that are ``given``."""
    from sros_tool.keystore.template import with_values
    from sros_tool.zenoh.network import ZenohNetwork

    network = settings.zenoh or ZenohNetwork()
    found = with_values(replace(settings, zenoh=network), list(given.items())).zenoh
    return found or network


def _domains(text: str | None) -> str:
    """Return domain ids such as ``3-5,9`` one by one."""
    from sros_tool.dds.domains import DomainSet

    return ",".join(map(str, DomainSet.parse(text, "--domain"))) if text else ""


def _document(path: str) -> str:
    """Return the path of the document to which a file of Zenoh belongs."""
    return path.removesuffix(".p7s").removesuffix(".json5") + ".json5"
