"""The DDS topics that an enclave may write and read: by the rules of a vendor, or of Zenoh.

Zenoh has keys in place of topics.  A key stands for the topic that the same name has on DDS, so
that all worlds speak of the same names.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from functools import lru_cache

from sros_tool.automata import NameSet
from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.policy.model import ALLOW
from sros_tool.proof.places import topics_of
from sros_tool.proof.worlds import TopicAccess, named, valid_topics
from sros_tool.translate import SERVICE_ENDS
from sros_tool.translate_zenoh import StatedRight
from sros_tool.zenoh.access import Flow, Message
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


KeysAs = Callable[[Iterable[str]], NameSet]
"""Function that returns the topics for which key expressions stand."""


def zenoh_access(passing: Callable[[Flow, Message, KeysAs], NameSet], domain: int) -> TopicAccess:
    """Return the topics that stand for the keys that an enclave may write and read.

    ``passing`` returns the keys of messages that pass, with the function that it is given.
    """

    def topics(writes: bool, begin: str) -> NameSet:
        def of(keys: Iterable[str]) -> NameSet:
            return NameSet.union(_topics(each, domain, begin) for each in keys)

        first, *others = (passing(*each, of) for each in _USES[writes, begin])
        for other in others:
            first &= other
        return first & named(f"{begin}/*{_ENDS[begin]}")

    return TopicAccess(*(NameSet.union(topics(w, each) for each in _ENDS) for w in (True, False)))


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
