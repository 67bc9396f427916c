"""Descriptions of keystores, enclaves, certificates and signed documents, and of their history."""

from __future__ import annotations

import binascii
import hashlib
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from cryptography import x509

from sros_tool.dataclass import dataclass
from sros_tool.dds.governance import Governance, parse_governance, values_of
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions
from sros_tool.errors import DocumentError, SrosError
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    GOVERNANCE_P7S,
    KEY_URI_FILE,
    PERMISSIONS_FILE,
    PUBLIC,
    RETIRED,
    REVOKED,
    ROLES,
    SETTINGS,
    ZENOH_SIGNED,
    ca_certificate,
    ca_key,
    enclave_folder,
    enclave_path,
    is_keystore,
    list_enclaves,
    permissions_ca_for,
    refuse_earlier,
    revoked_certificates,
    search_enclaves,
)
from sros_tool.keystore.ledger import GAP, Entry
from sros_tool.keystore.participant import EvaluatedEnclave, evaluated
from sros_tool.keystore.reader import FilesReadOnce, Keystore, OpenedEnclave, open_enclave
from sros_tool.keystore.zenoh_files import OpenedZenoh, ZenohFault, open_zenoh
from sros_tool.pki.certificates import (
    common_name_of,
    digest,
    load_certificates,
    subject_text,
    validity_of,
)
from sros_tool.pki.chains import Checks, chain_fault
from sros_tool.pki.crl import CRL_MARK, RevocationList, load_crl
from sros_tool.pki.keys import algorithm, holds_private_key, load_key
from sros_tool.pki.token import TokenUri, read_token_file
from sros_tool.policy.rights import KIND_OF
from sros_tool.translate import RosRight, ros_rights
from sros_tool.translate_zenoh import domains_of, stated_names
from sros_tool.validity import iso
from sros_tool.xml import parse, read_bytes
from sros_tool.zenoh.access import AccessRule
from sros_tool.zenoh.configuration import Configuration, Mode, ZenohNetwork, parse_rendered
from sros_tool.zenoh.document import parse_configuration

Description = dict[str, Any]
_JSON = (".json5", ".json")


def describe(
    path: Path,
    *,
    now: datetime,
    authority: Path | None = None,
    files: FilesReadOnce | None = None,
) -> Description:
    """Describe the content of ``path`` as a JSON value; ``kind`` selects the other fields.

    Kinds: keystore, enclave, certificate, revocation list, private key, permissions, governance,
    Zenoh configuration.

    Args:
        path: a keystore, the folder of an enclave, or a file of one.
        now: the moment for which validity is reported.
        authority: the permissions CA certificate that verifies a signed document; by default the
            one next to it.
        files: those that were read before.

    Raises:
        DocumentError: ``path`` is none of these kinds, or cannot be read.
    """
    files = files or FilesReadOnce()
    if path.is_dir():
        if is_keystore(path):
            return _keystore(path, now)
        if any((path / name).exists() for name in ("cert.pem", "permissions.p7s", KEY_URI_FILE)):
            return {
                "kind": "enclave",
                "path": str(path),
                **_describe_enclave(
                    evaluated("", path, open_enclave(path, now=now, files=files), at=now)
                ),
                **_zenoh(path, now),
            }
        refuse_earlier(path)
        raise DocumentError(
            f"'{path}' is neither a keystore nor an enclave",
            "It has no enclaves folder, and neither cert.pem nor permissions.p7s.",
        )
    data = files.read(path, "file")
    try:
        return {"path": str(path), **_file(path, data, now, authority, files)}
    except SrosError as error:
        raise DocumentError(f"'{path}' cannot be read: {error.what}", error.why) from error


def _file(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> Description:
    """Describe a file; its content decides the kind, not its name."""
    if b"-----BEGIN CERTIFICATE-----" in data:
        return {"kind": "certificate", **_certificates(data, "in it", now)}
    if CRL_MARK in data:
        return {"kind": "revocation list", **_revocation_list(load_crl(data, "in it"), now)}
    if path.name == KEY_URI_FILE:
        return {"kind": "key on a token", **_token(read_token_file(data))}
    if holds_private_key(data):
        mode = path.stat().st_mode & 0o777
        key = load_key(data, "in it")
        return {"kind": "private key", "algorithm": algorithm(key), "mode": f"{mode:04o}"}
    if b"multipart/signed" in data[:1000].lower():
        return _signed(path, data, now, authority, files)
    if data.lstrip()[:1] == b"<":
        return {**_document(data, now), "signed": False, "signature_verified": False}
    if path.suffix in _JSON or data.lstrip()[:1] == b"{":
        return _configuration(path, data, now, authority, files)
    raise DocumentError(
        "it is neither a PEM certificate, revocation list or key, nor a signed document, nor XML, "
        "nor a Zenoh configuration",
    )


def _configuration(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> Description:
    """Describe a Zenoh configuration, with the signature of the same document next to it."""
    described = _describe_configuration(data)
    signature: Description = {"signed": False, "signature_verified": False}
    signed = path.with_name(ZENOH_SIGNED.get(path.name, path.name))
    if signed != path and signed.exists():
        message = files.read(signed, "signed document")
        signature = _signature(signed, message, now, authority, files)
        if files.signed(message).text != data:
            problem = f"it is not the document that was signed in {signed.name}"
            signature |= {"signature_verified": False, "signature_problem": problem}
    return {**described, "problems": _content_problems(path, now), **signature}


def _keystore(root: Path, now: datetime) -> Description:
    keystore = Keystore(root)
    settings = keystore.settings
    authorities: Description = {}
    for role in ROLES:
        path = root / ca_certificate(role)
        if not path.exists():
            continue
        try:
            authorities[role] = {
                **_certificates(keystore.read(path, "file"), f"'{path}'", now),
                "key_present": (root / ca_key(role)).exists(),
            }
        except SrosError as error:
            authorities[role] = {"error": str(error)}
    names, unread = search_enclaves(root)
    enclaves = [
        _enclave(enclave_path(root, name), name, keystore.enclave(name, now=now), now)
        for name in names
    ]
    governance: Description | None = None
    if (root / GOVERNANCE_P7S).exists():
        try:
            governance = describe(root / GOVERNANCE_P7S, now=now, files=keystore.files)
        except SrosError as error:
            governance = {"error": str(error)}
        if governance.get("kind", "governance") != "governance":
            governance = {"error": f"it is a {governance['kind']} document"}
    problems = [f"{e['name']}: {problem}" for e in enclaves for problem in e["problems"]]
    unreadable = [f"'{each.path}' cannot be read: {each.why}" for each in unread]
    problems += unreadable
    problems += [f"{role} CA: {a['error']}" for role, a in authorities.items() if "error" in a]
    if governance and "error" in governance:
        problems.append(f"governance: {governance['error']}")
    try:
        gaps = list(keystore.ledger.gaps)
    except SrosError as error:
        gaps = [str(error)]
    problems += [f"ledger: {gap}" for gap in gaps]
    return {
        "kind": "keystore",
        "path": str(root),
        "template": settings.name if settings else None,
        "ledger": gaps,
        "authorities": authorities,
        "governance": governance,
        "zenoh": _network(settings.zenoh) if settings and settings.zenoh else None,
        "enclaves": enclaves,
        "unreadable": unreadable,
        "problems": problems,
    }


def _network(network: ZenohNetwork) -> Description:
    return {
        "router": network.router,
        "endpoints": list(network.endpoints),
        "listen": list(network.listening()),
        "mode": network.mode.value,
    }


def _zenoh(folder: Path, now: datetime) -> Description:
    """Describe the Zenoh configurations of an enclave: the files, and what is wrong with them."""
    opened = _opened_at(folder, now)
    if opened is None or not opened.files:
        return {"zenoh": None}
    return {
        "zenoh": {
            "files": [
                {"file": file, "mode": opened.configurations[file].mode.value}
                for file in opened.files
                if file in opened.configurations
            ],
            "problems": [str(each) for each in opened.problems],
        }
    }


def _enclave(folder: Path, name: str, state: OpenedEnclave, now: datetime) -> Description:
    """Describe an enclave of a keystore; a key that stays on its robot is not a problem there."""
    evaluation = evaluated(name, folder, state, at=now)
    problems = [*evaluation.problems, *evaluation.for_some(state.problems)]
    described = {**_describe_enclave(evaluation), "problems": problems}
    return {"name": name, "key_on_robot": state.key_on_robot, **described}


def _describe_enclave(evaluation: EvaluatedEnclave) -> Description:
    """Describe an enclave; ``loadable`` says whether a process can run in it now."""
    state = evaluation.state
    domains = state.domains()
    problems = list(evaluation.problems_here)
    return {
        "loadable": not problems,
        "problems": problems,
        "subject": state.subject or None,
        "valid_until": iso(validity_of(state.certificate).not_after) if state.certificate else None,
        "expires": iso(until) if (until := state.valid_until()) else None,
        **_authority("identity_ca", state.identity_ca),
        **_authority("permissions_ca", state.permissions_ca),
        "domains": str(domains) if domains else None,
        "token": _token(state.token) if state.token else None,
        "permissions": _permissions(state.permissions) if state.permissions else None,
        "permissions_bytes": state.permissions_bytes,
    }


def _token(place: TokenUri) -> Description:
    """Describe the place of a key on a token."""
    return {
        "token": place.token,
        "object": place.object,
        "pin_source": place.pin_source or None,
    }


def _authority(key: str, certificate: x509.Certificate | None) -> Description:
    """Return the subject of a CA as ``key``, and its SHA-256, since two CAs can have one name."""
    return {
        key: subject_text(certificate.subject) if certificate else None,
        f"{key}_sha256": digest(certificate) if certificate else None,
    }


def _describe_certificate(certificate: x509.Certificate, now: datetime) -> Description:
    """Describe the parts of a certificate that matter to DDS Security."""
    validity = validity_of(certificate)
    try:
        is_ca = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except x509.ExtensionNotFound:
        is_ca = False
    signature = certificate.signature_hash_algorithm
    return {
        "subject": subject_text(certificate.subject),
        "issuer": subject_text(certificate.issuer),
        "serial": f"{certificate.serial_number:x}",
        "is_ca": is_ca,
        "key": algorithm(certificate.public_key()),
        "signature": str(signature.name) if signature else "none",
        "sha256": digest(certificate),
        "not_before": iso(validity.not_before),
        "not_after": iso(validity.not_after),
        "valid_now": validity.contains(now),
    }


def _certificates(data: bytes, name: str, now: datetime) -> Description:
    """Describe the first certificate of a PEM file, its "further" certificates, and its "crl"."""
    certificate, *further = load_certificates(data, name)
    described = _describe_certificate(certificate, now)
    if further:  # the chain of a CA, or the other CA during a rotation
        described["further"] = [_describe_certificate(each, now) for each in further]
    if CRL_MARK in data:
        described["crl"] = _revocation_list(load_crl(data, name), now)
    return described


def _revocation_list(crl: RevocationList, now: datetime) -> Description:
    """Describe a revocation list; with an expired one DDS refuses all certificates of its CA."""
    return {
        "issuer": subject_text(crl.list.issuer),
        "number": crl.number,
        "not_before": iso(crl.this_update),
        "not_after": iso(crl.next_update),
        "valid_now": crl.this_update <= now <= crl.next_update,
        "revoked": [f"{each.serial:x}" for each in crl.revoked],
    }


def _signed(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> Description:
    signed = files.signed(data)
    signature = _signature(path, data, now, authority, files)
    if signed.document.lstrip()[:1] == b"<":
        return {**_document(signed.document, now), **signature}
    described = _describe_configuration(signed.text)
    return {**described, "problems": _content_problems(path, now), **signature}


def _signature(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> Description:
    """Describe the signature of the signed document ``data`` at ``path``."""
    signed = files.signed(data)
    signer = signed.signer()
    found = authority or permissions_ca_for(path)
    reason = "no permissions CA certificate is next to it; name one with --ca"
    verified: bool | None = None
    if found:
        certificates = load_certificates(files.read(found, "certificate"), f"'{found}'")
        try:
            signed.verify(certificates[0])
            reason = chain_fault(certificates[0], certificates, at=now, checks=Checks.DOCUMENTS)
        except SrosError as error:
            reason = str(error)
        verified = not reason
    return {
        "signed": True,
        **_authority("signer", signer),
        "digest": signed.digest,
        "bytes": len(data),
        "signature_verified": verified,
        "signature_problem": reason,
    }


def _document(document: bytes, now: datetime) -> Description:
    root = parse(document, "its content")
    if root.find("domain_access_rules") is not None:
        return {"kind": "governance", **_governance(parse_governance(document, "its content"))}
    permissions = parse_permissions(document, "its content")
    return {"kind": "permissions", "grants": _permissions(permissions, now)}


def _permissions(permissions: Permissions, now: datetime | None = None) -> list[Description]:
    return [_grant(grant, now) for grant in permissions.grants]


def _grant(grant: Grant, now: datetime | None) -> Description:
    described: Description = {
        "name": grant.name,
        "subject": grant.subject,
        "not_before": grant.not_before,
        "not_after": grant.not_after,
    }
    if now is not None:
        described["valid_now"] = grant.validity.contains(now)
    described["rules"] = [
        {
            "qualifier": "ALLOW" if rule.allow else "DENY",
            "domains": str(rule.domains),
            "rights": _rights(ros_rights(rule)),
            "partitions": sorted(
                {p for c in (*rule.publish, *rule.subscribe) for p in c.partitions}
            ),
        }
        for rule in grant.rules
    ]
    described["default"] = "ALLOW" if grant.default_allow else "DENY"
    return described


def _rights(rights: Iterable[RosRight]) -> Description:
    """Map ROS names by kind and right, such as ``{"topics": {"publish": ["/chatter"]}}``."""
    table: Description = {}
    for right in rights:
        table.setdefault(right.kind, {}).setdefault(right.right, []).append(right.name)
    return table


def _governance(governance: Governance) -> Description:
    return {
        "domain_rules": [
            {
                "domains": str(rule.domains),
                **values_of(rule),
                "topic_rules": [
                    {"topic_expression": topic.topic_expression, **values_of(topic)}
                    for topic in rule.topic_access_rules
                ],
            }
            for rule in governance.domain_access_rules
        ]
    }


# ── configurations of Zenoh ───────────────────────────────────────────────────────────────


_ABOUT_THE_CONTENT = (
    ZenohFault.OTHER_DOCUMENT,
    ZenohFault.MALFORMED,
    ZenohFault.OUT_OF_DATE,
    ZenohFault.OTHER_NAME,
)


def _describe_configuration(document: bytes) -> dict[str, Any]:
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
        "rights": _remote_rights(own) if own else [],
    }


def _remote_rights(configuration: Configuration) -> list[dict[str, Any]]:
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


def _opened_at(folder: Path, now: datetime) -> OpenedZenoh | None:
    """Return the Zenoh configurations of the enclave in ``folder``; None if it is no enclave."""
    if not all((folder / file).exists() for file in (CERTIFICATE_FILE, PERMISSIONS_FILE)):
        return None
    state = open_enclave(folder, now=now)
    name = common_name_of(state.certificate.subject) if state.certificate else ""
    return open_zenoh(folder, name, state)


def _content_problems(path: Path, now: datetime) -> list[str]:
    """Return how a configuration, or a signed one, does not fit the enclave that it lies in.

    Of a configuration, `describe` itself says whether it is the document that was signed.
    """
    told = {ZenohFault.OTHER_DOCUMENT} if path.name in ZENOH_SIGNED else set()
    names = [pair for pair in ZENOH_SIGNED.items() if path.name in pair]
    opened = _opened_at(path.absolute().parent, now) if names else None
    return [
        str(each)
        for each in (opened.problems if opened else ())
        if each.fault in _ABOUT_THE_CONTENT
        and each.fault not in told
        and each.file in (*names[0], CERTIFICATE_FILE)
    ]


_ISSUED = (CERTIFICATE_FILE, PERMISSIONS_FILE)
_PEM = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----(.*?)-----END \1-----\n?", re.DOTALL)


class HistoryStatus(StrEnum):
    """The state of an issued certificate or document."""

    CURRENT = "current"
    """It is in the keystore, and has not expired."""
    SUPERSEDED = "superseded"
    """It is no longer in the keystore, but neither revoked nor expired: DDS still accepts it."""
    REPLACED = "replaced"
    """Settings that the keystore had before; DDS never reads any."""
    REVOKED = "revoked"
    RETIRED = "retired"
    """A CA that was replaced, and is no longer trusted."""
    EXPIRED = "expired"
    DAMAGED = "damaged"
    """Lines of the ledger were missing or changed when the entry was made."""
    SENT = "sent"
    """It went to a robot; the keystore keeps no copy."""


@dataclass(frozen=True, slots=True)
class HistoryItem:
    """An entry of the ledger, its state, and the path of its file (or "")."""

    entry: Entry
    status: HistoryStatus
    path: str


@dataclass(frozen=True, slots=True)
class History:
    """All entries of the ledger, oldest first, and the paths of files without an entry.

    ``gaps`` are sentences about lines of the ledger that are missing, changed or unreadable.
    """

    items: tuple[HistoryItem, ...]
    unexplained: tuple[str, ...]
    gaps: tuple[str, ...]


def history(root: Path, *, now: datetime) -> History:
    """Return the ledger of a keystore, compared with its certificates and signed documents."""
    issued, revoked_files = _files(root, _active_paths(root)), _files(root, _revoked_paths(root))
    retired = _files(root, _retired_paths(root))
    keystore = Keystore(root)
    ledger = keystore.ledger
    entries = ledger.entries
    # A new CA starts with an empty revocation list, and lists drop expired certificates, so the
    # ledger is asked too.
    revoked = {each.serial for each in entries if each.what == "revocation"}
    revoked |= {f"{entry.serial:x}" for crl in keystore.revocation_lists for entry in crl.revoked}
    moment = iso(now)
    settings = _files(root, iter((SETTINGS,)))

    def status(entry: Entry) -> HistoryStatus:
        if entry.what == GAP:
            return HistoryStatus.DAMAGED
        if entry.what == "answer":
            return HistoryStatus.SENT
        if entry.what == "settings":
            return HistoryStatus.CURRENT if entry.sha256 in settings else HistoryStatus.REPLACED
        if entry.what == "revocation" or entry.serial in revoked or entry.sha256 in revoked_files:
            return HistoryStatus.REVOKED
        if entry.sha256 in retired and entry.sha256 not in issued:
            return HistoryStatus.RETIRED
        if entry.not_after and entry.not_after < moment:
            return HistoryStatus.EXPIRED
        return HistoryStatus.CURRENT if entry.sha256 in issued else HistoryStatus.SUPERSEDED

    known = {entry.sha256 for entry in entries}
    found = {**retired, **revoked_files, **issued}
    places = {**found, **settings}
    return History(
        tuple(
            HistoryItem(entry, status(entry), (places.get(entry.sha256) or [""])[0])
            for entry in entries
        ),
        tuple(
            sorted(path for digest, paths in found.items() if digest not in known for path in paths)
        ),
        ledger.gaps,
    )


def _active_paths(root: Path) -> Iterator[str]:
    """Yield the paths where DDS loads certificates and signed documents, missing files included."""
    yield from (f"{PUBLIC}/{path.name}" for path in sorted((root / PUBLIC).glob("*.cert.pem")))
    yield from (GOVERNANCE_P7S, CRL)
    for name in list_enclaves(root):
        yield from (f"{enclave_folder(name)}/{file}" for file in _ISSUED)


def _revoked_paths(root: Path) -> Iterator[str]:
    for path in revoked_certificates(root):
        yield from (f"{REVOKED}/{path.parent.name}/{file}" for file in _ISSUED)


def _retired_paths(root: Path) -> Iterator[str]:
    yield from (f"{RETIRED}/{path.name}" for path in sorted((root / RETIRED).glob("*.cert.pem")))


def _files(root: Path, paths: Iterator[str]) -> dict[str, list[str]]:
    """Map SHA-256 digests, as in the ledger, to the paths of existing files."""
    found: dict[str, list[str]] = {}
    for path in paths:
        if (root / path).is_file() and not (root / path).is_symlink():
            for digest in _digests(root / path):
                found.setdefault(digest, []).append(path)
    return found


def _digests(path: Path) -> list[str]:
    """Return the digests of a file's content; a CA file may hold several certificates."""
    data = read_bytes(path, "file")
    if not path.name.endswith("cert.pem"):
        return [hashlib.sha256(data).hexdigest()]
    found = []
    for part in _PEM.finditer(data):
        content = part[0]
        if part[1] == b"CERTIFICATE":
            try:
                content = binascii.a2b_base64(part[2])
            except binascii.Error:
                return ["unreadable"]
        found.append(hashlib.sha256(content).hexdigest())
    return found or ["unreadable"]
