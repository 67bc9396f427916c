"""The verbs that bring enclaves to robots: export, verify, request, sign and import."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.changed import (
    print_changed,
    print_closed_and_adopted,
    print_follow_up,
    print_plan,
)
from sros_tool.cli.common import (
    PATH,
    allow_refusal_option,
    change_options,
    chosen_enclaves,
    complete_file,
    domain_of,
    dry_run_option,
    enclave_filter_options,
    fleet_option,
    json_option,
    key_option,
    keystore_argument,
    keystore_arguments,
    keystore_from_environment,
    moment_of,
    now,
    print_json,
    print_notes,
    progress,
    read_file_or_stdin,
    root_and_file,
    secrets,
    several_enclaves_options,
    split_root,
    verb,
)
from sros_tool.errors import UsageError
from sros_tool.terminal import Colored, echo, echo_bytes
from sros_tool.values import FileChange, file_change
from sros_tool.wording import first_few

if TYPE_CHECKING:
    from cryptography import x509

    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.errors import Note
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.keystore.delivery.robot import ImportedEnclave
    from sros_tool.keystore.delivery.signing import SignedRequests
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.policy.model import Policy

_STREAM = Path("-")
"""The file argument that means standard input or output."""
_MOST_NAMES = 5
"""Maximum number of enclaves without keys that an export names."""


@verb("distribute_key")
@keystore_arguments("[KEYSTORE] [ENCLAVE...] TARGET")
@several_enclaves_options
@click.option("--force", is_flag=True, help="Replace files in TARGET that differ.")
@click.option(
    "--keyless",
    is_flag=True,
    help="Also export the documents of enclaves whose keys were made on their robots, as --robot "
    "does. Keys in KEYSTORE are exported in any case.",
)
@dry_run_option
@json_option
def distribute_key(
    arguments: tuple[str, ...],
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    force: bool,
    keyless: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    r"""Export ENCLAVE... to TARGET: a folder, a .tar.gz, or - for standard output.

    TARGET becomes a keystore with only these enclaves: files instead of links, and no CA key.

    Example:
      $ sros distribute_key keystore /talker talker.tar.gz
      exported enclave /talker to 'talker.tar.gz'
      $ tar -xzf talker.tar.gz -C /etc/robot enclaves/talker    # on the robot
      $ sros distribute_key keystore --match '/arm/*' - | \
            ssh robot tar -xz -C robot
      exported enclave /arm/gripper to standard output
      exported enclave /arm/wrist to standard output
      left out enclave /arm/camera: its key was made on its robot
    """
    from sros_tool.keystore.delivery.archive import SUFFIXES
    from sros_tool.keystore.delivery.export import (
        distribute,
        included_keys_notes,
        pack_enclaves,
        select_enclaves_to_export,
    )
    from sros_tool.keystore.delivery.publish import older_keystore_notes
    from sros_tool.keystore.layout import enclave_folder, key_on_robot
    from sros_tool.keystore.outcomes import changes_below
    from sros_tool.keystore.reader import OpenedKeystore

    root, names_and_target = split_root(arguments)
    names = names_and_target[:-1]
    if not names_and_target or not (names or patterns or robots):
        raise UsageError("distribute_key takes a keystore, one or more enclaves and a target")
    target = PATH.convert(names_and_target[-1], None, None)
    keystore = OpenedKeystore(root)
    _check_target(keystore, names_and_target[-1])
    chosen = chosen_enclaves(keystore, names, patterns, robots)
    every = keyless or bool(robots)  # a robot with only a part of its new files could not run
    selection = select_enclaves_to_export(keystore, chosen, names, keyless=every)
    notes: tuple[Note, ...] = ()
    kept: list[str] = []
    if target == _STREAM:
        if not dry_run:
            _refuse_json(as_json)
            _refuse_terminal()
        with progress("exporting"):
            packed = pack_enclaves(keystore, selection.names, now=now(), keyless=every)
        changes = tuple(FileChange("send", path) for path in packed.paths)
        notes = packed.notes
        if not dry_run:
            echo_bytes(packed.data)
        elif not as_json:
            for path in packed.paths:
                echo(f"would send {path}")
        where, done = "standard output", not dry_run
    else:
        with progress("exporting"):
            export = distribute(
                keystore,
                selection.names,
                target,
                now=now(),
                force=force,
                keyless=every,
                dry_run=dry_run,
            )
        where, done = f"'{target}'", bool(export.changes) and not dry_run
        notes = export.notes
        below = target.parent if target.name.endswith(SUFFIXES) else target
        changes = changes_below(below, export.changes)
        if dry_run and not as_json:
            print_plan(below, export.changes)
        changed = {Path(change.path).parent for change in export.changes}
        kept = [
            name
            for name in selection.names
            if not changed or (below == target and Path(enclave_folder(name)) not in changed)
        ]
        for change in export.changes if done else ():
            if word := {"replace": "replaced", "remove": "removed"}.get(change.action):
                echo(f"{word} {change.path}", err=True)
        if done:
            print_closed_and_adopted(below, export.changes, keystore=root)
    notes = (*older_keystore_notes(keystore), *notes)
    if keyless:
        notes += tuple(included_keys_notes(keystore, selection.names))
    exported = [name for name in selection.names if name not in kept]
    for name in exported if done and not as_json else ():
        echo(f"exported enclave {name} to {where}", err=target == _STREAM)
    for name in kept if not dry_run else ():
        echo(f"enclave {name} in '{target}' is already up to date", err=True)
    if as_json:
        from sros_tool.keystore.delivery.export import ExportedEnclaves, exported_outcomes

        archive = target == _STREAM or target.name.endswith(SUFFIXES)
        folder, names = Path() if archive else target, selection.names
        outcomes = exported_outcomes(keystore, names, folder, kept=kept)
        left_out = selection.left_out
        print_json(ExportedEnclaves(root, dry_run, target, outcomes, left_out, changes, notes))
    else:
        print_notes(notes)
    if keyless_names := [n for n in exported if done and key_on_robot(keystore.folder(n))]:
        only = len(keyless_names) == len(exported) > _MOST_NAMES
        whose = f"all {len(exported)}" if only else first_few(keyless_names, _MOST_NAMES)
        text = "their keys, which were made on their robots and stay there"
        if len(keyless_names) == 1:
            text = "its key, which was made on its robot and stays there"
        echo(f"{whose}: without {text}", err=True)
    for name in selection.left_out:
        echo(f"left out enclave {name}: its key was made on its robot", err=True)


def _check_target(keystore: OpenedKeystore, word: str) -> None:
    """Raise `UsageError` if the last word is an enclave of the keystore: TARGET is missing."""
    from sros_tool.errors import InvalidNameError
    from sros_tool.names import check_enclave_name

    try:
        is_enclave = not Path(word).exists() and keystore.has_enclave(check_enclave_name(word))
    except InvalidNameError:
        return
    if is_enclave:
        raise UsageError(
            f"no target is named: '{word}' is an enclave",
            "",
            "Add a folder, a .tar.gz, or - for standard output.",
        )


def _refuse_json(as_json: bool) -> None:
    """Raise `UsageError` for --json if standard output gets an archive."""
    if as_json:
        raise UsageError(
            "--json and an archive cannot both go to standard output",
            "",
            "Name a file for the archive, or leave out --json.",
        )


def _refuse_terminal() -> None:
    """Raise `UsageError` if standard output is a terminal: an archive is binary data."""
    if sys.stdout is not None and sys.stdout.isatty():
        raise UsageError(
            "an archive would be written to this terminal",
            "The archive is binary, and may contain private keys.",
            "Use a pipe, such as `| ssh robot tar -xz -C /etc/robot`, or name a file.",
        )


@verb("verify")
@keystore_argument("folder", "[DIR]")
@click.option("--domain", metavar="ID", help="Also check that the enclaves may join this domain.")
@click.option(
    "--at", metavar="MOMENT", help="Check as of a date (2027-06-01) or a time from now (90d)."
)
@enclave_filter_options()
@click.option(
    "--tokens",
    is_flag=True,
    help="Also check that the PKCS#11 tokens have the enclaves' keys; needs the PINs.",
)
@json_option
def verify(
    folder: Path,
    domain: str | None,
    at: str | None,
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    tokens: bool,
    as_json: bool,
) -> int:
    """On a robot: report whether the enclaves in DIR, or the enclave DIR, can be used.

    sros checks that enclaves are complete, consistent, valid and loadable, that only the owner can
    read their keys, that no CA key was exported, and that all enclaves trust the same CAs. The exit
    status is 0 if there are no findings.

    Example:
      $ sros verify robot
      /arm/camera  loadable in domain 0 until 2027-05-20T07:45:12Z
      /arm/gripper  loadable in domain 0 until 2027-05-20T07:45:12Z
      /arm/wrist  NOT LOADABLE
      robot/enclaves/arm/wrist/key.pem: error: a private key that others can ...
          its mode is 0644
          Run `chmod 600 robot/enclaves/arm/wrist/key.pem`.
      ...
      $ sros verify robot --at 2027-06-01 || echo 'renew before June'
    """
    from sros_tool.checks.keystores.arrival import verify_arrival
    from sros_tool.cli.common import echo_folded, local_zone
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.selection import select_enclaves
    from sros_tool.validity import iso

    wanted, moment = domain_of(domain), moment_of(at)
    chosen = patterns or robots
    only = select_enclaves(OpenedKeystore(folder), (), patterns, robots=robots) if chosen else None
    zone = local_zone(os.environ)
    with progress("verifying"):
        arrival = verify_arrival(
            folder,
            now=moment,
            domain=wanted,
            zone=zone,
            only_enclaves=only,
            secrets=secrets() if tokens else None,
        )
    if as_json:
        print_json(arrival.verified_folder(moment, wanted))
        return 1 if arrival.findings else 0
    for enclave in arrival.enclaves:
        until = f" until {iso(enclave.valid_until)}" if enclave.valid_until else ""
        state = (
            f"loadable in domain {enclave.domains}{until}"
            if enclave.loadable
            else "its key is on its robot: verify the enclave there"
            if enclave.key_on_robot
            else Colored("NOT LOADABLE")
        )
        place = f", key on the token {enclave.token}" if enclave.token else ""
        echo(f"{enclave.name}  ", state, place)
    echo_folded((finding,) for finding in arrival.findings)
    return 1 if arrival.findings else 0


@verb("create_request")
@keystore_arguments("ENCLAVE... [DIR]", shell_complete=complete_file)
@click.option(
    "--again", is_flag=True, help="Write the signing requests again, for the existing keys."
)
@key_option
@dry_run_option
@json_option
def create_request(
    arguments: tuple[str, ...], again: bool, key: str, dry_run: bool, as_json: bool
) -> None:
    """On a robot: create the keys of ENCLAVE... in the folder DIR, and signing requests.

    If you name more than one enclave, also name DIR: the last of several arguments is DIR.

    The keys never leave DIR. With --key, the keys are made on the robot's PKCS#11 token, and never
    leave the token; DIR then holds only their URIs. The PIN comes from the URI's pin-source=, from
    $SROS_PKCS11_PIN or from a prompt.

    Send the requests to the keystore, where `sros sign_request` answers them; `sros import`
    installs an answer next to its key.

    Example:
      $ sros create_request /arm/camera robot
      made the key of enclave /arm/camera; the key stays in 'robot'
        its SHA-256 is 6f5bbd292e91c5d0fbf579aa0d036ac044cdd9788c6efdbc730a...
        bring 'robot/enclaves/arm/camera/request.pem' to the keystore: ...
      $ ssh robot cat robot/enclaves/arm/camera/request.pem |   # or in one step
            sros sign_request keystore - | ssh robot sros import - robot
    """
    from sros_tool.keystore.delivery.robot import create_requests, shown_requests

    *names, last = arguments
    _refuse_enclave_as_folder(names, last)
    folder = PATH.convert(last, None, None) if names else keystore_from_environment()
    made = create_requests(
        folder, names or [last], again=again, key=key, secrets=secrets(), dry_run=dry_run
    )
    if as_json:
        print_json(shown_requests(folder, made, again=again, dry_run=dry_run))
        return
    if dry_run:
        print_plan(folder, made.changes)
        return
    for request in made.requests:
        name, token = request.name, request.token
        if again:
            echo(f"made the request of enclave {name} again, for the existing key")
        elif token:
            echo(
                f"the key of enclave {name} is {token.object!r} on the token {token.token}, and "
                "stays there"
            )
        else:
            echo(f"made the key of enclave {name}; the key stays in '{folder}'")
        echo(f"  its SHA-256 is {request.key}")
        echo(f"  bring '{request.file}' to the keystore: sros sign_request KEYSTORE request.pem")
    print_notes(made.notes)


def _refuse_enclave_as_folder(names: list[str], folder: str) -> None:
    """Raise `UsageError` if ``folder`` is probably one more enclave, as ``names`` are."""
    top = folder.split("/")[1] if folder.startswith("/") else ""
    if top and not Path("/", top).exists() and any(n.split("/")[1:2] == [top] for n in names):
        raise UsageError(
            f"there is no folder '/{top}': '{folder}' is perhaps meant as an enclave",
            "The last of several arguments is the folder in which the keys are made.",
            "Name the folder last.",
        )


@verb("sign_request")
@keystore_arguments("[KEYSTORE] REQUEST", shell_complete=complete_file)
@click.option(
    "-p",
    "--policy-file",
    type=PATH,
    help="Policy with the enclave's rights. [default: the rights of the keystore's template]",
)
@fleet_option("The robots that the placeholders of the policy stand for, as in generate_artifacts.")
@click.option(
    "-o",
    "--output",
    type=PATH,
    metavar="ANSWER",
    help="Where to write the answer; - is standard output. [default: request.answer.tar.gz]",
)
@click.option(
    "--renew", is_flag=True, help="Renew an enclave that exists; it keeps its permissions."
)
@click.option("--force", is_flag=True, help="Replace ANSWER if it exists.")
@click.option(
    "--no-answer",
    is_flag=True,
    help="Do not write an answer file; deliver later with `distribute_key --keyless`.  "
    "REQUEST may then hold several requests: all are signed, or none; a request whose"
    " key already has a certificate changes nothing.",
)
@click.option(
    "--enclave",
    "only",
    multiple=True,
    metavar="ENCLAVE",
    help="Accept REQUEST only for this enclave; needed to certify a revoked enclave again, or"
    " an earlier key of an enclave. For several requests, give the option once for each request.",
)
@allow_refusal_option
@click.option(
    "--refuse-revoked",
    is_flag=True,
    help="Refuse a revoked enclave, or an earlier key, even if --enclave names the enclave.",
)
@dry_run_option
@json_option
def sign_request(
    arguments: tuple[str, ...],
    policy_file: Path | None,
    fleet_file: Path | None,
    output: Path | None,
    renew: bool,
    force: bool,
    no_answer: bool,
    only: tuple[str, ...],
    allow_refusal: tuple[Vendor, ...],
    refuse_revoked: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    r"""At the keystore: certify the key in REQUEST (or -), and sign the enclave's permissions.

    The answer is one .tar.gz for `sros import` on the robot.  The answer contains the
    certificate, permissions, governance, revocation lists and the certificates of the CAs, and no
    secret.  The
    keystore then contains the enclave, without its private key.  Compare the key's SHA-256 with the
    one that the robot printed.

    Example:
      $ sros sign_request keystore request.pem -p camera.xml
      signed the request of enclave /arm/camera for the key 6f5bbd292e91c5d0...
        the robot will trust CN=sros identity CA 4f122aed, SHA-256 5fe417aa...
        and CN=sros permissions CA 4f122aed, SHA-256 e15ab4af...
        send 'request.answer.tar.gz' to the robot: sros import ...
      $ sros sign_request keystore keystore/enclaves/arm/camera/request.pem \
            --renew -o camera.tgz
    """
    from sros_tool.keystore.delivery.signing import certify_requests
    from sros_tool.keystore.delivery.signing import sign_request as sign
    from sros_tool.runtime.variables import domain_from

    root, request = root_and_file(arguments, "sign_request takes a keystore and one request")
    work: Callable[..., SignedRequests] = certify_requests
    if no_answer:
        if output is not None or force:
            raise UsageError("--no-answer writes no file: leave out -o and --force")
    else:
        if output is None:
            streamed = request == _STREAM
            output = _STREAM if streamed else Path(request.name).with_suffix(".answer.tar.gz")
        stream = output == _STREAM
        if stream and not dry_run:
            _refuse_json(as_json)
            _refuse_terminal()
        work = partial(sign, answer=None if stream else output, force=force)
    existed = output is not None and output.exists()
    signed = work(
        root,
        read_file_or_stdin(request, "signing request"),
        policy=_policy(policy_file, fleet_file),
        only_enclaves=only,
        refuse_revoked=refuse_revoked,
        renew=renew,
        domain=domain_from(os.environ),
        **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
    )
    _show_signed(signed, output, existed=existed, as_json=as_json)


def _show_signed(
    signed: SignedRequests, answer: Path | None, *, existed: bool, as_json: bool
) -> None:
    """Print what was done with signed requests; ``answer`` is the file for the robot.

    ``existed`` says whether this file existed before.
    """
    from sros_tool.pki.certificates import digest

    stream = answer == _STREAM
    if as_json:
        from sros_tool.keystore.delivery.signing import shown_signed

        answer_change = file_change(answer, existed=existed) if answer and not stream else ()
        print_changed(signed, shown_signed(signed, answer, answer_change), restart=False)
        return
    if signed.dry_run:
        print_plan(signed.root, signed.changes)
        if answer and not stream:
            echo(f"would {'replace' if existed else 'create'} {answer}")
    elif stream:
        echo_bytes(signed.archive)
    for name, key in signed.keys.items() if not signed.dry_run else ():
        outcome = signed.outcomes[name]
        if outcome == "kept":
            echo(f"the key of enclave {name} has a certificate already", err=True)
            continue
        word = "renewed" if outcome == "renewed" else "signed the request of"
        echo(f"{word} enclave {name} for the key {key}", err=stream)
    if answer and not signed.dry_run:
        echo(f"  the robot will trust {_ca_text(signed.identity_ca)}", err=stream)
        if signed.permissions_ca != signed.identity_ca:
            echo(f"  and {_ca_text(signed.permissions_ca)}", err=stream)
        if not stream:
            echo(
                f"  send '{answer}' to the robot: sros import {answer.name} DIR --ca "
                f"{digest(signed.permissions_ca)}"
            )
    print_follow_up(signed, restart=False)


def _policy(file: Path | None, fleet_file: Path | None) -> Policy | FleetPolicy | None:
    """Return the policy in ``file``, or None without a file.

    With ``fleet_file``, the robots in this file fill in the placeholders of the policy.
    """
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.policy.document import read_policy

    if file is None:
        if fleet_file is not None:
            raise UsageError("--fleet is for the placeholders of a policy: add -p POLICY_FILE")
        return None
    if fleet_file is None:
        return read_policy(file)
    return FleetPolicy(read_policy(file, placeholders=True), read_fleet(fleet_file))


@verb("import")
@click.argument("answer", type=PATH)
@keystore_argument("folder", "[DIR]")
@click.option("--force", is_flag=True, help="Accept an older answer, or an answer from other CAs.")
@click.option(
    "--ca",
    "pin",
    metavar="FILE|SHA-256",
    help="Accept ANSWER only from this permissions CA, given by its certificate or by the SHA-256 "
    "that sign_request and create_keystore print.",
)
@allow_refusal_option
@dry_run_option
@json_option
def import_verb(
    answer: Path,
    folder: Path,
    force: bool,
    pin: str | None,
    allow_refusal: tuple[Vendor, ...],
    dry_run: bool,
    as_json: bool,
) -> None:
    """On a robot: install the answer of `sign_request` next to the key in DIR.

    ANSWER is the file with the answer, or - for standard input.  sros first checks the
    certificate's key and chain, the signatures and the validity, and that the archive has no
    unexpected files.  If a check fails, nothing changes.  The first answer sets the CAs that the
    robot trusts: give --ca, or an attacker could replace this answer on its way.  Later answers
    must come from the same CAs.

    Example:
      $ sros import request.answer.tar.gz robot
      imported enclave /arm/camera, which can run until 2027-05-20T07:45:12Z
        it trusts CN=sros identity CA 4f122aed, SHA-256 5fe417aa...
        and CN=sros permissions CA 4f122aed, SHA-256 e15ab4af...
        compare each SHA-256 with the output of sign_request, or use --ca: ...
      $ sros import request.answer.tar.gz robot --ca e15ab4af9ee8c94bd8a5e4c6c1...
      $ sros run robot /arm/camera -- ros2 run camera driver
    """
    from sros_tool.keystore.delivery.robot import import_answer, read_pinned_cas, shown_import

    pinned = read_pinned_cas(pin) if pin is not None else frozenset[str]()
    data = read_file_or_stdin(answer, "answer")
    done = import_answer(
        folder,
        data,
        now=now(),
        pinned=pinned,
        force=force,
        allow_refusal=allow_refusal,
        dry_run=dry_run,
    )
    shown = None
    if as_json:
        shown = shown_import(done, pinned=bool(pinned))
    up_to_date = f"enclave {done.name} in '{folder}' is already up to date"
    if as_json or dry_run or not done.changes:
        first = () if as_json or dry_run else (up_to_date,)
        print_changed(done, shown, first=first, restart=False)
        return
    print_changed(done, None, _imported_lines(done, pinned=bool(pinned)), exported=False)


def _imported_lines(imported_enclave: ImportedEnclave, *, pinned: bool) -> Iterator[str]:
    from sros_tool.validity import iso

    until = iso(imported_enclave.until)
    yield f"imported enclave {imported_enclave.name}, which can run until {until}"
    yield f"  it trusts {_ca_text(imported_enclave.identity_ca)}"
    if imported_enclave.permissions_ca != imported_enclave.identity_ca:
        yield f"  and {_ca_text(imported_enclave.permissions_ca)}"
    if imported_enclave.first and not pinned:
        yield (
            "  compare each SHA-256 with the output of sign_request, or use --ca: without --ca, "
            "import does not verify the CAs"
        )


def _ca_text(certificate: x509.Certificate) -> str:
    from sros_tool.pki.certificates import digest, subject_text

    return f"{subject_text(certificate.subject)}, SHA-256 {digest(certificate)}"
