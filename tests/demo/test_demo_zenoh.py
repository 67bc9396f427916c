"""The demo on Zenoh: its rows, the judgement of what only Zenoh does, and what it needs."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from importlib import metadata
from multiprocessing import shared_memory as shared_memory_of_python
from pathlib import Path

import pytest

from sros_tool.demo import backend, program
from sros_tool.demo.result import PartyRecord, RowRecord, RowResult, judge_row
from sros_tool.demo.scenarios import choose_scenarios
from sros_tool.demo.scenarios.model import (
    Relation,
    Role,
    Row,
    RowStatus,
    merged_row,
    merged_scenario,
)
from sros_tool.demo.scenarios.on_zenoh import ATTACKS, ZENOH_SCENARIOS
from sros_tool.demo.wire import PacketCounter, mapped_segments, segments_with_text
from sros_tool.errors import UnavailableError, UsageError
from sros_tool.runtime.events import Event, EventKind, ProcessStage
from tests.support.harness import sros

ROWS = {row.name: row for scenario in ZENOH_SCENARIOS for row in scenario.rows}
WINDOW = (100.0, 105.0)
READY = Event(EventKind.READY, 99.0)


def sent(text: str, *times: float) -> PartyRecord:
    events = [Event(EventKind.SENT, at, f"{text}: {at}") for at in times]
    return PartyRecord(text=text, topic="/chatter", events=(READY, *events))


def heard(*events: tuple[str, float]) -> PartyRecord:
    found = [Event(EventKind.HEARD, at, f"{text}: {at}") for text, at in events]
    return PartyRecord(events=(READY, *found))


def judged(name: str, parties: Mapping[str, PartyRecord], expiry: float | None = None) -> RowResult:
    row = ROWS[name]
    idle = PartyRecord(events=(READY,))
    records = {party.name: parties.get(party.name, idle) for party in row.parties}
    return judge_row(RowRecord(row, 80, records, WINDOW, expiry=expiry))


# ── the rows ───────────────────────────────────────────────────────────────────────────────


def test_every_attack_is_also_tried_without_its_defense_or_told_as_open() -> None:
    rows = defaultdict[str, list[Row]](list)
    for row in ATTACKS.rows:
        rows[row.attack].append(row)
    for attack, of in rows.items():
        tried = [each for each in of if not each.defence_removed]
        assert tried, attack
        for each in tried:
            if each.open_because:
                assert each.remedy
            else:
                assert any(other.defence_removed for other in of), attack


def test_every_row_has_a_router_for_each_host_and_one_starts_before_all_others() -> None:
    for row in ROWS.values():
        first = [party for party in row.parties if not party.turn]
        assert len(first) == 1, row.name
        assert first[0].role in (Role.ROUTER, Role.RELAY)
        if "far router" in first[0].name:
            second = [party for party in row.parties if party.turn == 1]
            assert [party.role for party in second] == [Role.ROUTER]


def test_an_attacker_in_another_enclave_obeys_no_rules_of_its_own() -> None:
    attackers = [
        party
        for row in ATTACKS.rows
        for party in row.parties
        if party.identity.enclave == "guest" and party.role not in (Role.RELAY, Role.FLOODER)
    ]
    assert {party.name for party in attackers if not party.identity.ignores_rules} == {
        "guest with an earlier file"
    }


def test_rows_of_one_world_share_their_processes() -> None:
    rows = merged_scenario(ZENOH_SCENARIOS).rows
    groups = [[rows[index] for index in group] for group in program.groups_of_rows(rows)]
    assert sorted(row.name for group in groups for row in group) == sorted(ROWS)
    for group in groups:
        world = merged_row(group)
        assert len({party.name for party in world.parties}) == len(world.parties)
    processes = sum(len(merged_row(group).parties) for group in groups)
    assert processes < 0.6 * sum(len(row.parties) for row in rows)


def test_a_world_cannot_have_two_parties_of_one_name() -> None:
    row = ROWS["talker to listener, directly"]
    other = replace(row.party("talker"), topic="/other")
    with pytest.raises(ValueError, match="two parties 'talker'"):
        merged_row([row, replace(row, parties=(other,))])


def test_scenarios_are_chosen_by_name() -> None:
    assert choose_scenarios((), on_zenoh=True) == ZENOH_SCENARIOS
    assert choose_scenarios(("all",), on_zenoh=True) == ZENOH_SCENARIOS
    assert choose_scenarios(("attacks",), on_zenoh=True) == (ATTACKS,)
    with pytest.raises(UsageError, match="sros has isolation, services, routers, attacks on Zenoh"):
        choose_scenarios(("governance",), on_zenoh=True)
    for names in (("own.toml",), ("all", "own.toml")):
        with pytest.raises(UsageError, match=r"own\.toml cannot run on Zenoh.*explain KEYSTORE"):
            choose_scenarios(names, on_zenoh=True)


# ── the verdict ────────────────────────────────────────────────────────────────────────────

CALL = "another enclave calls a service past the router"


def test_a_call_counts_by_the_server_and_not_by_the_reply() -> None:
    answer = Event(EventKind.HEARD, 102, "S: 1")
    client = sent("C", 101)
    parties = {
        "guest that calls": sent("G", 101),
        "client": replace(client, events=(*client.events, answer)),
        "server": replace(heard(("C", 101)), text="S"),
    }
    good = judged(CALL, parties)
    assert (good.observed, good.as_expected) == (RowStatus.NOT_EXECUTED, True)
    reached = replace(heard(("C", 101), ("G", 101)), text="S")
    bad = judged(CALL, {**parties, "server": reached})
    assert (bad.observed, bad.as_expected) == (RowStatus.EXECUTED, False)
    idle = judged(CALL, {**parties, "guest that calls": sent("G")})
    assert idle.observed is RowStatus.UNDECIDED


EXPIRY = "certificate that expires during a link"


@pytest.mark.parametrize(
    ("times", "of_talker", "observed"),
    [
        ((100.5, 101.0), (100.5, 104.0), RowStatus.CUT_OFF),
        ((100.5, 104.0), (100.5, 104.0), RowStatus.STILL_HEARD),
        ((), (100.5, 104.0), RowStatus.UNDECIDED),
        ((104.0,), (104.0,), RowStatus.UNDECIDED),
        ((100.5,), (100.5,), RowStatus.UNDECIDED),
    ],
)
def test_cut_off_counts_only_after_it_was_heard(
    times: tuple[float, ...], of_talker: tuple[float, ...], observed: RowStatus
) -> None:
    listener = heard(*(("T", at) for at in times), ("S", 104.0))
    parties = {
        "listener": listener,
        "talker": sent("T", *of_talker),
        "steady talker": sent("S", 104.0),
    }
    assert judged(EXPIRY, parties, 102.0).observed is observed


def test_a_process_without_a_connection_is_refused_only_if_the_router_says_so() -> None:
    name = "a certificate of another CA"
    (attacker,) = [party.name for party in ROWS[name].parties if party.intruder]
    refused = Event(EventKind.REFUSED, 101, "no connection", stage=ProcessStage.PARTICIPANT)
    parties = {
        "talker": sent("T", 101),
        "listener": heard(("T", 101)),
        attacker: PartyRecord(events=(refused,)),
    }
    line = "2026 WARN acc-0 zenoh_link_tls: invalid peer certificate: UnknownIssuer. Hint: x"
    for output, observed in ((line, RowStatus.NOT_LET_IN), ("", RowStatus.UNDECIDED)):
        router = PartyRecord(events=(READY,), output=output)
        found = judged(name, {**parties, "router": router})
        assert found.observed is observed
    assert "router: invalid peer certificate: UnknownIssuer; control" in (
        judged(name, {**parties, "router": PartyRecord(events=(READY,), output=line)}).detail
    )


def test_what_was_heard_before_the_rights_were_taken_away_does_not_count() -> None:
    name = "rights taken away from running nodes"
    talker = sent("T", 99.5, 101)
    for at, observed in ((99.5, RowStatus.NOT_HEARD), (101, RowStatus.HEARD)):
        parties = {"talker": talker, "listener": heard(("T", at))}
        assert judged(name, parties).observed is observed


# ── packets and shared memory ──────────────────────────────────────────────────────────────


def ipv4(payload: bytes, source: int = 7447, target: int = 50000) -> bytes:
    header = bytearray(20)
    header[0], header[9] = 0x45, 6
    return bytes(header) + tcp(payload, source, target)


def tcp(payload: bytes, source: int = 7447, target: int = 50000) -> bytes:
    header = bytearray(20)
    header[0:4] = source.to_bytes(2, "big") + target.to_bytes(2, "big")
    header[12] = 5 << 4
    return bytes(header) + payload


def ipv6(payload: bytes) -> bytes:
    header = bytearray(40)
    header[0], header[6] = 0x60, 6
    return bytes(header) + tcp(payload)


@pytest.mark.parametrize("packet", [ipv4, ipv6])
def test_tcp_and_tls_are_counted(packet: type) -> None:
    counter = PacketCounter(["Hello"])
    counter.count(packet(b"..Hello.."))
    counter.count(packet(b"\x17\x03\x03\x00\x10" + b"x" * 16))
    counter.count(packet(b""))
    assert counter.plain == {"Hello": 1}
    assert counter.protected == {7447: 1, 50000: 1}


@pytest.mark.parametrize("length", range(0, 61, 4))
def test_short_packets_are_ignored(length: int) -> None:
    counter = PacketCounter(["x"])
    for packet in (ipv4(b""), ipv6(b"")):
        counter.count(packet[:length])
    assert not counter.protected


def test_text_in_shared_memory_is_found(tmp_path: Path) -> None:
    (tmp_path / "one").write_bytes(b"\0" * 5000 + b"the talker: 1")
    (tmp_path / "empty").touch()
    (tmp_path / "other").write_bytes(b"somebody's")
    segments = [*tmp_path.iterdir(), tmp_path / "gone"]
    texts = {"talker": "the talker", "listener": ""}
    assert segments_with_text(texts, segments) == {"talker": 1, "listener": 0}


def test_the_segments_of_a_process_are_those_that_it_maps() -> None:
    segment = shared_memory_of_python.SharedMemory(create=True, size=5000)
    path = Path("/dev/shm") / segment.name.lstrip("/")
    try:
        assert path in mapped_segments(os.getpid())
    finally:
        segment.close()
        segment.unlink()
    assert path not in mapped_segments(os.getpid())
    assert mapped_segments(2**22) == frozenset()


# ── what it needs ──────────────────────────────────────────────────────────────────────────


def test_without_the_package_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def missing(_name: str) -> str:
        raise metadata.PackageNotFoundError

    monkeypatch.setattr(metadata, "version", missing)
    with pytest.raises(UnavailableError, match=r"pip install 'eclipse-zenoh>="):
        backend.zenoh_backend()
    ended = sros("demo", "--backend", "zenoh", cwd=tmp_path)
    assert ended.status == 2
    assert "eclipse-zenoh" in ended.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("version", "fits"), [("1.9.0", False), ("1.10.0", True), ("2.0", True)])
def test_an_old_package_is_refused(
    version: str, fits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "version", lambda _name: version)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: object())
    if fits:
        assert backend.zenoh_backend().dds == f"Zenoh {version}"
    else:
        with pytest.raises(UnavailableError, match=r"needs eclipse-zenoh 1\.10 or newer.*1\.9\.0"):
            backend.zenoh_backend()


def test_a_keystore_of_the_user_is_refused(tmp_path: Path) -> None:
    ended = sros("demo", "--backend", "zenoh", "--keystore", tmp_path, cwd=tmp_path)
    assert ended.status == 2
    assert "attacks keystores of its own" in ended.err


def test_the_list_names_the_scenarios_of_both(tmp_path: Path) -> None:
    both = sros("demo", "--list", cwd=tmp_path).ok()
    assert "with --backend zenoh:" in both.out
    assert f"{len(ATTACKS.rows)} rows  {ATTACKS.title}" in both.out
    only = sros("demo", "--list", "--backend", "zenoh", cwd=tmp_path).ok()
    assert "DDS" not in only.out
    assert ATTACKS.title in only.out


def test_relations_of_zenoh_are_used() -> None:
    used = {claim.relation for row in ROWS.values() for claim in row.claims}
    here = {Relation.EXECUTES, Relation.HEARS_EXPIRED, Relation.SEES, Relation.LOSES}
    assert used >= {*here, Relation.READABLE}
