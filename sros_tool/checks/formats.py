"""Findings for other programs: SARIF 2.1.0 (OASIS), Markdown, annotations, metrics for Prometheus.

The metrics of a keystore also have the expiry of its files.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

from sros_tool.checks.kind import ChosenFindings, Finding, FindingKind, Severity, group_by_cause
from sros_tool.errors import SrosError
from sros_tool.fleet.robots import Fleet, grouped_by_robot, named_robots, with_robot_placeholder
from sros_tool.keystore.layout import (
    CRL_FILE,
    GOVERNANCE_P7S,
    IDENTITY_CA_FILE,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    ROLES,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.markdown import bounded_list, code, plain
from sros_tool.pki.certificates import validity_of
from sros_tool.pki.crl import load_crl
from sros_tool.terminal import visible_line
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from sros_tool.keystore.expiry import Lifetime
    from sros_tool.prometheus import Metric

_MOST_CHARACTERS = 20_000  # characters: a comment on GitHub has at most 65,536
_SEVERITY_SIGNS = {"error": "🔴", "warning": "🟠", "note": "🔵"}


_MergeKeys = Mapping[str, tuple[Hashable, Hashable]]


def folded_findings(
    groups: Iterable[tuple[Finding, ...]], fleet: Fleet | None
) -> Iterator[tuple[tuple[Finding, ...], str]]:
    """Merge findings that differ only in one robot or one enclave.

    Each group in ``groups`` has the findings with one cause; only groups of one finding are merged.
    Yields the first group of each merge, with a text that names the robots or enclaves of the other
    groups ("" if there are none).  Findings that have a line or related places are merged only by
    robot.
    """
    similar_groups: dict[Hashable, list[tuple[tuple[Finding, ...], str]]] = {}
    for group, other_robots, robots in _merge_robots(groups, fleet):
        key = (_key_without_enclave(group), other_robots, robots)
        similar_groups.setdefault(key, []).append((group, other_robots))
    for members in similar_groups.values():
        (first, other_robots), *more = members
        if len(more) < _FEWEST_ENCLAVES:
            yield from members
        else:
            names = first_few([group[0].subject for group, _ in more], _MOST_ROBOTS, joint=", and ")
            text = f"the same for {counted(len(more), 'more enclave')}"
            together = f"{other_robots}; {text} of each robot" if other_robots else text
            yield first, f"{together}: {names}"


def _key_without_enclave(group: tuple[Finding, ...]) -> Hashable:
    """Return a key that is equal for groups of one finding that differ only in the enclave."""
    finding = group[0]
    enclave = finding.subject
    is_enclave = enclave.startswith("/") and enclave not in ("/", finding.file)
    if len(group) > 1 or finding.line or finding.related or not is_enclave:
        return group
    texts = (finding.text, finding.file, finding.remedy)
    return (finding.id, finding.accepted, *(text.replace(enclave, "{}") for text in texts))


def _merge_robots(
    groups: Iterable[tuple[Finding, ...]], fleet: Fleet | None
) -> Iterator[tuple[tuple[Finding, ...], str, tuple[str, ...]]]:
    """Merge findings that differ only in one robot.

    Each group in ``groups`` has the findings with one cause; only groups of one finding are merged.
    Yields the first group of each merge, with a text that names the robots of the other groups (""
    if there are none), and with the names of all robots of the merge.  A finding that names several
    robots is merged by the robot with which most findings become one.  If more than `_MOST_SIMILAR`
    merges differ only in the other robots that they name, these become one merge, too.  Without
    ``fleet``, nothing is merged.
    """
    read = []
    for group in groups:
        kinds = _merge_keys(group, fleet) if fleet else {}
        same: list[tuple[Hashable, str]] = [(kind, robot) for robot, (kind, _) in kinds.items()]
        read.append((group, same or [(group, "")], [(kind, r) for r, (_, kind) in kinds.items()]))
    for (_, many), of_robot in grouped_by_robot(read, _MOST_SIMILAR).items():
        (first, *more), *others = of_robot.values()
        if others:
            count = counted(len(others), "more robot")
            names = first_few(list(of_robot)[1:], _MOST_ROBOTS, joint=", and ")
            text = f"similar for {count} (with other names)" if many else f"the same for {count}"
            yield first, f"{text}: {names}", tuple(of_robot)
        else:
            yield from ((alone, "", ()) for alone in (first, *more))


_MOST_ROBOTS = 10
_FEWEST_ENCLAVES = 2  # only more enclaves than this are merged into one finding
_MOST_SIMILAR = 5  # more similar findings for different robots become one finding


def _merge_keys(group: tuple[Finding, ...], fleet: Fleet) -> _MergeKeys:
    """Map each robot that a finding names to two keys by which findings are merged.

    The first key is equal for findings that differ only in this robot; the second key is also equal
    for findings that differ in further robots.
    """
    first, *more = group
    named = () if more else named_robots(fleet, first.subject, first.text)
    kinds: dict[str, tuple[Hashable, Hashable]] = {}
    for robot in named:
        texts = [
            with_robot_placeholder(text, robot)
            for text in (first.subject, first.text, first.file, first.remedy)
        ]
        same = (first.id, first.line, first.accepted, *texts)
        for other_robot in named:
            texts = [with_robot_placeholder(text, other_robot, "other") for text in texts]
        kinds[robot.name] = same, (first.id, first.line, first.accepted, *texts)
    return kinds


def findings_markdown(
    chosen_findings: ChosenFindings, fleet: Fleet | None = None, title: str = "Findings"
) -> str:
    """Return the findings as Markdown, under a heading with a title and their numbers.

    Findings that differ only in one robot of ``fleet``, or in one enclave, are one item.
    """
    shown_by = "which `sros check` shows"
    groups = folded_findings(group_by_cause(chosen_findings.shown), fleet)
    items = (_markdown_item(group, others) for group, others in groups)
    listed = bounded_list(items, _MOST_CHARACTERS, shown_by)
    heading = f"### {title}: {plain(chosen_findings.summary())}"
    return "\n\n".join(part for part in (heading, listed) if part) + "\n"


def _markdown_item(findings: Sequence[Finding], others: str) -> str:
    lines = _finding_lines(findings[0]) if len(findings) == 1 else _cause_lines(findings)
    return "<br>".join((*lines, *([code(others)] if others else [])))


def _cause_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """Yield the Markdown lines of findings that share a cause."""
    first = findings[0]
    assert first.cause, "findings that are shown together have a cause"
    word, place = first.severity.word, first.cause.place or first.place
    ids = code(", ".join(dict.fromkeys(finding.id for finding in findings)))
    yield f"{_SEVERITY_SIGNS[word]} **{word}** {code(place)} {plain(first.cause.title)} ({ids})"
    yield code(first.cause.text)
    yield code(first.cause.remedy)


def _finding_lines(finding: Finding) -> Iterator[str]:
    word = finding.severity.word
    title = f"{plain(finding.kind.title)} ({code(finding.id)})"
    yield f"{_SEVERITY_SIGNS[word]} **{word}** {code(finding.place)} {title}"
    subject = "" if finding.subject in (finding.file, finding.place) else f"{finding.subject}: "
    by = f" (accepted by the {finding.accepted})" if finding.accepted else ""
    yield code(f"{subject}{finding.text}{by}")
    yield from (code(f"{place}: {place.text}") for place in finding.related)
    yield code(finding.remedy)


_SARIF_VERSION = "2.1.0"
_SARIF_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_BASE_URI_ID = "SRCROOT"


def sarif(
    findings: Sequence[Finding], kinds: Sequence[FindingKind], *, version: str, base: Path
) -> dict[str, Any]:
    """Return a SARIF log of one run, in which ``kinds`` are the rules.

    Paths are relative to the folder ``base``; a finding without a line is placed at line 1.
    Accepted findings are included, marked as suppressed.
    """
    rules = {kind.id: index for index, kind in enumerate(kinds)}
    driver = {
        "name": "sros",
        "version": version,
        "semanticVersion": version,
        "rules": [_sarif_rule(kind) for kind in kinds],
    }
    run = {
        "tool": {"driver": driver},
        "columnKind": "unicodeCodePoints",
        "originalUriBaseIds": {_BASE_URI_ID: {"uri": f"{base.absolute().as_uri()}/"}},
        "results": [_sarif_result(finding, rules[finding.id], base) for finding in findings],
    }
    return {"$schema": _SARIF_SCHEMA, "version": _SARIF_VERSION, "runs": [run]}


def _sarif_rule(kind: FindingKind) -> dict[str, Any]:
    return {
        "id": kind.id,
        "name": "".join(part.capitalize() for part in kind.id.replace(".", "-").split("-")),
        "shortDescription": {"text": kind.title},
        "fullDescription": {"text": kind.why},
        "help": {"text": f"{kind.remedy}\n\nSource: {kind.source}"},
        "defaultConfiguration": {"level": kind.severity.word},
    }


def _sarif_result(finding: Finding, rule: int, base: Path) -> dict[str, Any]:
    result: dict[str, Any] = {
        "ruleId": finding.id,
        "ruleIndex": rule,
        "level": finding.severity.word,
        "message": {"text": _without_links(f"{finding.subject}: {finding.text}. {finding.remedy}")},
    }
    if finding.file:
        result["locations"] = [_sarif_location(finding.file, finding.line, base)]
    if finding.related:
        result["relatedLocations"] = [
            {
                "id": number,
                **_sarif_location(place.file, place.line, base),
                "message": {"text": _without_links(place.text)},
            }
            for number, place in enumerate(finding.related)
        ]
    if finding.accepted:
        result["suppressions"] = [
            {"kind": "external", "status": "accepted", "justification": finding.accepted}
        ]
    return result


_ANNOTATION_LEVELS = {"error": "error", "warning": "warning", "note": "notice"}


def github_annotations(findings: Iterable[Finding]) -> str:
    """Return workflow commands of GitHub Actions, which show each finding at its line.

    The worst findings come first, because GitHub shows ten of each severity.  The text of a finding
    is escaped, so that it can neither begin a command, a property or a line (GitHub,
    actions/toolkit, command.ts), nor control a terminal.
    """

    lines = []
    for finding in sorted(findings, key=lambda finding: -finding.severity.weight):
        kind = _ANNOTATION_LEVELS[finding.severity.word]
        place = f"file={_escaped(finding.file, ':,')},line={finding.line or 1}"
        message = _escaped(f"{finding.subject}: {finding.text}. {finding.remedy}")
        lines.append(f"::{kind} {place},title={finding.id}::{message}\n")
    return "".join(lines)


def _escaped(text: str, characters: str = "") -> str:
    """Return the text on one visible line, with "%" and ``characters`` as percent escapes."""
    line = visible_line(text)
    return "".join(f"%{ord(one):02X}" if one in f"%{characters}" else one for one in line)


def _sarif_location(file: str, line: int | None, base: Path) -> dict[str, Any]:
    return {
        "physicalLocation": {
            "artifactLocation": {
                "uri": quote(os.fsencode(_relative(file, base))),
                "uriBaseId": _BASE_URI_ID,
            },
            "region": {"startLine": line or 1},
        }
    }


def _without_links(text: str) -> str:
    """Escape embedded links (SARIF 2.1.0, 3.11.6), because others may choose names in the text.

    Only text with the form of a link is escaped, because many viewers show the escapes.
    """
    return re.sub(r"([\[\]\\])", r"\\\1", text) if "](" in text else text


def _relative(file: str, base: Path) -> str:
    """Return the path of ``file`` relative to the folder ``base``, with "/" between its parts."""
    path, start = (base / file).absolute(), base.absolute()
    common = start
    ups = 0
    while not path.is_relative_to(common):
        common = common.parent
        ups += 1
    return "/".join(("..",) * ups + path.relative_to(common).parts)


_FILE_KINDS_TEXT = "certificate, permissions, governance, crl, identity_ca or permissions_ca"


class Expiry(NamedTuple):
    """The moment when a file expires.

    ``kind`` is the kind of file in metrics, such as "certificate"; ``enclave`` is "" for a file
    that all enclaves share.
    """

    kind: str
    enclave: str
    moment: datetime


def keystore_metrics(
    keystore: OpenedKeystore,
    findings: Iterable[Finding],
    *,
    now: datetime,
    each_enclave: bool = True,
) -> tuple[Metric, ...]:
    """Return the metrics of a keystore, or of an export for a robot.

    Args:
        keystore: the keystore.
        findings: the result of `keystore_findings`.
        now: the moment for which the findings were made.
        each_enclave: also give the expiry of each enclave's files, not only the earliest.

    Raises:
        KeystoreError: the path is not a keystore, or some enclaves cannot be listed.
    """
    # Imported here, because only metrics need these modules.
    from sros_tool.keystore.expiry import enclaves_renewed_by_name, survey
    from sros_tool.prometheus import Metric, Sample

    lifetimes, unreadable = survey(keystore)
    expiries = [*_shared_expiries(keystore), *_enclave_expiries(keystore, lifetimes)]
    earliest: dict[str, datetime] = {}
    by_name: Sequence[str] = ()
    with suppress(SrosError):  # a finding reports the error
        if settings := keystore.settings:
            by_name = enclaves_renewed_by_name(keystore, settings, keystore.names)
    for expiry in expiries:
        if expiry.enclave in by_name:
            continue
        earliest[expiry.kind] = min(expiry.moment, earliest.get(expiry.kind, expiry.moment))
    place = {"keystore": str(keystore.root.absolute())}
    severities = Counter(finding.severity for finding in findings)
    kinds = Counter((finding.severity, finding.id) for finding in findings)
    return (
        Metric(
            "sros_examined_timestamp_seconds",
            "When the keystore was examined, in seconds since 1970.",
            (Sample(_timestamp(now), place),),
        ),
        Metric(
            "sros_enclaves",
            "Number of enclaves in the keystore.",
            (Sample(len(keystore.names), place),),
        ),
        Metric(
            "sros_unreadable_enclaves",
            "Number of enclaves whose certificate or permissions cannot be read.",
            (Sample(len(unreadable), place),),
        ),
        Metric(
            "sros_earliest_expiry_timestamp_seconds",
            f"The first expiry of all files of a kind ({_FILE_KINDS_TEXT}), in seconds since 1970. "
            "Short-lived enclaves, which a person renews when they are needed, do not count.",
            tuple(
                Sample(_timestamp(moment), {**place, "kind": kind})
                for kind, moment in earliest.items()
            ),
        ),
        Metric(
            "sros_expiry_timestamp_seconds",
            f"The expiry of a file by its kind ({_FILE_KINDS_TEXT}), in seconds since 1970; "
            "a file that all enclaves share has no label `enclave`.",
            tuple(
                Sample(
                    _timestamp(expiry.moment),
                    {**place, "kind": expiry.kind, "enclave": expiry.enclave},
                )
                for expiry in expiries
                if each_enclave or not expiry.enclave
            ),
        ),
        Metric(
            "sros_findings",
            "Number of findings of `sros check` by severity (error, warning or note).",
            tuple(
                Sample(severities[severity], {**place, "severity": severity.word})
                for severity in sorted(Severity, reverse=True)
            ),
        ),
        Metric(
            "sros_findings_of_kind",
            "Number of findings of `sros check` by the id of their kind.",
            tuple(
                Sample(number, {**place, "severity": severity.word, "id": identity})
                for (severity, identity), number in sorted(kinds.items())
            ),
        ),
    )


def _shared_expiries(keystore: OpenedKeystore) -> Iterator[Expiry]:
    """Yield the expiry of the files that all enclaves share; unreadable files are left out."""
    for role in ROLES:
        with suppress(SrosError):
            for certificate in keystore.authority(role)[:1]:
                yield Expiry(f"{role}_ca", "", validity_of(certificate).not_after)
    if (keystore.root / GOVERNANCE_P7S).exists():
        # The governance has no expiry of its own: it is valid as long as the CA that signed it.
        with suppress(SrosError):
            authority = keystore.ca_certificate(PERMISSIONS)
            keystore.governance_signed_by(authority)
            yield Expiry("governance", "", validity_of(authority).not_after)
    with suppress(SrosError):
        if crl := keystore.revocation_list:
            yield Expiry("crl", "", crl.next_update)


def _enclave_expiries(keystore: OpenedKeystore, lifetimes: Iterable[Lifetime]) -> Iterator[Expiry]:
    for lifetime in lifetimes:
        yield Expiry("certificate", lifetime.name, lifetime.certificate.not_after)
        yield Expiry("permissions", lifetime.name, lifetime.permissions.not_after)
        if not keystore.is_original:
            yield from _exported_expiries(keystore, lifetime.name)


def _exported_expiries(keystore: OpenedKeystore, name: str) -> Iterator[Expiry]:
    """Yield the expiry of an exported enclave's copies of the shared files."""
    folder = keystore.folder(name)
    for file in (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE):
        with suppress(SrosError):
            moment = validity_of(keystore.certificate(folder / file)).not_after
            yield Expiry(file.removesuffix(".cert.pem"), name, moment)
    if (folder / CRL_FILE).exists():
        with suppress(SrosError):
            crl = load_crl(keystore.read(folder / CRL_FILE, "revocation list"), CRL_FILE)
            yield Expiry("crl", name, crl.next_update)


def _timestamp(moment: datetime) -> int:
    return int(moment.timestamp())
