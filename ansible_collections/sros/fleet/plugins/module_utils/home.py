"""Running sros on the machine with the keystore."""

from __future__ import annotations

import re
import subprocess
import unicodedata

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError

_MOST_SHOWN = 4000
_BLANK = "\u115f\u1160\u2800\u3164\uffa0"
"""Letters without a shape."""
_LONG_BLANK = re.compile(" {40,}")


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
            f"{command[0]} cannot be run on the keystore machine: {error.strerror}. Install sros"
            " there (pip install sros_tool), or name the program: sros_program."
        ) from error


def decoded(output: bytes) -> str:
    """Return what a program says, without control characters and of bounded length."""
    text = harmless(output.decode(errors="replace").strip(), most=None, lines=True)
    return text if len(text) <= _MOST_SHOWN else "..." + text[-_MOST_SHOWN:]


def harmless(text: str, *, most: int | None = _MOST_SHOWN, lines: bool = False) -> str:
    """Return a text that cannot steer a terminal, as one line unless ``lines`` may stay.

    Control characters, and those that change the direction of text, look blank or lie over others,
    become question marks.  Many blanks, which on a terminal that wraps lines would look like the
    end of one, become one.
    """
    if most is not None and len(text) > most:
        text = text[:most] + "..."
    text = text.replace("\r\n", "\n")
    if lines:
        text = "".join(
            character if character in "\n\t" or _is_visible(character) else "?"
            for character in text
        )
        return _LONG_BLANK.sub(" ", text)
    text = "".join(
        character if _is_visible(character) else " " if character in "\n\t" else "?"
        for character in text
    )
    return re.sub("  +", " ", text)


def _is_visible(character: str) -> bool:
    if character.isascii():
        return character.isprintable()
    return (
        character.isprintable()
        and character not in _BLANK
        and unicodedata.category(character)[0] != "M"
        and unicodedata.bidirectional(character) not in ("R", "AL", "AN")
    )
