"""Protection that a policy demands: read and written, kept by every verb, refused if unclear."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path

import pytest
from lxml import etree

from sros_tool.errors import PolicyError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.graph.learn import merge_policies
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.merge import merge_into
from sros_tool.policy.minimize import minimize
from sros_tool.policy.model import ALLOW, Policy, stated_protections
from sros_tool.policy.rights import Right
from tests.support.harness import copy_of, sros

SIGN, ENCRYPT = '<?sros protect="sign"?>', '<?sros protect="encrypt"?>'


def policy(*enclaves: str) -> str:
    return f'<policy version="0.2.0"><enclaves>{"".join(enclaves)}</enclaves></policy>\n'


def enclave(path: str, *items: str, right: str = "publish", kind: str = "topic") -> str:
    names = "".join(f"\n      <{kind}>{each}</{kind}>" for each in items)
    return f"""
<enclave path="{path}"><profiles><profile ns="/" node="n">
    <{kind}s {right}="ALLOW">{names}
    </{kind}s></profile></profiles></enclave>"""


def read(text: str, *, placeholders: bool = False) -> Policy:
    return read_policy(Path("p.xml"), text.encode(), placeholders=placeholders)


def said(given: Policy) -> list[str]:
    return [f"{e.enclave} {e} {e.word}" for e in stated_protections(given.enclaves)]


WRITTEN = policy(
    enclave("/a", f"scan{ENCRYPT}", "/free", f"~/image{SIGN}", f"/x/*{ENCRYPT}"),
    enclave("/b", f"/dock{SIGN}", right="call", kind="action"),
)
SAID = [
    "/a topic /scan encrypt",
    "/a topic /x/* encrypt",
    "/a topic /n/image sign",
    "/b action /dock sign",
]


def test_it_is_read_with_its_line_and_written_again() -> None:
    given = read(WRITTEN)
    assert said(given) == SAID
    lines = WRITTEN.splitlines()
    for each in stated_protections(given.enclaves):
        assert each.name.removeprefix("/").removeprefix("n/") in lines[each.source.line - 1]
    assert read(policy_xml(given).decode()) == given
    assert given != read(WRITTEN.replace(SIGN, ENCRYPT)) != read(WRITTEN.replace(SIGN, ""))


def test_the_schema_and_readers_of_ros2_are_not_disturbed() -> None:
    root = Path(__file__).parents[1] / "schemas"
    schema = etree.XMLSchema(etree.parse(root / "policy.xsd"))
    for text in (WRITTEN.encode(), policy_xml(read(WRITTEN))):
        document = etree.fromstring(text)
        assert schema.validate(document), schema.error_log
        # The string value of an element, which XSLT uses, has no processing instructions in it.
        names = [each.xpath("string(.)") for each in document.iter("topic", "action")]
        assert sorted(names) == sorted(["scan", "/free", "~/image", "/x/*", "/dock"])
    for other in ('<topic s:protect="encrypt" xmlns:s="urn:s">', '<topic protect="encrypt">'):
        changed = WRITTEN.replace(f"<topic>scan{ENCRYPT}", f"{other}scan")
        assert not schema.validate(etree.fromstring(changed))
        with pytest.raises(PolicyError, match="has no attribute") as refused:
            read(changed)
        assert '<topic>scan<?sros protect="encrypt"?></topic>' in refused.value.remedy
    with pytest.raises(PolicyError, match="directly between the name and its end tag"):
        read(WRITTEN.replace(f"<topic>scan{ENCRYPT}", f"<topic>{ENCRYPT}scan"))


@pytest.mark.parametrize(
    "wrong",
    [
        '<?sros protect="secret"?>',
        '<?sros protect="ENCRYPT"?>',
        '<?sros protect="none"?>',
        '<?sros protect="encrypt" protect="sign"?>',
        '<?sros protect="encrypt?>',
        "<?sros protect=encrypt?>",
        "<?sros encrypt?>",
        "<?sros?>",
        "<?sors protect='encrypt'?>",
        '<?SROS protect="encrypt"?>',
        f"{SIGN}{SIGN}",
        f"{SIGN}\n",
        f"{SIGN}s",
        '<?sros protect="\x1b[31m"?>'.replace("\x1b", "&#27;"),
        f'<?sros protect="{"x" * 5000}"?>',
    ],
)
def test_an_unknown_level_is_refused(wrong: str, tmp_path: Path) -> None:
    text = WRITTEN.replace(ENCRYPT, wrong, 1)
    with pytest.raises(PolicyError, match=r"p\.xml:4: ") as found:
        read(text)
    assert len(str(found.value)) < 600
    assert "\x1b" not in str(found.value)


@pytest.mark.parametrize(
    "where", ["<enclaves>", '<topics publish="ALLOW">', "<policy", "</policy>"]
)
def test_it_is_said_in_a_name_only(where: str) -> None:
    after = where in ("<enclaves>", '<topics publish="ALLOW">', "</policy>")
    placed = f"{where}{SIGN}" if after else f"{SIGN}{where}"
    assert WRITTEN.count(where)
    with pytest.raises(PolicyError, match="is not in a name"):
        read(WRITTEN.replace(where, placed, 1))
    read(WRITTEN.replace(where, placed.replace("?sros", "?other"), 1))


def test_included_files_and_fleets_say_it(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text(
        f'<profile ns="/" node="n"><topics publish="ALLOW"><topic>scan{SIGN}</topic></topics>'
        "</profile>"
    )
    (tmp_path / "p.xml").write_text(
        '<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude"><enclaves>'
        '<enclave path="/a"><profiles><profile ns="/" node="n"><xi:include href="part.xml" '
        'xpointer="xpointer(/profile/topics)"/></profile></profiles></enclave></enclaves></policy>'
    )
    assert said(read_policy(tmp_path / "p.xml")) == ["/a topic /scan sign"]
    (tmp_path / "part.xml").write_text(
        (tmp_path / "part.xml").read_text().replace("protect=", "protects=")
    )
    with pytest.raises(PolicyError, match=r"part\.xml:1"):
        read_policy(tmp_path / "p.xml")

    fleet = Fleet.of([Robot(name, f"/{name}") for name in ("r1", "r2")])
    text = policy(enclave("/{robot}/a", f"{{namespace}}/scan{SIGN}", "/free"))
    expanded = FleetPolicy(read(text, placeholders=True), fleet)
    assert expanded.protects
    assert said(expanded.policy()) == ["/r1/a topic /r1/scan sign", "/r2/a topic /r2/scan sign"]


def test_a_merge_keeps_it_and_adds_it_with_new_names(tmp_path: Path) -> None:
    file = tmp_path / "p.xml"
    file.write_text(WRITTEN)
    added = merge_into(file, read(policy(enclave("/a", f"new{SIGN}", "/other"))))
    assert added.document.decode().count("<?sros") == WRITTEN.count("<?sros") + 1
    merged = read(added.document.decode())
    assert said(merged) == [*SAID[:2], *SAID[2:3], "/a topic /new sign", SAID[3]]
    same = merge_into(file, read(policy(enclave("/a", f"scan{ENCRYPT}", "/free"))))
    assert same.document.decode() == WRITTEN
    for other, text in ((f"scan{SIGN}", "says protect=.encrypt"), (f"/free{SIGN}", "no protect")):
        with pytest.raises(PolicyError, match=text) as caught:
            merge_into(file, read(policy(enclave("/a", other))))
        reverse = f", or merge '{file}' into the policy that states it."
        assert caught.value.remedy.endswith(reverse) is (text == "no protect")
    (protecting := tmp_path / "new.xml").write_text(policy(enclave("/a", f"/free{SIGN}")))
    merged = read(merge_into(protecting, read(WRITTEN)).document.decode())
    assert {*said(merged)} == {"/a topic /free sign", *SAID}, said(merged)


def test_a_merge_is_refused_if_another_enclave_states_another_level(tmp_path: Path) -> None:
    """`check` and `generate_artifacts` would refuse the result; what POLICY has already, stays."""
    file = tmp_path / "own.xml"
    own = enclave("/recorder", f"/scan{SIGN}", right="subscribe")
    for others, added, refused in (
        ((), enclave("/a", f"/scan{ENCRYPT}"), True),
        ((), enclave("/a", f"/sc*{ENCRYPT}"), True),
        ((), enclave("/a", f"/scan{SIGN}"), False),
        ((enclave("/b", f"/sc*{ENCRYPT}"),), enclave("/b", "/new"), False),
    ):
        file.write_text(policy(own, *others))
        with (
            pytest.raises(PolicyError, match=r"/scan has protect=.sign")
            if refused
            else nullcontext()
        ):
            merge_policies(file, [read(policy(added))])


def test_a_narrowed_policy_demands_the_same_of_the_names_that_are_left() -> None:
    given = read(
        policy(
            enclave("/a", f"/camera/*{ENCRYPT}", f"/gone{SIGN}", "/used"),
            enclave("/b", "/camera/front", "/gone", "/used", right="subscribe"),
            enclave("/c", "/*", right="subscribe"),
        )
    )
    observed = [
        Right("/a", ALLOW, "publish", "/camera/front"),
        Right("/a", ALLOW, "publish", "/used"),
        Right("/b", ALLOW, "subscribe", "/gone"),
        Right("/b", ALLOW, "subscribe", "/camera/front"),
    ]
    narrow = minimize(given, observed).policy
    assert read(policy_xml(narrow).decode()) == narrow
    assert sorted(said(narrow)) == [
        "/a topic /camera/front encrypt",
        "/b topic /camera/front encrypt",
        "/b topic /gone sign",
    ]


def test_policies_that_differ_in_it_differ(tmp_path: Path) -> None:
    one, other = tmp_path / "one.xml", tmp_path / "other.xml"
    one.write_text(WRITTEN)
    other.write_text(WRITTEN.replace(f"scan{ENCRYPT}", f"scan{SIGN}"))
    assert sros("diff_policy", one, one).status == 0
    ended = sros("diff_policy", one, other)
    assert ended.status == 1
    assert ended.out.splitlines() == [
        "- /a protect topic /scan with encrypt",
        "+ /a protect topic /scan with sign",
    ]
    value = json.loads(sros("diff_policy", one, other, "--json").out)
    assert not value["equal"]
    assert [each["level"] for each in value["protections"]] == ["ENCRYPT", "SIGN"]


def test_a_different_governance_of_equal_rights_is_said(keystore: Path, tmp_path: Path) -> None:
    opened = copy_of(keystore, tmp_path / "open")
    assert sros("diff_policy", keystore, opened).ok().err == "the rights are the same\n"
    sros(
        "update_keystore",
        opened,
        "--set",
        "protection.default.read_access_control=false",
        "--allow-looser",
    ).ok()
    ended = sros("diff_policy", keystore, opened)
    assert (ended.status, ended.out) == (1, "")
    command = f"sros diff_policy --no-new-access {keystore} {opened}"
    assert f"the governance differs: `{command}` shows what B opens, " in ended.err
    for name, root in (("first", keystore), ("second", opened)):
        sros("distribute_key", root, "--all", tmp_path / name).ok()
    exports = tmp_path / "first", tmp_path / "second"
    assert "the governance differs" in sros("diff_policy", *exports).err
    assert (
        sros("diff_policy", keystore, exports[0]).ok().err == "the rights of /a, /b are the same\n"
    )
    table = sros("view", exports[1], "--format", "markdown").ok().out
    assert "| everybody with an identity |" in table
    found = json.loads(sros("diff_policy", keystore, opened, "--json").out)
    assert (found["equal"], found["governance_differs"]) == (False, True)
