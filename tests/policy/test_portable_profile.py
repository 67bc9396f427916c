"""What is signed within the portable profile, both vendors decide alike: asked of the engine.

On this rests that `sros check` asks the engine only about what lies outside of the profile.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

from hypothesis import given
from hypothesis import strategies as st

from sros_tool.dds.decision.access import Access, AccessVerb
from sros_tool.dds.decision.vendors import TESTED
from sros_tool.dds.governance import render_governance
from sros_tool.dds.permissions import Permissions, render_permissions
from sros_tool.keystore.template import load_template, template_names
from sros_tool.translate import governance_for
from tests.dds.decision_documents import access_of
from tests.policy.drawn_policies import DOMAINS, EVERYTHING, portable_permissions

NOW = datetime(2026, 7, 1, tzinfo=UTC)


@given(
    portable_permissions(NOW),
    st.sampled_from(template_names()),
    st.sampled_from([-12, -8, 0, 9, 14]),
)
def test_vendors_agree(permissions: Permissions, template: str, zone: int) -> None:
    governance = render_governance(governance_for(load_template(template).protection, DOMAINS))
    answers = [
        access_of(
            vendor,
            governance,
            render_permissions(permissions),
            permissions.grants[0].subject,
            domain=next(iter(DOMAINS)),
            at=NOW,
            zone=timezone(timedelta(hours=zone)),
        )
        for vendor in TESTED
    ]
    for direction, topic in sorted(EVERYTHING):
        said = {
            answer.decide(AccessVerb(direction), topic).outcome.ok
            for answer in answers
            if isinstance(answer, Access)
        }
        assert len(said) == 1, (direction, topic)
