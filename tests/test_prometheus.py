"""The text of metrics: what the reader of Prometheus finds in it is what was given."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from sros_tool.prometheus import Metric, Sample, render_metrics


def read(text: str) -> dict[str, list[tuple[dict[str, str], float]]]:
    """Return the labels and values of every metric in a text."""
    families = list(text_string_to_metric_families(text))
    assert all(each.type == "gauge" for each in families)
    return {each.name: [(s.labels, s.value) for s in each.samples] for each in families}


@given(st.text(st.characters(codec="utf-8")), st.integers(-(2**40), 2**40))
def test_every_label_is_one_label_of_one_line(text: str, value: int) -> None:
    shown = render_metrics([Metric("a", f"help {text}", (Sample(value, {"b": text, "c": "end"}),))])
    assert [line[:1] for line in shown.split("\n")] == ["#", "#", "a", ""]
    ((labels, found),) = read(shown)["a"]
    assert found == value
    assert labels.keys() == {"b", "c"} and labels["c"] == "end"
    if text.isprintable():
        assert labels["b"] == text


def test_what_no_reader_accepts_is_made_visible() -> None:
    text = 'a"} 1\nb 2\r\x1b[2J\x85\u2028\udcff'
    shown = render_metrics([Metric("a", "h", (Sample(1, {"b": text}),))])
    assert read(shown) == {"a": [({"b": 'a"} 1\\x0ab 2\\x0d\\x1b[2J\\x85\\u2028\\xff'}, 1.0)]}


def test_a_series_is_given_once_and_an_empty_metric_not_at_all() -> None:
    same = (Sample(1, {"b": "\udcff"}), Sample(2, {"b": "x"}), Sample(3, {"b": "\\xff"}))
    shown = render_metrics([Metric("a", "h", same), Metric("c", "h", ()), Metric("d", "h", same)])
    assert shown.count("# TYPE") == 2
    assert read(shown)["a"] == [({"b": "\\xff"}, 1.0), ({"b": "x"}, 2.0)]
    assert render_metrics([Metric("n", "h", (Sample(1.5),))]).endswith("gauge\nn 1.5\n")


@pytest.mark.parametrize("name", ["", "A", "a b", "a\n", "1a", "__a", "ä", 'a{b="c"}'])
def test_other_names_are_a_defect(name: str) -> None:
    with pytest.raises(ValueError):
        Metric(name, "h", (Sample(1),))
    with pytest.raises(ValueError):
        Metric("a", "h", (Sample(1, {name: "x"}),))
