"""Reading JSON5, the language of Zenoh's configurations, with the line of each member.

Size and depth are limited, and the time is linear in the size: no recursion, no backtracking.  As
in Zenoh, an object with a repeated member is refused, because readers choose different values.
Source: spec.json5.org 1.0; compared with the texts that the wheel 1.10.2 accepts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, NamedTuple

MOST_BYTES = 16 * 1024 * 1024
_MAX_DEPTH = 100
_MOST_DIGITS = 400
_MOST_TOKENS = 2_000_000
"""Maximum number of tokens in a text; more tokens would take many seconds.

The configuration of a router for a thousand enclaves has less than half as many tokens.
"""
_MOST_WITHOUT_LINES = 200_000
"""Maximum number of tokens in JSON5 that is not plain JSON, if lines are not needed.

The default Zenoh configuration has a fiftieth of this number.
"""


class Json5Error(ValueError):
    """Raised for text that is not JSON5; ``line`` counts from 1."""

    def __init__(self, problem: str, line: int) -> None:
        super().__init__(problem)
        self.problem = problem
        self.line = line


class Json5Object(dict[str, Any]):
    """An object with its first line and the line of each member."""

    def __init__(self, line: int) -> None:
        super().__init__()
        self.line = line
        self.lines: dict[str, int] = {}


_TOKEN = re.compile(
    r"""
      (?P<space>(?:[\s\ufeff]+|//[^\n\r\u2028\u2029]*|/\*.*?\*/)+)
    | (?P<mark>[{}\[\]:,])
    | (?P<text>"(?:[^"\\\n\r\u2028\u2029]|\\(?:\r\n|.))*"
                |'(?:[^'\\\n\r\u2028\u2029]|\\(?:\r\n|.))*')
    | (?P<number>[+-]?(?:Infinity|NaN|0[xX][0-9a-fA-F]+
                       |(?:(?:0|[1-9][0-9]*)(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)
                 (?![\w$.]))
    | (?P<word>(?:[^\W\d]|\$|\\u[0-9a-fA-F]{4})(?:[\w$\u200c\u200d]|\\u[0-9a-fA-F]{4})*)
    """,
    re.VERBOSE | re.DOTALL,
)
_NOT_IN_JSON5 = re.compile(r"\\u|[\u2028\u2029]")
"""Matches string contents that JSON allows and JSON5 does not: Unicode escapes, U+2028, U+2029."""
_LINE = re.compile(r"\r\n|[\n\r\u2028\u2029]")
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|x([0-9a-fA-F]{2})|(\r\n|.))", re.DOTALL)
_ESCAPED = {"b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t", "v": "\v", "0": "\0"}
_CONTINUED = ("\r\n", "\n", "\r", "\u2028", "\u2029")
_WORDS = {"true": True, "false": False, "null": None}


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


def parse_json5(text: str, *, lines: bool = True) -> Any:
    """Return the value of a JSON5 text; all objects are `Json5Object` values.

    Without ``lines``, every line number is 1; plain JSON is then read about twenty times as fast,
    and other JSON5 has to be small.

    Raises:
        Json5Error: the text is not JSON5, is too large, has more than 100 levels, or an object has
            a repeated member.
    """
    if not lines and not _NOT_IN_JSON5.search(text):
        with suppress(Json5Error):  # the JSON5 reader below reports the error
            return parse_json(text)
    return _Reader(text, _MOST_TOKENS if lines else _MOST_WITHOUT_LINES).document()


def parse_json(text: str) -> Any:
    """Return the value of a JSON text; all objects are `Json5Object` values with line 1.

    Raises:
        Json5Error: the text is not JSON, or has more than 100 levels.
    """
    try:
        value = json.loads(text, object_pairs_hook=_without_lines)
    except (ValueError, RecursionError):
        raise Json5Error("it is not JSON", 1) from None
    if _is_deep(value):
        raise Json5Error(f"objects and lists are nested more than {_MAX_DEPTH} levels deep", 1)
    return value


def _without_lines(members: list[tuple[str, Any]]) -> Json5Object:
    plain_object = Json5Object(1)
    plain_object.update(members)
    if len(plain_object) != len(members):
        raise ValueError("a member is named twice")
    return plain_object


def _is_deep(value: Any) -> bool:
    level = [value]
    for _ in range(_MAX_DEPTH):
        if not level:
            return False
        inner = [value.values() if isinstance(value, dict) else value for value in level
                 if isinstance(value, dict | list)]  # fmt: skip
        level = [value for of in inner for value in of]
    return any(isinstance(value, dict | list) for value in level)


def _tokens(text: str, maximum: int) -> Iterator[_Token]:
    at, line, count = 0, 1, 0
    while at < len(text):
        count += 1
        if count > 2 * maximum:  # up to half of the tokens may be space
            raise Json5Error(f"the text has more than {maximum} tokens", line)
        match = _TOKEN.match(text, at)
        if match is None:
            raise Json5Error(f"unexpected {text[at : at + 10]!r}", line)
        kind, token = match.lastgroup or "", match.group()
        if kind != "space":
            yield _Token(kind, token, line)
        if kind in ("space", "text"):
            line += sum(1 for _ in _LINE.finditer(token))
        at = match.end()
    while True:
        yield _Token("end", "", line)


class _Reader:
    """A reader of JSON5 values; ``_now`` is the current token."""

    def __init__(self, text: str, maximum: int) -> None:
        self._tokens = _tokens(text, maximum)
        self._now = next(self._tokens)

    def document(self) -> Any:
        value = self._value(_MAX_DEPTH)
        if self._now.kind != "end":
            raise self._unexpected_error()
        return value

    def _take(self) -> _Token:
        taken, self._now = self._now, next(self._tokens)
        return taken

    def _value(self, depth: int) -> Any:
        if not depth:
            raise Json5Error(
                f"objects and lists are nested more than {_MAX_DEPTH} levels deep", self._now.line
            )
        token = self._take()
        if token.text == "{":
            return self._object(token.line, depth)
        if token.text == "[":
            return self._list(depth)
        if token.kind == "text":
            return _unescaped(token.text[1:-1], token.line)
        if token.kind == "number":
            return _number_of(token)
        if token.kind == "word" and token.text in _WORDS:
            return _WORDS[token.text]
        self._now = token
        raise self._unexpected_error()

    def _object(self, line: int, depth: int) -> Json5Object:
        value = Json5Object(line)
        while self._now.text != "}":
            token = self._take()
            name = _name_of(token)
            if name in value:
                raise Json5Error(f"{name!r} is named twice", token.line)
            if self._take_mark(":") is None:
                raise self._unexpected_error()
            value[name] = self._value(depth - 1)
            value.lines[name] = token.line
            if self._take_mark(",") is None:
                break
        if self._take_mark("}") is None:
            raise self._unexpected_error()
        return value

    def _list(self, depth: int) -> list[Any]:
        value = []
        while self._now.text != "]":
            value.append(self._value(depth - 1))
            if self._take_mark(",") is None:
                break
        if self._take_mark("]") is None:
            raise self._unexpected_error()
        return value

    def _take_mark(self, mark: str) -> _Token | None:
        return self._take() if self._now.text == mark else None

    def _unexpected_error(self) -> Json5Error:
        return _unexpected_error(self._now)


def _unexpected_error(token: _Token) -> Json5Error:
    problem = f"unexpected {token.text[:40]!r}" if token.kind != "end" else "it ends too early"
    return Json5Error(problem, token.line)


def _name_of(token: _Token) -> str:
    if token.kind == "text":
        return _unescaped(token.text[1:-1], token.line)
    if token.kind == "word":
        return _unescaped(token.text, token.line)
    raise _unexpected_error(token)


def _unescaped(text: str, line: int) -> str:
    def character(match: re.Match[str]) -> str:
        if code := match[1] or match[2]:
            return chr(int(code, 16))
        return "" if match[3] in _CONTINUED else _ESCAPED.get(match[3], match[3])

    if "\\" not in text:
        return text
    text = _ESCAPE.sub(character, text)
    try:  # two escapes can be the two surrogates of one character
        return text.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        raise Json5Error("a text has half a character (a lone surrogate)", line) from None


def _number_of(token: _Token) -> float:
    text = token.text.lstrip("+-")
    sign = -1 if token.text.startswith("-") else 1
    if len(text) <= _MOST_DIGITS:
        if text[:2] in ("0x", "0X"):
            return sign * int(text, 16)
        if text.isdigit():
            return sign * int(text)
    elif text.isalnum():
        return sign * float("inf")
    return sign * float(text.replace("Infinity", "inf").replace("NaN", "nan"))
