"""The wheel holds all that the verbs need: what is unpacked from it works far from any checkout."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from importlib.metadata import distributions
from pathlib import Path

import pytest

from sros_tool.cli.ros2 import SecurityCommand
from tests.support.checkout import CHECKOUT, known_files
from tests.support.long_form import sometimes
from tools import release


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(CHECKOUT)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode and "Could not find a version" in built.stdout + built.stderr:
        pytest.skip("hatchling cannot be installed here")
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def run(unpacked: Path, cwd: Path, *words: str) -> str:
    """What `sros` of the wheel prints; only what it depends on comes from elsewhere."""
    script = (
        f"import sys; sys.path.insert(0, {str(unpacked)!r}); import sros_tool.cli as cli; "
        f"assert cli.__file__.startswith({str(unpacked)!r}), cli.__file__; cli.main()"
    )
    command = [sys.executable, "-P", "-c", script, *words]
    ended = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, (words, ended.stdout, ended.stderr)
    return ended.stdout


@sometimes("the wheel")
def test_the_licences_of_what_draws_the_pages_are_in_it(unpacked: Path) -> None:
    (licences,) = unpacked.glob("*.dist-info/licenses")
    assert (licences / "LICENSE").read_bytes() == (CHECKOUT / "LICENSE").read_bytes()
    assert "d3" in (licences / "sros_tool/report/assets/view.js.LICENSES.txt").read_text()


@sometimes("the wheel")
def test_nothing_else_is_in_it(unpacked: Path) -> None:
    files = {
        str(path.relative_to(unpacked)): path.read_bytes()
        for path in unpacked.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert list(release.problems_of(files, wheel=True)) == []
    planted = {
        "tests/a.py": b"",
        "sros_tool/a.pyc": b"",
        "sros_tool/.env": b"",
        "sros_tool/a.pem": b"-----BEGIN PRIVATE KEY-----\nMIGH",
        "sros_tool/a.txt": b"in " + bytes(CHECKOUT) + b"/a",
    }
    found = list(release.problems_of({**files, **planted}, wheel=True))
    assert len(found) == len(planted)
    for name in {"tests", *planted} - {"tests/a.py"}:
        assert any(each.startswith(name) for each in found), name


def test_what_a_release_checks_is_complete() -> None:
    assert set(release.EXTRAS) == release.extras()
    stated = release.versions()
    assert release.version_problems(stated) == []
    released = dict.fromkeys(stated, "1.2.0")
    assert release.version_problems(released) == []
    after = released | dict.fromkeys(("pyproject.toml", "sros_tool/__init__.py"), "1.3.0.dev0")
    assert len(release.version_problems(after)) == 2
    after |= {release.GALAXY: "1.3.0-dev0", "package.xml": "1.3.0"}
    assert release.version_problems(after) == []


@sometimes("the wheel")
def test_other_programs_find_what_they_load(unpacked: Path) -> None:
    """The entry points of ros2cli and launch, as importlib.metadata gives them to these."""
    found = {
        (e.group, e.name): e for d in distributions(path=[str(unpacked)]) for e in d.entry_points
    }
    assert found["ros2cli.command", "security"].load() is SecurityCommand
    assert found["launch.frontend.launch_extension", "sros_tool"].value == "sros_tool.launch"


@sometimes("the wheel")
def test_the_manual_page_is_in_it(unpacked: Path) -> None:
    (page,) = unpacked.glob("*.data/data/share/man/man1/sros.1")
    assert page.read_bytes() == (CHECKOUT / "docs" / "man" / "sros.1").read_bytes()


@sometimes("the wheel")
def test_every_file_of_the_package_is_in_it(unpacked: Path) -> None:
    names = known_files("sros_tool", "policies", "keystore_templates")
    assert len(names) > 100
    places = [name if name.startswith("sros_tool/") else f"sros_tool/{name}" for name in names]
    assert [name for name in places if not (unpacked / name).is_file()] == []


@sometimes("the wheel")
def test_the_verbs_work_with_what_is_in_it(unpacked: Path, tmp_path: Path) -> None:
    def sros(*words: str) -> str:
        return run(unpacked, tmp_path, *words)

    sros("policies", "--copy", "policies")
    policy = "policies/mobile_robot.xml"
    for template in ("development", "production", "sros2"):
        sros("create_keystore", template, "--template", template)
    sros("generate_artifacts", "-k", "production", "-p", policy)
    question = ("/mobile_robot/velocity_mux", "publish", "/cmd_vel", "--policy", policy)
    assert f"from      {policy.removesuffix('.xml')}" in sros("explain", "production", *question)
    sros("check", "production", "--policy", policy)
    assert "policy.everything" in sros("check", "--list")
    page = sros("view", "production")
    for asset in ("view.js", "view.css"):
        shipped = (CHECKOUT / "sros_tool/report/assets" / asset).read_text().strip()
        assert shipped[:200] in page, asset
    for form in ("svg", "dot", "mermaid", "json"):
        assert "velocity_mux" in sros("view", policy, "--format", form)
    assert "attacks" in sros("demo", "--list")
    for shell in ("bash", "zsh", "fish"):
        assert "_SROS_COMPLETE" in sros("completion", shell)
