"""How a learned policy writes names: relative where that serves, and not those of one run."""

from __future__ import annotations

import re

from sros_tool.names import expand

_CHANGING = (
    # tf2_ros names the node of a listener by its address; the others by their process.
    (re.compile(r"(transform_listener_impl_)[0-9a-f]+\Z"), r"\1*"),
    (re.compile(r"(launch_ros_)[0-9]+\Z"), r"\1*"),
    (re.compile(r"(rqt_gui_(?:py|cpp)_node_)[0-9]+\Z"), r"\1*"),
)
_TOOLS = re.compile(r"_ros2cli(_.*)?\Z|_sros_observer\Z")

_ABSOLUTE = frozenset(
    ("/bond", "/clock", "/diagnostics", "/parameter_events", "/rosout", "/tf", "/tf_static")
)
"""Names that packages write with a leading slash, so that a namespace does not change them."""


def is_tool(name: str) -> bool:
    """Whether a node is that of a tool that looks at the robot, and no part of it."""
    return _TOOLS.match(name) is not None


def stable_name(name: str) -> str:
    """The node's name, with ``*`` for a part that is another one each time that it starts."""
    for pattern, stable in _CHANGING:
        if pattern.match(name):
            return pattern.sub(stable, name)
    return name


def written(fqn: str, ns: str, node: str) -> str:
    """How the profile of ``node`` in ``ns`` writes an absolute name; `expand` gives it back.

    ``~/x`` for what is the node's own, ``x`` for what is in its namespace, ``/x`` for the rest.
    In the root namespace only what lies directly in it is relative, as the rest is of others.
    """
    own = expand("~/", ns, node)
    if fqn.startswith(own):
        return "~/" + fqn[len(own) :]
    prefix = "/" if ns == "/" else ns + "/"
    if fqn in _ABSOLUTE or not fqn.startswith(prefix):
        return fqn
    rest = fqn[len(prefix) :]
    if ns == "/" and "/" in re.sub(r"/_(action/\w+|service_event)\Z", "", rest):
        return fqn
    return rest
