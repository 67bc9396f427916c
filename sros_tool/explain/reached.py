"""Whom one enclave of a policy or keystore can influence and learn from, as it is printed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sros_tool.errors import KeystoreError, Note
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.layout import enclave_names
from sros_tool.keystore.reader import Keystore
from sros_tool.keystore.rights import RightsSource
from sros_tool.keystore.selection import likely_names, no_such_enclave
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, HopPath, Network, Reach, unguarded
from sros_tool.values import shows


class ReachedStep(NamedTuple):
    """A step."""

    from_: str
    """The enclave that sends."""
    to: str
    """The enclave that receives."""
    kind: str
    """The kind of the name."""
    right: str
    """The right of the sender."""
    name: str
    """The ROS name."""
    said: str
    """The name or wildcard in the rights of the sender."""
    heard: str
    """The name or wildcard in the rights of the receiver."""


class ReachedEnclave(NamedTuple):
    """An enclave."""

    enclave: str
    """The enclave."""
    path: Sequence[ReachedStep]
    """A shortest way."""


@shows("path", "left_out", "enclave", "influences", "learns_from")
class FollowedReach(NamedTuple):
    """The enclaves that one can influence and learn from."""

    path: Path
    """The keystore or policy."""
    left_out: Sequence[str]
    """Topics that are not counted, and services (as */NAME) whose requests are not: they change
    nothing."""
    reach: Reach
    fleet: Fleet | None
    notes: Sequence[Note]

    @property
    def enclave(self) -> str:
        """The enclave."""
        return self.reach.enclave

    @property
    def influences(self) -> list[ReachedEnclave]:
        """The enclaves that it can influence."""
        return list(_printed(self.reach.influences))

    @property
    def learns_from(self) -> list[ReachedEnclave]:
        """The enclaves that it can learn from."""
        return list(_printed(self.reach.learns_from))


def _printed(paths: Mapping[str, HopPath]) -> Iterator[ReachedEnclave]:
    for enclave, path in sorted(paths.items()):
        yield ReachedEnclave(enclave, [ReachedStep(*hop) for hop in path])


def follow_reach(source: RightsSource, enclave: str, *, infrastructure: bool) -> FollowedReach:
    """Return whom an enclave can influence and learn from by the rights of a source.

    ``infrastructure`` says whether topics of all nodes, and requests that only ask, count.

    Raises:
        KeystoreError: the keystore does not have the enclave, or it has no rights.
    """
    of_keystore = source.kind == "keystore"
    names = enclave_names(source.path) if of_keystore or source.kind == "zenoh" else ()
    without, questions = ((), ()) if infrastructure else (OF_EVERY_NODE, QUESTIONS)
    network = Network(
        source.rights,
        without=without,
        questions=questions,
        unguarded=unguarded(Keystore(source.path).governance) if of_keystore else (),
        everybody=names if of_keystore else (),
    )
    if names and enclave not in names:
        raise no_such_enclave(Keystore(source.path), enclave, names)
    if enclave not in network.enclaves:
        meant = likely_names(enclave, network.enclaves)
        raise KeystoreError(
            f"enclave {enclave} has no rights in '{source.path}'",
            f"Enclaves with rights: {', '.join(network.enclaves[:5]) or 'none'}.",
            f"Perhaps you mean {' or '.join(meant)}." if meant else "",
        )
    reach = network.reach(enclave)
    return FollowedReach(source.path, (*without, *questions), reach, source.fleet, source.notes)
