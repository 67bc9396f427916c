"""Nothing is found in what sros itself makes, under any template, whatever its verbs did to it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sros_tool.files import policies_dir
from sros_tool.keystore.template import template_names
from tests.support.harness import sros
from tests.support.long_form import drawn, some


def life(root: Path, template: str) -> Iterator[tuple[str, Path]]:
    """A keystore and what comes from it, after each verb."""
    home, robot, arm = root / "ks", root / "robot", root / "arm"
    sros("create_keystore", home, "--template", template).ok()
    yield "create_keystore", home
    policy = policies_dir() / "mobile_robot.xml"
    sros("generate_artifacts", "-k", home, "-p", policy, "-e", "/extra").ok()
    yield "generate_artifacts", home
    sros("renew", home, "/extra", "--new-key").ok()
    yield "renew", home
    sros("revoke", home, "/mobile_robot/camera").ok()
    yield "revoke", home
    sros("crl", home, "--refresh").ok()
    yield "crl", home
    sros("distribute_key", home, "/extra", "/mobile_robot/base", robot).ok()
    yield "distribute_key", robot
    sros("create_request", "/arm", arm).ok()
    yield "create_request", arm
    sros("sign_request", home, arm / "enclaves/arm/request.pem", "-o", root / "answer.tar.gz").ok()
    yield "sign_request", home
    sros("import", root / "answer.tar.gz", arm).ok()
    yield "import", arm
    for stage in ("distribute", "reissue", "retire"):
        sros("rotate_ca", home, "--to", stage).ok()
        yield f"rotate_ca {stage}", home
        sros("distribute_key", home, "/extra", root / f"robot_{stage}").ok()
        yield f"distribute_key after {stage}", root / f"robot_{stage}"


@pytest.mark.parametrize("template", some(template_names(), 1))
def test_nothing_is_found(template: str, tmp_path: Path) -> None:
    for step, path in life(tmp_path, template):
        if not drawn(step, 1 / 3):
            continue
        # By the other templates, /extra and /arm may do everything without a policy.
        left_out = () if template == "production" else ("--exclude", "keystore.allow-everything")
        ended = sros("check", path, *left_out)
        assert ended.status == 0, (step, ended)
        accepted = [line for line in ended.out.splitlines() if line.startswith("accepted by the ")]
        assert ended.out.splitlines() == accepted, step
        if template == "sros2" and not step.startswith("create_request"):
            assert "[keystore.one-authority]" in ended.out, step
        if template == "production":
            assert not accepted, step
        elif step not in ("create_keystore", "create_request"):  # there is no enclave yet
            assert sros("check", path, "--strict").status == 1, step
