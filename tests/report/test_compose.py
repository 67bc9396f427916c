"""Pictures of two sources, groups, and protection."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.names import PARAMETER_SERVICES
from sros_tool.policy.document import read_policy
from sros_tool.policy.minimize import minimize
from sros_tool.policy.model import DomainProtection, Level, NamedProtection, TopicProtection
from sros_tool.proof.sources import AT
from sros_tool.report.compose import compose, group_of, overlay, protection_of
from sros_tool.report.folding import Folding
from sros_tool.report.formats import render
from sros_tool.report.picture import Lack, OverlaySide, PicturedFinding
from sros_tool.report.picture import WireLevel as Shown
from sros_tool.translate import governance_for
from tests.report.pictures import edge, group, mobile_robot, source_of


def test_before_and_after_are_marked_and_listed(tmp_path: Path) -> None:
    before = source_of(tmp_path, {"/a": group("topics", "publish", "/x", "/gone")}, "old.xml")
    after = source_of(tmp_path, {"/a": group("topics", "publish", "/x", "/new")}, "new.xml")
    picture = overlay(before, after, "change")
    marks = {e.name: e.mark for e in picture.edges}
    assert marks == {"/x": OverlaySide.BOTH, "/gone": OverlaySide.FIRST, "/new": OverlaySide.SECOND}
    assert [(d.mark, d.text) for d in picture.differences] == [
        (OverlaySide.FIRST, "/a ALLOW publish topic /gone"),
        (OverlaySide.SECOND, "/a ALLOW publish topic /new"),
    ]
    assert picture.title == "old.xml and new.xml"


def test_a_wildcard_that_became_names_is_a_difference_though_nothing_moved(tmp_path: Path) -> None:
    before = source_of(tmp_path, {"/a": group("topics", "publish", "/*")}, "old.xml")
    after = source_of(tmp_path, {"/a": group("topics", "publish", "/x")}, "new.xml")
    picture = overlay(before, after, "change")
    assert edge(picture, "/a", "publish", "/x").mark is OverlaySide.BOTH
    assert edge(picture, "/a", "publish", "/*").mark is OverlaySide.FIRST
    assert {d.text: d.notes for d in picture.differences} == {
        "/a ALLOW publish topic /*": (),
        "/a ALLOW publish topic /x": ("the other side has it as part of publish topic /*",),
    }


def test_a_wildcard_is_seen_though_its_known_names_are_denied_or_stated(tmp_path: Path) -> None:
    """It is a name of its own then, of which nobody is said to lack what single names have."""
    denied = group("topics", "publish", "/arm/safe", qualifier="DENY")
    enclaves = {
        "/a": group("topics", "publish", "/arm/*", "/log*", "/log") + denied,
        "/b": group("topics", "subscribe", "/arm/safe") + group("actions", "call", "/go", "/g*"),
    }
    picture = compose(source := source_of(tmp_path, enclaves))
    wild = {name.name: name.lacks for name in picture.names if name.wildcard}
    assert wild == {"/arm/*": Lack.NOTHING, "/log*": Lack.RECEIVER, "/g*": Lack.RECEIVER}
    table = render(picture, Folding.of(picture), "markdown", AT)
    assert "| topic `/arm/*` | `/a` | other enclaves, for single names only |" in table
    used = source_of(tmp_path, {"/a": group("topics", "publish", "/log")}, "used.xml")
    unused = {difference.text for difference in overlay(source, used, "use").differences}
    assert "/a ALLOW publish topic /arm/*" in unused
    assert "/a ALLOW publish topic /log*" not in unused


def test_over_privilege_stands_out_and_agrees_with_minimize_policy(tmp_path: Path) -> None:
    allowed = {
        "/talker": group("topics", "publish", "/chatter", "/status", "/log*")
        + group("topics", "subscribe", "/secret", qualifier="DENY"),
        "/idle": group("topics", "publish", "/other"),
    }
    used = {"/talker": group("topics", "publish", "/chatter", "/cmd_vel", "/log1")}
    first, second = source_of(tmp_path, allowed), source_of(tmp_path, used, "seen.xml")
    picture = overlay(first, second, "use")
    marks = {(e.enclave, e.name): e.mark for e in picture.edges}
    assert marks == {
        ("/talker", "/chatter"): OverlaySide.BOTH,
        ("/talker", "/log1"): OverlaySide.BOTH,
        ("/talker", "/status"): OverlaySide.FIRST,
        ("/talker", "/cmd_vel"): OverlaySide.SECOND,
        ("/talker", "/secret"): OverlaySide.BOTH,  # a denial is never observed
        ("/idle", "/other"): OverlaySide.BOTH,  # nothing is known of it
    }
    assert {e.path: e.observed for e in picture.enclaves} == {"/talker": True, "/idle": False}
    lost = PicturedFinding("graph.unknown-enclave", "note", "nodes without a known enclave")
    unclear = overlay(first, replace(second, findings=(lost,)), "use")
    assert {e.path: (e.observed, e.note) for e in unclear.enclaves} == {
        "/talker": (True, ""),
        "/idle": (True, "perhaps observed"),
    }
    use = minimize(read_policy(tmp_path / "policy.xml"), second.rights).uses[0]
    talker = [e for e in picture.edges if e.enclave == "/talker" and e.name != "/secret"]
    assert use.allowed == sum(e.mark is not OverlaySide.SECOND for e in talker)
    assert use.observed == sum(e.mark is OverlaySide.BOTH for e in talker)


def test_what_a_wildcard_reaches_and_nobody_used_is_counted(tmp_path: Path) -> None:
    topics = [f"/t{n}" for n in range(6)]
    reading = group("topics", "subscribe", "/*") + group("topics", "subscribe", "/t0*")
    allowed = {"/w": group("topics", "publish", *topics), "/r": reading}
    used = {
        "/w": group("topics", "publish", *topics[1:]),
        "/r": group("topics", "subscribe", "/t1", "/t2"),
    }
    picture = overlay(source_of(tmp_path, allowed), source_of(tmp_path, used, "seen.xml"), "use")
    assert [(d.mark, d.text, d.notes) for d in picture.differences] == [
        (
            OverlaySide.FIRST,
            "/r ALLOW subscribe topic /*",
            ("4 of the 6 names that it matches were never observed",),
        ),
        (
            OverlaySide.FIRST,
            "/r ALLOW subscribe topic /t0*",
            ("the only name that it matches was never observed",),
        ),
        (OverlaySide.FIRST, "/w ALLOW publish topic /t0", ()),
    ]


def test_only_what_both_sides_can_speak_of_is_compared(tmp_path: Path) -> None:
    both = {"/a": group("topics", "publish", "/x"), "/b": group("topics", "publish", "/y")}
    policy = source_of(tmp_path, both)
    enclave = source_of(tmp_path, {"/a": group("topics", "publish", "/x")}, "a.xml")
    picture = overlay(policy, replace(enclave, scope=frozenset({"/a"})), "drift")
    assert {e.enclave for e in picture.edges} == {"/a"}
    assert not picture.differences


@pytest.mark.parametrize(
    ("enclave", "group"),
    [
        ("/robot/arm/camera", "wrist"),
        ("/robot/arm", "wrist"),
        ("/robot/base", "brain"),
        ("/other/lidar", "/other"),
        ("/alone", "/"),
    ],
)
def test_enclaves_are_grouped_by_host_or_else_by_namespace(enclave: str, group: str) -> None:
    assert group_of(enclave, {"/robot": "brain", "/robot/arm": "wrist"}) == group


def test_protection_is_the_weakest_of_the_topics_behind_a_name() -> None:
    open_topics = TopicProtection(data=Level.NONE, metadata=Level.NONE, read_access_control=False)
    signed = TopicProtection(data=Level.NONE, metadata=Level.SIGN)
    domain = DomainProtection(
        rtps=Level.NONE,
        named=(
            NamedProtection("topics", "/camera/*", open_topics),
            NamedProtection("topics", "/dock/_action/status", signed),
        ),
    )
    governance = governance_for(domain, DomainSet.of((0, 0)))
    shown = {
        name: protection_of(governance, kind, name)
        for kind, name in (
            ("topics", "/camera/image"),
            ("topics", "/scan"),
            ("topics", "/*"),
            ("actions", "/dock"),
            ("services", "/camera/set"),
        )
    }
    assert {name: protection.level for name, protection in shown.items()} == {
        "/camera/image": Shown.NONE,
        "/scan": Shown.ENCRYPT,
        "/*": Shown.NONE,  # some of it
        "/dock": Shown.SIGN,  # of its eight topics one
        "/camera/set": Shown.ENCRYPT,
    }
    assert not shown["/camera/image"].read_control
    assert shown["/camera/image"].write_control


def test_access_is_open_where_it_is_for_any_topic_behind_a_name() -> None:
    secret = TopicProtection(read_access_control=False)
    weaker = TopicProtection(data=Level.NONE, metadata=Level.NONE, write_access_control=False)
    domain = DomainProtection(
        named=(
            NamedProtection("topics", "/dock/_action/status", secret),
            NamedProtection("topics", "/dock/_action/feedback", weaker),
            NamedProtection("topics", "/open/*", weaker),
        ),
    )
    governance = governance_for(domain, DomainSet.of((0, 0)))
    dock = protection_of(governance, "actions", "/dock")
    assert not dock.read_control and not dock.write_control
    topic = protection_of(governance, "topics", "/open/x")
    assert topic.read_control and not topic.write_control
    other = protection_of(governance, "topics", "/other")
    assert other.read_control and other.write_control
    # A topic is open if it is in any domain, as an enclave may join there.
    closed = governance_for(DomainProtection(), DomainSet.of((1, 1)))
    both = governance._replace(
        domain_access_rules=(*closed.domain_access_rules, *governance.domain_access_rules),
    )
    assert not protection_of(both, "topics", "/open/x").write_control


def test_names_without_protection_are_open_to_strangers_where_a_domain_admits_them() -> None:
    bare = TopicProtection(data=Level.NONE, metadata=Level.NONE, discovery=False)
    domain = DomainProtection(
        allow_unauthenticated_participants=True,
        rtps=Level.NONE,
        named=(NamedProtection("topics", "/bare", bare),),
    )
    governance = governance_for(domain, DomainSet.of((0, 0)))
    for name, open_text in (
        ("/bare", "everybody may publish and subscribe, even without an identity"),
        ("/*", "everybody may publish and subscribe, even without an identity"),
        ("/other", ""),
    ):
        assert protection_of(governance, "topics", name).open_access_text("topics") == open_text
    admits_nobody = replace(domain, allow_unauthenticated_participants=False)
    closed = governance_for(admits_nobody, DomainSet.of((0, 0)))
    assert not protection_of(closed, "topics", "/bare").open_access_text("topics")


def test_what_protects_whole_messages_protects_every_topic() -> None:
    domain = DomainProtection(
        rtps=Level.ENCRYPT_WITH_ORIGIN_AUTHENTICATION,
        default=TopicProtection(data=Level.NONE, metadata=Level.NONE),
    )
    governance = governance_for(domain, DomainSet.of((0, 0)))
    assert protection_of(governance, "topics", "/x").level is Shown.ENCRYPT
    assert protection_of(None, "topics", "/x").level is Shown.UNKNOWN


def test_hosts_reach_the_picture(tmp_path: Path) -> None:
    source = source_of(tmp_path, {"/robot/arm": group("topics", "publish", "/x")})
    picture = compose(source, {"/robot/arm": "wrist"})
    assert picture.enclaves[0].group == "wrist"


def test_everything_is_sorted() -> None:
    picture = mobile_robot()
    assert list(picture.names) == sorted(picture.names, key=lambda n: (n.kind, n.name))
    assert [e.path for e in picture.enclaves] == sorted(e.path for e in picture.enclaves)


def test_parameter_services_of_other_nodes_are_no_rights_that_every_node_needs(
    tmp_path: Path,
) -> None:
    own = tuple(f"/camera/{name}" for name in PARAMETER_SERVICES)
    source = source_of(
        tmp_path,
        {
            "/camera": group("services", "reply", *own),
            "/gripper": group("services", "reply", "/camera/set_parameters"),
        },
    )
    every = {(enclave, name) for enclave in ("/camera",) for name in own}
    beyond = {(edge.enclave, edge.name) for edge in compose(source).edges if not edge.common}
    assert beyond == every | {("/gripper", "/camera/set_parameters")}
    posing = {
        "/camera": group("services", "reply", *own),
        "/bad": group("services", "reply", "/cam*"),
    }
    edges_of = compose(source_of(tmp_path, posing)).edges
    assert not any(edge.common for edge in edges_of)
    alone = compose(source_of(tmp_path, {"/camera": group("services", "reply", *own)})).edges
    assert all(edge.common for edge in alone)
