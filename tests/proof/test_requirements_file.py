"""The requirements file: what it can say, and what is wrong with it, by file and line."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.automata import NameSet
from sros_tool.dds.decision.expressions import names_of
from sros_tool.dds.decision.vendors import Style
from sros_tool.errors import DocumentError
from sros_tool.policy.model import ALLOW, Level, Source
from sros_tool.policy.rights import Right
from sros_tool.proof.requirements import (
    Apart,
    AtMost,
    Must,
    Nobody,
    NotBoth,
    NothingBut,
    Only,
    Protected,
    Widest,
    demand,
    parse_requirements,
    read_requirements,
)
from sros_tool.proof.suggestions import render_requirements, suggest
from sros_tool.proof.worlds import TopicAccess, World

EVERY_KIND = """\
[[only]]
publish = ["/cmd_vel"]
subscribe = ["/a", "/b", "/c", "/d", "/e", "/f"]
enclaves = ["/robot/mux", "/arm/*"]
name = "drive"
why = "commands meet in one place"

[[ nobody ]] # each calls set_parameters
request = ["*/set_parameters"]
[[must]]
enclave = "/robot/mux"
call = ["/go"]
publish = ["/x"]
[[at_most]]
execute = ["/go"]
enclaves = 1
[[widest]]
enclaves = ["*"]
reply = []
[[protected]]
topics = ["/camera/*"]
actions = ["/go"]
level = "encrypt"
[[apart]]
from = ["/web/*"]
to = ["/"]
through = ["/robot/mux"]
[[protected]]
services = ["/x"]
level = "sign"
[[nothing_but]]
enclaves = ["/arm/*", "!/arm/base"]
subscribe = ["/a"]
[[not_both]]
first = { publish = ["/x"] }
second = { request = ["/y"], call = ["/z"] }
"""


def at(line: int) -> Source:
    return Source("r.toml", line)


def test_every_kind_is_read_with_its_line() -> None:
    assert parse_requirements(EVERY_KIND.encode(), "r.toml") == (
        Only(
            source=at(1),
            name="drive",
            why="commands meet in one place",
            rights=(
                ("publish", ("/cmd_vel",)),
                ("subscribe", ("/a", "/b", "/c", "/d", "/e", "/f")),
            ),
            enclaves=("/robot/mux", "/arm/*"),
        ),
        Nobody(source=at(8), rights=(("request", ("*/set_parameters",)),)),
        Must(
            source=at(10),
            rights=(("publish", ("/x",)), ("call", ("/go",))),
            enclave="/robot/mux",
        ),
        AtMost(source=at(14), rights=(("execute", ("/go",)),), most=1),
        Widest(source=at(17), rights=(("reply", ()),), enclaves=("*",)),
        Protected(
            source=at(20), names=(("topics", "/camera/*"), ("actions", "/go")), level=Level.ENCRYPT
        ),
        Apart(source=at(24), sources=("/web/*",), targets=("/",), through=("/robot/mux",)),
        Protected(source=at(28), names=(("services", "/x"),), level=Level.SIGN),
        NothingBut(
            source=at(31),
            rights=(("subscribe", ("/a",)),),
            enclaves=("/arm/*", "!/arm/base"),
        ),
        NotBoth(
            source=at(34),
            first=(("publish", ("/x",)),),
            second=(("request", ("/y",)), ("call", ("/z",))),
        ),
    )


def test_each_says_what_it_demands() -> None:
    assert [demand(each) for each in parse_requirements(EVERY_KIND.encode(), "r.toml")] == [
        "only /robot/mux, /arm/* may publish /cmd_vel or subscribe /a, /b, /c, /d and 2 more",
        "nobody may request */set_parameters",
        "/robot/mux has to be able to publish /x and call action /go",
        "at most 1 enclave may execute action /go",
        "* may use no wildcard to reply",
        "topic /camera/*, action /go has to be encrypted",
        "/web/* must not influence / except through /robot/mux",
        "service /x has to be signed",
        "/arm/* (but not /arm/base) may do nothing but subscribe /a",
        "nobody may both publish /x and request /y or call action /z",
    ]


NOBODY = '[[nobody]]\npublish = ["/x"]\n'
MANY = ",\n".join(f'"/x{number}"' for number in range(142))
WRONG = {
    "": "has no requirement",
    "[[nobody]": "not valid TOML",
    f"{NOBODY}[[none]]\n": "r.toml:3: 'none' is not a kind of requirement",
    'nobody = [{publish = ["/x"]}]': "nobody is not written as tables",
    '[nobody]\npublish = ["/x"]': "nobody is not written as tables",
    "nobody = 1": "nobody is not written as tables",
    f'{NOBODY}why = """\n[[nobody]]\n"""': "nobody is not written as tables",
    f"{NOBODY}\nenclaves = []": "r.toml:4: 'enclaves' is not a key of [[nobody]]",
    "[[nobody]]\n": "r.toml:1: [[nobody]] names no right",
    "[[nobody]]\n\npublish = []": "r.toml:3: publish is not a list of names",
    '[[nobody]]\npublish = "/x"': "r.toml:2: publish is not a list of names",
    "[[nobody]]\npublish = [1]": "r.toml:2: publish is not a list of names",
    '[[nobody]]\npublish = ["/"]': "'/' is not valid in publish",
    '[[nobody]]\npublish = ["~/x"]': "'~/x' is not valid in publish",
    '[[nobody]]\npublish = ["/x y"]': "'/x y' is not valid in publish",
    '[[nobody]]\npublish = ["/[^a]"]': "'/[^a]' is not valid in publish",
    '[[nobody]]\npublish = ["/{robot}/x"]': "{robot} stands for robots, but no fleet says which",
    '[[widest]]\npublish = []\nenclaves = ["/{robot}/x"]': "r.toml:3: {robot} stands for robots",
    f"{NOBODY}why = 1": "r.toml:3: why has 1, which is not a text",
    f'{NOBODY}why = ""': "r.toml:3: why has '', which is not a text",
    f'{NOBODY}name = "{"n" * 501}"': "r.toml:3: name has",
    '[[only]]\npublish = ["/x"]': "r.toml:1: enclaves is missing in [[only]]",
    '[[only]]\npublish = ["/x"]\nenclaves = ["robot"]': "r.toml:3: 'robot' is not an enclave",
    '[[must]]\npublish = ["/x"]\nenclave = "/a*"': "r.toml:3: '/a*' is not an enclave",
    '[[must]]\npublish = ["/x"]\nenclave = "a"': "r.toml:3: 'a' is not an enclave",
    '[[only]]\npublish = ["/x"]\nenclaves = ["///a"]': "r.toml:3: '///a' is not an enclave",
    '[[must]]\npublish = ["/x"]': "r.toml:1: enclave is missing in [[must]]",
    '[[at_most]]\npublish = ["/x"]\nenclaves = 0': "r.toml:3: enclaves has 0",
    '[[at_most]]\npublish = ["/x"]\nenclaves = true': "r.toml:3: enclaves has True",
    '[[at_most]]\npublish = ["/x"]\nenclaves = ["/a"]': "r.toml:3: enclaves has ['/a']",
    '[[protected]]\ntopics = ["/x"]': "r.toml:1: level is missing in [[protected]]",
    '[[protected]]\ntopics = ["/x"]\nlevel = "SIGN"': "r.toml:3: level has 'SIGN'",
    '[[protected]]\ntopics = ["/x"]\nlevel = []': "r.toml:3: level has []",
    '[[only]]\npublish = ["/x"]\nenclaves = ["!/x"]': "names only excluded enclaves",
    '[[only]]\npublish = ["/x"]\nenclaves = ["!x"]': "r.toml:3: '!x' is not an enclave",
    "[[not_both]]\nfirst = 1": "r.toml:2: first has 1, which does not state rights",
    '[[not_both]]\nfirst = { publish = ["/x"] }': "r.toml:1: second is missing in [[not_both]]",
    '[[not_both]]\nfirst = { fly = ["/x"] }': "r.toml:2: first has {'fly': ['/x']}",
    "[[not_both]]\nfirst = { publish = [] }": "r.toml:2: publish is not a list of names",
    '[[protected]]\nlevel = "sign"': "r.toml:1: [[protected]] names nothing",
    '[[apart]]\nfrom = ["/x"]': "r.toml:1: to is missing in [[apart]]",
    f"{NOBODY * 1001}": "more than 1000 requirements",
    f"[[apart]]\nfrom = [{MANY}]\nto = [{MANY}]\n": "r.toml:1: the requirements up to this",
    f"[[not_both]]\nfirst.call = [{MANY}]\nsecond.call = [{MANY}]": "more than 20000 pairs",
    f"a = {'[' * 1500}{']' * 1500}": "not valid TOML",
    f"{'x.' * 3000}y = 1": "not valid TOML",
    "[[\x1b]]": "not valid TOML",
}


@pytest.mark.parametrize("text", WRONG, ids=lambda text: repr(text[:40]))
def test_what_is_wrong_is_one_error_that_names_the_place(text: str) -> None:
    with pytest.raises(DocumentError) as caught:
        parse_requirements(text.encode(), "r.toml")
    assert WRONG[text] in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "latin.toml").write_bytes(b"why = '\xff'")
    (tmp_path / "large.toml").write_text("#" * 2_000_000)
    for name in ("latin.toml", "large.toml", "gone.toml", "."):
        with pytest.raises(DocumentError):
            read_requirements(tmp_path / name)


def test_proposals_have_no_name_that_the_file_could_not_have() -> None:
    names = ("/ok", "rt/x*", "/a b", "/a\x1b[31m*", "/fine*")
    rights = [
        Right(each, ALLOW, right, name)
        for name in names
        for each, right in (("/e", "publish"), ("/f", "subscribe"))
    ]
    sides = {
        "/e": TopicAccess(names_of(Style.FNMATCH, ("rt/ok", "rt/fine*")), NameSet()),
        "/f": TopicAccess(NameSet(), names_of(Style.FNMATCH, ("rt/ok", "rt/fine*"))),
    }
    world = World("a world", sides, confirm=lambda *_: True, stated_access=sides)
    text = render_requirements(suggest(rights, [world]).requirements, ['a "file"\n'])
    page, section = "docs/howto/package.md", "Requirements for a package"
    assert f"# other changes of {page} ({section}).\n\n" in text
    assert f"\n### {section}\n" in (Path(__file__).parents[2] / page).read_text()
    found = parse_requirements(text.encode(), "r.toml")
    assert [demand(each) for each in found][:1] == ["only /e may publish /ok"]
    assert "/* (but not /operator/*) may use wildcards only to publish /fine*" in map(demand, found)
    assert "\x1b" not in text


def test_a_file_is_read_for_each_namespace() -> None:
    text = b"""
[[only]]
publish = ["cmd", "/tf", "*/stop"]
enclaves = ["/mux", "/arm/*", "!/arm/tool"]
[[must]]
request = ["open"]
enclave = "/"
[[not_both]]
first = { publish = ["cmd"] }
second = { call = ["/dock"] }
[[apart]]
from = ["*", "!//arm/*"]
to = ["/base", "//web"]
"""
    plain, *_ = parse_requirements(text, "r.toml")
    assert demand(plain) == ("only /mux, /arm/* (but not /arm/tool) may publish /cmd, /tf, */stop")
    both = parse_requirements(text, "r.toml", namespaces=("/left", "/right"))
    assert [demand(each).replace("/right", "/left") for each in both[1::2]] == [
        demand(each) for each in both[::2]
    ]
    assert [demand(each) for each in both[::2]] == [
        "only /left/mux, /left/arm/* (but not /left/arm/tool) may publish /left/cmd, /tf, */stop",
        "/left has to be able to request /left/open",
        "nobody may both publish /left/cmd and call action /dock",
        "* (but not /arm/*) must not influence /left/base, /web",
    ]
