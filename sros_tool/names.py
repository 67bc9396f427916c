"""ROS names: their grammar, their expansion in a policy, and the DDS topics that they become.

This module is imported by every node of the demo, and imports little.

Sources: ROS 2 design "Topic and Service Names" and "Actions"; rcl's ``validate_topic_name`` and
``rmw_validate_namespace``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from sros_tool.errors import InvalidNameError

MAX_COMMON_NAME = 64
"""Longest enclave name in characters: the limit of an X.509 common name (RFC 5280)."""

ROS_DISCOVERY_TOPIC = "ros_discovery_info"
"""The DDS topic on which every ROS 2 participant announces its nodes (rmw_dds_common)."""

PARAMETER_SERVICES = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)
"""The services that a node offers for its parameters, as ``~/NAME`` (rclcpp, rclpy)."""

NODE_SERVICES = (*PARAMETER_SERVICES, "get_type_description")
"""All services that a node of ROS 2 Jazzy offers under its own name, as ``~/NAME``."""

GLOBAL_TOPICS = frozenset(
    ("/bond", "/clock", "/diagnostics", "/parameter_events", "/rosout", "/tf", "/tf_static")
)
"""Topics that packages use with a leading slash, so that they stay the same in any namespace."""

_NODE_SERVICE = re.compile(rf"(?P<node>/.+)/(?:{'|'.join(NODE_SERVICES)})\Z")


def node_of_service(service: str) -> str:
    """Return the full name of the node that offers a service.

    The result is "" for services that are not in `NODE_SERVICES`.
    """
    match = _NODE_SERVICE.match(service)
    return match["node"] if match else ""


def nodes_served(rights: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    """Return the full names of the nodes whose standard services ``rights`` (right, name) serve."""
    nodes = {node_of_service(name) for right, name in rights if right == "reply"}
    return tuple(sorted(nodes - {""}))


READING_SERVICES = (
    "_container/list_nodes",
    "describe_parameters",
    "get_available_states",
    "get_available_transitions",
    "get_logger_levels",
    "get_parameter_types",
    "get_parameters",
    "get_state",
    "get_transition_graph",
    "get_type_description",
    "list_parameters",
)
"""Services of nodes, as ``~/NAME``, that answer questions and change nothing.

Sources: rcl_interfaces, lifecycle_msgs, composition_interfaces and type_description_interfaces.
"""
_READING_SUFFIXES = tuple(f"/{name}" for name in READING_SERVICES)


def only_reads(service: str) -> bool:
    """Return whether a service is one of `READING_SERVICES`, of whatever node."""
    return service.endswith(_READING_SUFFIXES)


DISTRIBUTIONS = (
    "ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble", "iron",
    "jazzy", "kilted", "lyrical", "rolling",
)  # fmt: skip
"""The ROS 2 distributions, in the order of their release; rolling is always the latest."""

ACTION_SEPARATOR = "/_action/"
"""Separates the name of an action from the names of its services and topics."""

ACTION_SERVICES = ("cancel_goal", "get_result", "send_goal")
"""The services of an action (ROS 2 design "Actions")."""

ACTION_TOPICS = ("feedback", "status")
"""The topics of an action; the server publishes them.

`keystore/issuing/proof.py` repeats these names on purpose: a proof that used this list could not
find an error in it.
"""

# Most names need no further check: relative, private or absolute, without wildcards.
_PLAIN = re.compile(r"(?:~?/)?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
# A name in a policy: the characters of ROS names, ``*``, ``?`` and plain [sets].
_EXPRESSION = re.compile(
    r"(?:~(?=/|\Z))?(?:[A-Za-z0-9_/*?]|\[!?[A-Za-z0-9_/]+(?:-[A-Za-z0-9_]+)*\])*\Z"
)
_SET_RANGE = re.compile(r"(.)-(.)")
_MAX_NAMESPACE = 245
"""Maximum length of a node's namespace, in characters (RMW_NAMESPACE_MAX_LENGTH)."""
_MAX_NODE_NAME = 255
"""Maximum length of a node's name, in characters (RMW_NODE_NAME_MAX_NAME_LENGTH)."""
_MAX_EXPRESSION = 2000  # characters; the names that an expression can match have at most 255


def distribution_problem(name: str) -> str:
    """Return why ``name`` is not a ROS 2 distribution, as a sentence; "" if it is one."""
    if name in DISTRIBUTIONS:
        return ""
    return f"It is not a ROS 2 distribution that sros knows: {', '.join(DISTRIBUTIONS)}."


def has_type_descriptions(distribution: str) -> bool:
    """Return whether nodes of a ROS 2 distribution offer ``~/get_type_description``.

    Nodes do since Iron (its update of July 2023: rcl 6.0.3, rclcpp 21.0.2, rclpy 4.1.2), and in a
    distribution that sros does not know.
    """
    known = DISTRIBUTIONS
    return distribution not in known or known.index(distribution) >= known.index("iron")


def check_enclave_name(name: str) -> str:
    """Return ``name`` if it is a valid enclave name, else raise `InvalidNameError`.

    An enclave name is absolute, has the grammar of a ROS namespace, and fits into the common
    name of an X.509 certificate.
    """
    problem = _enclave_problem(name)
    if problem:
        remedy = "Use an absolute name of letters, digits and underscores, such as /robot/camera."
        if is_expression(name) and re.fullmatch(r"[\w/*?]+", name, re.ASCII):
            remedy += f" Verbs that take several enclaves also have --match '{name}'."
        raise InvalidNameError(f"{name!r} is not a valid enclave name", problem, remedy)
    return name


def _enclave_problem(name: str) -> str:
    if name.startswith("/") and len(name) > MAX_COMMON_NAME:
        return (
            f"It has {len(name)} characters, but the common name of an X.509 certificate has at "
            f"most {MAX_COMMON_NAME}."
        )
    return namespace_problem(name)


def namespace_problem(namespace: str) -> str:
    """Return why ROS would refuse the namespace of a node, as a sentence; "" if it is valid.

    Wildcards are not allowed.  Source: rmw_validate_namespace.
    """
    if not namespace:
        return "It is empty."
    if not namespace.startswith("/"):
        return "It does not start with '/'."
    if len(namespace) > _MAX_NAMESPACE:
        return f"It has {len(namespace)} characters, more than {_MAX_NAMESPACE}."
    if namespace == "/":
        return ""
    if namespace.endswith("/"):
        return "It ends with '/'."
    for token in namespace[1:].split("/"):
        if not token:
            return "It contains '//'."
        if not _TOKEN.match(token):
            if token[0].isdigit() and token.isalnum():
                return f"Its part {token!r} starts with a digit."
            return f"Its part {token!r} has a character other than letters, digits and underscores."
    return ""


_MOVES = re.compile(r"(^|/)(cmd_vel|[^/]*commands?\Z|joint_trajectory|follow_joint_trajectory)")


def moves_robot(name: str) -> bool:
    """Return whether a name, such as /cmd_vel, is usual for commands that move a robot.

    ``MOVES`` in web/src/table.js is the same pattern.
    """
    return bool(_MOVES.search(name))


def is_expression(name: str) -> bool:
    """Return whether ``name`` contains a wildcard: ``*``, ``?`` or ``[``."""
    return "*" in name or "?" in name or "[" in name


def expression_problem(text: str) -> str:
    """Return why ``text`` is not a valid name in a policy, as a sentence; "" if it is valid.

    Relative, private (``~``, ``~/x``) and absolute ROS names are valid, with the wildcards ``*``,
    ``?``, ``[abc]``, ``[a-c]`` and ``[!a-c]``, which all DDS vendors interpret alike.
    """
    if len(text) > _MAX_EXPRESSION:
        return f"It has {len(text)} characters, more than {_MAX_EXPRESSION}."
    if _PLAIN.match(text):
        return ""
    if not text:
        return "It is empty."
    if text != text.strip() or any(c.isspace() for c in text):
        return "It contains white space, which is not allowed in ROS names."
    if text[0] == "~" and len(text) > 1 and text[1] != "/":
        return "After '~' there must be a '/', as in ~/get_parameters."
    if "[^" in text or "[:" in text:
        return "DDS vendors interpret [^...] and [:class:] differently; write [!...] or [abc]."
    if not _EXPRESSION.match(text):
        return "It contains a character that is not allowed in ROS names."
    if any(first > last for first, last in _SET_RANGE.findall(text)):
        return "It contains a range of characters in reverse order: write for example [a-z]."
    if "//" in text:
        return "It contains '//'."
    if text.endswith("/"):
        return "It ends with '/'."
    for token in text.split("/"):
        if token and token[0].isdigit() and not is_expression(token):
            return f"Its part {token!r} starts with a digit."
    return ""


def check_namespace(ns: str) -> str:
    """Return the normalized namespace of a profile; raise `InvalidNameError` if it is not valid.

    "" becomes "/", as in rcl.  One trailing slash is dropped, as in ros2/sros2 (permissions.xsl),
    though a node cannot have it (rmw_validate_namespace).  Wildcards are allowed.
    """
    text = ns if ns == "/" else ns.removesuffix("/")
    if not text:
        return "/"
    problem = "" if ns == "/" else expression_problem(text)
    if not problem and text[0] not in "/*":
        problem = "A namespace starts with '/'."
    if not problem and len(text) > _MAX_NAMESPACE and not is_expression(text):
        problem = f"It has {len(text)} characters, more than {_MAX_NAMESPACE}."
    if problem:
        raise InvalidNameError(f"{ns!r} is not a valid namespace", problem, "")
    return text


def check_plain_namespace(ns: str) -> str:
    """Return a normalized namespace as `check_namespace` does; refuse wildcards, too."""
    if is_expression(ns):
        raise InvalidNameError(
            f"the namespace {ns!r} has a wildcard", "", "Write a namespace such as /left."
        )
    return check_namespace(ns)


def node_name_problem(name: str) -> str:
    """Return why ROS would refuse the name of a node, as a sentence; "" if it is valid.

    Wildcards are allowed.  Source: rmw_validate_node_name.
    """
    if problem := expression_problem(name):
        return problem
    if "/" in name or "~" in name:
        return "A node name has no '/' and no '~'; the namespace of the node goes into ns=."
    if len(name) > _MAX_NODE_NAME and not is_expression(name):
        return f"It has {len(name)} characters, more than {_MAX_NODE_NAME}."
    return ""


def expand(name: str, ns: str, node: str) -> str:
    """Return the absolute form of ``name`` as used by ``node`` in the namespace ``ns``.

    ``/x`` is unchanged, ``~`` becomes ``ns/node``, ``~/x`` becomes ``ns/node/x``, and ``x`` becomes
    ``ns/x``.
    """
    if name.startswith("/"):
        return name
    prefix = ns if ns.endswith("/") else ns + "/"
    if name.startswith("~"):
        return f"{prefix}{node}{name[1:]}"
    return prefix + name


def has_parts(text: str, parts: Sequence[str]) -> bool:
    """Return whether ``text`` matches the expression with ``parts`` separated by ``*``.

    There are at least two parts.
    """
    first, *middle, last = parts
    at, end = len(first), len(text) - len(last)
    if end < at or not text.startswith(first) or not text.endswith(last):
        return False
    for part in middle:
        at = text.find(part, at, end)
        if at < 0:
            return False
        at += len(part)
    return True


def action_part(name: str) -> tuple[str, str]:
    """Return the action that a service or topic belongs to, and which part it is.

    The part is a name such as ``send_goal``.  Both are "" if ``name`` belongs to no action.
    """
    action, _, part = name.rpartition(ACTION_SEPARATOR)
    return (action, part) if action and part in (*ACTION_SERVICES, *ACTION_TOPICS) else ("", "")


ACTION_PARTS: dict[str, tuple[tuple[str, str], ...]] = {
    action: tuple(
        [(of_services, f"{ACTION_SEPARATOR}{service}") for service in ACTION_SERVICES]
        + [(of_topics, f"{ACTION_SEPARATOR}{topic}") for topic in ACTION_TOPICS]
    )
    for action, of_services, of_topics in (
        ("call", "request", "subscribe"),
        ("execute", "reply", "publish"),
    )
}
"""The parts of a right to an action: pairs of a right and a suffix of the action's name."""

GOAL = f"{ACTION_SEPARATOR}send_goal"
"""Suffix of the service that identifies an action: ``NAME/_action/send_goal``."""

SERVICE_ENDS = {"rq": "Request", "rr": "Reply"}
"""Prefix and suffix of the DDS topics of a service: requests and replies."""

_TOPIC_AFFIXES = ("rt", "")
_REQUESTS, _REPLIES = SERVICE_ENDS.items()
_Ends = tuple[tuple[str, str], ...]
TOPIC_ENDS: dict[str, tuple[_Ends, _Ends]] = {
    "publish": ((_TOPIC_AFFIXES,), ()),
    "subscribe": ((), (_TOPIC_AFFIXES,)),
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


_RIGHTS_TO_USE = {
    "rt": ("publish", "subscribe"),
    "rq": ("request", "reply"),
    "rr": ("reply", "request"),
}
"""DDS topic prefix → the ROS rights to write and to read topics with this prefix."""


def right_to_use(topic: str, *, writes: bool) -> tuple[str, str]:
    """Return the ROS right to write (or read) a DDS topic, and its ROS name.

    For a topic that belongs to no ROS name, the right is "", and the name is the topic.
    """
    service, begin = service_of(topic)
    name = service or (topic[2:] if topic.startswith("rt/") else "")
    if not name:
        return "", topic
    return _RIGHTS_TO_USE[begin or "rt"][not writes], name
