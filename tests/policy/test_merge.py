"""A merge adds what was asked, in the direction in which it was asked, and denies no less."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from shlex import split
from typing import Any

import pytest
from hypothesis import given

from sros_tool.errors import UsageError
from sros_tool.graph.learn import merge_policies
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.merge import merge_all, merge_into, merge_notes, plan_merge
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    Enclave,
    Group,
    Policy,
    Profile,
    Profiles,
    policy_in_namespace,
)
from sros_tool.policy.remapping import (
    parse_remapping,
    parse_remapping_of_names,
    remapped_name,
    remapped_policies,
    remapped_policy,
)
from sros_tool.policy.rights import Right, policy_rights
from tests.policy.drawn_policies import PATHS, effective, meant, policies

OF_REQUIREMENTS = "merge.requirements-of-old-names"
OF_NAMESPACE = "merge.requirements-of-old-namespace"


def one(*groups: Group, node: str = "n") -> Policy:
    return Policy((Enclave("/a", (Profiles((Profile("/", node, groups),)),)),))


def group(kind: str, names: str, **rights: str) -> Group:
    found = tuple((right, DENY if word == "DENY" else ALLOW) for right, word in rights.items())
    return Group(kind, found, tuple(names.split()))


def merged(first: Policy, second: Policy) -> Policy:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.xml")
        path.write_bytes(policy_xml(first))
        result = merge_into(path, second)
        path.write_bytes(result.document)
        again = merge_into(path, second)
        assert not again.added
        assert again.document == result.document
        after = read_policy(path)
        assert policy_rights(after) == policy_rights(first) | set(result.added)
        assert set(result.added) <= policy_rights(second)
        return after


@given(policies(), policies())
def test_merging_is_the_union_whichever_comes_first(first: Policy, second: Policy) -> None:
    forward, backward = merged(first, second), merged(second, first)
    for path in PATHS:
        allowed = meant(first, path, allow=True) | meant(second, path, allow=True)
        denied = meant(first, path, allow=False) | meant(second, path, allow=False)
        assert effective(forward, path) == allowed - denied
        assert effective(backward, path) == allowed - denied


@given(policies())
def test_merging_with_itself_adds_nothing(policy: Policy) -> None:
    plan = plan_merge(policy, policy)
    assert plan.entries == {}
    assert plan.added == ()


@pytest.mark.parametrize(
    ("namespace", "path", "relative"), [("/left", "/left/a", "/left/x"), ("/", "/a", "/x")]
)
def test_a_policy_in_a_namespace(namespace: str, path: str, relative: str) -> None:
    moved = policy_in_namespace(one(group("topics", "x ~/y /z", publish="ALLOW")), namespace)
    assert [enclave.path for enclave in moved.enclaves] == [path]
    names = {right.name for right in policy_rights(moved)}
    assert names == {relative, f"{relative[:-1]}n/y", "/z"}


@pytest.mark.parametrize(
    ("unmoved", "paths"),
    [
        ("/b", ["/left/a", "/b"]),
        ("/left/a", ["/left/a", "/left/b"]),
        ("/c", ["/left/a", "/left/b"]),
    ],
)
def test_enclaves_that_stay_where_they_are(unmoved: str, paths: list[str]) -> None:
    both = Policy(tuple(replace(one().enclaves[0], path=path) for path in ("/a", "/b")))
    moved = policy_in_namespace(both, "/left", frozenset([unmoved]))
    assert [enclave.path for enclave in moved.enclaves] == paths


def test_no_two_enclaves_get_one_path() -> None:
    """One of them would hide the rights of the other one."""
    both = Policy(tuple(replace(one().enclaves[0], path=path) for path in ("/a", "/left/a")))
    moved = policy_in_namespace(both, "/left", frozenset(["/left/a"]))
    assert [enclave.path for enclave in moved.enclaves] == ["/left/a", "/left/left/a"]


@pytest.mark.parametrize(
    ("rules", "names"),
    [
        (["x:=/front/x"], {"/front/x", "/n/y", "/z", "/w/*"}),
        (["/x:=y", "/y:=/never"], {"/y", "/n/y", "/z", "/w/*"}),
        (["x:=/first", "x:=/later"], {"/first", "/n/y", "/z", "/w/*"}),
        (["n:~/y:=~/q"], {"/x", "/n/q", "/z", "/w/*"}),
        (["other:x:=/front/x"], None),
        (["__node:=m", "__ns:=/left", "x:=a"], {"/left/a", "/left/m/y", "/z", "/w/*"}),
        (["n:__node:=m", "n:x:=/old", "m:x:=/b"], {"/b", "/m/y", "/z", "/w/*"}),
        (["/w/a:=/b"], {"/x", "/n/y", "/z", "/w/*", "/b"}),
        (["/gone:=/b"], None),
    ],
)
def test_a_policy_whose_names_are_remapped(rules: list[str], names: set[str] | None) -> None:
    remappings = [parse_remapping(rule) for rule in rules]
    before = one(group("topics", "x ~/y /z /w/*", publish="ALLOW"))
    remapped, used = remapped_policy(before, remappings)
    if names is None:
        assert (remapped, used) == (before, set())
    else:
        assert {right.name for right in policy_rights(remapped)} == names
        assert remappings[0] in {use.rule for use in used}


@pytest.mark.parametrize(
    ("denied", "rules", "names"),
    [
        ("/*x", "n:x:=/mux/x_of_n", {"/*x", "/mux/x_of_n"}),
        ("x", "n:x:=~/speed", {"/x", "/n/speed"}),
        ("/*z", "n:x:=/mux/x_of_n", {"/*z"}),
        ("x", "x:=/other", {"/other"}),
        ("/*x", "x:=/other", {"/*x", "/other"}),
        ("/*n/y", "n:__node:=q", {"/*n/y", "/q/y"}),
        ("n/y", "n:__node:=q", {"/n/y", "/q/y"}),
        ("n/y", "__node:=q", {"/n/y", "/q/y"}),
        ("/n*", "n:__node:=q", {"/n*", "/q", "/q/*"}),
        ("/[n]/?*z", "n:__node:=q", {"/[n]/?*z", "/q/?*z"}),
        ("/*/y", "n:__node:=q", {"/*/y"}),
        ("/nn/y", "n:__node:=q", {"/nn/y"}),
        ("n/y", "n:__node:=q q:__ns:=/l", {"/n/y", "/l/q/y"}),
        ("x", "n:__ns:=/l", {"/x", "/l/x"}),
        ("x", "n:__ns:=/l n:x:=/b", {"/x", "/b"}),
        ("n/y", "n:__ns:=/l", {"/n/y", "/l/n/y"}),
        ("other", "n:__ns:=/l", {"/other"}),
        ("w/a", "n:__ns:=/l", {"/w/a", "/l/w/a"}),
    ],
)
def test_a_new_name_of_one_node_stays_denied_to_the_others(
    denied: str, rules: str, names: set[str]
) -> None:
    """Also where the rule is for one node: a DENY is a promise on what the name stands for."""
    denying = group("topics", denied, publish="DENY", subscribe="ALLOW")
    policies = [one(denying, node="m"), one(group("topics", "x w/*", publish="ALLOW"))]
    (of_m, of_n), _ = remapped_policies(policies, rules.split())
    rights = policy_rights(of_m)
    assert {right.name for right in rights if right.right == "publish"} == names
    assert all((right.qualifier is DENY) == (right.right == "publish") for right in rights)
    assert {right.qualifier for right in policy_rights(of_n)} == {ALLOW}


@pytest.mark.parametrize(
    ("allowed", "rules", "denied"),
    [
        ("/*", ["x:=/left/x"], {"/x", "/left/x"}),
        ("/*", ["__ns:=/left"], {"/x", "/left/x"}),
        ("/*", ["x:=z", "y:=x"], {"/z"}),  # the name now stands for what was y, and was allowed
        ("/x*", ["x:=z", "y:=x"], {"/x", "/z"}),  # nobody could publish y
    ],
)
def test_a_wildcard_does_not_allow_an_old_name_that_was_denied(
    allowed: str, rules: list[str], denied: set[str]
) -> None:
    """Without its DENY, the old name would be allowed, and another node's may be called so."""
    groups = (
        group("topics", allowed, publish="ALLOW"),
        group("topics", "x", publish="DENY"),
        group("services", "y", request="ALLOW"),
        group("topics", "y", subscribe="ALLOW"),
    )
    for stated in ([one(*groups)], [one(each) for each in groups]):
        remapped, _ = remapped_policies(stated, rules)
        rights = {right for policy in remapped for right in policy_rights(policy)}
        assert {right.name for right in rights if right.qualifier is DENY} == denied


@pytest.mark.parametrize(
    ("denied", "allowed", "rules", "after"),
    [
        ("~/x", "/n/x", ["n:__node:=q"], {"/n/x", "/q/x"}),
        ("~/*", "/n/x", ["n:__node:=q"], {"/n/*", "/q/*"}),
        ("x", "/x", ["n:x:=/y"], {"/x", "/y"}),
        ("~/x", "~/x", ["n:__node:=m", "m:__node:=n"], {"/m/x"}),  # /n/x is now a name of m
        ("~/*", "~/x", ["n:__node:=m", "m:__node:=n"], {"/m/*"}),
        ("x", "z", ["n:x:=y", "m:z:=x"], {"/y"}),
    ],
)
def test_an_old_name_that_another_node_uses_stays_denied(
    denied: str, allowed: str, rules: list[str], after: set[str]
) -> None:
    groups = group("topics", denied, publish="DENY"), group("topics", allowed, publish="ALLOW")
    both = [one(each, node=node) for each, node in zip(groups, "nm", strict=True)]
    rights = {r for policy in remapped_policies(both, rules)[0] for r in policy_rights(policy)}
    assert {right.name for right in rights if right.qualifier is DENY} == after


def test_a_denial_of_an_old_name_in_the_file_is_told() -> None:
    """What was merged before, such as another node of the same package, does not change."""
    file = one(group("topics", "/*x", publish="DENY"), node="m")
    camera = one(group("topics", "x", publish="ALLOW"))
    reader = one(group("topics", "x", subscribe="ALLOW"), node="reader")
    _, notes = remapped_policies([camera, reader], ["x:=/mux/speed"], file)
    assert [note.id for note in notes] == [OF_REQUIREMENTS, "merge.old-name-denied"]
    assert "/a DENY publish topic /*x at" in notes[1].text
    file_of_node = one(group("services", "/*n/open", request="DENY"), node="m")
    _, (_, note) = remapped_policies(
        [one(group("services", "~/open", reply="ALLOW"))], ["n:__node:=y"], file_of_node
    )
    assert "does not apply to /y/open, the new name of /n/open" in note.text
    for others, rule in (
        ([], "x:=/front/x"),
        ([one(group("topics", "/mux/*", publish="DENY"), node="m")], "x:=/mux/speed"),
    ):
        _, notes = remapped_policies([camera, *others], [rule], file)
        assert [note.id for note in notes] == [OF_REQUIREMENTS]


def test_names_of_an_earlier_merge_that_a_node_keeps_are_told() -> None:
    camera = one(group("topics", "x y", publish="ALLOW"))
    for names, rule, kept in (
        ("/a y", "x:=/b", "to merge: publish topic /a. If"),
        ("/a y", "x:=/a", ""),  # the same merge again
        ("/* y", "x:=/b", ""),  # nothing is added
        ("y", "x:=/b", ""),
    ):
        file = one(group("topics", names, publish="ALLOW"))
        _, notes = remapped_policies([camera], [rule], file)
        told = [note.text for note in notes if note.id == "merge.earlier-names"]
        assert len(told) == bool(kept) and all(kept in text for text in told), (names, told)


def test_a_name_of_no_single_node_is_remapped() -> None:
    for name, texts, names in (
        ("/l/a", ["a:=/b"], ["/b"]),
        ("/l/a", ["a:=a"], ["/l/a"]),
        ("/l/a", ["a:=b", "b:=/c", "/a:=/d"], ["/l/b"]),
        ("/l/*", ["a:=/b"], ["/l/*", "/b"]),
        ("*/a", ["a:=/x/a"], ["*/a", "/x/a"]),
        ("/l/n/a", ["n:__node:=m", "m:~/a:=/b"], ["/b"]),
        ("/l/n/*", ["n:__node:=m"], ["/l/m/*"]),
        ("/l/nn/a", ["n:__node:=m"], ["/l/nn/a"]),
        ("/l/a", ["n:a:=~/b"], ["/l/n/b"]),
        ("/*n/a", ["n:__node:=m"], ["/*n/a", "/l/m/a"]),
        ("/l/n*", ["n:__node:=m"], ["/l/n*", "/l/m", "/l/m/*"]),
        ("/*n/a", ["n:__node:=m", "m:~/a:=/b"], ["/*n/a", "/b"]),
        ("*/a", ["n:__node:=m"], ["*/a"]),
    ):
        assert remapped_name(name, "/l", map(parse_remapping_of_names, texts)) == names


def test_the_note_on_requirements_names_rules_that_they_take() -> None:
    driver = one(group("topics", "x ~/y z", publish="ALLOW"), node="driver")
    viewer = one(group("topics", "z", subscribe="ALLOW"), node="viewer")
    panel = one(group("topics", "driver/y", subscribe="ALLOW"), node="panel")
    for texts, options in (
        (["__node:=front"], ["driver:__node:=front"]),
        (["panel:driver/y:=front/y", "driver:__node:=front"], ["driver:__node:=front"]),
        (["panel:driver/y:=/v", "driver:~/y:=/v"], ["driver/y:=/v", "driver:~/y:=/v"]),
        (["~/y:=/v", "driver:x:=/w"], ["driver:~/y:=/v", "x:=/w"]),
        (["x:=/w", "driver:z:=/u"], ["x:=/w"]),
    ):
        others = [panel] if "panel" in texts[0] else [viewer]
        _, notes = remapped_policies([driver, *others], texts)
        (text,) = (note.text for note in notes if note.id == OF_REQUIREMENTS)
        rules = split(text.partition("FILE ")[2].partition("`")[0])[1::2]
        assert rules == options
        assert all(map(parse_remapping_of_names, rules))


@pytest.mark.parametrize(
    ("rules", "split"),
    [
        ("~/reset:=clear", "/driver/reset (reply)"),
        ("driver:~/reset:=clear", "/driver/reset (reply)"),
        ("viewer:z:=/u", "/z (subscribe)"),
        ("~/reset:=clear driver/reset:=clear", ""),
        ("viewer:driver/reset:=clear driver:~/reset:=clear", ""),
    ],
)
def test_a_name_that_only_one_side_remaps_is_noted(rules: str, split: str) -> None:
    """A requirement for the old name would hold, regardless of who uses the new name."""
    driver = one(group("services", "~/reset", reply="ALLOW"), node="driver")
    driver_of_topic = one(group("topics", "z", publish="ALLOW"), node="sensor")
    viewer = one(
        group("topics", "z", subscribe="ALLOW"),
        group("services", "driver/reset", request="ALLOW"),
        node="viewer",
    )
    _, notes = remapped_policies([driver, driver_of_topic, viewer], rules.split())
    texts = [note.text for note in notes if note.id == "merge.requirements-of-split-names"]
    starts = [text.startswith(f"the remapping leaves no right to {split}, but") for text in texts]
    assert starts == [True] * bool(split)


def test_the_note_on_requirements_names_its_package_and_who_keeps_an_old_name() -> None:
    """With another package's requirements, the options would hide who may use the old name."""
    own = group("services", "~/switch", reply="ALLOW")
    lamp = replace(one(own, group("topics", "x", publish="ALLOW"), node="lamp"), file="d/tower.xml")
    keeps = "In POLICY, /lamp keeps an old name: also check the requirements for it, without"
    for file, rules, kept in (
        (one(own, node="lamp"), "lamp:__node:=tower", True),
        (one(own, node="other"), "lamp:__node:=tower", False),
        (one(group("topics", "x", subscribe="ALLOW"), node="lamp"), "x:=/y", True),
        (one(group("topics", "x", subscribe="DENY"), node="lamp"), "x:=/y", False),
    ):
        _, notes = remapped_policies([lamp], [rules], file)
        (text,) = (note.text for note in notes if note.id == OF_REQUIREMENTS)
        assert "FILE has only the requirements of the merged package (tower.xml): check" in text
        assert (keeps in text) == kept


def test_names_that_are_exchanged_are_denied_as_before() -> None:
    both = one(group("topics", "x", publish="DENY"), group("topics", "y", publish="ALLOW"))
    (exchanged,), _ = remapped_policies([both], ["x:=y", "y:=x"])
    assert {(str(right.qualifier), right.name) for right in policy_rights(exchanged)} == {
        ("DENY", "/y"), ("ALLOW", "/x")
    }  # fmt: skip


def test_what_nodes_remap_otherwise_is_noted() -> None:
    """Not every rcl_action remaps the name of an action, but each one those of its parts."""
    nodes = [one(group("actions", "plan", execute="ALLOW"), node=node) for node in ("n", "hand")]
    own = group("services", "~/arm ~/set_parameters", reply="ALLOW")
    parts = ("cancel_goal", "get_result", "send_goal", "feedback", "status")
    rules = " ".join(f"-r plan/_action/{part}:=/arm/plan/_action/{part}" for part in parts)
    for texts, ids, told in (
        (
            ["plan:=/arm/plan"],
            ["merge.remapped-action", OF_REQUIREMENTS],
            f"start its nodes with `--ros-args {rules}`, which works with every release",
        ),
        (["__node:=x"], ["merge.remapped-nodes"], "name to the nodes hand and n. Choose the node"),
        (["n:__node:=x"], [], ""),
        # All names below a node's name move, also those of no right.
        (
            ["base:__node:=x"],
            [OF_REQUIREMENTS],
            "requirements that name /base/* protect only the old",
        ),
        (["__ns:=/left"], [OF_NAMESPACE], "Merge the policy with --namespace /left in place"),
        (["base:__ns:=/l", "~/arm:=/a"], [OF_NAMESPACE, OF_REQUIREMENTS], "follow --remap base:__"),
        (
            ["/plan:=/y"],
            ["merge.remapped-action", OF_REQUIREMENTS],
            "requirements that name /plan protect only the old",
        ),
    ):
        base = [one(own, node="base")] if "base" in texts[0] else []
        _, notes = remapped_policies([*nodes, *base], texts)
        assert [note.id for note in notes] == ids
        assert told in "".join(note.text for note in notes)


@pytest.mark.parametrize(
    "rule", ["x", "x:=", "x:=/a b", "/*:=/x", "x:=/y*", "__node:=a/b", "a:b:c:=d"]
)
def test_what_is_no_remapping(rule: str) -> None:
    with pytest.raises(UsageError):
        parse_remapping(rule)


def test_a_policy_without_enclaves_gets_the_rights_of_others_alone(tmp_path: Path) -> None:
    (path := tmp_path / "empty.xml").write_text('<policy version="0.2.0"><enclaves/></policy>')
    profiles = one(TOPICS).enclaves[0].profiles
    both = Policy((Enclave("/a", profiles), Enclave("/b", profiles)))
    result = merge_into(path, moved := policy_in_namespace(both, "/left"))
    assert policy_rights(read_policy(path, result.document)) == policy_rights(moved)
    lines = result.document.decode().splitlines()  # one for each right, as git and sros name lines
    assert lines[1] == '  <enclave path="/left/a">' and lines[-1] == "</enclaves></policy>"


TOPICS = group("topics", "/x /cam/*", publish="ALLOW")

CASES = {
    "exact": (one(TOPICS), one(group("topics", "x", publish="ALLOW")), []),
    "other node": (one(TOPICS), one(group("topics", "/x", publish="ALLOW"), node="m"), []),
    "wildcard": (one(TOPICS), one(group("topics", "/cam/a", publish="ALLOW")), []),
    "direction": (
        one(TOPICS),
        one(group("topics", "/x", publish="ALLOW", subscribe="ALLOW")),
        ["subscribe topic /x"],
    ),
    "wider": (one(TOPICS), one(group("topics", "/*", publish="ALLOW")), ["publish topic /*"]),
    "action by its parts": (
        one(
            group("services", "/f/*", request="ALLOW"),
            group("topics", "/f/*", subscribe="ALLOW"),
        ),
        one(group("actions", "/f", call="ALLOW", execute="ALLOW")),
        ["execute action /f"],
    ),
    "part of an action": (
        one(group("actions", "/f", call="ALLOW")),
        one(group("topics", "/f/_action/status", publish="ALLOW", subscribe="ALLOW")),
        ["publish topic /f/_action/status"],
    ),
}


@pytest.mark.parametrize(("before", "asked", "added"), CASES.values(), ids=CASES)
def test_what_is_there_is_not_added(before: Policy, asked: Policy, added: list[str]) -> None:
    assert [right.describe() for right in plan_merge(before, asked).added] == added


DENIED = group("topics", "/cam/*", subscribe="DENY")
ALLOWED = group("topics", "/cam/a", subscribe="ALLOW")
ALL = group("topics", "/*", subscribe="ALLOW")

CONTRADICTIONS = {
    "still denied": (one(DENIED), one(ALLOWED), [], "merge.still-denied"),
    "denied in part": (one(DENIED), one(ALL), ["ALLOW /*"], "merge.still-denied"),
    "both mean the exception": (one(DENIED), one(ALL, DENIED), ["ALLOW /*"], ""),
    "newly denied": (one(ALLOWED), one(DENIED), ["DENY /cam/*"], "merge.newly-denied"),
    "denied by both": (one(DENIED), one(DENIED), [], ""),
    "nothing to do with it": (one(DENIED), one(group("topics", "/x", subscribe="DENY")),
                              ["DENY /x"], ""),
    "other direction": (one(DENIED), one(group("topics", "/cam/a", publish="ALLOW")),
                        ["ALLOW /cam/a"], ""),
}  # fmt: skip


@pytest.mark.parametrize(
    ("before", "asked", "added", "note"), CONTRADICTIONS.values(), ids=CONTRADICTIONS
)
def test_a_denial_stays_and_is_told(
    before: Policy, asked: Policy, added: list[str], note: str
) -> None:
    plan = plan_merge(before, asked)
    assert [f"{right.qualifier} {right.name}" for right in plan.added] == added
    assert [each.id for each in merge_notes(plan.contradictions)] == ([note] if note else [])


def test_what_one_node_of_an_enclave_denies_to_another_is_told() -> None:
    """In one process, each DENY applies to all nodes; those of its own node are meant."""
    nodes = {
        node: one(*groups, node=node)
        for node, groups in (
            ("detector", (ALL, DENIED)), ("docker", (ALLOWED,)), ("light", (ALL, DENIED)),
        )
    }  # fmt: skip

    def composed(*names: str) -> Policy:
        blocks = (block for name in names for block in nodes[name].enclaves[0].profiles)
        return Policy((Enclave("/a", tuple(blocks)),))

    empty = Policy(())
    (note,) = merge_notes(plan_merge(empty, composed("detector", "docker")).contradictions)
    assert note.id == "merge.newly-denied"
    assert "DENY subscribe topic /cam/* was added, and overrides" in note.text
    assert note.text.endswith(": subscribe topic /cam/a.")
    assert not plan_merge(empty, composed("detector", "light")).contradictions
    again = plan_merge(nodes["detector"], composed("detector", "docker")).contradictions
    assert [note.id for note in merge_notes(again)] == ["merge.still-denied"]


NO_CMD = group("topics", "/*cmd_vel /left/y", publish="DENY")
SENDS = group("topics", "motor cmd_vel y", publish="ALLOW")
FOLLOWS = group("actions", "follow", execute="ALLOW")
NO_GOAL = group("services", "/*cmd_vel/_action/send_goal", reply="DENY")


@pytest.mark.parametrize(
    ("before", "asked", "options", "denials"),
    [
        (one(), one(NO_CMD, SENDS), {"remaps": ["motor:=/base/cmd_vel"]}, ["newly /*cmd_vel"]),
        (one(NO_CMD), one(NO_CMD, SENDS), {"remaps": ["motor:=/base/cmd_vel"]},
         ["still /*cmd_vel"]),
        (one(), one(NO_CMD, SENDS), {"namespace": "/left"}, ["newly /left/y"]),
        (one(), one(NO_GOAL, FOLLOWS), {"remaps": ["follow:=/cmd_vel"]},
         ["newly /*cmd_vel/_action/send_goal"]),
        # Denied before, too: by its own policy, under the old name, or as an exception.
        (one(), one(NO_CMD, SENDS), {"remaps": ["cmd_vel:=/base/cmd_vel"]}, []),
        (one(), one(NO_CMD, SENDS), {"remaps": ["motor:=/base/motor"]}, []),
        (one(), one(NO_CMD, group("topics", "/*", publish="ALLOW")), {"remaps": ["/cmd_vel:=/x"]},
         []),
        (one(NO_CMD), one(NO_CMD, SENDS), {}, []),
    ],
)  # fmt: skip
def test_a_right_that_is_denied_only_under_its_new_name_is_told(
    before: Policy,
    asked: Policy,
    options: dict[str, Any],
    denials: list[str],
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.xml"
    path.write_bytes(policy_xml(before))
    enclave = None if "namespace" not in options else "/a"
    result = merge_policies(path, [asked], **options, enclave=enclave)
    found = {
        f"{'newly' if each.new else 'still'} {each.denied.name}" for each in result.contradictions
    }
    assert sorted(found) == denials
    noted = [note.text for note in result.notes if note.id.endswith("-denied")]
    assert len(noted) == len(denials), noted


def test_a_denial_is_told_once_for_all_that_it_meets() -> None:
    names = " ".join(f"/cam/{number}" for number in range(9))
    plan = plan_merge(one(DENIED), one(group("topics", names, subscribe="ALLOW")))
    (note,) = merge_notes(plan.contradictions)
    assert "and 6 more" in note.text


def test_a_denied_action_is_told_as_one() -> None:
    action = group("actions", "/f", call="DENY")
    plan = plan_merge(one(action), one(group("actions", "/f", call="ALLOW")))
    assert [each.denied for each in plan.contradictions] == [Right("/a", DENY, "call", "/f")]


def test_several_policies_one_after_the_other(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_bytes(policy_xml(one(TOPICS)))
    more = [one(group("topics", name, publish="ALLOW")) for name in ("/y", "/z", "/y")]
    assert [right.name for right in merge_all(path, more).added] == ["/y", "/z"]
