"""What a review compares and says, and which names of commits it takes."""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import shutil
import subprocess
import tarfile
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from unittest.mock import Mock

import pytest

from sros_tool.checks.formats import github_annotations
from sros_tool.checks.kind import all_kinds
from sros_tool.cli.review import review as review_verb
from sros_tool.errors import DocumentError, SrosError, UsageError
from sros_tool.files import templates_dir
from sros_tool.fleet.fleet_file import inventory, render_fleet
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.policy.model import ALLOW, PEER_RIGHT
from sros_tool.policy.rights import KIND_OF, Right, renamed_enclaves
from sros_tool.proof import commit_files, escapes, reviewed_requirements
from sros_tool.proof.commit_files import CommitFiles
from sros_tool.proof.repository import Repository
from tests.support.code_host import NODE, PROJECT
from tests.support.code_host import policy as policy_text
from tests.support.harness import Ended, copy_of, may, publish, sros, subscribe
from tests.support.long_form import some

ROBOT = {"/a": publish("/x"), "/b": subscribe("/x") + publish("/y")}
WIDER = {"/a": publish("/x"), "/b": subscribe("/x") + publish("/y", "/x")}
ONLY = '[[only]]\npublish = ["/x"]\nenclaves = ["/a"]\n'
PERSON = {
    f"GIT_{who}_{what}": "a@example.org"
    for who in ("AUTHOR", "COMMITTER")
    for what in ("NAME", "EMAIL")
}


class Change:
    """A repository whose first commit is the base of a change."""

    def __init__(self, folder: Path, base: str = "") -> None:
        self.folder = folder
        self.base = base
        self.sarif = folder.with_name(f"{folder.name}.sarif")
        if not base:
            self.git("init", "--quiet", "--initial-branch", "main")

    def git(self, *words: str) -> str:
        nobody = {"GIT_CONFIG_GLOBAL": "/dev/null", "GIT_CONFIG_NOSYSTEM": "1"}
        # Each commit would start two more processes, to see whether there is much to pack.
        done = subprocess.run(
            ["git", "-C", str(self.folder), "-c", "maintenance.auto=false", *words],
            env={"PATH": "/usr/bin:/bin", **PERSON, **nobody},
            capture_output=True,
            check=True,
        )
        return done.stdout.decode().strip()

    def commit(self, files: Mapping[str, str | bytes | None]) -> str:
        for name, text in files.items():
            place = self.folder / name
            place.parent.mkdir(parents=True, exist_ok=True)
            if text is None:
                place.unlink()
            else:
                place.write_bytes(text.encode() if isinstance(text, str) else text)
        self.git("add", "--all", "--force")
        self.git("commit", "--quiet", "--allow-empty", "--message", "x")
        commit = (self.folder / ".git/refs/heads/main").read_text().strip()
        self.base = self.base or commit
        return commit

    def review(self, *words: str) -> Ended:
        """Review the change; whatever fails the review, and nothing else, is more than a note in
        its SARIF, with a place.
        """
        self.sarif.unlink(missing_ok=True)
        output = () if "--sarif" in words else ("--sarif", str(self.sarif))
        ended = sros("review", "--base", self.base, *output, *words, cwd=self.folder)
        if self.sarif.exists():
            results = json.loads(self.sarif.read_text())["runs"][0]["results"]
            bad = {"error", "warning"} & {each["level"] for each in results}
            assert bool(bad) == bool(ended.status), ended
            places = [each["physicalLocation"] for one in results for each in one["locations"]]
            uris = [place["artifactLocation"]["uri"] for place in places]
            assert len(places) == len(results), results
            assert not any(uri.startswith(("..", "/", "git%3A")) for uri in uris), uris
        return ended


@pytest.fixture(scope="module")
def first_commit(tmp_path_factory: pytest.TempPathFactory) -> Change:
    """A repository with a policy and its requirements; only to be copied."""
    made = Change(tmp_path_factory.mktemp("change"))
    shutil.copytree(PROJECT / "policies/common", made.folder / "common")
    made.commit({"robot.xml": policy_text(ROBOT), "robot.toml": ONLY})
    return made


@pytest.fixture
def change(first_commit: Change, tmp_path: Path) -> Change:
    shutil.copytree(first_commit.folder, tmp_path, symlinks=True, dirs_exist_ok=True)
    return Change(tmp_path, first_commit.base)


FOUND = {
    *("review.new-access", "review.dropped-denial", "review.file", "review.private-key"),
    *("review.expiry", "review.undecided"),
}
"""The kinds of findings that the tests below see."""
DENIES = '<topics publish="DENY"><topic>/q</topic></topics>'


@pytest.mark.parametrize(
    ("files", "found", "place"),
    [
        ({"robot.xml": policy_text(WIDER)}, "review.new-access", ("robot.xml", 6)),
        (
            {"robot.xml": policy_text({"/new/a": publish("/x")})},
            "review.new-access",
            ("robot.xml", 3),
        ),
        ({"second.xml": policy_text(WIDER)}, "review.file", ("second.xml", 1)),
        ({"robot.toml": ONLY.replace('/a"', '/b"')}, "requirement.dropped", ("robot.toml", 1)),
        ({"robot.toml": None}, "review.undecided", ("robot.toml", 1)),
        (
            {"old.key": "-----BEGIN EC PRIVATE KEY-----\nMHcCAQEE\n"},
            "review.private-key",
            ("old.key", 1),
        ),
        ({"robot.xml": "<policy"}, "review.undecided", ("robot.xml", 1)),
    ],
)
def test_what_fails_a_review_is_in_its_sarif(
    files: dict[str, str | bytes | None], found: str, place: tuple[str, int], change: Change
) -> None:
    change.commit(files)
    words = ("--policy", "robot.xml", "--requirements", "robot.toml")
    with TemporaryDirectory() as folder:
        sarif, commands = Path(folder, "sarif"), Path(folder, "annotations")
        ended = change.review(*words, "--sarif", str(sarif), "--annotations", str(commands))
        assert ended.status
        results = json.loads(sarif.read_text())["runs"][0]["results"]
        lines = commands.read_text().splitlines()
    result = next(each for each in results if each["ruleId"] == found)
    assert result["level"] == "error"
    (at,) = result["locations"]
    where = at["physicalLocation"]
    assert (where["artifactLocation"]["uri"], where["region"]["startLine"]) == place
    begin = f"::{result['level']} file={place[0]},line={place[1]},title={found}::"
    assert any(line.startswith(begin) for line in lines)


def test_a_denial_that_is_gone_is_named_as_what_failed(change: Change) -> None:
    change.base = change.commit({"robot.xml": policy_text({"/a": publish("/x") + DENIES})})
    change.commit({"robot.xml": policy_text({"/a": publish("/x")})})
    with TemporaryDirectory() as folder:
        summary = Path(folder, "review.md")
        ended = change.review("--policy", "robot.xml", "--summary", str(summary), "--json")
        said = summary.read_text()
    (step,) = (step for step in json.loads(ended.out)["steps"] if step["status"])
    assert step["result"].startswith("1 DENY is gone, so that other policies may allow the names")
    (finding,) = json.loads(ended.out)["findings"]
    assert (finding["id"], finding["file"]) == ("review.dropped-denial", "robot.xml")
    assert finding["severity"] == "error"
    assert "### New access: none, but a DENY is gone" in said and "**1 DENY gone**" in said
    allowed = change.review("--policy", "robot.xml", "--new-access", "allow", "--json").ok()
    (finding,) = json.loads(allowed.out)["findings"]
    assert (finding["severity"], finding["accepted"]) == ("note", "option --new-access allow")


def test_no_name_becomes_a_command_of_the_runner() -> None:
    kind = next(iter(all_kinds().values()))
    line = github_annotations([kind.found("a\n::error::b", "c%0A\x1b[2J\u202e", "x,line=1:\r\ny")])
    assert line.count("\n") == 1 and line.removesuffix("\n").isprintable()
    assert line.startswith(rf"::{kind.severity.word} file=x%2Cline=1%3A\x0d\x0ay,line=1,title=")
    assert r"::a\x0a::error::b: c%250A\x1b[2J\u202e." in line


# ── what is compared ───────────────────────────────────────────────────────────────────────


def test_rights_that_move_to_a_second_policy_are_seen(change: Change) -> None:
    """Requirements and access are decided of all policies together."""
    change.commit({"second.xml": policy_text({"/evil": publish("/x")})})
    both = change.review("--policy", "robot.xml\nsecond.xml", "--requirements", "robot.toml")
    assert both.status == 1
    assert "requirements robot.xml second.xml: 1 error" in both.out
    assert "rights are new" in both.out
    one = change.review("--policy", "robot.xml")
    assert one.status == 1
    assert "'second.xml' changes and is not reviewed" in one.out
    assert "leave it out with --leave-out second.xml, or delete it" in one.out
    allowed = change.review("--policy", "robot.xml", "--new-access", "allow").ok().out
    assert "'second.xml' changes and is not reviewed" in allowed
    change.commit({"second.xml": None, "tests/second.xml": policy_text(WIDER)})
    left = change.review("--policy", "robot.xml", "--leave-out", "tests")
    assert left.status == 0
    assert "policies in 'tests' are not reviewed, as the options say" in left.out
    assert change.review("--policy", "robot.xml", "--leave-out", "tests/second.xml").status == 0
    inside = change.review("--policy", "robot.xml\ntests/second.xml", "--leave-out", "tests").out
    assert "policies in 'tests', except 'tests/second.xml', are not reviewed" in inside


def test_dropping_a_requirement_is_a_consent_of_its_own(change: Change) -> None:
    """It is named also where it is allowed, and never called nothing."""
    change.commit(
        {"robot.xml": policy_text(WIDER), "robot.toml": ONLY.replace('"/a"', '"/a", "/b"')}
    )
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    failed = change.review(*words)
    lines = (
        "  robot.toml:1: error: only /a may publish /x: the new file demands less: only /a, /b may "
        f"publish /x [requirement.dropped] (required before: git:{change.base[:12]}:robot.toml:1)",
        "  robot.xml:6: error: /b: may publish /x, but only /a may publish /x "
        "[requirement.violated]",
    )
    assert failed.status == 1 and all(line in failed.out for line in lines), failed
    assert "1 step failed and 1 step found only allowed changes" in failed.out
    assert "\n  + /b publish topic /x  (robot.xml:6)" in failed.out
    allowed = change.review(*words, "--dropped-requirements", "allow", "--json").ok()
    steps = {step["step"]: step for step in json.loads(allowed.out)["steps"]}
    assert steps["requirements-before"]["allowed"] and steps["new-access"]["allowed"]
    assert all(line.strip() in str(steps["requirements-before"]) for line in lines)
    change.commit({"robot.toml": None})
    gone = change.review(*words)
    assert "requirements robot.toml: 'robot.toml' is not in the commit" in gone.out
    assert "nothing found" not in gone.out.replace("policy robot.xml: nothing found", ""), gone


def test_no_step_is_ok_without_one_of_its_files(change: Change) -> None:
    required = ONLY.replace("[[only]]", "[[only]]\nname = 'b'")
    policy = policy_text({"/c": publish("/z")})
    change.base = change.commit({"second.toml": required, "second.xml": policy})
    words = ("--policy", "robot.xml\nsecond.xml", "--requirements", "robot.toml\nsecond.toml")
    cases: tuple[tuple[dict[str, str | bytes | None], int, list[str]], ...] = (
        ({"README": "x"}, 0, ["policy", "requirements", "new-access"]),
        ({"second.toml": "[[only]"}, 2, ["policy", "new-access"]),
        ({"second.toml": required, "second.xml": None}, 2, []),
    )
    for files, status, steps in cases:
        change.commit(files)
        ended = change.review(*words)
        ok = re.findall(r"^\[ok\] (policy|requirements|new-access) ", ended.out, re.M)
        assert (ended.status, ok) == (status, steps), ended
        assert "requirements-before" not in ended.out, ended


def test_changed_rights_are_named_and_decided_over_all_policies(change: Change) -> None:
    reads = '<topics subscribe="ALLOW"><topic>x</topic></topics>'
    change.base = change.commit({"second.xml": policy_text({"/c": reads})})
    change.commit(
        {
            "robot.xml": policy_text({"/b": publish("/y")}),
            "second.xml": policy_text({"/c": reads.replace(">x<", ">/x<")}),
        }
    )
    ended = change.review("--policy", "robot.xml\nsecond.xml")
    said = ended.out.partition("\n[ok] rights ")[2].splitlines()
    assert "written rights gone, 1 name made absolute" in said[0], ended
    assert "  ! /c may subscribe /x, but no enclave may publish it any more" in said
    protected = policy_text({"/b": publish("/y").replace("/y<", '/y<?sros protect="sign"?><')})
    change.commit({"robot.xml": protected})
    ended = change.review("--policy", "robot.xml\nsecond.xml", "--new-access", "allow")
    assert "1 stated protection changed" in ended.out
    assert "\n  + /b protect topic /y with sign\n" in ended.out, ended
    assert "  - /a ALLOW publish topic /x" in said
    (absolute,) = (line for line in said if line.startswith("  ~"))
    assert "/c subscribe topic /x begins with / now, so that the namespace of" in absolute
    assert absolute.endswith("(second.xml:3)")
    # A right that lost its counterpart never fails, but the last line has it.
    answered = policy_text({"/c": reads, "/d": publish("/x")})
    kept = policy_text({"/b": publish("/y")})
    change.base = change.commit({"robot.xml": kept, "second.xml": answered})
    change.commit({"second.xml": policy_text({"/c": reads})})
    ended = change.review("--policy", "robot.xml\nsecond.xml").ok()
    lost = ": nothing found that fails, but 1 right has no counterpart any more\n"
    assert ended.out.endswith(lost), ended
    # Users in /left and /right now share /x: this is new access for them.
    change.base = change.commit({"other": "1", "second.xml": policy_text({"/c": reads})})
    change.commit({"second.xml": policy_text({"/c": reads.replace(">x<", ">/x<")})})
    ended = change.review("--policy", "robot.xml\nsecond.xml")
    assert ended.status == 1, ended
    assert "robot.xml second.xml: 1 right is new only for users who put the node into" in ended.out
    assert "\n  + /c subscribe topic /x in another namespace  (second.xml:3)\n" in ended.out
    # The name of node c is the same in every namespace.
    change.base = change.commit({"second.xml": policy_text({"/c": reads.replace(">x", ">~/x")})})
    change.commit({"second.xml": policy_text({"/c": reads.replace(">x", ">c/x")})})
    change.review("--policy", "robot.xml\nsecond.xml").ok()
    denies = '<topics publish="DENY"><topic>{}</topic></topics>'
    change.base = change.commit({"second.xml": policy_text({"/c": denies.format("/stop*")})})
    split = denies.format("stop</topic><topic>stop?*")
    change.commit({"second.xml": policy_text({"/c": split})})
    ended = change.review("--policy", "robot.xml\nsecond.xml")
    assert "1 name made relative" in ended.out
    assert "  ~ /c DENY publish topic /stop no longer begins with /, so that the name" in ended.out
    assert ended.status == 1 and "! /c DENY publish topic /stop is gone" in ended.out
    change.base = change.commit({"second.xml": policy_text({"/c": denies.format("stop")})})
    change.commit({"second.xml": policy_text({"/c": denies.format("/stop")})})
    gone = "/c DENY publish topic /stop is gone for names such as /any_namespace/stop: other"
    assert gone in change.review("--policy", "robot.xml\nsecond.xml").out
    # A relative wildcard covers the absolute name only where the policy itself has its nodes.
    change.base = change.commit({"second.xml": policy_text({"/c": reads.replace(">x<", ">*/x<")})})
    both = reads.replace(">x<", ">*/x</topic><topic>/arm/x<")
    change.commit({"second.xml": policy_text({"/c": both})})
    ended = change.review("--policy", "robot.xml\nsecond.xml")
    assert "  ~ /c subscribe topic /arm/x begins with / now, so that the namespace of" in ended.out
    # A DENY of what nobody allows is a promise to those who merge the policy with others.
    # Names that are still denied, or are allowed now, do not count: /cmd* is only split.
    allows = publish("/lidar/*")

    def denied(*names: str) -> str:
        return policy_text({"/c": allows + denies.format("</topic><topic>".join(names))})

    change.base = change.commit({"second.xml": denied("/stop", "/*erase", "/cmd*", "/lidar/x")})
    change.commit({"second.xml": denied("/erase", "/lidar*/erase", "/cmd", "/cmd?*")})
    ended = change.review("--policy", "robot.xml\nsecond.xml")
    assert ended.status == 1 and "; 2 DENYs are gone" in ended.out, ended
    assert (
        "  ! /c DENY publish topic /*erase is gone for names such as /any_namespace/erase: other "
        "policies may allow them now\n"
        "  ! /c DENY publish topic /stop is gone: other policies may allow it now"
    ) in ended.out
    sides = f"git:{change.base}:second.xml", "second.xml"
    compared = sros("diff_policy", "--no-new-access", *sides, cwd=change.folder)
    denials = [line.strip() for line in ended.out.splitlines() if line.startswith("  ! ")]
    assert [line for line in compared.out.splitlines() if line.startswith("! ")] == denials
    assert "; 2 DENYs are gone" in compared.err


def test_a_denial_that_a_node_leaves_behind_is_gone(change: Change) -> None:
    """An enclave that gets a node, and has its access already, has to deny what was denied."""
    denies = '<services request="DENY"><service>/*erase</service></services>'
    other = policy_text({"/d": publish("/x")})
    one, both = (policy_text({"/a": "", **more}) for more in ({}, {"/c": publish("/x") + denies}))
    change.base = change.commit({"robot.xml": both, "second.xml": other})
    line = "! /d has a node of /c, but not the DENY request service /*erase of that enclave: other"

    def review_of(text: str, node: str, rights: str) -> Ended:
        profile = f'<profile ns="/" node="{node}">{rights}</profile>'
        moved = other.replace("</profiles>", f"{profile}</profiles>")
        change.commit({"robot.xml": text, "second.xml": moved})
        return change.review("--policy", "robot.xml\nsecond.xml")

    for text, node, rights, lines in (
        (one, "c", "", [f"  {line} policies may allow it now"]),
        (both.replace('node="c"', 'node="k"'), "c", "", [f"  {line} policies may allow it now"]),
        (both, "c", "", []),  # another node of the name, perhaps
        (one, "c", denies, []),
        (one, "k", "", []),
    ):
        ended = review_of(text, node, publish("/x") + rights)
        assert [e for e in ended.out.splitlines() if e.startswith("  !")] == lines, ended
        assert "/d publish" not in ended.out


def test_a_name_has_a_line_only_if_it_is_new_in_another_namespace(change: Change) -> None:
    """A node that loses one of two names has no line."""

    def rights(*nodes: tuple[str, ...]) -> dict[str, str | bytes | None]:
        between = '</profile><profile ns="/" node="other">'
        return {"robot.xml": policy_text({"/e": between.join(publish(*node) for node in nodes)})}

    for before, after, lines in (
        ((("one", "/one"), ("one",)), (("/one",), ("one",)), 0),
        ((("one",), ("one",)), (("one",), ("/one",)), 1),
    ):
        change.base = change.commit(rights(*before))
        change.commit(rights(*after))
        ended = change.review("--policy", "robot.xml")
        assert ended.out.count("  ~ /e publish topic /one begins with / now") == lines, ended
        assert "no longer begins" not in ended.out


def test_a_renamed_policy_is_compared_by_its_folder(change: Change) -> None:
    """Where its file is named, what is new in it is lost among all that has a new place."""
    shutil.copytree(change.folder / "common", change.folder / "p/common")
    change.base = change.commit({"p/a.xml": policy_text({"/a": publish("/x")})})
    change.commit({"p/a.xml": None, "p/b.xml": policy_text({"/a": publish("/x", "/y")})})
    ended = change.review("--policy", "p")
    assert ended.status == 1 and "1 right is new" in ended.out, ended


def test_a_renamed_enclave_is_one_line_and_still_new_access(change: Change) -> None:
    reads = publish("/x").replace("publish", "subscribe")
    change.base = change.commit({"robot.xml": policy_text({"/a": publish("/x"), "/b": reads})})
    renamed = "  ~ enclave /b is now /new/b, with the same rights"
    for rights, also in ((publish("/x"), ()), (publish("/x", "/z"), ("/a publish topic /z",))):
        change.commit({"robot.xml": policy_text({"/a": rights, "/new/b": reads})})
        said = change.review("--policy", "robot.xml")
        assert said.status == 1 and f"{12 + len(also)} rights are new; 1 enclave can" in said.out
        lines = [line.partition("  (")[0] for line in said.out.splitlines() if line[:2] == "  "]
        # Whom the enclave is influenced by is only new if other access is.
        reach = ["  + /a can influence /new/b: /a -publish /x-> /new/b"] * len(also)
        assert lines == [
            f"{renamed}; rights under a new name count as new, so that a reviewer has to "
            "allow them",
            *(*(f"  + {right}" for right in also), *reach),
            *(renamed, *(f"  + {right}".replace(" publish", " ALLOW publish") for right in also)),
        ]


def test_an_enclave_is_renamed_only_if_all_of_its_rights_are_the_same() -> None:
    def rights(enclaves: dict[str, str]) -> set[Right]:
        return {
            Right(name, ALLOW, "publish", topic) for name in enclaves for topic in enclaves[name]
        }

    base = rights({"/a": "x", "/b": "yz"})
    for enclaves, renamed in (
        ({"/a": "x", "/c": "yz"}, {"/b": "/c"}),
        ({"/a": "x", "/c": "yzx"}, {}),
        ({"/a": "x", "/c": "y"}, {}),
        ({"/a": "x", "/b": "y", "/c": "yz"}, {}),
        ({"/a": "x", "/c": "yz", "/d": "yz"}, {}),
    ):
        assert renamed_enclaves(base, rights(enclaves)) == renamed, enclaves


def test_an_error_is_said_once(change: Change, tmp_path: Path) -> None:
    change.commit({"robot.xml": "<policy"})
    summary = tmp_path.with_name("summary.md")
    ended = change.review("--policy", "robot.xml", "--summary", str(summary))
    assert ended.status == 2 and ended.out.count("not well-formed") == 1
    assert ended.out.count(": could not be decided, for the reason above\n") == 2
    assert summary.read_text().count("not well-formed") == 2  # in short, and as a finding
    assert "\n### Policy: 1 error" in summary.read_text()
    (link := tmp_path.with_name("link.md")).symlink_to(summary)
    ended = change.review("--policy", "robot.xml", "--summary", str(link))
    assert (ended.status, link.is_symlink()) == (2, True)
    assert "sros writes neither through links nor to devices" in ended.err


def test_a_common_part_that_ships_with_sros_needs_no_review(change: Change) -> None:
    part, name = (change.folder / "common/lifecycle_node.xml").read_text(), "lifecycle_node.xml"
    change.commit({f"new/{name}": part})
    assert change.review("--policy", "robot.xml").status == 0
    include = '<xi:include href="{}" xpointer="xpointer({})"/>'
    user = policy_text({"/u": include.format("around.xml", "/x/y/*")})
    around = f'<x xmlns:xi="http://www.w3.org/2001/XInclude"><y>{include}</y></x>'
    narrow = around.format("node.xml", "/profile/*")
    files: dict[str, str | bytes | None]
    files = {"common/user.xml": user, "common/around.xml": narrow}
    change.base = change.commit(files)
    change.commit({"common/around.xml": around.format(name, "/profile/*"), f"new/{name}": None})
    included = change.review("--policy", "robot.xml")
    assert included.status == 1
    assert "'common/user.xml' is not reviewed, and includes a file that changes" in included.out
    change.base = change.commit({**dict.fromkeys(files), f"new/{name}": part})
    # An unreviewed policy can include the rights of another common part under its name.
    for path, text in ((f"new/{name}", part.replace("ALLOW", "DENY")), ("new/node.xml", part)):
        change.commit({f"new/{name}": None if path != f"new/{name}" else text, path: text})
        edited = change.review("--policy", "robot.xml")
        assert edited.status == 1 and f"'{path}' changes and is not reviewed" in edited.out


def test_what_a_partial_clone_lacks_is_not_passed_over(change: Change) -> None:
    change.commit({"evil.xml": policy_text(WIDER)})
    missing = change.git("rev-parse", "HEAD:evil.xml")
    (change.folder / ".git" / "objects" / missing[:2] / missing[2:]).unlink()
    ended = change.review("--policy", "robot.xml")
    assert ended.status == 2
    assert f"the object {missing} is not in the repository" in ended.out


@pytest.mark.parametrize(
    ("name", "content"),
    some(
        [
            ("evil.XML", policy_text(WIDER).encode()),
            ("robots/deep/evil.txt", policy_text(WIDER).encode()),
            ("evil.xml", b"\xff\xfe" + policy_text(WIDER).encode("utf-16-le")),
            (
                "seven.xml",
                b'<?xml version="1.0" encoding="UTF-7"?>'
                + policy_text(WIDER).replace("<", "+ADw-").replace(">", "+AD4-").encode(),
            ),
            (
                "padded.xml",
                b'<?xml version="1.%s" encoding="UTF-7"?>' % (b"0" * 300)
                + policy_text(WIDER).replace("<", "+ADw-").replace(">", "+AD4-").encode(),
            ),
            ("ebcdic.xml", f'<?xml version="1.0" encoding="IBM037"?>{ROBOT}'.encode("cp037")),
            ("part.xml", b'<profile ns="/" node="n"/>'),
            ("rights.xml", b"<x><topics publish='&#65;LLOW'><topic>/x</topic></topics></x>"),
            ("names.xml", b"<x><topic>/x</topic></x>"),
            (
                "outer.xml",
                b"<profiles><xi:include href='x' xmlns:xi='http://www.w3.org/2001/XInclude'/>"
                b"</profiles>",
            ),
            (
                "common/Node.xml",
                b'<profile>\n<topics publish="ALLOW"><topic>/x</topic></topics></profile>',
            ),
        ],
        1,
    ),
)
def test_a_policy_that_is_not_named_is_said(change: Change, name: str, content: bytes) -> None:
    change.commit({name: content})
    ended = change.review("--policy", "robot.xml")
    assert ended.status == 1
    assert f"'{name}' changes and is not reviewed" in ended.out
    change.base = change.git("rev-parse", "HEAD")
    change.commit({name: None})
    assert f"'{name}' is deleted" in change.review("--policy", "robot.xml").out


def test_what_is_no_part_of_a_policy_and_what_is_too_large(change: Change) -> None:
    world = "<sdf><plugin><topic>/x</topic><update_rate/></plugin></sdf>"
    profiles = '<profiles><topic profile_name="x"/></profiles>'  # of Fast DDS
    change.commit(
        {
            "world.sdf": world,
            "dds.xml": profiles,
            "large.xml": b"<policy version='0'>" + b" " * 2**25,
        }
    )
    said = change.review("--policy", "robot.xml").ok().out
    assert "files: 'large.xml' changes and is too large to be reviewed\n" in said
    with tarfile.open(fileobj=(tar := io.BytesIO()), mode="w") as archive:
        archive.addfile(tarfile.TarInfo("robot.xml"))
    packed = {"p.xml.gz": gzip.compress(policy_text(WIDER).encode()), "p.tar": tar.getvalue()}
    change.commit({"large.xml": None, **packed})
    said = change.review("--policy", "robot.xml").ok().out
    for name in packed:
        assert (
            f"'{name}' changes and is an archive, or compressed: the review does not look into"
            in said
        )


def test_a_keystore_fits_on_a_disk(change: Change) -> None:
    """A few kilobytes stand for gigabytes, and for folders that no program can delete."""
    (change.folder / "blob").write_bytes(bytes(2**25 + 1))  # larger than what is read
    blob = change.git("hash-object", "-w", "blob")
    (change.folder / "blob").unlink()
    nul = change.folder / "nul"
    nul.write_bytes(b"robot.xml\0evil")
    link = change.git("hash-object", "-w", "nul")
    many = _tree(change, *(("100644", f"{number}", blob) for number in range(32)))
    odd = _tree(change, ("120000", "link", link))
    long = _tree(change, ("120000", "link", blob))
    folders = (("40000", "long", long), ("40000", "many", many), ("40000", "odd", odd))
    top = _tree(change, *folders)
    commit = change.git("commit-tree", top, "-m", "x")
    no_path = "the target of the link '{}/link' is not a valid path: it {}"
    for name, said in (
        ("many", "has more than 1073741824"),
        ("odd", no_path.format("odd", "contains a zero byte")),
        ("long", no_path.format("long", "is empty, or longer than 4095 bytes")),
    ):
        with TemporaryDirectory() as folder:
            files = CommitFiles(Repository(change.folder), "HEAD", commit, Path(folder))
            with pytest.raises(DocumentError, match=said):
                files.write_tree(name)
    deep = change.commit({f"{'d/' * 250}file": "x"})
    ended = change.review("--policy", "robot.xml")
    assert (ended.status, "more than 200 levels of folders" in ended.out) == (2, True), deep


@pytest.mark.parametrize(
    ("before", "after", "pointer", "status"),
    some(
        [
            ("<x>{}</x>", "<x>{}{more}</x>", "/x/topics[@subscribe]", 1),
            ("<x>{}</x>", "<x>{}{include}</x>", "/x/topics[@subscribe]", 1),
            ("<x>{}</x>", "<x>{}<!-- -->{}</x>", "/x/*", 0),
            (
                "<profile>{}</profile>",
                "<profile ns='/other' node='n'>{}</profile>",
                "/profile/*",
                1,
            ),
        ],
        1,
    ),
)
def test_a_part_that_is_included_in_part_is_said(
    change: Change, before: str, after: str, pointer: str, status: int
) -> None:
    """Another policy, which is not reviewed, has all of it."""
    read = '<topics subscribe="ALLOW"><topic>/ok</topic></topics>'
    include = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="{}" xpointer="{}"/>'
    part = include.format("part.xml", f"xpointer({pointer})")
    reviewed = policy_text({"/a": publish("/x"), "/b": publish("/y") + part})
    change.base = change.commit({"part.xml": before.replace("{}", read), "robot.xml": reviewed})
    more = {"{}": read, "{more}": publish("/x"), "{include}": include.format("common/node.xml", "")}
    for name, text in more.items():
        after = after.replace(name, text)
    change.commit({"part.xml": after})
    ended = change.review("--policy", "robot.xml")
    assert ended.status == status, ended
    assert ("'part.xml' changes and is used only in part" in ended.out) == bool(status)


def test_a_policy_that_shares_a_part_is_said(change: Change) -> None:
    """The reviewed policy has the right already that another one gets by a file of both."""
    part = '<xi:include href="parts/outer.xml" xpointer="xpointer(/x/*)"/>'
    inner = '<xi:include href="inner.xml" xpointer="xpointer(/x/*)"/>'
    policies = {
        "robot.xml": policy_text({"/a": publish("/x") + part}),
        "other.xml": policy_text({"/b": part}).replace("XInclude", "X&#73;nclude"),
        "tests/other.xml": policy_text({"/b": publish("/z")}),
    }
    outer = f'<x xmlns:xi="http://www.w3.org/2001/XInclude">{inner}</x>'
    change.base = change.commit(
        {**policies, "parts/outer.xml": outer, "parts/inner.xml": f"<x>{publish('/x')}</x>"}
    )
    change.commit({"parts/inner.xml": f"<x>{publish('/x')}{publish('/y')}</x>"})
    ended = change.review("--policy", "robot.xml\nother.xml")
    assert "includes a file that changes" not in ended.out
    change.base = change.commit({"robot.xml": policy_text({"/a": publish("/x", "/y") + part})})
    change.commit({"parts/inner.xml": f"<x>{publish('/x')}</x>"})
    ended = change.review("--policy", "robot.xml")
    assert ended.status == 1, ended
    assert "files: 'other.xml' is not reviewed, and includes a file that changes\n" in ended.out


def test_a_policy_that_is_included_in_part_is_said(change: Change) -> None:
    """What the reviewed policy does not take from it gets no review."""
    part = """<xi:include href="second.xml" xpointer="xpointer(/policy/enclaves/*[@path='/b'])"/>"""
    first = policy_text({"/a": publish("/x")}).replace("</enclaves>", f"{part}</enclaves>")
    files: dict[str, str | bytes | None] = {"robot.xml": first}
    files |= {"second.xml": policy_text({"/b": publish("/y")})}
    change.base = change.commit({"README": "x"})
    change.commit(files)
    whole = change.review("--policy", "robot.xml")
    assert whole.status == 0, whole
    change.commit({"second.xml": policy_text({"/b": publish("/y"), "/evil": publish("/x")})})
    ended = change.review("--policy", "robot.xml")
    assert ended.status == 1, ended
    assert "'second.xml' changes and is used only in part: the rest is not reviewed" in ended.out


@pytest.mark.parametrize(
    ("path", "target", "status"),
    some(
        [
            ("deploy/robot.xml", "../tests/robot.xml", 1),  # a policy that is left out
            ("deploy", "tests", 1),
            ("deploy.xml", "/etc/robot.xml", 1),
            ("deploy.xml", "tests/notes", 1),  # which the next change can make a policy, unseen
            ("tests/link.xml", "robot.xml", 0),  # left out
            ("NOTES", "robot.toml", 0),
            ("robots/sub", "../tests", 2),  # in a folder that is reviewed
            ("robots/sub", "", 2),
            ("vendor", "", 1),
        ],
        1,
    ),
)
def test_links_and_submodules_hide_no_policy(
    change: Change, path: str, target: str, status: int
) -> None:
    """A checkout has policies there that no commit of this repository has at that path."""
    text = policy_text({"/c": publish("/z")})
    shutil.copytree(change.folder / "common", change.folder / "robots" / "common")
    text = policy_text({"/c": publish("/z")})
    left_out = {"tests/robot.xml": policy_text(WIDER), "tests/notes": "x"}
    change.base = change.commit({**left_out, "robots/c.xml": text})
    place = change.folder / path
    place.parent.mkdir(exist_ok=True)
    if target:
        place.symlink_to(target)
    else:
        change.git("update-index", "--add", "--cacheinfo", f"160000,{change.base},{path}")
        place.mkdir()
    change.commit({})
    ended = change.review("--policy", "robot.xml\nrobots", "--leave-out", "tests")
    assert ended.status == status, ended
    assert (path in ended.out) == bool(status)
    if status == 2:
        out = " ".join(change.review("--policy", "robots").out.split())
        assert out.count("could not be decided, for the reason above") == 2, out
        assert "has no policies" not in out and "Name it with --policy" not in out


def _tree(change: Change, *entries: tuple[str, str, str]) -> str:
    """Return the id of a folder that has entries (mode, name, id) besides those of HEAD."""
    here = [each.split() for each in change.git("ls-tree", "HEAD").splitlines()]
    listed = [(mode.lstrip("0"), name, digits) for mode, _, digits, name in here]
    data = b"".join(
        f"{mode} {name}".encode() + b"\0" + bytes.fromhex(digits)
        for mode, name, digits in sorted((*listed, *entries), key=lambda each: each[1])
    )
    words = ("git", "hash-object", "-w", "--literally", "-t", "tree", "--stdin")
    made = subprocess.run(words, cwd=change.folder, input=data, capture_output=True, check=True)
    return made.stdout.decode().strip()


SAFE_ATTRIBUTES = b"""# *.xml ident
* text=auto eol=crlf -ident
.git_archival.txt export-subst
/robot.xml/below ident
sub/robot.xml ident
/sub export-ignore
*.ps1 working-tree-encoding=UTF-16LE
*.bin filter=lfs diff=lfs merge=lfs -text
"""


@pytest.mark.parametrize(
    "line",
    [
        b"*.xml working-tree-encoding=ASCII//TRANSLIT",
        b"\xef\xbb\xbfrobot.xml\tident",
        b"/r*.XML text=\x85 export-subst",
        b"**/robot.xml ident",
        b"rob[o]t.xml ident",
        b"ro\\bot.xml ident",
        b'"robot.xml" ident',
        b"*.xml filter=lfs",
        b"[attr]odd ident\n*.xml odd",
    ],
)
def test_a_checkout_that_is_another_file_is_said(change: Change, line: bytes) -> None:
    """Fullwidth characters in a comment become elements, or a DENY becomes an `$Id$` of git."""
    change.commit({".gitattributes": SAFE_ATTRIBUTES})
    assert change.review("--policy", "robot.xml", "--requirements", "robot.toml").status == 0
    change.commit({".gitattributes": line + b"\n" + SAFE_ATTRIBUTES})
    ended = change.review("--policy", "robot.xml", "--requirements", "robot.toml")
    assert ended.status == 1
    assert "git may change it in a checkout or archive (" in ended.out


@pytest.mark.parametrize(
    "line",
    [
        b"part.xml export-ignore",
        b"/parts/ ident export-ignore",
        b"part* export-ignore",
        b"/parts/ export-ignore\n/parts/ ident",
    ],
)
def test_a_part_that_is_missing_in_archives_is_said(change: Change, line: bytes) -> None:
    """The fallback of its include then takes its place, such as nothing in place of a DENY."""
    part = f"<profile>{publish('/secret').replace('ALLOW', 'DENY')}</profile>".encode()
    include = (
        '<xi:include href="parts/part.xml" xpointer="xpointer(/profile/*)"><xi:fallback/>'
        "</xi:include></profile>"
    )
    policy = (change.folder / "robot.xml").read_text().replace("</profile>", include)
    change.commit({"robot.xml": policy.encode(), "parts/part.xml": part})
    change.commit({".gitattributes": line})
    ended = change.review("--policy", "robot.xml", "--new-access", "allow")
    assert ended.status == 1  # who allows new access has not seen this
    assert "'parts/part.xml' git may leave it out of an archive (export-ignore" in ended.out


def test_no_policy_hides_behind_an_odd_mode(change: Change) -> None:
    """Git checks these entries out as files, folders and links, and servers accept them."""
    evil = change.git("rev-parse", "HEAD:robot.xml")
    link = subprocess.run(
        ["git", "hash-object", "-w", "--stdin"],
        cwd=change.folder,
        input=b"robot.xml",
        capture_output=True,
        check=True,
    )
    named = (
        ("100600", "a.xml", evil),
        ("1100777", "b.xml", evil),
        ("40755", "folder", _tree(change)),
        ("120777", "link.xml", link.stdout.decode().strip()),
    )
    whole = change.git("commit-tree", _tree(change, *named), "-p", "HEAD", "-m", "x")
    change.git("reset", "--quiet", "--hard", whole)
    assert (change.folder / "a.xml").is_file()
    assert (change.folder / "folder" / "robot.xml").is_file()
    assert (change.folder / "link.xml").is_symlink()
    with TemporaryDirectory() as outside:
        summary = Path(outside, "review.md")
        ended = change.review("--policy", "robot.xml", "--summary", str(summary))
        said = summary.read_text()
    assert ended.status == 1, ended
    for path in ("a.xml", "b.xml", "folder/robot.xml", "link.xml"):
        assert f"- `{path}` `changes and is not reviewed" in said
    change.git("reset", "--hard", change.base)
    broken = _tree(change, ("100648", "a.xml", evil))
    with pytest.raises(DocumentError, match="malformed"):
        Repository(change.folder).folders([broken])


def test_a_merge_of_later_commits_is_said(change: Change) -> None:
    """What main lost since the base, a merge can bring back: the base has it, too."""
    main = change.commit({"README": "x"})
    tree = change.git("rev-parse", "HEAD^{tree}")
    merge = change.git("commit-tree", tree, "-p", main, "-p", change.base, "-m", "x")
    change.git("reset", "--hard", merge)
    assert change.review("--policy", "robot.xml").out.count("that the merge restores") == 0
    change.base = change.git("commit-tree", tree, "-m", "earlier")
    assert "access that a merged branch lost" in (change.review("--policy", "robot.xml").out)


def test_a_review_that_is_ended_has_no_result(change: Change, tmp_path: Path) -> None:
    """A comment of an earlier commit would stay otherwise, as green as it was."""
    summary = tmp_path.with_name("ended.md")
    words = ("--base", "refs/heads/main", "--policy", "robot.xml", "--summary", str(summary))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(change.folder)
        patch.setattr("sros_tool.proof.review.review", lambda *_: os.abort)
        with pytest.raises(AttributeError):
            review_verb.main(list(words), standalone_mode=False)
    assert summary.read_text().startswith("## Review: could not be decided")


def test_a_folder_with_endless_policies_is_refused(change: Change) -> None:
    """A few objects can stand for gigabytes, and many small ones are read in a moment."""
    text = policy_text({"/c": "<!-- -->" * 90_000})
    change.commit({f"robots/{number}.xml": text for number in range(100)})
    ended = change.review("--policy", "robots")
    assert ended.status == 2
    assert "has more than 67108864 bytes" in ended.out


def test_only_commits_count(change: Change) -> None:
    change.commit({"robot.xml": policy_text(WIDER)})
    (change.folder / "robot.xml").write_text(policy_text(ROBOT))
    ended = change.review("--policy", "robot.xml")
    assert ended.status == 1
    assert "the checkout differs from the reviewed commit: 'robot.xml'" in (ended.out)
    change.git("update-ref", "refs/heads/other", change.git("rev-parse", "HEAD"))
    change.commit({"README": "x"})
    earlier = change.review("--policy", "robot.xml", "--head", "refs/heads/other")
    assert earlier.status == 1
    assert "the commit that is checked out is not the reviewed commit" in earlier.out


def test_a_fleet_counts_as_each_commit_has_it(change: Change) -> None:
    fleet = 'enclaves = ["/{robot}"]\n[robots.r1]\n'
    policy = policy_text({"/{robot}": publish("/{robot}/x")})
    change.base = change.commit({"fleet.xml": policy, "fleet.toml": fleet})
    change.commit({"group_vars/all.yml": "x: 1"})
    words = ("--policy", "fleet.xml", "--fleet", "fleet.toml")
    passed = change.review(*words).ok().out
    assert "'group_vars/all.yml' changes and is not reviewed" in passed
    change.base = change.git("rev-parse", "HEAD")
    change.commit({"fleet.toml": f"{fleet}[robots.r2]\n", "group_vars/all.yml": None})
    ended = change.review(*words)
    assert ended.status == 1, ended
    assert "'group_vars/all.yml' changes and is not reviewed" in ended.out
    assert "new-access fleet.xml: " in ended.out
    change.base = change.commit({"fleet.toml": f'{fleet}address = "10.0.0.1"\n'})
    change.commit({"fleet.toml": f'{fleet}address = "10.6.6.6"\n'})
    ended = change.review(*words)
    assert ended.status == 1, ended
    assert "new-access fleet.toml: 'r1' gets its keys at another address: 10.6.6.6" in ended.out


_MUX, _BASE = publish("cmd"), '<topics subscribe="ALLOW"><topic>cmd</topic></topics>'
_PLACED = {"/{robot}/mux": _MUX, "/{robot}/base": _BASE}
_MOVED = """[[only]]
publish = ["{namespace}/cmd"]
enclaves = ["/{robot}/mux"]
[[must]]
enclave = "/{robot}/base"
subscribe = ["{namespace}/cmd"]
[[nothing_but]]
enclaves = ["/{robot}/base"]
subscribe = ["{namespace}/cmd"]
"""


@pytest.mark.parametrize(
    ("policy", "required", "said"),
    some(
        [
            (_PLACED, _MOVED, ""),
            ({**_PLACED, "/spy": publish("/n1/cmd")}, _MOVED, "but /spy may still publish /n1/cmd"),
            ({**_PLACED, "/spy": publish("/n1/*")}, _MOVED, "only /r1/mux may publish /n1/cmd"),
            (
                _PLACED,
                _MOVED[_MOVED.index("[[must]]") :],
                "only /r1/mux may publish /n2/cmd: the new",
            ),
            (
                {**_PLACED, "/{robot}/x": _BASE},
                _MOVED,
                "node /n2/base moves to enclave /r1/x, where",
            ),
        ],
        3,
    ),
)
def test_requirements_follow_a_robot_to_its_new_namespace(
    change: Change, policy: dict[str, str], required: str, said: str
) -> None:
    fleet = "[robots.r1]\nnamespace = '/n1'\n"

    def text(rights: dict[str, str]) -> str:
        """Return a policy in the robot's namespace; /x, if it is there, has the node of /base."""
        whole = policy_text(rights).replace('ns="/"', 'ns="{namespace}"')
        whole = whole.replace('ns="{namespace}" node="spy"', 'ns="/" node="spy"')
        moved = whole.replace('node="base"', 'node="lift"').replace('node="x"', 'node="base"')
        return moved if "/{robot}/x" in rights else whole

    change.base = change.commit(
        {"robots.xml": text(_PLACED), "robots.toml": _MOVED, "fleet.toml": fleet}
    )
    moved = fleet.replace("n1", "n2")
    change.commit({"robots.xml": text(policy), "robots.toml": required, "fleet.toml": moved})
    words = ("--policy", "robots.xml", "--fleet", "fleet.toml", "--requirements", "robots.toml")
    ended = change.review(*words, "--new-access", "allow")
    assert ("requirements-before" in ended.out) == bool(said), ended
    assert said in ended.out, ended


@pytest.mark.parametrize(
    ("before", "after", "ns", "said"),
    some(
        [
            ("{namespace}/mux", "{namespace}/mux", "{namespace}", ""),
            ("{namespace}/mux", "/free/{robot}", "{namespace}", "node /n2/mux moves to enclave"),
            ("/{robot}/mux", "/free/{robot}", "{namespace}", "node /n2/mux moves to enclave"),
            ("/{robot}/mux", "/free/{robot}", "/n1", "node /n1/mux moves to enclave /free/r1,"),
        ],
        2,
    ),
)
def test_no_node_escapes_while_its_robot_gets_another_namespace(
    change: Change, before: str, after: str, ns: str, said: str
) -> None:
    required = "[[only]]\npublish = ['{namespace}/x']\nenclaves = ['{namespace}/mux']\n"
    required += "[[widest]]\npublish = []\nenclaves = ['{namespace}/*', '/{robot}/*']\n"

    def files(enclave: str, namespace: str) -> dict[str, str | bytes | None]:
        policy = policy_text({enclave: publish("/y"), "/{robot}/rest": publish("/z")})
        node = 'node="mux"' if enclave.endswith("mux") else 'node="{robot}"'
        policy = policy.replace(f'ns="/" {node}', f'ns="{ns}" node="mux"')
        fleet = f"[robots.r1]\nnamespace = '{namespace}'\n"
        return {"robots.xml": policy, "robots.toml": required, "fleet.toml": fleet}

    change.base = change.commit(files(before, "/n1"))
    change.commit(files(after, "/n2"))
    words = ("--policy", "robots.xml", "--fleet", "fleet.toml", "--requirements", "robots.toml")
    ended = change.review(*words, "--new-access", "allow")
    assert ("requirements-before" in ended.out) == bool(said), ended
    assert said in ended.out, ended


_TWO = """[robots.r1]
address = "10.0.0.1"
namespace = "/n1"
[robots.r2]
address = "10.0.0.2"
namespace = "/n2"
"""
_HOSTS = """{"_meta": {"hostvars": {"r1": {"ansible_host": "10.0.0.1"}}},
 "all": {"children": ["far"], "vars": {"color": "red"}}, "far": {"hosts": ["r1"]}}
"""
_TWO_PORTS = """{"all": {"hosts": {
 "h1": {"sros_robot": "r1", "ansible_host": "10.0.0.1", "ansible_port": 22},
 "h2": {"sros_robot": "r2", "ansible_host": "10.0.0.1", "ansible_port": 2222}}}}
"""
_TWO_BEHIND_ONE = """{"all": {"hosts": {"h1": {"sros_robot": "r1", "ansible_host": "gate"}, \
"h2": {"sros_robot": "r2", "ansible_host": "gate"}}}}
"""  # with their ports in other files


@pytest.mark.parametrize(
    ("path", "before", "after", "said"),
    some(
        [
            (
                "fleet.toml",
                _TWO,
                _TWO.replace("/n1", "/n").replace("/n2", "/n1").replace('"/n"', '"/n2"'),
                "'r1' gets the keys of /n2/a, which r2 had before, and 1 more",
            ),
            (
                "fleet.toml",
                _TWO,
                f'{_TWO}[robots.hq]\naddress = "10.6.6.6"\nnamespace = "/hq"\n',
                "'hq' gets the keys of /hq/a, which no robot had before",
            ),
            (
                "fleet.toml",
                _TWO.replace("0.2", "0.1"),
                _TWO.replace("0.2", "0.1")
                .replace("/n2", "/n")
                .replace("/n1", "/n2")
                .replace('"/n"', '"/n1"'),
                "'r1' gets the keys of /n2/a, which r2 had before, and 1 more",
            ),
            ("fleet.toml", _TWO, _TWO.replace("r2", "r3"), ""),
            (
                "hosts.json",
                _TWO_BEHIND_ONE,
                re.sub('"h1": {.*}, "h2": {', '"h2": {"sros_namespace": "/r1", ', _TWO_BEHIND_ONE),
                "'r2' gets the keys of /r1/a, which r1 had before",
            ),
            ("hosts.json", _HOSTS, _HOSTS.replace("red", "blue"), ""),
            (
                "hosts.json",
                _HOSTS,
                _HOSTS.replace('"red"', '"red", "ansible_ssh_common_args": "-o ProxyCommand=evil"'),
                "'all.vars.ansible_ssh_common_args' is -o ProxyCommand=evil: this can change",
            ),
            (
                "hosts.json",
                _HOSTS,
                _HOSTS.replace('10.0.0.1"', '10.0.0.1", "sros_patterns": ["/*"]'),
                "'_meta.hostvars.r1.sros_patterns' is ['/*']: this can change which",
            ),
            (
                "hosts.json",
                _TWO_PORTS,
                _TWO_PORTS.replace("r1", "r").replace("r2", "r1").replace('"r"', '"r2"'),
                "'all.hosts.h1.sros_robot' is r2: this can change which",
            ),
            (
                "hosts.json",
                '{"all": {"hosts": {"h1": {"sros_robot": "r1"}, "h2": {"sros_robot": "r2"}}}}',
                '{"all": {"hosts": {"h1": {"sros_robot": "r1"}}}}',
                "",
            ),
            (
                "fleet.toml",
                _TWO,
                f'enclaves = ["/desk/{{robot}}"]\n{_TWO}',
                "'enclaves' has the new path /desk/{robot}, and robots get the keys of enclaves "
                "with such a path, and 1 more",
            ),
            (
                "fleet.toml",
                f'{_TWO}router = "h:7447"\n',
                f'routers = "/{{robot}}/a"\n{_TWO}router = "h:7447"\n',
                "'routers' makes other enclaves the routers of robots: /{robot}/a",
            ),
        ],
        3,
    ),
)
def test_keys_go_to_no_other_robot_unseen(
    change: Change, path: str, before: str, after: str, said: str
) -> None:
    """The access of every enclave stays what it is."""
    rights = publish("/x")
    alone = {"/hq/a": rights} if "/hq" in after else {}
    policy = {"{namespace}/a": rights} | ({"/desk/r1": rights} if "/desk" in after else {})
    change.base = change.commit({path: before, "robots.xml": policy_text({**policy, **alone})})
    change.commit({path: after, "robots.xml": policy_text(policy)})
    ended = change.review("--policy", "robots.xml", "--fleet", path)
    assert (f"new-access {path}: {said}" in ended.out) == bool(said), ended
    assert ended.status == bool(said), ended


class _Key(NamedTuple):
    """A key of the fleet file: two values of a robot with its name, and what changing each says.

    ``gained`` is said if the second value replaces the first, ``lost`` the other way round.
    """

    first: Any
    second: Any
    gained: str
    lost: str


_GRACE = "request renewal for a {} time after the expiry of a certificate (renewal_grace: "
_FLEET_KEYS = {
    "namespace": _Key(
        "/n1",
        "/n2",
        "+ /namespace/a publish topic /n2/x",
        "+ /namespace/a publish topic /n1/x",
    ),
    "domain": _Key(5, 6, "/domain/x  (robots.xml:3); in domain 6", "(robots.xml:3); in domain 5"),
    "address": _Key("h1", "h2", "gets its keys at another address: h2", "another address: h1"),
    "user": _Key("u1", "u2", "another address: u2@user", "another address: u1@user"),
    "groups": _Key((), ("g",), "+ /groups/lift publish topic /lift", ""),
    "router": _Key(
        "h:1",
        "h:2",
        "'router' has its router at another address: h:2 (/router/router)",
        "'router' has its router at another address: h:1 (/router/router)",
    ),
    "crossing": _Key(("/f",), ("/f", "/g"), "/g may pass between this router and others", ""),
    "distribution": _Key("jazzy", "humble", "", ""),
    "renewal": _Key(
        "",
        "allowed",
        "'renewal' may now request renewal (renewal: refused -> allowed)",
        "'renewal' may no longer request renewal (renewal: allowed -> refused)",
    ),
    "renewal_grace": _Key(
        "2w",
        "3650d",
        f"'renewal_grace' can {_GRACE.format('longer')}2w -> 3650d)",
        f"'renewal_grace' can {_GRACE.format('shorter')}3650d -> 2w)",
    ),
}
"""Every setting of a robot; "" means that the change says nothing, as it is no access."""


@pytest.mark.parametrize(("path", "back"), [("fleet.toml", False), ("fleet.toml", True),
                                            ("hosts.json", False)])  # fmt: skip
def test_what_counts_is_decided_for_every_key_of_a_robot(
    change: Change, path: str, back: bool
) -> None:
    """A new key has to be decided, too; `test_keys_go_to_no_other_robot_unseen` has other keys."""
    assert _FLEET_KEYS.keys() == set(Robot._fields) - {"name"}
    keys = {field.name for field in fields(Fleet) if field.compare}
    assert keys == {"robots", "groups", "enclaves", "routers"}
    policy = policy_text({"/{robot}/a": publish("x"), "/{robot:g}/lift": publish("/lift")})
    policy = policy.replace('ns="/" node="a"', 'ns="{namespace}" node="a"')

    def text(value: Callable[[_Key], Any]) -> str:
        robots = []
        for key, row in _FLEET_KEYS.items():
            usual = Robot(key, f"/{key}", address=key)
            if key == "crossing":
                usual = usual._replace(router="h:7447")
            robots.append(usual._replace(**{key: value(row)}))
        fleet = Fleet.of(robots, ["g"])
        return render_fleet(fleet) if path.endswith("toml") else json.dumps(inventory(fleet))

    sides = [text(lambda row: row.first), text(lambda row: row.second)]
    before, after = sides[::-1] if back else sides
    change.base = change.commit({"robots.xml": policy, path: before})
    change.commit({path: after})
    ended = change.review("--policy", "robots.xml", "--fleet", path, "--json")
    steps = [step for step in json.loads(ended.out)["steps"] if step["step"] == "new-access"]
    for key, row in _FLEET_KEYS.items():
        said = row.lost if back else row.gained
        lines = [text for step in steps for text in step["lines"]]
        about = [text for text in lines if f"/{key}/" in text or text.startswith(f"'{key}'")]
        assert any(said in text for text in about) if said else not about, (key, about)


@pytest.mark.parametrize("case", some(["rights", "ca", "governance", "default"], 1))
def test_the_access_of_a_keystore_is_compared(
    change: Change, made_keystores: Path, case: str
) -> None:
    public = change.folder / "ks"
    copy_of(made_keystores / "before", public)
    robots = 'enclaves = ["/{robot}"]\n[robots.r1]\n'
    change.base = change.commit({"ks/fleet.toml": robots})
    words = ("--policy", "robot.xml", "--keystore", "ks", "--requirements", "robot.toml")
    change.commit({"README": "x"})
    same = change.review(*words)
    assert "requirements ks: nothing found" in same.out
    assert "new-access ks: nobody gets more access" in same.out, same
    shutil.rmtree(public)
    copy_of(made_keystores / case, public)
    change.commit({"ks/fleet.toml": f'{robots}renewal = "allowed"\n'})
    ended = change.review(*words)
    assert ended.status > 0
    assert "[FAILED] new-access ks/fleet.toml: 'r1' may now request renewal" in ended.out
    (line,) = (each for each in ended.out.splitlines() if "] new-access ks:" in each)
    assert "nobody gets more" not in line
    assert ("requirements ks: 1 error" in ended.out) == (case == "rights")
    assert ("error: " in ended.out and "  + /" in ended.out) or case != "rights", ended


def test_a_keystore_fails_for_a_finding_an_expiry_and_a_link_out_of_it(
    change: Change, made_keystores: Path
) -> None:
    copy_of(made_keystores / "before", change.folder / "ks")
    change.base = change.commit({})
    change.commit({"README": "x"})
    words = ("--keystore", "ks", "--renew-within")
    sound = change.review(*words, "1d").ok()
    assert "expiry ks: 0 of 2 enclaves need to be renewed" in sound.out
    late = change.review(*words, "3000d", "--json")
    assert (late.status, "2 of 2 enclaves need to be" in late.out) == (1, True), late
    assert [each["id"] for each in json.loads(late.out)["findings"]] == ["review.expiry"] * 2
    certificate = change.folder / "ks/enclaves/a/cert.pem"
    settings = (change.folder / "ks/sros.toml").read_text()
    elsewhere = settings.replace("[authorities]", '[authorities]\nidentity_key = "file:/dev/null"')
    change.commit({"ks/sros.toml": elsewhere})
    (only,) = json.loads(change.review(*words, "1d", "--json").out)["findings"]
    assert only["id"] == "keystore.settings-edited", only
    change.commit({"ks/enclaves/a/cert.pem": "damaged", "ks/sros.toml": settings})
    damaged = json.loads(change.review(*words, "1d", "--json").out)
    steps = {each["step"]: (each["status"], each["result"]) for each in damaged["steps"]}
    assert (damaged["status"], steps["keystore"][0]) == (2, 1), damaged
    assert steps["keystore"][1].startswith("1 error"), damaged
    assert steps["expiry"] == (2, "0 of 1 enclave need to be renewed, 1 cannot be read"), damaged
    certificate.unlink()
    certificate.symlink_to("../../../robot.xml")
    change.commit({})
    linked = change.review(*words, "1d")
    assert (linked.status, "cert.pem' is a link out of 'ks'" in linked.out) == (2, True), linked


def test_no_setting_accepts_a_weakness_that_comes_with_it(change: Change) -> None:
    """The template for ros2/sros2 has one CA for both jobs, which its settings accept."""
    sros("generate_artifacts", "-k", "ks", "-e", "/a", cwd=change.folder).ok()
    for key in (change.folder / "ks").rglob("*key.pem"):
        key.unlink()
    settings = (change.folder / "ks/sros.toml").read_text()
    change.base = change.commit({})
    change.commit({"ks/sros.toml": f"# changed\n{settings}"})
    assert "keystore ks: 2 warnings" in change.review("--keystore", "ks").out, "not 1"


def test_a_change_renames_nothing_out_of_a_requirement(change: Change) -> None:
    """A wildcard matches the old name still, so that the requirement is about something."""
    enclaves = {"/a": publish("/x"), "/b": publish("/*")}
    required = '[[only]]\npublish = ["/x"]\nenclaves = ["/a", "/b"]\n'
    change.base = change.commit({"robot.xml": policy_text(enclaves), "robot.toml": required})
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    renamed = {"/a": publish("/drive"), "/b": publish("/*"), "/c": publish("/drive")}
    change.commit({"robot.xml": policy_text(renamed)})
    ended = change.review(*words)
    assert (
        "no right is stated for topic /x any more; required: only /a, /b may publish /x"
        in ended.out
    ), ended
    assert ended.status == 1
    change.base = change.commit({"README": "x"})
    change.commit({"README": "y"})
    assert "any more" not in change.review(*words).out


_SERVED = may("reply", "/driver/open")
_EVERYTHING = {"/recorder": may("subscribe", "/*")}


@pytest.mark.parametrize(
    ("required", "before", "after", "lost"),
    [
        # The server, or the receiver, has another name, which a new enclave uses.
        ("request", _SERVED, may("reply", "/driver/open_gate"), "reply service /driver/open"),
        ("request", _SERVED, may("reply", "/clear"), "reply service /driver/open"),
        ("request", may("reply", "/driver/*"), may("reply", "/x"), "reply service /driver/open"),
        ("call", may("execute", "/driver/open"), may("execute", "/lift"), "execute action /d"),
        ("publish", may("subscribe", "/driver/open"), may("subscribe", "/d"), "subscribe topic /d"),
        ("subscribe", may("publish", "/driver/open"), may("publish", "/d"), "publish topic /d"),
        ("request", _SERVED, _SERVED + _SERVED.replace("ALLOW", "DENY"), "reply service /driver"),
        # The name keeps its server, perhaps by a new wildcard.
        ("request", _SERVED, may("reply", "/driver/*"), ""),
        ("request", _SERVED, may("reply", "/driver/open", "/clear"), ""),
        ("request", may("reply", "/other"), may("reply", "/clear"), ""),
    ],
)
def test_a_requirement_about_a_name_that_loses_its_other_side(
    change: Change, required: str, before: str, after: str, lost: str
) -> None:
    """Twin: neither the server's enclave nor a recorder that matches every name matters."""
    panel = _EVERYTHING | {"/panel": may(required, "/driver/open")}
    toml = f'[[only]]\n{required} = ["/driver/open"]\nenclaves = ["/panel", "/recorder"]\n'
    robot = policy_text(panel | {"/driver": before})
    change.base = change.commit({"robot.xml": robot, "robot.toml": toml})
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    change.commit({"robot.xml": policy_text(panel | {"/driver": after})})
    ended = change.review(*words)
    assert (f"HEAD removes the last stated right to {lost}" in ended.out) == bool(lost), ended
    assert "requirements-before" in ended.out or not lost, ended
    change.commit({"robot.xml": policy_text(panel | {"/moved/driver": before})})
    assert "HEAD removes" not in change.review(*words).out


@pytest.mark.parametrize(
    ("required", "right", "later", "fails"),
    [
        ('[[only]]\nrequest = ["/old"{}]\nenclaves = ["/a"]\n', "request", "/new", True),
        ('[[only]]\npublish = ["old"{}]\nenclaves = ["//a*"]\n', "publish", "/new", True),
        ('[[at_most]]\ncall = ["/old"{}]\nenclaves = 1\n', "call", "/new", True),
        ('[[not_both]]\nfirst.call = ["/old"{}]\nsecond.call = ["/q"]\n', "call", "/new*", True),
        # HEAD gives no new name, or only one that every node has.
        ('[[at_most]]\npublish = ["/old"{}]\nenclaves = 1\n', "publish", "/rosout", False),
    ],
)
def test_a_limit_whose_users_get_a_new_name(
    change: Change, required: str, right: str, later: str, fails: bool
) -> None:
    """The earlier name keeps its other side. Twin: the limit is also about the new name."""
    peer = PEER_RIGHT[right]
    others = {"/b": may(peer, "/old", "/new"), "/c": may(right, "/q"), "/d": may(peer, "/q")}
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    before = policy_text({"/a": may(right, "/old"), **others})
    change.base = change.commit({"robot.xml": before, "robot.toml": required.format("")})
    change.commit({"robot.xml": policy_text({"/a": may(right, later), **others})})
    ended = change.review(*asked)
    lost = f"to {right} {KIND_OF[right][:-1]} /old (perhaps now {later}), and the requirement does"
    assert (ended.status, lost in ended.out) == (fails, fails), ended
    change.commit({"robot.toml": required.format(f', "{later}"')})
    assert "HEAD removes" not in change.review(*asked).out


def test_names_that_are_too_many_to_compare_leave_the_other_steps(
    change: Change, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after = (policy_text({"/a": publish("/x"), "/b": subscribe(n)}) for n in ("/x", "/y"))
    change.base = change.commit({"robot.xml": before, "robot.toml": ONLY})
    change.commit({"robot.xml": after})
    with monkeypatch.context() as patched:
        error = DocumentError("there are too many similar names")
        patched.setattr(escapes, "rights_without_counterpart", Mock(side_effect=error))
        ended = change.review("--policy", "robot.xml", "--requirements", "robot.toml")
    assert ended.status == 2 and "requirements-before robot.xml: there are too" in ended.out, ended
    assert "+ /b subscribe topic /y" in ended.out, ended


def test_a_name_that_nobody_may_use_may_lose_its_denial_and_its_right(change: Change) -> None:
    required = '[[nobody]]\npublish = ["/q"]\n'
    denied = policy_text({"/a": publish("/x") + DENIES})
    change.base = change.commit({"robot.xml": denied, "robot.toml": required})
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    change.commit({"README": "x"})
    said = "no right is stated for topic /q; required: nobody may publish /q [requirement.unn"
    note = f"  robot.toml:1: note: {said}"
    assert note in change.review(*words).ok().out
    change.base = change.commit({"robot.xml": policy_text({"/a": publish("/x", "/q")})})
    change.commit({"robot.xml": policy_text({"/a": publish("/x")})})
    change.review(*words).ok()


@pytest.mark.parametrize("name", ["/q", "q"])
@pytest.mark.parametrize(
    ("before", "after", "others", "fails"),
    [
        ("only", '[[nobody]]\npublish = ["{}"]\n', (), False),
        ("nobody", '[[nobody]]\npublish = ["{}"]\n', (), True),
        ("only", '[[nobody]]\npublish = ["{}"]\n', ("/r",), True),
        ("only", '[[nobody]]\npublish = ["{0}"]\nsubscribe = ["{0}"]\n', ("/r",), True),
        ("only", '[[only]]\npublish = ["{}*"]\nenclaves = ["/a"]\n', ("/r", "/qx"), True),
    ],
)
def test_a_change_may_forbid_the_name_that_it_removes(
    change: Change, name: str, before: str, after: str, others: tuple[str, ...], fails: bool
) -> None:
    """Twins: the subscriber gets, or perhaps got, another name, which no requirement restricts.

    A review of the requirements without the name proposes [[nobody]] only where it is enough.
    """
    is_forbidden = before == "nobody"
    required = f'[[{before}]]\npublish = ["{name}"]\n' + 'enclaves = ["/a"]\n' * (not is_forbidden)
    publisher = publish("/x") if is_forbidden else publish("/x", "/q")
    change.base = change.commit(
        {
            "robot.xml": policy_text({"/a": publisher, "/b": subscribe("/x", name)}),
            "robot.toml": required,
        }
    )
    robot = policy_text({"/a": publish("/x", *others), "/b": subscribe("/x", *others)})
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    if before == "only" and "nobody" in after and name == "/q":
        change.commit({"robot.xml": robot, "robot.toml": ONLY})
        ended = change.review(*words)
        assert "; a reviewer can approve this: --dropped-requirements allow\n" in ended.out, ended
        assert ("write so in [[nobody]]" in ended.out) == (not fails), ended
        allowed = change.review(*words, "--dropped-requirements", "allow").ok()
        assert "a reviewer can approve" not in allowed.out, allowed
    change.commit({"robot.xml": robot, "robot.toml": f"# shorter\n{after.format(name)}"})
    ended = change.review(*words)
    assert ("for topic /q any more; required: nobody" in ended.out) == is_forbidden, ended
    lost = "HEAD removes the last stated right to subscribe topic /q,"
    assert (lost in ended.out) == bool(others), ended
    assert ended.status == fails, ended


_NOTHING_BUT = (
    '[[nothing_but]]\nenclaves = ["/third/*"]\npublish = ["/scan", "/image"]\n'
    'subscribe = ["/clock"]\nreply = ["*"]\n'
)
_ONLY_OPERATORS = '[[only]]\npublish = ["/cmd"]\nenclaves = ["/drive", "*/operator/*"]\n'
_ONLY_HAND = '[[only]]\npublish = ["cmd"]\nenclaves = ["/drive", "//operator/hand"]\n'
_ADDED = "# added\n"
_REPLACED = "# replaced by\n"
_NODES = {
    "/eyes/eye": publish("/image"),
    "/drive": publish("/cmd"),
    "/eyes/ear": publish("/x") + subscribe("/cmd", "/x"),
}
_HANDS = _NODES | {"/operator/hand": publish("/x")}
_NO_CMD = '<topics publish="DENY"><topic>/cmd</topic></topics>'
_EYE = f'</profile><profile ns="/" node="eye">{NODE}{publish("/image")}'


def _moved(node: str, path: str, enclaves: dict[str, str] = _NODES) -> dict[str, str]:
    """Return enclaves with another path for the enclave of a node."""
    return {path if old.endswith(f"/{node}") else old: rights for old, rights in enclaves.items()}


@pytest.mark.parametrize(
    ("before", "required", "after", "said"),
    some(
        [
            (
                {"/third/lidar": publish("/scan"), "/third/cam": publish("/image")},
                _NOTHING_BUT,
                {"/lidar": publish("/scan", "/cmd_vel"), "/third/cam": publish("/image")},
                "node /lidar moves to enclave /lidar",
            ),
            (
                _NODES,
                _ONLY_OPERATORS,
                _moved("eye", "/operator/eye") | {"/operator/eye": publish("/image", "/cmd")},
                "node /eye moves to enclave /operator/eye",
            ),
            (
                _NODES,
                _ONLY_OPERATORS,
                _moved("eye", "/left/operator/eye"),  # with the same rights
                "node /eye moves to enclave /left/operator/eye",
            ),
            (
                _NODES,
                _ONLY_OPERATORS,
                {"/drive": publish("/cmd") + _EYE, "/eyes/ear": _NODES["/eyes/ear"]},
                "node /eye moves to enclave /drive",
            ),
            (
                _NODES,
                '[[only]]\npublish = ["/cmd"]\nenclaves = ["*", "!/eyes/*"]\n',
                _moved("eye", "/lens/eye"),
                "node /eye moves to enclave /lens/eye",
            ),
            (
                _NODES,
                '[[apart]]\nfrom = ["/eyes/*"]\nto = ["/drive"]\nthrough = ["/mux/*"]\n',
                _moved("eye", "/mux/eye"),
                "node /eye moves to enclave /mux/eye",
            ),
            (
                _NODES,
                '[[only]]\npublish = ["cmd"]\nenclaves = ["/drive", "//arm/operator/*"]\n',
                _moved("eye", "/operator/eye"),
                "node /eye moves to enclave /operator/eye, where the requirement does not apply "
                "for users in namespace /arm",
            ),
            # Each node moves out in another namespace.
            (
                _NODES,
                '[[only]]\npublish = ["cmd"]\n'
                'enclaves = ["/drive", "*/arm/operator/*", "*/leg/helper/*"]\n',
                _moved("eye", "/operator/eye", _moved("ear", "/helper/ear")),
                "node /ear moves to enclave /helper/ear, where the requirement does not apply "
                "for users in namespace /leg",
            ),
            # A new enclave, a new right or a lost DENY uses an exception for any package.
            (
                _NODES,
                _ONLY_OPERATORS,
                _NODES | {"/x/operator/hand": publish("/cmd")},
                "/x/operator/hand may publish /cmd: new access, which the requirement allows only "
                "by */operator/*",
            ),
            (
                _HANDS,
                _ONLY_OPERATORS,
                _HANDS | {"/operator/hand": publish("/x", "/cmd")},
                "/operator/hand may publish /cmd: new access",
            ),
            (
                _HANDS | {"/operator/hand": publish("/cmd") + _NO_CMD},
                _ONLY_OPERATORS,
                _HANDS | {"/operator/hand": publish("/cmd")},
                "/operator/hand may publish /cmd: new access",
            ),
            (  # It had access to a shorter name already.
                _HANDS | {"/operator/hand": publish("/cmd")},
                _ONLY_OPERATORS.replace('"/cmd"', '"/cmd", "/cmd_all"'),
                _HANDS | {"/operator/hand": publish("/cmd", "/cmd_all")},
                "/operator/hand may publish /cmd_all: new access",
            ),
            (  # The change itself names the enclave in the requirement.
                _NODES,
                _ONLY_OPERATORS
                + _REPLACED
                + _ONLY_OPERATORS.replace("*/operator/*", "/x/operator/hand"),
                _NODES | {"/x/operator/hand": publish("/cmd")},
                "/x/operator/hand may publish /cmd: new access",
            ),
            (  # For users without a namespace, it is an operator of the robot.
                _NODES,
                _ONLY_OPERATORS.replace("*/", "//").replace('"/cmd', '"cmd'),
                _NODES | {"/operator/hand": publish("/cmd")},
                "/operator/hand may publish /cmd: new access",
            ),
            (
                _HANDS,
                _ONLY_OPERATORS.replace("*/", "//").replace('"/cmd', '"cmd'),
                _HANDS | {"/operator/hand": publish("/x", "/cmd")},
                "/operator/hand may publish /cmd: new access, which the requirement allows only by "
                "//operator/*, which enclaves",
            ),
            (
                _NODES,
                _ONLY_HAND,
                _NODES | {"/operator/hand": publish("/cmd")},
                "/operator/hand may publish /cmd: this enclave is new, and the requirement allows "
                "//operator/hand whatever package",
            ),
            # An earlier change named this enclave, which the package has.
            (_HANDS, _ONLY_HAND, _HANDS | {"/operator/hand": publish("/x", "/cmd")}, ""),
            # The exception is for the robot's own operators, or the enclave gains other access.
            (
                _NODES,
                _ONLY_OPERATORS.replace("*/", "//"),
                _NODES | {"/operator/hand": publish("/cmd")},
                "",
            ),
            (
                _HANDS | {"/operator/hand": publish("/cmd")},
                _ONLY_OPERATORS,
                _HANDS | {"/operator/hand": publish("/cmd", "/y")},
                "",
            ),
            # A new wildcard gives the access that the enclave has; twins: it gives more.
            (
                _HANDS | {"/operator/hand": publish("/cmd")},
                _ONLY_OPERATORS,
                _HANDS | {"/operator/hand": publish("/cmd", "/cm?")},
                "",
            ),
            (
                _HANDS | {"/operator/hand": publish("/c*")},
                _ONLY_OPERATORS,
                _HANDS | {"/operator/hand": publish("/[cx]*")},
                "",
            ),
            (
                _HANDS | {"/operator/hand": publish("/c*") + _NO_CMD},
                _ONLY_OPERATORS,
                _HANDS | {"/operator/hand": publish("/cm*")},
                "/operator/hand may publish /cmd by /cm*: new access",
            ),
            (
                _HANDS | {"/operator/hand": publish("/cmd")},
                _ONLY_OPERATORS.replace('"/cmd"', '"/cmd", "/cmd_all"'),
                _HANDS | {"/operator/hand": publish("/cmd*")},
                "/operator/hand may publish /cmd_all by /cmd*: new access",
            ),
            (
                _HANDS | {"/operator/hand": publish("/cmd")},
                _ONLY_OPERATORS.replace('"/cmd"', '"/cm*"'),
                _HANDS | {"/operator/hand": publish("/cmd", "/cm*")},
                "/operator/hand may publish more names that match /cm*: new access",
            ),
            # Both enclaves are bound, or both are exempt.
            (_NODES, _ONLY_OPERATORS, _moved("eye", "/lens/eye"), ""),
            (_NODES, _ONLY_OPERATORS.replace("*/", "//"), _moved("drive", "/operator/drive"), ""),
            # The enclave keeps the right that it must have.
            (
                _NODES | {"/drive": publish("/cmd") + _EYE.replace("eye", "mux")},
                '[[must]]\nenclave = "/drive"\npublish = ["/cmd"]\n',
                _NODES | {"/operator/mux": publish("/image")},
                "",
            ),
            # Only the change brings this requirement.
            (
                _NODES,
                f"{ONLY.replace('/a', '/eyes/ear')}{_ADDED}{_ONLY_OPERATORS}",
                _moved("eye", "/operator/eye"),
                "",
            ),
        ],
        3,
    ),
)
def test_a_change_escapes_no_requirement(
    change: Change, before: dict[str, str], required: str, after: dict[str, str], said: str
) -> None:
    earlier, _, later = required.partition(_REPLACED)
    earlier, required = earlier.partition(_ADDED)[0], later or required
    change.base = change.commit({"robot.xml": policy_text(before), "robot.toml": earlier})
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    change.commit({"robot.xml": policy_text(after), "robot.toml": required})
    ended = change.review(*words)
    assert said in ended.out, ended
    found = ("where the requirement does not apply", "the requirement allows ")
    assert any(text in ended.out for text in found) == bool(said), ended
    failed = "[FAILED] requirements-before"
    assert (failed in ended.out) == bool(said) <= ended.status, ended
    assert failed not in change.review(*words, "--dropped-requirements", "allow").out


def test_requirements_get_the_protection_of_a_template(change: Change) -> None:
    protected = '[[protected]]\ntopics = ["/x"]\nlevel = "encrypt"\n'
    template = (templates_dir() / "production.toml").read_text()
    change.base = change.commit({"robot.toml": protected, "t.toml": template})
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--template")
    change.commit({"README": "x"})
    for choice in ("production", "t.toml"):
        ended = change.review(*words, choice).ok()
        assert "requirements robot.xml: nothing found\n" in ended.out, ended  # nothing is assumed
        assert "by the changes" not in ended.out
    weaker = template.replace('"ENCRYPT"', '"SIGN"')
    assert weaker != template
    change.commit({"t.toml": weaker})
    ended = change.review(*words, "t.toml")
    assert ended.status == 1
    assert "/x: its messages are not encrypted, but topic /x has to be encrypted" in ended.out
    assert (
        "not covered: 't.toml' changes, and the access that it gives is not compared"
        in " ".join(ended.out.split())
    )
    (change.folder / "link").symlink_to(".")
    change.base = change.commit({})
    (change.folder / "link").unlink()
    change.commit({"link/t.toml": weaker})
    assert "'link/t.toml' changes, and the access" in change.review(*words, "link/t.toml").out
    assert change.review(*words, "none.toml").status == 2


def test_whether_a_keystore_is_signed_for_the_policies(
    change: Change, made_keystores: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It never fails: who changes a policy seldom has the keys of the CAs."""
    copy_of(made_keystores / "before", change.folder / "ks")
    change.base = change.commit({})
    change.commit({"README": "x"})
    words = ("--policy", "robot.xml", "--keystore", "ks")
    assert "\n[ok] signed ks: nothing found" in change.review(*words).ok().out
    change.commit({"robot.xml": policy_text({"/a": publish("/x"), "/c": publish("/z")})})
    ended = change.review(*words, "--new-access", "allow").ok()
    assert "\n[allowed] signed ks: 1 warning, 1 note" in ended.out, ended
    assert "/c: the keystore does not have this enclave [keystore.enclave-missing]" in ended.out
    change.commit({"robot.xml": policy_text(ROBOT | {"/a": publish("/x2")})})
    summary = change.sarif.with_suffix(".md")
    ended = change.review(*words, "--new-access", "allow", "--summary", str(summary)).ok()
    assert "permissions (-) and policy (+) differ: - ALLOW publish topic /x" in ended.out, ended
    results = json.loads(change.sarif.read_text())["runs"][0]["results"]
    (stale,) = (each for each in results if each["ruleId"] == "enclave.stale-permissions")
    assert stale["level"] == "note" and "seldom has the keys" in str(stale["suppressions"])
    assert "### Signed rights: allowed" in summary.read_text()
    change.commit({"r1/export/enclaves/a/permissions.p7s": "x", "enclaves/governance.p7s": "x"})
    unnamed = change.review("--policy", "robot.xml", "--new-access", "allow").ok().out
    for path in ("ks", "r1/export", "."):
        assert f"'{path}' is a keystore and is not reviewed" in unnamed
    changed = change.review("--policy", "robot.xml", "--keystore", "ks")
    assert changed.status == 1
    assert "'r1/export' is a keystore that changes and is not reviewed: name it" in changed.out
    assert "'.' is a keystore that changes and is not reviewed: move it into" in changed.out
    assert "'ks' is a keystore" not in changed.out
    certificate = "enclaves/a/cert.pem"
    for file, new in (
        ("public/identity_ca.cert.pem", "x"),
        (certificate, "x"),
        (certificate, None),
    ):
        change.base = change.commit({})
        change.commit({f"ks/{file}": new})
        assert "'ks' is a keystore that ch" in change.review("--policy", "robot.xml").out, file
    with monkeypatch.context() as patched:
        patched.setattr(commit_files, "_MOST_ENTRIES", 20)
        change.commit({"README": "y"})
        assert "keystores that did not ch" in change.review("--policy", "robot.xml").out
    left = ("--leave-out", "enclaves", "--leave-out", "r1/export", "--leave-out", "ks")
    change.base = change.commit({})
    change.commit({"ks/enclaves/a/permissions.p7s": "x", "enclaves/governance.p7s": "y"})
    assert " is a keystore" not in change.review("--policy", "robot.xml", *left).ok().out
    change.base = change.commit({})
    shutil.rmtree(change.folder / "ks")
    change.commit({})
    assert "'ks' is a keystore" not in change.review("--policy", "robot.xml").ok().out


def test_private_keys_in_a_commit_are_named(change: Change, made_keystores: Path) -> None:
    """They fail the review, also outside of the keystore, and are expected of no other enclave."""
    copy_of(made_keystores / "before", change.folder / "ks")
    must = '[[must]]\nenclave = "/b"\npublish = ["/y"]\n'
    change.base = change.commit({"robot.toml": ONLY + must})
    begin = "-----BEGIN EC PRIVATE KEY-----"
    words = ("--policy", "robot.xml", "--requirements", "robot.toml", "--keystore", "ks")
    change.commit(
        {
            "mention.py": f'KEY = "{begin}\\n"\n',
            "own.toml": '[protection]\nrtps = "NONE"\n',
            "robots.toml": "[robots.r1]\n",
            "pyproject.toml": "[project]\n",
        }
    )
    passed = change.review(*words).ok().out.splitlines()[-2]
    assert "private keys of keystores are not reviewed; 'own.toml' changes and" in passed
    assert "'robots.toml' changes and is not reviewed" in passed
    assert "pyproject" not in passed
    keys = ("ks/enclaves/a/key.pem", "ks/private/permissions_ca.key.pem", "old/ca.key")
    texts = (f"{begin}\nMHcCAQEE\n", f"{begin}\r\nMHcCAQEE\r\n", rf'{{"key": "{begin}\nMHcC"}}')
    change.commit(dict(zip(keys, texts, strict=True)))
    ended = change.review(*words, "--new-access", "allow")
    assert ended.status == 1
    for key in keys:
        assert f"  '{key}' has a private key, which everybody who can read" in ended.out, ended
    assert "cannot start" not in ended.out, ended
    change.base = change.commit({})
    change.commit({"README": "x"})
    for status, word, more in ((0, "allowed", ()), (1, "FAILED", ("--keystore", "ks"))):
        ended = change.review("--policy", "robot.xml", *more)
        assert ended.status == status and f"\n[{word}] keystore" in ended.out, ended
        assert f"  '{keys[1]}' has a private key, " in ended.out, ended
    left = change.review("--policy", "robot.xml", "--leave-out", "ks").ok().out
    assert "has a private key" not in left


@pytest.mark.parametrize("was_whole", [True, False])
def test_no_change_makes_an_export_of_a_keystore(
    change: Change, made_keystores: Path, was_whole: bool
) -> None:
    """Otherwise, an enclave that the change removes would count as one that an export lacks."""
    copy_of(made_keystores / "before", change.folder / "ks")
    must = '[[must]]\nenclave = "/b"\npublish = ["/y"]\n'
    whole = {
        "robot.toml": must,
        "ks/ledger.jsonl": None,
        "ks/ledger.p7s": None,
        "ks/sros.toml": None,
    }
    exported = dict.fromkeys(("ks/enclaves/governance.p7s", "ks/enclaves/governance.xml"))
    for link in [path for path in change.folder.glob("ks/enclaves/*/*") if path.is_symlink()]:
        content = link.read_bytes()
        link.unlink()
        link.write_bytes(content)
    shutil.rmtree(change.folder / "ks/private", ignore_errors=True)
    change.base = change.commit(whole if was_whole else whole | exported)
    shutil.rmtree(change.folder / "ks/enclaves/b")
    change.commit(exported if was_whole else {})
    ended = change.review("--keystore", "ks", "--requirements", "robot.toml")
    if was_whole:
        assert ended.status == 1 and "/b: does not exist, but /b has to be" in ended.out, ended
        assert "of-export" not in ended.out
    else:
        assert "[ok] requirements ks: 1 note" in ended.out and "of-export" in ended.out, ended


def test_what_is_new_included_or_cannot_fail(change: Change) -> None:
    included = (change.folder / "common/node.xml").read_text()
    change.commit({"common/node.xml": f"{included}<!-- more -->\n"})
    assert "node.xml" not in change.review("--policy", "robot.xml").ok().out
    change.commit({"new.xml": policy_text({"/c": publish("/z")})})
    new = change.review("--policy", "new.xml")
    assert (new.status, "is new, so that all of its access is new; if it" in new.out) == (
        1,
        True,
    ), new
    change.base = change.commit({"robot.toml": ONLY.replace("/x", "/nobody")})
    change.commit({"README": "x"})
    empty = change.review("--policy", "robot.xml", "--requirements", "robot.toml")
    assert (empty.status, "requirements robot.xml: 1 warning" in empty.out) == (1, True), empty


@pytest.fixture(scope="module")
def made_keystores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the public part of a keystore, and what a change makes of it."""
    folder = tmp_path_factory.mktemp("keystores")
    shutil.copytree(PROJECT / "policies/common", folder / "common")
    for name, enclaves in (("robot", ROBOT), ("wider", WIDER)):
        (folder / f"{name}.xml").write_text(policy_text(enclaves))
    sros("create_keystore", "before", "--template", "production", cwd=folder).ok()
    sros("generate_artifacts", "-k", "before", "-p", "robot.xml", cwd=folder).ok()
    for case in ("rights", "ca", "governance", "default"):
        copy_of(folder / "before", folder / case)
    sros("generate_artifacts", "-k", "rights", "-p", "wider.xml", cwd=folder).ok()
    sros("rotate_ca", "ca", "--next", cwd=folder).ok()
    weaker = ("--set", "protection.rtps=NONE", "--allow-looser")
    for change_of in (weaker, weaker[:2]):
        if sros("update_keystore", "governance", *change_of, cwd=folder).status == 0:
            break
    settings = folder / "default" / "sros.toml"
    settings.write_text(settings.read_text().replace('"node_basics"', '"everything"'))
    for key in [*folder.glob("**/key.pem"), *folder.glob("**/*.key.pem")]:
        key.unlink()
    return folder


def test_new_access_is_never_pushed_out_of_a_comment(change: Change, tmp_path: Path) -> None:
    """Two hundred policies that are broken, with long names, do not."""
    broken = {f"many/{n:03}{'x' * 150}.policy.xml": "<policy version='0'/>" for n in range(200)}
    change.base = change.commit({"many/robot.xml": policy_text(ROBOT)})
    shutil.copytree(change.folder / "common", change.folder / "many" / "common")
    change.commit({**broken, "robot.xml": policy_text(WIDER)})
    with TemporaryDirectory() as outside:
        summary = Path(outside, "review.md")
        ended = change.review("--policy", "robot.xml\nmany", "--summary", str(summary))
        text = summary.read_text()
    assert ended.status == 2 and re.search(r"\n  and \d+ more lines \(--summary FILE", ended.out)
    assert len(text) < 65_536
    assert "New access `robot.xml many`" in text.partition("###")[0]


# ── names of commits ───────────────────────────────────────────────────────────────────────


@pytest.fixture
def named(change: Change) -> Change:
    """Return a repository with a remote, whose branch main has the wider policy since a tag."""
    change.git("remote", "add", "origin", ".")
    change.git("update-ref", "refs/remotes/origin/main", change.base)
    change.commit({"robot.xml": policy_text(WIDER)})
    return change


@pytest.mark.parametrize(
    ("reference", "name", "said"),
    some(
        [
            ("refs/tags/origin/main", "origin/main", "'refs/remotes/origin/main'"),
            ("refs/heads/origin/main", "origin/main", "'refs/heads/origin/main'"),
            ("refs/tags/main", "main", "'refs/tags/main' and 'refs/heads/main'"),
            ("refs/tags/{short}", "{short}", "ambiguous"),
            ("refs/main", "main", "'refs/main' and"),
        ],
        1,
    ),
)
def test_an_ambiguous_name_is_refused(named: Change, reference: str, name: str, said: str) -> None:
    """A tag that has the name of the base would be taken in its place."""
    short = named.base[:7]
    name, reference = name.format(short=short), reference.format(short=short)
    words = ("diff_policy", "--no-new-access", f"git:{name}:robot.xml", "robot.xml")
    before = sros(*words, cwd=named.folder)
    assert before.status == (0 if name == "main" else 1), before
    named.git("update-ref", reference, "HEAD")
    after = sros(*words, cwd=named.folder)
    assert after.status == 2, after
    assert f"the name '{name}' is ambiguous" in after.err
    assert said in after.err
    with pytest.raises(
        UsageError, match=r"neither the full id.*could choose another.*is ambiguous"
    ):
        Repository(named.folder).exact_commit(name)
    found = named.git("rev-parse", "HEAD").strip()
    with pytest.raises(
        UsageError, match=rf"neither .* If git finds .* now, write `--base {found}`"
    ):
        Repository(named.folder).base_commit("HEAD", None)


def test_a_tag_that_only_looks_like_a_branch_of_the_remote_is_refused(named: Change) -> None:
    named.git("tag", "origin/stable")
    with pytest.raises(DocumentError, match="no branch of the remote 'origin'"):
        Repository(named.folder).commit("origin/stable")
    assert Repository(named.folder).exact_commit("refs/tags/origin/stable")


@pytest.mark.parametrize("place", ["refs/tags/refs/heads/gone", "refs/heads/refs/heads/gone"])
def test_a_full_reference_is_taken_exactly(named: Change, place: str) -> None:
    """Git itself would find a tag that is named like a full reference which does not exist."""
    named.git("update-ref", place, "HEAD")
    assert named.git("rev-parse", "--verify", "refs/heads/gone")
    for ask in (Repository(named.folder).exact_commit, Repository(named.folder).commit):
        with pytest.raises(SrosError, match="git finds no"):
            ask("refs/heads/gone")


@pytest.mark.parametrize(
    "name", some(["main", "main~1", "HEAD", "@", "HEAD^", "v1", "v1^{}", "HEAD@{0}"], 2)
)
def test_names_that_are_clear_are_taken(named: Change, name: str) -> None:
    named.git("tag", "-a", "-m", "x", "v1")
    assert Repository(named.folder).commit(name) == named.git("rev-parse", f"{name}^{{commit}}")


def _replace(change: Change, wider: str) -> None:
    change.git("replace", wider, change.git("rev-parse", f"{change.base}:robot.xml"))


def _replace_commit(change: Change, _: str) -> None:
    head = change.git("rev-parse", "HEAD")
    change.git("replace", head, change.base)


def _damage(change: Change, wider: str) -> None:
    objects = change.folder / ".git" / "objects"
    earlier = change.git("rev-parse", f"{change.base}:robot.xml")
    places = [objects / each[:2] / each[2:] for each in (wider, earlier)]
    places[0].chmod(0o600)
    places[0].write_bytes(places[1].read_bytes())


@pytest.mark.parametrize(
    ("trick", "status"),
    [(_replace, 1), (_replace_commit, 1), (_damage, 2)],
    ids=["file", "commit", "loose"],
)
def test_objects_are_what_their_hashes_say(
    named: Change, trick: Callable[[Change, str], None], status: int
) -> None:
    """A naive `git show` gives the policy of before."""
    trick(named, named.git("rev-parse", "HEAD:robot.xml"))
    try:
        naive = named.git("show", "HEAD:robot.xml")
    except subprocess.CalledProcessError as error:
        naive = error.stdout.decode()
    assert "/x" not in naive.rpartition("/y")[2]
    assert named.review("--policy", "robot.xml").status == status


def test_requirements_of_a_package_are_decided_in_a_namespace(
    change: Change, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the namespace / they hold, because nobody there has their names."""
    only = '[[only]]\npublish = ["x"]\nenclaves = ["/a"]\n'
    robot = policy_text({"/a": publish("/x"), "/b": publish("/l/x")})
    change.base = change.commit({"robot.xml": robot, "robot.toml": only})
    change.commit({"other": "1"})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml")
    ended = change.review(*asked).ok()
    assert "in namespaces other than / (add --namespace /l): sros only decided" in ended.out
    with monkeypatch.context() as patched:
        patched.setattr(reviewed_requirements, "MOST_NAMESPACES", 1)
        some = "the change breaks them in 1 of 2 namespaces (first those in which a changed name"
        assert some in change.review(*asked).ok().out
    assert (
        "(add --namespace /l); nothing"
        in sros("review", "--base", "none", *asked, cwd=change.folder).out
    )
    ended = change.review(*asked, "--namespace", "/l", "--namespace", "/")
    assert ended.status == 1 and "only decided" not in ended.out, ended
    assert "not covered: requirements with relative names in namespaces other than /l and /" in (
        ended.out
    )
    # A review does not repeat that there was no /l/a before, either.
    assert "requirements robot.xml: 1 error in /l and /" in ended.out, ended
    assert "/b: may publish /l/x, but only /l/a may publish /l/x" in ended.out
    ended = change.review(*asked, "--namespace", "/l", "--remap", "x:=/x")
    assert "/a: may publish /x, but only /l/a may" in ended.out and "/l/x" not in ended.out, ended
    ended = change.review(*asked, "--remap", "z:=/z")
    assert (ended.status, "no requirement has the old name" in ended.out) == (2, True), ended
    # A namespace has to fit all requirements.
    more = only + only.replace('"x"', '"y"')
    change.base = change.commit(
        {
            "robot.xml": policy_text({"/a": publish("/r/x", "/r/y", "/l/x", "/l/y", "/m/x")}),
            "robot.toml": more,
        }
    )
    change.commit({"other": "3"})
    hint = "(add --namespace /l --namespace /r)"
    assert hint in change.review(*asked).out
    # No namespace fits the policy of a package, so that there is no option to add.
    package = {"robot.xml": policy_text({"/a": publish("x", "/m/y")}), "robot.toml": only}
    change.base = change.commit(package)
    change.commit({"other": "2"})
    assert "in namespaces" not in change.review(*asked).ok().out
    change.commit({"robot.toml": f"# Why.\n{only}"})
    ended = change.review(*asked).ok()
    assert "namespaces other than /: sros only decided" in ended.out, ended
    moved = sros(
        "check", "robot.xml", "--requirements", "robot.toml", "--namespace", "/m", cwd=change.folder
    )
    assert (
        "/x without the namespace, as the policy of a package does: leave out `--namespace /m`"
        in moved.out
    ), moved


def test_a_note_on_what_only_users_could_break_comes_with_the_change_that_causes_it(
    change: Change,
) -> None:
    only = '[[only]]\npublish = ["x"]\nenclaves = ["/a"]\n'
    second = only.replace('"x"', '"y"')
    note = "no enclave may subscribe to topic {0}; required: only /a may publish {0}"
    package, wider = ({"robot.xml": policy_text({"/a": publish(*names)})} for names in ("x", "xy"))
    fixed = {"robot.xml": policy_text({"/a": publish("/x")})}
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    for before, after, texts in (
        ({**package, "robot.toml": only}, {"robot.toml": f"# Why.\n{only}"}, ()),
        ({**package, "robot.toml": only}, wider, ()),
        ({**wider, "robot.toml": only}, {"robot.toml": only + second}, (note.format("/y"),)),
        ({"robot.xml": policy_text(WIDER), "robot.toml": only}, package, (note.format("/x"),)),
        # Nothing of BASE can be read: all notes are there.
        ({"robot.xml": "<policy/>", "robot.toml": ONLY}, fixed, (note.format("/x"),)),
    ):
        change.base = change.commit(before)
        change.commit(after)
        ended = change.review(*asked)
        notes = re.findall(r"note: (.*) \[requirement\.holds-alone]", ended.out)
        assert tuple(notes) == texts, ended


def test_a_name_that_breaks_requirements_of_users_in_a_namespace(change: Change) -> None:
    """In the namespace / nothing changes; twin: a name that was absolute before."""
    must = '[[must]]\npublish = ["x"]\nenclave = "/a"\n'
    moving = policy_text({"/a": publish("x"), "/b": publish("y")})
    change.base = change.commit({"robot.xml": moving, "robot.toml": must})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml")
    change.commit({"robot.xml": moving.replace(">x<", ">/x<")})
    ended = change.review(*asked)
    said = "error: /any_namespace/a: "
    assert (ended.status, "requirements robot.xml: 1 error\n" in ended.out) == (1, True), ended
    assert said in ended.out, ended
    change.base = change.commit({"other": "1"})
    change.commit({"robot.xml": moving.replace(">x<", ">/x<").replace(">y<", ">/y<")})
    assert said not in change.review(*asked).out


@pytest.mark.parametrize(("required", "is_new"), [("x", False), ("x*", True)])
def test_a_wildcard_that_gives_users_in_a_namespace_no_more_breaks_nothing(
    change: Change, required: str, is_new: bool
) -> None:
    """Users in a namespace have this failure already. Twin: the requirement has more names."""
    only = f'[[only]]\npublish = ["{required}"]\nenclaves = ["//[a]"]\n'
    text = policy_text({"/a": publish("x"), "/b": subscribe("x")})
    change.base = change.commit({"robot.xml": text, "robot.toml": only})
    change.commit({"robot.xml": text.replace(">x<", ">x*<", 1)})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert ("[FAILED] requirements robot.xml" in ended.out) is is_new, ended


@pytest.mark.parametrize("after", ["/x", "x"])
def test_a_requirement_that_protects_nothing_any_more_in_a_namespace(
    change: Change, after: str
) -> None:
    """The policy then has the name only outside the namespace; twin: the name stays relative."""
    only = '[[only]]\npublish = ["x"]\nenclaves = ["/a"]\n'
    change.base = change.commit(
        {"robot.xml": policy_text({"/a": publish("x")}), "robot.toml": only}
    )
    change.commit({"robot.xml": policy_text({"/a": publish(after, "y")})})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert ended.status == (after == "/x"), ended
    said = ": only /any_namespace/a may publish /any_namespace/x"
    assert (said in ended.out) == (after == "/x"), ended


@pytest.mark.parametrize("after", ["/n/z", "/n/x"])
def test_a_right_that_the_change_renames_on_a_robot(change: Change, after: str) -> None:
    """The subscriber is left with the earlier name; twin: the publisher keeps it, too."""
    only = '[[only]]\npublish = ["x"]\nenclaves = ["/a"]\n'
    reads = '<topics subscribe="ALLOW"><topic>/n/x</topic></topics>'
    before, renamed = (
        policy_text({"/n/a": publish(*names), "/b": reads}) for names in (["/n/x"], [after, "/n/y"])
    )
    change.base = change.commit({"robot.xml": before, "robot.toml": only})
    change.commit({"robot.xml": renamed})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked, "--namespace", "/n")
    assert ended.status == (after == "/n/z"), ended
    assert ("no enclave may publish topic /n/x; " in ended.out) == (after == "/n/z"), ended


@pytest.mark.parametrize(
    ("name", "namespace"),
    [("/*/x", "/any_namespace"), ("/[!a]*/x", "/b"), ("/left/x", "/left"), ("/*_arm/x", "/_arm")],
)
def test_a_wildcard_that_leaves_out_one_namespace_breaks_requirements_in_others(
    change: Change, name: str, namespace: str
) -> None:
    only = '[[only]]\npublish = ["x"]\nenclaves = ["/a"]\n'
    text = policy_text({"/a": publish("x"), "/b": publish("y")})
    change.base = change.commit({"robot.xml": text, "robot.toml": only})
    change.commit({"robot.xml": text.replace(">y<", f">{name}<")})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert ended.status == 1, ended
    place = f"in namespace {namespace}, which the review tries"
    assert f"error: {namespace}/b: {place}: may publish {namespace}/x" in ended.out


@pytest.mark.parametrize(
    ("required", "writer", "added"),
    [
        ('[[at_most]]\npublish = ["x"]\nenclaves = 1\n', "/b", "x"),
        ('[[not_both]]\nfirst.publish = ["x"]\nsecond.publish = ["v"]\n', "/a", "v"),
    ],
)
def test_a_name_that_moves_breaks_a_requirement_with_names_that_do_not(
    change: Change, monkeypatch: pytest.MonkeyPatch, required: str, writer: str, added: str
) -> None:
    """The change adds no name in the namespace, which is still tried before others."""
    robot = {"/a": ["w"], "/b": ["/b1/z", "/b2/z"], "/d": ["v"]}
    robot["/e"] = ["x"] if added == "v" else ["w"]
    robot[writer].append("/c/x")
    heard = {"/r": subscribe("x", "v")}

    def text() -> str:
        return policy_text(heard | {path: publish(*names) for path, names in robot.items()})

    change.base = change.commit({"robot.xml": text(), "robot.toml": required})
    robot["/a"].append(added)
    change.commit({"robot.xml": text()})
    monkeypatch.setattr(reviewed_requirements, "MOST_NAMESPACES", 2)
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert ": in namespace /c, which the review tries" in ended.out, ended


@pytest.mark.parametrize(
    ("names", "status", "said"),
    [
        # Namespaces in which no requirement has the name come last.
        ("/b1/z /b2/z /b3/z /c/x", 1, "error: /c/b: in namespace /c, which"),
        ("/b1/z /b2/z /b3/z /c/x*", 1, "error: /c/b: in namespace /c, which"),
        ("/b1/z /b2/z /b3/z", 0, "in 3 of 4 namespaces"),
        ("/n1/y /n2/y", 0, "[ok] requirements"),
        ("/n1/y /n2/y /n3/y", 2, "were not decided in /n3: the review tries only 3"),
        ("/n1/y /n2/y /n3/y /n4/x", 2, "were not decided in /n3, /n4: "),
        ("/n1/x /n2/y /n3/y", 1, "error: /n1/b: in namespace /n1, which"),
    ],
)
def test_no_name_uses_up_the_namespaces_that_are_tried(
    change: Change, monkeypatch: pytest.MonkeyPatch, names: str, status: int, said: str
) -> None:
    """What is left untried is undecided, if a requirement could be broken there.

    /a, which may publish all names of the requirement, gets the names with y.
    """
    only = '[[only]]\npublish = ["x", "y"]\nenclaves = ["/a"]\n'
    robot = {"/a": publish("x", "y"), "/b": publish("w"), "/c": subscribe("x", "y")}
    change.base = change.commit({"robot.xml": policy_text(robot), "robot.toml": only})
    own = [name for name in names.split() if name.endswith("/y")]
    others = [name for name in names.split() if name not in own]
    added = {"/a": publish("x", "y", *own), "/b": publish("w", *others)}
    change.commit({"robot.xml": policy_text(robot | added)})
    monkeypatch.setattr(reviewed_requirements, "MOST_NAMESPACES", 3)
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert (ended.status, said in ended.out) == (status, True), ended


@pytest.mark.parametrize(
    ("writers", "later", "new", "status"),
    [
        ("/b", "/b", "z", 0),
        ("/b", "/c", "z", 1),  # the second enclave breaks the requirement only after the change
        ("/b /x", "/b /x", "z", 0),
        ("/b /x", "/b /z", "z", 1),  # an enclave that is named like the new name
        ("/b", "/b", "xx", 0),
        ("/b /x", "/b /xx", "xx", 1),
    ],
)
def test_a_renamed_requirement_may_stay_broken_in_a_namespace(
    change: Change, writers: str, later: str, new: str, status: int
) -> None:
    only = '[[only]]\npublish = ["x", "w"]\nenclaves = ["/a", "/d"]\n'

    def policy(name: str, writers: str) -> str:
        enclaves = dict.fromkeys(("/b", "/c", "/x", "/z", "/xx"), publish("y"))
        enclaves |= dict.fromkeys(writers.split(), publish(f"/left/{name}"))
        return policy_text({"/a": publish(name), "/d": publish("w"), **enclaves})

    change.base = change.commit({"robot.xml": policy("x", writers), "robot.toml": only})
    renamed, after = only.replace('"x"', f'"{new}"'), policy(new, later)
    change.commit({"robot.xml": after, "robot.toml": renamed})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    assert "requirement.dropped" in change.review(*asked).out
    ended = change.review(*asked, "--dropped-requirements", "allow")
    assert ended.status == status, ended
    assert ("in namespace /left, which the review" in ended.out) == bool(status), ended
    for added in {*later.split()}.difference(writers.split()):
        line = after[: after.index(f'"{added}"')].count("\n") + 2
        assert f"  robot.xml:{line}: error: /left{added}: in namespace /left" in ended.out, ended


def test_requirements_may_swap_their_names(change: Change) -> None:
    """Twin: another enclave breaks one of them only after the change."""
    only = '[[only]]\npublish = ["{}"]\nsubscribe = ["{}"]\nenclaves = ["/a"]\n'
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    for later, status in (("/b", 0), ("/c", 1)):
        both = publish("x", "y")
        enclaves = {"/a": both + both.replace("publish", "subscribe")}
        enclaves |= dict.fromkeys(("/b", "/c"), publish("q"))
        before = policy_text(enclaves | {"/b": publish("/left/x")})
        change.base = change.commit({"robot.xml": before, "robot.toml": only.format("x", "y")})
        after = policy_text(enclaves | {later: publish("/left/y")})
        change.commit({"robot.xml": after, "robot.toml": only.format("y", "x")})
        ended = change.review(*asked, "--dropped-requirements", "allow")
        assert ended.status == status, ended


@pytest.mark.parametrize(
    ("requirement", "right"),
    [
        ('[[only]]\npublish = ["x"]\nenclaves = ["/a", "/op", "!//arm*/op*"]\n', "x"),
        ('[[widest]]\npublish = ["x"]\nenclaves = ["//arm*/op*"]\n', "y/*"),
    ],
)
def test_a_requirement_for_other_enclaves_in_the_namespaces_of_its_patterns(
    change: Change, requirement: str, right: str
) -> None:
    """No name of the policy has these namespaces."""
    enclaves = {"/a": publish("x"), "/arm1/open": publish("y"), "/op": publish("y")}
    change.base = change.commit({"robot.xml": policy_text(enclaves), "robot.toml": requirement})
    change.commit({"robot.xml": policy_text({**enclaves, "/op": publish("y", right)})})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert ended.status == 1, ended
    assert "/arm/op: in namespace /arm, which the review tries" in ended.out, ended


_HAND = '[[only]]\npublish = ["x"]\nenclaves = ["/a", "//op/hand"]\n'
_ONLY_Y = '[[only]]\npublish = ["y"]\nenclaves = ["/a"]\n'
_EXCEPT_LEFT = '[[only]]\npublish = ["x"]\nenclaves = ["*", "!//left/*"]\n'
_MUST_HAND = '[[must]]\npublish = ["x"]\nenclave = "//op/hand"\n'


@pytest.mark.parametrize(
    ("added", "before", "after", "said"),
    [
        ({"/op/hand": ["x"]}, _HAND, _HAND, ""),
        ({"/op/hand": ["/left/x"]}, _HAND, _HAND, ""),
        ({"/op/hand": ["x"]}, _HAND, _HAND + _MUST_HAND, ""),
        ({"/op/hand": ["/left/y"]}, _HAND + _ONLY_Y, _HAND + _ONLY_Y, "/hand: in namespace /left,"),
        # Requirements that name the enclave in different ways.
        (
            {"/op/hand": ["y"]},
            _HAND + _ONLY_Y.replace('"/a"', '"/a", "/op/hand"'),
            _HAND + _ONLY_Y.replace('"/a"', '"/a", "/op/hand"'),
            "error: /op/hand: in namespace /any_namespace, ",
        ),
        # The change names an enclave so that it does not move.
        (
            {"/b": ["/left/y"]},
            _ONLY_Y,
            _ONLY_Y + _HAND.replace("//op/hand", "//b"),
            "/left/b: in n",
        ),
        ({"/b": ["x"]}, _EXCEPT_LEFT, _EXCEPT_LEFT.replace("*", '*", "//b', 1), "/left/b: in n"),
        ({"/b": []}, _HAND, _HAND.replace('"/a"', '"/a", "//a"'), "requirement.dropped"),
        ({"/b": []}, _HAND, _HAND.replace('"/a"', '"//a"'), "requirement.dropped"),
    ],
)
def test_an_enclave_that_does_not_move_with_the_namespace(
    change: Change, added: dict[str, list[str]], before: str, after: str, said: str
) -> None:
    """Users merge it with `--enclave`."""
    enclaves = dict.fromkeys(("/op/hand", "/b"), publish("v"))
    enclaves |= {"/a": publish("x", "y"), "/c": subscribe("x", "y")}
    change.base = change.commit({"robot.xml": policy_text(enclaves), "robot.toml": before})
    enclaves |= {path: publish("v", *names) for path, names in added.items()}
    change.commit({"robot.xml": policy_text(enclaves), "robot.toml": after})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert (ended.status, said in ended.out) == (bool(said), True), ended


_DENIED = publish("/left/*") + publish("x").replace("ALLOW", "DENY")


@pytest.mark.parametrize(
    ("requirement", "before", "after"),
    [
        ('[[only]]\npublish = ["x"]\nenclaves = ["/a"]\n', _DENIED, publish("/left/*")),
        # In the namespace /, both are the same name.
        (ONLY.replace("/x", "x"), publish("left/x"), publish("/left/x")),
        (
            '[[not_both]]\nfirst = {publish = ["x"]}\nsecond = {publish = ["y"]}\n',
            publish("/left/x"),
            publish("/left/x", "y"),
        ),
    ],
)
def test_names_that_do_not_move_break_requirements_together_with_names_that_do(
    change: Change, monkeypatch: pytest.MonkeyPatch, requirement: str, before: str, after: str
) -> None:
    """In the namespace / and in most others, the change breaks nothing.

    Names of namespaces in which it breaks nothing do not use up those that are tried.
    """
    monkeypatch.setattr(reviewed_requirements, "MOST_NAMESPACES", 2)
    text = {"/a": publish("x"), "/b": before, "/c": publish("y", "/b1/z", "/b2/z")}
    change.base = change.commit({"robot.xml": policy_text(text), "robot.toml": requirement})
    change.commit({"robot.xml": policy_text({**text, "/b": after})})
    asked = ("--policy", "robot.xml", "--requirements", "robot.toml", "--new-access", "allow")
    ended = change.review(*asked)
    assert ended.status == 1 and "which the review tries: may publish /left/" in ended.out, ended
