"""The DDS topics of ROS names: of topics, services and actions.

This module is imported by every node of the demo, and imports little.
"""

from __future__ import annotations

from typing import NamedTuple

from sros_tool.names import ACTION_SEPARATOR, ACTION_SERVICES, ACTION_TOPICS

ACTION_PARTS: dict[str, tuple[tuple[str, str], ...]] = {
    action: tuple(
        [(of_services, f"{ACTION_SEPARATOR}{each}") for each in ACTION_SERVICES]
        + [(of_topics, f"{ACTION_SEPARATOR}{each}") for each in ACTION_TOPICS]
    )
    for action, of_services, of_topics in (
        ("call", "request", "subscribe"),
        ("execute", "reply", "publish"),
    )
}
"""The parts of a right to an action: pairs of a right and a suffix of the action's name."""

GOAL = f"{ACTION_SEPARATOR}send_goal"
"""The suffix of the service by which an action is recognised."""

SERVICE_ENDS = {"rq": "Request", "rr": "Reply"}
"""Prefix and suffix of the DDS topics of a service: requests and replies."""

_TOPIC = ("rt", "")
_REQUESTS, _REPLIES = SERVICE_ENDS.items()
_Ends = tuple[tuple[str, str], ...]
TOPIC_ENDS: dict[str, tuple[_Ends, _Ends]] = {
    "publish": ((_TOPIC,), ()),
    "subscribe": ((), (_TOPIC,)),
    "request": ((_REQUESTS,), (_REPLIES,)),
    "reply": ((_REPLIES,), (_REQUESTS,)),
}
"""Prefix and suffix of the DDS topics of a right: the written topics, and the read topics."""

TOPIC_ENDS |= {
    action: (
        tuple((begin, inside + end) for part, inside in of for begin, end in TOPIC_ENDS[part][0]),
        tuple((begin, inside + end) for part, inside in of for begin, end in TOPIC_ENDS[part][1]),
    )
    for action, of in ACTION_PARTS.items()
}


class DdsNames(NamedTuple):
    """The DDS topics of one right: the topics to publish, and the topics to subscribe."""

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]


def dds_names(right: str, fqn: str) -> DdsNames:
    """Return the DDS topics that ``right`` on the absolute ROS name ``fqn`` needs.

    ``right`` is publish or subscribe (topics), request or reply (services), call or execute
    (actions).  Source: ROS 2 design "Topic and Service name mapping to DDS".
    """
    written, read = TOPIC_ENDS[right]
    return DdsNames(
        tuple([begin + fqn + end for begin, end in written]),
        tuple([begin + fqn + end for begin, end in read]),
    )


def service_of(topic: str) -> tuple[str, str]:
    """Return the service of a DDS topic, and ``rq`` for a request or ``rr`` for a reply topic.

    Both are "" if the topic does not belong to a service.
    """
    begin, name = topic[:2], topic[2:]
    end = SERVICE_ENDS.get(begin)
    if (
        end is None
        or not name.startswith("/")
        or not name.endswith(end)
        or len(name) < len(end) + 2
    ):
        return "", ""
    return name.removesuffix(end), begin
