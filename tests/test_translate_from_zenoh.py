"""Zenoh rules, whoever wrote them, become rights in ROS terms: never more than they allow."""

from __future__ import annotations

import json
import random
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from sros_tool.errors import DocumentError, PolicyError
from sros_tool.files import policies_dir
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.model import ALLOW
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import Rules, join_actions, policy_rights
from sros_tool.translate_zenoh.rights import (
    RightsOfSubject,
    name_of_key,
    policy_of,
    remote_rights,
    rights_of_subjects,
)
from sros_tool.zenoh.access import AccessControl, Flow, Message, Remote
from sros_tool.zenoh.configuration import Configuration, Mode
from sros_tool.zenoh.document import parse_configuration
from tests.support.children import LONG
from tests.support.harness import sros
from tests.support.long_form import some
from tests.support.zenoh_configurations import self_limiting
from tests.test_translate_zenoh import NAMES, TYPE, USES, drawn_enclave

MANY = 500 if LONG else 40
"""How many key expressions a rule may have here: reading back more of them may be refused."""


def behind(document: str) -> tuple[RightsOfSubject, ...]:
    return rights_of_subjects(parse_configuration(document.encode(), "file.json5"))


def rules(*stated: dict[str, Any], mode: str = "router", default: str = "deny") -> str:
    """Rules for one certificate."""
    control = {
        "enabled": True,
        "default_permission": default,
        "rules": [{"id": f"r{n}", "permission": "allow", **each} for n, each in enumerate(stated)],
        "subjects": [{"id": "s", "cert_common_names": ["/talker"]}],
        "policies": [{"rules": [f"r{n}" for n in range(len(stated))], "subjects": ["s"]}],
    }
    return json.dumps({"mode": mode, "access_control": control})


def puts(*keys: str, **more: Any) -> dict[str, Any]:
    return {"messages": ["put"], "flows": ["ingress"], "key_exprs": list(keys), **more}


@pytest.mark.parametrize(
    ("keys", "names", "unsaid"),
    [
        (("0/chatter/*/*",), ["/chatter"], 0),
        (("0/ns/chatter/std_msgs::msg::dds_::String_/RIHS01_00",), [], 1),
        (("0/chatter/**",), ["/chatter", "/chatter/*"], 0),
        (("0/**",), ["/*"], 0),
        (("**",), ["/*"], 0),
        (("0/*/*/*/**",), ["/*"], 0),
        (("0/cam$*/*/*/**",), ["/cam*"], 0),
        (("0/**/$*cam/*/*",), ["/*cam"], 0),
        (("0/a$*b/*/*", "0/a$*/**/$*b/*/*"), ["/a*b"], 0),
        # One part of a name only, which no name of a policy says.
        (("0/a$*b/*/*",), [], 1),
        (("0/*/*/*",), [], 1),
        (("@ros2_lv/0/**", "0/chatter/*/*/@adv/**"), [], 0),
        (("some/key",), [], 1),
        (("demo/**",), [], 1),
        (("demo/chatter/*/*", "00/a/*/*", "0$*/a/*/*"), [], 3),
        (("42/chatter/*/*",), ["/chatter"], 0),
        (("0/a/*/*", "0/a/*/*", "0/a/b/*/*"), ["/a", "/a/b"], 0),
        (("0/*/*/*/**", "0/a/*/*"), ["/*"], 0),
    ],
)
def test_names(keys: tuple[str, ...], names: list[str], unsaid: int) -> None:
    (found,) = behind(rules(puts(*keys)))
    assert [each.name for each in found.rights if each.right == "publish"] == names
    if keys != ("@ros2_lv/0/**", "0/chatter/*/*/@adv/**"):
        assert len(found.unsaid) == unsaid


def test_what_a_right_lacks() -> None:
    (found,) = behind(rules(puts("0/a/*/*")))
    assert found.rights[0].lacks == ("declare_subscriber",)
    back = {"messages": ["declare_subscriber"], "flows": ["egress"], "key_exprs": ["0/a/*/*"]}
    (found,) = behind(rules(puts("0/a/*/*"), back))
    assert found.rights[0].lacks == ()


def test_a_denial_takes_its_names_away() -> None:
    no = puts("0/shutdown/*/*", permission="deny")
    (found,) = behind(rules(puts("0/*/*/*/**", "0/chatter/*/*"), no))
    assert [each.name for each in found.rights] == ["/*/*", "/chatter"]
    assert found.denied == (("publish", "0/shutdown/*/*"),)
    assert found.unsaid == (("publish", "0/*/*/*/**"),)


def test_without_access_control_and_by_default() -> None:
    (found,) = behind('{mode: "peer"}')
    assert (found.names, found.self_limiting) == (None, False)
    assert {(each.right, each.name) for each in found.rights} == {
        (right, "/*") for right in ("publish", "subscribe", "request", "reply")
    }
    (found,) = behind(rules(puts("0/a/*/*", permission="deny"), default="allow"))
    assert found.names == ("/talker",)
    assert "publish" not in {each.right for each in found.rights}


def test_session_files_of_zenoh_security_tools() -> None:
    text = self_limiting(
        publish=["chatter", "rosout"], subscribe=["clock"], request=["add"],
        reply=["talker/get_parameters"], end="/*/*",
    )  # fmt: skip
    router, talker = behind(text)
    assert not router.rights
    assert talker.self_limiting
    assert [(each.right, each.name, each.lacks) for each in talker.rights] == [
        ("publish", "/chatter", ()),
        ("publish", "/rosout", ()),
        ("subscribe", "/clock", ()),
        ("request", "/add", ()),
        ("reply", "/talker/get_parameters", ()),
    ]
    (enclave,) = policy_of(behind(text)).enclaves
    assert enclave.path == "/talker"


@pytest.mark.parametrize(
    "policy", some(sorted(policies_dir().glob("*.xml")), 4), ids=lambda p: p.stem
)
def test_the_shipped_policies_come_back(policy: Path, tmp_path: Path) -> None:
    stated = read_policy(policy)
    remotes = {each.path: remote_rights(each, 0) for each in stated.enclaves}
    written = Configuration(
        Mode.ROUTER, ("tls/a:1",), (), AccessControl(tuple(remotes.values()))
    ).render()
    found = rights_of_subjects(parse_configuration(written, "router.json5"))
    assert not [one for each in found for one in each.rights if one.lacks]
    back = policy_of(found)
    (tmp_path / "back.xml").write_bytes(policy_xml(back))
    assert read_policy(tmp_path / "back.xml") == back
    allowed = {each for each in policy_rights(stated) if each.qualifier is ALLOW}
    whole, came = Rules(allowed), policy_rights(back)
    assert all(whole.cover(each) for each in came)
    denied = {each.enclave for each in policy_rights(stated) if each.qualifier is not ALLOW}
    again = Rules(came)
    missing = {each for each in join_actions(allowed) if not again.cover(each)}
    assert {each.enclave for each in missing} <= denied


def test_random_policies_come_back_without_more_rights() -> None:
    draw, said, allowed = random.Random(15), 0, 0
    for _ in range(3000 if LONG else 30):
        enclave = drawn_enclave(draw)
        try:
            control = AccessControl((remote_rights(enclave, 0),))
        except PolicyError:
            continue
        if any(len(each.key_expressions) > MANY for each in control.remotes[0].rules):
            continue  # denials inside of wildcards
        written = Configuration(Mode.ROUTER, ("tls/a:1",), (), control).render()
        (found,) = rights_of_subjects(parse_configuration(written, "router.json5"))
        for name, (right, use) in product(NAMES, USES.items()):
            told = any(each.right == right and matches(each.name, name) for each in found.rights)
            allows = control.allows("/e", *use, f"0{name}/{TYPE}")
            assert allows or not told, (enclave, right, name)
            said += told
            allowed += allows
    assert said > 0.7 * allowed > (50 if LONG else 15)


def test_random_rules_give_no_more_than_zenoh_decides() -> None:
    """Also with denials, and expressions that sros does not write."""
    draw, told = random.Random(15), 0
    chunks = ["a", "b", "ab", "*", "**", "a$*", "$*b", "T", "h"]
    for _ in range(3000 if LONG else 200):
        stated = []
        for _ in range(draw.randint(1, 4)):
            key = "/".join(draw.choices(chunks, k=draw.randint(1, 4)))
            end = draw.choice(["/*/*", "/**", ""])
            stated.append(
                puts(
                    f"{draw.choice('00*')}/{key}{end}",
                    permission=draw.choice(["allow"] * 3 + ["deny"]),
                )
            )
        try:
            document = parse_configuration(rules(*stated).encode(), "drawn")
        except DocumentError:  # not canonical
            continue
        (found,) = rights_of_subjects(document)
        for name in NAMES:
            if any(each.right == "publish" and matches(each.name, name) for each in found.rights):
                told += 1
                decision = document.access.decide(
                    Remote("/talker"), Flow.INGRESS, Message.PUT, f"0{name}/{TYPE}"
                )
                assert decision.allowed, (stated, name)
    assert told > (200 if LONG else 80)


@pytest.mark.parametrize(
    ("key", "domain", "name"),
    [
        ("0/chatter/t/h", "0", "/chatter"),
        ("3/ns/chatter/t/h/@adv/pub/a1/0/_", "3", "/ns/chatter"),
        ("@ros2_lv/0/**", "@ros2_lv", ""),
        ("0/a/b", "0", ""),
    ],
)
def test_names_of_keys(key: str, domain: str, name: str) -> None:
    assert name_of_key(key) == (domain, name)


# ── the verb ───────────────────────────────────────────────────────────────────────────────


def test_the_verb_says_and_writes_what_it_can(tmp_path: Path) -> None:
    file = tmp_path / "talker.json5"
    file.write_text(self_limiting())
    ended = sros("zenoh", "--from", "talker.json5", "-o", "policy.xml", cwd=tmp_path)
    assert ended.status == 1
    assert ended.out.startswith(
        "talker.json5: the configuration of a session (mode peer)\n"
        "the process itself (talker); no other process enforces these rules\n"
        "  may publish /chatter\n"
        "  may publish /chatter/*\n"
    )
    assert "[zenoh.self-limiting]" in ended.out
    assert "note [zenoh.node-names]" in ended.err
    (enclave,) = read_policy(tmp_path / "policy.xml").enclaves
    assert enclave.path == "/talker"
    refused = sros("zenoh", "--from", "talker.json5", "-o", "policy.xml", cwd=tmp_path)
    assert refused.status == 2


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        ("{", (), "Line 1: it ends too early"),
        ("{}", ("-o", "x.xml"), "everybody who gets a connection, but to no enclave: cert_common_"),
        (rules(puts("demo/**")), ("-o", "x.xml"), "The rules let nobody publish"),
        ("{}", ("--mode", "peer"), "--from takes no keystore"),
    ],
)
def test_the_verb_refuses(text: str, words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    (tmp_path / "file.json5").write_text(text)
    ended = sros("zenoh", "--from", "file.json5", *words, cwd=tmp_path)
    assert ended.status == 2
    assert said in ended.err


def test_rights_of_other_domains_are_noted(tmp_path: Path) -> None:
    (tmp_path / "file.json5").write_text(rules(puts("0/a/*/*", "7/b/*/*")))
    ended = sros("zenoh", "--from", "file.json5", "-o", "x.xml", cwd=tmp_path)
    assert "note [zenoh.domains]: a policy names no domains" in ended.err
    (tmp_path / "file.json5").write_text(rules(puts("0/a/*/*")))
    ended = sros("zenoh", "--from", "file.json5", "-o", "y.xml", cwd=tmp_path)
    assert "zenoh.domains" not in ended.err
    assert (tmp_path / "y.xml").exists()


def test_output_is_for_from_alone(tmp_path: Path) -> None:
    ended = sros("zenoh", tmp_path, "-o", tmp_path / "x")
    assert ended.status == 2
    assert "are for --from only" in ended.err


def test_hostile_names_are_made_visible(tmp_path: Path) -> None:
    document = json.loads(rules(puts("0/\x1b[31mred/*/*")))
    document["access_control"]["subjects"][0]["cert_common_names"] = ["/a\x1b[2J\nmay all"]
    (tmp_path / "file.json5").write_text(json.dumps(document))
    ended = sros("zenoh", "--from", "file.json5", cwd=tmp_path)
    assert "\x1b" not in ended.out + ended.err
    assert "\nmay all" not in ended.out
