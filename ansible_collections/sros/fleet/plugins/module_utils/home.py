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
    text = harmless(output.decode(errors="replace").strip(), most=None, lines=True)
    return text if len(text) <= _MOST_SHOWN else "..." + text[-_MOST_SHOWN:]


def harmless(text: str, *, most: int | None = _MOST_SHOWN, lines: bool = False) -> str:
    """Return a text that cannot steer a terminal, as one line unless ``lines`` may stay.

    Control characters, and those that change the direction of text, become question marks.
    """
    if most is not None and len(text) > most:
        text = text[:most] + "..."
    text = text.replace("\r\n", "\n")
    if lines:
        return "".join(each if each.isprintable() or each in "\n\t" else "?" for each in text)
    return "".join(each if each.isprintable() else " " if each in "\n\t" else "?" for each in text)
