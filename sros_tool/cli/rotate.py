"""The verb that replaces the CAs of a keystore, stage by stage."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    dry_run_option,
    json_option,
    keystore_from_environment,
    now,
    print_json,
    print_notes,
    print_plan,
    progress_bar,
)
from sros_tool.cli.secrets import keyring
from sros_tool.errors import UsageError

if TYPE_CHECKING:
    from sros_tool.keystore.keyring import Keyring
    from sros_tool.keystore.rotate import RotationStep
    from sros_tool.keystore.rotation import RotationStatus

_DONE = {
    "distribute": "distributed the new CA beside the old one",
    "reissue": "issued and signed everything anew by the new CA",
    "retire": "retired the old CA",
}


@click.command(
    "rotate_ca",
    epilog="""\b
Example:
  $ sros rotate_ca keystore --next
  distributed the new CA beside the old one: identity_ca, permissions_ca
  $ sros rotate_ca keystore --status
  stage: distribute, next: reissue
    identity CA    issuing 2 of 2 enclaves  until 2036-11-18T07:37:42Z  CN=sros identity CA b6d1525f
    identity CA    next    0 of 2 enclaves  until 2036-11-18T07:37:45Z  CN=sros identity CA 45aff1c0
  $ sros rotate_ca keystore --next     # once all processes were restarted
  issued and signed everything anew by the new CA: identity_ca, permissions_ca
  $ sros rotate_ca keystore --next     # once more, all processes were restarted
  retired the old CA: identity_ca, permissions_ca
  $ sros rotate_ca keystore --finish   # or all stages at once; then restart all together""",
)
@click.argument("root", type=PATH, required=False)
@click.option("--identity", is_flag=True, help="Only the identity CA.")
@click.option("--permissions", is_flag=True, help="Only the permissions CA.")
@click.option("--status", is_flag=True, help="Say where the keystore stands (the default).")
@click.option("--next", "go_on", is_flag=True, help="Do the next stage.")
@click.option(
    "--to",
    type=click.Choice(["distribute", "reissue", "retire"]),
    help="Do the next stage if it is that one, and nothing if it is done.",
)
@click.option("--finish", is_flag=True, help="Do all stages that remain, at once.")
@click.option(
    "--same-key",
    is_flag=True,
    help="Give the identity CA a longer life without a new key; no stages are needed.",
)
@click.option("--ca-validity", metavar="SPAN", help="How long the new CA is valid, such as 10y.")
@click.option("--identity-key", metavar="URI", help="Where the new key is made: file: or pkcs11:.")
@click.option("--permissions-key", metavar="URI", help="The same for the permissions CA.")
@click.option("--encrypt-ca-keys", is_flag=True, help="Protect new keys in files by a passphrase.")
@click.option("--delete-old-key", is_flag=True, help="Do not keep the old key in 'retired'.")
@json_option
@dry_run_option
def rotate_ca(
    root: Path | None,
    identity: bool,
    permissions: bool,
    status: bool,
    go_on: bool,
    to: str | None,
    finish: bool,
    same_key: bool,
    ca_validity: str | None,
    identity_key: str | None,
    permissions_key: str | None,
    encrypt_ca_keys: bool,
    delete_old_key: bool,
    as_json: bool,
    dry_run: bool,
) -> None:
    """Replace the CAs of the keystore ROOT while its robots run.

    Stage 1, distribute: a new CA is trusted beside the old one. Stage 2, reissue: certificates,
    governance and permissions are made anew by the new CA. Stage 3, retire: the old CA is trusted
    no longer. Processes notice nothing before they are restarted; restart them all after each
    stage, and export again what was exported.

    Fast DDS (2.9.1) lets processes talk at every moment of this. Cyclone DDS (0.10.2) trusts one
    CA at a time: after stage 2, restart all its processes together. There, an identity CA that
    only comes to its end is better renewed with --same-key, which disturbs nobody.
    """
    from sros_tool.keystore.rotate import renew_identity_ca
    from sros_tool.keystore.rotate import rotate_ca as work
    from sros_tool.keystore.rotation import Stage, rotation_status
    from sros_tool.validity import parse_span

    if sum((status, go_on, to is not None, finish, same_key)) > 1:
        raise UsageError("only one of --status, --next, --to, --finish and --same-key makes sense")
    root = root or keystore_from_environment()
    if not (go_on or to or finish or same_key):
        _show_status(rotation_status(root, now=now()), as_json)
        return
    validity = parse_span(ca_validity) if ca_validity is not None else None
    if same_key:
        if permissions:
            raise UsageError(
                "the permissions CA cannot keep its key",
                "DDS takes what it has signed from the very certificate only.",
                "Leave out --permissions or --same-key.",
            )
        step = renew_identity_ca(
            root, now=now(), keyring=keyring(), validity=validity, dry_run=dry_run
        )
    else:
        roles = [r for r, on in (("identity", identity), ("permissions", permissions)) if on]
        with progress_bar(50) as tick:
            step = work(
                root,
                Stage(to) if to else None,
                roles=roles,
                now=now(),
                finish=finish,
                keyring=keyring(),
                new_keys=_new_keys(identity_key, permissions_key, encrypt_ca_keys),
                validity=validity,
                delete_old_key=delete_old_key,
                dry_run=dry_run,
                progress=tick,
            )
    if dry_run:
        print_plan(root, step.changes)
    else:
        _say(step, rotation_status(root, now=now()), together=finish, same_key=same_key)
    print_notes(step.notes)


def _say(step: RotationStep, status: RotationStatus, *, together: bool, same_key: bool) -> None:
    if not step.changes:
        click.echo("nothing is left to do", err=True)
        return
    if same_key:
        click.echo("renewed the identity CA with its key; what it has issued stays valid")
        click.echo(
            "Restart the processes when it suits; those restarted and those not yet restarted talk "
            "with each other. Certificates expire when they did: `sros renew "
            f"{step.root} --all-expiring 30d` renews those that soon do.",
            err=True,
        )
        return
    anew = any(each.path.endswith("/cert.pem") for each in step.changes)
    done = f"{_DONE['reissue']}, and " if together and anew else ""
    click.echo(f"{done}{_DONE[step.stage]}: {', '.join(step.files)}")
    for place in step.kept_elsewhere:
        click.echo(f"the old key at '{place}' is used no longer, and was left there", err=True)
    if step.stage == "retire":
        how = "together" if together else "when it suits; all of them go on talking"
        click.echo(f"Restart all processes {how}.", err=True)
    for remark in status.remarks:
        click.echo(remark, err=True)


def _show_status(status: RotationStatus, as_json: bool) -> None:
    from sros_tool.validity import iso

    rotation = status.rotation
    if as_json:
        print_json(
            {
                "stage": rotation.stage,
                "next": rotation.following(),
                "enclaves": status.enclaves,
                "authorities": [
                    {
                        "roles": list(each.roles),
                        "standing": each.standing,
                        "subject": each.subject,
                        "serial": each.serial,
                        "not_before": iso(each.validity.not_before),
                        "not_after": iso(each.validity.not_after),
                        "enclaves": each.enclaves,
                    }
                    for each in status.authorities
                ],
                "remarks": list(status.remarks),
            }
        )
        return
    click.echo(f"stage: {rotation.stage}, next: {rotation.following()}")
    for each in status.authorities:
        name = f"{each.roles[0]} CA" if len(each.roles) == 1 else "CA"
        end = f"until {iso(each.validity.not_after)}"
        if each.validity.not_after < now():
            end = f"ENDED {iso(each.validity.not_after)}"
        click.echo(
            f"  {name:14} {each.standing:7} {each.enclaves} of {status.enclaves} enclaves  {end}"
            f"  {each.subject}"
        )
    for remark in status.remarks:
        click.echo(remark)


def _new_keys(identity: str | None, permissions: str | None, encrypt: bool) -> Keyring:
    """Where new keys are made.

    What the environment names are the places of the present keys.
    """
    from dataclasses import replace

    named = {"identity": identity, "permissions": permissions}
    found = keyring(identity, permissions, encrypt=encrypt)
    return replace(
        found, places={role: place for role, place in found.places.items() if named[role]}
    )
