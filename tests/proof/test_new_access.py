"""What a change adds, against brute force over short names, and as a user asks for it."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import product
from pathlib import Path
from random import Random

import pytest

from sros_tool.dds.decision.access import AccessVerb
from sros_tool.dds.decision.expressions import matches
from sros_tool.dds.decision.vendors import TESTED, Style
from sros_tool.errors import DocumentError, UsageError
from sros_tool.fleet.fleet_file import read_fleet
from sros_tool.names import DdsNames, dds_names
from sros_tool.policy import rights as policy_rights
from sros_tool.policy.model import Enclave
from sros_tool.policy.rights import PlacedRight, placed_rights
from sros_tool.proof import sources
from sros_tool.proof.growth import Gain, compare_access
from sros_tool.proof.repository import Repository
from sros_tool.proof.sources import load_side
from sros_tool.proof.zenoh_settings import LONE
from tests.checks.bench import Bench, name_of
from tests.proof.drawn_sides import (
    DOMAINS,
    TOPICS,
    VERBS,
    Drawn,
    Side,
    changed,
    draw,
    loosened,
    unknown,
)
from tests.proof.drawn_sides import write as write_side
from tests.support.children import LONG
from tests.support.harness import copy_of, policy_text, publish, sros
from tests.support.long_form import SEED as DRAWN
from tests.support.long_form import some

PAIRS = int(os.environ.get("SROS_PAIRS", "5000" if LONG else "5"))
SEED = os.environ.get("SROS_PAIRS_SEED", "1" if LONG else DRAWN)


Used = tuple[AccessVerb, str]
"""The use of a topic."""


def says(gain: Gain, style: Style, used: Used) -> bool:
    """Return whether a gain stands for the use of a topic, by its right."""
    verb, topic = used
    if gain.right is None:
        return gain.action == ("write" if verb is AccessVerb.PUBLISH else "read")
    if gain.right.kind == "dds":
        return matches(style, gain.right.name, topic)
    names = dds_names(gain.right.right, gain.right.name)
    topics = names.publish if verb is AccessVerb.PUBLISH else names.subscribe
    return any(matches(style, each, topic) for each in topics)


Decide = Callable[..., bool]
USES = tuple(product(VERBS, TOPICS))


def questions(base: Drawn, head: Drawn) -> Iterator[tuple[str, Style, Decide]]:
    """Yield title, style and decision of each world in which a pair is compared."""
    if "zenoh" not in (base.kind, head.kind):
        for vendor in TESTED:
            yield vendor.title, vendor.traits.style, partial(Side.dds, vendor=vendor)
    if base.zenoh or head.zenoh:
        yield "Zenoh", Style.FNMATCH, Side.on_zenoh


@pytest.mark.parametrize(
    ("before", "mux", "web", "lines"),
    [
        ("mux", "mux web", "other", ["/web moves from enclave /web to /mux"]),
        ("mux", "web", "mux", ["/web moves from enclave /web to /mux"]),
        ("mux", "mux web", "web", ["/web is new in enclave /mux"]),
        ("mux", "mux new", "web", ["/new is new in enclave /mux"]),
        ("mux", "new", "web", []),  # may be another name of the node
        ("mux arm_*", "mux arm_* arm_2", "web", []),
        ("mux", "mux", "web mux", []),  # has less there
    ],
)
def test_a_node_that_gets_the_rights_of_another_enclave(
    tmp_path: Path, before: str, mux: str, web: str, lines: list[str]
) -> None:
    """`sros run --policy` starts a node in the enclave to which the policy assigns it."""

    def write(name: str, mux: str, web: str) -> None:
        enclaves = ""
        for path, names, wide in (("/mux", mux, "/*"), ("/web", web, "/status")):
            first, *others = names.split()
            profiles = f'<profile ns="/" node="{first}">{publish(wide)}</profile>'
            for node in others:
                profiles += f'<profile ns="/" node="{node}">{publish("/status")}</profile>'
            enclaves += f'<enclave path="{path}"><profiles>{profiles}</profiles></enclave>'
        text = f'<policy version="0.2.0"><enclaves>{enclaves}</enclaves></policy>'
        (tmp_path / name).write_text(text)

    write("base.xml", before, "web")
    write("head.xml", mux, web)
    ended = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path)
    added = [line for line in ended.out.splitlines() if line.startswith("+")]
    assert [line.partition(", and")[0] for line in added] == [f"+ node {each}" for each in lines]
    assert all("and may publish topic /* there  (head.xml:1)" in line for line in added)
    assert ended.status == bool(lines) and ("1 node is new in an" in ended.err) == bool(lines)


@pytest.mark.parametrize(
    ("deny_in_mux", "others_deny", "found"), [("", "", 1), ("", "/secret", 1), ("/secret", "", 0)]
)
def test_a_node_that_loses_a_denial_in_another_enclave(
    tmp_path: Path, deny_in_mux: str, others_deny: str, found: int
) -> None:
    """Its process may use the name then, though the ALLOW of both enclaves is the same."""

    def node(name: str, denied: str) -> str:
        deny = publish(denied).replace("ALLOW", "DENY") if denied else ""
        return f'<profile ns="/" node="{name}">{publish("/*")}{deny}</profile>'

    def write(file: str, web: str, mux: str) -> None:
        enclaves = (("/web", web), ("/mux", mux))
        text = "".join(
            f'<enclave path="{p}"><profiles>{n}</profiles></enclave>' for p, n in enclaves
        )
        (tmp_path / file).write_text(
            f'<policy version="0.2.0"><enclaves>{text}</enclaves></policy>'
        )

    stays, mux = node("stays", others_deny), node("mux", deny_in_mux)
    write("base.xml", node("moves", "/secret") + stays, mux)
    write("head.xml", stays, mux + node("moves", ""))
    ended = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path)
    assert ended.status == (found or not others_deny), ended.out
    line = "node /moves moves from enclave /web to /mux, and may publish topic /secret there"
    assert (line in ended.out) == bool(found)


def test_a_node_that_moves_on_each_robot_of_a_fleet(tmp_path: Path) -> None:
    """Nodes of other robots may have the same name, such as in domains of their own."""
    (tmp_path / "fleet.toml").write_text("robots = {r1 = {}, r2 = {}}")
    deny = publish("/secret").replace("ALLOW", "DENY")
    moves = f'<profile ns="/" node="moves">{publish("/a")}'
    stays, other = (f'<profile ns="/" node="{n}">{publish("/a")}</profile>' for n in "so")
    for file, web, mux in (
        ("base.xml", f"{stays}{moves}{deny}</profile>", other),
        ("head.xml", stays, f"{other}{moves}</profile>"),
    ):
        enclaves = (("web", web), ("mux", mux))
        text = "".join(
            f'<enclave path="/{{robot}}/{name}"><profiles>{nodes}</profiles></enclave>'
            for name, nodes in enclaves
        )
        (tmp_path / file).write_text(
            f'<policy version="0.2.0"><enclaves>{text}</enclaves></policy>'
        )
    words = ("base.xml", "head.xml", "--fleet", "fleet.toml", "--json")
    found = json.loads(sros("diff_policy", "--no-new-access", *words, cwd=tmp_path).ok().out)
    denials = {(e["denial"]["enclave"], e["moved_from"]) for e in found["dropped_denials"]}
    assert {e for e in denials if e[1]} == {("/r1/mux", "/r1/web"), ("/r2/mux", "/r2/web")}


def test_what_a_moved_node_may_is_compared_with_the_denials_of_other_nodes(tmp_path: Path) -> None:
    """A DENY holds for all nodes of an enclave: a node has what its enclave may."""
    deny = publish("/drive").replace("ALLOW", "DENY")
    own = '<services reply="ALLOW"><service>/nav/get_parameters</service></services>'
    nav, picker = (
        f'<profile ns="/" node="{n}">{publish("/drive")}</profile>' for n in ("nav", "picker")
    )
    nav = nav.replace("</profile>", f"{own}</profile>")
    gripper = f'<profile ns="/" node="gripper">{deny}</profile>'

    def write(file: str, *enclaves: str) -> None:
        text = "".join(
            f'<enclave path="{path}"><profiles>{profiles}</profiles></enclave>'
            for path, profiles in zip(("/arm", "/base"), enclaves, strict=True)
            if profiles
        )
        (tmp_path / file).write_text(
            f'<policy version="0.2.0"><enclaves>{text}</enclaves></policy>'
        )

    write("apart.xml", gripper, nav)
    write("denied.xml", gripper + picker, nav)
    write("freed.xml", gripper, nav + picker)
    write("along.xml", "", nav + gripper)
    ended = sros("diff_policy", "--no-new-access", "denied.xml", "freed.xml", cwd=tmp_path)
    line = "+ node /picker moves from enclave /arm to /base, and may publish topic /drive, "
    assert (ended.status, ended.out) == (
        1, f"{line}reply service /nav/get_parameters there  (freed.xml:1)\n"
    )  # fmt: skip
    ended = sros("diff_policy", "--no-new-access", "apart.xml", "along.xml", cwd=tmp_path)
    assert "publish topic /drive there" not in ended.out
    assert "/gripper moves from enclave /arm to /base, and may reply service /nav" in ended.out


@pytest.mark.parametrize("part", range(8 if LONG else 1))
def test_random_pairs_against_single_questions(tmp_path: Path, part: int) -> None:
    """Policies, keystores, fleets and Zenoh files: what is new is found, and nothing else."""
    seen: Counter[str] = Counter()
    parts = 8 if LONG else 1
    for number in range(part, PAIRS, parts):
        dice = Random(f"{SEED}.{number}")
        base = draw(dice)
        head = changed(base, dice)
        if dice.random() < 0.5:
            base, head = head, base
        seen.update(check_pair(tmp_path / str(number), base, head, f"{SEED}.{number}"))
        shutil.rmtree(tmp_path / str(number))
    print(sorted(seen.items()))
    if LONG:
        assert min(seen[each] for each in ("gain", "none", "less")) > PAIRS // parts // 20


def check_pair(folder: Path, base: Drawn, head: Drawn, name: str) -> Counter[str]:
    """Compare two drawn sides; return how often what was seen."""
    folder.mkdir()
    sides = []
    for each, drawn in (("base", base), ("head", head)):
        path, fleet = write_side(drawn, folder / each)
        sides.append(load_side(path, read_fleet(fleet) if fleet else None))
    of_base, of_head = Side(base, head), Side(head, base)

    def is_new(decide: Decide, enclave: str, domain: int, used: Used) -> bool:
        verb, topic = used
        asked = {"enclave": enclave, "domain": domain, "verb": verb, "topic": topic}
        return decide(of_head, **asked) and not decide(of_base, **asked)

    new = {
        (title, style, enclave): {
            domain: {each for each in USES if is_new(decide, enclave, domain, each)}
            for domain in DOMAINS
        }
        for title, style, decide in questions(base, head)
        for enclave in of_head.enclaves()
    }
    less = loosened(base, head, tuple(Style))
    seen = {f"{base.kind} {head.kind}": 1}
    try:
        growth = compare_access(*sides)
    except DocumentError as error:
        assert unknown(base, head), (name, error)
        assert not any(used for domains in new.values() for used in domains.values()), name
        assert not less, (name, less)
        return Counter({**seen, "not compared": 1})
    assert bool(growth.not_compared) >= unknown(base, head), name
    for (title, style, enclave), domains in new.items():
        gains = [e for e in growth.added if enclave in e.enclaves and title in e.worlds]
        for domain, uses in domains.items():
            # One domain is named of those in which the same is new.
            alike = {each for each in domains if domains[each] == uses} | {*others(gains)}
            for used in uses:
                assert any(alike & {*each.domains} and says(each, style, used) for each in gains), (
                    name, title, enclave, domain, used
                )  # fmt: skip
    decided = {title: decide for title, _, decide in questions(base, head)}
    for gain in growth.added:
        if gain.action == "join":
            continue
        used = (AccessVerb.PUBLISH if writes(gain) else AccessVerb.SUBSCRIBE), gain.topic
        for enclave, title in product(of_head.enclaves() & {*gain.enclaves}, gain.worlds):
            assert any(is_new(decided[title], enclave, each, used) for each in gain.domains), (
                name, title, gain
            )  # fmt: skip
    keys = [each.key for each in growth.lost]
    for each in less:
        assert any(key.startswith(SAID.get(each, f"protection.{each}")) for key in keys) or (
            each == "zenoh" and any("router.json5" in key or LONE in key for key in keys)
        ), (name, less, keys)
    found = [what for what, some in (("gain", growth.added), ("less", growth.lost)) if some]
    return Counter({**seen, **dict.fromkeys(found or ["none"], 1)})


SAID = {
    "signature": "signature of",
    "later": "later enclaves",
    "files": "Zenoh files",
    "protect": "protect ",
    "data or metadata": "protection.",
}
"""How the key begins that says what is protected less, where it is not the attribute."""


def others(gains: Sequence[Gain]) -> Iterator[int]:
    """Yield domains of gains in which nothing was asked."""
    return (domain for each in gains for domain in each.domains if domain not in DOMAINS)


def writes(gain: Gain) -> bool:
    """Return whether the topic of a gain is one that it writes."""
    if gain.right is None or gain.right.kind == "dds":
        return gain.action in ("write", "publish")
    names = dds_names(gain.right.right, gain.right.name)
    return any(matches(Style.FNMATCH, each, gain.topic) for each in names.publish)


POLICY = """<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude">
  <enclaves>
    <enclave path="/web"><profiles><profile ns="/" node="web">
      <topics publish="ALLOW">
        <topic>{}</topic>
      </topics>
      <topics publish="DENY"><topic>/cmd_{}</topic></topics>
    </profile></profiles></enclave>
    <enclave path="/mux"><profiles><profile ns="/" node="mux">
      <topics subscribe="ALLOW"><topic>/web_cmd</topic></topics>
      <topics publish="ALLOW"><topic>/wheels</topic></topics>
    </profile></profiles></enclave>
    <enclave path="/wheels"><profiles><profile ns="/" node="wheels">
      <topics subscribe="ALLOW"><topic>/wheels</topic></topics>{}
    </profile></profiles></enclave>
  </enclaves>
</policy>
"""


def write(folder: Path, name: str, *values: str) -> Path:
    (folder / name).write_text(POLICY.format(*values), encoding="utf-8")
    return folder / name


def test_a_wildcard_that_differs_only_in_names_that_nobody_uses(tmp_path: Path) -> None:
    write(tmp_path, "base.xml", "/log_[a-y]*", "vel", "")
    write(tmp_path, "head.xml", "/log_[a-z]*", "vel", "")
    ended = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path)
    assert ended.status == 1
    assert ended.out == "+ /web publish topic /log_[a-z]*  (head.xml:5): such as /log_z\n"
    back = sros("diff_policy", "--no-new-access", "head.xml", "base.xml", cwd=tmp_path)
    assert back.status == 0
    assert "- /web publish topic /log_[a-z]*  (head.xml:5): such as /log_z" in back.out


def test_the_example_is_a_service_that_not_every_node_has(tmp_path: Path) -> None:
    served = '<services reply="ALLOW"><service>~/home</service></services>'
    served += '<services reply="ALLOW"><service>~/describe_parameters</service></services>'
    asked = '<services request="ALLOW"><service>*</service></services>'
    for name, right in (("base.xml", publish("/x")), ("head.xml", asked)):
        (tmp_path / name).write_text(policy_text({"/arm": served, "/web": right}))
    out = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path).out
    assert re.search(r"/web request service /\*  \(head.xml:\d+\): such as /\w+/home\n", out), out


def test_a_denial_that_is_gone_and_whom_it_lets_be_influenced(tmp_path: Path) -> None:
    write(tmp_path, "base.xml", "/*", "vel", "")
    write(tmp_path, "head.xml", "/*", "other", "")
    out = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path).out
    assert "such as /cmd_vel, which BASE denies by /cmd_vel at base.xml:7" in out
    assert "- /web publish topic /*  (base.xml:5): such as /cmd_other" in out
    write(tmp_path, "base.xml", "/x", "vel", "")
    write(tmp_path, "head.xml", "/web_*", "vel", "")
    ended = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", "--json", cwd=tmp_path)
    value = json.loads(ended.out)
    assert {(each["source"], each["target"]) for each in value["reach"]} == {
        ("/web", "/mux"), ("/web", "/wheels")
    }  # fmt: skip
    assert [len(each["path"]) for each in value["reach"]] == [1, 2]


def test_reach_that_is_not_followed_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, "base.xml", "/x", "vel", "")
    write(tmp_path, "head.xml", "/web_*", "vel", "")
    words = ("diff_policy", "--no-new-access", "base.xml", "head.xml")
    assert "can influence" in sros(*words, cwd=tmp_path).out
    monkeypatch.setattr("sros_tool.proof.growth._MOST_HOPS", 0)
    ended = sros(*words, cwd=tmp_path)
    assert ended.status == 1
    assert "can influence" not in ended.out
    unknown = "on others is unknown now: there are more than 0 hops between enclaves"
    assert unknown in ended.err
    assert unknown in sros(*words, "--format", "markdown", cwd=tmp_path).out
    assert json.loads(sros(*words, "--json", cwd=tmp_path).out)["reach_known"] is False


def test_less_protection_is_found(tmp_path: Path) -> None:
    protected = '<topics publish="ALLOW"><topic>/image{}<?sros protect="{}"?></topic></topics>'
    write(tmp_path, "base.xml", "/x", "vel", protected.format("*", "encrypt"))
    for name, level, told in (("*", "sign", "sign"), ("_left*", "encrypt", "nothing")):
        write(tmp_path, "head.xml", "/x", "vel", protected.format(name, level))
        ended = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path)
        assert ended.status == 1
        assert f"+ less protection: protect topic /image* encrypt -> {told}" in ended.out
    back = sros("diff_policy", "--no-new-access", "head.xml", "base.xml", cwd=tmp_path)
    assert "less protection" not in back.out


def test_less_protection_at_one_of_two_enclaves_is_found(tmp_path: Path) -> None:
    """Users may merge one of the enclaves without the other."""
    tag = "<actions execute='ALLOW'><action>/go{}</action></actions>"
    level, gone = '<?sros protect="{}"?>', "protect action /go of /arm encrypt -> "
    parts = "".join(
        f"<services reply='ALLOW'><service>/go/_action/{name}</service></services>"
        for name in ("send_goal", "cancel_goal", "get_result")
    )
    encrypts = level.format("encrypt")
    other = tag.replace("execute", "call").format(encrypts)
    base = policy_text({"/arm": tag.format(encrypts), "/ui": other})
    (tmp_path / "base.xml").write_text(base)
    for arm, told in (
        (tag.format(""), f"{gone}nothing"),
        (parts, f"{gone}nothing"),
        ("", ""),
        (tag.format(encrypts), ""),
    ):
        (tmp_path / "head.xml").write_text(policy_text({"/arm": arm, "/ui": other}))
        ended = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path)
        assert ended.status == bool(told), ended
        assert told in ended.out and ("less protection" in ended.out) == bool(told), ended.out
        assert ("nothing is protected less" in ended.err) == (not told), ended.err


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    write(folder, "robot.xml", "/log_*", "vel", "")
    sros("create_keystore", "ks", cwd=folder).ok()
    sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", cwd=folder).ok()
    return folder


def test_keystores_and_signed_permissions(made: Path) -> None:
    for one, other in (
        ("ks", "ks"), ("robot.xml", "ks"), ("ks", "robot.xml"), ("ks/enclaves/web", "robot.xml"),
        ("ks/enclaves/web/permissions.p7s", "ks"),
    ):  # fmt: skip
        assert sros("diff_policy", "--no-new-access", one, other, cwd=made).status == 0, (
            one,
            other,
        )
    write(made, "wide.xml", "/*", "vel", "")
    ended = sros("diff_policy", "--no-new-access", "ks/enclaves/web", "wide.xml", cwd=made)
    assert ended.status == 1
    assert ended.out.startswith("+ /web publish topic /*  (wide.xml:5): such as /")


def test_a_governance_that_opens_a_topic(made: Path) -> None:
    shutil.copytree(made / "ks", made / "open")
    rule = "topic /wheels data=NONE read_access_control=false"
    sros("update_keystore", "open", "--rule", rule, "--allow-looser", cwd=made).ok()
    ended = sros("diff_policy", "--no-new-access", "ks", "open", cwd=made)
    assert ended.status == 1
    assert "+ /mux, /web read DDS topic rt/wheels without a right to it\n" in ended.out
    assert "+ less protection: protection.data ENCRYPT -> NONE" in ended.out
    back = sros("diff_policy", "--no-new-access", "open", "ks", cwd=made)
    assert back.status == 0
    assert "- more protection: protection.data NONE -> ENCRYPT" in back.out


def test_an_enclave_that_only_joins_is_new_access(tmp_path: Path) -> None:
    (tmp_path / "before.xml").write_text(policy_text({"/a": publish("/x")}))
    (tmp_path / "after.xml").write_text(policy_text({"/a": publish("/x"), "/new": ""}))
    for words, status in ((("before", "after"), 1), (("after", "before"), 0)):
        files = (f"{word}.xml" for word in words)
        ended = sros("diff_policy", "--no-new-access", *files, cwd=tmp_path)
        assert ended.status == status, ended
        assert ("+ /new join the domain" in ended.out) is bool(status), ended


LOOSER = {
    "topics": ("--rule", "topic /wheels data=NONE metadata=NONE"),
    "writing": ("--rule", "topic /wheels write_access_control=false"),
    "rtps": ("--set", "protection.rtps=NONE"),
    "discovery": ("--set", "protection.discovery=NONE"),
    "liveliness": ("--set", "protection.liveliness=SIGN"),
    "join": ("--set", "protection.join_access_control=false"),
    "unauthenticated": (
        "--set", "protection.rtps=NONE",
        "--set", "protection.allow_unauthenticated_participants=true",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", some([*LOOSER], 3))
def test_a_policy_alone_means_a_strict_governance(made: Path, kind: str) -> None:
    keystore = made / f"looser-{kind}"
    shutil.copytree(made / "ks", keystore)
    change = ("update_keystore", keystore.name, *LOOSER[kind], "--allow-looser")
    sros(*change, cwd=made).ok()
    words = ("diff_policy", "--no-new-access")
    ended = sros(*words, "robot.xml", keystore.name, cwd=made)
    assert ended.status == 1, ended
    assert "+ less protection: protection." in ended.out
    back = sros(*words, keystore.name, "robot.xml", cwd=made)
    assert back.status == 0, back
    assert "- more protection: protection." in back.out
    assert "; assumed: HEAD is signed with a governance that controls all access" in back.err
    strict = sros(*words, "robot.xml", "ks", cwd=made)
    assert strict.status == 0
    assert "nothing is protected less" in strict.err
    assert "; assumed: BASE is signed with a governance that controls all access" in strict.err


def test_what_a_policy_demands_of_a_name_is_asked_of_a_keystore(made: Path) -> None:
    """A policy that demands a signature of a name alone is content with it, and only there."""
    protected = '<topics publish="ALLOW"><topic>/image<?sros protect="{}"?></topic></topics>'
    for level in ("sign", "encrypt"):
        write(made, f"{level}.xml", "/log_*", "vel", protected.format(level))
    words = ("diff_policy", "--no-new-access")
    shutil.copytree(made / "ks", made / "camera")
    sros("generate_artifacts", "-k", "camera", "-p", "sign.xml", cwd=made).ok()
    signs = ("--rule", "topic /image data=NONE metadata=SIGN", "--allow-looser")
    sros("update_keystore", "camera", *signs, cwd=made).ok()
    assert sros(*words, "sign.xml", "camera", cwd=made).status == 0
    assert sros(*words, "camera", "sign.xml", cwd=made).status == 0
    ended = sros(*words, "encrypt.xml", "camera", cwd=made)
    assert ended.status == 1
    assert "DDS topic rt/image: no longer encrypted" in ended.out


def test_protection_that_contradicts_itself_is_not_compared(tmp_path: Path) -> None:
    """Two lines of HEAD that demand different protection of a name demand nothing certain."""
    line = '<topics publish="ALLOW"><topic>/image{}<?sros protect="{}"?></topic></topics>'
    write(tmp_path, "base.xml", "/x", "vel", line.format("*", "encrypt"))
    both = line.format("*", "encrypt") + line.format("_left", "sign")
    write(tmp_path, "head.xml", "/x", "vel", both)
    words = ("diff_policy", "--no-new-access")
    ended = sros(*words, "base.xml", "head.xml", cwd=tmp_path)
    assert ended.status == 2, ended
    assert 'head.xml:14: topic /image_left has protect="sign"' in ended.err
    assert "nobody gets more access" not in ended.err
    write(tmp_path, "more.xml", "/y", "vel", both)
    ended = sros(*words, "base.xml", "more.xml", cwd=tmp_path)
    assert ended.status == 1
    assert "not compared: HEAD contradicts itself" in ended.err
    assert sros(*words, "head.xml", "base.xml", cwd=tmp_path).status == 0


def test_a_signature_that_does_not_verify_is_not_compared(made: Path) -> None:
    broken = made / "broken"
    broken.mkdir()
    source = made / "ks" / "enclaves" / "web"
    for name in ("permissions.p7s", "permissions_ca.cert.pem"):
        (broken / name).write_bytes((source / name).read_bytes())
    content = (broken / "permissions.p7s").read_bytes()
    (broken / "permissions.p7s").write_bytes(content.replace(b"rt/log_*", b"rt/lag_*"))
    ended = sros("diff_policy", "--no-new-access", "broken", "robot.xml", cwd=made)
    assert ended.status == 2
    assert "cannot be compared" in ended.err


# ── revisions ──────────────────────────────────────────────────────────────────────────────


def git(folder: Path, *words: str) -> str:
    person = {f"GIT_{who}_{what}": "x@x" for who in ("AUTHOR", "COMMITTER")
              for what in ("NAME", "EMAIL")}  # fmt: skip
    nobody = {"GIT_CONFIG_GLOBAL": "/dev/null", "GIT_CONFIG_NOSYSTEM": "1"}
    done = subprocess.run(
        ["git", "-C", str(folder), *words],
        env={**os.environ, **person, **nobody},
        capture_output=True,
        check=True,
    )
    return done.stdout.decode()


INCLUDE = '<xi:include href="common/more.xml" xpointer="xpointer(/profile/*)"/>'
MORE = '<profile ns="/" node="x"><topics publish="ALLOW"><topic>{}</topic></topics></profile>'


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    git(tmp_path, "init", "-q", "-b", "main")
    (tmp_path / "policies" / "common").mkdir(parents=True)
    write(tmp_path / "policies", "robot.xml", "/x", "vel", INCLUDE)
    (tmp_path / "policies" / "common" / "more.xml").write_text(MORE.format("/a"))
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-q", "-m", "first")
    return tmp_path


def test_a_revision_is_read_with_its_own_includes(repository: Path) -> None:
    words = ("diff_policy", "--no-new-access", "git:main:policies/robot.xml")
    assert sros(*words, "policies/robot.xml", cwd=repository).status == 0
    (repository / "policies" / "common" / "more.xml").write_text(MORE.format("/b"))
    ended = sros(*words, "policies/robot.xml", cwd=repository)
    assert ended.status == 1
    more = repository / "policies" / "common" / "more.xml"
    assert f"+ /wheels publish topic /b  ({more}:1)\n" in ended.out
    assert "- /wheels publish topic /a  (git:main:policies/common/more.xml:1)\n" in ended.out
    below = repository / "policies"
    same = sros("diff_policy", "--no-new-access", "git:HEAD:./robot.xml", "git:main:policies",
                cwd=below)  # fmt: skip
    assert same.status == 0, same.err


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("git:nothing:policies/robot.xml", "finds no revision 'nothing'"),
        ("git:--output=x:policies/robot.xml", "finds no revision '--output=x'"),
        ("git:main:policies/none.xml", "does not exist"),
        ("git:main:../robot.xml", "outside of the repository"),
        ("git:main", "does not name a policy at a git revision"),
        ("git::robot.xml", "does not name a policy at a git revision"),
        ("git:main:policies/link.xml", "is a symbolic link"),
        ("git:main:policies/fallback.xml", "is a symbolic link"),
        ("git:main:policies/through.xml", "is not a folder in the commit"),
        ("git:main:policies/away.xml", "leaves the folder of the policy"),
    ],
)
def test_revisions_that_cannot_be_read(repository: Path, what: str, said: str) -> None:
    (repository / "policies" / "link.xml").symlink_to("robot.xml")
    (repository / "policies" / "more.xml").symlink_to("common/more.xml")
    (repository / "policies" / "linked").symlink_to("common")
    for name, there in (("fallback", "more.xml"), ("through", "linked/more.xml")):
        # On disk they give rights, so that a fallback without any would hide them.
        other = INCLUDE.replace("common/more.xml", there).replace(
            "/>", "><xi:fallback/></xi:include>"
        )
        write(repository / "policies", f"{name}.xml", "/x", "vel", other)
    away = INCLUDE.replace("common/more.xml", "../../etc/passwd")
    write(repository / "policies", "away.xml", "/x", "vel", away)
    git(repository, "add", "-A")
    git(repository, "commit", "-q", "-m", "second")
    words = ("diff_policy", "--no-new-access", what, "policies/robot.xml")
    ended = sros(*words, cwd=repository)
    assert ended.status == 2
    assert said in ended.err
    assert "/dev/null" not in ended.err
    assert not (repository / "x").exists()


def test_nothing_that_a_repository_configures_is_run(repository: Path) -> None:
    trap = repository / "trap"
    trap.write_text(f"#!/bin/sh\ntouch {repository}/sprung\ncat\n")
    trap.chmod(0o755)
    for key in ("core.fsmonitor", "core.pager", "diff.x.textconv", "filter.x.smudge", "core.editor",
                "filter.x.process", "core.sshCommand", "gpg.program", "credential.helper",
                "remote.origin.uploadpack"):  # fmt: skip
        git(repository, "config", key, str(trap))
    git(repository, "config", "remote.origin.url", str(repository))
    git(repository, "config", "remote.origin.promisor", "true")
    git(repository, "config", "extensions.partialClone", "origin")
    (repository / ".gitattributes").write_text("*.xml diff=x filter=x\n")
    for each in ("post-checkout", "reference-transaction", "post-index-change"):
        (repository / ".git" / "hooks" / each).write_bytes(trap.read_bytes())
        (repository / ".git" / "hooks" / each).chmod(0o755)
    sides = ("git:main:policies/robot.xml", "policies/robot.xml")
    assert sros("diff_policy", "--no-new-access", *sides, cwd=repository).status == 0
    assert not (repository / "sprung").exists()
    # With an object that is missing, git would ask the remote for it.
    write(repository / "policies", "robot.xml", "/x", "other", INCLUDE)
    git(repository, "-c", "filter.x.smudge=", "-c", "filter.x.process=", "commit", "-q", "-a",
        "--no-verify", "-m", "second")  # fmt: skip
    (repository / "sprung").unlink(missing_ok=True)
    blob = git(repository, "rev-parse", "HEAD:policies/robot.xml").strip()
    missing = repository / ".git" / "objects" / blob[:2] / blob[2:]
    missing.rename(repository / "kept")
    assert sros("diff_policy", "--no-new-access", *sides, cwd=repository).status == 2
    assert not (repository / "sprung").exists()


def test_a_path_of_a_revision_is_from_its_top(repository: Path) -> None:
    words = ("diff_policy", "--no-new-access", "git:main:robot.xml", "robot.xml")
    ended = sros(*words, cwd=repository / "policies")
    assert ended.status == 2
    assert "'git:main:robot.xml' does not exist. A path starts at the top of the" in ended.err


@pytest.mark.parametrize("name", ["robots/evil.xml", "evil.XML", "robots/evil.inc", "robots/link"])
def test_a_folder_of_a_revision_is_read_whole(name: str, repository: Path) -> None:
    """Policies below the folder, and under another ending, were left out without a word."""
    words = ("diff_policy", "--no-new-access", "git:main~1:policies", "git:main:policies")
    evil = repository / "policies" / name
    evil.parent.mkdir(exist_ok=True)
    if evil.name == "link":
        evil.symlink_to("../../elsewhere")
    else:
        evil.write_text(policy_text({"/evil": publish("/cmd_vel")}))
    git(repository, "add", "-A")
    git(repository, "commit", "-q", "-m", "more")
    ended = sros(*words, cwd=repository)
    known = evil.suffix.lower() == ".xml"
    assert ended.status == (1 if known else 2)
    assert ("/evil" if known else f"git:main:policies/{name}' ") in ended.out + ended.err


def test_a_folder_of_too_many_policies_is_refused(repository: Path) -> None:
    for each in range(301):
        (repository / "policies" / f"more{each}.xml").write_text("<policy version='0.2.0'/>")
    git(repository, "add", "-A")
    git(repository, "commit", "-q", "-m", "many")
    words = ("diff_policy", "--no-new-access")
    ended = sros(*words, "git:main~1:policies", "git:main:policies", cwd=repository)
    assert ended.status == 2
    assert "'git:main:policies' has more than 300 policies" in ended.err


def test_a_git_that_fails_without_a_word_is_no_missing_file(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = shutil.which("git")
    fake = repository / "bin" / "git"
    fake.parent.mkdir()
    fake.write_text(f'#!/bin/sh\ncase "$*" in *cat-file*) exit 9;; esac\nexec {real} "$@"\n')
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{fake.parent}:{os.environ['PATH']}")
    sides = ("git:main:policies/robot.xml", "policies/robot.xml")
    ended = sros("diff_policy", "--no-new-access", *sides, cwd=repository)
    assert ended.status == 2
    assert "git failed: exit status 9" in ended.err


# ── fleets ─────────────────────────────────────────────────────────────────────────────────


FLEET_POLICY = """<policy version="0.2.0"><enclaves>
<enclave path="/{robot}/base"><profiles><profile ns="{namespace}" node="base">
<topics publish="ALLOW"><topic>status</topic></topics></profile></profiles></enclave>
<enclave path="/desk"><profiles><profile ns="/" node="desk">
<topics subscribe="ALLOW"><topic>/r1/status</topic></topics></profile></profiles></enclave>
</enclaves></policy>"""
ROBOTS = '[robots.r1]\nnamespace = "/r1"\n{}\n[robots.r2]\nnamespace = "/r2"\n'


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy, fleets whose robot r1 is in another domain, and a keystore with domains 0 and 7."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "fleet.xml").write_text(FLEET_POLICY)
    for name, line in (("any", ""), ("seven", "domain = 7"), ("eight", "domain = 8")):
        (folder / f"{name}.toml").write_text(ROBOTS.format(line))
    more = "domain = 7\n[robots.r3]"  # r3 has no domain
    (folder / "r3.toml").write_text(ROBOTS.format(more))
    sros("create_keystore", "ks", cwd=folder, env={"ROS_DOMAIN_ID": None}).ok()
    sros("update_keystore", "ks", "--domain", "0,7", "--allow-looser", cwd=folder).ok()
    made = ("generate_artifacts", "-k", "ks", "-p", "fleet.xml", "--fleet", "seven.toml")
    sros(*made, cwd=folder).ok()
    return folder


@pytest.mark.parametrize(
    ("base", "head", "status", "said"),
    some(
        [
            (
                "seven",
                "eight",
                1,
                "+ /r1/base publish topic /r1/status  (fleet.xml:3); in domain 8\n",
            ),
            (
                "seven",
                "any",
                1,
                "+ /r1/base publish topic /r1/status  (fleet.xml:3); in every domain except 7\n",
            ),
            (
                "any",
                "seven",
                0,
                "- /r1/base publish topic /r1/status  (fleet.xml:3); in every domain except 7\n",
            ),
            ("seven", "r3", 1, "+ /r3/base publish topic /r3/status  (fleet.xml:3)\n"),
            ("seven", "seven", 0, ""),
            ("ks", "seven", 0, ""),
            ("seven", "ks", 0, ""),
            ("ks", "any", 1, "+ /r1/base publish topic /r1/status  (fleet.xml:3); in domain 0\n"),
            ("ks", "eight", 1, "+ /desk subscribe topic /r1/status  (fleet.xml:5); in domain 8\n"),
            ("any", "ks", 0, "- /r1/base publish topic /r1/status  (fleet.xml:3); in domain 0\n"),
        ],
        4,
    ),
)
def test_the_domains_of_robots_are_compared(
    fleet: Path, base: str, head: str, status: int, said: str
) -> None:
    sides = ["ks" if each == "ks" else "fleet.xml" for each in (base, head)]
    files = [f"{each}.toml" for each in (base, head) if each != "ks"]
    words = [word for each in files for word in ("--fleet", each)]
    ended = sros("diff_policy", "--no-new-access", *sides, *words, cwd=fleet)
    assert ended.status == status, ended
    assert (said in ended.out) if said else not ended.out


def test_a_fleet_in_another_domain_is_said_when_it_is_signed(fleet: Path) -> None:
    """What was signed for the domain of before works on, and that is said."""
    root = fleet / "moved"
    shutil.copytree(fleet / "ks", root)
    words = ("generate_artifacts", "-k", "moved", "-p", "fleet.xml", "--fleet", "any.toml")
    ended = sros(*words, cwd=fleet).ok()
    assert "replaced the permissions of enclave /r1/base" in ended.out
    assert "same rights" not in ended.out
    assert "/r1/base gains: domain 0" in ended.err
    words = ("generate_artifacts", "-k", "moved", "-p", "fleet.xml", "--fleet", "seven.toml")
    ended = sros(*words, cwd=fleet).ok()
    assert "same rights" not in ended.out
    assert "/r1/base loses: domain 0" in ended.err
    assert "/r1/base: the rights that it lost still work until" in ended.err
    rights = json.loads(sros(*words[:-1], "any.toml", "--dry-run", "--json", cwd=fleet).out)
    assert [each["gained_domains"] for each in rights["rights"]] == ["0"]


NAMED = """<policy version="0.2.0"><enclaves>{}</enclaves></policy>"""
SENDER = """<enclave path="{}"><profiles><profile ns="/" node="n">
  <topics publish="ALLOW"><topic>{}</topic></topics></profile></profiles></enclave>"""


def test_an_enclave_whose_subject_fits_the_permissions_of_another_one(tmp_path: Path) -> None:
    """Cyclone DDS takes the permissions of /robot/mux for those of /mux: a new /mux has them."""
    old, new = SENDER.format("/robot/mux", "cmd_vel"), SENDER.format("/mux", "log")
    for name, text in (("base.xml", old), ("head.xml", old + new)):
        (tmp_path / name).write_text(NAMED.format(text), encoding="utf-8")
    ended = sros("diff_policy", "--no-new-access", "base.xml", "head.xml", cwd=tmp_path)
    assert ended.status == 1
    (line,) = [each for each in ended.out.splitlines() if "/robot/mux" in each]
    assert line == (
        "+ /mux publish topic /cmd_vel  (head.xml:2) (by the permissions of /robot/mux, which fit "
        "the certificate of /mux, too); with Cyclone DDS"
    )
    back = compare_access(*(load_side(tmp_path / each) for each in ("head.xml", "base.xml")))
    assert not back.added


@pytest.fixture(scope="module")
def lent(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A keystore with unique subjects, of /mux and of /robot/mux, which commands /wheels."""
    folder = tmp_path_factory.mktemp("lent")
    reader = SENDER.format("/wheels", "odom").replace(
        "</profile>", '<topics subscribe="ALLOW"><topic>cmd_vel</topic></topics></profile>'
    )
    text = SENDER.format("/robot/mux", "cmd_vel") + SENDER.format("/mux", "log") + reader
    (folder / "robot.xml").write_text(NAMED.format(text), encoding="utf-8")
    sros("create_keystore", "base", "--template", "production", cwd=folder).ok()
    sros("generate_artifacts", "-k", "base", "-p", "robot.xml", cwd=folder).ok()
    return Bench(folder / "base", datetime.now(UTC))


def test_a_certificate_that_fits_the_permissions_of_another_one(lent: Bench) -> None:
    """The subject of a grant cannot hide whose permissions fit the certificate."""
    head = Bench(lent.root.with_name("head"), lent.now)
    copy_of(lent.root, head.root)
    head.issue("mux", subject=name_of(("CN", "/mux")))
    head.permissions(("CN=/mux<", "CN=/mux,,x<"), name="mux")
    words = ("diff_policy", "--no-new-access", "base", "head")
    ended = sros(*words, cwd=head.root.parent)
    assert ended.status == 1
    assert (
        "+ /mux publish topic /cmd_vel (by the permissions of /robot/mux, which fit the "
        "certificate of /mux, too); with Cyclone DDS\n" in ended.out
    )
    reach = json.loads(sros(*words, "--json", cwd=head.root.parent).out)["reach"]
    assert [(each["source"], each["target"]) for each in reach] == [("/mux", "/wheels")]


def test_a_certificate_that_does_not_fit_its_own_permissions_is_said(lent: Bench) -> None:
    odd = Bench(lent.root.with_name("odd"), lent.now)
    copy_of(lent.root, odd.root)
    odd.issue("mux", subject=name_of(("CN", "/mux")))
    odd.permissions(("CN=/mux<", "CN=/mux,OU=1<"), name="mux")
    for sides, status in ((("base", "odd"), 1), (("odd", "base"), 2)):
        ended = sros("diff_policy", "--no-new-access", *sides, cwd=odd.root.parent)
        assert ended.status == status
        assert "the permissions of /mux in 'odd' do not fit its certificate" in ended.err
        assert ("+ /mux publish topic /cmd_vel (by the permissions" in ended.out) is (status == 1)


def test_whom_borrowed_permissions_let_an_enclave_influence(tmp_path: Path) -> None:
    """A denial of its own does not count there: the other permissions are loaded in their place."""
    reader = SENDER.format("/wheels", "odom").replace(
        "</profile>", '<topics subscribe="ALLOW"><topic>cmd_vel</topic></topics></profile>'
    )
    old = SENDER.format("/robot/mux", "cmd_vel") + reader
    new = SENDER.format("/mux", "log").replace(
        "</profile>", '<topics publish="DENY"><topic>cmd_vel</topic></topics></profile>'
    )
    for name, text in (("base.xml", old), ("head.xml", old + new)):
        (tmp_path / name).write_text(NAMED.format(text), encoding="utf-8")
    words = ("diff_policy", "--no-new-access", "base.xml", "head.xml", "--json")
    reach = json.loads(sros(*words, cwd=tmp_path).out)["reach"]
    assert [(each["source"], each["target"]) for each in reach] == [("/mux", "/wheels")]


def test_the_work_grows_with_the_number_of_new_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tens of thousands of names take seconds: the place of a right is looked up once."""
    base, head = tmp_path / "base.xml", tmp_path / "head.xml"
    topics = "</topic><topic>".join(f"t{number}" for number in range(100))
    base.write_text(NAMED.format(SENDER.format("/a", "x")), encoding="utf-8")
    head.write_text(NAMED.format(SENDER.format("/a", f"x</topic><topic>{topics}")), "utf-8")
    sides = load_side(base), load_side(head)
    asked: list[str] = []

    def counted(enclave: Enclave) -> Iterator[PlacedRight]:
        for placed in placed_rights(enclave):
            asked.append(placed.written)
            yield placed

    monkeypatch.setattr(sources, "placed_rights", counted)
    added = compare_access(*sides).added
    assert len(added) == 100
    assert all(each.source and each.source.line == 2 for each in added)
    assert len(asked) < 300


def test_the_work_grows_with_the_number_of_denials_that_are_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not every name is compared with every denial."""
    names = [f"/t{number}" for number in range(200)]
    denied = publish(*names).replace("ALLOW", "DENY")
    for name, rights in (("base", publish("/x") + denied), ("head", publish("/x", *names))):
        (tmp_path / f"{name}.xml").write_text(policy_text({"/a": rights}))
    sides = [load_side(tmp_path / f"{name}.xml") for name in ("base", "head")]
    asked: list[str] = []

    def topics(right: str, name: str) -> DdsNames:
        asked.append(name)
        return dds_names(right, name)

    monkeypatch.setattr(policy_rights, "dds_names", topics)
    added = compare_access(*sides).added
    assert len(added) == 200
    assert all(each.denied and each.denied.name == each.name for each in added)
    assert len(asked) < 20 * 200


@pytest.mark.parametrize("name", ["HOME", "XDG_CONFIG_HOME", "GIT_CONFIG_GLOBAL"])
def test_nothing_is_fetched_with_settings_from_the_work_tree(
    repository: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A .gitconfig of a pull request could name a program that a fetch runs."""
    git(repository, "remote", "add", "origin", "ext::true")
    monkeypatch.setenv(name, str(repository / "home"))
    with pytest.raises(UsageError, match=f"{name} is '.*/home', inside of the work tree"):
        Repository(repository).fetch_missing("0" * 40, "origin")
    monkeypatch.setenv(name, str(repository.parent / "home"))
    with pytest.raises(DocumentError, match="not allowed"):
        Repository(repository).fetch_missing("0" * 40, "origin")


def test_an_export_is_compared_in_its_enclaves(keystore: Path, tmp_path: Path) -> None:
    robot, policy = tmp_path / "robot", tmp_path / "robot.xml"
    sros("distribute_key", keystore, "/a", robot).ok()
    readers = f"{publish('old_b')}{publish('old_a').replace('publish', 'subscribe')}"
    policy.write_text(policy_text({"/a": publish("old_a"), "/b": readers}))
    (robot / "private").mkdir()  # without keys, it is still an export
    same = sros("diff_policy", policy, robot).ok()
    assert (same.out, same.err) == ("", "the rights of /a are the same\n")
    drawn = json.loads(sros("view", policy, robot, "--json").ok().out)
    assert [each["path"] for each in drawn["enclaves"]] == ["/a"]
    for other, lacks in ((policy, True), (keystore, True), (robot / "enclaves" / "a", False)):
        nothing = sros("diff_policy", "--no-new-access", robot, other).ok()
        assert ("enclaves that BASE does not have" in nothing.err) is lacks
        sros("diff_policy", "--no-new-access", other, robot).ok()
    policy.write_text(policy_text({"/a": publish("old_a", "more")}))
    assert sros("diff_policy", "--no-new-access", robot, policy).out.startswith("+ /a publish")
    sros("distribute_key", keystore, "--all", tmp_path / "more").ok()
    assert sros("diff_policy", "--no-new-access", robot, tmp_path / "more").status == 1
    (session := robot / "enclaves" / "a" / "session.json5").write_text("{}")
    lacking = sros("diff_policy", "--no-new-access", robot, policy)
    assert lacking.status == 2 and "it has Zenoh files, but not router.json5" in lacking.err
    session.unlink()
    (governance := robot / "enclaves" / "a" / "governance.p7s").write_text("damaged")
    damaged = sros("diff_policy", "--no-new-access", robot, policy)
    assert damaged.status == 2 and f"'{governance}' cannot be used: it is not an" in damaged.err
    governance.unlink()
    lacking = sros("diff_policy", "--no-new-access", robot, policy)
    assert lacking.status == 2 and "governance.p7s' does not exist" in lacking.err
