"""ROS names: their grammar, the expansion of a policy's names, and the names of ROS itself.

Sources: ROS 2 design "Topic and Service Names" and "Actions"; rcl's ``validate_topic_name`` and
``rmw_validate_namespace``.
"""

from __future__ import annotations

import re

from sros_tool.errors import InvalidNameError

MAX_COMMON_NAME = 64
"""Longest enclave name in characters: the limit of an X.509 common name (RFC 5280)."""

ROS_DISCOVERY_TOPIC = "ros_discovery_info"
"""The DDS topic by which every ROS 2 participant announces its nodes (rmw_dds_common)."""

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

ACTION_INSIDE = "/_action/"
"""Separates the name of an action from the names of its services and topics."""

ACTION_SERVICES = ("cancel_goal", "get_result", "send_goal")
"""The services that an action consists of (ROS 2 design "Actions")."""

ACTION_TOPICS = ("feedback", "status")
"""The topics that an action consists of; the server publishes them.

`keystore/issuing/proof.py` has its own list of these parts on purpose: a proof that used this list
could not find an error in it.
"""

# Most names need no further check: relative, private or absolute, without wildcards.
_PLAIN = re.compile(r"(?:~?/)?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_WILDCARDS = frozenset("*?[")
# One segment of a name in a policy: the letters of a ROS name, * ? and plain [sets].
_EXPRESSION = re.compile(
    r"(?:~(?=/|\Z))?(?:[A-Za-z0-9_/*?]|\[!?[A-Za-z0-9_/]+(?:-[A-Za-z0-9_]+)*\])*\Z"
)
_RANGE = re.compile(r"(.)-(.)")


def check_enclave_name(name: str) -> str:
    """Return ``name`` if it is a valid enclave name, else raise `InvalidNameError`.

    An enclave name is absolute, has the grammar of a ROS namespace, and fits into the common
    name of a certificate.
    """
    problem = _enclave_problem(name)
    if problem:
        raise InvalidNameError(
            f"{name!r} is not a valid enclave name",
            problem,
            "Use an absolute name of letters, digits and underscores, such as /robot/camera.",
        )
    return name


def _enclave_problem(name: str) -> str:
    if not name:
        return "It is empty."
    if not name.startswith("/"):
        return "It does not start with '/'."
    if len(name) > MAX_COMMON_NAME:
        return (
            f"It has {len(name)} characters, and the common name of an X.509 certificate holds "
            f"{MAX_COMMON_NAME}."
        )
    if name == "/":
        return ""
    if name.endswith("/"):
        return "It ends with '/'."
    for token in name[1:].split("/"):
        if not token:
            return "It contains '//'."
        if not _TOKEN.match(token):
            if token[0].isdigit() and token.isalnum():
                return f"Its part {token!r} starts with a digit."
            return f"Its part {token!r} is not made of letters, digits and underscores."
    return ""


def is_expression(name: str) -> bool:
    """Return whether ``name`` holds a wildcard."""
    return not _WILDCARDS.isdisjoint(name)


def expression_problem(text: str) -> str:
    """Return why ``text`` cannot name a topic, service or action in a policy; "" if it can.

    Allowed are relative, private (``~``, ``~/x``) and absolute ROS names, with the wildcards
    ``*``, ``?``, ``[abc]``, ``[a-c]`` and ``[!a-c]``, which every DDS vendor reads alike.
    """
    if _PLAIN.match(text):
        return ""
    if not text:
        return "It is empty."
    if text != text.strip() or any(c.isspace() for c in text):
        return "It contains white space, which no ROS name has."
    if text[0] == "~" and len(text) > 1 and text[1] != "/":
        return "After '~' there must be a '/', as in ~/get_parameters."
    if "[^" in text or "[:" in text:
        return "DDS vendors disagree about [^...] and [:class:]; [!...] and plain sets work alike."
    if not _EXPRESSION.match(text):
        return "It contains a character that no ROS name has."
    if any(first > last for first, last in _RANGE.findall(text)):
        return "It contains a range of characters that runs backwards."
    if "//" in text:
        return "It contains '//'."
    if text.endswith("/"):
        return "It ends with '/'."
    for token in text.split("/"):
        if token and token[0].isdigit() and not is_expression(token):
            return f"Its part {token!r} starts with a digit."
    return ""


def check_namespace(ns: str) -> str:
    """Return the namespace of a profile, normalised, else raise `InvalidNameError`.

    "" stands for "/", one trailing slash is dropped; wildcards are allowed.
    """
    text = ns if ns == "/" else ns.removesuffix("/")
    if not text:
        return "/"
    problem = "" if ns == "/" else expression_problem(text)
    if not problem and text[0] not in "/*":
        problem = "A namespace starts with '/'."
    if problem:
        raise InvalidNameError(f"{ns!r} is not a valid namespace", problem, "")
    return text


def expand(name: str, ns: str, node: str) -> str:
    """Return the absolute name of ``name`` used by ``node`` in ``ns``.

    ``/x`` stays; ``~`` and ``~/x`` become ns/node and ns/node/x; anything else ns/name.
    """
    if name.startswith("/"):
        return name
    prefix = ns if ns.endswith("/") else ns + "/"
    if name.startswith("~"):
        return f"{prefix}{node}{name[1:]}"
    return prefix + name


def action_part(name: str) -> tuple[str, str]:
    """Return the action of a service or topic, and the part that it is; "" if it is not a part."""
    action, _, part = name.rpartition(ACTION_INSIDE)
    return (action, part) if part in (*ACTION_SERVICES, *ACTION_TOPICS) else ("", "")
