"""The choices for the Zenoh processes of a robot: who routes, where, and for which domains."""

from __future__ import annotations

from dataclasses import dataclass

from sros_tool.zenoh.configuration import Mode


@dataclass(frozen=True, slots=True)
class ZenohNetwork:
    """The Zenoh network of a keystore's enclaves.

    ``router`` is the enclave of the router; ``endpoints`` (``HOST:PORT``) are where the sessions
    connect to it, and ``listen`` is where it listens, if elsewhere, such as ``[::]:7447``.
    ``mode`` is that of the sessions, client or peer.  ``domains`` are ROS domains; empty for those
    of the keystore's governance.
    """

    router: str = "/router"
    endpoints: tuple[str, ...] = ("localhost:7447",)
    listen: tuple[str, ...] = ()
    mode: Mode = Mode.CLIENT
    domains: tuple[int, ...] = ()

    def listening(self) -> tuple[str, ...]:
        """Return where the router listens."""
        return self.listen or self.endpoints
