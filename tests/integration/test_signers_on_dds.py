"""Who may sign and which CA files are taken: the vendors themselves, row by row."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.dds.decision_documents import allow, grant, permissions, publish, subscribe
from tests.dds.signer_rows import NOW, SIGNER, YES, Made, Row, authority, rows, write_enclave
from tests.integration.fastdds import fastdds_vendor
from tests.integration.vendor_oracle import (
    PEER,
    PEER_PERMISSIONS,
    Pair,
    Reply,
    ask_cyclone_folders,
    ask_fastdds_folders,
    cyclone_vendor,
    with_patience,
)
from tests.integration.vendor_rows import OPEN
from tests.support.openssl import takes_changes_for_lists

pytestmark = pytest.mark.dds

TOPIC = "rt/a"
GRANTED = permissions(
    grant(allow(publish("*"), subscribe("*"), domains="<id>0</id>"), subject="CN=/t")
)


@pytest.mark.parametrize(
    ("name", "expected"), [("permissions CA", YES), ("permissions CA 2", "unmatched")]
)
def test_the_next_permissions_ca_needs_the_name_of_the_old_one(
    name: str, expected: str, tmp_path: Path
) -> None:
    """Why a rotation gives both CAs one name: Fast DDS compares the names of permissions CAs.

    Each enclave trusts both CAs, its own first, as in the stage reissue.
    """
    old, new = SIGNER, authority(name)
    own, peer = tmp_path / "own", tmp_path / "peer"
    write_enclave(Row("", Made(permissions=(old, new)), "", "", ""), own, "CN=/t", OPEN, GRANTED)
    turned = Row("", Made(permissions=(new, old)), "", "", "")
    write_enclave(turned, peer, PEER, OPEN, PEER_PERMISSIONS)
    seconds = 8 if expected == YES else 2.5
    pair = own, peer, "UTC"
    (reply,) = ask_fastdds_folders([pair], TOPIC, tmp_path, seconds=seconds, made=NOW)
    assert reply.end == "joined" and reply.answers == (expected,), reply


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Row, Pair]]:
    """All rows, each with two enclaves that are made as it says."""
    folder = tmp_path_factory.mktemp("rows")
    taken = "a list that has only changes" if takes_changes_for_lists() else ""
    made: list[tuple[Row, Pair]] = []
    for number, row in enumerate(row for row in rows() if row.name != taken):
        own, peer = folder / f"{number} own", folder / f"{number} peer"
        write_enclave(row, own, "CN=/t", OPEN, GRANTED)
        write_enclave(row, peer, PEER, OPEN, PEER_PERMISSIONS)
        made.append((row, (own, peer, "UTC")))
    return made


@pytest.mark.parametrize("asked", ["Fast DDS", "Cyclone DDS"])
def test_every_row(asked: str, table: list[tuple[Row, Pair]], tmp_path: Path) -> None:
    vendor = cyclone_vendor() if asked == "Cyclone DDS" else fastdds_vendor()
    pairs = [pair for _, pair in table]

    def ask(some: Sequence[Pair], seconds: float) -> list[Reply]:
        if asked == "Cyclone DDS":
            return ask_cyclone_folders(some, TOPIC, pairs[0][0], seconds=seconds, made=NOW)
        return ask_fastdds_folders(some, TOPIC, tmp_path, seconds=seconds, made=NOW)

    expected = [row.answer(vendor) for row, _ in table]
    replies = with_patience(ask, pairs, lambda place, _: expected[place] == YES)
    wrong = [
        f"{row.name}: {vendor.title} answers {reply}, not {answer}"
        for (row, _), reply, answer in zip(table, replies, expected, strict=True)
        if (reply.answers[0] if reply.end == "joined" else reply.end) != answer
    ]
    assert not wrong, "\n".join(wrong)
