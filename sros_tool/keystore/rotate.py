"""Replaces the CAs of a keystore, in stages between which its robots are restarted.

distribute: a new CA is trusted beside the old one.  reissue: everything is issued and signed anew
by the new one.  retire: the old one is trusted no longer.  Each is one transaction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.bundle import authority_files, certificates_of, write_bundle
from sros_tool.keystore.create import list_enclaves
from sros_tool.keystore.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.layout import IDENTITY
from sros_tool.keystore.ledger import append, certificate_entry
from sros_tool.keystore.open import load_settings
from sros_tool.keystore.reissue import Progress
from sros_tool.keystore.rotation import RETIRED, Rotation, Stage, read_rotation
from sros_tool.keystore.succession import Rotator
from sros_tool.keystore.successor import check_later
from sros_tool.keystore.transaction import Change, Transaction, tidy
from sros_tool.notes import Note
from sros_tool.pki.certificates import issue_ca, pem, same_key
from sros_tool.validity import Span, window


@dataclass(frozen=True, slots=True)
class RotationStep:
    """What was done, or with ``dry_run`` would be.

    ``stage`` is the one that is reached, ``files`` are the stems of the CA files that it is about,
    ``kept_elsewhere`` the places of old keys outside of the keystore, which are left there.
    """

    root: Path
    stage: Stage
    files: tuple[str, ...]
    enclaves: tuple[str, ...]
    changes: tuple[Change, ...]
    kept_elsewhere: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()


def rotate_ca(
    root: Path,
    to: Stage | None = None,
    *,
    roles: Sequence[str] = (),
    now: datetime,
    finish: bool = False,
    keyring: Keyring = IN_KEYSTORE,
    new_keys: Keyring = IN_KEYSTORE,
    validity: Span | None = None,
    delete_old_key: bool = False,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> RotationStep:
    """Go to the stage ``to`` (default: the next one), or through all that remain with ``finish``.

    A stage that was reached already is left as it is, so that ``to`` can be repeated.  ``roles``
    ("identity", "permissions"; default both) count where a rotation begins.  ``keyring`` reaches
    the present keys; ``new_keys`` says where new ones are made, where not in the keystore.
    """
    if not dry_run:
        tidy(root)
    list_enclaves(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        names = list_enclaves(root)
        rotation = read_rotation(root)
        stage = Stage.RETIRE if finish else _wanted(root, rotation, to)
        work = Rotator(transaction, rotation, keyring, new_keys, now, delete_old_key=delete_old_key)
        if finish or stage not in (rotation.stage, Stage.NONE):
            stage = work.go(stage, names, roles, validity, progress)
            transaction.commit()
    return RotationStep(
        root,
        stage,
        tuple(each.file for each in work.replacements),
        names,
        tuple(transaction.changes),
        tuple(work.kept_elsewhere),
        work.notes,
    )


def _wanted(root: Path, rotation: Rotation, to: Stage | None) -> Stage:
    """The stage to go to; NONE where there is nothing to do.

    Raises `UsageError` where it is over, or where another one comes before it.
    """
    if to is None:
        return rotation.following()
    if to is Stage.RETIRE and rotation.stage is Stage.NONE:
        return Stage.NONE  # it is done
    order = list(Stage)
    ahead = order.index(to) - order.index(rotation.stage)
    if ahead > 1:
        raise UsageError(
            f"the stage {to} cannot be reached yet",
            f"Before it come {rotation.following()}, and restarting the processes.",
            f"Run `sros rotate_ca {root} --next`, or `--finish` to do all stages at once.",
        )
    if ahead < 0:
        raise UsageError(
            f"the stage {to} is over",
            f"The keystore is at {rotation.stage}; a rotation does not go back.",
            f"Run `sros rotate_ca {root} --next`.",
        )
    return to


def renew_identity_ca(
    root: Path,
    *,
    now: datetime,
    keyring: Keyring = IN_KEYSTORE,
    validity: Span | None = None,
    dry_run: bool = False,
) -> RotationStep:
    """Give the identity CA a new certificate of the same name and key, which ends later.

    All certificates that it has issued fit both, on Cyclone DDS 0.10.2 and Fast DDS 2.9.1 (ran), so
    nothing else changes.  A permissions CA cannot be renewed so: what it has signed names the very
    certificate.
    """
    if not dry_run:
        tidy(root)
    list_enclaves(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        names = list_enclaves(root)
        if len(authority_files(root)) == 1:
            raise KeystoreError(
                "the one CA of this keystore cannot keep its key",
                "It signs permissions, too, and DDS takes these from the very certificate only.",
                "Rotate it without --same-key.",
            )
        if read_rotation(root).stage is not Stage.NONE:
            raise KeystoreError("a rotation is under way", "", "Bring it to its end first.")
        template = load_settings(root)
        key = keyring.open(root, IDENTITY, template)
        old, *above = certificates_of(root, "identity_ca")
        if above or not same_key(old, key):
            raise KeystoreError(
                "the identity CA cannot be renewed with its key",
                "It is not self-signed, or the key is not its own.",
            )
        new = issue_ca(key, old.subject, window(now, validity or template.authority_validity))
        check_later(old, new)
        write_bundle(transaction, "identity_ca", (IDENTITY,), pem(new), names)
        transaction.write(f"{RETIRED}/{old.serial_number:x}.cert.pem", pem(old))
        append(transaction, [certificate_entry(now, "ca", new)])
        transaction.commit()
    return RotationStep(root, Stage.NONE, ("identity_ca",), names, tuple(transaction.changes))
