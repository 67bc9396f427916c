"""Tells a picture as JSON, for programs; the same picture gives the same bytes."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from sros_tool.report.picture import Edge, Picture


def render_json(picture: Picture) -> str:
    """The whole picture: every enclave, name and edge, by the names of `Picture`'s fields."""
    return json.dumps(as_value(picture), indent=1, ensure_ascii=False) + "\n"


def as_value(picture: Picture) -> dict[str, Any]:
    """The picture as a value of lists, dictionaries and texts."""
    value = asdict(picture)
    value["edges"] = [_edge(edge) for edge in picture.edges]
    return value


def _edge(edge: Edge) -> dict[str, Any]:
    direction = "to the name" if edge.sends else "from the name"
    return {**asdict(edge), "direction": direction}
