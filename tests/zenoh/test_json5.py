"""JSON5 is read as Zenoh itself reads it, and hostile texts are refused at once."""

from __future__ import annotations

import json
import random
from typing import Any

import pytest

from sros_tool.zenoh.json5 import Json5Error, parse_json5
from tests.support.children import LONG

ACCEPTED = {
    "{a:1,}": {"a": 1},
    "[1,'x',\"y\",]": [1, "x", "y"],
    "/*c*/{// d\n a /*e*/ : .5, 'b': 5., c: +1, $d_: -0x1F}": {
        "a": 0.5, "b": 5.0, "c": 1, "$d_": -31,
    },
    '"\\x41\\u0042\\\n\\q\\0\\v"': "ABq\0\v",
    '"\\ud83d\\ude00"': "\U0001f600",
    "\ufeff\u2028 null": None,
    "[true,false,-Infinity]": [True, False, float("-inf")],
    "{\\u0061b: 1}": {"ab": 1},
}  # fmt: skip
REFUSED = {
    "": "it ends too early",
    "{a:1": "it ends too early",
    "{a:1} 2": "unexpected '2'",
    "[1,,2]": "unexpected ','",
    "{a 1}": "unexpected '1'",
    "{1:1}": "unexpected '1'",
    "01": "unexpected '01'",
    "nul": "unexpected 'nul'",
    "'a\nb'": "unexpected",
    "/* open": "unexpected",
    "{a:1,'a':2}": "'a' is named twice",
    '"\\ud800"': "half a character",
    "[" * 101 + "]" * 101: "nested more than 100 levels deep",
}


@pytest.mark.parametrize(("text", "value"), ACCEPTED.items())
@pytest.mark.parametrize("lines", [True, False])
def test_accepted(text: str, value: object, lines: bool) -> None:
    assert parse_json5(text, lines=lines) == value


@pytest.mark.parametrize(("text", "problem"), REFUSED.items())
@pytest.mark.parametrize("lines", [True, False])
def test_refused(text: str, problem: str, lines: bool) -> None:
    with pytest.raises(Json5Error, match=problem.replace("[", r"\[")):
        parse_json5(text, lines=lines)


@pytest.mark.parametrize(
    "text", ['{"a":1,"a":2}', '{"a":"\\ud800"}', "[" * 101 + "]" * 101, "[" * 5000]
)
def test_json_is_refused_alike_without_its_lines(text: str) -> None:
    for lines in (True, False):
        with pytest.raises(Json5Error):
            parse_json5(text, lines=lines)
    assert parse_json5("[" * 100 + "]" * 100, lines=False) == parse_json5("[" * 100 + "]" * 100)
    assert parse_json5('{"a":[1,{}]}', lines=False)["a"][1].line == 1


def test_lines() -> None:
    value = parse_json5('{ // one\n/* two\nthree */ a: 1,\r\n b: {\n c: "x\\\ny", d: 2}}')
    assert value.lines == {"a": 3, "b": 4}
    assert value["b"].lines == {"c": 5, "d": 6}
    with pytest.raises(Json5Error) as caught:
        parse_json5("{\n\n!}")
    assert caught.value.line == 3


@pytest.mark.parametrize(
    ("before", "repeated", "after"),
    [
        ("", "[", ""),
        ("", "{a:", ""),
        ("", "/*", ""),
        ("", " ", "!"),
        ("'", "\\", ""),
        ('"', "a", ""),
        ("", "9", "x"),
        ("", "a", ""),
    ],
)
def test_hostile_texts_are_refused_in_linear_time(before: str, repeated: str, after: str) -> None:
    with pytest.raises(Json5Error) as caught:
        parse_json5(before + repeated * 10**6 + after)
    assert len(caught.value.problem) < 200


def drawn_text(draw: random.Random, depth: int = 3) -> str:
    """A random text that often is JSON5."""
    space = draw.choice(["", "", " ", "\n", "/* x */", "// y\n", "\u00a0"])
    kind = draw.random()
    if depth and kind < 0.25:
        inner = ",".join(drawn_text(draw, depth - 1) for _ in range(draw.randint(0, 3)))
        return f"{space}[{inner}{draw.choice(['', '', ','])}]"
    if depth and kind < 0.5:
        names = draw.sample(["a", "'b c'", '"d"', "$e", "_f1", "\\u0067"], draw.randint(0, 3))
        inner = ",".join(f"{each}{space}:{drawn_text(draw, depth - 1)}" for each in names)
        return f"{{{inner}{draw.choice(['', '', ','])}}}{space}"
    scalars = ["1", "-2", "+3", "0x1f", ".5", "5.", "1e3", "1.5E-1", "true", "false", "null"]
    scalars += ["'x'", '"y\\n"', "'\\x41'", '"\\u00e9"', "'a\\\nb'", "'it\\'s'", '"\\q"', "''"]
    broken = ["01", "1a", "tru", "'", '"', "\\", "-", "--1", "0x", "1e", "1.e", "@", "'\n'"]
    return space + draw.choice(scalars * 4 + broken)


def test_texts_are_read_as_zenoh_reads_them() -> None:
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

    def theirs(text: str) -> Any:
        try:
            config = zenoh.Config.from_json5(f"{{metadata:{text}}}")
            return json.loads(config.get_json("metadata"))
        except zenoh.ZError:
            return "refused"

    def ours(text: str) -> Any:
        try:
            return parse_json5(f"{{metadata:{text}}}")["metadata"]
        except Json5Error:
            return "refused"

    draw = random.Random(15)
    texts = [drawn_text(draw) for _ in range(100_000 if LONG else 1500)]
    different = [text for text in texts if theirs(text) != ours(text)]
    assert different == []
    assert 0.3 < sum(ours(each) != "refused" for each in texts) / len(texts) < 0.95


def test_a_large_text_that_is_no_json_is_read_only_where_it_was_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whoever runs a process chooses its file, and JSON5 takes seconds for a megabyte."""
    monkeypatch.setattr("sros_tool.zenoh.json5._MOST_WITHOUT_LINES", 100)
    large = "[" + "1," * 100 + "]"
    assert len(parse_json5(large)) == 100
    with pytest.raises(Json5Error, match="more than 100 tokens"):
        parse_json5(large, lines=False)
    assert len(parse_json5(large.replace(",]", "]"), lines=False)) == 100
