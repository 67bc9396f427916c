"""Read the logs of DDS vendors, rcl and the RMWs: their lines, refusals and reasons.

Fast DDS writes colored text to standard output, Cyclone DDS writes to its log sink or to standard
error.  With ROS_SECURITY_LOG_FILE, Fast DDS writes the reasons of refusals to that file instead, in
another format.

To add a vendor, add the vendor's text around a reason to `_REASON_CONTEXT`, the words for writers
and readers to `ENDPOINT_KINDS`, and the messages to `sros_tool.runtime.log_texts`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.runtime.log_texts import LOG_TEXTS, LogText, RefusedObject

_LINE_FORMATS = (
    (Vendor.CYCLONE, re.compile(r"\A\d+\.\d+ \[\d*\]\s+\S+: ")),
    (
        Vendor.FAST,
        re.compile(
            r"\[\w{0,40} (?:Error|Warning)\]|\[[A-Z]{4,13}\] [^\s|]+\|[^\s|]+ \d+ \w+::\w+ :"
        ),
    ),
)


def vendor_of_line(line: str) -> Vendor | None:
    """Return the vendor whose log has lines of this form, or None.

    Callers have to remove the label of the process from ``line``.
    """
    return next((vendor for vendor, form in _LINE_FORMATS if form.search(line)), None)


_PROCESS_LABEL = re.compile(
    r"\[(?P<launch>[\w.-]+-\d+)\] "  # ros2 launch: [talker-1]
    # Nov 21 06:00:00 robot talker[12]: (but not the message of a node: [INFO] [1.0] [talker]: ...)
    r"|(?!\[[A-Z]+\] )(?:\S+ +){2,4}?(?P<journald>[\w.@-]+\[\d+\]): "
    r"|(?P<compose>[\w.-]+) +\| "  # Docker Compose: talker-1  |
)
"""Matches the label that distinguishes the processes in a log, at the start of a line."""

_RCUTILS_LOGGER = re.compile(r"\[[A-Z]+\] \[[\d.]+\] \[([\w.]+)\]: ")
_SECURITY_DIRECTORY = re.compile(
    r"(?:(?:[\w.-]+ +\| )?(?:(?:\[[^\[\]]*\] )*\[rcl\]: )?Found|\[\w+\]) security directory: "
    r"(?P<folder>[^\s\0]{0,4096}?/enclaves(?P<enclave>/[^\s\0]{0,4096})?)(?:\s|\Z)"
)
"""Matches a line, without its label, in which rcl or a node of `sros demo` names its enclave.

The beginning of the line counts, because a node can log the text of a message that it received.
"""

LINE_DOMAIN = re.compile(r"\] \S+\|\S+ (\d{1,9}) \w+::\w+ :")
"""Matches the domain in a line of ROS_SECURITY_LOG_FILE, after the participant's identifier."""

CONTINUATION = re.compile(r"^(?:[0-9A-F]{8,}:error:|\(code: )")
"""Matches the start of a continuation line: OpenSSL's error stack."""

REMOTE_ENDPOINT = re.compile(r"check_remote_data|remote (?:writer|reader)")
"""Matches words which show that permissions of a remote participant deny a topic."""

ENDPOINT_KINDS: Mapping[str, re.Pattern[str]] = {
    "writer": re.compile(
        r"Writer is not|local writer|create a writer on|check_create_datawriter|datawriter_sec"
        r"|associated Writer|DATA_WRITER|create(?:_p| p|P)ublisher|register_local_writer"
        r"|/rcl/publisher\.c:"
    ),
    "reader": re.compile(
        r"Reader is not|local reader|create a reader on|check_create_datareader|datareader_sec"
        r"|associated Reader|DATA_READER|create(?:_s| s|S)ubscri|register_local_reader"
        r"|/rcl/subscription\.c:"
    ),
    "client": re.compile(r"create(?:_c| c|C)lient|/rcl/client\.c:"),
    "server": re.compile(r"create(?:_s| s|S)ervice|/rcl/service\.c:"),
}
"""Kind of endpoint → words in lines near a denied topic that show this kind."""


def log_lines(text: str) -> list[str]:
    r"""Return the lines of a log; only ``\n`` ends a line.

    A process can print another line separator, such as ``\r``, in the middle of a line, and then a
    label of another process, to make the text look like the text of that process.
    """
    return [line.removesuffix("\r") for line in text.split("\n")]


def labeled_line(line: str) -> tuple[str, str]:
    """Return the process that the label of a line names, and the text after the label.

    A line without a label gives ("", line).
    """
    label = _PROCESS_LABEL.match(line)
    return (label[label.lastgroup or 0], line[label.end() :]) if label else ("", line)


def security_directory(line: str) -> re.Match[str] | None:
    """Return the match of a log line in which a process names its enclave's folder, or None.

    The groups of the match are ``folder`` and ``enclave``.
    """
    return _SECURITY_DIRECTORY.match(labeled_line(line)[1])


def logging_node(message: str) -> str:
    """Return the full name of the node whose logger wrote a line without label, or ""."""
    logger = _RCUTILS_LOGGER.match(message)
    return "/" + logger[1].replace(".", "/") if logger else ""


def missing_security(text: str) -> str:
    """Return the message of a DDS which says that it was built without DDS Security, or ""."""
    return _first_refusal(RefusedObject.ALL_SECURITY, text)


def participant_refusal(text: str) -> str:
    """Return the message that refuses a participant's files or domain, or ""."""
    return _first_refusal(RefusedObject.PARTICIPANT, text)


def endpoint_refusal(text: str) -> str:
    """Return the message that denies a topic, a writer or a reader, or ""."""
    return _first_refusal(RefusedObject.TOPIC, text)


def _first_refusal(refused: RefusedObject, text: str) -> str:
    patterns = [text.pattern for text in LOG_TEXTS if text.refuses is refused]
    for line in plain_text(text).splitlines():
        if any(pattern.search(line) for pattern in patterns):
            return plain_refusal(line)
    return ""


def denied_topic(line: str) -> tuple[Vendor, re.Match[str]] | None:
    """Return the vendor that denies a topic in ``line``, and the match with group ``topic``.

    The result is None if the line denies no topic.

    Group ``rule`` is the denying rule, if the line names the rule; group ``neither`` is present if
    the line says that the topic may be used in neither direction.
    """
    for vendor, pattern in _TOPIC_DENIED:
        if match := pattern.search(line):
            return vendor, match
    return None


_TOPIC_DENIED = [
    (text.vendor, text.pattern) for text in LOG_TEXTS if text.id == "topic-denied" and text.vendor
]


def matching_text(line: str) -> tuple[LogText, re.Match[str]] | None:
    """Return the text that explains a line, with its match, or None; see also `denied_topic`."""
    for text in LOG_TEXTS:
        if text.cause and (match := text.pattern.search(line)):
            return text, match
    return None


def plain_text(output: str) -> str:
    """Return the output of a process without ANSI color codes."""
    return _COLOR_CODE.sub("", output)


def plain_refusal(line: str) -> str:
    """Return the message in a line of a DDS log, without time, severity and source positions.

    A line without a message gives the name of the failed function; only an empty line gives "".
    """
    line = " ".join(plain_text(line).split())
    if words := " ".join(_REASON_CONTEXT.sub("", line).split()):
        return words
    function = _FAILED_FUNCTION.search(line)
    return _NO_REASON.format(function[1].replace("_", " ") + " failed") if function else line


_COLOR_CODE = re.compile(r"\x1b\[[0-9;]*m")

_REASON_CONTEXT = re.compile(
    # rcutils: level, time and logger.
    r"^\[[A-Z]+\] \[[\d.]+\] \[\w+\]: "
    # Fast DDS: time, `[SECURITY Error]`, source position, and function.
    r"|^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d[.\d]* (?=\[)|\[SECURITY\w* (?:Error|Warning)\]\s*"
    r"|\s*\([^()\s]+\.(?:cpp|h|hpp|ipp):\d+\)|\s*-> Function \w+\Z|, at \S+\.(?:cpp|c):\d+"
    # The file of ROS_SECURITY_LOG_FILE: time, severity, participant, domain, and function.
    r"|^\S+ \[[A-Z]+\] \S+ \d+ \w+::\w+ :\s*"
    # Cyclone DDS and OpenSSL: time and thread, numbers, and source positions.
    r"|^\d+\.\d+ \[\d*\]\s+\S+: |(?:candidate|adjusted)_guid: \S+ "
    r"|Remote secure participant \S+ not allowed\. ?|[0-9A-F]{16}:error:[0-9A-F]+:[\w ]+:"
    r"|:\.\./\S+\.c:\d+|\[\w+\] failed: |validate_local_identity: |Error\. (?=Error|validate)"
)
"""Matches the text that vendors put around the reason of a refusal, such as times and positions."""

_NO_REASON = "{}, and Fast DDS gives no reason"
_FAILED_FUNCTION = re.compile(r"(?:-> Function |::)(\w+)(?: :)?\s*\Z")
"""Matches the failed function in a line of Fast DDS without a message."""
