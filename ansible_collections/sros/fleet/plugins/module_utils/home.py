"""Running sros at home, where the keystore is."""

from __future__ import annotations

import subprocess
from typing import Any

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError

_MOST_SHOWN = 4000
_SETTINGS = "sros_"
"""How the names of all variables of this collection begin."""


def check_facts(variables: dict[str, Any]) -> None:
    """Refuse to do anything at home for a robot that returned facts named as settings.

    Every answer of a robot can have facts, and Ansible lets them take the place of variables of the
    inventory: so a robot could choose the command that runs at home, or whose keys it gets.

    Args:
        variables: the variables of a task, with the facts of its robot.

    Raises:
        RefusedError: the robot returned such facts.
    """
    facts = variables.get("ansible_facts") or {}
    if found := sorted(str(each) for each in facts if str(each).startswith(_SETTINGS)):
        shown = decoded(", ".join(found).encode(errors="replace")[:200]).replace("\n", "?")
        raise RefusedError(
            f"This robot returned facts with the names of settings ({shown}). No robot has to do"
            " that: it could choose the commands that run at home, or get the keys of another."
            " Nothing was done for it. Look at the robot, and delete its facts if they are cached"
            " (ansible-playbook --flush-cache)."
        )


def ask(command: list[str], said: bytes = b"") -> subprocess.CompletedProcess:
    """Run sros with ``said`` on its standard input.

    Its passphrases come from the environment (SROS_CA_PASSPHRASE_FILE, ...).

    Raises:
        RefusedError: the program cannot be run.
    """
    try:
        return subprocess.run(
            command,
            input=said,
            capture_output=True,
            check=False,
        )
    except OSError as error:
        raise RefusedError(
            f"{command[0]} cannot be run at home: {error.strerror}. Install sros there (pip install"
            " sros_tool), or name the program: sros_program."
        ) from error


def decoded(output: bytes) -> str:
    """Return what a program says, without control characters and of bounded length."""
    text = output.decode(errors="replace").strip()
    shown = "".join(each if each.isprintable() or each == "\n" else "?" for each in text)
    return shown if len(shown) <= _MOST_SHOWN else "..." + shown[-_MOST_SHOWN:]
