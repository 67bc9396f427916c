"""Scenario files of users: what they say, and the line of what is not understood."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sros_tool.demo.result import PartyRecord, RowRecord, judge_row
from sros_tool.demo.scenarios import read_scenario
from sros_tool.demo.scenarios.model import OWN, UNSECURED, Identity, Relation, Role, RowStatus
from sros_tool.errors import DocumentError
from sros_tool.runtime.events import Event, EventKind, ProcessStage
from tests.support.harness import policy_text, publish, sros

GOOD = """title = "who sees the camera"
policy = "robot.xml"

[[party]]
name = "camera"
role = "talker"
enclave = "/arm/camera"
topic = "/image"

[[party]]
name = "viewer"
role = "listener"
enclave = "/arm/viewer"
topic = "/image"

[[party]]
name = "spy"
role = "listener"
topic = "/image"

[[row]]
name = "the viewer sees"
claim = { listener = "viewer", talker = "camera", expected = "heard" }

[[row]]
name = "a spy does not"
because = "it has no keys"

[[row.claim]]
listener = "spy"
talker = "camera"
expected = "not heard"

[[row.control]]
listener = "viewer"
talker = "camera"
expected = "heard"
"""
CLAIM = 'claim = { listener = "viewer", talker = "camera", expected = "heard" }'
CONTROL = """[[row.control]]
listener = "viewer"
talker = "camera"
expected = "heard"
"""
HEARS = '<topics subscribe="ALLOW"><topic>/image</topic></topics>'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    policy = policy_text({"/arm/camera": publish("/image"), "/arm/viewer": HEARS})
    (tmp_path / "robot.xml").write_text(policy)
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_a_good_file(folder: Path) -> None:
    scenario = read_scenario(write(folder, GOOD))
    assert (scenario.name, scenario.title) == ("mine", "who sees the camera")
    first, second = scenario.rows
    assert first.expected is RowStatus.HEARD
    assert [party.name for party in first.parties] == ["camera", "viewer"]
    assert second.expected is RowStatus.NOT_HEARD
    assert second.mechanism == "it has no keys"
    camera, _, spy = second.parties
    assert camera.identity == Identity(OWN, "/arm/camera")
    assert (camera.role, camera.topic) == (Role.TALKER, "/image")
    assert spy.identity == UNSECURED
    assert second.controls[0].relation is Relation.HEARS


@pytest.mark.parametrize(
    ("old", "new", "line", "told"),
    [
        ('role = "talker"', 'role = "singer"', 6, "'singer' is not a role"),
        ('role = "talker"', 'role = "router"', 6, "'router' is not a role; use one of talker, l"),
        ('"/arm/viewer"', '"/arm/vewer"', 13, "did you mean /arm/viewer?"),
        ('topic = "/image"', 'topic = "a b"', 8, "not a topic name"),
        ('name = "viewer"', 'name = "camera"', 11, "two parties"),
        (CLAIM, CLAIM.replace("camera", "camra"), 23, "no party 'camra'"),
        (CLAIM, CLAIM.replace("heard", "liked"), 23, "'liked' is not a status"),
        (CLAIM, CLAIM.replace('"heard"', '["heard"]'), 23, "is not a status"),
        (CLAIM, CLAIM.replace('"camera"', '["camera"]'), 23, "no party ['camera']"),
        (CLAIM, CLAIM.replace('expected = "heard"', "x = 1"), 23, "has no expected status; use"),
        (CLAIM, CLAIM.replace("viewer", "camera"), 23, "so it cannot be the listener of a claim"),
        (CLAIM, 'claim = { party = "spy", expected = "readable" }', 23, "spy has the role"),
        (CLAIM, CLAIM.replace("listener", "client"), 23, "needs listener, talker and expected,"),
        (CLAIM, CLAIM.replace('"heard"', '"started"'), 23, "needs party and expected, and no"),
        (CLAIM, 'claim = { client = "a", server = "b", expected = "not heard" }', 23,
         "it has client, server, expected. With these keys, write 'not answered'."),
        (CLAIM, "claim = 3", 23, "claim is not a table"),
        (CLAIM, 'claim = ["viewer hears camera"]', 23, '\'viewer hears camera\' is not a table'),
        (CLAIM, 'claims = ["viewer hears camera"]', 23, "write tables [[row.claim]]"),
        (CLAIM, 'claims = ["viewer hears camera"]', 23, 'listener = "spy", talker = "camera"'),
        (CONTROL, "", 29, "a crash would look the same"),
        ("because", "becuase", 27, "'becuase' is not a key"),
        ('role = "listener"\ntopic = "/image"\n\n[[row]]',
         'role = "listener"\nkeystore = "foreign"\n\n[[row]]', 19, "this party is unsecured"),
        ('enclave = "/arm/viewer"', 'enclave = "/arm/viewer"\nkeystore = "theirs"', 14,
         "'theirs' is not a keystore; use one of own, foreign"),
        ('policy = "robot.xml"', 'policy = "other.xml"', 2, "other.xml"),
        ('policy = "robot.xml"', f'policy = "{"x" * 300}"', 2, "does not exist"),
        ('policy = "robot.xml"\n', "", 1, "no policy"),
        (CLAIM, "", 22, "has no claim"),
        ('name = "the viewer sees"', "name = 3", 22, "3, not a string"),
        ('name = "the viewer sees"', 'name = ""', 22, "name is empty"),
        ('name = "viewer"', 'name = "../../viewer"', 11, "'../../viewer' cannot be the name"),
        ('name = "viewer"', 'name = "/var/log/viewer"', 11, "cannot be the name of a party"),
        ('name = "viewer"', 'name = ".."', 11, "cannot be the name of a party"),
        ('enclave = "/arm/viewer"',
         'enclave = "/arm/viewer"\nvariables = { LD_PRELOAD = "/tmp/x.so" }', 14,
         "a party cannot set 'LD_PRELOAD', only ROS_DOMAIN_ID, ROS_SECURITY_ENABLE,"),
        ('enclave = "/arm/viewer"', 'enclave = "/arm/viewer"\nvariables.PYTHONPATH = "."', 14,
         "cannot set 'PYTHONPATH'"),
        ('enclave = "/arm/viewer"', 'enclave = "/arm/viewer"\nvariables.CYCLONEDDS_URI = "x"', 14,
         "cannot set 'CYCLONEDDS_URI'"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_reported_with_its_line(
    folder: Path, old: str, new: str, line: int, told: str
) -> None:
    assert old in GOOD
    with pytest.raises(DocumentError) as caught:
        read_scenario(write(folder, GOOD.replace(old, new)))
    assert f"line {line}: " in str(caught.value)
    assert told in str(caught.value)


def test_what_to_write_for_a_party_that_its_own_enclave_refuses(folder: Path) -> None:
    alone = GOOD.replace(CONTROL, "")
    for enclave, remedy in (
        ('enclave = "/arm/viewer"\n', r'party = "camera", expected = "refused" }'),
        ("", "an unsecured listener that hears the same talker"),
    ):
        with pytest.raises(DocumentError) as caught:
            read_scenario(write(folder, alone.replace('enclave = "/arm/camera"\n', enclave)))
        assert remedy in str(caught.value)
    row = read_scenario(write(folder, GOOD)).rows[0]
    refused = PartyRecord(
        events=(Event(EventKind.REFUSED, 99, "not allowed", stage=ProcessStage.ENDPOINT),)
    )
    record = RowRecord(replace(row, claims=(replace(row.claims[0], holds=False),)), 100,
                       {"viewer": refused, "camera": refused}, None)  # fmt: skip
    assert 'write the claim { party = "viewer", expected = "refused" }' in judge_row(record).detail


def test_two_parties_whose_logs_would_be_one_file(folder: Path) -> None:
    text = GOOD.replace('"camera"', '"a b"').replace('"viewer"', '"a_b"')
    with pytest.raises(DocumentError, match="'a_b': 'a b' counts as the same name"):
        read_scenario(write(folder, text))


def test_the_variables_of_security_can_be_set(folder: Path) -> None:
    text = GOOD.replace(
        'enclave = "/arm/camera"',
        'enclave = "/arm/camera"\nvariables = { ROS_SECURITY_STRATEGY = "Permissive" }',
    )
    camera = read_scenario(write(folder, text)).rows[0].parties[0]
    assert camera.identity.variables == (("ROS_SECURITY_STRATEGY", "Permissive"),)


SERVICES = """policy = "robot.xml"
party = [
    { name = "adder", role = "server", topic = "/add" },
    { name = "asker", role = "client", topic = "/add" },
]

[[row]]
name = "answers in the open"
claim = [
    { party = "adder", expected = "readable" },
    { client = "asker", server = "adder", expected = "answered" },
]
"""


def test_claims_in_a_list(folder: Path) -> None:
    (row,) = read_scenario(write(folder, SERVICES)).rows
    assert [(claim.relation, claim.subject, claim.talker) for claim in row.claims] == [
        (Relation.READABLE, "adder", ""),
        (Relation.IS_ANSWERED, "asker", "adder"),
    ]
    assert row.wire
    assert row.expected is RowStatus.UNDISTURBED
    for kind in ("server", "client"):
        of_action = SERVICES.replace(f'role = "{kind}"', f'role = "action_{kind}"')
        with pytest.raises(DocumentError, match=r"line 9: .* the roles action_client"):
            read_scenario(write(folder, of_action))
    readable = '    { party = "adder", expected = "readable" },\n'
    silent = SERVICES.replace('"answered', '"not answered').replace(readable, "")
    with pytest.raises(
        DocumentError, match=r"adder answers a client .*unsecured client whom the same server"
    ):
        read_scenario(write(folder, silent))


def test_a_party_that_is_no_table(folder: Path) -> None:
    text = 'policy = "robot.xml"\nparty = [{ name = "a", role = "talker" }, 3]\n'
    with pytest.raises(DocumentError, match=r"line 2: the scenario needs party tables"):
        read_scenario(write(folder, text))


def test_broken_toml_and_missing_files(folder: Path) -> None:
    ended = sros("demo", "--scenario", write(folder, "a = = 1\n"))
    assert ended.status == 2
    assert "line" in ended.err
    ended = sros("demo", "--scenario", folder / "none.toml")
    assert ended.status == 2
    assert "none.toml" in ended.err
    assert "Traceback" not in ended.err
