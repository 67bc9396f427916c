"""What a hostile robot answers to Ansible changes nothing at home."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.harness import sros

CHECKOUT = Path(__file__).parents[2]
PLAYBOOK = shutil.which("ansible-playbook", path=str(Path(sys.executable).parent))
pytestmark = pytest.mark.skipif(not PLAYBOOK, reason="not here: ansible-playbook")

CONFIRMATION = {"format": 1, "robot": "r1", "time": "2026-01-01T00:00:00Z", "files": {}}
INSTALLED: dict[str, Any] = {
    "changed": False,
    "restart": [],
    "routers": [],
    "confirmation": CONFIRMATION,
}


def hostile(folder: Path, name: str, answers: dict[str, dict[str, Any]]) -> Path:
    """Return a program that takes the place of Python on a robot, and answers as it likes."""
    cases = []
    for module, answer in answers.items():
        (folder / f"{name}-{module}.json").write_text(json.dumps(answer))
        cases.append(f"*AnsiballZ_{module}.py*) cat '{folder}/{name}-{module}.json' ;;")
    program = folder / f"{name}-python"
    program.write_text('#!/bin/sh\ncase "$*" in\n' + "\n".join(cases) + "\nesac\n")
    program.chmod(0o755)
    return program


def play(folder: Path, which: str, hosts: dict[str, Any], *words: str, **variables: object) -> str:
    """Run a play of the collection on hosts of this machine; return what it prints."""
    (folder / "inventory.json").write_text(json.dumps({"all": {"hosts": hosts}}))
    playbook = CHECKOUT / f"ansible_collections/sros/fleet/playbooks/{which}.yml"
    done = subprocess.run(
        [
            str(PLAYBOOK),
            "-i",
            folder / "inventory.json",
            playbook,
            *words,
            "-e",
            json.dumps(variables),
        ],
        env={
            "PATH": "/usr/local/bin:/usr/bin:/bin",
            "HOME": str(folder),
            "LC_ALL": "C.UTF-8",
            "PYTHONPATH": str(CHECKOUT),
            "ANSIBLE_COLLECTIONS_PATH": str(CHECKOUT),
            "ANSIBLE_LOCALHOST_WARNING": "0",
        },
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout + done.stderr


@pytest.mark.parametrize(("which", "module"), [("deliver", "ping"), ("status", "enclaves")])
def test_facts_of_a_robot_choose_no_command_and_no_keys(
    tmp_path: Path, which: str, module: str
) -> None:
    """Neither an export nor a record is made with the settings that a robot returned as facts."""
    keystore = tmp_path / "keystore"
    sros("create_keystore", keystore).ok()
    sros("create_enclave", keystore, "/r1/a", "/r2/a").ok()
    trace = tmp_path / "trace"
    facts = {
        "sros_program": ["/bin/sh", "-c", f"echo here >> '{trace}'; echo '{{}}'"],
        "sros_robot": "r2",
    }
    answers: dict[str, dict[str, Any]] = {"ping": {"ping": "pong"}, "enclaves": INSTALLED}
    answers[module] = {**answers[module], "ansible_facts": facts}
    robot = {
        "ansible_connection": "local",
        "ansible_python_interpreter": str(hostile(tmp_path, "r1", answers)),
        "sros_patterns": ["/r1/*"],
        "sros_program": [sys.executable, "-m", "sros_tool"],
    }
    text = play(tmp_path, which, {"r1": robot}, sros_keystore=str(keystore))
    assert "names of settings (sros_program, sros_robot)" in text, text
    assert not trace.exists()


def test_bad_requests_of_robots_get_no_certificate_and_stop_no_other(tmp_path: Path) -> None:
    """A request says which enclave it is for, and who made it can choose that."""
    keystore = tmp_path / "keystore"
    sros("create_keystore", keystore).ok()
    asked = tmp_path / "asked"
    requests = {}
    for name in ("/r2/own", "/spare"):
        sros("create_request", name, asked).ok()
        requests[name] = (asked / f"enclaves{name}/request.pem").read_text()
    returned: dict[str, dict[str, Any]] = {
        "r1": {"requests": {"/r1/own": requests["/spare"]}},
        "r2": {"requests": {"/r2/own": requests["/r2/own"]}},
        "r3": {"requests": {"/spare": requests["/spare"]}},
        "r4": {"failed": True, "msg": "openssl is missing"},
    }
    hosts: dict[str, Any] = {}
    for name, answer in returned.items():
        answers: dict[str, dict[str, Any]] = {
            "ping": {"ping": "pong"},
            "requests": {"changed": True, "made": [f"/{name}/own"], **answer},
            "enclaves": INSTALLED,
        }
        hosts[name] = {
            "ansible_connection": "local",
            "ansible_python_interpreter": str(hostile(tmp_path, name, answers)),
            "sros_own_keys": [f"/{name}/own"],
            "sros_patterns": [f"/{name}/*"],
            "sros_confirm": False,
        }
    program = [sys.executable, "-m", "sros_tool"]
    printed = play(tmp_path, "requests", hosts, sros_keystore=str(keystore), sros_program=program)
    text = " ".join(printed.split())
    assert "is for enclave /spare, and should be for /r1/own" in text, text
    assert "r3 returned requests for other enclaves" in text, text
    assert "openssl is missing" in text, text
    assert "Left out, because of what they answered (see above): r1, r3, r4." in text, text
    names = [each.name for each in (keystore / "enclaves").iterdir() if each.is_dir()]
    assert names == ["r2"], text
    assert (keystore / "enclaves/r2/own/cert.pem").exists()
    _, _, delivered = text.partition("Install and verify the enclaves]")
    assert "ok: [r2]" in delivered, text


def test_a_limit_that_leaves_out_the_home_is_refused(tmp_path: Path) -> None:
    """Otherwise a play would revoke nothing and say that all is well."""
    robot = {
        "ansible_connection": "local",
        "ansible_python_interpreter": str(hostile(tmp_path, "r1", {"ping": {"ping": "pong"}})),
    }
    hosts = {"r1": robot, "r5": robot}
    said = play(tmp_path, "revoke", hosts, "--limit", "r1", sros_keystore="/k", sros_revoke=["r5"])
    assert "--limit leaves out localhost" in said
    assert "failed=1" in said
