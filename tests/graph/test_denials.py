"""Logs of refusals become the rules that were missing; what a log does not tell is not guessed."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.errors import UsageError
from sros_tool.graph.denials import Denial, propose, read_denials
from sros_tool.graph.fold import Right
from sros_tool.graph.proposal import as_learned
from sros_tool.policy import Enclave, Policy, Profile, Profiles
from sros_tool.runtime.security_log import plain_text

LOGS = Path(__file__).with_name("logs")


def log(name: str) -> str:
    """A real log of a process that was refused, colours and all."""
    return plain_text((LOGS / name).read_text())


def test_fast_dds() -> None:
    assert read_denials(log("fastdds_2.9.1.log")) == (
        Denial("rt/chatter", "subscribe"),
        Denial("rt/nope", "publish"),
        Denial("rr/fibonacci/_action/send_goalReply", "subscribe"),
        Denial("rq/addRequest", "publish"),
        Denial("rt/front_camera/image_raw", "subscribe", by_rule=True),
    )


def test_cyclone() -> None:
    assert read_denials(log("cyclone_0.10.2.log")) == (
        Denial("rt/chatter", "subscribe"),
        Denial("rt/camera/image", ""),
        Denial("rt/nope", "publish"),
        Denial("rt/front_camera/image_raw", "", by_rule=True),
    )


@pytest.mark.parametrize(
    ("lines", "direction"),
    [
        ("rt/x topic not found in allow rule.", ""),
        ("rt/x topic not found in allow rule.\nFailed to create publisher", "publish"),
        ("rt/x topic not found in allow rule.\nfailed to create subscription: denied", "subscribe"),
        ("Error checking creation of local writer 1.2|3 (rt/x topic not found in allow rule. "
         "(/tmp/Permissions.cpp:1111))", "publish"),
        ("rt/x topic not found in allow rule.\n\n\n\n\nFailed to create publisher", ""),
        ("rt/x topic not found in allow rule.\nrt/y topic not found in allow rule.\n"
         "Failed to create publisher", ""),
        ("what():  could not create publisher: create_publisher() could not create data writer\n"
         "rt/x topic not found in allow rule. -> Function check_create_datareader", "subscribe"),
    ],
)  # fmt: skip
def test_the_direction_is_that_of_the_lines_nearby(lines: str, direction: str) -> None:
    assert read_denials(lines)[0] == Denial("rt/x", direction)


@pytest.mark.parametrize(
    ("topic", "said", "direction"),
    [
        ("rq/addRequest", "failed to create client: failed to create topic", "publish"),
        ("rr/addReply", "failed to create client: failed to create topic", "subscribe"),
        ("rq/addRequest", "could not create service: failed to create topic", "subscribe"),
        ("rr/addReply", "could not create service: failed to create topic", "publish"),
        ("rt/x", "could not create publisher: failed to create topic", "publish"),
        ("rt/x", "could not create subscription: failed to create topic", "subscribe"),
        ("rt/x", "failed to create client: failed to create topic", ""),
    ],
)
def test_rcl_tells_what_cyclone_does_not(topic: str, said: str, direction: str) -> None:
    text = f"Local topic permission denied: {topic} denied by default rule(code: 145)\n{said}"
    assert read_denials(text) == (Denial(topic, direction),)


def test_a_denial_of_a_peer_is_no_reason_to_widen_ones_own() -> None:
    text = "rt/x topic not found in allow rule. -> Function check_remote_datawriter"
    (denial,) = read_denials(text)
    assert denial.remote
    assert propose([denial]).rights == {}
    assert propose([denial]).remote == (denial,)


def test_the_enclave_that_rcl_names() -> None:
    text = (
        "[INFO] [1.2] [rcl]: Found security directory: /home/r/ks/enclaves/robot/arm\n"
        "rt/x topic not found in allow rule. -> Function check_create_datawriter\n"
        "[INFO] [1.3] [rcl]: Found security directory: /home/r/ks/enclaves\n"
        "rt/y topic not found in allow rule. -> Function check_create_datawriter\n"
    )
    assert propose(read_denials(text)).rights == {
        "/robot/arm": {Right("publish", "/x")},
        "/": {Right("publish", "/y")},
    }


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("[talker-1] ", "[listener-2] "),
        ("Nov 21 06:00:00 robot talker[12]: ", "Nov 21 06:00:00 robot listener[13]: "),
        (
            "2026-11-21T06:00:00+0000 host robot talker[1]: ",
            "2026-11-21T06:00:00+0000 host robot l[2]: ",
        ),
        ("talker-1    | ", "listener-1  | "),
    ],
)
def test_processes_that_write_at_the_same_time(one: str, other: str) -> None:
    text = (
        f"{one}[INFO] [1.2] [rcl]: Found security directory: /ks/enclaves/talker\n"
        f"{other}[INFO] [1.2] [rcl]: Found security directory: /ks/enclaves/listener\n"
        f"{one}2026-11-21 06:00:00.1 [SECURITY Error] rt/x topic not found in allow rule.\n"
        f"{other}2026-11-21 06:00:00.1 [SECURITY Error] rt/x topic not found in allow rule.\n"
        f"{other}failed to create subscription: denied\n"
        f"{one}could not create publisher: denied\n"
    )
    proposal = propose(read_denials(text))
    assert proposal.rights == {
        "/talker": {Right("publish", "/x")},
        "/listener": {Right("subscribe", "/x")},
    }
    assert [note.id for note in as_learned(proposal, "", None, None).notes] == [
        "log.several-enclaves"
    ]


@pytest.mark.parametrize(
    ("topic", "direction", "right"),
    [
        ("rt/x", "publish", Right("publish", "/x")),
        ("rt/x", "subscribe", Right("subscribe", "/x")),
        ("rq/addRequest", "publish", Right("request", "/add")),
        ("rr/addReply", "subscribe", Right("request", "/add")),
        ("rq/addRequest", "subscribe", Right("reply", "/add")),
        ("rr/addReply", "publish", Right("reply", "/add")),
        ("rq/f/_action/send_goalRequest", "publish", Right("call", "/f")),
        ("rr/f/_action/get_resultReply", "publish", Right("execute", "/f")),
        ("rt/f/_action/status", "subscribe", Right("subscribe", "/f/_action/status")),
    ],
)
def test_one_half_asks_for_the_whole(topic: str, direction: str, right: Right) -> None:
    assert propose([Denial(topic, direction)]).rights == {"": {right}}


def test_an_action_brings_its_topics_along() -> None:
    denials = [
        Denial("rr/f/_action/send_goalReply", "subscribe"),
        Denial("rt/f/_action/status", "subscribe"),
        Denial("rt/f/_action/status", "publish"),
    ]
    assert propose(denials).rights == {
        "": {Right("call", "/f"), Right("publish", "/f/_action/status")}
    }


@pytest.mark.parametrize("topic", ["rt/*", "rt/a?", "Square", "rq/add", "rt/a//b"])
def test_no_wildcard_and_no_foreign_topic_is_proposed(topic: str) -> None:
    proposal = propose([Denial(topic, "publish")])
    assert proposal.rights == {}
    assert proposal.foreign


def test_what_is_not_clear_is_said_and_not_granted() -> None:
    learned = as_learned(propose(read_denials(log("cyclone_0.10.2.log"))), "/robot", None, None)
    (profile,) = learned.profiles
    assert {f"{each.right} {each.name}" for each in profile.rights} == {
        "subscribe /chatter",
        "publish /nope",
    }
    assert (profile.enclave, profile.ns, profile.node) == ("/robot", "/", "*")
    notes = {note.id: note.text for note in learned.notes}
    assert "rt/camera/image" in notes["log.unclear"]
    assert "rt/front_camera/image_raw" in notes["log.denied-by-rule"]


def test_the_profile_that_is_there_is_taken() -> None:
    present = Policy((Enclave("/robot", (Profiles((Profile("/hall", "arm", ()),)),)),))
    proposal = propose([Denial("rt/hall/x", "publish")])
    (profile,) = as_learned(proposal, "/robot", None, present).profiles
    assert (profile.ns, profile.node) == ("/hall", "arm")
    assert profile.groups[0].names == ("x",)
    (profile,) = as_learned(proposal, "/robot", ("/", "leg"), present).profiles
    assert profile.node == "leg"


def test_an_enclave_that_nobody_names_is_asked_for() -> None:
    with pytest.raises(UsageError, match="--enclave"):
        as_learned(propose([Denial("rt/x", "publish")]), "", None, None)
