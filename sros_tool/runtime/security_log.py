"""Read what the DDS vendors log about security: was it a refusal, or is security not built in?

Fast DDS writes coloured text to standard output, Cyclone DDS to its log sink or standard error.
The texts are those of Fast DDS 2.9 to 2.14 (Permissions.cpp, SecurityManager.cpp, PKIDH.cpp) and
of Cyclone DDS 0.10 (access_control.c, authentication.c, q_omg_security.c).
"""

from __future__ import annotations

import re

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")

_TRACE_HEAD = re.compile(r"^\d+\.\d+ \[\d*\]\s+\S+: ")

CYCLONE_EXPLAINS = {
    "CYCLONEDDS_URI": "<CycloneDDS><Domain><Tracing><Category>fatal,error,warning,trace</Category>"
    "<OutputFile>stderr</OutputFile></Tracing></Domain></CycloneDDS>"
}
"""Makes Cyclone DDS say why it denies a topic, which it tells only its trace."""

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
    "function validate_local_identity",
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
    """The line in which DDS Security denies a topic, a writer or a reader, or ""."""
    return _first_line_with(_ENDPOINT_REFUSALS, text)


def participant_refusal(text: str) -> str:
    """The line in which DDS Security refuses the files or the domain of a participant, or ""."""
    return _first_line_with(_PARTICIPANT_REFUSALS, text)


def missing_security(text: str) -> str:
    """The line in which a DDS says that it was built without DDS Security, or ""."""
    return _first_line_with(_NOT_BUILT_IN, text)


def plain_text(output: str) -> str:
    """What a process printed, without colours."""
    return _COLOUR.sub("", output)


def _first_line_with(marks: tuple[str, ...], text: str) -> str:
    for line in plain_text(text).splitlines():
        lowered = line.lower()
        if any(mark in lowered for mark in marks):
            return " ".join(_TRACE_HEAD.sub("", line).split())
    return ""
