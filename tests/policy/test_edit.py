"""Merging leaves the file as its owner wrote it: only what is added is new."""

from __future__ import annotations

import difflib
import re
from pathlib import Path

import pytest

from sros_tool.errors import DocumentError, PolicyError
from sros_tool.policy.document import read_policy
from sros_tool.policy.merge import merge_into
from sros_tool.policy.model import Policy
from sros_tool.policy.rights import policy_rights

POLICY = """\
<?xml version="1.0" encoding="UTF-8"?>
<!-- The robot & its <topics>. -->
<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude">
  <enclaves>
    <enclave path="/a">
      <profiles type="robot">
        <!-- Two nodes. -->
        <profile ns="/" node="n">
          <xi:include href="common.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW">
            <topic>b</topic> <!-- the second letter -->
            <!-- the fourth letter -->
            <topic>d</topic>
          </topics>
          <?keep this?>
        </profile>
        <profile ns='/ns/' node="m"/>
        <metadata><x:owner xmlns:x="urn:x">me &amp; you</x:owner></metadata>
      </profiles>
    </enclave>
  </enclaves>
</policy>
"""
COMMON = '<profile><topics publish="ALLOW"><topic>/rosout</topic></topics></profile>'


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "common.xml").write_text(COMMON)
    (tmp_path / "a.xml").write_text(POLICY)
    return tmp_path / "a.xml"


def asking(groups: str, *, ns: str = "/", node: str = "n", path: str = "/a") -> Policy:
    text = (
        f'<policy version="0.2.0"><enclaves><enclave path="{path}"><profiles>'
        f'<profile ns="{ns}" node="{node}">{groups}</profile></profiles></enclave></enclaves>'
        "</policy>"
    )
    return read_policy(Path("/nowhere/b.xml"), text.encode())


def topics(*names: str, rights: str = 'publish="ALLOW"') -> str:
    return f"<topics {rights}>{''.join(f'<topic>{name}</topic>' for name in names)}</topics>"


def new_text(before: bytes, after: bytes) -> list[str]:
    """The pieces that were put into a document; nothing else may have changed."""
    matcher = difflib.SequenceMatcher(None, before.decode(), after.decode(), autojunk=False)
    pieces = []
    for action, _, _, start, end in matcher.get_opcodes():
        assert action in ("equal", "insert")
        if action == "insert":
            pieces.append(after.decode()[start:end])
    return pieces


def lines_added(before: str, after: str) -> list[tuple[str, str]]:
    """Each new line, with the line before it."""
    old, new = before.splitlines(), after.splitlines()
    matcher = difflib.SequenceMatcher(None, old, new, autojunk=False)
    found = []
    for action, _, _, start, end in matcher.get_opcodes():
        assert action in ("equal", "insert"), new[start:end]
        found += [(new[at - 1].strip(), new[at]) for at in range(start, end) if action == "insert"]
    return found


def test_names_go_where_they_belong_in_a_sorted_group(file: Path) -> None:
    merged = merge_into(file, asking(topics("c", "e", "a", "b", "/rosout")))
    assert lines_added(POLICY, merged.document.decode()) == [
        ('<topics publish="ALLOW">', "            <topic>a</topic>"),
        ("<topic>b</topic> <!-- the second letter -->", "            <topic>c</topic>"),
        ("<topic>d</topic>", "            <topic>e</topic>"),
    ]
    assert [right.name for right in merged.added] == ["/a", "/c", "/e"]


def test_names_go_to_the_end_of_an_unsorted_group(file: Path) -> None:
    text = POLICY.replace("<topic>d</topic>", "<topic>a</topic>")
    file.write_text(text)
    merged = merge_into(file, asking(topics("z", "c")))
    assert lines_added(text, merged.document.decode()) == [
        ("<topic>a</topic>", "            <topic>c</topic>"),
        ("<topic>c</topic>", "            <topic>z</topic>"),
    ]


def test_a_leading_comment_stays_leading(file: Path) -> None:
    text = POLICY.replace("<topic>b</topic> <!-- the", "<!-- letters --><topic>b</topic> <!-- the")
    file.write_text(text.replace("--><topic>b", "-->\n            <topic>b"))
    merged = merge_into(file, asking(topics("a"))).document.decode()
    assert merged.index("letters") < merged.index("<topic>a<")


def test_a_group_with_more_rights_is_not_taken(file: Path) -> None:
    file.write_text(POLICY.replace('publish="ALLOW"', 'publish="ALLOW" subscribe="ALLOW"'))
    merged = merge_into(file, asking(topics("c")))
    after = read_policy(file, merged.document)
    assert [f"{right.right} {right.name}" for right in merged.added] == ["publish /c"]
    assert policy_rights(after) - policy_rights(read_policy(file)) == set(merged.added)


def test_a_group_with_a_denial_is_not_taken(file: Path) -> None:
    rights = 'publish="ALLOW" subscribe="DENY"'
    file.write_text(POLICY.replace('<topics publish="ALLOW">', f"<topics {rights}>"))
    assert [str(r) for r in merge_into(file, asking(topics("c"))).added] == [
        "/a ALLOW publish topic /c"
    ]


def test_new_groups_profiles_and_enclaves(file: Path) -> None:
    more = asking(topics("q", rights='subscribe="ALLOW"') + "<services request='ALLOW'>"
                  "<service>s</service></services>")  # fmt: skip
    merged = merge_into(file, more)
    assert [line for _, line in lines_added(POLICY, merged.document.decode())] == [
        '          <topics subscribe="ALLOW">',
        "            <topic>q</topic>",
        "          </topics>",
        '          <services request="ALLOW">',
        "            <service>s</service>",
        "          </services>",
    ]
    for other in (asking(topics("q"), node="new"), asking(topics("q"), path="/new")):
        text = merge_into(file, other).document.decode()
        assert len(lines_added(POLICY, text)) == (5 if other.enclaves[0].path == "/a" else 9)
        assert text.index("new") > text.index("node=")
        assert ("new" in text[: text.index("<metadata>")]) is (other.enclaves[0].path == "/a")


def test_an_empty_profile_is_opened(file: Path) -> None:
    asked = asking(topics("q") + topics("r", rights='subscribe="ALLOW"'), ns="/ns", node="m")
    merged = merge_into(file, asked).document.decode()
    assert merged == POLICY.replace(
        "<profile ns='/ns/' node=\"m\"/>",
        "<profile ns='/ns/' node=\"m\">\n"
        '          <topics publish="ALLOW">\n'
        "            <topic>q</topic>\n"
        "          </topics>\n"
        '          <topics subscribe="ALLOW">\n'
        "            <topic>r</topic>\n"
        "          </topics>\n"
        "        </profile>",
    )


@pytest.mark.parametrize("content", ["", "\n        ", "\n<!-- nothing yet -->\n        "])
def test_a_profile_without_rules_is_filled(file: Path, content: str) -> None:
    text = POLICY.replace('node="m"/>', f'node="m">{content}</profile>')
    file.write_text(text)
    merged = merge_into(file, asking(topics("q"), ns="/ns", node="m")).document
    new_text(text.encode(), merged)
    assert b"  </topics>\n        </profile>" in merged


def test_what_it_includes_is_not_touched(file: Path) -> None:
    only = re.sub(r"<topics p.*?</topics>", "", POLICY, flags=re.DOTALL)
    file.write_text(only)
    merged = merge_into(file, asking(topics("/rosout", "/z"))).document
    assert [right for right in new_text(only.encode(), merged) if "rosout" in right] == []
    assert file.with_name("common.xml").read_text() == COMMON


# ── forms of a file ────────────────────────────────────────────────────────────────────────

FORMS = {
    "as it is": POLICY.encode(),
    "CRLF": POLICY.replace("\n", "\r\n").encode(),
    "tabs": POLICY.replace("  ", "\t").encode(),
    "no newline at the end": POLICY.rstrip().encode(),
    "one line": re.sub(r"\n\s*", "", POLICY).encode(),
    "not indented": re.sub(r"\n\s*", "\n", POLICY).encode(),
    "byte order mark": b"\xef\xbb\xbf" + POLICY.encode(),
    "latin-1": POLICY.replace("UTF-8", "ISO-8859-1").replace(">me", ">ä").encode("latin-1"),
    "utf-8 letters": POLICY.replace(">me", ">äöü €").encode(),
    "utf-16": POLICY.replace("UTF-8", "UTF-16").encode("utf-16"),
    "utf-32": POLICY.replace("UTF-8", "UTF-32").encode("utf-32"),
    "no declaration": POLICY.split("\n", 1)[1].encode(),
    "CDATA and tricks": POLICY.replace(
        "me &amp; you", "<![CDATA[</metadata><topic>]]><a\u1680 b='>' c=\"/>\"/><!-- </policy> -->"
    ).encode(),
    "groups on one line": re.sub(
        r"(<topics p.*?</topics>)", lambda m: re.sub(r"\n\s*", "", m[0]), POLICY, flags=re.DOTALL
    ).encode(),
}
ASKED = (
    asking(topics("a", "c", "z") + topics("y", rights='subscribe="ALLOW" publish="DENY"')),
    asking("<actions call='ALLOW'><action>act</action></actions>", ns="/ns", node="m"),
    asking(topics("a"), node="new"),
    asking(topics("a"), path="/new"),
)


@pytest.mark.parametrize("asked", range(len(ASKED)))
@pytest.mark.parametrize("form", FORMS)
def test_everything_else_survives(file: Path, form: str, asked: int) -> None:
    before = FORMS[form]
    file.write_bytes(before)
    merged = merge_into(file, ASKED[asked])
    assert merged.added
    encoding = form if form in ("latin-1", "utf-16", "utf-32") else "utf-8"
    old, new = before.decode(encoding), merged.document.decode(encoding)
    if asked == 1:  # the empty profile is opened
        old = old.replace('node="m"/>', 'node="m"></profile>')
    rest = iter(new)
    assert all(letter in rest for letter in old)  # in this order
    assert new.count("\r\n") == (new.count("\n") if form == "CRLF" else 0)
    if form == "tabs":
        assert "\n " not in new
    if form == "one line":
        assert "\n" not in new
    assert new.endswith(old[-5:])
    file.write_bytes(merged.document)
    assert merge_into(file, ASKED[asked]).document == merged.document


def test_new_enclaves_of_a_dense_policy_have_lines_of_their_own(file: Path) -> None:
    """Otherwise, each finding about them would have the same line. Twin: the form "one line"."""
    dense = re.sub(r"\n\s*", "", POLICY).replace("</policy>", "\n</policy>")
    file.write_text(dense)
    merged = merge_into(file, asking(topics("a", "b"), path="/new")).document.decode()
    assert '\n  <enclave path="/new">\n' in merged and "\n          <topic>a</topic>\n" in merged


def test_nothing_to_add_is_the_file_itself(file: Path) -> None:
    merged = merge_into(file, asking(topics("b", "d", "/rosout")))
    assert merged.document == POLICY.encode()
    assert merged.added == ()


# ── where it cannot be done ────────────────────────────────────────────────────────────────


def test_an_encoding_that_cannot_be_kept_is_named(file: Path) -> None:
    """Without a byte order mark, which Python would add."""
    file.write_bytes(POLICY.replace("UTF-8", "UTF-16").encode("utf-16-be"))
    with pytest.raises(PolicyError, match="encoding UTF-16 cannot be kept exactly"):
        merge_into(file, ASKED[0])


def test_an_included_enclave_is_not_added_to(file: Path) -> None:
    file.with_name("part.xml").write_text(POLICY)
    include = '<xi:include href="part.xml" xpointer="xpointer(/policy/enclaves/enclave)"/>'
    file.write_text(re.sub(r"<enclave path.*</enclave>", include, POLICY, flags=re.DOTALL))
    with pytest.raises(PolicyError, match=r"The enclave is included from .*part\.xml:5"):
        merge_into(file, asking(topics("q")))
    assert merge_into(file, asking(topics("q"), path="/new")).added


def test_included_profiles_get_a_block_beside_them(file: Path) -> None:
    file.with_name("part.xml").write_text(POLICY)
    include = '<xi:include href="part.xml" xpointer="xpointer(/policy/enclaves/enclave/profiles)"/>'
    file.write_text(re.sub(r"<profiles.*</profiles>", include, POLICY, flags=re.DOTALL))
    merged = merge_into(file, asking(topics("q")))
    assert [right.name for right in merged.added] == ["/q"]
    assert merged.document.count(b"<profiles>") == 1


def test_a_part_that_is_included_again_is_not_changed(file: Path) -> None:
    path = "/policy/enclaves/enclave/profiles/profile[@node='n']/topics"
    again = f'<xi:include href="" xpointer="xpointer({path})"/>'
    file.write_text(POLICY.replace("<profile ns='/ns/' node=\"m\"/>",
                                   f"<profile ns='/ns/' node=\"m\">{again}</profile>"))  # fmt: skip
    with pytest.raises(PolicyError, match="without changing other rights"):
        merge_into(file, asking(topics("q")))


def test_many_comments_in_a_line_take_no_time(file: Path) -> None:
    """Each could begin or go on another one: 2^60 ways to find that the line goes on."""
    comments = "<!--c-->" * 60
    text = POLICY.replace("</topics>", f"</topics>{comments}<!-- end --><topics publish='DENY'>"
                          "<topic>never</topic></topics>", 1)  # fmt: skip
    assert text != POLICY
    file.write_text(text)
    merged = merge_into(file, asking(topics("q"))).document.decode()
    assert comments in merged


def test_a_fallback_is_not_the_file_itself(file: Path) -> None:
    fallback = f'<xi:include href="none.xml"><xi:fallback>{topics("k")}</xi:fallback></xi:include>'
    text = re.sub(r"<topics p.*?</topics>", fallback, POLICY, flags=re.DOTALL)
    file.write_text(text)
    merged = merge_into(file, asking(topics("k", "l"))).document.decode()
    assert merged.index("<topic>l<") > merged.index("</xi:include>")


@pytest.mark.parametrize("text", ["", "<policy", "<profile/>", POLICY.replace("/ns/", "a b")])
def test_an_invalid_file_is_an_error(file: Path, text: str) -> None:
    file.write_text(text)
    with pytest.raises(DocumentError):
        merge_into(file, asking(topics("q")))


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match="does not exist"):
        merge_into(tmp_path / "none.xml", asking(topics("q")))
