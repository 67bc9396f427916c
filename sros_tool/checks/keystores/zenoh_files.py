"""Checks of the Zenoh configurations of a keystore: signature, and the rights of the permissions.

In a keystore, configurations are compared with the files that `sros zenoh` would write; on a robot,
with the permissions of their enclave.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

from sros_tool.checks.keystores.opened import CheckedEnclave, CheckedKeystore
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.dds.decision.vendors import ZENOH
from sros_tool.errors import SrosError
from sros_tool.faults import ORIGINAL_KEYSTORE, Fault
from sros_tool.keystore.layout import PERMISSIONS, SESSION_FILE, SETTINGS, ZENOH_FILES

if TYPE_CHECKING:
    from sros_tool.keystore.zenoh_files import DriftedConfiguration, OpenedZenoh

_WRITE_AGAIN_REMEDY = "Run `sros zenoh KEYSTORE`, and restart the processes that it names."
_ZENOH_SOURCE = "sros (docs/zenoh.md); Zenoh 1.10 verifies no signature of its configuration."

MISSING = FindingKind(
    "zenoh.missing",
    ERROR,
    "an enclave without its Zenoh configuration",
    "`sros run` starts no process of rmw_zenoh_cpp in the enclave; without sros, such a process "
    "runs with the default of rmw_zenoh_cpp, which is open.",
    _ZENOH_SOURCE,
    _WRITE_AGAIN_REMEDY,
)
UNSIGNED = FindingKind(
    "zenoh.unsigned",
    ERROR,
    "a Zenoh configuration that the permissions CA has not signed",
    "Anyone who could write the file may have changed its rules: the process may enforce nothing.",
    _ZENOH_SOURCE,
    _WRITE_AGAIN_REMEDY,
)
OTHER_DOCUMENT = FindingKind(
    "zenoh.other-document",
    ERROR,
    "a Zenoh configuration that differs from its signed copy",
    "Somebody changed it after it was signed, and Zenoh reads the changed file.",
    _ZENOH_SOURCE,
    f"Find out who changed it. {_WRITE_AGAIN_REMEDY}",
)
OUT_OF_DATE = FindingKind(
    "zenoh.out-of-date",
    ERROR,
    "a Zenoh configuration that does not state the rights of the signed permissions",
    "DDS and Zenoh enforce different rights: one of them enforces an earlier policy.",
    _ZENOH_SOURCE,
    _WRITE_AGAIN_REMEDY,
)
LEFT_OVER = FindingKind(
    "zenoh.left-over",
    WARNING,
    "a signed Zenoh configuration that its enclave should not have",
    "A process that uses it enforces rules that sros no longer updates.",
    _ZENOH_SOURCE,
    "Run `sros zenoh KEYSTORE`, or remove all Zenoh configurations with `sros zenoh KEYSTORE "
    "--off`.",
)
LEFT_OUT = FindingKind(
    "zenoh.left-out",
    WARNING,
    "an enclave that has no rights on Zenoh",
    "The enclave gets no configuration, and all other enclaves deny it everything.",
    _ZENOH_SOURCE,
    "State the enclave's rights with `sros create_permission KEYSTORE ENCLAVE POLICY_FILE`, or "
    "revoke it if nobody needs it.",
)
OTHER_DOMAIN = FindingKind(
    "zenoh.other-domain",
    NOTE,
    "an enclave outside the ROS domains of the Zenoh network",
    "The enclave gets no configuration, and all enclaves of the network deny it everything.",
    _ZENOH_SOURCE,
    "An enclave that runs on DDS needs no configuration. For an enclave that runs on Zenoh, "
    "name all domains of the network: `sros zenoh KEYSTORE --domain IDS`.",
)
SHARED_NODE = FindingKind(
    "zenoh.shared-node",
    WARNING,
    "a node that several enclaves may announce in the graph",
    "rmw_zenoh does not check which enclave removes a node from the graph: a process of one of "
    "these enclaves can remove or imitate the node of another enclave. The topics and services "
    "of that node are then not found, although its data still arrive.",
    "rmw_zenoh (graph_cache.cpp); sros (docs/zenoh.md).",
    "In the policy, name each node in only one enclave. If a wildcard gives an enclave the "
    "services of all nodes, deny the services of other enclaves' nodes, such as `/camera/*`.",
)
_RENEW_REMEDY = (
    "Renew the enclave with `sros renew KEYSTORE ENCLAVE`, or revoke it if nobody needs it."
)
_EXPIRY_FAULTS = {Fault.CERTIFICATE_EXPIRED, Fault.PERMISSIONS_EXPIRED}
CANNOT_BE_MADE = FindingKind(
    "zenoh.cannot-be-made",
    ERROR,
    "a Zenoh network whose configurations cannot be made",
    "The keystore's settings define the network, but its permissions or its enclaves do not fit "
    "the network, so sros does not update the files.",
    _ZENOH_SOURCE,
    "Run `sros zenoh KEYSTORE --dry-run` and do what it says.",
)

_KINDS = {
    "missing": MISSING,
    "unreadable": UNSIGNED,
    "unsigned": UNSIGNED,
    "signature": UNSIGNED,
    "other-document": OTHER_DOCUMENT,
    "malformed": OUT_OF_DATE,
    "out-of-date": OUT_OF_DATE,
}
"""Fault id → kind of finding; a wrong common name is reported as ``enclave.name-mismatch``."""


def check_own_zenoh(enclave: CheckedEnclave) -> Iterator[Finding]:
    """Yield findings about an enclave's Zenoh configurations, compared with its permissions.

    In a keystore with Zenoh settings, `check_network` reports these findings, and more.
    """
    settings = enclave.keystore.settings
    if settings and settings.zenoh:
        return
    if not any(os.path.lexists(enclave.folder / file) for file in ZENOH_FILES):
        if ZENOH in enclave.keystore.at.vendors:
            yield _zenoh_finding(MISSING, enclave, f"{SESSION_FILE} is missing", SESSION_FILE)
        return
    from sros_tool.keystore.zenoh_files import open_zenoh  # most keystores have no Zenoh files

    yield from _configuration_findings(
        enclave, open_zenoh(enclave.folder, enclave.name, enclave.state)
    )


def _configuration_findings(
    enclave: CheckedEnclave, opened_zenoh: OpenedZenoh
) -> Iterator[Finding]:
    for problem in opened_zenoh.problems:
        if kind := _KINDS.get(problem.fault.value):
            text = problem.text if problem.text != "missing" else f"{problem.file} is missing"
            yield _zenoh_finding(kind, enclave, text, problem.file)


def _zenoh_finding(kind: FindingKind, enclave: CheckedEnclave, text: str, file: str) -> Finding:
    remedy = kind.remedy
    if not enclave.keystore.is_original:
        remedy = f"In the {ORIGINAL_KEYSTORE}: run `sros zenoh KEYSTORE`."
        remedy += " Then export the enclave again."
    return kind.found(enclave.name, text, enclave.file(file), remedy=remedy)


def check_network(
    keystore: CheckedKeystore, only_enclaves: Collection[str] | None = None
) -> Iterator[Finding]:
    """Yield findings about a keystore's Zenoh network, or only about the files of some enclaves."""
    network = keystore.settings.zenoh if keystore.settings else None
    authorities = keystore.authorities.get(PERMISSIONS)
    if network is None or not authorities:
        return
    from sros_tool.keystore.zenoh_files import OTHER_DOMAINS, zenoh_drift
    from sros_tool.translate_zenoh.graph import shared_nodes

    try:
        domains = keystore.opened.domains
    except SrosError:  # each enclave's check reports the error
        return
    try:
        drift = zenoh_drift(keystore.opened, network, domains, authorities[0], keystore.at.now)
    except SrosError as error:
        yield CANNOT_BE_MADE.found("zenoh", str(error), keystore.shown_path(SETTINGS))
        return
    for file in drift.files:
        if only_enclaves is None or file.enclave in only_enclaves:
            yield from _drift_findings(keystore, file)
    for shared in shared_nodes(drift.nodes):
        if only_enclaves is None or not {*shared.enclaves, *shared.others}.isdisjoint(
            only_enclaves
        ):
            first = shared.enclaves[0]
            yield SHARED_NODE.found(first, str(shared), str(keystore.opened.folder(first)))
    for name, why in drift.left_out.items():
        if only_enclaves is not None and name not in only_enclaves:
            continue
        folder = str(keystore.opened.folder(name))
        if why == OTHER_DOMAINS:
            yield OTHER_DOMAIN.found(name, why, folder)
        else:
            faults = {e.fault for e in keystore.enclave(name).problems_in_keystore}
            remedy = _RENEW_REMEDY if faults and faults <= _EXPIRY_FAULTS else ""
            yield LEFT_OUT.found(name, why.rstrip("."), folder, remedy=remedy)


def _drift_findings(keystore: CheckedKeystore, drifted: DriftedConfiguration) -> Iterator[Finding]:
    """Yield a finding for each difference between a configuration and the keystore."""
    from sros_tool.keystore.zenoh_files import Drift, open_zenoh

    file = keystore.shown_path(drifted.path)
    if drifted.kind is Drift.STALE:
        yield LEFT_OVER.found(drifted.enclave, "sros writes no such file for this enclave", file)
        return
    if drifted.kind is Drift.FOREIGN:
        text = "sros writes no such file for this enclave"
        yield UNSIGNED.found(drifted.enclave, text, file, remedy="Remove the file.")
        return
    if drifted.kind is Drift.MISSING:
        yield MISSING.found(drifted.enclave, "it is missing, or cannot be read", file)
        return
    state = keystore.enclave(drifted.enclave)
    enclave = CheckedEnclave(keystore, drifted.enclave, state)
    findings = list(
        _configuration_findings(enclave, open_zenoh(enclave.folder, drifted.enclave, state))
    )
    text = "the settings and the permissions of the keystore give another configuration"
    yield from findings or [OUT_OF_DATE.found(drifted.enclave, text, file)]
