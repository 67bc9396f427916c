"""Translation of access control of Zenoh back to ROS rights: what its rules let enclaves do.

The inverse of `translate_zenoh` for what that writes.  Key expressions of others may stand for
fewer names than the result, since a ``*`` of ROS also stands for parts with slashes; never more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sros_tool.names import expression_problem
from sros_tool.policy.model import ALLOW, DENY
from sros_tool.policy.patterns import covers
from sros_tool.policy.rights import Right
from sros_tool.zenoh.access import Flow, Message
from sros_tool.zenoh.enforcement import AclRule, Enforcement
from sros_tool.zenoh.key_expressions import ANY_CHUNKS, ANY_PART

_USE = {
    (Flow.INGRESS, Message.PUT): "publish",
    (Flow.EGRESS, Message.PUT): "subscribe",
    (Flow.INGRESS, Message.QUERY): "request",
    (Flow.EGRESS, Message.QUERY): "reply",
}
"""The right that a message from or to an enclave is the use of."""
_WILD = ("*", ANY_CHUNKS)
_TYPE_AND_HASH = 2
_MOST_ANY_CHUNKS = 6
"""Each may stand for no chunk, which makes two names of one."""


@dataclass(frozen=True, slots=True)
class RightsInRules:
    """The rights that rules give to processes by the common name of their certificate.

    ``enclaves`` are the common names that rules name.  ``left_out`` are key expressions that are no
    names of ROS topics or services, sorted.
    """

    rights: frozenset[Right]
    enclaves: frozenset[str]
    left_out: tuple[str, ...]


def rights_in_rules(access: Enforcement) -> RightsInRules:
    """Return the rights that access control gives to enclaves, in all ROS domains together.

    Subjects without a common name are not enclaves, and are left out.
    """
    rights: set[Right] = set()
    left_out: set[str] = set()
    names: set[str] = set()
    for subject in access.subjects:
        for enclave in subject.cert_common_names or ():
            names.add(enclave)
            for rule in access.rules_of(subject.id):
                for right, key in _uses(rule):
                    qualifier = ALLOW if rule.allows else DENY
                    found = ros_names(key)
                    rights |= {Right(enclave, qualifier, right, name) for name in found}
                    left_out |= set() if found else {key}
    return RightsInRules(frozenset(rights), frozenset(names), tuple(sorted(left_out)))


def _uses(rule: AclRule) -> Iterator[tuple[str, str]]:
    """Yield the rights that a rule is about, each with each of its key expressions."""
    for (flow, message), right in _USE.items():
        if flow in rule.flows and message in rule.messages:
            # Below @adv is the history of a topic, which belongs to the same right.
            yield from ((right, key) for key in rule.key_expressions if "/@adv" not in key)


def ros_names(key: str) -> tuple[str, ...]:
    """Return the ROS names and expressions for which a key expression stands; none if it is none.

    The first chunk is the ROS domain, and the last two are the type and its hash.
    """
    chunks = _without_type(key.split("/")[1:])
    if chunks.count(ANY_CHUNKS) > _MOST_ANY_CHUNKS or any(each.startswith("@") for each in chunks):
        return ()
    names = [""]
    for each in chunks:
        if each == ANY_CHUNKS:
            # It may stand for no chunk; a star of ROS before it includes what it stands for.
            names += [f"{name}/*" for name in names if not name.endswith("*")]
        else:
            names = [f"{name}/{each.replace(ANY_PART, '*')}" for name in names]
    found = sorted({each for each in names if each and not expression_problem(each)})
    return tuple(
        each for each in found if not any(one != each and covers(one, each) for one in found)
    )


def _without_type(chunks: list[str]) -> list[str]:
    """Return the chunks of the name; type and hash may stand before wildcards for any chunks.

    In the canonical form, ``*`` stands before ``**``.
    """
    end = len(chunks)
    while end and chunks[end - 1] in _WILD:
        end -= 1
    wild = chunks[end:]
    if wild.count("*") >= _TYPE_AND_HASH:
        kept = wild.count("*") - _TYPE_AND_HASH
        return [*chunks[:end], *["*"] * kept, *[ANY_CHUNKS] * wild.count(ANY_CHUNKS)]
    if wild:
        return chunks[:end] + wild if ANY_CHUNKS in wild else chunks[:-_TYPE_AND_HASH]
    return chunks[:-_TYPE_AND_HASH]
