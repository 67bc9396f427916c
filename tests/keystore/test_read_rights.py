"""Rights are read from whatever gives them, and it is said what is not certain of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import SrosError
from sros_tool.keystore.issuing.size import SizeEstimator
from sros_tool.keystore.rights import RightsSource, load_rights
from sros_tool.policy.document import read_policy
from sros_tool.translate import grant_rights
from tests.support.harness import policy_text, publish, sros

DOCUMENT = """<dds><permissions>{}</permissions></dds>"""
GRANT = """<grant name="/g"><subject_name>{subject}</subject_name><validity>
<not_before>2026-01-01T00:00:00</not_before><not_after>2036-01-01T00:00:00</not_after></validity>
{rules}<default>{default}</default></grant>"""
RULE = """<{kind}><domains><id>{domain}</id></domains><publish><topics><topic>{topic}</topic>
</topics>{rest}</publish></{kind}>"""

RAW = "<topics><topic>raw</topic></topics>"


def rule(topic: str = "rt/x", kind: str = "allow_rule", domain: int = 0, rest: str = "") -> str:
    return RULE.format(topic=topic, kind=kind, domain=domain, rest=rest)


def grant(*rules: str, subject: str = "CN=/a", default: str = "DENY") -> str:
    return GRANT.format(rules="".join(rules), subject=subject, default=default)


BOTH = rule(
    "ros_discovery_info",
    rest="</publish><subscribe><topics><topic>ros_*</topic></topics></subscribe><publish>" + RAW,
)
_NO_DISCOVERY = rule("ros_discovery_info", "deny_rule")


def told(source: RightsSource) -> list[str]:
    return sorted(str(right) for right in source.rights)


def ids(source: RightsSource) -> list[str]:
    return [note.id for note in source.notes]


def test_every_form_of_the_same_rights(keystore: Path) -> None:
    policy = keystore.parent / "policy.xml"
    policy.write_text(policy_text({"/a": publish("old_a"), "/b": publish("old_b")}))
    folder = keystore / "enclaves" / "a"
    forms = [load_rights(path) for path in (policy, keystore)]
    assert [(each.kind, told(each), ids(each), each.sound) for each in forms] == [
        (kind, ["/a ALLOW publish topic /old_a", "/b ALLOW publish topic /old_b"], [], True)
        for kind in ("policy", "keystore")
    ]
    single = [
        load_rights(path)
        for path in (folder, folder / "permissions.p7s", folder / "permissions.xml")
    ]
    for each in single:
        assert told(each) == ["/a ALLOW publish topic /old_a"]
        assert each.scope == frozenset({"/a"})
    assert [ids(each) for each in single] == [[], [], ["rights.unsigned"]]


def test_a_signature_without_its_authority_is_not_verified(keystore: Path, tmp_path: Path) -> None:
    alone = tmp_path / "permissions.p7s"
    shutil.copy(keystore / "enclaves" / "a" / "permissions.p7s", alone)
    source = load_rights(alone)
    assert ids(source) == ["rights.not-verified"]
    assert source.sound


def test_a_changed_document_is_not_sound(keystore: Path) -> None:
    file = keystore / "enclaves" / "a" / "permissions.p7s"
    file.write_bytes(file.read_bytes().replace(b"old_a", b"new_a"))
    for path in (file, file.parent, keystore):
        source = load_rights(path)
        assert ids(source) == ["rights.bad-signature"]
        assert not source.sound
        assert "/a ALLOW publish topic /new_a" in told(source)


def test_permissions_of_another_authority_are_not_sound(keystore: Path, tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "other").ok()
    sros("create_enclave", tmp_path / "other", "/a").ok()
    shutil.copy(
        tmp_path / "other" / "enclaves" / "a" / "permissions.p7s", keystore / "enclaves" / "a"
    )
    assert not load_rights(keystore).sound


def test_missing_and_foreign_permissions_of_a_keystore(keystore: Path) -> None:
    a, b = (keystore / "enclaves" / name / "permissions.p7s" for name in "ab")
    shutil.copy(a, b)
    a.unlink()
    source = load_rights(keystore)
    assert not source.sound
    assert sorted(ids(source)) == ["rights.foreign-grant", "rights.unreadable"]


@pytest.mark.parametrize(
    ("document", "rights", "notes"),
    [
        (grant(rule()), ["/a ALLOW publish topic /x"], []),
        (grant(rule("raw")), ["/a ALLOW publish DDS topic raw"], []),
        (grant(rule("ros_discovery_info")), [], []),
        (grant(rule(), subject="CN=/r/a,O=x"), ["/r/a ALLOW publish topic /x"], []),
        (grant(rule(), subject="O=x"), ["/g ALLOW publish topic /x"], []),
        (grant(rule(), default="ALLOW"), ["/a ALLOW publish topic /x"], ["rights.default-allow"]),
        (
            grant(rule(rest="<partitions><partition>p</partition></partitions>")),
            ["/a ALLOW publish topic /x"],
            ["rights.partitions"],
        ),
        (
            grant(rule(), rule("rt/y", domain=7)),
            ["/a ALLOW publish topic /x", "/a ALLOW publish topic /y"],
            ["rights.domains"],
        ),
        (
            grant(rule("rt/y", "deny_rule"), rule()),
            ["/a ALLOW publish topic /x", "/a DENY publish topic /y"],
            [],
        ),
        (
            grant(rule(), rule("rt/y", "deny_rule")),
            ["/a ALLOW publish topic /x", "/a DENY publish topic /y"],
            ["rights.rule-order"],
        ),
        (grant(rule()) + grant(rule("rt/y")), ["/a ALLOW publish topic /x"],
         ["rights.later-grant"]),
    ],
)  # fmt: skip
def test_what_rights_do_not_tell(
    tmp_path: Path, document: str, rights: list[str], notes: list[str]
) -> None:
    file = tmp_path / "permissions.xml"
    file.write_text(DOCUMENT.format(document))
    source = load_rights(file)
    assert told(source) == rights
    assert [name for name in ids(source) if name != "rights.discovery"] == [
        "rights.unsigned",
        *notes,
    ]


@pytest.mark.parametrize(
    ("document", "lacking"),
    [
        (grant(BOTH, _NO_DISCOVERY), ""),  # the first rule that matches decides
        (grant(_NO_DISCOVERY, BOTH), "publish"),
        (grant(rule("ros_discovery_info")), "subscribe"),
        (grant(rule()), "publish or subscribe"),
        (grant(rule(), default="ALLOW"), ""),
    ],
)
def test_a_topic_that_every_node_needs(tmp_path: Path, document: str, lacking: str) -> None:
    file = tmp_path / "permissions.xml"
    file.write_text(DOCUMENT.format(document))
    notes = [note.text for note in load_rights(file).notes if note.id == "rights.discovery"]
    assert len(notes) == bool(lacking)
    assert all(f": /a may not {lacking} ros_discovery_info: " in note for note in notes)


@pytest.mark.parametrize(
    ("document", "other", "is_unclear"),
    [
        (grant(rule()), grant(rule(), default="ALLOW"), True),
        (
            grant(rule()),
            grant(rule(rest="<partitions><partition>p</partition></partitions>")),
            True,
        ),
        (
            grant(rule(), rule("rt/y", "deny_rule")),
            grant(rule("rt/y", "deny_rule"), rule()),
            True,
        ),
        (grant(rule(), rule("rt/y", domain=7)), grant(rule("rt/y"), rule(domain=7)), True),
        (grant(rule()), grant(rule()) + grant(rule("rt/y")), True),
        (grant(rule()), grant(rule(rest=f"</publish><relay>{RAW}</relay><publish>{RAW}")), True),
        (grant(rule(), rule("rt/y", domain=7)), grant(rule(), rule("rt/y", domain=7)), False),
        (grant(rule(), rule("rt/y")), grant(rule("rt/y"), rule()), False),
        (grant(rule(), rule("ros_discovery_info")), grant(rule(), BOTH), True),
        (grant(rule(), BOTH), grant(rule("ros_discovery_info", "deny_rule"), rule(), BOTH), True),
        (grant(rule(), BOTH), grant(BOTH, rule()), False),
    ],
)
def test_permissions_with_another_effect_are_not_the_same(
    tmp_path: Path, document: str, other: str, is_unclear: bool
) -> None:
    files = tmp_path / "a.xml", tmp_path / "b.xml"
    for file, text in zip(files, (document, other), strict=True):
        file.write_text(DOCUMENT.format(text))
    ended = sros("diff_policy", *files)
    assert ended.status == is_unclear
    assert ("? /a may have other rights" in ended.out) == is_unclear
    assert ("the rights are the same" in ended.err) != is_unclear


def test_an_enclave_in_a_hidden_folder_is_not_left_out_in_silence(keystore: Path) -> None:
    """DDS loads it: no answer about all enclaves goes without it."""
    shutil.copytree(keystore, keystore.parent / "twin", symlinks=True)
    (keystore / "enclaves/.h").mkdir()
    shutil.copytree(keystore / "enclaves/a", keystore / "enclaves/.h/a", symlinks=True)
    for words, status in (
        (("diff_policy", keystore.parent / "twin", keystore), 1),
        (("explain", keystore, "--who", "publish", "/x", "--vendor", "fastdds"), 1),
        (("view", keystore, "--focus", "/old_a", "-o", keystore.parent / "x.svg"), 0),
    ):
        ended = sros(*words)
        assert ended.status == status, ended
        assert "[rights.hidden-enclave]: left out, although DDS loads" in ended.err, ended


def test_rights_of_a_grant_leave_out_what_every_participant_has() -> None:
    (found,) = parse_permissions(DOCUMENT.format(grant(rule("ros_discovery_info"))).encode()).grants
    assert grant_rights("/a", found) == frozenset()


@pytest.mark.parametrize("content", ["", "<policy/>", "<other/>", "MIME multipart/signed"])
def test_what_is_nothing_is_an_error(tmp_path: Path, content: str) -> None:
    (tmp_path / "file").write_text(content)
    for path in (tmp_path / "file", tmp_path, tmp_path / "none"):
        with pytest.raises(SrosError):
            load_rights(path)


def test_a_size_is_that_of_a_real_document(keystore: Path) -> None:
    policy = keystore.parent / "policy.xml"
    policy.write_text(policy_text({"/a": publish("old_a")}))
    real = (keystore / "enclaves" / "a" / "permissions.p7s").stat().st_size
    assert abs(SizeEstimator().signed_bytes(read_policy(policy).enclaves[0]) - real) < 100
