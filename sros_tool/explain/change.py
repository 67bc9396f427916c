"""Find the smallest change of a policy that makes a vendor allow a denied question.

A right is added only if no right covers the question, and a denial is removed only if it prevents
the answer "allowed"; the decision engine checks the result before it is proposed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from lxml import etree

from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.dds.governance import parse_governance
from sros_tool.errors import SrosError
from sros_tool.explain.answer import Answer, GroupEdit, PolicyChange, lines_of_right
from sros_tool.explain.evaluator import Evaluator
from sros_tool.keystore.participant import plan_enclave
from sros_tool.names import NODE_SERVICES, dds_names, is_expression, nodes_served
from sros_tool.policy.document import write_policy
from sros_tool.policy.model import ALLOW, DENY, Enclave, Group, Policy, Profile, Profiles, Source
from sros_tool.policy.rights import Right, profile_rights
from sros_tool.translate import grant_rights

_NO_RULE = frozenset({"no-rule", "default"})


def smallest_change(evaluator: Evaluator, answer: Answer) -> PolicyChange | None:
    """Return the change that makes the evaluator's vendor allow a denied question.

    It starts from the policy of the enclave or, if that is not known, from the rights in its
    permissions.  Returns None if no policy could allow the question.
    """
    enclave, question = evaluator.enclave, answer.question
    if not question.right:
        return None
    try:
        governance = enclave.plain_governance or parse_governance(enclave.governance)
    except SrosError:
        return None
    wanted = question.allowed(enclave.name)
    present = _present_rights(enclave.policy, enclave.name, answer)
    add: list[Right] = []
    lift: list[Right] = []
    while True:
        planned = plan_enclave(
            policy_of(enclave.name, present), governance, at=evaluator.context.at
        )
        tried = Evaluator(evaluator.vendor, planned, evaluator.context).answer(question)
        if tried.allowed:
            return PolicyChange(
                tuple(add),
                tuple(lift),
                _addition(add[0], _places(enclave.policy, answer)) if add else "",
                tuple(_edits(lift, enclave.policy)) if enclave.policy else (),
            )
        if tried.reason in _NO_RULE and wanted not in present:
            present.add(wanted)
            add.append(wanted)
            continue
        blocking = _blocking(present, tried) if tried.reason == "deny-rule" else []
        if not blocking:
            return None
        present.difference_update(blocking)
        lift += sorted(blocking)


def policy_of(name: str, rights: Iterable[Right]) -> Enclave:
    """Return the policy of an enclave with a single nameless node that has these rights."""
    groups = tuple(
        Group(right.kind, ((right.right, right.qualifier),), (right.name,))
        for right in sorted(rights)
    )
    return Enclave(name, (Profiles((Profile("/", "", groups),)),))


def _present_rights(policy: Enclave | None, name: str, answer: Answer) -> set[Right]:
    """Return the present rights of an enclave, except those that no policy can state."""
    found: Iterable[Right] = ()
    if policy:
        found = (r for each in policy.all_profiles() for r in profile_rights(name, each))
    elif answer.grant:
        found = grant_rights(name, answer.grant)
    return {right for right in found if right.kind != "dds"}


def _blocking(rights: Iterable[Right], answer: Answer) -> list[Right]:
    """Return the denials that the deciding expression of an answer comes from.

    Denials of the other direction count only if there is no other: Cyclone DDS denies a whole topic
    because of a denial in either direction.
    """
    expression = answer.decision.expression or ""
    publishes = answer.part is not None and answer.part.verb is AccessVerb.PUBLISH
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


_ANY_NODE = ("/", "*")
"""Namespace and name of a profile for any node: DDS decides by the enclave alone."""


def _addition(right: Right, places: Iterable[tuple[str, str]]) -> str:
    """Return a policy with one right, in the profile of the node that it belongs to.

    It belongs to the node with the longest namespace around the right's name, of ``places``
    (namespace and name of nodes).  Without any, no name of a node is invented.
    """
    known = list(places)
    fitting = [each for each in known if right.name.startswith(each[0].rstrip("/") + "/")]
    ns, node = max(fitting or known, key=lambda each: len(each[0]), default=_ANY_NODE)
    group = Group(right.kind, ((right.right, right.qualifier),), (right.name,))
    enclave = Enclave(right.enclave, (Profiles((Profile(ns, node, (group,)),)),))
    return write_policy(Policy((enclave,))).decode().rstrip()


def _places(policy: Enclave | None, answer: Answer) -> Iterator[tuple[str, str]]:
    """Yield namespace and name of an enclave's nodes.

    Without its policy, these are the nodes whose standard services its permissions allow.
    """
    if policy:
        yield from ((each.ns, each.node) for each in policy.all_profiles())
        return
    for node in nodes_served((each.right, each.name) for each in _granted(answer)):
        ns, _, name = node.rpartition("/")
        yield ns or "/", name


def _granted(answer: Answer) -> Iterator[Right]:
    if answer.grant:
        yield from grant_rights("", answer.grant)


_ALIKE = 0.9
"""The lowest similarity (`difflib`) of a typo in a ROS name."""


def likely_names(answer: Answer) -> tuple[str, ...]:
    """Return at most three names of the same right that the denied name of a question may mean.

    For a standard service of a node, these are the services of the enclave's nodes; for any other
    name, those with the same last part, as a forgotten remapping leaves it, and else those that are
    spelled almost alike.
    """
    question, enclave = answer.question, answer.enclave
    names = {
        each.name
        for each in _present_rights(enclave.policy, enclave.name, answer)
        if (each.right, each.qualifier) == (question.right, ALLOW) and not is_expression(each.name)
    } - {question.name}
    last = question.name.rpartition("/")[2]
    same = sorted(each for each in names if each.rpartition("/")[2] == last)
    if (question.type == "service" and last in NODE_SERVICES) or 0 < len(same) <= _SHOWN:
        return tuple(same) if len(same) <= _SHOWN else ()
    from difflib import get_close_matches  # for this alone, which is asked last

    return tuple(get_close_matches(question.name, sorted(names), n=_SHOWN, cutoff=_ALIKE))


_SHOWN = 3
"""The number of names that are proposed at most."""


def _edits(lift: list[Right], policy: Enclave) -> Iterator[GroupEdit]:
    """Yield a replacement without these denials for each group that contains one."""
    groups: dict[Source, Group] = {}
    lifted: dict[Source, set[tuple[str, str]]] = {}
    for right in lift:
        for line in lines_of_right(policy, right):
            groups[line.group.source] = line.group
            lifted.setdefault(line.group.source, set()).add((line.name, line.right))
    for source, group in groups.items():
        kept: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for name in group.names:
            rights = tuple(each for each in group.rights if (name, each[0]) not in lifted[source])
            if rights:
                kept.setdefault(rights, []).append(name)
        yield GroupEdit(source, "\n".join(_xml(group.kind, *each) for each in kept.items()))


def _xml(kind: str, rights: tuple[tuple[str, str], ...], names: list[str]) -> str:
    element = etree.Element(kind, dict(rights))
    for name in names:
        etree.SubElement(element, kind.removesuffix("s")).text = name
    etree.indent(element, space="  ")
    return etree.tostring(element, encoding="unicode")
