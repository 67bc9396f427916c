"""Rules of a policy that cannot do what they say: unreachable, contradicting, without effect."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, Kind, by_id
from sros_tool.checks.policies.stated import CheckedPolicy, Stated
from sros_tool.names import is_expression
from sros_tool.policy.model import ALLOW, DENY
from sros_tool.policy.patterns import covers
from sros_tool.policy.rights import Rules, parts

_ORDER = (
    "sros signs the denials of an enclave before its permissions, as ros2/sros2 does, and the "
    "first rule that matches decides (DDS-Security 1.1, 9.4.1.3)."
)

CONTRADICTION = Kind(
    "policy.contradiction",
    WARNING,
    "the same name is allowed and denied",
    "The denial counts, so the permission does nothing; one of them is not meant.",
    _ORDER,
    "Remove the one that is not meant.",
)
UNREACHABLE = Kind(
    "policy.unreachable-rule",
    WARNING,
    "a permission that a denial takes away as a whole",
    "A denial of the same enclave, perhaps of another node in it, covers every name of the rule, "
    "so it never allows anything.",
    _ORDER,
    "Remove the permission, or narrow the denial.",
)
NO_EFFECT = Kind(
    "policy.deny-without-effect",
    WARNING,
    "a denial of what nothing allows",
    "What no rule allows is denied anyway. The denial takes nothing away, and on Cyclone DDS it "
    "can close the other direction of the topic.",
    "DDS-Security 1.1, 9.4.1.3 (the default is DENY); Cyclone DDS 0.10.2 refuses a topic of "
    "which one direction is denied.",
    "Remove the denial.",
)
REDUNDANT = Kind(
    "policy.redundant-rule",
    NOTE,
    "a permission that a wildcard beside it gives already",
    "The name stands under a wildcard of the same profile, so it only makes the document longer.",
    "sros: rights of a profile are joined.",
    "Remove the name, or better the wildcard.",
)
HALF_ACTION = Kind(
    "policy.action-in-part",
    ERROR,
    "a part of an action without the others",
    "An action is three services and two topics, and its client or server makes all five when it "
    "starts: denied one of them, it fails.",
    "ROS 2 design, Actions; rcl_action 9 (rcl_action_client_init, rcl_action_server_init).",
    'Write <actions call="ALLOW"> or <actions execute="ALLOW"> with the name of the action.',
)

KINDS = by_id(CONTRADICTION, UNREACHABLE, NO_EFFECT, REDUNDANT, HALF_ACTION)

_GOAL = "/_action/send_goal"
_WHOLE = {"request": "call", "reply": "execute"}


def check_rules(checked: CheckedPolicy) -> Iterator[Finding]:
    """Every statement against the others of its enclave."""
    for each in checked.statements:
        if each.allows:
            yield from _permission(each, checked.rules)
        elif not checked.rules.meeting(each.right._replace(qualifier=ALLOW)):
            yield each.found(NO_EFFECT, f"nothing allows to {each.right.told()}")
    yield from _redundant(checked)


def _permission(each: Stated, rules: Rules) -> Iterator[Finding]:
    denial = each.right._replace(qualifier=DENY)
    if denials := rules.covering(denial):
        same = set(parts(denial)) == set(denials)
        shown = ", ".join(sorted({f"{by.right} {by.name}" for by in denials}))
        if same:
            text = f"{each.right.told()} is allowed here and denied in the same enclave"
            yield each.found(CONTRADICTION, text)
        else:
            yield each.found(UNREACHABLE, f"{each.right.told()} is denied by {shown}")
        return
    if each.name.endswith(_GOAL) and each.right.right in _WHOLE:
        action = each.name.removesuffix(_GOAL)
        whole = _WHOLE[each.right.right]
        if not rules.allow(each.right.enclave, whole, action):
            text = f"{each.name} is allowed, but not all that it takes to {whole} {action}"
            yield each.found(HALF_ACTION, text)


def _redundant(checked: CheckedPolicy) -> Iterator[Finding]:
    wild: dict[tuple[int, str], list[str]] = defaultdict(list)
    for each in checked.statements:
        if each.allows and is_expression(each.name):
            wild[id(each.profile), each.right.right].append(each.name)
    for each in checked.statements:
        # What was included is the same for all; that some node does not need it is no fault.
        if not each.allows or each.source.file != each.profile.source.file:
            continue
        for wide in wild.get((id(each.profile), each.right.right), ()):
            if wide != each.name and covers(wide, each.name):
                yield each.found(REDUNDANT, f"{each.right.told()} is part of {wide}")
                break
