"""What the documents say of the program is so: verbs, attacks, files, and where links lead."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest

import sros_tool
from sros_tool.cli.program import FAMILIES
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.on_zenoh import ATTACKS as ZENOH_ATTACKS
from tests.support.checkout import known_files
from tests.support.tables import for_every

PROJECT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    path.relative_to(PROJECT)
    for path in (
        *PROJECT.glob("*.md"),
        *PROJECT.glob("docs/**/*.md"),
        *PROJECT.glob("policies/*.md"),
    )
)
CI_PAGE = "docs/howto/ci.md"
FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


def read(document: Path | str) -> str:
    return (PROJECT / document).read_text(encoding="utf-8")


def anchors(document: Path) -> set[str]:
    """The anchors of a document's headings, as code hosts make them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", read(document)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


@for_every(DOCUMENTS)
def test_links_lead_somewhere(document: Path) -> None:
    links = re.findall(r"\]\(([^)]+)\)", FENCE.sub("", read(document)))
    for link in links:
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (PROJECT / document).parent / path if path else PROJECT / document
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target.resolve().relative_to(PROJECT)), link


def test_the_readme_says_what_sros_is_then_the_two_commands_and_is_short() -> None:
    lines = re.sub(r"<!--.*?-->\n", "", read("README.md"), flags=re.DOTALL).splitlines()
    assert lines[2].startswith("**sros** is ")
    commands = [line.split("#")[0].strip() for line in lines[:40] if line.startswith("./dev ")]
    assert commands == ["./dev demo", "./dev test"], "before and after, and installing, come first"
    assert len(lines) <= 150


def test_every_entry_at_the_top_says_who_looks_for_it() -> None:
    rows = re.findall(r"^\| (`.+?) \| ", read("CONTRIBUTING.md"), re.MULTILINE)
    said = {word.rstrip("/") for row in rows for word in re.findall(r"`([^`]+)`", row)}
    assert {name.partition("/")[0] for name in known_files()} - said == set()


def test_every_verb_is_described() -> None:
    verbs = {name for family in FAMILIES.values() for name in family}
    rows = re.findall(r"^\| (`.+?) \| ", read("docs/verbs.md"), re.MULTILINE)
    assert {word for row in rows for word in re.findall(r"`([a-z_]+)", row)} >= verbs
    assert "(docs/verbs.md)" in read("README.md")


def test_every_verb_that_refuses_to_stop_nodes_is_listed() -> None:
    verbs = re.split(r"^### sros ", read("docs/reference/options.md"), flags=re.MULTILINE)
    refusing = {each.partition("\n")[0] for each in verbs if "`--allow-refusal VENDOR`" in each}
    _, _, page = read("docs/life_of_keys.md").partition("\n## Changes that would stop nodes\n")
    (listed,) = re.findall(r"These verbs are (.*?)\.", page)
    assert {name.partition(" --")[0] for name in re.findall(r"`(.+?)`", listed)} >= refusing


def test_setup_py_installs_every_policy_of_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A formatter of the page could turn rows of a list into statements that cannot be pasted."""
    shutil.copytree(PROJECT / "policies/common", tmp_path / "policies/common")
    (tmp_path / "policies/gripper.xml").touch()
    (tmp_path / "policies/gripper.requirements.toml").touch()
    (lines,) = re.findall(
        r"^```python\n(from glob.*?)^```", read("docs/howto/package.md"), re.M | re.S
    )
    monkeypatch.chdir(tmp_path)
    exec(lines, made := dict[str, Any]())
    files = [Path(file) for _, found in made["POLICIES"] for file in found]
    assert sorted(files) == sorted(
        path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()
    )
    share = Path("share/gripper_driver")
    assert all(share / Path(found[0]).parent == Path(at) for at, found in made["POLICIES"])


def test_every_attack_is_in_the_table_of_attacks() -> None:
    text = read("docs/attacks.md")
    rows = [row.name for row in ATTACKS.rows if not row.defence_removed]
    assert len(rows) > 30
    rows += [row.name for row in ZENOH_ATTACKS.rows if not row.defence_removed]
    assert [name for name in rows if f"| {name} |" not in text] == []


@pytest.mark.parametrize(
    ("page", "heading", "least"),
    [
        ("docs/security.md", "the attacker", 90),
        ("docs/pull_requests.md", "what this page promises", 20),
    ],
)
def test_every_promise_of_a_page_has_tests_that_are_there(
    page: str, heading: str, least: int
) -> None:
    text = read(page)
    tables = re.findall(rf"^\| {heading} \|.*\n\| ---.*\n((?:\|.*\n)+)", text, re.MULTILINE)
    rows = [row for table in tables for row in table.splitlines()]
    assert len(rows) >= least
    assert [row for row in rows if "::test_" not in row] == []
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)
    assert len(named) == text.count("::test_")
    assert [
        f"{path}::{name}" for path, name in named if f"\ndef {name}(" not in f"\n{read(path)}"
    ] == []


def test_every_name_of_the_public_face_is_in_its_document() -> None:
    text = read("docs/python.md")
    assert [name for name in sros_tool.__all__ if f"`{name}" not in text] == []


def test_the_files_that_a_contributor_is_sent_to_are_there() -> None:
    named = set(re.findall(r"`([\w./*]+(?:\.py|\.md|\.toml|\.cpp|/))`", read("CONTRIBUTING.md")))
    assert len(named) > 20
    assert [each for each in sorted(named) if not any(PROJECT.glob(each))] == []


def test_examples_install_a_release_that_has_what_they_use() -> None:
    version = tomllib.loads(read("pyproject.toml"))["project"]["version"]
    for page in ("docs/pull_requests.md", CI_PAGE):
        installed = re.findall(r"\b(?:v|sros_tool==)(\d+\.\d+\.\d+)", read(page))
        assert set(installed) == {version.partition(".dev")[0]}, page


@pytest.mark.parametrize(
    ("build", "status"),
    [
        ("cp -r policies/. $INSTALLED", 0),
        ("echo new >policies/p.xml; cp -r policies/. $INSTALLED", 1),
        ("cp -r policies/. $INSTALLED; echo new >policies/p.xml", 1),
        ("cp -r policies/. $INSTALLED; echo new >$INSTALLED/p.xml", 1),
        ("touch policies/new.xml; cp -r policies/. $INSTALLED", 1),
    ],
)
def test_the_workflow_of_a_package_sees_other_policies(
    build: str, status: int, tmp_path: Path
) -> None:
    """The lines of the workflow, with a ``colcon`` that installs policies as ``build`` does."""
    lines = re.findall(r"^ +(cp -r policies .*|colcon build|diff -r .*)$", read(CI_PAGE), re.M)
    assert [line.split()[0] for line in lines] == ["cp", "colcon", "diff", "diff"]
    installed = "install/gripper_driver/share/gripper_driver/policies"
    colcon = f"colcon() {{ mkdir -p {installed}; {build.replace('$INSTALLED', installed)}; }}"
    (tmp_path / "policies").mkdir()
    (tmp_path / "policies/p.xml").write_text("reviewed\n")
    script = "\n".join([colcon, *lines]).replace("/tmp/reviewed", f"{tmp_path}/reviewed")
    done = subprocess.run(["bash", "-ec", script], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == status, done


def test_no_start_limit_stops_the_path_units_of_pages() -> None:
    """A service that reaches its limit also stops its path unit, until somebody restarts it."""
    fences = [fence for document in DOCUMENTS for fence in FENCE.findall(read(document))]
    names = re.findall(r"^# (\S+)\.path$", "\n".join(fences), re.MULTILINE)
    services = [each for each in fences for name in names if f"\n# {name}.service\n" in each]
    assert len(services) == len(names) > 0
    assert all("\nStartLimitIntervalSec=0\n" in service for service in services)


def test_the_changelog_is_about_this_version() -> None:
    version = tomllib.loads(read("pyproject.toml"))["project"]["version"]
    changelog = read("CHANGELOG.md")
    assert "## [Unreleased]" in changelog or f"## [{version}]" in changelog
    assert version in changelog
