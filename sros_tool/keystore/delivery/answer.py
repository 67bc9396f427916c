"""Importing the answer to a signing request on the robot: verified in full, installed at once."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509

from sros_tool.errors import DocumentError, KeystoreError, PkiError, SrosError
from sros_tool.keystore.authorities.authority import Authority
from sros_tool.keystore.delivery.archive import unpack
from sros_tool.keystore.delivery.trust import check_same_authority, refuse_home, trusted_in
from sros_tool.keystore.layout import ENCLAVES, OPTIONAL_FILES, REQUIRED_FILES, enclave_folder
from sros_tool.keystore.reader import OpenedEnclave, open_enclave, read_certificate
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name_of,
    digest,
    subject_text,
    validity_of,
)
from sros_tool.pki.crl import load_crl
from sros_tool.pki.keys import PublicKey, load_key
from sros_tool.validity import iso
from sros_tool.xml import read_bytes

_KEY = "key.pem"
_REQUIRED = tuple(file for file in REQUIRED_FILES if file != _KEY)
_AGAIN = "Have the request signed again, and the answer sent again."
SEAL = "answer.p7s"
"""The list of all files of an answer with their digests, signed by the permissions CA.

Without it, the carrier of an answer could put an older governance or another CA into it.
"""


@dataclass(frozen=True, slots=True)
class RequestAnswer:
    """The answer to a request: the files of one enclave by their paths, without its key.

    ``seal`` is the signed list of the files.
    """

    name: str
    files: dict[str, bytes]
    seal: bytes

    def file(self, name: str) -> bytes | None:
        """Return the content of a file of the enclave, such as ``cert.pem``, or None."""
        return self.files.get(f"{enclave_folder(self.name)}/{name}")


@dataclass(frozen=True, slots=True)
class ImportedEnclave:
    """The result of an import; without changes, the same answer was installed already.

    ``first`` is whether the folder had no CAs before: nothing there vouches for the new ones.
    """

    name: str
    identity_ca: x509.Certificate
    permissions_ca: x509.Certificate
    first: bool
    until: datetime
    changes: tuple[Change, ...]


def seal(files: dict[str, bytes], authority: Authority) -> bytes:
    """Return the signed list of the files of an answer."""
    return authority.sign(_listed(files), "the list of the files of the answer")


def _listed(files: dict[str, bytes]) -> bytes:
    digests = (f"{hashlib.sha256(data).hexdigest()}  {path}" for path, data in files.items())
    return "\n".join(["sros answer 1", *sorted(digests), ""]).encode()


def _lines(document: bytes) -> bytes:
    return document.replace(b"\r\n", b"\n")


def _read_answer(data: bytes) -> RequestAnswer:
    """Return the answer in an archive that ``sign_request`` made; nothing is written.

    Raises:
        DocumentError: the archive holds anything else than the files of one enclave.
    """
    try:
        files = unpack(data)
        signed = files.pop(SEAL, b"")
        own = [path for path in files if path.endswith("/cert.pem")]
        if len(own) != 1 or not own[0].startswith(f"{ENCLAVES}/"):
            raise DocumentError("it is not the answer for one enclave")
        name = check_enclave_name(own[0].removeprefix(ENCLAVES).removesuffix("/cert.pem") or "/")
        folder = enclave_folder(name)
        welcome = {f"{folder}/{file}" for file in (*_REQUIRED, *OPTIONAL_FILES)}
        if strange := sorted(files.keys() - welcome):
            raise DocumentError(f"it holds {strange[0]!r}, which no answer has")
        if missing := [file for file in _REQUIRED if f"{folder}/{file}" not in files]:
            raise DocumentError(f"{', '.join(missing)} is missing in it")
        if not signed:
            raise DocumentError(f"{SEAL} is missing in it")
    except SrosError as error:
        raise DocumentError(
            f"the answer cannot be used: {error.what}", error.why, _AGAIN
        ) from error
    return RequestAnswer(name, files, signed)


def check_answer(answer: RequestAnswer, key: PublicKey, *, now: datetime) -> OpenedEnclave:
    """Check that DDS would load an answer together with the private half of ``key``.

    Raises:
        PkiError: it lists everything that is wrong: a certificate for another key or enclave, an
            invalid chain or signature, an expired or revoked part, a file changed on the way.
    """
    with tempfile.TemporaryDirectory(prefix="sros-") as folder:
        for path, data in answer.files.items():
            Path(folder, path.rpartition("/")[2]).write_bytes(data)
        state = open_enclave(Path(folder), now=now)
    problems = [str(each) for each in state.problems if each.file != _KEY]
    certificate = state.certificate
    if certificate and certificate.public_key() != key:
        problems.insert(0, "cert.pem: it is for another key than the one that is here")
    if state.permissions_ca and (problem := _broken_seal(answer, [state.permissions_ca])):
        problems.append(f"{SEAL}: {problem}")
    if certificate and common_name_of(certificate.subject) != answer.name:
        problems.insert(0, f"cert.pem: it is for {subject_text(certificate.subject)}")
    if problems:
        raise PkiError(
            f"the answer for enclave {answer.name} does not hold", "; ".join(problems) + ".", _AGAIN
        )
    return state


def _broken_seal(answer: RequestAnswer, authorities: Iterable[x509.Certificate]) -> str:
    """Return why no CA's signature of the list of files verifies, or "" if one does."""
    try:
        signed = smime.parse(answer.seal)
    except SrosError as error:
        return str(error)
    if _lines(signed.document) != _listed(answer.files):
        return "the files are not those that were sent"
    problem = ""
    for authority in authorities:
        try:
            signed.verify(authority)
            return ""
        except SrosError as error:
            problem = str(error)
    return problem


def import_answer(
    folder: Path,
    data: bytes,
    *,
    now: datetime,
    pinned: frozenset[str] = frozenset(),
    force: bool = False,
    dry_run: bool = False,
) -> ImportedEnclave:
    """Install an answer next to its key in ``folder``, or change nothing.

    An answer that is older than the present files, or that comes from other CAs, needs ``force``.
    If CAs are ``pinned``, by their SHA-256, one of them must have signed it, also with ``force``.
    """
    answer = _read_answer(data)
    name = answer.name
    place = folder / enclave_folder(name)
    if not dry_run and folder.is_dir():
        tidy(folder)
    refuse_home(folder, "Name the folder in which the request was made.")
    if not (place / _KEY).is_file():
        raise KeystoreError(
            f"'{folder}' has no key of enclave {name}",
            "An answer is for the key of its request, which stays where the request was made.",
            f"Make key and request with `sros create_request {name} {folder}`, and have that "
            "signed.",
        )
    with Transaction(folder, dry_run=dry_run) as transaction:
        key = load_key(read_bytes(place / _KEY, "private key"), f"'{place / _KEY}'")
        state = check_answer(answer, key.public_key(), now=now)
        assert state.certificate and state.identity_ca and state.permissions_ca
        assert state.permissions
        _check_pinned(answer, state.identity_ca, state.permissions_ca, pinned)
        known = trusted_in(folder, "permissions_ca.cert.pem")
        if not force:
            _check_known(folder, answer, known)
            _check_newer(place, answer, state.certificate)
        for path, content in answer.files.items():
            present = folder / path
            if not present.is_file() or read_bytes(present, "file") != content:
                transaction.write(path, content)
        for file in OPTIONAL_FILES:
            if answer.file(file) is None and (place / file).exists():
                transaction.remove(f"{enclave_folder(name)}/{file}")
        transaction.commit()
    subject = subject_text(state.certificate.subject)
    ends = [each.validity.not_after for each in state.permissions.grants if each.subject == subject]
    until = min(validity_of(state.certificate).not_after, ends[0])
    return ImportedEnclave(
        name,
        state.identity_ca,
        state.permissions_ca,
        not known,
        until,
        tuple(transaction.changes),
    )


def _check_pinned(
    answer: RequestAnswer,
    identity_ca: x509.Certificate,
    permissions_ca: x509.Certificate,
    pinned: frozenset[str],
) -> None:
    """Check that one of the pinned CAs has signed the seal, and so the whole answer.

    The identity CA vouches for the certificate only: an attacker could add other permissions and
    another governance to it.
    """
    if not pinned or digest(permissions_ca) in pinned:
        return
    why = f"It comes from {subject_text(permissions_ca.subject)}, SHA-256 {digest(permissions_ca)}."
    remedy = "Ask for the SHA-256 that `sros sign_request` printed. Nothing was changed."
    if digest(identity_ca) in pinned:
        why = "The named CA is its identity CA, which vouches for the certificate only."
        remedy = "Name the permissions CA: it signs the whole answer. Nothing was changed."
    raise KeystoreError(
        f"the answer for enclave {answer.name} is not signed by the CA that is named", why, remedy
    )


def _check_known(folder: Path, answer: RequestAnswer, known: list[x509.Certificate]) -> None:
    """Refuse an answer that the CAs of the first answer did not sign."""
    if known and (problem := _broken_seal(answer, known)):
        raise KeystoreError(
            f"the answer for enclave {answer.name} comes from another keystore",
            f"The permissions CA that '{folder}' trusts has not signed it: {problem.rstrip('.')}.",
            "Add --force if this robot moves to that keystore.",
        )
    check_same_authority(folder, answer.files)


def _check_newer(place: Path, answer: RequestAnswer, certificate: x509.Certificate) -> None:
    """Refuse an answer that is older than the present state: an attacker may replay it."""
    remedy = "Have a new answer made, or add --force if going back is meant."
    path = place / "cert.pem"
    if path.exists():
        old = validity_of(read_certificate(path))
        new = validity_of(certificate)
        if new.not_before < old.not_before:
            raise KeystoreError(
                f"the answer for enclave {answer.name} is older than what is there",
                f"Its certificate begins at {iso(new.not_before)}, the present one at "
                f"{iso(old.not_before)}.",
                remedy,
            )
    path = place / "crl.pem"
    if path.exists():
        present = load_crl(read_bytes(path, "revocation list"), f"'{path}'").number
        sent = answer.file("crl.pem")
        if sent is None or load_crl(sent, "of the answer").number < present:
            raise KeystoreError(
                f"the answer for enclave {answer.name} has an older revocation list",
                f"'{path}' has the number {present}; enclaves that were revoked would be trusted "
                "again.",
                remedy,
            )
