"""Checks of the rules of an enclave: contradicting, unused and repeated statements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import islice

from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.policies.statements import CheckedPolicy, PolicyStatement
from sros_tool.names import ACTION_PARTS, ACTION_SEPARATOR, is_expression
from sros_tool.policy.model import ALLOW, DENY, stated_protections
from sros_tool.policy.patterns import ComparisonLimit, Names, matches
from sros_tool.policy.rights import Rules, parts
from sros_tool.translate import contradictions
from sros_tool.wording import first_few

_MOST_CONTRADICTIONS = 1000

CONTRADICTING_PROTECTION = FindingKind(
    "policy.protection-contradicts",
    ERROR,
    "a name with contradicting protect= values",
    "A keystore has one governance for all enclaves, so a name has one protection; a wildcard "
    "sets it for all names that it matches. No keystore can follow this policy.",
    "DDS-Security 1.1, 9.4.1.2 (topic rules); sros: protect= in a policy.",
    "State the same protection in both places, or only in one of them.",
)
_RULE_ORDER_SOURCE = (
    "sros signs the deny rules of an enclave before its allow rules, as ros2/sros2 does, and the "
    "first rule that matches decides (DDS-Security 1.1, 9.4.1.3)."
)
CONTRADICTION = FindingKind(
    "policy.contradiction",
    WARNING,
    "the same name is allowed and denied",
    "The DENY wins, so the ALLOW has no effect; one of the two is a mistake.",
    _RULE_ORDER_SOURCE,
    "Remove the ALLOW or the DENY.",
)
UNREACHABLE = FindingKind(
    "policy.unreachable-rule",
    WARNING,
    "an ALLOW that a DENY covers completely",
    "A DENY of the same enclave, perhaps of another node in it, covers every name of the ALLOW, "
    "so the ALLOW has no effect.",
    _RULE_ORDER_SOURCE,
    "Remove the ALLOW, or narrow the DENY.",
)
NO_EFFECT = FindingKind(
    "policy.deny-without-effect",
    NOTE,
    "a DENY of something that no rule allows",
    "Everything that no rule allows is denied anyway. The DENY has an effect only in a policy that "
    "users merge into their own, such as the policy of a package: in the merged policy, it wins "
    "over every ALLOW for the enclave.",
    "DDS-Security 1.1, 9.4.1.3 (the default is DENY); sros: merge_policy never weakens a DENY.",
    "Keep the DENY if this right must never be added to the enclave.",
)
REDUNDANT_RULE = FindingKind(
    "policy.redundant-rule",
    NOTE,
    "a name that a wildcard in the same profile already covers",
    "The rights of a profile add up, so the name only makes the document longer.",
    "sros: the rights of a profile are joined.",
    "Remove the name, or better the wildcard.",
)
HALF_ACTION = FindingKind(
    "policy.action-in-part",
    ERROR,
    "an action that is allowed only in part",
    "An action consists of three services and two topics. The client or server of an action "
    "creates all five when it starts, and fails if one of them is denied. An enclave that has only "
    "a part of the right to execute the action can still send false feedback or results. (Not "
    "reported are rights to subscribe to feedback and status, which a node needs to observe an "
    "action, and to request cancel_goal or get_result.)",
    "ROS 2 design, Actions; rcl_action 9 (rcl_action_client_init, rcl_action_server_init).",
    'Write <actions call="ALLOW"> or <actions execute="ALLOW"> with the name of the action, or '
    "remove the part.",
)


def check_protection(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about names with contradicting protect= values."""
    for protection, other in islice(
        contradictions(stated_protections(checked_policy.policy.enclaves)), _MOST_CONTRADICTIONS
    ):
        text = (
            f"{other} has protect={other.word}, "
            f"and {protection} has protect={protection.word} at {protection.source}"
        )
        place = other.source
        yield CONTRADICTING_PROTECTION.found(other.enclave, text, place.file, place.line)


def check_rules(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about contradicting, unused and repeated statements of an enclave."""
    for statement in checked_policy.statements:
        if statement.allows:
            yield from _statement_findings(statement, checked_policy.rules)
        elif not checked_policy.rules.overlaps(statement.right._replace(qualifier=ALLOW)):
            text = f"no rule gives the right to {statement.right.describe()}"
            yield statement.found(NO_EFFECT, text, _remedy_of_denial(statement.written))
    yield from _actions_in_part(checked_policy)
    yield from _redundancy_findings(checked_policy)


def _remedy_of_denial(written: str) -> str:
    """Return the remedy for a DENY without effect; ``written`` is its name in the policy file."""
    if written.startswith(("/", "~")):
        return NO_EFFECT.remedy
    return (
        f"{NO_EFFECT.remedy} Write /*{written.lstrip('*')} to deny the name in every namespace: "
        f"after a merge with `--namespace /left`, {written} denies only /left/{written}."
    )


def _statement_findings(statement: PolicyStatement, rules: Rules) -> Iterator[Finding]:
    denial = statement.right._replace(qualifier=DENY)
    if denials := rules.covering_rights(denial):
        is_same_right = set(parts(denial)) == set(denials)
        shown = ", ".join(sorted({f"{by.right} {by.name}" for by in denials}))
        if is_same_right:
            text = f"{statement.right.describe()} is allowed here and denied in the same enclave"
            yield statement.found(CONTRADICTION, text)
        else:
            yield statement.found(UNREACHABLE, f"{statement.right.describe()} is denied by {shown}")
        return
    right, name = statement.right.right, statement.right.name
    if right in ACTION_PARTS and not is_expression(name) and rules.overlaps(denial):
        shown = ", ".join(f"{by.right} {by.name}" for by in rules.overlapping(denial))
        text = f"{right} {name} is allowed, but a part of the action is denied by {shown}"
        yield statement.found(HALF_ACTION, text, "Remove the DENY of the part, or the ALLOW.")


def _actions_in_part(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield a finding for each action of an enclave of which only parts are allowed."""
    rules = checked_policy.rules
    parts_of_actions: dict[tuple[str, str, str], list[PolicyStatement]] = defaultdict(list)
    for statement in checked_policy.statements:
        enclave, _, right, name = statement.right
        action, separator, ending = name.rpartition(ACTION_SEPARATOR)
        if not (statement.allows and separator) or rules.cover(
            statement.right._replace(qualifier=DENY)
        ):
            continue
        if whole := _action_right(right, ending):
            parts_of_actions[enclave, whole, action].append(statement)
    for (enclave, whole, action), statements in parts_of_actions.items():
        if not rules.allow(enclave, whole, action):
            shown = first_few([f"{s.right.right} {s.name}" for s in statements], 2)
            is_are = "is" if len(statements) == 1 else "are"
            text = f"{shown} {is_are} allowed, but not everything needed to {whole} {action}"
            remedy = f'Write <actions {whole}="ALLOW"> with the name of the action, or remove '
            remedy += "the part." if len(statements) == 1 else "the parts."
            yield statements[0].found(HALF_ACTION, text, remedy)


def _action_right(right: str, ending: str) -> str:
    """Return the right to an action of which a part may be a mistake, or ""."""
    if right == "request":
        return "call" if matches(ending, "send_goal") else ""
    executes = any(
        right == of_part and matches(ending, part.removeprefix(ACTION_SEPARATOR))
        for of_part, part in ACTION_PARTS["execute"]
    )
    return "execute" if executes else ""


def _redundancy_findings(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    wild: dict[tuple[int, str], list[str]] = defaultdict(list)
    for statement in checked_policy.statements:
        if statement.allows and is_expression(statement.name):
            wild[id(statement.profile), statement.right.right].append(statement.name)
    limit = ComparisonLimit()
    names = {place: Names(expressions, limit) for place, expressions in wild.items()}
    for statement in checked_policy.statements:
        # Included rights are the same for all nodes, so a redundant one is not a mistake.
        if not statement.allows or statement.source.file != statement.profile.source.file:
            continue
        place_names = names.get((id(statement.profile), statement.right.right))
        if place_names and (wide := next(place_names.covering(statement.name), "")):
            yield statement.found(
                REDUNDANT_RULE, f"{statement.right.describe()} is covered by {wide}"
            )
