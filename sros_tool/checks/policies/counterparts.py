"""Checks of names for which no enclave of a policy has the counterpart right."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import cache

from sros_tool.checks.kind import NOTE, WARNING, Finding, FindingKind, RelatedPlace
from sros_tool.checks.policies.statements import CheckedPolicy, PolicyStatement
from sros_tool.names import (
    ACTION_SEPARATOR,
    GLOBAL_TOPICS,
    NODE_SERVICES,
    READING_SERVICES,
    action_part,
    expand,
    is_expression,
)
from sros_tool.policy.model import OFFERING_RIGHT, RIGHTS, Source
from sros_tool.policy.patterns import Names
from sros_tool.spelling import NearNames

_NAMES_SHOWN = 3

NO_COUNTERPART = FindingKind(
    "policy.no-counterpart",
    NOTE,
    "a name for which no enclave has the counterpart right",
    "No enclave, in any ROS domain, may publish this subscribed topic, or serve this called "
    "service or action. The name may have a typing error, or its counterpart is in a policy "
    "that was not checked in the same command. This check leaves out names that many nodes "
    "share, such as /tf, /clock and /diagnostics, and services of any node, such as "
    "/*/get_state.",
    "sros: compares the rights of all enclaves in the policies that are checked together.",
    "Compare the names that senders and receivers have after remapping, and name all policies of "
    "the robot in one command.",
)
NOT_OFFERED = FindingKind(
    "policy.not-offered",
    NOTE,
    "a called service or action that the node in its name may not offer",
    "No call succeeds, because the policy does not let this node offer the service or action. "
    "Perhaps it was renamed. Or the node was: then it is not in the policy, but another node of "
    "the namespace offers a service or action with the same last part, which nobody calls.",
    "sros: compares the rights of all enclaves in the policies that are checked together.",
    "Write the new name at the node that calls, or allow the other node to offer the old name. "
    "Ignore this finding if another policy of the robot has the server.",
    prominent=True,
)
MISSPELT = FindingKind(
    "policy.name-misspelt",
    WARNING,
    "a name that differs from its likely counterpart in spelling, namespace or kind",
    "Neither of the two names has an exact counterpart, so the nodes do not communicate. One name "
    "may be misspelled, lack a namespace, or be of another kind, such as a service where an action "
    "is called.",
    "sros: compares the rights of all enclaves in the policy.",
    "Write the same name, of the same kind, in both places, as the nodes have it after remapping.",
)
MISTAKEN_SIDE = FindingKind(
    "policy.side-mistaken",
    WARNING,
    "a service or action for which request and reply, or call and execute, were confused",
    "A node offers (reply, execute) the services and actions under its own name, and other nodes "
    "use them (request, call). The rule states the wrong side, and nobody has its counterpart, so "
    "no call succeeds.",
    "sros: compares the rights of all enclaves in the policy.",
    'Write reply="ALLOW" (action: execute) at the node that offers the service, and '
    'request="ALLOW" (action: call) at the nodes that use it.',
)
_ASKING_RIGHT = {offering: asking for asking, offering in OFFERING_RIGHT.items()}


def check_counterparts(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about subscribed or called names that no enclave may publish or serve."""
    names: dict[str, set[str]] = {right: set() for pair in RIGHTS.values() for right in pair}
    for statement in checked_policy.statements:
        if statement.allows:
            names[statement.right.right].add(statement.name)
    sides = {right: Names(sorted(names_of_right)) for right, names_of_right in names.items()}

    def is_alone(statement: PolicyStatement, other: str) -> bool:
        name = statement.name
        if not statement.allows or is_expression(name) or name in GLOBAL_TOPICS:
            return False
        # The counterpart may be in a right to the whole action.
        return not sides[other].overlaps(name) and not action_part(name)[1]

    alone = [
        statement
        for statement in checked_policy.statements
        if (other := _ASKING_RIGHT.get(statement.right.right)) and is_alone(statement, other)
    ]
    yield from _offered_by_others_findings(alone)
    offered: dict[str, list[PolicyStatement]] = defaultdict(list)
    for statement in alone:
        if not _is_service_of_every_node(statement.name):
            offered[statement.name].append(statement)
    nodes = {
        expand("~", statement.profile.ns, statement.profile.node)
        for statement in checked_policy.statements
    }
    near = NearNames(offered)
    spelled = cache(lambda side: NearNames(e for e in names[side] if not is_expression(e)))
    for statement in checked_policy.statements:
        other = OFFERING_RIGHT.get(statement.right.right)
        if not other or not is_alone(statement, other):
            continue
        if statement.right.kind != "topics" and statement.is_private:
            text = (
                f"the node may {statement.right.describe()}, a name of its own that nobody offers"
            )
            yield statement.found(MISTAKEN_SIDE, text, f'Write {other}="ALLOW" for it.')
            continue
        candidates = [
            candidate
            for name in (statement.name, *near.similar_names(statement.name))
            for candidate in offered.get(name, ())
        ] + [
            candidate
            for name in near.same_name_elsewhere(statement.name)
            for candidate in offered[name]
            if candidate.right.right == other
        ]
        # The same node may use one name for a topic and a service, so its own names are no
        # suggestions.
        candidates = [
            candidate for candidate in candidates if candidate.profile is not statement.profile
        ]
        same_end = [
            candidate
            for name in near.names_with_same_end(statement.name)
            for candidate in offered[name][:1]
            if candidate.right.right == other and candidate.profile is not statement.profile
        ]
        if (
            not candidates
            and len(same_end) == 1
            and _differ_only_by_namespace(statement, same_end[0])
        ):
            candidates = same_end
        if candidates:
            yield _misspelt_name_finding(statement, other, candidates)
        else:
            hint = f"; {_candidates_text(same_end)}" if same_end else ""
            # All of the similar names are used.
            if similar := spelled(other).similar_names(statement.name):
                hint = f"; perhaps you mean {' or '.join(similar[:_NAMES_SHOWN])} ({other})"
            name = statement.name
            node = name.rpartition("/")[0]
            is_of_node = statement.right.kind != "topics" and (
                node in nodes or any(_is_of_sibling(candidate, node) for candidate in same_end)
            )
            kind = NO_COUNTERPART
            if is_of_node and not _is_service_of_every_node(name):
                kind = NOT_OFFERED
            yield statement.found(kind, f"no enclave may {other} {name}{hint}")
    for statement in checked_policy.statements:
        other, name = OFFERING_RIGHT.get(statement.right.right), statement.name
        if other not in ("publish", "reply") or not statement.allows or not is_expression(name):
            continue
        if name.removeprefix("/*/") in READING_SERVICES:  # a question to any node, if it answers
            continue
        if not sides[other].overlaps(name) and ACTION_SEPARATOR not in name:
            text = f"no enclave may {other} a name that {name} matches"
            yield statement.found(NO_COUNTERPART, text)


def _differ_only_by_namespace(statement_a: PolicyStatement, statement_b: PolicyStatement) -> bool:
    """Return whether the longer name is the shorter one with a namespace in front of it.

    Returns False if the policy writes the longer name with ``~``, and so intends the namespace.
    """
    shorter, longer = sorted((statement_a, statement_b), key=lambda statement: len(statement.name))
    return longer.name.endswith(shorter.name) and "~" not in longer.written


def _is_of_sibling(statement: PolicyStatement, node: str) -> bool:
    """Return whether a right is to a name of another node in the namespace of ``node``."""
    other = statement.name.rpartition("/")[0]
    return statement.is_private and other.rpartition("/")[0] == node.rpartition("/")[0]


def _candidates_text(candidates: Sequence[PolicyStatement]) -> str:
    texts = dict.fromkeys(f"{candidate.name} ({candidate.right.right})" for candidate in candidates)
    return f"perhaps you mean {' or '.join([*texts][:_NAMES_SHOWN])}"


def _is_service_of_every_node(name: str) -> bool:
    """Return whether every node offers this service, which then needs no client in a policy."""
    return name.rpartition("/")[2] in NODE_SERVICES


def _offered_by_others_findings(unused_statements: Iterable[PolicyStatement]) -> Iterator[Finding]:
    """Yield findings about uncalled services that are under the name of another enclave's node."""
    owners = {
        (statement.right.right, statement.name): statement
        for statement in unused_statements
        if statement.right.kind != "topics" and statement.is_private
    }
    for statement in unused_statements:
        owner = owners.get((statement.right.right, statement.name))
        if owner and not statement.is_private and statement.right.enclave != owner.right.enclave:
            asking = _ASKING_RIGHT[statement.right.right]
            place = RelatedPlace(f"{owner.right.enclave} offers it", *_source_place(owner.source))
            text = (
                f"the node may {statement.right.describe()}, under the name of a node in "
                f"{owner.right.enclave}; that enclave also offers it ({place}), and nobody may "
                f"{asking} it"
            )
            remedy = f'Write {asking}="ALLOW" for it.'
            yield statement.found(MISTAKEN_SIDE, text, remedy)._replace(related=(place,))


def _misspelt_name_finding(
    misspelt: PolicyStatement, counterpart: str, candidates: Sequence[PolicyStatement]
) -> Finding:
    """Return the finding on a name for which no enclave has the right ``counterpart``.

    The finding suggests ``candidates``, statements with similar names.
    """
    shown, remedy = candidates[:_NAMES_SHOWN], ""
    hint, first = _candidates_text(shown), shown[0]
    if first.name == misspelt.name:
        kind = first.right.kind.removesuffix("s")
        article = "an" if kind == "action" else "a"
        hint = (
            f"{first.right.enclave} offers {article} {kind} of this name ({first.right.right}), "
            "which no enclave uses"
        )
        if misspelt.right.kind == "actions":
            place = RelatedPlace("", *_source_place(first.source))
            remedy = f"Write it at {place} {_as_action(counterpart, first.written)}"
        elif kind == "action":
            remedy = f"Write it {_as_action('call', misspelt.written)}"
    text = f"no enclave may {counterpart} {misspelt.name}; {hint}"
    places = tuple(
        RelatedPlace(
            f"{candidate.right.enclave} may {candidate.right.describe()}",
            *_source_place(candidate.source),
        )
        for candidate in shown
    )
    return misspelt.found(MISSPELT, text, remedy=remedy)._replace(related=places)


def _as_action(right: str, name: str) -> str:
    return f'as an action: <actions {right}="ALLOW"><action>{name}</action></actions>.'


def _source_place(source: Source) -> tuple[str, int | None]:
    return source.file, source.line or None
