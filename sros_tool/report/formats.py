"""Render a scene as SVG, DOT or Mermaid, and a picture as a table in Markdown.

The SVG has the positions of the scene; tools that read DOT or Mermaid place the cards themselves.
"""

from __future__ import annotations

import re
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Mapping
from datetime import datetime
from string import Template
from textwrap import wrap

from sros_tool.errors import UnavailableError
from sros_tool.markdown import code, plain
from sros_tool.policy.model import ALLOW
from sros_tool.policy.patterns import matches
from sros_tool.report.folding import Folding
from sros_tool.report.layout import (
    INFLUENCE,
    KIND_NAMES,
    LINE,
    ONLOOKERS,
    OTHERS,
    OWN,
    PAD,
    SMALL,
    Card,
    Link,
    Scene,
    level_name,
)
from sros_tool.report.pages import escape, render_page
from sros_tool.report.picture import (
    Lack,
    Name,
    OverlaySide,
    Picture,
    Spelling,
    WireLevel,
    lack_text,
)
from sros_tool.terminal import visible_line
from sros_tool.wording import counted

_HEAD, _SAID = 40, 19
_PALETTE = {
    "paper": ("#fbfcfd", "#131416"),
    "card": ("#fff", "#1e2023"),
    "ink": ("#17222e", "#e8eef5"),
    "soft": ("#56657a", "#a9b2bc"),
    "rule": ("#cfd7e1", "#424850"),
    "frame": ("#eef2f6", "#191b1e"),
    "line": ("#5d7590", "#8aa3bf"),
    "deny": ("#b3261e", "#ff8a80"),
    "first": ("#a34a00", "#ffb070"),
    "second": ("#176b3a", "#7fd6a0"),
    "encrypt": ("#176b3a", "#7fd6a0"),
    "sign": ("#1f5fae", "#8fbcff"),
    "open": ("#a34a00", "#ffb070"),
}
"""The light and the dark color of each `$` word of the style."""
_STYLE = """\
svg{background:$paper}
text{font:12px ui-monospace,"SFMono-Regular",Menlo,Consolas,"DejaVu Sans Mono",monospace;\
fill:$ink;white-space:pre}
.small{font:11px system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;fill:$soft}
.title{font:600 15px system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
.said{font:13px system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
.head{font:600 11px system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;fill:$soft;\
letter-spacing:.06em}
.enclave text{font-weight:600}.enclave .small{font-weight:400}
.paper{fill:$paper}.card rect{fill:$card;stroke:$rule}
.enclave rect,.group rect{stroke:$soft}\
.chosen rect{stroke:$sign;stroke-width:2.5}.frame{fill:$frame}
.lacking rect{stroke:$open;stroke-dasharray:5 3}.small.lack{fill:$open}
.link{fill:none;stroke:$line;stroke-width:1.5;marker-end:url(#to)}
.wild{stroke-width:1;stroke-opacity:.75}
.sign{stroke-dasharray:9 3}.none{stroke-dasharray:2 3}
.first{stroke:$first;stroke-width:2.25;marker-end:url(#to1)}
.second{stroke:$second;stroke-width:2.25;marker-end:url(#to2)}
.differs{stroke:$sign;stroke-width:3;stroke-opacity:1;marker-end:url(#odd)}
.tipodd{fill:$sign}
.deny{stroke:$soft;stroke-width:1.75;stroke-opacity:1;marker-end:url(#no)}
.violates{stroke:$deny;stroke-width:3;stroke-opacity:1;marker-end:url(#bad)}
.tip{fill:$line}.tipbad{fill:$deny}.tip1{fill:$paper;stroke:$first;stroke-width:1.2}.tip2{fill:$second}
.cross{fill:$paper;stroke:$soft;stroke-width:1.6}
.glyph{fill:none;stroke:$soft;stroke-width:1.4}
.lock{fill:none;stroke-width:1.4}.lock-encrypt{stroke:$encrypt}.lock-sign{stroke:$sign}\
.lock-none{stroke:$open}
.tag{font:700 11px system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;fill:$soft}
"""
_MARKERS = """\
<marker id="to" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" \
markerUnits="userSpaceOnUse" orient="auto"><path class="tip" d="M0 0.5L8 4L0 7.5z"/></marker>
<marker id="to1" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="9" markerHeight="9" \
markerUnits="userSpaceOnUse" orient="auto"><path class="tip1" d="M1 1L7 4L1 7z"/></marker>
<marker id="to2" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="9" markerHeight="9" \
markerUnits="userSpaceOnUse" orient="auto"><path class="tip2" d="M0 4L4 0L8 4L4 8z"/></marker>
<marker id="bad" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="11" markerHeight="11" \
markerUnits="userSpaceOnUse" orient="auto"><path class="tipbad" d="M0 0.5L8 4L0 7.5z"/></marker>
<marker id="odd" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="11" markerHeight="11" \
markerUnits="userSpaceOnUse" orient="auto"><path class="tipodd" d="M0 0.5L8 4L0 7.5z"/></marker>
<marker id="no" viewBox="0 0 14 14" refX="13" refY="7" markerWidth="14" markerHeight="14" \
markerUnits="userSpaceOnUse" orient="0"><path class="cross" d="M7 1.5a5.5 5.5 0 1 0 .01 0z\
M3.2 10.8L10.8 3.2"/></marker>"""
_GLYPHS = {
    "topics": "M1 2.5h11M1 6.5h11M1 10.5h7",
    "services": "M1 4h10.5l-3-3M12 9H1.5l3 3",
    "actions": "M6.5 1a5.5 5.5 0 1 0 .01 0zM6.5 4.5a2 2 0 1 0 .01 0z",
    "dds": "M6.5 1L12 6.5L6.5 12L1 6.5z",
}
"""SVG shapes of the symbols for kinds of names, 13 by 13 pixels."""
_LOCKS = {
    WireLevel.ENCRYPT: "M2 6h9v6.5H2zM4 6V3.8a2.5 2.5 0 0 1 5 0V6M6.5 8.3v2",
    WireLevel.SIGN: "M1.5 12h10M2.5 9.5l1-2.6L9.3 1.2l1.8 1.8L5.2 8.7z",
    WireLevel.NONE: "M2 6h9v6.5H2zM4 6V3.8a2.5 2.5 0 0 1 4.8-1",
}
"""SVG shapes of the symbols for protection levels (lock, pen, open lock), 13 by 13 pixels."""


def render_svg(picture: Picture, scene: Scene) -> str:
    """Return the scene as an SVG document; the same scene gives the same bytes."""
    legend = list(_legend(picture, scene))
    # A used right that is not allowed is drawn like a violation.
    use = picture.overlay is not None and picture.overlay.kind == "use"
    palette = {**_PALETTE, "second": _PALETTE["deny"]} if use else _PALETTE
    text_lines = [
        line for headline in picture.headlines for line in _lines(f"{headline}.", scene.width)
    ]
    top = _HEAD + _SAID * len(text_lines) + (8 if text_lines else 0)
    height = scene.height + top + 16 + 20 * len(legend)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {scene.width} {height}" '
        f'width="{scene.width}" height="{height}" role="img">',
        f"<title>{escape(picture.title)}: who may do what</title>",
        f"<style>{_style(palette)}</style>",
        f"<defs>{_MARKERS}</defs>",
        f'<rect class="paper" width="{scene.width}" height="{height}"/>',
        f'<text class="title" x="14" y="26">{escape(picture.title)}</text>',
        f'<text class="small" x="{scene.width - 14}" y="26" text-anchor="end">'
        f"{escape(_summary(picture, scene))}</text>",
        *(
            f'<text class="said" x="14" y="{_HEAD + 8 + _SAID * number}">{escape(line)}</text>'
            for number, line in enumerate(text_lines)
        ),
        f'<g transform="translate(0 {top})">',
        *_svg_heads(scene),
    ]
    cards = {card.id: card for card in scene.cards}
    for frame in scene.frames:
        lines.append(
            f'<rect class="frame" x="{frame.x}" y="{frame.y}" width="{frame.width}" '
            f'height="{frame.height}" rx="8"/>'
            f'<text class="small" x="{frame.x + 8}" y="{frame.y + 16}">{escape(frame.title)}</text>'
        )
    # The most important links are drawn last, on top.
    rank = {OverlaySide.BOTH: 0, OverlaySide.FIRST: 1, OverlaySide.SECOND: 2}
    for link in sorted(
        scene.links,
        key=lambda link: (
            *(link.violates, link.qualifier is not ALLOW, link.differs, rank[link.mark]),
        ),
    ):
        lines.append(_svg_link(picture, link, cards))
    lines += [line for card in scene.cards for line in _svg_card(card)]
    lines.append("</g>")
    for number, text in enumerate(legend):
        y = top + scene.height + 16 + 20 * number
        lines.append(f'<g transform="translate(14 {y})">{text}</g>')
    return "\n".join((*lines, "</svg>", ""))


def _style(palette: Mapping[str, tuple[str, str]]) -> str:
    """Return the style of a drawing: light, and dark where the viewer asks for it.

    Viewers without variables and media queries (CairoSVG, Qt, printing) draw in the light colors,
    so the style also has every color as a value.
    """
    light = {word: colors[0] for word, colors in palette.items()}
    dark = {word: colors[1] for word, colors in palette.items()}
    colored = "".join(
        f"{selector.strip()}{{{';'.join(parts)}}}\n"
        for selector, rule in re.findall(r"([^{}]+)\{([^{}]*)\}", _STYLE)
        if (parts := [part for part in rule.split(";") if "$" in part])
    )
    return (
        Template(_STYLE).substitute(light)
        + "@media (prefers-color-scheme:dark){\n"
        + Template(colored).substitute(dark)
        + "}\n"
    )


def _summary(picture: Picture, scene: Scene) -> str:
    """Return the numbers of enclaves and names in a scene, and of left out names, in words."""
    text = f"{counted(len(picture.enclaves), 'enclave')}, {counted(scene.shown, 'name')}"
    return text + (f", without {scene.hidden} that every node needs" if scene.hidden else "")


def _lines(text: str, width: int) -> list[str]:
    """Split a sentence into lines that fit into a picture of this width, in pixels."""
    return wrap(text, max(20, (width - 28) // 7), break_on_hyphens=False)


def _svg_heads(scene: Scene) -> Iterable[str]:
    for head in scene.heads:
        text = escape(head.text.upper())
        yield f'<text class="head" x="{head.x}" y="4" text-anchor="{head.anchor}">{text}</text>'


def _curve(link: Link, source: Card, target: Card) -> str:
    """Return the curve of a link as SVG path data."""
    x1, x2 = source.x + source.width, target.x - 1
    middle = (x1 + x2) // 2
    return f"M{x1} {link.y1}C{middle} {link.y1} {middle} {link.y2} {x2} {link.y2}"


_DIFFERS = "the robots (namespaces, enclaves) that are drawn as one do not have this right"


def _link_text(picture: Picture, link: Link) -> str:
    """Return the tooltip of a link."""
    if link.rights == INFLUENCE:
        return "influence over names that are not drawn"
    overlay = picture.overlay
    text = f"{link.qualifier.value} {', '.join(link.rights)}"
    if link.wildcard:
        text += " (by a wildcard)"
    if link.violates:
        text += ": breaks a requirement"
    if link.differs:
        text += f": {_DIFFERS}"
    if overlay and link.mark is not OverlaySide.BOTH:
        text += f": {overlay.first if link.mark is OverlaySide.FIRST else overlay.second}"
    return f"{text}, {level_name(picture, link.level)}"


def _link_classes(link: Link) -> str:
    """Return the CSS classes of a link: its protection, wildcard, side and denial."""
    classes = ["link", link.level.value]
    classes += ["wild"] if link.wildcard else []
    classes += [link.mark.value] if link.mark is not OverlaySide.BOTH else []
    classes += ["differs"] if link.differs else []
    classes += ["violates"] if link.violates else []
    classes += ["deny"] if link.qualifier is not ALLOW else []
    return " ".join(classes)


def _svg_link(picture: Picture, link: Link, cards: dict[str, Card]) -> str:
    source, target = cards[link.source], cards[link.target]
    return (
        f'<path class="{_link_classes(link)}" d="{_curve(link, source, target)}">'
        f"<title>{escape(_link_text(picture, link))}</title></path>"
    )


def _svg_card(card: Card) -> Iterable[str]:
    names = card.role == "names"
    lacks = lack_text(card.kind, card.lacks) if card.lacks else ""
    kind = f"card {card.role}{' chosen' if card.chosen else ''}{' lacking' if lacks else ''}"
    yield (
        f'<g class="{kind}" transform="translate({card.x} {card.y})">'
        f"<title>{escape(', '.join(card.members))}</title>"
        f'<rect width="{card.width}" height="{card.height}" rx="6"/>'
    )
    if names:
        yield f'<path class="glyph" transform="translate(10 9)" d="{_GLYPHS[card.kind]}"/>'
        if lock := _LOCKS.get(card.level):
            yield (
                f'<path class="lock lock-{card.level.value}" '
                f'transform="translate({card.width - 23} 8)" d="{lock}"/>'
            )
    x, y = (32 if names else 12), PAD + 12
    for line in card.lines:
        yield f'<text x="{x}" y="{y}">{escape(line)}</text>'
        y += LINE
    for number, tag in enumerate(reversed(card.tags)):
        right = card.width - (32 if card.level in _LOCKS else 12) - 18 * number
        yield f'<text class="tag" x="{right}" y="{PAD + 12}" text-anchor="end">{tag}</text>'
    for note in card.notes:
        lack = " lack" if note == lacks or (names and note.startswith("everybody may ")) else ""
        yield f'<text class="small{lack}" x="{x}" y="{y - 1}">{escape(note)}</text>'
        y += SMALL
    yield "</g>"


def _legend(picture: Picture, scene: Scene) -> Iterable[str]:
    """Yield the lines of the legend for the symbols in a scene."""
    kinds = sorted({card.kind for card in scene.cards if card.kind}, key=list(_GLYPHS).index)
    yield _legend_row(
        (
            f'<path class="glyph" transform="translate(0 -10)" d="{_GLYPHS[kind]}"/>',
            KIND_NAMES[kind],
        )
        for kind in kinds
    )
    levels = [level for level in _LOCKS if any(link.level is level for link in scene.links)]
    if levels:
        yield _legend_row(
            (
                f'<path class="lock lock-{level.value}" transform="translate(0 -10)" '
                f'd="{_LOCKS[level]}"/><path class="link {level.value}" d="M20 -4h40"/>',
                level_name(picture, level),
            )
            for level in levels
        )
    rows = []
    allowed = [link for link in scene.links if link.qualifier is ALLOW]
    if allowed:
        rows.append(('<path class="link" d="M0 -4h40"/>', "allowed"))
    if any(link.wildcard for link in allowed):
        rows.append(('<path class="link wild" d="M0 -4h40"/>', "allowed by a wildcard only"))
    if any(link.qualifier is not ALLOW for link in scene.links):
        rows.append(('<path class="link deny" d="M0 -4h40"/>', "denied"))
    if any(link.violates for link in scene.links):
        rows.append(('<path class="link violates" d="M0 -4h40"/>', "breaks a requirement"))
    if any(link.differs for link in scene.links):
        rows.append(('<path class="link differs" d="M0 -4h40"/>', _DIFFERS))
    if picture.overlay:
        rows.append(('<path class="link first" d="M0 -4h40"/>', picture.overlay.first))
        rows.append(('<path class="link second" d="M0 -4h40"/>', picture.overlay.second))
    yield _legend_row(rows)
    yield from _card_legend(picture, scene)
    if any(note.startswith(OWN) for card in scene.cards for note in card.notes):
        yield _legend_row([("", f"{OWN} names that no other enclave may use")])
    if scene.onlookers:
        yield _legend_row(
            (
                f'<text class="tag" x="4" y="0">{onlooker.tag}</text>',
                f"{ONLOOKERS[onlooker.right]} {onlooker.enclave.removeprefix(':')}",
            )
            for onlooker in scene.onlookers
        )


def _card_legend(picture: Picture, scene: Scene) -> Iterable[str]:
    """Yield the lines of the legend for marked cards, and for labels of equal units."""
    rows = []
    if any(card.chosen for card in scene.cards):
        rows.append(
            (_LEGEND_BOX.format("chosen"), "in focus: information goes to it from the left")
        )
    if any(card.lacks for card in scene.cards):
        rows.append((_LEGEND_BOX.format("lacking"), "nobody may send it, or nobody may receive it"))
    if rows:
        yield _legend_row(rows)
    for units in picture.equal[:_MOST_LABELS]:
        of_each = f"each of {len(units.members)} {units.what}s, which are equal except for their"
        yield _legend_row([("", f"{units.label}: {of_each} names")])
    if any(word in line for word in OTHERS for card in scene.cards for line in card.lines):
        yield _legend_row(
            [("", f"{{1 {OTHERS[0]} …}}: this name of one other robot, namespace or enclave")]
        )


_LEGEND_BOX = '<g class="card {}"><rect y="-11" width="34" height="14" rx="4"/></g>'
_MOST_LABELS = 8


def _legend_row(rows: Iterable[tuple[str, str]]) -> str:
    """Return one row of the legend as SVG, from pairs of symbol (SVG) and text."""
    x, cells = 0, []
    for drawn, text in rows:
        symbol_width = (
            68 if "M20 -4h40" in drawn else (48 if "h40" in drawn else (20 if drawn else 0))
        )
        symbol_width = 42 if "<rect" in drawn else symbol_width
        cells.append(
            f'<g transform="translate({x} 0)">{drawn}'
            f'<text class="small" x="{symbol_width}" y="0">{escape(text)}</text></g>'
        )
        x += symbol_width + round(6.2 * len(text)) + 26
    return "".join(cells)


_DOT_STYLES = {"encrypt": "solid", "sign": "dashed", "none": "dotted", "unknown": "solid"}
_COLORS = {
    OverlaySide.BOTH: "#5d7590",
    OverlaySide.FIRST: "#a34a00",
    OverlaySide.SECOND: "#176b3a",
}
_VIOLATING = "#b3261e"
_MERMAID_ARROWS = {"encrypt": "==>", "sign": "-->", "none": "-.->", "unknown": "-->"}
_WAIT_SECONDS = 60


def render_dot(picture: Picture, scene: Scene) -> str:
    """Return the scene as a directed graph in the DOT language."""
    lines = [
        f"digraph {_dot_quoted(picture.title)} {{",
        '  graph [rankdir=LR, fontname="sans-serif", ranksep=1.2, nodesep=0.15]',
        f"  graph [labelloc=t, label={_dot_quoted(_picture_title(picture))}]",
        '  node [shape=box, style=rounded, fontname="monospace", fontsize=11]',
        '  edge [fontname="sans-serif", fontsize=9, color="#5d7590"]',
    ]
    cards = _node_cards(scene)
    clusters = _clusters(cards)
    for number, (title, members) in enumerate(clusters.items()):
        lines.append(f"  subgraph cluster_{number} {{ label={_dot_quoted(title)}; style=rounded")
        lines += [f"    {_dot_node(picture, scene, key, cards[key])}" for key in members]
        lines.append("  }")
    inside = {key for members in clusters.values() for key in members}
    lines += [
        f"  {_dot_node(picture, scene, key, card)}"
        for key, card in cards.items()
        if key not in inside
    ]
    lines += [f"  {_dot_edge(picture, link)}" for link in scene.links]
    return "\n".join((*lines, "}", ""))


def render_mermaid(picture: Picture, scene: Scene) -> str:
    """Return the scene as a Mermaid flowchart."""
    cards = _node_cards(scene)
    clusters = _clusters(cards)
    lines = ["---", f"title: {_yaml_quoted(_picture_title(picture))}", "---", "flowchart LR"]
    for number, (title, members) in enumerate(clusters.items()):
        lines.append(f'  subgraph g{number}["{_escaped_for_mermaid(title)}"]')
        lines += [f"    {_mermaid_node(picture, scene, key, cards[key])}" for key in members]
        lines.append("  end")
    inside = {key for members in clusters.values() for key in members}
    for key in [key for key in cards if key not in inside]:
        lines.append(f"  {_mermaid_node(picture, scene, key, cards[key])}")
    styles: dict[str, list[int]] = defaultdict(list)
    for number, link in enumerate(scene.links):
        arrow = _MERMAID_ARROWS[link.level.value] if link.qualifier is ALLOW else "--x"
        text = _escaped_for_mermaid(_link_label(picture, link))
        lines.append(f'  {_node_id(link.source)} {arrow}|"{text}"| {_node_id(link.target)}')
        color = _VIOLATING if link.violates else _COLORS[link.mark]
        styles[color].append(number)
    lines += [
        f"  linkStyle {','.join(map(str, links))} stroke:{color}"
        for color, links in sorted(styles.items())
    ]
    return "\n".join((*lines, ""))


def _render_markdown(picture: Picture, *, everything: bool = False) -> str:
    """Return a Markdown table with the protection, the senders and the receivers of each name.

    Without ``everything``, names are left out if the only rights to them are rights that every node
    needs.
    """
    rows: dict[tuple[str, str], tuple[list[str], list[str]]] = {
        (edge.kind, edge.name): ([], [])
        for edge in sorted(picture.edges)
        if everything or not edge.common
    }
    for edge in sorted(picture.edges):
        if ends := rows.get((edge.kind, edge.name)):
            who = code(edge.enclave) + ("" if edge.qualifier is ALLOW else " is denied")
            who += f" by {', '.join(map(code, edge.by))}" if edge.by else ""
            who += f" ({', '.join(edge.parts)})" if edge.parts else ""
            ends[0 if edge.sends else 1].append(who)
    known = {(name.kind, name.name): name for name in picture.names}
    allowed = {(edge.kind, edge.name) for edge in picture.edges if edge.qualifier is ALLOW}
    lines = [f"### {plain(picture.title)}: who may do what", ""]
    lines += [f"- {plain(headline)}" for headline in picture.headlines]
    lines += ["", "| name | may publish or call | may subscribe or serve |", "| --- | --- | --- |"]
    spellings = {known[row].spelling for row in rows}
    for (kind, name), ends in rows.items():
        stated = known[kind, name]
        level = stated.protection.level
        remarks: list[str] = [stated.spelling] if stated.spelling in _MOVING else []
        remarks += [] if level is WireLevel.UNKNOWN else [level_name(picture, level)]
        cells = [f"{KIND_NAMES[kind]} {code(name)}" + f" ({'; '.join(remarks)})" * bool(remarks)]
        controls = stated.protection.write_control, stated.protection.read_control
        sides = Lack.SENDER, Lack.RECEIVER
        for end, lack, controlled, sends in zip(ends, sides, controls, (True, False), strict=True):
            first = [stated.protection.everybody] if not controlled else []
            is_denied_alone = controlled and (kind, name) not in allowed
            first += ["no enclave here"] if stated.lacks is lack or is_denied_alone else []
            who = ", ".join(dict.fromkeys((*first, *end)))
            cells.append(who or _remark_on_single_names(picture, stated, sends=sends))
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    if not spellings.isdisjoint(_MOVING):
        lines += ["", "A relative name moves with the namespace of its node; absolute names stay."]
    elif spellings == {Spelling.ABSOLUTE}:
        lines += ["", "All names are absolute: the namespaces of their nodes do not change them."]
    return "\n".join((*lines, ""))


_MOVING = (Spelling.RELATIVE, Spelling.BOTH)


def _remark_on_single_names(picture: Picture, name: Name, *, sends: bool) -> str:
    """Return a remark if enclaves on one side may use only known names of a wildcard, or ""."""
    single = (
        edge
        for edge in picture.edges
        if (edge.kind, edge.sends, edge.qualifier) == (name.kind, sends, ALLOW)
        and matches(name.name, edge.name)
    )
    return "other enclaves, for single names only" if name.wildcard and any(single) else ""


def _graphviz_svg(dot: str) -> str:
    """Return the SVG that Graphviz draws from DOT text, or raise `UnavailableError`."""
    try:
        done = subprocess.run(
            ["dot", "-Tsvg"],
            input=dot,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=_WAIT_SECONDS,
            check=True,
        )
    except FileNotFoundError as error:
        raise UnavailableError(
            "Graphviz is not installed", "", "Install graphviz, or leave out --graphviz."
        ) from error
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        raise UnavailableError("Graphviz could not draw the picture", str(error)) from error
    return done.stdout


# ── both formats ───────────────────────────────────────────────────────────────────────────


def _picture_title(picture: Picture) -> str:
    return ". ".join((picture.title, *picture.headlines))


def _node_cards(scene: Scene) -> Mapping[str, Card]:
    """Map the ids of graph nodes to cards; an enclave that has two cards becomes one graph node.

    A graph node is a box in the graph of Graphviz or Mermaid.
    """
    cards: dict[str, Card] = {}
    for card in sorted(scene.cards, key=lambda card: (card.role, card.members, card.column)):
        cards.setdefault(_node_key(card.id), card)
    return cards


def _clusters(cards: Mapping[str, Card]) -> dict[str, list[str]]:
    """Map groups to the graph nodes of their enclaves, by id; empty for a single group."""
    groups: dict[str, list[str]] = defaultdict(list)
    for key, card in cards.items():
        if card.role == "enclave":
            groups[card.group].append(key)
    return dict(sorted(groups.items())) if len(groups) > 1 else {}


def _node_key(card: str) -> str:
    """Return the id of a card's graph node: "e" and the enclave, or "n" and the card's number."""
    return card if card[0] == "n" else f"e{card[1:]}"


def _card_texts(picture: Picture, scene: Scene, card: Card) -> Iterable[str]:
    if card.kind:
        yield KIND_NAMES[card.kind] + _level_text(picture, card)
    yield from card.members if len(card.members) <= len(card.lines) else card.lines
    yield from card.notes
    for onlooker in scene.onlookers:
        if onlooker.tag in card.tags:
            enclave = onlooker.enclave.removeprefix(":")
            yield f"{onlooker.tag}: {ONLOOKERS[onlooker.right]} {enclave}"


def _level_text(picture: Picture, card: Card) -> str:
    return "" if card.level is WireLevel.UNKNOWN else f", {level_name(picture, card.level)}"


def _link_label(picture: Picture, link: Link) -> str:
    text = ", ".join(link.rights)
    if link.qualifier is not ALLOW:
        text = f"DENY {text}"
    if link.wildcard:
        text += " by a wildcard"
    if link.violates:
        text += ": breaks a requirement"
    if link.differs:
        text += f": {_DIFFERS}"
    if picture.overlay and link.mark is not OverlaySide.BOTH:
        side = picture.overlay.first if link.mark is OverlaySide.FIRST else picture.overlay.second
        text += f": {side}"
    return text


# ── DOT ────────────────────────────────────────────────────────────────────────────────────


def _dot_node(picture: Picture, scene: Scene, key: str, card: Card) -> str:
    texts = [_dot_escaped(text) for text in _card_texts(picture, scene, card)]
    label = r"\l".join((*texts, "") if len(texts) > 1 else texts)
    shape = ", style=filled, fillcolor=white, shape=note" if card.role == "names" else ""
    return f'{_dot_quoted(key)} [label="{label}"{shape}]'


def _dot_edge(picture: Picture, link: Link) -> str:
    denied = link.qualifier is not ALLOW
    attributes = [
        f"label={_dot_quoted(_link_label(picture, link))}",
        f'color="{_VIOLATING if link.violates else _COLORS[link.mark]}"',
        f"style={_DOT_STYLES[link.level.value]}",
    ]
    attributes += ["arrowhead=tee"] if denied else []
    attributes += ["penwidth=3"] if link.violates else []
    ends = f"{_dot_quoted(_node_key(link.source))} -> {_dot_quoted(_node_key(link.target))}"
    return f"{ends} [{', '.join(attributes)}]"


def _dot_quoted(text: str) -> str:
    return f'"{_dot_escaped(text)}"'


def _dot_escaped(text: str) -> str:
    return visible_line(text).replace("\\", "\\\\").replace('"', '\\"')


# ── Mermaid ────────────────────────────────────────────────────────────────────────────────


def _mermaid_node(picture: Picture, scene: Scene, key: str, card: Card) -> str:
    around = '["{}"]' if card.role == "names" else '("{}")'
    return _identifier(key) + around.format(_mermaid_label(picture, scene, card))


def _mermaid_label(picture: Picture, scene: Scene, card: Card) -> str:
    return "<br/>".join(map(_escaped_for_mermaid, _card_texts(picture, scene, card)))


def _node_id(card: str) -> str:
    return _identifier(_node_key(card))


def _identifier(key: str) -> str:
    """Return a unique identifier of ASCII letters and digits for a key."""
    plain = "".join(
        letter if letter.isalnum() and letter.isascii() else f"_{ord(letter):x}_" for letter in key
    )
    return f"{plain}_"


def _escaped_for_mermaid(text: str) -> str:
    """Return ``text`` with all markup characters escaped as Mermaid's numbered entities."""
    return re.sub(r"[^A-Za-z0-9 /_.,:+-]", lambda letter: f"#{ord(letter[0])};", visible_line(text))


def _yaml_quoted(text: str) -> str:
    return '"' + re.sub(r"[^A-Za-z0-9 /_.,:+-]", "_", text) + '"'


def render(
    picture: Picture,
    folding: Folding,
    form: str,
    moment: datetime,
    *,
    everything: bool = False,
    graphviz: bool = False,
    hops: int | None = None,
) -> str:
    """Render a picture as text in one of the formats html, svg, dot, mermaid and markdown.

    Args:
        picture: the picture.
        folding: the same picture with equal units drawn once.
        form: the format.
        moment: the time that a page shows.
        everything: also draw rights that every node needs; a page has both.
        graphviz: let Graphviz lay out an SVG.
        hops: number of hops to draw from the focus.

    Raises:
        UnavailableError: Graphviz is not installed.
    """
    if form == "markdown":
        return _render_markdown(folding.picture, everything=everything)
    placed = form in ("html", "svg") and not graphviz
    scenes = folding.scenes(with_places=placed, hops=hops or 0)
    if form == "html":
        return render_page(picture, scenes, moment, folding.picture)
    scene = next((scene for scene in scenes if everything and scene.id == "all"), scenes[0])
    if form == "svg" and not graphviz:
        return render_svg(picture, scene)
    if form == "mermaid":
        return render_mermaid(picture, scene)
    dot = render_dot(picture, scene)
    return _graphviz_svg(dot) if graphviz else dot
