"""rcl's rules of which enclave is loaded, and the warnings about misspelt values."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import ENCLAVE_FILES
from sros_tool.runtime.variables import choose_enclave, choose_loadable, domain_of


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "enclaves" / "a" / "b").mkdir(parents=True)
    return {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(tmp_path),
        "ROS_SECURITY_ENCLAVE_OVERRIDE": "/a/b",
    }


def test_the_enclave_of_the_override(environment: dict[str, str], tmp_path: Path) -> None:
    assert choose_enclave(environment, "/other").enclave == tmp_path / "enclaves/a/b"


def test_the_enclave_of_the_argument(environment: dict[str, str], tmp_path: Path) -> None:
    del environment["ROS_SECURITY_ENCLAVE_OVERRIDE"]
    assert choose_enclave(environment, "/a").enclave == tmp_path / "enclaves/a"
    assert choose_enclave(environment).enclave == tmp_path / "enclaves"


@pytest.mark.parametrize("value", ["True", "1", "TRUE", "yes", "", " true", None])
def test_only_true_switches_security_on(environment: dict[str, str], value: str | None) -> None:
    environment.pop("ROS_SECURITY_ENABLE")
    if value is not None:
        environment["ROS_SECURITY_ENABLE"] = value
    assert choose_enclave(environment).enclave is None


@pytest.mark.parametrize("change", [{"KEYSTORE": ""}, {"ENCLAVE_OVERRIDE": "/missing"}])
@pytest.mark.parametrize(
    ("strategy", "starts"),
    [("Enforce", False), ("enforce", True), ("Permissive", True), ("", True)],
)
def test_a_missing_enclave(
    environment: dict[str, str], change: dict[str, str], strategy: str, starts: bool
) -> None:
    environment |= {f"ROS_SECURITY_{name}": value for name, value in change.items()}
    environment["ROS_SECURITY_STRATEGY"] = strategy
    if starts:
        assert choose_enclave(environment).enclave is None
    else:
        with pytest.raises(SrosError):
            choose_enclave(environment)
    environment["ROS_SECURITY_KEYSTORE"] = "/no/keystore"
    if starts:
        assert "KEYSTORE is /no/keystore, which does not" in choose_enclave(environment).note


@pytest.mark.parametrize(("strategy", "starts"), [("Enforce", False), ("Permissive", True)])
def test_a_missing_file(
    environment: dict[str, str], tmp_path: Path, strategy: str, starts: bool
) -> None:
    """The RMWs run a node unsecured, or not at all; with all files, secured."""
    environment["ROS_SECURITY_STRATEGY"] = strategy
    folder = tmp_path / "enclaves/a/b"
    for name in ENCLAVE_FILES:
        (folder / name).touch()
    assert choose_loadable(environment).enclave == folder
    (folder / "key.pem").unlink()
    if starts:
        choice = choose_loadable(environment)
        assert choice.enclave is None
        assert "key.pem" in choice.note
    else:
        with pytest.raises(SrosError, match=r"couldn't find all security files.*key\.pem"):
            choose_loadable(environment)


def test_domains() -> None:
    assert domain_of({}) == 0
    assert domain_of({"ROS_DOMAIN_ID": "42"}) == 42
    for wrong in ("231", "-1", "x", " 7 "):
        with pytest.raises(SrosError):
            domain_of({"ROS_DOMAIN_ID": wrong})
