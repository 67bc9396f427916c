"""The Zenoh network of the demo's keystores, and the variables that its processes read."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    ROUTER_FILE,
    SESSION_FILE,
    enclave_path,
)
from sros_tool.keystore.lifecycle.zenoh import set_zenoh
from sros_tool.runtime.environment import (
    OVERRIDE,
    ROUTER_URI,
    SESSION_URI,
    zenoh_environment,
)
from sros_tool.runtime.variables import DOMAIN
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.network import ZenohNetwork

_WITHOUT_RULES = "access_control/enabled=false"


def start_network(root: Path, router: str, endpoint: str, mode: Mode, now: datetime) -> None:
    """Give a keystore a Zenoh network whose router listens at ``endpoint``, as `sros zenoh`."""
    set_zenoh(root, ZenohNetwork(router, (endpoint,), mode=mode), now=now)


def zenoh_variables(
    root: Path, enclave: str, domain: int, *, router: bool, lawless: bool
) -> Mapping[str, str]:
    """Return the variables with which rmw_zenoh uses the files of an enclave as they are written.

    A ``lawless`` process does not enforce the rules of its own file.  One without a key shows no
    certificate.
    """
    folder = enclave_path(root, enclave).absolute()
    file = str(folder / (ROUTER_FILE if router else SESSION_FILE))
    places = {SESSION_URI: file, **({ROUTER_URI: file} if router else {})}
    files = (folder / name for name in (IDENTITY_CA_FILE, CERTIFICATE_FILE, KEY_FILE))
    variables = zenoh_environment(places, *files)
    override = variables[OVERRIDE]
    if not (folder / KEY_FILE).exists():
        override, _, _ = override.partition(";")  # the CA comes first
    if lawless:
        override = f"{override};{_WITHOUT_RULES}"
    return {**variables, DOMAIN: str(domain), OVERRIDE: override}
