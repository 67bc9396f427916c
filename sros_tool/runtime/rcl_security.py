"""The enclave that a process would load, by the exact rules of rcl (rcl/src/rcl/security.c).

Any other ROS_SECURITY_ENABLE than ``true`` switches security off.  With any other
ROS_SECURITY_STRATEGY than ``Enforce``, a process without an enclave runs unsecured.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import ENCLAVE_FILES
from sros_tool.runtime.variables import ENABLE, ENCLAVE, KEYSTORE, STRATEGY, domain_from


class SecurityChoice(NamedTuple):
    """The enclave directory that rcl chooses (None: no security), and the reason."""

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
        SrosError: The process would not start (Enforce); contains the message of the RMWs.
    """
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
    """Return the domain that ROS_DOMAIN_ID names, or 0 if it is not set.

    Raises:
        UsageError: It is not a domain id.
    """
    return domain_from(environment) or 0
