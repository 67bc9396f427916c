"""HTML pages of a picture, of a demo's result and of a fleet's status, each in a single file.

The pages load no other files: the content security policy allows only the script and style in the
file, by their digests.  The data is JSON in which every character that could end the script element
is escaped, and the script inserts data only as text. The pages of a demo and of a fleet have no
script; their input is the output of ``sros demo --json`` and ``sros fleet status --json``.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import groupby
from pathlib import Path
from string import Template
from typing import Any

from sros_tool.names import is_expression
from sros_tool.policy.model import ALLOW
from sros_tool.reach import OF_EVERY_NODE
from sros_tool.report.layout import Scene, essential_edges
from sros_tool.report.picture import (
    Bundle,
    Picture,
    PicturedEnclave,
    Requirements,
    Tie,
    bundled_names,
    lack_text,
)
from sros_tool.terminal import visible_json, visible_line
from sros_tool.validity import iso
from sros_tool.values import as_plain
from sros_tool.wording import capitalized, counted, first_few

_ASSETS = Path(__file__).with_name("assets")
_ESCAPES = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


def render_page(
    picture: Picture, scenes: tuple[Scene, ...], now: datetime, drawn: Picture | None = None
) -> str:
    """Return the HTML page of a picture.

    Args:
        picture: the picture, with all its enclaves.
        scenes: the drawings that the page offers.
        now: the time for which the findings were decided.
        drawn: the picture in which equal robots, namespaces and enclaves are drawn once; None if no
            units are equal.
    """
    script, style = _asset("view.js"), _asset("view.css")
    origins = ", ".join(f"{origin.kind} {origin.title}" for origin in picture.origins)
    made = f"{origins}. Findings are as of {iso(now)[:10]}."
    if unread := sum(units.enclaves for units in picture.unread):
        enclaves = counted(unread, "enclave")
        made += f" The page lacks findings and expiry of {enclaves}, only compared with others."
    return _document(
        f"{picture.title}: who may do what",
        Template(_asset("view.html")).substitute(title=escape(picture.title), made=escape(made)),
        style,
        script,
        _page_data(picture, scenes, drawn or picture),
    )


def escape(text: str) -> str:
    """Escape ``text`` for the content of an HTML element or an attribute value.

    A character that XML forbids, a control character or a line break becomes a visible escape,
    because it could control a terminal that shows the file.
    """
    return html.escape(visible_line(text))


def _asset(name: str) -> str:
    """Return the text of a file in assets/, which is built from web/ by web/package.json."""
    return (_ASSETS / name).read_text("utf-8")


def _document(title: str, body: str, style: str, script: str = "", data: object = None) -> str:
    """Return a self-contained HTML document; ``body`` is HTML, ``data`` is for the script."""
    policy = f"default-src 'none'; style-src {_digest(style)}; base-uri 'none'; form-action 'none'"
    if script:
        policy += f"; script-src {_digest(script)}"
    lines = [
        "<!doctype html>",
        '<html lang="en" data-theme="auto">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="referrer" content="no-referrer">',
        f"<title>{escape(title)}</title>",
        f"<style>{style}</style>",
        "</head>",
        f"<body>{body}",
    ]
    if data is not None:
        lines.append(f'<script type="application/json" id="picture">{_safe_json(data)}</script>')
    if script:
        lines.append(f"<script>{script}</script>")
    return "\n".join((*lines, "</body>", "</html>", ""))


def _safe_json(value: object) -> str:
    """Return JSON for a script element, with < > & and line separators escaped."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), sort_keys=True)
    return visible_json(text.translate(_ESCAPES))


def _digest(text: str) -> str:
    """Return the source expression of the content security policy for a script or style."""
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"'sha256-{digest}'"


# ── data ───────────────────────────────────────────────────────────────────────────────────


def _page_data(picture: Picture, scenes: tuple[Scene, ...], drawn: Picture) -> dict[str, Any]:
    """Return the data of the page's script, as values for JSON.

    Names with equal rights are grouped into bundles, which take less space than an entry for each
    right.
    """
    essential = frozenset(essential_edges(picture.edges))  # the page leaves out the same rights
    edges = [replace(edge, common=edge not in essential) for edge in picture.edges]
    bundles = bundled_names(picture.names, edges, separate_questions=True)
    return {
        "requirements": _requirements_json(picture.requirements),
        "headlines": picture.other_answers,
        "notes": picture.notes,
        "overlay": as_plain(picture.overlay),
        "of_every_node": OF_EVERY_NODE,
        "join_needs_right": picture.join_needs_right,
        "has_least_levels": picture.has_least_levels,
        "enclaves": [_enclave_json(enclave) for enclave in picture.enclaves],
        **_bundles_json(bundles, [enclave.path for enclave in picture.enclaves]),
        "scenes": [_scene_json(scene) for scene in scenes],
        "equal": as_plain(picture.equal),
        "rows": [_row_json(bundle) for bundle in bundled_names(drawn.names, drawn.edges)],
        "differences": as_plain(picture.differences),
        "validities": as_plain(picture.validities),
        "findings": as_plain(picture.findings),
        "unread": sum(units.enclaves for units in picture.unread),
    }


def _requirements_json(requirements: Requirements | None) -> dict[str, Any] | None:
    """Return the number of requirements that hold, and the violations of all others.

    The result is None without requirements. The page's findings have further details.
    """
    return requirements and {
        "hold": requirements.hold,
        "assumed": len(requirements.assumed),
        "violations": [violation.short for violation in requirements.violations],
    }


def _enclave_json(enclave: PicturedEnclave) -> dict[str, Any]:
    """Return an enclave as JSON, with only its rights to names with wildcards."""
    wild = [
        _with_denial_flag(as_plain(statement))
        for statement in enclave.statements
        if is_expression(statement.name)
    ]
    return {**as_plain(enclave), "statements": wild, "domains": enclave.domains}


def _with_denial_flag(value: dict[str, Any]) -> dict[str, Any]:
    value["deny"] = value.pop("qualifier") != ALLOW
    return value


def _bundles_json(bundles: Iterable[Bundle], enclaves: Sequence[str]) -> dict[str, Any]:
    """Return bundles as JSON, in which common parts of bundles and ties are listed once.

    A bundle is a list of names, the number of its traits, and lists of ties. A list of ties is the
    number of their common part, followed by the numbers of their enclaves.
    """
    numbers = {path: number for number, path in enumerate(enclaves)}
    traits: dict[Bundle, int] = {}
    kinds: dict[Tie, int] = {}
    listed = [
        [
            bundle.names,
            traits.setdefault(replace(bundle, names=(), ties=()), len(traits)),
            [
                [kinds.setdefault(kind, len(kinds)), *(numbers[tie.node] for tie in ties)]
                for kind, ties in groupby(bundle.ties, key=lambda tie: replace(tie, node=""))
            ],
        ]
        for bundle in bundles
    ]
    return {
        "bundles": listed,
        "traits": [_traits_json(bundle) for bundle in traits],
        "ties": [_tie_json(tie) for tie in kinds],
    }


def _traits_json(bundle: Bundle) -> dict[str, Any]:
    return {
        "kind": bundle.kind,
        "asks": bundle.asks,
        "open": bundle.protection.open_access_text(bundle.kind),
        "everybody": bundle.protection.everybody,
        "lacks": lack_text(bundle.kind, bundle.lacks) if bundle.lacks else "",
        "protection": as_plain(bundle.protection),
    }


def _tie_json(tie: Tie) -> dict[str, Any]:
    value = _with_denial_flag(as_plain(tie))
    return {key: value[key] for key in value if key not in ("node", "differs")}


def _row_json(bundle: Bundle) -> dict[str, Any]:
    """Return a row of the table of names: its senders, receivers and denied enclaves."""
    ties = [tie for tie in bundle.ties if tie.qualifier is ALLOW]
    return {
        "kind": bundle.kind,
        "names": bundle.names,
        "level": bundle.protection.level.value,
        "everybody": bundle.protection.everybody,
        "all_send": not bundle.protection.write_control,
        "all_receive": not bundle.protection.read_control,
        "lacks": lack_text(bundle.kind, bundle.lacks) if bundle.lacks else "",
        "common": all(tie.common for tie in bundle.ties),
        "senders": sorted({tie.node for tie in ties if tie.sends}),
        "receivers": sorted({tie.node for tie in ties if not tie.sends}),
        "denied": sorted({tie.node for tie in bundle.ties if tie.qualifier is not ALLOW}),
    }


def _scene_json(scene: Scene) -> dict[str, Any]:
    value: dict[str, Any] = as_plain(scene)
    value["cards"] = _table(value["cards"])
    value["links"] = _table([_with_denial_flag(link) for link in value["links"]])
    return value


def _table(rows: list[dict[str, Any]]) -> list[list[Any]]:
    """Return ``rows`` with equal keys as a list: the list of keys, then lists of values."""
    if not rows:
        return []
    keys = list(rows[0])
    return [keys, *([row[key] for key in keys] for row in rows)]


# ── a demo ───────────────────────────────────────────────────────────────────────────────────────

Json = Mapping[str, Any]
_SKIPPED = "skipped"
_MOST_NAMES = 4
_MOST_OPEN_ROWS = 20


def render_demo_page(result: Json, made: str) -> str:
    """Return the HTML page of a demo's result; ``made`` names the release of sros and the time."""
    is_only = len(result["scenarios"]) == 1
    scenarios = (_demo_scenario(scenario, is_only=is_only) for scenario in result["scenarios"])
    why = _sentence(f"why {result['backend']}: {result['why']}" if result["why"] else "")
    body = "\n".join(
        (
            _demo_head(result, made),
            _open_rows_html(result["rows"]),
            *scenarios,
            _demo_vulnerabilities(result),
            f'<p class="soft">{why}</p>',
        )
    )
    title = f"sros demo on {result['dds']}"
    return _document(title, f"<main>{body}</main>", _asset("demo.css"))


def without_folders(value: Any, folders: Sequence[str]) -> Any:
    """Return a JSON value in which "…" replaces these folder paths in all texts."""
    if isinstance(value, str):
        for folder in sorted(folders, key=len, reverse=True):
            value = value.replace(folder, "…") if len(folder) > 1 else value
        return value
    if isinstance(value, Mapping):
        return {key: without_folders(item, folders) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [without_folders(item, folders) for item in value]
    return value


def _sentence(text: str) -> str:
    """Return ``text`` as a sentence in HTML, with a capital letter and a full stop; "" stays ""."""
    return _with_marks(f"{capitalized(text).rstrip('.')}.") if text else ""


def _with_marks(text: str) -> str:
    """Return ``text`` in HTML, with text between backticks as code.

    Options, dates and CVE numbers are marked, so that no line ends within them.
    """
    marked = re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))
    return re.sub(
        r"\bCVE-\d+-\d+|\b\d{4}-\d\d-\d\d|(?<![\w-])--[a-z][a-z-]*",
        r'<span class="id">\g<0></span>',
        marked,
    )


def _demo_head(result: Json, made: str) -> str:
    rows = result["rows"]
    good, skipped = _number_as_expected(rows), sum(row["observed"] == _SKIPPED for row in rows)
    not_tried = sum(len(_untried_attempts(scenario)) for scenario in result["scenarios"])
    opened = sum(bool(row.get("open_because")) and not row.get("open_here") for row in rows)
    open_here = sum(bool(row.get("open_here")) for row in rows)
    where = (
        "in a separate network namespace"
        if result["own_network"]
        else "in the network of the machine"
    )
    facts = [
        f"{escape(result['dds'])}, nodes by {escape(result['backend'])}",
        escape(first_few(result["names"], _MOST_NAMES)),
        f"keystore template {escape(result['template'])}",
        where,
    ]
    differing = sum(not row["as_expected"] for row in rows) - open_here
    tiles = [
        ("error", str(differing), "ended otherwise"),
        ("warning" if opened else "", str(opened), "known to be open"),
        ("error", str(open_here), "open in this keystore"),
        ("", str(skipped), "skipped"),
        ("", str(result.get("left_out", 0)), "left out"),
        ("error", str(not_tried), "not tried, but needed for a proof"),
    ]
    shown = "".join(
        f'<li class="tile {kind}"><b>{number}</b> {text}</li>'
        for kind, number, text in tiles
        if number != "0"
    )
    removed = sum(bool(row.get("defence_removed")) for row in rows)
    controls = (
        f"in {removed} of the attempts a defense is removed, and the attack has to succeed: this "
        "shows that the defense stops it in the other attempts"
        if removed
        else ""
    )
    return (
        f"<header><h1>sros demo: {good} of {len(rows)} attempts ended as expected</h1>"
        f"<p>On a real middleware: {', '.join(facts)}. {_sentence(made)} {_sentence(controls)}</p>"
        + (f'<ul class="tiles">{shown}</ul></header>' if shown else "</header>")
    )


def _open_rows_html(rows: Sequence[Json]) -> str:
    """Return a list of the rows that are open, with the reason and the remedy, or ""."""
    names: dict[tuple[bool, str, str, str], list[str]] = {}
    for row in rows:
        if row.get("open_because") and row["observed"] in (row["expected"], _SKIPPED):
            is_here, accepted = bool(row.get("open_here")), row.get("accepted")
            known = "accepted if it is open" if accepted else "open"
            label = "open in this keystore" if is_here else known
            reason = (not is_here, label, row["open_because"], row.get("remedy", ""))
            names.setdefault(reason, []).append(row["name"])
    here_first = sorted(names.items(), key=lambda item: item[0][0])
    items = "".join(
        f"<li>{''.join(_open_row_html(name, label, is_known=is_known) for name in opened)}"
        f"{_sentence(because)} {_sentence(remedy)}</li>"
        for (is_known, label, because, remedy), opened in here_first
    )
    return f'<ul class="open">{items}</ul>' if items else ""


def _open_row_html(row_name: str, label: str, *, is_known: bool) -> str:
    kind = "warning" if is_known else "error"
    return f'<span class="chip {kind}">{label}</span> <b>{escape(row_name)}</b><br>'


def _demo_vulnerabilities(result: Json) -> str:
    """Return a section on the DDS under test, and on other DDS libraries of the processes."""
    lines = []
    libraries = result.get("libraries") or ()
    for used in sorted(libraries, key=lambda used: not result["dds"].startswith(used["product"])):
        name = f"{used['product']} {used['version'] or 'of unknown version'}"
        if not result["dds"].startswith(used["product"]):
            name += " (not the DDS under test, but processes had loaded it, too)"
        ids, unclear = used["vulnerabilities"], used["unclear"]
        if ids is None:
            lines.append(
                f"<p>{_sentence(f'{name} may have vulnerabilities: they are not known')}</p>"
            )
            continue
        number = counted(len(ids), "known vulnerability", "known vulnerabilities")
        fixed = " (its package may have the fixes)" if used["packaged"] and ids else ""
        listed = ", ".join(
            (
                *ids,
                *(f"{name} (this advisory does not mention the release line)" for name in unclear),
            )
        )
        lines.append(_unfolding_html(f"{name}: {number}{fixed}", listed))
    shown = "".join(lines) or f"<p>{_with_marks(result['vulnerabilities'])}</p>"
    return f"<section><h2>Known vulnerabilities</h2>{shown}</section>"


def _unfolding_html(title: str, text: str) -> str:
    """Return an HTML element with a title that unfolds ``text``."""
    return (
        f"<details><summary>{escape(title)}</summary>{_with_marks(text)}</details>"
        if text
        else f"<p>{escape(title)}.</p>"
    )


def _number_as_expected(rows: Sequence[Json]) -> int:
    """Return the number of rows that ran with the expected result."""
    return sum(bool(row["as_expected"]) and row["observed"] != _SKIPPED for row in rows)


def _untried_attempts(scenario: Json) -> Sequence[str]:
    """Return the missing attempts that a proof of a user's keystore needs."""
    keystore = scenario.get("keystore")
    return keystore["not_tried"] if keystore else ()


def _demo_scenario(scenario: Json, *, is_only: bool) -> str:
    """Return a section, folded unless its scenario is short and the only one or needs attention."""
    rows = scenario["rows"]
    good, not_tried = _number_as_expected(rows), _untried_attempts(scenario)
    opened = sum(bool(row.get("open_because")) for row in rows)
    is_good = good == len(rows) and not not_tried
    kind = ("good" if is_good and rows else "") if scenario["as_expected"] else "error"
    title = scenario["title"]
    summary = f"<h2>{escape(capitalized(title))}</h2>"
    if not is_only:
        summary += f' <span class="chip {kind}">{good} of {len(rows)} as expected</span>'
        summary += f' <span class="chip warning">{opened} open</span>' if opened else ""
    is_open = " open" if (is_only and len(rows) <= _MOST_OPEN_ROWS) or not is_good else ""
    parts = [f'<section><details class="scenario"{is_open}><summary>{summary}</summary>']
    if scenario.get("cast"):
        members = (
            f"<b>{escape(member['part'])}</b> {escape(member['enclave'])}"
            + (f" as node {escape(', '.join(member['nodes']))}" if member["nodes"] else "")
            + (f" ({escape(member['why'])})" if member.get("why") else "")
            for member in scenario["cast"]
        )
        parts.append(f'<p class="soft">Cast: {"; ".join(members)}.</p>')
    if keystore := scenario.get("keystore"):
        used = len({member["enclave"] for member in scenario["cast"]})
        played = f"The demo used {used} of the keystore's {keystore['enclaves']} enclaves"
        elsewhere = keystore["elsewhere"]
        played += f"; the keys of {elsewhere} are elsewhere" if elsewhere else ""
        parts.append(f'<p class="soft">{played}.</p>')
    if not_tried:
        names = escape("; ".join(not_tried))
        parts.append(f"<p>Not tried, and needed for a proof: {names}.</p>")
    if rows:
        parts += [f'<p class="soft">Scenario {escape(scenario["name"])}</p>', _demo_table(rows)]
    return "\n".join((*parts, "</details></section>"))


def _demo_table(rows: Sequence[Json]) -> str:
    lines = [
        '<table class="rows"><thead><tr><th scope="col"><span class="hidden">Result</span></th>'
        '<th scope="col">Tried</th><th scope="col">Expected</th><th scope="col">Seen</th>'
        '<th scope="col">Why</th></tr></thead>'
    ]
    for attack, attack_rows in groupby(rows, key=lambda row: row.get("attack", "")):
        lines.append("<tbody>")
        if attack:
            heading = f'<th colspan="5" scope="rowgroup">{escape(attack)}</th>'
            lines.append(f'<tr class="attack">{heading}</tr>')
        lines += [line for row in attack_rows for line in _demo_row(row)]
        lines.append("</tbody>")
    return "\n".join((*lines, "</table>"))


def _demo_row(row: Json) -> Iterator[str]:
    if row["observed"] == _SKIPPED:
        mark = '<span class="chip">skipped</span>'
    elif row["as_expected"] and (row.get("open_because") or row["observed"] != row["expected"]):
        mark = '<span class="chip warning">open</span>'
    elif row["as_expected"]:
        mark = '<span class="chip good">ok</span>'
    else:
        mark = f'<span class="chip error">{"open" if row.get("open_here") else "differs"}</span>'
    tried = escape(row["name"])
    if removed := row.get("defence_removed"):
        tried += f' <span class="chip">without {escape(removed)}</span>'
    mechanism = escape(row["mechanism"])
    if row.get("accepted") and not row.get("open_because"):
        mechanism += ' <span class="chip warning">accepted if it is open</span>'
    seconds = f" ({row['seconds']:g} s)" if row.get("seconds") else ""
    if row.get("detail"):
        mechanism += (
            f"<details><summary>what was counted{seconds}</summary>"
            f"{escape(row['detail'])}</details>"
        )
    yield (
        f'<tr class="{"" if row["as_expected"] else "wrong"}"><td>{mark}</td>'
        f'<th scope="row" data-label="Tried">{tried}</th>'
        f'<td data-label="Expected">{escape(row["expected"])}</td>'
        f'<td data-label="Seen">{escape(row["observed"])}</td>'
        f'<td data-label="Why">{mechanism}</td></tr>'
    )


# ── a fleet ──────────────────────────────────────────────────────────────────────────────────────

_GOOD_STATES = ("current", "none")
_OUT_OF_DATE = ("restart", "unusable", "earlier", "different", "missing", "offline", "never")


def render_fleet_page(
    status: Json,
    words: Mapping[str, str],
    facts: Sequence[str],
    rows: Sequence[Sequence[str]],
    remedies: Mapping[str, str],
    list_lacking: str = "",
) -> str:
    """Return the HTML page of a fleet's status.

    Args:
        status: the output of ``sros fleet status --json``.
        words: maps a state to its words, if they differ from the name of the state.
        facts: sentences about the fleet as a whole.
        rows: a row for each group of robots with the same state: state, names, time of
            confirmation, first expiry, what to do, and why.
        remedies: maps what to do to how to do it.
        list_lacking: a sentence on how many robots have the revocation list in force; "" if all
            robots that need the list have it.
    """
    order = {state: (_urgency(state), place) for place, state in enumerate(status["counts"])}
    tiles = "".join(
        f'<li class="tile {_fleet_class(state)}"><b>{number}</b> {words.get(state, state)}</li>'
        for state, number in sorted(status["counts"].items(), key=lambda item: order[item[0]])
        if state != "current"
    )
    if outdated := len(status["outdated_dds"]):
        tiles += f'<li class="tile warning"><b>{outdated}</b> with a DDS to upgrade</li>'
    trusted = ""
    if list_lacking:
        trusted = (
            f'<p class="wrong">{_sentence(list_lacking)} Until the current '
            "revocation list is in force on a robot, the robot accepts whoever has a revoked key. "
            "Deliver the list, restart the processes, and confirm by Ansible, "
            "<code>sros agent</code> or <code>sros fleet report --restarted</code>.</p>"
        )
    current, robots = status["counts"].get("current", 0), counted(len(status["robots"]), "robot")
    fact_lines = "".join(f"<br>{_sentence(fact)}" for fact in facts)
    head = (
        f"<header><h1>{current} of {robots} current</h1>"
        f"<p>Fleet of keystore <code>{escape(status['keystore'])}</code>, as of "
        f"{_text_to_minute(status['at'])} UTC.{fact_lines}</p>"
        f'<ul class="tiles">{tiles}</ul>{trusted}</header>'
    )
    heads = "".join(f'<th scope="col">{name}</th>' for name in _FLEET_COLUMNS)
    lines = "".join(_fleet_row(row, words) for row in sorted(rows, key=lambda row: order[row[0]]))
    table = (
        f'<table class="rows fleet"><thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table>'
    )
    how = "".join(
        f"<dt>{escape(to_do)}</dt><dd>{_sentence(remedy)}</dd>"
        for to_do, remedy in remedies.items()
    )
    how = f"<h2>How to do it</h2><dl>{how}</dl>" if how else ""
    builds = Counter(finding["subject"] for finding in status["findings"])
    findings = "".join(
        _dds_finding(finding, is_only_build=builds[finding["subject"]] == 1)
        for finding in status["findings"]
    )
    listed = f"<h2>Vulnerabilities of the DDS</h2>{findings}" if findings else ""
    body = f"<main>{head}<section>{table}{how}{listed}</section></main>"
    return _document(f"Fleet of {status['keystore']}", body, _asset("demo.css"))


def _dds_finding(finding: Json, *, is_only_build: bool) -> str:
    """Return a finding on the DDS of robots; path and numbers are in a part that unfolds.

    Several builds of one release can be told apart only by their paths, which they then show.
    """
    text, comma, rest = finding["text"].partition("; in '")
    folded = f"In '{rest}. {finding['remedy']}" if comma else ""
    path = re.match(r".*'(?=: |$)", rest)
    shown = f"{text}; in '{path[0]}" if path and not is_only_build else text
    return _unfolding_html(f"{finding['subject']}: {shown}", folded)


_FLEET_COLUMNS = ("State", "Robots", "To do", "Details", "Confirmed (UTC)", "First expiry")
_FLEET_CLASSES = ("error", "warning", "good")


def _text_to_minute(moment: str) -> str:
    return moment[:16].replace("T", " ")


def _fleet_row(row: Sequence[str], words: Mapping[str, str]) -> str:
    state, robots, confirmed, expiry, to_do, why = row
    chip = f'<span class="chip {_fleet_class(state)}">{words.get(state, state)}</span>'
    texts = (to_do, why, confirmed and _text_to_minute(confirmed), expiry[:10])
    cells = "".join(
        f'<td data-label="{label}">{_with_marks(text)}</td>' if text else "<td></td>"
        for label, text in zip(_FLEET_COLUMNS[2:], texts, strict=True)
    )
    names = escape(robots).replace("_", "_<wbr>")  # a line ends between words of a name
    return f'<tr><td>{chip}</td><th scope="row">{names}</th>{cells}</tr>'


def _urgency(state: str) -> int:
    """Return the sort key of a state: the worst comes first."""
    return _FLEET_CLASSES.index(_fleet_class(state))


def _fleet_class(state: str) -> str:
    return "good" if state in _GOOD_STATES else "warning" if state in _OUT_OF_DATE else "error"
