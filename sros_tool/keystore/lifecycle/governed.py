"""A governance that changes: what to restart and to export again, and policies that change it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from shlex import quote

from sros_tool.dds.governance import Governance
from sros_tool.errors import KeystoreError, Note
from sros_tool.keystore.authorities.authority import Authority
from sros_tool.keystore.comparison import Mismatch, compare_governance, mismatch
from sros_tool.keystore.issuing.governance import write_governance
from sros_tool.keystore.layout import SETTINGS, enclave_path, key_on_robot
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.protection import less_protected, with_stated
from sros_tool.keystore.settings import edit_remedy, found_edits, write_settings
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.policy.model import StatedProtection
from sros_tool.policy.protection import Level
from sros_tool.translate import governance_for

_SHOWN = 5


@dataclass(frozen=True, slots=True)
class Governed:
    """The settings of a keystore with what policies demand, and what follows from the change.

    ``restart`` are the enclaves whose processes have to be restarted, with new files.
    """

    template: Template
    entries: tuple[Entry, ...] = ()
    restart: tuple[str, ...] = ()
    remarks: tuple[Note, ...] = ()


def protected_as_stated(
    transaction: Transaction,
    template: Template,
    governance: Governance,
    stated: Sequence[StatedProtection],
    permissions: Authority,
    names: Sequence[str],
    now: datetime,
) -> Governed:
    """Stage the governance and the settings of an existing keystore if policies demand more.

    Args:
        transaction: the transaction of the keystore.
        template: its settings.
        governance: its signed governance.
        stated: what policies say about the protection of names.
        permissions: the permissions CA.
        names: its enclaves.
        now: the time of the change.

    Raises:
        PolicyError: the statements contradict each other, or the settings.
        KeystoreError: the files of the settings cannot state it, or were edited by hand.
    """
    protection = with_stated(template.protection, stated)
    less = [each for each, _ in less_protected(governance, stated)]
    if not less:
        return Governed(template)
    root = transaction.root
    demand = f"{less[0].source} demands that {less[0]} has protect={less[0].word!r}"
    if not (root / SETTINGS).exists():
        raise KeystoreError(
            f"{demand}, and keystore '{root}' has no settings that can say it",
            f"A keystore of ros2/sros2 has no {SETTINGS}.",
            f"Give it settings first: `sros update_keystore {quote(str(root))} --template "
            "NAME|FILE --dry-run` shows what they would change.",
        )
    if edits := found_edits(root, governance):
        raise KeystoreError(
            f"{demand}, and files of keystore '{root}' were edited by hand: "
            f"{'; '.join(edits.clauses())}",
            "It is unclear which governance to start from.",
            f"First carry it out or undo it: {edit_remedy(root)}",
        )
    raised = replace(template, protection=protection)
    after = governance_for(raised.protection, governance.domains().closed())
    entries = (
        write_governance(transaction, after, permissions, names, now),
        write_settings(transaction, raised, now),
    )
    more = f" and {len(less) - _SHOWN} more" if len(less) > _SHOWN else ""
    changes = compare_governance(governance, after)
    text = (
        f"The governance of the keystore changes, because policies demand it: "
        f"{', '.join(f'{each} {each.word} ({each.source})' for each in less[:_SHOWN])}{more}. "
        f"{'; '.join(dict.fromkeys(each.meaning for each in changes[:_SHOWN]))}."
    )
    remarks = (
        Note("keystore.governance-by-policy", text),
        restart_note(mismatch(governance, after)),
        exports_note(root, names),
        Note(
            "keystore.earlier-governance",
            "The governance of before is still validly signed: whoever changes the files of a "
            "robot can put it back there, until the CA that signed it is replaced (`sros "
            "rotate_ca --help`).",
        ),
        *_zenoh_notes(template),
    )
    return Governed(raised, entries, tuple(names), remarks)


def refuse_less_protected(
    root: Path, governance: Governance, stated: Sequence[StatedProtection]
) -> None:
    """Raise `KeystoreError` if a policy demands more than the governance of a keystore gives.

    For what signs a request, which changes no governance: all robots would have to get it.
    """
    for each, level in less_protected(governance, stated):
        kinds = "data=ENCRYPT" if each.level is Level.ENCRYPT else "metadata=SIGN"
        raise KeystoreError(
            f"{each.source} demands that {each} has protect={each.word!r}, and keystore '{root}' "
            f"protects it with {level}",
            "Its governance has to change first, and with it the files of all enclaves.",
            f"Run `sros update_keystore {quote(str(root))} --rule "
            f"{quote(f'{each} {kinds}')} --dry-run`, and then without --dry-run.",
        )


def _zenoh_notes(template: Template) -> tuple[Note, ...]:
    """Return a note on what protection means on Zenoh, if the keystore has files for it."""
    if template.zenoh is None:
        return ()
    text = (
        "Zenoh has no protection of single names: its links are TLS, so all names are encrypted "
        "on each link, and each router reads what it passes on."
    )
    return (Note("keystore.protection-on-zenoh", text),)


def restart_note(disturbed: Mismatch, *, revoked: bool = False) -> Note:
    """Return which processes to restart in which order; the vendors agree (measured)."""
    return Note("keystore.restart", _restart_text(disturbed, revoked=revoked))


def _restart_text(disturbed: Mismatch, *, revoked: bool) -> str:
    if revoked and not disturbed.everything:
        return (
            "All vendors: restart all processes together; processes after the restart refuse the "
            "revoked certificates of processes before it. Until then, running processes "
            "communicate as before."
        )
    if disturbed:
        which, what = "all processes", "do not communicate"
        if not disturbed.everything:
            which = "the processes that use these names"
            what += f" on {', '.join(disturbed.names)}, and do on everything else"
        return (
            f"Cyclone DDS and Fast DDS: restart {which} together; processes before and after the "
            f"restart {what}. Until then, running processes communicate as before."
        )
    return (
        "All vendors: restart the processes one by one, at any time; processes before and after "
        "the restart communicate. Until its restart, a process has what it had before."
    )


def exports_note(root: Path, names: Sequence[str]) -> Note:
    """Return that robots need new files, and how they get them."""
    shown = quote(str(root))
    text = "Robots have the files of before: export them again (`sros distribute_key "
    text += f"{shown} NAME TARGET --force`)"
    remote = [each for each in names if key_on_robot(enclave_path(root, each))]
    if remote:
        text += f"; for {', '.join(remote)}, answer the request again (`sros sign_request "
        text += f"{shown} REQUEST --renew`)"
    return Note("keystore.export-again", f"{text}.")
