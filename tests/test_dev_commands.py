"""The commands that set up a checkout: what they trust, what they ask for, what they say."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.support.children import PATIENCE
from tools import apt, checks, dds, environment, record, steps
from tools.record import Record
from tools.steps import SetupError

CHECKOUT = Path(__file__).resolve().parent.parent

APT_DEPENDS = {
    "libddsc0debian": "libddsc0debian\n  Depends: libc6\n  Depends: libiceoryx-binding-c2\n",
    "libiceoryx-binding-c2": "libiceoryx-binding-c2\n |Depends: libc6\n  Depends: <libc6-other>\n"
    "  PreDepends: libiceoryx-posh2:any\n",
    "libiceoryx-posh2": "libiceoryx-posh2\n  Depends: libddsc0debian\n  Depends: <virtual>\n"
    " |Depends: <virtual>\n |Depends: real-one\n  Depends: other\n",
}


def start(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["/bin/sh", str(folder / "dev"), *arguments],
        env={"PATH": "/usr/bin:/bin", **variables},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


def fake_python(path: Path, version: str) -> Path:
    """An interpreter that refuses to be new enough and tells its version."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'#!/bin/sh\ncase "$*" in *exit*) exit 1;; *) echo Python {version};; esac\n')
    path.chmod(0o755)
    return path


def changed(found: Record, change: dict[str, Any]) -> Record:
    return replace(found, **change)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of the program alone, in a folder whose name has a space."""
    folder = tmp_path / "a robot"
    folder.mkdir()
    shutil.copy(CHECKOUT / "dev", folder)
    shutil.copytree(CHECKOUT / "tools", folder / "tools")
    shutil.copy(CHECKOUT / "pyproject.toml", folder)
    return folder


@pytest.fixture
def venv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty stand-in for the environment, with a Python that does not run."""
    folder = tmp_path / ".venv"
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "python").touch()
    for module in (record, environment, steps):
        monkeypatch.setattr(module, "VENV", folder)
    for module in (record, environment):
        monkeypatch.setattr(module, "PYTHON", folder / "bin" / "python")
        monkeypatch.setattr(module, "UNFINISHED", folder / "sros-setup.unfinished")
    monkeypatch.setattr(record, "_RECORD", folder / "sros-setup.json")
    monkeypatch.setattr(steps, "LOG", folder / "setup.log")
    return folder


def test_a_python_that_is_too_old_is_named_with_what_to_do(checkout: Path) -> None:
    old = fake_python(checkout / "old" / "python3", "3.9.18")
    answer = start(checkout, "demo", PYTHON=str(old))
    assert answer.returncode == 1
    assert "PYTHON names" in answer.stderr
    assert "Python 3.9.18" in answer.stderr
    assert not (checkout / ".venv").exists()


def test_without_a_fitting_python_the_way_to_one_is_told(checkout: Path) -> None:
    stubs = checkout / "stubs"
    fake_python(stubs / "python3", "3.10.12")
    (stubs / "dirname").symlink_to(shutil.which("dirname") or "/usr/bin/dirname")
    answer = start(checkout, "test", PATH=str(stubs))
    assert answer.returncode == 1
    assert "python3: Python 3.10.12" in answer.stderr
    assert "apt-get install python3 python3-venv" in answer.stderr
    assert answer.stdout == ""
    assert len(answer.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "status"), [((), 2), (("nonsense",), 2), (("--help",), 0), (("help",), 0)]
)
def test_usage_is_told_and_nothing_is_set_up(
    checkout: Path, arguments: tuple[str, ...], status: int
) -> None:
    answer = start(checkout, *arguments, PYTHON=sys.executable)
    assert answer.returncode == status
    assert "Usage: ./dev COMMAND" in (answer.stderr if status else answer.stdout)
    assert not (checkout / ".venv").exists()


def test_a_folder_that_cannot_be_written_is_one_line(checkout: Path) -> None:
    (checkout / "pyproject.toml").unlink()
    answer = start(checkout, "demo", PYTHON=sys.executable)
    assert answer.returncode == 1
    assert answer.stderr.startswith("dev: cannot continue: ")
    assert "pyproject.toml" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_missing_venv_names_the_package(venv: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "_has_venv", lambda: False)
    monkeypatch.setattr(environment, "root_prefix", lambda: None)
    now = Record(checkout="/here", base="/usr/bin/python3.12", version="3.12.3")
    with pytest.raises(SetupError, match=r"sudo apt-get install python3\.12-venv'"):
        environment._make_sure_of_venv(now, 0)


def test_a_record_is_trusted_only_when_the_setup_ended(venv: Path) -> None:
    done = Record(checkout="/here", groups=["package"], dds="/usr/lib/plugins")
    record.write_record(done)
    assert record.read_record() == done
    (venv / "sros-setup.unfinished").touch()
    assert record.read_record() == Record()


@pytest.mark.parametrize("content", ["", "{", "[]", '{"unknown": 1}', "null"])
def test_a_damaged_record_counts_as_none(venv: Path, content: str) -> None:
    (venv / "sros-setup.json").write_text(content)
    assert record.read_record() == Record()


def test_a_setup_holds_until_anything_it_rests_on_changes(venv: Path) -> None:
    now = record.current()
    distribution = f"lib/python{now.version.rpartition('.')[0]}/site-packages/click.dist-info"
    (venv / distribution).mkdir(parents=True)
    done = replace(now, groups=["package", "ros"], distributions=["click.dist-info"], dds="/lib")
    assert record.holds(done, now, ["package"])
    assert not record.holds(done, now, ["package", "test"])
    for name in ("checkout", "base", "version", "requirements", "surroundings"):
        assert not record.holds(changed(done, {name: "other"}), now, ["package"]), name
    (venv / distribution).rmdir()
    assert not record.holds(done, now, ["package"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"checkout": "/old"}, "moved here from /old"),
        ({"version": "3.11.0"}, "Python 3.11.0"),
        ({"base": "/gone/python3"}, "/gone/python3"),
        ({"ros_around": True}, "no longer sourced"),
        ({"requirements": "other"}, None),
        ({"distributions": ["gone"]}, None),
    ],
)
def test_only_what_cannot_be_built_upon_is_made_anew(
    venv: Path, change: dict[str, Any], said: str | None
) -> None:
    now = record.current()
    reason = record.difference(changed(now, change), now)
    assert reason is None if said is None else said in (reason or "")


def test_an_environment_that_a_person_made_is_not_removed(
    venv: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (venv / "pyvenv.cfg").touch()
    monkeypatch.setattr(environment, "output_of", lambda command: "3.99.0\n")
    with pytest.raises(SetupError, match="was not created by"):
        environment._usable(Record(), record.current())
    assert (venv / "pyvenv.cfg").exists()


def test_without_a_fitting_wheel_the_setup_goes_on_without_rclpy(
    venv: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(environment, "succeeds", lambda *_, **__: pytest.fail("pip was asked"))
    assert environment._install("ros", Record(version="3.14.0"), 0)
    assert capsys.readouterr().err.startswith("dev: no rclpy wheel fits Python 3.14.0 on ")
    assert environment._install("ros", Record(version="3.12.3", ros_around=True), 0)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("listed", "settings"),
    [
        ("", {}),
        ("global.timeout='9'\nfreeze.exclude='x'", {}),
        (
            "global.index-url='/a'\nglobal.find-links='\\nx\\ny'\ninstall.index-url='/b'\n"
            ":env:.constraint='c d'",
            {"UV_DEFAULT_INDEX": "/b", "UV_FIND_LINKS": "x,y", "UV_CONSTRAINT": "c d"},
        ),
        (":env:.index-url='/a'\ninstall.index-url='/b'", {"UV_DEFAULT_INDEX": "/a"}),
        ("global.index-url='/a'\nglobal.only-binary=':all:'", None),
        (None, None),
    ],
)
def test_uv_is_told_all_that_pip_was_told_or_not_used(
    listed: str | None, settings: dict[str, str] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment, "output_of", lambda *_: listed)
    environment._uv_settings.cache_clear()
    told = environment._uv_settings()
    environment._uv_settings.cache_clear()
    if settings is not None:
        settings = {"UV_INDEX_STRATEGY": "unsafe-best-match", **settings}
    assert told == settings


@pytest.mark.parametrize(
    ("refused", "ros_around", "used"),
    [
        ("nothing", False, ["pip uv", "uv"]),
        ("pip uv", False, ["pip uv", "pip"]),
        ("uv", False, ["pip uv", "uv", "pip"]),
        ("nothing", True, ["pip"]),
    ],
)
def test_pip_installs_what_uv_cannot(
    refused: str, ros_around: bool, used: list[str], venv: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = []

    def succeeds(command: list[str], **_: Any) -> bool:
        program = "uv" if command[0] == str(venv / "bin/uv") else "pip"
        run.append("pip uv" if environment.INSTALLER in command else program)
        return run[-1] != refused

    monkeypatch.setattr(environment, "_UV", venv / "bin/uv")
    monkeypatch.setattr(environment, "_uv_settings", dict)
    monkeypatch.setattr(environment, "succeeds", succeeds)
    assert environment._install("test", Record(ros_around=ros_around), 0)
    assert run == used


def test_needed_packages_are_those_that_are_not_here() -> None:
    here = {"libc6"}
    needed = apt.needed("libddsc0debian", lambda name: APT_DEPENDS.get(name, ""), here.__contains__)
    assert needed == ["libddsc0debian", "libiceoryx-binding-c2", "libiceoryx-posh2", "real-one"]
    everything = here | set(APT_DEPENDS)
    alone = apt.needed("libddsc0debian", APT_DEPENDS.__getitem__, everything.__contains__)
    assert alone == ["libddsc0debian"]


def test_the_package_answers_where_its_security_plugins_are() -> None:
    """An answer of None would mean that the question no longer fits the package."""
    assert dds.plugins_found_by(Path(sys.executable)) is not None


def test_an_empty_folder_has_no_plugins(tmp_path: Path) -> None:
    assert dds.plugins_found_by(Path(sys.executable), tmp_path) == ""


def test_a_package_that_does_not_start_installs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(apt, "install", lambda *_: pytest.fail("nothing is to be installed"))
    monkeypatch.setattr(apt, "unpack", lambda *_: pytest.fail("nothing is to be unpacked"))
    assert dds.provide(fake_python(tmp_path / "python", "3.11.0").with_name("gone"), None) is None


def test_a_second_setup_waits_for_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(steps, "CHECKOUT", tmp_path)
    order: list[str] = []

    def second() -> None:
        with steps.locked():
            order.append("second")

    with steps.locked():
        thread = threading.Thread(target=second)
        thread.start()
        while "waiting for it" not in capsys.readouterr().err:
            thread.join(0.01)
        order.append("first")
    thread.join(PATIENCE)
    assert order == ["first", "second"]
    assert os.listdir(tmp_path) == []


def test_an_installer_keeps_the_lock_of_a_killed_setup(
    venv: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "CHECKOUT", venv.parent)
    ask = "import os, sys; os.fstat(int(sys.argv[1]))"
    with steps.locked() as lock:
        assert steps.succeeds([sys.executable, "-c", ask, str(lock)], keep_open=lock)
        assert not steps.succeeds([sys.executable, "-c", ask, str(lock)])


def test_counts_come_from_the_reports_of_pytest(tmp_path: Path) -> None:
    report = tmp_path / "report.xml"
    report.write_text(
        '<testsuites><testsuite name="pytest" errors="1" failures="2" skipped="3" tests="10"/>'
        "</testsuites>"
    )
    assert checks.count(report) == {"passed": 4, "failed": 3, "skipped": 3}
    assert checks.count(tmp_path / "none.xml") == {}


FORKED_TESTS = {
    "test_one.py": """
import os
import pytest

@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shared")
    yield folder
    (folder.parents[2] / f"ended-{os.getpid()}").touch()

def test_passes(shared, tmp_path):
    assert not list(tmp_path.iterdir())

def test_fails(shared):
    print("what it printed")
    assert "this" == "that"

@pytest.mark.skip(reason="why not")
def test_skipped():
    pass
""",
    "test_two.py": """
import os

def test_passes():
    pass

def test_ends_its_process():
    os.abort()

def test_never_runs():
    pass
""",
}


def test_forked_processes_report_what_a_single_one_would(tmp_path: Path) -> None:
    """A test that ends its process has failed, and so has what would have come after it."""
    for name, text in FORKED_TESTS.items():
        (tmp_path / name).write_text(text)
    words = ("-p", "no:cacheprovider", "-c", "/dev/null", "--rootdir", ".", "-ra")
    forked = ("-p", "tools.forked_tests", "--processes", "2", f"--basetemp={tmp_path / 'made'}")

    def run(*more: str) -> str:
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *words, *forked, f"--junit-xml={report}", *more],
            cwd=tmp_path,
            env={"PYTHONPATH": str(CHECKOUT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
        return f"{ended.stdout}{ended.returncode}"

    report = tmp_path / "report.xml"
    text = run("-k", "not ends and not never")
    assert text.endswith("1")
    assert "assert 'this' == 'that'" in text
    assert "what it printed" in text
    assert "SKIPPED [1] test_one.py:18: why not" in text
    assert checks.count(report) == {"passed": 2, "failed": 1, "skipped": 1}
    assert len(list(tmp_path.glob("ended-*"))) == 1
    text = run("test_two.py", "test_one.py")
    assert "test_ends_its_process - its process ended: SIGABRT" in text
    assert "1 of 6 tests have not ended, such as test_two.py::test_never_runs" in text
    assert not text.endswith("\n0")


def python_that_says(variable: str, ends: str, venv: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """In place of the Python of the checks: a program that says a variable and its arguments."""
    python = venv / "python"
    python.write_text(f'#!/bin/sh\necho "ran {variable}: $*"\n{ends}\n')
    python.chmod(0o755)
    for name, value in (("PYTHON", python), ("VENV", venv), ("CHECKOUT", venv)):
        monkeypatch.setattr(checks, name, value)
    monkeypatch.setattr(checks, "read_record", Record)
    return python


@pytest.mark.parametrize(
    ("arguments", "started"),
    [
        ([], ["check", "format", "mypy", "--processes"]),
        (["--long"], ["check", "format", "mypy", "--processes"]),
        (["-k", "x"], ["check", "format", "mypy", "-k x"]),
    ],
)
def test_every_check_is_run_and_shown_and_the_worst_counts(
    arguments: list[str],
    started: list[str],
    venv: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    ends = 'case "$*" in *mypy*) exit 3;; *format*) exit 1;; esac'
    python_that_says("$SROS_LONG", ends, venv, monkeypatch)
    assert checks.run(arguments, {"PATH": "/usr/bin:/bin"}, with_tests=True) == 3
    lines = capfd.readouterr().out.splitlines()
    ran = [line for line in lines if line.startswith("ran ")]
    assert len(ran) == len(started)
    assert all(any(word in line for line in ran) for word in started)
    assert all(line.startswith("ran 1:") is ("--long" in arguments) for line in ran)
    assert "mypy FAILED (3); " in lines[-1]
    assert lines[-1].startswith("ruff check ok; ruff format FAILED (1); ")


def test_tests_that_failed_run_again_with_the_same_seed_to_tell_their_values(
    venv: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    ends = 'case "$*" in *--processes*) exit 1;; esac'
    python_that_says("$SROS_SEED", ends, venv, monkeypatch)
    assert checks.run([], {"PATH": "/usr/bin:/bin"}, with_tests=True) == 1
    ran = [line for line in capfd.readouterr().out.splitlines() if "pytest" in line]
    all_of_them, again = ran
    assert "--assert=plain" in all_of_them and "--assert" not in again
    assert "--last-failed" in again
    seeds = [line.partition(":")[0] for line in ran]
    assert seeds[0] == seeds[1] != "ran "


def test_the_oldest_packages_are_those_that_the_package_asks_for_or_newer(
    venv: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    ends = 'case "$*" in *==41*) exit 4;; esac'
    python = python_that_says("$PYTHONPATH", ends, venv, monkeypatch)
    monkeypatch.setattr(steps, "LOG", venv / "log")
    with pytest.raises(steps.SetupError):
        checks.run(["--oldest"], {}, with_tests=True)
    python.write_text(python.read_text().replace("exit 4", "exit 0"))
    assert checks.run(["--oldest", "-k", "x"], {}, with_tests=True) == 0
    (ran,) = [line for line in capfd.readouterr().out.splitlines() if line.startswith("ran ")]
    assert ran == f"ran {venv / 'oldest'}: -m pytest -k x"
    needed = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["dependencies"]
    for least, oldest in zip(sorted(needed), sorted(checks.OLDEST_PACKAGES), strict=True):
        assert oldest.replace("==", ">=").startswith(least)


def test_one_package_that_fails_does_not_keep_the_others_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run: list[list[str]] = []

    def succeeds(command: list[str], **_: Any) -> bool:
        run.append(command)
        return "broken" not in command

    monkeypatch.setattr(apt, "root_prefix", list)
    monkeypatch.setattr(apt, "available", lambda: True)
    monkeypatch.setattr(apt, "find", lambda name: None if name == "unknown" else name)
    monkeypatch.setattr(apt, "succeeds", succeeds)
    assert apt.install_all(["good", "broken", "unknown"]) == ["broken", "unknown"]
    assert [each[-1] for each in run] == ["update", "broken", "good", "broken"]
    run.clear()
    assert apt.install_all(["good", "other"]) == []
    assert [each[-2:] for each in run[1:]] == [["good", "other"]]


def test_nothing_is_installed_that_is_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[list[str]] = []

    def fail(names: list[str], _lock: int | None) -> list[str]:
        asked.append(names)
        return names

    monkeypatch.setattr(apt, "install_all", fail)
    there = ("openssl", "OpenSSL", lambda: True)
    absent = ("chromium", "a browser", lambda: False)
    monkeypatch.setattr(apt, "FOR_TESTS", (there,))
    apt.provide_for_tests()
    assert (asked, capsys.readouterr().err) == ([], "")
    monkeypatch.setattr(apt, "FOR_TESTS", (there, absent))
    apt.provide_for_tests()
    assert asked == [["chromium"]]
    assert "a browser (chromium) cannot be installed" in capsys.readouterr().err


@pytest.mark.parametrize("error", [KeyboardInterrupt, SetupError, None])
def test_apt_works_meanwhile_and_is_waited_for_only_without_an_error(
    venv: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException] | None
) -> None:
    begun, may_end, ended = (threading.Event() for _ in range(3))

    def install(*_: object) -> bool:
        assert begun.wait(PATIENCE), "apt works at the same time"
        if error:
            raise error
        may_end.set()
        return True

    def meanwhile() -> None:
        begun.set()
        may_end.wait(PATIENCE)
        ended.set()

    monkeypatch.setattr(environment, "current", Record)
    monkeypatch.setattr(environment, "distributions_now", dict)
    for name in ("_usable", "whole"):
        monkeypatch.setattr(environment, name, lambda *_: True)
    monkeypatch.setattr(environment, "_install", install)
    if error:
        with pytest.raises(error):
            environment.prepare(["package"], Record(), 0, meanwhile=meanwhile)
        assert not ended.is_set()
        may_end.set()
    else:
        done = environment.prepare(["package"], Record(), 0, meanwhile=meanwhile)
        assert ended.is_set() and done.groups == ["package"]


def test_what_fails_meanwhile_is_said() -> None:
    def fail() -> None:
        raise OSError("no space")

    with pytest.raises(OSError, match="no space"):
        environment._started(fail).result(PATIENCE)
