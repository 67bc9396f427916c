"""The verbs for keys that are born on the robot: the request, its answer, putting that in place."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    dry_run_option,
    keystore_from_environment,
    now,
    print_notes,
    print_plan,
    split_root,
)
from sros_tool.cli.deploy import STREAM, refuse_terminal, write_stdout
from sros_tool.cli.secrets import keyring
from sros_tool.errors import DocumentError, UsageError

if TYPE_CHECKING:
    from cryptography import x509


@click.command(
    "create_request",
    epilog="""\b
Example:
  $ sros create_request /arm/camera robot
  made the key of enclave /arm/camera, which stays in 'robot'
    its SHA-256 is 6f5bbd292e91c5d0fbf579aa0d036ac044cdd9788c6efdbc730a4b3a2a2809da
    have 'robot/enclaves/arm/camera/request.pem' signed: sros sign_request
  $ ssh robot cat robot/enclaves/arm/camera/request.pem |          # all the rest, from home
      sros sign_request keystore - | ssh robot sros import - robot""",
)
@click.argument("name")
@click.argument("folder", metavar="[DIR]", type=PATH, required=False)
@click.option("--again", is_flag=True, help="Make the request anew, for the key that is there.")
@dry_run_option
def create_request(name: str, folder: Path | None, again: bool, dry_run: bool) -> None:
    """On a robot: make the key of the enclave NAME in the folder DIR, and a signing request.

    The key never leaves DIR.  Send the request home, where `sros sign_request` answers it; `sros
    import` puts the answer beside the key.
    """
    from sros_tool.keystore.request import create_request as create

    folder = folder or keystore_from_environment()
    made = create(folder, name, again=again, dry_run=dry_run)
    if dry_run:
        print_plan(folder, made.changes)
        return
    if again:
        click.echo(f"made the request of enclave {name} anew, for the key that is there")
    else:
        click.echo(f"made the key of enclave {name}, which stays in '{folder}'")
    click.echo(f"  its SHA-256 is {made.key}")
    click.echo(f"  have '{made.file}' signed: sros sign_request")


@click.command(
    "sign_request",
    epilog="""\b
Example:
  $ sros sign_request keystore request.pem -p camera.xml
  signed the request of enclave /arm/camera for the key 6f5bbd292e91c5d0fbf579aa0d036ac044cdd978...
    the robot will trust CN=sros identity CA 4f122aed, SHA-256 5fe417aaed47cccd3f4a6b3e8e94db18...
    and CN=sros permissions CA 4f122aed, SHA-256 e15ab4af9ee8c94bd8a5e4c6c10bb86fb7ac17e2cdd91a...
    send 'request.answer.tar.gz' to the robot: sros import request.answer.tar.gz DIR --ca e15ab4...
  $ sros sign_request keystore keystore/enclaves/arm/camera/request.pem --renew -o camera.tgz""",
)
@click.argument("words", metavar="[ROOT] REQUEST", nargs=-1, required=True)
@click.option(
    "-p",
    "--policy-file",
    type=PATH,
    help="The policy that states the rights. [default: by the template of the keystore]",
)
@click.option(
    "-o",
    "--output",
    type=PATH,
    metavar="ANSWER",
    help="Where to write the answer; - is standard output. [default: request.answer.tar.gz]",
)
@click.option(
    "--renew", is_flag=True, help="Answer for an enclave that exists; it keeps its rights."
)
@click.option("--force", is_flag=True, help="Replace ANSWER if it exists.")
@dry_run_option
def sign_request(
    words: tuple[str, ...],
    policy_file: Path | None,
    output: Path | None,
    renew: bool,
    force: bool,
    dry_run: bool,
) -> None:
    """At home: certify the key of the file REQUEST (or -), and sign the enclave's permissions.

    The answer is one .tar.gz for `sros import` on the robot.  It holds no secret: certificate,
    permissions, governance, the certificates of the CAs, and what was revoked.  The keystore knows
    the enclave from then on, without its key.  Compare the key's SHA-256 with what the robot says.
    """
    from sros_tool.keystore.authority import load_ca_certificate
    from sros_tool.keystore.layout import PERMISSIONS
    from sros_tool.keystore.signing import sign_request as sign
    from sros_tool.pki.certificates import digest
    from sros_tool.policy import read_policy
    from sros_tool.runtime.environment import domain_from

    root, rest = split_root(words) if len(words) > 1 else (keystore_from_environment(), words)
    if len(rest) != 1:
        raise UsageError("sign_request takes a keystore and one request")
    request = PATH.convert(rest[0], None, None)
    if output is None:
        output = STREAM if request == STREAM else Path(request.name).with_suffix(".answer.tar.gz")
    stream = output == STREAM
    if stream and not dry_run:
        refuse_terminal()
    signed = sign(
        root,
        _read(request, "signing request"),
        now=now(),
        policy=read_policy(policy_file) if policy_file else None,
        renew=renew,
        answer=None if stream else output,
        force=force,
        domain=domain_from(os.environ),
        keyring=keyring(),
        dry_run=dry_run,
    )
    if dry_run:
        print_plan(root, signed.changes)
        if not stream:
            click.echo(f"would {'replace' if output.exists() else 'create'} {output}")
    else:
        if stream:
            write_stdout(signed.archive)
        word = "renewed" if renew else "signed the request of"
        click.echo(f"{word} enclave {signed.name} for the key {signed.key}", err=stream)
        permissions_ca = load_ca_certificate(root, PERMISSIONS)
        click.echo(f"  the robot will trust {_named(signed.identity_ca)}", err=stream)
        if permissions_ca != signed.identity_ca:
            click.echo(f"  and {_named(permissions_ca)}", err=stream)
        if not stream:
            click.echo(
                f"  send '{output}' to the robot: sros import {output.name} DIR --ca "
                f"{digest(permissions_ca)}"
            )
    print_notes(signed.notes)


@click.command(
    "import",
    epilog="""\b
Example:
  $ sros import request.answer.tar.gz robot
  imported enclave /arm/camera, which can run until 2027-05-20T07:45:12Z
    it trusts CN=sros identity CA 4f122aed, SHA-256 5fe417aaed47cccd3f4a6b3e8e94db185bfc8e10...
    and CN=sros permissions CA 4f122aed, SHA-256 e15ab4af9ee8c94bd8a5e4c6c10bb86fb7ac17e2cdd9...
    compare both with what sign_request said, or say --ca: nothing else vouches for them
  $ sros import request.answer.tar.gz robot --ca e15ab4af9ee8c94bd8a5e4c6c10bb86fb7ac17e2cdd91...
  $ sros run robot /arm/camera -- ros2 run camera driver""",
)
@click.argument("answer", type=PATH)
@click.argument("folder", metavar="[DIR]", type=PATH, required=False)
@click.option("--force", is_flag=True, help="Go back to an older answer, or move to other CAs.")
@click.option(
    "--ca",
    "pin",
    metavar="FILE|SHA-256",
    help="Accept it only if this permissions CA has signed it: its certificate, or the SHA-256 "
    "that sign_request and create_keystore say.",
)
@dry_run_option
def import_verb(
    answer: Path, folder: Path | None, force: bool, pin: str | None, dry_run: bool
) -> None:
    """On a robot: put the file ANSWER (or -) beside the key that waits in DIR, or change nothing.

    All of it is checked first: that the certificate is for this key, the chain, the signatures,
    the dates, and that the archive holds nothing else.  The first answer tells the robot whom to
    trust; whoever carries it could send one of his own, unless --ca says whose it has to be.  Later
    ones have to come from the same CAs.
    """
    from sros_tool.keystore.answer import import_answer
    from sros_tool.keystore.trust import read_pin

    folder = folder or keystore_from_environment()
    pinned = read_pin(pin) if pin is not None else frozenset[str]()
    data = _read(answer, "answer")
    done = import_answer(folder, data, now=now(), pinned=pinned, force=force, dry_run=dry_run)
    if dry_run:
        print_plan(folder, done.changes)
        return
    if not done.changes:
        click.echo(f"'{folder}' already holds enclave {done.name} as it is", err=True)
        return
    from sros_tool.validity import iso

    click.echo(f"imported enclave {done.name}, which can run until {iso(done.until)}")
    click.echo(f"  it trusts {_named(done.identity_ca)}")
    if done.permissions_ca != done.identity_ca:
        click.echo(f"  and {_named(done.permissions_ca)}")
    if done.first and not pinned:
        click.echo(
            "  compare both with what sign_request said, or say --ca: nothing else vouches for them"
        )


def _read(path: Path, what: str) -> bytes:
    """The bytes of a file, or of standard input; more than any answer has is refused."""
    from sros_tool.keystore.archive import MAX_PACKED
    from sros_tool.xml import read_bytes

    if path != STREAM:
        return read_bytes(path, what)
    data = sys.stdin.buffer.read(MAX_PACKED + 1) if sys.stdin else b""
    if not data:
        raise DocumentError(
            f"the {what} is empty", "Nothing came from standard input.", "See what sends it."
        )
    return data


def _named(certificate: x509.Certificate) -> str:
    from sros_tool.pki.certificates import digest, subject_text

    return f"{subject_text(certificate.subject)}, SHA-256 {digest(certificate)}"
