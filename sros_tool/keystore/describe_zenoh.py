"""Descriptions of Zenoh configurations as JSON values, signed or not."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from sros_tool.errors import SrosError
from sros_tool.keystore.layout import CERTIFICATE_FILE, PERMISSIONS_FILE, ZENOH_SIGNED
from sros_tool.keystore.reader import open_enclave
from sros_tool.keystore.zenoh.opened import OpenedZenoh, ZenohFault, open_zenoh
from sros_tool.pki.certificates import common_name_of
from sros_tool.policy.rights import KIND_OF
from sros_tool.translate_zenoh import domains_of, stated_names
from sros_tool.zenoh.access import AccessRule
from sros_tool.zenoh.configuration import Configuration, Mode, parse_rendered
from sros_tool.zenoh.document import parse_configuration

_ABOUT_THE_CONTENT = (
    ZenohFault.OTHER_DOCUMENT,
    ZenohFault.MALFORMED,
    ZenohFault.OUT_OF_DATE,
    ZenohFault.OTHER_NAME,
)


def describe_configuration(document: bytes) -> dict[str, Any]:
    """Describe any Zenoh configuration; ``rights`` only of one that sros wrote.

    Raises:
        DocumentError: Zenoh would not accept it.
    """
    found = parse_configuration(document, "its content")
    own: Configuration | None = None
    with suppress(SrosError):
        own = parse_rendered(document, "its content")
    access = found.access
    return {
        "kind": "Zenoh configuration",
        "mode": found.mode.value,
        "connect": [each.text for each in found.connect],
        "listen": [each.text for each in found.listen],
        "access_control": {
            "enabled": access.enabled,
            "default": "allow" if access.allows_by_default else "deny",
            "rules": len(access.rules),
            "subjects": len(access.subjects),
        },
        "made_by_sros": own is not None,
        "domains": sorted(domains_of(own.access_control)) if own else [],
        "rights": _rights(own) if own else [],
    }


def _rights(configuration: Configuration) -> list[dict[str, Any]]:
    """Return what each remote enclave may do here, and whether it is as the router of a session.

    The router of a session in client mode may send what the session may get, and the reverse: its
    entry shows the rights of the session's own enclave.
    """
    is_client = configuration.mode is Mode.CLIENT
    return [
        {
            "enclave": each.common_name,
            "own_rights_by_router": is_client,
            "may": _names(rule.mirrored() if is_client else rule for rule in each.rules),
        }
        for each in configuration.access_control.remotes
    ]


def _names(rules: Iterable[AccessRule]) -> dict[str, dict[str, list[str]]]:
    """Map the names that rules allow, by kind and right, as descriptions of permissions do."""
    table: dict[str, dict[str, list[str]]] = {}
    for right, name in stated_names(rules):
        table.setdefault(KIND_OF[right], {}).setdefault(right, []).append(name)
    return table


def opened_at(folder: Path, now: datetime) -> OpenedZenoh | None:
    """Return the Zenoh configurations of the enclave in ``folder``; None if it is no enclave."""
    if not all((folder / file).exists() for file in (CERTIFICATE_FILE, PERMISSIONS_FILE)):
        return None
    state = open_enclave(folder, now=now)
    name = common_name_of(state.certificate.subject) if state.certificate else ""
    return open_zenoh(folder, name, state)


def content_problems(path: Path, now: datetime) -> list[str]:
    """Return how a configuration, or a signed one, does not fit the enclave that it lies in.

    Of a configuration, `describe` itself says whether it is the document that was signed.
    """
    told = {ZenohFault.OTHER_DOCUMENT} if path.name in ZENOH_SIGNED else set()
    names = [pair for pair in ZENOH_SIGNED.items() if path.name in pair]
    opened = opened_at(path.absolute().parent, now) if names else None
    return [
        str(each)
        for each in (opened.problems if opened else ())
        if each.fault in _ABOUT_THE_CONTENT
        and each.fault not in told
        and each.file in (*names[0], CERTIFICATE_FILE)
    ]
