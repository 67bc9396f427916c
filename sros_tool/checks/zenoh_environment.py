"""Checks of the variables with which processes of rmw_zenoh_cpp run, and of the files they name."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from sros_tool.checks.kind import ERROR, WARNING, Finding, FindingKind
from sros_tool.checks.zenoh import MALFORMED, document_findings
from sros_tool.errors import SrosError
from sros_tool.runtime.environment import (
    NO_CONFIGURATION,
    OVERRIDE,
    RMW_ZENOH,
    ROUTER_URI,
    SESSION_URI,
    override_pairs,
)
from sros_tool.runtime.rmw import RMW
from sros_tool.runtime.variables import ENABLE
from sros_tool.xml import read_bytes
from sros_tool.zenoh.document import (
    ConfigurationDocument,
    UnreadConfigurationError,
    parse_configuration,
)

_SOURCE = "rmw_zenoh_cpp (zenoh_config.cpp); 1.10.2 of Zenoh measured."
OWN_CONFIGURATION = (
    "`sros zenoh ROOT` writes the configuration of each enclave, where the CA keys are; `sros env "
    "ROOT NAME` and `sros run ROOT NAME -- COMMAND...` set the variables of an enclave."
)

NO_SESSION_FILE = FindingKind(
    "runtime.zenoh-open",
    ERROR,
    "rmw_zenoh runs open although security is enabled",
    "rmw_zenoh reads no ROS_SECURITY_* variable and no file of an enclave. Without a session file, "
    "every node uses the default of rmw_zenoh_cpp: no TLS, no access control.",
    _SOURCE,
    f"Set ZENOH_SESSION_CONFIG_URI to the session.json5 of the enclave. {OWN_CONFIGURATION}",
)
FILE_NOT_FOUND = FindingKind(
    "runtime.zenoh-file-not-found",
    ERROR,
    "a variable of rmw_zenoh names no file that can be read",
    "No node, or with ZENOH_ROUTER_CONFIG_URI no router, starts.",
    _SOURCE,
    f"Correct the path. {OWN_CONFIGURATION}",
)
UNREAD = FindingKind(
    "runtime.zenoh-unread",
    WARNING,
    "a configuration of Zenoh that sros does not read",
    "Zenoh reads more than sros: YAML, lists in place of objects, pipes, more than 16 MiB. Whether "
    "the configuration enforces anything is not known.",
    _SOURCE,
    f"Write it as JSON5 objects into a file. {OWN_CONFIGURATION}",
)
OVERRIDDEN = FindingKind(
    "runtime.zenoh-overridden",
    WARNING,
    "ZENOH_CONFIG_OVERRIDE changes what a configuration of Zenoh protects",
    "It is applied after the file, for nodes and the router alike, and can switch off access "
    "control, TLS and everything else that the file states.",
    _SOURCE,
    f"Leave only the paths of certificates and keys in it. {OWN_CONFIGURATION}",
)
NO_CERTIFICATE = FindingKind(
    "runtime.zenoh-no-certificate",
    ERROR,
    "a configuration of Zenoh with TLS, and without the paths of certificates and keys",
    "No session opens with it, and no router starts.",
    "Zenoh 1.10.2, measured.",
    f"Name them in ZENOH_CONFIG_OVERRIDE. {OWN_CONFIGURATION}",
)
PROCESS_OPEN = FindingKind(
    "runtime.zenoh-process-open",
    ERROR,
    "a process of rmw_zenoh that asks for security and enforces nothing",
    "It runs without a session file, or with one that has no access control: whoever connects to "
    "it, or plays its router, reads everything from it and sends it anything.",
    _SOURCE,
    f"Stop it, and start it again. {OWN_CONFIGURATION}",
)

_NEEDED = {
    "listen": ("listen_private_key", "listen_certificate"),
    "connect": ("connect_private_key", "connect_certificate"),
}


def is_zenoh(environment: Mapping[str, str]) -> bool:
    """Return whether processes in an environment use rmw_zenoh."""
    return environment.get(RMW, "").startswith(RMW_ZENOH)


def _named_files(environment: Mapping[str, str]) -> Iterator[tuple[str, Path]]:
    """Yield the variables that name a configuration of Zenoh, and its path."""
    for name in (SESSION_URI, ROUTER_URI):
        text = environment.get(name, "")
        if text and text != NO_CONFIGURATION:
            yield name, Path(text)


def zenoh_environment_findings(environment: Mapping[str, str]) -> Iterator[Finding]:
    """Yield the findings in the variables of rmw_zenoh, and in the configurations they make."""
    if not is_zenoh(environment):
        return
    if environment.get(ENABLE) == "true" and not environment.get(SESSION_URI):
        yield NO_SESSION_FILE.found(SESSION_URI, f"{SESSION_URI} is not set")
    overrides = tuple(override_pairs(environment.get(OVERRIDE, "")))
    for name, path in _named_files(environment):
        try:
            data = read_bytes(path, "Zenoh configuration")
        except SrosError as error:
            kind = UNREAD if _may_be_read(path) else FILE_NOT_FOUND
            yield kind.found(name, str(error))
            continue
        try:
            document = parse_configuration(data, str(path))
            effective = parse_configuration(data, str(path), overrides)
        except UnreadConfigurationError as error:
            yield UNREAD.found(name, str(error), str(path))
            continue
        except SrosError as error:
            yield MALFORMED.found(name, str(error), str(path))
            continue
        yield from document_findings(effective)
        yield from _overridden(document, effective, overrides)
        yield from _certificates(effective, name)


def _may_be_read(path: Path) -> bool:
    """Return whether another program may read what sros does not read, such as a pipe."""
    try:
        return not path.is_dir() and os.access(path, os.R_OK)
    except ValueError:  # a NUL
        return False


def enforces_nothing(environment: Mapping[str, str], variable: str) -> str:
    """Return why a process has no access control, or "": it has, does not start, or is not known.

    What is not known, the findings on its environment say.

    ``variable`` is the one that names its configuration.
    """
    text = environment.get(variable, "")
    if not text:
        return f"{variable} is not set"
    with suppress(SrosError):  # a finding says what is wrong with the file
        data = read_bytes(Path(text), "Zenoh configuration")
        return open_because(data, text, environment.get(OVERRIDE, ""))
    return ""


def open_because(data: bytes, name: str, override: str) -> str:
    """Return why a configuration has no access control, as a clause, or "" if it has.

    ``name`` is the name of the file; ``override`` is the value of ZENOH_CONFIG_OVERRIDE.

    Raises:
        SrosError: sros cannot read the configuration.
    """
    document = parse_configuration(data, name, override_pairs(override), lines=False)
    return "" if document.access.enabled else f"access_control is off in '{name}' with {OVERRIDE}"


def _overridden(
    stated: ConfigurationDocument,
    effective: ConfigurationDocument,
    overrides: tuple[tuple[str, str], ...],
) -> Iterator[Finding]:
    """Yield a finding if more changed than the router to connect to, and paths of TLS."""
    unchanged = replace(
        effective, connect=stated.connect, tls=replace(effective.tls, named=stated.tls.named)
    )
    if unchanged != stated:
        keys = ", ".join(dict.fromkeys(key.strip().strip("/")[:60] for key, _ in overrides))
        yield OVERRIDDEN.found(OVERRIDE, f"it has {keys[:300]}", effective.name)


def _certificates(document: ConfigurationDocument, variable: str) -> Iterator[Finding]:
    missing: list[str] = []
    for side, needed in _NEEDED.items():
        endpoints = document.listen if side == "listen" else document.connect
        if any(each.is_encrypted() for each in endpoints):
            wanted = needed if side == "listen" or document.tls.mutual else ()
            missing += [
                each
                for each in ("root_ca_certificate", *wanted)
                if each not in document.tls.named and each not in missing
            ]
    if missing:
        text = f"{variable} and {OVERRIDE} name no {', '.join(missing)}"
        yield NO_CERTIFICATE.found(variable, text, document.name)
