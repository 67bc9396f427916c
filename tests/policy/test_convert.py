"""Converting policies of version 0.1.0: the same rights, or a reason."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from lxml import etree

from sros_tool.dds.domains import DomainSet
from sros_tool.errors import PolicyError
from sros_tool.policy.document import convert_policy, read_policy
from sros_tool.policy.model import Policy
from sros_tool.policy.rights import policy_rights
from sros_tool.translate import permissions_for
from sros_tool.validity import Window
from tests.policy.earlier_policies import EARLIER, FRAGMENTS, PRESENT, policies
from tests.support.harness import sros
from tests.support.long_form import some

Topics = dict[str, set[tuple[str, str, str]]]
"""Each enclave's DDS topics, with ALLOW or DENY and publish or subscribe."""

_SERVICE = {"request": ("rq", "rr"), "reply": ("rr", "rq")}
_ENDS = {"rq": "Request", "rr": "Reply"}


def _files(folder: Path, text: str) -> Path:
    for name, content in FRAGMENTS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    file = folder / "old.xml"
    file.write_text(text)
    return file


def _read_independently(file: Path) -> Topics:
    """Return what ros2/sros2 signs for a policy, read with libxml2's own XInclude.

    Of Dashing's stylesheet this follows the rules for names, with the slash of Eloquent in place of
    the doubled one.
    """
    tree: Any = etree.parse(str(file))
    tree.xinclude()
    found: Topics = defaultdict(set)
    for profile in tree.iter("profile"):
        parent = profile.getparent().getparent()
        at = profile.get("ns").rstrip("/") + "/"
        name = parent.get("path") or at + profile.get("node")
        found[name] |= {
            (qualifier, way, topic)
            for group in profile
            for right, qualifier in group.attrib.items()
            if right in ("publish", "subscribe", "request", "reply", "call", "execute")
            for item in group
            for way, topic in _signed(right, _full(item.text, at, profile.get("node")))
        }
    return found


def _full(name: str, at: str, node: str) -> str:
    if name[0] == "~":
        return f"{at}{node}/{name[1:].lstrip('/')}"
    return name if name[0] == "/" else at + name


def _signed(right: str, name: str) -> set[tuple[str, str]]:
    if right in ("publish", "subscribe"):
        return {(right, f"rt{name}")}
    if right in _SERVICE:
        written, read = _SERVICE[right]
        topics = {"publish": written, "subscribe": read}
        return {(way, f"{start}{name}{_ENDS[start]}") for way, start in topics.items()}
    service, topic = ("request", "subscribe") if right == "call" else ("reply", "publish")
    inside = f"{name}/_action/"
    return {
        pair
        for part in ("send_goal", "cancel_goal", "get_result")
        for pair in _signed(service, inside + part)
    } | {(topic, f"rt{inside}{part}") for part in ("feedback", "status")}


def _signed_by_sros(policy: Policy, window: Window) -> Topics:
    found: Topics = {}
    for enclave in policy.enclaves:
        domains = DomainSet.of((0, 0))
        permissions = permissions_for(enclave, subject="CN=x", validity=window, domains=domains)
        found[enclave.path] = {
            ("ALLOW" if rule.allow else "DENY", way, topic)
            for rule in permissions.grants[0].rules
            for way in ("publish", "subscribe")
            for criteria in getattr(rule, way)
            for topic in criteria.topics
            if topic != "ros_discovery_info"
        }
    return found


@pytest.mark.parametrize(
    ("name", "text"), some([*policies(EARLIER)], 12), ids=lambda value: str(value)[:30]
)
def test_an_earlier_policy_is_recognized_and_keeps_its_rights(
    name: str, text: str, tmp_path: Path, any_time: Window
) -> None:
    old, new = _files(tmp_path, text), tmp_path / "new.xml"
    refusal = sros("check", "policy", old)
    assert refusal.status == 1 and f"sros policies --convert {old} -o" in refusal.out
    sros("policies", "--convert", old, "-o", new).ok()
    assert _signed_by_sros(read_policy(new), any_time) == _read_independently(old)
    assert "policy.malformed" not in sros("check", "policy", new).out


@pytest.mark.parametrize(("name", "text"), [*policies(PRESENT)], ids=lambda value: str(value)[:30])
def test_a_present_policy_has_its_rights_and_needs_no_conversion(
    name: str, text: str, tmp_path: Path, any_time: Window
) -> None:
    file = _files(tmp_path, text)
    assert _signed_by_sros(read_policy(file), any_time) == _read_independently(file)
    ended = sros("policies", "--convert", file)
    assert ended.status and "nothing to convert" in ended.err


def test_there_are_fifty() -> None:
    assert len([*policies(EARLIER), *policies(PRESENT)]) >= 50


LEFT_OUT = {
    "two profiles of a node": ('<profile ns="/" node="a"><topics publish="ALLOW"><topic>x</topic>'
                               "</topics></profile>", "the node /a, too"),
    "a wildcard as namespace": ('<profile ns="/*" node="b"/>', "'/*/b' cannot be the name"),
    "a wildcard as node": ('<profile ns="/" node="b*"/>', "'/b*' cannot be the name"),
    "a name that is too long": (f'<profile ns="/{"n" * 60}" node="node"/>', "at most 64"),
    "a profile without a node": ('<profile ns="/" node=""/>', "cannot be the name"),
}  # fmt: skip


@pytest.mark.parametrize("case", LEFT_OUT)
def test_what_cannot_be_an_enclave_is_left_out_and_said(case: str, tmp_path: Path) -> None:
    profile, reason = LEFT_OUT[case]
    first = '<profile ns="/" node="a"><topics subscribe="ALLOW"><topic>y</topic></topics></profile>'
    body = f"<profiles>{first}\n{profile}</profiles>"
    old, new = _files(tmp_path, f'<policy version="0.1.0">{body}</policy>'), tmp_path / "new.xml"
    ended = sros("policies", "--convert", old, "-o", new)
    assert ended.status == 1
    assert f"left out: {old}:2: " in ended.err and reason in ended.err
    (enclave,) = read_policy(new).enclaves
    assert enclave.path == "/a" and "subscribe" in str(enclave)
    old.write_text(f'<policy version="0.1.0"><profiles>{first}</profiles></policy>')
    sros("policies", "--convert", old, "-o", new, "--force").ok()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('<policy version="0.1.0"/>', "contains nothing"),
        ('<policy version="0.1.0"><profiles/></policy>', "no enclave"),
        ('<policy version="0.1.0"><profiles><profile ns="/*" node="x"/></profiles></policy>',
         "nothing in"),
        ('<policy version="0.1.0"><profiles><profile ns="/" node="x"><topics publish="DENY">'
         "<topic>a b</topic></topics></profile></profiles></policy>", "not a valid topic name"),
        ('<profile/>', "not a policy"),
    ],
)  # fmt: skip
def test_what_is_broken_is_refused(text: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=reason):
        convert_policy(_files(tmp_path, text))


def test_the_result_in_each_form(tmp_path: Path) -> None:
    _, text = next(policies(EARLIER))
    old, new = _files(tmp_path, text), tmp_path / "new.xml"
    assert "would write" in sros("policies", "--convert", old, "-o", new, "--dry-run").ok().out
    assert not new.exists()
    printed = sros("policies", "--convert", old).ok().out
    value = json.loads(sros("policies", "--convert", old, "--json").ok().out)
    assert value["document"] == printed and value["enclaves"] == ["/gauge", "/display"]
    sros("policies", "--convert", old, "-o", new).ok()
    assert new.read_text() == printed
    assert "already exists" in sros("policies", "--convert", old, "-o", new).err
    for wrong in (("-o", new), ("--copy", "x", "--convert", old), ("--force",)):
        assert sros("policies", *wrong, cwd=tmp_path).status == 2


@pytest.fixture
def any_time() -> Window:
    from datetime import UTC, datetime

    return Window(datetime(2026, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC))


_ALONE = """<profiles>
  <profile ns="/arm" node="talker"><topics publish="ALLOW"><topic>chatter</topic></topics></profile>
  <profile ns="/" node="listener">
    <topics subscribe="ALLOW"><topic>/arm/chatter</topic></topics>
    <topics publish="ALLOW"><topic>/rosout</topic></topics>
  </profile>
</profiles>"""


def test_profiles_without_a_policy_around_them(tmp_path: Path) -> None:
    old, new = _files(tmp_path, _ALONE), tmp_path / "new.xml"
    for verb in (("check", "policy", old), ("diff_policy", old, old)):
        ended = sros(*verb)
        assert f"sros policies --convert {old} -o" in ended.out + ended.err
    sros("policies", "--convert", old, "-o", new).ok()
    assert [each.path for each in read_policy(new).enclaves] == ["/arm/talker", "/listener"]


def test_what_every_node_needs_is_added_on_request(tmp_path: Path) -> None:
    old, new = _files(tmp_path, _ALONE), tmp_path / "new.xml"
    said = sros("policies", "--convert", old, "-o", new).ok().err
    before = policy_rights(read_policy(new))
    assert sros("check", "policy", new).status == 1
    (command,) = re.findall(r"`sros (policies --convert [^`]*)`", said)
    sros(*command.split()).ok()
    assert "nothing found" in sros("check", "policy", new).ok().err
    assert before < policy_rights(read_policy(new))
    assert new.read_text().count("/rosout") == 2, "what a profile has is not added again"
    assert sros("policies", "--with-node-rights").status == 2
