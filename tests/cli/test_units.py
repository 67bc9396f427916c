"""The verb units: the files that it writes, replaces only if asked, and refuses to write."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from sros_tool.agent.settings import AgentSettings, make_agent_folder, write_settings
from sros_tool.runtime.units import FLEET_FILE
from tests.support.harness import policy_text, publish, snapshot, sros

THERE = "/etc/sros/keystore"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore with nested enclaves; only read."""
    folder = tmp_path_factory.mktemp("units")
    names = {each: publish("/x") for each in ("/arm", "/arm/gripper", "/leg")}
    (folder / "p.xml").write_text(policy_text(names))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=folder).ok()
    return folder / "ks"


def settings(folder: Path, instance: str) -> list[str]:
    path = folder / f"sros@{instance}.service.d/enclave.conf"
    return path.read_text().splitlines()


def test_nodes_of_several_enclaves(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "new/units"
    planned = sros("units", made, "--match", "/arm*", folder, "--dry-run").ok().out
    assert not folder.exists()
    said = sros("units", made, "--match", "/arm*", folder).ok()
    assert said.out == planned.replace("would create", "wrote")
    assert {str(each.relative_to(folder)) for each in folder.rglob("*") if each.is_file()} == {
        "sros@.service",
        "sros@arm.service.d/enclave.conf",
        "sros@arm-gripper.service.d/enclave.conf",
    }
    gripper = settings(folder, "arm-gripper")
    assert f"BindReadOnlyPaths={THERE}/enclaves/arm/gripper" in gripper
    assert f"TemporaryFileSystem={THERE}/enclaves:ro" in gripper
    assert f"InaccessiblePaths=-{THERE}/private" in gripper, "the keys of the CAs"
    assert 'Environment="ROS_SECURITY_ENCLAVE_OVERRIDE=/arm/gripper"' in gripper
    assert gripper[-1] == "ExecStart=/etc/sros/nodes/arm/gripper"
    assert f"InaccessiblePaths=-{THERE}/enclaves/arm/gripper" in settings(folder, "arm")
    assert not any("leg" in line for line in [*gripper, *settings(folder, "arm")])
    assert "User=ros\n" in (folder / "sros@.service").read_text()


def test_what_differs_is_replaced_only_if_asked(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "units"
    words = ("units", made, "/leg", folder)
    sros(*words).ok()
    before = snapshot(folder)
    again = sros(*words).ok()
    assert again.out == "" and "already up to date" in again.err
    refused = sros(*words, "--domain", "0", "--user", "other")
    assert refused.status == 2 and "other versions of sros@.service" in refused.err
    assert snapshot(folder) == before
    sros(*words[:2], "/arm", folder).ok()
    done = sros(*words, "--user", "other", "--force", "--", "/bin/true", "a b").ok()
    assert [line.split()[0] for line in done.out.splitlines()] == ["replaced", "replaced"]
    assert settings(folder, "leg")[-1] == 'ExecStart=/bin/true "a b"'
    assert settings(folder, "arm")[-1] == "ExecStart=/etc/sros/nodes/arm"


def test_a_node_is_verified_first_where_sros_is(made: Path, tmp_path: Path) -> None:
    words = ("--sros", "/usr/bin/sros", "--target", "/srv/k")
    sros("units", made, "/leg", tmp_path / "units", *words).ok()
    first, last = settings(tmp_path / "units", "leg")[-2:]
    assert first == "ExecStartPre=/usr/bin/sros verify /srv/k --match /leg"
    assert last == "ExecStart=/etc/sros/nodes/leg"


def test_jobs_are_of_this_keystore_and_its_owner(made: Path, tmp_path: Path) -> None:
    jobs = ("--job", "renew", "--job", "check", "--job", "metrics", "--job", "fleet")
    (tmp_path / "work").mkdir()
    words = ("--sros", "/usr/bin/sros", "--passphrase-file", "../pass")
    sros("units", made, *jobs, tmp_path / "units", *words, cwd=tmp_path / "work").ok()
    names = {each.name for each in (tmp_path / "units").iterdir()}
    assert names == {f"sros-{job}.{end}" for job in jobs[1::2] for end in ("service", "timer")}
    renew = (tmp_path / "units/sros-renew.service").read_text()
    assert f"ExecStart=/usr/bin/sros renew {made} --all-expiring soon\n" in renew
    assert f"User={made.owner()}\n" in renew
    assert f"ca-passphrase:{tmp_path / 'pass'}\n" in renew
    fleet = (tmp_path / "units/sros-fleet.service").read_text()
    assert f"ExecStart=/usr/bin/sros fleet status {made} --prometheus -o {FLEET_FILE}\n" in fleet
    assert "\nSuccessExitStatus=1\n" in fleet
    often = ("--job", "fleet", "--max-age", "15m", "--sros", "/usr/bin/sros", "--force")
    sros("units", made, *often, tmp_path / "units").ok()
    fleet = (tmp_path / "units/sros-fleet.service").read_text()
    assert f"fleet status {made} --max-age 900s --prometheus -o {FLEET_FILE}\n" in fleet


@pytest.mark.parametrize(("validity", "limit"), [("2d", "16 h"), ("5d", "1 d"), ("6d", "")])
def test_a_validity_that_is_too_short_for_the_daily_job(
    tmp_path: Path, validity: str, limit: str
) -> None:
    sros("create_keystore", tmp_path / "ks", "--permissions-validity", validity).ok()
    said = sros("units", tmp_path / "ks", "--job", "renew", tmp_path / "units").ok().err
    days = validity[0]
    late = (
        f"permissions are valid for {days} d, and count as expiring soon only in the last {limit}"
    )
    assert said.count("may come too late") == bool(limit) == (late in said)


def test_files_with_a_shorter_validity_than_the_settings_choose(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--ca-validity", "100h").ok()
    sros("create_enclave", root, "/a").ok()
    said = sros("units", root, "--job", "renew", tmp_path / "units").ok().err
    # The enclave ends with its CA, which may be some seconds older.
    period = r"files of /a are valid for 4 d \d h, and count as expiring soon only in the last 1 d"
    assert re.search(period, said), said


def test_jobs_without_the_passphrase_are_said(made: Path, tmp_path: Path) -> None:
    secret, root = tmp_path / "secret", tmp_path / "ks"
    secret.write_text("a long secret")
    secret.chmod(0o600)
    environment = {"SROS_CA_PASSPHRASE_FILE": str(secret)}
    sros("create_keystore", root, "--encrypt-ca-keys", env=environment).ok()
    job, option = ("--job", "renew", "--dry-run"), "--passphrase-file"
    for keystore, words, why in (
        (root, (), "the CA keys are encrypted"),
        (root, (option, tmp_path / "lost"), "lost' does not exist"),
        (root, (option, secret), ""),
        (made, (), ""),
    ):
        said = sros("units", keystore, *job, *words, tmp_path / "units").ok().err
        assert ("[units.no-passphrase]" in said) is bool(why) and why in said, said


@pytest.mark.parametrize(
    "verb", ["units {0} --job renew {0}/units", "renew {0} --all-expiring soon"]
)
def test_an_export_is_never_renewed(verb: str, made: Path, tmp_path: Path) -> None:
    sros("distribute_key", made, "--all", tmp_path / "export").ok()
    words = verb.format(tmp_path / "export").split()
    ended = sros(*words)
    assert ended.status == 2 and "has no identity CA" in ended.err, ended
    assert not (tmp_path / "export/units").exists()


def test_messages_are_collected_and_releases_published(made: Path, tmp_path: Path) -> None:
    folders = ("--inbox", tmp_path / "in", "--publish", tmp_path / "pub")
    sros(
        *("units", made, "--job", "collect", *folders, tmp_path / "units"),
        *("--sros", "/usr/bin/sros", "--passphrase-file", "/etc/sros/pass"),
    ).ok()
    lines = (tmp_path / "units/sros-collect.service").read_text().splitlines()
    command = f"/usr/bin/sros fleet collect {made} {tmp_path}/in --publish {tmp_path}/pub"
    assert f"ExecStart={command}" in lines
    assert f"ReadWritePaths={made} {tmp_path}/pub" in lines
    assert "LoadCredential=ca-passphrase:/etc/sros/pass" in lines
    assert (tmp_path / "units/sros-collect.timer").exists()


def test_the_guard_watches_with_the_keystore_and_its_domain(made: Path, tmp_path: Path) -> None:
    words = ("--job", "guard", "--sros", "/usr/bin/sros", "--domain", "3", "--target", "/srv/k")
    sros("units", made, *words, tmp_path / "units").ok()
    (unit,) = (tmp_path / "units").iterdir()
    lines = unit.read_text().splitlines()
    assert unit.name == "sros-guard.service"
    assert "ExecStart=/usr/bin/sros check runtime --watch" in lines
    assert 'Environment="ROS_SECURITY_KEYSTORE=/srv/k"' in lines
    assert 'Environment="ROS_DOMAIN_ID=3"' in lines
    assert "CapabilityBoundingSet=CAP_SYS_PTRACE CAP_DAC_READ_SEARCH" in lines


def test_the_agent_is_of_the_owner_and_may_write_into_its_inbox(made: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    sros("distribute_key", made, "/leg", robot).ok()
    words = ("--job", "agent", "--sros", "/usr/bin/sros")
    said = sros("units", robot, *words, tmp_path / "before").ok().err
    assert "[units.no-agent]" in said
    assert {unit.name for unit in (tmp_path / "before").iterdir()} == {
        "sros-agent.service",
        "sros-agent.timer",
    }
    make_agent_folder(robot)
    write_settings(robot, AgentSettings("r1", "/media/pub", "/media/inbox"))
    if os.geteuid() == 0:  # the units are often written by root, who does not own the folder
        os.chown(robot, 65534, 65534)
    assert "units.no-agent" not in sros("units", robot, *words, tmp_path / "units").ok().err
    lines = (tmp_path / "units/sros-agent.service").read_text().splitlines()
    assert f"ExecStart=/usr/bin/sros agent run {robot} --once" in lines
    assert f"User={robot.owner()}" in lines
    assert f"ReadWritePaths={robot} -/media/inbox" in lines
    before = (tmp_path / "before/sros-agent.service").read_text()
    assert f"ReadWritePaths={robot}\n" in before


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("/none", "F"), "enclave /none does not exist"),
        (("F",), "units takes"),
        (("/leg",), "units takes"),
        (("--job", "check", "F", "--", "/bin/true"), "no enclave is named"),
        (("/leg", "--job", "check", "F"), "One folder of units is for one machine"),
        (("--job", "check", "F", "--passphrase-file", "/x"), "only for --job renew"),
        (("--job", "collect", "F", "--inbox", "/in"), "needs --inbox INBOX and --publish PUB"),
        (("--job", "check", "F", "--publish", "/pub"), "no other job takes them"),
        (("--job", "check", "F", "--max-age", "15m"), "only for --job fleet and --job status"),
        (("--job", "fleet", "F", "--max-age", "15m\nUser=root"), "is not a duration"),
        (("/leg", "F", "--target", "/a b"), "cannot be written in a systemd unit"),
        (("/leg", "F", "--target", "k"), "--target 'k'"),
        (("/leg", "F", "--user", "a b"), "name of a user"),
        (("/leg", "F", "--", "true"), "cannot be written in a systemd unit"),
        (("/leg", "F", "--", "/bin/true", "a\nUser=root"), "cannot be written in a systemd unit"),
        (("--job", "renew", "F", "--sros", "sros"), "cannot be written in a systemd unit"),
        (("--job", "agent", "F", "--sros", "/x/../bin/sros"), "With --sros FILE, name"),
        (("--job", "guard", "F", "--user", "ros"), "Only root"),
    ],
)
def test_what_is_refused_writes_nothing(
    words: tuple[str, ...], why: str, made: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "units"
    refused = sros("units", made, *(str(folder) if each == "F" else each for each in words))
    assert refused.status == 2 and why in refused.err, refused
    assert len(refused.err.splitlines()) == 1
    assert not folder.exists()


def test_no_link_is_followed_out_of_the_folder(made: Path, tmp_path: Path) -> None:
    (tmp_path / "units").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "units/sros@leg.service.d").symlink_to(tmp_path / "elsewhere")
    refused = sros("units", made, "/leg", tmp_path / "units")
    assert refused.status == 2
    assert not any((tmp_path / "elsewhere").iterdir())
    assert [each.name for each in (tmp_path / "units").iterdir()] == ["sros@leg.service.d"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as several users")
@pytest.mark.parametrize("theirs", ["units", "units/sros@leg.service.d", "."])
def test_no_unit_is_written_where_others_can_change_it(
    made: Path, tmp_path: Path, theirs: str
) -> None:
    folder = tmp_path / "units"
    (folder / "sros@leg.service.d").mkdir(parents=True)
    os.chown(tmp_path / theirs, 65532, 65532)
    before = snapshot(tmp_path)
    ended = sros("units", made, "/leg", folder)
    assert ended.status == 2 and "which others can change" in ended.err, ended
    assert snapshot(tmp_path) == before
    os.chown(tmp_path / theirs, 0, 0)
    sros("units", made, "/leg", folder).ok()


def test_an_option_for_one_value_is_refused_twice(made: Path, tmp_path: Path) -> None:
    """The first pair of folders would never be collected from, or published to."""
    job = ("units", made, "--job", "collect", "--inbox", "a", "--publish", "p")
    ended = sros(*job, "--inbox", "b", "--publish", "q", tmp_path / "units")
    assert ended.status == 2 and "--inbox is given twice. It takes one value." in ended.err, ended
    assert not (tmp_path / "units").exists()
    assert sros(*job, "--inbox", "b", "--help").ok().out.startswith("Usage: sros units ")
    sros(
        "units", made, "--job", "renew", "--job", "metrics", tmp_path / "u", "--json", "--json"
    ).ok()
