"""What is read from, and sent into, the network of one row."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping

from sros_tool.demo.capture import Capture, Kept
from sros_tool.demo.records import WireCount
from sros_tool.demo.replay import Injector, packets_of

_CERTIFICATE = "-----BEGIN CERTIFICATE-----"


class Wiretap:
    """Captures from the moment it is made; ``problem`` says why that is not permitted, or "".

    ``texts`` marks what each party says, by its name; ``topic`` is a DDS topic name.  Make it in
    the network that it listens in on, and in the loop of asyncio.
    """

    def __init__(self, texts: Mapping[str, str], topic: str, *, replayed: bool) -> None:
        self._texts = texts
        self._topic = topic
        self.problem = ""
        self._capture: Capture | None = None
        self._injector: Injector | None = None
        try:
            self._capture = Capture([*texts.values(), topic, _CERTIFICATE], keep=replayed)
            self._injector = Injector() if replayed else None
        except OSError as error:
            self.problem = f"capturing packets is not permitted: {error.strerror}"
            self.close()
            return
        asyncio.get_running_loop().add_reader(self._capture.fileno(), self._capture.drain)

    def count(self, ports: Collection[int]) -> dict[str, WireCount]:
        """What was readable so far, by party; packets of ``ports`` count as protected."""
        if self._capture is None:
            return {}
        self._capture.drain()
        plain = self._capture.plain
        protected = sum(self._capture.protected[port] for port in ports)
        return {
            name: WireCount(plain[text], protected, plain[self._topic], plain[_CERTIFICATE])
            for name, text in self._texts.items()
        }

    def packets(self, ports: Collection[int]) -> list[Kept]:
        """The packets that were sent from one of the ports so far, in order."""
        if self._capture is None:
            return []
        self._capture.drain()
        return packets_of(self._capture.kept, ports)

    def send(self, packet: bytes) -> None:
        """Send a packet again."""
        if self._injector is not None:
            self._injector.send(packet)

    def close(self) -> None:
        """Stop listening."""
        if self._capture is not None:
            asyncio.get_running_loop().remove_reader(self._capture.fileno())
            self._capture.close()
        if self._injector is not None:
            self._injector.close()
        self._capture = self._injector = None
