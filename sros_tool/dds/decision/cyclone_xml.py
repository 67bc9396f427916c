"""XML as Cyclone DDS 0.10 reads it (ddsrt/src/xmlparser.c).

Names are of ASCII letters, digits, ``_ - :``; comments, processing instructions and ``<!...>`` are
passed over between any two tokens; an element holds either elements or one text.
"""

from __future__ import annotations

import re

from sros_tool.dds.decision.elements import Element, UnreadableError

BLANKS = " \t\v\r\n"
_CDATA = "<![CDATA["
_ROOM = len(_CDATA) - 2  # it looks for more text only where so many characters are left
_DEEPEST = 200  # of elements within each other; any such document is refused for its names
_NAME = re.compile("[A-Za-z][A-Za-z0-9_:-]*")
_PASSED_OVER = re.compile(
    rf"(?:[{BLANKS}]++|<!--.*?-->|<\?(?:.*?\?>|.*)|<!(?!--|\[CDATA\[)(?:[^>]*>|.*))*+", re.DOTALL
)
_QUOTES = {'"': '"', "'": "'", "\xe2\x80\x9c": "\xe2\x80\x9d", "\xe2\x80\x98": "\xe2\x80\x99"}
_REFERENCE = re.compile("&(.{0,15}?;)?", re.DOTALL)
_NUMBER = re.compile(rf"#(?:x[{BLANKS}\f]*([+-]?(?:0[xX])?[0-9a-fA-F]+)|[{BLANKS}\f]*([+-]?\d+))")
_ENTITIES = {"lt": "<", "gt": ">", "amp": "&", "apos": "'", "quot": '"'}


def read(xml: bytes) -> Element:
    """The root of a document; raises `UnreadableError` where Cyclone DDS refuses it.

    A text is without the blanks around it, and decoded as UTF-8, each byte that is none as a
    surrogate.
    """
    return _Reader(xml).root()


class _Reader:
    def __init__(self, xml: bytes) -> None:
        self._text = xml.decode("latin-1").partition("\0")[0]  # each character stands for a byte
        self._index = 0

    def root(self) -> Element:
        root = self._element(0)
        self._pass_over()
        if self._index < len(self._text):
            raise self._error("something stands behind its root")
        return root

    def _error(self, why: str) -> UnreadableError:
        line = self._text.count("\n", 0, self._index) + 1
        return UnreadableError(f"its XML cannot be read, {why} (line {line})")

    def _pass_over(self) -> None:
        found = _PASSED_OVER.match(self._text, self._index)
        self._index = found.end() if found else self._index
        if self._text.startswith("<!--", self._index):
            raise self._error("a comment is not closed")

    def _take(self, mark: str) -> bool:
        there = self._text.startswith(mark, self._index)
        self._index += len(mark) if there else 0
        return there

    def _name(self) -> str:
        found = _NAME.match(self._text, self._index)
        if not found:
            raise self._error("a name is malformed")
        self._index = found.end()
        return found[0]

    def _string(self) -> str:
        for begin, end in _QUOTES.items():
            if self._take(begin):
                stop = self._text.find(end, self._index)
                if stop < 0:
                    raise self._error("a quoted text does not end")
                text = self._text[self._index : stop]
                self._index = stop + len(end)
                return self._unescaped(text)
        raise self._error("an attribute has no value")

    def _element(self, depth: int) -> Element:
        self._pass_over()
        if self._text.startswith(_CDATA, self._index) or not self._take("<") or depth > _DEEPEST:
            raise self._error("an element was expected")
        element = Element(self._name())
        self._pass_over()
        while _NAME.match(self._text, self._index):
            name = self._name()
            self._pass_over()
            if not self._take("="):
                raise self._error(f"the attribute {name} has no value")
            self._pass_over()
            element.attributes[name] = _decoded(self._string())
            self._pass_over()
        if self._take("/>"):
            return element
        if not self._take(">"):
            raise self._error(f"<{element.name}> does not end")
        self._content(element, depth)
        self._pass_over()
        closed = self._take("/>") or (self._take("</") and self._name() == element.name)
        if not closed or not self._take(">"):
            raise self._error(f"<{element.name}> is not closed")
        return element

    def _content(self, element: Element, depth: int) -> None:
        start = self._index
        if not self._opens():
            self._index = start
            if text := self._content_text():
                element.children.append(text)
            return
        while self._opens():
            element.children.append(self._element(depth + 1))

    def _opens(self) -> bool:
        """Whether the next token begins an element; raises where it is none at all."""
        self._pass_over()
        text, index = self._text, self._index
        if text[index : index + 1] == "<" and not text.startswith(_CDATA, index):
            closes = text[index + 1 : index + 2] == "/"
            if not _NAME.match(text, index + 1 + closes):
                raise self._error("a name is malformed")
            return not closes
        if text.startswith(tuple(_QUOTES), index):  # it reads on to the other quote
            self._string()
            self._index = index
        return False

    def _content_text(self) -> str:
        text, done, pending = self._text, "", ""
        while True:
            stop = text.find("<", self._index)
            stop = len(text) if stop < 0 else stop
            pending += text[self._index : stop]
            self._index = stop
            if self._take(_CDATA):
                stop = text.find("]]>", self._index)
                if stop < 0:
                    raise self._error("a CDATA is not closed")
                if stop > self._index:
                    done += self._unescaped(pending) + text[self._index : stop]
                    pending = ""
                self._index = stop + len("]]>")
            if text[self._index : self._index + 1] == "<":
                if not text.startswith("<!--", self._index):
                    break
                stop = text.find("-->", self._index + len("<!--"))
                if stop < 0:
                    raise self._error("a comment is not closed")
                self._index = stop + len("-->")
            if len(text) - self._index < _ROOM:
                break
        content = (done + self._unescaped(pending)).strip(BLANKS)
        return _decoded(content.partition("\0")[0])

    def _unescaped(self, text: str) -> str:
        return _REFERENCE.sub(self._referred, text) if "&" in text else text

    def _referred(self, found: re.Match[str]) -> str:
        word = (found[1] or "").removesuffix(";")
        if word in _ENTITIES:
            return _ENTITIES[word]
        number = _NUMBER.fullmatch(word)
        if number:
            code = (int(number[1], 16) if number[1] else int(number[2])) % 2**32
            if code <= 0x10FFFF:
                return chr(code).encode("utf-8", "surrogatepass").decode("latin-1")
        raise self._error(f"&{word} is no reference to a character")


def _decoded(text: str) -> str:
    return text if text.isascii() else text.encode("latin-1").decode("utf-8", "surrogateescape")
