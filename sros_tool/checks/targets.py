"""Checks of any path: a policy, a keystore, an enclave, a Zenoh configuration, or a folder."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from shlex import quote

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import Finding
from sros_tool.dds.decision.vendors import ZENOH
from sros_tool.errors import DocumentError
from sros_tool.keystore.layout import (
    KEY_URI_FILE,
    PERMISSIONS_FILE,
    REQUIRED_FILES,
    is_enclave,
    is_keystore,
    locate_enclave,
    refuse_flat_keystore,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.xml import read_bytes

_COMMENT = re.compile(rb"<!--.*?(?:-->|\Z)", re.DOTALL)
_ENCLAVE_FILES = (*REQUIRED_FILES, KEY_URI_FILE, "permissions.xml", "crl.pem", "request.pem")


def path_findings(paths: Iterable[Path], circumstances: Circumstances) -> list[Finding]:
    """Return the findings at paths: policies, folders of policies, keystores, or enclaves.

    All policies count as the policies of one robot or fleet: a name may have its counterpart in
    another policy.  The nodes of keystores and enclaves in several folders have to communicate.
    A file ``*.json5``, ``*.json`` or ``*.yaml`` is a Zenoh configuration.  Raises `DocumentError`
    for any other path.
    """
    findings: list[Finding] = []
    policies, paths = [], tuple(paths)
    for path in paths:
        check = _check_of(path)
        if check:
            findings += check(path, circumstances)
        else:
            policies.append(path)
    if policies:
        findings += policy_findings(policies, circumstances)
    findings += findings_between_folders(paths, circumstances)
    return list(dict.fromkeys(findings))


def findings_between_folders(paths: Iterable[Path], circumstances: Circumstances) -> list[Finding]:
    """Return findings about folders among the paths whose nodes do not communicate."""
    targets: dict[str, tuple[OpenedKeystore, Sequence[str]]] = {}
    for path in filter(Path.is_dir, paths):
        if is_keystore(path):
            keystore = circumstances.keystore(path)
            targets[str(path)] = keystore, keystore.names
        elif is_enclave(path):
            root, name = locate_enclave(path)
            targets[str(path)] = circumstances.keystore(root), (name,)
    if len(targets) < 2:
        return []
    from sros_tool.checks.keystores.trust import findings_between

    return list(
        findings_between(targets, now=circumstances.now, on_zenoh=circumstances.vendors == (ZENOH,))
    )


def is_of_policies(path: Path) -> bool:
    """Return whether a path has to be a policy, or a folder of policies: it is nothing else."""
    return _check_of(path) is None


def _check_of(path: Path) -> Callable[[Path, Circumstances], list[Finding]] | None:
    """Return the check of a path; None if it has to be a policy, or a folder of policies."""
    if path.suffix in (".json5", ".json", ".yaml", ".yml") and not path.is_dir():
        return _zenoh_findings
    if is_keystore(path):
        return findings_in_keystore
    enclave = path if path.is_dir() else path.parent
    if (is_enclave(enclave) or (enclave / PERMISSIONS_FILE).exists()) and (
        path.is_dir() or path.name in _ENCLAVE_FILES
    ):
        return _enclave_findings
    return None


def _zenoh_findings(path: Path, _circumstances: Circumstances) -> list[Finding]:
    from sros_tool.checks.zenoh import configuration_findings

    return list(configuration_findings(path))


def _enclave_findings(path: Path, circumstances: Circumstances) -> list[Finding]:
    root, name = locate_enclave(path if path.is_dir() else path.parent)
    return findings_in_keystore(root, circumstances, name)


def policy_findings(paths: Iterable[Path], circumstances: Circumstances) -> list[Finding]:
    """Return the findings about policy files and the policies in folders, checked together.

    Raises:
        DocumentError: there is no file at a path, or no policy in a folder.
    """
    from sros_tool.checks.policies.policy import policy_file_findings

    files = [file for path in paths for file in _policies_at(path)]
    findings = policy_file_findings(
        *files,
        distribution=circumstances.distribution,
        fleet=circumstances.fleet,
        on_zenoh=ZENOH in circumstances.vendors,
    )
    return list(dict.fromkeys(findings))


def _policies_at(path: Path) -> list[Path]:
    from sros_tool.policy.document import files_of_policies

    if not path.is_dir():
        begin = _COMMENT.sub(b"", read_bytes(path, "file")[:1000]).lower()
        if b"multipart/signed" in begin or b"<dds" in begin:
            raise DocumentError(
                f"'{path}' is a DDS Security document without its enclave",
                "sros checks the signature and the subject of the document with the files of its "
                "enclave.",
                f"Name the folder of the enclave, or run `sros inspect {quote(str(path))}`.",
            )
    if policies := list(files_of_policies(path)):
        return policies
    refuse_flat_keystore(path)
    raise DocumentError(
        f"'{path}' is neither a keystore nor an enclave, and holds no policy",
        "It has no folder 'enclaves' with content, no cert.pem, and no XML file that begins "
        "with <policy>.",
    )


def findings_in_keystore(
    root: Path, circumstances: Circumstances, only_enclave: str | None = None
) -> list[Finding]:
    """Return findings about a keystore or an export, or only about one of its enclaves."""
    enclaves = None if only_enclave is None else (only_enclave,)
    return keystore_findings(circumstances.keystore(root), circumstances, only_enclaves=enclaves)
