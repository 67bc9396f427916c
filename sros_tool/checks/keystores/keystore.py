"""All checks of a keystore, over its enclaves by all cores."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, tzinfo
from pathlib import Path

from sros_tool.checks.keystores.authorities import check_authorities
from sros_tool.checks.keystores.documents import (
    check_documents,
    check_governance,
    check_vendors,
    governance_findings,
)
from sros_tool.checks.keystores.enclaves import EVERYTHING, LONG_PERMISSIONS, check_enclave
from sros_tool.checks.keystores.files import check_files
from sros_tool.checks.keystores.issued import (
    Traits,
    check_issued,
    check_policy,
    traits_of,
    wanted_rights,
)
from sros_tool.checks.keystores.opened import CheckedEnclave, CheckedKeystore, read_keystore
from sros_tool.checks.kind import Finding
from sros_tool.dds.governance import parse_governance
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import GOVERNANCE_P7S, REQUEST, enclave_path
from sros_tool.keystore.reader import open_enclave as load_enclave
from sros_tool.parallel import map_slices
from sros_tool.pki import smime
from sros_tool.policy.model import Policy
from sros_tool.policy.rights import Right

_MANY = 3
_GOVERNANCE = "governance.p7s"
_OF_THE_WHOLE = frozenset({EVERYTHING.id, LONG_PERMISSIONS.id})
"""What enclaves have in common by the way in which their keystore was made."""


def keystore_findings(
    root: Path,
    *,
    now: datetime,
    zone: tzinfo = UTC,
    domain: int | None = None,
    policies: tuple[Policy, ...] = (),
    only: Sequence[str] | None = None,
) -> list[Finding]:
    """Everything that is found in a keystore, or in the enclaves ``only``; `KeystoreError` if none.

    ``zone`` is the time zone of the host on which its enclaves run, ``domain`` the one that they
    have to join; with ``policies``, their rights are compared with those.
    """
    keystore = read_keystore(root, now=now, zone=zone, policies=policies)
    names = keystore.names if only is None else tuple(only)
    wanted = wanted_rights(keystore)
    first = next((name for name in names if (enclave_path(root, name) / _GOVERNANCE).exists()), "")

    def work(share: Sequence[str]) -> tuple[list[Finding], list[Traits]]:
        found: list[Finding] = []
        traits: list[Traits] = []
        for name in share:
            enclave = _open(keystore, name, domain)
            found += enclave_findings(enclave, wanted, alone=name != first)
            if each := traits_of(enclave):
                traits.append(each)
        return found, traits

    outcomes = [outcome for _, outcome in map_slices(names, work)]
    found = [finding for findings, _ in outcomes for finding in findings]
    if only is None:
        traits = [each for _, all_traits in outcomes for each in all_traits]
        common = [*check_files(keystore), *check_authorities(keystore)]
        if not first and keystore.governance:
            common += _governance_alone(keystore)
        found = [*common, *check_issued(keystore, traits), *found]
    real_root = os.path.realpath(root)
    located = (_at_real_file(each, root, real_root) for each in found)
    return joined([_with_names(each, root) for each in located])


def enclave_findings(
    enclave: CheckedEnclave, wanted: dict[str, frozenset[Right]], *, alone: bool
) -> Iterator[Finding]:
    """Everything that is found in one enclave."""
    yield from check_enclave(enclave)
    documents = list(check_documents(enclave))
    yield from documents
    yield from check_governance(enclave, alone=alone)
    yield from check_vendors(enclave, outside=bool(documents))
    yield from check_policy(enclave, wanted)


def joined(findings: Sequence[Finding]) -> list[Finding]:
    """``findings`` with one in place of many that say the same of one file, or by one choice."""
    together: dict[tuple[object, ...], list[Finding]] = {}
    for each in findings:
        one = each.accepted or each.id in _OF_THE_WHOLE
        place = (each.accepted,) if one else (each.file, each.line, each.text)
        together.setdefault((each.id, *place), []).append(each)
    return [_one_of(group) for group in together.values()]


def _governance_alone(keystore: CheckedKeystore) -> Iterator[Finding]:
    """The governance of a keystore that has no enclave yet."""
    with suppress(SrosError):  # whoever makes an enclave is told
        document = smime.parse(keystore.governance).document
        governance = parse_governance(document, GOVERNANCE_P7S)
        yield from governance_findings(keystore, governance, keystore.shown(GOVERNANCE_P7S))


def _at_real_file(finding: Finding, root: Path, real_root: str) -> Finding:
    """``finding``, at the file that all enclaves share where theirs is a link to that."""
    if "/enclaves/" not in finding.file or finding.id.startswith("keystore.link"):
        return finding
    real = Path(os.path.realpath(finding.file))
    if not Path(finding.file).is_symlink() or not real.is_relative_to(real_root):
        return finding
    return replace(finding, file=str(root / real.relative_to(real_root)))


def _with_names(finding: Finding, root: Path) -> Finding:
    """``finding`` with what the commands of its remedy are to name."""
    remedy = re.sub(r"\bROOT\b", lambda _: str(root), finding.remedy)
    if finding.subject.startswith("/") and "," not in finding.subject:
        remedy = re.sub(r"\bNAME\b", finding.subject, remedy)
    return finding if remedy == finding.remedy else replace(finding, own_remedy=remedy)


def _one_of(group: list[Finding]) -> Finding:
    subjects = list(dict.fromkeys(each.subject for each in group))
    if len(subjects) == 1:
        return group[0]
    shown = ", ".join(subjects[:_MANY])
    more = f" and {len(subjects) - _MANY} more" if len(subjects) > _MANY else ""
    return replace(group[0], subject=shown + more)


def _open(keystore: CheckedKeystore, name: str, domain: int | None) -> CheckedEnclave:
    folder = enclave_path(keystore.root, name)
    state = load_enclave(folder, now=keystore.now, domain=domain)
    elsewhere = (folder / REQUEST).exists() and not (folder / "key.pem").exists()
    return CheckedEnclave(keystore, name, state, elsewhere and keystore.is_home)
