"""What the user of `sros close` can accept although sros could not check it."""

from __future__ import annotations

from collections.abc import Set
from enum import StrEnum


class Acceptance(StrEnum):
    """A word of ``--accept``; ``--partial`` stands for all of them."""

    NODES = "nodes"
    UNEXAMINED = "unexamined"
    UNOBSERVED = "unobserved"
    REQUIREMENTS = "requirements"
    CONNECTIONS = "connections"


Acceptances = Set[Acceptance]
