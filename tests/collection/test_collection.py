"""The collection as Ansible reads it: documentation, syntax, and what robots need."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from ansible_collections.sros.fleet.plugins.filter.due_units import due_units, without_unit
from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from sros_tool import __version__
from tests.integration.robots import CHECKOUT
from tests.support.children import run
from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import some

COLLECTION = CHECKOUT / "ansible_collections/sros/fleet"
PLAYS = sorted(path.stem for path in (COLLECTION / "playbooks").glob("*.yml"))
BIN = Path(sys.executable).parent
FOR_ROBOTS = ("plugins/modules", "plugins/module_utils")
_STANDARD = sys.stdlib_module_names

needs_ansible = pytest.mark.skipif(
    not (BIN / "ansible-playbook").exists(), reason="ansible-core is needed"
)


def ansible(program: str, *words: object, folder: Path) -> str:
    environment = {
        **os.environ,
        "ANSIBLE_HOME": str(folder),
        "ANSIBLE_COLLECTIONS_PATH": str(CHECKOUT),
        "ANSIBLE_DEPRECATION_WARNINGS": "1",
        "LC_ALL": "C.UTF-8",
    }
    done = run([BIN / program, *words], env=environment, cwd=folder)
    assert "WARNING" not in done.stderr.replace("provided hosts list is empty", ""), done.stderr
    return done.stdout


@needs_ansible
def test_the_syntax_of_each_play(tmp_path: Path) -> None:
    assert {"deliver", "renew", "change", "revoke", "rotate", "requests", "status"} <= set(PLAYS)
    chosen = some(PLAYS, 5)
    plays = [f"sros.fleet.{each}" for each in chosen]
    facts = json.dumps({"sros_stage": "reissue", "sros_revoke": ["r1"]})
    (tmp_path / "inventory.json").write_text('{"all": {"hosts": {"r1": {}}}}')
    words = ("-i", tmp_path / "inventory.json", "--syntax-check", "-e", facts)
    said = ansible("ansible-playbook", *words, *plays, folder=tmp_path)
    assert said.count("playbook:") == len(chosen)


def test_each_play_looks_at_the_names_first() -> None:
    """Otherwise enclaves are renewed at home before a name that is misspelt stops the play."""
    of_user = {"deliver", "renew", "change", "revoke", "rotation_stage", "requests", "status"}
    assert set(PLAYS) - of_user == {"hosts", "report", "rotate", "sign_rights"}
    for name in of_user:
        first = yaml.safe_load((COLLECTION / f"playbooks/{name}.yml").read_text())[0]
        assert first["ansible.builtin.import_playbook"] == "hosts.yml", name


def test_two_hosts_of_one_robot_are_named() -> None:
    """Those with patterns get what these say, whatever their robot is called."""
    from ansible_collections.sros.fleet.plugins.filter.sharing import sharing

    hosts: dict[str, dict[str, object]] = {"r1": {}, "r2": {"sros_robot": "r1"}, "r4": {}}
    hosts["r3"] = {"sros_robot": "r1", "sros_patterns": ["/r3/*"]}
    assert sharing(hosts, [*hosts]) == ["r1 (r1, r2)"]
    assert not sharing(hosts, ["r2", "r3", "r4"])


@needs_ansible
def test_the_documentation_of_each_part(tmp_path: Path) -> None:
    dump = ansible("ansible-doc", "--metadata-dump", "sros.fleet", folder=tmp_path)
    found = json.loads(dump)["all"]
    for kind, files in (("module", "modules/*.*"), ("filter", "filter/*.*")):
        stems = {path.stem for path in (COLLECTION / "plugins").glob(files)}
        assert found[kind].keys() == {f"sros.fleet.{stem}" for stem in stems}
    for name, parts in found["module"].items():
        assert parts["examples"].strip(), name
        assert parts["return"], name
        assert all(each.get("description") for each in parts["doc"]["options"].values()), name
        source = (COLLECTION / f"plugins/modules/{name.rpartition('.')[2]}.py").read_text()
        given = set(re.findall(r'^\s+"(\w+)": \{"type"', source, re.MULTILINE))
        assert given == set(parts["doc"]["options"]), name
    (role,) = found["role"].values()
    defaults = (COLLECTION / "roles/robot/defaults/main.yml").read_text()
    known = set(re.findall(r"^(\w+):", defaults, re.MULTILINE)) | {"sros_keystore"}
    assert known == set(role["entry_points"]["main"]["options"])


def test_robots_need_an_old_python_and_nothing_else() -> None:
    for folder in FOR_ROBOTS:
        for path in (COLLECTION / folder).glob("*.py"):
            tree = ast.parse(path.read_text(), feature_version=(3, 8))
            for node in ast.walk(tree):
                names = []
                if isinstance(node, ast.Import):
                    names = [each.name for each in node.names]
                elif isinstance(node, ast.ImportFrom):
                    names = [node.module or ""]
                for name in names:
                    own = name.startswith(("ansible_collections.sros", "ansible.module_utils"))
                    assert own or name.partition(".")[0] in _STANDARD, (path, name)


def test_the_version_is_that_of_sros() -> None:
    assert (
        f"\nversion: {__version__.replace('.dev', '-dev')}\n"
        in (COLLECTION / "galaxy.yml").read_text()
    )


def test_units_to_restart_are_in_order() -> None:
    units = [
        {"name": "camera", "enclaves": ["/r1/camera"]},
        {"name": "both", "enclaves": ["/r1/camera", "/r1/base"]},
        {"name": "router", "enclaves": ["/r1/router"]},
        {"name": "all"},
    ]
    assert due_units(units, []) == []
    assert due_units(units, ["/r1/base"]) == ["both", "all"]
    changed = ["/r1/camera", "/r1/router"]
    assert due_units(units, changed, ["/r1/router"]) == ["router", "camera", "both", "all"]
    assert without_unit(["/r1/x", "/r1/base"], units[:2]) == ["/r1/x"]


@needs_ansible
def test_what_is_said_restarted_has_no_files_of_the_same_play(tmp_path: Path) -> None:
    """They came after the restart; what a unit runs was restarted by the play."""
    names = ["/r1/before", "/r1/new", "/r1/unit"]
    found = {"restart": names, "changed_enclaves": ["/r1/new", "/r1/unit"], "routers": []}
    (tmp_path / "keystore").mkdir(mode=0o700)
    record = tmp_path / ".keystore.sros-restart"
    record.write_text(json.dumps(names))
    record.chmod(0o600)
    variables = {
        "sros_enclaves": found,
        "sros_units": [{"name": "a.service", "enclaves": ["/r1/unit"]}],
        "sros_systemctl": ["true"],
        "sros_restarted": True,
        "sros_dest": str(tmp_path / "keystore"),
        "sros_prefix": "",
        "sros_timeout": 60,
    }
    role = {"name": "sros.fleet.robot", "tasks_from": "restart.yml"}
    tasks = [{"ansible.builtin.include_role": role}]
    play = {"hosts": "localhost", "gather_facts": False, "vars": variables, "tasks": tasks}
    (tmp_path / "play.yml").write_text(json.dumps([play]))
    local = {"ansible_connection": "local", "ansible_python_interpreter": sys.executable}
    hosts = {"localhost": local}
    (tmp_path / "inventory.json").write_text(json.dumps({"all": {"hosts": hosts}}))
    said = ansible("ansible-playbook", "-i", "inventory.json", "play.yml", folder=tmp_path)
    assert "Restart the processes of /r1/new, which no unit" in " ".join(said.split())
    assert json.loads(record.read_text()) == ["/r1/new"]


@needs_ansible
def test_a_revoked_robot_is_left_out_and_no_failure(tmp_path: Path) -> None:
    """Otherwise a robot that was revoked before would stop every delivery to the others."""
    from ansible_collections.sros.fleet.plugins.action.enclaves import export
    from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import LeftOutError

    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}/a": publish("a")}))
    (tmp_path / "fleet.toml").write_text("[robots]\nr1 = {}\nr2 = {}\nr3 = {}\n")
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", tmp_path / "ks", *words).ok()
    sros("revoke", tmp_path / "ks", "--robot", "r1").ok()
    shutil.rmtree(tmp_path / "ks/enclaves/r3")
    arguments = {"keystore": tmp_path / "ks", "program": [sys.executable, "-m", "sros_tool"]}
    assert export({**arguments, "robot": "r2"})
    with pytest.raises(LeftOutError, match="All enclaves of r1 are revoked"):
        export({**arguments, "robot": "r1"})
    with pytest.raises(RefusedError, match="the robot r3 has no enclave") as refused:
        export({**arguments, "robot": "r3"})
    assert not isinstance(refused.value, LeftOutError)


@needs_ansible
def test_facts_named_as_variables_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from ansible import constants

    from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

    def task(*names: str) -> dict[str, object]:
        """Return the variables of a task on a robot that has facts with these names."""
        known = dict.fromkeys(names, "x")
        injected = known if constants.INJECT_FACTS_AS_VARS else {}
        return {"my_keystore": "/ks", **injected, "ansible_facts": known}

    for inject, refused in ((True, "my_keystore"), (True, "sros_robot"), (False, "sros_robot")):
        monkeypatch.setattr(constants, "INJECT_FACTS_AS_VARS", inject)
        with pytest.raises(RefusedError, match=f"replace variables \\({refused}\\)"):
            check_facts(task("distribution", refused) if not inject else task(refused))
    check_facts(task("distribution", "my_keystore"))


@needs_ansible
@pytest.mark.parametrize("fact", ["control_path", "sftp_executable", "host_key_checking"])
def test_facts_that_set_ssh_at_home_are_refused(fact: str) -> None:
    """Ansible takes them for its settings, though they come from a robot."""
    from ansible.plugins.loader import connection_loader

    from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

    assert connection_loader.get("ssh", class_only=True)
    with pytest.raises(RefusedError, match=f"replace variables \\({fact}\\)"):
        check_facts({f"ansible_{fact}": "x", "ansible_facts": {fact: "x", "distribution": "x"}})
    check_facts({"ansible_distribution": "x", "ansible_facts": {"distribution": "x"}})
