"""Turns the security messages of a log into causes and remedies, with the enclave looked at.

The lines of several processes may be mixed, with the labels of ros2 launch, journald or Docker
Compose before them, with colours, and with tracebacks between them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from sros_tool.dds.decision import Vendor, Verb
from sros_tool.explain.answer import Answer, Judge, Setting
from sros_tool.explain.log_texts import MEANINGS, Meaning
from sros_tool.explain.material import Material
from sros_tool.explain.question import Part, Question, ask
from sros_tool.explain.remedy import remedy
from sros_tool.graph.denials import (
    PROCESS_LABEL,
    SECURITY_DIRECTORY,
    Denial,
    read_denials,
)
from sros_tool.runtime.security_log import plain_text

_CONTINUED = re.compile(r"^(?:[0-9A-F]{8,}:error:|\(code: )")
_WORDS = (re.compile(r"[\w/]+"), re.compile(r"[^\s(]+"), re.compile(r"\S+"))
"""As what a topic stands in a line: between punctuation, or with it where it has some itself."""
_LONGEST = 8000
"""How many characters of a line can be a message: a log may be one line of many megabytes."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A message, what it means, and what was found in the enclave.

    ``line`` counts from 1 and is that of the first of ``count`` messages; ``vendor`` is None for
    those of rcl.  ``enclave`` is "" where the log does not name it.  ``found`` are the true
    causes, where an enclave was looked at; ``checked`` says whether one was.
    """

    id: str
    vendor: Vendor | None
    line: int
    count: int
    text: str
    enclave: str
    cause: str
    remedy: str
    found: tuple[str, ...] = ()
    checked: bool = False


@dataclass(frozen=True, slots=True)
class _Hit:
    line: int
    text: str
    process: str
    enclave: str
    meaning: Meaning
    cause: str


Look = Callable[[str], Material | None]
"""Gives what lies in a keystore for an enclave ("": the one that was named), or None."""


def explain_log(
    text: str, look: Look, setting: Callable[[Material], Setting], root: str = ""
) -> tuple[Finding, ...]:
    """What a log tells, in its order, each thing once; empty if it tells of no fault.

    ``setting`` says where and when an enclave is looked at, ``root`` names its keystore.
    """
    plain = plain_text(text)
    eye = _Eye(look, setting, root)
    lines = plain.splitlines()
    refused = read_denials(plain)
    naming = _naming(lines, {each.topic for each in refused})
    denials = [(each, naming[each.topic]) for each in refused]
    told = {_process(line) for _, named in denials for _, line in named}
    hits = list(_strongest(_hits(_joined(lines)), told))
    found = [eye.finding(group) for group in _grouped(hits)]
    found += [eye.denial(each, named) for each, named in denials]
    return tuple(sorted(found, key=lambda each: each.line))


# ── reading ────────────────────────────────────────────────────────────────────────────────


def _joined(lines: list[str]) -> Iterator[tuple[int, str]]:
    """The lines with their numbers; OpenSSL's error stack is one line with what it explains."""
    number, current = 0, ""
    for index, line in enumerate(lines, 1):
        if current and _CONTINUED.match(line):
            if len(current) < _LONGEST:
                current += " " + line
            continue
        if current:
            yield number, current[:_LONGEST]
        number, current = index, line
    if current:
        yield number, current[:_LONGEST]


def _hits(lines: Iterable[tuple[int, str]]) -> Iterator[_Hit]:
    enclaves: dict[str, str] = {}
    for number, line in lines:
        process = _process(line)
        if named := SECURITY_DIRECTORY.search(line):
            enclaves[process] = named["enclave"] or "/"
            continue
        for meaning in MEANINGS:
            if match := meaning.pattern.search(line):
                cause = meaning.cause.format(**{k: v or "" for k, v in match.groupdict().items()})
                yield _Hit(
                    number, _without_label(line), process, enclaves.get(process, ""), meaning, cause
                )
                break


def _process(line: str) -> str:
    label = PROCESS_LABEL.match(line)
    return label[0].strip() if label else ""


def _without_label(line: str) -> str:
    label = PROCESS_LABEL.match(line)
    return " ".join(line[label.end() if label else 0 :].split())


def _strongest(hits: Iterable[_Hit], told: set[str]) -> Iterator[_Hit]:
    """The hits without those that only follow on what is ``told`` of the same process."""
    found = list(hits)
    strong = told.union(hit.process for hit in found if not hit.meaning.weak)
    return (hit for hit in found if not hit.meaning.weak or hit.process not in strong)


def _grouped(hits: Iterable[_Hit]) -> Iterator[list[_Hit]]:
    groups: dict[tuple[str, str, str, str], list[_Hit]] = {}
    for hit in hits:
        key = (hit.process, hit.enclave, hit.meaning.id, hit.cause)
        groups.setdefault(key, []).append(hit)
    return iter(groups.values())


def _naming(lines: list[str], topics: set[str]) -> dict[str, list[tuple[int, str]]]:
    """The lines that name each topic, with their numbers, in one pass over the log."""
    found: dict[str, list[tuple[int, str]]] = {topic: [] for topic in topics}
    for number, line in enumerate(lines, 1):
        words = (word for pattern in _WORDS for word in pattern.findall(line))
        for topic in topics.intersection(words):
            found[topic].append((number, line))
    return found


# ── looking ────────────────────────────────────────────────────────────────────────────────


class _Eye:
    """Looks at enclaves for the causes of messages."""

    def __init__(self, look: Look, setting: Callable[[Material], Setting], root: str) -> None:
        self._look = look
        self._setting = setting
        self._root = root

    def finding(self, hits: list[_Hit]) -> Finding:
        """What one message means, however often it came."""
        first = hits[0]
        meaning = first.meaning
        plain = Finding(
            meaning.id,
            meaning.vendor,
            first.line,
            len(hits),
            first.text,
            first.enclave,
            first.cause,
            meaning.remedy,
        )
        material = self._look(first.enclave) if meaning.codes else None
        if material is None:
            return plain
        answer = self._answer(material, meaning.vendor or Vendor.FAST, ask("join"))
        causes = list(self._causes(material, answer, meaning.codes))
        told = [text for text, _ in causes]
        remedies = list(dict.fromkeys(remedy for _, remedy in causes if remedy))
        return replace(
            plain,
            enclave=material.enclave,
            found=tuple(told),
            checked=True,
            remedy=" ".join(remedies) if remedies else _nothing_found(material),
        )

    def denial(self, denial: Denial, named: list[tuple[int, str]]) -> Finding:
        """A topic that was denied, with the lines that name it."""
        line, text = named[0][0], _without_label(named[0][1])
        right, name = _in_ros_terms(denial)
        vendor = Vendor.CYCLONE if "permi" in text and "denied by" in text else Vendor.FAST
        who = "a peer" if denial.remote else denial.enclave or "the process"
        by = "a rule of the policy denies it" if denial.by_rule else "no rule allows it"
        finding = Finding(
            "topic-denied",
            vendor,
            line,
            len(named),
            text,
            denial.enclave,
            f"{who} may not {right} {name}: {by}",
            f"`sros explain {self._root or 'KEYSTORE'} {denial.enclave or 'ENCLAVE'} {right} "
            f"{name}` says what the policy lacks.",
        )
        material = None if denial.remote else self._look(denial.enclave)
        question = _question(denial)
        if material is None or question is None:
            return finding
        answer = self._answer(material, vendor, question)
        if answer.allowed:
            found = "the permissions that lie there now allow it"
            remedy = "Restart the process: it loaded the permissions that were there before."
        else:
            found, remedy = answer.deciding.decision.text, finding.remedy
        remedy = remedy.replace("ENCLAVE", material.enclave)
        return replace(
            finding, enclave=material.enclave, found=(found,), checked=True, remedy=remedy
        )

    def _answer(self, material: Material, vendor: Vendor, question: Question) -> Answer:
        return Judge(vendor, material, self._setting(material)).answer(question)

    def _causes(
        self, material: Material, answer: Answer, codes: tuple[str, ...]
    ) -> Iterator[tuple[str, str]]:
        """The faults of an enclave, those first that the message can stand for."""
        fitting = [each for each in answer.problems if each.code in codes]
        for each in fitting or answer.problems:
            yield str(each), remedy(each.code, self._root, material.enclave)
        if not answer.problems and not answer.allowed:
            decision = answer.deciding.decision
            yield decision.text, remedy(decision.reason, self._root, material.enclave)


def _nothing_found(material: Material) -> str:
    return (
        f"Enclave {material.enclave}, as it lies there now, has no fault that would explain it: "
        "look at the files on the robot itself, its clock and its time zone."
    )


_HALVES = {
    ("rq", "publish"): ("call", "Request"),
    ("rq", "subscribe"): ("serve", "Request"),
    ("rr", "publish"): ("serve", "Reply"),
    ("rr", "subscribe"): ("call", "Reply"),
}


def _in_ros_terms(denial: Denial) -> tuple[str, str]:
    """What was tried, in the words of `question.WORDS`, and the name."""
    prefix, topic = denial.topic[:2], denial.topic[2:]
    if (prefix, denial.direction) in _HALVES:
        word, end = _HALVES[prefix, denial.direction]
        name, part, _ = topic.removesuffix(end).partition("/_action/")
        return ("execute" if part and word == "serve" else word), name
    if prefix == "rt" and topic.startswith("/"):
        return denial.direction or "use", topic
    return denial.direction or "use", denial.topic


def _question(denial: Denial) -> Question | None:
    """The question whose answer was no, about that one topic; None where that is not known."""
    if not denial.direction:
        return None
    part = Part(Verb(denial.direction), denial.topic)
    return Question(denial.direction, "topic", denial.direction, denial.topic, (part,))
