"""The process that tries one DDS; only `sros_tool.runtime.stacks` starts it.

It joins with the enclave that the environment names, then creates endpoints that the enclave's
permissions allow and some that they deny, and reports each result.  The parent judges the results,
so that a crash of this process does not count as a refusal.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import (
    Participant,
    SecurityRefusedError,
    loaded_libraries,
    plugins_next_to,
    security_properties,
    version_of,
)
from sros_tool.runtime.events import EventKind, EventWriter, ProcessStage
from sros_tool.runtime.netns import enter_isolation, try_isolation
from sros_tool.runtime.rcl_security import choose_enclave, domain_of
from sros_tool.runtime.rmw import MIDDLEWARE

_LOG_FLUSH_SECONDS = 0.3

Ask = Callable[[str, str], None]
"""A function that creates an endpoint ("writer" or "reader") on a ROS topic ("/chatter")."""

Close = Callable[[], None]
"""A function that leaves the domain."""


def _join_rclpy() -> tuple[Ask, Close]:
    """Join as a node of rclpy with the RMW of ``RMW_IMPLEMENTATION``, or rclpy's default."""
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("talker")

    def ask(kind: str, topic: str) -> None:
        if kind == "writer":
            node.create_publisher(String, topic, 10)
        else:
            node.create_subscription(String, topic, lambda _message: None, 10)

    def close() -> None:
        node.destroy_node()
        rclpy.try_shutdown()

    return ask, close


def _join_cyclone() -> tuple[Ask, Close]:
    """Join as a participant with the libddsc that `sros_tool.runtime.cyclone` loads."""
    participant = Participant(domain_of(os.environ), choose_enclave(os.environ).enclave)

    def ask(kind: str, topic: str) -> None:
        if kind == "writer":
            participant.writer(f"rt{topic}")
        else:
            participant.reader(f"rt{topic}")

    return ask, participant.close


def _join_cyclonedds_package() -> tuple[Ask, Close]:
    """Join as a participant of the Python package ``cyclonedds``, with its own libddsc."""
    core, domain, idl, pub, sub, topics = (
        importlib.import_module(f"cyclonedds.{name}")
        for name in ("core", "domain", "idl", "pub", "sub", "topic")
    )
    enclave = choose_enclave(os.environ).enclave
    properties = {} if enclave is None else security_properties(enclave, _package_plugins())
    qos = core.Qos(*(core.Policy.Property(name, value) for name, value in properties.items()))
    participant = domain.DomainParticipant(domain_of(os.environ), qos)
    string = idl.make_idl_struct("String_", "std_msgs.msg.dds_.String_", {"data": str})

    def ask(kind: str, topic: str) -> None:
        made = topics.Topic(participant, f"rt{topic}", string)
        (pub.DataWriter if kind == "writer" else sub.DataReader)(participant, made)

    return ask, lambda: None


_JOINS: dict[str, Callable[[], tuple[Ask, Close]]] = {
    "rclpy": _join_rclpy,
    "cyclone": _join_cyclone,
    "cyclonedds": _join_cyclonedds_package,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Join, then create endpoints on two topics; arguments are ``KIND REPORT ALLOWED DENIED``.

    KIND is a key of `_JOINS`, REPORT the file for the events, the others are ROS topics.  Returns
    the exit status.
    """
    kind, report, allowed, denied = sys.argv[1:] if arguments is None else arguments
    if try_isolation().isolated:
        enter_isolation()
    events = EventWriter(Path(report))
    try:
        ask, close = _JOINS[kind]()
    except Exception as error:
        stage = ProcessStage.IMPORT if isinstance(error, ImportError) else ProcessStage.PARTICIPANT
        events.report(EventKind.SEEN, _dds_in_memory())
        _report_failure(events, error, stage, "")
        return 1
    events.report(EventKind.SEEN, _dds_in_memory())
    events.report(EventKind.READY, stage=ProcessStage.PARTICIPANT)
    for what, topic in (("writer", allowed), ("writer", denied), ("reader", denied)):
        try:
            ask(what, topic)
        except Exception as error:
            _report_failure(events, error, ProcessStage.ENDPOINT, f"{what} {topic}")
        else:
            events.report(EventKind.READY, f"{what} {topic}", stage=ProcessStage.ENDPOINT)
    time.sleep(_LOG_FLUSH_SECONDS)
    events.report(EventKind.DONE)
    close()
    return 0


def _report_failure(events: EventWriter, error: Exception, stage: ProcessStage, asked: str) -> None:
    refused = isinstance(error, SecurityRefusedError)
    reason = f"{type(error).__name__}: {error}"
    if isinstance(error, SrosError):
        # Without the remedy, which depends on the results of all stacks.
        reason = str(SrosError(error.what, error.why)).rstrip(".")
    if stage is not ProcessStage.ENDPOINT:
        time.sleep(_LOG_FLUSH_SECONDS)
    text = f"{asked}\n{reason}" if asked else reason
    events.report(EventKind.REFUSED if refused else EventKind.FAILED, text, stage=stage)


def _dds_in_memory() -> str:
    """Return name, version and file of the DDS in this process, one per line; "" if none."""
    for each in MIDDLEWARE:
        for prefix in each.libraries:
            for file in loaded_libraries(prefix):
                return f"{each.name}\n{version_of(file)}\n{file}"
    return ""


def _package_plugins() -> Path | None:
    folders = (plugins_next_to(file) for file in loaded_libraries("libddsc"))
    return next((folder for folder in folders if folder is not None), None)


if __name__ == "__main__":
    sys.exit(main())
