"""The security folder on a robot: making signing requests, and installing the answers."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from shlex import quote
from typing import Annotated, NamedTuple

from cryptography import x509

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import DocumentError, KeystoreError, Note, PkiError, SrosError, UsageError
from sros_tool.files import write_new_file
from sros_tool.keystore.confirmation import OF_ANOTHER_KEY
from sros_tool.keystore.delivery.archive import listed_digests, unpack
from sros_tool.keystore.delivery.rollback import (
    lost_serials,
    older_list,
    public_key_of,
    retired_authorities,
)
from sros_tool.keystore.issuing.acceptance import refuse_stopping_nodes
from sros_tool.keystore.issuing.authority import Authority
from sros_tool.keystore.issuing.keyring import no_secrets
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    ENCLAVES,
    IDENTITY,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    LIST_FILES,
    OPTIONAL_FILES,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PRIVATE,
    PUBLIC,
    REQUEST,
    REQUIRED_FILES,
    SEAL,
    ZENOH_FILES,
    ZENOH_SIGNED,
    enclave_folder,
    has_key,
    refuse_flat_keystore,
)
from sros_tool.keystore.lifecycle.change import Changed
from sros_tool.keystore.lifecycle.shown import shown
from sros_tool.keystore.outcomes import (
    AuthorityFacts,
    EnclaveResult,
    changes_below,
    trusted_authorities,
)
from sros_tool.keystore.participant import evaluate_enclave
from sros_tool.keystore.reader import (
    OpenedEnclave,
    OpenedKeystore,
    open_enclave,
    read_certificate,
    weaknesses,
)
from sros_tool.keystore.transaction import Change, Transaction, recover_keystore
from sros_tool.keystore.zenoh_files import open_zenoh
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    authority_text,
    common_name_of,
    digest,
    fingerprints,
    key_digest,
    load_certificates,
    load_request,
    make_request,
    subject_text,
    validity_of,
)
from sros_tool.pki.crl import SUPERSEDED, load_crl
from sros_tool.pki.keys import PrivateKey, PublicKey, generate_key, key_pem, load_enclave_key
from sros_tool.pki.token import (
    Secrets,
    TokenKey,
    TokenUri,
    make_enclave_key,
    open_enclave_key,
    place_in_file,
    token_file_content,
    token_notes,
    token_places,
)
from sros_tool.validity import iso
from sros_tool.values import DryRun, FileChanges, Notes, Words
from sros_tool.wording import counted, serial_text
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class NewRequest:
    """A new signing request for the enclave ``name``; ``key`` is the SHA-256 of its public key.

    ``token`` is the place of the key on a PKCS#11 token; None for a key in a file.
    """

    name: str
    file: Path
    key: str
    token: TokenUri | None = None


@dataclass(frozen=True, slots=True)
class NewRequests:
    """New signing requests, and the changes of the folder on the robot."""

    requests: tuple[NewRequest, ...]
    changes: tuple[Change, ...]
    notes: tuple[Note, ...]


def create_requests(
    folder: Path,
    names: Sequence[str],
    *,
    again: bool = False,
    key: str = "",
    secrets: Secrets = no_secrets,
    dry_run: bool = False,
) -> NewRequests:
    """Create the private keys of enclaves in ``folder``, and signing requests for the keys.

    ``folder`` becomes a keystore without CAs.  Either all requests are made, or none.  With
    ``again``, they are made for the existing keys; a key is never replaced.  With ``key``, a
    ``pkcs11:`` URI, the keys are on a token: they are created there if they do not exist, and
    ``folder`` gets files with their URIs.  ``secrets`` returns the PIN.

    Raises:
        KeystoreError: an enclave has a key already (without ``again``), or a certificate without a
            key, or ``folder`` is a keystore with CAs.
        PkiError: the token cannot be used.
    """
    names = [*dict.fromkeys(check_enclave_name(name) for name in names)]
    places = token_places(key, names) if key else {}
    if again and key:
        raise UsageError(
            "--again and --key exclude each other",
            "With --again, the request is for the key that the enclave already has.",
            "Leave one of the two options out.",
        )
    if not dry_run and folder.is_dir():
        recover_keystore(folder)
    _refuse_ca_keystore(
        folder, f"Make the enclave with `sros create_enclave {quote(str(folder))} {names[0]}`."
    )
    requests: list[NewRequest] = []
    notes: list[Note] = []
    with Transaction(folder, new_keystore=True, dry_run=dry_run) as transaction:
        for name in names:
            place = enclave_folder(name)
            place_of_key = places.get(name)
            if again:
                made = _existing_key(folder / place, secrets)
            else:
                _refuse_existing_key(folder, name)
                made = _write_new_key(transaction, name, place_of_key, secrets)
            request = make_request(made, name)
            # This reports an unsupported kind of key now, and not later at the keystore.
            load_request(request, f"of enclave {name}")
            transaction.write(f"{place}/{REQUEST}", request)
            token = made.place if isinstance(made, TokenKey) else place_of_key
            file = folder / place / REQUEST
            requests.append(NewRequest(name, file, key_digest(made.public_key()), token))
            notes += token_notes(made) if isinstance(made, TokenKey) else ()
        transaction.commit()
    return NewRequests(tuple(requests), tuple(transaction.changes), tuple(notes))


def _existing_key(enclave: Path, secrets: Secrets) -> PrivateKey:
    """Return the key in the folder of an enclave, or on the token that the folder names."""
    path, on_token = enclave / KEY_FILE, enclave / KEY_URI_FILE
    if on_token.exists() and not path.exists():
        return open_enclave_key(place_in_file(on_token), secrets)
    return load_enclave_key(read_bytes(path, "private key"), f"'{path}'")


def _refuse_existing_key(folder: Path, name: str) -> None:
    """Raise `KeystoreError` if a new key would make a key or certificate of the enclave useless."""
    enclave = folder / enclave_folder(name)
    if has_key(enclave):
        raise KeystoreError(
            f"enclave {name} already has a key in '{folder}'",
            "A key is never replaced, because its certificate would become useless.",
            "Add --again to make the request again for this key, or choose another folder.",
        )
    if (enclave / CERTIFICATE_FILE).exists():
        raise KeystoreError(
            f"enclave {name} has a certificate in '{folder}', but no key",
            "A new key would make the certificate useless.",
            "Restore the key, or choose another folder.",
        )


def _write_new_key(
    transaction: Transaction, name: str, place_of_key: TokenUri | None, secrets: Secrets
) -> PrivateKey:
    """Return the new key of an enclave, and stage its file; with a place, the key on the token."""
    place = enclave_folder(name)
    if place_of_key is None or transaction.dry_run:
        made: PrivateKey = generate_key()  # a dry run does not open the token
        if place_of_key is None:
            transaction.write(f"{place}/{KEY_FILE}", key_pem(made), private=True)
        else:
            transaction.write(f"{place}/{KEY_URI_FILE}", token_file_content(place_of_key))
        return made
    on_token = make_enclave_key(place_of_key, secrets)
    known = KnownKeys(OpenedKeystore(transaction.root))
    known.refuse_shared_key(on_token.public_key(), name, "Name another object of the token.")
    transaction.write(f"{place}/{KEY_URI_FILE}", on_token.file)
    return on_token


def read_pinned_cas(text: str) -> frozenset[str]:
    """Return the SHA-256 of the CA certificates that ``text`` pins, in lower-case hexadecimal.

    ``text`` is a SHA-256 fingerprint or the path of a certificate file.  Colons and capital letters
    are allowed, as in the output of ``openssl x509 -fingerprint -sha256``.

    Raises:
        UsageError: ``text`` is neither a fingerprint nor a certificate file.
    """
    plain = text.strip().rpartition("=")[2].replace(":", "").lower()
    if re.fullmatch(r"[0-9a-f]{64}", plain):
        return frozenset({plain})
    path = Path(text)
    if path.is_file():
        return fingerprints(read_bytes(path, "certificate"))
    raise UsageError(
        f"{text!r} is neither a certificate file nor a SHA-256 fingerprint",
        "A fingerprint has 64 hexadecimal digits.",
        "Copy the fingerprint that `sros sign_request` prints, or name the CA's certificate file.",
    )


def _trusted_certificates(folder: Path, file: str) -> list[x509.Certificate]:
    """Return the distinct certificates in all files named ``file`` of enclaves in ``folder``."""
    certificates: dict[str, x509.Certificate] = {}
    for path in sorted((folder / ENCLAVES).rglob(file)):
        if path.exists():
            certificates |= {
                digest(certificate): certificate for certificate in _certificates(path)
            }
    return list(certificates.values())


def check_same_authority(
    target: Path, files: Mapping[str, bytes], *, earlier: Collection[str] = ()
) -> None:
    """Check that the enclaves in ``target`` and the new files trust the same identity CA.

    Enclaves of two keystores in one folder could not communicate with each other.

    Args:
        target: the security folder of a robot.
        files: the content of the new files, by their paths relative to ``target``.
        earlier: the SHA-256 of CAs that the keystore of the new files has or had.

    Raises:
        KeystoreError: an enclave in ``target`` trusts none of the identity CAs in ``files``.
    """
    new_authorities: set[str] = set()
    for path, data in files.items():
        if path.endswith(f"/{IDENTITY_CA_FILE}"):
            new_authorities |= fingerprints(data)
    for ca_file in sorted((target / ENCLAVES).rglob(IDENTITY_CA_FILE)):
        if f"{ca_file.relative_to(target)}" in files or not ca_file.exists():
            continue
        present_authorities = _certificates(ca_file)
        if new_authorities.isdisjoint(map(digest, present_authorities)):
            replaced = any(digest(authority) in earlier for authority in present_authorities)
            whose = "that trust a replaced CA of this keystore"
            raise KeystoreError(
                f"'{target}' contains enclaves {whose if replaced else 'of another keystore'}",
                f"They trust {subject_text(present_authorities[0].subject)}, and could not "
                "communicate with the new enclaves.",
                "Export all enclaves of the folder together: add --robot NAME, or name all of "
                "them (with --keyless if their keys were made on the robot)."
                if replaced
                else "Choose another folder.",
            )


def _refuse_ca_keystore(folder: Path, remedy: str) -> None:
    """Raise `KeystoreError` if ``folder`` is a keystore with CAs, not a folder of a robot."""
    refuse_flat_keystore(folder)
    if (folder / PRIVATE).exists() or (folder / PUBLIC).exists():
        raise KeystoreError(
            f"'{folder}' is a keystore with CAs",
            "Signing requests and their answers belong in a folder on the robot.",
            remedy,
        )


def _certificates(path: Path) -> tuple[x509.Certificate, ...]:
    return load_certificates(read_bytes(path, "certificate"), f"'{path}'")


_OPTIONAL_ANSWER_FILES = (*OPTIONAL_FILES, *ZENOH_FILES)
_REQUIRED_ANSWER_FILES = tuple(file for file in REQUIRED_FILES if file != KEY_FILE)
_SIGN_REQUEST_AGAIN = "Have the request signed again, and import the new answer."
_SEAL_HEAD = re.compile(rb"sros answer 2\nnumber ([1-9][0-9]{0,12})\n")
"""Matches the first lines of a seal."""


@dataclass(frozen=True, slots=True)
class RequestAnswer:
    """The answer to a signing request: the files of an enclave, by path, without its key.

    ``seal`` is the signed list of the files (`SEAL`).  The list begins with the number of the
    answer, which is higher than the numbers of all earlier answers from the keystore.
    """

    name: str
    files: dict[str, bytes]
    seal: bytes

    def file(self, name: str) -> bytes | None:
        """Return the content of the enclave's file ``name``, such as ``cert.pem``, or None."""
        return self.files.get(f"{enclave_folder(self.name)}/{name}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportedEnclave(Changed):
    """The result of installing the answer to a signing request.

    ``changes`` is empty if the answer was already installed.  ``first`` says whether the folder
    trusted no CA before, so that the CAs of the answer could not be verified.  ``until`` is the
    first expiry of certificate and permissions.  ``restart`` has the name of the enclave if its
    running processes on Zenoh keep the old rules until they are restarted, and is empty otherwise.
    """

    name: str
    identity_ca: x509.Certificate
    permissions_ca: x509.Certificate
    first: bool
    until: datetime


def seal(files: dict[str, bytes], number: int, authority: Authority) -> bytes:
    """Return the file list of an answer as an S/MIME message signed by ``authority``.

    ``number`` is from `sros_tool.keystore.ledger.Ledger.next_number`.
    """
    head = f"sros answer 2\nnumber {number}\n".encode()
    return authority.sign(head + listed_digests(files), "the file list of the answer")


def _answer_number(message: bytes) -> int:
    """Return the number in a seal; 0 for a document that is no seal."""
    head = _SEAL_HEAD.match(smime.parse(message).text)
    return int(head[1]) if head else 0


def _read_answer(data: bytes) -> RequestAnswer:
    """Return the answer in an archive (``.tar.gz``), without verifying it.

    Raises:
        DocumentError: the archive is damaged, or has other content than the files of one enclave.
    """
    try:
        files = unpack(data)
        signed = files.pop(SEAL, b"")
        own = [path for path in files if path.endswith("/cert.pem")]
        if len(own) != 1 or not own[0].startswith(f"{ENCLAVES}/"):
            raise DocumentError("it is not the answer for one enclave")
        name = check_enclave_name(own[0].removeprefix(ENCLAVES).removesuffix("/cert.pem") or "/")
        folder = enclave_folder(name)
        welcome = {
            f"{folder}/{file}" for file in (*_REQUIRED_ANSWER_FILES, *_OPTIONAL_ANSWER_FILES)
        }
        if strange := sorted(files.keys() - welcome):
            raise DocumentError(f"it contains {strange[0]!r}, which does not belong to an answer")
        if missing := [file for file in _REQUIRED_ANSWER_FILES if f"{folder}/{file}" not in files]:
            raise DocumentError(f"it lacks {', '.join(missing)}")
        if not signed:
            raise DocumentError(f"it lacks {SEAL}")
    except SrosError as error:
        raise DocumentError(
            f"the answer cannot be used: {error.what}", error.why, _SIGN_REQUEST_AGAIN
        ) from error
    return RequestAnswer(name, files, signed)


def check_answer(answer: RequestAnswer, key: PublicKey, *, now: datetime) -> OpenedEnclave:
    """Return the enclave in an answer, after checking that DDS would load it.

    The Zenoh configurations in the answer must be signed and fit the permissions.  The certificate
    must be for ``key``, the public key of the enclave.

    Raises:
        PkiError: the answer has problems; the error lists all of them, such as a certificate for
            another key or enclave, an invalid chain or signature, an expired or revoked
            certificate, weak cryptography, or a file changed in transit.
    """
    files = {path.rpartition("/")[2]: data for path, data in answer.files.items()}
    state, problems = evaluate_delivered_files(answer.name, files, key, now=now)
    if state.permissions_ca and (problem := _answer_seal_problem(answer, [state.permissions_ca])):
        problems.append(f"{SEAL}: {problem}")
    if problems:
        raise PkiError(
            f"the answer for enclave {answer.name} is not valid",
            "; ".join(problems) + ".",
            _SIGN_REQUEST_AGAIN,
        )
    if weak := "; ".join(f"{file}: {text}" for file, text in weaknesses(state)):
        raise PkiError(
            f"the answer for enclave {answer.name} has weak cryptography",
            f"{weak}. Whoever forges such signatures can issue any identity or any permissions.",
            "Replace the CA with `sros rotate_ca`, and have the request signed again.",
        )
    return state


def evaluate_delivered_files(
    name: str, files: Mapping[str, bytes], key: PublicKey, *, now: datetime
) -> tuple[OpenedEnclave, list[str]]:
    """Return the enclave with the delivered files, and clauses on why it cannot be used.

    Args:
        name: the name of the enclave.
        files: the files by name, without the enclave's key.
        key: the public key of the enclave, which must be the key of the certificate.
        now: the time at which the enclave must be valid.
    """
    with tempfile.TemporaryDirectory(prefix="sros-") as folder:
        for file, data in files.items():
            write_new_file(Path(folder, file), data)
        opened = replace(open_enclave(Path(folder), now=now), key_on_robot=True)
        evaluation = evaluate_enclave(name, Path(folder), opened, moment=now)
        state = evaluation.state
        zenoh = open_zenoh(Path(folder), name, state)
    problems = list(evaluation.problems)
    if zenoh.files:
        problems += [str(fault) for fault in zenoh.problems if fault.file != CERTIFICATE_FILE]
    certificate = state.certificate
    if certificate and certificate.public_key() != key:
        problems.insert(0, f"{CERTIFICATE_FILE}: {OF_ANOTHER_KEY}")
    if certificate and common_name_of(certificate.subject) != name:
        problems.insert(0, f"cert.pem: it is for {subject_text(certificate.subject)}")
    return state, problems


def _answer_seal_problem(answer: RequestAnswer, authorities: Iterable[x509.Certificate]) -> str:
    """Return why no CA in ``authorities`` signed the file list of an answer; "" if one did."""
    try:
        signed = smime.parse(answer.seal)
    except SrosError as error:
        return str(error)
    head = _SEAL_HEAD.match(document := signed.text)
    if not head or document[head.end() :] != listed_digests(answer.files):
        return "the files differ from the signed list"
    return signed.problem_for(authorities)


def import_answer(
    folder: Path,
    data: bytes,
    *,
    now: datetime,
    pinned: frozenset[str] = frozenset(),
    force: bool = False,
    allow_refusal: Sequence[Vendor] = (),
    dry_run: bool = False,
) -> ImportedEnclave:
    """Install the answer to a request next to the enclave's key in ``folder``, whole or not at all.

    Args:
        data: the answer (``.tar.gz``).
        pinned: SHA-256 of permissions CAs; if not empty, one of these CAs must have signed the
            answer, also with ``force``.
        force: accept an answer that is older than the current files, or comes from other CAs.
        allow_refusal: vendors whose nodes of the enclave may stop working.

    Raises:
        DocumentError: ``data`` is not an answer.
        PkiError: the answer is not valid, see `check_answer`.
        KeystoreError: the key is missing, was revoked or is the key of another enclave; the answer
            is accepted only with ``force``; no vendor would accept the enclave; or a vendor that
            accepts it today would no longer do so.
    """
    answer = _read_answer(data)
    name = answer.name
    place = folder / enclave_folder(name)
    if not dry_run and folder.is_dir():
        recover_keystore(folder)
    _refuse_ca_keystore(folder, "Name the folder in which the request was made.")
    if not has_key(place):
        raise KeystoreError(
            f"'{folder}' has no key of enclave {name}",
            "An answer is installed next to the key, in the folder where the request was made.",
            f"Name that folder, or make a new key and request with `sros create_request {name} "
            f"{folder}`, and have the request signed.",
        )
    ran = any((place / file).exists() for file in ZENOH_SIGNED)
    with Transaction(folder, dry_run=dry_run) as transaction:
        key = public_key_of(place, name)
        state = check_answer(answer, key, now=now)
        assert state.certificate and state.identity_ca and state.permissions_ca
        until = state.valid_until()
        assert until
        _check_pinned(answer, state.identity_ca, state.permissions_ca, pinned)
        _check_enclave_key(folder, answer, key)
        known = _trusted_certificates(folder, "permissions_ca.cert.pem")
        if not force:
            _check_known_authority(folder, answer, known)
            _check_newer(place, answer, state.certificate)
        seal_path = f"{enclave_folder(name)}/{SEAL}"
        for path, content in {**answer.files, seal_path: answer.seal}.items():
            present = folder / path
            if not present.is_file() or read_bytes(present, "file") != content:
                transaction.write(path, content)
        for file in _OPTIONAL_ANSWER_FILES:
            if answer.file(file) is None and (place / file).exists():
                transaction.remove(f"{enclave_folder(name)}/{file}")
        notes = (
            *_lost_revocation_notes(place, answer),
            *refuse_stopping_nodes(
                transaction, now, allowed=allow_refusal, remedy=lambda: _SIGN_REQUEST_AGAIN
            ),
        )
        transaction.commit()
    changes = transaction.changes
    other_rules = ran and any(Path(change.path).name in ZENOH_SIGNED for change in changes)
    return ImportedEnclave(
        root=folder,
        dry_run=dry_run,
        outcomes={name: "imported" if changes else "kept"},
        changes=changes,
        restart=(name,) if other_rules else (),
        notes=notes,
        name=name,
        identity_ca=state.identity_ca,
        permissions_ca=state.permissions_ca,
        first=not known,
        until=until,
    )


def _check_pinned(
    answer: RequestAnswer,
    identity_ca: x509.Certificate,
    permissions_ca: x509.Certificate,
    pinned: frozenset[str],
) -> None:
    """Raise `KeystoreError` unless the permissions CA that signed an answer is pinned.

    A pinned identity CA is not enough, because it signs only the certificate: an attacker could
    add other permissions and another governance.  Without ``pinned``, any CA is accepted.
    """
    if not pinned or digest(permissions_ca) in pinned:
        return
    why = (
        f"It is signed by {subject_text(permissions_ca.subject)}, SHA-256 {digest(permissions_ca)}."
    )
    remedy = "Ask for the SHA-256 that `sros sign_request` printed. Nothing was changed."
    if digest(identity_ca) in pinned:
        why = "The pinned CA is the answer's identity CA, which signs only the certificate."
        remedy = "Pin the permissions CA, which signs the whole answer. Nothing was changed."
    raise KeystoreError(
        f"the answer for enclave {answer.name} is not signed by the pinned CA", why, remedy
    )


def _check_enclave_key(folder: Path, answer: RequestAnswer, key: PublicKey) -> None:
    """Raise `KeystoreError` if the answer revokes ``key``, or if another enclave here has it."""
    remedy = f"Make a new key with `sros create_request {answer.name}` in another folder."
    path = folder / enclave_folder(answer.name) / "cert.pem"
    present = read_certificate(path) if path.exists() else None
    if not present or present.public_key() != key:
        KnownKeys(OpenedKeystore(folder)).refuse_shared_key(key, answer.name, remedy)
        return
    crl = answer.file("crl.pem")
    for revoked in load_crl(crl, "of the answer").revoked if crl else ():
        if revoked.serial == present.serial_number and revoked.reason != SUPERSEDED:
            raise KeystoreError(
                f"the key of enclave {answer.name} was revoked",
                "The answer has a certificate for this key, but its revocation list revokes "
                f"'{path}'.",
                remedy,
            )


def _check_known_authority(
    folder: Path, answer: RequestAnswer, known: list[x509.Certificate]
) -> None:
    """Raise `KeystoreError` unless a CA in ``known`` signed the answer.

    ``known`` are the permissions CAs that ``folder`` trusts; if empty, any CA is accepted.
    """
    if known and (problem := _answer_seal_problem(answer, known)):
        raise KeystoreError(
            f"the answer for enclave {answer.name} is not from a CA that this robot trusts",
            f"The permissions CA that '{folder}' trusts has not signed it: {problem.rstrip('.')}. "
            "Either the CA was replaced after the last answer, or this answer is from another "
            "keystore.",
            "If the CA was replaced, export all enclaves of the robot: `sros distribute_key "
            "KEYSTORE --robot NAME FOLDER --force` (without a fleet: ENCLAVE... and --keyless in "
            "place of --robot NAME). To move this robot to another keystore, add --force.",
        )
    check_same_authority(folder, answer.files)


def _check_newer(enclave_dir: Path, answer: RequestAnswer, certificate: x509.Certificate) -> None:
    """Raise `KeystoreError` if the answer is older than the installed files, as in a replay."""
    remedy = "Have the request signed again, or add --force to go back to the older answer."
    path = enclave_dir / "cert.pem"
    numbered = _check_number(enclave_dir / SEAL, answer, remedy)
    if path.exists() and not numbered:
        old = validity_of(read_certificate(path))
        new = validity_of(certificate)
        if new.not_before < old.not_before:
            raise KeystoreError(
                f"the answer for enclave {answer.name} is older than the installed one",
                f"Its certificate is valid from {iso(new.not_before)}, the installed one from "
                f"{iso(old.not_before)}.",
                remedy,
            )
    for role, file in ((IDENTITY, IDENTITY_CA_FILE), (PERMISSIONS, PERMISSIONS_CA_FILE)):
        trusted = _certificates(enclave_dir / file) if (enclave_dir / file).exists() else ()
        sent_cas = load_certificates(answer.file(file) or b"", file)
        if retired := retired_authorities(trusted, sent_cas):
            raise KeystoreError(
                f"the answer for enclave {answer.name} goes back to an earlier {role} CA",
                f"It trusts {authority_text(retired[0])}, which is older than a CA here: the "
                "keystore may come from a backup. The robot would trust again what was revoked "
                "after this CA was replaced.",
                "If the keystore comes from a backup, replace its CA there again: "
                "docs/howto/keystore_is_lost.md says how. If this CA is right, because `sros "
                "rotate_ca --identity-ca` or --permissions-ca named it, add --force.",
            )
    if older := older_list(*_installed_and_sent_lists(enclave_dir, answer)):
        here, _ = older
        raise KeystoreError(
            f"the answer for enclave {answer.name} has an older revocation list",
            f"The list in '{enclave_dir}' has the number {here.number}; with an older list, "
            "revoked enclaves would be trusted again.",
            remedy,
        )


def _installed_and_sent_lists(
    enclave_dir: Path, answer: RequestAnswer
) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """Return the files with revocation lists: the files here, and the files in the answer."""
    present = {
        f: read_bytes(enclave_dir / f, "file") for f in LIST_FILES if (enclave_dir / f).exists()
    }
    return present, {f: data for f in LIST_FILES if (data := answer.file(f)) is not None}


def _lost_revocation_notes(enclave_dir: Path, answer: RequestAnswer) -> Iterator[Note]:
    """Yield a note if the answer's revocation list lacks certificates of the installed list.

    Certificates that the list lacks may have expired since.
    """
    if lost := lost_serials(*_installed_and_sent_lists(enclave_dir, answer)):
        text = (
            f"the earlier revocation list revokes {counted(len(lost), 'certificate')} that the new "
            f"list lacks, such as {serial_text(min(lost))}. This is right if these certificates "
            "have expired: `sros inspect KEYSTORE --history` shows when they expire. If a "
            "certificate has not expired, or is not shown, the keystore comes from a backup: then "
            "import the list of another robot with `sros crl KEYSTORE --refresh --crl FILE`, and "
            "have the request signed again."
        )
        yield Note("import.list-lacks", text)


def _check_number(path: Path, answer: RequestAnswer, remedy: str) -> bool:
    """Return whether the installed answer has a number, so that the new answer is not older.

    Without one, the caller has to compare times.  ``path`` is the seal of the installed answer.

    Raises:
        KeystoreError: the number of the new answer is not higher than the number of the installed
            answer.
    """
    if not path.exists():
        return False
    present = read_bytes(path, "file list of the installed answer")
    old, new = _answer_number(present), _answer_number(answer.seal)
    if not old or present == answer.seal:
        return bool(old)
    if new < old:
        why = f"It has the number {new}, and the installed answer has {old}."
    elif new == old:
        why = f"Both answers have the number {old}, so the keystore's ledger was reset in between."
    else:
        return True
    raise KeystoreError(
        f"the answer for enclave {answer.name} is older than the installed one", why, remedy
    )


# ── as JSON ────────────────────────────────────────────────────────────────────────────────


class RequestedEnclave(NamedTuple):
    """An enclave with a signing request."""

    name: str
    """Name of the enclave."""
    outcome: Annotated[str, Words(("requested", "requested_again"))]
    """``requested``: the request is for a new key; ``requested_again``: for the existing key."""
    folder: Path
    """Folder of the enclave."""
    request: Path
    """File with the signing request."""
    key_sha256: str | None
    """SHA-256 of the enclave's public key (DER), in hexadecimal; null if a dry run made no key."""


class MadeRequests(NamedTuple):
    """The signing requests that were made."""

    folder: Path
    """DIR, as given on the command line."""
    dry_run: DryRun
    enclaves: Sequence[RequestedEnclave]
    """The enclaves that the requests are for."""
    changes: FileChanges
    notes: Notes


def shown_requests(folder: Path, made: NewRequests, *, again: bool, dry_run: bool) -> MadeRequests:
    """Return the value that ``--json`` prints for new signing requests.

    ``again`` and ``dry_run`` are as in `create_requests`.
    """
    outcome = "requested_again" if again else "requested"
    has_keys = again or not dry_run  # a dry run does not keep the keys that it makes
    enclaves = [
        RequestedEnclave(
            each.name, outcome, each.file.parent, each.file, each.key if has_keys else None
        )
        for each in made.requests
    ]
    return MadeRequests(folder, dry_run, enclaves, changes_below(folder, made.changes), made.notes)


class ImportedAnswer(NamedTuple):
    """The installed answer to a signing request."""

    folder: Path
    """DIR, as given on the command line."""
    dry_run: DryRun
    enclaves: Sequence[
        EnclaveResult[
            Annotated[
                str,
                Words(("imported", "kept")),
                "`imported`, or `kept` if this answer was installed already.",
            ]
        ]
    ]
    """The enclave of the answer."""
    authorities: Sequence[AuthorityFacts]
    """The CAs that the enclave trusts."""
    authorities_verified: bool
    """Whether ``--ca`` or an earlier answer verified the CAs; if not, compare their SHA-256."""
    restart_zenoh: Sequence[str]
    """The enclave, if its processes on Zenoh have to be restarted; otherwise empty."""
    changes: FileChanges
    notes: Notes


def shown_import(imported_enclave: ImportedEnclave, *, pinned: bool) -> ImportedAnswer:
    """Return the value that ``--json`` prints for an installed answer.

    ``pinned`` says whether ``--ca`` was given.
    """
    return shown(
        imported_enclave,
        ImportedAnswer,
        authorities=trusted_authorities(
            imported_enclave.identity_ca, imported_enclave.permissions_ca
        ),
        authorities_verified=pinned or not imported_enclave.first,
        restart_zenoh=imported_enclave.restart,
    )
