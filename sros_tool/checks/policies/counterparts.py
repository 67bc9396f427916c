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
    PARAMETER_SERVICES,
    READING_SERVICES,
    action_part,
    expand,
    is_expression,
)
from sros_tool.policy.model import OFFERING_RIGHT, Source
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
SEVERAL_SERVERS = FindingKind(
    "policy.several-servers",
    WARNING,
    "a service or action that two enclaves may serve",
    "Both receive the requests, and a client may take the answer of either. So a process in one "
    "enclave can pose as the server in the other one. (For services that set or read parameters, "
    "this is policy.other-nodes-parameters.)",
    "sros: compares the rights of all enclaves in the policies that are checked together.",
    "Remove the right from the enclave whose nodes do not serve it. If nodes of both enclaves "
    "serve it, leave this finding out: `--exclude policy.several-servers`.",
)
_ASKING_RIGHT = {offering: asking for asking, offering in OFFERING_RIGHT.items()}


def check_counterparts(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about subscribed or called names that no enclave may publish or serve."""
    statements = checked_policy.statements
    sides = _Sides(statements)
    unused = [
        statement
        for statement in statements
        if (asking := _ASKING_RIGHT.get(statement.right.right)) and sides.lack(asking, statement)
    ]
    yield from _offered_by_others_findings(unused)
    offers = _UnusedOffers(unused, statements, sides)
    for statement in statements:
        offering = OFFERING_RIGHT.get(statement.right.right)
        if offering and sides.lack(offering, statement):
            yield offers.finding_without_counterpart(statement, offering)
    for statement in statements:
        offering, name = OFFERING_RIGHT.get(statement.right.right), statement.name
        if offering not in ("publish", "reply") or not (statement.allows and is_expression(name)):
            continue
        if name.removeprefix("/*/") in READING_SERVICES:  # a question to any node, if it answers
            continue
        if not sides.names(offering).overlaps(name) and ACTION_SEPARATOR not in name:
            text = f"no enclave may {offering} a name that {name} matches"
            yield statement.found(NO_COUNTERPART, text)


def check_servers(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about services and actions that two enclaves may serve.

    The server is the enclave with the node whose name is in the name of the service, also if the
    right has a wildcard; otherwise, it is the first enclave with a right to exactly this name. The
    findings are about the other enclaves.
    """
    rules, sides = checked_policy.rules, _Sides(checked_policy.statements)
    enclaves_by_node: dict[str, dict[str, None]] = defaultdict(dict)
    for stated in checked_policy.policy.enclaves:
        for profile in stated.all_profiles():
            if profile.node:
                enclaves_by_node[profile.full_name][stated.path] = None
    offers = [statement for statement in checked_policy.statements if statement.allows]
    exact = {(statement.right.enclave, *_whole_offer(statement)) for statement in offers}
    first: dict[tuple[str, str], str] = {}
    for statement in offers:
        enclave, (right, name) = statement.right.enclave, _whole_offer(statement)
        if right not in ("reply", "execute") or is_expression(name):
            continue
        node = next((of for of in _nodes_above(name) if of in enclaves_by_node), "")
        owners = enclaves_by_node.get(node, {})
        if enclave in owners or name.rpartition("/")[2] in PARAMETER_SERVICES:
            continue
        if not rules.allow(enclave, statement.right.right, statement.name):
            continue
        if sides.lack(_ASKING_RIGHT[right], statement) and any(
            (of, right, name) in exact for of in owners
        ):
            continue  # perhaps the statement has the wrong side: `check_counterparts` says so
        other = next((of for of in owners if rules.allow(of, right, name)), "")
        where = f", under the name of a node in {other}; that enclave" if other else ""
        other = other or first.setdefault((right, name), enclave)
        if other != enclave:
            where = where or f"; {other}"
            text = f"the node may {statement.right.describe()}{where} may also serve it"
            yield statement.found(SEVERAL_SERVERS, text)


def _whole_offer(statement: PolicyStatement) -> tuple[str, str]:
    """Return right and name of a statement; a part of an action counts as the action."""
    action, part = action_part(statement.name)
    if part and statement.right.right == "reply":
        return "execute", action
    return statement.right.right, statement.name


def _nodes_above(name: str) -> Iterator[str]:
    """Yield the names that a node could have whose private name is ``name``."""
    while name := name.rpartition("/")[0]:
        yield name


class _Sides:
    """The names that enclaves may publish, subscribe to, serve or call."""

    def __init__(self, statements: Iterable[PolicyStatement]) -> None:
        self._stated: dict[str, set[str]] = defaultdict(set)
        for statement in statements:
            if statement.allows:
                self._stated[statement.right.right].add(statement.name)
        self.names = cache(lambda right: Names(sorted(self._stated[right])))
        """Returns the names of a right."""
        self.spelled = cache(
            lambda right: NearNames(e for e in self._stated[right] if not is_expression(e))
        )
        """Returns the names of a right without wildcards, to search for similar names."""

    def lack(self, counterpart: str, statement: PolicyStatement) -> bool:
        """Return whether no enclave has the right ``counterpart`` to the name of a statement."""
        name = statement.name
        if not statement.allows or is_expression(name) or name in GLOBAL_TOPICS:
            return False
        # The counterpart may be in a right to the whole action.
        return not self.names(counterpart).overlaps(name) and not action_part(name)[1]


class _UnusedOffers:
    """The offered names that nobody uses, among which the counterpart of a name may be."""

    def __init__(
        self,
        unused: Iterable[PolicyStatement],
        statements: Iterable[PolicyStatement],
        sides: _Sides,
    ) -> None:
        self._sides = sides
        self._by_name: dict[str, list[PolicyStatement]] = defaultdict(list)
        for statement in unused:
            if not _is_service_of_every_node(statement.name):
                self._by_name[statement.name].append(statement)
        self._near = NearNames(self._by_name)
        profiles = (statement.profile for statement in statements)
        self._nodes = {expand("~", profile.ns, profile.node) for profile in profiles}

    def finding_without_counterpart(self, statement: PolicyStatement, other: str) -> Finding:
        """Return the finding on a name for which no enclave has the right ``other``."""
        if statement.right.kind != "topics" and statement.is_private:
            text = (
                f"the node may {statement.right.describe()}, a name of its own that nobody offers"
            )
            return statement.found(MISTAKEN_SIDE, text, f'Write {other}="ALLOW" for it.')
        same_end = self._with_same_end(statement, other)
        candidates = self._similar(statement, other)
        if not candidates and len(same_end) == 1:
            candidates = [of for of in same_end if _differ_only_by_namespace(statement, of)]
        if candidates:
            return _misspelt_name_finding(statement, other, candidates)
        hint = f"; {_candidates_text(same_end)}" if same_end else ""
        # All of the similar names are used.
        if similar := self._sides.spelled(other).similar_names(statement.name):
            hint = f"; perhaps you mean {' or '.join(similar[:_NAMES_SHOWN])} ({other})"
        kind = NOT_OFFERED if self._is_of_node(statement, same_end) else NO_COUNTERPART
        return statement.found(kind, f"no enclave may {other} {statement.name}{hint}")

    def _similar(self, statement: PolicyStatement, other: str) -> list[PolicyStatement]:
        """Return the offers with a similar name, or with the same name in another namespace."""
        name = statement.name
        offers = [
            offer
            for similar in (name, *self._near.similar_names(name))
            for offer in self._by_name.get(similar, ())
        ] + [
            offer
            for elsewhere in self._near.same_name_elsewhere(name)
            for offer in self._by_name[elsewhere]
            if offer.right.right == other
        ]
        # The same node may use one name for a topic and a service, so its own names are no
        # suggestions.
        return [offer for offer in offers if offer.profile is not statement.profile]

    def _with_same_end(self, statement: PolicyStatement, other: str) -> list[PolicyStatement]:
        """Return the offers of other nodes whose names have the same last part."""
        return [
            offer
            for name in self._near.names_with_same_end(statement.name)
            for offer in self._by_name[name][:1]
            if offer.right.right == other and offer.profile is not statement.profile
        ]

    def _is_of_node(self, statement: PolicyStatement, same_end: Iterable[PolicyStatement]) -> bool:
        """Return whether a service or action is under the name of a node, or of its sibling."""
        name = statement.name
        if statement.right.kind == "topics" or _is_service_of_every_node(name):
            return False
        node = name.rpartition("/")[0]
        return node in self._nodes or any(_is_of_sibling(offer, node) for offer in same_end)


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
