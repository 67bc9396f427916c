"""Ask Cyclone DDS which endpoints an enclave may have."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from sros_tool.runtime.cyclone import Participant, SecurityRefusedError
from tests.support.children import apart

Endpoint = tuple[str, str]
"""A direction (publish or subscribe) and a DDS topic."""


def refusals(enclave: Path, domain: int, endpoints: Iterable[Endpoint]) -> dict[Endpoint, str]:
    """Map the endpoints that Cyclone DDS refuses an enclave to what it says.

    One participant in a process of its own, for Cyclone DDS 0.10 lets a second one of a process
    borrow the rights of the first.
    """
    return apart(partial(_ask, enclave, domain, sorted(set(endpoints))))


def _ask(enclave: Path, domain: int, endpoints: Sequence[Endpoint]) -> dict[Endpoint, str]:
    refused = {}
    with Participant(domain, enclave) as participant:
        for direction, topic in endpoints:
            try:
                (participant.writer if direction == "publish" else participant.reader)(topic)
            except SecurityRefusedError as refusal:
                refused[direction, topic] = str(refusal)
    return refused
