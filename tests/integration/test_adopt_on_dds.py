"""A keystore of ROS 2 Dashing, taken over, on a DDS that enforces it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.adopt import adopt_keystore
from tests.integration.converse import converse, listener, talker
from tests.integration.vendor_oracle import ask_fastdds_folders
from tests.support.made_by_eloquent import EVERYTHING, make_dashing

pytestmark = pytest.mark.dds

DOMAIN = 121


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dashing")
    nodes = {"/talker": EVERYTHING, "/listener": ("rt/chatter",), "/deaf": ("rt/other",)}
    make_dashing(folder / "old", nodes, domain=DOMAIN)
    adopt_keystore(folder / "new", folder / "old", now=datetime.now(UTC))
    return folder / "new"


def test_its_nodes_talk_on_cyclone_dds_by_their_rights(root: Path) -> None:
    said = converse(
        DOMAIN,
        talker(root, "/talker"),
        listener(root, "/listener"),
        listener(root, "/deaf", "deaf", hears=False),
    )
    assert said.heard(), said
    assert said.nodes["deaf"].kinds == ["refused"], said


def test_its_nodes_match_on_fast_dds_by_their_rights(root: Path, tmp_path: Path) -> None:
    own, peer, deaf = (enclave_path(root, name) for name in ("/talker", "/listener", "/deaf"))
    pairs = [(own, peer, "UTC"), (deaf, peer, "UTC")]
    both = ask_fastdds_folders(pairs, "rt/chatter", tmp_path, domain=DOMAIN, seconds=8)
    assert [(each.end, each.answers) for each in both] == [
        ("joined", ("matched",)),
        ("joined", ("denied",)),
    ], both
