"""What the templates promise, asked of a DDS that enforces it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.keystore import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.export import distribute
from sros_tool.keystore.template import Template, load_template
from sros_tool.policy import read_policy
from sros_tool.resources import policies_dir

pytestmark = pytest.mark.dds

DOMAIN = 120
TALKER, LISTENER = "/talker_listener/talker", "/talker_listener/listener"


def make(root: Path, template: Template, *, policy: bool = True) -> None:
    now = datetime.now(UTC)
    create_keystore(root, template=template, domains=DomainSet.of((DOMAIN, DOMAIN)), now=now)
    if policy:
        read = read_policy(policies_dir() / "talker_listener.xml")
        generate_artifacts(root, policies=[read], now=now)
    else:
        create_enclaves(root, [TALKER, LISTENER], now=now)


def party(role: str, root: Path | None, enclave: str = "", **more: str) -> dict[str, str]:
    return {
        "role": role,
        "name": more.get("name", role),
        "keystore": str(root or ""),
        "enclave": enclave,
        "topic": more.get("topic", "/chatter"),
        "text": more.get("text", "Hello"),
    }


def converse(*parties: dict[str, str]) -> dict[str, Any]:
    script = Path(__file__).with_name("converse.py")
    done = subprocess.run(
        [sys.executable, str(script), str(DOMAIN)],
        input=json.dumps(parties),
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    answer["nodes"] = {node["name"]: node for node in answer["nodes"]}
    return dict(answer)


def assert_heard(answer: dict[str, Any]) -> None:
    assert answer["nodes"]["talker"]["sent"] > 10, answer
    assert len(answer["nodes"]["listener"]["heard"]) > 10, answer


@pytest.mark.parametrize(
    ("name", "policy"),
    [
        ("development", False),
        ("development", True),
        ("production", True),
        ("sros2", False),
    ],
)
def test_a_pair_talks(name: str, policy: bool, tmp_path: Path) -> None:
    make(tmp_path / "ks", load_template(name), policy=policy)
    assert_heard(
        converse(
            party("talker", tmp_path / "ks", TALKER), party("listener", tmp_path / "ks", LISTENER)
        )
    )


def test_production_without_a_policy_denies_the_topic_but_not_the_participant(
    tmp_path: Path,
) -> None:
    make(tmp_path / "ks", load_template("production"), policy=False)
    root = tmp_path / "ks"
    answer = converse(
        party("talker", root, TALKER),
        party("talker", root, TALKER, name="log", topic="/rosout", text="log"),
        party("listener", root, LISTENER),
    )
    assert answer["nodes"]["talker"]["kinds"] == ["refused"], answer
    assert answer["nodes"]["listener"]["kinds"] == ["refused"], answer
    assert answer["nodes"]["log"]["sent"] > 10, answer  # what every node needs is allowed


def test_an_exported_pair_talks_when_the_original_is_gone(tmp_path: Path) -> None:
    make(tmp_path / "ks", load_template("production"))
    now = datetime.now(UTC)
    distribute(tmp_path / "ks", [TALKER], tmp_path / "folder", now=now)
    distribute(tmp_path / "ks", [LISTENER], tmp_path / "robot.tar.gz", now=now)
    shutil.rmtree(tmp_path / "ks")
    (tmp_path / "unpacked").mkdir()
    subprocess.run(
        ["tar", "-xzf", str(tmp_path / "robot.tar.gz"), "-C", str(tmp_path / "unpacked")],
        check=True,
    )
    assert_heard(
        converse(
            party("talker", tmp_path / "folder", TALKER),
            party("listener", tmp_path / "unpacked", LISTENER),
        )
    )


def test_protection_by_name_is_what_is_on_the_wire(tmp_path: Path) -> None:
    """A stream that is signed only can be read, and commands beside it can not."""
    text = (
        (policies_dir().parent / "keystore_templates/development.toml").read_text()
        + '\n[[protection.topic]]\nnames = ["/camera/*"]\ndata = "SIGN"\nmetadata = "SIGN"\n'
        + '\n[[protection.topic]]\nnames = ["/camera/secret"]\ndata = "ENCRYPT"\n'
        + 'metadata = "ENCRYPT"\n'
    )
    (tmp_path / "camera.toml").write_text(text)
    root = tmp_path / "ks"
    make(root, load_template(str(tmp_path / "camera.toml")), policy=False)
    topics = {"stream": "/camera/image", "secret": "/camera/secret", "command": "/cmd_vel"}
    parties = []
    for name, topic in topics.items():
        parties.append(party("talker", root, TALKER, name=name, topic=topic, text=f"say-{name}"))
        parties.append(party("listener", root, LISTENER, name=f"{name} heard", topic=topic))
    answer = converse(*parties)
    for name in topics:
        assert len(answer["nodes"][f"{name} heard"]["heard"]) > 10, answer
    if answer["readable"] is None:
        pytest.skip("packets may not be captured here")
    assert answer["readable"].get("say-stream", 0) > 10, answer
    assert answer["readable"].get("say-secret", 0) == 0, answer
    assert answer["readable"].get("say-command", 0) == 0, answer
