"""Checks of a single enclave: faults that stop a process from running in it, and weaknesses."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.checks.keystores.authorities import WEAK, key_findings, shared_ca_findings
from sros_tool.checks.keystores.opened import CheckedEnclave
from sros_tool.checks.kind import (
    ERROR,
    NOTE,
    WARNING,
    Finding,
    FindingKind,
    kinds_by_id,
    names_text,
)
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.permissions import Grant, Rule
from sros_tool.errors import SrosError
from sros_tool.faults import NOT_IN_THE_FILE, REPLACE, VENDOR_FAULTS, Fault
from sros_tool.keystore.known_keys import other_enclave
from sros_tool.keystore.layout import (
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    PERMISSIONS_CA_FILE,
    REQUEST,
    ROUTER_FILE,
    SHARED_FILES,
    ZENOH_FILES,
    enclave_path,
    is_own_copy,
    key_on_robot,
    waits_for_answer,
)
from sros_tool.keystore.reader import weaknesses
from sros_tool.pki.certificates import subject_text, validity_of
from sros_tool.pki.token import TokenUri, pin_file_problem, pin_line_break_clause
from sros_tool.translate import allows_everything
from sros_tool.validity import BACKDATE, Span, iso, parse_iso

_SAME_DAY = timedelta(days=1)
"""Tolerance for an expiry after the CA's.

ros2/sros2 makes a CA and its certificates valid for ten years each, so that certificates expire
seconds after the CA.
"""
_NOT_LOADABLE = "enclave.not-loadable"
"""The group id of all faults, for `--include` and `--exclude`."""

_LOADING_KINDS = kinds_by_id(
    *(
        FindingKind(
            f"enclave.{fault.id}",
            ERROR,
            fault.title,
            fault.why,
            fault.source,
            fault.remedy.format(root="KEYSTORE", enclave="ENCLAVE", path="FILE"),
            _NOT_LOADABLE,
        )
        for fault in Fault
        if fault not in VENDOR_FAULTS
    )
)


def _check_loading(enclave: CheckedEnclave) -> Iterator[Finding]:
    """Yield a finding for every fault that keeps a process from loading the enclave.

    A key that is only on the robot is no fault in the keystore itself.
    """
    state = enclave.state
    for problem in state.problems_in_keystore if enclave.keystore.is_original else state.problems:
        kind = _LOADING_KINDS[f"enclave.{problem.fault.id}"]
        text = problem.text if problem.text != "missing" else f"{problem.file} is missing"
        file = enclave.file(problem.file)
        remedy = fault_remedy(enclave, problem.fault, problem.file)
        lacks_key = (problem.file, problem.fault) == (KEY_FILE, Fault.FILE_MISSING)
        if lacks_key and not enclave.keystore.opened.has_keys:
            text += ", like all keys here"
            remedy = (
                "If this is a copy without keys, nothing is wrong: `--exclude "
                f"{kind.id}` hides this finding. Otherwise: {remedy}"
            )
        accepted = enclave.expiry_accepted_by if problem.fault in _EXPIRY_FAULTS else ""
        yield kind.found(enclave.name, text, file, remedy=remedy, accepted=accepted)


def fault_remedy(enclave: CheckedEnclave, fault: Fault, name: str) -> str:
    """Return what to do about a fault in the file ``name`` of an enclave.

    The text has the placeholders ``KEYSTORE`` for the keystore and ``ENCLAVE`` for the enclave.
    """
    file = enclave.file(name)
    if enclave.keystore.can_issue:
        remedy, root, path = fault.remedy_in(name), "KEYSTORE", quote(file)
        missing = SHARED_FILES.get(name, "")
        if fault not in NOT_IN_THE_FILE and is_own_copy(enclave.keystore.root, enclave.name, name):
            remedy = REPLACE
        elif missing and not (enclave.keystore.root / missing).exists():
            remedy = f"Restore {missing} from a backup; every exported enclave has a copy of it."
    else:
        made_here = key_on_robot(enclave_path(enclave.keystore.root, enclave.name))
        remedy, root = fault.remedy_in_export(name, key_made_here=made_here), "KEYSTORE"
        quoted_path = f"KEYSTORE/enclaves{quote(enclave.name)}/{name}"
        path = quoted_path if "`" in remedy else quote(file)
    return remedy.format(root=root, enclave="ENCLAVE", path=path)


EXPIRES_SOON = FindingKind(
    "enclave.ends-soon",
    WARNING,
    "a certificate or permissions that expire soon",
    "Once they expire, the node no longer starts; on Cyclone DDS a running node stops.",
    "Fast DDS 2.14.5 (at start), Cyclone DDS 0.10.2 (timer).",
    "Run `sros renew KEYSTORE ENCLAVE`, and export the enclave again.",
)
OUTLIVES_CA = FindingKind(
    "enclave.outlives-ca",
    WARNING,
    "a certificate that is valid for longer than its CA",
    "Once the CA expires, DDS refuses the certificate, whatever its own dates are.",
    "RFC 5280, 6.1.3; Fast DDS 2.14.5 and Cyclone DDS 0.10.2 verify the CA too.",
    "Let the certificate expire no later than the CA, or renew the enclave after `sros rotate_ca`.",
)
PERMISSIONS_OUTLIVE = FindingKind(
    "enclave.permissions-outlive",
    WARNING,
    "permissions that are valid for longer than the certificate",
    "They can be used with a later certificate of the same subject, even if the enclave's rights "
    "have changed since.",
    "ros2/sros2 issue 275; DDS-Security 1.1, 9.4.1.3.",
    "Run `sros renew KEYSTORE ENCLAVE`, which signs permissions that expire no later than the "
    "certificate.",
)
NAME_MISMATCH = FindingKind(
    "enclave.name-mismatch",
    WARNING,
    "a certificate with the name of another enclave",
    "The files of two enclaves were probably mixed up. DDS does not compare the subject with the "
    "folder, so the node has the rights of the other enclave.",
    "rcl 9 (security.c); ros2/sros2 (CN is the name of the enclave).",
    "Restore the files of this enclave, or create it again.",
)
IS_A_CA = FindingKind(
    "enclave.certificate-is-ca",
    ERROR,
    "an enclave whose certificate may issue certificates",
    "Anyone who has its key can issue identities that every node accepts.",
    "RFC 5280, 4.2.1.9.",
    "Revoke the enclave, and create it again.",
)
NOT_UNIQUE = FindingKind(
    "enclave.subject-not-unique",
    WARNING,
    "a subject without the unique part that the keystore adds",
    "The keystore adds a unique part to every subject, so that neither permissions of another "
    "enclave nor earlier permissions match it. This certificate was issued before the keystore "
    "did so, or elsewhere.",
    "Cyclone DDS 0.10.2 (subsets of subjects); ros2/sros2 issue 275; tested with both vendors.",
    "Run `sros renew KEYSTORE ENCLAVE`.",
)
LONG_PERMISSIONS = FindingKind(
    "enclave.long-permissions",
    WARNING,
    "permissions that are valid for years, for a subject that never changes",
    "Replaced permissions stay valid until they expire, for anyone who kept a copy.",
    "ros2/sros2 issue 275; DDS-Security 1.1, 9.4.1.3 (there is no revocation of permissions).",
    "Run `sros update_keystore KEYSTORE --set certificates.unique_subject=true`, so that subjects "
    "change with every renewal, or `sros update_keystore KEYSTORE --set "
    "permissions.validity=180d`.",
)
EVERYTHING = FindingKind(
    "keystore.allow-everything",
    WARNING,
    "an enclave that may do everything",
    "The enclave's messages are authenticated and encrypted, but it can command every node.",
    "ros2/sros2 0.13 grants this to every enclave without a policy.",
    "Give the enclave a policy, with `sros create_permission KEYSTORE ENCLAVE POLICY_FILE`.",
)
ANY_NODE = FindingKind(
    "enclave.any-node",
    NOTE,
    "an enclave that may offer the parameter services of every node",
    "A process in an enclave without a policy may start nodes of any name. So it can read and "
    "answer requests to the parameter services of other enclaves' nodes.",
    "ROS 2 design, ROS 2 DDS-Security Integration; sros (template production).",
    EVERYTHING.remedy,
)
_ANY_NODES_SERVICE = "rr/*/set_parametersReply"
ONLY_DENIALS = FindingKind(
    "keystore.only-denials",
    NOTE,
    "an enclave that may do everything except what its deny rules name",
    "The enclave's messages are authenticated and encrypted, but it can command every node whose "
    "topics and services no deny rule names.",
    EVERYTHING.source,
    EVERYTHING.remedy,
    prominent=True,
)
XML_DIFFERS = FindingKind(
    "enclave.xml-differs",
    WARNING,
    "permissions.xml differs from the signed permissions.p7s",
    "DDS loads permissions.p7s. The readable copy was changed, but never signed again.",
    "DDS-Security 1.1, 9.4.1.3; rcl 9 (security.c).",
    "Sign the intended permissions with `sros create_permission KEYSTORE ENCLAVE POLICY_FILE`.",
)
_NOT_IN_EXPORTS = "Delete permissions.xml: exports do not have this file, and DDS does not read it."
CRL_MISSING = FindingKind(
    "enclave.crl-missing",
    ERROR,
    "an enclave without the revocation list of its keystore",
    "A node of this enclave continues to communicate with revoked enclaves.",
    "rmw_dds_common (crl.pem), since 2021.",
    "Run `sros crl KEYSTORE --refresh`, and export the enclave again.",
)
WAITS = FindingKind(
    "enclave.waits-for-answer",
    NOTE,
    "an enclave whose signing request has no answer yet",
    "The enclave has a key but no certificate.",
    "sros: create_request, sign_request, import.",
    "Answer the request with `sros sign_request`, and put the answer into the enclave with `sros "
    "import`.",
)

ON_TOKEN = FindingKind(
    "portable.key-on-token",
    NOTE,
    *(Fault.KEY_ON_TOKEN.title, Fault.KEY_ON_TOKEN.why, Fault.KEY_ON_TOKEN.source),
    Fault.KEY_ON_TOKEN.remedy,
    vendors=tuple(vendor for vendor in Vendor if not vendor.traits.reads_tokens),
)
TOKEN_ON_ZENOH = FindingKind(
    "zenoh.key-on-token",
    WARNING,
    "a Zenoh configuration of an enclave whose key is on a token",
    "Zenoh reads the key only from key.pem, so a process of rmw_zenoh_cpp does not start.",
    "Zenoh 1.x (io/zenoh-links/zenoh-link-tls); rmw_zenoh_cpp.",
    "Use a key in a file, or Fast DDS.",
)
PIN_FILE = FindingKind(
    "enclave.pin-file",
    WARNING,
    "a PIN file that other users can read, or that Fast DDS cannot read",
    "Anyone who can read the file can use the key while the token is there; a node that cannot "
    "read the file does not start.",
    "RFC 7512, 2.4 and 4; libp11 0.4.12 (eng_parse.c), tested.",
    "Write only the PIN into the file. Give the file to the user that runs the node, with mode "
    "0600.",
)

_LONG_VALIDITY = timedelta(days=2 * 366)


def check_enclave(enclave: CheckedEnclave) -> Iterator[Finding]:
    """Yield the findings about a single enclave."""
    if waits_for_answer(enclave.folder):
        yield WAITS.found(enclave.name, "its certificate is missing", enclave.file(REQUEST))
        return
    yield from _check_loading(enclave)
    yield from _weakness_findings(enclave)
    if place := enclave.state.token:
        yield from _token_findings(enclave, place)
    grant = grant_of(enclave)
    if certificate := enclave.state.certificate:
        yield from _certificate_findings(enclave, certificate)
        yield from _expiry_findings(enclave, certificate, grant)
    if grant:
        yield from _rights_findings(enclave, grant)
    state = enclave.state
    known = len(enclave.keystore.authorities) > 1  # `check_authorities` compares both CAs
    if not known and state.identity_ca and state.permissions_ca:
        file = enclave.file("identity_ca.cert.pem")
        cas = (state.identity_ca, state.permissions_ca)
        yield from shared_ca_findings(enclave.keystore, *cas, file)
    yield from _copy_findings(enclave)


def _weakness_findings(enclave: CheckedEnclave) -> Iterator[Finding]:
    """Yield findings about weak cryptography of an enclave; the CAs are checked elsewhere."""
    for file, text in weaknesses(enclave.state):
        if not enclave.keystore.is_original or file not in (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE):
            yield WEAK.found(enclave.name, text, enclave.file(file))


def _token_findings(enclave: CheckedEnclave, place: TokenUri) -> Iterator[Finding]:
    """Yield findings about a key on a token, without opening the token."""
    name, file = enclave.name, enclave.file(KEY_URI_FILE)
    yield ON_TOKEN.found(name, f"its key is {place.object!r} on the token {place.token!r}", file)
    if any((enclave.folder / zenoh_file).exists() for zenoh_file in ZENOH_FILES):
        yield TOKEN_ON_ZENOH.found(name, "it has no key.pem", file)
    is_local = not enclave.keystore.is_original or Path(place.pin_source).exists()
    for problem in (pin_file_problem(place), pin_line_break_clause(place)) if is_local else ():
        if problem:
            yield PIN_FILE.found(name, problem, file)


def grant_of(enclave: CheckedEnclave) -> Grant | None:
    """Return the grant that DDS reads for the enclave.

    The result is None if there is no grant, or if the grant's validity is empty or cannot be read.
    The grant's dates may have a form that only some vendors read.
    """
    grant = enclave.state.grant
    with suppress(ValueError):
        if grant and parse_iso(grant.not_after) > parse_iso(grant.not_before):
            return grant
    return None


def _certificate_findings(
    enclave: CheckedEnclave, certificate: x509.Certificate
) -> Iterator[Finding]:
    name, file = enclave.name, enclave.file("cert.pem")
    if other_enclave(enclave.keystore.opened, name, certificate):
        text = f"its subject is {subject_text(certificate.subject)}"
        remedy = "" if enclave.keystore.looks_like_original else "Export the enclave again."
        yield NAME_MISMATCH.found(name, text, file, remedy=remedy)
    yield from key_findings(certificate, name, file)
    for extension in certificate.extensions:
        value = extension.value
        if isinstance(value, x509.BasicConstraints) and value.ca:
            yield IS_A_CA.found(name, "its BasicConstraints say CA:TRUE", file)
    ca = enclave.state.identity_ca
    if ca and validity_of(certificate).not_after - validity_of(ca).not_after > _SAME_DAY:
        text = (
            f"it expires at {iso(validity_of(certificate).not_after)}, its CA at "
            f"{iso(validity_of(ca).not_after)}"
        )
        yield OUTLIVES_CA.found(name, text, file)
    settings = enclave.keystore.settings
    if settings and settings.unique_subject and len(certificate.subject.rdns) < 2:
        text = f"its subject is only {subject_text(certificate.subject)}"
        yield NOT_UNIQUE.found(name, text, file)


def _expiry_findings(
    enclave: CheckedEnclave, certificate: x509.Certificate, grant: Grant | None
) -> Iterator[Finding]:
    now, validity = enclave.keystore.at.now, validity_of(certificate)
    windows = [("cert.pem", "the certificate", validity)]
    if grant:
        windows.append(("permissions.p7s", "the permissions", grant.validity))
        if grant.validity.not_after > validity.not_after:
            text = f"they expire at {grant.not_after}, the certificate at {iso(validity.not_after)}"
            file = enclave.file("permissions.p7s")
            yield PERMISSIONS_OUTLIVE.found(enclave.name, text, file)
    for file, subject, window in windows:
        if window.expires_soon_from() < now <= window.not_after:
            verb = "expires" if subject == "the certificate" else "expire"
            text = f"{subject} {verb} at {iso(window.not_after)}"
            accepted = enclave.expiry_accepted_by
            yield EXPIRES_SOON.found(enclave.name, text, enclave.file(file), accepted=accepted)


_EXPIRY_FAULTS = (Fault.CERTIFICATE_EXPIRED, Fault.PERMISSIONS_EXPIRED)


def _rights_findings(enclave: CheckedEnclave, grant: Grant) -> Iterator[Finding]:
    file, keystore = enclave.file("permissions.p7s"), enclave.keystore
    if allows_everything(grant):
        text = "the permissions allow publishing and subscribing every topic"
        if denied := _denied_before_everything(grant):
            yield ONLY_DENIALS.found(enclave.name, f"{text} but {names_text(denied)}", file)
        else:
            # No template accepts this finding, because the question is whether the robot is closed.
            accepted = keystore.accepted_by(EVERYTHING, lambda _: False)
            yield EVERYTHING.found(enclave.name, text, file, accepted=accepted)
    elif not _is_router(enclave) and any(
        _ANY_NODES_SERVICE in _published_expressions(rule) for rule in grant.rules if rule.allow
    ):
        text = f"the permissions allow publishing {_ANY_NODES_SERVICE}"
        yield ANY_NODE.found(enclave.name, text, file)
    unique = "," in grant.subject or "+" in grant.subject
    window = grant.validity
    length = window.not_after - window.not_before
    if length > _LONG_VALIDITY and not unique:
        accepted = keystore.accepted_by(
            LONG_PERMISSIONS, lambda s: _lasts_at_least(s.permissions_validity, length)
        )
        text = f"they are valid from {iso(window.not_before)} to {iso(window.not_after)}"
        yield LONG_PERMISSIONS.found(enclave.name, text, file, accepted=accepted)


def _is_router(enclave: CheckedEnclave) -> bool:
    """Return whether a Zenoh router runs in the enclave, whose permissions no node uses."""
    if not os.path.lexists(enclave.folder / ROUTER_FILE):
        return False
    from sros_tool.keystore.zenoh_files import router_enclaves  # most enclaves are no routers

    keystore = enclave.keystore
    with suppress(SrosError):  # another check reports settings that cannot be read
        return enclave.name in router_enclaves(keystore.opened, keystore.at.now)
    return False


def _published_expressions(rule: Rule) -> set[str]:
    """Return the topic expressions in the publish criteria of a rule."""
    return {topic for criteria in rule.publish for topic in criteria.topics}


def _denied_before_everything(grant: Grant) -> list[str]:
    """Return the topics that a grant denies before its rule that allows all topics."""
    denied: dict[str, None] = {}
    for index, rule in enumerate(grant.rules):
        if allows_everything(grant._replace(rules=grant.rules[: index + 1], default_allow=False)):
            return [*denied]
        for criteria in () if rule.allow else (*rule.publish, *rule.subscribe):
            denied.update(dict.fromkeys(criteria.topics))
    return []


def _lasts_at_least(chosen_validity: Span, length: timedelta) -> bool:
    """Return whether a chosen validity is at least ``length``, or is a fixed date of expiry."""
    return not isinstance(chosen_validity, timedelta) or length <= chosen_validity + BACKDATE


def _copy_findings(enclave: CheckedEnclave) -> Iterator[Finding]:
    xml, signed = enclave.folder / "permissions.xml", enclave.state.permissions_document
    if signed and xml.is_file() and _plain_file(enclave, xml) != plain(signed):
        text = "permissions.xml differs from the content of permissions.p7s"
        remedy = "" if enclave.keystore.looks_like_original else _NOT_IN_EXPORTS
        yield XML_DIFFERS.found(enclave.name, text, enclave.file("permissions.xml"), remedy=remedy)
    if enclave.keystore.crl and not os.path.lexists(enclave.folder / "crl.pem"):
        text = "crl.pem is missing"
        yield CRL_MISSING.found(enclave.name, text, str(enclave.folder))


def plain(document: bytes) -> bytes:
    """Normalize a document for comparison: uniform line endings, no surrounding space."""
    return document.replace(b"\r\n", b"\n").strip()


def _plain_file(enclave: CheckedEnclave, path: Path) -> bytes:
    """Return a file's normalized content for comparison, or b"" if it cannot be read."""
    try:
        return plain(enclave.keystore.opened.read(path, "file"))
    except SrosError:
        return b""
