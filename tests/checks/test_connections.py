"""Which pairs of processes have not connected, and which restarts are proposed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from sros_tool.checks import connections as connections_module
from sros_tool.checks.connections import (
    connection_findings,
    connections_between,
    lost_memory_findings,
    not_connected_text,
    restarts,
)
from sros_tool.runtime.processes import MemoryPort, Process

FIRST_OF_DOMAIN_77 = 26661
STARTED = datetime(2026, 1, 1, tzinfo=UTC)


def port(pid: int, *, domain: int = 77, file: int = 0) -> MemoryPort:
    """Return the port of a process whose id is also its number in the domain."""
    number = FIRST_OF_DOMAIN_77 + 250 * (domain - 77) + 2 * pid
    return MemoryPort(number, "00:1b", file or number)


def robot(*pids: int, deaf: Iterable[tuple[int, int]] = ()) -> list[Process]:
    """Return processes that have mapped the ports of all others, except those of the pairs."""
    pairs = {*deaf, *((second, first) for first, second in deaf)}
    return [
        Process(
            pid,
            (f"node{pid}",),
            {},
            STARTED,
            own_ports=frozenset({port(pid), MemoryPort(7000 + pid, "00:1b", pid)}),
            mapped_ports=frozenset(port(peer) for peer in pids if (pid, peer) not in pairs),
        )
        for pid in pids
    ]


def missing_pairs(processes: Iterable[Process]) -> set[tuple[int, int]]:
    return {(one.pid, other.pid) for one, other in connections_between(processes).missing}


def test_a_pair_that_has_not_mapped_each_others_port_is_missing() -> None:
    assert missing_pairs(robot(1, 2, 3)) == set()
    assert missing_pairs(robot(1, 2, 3, deaf=[(1, 3)])) == {(1, 3)}
    in_two_domains = [
        replace(process, own_ports=process.own_ports | {port(process.pid, domain=78)})
        for process in robot(1, 2, deaf=[(1, 2)])
    ]
    assert len(connections_between(in_two_domains).missing) == 1


def test_one_direction_is_enough_to_be_missing() -> None:
    first, second = robot(1, 2)
    assert missing_pairs([first, replace(second, mapped_ports=second.own_ports)]) == {(1, 2)}


def test_a_port_that_the_other_process_opened_again_does_not_count() -> None:
    """A process that restarts has the number of before, and another file."""
    first, second = robot(1, 2)
    again = frozenset({port(2, file=9)})
    second = replace(second, own_ports=again, mapped_ports=frozenset({port(1)}) | again)
    assert missing_pairs([first, second]) == {(1, 2)}


@pytest.mark.parametrize(
    ("change", "unknown"),
    [
        ({}, []),
        ({"own_ports": frozenset()}, [3]),  # another DDS, or no shared memory
        ({"network": "net:[1]"}, [3]),
        ({"own_ports": frozenset({port(3, domain=78)})}, [3]),
        ({"own_ports": frozenset({port(3)._replace(memory="00:2c")})}, [3]),
        ({"own_ports": frozenset({port(3)._replace(number=FIRST_OF_DOMAIN_77 + 5)})}, [3]),
    ],
)
def test_what_cannot_be_compared_is_unknown(change: dict[str, Any], unknown: list[int]) -> None:
    first, second, third = robot(1, 2, 3, deaf=[(1, 3), (2, 3)])
    connections = connections_between([first, second, replace(third, **change)])
    assert [process.pid for process in connections.unknown] == unknown
    assert bool(connections.missing) is not bool(unknown)


def test_few_processes_are_named_for_a_restart() -> None:
    pairs = [(2, 12), (3, 6), (3, 12), (3, 14), (4, 8), (5, 8), (6, 12)]
    missing = connections_between(robot(*range(2, 15), deaf=pairs)).missing
    proposed = {process.pid: {peer.pid for peer in peers} for process, peers in restarts(missing)}
    assert proposed == {12: {2, 3, 6}, 3: {6, 14}, 8: {4, 5}}


def test_processes_of_two_users_need_one_user_rather_than_a_restart() -> None:
    first, second = robot(1, 2, deaf=[(1, 2)])
    (same,) = connection_findings([(first, second)])
    assert same.text == "it has not connected to process 2 (node2): they do not hear each other"
    assert "restart the process" in same.remedy
    assert "the program may turn security off in its own environment" in same.remedy
    (different,) = connection_findings([(first, replace(second, user=1000))])
    assert different.remedy.startswith("Run these processes as one user")


def test_a_summary_names_a_pair_and_all_restarts() -> None:
    connections = connections_between(robot(*range(2, 15), deaf=[(2, 12), (3, 6), (3, 12)]))
    assert not_connected_text(connections) == (
        "process 2 (node2) and process 12 (node12) and 2 other pairs do not hear each other; "
        "restart process 12 (node12) and process 3 (node3), one after the other, and check again"
    )
    different = [(first, replace(second, user=1000)) for first, second in connections.missing]
    connections = connections._replace(missing=different)
    assert "; run these processes as one user" in not_connected_text(connections)


def test_processes_that_lost_their_shared_memory_are_deaf_to_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They still map what was deleted, and their peers may map their ports of before."""
    users_named = {4711: "4711", 4712: "4712"}
    monkeypatch.setattr(
        connections_module,
        "users_without_linger",
        lambda users: [users_named[user] for user in users if user in users_named],
    )
    heard, *lost = robot(1, 2, 3)
    system, login = (replace(process, lost_memory=True) for process in lost)
    connections = connections_between([heard, system])
    assert (connections.deaf, connections.missing, connections.unknown) == ([system], [], [])
    assert not_connected_text(connections) == (
        "process 2 (node2) has lost its shared memory (its files in /dev/shm were removed), and "
        "hears nothing. Stop it, and start it again"
    )
    users = [replace(login, user=user) for user in (4711, 4712)]
    several = not_connected_text(connections_between([heard, *users]))
    assert (
        "If 4711 and 4712 also log in, first run `loginctl enable-linger 4711` and `loginctl "
        "enable-linger 4712`, because systemd removes the shared memory of a user who logs out. "
        "Stop all of them before you start the first one again"
    ) in several
    (finding,) = lost_memory_findings([heard, users[0]])
    assert finding.remedy.startswith("If 4711 also logs in, first run `loginctl enable-linger 4711")
    users_named.pop(4711)
    assert "linger" not in not_connected_text(connections_between([heard, users[0]])), "it is on"


@pytest.mark.parametrize("lost", [False, True])
def test_a_stopped_process_is_continued_whatever_became_of_its_memory(lost: bool) -> None:
    """It opens its port again by itself, so neither a restart nor linger is needed."""
    first, *others = robot(1, 2, 3)
    stopped = [replace(process, is_stopped=True, lost_memory=lost) for process in others]
    assert not_connected_text(connections_between([first, *stopped])) == (
        "process 2 (node2), process 3 (node3) are stopped (SIGSTOP), and hear nothing. Continue "
        "with `kill -CONT 2 3`, and check again"
    )
    found = [*lost_memory_findings([first, *stopped])]
    remedies = [f"Continue with `kill -CONT {pid}`, and check again." for pid in (2, 3)]
    assert [finding.remedy for finding in found] == remedies * lost
