"""Turns the security messages of a log into causes and remedies, with the enclave looked at.

The lines of several processes may be mixed, with the labels of ros2 launch, journald or Docker
Compose before them, with colours, and with tracebacks between them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from shlex import quote

from sros_tool.dds.decision.answers import Verb
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.explain.answer import Answer, Judge, Setting
from sros_tool.explain.denials import Denial, nodes_served, read_denials, serving_node
from sros_tool.explain.material import Material
from sros_tool.explain.question import Part, Question, ask
from sros_tool.explain.remedy import remedy
from sros_tool.faults import Fault
from sros_tool.graph.observation import PUBLISH
from sros_tool.policy.patterns import covers
from sros_tool.runtime.vendor_log import (
    CONTINUED,
    DOMAIN_OF_LINE,
    PROCESS_LABEL,
    SECURITY_DIRECTORY,
    UNKNOWN,
    LogText,
    denied_topic,
    log_text,
    plain_refusal,
    plain_text,
)
from sros_tool.translate import grant_rights

_WORDS = (re.compile(r"[\w/]+"), re.compile(r"[^\s(]+"), re.compile(r"\S+"))
"""As what a topic stands in a line: between punctuation, or with it where it has some itself."""
_NUMBERS = re.compile(r"\b[0-9a-f]{2}(?:\.[0-9a-f]{2}){5,}\S*|\d+")
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
    """A line that has a meaning; ``said`` is what it says itself, by the names of a pattern."""

    line: int
    text: str
    process: str
    enclave: str
    meaning: LogText
    said: Mapping[str, str]

    @property
    def cause(self) -> str:
        return self.meaning.cause.format(**self.said)

    @property
    def quoted(self) -> Mapping[str, str]:
        """What the line says, as words of a command: whoever wrote the log chose them."""
        return {name: quote(text) for name, text in self.said.items()}

    @property
    def kind(self) -> str:
        """What is the same of lines that are told as one."""
        if self.meaning is not UNKNOWN:
            return f"{self.meaning.id} {self.cause}"
        return _NUMBERS.sub("", plain_refusal(self.text))


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
        if current and CONTINUED.match(line):
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
        text = _without_label(line)
        meaning, match = _meaning_of(line, text)
        if match:
            said = {name: found or "" for name, found in match.groupdict().items()}
            if domain := DOMAIN_OF_LINE.search(line):
                said["domain"] = domain[1]
            yield _Hit(number, text, process, enclaves.get(process, ""), meaning, said)


def _meaning_of(line: str, text: str) -> tuple[LogText, re.Match[str] | None]:
    """What a line means, which is ``text`` without its label; UNKNOWN where only that is clear."""
    if found := log_text(line):
        return found
    return UNKNOWN, None if denied_topic(line) else UNKNOWN.pattern.search(text)


def _process(line: str) -> str:
    label = PROCESS_LABEL.match(line)
    return label[0].strip() if label else ""


def _without_label(line: str) -> str:
    label = PROCESS_LABEL.match(line)
    return " ".join(line[label.end() if label else 0 :].split())


def _strongest(hits: Iterable[_Hit], told: set[str]) -> Iterator[_Hit]:
    """The hits without those that only follow on others, or on what is ``told``, of a process."""
    found = list(hits)
    least = dict.fromkeys(told, 0)
    for hit in found:
        if hit.meaning is not UNKNOWN:
            least[hit.process] = min(hit.meaning.weak, least.get(hit.process, hit.meaning.weak))
    return (hit for hit in found if hit.meaning.weak <= least.get(hit.process, 0))


def _grouped(hits: Iterable[_Hit]) -> Iterator[list[_Hit]]:
    groups: dict[tuple[str, str, str], list[_Hit]] = {}
    for hit in hits:
        groups.setdefault((hit.process, hit.enclave, hit.kind), []).append(hit)
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
            meaning.remedy.format(**first.quoted),
        )
        looked_at = meaning.faults or meaning.id == "service"
        material = self._look(first.enclave) if looked_at else None
        if material is None:
            return plain
        answer = self._answer(material, meaning.vendor or Vendor.FAST, ask("join"))
        causes = list(self._causes(material, answer, meaning.faults))
        if meaning.id == "service" and not causes:
            return replace(plain, enclave=material.enclave, found=_nodes(answer), checked=True)
        causes = causes or list(self._out_of_domain(material, answer, first))
        remedies = list(dict.fromkeys(remedy for _, remedy in causes if remedy))
        nothing = f"{_nothing_found(material)} {meaning.unseen.format(**first.quoted)}".rstrip()
        return replace(
            plain,
            enclave=material.enclave,
            found=tuple(text for text, _ in causes),
            checked=True,
            remedy=" ".join(remedies) if remedies else nothing,
        )

    def denial(self, denial: Denial, named: list[tuple[int, str]]) -> Finding:
        """A topic that was denied, with the lines that name it."""
        line, text = named[0][0], _without_label(named[0][1])
        right, name = _in_ros_terms(denial)
        who = "a peer" if denial.remote else denial.enclave or "the process"
        by = "a rule of the policy denies it" if denial.by_rule else "no rule allows it"
        if node := serving_node(denial):
            by += f"; every node has such a service, and this one is the node {node}"
        finding = Finding(
            "topic-denied",
            denial.vendor,
            line,
            len(named),
            text,
            denial.enclave,
            f"{who} may not {right} {name}: {by}",
            f"`sros explain {self._root or 'KEYSTORE'} {denial.enclave or 'ENCLAVE'} {right} "
            f"{name}` says what the policy lacks.",
        )
        material = None if denial.remote else self._look(denial.enclave)
        if material is None or not denial.direction:
            return finding
        question = _question(denial)
        answer = self._answer(material, denial.vendor, question)
        if answer.allowed:
            found = ["the permissions that lie there now allow it"]
            remedy = "Restart the process: it loaded the permissions that were there before."
        else:
            found = [answer.deciding.decision.text]
            other, better = _other_node(denial, answer)
            found += other
            remedy = better or finding.remedy
        remedy = remedy.replace("ENCLAVE", material.enclave)
        return replace(
            finding, enclave=material.enclave, found=tuple(found), checked=True, remedy=remedy
        )

    def _answer(self, material: Material, vendor: Vendor, question: Question) -> Answer:
        return Judge(vendor, material, self._setting(material)).answer(question)

    def _causes(
        self, material: Material, answer: Answer, faults: tuple[Fault, ...]
    ) -> Iterator[tuple[str, str]]:
        """The faults of an enclave, those first that the message can stand for."""
        fitting = [each for each in answer.problems if each.fault in faults]
        for each in fitting or answer.problems:
            yield str(each), remedy(each.fault, self._root, material.enclave, each.file)
        if not answer.problems and not answer.allowed:
            decision = answer.deciding.decision
            yield decision.text, remedy(decision.reason, self._root, material.enclave)

    def _out_of_domain(
        self, material: Material, answer: Answer, hit: _Hit
    ) -> Iterator[tuple[str, str]]:
        """That a process was in a domain its documents are not for, where only that is left."""
        topic, said = hit.said.get("topic", ""), hit.said.get("domain", "")
        if hit.meaning.id == "domain" and topic:
            asked = _question(Denial(topic, PUBLISH))
            decision = self._answer(material, answer.vendor, asked).deciding.decision
            if decision.reason == "no-topic-rule":
                yield decision.text, remedy(decision.reason, self._root, material.enclave)
                return
        governed = material.domains
        if hit.meaning.id not in _OF_DOMAINS or governed is None:
            return
        where = f"domain {said}" if said else "another domain"
        if said and int(said) in governed:
            return
        yield (
            f"the governance is for domain {governed}: the process was in {where}, or had another "
            "governance then",
            remedy(Fault.GOVERNANCE_DOMAIN, self._root, material.enclave).replace(
                "domain of the keystore", f"domain of the keystore, such as {next(iter(governed))}"
            ),
        )


def _nodes(answer: Answer) -> tuple[str, ...]:
    """For which nodes the permissions of an enclave are, as far as they tell."""
    rights = grant_rights("", answer.grant) if answer.grant else ()
    nodes = nodes_served((each.right, each.name) for each in rights)
    if nodes:
        return (f"its permissions are for {_listed(nodes)}",)
    return (f"its permissions have nothing of {_EVERY_NODE}",)


def _other_node(denial: Denial, answer: Answer) -> tuple[list[str], str]:
    """What is to be said where a node has not the name that its permissions are for."""
    rights = [(each.right, each.name) for each in grant_rights("", answer.grant)] if (
        answer.grant
    ) else []  # fmt: skip
    node, nodes = serving_node(denial), nodes_served(rights)
    if node and nodes and not any(covers(each, node) for each in nodes):
        ns, _, name = nodes[0].rpartition("/")
        return [f"the permissions are for {_listed(nodes)}, and this is the node {node}"], (
            f"Start it under that name (`--ros-args -r __node:={name} -r __ns:={ns or '/'}`); or, "
            f"if {node} is right, give it a profile in the policy of ENCLAVE, with common/node.xml."
        )
    if not nodes and (node or denial.topic in _OF_EVERY_NODE):
        return [f"the permissions have nothing of {_EVERY_NODE}"], (
            'Put <xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/> into the '
            "node's profile: `sros generate_policy POLICY --enclave ENCLAVE --from-log LOG` does."
        )
    return [], ""


def _listed(nodes: Sequence[str]) -> str:
    return f"the node{'s' * (len(nodes) > 1)} {', '.join(nodes)}"


def _nothing_found(material: Material) -> str:
    return (
        f"Enclave {material.enclave}, as it lies there now, has no fault that would explain it: "
        "look at the files on the robot itself, its clock and its time zone."
    )


_OF_DOMAINS = ("domain", "domain-of-permissions")
_EVERY_NODE = "what every node has: parameter services, /rosout, /parameter_events"
_OF_EVERY_NODE = ("rt/rosout", "rt/parameter_events")

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


def _question(denial: Denial) -> Question:
    """The question whose answer was no, about that one topic."""
    part = Part(Verb(denial.direction), denial.topic)
    return Question(denial.direction, "topic", denial.direction, denial.topic, (part,))
