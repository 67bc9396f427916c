"""The verb env for containers: the paths of the robot, and a key that nobody else gets to see."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from sros_tool.runtime.environment import CONTAINER_FORMS, NO_CONFIGURATION, render_refusal
from tests.runtime.test_containers import check
from tests.support.harness import Running, copy_of, policy_text, publish, sros

THERE = "/etc/sros/keystore"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore of nested enclaves and an export; only read."""
    folder = tmp_path_factory.mktemp("containers")
    names = {each: publish("/x") for each in ("/arm", "/arm/gripper", "/Arm")}
    (folder / "p.xml").write_text(policy_text(names))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=folder).ok()
    sros("distribute_key", "ks", "/arm", "alone", cwd=folder).ok()
    sros("create_request", "/born", "robot", cwd=folder).ok()
    request = "robot/enclaves/born/request.pem"
    sros("sign_request", "ks", request, "-o", "answer.tgz", cwd=folder).ok()
    copy_of(folder / "ks", folder / "zenoh")
    sros("zenoh", "zenoh", "--mode", "peer", cwd=folder).ok()
    return folder


def test_the_paths_are_those_of_the_robot(made: Path) -> None:
    keystore = made / "ks"
    shown = sros("env", keystore, "/arm/gripper", "--format", "compose").ok()
    service = check(shown.out, "compose")["services"]["arm-gripper"]
    assert service["environment"]["ROS_SECURITY_KEYSTORE"] == THERE
    assert service["volumes"][0]["source"] == f"{THERE}/enclaves/arm/gripper"
    assert service["environment"]["ZENOH_SESSION_CONFIG_URI"] == NO_CONFIGURATION
    words = ("--target", "/srv/$k", "--name", "grip", "--image", "grip:2", "--domain", "0")
    shown = sros("env", keystore, "/Arm", "--format", "kubernetes", *words).ok()
    deployment = check(shown.out, "kubernetes")
    assert deployment["metadata"]["name"] == "grip"
    assert 'value: "/srv/$$k"' in shown.out and str(made) not in shown.out
    shown = sros("env", keystore, "/arm", "--target", "/srv/k", "--rmw", "rmw_cyclonedds_cpp").ok()
    assert "KEYSTORE=/srv/k\n" in shown.out and "ZENOH" not in shown.out


def test_zenoh_has_the_paths_of_the_robot_too(made: Path) -> None:
    words = ("--format", "kubernetes", "--rmw", "rmw_zenoh_cpp")
    inherited = {"ZENOH_ROUTER_CONFIG_URI": "/etc/r.json5"}
    shown = sros("env", made / "zenoh", "/arm/gripper", *words, env=inherited).ok()
    check(shown.out, "kubernetes")
    assert f"value: {THERE}/enclaves/arm/gripper/session.json5" in shown.out
    assert str(made) not in shown.out
    assert "enclave-argument" in shown.err and "zenoh.replaced" not in shown.err
    shown = sros("env", made / "zenoh", "/arm/gripper", "--format", "kubernetes-secret").ok()
    assert {"session.json5", "session.p7s"} <= check(shown.out, "kubernetes-secret")["data"].keys()


def test_a_key_that_was_made_on_the_robot_is_not_missed(made: Path) -> None:
    for form in ("compose", "kubernetes"):
        check(sros("env", made / "ks", "/born", "--format", form).ok().out, form)
    assert sros("env", made / "ks", "/born").status == 2
    refused = sros("env", made / "ks", "/born", "--format", "kubernetes-secret")
    assert refused.status == 2 and "made on its robot" in refused.err


def test_no_container_sees_the_keys_of_others(made: Path) -> None:
    words = ("/arm", "--format", "compose")
    refused = sros("env", made / "ks", *words)
    assert (refused.status, refused.out) == (2, render_refusal("compose"))
    assert "also has /arm/gripper" in refused.err
    shown = sros("env", made / "alone", *words).ok()
    check(shown.out, "compose")
    refused = sros("env", made / "ks", "/Arm", *words[1:], "--target", made / "ks")
    assert refused.status == 2 and "a container cannot use" in refused.err
    sros("env", made / "alone", *words, "--target", made / "alone").ok()
    shown = sros("env", made / "ks", "/arm", "--format", "kubernetes-secret").ok()
    secret = check(shown.out, "kubernetes-secret")
    folder = made / "alone/enclaves/arm"
    wanted = {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}
    found = {name: base64.b64decode(data) for name, data in secret["data"].items()}
    assert found == wanted and "key.pem" in found


@pytest.mark.parametrize(("mode", "status"), [(0o600, 0), (0o644, 2), (0o640, 2)])
def test_a_secret_goes_to_no_file_that_others_can_read(
    mode: int, status: int, made: Path, tmp_path: Path
) -> None:
    output = tmp_path / "secret.yaml"
    output.touch()
    output.chmod(mode)
    words = ("env", made / "ks", "/arm", "--format", "kubernetes-secret")
    ended = Running(*words, write_to=output).end()
    assert ended.status == status, ended
    assert (output.read_text() == render_refusal("kubernetes-secret")) == bool(status)
    assert ("key.pem" in output.read_text()) == (not status)


@pytest.mark.parametrize("form", CONTAINER_FORMS)
@pytest.mark.parametrize(
    "words",
    [
        ("/none",),
        ("/arm", "--target", "relative"),
        ("/arm", "--target", ""),
        ("/arm", "--target", "/a/../b"),
        ("/arm", "--target", "//a"),
        ("/arm", "--name", "a b", "--target", "/k"),
        ("/arm", "--image", ""),
        ("/arm", "--no-such-option"),
    ],
)
def test_what_cannot_be_given_is_refused_in_its_form(
    words: tuple[str, ...], form: str, made: Path
) -> None:
    refused = sros("env", made / "alone", *words, "--format", form)
    assert (refused.status, refused.out) == (2, render_refusal(form))
    assert len(refused.err.splitlines()) == 1


@pytest.mark.parametrize("form", ["sh", "docker", "kubernetes-secret"])
@pytest.mark.parametrize("option", ["--name", "--image"])
def test_an_option_that_would_have_no_effect_is_refused(option: str, form: str, made: Path) -> None:
    refused = sros("env", made / "alone", "/arm", "--format", form, option, "x")
    assert refused.status == 2 and f"the format {form} has no {option}" in refused.err
