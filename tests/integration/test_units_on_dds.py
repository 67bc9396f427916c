"""Nodes on Cyclone DDS under the restrictions of the units that sros writes."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from sros_tool.runtime.netns import try_isolation
from sros_tool.runtime.units import Job, job_units, node_settings, node_template
from tests.agent.test_fetch import Quiet, serving
from tests.integration.converse import converse, listener, talker
from tests.support.children import python, run
from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import sometimes

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(
        os.geteuid() != 0 or not shutil.which("systemd-analyze") or not try_isolation().isolated,
        reason="needs root, namespaces, and the groups of system calls of systemd",
    ),
]

CONFINED = str(Path(__file__).with_name("confined.py"))
DOMAIN = 133
HEARS = '<topics subscribe="ALLOW"><topic>/x</topic></topics>'

TRY = """
import json, socket, sys, os, tempfile
def refused(act):
    try:
        act()
    except OSError as error:
        return type(error).__name__
    return ""
own, other, outside = sys.argv[1:]
print(json.dumps({
    "own key": refused(lambda: open(own + "/key.pem").read()),
    "UDP": refused(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)),
    "interfaces": refused(lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW)),
    "shared memory": refused(lambda: tempfile.TemporaryFile(dir="/dev/shm")),
    "temporary file": refused(lambda: tempfile.TemporaryFile(dir="/tmp")),
    "another key": refused(lambda: open(other + "/key.pem").read()),
    "change own": refused(lambda: open(own + "/key.pem", "a")),
    "packets": refused(lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW)),
    "system": refused(lambda: open(outside, "w")),
    "module": refused(lambda: os.chroot("/")),
    "owner": refused(lambda: os.setuid(1)),
}))
"""
NEEDED = {"own key", "UDP", "interfaces", "shared memory", "temporary file"}


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """An export with a talker and a listener."""
    now = datetime.now(UTC)
    domains = DomainSet.of((DOMAIN, DOMAIN))
    create_keystore(tmp_path / "ks", template=load_template("production"), domains=domains, now=now)
    (tmp_path / "p.xml").write_text(policy_text({"/arm": publish("/x"), "/leg": HEARS}))
    generate_artifacts(tmp_path / "ks", policies=[read_policy(tmp_path / "p.xml")], now=now)
    sros("distribute_key", tmp_path / "ks", "--all", tmp_path / "robot").ok()
    return tmp_path / "robot"


@pytest.fixture
def units(robot: Path, tmp_path: Path) -> Iterator[Path]:
    """The unit of the talker, as a file."""
    path = tmp_path / "units"
    path.write_text(node_template("root") + node_settings("/arm", {}, str(robot)))
    yield path


def test_a_talker_under_the_restrictions_of_its_unit_is_heard(
    robot: Path, units: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)  # the unit has devices of its own: no /dev/shm
    place = tempfile.gettempdir()
    confined = (sys.executable, CONFINED, str(units), place, "--")
    speaks = replace(talker(robot, "/arm", topic="/x"), through=confined)
    said = converse(DOMAIN, speaks, listener(robot, "/leg", topic="/x"))
    assert said.heard(), said


def test_the_restrictions_are_in_force(robot: Path, units: Path) -> None:
    with tempfile.TemporaryDirectory(dir="/var/tmp") as outside:
        words = (robot / "enclaves/arm", robot / "enclaves/leg", f"{outside}/file")
        free = json.loads(python("-c", TRY, *words).stdout)
        confined = [sys.executable, CONFINED, units, "--"]
        held = json.loads(run([*confined, sys.executable, "-c", TRY, *words]).stdout)
    assert {name for name, error in free.items() if error} <= {"packets", "module"}
    assert {name for name, error in held.items() if not error} == NEEDED, held


@sometimes("jobs under their restrictions")
def test_the_jobs_do_their_work_under_their_restrictions(robot: Path, tmp_path: Path) -> None:
    keystore, metrics, pub = tmp_path / "ks", tmp_path / "metrics", tmp_path / "pub"
    metrics.mkdir()
    before = (keystore / "enclaves/arm/cert.pem").read_bytes()
    (tmp_path / "fleet.toml").write_text("[robots.r1]\n")
    (tmp_path / "robot.xml").write_text(policy_text({"/{robot}/a": publish("/a")}))
    stated = ("-p", tmp_path / "robot.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", keystore, *stated).ok()
    sros("fleet", "publish", keystore, pub).ok()
    (tmp_path / "inbox").mkdir()
    make = partial(job_units, inbox=str(tmp_path / "inbox"), publishing=str(pub))
    # No node starts with these rights; r1 confirmed nothing.
    ended = {Job.CHECK: 1, Job.FLEET: 1, Job.STATUS: 1}
    # The guard never ends, and the agent has a test of its own.
    for job in (each for each in Job if each not in (Job.GUARD, Job.AGENT)):
        files = make(job, str(keystore), user="root", sros="/bin/sros")
        (tmp_path / "job").write_text(files[f"sros-{job}.service"])
        (line,) = re.findall("^ExecStart=/bin/sros (.*)$", (tmp_path / "job").read_text(), re.M)
        words = line.replace("/var/lib/sros-metrics", str(metrics)).replace(" soon", " 9999d")
        program = [sys.executable, "-m", "sros_tool", *words.split()]
        folders = (keystore, metrics, *([pub] if job is Job.COLLECT else []))
        confined = [sys.executable, CONFINED, tmp_path / "job", *folders, "--", *program]
        run(confined, status=ended.get(job, 0))
    assert (keystore / "enclaves/arm/cert.pem").read_bytes() != before
    assert "sros_enclaves{" in (metrics / "sros.prom").read_text()
    assert 'robot="r1"' in (metrics / "fleet.prom").read_text()


@pytest.fixture
def outside() -> Iterator[Path]:
    """A folder on the file system that a unit cannot change; shared memory it can."""
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:
        yield Path(folder)


@sometimes("the agent under its restrictions")
def test_the_agent_does_its_work_under_its_restrictions(tmp_path: Path, outside: Path) -> None:
    """It fetches over the network, installs, and confirms; twin: nothing is left to write to."""
    (tmp_path / "fleet.toml").write_text("[robots.r1]\n")
    (tmp_path / "p.xml").write_text(policy_text({"/{robot}/a": publish("/a")}))
    keystore, pub, robot, inbox = (tmp_path / "ks", tmp_path / "pub", outside / "r", outside / "i")
    inbox.mkdir()
    stated = ("-p", tmp_path / "p.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", keystore, *stated).ok()
    sros("distribute_key", keystore, "--robot", "r1", robot).ok()
    sros("renew", keystore, "/r1/a").ok()
    sros("fleet", "publish", keystore, pub).ok()
    unit, place = tmp_path / "agent", robot / "enclaves/r1/a/cert.pem"
    files = job_units(Job.AGENT, str(robot), user="root", sros="/bin/sros", writable=[str(inbox)])
    unit.write_text(files["sros-agent.service"])
    (line,) = re.findall("^ExecStart=/bin/sros (.*)$", unit.read_text(), re.M)
    (writable,) = re.findall("^ReadWritePaths=(.*)$", unit.read_text(), re.M)
    kept = [path.removeprefix("-") for path in writable.split()]
    with serving(partial(Quiet, directory=str(pub))) as address:
        sros(
            *("agent", "init", robot, "--robot", "r1", "--root", pub / "metadata/1.root.json"),
            *("--from", address, "--inbox", inbox),
        ).ok()

        def agent(*kept: str, status: int) -> None:
            program = [sys.executable, "-m", "sros_tool", *line.split()]
            run([sys.executable, CONFINED, unit, *kept, "--", *program], status=status)

        agent(status=2)
        assert place.read_bytes() != (keystore / "enclaves/r1/a/cert.pem").read_bytes()
        agent(*kept, status=0)
    assert place.read_bytes() == (keystore / "enclaves/r1/a/cert.pem").read_bytes()
    assert sros("fleet", "collect", keystore, inbox).ok().out.startswith("1 robot: 1 kept")
