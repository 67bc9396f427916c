"""The Prometheus metrics of a fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime

from sros_tool.dds.advisories import Advisory, known_vulnerabilities
from sros_tool.keystore.confirmation import is_mended
from sros_tool.keystore.fleet_status import FleetStatus, RobotStatus, State
from sros_tool.prometheus import Metric, Sample


def fleet_metrics(
    status: FleetStatus, *, now: datetime, advisories: Sequence[Advisory] | None = None
) -> tuple[Metric, ...]:
    """Return the Prometheus metrics of a fleet; ``now`` is the time of the comparison.

    ``advisories`` are the known vulnerabilities; None for the vulnerabilities that ship with sros.
    """
    place = {"keystore": str(status.keystore.absolute())}
    robots = [({**place, "robot": robot.robot}, robot) for robot in status.robots]
    ends = status.publication.expires if status.publication else None
    root = status.publication.root_expires if status.publication else None

    def per_robot(value: Callable[[RobotStatus], int | None]) -> tuple[Sample, ...]:
        values = ((value(robot), labels) for labels, robot in robots)
        return tuple(Sample(number, labels) for number, labels in values if number is not None)

    return (
        Metric(
            "sros_fleet_compared_timestamp_seconds",
            "When the fleet was compared with its keystore, in seconds since 1970.",
            (Sample(int(now.timestamp()), place),),
        ),
        Metric(
            "sros_fleet_complete",
            "1 if `sros fleet status` reports no problem of the robots, the keystore or the clock "
            "of its machine, otherwise 0. Known vulnerabilities do not count.",
            (Sample(int(status.complete), place),),
        ),
        Metric(
            "sros_fleet_mended",
            "Like sros_fleet_complete, but changed files that an agent or `sros fleet publish` has "
            "replaced do not count. (sros_fleet_complete counts them for a day.)",
            (Sample(int(status.mended), place),),
        ),
        Metric(
            "sros_fleet_seen",
            "Like sros_fleet_complete, but a publishing folder that cannot be examined on the "
            "machine of the keystore does not count.",
            (Sample(int(status.seen), place),),
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
            tuple(Sample(1, {**labels, "state": robot.state}) for labels, robot in robots),
        ),
        Metric(
            "sros_fleet_confirmed_timestamp_seconds",
            "The time from which the age of the last confirmation of a robot counts, in seconds "
            "since 1970.",
            per_robot(lambda robot: int(robot.confirmed.timestamp()) if robot.confirmed else None),
        ),
        Metric(
            "sros_fleet_expiry_timestamp_seconds",
            "For each kind of file: the earliest expiry of the files that a robot confirmed, as "
            "the ledger says, in seconds since 1970.",
            tuple(
                Sample(int(end.timestamp()), {**labels, "kind": kind})
                for labels, robot in robots
                for kind, end in robot.expiry.items()
            ),
        ),
        Metric(
            "sros_fleet_restarts_due",
            "For robots that report restarts: number of enclaves whose processes may still run "
            "with earlier files.",
            per_robot(lambda robot: None if robot.restart is None else len(robot.restart)),
        ),
        Metric(
            "sros_fleet_revocation_list_in_force",
            "1 if the current revocation list is known to be in force on a robot, otherwise 0; "
            "present only if the list revokes a certificate.",
            per_robot(lambda robot: None if robot.crl_in_force is None else int(robot.crl_in_force))
            if status.is_any_revoked
            else (),
        ),
        Metric(
            "sros_fleet_release",
            "Number of the release that a robot installed last, for robots that fetch.",
            per_robot(lambda robot: robot.release),
        ),
        Metric(
            "sros_fleet_published_release",
            "Number of the release that was published last for a robot.",
            per_robot(lambda robot: robot.published),
        ),
        Metric(
            "sros_fleet_publication_expiry_timestamp_seconds",
            "When robots begin to refuse what was published last, in seconds since 1970.",
            (Sample(int(ends.timestamp()), place),) if ends else (),
        ),
        Metric(
            "sros_fleet_root_expiry_timestamp_seconds",
            "When the root metadata expires, in seconds since 1970; only the root key renews it.",
            (Sample(int(root.timestamp()), place),) if root else (),
        ),
        Metric(
            "sros_fleet_publication_altered",
            "Number of published files that `sros fleet publish` put right in the last day, "
            "because they were missing, changed, older than the last publication or foreign.",
            (Sample(len(status.publication.altered), place),) if status.publication else (),
        ),
        Metric(
            "sros_fleet_agent_problems",
            "For robots that report problems: number of problems, not counting changed files that "
            "the robot's agent has replaced.",
            per_robot(
                lambda robot: (
                    None
                    if robot.problems is None
                    else sum(not is_mended(problem) for problem in robot.problems)
                )
            ),
        ),
        Metric(
            "sros_fleet_agent_mended",
            "For robots that report problems: number of problems of the last day that are over, "
            "because the robot's agent has replaced the changed files.",
            per_robot(
                lambda robot: (
                    None if robot.problems is None else sum(map(is_mended, robot.problems))
                )
            ),
        ),
        Metric(
            "sros_fleet_clock_ahead_seconds",
            "How many seconds the clock of a robot was ahead when its confirmation was received; "
            "negative if the clock was behind.",
            per_robot(
                lambda robot: (
                    int((robot.clock - robot.received).total_seconds())
                    if robot.clock and robot.received
                    else None
                )
            ),
        ),
        Metric(
            "sros_fleet_pending_files",
            "For robots that sent a confirmation: number of files, by kind, to deliver to the "
            "robot or to remove there.",
            tuple(
                Sample(
                    sum(number for state, number in states.items() if state is not State.CURRENT),
                    {**labels, "kind": kind},
                )
                for labels, robot in robots
                for kind, states in robot.files.items()
            ),
        ),
        *_dds_metrics(robots, advisories),
    )


def _dds_metrics(
    robots: Sequence[tuple[Mapping[str, str], RobotStatus]], advisories: Sequence[Advisory] | None
) -> Iterator[Metric]:
    """Yield metrics on known vulnerabilities of robots' DDS, and on robots with unknown DDS."""
    numbers: list[Sample] = []
    unknown: list[Sample] = []
    for labels, robot in robots:
        unknown_libraries = 0 if robot.dds and robot.dds.libraries else 1
        most: dict[tuple[str, str], int] = {}
        for library in robot.dds.libraries if robot.dds else ():
            vulnerabilities = known_vulnerabilities(library.product, library.version, advisories)
            if vulnerabilities is None:
                unknown_libraries += 1
            else:
                use = library.product, library.seen.value
                most[use] = max(most.get(use, 0), len(vulnerabilities.known))
        numbers += (
            Sample(number, {**labels, "product": product, "seen": seen})
            for (product, seen), number in sorted(most.items())
        )
        unknown.append(Sample(unknown_libraries, labels))
    yield Metric(
        "sros_fleet_dds_known_vulnerabilities",
        "Number of vulnerabilities known for the version of a DDS that processes of a robot have "
        "loaded, or that is only installed. They count even if the package has fixes for them "
        "without a new version. If the robot has several releases of the DDS, the largest number.",
        tuple(numbers),
    )
    yield Metric(
        "sros_fleet_dds_unknown",
        "Number of DDS libraries of a robot whose known vulnerabilities cannot be determined; 1 if "
        "it reported no library.",
        tuple(unknown),
    )
    yield Metric(
        "sros_fleet_processes_not_seen",
        "Number of processes that a robot could not examine; they may use other libraries.",
        tuple(Sample(robot.dds.unseen, labels) for labels, robot in robots if robot.dds),
    )
