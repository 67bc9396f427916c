"""Reading the Zenoh configurations of an enclave, and what is wrong with them.

Zenoh itself verifies nothing: each configuration has to be the document that the permissions CA
signed next to it, and to state the rights of the enclave's signed permissions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from cryptography import x509

from sros_tool.errors import SrosError
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    PERMISSIONS_FILE,
    SESSION_FILE,
    ZENOH_SIGNED,
)
from sros_tool.keystore.reader import FilesReadOnce, OpenedEnclave
from sros_tool.keystore.rights import joined_domains, recorded_rights
from sros_tool.pki.certificates import common_name_of
from sros_tool.translate_zenoh import domains_of, remote_of
from sros_tool.zenoh.access import joined
from sros_tool.zenoh.configuration import Configuration, Mode, parse_rendered


class ZenohFault(Enum):
    """What can be wrong with the Zenoh configurations of an enclave, by its stable id."""

    MISSING = "missing"
    UNREADABLE = "unreadable"
    UNSIGNED = "unsigned"
    SIGNATURE = "signature"
    OTHER_DOCUMENT = "other-document"
    MALFORMED = "malformed"
    OUT_OF_DATE = "out-of-date"
    OTHER_NAME = "other-name"


@dataclass(frozen=True, slots=True)
class ZenohProblem:
    """A fault of a Zenoh configuration, with the file that has it and the reason as a clause."""

    file: str
    text: str
    fault: ZenohFault

    def __str__(self) -> str:
        return f"{self.file}: {self.text}"


@dataclass(frozen=True, slots=True)
class OpenedZenoh:
    """The Zenoh configurations of an enclave by file name, and their problems.

    ``files`` are those that exist; ``configurations`` those that could be read and verified.
    """

    files: tuple[str, ...]
    configurations: Mapping[str, Configuration]
    problems: tuple[ZenohProblem, ...]

    def domains(self) -> tuple[int, ...]:
        """Return the ROS domains that the configurations are for, sorted."""
        controls = (each.access_control for each in self.configurations.values())
        return tuple(sorted(set().union(*map(domains_of, controls))))


def open_zenoh(folder: Path, name: str, state: OpenedEnclave) -> OpenedZenoh:
    """Return the Zenoh configurations of the enclave ``name`` in ``folder``, and their problems.

    They are compared with the enclave's own files in ``state`` alone, so it works on a robot, too.
    An enclave without any configuration has the problem `ZenohFault.MISSING`.
    """
    present = tuple(
        file
        for file, signed in ZENOH_SIGNED.items()
        if any(map(_exists, (folder / file, folder / signed)))
    )
    found: dict[str, Configuration] = {}
    problems: list[ZenohProblem] = []
    if not present:
        text = "the enclave has neither it nor router.json5"
        problems.append(ZenohProblem(SESSION_FILE, text, ZenohFault.MISSING))
    for file in present:
        read = _read(folder, file, state)
        if isinstance(read, ZenohProblem):
            problems.append(read)
            continue
        found[file] = read
        if text := _out_of_date(read, file, name, state):
            problems.append(ZenohProblem(file, text, ZenohFault.OUT_OF_DATE))
    certified = common_name_of(state.certificate.subject) if state.certificate else name
    if found and certified != name:
        text = f"its common name is {certified or '(none)'}, by which Zenoh knows the process"
        problems.append(ZenohProblem(CERTIFICATE_FILE, text, ZenohFault.OTHER_NAME))
    return OpenedZenoh(present, found, tuple(problems))


def is_signed(
    path: Path,
    document: bytes,
    authority: x509.Certificate,
    files: FilesReadOnce | None = None,
) -> bool:
    """Return whether the permissions CA signed a document next to its file ``path``."""
    files = files or FilesReadOnce()
    try:
        message = files.read(path.with_name(ZENOH_SIGNED[path.name]), "signed document")
        signed = files.signed(message)
        signed.verify(authority)
    except SrosError:
        return False
    return signed.text == document


def _exists(path: Path) -> bool:
    return path.exists() or path.is_symlink()


def _read(folder: Path, file: str, state: OpenedEnclave) -> Configuration | ZenohProblem:
    """Return a configuration that the permissions CA signed, or what is wrong with it."""
    signed_file = ZENOH_SIGNED[file]
    for each, fault in ((file, ZenohFault.MISSING), (signed_file, ZenohFault.UNSIGNED)):
        if not _exists(folder / each):
            return ZenohProblem(each, "missing", fault)
    try:
        document = state.read_once.read(folder / file, "Zenoh configuration")
        message = state.read_once.read(folder / signed_file, "signed document")
    except SrosError as error:
        return ZenohProblem(file, str(error), ZenohFault.UNREADABLE)
    try:
        signed = state.read_once.signed(message)
        if state.permissions_ca is None:
            text = "the permissions CA of the enclave, which has to have signed it, is not there"
            return ZenohProblem(signed_file, text, ZenohFault.SIGNATURE)
        signed.verify(state.permissions_ca)
    except SrosError as error:
        return ZenohProblem(signed_file, str(error).rstrip("."), ZenohFault.SIGNATURE)
    if signed.text != document:
        text = f"it is not the document that the permissions CA signed in {signed_file}"
        return ZenohProblem(file, text, ZenohFault.OTHER_DOCUMENT)
    try:
        return parse_rendered(document, "it")
    except SrosError as error:
        return ZenohProblem(file, error.what, ZenohFault.MALFORMED)


def _out_of_date(configuration: Configuration, file: str, name: str, state: OpenedEnclave) -> str:
    """Return how a configuration differs from the permissions of its enclave, or ""."""
    is_session = file == SESSION_FILE
    if is_session is (configuration.mode is Mode.ROUTER):
        return f"it is the configuration of a {'router' if is_session else 'session'}"
    if not is_session or state.grant is None:
        return ""
    control = configuration.access_control
    domains = joined_domains(state.grant, domains_of(control))
    stated = {each: recorded_rights(name, state.grant, each) for each in domains}
    try:
        own = remote_of(name, stated)
    except SrosError as error:
        return f"Zenoh cannot state the permissions of the enclave: {error.what}"
    # The router may do what the enclave lets it, and another process of the enclave the same.
    mirrored = joined(each.mirrored() for each in own.rules)
    if not any(remote.rules == mirrored for remote in control.remotes) or any(
        remote.common_name == name and remote != own for remote in control.remotes
    ):
        return f"it does not state the rights of {PERMISSIONS_FILE}"
    return ""
