"""The exceptions of sros: each has an error, its reason, and a remedy.

Only the command line prints them, with the exit status `NOT_DONE`: an error says that something
could not be asked or done, and is never the answer "no".
"""

from __future__ import annotations

from typing import NamedTuple

NOT_DONE = 2
"""Exit status of a command that failed; 1 means the answer "no", or findings."""


class SrosError(Exception):
    """Base of every error that sros raises on purpose.

    ``what`` is a clause without a full stop at its end and without "Unable to ..." at its start;
    ``why`` and ``remedy`` are whole sentences, or empty.
    """

    def __init__(self, what: str, why: str = "", remedy: str = "") -> None:
        super().__init__(what, why, remedy)
        self.what = what
        self.why = why
        self.remedy = remedy

    def __str__(self) -> str:
        sentences = [
            sentence.strip().removesuffix(".") for sentence in (self.what, self.why, self.remedy)
        ]
        text = ". ".join(sentence for sentence in sentences if sentence)
        return " ".join(text.split()) + ("." if self.why or self.remedy else "")

    @property
    def clause(self) -> str:
        """The cause as a clause without a full stop: ``why``, or ``what`` if ``why`` is empty."""
        why = self.why.rstrip(".")
        begin = why[:1] if why[1:2].isupper() else why[:1].lower()
        return f"{begin}{why[1:]}" or self.what


class UsageError(SrosError):
    """A wrong argument or option."""


class InvalidNameError(SrosError):
    """A name that ROS 2 or DDS Security does not accept."""


class DocumentError(SrosError):
    """An XML, TOML or S/MIME document that cannot be parsed."""


class PolicyError(DocumentError):
    """A policy file that cannot be read, is malformed or contradicts itself."""


class PkiError(SrosError):
    """An invalid key, certificate or signature."""


class KeystoreError(SrosError):
    """A keystore that is missing, broken or busy, or a change that would weaken it."""


class IndexDamagedError(SrosError):
    """The index of a ledger, or a line of the ledger, differs from what the ledger head states."""


class UnavailableError(SrosError):
    """A missing DDS stack, RMW, Python package or privilege."""


class Note(NamedTuple):
    """A warning or hint about a successful result."""

    id: str
    """A stable name, such as ``portable.document-size``."""
    text: str
    """One paragraph for people."""


def check_meaning(read: object, meant: object, what: str) -> None:
    """Raise `PkiError` on ``what`` unless ``read``, parsed from a new document, is ``meant``."""
    if read != meant:
        raise PkiError(
            f"{what} would not have the intended content",
            "Nothing was written.",
            "This is a defect of sros: please report it with the policy.",
        )
