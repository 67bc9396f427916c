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
    """The class `SecuredNodes` with the parts of launch that it uses: texts are as they are."""

    class Action:
        @classmethod
        def parse(cls, entity: object, parser: object) -> tuple[type, dict[str, Any]]:
            return cls, {}

    launch, frontend, utilities = map(ModuleType, ("launch", "launch.frontend", "launch.utilities"))
    launch.__dict__.update(Action=Action, LaunchContext=object, SomeSubstitutionsType=str)
    frontend.__dict__.update(Entity=object, Parser=object, expose_action=lambda _: lambda c: c)
    utilities.__dict__.update(
        normalize_to_list_of_substitutions=lambda text: [text],
        perform_substitutions=lambda _, parts: "".join(parts),
    )
    modules = {each.__name__: each for each in (launch, frontend, utilities)}
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
    return SimpleNamespace(launch_configurations=named, environment={})


def test_every_process_starts_by_the_policy(action: Any) -> None:
    at = context()
    hostile = "a b'; touch x; $(id).xml"
    action(keystore="ks", policy=hostile).execute(at)
    own = ["-P", "-m", "sros_tool", "run", "ks", "--policy", hostile, "--"]
    assert shlex.split(at.launch_configurations[PREFIX]) == [sys.executable, *own]
    assert at.environment == REFUSING
    debugged = context(launch_prefix="gdb -ex run --args")
    action(keystore="ks", policy="p.xml").execute(debugged)
    assert debugged.launch_configurations[PREFIX].endswith(" -- gdb -ex run --args")


def test_what_would_leave_a_process_out_is_refused(action: Any, tmp_path: Path) -> None:
    for at, given, why in (
        (context(launch_prefix_filter="x"), {}, FILTER),
        (context(), {"policy": ""}, "is empty"),
        (context(), {"keystore": ""}, "is empty"),
        (context(), {"enclave": "/a"}, "keystore"),
    ):
        words = {"keystore": str(tmp_path / "none\x1b[2J"), "policy": "p.xml", **given}
        with pytest.raises(RuntimeError, match=why) as error:
            action(**words).execute(at)
        assert "\x1b" not in str(error.value)
        assert PREFIX not in at.launch_configurations and not at.environment


def test_launch_itself_may_have_an_enclave(action: Any, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text({"/launch": publish("/x")}))
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", tmp_path / "p.xml").ok()
    at = context()
    action(keystore=str(tmp_path / "ks"), policy="p.xml", enclave="/launch").execute(at)
    assert at.environment["ROS_SECURITY_ENCLAVE_OVERRIDE"] == "/launch"
    assert at.environment["ROS_SECURITY_KEYSTORE"] == str(tmp_path / "ks")
    with pytest.raises(RuntimeError, match="/other"):
        action(keystore=str(tmp_path / "ks"), policy="p.xml", enclave="/other").execute(context())


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
    show = "import os, sys; print(sys.argv[1], os.environ.get('ROS_SECURITY_ENCLAVE_OVERRIDE'))"

    def process(name: str, **more: str) -> Any:
        words = [sys.executable, "-c", show, name, "--ros-args", "-r", f"__node:={name}"]
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
    assert "n /line" in said and "own None" in said
    assert "has the node /stranger in no enclave" in said and "stranger None" not in said
