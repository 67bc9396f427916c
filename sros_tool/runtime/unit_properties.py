"""The properties of systemd units, as systemctl shows them."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping


def unit_properties(unit: str, *names: str) -> Mapping[str, str]:
    """Map the names of a unit's properties to their values; empty if systemctl cannot be run.

    The value of a property that systemctl shows in several lines, such as ExecStart, has these
    lines. Source: org.freedesktop.systemd1(5).
    """
    command = ["systemctl", "show", f"--property={','.join(names)}", unit]
    try:
        shown = subprocess.run(command, capture_output=True, check=False).stdout
    except OSError:
        return {}
    properties: dict[str, str] = {}
    for line in shown.decode(errors="surrogateescape").splitlines():
        name, _, value = line.partition("=")
        properties[name] = f"{properties[name]}\n{value}" if name in properties else value
    return properties
