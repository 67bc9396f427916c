"""Sources of pictures: policies, permissions, keystores and observations.

A picture shows only the base name of a source, because paths of this machine are private.
Enclave keys are read only to report faults such as a key that does not fit its certificate.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from cryptography import x509

from sros_tool.dds.governance import Governance
from sros_tool.dds.permissions import Grant
from sros_tool.errors import DocumentError, SrosError
from sros_tool.files import policies_dir
from sros_tool.fleet.robots import Fleet
from sros_tool.graph.learn import learn
from sros_tool.graph.observation import from_json
from sros_tool.keystore.layout import PUBLIC, is_keystore
from sros_tool.keystore.participant import evaluated
from sros_tool.keystore.protection import with_stated
from sros_tool.keystore.reader import (
    Keystore,
    OpenedEnclave,
    open_enclave,
)
from sros_tool.keystore.rights import is_zenoh, load_rights
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import (
    authority_text,
    load_certificates,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import algorithm
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy, StatedProtection
from sros_tool.policy.rights import Right, policy_rights
from sros_tool.report.compose import PictureSource
from sros_tool.report.picture import PicturedEnclave, PicturedFinding, SourceTitle, Validity
from sros_tool.translate import governance_for
from sros_tool.validity import iso
from sros_tool.values import parse_json
from sros_tool.xml import read_bytes

_LINK = re.compile(r"(it is a broken link) \([^)]*\)")
_AUTHORITY_FILES = "*_ca.cert.pem"


def read_source(path: Path, *, now: datetime, fleet: Fleet | None = None) -> PictureSource:
    """Return the source at ``path``: a policy, permissions, an enclave, a keystore, an observation.

    An observation is a learned policy, or the output of ``sros generate_policy --json``.  Faults of
    a keystore become findings.  ``fleet`` has the robots that placeholders in a policy stand for.

    Raises:
        DocumentError: ``path`` is none of these.
    """
    data = read_bytes(path, "file") if path.is_file() else b""
    if data.lstrip()[:1] == b"{" and not is_zenoh(data):
        return _observation(path)
    opened = Keystore(path) if path.is_dir() and is_keystore(path) else None
    read = load_rights(opened or path, fleet)
    findings = tuple(PicturedFinding(note.id, "warning", note.text) for note in read.notes)
    source = PictureSource(
        SourceTitle(_base_name(path), read.kind), read.rights, findings=findings, scope=read.scope
    )
    if read.policy:
        nodes, stated = _nodes(read.policy), read.protections or ()
        source = replace(source, nodes=nodes, protections=stated, policy=read.policy)
    elif opened:
        source = _with_keystore(source, opened, now)
    elif read.kind == "enclave":
        source = _with_enclave(source, path, now)
    places = _places(path)
    return replace(
        with_findings(replace(source, findings=()), path, source.findings),
        enclaves=tuple(
            replace(
                enclave, problems=tuple(_without_path(text, places) for text in enclave.problems)
            )
            for enclave in source.enclaves
        ),
    )


def with_findings(
    source: PictureSource, path: Path, findings: Iterable[PicturedFinding]
) -> PictureSource:
    """Return ``source``, read from ``path``, with more findings, without the path in their texts.

    A finding keeps its enclave only if the source has an enclave of that name.
    """
    known = {enclave.path for enclave in source.enclaves} | {
        right.enclave for right in source.rights
    }
    places = _places(path)
    found = tuple(_without_paths(_placed(finding, known), places) for finding in findings)
    return replace(source, findings=tuple(dict.fromkeys((*source.findings, *found))))


def _base_name(path: Path) -> str:
    """Return the base name of a source, in characters that every format supports."""
    name = path.absolute().name or "/"
    return "".join(
        letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in name
    )


def common_rights() -> tuple[Right, ...]:
    """Return the rights that every node needs, from the policy that ships with sros."""
    policy = read_policy(policies_dir() / "defaults" / "node_basics.xml")
    return tuple(sorted(policy_rights(policy)))


def template_governance(choice: str, stated: Sequence[StatedProtection] = ()) -> Governance:
    """Return the governance of a keystore made from the template ``choice`` and a policy.

    ``stated`` is what the policy says about the protection of names.
    """
    from sros_tool.dds.domains import DomainSet

    protection = with_stated(load_template(choice).protection, stated)
    return governance_for(protection, DomainSet.of((0, 0)))


def _nodes(policy: Policy) -> dict[str, tuple[str, ...]]:
    return {
        enclave.path: tuple(
            sorted({f"{each.ns.rstrip('/')}/{each.node}" for each in enclave.all_profiles()})
        )
        for enclave in policy.enclaves
    }


def _observation(path: Path) -> PictureSource:
    try:
        observed = from_json(parse_json(read_bytes(path, "file")))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DocumentError(
            f"'{path}' is not an observation",
            "It contains JSON, but not the output of `sros generate_policy --json`.",
        ) from error
    learned = learn(observed)
    policy = learned.policy()
    notes = tuple(PicturedFinding(note.id, "note", note.text) for note in learned.notes)
    return PictureSource(
        SourceTitle(_base_name(path), "observation"),
        policy_rights(policy),
        _nodes(policy),
        findings=notes,
    )


# ── keystores ──────────────────────────────────────────────────────────────────────────────


def _with_keystore(source: PictureSource, keystore: Keystore, now: datetime) -> PictureSource:
    findings = list(source.findings)
    governance = None
    try:
        governance = keystore.governance
    except SrosError as error:
        findings.append(PicturedFinding("view.no-governance", "error", str(error)))
    enclaves, validities = [], set()
    for name in keystore.names:
        opened = keystore.enclave(name, now=now)
        evaluation = evaluated(name, keystore.folder(name), opened, at=now)
        enclaves.append(_described(name, evaluation.state, evaluation.problems))
        validities |= set(_validities_of(name, evaluation.state))
    try:
        validities |= set(_authorities(keystore))
    except SrosError as error:
        findings.append(PicturedFinding("view.no-authorities", "error", str(error)))
    return replace(
        source,
        keystore=keystore,
        enclaves=tuple(enclaves),
        governance=governance,
        validities=tuple(sorted(validities)),
        findings=tuple(findings),
    )


def _with_enclave(source: PictureSource, folder: Path, now: datetime) -> PictureSource:
    name = next(iter(sorted(source.scope or ())), _base_name(folder))
    evaluation = evaluated(name, folder, open_enclave(folder, now=now), at=now)
    state = evaluation.state
    return replace(
        source,
        enclaves=(_described(name, state, evaluation.problems_here),),
        governance=state.governance,
        validities=tuple(sorted(_validities_of(name, state))),
    )


def _described(name: str, state: OpenedEnclave, problems: tuple[str, ...]) -> PicturedEnclave:
    certificate = state.certificate
    if certificate is None:
        return PicturedEnclave(name, "", problems=problems)
    return PicturedEnclave(
        name,
        "",
        subject=subject_text(certificate.subject),
        issuer=subject_text(certificate.issuer),
        serial=f"{certificate.serial_number:x}",
        key=algorithm(certificate.public_key()),
        problems=problems,
    )


def _validities_of(name: str, state: OpenedEnclave) -> Iterator[Validity]:
    if state.certificate:
        yield _certificate(state.certificate, "certificate", name, name)
    for grant in state.permissions.grants if state.permissions else ():
        yield _grant(grant, name)


def _grant(grant: Grant, name: str) -> Validity:
    window = grant.validity
    return Validity(iso(window.not_after), iso(window.not_before), "permissions", name, name)


def _certificate(certificate: x509.Certificate, kind: str, title: str, name: str) -> Validity:
    window = validity_of(certificate)
    return Validity(iso(window.not_after), iso(window.not_before), kind, title, name)


def _authorities(keystore: Keystore) -> Iterator[Validity]:
    """Yield the validity of every CA certificate and revocation list."""
    roles: dict[x509.Certificate, list[str]] = defaultdict(list)
    for path in sorted((keystore.root / PUBLIC).glob(_AUTHORITY_FILES)):
        role = path.name.removesuffix("_ca.cert.pem")
        for certificate in load_certificates(keystore.read(path, "CA certificate"), "of the CA"):
            roles[certificate].append(role)
    for certificate, found in roles.items():
        named = [role for role in found if role != "ca"] or found
        title = f"{' and '.join(dict.fromkeys(named))} CA, {authority_text(certificate)}"
        yield _certificate(certificate, "authority", title, "")
    for crl in keystore.revocation_lists:
        title = f"revocation list {crl.number}"
        yield Validity(iso(crl.next_update), iso(crl.this_update), "revocation list", title)


# ── removing paths of this machine ─────────────────────────────────────────────────────────


def _placed(finding: PicturedFinding, known: Set[str]) -> PicturedFinding:
    if not finding.enclave or finding.enclave in known:
        return finding
    return replace(finding, enclave="", text=f"{finding.enclave}: {finding.text}")


def _without_paths(finding: PicturedFinding, places: Mapping[str, str]) -> PicturedFinding:
    text, remedy = (_without_path(each, places) for each in (finding.text, finding.remedy))
    return replace(finding, text=text, remedy=remedy)


def _places(path: Path) -> Mapping[str, str]:
    """Map every form of the path of a source to its base name, the longest first."""
    places = sorted({str(path), str(path.absolute()), os.path.realpath(path)}, key=len)
    return {place: _base_name(path) for place in reversed(places) if "/" in place and place != "/"}


def _without_path(text: str, places: Mapping[str, str]) -> str:
    """Return ``text`` with the base name of the source instead of its path."""
    for place, name in places.items():
        text = text.replace(place, name)
    return _LINK.sub(r"\1", text)
