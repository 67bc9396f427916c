"""What is signed within the portable profile, both vendors decide alike: asked of the engine.

On this rests that `sros check` asks the engine only about what lies outside of the profile.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta, timezone

from hypothesis import given
from hypothesis import strategies as st

from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import render_governance
from sros_tool.dds.permissions import Meets, outside, render_permissions
from sros_tool.keystore.template import load_template, template_names
from sros_tool.policy.model import Enclave, Policy
from sros_tool.policy.patterns import Names
from sros_tool.translate import governance_for, permissions_for
from sros_tool.validity import window
from tests.dds.decision_documents import access_of
from tests.policy.drawn_policies import EVERYTHING, PATHS, policies

NOW = datetime(2026, 7, 1, tzinfo=UTC)
DOMAINS = DomainSet.of((0, 0))


def _meets(names: Sequence[str]) -> Meets:
    return Names(names).meets


@given(policies(), st.sampled_from(template_names()), st.sampled_from([-12, -8, 0, 9, 14]))
def test_vendors_agree(policy: Policy, template: str, zone: int) -> None:
    governance = render_governance(governance_for(load_template(template).protection, DOMAINS))
    for path in PATHS:
        permissions = permissions_for(
            policy.enclave(path) or Enclave(path, ()),
            subject=f"CN={path}",
            validity=window(NOW, timedelta(days=90)),
            domains=DOMAINS,
        )
        if any(found != "portable.character-set" for found, _ in outside(permissions, 0, _meets)):
            continue
        answers = [
            access_of(
                vendor,
                governance,
                render_permissions(permissions),
                f"CN={path}",
                domain=0,
                at=NOW,
                zone=timezone(timedelta(hours=zone)),
            )
            for vendor in (Vendor.FAST, Vendor.FAST_2_9, Vendor.CYCLONE)
        ]
        for direction, topic in sorted(EVERYTHING):
            said = {
                answer.decide(AccessVerb(direction), topic).outcome.ok
                for answer in answers
                if isinstance(answer, Access)
            }
            assert len(answers) == 3
            assert len(said) == 1, (direction, topic)
