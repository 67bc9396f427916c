"""Policies in ROS terms: their model, and SROS2 policy XML 0.2.0."""

from sros_tool.policy.document import read_policy, write_policy
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    RIGHTS,
    Enclave,
    Group,
    Policy,
    Profile,
    Profiles,
    Qualifier,
    Source,
)

__all__ = [
    "ALLOW",
    "DENY",
    "RIGHTS",
    "Enclave",
    "Group",
    "Policy",
    "Profile",
    "Profiles",
    "Qualifier",
    "Source",
    "read_policy",
    "write_policy",
]
