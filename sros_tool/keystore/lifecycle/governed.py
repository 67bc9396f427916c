"""Changes of a governance: writing it, policies that demand them, and notes on what to restart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote

from sros_tool.dds.governance import Governance, parse_governance, render_governance
from sros_tool.errors import KeystoreError, Note, check_meaning
from sros_tool.keystore.comparison import Mismatch, compare_governance, mismatch
from sros_tool.keystore.fleet import publish_command
from sros_tool.keystore.issuing.authority import write_copies
from sros_tool.keystore.layout import (
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    GOVERNANCE_XML,
    SETTINGS,
    enclave_path,
    key_on_robot,
)
from sros_tool.keystore.ledger import document_entry
from sros_tool.keystore.lifecycle.change import KeystoreChange
from sros_tool.keystore.protection import less_protected, with_stated
from sros_tool.keystore.settings import edit_remedy, found_edits, write_settings
from sros_tool.keystore.template import Template
from sros_tool.policy.model import Level, StatedProtection
from sros_tool.translate import governance_for
from sros_tool.wording import first_few

_SHOWN = 5


def write_governance(
    change: KeystoreChange, governance: Governance, *, names: Sequence[str]
) -> None:
    """Sign, stage and record the governance of a keystore that is made from settings.

    Enclaves in ``names`` that have a copy of the document instead of a link get the new one, too.
    """
    document, what = render_governance(governance), "the governance document"
    check_meaning(parse_governance(document), governance, what)
    message = change.permissions.sign(document, what)
    change.transaction.write(GOVERNANCE_XML, document)
    change.transaction.write(GOVERNANCE_P7S, message)
    # The governance of the keystore itself is in the folder of the enclave /.
    below = [name for name in names if name != "/"]
    write_copies(change.transaction, below, GOVERNANCE_FILE, message)
    change.entries.append(document_entry(change.now, "governance", message))


def raise_protection(change: KeystoreChange, stated: Sequence[StatedProtection]) -> None:
    """Stage a governance and settings with more protection, if policies demand more.

    ``stated`` are the statements of policies about the protection of names.

    Raises:
        PolicyError: the statements contradict each other, or the settings.
        KeystoreError: the keystore has no settings that can state it, or its files were edited by
            hand.
    """
    root, template, governance = change.root, change.template, change.governance
    protection = with_stated(template.protection, stated)
    less = [demanded for demanded, _ in less_protected(governance, stated)]
    if not less:
        return
    demand = f"{less[0].source} demands that {less[0]} has protect={less[0].word!r}"
    if not (root / SETTINGS).exists():
        raise KeystoreError(
            f"{demand}, and keystore '{root}' has no settings for that",
            f"A keystore of ros2/sros2 has no {SETTINGS}.",
            f"Give it settings first: `sros update_keystore {quote(str(root))} --template "
            "NAME|FILE --dry-run` shows what they would change.",
        )
    if edits := found_edits(change.keystore, governance):
        raise KeystoreError(
            f"{demand}, and files of keystore '{root}' were edited by hand: "
            f"{'; '.join(edits.clauses())}",
            "It is unclear which governance to start from.",
            f"First apply or undo the edit: {edit_remedy(root)}",
        )
    change.template = replace(template, protection=protection)
    after = governance_for(protection, governance.domains().closed())
    write_governance(change, after, names=change.names)
    change.entries.append(write_settings(change.transaction, change.template, change.now))
    demanded = [f"{name} {name.word} ({name.source})" for name in less]
    changes = compare_governance(governance, after)
    text = (
        f"The governance of the keystore changes, because policies demand it: "
        f"{first_few(demanded, _SHOWN)}. "
        f"{'; '.join(dict.fromkeys(change.meaning for change in changes[:_SHOWN]))}."
    )
    change.restart = change.names
    change.remarks += (
        Note("keystore.governance-by-policy", text),
        restart_note(mismatch(governance, after)),
        exports_note(root, change.names),
        Note(
            "keystore.earlier-governance",
            "The signature of the former governance stays valid: anyone who can change the files "
            "of a robot can put it back there, until the CA that signed it is replaced (`sros "
            "rotate_ca --help`).",
        ),
        *_zenoh_notes(template),
    )


def refuse_less_protected(
    root: Path, governance: Governance, stated: Sequence[StatedProtection]
) -> None:
    """Raise `KeystoreError` if a policy demands more protection than the governance gives.

    Used when requests are signed, because all robots would need a changed governance.
    """
    for name, level in less_protected(governance, stated):
        kinds = "data=ENCRYPT" if name.level is Level.ENCRYPT else "metadata=SIGN"
        raise KeystoreError(
            f"{name.source} demands that {name} has protect={name.word!r}, and keystore '{root}' "
            f"protects it with {level}",
            "Its governance has to change first, and with it the files of all enclaves.",
            f"Run `sros update_keystore {quote(str(root))} --rule "
            f"{quote(f'{name} {kinds}')} --dry-run`, and then without --dry-run.",
        )


def _zenoh_notes(template: Template) -> tuple[Note, ...]:
    """Return a note on protection by Zenoh, if the keystore has a Zenoh network."""
    if template.zenoh is None:
        return ()
    text = (
        "Zenoh has no protection of single names: its links are TLS, so all names are encrypted "
        "on each link, and each router reads what it passes on."
    )
    return (Note("keystore.protection-on-zenoh", text),)


def restart_note(disturbed: Mismatch, *, revoked: bool = False) -> Note:
    """Return a note on the processes to restart and their order; vendors agree (measured)."""
    return Note("keystore.restart", _restart_text(disturbed, revoked=revoked))


def _restart_text(disturbed: Mismatch, *, revoked: bool) -> str:
    if revoked and not disturbed.everything:
        return (
            "All vendors: restart all processes together; restarted processes refuse the revoked "
            "certificates of other processes. Until then, running processes communicate as before."
        )
    if disturbed:
        which, what = "all processes", "do not communicate"
        if not disturbed.everything:
            which = "the processes that use these names"
            what += f" on {', '.join(disturbed.names)}, but do on everything else"
        return (
            f"Cyclone DDS and Fast DDS: restart {which} together; processes before and after the "
            f"restart {what}. Until then, running processes communicate as before."
        )
    return (
        "All vendors: restart the processes one by one, at any time; processes before and after "
        "the restart communicate. Until its restart, a process keeps its former files."
    )


def exports_note(root: Path, names: Sequence[str]) -> Note:
    """Return a note that robots need new files, with the commands that deliver them."""
    if published := publish_command(root):
        text = (
            f"Robots have the former files: publish the new ones ({published}); if nodes run from "
            "an export, export them again."
        )
        return Note("keystore.export-again", text)
    shown = quote(str(root))
    text = "Robots have the former files: export the new ones (`sros distribute_key "
    text += f"{shown} ENCLAVE TARGET --force`)"
    remote = [name for name in names if key_on_robot(enclave_path(root, name))]
    if remote:
        text += f"; for {', '.join(remote)}, answer the request again (`sros sign_request "
        text += f"{shown} REQUEST --renew`)"
    return Note("keystore.export-again", f"{text}.")
