"""Which of the conditions that decide attacks hold, by a keystore's template and its DDS vendor."""

from __future__ import annotations

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Protection
from sros_tool.demo.backend import Backend
from sros_tool.demo.model import Condition
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.policy.patterns import matches
from sros_tool.policy.protection import Level
from sros_tool.translate import governance_for

_ENCRYPTING = (Protection.ENCRYPT, Protection.ENCRYPT_WITH_ORIGIN_AUTHENTICATION)
_ENCRYPTED = (Level.ENCRYPT, Level.ENCRYPT_WITH_ORIGIN_AUTHENTICATION)


def conditions(backend: Backend, template: Template, topic: str) -> frozenset[Condition]:
    """What holds on ``backend`` in a keystore made by ``template``, for a ROS topic."""
    protection = template.protection
    found = {
        Condition.ONE_CA: not template.separate_authorities,
        Condition.SHARED_SUBJECTS: not template.unique_subject,
        Condition.OPEN_DEFAULT: template.default_permissions == EVERYTHING,
        Condition.IN_CLEAR: not _encrypted(template, f"rt{topic}"),
        Condition.STRANGERS: protection.allow_unauthenticated_participants,
        Condition.OPEN_DISCOVERY: protection.discovery not in _ENCRYPTED,
    }
    vendor = {backend.vendor} if backend.vendor else set()
    return frozenset(name for name, holds in found.items() if holds) | vendor


def _encrypted(template: Template, dds_topic: str) -> bool:
    """Whether the payload of a topic is encrypted at one level at least."""
    (rule,) = governance_for(template.protection, DomainSet.of((0, 0))).domain_access_rules
    topic = next(
        each for each in rule.topic_access_rules if matches(each.topic_expression, dds_topic)
    )
    kinds = (
        rule.rtps_protection_kind,
        topic.metadata_protection_kind,
        topic.data_protection_kind,
    )
    return any(kind in _ENCRYPTING for kind in kinds)
