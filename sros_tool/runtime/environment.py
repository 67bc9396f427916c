"""The environment in which a process runs secured: what rcl and the RMWs read.

Source: rcl 9.x ``security.c``, ``rcl/src/rcl/domain_id.c``.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.errors import KeystoreError, UsageError

KEYSTORE = "ROS_SECURITY_KEYSTORE"
ENABLE = "ROS_SECURITY_ENABLE"
STRATEGY = "ROS_SECURITY_STRATEGY"
ENCLAVE = "ROS_SECURITY_ENCLAVE_OVERRIDE"
DOMAIN = "ROS_DOMAIN_ID"

_DOMAIN = re.compile(r"(?:0|[1-9]\d*)\Z", re.ASCII)


def domain_from(environment: Mapping[str, str]) -> int | None:
    """ROS_DOMAIN_ID as a number, or None where it is unset or empty.

    Raises `UsageError` where it is no domain id (rcl then refuses to start, too).
    """
    text = environment.get(DOMAIN, "")
    if not text:
        return None
    # rcl reads a leading zero as octal (strtoul with base 0): 010 would be domain 8 to a node.
    domain = DomainSet.parse(text, DOMAIN).only() if _DOMAIN.match(text) else None
    if domain is None:
        raise UsageError(
            f"{DOMAIN} is {text!r}, which is not a domain id",
            "A domain id is one whole number from 0 to 230, without leading zeros.",
            "Correct the variable, or unset it.",
        )
    return domain


def choose_domain(domains: DomainSet, wanted: int | None, root: Path) -> int:
    """The domain for a process of a keystore that is made for ``domains``.

    It is the one that is ``wanted`` (by an option or ROS_DOMAIN_ID); else 0, as ROS does, where
    the keystore has it; else the keystore's only domain, or its first one.
    """
    if wanted is not None:
        if wanted not in domains:
            raise KeystoreError(
                f"keystore '{root}' is for domain {domains}, not for {wanted}",
                "DDS would refuse the node.",
                f"Set {DOMAIN} to {next(iter(domains))}, or make a keystore with "
                f"--domain {wanted}.",
            )
        return wanted
    return 0 if 0 in domains else next(iter(domains))


def secured_environment(root: Path, name: str, domain: int) -> dict[str, str]:
    """The variables with which a process runs in enclave ``name``, and not at all otherwise."""
    return {
        KEYSTORE: str(root.absolute()),
        ENABLE: "true",
        STRATEGY: "Enforce",
        ENCLAVE: name,
        DOMAIN: str(domain),
    }


def render_environment(variables: Mapping[str, str], form: str) -> str:
    """The variables as text for ``sh``, ``fish``, ``json``, ``systemd`` or ``docker``.

    ``docker`` is an env-file, ``systemd`` the lines of a unit; neither can hold a line break.
    """
    if form == "json":
        return json.dumps(dict(variables), indent=2) + "\n"
    if form in ("docker", "systemd") and any("\n" in value for value in variables.values()):
        raise UsageError(f"the form {form} cannot hold a path with a line break")
    return "".join(_LINES[form](name, value) for name, value in variables.items())


def _fish(name: str, value: str) -> str:
    quoted = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"set -gx {name} '{quoted}'\n"


def _systemd(name: str, value: str) -> str:
    # systemd.exec(5): C escapes inside double quotes; % starts a specifier.
    quoted = value.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'Environment="{name}={quoted}"\n'


def _sh(name: str, value: str) -> str:
    return f"export {name}={shlex.quote(value)}\n"


def _docker(name: str, value: str) -> str:
    return f"{name}={value}\n"


_LINES = {"sh": _sh, "fish": _fish, "systemd": _systemd, "docker": _docker}
FORMS = ("sh", "fish", "json", "systemd", "docker")
