"""systemd units: what the real systemd reads in them, also with hostile names and words."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pytest

from sros_tool.errors import UsageError
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.units import (
    FLEET_FILE,
    METRICS_FILE,
    TEMPLATE,
    Job,
    job_units,
    node_settings,
    node_template,
    unit_instance,
)
from tests.support.children import run
from tests.support.pages import PROJECT, blocks

pytestmark = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="there is no systemd")

THERE = "/etc/sros/keystore"


def verified(folder: Path, files: Mapping[str, str], *units: str) -> str:
    """Return what systemd says of units; fail if it finds anything wrong in them."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    env = {**os.environ, "SYSTEMD_UNIT_PATH": f"{folder}:", "LC_ALL": "C.UTF-8"}
    command = ["systemd-analyze", "verify", "--man=no", *units]
    quiet = run(command, env=env)
    assert str(folder) not in quiet.stdout + quiet.stderr, quiet
    said = run(command, env={**env, "SYSTEMD_LOG_LEVEL": "debug"})
    return said.stdout + said.stderr


def node(enclave: str, command: tuple[str, ...] = ("/bin/true",), **more: str) -> dict[str, str]:
    variables = {**secured_environment(Path(THERE), enclave, 7), **more}
    settings = node_settings(enclave, variables, THERE, command=command)
    path = f"sros@{unit_instance(enclave)}.service.d/enclave.conf"
    return {TEMPLATE: node_template("root"), path: settings}


@pytest.mark.parametrize("enclave", ["/arm", "/arm/Left_1", "/a_b/c", "/"])
def test_systemd_finds_nothing_wrong_in_a_node(enclave: str, tmp_path: Path) -> None:
    instance = run(["systemd-escape", "--path", enclave]).stdout.strip()
    assert unit_instance(enclave) == instance
    unit = f"sros@{instance}.service"
    said = verified(tmp_path, node(enclave), unit)
    found = dict(re.findall(r"\tEnvironment: (\w+)=(.*)", said))
    assert secured_environment(Path(THERE), enclave, 7).items() <= found.items()
    assert f"Description: ROS node in enclave {enclave}\n" in said
    assert found["ROS_LOG_DIR"] == f"/var/log/sros/{instance}"
    assert re.search(r"Command Line: /bin/true\n", said)
    assert "\tProtectSystem: strict\n" in said
    own = f"{THERE}/enclaves{enclave}"
    assert (f"\tBindReadOnlyPaths: {own}:{own}:" in said) == (enclave != "/")


def test_a_node_without_settings_does_not_start(tmp_path: Path) -> None:
    (tmp_path / TEMPLATE).write_text(node_template("root"))
    env = {**os.environ, "SYSTEMD_UNIT_PATH": f"{tmp_path}:"}
    command = ["systemd-analyze", "verify", "--man=no", "sros@arm.service"]
    said = run(command, env=env, status=None)
    assert said.returncode and "no ExecStart=" in said.stderr


def test_systemd_sees_what_is_misspelt(tmp_path: Path) -> None:
    files = node("/arm")
    files[TEMPLATE] = files[TEMPLATE].replace("ProtectClock", "ProtectClocks")
    with pytest.raises(AssertionError, match="ProtectClocks"):
        verified(tmp_path, files, "sros@arm.service")


def test_a_node_is_closed_for_the_analysis_of_systemd(tmp_path: Path) -> None:
    verified(tmp_path, node("/arm"), "sros@arm.service")
    env = {**os.environ, "SYSTEMD_UNIT_PATH": f"{tmp_path}:"}
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=30"]
    run([*command, "sros@arm.service"], env=env)
    said = run([*command[:-1], "--threshold=10", "sros@arm.service"], env=env, status=None)
    assert said.returncode  # the limit is one


@pytest.mark.parametrize("passphrase", ["", "/etc/sros/passphrase"])
def test_systemd_finds_nothing_wrong_in_the_jobs(passphrase: str, tmp_path: Path) -> None:
    files: dict[str, str] = {}
    program = tmp_path / ".venv/true"
    program.parent.mkdir()
    program.symlink_to("/bin/true")
    make = partial(job_units, user="root", sros=str(program), passphrase=passphrase)
    for job in Job:
        files |= make(job, "/srv/ks", inbox="/srv/in", publishing="/srv/pub")
    assert len(files) == 2 * len(Job) - 1  # the guard has no timer
    said = verified(tmp_path, files, *files)
    lines = set(re.findall(rf"Command Line: {program} (.*)", said))
    assert lines == {
        "agent run /srv/ks --once",
        "renew /srv/ks --all-expiring soon",
        "check keystore /srv/ks",
        "check runtime --watch",
        f"metrics /srv/ks -o {METRICS_FILE}",
        f"fleet status /srv/ks --prometheus -o {FLEET_FILE}",
        "fleet status /srv/ks --fail-on unmended",
        "fleet collect /srv/ks /srv/in --publish /srv/pub",
    }
    renew = files["sros-renew.service"]
    assert ("LoadCredential=ca-passphrase:/etc/sros/passphrase\n" in renew) == bool(passphrase)
    assert "ReadWritePaths=/srv/ks\n" in renew
    writing = {name for name in files if "ReadWritePaths" in files[name]}
    assert writing == {f"sros-{job}.service" for job in (Job.RENEW, Job.COLLECT, Job.AGENT)}
    env = {**os.environ, "SYSTEMD_UNIT_PATH": f"{tmp_path}:"}
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=30"]
    run([*command, "sros-agent.service"], env=env)


def test_systemd_finds_nothing_wrong_in_the_mail_of_the_page(tmp_path: Path) -> None:
    page = (PROJECT / "docs/howto/fleet.md").read_text("utf-8")
    files = {
        block.file.removeprefix("units/"): "\n".join(block.lines).replace(
            "/opt/sros/bin/sros", "/bin/true"
        )
        for block in blocks(page)
        if block.file.startswith("units/")
    }
    files |= job_units(Job.STATUS, "/srv/keystore", user="root", sros="/bin/true")
    mail = "mail@sros-status.service.service"
    said = verified(tmp_path, files, "sros-status.service", "sros-status.timer", mail)
    assert f"OnFailure: {mail}" in said
    (sent,) = re.findall(r"Command Line: (/bin/sh -c .*)", said)
    assert sent.endswith(" sh sros-status.service")


# ── hostile names and words ────────────────────────────────────────────────────────────────

WORDS = (
    *("-x", "a b", 'say "so"', "it's", "%h", "%%", "$HOME", "${HOME}", "$$", "a\\nb", "\\", ";"),
    *("a;b", "&&", "# no", "ä", "", "{}", "*", "=", "@", "!", "|", "\\;"),
)


def test_every_word_of_a_command_stays_one(tmp_path: Path) -> None:
    command = ("/usr/bin/printf", *WORDS)
    said = verified(tmp_path, node("/arm", command), "sros@arm.service")
    (line,) = re.findall(r"Command Line: (/usr/bin/printf.*)", said)
    # systemd shows words as a shell would read them, with $$ as it will be replaced.
    shown = run(["sh", "-c", f"for each in {line}; do printf '%s\\n' \"$each\"; done"]).stdout
    assert shown.splitlines() == [command[0], *(each.replace("$", "$$") for each in WORDS)]


@pytest.mark.parametrize(
    "word", ["a\nUser=root", "a\rUser=root", "\x1b[2J", "a\u2028b", "a\udcff", "a\x00"]
)
def test_a_word_cannot_add_a_line(word: str) -> None:
    with pytest.raises(UsageError):
        node("/arm", ("/bin/true", word))
    with pytest.raises(UsageError):
        node("/arm", VARIABLE=word)


@pytest.mark.parametrize(
    "path",
    [
        *("", "relative", "-/x", "/a b", "/a%h", "/a$b", "/a:b", "/a\nb", "/a/../b", "/a//b"),
        *("/a/", "/.", "/./a", "/a/..", "/ä", '/a"', "/a\\x20", "/", "@/bin/true", "!!/bin/true"),
    ],
)  # fmt: skip
def test_a_path_with_a_meaning_for_systemd_is_refused(path: str) -> None:
    with pytest.raises(UsageError):
        node("/arm", (path,))
    with pytest.raises(UsageError):
        node_settings("/arm", {}, path)
    for places in ({"keystore": path}, {"sros": path}):
        words = {"keystore": "/srv/ks", "sros": "/bin/true", **places}
        with pytest.raises(UsageError):
            job_units(Job.RENEW, words["keystore"], user="root", sros=words["sros"])


@pytest.mark.parametrize("name", ["/arm/x\nExecStart=/bin/sh", "/arm/a b", "/arm/%h", "/arm/../x"])
def test_a_folder_in_that_of_an_enclave_cannot_add_a_line(name: str) -> None:
    settings = node_settings("/arm", {}, THERE, below=["/arm/x"])
    assert f"\nInaccessiblePaths=-{THERE}/enclaves/arm/x\n" in settings
    with pytest.raises(UsageError):
        node_settings("/arm", {}, THERE, below=["/arm/x", name])


@pytest.mark.parametrize("user", ["", "a b", "a\nUser=root", "0", "-x", "a%u", "x" * 40])
def test_other_names_of_users_are_refused(user: str) -> None:
    with pytest.raises(UsageError):
        node_template(user)
    with pytest.raises(UsageError):
        job_units(Job.CHECK, "/srv/ks", user=user, sros="/bin/true")
