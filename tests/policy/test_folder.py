"""The policies of a folder: none is left out in silence, wherever and under whatever name it is."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sros_tool.errors import DocumentError
from sros_tool.policy.document import files_of_policies
from tests.support.harness import policy_text, publish, sros

POLICY = policy_text({"/a": publish("/x")})
OTHER = policy_text({"/evil": publish("/cmd_vel")})

NO_POLICY = {
    "fragment.xml": "<profile ns='/' node='n'/>",
    "README.md": f"Write for example:\n\n{OTHER}",
    "sub/empty.xml.txt": "",
    "picture.svg": "<svg/>",
    ".git/config.xml": OTHER,
}
REFUSED = {
    "evil.xml.bak": (OTHER, "looks like a policy, but its name does not end with .xml"),
    "sub/evil": (f"\ufeff \n{OTHER}", "looks like a policy"),
    "sub/.hidden/evil.txt": (f"<?xml version='1.0'?>\n<!-- -->{OTHER}", "looks like a policy"),
    "broken.xml": ("<policy", "broken.xml"),
}


def write(folder: Path, name: str, text: str) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text, encoding="utf-8")


def test_every_policy_below_is_found(tmp_path: Path) -> None:
    for name, text in NO_POLICY.items():
        write(tmp_path, name, text)
    names = ("a.xml", "b.XML", "sub/c.xml", "sub/.d/e.Xml")
    for name in names:
        write(tmp_path, name, POLICY)
    os.mkfifo(tmp_path / "pipe.xml")
    assert [str(each.relative_to(tmp_path)) for each in files_of_policies(tmp_path)] == [
        "a.xml",
        "b.XML",
        "sub/c.xml",
        "sub/.d/e.Xml",
    ]


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_perhaps_a_policy_is_refused(name: str, tmp_path: Path) -> None:
    write(tmp_path, "a.xml", POLICY)
    text, says = REFUSED[name]
    write(tmp_path, name, text)
    with pytest.raises(DocumentError, match=says):
        list(files_of_policies(tmp_path))
    write(tmp_path / "utf16", "a.xml", POLICY)
    (tmp_path / "utf16" / "evil.inc").write_bytes(OTHER.encode("utf-16"))
    with pytest.raises(DocumentError, match="looks like a policy"):
        list(files_of_policies(tmp_path / "utf16"))


def test_a_link_to_a_folder_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "p", "a.xml", POLICY)
    write(tmp_path / "away", "evil.xml", OTHER)
    (tmp_path / "p" / "robots").symlink_to("../away")
    with pytest.raises(DocumentError, match="robots' is a link to a folder"):
        list(files_of_policies(tmp_path / "p"))


@pytest.mark.parametrize("name", ["robots/evil.xml", "evil.XML", "robots/evil.inc"])
def test_a_comparison_counts_what_lies_below(name: str, tmp_path: Path) -> None:
    """The first two gave access that was not compared, the third one is not left out unsaid."""
    for side in ("before", "after"):
        write(tmp_path / side, "a.xml", POLICY)
    asked = ("diff_policy", "--no-new-access", tmp_path / "before", tmp_path / "after")
    assert sros(*asked).status == 0
    write(tmp_path / "after", name, OTHER)
    ended = sros(*asked)
    assert ended.status == (2 if name.endswith(".inc") else 1)
    assert ("evil.inc" if ended.status == 2 else "/evil") in ended.out + ended.err
    checked = sros("check", "policy", tmp_path / "after", "--include", "policy.no-rosout")
    assert checked.status == (2 if name.endswith(".inc") else 1)
    assert "evil" in checked.out + checked.err
