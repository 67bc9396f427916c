"""Information flows where a writer and a reader have a name in common, and nowhere else."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.dds.domains import DomainSet
from sros_tool.policy.model import ALLOW, DENY
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import Right, Rules
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, DomainRights, Network, Unguarded, path_text


def rights(*lines: str) -> list[Right]:
    """Rights as ``/a publish /x``; with ``!`` before the right, a denial."""
    found = []
    for line in lines:
        enclave, right, name = line.split()
        qualifier = DENY if right.startswith("!") else ALLOW
        found.append(Right(enclave, qualifier, right.lstrip("!"), name))
    return found


CHAIN = rights("/a publish /x", "/b subscribe /x", "/b publish /y", "/c subscribe /y")


def reached(found: list[Right], start: str) -> tuple[set[str], set[str]]:
    reach = Network(found).reach(start)
    return set(reach.influences), set(reach.learns_from)


def test_over_several_hops_with_the_path() -> None:
    reach = Network(CHAIN).reach("/a")
    assert path_text(reach.influences["/c"]) == "/a -publish /x-> /b -publish /y-> /c"
    assert reach.learns_from == {}
    assert path_text(Network(CHAIN).reach("/c").learns_from["/a"]) == path_text(
        reach.influences["/c"]
    )


def test_services_carry_both_ways() -> None:
    found = rights("/client request /add", "/server reply /add")
    assert reached(found, "/client") == ({"/server"}, {"/server"})
    reach = Network(found).reach("/client")
    assert path_text(reach.influences["/server"]) == "/client -request /add-> /server"
    assert path_text(reach.learns_from["/server"]) == "/server -reply /add-> /client"


def test_actions_carry_both_ways_and_are_told_as_such() -> None:
    reach = Network(rights("/client call /go", "/server execute /go")).reach("/client")
    assert path_text(reach.influences["/server"]) == "/client -call action /go-> /server"
    assert path_text(reach.learns_from["/server"]) == "/server -execute action /go-> /client"
    assert reach.influences["/server"][0].kind == "actions"


def test_a_topic_of_an_action_alone_carries_one_way() -> None:
    found = rights("/spy subscribe /go/_action/feedback", "/server execute /go")
    assert reached(found, "/spy") == (set(), {"/server"})


@pytest.mark.parametrize(
    ("said", "heard", "name"),
    [
        ("/cmd_*", "/*_vel", "/cmd_vel"),
        ("/a/*", "/*/b", "/a/b"),
        ("/scan", "/*", "/scan"),
        ("/*", "/scan", "/scan"),
        ("/a*", "/b*", ""),
        ("/a?", "/a", ""),
    ],
)
def test_wildcards_meet_where_they_overlap(said: str, heard: str, name: str) -> None:
    found = rights(f"/a publish {said}", f"/b subscribe {heard}")
    influences = Network(found).reach("/a").influences
    assert [path[0].name for path in influences.values()] == ([name] if name else [])


@pytest.mark.parametrize(
    "denial",
    ["/a !publish /cmd_vel", "/b !subscribe /cmd_vel", "/a !publish /*", "/b !subscribe /c*"],
)
def test_denials_cut(denial: str) -> None:
    open_way = rights("/a publish /cmd_vel", "/b subscribe /cmd_*")
    assert reached(open_way, "/a")[0] == {"/b"}
    assert reached([*open_way, *rights(denial)], "/a")[0] == set()


def test_denials_cut_no_more_than_they_say() -> None:
    found = rights("/a publish /cmd_*", "/b subscribe /*_vel", "/a !publish /cmd_vel")
    (hop,) = Network(found).reach("/a").influences["/b"]
    assert hop.name == "/cmd__vel"
    assert reached([*found, *rights("/b !subscribe /cmd_?*")], "/a")[0] == set()


def test_topics_that_ros_has_no_word_for() -> None:
    """As in the permissions of ros2/sros2, where * stands for every DDS topic."""
    found = rights("/all publish *", "/all subscribe *", "/a publish /x", "/b request /add")
    assert reached(found, "/a") == ({"/all", "/b"}, set())
    reach = Network(found).reach("/all")
    assert path_text(reach.influences["/b"]) == "/all -reply /add-> /b"
    (hop,) = Network([*rights("/more subscribe *"), *found]).reach("/all").influences["/more"]
    assert (hop.kind, hop.name, hop.stated_by_source, hop.stated_by_target) == (
        "topics",
        "/a",
        "*",
        "*",
    )
    assert reached(rights("/a publish foreign", "/b subscribe f*"), "/a") == ({"/b"}, set())
    kept = rights("/a publish *", "/b subscribe rt/*", "/a !publish r?/a")
    assert Network(kept).reach("/a").influences["/b"][0].name != "/a"
    halves = rights("/a publish rq/addRequest", "/b reply /add")
    assert reached(halves, "/a") == ({"/b"}, set())


def test_names_that_do_not_count() -> None:
    found = rights("/a publish /parameter_events", "/b subscribe /*")
    assert set(Network(found).reach("/a").influences) == {"/b"}
    assert Network(found, excluded=OF_EVERY_NODE).reach("/a").influences == {}


def test_nobody_reaches_itself_through_itself_and_circles_end() -> None:
    found = [*CHAIN, *rights("/c publish /z", "/a subscribe /z", "/a subscribe /x")]
    assert reached(found, "/a") == ({"/b", "/c"}, {"/b", "/c"})


@pytest.mark.parametrize(
    "asked",
    ["/b/get_parameters", "/*/get_parameters", "/ns/b/get_state", "/*/_container/list_nodes"],
)
@pytest.mark.parametrize("served", ["/*", ""])
def test_a_question_changes_nothing(asked: str, served: str) -> None:
    found = rights(f"/look request {asked}", f"/b reply {served or asked}")
    with_questions = Network(found).reach("/look")
    assert set(with_questions.influences) == {"/b"}
    without = Network(found, questions=QUESTIONS).reach("/look")
    assert (set(without.influences), set(without.learns_from)) == (set(), {"/b"})


def test_requests_that_change_something_count() -> None:
    found = rights("/c request /b/set_parameters", "/d request /*", "/b reply /*")
    network = Network(found, questions=QUESTIONS)
    assert dict(network.links("/c", ())).keys() == {"/b"}
    assert dict(network.links("/d", ())).keys() == {"/b"}


def test_hops_of_one_enclave() -> None:
    hops = [hop() for _, hop in Network(CHAIN).links("/b", ())]
    assert [str(hop) for hop in hops] == ["/b -publish /y-> /c"]
    assert (hops[0].stated_by_source, hops[0].stated_by_target, hops[0].kind) == (
        "/y",
        "/y",
        "topics",
    )


def test_links_are_found_without_the_name_of_each_hop() -> None:
    """Also for expressions that overlap, but only in names that no node can have."""
    stars = ("/e{}/*/a*", "/*/c{}/*", "/*x", "/*/1*", "/?{}", "/[0-9]", "/e{}/x", "*")
    names = [star.format(number) for star in stars for number in (1, 2)]
    found = [f"/w{n} publish {name}" for n, name in enumerate(names)]
    found += [f"/r{n} subscribe {name}" for n, name in enumerate(names)]
    found += ["/w publish /*d", "/w !publish /d*", "/r subscribe /d*"]
    network = Network(rights(*found))
    for enclave in network.enclaves:
        linked = {reader for reader, _ in network.links(enclave, ())}
        reached_directly = {path[0].target for path in network.influenced_by([enclave]).values()}
        assert linked == reached_directly, enclave


ENCLAVES = ["/a", "/b", "/c", "/d"]
NAMES = ["/x", "/y", "/xx", "/x/y", "/*", "/x*", "/?", "/*y"]
KNOWN = ["/x", "/y", "/xx", "/x/y", "/z", "/zy", "/xz", "/zz", "/xy"]
"""Every combination of NAMES that is not empty holds one of these."""

drawn = st.lists(
    st.builds(
        Right,
        st.sampled_from(ENCLAVES),
        st.sampled_from([ALLOW, ALLOW, DENY]),
        st.sampled_from(["publish", "subscribe"]),
        st.sampled_from(NAMES),
    ),
    max_size=12,
)


@given(drawn)
def test_against_the_closure_over_every_name(found: list[Right]) -> None:
    rules = Rules(found)
    able = {
        (enclave, right, name)
        for enclave, right, name in product(ENCLAVES, ("publish", "subscribe"), KNOWN)
        if rules.allow(enclave, right, name)
    }
    ways = {
        (one, other)
        for one, other in product(ENCLAVES, ENCLAVES)
        if one != other
        and any((one, "publish", n) in able and (other, "subscribe", n) in able for n in KNOWN)
    }
    for middle, one, other in product(ENCLAVES, ENCLAVES, ENCLAVES):  # Warshall
        if (one, middle) in ways and (middle, other) in ways and one != other:
            ways.add((one, other))
    network = Network(found)
    for start in ENCLAVES:
        reach = network.reach(start)
        assert set(reach.influences) == {other for one, other in ways if one == start}
        assert set(reach.learns_from) == {one for one, other in ways if other == start}
        for there, path in reach.influences.items():
            assert (path[0].source, path[-1].target) == (start, there)
            for hop in path:
                assert rules.allow(hop.source, "publish", hop.name), path_text(path)
                assert rules.allow(hop.target, "subscribe", hop.name), path_text(path)
                assert matches(hop.stated_by_source, hop.name) and matches(
                    hop.stated_by_target, hop.name
                )


def test_what_the_governance_leaves_open_carries_for_everybody() -> None:
    found = rights("/a subscribe /x", "/b publish /y", "/b !publish /x")
    assert Network(found).reach("/b").influences == {}
    open_x = Unguarded("publish", "rt/*", ("rt/guarded/*",))
    network = Network(found, unguarded=[open_x], everybody=["/a", "/b"])
    assert path_text(network.reach("/b").influences["/a"]) == "/b -publish /x-> /a"
    guarded = rights("/a subscribe /guarded/x")
    assert Network(guarded, unguarded=[open_x], everybody=["/b"]).reach("/b").influences == {}
    log = rights("/a subscribe /parameter_events")
    for left_out, reached in (((), {"/a"}), (OF_EVERY_NODE, set())):
        network = Network(log, excluded=left_out, unguarded=[open_x], everybody=["/b"])
        assert set(network.reach("/b").influences) == reached


NORTH, SOUTH, BOTH = (DomainSet.parse(text) for text in ("10", "20", "10,20"))


def test_a_hop_needs_a_common_domain_in_which_both_rights_hold() -> None:
    found: DomainRights = {
        NORTH: rights("/n publish /x", "/m subscribe /y", "/d !publish /x"),
        SOUTH: rights("/s subscribe /x", "/d publish /x"),
        BOTH: rights("/b subscribe /x", "/b publish /y"),
    }
    network = Network(found)
    assert set(network.reach("/n").influences) == {"/b", "/m"}
    # Denied in one domain, allowed in the other; through an enclave of both into the first.
    assert set(network.reach("/d").influences) == {"/s", "/b", "/m"}
    assert network.reach("/s").learns_from.keys() == {"/d"}


@pytest.mark.parametrize(("needs_right", "reached"), [(True, set()), (False, {"/n"})])
def test_what_is_open_in_a_domain_is_for_those_who_can_join_it(
    needs_right: bool, reached: set[str]
) -> None:
    found: DomainRights = {NORTH: rights("/n subscribe /x"), SOUTH: rights("/s publish /y")}
    opened = Unguarded("publish", "*", (), BOTH, needs_right)
    network = Network(found, unguarded=[opened], everybody=["/n", "/s"])
    assert set(network.reach("/s").influences) == reached
