"""The verbs for the life of keys: renewing and revoking."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    complete_keystore_and_enclave,
    dry_run_option,
    json_option,
    keystore_from_environment,
    now,
    print_json,
    print_notes,
    print_plan,
    progress_bar,
    split_root,
)
from sros_tool.cli.secrets import keyring
from sros_tool.errors import UsageError

if TYPE_CHECKING:
    from sros_tool.keystore.renew import Renewal

_MANY = 5


@click.command(
    "renew",
    epilog="""\b
Example:
  $ sros renew keystore /talker
  renewed enclave /talker
  the replaced certificate works until 2027-11-21T09:00:00Z, unless revoked: see --revoke-old
  $ sros renew keystore --all-expiring 30d --revoke-old""",
)
@click.argument(
    "words",
    metavar="[ROOT] [NAME...]",
    nargs=-1,
    shell_complete=complete_keystore_and_enclave,
)
@click.option(
    "--all-expiring",
    metavar="DURATION|PERCENT",
    help="Renew also all that end within 30d, or of whose life 66% is over.",
)
@click.option("--new-key", is_flag=True, help="Make new keys, too.")
@click.option(
    "--revoke-old",
    is_flag=True,
    help="Revoke the earlier certificates of what is renewed, as superseded.",
)
@dry_run_option
def renew(
    words: tuple[str, ...],
    all_expiring: str | None,
    new_key: bool,
    revoke_old: bool,
    dry_run: bool,
) -> None:
    """Issue new certificates for the enclaves NAME..., and sign their permissions anew.

    The rights stay as they are.  Processes that run go on with what they have loaded; restart
    them before it ends.

    A certificate that is replaced works until it ends, together with the permissions of its time,
    for whoever has a copy of the files.  With --revoke-old nobody who reads the new crl.pem
    accepts it: restart the renewed processes first, then the others.
    """
    from sros_tool.keystore.renew import parse_threshold
    from sros_tool.keystore.renew import renew as work

    root, names = split_root(words)
    if not names and all_expiring is None:
        raise UsageError("no enclave is named", "", "Name one or more, or give --all-expiring 30d.")
    threshold = parse_threshold(all_expiring) if all_expiring is not None else None
    with progress_bar(len(names) or 50) as step:
        result = work(
            root,
            names,
            now=now(),
            expiring=threshold,
            new_key=new_key,
            revoke_old=revoke_old,
            keyring=keyring(),
            dry_run=dry_run,
            progress=step,
        )
    if dry_run:
        print_plan(root, result.changes)
    else:
        for name in result.renewed:
            click.echo(f"renewed enclave {name}")
        if not result.renewed:
            click.echo("no enclave needs to be renewed", err=True)
    print_notes(result.notes)
    _say_replaced(result)


def _say_replaced(result: Renewal) -> None:
    from sros_tool.validity import iso

    if result.works_until:
        end = iso(result.works_until)
        what = (
            f"the replaced certificate works until {end}"
            if len(result.renewed) == 1
            else f"the replaced certificates work until {end} at the latest"
        )
        click.echo(f"{what}, unless revoked: see --revoke-old", err=True)
    elif result.restart:
        _say_restart(result.restart)
    for remark in result.remarks:
        click.echo(remark, err=True)


def _complete_reason(
    _ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[str]:
    """Completes the reasons of RFC 5280, written as RFC 5280 writes them."""
    from sros_tool.pki.crl import REASONS

    return [each for each in REASONS if each.startswith(incomplete)]


@click.command(
    "revoke",
    epilog="""\b
Example:
  $ sros revoke keystore /talker --reason key_compromise
  revoked enclave /talker
  restart the processes of 2 enclaves for it to take effect: /listener, /monitor""",
)
@click.argument(
    "words",
    metavar="[ROOT] NAME...",
    nargs=-1,
    required=True,
    shell_complete=complete_keystore_and_enclave,
)
@click.option(
    "--reason",
    default="unspecified",
    shell_complete=_complete_reason,
    show_default=True,
    help="Why, in a word of RFC 5280, such as key_compromise, superseded, cessation_of_operation.",
)
@click.option(
    "--until-retired",
    is_flag=True,
    help="While CAs are replaced: revoke without the key of the old identity CA.",
)
@dry_run_option
def revoke(words: tuple[str, ...], reason: str, until_retired: bool, dry_run: bool) -> None:
    """Revoke the enclaves NAME...: nobody who reads the new crl.pem talks to them any more.

    Their files move to the folder "revoked" of the keystore.  Exported enclaves need their
    crl.pem exported again, and their CA files, too, while a rotation of CAs is under way.

    In a rotation both CAs revoke, for Fast DDS trusts both. Where the key of the old one is gone,
    its certificates are refused only once `sros rotate_ca --to retire` is done; --until-retired
    accepts that.
    """
    from sros_tool.keystore.revoke import revoke as work

    root, names = split_root(words)
    if not names:
        raise UsageError("no enclave is named", "", "Name one or more, such as /talker.")
    words_of_rfc = reason.replace("-", "_").split("_")
    told = words_of_rfc[0] + "".join(word.capitalize() for word in words_of_rfc[1:])
    result = work(
        root,
        names,
        now=now(),
        reason=told,
        keyring=keyring(),
        until_retired=until_retired,
        dry_run=dry_run,
    )
    if dry_run:
        print_plan(root, result.changes)
    else:
        for name in result.revoked:
            click.echo(f"revoked enclave {name}")
    _say_restart(result.restart)
    for remark in result.remarks:
        click.echo(remark, err=True)


@click.command(
    "crl",
    epilog="""\b
Example:
  $ sros crl keystore
  revocation list 3, until 2036-11-18T06:05:29Z
    69aa94992b4cf7d761cf3c3e06f16849896e24a3  2026-11-21T07:00:00Z  keyCompromise
  $ sros crl keystore --refresh""",
)
@click.argument("root", type=PATH, required=False)
@click.option("--refresh", is_flag=True, help="Sign it anew, so that it holds for longer.")
@json_option
@dry_run_option
def crl(root: Path | None, refresh: bool, as_json: bool, dry_run: bool) -> int:
    """Show the revocation list of the keystore ROOT, or sign it anew.

    An expired list makes DDS refuse everybody, so the exit status is 1 when it ends within 30
    days.
    """
    from datetime import timedelta

    from sros_tool.keystore.create import list_enclaves
    from sros_tool.keystore.lists import read_lists
    from sros_tool.keystore.revoke import refresh_crl
    from sros_tool.pki.certificates import subject_text
    from sros_tool.validity import iso

    root = root or keystore_from_environment()
    list_enclaves(root)
    if refresh:
        result = refresh_crl(root, now=now(), keyring=keyring(), dry_run=dry_run)
        if dry_run:
            print_plan(root, result.changes)
            return 0
        _say_restart(result.restart)
        for remark in result.remarks:
            click.echo(remark, err=True)
    lists = read_lists(root)
    if not lists:
        print_json(None) if as_json else click.echo("nothing was ever revoked", err=True)
        return 0
    found, *beside = lists
    soon = min(each.next_update for each in lists) - now() < timedelta(days=30)
    if as_json:
        print_json(
            {
                "number": found.number,
                "this_update": iso(found.this_update),
                "next_update": iso(found.next_update),
                "ends_soon": soon,
                "revoked": [
                    {"serial": f"{each.serial:x}", "date": iso(each.date), "reason": each.reason}
                    for each in found.revoked
                ],
                "beside": [
                    {
                        "issuer": subject_text(each.list.issuer),
                        "number": each.number,
                        "this_update": iso(each.this_update),
                        "next_update": iso(each.next_update),
                        "revoked": [f"{one.serial:x}" for one in each.revoked],
                    }
                    for each in beside
                ],
            }
        )
    else:
        click.echo(f"revocation list {found.number}, until {iso(found.next_update)}")
        for each in found.revoked:
            click.echo(f"  {each.serial:x}  {iso(each.date)}  {each.reason}")
        for other in beside:  # of the CA that comes or goes, while one replaces the other
            click.echo(
                f"beside it, list {other.number} of {subject_text(other.list.issuer)}, until "
                f"{iso(other.next_update)}: {len(other.revoked)} revoked"
            )
    if soon:
        click.echo(
            f"it ends soon, and DDS then refuses everybody: run `sros crl {root} --refresh`.",
            err=True,
        )
    return 1 if soon else 0


def _say_restart(names: tuple[str, ...]) -> None:
    if not names:
        return
    shown = ", ".join(names[:_MANY]) + (", ..." if len(names) > _MANY else "")
    click.echo(
        f"restart the processes of {len(names)} enclaves for it to take effect: {shown}", err=True
    )
