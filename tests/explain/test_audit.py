"""What a policy or keystore would deny to an observed graph, and what to add."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from shutil import copytree

import pytest

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.explain.audit import (
    Audit,
    AuditedEnclaves,
    audit,
    keystore_enclaves,
    policy_enclaves,
)
from sros_tool.graph.learn import render
from sros_tool.graph.observation import Endpoint, Observation, ObservedNode, make_observation
from sros_tool.keystore.layout import enclave_names
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.participant import JoinContext
from sros_tool.keystore.rights import load_rights
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from sros_tool.policy.merge import merge_into
from sros_tool.translate import governance_for
from tests.graph.graphs import graph, node
from tests.support.harness import sros

NOW = datetime(2026, 11, 22, tzinfo=UTC)
ONE_DOMAIN = DomainSet.of((0, 0))
TEMPLATE = load_template("production")
Enclaves = dict[str, dict[str, list[str]]]
"""The rights of each node of each enclave, each said as "publish chatter"."""


def written(folder: Path, enclaves: Enclaves) -> Path:
    """A policy of these enclaves; a right may end with DENY."""
    text = ""
    for path, profiles in enclaves.items():
        text += f'<enclave path="{path}"><profiles>'
        for fqn, rights in profiles.items():
            ns, _, name = fqn.rpartition("/")
            text += (
                f'<profile ns="{ns or "/"}" node="{name}">{"".join(map(group, rights))}</profile>'
            )
        text += "</profiles></enclave>"
    file = folder / "policy.xml"
    file.write_text(f'<policy version="0.2.0"><enclaves>{text}</enclaves></policy>')
    return file


def group(right: str) -> str:
    word, name, *denied = right.split()
    kind = {"p": "topic", "s": "topic", "c": "action", "e": "action"}.get(word[0], "service")
    return f'<{kind}s {word}="{"DENY" if denied else "ALLOW"}"><{kind}>{name}</{kind}></{kind}s>'


def audited(
    folder: Path,
    enclaves: Enclaves,
    seen: Observation,
    vendor: Vendor = Vendor.FAST,
) -> Audit:
    return audit(seen, of_policy(written(folder, enclaves), vendor))


def of_policy(file: Path, vendor: Vendor = Vendor.FAST) -> AuditedEnclaves:
    governance = governance_for(TEMPLATE.protection, ONE_DOMAIN)
    return policy_enclaves(read_policy(file), governance, vendor, JoinContext(0, NOW))


def said(found: Audit) -> list[str]:
    return [str(each) for each in found.denied]


def ids(found: Audit) -> list[str]:
    return [each.id for each in found.notes]


def lacks(used: str, allowed: str) -> str:
    """The hint at a remapping from the name that is used to one like it that is allowed."""
    node = f"the node may lack the remapping -r {used}:={allowed}"
    return (
        f"; perhaps the policy means {allowed} ({node}, or the policy may lack "
        f"--remap {allowed}:={used}, or a remapping or parameter makes the node use the wrong "
        f"{used})"
    )


TALKER = {"/t": {"/talker": ["publish chatter"]}}
UNUSED = (
    "; the enclave may {}, which the process does not use: perhaps a remapping or a parameter is "
    "missing or wrong"
)
UNNAMED = "the policy has no enclave for this node"


def talks(*more: str, enclave: str = "/", fqn: str = "/talker", pid: str = "p1") -> ObservedNode:
    return node(fqn, "publish /chatter", *more, enclave=enclave, participant=pid)


@pytest.mark.parametrize(
    ("enclaves", "nodes", "denied"),
    [
        (TALKER, [talks()], []),
        (TALKER, [talks(enclave="/t")], []),
        (
            TALKER,
            [talks("subscribe /chatter")],
            ["/t subscribe topic /chatter (/talker): no rule allows subscribe rt/chatter"],
        ),
        (
            TALKER,
            [talks("reply ~/reset", "call fib")],
            [
                "/t reply service /talker/reset (/talker): no rule allows publish"
                " rr/talker/resetReply",
                "/t call action /fib (/talker): no rule allows publish"
                " rq/fib/_action/cancel_goalRequest",
            ],
        ),
        # A right is one of the enclave, whichever of its nodes uses it.
        (
            {"/t": {"/a": ["publish old/y"], "/b": []}},
            [node("/a", "publish /y", enclave="/t"), node("/b", "publish /y", enclave="/t")],
            [f"/t publish topic /y (/a, /b): no rule allows publish rt/y{lacks('/y', '/old/y')}"],
        ),
        (
            {"/t": {"/talker": ["reply ~/get_parameters", "publish transition_event"]}},
            [node("/talker", "publish ~/transition_event", enclave="/t")],
            [
                "/t publish topic /talker/transition_event (/talker): no rule allows publish "
                "rt/talker/transition_event; if /talker is a lifecycle node, include "
                "common/lifecycle_node.xml in its profile, in place of common/node.xml"
            ],
        ),
        # A parameter names another topic. Twin: peers have a right to this topic.
        *(
            (
                {"/t": {"/driver": ["publish motor_cmd", "publish /tf"], "/base": [peers]}},
                [node("/driver", "publish /base/cmd", enclave="/t")],
                [f"/t publish topic /base/cmd (/driver): no rule allows publish rt/base/cmd{hint}"],
            )
            for peers, hint in (
                ("subscribe /x", UNUSED.format("publish /motor_cmd")),
                ("subscribe /base/cmd", ""),
            )
        ),
        # What another node of the process uses is no name that a remapping lacks.
        (
            {"/t": {"/a": ["publish old/y"], "/b": []}},
            [node("/a", "publish /old/y", enclave="/t"), node("/b", "publish /y", enclave="/t")],
            ["/t publish topic /y (/b): no rule allows publish rt/y"],
        ),
        # DDS knows processes: what another node of the enclave may do is allowed.
        ({"/t": {"/talker": [], "/b": ["publish /chatter"]}}, [talks()], []),
        # The enclave that the graph shows counts, whatever the names of the nodes.
        (
            {"/t": {"/*": ["publish chatter"]}, "/u": {"/other": ["publish /x"]}},
            [talks(enclave="/u")],
            ["/u publish topic /chatter (/talker): no rule allows publish rt/chatter"],
        ),
        (TALKER, [talks(enclave="/gone")], [f"/gone publish topic /chatter (/talker): {UNNAMED}"]),
        (TALKER, [talks(fqn="/hall/x")], [f"/hall/x publish topic /chatter (/hall/x): {UNNAMED}"]),
        # Enclaves by name: exact before wildcard, with the parts that change.
        (
            {"/any": {"/*": ["publish /chatter"]}, "/t": {"/talker": []}},
            [talks()],
            ["/t publish topic /chatter (/talker): no rule allows publish rt/chatter"],
        ),
        ({"/any": {"/*": ["publish /chatter"]}, "/t": {"/n": []}}, [talks()], []),
        (
            {"/t": {"/launch_ros_*": ["publish /chatter", "reply ~/x"]}},
            [talks("reply ~/x", fqn="/launch_ros_12")],
            [],
        ),
        ({"/": {"/n": ["publish /chatter"]}, "/u": {"/m": []}}, [talks()], []),
    ],
)
def test_denied(
    enclaves: Enclaves,
    nodes: list[ObservedNode],
    denied: list[str],
    tmp_path: Path,
) -> None:
    found = audited(tmp_path, enclaves, graph(*nodes))
    assert said(found) == denied
    assert found.allowed is not bool(denied)
    assert found.notes == ()


def test_the_rest_of_a_process_shows_its_enclave(tmp_path: Path) -> None:
    """A listener of transforms has the same name in every process."""
    listener = "/transform_listener_impl_*"
    enclaves: Enclaves = {
        "/a": {"/a": ["publish x"], listener: ["subscribe /tf"]},
        "/b": {"/b": ["publish y"], listener: ["subscribe /tf"]},
    }
    seen = graph(
        node("/a", "publish x", enclave="/"),
        node("/transform_listener_impl_55", "subscribe /tf", enclave="/"),
        node("/b", "publish x", enclave="/", participant="p2"),
        node("/transform_listener_impl_66", "subscribe /tf", enclave="/", participant="p2"),
    )
    found = audited(tmp_path, enclaves, seen)
    text = "/b publish topic /x (/b): no rule allows publish rt/x"
    assert said(found) == [text + UNUSED.format("publish /y")]
    assert found.notes == ()


def test_a_process_that_fits_several_enclaves_is_judged_in_all(tmp_path: Path) -> None:
    enclaves: Enclaves = {"/one": {"/talker": ["publish /chatter"]}, "/two": {"/talker": []}}
    found = audited(tmp_path, enclaves, graph(talks()))
    assert said(found) == [
        "/two publish topic /chatter (/talker): no rule allows publish rt/chatter"
    ]
    assert ids(found) == ["audit.several-enclaves"]
    assert "/talker in /one or /two" in found.notes[0].text


@pytest.mark.parametrize(
    ("enclave", "denied", "notes"),
    [
        ("/", "/b", ["audit.divided-process"]),
        ("/b", "/b", ["audit.other-enclave"]),
        ("/c", "/c", ["audit.other-enclave"]),
        ("/free", "/free", []),
    ],
)
def test_a_process_whose_nodes_are_in_different_enclaves(
    enclave: str, denied: str, notes: list[str], tmp_path: Path
) -> None:
    """A patch would put a node into a second enclave. Twin: the enclave also has the node."""
    enclaves = {"/a": {"/a": ["publish x"]}, "/b": {"/b": ["publish y", "publish z"]}}
    enclaves["/c"] = {"/c": []}
    enclaves |= {"/free": {"/a": [], "/b": ["publish y", "publish z"]}} if not notes else {}
    b_uses = ("publish y", "publish z", "publish new")
    seen = graph(node("/a", "publish x", enclave=enclave), node("/b", *b_uses, enclave=enclave))
    found = audited(tmp_path, enclaves, seen)
    assert f"{denied} publish topic /x (/a): no rule allows publish rt/x" in said(found)
    assert ids(found) == notes
    added = [(profile.enclave, profile.node) for profile in found.missing.profiles]
    own = [("/b", "b")] if denied == "/b" else []
    assert added == (own if notes else [("/free", "a"), ("/free", "b")])
    for note in found.notes:
        assert "--enclave ENCLAVE`, with --node for each" in note.text
        judged = f"/a, /b (judged in {denied})" if enclave == "/" else f"/a in {denied} (its enc"
        assert judged in note.text


def test_what_a_rule_denies_cannot_be_added(tmp_path: Path) -> None:
    enclaves = {"/t": {"/talker": ["publish /*", "publish /chatter DENY"]}}
    found = audited(tmp_path, enclaves, graph(talks("subscribe /x")))
    assert [(each.right.right, each.by_rule) for each in found.denied] == [
        ("publish", True),
        ("subscribe", False),
    ]
    assert {each.right for p in found.missing.profiles for each in p.rights} == {"subscribe"}


def test_tools_and_strays_are_said(tmp_path: Path) -> None:
    seen = make_observation(
        [talks(), node("/_ros2cli_12", "publish /x", enclave="/", participant="p2")],
        strays=[("p9", Endpoint("Square", "publish"))],
    )
    found = audited(tmp_path, TALKER, seen)
    assert found.allowed
    assert ids(found) == ["audit.tool-writes", "audit.stray"]
    assert found.unjudged == (
        "1 node with a tool's name (/_ros2cli_12 publish /x)",
        "1 topic without a node (Square)",
    )
    assert [each.fqn for each in found.observation.nodes] == ["/talker"]


def test_a_tool_that_only_observes_leaves_nothing_open(tmp_path: Path) -> None:
    daemon = node("/_ros2cli_daemon", "subscribe /x", like="c++", enclave="/", participant="p2")
    found = audited(tmp_path, TALKER, graph(talks(), daemon))
    assert (ids(found), found.unjudged, found.tools) == (["audit.tool"], (), (daemon,))


@pytest.mark.parametrize(("context", "enclave"), [("01", "/t"), ("02", "/_ros2cli_12")])
def test_a_node_of_the_robot_with_the_name_of_a_tool_is_judged(
    context: str, enclave: str, tmp_path: Path
) -> None:
    """Each context of a process has a participant of its own."""
    process = "010f00000000000a000000"
    hidden = node("/_ros2cli_12", "publish /evil", enclave="/", participant=process + context)
    found = audited(tmp_path, TALKER, graph(talks(pid=f"{process}01"), hidden))
    assert [(right.right.enclave, right.right.name) for right in found.denied] == [
        (enclave, "/evil")
    ]
    assert [each.node for each in found.missing.profiles] == ["_ros2cli_12"]


def test_a_node_without_an_endpoint_is_not_judged(tmp_path: Path) -> None:
    seen = make_observation([talks()], silent=[("/", "/", "mute"), ("/", "/", "_ros2cli_9")])
    found = audited(tmp_path, TALKER, seen)
    assert ids(found) == ["audit.tool", "audit.silent"]
    assert found.unjudged == ("1 node without endpoints (/mute)",)
    assert found.allowed and found.unjudged


HALL = {"/t": {"/talker": ["publish chatter"], "/hall/a": []}, "/h": {"/hall/[ab]*": []}}


@pytest.mark.parametrize(
    ("enclaves", "nodes", "unseen"),
    [
        (TALKER, [talks()], []),
        (HALL, [talks()], ["node /hall/[ab]* of enclave /h", "node /hall/a of enclave /t"]),
        (HALL, [talks(), node("/hall/a", enclave="/t")], ["node /hall/[ab]* of enclave /h"]),
        (
            HALL,
            [talks(), node("/hall/bell", enclave="/", participant="p2")],
            ["node /hall/a of enclave /t"],
        ),
        # In another enclave than its own, a node is another one.
        (
            {**TALKER, "/u": {"/x": []}},
            [talks(enclave="/u")],
            ["node /talker of enclave /t", "node /x of enclave /u"],
        ),
        # What the policy has for the tools that observe a robot need not run.
        ({**TALKER, "/o": {"/_sros_observer": []}, "/cli": {"/_ros2cli_*": []}}, [talks()], []),
    ],
)
def test_nodes_that_were_not_seen(
    enclaves: Enclaves, nodes: list[ObservedNode], unseen: list[str], tmp_path: Path
) -> None:
    found = audited(tmp_path, enclaves, graph(*nodes))
    assert list(map(str, found.unseen)) == unseen
    assert not found.unjudged


def test_topics_without_a_ros_name_are_judged_and_never_added(tmp_path: Path) -> None:
    seen = talks()
    odd = {
        Endpoint("Square", "publish"),
        Endpoint("rt/*", "publish"),
        Endpoint("rq/aRequest", "publish"),
    }
    found = audited(tmp_path, TALKER, graph(replace(seen, endpoints=seen.endpoints | odd)))
    assert {each.right.name for each in found.denied} == {"Square", "/*", "rq/aRequest"}
    assert found.missing.profiles == ()
    assert {note.id for note in found.missing.notes} == {
        "graph.half-service", "graph.no-ros-name", "graph.odd-name",
    }  # fmt: skip


def test_vendors_differ(tmp_path: Path) -> None:
    """Cyclone DDS refuses a topic of which the other direction is denied."""
    enclaves = {"/t": {"/talker": ["publish /chatter", "subscribe /chatter DENY"]}}
    assert audited(tmp_path, enclaves, graph(talks())).allowed
    assert not audited(tmp_path, enclaves, graph(talks()), Vendor.CYCLONE).allowed


def test_what_only_peers_deny_counts_too(tmp_path: Path) -> None:
    """Fast DDS creates a writer on a topic with a long name, and no peer matches it."""
    long = f"/{'x' * 255}"
    enclaves = {"/t": {"/talker": ["publish /*"]}}
    found = audited(tmp_path, enclaves, graph(talks(f"publish {long}")))
    assert [each.right.name for each in found.denied] == [long]


ROBOT = {
    "/t": {"/talker": ["publish chatter", "reply ~/get_parameters"]},
    "/hall/l": {"/hall/listener": ["subscribe /chatter", "reply ~/get_parameters"]},
}


@pytest.mark.parametrize("enclaves", [{}, {"/t": {"/talker": []}}, ROBOT])
def test_what_is_missing_makes_everything_allowed(enclaves: Enclaves, tmp_path: Path) -> None:
    seen = graph(
        talks("call /fib"),
        node(
            "/hall/listener", "subscribe /chatter", "reply ~/reset", enclave="/", participant="p2"
        ),
        node("/launch_ros_17", "reply ~/x", enclave="/", participant="p3"),
    )
    file = written(tmp_path, {"/other": {"/other": ["publish x"]}, **enclaves})
    before = audit(seen, of_policy(file))
    patch = tmp_path / "patch.xml"
    patch.write_bytes(render(before.missing))
    assert b"Written by sros audit" in patch.read_bytes()
    merged = merge_into(file, read_policy(patch))
    file.write_bytes(merged.document)
    assert not before.allowed and merged.contradictions == ()
    assert audit(seen, of_policy(file)).allowed
    assert {(r.right, r.name) for r in merged.added} <= {
        (r.right.right, r.right.name.replace("_17", "_*")) for r in before.denied
    }


# ── keystores ──────────────────────────────────────────────────────────────────────────────


def of_keystore(root: Path, domain: int = 0) -> AuditedEnclaves:
    context = JoinContext(domain, datetime.now(UTC))
    return keystore_enclaves(load_rights(root), enclave_names(root), Vendor.FAST, context)


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("audit")
    policy = read_policy(written(folder, ROBOT))
    generate_artifacts(
        folder / "ks",
        policies=[policy],
        now=datetime.now(UTC),
        create=TEMPLATE,
        domains=ONE_DOMAIN,
    )
    return folder / "ks"


def uses(fqn: str, pid: str, *rights: str) -> ObservedNode:
    return node(fqn, "reply ~/get_parameters", *rights, enclave="/", participant=pid)


@pytest.mark.parametrize(
    ("more", "denied"),
    [
        ((), []),
        (("publish /x",), ["/hall/l publish topic /x (/hall/listener)"]),
    ],
)
def test_permissions_know_their_nodes_by_the_services_that_these_offer(
    keystore: Path, more: Iterable[str], denied: list[str]
) -> None:
    seen = graph(
        uses("/talker", "p1", "publish /chatter"),
        uses("/hall/listener", "p2", "subscribe /chatter", *more),
    )
    found = audit(seen, of_keystore(keystore))
    assert [line.partition(":")[0] for line in said(found)] == denied
    assert not (found.unseen or found.unjudged)


def test_a_keystore_tells_which_of_its_nodes_were_not_seen(keystore: Path, tmp_path: Path) -> None:
    seen = graph(uses("/talker", "p1"))
    (unseen,) = audit(seen, of_keystore(keystore)).unseen
    assert str(unseen) == "node /hall/listener of enclave /hall/l"
    other = tmp_path / "ks"
    copytree(keystore, other, symlinks=True)
    sros("create_enclave", other, "/observer").ok()
    without = audit(seen, of_keystore(other)).unseen
    assert [str(each) for each in without][1:] == ["node /* of enclave /observer"]
    assert audit(seen, of_keystore(other), "/observer").unseen == (unseen,)


def test_an_enclave_that_dds_refuses_is_reported_as_a_whole(keystore: Path) -> None:
    found = audit(graph(uses("/talker", "p1", "publish /x")), of_keystore(keystore, domain=5))
    assert said(found) == [] and not found.allowed
    assert set(found.refused) == {"/t"}
    assert "domain 5" in found.refused["/t"]


TWO = "2 rights (publish topic /chatter, publish topic /x)"


@pytest.mark.parametrize(
    ("enclaves", "fqns", "lines"),
    [
        (
            {"/left/talker": {"/left/talker": []}},
            ["/talker"],
            [f"/talker: {UNNAMED}: {TWO}; perhaps it is node /left/talker of enclave "
             "/left/talker, which was not seen"],
        ),
        ({"/left/talker": {"/left/other": []}}, ["/talker"], [f"/talker: {UNNAMED}: {TWO}"]),
        (
            {"/left": {"/left/talker": []}, "/right": {"/right/talker": []}},
            ["/talker"],
            [f"/talker: {UNNAMED}: {TWO}"],
        ),
        (
            {"/left/talker": {"/left/talker": []}},
            ["/a/talker", "/b/talker"],
            [f"/a/talker: {UNNAMED}: {TWO}", f"/b/talker: {UNNAMED}: {TWO}"],
        ),
        (
            {"/left/talker": {"/left/talker": ["publish /chatter", "publish /x"]}},
            ["/left/talker"],
            [],
        ),
    ],
)  # fmt: skip
def test_one_line_for_a_node_without_an_enclave(
    enclaves: Enclaves, fqns: list[str], lines: list[str], tmp_path: Path
) -> None:
    """The node that the policy has may have been started in another namespace."""
    nodes = [talks("publish /x", fqn=fqn, pid=fqn) for fqn in fqns]
    assert list(audited(tmp_path, enclaves, graph(*nodes)).lines().values()) == lines


def test_the_nodes_of_a_process_in_the_wrong_namespace(tmp_path: Path) -> None:
    enclaves: Enclaves = {"/rig": {"/left/cell": [], "/left/talker": []}}
    nodes = (talks("publish /x"), talks("publish /y", fqn="/cell"))
    lines = audited(tmp_path, enclaves, graph(*nodes)).lines().values()
    cell, talker = (f"node /left/{name} of enclave /rig" for name in ("cell", "talker"))
    assert [line.partition("; ")[2] for line in lines] == [
        f"perhaps they are {cell} and {talker}, which were not seen",
        f"perhaps it is {talker}, which was not seen",
        f"perhaps it is {cell}, which was not seen",
    ]


def test_each_right_of_a_known_enclave_has_a_line(tmp_path: Path) -> None:
    seen = graph(talks("publish /x", "publish /y"), talks(fqn="/new", pid="p2"))
    denied = audited(tmp_path, TALKER, seen)
    assert list(denied.lines().values()) == [
        "/t publish topic /x (/talker): no rule allows publish rt/x",
        "/t publish topic /y (/talker): no rule allows publish rt/y",
        f"/new: {UNNAMED}: 1 right (publish topic /chatter)",
    ]
