"""Permissions with which ROS 2 nodes cannot start, or that allow them nothing."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.keystores.topic_names import ros_name_problem
from sros_tool.checks.kind import NOTE, Finding
from sros_tool.dds.decision.vendors import TESTED, Vendor
from sros_tool.keystore.reader import OpenedKeystore
from tests.checks.bench import Bench, name_of
from tests.checks.keystore_cases import (
    ALLOW,
    DENY_ALL,
    LEFT,
    SECOND,
    names_in_capitals,
    names_of_dds,
)

pytest_plugins = ["tests.checks.sound_keystore"]

NO_NODE = "enclave.node-cannot-start"
EVERYTHING = "or publish /parameter_events or publish /rosout or offer ~/get_type_description"
DISCOVERY = "<topic>ros_discovery_info</topic>"
DENY_FIRST = (ALLOW, DENY_ALL.replace("rt/*", "*") + ALLOW)
DEFAULT_ALLOW = ("<default>DENY", "<default>ALLOW")
UNCONTROLLED = (
    ("read_access_control>true", "read_access_control>false"),
    ("write_access_control>true", "write_access_control>false"),
    ("join_access_control>true", "join_access_control>false"),
)


def found_in(bench: Bench, vendor: str = "") -> list[Finding]:
    """The findings about the changed permissions, but not that sros did not sign them."""
    found = keystore_findings(
        OpenedKeystore(bench.checked), Circumstances(bench.now, vendors=(vendor,) if vendor else ())
    )
    return [each for each in found if each.id != "keystore.not-in-ledger"]


class Row(NamedTuple):
    """``begins`` and ``ends`` are the text of the only finding, "" if nothing is found."""

    name: str
    changes: tuple[tuple[str, str], ...]
    begins: str = ""
    ends: str = ""
    vendor: str = ""
    governance: tuple[tuple[str, str], ...] = ()


STARTING = [
    Row(
        "without ros_discovery_info",
        ((DISCOVERY, "<topic>rt/own</topic>"),),
        "no node may publish or subscribe ros_discovery_info",
    ),
    Row(
        "in a partition",
        (("</topics>", f"</topics>{LEFT}"),),
        f"no node may publish or subscribe ros_discovery_info {EVERYTHING}",
        "except in partition left, which ROS 2 does not use",
    ),
    Row(
        "in the default partition",
        (("</topics>", "</topics><partitions><partition></partition></partitions>"),),
    ),
    Row(
        "all publishing denied before",
        (DENY_FIRST,),
        "no node may publish",
        "as rule 1 denies *",
    ),
    Row(
        "ros_discovery_info denied, the rest allowed by default",
        ((ALLOW, DENY_ALL.replace("rt/*", "ros_discovery_info") + ALLOW), DEFAULT_ALLOW),
        "no node may publish",
        "as rule 1 denies ros_discovery_info",
        "cyclonedds",
    ),
    Row(
        "rules that the governance does not ask for",
        (("ros_discovery_info", "rt/own"), ("rt/rosout", "rt/other")),
        governance=UNCONTROLLED,
    ),
    Row(
        "the same rules where it does",
        (("ros_discovery_info", "rt/own"), ("rt/rosout", "rt/other")),
        "no node may publish or subscribe ros_discovery_info or publish /rosout",
    ),
]


@pytest.mark.parametrize("row", STARTING, ids=lambda row: row.name)
def test_a_node_can_start_where_a_vendor_lets_it(row: Row, bench: Bench) -> None:
    bench.permissions(*row.changes)
    if row.governance:
        bench.governance(*row.governance)
    found = [each for each in found_in(bench, row.vendor) if each.id == NO_NODE]
    assert len(found) == bool(row.begins)
    for each in found:
        assert each.text.startswith(row.begins) and each.text.endswith(row.ends), each.text
    vain = {"permissions.unreachable-rule"} if row.ends else set()
    assert not {each.id for each in found_in(bench, row.vendor)} & vain


def test_only_vendors_that_let_the_enclave_in_are_named(bench: Bench) -> None:
    """Fast DDS refuses an enclave without an allow rule, Cyclone DDS goes by the default."""
    denial = ("allow_rule>", "deny_rule>")
    bench.permissions(denial, DEFAULT_ALLOW)
    texts = {
        vendor: [each.text for each in found_in(bench, vendor) if each.id == NO_NODE]
        for vendor in ("", "cyclonedds", "fastdds")
    }
    assert texts["fastdds"] == []
    (alone,), (among,) = texts["cyclonedds"], texts[""]
    assert among == f"on Cyclone DDS {alone}"


def test_a_program_of_dds_alone_is_no_error(bench: Bench) -> None:
    """Twin: a ROS name makes the same names a warning."""
    bench.sign("enclaves/base/permissions.p7s", names_of_dds)
    found = found_in(bench)
    assert [(each.id, each.severity) for each in found] == [("permissions.not-for-ros", NOTE)]
    bench.permissions(("      <default>", SECOND))
    assert {each.id for each in found_in(bench)} >= {"permissions.no-ros-name", NO_NODE}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("chatter", "write rt/chatter"),
        ("/chatter", "write rt/chatter"),
        ("rt//chatter", "write rt/chatter"),
        ("rt/chatter/", "write rt/chatter"),
        ("/robot*/chatter", "write rt/robot*/chatter"),
        ("rq/add", "write rq/addRequest"),
        ("rr/add", "write rr/addReply"),
        ("std_msgs/msg/String", "the name of a type"),
        ("rt/.*", "write rt/*"),
        ("rt/%", "write rt/*"),
        ("rt\\chatter", "write rt/chatter"),
        ("rt/{{ robot }}/chatter", "write the value in place of the placeholder"),
        ("rt/$(env ROBOT)/chatter", "write the value in place of the placeholder"),
        ("rt/~/chatter", "in place of ~"),
        ("rt/a, rt/b", "a <topic> for every name"),
        ("rt/2nd", "is not a valid ROS name"),
        ("rt//*", "no valid ROS name"),
        ("rt/café", "é"),
        ("chatter*", "write rt/chatter*"),
    ],
)
def test_a_name_that_nothing_of_ros_has(name: str, words: str) -> None:
    assert words in ros_name_problem(name)


@pytest.mark.parametrize(
    "name",
    [
        *("*", "?t/a", "rt/chatter", "rt/a/b_2", "rt/*", "rt/robot[12]/scan", "rq/addRequest"),
        *("rr/addReply", "rq/*", "rr/*Reply", "[!x]t/a", "ros_discovery_info", "ros_*", "r*"),
        *("rt/_hidden", "rq/turtle/_action/send_goalRequest", "DCPSParticipant", " rt/a\n", ""),
        "*chatter",
    ],
)
def test_a_name_that_something_of_ros_may_have(name: str) -> None:
    assert ros_name_problem(name) == ""


def test_a_denial_that_hides_several_topics_is_one_finding(bench: Bench) -> None:
    bench.permissions((ALLOW, DENY_ALL.replace("rt/*", "rr/*") + ALLOW))
    (text,) = (each.text for each in found_in(bench) if each.id == "permissions.unreachable-rule")
    assert text.startswith("rule 2 allows publish rr/base/") and text.count("rr/base/") > 1
    assert text.endswith("after a rule that denies rr/*")


def test_names_that_differ_only_in_capitals(bench: Bench) -> None:
    names_in_capitals(bench)
    texts = [each.text for each in found_in(bench) if each.id == "permissions.only-capitals-differ"]
    assert texts == ["rt/status (in /arm) and rt/Status (in /base) differ only in capitals"]


def test_blanks_are_named_where_they_count(bench: Bench) -> None:
    bench.permissions(("rt/status<", "\n  rt/status\n<"))
    (found,) = found_in(bench)
    assert (found.id, found.text) == (
        "portable.blanks",
        "there are spaces or line ends around rt/status",
    )
    assert "cyclonedds" not in found.kind.vendors


@pytest.mark.parametrize("vendor", ["", "fastdds", "fastdds-2.9"])
def test_a_default_before_the_rules_is_one_finding(vendor: str, bench: Bench) -> None:
    default = "      <default>DENY</default>\n"
    bench.permissions((default, ""), (ALLOW, default + ALLOW))
    found = {each.id for each in found_in(bench, vendor)}
    assert found == {"portable.default-first"}


def test_a_rule_for_another_name_does_not_undo_everything(bench: Bench) -> None:
    """Twin: a denial after the rule that allows everything changes nothing."""
    everything = (DISCOVERY, "<topic>*</topic>")
    stop = DENY_ALL.replace("rt/*", "rt/stop")
    bench.permissions(everything, (ALLOW, stop + ALLOW))
    found = {each.id: each.text for each in found_in(bench)}
    assert "keystore.allow-everything" not in found
    assert found["keystore.only-denials"].endswith("every topic but rt/stop")
    bench.issue(subject=name_of(("CN", "/base"), ("OU", "1f")))
    bench.permissions((stop, ""), ("      <default>", stop + "      <default>"))
    found = {each.id: each.text for each in found_in(bench)}
    assert "keystore.only-denials" not in found and "keystore.allow-everything" in found


OPEN = "on {} anybody can read and write *"
UNPROTECTED = (
    ("metadata_protection_kind>ENCRYPT", "metadata_protection_kind>NONE"),
    ("data_protection_kind>ENCRYPT", "data_protection_kind>NONE"),
    ("discovery_protection>true", "discovery_protection>false"),
)


@pytest.mark.parametrize(
    ("vendor", "rtps", "changes", "kind", "text"),
    [
        ("cyclonedds", "NONE", (), "unauthenticated", "on {} they reach no topic"),
        ("fastdds", "NONE", (), "unauthenticated", "on {} they reach no topic"),
        ("fastdds-2.9", "NONE", (), "unauthenticated-kept-out", "on {} they are still refused"),
        ("cyclonedds", "ENCRYPT", (), "unauthenticated-kept-out", "on {} they are kept out"),
        ("fastdds", "ENCRYPT", (), "unauthenticated", "on {} the document is refused"),
        ("cyclonedds", "NONE", UNPROTECTED, "unauthenticated", OPEN),  # heard, and forged
        ("fastdds", "NONE", UNPROTECTED, "unauthenticated", "on {} they reach no topic"),
        ("fastdds", "NONE", (*UNPROTECTED, *UNCONTROLLED), "unauthenticated", OPEN),
    ],
)
def test_strangers_are_those_of_the_vendor(
    vendor: str,
    rtps: str,
    changes: tuple[tuple[str, str], ...],
    kind: str,
    text: str,
    bench: Bench,
) -> None:
    admitted = ("participants>false", "participants>true")
    protection = ("kind>ENCRYPT</rtps", f"kind>{rtps}</rtps")
    bench.governance(admitted, protection, *changes)
    of_kind = [each for each in found_in(bench, vendor) if each.id.startswith("governance.unauth")]
    (found,) = of_kind
    assert found.id == f"governance.{kind}"
    said = text.format(Vendor(vendor).title)
    assert found.text.startswith(f"allow_unauthenticated_participants is true: {said}")
    others = {each.title for each in TESTED} - {Vendor(vendor).title}
    assert not any(each in found.text for each in others)
