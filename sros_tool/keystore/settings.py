"""The settings of a keystore: writing ``sros.toml``, reading it, and finding manual edits.

The ledger has the text of the settings that sros wrote last.  So an edit is noticed, and can be
applied (`sros_tool.keystore.lifecycle.update`) or undone.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.errors import DocumentError, KeystoreError, Note, SrosError
from sros_tool.keystore.layout import GOVERNANCE_P7S, GOVERNANCE_XML, SETTINGS
from sros_tool.keystore.ledger import Entry, Ledger
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import Template, parse_template, render_template, settings_values
from sros_tool.translate import governance_for, protection_for
from sros_tool.validity import duration_text, iso
from sros_tool.wording import first_few

if TYPE_CHECKING:
    from sros_tool.keystore.transaction import Transaction

_SETTINGS_COMMENT = """\
# The settings of this keystore; sros uses them for each enclave that is added.
# To change them, run `sros update_keystore`: it also signs the affected files again.
"""


def write_settings(transaction: Transaction, template: Template, now: datetime) -> Entry:
    """Stage ``template`` as the settings of the keystore, and return the entry for the ledger."""
    text = render_template(template)
    document = (_SETTINGS_COMMENT + text).encode()
    transaction.write(SETTINGS, document)
    digest = hashlib.sha256(document).hexdigest()
    return Entry(iso(now), "settings", sha256=digest, settings=text)


def _recorded_settings(ledger: Ledger) -> Template | None:
    """Return the settings that sros wrote last; None if the ledger has none.

    Only lines after the last gap count, because others may be forged, or older than the settings.
    """
    for entry in reversed(ledger.certain):
        if entry.what == "settings":
            with suppress(tomllib.TOMLDecodeError, ValueError):
                return parse_template(entry.settings, "")
    return None


class HandEdits(NamedTuple):
    """Manual edits of settings and governance files that sros has not applied yet.

    ``settings`` are clauses on keys of ``sros.toml``; ``governance`` is a clause on
    ``governance.xml``, or "".  ``unsigned`` are clauses on protection that ``sros.toml`` states but
    the signed governance lacks.
    """

    settings: tuple[str, ...] = ()
    governance: str = ""
    unsigned: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.settings or self.governance or self.unsigned)

    def clauses(self) -> tuple[str, ...]:
        """Return all clauses, without duplicates."""
        clauses = (*self.settings, *self.unsigned, self.governance)
        return tuple(dict.fromkeys(clause for clause in clauses if clause))


class PresentSettings(NamedTuple):
    """The settings in force in a keystore, and manual edits.

    ``settings`` are the settings that sros wrote last, with the protection of the signed
    ``governance``.  ``written`` are the settings that are now in ``sros.toml``; None if the file is
    missing or cannot be read.  ``recorded`` are the settings in the ledger.  ``without_settings``
    says that the keystore has no settings, as made by ros2/sros2.
    """

    settings: Template
    written: Template | None
    governance: Governance
    edits: HandEdits
    without_settings: bool = False
    recorded: Template | None = None

    @property
    def domains(self) -> DomainSet:
        """The domains of the signed governance."""
        return self.governance.domains().closed()

    def settings_without_edits(self) -> Template:
        """Return the settings without edits, from the ledger, or else from `settings_to_change`.

        Raises:
            KeystoreError: as `settings_to_change`.
        """
        return self.recorded or self.settings_to_change()

    def settings_to_change(self) -> Template:
        """Return the settings to which a single change is applied.

        Raises:
            KeystoreError: settings cannot express the governance, so a change would replace the
                governance.
        """
        if self.without_settings and protection_for(self.governance) is None:
            raise KeystoreError(
                "the governance of the keystore has rules that settings cannot express",
                "It has several domain rules, its last rule is not for *, or it has a rule for a "
                "DDS topic that is not a topic, service or action of ROS. Changing one setting "
                "would replace these rules.",
                "Replace all settings with --template; --dry-run shows the changes.",
            )
        return self.settings


def present_settings(keystore: OpenedKeystore) -> PresentSettings:
    """Return the settings that are in force in a keystore.

    Raises:
        KeystoreError: the folder is not a keystore, or its governance cannot be used.
        DocumentError: its settings are malformed, and the ledger has no earlier settings.
    """
    keystore.check()
    governance = keystore.governance
    ledger = keystore.ledger_with("what", "settings")
    recorded = _recorded_settings(ledger)
    missing = not keystore.has(SETTINGS)
    without_settings = missing and recorded is None
    written, unreadable = None, ""
    try:
        loaded = recorded if missing and recorded else keystore.template
        written = None if missing else loaded
        unreadable = f"there is no {SETTINGS}" if missing and recorded else ""
    except DocumentError as error:
        if recorded is None:
            raise DocumentError(
                error.what,
                error.why,
                "The ledger has no earlier settings: correct the file, or restore it "
                "from a backup.",
            ) from error
        loaded, unreadable = recorded, f"{error.what}: {error.why}".removesuffix(".")
    recorded = with_key_places(recorded, loaded) if recorded else None
    settings = recorded or loaded
    if protection := protection_for(governance):
        settings = replace(settings, protection=protection)
    edits = hand_edits(keystore, ledger, written, governance)
    if unreadable:
        edits = edits._replace(settings=(unreadable,))
    return PresentSettings(settings, written, governance, edits, without_settings, recorded)


_MOST_SHOWN = 3


def edit_notes(keystore: OpenedKeystore, governance: Governance) -> tuple[Note, ...]:
    """Return a note on manually edited files, for a verb that does not apply the edits.

    ``governance`` is the signed governance of the keystore.
    """
    edits = find_edits(keystore, governance)
    if not edits:
        return ()
    clauses = first_few(edits.clauses(), _MOST_SHOWN, "; ", "; and ")
    text = f"{clauses}. Files that are issued from now on may follow the edit; earlier files "
    text += f"and the signed governance do not: {edit_remedy(keystore.root)}"
    return (Note("keystore.edited", text),)


def find_edits(keystore: OpenedKeystore, governance: Governance | None) -> HandEdits:
    """Return the manual edits; ``governance`` is the signed governance, None if unreadable."""
    ledger = keystore.ledger_with("what", "settings")
    return hand_edits(keystore, ledger, keystore.settings, governance)


def edit_remedy(root: Path | str) -> str:
    """Return the remedy for edited files, as a sentence with commands."""
    shown = root if isinstance(root, str) else quote(str(root))
    return (
        f"`sros update_keystore {shown} --take-edits --dry-run` shows what accepting the edits "
        f"would change; `sros update_keystore {shown} --discard-edits` undoes the edits."
    )


_LONG_ENOUGH = timedelta(days=2)
LENGTHEN_PERMISSIONS = (
    "If new permissions are valid for less than a day, first choose a longer validity in "
    "`sros.toml` of the keystore: in the [[enclaves]] entry for the enclave or, without such an "
    "entry, in [permissions]. Then run `sros update_keystore KEYSTORE --take-edits "
    "--allow-looser`."
)
"""How to lengthen the validity of permissions if the settings of their keystore are not known."""


def lengthening_remedy(settings: Template | None, enclave: str) -> str:
    """Return how to lengthen the validity of an enclave's new permissions.

    The text is "" if new permissions are valid for at least two days, or until a fixed time.
    """
    if settings is None:
        return LENGTHEN_PERMISSIONS
    usual, short = settings.permissions_validity, settings.longest_validity(enclave)
    limits = [validity for validity in (usual, short) if isinstance(validity, timedelta)]
    shortest = min(limits, default=_LONG_ENOUGH)
    if shortest >= _LONG_ENOUGH:
        return ""
    enough = duration_text(_LONG_ENOUGH)
    if shortest == usual:
        setting = "permissions.validity"
        how = f"run `sros update_keystore KEYSTORE --set {setting}={enough} --allow-looser`"
    else:
        setting = "the [[enclaves]] entry for this enclave in `sros.toml`"
        how = f'write validity = "{enough}" there, and run `sros update_keystore KEYSTORE '
        how += "--take-edits --allow-looser`"
    return (
        f"New permissions are valid for {duration_text(shortest)}, because of {setting}. "
        f"If this is too short, first {how}."
    )


def hand_edits(
    keystore: OpenedKeystore,
    ledger: Ledger,
    present: Template | None,
    governance: Governance | None,
) -> HandEdits:
    """Return the manual edits, found by comparing ``sros.toml`` with ledger and governance.

    ``present`` are the settings in ``sros.toml``, and ``governance`` is the signed governance; None
    if they cannot be read.  A keystore of ros2/sros2 has no settings, so only its
    ``governance.xml`` is compared.
    """
    recorded = _recorded_settings(ledger)
    settings: tuple[str, ...] = ()
    unsigned: tuple[str, ...] = ()
    if present and recorded:
        settings = tuple(_difference_clauses(recorded, present))
    if present and governance:
        stated = governance_for(present.protection, governance.domains().closed())
        if stated != governance:
            unsigned = tuple(_unsigned_clauses(present, recorded, settings))
    return HandEdits(settings, _governance_edit(keystore), unsigned)


def _unsigned_clauses(
    present: Template, recorded: Template | None, edit_clauses: Sequence[str]
) -> Iterator[str]:
    """Yield a clause on a signed governance that differs from the protection in sros.toml.

    Nothing is yielded if ``edit_clauses`` report edits of sros.toml that changed the protection.
    """
    if not edit_clauses or (recorded and recorded.protection == present.protection):
        yield f"the signed governance differs from [protection] in {SETTINGS}"


def _difference_clauses(old: Template, new: Template) -> Iterator[str]:
    """Yield a clause for each key with different values, except name and description."""
    if old == new:
        return
    before, after = settings_values(old), settings_values(new)
    for key in dict.fromkeys((*before, *after)):
        old_value, new_value = before.get(key, "not set"), after.get(key, "not set")
        if old_value != new_value and key not in ("name", "description"):
            yield f"{key} in {SETTINGS} is {new_value}, but was {old_value} when sros wrote it"


def _governance_edit(keystore: OpenedKeystore) -> str:
    """Return a clause if ``governance.xml`` differs from the signed governance, or ""."""
    if not all((keystore.root / file).is_file() for file in (GOVERNANCE_XML, GOVERNANCE_P7S)):
        return ""
    try:
        plain = keystore.read(GOVERNANCE_XML, "governance document")
        message = keystore.read(GOVERNANCE_P7S, "governance document")
        signed = keystore.files.signed_document(message).document
    except SrosError:
        return ""
    if plain.replace(b"\r\n", b"\n").strip() == signed.replace(b"\r\n", b"\n").strip():
        return ""
    with suppress(SrosError):
        if parse_governance(plain) == parse_governance(signed):
            return ""
    return f"{GOVERNANCE_XML} differs from the signed governance"


def with_key_places(template: Template, source: Template) -> Template:
    """Return ``template`` with the places of the CA keys from the template ``source``.

    If ``template`` has no Zenoh network, the result has the network of ``source``.
    """
    return replace(
        template,
        identity_key=source.identity_key,
        permissions_key=source.permissions_key,
        zenoh=template.zenoh or source.zenoh,
    )
