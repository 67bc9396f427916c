"""What reads a keystore imports nothing that writes one, directly or indirectly."""

from __future__ import annotations

import pytest

from tests.support.children import python
from tests.support.long_form import some

READERS = (
    "sros_tool.keystore.layout",
    "sros_tool.keystore.reader",
    "sros_tool.keystore.loading",
    "sros_tool.keystore.describe",
    "sros_tool.keystore.expiry",
    "sros_tool.keystore.selection",
    "sros_tool.keystore.ledger",
    "sros_tool.keystore.rights",
    "sros_tool.keystore.zenoh_files",
)
WRITERS = ("transaction", "issuing", "lifecycle", "delivery")

_LIST = "import sys, {0}; print(*(name for name in sys.modules if name.startswith('sros_tool')))"


def loaded_by(module: str) -> list[str]:
    """The modules of sros that a fresh process has after it imported one."""
    return python("-c", _LIST.format(module)).stdout.split()


@pytest.mark.parametrize("module", some(READERS, 2))
def test_reading_imports_nothing_that_writes(module: str) -> None:
    rooms = tuple(f"sros_tool.keystore.{room}" for room in WRITERS)
    assert not [name for name in loaded_by(module) if name.startswith(rooms)]


def test_what_writes_is_seen_by_this_search() -> None:
    assert "sros_tool.keystore.transaction" in loaded_by("sros_tool.keystore.lifecycle.renew")
