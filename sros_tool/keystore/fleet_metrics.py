"""The state of a fleet as metrics: which robots have what they should have, and since when."""

from __future__ import annotations

from datetime import datetime

from sros_tool.keystore.fleet_status import FleetStatus, State
from sros_tool.prometheus import Metric, Sample


def fleet_metrics(status: FleetStatus, *, now: datetime) -> tuple[Metric, ...]:
    """Return the metrics of a fleet; ``now`` is the moment of the comparison."""
    place = {"keystore": str(status.keystore.absolute())}
    robots = [({**place, "robot": each.robot}, each) for each in status.robots]
    return (
        Metric(
            "sros_fleet_compared_timestamp_seconds",
            "When the fleet was compared with its keystore, in seconds since 1970.",
            (Sample(int(now.timestamp()), place),),
        ),
        Metric(
            "sros_fleet_robots",
            f"Number of robots by state ({', '.join(State)}).",
            tuple(
                Sample(status.counts.get(state, 0), {**place, "state": state}) for state in State
            ),
        ),
        Metric(
            "sros_fleet_robot_state",
            "The state of each robot, with the value 1.",
            tuple(Sample(1, {**labels, "state": each.state}) for labels, each in robots),
        ),
        Metric(
            "sros_fleet_confirmed_timestamp_seconds",
            "When the last confirmation of a robot was received, in seconds since 1970.",
            tuple(
                Sample(int(each.received.timestamp()), labels)
                for labels, each in robots
                if each.received
            ),
        ),
        Metric(
            "sros_fleet_clock_ahead_seconds",
            "How far the clock of a robot was ahead when its confirmation was received.",
            tuple(
                Sample(int((each.clock - each.received).total_seconds()), labels)
                for labels, each in robots
                if each.clock and each.received
            ),
        ),
        Metric(
            "sros_fleet_pending_files",
            "Number of files by kind that a robot has to get or to lose; only of robots that "
            "confirmed something.",
            tuple(
                Sample(
                    sum(number for state, number in states.items() if state is not State.CURRENT),
                    {**labels, "kind": kind},
                )
                for labels, each in robots
                for kind, states in each.files.items()
            ),
        ),
    )
