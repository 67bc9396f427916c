"""`sros doctor --report`: what helps is in the file, and nothing secret; whose `ros2 security`."""

from __future__ import annotations

import json
import os
import pwd
import socket
import sys
from pathlib import Path

import pytest

from sros_tool.demo import doctor
from sros_tool.demo.doctor import Diagnosis, security_provider
from sros_tool.runtime.stacks import Stack
from tests.support.harness import sros

STACK = Stack("rclpy", "rmw", "Fast DDS", "2.14", "", True, False, "", "", "rmw_x")
SECRETS = {
    "passphrase": "plum-duff horse",
    "PIN": "80731",
    "token": "ghp_abcdefgh",
    "user": "zaphod",
    "host": "heartofgold",
    "folder": "secretproject",
    "label": "robot-ca-label",
    "key": "MIGHAgEAMBMGByqGSM49",
    "address": "192.0.2.77",
    "address of 6": "2001:db8::cafe:77",
}
PEM = f"-----BEGIN PRIVATE KEY-----\n{SECRETS['key']}\n-----END PRIVATE KEY-----"
TEXT = "; ".join(
    (
        f"cannot open /home/zaphod/{SECRETS['folder']}/key.pem on heartofgold.example.org",
        f"~zaphod ~/{SECRETS['folder']} file:///home/zaphod/{SECRETS['folder']}/a.xml",
        f"'/srv/{SECRETS['folder']}/x' /usr/../srv/{SECRETS['folder']} {PEM}",
        f"pkcs11:token={SECRETS['label']};pin-value=80731 PIN 80731 {SECRETS['passphrase']}",
        f"peer {SECRETS['address']}:7400 and [{SECRETS['address of 6']}] said {SECRETS['token']}",
        "/usr/lib/libfastrtps.so 2.14.5 has no security \x1b[2J\n## forged",
    )
)
ENVIRONMENT = {
    "HOME": "/home/zaphod",
    "USER": SECRETS["user"],
    "HOSTNAME": SECRETS["host"],
    "SROS_CA_PASSPHRASE": SECRETS["passphrase"],
    "SROS_PKCS11_PIN": SECRETS["PIN"],
    "GITHUB_TOKEN": SECRETS["token"],
    "ROS_SECURITY_KEYSTORE": f"/home/zaphod/{SECRETS['folder']}",
    "ROS_SECURITY_ENCLAVE_OVERRIDE": f"/{SECRETS['folder']}",
    "ROS_SECURITY_STRATEGY": "Enforce",
    "ROS_SECURITY_ENABLE": SECRETS["folder"],
    "ROS_DISTRO": SECRETS["label"],
    "RMW_IMPLEMENTATION": f"rmw_{SECRETS['folder']}",
    "CYCLONEDDS_URI": f"file:///home/zaphod/{SECRETS['folder']}",
}


def test_nothing_secret_is_in_the_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planted = STACK._replace(name=TEXT, version=TEXT, evidence=TEXT, where=TEXT)
    monkeypatch.setattr(doctor, "examine", lambda *_: Diagnosis((planted,)))
    monkeypatch.setattr(socket, "gethostname", lambda: "heartofgold.example.org")
    user = pwd.struct_passwd(("zaphod", "x", 1, 1, "", "/home/zaphod", ""))
    monkeypatch.setattr(pwd, "getpwuid", lambda _: user)
    file = tmp_path / "support.md"
    ended = sros("doctor", "--report", file, env=ENVIRONMENT)
    assert "read it before you attach it" in ended.err, ended
    text = file.read_text()
    assert {what: secret for what, secret in SECRETS.items() if secret in text} == {}
    assert "example.org" not in text and "\x1b" not in text and "\n## forged" not in text
    assert all(secret in TEXT for secret in SECRETS.values()), "each one was to be found"
    for helpful in (
        "- Python 3.",
        "- cryptography ",
        "- ROS_SECURITY_STRATEGY=Enforce",
        "- ROS_SECURITY_ENABLE has a value that sros does not know (not shown)",
        "- ROS_SECURITY_KEYSTORE is set",
        "does not enforce",
        "/usr/lib/libfastrtps.so 2.14.5 has no security",
        "× error: ",
    ):
        assert helpful in text, (helpful, text)


def test_a_report_replaces_no_file_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "examine", lambda *_: pytest.fail("asked for nothing"))
    file = tmp_path / "support.md"
    file.write_text("mine")
    assert sros("doctor", "--report", file).status == 2
    assert sros("doctor", "--report", tmp_path).status == 2
    assert sros("doctor", "--force").status == 2
    assert file.read_text() == "mine"
    monkeypatch.setattr(doctor, "examine", lambda *_: Diagnosis((STACK,)))
    sros("doctor", "--report", file, "--force")
    assert file.read_text().startswith("# sros support report\n")


@pytest.mark.parametrize(
    ("installed", "provider", "said"),
    [
        (("sros_tool",), "sros_tool", "comes from sros."),
        (("sros_tool", "sros2"), "sros2", "from sros2, not from sros"),
        (("sros2", "sros_tool"), "sros_tool", "comes from sros."),
        (("sros_tool", "sros2", "sros_ros2_security"), "sros_ros2_security", "comes from sros."),
        (("s\x1b[2J",), "s\x1b[2J", "not from sros"),
        ((), None, ""),
    ],
)
def test_whose_ros2_security(
    installed: tuple[str, ...],
    provider: str | None,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for number, name in enumerate(installed):
        folder = tmp_path / f"{number}/d{number}.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
        (folder / "entry_points.txt").write_text("[ros2cli.command]\nsecurity = m:C\n")
    (tmp_path / "json.py").write_text("raise SystemExit('of the working folder')")
    ros2 = tmp_path / "bin/ros2"
    ros2.parent.mkdir()
    ros2.write_text(f"#!{sys.executable} -S\n")
    ros2.chmod(0o755)
    path = os.pathsep.join(str(tmp_path / str(number)) for number in range(len(installed)))
    env = {"PATH": str(ros2.parent), "PYTHONPATH": path}
    monkeypatch.chdir(tmp_path)
    found = security_provider(env)
    assert (found and found.provider) == provider
    assert said in str(found or "")
    if provider == "sros2":
        monkeypatch.setattr(doctor, "examine", lambda *_: Diagnosis((STACK,)))
        shown = json.loads(sros("doctor", "--json", env=env).out)
        assert shown["ros2_security"] == {"provider": "sros2", "hidden": []}
        assert said in sros("doctor", env=env).out


def test_no_answer_is_none(tmp_path: Path) -> None:
    for number, first in enumerate(("", "#!/bin/sh python", "#!/none/python", "#!'python")):
        ros2 = tmp_path / f"{number}/ros2"
        ros2.parent.mkdir()
        ros2.write_text(f"{first}\necho no\n")
        ros2.chmod(0o755)
        assert security_provider({"PATH": str(ros2.parent)}) is None
    assert security_provider({"PATH": str(tmp_path)}) is None
