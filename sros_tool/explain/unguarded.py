"""Topics that the governance leaves open: everybody in the domain may write or read them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sros_tool.dds.governance import Governance


@dataclass(frozen=True, slots=True)
class Unguarded:
    """DDS topics without access control in one direction (publish or subscribe).

    ``topic`` is an expression; ``without`` are those of earlier rules that guard a part of it.
    """

    direction: str
    topic: str
    without: tuple[str, ...]


def unguarded(governance: Governance) -> Iterator[Unguarded]:
    """What anybody may do in any of the domains; the first topic rule that matches holds.

    DDS-Security 1.1, 9.4.1.2.6 (topic rules, and enable_read/write_access_control).
    """
    for domain in governance.domain_access_rules:
        guarded: dict[str, list[str]] = {"publish": [], "subscribe": []}
        for rule in domain.topic_access_rules:
            for direction, on in (
                ("publish", rule.enable_write_access_control),
                ("subscribe", rule.enable_read_access_control),
            ):
                if on:
                    guarded[direction].append(rule.topic_expression)
                else:
                    yield Unguarded(direction, rule.topic_expression, tuple(guarded[direction]))
