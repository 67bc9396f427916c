"""Reads TOML that may be hostile: everything that is wrong with it is one kind of error."""

from __future__ import annotations

import tomllib
from typing import Any

LONGEST_LINE = 4000
"""In characters: the parser takes quadratic time for a key of many dots."""
LARGEST = 256 * 1024
"""Of a document, in characters."""


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML document; raises `tomllib.TOMLDecodeError`, and nothing else."""
    if len(text) > LARGEST:
        raise tomllib.TOMLDecodeError(f"it is longer than {LARGEST // 1024} KiB")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > LONGEST_LINE:
            raise tomllib.TOMLDecodeError(f"line {number} is longer than {LONGEST_LINE} characters")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError as error:
        raise tomllib.TOMLDecodeError("it is nested too deeply") from error
    except ValueError as error:  # a number of thousands of digits, a date that does not exist
        raise tomllib.TOMLDecodeError(str(error)) from error
