"""Parts of the pages that are made from the program: the page itself, tables and their cells."""

from __future__ import annotations

import re
from collections.abc import Iterable

MADE = "<!-- made by `python -m tools.reference_pages`; do not edit -->"


def page_text(title: str, *parts: str) -> str:
    """Return a page as Markdown."""
    return "\n\n".join([f"# {title}", MADE, *parts]) + "\n"


def cell(text: str) -> str:
    """Return a text of the program as Markdown on one line, also for a cell of a table."""
    parts = " ".join(text.split()).replace("|", "\\|").split("`")
    parts[::2] = [re.sub(r"[<*\[]", r"\\\g<0>", part) for part in parts[::2]]
    return "`".join(parts)


def table_text(*heads: str, rows: Iterable[tuple[str, ...]]) -> str:
    """Return a table as Markdown."""
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
