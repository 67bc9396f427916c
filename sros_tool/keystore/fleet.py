"""The fleet that a keystore records: its robots, and which enclave is whose."""

from __future__ import annotations

from pathlib import Path

from sros_tool.fleet.document import MAX_BYTES, parse_fleet
from sros_tool.fleet.enclaves import enclaves_of
from sros_tool.fleet.model import Fleet, Robot
from sros_tool.keystore.layout import FLEET, has_enclave
from sros_tool.xml import read_bytes


def load_fleet(root: Path) -> Fleet | None:
    """Return the fleet of a keystore, or None: nobody named one.

    Raises:
        DocumentError: the file cannot be read, or is not a fleet.
    """
    path = root / FLEET
    if not path.exists():
        return None
    return parse_fleet(read_bytes(path, "fleet file", most=MAX_BYTES), f"the fleet file '{path}'")


def enclaves_of_robot(root: Path, fleet: Fleet, robot: Robot) -> tuple[str, ...]:
    """Return the enclaves of a robot that the keystore has, sorted."""
    return tuple(name for name in enclaves_of(fleet, robot) if has_enclave(root, name))
