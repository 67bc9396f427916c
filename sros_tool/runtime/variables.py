"""The environment variables of ROS 2 that choose security and the domain.

This module is imported by every node of the demo, and imports little.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from sros_tool.dds.domains import DomainSet
from sros_tool.errors import UsageError

KEYSTORE = "ROS_SECURITY_KEYSTORE"
ENABLE = "ROS_SECURITY_ENABLE"
STRATEGY = "ROS_SECURITY_STRATEGY"
ENCLAVE = "ROS_SECURITY_ENCLAVE_OVERRIDE"
DOMAIN = "ROS_DOMAIN_ID"

_DOMAIN_ID = re.compile(r"(?:0|[1-9]\d*)\Z", re.ASCII)


def domain_from(environment: Mapping[str, str]) -> int | None:
    """Return ROS_DOMAIN_ID as a number, or None if it is unset or empty.

    Raises:
        UsageError: It is not a domain id; rcl would not start either.
    """
    text = environment.get(DOMAIN, "")
    if not text:
        return None
    # rcl reads a leading zero as octal (strtoul with base 0): 010 would be domain 8 to a node.
    domain = DomainSet.parse(text, DOMAIN).only() if _DOMAIN_ID.match(text) else None
    if domain is None:
        raise UsageError(
            f"{DOMAIN} is {text!r}, which is not a domain id",
            "A domain id is one whole number from 0 to 230, without leading zeros.",
            "Correct the variable, or unset it.",
        )
    return domain
