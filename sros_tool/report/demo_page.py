"""The result of a demo as an HTML page: its rows.

The input is the JSON value of ``sros demo --json`` (`sros_tool.demo.result`).  The page has no
script; it can be opened from disk, and printed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

from sros_tool.report.markup import escape
from sros_tool.report.page import asset, document

Json = Mapping[str, Any]
_SKIPPED = "skipped"


def render_demo_page(result: Json) -> str:
    """Return the result of a demo as an HTML document."""
    body = "\n".join((_head(result), *map(_scenario, result["scenarios"])))
    title = f"sros demo on {result['dds']}"
    return document(title, f"<main>{body}</main>", asset("demo.css"))


def without_folders(value: Any, folders: Sequence[str]) -> Any:
    """Return a JSON value with these folder paths replaced by "…" in all texts."""
    if isinstance(value, str):
        for folder in sorted(folders, key=len, reverse=True):
            value = value.replace(folder, "…") if len(folder) > 1 else value
        return value
    if isinstance(value, Mapping):
        return {key: without_folders(each, folders) for key, each in value.items()}
    if isinstance(value, Sequence):
        return [without_folders(each, folders) for each in value]
    return value


def _sentence(text: str) -> str:
    return escape(f"{text[:1].upper()}{text[1:].rstrip('.')}.") if text else ""


def _head(result: Json) -> str:
    rows = result["rows"]
    good, skipped = _good(rows), sum(row["observed"] == _SKIPPED for row in rows)
    not_tried = sum(len(_not_tried(scenario)) for scenario in result["scenarios"])
    opened = sum(bool(row.get("open_because")) and not row.get("open_here") for row in rows)
    here = sum(bool(row.get("open_here")) for row in rows)
    where = (
        "in a separate network namespace"
        if result["own_network"]
        else "in the network of the machine"
    )
    facts = [
        f"{escape(result['dds'])}, nodes by {escape(result['backend'])}",
        f"topic <code>{escape(result['topic'])}</code>",
        f"keystore template {escape(result['template'])}",
        where,
    ]
    tiles = [
        (
            ("good" if good == len(rows) else "") if result["as_expected"] else "error",
            f"{good} of {len(rows)}",
            "rows as expected",
        ),
        ("", str(sum(bool(row.get("defence_removed")) for row in rows)), "with a defence removed"),
        ("warning" if opened else "", str(opened), "known to be open"),
        ("error", str(here), "open in this keystore"),
        ("", str(skipped), "skipped"),
        ("", str(result.get("left_out", 0)), "left out"),
        ("error", str(not_tried), "not tried, and needed for a proof"),
    ]
    shown = "".join(
        f'<li class="tile {kind}"><b>{number}</b> {text}</li>'
        for kind, number, text in tiles
        if number != "0"
    )
    why = f'<p class="soft">{escape(result["why"])}</p>' if result.get("why") else ""
    return (
        f"<header><h1>Attempts and their results</h1><p>{', '.join(facts)}.</p>{why}"
        f'<ul class="tiles">{shown}</ul></header>'
    )


def _good(rows: Sequence[Json]) -> int:
    """Return the number of rows that were tried and are as expected."""
    return sum(bool(row["as_expected"]) and row["observed"] != _SKIPPED for row in rows)


def _not_tried(scenario: Json) -> Sequence[str]:
    """Return what would have to be tried to prove a user's keystore sound, and was not."""
    keystore = scenario.get("keystore")
    return keystore["not_tried"] if keystore else ()


def _scenario(scenario: Json) -> str:
    rows = scenario["rows"]
    good = _good(rows)
    parts = [f"<section><h2>{escape(scenario['title'])}</h2>"]
    if scenario.get("cast"):
        members = (
            f"<b>{escape(each['part'])}</b> {escape(each['enclave'])}"
            + (f" as node {escape(', '.join(each['nodes']))}" if each["nodes"] else "")
            + (f" ({escape(each['why'])})" if each.get("why") else "")
            for each in scenario["cast"]
        )
        parts.append(f'<p class="soft">Cast: {"; ".join(members)}.</p>')
    if keystore := scenario.get("keystore"):
        used = len({each["enclave"] for each in scenario["cast"]})
        played = f"Parts are played by {used} of {keystore['enclaves']} enclaves"
        elsewhere = keystore["elsewhere"]
        played += f"; the keys of {elsewhere} are elsewhere" if elsewhere else ""
        parts.append(f'<p class="soft">{played}.</p>')
    if not_tried := _not_tried(scenario):
        names = escape("; ".join(not_tried))
        parts.append(f"<p>Not tried, and needed for a proof: {names}.</p>")
    if rows:
        count = f"{escape(scenario['name'])}: {good} of {len(rows)} rows as expected"
        parts += [f'<p class="soft">{count}</p>', _table(rows)]
    return "\n".join((*parts, "</section>"))


def _table(rows: Sequence[Json]) -> str:
    lines = [
        '<table class="rows"><thead><tr><th scope="col"><span class="hidden">Result</span></th>'
        '<th scope="col">Tried</th><th scope="col">Expected</th><th scope="col">Seen</th>'
        '<th scope="col">Mechanism</th></tr></thead>'
    ]
    for attack, found in groupby(rows, key=lambda row: row.get("attack", "")):
        lines.append("<tbody>")
        if attack:
            heading = f'<th colspan="5" scope="rowgroup">{escape(attack)}</th>'
            lines.append(f'<tr class="attack">{heading}</tr>')
        lines += [line for row in found for line in _row(row)]
        lines.append("</tbody>")
    return "\n".join((*lines, "</table>"))


def _row(row: Json) -> Iterator[str]:
    if row["observed"] == _SKIPPED:
        mark = '<span class="chip">skipped</span>'
    elif row["as_expected"]:
        mark = '<span class="chip good">ok</span>'
    else:
        mark = f'<span class="chip error">{"open" if row.get("open_here") else "differs"}</span>'
    tried = escape(row["name"])
    if removed := row.get("defence_removed"):
        tried += f' <span class="chip">without {escape(removed)}</span>'
    mechanism = escape(row["mechanism"])
    because, accepted = row.get("open_because", ""), row.get("accepted")
    if because or accepted:
        known = "accepted if it is open" if accepted else "known to be open"
        opened = "open in this keystore" if row.get("open_here") else known
        mechanism += (
            f'<p><span class="chip warning">{opened}</span> {_sentence(because)} '
            f"{_sentence(row.get('remedy', ''))}</p>"
        )
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
        f'<td data-label="Mechanism">{mechanism}</td></tr>'
    )
