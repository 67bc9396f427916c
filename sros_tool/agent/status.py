"""What the agent of a robot last did, as it remembers it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from sros_tool.agent.settings import read_settings
from sros_tool.agent.state import read_state
from sros_tool.values import DryRun, FileChanges, Notes


class InitializedAgent(NamedTuple):
    """An agent that was set up."""

    folder: Path
    """FOLDER, as given on the command line."""
    dry_run: DryRun
    robot: str
    """Name of the robot."""
    root_sha256: str | None
    """SHA-256 of the root metadata that is trusted; null with ``--dry-run``."""
    changes: FileChanges
    notes: Notes


class AgentStatus(NamedTuple):
    """What the agent of a robot last did, and what waits."""

    folder: Path
    """FOLDER, as given on the command line."""
    robot: str
    """Name of the robot."""
    source: str
    """Where releases are fetched from."""
    inbox: str
    """Where messages are sent to."""
    release: int
    """Number of the release that is installed with all its enclaves; 0 for none."""
    accepted: int
    """Highest number of a release that was verified; if it is higher than ``release``, some
    enclaves wait for it.
    """
    fetched: datetime | None
    """When the source was last reached, by the clock of the robot, in UTC; null for never."""
    sent: datetime | None
    """When the inbox was last reached, by the clock of the robot, in UTC; null for never."""
    restart: Sequence[str]
    """Enclaves whose processes were not yet seen with the installed files."""
    unseen: Sequence[str]
    """Enclaves of ``restart`` of which no process was seen, although not all processes here can be
    seen. `sros agent run FOLDER --once --restarted` says that these restarts are done.
    """
    problems: Sequence[str]
    """What the last round could not do, and what is wrong, as sentences."""
    well: bool
    """Whether nothing is wrong or due, and source and inbox were reached recently."""


def agent_status(folder: Path, *, now: datetime, oldest: timedelta) -> AgentStatus:
    """Return what the agent of ``folder`` last did.

    Source and inbox have to be reached within the time ``oldest``.

    Raises:
        SrosError: the folder has no agent, or its settings are malformed.
    """
    settings, state = read_settings(folder), read_state(folder)
    recent = all(
        moment is not None and abs(now - moment) <= oldest for moment in (state.fetched, state.sent)
    )
    whole = 0 < state.release == state.accepted
    return AgentStatus(
        folder,
        settings.robot,
        settings.source,
        settings.inbox,
        state.release,
        state.accepted,
        state.fetched,
        state.sent,
        state.due,
        state.unseen,
        state.problems,
        recent and whole and not state.due and not state.problems,
    )
