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
    DOMAINS = "domains"


Acceptances = Set[Acceptance]

IN_PREPARATION: Acceptances = frozenset({Acceptance.NODES, Acceptance.REQUIREMENTS})
"""What is asked for before a robot is closed."""

IN_PROOF: Acceptances = frozenset(Acceptance) - {Acceptance.NODES}
"""What is asked for in the proof that a robot is closed."""
