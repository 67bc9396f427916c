"""Which of the conditions that decide attacks hold, by a keystore's template and its DDS vendor."""

from __future__ import annotations

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Protection
from sros_tool.demo.backend import Backend
from sros_tool.demo.model import Condition
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.policy.patterns import matches
from sros_tool.translate import governance_for

_SIGNERS_CHECKED = ((2, 1, 4), (2, 6, 5), (2, 8, 2), (2, 9, 2))
"""The first release of each older line of Fast DDS that takes no signer but those in the file of
the permissions CA (CVE-2023-24010); all do from 2.10 on.  From the tags of its repository."""

_ENCRYPTING = (Protection.ENCRYPT, Protection.ENCRYPT_WITH_ORIGIN_AUTHENTICATION)


def conditions(backend: Backend, template: Template, topic: str) -> frozenset[Condition]:
    """What holds on ``backend`` in a keystore made by ``template``, for a DDS topic."""
    (domain,) = governance_for(template.protection, DomainSet.of((0, 0))).domain_access_rules
    rule = next(each for each in domain.topic_access_rules if matches(each.topic_expression, topic))
    kinds = (
        domain.rtps_protection_kind,
        rule.metadata_protection_kind,
        rule.data_protection_kind,
    )
    strangers = domain.allow_unauthenticated_participants
    bare = all(kind is Protection.NONE for kind in kinds)
    uncontrolled = not (rule.enable_read_access_control or rule.enable_write_access_control)
    found = {
        Condition.ONE_CA: not template.separate_authorities,
        Condition.SHARED_SUBJECTS: not template.unique_subject,
        Condition.OPEN_DEFAULT: template.default_permissions == EVERYTHING,
        Condition.IN_CLEAR: not any(kind in _ENCRYPTING for kind in kinds),
        Condition.STRANGERS: strangers and bare and uncontrolled,
        Condition.STRANGERS_SEE: strangers and not rule.enable_discovery_protection,
        Condition.UNCONTROLLED: uncontrolled,
        Condition.OPEN_JOIN: not domain.enable_join_access_control,
        Condition.EXACT_SIGNER: backend.vendor is Condition.FAST and _checks_signers(backend.dds),
    }
    vendor = {backend.vendor} if backend.vendor else set()
    return frozenset(name for name, holds in found.items() if holds) | vendor


def _checks_signers(dds: str) -> bool:
    """Return whether that Fast DDS, as in ``Fast DDS 2.14.5``, knows its signers exactly.

    One whose version is not known is taken for a recent one.
    """
    version = tuple(int(part) for part in dds.rpartition(" ")[2].split(".") if part.isdigit())
    if len(version) < 3 or version >= (2, 10):
        return True
    return any(version[:2] == first[:2] and version >= first for first in _SIGNERS_CHECKED)
