"""How far a robot is closed: the steps, the processes that run in their enclaves, the proofs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, NamedTuple

from sros_tool.close.export import valid_until
from sros_tool.close.processes import ClosedProcess, ObservedProcesses
from sros_tool.close.robot import OBSERVER, LocalRobot, check_enclaves
from sros_tool.close.running import RunningRobot
from sros_tool.policy.model import Policy
from sros_tool.values import DryRun, FileChanges, Words, shows

TALK = "everything that talked can still talk"
SILENCE = "an open listener finds nothing"


class CloseStep(NamedTuple):
    """A step of closing a robot."""

    command: str
    """The command line that does the same."""
    state: Annotated[str, Words(("done", "kept", "findings", "open"))]
    """Whether the step was done now, was kept because its result existed, found something, or
    is not done."""


class Proof(NamedTuple):
    """A claim about the closed robot."""

    claim: str
    """What has to hold."""
    holds: bool | None
    """Whether the claim holds; null if it could not be tested."""
    reason: str
    """What was seen, or why the claim could not be tested."""

    @property
    def fails(self) -> bool:
        """Whether the claim was tested, and does not hold."""
        return self.holds is False

    @property
    def is_accepted_by_partial(self) -> bool:
        """Whether ``--partial`` accepts that the claim could not be tested.

        It never accepts that for the claims that need an observer of the running robot.
        """
        return self.holds is None and self.claim not in (TALK, SILENCE)


@shows(spread=("observed",))
class CloseState(NamedTuple):
    """How far a robot is closed."""

    folder: Path
    """The folder with everything that was made."""
    observed: ObservedProcesses
    steps: Sequence[CloseStep]
    """The steps in their order."""
    secured: Mapping[str, bool]
    """The enclaves in which a process of the robot runs now, and whether with the current files;
    otherwise it has to be restarted."""
    new: Sequence[str]
    """The enclaves of the policy without a process: none was observed, and none runs now."""
    without: Sequence[str]
    """The enclaves of `--without`, of which no process has to run."""
    valid_until: datetime | None
    """When the first enclave of the export expires, in UTC; null without an export."""
    denied: Sequence[str]
    """What the observed nodes do although the keystore denies it, as sentences."""
    newly_denied: Sequence[str]
    """The part of `denied` that the keystore did not deny before this command."""
    problems: Sequence[str]
    """Reasons why the robot is not closed yet, or not open again, with what to do."""
    proofs: Sequence[Proof]
    """The proof that the robot is closed; empty before."""
    dry_run: DryRun
    changes: FileChanges

    def is_proved(self, *, partial: bool) -> bool:
        """Return whether the proof holds; ``partial`` accepts what could not be examined."""
        claims = [
            proof.holds or (partial and proof.is_accepted_by_partial) for proof in self.proofs
        ]
        return bool(claims) and all(claims)

    @property
    def is_signed(self) -> bool:
        """Whether the steps came to the end, so that the policy is what is signed."""
        return all(step.state != "open" for step in self.steps)

    @property
    def pending(self) -> Sequence[str]:
        """The enclaves that should have a process with the current files, and have none."""
        names = {process.enclave for process in self.observed.processes} | {*self.new}
        names = names.difference(self.without) | self.secured.keys()
        return sorted(name for name in names if not self.secured.get(name))

    @property
    def stopped(self) -> set[str]:
        """The enclaves of which no process runs, open or closed."""
        stopped = {process.enclave for process in self.observed.processes if not process.pid}
        return {*self.new, *stopped} - self.secured.keys()

    @property
    def pending_by_hand(self) -> Mapping[str, Sequence[ClosedProcess]]:
        """The commands to run by hand for the enclaves in ``pending``, with their processes."""
        by_hand = self.observed.commands_by_hand(self.folder.absolute())
        return {
            command: processes
            for command, processes in by_hand.items()
            if any(process.enclave in self.pending for process in processes)
        }


def current_state(robot: LocalRobot, policy: Policy | None) -> CloseState:
    """Return the processes of the enclaves that the policy has, as they run now."""
    running = RunningRobot(robot)
    observed, new = ObservedProcesses(robot.domain), set[str]()
    names = {enclave.name for _, enclave in running.secured} - {OBSERVER}
    secured = {name: name in running.current_enclaves for name in sorted(names)}
    if robot.observed:
        observed = running.with_later_processes(robot.observed).with_current_pids(running.processes)
    if policy:
        observed = observed.within(policy)
        known = {process.enclave for process in observed.processes} | names
        new = {enclave.path for enclave in policy.enclaves} - known - {*observed.elsewhere}
        new -= robot.not_here
    new -= {OBSERVER} if robot.observed else new
    known = {process.enclave for process in observed.processes} | new | secured.keys()
    check_enclaves(robot.without, known | robot.not_here, "--without")
    until = valid_until(robot)
    started = observed, (), secured, sorted(new), robot.without, until
    return CloseState(robot.folder, *started, (), (), (), (), False, ())
