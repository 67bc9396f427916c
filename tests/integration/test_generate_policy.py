"""A policy learned from real nodes is the expected one, covers just what was seen, and holds.

The nodes are those of rclpy in processes of their own (unsecured, for its wheels have no DDS
Security); what is learned from them is then enforced by Cyclone DDS.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.backend import RCLPY
from sros_tool.files import policies_dir
from sros_tool.graph import observe
from sros_tool.graph.learn import is_tool_name
from sros_tool.graph.observation import Observation, observation_from_json
from sros_tool.graph.observe import Readings
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.names import ROS_DISCOVERY_TOPIC
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave, Group, Policy
from sros_tool.policy.rights import policy_rights
from sros_tool.translate import permissions_for
from sros_tool.validity import Window
from tests.integration.converse import converse, listener, talker
from tests.integration.cyclone_rights import Endpoint, refusals
from tests.integration.enforcing import enforces
from tests.support.children import LATE, apart, python
from tests.support.harness import Ended, sros
from tests.support.long_form import some, sometimes

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed"),
]

DOMAIN = 211
NO_NODES = "No nodes detected in the ROS graph. No policy file was generated."


def node(name: str, ns: str = "/", **rights: list[str] | bool) -> dict[str, Any]:
    return {"name": name, "ns": ns, **rights}


def process(enclave: str, *nodes: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"enclave": enclave, "nodes": list(nodes), **more}


SIMULATED = ["-p", "use_sim_time:=true"]
ROBOT = [
    process("/talker", node("talker", publish=["chatter", "/tf"], ask=["/hall/listener"])),
    process("/listener", node("listener", "/hall", subscribe=["/chatter", "~/status"])),
    process("/adder", node("server", "/hall", reply=["add", "~/reset"])),
    process("/caller", node("client", request=["/hall/add"], subscribe=["fib/_action/status"])),
    process("/fibonacci", node("fibonacci", execute=["fib"])),
    process("/planner", node("planner", "/hall", call=["/fib"], execute=["plan"])),
    process(
        "/composed",
        node("left", "/hall", publish=["out"]),
        node("right", "/cellar", managed=True, subscribe=["in"]),
        arguments=SIMULATED,
    ),
    # Of the same name: in two enclaves, and in two processes of one enclave.
    process("/first", node("twin", publish=["one"])),
    process("/second", node("twin", publish=["two"])),
    process("/crew", node("worker", publish=["a"], subscribe=["job"])),
    process("/crew", node("worker", publish=["b"], subscribe=["job"])),
    process("/tools", node("_ros2cli_daemon_0_abc", bare=True)),
]

EXPECTED = """\
<?xml version="1.0" encoding="UTF-8"?>
<!-- Written by sros generate_policy: rights that the robot was observed to use.
     Review it before you enforce it: rights that were not observed are not allowed, and rights
     that were observed may be unwanted. -->
<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude">
  <enclaves>
    <enclave path="/adder">
      <profiles>
        <profile ns="/hall" node="server">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <services reply="ALLOW">
            <service>add</service>
            <service>~/reset</service>
          </services>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/caller">
      <profiles>
        <profile ns="/" node="client">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <topics subscribe="ALLOW">
            <topic>fib/_action/status</topic>
          </topics>
          <services request="ALLOW">
            <service>/hall/add</service>
          </services>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/composed">
      <profiles>
        <profile ns="/cellar" node="right">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <xi:include href="common/node/time.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW">
            <topic>~/transition_event</topic>
          </topics>
          <topics subscribe="ALLOW">
            <topic>in</topic>
          </topics>
          <services reply="ALLOW">
            <service>~/change_state</service>
            <service>~/get_available_states</service>
            <service>~/get_available_transitions</service>
            <service>~/get_state</service>
            <service>~/get_transition_graph</service>
          </services>
        </profile>
        <profile ns="/hall" node="left">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <xi:include href="common/node/time.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW">
            <topic>out</topic>
          </topics>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/crew">
      <profiles>
        <profile ns="/" node="worker">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW">
            <topic>a</topic>
            <topic>b</topic>
          </topics>
          <topics subscribe="ALLOW">
            <topic>job</topic>
          </topics>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/fibonacci">
      <profiles>
        <profile ns="/" node="fibonacci">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <actions execute="ALLOW">
            <action>fib</action>
          </actions>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/first">
      <profiles>
        <profile ns="/" node="twin">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW">
            <topic>one</topic>
          </topics>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/listener">
      <profiles>
        <profile ns="/hall" node="listener">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <topics subscribe="ALLOW">
            <topic>/chatter</topic>
            <topic>~/status</topic>
          </topics>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/planner">
      <profiles>
        <profile ns="/hall" node="planner">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <actions call="ALLOW">
            <action>/fib</action>
          </actions>
          <actions execute="ALLOW">
            <action>plan</action>
          </actions>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/second">
      <profiles>
        <profile ns="/" node="twin">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW">
            <topic>two</topic>
          </topics>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/talker">
      <profiles>
        <profile ns="/" node="talker">
          <xi:include href="common/rclpy_node.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW">
            <topic>/tf</topic>
            <topic>chatter</topic>
          </topics>
          <services request="ALLOW">
            <service>/hall/listener/describe_parameters</service>
            <service>/hall/listener/get_parameter_types</service>
            <service>/hall/listener/get_parameters</service>
            <service>/hall/listener/list_parameters</service>
            <service>/hall/listener/set_parameters</service>
            <service>/hall/listener/set_parameters_atomically</service>
          </services>
        </profile>
      </profiles>
    </enclave>
  </enclaves>
</policy>
"""

OLDER = """\
<?xml version="1.0"?>
<!-- Written by hand. -->
<policy version="0.2.0">
  <enclaves>
    <enclave path="/talker">
      <profiles type="mine">
        <profile ns="/" node="talker">
          <topics publish="ALLOW" subscribe="ALLOW"><topic>/both</topic></topics>
          <topics publish="DENY"><topic>/tf</topic></topics> <!-- never -->
        </profile>
        <metadata><owner>me</owner></metadata>
      </profiles>
    </enclave>
  </enclaves>
</policy>
"""

ELSEWHERE = """\
<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude">
  <enclaves><xi:include href="older.xml" xpointer="xpointer(/policy/enclaves/enclave)"/></enclaves>
</policy>
"""


# ── running ────────────────────────────────────────────────────────────────────────────────


Command = str | dict[str, Any]


def live(
    domain: int,
    folder: Path,
    processes: list[dict[str, Any]],
    *commands: Command | Sequence[Command],
) -> list[Ended]:
    """Run commands next to the nodes, one after the other; those of a list at the same time."""

    def spelled(each: Command) -> dict[str, Any]:
        return {"words": each.split()} if isinstance(each, str) else each

    groups = [[each] if isinstance(each, str | dict) else each for each in commands]
    spelt = [[spelled(each) for each in group] for group in groups]
    from tests.integration.ros_nodes import robot  # it imports rclpy, once for all that follow

    return apart(partial(robot.play, domain, folder, processes, spelt))


@dataclass(frozen=True)
class Learned:
    folder: Path
    ended: dict[str, Ended]
    observed: dict[str, Any]


class Replayed:
    """What was observed of a robot, in place of the observer: it stays as it is."""

    rmw = "rmw_fastrtps_cpp"

    def __init__(self, seen: Observation) -> None:
        self._seen: Observation | None = seen

    @property
    def readings(self) -> Readings:
        return Readings(time.monotonic())

    def __enter__(self) -> Replayed:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def next(self, seconds: float) -> Observation | None:
        seen, self._seen = self._seen, None
        if seen is None:
            time.sleep(seconds)
        return seen


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Learned:
    """Everything that is asked of one robot, which one run observes.

    What other runs do with what they see, they are asked with what this one saw.
    """
    folder = tmp_path_factory.mktemp("robot")
    (folder / "older.xml").write_text(OLDER)
    (folder / "elsewhere.xml").write_text(ELSEWHERE)
    (flat,) = live(DOMAIN, folder, ROBOT, "generate_policy flat.xml --flat --json")
    assert flat.status == 0, flat.err
    observed = json.loads(flat.out)
    ended = {"flat": flat}
    later = {
        "first": "robot.xml",
        "elsewhere": "elsewhere.xml",
        "dry": "never.xml --dry-run",
        "second": "robot.xml --no-daemon --use-sim-time",
        "older": "older.xml",
        "older_again": "older.xml",
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observe, "RosGraph", lambda _: Replayed(observation_from_json(observed)))
        for name, words in later.items():
            spelt = ("generate_policy", *words.split(), "--spin-time", "0.1")
            ended[name] = sros(*spelt, cwd=folder)
    return Learned(folder, ended, observed)


def observed_endpoints(learned: Learned) -> dict[str, set[Endpoint]]:
    found: dict[str, set[Endpoint]] = {}
    for each in learned.observed["nodes"]:
        if is_tool_name(each["name"]):  # also the observers of the other commands
            continue
        (enclave,) = each["enclaves"]
        for way in ("publish", "subscribe"):
            found.setdefault(enclave, set()).update((way, topic) for topic in each[way])
    return found


def allowed_endpoints(enclave: Enclave) -> set[Endpoint]:
    """Every topic of the permissions that sros makes from a policy."""
    moment = datetime(2024, 1, 1, tzinfo=UTC)
    permissions = permissions_for(
        enclave,
        subject=f"CN={enclave.path}",
        validity=Window(moment, moment + timedelta(days=1)),
        domains=DomainSet.parse("0"),
    )
    (only,) = permissions.grants
    assert all(rule.allow for rule in only.rules)
    return {
        (way, topic)
        for rule in only.rules
        for way, found in (("publish", rule.publish), ("subscribe", rule.subscribe))
        for each in found
        for topic in each.topics
    } - {("publish", ROS_DISCOVERY_TOPIC), ("subscribe", ROS_DISCOVERY_TOPIC)}


# ── what is learned ────────────────────────────────────────────────────────────────────────


def test_the_policy_is_the_expected_one(learned: Learned) -> None:
    ended = learned.ended["first"]
    assert ended.status == 0, ended.err
    assert (learned.folder / "robot.xml").read_text() == EXPECTED
    assert "wrote 'robot.xml': 10 enclaves, 11 nodes" in ended.out
    assert "copied common/node/logging.xml, " in ended.out
    for part in ("rclpy_node.xml", "node/time.xml", "node/types.xml"):
        copied = (learned.folder / "common" / part).read_bytes()
        assert copied == (policies_dir() / "common" / part).read_bytes()
    assert not (learned.folder / "common" / "node.xml").exists(), "only what is needed"


def test_what_is_left_out_is_said(learned: Learned) -> None:
    err = learned.ended["first"].err
    assert "note [graph.tool]" in err
    assert "/_ros2cli_daemon_0_abc" in err
    assert "note [graph.partial-action]" in err
    assert "/client subscribe /fib/_action/status" in err
    assert "ambiguous" not in err


def test_a_second_run_changes_nothing(learned: Learned) -> None:
    ended = learned.ended["second"]
    assert ended.status == 0, ended.err
    assert ended.out == "nothing to add: 'robot.xml' already covers all rights that were observed\n"
    assert (learned.folder / "robot.xml").read_text() == EXPECTED


def test_flat_is_the_same_in_one_file(learned: Learned, tmp_path: Path) -> None:
    assert b"include" not in (learned.folder / "flat.xml").read_bytes()
    alone = shutil.copy(learned.folder / "flat.xml", tmp_path)
    assert policy_rights(read_policy(Path(alone))) == policy_rights(
        read_policy(learned.folder / "robot.xml")
    )


def test_processes_are_told_apart(learned: Learned) -> None:
    nodes = [each for each in learned.observed["nodes"] if each["name"] in ("twin", "worker")]
    assert len({each["participant"] for each in nodes}) == 4
    assert all(len(each["enclaves"]) == 1 for each in nodes)


@pytest.mark.parametrize("file", ["robot.xml", "flat.xml"])
def test_permissions_cover_what_was_observed_and_nothing_else(learned: Learned, file: str) -> None:
    policy = read_policy(learned.folder / file)
    allowed = {each.path: allowed_endpoints(each) for each in policy.enclaves}
    observed = observed_endpoints(learned)
    assert len(observed["/planner"]) == 32
    assert allowed == observed


def test_it_stays_inside_the_portable_profile(learned: Learned, tmp_path: Path) -> None:
    result = generate_artifacts(
        tmp_path / "keystore",
        policies=[read_policy(learned.folder / "robot.xml")],
        now=datetime.now(UTC),
        create=load_template("production"),
    )
    assert result.notes == ()


def test_a_dry_run_writes_nothing(learned: Learned) -> None:
    assert "would have written 'never.xml'" in learned.ended["dry"].out
    assert not (learned.folder / "never.xml").exists()


# ── merging ────────────────────────────────────────────────────────────────────────────────


def test_merging_keeps_what_was_there_and_adds_one_direction(learned: Learned) -> None:
    ended = learned.ended["older"]
    assert ended.status == 0, ended.err
    text = (learned.folder / "older.xml").read_text()
    declared = 'version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude"'
    for line in OLDER.replace('version="0.2.0"', declared).splitlines():
        assert line in text
    assert "note [merge.still-denied]" in ended.err and "/tf" in ended.err
    rights = {(each.qualifier, each.right, each.name) for each in policy_rights(
        read_policy(learned.folder / "older.xml")
    ) if each.enclave == "/talker"}  # fmt: skip
    assert ("ALLOW", "publish", "/chatter") in rights
    assert ("ALLOW", "subscribe", "/chatter") not in rights
    assert ("DENY", "publish", "/tf") in rights and ("ALLOW", "publish", "/tf") not in rights


def test_what_is_new_in_an_old_file_comes_with_its_includes(learned: Learned) -> None:
    text = (learned.folder / "older.xml").read_text()
    # Also in the profile of /talker, which was there and had nothing of it.
    assert text.count('<xi:include href="common/rclpy_node.xml"') == 11
    assert text.count("http://www.w3.org/2001/XInclude") == 1


def test_merging_again_adds_nothing(learned: Learned) -> None:
    assert learned.ended["older_again"].status == 0
    assert "nothing to add" in learned.ended["older_again"].out


def test_a_merge_that_fails_leaves_the_file_as_it_was(learned: Learned) -> None:
    ended = learned.ended["elsewhere"]
    assert ended.status == 2
    assert ended.err.startswith("Unable to generate policy: rights of the enclave")
    assert (learned.folder / "elsewhere.xml").read_text() == ELSEWHERE
    assert sorted(each.name for each in learned.folder.iterdir()) == [
        "common", "elsewhere.xml", "flat.xml", "older.xml", "robot.xml",
    ]  # fmt: skip


# ── enforced ───────────────────────────────────────────────────────────────────────────────


def keystore_of(policy: Policy, root: Path) -> Path:
    generate_artifacts(
        root,
        policies=[policy],
        now=datetime.now(UTC),
        create=load_template("production"),
        domains=DomainSet.of((DOMAIN + 3, DOMAIN + 3)),
    )
    return root


def refused(keystore: Path, enclave: str, endpoints: Iterable[Endpoint]) -> set[Endpoint]:
    return set(refusals(enclave_path(keystore, enclave), DOMAIN + 3, endpoints))


def without(policy: Policy, path: str, name: str) -> Policy:
    """The policy without one name of one enclave."""

    def poorer(groups: tuple[Group, ...]) -> tuple[Group, ...]:
        left = (replace(g, names=tuple(n for n in g.names if n != name)) for g in groups)
        return tuple(group for group in left if group.names)

    return replace(
        policy,
        enclaves=tuple(
            each
            if each.path != path
            else replace(
                each,
                profiles=tuple(
                    block._replace(
                        profiles=tuple(replace(p, groups=poorer(p.groups)) for p in block.profiles),
                    )
                    for block in each.profiles
                ),
            )
            for each in policy.enclaves
        ),
    )


def test_a_learned_pair_works_on_cyclone_and_one_topic_less_fails(
    learned: Learned, tmp_path: Path
) -> None:
    policy = read_policy(learned.folder / "robot.xml")
    whole = keystore_of(policy, tmp_path / "whole")
    poorer = keystore_of(without(policy, "/talker", "chatter"), tmp_path / "poorer")
    seen = observed_endpoints(learned)

    said = converse(DOMAIN + 3, talker(whole, "/talker"), listener(whole, "/listener"))
    assert said.heard(), said
    deaf = listener(poorer, "/listener", hears=False)
    said = converse(DOMAIN + 3, talker(poorer, "/talker"), deaf)
    assert said.nodes["listener"].heard == [], said
    assert said.nodes["talker"].kinds == ["refused"], said
    assert refused(poorer, "/talker", seen["/talker"]) == {("publish", "rt/chatter")}


@pytest.mark.parametrize("path", ["/talker", "/planner", "/fibonacci", "/crew", "/composed"])
def test_cyclone_allows_what_was_learned_and_nothing_else(
    learned: Learned, tmp_path: Path, path: str
) -> None:
    keystore = keystore_of(read_policy(learned.folder / "robot.xml"), tmp_path / "keystore")
    seen = observed_endpoints(learned)
    others = set.union(*seen.values()) - seen[path]
    assert refused(keystore, path, seen[path] | others) == others


def test_what_cyclone_denied_is_proposed_and_then_allowed(tmp_path: Path) -> None:
    """Both nodes hold the wrong direction of their topic; their log sets it right."""
    path, enclave = tmp_path / "robot.xml", "/robot"
    path.write_text(
        f'<policy version="0.2.0"><enclaves><enclave path="{enclave}"><profiles>'
        '<profile ns="/" node="arm"><topics publish="ALLOW"><topic>state</topic></topics>'
        '<topics subscribe="ALLOW"><topic>goal</topic></topics></profile>'
        "</profiles></enclave></enclaves></policy>"
    )
    wrong = {("subscribe", "rt/state"), ("publish", "rt/goal")}
    never = {("publish", "rt/never")}
    # Cyclone DDS says nothing of topics whose discovery is protected.
    template = load_template("production")
    default = replace(template.protection.default, discovery=False)
    template = replace(template, protection=replace(template.protection, default=default))

    def keystore(name: str) -> Path:
        root, domains = tmp_path / name, DomainSet.of((DOMAIN + 3, DOMAIN + 3))
        generate_artifacts(
            root,
            policies=[read_policy(path)],
            now=datetime.now(UTC),
            create=template,
            domains=domains,
        )
        return root

    before = keystore("before")
    said = refusals(enclave_path(before, enclave), DOMAIN + 3, wrong | never)
    assert set(said) == wrong | never
    (tmp_path / "arm.log").write_text("".join(f"{text}\n" for text in said.values()))
    words = ("robot.xml", "--enclave", enclave, "--from-log", "arm.log", "--accept")
    ended = sros("generate_policy", *words, cwd=tmp_path).ok()
    assert "note [log.unclear]" in ended.err and "rt/never" in ended.err
    assert "added 2 rights" in ended.out
    assert refused(keystore("after"), enclave, wrong | never) == never


# ── without enclaves ──────────────────────────────────────────────────────────────────────

UNSHOWN = "/"
"""The enclave that the graph shows for a process that was started without one."""
UNSECURED = [
    process(UNSHOWN, node("talker", publish=["chatter"])),
    process(UNSHOWN, node("listener", "/hall", subscribe=["/chatter"])),
    process(UNSHOWN, node("left", publish=["out"]), node("right", "/cellar", subscribe=["/in"])),
    process(UNSHOWN, node("twin", publish=["one"])),
    process(UNSHOWN, node("twin", publish=["two"])),
]


@sometimes("a robot without enclaves is learned")
def test_a_robot_without_enclaves_is_learned_into_one_for_each_process(tmp_path: Path) -> None:
    commands = ("generate_policy own.xml --enclave-per-node", "generate_policy shared.xml --flat")
    own, shared = live(DOMAIN + 5, tmp_path, UNSECURED, list(commands))
    assert own.status == shared.status == 0, (own, shared)
    assert "note [graph.several-nodes]" in own.err and "/left has /cellar/right, /left" in own.err
    assert "note [graph.same-node]" in own.err and "/twin in /twin (2 processes)" in own.err
    assert "note [graph.root-enclave]" in shared.err and "[graph.root-enclave]" not in own.err
    rights = rights_of(tmp_path / "own.xml")
    assert {each[0] for each in rights} == {"/talker", "/hall/listener", "/left", "/twin"}
    assert {each[0] for each in rights_of(tmp_path / "shared.xml")} == {"/"}
    topics = {each for each in rights if each[2] in ("/chatter", "/out", "/in", "/one", "/two")}
    assert topics == {
        ("/talker", "publish", "/chatter"),
        ("/hall/listener", "subscribe", "/chatter"),
        ("/left", "publish", "/out"),
        ("/left", "subscribe", "/in"),
        ("/twin", "publish", "/one"),
        ("/twin", "publish", "/two"),
    }

    keystore = keystore_of(read_policy(tmp_path / "own.xml"), tmp_path / "keystore")
    pair = talker(keystore, "/talker"), listener(keystore, "/hall/listener")
    said = converse(DOMAIN + 3, *pair)
    assert said.heard(), said
    others = {("publish", "rt/out"), ("subscribe", "rt/in"), ("publish", "rt/one")}
    assert refused(keystore, "/talker", {("publish", "rt/chatter"), *others}) == others


# ── over time ──────────────────────────────────────────────────────────────────────────────

WATCHING = "watching until Ctrl-C; then the policy is written"
PASSED_BY = "seen: /passer_by (/passer_by) publish /hello"
PASSER_BY = process(
    "/passer_by", node("passer_by", publish=["hello"]), visits=[WATCHING, PASSED_BY]
)
BEATS = "seen: /steady (/steady) publish /beat"
STEADY = process("/steady", node("steady", publish=["beat"]))


def stopped(words: str, number: signal.Signals, *once: str) -> dict[str, Any]:
    """A command that gets a signal once it has said all texts (none: once it looks around)."""
    return {"words": words.split(), "signal": number, "once": once}


def rights_of(path: Path) -> set[tuple[str, str, str]]:
    return {(each.enclave, each.right, each.name) for each in policy_rights(read_policy(path))}


def test_a_watch_keeps_who_came_and_went(tmp_path: Path) -> None:
    watched, _ = live(
        DOMAIN + 1,
        tmp_path,
        [STEADY, PASSER_BY],
        stopped("generate_policy watched.xml --watch", signal.SIGINT, BEATS),
        "generate_policy after.xml",
    )
    assert watched.status == 0, watched.err
    assert "_sros_observer" not in watched.err
    assert ("/passer_by", "publish", "/hello") in rights_of(tmp_path / "watched.xml")
    assert ("/steady", "publish", "/beat") in rights_of(tmp_path / "watched.xml")
    assert {each[0] for each in rights_of(tmp_path / "after.xml")} == {"/steady"}
    news = [line for line in watched.err.splitlines() if line.startswith("seen: ")]
    assert sorted(news) == [
        "seen: /passer_by (/passer_by)",
        PASSED_BY,
        "seen: /steady (/steady)",
        BEATS,
    ]


@pytest.mark.parametrize("number", some([signal.SIGINT, signal.SIGTERM], 1))
def test_a_signal_ends_a_watch_and_the_policy_is_written(
    tmp_path: Path, number: signal.Signals
) -> None:
    command = stopped("generate_policy --watch endless.xml", number, BEATS)
    (ended,) = live(DOMAIN + 2, tmp_path, [STEADY], command)
    assert ended.status == 0, ended.err
    assert ("/steady", "publish", "/beat") in rights_of(tmp_path / "endless.xml")


def test_ctrl_c_in_a_snapshot_writes_nothing(tmp_path: Path) -> None:
    command = stopped("generate_policy none.xml --spin-time 3600", signal.SIGINT)
    (ended,) = live(DOMAIN + 2, tmp_path, [], command)
    assert (ended.status, ended.err.strip()) == (130, "sros: interrupted")
    assert list(tmp_path.iterdir()) == []


# ── nothing to see ─────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("how", some(["--spin-time 1", "--watch 1s"], 1))
def test_no_nodes(how: str, tmp_path: Path) -> None:
    (ended,) = live(DOMAIN + 4, tmp_path, [], f"generate_policy empty.xml {how}")
    assert ended.status == 1
    assert ended.out == ""
    *watching, message, why = ended.err.splitlines()
    assert (
        watching
        == ["watching for 1 s, or until Ctrl-C; then the policy is written"][: "--watch" in how]
    )
    assert message == NO_NODES
    assert f"domain {DOMAIN + 4}" in why and "--enclave" in why
    assert list(tmp_path.iterdir()) == []


def test_a_dds_without_security_is_named(tmp_path: Path) -> None:
    """The wheels of rclpy have none: an enclave cannot be observed in, and that is the answer."""
    keystore = keystore_of(read_policy(policies_dir() / "observer.xml"), tmp_path / "ks")
    command = f"generate_policy p.xml --keystore {keystore} --enclave /sros_observer --domain 214"
    (ended,) = live(DOMAIN + 3, tmp_path, [], command)
    if enforces(RCLPY):
        assert ended.status == 1, ended
        assert "No nodes detected" in ended.err  # there is nobody to observe
        return
    assert ended.status == 2, ended
    assert ended.err.count("\n") == 1
    assert "built without DDS Security" in ended.err


def test_the_observer_may_join_and_nothing_else(tmp_path: Path) -> None:
    keystore = keystore_of(read_policy(policies_dir() / "observer.xml"), tmp_path / "keystore")
    may = {("publish", "rt/parameter_events"), ("publish", "ros_discovery_info")}
    may.add(("subscribe", "ros_discovery_info"))
    more = {("subscribe", "rt/chatter"), ("publish", "rt/rosout"), ("subscribe", "rt/rosout")}
    assert refused(keystore, "/sros_observer", may | more) == more


def endpoints_of_an_observer(expected: set[Endpoint]) -> set[Endpoint]:
    """What the process that observes the graph has in it; for a process of its own."""
    os.environ["ROS_DOMAIN_ID"] = "216"
    import rclpy

    with observe.RosGraph():
        rclpy.init(args=[])
        asker = rclpy.create_node("asker")
        found: set[Endpoint] = set()
        end = time.monotonic() + LATE
        while time.monotonic() < end:
            time.sleep(0.2)
            for topic, _ in asker.get_topic_names_and_types(no_demangle=True):
                for way, infos in (
                    ("publish", asker.get_publishers_info_by_topic(topic, no_mangle=True)),
                    ("subscribe", asker.get_subscriptions_info_by_topic(topic, no_mangle=True)),
                ):
                    if any(each.node_name.startswith("_sros_observer_") for each in infos):
                        found.add((way, topic))
            if found >= expected:  # a little longer: there must not be more
                end = min(end, time.monotonic() + 2)
    return found


def test_the_observer_has_no_more_than_its_policy_says() -> None:
    (enclave,) = read_policy(policies_dir() / "observer.xml").enclaves
    allowed = allowed_endpoints(enclave)
    assert apart(partial(endpoints_of_an_observer, allowed)) == allowed


_TALK_AND_LOOK = """
import json, subprocess, sys
from pathlib import Path
from tests.support.children import wait_for
from sros_tool.runtime.cyclone import Participant
from sros_tool.runtime.netns import enter_isolation, try_isolation
if sys.argv[3:]:
    with Participant(int(sys.argv[2]), Path(sys.argv[1])) as talker:
        talker.writer("rt/chatter")
        sys.stdin.read()
    sys.exit()
if try_isolation().isolated:
    enter_isolation()
folders, domain = sys.argv[1].split(":"), sys.argv[2]
talk = [sys.executable, "-c", sys.stdin.read(), folders[0], domain, "talk"]
with (
    Participant(int(domain), Path(folders[1])) as observer,
    subprocess.Popen(talk, stdin=subprocess.PIPE) as process,
):
    found = wait_for(observer.publications, "the talker")
    print(json.dumps([each.topic for each in found]))
    process.stdin.close()
"""


def test_a_secured_observer_sees_what_it_may_not_read(tmp_path: Path) -> None:
    """On Cyclone DDS: the discovery is encrypted, and the observer is let in."""
    root, domain = tmp_path / "keystore", DOMAIN + 3
    names = ("talker_listener.xml", "observer.xml")
    generate_artifacts(
        root,
        policies=[read_policy(policies_dir() / name) for name in names],
        now=datetime.now(UTC),
        create=load_template("production"),
        domains=DomainSet.of((domain, domain)),
    )
    enclaves = ("/talker_listener/talker", "/sros_observer")
    folders = ":".join(str(enclave_path(root, each)) for each in enclaves)
    done = python("-c", _TALK_AND_LOOK, folders, domain, said=_TALK_AND_LOOK)
    assert json.loads(done.stdout) == ["rt/chatter"]
    assert refused(root, "/sros_observer", {("subscribe", "rt/chatter")})
