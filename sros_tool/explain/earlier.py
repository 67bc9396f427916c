"""Notes on earlier permissions and revoked certificates that may still give a denied right."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import Note, SrosError
from sros_tool.explain.answer import Evaluator, Question, influencing_parts
from sros_tool.explain.asking import AskingContext, domains_decided_alike
from sros_tool.keystore.known_keys import IssuedCredentials, removed_enclaves, revoked_entries
from sros_tool.keystore.layout import LEDGER, PERMISSIONS_FILE, REVOKED, ROUTER_FILE
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.participant import LoadedEnclave
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.validity import iso, parse_iso
from sros_tool.wording import first_few

_MOST_NAMED = 20
"""The most enclaves that a note names one by one, so that a user can renew them."""


def note_on_earlier_permissions(
    keystore: OpenedKeystore,
    denied: Collection[str],
    stopped: Collection[str],
    question: Question,
    vendor: Vendor,
    asking: AskingContext,
) -> Iterator[Note]:
    """Yield notes on enclaves that are ``denied`` now, but perhaps allowed by earlier permissions.

    Permissions cannot be revoked: earlier permissions work with every fitting certificate, until
    the permissions or the certificate expire, or the certificate is revoked. The ledger does not
    have the rights of earlier permissions. Permissions from the same policy as the present
    permissions give the same rights: they count for the enclaves ``stopped``, whose present files
    the vendor refuses, for example because they have expired. A note also reports a ledger or
    revocation list that is unreadable or lacks lines.
    """
    if not denied or not keystore.has(LEDGER):  # an export, or a keystore of ros2/sros2
        return
    now = iso(asking.at)
    unknown: dict[str, str] = {}
    same: dict[str, str] = {}
    try:
        issued = IssuedCredentials(keystore, denied)
    except SrosError as error:
        yield _note_on_unknown_answer(
            keystore, "explain.earlier-permissions", error.what, error.remedy
        )
        return
    if gaps := issued.ledger.gaps:
        reason = f"{LEDGER}: {first_few(gaps, 1)}"
        yield _note_on_unknown_answer(keystore, "explain.earlier-permissions", reason)
    for name in denied:
        permissions = issued.permissions(name)
        for earlier, end in permissions:
            if end > now:
                ends = same if earlier.policy == permissions[-1][0].policy else unknown
                ends[name] = max(end, ends.get(name, ""))
        if name in same and not (
            name in stopped
            and _present_rights_allow(keystore, permissions[-1][0], question, vendor, asking)
        ):
            del same[name]
    if unknown:
        names = first_few(sorted(unknown), _MOST_NAMED)
        text = (
            f"the rights in earlier permissions of {names} are not known here: they were signed "
            "from an earlier policy. Whoever kept these permissions and the key has the rights "
            f"until {_ends_text(unknown)}. {_remedy_to_end_rights(keystore, unknown)}"
        )
        yield Note("explain.earlier-permissions", text)
    if same:
        names = first_few(sorted(same), _MOST_NAMED)
        text = (
            f"the present files of {names} do not work, but whoever kept earlier files may still "
            f"do it until {_ends_text(same)}. {_remedy_to_end_rights(keystore, same)}"
        )
        yield Note("explain.earlier-permissions", text)


def _remedy_to_end_rights(keystore: OpenedKeystore, names: Collection[str]) -> str:
    listed = " ".join(quote(name) for name in sorted(names))
    which = listed if len(names) <= _MOST_NAMED else "ENCLAVE..."
    return f"To end this, run `sros renew {quote(str(keystore.root))} {which} --revoke-old`."


def _present_rights_allow(
    keystore: OpenedKeystore,
    present: Entry,
    question: Question,
    vendor: Vendor,
    asking: AskingContext,
) -> bool:
    """Return whether the present permissions gave a right one second after they became valid.

    Faults of other files do not count. Without the permissions that the ledger has as ``present``,
    or if they cannot be read, the result is True: their rights are not known.
    """
    document = _documents(keystore, [keystore.folder(present.enclave)]).get(present.sha256)
    if document is None:
        return True
    asking = asking._replace(at=parse_iso(present.not_before) + timedelta(seconds=1))
    with suppress(SrosError):
        return _allows(keystore, document, present, question, vendor, asking)
    return True


def note_on_revoked_enclaves(
    keystore: OpenedKeystore,
    question: Question,
    vendor: Vendor | None,
    asking: AskingContext,
    named: Collection[str],
) -> Iterator[Note]:
    """Yield notes on enclaves whose revoked certificates are still accepted and give the right.

    DDS processes without the current revocation list accept revoked certificates; Zenoh (``vendor``
    None) has no revocation list.  ``named`` are the enclaves that have the right now; on Zenoh, a
    revoked certificate keeps the rights of such an enclave.
    """
    kind = "explain.revoked-enclaves"
    try:
        if not keystore.has(LEDGER):  # an export, or a keystore of ros2/sros2, has no list here
            if keystore.revocation_list:
                yield _note_on_unknown_answer(keystore, kind, f"{LEDGER} is missing")
            return
        if gaps := keystore.ledger_with("what", "revocation").gaps:
            yield _note_on_unknown_answer(keystore, kind, f"{LEDGER}: {first_few(gaps, 1)}")
        revoked = tuple(_revoked_enclaves_with_right(keystore, question, vendor, asking))
        removed = removed_enclaves(keystore, asking.at)
    except SrosError as error:
        yield _note_on_unknown_answer(keystore, kind, error.what, error.remedy)
        return
    root = quote(str(keystore.root))
    if removed:
        text = (
            f"{first_few(sorted(removed), 3)} {'were' if len(removed) > 1 else 'was'} removed from "
            "the keystore, and not revoked. Whoever kept the files may have the right, until "
            f"{_ends_text(removed)}. To revoke an enclave, create it again (`sros create_enclave "
            f"{root} ENCLAVE`), and run `sros revoke {root} ENCLAVE`."
        )
        yield Note("explain.removed-enclaves", text)
    if vendor:
        old = "the current revocation list"
        remedy = "the list at a restart (with a fleet, `sros fleet status "
        remedy += f"{root}` says where it is in force)"
    else:
        old = "the current Zenoh files"
        remedy = "the files at a restart, because Zenoh has no revocation list"
    for decided, has_right in (
        (True, "have the right"),
        (False, "work with permissions that are not here, whose rights are not known"),
    ):
        gone = {
            of.name: of.until
            for of in revoked
            if of.decided is decided and (vendor or of.name not in named)
        }
        if gone:
            text = (
                f"revoked certificates of {first_few(sorted(gone), 3)} {has_right}. A process "
                f"without {old} still accepts them, until {_ends_text(gone)}: each process has "
                f"to load {remedy}."
            )
            yield Note(kind, text)
    again = {of.name: of.until for of in revoked if of.name in named}
    if again and vendor is None:
        text = (
            f"whoever kept a revoked certificate of {first_few(sorted(again), 3)} and its key may "
            f"do it, too, until {_ends_text(again)}: Zenoh has no revocation list. Give the "
            f"enclave another name, or run `sros rotate_ca {root}`."
        )
        yield Note(kind, text)


def _ends_text(ends: Mapping[str, str]) -> str:
    """Return when the files of enclaves expire: one moment, or, if the days differ, the last
    ones with their enclaves.
    """
    if len({end[:10] for end in ends.values()}) == 1:
        return max(ends.values())
    names = sorted(ends, key=lambda name: ends[name], reverse=True)
    return first_few([f"{ends[name]} ({name})" for name in names], 3)


class _RevokedEnclave(NamedTuple):
    """An enclave whose revoked certificate works with fitting permissions ``until`` a moment.

    ``decided`` is False if the keystore lacks some of these permissions, which may give the right.
    """

    name: str
    decided: bool
    until: str


def _revoked_enclaves_with_right(
    keystore: OpenedKeystore, question: Question, vendor: Vendor | None, asking: AskingContext
) -> Iterator[_RevokedEnclave]:
    """Yield the enclaves whose revoked certificates may have a right."""
    permissions: defaultdict[str, list[Entry]] = defaultdict(list)
    certificates: defaultdict[str, list[Entry]] = defaultdict(list)
    for entry in revoked_entries(keystore):
        if entry.what == "permissions":
            permissions[entry.enclave].append(entry)
        elif entry.not_after > iso(asking.at):
            certificates[entry.enclave].append(entry)
    for name, revoked in certificates.items():
        folders = [keystore.root / REVOKED / entry.serial for entry in revoked]
        documents = _documents(keystore, [*folders, keystore.folder(name)])
        works: list[tuple[bool, str]] = []
        for certificate, folder in zip(revoked, folders, strict=True):
            fitting = [of for of in permissions[name] if of.subject in ("", certificate.subject)]
            # Zenoh files have the rules of the last permissions, and do not expire.
            if vendor is None:
                fitting = [of._replace(not_after="") for of in permissions[name][-1:]]
                if (folder / ROUTER_FILE).exists():  # sessions trust a router in everything
                    works.append((True, certificate.not_after))
            allowed = {
                of.policy or of.sha256: _allows(
                    keystore, documents[of.sha256], certificate, question, vendor, asking
                )
                for of in fitting
                if of.sha256 in documents
            }
            # Permissions for the certificate that replaced this one have the rights of its policy.
            for of in permissions[name]:
                if of.policy and of.policy not in allowed and of.sha256 in documents:
                    allowed[of.policy] = _allows(
                        keystore,
                        documents[of.sha256],
                        certificate._replace(subject=of.subject or certificate.subject),
                        question,
                        vendor,
                        asking._replace(at=parse_iso(of.not_before) + timedelta(seconds=1)),
                    )
            for of in fitting:
                until = min(certificate.not_after, of.not_after or certificate.not_after)
                has_right = allowed.get(of.policy or of.sha256)
                if has_right is not False and until > iso(asking.at):
                    works.append((has_right is True, until))
        if works:
            decided = any(is_decided for is_decided, _ in works)
            ends = (until for is_decided, until in works if is_decided is decided)
            yield _RevokedEnclave(name, decided, max(ends))


def _documents(keystore: OpenedKeystore, folders: Iterable[Path]) -> Mapping[str, bytes]:
    """Map the SHA-256 of each ``permissions.p7s`` in the folders to its content."""
    documents = {}
    for folder in folders:
        with suppress(SrosError):  # an unreadable file counts as missing permissions
            data = keystore.read(folder / PERMISSIONS_FILE, "permissions document")
            documents[hashlib.sha256(data).hexdigest()] = data
    return documents


def _allows(
    keystore: OpenedKeystore,
    permissions: bytes,
    certificate: Entry,
    question: Question,
    vendor: Vendor | None,
    asking: AskingContext,
) -> bool:
    """Return whether permissions give a certificate a right or one of its `influencing_parts`."""
    governance, document = keystore.governance, keystore.files.signed_document(permissions).document
    grant = parse_permissions(document).grant_of(certificate.subject)
    if vendor is None and grant:
        asking = asking._replace(at=grant.validity.not_before)
    enclave = LoadedEnclave(
        certificate.enclave,
        certificate.subject,
        b"",
        document,
        keystore.domains,
        plain_governance=governance,
    )
    questions = (question, *influencing_parts(question).values())
    for domains in domains_decided_alike(keystore.domains, governance, grant, asking.domain):
        context = asking._replace(domain=next(iter(domains))).context(None)
        evaluator = Evaluator(vendor or Vendor.STANDARD, enclave, context)
        if any(evaluator.answer(asked).allowed for asked in questions):
            return True
    return False


_UNKNOWN_TEXTS = {
    "explain.earlier-permissions": "whether earlier permissions may still allow it",
    "explain.revoked-enclaves": "whether processes still accept revoked certificates",
}


def _note_on_unknown_answer(
    keystore: OpenedKeystore, kind: str, reason: str, remedy: str = ""
) -> Note:
    """Return a note which says that the answer is not known, for what reason, and what to do."""
    remedy = remedy or f"`sros check {quote(str(keystore.root))}` says what to do."
    return Note(kind, f"it is not known {_UNKNOWN_TEXTS[kind]}: {reason}. {remedy}")
