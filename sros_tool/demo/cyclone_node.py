"""Talk, listen or look over Cyclone DDS: ``python -m sros_tool.demo.cyclone_node``.

The nodes read the same environment as a ROS 2 node and speak on the same DDS topics with the same
type, so that rclpy nodes hear them, and a launcher need not know which kind it starts.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from types import FrameType

from sros_tool.demo.options import NodeOptions, option_parser, split_ros_args
from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import Participant, Reader, SecurityRefusedError, Writer
from sros_tool.runtime.events import EventWriter, Kind, Stage
from sros_tool.runtime.rcl_security import choose_enclave, domain_of

_LISTEN_SECONDS = 0.02


class _Stopped(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Talk, listen or look around until told to stop; returns the exit status."""
    own, ros = split_ros_args(sys.argv[1:] if arguments is None else arguments)
    parser = option_parser(
        "sros_tool.demo.cyclone_node", "Talk, listen or look around over Cyclone DDS."
    )
    parser.add_argument("role", choices=("talker", "listener", "observer"))
    parser.add_argument("--also", action="append", default=[], help="one more topic to look at")
    parsed = parser.parse_args(own)
    options = NodeOptions(parsed.topic, parsed.period, parsed.text, parsed.report)
    _stop_on_signals()
    events = EventWriter(options.report)
    stage = Stage.PARTICIPANT
    try:
        choice = choose_enclave(os.environ, _enclave_in(ros))
        _say(parsed.role, choice.note)
        with Participant(domain_of(os.environ), choice.enclave) as participant:
            stage = Stage.ENDPOINT
            if parsed.role == "talker":
                writer = participant.writer(_dds_name(options.topic))
                stage = Stage.RUNNING
                events.report(Kind.READY)
                _talk(writer, options, events)
            elif parsed.role == "observer":
                stage = Stage.RUNNING
                events.report(Kind.READY)
                _observe(participant, [options.topic, *parsed.also], options.period, events)
            else:
                reader = participant.reader(_dds_name(options.topic))
                stage = Stage.RUNNING
                events.report(Kind.READY)
                _listen(reader, events)
    except _Stopped:
        pass
    except SecurityRefusedError as refusal:
        events.report(Kind.REFUSED, str(refusal), stage=stage)
        _say(parsed.role, f"refused by DDS Security: {refusal}")
        return 1
    except SrosError as error:
        events.report(Kind.FAILED, str(error), stage=stage)
        _say(parsed.role, f"failed: {error}")
        return 1
    events.report(Kind.DONE)
    return 0


def _talk(writer: Writer, options: NodeOptions, events: EventWriter) -> None:
    sent = 0
    due = time.monotonic()
    while True:
        due += options.period
        time.sleep(max(0.0, due - time.monotonic()))
        sent += 1
        text = f"{options.text}: {sent}"
        writer.write(text)
        events.report(Kind.SENT, text, count=sent)
        _say("talker", f"Publishing: '{text}'")


def _listen(reader: Reader, events: EventWriter) -> None:
    heard = 0
    while True:
        for text in reader.take():
            heard += 1
            events.report(Kind.HEARD, text, count=heard)
            _say("listener", f"I heard: '{text}'")
        time.sleep(_LISTEN_SECONDS)


def _observe(
    participant: Participant, topics: Sequence[str], period: float, events: EventWriter
) -> None:
    while True:
        found = [publication.topic for publication in participant.publications()]
        counts = {topic: found.count(_dds_name(topic)) for topic in topics}
        events.report(Kind.SEEN, " ".join(sorted(set(found))), publishers=counts)
        _say("observer", f"Publishers: {counts}; topics: {' '.join(sorted(set(found)))}")
        time.sleep(period)


def _dds_name(topic: str) -> str:
    """The DDS topic of a ROS topic of a node in the namespace "/"."""
    return f"rt/{topic.removeprefix('/')}"


def _enclave_in(ros_arguments: Sequence[str]) -> str:
    enclave = "/"
    for flag, value in itertools.pairwise(ros_arguments):
        if flag in ("-e", "--enclave"):
            enclave = value
    return enclave


def _say(role: str, text: str) -> None:
    print(f"[{role}] {text}", file=sys.stderr, flush=True)


def _stop_on_signals() -> None:
    def stop(_number: int, _frame: FrameType | None) -> None:
        raise _Stopped

    handler: Callable[[int, FrameType | None], None] = stop
    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


if __name__ == "__main__":
    sys.exit(main())
