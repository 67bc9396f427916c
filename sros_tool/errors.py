"""The exceptions of sros: each says what happened, why, and what to do.

Only the command line prints them.  ``exit_status`` is the exit status of the command line for an
uncaught error: 1 for a negative result or a failure, 2 for wrong usage.
"""

from __future__ import annotations

from dataclasses import dataclass


class SrosError(Exception):
    """Base of every error that sros raises on purpose.

    ``what`` is a clause without a full stop at its end and without "Unable to ..." at its start;
    ``why`` and ``remedy`` are whole sentences, or empty.
    """

    exit_status = 1

    def __init__(self, what: str, why: str = "", remedy: str = "") -> None:
        super().__init__(what, why, remedy)
        self.what = what
        self.why = why
        self.remedy = remedy

    def __str__(self) -> str:
        sentences = [each.strip().removesuffix(".") for each in (self.what, self.why, self.remedy)]
        text = ". ".join(each for each in sentences if each)
        return " ".join(text.split()) + ("." if self.why or self.remedy else "")


class UsageError(SrosError):
    """A wrong argument or option."""

    exit_status = 2


class InvalidNameError(SrosError):
    """A name that ROS 2 or DDS Security does not accept."""


class DocumentError(SrosError):
    """An XML, TOML or S/MIME document that cannot be parsed."""


class PolicyError(DocumentError):
    """A policy file that is malformed or contradicts itself."""


class PkiError(SrosError):
    """An invalid key, certificate or signature."""


class KeystoreError(SrosError):
    """A keystore that is missing, broken or busy, or a change that would weaken it."""


class UnavailableError(SrosError):
    """A missing DDS stack, RMW, Python package or privilege."""


@dataclass(frozen=True, slots=True)
class Note:
    """A remark with a stable ``id`` (such as ``portable.document-size``) and one paragraph."""

    id: str
    text: str
