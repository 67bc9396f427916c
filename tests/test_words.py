"""Help, messages, docstrings and documents use one word for one thing (CONTRIBUTING.md)."""

from __future__ import annotations

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.checkout import CHECKOUT

TABLE = re.compile(r"^## Words\n(.*?)^## ", re.MULTILINE | re.DOTALL)
ROW = re.compile(r"^\| [^|]+ \| (?P<instead>`[^|]+) \|$", re.MULTILINE)


def unused_words() -> list[str]:
    """The words of the right column of the table in CONTRIBUTING.md."""
    table = TABLE.search((CHECKOUT / "CONTRIBUTING.md").read_text())
    assert table
    columns = [row["instead"] for row in ROW.finditer(table[1])]
    return re.findall(r"`([^`]+)`", " ".join(columns))


_EITHER = "|".join(
    re.escape(word) if word.isupper() else f"(?i:{re.escape(word)})" for word in unused_words()
)
UNUSED = re.compile(rf"(?<![\w./$-])(?:{_EITHER})(?![\w/-]|\.\w)")


def wrong_words(text: str) -> list[str]:
    """The unused words in a text; capitals matter only for those written in capitals."""
    return UNUSED.findall(text)


def texts_of(path: Path) -> Iterator[tuple[int, str]]:
    """Yield what a person reads in a file: a document's lines, a program's strings and comments.

    A program without any unused word is left out: separating its tokens takes most of the time.
    """
    if path.suffix == ".py":
        source = path.read_text()
        if not UNUSED.search(" ".join(source.split())):
            return
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            is_text = token.type in (tokenize.STRING, tokenize.COMMENT)
            if is_text and " " in token.string:
                yield token.start[0], " ".join(token.string.split())
        return
    yield from enumerate(path.read_text().splitlines(), 1)


DOCUMENTS = [
    *(CHECKOUT / name for name in ("README.md", "SECURITY.md")),
    *sorted((CHECKOUT / "docs").rglob("*.md")),
]
PROGRAM = sorted((CHECKOUT / "sros_tool").rglob("*.py"))


@pytest.mark.parametrize("files", [DOCUMENTS, PROGRAM], ids=["documents", "program"])
def test_no_word_is_used_that_is_not_used(files: list[Path]) -> None:
    assert [
        f"{path.relative_to(CHECKOUT)}:{line}: {word!r}"
        for path in files
        for line, text in texts_of(path)
        for word in wrong_words(text)
    ] == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("`sros check ROOT` finds it", ["ROOT"]),
        ("the Root of all", []),
        ("Beside it, in order to show it", ["Beside", "in order to"]),
        ("e.g. this, and an adjustment", ["e.g."]),
        ("next to the keystore", []),
    ],
)
def test_words_are_recognized_whole(text: str, words: list[str]) -> None:
    assert wrong_words(text) == words
