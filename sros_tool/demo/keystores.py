"""Make the two keystores of the demo from the shipped policy: the robot's, and a stranger's."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.scenarios import Identity
from sros_tool.errors import UsageError
from sros_tool.keystore import create_keystore, generate_artifacts
from sros_tool.keystore.template import Template
from sros_tool.policy import Enclave, Group, Policy, Profile, read_policy
from sros_tool.resources import policies_dir
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.stacks import ProbeEnclave

DEFAULT_TOPIC = "/chatter"
DENIED_TOPIC = "/sros_not_allowed"
"""A topic that no enclave of the demo may use."""

_POLICY_FILE = "talker_listener.xml"
_POLICY_TOPIC = "chatter"
_TALKER, _LISTENER = "/talker_listener/talker", "/talker_listener/listener"
_TALKER_DENIED = "/talker_listener/talker_without_permission"
_LISTENER_DENIED = "/talker_listener/listener_without_permission"
_ENCLAVES = {
    Identity.TALKER: _TALKER,
    Identity.LISTENER: _LISTENER,
    Identity.TALKER_DENIED: _TALKER_DENIED,
    Identity.LISTENER_DENIED: _LISTENER_DENIED,
    Identity.FOREIGN_TALKER: _TALKER,
    Identity.FOREIGN_LISTENER: _LISTENER,
}
_FOREIGN = (Identity.FOREIGN_TALKER, Identity.FOREIGN_LISTENER)

_ROS_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_LONGEST_TOPIC = 200
_EVERY_NODE_MAY = ("/rosout", "/parameter_events", "/clock", DENIED_TOPIC)


@dataclass(frozen=True)
class DemoKeystores:
    """Where the two keystores are."""

    own: Path
    foreign: Path

    def environment(self, identity: Identity, domain: int) -> Mapping[str, str]:
        """The ROS_SECURITY_* variables and ROS_DOMAIN_ID of a process with that identity."""
        if identity is Identity.NONE:
            return {"ROS_DOMAIN_ID": str(domain)}
        root = self.foreign if identity in _FOREIGN else self.own
        return secured_environment(root, _ENCLAVES[identity], domain)

    def probe(self, topic: str, domain: int) -> ProbeEnclave:
        """What to ask a DDS in order to find out whether it enforces security."""
        return ProbeEnclave(self.environment(Identity.TALKER, domain), topic, DENIED_TOPIC)


def check_topic(topic: str) -> str:
    """The absolute form of a topic name for the demo.  Raises `UsageError`."""
    if len(topic) > _LONGEST_TOPIC or not _ROS_TOPIC.match(topic):
        raise UsageError(
            f"{topic!r} is not a topic name that the demo can use",
            "It must be made of letters, digits and underscores, in parts joined by '/', none of"
            f" which starts with a digit, and have at most {_LONGEST_TOPIC} characters.",
            "Use a name such as /chatter or /robot/camera.",
        )
    absolute = topic if topic.startswith("/") else f"/{topic}"
    if absolute in _EVERY_NODE_MAY:
        raise UsageError(
            f"the demo cannot use {absolute}",
            "It is one of the topics that a ROS 2 node uses by itself.",
            "Use a name such as /chatter.",
        )
    return absolute


def make_keystores(
    folder: Path, topic: str, domains: DomainSet, template: Template, now: datetime
) -> DemoKeystores:
    """Create both keystores in ``folder``, for an absolute ``topic``.

    Raises what the keystore raises: `KeystoreError` and `OSError` among them.
    """
    policy = demo_policy(topic)
    keystores = DemoKeystores(folder / "keystore", folder / "another_keystore")
    for root in (keystores.own, keystores.foreign):
        create_keystore(root, template=template, domains=domains, now=now)
        generate_artifacts(root, policies=[policy], now=now)
    return keystores


def demo_policy(topic: str) -> Policy:
    """The shipped policy, for ``topic``, and the two enclaves that are not allowed it."""
    shipped = read_policy(policies_dir() / _POLICY_FILE)
    by_path = {enclave.path: enclave for enclave in shipped.enclaves}
    talker, listener = by_path[_TALKER], by_path[_LISTENER]
    return replace(
        shipped,
        enclaves=(
            _with_topic(talker, topic),
            _with_topic(listener, topic),
            replace(_with_topic(talker, None), path=_TALKER_DENIED),
            replace(_with_topic(listener, None), path=_LISTENER_DENIED),
        ),
    )


def _with_topic(enclave: Enclave, topic: str | None) -> Enclave:
    """The enclave with ``topic`` in place of the shipped policy's, or without either."""

    def of_group(group: Group) -> Group | None:
        if group.kind != "topics" or _POLICY_TOPIC not in group.names:
            return group
        return None if topic is None else replace(group, names=(topic,))

    def of_profile(profile: Profile) -> Profile:
        groups = (of_group(group) for group in profile.groups)
        return replace(profile, groups=tuple(group for group in groups if group is not None))

    blocks = (
        replace(block, profiles=tuple(of_profile(profile) for profile in block.profiles))
        for block in enclave.profiles
    )
    return replace(enclave, profiles=tuple(blocks))
