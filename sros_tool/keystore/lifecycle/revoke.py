"""Revocation of enclaves: certificates go on the list, and files to the folder ``revoked``."""

from __future__ import annotations

import os
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from itertools import count
from pathlib import Path
from shlex import quote
from typing import Unpack

from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
from sros_tool.keystore.known_keys import (
    keys_on_robots_remedy,
    lacking_enclaves_remedy,
    other_keys_remedy,
    revoked_serials,
)
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    IDENTITY,
    KEY_URI_FILE,
    OPTIONAL_FILES,
    REQUEST,
    REQUIRED_FILES,
    REVOKED,
    SETTINGS,
    ZENOH_FILES,
    enclave_folder,
    has_key,
    key_on_robot,
)
from sros_tool.keystore.ledger import (
    LOST_CA,
    ON_ROBOT_ONLY,
    PERHAPS_REVOKED,
    RESTORED,
    Entry,
    certificate_entry,
)
from sros_tool.keystore.lifecycle.change import Changed, ChangeOptions, KeystoreChange
from sros_tool.keystore.lifecycle.revocation_list import LostRecords
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.selection import missing_enclave_error
from sros_tool.names import check_enclave_name
from sros_tool.pki.certificates import issued_by, key_digest, validity_of
from sros_tool.pki.crl import REASONS, SUPERSEDED, load_crls, signed_by
from sros_tool.validity import Window, duration_text, iso, parse_iso
from sros_tool.wording import counted, first_few

_MOVED_FILES = (
    *REQUIRED_FILES,
    KEY_URI_FILE,
    *OPTIONAL_FILES,
    *ZENOH_FILES,
    "permissions.xml",
    REQUEST,
)
_PRIVATE_FILE = "key.pem"
_MOST_SHOWN = 5
_CLEAR_DIFFERENCE = timedelta(days=1)
"""The difference between two validities from which they show that a setting was changed."""
REVOKED_AGAIN = "fleet.revocations-restored"
"""The id of the note that `restored_list_note` returns."""
REPLACED_AFTER_BACKUP = "fleet.replaced-after-backup"
"""The id of a note on enclaves of which a restored keystore has only revoked certificates."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RestoredRevocations(Changed):
    """The result of `restore_revocations`.

    ``replaced`` maps enclaves that stay, although their certificate is revoked, to whether their
    key is revoked, too.
    """

    replaced: Mapping[str, bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class Revocation(Changed):
    """The result of a revocation, or of signing the revocation list again.

    ``next_update`` is the expiry of the revocation list, in UTC.  ``restart`` are the enclaves
    whose processes trust the revoked certificates until they are restarted.
    """

    next_update: datetime
    reason: str = ""


def revoke(
    root: Path,
    names: Sequence[str],
    *,
    reason: str = "unspecified",
    until_retired: bool = False,
    crl: bytes = b"",
    **options: Unpack[ChangeOptions],
) -> Revocation:
    """Revoke the certificates of enclaves and move their files to ``revoked`` in the keystore.

    All certificates of an enclave that have not expired are revoked, because an attacker with the
    key could also use an earlier certificate.  The certificates are found in the enclave's folder,
    the ledger and the folder ``revoked``; if the ledger may lack certificates, a remark says so.
    The other enclaves get ``crl.pem``, a link to the list.  During a rotation of the identity CA,
    both CAs sign a list; if the key of the old CA is missing, ``until_retired`` accepts that Fast
    DDS trusts the old CA's certificates until this CA is retired.  If the identity CA is a CA
    service, ``crl`` is the list (PEM) that the service signed.

    Raises:
        KeystoreError: an enclave does not exist, the identity CA did not issue its certificate, the
            key of a CA is missing, or vendors would refuse other enclaves with the list.
        UsageError: ``reason`` is not in `REASONS`, or is `SUPERSEDED`.
    """
    if reason not in REASONS:
        raise UsageError(
            f"unknown reason {reason!r} for a revocation", "", f"Choose {', '.join(REASONS)}."
        )
    if reason == SUPERSEDED:
        raise UsageError(
            f"{SUPERSEDED} is not a reason to revoke an enclave",
            "sros uses this reason for earlier certificates of renewed enclaves. A machine that "
            "has only an export would take the enclave for renewed, not revoked, and still accept "
            "Zenoh files from before the revocation.",
            "Choose another reason, such as cessation_of_operation; or replace the certificate "
            "with `sros renew --revoke-old`.",
        )
    change = KeystoreChange(root, **options)
    change.crl = crl
    with change:
        if not names and (current := change.keystore.revocation_lists):  # no list to sign
            expiry = min(crl.next_update for crl in current)
            return change.result(Revocation, next_update=expiry, reason=reason)
        _check_names(change, names)
        lists = change.revocation_lists()
        gone = frozenset(names)
        last = {name: _move_to_revoked(change, name) for name in dict.fromkeys(names)}
        recipients = lists.recipients()
        everybody = change.names if recipients is None else recipients
        change.restart = tuple(name for name in everybody if name not in gone)
        revocations = lists.revocations(last, reason)
        change.notes += _later_keys_notes(change, last, {entry.serial for entry in revocations})
        next_update, change.entries = lists.sign(
            revocations, change.restart, incomplete=until_retired
        )
        change.remarks += lists.remarks
        _drop_routers(change, gone)
        change.stage_zenoh({}, revoked_enclaves=gone)
        change.record()
        change.finish(command="revoke")
    return change.result(
        Revocation,
        outcomes=dict.fromkeys(names, "revoked"),
        next_update=next_update,
        reason=reason,
    )


def _later_keys_notes(
    change: KeystoreChange, last: Mapping[str, Entry], revoked: Container[str]
) -> Iterator[Note]:
    """Yield a note on revoked keys that a restored keystore certified after its last backup.

    ``last`` maps enclaves to the entries of their present certificates.  ``revoked`` has the serial
    numbers (hexadecimal) of the revoked certificates.
    """
    names = {
        entry.enclave
        for entry in change.known.certificates_shown_after_restore(last)
        if entry.serial in revoked and entry.key != last[entry.enclave].key
    }
    if names:
        would = "would be" if change.dry_run else "are"
        yield Note(
            "revoke.later-keys",
            "the keystore was restored from a backup, and learned only afterwards of newer keys of "
            f"{first_few(sorted(names), _MOST_SHOWN)} (for example of new hardware). These keys "
            f"{would} revoked, too, and get no certificates again: create new keys on their "
            "robots. docs/howto/keystore_is_lost.md says how to revoke only the earlier keys.",
        )


def restore_revocations(
    root: Path,
    forgotten_lists: LostRecords,
    *,
    shown_by: str = "",
    enclaves_with_named_rights: Collection[str] = (),
    perhaps_revoked: Collection[str] = (),
    on_robots_only: Collection[str] = (),
    **options: Unpack[ChangeOptions],
) -> RestoredRevocations:
    """Revoke again all certificates on revocation lists that the keystore signed and lost.

    The next list has a higher number than the lost lists.

    An enclave that was revoked is moved to ``revoked`` again, even if it was renewed since then.
    An enclave stays if only an earlier certificate of the enclave was replaced and revoked.  The
    key of this certificate is revoked, too, unless a certificate that the ledger lacked has the
    same key.  If a revoked key vouched for later keys, these keys are also revoked.

    Certificates that the ledger lacks are recorded, so that they can be revoked.  Certificates
    of a revoked enclave are revoked immediately.

    The ledger also records that the keystore was restored.  This entry has a number that the
    keystore never used: the seconds since 1970, or the number of a later release that a robot has.
    Its ``reason`` is ``shown_by``.  Further entries have ``enclaves_with_named_rights``: the caller
    names the rights that these enclaves lost after the backup, so that a later renewal counts as
    consent to these rights.  These further entries are left out while there are certificates to
    replace first.  Each of the enclaves ``perhaps_revoked`` that stays has an entry, too, and each
    of ``on_robots_only``, enclaves that the keystore lacks: robots may have made their keys.  If an
    identity CA was lost, an entry says so.

    Raises:
        KeystoreError: as `revoke`.
    """
    change = KeystoreChange(root, **options)
    with change:
        lists, known = change.revocation_lists(), revoked_serials(change.keystore)
        reasons = {
            f"{entry.serial:x}": entry.reason
            for crl in forgotten_lists.lists
            for entry in crl.revoked
            if entry.serial not in known
        }
        # A CA service knows its certificates, including those of other sites.
        unknown = (
            {} if change.identity.service else forgotten_lists.unknown_certificates(change.keystore)
        )
        reasons = _reasons_of_revoked(change, unknown) | reasons
        recorded = change.keystore.ledger_file.with_values("serial", reasons).entries
        issued = {
            entry.serial: entry
            for entry in (*recorded, *unknown.values())
            if entry.what == "certificate" and entry.serial in reasons
        }
        lost_revocations = {
            entry.enclave: reasons[serial]
            for serial, entry in sorted(issued.items())
            if reasons[serial] != SUPERSEDED and change.keystore.has_enclave(entry.enclave)
        }
        replaced_keys = _replaced_keys(issued, unknown, reasons)
        names = {enclave for enclave, _ in replaced_keys}
        # A restored keystore may have certified these keys again since then.
        for entry in change.keystore.ledger_file.with_values("enclave", names).entries:
            is_known = entry.serial in reasons or int(entry.serial or "0", 16) in known
            if (entry.enclave, entry.key) in replaced_keys and not is_known:
                reasons[entry.serial], issued[entry.serial] = SUPERSEDED, entry
        later_keys = [of.key for serial, of in unknown.items() if serial not in reasons]
        for entry in _vouched_certificates(change, forgotten_lists, issued, later_keys):
            reasons[entry.serial], issued[entry.serial] = SUPERSEDED, entry
            replaced_keys.add((entry.enclave, entry.key))
        _check_names(change, tuple(lost_revocations))
        # Certificates from after the backup that no list has are good, as of a robot's new key.
        shown = change.known.certificates_shown_after_restore(lost_revocations)
        good = {entry.serial for entry in shown}.difference(reasons)
        revocations = [
            entry
            for name, reason in lost_revocations.items()
            for entry in lists.revocations({name: _move_to_revoked(change, name)}, reason)
            if entry.serial not in good
        ]
        done = {entry.serial for entry in revocations}
        for serial, reason in reasons.items():
            if serial not in done:
                # This entry names no enclave, because the enclave may have another certificate
                # here.
                entry = Entry(iso(change.now), "revocation", serial=serial, reason=reason)
                of = issued.get(serial)
                if of and (reason != SUPERSEDED or (of.enclave, of.key) in replaced_keys):
                    entry = entry._replace(subject=of.subject, key=of.key)
                    if serial in unknown:
                        entry = entry._replace(enclave=of.enclave, not_after=of.not_after)
                revocations.append(entry)
        gone = frozenset(lost_revocations)
        # A release that was published while the clock was ahead can have an even higher number.
        least = max(int(change.now.timestamp()), forgotten_lists.later_number)
        number = max(change.keystore.ledger_file.next_number(), least)
        revoked = known | {int(serial, 16) for serial in reasons}
        replaced = _key_revoked_by_enclave(change, revoked, {key for _, key in replaced_keys}, gone)
        mark = Entry(iso(change.now), RESTORED, number=number, reason=shown_by)
        named = sorted({*enclaves_with_named_rights} - gone) if not replaced else ()
        shows_restore = (
            shown_by
            or forgotten_lists.lists
            or reasons
            or perhaps_revoked
            or unknown.keys() - forgotten_lists.explained
        )
        marks = [
            mark,
            *(mark._replace(enclave=name) for name in named),
            *(
                mark._replace(enclave=name, reason=PERHAPS_REVOKED)
                for name in sorted({*perhaps_revoked} - gone)
            ),
            *(
                mark._replace(enclave=name, reason=ON_ROBOT_ONLY)
                for name in sorted({*on_robots_only})
            ),
            *([mark._replace(reason=LOST_CA)] if forgotten_lists.has_lost_ca else ()),
        ]
        change.entries = [*(marks if shows_restore else ()), *unknown.values()]
        if revocations or forgotten_lists.lists:
            change.restart = tuple(name for name in change.names if name not in gone)
            _, entries = lists.sign(
                revocations,
                change.restart,
                incomplete=True,
                least=max((crl.number for crl in forgotten_lists.lists), default=0) + 1,
            )
            change.entries += entries
        change.remarks += lists.remarks
        _drop_routers(change, gone)
        change.stage_zenoh({}, revoked_enclaves=gone)
        change.record()
        change.finish(command="revoke", revoked_before=revoked)
    if unknown:
        change.notes.append(_unknown_note(change, unknown))
    change.notes += _validity_notes(change, unknown)
    change.notes += _replaced_notes(change, replaced)
    outcomes = dict.fromkeys(lost_revocations, "revoked") | dict.fromkeys(replaced, "replaced")
    return change.result(RestoredRevocations, outcomes=outcomes, replaced=replaced)


def _replaced_keys(
    issued: Mapping[str, Entry], unknown: Mapping[str, Entry], reasons: Mapping[str, str]
) -> set[tuple[str, str]]:
    """Return (enclave, key) of each ``issued`` certificate that was replaced together with its key.

    ``unknown`` are certificates that were issued after the backup.  Such a certificate is valid
    unless its serial number is in ``reasons``, which maps revoked serial numbers to reasons. The
    keys of valid certificates are left out.
    """
    kept = {
        (entry.enclave, entry.key) for serial, entry in unknown.items() if serial not in reasons
    }
    replaced = {
        (entry.enclave, entry.key)
        for serial, entry in issued.items()
        if reasons[serial] == SUPERSEDED
    }
    return {(enclave, key) for enclave, key in replaced - kept if key}


def _vouched_certificates(
    change: KeystoreChange,
    forgotten_lists: LostRecords,
    issued: Mapping[str, Entry],
    later_keys: Iterable[str],
) -> Iterator[Entry]:
    """Yield later certificates for keys that a revoked key vouched for.

    The keystore issued these certificates after the date on which a lost list revoked an ``issued``
    certificate of the same enclave.  The key of that certificate vouched for the first of the later
    keys (`sros_tool.keystore.delivery.collect`).  Two kinds of keys are left out: keys in the
    keystore, and keys that were certified before the keystore was lost.  ``later_keys`` are such
    keys that the ledger lacks.
    """
    dates = {f"{e.serial:x}": iso(e.date) for crl in forgotten_lists.lists for e in crl.revoked}
    since: dict[str, str] = {}
    for serial in issued.keys() & dates.keys():
        name = issued[serial].enclave
        since[name] = min(dates[serial], since.get(name, dates[serial]))
    shown = change.known.certificates_shown_after_restore(since)
    others = {"", *later_keys, *(entry.key for entry in (*issued.values(), *shown))}
    for name in since:
        with suppress(SrosError):  # the enclave does not exist, or a file of it is broken
            if has_key(change.keystore.folder(name)):
                others.add(key_digest(change.keystore.certificate_of(name).public_key()))  # type: ignore[arg-type]
    for entry in change.keystore.ledger_file.with_values("enclave", since).entries:
        if entry.what == "certificate" and entry.enclave in since and entry.key not in others:
            if entry.time > since[entry.enclave]:
                yield entry
            else:
                others.add(entry.key)


def _key_revoked_by_enclave(
    change: KeystoreChange, revoked: Container[int], keys: Container[str], removed: Container[str]
) -> dict[str, bool]:
    """Map the enclaves that keep a ``revoked`` certificate to whether their key is revoked, too.

    ``keys`` are digests of keys that are revoked now; enclaves in ``removed`` are left out.
    """
    replaced = {}
    for name in change.names:
        with suppress(SrosError):  # the enclave has no certificate
            certificate = change.keystore.certificate_of(name)
            if name not in removed and certificate.serial_number in revoked:
                key = key_digest(certificate.public_key())  # type: ignore[arg-type]
                replaced[name] = key in keys or change.known.is_revoked(key)
    return replaced


def _replaced_notes(change: KeystoreChange, replaced: Mapping[str, bool]) -> Iterator[Note]:
    """Yield a note on the ``replaced`` certificates and keys, as in `RestoredRevocations`."""
    root = quote(str(change.root))
    on_robots = {
        name
        for name, is_key in replaced.items()
        if is_key and key_on_robot(change.keystore.folder(name))
    }
    commands = [
        f"`sros renew {root} {' '.join(map(quote, names))}{options}`"
        for is_key_revoked, options in ((False, ""), (True, " --new-key --revoke-old"))
        if (names := [n for n in replaced if replaced[n] is is_key_revoked and n not in on_robots])
    ]
    steps = [f"Give the others new certificates: run {' and '.join(commands)}."] if commands else []
    if on_robots:
        steps.append(keys_on_robots_remedy(change.root, sorted(on_robots)))
    if steps:
        yield Note(
            REPLACED_AFTER_BACKUP,
            f"after the backup, the certificates of {first_few(tuple(replaced), _MOST_SHOWN)} were "
            "replaced and revoked, and the keystore has only the revoked certificates. Revoke "
            f"robots that were stolen (`sros revoke {root} --robot NAME`). {' '.join(steps)}",
        )


def _reasons_of_revoked(change: KeystoreChange, unknown: Mapping[str, Entry]) -> dict[str, str]:
    """Map the serial numbers of revoked enclaves' certificates to the reasons for revocation."""
    enclaves = {entry.enclave for entry in unknown.values()}
    reasons = {
        entry.enclave: entry.reason
        for entry in change.keystore.ledger_file.with_values("enclave", enclaves).entries
        if entry.what == "revocation" and entry.reason != SUPERSEDED
    }
    gone = change.known.enclaves_revoked_before(enclaves)
    return {
        serial: reasons.get(entry.enclave, "unspecified")
        for serial, entry in unknown.items()
        if entry.enclave in gone and not change.keystore.has_enclave(entry.enclave)
    }


def _validity_notes(change: KeystoreChange, unknown: Mapping[str, Entry]) -> Iterator[Note]:
    """Yield a note if the settings give another validity than the last later certificate has.

    Then the setting was probably changed after the backup.  Later certificates are ``unknown``, or
    became known since the last publication, as in a run that was refused.  Certificates that expire
    with their CA show nothing.
    """
    published = max((entry.time for entry in change.keystore.entries_of("release")), default="")
    shown = change.known.certificates_shown_after_restore(change.names)
    later = [*unknown.values(), *(entry for entry in shown if entry.time > published)]
    if not later:
        return
    last = max(later, key=lambda entry: entry.not_before)
    setting = change.template.certificate_validity
    ends = {iso(validity_of(ca).not_after) for ca in change.keystore.authority(IDENTITY)}
    if not isinstance(setting, timedelta) or last.not_after in ends:
        return
    longest = change.template.longest_validity(last.enclave)
    present = setting if longest is None else min(setting, longest)
    lifetime = Window(parse_iso(last.not_before), parse_iso(last.not_after)).lifetime()
    if abs(lifetime - present) > _CLEAR_DIFFERENCE:
        yield Note(
            "fleet.settings-restored",
            f"the last certificate from after the backup, of {last.enclave}, is valid for "
            f"{duration_text(lifetime)}; a new one would be valid for {duration_text(present)}. So "
            f"settings were probably changed after the backup: compare '{change.root / SETTINGS}' "
            "with the settings that you want, and change them before you renew certificates "
            f"(`sros update_keystore {quote(str(change.root))} --set KEY=VALUE`).",
        )


def _unknown_note(change: KeystoreChange, unknown: Mapping[str, Entry]) -> Note:
    """Return a note on certificates that are recorded now, or would be without ``dry_run``."""
    has = "would have" if change.dry_run else "has"
    text = (
        f"the keystore issued {counted(len(unknown), 'certificate')} that its ledger lacks: the "
        f"keystore was restored from a backup, or is a copy. The ledger {has} each certificate "
        "again, so that `sros revoke` can revoke it"
    )
    revoked = {entry.serial for entry in change.entries if entry.what == "revocation"}
    valid = sorted({entry.enclave for entry in unknown.values() if entry.serial not in revoked})
    if missing := [name for name in valid if not change.keystore.has_enclave(name)]:
        text += (
            f". The keystore lacks {first_few(missing, _MOST_SHOWN)}, whose certificates stay "
            f"valid. {lacking_enclaves_remedy(change.root)}"
        )
    unknowing = change.known.made_unknowing({*valid, *change.names}, unknown.values())
    if others := sorted({*unknowing.values()}):
        text += (
            f". Robots have other keys for {first_few(others, _MOST_SHOWN)} than the keystore. "
            + other_keys_remedy(change.root, others).removesuffix(".")
        )
    return Note("fleet.certificates-restored", f"{text}.")


def restored_list_note(restored: Changed, holders: str) -> Note:
    """Return a note on the lists from which `restore_revocations` revoked certificates again.

    ``holders`` is a subject with its verb that says who has the lists, such as "r1 and r2 have".
    """
    verb = "would be revoked again" if restored.dry_run else "is revoked again"
    text = (
        f"{holders} a revocation list that the keystore signed but no longer has: the keystore "
        f"was restored from a backup, or is a copy. Everything on the list {verb}"
    )
    if again_revoked := restored.names("revoked"):
        text += f", including {first_few(again_revoked, _MOST_SHOWN)}"
    return Note(REVOKED_AGAIN, f"{text}.")


def refresh_crl(
    root: Path,
    *,
    crl: bytes = b"",
    **options: Unpack[ChangeOptions],
) -> Changed:
    """Sign the revocation list again, so that it is valid for longer.

    The entries are kept, except certificates that expired before the present list was signed.  If
    the identity CA is a CA service, ``crl`` is its new list (PEM), which replaces the present list.
    For any other identity CA, ``crl`` is a list that was lost with a keystore; the certificates on
    it are revoked again.

    Raises:
        KeystoreError: no identity CA of the keystore signed ``crl``; or as `revoke`.
    """
    keystore = OpenedKeystore(root)
    keyring = options.get("keyring", IN_KEYSTORE)
    if crl and not keyring.ca_service(root, IDENTITY, keystore.template):
        lost, forgotten = load_crls(crl, "that was given"), LostRecords(keystore, options["now"])
        authorities = keystore.authority(IDENTITY)
        if not any(signed_by(each.list, ca) for each in lost for ca in authorities):
            raise KeystoreError(
                "no identity CA of the keystore signed the revocation list that was given",
                "Whoever wrote it could revoke any certificate. Nothing was changed.",
                "Give a list of this keystore, such as crl.pem of a robot.",
            )
        if forgotten.add(crl):
            return restore_revocations(root, forgotten, **options)
        crl = b""  # the keystore already has everything on this list
    change = KeystoreChange(root, **options)
    change.crl = crl
    with change:
        lists = change.revocation_lists()
        if keystore.revocation_lists or crl:  # a first list without revocations changes nothing
            change.restart = change.names
        next_update, change.entries = lists.sign((), change.names, incomplete=True)
        change.remarks += lists.remarks
        change.record()
        change.finish(command="sign the list")
    return change.result(Revocation, next_update=next_update)


def _check_names(change: KeystoreChange, names: Sequence[str]) -> None:
    """Raise an error unless all ``names`` are enclaves, and none is the Zenoh router."""
    router = change.template.zenoh.router if change.template.zenoh else None
    for name in names:
        check_enclave_name(name)
        exists = change.keystore.has_enclave(name)
        if name == router and exists:
            raise _router_error(change, name)
        if not exists:
            raise missing_enclave_error(change.keystore, name, change.names, may_create=False)


def _drop_routers(change: KeystoreChange, revoked: Collection[str]) -> None:
    """Remove routers from the settings of the Zenoh network if their enclaves are ``revoked``."""
    network = change.template.zenoh
    dropped = [router for router in network.routers if router.name in revoked] if network else []
    if network and dropped:
        left = tuple(router for router in network.routers if router not in dropped)
        change.set_network(replace(network, routers=left))
        names = ", ".join(router.name for router in dropped)
        is_or_are, them = (
            ("is no longer a router", "it")
            if len(dropped) == 1
            else ("are no longer routers", "them")
        )
        text = (
            f"{names} {is_or_are}. The enclaves that connected to {them} have new files, which "
            "name another router."
        )
        change.notes.append(Note("zenoh.router-revoked", text))


def _router_error(change: KeystoreChange, router: str) -> KeystoreError:
    where = quote(str(change.root))
    other = next(n for at in count(2) if (n := f"{router}{at}") not in change.names)
    return KeystoreError(
        f"{router} is the enclave of the Zenoh router, and cannot be revoked yet",
        "Without a router, no node on Zenoh finds the other nodes; and every session trusts the "
        "router's key.",
        f"Move the router first: `sros zenoh {where} --router {other}`. Stop the router in "
        f"{router}, start one in {other}, restart the processes that `sros zenoh` names, "
        f"and then revoke {router}.",
    )


def _move_to_revoked(change: KeystoreChange, name: str) -> Entry:
    """Stage the move of an enclave's files to ``revoked``; return the entry of its certificate.

    A folder that has only files of the enclave is moved as a whole, unless other users can read the
    key in it.
    """
    transaction, folder = change.transaction, enclave_folder(name)
    certificate = change.keystore.certificate_of(name)
    if not issued_by(certificate, change.identity.certificate):
        raise KeystoreError(
            f"the certificate of enclave {name} was not issued by the identity CA of this keystore",
            "Only the CA that issued a certificate can revoke it.",
            "Revoke the enclave in the keystore of that CA, or restore the right certificate.",
        )
    target = f"{REVOKED}/{certificate.serial_number:x}"
    with os.scandir(transaction.root / folder) as entries:
        by_name = {entry.name: entry for entry in entries}
    links = [file for file in _MOVED_FILES if file in by_name and by_name[file].is_symlink()]
    files = [file for file in _MOVED_FILES if file in by_name and file not in links]
    if (
        name != "/"
        and CERTIFICATE_FILE in files
        and len(files) + len(links) == len(by_name)
        and all(by_name[file].is_file() for file in files)
        and not (_PRIVATE_FILE in files and by_name[_PRIVATE_FILE].stat().st_mode & 0o077)
        and not os.path.lexists(transaction.root / target)
    ):
        transaction.move_folder(folder, target, files, links)
        return certificate_entry(change.now, "certificate", certificate, name)
    for file in _MOVED_FILES:
        path = f"{folder}/{file}"
        if name == "/" and file == "governance.p7s":
            continue  # the folder of the enclave / has the governance of the keystore
        if file not in by_name:
            continue
        if file not in links:
            known = file == CERTIFICATE_FILE
            place = transaction.root / path
            data = change.keystore.read(place, file) if known else transaction.read(path)
            transaction.write(f"{target}/{file}", data, private=file == _PRIVATE_FILE)
        transaction.remove(path)
    return certificate_entry(change.now, "certificate", certificate, name)
