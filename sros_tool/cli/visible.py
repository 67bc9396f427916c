"""Makes text of others safe to show: what would steer a terminal is shown, and not obeyed."""

from __future__ import annotations

_CONTROLS = [
    *(code for code in range(0x20) if chr(code) not in "\n\t"),
    *range(0x7F, 0xA0),  # DEL, and C1, which holds CSI as one character
    *(0x061C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)),  # bidirectional
]
_SHOWN = {code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" for code in _CONTROLS}
_IN_JSON = {code: f"\\u{code:04x}" for code in _CONTROLS}


def visible(text: str) -> str:
    """``text`` with its control characters, but newline and tab, spelled as escapes.

    Names of files, certificates and logs are chosen by others, who could otherwise clear the
    screen, hide a denial, or let a name read backwards.
    """
    return text.translate(_SHOWN)


def visible_json(document: str) -> str:
    """The same for a JSON document, which goes on to mean the same."""
    return document.translate(_IN_JSON)
