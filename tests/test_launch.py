"""The action of launch files: what it sets for the processes that follow.

The real launch package is on no package index, so its few functions are replaced here; with a
sourced ROS 2 the last test starts processes with the real one.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import shlex
import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from sros_tool.runtime.environment import REFUSING
from tests.support.harness import policy_text, publish, sros

PREFIX, FILTER = "launch-prefix", "launch-prefix-filter"


@pytest.fixture
def action() -> Iterator[Any]:
    """The class `SecuredNodes` with the parts of launch that it uses: texts are as they are.

    The node of launch that would start keeps the variables that it starts with.
    """

    class Action:
        @classmethod
        def parse(cls, entity: object, parser: object) -> tuple[type, dict[str, Any]]:
            return cls, {}

    class Executable:
        def __init__(self, *cmd: str, name: str | None = None) -> None:
            self.name, self.cmd = name, list(cmd)

        def prepare(self, at: Any, action: object) -> None:
            self.final_cmd = shlex.split(at.launch_configurations[PREFIX]) + self.cmd
            self._Executable__final_name = f"{self.name or os.path.basename(self.final_cmd[0])}-7"

        @property
        def final_name(self) -> str:
            return self._Executable__final_name

    names = ("launch", "launch.descriptions", "launch.frontend", "launch.utilities")
    launch, descriptions, frontend, utilities = map(ModuleType, names)
    adapters = ModuleType("launch_ros.ros_adapters")
    launch.__dict__.update(
        Action=Action,
        LaunchContext=object,
        LaunchDescription=lambda entities: SimpleNamespace(entities=entities),
        SomeSubstitutionsType=str,
    )
    descriptions.__dict__["Executable"] = Executable
    adapters.__dict__["get_ros_adapter"] = lambda at: setattr(at, "node", dict(at.environment))
    frontend.__dict__.update(Entity=object, Parser=object, expose_action=lambda _: lambda c: c)
    utilities.__dict__.update(
        normalize_to_list_of_substitutions=lambda text: [text],
        perform_substitutions=lambda _, parts: "".join(parts),
    )
    made = (launch, descriptions, frontend, utilities, adapters)
    modules = {module.__name__: module for module in made}
    before = {name: sys.modules.get(name) for name in (*modules, "sros_tool.launch")}
    sys.modules.pop("sros_tool.launch", None)
    sys.modules.update(modules)
    yield importlib.import_module("sros_tool.launch").SecuredNodes
    for name, module in before.items():
        sys.modules.pop(name)
        if module:
            sys.modules[name] = module


def context(**configurations: str) -> SimpleNamespace:
    named = {name.replace("_", "-"): value for name, value in configurations.items()}
    return SimpleNamespace(launch_configurations=named, environment={"HOME": "/root"})


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with a keystore ``ks`` and its policy ``p.xml``."""
    policy = policy_text({"/line": publish("/x"), "/launch": publish("/y")})
    (tmp_path / "p.xml").write_text(policy)
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", tmp_path / "p.xml").ok()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_process_starts_by_the_policy(action: Any, place: Path) -> None:
    hostile = "a b'; touch x; $(id).xml"
    (place / "p.xml").rename(hostile)
    at = context()
    action(keystore="ks", policy=hostile).execute(at)
    own = ["-P", "-m", "sros_tool", "run", f"{place}/ks", "--policy", f"{place}/{hostile}", "--"]
    assert shlex.split(at.launch_configurations[PREFIX]) == [sys.executable, *own]
    assert at.environment == {"HOME": "/root", **REFUSING} and not hasattr(at, "node")


def test_a_process_keeps_the_label_of_its_output(action: Any, place: Path) -> None:
    executable = sys.modules["launch.descriptions"].__dict__["Executable"]

    def label(at: Any, **named: str) -> str:
        process = executable("/opt/ros/lib/camera", "--ros-args", "--", "x", **named)
        process.prepare(at, None)
        return str(process.final_name)

    at, debugged = context(), context(launch_prefix="/usr/bin/gdb -ex run --args")
    for secured in (at, debugged):
        action(keystore="ks", policy="p.xml").execute(secured)
    assert (label(at), label(at, name="front")) == ("camera-7", "front-7")
    assert debugged.launch_configurations[PREFIX].endswith(" -- /usr/bin/gdb -ex run --args")
    assert (label(debugged), label(context(launch_prefix="env"))) == ("gdb-7", "env-7")


def test_what_would_leave_a_process_out_is_refused(action: Any, place: Path) -> None:
    for at, given, why in (
        (context(launch_prefix_filter="x"), {}, FILTER),
        (context(), {"policy": ""}, "is empty"),
        (context(), {"keystore": ""}, "is empty"),
        (context(), {"policy": "none\x1b[2J"}, "none"),
        (context(), {"keystore": "none\x1b[2J", "enclave": "/a"}, "keystore"),
    ):
        before = dict(at.environment)
        with pytest.raises(RuntimeError, match=why) as error:
            action(**{"keystore": "ks", "policy": "p.xml", **given}).execute(at)
        assert "\x1b" not in str(error.value)
        assert PREFIX not in at.launch_configurations and at.environment == before


def test_launch_itself_may_have_an_enclave(action: Any, place: Path) -> None:
    """Its variables are those of its node alone: other processes are not to run with them."""

    def enclave_of_launch(**enclave: str) -> str:
        at = context()
        action(keystore="ks", policy="p.xml", **enclave).execute(at)
        assert at.environment == {"HOME": "/root", **REFUSING}
        assert at.node["ROS_SECURITY_KEYSTORE"] == str(place / "ks")
        return str(at.node["ROS_SECURITY_ENCLAVE_OVERRIDE"])

    assert enclave_of_launch(enclave="/launch") == "/launch"
    with pytest.raises(RuntimeError, match="/other"):
        enclave_of_launch(enclave="/other")
    policy = (place / "p.xml").read_text()
    (place / "p.xml").write_text(policy.replace('node="n"', 'node="launch_ros_*"', 1))
    assert enclave_of_launch() == "/line" != enclave_of_launch(enclave="/launch")
    (place / "p.xml").write_text(policy.replace('node="n"', 'node="launch_ros_*"'))
    with pytest.raises(RuntimeError, match="in 2 enclaves"):
        enclave_of_launch()


def test_the_option_of_ros2_launch(action: Any) -> None:
    option = sys.modules["sros_tool.launch"].__dict__["SecuredOption"]()
    parser = ArgumentParser()
    for name in ("--launch-prefix", "--launch-prefix-filter"):
        parser.add_argument(name)
    option.add_arguments(parser, "launch")
    open_robot = SimpleNamespace(entities=["robot.launch.py"])
    without = parser.parse_args(["--launch-prefix", "gdb"])
    option.prestart(without)
    assert option.prelaunch(open_robot, without) == (open_robot,)
    asked = ["--secured", "ks", "p.xml"]
    option.prestart(parser.parse_args(asked))
    (closed,) = option.prelaunch(open_robot, parser.parse_args(asked))
    secured, rest = closed.entities
    assert isinstance(secured, action) and rest == "robot.launch.py"
    assert secured._given == (["ks"], ["p.xml"], [""])
    for more in ("--launch-prefix", "--launch-prefix-filter"):
        with pytest.raises(RuntimeError, match="--secured"):
            option.prestart(parser.parse_args([*asked, more, "gdb"]))


def test_its_attributes_in_xml(action: Any) -> None:
    given = {"keystore": "ks", "policy": "p.xml"}

    def attribute(name: str, *, optional: bool = False) -> str | None:
        return given.get(name) if optional else given[name]

    parser = SimpleNamespace(parse_substitution=lambda text: f"<{text}>")
    kind, arguments = action.parse(SimpleNamespace(get_attr=attribute), parser)
    assert (kind, arguments) == (action, {"keystore": "<ks>", "policy": "<p.xml>"})
    given["enclave"] = "/launch"
    assert action.parse(SimpleNamespace(get_attr=attribute), parser)[1]["enclave"] == "</launch>"


def test_with_the_launch_package_of_ros(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    if not importlib.util.find_spec("launch"):
        pytest.skip("there is no launch package: source a ROS 2")
    launch: Any = importlib.import_module("launch")
    actions: Any = importlib.import_module("launch.actions")
    secured: Any = importlib.import_module("sros_tool.launch").SecuredNodes
    policy, root = tmp_path / "p.xml", tmp_path / "ks"
    policy.write_text(policy_text({"/line": publish("/x")}))
    sros("generate_artifacts", "-k", root, "-p", policy).ok()
    show = tmp_path / "show"
    show.write_text('#!/bin/sh\necho "$1 ${ROS_SECURITY_ENCLAVE_OVERRIDE-None}"\n')
    show.chmod(0o700)

    def process(name: str, **more: str) -> Any:
        words = [str(show), name, "--ros-args", "-r", f"__node:={name}"]
        return actions.ExecuteProcess(cmd=words, output="screen", **more)

    service = launch.LaunchService()
    service.include_launch_description(
        launch.LaunchDescription(
            [
                secured(keystore=str(root), policy=str(policy)),
                process("n"),
                process("stranger"),
                process("own", prefix="env"),
            ]
        )
    )
    before = dict(os.environ)
    try:
        service.run()
    finally:
        os.environ.clear()
        os.environ.update(before)
    said = "".join(capfd.readouterr())
    assert "[show-1] n /line" in said and "own None" in said
    assert "has the node /stranger in no enclave" in said and "stranger None" not in said
