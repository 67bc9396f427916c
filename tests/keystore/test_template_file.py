"""Templates as TOML: what a keystore keeps of its choices reads back."""

from __future__ import annotations

from datetime import timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.keystore.template import (
    EVERYTHING,
    NODE_BASICS,
    Template,
    load_template,
    parse_template,
    render_template,
    template_names,
)
from sros_tool.policy.protection import (
    DomainProtection,
    Level,
    NamedProtection,
    TopicProtection,
)

texts = st.text(st.characters(codec="utf-8"), max_size=20)
printable = st.text(st.characters(codec="utf-8"), min_size=1, max_size=40).filter(str.isprintable)
durations = st.integers(1, 100 * 365 * 86400).map(lambda each: timedelta(seconds=each))
levels = st.sampled_from(Level)
topics = st.builds(
    TopicProtection,
    st.sampled_from((Level.NONE, Level.SIGN, Level.ENCRYPT)),
    levels,
    *[st.booleans()] * 4,
)
ORDER = ("topics", "services", "actions")
named = st.lists(
    st.builds(
        NamedProtection, st.sampled_from(ORDER), st.sampled_from(("/x", "*", "a/b?")), topics
    ),
    max_size=4,
).map(lambda found: tuple(sorted(found, key=lambda each: ORDER.index(each.kind))))
protections = st.builds(
    DomainProtection,
    levels,
    levels,
    levels,
    st.just(False),
    st.booleans(),
    topics,
    named,
) | st.builds(
    DomainProtection, st.just(Level.NONE), levels, levels, st.booleans(), st.booleans(), topics
)
templates = st.builds(
    Template,
    texts,
    texts,
    st.booleans(),
    printable,
    durations,
    durations,
    durations,
    st.sampled_from((EVERYTHING, NODE_BASICS)),
    protections,
)


@given(templates)
def test_a_template_reads_back(template: Template) -> None:
    assert parse_template(render_template(template), "other") == template


@pytest.mark.parametrize("name", template_names())
def test_the_shipped_ones_read_back(name: str) -> None:
    template = load_template(name)
    assert parse_template(render_template(template), name) == template
    assert template.separate_authorities or name == "sros2"
