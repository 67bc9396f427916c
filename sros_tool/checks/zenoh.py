"""Checks of a configuration of Zenoh, as rmw_zenoh reads it for a router or a session."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sros_tool.checks.kind import ERROR, Finding, FindingKind
from sros_tool.errors import DocumentError
from sros_tool.xml import read_bytes
from sros_tool.zenoh.document import ConfigurationDocument, parse_configuration

MALFORMED = FindingKind(
    "zenoh.malformed",
    ERROR,
    "a configuration that Zenoh does not accept",
    "No session opens with it, and no router starts.",
    "Zenoh 1.10.2 (commons/zenoh-config), measured.",
    "Correct the file.",
)
NO_ACCESS_CONTROL = FindingKind(
    "zenoh.no-access-control",
    ERROR,
    "a process of Zenoh without access control",
    "Whoever gets a connection to it publishes, hears, calls and serves everything: also a router "
    "without rights of its own, to which a session connects.",
    "Zenoh 1.10.2, measured.",
    "Let `sros zenoh` write the files of a keystore.",
)


def configuration_findings(path: Path) -> Iterator[Finding]:
    """Yield the findings in a configuration of Zenoh; one that cannot be read is a finding too."""
    data = read_bytes(path, "Zenoh configuration")
    try:
        document = parse_configuration(data, str(path))
    except DocumentError as error:
        yield MALFORMED.found(str(path), str(error), str(path))
        return
    yield from _access(document)


def _access(document: ConfigurationDocument) -> Iterator[Finding]:
    if not document.access.enabled:
        line = document.line_of("access_control/enabled")
        yield NO_ACCESS_CONTROL.found(
            document.mode.value, "access_control is off", document.name, line
        )
