"""Run ordinary rclpy nodes: start, report, spin, and end quietly on Ctrl-C or SIGTERM."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from sros_tool.demo.nodes.options import NodeOptions
from sros_tool.runtime.events import EventWriter, Kind, Stage

_LOG_FLUSH_SECONDS = 0.3
"""Fast DDS logs from a thread of its own: a process that ends at once loses the reason."""

Build = Callable[[Any, EventWriter], Sequence[Any] | None]
"""Adds a node's publishers, subscriptions and timers; returns further nodes of the process."""


def run_ros_node(name: str, options: NodeOptions, arguments: Sequence[str], build: Build) -> int:
    """Create the node ``name``, let ``build`` add its endpoints, and spin until told to stop.

    ``arguments`` is the whole command line, from which rclpy takes its ``--ros-args``.  Returns
    the exit status.
    """
    events = EventWriter(options.report)
    try:
        import rclpy
    except ImportError as error:
        return _fail(name, error, Stage.IMPORT, events)
    stage = Stage.PARTICIPANT
    nodes: list[Any] = []
    joined = False
    try:
        rclpy.init(args=list(arguments))
        joined = True
        nodes.append(rclpy.create_node(name))
        stage = Stage.ENDPOINT
        nodes += build(nodes[0], events) or ()
        stage = Stage.RUNNING
        events.report(Kind.READY)
        _spin(nodes)
    except KeyboardInterrupt:
        pass
    except ImportError as error:
        return _fail(name, error, Stage.IMPORT, events)
    except Exception as error:
        # A signal ends the context, and what is being made then fails by that.
        if rclpy.ok() or not joined:
            return _fail(name, error, stage, events)
    finally:
        # Leaves the domain, and nothing in shared memory; what is half made may well complain.
        with suppress(Exception):
            for node in nodes:
                node.destroy_node()
            rclpy.try_shutdown()
    events.report(Kind.DONE)
    return 0


def _spin(nodes: Sequence[Any]) -> None:
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    try:
        executor.spin()
    except ExternalShutdownException:
        pass
    except Exception:
        # A signal may end the context in the middle of a callback; that is no failure.
        if rclpy.ok():
            raise


def _fail(name: str, error: Exception, stage: Stage, events: EventWriter) -> int:
    reason = f"{type(error).__name__}: {error}"
    time.sleep(_LOG_FLUSH_SECONDS)
    sys.stdout.flush()
    events.report(Kind.FAILED, reason, stage=stage)
    print(f"{name}: failed at stage {stage.value}: {reason}", file=sys.stderr)
    return 1
