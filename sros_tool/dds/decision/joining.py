"""Whether a participant starts on a domain, and whether its peers accept it."""

from __future__ import annotations

from dataclasses import dataclass

from sros_tool.dds.decision.answers import Outcome
from sros_tool.dds.decision.governed import Governed
from sros_tool.dds.decision.rights import Numbered, Verdict
from sros_tool.dds.decision.vendors import Traits
from sros_tool.dds.decision.wording import verdict_text
from sros_tool.dds.governance import Protection
from sros_tool.dds.permissions import Grant


@dataclass(frozen=True, slots=True)
class Joining:
    """The outcome, why, and a clause that says so."""

    outcome: Outcome
    reason: str
    text: str


def decide_join(
    traits: Traits,
    governed: Governed,
    grant: Grant,
    rules: list[Numbered],
    otherwise: Verdict,
    domain: int,
) -> Joining:
    """``rules`` are those of the grant for ``domain``, ``otherwise`` the verdict behind them."""
    where = f"domain {domain}"
    if traits.always_needs_allow_rule and not any(rule.allow for rule in grant.rules):
        text = "the grant has no allow rule, so nothing starts"
        return Joining(Outcome.REFUSED, "no-rule", text)
    rule = governed.rule
    if rule is None:
        text = f"the governance does not list {where}"
        if traits.needs_domain_rule:
            return Joining(Outcome.REFUSED, "domain-not-in-governance", text)
        text += "; the participant starts, but no endpoint can be created"
        return Joining(Outcome.ALLOWED, "domain-not-in-governance", text)
    open_door = rule.allow_unauthenticated_participants
    if traits.refuses_open_rtps and open_door and rule.rtps_protection_kind != Protection.NONE:
        text = "the governance lets unauthenticated participants in and protects RTPS"
        return Joining(Outcome.REFUSED, "unauthenticated-with-rtps-protection", text)
    if not rule.enable_join_access_control:
        text = f"joining {where} is not access controlled"
        return Joining(Outcome.ALLOWED, "unrestricted", text)
    if any(each.allow for _, each in rules):
        return Joining(Outcome.ALLOWED, "allow-rule", f"an allow rule holds on {where}")
    missing = f"no allow rule of the grant holds on {where}"
    opened = not governed.all_controlled() and otherwise.outcome is not Outcome.ALLOWED
    if traits.always_needs_allow_rule or opened:
        return Joining(Outcome.PEER_DENIES, "no-rule", f"{missing}, so peers refuse it")
    if otherwise.outcome is Outcome.DENIED:
        return Joining(Outcome.REFUSED, "no-rule", missing)
    return Joining(
        otherwise.outcome, otherwise.reason, verdict_text(otherwise, f"joining {where}", domain)
    )
