"""The policies that ship with sros are readable for every tool, and mean what they say."""

from __future__ import annotations

import re
import shutil
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from lxml import etree

from sros_tool.files import policies_dir
from sros_tool.graph.learn import PARTS
from sros_tool.names import MAX_COMMON_NAME, dds_names, expand
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.model import DENY, Enclave, Group, Profile

POLICIES = policies_dir()
TOP_LEVEL = sorted(POLICIES.glob("*.xml"))
EVERY_FILE = sorted(POLICIES.rglob("*.xml"))
# What an enclave without a policy gets, by the template of its keystore.
DEFAULTS = sorted((POLICIES / "defaults").glob("*.xml"))
POLICY_FILES = TOP_LEVEL + DEFAULTS
FRAGMENTS = sorted(set(EVERY_FILE) - set(POLICY_FILES))
SCHEMA = Path(__file__).with_name("schemas") / "policy.xsd"
XI_INCLUDE = "{http://www.w3.org/2001/XInclude}include"

EVERY_NODE = {
    ("publish", "/rosout"),
    ("publish", "/parameter_events"),
    ("subscribe", "/parameter_events"),
    ("subscribe", "/clock"),
    ("reply", "~/describe_parameters"),
    ("reply", "~/get_parameter_types"),
    ("reply", "~/get_parameters"),
    ("reply", "~/get_type_description"),
    ("reply", "~/list_parameters"),
    ("reply", "~/set_parameters"),
    ("reply", "~/set_parameters_atomically"),
}


def relative(path: Path) -> str:
    return str(path.relative_to(POLICIES))


def all_enclaves() -> list[Enclave]:
    return [enclave for file in TOP_LEVEL for enclave in read_policy(file).enclaves]


ENCLAVES = {enclave.path: enclave for enclave in all_enclaves()}


def rights(profile: Profile) -> set[tuple[str, str]]:
    """The rights of a profile as (right, absolute name), without the denials."""
    return {
        (right, expand(name, profile.ns, profile.node))
        for group in profile.groups
        for right, qualifier in group.rights
        if qualifier is not DENY
        for name in group.names
    }


def holders(right: str, name: str, prefix: str = "/mobile_robot/") -> set[str]:
    """The enclaves below ``prefix`` that hold a right on exactly this name."""
    return {
        path
        for path, enclave in ENCLAVES.items()
        if path.startswith(prefix)
        for profile in enclave.all_profiles()
        if (right, name) in rights(profile)
    }


def test_the_promised_files_are_there() -> None:
    assert {relative(path) for path in TOP_LEVEL} == {
        "add_two_ints.xml",
        "composition.xml",
        "fibonacci.xml",
        "mobile_robot.xml",
        "observer.xml",
        "operator_configure.xml",
        "operator_drive.xml",
        "operator_list.xml",
        "operator_look.xml",
        "talker_listener.xml",
    }
    assert (POLICIES / "common" / "node.xml").is_file()


@pytest.mark.parametrize("path", POLICY_FILES, ids=relative)
def test_valid_for_other_tools(path: Path) -> None:
    tree = etree.parse(path)
    tree.xinclude()
    schema = etree.XMLSchema(etree.parse(SCHEMA, etree.XMLParser(no_network=True)))
    assert schema.validate(tree), schema.error_log


@pytest.mark.parametrize("path", POLICY_FILES, ids=relative)
def test_sros_and_xinclude_read_the_same(path: Path) -> None:
    tree = etree.parse(path)
    tree.xinclude()
    expected = [
        (
            enclave.get("path"),
            profile.get("ns"),
            profile.get("node"),
            [group_of(each) for each in profile.iterchildren("topics", "services", "actions")],
        )
        for enclave in tree.iter("enclave")
        for profile in enclave.iter("profile")
    ]
    found = [
        (enclave.path, profile.ns, profile.node, [plain(group) for group in profile.groups])
        for enclave in read_policy(path).enclaves
        for profile in enclave.all_profiles()
    ]
    assert found == expected


def group_of(element: etree._Element) -> tuple[str, dict[str, str], list[str]]:
    attributes = {str(name): str(value) for name, value in element.attrib.items() if name[0] != "{"}
    return str(element.tag), attributes, [each.text or "" for each in element]


def plain(group: Group) -> tuple[str, dict[str, str], list[str]]:
    rights = {right: str(qualifier) for right, qualifier in group.rights}
    return group.kind, rights, list(group.names)


@pytest.mark.parametrize("path", POLICY_FILES, ids=relative)
def test_written_back_in_one_file_it_is_the_same(path: Path, tmp_path: Path) -> None:
    flat = tmp_path / path.name
    flat.write_bytes(policy_xml(read_policy(path)))
    assert b"include" not in flat.read_bytes()
    assert read_policy(flat) == read_policy(path)


@pytest.mark.parametrize("path", EVERY_FILE, ids=relative)
def test_includes_are_relative_and_stay_inside(path: Path) -> None:
    for include in etree.parse(path).iter(XI_INCLUDE):
        assert set(include.attrib) == {"href", "xpointer"}
        href = include.get("href", "")
        target = (path.parent / href).resolve()
        assert not Path(href).is_absolute() and "://" not in href
        assert target.is_relative_to(POLICIES.resolve())
        assert target.is_file()


def test_the_example_of_the_readme(tmp_path: Path) -> None:
    text = (POLICIES / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```xml\n(.*?)```", text, re.DOTALL)
    shutil.copytree(POLICIES / "common", tmp_path / "common")
    path = tmp_path / "plant.xml"
    path.write_text(example, encoding="utf-8")
    (profile,) = read_policy(path).enclaves[0].all_profiles()
    assert {("publish", "/hall_2/speed"), ("reply", "/hall_2/conveyor/stop")} <= rights(profile)
    assert ("publish", "/rosout") in rights(profile)


def test_every_fragment_is_included_somewhere() -> None:
    included = {
        (path.parent / include.get("href", "")).resolve()
        for path in EVERY_FILE
        for include in etree.parse(path).iter(XI_INCLUDE)
    }
    # Beside those that the examples include, there are parts for policies that are learned.
    included |= {(POLICIES / part).resolve() for part in PARTS}
    assert {path.resolve() for path in FRAGMENTS} <= included


@pytest.mark.parametrize("path", FRAGMENTS, ids=relative)
def test_fragments_say_nothing_about_who_includes_them(path: Path) -> None:
    root = etree.parse(path).getroot()
    assert root.tag == "profile"
    assert not root.attrib


def test_enclave_names_are_portable() -> None:
    """Cyclone DDS compares the parts of a name as sets, and a subset is enough for it."""
    parts = {path: set(path[1:].split("/")) for path in ENCLAVES}
    assert len(ENCLAVES) == len(all_enclaves())
    for path in ENCLAVES:
        assert len(path) <= MAX_COMMON_NAME
        assert not set(path) & set(',|"')
        assert [other for other in ENCLAVES if parts[path] <= parts[other]] == [path]


def test_wildcards_are_portable() -> None:
    for enclave in ENCLAVES.values():
        for profile in enclave.all_profiles():
            for group in profile.groups:
                assert not set("[]^!") & set("".join((profile.ns, profile.node, *group.names)))


@pytest.mark.parametrize("enclave", ENCLAVES.values(), ids=lambda enclave: enclave.path)
def test_every_node_can_start(enclave: Enclave) -> None:
    for profile in enclave.all_profiles():
        if profile.node.startswith("_"):
            continue  # hidden nodes of tools start without all that
        needed = {(right, expand(name, profile.ns, profile.node)) for right, name in EVERY_NODE}
        assert needed <= rights(profile)


@pytest.mark.parametrize("path", DEFAULTS, ids=relative)
@pytest.mark.parametrize("ns", ["/", "/front_camera", "/hall_2/conveyor"])
def test_every_node_can_start_by_default(path: Path, ns: str) -> None:
    """What an enclave without a policy gets is enough for any node in any namespace."""
    (profile,) = read_policy(path).enclaves[0].all_profiles()
    allowed = rights(profile)
    for right, name in EVERY_NODE:
        wanted = expand(name, ns, "driver")
        assert [other for way, other in allowed if way == right and fnmatchcase(wanted, other)]


@pytest.mark.parametrize("enclave", ENCLAVES.values(), ids=lambda enclave: enclave.path)
def test_denials_take_away_something_and_mean_one_thing(enclave: Enclave) -> None:
    """Each denial cuts into a permission of the same right, and into nothing that is needed.

    Cyclone DDS refuses the topic itself where either direction is denied, so a name must not be
    denied in one direction and allowed in the other.
    """
    allowed: set[tuple[str, str]] = set()
    denied: set[tuple[str, str]] = set()
    for profile in enclave.all_profiles():
        for group in profile.groups:
            for right, qualifier in group.rights:
                for name in group.names:
                    names = dds_names(right, expand(name, profile.ns, profile.node))
                    found = {("publish", topic) for topic in names.publish}
                    found |= {("subscribe", topic) for topic in names.subscribe}
                    (denied if qualifier is DENY else allowed).update(found)
    for direction, topic in denied:
        covering = [way for way, other in allowed if fnmatchcase(topic, other)]
        assert set(covering) == {direction}, topic
        assert not [other for _, other in allowed if fnmatchcase(other, topic)]


def test_some_denial_is_there_to_learn_from() -> None:
    profile = ENCLAVES["/mobile_robot/recorder"].all_profiles()[0]
    groups = [plain(group) for group in profile.groups]
    assert ("topics", {"subscribe": "ALLOW"}, ["/*"]) in groups
    assert ("topics", {"subscribe": "DENY"}, ["/front_camera/*"]) in groups


def test_who_moves_the_robot() -> None:
    for topic, writers, readers in (
        ("/cmd_vel", {"velocity_mux"}, {"base", "monitor"}),
        ("/cmd_vel_nav", {"controller"}, {"velocity_mux"}),
        ("/cmd_vel_teleop", {"teleop"}, {"velocity_mux"}),
        ("/emergency_stop", {"teleop"}, {"velocity_mux", "monitor"}),
    ):
        assert holders("publish", topic) == {f"/mobile_robot/{name}" for name in writers}
        assert holders("subscribe", topic) == {f"/mobile_robot/{name}" for name in readers}


COMMANDS_EVERYTHING = {"/operator/drive"}
CONFIGURES_EVERYTHING = {"/operator/configure", *COMMANDS_EVERYTHING}
"""The last steps of a person at the robot, which no process of the robot may have."""


def test_nobody_publishes_with_a_wildcard_beyond_a_namespace_of_its_own() -> None:
    for enclave in ENCLAVES.values():
        if enclave.path in COMMANDS_EVERYTHING:
            continue
        for profile in enclave.all_profiles():
            for right, name in rights(profile):
                if right in ("publish", "reply", "execute") and set("*?") & set(name):
                    own = profile.ns != "/" and name.startswith(profile.ns + "/")
                    private = name.startswith(expand("~/", profile.ns, profile.node))
                    listener = "transform_listener_impl_" in name
                    assert own or private or listener, (enclave.path, right, name)


def test_nobody_sets_the_clock_or_the_parameters_of_others() -> None:
    for enclave in ENCLAVES.values():
        if enclave.path in CONFIGURES_EVERYTHING:
            continue
        for profile in enclave.all_profiles():
            for right, name in rights(profile):
                assert (right, name) != ("publish", "/clock")
                assert not (right == "request" and name.endswith("set_parameters"))


@pytest.mark.parametrize(
    ("server_right", "client_right"), [("reply", "request"), ("execute", "call")]
)
def test_what_is_called_is_offered(server_right: str, client_right: str) -> None:
    """A right to call what no node of the robot offers is a typing error."""
    robots = {path.split("/")[1] for path in ENCLAVES} - {"operator"}  # calls other enclaves' nodes
    for prefix in robots:
        below = [e for path, e in ENCLAVES.items() if path.split("/")[1] == prefix]
        held = [right for e in below for p in e.all_profiles() for right in rights(p)]
        offered = [name for right, name in held if right == server_right]
        for wanted in (name for right, name in held if right == client_right):
            assert [name for name in offered if fnmatchcase(name, wanted)], wanted
