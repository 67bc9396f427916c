"""All checks of a keystore; its enclaves are checked on all cores in parallel."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote

from sros_tool.checks import upgrade
from sros_tool.checks.keystores import zenoh_files
from sros_tool.checks.keystores.authorities import ONE_AUTHORITY, ROBOT_LEFT, check_authorities
from sros_tool.checks.keystores.documents import (
    DIFFERS,
    DOMAINS,
    TIME_FORMAT,
    check_documents,
    check_governance,
    governance_copy_findings,
    governance_findings,
)
from sros_tool.checks.keystores.enclaves import (
    ANY_NODE,
    CRL_MISSING,
    EVERYTHING,
    EXPIRES_SOON,
    LONG_PERMISSIONS,
    NOT_UNIQUE,
    check_enclave,
)
from sros_tool.checks.keystores.files import FOLDER_OPEN, KEY_READABLE, check_files
from sros_tool.checks.keystores.issued import (
    UNEXPLAINED,
    EnclaveSummary,
    check_issued,
    check_policy,
    summary_of,
    wanted_rights,
)
from sros_tool.checks.keystores.opened import CheckedEnclave, CheckedKeystore, Circumstances
from sros_tool.checks.keystores.topic_names import check_capitals, names_without_wildcards
from sros_tool.checks.keystores.vendors import (
    REFUSED,
    SOME_REFUSE,
    asked_vendors,
    check_vendors,
    evaluate,
    with_causes,
    with_start_finding,
)
from sros_tool.checks.kind import WARNING, Cause, Finding, names_text
from sros_tool.dds.decision.vendors import TESTED, Vendor
from sros_tool.dds.governance import parse_governance
from sros_tool.distributions import Distribution, find_distribution
from sros_tool.errors import SrosError
from sros_tool.faults import NEEDS_CA_KEYS, ORIGINAL_KEYSTORE, remedy_in_original_keystore
from sros_tool.keystore.fleet import publish_command, stated_distributions
from sros_tool.keystore.layout import (
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    KEY_FILE,
    enclave_path,
    remedy_in_closed_robot,
    waits_for_answer,
)
from sros_tool.keystore.reader import OpenedKeystore, read_consistently
from sros_tool.parallel import map_slices, tick
from sros_tool.policy.rights import Right
from sros_tool.wording import capitalized, counted, first_few

_NAMES_SHOWN = 3
_IDS_WITH_KEYSTORE_CAUSE = frozenset(
    {EVERYTHING.id, ANY_NODE.id, LONG_PERMISSIONS.id, TIME_FORMAT.id}
)
"""Ids of findings with one cause in all enclaves: a setting, or the signer of their files."""
_IDS_JOINED_BY_TEXT = frozenset(
    {
        REFUSED.id,
        SOME_REFUSE.id,
        CRL_MISSING.id,
        zenoh_files.MISSING.id,
        *(kind.id for kind in upgrade.OF_ENCLAVES),
    }
)
"""Ids of findings that have one cause, such as a shared CA, if their texts are equal."""


@read_consistently
def keystore_findings(
    opened: OpenedKeystore, at: Circumstances, *, only_enclaves: Sequence[str] | None = None
) -> list[Finding]:
    """Return all findings in a keystore, or in some of its enclaves.

    ``at`` has the moment and the other conditions of the check.  With ``only_enclaves``, only these
    enclaves are checked, and not the keystore itself.

    Raises:
        KeystoreError: the path of ``opened`` is not a keystore.
    """
    opened.check()
    root = opened.root
    keystore = CheckedKeystore(opened, at)
    checked = at.sample if only_enclaves is None else only_enclaves
    names = keystore.names if checked is None else tuple(checked)
    wanted = wanted_rights(keystore)
    asked = asked_vendors(at.vendors)
    stated = {} if at.vendors else _stated_distributions(keystore, names)
    deciding = {
        name: _vendors_of(vendors_of_enclave) for name, vendors_of_enclave in stated.items()
    }
    if stated:
        union = {vendor for of_enclave in deciding.values() for vendor in of_enclave}
        asked = asked if len(stated) < len(names) else asked_vendors(tuple(union))
    about_authorities = list(check_authorities(keystore))
    first, common = _governing_enclave(keystore, names)
    about_governance = list(_governance_findings(keystore, first, asked))

    def work(
        share: Sequence[str],
    ) -> tuple[list[Finding], list[EnclaveSummary], dict[str, frozenset[str]]]:
        all_findings: list[Finding] = []
        issued: list[EnclaveSummary] = []
        topics: dict[str, frozenset[str]] = {}
        for name in share:
            state = opened.enclave(name, now=at.now, domain=at.domain)
            evaluation = evaluate(
                CheckedEnclave(keystore, name, state),
                deciding.get(name, asked),
                at.domain,
                stated.get(name, ()),
            )
            enclave = evaluation.enclave
            findings = list(_enclave_findings(enclave, wanted, common, deciding.get(name, asked)))
            if not waits_for_answer(enclave.folder):
                differs = any(finding.kind is DIFFERS for finding in findings)
                shared = [] if differs else about_governance
                findings += check_vendors(evaluation, [*about_authorities, *shared, *findings])
            if not at.on_robot and name not in wanted:  # a policy says which nodes the enclave has
                findings = with_start_finding(evaluation, findings)
            all_findings += findings
            if summary := summary_of(enclave):
                issued.append(summary)
            grant = enclave.state.grant
            if grant and not keystore.is_original:  # a keystore may have too many robots for this
                topics[name] = names_without_wildcards(grant)
            tick()
        return all_findings, issued, topics

    outcomes = [outcome for _, outcome in map_slices(names, work)]
    all_findings = [
        *about_governance,
        *(finding for findings, *_ in outcomes for finding in findings),
    ]
    if only_enclaves is None:
        issued = [summary for _, share, _ in outcomes for summary in share]
        of_keystore = [*check_files(keystore), *about_authorities]
        all_findings = [*of_keystore, *check_issued(keystore, issued), *all_findings]
    else:
        all_findings = [*check_files(keystore, names), *all_findings]
    topics = {name: names for *_, share in outcomes for name, names in share.items()}
    all_findings += check_capitals(topics)
    all_findings += zenoh_files.check_network(keystore, only_enclaves)
    if at.policies:
        from sros_tool.checks.policies.policy import findings_in
        from sros_tool.checks.policies.portability import is_mended_by

        parts = [
            replace(
                policy,
                enclaves=tuple(
                    enclave for enclave in policy.enclaves if enclave.path in only_enclaves
                ),
            )
            if only_enclaves is not None
            else policy
            for policy in at.policies
        ]
        all_findings += (
            finding
            for finding in findings_in(parts, at.distribution, of_fleet=at.fleet is not None)
            if not is_mended_by(opened.template, finding)
        )
    real_root = os.path.realpath(root)
    located = (_with_real_file(finding, opened, real_root) for finding in all_findings)
    all_findings = with_causes(
        with_joined_findings([_with_enclave_names(finding, keystore) for finding in located])
    )
    if not keystore.is_original:
        return all_findings
    all_findings = _with_cause_of_left_robots(all_findings, keystore)
    return _with_cause_of_expiry(_with_cause_of_ros2(all_findings, opened), opened)


def _stated_distributions(
    keystore: CheckedKeystore, names: Sequence[str]
) -> dict[str, tuple[Distribution, ...]]:
    """Map the enclaves that are for certain ROS 2 distributions to these distributions."""
    by_enclave = {}
    for name in names:
        with suppress(SrosError):  # it is a finding
            if stated := stated_distributions(keystore.opened, name):
                by_enclave[name] = tuple(map(find_distribution, stated))
    return by_enclave


def _vendors_of(distributions: Sequence[Distribution]) -> tuple[Vendor, ...]:
    """Return the vendors that decide for ``distributions``, in the order of all vendors."""
    shipped = {vendor for distribution in distributions for vendor in distribution.vendors}
    return tuple(vendor for vendor in TESTED if vendor in shipped)


def _enclave_findings(
    enclave: CheckedEnclave,
    wanted_rights: dict[str, frozenset[Right]],
    governance: bytes,
    vendors: Sequence[Vendor],
) -> Iterator[Finding]:
    """Yield all findings in one enclave, except refusals by vendors (see `check_vendors`).

    ``vendors`` are the vendors that the enclave's nodes may use. ``governance`` is the keystore's
    signed governance; in an export, the governance of the first enclave; findings about this
    governance are reported already.
    """
    yield from check_enclave(enclave)
    yield from check_documents(enclave)
    yield from check_governance(enclave, governance, vendors)
    yield from check_policy(enclave, wanted_rights)
    yield from zenoh_files.check_own_zenoh(enclave)


def with_joined_findings(findings: Sequence[Finding]) -> list[Finding]:
    """Return findings; findings that a shared file or a keystore setting causes are joined."""
    together: dict[tuple[object, ...], list[Finding]] = {}
    for finding in findings:
        joined = finding.accepted or finding.id in _IDS_WITH_KEYSTORE_CAUSE
        file = "" if finding.id in _IDS_JOINED_BY_TEXT else finding.file
        place = (finding.accepted,) if joined else (file, finding.line, finding.text)
        together.setdefault((finding.id, *place), []).append(finding)
    return [_joined_finding(group) for group in together.values()]


def _governing_enclave(keystore: CheckedKeystore, names: Sequence[str]) -> tuple[str, bytes]:
    """Return the first enclave with the keystore's signed governance, and this governance.

    For an export, return the first enclave and its governance.  Without such an enclave, return ""
    and the keystore's governance.
    """
    common = keystore.governance
    for name in names:
        own_governance = b""
        with suppress(SrosError):  # it is a finding
            own_governance = keystore.opened.read(
                keystore.opened.folder(name) / GOVERNANCE_FILE, "file"
            )
        if own_governance and own_governance == (common or own_governance):
            return name, own_governance
    return "", common


def _governance_findings(
    keystore: CheckedKeystore, name: str, vendors: Sequence[Vendor]
) -> Iterator[Finding]:
    """Yield the findings in the governance of an enclave, or of a keystore without enclaves."""
    yield from governance_copy_findings(keystore)
    if name:
        state = keystore.enclave(name)
        enclave = evaluate(CheckedEnclave(keystore, name, state), vendors, None).enclave
        if enclave.state.governance:
            file = enclave.file(GOVERNANCE_FILE)
            yield from governance_findings(keystore, enclave.state.governance, file, vendors)
        return
    with suppress(SrosError):  # `sros create_enclave` reports the error
        document = keystore.opened.files.signed_document(keystore.governance).document
        governance = parse_governance(document, GOVERNANCE_P7S)
        file = keystore.shown_path(GOVERNANCE_P7S)
        yield from governance_findings(keystore, governance, file, vendors)


def _with_real_file(finding: Finding, keystore: OpenedKeystore, real_root: str) -> Finding:
    """Return the finding with the path of the shared file instead of an enclave's link to it.

    ``real_root`` is the real path of the keystore.
    """
    if "/enclaves/" not in finding.file or finding.id.startswith("keystore.link"):
        return finding
    real = Path(os.path.realpath(finding.file))
    if not Path(finding.file).is_symlink() or not real.is_relative_to(real_root):
        return finding
    return finding._replace(file=str(keystore.root / real.relative_to(real_root)))


_COMMAND_FOR_SEVERAL = re.compile(
    r"(\bsros (?:renew|revoke|create_permission|create_enclave|distribute_key) \S+ )([^\s`]+)"
)
"""Matches a command that takes several enclaves, up to the first enclave."""
_SIGNS_POLICY = re.compile(
    r"\bsros (?:create_permission|generate_artifacts -k) [^`]*?\bPOLICY(?:_FILE)?\b"
)
"""Matches a command that signs a policy, which may be the policy of a fleet."""


def _with_enclave_names(finding: Finding, keystore: CheckedKeystore) -> Finding:
    """Return the finding with the placeholders KEYSTORE and ENCLAVE in its remedy filled in.

    The remedy for an export says that signing commands have to run in the original keystore.
    """
    remedy = finding.remedy
    if not keystore.looks_like_original and NEEDS_CA_KEYS.search(remedy):
        remedy = remedy if ORIGINAL_KEYSTORE in remedy else remedy_in_original_keystore(remedy)
    if ORIGINAL_KEYSTORE not in remedy:
        remedy = re.sub(r"\bKEYSTORE\b", lambda _: quote(str(keystore.root)), remedy)
    if keystore.fleet and "--fleet" not in remedy:
        remedy = _SIGNS_POLICY.sub(r"\g<0> --fleet FLEET_FILE", remedy)
    if finding.subject.startswith("/") and "," not in finding.subject:
        remedy = re.sub(r"\bENCLAVE\b", lambda _: quote(finding.subject), remedy)
    remedy = remedy_in_closed_robot(keystore.root, remedy)
    return finding if remedy == finding.remedy else finding._replace(own_remedy=remedy)


def _joined_finding(group: list[Finding]) -> Finding:
    subjects = list(dict.fromkeys(finding.subject for finding in group))
    if len(subjects) == 1:
        return group[0]
    shown = " ".join(map(quote, subjects)) if len(subjects) <= _MOST_NAMED else "ENCLAVE..."
    remedy = _COMMAND_FOR_SEVERAL.sub(
        lambda match: match[1] + (shown if match[2] == quote(subjects[0]) else match[2]),
        group[0].remedy,
    )
    together = group[0]._replace(subject=first_few(subjects, _NAMES_SHOWN))
    return together if remedy == group[0].remedy else together._replace(own_remedy=remedy)


# ── one cause for what ros2/sros2 made ────────────────────────────────────────────────────


_IDS_OF_ROS2_KEYSTORES = (KEY_READABLE, FOLDER_OPEN, TIME_FORMAT, LONG_PERMISSIONS, ONE_AUTHORITY)
"""Ids of findings in any ros2/sros2 keystore; `update_keystore --template sros2` resolves them."""
_IDS_OF_ROS2_ENCLAVES = (
    UNEXPLAINED,
    KEY_READABLE,
    TIME_FORMAT,
    NOT_UNIQUE,
    LONG_PERMISSIONS,
    EVERYTHING,
)
"""Ids of findings in every ros2/sros2 enclave; `create_permission --revoke-old` resolves them."""
_MOST_NAMED = 3


def _with_cause_of_ros2(findings: Sequence[Finding], keystore: OpenedKeystore) -> list[Finding]:
    """Return the findings; several findings that ros2/sros2 causes get a common cause."""
    root = keystore.root
    if keystore.was_written_only_by_sros2:
        chosen = [finding for finding in findings if finding.kind in _IDS_OF_ROS2_KEYSTORES]
        text = f"It has neither sros.toml nor ledger.jsonl. Found: {_kinds_text(chosen)}."
        return _with_cause(
            findings,
            chosen,
            keystore,
            "a keystore that ros2/sros2 made",
            text,
            f"Run `sros update_keystore {quote(str(root))} --template sros2`, which takes it over "
            "with its CA, keys and rights, lets only their owner read the keys, and signs the "
            "permissions again.",
        )
    unknown = {finding.subject for finding in findings if finding.kind is UNEXPLAINED}
    names = sorted(name for name in unknown if _is_unrecorded(findings, name))
    keys = {f"{enclave_path(root, name)}/{KEY_FILE}" for name in names}
    chosen = [
        finding
        for finding in findings
        if finding.kind in _IDS_OF_ROS2_ENCLAVES
        and (finding.subject in names or finding.file in keys)
    ]
    shown = " ".join(map(quote, names)) if len(names) <= _MOST_NAMED else "ENCLAVE..."
    command = f"sros create_permission {quote(str(root))} {shown} POLICY_FILE --revoke-old"
    return _with_cause(
        findings,
        chosen,
        keystore,
        f"{len(names)} enclaves that the keystore never issued"
        if len(names) > 1
        else "an enclave that the keystore never issued",
        f"{names_text(names)}: the ledger has neither the certificate nor the permissions; `ros2 "
        f"security create_enclave` leaves enclaves in this state. Found: {_kinds_text(chosen)}.",
        f"If your team made an enclave, state its rights with `{command}`, which also issues its "
        "certificate again. Otherwise, somebody else has the CA key: revoke the enclave, and "
        "replace the CA (`sros rotate_ca`).",
    )


def _with_cause_of_left_robots(
    findings: Sequence[Finding], keystore: CheckedKeystore
) -> list[Finding]:
    """Return the findings, with a cause for domains that only a robot of the fleet has."""
    left = [finding for finding in findings if finding.kind is ROBOT_LEFT]
    domains = [
        finding
        for finding in findings
        if finding.kind is DOMAINS and finding.subject in keystore.left_enclaves
    ]
    if not (left and domains):
        return list(findings)
    robots = "; ".join(finding.text for finding in left)
    return _with_cause(
        findings,
        [*left, *domains],
        keystore.opened,
        ROBOT_LEFT.title,
        f"{capitalized(robots)}. {ROBOT_LEFT.why} Also found: {_kinds_text(domains)}.",
        left[0].remedy,
    )


def _with_cause_of_expiry(findings: Sequence[Finding], keystore: OpenedKeystore) -> list[Finding]:
    """Return the findings, with a cause for all certificates and permissions that expire soon."""
    soon = [f for f in findings if f.kind is EXPIRES_SOON and not f.accepted and not f.cause]
    if not soon:
        return list(findings)
    from sros_tool.keystore.expiry import renewal_command  # which reads all about renewals

    enclaves = len({finding.subject for finding in soon})
    first = min(soon, key=lambda finding: finding.text.rpartition(" ")[2])
    published = publish_command(keystore.root)
    return _with_cause(
        findings,
        soon,
        keystore,
        EXPIRES_SOON.title.replace("a certificate", "certificates"),
        f"{counted(len(soon), 'file')} of {counted(enclaves, 'enclave')}; the file that expires "
        f"first belongs to {first.subject}: {first.text}. {EXPIRES_SOON.why}",
        f"Run `{renewal_command(keystore.root)}`, then "
        f"{published or 'export the enclaves again'}, and restart their processes.",
    )


def _is_unrecorded(findings: Sequence[Finding], name: str) -> bool:
    """Return whether neither certificate nor permissions of an enclave are in the ledger."""
    return sum(finding.kind is UNEXPLAINED and finding.subject == name for finding in findings) > 1


def _with_cause(
    findings: Sequence[Finding],
    chosen: Sequence[Finding],
    keystore: OpenedKeystore,
    title: str,
    text: str,
    remedy: str,
) -> list[Finding]:
    """Return the findings; errors and warnings in ``chosen`` get a common cause."""
    together = {id(finding) for finding in chosen if finding.severity >= WARNING}
    if len(together) < 2:
        return list(findings)
    cause = Cause(title, text, remedy, len(together), str(keystore.root))
    return [
        finding._replace(cause=cause) if id(finding) in together else finding
        for finding in findings
    ]


def _kinds_text(findings: Sequence[Finding]) -> str:
    """Return text with the title of each kind of finding and the number of its findings."""
    titles = Counter(finding.kind.title for finding in findings if finding.severity >= WARNING)
    return "; ".join(
        f"{title} ({number} times)" if number > 1 else title for title, number in titles.items()
    )
