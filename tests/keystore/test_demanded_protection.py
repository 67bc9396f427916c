"""A keystore protects names at least as the policies say, and tells when that changes it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sros_tool.dds.governance import parse_governance
from sros_tool.files import templates_dir
from sros_tool.keystore.protection import unfulfilled_protections
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki import smime
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Level, stated_protections
from sros_tool.translate import governance_for
from tests.support.harness import check_whole, snapshot, sros

POLICY = """<policy version="0.2.0"><enclaves>
<enclave path="/camera"><profiles><profile ns="/" node="camera"><topics publish="ALLOW">
<topic>/image<?sros protect="sign"?></topic><topic>/rosout</topic>
</topics></profile></profiles></enclave>
<enclave path="/mux"><profiles><profile ns="/" node="mux"><topics publish="ALLOW">
<topic>/cmd_vel<?sros protect="encrypt"?></topic>
</topics></profile></profiles></enclave></enclaves></policy>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a template that protects nothing, a policy, and a keystore of the template."""
    folder = tmp_path_factory.mktemp("demanded")
    text = (templates_dir() / "development.toml").read_text()
    text = text.replace('rtps = "SIGN"', 'rtps = "NONE"')
    for each in ("data", "metadata"):
        text = text.replace(f'{each} = "ENCRYPT"', f'{each} = "NONE"')
    (folder / "open.toml").write_text(text)
    (folder / "p.xml").write_text(POLICY)
    sros("create_keystore", "ks", "--template", "open.toml", cwd=folder).ok()
    sros("create_enclave", "ks", "/old", cwd=folder).ok()
    return folder


def missing(root: Path, policy: Path) -> list[str]:
    message = (root / "enclaves/governance.p7s").read_bytes()
    governance = parse_governance(smime.parse(message).document)
    settings = OpenedKeystore(root).template
    assert governance == governance_for(settings.protection, governance.domains().closed())
    stated = stated_protections(read_policy(policy).enclaves)
    return [str(each) for each, _ in unfulfilled_protections(governance, stated)]


def test_an_existing_keystore_gets_a_governance_that_keeps_to_it(folder: Path) -> None:
    ks, policy = folder / "ks", folder / "p.xml"
    assert missing(ks, policy) == ["topic /image", "topic /cmd_vel"]
    ended = sros("check", ks, "--policy", policy, "--include", "governance.less*", cwd=folder)
    assert ended.status == 1
    assert f"{policy.name}:3: error" in ended.out
    assert "topic /cmd_vel has the protection none, but the policy demands encrypt" in ended.out

    before = snapshot(ks)
    planned = sros("generate_artifacts", "-k", ks, "-p", policy, "--dry-run", cwd=folder).ok()
    assert snapshot(ks) == before
    assert f"would replace {ks}/enclaves/governance.p7s" in planned.out
    done = sros("generate_artifacts", "-k", ks, "-p", policy, cwd=folder).ok()
    for ended in (planned, done):
        assert "restart the processes of 1 enclave for the change to take effect: /old" in ended.err
        assert f"topic /cmd_vel encrypt ({policy}:6)" in ended.err
        assert "export the enclaves again" in ended.err
    check_whole(ks)
    assert missing(ks, policy) == []
    named = {str(each): each.protection for each in OpenedKeystore(ks).template.protection.named}
    assert named["topic /image"].metadata is Level.SIGN
    assert named["topic /cmd_vel"].data is Level.ENCRYPT
    assert sros("check", ks, "--policy", policy, "--include", "governance.less*").status == 0

    again = sros("generate_artifacts", "-k", ks, "-p", policy, cwd=folder).ok()
    assert "governance" not in again.err
    sros("update_keystore", ks, "--set", "protection.default.metadata=SIGN", cwd=folder).ok()
    assert missing(ks, policy) == []
    refused = sros("update_keystore", ks, "--drop-rule", "topic /cmd_vel", cwd=folder)
    assert refused.status != 0
    assert "no longer encrypted" in refused.err


def test_a_new_keystore_is_made_with_it(folder: Path) -> None:
    policy = folder / "p.xml"
    words = ("-p", policy, "--template", "open.toml")
    sros("generate_artifacts", "-k", "new", *words, cwd=folder).ok()
    assert missing(folder / "new", policy) == []
    permission = sros("create_permission", "new", "/mux", "p.xml", cwd=folder).ok()
    assert "governance" not in permission.err
    asked = ("/mux", "publish", "/cmd_vel", "--policy", "p.xml")
    for shown in (sros("explain", "new", *asked, cwd=folder), sros("explain", *asked, cwd=folder)):
        assert "payload ENCRYPT" in shown.out
        assert 'p.xml:6: ALLOW publish /cmd_vel, protect="encrypt"' in shown.out


def test_a_template_that_protects_more_stays(folder: Path) -> None:
    words = ("-p", "p.xml", "--template", "production")
    sros("generate_artifacts", "-k", "strict", *words, cwd=folder).ok()
    assert OpenedKeystore(folder / "strict").template.protection.named == ()
    assert missing(folder / "strict", folder / "p.xml") == []


def test_what_contradicts_or_cannot_be_kept_is_refused(folder: Path) -> None:
    sros("create_keystore", "kept", "--template", "open.toml", cwd=folder).ok()
    before = snapshot(folder / "kept")
    other = POLICY.replace("/cmd_vel<", "/im*<")
    (folder / "other.xml").write_text(other)
    ended = sros("generate_artifacts", "-k", "kept", "-p", "other.xml", cwd=folder)
    assert ended.status != 0
    assert "other.xml:6" in ended.err
    assert "other.xml:3" in ended.err
    checked = sros("check", "other.xml", "--include", "policy.protection*", cwd=folder)
    assert checked.status == 1
    assert "other.xml:6: error" in checked.out

    one = (
        POLICY.replace("/mux", "/elsewhere").replace("/camera", "/other").replace("sign", "encrypt")
    )
    (folder / "one.xml").write_text(one)
    ended = sros("generate_artifacts", "-k", "kept", "-p", "p.xml", "one.xml", cwd=folder)
    assert ended.status != 0
    assert "p.xml:3" in ended.err
    assert "one.xml:3" in ended.err

    sros("create_request", "/mux", "robot", cwd=folder).ok()
    request = "robot/enclaves/mux/request.pem"
    words = ("sign_request", "kept", request, "-p", "p.xml", "-o", "answer.tar.gz")
    refused = sros(*words, cwd=folder)
    assert refused.status != 0
    assert "update_keystore kept --rule 'topic /cmd_vel data=ENCRYPT'" in refused.err
    assert snapshot(folder / "kept") == before


def test_a_picture_shows_what_is_demanded(folder: Path) -> None:
    drawn = sros("view", "p.xml", "--format", "mermaid", cwd=folder).ok().out
    assert "topic, at least signed<br/>/image" in drawn
    assert "topic, encrypted<br/>/cmd_vel" in drawn
    words = ("--format", "mermaid", "--template", "open.toml")
    drawn = sros("view", "p.xml", *words, cwd=folder).ok().out
    assert "topic, encrypted<br/>/cmd_vel" in drawn


def test_a_keystore_with_zenoh_says_what_protection_is_there(folder: Path) -> None:
    """The permissions state the same and are kept; only the governance changes."""
    plain = re.sub(r"<\?sros.*?\?>", "", POLICY)
    (folder / "plain.xml").write_text(plain)
    words = ("generate_artifacts", "-k", "zenoh", "-p")
    sros(*words, "plain.xml", "--template", "open.toml", cwd=folder).ok()
    sros("zenoh", "zenoh", cwd=folder).ok()
    done = sros(*words, "p.xml", cwd=folder).ok()
    assert "restart the processes of 3 enclaves" in done.err
    assert "unchanged: 2 enclaves" in done.err
    assert "Zenoh has no protection of single names" in done.err
    assert missing(folder / "zenoh", folder / "p.xml") == []
    check_whole(folder / "zenoh")
