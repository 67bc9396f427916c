"""The verbs for the life of keys: `renew`, `revoke`, `crl` and `rotate_ca`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from sros_tool.cli.changed import (
    enclave_lines,
    json_form,
    planned_lines,
    print_changed,
    print_follow_up,
    print_plan,
    shown_names,
)
from sros_tool.cli.common import (
    PATH,
    allow_refusal_option,
    change_options,
    check_chosen,
    chosen_enclaves,
    dry_run_option,
    json_option,
    key_option,
    keyring,
    keystore_argument,
    keystore_arguments,
    now,
    print_json,
    print_notes,
    progress,
    several_enclaves_options,
    split_root,
    try_passphrase,
    verb,
)
from sros_tool.errors import Note, SrosError, UsageError
from sros_tool.terminal import echo
from sros_tool.wording import capitalized, first_few, serial_text

if TYPE_CHECKING:
    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.keystore.lifecycle.change import Changed
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.pki.crl import RevocationList


_crl_option = click.option(
    "--crl",
    "crl_file",
    type=PATH,
    help="Revocation list (PEM) that the CA service signed, for a keystore with a CA service. With "
    "`sros crl`, after the keystore was restored from a backup: a list made after the backup, such "
    "as a robot's crl.pem.",
)


@verb("renew")
@keystore_arguments("[KEYSTORE] [ENCLAVE...]", required=False)
@several_enclaves_options
@click.option(
    "--all-expiring",
    metavar="DURATION|PERCENT|soon",
    help="Renew the named enclaves, and all that expire within DURATION (30d) or have used PERCENT "
    "of their validity (66%). `soon`: a file of the enclave expires within 30 days, or within a "
    "third of its validity if this third is shorter. A short-lived enclave is renewed only "
    "if you name it, or if it belongs to a process that `sros close` saw on this machine.",
)
@click.option("--new-key", is_flag=True, help="Also create new private keys.")
@key_option
@click.option(
    "--revoke-old",
    is_flag=True,
    help="Revoke earlier certificates of renewed enclaves, with the reason superseded.",
)
@allow_refusal_option
@dry_run_option
@json_option
def renew(
    arguments: tuple[str, ...],
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    all_expiring: str | None,
    new_key: bool,
    key: str,
    revoke_old: bool,
    allow_refusal: tuple[Vendor, ...],
    dry_run: bool,
    as_json: bool,
) -> int:
    """Issue new certificates for ENCLAVE..., and sign their permissions again.

    The rights stay the same.  Running processes keep the files that they have loaded: restart the
    processes before these files expire. If some of these files have expired, restart all processes
    together.

    With --all-expiring, the enclaves of robots that left the fleet are not renewed: the command
    names those that are due, and exits with 1, until they are revoked or have expired.

    Anyone who has copies of a replaced certificate, of its key and of the permissions can use these
    copies until the certificate or the permissions expire. With --revoke-old, processes that load
    the new crl.pem refuse these copies: restart the renewed processes first, then all others.

    With --key, ENCLAVE... get new keys on a token, and their key.pem files are removed.

    Example:
      $ sros renew keystore /talker
      renewed enclave /talker
      the replaced certificate works until 2027-05-20T09:00:00Z, when ...
      $ sros renew keystore --all-expiring 30d --revoke-old
    """
    from sros_tool.keystore.delivery.restored import refuse_unpublished_restore
    from sros_tool.keystore.expiry import parse_threshold
    from sros_tool.keystore.lifecycle.renew import NOT_RENEWED
    from sros_tool.keystore.lifecycle.renew import renew as work
    from sros_tool.keystore.reader import OpenedKeystore

    root, names = split_root(arguments)
    keystore = OpenedKeystore(root)
    if names or patterns or robots or all_expiring is None:
        names = chosen_enclaves(keystore, names, patterns, robots)
    if patterns or all_expiring is not None:  # as a timer does, which agrees to no right
        refuse_unpublished_restore(keystore, "Renewing more than the named enclaves")
    threshold = parse_threshold(all_expiring) if all_expiring is not None else None
    with progress("renewing") as step:
        result = work(
            root,
            names,
            expiring=threshold,
            new_key=new_key,
            key=key,
            revoke_old=revoke_old,
            progress=step,
            **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
        )
    if not result.outcomes:
        try_passphrase(root, keyring())
    print_changed(
        result,
        json_form(result, "RenewedEnclaves") if as_json else None,
        enclave_lines(tuple(result.outcomes), "renewed enclave {}"),
        first=_replaced_lines(result, has_new_keys=new_key),
    )
    return 1 if any(note.id == NOT_RENEWED for note in result.notes) else 0


def _replaced_lines(result: Changed, *, has_new_keys: bool) -> Iterator[str]:
    """Yield lines that say how long replaced certificates still work, and what to do next.

    Next, exports may have to be made again, and processes may have to be restarted.
    """
    from sros_tool.keystore.fleet import publish_command
    from sros_tool.keystore.layout import remedy_in_closed_robot
    from sros_tool.validity import iso

    if not result.outcomes and not result.dry_run:
        yield "no enclave needs to be renewed"
    if result.works_until:
        end = iso(result.works_until)
        which = (
            "replaced certificate works"
            if len(result.outcomes) == 1
            else "last of the replaced certificates works"
        )
        others = (
            "; the ledger may lack certificates that work longer, because the keystore was "
            "restored from a backup"
        )
        yield (
            f"the {which} until it or its last permissions expire at {end}, or until it is "
            "revoked: "
            f"see --revoke-old{others * result.may_work_longer}"
        )
    if result.outcomes and not result.restart:
        published = publish_command(result.root)
        deliver = f"publish ({published}) or export again" if published else "export again"
        yield remedy_in_closed_robot(
            result.root,
            "exports and running processes still have the earlier certificates and permissions: "
            f"{deliver}, and restart the processes before these files expire; if some of "
            "these files have expired, restart all processes together",
        )
    if has_new_keys and result.outcomes and publish_command(result.root):
        yield (
            "a release has no keys: after publishing, bring the new keys by hand to robots that "
            "fetch: "
            f"`sros distribute_key {quote(str(result.root))} --robot NAME FOLDER --force`"
        )


def _complete_reason(
    _ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[str]:
    """Complete the revocation reasons of RFC 5280."""
    from sros_tool.pki.crl import REASONS, SUPERSEDED

    chosen = (reason for reason in REASONS if reason != SUPERSEDED)
    return [reason for reason in chosen if reason.startswith(incomplete)]


@verb("revoke")
@keystore_arguments("[KEYSTORE] [ENCLAVE...]", required=False)
@several_enclaves_options
@click.option(
    "--reason",
    default="unspecified",
    shell_complete=_complete_reason,
    show_default=True,
    help="Reason as in RFC 5280, such as key_compromise or cessation_of_operation, but not "
    "superseded.",
)
@click.option(
    "--until-retired",
    is_flag=True,
    help="During a CA rotation: revoke even if the key of the old identity CA is gone. The "
    "certificates of that CA are then refused only after the stage retire.",
)
@_crl_option
@allow_refusal_option
@dry_run_option
@json_option
def revoke(
    arguments: tuple[str, ...],
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    reason: str,
    until_retired: bool,
    crl_file: Path | None,
    allow_refusal: tuple[Vendor, ...],
    dry_run: bool,
    as_json: bool,
) -> None:
    """Revoke ENCLAVE...: processes that load the new crl.pem refuse them.

    The files of ENCLAVE... move to the folder "revoked" of the keystore.  Export the other enclaves
    to their robots again: the robots need the new crl.pem and, during a CA rotation, the CA files.

    During a rotation both CAs revoke, because Fast DDS trusts both. If the key of the old CA is
    gone, the certificates of that CA are refused only after `sros rotate_ca --to retire`;
    --until-retired accepts this delay.

    Example:
      $ sros revoke keystore /talker --reason key_compromise
      revoked enclave /talker
      restart the processes of 2 enclaves for the change to take effect: ...
    """
    from sros_tool.keystore.lifecycle.revoke import revoke as work
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.selection import select_enclaves_to_revoke

    root, given = split_root(arguments)
    check_chosen(given, patterns, robots)
    names, selection_notes = select_enclaves_to_revoke(
        OpenedKeystore(root), given, patterns, robots, now=now()
    )
    words_of_rfc = reason.replace("-", "_").split("_")
    reason_text = words_of_rfc[0] + "".join(word.capitalize() for word in words_of_rfc[1:])
    with progress("revoking"):
        result = work(
            root,
            names,
            reason=reason_text,
            until_retired=until_retired,
            crl=_read_given_list(crl_file),
            **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
        )
    result = replace(result, remarks=(*selection_notes, *result.remarks))
    shown = None
    if as_json:
        from sros_tool.keystore.lifecycle.shown import RevokedEnclave

        enclaves = list(map(RevokedEnclave, result.outcomes))
        shown = json_form(result, "RevokedEnclaves", enclaves=enclaves)
    names = tuple(result.outcomes)
    print_changed(
        result,
        shown,
        enclave_lines(names, "revoked enclave {}"),
        planned=planned_lines(root, names, "would revoke enclave {}"),
        after=_lines_on_closed_robot(root, names),
    )


def _lines_on_closed_robot(root: Path, revoked: Iterable[str]) -> Iterator[str]:
    """Yield a line if the policy in the folder of `sros close` still names revoked enclaves."""
    from sros_tool.keystore.layout import CLOSED_POLICY, folder_of_closed_robot
    from sros_tool.policy.document import read_policy

    robot, named = folder_of_closed_robot(root), list[str]()
    with suppress(SrosError):  # `sros close` says what is wrong with the policy
        policy = read_policy(robot / CLOSED_POLICY) if robot else None
        named = [name for name in revoked if policy and policy.enclave(name)]
    if robot and named:
        yield (
            f"first remove {shown_names(named)} from '{robot / CLOSED_POLICY}' (and from "
            f"requirements.toml): otherwise, `sros close {quote(str(robot))}` exports nothing, and "
            "no process gets the revocation list"
        )


@verb("crl")
@keystore_argument()
@click.option("--refresh", is_flag=True, help="Sign the list again to extend its validity.")
@_crl_option
@allow_refusal_option
@json_option
@dry_run_option
def crl(
    root: Path,
    refresh: bool,
    crl_file: Path | None,
    allow_refusal: tuple[Vendor, ...],
    as_json: bool,
    dry_run: bool,
) -> int:
    """Show the revocation list of KEYSTORE, or sign it again.

    DDS refuses every participant once the list has expired, so the exit status is 1 if the list
    expires within 30 days, or within a third of its validity if this third is shorter.

    With --refresh --crl FILE, a keystore that was restored from a backup revokes again the
    certificates in FILE: a revocation list made after the backup, such as a robot's crl.pem.

    Example:
      $ sros crl keystore
      revocation list 3, until 2036-11-18T06:05:29Z
        69aa94992b4cf7d761cf3c3e06f16849896e24a3  2026-11-21T07:00:00Z  ...
      $ sros crl keystore --refresh
    """

    from sros_tool.keystore.fleet import publish_command
    from sros_tool.keystore.layout import PUBLIC, list_enclaves
    from sros_tool.keystore.lifecycle.revoke import refresh_crl
    from sros_tool.keystore.reader import OpenedKeystore

    list_enclaves(root)
    result = None
    if crl_file and not refresh:
        raise UsageError("--crl has no effect without --refresh", "", "Add --refresh.")
    if refresh:
        result = refresh_crl(
            root,
            crl=_read_given_list(crl_file),
            **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
        )
        if dry_run and not as_json:
            print_plan(root, result.changes)
            return 0
        published = publish_command(root) if result.changes and not result.restart else ""
        after = [f"robots that fetch get the changed files after {published}"] if published else []
        print_follow_up(result, after, restart=not dry_run)
    keystore = OpenedKeystore(root)
    lists = keystore.revocation_lists
    if not (lists or (root / PUBLIC).is_dir()):
        raise UsageError(
            f"'{root}' is an export, which has no CAs",
            "The revocation list is in the folder of each enclave.",
            f"Show the list: `sros inspect {quote(str(root / 'enclaves'))}/ENCLAVE/crl.pem`.",
        )
    soon = any(revoked.expires_soon_from() < now() for revoked in lists)
    age_notes = tuple(_age_notes(keystore))
    if as_json:
        from sros_tool.keystore.lifecycle.shown import shown_lists

        enclaves = _enclaves_by_serial(keystore, lists)
        lists_shown = shown_lists(
            keystore, result, enclaves, age_notes, expires_soon=soon, dry_run=dry_run
        )
        print_json(lists_shown)
    elif lists:
        for line in _list_lines(lists, _enclaves_by_serial(keystore, lists)):
            echo(line)
    else:
        echo("the keystore knows of no revocation", err=True)
    print_notes(age_notes)
    if result and dry_run:
        return 0
    if soon:
        echo(
            "the list expires soon, or has expired; with an expired list, DDS refuses every "
            "participant: "
            f"run `sros crl {quote(str(root))} --refresh`.",
            err=True,
        )
    return 1 if soon else 0


def _read_given_list(path: Path | None) -> bytes:
    from sros_tool.xml import read_bytes

    return read_bytes(path, "revocation list") if path else b""


def _age_notes(keystore: OpenedKeystore) -> Iterator[Note]:
    """Yield a note if the keystore is known to be older than its robots."""
    from sros_tool.keystore.layout import PUBLISHED
    from sros_tool.keystore.ledger import RESTORED

    with suppress(SrosError):  # `sros check` reports a ledger that cannot be read
        if not (keystore.entries_of(RESTORED) or keystore.has(PUBLISHED)):
            return
        # Most keystores publish nothing, and do not need it.
        from sros_tool.keystore.delivery.publish import unpublished_restore_clause

        if why := unpublished_restore_clause(keystore):
            yield Note(
                "crl.older-keystore",
                f"the keystore is older than its robots: {why}. It was restored from a backup, or "
                "is a copy, and may lack later revocations: run `sros fleet status "
                f"{quote(str(keystore.root))}`, which names the next step.",
            )


def _enclaves_by_serial(
    keystore: OpenedKeystore, lists: Sequence[RevocationList]
) -> dict[str, str]:
    """Map the serial numbers in ``lists`` to enclaves, by the records of the ledger.

    If a revocation was repeated after a restore, its record names no enclave.
    """
    serials = {f"{entry.serial:x}" for crl in lists for entry in crl.revoked}
    ledger = keystore.ledger_file.with_values("serial", serials)
    return {entry.serial: entry.enclave for entry in ledger.entries if entry.enclave}


def _list_lines(lists: Sequence[RevocationList], names: Mapping[str, str]) -> Iterator[str]:
    from sros_tool.pki.certificates import subject_text
    from sros_tool.validity import iso

    newest, *further_lists = lists
    yield f"revocation list {newest.number}, until {iso(newest.next_update)}"
    for entry in newest.revoked:
        serial, enclave = serial_text(entry.serial), names.get(f"{entry.serial:x}", "")
        yield f"  {serial}  {iso(entry.date)}  {entry.reason}  {enclave}".rstrip()
    for other_list in further_lists:  # of the other CA during a rotation
        yield (
            f"next to it, list {other_list.number} of the other CA, "
            f"{subject_text(other_list.list.issuer)}, until {iso(other_list.next_update)}: "
            f"{len(other_list.revoked)} revoked"
        )


if TYPE_CHECKING:
    from sros_tool.keystore.issuing.keyring import Keyring
    from sros_tool.keystore.lifecycle.rotate import RotationStep
    from sros_tool.keystore.lifecycle.rotation import RotationStatus
    from sros_tool.keystore.reader import OpenedKeystore

_STAGE_DONE_TEXTS = {
    "distribute": "distributed the new CA next to the old one",
    "reissue": "issued and signed everything with the new CA",
    "retire": "retired the old CA",
}


@verb("rotate_ca")
@keystore_argument()
@click.option("--identity", is_flag=True, help="Replace only the identity CA.")
@click.option("--permissions", is_flag=True, help="Replace only the permissions CA.")
@click.option("--status", is_flag=True, help="Show the stage of the keystore (the default).")
@click.option("--next", "go_on", is_flag=True, help="Perform the next stage of the rotation.")
@click.option(
    "--to",
    type=click.Choice(["distribute", "reissue", "retire"]),
    help="Perform this stage if it is the next one; if it is already done, change nothing.",
)
@click.option("--finish", is_flag=True, help="Perform all remaining stages together.")
@click.option(
    "--same-key",
    is_flag=True,
    help="Extend the validity of the identity CA, with the same key and without stages.",
)
@click.option(
    "--identity-ca",
    type=PATH,
    help="Certificate (PEM) of an existing CA that replaces the identity CA, for example of a CA "
    "that is younger than a restored backup; needs --identity-key. With --same-key, if a CA "
    "service signs: the new certificate of its CA.",
)
@click.option(
    "--permissions-ca",
    type=PATH,
    help="Like --identity-ca, for the permissions CA; needs --permissions-key.",
)
@click.option("--ca-validity", metavar="SPAN", help="How long the new CA is valid, such as 10y.")
@click.option(
    "--identity-key",
    metavar="URI",
    help="Place of the new identity CA key: file:PATH or pkcs11:...",
)
@click.option(
    "--permissions-key",
    metavar="URI",
    help="Place of the new permissions CA key: file:PATH or pkcs11:...",
)
@click.option(
    "--encrypt-ca-keys", is_flag=True, help="Protect new keys in files with a passphrase."
)
@click.option(
    "--delete-old-key",
    is_flag=True,
    help="In the stages reissue and retire: delete the old CA's private key instead of keeping it "
    "in the folder 'retired'. Refused if the key is outside of the keystore.",
)
@click.option(
    "--allow-unconfirmed",
    is_flag=True,
    help="Perform the stage even if some robots of the fleet have not confirmed the "
    "previous stage; these robots lose communication.",
)
@allow_refusal_option
@json_option
@dry_run_option
def rotate_ca(
    root: Path,
    identity: bool,
    permissions: bool,
    status: bool,
    go_on: bool,
    to: str | None,
    finish: bool,
    same_key: bool,
    identity_ca: Path | None,
    permissions_ca: Path | None,
    ca_validity: str | None,
    identity_key: str | None,
    permissions_key: str | None,
    encrypt_ca_keys: bool,
    delete_old_key: bool,
    allow_unconfirmed: bool,
    allow_refusal: tuple[Vendor, ...],
    as_json: bool,
    dry_run: bool,
) -> None:
    """Replace the CAs of KEYSTORE while its robots run.

    Stage 1, distribute: enclaves trust the new CA as well as the old one. Stage 2, reissue: the new
    CA issues all certificates, governance and permissions again. Stage 3, retire: enclaves no
    longer trust the old CA. Processes load the new files only when they start: after each stage,
    export all enclaves to their robots again, and restart all processes.

    Unless the output says otherwise, all processes on Fast DDS (2.9.1) can talk to each other at
    every moment of a rotation.
    Cyclone DDS (0.10.2) trusts one CA at a time: after stage 2, restart all its processes
    together. To only extend the validity of the identity CA, use --same-key: it has no stages, and
    you need not restart all processes together.

    In a keystore with a fleet, a stage is refused until all robots have confirmed the previous
    stage (`sros fleet confirm`).

    Example:
      $ sros rotate_ca keystore --next
      distributed the new CA next to the old one: identity_ca, permissions_ca
      $ sros rotate_ca keystore --status
      stage: distribute, next: reissue
        identity CA    issuing 2 of 2 enclaves  until 2036-11-18T07:37:42Z  ...
        identity CA    next    0 of 2 enclaves  until 2036-11-18T07:37:45Z  ...
      $ sros rotate_ca keystore --next     # once all processes were restarted
      issued and signed everything with the new CA: identity_ca, permissions_ca
      $ sros rotate_ca keystore --next     # once they were restarted again
      retired the old CA: identity_ca, permissions_ca
      $ sros rotate_ca keystore --finish   # or all together; then restart all
    """
    from sros_tool.keystore.layout import IDENTITY, PERMISSIONS
    from sros_tool.keystore.lifecycle.rotate import renew_identity_ca
    from sros_tool.keystore.lifecycle.rotate import rotate_ca as work
    from sros_tool.keystore.lifecycle.rotation import RotationStage, rotation_status
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.validity import parse_span
    from sros_tool.xml import read_bytes

    if sum((status, go_on, to is not None, finish, same_key)) > 1:
        raise UsageError("give only one of --status, --next, --to, --finish and --same-key")
    if not (go_on or to or finish or same_key):
        keystore = OpenedKeystore(root)
        status_now = rotation_status(keystore, now=now())
        _show_status(keystore, status_now, _unconfirmed_robots(keystore), as_json)
        return
    existing = {}
    for role, file, is_chosen, key in (
        (IDENTITY, identity_ca, identity, identity_key or same_key),
        (PERMISSIONS, permissions_ca, permissions, permissions_key),
    ):
        if file and not key:
            raise UsageError(
                f"--{role}-ca needs the key of this CA", "", f"Name it with --{role}-key."
            )
        if file and (identity or permissions) and not is_chosen:
            raise UsageError(
                f"--{role}-ca has no effect without --{role}",
                "",
                f"Add --{role}, or leave --{role}-ca out.",
            )
        if file:
            existing[role] = read_bytes(file, "CA certificate")
    validity = parse_span(ca_validity) if ca_validity is not None else None
    if same_key:
        if permissions or permissions_ca:
            raise UsageError(
                "the permissions CA cannot keep its key",
                "DDS accepts signed documents only from exactly the same CA certificate.",
                "Leave out --same-key, or the options for the permissions CA.",
            )
        step = renew_identity_ca(
            root,
            validity=validity,
            issued=existing.get(IDENTITY, b""),
            **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
        )
    else:
        roles = [r for r, on in (("identity", identity), ("permissions", permissions)) if on]
        with progress("rotating the CA") as tick:
            step = work(
                root,
                RotationStage(to) if to else None,
                roles=roles,
                finish=finish,
                new_keys=_new_keyring(identity_key, permissions_key, encrypt_ca_keys),
                existing=existing,
                validity=validity,
                delete_old_key=delete_old_key,
                allow_unconfirmed=allow_unconfirmed,
                progress=tick,
                **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
            )
    shown = None
    if as_json:
        shown = json_form(
            step,
            "RotationChange",
            authorities=step.files,
            old_keys_elsewhere=step.kept_elsewhere,
            remarks=() if dry_run else rotation_status(OpenedKeystore(root), now=now()).remarks,
        )
    done, to_do = "", list[str]()
    if not (as_json or dry_run):
        reached = rotation_status(OpenedKeystore(root), now=now())
        done, to_do = _step_lines(step, reached, together=finish, same_key=same_key)
    if step.cut_off:  # after the delivery, before restarts
        to_do.insert(1, _cut_off_text(step, dry_run=dry_run))
    print_changed(step, shown, [done] if done else (), first=to_do, restart=False)


def _cut_off_text(step: RotationStep, *, dry_run: bool) -> str:
    """Return which robots have not confirmed the stage before, and what that means for them."""
    from sros_tool.keystore.fleet import publish_command
    from sros_tool.keystore.fleet_status import robots_with_shared_keys, shared_keys_clause
    from sros_tool.keystore.reader import OpenedKeystore

    copied = robots_with_shared_keys(OpenedKeystore(step.root), step.cut_off)
    are = "would be" if dry_run else "are"
    cut_off = ""
    if behind := [robot for robot in step.cut_off if robot not in copied]:
        cut_off = (
            f"these robots have not confirmed the stage before: {', '.join(behind)}. They {are} "
            "cut off from robots that have the files of this stage, until they have these files, "
            "too"
        )
    if copied:
        clause = shared_keys_clause(copied)
        cut_off += (
            f"{f'. {capitalized(clause)}' if cut_off else clause}: if they lack the files of the "
            f"stage before, they {are} cut off from robots that have the files of this stage"
        )
    is_published = bool(publish_command(step.root))
    if is_published and step.stage == "retire" and step.replaces_identity:
        cut_off += (
            ". A web server that has only the new identity CA refuses robots with certificates of "
            "the old one: until these robots have their new files, give the server both CAs with "
            "their revocation lists (docs/fetching.md, The last stage of a rotation)"
        )
    if is_published and step.replaces_seals:
        cut_off += (
            ". A robot that fetches and does not trust the new permissions CA yet refuses all "
            "later releases: run "
            f"`sros distribute_key {quote(str(step.root))} --robot NAME FOLDER --force`, and bring "
            "FOLDER to the robot"
        )
    return cut_off


def _step_lines(
    step: RotationStep, status: RotationStatus, *, together: bool, same_key: bool
) -> tuple[str, list[str]]:
    """Return what a step of a rotation did, or "", and what to do next, in this order."""
    from sros_tool.keystore.expiry import ONE_BY_ONE
    from sros_tool.keystore.fleet import deliver_first_sentence

    if not step.changes:
        done = (
            "the last rotation is complete"
            if status.rotation.stage == "none"
            else f"the keystore is already at the stage {status.rotation.stage}"
        )
        return "", [f"nothing is left to do: {done}"]
    if same_key:
        done = "renewed the identity CA with the same key; certificates that it issued stay valid"
        return done, [
            f"All vendors: {ONE_BY_ONE} Certificates keep their expiry: `sros renew {step.root} "
            "--all-expiring 30d` renews certificates that expire soon."
        ]
    reissued = any(change.path.endswith("/cert.pem") for change in step.changes)
    done = f"{_STAGE_DONE_TEXTS['reissue']}, and " if together and reissued else ""
    to_do = []
    if step.stage == "retire":
        how = "Then restart all processes together." if together else f"All vendors: {ONE_BY_ONE}"
        to_do = [deliver_first_sentence(step.root), how]
    return f"{done}{_STAGE_DONE_TEXTS[step.stage]}: {', '.join(step.files)}", [
        *to_do,
        *status.remarks,
    ]


def _unconfirmed_robots(keystore: OpenedKeystore) -> tuple[str, ...] | str:
    """Return the robots that have not confirmed a stage of a rotation, or why these are unknown."""
    from sros_tool.keystore.lifecycle.rotate import robots_cut_off
    from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation

    rotation = read_rotation(keystore)
    if rotation.stage is RotationStage.NONE:
        return ()
    try:
        return robots_cut_off(keystore, rotation, rotation.next_stage(), now())
    except SrosError as error:
        return error.what


_MOST_ROBOTS = 20


def _show_status(
    keystore: OpenedKeystore,
    status: RotationStatus,
    unconfirmed: Sequence[str] | str,
    as_json: bool,
) -> None:
    from sros_tool.keystore.fleet_status import robots_with_shared_keys, shared_keys_clause
    from sros_tool.validity import iso

    rotation = status.rotation
    if as_json:
        from sros_tool.keystore.lifecycle.shown import shown_status

        print_json(shown_status(status, None if isinstance(unconfirmed, str) else unconfirmed))
        return
    echo(f"stage: {rotation.stage}, next: {rotation.next_stage()}")
    for authority in status.authorities:
        name = f"{authority.roles[0]} CA" if len(authority.roles) == 1 else "CA"
        end = f"until {iso(authority.validity.not_after)}"
        if authority.validity.not_after < now():
            end = f"EXPIRED {iso(authority.validity.not_after)}"
        echo(
            f"  {name:14} {authority.state:7} {authority.enclaves} of {status.enclaves} enclaves"
            f"  {end}  {authority.subject} (SHA-256 {authority.sha256[:8]})"
        )
    if isinstance(unconfirmed, str):
        echo(f"it is not known which robots confirmed this stage: {unconfirmed}")
    elif unconfirmed:
        echo(f"not confirmed by {first_few(unconfirmed, _MOST_ROBOTS)}: see `sros fleet status`")
        if clause := shared_keys_clause(robots_with_shared_keys(keystore, unconfirmed)):
            echo(clause)
    for remark in status.remarks:
        echo(remark)


def _new_keyring(identity: str | None, permissions: str | None, encrypt: bool) -> Keyring:
    """Return a keyring for new CA keys.

    Only options state the places of new keys; environment variables state the places of the current
    keys.
    """
    from dataclasses import replace

    named = {"identity": identity, "permissions": permissions}
    chosen_keyring = keyring(identity, permissions, encrypt=encrypt)
    return replace(
        chosen_keyring,
        places={role: place for role, place in chosen_keyring.places.items() if named[role]},
    )
