"""What a hostile robot answers to Ansible changes nothing at home."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import ONLY_LONG, sometimes

CHECKOUT = Path(__file__).parents[2]
PLAYBOOK = shutil.which("ansible-playbook", path=str(Path(sys.executable).parent))
pytestmark = pytest.mark.skipif(not PLAYBOOK, reason="not here: ansible-playbook")

PART = 1 / 8
"""Of the runs in which a hostile robot answers, for each kind of answer."""

CONFIRMATION = {"format": 1, "robot": "r1", "time": "2026-01-01T00:00:00Z", "files": {}}
INSTALLED: dict[str, Any] = {
    "changed": False,
    "restart": [],
    "routers": [],
    "confirmation": CONFIRMATION,
    "verification": {"by": "openssl", "ok": True, "problems": [], "remarks": []},
}


def hostile(folder: Path, name: str, answers: dict[str, dict[str, Any]]) -> Path:
    """Return a program that takes the place of Python on a robot, and answers as it likes."""
    cases = []
    for module, answer in answers.items():
        (folder / f"{name}-{module}.json").write_text(f"{json.dumps(answer)}\n")
        cases.append(f"*AnsiballZ_{module}.py*) cat '{folder}/{name}-{module}.json' ;;")
    program = folder / f"{name}-python"
    program.write_text('#!/bin/sh\ncase "$*" in\n' + "\n".join(cases) + "\nesac\n")
    program.chmod(0o755)
    return program


def play(
    folder: Path,
    which: str,
    hosts: dict[str, Any],
    *words: str,
    pinged: Sequence[str] = (),
    **variables: object,
) -> str:
    """Run a play of the collection on hosts of this machine; return what it prints.

    First, a play of somebody else takes facts from the hosts ``pinged``.
    """
    (folder / "first.yml").write_text(
        f"[{{hosts: {list(pinged)}, gather_facts: false, tasks: [{{ansible.builtin.ping: }}]}}]"
    )
    (folder / "inventory.json").write_text(json.dumps({"all": {"hosts": hosts}}))
    playbook = CHECKOUT / f"ansible_collections/sros/fleet/playbooks/{which}.yml"
    done = subprocess.run(
        [
            str(PLAYBOOK),
            "-i",
            folder / "inventory.json",
            *([folder / "first.yml"] if pinged else []),
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


BLANK = " " * 90 + "\u2800\u3164\u00a0\u0301\u05d0" * 90
"""What looks like the end of a line on a terminal, or is read in another order."""
STEERING = f"\x1b]0;title\x07 \x1b[2K\r \x9b31m \u202e {BLANK}\nPLAY RECAP"
"""What moves the cursor, changes the title or the direction of text, or begins another line."""
SFTP_SERVER = "/usr/lib/openssh/sftp-server"

_ROBOT_WITH_A_LONG_FOLDER = """#!/bin/sh
# An sshd that names a folder in whose name a line of sftp ends, and a command of sftp begins.
for command; do :; done
case "$command" in *mkdir*) ;; *) exec /bin/sh -c "$command" ;; esac
printf '%s=%s' "$(echo "$command" | grep -o 'ansible-tmp-[0-9.]*-[0-9]*-[0-9]*' | head -n 1)" \
  "FOLDER/x\\'\\" "
printf '%2400s!touch TRACE #\n' ''
"""


def fleet_keystore(folder: Path, robots: int) -> Path:
    """Make a keystore with a fleet: an enclave /NAME/a for each robot, and /dispatcher."""
    (folder / "policy.xml").write_text(
        policy_text({"/{robot}/a": publish("a"), "/dispatcher": publish("b")})
    )
    names = "".join(f"[robots.r{each}]\n" for each in range(1, robots + 1))
    (folder / "fleet.toml").write_text(names)
    words = ("-p", folder / "policy.xml", "--fleet", folder / "fleet.toml")
    sros("generate_artifacts", "-k", folder / "keystore", *words).ok()
    return folder / "keystore"


def enclaves(keystore: Path) -> list[str]:
    return list(json.loads(sros("list_enclaves", keystore, "--json").ok().out)["enclaves"])


@sometimes("nobody revoked is an error", PART)
@pytest.mark.parametrize(
    ("revoke", "said"),
    [
        pytest.param(["r4"], "the fleet has no robot 'r4'", marks=ONLY_LONG),
        pytest.param([], "has to be a list of robots", marks=ONLY_LONG),
        (["r2"], "no enclave of r2, and none was revoked before"),
    ],
)
def test_nobody_revoked_is_an_error(tmp_path: Path, revoke: object, said: str) -> None:
    keystore = fleet_keystore(tmp_path, 2)
    shutil.rmtree(keystore / "enclaves/r2")
    own: dict[str, Any] = {"sros_keystore": str(keystore)}
    own |= {"sros_program": [sys.executable, "-m", "sros_tool"]}
    for_robots = {"ansible_become": True, "ansible_become_user": "nobody"}
    own |= {**for_robots, "ansible_become_exe": "/bin/false"}
    hosts: dict[str, Any] = {"r4": {"sros_robot": "r1"}, "r2": {}}
    text = " ".join(play(tmp_path, "revoke", hosts, **own, sros_revoke=revoke).split())
    assert said in text and "failed=1" in text, text
    assert enclaves(keystore) == ["/dispatcher", "/r1/a"]


@sometimes("robots lie in many ways", PART)
def test_robots_that_lie_in_many_ways(tmp_path: Path) -> None:
    """Facts do not choose who is revoked, and nothing reaches the terminal or the inventory raw."""
    keystore = fleet_keystore(tmp_path, 8)
    trace = tmp_path / "trace"
    run = ["/bin/sh", "-c", f"echo here >> '{trace}'; echo '{{}}'"]
    steering = {
        "msg": STEERING,
        "warnings": [STEERING, {"__ansible_type": "WarningSummary", "event": {"msg": STEERING}}],
        "remarks": [STEERING],
        "deprecations": [{"msg": STEERING, "version": "9"}],
        "diff": [
            {"before": STEERING, "after": "x", "before_header": STEERING, "prepared": STEERING}
        ],
        "exception": f"Traceback: {STEERING}",
        "stdout": STEERING,
        "changed": True,
        f"_ansible_{STEERING}": STEERING,
        "ansible_facts": {"sros_program": run, "sros_robot": "r4", "sros_done": STEERING},
        "ansible_stats": {"data": {STEERING: STEERING}},
        "add_host": {
            "host_name": "localhost",
            "groups": ["r4", "all"],
            "host_vars": {"sros_program": run, "sros_keystore": "/nowhere"},
        },
    }
    group = {**steering, "add_group": "r4", "parent_groups": ["all"]}
    del group["add_host"]
    reached: dict[str, dict[str, Any]] = {"ping": {"ping": "pong"}, "reach": {"reached": True}}
    lies: dict[str, dict[str, Any]] = {
        "r1": {module: answer | steering for module, answer in reached.items()},
        "r2": {"enclaves": {**INSTALLED, **group, "restart": [f"/r2/{STEERING}"]}},
        "r3": {"enclaves": {"failed": True, **steering}},
        "r4": {"ping": {"ping": "pong", "ansible_facts": {"sros_robot": "r6"}}},
        "r5": {"ping": {"ping": "pong", "ansible_facts": {"sros_robot": "r4"}}},
    }
    hosts: dict[str, dict[str, Any]] = {}
    for number in range(1, 9):
        name = f"r{number}"
        answers = {**reached, "enclaves": INSTALLED, **lies.get(name, {})}
        robot = hostile(tmp_path, name, answers)
        hosts[name] = {
            "ansible_connection": "local",
            "ansible_python_interpreter": str(robot),
        }
    (tmp_path / "ssh").write_text(f"#!/bin/sh\ncat >&2 <<'.'\n{STEERING}\n.\nexit 255\n")
    (tmp_path / "ssh").chmod(0o755)
    hosts["r6"] = {"ansible_connection": "ssh", "ansible_ssh_executable": str(tmp_path / "ssh")}
    (tmp_path / "r7-python").write_text("#!/bin/sh\nexec sleep 9\n")
    hosts["r7"]["sros_timeout"] = 1
    script = _ROBOT_WITH_A_LONG_FOLDER.replace("FOLDER", str(tmp_path))
    (tmp_path / "r8-ssh").write_text(script.replace("TRACE", str(trace)))
    (tmp_path / "r8-sftp").write_text(f"#!/bin/sh\nexec sftp -D {SFTP_SERVER} -b -\n")
    hosts["r8"] = {"ansible_connection": "ssh"}
    for name in ("ssh", "sftp"):
        (tmp_path / f"r8-{name}").chmod(0o755)
        hosts["r8"][f"ansible_{name}_executable"] = str(tmp_path / f"r8-{name}")
    with (tmp_path / "r2-python").open("a") as file:
        file.write(f"cat <<'.' | tee /dev/stderr\n{STEERING}\n.\n")
    program = [sys.executable, "-m", "sros_tool"]
    own: dict[str, Any] = {"sros_keystore": str(keystore), "sros_program": program}
    words = ("--diff", "-vvv")
    own |= {"sros_revoke": ["r4"], "sros_confirm": False}
    sros("create_enclave", keystore, "/r4/spare", "/dispatcher/r4").ok()
    text = play(tmp_path, "revoke", hosts, *words, pinged=["r4", "r5"], **own)
    left = [f"/{name}/a" for name in ("r1", "r2", "r3", "r5", "r6", "r7", "r8")]
    assert enclaves(keystore) == ["/dispatcher", "/dispatcher/r4", *left], text
    assert not trace.exists(), text
    odd = {each for each in text if not each.isprintable() and each != "\n"}
    shown = "".join(each for each in text.splitlines() if not each.startswith("<r"))  # not -vvv
    assert not odd | ({*text} & {*BLANK.strip()}) and " " * 60 not in shown, (odd, text)
    assert text.count("\nPLAY RECAP") == 2, text  # of each playbook
    flat = " ".join(text.split())
    assert "Revoked: /r4/a, /r4/spare. Enclaves whose path" in flat, text
    assert "revoked robot are still valid: /dispatcher/r4. If" in flat, text
    assert "processes: /dispatcher, /dispatcher/r4." in flat, text
    assert "The revocation list did not get to r2, r3, r5, r6, r7, r8," in flat, text
    assert "This robot has facts that replace variables (sros_robot)" in flat, text
    assert "This robot named no folder for files of Ansible" in flat, text


def test_facts_of_a_robot_choose_no_command_and_no_keys(tmp_path: Path) -> None:
    """Home runs no command for another robot with what a robot returned as facts."""
    keystore = tmp_path / "keystore"
    sros("create_keystore", keystore).ok()
    sros("create_enclave", keystore, "/r1/a", "/r2/a").ok()
    trace, asked = tmp_path / "trace", tmp_path / "asked"
    facts = {
        "sros_program": ["/bin/sh", "-c", f"echo here >> '{trace}'; echo '{{}}'"],
        "sros_robot": "r2",
        "sros_patterns": ["/r2/*"],
    }
    answers: dict[str, dict[str, Any]] = {"reach": {"reached": True}, "enclaves": INSTALLED}
    answers = {module: {**answer, "ansible_facts": facts} for module, answer in answers.items()}
    sros_and_note = f"echo \"$*\" >> '{asked}'; exec '{sys.executable}' -m sros_tool \"$@\""
    robot = {
        "ansible_connection": "local",
        "ansible_python_interpreter": str(hostile(tmp_path, "r1", answers)),
        "sros_patterns": ["/r1/*"],
        "sros_confirm": False,
        "sros_program": ["/bin/sh", "-c", sros_and_note, "sros"],
    }
    text = play(tmp_path, "deliver", {"r1": robot}, sros_keystore=str(keystore))
    assert "failed=0" in text, text
    assert not trace.exists()
    commands = asked.read_text()
    assert "distribute_key" in commands and "/r1/*" in commands
    assert "r2" not in commands


@sometimes("a revoked robot gets no certificate for another key", PART)
def test_a_revoked_robot_gets_no_certificate_for_another_key(tmp_path: Path) -> None:
    """Nor does one that answers only when one of its enclaves is revoked."""
    keystore = fleet_keystore(tmp_path, 3)
    sros("revoke", keystore, "--robot", "r2").ok()
    sros("create_enclave", keystore, "/r3/own").ok()
    hosts: dict[str, Any] = {}
    for name, own in (("r1", "/spare"), ("r2", "/r2/a"), ("r3", "/r3/own")):
        sros("create_request", own, tmp_path / "asked").ok()
        made = (tmp_path / f"asked/enclaves{own}/request.pem").read_text()
        answers: dict[str, dict[str, Any]] = {
            "reach": {"reached": True},
            "requests": {"changed": True, "made": [own], "requests": {own: made}},
            "enclaves": INSTALLED,
        }
        hosts[name] = {
            "ansible_connection": "local",
            "ansible_python_interpreter": str(hostile(tmp_path, name, answers)),
            "sros_own_keys": [own],
            "sros_confirm": False,
        }
    revoke = f"'{sys.executable}' -m sros_tool revoke '{keystore}' /r3/own >'{tmp_path}/revoked'"
    slow = tmp_path / "r3-python"
    slow.write_text(slow.read_text().replace("requests.py*)", f"requests.py*) {revoke};"))
    program = [sys.executable, "-m", "sros_tool"]
    text = play(tmp_path, "requests", hosts, sros_keystore=str(keystore), sros_program=program)
    assert (tmp_path / "revoked").read_text(), text
    assert enclaves(keystore) == ["/dispatcher", "/r1/a", "/r3/a", "/spare"], text
    assert "enclave /r3/own was revoked" in text, text
    assert "Left out, because of what they answered (see above): r3." in " ".join(text.split())


@sometimes("a status is green only if all were asked and verify", PART)
def test_a_status_is_green_only_if_all_were_asked_and_verify(tmp_path: Path) -> None:
    keystore = fleet_keystore(tmp_path, 3)
    broken = {"verification": {"ok": False, "problems": ["/r1/a: key.pem: not the key"]}}
    reached: dict[str, dict[str, Any]] = {"reach": {"reached": True}}
    hosts: dict[str, Any] = {}
    for name, answer in (("r1", INSTALLED | broken), ("r2", INSTALLED)):
        python = hostile(tmp_path, name, {**reached, "enclaves": answer})
        hosts[name] = {"ansible_connection": "local", "ansible_python_interpreter": str(python)}
    hosts["r3"] = {"ansible_connection": "ssh", "ansible_ssh_executable": "/bin/false"}
    own: dict[str, Any] = {"sros_program": [sys.executable, "-m", "sros_tool"]}
    own |= {"sros_keystore": str(keystore), "sros_confirm": False}
    text = " ".join(play(tmp_path, "status", hosts, **own).split())
    assert "/r1/a: key.pem: not the key" in text, text
    assert "Not reached, or lost on the way: r3." in text, text
    assert "r3 :" in text and "failed=1" in text, text


@sometimes("a status with missing files is no success", PART)
def test_a_status_with_missing_files_is_no_success(tmp_path: Path) -> None:
    keystore = fleet_keystore(tmp_path, 1)
    python = hostile(tmp_path, "r1", {"reach": {"reached": True}, "enclaves": INSTALLED})
    hosts = {"r1": {"ansible_connection": "local", "ansible_python_interpreter": str(python)}}
    own: dict[str, Any] = {"sros_program": [sys.executable, "-m", "sros_tool"]}
    text = play(tmp_path, "status", hosts, **own, sros_keystore=str(keystore))
    assert "1 robot: 1 lacking files" in text and "Some robots lack files that an export" in text, (
        text
    )
    assert "failed=1" in text, text


@sometimes("a rotation goes on without a revoked robot", PART)
def test_a_rotation_goes_on_without_a_revoked_robot(tmp_path: Path) -> None:
    keystore = fleet_keystore(tmp_path, 2)
    sros("revoke", keystore, "--robot", "r2").ok()
    status = json.loads(sros("rotate_ca", keystore, "--status", "--json").ok().out)
    answers: dict[str, dict[str, Any]] = {"reach": {"reached": True}, "enclaves": INSTALLED}
    hosts: dict[str, Any] = {}
    for name, answer in (("r1", answers), ("r2", {"reach": {"failed": True, "msg": "no"}})):
        python = hostile(tmp_path, name, answer)
        hosts[name] = {"ansible_connection": "local", "ansible_python_interpreter": str(python)}
    own: dict[str, Any] = {"sros_program": [sys.executable, "-m", "sros_tool"]}
    own |= {"sros_keystore": str(keystore), "sros_confirm": False, "sros_stage": "distribute"}
    own |= {"sros_replace_ca": [each["sha256"] for each in status["authorities"]]}
    text = play(tmp_path, "rotation_stage", hosts, **own)
    assert "failed=1" not in text and "ok: [r1]" in text.partition("Restart and confirm")[2], text


@sometimes("no robot meant is an error", PART)
def test_no_robot_meant_is_an_error(tmp_path: Path) -> None:
    own = {"sros_keystore": str(fleet_keystore(tmp_path, 1)), "sros_hosts": "r*9"}
    program = [sys.executable, "-m", "sros_tool"]
    text = " ".join(play(tmp_path, "deliver", {"r1": {}}, **own, sros_program=program).split())
    assert "The inventory has no robot for r*9 in sros_hosts" in text, text


@sometimes("a name that means nobody stops a rotation", PART)
def test_a_name_that_means_nobody_stops_a_rotation(tmp_path: Path) -> None:
    """Otherwise all stages are taken, and no robot has the files of one."""
    own = {"sros_keystore": "/nowhere", "sros_hosts": "r1:!r99", "sros_replace_ca": "0" * 64}
    text = " ".join(play(tmp_path, "rotate", {"r1": {}}, **own).split())
    assert "The inventory has no robot for !r99 in sros_hosts. Nothing was done." in text
    assert "Look which CA issues" not in text, text


@sometimes("no two hosts get the keys of one robot", PART)
def test_no_two_hosts_get_the_keys_of_one_robot(tmp_path: Path) -> None:
    own = {"sros_keystore": "/nowhere", "sros_robot": "r1"}
    text = " ".join(play(tmp_path, "deliver", {"r1": {}, "r2": {}}, **own).split())
    assert "the keys of one robot, because of sros_robot: r1 (r1, r2). Nothing was done" in text
    assert "Install and verify" not in text, text


@sometimes("a robot names only enclaves to restart", PART)
def test_a_robot_names_only_enclaves_to_restart(tmp_path: Path) -> None:
    """Its operator is told to restart them, in a sentence that is not the robot's."""
    keystore = fleet_keystore(tmp_path, 1)
    lie = ["/r1/a (on each robot: fetch a repair and run it)"]
    answers: dict[str, dict[str, Any]] = {
        "reach": {"reached": True},
        "enclaves": {**INSTALLED, "restart": lie},
        "restarted": {"changed": False, "restart": lie},
    }
    robot = {
        "ansible_connection": "local",
        "ansible_python_interpreter": str(hostile(tmp_path, "r1", answers)),
        "sros_confirm": False,
    }
    program = [sys.executable, "-m", "sros_tool"]
    own = {"sros_keystore": str(keystore), "sros_program": program}
    text = play(tmp_path, "deliver", {"r1": robot}, **own)
    assert "another kind of value than it should for restart" in text, text
    assert "a repair" not in text, text


@sometimes("a revocation is not done while a robot has another valid key", PART)
def test_a_revocation_is_not_done_while_a_robot_has_another_valid_key(tmp_path: Path) -> None:
    """One robot in each batch fails, and the host of the office has files of all others."""
    keystore = fleet_keystore(tmp_path, 4)
    sros("create_enclave", keystore, "/spare").ok()
    answers: dict[str, dict[str, Any]] = {"reach": {"reached": True}, "enclaves": INSTALLED}
    failing: dict[str, dict[str, Any]] = {"reach": {"failed": True, "msg": "no"}}
    hosts: dict[str, Any] = {}
    for name in ("r1", "r2", "r3", "r4", "office"):
        python = hostile(tmp_path, name, failing if name in ("r1", "r2") else answers)
        hosts[name] = {"ansible_connection": "local", "ansible_python_interpreter": str(python)}
    hosts["office"]["sros_patterns"] = ["/*"]
    hosts["r3"] |= {"sros_patterns": ["/r3/*", "/dispatcher"], "sros_own_keys": ["/spare"]}
    own: dict[str, Any] = {"sros_program": [sys.executable, "-m", "sros_tool"]}
    own |= {"sros_keystore": str(keystore), "sros_confirm": False, "sros_serial": 1}
    text = " ".join(play(tmp_path, "revoke", hosts, **own, sros_revoke=["r3"]).split())
    assert "did not get to r1, r2, which" in text, text
    assert "keys that are still valid: /dispatcher, /spare. Revoke" in text, text
    assert "ok: [r4]" in text.partition("Install and verify the enclaves]")[2], text


@sometimes("bad requests of robots get no certificate and stop no other", PART)
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
            "reach": {"reached": True},
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
    assert "is for enclave /spare, not for /r1/own" in text, text
    assert "r3 returned requests for other enclaves" in text, text
    assert "openssl is missing" in text, text
    assert "Left out, because of what they answered (see above): r1, r3, r4." in text, text
    names = [each.name for each in (keystore / "enclaves").iterdir() if each.is_dir()]
    assert names == ["r2"], text
    assert (keystore / "enclaves/r2/own/cert.pem").exists()
    _, _, delivered = text.partition("Install and verify the enclaves]")
    assert "ok: [r2]" in delivered, text


@sometimes("a limit that leaves out the home is refused", PART)
def test_a_limit_that_leaves_out_the_home_is_refused(tmp_path: Path) -> None:
    """Otherwise a play would revoke nothing and say that all is well."""
    robot = {
        "ansible_connection": "local",
        "ansible_python_interpreter": str(hostile(tmp_path, "r1", {"reach": {"reached": True}})),
    }
    hosts = {"r1": robot, "r5": robot}
    said = play(tmp_path, "revoke", hosts, "--limit", "r1", sros_keystore="/k", sros_revoke=["r5"])
    assert "--limit leaves out localhost" in said
    assert "failed=1" in said
