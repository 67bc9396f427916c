"""Finds the smallest change of a policy by which DDS would allow what it denies now.

A right is added only if none covers the question, and a denial is lifted only if it stands in the
way; the result is tried out on the decision engine before it is proposed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from lxml import etree

from sros_tool.dds.decision import Vendor, Verb
from sros_tool.dds.governance import Governance
from sros_tool.explain.answer import Judge, PartAnswer, Setting
from sros_tool.explain.material import from_policy
from sros_tool.explain.origin import origins_of
from sros_tool.explain.question import Question
from sros_tool.names import dds_names
from sros_tool.policy.model import (
    DENY,
    Enclave,
    Group,
    Policy,
    Profile,
    Profiles,
    Source,
)
from sros_tool.policy.rights import Right
from sros_tool.policy.writer import write_policy

_NO_RULE = frozenset({"no-rule", "default"})


@dataclass(frozen=True, slots=True)
class Edit:
    """A group of a policy file that is to be replaced; ``xml`` may be "", where nothing is left."""

    source: Source
    xml: str


@dataclass(frozen=True, slots=True)
class Change:
    """Rights to add and denials to lift.

    ``document`` is a policy of the additions alone, for ``sros merge_policy``; ``edits`` are how
    the groups that deny have to read, where the policy file is known.
    """

    add: tuple[Right, ...]
    lift: tuple[Right, ...]
    document: str
    edits: tuple[Edit, ...]


def smallest_change(
    enclave: str,
    rights: Iterable[Right],
    question: Question,
    governance: Governance,
    vendor: Vendor,
    setting: Setting,
    policy: Enclave | None = None,
) -> Change | None:
    """The change that makes ``vendor`` allow the question, or None if no policy could.

    ``rights`` are what the enclave has now, ``policy`` is where they come from, if that is known.
    """
    if not question.right:
        return None
    wanted = question.allowed(enclave)
    present = {right for right in rights if right.kind != "dds"}
    add: list[Right] = []
    lift: list[Right] = []
    while True:
        material = from_policy(as_policy(enclave, present), governance, at=setting.at)
        answer = Judge(vendor, material, setting).answer(question)
        decision = answer.deciding.decision
        if answer.allowed:
            break
        if decision.reason == "deny-rule":
            blocking = _blocking(present, answer.deciding, decision.expression or "")
        elif decision.reason in _NO_RULE and wanted not in present:
            present.add(wanted)
            add.append(wanted)
            continue
        else:
            return None
        if not blocking:
            return None
        present.difference_update(blocking)
        lift += sorted(blocking)
    return Change(
        tuple(add),
        tuple(lift),
        _document(add, policy),
        tuple(_edits(lift, policy)) if policy else (),
    )


def as_policy(enclave: str, rights: Iterable[Right]) -> Enclave:
    """An enclave with one nameless node that has these rights."""
    groups = tuple(
        Group(right.kind, ((right.right, right.qualifier),), (right.name,))
        for right in sorted(rights)
    )
    return Enclave(enclave, (Profiles((Profile("/", "", groups),)),))


def _blocking(rights: Iterable[Right], deciding: PartAnswer, expression: str) -> list[Right]:
    """The denials from which an expression comes; of the other direction only if it must be.

    Cyclone DDS denies a topic as a whole by a denial of either direction.
    """
    publishes = deciding.part is not None and deciding.part.verb is Verb.PUBLISH
    own: list[Right] = []
    other: list[Right] = []
    for right in rights:
        if right.qualifier is DENY:
            names = dds_names(right.right, right.name)
            if expression in (names.publish if publishes else names.subscribe):
                own.append(right)
            elif expression in names.publish + names.subscribe:
                other.append(right)
    return own or other


def _document(add: list[Right], policy: Enclave | None) -> str:
    if not add:
        return ""
    (right,) = add
    ns, node = _place(right, policy)
    group = Group(right.kind, ((right.right, right.qualifier),), (right.name,))
    enclave = Enclave(right.enclave, (Profiles((Profile(ns, node, (group,)),)),))
    return write_policy(Policy((enclave,))).decode().rstrip()


def _place(right: Right, policy: Enclave | None) -> tuple[str, str]:
    """The node that gets a right: the innermost one whose namespace the name lies in."""
    profiles = policy.all_profiles() if policy else ()
    fitting = [
        each for each in profiles if right.name.startswith(each.ns.rstrip("/") + "/")
    ] or list(profiles)
    if not fitting:
        return "/", right.enclave.rpartition("/")[2] or "node"
    best = max(fitting, key=lambda each: len(each.ns))
    return best.ns, best.node


def _edits(lift: list[Right], policy: Enclave) -> Iterable[Edit]:
    """What each group that denies has to read without these denials."""
    groups: dict[Source, Group] = {}
    found: dict[Source, set[tuple[str, str]]] = {}
    for right in lift:
        for origin in origins_of(policy, right):
            groups[origin.group.source] = origin.group
            found.setdefault(origin.group.source, set()).add((origin.name, origin.right))
    for source, lifted in found.items():
        group = groups[source]
        kept: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for name in group.names:
            rights = tuple(each for each in group.rights if (name, each[0]) not in lifted)
            if rights:
                kept.setdefault(rights, []).append(name)
        yield Edit(source, "\n".join(_xml(group.kind, *each) for each in kept.items()))


def _xml(kind: str, rights: tuple[tuple[str, str], ...], names: list[str]) -> str:
    element = etree.Element(kind, dict(rights))
    for name in names:
        etree.SubElement(element, kind.removesuffix("s")).text = name
    etree.indent(element, space="  ")
    return etree.tostring(element, encoding="unicode")
