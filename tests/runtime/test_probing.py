"""The judgement of a probe: yes and no only on clear answers."""

from __future__ import annotations

import pytest

from sros_tool.runtime.events import Event, EventKind, ProcessStage
from sros_tool.runtime.stacks import ProbeRun, judge

JOINED = Event(EventKind.READY, 1, stage=ProcessStage.PARTICIPANT)
ALLOWED = Event(EventKind.READY, 2, "writer /ok", stage=ProcessStage.ENDPOINT)
DONE = Event(EventKind.DONE, 9)


def endpoint(kind: EventKind, what: str, reason: str = "") -> Event:
    return Event(kind, 3, f"{what}\n{reason}", stage=ProcessStage.ENDPOINT)


def run(*events: Event, output: str = "", status: int | None = 0) -> ProbeRun:
    return ProbeRun(events, output, status)


FAST_DDS = (
    "[SECURITY Error] rt/no topic not found in allow rule. -> Function check_create_datawriter\n"
    "[SECURITY Error] rt/no topic not found in allow rule. -> Function check_create_datareader\n"
)
WRITER = endpoint(EventKind.FAILED, "writer /no", "RCLError: failed to create publisher")
READER = endpoint(EventKind.FAILED, "reader /no", "RCLError: invalid allocator")

CASES = {
    "Cyclone refuses": (
        run(
            JOINED,
            ALLOWED,
            endpoint(EventKind.REFUSED, "writer /no", "Not Allowed By Security"),
            endpoint(EventKind.REFUSED, "reader /no", "Not Allowed By Security"),
            DONE,
        ),
        True,
        "Not Allowed By Security",
    ),
    "Fast DDS refuses": (
        run(JOINED, ALLOWED, WRITER, READER, DONE, output=FAST_DDS),
        True,
        "rt/no topic not found in allow rule",
    ),
    "no security built in": (
        run(
            Event(
                EventKind.FAILED,
                1,
                "RCLError: This Fast DDS version doesn't have the security libraries\nPlease"
                " compile Fast DDS using the -DSECURITY=ON CMake option",
                stage=ProcessStage.PARTICIPANT,
            ),
            status=1,
        ),
        False,
        "security libraries",
    ),
    "it lets a writer pass": (
        run(JOINED, ALLOWED, endpoint(EventKind.READY, "writer /no"), READER, DONE),
        False,
        "created a writer /no",
    ),
    "it lets a reader pass": (
        run(
            JOINED,
            ALLOWED,
            endpoint(EventKind.REFUSED, "writer /no", "Not Allowed By Security"),
            endpoint(EventKind.READY, "reader /no"),
            DONE,
        ),
        False,
        "created a reader /no",
    ),
    "endpoints fail for another reason": (
        run(JOINED, ALLOWED, WRITER, READER, DONE, output="out of memory\n"),
        None,
        "not because security refused them",
    ),
    "even the allowed endpoint fails": (
        run(
            JOINED, endpoint(EventKind.FAILED, "writer /ok", "no"), WRITER, READER, output=FAST_DDS
        ),
        None,
        "even the allowed writer",
    ),
    "it crashes at once": (run(status=-11), None, "SIGSEGV"),
    "it crashes on the denied endpoint": (run(JOINED, ALLOWED, status=-6), None, "SIGABRT"),
    "it hangs": (run(JOINED, ALLOWED, status=None), None, "no answer in time"),
    "it cannot be imported": (
        run(
            Event(EventKind.FAILED, 1, "ImportError: librcl.so", stage=ProcessStage.IMPORT),
            status=1,
        ),
        None,
        "librcl.so",
    ),
    "the enclave is refused": (
        run(
            Event(EventKind.FAILED, 1, "RCLError: x", stage=ProcessStage.PARTICIPANT),
            output="[SECURITY Error] PKCS7 data verification failed\n",
            status=1,
        ),
        None,
        "the participant itself was refused",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_judgement(case: str) -> None:
    probe, enforces, told = CASES[case]
    verdict = judge(probe, "/ok", "/no")
    assert verdict.enforces is enforces
    assert told in verdict.evidence
    assert verdict.evidence.startswith("could not be tried") is (enforces is None)
