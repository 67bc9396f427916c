"""Plots of the cost of security: latency and throughput over the payload size.

Both axes are logarithmic.  Each kind of protection has one shape and colour of points.  The
input is the JSON that `sros_tool.demo.cost` describes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from textwrap import wrap
from typing import Any

from sros_tool.report.markup import escape

Json = Mapping[str, Any]
_WIDTH, _HEIGHT, _LEFT, _TOP = 380, 240, 58, 12
_SHAPES = (
    "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0z",
    "M-3.6 -3.6h7.2v7.2h-7.2z",
    "M0 -5L5 0L0 5L-5 0z",
    "M0 -5L4.6 3.8H-4.6z",
    "M0 5L4.6 -3.8H-4.6z",
)
"""The shapes of points as SVG paths: a circle, a square, a rhombus, two triangles."""

_PLOTS = (
    ("Latency in µs, over the payload", "latency_us"),
    ("Throughput in MB/s, over the payload", "megabytes_per_s"),
)
_COLOURS = ("#1b1b1b", "#0072b2", "#b8860b", "#00795a", "#a3497e")
"""The colours, after Okabe and Ito, which colour-blind people can distinguish."""

_STYLE = (
    ".grid{stroke:#ddd;fill:none}"
    + "".join(
        f".k{number}{{fill:{colour};stroke:{colour}}}" for number, colour in enumerate(_COLOURS)
    )
    + ".line{fill:none;stroke-width:2}"
)


def cost_section(cost: Json) -> str:
    """Return the plots and the table as HTML markup."""
    kinds = cost["kinds"]
    legend = "".join(
        f'<li><svg class="icon" width="14" height="14" aria-hidden="true"><path class="k{n}" '
        f'transform="translate(7 7)" d="{_shape(n)}"/></svg>{escape(kind)}</li>'
        for n, kind in enumerate(kinds)
    )
    plots = "".join(
        f"<figure><figcaption>{title}</figcaption>{_plot(cost, field, title)}</figure>"
        for title, field in _PLOTS
    )
    return (
        f'<h3>Cost of security</h3><ul class="kinds">{legend}</ul><div class="plots">{plots}</div>'
        f'<p class="soft">{escape(cost["note"])}.</p>{_table(cost)}'
    )


def cost_picture(cost: Json) -> str:
    """Return the plots as an SVG document."""
    kinds, note = cost["kinds"], wrap(cost["note"], 120)
    across, below = _LEFT + _WIDTH + 48, _TOP + _HEIGHT + 84
    width, height = 2 * across, below + 30 + 24 * len(kinds) + 16 * len(note)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="sans-serif" font-size="12" role="img">',
        f"<title>What security costs</title><style>{_STYLE}</style>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for number, (title, field) in enumerate(_PLOTS):
        left = number * across
        parts.append(f'<text x="{left + _LEFT}" y="20" font-weight="bold">{title}</text>')
        parts.append(_plot(cost, field, title, f'x="{left}" y="30" {_size()} '))
    for number, kind in enumerate(kinds):
        y = below + 24 * number
        first = next((e["seconds"] for e in cost["first_message"] if e["kind"] == kind), None)
        label = f"{kind}: first message after {first:.2f} s" if first is not None else kind
        parts.append(f'<path class="k{number}" transform="translate({_LEFT} {y - 4})"')
        parts.append(f'd="{_shape(number)}"/><text x="{_LEFT + 14}" y="{y}">{escape(label)}</text>')
    for number, line in enumerate(note):
        y = below + 24 * len(kinds) + 16 * number
        parts.append(f'<text x="{_LEFT}" y="{y}" fill="#555">{escape(line)}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _size() -> str:
    return f'width="{_LEFT + _WIDTH + 8}" height="{_TOP + _HEIGHT + 30}"'


def _shape(number: int) -> str:
    return _SHAPES[number % len(_SHAPES)]


def payload_text(size: int) -> str:
    """Return a payload size in bytes as text like ``64 B``, ``16 KiB``, ``1 MiB``."""
    for unit, step in (("MiB", 1 << 20), ("KiB", 1 << 10)):
        if size >= step:
            return f"{size / step:g} {unit}"
    return f"{size} B"


def _plot(cost: Json, field: str, title: str, place: str = "") -> str:
    values = [each[field] for each in cost["measurements"] if each[field] > 0]
    if not values:
        return ""
    payloads = cost["payloads"]
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    high = max(high, low + 1)
    first, last = math.log(payloads[0]), math.log(payloads[-1])

    def across(payload: int) -> float:
        return _LEFT + 14 + (_WIDTH - 28) * (math.log(payload) - first) / ((last - first) or 1)

    def down(value: float) -> float:
        return _TOP + _HEIGHT * (1 - (math.log10(value) - low) / (high - low))

    lines = [*_grid(low, high, payloads, across, down)]
    for number, kind in enumerate(cost["kinds"]):
        points = [
            (across(each["payload"]), down(each[field]), each)
            for each in cost["measurements"]
            if each["kind"] == kind and each[field] > 0
        ]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y, _ in points)
        lines.append(f'<polyline class="line k{number}" points="{path}"/>')
        lines += [
            f'<path class="k{number}" transform="translate({x:.1f} {y:.1f})" d="{_shape(number)}">'
            f"<title>{escape(kind)}, {payload_text(each['payload'])}: {each[field]:g}</title>"
            "</path>"
            for x, y, each in points
        ]
    width, height = _LEFT + _WIDTH + 8, _TOP + _HEIGHT + 30
    return (
        f'<svg {place}viewBox="0 0 {width} {height}" role="img" aria-label="{title}">'
        f"{''.join(lines)}</svg>"
    )


def _grid(
    low: int,
    high: int,
    payloads: Sequence[int],
    across: Callable[[int], float],
    down: Callable[[float], float],
) -> Iterator[str]:
    for power in range(low, high + 1):
        y = down(10.0**power)
        yield f'<path class="grid" d="M{_LEFT} {y:.1f}h{_WIDTH}"/>'
        yield f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{10.0**power:,.9g}</text>'
    for payload in payloads:
        x = across(payload)
        yield f'<path class="grid" d="M{x:.1f} {_TOP}v{_HEIGHT}"/>'
        yield (
            f'<text x="{x:.1f}" y="{_TOP + _HEIGHT + 18}" text-anchor="middle">'
            f"{payload_text(payload)}</text>"
        )


def _table(cost: Json) -> str:
    first = {each["kind"]: each for each in cost["first_message"]}
    found = {(each["kind"], each["payload"]): each for each in cost["measurements"]}
    heads = "".join(f'<th scope="col">{payload_text(size)}</th>' for size in cost["payloads"])
    lines = [
        '<div class="wide" tabindex="0" role="region" aria-label="Costs"><table class="costs">'
        "<caption>Latency in µs and throughput in MB/s; in parentheses, the ratio to the first "
        'kind</caption><thead><tr><th scope="col">Protection</th>'
        f'<th scope="col">First message</th>{heads}</tr></thead><tbody>'
    ]
    for kind in cost["kinds"]:
        cells = "".join(_cell(found.get((kind, size))) for size in cost["payloads"])
        start = first.get(kind)
        begin = f"{start['seconds']:.2f} s ({start['ratio']:g})" if start else ""
        lines.append(f'<tr><th scope="row">{escape(kind)}</th><td>{begin}</td>{cells}</tr>')
    return "\n".join((*lines, "</tbody></table></div>"))


def _cell(each: Json | None) -> str:
    if each is None:
        return "<td></td>"
    return (
        f"<td>{each['latency_us']:g} ({each['latency_ratio']:g})<br>"
        f"{each['megabytes_per_s']:g} ({each['throughput_ratio']:g})</td>"
    )
