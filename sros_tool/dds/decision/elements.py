"""Elements of a document as a vendor's own XML parser sees them."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto

from sros_tool.dds.decision.answers import Outcome, Refusal


class UnreadableError(Exception):
    """The vendor does not accept the document; ``outcome`` says whether it crashes over it."""

    def __init__(self, text: str, outcome: Outcome = Outcome.REFUSED) -> None:
        super().__init__(text)
        self.outcome = outcome

    def refusal(self, title: str, document: str) -> Refusal:
        """The same as a value; ``title`` names the vendor."""
        how = "crashes over" if self.outcome is Outcome.CRASHES else "refuses"
        return Refusal("malformed", f"{title} {how} the {document}: {self}.", self.outcome)


class Mark(Enum):
    """A node that is neither an element nor text."""

    COMMENT = auto()
    DECLARATION = auto()
    """An XML declaration, or any processing instruction."""
    OTHER = auto()
    """``<!...>``"""


@dataclass(slots=True)
class Element:
    """An element; ``children`` are its nodes in order, text and CDATA as strings.

    ``name`` and the names of ``attributes`` stand as they are written, with their prefixes.
    """

    name: str
    attributes: dict[str, str] = field(default_factory=dict)
    children: list[Element | str | Mark] = field(default_factory=list)

    @property
    def elements(self) -> list[Element]:
        """The child elements."""
        return [child for child in self.children if isinstance(child, Element)]
