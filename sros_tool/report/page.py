"""HTML pages that contain their script, style and data, and need no network.

The content security policy allows only the script and style in the file, by their digests.  The
data is JSON in which every character that could end its element is escaped, and the script inserts
it only as text.
"""

from __future__ import annotations

import base64
import hashlib
import json
from datetime import datetime
from pathlib import Path
from string import Template
from typing import Any

from sros_tool.names import is_expression
from sros_tool.policy.model import ALLOW
from sros_tool.reach import OF_EVERY_NODE
from sros_tool.report.layout import Scene
from sros_tool.report.markup import escape
from sros_tool.report.picture import Bundle, Picture, PicturedEnclave, fold, lack_text
from sros_tool.terminal import visible_json
from sros_tool.validity import iso
from sros_tool.values import as_plain

_ASSETS = Path(__file__).with_name("assets")
_ESCAPES = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


def render_page(
    picture: Picture, scenes: tuple[Scene, ...], now: datetime, drawn: Picture | None = None
) -> str:
    """Return the HTML page of a picture with its scenes.

    ``now`` is the date of its findings, ``drawn`` the picture in which equal units are one.
    """
    script, style = asset("view.js"), asset("view.css")
    origins = ", ".join(f"{each.kind} {each.title}" for each in picture.origins)
    made = f"{origins}. Findings are as of {iso(now)[:10]}."
    return document(
        f"{picture.title}: who may do what",
        Template(asset("view.html")).substitute(title=escape(picture.title), made=escape(made)),
        style,
        script,
        _data(picture, scenes, drawn or picture),
    )


def asset(name: str) -> str:
    """Return the content of a file in assets/, which web/package.json builds from web/."""
    return (_ASSETS / name).read_text("utf-8")


def document(title: str, body: str, style: str, script: str = "", data: object = None) -> str:
    """Return a self-contained HTML document; ``body`` is HTML, ``data`` the script's input."""
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
    """Return JSON for a script element: < > & and line separators are escaped."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), sort_keys=True)
    return visible_json(text.translate(_ESCAPES))


def _digest(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"'sha256-{digest}'"


# ── data ───────────────────────────────────────────────────────────────────────────────────


def _data(picture: Picture, scenes: tuple[Scene, ...], drawn: Picture) -> dict[str, Any]:
    """Return the script's data: bundles of names, which need much less space than edges."""
    return {
        "headlines": picture.headlines,
        "overlay": as_plain(picture.overlay),
        "of_every_node": OF_EVERY_NODE,
        "enclaves": [_enclave(each) for each in picture.enclaves],
        "bundles": [_bundle(each) for each in fold(picture.names, picture.edges, apart=True)],
        "scenes": [_scene(each) for each in scenes],
        "equal": as_plain(picture.equal),
        "rows": [_row(each) for each in fold(drawn.names, drawn.edges)],
        "differences": as_plain(picture.differences),
        "validities": as_plain(picture.validities),
        "findings": as_plain(picture.findings),
    }


def _enclave(enclave: PicturedEnclave) -> dict[str, Any]:
    """Return an enclave as JSON, with only those statements that have wildcards."""
    wild = [_with_deny(as_plain(each)) for each in enclave.statements if is_expression(each.name)]
    return {**as_plain(enclave), "statements": wild}


def _with_deny(value: dict[str, Any]) -> dict[str, Any]:
    value["deny"] = value.pop("qualifier") != ALLOW
    return value


def _bundle(bundle: Bundle) -> dict[str, Any]:
    ties = [_with_deny(as_plain(tie)) for tie in bundle.ties]
    for tie in ties:
        tie["enclave"] = tie.pop("node")
        del tie["differs"]
    return {
        "kind": bundle.kind,
        "names": bundle.names,
        "asks": bundle.asks,
        "lacks": lack_text(bundle.kind, bundle.lacks) if bundle.lacks else "",
        "protection": as_plain(bundle.protection),
        "ties": _table(ties),
    }


def _row(bundle: Bundle) -> dict[str, Any]:
    """Return a row of the table of names: who may send, who may receive, and who is denied."""
    ties = [tie for tie in bundle.ties if tie.qualifier is ALLOW]
    return {
        "kind": bundle.kind,
        "names": bundle.names,
        "level": bundle.protection.level.value,
        "lacks": lack_text(bundle.kind, bundle.lacks) if bundle.lacks else "",
        "common": all(tie.common for tie in bundle.ties),
        "senders": sorted({tie.node for tie in ties if tie.sends}),
        "receivers": sorted({tie.node for tie in ties if not tie.sends}),
        "denied": sorted({tie.node for tie in bundle.ties if tie.qualifier is not ALLOW}),
    }


def _scene(scene: Scene) -> dict[str, Any]:
    value: dict[str, Any] = as_plain(scene)
    value["cards"] = _table(value["cards"])
    value["links"] = _table([_with_deny(link) for link in value["links"]])
    return value


def _table(rows: list[dict[str, Any]]) -> list[list[Any]]:
    """Return rows with the same keys as lists: first the keys, then the values of each row."""
    if not rows:
        return []
    keys = list(rows[0])
    return [keys, *([row[key] for key in keys] for row in rows)]
