"""Read what the DDS vendors log about security: was it a refusal, or is security not built in?

Fast DDS writes coloured text to standard output, Cyclone DDS to its log sink or standard error.
The texts are those of Fast DDS 2.9 to 2.14 (Permissions.cpp, SecurityManager.cpp, PKIDH.cpp) and
of Cyclone DDS 0.10 (access_control.c, authentication.c, q_omg_security.c).
"""

from __future__ import annotations

import re

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")

_FRAME = re.compile(
    # Fast DDS: when, `[SECURITY Error]`, the place in its sources, and the function.
    r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d[.\d]* (?=\[)|\[SECURITY\w* (?:Error|Warning)\]\s*"
    r"|\s*\([^()\s]+\.(?:cpp|h|hpp|ipp):\d+\)|\s*-> Function \w+\Z|, at \S+\.(?:cpp|c):\d+"
    # The file of ROS_SECURITY_LOG_FILE: when, severity, participant, domain, and the function.
    r"|^\S+ \[[A-Z]+\] \S+ \d+ \w+::\w+ :\s*"
    # Cyclone DDS and OpenSSL: when and by which thread, numbers, and places in their sources.
    r"|^\d+\.\d+ \[\d*\]\s+\S+: |(?:candidate|adjusted)_guid: \S+ "
    r"|Remote secure participant \S+ not allowed\. ?|[0-9A-F]{16}:error:[0-9A-F]+:[\w ]+:"
    r"|:\.\./\S+\.c:\d+|\[\w+\] failed: |validate_local_identity: |Error\. (?=Error|validate)"
)
"""What is put around the reason of a refusal and says nothing to a person."""

CYCLONE_EXPLAINS = {
    "CYCLONEDDS_URI": "<CycloneDDS><Domain><Tracing><Category>fatal,error,warning,trace</Category>"
    "<OutputFile>stderr</OutputFile></Tracing></Domain></CycloneDDS>"
}
"""Makes Cyclone DDS say why it denies a topic, which it tells only its trace."""

_NO_REASON = "{}, and Fast DDS gives no reason"
_FUNCTION = re.compile(r"(?:-> Function |::)(\w+)(?: :)?\s*\Z")
"""Of a line of Fast DDS that has no text of its own, what did not succeed."""

_ENDPOINT_REFUSALS = (
    "topic not found in allow rule",
    "topic denied by deny rule",
    "partition not found in rule",
    "not found topic access rule for topic",
    "not allowed by security",
    "denied by default rule",
    "found in deny_rule",
)
_PARTICIPANT_REFUSALS = (
    "validate_local_identity",
    "error verifying private key",
    "error obtaining private key",
    "verifying ca certificate",
    "pkcs7 data verification failed",
    "input data has not pkcs7",
    "not found the identity subject name in permissions file",
    "not found a rule allowing to use the domain_id",
    "malformed permissions file",
    "malformed governance file",
    "error occurred while validating local permission",
    "error occurred while validating local identity",
    "could not find domain",
    "couldn't find all security files",
)
_NOT_BUILT_IN = (
    "doesn't have the security libraries",
    "-dsecurity=on",
    "compiled without security",
    "security not supported",
    "security is not supported",
)


def endpoint_refusal(text: str) -> str:
    """The words in which DDS Security denies a topic, a writer or a reader, or ""."""
    return _first_line_with(_ENDPOINT_REFUSALS, text)


def participant_refusal(text: str) -> str:
    """The words in which DDS Security refuses a participant's files or its domain, or ""."""
    return _first_line_with(_PARTICIPANT_REFUSALS, text)


def missing_security(text: str) -> str:
    """The words in which a DDS says that it was built without DDS Security, or ""."""
    return _first_line_with(_NOT_BUILT_IN, text)


def plain_text(output: str) -> str:
    """What a process printed, without colours."""
    return _COLOUR.sub("", output)


def plain_refusal(line: str) -> str:
    """The words of a line of a DDS log: without time, severity, and places in its sources.

    Never empty where the line is not: of a refusal without a reason it says what was refused.
    """
    line = " ".join(plain_text(line).split())
    if words := " ".join(_FRAME.sub("", line).split()):
        return words
    function = _FUNCTION.search(line)
    return _NO_REASON.format(function[1].replace("_", " ") + " failed") if function else line


def _first_line_with(marks: tuple[str, ...], text: str) -> str:
    for line in plain_text(text).splitlines():
        lowered = line.lower()
        if any(mark in lowered for mark in marks):
            return plain_refusal(line)
    return ""
