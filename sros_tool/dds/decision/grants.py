"""Which grant of a permissions document holds for an identity at a moment."""

from __future__ import annotations

from datetime import datetime, tzinfo

from sros_tool.dds.decision.answers import Refusal
from sros_tool.dds.decision.moments import read_moment
from sros_tool.dds.decision.subjects import escaped, same_subject
from sros_tool.dds.decision.vendors import Moments, Traits
from sros_tool.dds.permissions import Grant, Permissions


def choose_grant(
    traits: Traits, permissions: Permissions, subject: str, *, at: datetime, zone: tzinfo
) -> int | Refusal:
    """The index of the grant, or why there is none."""
    now = at.timestamp()
    outdated: Refusal | None = None
    certified = escaped(subject) if traits.escapes_subjects else subject
    states = [
        _state(traits, index, grant, now, zone) for index, grant in enumerate(permissions.grants)
    ]
    for state in states:
        if state and state.reason == "malformed":  # of whomever it is
            return state
    for index, (grant, state) in enumerate(zip(permissions.grants, states, strict=True)):
        granted = grant.subject.strip() if traits.trims_texts else grant.subject
        if not same_subject(traits.subjects, granted, certified):
            continue
        if state is None:
            return index
        if not traits.passes_over_outdated_grants:
            return state
        outdated = outdated or state
    return outdated or Refusal(
        "no-grant", f"{traits.title}: no grant of the permissions names the subject {subject!r}."
    )


def _state(traits: Traits, index: int, grant: Grant, now: float, zone: tzinfo) -> Refusal | None:
    """Why the grant does not hold now, if so."""
    begin = read_moment(traits.moments, grant.not_before, zone)
    end = read_moment(traits.moments, grant.not_after, zone)
    name = f"grant {grant.name!r}" if grant.name else f"grant {index + 1}"
    if begin is None or end is None:
        wrong = grant.not_before if begin is None else grant.not_after
        return Refusal("malformed", f"{traits.title} cannot read the date {wrong!r} of {name}.")
    how = ", which it reads in the host's local time" if traits.moments is Moments.LOCAL else ""
    # Fast DDS counts whole seconds and includes both ends; Cyclone DDS excludes them.
    strict = traits.moments is Moments.CYCLONE
    if now < begin or (strict and now == begin):
        return Refusal(
            "not-yet-valid", f"{traits.title}: {name} begins at {grant.not_before}{how}."
        )
    seconds = int(now) if traits.moments is Moments.LOCAL else now
    if seconds > end or (strict and now == end):
        return Refusal("expired", f"{traits.title}: {name} ended at {grant.not_after}{how}.")
    return None
