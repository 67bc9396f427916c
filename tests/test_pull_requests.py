"""The action, the template and the hooks, run as a user runs them: in clones with a git history."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic_sarif.model import StaticAnalysisResultsFormatSarifVersion210JsonSchema as Sarif

from tests.support.harness import publish, sros

PROJECT = Path(__file__).parents[1]
SCRIPT = PROJECT / "templates" / "review.sh"
NODE = '<xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/>'
REQUIREMENTS = """[[only]]
publish = ["/cmd_vel"]
enclaves = ["/mux"]
why = "one way to the wheels"
"""
AUTHOR = {
    f"GIT_{role}_{what}": value
    for role in ("AUTHOR", "COMMITTER")
    for what, value in (("NAME", "A"), ("EMAIL", "a@example.org"))
}


def policy(enclaves: Mapping[str, str]) -> str:
    parts = "".join(
        f'<enclave path="{path}"><profiles>\n<profile ns="/" node="n">{NODE}{rights}\n</profile>'
        "</profiles></enclave>\n"
        for path, rights in enclaves.items()
    )
    return (
        '<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude"><enclaves>\n'
        f"{parts}</enclaves></policy>\n"
    )


BEFORE = {"/mux": publish("/cmd_vel"), "/web": publish("/status")}
WIDER = {"/mux": publish("/cmd_vel"), "/web": publish("/status", "/cmd_vel")}


class Origin:
    """A repository with a robot's policy, and clones of it as a code host makes them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "origin"
        shutil.copytree(PROJECT / "policies/common", self.folder / "robot/common")
        (self.folder / "robot/robot.requirements.toml").write_text(REQUIREMENTS)
        programs = folder / "bin"
        programs.mkdir()
        program = programs / "sros"
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m sros_tool "$@"\n')
        program.chmod(0o755)
        self.environment = {
            "PATH": f"{programs}:{os.environ['PATH']}",
            "PYTHONPATH": str(PROJECT),
            "HOME": str(folder),
            "GIT_CONFIG_NOSYSTEM": "1",
            **AUTHOR,
        }
        self.git("init", "--quiet", "--initial-branch", "main")
        self.git("config", "uploadpack.allowAnySHA1InWant", "true")
        self.base = self.commit(policy(BEFORE))

    def git(self, *words: object, cwd: Path | None = None) -> str:
        ended = subprocess.run(
            ["git", *map(str, words)],
            cwd=cwd or self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return ended.stdout.strip()

    def commit(self, text: str, branch: str = "main") -> str:
        """Commit the policy on a branch that begins at the base; return the commit."""
        if branch != "main":
            self.git("checkout", "--quiet", "-B", branch, self.base)
        (self.folder / "robot/robot.policy.xml").write_text(text)
        self.git("add", "--all")
        self.git("commit", "--quiet", "--allow-empty", "--message", "Change the policy")
        return self.git("rev-parse", "HEAD")

    def clone(self, folder: Path, branch: str, *, depth: int = 1) -> Path:
        """Return a shallow clone of a branch, as `actions/checkout` and GitLab make them."""
        where = f"file://{self.folder}"
        self.git("clone", "--quiet", "--depth", depth, "--branch", branch, where, folder)
        return folder


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Origin:
    made = Origin(tmp_path_factory.mktemp("origin"))
    made.commit(policy(WIDER), "wider")
    made.commit(policy(BEFORE).replace("ALLOW", "PERMIT"), "broken")
    return made


def expanded(text: str, values: Mapping[str, str]) -> str:
    """Return a text with its expressions replaced, as a code host does; each has to be known."""
    return re.sub(
        r"\$\{\{ ([\w.-]+) \}\}|\$\[\[ ([\w.-]+) \]\]", lambda m: values[m[1] or m[2]], text
    )


def run_action(origin: Origin, clone: Path, **inputs: str) -> tuple[int, str, dict[str, str]]:
    """Run the steps of the action but the installation; return status, summary and outputs."""
    action = yaml.safe_load((PROJECT / "action.yml").read_text())
    temp = clone.with_name(f"{clone.name}.temp")
    temp.mkdir()
    files = {name: temp / name for name in ("GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY", "GITHUB_PATH")}
    values = {"github.event.pull_request.base.sha": origin.base, "runner.temp": str(temp)}
    for name, spec in action["inputs"].items():
        assert not (
            unknown := set(inputs) - {each.replace("-", "_") for each in action["inputs"]}
        ), unknown
        given = inputs.get(name.replace("-", "_"), spec.get("default"))
        assert given is not None, f"{name} is required"
        values[f"inputs.{name}"] = expanded(given, values)
    install, review = action["runs"]["steps"]
    assert "pip" in install["run"]
    assert not re.search(r"python3 (?!-I )", install["run"] + review["run"])
    environment = {name: expanded(text, values) for name, text in review["env"].items()}
    ended = subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", review["run"]],
        cwd=clone,
        env={
            **origin.environment,
            **{name: str(path) for name, path in files.items()},
            "GITHUB_ACTION_PATH": str(PROJECT),
            **environment,
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in ended.stderr
    begin, *printed, end = ended.stdout.splitlines()
    assert begin.removeprefix("::stop-commands::") == end.strip(":")
    assert not printed
    outputs = dict(line.split("=", 1) for line in files["GITHUB_OUTPUT"].read_text().splitlines())
    for name, spec in action["outputs"].items():
        assert spec["value"] == f"${{{{ steps.{review['id']}.outputs.{name} }}}}"
    summary = files["GITHUB_STEP_SUMMARY"].read_text()
    assert summary == Path(outputs["summary"]).read_text()
    assert len(summary) < 65_536
    return ended.returncode, summary + ended.stderr, outputs


ALL = {
    "policy": "robot/robot.policy.xml",
    "requirements": "robot/robot.requirements.toml",
}


def test_the_action_on_pull_requests(origin: Origin, tmp_path: Path) -> None:
    status, said, _ = run_action(origin, origin.clone(tmp_path / "same", "main"), **ALL)
    assert status == 0, said
    assert "### Findings: nothing found" in said

    status, said, outputs = run_action(origin, origin.clone(tmp_path / "wider", "wider"), **ALL)
    assert status == 1, said
    assert "`/web ALLOW publish topic /cmd_vel`" in said
    assert "```mermaid" in said
    assert "requirement.violated" in said
    log = json.loads(Path(outputs["sarif"]).read_text())
    Sarif.model_validate(log)
    results = log["runs"][0]["results"]
    places = [e["physicalLocation"] for each in results for e in each.get("locations", [])]
    assert "robot/robot.policy.xml" in {e["artifactLocation"]["uri"] for e in places}

    words = {**ALL, "requirements": ""}
    clone = origin.clone(tmp_path / "allowed", "wider")
    status, said, _ = run_action(origin, clone, **words)
    assert status == 1, "new access alone is enough"
    shutil.rmtree(tmp_path / "allowed.temp")
    status, said, _ = run_action(origin, clone, **words, new_access="allow")
    assert status == 0, said
    assert "/web ALLOW publish topic /cmd_vel" in said

    status, said, _ = run_action(origin, origin.clone(tmp_path / "broken", "broken"), **ALL)
    assert status != 0, said


def test_requirements_that_a_pull_request_drops_are_decided(origin: Origin, tmp_path: Path) -> None:
    clone = origin.clone(tmp_path / "dropped", "wider")
    file = clone / ALL["requirements"]
    file.write_text(REQUIREMENTS.replace("/mux", "/*"))
    status, said, _ = run_action(origin, clone, **ALL)
    assert status == 1, said
    assert "requirements change" in said
    assert "but only /mux may publish /cmd_vel" in said
    shutil.rmtree(tmp_path / "dropped.temp")
    status, said, _ = run_action(origin, clone, **ALL, new_access="allow")
    assert status == 0, said


def test_the_installation_runs_nothing_of_the_pull_request(tmp_path: Path) -> None:
    install, _ = yaml.safe_load((PROJECT / "action.yml").read_text())["runs"]["steps"]
    (line,) = (each for each in install["run"].splitlines() if "-m venv" in each)
    for name in ("venv", "ensurepip", "secrets"):
        (tmp_path / f"{name}.py").write_text("open('sprung', 'w')")
    words = line.replace('"$RUNNER_TEMP/sros"', "--help")
    environment = {"PATH": os.environ["PATH"]}
    subprocess.run(words, shell=True, cwd=tmp_path, env=environment, check=True)
    assert not (tmp_path / "sprung").exists()


def test_what_cannot_be_compared_fails(origin: Origin, tmp_path: Path) -> None:
    clone = origin.clone(tmp_path / "clone", "main")
    status, said, _ = run_action(origin, clone, **ALL, base="0" * 40)
    assert status == 2
    assert "nothing can be compared" in said


def test_certificates_in_the_action(origin: Origin, tmp_path: Path) -> None:
    clone = origin.clone(tmp_path / "clone", "main")
    sros("generate_artifacts", "-k", clone / "ks", "-p", clone / ALL["policy"]).ok()
    words = {**ALL, "base": "", "keystore": "ks"}
    status, said, _ = run_action(origin, clone, **words, renew_within="9000d")
    assert status == 1
    assert "### Certificates: 2 enclaves need to be renewed" in said


def gitlab() -> tuple[dict[str, Any], dict[str, Any]]:
    spec, jobs = yaml.safe_load_all((PROJECT / "templates/sros.yml").read_text())
    return spec["spec"]["inputs"], jobs["sros-review"]


def test_the_job_of_gitlab(origin: Origin, tmp_path: Path) -> None:
    inputs, job = gitlab()
    (script,) = job["script"]
    assert script == SCRIPT.read_text(), "both code hosts run the same script"
    values = {f"inputs.{name}": str(each.get("default", "")) for name, each in inputs.items()}
    values |= {f"inputs.{name}": text for name, text in ALL.items()}
    environment = {name: expanded(text, values) for name, text in job["variables"].items()}
    for variable, text in environment.items():
        environment[variable] = text.replace("$CI_MERGE_REQUEST_DIFF_BASE_SHA", origin.base)
    clone = origin.clone(tmp_path / "clone", "wider", depth=20)
    ended = subprocess.run(
        ["bash", "-eo", "pipefail", "-c", script],
        cwd=clone,
        env={**origin.environment, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1, ended
    assert "requirement.violated" in (clone / "sros-review.md").read_text()
    assert all((clone / each).is_file() for each in job["artifacts"]["paths"])
    assert not origin.git("worktree", "list", cwd=clone).partition("\n")[2]


def test_the_files_fit_their_schemas(tmp_path: Path) -> None:
    (tmp_path / "gitlab.yml").write_text(yaml.safe_dump({"sros-review": gitlab()[1]}))
    for name, file in (
        ("github-actions", PROJECT / "action.yml"),
        ("gitlab-ci", tmp_path / "gitlab.yml"),
    ):
        words = ["--builtin-schema", f"vendor.{name}", str(file)]
        subprocess.run([sys.executable, "-m", "check_jsonschema", *words], check=True)
    words = ["-m", "pre_commit", "validate-manifest", str(PROJECT / ".pre-commit-hooks.yaml")]
    subprocess.run([sys.executable, *words], check=True)


def test_the_hooks(origin: Origin, tmp_path: Path) -> None:
    """Each as it is, but with the sros of this checkout, so that nothing has to be installed."""
    hooks = yaml.safe_load((PROJECT / ".pre-commit-hooks.yaml").read_text())
    arguments: dict[str, list[str]] = {
        "sros-policy": ["--"],
        "sros-requirements": [ALL["policy"], "--requirements", ALL["requirements"]],
        "sros-no-new-access": [f"git:{origin.base}:{ALL['policy']}", ALL["policy"]],
    }
    assert [each["id"] for each in hooks] == list(arguments)
    assert hooks[0]["args"] == ["--"], "a file of the pull request is no option"
    local = [{**each, "language": "system", "args": arguments[each["id"]]} for each in hooks]
    failing: dict[str, set[str]] = {
        "main": set(),
        "wider": {"sros-requirements", "sros-no-new-access"},
        "broken": set(arguments),
    }
    for branch, expected in failing.items():
        clone = origin.clone(tmp_path / branch, branch, depth=20)
        config = {"repos": [{"repo": "local", "hooks": local}]}
        (clone / "config.yaml").write_text(yaml.safe_dump(config))
        words = ("run", "--config", "config.yaml", "--all-files", "--hook-stage", "manual")
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
