"""The properties of systemd units, as systemctl shows them."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Mapping


def unit_properties(unit: str, *names: str) -> Mapping[str, str]:
    """Map the names of a unit's properties to their values; empty if systemctl cannot be run.

    The value of a property that systemctl shows in several lines, such as ExecStart, has these
    lines. Source: org.freedesktop.systemd1(5).
    """
    properties: dict[str, str] = {}
    for line in _output("show", f"--property={','.join(names)}", unit).splitlines():
        name, _, value = line.partition("=")
        properties[name] = f"{properties[name]}\n{value}" if name in properties else value
    return properties


def log_file_of_unit(unit: str) -> str:
    """Return the file to which a unit writes its errors; "" for the journal.

    Returns "ITS_LOG" for a path with a specifier such as %n.  systemctl does not show the path as a
    property. Source: systemd.exec(5), StandardOutput=.
    """
    shown = unit_properties(unit, "StandardOutput", "StandardError")
    of_errors = shown.get("StandardError", "inherit")
    name = "StandardOutput" if of_errors == "inherit" else "StandardError"
    if not re.match(_TO_FILE, shown.get(name, "")):
        return ""
    paths = re.findall(rf"^{name}={_TO_FILE}:(.+)$", _output("cat", unit), re.MULTILINE)
    return paths[-1] if paths and "%" not in paths[-1] else "ITS_LOG"


_TO_FILE = "(?:file|append|truncate)"


def _output(*words: str) -> str:
    """Return what systemctl prints; "" if it cannot be run."""
    try:
        shown = subprocess.run(["systemctl", *words], capture_output=True, check=False).stdout
    except OSError:
        return ""
    return shown.decode(errors="surrogateescape")
