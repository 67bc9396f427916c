"""Draw what security costs as SVG: latency and throughput over the payload, both logarithmic."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape

from sros_tool.demo.cost import NOTE, CostResult, Measurement, payload_text

_WIDTH, _HEIGHT, _GAP = 360, 260, 90
_LEFT, _TOP, _BOTTOM = 70, 50, 130
_COLOURS = ("#1b1b1b", "#0072b2", "#e69f00", "#009e73", "#cc79a7")
"""Of Okabe and Ito: told apart by those who do not see all colours."""

Value = Callable[[Measurement], float]


def cost_plot(cost: CostResult) -> str:
    """The plot as a document of its own."""
    width = _LEFT + 2 * _WIDTH + _GAP + 30
    height = _TOP + _HEIGHT + _BOTTOM
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}"'
        f' height="{height}" font-family="sans-serif" font-size="12" role="img">',
        "<title>What security costs</title>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
        *_panel(cost, _LEFT, "latency in µs", lambda each: each.latency * 1e6),
        *_panel(
            cost,
            _LEFT + _WIDTH + _GAP,
            "throughput in MB/s",
            lambda each: each.rate * each.payload / 1e6,
        ),
        *_legend(cost, height),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _panel(cost: CostResult, left: float, title: str, value: Value) -> list[str]:
    values = [value(each) for each in cost.measurements]
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    span = max(1, high - low)

    def across(payload: int) -> float:
        first, last = math.log(cost.payloads[0]), math.log(cost.payloads[-1])
        return left + _WIDTH * (math.log(payload) - first) / ((last - first) or 1)

    def down(number: float) -> float:
        return _TOP + _HEIGHT * (1 - (math.log10(number) - low) / span)

    lines = [_text(left, _TOP - 18, title, weight="bold")]
    for power in range(low, high + 1):
        y = down(10.0**power)
        lines.append(_line(left, y, left + _WIDTH, y, "#dddddd"))
        lines.append(_text(left - 6, y + 4, f"{10.0**power:g}", anchor="end"))
    for payload in cost.payloads:
        x = across(payload)
        lines.append(_line(x, _TOP, x, _TOP + _HEIGHT, "#eeeeee"))
        lines.append(_text(x, _TOP + _HEIGHT + 16, payload_text(payload), anchor="middle"))
    for kind, colour in zip(cost.kinds, _COLOURS, strict=False):
        points = [(across(each), down(value(cost.of(kind, each)))) for each in cost.payloads]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        lines.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
        lines += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in points]
    return lines


def _legend(cost: CostResult, height: float) -> list[str]:
    lines = []
    y = height - _BOTTOM + 45
    for place, (kind, colour) in enumerate(zip(cost.kinds, _COLOURS, strict=False)):
        x = _LEFT + place * 190
        lines.append(f'<rect x="{x}" y="{y - 10}" width="14" height="10" fill="{colour}"/>')
        label = f"{kind}: first after {cost.first[kind]:.2f} s"
        lines.append(_text(x + 20, y, label))
    words, rows = NOTE.split(), [""]
    for word in words:
        rows[-1] = f"{rows[-1]} {word}".strip()
        if len(rows[-1]) > 120:
            rows.append("")
    lines += [_text(_LEFT, y + 22 + 15 * n, row, colour="#555555") for n, row in enumerate(rows)]
    return lines


def _line(x1: float, y1: float, x2: float, y2: float, colour: str) -> str:
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{colour}"/>'


def _text(
    x: float,
    y: float,
    text: str,
    *,
    anchor: str = "start",
    weight: str = "normal",
    colour: str = "black",
) -> str:
    style = f'text-anchor="{anchor}" font-weight="{weight}" fill="{colour}"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{escape(text)}</text>'
