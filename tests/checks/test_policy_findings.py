"""Each finding about policies comes about where it should, at its line, and not in its twin."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.checks.kind import WARNING, Finding
from sros_tool.checks.policies.policy import policy_file_findings, signed_findings
from sros_tool.files import policies_dir
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.policy.document import read_policy
from tests.checks.policy_cases import (
    BASICS,
    CASES,
    EVENTS,
    LOG,
    OTHER,
    PARAMETERS,
    TYPES,
    Case,
    deny,
    services,
    topics,
)
from tests.support.harness import sros, with_includes

FOUND_OTHERWISE = {
    "policy.malformed",
    "policy.duplicate-enclave",
    "policy.enclave-in-two-files",
    "policy.node-in-two-enclaves",
    "policy.node-misspelt",
    "policy.several-servers",
    "policy.include-fallback",
    "policy.redundant-include",
    "portable.enclave-names",
    "policy.root-enclave",
    "policy.unknown-group",
    "policy.robot-written-out",
    "policy.shared-namespace",
    "policy.not-on-zenoh",
}
"""These are about more than the content of one profile; they have tests of their own here."""
HEAD = 3


def policy(*enclaves: str) -> str:
    return f'<policy version="0.2.0"><enclaves>\n{"".join(enclaves)}</enclaves></policy>'


def enclave(content: str, path: str = "/a", ns: str = "/", *, basics: bool = True) -> str:
    shared = BASICS if basics else ""
    return (
        f'<enclave path="{path}"><profiles>\n<profile ns="{ns}" node="n">\n{content}\n{shared}'
        "</profile></profiles></enclave>\n"
    )


def findings(folder: Path, text: str) -> list[Finding]:
    file = folder / "policy.xml"
    file.write_text(text)
    return list(policy_file_findings(file))


def ids(folder: Path, text: str) -> set[str]:
    return {each.id for each in findings(folder, text)}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_found_and_not_found(case: Case, tmp_path: Path) -> None:
    bad = findings(tmp_path, policy(enclave(case.bad, ns=case.ns, basics=case.basics)))
    (found, *_) = [each for each in bad if each.id == case.id]
    assert found.file == str(tmp_path / "policy.xml")
    assert found.subject == "/a"
    if case.line is not None:
        assert found.line == HEAD + case.line
    good = policy(enclave(case.good, ns=case.ns, basics=case.basics))
    assert case.id not in ids(tmp_path, good)


def test_a_name_that_is_too_long(tmp_path: Path) -> None:
    for length, found in ((247, False), (248, True)):
        text = policy(enclave(topics("publish", "/" + "x" * (length - 1))))
        assert ("policy.name-never-matches" in ids(tmp_path, text)) == found


@pytest.mark.parametrize(
    ("name", "advised"), [("cmd_vel", True), ("/cmd_vel", False), ("~/x", False)]
)
def test_a_relative_denial_is_of_one_namespace(name: str, advised: bool, tmp_path: Path) -> None:
    found = findings(tmp_path, policy(enclave(deny("publish", name))))
    (remedy,) = [each.remedy for each in found if each.id == "policy.deny-without-effect"]
    assert ("Write /*cmd_vel to deny the name in every namespace" in remedy) is advised


def test_a_denial_reaches_the_other_nodes_of_the_process(tmp_path: Path) -> None:
    other = f'</profile><profile ns="/" node="m">{BASICS}{deny("publish", "/rosout")}'
    (found, *_) = [
        each for each in findings(tmp_path, policy(enclave(other))) if each.id == "policy.no-rosout"
    ]
    assert "node /n may not publish /rosout" in found.text


@pytest.mark.parametrize("kind", ["publish", "subscribe"])
def test_hidden_nodes_are_tools_and_need_nothing(kind: str, tmp_path: Path) -> None:
    text = policy(enclave(topics(kind, "/x/a"), basics=False))
    assert "policy.no-rosout" in ids(tmp_path, text)
    hidden = text.replace('node="n"', 'node="_n"')
    assert not [
        each
        for each in ids(tmp_path, hidden)
        if each.startswith("policy.no-") and each != "policy.no-counterpart"
    ]


def test_listeners_of_transforms_have_no_parameters(tmp_path: Path) -> None:
    text = policy(enclave(topics("publish", "/rosout") + services("reply", TYPES), basics=False))
    assert "policy.no-parameter-events" in ids(tmp_path, text)
    listener = text.replace('node="n"', 'node="transform_listener_impl_*"')
    assert ids(tmp_path, listener) == set()


@pytest.mark.parametrize(
    ("words", "named", "found"),
    [
        ((), None, True),
        ((), "humble", False),
        ((), "jazzy", True),
        (("--distro", "humble"), "jazzy", False),
        (("--distro", "iron"), "humble", True),
    ],
)
def test_type_descriptions_are_of_iron_and_later(
    words: tuple[str, ...], named: str | None, found: bool, tmp_path: Path
) -> None:
    file = tmp_path / "robot.xml"
    content = f"{LOG}{EVENTS}{services('reply', *PARAMETERS)}"
    file.write_text(policy(enclave(content, basics=False)))
    ended = sros("check", "policy", file, *words, env={"ROS_DISTRO": named})
    assert ("policy.no-type-description" in ended.out) is found
    assert ended.status == int(found)
    assert sros("check", "policy", file, "--distro", "humbel").status == 2


def test_parts_of_one_action_are_one_finding(tmp_path: Path) -> None:
    parts = (f"dock/_action/{part}" for part in ("send_goal", "get_result", "cancel_goal"))
    (file := tmp_path / "robot.xml").write_text(policy(enclave(services("reply", *parts))))
    found = sros("check", file).out
    assert found.count("[policy.action-in-part]") == 1
    assert "and 1 more are allowed, but not everything needed to execute /dock\n" in found
    assert 'Write <actions execute="ALLOW"> with' in found


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), ""),
        (("--vendor", "zenoh"), "checked for Zenoh\n"),
        (("--all-distros",), "checked for ROS 2 Humble, Jazzy, Kilted and Lyrical\n"),
        (("--distro", "humble"), "checked for ROS 2 Humble\n"),
        (
            ("--distro", "iron"),
            "checked for ROS 2 Iron, which is assumed to be like Jazzy\n",
        ),
        (
            ("--distro", "humble", "--vendor", "fastdds"),
            "checked for Fast DDS 2.6, ROS 2 Humble\n",
        ),
    ],
)
def test_options_that_choose_a_dds_are_repeated(
    words: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    (file := tmp_path / "robot.xml").write_text(policy(enclave("")))
    assert sros("check", file, *words).ok().err == f"{said}nothing found\n"


def test_a_node_that_lacks_everything_lacks_its_parameters_too(tmp_path: Path) -> None:
    found = ids(tmp_path, policy(enclave(topics("publish", "a"), basics=False)))
    assert "policy.no-parameter-services" in found
    assert "policy.without-parameters" not in found


def test_wildcards_give_what_a_node_needs(tmp_path: Path) -> None:
    every = topics("publish", "/*") + services("reply", "/*")
    assert "policy.no-rosout" not in ids(tmp_path, policy(enclave(every, basics=False)))
    wide = policy(enclave(topics("publish", "/cam*", "/*/a*")))
    said = {each.text for each in findings(tmp_path, wide) if each.id == "policy.wide-wildcard"}
    assert said == {
        "publish topic /cam* has a wildcard in the only part of the name",
        "publish topic /*/a* has a wildcard in the first part and in the last part of the name",
    }


NARROW, WIDE = topics("publish", "/x/a"), topics("publish", "/x/*")


@pytest.mark.parametrize(
    ("enclaves", "text"),
    [
        ({"/": [WIDE], "/b": [NARROW]}, "/ has all rights of /b"),
        ({"/": [NARROW, ""]}, "/ has the rights of 2 nodes"),
        ({"/": [NARROW], "/b": [WIDE]}, "/ has the rights of the node /n"),
        ({"/": [""]}, ""),  # rights that every node needs
        ({"/": [""], "/b": [WIDE]}, ""),
        ({"/": [NARROW], "/b": [""]}, "/ has the rights of the node /n"),
        ({"/": [WIDE, deny("publish", "/x/a")], "/b": [NARROW]}, "/ has the rights of 2 nodes"),
        ({"/": [NARROW]}, "/ has the rights of the node /n"),
        ({"/a": [WIDE], "/b": [NARROW]}, ""),
    ],
)
def test_an_enclave_with_everybodys_rights(
    enclaves: dict[str, list[str]], text: str, tmp_path: Path
) -> None:
    def profiles(contents: list[str]) -> str:
        (first, *rest) = contents
        more = (f'</profile>\n<profile ns="/" node="m">{BASICS}{each}' for each in rest)
        return "".join((first, *more))

    written = policy(*(enclave(profiles(found), path) for path, found in enclaves.items()))
    found = [each for each in findings(tmp_path, written) if each.id == "policy.root-enclave"]
    assert [each.text for each in found] == ([text] if text else [])


@pytest.mark.parametrize(("node", "reported"), [("n", True), ("_ros2cli_*", False), ("*", False)])
def test_tools_and_any_node_may_run_in_the_root_enclave(
    node: str, reported: bool, tmp_path: Path
) -> None:
    text = policy(enclave(NARROW, "/")).replace('node="n"', f'node="{node}"')
    assert ("policy.root-enclave" in ids(tmp_path, text)) == reported


def test_enclave_names(tmp_path: Path) -> None:
    text = policy(enclave("", "/robot"), enclave("", "/robot/admin"))
    assert "portable.enclave-names" in ids(tmp_path, text)
    twin = text.replace("/robot/admin", "/robot_admin")
    assert "portable.enclave-names" not in ids(tmp_path, twin)


def test_a_wildcard_for_nodes_that_matches_a_node_of_another_enclave(tmp_path: Path) -> None:
    own = enclave("").replace('node="n"', 'node="bas?"')
    other = enclave("", "/b").replace('node="n"', 'node="base"')
    posing = {each.text for each in findings(tmp_path, policy(own, other)) if "pose" in each.text}
    assert "may serve /bas?/set_parameters, and so pose as the node /base of /b" in str(posing)
    assert len(posing) == len(PARAMETERS)
    assert "policy.other-nodes-parameters" not in ids(tmp_path, policy(own, enclave("", "/b")))


def test_a_wildcard_poses_as_each_node_that_it_matches(tmp_path: Path) -> None:
    """Whether a name is written out, or matched, a request to set parameters arrives."""
    planner = enclave("", "/p").replace('ns="/" node="n"', 'ns="/left" node="planner"')
    (tmp_path / "other.xml").write_text(policy(planner))
    kept = services("reply", "/left/planner/*", qualifier="DENY")
    for reply, poses in {
        services("reply", "planner/set_parameters"): True,
        services("reply", "planner/*"): True,
        services("reply", "*"): True,
        services("reply", "*") + kept: False,
        services("reply", "~/*"): False,
        services("reply", "plan/*"): False,
    }.items():
        own = enclave(reply, ns="/left")
        for other in ([planner], []):
            (tmp_path / "policy.xml").write_text(policy(own, *other))
            files = ["policy.xml"] if other else ["policy.xml", "other.xml"]
            found = policy_file_findings(*(tmp_path / file for file in files))
            posing = [each for each in found if each.id == "policy.other-nodes-parameters"]
            assert bool(posing) == poses, (reply, files)


def test_a_node_in_two_enclaves(tmp_path: Path) -> None:
    twice = policy(enclave(""), enclave("", "/b"), enclave("", "/c"))
    (found,) = findings(tmp_path, twice)
    assert (found.id, found.line) == ("policy.node-in-two-enclaves", HEAD + 4)
    assert found.text == "the node /n is in /a, /b, /c"
    assert ids(tmp_path, policy(enclave(""), enclave("", "/b", ns="/b"))) == set()
    tools = twice.replace('node="n"', 'node="_ros2cli_*"')
    assert ids(tmp_path, tools) == set()

    robots = [Robot(f"r{domain}", "/", domain, groups=(f"g{domain}",)) for domain in (1, 2)]
    text = policy(*(enclave("", f"/{{robot:g{domain}}}/n") for domain in (1, 2)))
    (tmp_path / "policy.xml").write_text(text)
    assert not [*policy_file_findings(tmp_path / "policy.xml", fleet=Fleet.of(robots))]
    of_fleet = FleetPolicy(
        read_policy(tmp_path / "policy.xml", placeholders=True), Fleet.of(robots)
    )
    assert not signed_findings([of_fleet], [*of_fleet])


def test_whoever_signs_knows_whether_the_name_is_the_whole_subject(tmp_path: Path) -> None:
    """With unique subjects, Cyclone DDS mistakes no enclave for another one."""
    (tmp_path / "p.xml").write_text(policy(enclave("", "/panel"), enclave("", "/x/panel", ns="/x")))
    for template, expected in (("production", 0), ("sros2", 1)):
        words = ("generate_artifacts", "-k", template, "-p", "p.xml", "--template", template)
        said = sros(*words, cwd=tmp_path).ok().err
        assert said.count("portable.enclave-names") == expected, said


def test_a_node_with_nearly_the_name_of_its_enclave(tmp_path: Path) -> None:
    for path, ns, node, is_near in (
        ("/left/gripper", "/left", "griper", True),
        ("/letf/gripper", "/left", "gripper", True),
        ("/robot/griper", "/", "gripper", True),
        ("/left/gripper", "/left", "gripper", False),
        ("/left_gripper", "/left", "gripper", False),
        ("/camera1", "/", "camera2", False),
        ("/arm/gripper", "/left", "gripper", False),
    ):
        text = policy(enclave("", path, ns).replace('node="n"', f'node="{node}"'))
        assert ("policy.node-misspelt" in ids(tmp_path, text)) == is_near, (path, ns, node)
    both = enclave(OTHER, "/gripper").replace('"n"', '"griper"').replace('"m"', '"gripper"')
    assert "policy.node-misspelt" not in ids(tmp_path, policy(both))


def test_malformed(tmp_path: Path) -> None:
    good = policy(enclave(topics("publish", "a")))
    assert ids(tmp_path, good) == set()
    (found,) = findings(tmp_path, good.replace("<topic>a<", "<topic>a b<"))
    assert (found.id, found.line) == ("policy.malformed", HEAD + 1)
    assert "white space" in found.text
    assert ids(tmp_path, "<policy") == {"policy.malformed"}
    assert ids(tmp_path, "") == {"policy.malformed"}


def test_duplicate_enclaves(tmp_path: Path) -> None:
    twice = policy(enclave(""), enclave(topics("publish", "x")))
    found = findings(tmp_path, twice)
    assert [(each.id, each.line) for each in found] == [("policy.duplicate-enclave", 6)]
    assert ids(tmp_path, policy(enclave(""), enclave("", "/b", ns="/b"))) == set()
    one, other = tmp_path / "policy.xml", tmp_path / "other.xml"
    other.write_text(policy(enclave("", "/c"), enclave("")))
    (second,) = (each for each in policy_file_findings(one, other) if "two-files" in each.id)
    assert (second.file, second.line) == (str(other), 6)
    assert second.text == f"/a is defined here and at {one}:{HEAD - 1}"


INCLUDE = '<xi:include href="{}" xpointer="xpointer(/profile/*)">{}</xi:include>'


def test_includes(tmp_path: Path) -> None:
    (tmp_path / "inner.xml").write_text(f"<profile>{topics('publish', 'x')}</profile>")
    outer = f"<profile>{INCLUDE.format('inner.xml', '')}</profile>"
    (tmp_path / "outer.xml").write_text(
        with_includes(outer).replace(
            "<profile>", '<profile xmlns:xi="http://www.w3.org/2001/XInclude">'
        )
    )

    def of(*includes: str) -> set[str]:
        return ids(tmp_path, with_includes(policy(enclave("".join(includes)))))

    inner, outer = INCLUDE.format("inner.xml", ""), INCLUDE.format("outer.xml", "")
    assert of(inner) == set()
    assert of(outer) == set()
    assert of(inner, outer) == {"policy.redundant-include"}
    assert of(inner, inner) == {"policy.redundant-include"}
    gone = f"<xi:fallback>{topics('publish', 'y')}</xi:fallback>"
    assert of(INCLUDE.format("gone.xml", gone)) == {"policy.include-fallback"}
    assert of(INCLUDE.format("inner.xml", gone)) == set()
    missing = ids(tmp_path, with_includes(policy(enclave(INCLUDE.format("gone.xml", "")))))
    assert missing == {"policy.malformed"}


def test_an_old_common_part_can_be_left_out(tmp_path: Path) -> None:
    """A profile of an earlier sros2 has one, and gets common/node.xml by the advised command."""
    (tmp_path / "old.xml").write_text(f"<profile>{topics('publish', 'rosout')}</profile>")
    include = '<xi:include href="old.xml" xpointer="xpointer(/profile/*)"/>'
    for content, left_out in ((include, True), (topics("publish", "rosout"), False)):
        found = findings(tmp_path, with_includes(policy(enclave(content, ns="/arm"))))
        (finding,) = [each for each in found if each.id == "policy.relative-global-name"]
        assert ("remove the include of this file" in finding.remedy) == left_out


def test_a_broken_tag_is_found_at_its_line(tmp_path: Path) -> None:
    text = policy(enclave(topics("publish", "x"))).replace("</profile>", "</profil>")
    (found,) = findings(tmp_path, text)
    assert (found.id, found.line) == (
        "policy.malformed",
        1 + text[: text.index("</profil>")].count("\n"),
    )
    assert "<string>" not in found.text


WIDE_ON_PURPOSE = {
    "operator_configure": {"policy.sets-all-parameters"},
    "operator_drive": {"policy.sets-all-parameters", "policy.everything"},
}
"""What is found in the wide steps of a person's enclaves, which are no better than others."""


@pytest.mark.parametrize(
    "path",
    [
        each
        for each in sorted(policies_dir().rglob("*.xml"))
        if "<policy" in each.read_text() and each.stem != "everything"
    ],
    ids=lambda path: path.stem,
)
def test_nothing_in_the_policies_of_sros(path: Path) -> None:
    found = {each.id for each in policy_file_findings(path) if each.severity >= WARNING}
    assert found == WIDE_ON_PURPOSE.get(path.stem, set())


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (("/hall", None), "the namespace of a, /hall/r1, is inside /hall, the namespace of b"),
        (("/hall/r1", None), "a and b have the namespace /hall/r1"),
        (
            ("/hall/r1/arm", None),
            "the namespace of b, /hall/r1/arm, is inside /hall/r1, the namespace of a",
        ),
        (
            ("/hall/r1/arm", 7),
            "the namespace of b, /hall/r1/arm, is inside /hall/r1, the namespace of a",
        ),
        (("/hall/r1/arm", 8), ""),
        (("/hall/r10", 7), ""),
        (("/", 7), ""),
    ],
)
def test_robots_that_share_a_namespace(
    settings: tuple[str, int | None], text: str, tmp_path: Path
) -> None:
    fleet = Fleet.of([Robot("a", "/hall/r1", 7), Robot("b", *settings)])
    file = tmp_path / "policy.xml"
    file.write_text(policy(enclave(topics("publish", "/x/a"))))
    found = [each.text for each in policy_file_findings(file, fleet=fleet)]
    shared = [each for each in found if "namespace" in each]
    assert shared == ([text] if text else [])


@pytest.mark.parametrize(
    ("nodes", "groups", "is_found"),
    [
        (("base", "camera"), ("r1", "r1"), False),
        (("base", "base"), ("r1", "r1"), True),  # rather a copied robot
        (("base", "camera"), ("r1", "r2"), True),  # nobody says that they are of one robot
    ],
)
def test_computers_of_one_robot_share_its_namespace(
    nodes: tuple[str, str], groups: tuple[str, str], is_found: bool, tmp_path: Path
) -> None:
    fleet = Fleet.of(
        [
            Robot("a", "/r1", groups=(groups[0], "x")),
            Robot("b", "/r1", groups=(groups[1], "y")),
            Robot("c", "/r3", groups=("x",)),
            Robot("d", "/r4", groups=("y",)),
        ]
    )
    enclaves = [
        enclave("", f"/{{robot:{group}}}", "{namespace}").replace('node="n"', f'node="{node}"')
        for group, node in zip("xy", nodes, strict=True)
    ]
    file = tmp_path / "policy.xml"
    file.write_text(policy(*enclaves))
    found = {each.id for each in policy_file_findings(file, fleet=fleet)}
    assert ("policy.shared-namespace" in found) == is_found


def test_what_zenoh_cannot_express_is_found_where_zenoh_is_named(tmp_path: Path) -> None:
    text = policy(enclave(topics("publish", "/x*") + deny("publish", "/x*y*")))
    assert "policy.not-on-zenoh" not in ids(tmp_path, text)
    file = tmp_path / "policy.xml"
    found = {each.id: each for each in policy_file_findings(file, on_zenoh=True)}
    assert "DENY publish /x*y* cannot be expressed" in found["policy.not-on-zenoh"].text


def test_a_misspelled_group_is_found(tmp_path: Path) -> None:
    fleet, file = tmp_path / "fleet.toml", tmp_path / "policy.xml"
    carts = enclave("", "/{robot:carts}/base", "{namespace}")
    file.write_text(policy(carts))
    fleet.write_text(
        '[robots]\nh1 = { groups = ["carts"] }\nh2 = { groups = ["cart"] }\nh3 = {}\n'
        'w1 = { groups = ["windows"] }\nc2 = { groups = ["carts", "carst"] }\n'
        'n1 = { groups = ["carts2"] }\n'
    )
    words = ("check", file, "--fleet", fleet, "--include", "policy.unknown-group")
    said = sros(*words).out
    c2, h2 = "c2 (group carst: perhaps carts)", "h2 (group cart: perhaps carts)"
    assert f"no enclave is for {c2}, {h2}, h3 (in no group)\n" in said
    file.write_text(policy(carts, enclave("", "/h3/look", "/")))
    text = "/h3/look is no enclave of the robot h3: write /{robot}/look"
    assert text in sros("check", file, "--fleet", fleet).out
    file.write_text(policy(carts, enclave("", "/{robot}/all", "{namespace}")))
    assert f"no enclave is for {c2}, {h2}\n" in sros(*words).out
