"""The DDS topics that an enclave may write and read: by the rules of a vendor, or of Zenoh.

Zenoh has keys in place of topics.  A key stands for the topic that the same name has on DDS, so
that all worlds speak of the same names.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable
from functools import lru_cache
from itertools import count

from sros_tool.automata import NameSet
from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.names import SERVICE_ENDS
from sros_tool.policy.model import ALLOW
from sros_tool.proof.places import topics_of
from sros_tool.proof.worlds import TopicAccess, named, valid_topics
from sros_tool.translate_zenoh import StatedRight
from sros_tool.zenoh.access import Enforcement, Flow, Message, Remote
from sros_tool.zenoh.key_expressions import names_of

_IN, _OUT = Flow.INGRESS, Flow.EGRESS
_ENDS = {"rt": "", **SERVICE_ENDS}
_USES: dict[tuple[bool, str], tuple[tuple[Flow, Message], ...]] = {
    (True, "rt"): ((_IN, Message.PUT),),
    (False, "rt"): ((_OUT, Message.PUT),),
    (True, "rq"): ((_IN, Message.QUERY),),
    (False, "rq"): ((_OUT, Message.QUERY),),
    (True, "rr"): ((_IN, Message.REPLY), (_IN, Message.DECLARE_QUERYABLE)),
    (False, "rr"): ((_OUT, Message.REPLY), (_OUT, Message.DECLARE_QUERYABLE)),
}
"""The messages by which a process of an enclave writes, or reads, what a prefix stands for.

Each has to pass: replies without the offer to reply belong to the history of topics.
"""
_TYPE = ("/type", "/hash")
"""Type and hash at the end of a key: rules that sros writes hold for all of them."""
_ANY_TYPE = "/*/*"


def dds_access(access: Access) -> TopicAccess:
    """Return the topics that a vendor lets an enclave write and read."""
    return TopicAccess(access.topics(AccessVerb.PUBLISH), access.topics(AccessVerb.SUBSCRIBE))


def ros_access(stated: Iterable[StatedRight]) -> TopicAccess:
    """Return the topics of the ROS names that rights allow, and denials do not take away."""
    names: dict[tuple[bool, str, bool], list[NameSet]] = defaultdict(list)
    for right in (each.right for each in stated):
        for writes, topic in topics_of(right):
            names[writes, topic[:2], right.qualifier is ALLOW].append(named(topic))

    def side(writes: bool) -> NameSet:
        return NameSet.union(
            (NameSet.union(names[writes, begin, True]) & valid_topics(begin, end))
            - NameSet.union(names[writes, begin, False])
            for begin, end in _ENDS.items()
        )

    return TopicAccess(side(True), side(False))


def enforced_access(enforcers: Iterable[Enforcement], enclave: str, domain: int) -> TopicAccess:
    """Return the topics that stand for the keys that an enclave may write and read on Zenoh.

    ``enforcers`` are the access control of the processes it has links to: each one passes on alone.
    """
    remote = Remote(enclave)

    def topics(enforcer: Enforcement, writes: bool, begin: str) -> NameSet:
        def of(keys: Iterable[str]) -> NameSet:
            return NameSet.union(_topics(each, domain, begin) for each in keys)

        first, *others = (enforcer.passing(remote, *each, of) for each in _USES[writes, begin])
        for other in others:
            first &= other
        return first & named(f"{begin}/*{_ENDS[begin]}")

    every = tuple(enforcers)
    return TopicAccess(
        *(
            NameSet.union(topics(each, writes, begin) for each in every for begin in _ENDS)
            for writes in (True, False)
        )
    )


def is_enforced(
    enforcers: Iterable[Enforcement], enclave: str, domain: int, topic: str, *, writes: bool
) -> bool:
    """Return whether an enforcer lets an enclave write or read a topic, as `decide` of it says."""
    messages = zenoh_message(topic, domain, writes=writes)
    remote = Remote(enclave)
    return bool(messages) and any(
        all(enforcer.decide(remote, *each).allowed for each in messages) for enforcer in enforcers
    )


def domains_of(
    enforcers: Iterable[Enforcement], others: Collection[DomainSet] = ()
) -> tuple[int, ...]:
    """Return the ROS domains of the keys in rules: of those with the same rules the first one.

    Where keys have a wildcard in place of the domain, one is added that no key names.  Domains in
    ``others`` are added, too; which of these sets they are in tells domains apart as rules do.
    """
    rules: dict[int, set[object]] = {}
    wild = False
    for number, enforcer in enumerate(enforcers):
        subjects: dict[str, list[str]] = defaultdict(list)
        for policy in enforcer.policies:
            for each in policy.rules:
                subjects[each] += policy.subjects
        for rule in enforcer.rules:
            what = number, frozenset(subjects[rule.id]), rule.allows, rule.flows, rule.messages
            for key in rule.key_expressions:
                begin, _, rest = key.partition("/")
                wild |= "*" in begin
                if _DOMAIN.match(begin):
                    rules.setdefault(int(begin), set()).add((*what, rest))
    unnamed = next(each for each in count() if each not in rules)
    known = {*rules, *(range(MAX_DOMAIN + 1) if others else ()), *([unnamed] if wild else ())}
    kinds: dict[object, int] = {}
    for each in sorted(known, reverse=True):
        inside = tuple(each in one for one in others)
        if each in rules or any(inside) or wild:
            kinds[frozenset(rules.get(each, ())), inside] = each
    return tuple(sorted(kinds.values()))


_DOMAIN = re.compile(r"(?:0|[1-9][0-9]{0,8})\Z", re.ASCII)


@lru_cache(maxsize=65536)
def _topics(key: str, domain: int, begin: str) -> NameSet:
    """Return the topics with a prefix that stand for what a key expression includes."""
    end, space = _ENDS[begin], str(domain)
    name = key.removesuffix(_ANY_TYPE).removeprefix(space)
    if len(name) == len(key) - len(space) - len(_ANY_TYPE) and "*" not in name:
        return NameSet((f"{begin}{name}{end}",)) if name.startswith("/") else NameSet()
    around = names_of((key,)).around()
    assert around
    inner = (each.between(space, "".join(_TYPE)) for each in around.automata)
    exact = (
        f"{begin}{each[len(space) : -len(''.join(_TYPE))]}{end}"
        for each in around.exact
        if each.startswith(f"{space}/") and each.endswith("".join(_TYPE))
    )
    return NameSet(exact, (each.surrounded(begin, end) for each in inner))


def zenoh_message(topic: str, domain: int, *, writes: bool) -> list[tuple[Flow, Message, str]]:
    """Return flow, message and key of the messages by which a process writes or reads a topic.

    A topic without a ROS name has none.
    """
    begin = topic[:2]
    end = _ENDS.get(begin)
    if end is None or not topic[2:].startswith("/") or not topic.endswith(end):
        return []
    key = f"{domain}{topic[2 : len(topic) - len(end)]}{''.join(_TYPE)}"
    return [(flow, message, key) for flow, message in _USES[writes, begin]]
