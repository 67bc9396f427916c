"""Check the enclaves in a folder on a robot: whether processes can run in them, and how long.

`verify_arrival` is for the delivery of enclaves; the functions below it are for the robot's later
reports.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from shlex import quote
from typing import Annotated, NamedTuple

from sros_tool.checks.keystores.enclaves import WAITS
from sros_tool.checks.keystores.files import KEY_READABLE, check_files
from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import CheckedKeystore, Circumstances
from sros_tool.checks.kind import ERROR, Finding, FindingFilter, FindingKind
from sros_tool.errors import DocumentError, SrosError
from sros_tool.faults import KEY_MADE_ON_ROBOT, Fault
from sros_tool.keystore.confirmation import COULD_NOT_START
from sros_tool.keystore.delivery.archive import SUFFIXES
from sros_tool.keystore.layout import (
    KEY_FILE,
    KEY_URI_FILE,
    LEDGER,
    OPTIONAL_FILES,
    REQUEST,
    REQUIRED_FILES,
    enclave_path,
    is_enclave,
    is_keystore,
    locate_enclave,
    refuse_flat_keystore,
    search_enclaves,
    waits_for_answer,
)
from sros_tool.keystore.participant import evaluate_enclave
from sros_tool.keystore.reader import FilesReadOnce, OpenedEnclave, OpenedKeystore, open_enclave
from sros_tool.pki.certificates import load_request
from sros_tool.pki.token import Secrets, TokenUri, open_enclave_key
from sros_tool.values import Words, shows
from sros_tool.wording import first_few

_FILE_MISSING = f"enclave.{Fault.FILE_MISSING.id}"
_FILES_OF_ENCLAVE = (*REQUIRED_FILES, KEY_URI_FILE, *OPTIONAL_FILES)


class ArrivalFinding(NamedTuple):
    """A finding about the folder of enclaves on a robot."""

    enclave: str | None
    """The enclave that the finding is about, or null."""
    file: str
    """The file that the finding is about: its path in the enclave's folder, else in DIR."""
    text: str
    """The fault and its remedy."""


class VerifiedFolder(NamedTuple):
    """Whether the enclaves of a robot can be used."""

    path: Path
    """The folder DIR, as named on the command line."""
    kind: Annotated[str, Words(("keystore", "enclave"))]
    """Whether DIR is a keystore or an enclave."""
    ok: bool
    """Whether there are no findings; the exit status is then 0."""
    enclaves: Sequence[ArrivedEnclave]
    """The enclaves."""
    findings: Sequence[ArrivalFinding]
    """The faults that were found."""
    at: datetime
    """The moment for which the enclaves were checked, in UTC."""
    domain: int | None
    """The ROS domain that the enclaves have to join, or null."""


@shows(
    *("name", "loadable", "domains", "valid_until", "key_on_robot", "token"),
    null_if_empty=("domains",),
)
@dataclass(frozen=True, slots=True)
class ArrivedEnclave:
    """An enclave on a robot: whether a process can run in it, in which domains, and how long.

    It is enough if one vendor accepts the enclave; a refusal by another vendor is a finding.
    ``place`` is the PKCS#11 URI of a key on a token.
    """

    name: str
    """The enclave."""
    loadable: bool
    """Whether a process can run in the enclave."""
    domains: str
    """The ROS domains that the process can join, or null."""
    valid_until: datetime | None
    """The earliest expiry of the enclave's certificates and permissions, in UTC, or null."""
    key_on_robot: bool = False
    """Whether only the private key is missing here, because it was made on the robot."""
    place: TokenUri | None = None

    @property
    def token(self) -> str | None:
        """The token that has the enclave's key, or null for a key in a file."""
        return self.place.token if self.place else None


@dataclass(frozen=True, slots=True)
class Arrival:
    """The enclaves in a folder on a robot, or a single enclave, with the errors and warnings.

    ``path`` is what the user named; ``root`` is the folder that contains the enclaves folder;
    ``kind`` is keystore or enclave.
    """

    path: Path
    root: Path
    kind: str
    enclaves: tuple[ArrivedEnclave, ...]
    findings: tuple[Finding, ...]

    def verified_folder(self, moment: datetime, domain: int | None) -> VerifiedFolder:
        """Return the result in the form that ``--json`` prints, for one ROS domain or all."""
        findings = [
            ArrivalFinding(
                self.enclave_of(finding) or None,
                self.file_of(finding),
                f"{finding.kind.title}: {finding.text}",
            )
            for finding in self.findings
        ]
        ok = not findings
        return VerifiedFolder(self.path, self.kind, ok, self.enclaves, findings, moment, domain)

    def enclave_of(self, finding: Finding) -> str:
        """Return the enclave that a finding is about, or ""."""
        file = Path(finding.file)
        for enclave in self.enclaves:
            of_enclave = file.name in _FILES_OF_ENCLAVE and file.parent == enclave_path(
                self.root, enclave.name
            )
            if enclave.name == finding.subject or of_enclave:
                return enclave.name
        return ""

    def file_of(self, finding: Finding) -> str:
        """Return the file of a finding, relative to its enclave's folder or to the root."""
        name = self.enclave_of(finding)
        folder = enclave_path(self.root, name) if name else self.root
        inside = Path(finding.file).is_relative_to(folder)
        return os.path.relpath(finding.file, folder if inside else self.root)


def verify_arrival(
    path: Path,
    *,
    now: datetime,
    domain: int | None = None,
    zone: tzinfo = UTC,
    only_enclaves: Sequence[str] | None = None,
    secrets: Secrets | None = None,
) -> Arrival:
    """Check the enclaves in a folder on a robot, or one enclave.

    The findings are errors, warnings and signing requests without an answer, because the enclave
    does not work before the answer.

    Args:
        path: a folder with enclaves, or the folder of an enclave.
        now: the moment to check for.
        domain: the ROS domain that the enclaves have to join.
        zone: the time zone of the robot.
        only_enclaves: the enclaves to check; None for all of them and the folder itself.
        secrets: called for the PINs of tokens, which are then opened to prove that they have the
            keys; None opens no token.

    Raises:
        DocumentError: ``path`` is neither a folder with enclaves nor an enclave.
    """
    if is_keystore(path):
        root, kind = path, "keystore"
        names = search_enclaves(path)[0] if only_enclaves is None else tuple(only_enclaves)
    elif path.is_dir() and is_enclave(path):
        root, name = locate_enclave(path)
        names, kind = (name,), "enclave"
        only_enclaves = names
    else:
        refuse_flat_keystore(path)
        raise DocumentError(
            f"'{path}' is neither a keystore nor an enclave",
            _why_no_enclaves(path),
            f"Unpack it first: `mkdir robot && tar -xzf {quote(str(path))} -C robot && sros verify "
            "robot`."
            if path.is_file() and path.name.endswith(SUFFIXES)
            else "Name the folder that `sros distribute_key` or `sros import` has written to.",
        )
    keystore = OpenedKeystore(root)
    enclaves = tuple(_enclave(keystore, name, now, domain, zone) for name in names)
    elsewhere = {
        str(enclave_path(root, enclave.name) / KEY_FILE)
        for enclave in enclaves
        if enclave.key_on_robot
    }
    at = Circumstances(now, zone, domain, on_robot=True)
    findings = [
        finding
        for finding in keystore_findings(keystore, at, only_enclaves=only_enclaves)
        if not (finding.file in elsewhere and finding.id == _FILE_MISSING)
    ]
    findings += [
        finding for name in names for finding in _token_findings(keystore, name, now, secrets)
    ]
    shown = FindingFilter().choose(findings).shown
    return Arrival(
        path,
        root,
        kind,
        enclaves,
        tuple(finding for finding in findings if finding in shown or finding.kind is WAITS),
    )


TOKEN_KEY = FindingKind(
    "enclave.token-key",
    ERROR,
    "a token that does not have the key of an enclave",
    "A node does not start if the token is missing, has another key, or refuses the PIN.",
    "Fast DDS 2.9.1 (Pkcs11Provider.cpp); tested.",
    "Check that the token is there, and check its module and PIN. If its key is lost, make another "
    "key, with `sros create_request` in another folder.",
)


_SIGN_AGAIN = (
    "Have the request signed again on the keystore machine, with `sros sign_request --renew`, and "
    "import the answer."
)


def _token_findings(
    keystore: OpenedKeystore, name: str, now: datetime, secrets: Secrets | None
) -> Iterator[Finding]:
    """Yield a finding if an enclave's key is on a token, and is not the key of its certificate.

    Without ``secrets``, the token stays closed: the signing request says which key the token has.
    """
    state = keystore.enclave(name, now=now)
    if not state.token:
        return
    file = str(keystore.folder(name) / KEY_URI_FILE)
    if not secrets:
        request = keystore.folder(name) / REQUEST
        with suppress(SrosError):
            made = load_request(keystore.read(request, "request"), f"'{request}'")
            if state.certificate and made.public_key != state.certificate.public_key():
                text = f"cert.pem is not for the key that {REQUEST} was made with"
                yield TOKEN_KEY.found(name, text, file, remedy=_SIGN_AGAIN)
        return
    try:
        key = open_enclave_key(state.token, secrets)
        if state.certificate and not key.signs_for(state.certificate.public_key()):
            text = f"the key {state.token.object!r} on the token is not the key of cert.pem"
            yield TOKEN_KEY.found(name, text, file)
    except SrosError as error:
        yield TOKEN_KEY.found(name, str(error), file)


def _why_no_enclaves(path: Path) -> str:
    """Return why a path holds no enclaves, as a sentence."""
    if not path.exists():
        return "It does not exist."
    if not path.is_dir():
        return "It is a file."
    return "It has no folder 'enclaves' with content, and neither cert.pem nor key.pem."


def _enclave(
    keystore: OpenedKeystore, name: str, now: datetime, domain: int | None, zone: tzinfo
) -> ArrivedEnclave:
    folder = keystore.folder(name)
    if waits_for_answer(folder):
        return ArrivedEnclave(name, False, "", None)
    state = keystore.enclave(name, now=now, domain=domain)
    domains = state.joined_domains()
    evaluation = evaluate_enclave(name, folder, state, moment=now, domain=domain, zone=zone)
    state = evaluation.state
    loadable = not (state.problems or evaluation.refusal_sentences())
    # A folder without a ledger is on a robot, where a missing key is a lost key.
    has_ledger = (keystore.root / LEDGER).is_file()
    elsewhere = has_ledger and state.key_on_robot and not state.problems_in_keystore
    until = state.valid_until()
    return ArrivedEnclave(name, loadable, str(domains or ""), until, elsewhere, state.token)


_MOST_NAMED = 2
_CLOSE_KEY = (
    " Run `chmod 600` on it; if others may have copied it, also run `sros renew KEYSTORE ENCLAVE "
    f"--new-key --revoke-old`.{KEY_MADE_ON_ROBOT}"
)


class InstalledEnclave(NamedTuple):
    """An enclave on the robot, and a clause on why no process could start in it, or ""."""

    state: OpenedEnclave
    problem: str

    def permissions_until(self) -> datetime | None:
        """Return when the enclave's permissions expire; None if that is not known."""
        with suppress(SrosError):
            return self.state.grant.validity.not_after if self.state.grant else None
        return None


def open_installed(
    folder: Path, names: Iterable[str], *, now: datetime
) -> dict[str, InstalledEnclave]:
    """Map ``names`` to the enclaves in a security folder; unreadable enclaves are left out."""
    opened, files = {}, FilesReadOnce()
    for name in names:
        place = enclave_path(folder, name)
        with suppress(SrosError, OSError):
            state = open_enclave(place, now=now, files=files)
            evaluation = evaluate_enclave(name, place, state, moment=now)
            opened[name] = InstalledEnclave(evaluation.state, "; ".join(evaluation.problems_here))
    return opened


def unusable_sentences(enclaves: Mapping[str, InstalledEnclave]) -> Iterator[str]:
    """Yield a sentence for each enclave in which no process could start."""
    for name, enclave in enclaves.items():
        if enclave.problem:
            yield f"{name} {COULD_NOT_START}: {enclave.problem}."


def _keystore_on_robot(folder: Path, now: datetime) -> CheckedKeystore:
    return CheckedKeystore(OpenedKeystore(folder), Circumstances(now, on_robot=True))


def exposed_sentences(folder: Path, now: datetime) -> Iterator[str]:
    """Yield sentences on files that others can read or change, as `sros verify` finds them."""
    paths: dict[tuple[str, str, str], list[str]] = {}
    try:
        for finding in check_files(_keystore_on_robot(folder, now)):
            if finding.severity >= ERROR:
                path = os.path.relpath(finding.file, folder)
                to_do = _CLOSE_KEY if finding.kind is KEY_READABLE else ""
                paths.setdefault((finding.kind.title, finding.text, to_do), []).append(path)
    except (SrosError, OSError) as error:
        yield f"The modes of the files in '{folder}' cannot be checked: {error}"
    for (title, text, to_do), files in paths.items():
        yield f"{first_few(files, _MOST_NAMED)}: {title}: {text}.{to_do}"


def exposed_keys(folder: Path, now: datetime) -> frozenset[str]:
    """Return the paths, in ``folder``, of private keys that others can read, as far as known."""
    keys = set()
    with suppress(SrosError, OSError):
        for finding in check_files(_keystore_on_robot(folder, now)):
            if finding.kind is KEY_READABLE:
                keys.add(os.path.relpath(finding.file, folder))
    return frozenset(keys)


def installed_sentences(folder: Path, names: Sequence[str], now: datetime) -> Iterator[str]:
    """Yield sentences on all that is wrong with the enclaves ``names`` and with the folder."""
    answered = [name for name in names if not waits_for_answer(enclave_path(folder, name))]
    yield from unusable_sentences(open_installed(folder, answered, now=now))
    yield from exposed_sentences(folder, now)
