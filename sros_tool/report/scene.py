"""A picture placed on paper, as values: senders left, names in the middle, listeners right.

A scene is the same for every format that draws it, and for the page.  Lengths are in pixels at
the size at which the text is read; x grows to the right and y downwards.
"""

from __future__ import annotations

from dataclasses import dataclass

from sros_tool.policy.model import Qualifier
from sros_tool.report.picture import Level, Mark

SIDE_WIDTH, NAMES_WIDTH, GUTTER = 184, 330, 110
LINE, PAD, SMALL = 16, 7, 14
"""The heights of a line of text, of the room around it, and of a line of a note."""


@dataclass(frozen=True, slots=True)
class Card:
    """A rectangle with text: an enclave, a group of enclaves, or names that are alike.

    ``column`` is 0, 1 or 2; an enclave that sends and listens has a card on either side.
    ``lines`` are its text, ``notes`` smaller text below.  ``members`` are all the enclaves or
    names that it stands for; ``kind`` and ``level`` are those of names, else "" and unknown.
    ``group`` is that of an enclave; ``tags`` are the letters of the onlookers of these names.
    """

    id: str
    role: str
    column: int
    x: int
    y: int
    width: int
    height: int
    lines: tuple[str, ...]
    notes: tuple[str, ...]
    members: tuple[str, ...]
    kind: str = ""
    level: Level = Level.UNKNOWN
    group: str = ""
    tags: str = ""


@dataclass(frozen=True, slots=True)
class Onlooker:
    """Who reaches so much that lines would hide all others: a letter stands on what it reaches."""

    tag: str
    enclave: str
    right: str


@dataclass(frozen=True, slots=True)
class Link:
    """A line from the right edge of a card to the left edge of another one; the arrow is there.

    ``rights`` are what it says, such as publish; ``wildcard`` if only wildcards say so.
    """

    source: str
    target: str
    y1: int
    y2: int
    rights: tuple[str, ...]
    qualifier: Qualifier
    level: Level
    wildcard: bool
    mark: Mark


@dataclass(frozen=True, slots=True)
class Frame:
    """The title of a group of enclaves that stand together, and the room that they take."""

    title: str
    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Scene:
    """Cards and the links between them.

    ``shown`` names are drawn or counted in the enclave that alone may use them; ``hidden`` ones
    are not, as only what every node needs is said of them.
    """

    id: str
    title: str
    width: int
    height: int
    cards: tuple[Card, ...]
    links: tuple[Link, ...]
    frames: tuple[Frame, ...]
    onlookers: tuple[Onlooker, ...]
    hidden: int = 0
    shown: int = 0
