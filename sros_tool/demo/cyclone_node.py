"""One node over Cyclone DDS, in any role: ``python -m sros_tool.demo.cyclone_node``.

The nodes read the same environment as a ROS 2 node and speak on the same DDS topics with the same
type, so that rclpy nodes hear them, and a launcher need not know which kind it starts.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType

from sros_tool.demo.cyclone_roles import ROLES, Observer, run
from sros_tool.demo.options import option_parser, options_of, split_ros_args
from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import Participant, SecurityRefusedError
from sros_tool.runtime.events import EventWriter, Kind, Stage
from sros_tool.runtime.rcl_security import choose_loadable, domain_of


class _Stopped(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Play a role until told to stop; returns the exit status."""
    own, ros = split_ros_args(sys.argv[1:] if arguments is None else arguments)
    parser = option_parser("sros_tool.demo.cyclone_node", "Play a role over Cyclone DDS.")
    parser.add_argument("role", choices=tuple(ROLES))
    parser.add_argument("--also", action="append", default=[], help="one more topic to look at")
    parsed = parser.parse_args(own)
    options = options_of(parsed, parsed.role)
    _stop_on_signals()
    events = EventWriter(options.report)
    stage = Stage.PARTICIPANT
    try:
        choice = choose_loadable(os.environ, _enclave_in(ros))
        _say(parsed.role, choice.note)
        with Participant(domain_of(os.environ), choice.enclave) as participant:
            stage = Stage.ENDPOINT
            node = (
                Observer(participant, options, events, parsed.also)
                if parsed.role == "observer"
                else ROLES[parsed.role](participant, options, events)
            )
            stage = Stage.RUNNING
            events.report(Kind.READY)
            run(node)
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
