"""The names that OpenSSL has for objects, such as the attributes of a subject.

``object_names.txt`` has all of OpenSSL 3.0, which the measured vendors of DDS use.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path


@cache
def short_names() -> Mapping[str, str]:
    """Return OpenSSL's short names by OID; it prints any other attribute in hexadecimal."""
    data = Path(__file__).with_suffix(".txt").read_text(encoding="ascii")
    return dict(line.split(" ") for line in data.splitlines())
