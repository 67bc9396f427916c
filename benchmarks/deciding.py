"""Benchmarks of the decision engine, with names that it has not seen before.

The floor of a decision is a Python function with the same arguments that looks the name up and
returns a `Decision`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

from sros_tool.dds.decision.access import Access, Decision, GovernedDomain, Outcome
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, ProtectionKind, TopicRule
from sros_tool.dds.permissions import Criteria, Grant, Permissions, Rule

_NOW = datetime(2026, 6, 15, 12, tzinfo=UTC)
_DOMAINS = DomainSet.of((0, 0))
_MILLION = 1_000_000
_ASKED = 100_000
_LIMIT = 60.0
_PREPARED = 1000

Figure = tuple[str, float, float | None, str, bool]
"""The task, its seconds, the floor, the limit, and whether it is kept."""


def deciding() -> Iterator[Figure]:
    """Measure a million decisions of two vendors, and the preparation of many enclaves."""
    names = [_name(index) for index in range(_ASKED)]
    floor = _seconds(_nothing, names)
    for vendor in (Vendor.FAST, Vendor.CYCLONE):
        for topics, wildcards in ((100, 10), (20_000, 1000)):
            access = _access(vendor, topics, wildcards)
            taken = _seconds(access.publish, names)
            what = f"a million decisions, {topics} topics, {wildcards} *, {vendor.title}"
            yield what, taken, floor, f"{_LIMIT:.0f} s", taken < _LIMIT
    begin = time.perf_counter()
    for _ in range(_PREPARED):
        _access(Vendor.CYCLONE, 100, 10)
    taken = time.perf_counter() - begin
    yield f"... {_PREPARED} enclaves of 100 topics prepared", taken, None, "2 s", taken < 2.0


def _name(index: int) -> str:
    """Return a name: of four, two are allowed by name, one by a wildcard, and one is denied."""
    match index % 4:
        case 0 | 1:
            return f"rt/fleet/topic_{index % 100}"
        case 2:
            return f"rt/group_{index % 10}/part_{index}/state"
        case _:
            return f"rt/elsewhere/topic_{index}"


_KNOWN = {f"rt/fleet/topic_{index}": index for index in range(100)}


def _nothing(topic: str, partitions: tuple[str, ...] = ()) -> Decision:
    found = _KNOWN.get(topic)
    outcome = Outcome.DENIED if found is None else Outcome.ALLOWED
    return Decision(outcome, "allow-rule", f"rule {found} of {topic}", 0, found, topic)


def _seconds(ask: Callable[[str], Decision], names: list[str]) -> float:
    """Return the CPU seconds of a million decisions, from the best of three rounds."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        for name in names:
            ask(name)
        times.append(time.process_time() - begin)
    return min(times) * _MILLION / len(names)


def _access(vendor: Vendor, topics: int, wildcards: int) -> Access:
    plain = tuple(f"rt/fleet/topic_{index}" for index in range(topics))
    wild = tuple(f"rt/group_{index}/*/state" for index in range(wildcards))
    rules = (
        Rule(False, _DOMAINS, publish=(Criteria(("rt/secret/*",)),)),
        Rule(True, _DOMAINS, publish=(Criteria(plain), Criteria(wild))),
    )
    window = ("2026-01-01T00:00:00Z", "2027-01-01T00:00:00Z")
    permissions = Permissions((Grant("g", "CN=/robot", *window, rules),))
    kind = ProtectionKind.ENCRYPT
    topic_rule = TopicRule("*", True, True, True, True, kind, kind)
    domain_rule = DomainRule(_DOMAINS, False, True, kind, kind, kind, (topic_rule,))
    governance = Governance((domain_rule,))
    return Access(GovernedDomain(vendor, governance, 0), permissions, "CN=/robot", moment=_NOW)
