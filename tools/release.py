"""The check before a release: what is in the packages, and whether they work where they install.

It builds the sdist, and the wheel from it, and installs the wheel with every Python 3.11 to 3.14
that is here, without extras and with each of them, in environments of its own.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tools.record import PYTHON
from tools.steps import CHECKOUT, SetupError, output_of, say

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
EXTRAS = {
    "": "sros_tool.cli.program",
    "fetch": "tuf.ngclient",
    "fleet": "ansible",
    "pkcs11": "pkcs11",
    "ros": "rclpy",
    "ros-kilted": "rclpy",
    "zenoh": "zenoh",
}
"""The extras of the package, with a module that each of them brings."""

_UNWANTED_NAME = re.compile(
    r"(^|/)(\.(?!(?:gitignore|npmrc|pre-commit-hooks\.yaml)$)[^/]*|__pycache__|node_modules|"
    r"[^/]*\.(pyc|so|orig|rej|key|p12|p7s))(/|$)"
)
_PRIVATE = (b"PRIVATE KEY-----\nM", b"OPENSSH PRIVATE KEY-----\nb3Bl")
_MAY_HAVE_KEYS = re.compile(r"/tests/")
_SMOKE: tuple[tuple[str, ...], ...] = (
    ("--version",),
    ("policies", "--copy", "policies"),
    ("generate_artifacts", "-k", "ks", "-p", "policies/talker_listener.xml"),
    ("create_keystore", "production", "--template", "production"),
    ("check", "keystore", "production"),
    ("explain", "ks", "/talker_listener/talker", "publish", "/chatter"),
    ("view", "ks", "--format", "svg"),
)
"""Verbs that every installation can run, with exit status 0."""
_PATIENCE = 1800


GALAXY = "ansible_collections/sros/fleet/galaxy.yml"
_MANUAL = ".data/data/share/man/man1/sros.1"


def problems_of(files: Mapping[str, bytes], *, wheel: bool) -> Iterator[str]:
    """Yield what should not be in a package, by the names and contents of its files."""
    top = {name.split("/")[0] for name in files if not name.endswith(_MANUAL)}
    strange = {each for each in top if each != "sros_tool" and not each.endswith(".dist-info")}
    if wheel and strange:
        yield f"{', '.join(sorted(strange))}: not a part of the package"
    places = {
        bytes(CHECKOUT),
        *(os.fsencode(each) for each in (Path.home(),) if len(str(each)) > 5),
    }
    for name, content in files.items():
        if _UNWANTED_NAME.search(name.partition("/")[2] if not wheel else name):
            yield f"{name}: not for others"
        if any(each in content for each in _PRIVATE) and (wheel or not _MAY_HAVE_KEYS.search(name)):
            yield f"{name}: a private key"
        if any(place in content for place in places):
            yield f"{name}: names a folder of this machine"


def versions() -> dict[str, str]:
    """Return the version of the package, by each file of the checkout that states it."""
    read = {
        "pyproject.toml": r'^version = "(.+)"$',
        "sros_tool/__init__.py": r'^__version__ = "(.+)"$',
        "package.xml": r"<version>(.+)</version>",
        GALAXY: r"^version: (.+)$",
        "CHANGELOG.md": r"^## \[(\d.*?)\]",
    }
    found = {}
    for name, pattern in read.items():
        match = re.search(pattern, (CHECKOUT / name).read_text(), re.MULTILINE)
        found[name] = match[1] if match else "none"
    return found


def version_problems(stated: Mapping[str, str]) -> list[str]:
    """Return what is wrong with the version in each file, of a release or after the last one.

    After a release, the version is that of the next one with ``.dev0`` (PEP 440), which
    package.xml cannot say (REP 149), and the changelog still begins with the last release.
    """
    version = stated["pyproject.toml"]
    release, is_after, _ = version.partition(".dev")
    expected = dict.fromkeys(stated, version)
    if is_after:
        expected |= {GALAXY: version.replace(".dev", "-dev"), "package.xml": release}
        del expected["CHANGELOG.md"]
    return [
        f"{name} states version {stated[name]}, not {wanted}"
        for name, wanted in expected.items()
        if stated[name] != wanted
    ]


def check() -> int:
    """Check a release of this checkout; return the exit status."""
    stated = versions()
    bad = version_problems(stated)
    if ".dev" in stated["pyproject.toml"]:
        bad.append(f"{stated['pyproject.toml']} is no version of a release")
    with tempfile.TemporaryDirectory(prefix="sros-release-") as folder:
        wheel = _built(Path(folder))
        for package in Path(folder).glob("sros_tool-*"):
            bad += [f"{package.name}: {each}" for each in _package_problems(package)]
        pythons = dict(_pythons())
        for version in PYTHONS:
            if version not in pythons:
                say(f"Python {version}: not here")
        for version, python in pythons.items():
            for extra in EXTRAS:
                what = f"Python {version}{', with ' + extra if extra else ''}"
                problem = _tried(Path(folder), python, wheel, extra)
                say(f"{what}: {problem or 'works'}")
                if problem and not problem.startswith("cannot be had"):
                    bad.append(f"{what}: {problem}")
    for each in bad:
        print(f"release-check: {each}", file=sys.stderr)
    return 1 if bad else 0


def _built(folder: Path) -> Path:
    """Build the sdist, and the wheel from it; return the wheel."""
    say("building the sdist and the wheel")
    ended = _run([str(PYTHON), "-m", "build", "--outdir", str(folder), str(CHECKOUT)], folder)
    if ended.returncode:
        raise SetupError(f"the package cannot be built:\n{ended.stdout[-2000:]}")
    (wheel,) = folder.glob("*.whl")
    return wheel


def _package_problems(package: Path) -> list[str]:
    if package.suffix == ".whl":
        with zipfile.ZipFile(package) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        return list(problems_of(files, wheel=True))
    files = {}
    with tarfile.open(package) as archive:
        for member in archive:
            content = archive.extractfile(member) if member.isfile() else None
            files[member.name] = content.read() if content else b""
    return list(problems_of(files, wheel=False))


def _pythons() -> Iterator[tuple[str, str]]:
    """Yield each version of Python that is in PATH or installed by pyenv, with its program."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for version in PYTHONS:
        of_pyenv = map(str, sorted(pyenv.glob(f"{version}.*/bin/python")))
        for each in filter(None, (shutil.which(f"python{version}"), *of_pyenv)):
            ask = "import sys, ensurepip; print('%d.%d' % sys.version_info[:2])"
            if (output_of([each, "-I", "-c", ask]) or "").strip() == version:
                yield version, each
                break


def _tried(folder: Path, python: str, wheel: Path, extra: str) -> str:
    """Install the wheel in an environment of its own and run it; return the problem, or ""."""
    place = Path(tempfile.mkdtemp(dir=folder))
    try:
        bin_folder = place / "venv/bin"
        if _run([python, "-I", "-m", "venv", str(place / "venv")], place).returncode:
            return "has no venv"
        wanted = f"{wheel}[{extra}]" if extra else str(wheel)
        pip = [str(bin_folder / "python"), "-I", "-m", "pip", "install", "-q", wanted]
        installed = _run(pip, place)
        if installed.returncode:
            no_wheel = re.search(r"No matching distribution found for (\S+)", installed.stdout)
            if extra and no_wheel:
                return f"cannot be had: no {no_wheel[1]} for this Python"
            return f"does not install: {installed.stdout[-500:]}"
        module = _run([str(bin_folder / "python"), "-I", "-c", f"import {EXTRAS[extra]}"], place)
        if module.returncode:
            return f"has no {EXTRAS[extra]}: {module.stdout[-500:]}"
        words = _SMOKE if extra else (*_SMOKE, *_demo())
        for each in words:
            ended = _run([str(bin_folder / "sros"), *each], place)
            if ended.returncode:
                return f"sros {' '.join(each)} ends with {ended.returncode}: {ended.stdout[-500:]}"
        return ""
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _demo() -> tuple[tuple[str, ...], ...]:
    """Return the demo as the commands to run: on Cyclone DDS, which needs no package of Python."""
    return (("demo", "--backend", "cyclone"),)


def _run(command: Sequence[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command as a user would who has only the package; its output is in ``stdout``."""
    left = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}
    environment = {name: each for name, each in os.environ.items() if name not in left}
    return subprocess.run(
        command,
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=_PATIENCE,
        encoding="utf-8",
        errors="replace",
        check=False,
    )


def extras() -> set[str]:
    """Return the extras that pyproject.toml has for users."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    return {"", *project["optional-dependencies"]} - {"test", "docs"}
