"""A scene as DOT for Graphviz or as Mermaid for Markdown, which place the cards themselves."""

from __future__ import annotations

import re
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Mapping

from sros_tool.errors import UnavailableError
from sros_tool.policy.model import ALLOW
from sros_tool.report.layout import KIND_NAMES, LEVEL_NAMES, ONLOOKERS, Card, Link, Scene
from sros_tool.report.picture import OverlaySide, Picture, WireLevel
from sros_tool.terminal import visible_line

_DOT_STYLES = {"encrypt": "solid", "sign": "dashed", "none": "dotted", "unknown": "solid"}
_COLOURS = {
    OverlaySide.BOTH: "#5d7590",
    OverlaySide.FIRST: "#a34a00",
    OverlaySide.SECOND: "#176b3a",
}
_DENIED = "#b3261e"
_MERMAID_ARROWS = {"encrypt": "==>", "sign": "-->", "none": "-.->", "unknown": "-->"}
_WAIT = 60


def render_dot(picture: Picture, scene: Scene) -> str:
    """Return the scene as a directed graph in the DOT language."""
    lines = [
        f"digraph {_quoted(picture.title)} {{",
        '  graph [rankdir=LR, fontname="sans-serif", ranksep=1.2, nodesep=0.15]',
        f"  graph [labelloc=t, label={_quoted(_title(picture))}]",
        '  node [shape=box, style=rounded, fontname="monospace", fontsize=11]',
        '  edge [fontname="sans-serif", fontsize=9, color="#5d7590"]',
    ]
    cards = _once(scene)
    clusters = _clusters(cards)
    for number, (title, members) in enumerate(clusters.items()):
        lines.append(f"  subgraph cluster_{number} {{ label={_quoted(title)}; style=rounded")
        lines += [f"    {_dot_node(scene, key, cards[key])}" for key in members]
        lines.append("  }")
    inside = {key for members in clusters.values() for key in members}
    lines += [
        f"  {_dot_node(scene, key, card)}" for key, card in cards.items() if key not in inside
    ]
    lines += [f"  {_dot_edge(picture, link)}" for link in scene.links]
    return "\n".join((*lines, "}", ""))


def render_mermaid(picture: Picture, scene: Scene) -> str:
    """Return the scene as a Mermaid flowchart."""
    cards = _once(scene)
    clusters = _clusters(cards)
    lines = ["---", f"title: {_yaml(_title(picture))}", "---", "flowchart LR"]
    for number, (title, members) in enumerate(clusters.items()):
        lines.append(f'  subgraph g{number}["{_entities(title)}"]')
        lines += [f"    {_mermaid_node(scene, key, cards[key])}" for key in members]
        lines.append("  end")
    inside = {key for members in clusters.values() for key in members}
    for key in [key for key in cards if key not in inside]:
        lines.append(f"  {_mermaid_node(scene, key, cards[key])}")
    styles: dict[str, list[int]] = defaultdict(list)
    for number, link in enumerate(scene.links):
        arrow = _MERMAID_ARROWS[link.level.value] if link.qualifier is ALLOW else "--x"
        text = _entities(_link_label(picture, link))
        lines.append(f'  {_end(link.source)} {arrow}|"{text}"| {_end(link.target)}')
        red = link.violates or link.qualifier is not ALLOW
        colour = _DENIED if red else _COLOURS[link.mark]
        styles[colour].append(number)
    lines += [
        f"  linkStyle {','.join(map(str, found))} stroke:{colour}"
        for colour, found in sorted(styles.items())
    ]
    return "\n".join((*lines, ""))


def graphviz_svg(dot: str) -> str:
    """Return the SVG that Graphviz draws from DOT text; `UnavailableError` without Graphviz."""
    try:
        done = subprocess.run(
            ["dot", "-Tsvg"],
            input=dot,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=_WAIT,
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


def _title(picture: Picture) -> str:
    return ". ".join((picture.title, *picture.headlines))


def _once(scene: Scene) -> Mapping[str, Card]:
    """Map node ids to cards; the two cards of an enclave in a scene are one node here."""
    found: dict[str, Card] = {}
    for card in sorted(scene.cards, key=lambda each: (each.role, each.members, each.column)):
        found.setdefault(_key(card.id), card)
    return found


def _clusters(cards: Mapping[str, Card]) -> dict[str, list[str]]:
    """Map groups to node ids of their enclaves; empty if there is only one group."""
    found: dict[str, list[str]] = defaultdict(list)
    for key, card in cards.items():
        if card.role == "enclave":
            found[card.group].append(key)
    return dict(sorted(found.items())) if len(found) > 1 else {}


def _key(card: str) -> str:
    """Return the node id for a card id: "e" and the enclave, or "n" and the number of the card."""
    return card if card[0] == "n" else f"e{card[1:]}"


def _texts(scene: Scene, card: Card) -> Iterable[str]:
    if card.kind:
        yield KIND_NAMES[card.kind] + _protected(card)
    yield from card.members if len(card.members) <= len(card.lines) else card.lines
    yield from card.notes
    for onlooker in scene.onlookers:
        if onlooker.tag in card.tags:
            enclave = onlooker.enclave.removeprefix(":")
            yield f"{onlooker.tag}: {ONLOOKERS[onlooker.right]} {enclave}"


def _protected(card: Card) -> str:
    return "" if card.level is WireLevel.UNKNOWN else f", {LEVEL_NAMES[card.level]}"


def _link_label(picture: Picture, link: Link) -> str:
    text = ", ".join(link.rights)
    if link.qualifier is not ALLOW:
        text = f"DENY {text}"
    if link.wildcard:
        text += " by *"
    if link.violates:
        text += ": breaks a requirement"
    if link.differs:
        text += ": not so of the equal ones"
    if picture.overlay and link.mark is not OverlaySide.BOTH:
        said = picture.overlay.first if link.mark is OverlaySide.FIRST else picture.overlay.second
        text += f": {said}"
    return text


# ── DOT ────────────────────────────────────────────────────────────────────────────────────


def _dot_node(scene: Scene, key: str, card: Card) -> str:
    texts = [_escaped(each) for each in _texts(scene, card)]
    label = r"\l".join((*texts, "") if len(texts) > 1 else texts)
    shape = ", style=filled, fillcolor=white, shape=note" if card.role == "names" else ""
    return f'{_quoted(key)} [label="{label}"{shape}]'


def _dot_edge(picture: Picture, link: Link) -> str:
    denied = link.qualifier is not ALLOW
    attributes = [
        f"label={_quoted(_link_label(picture, link))}",
        f'color="{_DENIED if denied or link.violates else _COLOURS[link.mark]}"',
        f"style={_DOT_STYLES[link.level.value]}",
    ]
    attributes += ["arrowhead=tee"] if denied else []
    attributes += ["penwidth=3"] if link.violates else []
    ends = f"{_quoted(_key(link.source))} -> {_quoted(_key(link.target))}"
    return f"{ends} [{', '.join(attributes)}]"


def _quoted(text: str) -> str:
    return f'"{_escaped(text)}"'


def _escaped(text: str) -> str:
    return visible_line(text).replace("\\", "\\\\").replace('"', '\\"')


# ── Mermaid ────────────────────────────────────────────────────────────────────────────────


def _mermaid_node(scene: Scene, key: str, card: Card) -> str:
    around = '["{}"]' if card.role == "names" else '("{}")'
    return _id(key) + around.format(_label(scene, card))


def _label(scene: Scene, card: Card) -> str:
    return "<br/>".join(map(_entities, _texts(scene, card)))


def _end(card: str) -> str:
    return _id(_key(card))


def _id(key: str) -> str:
    """Return an identifier of ASCII letters and digits, unique for each key."""
    plain = "".join(
        each if each.isalnum() and each.isascii() else f"_{ord(each):x}_" for each in key
    )
    return f"{plain}_"


def _entities(text: str) -> str:
    """Return ``text`` with all possible markup escaped as Mermaid's numbered entities."""
    return re.sub(r"[^A-Za-z0-9 /_.,:+-]", lambda found: f"#{ord(found[0])};", visible_line(text))


def _yaml(text: str) -> str:
    return '"' + re.sub(r"[^A-Za-z0-9 /_.,:+-]", "_", text) + '"'
