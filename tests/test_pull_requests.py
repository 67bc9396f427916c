"""The action, the template and the hooks, run as a user runs them: in clones with a git history."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from tests.support.code_host import (
    BEFORE,
    POLICY,
    PROJECT,
    REQUIRED,
    REQUIREMENTS,
    WIDER,
    Origin,
    action,
    action_job,
    gitlab,
    gitlab_job,
    policy,
)
from tests.support.harness import sros
from tests.support.long_form import some, sometimes

ALL = {"policy": POLICY, "requirements": REQUIRED}
MARKS_OF_JOBS: list[str] = []
"""What ended the part of each job in which the runner takes no commands."""


def check_sarif(log: object) -> None:
    from pydantic_sarif.model import StaticAnalysisResultsFormatSarifVersion210JsonSchema as Sarif

    Sarif.model_validate(log)


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Origin:
    made = Origin(tmp_path_factory.mktemp("origin"))
    made.commit({"README": "A robot.\n"}, "same")
    made.git("rm", "--quiet", "README")
    made.commit({POLICY: policy(WIDER)}, "wider")
    made.commit({POLICY: policy(BEFORE).replace("ALLOW", "PERMIT")}, "broken")
    looser = REQUIREMENTS.replace("/cmd_vel", "/status").replace("/mux", "/web")
    made.commit({POLICY: policy(WIDER), REQUIRED: looser}, "dropped")
    made.git("checkout", "--quiet", "same")
    return made


def run_action(
    origin: Origin, clone: Path, *, event_base: str = "", **inputs: str
) -> tuple[int, str, dict[str, str]]:
    """Run the steps of the action but the installation; return status, summary and outputs."""
    shutil.rmtree(clone.with_name(f"{clone.name}.temp"), ignore_errors=True)
    job = action_job(origin, clone, event_base=event_base, **inputs)
    ended = job.run()
    begin, *lines = ended.stdout.splitlines()
    mark = begin.removeprefix("::stop-commands::")
    annotations = lines[lines.index(f"::{mark}::") + 1 :]
    assert len(mark) >= 32
    assert all(re.match(r"::(error|warning|notice) file=[^:]+::", line) for line in annotations)
    assert mark not in MARKS_OF_JOBS, "a pull request could print it"
    MARKS_OF_JOBS.append(mark)
    outputs = dict(
        line.split("=", 1) for line in job.files["GITHUB_OUTPUT"].read_text().splitlines()
    )
    for name, spec in action()["outputs"].items():
        assert spec["value"] == f"${{{{ steps.review.outputs.{name} }}}}"
    summary = job.files["GITHUB_STEP_SUMMARY"].read_text()
    written = Path(outputs["summary"])
    assert summary == (written.read_text() if written.exists() else "")
    assert len(summary) < 65_536
    if ended.returncode and written.exists():
        assert "::error " in "".join(annotations), annotations
    assert not origin.git("status", "--porcelain", cwd=clone)
    return ended.returncode, summary + ended.stderr, outputs


def test_the_action_on_pull_requests(origin: Origin, tmp_path: Path) -> None:
    status, said, _ = run_action(origin, origin.clone(tmp_path / "same", "merged/same"), **ALL)
    assert status == 0, said
    assert said.startswith("## Review: nothing found\n")
    assert "nobody gets more access" in said

    clone = origin.clone(tmp_path / "wider", "merged/wider")
    status, said, outputs = run_action(origin, clone, **ALL)
    assert status == 1, said
    assert "`/web ALLOW publish topic /cmd_vel`" in said
    assert "```mermaid" in said
    assert "requirement.violated" in said
    log = json.loads(Path(outputs["sarif"]).read_text())
    check_sarif(log)
    results = log["runs"][0]["results"]
    places = [e["physicalLocation"] for each in results for e in each.get("locations", [])]
    assert POLICY in {e["artifactLocation"]["uri"] for e in places}
    assert str(tmp_path) not in said


@pytest.mark.parametrize("case", some(["new access", "new access is allowed", "broken"], 1))
def test_what_decides_the_status_of_the_action(case: str, origin: Origin, tmp_path: Path) -> None:
    branch = "merged/broken" if case == "broken" else "merged/wider"
    words = {**ALL, "requirements": ""} if case != "broken" else ALL
    if case == "new access is allowed":
        words["new_access"] = "allow"
    status, said, _ = run_action(origin, origin.clone(tmp_path / "clone", branch), **words)
    assert (status == 0) is (case == "new access is allowed"), said
    if case == "new access":
        assert status == 1, "new access alone is enough"
        assert "requirements: none are named" in said
    elif case == "new access is allowed":
        assert "/web ALLOW publish topic /cmd_vel" in said
        assert "new access does not fail the review, as the options say" in said


@sometimes("requirements that a pull request drops")
def test_requirements_that_a_pull_request_drops_are_decided(origin: Origin, tmp_path: Path) -> None:
    clone = origin.clone(tmp_path / "dropped", "merged/dropped")
    status, said, _ = run_action(origin, clone, **ALL)
    assert status == 1, said
    assert "`requirement.dropped`" in said
    assert "only /mux may publish /cmd_vel: the new file has no such requirement" in said
    assert "but only /mux may publish /cmd_vel" in said
    allowed = {"new_access": "allow", "dropped_requirements": "allow"}
    status, said, _ = run_action(origin, clone, **ALL, **allowed)
    assert status == 0, said
    assert said.startswith("## Review: only allowed changes were found\n")
    assert said.partition("\n\nNot covered:\n\n")[2].count("do not fail the review, as") == 1


@sometimes("the installation of the action")
def test_the_installation_runs_nothing_of_the_pull_request(tmp_path: Path) -> None:
    """Run the lines that install sros in a folder of traps, which import what Python offers."""
    install, _ = action()["runs"]["steps"]
    ((script,), _) = gitlab()[1]["script"], None
    trap = tmp_path / "checkout"
    (trap / "sros_tool").mkdir(parents=True)
    for name in ("venv", "ensurepip", "secrets", "pip", "sitecustomize", "sros_tool/__init__"):
        (trap / f"{name}.py").write_text("open('/tmp/sprung', 'w')".replace("/tmp", str(tmp_path)))
    (trap / "pip.conf").write_text("[global]\nindex-url = file:///nowhere\n")
    for name, text in (("action", install["run"]), ("gitlab", script)):
        lines = [each.strip() for each in text.splitlines()]
        (venv,) = (each for each in lines if "-m venv" in each)
        (pip,) = (each for each in lines if "-m pip" in each)
        commands = [
            next(each for each in lines if each.startswith("cd ")),
            re.sub(r'"\$\S+"$', "--help", venv),
            re.sub(r'^"\$\S+" (.*) install .*', rf"{sys.executable} \1 --version", pip),
        ]
        assert lines.index(commands[0]) < lines.index(venv) < lines.index(pip), name
        for words in (commands, commands[1:]):  # each of both protections is enough
            subprocess.run(
                ["bash", "-euc", "\n".join(words)],
                cwd=trap,
                env={"PATH": os.environ["PATH"]},
                check=True,
            )
    assert not (tmp_path / "sprung").exists()
    naive = subprocess.run([sys.executable, "-m", "venv", "--help"], cwd=trap, check=False)
    assert naive.returncode == 0
    assert (tmp_path / "sprung").exists(), "without -I the trap springs"


def test_what_cannot_be_compared_fails_in_the_action(origin: Origin, tmp_path: Path) -> None:
    clone = origin.clone(tmp_path / "clone", "main")
    status, found, outputs = run_action(origin, clone, **ALL, base="0" * 40)
    assert status == 2, found
    assert found.startswith("## Review: could not be decided")
    assert Path(outputs["sarif"]).exists()
    status, found, _ = run_action(origin, clone, **ALL, new_access="fial")
    assert status == 2, found
    assert "'fial' is not one of 'fail', 'allow'" in found


@sometimes("a checkout below the workspace")
def test_a_checkout_below_the_workspace_is_reviewed(origin: Origin, tmp_path: Path) -> None:
    origin.clone(tmp_path / "workspace/robot-sources", "merged/wider")
    job = action_job(origin, tmp_path / "workspace", **ALL, checkout="robot-sources")
    ended = job.run()
    assert (ended.returncode, "requirement" in ended.stdout) == (1, True), ended


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        ({"base": ""}, "the base is empty. Nothing would be compared."),
        ({"base": "main"}, "neither the full id of a commit nor a full reference"),
        ({"base": "refs/heads/none"}, "git finds no reference 'refs/heads/none'"),
        ({"renew-within": "later"}, "later"),
        ({"policy": "robot/none.xml"}, "'robot/none.xml' is not in the commit"),
        ({"policy": "../robot.xml"}, "is not a path from the top of the repository"),
        ({"policy": "/robot.xml"}, "is not a path from the top of the repository"),
        ({"policy": ""}, "no policy and no keystore is named"),
        ({"policy": "robot.policy.xml"}, f"repository: perhaps '{POLICY}' is meant. Review"),
        (
            {"keystore": "common"},
            "begin at the top of the repository: perhaps 'robot/common' is meant. R",
        ),
        ({"requirements": "robot/none.toml"}, "'robot/none.toml' is not in the commit"),
        ({"fleet": "robot/none.toml"}, "'robot/none.toml' is not in the commit"),
        ({"keystore": "none"}, "'none' is not in the commit"),
        ({"summary": "review.md"}, "'review.md' is in the repository"),
        ({"sarif": "robot/../.git/x"}, "'robot/../.git/x' is in the repository"),
        ({"head": "main"}, "neither the full id of a commit nor a full reference"),
        ({"base": "refs/heads/same"}, "both commits are the same"),
        ({"keystore": "robot/common"}, "'robot/common' is not a keystore"),
    ],
)
def test_what_cannot_be_decided(origin: Origin, inputs: dict[str, str], said: str) -> None:
    words = {"base": origin.base, **ALL, **inputs}
    ended = sros("review", *(f"--{name}={text}" for name, text in words.items()), cwd=origin.folder)
    assert ended.status == 2
    assert said in ended.out + ended.err
    assert not origin.git("status", "--porcelain")


def test_no_comparison_is_asked_for_by_name(origin: Origin, tmp_path: Path) -> None:
    clone = origin.clone(tmp_path / "clone", "wider")
    words = {"policy": POLICY, "requirements": "", "base": "none"}
    status, said, _ = run_action(origin, clone, **words)
    assert status == 0
    assert said.startswith("## Review: nothing found\n")
    assert "\n\nNot covered:\n\n- `" in said
    assert "nothing is compared with an earlier commit, as the options say" in said


@sometimes("what the action compares with")
def test_the_action_compares_with_what_is_merged_into(origin: Origin, tmp_path: Path) -> None:
    """The base of the event is older than what main has lost, and the merge brings it back."""
    began = origin.git("commit-tree", "wider^{tree}", "-m", "Before main lost the right")
    clone = origin.clone(tmp_path / "clone", "merged/wider")
    status, said, _ = run_action(origin, clone, policy=POLICY, event_base=began)
    assert status == 1, said
    assert "`/web ALLOW publish topic /cmd_vel`" in said
    assert f"compared with `{origin.base}`" in said
    words = ("--base", began, "--fetch", "origin", "--policy", POLICY)
    older = sros("review", *words, cwd=clone)
    assert (older.status, "lost since BASE" in older.out) == (0, True), "asked by its id"


def test_only_a_merge_says_what_it_is_merged_into(origin: Origin) -> None:
    """A commit of the pull request would name its own parent as the base."""
    for name, said in (
        (f"{origin.git('rev-parse', 'wider')}^1", "is not a merge"),
        ("refs/heads/merged/wider^1", "is not the full id of a commit"),
    ):
        ended = sros("review", "--base", name, "--policy", POLICY, cwd=origin.folder)
        assert (ended.status, said in ended.err) == (2, True), ended


def test_the_job_of_gitlab(origin: Origin, tmp_path: Path) -> None:
    clone = origin.clone(tmp_path / "clone", "wider", depth=20)
    job = gitlab_job(origin, clone, **ALL)
    assert job.run().returncode == 1
    (folder,) = gitlab()[1]["artifacts"]["paths"]
    assert "requirement.violated" in (clone / folder / "review.md").read_text()
    check_sarif(json.loads((clone / folder / "review.sarif").read_text()))
    assert sorted(each.name for each in (clone / folder).iterdir()) == ["review.md", "review.sarif"]
    assert not origin.git("worktree", "list", cwd=clone).partition("\n")[2]


def test_the_job_of_gitlab_has_no_result_of_the_merge_request(
    origin: Origin, tmp_path: Path
) -> None:
    """An installation that fails would leave as an artifact what the merge request has there."""
    clone = origin.clone(tmp_path / "clone", "wider")
    (clone / "sros-review").mkdir()
    (clone / "sros-review" / "review.md").write_text("## Review: nothing found\n")
    job = gitlab_job(origin, clone, **ALL)
    script = job.words[-1].replace("status=0\n", "exit 1\n", 1)
    assert replace(job, words=[*job.words[:-1], script]).run().returncode == 1
    assert not list((clone / "sros-review").iterdir())


@sometimes("what the job of gitlab compares with")
def test_the_job_of_gitlab_compares_with_what_is_merged_into(
    origin: Origin, tmp_path: Path
) -> None:
    """The target branch has lost a right since the merge request began, which has it still."""
    clone = origin.clone(tmp_path / "clone", "dropped", depth=20)
    began = origin.git("rev-parse", "wider")
    job = gitlab_job(origin, clone, **{**ALL, "requirements": ""}, base=began)
    known = {**job.environment, "CI_MERGE_REQUEST_DIFF_BASE_SHA": began}
    assert replace(job, environment=known).run().returncode == 0
    known["CI_MERGE_REQUEST_TARGET_BRANCH_SHA"] = origin.base
    assert replace(job, environment=known).run().returncode == 1


def test_both_code_hosts_run_the_same_command() -> None:
    """Each option of the verb is an input of both, but those that the runner decides."""
    _, review = action()["runs"]["steps"]
    (script,) = gitlab()[1]["script"]
    of_github, of_gitlab = (
        sorted(re.findall(r"--[a-z-]+", text.partition("sros_tool review")[2].partition("||")[0]))
        for text in (review["run"], script)
    )
    of_github.remove("--annotations")  # GitLab has none
    assert of_github == of_gitlab
    own = {"--repository", "--fetch", "--summary", "--sarif"}
    inputs = {f"--{name}" for name in action()["inputs"]} - {"--checkout"}
    assert set(of_github) == inputs | own
    assert inputs == {f"--{name}" for name in gitlab()[0]} - {"--source", "--stage"}


OF_GITHUB = ("check_jsonschema", "--builtin-schema", "vendor.github-actions")
OF_GITLAB = ("check_jsonschema", "--builtin-schema", "vendor.gitlab-ci")


@pytest.mark.parametrize(
    ("file", "words"),
    some(
        [
            ("action.yml", OF_GITHUB),
            ("gitlab.yml", OF_GITLAB),
            (".pre-commit-hooks.yaml", ("pre_commit", "validate-manifest")),
        ],
        1,
    ),
)
def test_the_files_fit_their_schemas(file: str, words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "gitlab.yml").write_text(yaml.safe_dump({"sros-review": gitlab()[1]}))
    folder = tmp_path if words == OF_GITLAB else PROJECT
    # -E: with the newest click, also where the tests run with the oldest packages.
    subprocess.run([sys.executable, "-E", "-m", *words, str(folder / file)], check=True)


@sometimes("the hooks of pre-commit")
def test_the_hooks(origin: Origin, tmp_path: Path) -> None:
    """Run each hook for a commit that touches no file named like a policy."""
    hooks = yaml.safe_load((PROJECT / ".pre-commit-hooks.yaml").read_text())
    arguments: dict[str, list[str]] = {
        "sros-policy": hooks[0]["args"],
        "sros-requirements": [POLICY, "--requirements", REQUIRED],
        "sros-no-new-access": [f"git:{origin.base}:{POLICY}", POLICY],
        "sros-review": ["--base", origin.base, "--policy", POLICY],
    }
    assert [each["id"] for each in hooks] == list(arguments)
    local = [{**each, "language": "system", "args": arguments[each["id"]]} for each in hooks]
    for each in local:
        verb = each["entry"].removeprefix("sros ")
        each["entry"] = f"{origin.python} -I -m sros_tool {verb}"
    everything = set(arguments)
    failing: dict[str, set[str]] = {
        "same": set(),
        "broken": everything,
    }
    for branch, expected in failing.items():
        clone = origin.clone(tmp_path / branch, branch, depth=20)
        (clone / "config.yaml").write_text(
            yaml.safe_dump({"repos": [{"repo": "local", "hooks": local}]})
        )
        words = ("run", "--config", "config.yaml", "--files", "README", "--hook-stage", "manual")
        ended = subprocess.run(
            [sys.executable, "-m", "pre_commit", *words, "--color", "never", "--verbose"],
            cwd=clone,
            env={**origin.environment, "PRE_COMMIT_HOME": str(tmp_path / "home")},
            capture_output=True,
            text=True,
            check=False,
        )
        outcomes = {
            name: outcome
            for outcome, name in re.findall(
                r"(Passed|Failed|Skipped)\n- hook id: (\S+)", ended.stdout
            )
        }
        assert outcomes == {
            name: "Failed" if name in expected else "Passed" for name in arguments
        }, ended
