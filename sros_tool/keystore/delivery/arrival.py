"""Whom the enclaves of a robot trust: those of one folder have an identity CA in common."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.errors import DocumentError, KeystoreError, PkiError, SrosError, UsageError
from sros_tool.keystore.describe import Description
from sros_tool.keystore.layout import (
    ENCLAVES,
    PRIVATE,
    PUBLIC,
    REQUEST,
    STAGE,
    enclave_folder,
    enclave_names,
    is_keystore,
)
from sros_tool.keystore.reader import OpenedEnclave, open_enclave
from sros_tool.pki.certificates import UNREADABLE, common_name_of, subject_text, validity_of
from sros_tool.validity import iso
from sros_tool.xml import read_bytes

_AUTHORITY = "identity_ca.cert.pem"


def fingerprints(pem: bytes) -> frozenset[str]:
    """The SHA-256 of every certificate in a PEM file: more than one while a CA is rotated."""
    return frozenset(each.fingerprint(hashes.SHA256()).hex() for each in _load(pem))


def read_pin(text: str) -> frozenset[str]:
    """The SHA-256 of the CAs that a person named: by a fingerprint, or a file of certificates.

    Raises `UsageError` for what is neither; colons and capitals in a fingerprint do not matter, so
    that one may be copied from ``openssl x509 -fingerprint -sha256``.
    """
    plain = text.strip().rpartition("=")[2].replace(":", "").lower()
    if re.fullmatch(r"[0-9a-f]{64}", plain):
        return frozenset({plain})
    path = Path(text)
    if path.is_file():
        return fingerprints(read_bytes(path, "certificate"))
    raise UsageError(
        f"{text!r} is neither the file of a certificate nor its SHA-256",
        "A fingerprint has 64 hexadecimal digits.",
        "Copy the one that `sros sign_request` says, or name a file.",
    )


def trusted_in(folder: Path, file: str) -> list[x509.Certificate]:
    """The CAs that the enclaves of a robot's folder trust, by the name of the CA file."""
    found: dict[str, x509.Certificate] = {}
    for path in sorted((folder / ENCLAVES).rglob(file)):
        if path.exists():
            found |= {each.fingerprint(hashes.SHA256()).hex(): each for each in _of(path)}
    return list(found.values())


def _of(path: Path) -> list[x509.Certificate]:
    return _load(read_bytes(path, "certificate"))


def check_same_authority(target: Path, files: Mapping[str, bytes]) -> None:
    """One folder holds the enclaves of one keystore only: others would never talk to each other.

    ``files`` are those that are to be written below ``target``, by their paths.
    """
    ours: set[str] = set()
    for path, data in files.items():
        if path.endswith(f"/{_AUTHORITY}"):
            ours |= fingerprints(data)
    for place in sorted((target / ENCLAVES).rglob(_AUTHORITY)):
        if f"{place.relative_to(target)}" in files or not place.exists():
            continue
        theirs = _of(place)
        if not {each.fingerprint(hashes.SHA256()).hex() for each in theirs} & ours:
            raise KeystoreError(
                f"'{target}' holds enclaves of another keystore",
                f"Those trust {subject_text(theirs[0].subject)}, and would not talk to these.",
                "Choose another folder.",
            )


def refuse_home(folder: Path, remedy: str) -> None:
    """Raise `KeystoreError` where ``folder`` is the keystore that has the CAs, not a robot's."""
    if (folder / PRIVATE).exists() or (folder / PUBLIC).exists():
        raise KeystoreError(
            f"'{folder}' is a keystore with CAs",
            "Requests are made, and their answers used, in a folder of the robot.",
            remedy,
        )


def _load(pem: bytes) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(pem)
    except UNREADABLE as error:
        raise PkiError("the certificate of a CA cannot be read") from error


_AUTHORITIES = ("identity_ca.cert.pem", "permissions_ca.cert.pem")
_KEY_MARK = b"PRIVATE KEY-----"


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is wrong; ``enclave`` is "" where it is not of one, ``file`` is a path."""

    enclave: str
    file: str
    text: str

    def __str__(self) -> str:
        return ": ".join(part for part in (self.enclave, self.file, self.text) if part)


@dataclass(frozen=True, slots=True)
class Arrived:
    """An enclave that arrived: whether a process can run in it, where, and until when."""

    name: str
    loadable: bool
    domains: str
    until: datetime | None


@dataclass(frozen=True, slots=True)
class Arrival:
    """All enclaves of a folder, or the one that it is, and everything that is wrong."""

    path: Path
    kind: str
    enclaves: tuple[Arrived, ...]
    findings: tuple[Finding, ...]

    def describe(self) -> Description:
        """The same as a plain value for JSON."""
        return {
            "path": str(self.path),
            "kind": self.kind,
            "ok": not self.findings,
            "enclaves": [
                {
                    "name": each.name,
                    "loadable": each.loadable,
                    "domains": each.domains or None,
                    "valid_until": iso(each.until) if each.until else None,
                }
                for each in self.enclaves
            ],
            "findings": [
                {"enclave": each.enclave or None, "file": each.file, "text": each.text}
                for each in self.findings
            ],
        }


def verify_arrival(path: Path, *, now: datetime, domain: int | None = None) -> Arrival:
    """Check a robot's folder, or the folder of one enclave, as it would be used at ``now``.

    Every check that DDS makes, and those that nobody makes: who can read the keys, CA keys that
    have no place on a robot, links that lead out, and whether the enclaves trust the same CAs.
    Raises `DocumentError` where ``path`` is neither.
    """
    root, names = _what(path)
    enclaves, findings = [], []
    states: dict[str, OpenedEnclave] = {}
    for name in names:
        folder = root / enclave_folder(name)
        found = []
        if (folder / REQUEST).exists() and not (folder / "cert.pem").exists():
            text = "it waits for the answer to its request; `sros import` puts that in place"
            found.append(Finding(name, REQUEST, text))
            enclaves.append(Arrived(name, False, "", None))
        else:
            states[name] = state = open_enclave(folder, now=now, domain=domain)
            found += [Finding(name, each.file, each.text) for each in state.problems]
            enclaves.append(Arrived(name, not found, str(state.domains() or ""), _until(state)))
            found += _name(name, state)
        found += _key(name, folder)
        findings += found
    findings += _trust(root, states)
    findings += _tree(path, root, names)
    kind = "keystore" if path == root else "enclave"
    return Arrival(path, kind, tuple(enclaves), tuple(findings))


def _what(path: Path) -> tuple[Path, tuple[str, ...]]:
    """The root of what was named, and the names of the enclaves to check in it."""
    if is_keystore(path):
        return path, tuple(enclave_names(path))
    if path.is_dir() and any((path / file).exists() for file in ("cert.pem", "key.pem")):
        whole = Path(os.path.abspath(path))  # noqa: PTH100 - a link is not followed to elsewhere
        for above in (whole, *whole.parents):
            if above.name == ENCLAVES:
                below = "/".join(whole.relative_to(above).parts)
                return above.parent, (f"/{below}",)
        raise DocumentError(
            f"'{path}' lies in no folder named {ENCLAVES}",
            "rcl looks for an enclave below that, by its name.",
            "Name the folder that was exported, or the enclave's folder in it.",
        )
    raise DocumentError(
        f"'{path}' is neither a keystore nor an enclave",
        "It does not exist."
        if not path.exists()
        else "It has no enclaves folder in use, and neither cert.pem nor key.pem.",
        "Name the folder into which `sros distribute_key` or `sros import` has written.",
    )


def _until(state: OpenedEnclave) -> datetime | None:
    """When the enclave stops being loadable: the first end of anything that it consists of."""
    if not (state.certificate and state.permissions):
        return None
    subject = subject_text(state.certificate.subject)
    grants = [each for each in state.permissions.grants if each.subject == subject][:1]
    certificates = (state.certificate, state.identity_ca, state.permissions_ca)
    return min(
        *(validity_of(each).not_after for each in certificates if each),
        *(each.validity.not_after for each in grants),
    )


def _name(name: str, state: OpenedEnclave) -> Iterator[Finding]:
    """DDS does not ask where a certificate lies; that it is another's shows a mix-up."""
    if state.certificate and common_name_of(state.certificate.subject) != name:
        text = f"it is of {subject_text(state.certificate.subject)}, not of this enclave"
        yield Finding(name, "cert.pem", text)


def _key(name: str, folder: Path) -> Iterator[Finding]:
    try:
        mode = stat.S_IMODE((folder / "key.pem").stat().st_mode)
    except OSError:
        return  # that it is missing is said already
    if mode & 0o077:
        yield Finding(name, "key.pem", f"others have access to it (mode {mode:04o}): chmod 600")


def _trust(root: Path, states: dict[str, OpenedEnclave]) -> Iterator[Finding]:
    """Enclaves that have no CA in common would not talk to each other."""
    for file in _AUTHORITIES:
        first: tuple[str, frozenset[str]] | None = None
        for name in states:
            try:
                trusted = fingerprints(read_bytes(root / enclave_folder(name) / file, "file"))
            except SrosError:
                continue  # said already
            first = first or (name, trusted)
            if not trusted & first[1]:
                yield Finding(name, file, f"it is another CA than that of {first[0]}")


def _tree(path: Path, root: Path, names: tuple[str, ...]) -> Iterator[Finding]:
    """What no file of an arrival may be, whether it belongs to an enclave or not."""
    keys = {root / enclave_folder(name) / "key.pem" for name in names}
    start = root if path == root else root / enclave_folder(names[0])
    real_root = Path(os.path.realpath(root))
    for parent, folders, files in os.walk(start):
        if STAGE in folders:
            folders.remove(STAGE)
            text = "a write was interrupted here: any sros verb that writes completes or undoes it"
            yield Finding("", STAGE, text)
        for file in sorted((*files, *folders)):
            place = Path(parent, file)
            shown = str(place.relative_to(start))
            mode = place.lstat().st_mode
            if stat.S_ISLNK(mode):
                if not Path(os.path.realpath(place)).is_relative_to(real_root):
                    yield Finding("", shown, f"it is a link that leads out, to {place.readlink()}")
            elif mode & stat.S_IWOTH:
                yield Finding("", shown, f"everybody can change it (mode {mode & 0o7777:04o})")
            if file in files and place not in keys and _holds_key(place):
                yield Finding(
                    "", shown, "it is a private key, perhaps of a CA, which has no place on a robot"
                )


def _holds_key(path: Path) -> bool:
    if path.suffix not in (".pem", ".key"):
        return False
    try:
        return _KEY_MARK in read_bytes(path, "file")
    except SrosError:
        return False
