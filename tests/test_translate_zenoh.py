"""Rights of policies become Zenoh access control: exactly, or an error with the place."""

from __future__ import annotations

import random
from datetime import UTC, datetime
from functools import partial
from itertools import product
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Permissions
from sros_tool.errors import PolicyError
from sros_tool.files import policies_dir
from sros_tool.names import NODE_SERVICES, dds_names, expression_problem
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import ALLOW, Enclave, Group, Profile, Profiles, Qualifier, Source
from sros_tool.policy.model import DENY as DENY_
from sros_tool.policy.model import RIGHTS as RIGHTS_OF
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import NodeName, Right, Rules, nodes_not_shown, nodes_of_rights
from sros_tool.translate import permissions_for
from sros_tool.translate_zenoh.graph import (
    announced_nodes,
    example_token,
    graph_rules,
    nodes_in_rules,
    shared_nodes,
)
from sros_tool.translate_zenoh.rights import (
    StatedRight,
    chunks_of,
    remote_of,
    remote_rights,
    rights_given_to_router,
    stated_rights,
)
from sros_tool.validity import Window
from sros_tool.zenoh.access import AccessControl, Flow, Message, RemoteRights, RightsBetween
from sros_tool.zenoh.key_expressions import canonical, includes
from sros_tool.zenoh.releases import RELEASES
from tests.support.children import LONG
from tests.support.harness import policy_text, publish
from tests.support.long_form import SEED

IN, OUT = Flow.INGRESS, Flow.EGRESS
VALIDITY = Window(datetime(2027, 1, 1, tzinfo=UTC), datetime(2028, 1, 1, tzinfo=UTC))
TYPE = "std_msgs::msg::dds_::String_/RIHS01_00"


def enclave(tmp_path: Path, groups: str, path: str = "/robot/n") -> Enclave:
    file = tmp_path / "policy.xml"
    file.write_text(policy_text({path: groups}))
    return read_policy(file).enclaves[0]


def keys(name: str) -> list[str]:
    return [canonical(("0", *each, "*", "*")) for each in chunks_of(name)]


def right_to(right: str, name: str) -> AccessControl:
    stated = StatedRight(Right("/n", ALLOW, right, name), Source("a policy", 1))
    return AccessControl((remote_of("/n", {0: [stated]}),))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("/chatter", ["0/chatter/*/*"]),
        ("/ns/_hidden", ["0/ns/_hidden/*/*"]),
        ("/*", ["0/*/*/*/**"]),
        ("/cam*", ["0/cam$*/*/*/**"]),
        ("/*cam", ["0/**/$*cam/*/*"]),
        ("/cam/*", ["0/cam/*/*/*/**"]),
        ("/a/*/b", ["0/a/*/**/b/*/*"]),
        ("/a*b", ["0/a$*b/*/*", "0/a$*/**/$*b/*/*"]),
        ("/*a*", ["0/**/$*a$*/*/*/**"]),
        ("*/chatter", ["0/chatter/*/*", "0/*/**/chatter/*/*"]),
    ],
)
def test_names(name: str, expected: list[str]) -> None:
    assert keys(name) == expected


BELOW = [f"/{each.replace('*', '0a1b')}" for of in RELEASES for each in of.below_topics]
"""What some release has below the key of a topic."""
BELOW = ["", *dict.fromkeys(BELOW)]
NAMES = [
    "/" + "/".join(parts)
    for count in (1, 2, 3)
    for parts in product(("a", "b", "ab", "aab"), repeat=count)
]


def test_a_wildcard_matches_the_same_names_in_both_worlds() -> None:
    draw = random.Random(SEED)
    tried = 0
    while tried < (400 if LONG else 50):
        text = "/" + "".join(draw.choice("aab/**") for _ in range(draw.randint(1, 7)))
        if expression_problem(text):
            continue
        tried += 1
        expressions = keys(text)
        put = right_to("publish", text).passing("/n", IN, Message.PUT)
        query = right_to("request", text).passing("/n", IN, Message.QUERY)
        for name in NAMES:
            key = f"0{name}/{TYPE}"
            meant = matches(text, name)
            said = any(includes(each, key) for each in expressions)
            assert said == query.include(key) == meant, (text, name, expressions)
            for below in BELOW:
                assert put.include(key + below) == meant, (text, name, below, put.all)


RIGHTS = {
    "publish": [
        (IN, Message.PUT, ""), (IN, Message.DELETE, ""), (OUT, Message.DECLARE_SUBSCRIBER, ""),
        (IN, Message.REPLY, ""), (IN, Message.PUT, "/@adv/pub/1/2/_"),
        (IN, Message.DECLARE_QUERYABLE, "/@adv/pub/1/2/_"),
        (IN, Message.LIVELINESS_TOKEN, "/@adv/pub/1/2/_"), (OUT, Message.QUERY, "/@adv/**"),
        (OUT, Message.DECLARE_SUBSCRIBER, "/@adv/**"),
        (OUT, Message.DECLARE_LIVELINESS_SUBSCRIBER, "/@adv/**"),
    ],
    "request": [
        (IN, Message.QUERY, ""), (OUT, Message.REPLY, ""), (OUT, Message.DECLARE_QUERYABLE, ""),
    ],
}  # fmt: skip
RIGHTS["subscribe"] = [(flow.opposite(), message, end) for flow, message, end in RIGHTS["publish"]]
RIGHTS["reply"] = [(flow.opposite(), message, end) for flow, message, end in RIGHTS["request"]]
GROUP = {
    "publish": publish("/x"),
    "subscribe": publish("/x").replace("publish", "subscribe"),
    "request": '<services request="ALLOW"><service>/x</service></services>',
    "reply": '<services reply="ALLOW"><service>/x</service></services>',
}
NAMED = [*product(Flow, Message, ["", "/@adv/pub/1/2/_", "/@adv/**"])]


@pytest.mark.parametrize("right", RIGHTS)
def test_a_right_is_exactly_these_messages(right: str, tmp_path: Path) -> None:
    rights = remote_rights(enclave(tmp_path, GROUP[right]), 0)
    control = AccessControl((rights,))
    key = f"0/x/{TYPE}"
    allowed = {each for each in NAMED if control.allows("/robot/n", *each[:2], key + each[2])}
    advanced = {each for each in allowed if each[2]}
    assert {each for each in allowed if not each[2]} == {e for e in RIGHTS[right] if not e[2]}
    assert advanced >= {each for each in RIGHTS[right] if each[2]}
    assert bool(advanced) == (right in ("publish", "subscribe"))
    for other in (f"0/y/{TYPE}", f"0/x/y/{TYPE}", f"1/x/{TYPE}", "0/**", "0/*/*/*", "0/x/**"):
        assert not any(control.allows("/robot/n", *each[:2], other) for each in NAMED), other
    assert not any(control.allows("/robot", *each[:2], key) for each in NAMED)


def test_wildcards_whose_keys_double_with_each_are_refused_at_once(tmp_path: Path) -> None:
    """Forty wildcards in a part of a name are a million million key expressions."""
    with pytest.raises(PolicyError, match="cannot be expressed in Zenoh"):
        remote_rights(enclave(tmp_path, publish("/" + "a*" * 40 + "a")), 0)


@pytest.mark.parametrize("name", ["/a#b", "/a$b", "/a//b", "/a/", "/#*"])
@pytest.mark.parametrize("qualifier", [ALLOW, DENY_])
def test_a_name_that_is_no_key_of_zenoh_is_refused(name: str, qualifier: Qualifier) -> None:
    place = Source("permissions of others", 0)
    stated = [
        StatedRight(Right("/n", each, "publish", text), place)
        for each, text in ((ALLOW, "/c"), (qualifier, name))
    ]
    assert remote_of("/n", {0: stated[:1]})
    with pytest.raises(PolicyError, match="cannot be expressed in Zenoh"):
        remote_of("/n", {0: stated})


def test_an_action_is_its_services_and_topics(tmp_path: Path) -> None:
    group = '<actions execute="ALLOW"><action>/a</action></actions>'
    control = AccessControl((remote_rights(enclave(tmp_path, group), 0),))

    def allowed(flow: Flow, message: Message, name: str) -> bool:
        return control.allows("/robot/n", flow, message, f"0/a/_action/{name}/{TYPE}")

    for name in ("send_goal", "cancel_goal", "get_result"):
        assert allowed(OUT, Message.QUERY, name) and not allowed(IN, Message.QUERY, name)
    for name in ("feedback", "status"):
        assert allowed(IN, Message.PUT, name) and not allowed(OUT, Message.PUT, name)


def test_whoever_asks_for_the_graph_asks_for_all_of_it(tmp_path: Path) -> None:
    control = AccessControl((remote_rights(enclave(tmp_path, publish("/x")), 0),))
    assert control.allows("/robot/n", IN, Message.LIVELINESS_QUERY, "@ros2_lv/0/**")
    assert not control.allows("/robot/n", IN, Message.LIVELINESS_QUERY, "@ros2_lv/**")


DENY = '<topics {}="DENY"><topic>{}</topic></topics>'


@pytest.mark.parametrize(
    ("groups", "allowed", "refused"),
    [
        (publish("/a", "/b") + DENY.format("publish", "/b"), ["/a"], ["/b"]),
        (publish("/a", "/b") + DENY.format("publish", "/*"), [], ["/a", "/b"]),
        (publish("/a*") + DENY.format("publish", "/*"), [], ["/a", "/ab"]),
        (publish("/a*") + DENY.format("publish", "/b*"), ["/a", "/ab"], ["/b"]),
        (publish("/a*") + DENY.format("subscribe", "/a"), ["/a", "/ab"], ["/b"]),
        (publish("/c[0-2]") + DENY.format("publish", "/c1"), ["/c0", "/c2"], ["/c1", "/c3"]),
        (publish("/c[ab]*"), ["/ca", "/cbx/y"], ["/cc"]),
        (publish("/a?", "/[!a]b"), ["/ab", "/a_", "/bb", "/_b"], ["/a", "/a/b", "/abc", "/ab/b"]),
        (publish("/a?b"), ["/acb", "/a/b"], ["/ab", "/acdb"]),
        (publish("/a*") + DENY.format("publish", "/a?"), ["/a", "/abc", "/a/b"], ["/ab", "/a_"]),
        (
            publish("/*") + DENY.format("publish", "/front_camera/*"),
            ["/front_camera", "/front", "/front_camera2/x", "/x/front_camera/y", "/f", "/g/h/i"],
            ["/front_camera/image", "/front_camera/a/b"],
        ),
        (
            publish("/*") + DENY.format("publish", "/*/set_parameters"),
            ["/set_parameters", "/n/set_parameters_atomically", "/n/set", "/n/reset_parameters"],
            ["/n/set_parameters", "/n/m/set_parameters"],
        ),
        (
            publish("/robot*/cmd_vel") + DENY.format("publish", "/robot1/*"),
            ["/robot2/cmd_vel", "/robot/cmd_vel", "/robot11/x/cmd_vel"],
            ["/robot1/cmd_vel", "/robot2/odom"],
        ),
    ],
)
def test_denials_are_subtracted(
    groups: str, allowed: list[str], refused: list[str], tmp_path: Path
) -> None:
    control = AccessControl((remote_rights(enclave(tmp_path, groups), 0),))
    for name in (*allowed, *refused):
        told = control.allows("/robot/n", IN, Message.PUT, f"0{name}/{TYPE}")
        assert told == (name in allowed), name


@pytest.mark.parametrize(
    ("groups", "text"),
    [
        (
            publish("/*") + "\n" + DENY.format("publish", "/*image*"),
            "policy.xml:2: DENY publish /*image* cannot be expressed in Zenoh, because line 1 of",
        ),
        (
            publish("/*")
            + "\n"
            + "".join(
                DENY.format("publish", each)
                for each in ("/front_camera/*", "/*/set_parameters", "/*/describe_parameters")
            ),
            "policy.xml:2: DENY publish /front_camera/* cannot be expressed in Zenoh, because line "
            "1",
        ),
        ("\n" + publish("/a???"), "policy.xml:2: the name /a???"),
        (publish("/[!a][!b][!c]"), "policy.xml:1: the name /[!a][!b][!c]"),
        (publish("/a") + "\n" + DENY.format("publish", "/???"), "policy.xml:2: the name /???"),
    ],
)
def test_what_zenoh_cannot_enforce_is_refused_with_its_line(
    groups: str, text: str, tmp_path: Path
) -> None:
    with pytest.raises(PolicyError) as caught:
        remote_rights(enclave(tmp_path, groups), 0)
    assert text in caught.value.what
    assert caught.value.remedy.startswith(("List the names to ", "Write only the names "))


@pytest.mark.parametrize(
    ("allowed", "denied", "reached"),
    [
        ("/*", "/front_camera/*", ["/front_camera/image", "/front_camera/a/b/c"]),
        ("/*", "/cmd_vel", ["/cmd_vel"]),
        ("/*", "/*/set_parameters", ["/n/set_parameters", "/a/b/set_parameters"]),
        ("/a*", "/a?", ["/ab", "/a_", "/a0"]),
        ("/*/get", "/secret/*", ["/secret/get", "/secret/a/get"]),
    ],
)
def test_no_put_or_query_with_a_wildcard_reaches_what_is_denied(
    allowed: str, denied: str, reached: list[str], tmp_path: Path
) -> None:
    """A key expression passes if a rule includes it; so no rule may meet the key of a denied name.

    Zenoh itself is asked which expressions meet.
    """
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    with_denial = enclave(tmp_path, publish(allowed) + DENY.format("publish", denied))
    without = remote_rights(enclave(tmp_path, publish(allowed)), 0)
    of_names = [
        key
        for rule in remote_rights(with_denial, 0).rules
        for key in rule.key_expressions
        if not key.startswith("@")
    ]
    expressions = [zenoh.KeyExpr(each) for each in of_names]  # refuses what is not canonical
    for name in reached:
        for end in ("", "/@adv/pub/1/2/_"):
            key = zenoh.KeyExpr(f"0{name}/{TYPE}{end}")
            assert not any(each.intersects(key) for each in expressions), name
            assert any(
                zenoh.KeyExpr(each).includes(key)
                for rule in without.rules
                for each in rule.key_expressions
            )


@pytest.mark.parametrize("file", sorted(each.name for each in policies_dir().glob("*.xml")))
def test_the_shipped_policies_give_the_same_rights_as_on_dds(file: str) -> None:
    """Each enclave is asked about every name of its policy, in each right that such names have."""
    policy = read_policy(policies_dir() / file)
    stated = {each.path: [one.right for one in stated_rights(each)] for each in policy.enclaves}
    names = {(e.kind, e.name) for of in stated.values() for e in of if "*" not in e.name}
    for each in policy.enclaves:
        control, rules = AccessControl((remote_rights(each, 0),)), Rules(stated[each.path])
        for kind, name in names:
            for right in ("publish", "subscribe") if kind == "topics" else ("request", "reply"):
                told = control.allows(each.path, *USES[right], f"0{name}/{TYPE}")
                assert told == rules.allow(each.path, right, name), (each.path, right, name)


USES = {
    "publish": (IN, Message.PUT), "subscribe": (OUT, Message.PUT),
    "request": (IN, Message.QUERY), "reply": (OUT, Message.QUERY),
}  # fmt: skip


def test_random_policies_give_the_same_rights_as_on_dds_or_an_error() -> None:
    """DDS is asked by its own engine, from the permissions of the same enclave."""
    draw, translated = random.Random(SEED), 0
    for _ in range(3000):
        if translated == 4 and not LONG:
            break
        enclave = drawn_enclave(draw)
        try:
            stated = dict.fromkeys((0, 7), stated_rights(enclave))
            control = AccessControl((remote_of("/e", stated),))
        except PolicyError:
            continue
        translated += 1
        document = permissions_for(
            enclave, subject="CN=/e", validity=VALIDITY, domains=DomainSet.of((0, 0))
        )
        parts = [f"/{a}/_action/{part}" for a in ("a", "ab/a") for part in ("send_goal", "status")]
        for name, (right, use) in product(
            [*draw.sample(NAMES, 40 if LONG else 15), *parts], USES.items()
        ):
            names = dds_names(right, name)
            on_dds = all(
                rule_allows(document, topic, publish=written)
                for topics, written in ((names.publish, True), (names.subscribe, False))
                for topic in topics
            )
            for domain, here in ((0, on_dds), (7, on_dds), (1, False)):
                told = control.allows("/e", *use, f"{domain}{name}/{TYPE}")
                assert told == here, (enclave, right, name)
    assert translated > (2500 if LONG else 3)


def rule_allows(permissions: Permissions, topic: str, *, publish: bool) -> bool:
    """The first rule that matches a topic decides; without one it is denied."""
    for rule in permissions.grants[0].rules:
        criteria = rule.publish if publish else rule.subscribe
        if any(matches(each, topic) for one in criteria for each in one.topics):
            return rule.allow
    return False


DRAWN = [
    "/a", "/b", "/ab", "/a/b", "/ab/a", "/a/b/aab", "/a*", "/*b", "/a/*", "/*", "/[ab]", "/a?",
    "/[!b]b", "/a*b", "a", "a/b", "~/b", "*", "b*", "~/*",
]  # fmt: skip


def drawn_enclave(draw: random.Random) -> Enclave:
    """An enclave of some nodes with rights and denials, on names of which some have wildcards."""
    profiles = []
    for ns in draw.sample(("/", "/a", "/ab/a"), draw.randint(1, 2)):
        groups = []
        for _ in range(draw.randint(1, 4)):
            kind = draw.choice(("topics", "services", "actions"))
            right = draw.choice(RIGHTS_OF[kind])
            qualifier = DENY_ if draw.random() < 0.3 else ALLOW
            groups.append(Group(kind, ((right, qualifier),), tuple(draw.sample(DRAWN, 2))))
        profiles.append(Profile(ns, draw.choice("ab"), tuple(groups)))
    return Enclave("/e", (Profiles(tuple(profiles)),))


def test_a_session_trusts_its_router_with_its_own_rights_alone(tmp_path: Path) -> None:
    text = policy_text({"/a": publish("/x"), "/b": publish("/y")})
    (tmp_path / "p.xml").write_text(text)
    remotes = {e.path: remote_rights(e, 0) for e in read_policy(tmp_path / "p.xml").enclaves}
    put_x, put_y = (Message.PUT, f"0/x/{TYPE}"), (Message.PUT, f"0/y/{TYPE}")
    for direct in (True, False):
        known = remotes.values() if direct else ()
        session = AccessControl((*known, rights_given_to_router("/router", remotes["/a"])))
        assert session.allows("/router", OUT, *put_x)
        assert not session.allows("/router", IN, *put_x)
        assert not session.allows("/router", OUT, *put_y)
        assert session.allows("/b", IN, *put_y) == direct
        assert not session.allows("/b", IN, *put_x)
        assert not session.allows("", IN, *put_x)
    router = AccessControl(tuple(remotes.values()))
    assert router.allows("/a", IN, *put_x) and router.allows("/b", IN, *put_y)
    assert not router.allows("/a", IN, *put_y)
    assert not router.allows("/router", IN, *put_x)


# ── the graph ──────────────────────────────────────────────────────────────────────────────

NODES = """
<profile ns="/" node="n"><topics publish="ALLOW"><topic>chatter</topic></topics>
  <services reply="ALLOW"><service>~/list_parameters</service></services></profile>
<profile ns="/arm/left" node="camera_*">
  <topics publish="ALLOW" subscribe="ALLOW"><topic>image*</topic></topics>
  <topics publish="DENY"><topic>image_secret</topic><topic>image/*/raw</topic></topics>
  <services reply="ALLOW"><service>~/get_parameters</service></services>
  <actions call="ALLOW"><action>/dock</action></actions>
</profile>
"""
TOKENS = {  # what a token announces, and whether it may
    "NN/%e/%/n": True,
    "NN/%e/%arm%left/camera_1": True,
    "NN/%e/%/camera_1": False,
    "NN/%e/%arm/camera_1": False,
    "NN/%e/%arm%left/n": False,
    "NN/%e/%/other": False,
    "NN/%f/%/n": False,
    "NN/%e/%/*": False,
    "NN/*/%/n": False,
    "MP/%e/%/n/%chatter/t/h/q": True,
    "MP/%e/%/n/%chatter/t/h/q/more": True,
    "MS/%e/%/n/%chatter/t/h/q": False,
    "MP/%e/%/n/%other/t/h/q": False,
    "MP/%e/%/other/%chatter/t/h/q": False,
    "MP/%e/%arm%left/camera_1/%arm%left%image/t/h/q": True,
    "MP/%e/%arm%left/camera_1/%arm%left%image%raw/t/h/q": True,
    "MP/%e/%arm%left/camera_1/%arm%left%image%left%raw/t/h/q": False,
    "MS/%e/%arm%left/camera_1/%arm%left%image%left%raw/t/h/q": True,
    "MP/%e/%arm%left/camera_1/%arm%left%image_secret/t/h/q": False,
    "SS/%e/%arm%left/camera_1/%arm%left%camera_1%get_parameters/t/h/q": True,
    "SS/%e/%arm%left/camera_1/%arm%left%camera_1%set_parameters/t/h/q": False,
    "SS/%e/%/n/%n%list_parameters/t/h/q": True,
    "SS/%e/%arm%left/camera_1/%n%list_parameters/t/h/q": False,
    "SC/%e/%/n/%dock%_action%send_goal/t/h/q": True,
    "SS/%e/%/n/%dock%_action%send_goal/t/h/q": False,
    "MS/%e/%/n/%dock%_action%status/t/h/q": True,
    "MP/%e/%/n/**": False,
}


def test_tokens_are_bound_to_the_nodes_and_names_of_the_policy(tmp_path: Path) -> None:
    file = tmp_path / "policy.xml"
    file.write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/e"><profiles>'
        f"{NODES}</profiles></enclave></enclaves></policy>"
    )
    rights = remote_rights(read_policy(file).enclaves[0], 0)
    router, session = (
        AccessControl((rights,)),
        AccessControl((rights_given_to_router("/router", rights),)),
    )
    for token, expected in TOKENS.items():
        place = (Message.LIVELINESS_TOKEN, f"@ros2_lv/0/zid/0/1/{token}")
        assert router.allows("/e", IN, *place) is expected, token
        assert session.allows("/router", OUT, *place) is expected, token
        assert router.allows("/e", OUT, *place), "everybody may see everything"
        assert not router.allows("/e", IN, place[0], place[1].replace("/0/", "/1/", 1))
    assert set(nodes_in_rules(rights.rules, "/e")) >= {
        NodeName("/", "n"), NodeName("/arm/left", "camera_*"),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("services", "nodes"),
    [
        (["/a/n/get_parameters"], [("/a", "n")]),
        (["/n/describe_parameters", "/n/add"], [("/", "n")]),
        (["/n_*/list_parameters"], [("/", "n_*"), ("/n_*", "*")]),
        (["/*"], [("/", "*"), ("/*", "*")]),
        (["/add"], []),
    ],
)
def test_services_of_a_node_show_its_name(
    services: list[str], nodes: list[tuple[str, str]]
) -> None:
    rights = [Right("/e", ALLOW, "reply", each) for each in services]
    assert list(nodes_of_rights(rights)) == nodes
    stated = [StatedRight(each, Source("p", 0)) for each in rights]
    told = nodes_in_rules(remote_of("/e", {0: stated}).rules, "/e")
    assert AccessControl((remote_of("/e", {0: stated}),)).allows(
        "/e", IN, Message.LIVELINESS_TOKEN, "@ros2_lv/0/z/0/0/NN/%e/%x%y/other"
    ) is (services in (["/*"], ["/add"])), "any node, if none is known"
    assert remote_of("/e", {0: stated}, told) == remote_of("/e", {0: stated})


OWN = {
    node: [f"{node}/{service}" for service in NODE_SERVICES]
    for node in ("/n", "/n1", "/m", "/robot/arm")
}
EVERY = OWN["/robot/arm"]


@pytest.mark.parametrize(
    ("allowed", "denied", "may", "may_not"),
    [
        (["/*"], ["/robot/*"], ["%/n", "%/robo", "%robots/n"],
         ["%/robot", "%robot/n", "%robot%arm/n"]),
        (["/*"], ["/robot*"], ["%/n", "%arm/robot"], ["%/robot", "%/robots", "%robot/n"]),
        (["/*"], EVERY, ["%/n", "%robot/arms", "%robot%arm/n"], ["%robot/arm"]),
        (["/*"], EVERY[1:], ["%robot/arm"], []),
        (["/*/get_parameters"], ["/n/get_parameters"], ["%/m"], ["%/n"]),
        (["/*"], ["/*/set_parameters"], ["%/n", "%robot/arm"], []),
        (["/*"], ["/*/arm/*"], ["%/n", "%/arm"], ["%robot/arm", "%robot%arm/n"]),
        (["/*"], ["/n?/*"], ["%/n"], ["%/n1", "%n1/n"]),
        (["/n*"], ["/*"], ["%/profile"], ["%/n", "%/n1"]),
        (["/add"], ["/*"], ["%/profile"], ["%/n"]),
    ],
)  # fmt: skip
def test_denied_services_of_a_node_take_it_away(
    allowed: list[str], denied: list[str], may: list[str], may_not: list[str]
) -> None:
    rights = [Right("/e", ALLOW, "reply", name) for name in allowed]
    rights += [Right("/e", DENY_, "reply", name) for name in denied]
    rights.append(Right("/e", ALLOW, "publish", "/chatter"))
    profiles = [NodeName("/", "profile")]
    rules = tuple(graph_rules("/e", 0, rights, profiles))
    assert tuple(graph_rules("/e", 0, rights, nodes_in_rules(rules, "/e"))) == rules
    own = RemoteRights("/e", rules)
    peer = RemoteRights("/p", tuple(graph_rules("/p", 0, rights, profiles)))
    between = RightsBetween((own, peer))
    direct = next(r for r in between.rights_for_others("/p") if r.common_name == "/e")
    obeyed = AccessControl(tuple(between.rights_for_others("/e")))
    for remote in (own, direct):
        control = AccessControl((remote,))
        for announced in ("NN/%e/{}", "MP/%e/{}/%chatter/t/h/q"):
            for node in (*may, *may_not):
                key = f"@ros2_lv/0/z/0/0/{announced.format(node)}"
                assert control.allows("/e", IN, Message.LIVELINESS_TOKEN, key) is (node in may), key
                assert obeyed.allows("/p", OUT, Message.LIVELINESS_TOKEN, key) is (node in may), key
        announcing = ("/e", IN, Message.LIVELINESS_TOKEN)
        passes = partial(control.allows, *announcing)
        assert passes(example_token(0, "/e", control.allowed_keys(*announcing), passes))


def test_a_node_that_the_policy_names_stays_without_services(tmp_path: Path) -> None:
    """Its profile names it, whatever it may offer; ``nodes`` of the ledger have it."""
    denied = '<services reply="DENY"><service>/*</service></services>'
    own = f'<services reply="ALLOW"><service>~/get_parameters</service></services>{denied}'
    named = enclave(tmp_path, publish("/chatter") + own, "/n")
    assert nodes_not_shown(named) == (NodeName("/", "n"),)
    rights = [each.right for each in stated_rights(named)]
    for nodes, may in ((nodes_not_shown(named), True), ((NodeName("/", "m"),), False), ((), False)):
        rules = tuple(graph_rules("/n", 0, rights, nodes))
        assert tuple(graph_rules("/n", 0, rights, nodes_in_rules(rules, "/n"))) == rules
        control = AccessControl((RemoteRights("/n", rules),))
        for announced in ("NN/%n/%/n", "MP/%n/%/n/%chatter/t/h/q"):
            key = f"@ros2_lv/0/z/0/0/{announced}"
            assert control.allows("/n", IN, Message.LIVELINESS_TOKEN, key) is may, (nodes, key)


OF_SEVERAL = {
    # What each enclave may offer (-: denied), and the nodes that several may announce.
    "other nodes": ({"/a": ["/n/*"], "/b": ["/m/*"], "/c": ["/x/n/*"]}, []),
    "the same": ({"/a": OWN["/n"], "/b": OWN["/n"], "/c": OWN["/m"]}, [("/a /b", "", "/n")]),
    "within": ({"/a": ["/n*"], "/b": OWN["/n1"], "/c": OWN["/m"]}, [("/a", "/b", "/n*")]),
    "without": ({"/a": ["/*", "-/n/*"], "/b": OWN["/n"]}, []),
    "not without": ({"/a": ["/*", "-/m/*"], "/b": OWN["/n"]}, [("/a", "/b", "/*")]),
    "denied at the other": ({"/a": ["/n*"], "/b": [*OWN["/n"], "-/n/*"]}, []),
    "wildcards": ({"/a": ["/n/*"], "/b": ["/n*"]}, [("/a", "/b", "/n/*")]),
    "no common part": ({"/a": ["/n/*"], "/b": ["/n*", "-/n/*"]}, []),
    "everything": ({"/a": ["/*"], "/b": ["/*"]}, [("/a /b", "", "/*")]),
    "changing": ({"/a": ["/launch_ros_*"], "/b": ["/launch_ros_*"]}, []),
}


@pytest.mark.parametrize("case", OF_SEVERAL)
def test_nodes_of_several_enclaves(case: str) -> None:
    offered, expected = OF_SEVERAL[case]
    announced = {}
    for path, names in offered.items():
        rights = [
            Right(path, DENY_ if name[0] == "-" else ALLOW, "reply", name.removeprefix("-"))
            for name in names
        ]
        announced[path] = announced_nodes(graph_rules(path, 0, rights, ()), path)
    assert [tuple(map(" ".join, shared)) for shared in shared_nodes(announced)] == expected


@pytest.mark.parametrize("policy", sorted(policies_dir().glob("*.xml")), ids=lambda p: p.stem)
def test_no_node_of_several_enclaves_in_shipped_policies(policy: Path) -> None:
    announced = {
        each.path: announced_nodes(remote_rights(each, 0).rules, each.path)
        for each in read_policy(policy).enclaves
    }
    assert all(nodes.allowed for nodes in announced.values())
    assert not list(shared_nodes(announced))


def test_many_nodes_with_many_names_announce_them_as_any_node() -> None:
    nodes = [NodeName("/", f"n{each}") for each in range(70)]
    names = [f"/x{each}" for each in range(70)]
    stated = [StatedRight(Right("/e", ALLOW, "publish", n), Source("p", 0)) for n in names]
    control = AccessControl((remote_of("/e", {0: stated}, nodes),))
    token = Message.LIVELINESS_TOKEN
    assert control.allows("/e", IN, token, "@ros2_lv/0/z/0/0/MP/%e/%/other/%x1/t/h/q")
    assert not control.allows("/e", IN, token, "@ros2_lv/0/z/0/0/MP/%e/%/n1/%y/t/h/q")
    assert not control.allows("/e", IN, token, "@ros2_lv/0/z/0/0/NN/%e/%/other")
