"""XML as TinyXML-2 9 reads it, the parser of Fast DDS: it forgives much that XML forbids.

It knows bytes, not encodings, and neither namespaces nor entities of a document: ``--`` in a
comment, a lone ``&``, control characters, ``]]>`` in a text and a second root are all taken.
"""

from __future__ import annotations

import re

from sros_tool.dds.decision.elements import Element, Mark, UnreadableError

_BLANKS = " \t\n\v\f\r"
_MARK = "\xef\xbb\xbf"
_DEEPEST = 99  # elements within each other
_NAME = "[A-Za-z_:\x80-\xff][A-Za-z0-9_:.\x80-\xff-]*+"
_VALUE = "(?:\"[^\"]*\"|'[^']*')"
_ATTRIBUTE = f"({_NAME})[{_BLANKS}]*=[{_BLANKS}]*({_VALUE})"
_TAG = re.compile(f"<[{_BLANKS}]*(/?)({_NAME})((?:[{_BLANKS}]*{_ATTRIBUTE})*+)[{_BLANKS}]*(/?)>")
_ATTRIBUTES = re.compile(_ATTRIBUTE)
_TEXT = re.compile(f"[{_BLANKS}]*([^<]*)<")
_LINE_END = re.compile("\r\n?|\n\r?")
_SPECIAL = (("<?", "?>"), ("<!--", "-->"), ("<![CDATA[", "]]>"), ("<!", ">"))
_ENTITIES = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}
_REFERENCE = re.compile("&(?:#x?([^;]*)|(quot|amp|apos|lt|gt));")


def read(xml: bytes) -> Element:
    """The first element of a document; raises `UnreadableError` where TinyXML-2 refuses it.

    A text is decoded as UTF-8, each byte that is none as a surrogate.
    """
    return _Reader(xml).root()


class _Reader:
    def __init__(self, xml: bytes) -> None:
        # Signed documents have these line ends; each character stands for a byte.
        canonical = xml.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n").decode("latin-1")
        self._text = canonical.partition("\0")[0].lstrip(_BLANKS).removeprefix(_MARK)
        self._index = 0

    def root(self) -> Element:
        document = Element("")
        if not self._text:
            raise self._error("it is empty")
        self._read_into(document)
        if not document.elements:
            raise self._error("it has no element")
        return document.elements[0]

    def _error(self, why: str) -> UnreadableError:
        line = self._text.count("\r\n", 0, self._index) + 1
        return UnreadableError(f"its XML cannot be read, {why} (line {line})")

    def _read_into(self, document: Element) -> None:
        text = self._text
        stack = [document]
        while found := _TEXT.match(text, self._index):
            children = stack[-1].children
            if found[1]:
                self._need_more(found.end())
                children.append(_plain(found[0][:-1]))
            self._index = found.end() - 1
            if text[found.end() : found.end() + 1] in ("?", "!"):
                self._take_special(stack)
                continue
            tag = _TAG.match(text, self._index)
            if not tag:
                raise self._error("a tag is malformed")
            self._index = tag.end()
            closing, name, closed = tag[1], tag[2], tag[6]
            if closing and not closed:
                if len(stack) == 1:
                    return  # what stands behind it goes unread
                if stack.pop().name != _decoded(name):
                    raise self._error(f"</{name}> closes another element")
                continue
            element = Element(_decoded(name), self._attributes(tag[3]) if tag[3] else {})
            children.append(element)
            if not closed:
                stack.append(element)
                if len(stack) > _DEEPEST:
                    raise self._error("its elements are nested too deeply")
        if len(stack) > 1:
            raise self._error(f"<{stack[-1].name}> is not closed")
        if text[self._index :].strip(_BLANKS):
            raise self._error("it ends with text")

    def _need_more(self, index: int) -> None:
        if index >= len(self._text):
            raise self._error("it ends with <")

    def _take_special(self, stack: list[Element]) -> None:
        """A declaration, comment, CDATA or anything else that begins with ``<?`` or ``<!``."""
        text, children = self._text, stack[-1].children
        begin, end = next(each for each in _SPECIAL if text.startswith(each[0], self._index))
        start = self._index + len(begin)
        stop = text.find(end, start)
        if stop < 0:
            raise self._error(f"{begin} is not closed")
        self._index = stop + len(end)
        if begin == "<?":
            if len(stack) > 1 or any(each is not Mark.DECLARATION for each in children):
                raise self._error("a processing instruction stands behind the prolog")
            children.append(Mark.DECLARATION)
        elif begin == "<![CDATA[":
            children.append(_decoded(_LINE_END.sub("\n", text[start:stop])))
        else:
            children.append(Mark.COMMENT if begin == "<!--" else Mark.OTHER)

    def _attributes(self, text: str) -> dict[str, str]:
        found = {}
        for name, value in _ATTRIBUTES.findall(text):
            if name in found:
                raise self._error(f"the attribute {name} stands there twice")
            found[name] = _plain(value[1:-1])
        return {_decoded(name): value for name, value in found.items()}


def _decoded(text: str) -> str:
    return text if text.isascii() else text.encode("latin-1").decode("utf-8", "surrogateescape")


def _plain(text: str) -> str:
    """The text with its line ends and references resolved, up to a NUL."""
    if "&" not in text:
        return _decoded(_LINE_END.sub("\n", text) if "\r" in text or "\n" in text else text)
    # It writes into the text that it reads: of a lone "&" nothing is written, so that the
    # character stays that stood there before.
    written = list(text)
    place = index = 0
    while index < len(text):
        taken, into = text[index], text[index]
        if taken in "\r\n":
            taken, into = _LINE_END.match(text, index)[0], "\n"  # type: ignore[index]
        elif taken == "&":
            found = _REFERENCE.match(text, index)
            character = _referred(found) if found else None
            if found and character is not None:
                taken, into = found[0], character
            elif text[index + 1 :] == "#":
                into = ""
            elif text[index + 1 : index + 2] != "#":
                into = written[place]
        written[place : place + len(into)] = into
        place += len(into)
        index += len(taken)
    return _decoded("".join(written[:place]).partition("\0")[0])


def _referred(found: re.Match[str]) -> str | None:
    """The bytes of a reference; None where it is malformed."""
    if found[2]:
        return _ENTITIES[found[2]]
    # It reads the digits from the last one on, back to the mark before them.
    base, mark = (16, "x") if found[0][2] == "x" else (10, "#")
    digits = found[1].rpartition(mark)[2]
    if not re.fullmatch("[0-9a-fA-F]*" if base == 16 else "[0-9]*", digits):
        return None
    return _utf8(int(digits or "0", base))


def _utf8(number: int) -> str:
    if number < 0x80:
        return chr(number)
    for length, limit, head in ((2, 0x800, 0xC0), (3, 0x10000, 0xE0), (4, 0x200000, 0xF0)):
        if number < limit:
            rest = [0x80 | number >> 6 * place & 0x3F for place in range(length - 1)]
            return "".join(map(chr, [head | number >> 6 * (length - 1), *reversed(rest)]))
    return ""
