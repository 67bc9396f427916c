"""The releases of rmw_zenoh in the supported ROS 2 distributions, and their additional keys.

The files that sros writes work with all of these releases.  Source: ros2/rmw_zenoh, its changelogs,
rmw_publisher_data.cpp and rmw_subscription_data.cpp.
"""

from __future__ import annotations

from typing import NamedTuple

_LEAST_ZENOH = "1.3"
"""First version of Zenoh that accepts all settings of the files.

rmw_zenoh 0.2.3 has a slightly earlier version.
"""

Version = tuple[int, int, int]


class RmwZenohRelease(NamedTuple):
    """The versions of rmw_zenoh_cpp in a ROS 2 distribution, from ``begin`` on.

    ``least`` is the first version that has `_LEAST_ZENOH` and reads ZENOH_CONFIG_OVERRIDE.
    ``below_topics`` are key expressions below the key of a topic.  If a publisher sees the graph
    tokens of subscriptions, it sends to these subscriptions on these keys, in addition to the key
    of the topic or instead of it.
    """

    distribution: str
    begin: Version
    least: Version
    below_topics: tuple[str, ...] = ()


_BUFFER_KEYS = ("_buf_cpu", "_buf/*")
"""Keys for messages with an array of bytes (images, point clouds) between C++ nodes.

All subscriptions in main memory share ``_buf_cpu``; every subscription on an accelerator has a
separate key.
"""

RELEASES = (
    RmwZenohRelease("Humble", (0, 1, 0), (0, 1, 2)),
    RmwZenohRelease("Jazzy", (0, 2, 0), (0, 2, 3)),
    RmwZenohRelease("Kilted", (0, 3, 0), (0, 6, 0)),
    RmwZenohRelease("Lyrical", (0, 7, 0), (0, 7, 0), _BUFFER_KEYS),
)
"""All supported releases, earliest first; Rolling's versions count for the next distribution."""


def release_of(version: Version) -> RmwZenohRelease:
    """Return the latest release that begins at or before a version; otherwise the first release."""
    begun = (release for release in reversed(RELEASES) if release.begin <= version)
    return next(begun, RELEASES[0])


def why_too_old(version: Version) -> str:
    """Return a clause on why the files of sros do not work with a version of rmw_zenoh, or ""."""
    release = release_of(version)
    if version >= release.least:
        return ""
    return (
        f"Files that sros writes need Zenoh {_LEAST_ZENOH} and ZENOH_CONFIG_OVERRIDE, which "
        f"rmw_zenoh_cpp has since {version_text(release.least)} (ROS 2 {release.distribution})."
    )


def version_text(version: Version) -> str:
    """Return a version as text, such as "0.2.3"."""
    return ".".join(map(str, version))
