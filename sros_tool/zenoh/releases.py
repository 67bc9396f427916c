"""The releases of rmw_zenoh that supported distributions of ROS 2 have: what each one adds.

Files that sros writes are for all of them.
Source: ros2/rmw_zenoh, its changelogs, rmw_publisher_data.cpp and rmw_subscription_data.cpp.
"""

from __future__ import annotations

from typing import NamedTuple


class _Release(NamedTuple):
    """A series of versions of rmw_zenoh_cpp.

    ``below_topics`` are the key expressions, below the key of a topic, on which its messages are
    sent too, or instead.
    """

    distribution: str
    series: tuple[int, int]
    below_topics: tuple[str, ...] = ()


_BUFFERS = ("_buf_cpu", "_buf/*")
"""Messages with an array of bytes (images, point clouds) between publishers and subscriptions of
C++: one key for all subscriptions in main memory, and one for each of those on accelerators."""

RELEASES = (
    _Release("Humble", (0, 1)),
    _Release("Jazzy", (0, 2)),
    _Release("Kilted", (0, 6)),
    _Release("Lyrical", (0, 10), _BUFFERS),
)
"""All that are supported, the earliest first."""
