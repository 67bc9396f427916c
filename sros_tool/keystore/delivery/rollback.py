"""Detection of rollbacks: files that take a robot back to earlier CAs, revocation lists or keys.

Signatures and numbers do not show a rollback: a keystore that was restored from a backup signs as
before, and may meanwhile have given higher numbers than the lost one.  Files of another keystore
are refused, too.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.delivery.archive import SUFFIXES
from sros_tool.keystore.known_keys import known_expiries
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    ENCLAVES,
    IDENTITY,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    LIST_FILES,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    REQUEST,
    enclave_folder,
    has_key,
    search_enclaves,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import is_ca_service
from sros_tool.pki.certificates import (
    authority_text,
    digest,
    key_digest_of_ca,
    load_certificate,
    load_certificates,
    load_request,
    pem,
    validity_of,
)
from sros_tool.pki.crl import Revocations, newest_revocations
from sros_tool.pki.keys import PublicKey, load_enclave_key
from sros_tool.validity import iso
from sros_tool.wording import counted, serial_text
from sros_tool.xml import read_bytes

_ANSWER_AGAIN = (
    "Sign the request.pem in the enclave's folder with `sros sign_request --renew`, and send the "
    "answer to the robot."
)
ROLES_OF_FILES = {IDENTITY_CA_FILE: IDENTITY, PERMISSIONS_CA_FILE: PERMISSIONS}


# ── lists and CAs of one enclave ───────────────────────────────────────────────────────────


def retired_authorities(
    trusted: Sequence[x509.Certificate], sent: Iterable[x509.Certificate]
) -> list[x509.Certificate]:
    """Return the CAs in ``sent`` that a later CA in ``trusted`` replaced, by key and date."""
    keys = {key_digest_of_ca(authority) for authority in trusted}
    newest = max((validity_of(authority).not_before for authority in trusted), default=None)
    return [
        authority
        for authority in sent
        if newest
        and validity_of(authority).not_before < newest
        and key_digest_of_ca(authority) not in keys
    ]


def older_list(
    present: Mapping[str, bytes], sent: Mapping[str, bytes]
) -> tuple[Revocations, Revocations] | None:
    """Return a CA's revocation lists in ``present`` and in ``sent`` if the sent list is older.

    The result is None if no sent list is older.

    ``present`` and ``sent`` map names of an enclave's files to content.  A sent list with the same
    number but other revocations also counts as older.
    """
    for here, new in _list_pairs(present, sent):
        if here != new and here.number >= new.number:
            return here, new
    return None


def lost_serials(present: Mapping[str, bytes], sent: Mapping[str, bytes]) -> frozenset[int]:
    """Return the serial numbers on lists in the ``present`` files that lists in ``sent`` lack."""
    return frozenset[int]().union(
        *(here.serials - new.serials for here, new in _list_pairs(present, sent))
    )


def _list_pairs(
    present: Mapping[str, bytes], sent: Mapping[str, bytes]
) -> Iterator[tuple[Revocations, Revocations]]:
    """Yield two lists for each CA that the ``sent`` files trust: the present one and the sent one.

    ``present`` and ``sent`` are as in `older_list`.  In a rotation, the list of the second CA is in
    the file of the CAs.
    """
    with suppress(SrosError):  # damaged files change no enclave
        for authority in load_certificates(sent.get(IDENTITY_CA_FILE, b""), IDENTITY_CA_FILE):
            here, new = (
                newest_revocations(pem(authority), *(files.get(file, b"") for file in LIST_FILES))
                for files in (present, sent)
            )
            yield here, new


# ── an export to an existing folder ────────────────────────────────────────────────────────


def check_rollback(
    keystore: OpenedKeystore,
    target: Path,
    present: Mapping[str, bytes],
    files: Mapping[str, bytes],
    now: datetime,
) -> None:
    """Raise `KeystoreError` if an export would undo a revocation or a rotation in ``target``.

    An export is also refused if enclaves in ``target`` trust only CAs of another keystore.
    ``present`` maps paths in ``target`` to the content of files, including all CAs and lists;
    ``files`` are the files of the export in the same form.
    """
    if later := _later_authorities(keystore, present, files):
        path, authority = next(iter(later.items()))
        role = ROLES_OF_FILES[path.rpartition("/")[2]]
        raise KeystoreError(
            f"'{target / path}' has a later {role} CA than the keystore's",
            f"Its CA is {authority_text(authority)}, and the keystore's CA is "
            f"{_first_authority(files, path)}: the robot would trust the earlier CA again, and "
            "certificates that were revoked since its replacement. Nothing was changed.",
            "The keystore may come from a backup (docs/howto/keystore_is_lost.md says how to go "
            "on), or the files in the folder are of another keystore. If the keystore's CA is "
            f"right, first {_removal_remedy(target, later)}",
        )
    if foreign := _foreign_authorities(keystore, present, files):
        path, authority = next(iter(foreign.items()))
        raise KeystoreError(
            f"'{target / path}' has only CAs that are neither in the keystore nor in its ledger",
            f"Its CA is {authority_text(authority)}, and the keystore's CA is "
            f"{_first_authority(files, path)}: the robot could no longer communicate with "
            "other robots of its keystore, and would lose its revocation list. Nothing was "
            "changed.",
            f"Export from the keystore that issued these files. If '{keystore.root}' is the right "
            "keystore, because it replaces a lost keystore (docs/howto/keystore_is_lost.md) or its "
            "ledger lacks a rotation, first "
            f"{_removal_remedy(target, foreign)}",
        )
    if lost := _lost_revocations(keystore, present, files, now):
        path, (what, why) = next(iter(lost.items()))
        file = "FILE" if target.name.endswith(SUFFIXES) else quote(str(target / path))
        raise KeystoreError(
            f"'{target / path}' {what}",
            f"{why}: revoked enclaves would be trusted again. Nothing was changed.",
            "The keystore may come from a backup: docs/howto/keystore_is_lost.md says what to do, "
            f"and `sros crl {quote(str(keystore.root))} --refresh --crl {file}` revokes the same "
            "certificates "
            f"again. If the keystore's list is right, export all enclaves of the folder, but first "
            f"{_removal_remedy(target, lost)}",
        )


def trust_files_in(target: Path, files: Mapping[str, bytes]) -> dict[str, bytes]:
    """Map the paths of CA files and revocation lists in a folder to their content.

    These are the files of all enclaves in the folder, and the files at the paths of ``files``.
    """
    folders = {path.rpartition("/")[0] for path in files}
    if (target / ENCLAVES).is_dir():
        folders.update(map(enclave_folder, search_enclaves(target)[0]))
    paths = (
        f"{at}/{file}" for at in sorted(folders) for file in (*LIST_FILES, PERMISSIONS_CA_FILE)
    )
    return {path: data for path in paths if (data := _read_file(target / path))}


def _removal_remedy(target: Path, paths: Iterable[str]) -> str:
    if target.name.endswith(SUFFIXES):
        return f"remove the archive: `rm {quote(str(target))}`."
    files = " ".join(quote(str(target / path)) for path in paths)
    return f"remove these files: `rm {files}`."


def _first_authority(files: Mapping[str, bytes], path: str) -> str:
    return authority_text(load_certificates(files[path], path)[0])


def _foreign_authorities(
    keystore: OpenedKeystore, present: Mapping[str, bytes], files: Mapping[str, bytes]
) -> Mapping[str, x509.Certificate]:
    """Map paths of CA files in ``present`` to a CA in them, for enclaves of another keystore.

    An enclave is one of another keystore if none of its identity CAs and none of its permissions
    CAs is in the ledger or in ``files``.  If only one kind of CA is unknown, the keystore may be a
    backup from before that CA was replaced.
    """
    recorded = {entry.sha256 for entry in keystore.entries_of("ca")}
    trusted: dict[str, dict[str, Sequence[x509.Certificate]]] = defaultdict(dict)
    keys: set[str] = set()
    for path, data in files.items():
        folder, _, file = path.rpartition("/")
        if file in ROLES_OF_FILES:
            keys.update(map(key_digest_of_ca, load_certificates(data, path)))
            with suppress(SrosError):  # a damaged file trusts no CA
                trusted[folder][path] = load_certificates(present.get(path, b""), path)
    return {
        path: authorities[0]
        for of_enclave in trusted.values()
        if not any(
            digest(authority) in recorded or key_digest_of_ca(authority) in keys
            for authorities in of_enclave.values()
            for authority in authorities
        )
        for path, authorities in of_enclave.items()
    }


def _later_authorities(
    keystore: OpenedKeystore, present: Mapping[str, bytes], files: Mapping[str, bytes]
) -> Mapping[str, x509.Certificate]:
    """Map the paths of CA files in the target to a CA in them that replaced the keystore's CA.

    If there is such a CA, the keystore is from before a stage of a rotation.  ``present`` are the
    files in the target, ``files`` those of the export.  If the ledger has both CAs, their order
    there says which one is later.  A CA that is not in the ledger counts as later if it is at least
    as new as the newest CA in the file of the export.
    """
    entries = keystore.entries_of("ca")
    place_in_ledger = {entry.sha256: place for place, entry in enumerate(entries)}
    later: dict[str, x509.Certificate] = {}
    for path, data in files.items():
        if path.rpartition("/")[2] not in ROLES_OF_FILES or present.get(path) in (data, None):
            continue
        sent = load_certificates(data, path)
        newest = max(validity_of(authority).not_before for authority in sent)
        with suppress(SrosError):  # a damaged file trusts no CA
            trusted = load_certificates(present[path], path)
            keys, kept = set(map(key_digest_of_ca, trusted)), set(map(key_digest_of_ca, sent))
            added = [
                place_in_ledger.get(digest(authority), len(entries))
                for authority in sent
                if key_digest_of_ca(authority) not in keys
            ]
            for authority in trusted:
                place = place_in_ledger.get(digest(authority))
                if (
                    any(place > other for other in added)
                    if place is not None
                    else key_digest_of_ca(authority) not in kept
                    and validity_of(authority).not_before >= newest
                ):
                    later[path] = authority
    return later


def _lost_revocations(
    keystore: OpenedKeystore,
    present: Mapping[str, bytes],
    files: Mapping[str, bytes],
    now: datetime,
) -> Mapping[str, tuple[str, str]]:
    """Map paths of lists in ``present`` to evidence that the keystore's list is older.

    The evidence is two texts: what the list in the folder is or does, and why.

    The lists of all enclaves in the folder are compared, because a new enclave does not have a list
    yet.  A list counts only if a CA in ``files`` signed it.  The list of the same CA in ``files``
    must have at least the same number. That list must also have every certificate of the list here,
    with two exceptions: certificates that have expired according to the ledger, and certificates of
    a CA service, which knows more certificates than the ledger.
    """
    places: dict[bytes, list[str]] = defaultdict(list)
    for path, data in present.items():
        if path.rpartition("/")[2] in LIST_FILES:
            places[data].append(path)
    sources = dict.fromkeys(
        (data, files.get(f"{path.removesuffix(IDENTITY_CA_FILE)}{CRL_FILE}", b""))
        for path, data in files.items()
        if path.endswith(f"/{IDENTITY_CA_FILE}")
    )
    lost: dict[str, tuple[str, str]] = {}
    for source in sources:
        for authority in load_certificates(source[0], IDENTITY_CA_FILE):
            sent = newest_revocations(pem(authority), *source)
            for data, paths in places.items():
                there = newest_revocations(pem(authority), data)
                missing = there.serials - sent.serials
                expiries = known_expiries(keystore, missing)
                lacking = [s for s in missing if expiries.get(s, iso(now)) >= iso(now)]
                if there.number > sent.number:
                    has = "no list" if sent.number < 0 else f"the number {sent.number}"
                    shown = (
                        "is a newer revocation list than the keystore's",
                        f"It has the number {there.number}; the keystore has {has}",
                    )
                elif lacking and not is_ca_service(keystore.template.identity_key):
                    shown = (
                        f"revokes {counted(len(lacking), 'certificate')} that the keystore's "
                        "revocation list lacks",
                        "The certificate with the serial number "
                        f"{serial_text(min(lacking))} has perhaps not expired yet",
                    )
                else:
                    continue
                lost |= dict.fromkeys(paths, shown)
    return lost


def check_own_keys(target: Path, files: Mapping[str, bytes]) -> None:
    """Raise `KeystoreError` if a certificate does not belong to the key that stays in ``target``.

    If the key is on a token, the signing request has the public key.
    """
    for path, data in files.items():
        folder, _, file = path.rpartition("/")
        token_file = files.get(f"{folder}/{KEY_URI_FILE}", b"")
        if (
            file != CERTIFICATE_FILE
            or f"{folder}/{KEY_FILE}" in files
            or (token_file and token_file != _read_file(target / folder / KEY_URI_FILE))
        ):
            continue
        key: object = None
        with suppress(SrosError):  # the key is not in the folder, or is damaged
            key = public_key_of(target / folder, folder) if has_key(target / folder) else None
        if key and key != load_certificate(data, path).public_key():
            raise KeystoreError(
                f"the certificate is not for the key in '{target / folder}'",
                "No process would start with it. Perhaps the keystore comes from a backup, and "
                "knows only an earlier key. Nothing was changed.",
                f"{_ANSWER_AGAIN} If the keystore's certificate is right, remove the key first.",
            )


def public_key_of(place: Path, name: str) -> PublicKey:
    """Return the public key of an enclave, from its key file or its signing request in ``place``.

    A key on a token has no file, but it signed the request.

    Raises:
        SrosError: both are missing, or the file cannot be read.
    """
    path = place / KEY_FILE
    if path.exists():
        return load_enclave_key(read_bytes(path, "private key"), f"'{path}'").public_key()
    request = load_request(read_bytes(place / REQUEST, "signing request"), f"of enclave {name}")
    return request.public_key


def _read_file(path: Path) -> bytes:
    return read_bytes(path, "file") if path.is_file() else b""
