"""A pull request that tries to steer its own review, run as the runners of code hosts run it.

The jobs of ``action.yml`` and ``templates/sros.yml`` run as root, in a namespace of mounts in which
``/etc`` can be written.  One repository has all tricks.  A naive reader springs each trap in a
namespace of its own, which shows that the trap works.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.support.code_host import POLICY, REQUIRED, Job, Origin, action_job, gitlab_job, policy
from tests.support.harness import publish
from tests.support.long_form import some

MARKS = "/run/sros-marks"
"""The folder in which a trap that springs makes a file of its name."""
NODE = f'<profile ns="/" node="n">{publish("/rosout")}</profile>'


@dataclass(frozen=True)
class Trap:
    """What a pull request brings so that something runs or is written.

    ``files`` and ``links`` are by path; ``settings`` are of the clone's own git, which a pull
    request can set only by an earlier step of the job.  ``naive`` are commands, in the checkout,
    that a reader could run without thought; "" if there is none that is harmless to run.  The trap
    has sprung if ``mark``, or the file of its name in `MARKS`, exists.
    """

    name: str
    naive: str
    files: dict[str, str] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    settings: dict[str, str] = field(default_factory=dict)
    mark: str = ""
    executable: bool = False

    @property
    def sprung(self) -> str:
        return self.mark or f"{MARKS}/{self.name}"


def _python(name: str) -> str:
    return (
        f"import os\nos.makedirs({MARKS!r}, exist_ok=True)\nopen('{MARKS}/{name}', 'w').close()\n"
    )


def _shell(name: str) -> str:
    return f"#!/bin/sh\nmkdir -p {MARKS}; : >{MARKS}/{name}\n"


def _module(name: str, path: str, naive: str = "") -> Trap:
    return Trap(name, naive or f"python3 -c 'import {name}'", {path: _python(name)})


def _program(name: str) -> Trap:
    return Trap(f"program-{name}", f"PATH=.:$PATH {name} --version",
                {name: _shell(f"program-{name}")}, executable=True)  # fmt: skip


def _link(name: str, path: str, target: str, naive: str) -> Trap:
    return Trap(name, naive, links={path: target}, mark=target)


def _setting(key: str, naive: str) -> Trap:
    return Trap(key, naive, settings={key: f"{MARKS}.programs/{key}"})


TRAPS = (
    # modules that Python would import from the working directory
    _module("venv", "venv.py", "python3 -m venv --help"),
    _module("ensurepip", "ensurepip.py"),
    _module("secrets", "secrets.py"),
    _module("pip", "pip.py", "python3 -m pip --version"),
    _module("click", "click.py"),
    _module("lxml", "lxml/__init__.py"),
    _module("sros_tool", "sros_tool/__init__.py", "python3 -m sros_tool"),
    _module("tomllib", "tomllib.py"),
    _module("sitecustomize", "sitecustomize.py", "PYTHONPATH=. python3 -c 1"),
    _module("usercustomize", "usercustomize.py"),
    _module("setup", "setup.py", "python3 setup.py"),
    # programs that a shell would find, and files that it would read
    *map(_program, ("git", "python3", "sros", "mktemp", "cat", "cp")),
    Trap("env", ". ./.env", {".env": _shell("env")}),
    Trap("profile", "HOME=. bash -l -c :", {".bash_profile": _shell("profile")}),
    Trap("bash-env", "BASH_ENV=./.bashrc bash -c :", {".bashrc": _shell("bash-env")}),
    Trap("script", "sh templates/review.sh", {"templates/review.sh": _shell("script")}),
    # links at the places of results, out of the checkout
    _link("summary", "review.md", "/etc/ld.so.preload-1", "echo x >>review.md"),
    _link("sarif", "review.sarif", "/etc/ld.so.preload-2", "echo x >>review.sarif"),
    _link("folder", "sros-review", "/etc/sros-folder", "mkdir -p /etc/sros-folder; cp .env "
          "sros-review/review.md; rm -r /etc/sros-folder; mkdir /etc/sros-folder"),
    _link("preload", "sros-review.md", "/etc/ld.so.preload-3", "echo x >sros-review.md"),
    _link("temporary", "tmp", "/etc/sros-temporary", "mkdir /etc/sros-temporary; : >tmp/x"),
    # git: hooks, filters and programs of a configuration, and repositories in the repository
    _setting("core.fsmonitor", "git status"),
    _setting("diff.external", "git rm -q --cached .env; git diff --cached"),
    _setting("filter.trap.smudge", "rm .env; git checkout -- .env"),
    _setting("alias.trap", ""),
    _setting("gpg.program", "git commit-tree -Sx 'HEAD^{tree}' -m x"),
    Trap("hook", "git checkout -q -f HEAD", {"hooks/post-checkout": _shell("hook")},
         settings={"core.hooksPath": "hooks"}, executable=True),
    Trap("embedded", "git -C embedded status",
         {"embedded/HEAD": "ref: refs/heads/main\n", "embedded/objects/x": "",
          "embedded/refs/x": "",
          "embedded/config": f"[core]\n\trepositoryformatversion = 0\n\tbare = false\n"
          f"\tworktree = ..\n\tfsmonitor = \"mkdir -p {MARKS}; : >{MARKS}/embedded\"\n"}),
    Trap("makefile", "make", {"Makefile": f"all:\n\tmkdir -p {MARKS}; : >{MARKS}/makefile\n"}),
    Trap("attributes", "", {".gitattributes": "* filter=trap diff=trap\n"}),
    Trap("modules", "", {".gitmodules": f'[submodule "x"]\n\tpath = x\n\turl = "ext::touch '
                         f'{MARKS}/modules"\n\tupdate = "!touch {MARKS}/modules"\n'}),
    Trap("lfs", "", {".lfsconfig": f"[lfs]\n\turl = \"ext::touch {MARKS}/lfs\"\n"}),
)  # fmt: skip


LIES = "robot/lies"


@dataclass(frozen=True)
class Lie:
    """What a pull request brings so that the review says nothing of rights that it adds.

    ``policy`` is named in the job; ``said`` is in the review.
    """

    name: str
    said: str
    plant: Callable[[Origin, Path], object]


def _text(text: str, path: str = "") -> Callable[[Origin, Path], None]:
    def plant(_: Origin, folder: Path) -> None:
        file = folder / path if path else folder / "robot.policy.xml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    return plant


def _to(target: str, path: str = "robot.policy.xml") -> Callable[[Origin, Path], None]:
    def plant(_: Origin, folder: Path) -> None:
        (folder / path).unlink(missing_ok=True)
        (folder / path).symlink_to(target)

    return plant


def _including(href: str) -> str:
    return policy({"/x": ""}).replace("common/node.xml", href)


def _and(*plants: Callable[[Origin, Path], None]) -> Callable[[Origin, Path], None]:
    def plant(origin: Origin, folder: Path) -> None:
        for each in plants:
            each(origin, folder)

    return plant


def _module_of_git(origin: Origin, folder: Path) -> None:
    entry = f"160000,{origin.base},{(folder / 'robot.policy.xml').relative_to(origin.folder)}"
    (folder / "robot.policy.xml").unlink()
    origin.git("update-index", "--add", "--cacheinfo", entry)


FALLBACK = "<xi:include href='{}'><xi:fallback/></xi:include>"
LIE_TABLE = (
    Lie("link to a file", "is a symbolic link", _to("../../robot.policy.xml")),
    Lie("absolute link", "is a symbolic link", _to("/etc/passwd")),
    Lie("include of a link", "is a symbolic link",
        _and(_text(_including("linked.xml")), _to("../../common/node.xml", "linked.xml"))),
    Lie("include through a link", "is not a folder in the commit",
        _and(_text(_including("linked/node.xml")), _to("../../common", "linked"))),
    Lie("include of another folder", "leaves the folder of the policy",
        _text(_including("../../common/node.xml"))),
    Lie("include of a file of the runner", "leaves the folder of the policy",
        _text(_including("/etc/passwd"))),
    Lie("fallback for a link", "is a symbolic link",
        _and(_text(policy({"/x": FALLBACK.format("evil.xml")})), _to("/etc/evil.xml", "evil.xml"))),
    Lie("entity of a file", "entities could pull other files",
        _text(f'<!DOCTYPE p [<!ENTITY x SYSTEM "/etc/passwd">]>{policy({"/x": ""})}')),
    Lie("pointer of LFS", "cannot be", _text("version https://git-lfs.github.com/spec/v1\n"
                                      "oid sha256:" + "0" * 64 + "\nsize 9\n")),
    Lie("submodule", "is a submodule", _module_of_git),
    Lie("gone", "If it is renamed, give --policy the folder",
        lambda _, folder: (folder / "robot.policy.xml").unlink()),
    Lie("another name", "The change renames it to 'robot/lies/another name/other.xml'",
        lambda _, folder: (folder / "robot.policy.xml").rename(folder / "other.xml")),
)  # fmt: skip


@dataclass(frozen=True)
class Ran:
    """A job that has ended, the files that were in a folder afterwards, and its result."""

    ended: subprocess.CompletedProcess[str]
    marks: frozenset[str]
    summary: str


def may_mount() -> bool:
    words = ["unshare", "-m", "sh", "-c", "mount -t tmpfs none /run"]
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or not may_mount(), reason="root and a namespace of mounts are needed"
)

IN_NAMESPACE = """
set -e
mount -t tmpfs none /run
mkdir -p /run/upper /run/work
if ! mount -t overlay none -o lowerdir=/etc,upperdir=/run/upper,workdir=/run/work /etc; then
    cp -a /etc /run/etc; mount --bind /run/etc /etc
fi
mkdir "$MARKS.programs"
for key in $KEYS; do
    printf '#!/bin/sh\nmkdir -p %s; : >%s/%s\n' "$MARKS" "$MARKS" "$key" >"$MARKS.programs/$key"
    chmod 755 "$MARKS.programs/$key"
done
set +e
"$@"
status=$?
for mark in $MARKS_TO_SEE; do
    if [ -e "$mark" ] || [ -L "$mark" ]; then echo "$mark" >>"$SEEN"; fi
done
exit $status
"""


def run_in_namespace(job: Job, seen: Path) -> tuple[
    subprocess.CompletedProcess[str], frozenset[str]
]:  # fmt: skip
    """Run a job as root where /etc can be written; return how it ended, and the marks it left."""
    marks = " ".join(each.sprung for each in TRAPS)
    own = {"SEEN": str(seen), "MARKS_TO_SEE": marks, "MARKS": MARKS}
    own["KEYS"] = " ".join(key for each in TRAPS for key in each.settings)
    environment = {**job.environment, **own}
    whole = Job(job.words, job.folder, environment, job.temp, job.files)
    ended = whole.run("unshare", "-m", "sh", "-c", IN_NAMESPACE, "sh")
    found = seen.read_text().splitlines() if seen.exists() else []
    return ended, frozenset(found)


def plant_traps(folder: Path) -> None:
    for trap in TRAPS:
        for path, text in trap.files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
            if trap.executable:
                (folder / path).chmod(0o755)
        for path, target in trap.links.items():
            (folder / path).symlink_to(target)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Origin:
    """Return a repository whose branch ``hostile`` has all traps and lies."""
    origin = Origin(tmp_path_factory.mktemp("hostile"))
    same = policy({"/x": ""})
    listed = {f"{LIES}/{lie.name}/robot.policy.xml": same.replace("/x", f"/x{number}")
              for number, lie in enumerate(LIE_TABLE)}  # fmt: skip
    for lie in LIE_TABLE:
        listed[f"{LIES}/{lie.name}/common/node.xml"] = NODE
    origin.base = origin.commit(listed)
    origin.commit({}, "hostile")
    plant_traps(origin.folder)
    for lie in LIE_TABLE:
        lie.plant(origin, origin.folder / LIES / lie.name)
    origin.git("add", "--all", "--force", ":!*/submodule/*")
    origin.git("commit", "--quiet", "--message", "Improve the documentation")
    origin.merge("hostile", origin.base)
    return origin


def clone_of(hostile: Origin, folder: Path) -> Path:
    clone = hostile.clone(folder, "merged/hostile")
    for trap in TRAPS:
        for key, value in trap.settings.items():
            hostile.git("config", key, value, cwd=clone)
    return clone


INPUTS = {
    "policy": "\n".join([POLICY, *(f"{LIES}/{lie.name}/robot.policy.xml" for lie in LIE_TABLE)]),
    "requirements": REQUIRED,
}


JOBS = some(["action", "gitlab"], 1)


@pytest.fixture(scope="module")
def reviews(hostile: Origin, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ran]:
    """Return what the jobs did and said."""
    folder = tmp_path_factory.mktemp("runs")
    found = {}
    for name in JOBS:
        clone = clone_of(hostile, folder / name)
        job = (action_job if name == "action" else gitlab_job)(hostile, clone, **INPUTS)
        ended, marks = run_in_namespace(job, folder / f"{name}.seen")
        if name == "action":
            summary = job.files["GITHUB_STEP_SUMMARY"].read_text()
        else:
            assert not (clone / "sros-review").is_symlink()
            summary = (clone / "sros-review" / "review.md").read_text()
        found[name] = Ran(ended, marks, summary)
    return found


@needs_root
@pytest.mark.parametrize("job", JOBS)
def test_no_trap_springs_in_a_job(reviews: dict[str, Ran], job: str) -> None:
    assert reviews[job].ended.returncode == 2, reviews[job]
    assert not reviews[job].marks


@needs_root
def test_each_trap_works(hostile: Origin, tmp_path: Path) -> None:
    """A naive reader springs them: that none springs in a job says something."""
    clone = clone_of(hostile, tmp_path / "clone")
    lines = "\n".join(f"({each.naive}) </dev/null" for each in TRAPS if each.naive)
    job = Job(["bash", "-c", lines], clone, hostile.environment, tmp_path)
    ended, marks = run_in_namespace_naive(job, tmp_path / "seen")
    expected = {each.sprung for each in TRAPS if each.naive}
    assert expected <= marks, (expected - marks, ended.stderr[-3000:])


def run_in_namespace_naive(job: Job, seen: Path) -> tuple[
    subprocess.CompletedProcess[str], frozenset[str]
]:  # fmt: skip
    """As `run_in_namespace`, for a reader that may well end with a traceback."""
    words = ["sh", "-c", f"{shlex.join(job.words)} >/dev/null 2>{job.temp}/said || :"]
    return run_in_namespace(Job(words, job.folder, job.environment, job.temp), seen)


@needs_root
@pytest.mark.parametrize("lie", LIE_TABLE, ids=lambda lie: lie.name)
def test_no_lie_is_believed(reviews: dict[str, Ran], lie: Lie) -> None:
    for ran in reviews.values():
        about = [
            line for line in ran.summary.splitlines() if line.startswith("- ") and lie.name in line
        ]
        assert any(lie.said in line for line in about), about
        assert not any("🟢" in line for line in about if lie.said in line)
