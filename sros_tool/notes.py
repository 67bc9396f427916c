"""Remarks about a result that is usable as it is: what its owner should still know."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Note:
    """A remark with a stable ``id`` (such as ``portable.document-size``) and one paragraph."""

    id: str
    text: str
