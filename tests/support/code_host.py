"""A repository as a code host has it, clones as its runners make them, and the steps of their jobs.

The steps are those of ``action.yml`` and ``templates/sros.yml``; only the installation of sros is
left out: the Python of this checkout takes its place.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from tests.support.harness import publish, subscribe

PROJECT = Path(__file__).parents[2]
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
POLICY, REQUIRED = "robot/robot.policy.xml", "robot/robot.requirements.toml"


def policy(enclaves: Mapping[str, str]) -> str:
    """Return the text of a policy, with the rights of a node for each of the enclaves.

    The node has the name of its enclave.
    """
    parts = "".join(
        f'<enclave path="{path}"><profiles>\n<profile ns="/" node="{path.rpartition("/")[2]}">'
        f"{NODE}{rights}\n</profile></profiles></enclave>\n"
        for path, rights in enclaves.items()
    )
    return (
        '<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude"><enclaves>\n'
        f"{parts}</enclaves></policy>\n"
    )


BEFORE = {
    "/mux": publish("/cmd_vel"),
    "/web": publish("/status"),
    "/base": subscribe("/cmd_vel"),
}
WIDER = {**BEFORE, "/web": publish("/status", "/cmd_vel")}


class Origin:
    """A repository with a robot's policy, and clones of it as a code host makes them."""

    def __init__(self, folder: Path) -> None:
        """Make the repository, with one commit."""
        self.folder = folder / "origin"
        shutil.copytree(PROJECT / "policies/common", self.folder / "robot/common")
        (self.folder / REQUIRED).write_text(REQUIREMENTS)
        self.python = folder / "python"
        words = f'exec {shlex.quote(sys.executable)} "$@"'
        self.python.write_text(f"#!/bin/sh\n{words}\n")
        self.python.chmod(0o755)
        self.environment = {
            "PATH": os.environ["PATH"],
            "HOME": str(folder),
            "GIT_CONFIG_NOSYSTEM": "1",
            **AUTHOR,
        }
        self.git("init", "--quiet", "--initial-branch", "main")
        self.git("config", "uploadpack.allowAnySHA1InWant", "true")
        self.base = self.commit({POLICY: policy(BEFORE)})

    def git(self, *words: object, cwd: Path | None = None) -> str:
        """Return what git prints."""
        ended = subprocess.run(
            ["git", *map(str, words)],
            cwd=cwd or self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return ended.stdout.strip()

    def commit(self, files: Mapping[str, str | None], branch: str = "main") -> str:
        """Commit files, None to delete, on a branch that begins at the base; return the commit.

        The branch merged/BRANCH is what GitHub checks out for a pull request: a merge into main.
        """
        if branch != "main":
            self.git("checkout", "--quiet", "-B", branch, self.base)
        for path, text in files.items():
            place = self.folder / path
            if text is None:
                place.unlink()
            else:
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_text(text)
        self.git("add", "--all", "--force")
        self.git("commit", "--quiet", "--allow-empty", "--message", "Change the policy")
        if branch != "main":
            self.merge(branch, self.base)
        return self.git("rev-parse", "HEAD")

    def merge(self, branch: str, into: str) -> None:
        """Make the branch merged/BRANCH, a merge into a commit with all that the branch has."""
        words = (f"{branch}^{{tree}}", "-p", into, "-p", branch, "-m", "Merge")
        merged = self.git("commit-tree", *words)
        self.git("update-ref", f"refs/heads/merged/{branch}", merged)

    def clone(self, folder: Path, branch: str, *, depth: int = 1) -> Path:
        """Return a shallow clone of a branch, as `actions/checkout` and GitLab make them."""
        where = f"file://{self.folder}"
        self.git("clone", "--quiet", "--depth", depth, "--branch", branch, where, folder)
        return folder


@dataclass(frozen=True)
class Job:
    """What a step of a job runs, and where: ``words`` is a command, which ends with a script."""

    words: Sequence[str]
    folder: Path
    environment: Mapping[str, str]
    temp: Path
    files: Mapping[str, Path] = field(default_factory=dict)

    def run(self, *before: str) -> subprocess.CompletedProcess[str]:
        """Run it, as the argument of another command if words are given ``before`` it."""
        ended = subprocess.run(
            [*before, *self.words],
            cwd=self.folder,
            env=dict(self.environment),
            capture_output=True,
            text=True,
            check=False,
        )
        assert "Traceback" not in ended.stderr, ended.stderr
        return ended


def expanded(text: str, values: Mapping[str, str]) -> str:
    """Return a text with its expressions replaced, as a code host does; each has to be known."""
    return re.sub(
        r"\$\{\{ ([\w.-]+) \}\}|\$\[\[ ([\w.-]+) \]\]", lambda m: values[m[1] or m[2]], text
    )


def action() -> Any:
    """Return the action."""
    return yaml.safe_load((PROJECT / "action.yml").read_text())


def _named(inputs: Mapping[str, str], known: Mapping[str, Any]) -> dict[str, str]:
    found = {name.replace("_", "-"): value for name, value in inputs.items()}
    assert not set(found) - set(known), found
    return found


def action_job(origin: Origin, clone: Path, *, event_base: str = "", **inputs: str) -> Job:
    """Return the step of the action after the installation, for a pull request.

    ``event_base`` is the base that the event has, which can be older than the target branch.
    """
    found = action()
    temp = clone.with_name(f"{clone.name}.temp")
    (temp / "sros" / "bin").mkdir(parents=True)
    (temp / "sros" / "bin" / "python").symlink_to(origin.python)
    files = {name: temp / name for name in ("GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY")}
    for file in files.values():
        file.touch()
    given = _named(inputs, found["inputs"])
    values = {
        "github.event.pull_request.base.sha": event_base or origin.base,
        "github.event_name": "pull_request",
        "github.sha": origin.git("rev-parse", "HEAD", cwd=clone / inputs.get("checkout", "")),
        "runner.temp": str(temp),
    }
    for name, spec in found["inputs"].items():
        values[f"inputs.{name}"] = given.get(name, expanded(spec["default"], values))
    install, review = found["runs"]["steps"]
    assert "pip" in install["run"]
    return Job(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", review["run"]],
        clone,
        {
            **origin.environment,
            **{name: str(path) for name, path in files.items()},
            "GITHUB_ACTION_PATH": str(PROJECT),
            "GITHUB_WORKSPACE": str(clone),
            "RUNNER_TEMP": str(temp),
            **{name: expanded(text, values) for name, text in review["env"].items()},
        },
        temp,
        files,
    )


def gitlab() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the inputs and the job of the template."""
    spec, jobs = yaml.safe_load_all((PROJECT / "templates/sros.yml").read_text())
    return spec["spec"]["inputs"], jobs["sros-review"]


def gitlab_job(origin: Origin, clone: Path, **inputs: str) -> Job:
    """Return the job of the template, without the lines that install sros."""
    known, job = gitlab()
    given = _named(inputs, known)
    values = {f"inputs.{name}": str(each.get("default", "")) for name, each in known.items()}
    values |= {f"inputs.{name}": text for name, text in given.items()}
    environment = {name: expanded(text, values) for name, text in job["variables"].items()}
    for variable, text in environment.items():
        environment[variable] = text.replace("$CI_MERGE_REQUEST_DIFF_BASE_SHA", origin.base)
    (script,) = job["script"]
    install = re.findall(r"(?m)^.*(?:-m venv|-m pip) .*\n", script)
    assert len(install) == 2, install
    for line in install:
        assert " -I " in line
        script = script.replace(line, "")
    python = '"$results/python/bin/python"'
    assert script.count(python) == 1
    script = script.replace(python, shlex.quote(str(origin.python)))
    temp = clone.with_name(f"{clone.name}.temp")
    temp.mkdir()
    return Job(
        ["bash", "-eo", "pipefail", "-c", script],
        clone,
        {
            **origin.environment,
            "CI_PROJECT_DIR": str(clone),
            "TMPDIR": str(temp),
            **environment,
        },
        temp,
    )
