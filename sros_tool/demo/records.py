"""What a row left behind, and what a row came to: values between the runner and the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sros_tool.demo.model import Row, Status
from sros_tool.runtime.events import Event


@dataclass(frozen=True)
class WireCount:
    """How many packets held a talker's text in the open, and how many of its row were protected.

    ``topics`` and ``certificates`` count the packets of the row that show the name of its topic,
    and a certificate.
    """

    plain: int
    protected: int
    topics: int = 0
    certificates: int = 0


@dataclass(frozen=True)
class Replay:
    """How many captured packets were sent again or changed, and when (CLOCK_MONOTONIC)."""

    packets: int
    time: float


def forged_text(text: str) -> str:
    """What is said in the name of a talker that says ``text``; of the same length."""
    return text.swapcase()


@dataclass(frozen=True)
class PartyRecord:
    """What one process left behind.

    ``text`` marks the messages of a talker; ``topic`` is its ROS topic; ``through`` names the
    library it used; ``output`` is what it printed; ``status`` its exit status
    (negative for a signal) if it ended before it was stopped.
    """

    text: str = ""
    topic: str = ""
    through: str = ""
    events: tuple[Event, ...] = ()
    output: str = ""
    status: int | None = None


@dataclass(frozen=True)
class RowRecord:
    """What a row left behind.

    ``window`` is the time (CLOCK_MONOTONIC) that counts; None where not all parties became ready.
    ``skipped`` is the reason for which the row was not run, or "".
    """

    row: Row
    domain: int
    parties: Mapping[str, PartyRecord] = field(default_factory=dict)
    window: tuple[float, float] | None = None
    wire: Mapping[str, WireCount] = field(default_factory=dict)
    replay: Replay | None = None
    skipped: str = ""


@dataclass(frozen=True)
class CastMember:
    """Who plays a part in a keystore of the user's: an enclave, and its ROS nodes on rclpy."""

    part: str
    enclave: str
    nodes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """What was observed about one claim, and in a clause why one may believe it."""

    status: Status
    detail: str


@dataclass(frozen=True)
class RowResult:
    """A line of the table: ``as_expected`` is also true of a row skipped with its reason."""

    name: str
    expected: Status
    observed: Status
    mechanism: str
    detail: str
    domain: int
    seconds: float = 0.0
    attack: str = ""
    removed: str = ""
    open_because: str = ""
    remedy: str = ""

    @property
    def as_expected(self) -> bool:
        """Whether this row lets the demo succeed."""
        return self.observed in (self.expected, Status.SKIPPED)

    @property
    def known_open(self) -> bool:
        """Whether it shows a way in that is known to be open, and why."""
        return bool(self.open_because) and self.observed is self.expected

    def as_json(self) -> dict[str, Any]:
        """The row as `sros demo --json` shows it."""
        return {
            "name": self.name,
            "expected": self.expected.value,
            "observed": self.observed.value,
            "as_expected": self.as_expected,
            "mechanism": self.mechanism,
            "detail": self.detail,
            "domain": self.domain,
            "seconds": round(self.seconds, 1),
            "attack": self.attack,
            "defence_removed": self.removed,
            "open_because": self.open_because,
            "remedy": self.remedy,
        }
