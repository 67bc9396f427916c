"""Which enclave a process would load, by exactly the rules of ROS 2's rcl (rcl/src/rcl/security.c).

The rules are unforgiving: anything but ``true`` switches security off, anything but ``Enforce``
lets a process go on unsecured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import ENCLAVE_FILES
from sros_tool.runtime.environment import ENABLE, ENCLAVE, KEYSTORE, STRATEGY, domain_from


@dataclass(frozen=True)
class SecurityChoice:
    """What rcl makes of an environment: the enclave's directory, or None for no security."""

    enclave: Path | None
    note: str


def choose_enclave(environment: Mapping[str, str], enclave: str = "/") -> SecurityChoice:
    """The choice for a process started with ``--ros-args --enclave`` ENCLAVE.

    Raises `SrosError` where rcl would not start the process: Enforce, and no such enclave.
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
        raise SrosError("cannot start a secured process", why, f"Set {KEYSTORE} and the enclave.")
    return SecurityChoice(None, f"running without security, as {STRATEGY} is not 'Enforce'. {why}")


def choose_loadable(environment: Mapping[str, str], enclave: str = "/") -> SecurityChoice:
    """As `choose_enclave`, and then as the RMWs go on: an enclave that lacks a file is none.

    Raises `SrosError` where that ends the process (Enforce), with the words of the RMWs, which do
    not say which file it is (rmw_dds_common ``security.cpp``).
    """
    choice = choose_enclave(environment, enclave)
    folder = choice.enclave
    lacking = [name for name in ENCLAVE_FILES if folder and not (folder / name).is_file()]
    if not lacking:
        return choice
    why = f"couldn't find all security files! The enclave has no {', '.join(lacking)}."
    if environment.get(STRATEGY) == "Enforce":
        raise SrosError("cannot start a secured process", why, "Make the enclave again.")
    return SecurityChoice(None, f"running without security, as {STRATEGY} is not 'Enforce'. {why}")


def domain_of(environment: Mapping[str, str]) -> int:
    """The domain that ROS_DOMAIN_ID names, 0 where it is not set.  Raises `SrosError`."""
    return domain_from(environment) or 0
