"""What is printed as Markdown: bounded, and names of others stay text in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.markdown import bounded_list, code, fenced, plain
from tests.support.harness import policy_text, publish, sros

HOSTILE = [
    "`x` [a](http://b) ![i](http://c)",
    "``` end",
    "a\n# heading\n```\n<!-- -->",
    "@team #12 https://x.y <img src=x onerror=y> | cell | --> &lt;",
    "\x1b[31m\u202eabc\u2028d\ud800",
    "",
    "`",
    "a" * 100_000,
]


def spans(text: str) -> list[str]:
    """Return the code spans of a line, as CommonMark 6.1 delimits them; fail if one is open."""
    found, at = [], 0
    while (start := text.find("`", at)) >= 0:
        size = len(text[start:]) - len(text[start:].lstrip("`"))
        end = start + size
        while True:
            end = text.index("`", end)
            run = len(text[end:]) - len(text[end:].lstrip("`"))
            if run == size:
                break
            end += run
        found.append(text[start + size : end])
        at = end + size
    return found


@pytest.mark.parametrize("text", HOSTILE)
def test_a_name_is_one_code_span(text: str) -> None:
    shown = code(text)
    (inside,) = spans(shown)
    assert shown == f"{shown[0] * ((len(shown) - len(inside)) // 2)}{inside}{shown[-1:]}" or (
        shown.strip("`").strip() == inside.strip("`").strip()
    )
    assert shown.isprintable()
    assert len(shown) < 1000


@pytest.mark.parametrize(
    "unseen", ["\ufe0f", "\u3164", "\u2800", "\u0336", "\U0001d159", "\U000e0041"]
)
def test_two_names_that_look_alike_are_told_apart(unseen: str) -> None:
    assert code(f"robot{unseen}.xml") == f"`robot\\x{ord(unseen):x}.xml`"
    assert code("r\u00e9sum\u00e9 \U0001f7e2") == "`r\u00e9sum\u00e9 \U0001f7e2`"


@pytest.mark.parametrize("text", HOSTILE[:-1])
def test_a_fence_ends_where_it_should(text: str) -> None:
    first, *inside, last = fenced(text).split("\n")
    fence = first.removesuffix("text")
    assert last == fence
    assert not any(fence in line for line in inside)
    assert all(line.isprintable() for line in inside)


def test_words_are_no_markup_and_a_list_is_bounded() -> None:
    assert plain("a rule for * [x](y) <b> `c` a_b") == r"a rule for \* \[x\](y) \<b\> \`c\` a\_b"
    listed = bounded_list(("x" * 90 for _ in range(1000)), 1000, "which are elsewhere")
    assert listed.endswith("\n- and 990 more, which are elsewhere")
    assert len(listed) < 1100


def test_findings_as_markdown(tmp_path: Path) -> None:
    name = "p`![x](http:y)@team.xml"
    (tmp_path / name).write_text(policy_text({f"/a{i}": publish("/x/[0-9]*") for i in range(300)}))
    ended = sros("check", name, "--format", "markdown", "--include", "policy.name-*", cwd=tmp_path)
    assert ended.status == 1
    heading, _, *items = ended.out.strip().split("\n")
    assert heading == "### Findings: 300 warnings"
    assert "more, which `sros check` shows" in items[-1]
    for item in items[:-1]:
        assert any(each.strip() == f"{name}:1" for each in spans(item))
        outside = item
        for each in spans(item):
            outside = outside.replace(each, "")
        assert "http" not in outside
        assert "@" not in outside
    assert len(ended.out) < 21_000
    for wrong in (("--list",), ("--json",)):
        assert sros("check", name, *wrong, "--format", "markdown", cwd=tmp_path).status == 2


def test_a_difference_as_markdown_with_its_picture(tmp_path: Path) -> None:
    one = {"/a": publish("/x"), "/b": publish("/y", "/x")}
    (tmp_path / "one.xml").write_text(policy_text(one))
    (tmp_path / "other.xml").write_text(policy_text({"/a": publish("/z"), "/b": one["/b"]}))
    words = ("--format", "markdown")
    ended = sros("diff_policy", "one.xml", "other.xml", *words, cwd=tmp_path)
    assert ended.status == 1
    assert ended.out.startswith(
        "### Rights: 2 differences\n\n**1 added**\n\n- `/a ALLOW publish topic /z`\n\n"
        "**1 removed**\n\n- `/a ALLOW publish topic /x`\n\n```mermaid\n"
    )
    assert ended.out.rstrip().endswith("\n```")
    assert '"publish: added"' in ended.out
    assert "/b" in ended.out, "who else uses the name is shown, too"
    assert "/y" not in ended.out
    same = sros("diff_policy", "one.xml", "one.xml", *words, cwd=tmp_path).ok()
    assert same.out == "### Rights: no difference\n\n"
    many = {f"/e{i}": publish(*(f"/n{i}/t{j}" for j in range(9))) for i in range(400)}
    (tmp_path / "many.xml").write_text(policy_text(many))
    large = sros("diff_policy", "one.xml", "many.xml", *words, cwd=tmp_path).out
    assert "more, which `sros diff_policy` shows" in large
    assert "too large for a comment" in large
    assert len(large) < 30_000


def test_certificates_as_markdown(tmp_path: Path) -> None:
    sros("create_enclave", "ks", "/a", cwd=tmp_path)
    sros("create_keystore", "ks", cwd=tmp_path)
    sros("create_enclave", "ks", "/a", cwd=tmp_path).ok()
    words = ("check", "ks", "--format", "markdown", "--needs-renewal")
    fine = sros(*words, "30d", cwd=tmp_path).ok()
    assert fine.out == "### Certificates: no enclave needs to be renewed (30d)\n\n"
    due = sros(*words, "9000d", cwd=tmp_path)
    assert due.status == 1
    title = "### Certificates: 1 enclave and 2 shared files need to be renewed (9000d)\n\n"
    assert due.out.startswith(f"{title}- `identity CA  until ") and "\n- `/a " in due.out
    (tmp_path / "ks/enclaves/a/cert.pem").write_text("")
    unread = "### Certificates: 0 enclaves need to be renewed (30d), 1 cannot be read\n\n- `/a "
    assert sros(*words, "30d", cwd=tmp_path).out.startswith(unread)
    (tmp_path / "ks/public/identity_ca.cert.pem").write_text("")
    unread = "### Certificates: 0 enclaves need to be renewed (30d), 3 cannot be read\n\n- `CAs  "
    assert sros(*words, "30d", cwd=tmp_path).out.startswith(unread)
