"""The answer to a question: the outcome, what decided it, and the lines of the policy behind it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from sros_tool.dds.decision.answers import AccessVerb, Decision, Outcome
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.governance import DomainRule
from sros_tool.dds.permissions import Grant
from sros_tool.explain.question import Part, Question
from sros_tool.keystore.reader import Problem
from sros_tool.names import expand, is_expression
from sros_tool.policy.model import ALLOW, DENY, Enclave, Group, Profile, Qualifier, Source
from sros_tool.policy.rights import Right
from sros_tool.topics import dds_names

if TYPE_CHECKING:
    from sros_tool.explain.change import PolicyChange


class Provenance(StrEnum):
    """Whether signed permissions were made from a policy file."""

    SAME = "same"
    """They were made from the file as it is now."""
    EQUAL = "equal"
    """The file has changed since then, or it is another one, and it states the same rights."""
    CHANGED = "changed"
    """The file states other rights than they have."""
    UNKNOWN = "unknown"
    """The ledger does not have the file that they were made from."""
    PLANNED = "planned"
    """The answer is about the policy; nothing is signed yet."""


@dataclass(frozen=True, slots=True)
class PolicyLine:
    """A name in a policy that became part of a rule, with its position and its right.

    ``group`` and ``profile`` contain the name; ``right`` is the word of the policy language.
    """

    source: Source
    qualifier: Qualifier
    right: str
    name: str
    group: Group
    profile: Profile

    def __str__(self) -> str:
        """Return text like ``robot.xml:12: ALLOW publish chatter``."""
        return f"{self.source}: {self.qualifier.value} {self.right} {self.name}"


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of one vendor to a question, with an explanation on request.

    ``decision`` determines the outcome; ``part`` is the endpoint that it is about, None if it is
    about joining.  ``parts`` are all endpoints of the question with the decisions on them.
    ``problems`` are the faults of files that keep the vendor from loading the enclave.  ``grant``
    and ``domain_rule`` are the parts of the documents that apply.  ``until`` is the time when
    ``until_file``, the first of the files, expires; None if nothing is signed.

    `Evaluator.explain` fills in the other fields.  ``lines`` are the lines of the policy file that
    the deciding rule comes from, and ``provenance`` says whether the permissions were made from
    that file; ``policy_sha256`` is the digest of the file that they were made from, "" if it is not
    known.  For a denial, ``change`` is the necessary change of the policy, ``remedy`` is what to do
    if no policy can help, and ``sign`` says that the present policy file, once signed, allows it.
    """

    vendor: Vendor
    question: Question
    outcome: Outcome
    decision: Decision
    part: Part | None = None
    parts: tuple[tuple[Part, Decision], ...] = ()
    problems: tuple[Problem, ...] = ()
    grant: Grant | None = None
    domain_rule: DomainRule | None = None
    until: datetime | None = None
    until_file: str = ""
    lines: tuple[PolicyLine, ...] = ()
    provenance: Provenance | None = None
    policy_sha256: str = ""
    change: PolicyChange | None = None
    remedy: str = ""
    sign: bool = False

    @property
    def allowed(self) -> bool:
        """Whether data can flow."""
        return self.outcome.ok

    @property
    def as_documented(self) -> bool:
        """Whether the answer relies on the vendor's documentation alone, not on tests."""
        return self.vendor.documented_only and not self.problems

    @property
    def wildcard(self) -> str:
        """The expression of the deciding rule if it is a wildcard, or ""."""
        expression = self.decision.expression or ""
        return expression if is_expression(expression) else ""

    @property
    def denied_by(self) -> str:
        """The process that denies it, with the consequence; "" if it is allowed."""
        match self.outcome:
            case Outcome.ALLOWED:
                return ""
            case Outcome.PEER_DENIES:
                return "the peers: the node starts, and none of them talks to it"
            case Outcome.CRASHES if self.decision.hits_peers:
                return "nobody: the node starts, and the processes of its peers crash"
            case Outcome.CRASHES:
                return "nobody: the process crashes when it starts"
            case Outcome.DENIED if self.part in self.question.parts:
                what = _CREATED.get(self.question.word, "it")
                return f"DDS in the process itself: {what} is not created"
            case _:
                return "DDS in the process itself: no node of the enclave starts"


_CREATED = {
    "publish": "the publisher",
    "subscribe": "the subscription",
    "call": "the client",
    "request": "the client",
    "serve": "the server",
    "reply": "the server",
    "execute": "the action server",
}


# ── the policy behind an answer ────────────────────────────────────────────────────────────


def recorded_policy(root: Path, signed: bytes) -> str:
    """Return the SHA-256 of the policy that signed permissions were made from, or "".

    It comes from the ledger of the keystore at ``root``; it is "" if there is no ledger or entry.
    """
    from sros_tool.keystore.ledger import read_ledger

    digest = hashlib.sha256(signed).hexdigest()
    ledger = read_ledger(root, having=("sha256", digest))
    found = (e.policy for e in reversed(ledger.certain) if e.sha256 == digest)
    return next(found, "")


def template_default(digest: str) -> str:
    """Return which default of keystore templates has this digest (`recorded_policy`), or "".

    It is "everything" or "node_basics", a value of the template's ``permissions.default``.
    """
    from sros_tool.files import policies_dir
    from sros_tool.policy.document import read_policy

    files = sorted((policies_dir() / "defaults").glob("*.xml"))
    return next((f.stem for f in files if read_policy(f).enclaves[0].digest == digest), "")


def deciding_lines(policy: Enclave, answer: Answer) -> tuple[PolicyLine, ...]:
    """Return the names in an enclave's policy that the deciding rule of an answer comes from.

    Several nodes of an enclave may have the same right, so there may be several.
    """
    expression, part = answer.decision.expression, answer.part
    if part is None or not expression or answer.grant is None:
        return ()
    rule = answer.grant.rules[answer.decision.rule or 0]
    qualifier = ALLOW if rule.allow else DENY
    # Cyclone DDS denies a whole topic, also because of a rule for the other direction.
    other = AccessVerb.SUBSCRIBE if part.verb is AccessVerb.PUBLISH else AccessVerb.PUBLISH
    for verb in (part.verb, other):
        found = tuple(
            each
            for each in _lines(policy)
            if each.qualifier is qualifier and expression in _topics(each, verb)
        )
        if found:
            return found
    return ()


def lines_of_right(policy: Enclave, right: Right) -> tuple[PolicyLine, ...]:
    """Return the names in an enclave's policy that state a right or denial."""
    return tuple(
        each
        for each in _lines(policy)
        if (each.qualifier, each.right) == (right.qualifier, right.right)
        and expand(each.name, each.profile.ns, each.profile.node) == right.name
    )


def _lines(policy: Enclave) -> Iterator[PolicyLine]:
    for profile in policy.all_profiles():
        for group in profile.groups:
            for index, name in enumerate(group.names):
                source = group.source_of(index)
                for right, qualifier in group.rights:
                    yield PolicyLine(source, qualifier, right, name, group, profile)


def _topics(line: PolicyLine, verb: AccessVerb) -> tuple[str, ...]:
    names = dds_names(line.right, expand(line.name, line.profile.ns, line.profile.node))
    return names.publish if verb is AccessVerb.PUBLISH else names.subscribe
