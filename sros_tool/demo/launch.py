"""Start one process of a row, follow its report, and end it; none outlives its starter."""

from __future__ import annotations

import logging
import os
import shlex
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from sros_tool.demo.records import PartyRecord
from sros_tool.demo.wire import udp_ports
from sros_tool.runtime.events import Event, EventReader, Kind
from sros_tool.runtime.netns import end_with_parent
from sros_tool.runtime.vendor_log import plain_text

_LOG = logging.getLogger(__name__)

_LEFT_OUT_PREFIXES = ("ROS_SECURITY_",)
_LEFT_OUT = frozenset(
    {
        "CYCLONEDDS_URI",
        "FASTDDS_BUILTIN_TRANSPORTS",
        "FASTDDS_DEFAULT_PROFILES_FILE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        "RMW_FASTRTPS_USE_QOS_FROM_XML",
        "RMW_IMPLEMENTATION",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_DISCOVERY_SERVER",
        "ROS_DOMAIN_ID",
        "ROS_LOCALHOST_ONLY",
        "ROS_STATIC_PEERS",
    }
)


def base_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """``environment`` without what would change how DDS discovers or secures."""
    return {
        name: value
        for name, value in environment.items()
        if name not in _LEFT_OUT and not name.startswith(_LEFT_OUT_PREFIXES)
    } | {"PYTHONUNBUFFERED": "1"}


class PartyProcess:
    """A running node; ``folder`` gets its report and its log under ``name``."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        folder: Path,
        *,
        topic: str,
        text: str = "",
        through: str = "",
    ) -> None:
        stem = name.replace(" ", "_")
        self.name = name
        self.topic = topic
        self.text = text
        self._through = through
        self._log = folder / f"{stem}.log"
        report = folder / f"{stem}.jsonl"
        self._reader = EventReader(report)
        self._events: list[Event] = []
        self._own_status: int | None = None
        self._asked = False
        self._ports: frozenset[int] = frozenset()
        starter = os.getpid()

        def before() -> None:
            end_with_parent()
            if os.getppid() != starter:
                os._exit(1)

        with self._log.open("wb") as output:
            self._process = subprocess.Popen(
                [*command, "--report", str(report)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**environment, "ROS_LOG_DIR": str(folder / "ros_log")},
                start_new_session=True,
                preexec_fn=before,
            )
        _LOG.info("started process %d, %s: %s", self._process.pid, name, shlex.join(command))

    def look(self) -> list[Event]:
        """Everything that the process has reported so far, oldest first."""
        ended = self._process.poll()
        self._events += self._reader.new_events()
        if ended is not None and self._own_status is None and not self._asked:
            self._own_status = ended
        return self._events

    @property
    def settled(self) -> bool:
        """Whether the process is ready, or will never be."""
        events = self.look()
        return self._own_status is not None or any(
            event.kind in (Kind.READY, Kind.REFUSED, Kind.FAILED) for event in events
        )

    @property
    def running(self) -> bool:
        """Whether the process is ready and still there."""
        events = self.look()
        return self._own_status is None and any(event.kind is Kind.READY for event in events)

    @property
    def ended(self) -> bool:
        """Whether the process has ended by itself."""
        self.look()
        return self._own_status is not None

    def ports(self) -> frozenset[int]:
        """The UDP ports that the process holds, or held when it was last asked."""
        self._ports = udp_ports(self._process.pid) or self._ports
        return self._ports

    def ask_to_end(self) -> None:
        """Send SIGTERM; from now on an end is not the process's own."""
        self.look()
        self._asked = True
        with suppress(ProcessLookupError):
            self._process.terminate()
            self._process.send_signal(signal.SIGCONT)

    def hold(self) -> None:
        """Stop the process where it is; `end` still ends it."""
        with suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGSTOP)

    @property
    def gone(self) -> bool:
        """Whether the process has ended, by itself or because it was asked to."""
        return self._process.poll() is not None

    def end(self) -> None:
        """Force the end on the process and its children."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def record(self) -> PartyRecord:
        """What the process left behind; call it after `end`."""
        # Being ended is no failure, whatever a node makes of it.
        late = [event for event in self._reader.new_events() if event.kind is not Kind.FAILED]
        return PartyRecord(
            text=self.text,
            topic=self.topic,
            through=self._through,
            events=(*self._events, *late),
            output=plain_text(self._log.read_text(encoding="utf-8", errors="replace")),
            status=self._own_status,
        )
