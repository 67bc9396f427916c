"""The environment variables of ROS 2 that choose security and the domain, as rcl reads them.

Any value of ROS_SECURITY_ENABLE other than ``true`` switches security off. With any value of
ROS_SECURITY_STRATEGY other than ``Enforce``, a process without an enclave runs unsecured.  Source:
rcl/src/rcl/security.c.

This module is imported by every node of the demo, and imports little.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.errors import SrosError, UsageError

KEYSTORE = "ROS_SECURITY_KEYSTORE"
ENABLE = "ROS_SECURITY_ENABLE"
STRATEGY = "ROS_SECURITY_STRATEGY"
ENCLAVE = "ROS_SECURITY_ENCLAVE_OVERRIDE"
DOMAIN = "ROS_DOMAIN_ID"

_DOMAIN_ID = re.compile(r"(?:0|[1-9]\d*)\Z", re.ASCII)


def domain_from(environment: Mapping[str, str]) -> int | None:
    """Return ROS_DOMAIN_ID as a number, or None if the variable is unset or empty.

    Raises:
        UsageError: the value is not a domain id, or begins with a zero.
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


class SecurityChoice(NamedTuple):
    """The enclave directory that rcl chooses (None: no security), and a note on the choice."""

    enclave: Path | None
    note: str


def choose_enclave(environment: Mapping[str, str], enclave: str = "/") -> SecurityChoice:
    """Return rcl's choice for a process started with ``--ros-args --enclave`` ENCLAVE.

    Raises:
        SrosError: rcl would not start the process: with Enforce, the enclave must exist.
    """
    if environment.get(ENABLE) != "true":
        return SecurityChoice(None, f"security is off: {ENABLE} is not exactly 'true'")
    enforce = environment.get(STRATEGY) == "Enforce"
    keystore = environment.get(KEYSTORE, "")
    name = environment.get(ENCLAVE) or enclave
    if keystore:
        folder = Path(keystore) / "enclaves" / name.strip("/")
        if folder.is_dir():
            return SecurityChoice(folder, f"security directory: {folder}")
        why = f"The keystore {keystore} has no enclave {name}."
        if not Path(keystore).exists():
            why = f"{KEYSTORE} is {keystore}, which does not exist."
    else:
        why = f"{KEYSTORE} is not set."
    if enforce:
        raise SrosError(
            "cannot start a secured process",
            why,
            f"Set {KEYSTORE} to a keystore with this enclave.",
        )
    return SecurityChoice(None, f"running without security, as {STRATEGY} is not 'Enforce'. {why}")


def choose_loadable(environment: Mapping[str, str], enclave: str = "/") -> SecurityChoice:
    """Return rcl's choice, but without security if a file of the enclave is missing.

    Source: rmw_dds_common ``security.cpp``, whose message does not name the file.

    Raises:
        SrosError: The process would not start (Enforce); the error contains the message of the
            RMWs.
    """
    from sros_tool.runtime.cyclone import ENCLAVE_FILES

    choice = choose_enclave(environment, enclave)
    folder = choice.enclave
    lacking = [name for name in ENCLAVE_FILES if folder and not (folder / name).is_file()]
    if not lacking:
        return choice
    why = f"couldn't find all security files! The enclave has no {', '.join(lacking)}."
    if environment.get(STRATEGY) == "Enforce":
        raise SrosError("cannot start a secured process", why, "Create the enclave again.")
    return SecurityChoice(None, f"running without security, as {STRATEGY} is not 'Enforce'. {why}")


def domain_of(environment: Mapping[str, str]) -> int:
    """Return the domain in ROS_DOMAIN_ID, or 0 if the variable is not set.

    Raises:
        UsageError: The value is not a domain id.
    """
    return domain_from(environment) or 0
