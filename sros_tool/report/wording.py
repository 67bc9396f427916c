"""The words of pictures: labels that fit their cards, and what symbols stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sros_tool.report.fold import Bundle
from sros_tool.report.picture import Level

ONLOOKERS = {
    "publish": "also written by",
    "subscribe": "also read by",
    "request": "also called by",
    "reply": "also served by",
    "call": "also called by",
    "execute": "also carried out by",
}
REACHES = {
    "publish": "writes",
    "subscribe": "reads",
    "request": "calls",
    "reply": "serves",
    "call": "calls",
    "execute": "carries out",
}
COMMON = {
    "topics": "used by every node",
    "services": "served by every node",
    "actions": "used by every node",
    "dds": "used by every node",
}
"""What a card says of the rights that every node has to its names, where these are not drawn."""
KIND_NAMES = {"topics": "topic", "services": "service", "actions": "action", "dds": "DDS topic"}
LEVEL_NAMES = {
    Level.ENCRYPT: "encrypted",
    Level.SIGN: "signed, readable",
    Level.NONE: "not protected",
    Level.UNKNOWN: "protection unknown",
}
OWN = "own:"
SENDERS, LISTENERS = "may send", "may receive"


_MOST, _SHOWN = 8, 4  # so many names stand on a card, and of more than these so many


def counted(number: int, thing: str) -> str:
    """As ``1 topic`` and ``2 topics``."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def own_text(own: Mapping[str, int]) -> list[str]:
    """What an enclave alone has, as ``own: 3 topics, 2 services``, on lines that are short."""
    found = [counted(number, KIND_NAMES[kind]) for kind, number in own.items() if number]
    lines = [f"{OWN} {', '.join(found[:2])}"]
    return [*lines, ", ".join(found[2:])] if found[2:] else lines


def names_title(bundle: Bundle) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What stands on the card of a bundle: names or the wildcards for them, and small notes."""
    kind, names = KIND_NAMES[bundle.kind], bundle.names
    if bundle.partial:
        return (f"{_common_place(names)}/…",), (
            f"{counted(len(names), kind)}; a line is for some of them",
        )
    if len(names) <= _MOST:
        return names, ()
    expressions = sorted({each for tie in bundle.ties for each in tie.by})
    if expressions and all(tie.by for tie in bundle.ties):
        return tuple(expressions[:_MOST]), (f"reaches {counted(len(names), kind)}",)
    return names[:_SHOWN], (f"and {len(names) - _SHOWN} more {kind}s",)


def _common_place(names: Sequence[str]) -> str:
    """The namespace that all names are in, "" for the root."""
    found = []
    for parts in zip(*(name.split("/")[:-1] for name in names), strict=False):
        if len(set(parts)) > 1:
            break
        found.append(parts[0])
    return "/".join(found)


def wrapped(text: str, letters: int) -> tuple[str, ...]:
    """``text`` in lines of so many letters, cut after a slash or underscore where one is near."""
    lines = []
    while len(text) > letters:
        cut = max(
            text.rfind("/", letters // 2, letters), text.rfind("_", letters // 2, letters - 1)
        )
        cut = cut if cut > 0 else letters - 1
        if text[cut] == "_":
            cut += 1
        lines.append(text[:cut])
        text = "  " + text[cut:]
    return (*lines, text)
