"""The security messages in the lines of a log, before any enclave is examined."""

from __future__ import annotations

import re
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from shlex import quote

from sros_tool.explain.denials import Denial
from sros_tool.runtime.log_texts import RUNS_OPEN, UNKNOWN, LogText
from sros_tool.runtime.vendor_log import (
    CONTINUATION,
    LINE_DOMAIN,
    denied_topic,
    labeled_line,
    matching_text,
    security_directory,
)
from sros_tool.runtime.zenoh_log import ZENOH_LINE, matching_zenoh_text

_WORD_PATTERNS = (re.compile(r"[\w/]+"), re.compile(r"[^\s(]+"), re.compile(r"\S+"))
"""Patterns that split a log line into words: without punctuation, or with that of topics."""
MAX_LINE_LENGTH = 8000
"""Maximum number of characters read from a line, because a line may have many megabytes."""


@dataclass(frozen=True, slots=True)
class LogHit:
    """A log line with a known text; ``fields`` are the groups that the text's pattern matched."""

    line: int
    text: str
    process: str
    enclave: str
    meaning: LogText
    fields: Mapping[str, str]

    @property
    def cause(self) -> str:
        """The meaning of the line, with the matched fields."""
        return self.meaning.cause.format(**self.fields)

    @property
    def quoted(self) -> Mapping[str, str]:
        """The fields, quoted for a shell command because a log can contain any text."""
        return {name: quote(text) for name, text in self.fields.items()}

    @property
    def kind(self) -> str:
        """A key that is equal for lines that are reported as one finding."""
        return f"{self.meaning.id} {self.cause}"


def grouped_hits(lines: list[str], reported: set[str]) -> Iterator[list[LogHit]]:
    """Yield the hits of a log, in groups of the lines that are reported as one finding.

    Weak hits of processes that also have a stronger hit are left out. ``reported`` are the
    processes whose denied topics are reported separately.
    """
    groups: dict[tuple[str, str, str], list[LogHit]] = {}
    for hit in _strongest_hits(_log_hits(_joined_lines(lines)), reported):
        groups.setdefault((hit.process, hit.enclave, hit.kind), []).append(hit)
    return iter(groups.values())


def _joined_lines(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Yield lines with their numbers; an error stack of OpenSSL is joined to the line before."""
    number, current = 0, ""
    for index, line in enumerate(lines, 1):
        if current and CONTINUATION.match(line):
            if len(current) < MAX_LINE_LENGTH:
                current += " " + line
            continue
        if current:
            yield number, current[:MAX_LINE_LENGTH]
        number, current = index, line
    if current:
        yield number, current[:MAX_LINE_LENGTH]


def _log_hits(lines: Iterable[tuple[int, str]]) -> Iterator[LogHit]:
    enclaves: dict[str, str] = {}
    following = deque(lines)
    while following:
        number, line = following.popleft()
        process, rest = labeled_line(line)
        if named := security_directory(line):
            enclaves[process] = named["enclave"] or "/"
            text = " ".join(rest.split())
            yield LogHit(number, text, process, enclaves[process], RUNS_OPEN, {})
            continue
        if following and (rejoined := _rejoined_message(process, line, rest, following[0][1])):
            following.popleft()
            line = rest = rejoined
        text = " ".join(rest.split())
        meaning, match = _meaning_of(line, rest)
        if match:
            fields = {name: value or "" for name, value in match.groupdict().items()}
            if domain := LINE_DOMAIN.search(line):
                fields["domain"] = domain[1]
            enclave = enclaves.get(process) or fields.get("enclave", "")
            yield LogHit(number, text, process, enclave, meaning, fields)


def _rejoined_message(process: str, line: str, rest: str, following: str) -> str:
    """Return the joined message if ``line`` and ``following`` are its halves; otherwise "".

    ``line`` counts as broken if neither ``line`` nor ``following`` has a known meaning, but the
    joined lines have one.
    """
    if not UNKNOWN.pattern.search(rest):  # checked first, because this check is fast
        return ""
    other, end = labeled_line(following)
    if other not in ("", process) or matching_text(line) or matching_text(following):
        return ""
    if denied_topic(line) or denied_topic(following) or security_directory(following):
        return ""
    return next(
        (candidate for candidate in (rest + end, f"{rest} {end}") if matching_text(candidate)), ""
    )


def _meaning_of(line: str, rest: str) -> tuple[LogText, re.Match[str] | None]:
    """Return the meaning of a line, and its match, if any; ``rest`` is the line without label."""
    if meaning := matching_zenoh_text(line):
        return meaning
    if ZENOH_LINE.search(rest):  # other lines of Zenoh's log are no security problem
        return UNKNOWN, None
    if meaning := matching_text(line):
        return meaning
    return UNKNOWN, None if denied_topic(line) else UNKNOWN.pattern.search(rest)


def _strongest_hits(hits: Iterable[LogHit], reported: set[str]) -> Iterator[LogHit]:
    """Yield the hits, without weak hits of processes that also have a stronger hit.

    ``reported`` are the processes whose denied topics are reported separately.
    """
    all_hits = list(hits)
    least = dict.fromkeys(reported, 0)
    for hit in all_hits:
        if hit.meaning is not UNKNOWN:
            least[hit.process] = min(
                hit.meaning.vagueness, least.get(hit.process, hit.meaning.vagueness)
            )
    return (hit for hit in all_hits if hit.meaning.vagueness <= least.get(hit.process, 0))


def lines_naming(
    lines: list[str], denials: Sequence[Denial]
) -> Mapping[Denial, list[tuple[int, str]]]:
    """Map denials to the numbers and texts of lines that name the denied topic.

    If a process was denied a topic for several causes, a line that reports no denial belongs to the
    last denial before it.
    """
    of_topic = defaultdict[tuple[str, str], list[Denial]](list)
    for denial in denials:
        of_topic[denial.process, denial.topic].append(denial)
    topics = {topic for _, topic in of_topic}
    denial_at = {number: denial for denial in denials for number in denial.lines}
    lines_of = defaultdict[Denial, list[tuple[int, str]]](list)
    for number, line in enumerate(lines, 1):
        process, text = labeled_line(line)
        words = (word for pattern in _WORD_PATTERNS for word in pattern.findall(text))
        for topic in topics.intersection(words):
            causes = of_topic[process, topic]
            own = [denial for denial in causes if denial_at.get(number) == denial]
            if own or len(causes) == 1 or (causes and not denied_topic(text)):
                last = (own or causes)[0]
                lines_of[last].append((number, text))
                of_topic[process, topic] = sorted(causes, key=lambda denial: denial != last)
    return lines_of
