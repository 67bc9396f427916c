"""The text of a policy file with the place of each element, to change it as a person would.

What is not concerned stays byte for byte, comments and line ends included.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from lxml import etree

from sros_tool.errors import PolicyError
from sros_tool.xml import parse, tag_of

_MARKUP = re.compile(
    r"<!--.*?-->|<\?.*?\?>|<!\[CDATA\[.*?\]\]>"
    r"|</(?P<close>[^\s>]+)\s*>"
    r"|<(?P<open>[^\s/>!?]+)(?:[^>\"']|\"[^\"]*\"|'[^']*')*?(?P<empty>/?)>",
    re.DOTALL,
)
_COMMENTS_OF_THE_LINE = re.compile(r"(?:[ \t]*<!--.*?-->)+(?=[ \t]*(?:\r?\n|\Z))", re.DOTALL)


@dataclass(slots=True)
class Element:
    """An element and its places in the text: characters from the start of the document.

    ``inner`` is where its content begins, ``close`` where its end tag does; an element without
    end tag (``<a/>``) has ``inner == close == end``.
    """

    xml: etree._Element
    start: int
    inner: int
    close: int = 0
    end: int = 0
    children: list[Element] = field(default_factory=list)

    @property
    def tag(self) -> str:
        """The tag, with its namespace in braces if it has one."""
        return tag_of(self.xml)

    def get(self, attribute: str) -> str:
        """The value of an attribute, or ""."""
        return self.xml.get(attribute, "")

    def named(self, tag: str) -> Iterator[Element]:
        """The child elements of that tag which stand here themselves (not through an include)."""
        return (child for child in self.children if child.tag == tag)


class Text:
    """A policy file as text; edits are collected, and made all at once."""

    def __init__(self, data: bytes, name: str) -> None:
        self._name = name
        root = parse(data, name)
        self._encoding = _encoding(data, root)
        try:
            self.text = data.decode(self._encoding)
            faithful = self.text.encode(self._encoding) == data
        except (UnicodeError, LookupError):
            faithful = False
        if not faithful:
            raise self._unsuitable(f"Its encoding {self._encoding} cannot be kept exactly.")
        self.root = self._elements(root)
        self.newline = "\r\n" if "\r\n" in self.text else "\n"
        self.unit = self._unit()
        self._edits: list[tuple[int, int, str]] = []

    def _unsuitable(self, why: str) -> PolicyError:
        return PolicyError(
            f"{self._name} cannot be added to in place",
            why,
            "Save it as UTF-8.",
        )

    def _elements(self, root: etree._Element) -> Element:
        """The tree of places.  lxml knows what the elements are, but not where they stand."""
        nodes = root.iter()
        top: Element | None = None
        stack: list[Element] = []
        for mark in _MARKUP.finditer(self.text):
            if mark["close"]:
                stack[-1].close, stack[-1].end = mark.start(), mark.end()
                stack.pop()
            elif mark["open"]:
                node = next(nodes, None)
                if node is None or etree.QName(node).localname != mark["open"].split(":")[-1]:
                    raise self._unsuitable(f"<{mark['open']}> is not where it was expected.")
                end = mark.end()
                element = Element(node, mark.start(), end, end, end)
                if stack:
                    stack[-1].children.append(element)
                top = top or element
                if not mark["empty"]:
                    stack.append(element)
        if top is None or stack or next(nodes, None) is not None:
            raise self._unsuitable("Its elements are not where they were expected.")
        return top

    # ── how it is laid out ─────────────────────────────────────────────────────────────────

    def indent_of(self, element: Element) -> str | None:
        """The white space before an element that begins its line; None for one that does not."""
        line = max(self.text.rfind("\n", 0, element.start), self.text.rfind("\r", 0, element.start))
        before = self.text[line + 1 : element.start].removeprefix("\ufeff")
        if before.strip(" \t") or (line < 0 and element is not self.root):
            return None
        return before

    def _unit(self) -> str:
        """What a line is indented by more than that of its parent."""
        stack = [self.root]
        while stack:
            parent = stack.pop()
            outer = self.indent_of(parent)
            for child in parent.children[:1]:
                inner = self.indent_of(child)
                if outer is not None and inner is not None and inner.startswith(outer):
                    return inner[len(outer) :]
            stack += parent.children[:1]
        return "  "

    def after(self, element: Element) -> int:
        """The place behind an element and the comments that follow on its line."""
        comments = _COMMENTS_OF_THE_LINE.match(self.text, element.end)
        if comments and self.indent_of(element) is not None:
            return comments.end()
        return element.end

    # ── changing it ────────────────────────────────────────────────────────────────────────

    def put(self, place: int, text: str, until: int | None = None) -> None:
        """Let ``text`` stand at a place, or in place of what goes from there to ``until``."""
        self._edits.append((place, place if until is None else until, text))

    def document(self) -> bytes:
        """The document with all edits."""
        pieces, done = [], 0
        for start, end, text in sorted(self._edits, key=lambda edit: edit[0]):
            pieces += [self.text[done:start], text]
            done = end
        return "".join((*pieces, self.text[done:])).encode(self._encoding)


def _encoding(data: bytes, root: etree._Element) -> str:
    """The encoding of a document; a byte order mark stays a character of it."""
    declared = root.getroottree().docinfo.encoding or "utf-8"
    if data.startswith(codecs.BOM_UTF16_LE):
        return "utf-16-le"
    if data.startswith(codecs.BOM_UTF16_BE):
        return "utf-16-be"
    return declared
