"""Subtract name expressions from an expression; the result is a union of expressions.

For access control that only allows, such as that of Zenoh.  The result is exact on ROS names, whose
characters are few: "/*" without "/ab" is every name that begins with another letter than a, "/a",
the names "/a" with another letter than b after it, and the names that go on after "/ab".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import prod
from string import ascii_letters, digits
from typing import NamedTuple

from sros_tool.policy.patterns import covers, overlap

IN_PART = "#"
"""In a result: any characters except "/"; ``*`` stands for any characters, as in policies."""

_LETTERS = "_" + digits + ascii_letters
_PIECE = re.compile(r"\[(!?)([^\]]+)\]|(\?)|([^?\[]+)")
_RANGE = re.compile(r"(.)-(.)|(.)", re.DOTALL)
_STARS = re.compile(r"\*\*+")
_MOST_CHARACTERS = 1_000_000
"""Maximum number of characters that a search compares: about one second."""


class CannotSubtract(Exception):  # noqa: N818 - the caller makes an error of it
    """The difference is no union of expressions, or of too many; ``denied`` is why, if not ""."""

    def __init__(self, denied: str = "") -> None:
        """Record the expression that cannot be subtracted."""
        super().__init__(denied)
        self.denied = denied


def listed(expression: str, most: int) -> list[str]:
    """Return expressions whose only wildcard is ``*`` and that match the same ROS names.

    A ``?`` is any character of ROS names.

    Raises:
        CannotSubtract: there are more than ``most``.
    """
    if "?" not in expression and "[" not in expression:
        return [_STARS.sub("*", expression)]
    pieces = [_choices(*match.groups()) for match in _PIECE.finditer(expression)]
    if prod(map(len, pieces)) > most:
        raise CannotSubtract
    names = ("".join(choice) for choice in product(*pieces))
    # "/" next to another one or at the end is in no name.
    found = (_STARS.sub("*", name) for name in names if "//" not in name and name[-1:] != "/")
    return list(dict.fromkeys(found))


def _choices(negated: str, members: str, one: str, text: str) -> Sequence[str]:
    if text:
        return [text]
    if one:
        return _LETTERS + "/"
    chosen: set[str] = set()
    for low, high, single in _RANGE.findall(members):
        chosen.update([single] if single else map(chr, range(ord(low), ord(high) + 1)))
    return [letter for letter in _LETTERS + "/" if (letter in chosen) is not bool(negated)]


@dataclass
class SubtractionEffort:
    """A budget of characters to compare, shared by subtractions of one task."""

    left: int = _MOST_CHARACTERS


def subtract(
    wide: str, denied: Iterable[str], most: int, effort: SubtractionEffort | None = None
) -> list[str]:
    """Return expressions for the names that match ``wide`` and none of ``denied``.

    All are absolute, with ``*`` as the only wildcard; the results may also have `IN_PART`.

    Raises:
        CannotSubtract: there are more than ``most``, or a denied expression has text between two
            stars where ``wide`` has a star, too.
    """
    without = tuple(dict.fromkeys(denied))
    search = _Difference(most, effort or SubtractionEffort())
    begins = [wide.removeprefix("*"), f"/{wide}"] if wide.startswith("*") else [wide]
    try:
        search.run(
            [_Place("", begin, without, _LETTERS) for begin in begins if begin.startswith("/")]
        )
    except CannotSubtract as error:
        if error.denied:  # what is left of it after some letters
            error.denied = next(expression for expression in without if error.denied in expression)
        raise
    return list(search.found)


class _Place(NamedTuple):
    """The names that begin with ``read``, and go on as ``wide`` and none of ``denied`` matches.

    ``letters`` are those that the rest of this part of a name may have: names with others have been
    found already.
    """

    read: str
    wide: str
    denied: tuple[str, ...]
    letters: str


@dataclass
class _Difference:
    """The search: it reads names from their start until no denied expression can match any more.

    Where all that is denied begins with a star, a second search reads backwards from their end.
    """

    most: int
    effort: SubtractionEffort
    backwards: bool = False
    found: dict[str, None] = field(default_factory=dict)

    def run(self, places: list[_Place]) -> None:
        """Run the search from the empty name to the end."""
        seen = set()
        while places:
            place = places.pop()
            if place[:2] not in seen:
                seen.add(place[:2])
                places += self._following(place)

    def _following(self, place: _Place) -> Iterable[_Place]:
        """Keep the names of a place if one expression matches all of them; else split the place."""
        read, wide, denied, _ = place
        self.effort.left -= sum(map(len, denied)) + len(denied) * len(wide) + len(read)
        if self.effort.left < 0:
            raise CannotSubtract
        denied = tuple(expression for expression in denied if overlap(expression, wide))
        if not denied:
            self._keep(read + wide)
            return ()
        if any(covers(expression, wide) for expression in denied):
            return ()
        if not wide.startswith("*"):
            return (_Place(read + wide[0], wide[1:], _after(wide[0], denied), _LETTERS),)
        starred = [expression for expression in denied if expression.startswith("*")]
        if starred and all(expression in starred or "*" not in expression for expression in denied):
            self._keep_backwards(read, wide, denied)
            return ()
        return self._by_next_letter(place._replace(denied=denied))

    def _by_next_letter(self, place: _Place) -> Iterator[_Place]:
        """Split the names of a place by their next letter; ``wide`` begins with a star."""
        read, wide, denied, letters = place
        rest = wide[1:]
        parts = [expression.partition("/")[0] for expression in denied]
        if rest[:1] in ("", "/") and not any("*" in part for part in parts):
            # A part with a letter that no denied part has is allowed, whatever its other letters.
            needed = {letter for part in parts for letter in part}
            for letter in letters:
                if letter not in needed:
                    self._keep(f"{read}{IN_PART}{letter}{wide}")
            letters = "".join(each for each in letters if each in needed)
        yield _Place(read, rest, denied, letters)
        begins = not self.backwards and read.endswith("/")
        for letter in letters:
            if not (begins and letter in digits):
                yield _Place(read + letter, wide, _after(letter, denied), letters)
        if read and not read.endswith("/"):
            yield _Place(f"{read}/", wide, _after("/", denied), _LETTERS)

    def _keep_backwards(self, read: str, wide: str, denied: tuple[str, ...]) -> None:
        if self.backwards:
            raise CannotSubtract(
                next(expression for expression in denied if expression.startswith("*"))[::-1]
            )
        ends = _Difference(self.most, self.effort, backwards=True)
        ends.run(
            [_Place("", wide[::-1], tuple(expression[::-1] for expression in denied), _LETTERS)]
        )
        for expression in ends.found:
            self._keep(read + expression[::-1])

    def _keep(self, expression: str) -> None:
        """Keep an expression, unless it has an empty name part and so matches no name."""
        if self.backwards or not ("//" in expression or expression.endswith("/")):
            self.found[expression] = None
        if len(self.found) > self.most:
            raise CannotSubtract


def _after(letter: str, expressions: Iterable[str]) -> tuple[str, ...]:
    """Return the rests of the expressions after one letter was read."""
    found = []
    for expression in expressions:
        if expression.startswith("*"):
            found.append(expression)
            if expression[1:2] == letter:
                found.append(expression[2:])
        elif expression.startswith(letter):
            found.append(expression[1:])
    return tuple(dict.fromkeys(found))
