"""Names of others in SVG and HTML."""

from __future__ import annotations

import html

from sros_tool.terminal import visible_line


def escape(text: str) -> str:
    """Return ``text`` as the content of an element or the value of an attribute.

    What no XML document can have, and what could steer a terminal that shows the file or begin a
    line in it, becomes a visible escape.
    """
    return html.escape(visible_line(text))
