"""What DDS decides: who may join, publish and subscribe, by vendor, and why.

The rules are those of the vendors' code and were compared with what Fast DDS 2.9.1 and 2.14.5 and
Cyclone DDS 0.10.2 really do; OpenDDS and Connext are as documented.
"""

from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import REASONS, Decision, Outcome, Refusal, Verb
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.vendors import TRAITS, Traits, Vendor

__all__ = [
    "REASONS",
    "TRAITS",
    "Access",
    "Decision",
    "Outcome",
    "Refusal",
    "Traits",
    "Vendor",
    "Verb",
    "read_governance_as",
    "read_permissions_as",
]
