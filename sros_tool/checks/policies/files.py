"""Policy files themselves: whether they can be read, and what their includes bring."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

from lxml import etree

from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, Kind, by_id
from sros_tool.checks.policies.naming import check_counterparts, check_names
from sros_tool.checks.policies.nodes import check_nodes
from sros_tool.checks.policies.portability import check_portability
from sros_tool.checks.policies.rules import check_rules
from sros_tool.checks.policies.stated import CheckedPolicy
from sros_tool.errors import SrosError
from sros_tool.policy.model import Policy
from sros_tool.policy.reader import read_policy
from sros_tool.xml import parse, read_bytes

MALFORMED = Kind(
    "policy.malformed",
    ERROR,
    "a policy that cannot be read",
    "Nothing can be made from it.",
    "SROS2 policy XML 0.2.0 (policy.xsd of ros2/sros2) and the names of ROS 2.",
    "Correct it where the text says.",
)
DUPLICATE = Kind(
    "policy.duplicate-enclave",
    ERROR,
    "an enclave that is given twice",
    "One verb of ros2/sros2 takes the first and another one the last, so rights change with the "
    "command; sros takes neither.",
    "ros2/sros2 0.13 (create_permission, generate_artifacts).",
    "Join the two into one <enclave>.",
)
FALLBACK = Kind(
    "policy.include-fallback",
    WARNING,
    "an include whose file does not exist",
    "Its <xi:fallback> stands in, so the rights are others than those that were meant.",
    "XInclude 1.0, 4.4.",
    "Put the file there, or remove the include.",
)
REDUNDANT = Kind(
    "policy.redundant-include",
    NOTE,
    "an include that brings nothing new",
    "The same profile includes the file once more, itself or through another.",
    "XInclude 1.0.",
    "Remove it.",
)

KINDS = by_id(MALFORMED, DUPLICATE, FALLBACK, REDUNDANT)

_CHECKS = (check_rules, check_nodes, check_names, check_counterparts, check_portability)
_PLACE = re.compile(r"(?P<file>.+?):(?P<line>\d+): (?P<text>.*)", re.DOTALL)
_INCLUDE = re.compile(r"\{http://www\.w3\.org/200[13]/XInclude\}include\Z")
_MANY = 1000


def policy_findings(policy: Policy) -> Iterator[Finding]:
    """Everything that is found in a policy that could be read."""
    checked = CheckedPolicy(policy)
    for check in _CHECKS:
        yield from check(checked)


def policy_file_findings(path: Path) -> Iterator[Finding]:
    """Everything that is found in a policy file, also where it cannot be read."""
    try:
        policy = read_policy(path)
    except SrosError as error:
        yield from _unreadable(path, error)
        return
    yield from policy_findings(policy)
    yield from _includes(path)


def _unreadable(path: Path, error: SrosError) -> Iterator[Finding]:
    found = False
    for name, line in _duplicates(path):
        found = True
        yield DUPLICATE.found(name, f"{name} stands here once more", str(path), line)
    if found:
        return
    match = _PLACE.match(error.what)
    file, line, text = (match["file"], int(match["line"]), match["text"]) if match else ("", 0, "")
    why = " ".join(part for part in (f"{text or error.what}.", error.why) if part)
    yield MALFORMED.found(str(path), why, file or str(path), line, error.remedy)


def _duplicates(path: Path) -> Iterator[tuple[str, int]]:
    try:
        root = parse(read_bytes(path, "policy file"), str(path))
    except SrosError:
        return
    seen: set[str] = set()
    for element in root.iter("enclave"):
        name = element.get("path", "")
        if name in seen:
            yield name, element.sourceline or 0
        seen.add(name)


# ── includes ───────────────────────────────────────────────────────────────────────────────


def _includes(path: Path) -> Iterator[Finding]:
    """The includes in the file itself; what they include in turn is looked into once."""
    root = parse(read_bytes(path, "policy file"), str(path))
    below: dict[Path, frozenset[Path]] = {}
    for parent in root.iter():
        includes = [child for child in parent if _INCLUDE.match(str(child.tag))]
        files = [_target(path, child) for child in includes]
        for index, (element, file) in enumerate(zip(includes, files, strict=True)):
            href = element.get("href", "")
            line = element.sourceline
            if not file.exists():
                yield FALLBACK.found(str(path), f"'{href}' does not exist", str(path), line)
                continue
            others = [each for number, each in enumerate(files) if number != index]
            twice = file in files[:index] and element.get("xpointer") in (
                each.get("xpointer") for each in includes[:index]
            )
            if twice or any(file != o and file in _reached(o, below) for o in others):
                text = f"'{href}' comes with another include of the same profile"
                yield REDUNDANT.found(str(path), text, str(path), line)


def _target(path: Path, element: etree._Element) -> Path:
    return Path(os.path.realpath(path.parent / unquote(element.get("href", ""))))


def _reached(file: Path, known: dict[Path, frozenset[Path]]) -> frozenset[Path]:
    """The files that one includes, itself or through others."""
    if file in known:
        return known[file]
    known[file] = frozenset()  # for includes in a circle
    reached: set[Path] = set()
    if file.exists() and len(known) < _MANY:
        root = parse(read_bytes(file, "policy file"), str(file))
        for element in root.iter():
            if _INCLUDE.match(str(element.tag)):
                target = _target(file, element)
                reached |= {target, *_reached(target, known)}
    known[file] = frozenset(reached)
    return known[file]
