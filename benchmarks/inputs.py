"""Policies of any size for the benchmarks."""

from __future__ import annotations

from collections.abc import Iterable

_GROUPS = (
    ('topics publish="ALLOW"', "topic"),
    ('topics subscribe="ALLOW"', "topic"),
    ('services reply="ALLOW"', "service"),
    ('services request="ALLOW"', "service"),
    ('actions call="ALLOW"', "action"),
)


def enclaves_policy(enclaves: int, rules: int) -> str:
    """Return a policy with this number of enclaves, and of names in five groups of each."""
    return _enclaves(
        ((f"/robot{index}/part", f"/robot{index}", "part") for index in range(enclaves)), rules
    )


def _groups(rules: int) -> str:
    """Return this number of names in five groups."""
    groups = []
    for number, (opening, item) in enumerate(_GROUPS):
        names = "".join(
            f"<{item}>{item}_{rule}</{item}>"
            for rule in range(rules)
            if rule % len(_GROUPS) == number
        )
        groups.append(f"<{opening}>{names}</{opening.split()[0]}>")
    return "".join(groups)


def topics_policy(topics: int) -> str:
    """Return a policy of one enclave that publishes this number of topics."""
    names = "".join(f"<topic>/fleet/topic_{index}</topic>" for index in range(topics))
    return _policy(
        '<enclave path="/big"><profiles><profile ns="/" node="big">'
        f'<topics publish="ALLOW">{names}</topics></profile></profiles></enclave>'
    )


def _policy(enclaves: str) -> str:
    return f'<policy version="0.2.0"><enclaves>{enclaves}</enclaves></policy>'


def fleet_policy(enclaves: int, rules: int) -> str:
    """Return a policy with this number of enclaves, and of names in each, for every robot."""
    return _enclaves(
        ((f"/{{robot}}/part_{i}", "{namespace}", f"part_{i}") for i in range(enclaves)), rules
    )


def _enclaves(named: Iterable[tuple[str, str, str]], rules: int) -> str:
    """Return a policy of enclaves, each with its path, namespace and node."""
    return _policy(
        "".join(
            f'<enclave path="{path}"><profiles><profile ns="{ns}" node="{node}">{_groups(rules)}'
            "</profile></profiles></enclave>"
            for path, ns, node in named
        )
    )


def fleet_file(robots: int) -> str:
    """Return a fleet file with this number of robots, named r1 and so on."""
    return "".join(f"[robots.r{number}]\n" for number in range(1, robots + 1))
