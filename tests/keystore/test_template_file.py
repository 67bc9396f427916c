"""Templates as TOML: what a keystore keeps of its choices reads back."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.errors import DocumentError
from sros_tool.keystore.template import (
    EVERYTHING,
    NODE_BASICS,
    ShortLivedEnclaves,
    Template,
    load_template,
    parse_template,
    render_template,
    template_names,
)
from sros_tool.policy.model import DomainProtection, Level, NamedProtection, TopicProtection

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
    short_lived=st.lists(
        st.builds(ShortLivedEnclaves, st.sampled_from(("/operator/*", "/a", "/b?")), durations),
        max_size=3,
    ).map(tuple),
)


@given(templates)
def test_a_template_reads_back(template: Template) -> None:
    assert parse_template(render_template(template), "other") == template


@pytest.mark.parametrize("name", template_names())
def test_the_shipped_ones_read_back(name: str) -> None:
    template = load_template(name)
    assert parse_template(render_template(template), name) == template
    assert template.separate_authorities or name == "sros2"


@pytest.mark.parametrize("name", template_names())
def test_what_the_shipped_ones_protect(name: str) -> None:
    template = load_template(name)
    everything = TopicProtection(Level.ENCRYPT, Level.ENCRYPT, True, True, True, True)
    rtps = Level.ENCRYPT if name == "production" else Level.SIGN
    whole = DomainProtection(rtps, Level.ENCRYPT, Level.ENCRYPT, False, True, everything)
    assert template.protection == whole
    denies = name == "production"
    assert template.default_permissions == (NODE_BASICS if denies else EVERYTHING)
    assert template.unique_subject is denies


@pytest.mark.parametrize(
    ("enclave", "longest"),
    [("/operator/look", 1), ("/operator/a/b", 1), ("/operator", None), ("/robot", None)],
)
def test_the_enclaves_of_people_live_for_a_day(enclave: str, longest: int | None) -> None:
    for name in ("development", "production"):
        found = load_template(name).longest_validity(enclave)
        assert found == (None if longest is None else timedelta(days=longest))
    assert load_template("sros2").longest_validity(enclave) is None


def test_the_shortest_of_several_validities_counts() -> None:
    both = tuple(
        ShortLivedEnclaves(name, timedelta(hours=h)) for name, h in (("/a/*", 9), ("/a/b*", 3))
    )
    template = replace(load_template("production"), short_lived=both)
    assert template.longest_validity("/a/c") == timedelta(hours=9)
    assert template.longest_validity("/a/b") == timedelta(hours=3)


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        ('names = ["operator"]\nvalidity = "1d"', "enclaves.names has 'operator', which is not"),
        ('names = ["/a b"]\nvalidity = "1d"', "white space"),
        ('names = ["/a"]\nvalidity = "soon"', "enclaves.validity: 'soon' is not a duration"),
        ('names = ["/a"]', "enclaves.validity is missing"),
        ('validity = "1d"', "enclaves.names is missing"),
        ('names = ["/a"]\nvalidity = "1d"\nvalid = 1', "enclaves.valid is not a known key"),
    ],
)
def test_a_short_life_that_is_not_understood_is_refused(
    entry: str, why: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.toml"
    text = render_template(replace(load_template("production"), short_lived=()))
    path.write_text(f"{text}\n[[enclaves]]\n{entry}\n")
    with pytest.raises(DocumentError, match=re.escape(why)):
        load_template(str(path))
