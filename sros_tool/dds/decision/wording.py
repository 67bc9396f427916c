"""The sentences in which decisions are explained, in the terms of DDS."""

from __future__ import annotations

from sros_tool.dds.decision.rights import Verdict


def verdict_text(verdict: Verdict, asked: str, domain: int, *, by_peers: bool = False) -> str:
    """What ``verdict`` says about ``asked`` (``publish rt/a``), as a clause.

    ``by_peers`` says that the own participant lets it pass and its peers do not.
    """
    rule = "" if verdict.rule is None else f"rule {verdict.rule + 1}"
    peers = f" for domain {domain}, and peers keep to that" if by_peers else ""
    match verdict.reason:
        case "allow-rule":
            return f"{rule} allows {asked} by {verdict.expression}"
        case "deny-rule":
            return f"{rule} denies {asked} by {verdict.expression}{peers}"
        case "partition":
            return f"{rule} has {verdict.expression}, but not the partitions of {asked}{peers}"
        case "default":
            word = "ALLOW" if verdict.allowed else "DENY"
            return f"no rule names {asked}, and the grant's default is {word}"
        case "open-range":
            return f"{rule} has domains without <min>, over which the process crashes"
        case "empty-topic":
            return f"{rule} has a <topic> without text, over which the process crashes"
        case "empty-default":
            return "the grant's <default> is empty, over which the process crashes"
        case _:
            return f"no rule allows {asked}{peers}"
