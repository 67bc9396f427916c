"""The policies of the demo's enclaves: shipped policies with the demo's topic."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Final

from sros_tool.errors import UsageError
from sros_tool.files import policies_dir
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave, Group, Policy, Profile

DEFAULT_TOPIC: Final = "/chatter"
DENIED_TOPIC: Final = "/sros_not_allowed"
"""A topic that no enclave of the demo may use."""

_POLICY_FILE = "talker_listener.xml"
_POLICY_TOPIC = "chatter"
_TALKER, _LISTENER = "/talker_listener/talker", "/talker_listener/listener"
_WITHOUT = "_without_permission"
GUEST: Final = "/talker_listener/guest"
_GUEST_TOPIC: Final = "/guest_book"
SERVICE: Final = "/add_two_ints"
ACTION: Final = "/fibonacci"

_ROS_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_MAX_TOPIC_LENGTH = 200
_TOPICS_OF_EVERY_NODE = ("/rosout", "/parameter_events", "/clock", DENIED_TOPIC)


def check_topic(topic: str) -> str:
    """Return the absolute form of a ROS topic name for the demo.

    Raises:
        UsageError: the demo cannot use it.
    """
    if len(topic) > _MAX_TOPIC_LENGTH or not _ROS_TOPIC.match(topic):
        raise UsageError(
            f"{topic!r} is not a topic name that the demo can use",
            "It must be made of letters, digits and underscores, in parts joined by '/', none of"
            f" which starts with a digit, and have at most {_MAX_TOPIC_LENGTH} characters.",
            "Use a name such as /chatter or /robot/camera.",
        )
    absolute = topic if topic.startswith("/") else f"/{topic}"
    if absolute in _TOPICS_OF_EVERY_NODE:
        raise UsageError(
            f"the demo cannot use {absolute}",
            "Every ROS 2 node, or the demo itself, uses this topic.",
            "Use a name such as /chatter.",
        )
    return absolute


def _shipped_policy(file: str) -> Policy:
    """Return a policy that ships with sros."""
    return read_policy(policies_dir() / file)


def talking_policy(topic: str) -> Policy:
    """Return the shipped talker and listener on ``topic``, and one of each without that right."""
    shipped = _shipped_policy(_POLICY_FILE)
    by_path = {enclave.path: enclave for enclave in shipped.enclaves}
    talker, listener = by_path[_TALKER], by_path[_LISTENER]
    return replace(
        shipped,
        enclaves=(
            _with_topic(talker, topic),
            _with_topic(listener, topic),
            replace(_with_topic(talker, None), path=f"{_TALKER}{_WITHOUT}"),
            replace(_with_topic(listener, None), path=f"{_LISTENER}{_WITHOUT}"),
        ),
    )


def attacked_policy(topic: str) -> Policy:
    """Return a policy with talker, listener, a service, a guest and an admin.

    The guest may use neither the topic nor the service.  The admin may publish the topic, and its
    enclave name contains the guest's.
    """
    talking = talking_policy(topic)
    talker = next(
        enclave for enclave in _shipped_policy(_POLICY_FILE).enclaves if enclave.path == _TALKER
    )
    guest = replace(_with_topic(talker, _GUEST_TOPIC), path=GUEST)
    guests = (guest, replace(_with_topic(talker, topic), path=f"{GUEST}/admin"))
    service = _shipped_policy("add_two_ints.xml").enclaves
    allowed = tuple(enclave for enclave in talking.enclaves if not enclave.path.endswith(_WITHOUT))
    return replace(talking, enclaves=(*allowed, *guests, *service))


def zenoh_policy(topic: str, *, guest_talks: bool = False, silent: str = "") -> Policy:
    """Return the policy of the demo on Zenoh: `attacked_policy` and an action.

    With ``guest_talks``, the guest may use the topic as talker and as listener; the enclave
    ``silent`` may not use it.  The guest's node has a name of its own.
    """
    attacked = attacked_policy(topic)
    of = {enclave.path: enclave for enclave in attacked.enclaves}
    of[GUEST] = of[GUEST].with_profiles(lambda profile: replace(profile, node="guest"))
    if guest_talks:
        of[GUEST] = replace(of[GUEST], profiles=(*of[_TALKER].profiles, *of[_LISTENER].profiles))
    if silent:
        of[silent] = _with_topic(of[silent], None, topic)
    return replace(attacked, enclaves=(*of.values(), *shipped_action_policy(topic).enclaves))


def shipped_service_policy(_topic: str) -> Policy:
    """Return the shipped policy of a service; the topic does not matter."""
    return _shipped_policy("add_two_ints.xml")


def shipped_action_policy(_topic: str) -> Policy:
    """Return the shipped policy of an action; the topic does not matter."""
    return _shipped_policy("fibonacci.xml")


def composed_policy(topic: str) -> Policy:
    """Return the shipped policies of a container, and of the nodes that it talks to."""
    talking = talking_policy(topic)
    container = (
        _with_topic(enclave, topic) for enclave in _shipped_policy("composition.xml").enclaves
    )
    service = shipped_service_policy(topic).enclaves
    return replace(talking, enclaves=(*talking.enclaves, *container, *service))


def _with_topic(enclave: Enclave, topic: str | None, before: str = _POLICY_TOPIC) -> Enclave:
    """Return the enclave with ``topic`` in place of ``before`` (None: remove ``before``)."""

    def of_group(group: Group) -> Group | None:
        if group.kind != "topics" or before not in group.names:
            return group
        return None if topic is None else replace(group, names=(topic,))

    def of_profile(profile: Profile) -> Profile:
        groups = (of_group(group) for group in profile.groups)
        return replace(profile, groups=tuple(group for group in groups if group is not None))

    return enclave.with_profiles(of_profile)
