"""Printing to the terminal, with control characters from untrusted text made visible.

Names of files, certificates and tokens, lines of logs and policies may come from an attacker.
Their control characters could clear the screen, hide a denial, reverse a name, or forge a line.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

_CONTROL_CODES = [
    *(code for code in range(0x20) if chr(code) not in "\n\t"),
    *range(0x7F, 0xA0),  # DEL, and C1, which holds CSI as one character
    *(0x061C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)),  # bidirectional
    *(0x2028, 0x2029),  # ends of lines
]
_UNDECODED_BYTES = range(
    0xDC80, 0xDD00
)  # bytes of names that are not UTF-8; 0x9B is CSI to some terminals
_COLORS = {
    "error": "red",
    "warning": "yellow",
    "note": "cyan",
    "yes": "green",
    "no": "red",
    "NOT LOADABLE": "red",
}


class Colored(NamedTuple):
    """A word printed in color on a terminal, unless $NO_COLOR is set (https://no-color.org)."""

    word: str


def visible(text: str) -> str:
    """Return ``text`` with control characters as visible escapes, so that none controls a terminal.

    Newline and tab stay.
    """
    # A text that Python calls printable has none of these characters, and most texts are.
    return text if text.isprintable() else text.translate(_escapes())


def visible_line(text: str) -> str:
    """Return ``text`` as `visible` does, on one line: a line feed could forge the next one."""
    return visible(text).replace("\n", "\\x0a")


def log_step(level: str, module: str, text: str, *args: object) -> None:
    """Log a step if `logging` is loaded: by ``-v``, or by a program that uses sros.

    Importing `logging` only to drop the message would slow down every start.
    """
    if logging := sys.modules.get("logging"):
        logging.getLogger(module).log(getattr(logging, level), text, *args)


@cache
def _escapes() -> dict[int, str]:
    escapes = {
        code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" for code in _CONTROL_CODES
    }
    escapes |= {code: f"\\u{code:04x}" for code in (*range(0xD800, 0xE000), 0xFFFE, 0xFFFF)}
    return escapes | {code: f"\\x{code - 0xDC00:02x}" for code in _UNDECODED_BYTES}


@cache
def _json_escapes() -> dict[int, str]:
    return {code: f"\\u{code:04x}" for code in (*_CONTROL_CODES, *range(0xD800, 0xE000))}


def visible_json(document: str) -> str:
    """Replace the control characters in a JSON document with JSON escapes of the same value."""
    return document.translate(_json_escapes())


def echo(*parts: str | Colored, err: bool = False) -> None:
    """Print one line, on standard error with ``err``."""
    _print_parts(parts, visible_line, err=err)


def echo_lines(*parts: str | Colored, err: bool = False) -> None:
    """Print several lines, in which only sros added line feeds, on standard error with ``err``."""
    _print_parts(parts, visible, err=err)


def echo_document(document: str | bytes) -> None:
    """Print a document for another program: unchanged; on a terminal, with `visible` escapes."""
    import click

    if sys.stdout is not None and sys.stdout.isatty():
        text = document if isinstance(document, str) else os.fsdecode(document)
        document = visible(text)
    click.echo(document, nl=False, color=True)  # otherwise click removes colors, as in a path


def echo_bytes(data: bytes) -> None:
    """Write binary data to standard output, after flushing text printed before."""
    sys.stdout.flush()
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()


def redraw(text: str) -> None:
    """Replace the current line of the terminal on standard error; "" erases it.

    The text does not go through the buffer of the stream, which may be in use when a signal comes.
    """
    os.write(sys.stderr.fileno(), f"\r\x1b[K{visible_line(text)}".encode())


def ask_secret(secret: str, *, confirm: bool) -> str:
    """Ask on the terminal for a secret that is not shown, twice with ``confirm``."""
    import click

    asked = visible_line(f"{secret[:1].upper()}{secret[1:]}")  # a keystore may name the token
    answer = click.prompt(asked, hide_input=True, err=True, confirmation_prompt=confirm)
    return str(answer)


def _print_parts(
    parts: tuple[str | Colored, ...], shown: Callable[[str], str], *, err: bool
) -> None:
    import click

    texts = (
        click.style(part.word, fg=_COLORS[part.word], bold=True)
        if isinstance(part, Colored)
        else shown(part)
        for part in parts
    )
    click.echo("".join(texts), err=err)
