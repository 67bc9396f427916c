"""Logs of refusals become the rules that were missing; what a log does not tell is not guessed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sros_tool.errors import UsageError
from sros_tool.explain.denials import (
    Denial,
    MissingRights,
    as_learned,
    learned_from_logs,
    propose,
    read_denials,
)
from sros_tool.files import policies_dir
from sros_tool.graph.learn import NodeRight, common_parts, groups_of
from sros_tool.names import PARAMETER_SERVICES
from sros_tool.policy.model import ALLOW, Enclave, Group, Policy, Profile, Profiles
from sros_tool.runtime.vendor_log import plain_text
from tests.support.harness import sros

LOGS = Path(__file__).with_name("denial_logs")


def log(name: str) -> str:
    """A real log of a process that was refused, colors and all."""
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


@pytest.mark.parametrize(
    ("line", "denial"),
    [
        ("RCLError: Failed to create publisher: failed to create topic [rt/x] for unknown reasons",
         Denial("rt/x", "publish", by_rule=None)),
        ("  'failed to create topic [rt/x] for unknown reasons, at src/rmw_node.cpp:1941, at "
         "/project/src/rcl/subscription.c:112'", Denial("rt/x", "subscribe", by_rule=None)),
        ("Failed to create action client: failed to create topic [rq/x/_action/send_goalRequest] "
         "for unknown reasons, at src/rmw_node.cpp:1941, at /project/src/rcl/client.c:146",
         Denial("rq/x/_action/send_goalRequest", "publish", by_rule=None)),
        ("failed to create service: failed to create topic [rr/xReply] for unknown reasons",
         Denial("rr/xReply", "publish", by_rule=None)),
        ("failed to create topic [rt/x] for unknown reasons", Denial("rt/x", "", by_rule=None)),
    ],
)  # fmt: skip
def test_rmw_cyclonedds_names_the_topic_and_rcl_the_kind(line: str, denial: Denial) -> None:
    """As rclpy printed it with rmw_cyclonedds over Cyclone DDS 0.10.5, without a trace."""
    assert read_denials(line) == (denial,)
    other_reason = line.replace(
        "for unknown reasons", "because it's already in use in this context with another type"
    )
    assert not read_denials(other_reason)


def test_a_line_that_names_the_rule_is_of_the_same_denial_as_one_that_does_not() -> None:
    text = (
        "1.2 [0] python: Local topic permission denied: rt/x found in deny_rule\n"
        "cannot create topic rt/x. Not Allowed By Security\n"
    )
    assert read_denials(text) == (Denial("rt/x", "", by_rule=True),)


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
        "/robot/arm": {NodeRight("publish", "/x")},
        "/": {NodeRight("publish", "/y")},
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
        "/talker": {NodeRight("publish", "/x")},
        "/listener": {NodeRight("subscribe", "/x")},
    }
    learned = as_learned(proposal, "", None, None)
    assert [note.id for note in learned.notes] == ["log.several-enclaves", "log.node-assumed"]


@pytest.mark.parametrize(
    ("topic", "direction", "right"),
    [
        ("rt/x", "publish", NodeRight("publish", "/x")),
        ("rt/x", "subscribe", NodeRight("subscribe", "/x")),
        ("rq/addRequest", "publish", NodeRight("request", "/add")),
        ("rr/addReply", "subscribe", NodeRight("request", "/add")),
        ("rq/addRequest", "subscribe", NodeRight("reply", "/add")),
        ("rr/addReply", "publish", NodeRight("reply", "/add")),
        ("rq/f/_action/send_goalRequest", "publish", NodeRight("call", "/f")),
        ("rr/f/_action/get_resultReply", "publish", NodeRight("execute", "/f")),
        ("rt/f/_action/status", "subscribe", NodeRight("subscribe", "/f/_action/status")),
        ("rt/f/_action/status", "publish", NodeRight("execute", "/f")),
        ("rt/_action/status", "publish", NodeRight("publish", "/_action/status")),
        ("rr/_action/send_goalReply", "publish", NodeRight("reply", "/_action/send_goal")),
    ],
)
def test_one_half_asks_for_the_whole(topic: str, direction: str, right: NodeRight) -> None:
    assert propose([Denial(topic, direction)]).rights == {"": {right}}


def test_an_action_brings_its_topics_along() -> None:
    denials = [
        Denial("rr/f/_action/send_goalReply", "subscribe"),
        Denial("rt/f/_action/status", "subscribe"),
        Denial("rt/f/_action/status", "publish"),
    ]
    assert propose(denials).rights == {"": {NodeRight("call", "/f"), NodeRight("execute", "/f")}}


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
    assert (profile.enclave, profile.ns, profile.node) == ("/robot", "/", "robot")
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


# ── nodes and their common parts ───────────────────────────────────────────────────────────

COMMON = common_parts(policies_dir(), policies_dir())
BARE = Profile("/", "talker", (Group("topics", (("publish", ALLOW),), ("chatter",)),))
WHOLE = replace(
    BARE,
    groups=(
        *BARE.groups,
        Group("services", (("reply", ALLOW),), ("~/get_parameters", "~/describe_parameters")),
        Group("topics", (("publish", ALLOW),), ("/rosout",)),
    ),
)


DENIED = (
    "2026-11-21 06:00:00.1 [SECURITY Error] rt/x topic not found in allow rule.\n"
    "could not create publisher: denied"
)


def robot(*profiles: Profile) -> Policy:
    return Policy((Enclave("/robot", (Profiles(profiles),)),))


def of(topic: str, direction: str = "subscribe") -> MissingRights:
    return propose([Denial(topic, direction)])


@pytest.mark.parametrize(
    ("loggers", "ns"),
    [
        (["left.dock"], "/left"),
        (["left.dock", "rcl", "left.dock.tf", "left.station.dock2"], "/left"),
        ([], ""),
        (["dock"], ""),  # perhaps the logger of a library
        (["left.dock", "right.dock"], ""),
        (["left..dock"], ""),
        (["left.docks"], ""),
    ],
)
def test_the_namespace_of_a_new_node_is_that_of_its_logger(
    loggers: list[str], ns: str, tmp_path: Path
) -> None:
    lines = ["Found security directory: /ks/enclaves/left/dock", DENIED]
    lines += [f"[INFO] [1.2] [{logger}]: ready" for logger in loggers]
    text = "\n".join([*lines, "[other-1] [INFO] [1.2] [x.dock]: ready"])
    found, _, _ = learned_from_logs(
        {tmp_path / "log": text}, file=None, enclave="", node=None, present=None
    )
    (profile,) = found.profiles
    assert (profile.ns, profile.node) == (ns or "/", "dock")
    assert [note.id for note in found.notes] == ["log.node-assumed"] * (not ns)


def test_a_node_of_another_name_gets_nothing_and_is_told() -> None:
    proposal = propose(read_denials(secured_log("node_name_differs")))
    learned = as_learned(proposal, "", None, the_talker(WHOLE), COMMON)
    assert learned.profiles == ()
    (note,) = learned.notes
    assert note.id == "log.other-node"
    assert "/foo: enclave /talker_listener/talker has /talker" in note.text
    (profile,) = as_learned(proposal, "", ("/", "foo"), the_talker(WHOLE), COMMON).profiles
    assert profile.node == "foo" and profile.includes == ("common/node.xml",)


def test_topics_of_a_node_of_another_name_are_proposed() -> None:
    proposal = propose([Denial("rq/foo/get_parametersRequest", "subscribe"),
                        Denial("rt/x", "publish")])  # fmt: skip
    (profile,) = as_learned(proposal, "/robot", None, robot(WHOLE), COMMON).profiles
    assert (profile.node, profile.rights) == ("talker", frozenset([NodeRight("publish", "/x")]))


@pytest.mark.parametrize(
    ("topic", "direction", "includes"),
    [
        ("rt/rosout", "publish", ("common/node.xml",)),
        ("rq/talker/describe_parametersRequest", "subscribe", ("common/node.xml",)),
        ("rq/talker/get_type_descriptionRequest", "subscribe", ("common/node.xml",)),
        ("rt/chatter", "subscribe", ()),
        ("rq/other/describe_parametersRequest", "publish", ()),
    ],
)
def test_a_missing_common_part_is_one_include(
    topic: str, direction: str, includes: tuple[str, ...]
) -> None:
    learned = as_learned(of(topic, direction), "/robot", None, robot(BARE), COMMON)
    (profile,) = learned.profiles
    assert profile.includes == includes
    assert [note.id for note in learned.notes].count("log.common-part") == len(includes)
    assert len(profile.rights) == (11 if includes else 1)
    assert len(learned.flat().profiles[0].groups) > len(profile.groups) or not includes


def test_of_a_common_part_that_is_there_one_right_is_proposed() -> None:
    proposal = of("rq/talker/set_parametersRequest")
    (profile,) = as_learned(proposal, "/robot", None, robot(WHOLE), COMMON).profiles
    assert (profile.includes, len(profile.rights)) == ((), 1)


def test_a_lifecycle_node_gets_all_its_rights_at_once() -> None:
    """Twins: a service that other nodes may have; a profile with only some rights of every node."""
    ordinary = COMMON.included_rights(["common/node.xml"], "/", "talker")
    node = replace(BARE, groups=groups_of(ordinary, "/", "talker"))
    event, state = of("rt/talker/transition_event", "publish"), of("rq/talker/get_stateRequest")
    for denied, present, added in ((event, node, 6), (state, node, 1), (event, WHOLE, 1)):
        learned = as_learned(denied, "/robot", None, robot(present), COMMON)
        (profile,) = learned.profiles
        assert len(profile.rights - ordinary) == added
        assert profile.includes == ("common/lifecycle_node.xml",) * (added == 6)
        (told,) = [note.text for note in learned.notes] or [""]
        assert told.endswith(": /talker: common/lifecycle_node.xml") is (added == 6)


def test_a_parameter_client_is_told_which_services_it_also_needs() -> None:
    """Twin: all six were denied."""
    others = "describe_parameters, get_parameter_types, list_parameters, set_parameters and "
    for services, told in ((("get_parameters",), True), (PARAMETER_SERVICES, False)):
        denied = [Denial(f"rq/camera/{name}Request", "publish") for name in services]
        notes = {note.id: note.text for note in as_learned(propose(denied), "/a", None, None).notes}
        assert (others in notes.get("log.parameter-client", "")) is told


def test_without_a_policy_the_node_is_that_of_its_services() -> None:
    proposal = of("rq/hall/talker/describe_parametersRequest")
    (profile,) = as_learned(proposal, "/robot", None, None, COMMON).profiles
    assert (profile.ns, profile.node) == ("/hall", "talker")
    assert profile.includes == ("common/node.xml",)


def secured_log(name: str) -> str:
    """A log of rclpy over Fast DDS 2.14.5 with security."""
    logs = Path(__file__).parents[1] / "explain/logs"
    return plain_text((logs / f"fastdds_2.14.5.{name}.log").read_text())


def the_talker(profile: Profile) -> Policy:
    return Policy((Enclave("/talker_listener/talker", (Profiles((profile,)),)),))


def test_only_lines_that_ask_for_an_added_right_are_shown(tmp_path: Path) -> None:
    """A line of an older start may ask for what the policy allows now, and denies as well."""
    names = "<topic>/drive</topic>"
    (tmp_path / "robot.xml").write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/eye"><profiles>'
        f'<profile ns="/" node="eye"><topics publish="ALLOW">{names}</topics>'
        f'<topics publish="DENY">{names}</topics></profile>'
        "</profiles></enclave></enclaves></policy>"
    )
    (tmp_path / "eye.log").write_text(
        "[SECURITY Error] rt/drive topic not found in allow rule. -> check_create_datawriter\n"
        "[SECURITY Error] rr/homeReply topic not found in allow rule. -> check_create_datareader\n"
    )
    asked = ("robot.xml", "--from-log", "eye.log", "--enclave", "/eye", "--dry-run")
    out = sros("generate_policy", *asked, cwd=tmp_path).out
    assert "eye.log:2:" in out and "eye.log:1:" not in out
