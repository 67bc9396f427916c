"""Whether DDS vendors accept enclaves, checked before a transaction puts new files in place.

Every verb that changes trust calls `refuse_stopping_nodes` before it commits.  This function
evaluates each changed enclave as every tested vendor would load it, before and after the change.
If a vendor accepts an enclave before the change and would refuse it afterwards, the vendor's nodes
would not start again, so the change is refused.

If several enclaves are alike in everything that vendors examine, only one of them is evaluated.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path

from cryptography import x509

from sros_tool.dds.decision.access import Decision
from sros_tool.dds.decision.vendors import TESTED, Vendor, joined_titles, words_of
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import render_permissions
from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.faults import Fault
from sros_tool.files import write_new_file
from sros_tool.keystore.issuing.authority import Authorities
from sros_tool.keystore.issuing.enclave import default_rights
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    ENCLAVES,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    IDENTITY,
    IDENTITY_CA_FILE,
    KEY_URI_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    PUBLIC,
    REQUEST,
    ROLES,
    ca_certificate_path,
    enclave_folder,
    is_enclave,
)
from sros_tool.keystore.participant import JoinContext, VendorParticipant, load_enclave
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Transaction
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    enclave_subject,
    is_self_issued,
    is_valid_at,
    issued_by,
    load_certificates,
    pem,
    read_form,
    subject_text,
    validity_of,
)
from sros_tool.pki.crl import may_sign_lists, next_update, read_list, sign_crl
from sros_tool.pki.keys import generate_key
from sros_tool.translate import permissions_for
from sros_tool.validity import window
from sros_tool.wording import enumerated, first_few

_LOADED_FILES = (
    IDENTITY_CA_FILE,
    PERMISSIONS_CA_FILE,
    CERTIFICATE_FILE,
    GOVERNANCE_FILE,
    PERMISSIONS_FILE,
    CRL_FILE,
    KEY_URI_FILE,
)
"""The files that DDS loads, except the key, which only changes together with its certificate."""
_REQUIRED_LOADED_FILES = _LOADED_FILES[:5]
_CRL_NAME = CRL.rpartition("/")[2]
_SHARED_IDENTITY_FILES = {IDENTITY_CA_FILE, _CRL_NAME}
"""Shared files that do not affect the verification of governance and permissions."""
_ACCEPTED_FAULTS = {Fault.DOCUMENT_SIZE, Fault.KEY_ON_TOKEN}
"""Faults that follow from the user's own choices, and are only reported by notes."""
_MOST_SHOWN = 5
_EXAMPLE_ENCLAVE = "/example"
_MOST_TRIED = 20
"""Maximum number of enclaves of one kind that are tried until a vendor accepts one."""

Files = dict[str, bytes]
_Kind = tuple[tuple[str, ...], frozenset[str], tuple[object, ...]]
"""What vendors decide on: an enclave's paths and changed files, and the relevant content."""


@dataclass(frozen=True, slots=True)
class _Refusals:
    """The enclaves that a vendor would refuse, and the vendor's reasons as clauses."""

    enclaves: tuple[str, ...]
    reasons: tuple[str, ...]


def refuse_stopping_nodes(
    transaction: Transaction,
    now: datetime,
    *,
    keystore: OpenedKeystore | None = None,
    allowed: Collection[Vendor] = (),
    revoked_before: Collection[int] = (),
    remedy: Callable[[], str] = str,
) -> tuple[Note, ...]:
    """Refuse a transaction after which vendors refuse enclaves that they accept today.

    A transaction is also refused if no vendor would accept a new enclave in it.  An enclave whose
    certificate was revoked before this transaction does not count: somebody put its files back, and
    vendors are meant to refuse them.

    Args:
        transaction: the transaction, with all its files staged.
        now: the time at which the enclaves are evaluated.
        keystore: the keystore that was opened for the change.
        allowed: vendors whose nodes may stop, because the user named them.
        revoked_before: serial numbers that were revoked before, but not in this keystore.
        remedy: a function that returns a remedy, as sentences; by default, the error names the
            changed files.

    Returns:
        Notes on enclaves that stop on the ``allowed`` vendors, and on enclaves that a dry run did
            not evaluate.

    Raises:
        KeystoreError: nodes of a vendor that is not ``allowed`` would stop.
    """
    files = _FilesOfChange(
        transaction, keystore or OpenedKeystore(transaction.root), revoked_before
    )
    stopped, revoked = _stopped_enclaves(files, now)
    if refused := {vendor: why for vendor, why in stopped.items() if vendor not in allowed}:
        raise _refused_change_error(transaction.root, refused, remedy())
    old = _authority_without_list(files)
    if old and (
        cut_off := [vendor for vendor in _VENDORS_READING_ALL_CAS if vendor not in allowed]
    ):
        raise _shut_out_error(transaction.root, old, cut_off, remedy())
    notes = [
        Note(
            "vendor.refuses",
            f"{vendor.title} refuses {_names_text(refusals.enclaves)} from now on: "
            f"{'; '.join(refusals.reasons)}. Running nodes continue until they are restarted.",
        )
        for vendor, refusals in stopped.items()
    ]
    if revoked:
        text = (
            f"revoked certificates of {_names_text(revoked)} are in the keystore again: every "
            "process with the new revocation list refuses them"
        )
        notes.append(Note("keystore.revoked-put-back", text))
    if unseen := transaction.files_not_kept():
        text = (
            f"sros did not check {_names_text(unseen)} against the vendors, because this dry run "
            "makes too many files"
        )
        notes.append(Note("vendor.not-asked", text))
    return tuple(notes)


def _stopped_enclaves(
    files: _FilesOfChange, now: datetime
) -> tuple[dict[Vendor, _Refusals], list[str]]:
    """Return the refusals by vendors after the change, and the enclaves that are left out.

    The first value maps vendors to the enclaves that they accept today, but would refuse after the
    change, and to new enclaves that they would refuse.  The second value has the enclaves whose
    certificates were revoked before.
    """
    stopped: dict[Vendor, dict[str, list[str]]] = {}
    put_back: list[str] = []
    for (_, own, _), names in _enclaves_by_kind(files, now).items():
        for tried, name in enumerate(names, 1):
            before, after = files.files_before(name), files.files_after(name)
            refused = refusals(name, after, now) if after else {}
            is_last = tried == min(len(names), _MOST_TRIED)
            # Today's acceptance matters if a vendor would refuse the enclave, or if another enclave
            # can still be tried.
            asked = before and (refused or not is_last)
            accepted = set(TESTED) - refusals(name, before, now).keys() if asked else set()
            if accepted or not before or is_last:
                break
        if not before:
            all_new = {CERTIFICATE_FILE, PERMISSIONS_FILE} <= own
            accepted = set(TESTED) if all_new and len(refused) == len(TESTED) else set()
        stopping = [vendor for vendor in TESTED if vendor in accepted and vendor in refused]
        revoked = [name for name in names if stopping and files.was_revoked(name)]
        put_back += revoked
        if others := [name for name in names if name not in revoked]:
            for vendor in stopping:
                stopped.setdefault(vendor, {}).setdefault(refused[vendor], []).extend(others)
    refusals_by_vendor = {
        vendor: _Refusals(tuple(sorted(name for names in by.values() for name in names)), tuple(by))
        for vendor, by in stopped.items()
    }
    return refusals_by_vendor, put_back


def refusals(name: str, files: Files, now: datetime) -> dict[Vendor, str]:
    """Map the tested vendors that refuse an enclave with these files to their reasons.

    ``files`` maps file names to content.  The private key is assumed to fit the certificate.
    """
    import tempfile

    with tempfile.TemporaryDirectory(prefix="sros-") as folder:
        for file, data in files.items():
            write_new_file(Path(folder, file), data, flush=False)
        if KEY_URI_FILE not in files:
            # With a request, the key counts as being on its robot.
            write_new_file(Path(folder, REQUEST), b"\n", flush=False)
        enclave = load_enclave(name, Path(folder), moment=now)
    domains = enclave.joined_domains
    domain = next(iter(domains), 0) if domains else 0
    reasons = {}
    for vendor in TESTED:
        participant = VendorParticipant(vendor, enclave, JoinContext(domain, now))
        decision = participant.join()
        faults = {problem.fault for problem in participant.problems}
        if not decision.outcome.ok and not (faults and faults <= _ACCEPTED_FAULTS):
            reasons[vendor] = _refusal_reason(participant, decision)
    return reasons


def _refusal_reason(participant: VendorParticipant, decision: Decision) -> str:
    return str(participant.problems[0]).rstrip(".") if participant.problems else decision.clause


def _refused_change_error(
    root: Path, refused: Mapping[Vendor, _Refusals], remedy: str
) -> KeystoreError:
    names = tuple(sorted({name for refusals in refused.values() for name in refusals.enclaves}))
    why = {
        vendor: "; ".join(refusals.reasons[:_MOST_SHOWN]) for vendor, refusals in refused.items()
    }
    whose = "its" if len(names) == 1 else "their"
    options = " ".join(f"--allow-refusal {word}" for word in words_of(refused))
    titles = enumerated(joined_titles(vendor.title for vendor in refused))
    return KeystoreError(
        f"after this change, nodes on {titles} could not start in {_names_text(names)} of '{root}'",
        f"{_refusal_clauses(why, f'{whose} new files')}. Nothing was changed.",
        f"{remedy or 'Replace the file that the error names.'} If no node runs on "
        f"{titles}, add {options}.",
    )


_VENDORS_READING_ALL_CAS = tuple(
    vendor for vendor in TESTED if not vendor.traits.reads_first_authority
)


def _authority_without_list(files: _FilesOfChange) -> x509.Certificate | None:
    """Return an earlier identity CA that may not sign revocation lists, or None.

    The result is None unless the change adds the first revocation list.  Once there is a list,
    OpenSSL demands a list of the issuing CA for every certificate.
    """
    if not files.content_after(CRL) or files.content(CRL):
        return None
    data = files.content_after(ca_certificate_path(IDENTITY))
    present, *others = load_certificates(data, "of the identity CA")
    return next(
        (
            authority
            for authority in others
            if is_self_issued(authority)
            and not may_sign_lists(authority)
            and not issued_by(present, authority)
        ),
        None,
    )


def _shut_out_error(
    root: Path, old: x509.Certificate, vendors: Sequence[Vendor], remedy: str
) -> KeystoreError:
    titles = joined_titles(vendor.title for vendor in vendors)
    demand = f"{enumerated(titles)} {'demands' if len(titles) == 1 else 'demand'}"
    name = subject_text(old.subject)
    options = " ".join(f"--allow-refusal {word}" for word in words_of(vendors))
    return KeystoreError(
        f"after this change of '{root}', {enumerated(titles)} would refuse processes that still "
        f"have certificates of the CA {name}",
        f"Once there is a revocation list, {demand} one from each CA, but the keyUsage of {name} "
        "lacks cRLSign. Nothing was changed.",
        f"{remedy} If no process runs with such a certificate, add {options}.",
    )


def _refusal_clauses(refused: Mapping[Vendor, str], label: str) -> str:
    """Return a clause for each reason, such as "A and B refuse ``label`` (reason)"."""
    by_reason: dict[str, list[str]] = {}
    for vendor, reason in refused.items():
        by_reason.setdefault(reason, []).append(vendor.title)
    return "; ".join(
        f"{enumerated(titles)} {'refuses' if len(titles) == 1 else 'refuse'} {label} ({reason})"
        for reason, titles in (
            (reason, joined_titles(named)) for reason, named in by_reason.items()
        )
    )


def _names_text(names: Sequence[str]) -> str:
    return first_few(names, _MOST_SHOWN)


# ── CAs that are imported ──────────────────────────────────────────────────────────────────


def imported_ca_notes(
    transaction: Transaction,
    template: Template,
    authorities: Authorities,
    domains: DomainSet,
    now: datetime,
) -> tuple[Note, ...]:
    """Return notes on vendors that refuse enclaves of imported CAs, now or after a revocation.

    An example enclave is issued but not written.  It is evaluated with a revocation list and
    without one.  Vendors that the notes of ``authorities`` already name are left out.

    Raises:
        KeystoreError: no vendor would accept an enclave of the keystore.
    """
    files = _example_files(transaction, template, authorities, domains, now)
    refused = refusals(_EXAMPLE_ENCLAVE, files, now)
    if len(refused) == len(TESTED):
        raise KeystoreError(
            f"no DDS vendor would accept an enclave of keystore '{transaction.root}'",
            f"{_refusal_clauses(refused, 'it')}. Nothing was written.",
            "Name CAs that vendors accept, or let sros create the CAs.",
        )
    known = " ".join(note.text for note in authorities.notes)
    notes = []
    if new := {vendor: why for vendor, why in refused.items() if vendor.title not in known}:
        others = joined_titles(vendor.title for vendor in TESTED if vendor not in refused)
        verb = "accepts" if len(others) == 1 else "accept"
        refusing = _refusal_clauses(new, "the enclaves of this keystore")
        text = f"{refusing}; {enumerated(others)} {verb} them."
        notes.append(Note("portable.imported-ca", text))
    identity = authorities.identity
    validity = validity_of(identity.certificate).intersection(
        window(now, template.revocation_validity)
    )
    crl = sign_crl(
        identity.certificate,
        identity.key,
        (),
        number=1,
        this_update=validity.not_before,
        next_update=validity.not_after,
    )
    listed = refusals(_EXAMPLE_ENCLAVE, files | {CRL_FILE: crl}, now)
    if later := {vendor: why for vendor, why in listed.items() if vendor not in refused}:
        text = (
            "once this identity CA has a revocation list, "
            f"{_refusal_clauses(later, 'every enclave')}, so `sros revoke` signs no list. "
            "To revoke enclaves, have the CA's certificate issued again with keyUsage cRLSign, or "
            "let sros make the identity CA."
        )
        notes.append(Note("portable.revocation-list", text))
    return tuple(notes)


def _example_files(
    transaction: Transaction,
    template: Template,
    authorities: Authorities,
    domains: DomainSet,
    now: datetime,
) -> Files:
    """Return the files of an example enclave for a new keystore, by name."""
    files = {
        f"{role}_ca.cert.pem": transaction.content_after(
            transaction.place_after(ca_certificate_path(role))
        )
        for role in ROLES
    }
    files[GOVERNANCE_FILE] = transaction.content_after(GOVERNANCE_P7S)
    validity = window(now, template.certificate_validity)
    subject = enclave_subject(_EXAMPLE_ENCLAVE, unique=template.unique_subject)
    certificate = authorities.identity.issuer().issue(
        subject, generate_key().public_key(), validity
    )
    signer = authorities.permissions
    rights = default_rights(template, _EXAMPLE_ENCLAVE)
    validity = validity.intersection(validity_of(signer.certificate))
    permissions = permissions_for(
        rights,
        subject=subject_text(certificate.subject),
        validity=validity.intersection(validity_of(certificate)),
        domains=domains.closed(),
    )
    files[CERTIFICATE_FILE] = pem(certificate)
    files[PERMISSIONS_FILE] = signer.sign(render_permissions(permissions), "example permissions")
    return _if_complete(files)


# ── the enclaves that change ───────────────────────────────────────────────────────────────


class _FilesOfChange:
    """The files of enclaves before and after a transaction; each shared file is read once."""

    def __init__(
        self, transaction: Transaction, keystore: OpenedKeystore, revoked_before: Collection[int]
    ) -> None:
        self._revoked_before = revoked_before
        self.transaction = transaction
        self.changed = transaction.changed_folders()
        self._keystore = keystore
        self._after: dict[str, bytes] = {}
        self._places: dict[str, str] = {}

    @cached_property
    def _revoked_serials(self) -> frozenset[int]:
        """The serial numbers that the ledger or the revocation list had before the transaction.

        If the list comes from a robot and the keystore from a backup, some numbers are only on the
        list.
        """
        of_ledger = {int(entry.serial, 16) for entry in self._keystore.entries_of("revocation")}
        has_list = self._keystore.has(CRL)
        return _listed_serials(
            self._keystore.read(CRL, "revocation list") if has_list else b""
        ) | of_ledger.union(self._revoked_before)

    def enclaves_of_newer_list(self) -> set[str] | None:
        """Return the enclaves to evaluate if a newer revocation list is the only change, or None.

        These are the enclaves whose certificates only the new list has, and one other enclave.  The
        result is None if the lists differ in more than entries, number and dates, or if no index
        finds these enclaves.
        """
        before, after = self.content(CRL), self.content_after(CRL)
        ledger = self._keystore.ledger_file
        recorded = ledger.recorded_enclaves()
        if (
            recorded is None
            or not before
            or _refusable_parts_of_crl(before) != _refusable_parts_of_crl(after)
        ):
            return None
        added = [f"{serial:x}" for serial in _listed_serials(after) - _listed_serials(before)]
        entries = ledger.with_values("serial", added).entries
        listed = {entry.enclave for entry in entries if entry.enclave}
        existing = (
            name for name in recorded if is_enclave(self.transaction.root / enclave_folder(name))
        )
        kept = next((name for name in existing if enclave_folder(name) not in self.changed), None)
        return listed | ({kept} if kept else set())

    def was_revoked(self, name: str) -> bool:
        """Return whether the enclave keeps a certificate that was revoked before this change."""
        path = f"{enclave_folder(name)}/{CERTIFICATE_FILE}"
        if not self._revoked_serials or self.transaction.is_staged(path):
            return False
        form = read_form(self.content(path))
        return form is not None and form.serial in self._revoked_serials

    def places_after(self, name: str) -> dict[str, str]:
        """Map an enclave's file names to the paths from which their content will be read."""
        folder = enclave_folder(name)
        return {file: self._place_after(f"{folder}/{file}") for file in _LOADED_FILES}

    def _place_after(self, path: str) -> str:
        """Return the path of the file that ``path`` leads to, as a link or as the file itself."""
        target = self.transaction.target_after(path)
        if target is None:
            return path
        if target.startswith("/"):
            return self.transaction.place_after(path)
        linked = os.path.normpath(f"{path.rpartition('/')[0]}/{target}")
        if linked not in self._places:
            self._places[linked] = self.transaction.place_after(path)
        return self._places[linked]

    def files_before(self, name: str) -> Files:
        """Return the present files of an enclave; empty if a required file is missing."""
        folder = enclave_folder(name)
        return _if_complete({file: self.content(f"{folder}/{file}") for file in _LOADED_FILES})

    def files_after(self, name: str) -> Files:
        """Return an enclave's files after the transaction; empty if a required file is missing."""
        places = self.places_after(name)
        return _if_complete({file: self.content_after(place) for file, place in places.items()})

    def content(self, path: str) -> bytes:
        """Return the present content of a file; empty if it cannot be read."""
        try:
            return self._keystore.read(path, "file")
        except SrosError:
            return b""

    def content_after(self, place: str) -> bytes:
        """Return the content of a file (not a link) after the transaction; empty if missing."""
        if not self.transaction.is_staged(place):
            return self.content(place)
        if place not in self._after:
            self._after[place] = self.transaction.content_after(place) or b""
        return self._after[place]


def _enclaves_by_kind(files: _FilesOfChange, now: datetime) -> dict[_Kind, list[str]]:
    """Map kinds of enclaves to the changed, complete enclaves of each kind.

    A kind is everything in an enclave's files that vendors could treat differently.
    """
    changed, root = files.changed, files.transaction.root
    shared = changed.get(PUBLIC, set()) | changed.get(ENCLAVES, set()) & {GOVERNANCE_FILE}
    documents = not shared <= _SHARED_IDENTITY_FILES
    names = {
        f"/{folder.removeprefix(ENCLAVES).lstrip('/')}"
        for folder, changed_files in changed.items()
        if folder.split("/", 1)[0] == ENCLAVES and not changed_files.isdisjoint(_LOADED_FILES)
    }
    if shared == {_CRL_NAME} and (others := files.enclaves_of_newer_list()) is not None:
        names.update(others)
    elif shared:
        names.update(files.transaction.enclaves)
    present = {name for name in names if is_enclave(root / enclave_folder(name))}
    lists: dict[str, frozenset[int]] = {}
    kinds: dict[_Kind, list[str]] = {}
    for name in sorted(names):
        folder = enclave_folder(name)
        own = frozenset(changed.get(folder, ())).intersection(_LOADED_FILES)
        if name not in present and own.issuperset(_REQUIRED_LOADED_FILES):
            # All of its files are made now, in the same way.
            kinds.setdefault(((), own, ()), []).append(name)
            continue
        places = files.places_after(name)
        shared_places = tuple(place.removeprefix(f"{folder}/") for place in places.values())
        looks: tuple[object, ...] = ()
        if name in present:  # a new enclave is issued by this transaction like all other new ones
            data = files.content_after(places[CERTIFICATE_FILE])
            if not data:
                continue  # the enclave is revoked, or its request is not answered yet
            crl = places[CRL_FILE]
            if crl not in lists:
                lists[crl] = _listed_serials(files.content_after(crl))
            is_new = CERTIFICATE_FILE in own
            before = files.content(f"{folder}/{CERTIFICATE_FILE}") if is_new else b""
            signed = documents or PERMISSIONS_FILE in own
            looks = (
                _certificate_kind(data, lists[crl], now),
                _certificate_kind(before, frozenset(), now),
                signed and _signature_properties(files.content_after(places[PERMISSIONS_FILE])),
            )
        kinds.setdefault((shared_places, own, looks), []).append(name)
    return kinds


def _if_complete(files: Mapping[str, bytes | None]) -> Files:
    complete = {file: data for file, data in files.items() if data}
    return complete if all(file in complete for file in _REQUIRED_LOADED_FILES) else {}


def _certificate_kind(
    data: bytes, listed_serials: frozenset[int], now: datetime
) -> tuple[object, ...]:
    """Return the parts of a certificate, except name and key, that a vendor could refuse."""
    form = read_form(data)
    if form is None:
        return (data,)
    return (form.common, is_valid_at(form, now), form.serial in listed_serials)


def _listed_serials(crl: bytes) -> frozenset[int]:
    """Return the serial numbers on a revocation list."""
    try:
        return frozenset(entry.serial_number for entry in read_list(crl, ""))
    except SrosError:
        return frozenset()


def _refusable_parts_of_crl(crl: bytes) -> tuple[object, ...] | None:
    """Return the parts of a revocation list that a vendor could refuse; None if unreadable."""
    try:
        read = read_list(crl, "")
        extensions = tuple((part.oid, part.critical) for part in read.extensions)
        return read.issuer, read.signature_algorithm_oid, extensions, bool(next_update(read))
    except (SrosError, ValueError):
        return None


def _signature_properties(message: bytes) -> tuple[object, ...] | None:
    """Return the certificates and the hash algorithm of a signed message; None if unreadable."""
    try:
        signed = smime.parse(message)
    except SrosError:
        return None
    return signed.certificates, signed.digest
