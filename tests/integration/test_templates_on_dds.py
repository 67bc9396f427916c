"""What the templates promise, asked of a DDS that enforces it."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.files import policies_dir, templates_dir
from sros_tool.keystore.delivery.export import distribute
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import Template, load_template
from sros_tool.policy.document import read_policy
from tests.integration.converse import ENOUGH, converse, listener, talker
from tests.support.children import run

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
    root = tmp_path / "ks"
    said = converse(DOMAIN, talker(root, TALKER), listener(root, LISTENER))
    assert said.heard(), said


def test_production_without_a_policy_denies_the_topic_but_not_the_participant(
    tmp_path: Path,
) -> None:
    make(tmp_path / "ks", load_template("production"), policy=False)
    root = tmp_path / "ks"
    said = converse(
        DOMAIN,
        talker(root, TALKER),
        talker(root, TALKER, "log", topic="/rosout", text="log"),
        listener(root, LISTENER),
    )
    assert said.nodes["talker"].kinds == ["refused"], said
    assert said.nodes["listener"].kinds == ["refused"], said
    assert said.nodes["log"].sent >= ENOUGH, said  # what every node needs is allowed


def test_an_exported_pair_talks_when_the_original_is_gone(tmp_path: Path) -> None:
    make(tmp_path / "ks", load_template("production"))
    now = datetime.now(UTC)
    distribute(OpenedKeystore(tmp_path / "ks"), [TALKER], tmp_path / "folder", now=now)
    distribute(OpenedKeystore(tmp_path / "ks"), [LISTENER], tmp_path / "robot.tar.gz", now=now)
    shutil.rmtree(tmp_path / "ks")
    (tmp_path / "unpacked").mkdir()
    run(["tar", "-xzf", tmp_path / "robot.tar.gz", "-C", tmp_path / "unpacked"])
    said = converse(
        DOMAIN, talker(tmp_path / "folder", TALKER), listener(tmp_path / "unpacked", LISTENER)
    )
    assert said.heard(), said


def test_protection_by_name_is_what_is_on_the_wire(tmp_path: Path) -> None:
    """A stream that is signed only can be read, and commands beside it can not."""
    text = (
        (templates_dir() / "development.toml").read_text()
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
        parties.append(talker(root, TALKER, name, topic=topic, text=f"say-{name}"))
        parties.append(listener(root, LISTENER, f"{name} heard", topic=topic))
    said = converse(DOMAIN, *parties)
    for name in topics:
        assert said.heard(f"{name} heard"), said
    if said.readable is None:
        pytest.skip("packets may not be captured here")
    assert said.readable.get("say-stream", 0) > 0, said
    assert said.readable.get("say-secret", 0) == 0, said
    assert said.readable.get("say-command", 0) == 0, said
