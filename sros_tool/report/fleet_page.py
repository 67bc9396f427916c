"""What is where in a fleet, as an HTML page.

The input is the JSON value of ``sros fleet status --json``.  The page has no script; it can be
opened from disk, and printed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from sros_tool.report.markup import escape
from sros_tool.report.page import asset, document

Json = Mapping[str, Any]
_GOOD = ("current", "none")
_OUT_OF_DATE = ("earlier", "different", "missing", "never")


def render_fleet_page(status: Json) -> str:
    """Return the state of a fleet as an HTML document."""
    body = f"{_head(status)}<section>{_table(status)}</section>"
    return document(f"Fleet of {status['keystore']}", f"<main>{body}</main>", asset("demo.css"))


def _head(status: Json) -> str:
    tiles = "".join(
        f'<li class="tile {_class(state)}"><b>{number}</b> {escape(state)}</li>'
        for state, number in status["counts"].items()
    )
    facts = [f"keystore <code>{escape(status['keystore'])}</code>", f"as of {status['at']}"]
    if status["stage"] != "complete":
        facts.append(f"CA rotation at the stage {escape(status['stage'])}")
    if status["unassigned"]:
        facts.append(f"{status['unassigned']} enclaves of no robot")
    return (
        f"<header><h1>What is where</h1><p>{', '.join(facts)}.</p>"
        f'<ul class="tiles">{tiles}</ul></header>'
    )


def _table(status: Json) -> str:
    rows = sorted(status["robots"], key=lambda robot: (robot["state"] in _GOOD, robot["robot"]))
    heads = ("robot", "state", "confirmed", "enclaves", "CA stage", "what differs")
    return (
        f"<table><thead><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr></thead>"
        f"<tbody>{''.join(map(_row, rows))}</tbody></table>"
    )


def _row(robot: Json) -> str:
    differences = Counter(
        (each["kind"], each["state"], each["robot"] or each["enclave"] or "", each["since"] or "")
        for each in robot["pending"]
    )
    what = [
        f"{number} {kind} {state}{f' of {whose}' if whose else ''}{f', {since}' if since else ''}"
        for (kind, state, whose, since), number in differences.items()
    ]
    cells = (
        f"<code>{escape(robot['robot'])}</code>",
        f'<span class="{_class(robot["state"])}">{escape(robot["state"])}</span>',
        escape(robot["received"] or ""),
        str(robot["enclaves"]),
        escape(robot["stage"] or ""),
        "<br>".join(map(escape, (*what, *robot["notes"]))),
    )
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _class(state: str) -> str:
    return "good" if state in _GOOD else "warning" if state in _OUT_OF_DATE else "error"
