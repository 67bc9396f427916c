"""Ansible inventories in place of fleet files, read as Ansible reads them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sros_tool.errors import SrosError
from sros_tool.fleet.fleet_file import inventory, parse_fleet, read_fleet, script_inventory
from sros_tool.fleet.robots import Fleet
from tests.support.long_form import ONLY_LONG, sometimes

HOSTS = """
all:
  vars: {ansible_user: ros, other: "{{ not read }}"}
  hosts:
    lone: {sros_renewal: allowed, sros_renewal_grace: 30d}
  children:
    carriers:
      vars: {sros_domain: 5, ansible_user: pilot}
      hosts:
        r1: {ansible_host: 10.0.0.1}
        r2.example.com: {sros_robot: r2, sros_domain: "7", sros_namespace: /hall/r2}
      children:
        heavy:
          hosts: {r1: }
    not-a-name:
      hosts: {lone: }
"""
TOML = """
[groups.carriers]
[groups.heavy]
[robots]
lone = { user = "ros", renewal = "allowed", renewal_grace = "30d" }
r1 = { user = "pilot", address = "10.0.0.1", domain = 5, groups = ["carriers", "heavy"] }
r2 = { user = "pilot", address = "r2.example.com", domain = 7, namespace = "/hall/r2",
       groups = ["carriers"] }
""".replace(",\n      ", ",")


def fleet_in(folder: Path, name: str, text: str) -> Fleet:
    (folder / name).write_text(text)
    return read_fleet(folder / name)


def test_an_inventory_states_what_a_fleet_file_states(tmp_path: Path) -> None:
    wanted = parse_fleet(TOML.encode(), "it")
    assert fleet_in(tmp_path, "hosts.yml", HOSTS) == wanted
    for write in (inventory, script_inventory):
        text = json.dumps(write(wanted))
        assert fleet_in(tmp_path, "hosts.json", text) == wanted
        assert fleet_in(tmp_path, "hosts.yaml", text) == wanted


@sometimes("inventories as Ansible reads them")
def test_ansible_reads_the_same_in_both_directions(tmp_path: Path) -> None:
    """The real `ansible-inventory` writes what is read here, and reads what is written here."""
    wanted = fleet_in(tmp_path, "hosts.yml", HOSTS)
    program = Path(sys.executable).parent / "ansible-inventory"

    def listed(file: str, *words: str) -> str:
        command = [str(program), "-i", str(tmp_path / file), "--list", *words]
        environment = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "LC_ALL": "C.UTF-8"}
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        return done.stdout

    assert fleet_in(tmp_path, "listed.json", listed("hosts.yml")) == wanted
    assert fleet_in(tmp_path, "listed.yml", listed("hosts.yml", "--yaml")) == wanted
    (tmp_path / "ours.json").write_text(json.dumps(inventory(wanted)))
    found = json.loads(listed("ours.json"))
    assert found["_meta"]["hostvars"]["r2"] == {
        "ansible_host": "r2.example.com", "ansible_user": "pilot", "sros_domain": 7,
        "sros_namespace": "/hall/r2", "sros_robot": "r2",
    }  # fmt: skip
    assert found["carriers"]["hosts"] == ["r1", "r2"]


DIAMONDS = {f"g{i}": {"children": [f"g{i + 1}", f"h{i + 1}"]} for i in range(30)} | {
    f"h{i}": {"children": [f"g{i + 1}", f"h{i + 1}"]} for i in range(1, 30)
}


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("h.yml", "- a\n- b\n", "top level is not a mapping"),
        ("h.json", "[1]", "top level is not a mapping"),
        ("h.json", "{", "not valid JSON"),
        ("h.json", "[" * 100_000, "nested too deeply"),
        ("h.yml", "[" * 500, "nested too deeply"),
        ("h.yml", "[" * 100_000, "nest"),  # a newer libyaml says so itself
        ("h.yml", "a: &x {hosts: {}}\nb: *x\n", "See line 2."),
        ("h.yml", "a: !vault x\n", "text, numbers, lists"),
        ("h.yml", "a: !!python/object/apply:os.system ['id']\n", "text, numbers, lists"),
        ("h.yml", "a: {\n", "text, numbers, lists"),
        ("h.yml", "all: {hosts: {'r[1:50]': }}", "r[1:50]"),
        ("h.yml", "all: {hosts: {r-1: }}", "sros_robot: r7"),
        ("h.yml", "all: {hosts: {'<r7/>': }}", "sros_robot: r7"),
        ("h.yml", "all: {hosts: {r1: {sros_robot: 7}}}", "not a text"),
        ("h.yml", "all: {hosts: {r1: , a: {sros_robot: r1}}}", "the same robot name r1"),
        ("h.yml", "all: {hosts: {localhost: }}", "means something else"),
        ("h.yml", "all: {hosts: {h: {sros_robot: all}}}", "means something else"),
        ("h.yml", "arm: {hosts: {arm: }}", "'arm' is a robot and a group"),
        ("h.yml", "all: {hosts: {r1: {ansible_host: '{{ x }}'}}}", "hosts.r1.ansible_host"),
        ("h.yml", "all: {hosts: {r1: {ansible_host: '-oProxyCommand=id'}}}", "ansible_host"),
        ("h.yml", "all: {hosts: {r1: {sros_domain: 500}}}", "hosts.r1.sros_domain"),
        ("h.yml", "all: {hosts: {r1: {sros_namespace: 'a b'}}}", "hosts.r1.sros_namespace"),
        ("h.yml", "all: {hosts: 7}", "not a mapping"),
        ("h.yml", "all: {children: {a: 7}}", "not a mapping"),
        ("h.yml", "7: {hosts: {r1: }}", "not a text"),
        ("h.yml", "a: {vars: {sros_domain: 1}, hosts: {r: }}\nb: {vars: {sros_domain: 2}, "
         "hosts: {r: }}", "gets sros_domain from two groups"),
        ("h.json", '{"a": {"children": ["b"]}, "b": {"children": ["a"]}, "all": {"children": '
         '["a"]}}', "contains itself"),
        pytest.param("h.json", json.dumps(DIAMONDS), "more than 200000", marks=ONLY_LONG),
        ("h.yml", "all: {}", "no robot"),
        ("hosts", "[carriers]\nr1 ansible_host=10.0.0.1\n", "ansible-inventory -i"),
        ("hosts.ini", "r1\nr2\n", "ansible-inventory -i"),
    ],
)  # fmt: skip
def test_what_is_not_read_is_refused(tmp_path: Path, name: str, text: str, problem: str) -> None:
    with pytest.raises(SrosError) as caught:
        fleet_in(tmp_path, name, text)
    assert problem in str(caught.value)
    assert name in str(caught.value)
