"""Running sros at home, where the keystore is."""

from __future__ import annotations

import subprocess

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError

_MOST_SHOWN = 4000


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
