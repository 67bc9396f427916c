"""The example policies against real nodes: what a node has in the graph is what it may have in DDS.

rclpy nodes are started (unsecured, for the wheels of rclpy have no DDS Security) and their
endpoints observed; the permissions that sros makes from the policy must cover every one of them,
and Cyclone DDS, which enforces them, must agree.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.files import policies_dir
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.names import ROS_DISCOVERY_TOPIC, dds_names, expand
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave, Group, Policy, Profile
from sros_tool.translate import permissions_for
from sros_tool.validity import Window
from tests.integration.cyclone_rights import Endpoint, refusals
from tests.support.children import apart
from tests.support.long_form import some

pytestmark = pytest.mark.dds

needs_rclpy = pytest.mark.skipif(
    importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed"
)

DOMAINS = DomainSet.parse("200-219")
CYCLONE_DOMAIN = 210

Nodes = list[dict[str, Any]]


def node(name: str, ns: str = "/", **rights: list[str] | bool) -> dict[str, Any]:
    return {"name": name, "ns": ns, **rights}


CONTAINER = ["list_nodes", "load_node", "unload_node"]
COSTMAP = node(
    "global_costmap",
    "/global_costmap",
    managed=True,
    publish=["costmap", "costmap_raw", "costmap_updates", "published_footprint"],
    subscribe=["/map", "/scan", "/tf", "/tf_static", "footprint"],
    reply=["clear_entirely_global_costmap", "get_costmap"],
)

SYSTEMS: dict[str, dict[str, Nodes]] = {
    "talker_listener": {
        "/talker_listener/talker": [node("talker", publish=["chatter"])],
        "/talker_listener/listener": [node("listener", subscribe=["chatter"])],
    },
    "add_two_ints": {
        "/add_two_ints/server": [node("add_two_ints_server", reply=["add_two_ints"])],
        "/add_two_ints/client": [node("add_two_ints_client", request=["add_two_ints"])],
    },
    "fibonacci": {
        "/fibonacci/server": [node("fibonacci_action_server", execute=["fibonacci"])],
        "/fibonacci/client": [node("fibonacci_action_client", call=["fibonacci"])],
    },
    "composition": {
        "/composition": [
            node("ComponentManager", reply=[f"~/_container/{name}" for name in CONTAINER]),
            node("talker", publish=["chatter"]),
            node("listener", subscribe=["chatter"]),
            node("Server", reply=["add_two_ints"]),
        ],
    },
    "mobile_robot": {
        "/mobile_robot/camera": [
            node(
                "driver",
                "/front_camera",
                publish=["/diagnostics", "camera_info", "image_raw", "image_raw/compressed"],
                reply=["set_camera_info"],
            )
        ],
        "/mobile_robot/map_server": [
            node(
                "map_server",
                managed=True,
                publish=["/bond", "map"],
                subscribe=["/bond"],
                reply=["~/load_map", "~/map"],
            )
        ],
        "/mobile_robot/planner": [
            node(
                "bt_navigator",
                managed=True,
                subscribe=["/bond", "/tf", "/tf_static", "odom"],
                publish=["/bond"],
                execute=["navigate_to_pose"],
                call=["compute_path_to_pose", "follow_path"],
                request=["/global_costmap/clear_entirely_global_costmap"],
            ),
            node("bt_navigator_navigate_to_pose_rclcpp_node"),
            node(
                "transform_listener_impl_55d0c2a4b8f0", bare=True, subscribe=["/tf", "/tf_static"]
            ),
            node(
                "planner_server", managed=True, publish=["plan"], execute=["compute_path_to_pose"]
            ),
            COSTMAP,
        ],
    },
}
ENCLAVES = [(system, path) for system, processes in SYSTEMS.items() for path in processes]


# ── observing ──────────────────────────────────────────────────────────────────────────────


def observe(domain: int, processes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What the ROS graph says of every node of processes, which are started for that."""
    from tests.integration.ros_nodes import observe  # it imports rclpy, once for all that follow

    return apart(partial(observe.observe, domain, processes))


@cache
def observed(system: str) -> list[dict[str, Any]]:
    """What the ROS graph says of every node of a system, each system in a domain of its own."""
    domain = 200 + list(SYSTEMS).index(system)
    return observe(domain, SYSTEMS[system])


def observed_in(system: str, enclave: str) -> list[dict[str, Any]]:
    return [each for each in observed(system) if each["enclave"] == enclave]


def ros_endpoints(nodes: Nodes) -> set[tuple[str, str]]:
    """The (right, absolute ROS name) of these nodes."""
    rights = ("publish", "subscribe", "reply", "request", "execute", "call")
    return {(right, name) for each in nodes for right in rights for name in each[right]}


def dds_endpoints(right: str, name: str) -> set[Endpoint]:
    names = dds_names(right, name)
    return {("publish", topic) for topic in names.publish} | {
        ("subscribe", topic) for topic in names.subscribe
    }


def all_dds_endpoints(nodes: Nodes) -> set[Endpoint]:
    """What these nodes write and read, translated; and what every participant does."""
    found = {("publish", ROS_DISCOVERY_TOPIC), ("subscribe", ROS_DISCOVERY_TOPIC)}
    for right, name in ros_endpoints(nodes):
        found |= dds_endpoints(right, name)
    return found


# ── deciding ───────────────────────────────────────────────────────────────────────────────


def uncovered(enclave: Enclave, endpoints: Iterable[Endpoint]) -> set[Endpoint]:
    """The endpoints that the permissions of ``enclave`` do not allow.

    As every vendor does it, the first rule with a matching topic decides.
    """
    moment = datetime(2024, 1, 1, tzinfo=UTC)
    permissions = permissions_for(
        enclave,
        subject=f"CN={enclave.path}",
        validity=Window(moment, moment + timedelta(days=1)),
        domains=DOMAINS,
    )
    (only,) = permissions.grants
    rules = [
        (rule.allow, direction, topic)
        for rule in only.rules
        for direction, found in (("publish", rule.publish), ("subscribe", rule.subscribe))
        for each in found
        for topic in each.topics
    ]
    return {
        (direction, topic)
        for direction, topic in endpoints
        if not next((a for a, d, t in rules if d == direction and fnmatchcase(topic, t)), False)
    }


@cache
def policy_of(system: str) -> Policy:
    return read_policy(policies_dir() / f"{system}.xml")


def enclave_of(system: str, path: str) -> Enclave:
    enclave = policy_of(system).enclave(path)
    assert enclave is not None
    return enclave


def without(enclave: Enclave, right: str, name: str) -> Enclave:
    """The enclave with every name gone by which it has that right on that absolute name."""
    return replace(
        enclave,
        profiles=tuple(
            block._replace(profiles=tuple(poorer(each, right, name) for each in block.profiles))
            for block in enclave.profiles
        ),
    )


def poorer(profile: Profile, right: str, name: str) -> Profile:
    groups: list[Group] = []
    for group in profile.groups:
        gone = tuple(
            each
            for each in group.names
            if right in dict(group.rights)
            and fnmatchcase(name, expand(each, profile.ns, profile.node))
        )
        # The other right of the group must not go with it.
        others = tuple(pair for pair in group.rights if pair[0] != right)
        kept = tuple(each for each in group.names if each not in gone)
        split = (replace(group, names=kept), replace(group, names=gone, rights=others))
        groups += [each for each in split if each.names and each.rights]
    return replace(profile, groups=tuple(groups))


# ── the graph and the policy ───────────────────────────────────────────────────────────────


@needs_rclpy
@pytest.mark.parametrize("system", some([*SYSTEMS], 3))
def test_every_node_is_seen_and_is_what_the_policy_says(system: str) -> None:
    expected = {
        (path, each["ns"], each["name"])
        for path, nodes in SYSTEMS[system].items()
        for each in nodes
    }
    assert {(each["enclave"], each["ns"], each["name"]) for each in observed(system)} == expected
    for path in SYSTEMS[system]:
        profiles = {(p.ns, p.node) for p in enclave_of(system, path).all_profiles()}
        for each in observed_in(system, path):
            listener = each["name"].startswith("transform_listener_impl_")
            assert listener or (each["ns"], each["name"]) in profiles


@needs_rclpy
@pytest.mark.parametrize("system", SYSTEMS)
def test_names_are_translated_as_ros_does(system: str) -> None:
    for each in observed(system):
        raw = {(way, topic) for way in ("publish", "subscribe") for topic in each["raw"][way]}
        translated = all_dds_endpoints([each])
        assert {pair for pair in translated if pair[1] != ROS_DISCOVERY_TOPIC} == raw


@needs_rclpy
@pytest.mark.parametrize(("system", "path"), ENCLAVES)
def test_the_policy_covers_every_endpoint(system: str, path: str) -> None:
    endpoints = all_dds_endpoints(observed_in(system, path))
    assert len(endpoints) > 15
    assert uncovered(enclave_of(system, path), endpoints) == set()


@needs_rclpy
@pytest.mark.parametrize(("system", "path"), ENCLAVES)
def test_one_name_less_uncovers_exactly_that_endpoint(system: str, path: str) -> None:
    nodes = observed_in(system, path)
    endpoints = all_dds_endpoints(nodes)
    for right, name in ros_endpoints(nodes):
        lacking = without(enclave_of(system, path), right, name)
        assert uncovered(lacking, endpoints) == dds_endpoints(right, name), (right, name)


def as_private(seen: dict[str, Any]) -> set[tuple[str, str]]:
    """The endpoints of a node, with ~/ for what is its own."""
    own = expand("~/", seen["ns"], seen["name"])
    return {(right, name.replace(own, "~/", 1)) for right, name in ros_endpoints([seen])}


@needs_rclpy
def test_the_common_part_is_what_all_nodes_have_in_common() -> None:
    nodes = [each for system in SYSTEMS for each in observed(system)]
    ordinary = [each for each in nodes if not each["name"].startswith("transform_listener")]
    shared = set.intersection(*(as_private(each) for each in ordinary))
    helper = enclave_of("mobile_robot", "/mobile_robot/planner").all_profiles()[1]
    included = {
        (right, name)
        for group in helper.groups
        for right, _ in group.rights
        for name in group.names
    }
    # The last one is what a node of rclcpp has more than a node of rclpy.
    assert included == shared | {("subscribe", "/parameter_events")}


# ── Cyclone DDS and the policy ─────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore with the enclaves of every example, closed but for what they allow."""
    root = tmp_path_factory.mktemp("policies") / "keystore"
    result = generate_artifacts(
        root,
        policies=[policy_of(system) for system in SYSTEMS],
        now=datetime.now(UTC),
        create=load_template("production"),
        domains=DOMAINS,
    )
    assert result.notes == (), "what the examples say, all vendors must take alike"
    return root


def refused_by_cyclone(keystore: Path, path: str, endpoints: Iterable[Endpoint]) -> set[Endpoint]:
    return set(refusals(enclave_path(keystore, path), CYCLONE_DOMAIN, endpoints))


STRANGERS = {
    (direction, topic)
    for direction in ("publish", "subscribe")
    for topic in ("rt/not_in_the_policy", "rq/not_in_the_policyRequest", "chatter")
}


@needs_rclpy
@pytest.mark.parametrize(("system", "path"), some(ENCLAVES, 4))
def test_cyclone_creates_what_the_node_has_and_nothing_else(
    keystore: Path, system: str, path: str
) -> None:
    endpoints = all_dds_endpoints(observed_in(system, path))
    assert refused_by_cyclone(keystore, path, endpoints | STRANGERS) == STRANGERS


def literal_endpoints(enclave: Enclave) -> set[Endpoint]:
    """Everything that an enclave may do by names without wildcards."""
    found: set[Endpoint] = set()
    for profile in enclave.all_profiles():
        for group in profile.groups:
            for right, qualifier in group.rights:
                for name in group.names:
                    if qualifier == "ALLOW" and not set("*?") & set(name):
                        found |= dds_endpoints(right, expand(name, profile.ns, profile.node))
    return found


@pytest.mark.parametrize(
    ("system", "path"),
    some([(system, each.path) for system in SYSTEMS for each in policy_of(system).enclaves], 6),
)
def test_every_right_of_the_policy_holds_on_cyclone(keystore: Path, system: str, path: str) -> None:
    enclave = enclave_of(system, path)
    rights = literal_endpoints(enclave)
    opposite = {
        ({"publish": "subscribe", "subscribe": "publish"}[direction], topic)
        for direction, topic in rights
    }
    wrong_way = uncovered(enclave, opposite - rights)
    assert wrong_way
    assert refused_by_cyclone(keystore, path, rights | wrong_way) == wrong_way


@pytest.mark.parametrize(
    ("path", "allowed", "refused"),
    [
        (
            "/mobile_robot/recorder",
            {
                ("subscribe", "rt/scan"),
                ("subscribe", "rt/global_costmap/costmap"),
                ("subscribe", "rt/navigate_to_pose/_action/feedback"),
                ("publish", "rr/rosbag2_recorder/pauseReply"),
            },
            {
                ("subscribe", "rt/front_camera/image_raw"),
                ("subscribe", "rt/front_camera/image_raw/compressed"),
                ("publish", "rt/scan"),
                ("publish", "rr/map_server/load_mapReply"),
            },
        ),
        (
            "/mobile_robot/camera",
            {
                ("publish", "rt/front_camera/image_raw"),
                ("publish", "rt/front_camera/image_raw/compressed"),
            },
            {("publish", "rt/rear_camera/image_raw"), ("publish", "rt/cmd_vel")},
        ),
        (
            "/mobile_robot/monitor",
            {
                ("publish", "rq/amcl/get_parametersRequest"),
                ("subscribe", "rr/front_camera/driver/get_parametersReply"),
            },
            {
                ("publish", "rq/amcl/set_parametersRequest"),
                ("publish", "rq/amcl/change_stateRequest"),
                ("publish", "rt/cmd_vel"),
            },
        ),
        (
            "/mobile_robot/planner",
            {
                ("publish", "rr/transform_listener_impl_7f00/get_type_descriptionReply"),
                ("publish", "rq/follow_path/_action/send_goalRequest"),
            },
            {
                ("publish", "rt/cmd_vel"),
                ("publish", "rt/cmd_vel_nav"),
                ("publish", "rt/cmd_vel_teleop"),
            },
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wildcards_and_denials_on_cyclone(
    keystore: Path, path: str, allowed: set[Endpoint], refused: set[Endpoint]
) -> None:
    assert refused_by_cyclone(keystore, path, allowed | refused) == refused
