"""Which requirements of an earlier file a new one does not demand, and how that is said."""

from __future__ import annotations

import pytest

from sros_tool.files import policies_dir
from sros_tool.proof.requirements import (
    Requirement,
    dropped_requirements,
    parse_requirements,
    read_requirements,
)
from sros_tool.values import as_plain


def read(text: str, file: str = "r.toml") -> tuple[Requirement, ...]:
    return parse_requirements(text.encode(), file)


ONLY = '[[only]]\npublish = ["/a", "/b/*"]\nenclaves = ["/x", "/y"]\n'
APART = '[[apart]]\nfrom = ["/web/*"]\nto = ["/base"]\nthrough = ["/mux"]\n'
WIDEST = '[[widest]]\npublish = ["/a*"]\nsubscribe = []\nenclaves = ["/x"]\n'
AT_MOST = '[[at_most]]\ncall = ["/go"]\nenclaves = 2\n'
PROTECTED = '[[protected]]\ntopics = ["/a"]\nlevel = "encrypt"\n'
MUST = '[[must]]\nenclave = "/x"\npublish = ["/a", "/b"]\n'
NOTHING_BUT = '[[nothing_but]]\nenclaves = ["/x", "/y"]\npublish = ["/a", "/b*"]\n'
NOT_BOTH = '[[not_both]]\nfirst = { publish = ["/a"] }\nsecond = { request = ["/b"] }\n'

KEPT = {
    "the same": (ONLY + MUST + PROTECTED, ONLY + MUST + PROTECTED),
    "another order and name": (ONLY + MUST, MUST + ONLY + 'name = "n"\n'),
    "fewer enclaves": (ONLY, ONLY.replace(', "/y"', "")),
    "nobody": (ONLY + AT_MOST, '[[nobody]]\npublish = ["/*"]\ncall = ["/g*"]\n'),
    "in two tables": (
        ONLY,
        '[[only]]\npublish = ["/a"]\nenclaves = ["/y"]\n'
        '[[only]]\npublish = ["/b*"]\nenclaves = ["/x"]\n',
    ),
    "fewer ways round": (APART, APART[: APART.index("through")]),
    "wider names": (APART, APART.replace("/web/*", "*")),
    "fewer wildcards": (WIDEST, WIDEST.replace("/a*", "/ab*").replace('"/x"', '"*"')),
    "a lower number": (AT_MOST, AT_MOST.replace("2", "1")),
    "stronger": (PROTECTED.replace("encrypt", "sign"), PROTECTED.replace('"/a"', '"/*"')),
    "less rights of more enclaves": (
        NOTHING_BUT,
        NOTHING_BUT.replace('"/y"', '"*"').replace('"/a", ', ""),
    ),
    "more that nobody may both": (NOT_BOTH, NOT_BOTH.replace("/a", "/*")),
    "an exception more": (ONLY, ONLY.replace('"/y"', '"/y", "!/y/z"')),
}
WEAKENED = {
    "another enclave": (ONLY, ONLY.replace('"/y"', '"/y", "/z"')),
    "a name less": (ONLY, ONLY.replace('"/a", ', "")),
    "a narrower name": (ONLY, ONLY.replace("/b/*", "/b/c")),
    "a wildcard for enclaves": (ONLY, ONLY.replace('"/y"', '"/*"')),
    "another way round": (APART, APART.replace('"/mux"', '"/mux", "/x"')),
    "a target less": (
        APART.replace('"/base"', '"/base", "/arm"'),
        APART.replace('"/base"', '"/arm"'),
    ),
    "more wildcards": (WIDEST, WIDEST.replace("/a*", "/*")),
    "a higher number": (AT_MOST, AT_MOST.replace("2", "3")),
    "weaker": (PROTECTED, PROTECTED.replace("encrypt", "sign")),
    "less that must work": (MUST, MUST.replace(', "/b"', "")),
    "an exception less": (ONLY.replace('"/y"', '"/*", "!/z"'), ONLY.replace('"/y"', '"/*"')),
    "more rights": (NOTHING_BUT, NOTHING_BUT.replace("/b*", "/*")),
    "fewer enclaves do nothing but": (NOTHING_BUT, NOTHING_BUT.replace(', "/y"', "")),
    "less that nobody may both": (NOT_BOTH.replace("/a", "/*"), NOT_BOTH),
    "somebody is not kept apart": (APART, APART.replace('"/web/*"', '"/web/*", "!/web/x"')),
}
ELSEWHERE = {
    "a name moves": ('"/a"', '"a"'),
    "a name stays": ('"a"', '"/a"'),
    "a name stays, and some namespaces are named": ('"a"', '"/a", "/[!l]*/a", "/?/a"'),
}
DROPPED = {
    "another kind": (ONLY, MUST),
    "other names": (ONLY, ONLY.replace("/a", "/c").replace("/b", "/d")),
    "another right": (ONLY, ONLY.replace("publish", "subscribe")),
    "another enclave must": (MUST, MUST.replace("/x", "/z")),
    "other enclaves have no wildcards": (WIDEST, WIDEST.replace("/x", "/z")),
    "others are apart": (APART, APART.replace("/base", "/arm")),
}


@pytest.mark.parametrize("case", KEPT)
def test_what_is_demanded_in_other_words_is_kept(case: str) -> None:
    before, after = map(read, KEPT[case])
    assert dropped_requirements(before, after) == ()


@pytest.mark.parametrize("case", WEAKENED)
def test_what_is_demanded_in_part_is_weakened(case: str) -> None:
    before, after = map(read, WEAKENED[case])
    (found,) = dropped_requirements(before, after)
    assert (found.change, found.kept) == ("weakened", after)


@pytest.mark.parametrize("case", ELSEWHERE)
def test_what_no_longer_moves_with_the_namespace_is_weakened(case: str) -> None:
    before, after, wider = (
        read(ONLY.replace('"/a"', names)) for names in (*ELSEWHERE[case], '"*/a", "/a"')
    )
    (found,) = dropped_requirements(before, after)
    assert (found.change, found.only_elsewhere) == ("weakened", True)
    assert found.text().endswith(
        ": only one of the files states /a without the first '/', as a relative name"
    )
    assert dropped_requirements(before, before) == dropped_requirements(before, wider) == ()
    in_root = (
        parse_requirements(ONLY.replace('"/a"', names).encode(), "r.toml", namespaces=["/"])
        for names in ELSEWHERE[case]
    )
    assert dropped_requirements(*in_root) == ()


def test_an_exception_of_some_namespaces_is_weakened() -> None:
    before, after = read(NOTHING_BUT), read(NOTHING_BUT.replace('"/y"', '"/y", "!*/left/*"'))
    (found,) = dropped_requirements(before, after)
    assert found.only_elsewhere and found.text().endswith("(`sros check --namespace`)")
    assert dropped_requirements(after, after) == ()


def test_an_exception_that_moves_into_what_does_not_is_weakened() -> None:
    """In /arm, ``!/z`` is an exception from ``//arm/*``; twin: never from ``/arm/*``."""
    for listed, is_weakened in (("//arm/*", True), ("/arm/*", False)):
        only, nothing_but = (text.replace("/y", listed) for text in (ONLY, NOTHING_BUT))
        excepting, sparing = (
            text.replace(listed, f'{listed}", "!/z') for text in (only, nothing_but)
        )
        for before, after in ((excepting, only), (nothing_but, sparing)):
            found = dropped_requirements(read(before), read(after))
            assert [each.only_elsewhere for each in found] == [True] * is_weakened


def test_an_enclave_that_begins_to_move_with_the_namespace_or_stops_is_weakened() -> None:
    """Twin: ``//x`` in place of ``*/x`` is stricter."""
    moving, unmoved, anywhere = (read(ONLY.replace('"/y"', f'"{at}y"')) for at in ("/", "//", "*/"))
    for before, after in ((moving, unmoved), (unmoved, moving), (unmoved, anywhere)):
        (found,) = dropped_requirements(before, after)
        assert found.only_elsewhere is (after is not anywhere)
    assert dropped_requirements(anywhere, unmoved) == ()


def test_another_kind_that_stays_is_weakened() -> None:
    before, after = read(ONLY.replace('"/a"', '"a"')), read('[[nobody]]\npublish = ["/a", "/b*"]\n')
    (found,) = dropped_requirements(before, after)
    assert (found.change, found.kept, found.only_elsewhere) == ("weakened", (), True)


@pytest.mark.parametrize("case", DROPPED)
def test_what_is_not_demanded_is_dropped(case: str) -> None:
    before, after = map(read, DROPPED[case])
    (found,) = dropped_requirements(before, after)
    assert (found.change, found.kept) == ("dropped", ())


def test_twenty_of_twenty_one_are_named() -> None:
    every = read_requirements(policies_dir() / "mobile_robot.requirements.toml")
    assert dropped_requirements(every, every) == ()
    found = dropped_requirements(every, every[:1])
    assert [each.requirement for each in found] == list(every[1:])


def test_a_value_is_json() -> None:
    (found,) = dropped_requirements(read(ONLY), read(ONLY.replace('"/y"', '"*"')))
    assert as_plain(found) == {
        "change": "weakened",
        "demand": "only /x, /y may publish /a, /b/*",
        "name": "",
        "why": "",
        "file": "r.toml",
        "line": 1,
        "now": ["only /x, * may publish /a, /b/*"],
    }
