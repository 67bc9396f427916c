"""Policies as XML: what is written reads back, and lies where the includes say."""

from __future__ import annotations

import itertools
import string
import tempfile
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from lxml import etree

from sros_tool.errors import DocumentError, PolicyError
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.model import Enclave, Policy, Profile, Profiles
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import policy_rights
from sros_tool.xml import tag_of
from tests.support.drawn_policies import drawn_groups
from tests.support.harness import policy_text, publish, with_includes

names = st.sampled_from(("x", "/x/y", "~/z", "~", "*", "a?", "[!a-c]d", "/a/*/b"))


texts = st.text(alphabet=string.ascii_letters + "&<>\"' \té中😀", max_size=8)
metadata = st.just("") | texts.map(lambda text: _metadata(text))


def _metadata(text: str) -> str:
    element = etree.Element("metadata")
    etree.SubElement(element, "note", by=text).text = text or None
    etree.SubElement(element, "empty").tail = text or None
    return etree.tostring(element, encoding="unicode")


blocks = st.builds(
    Profiles,
    st.lists(
        st.builds(
            Profile,
            st.sampled_from(("/", "/ns", "/ns/*")),
            st.sampled_from(("n", "node_2", "*")),
            st.lists(drawn_groups(names), max_size=3).map(tuple),
        ),
        min_size=1,
        max_size=3,
    ).map(tuple),
    texts,
    metadata,
)
policies = st.lists(
    st.builds(
        Enclave,
        st.sampled_from(("/", "/a", "/a/b", "/c")),
        st.lists(blocks, min_size=1, max_size=2).map(tuple),
    ),
    min_size=1,
    max_size=3,
    unique_by=lambda each: each.path,
).map(lambda enclaves: Policy(tuple(enclaves)))

SCHEMA = etree.XMLSchema(
    etree.parse(Path(__file__).parents[1] / "schemas/policy.xsd", etree.XMLParser(no_network=True))
)


@given(policies)
def test_a_policy_reads_back(policy: Policy) -> None:
    document = policy_xml(policy)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "policy.xml")
        path.write_bytes(document)
        again = read_policy(path)
    assert again == policy
    assert policy_xml(again) == document
    SCHEMA.assertValid(etree.fromstring(document))


POLICY = """<policy version="0.2.0">
  <enclaves>
    <xi:include href="enclaves/one.xml" xpointer="xpointer(/enclaves/*)"/>
    <enclave path="/two"><profiles>
      <xi:include href="enclaves/profile.xml"/>
    </profiles></enclave>
  </enclaves>
</policy>"""
ONE = """<enclaves xmlns:xi="http://www.w3.org/2001/XInclude">
  <enclave path="/one"><profiles><xi:include href="profile.xml" xpointer="xpointer(/profile)"/>
  </profiles></enclave>
</enclaves>"""
PROFILE = """<profile ns="/" node="n" xmlns:xi="http://www.w3.org/2003/XInclude">
  <xi:include href="../groups.xml" xpointer="xpointer(/profile/topics[@publish])"/>
</profile>"""
GROUPS = """<profile>
  <topics publish="ALLOW"><topic>out</topic></topics>
  <topics subscribe="ALLOW"><topic>in</topic></topics>
</profile>"""


def test_includes_are_read_where_they_lie(tmp_path: Path) -> None:
    (tmp_path / "enclaves").mkdir()
    (tmp_path / "policy.xml").write_text(with_includes(POLICY))
    (tmp_path / "enclaves/one.xml").write_text(ONE)
    (tmp_path / "enclaves/profile.xml").write_text(PROFILE)
    (tmp_path / "groups.xml").write_text(GROUPS)
    policy = read_policy(tmp_path / "policy.xml")
    assert [each.path for each in policy.enclaves] == ["/one", "/two"]
    one, two = (each.all_profiles() for each in policy.enclaves)
    assert one == two
    assert one[0].groups[0].names == ("out",)
    assert one[0].groups[0].source.file == str(tmp_path / "groups.xml")
    assert one[0].groups[0].source.line == 2
    (tmp_path / "groups.xml").write_text(GROUPS.replace("out", "o ut"))
    with pytest.raises(PolicyError, match=r"groups\.xml:2: 'o ut'"):
        read_policy(tmp_path / "policy.xml")


def test_a_linked_policy_includes_from_where_it_really_is(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real/groups.xml").write_text(GROUPS)
    text = """<policy version="0.2.0"><enclaves><enclave path="/a"><profiles>
    <profile ns="/" node="n"><xi:include href="groups.xml" xpointer="xpointer(/profile/*)"/>
    </profile></profiles></enclave></enclaves></policy>"""
    (tmp_path / "real/policy.xml").write_text(with_includes(text))
    (tmp_path / "link.xml").symlink_to("real/policy.xml")
    assert len(read_policy(tmp_path / "link.xml").enclaves[0].all_profiles()[0].groups) == 2


@pytest.mark.parametrize("comment", ["<!-- c -->", "<?pi x?>"])
def test_comments_count_for_nothing(comment: str, tmp_path: Path) -> None:
    inside = "" if comment.startswith("<?") else comment  # a name has only those of sros
    text = f"""{comment}<policy version="0.2.0">{comment}<enclaves><enclave path="/a"><profiles>
    <profile ns="/" node="n"><topics publish="ALLOW">{comment}<topic>ch{inside}atter</topic>
    </topics></profile></profiles></enclave></enclaves></policy>{comment}"""
    (tmp_path / "p.xml").write_text(text)
    assert read_policy(tmp_path / "p.xml").enclaves[0].all_profiles()[0].groups[0].names == (
        "chatter",
    )


def test_includes_have_a_size_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sros_tool.policy import document as include

    part = '<profile ns="/" node="n"><topics publish="ALLOW"><topic>t</topic></topics></profile>'
    (tmp_path / "part.xml").write_text(part)
    policy = tmp_path / "policy.xml"
    policy.write_text(
        '<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude"><enclaves>'
        '<enclave path="/a"><profiles><xi:include href="part.xml"/></profiles></enclave>'
        "</enclaves></policy>"
    )
    monkeypatch.setattr(include, "_MAX_BYTES", policy.stat().st_size + len(part))
    read_policy(policy)
    monkeypatch.setattr(include, "_MAX_BYTES", policy.stat().st_size + len(part) - 1)
    with pytest.raises(PolicyError, match="too large"):
        read_policy(policy)


# ── the same as other readers, or refused ──────────────────────────────────────────────────

XI = 'xmlns:xi="http://www.w3.org/2001/XInclude"'
PLAIN_HREFS = ("b.xml", "./b.xml", "%62.xml", "sub/b.xml", "a.xml", "sub/a.xml")
ODD_HREFS = (
    *("link.xml", "linked/b.xml", "sub/../b.xml", "none/../b.xml", "linked/../a.xml", "b.xml#x"),
    *("b.xml?x", "%2e%2e/b.xml", "%00", "file:b.xml", "/b.xml", "//b.xml", "b%2exml", "sub//b.xml"),
    *("none.xml", "", "sub/", "../a.xml"),
)
PLAIN_POINTERS = ("/profile/*", "/*/*", "/profile/topics", "/profile/topics[@publish]")
ODD_POINTERS = (
    *("/profile/topics[@subscribe='ALLOW']", "/profile", "//topics", "/profile[1]/*", "/*/none"),
    *("/profile/topics[@publish='ALLOW']/topic", "/profile/*[count(*)]", "/profile/xi:include", ""),
)


@st.composite
def fragments(draw: st.DrawFn, odd: bool, most: int = 2) -> str:
    """The content of a profile: groups, and includes of other files."""
    name = draw(st.integers(0, 999))
    parts = [f'<topics {draw(st.sampled_from(("publish", "subscribe")))}="ALLOW">']
    parts += [f"<topic>t{name}</topic></topics>"]
    for _ in range(draw(st.integers(0, most))):
        href = draw(st.sampled_from(PLAIN_HREFS * (1 + 4 * odd) + ODD_HREFS * odd))
        pointer = draw(st.sampled_from(PLAIN_POINTERS * (1 + 4 * odd) + ODD_POINTERS * odd))
        base = draw(st.sampled_from(("", "", "", 'xml:base="sub/"'))) if odd else ""
        inner = draw(st.sampled_from(("", "", f"<xi:fallback>{''.join(parts)}</xi:fallback>")))
        attribute = f'xpointer="xpointer({pointer})"' if pointer else ""
        parts += [f'<xi:include href="{href}" {attribute} {base}>{inner}</xi:include>']
    return "".join(draw(st.permutations(["".join(parts[:2]), *parts[2:]])))


@st.composite
def folders(draw: st.DrawFn, odd: bool) -> dict[str, str]:
    """Files by name: a policy, and parts that include each other."""
    base = st.sampled_from(("", "", "", "", 'xml:base="sub/"' if odd else ""))
    found = {
        file: f"<profile {XI} {draw(base)}>{draw(fragments(odd, most))}</profile>"
        for file, most in (("a.xml", 2), ("b.xml", 0), ("sub/a.xml", 1), ("sub/b.xml", 0))
    }
    found["policy.xml"] = (
        f'<policy version="0.2.0" {XI}><enclaves><enclave path="/e"><profiles {draw(base)}>'
        f'<profile ns="/" node="n">{draw(fragments(odd))}</profile></profiles></enclave></enclaves>'
        "</policy>"
    )
    return found


TOPIC = '<topics publish="ALLOW"><topic>t</topic></topics>'
INCLUDE = '<xi:include href="a.xml" xpointer="xpointer(/profile/*)"/>'
ALWAYS_COMPARED = {
    "a.xml": f"<profile>{TOPIC}</profile>",
    "policy.xml": with_includes(policy_text({"/e": TOPIC + INCLUDE})),
}


def rights_by_lxml(policy: Path) -> list[tuple[str, list[str]]] | None:
    try:
        tree = etree.parse(policy)
        tree.xinclude()
    except etree.LxmlError:
        return None
    (profile,) = tree.iterfind("enclaves/enclave/profiles/profile")
    return [
        (f"{tag_of(each)} {said_of(each)}", [name.text or "" for name in each]) for each in profile
    ]


def said_of(group: etree._Element) -> dict[str, str]:
    return {str(right): str(said) for right, said in group.items() if str(right)[0] != "{"}


def rights_by_sros(policy: Path) -> list[tuple[str, list[str]]] | None:
    try:
        (profile,) = read_policy(policy).enclaves[0].all_profiles()
    except DocumentError:
        return None
    return [
        (f"{group.kind} { {right: str(said) for right, said in group.rights} }", list(group.names))
        for group in profile.groups
    ]


@pytest.mark.parametrize("odd", [False, True])
def test_includes_give_what_lxml_gives_or_are_refused(odd: bool) -> None:
    read = 0

    @given(folders(odd))
    @example(ALWAYS_COMPARED)  # most of what is drawn is refused
    @settings(max_examples=5 * settings().max_examples)
    def compare(files: dict[str, str]) -> None:
        nonlocal read
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "sub").mkdir()
            (folder / "link.xml").symlink_to("sub/a.xml")
            (folder / "linked").symlink_to("sub")
            for file, text in files.items():
                (folder / file).write_text(text)
            found = rights_by_sros(folder / "policy.xml")
            if found is not None:
                expected = rights_by_lxml(folder / "policy.xml")  # None: it sees a circle earlier
                assert expected in (found, None)
                read += "include" in files["policy.xml"] and expected is not None

    compare()
    assert read, "nothing was compared"


def test_a_group_that_names_nothing_is_to_be_removed(tmp_path: Path) -> None:
    file = tmp_path / "p.xml"
    file.write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/a"><profiles>'
        '<profile ns="/" node="a"><topics publish="ALLOW"></topics></profile>'
        "</profiles></enclave></enclaves></policy>"
    )
    with pytest.raises(PolicyError, match="<topics> names no topic") as caught:
        read_policy(file)
    assert "Remove the element" in str(caught.value)


@pytest.mark.parametrize("ns", ["*", "**", "*/", "*/a", "*a", "*a/b", "*[ab]/c", "/a*"])
def test_a_namespace_that_begins_with_a_wildcard_means_absolute_names(
    ns: str, tmp_path: Path
) -> None:
    """Every part of sros takes a name without a slash before it for one that is not of ROS."""
    group = '<services request="ALLOW"><service>x</service></services>'
    file = tmp_path / "policy.xml"
    file.write_text(policy_text({"/e": group}).replace('ns="/"', f'ns="{ns}"'))
    stated = [each.name for each in policy_rights(read_policy(file))]
    assert all(each.startswith("/") for each in stated)
    written = f"{ns.removesuffix('/')}/x"
    for parents in (p for size in range(4) for p in itertools.product("abc", repeat=size)):
        name = "/".join(("", *parents, "x"))
        assert any(matches(each, name) for each in stated) == matches(written, name), name


@pytest.mark.parametrize(
    ("group", "fix"),
    [
        ('<services reply="ALLOW"><topic>a</topic></services>', "or move it into <topics>."),
        ('<topics publish="ALLOW"><name>a</name></topics>', "Write <topic> in its place."),
    ],
)
def test_an_element_in_a_wrong_place_comes_with_its_mend(
    group: str, fix: str, tmp_path: Path
) -> None:
    (tmp_path / "policy.xml").write_text(policy_text({"/a": group}))
    with pytest.raises(PolicyError, match="expected") as error:
        read_policy(tmp_path / "policy.xml")
    assert error.value.remedy.endswith(fix)


@pytest.mark.parametrize(
    ("right", "wrong", "fix"),
    [
        (' ns="/"', "", 'Write ns="/", or the namespace of the node.'),
        (' node="n"', "", 'Write node="NAME", with the name of the node.'),
        (' path="/a"', "", 'Write path="/NAME", with the name of the enclave.'),
        ('"ALLOW"', '"allow"', 'Write publish="ALLOW".'),
        ('"ALLOW"', '"yes"', 'Write publish="ALLOW" or publish="DENY".'),
        ("<topic>x</topic>", '<topic name="joint_states"/>', "Write <topic>joint_states</topic>."),
        ("<topic>x</topic>", "<topic> x\n</topic>", "Write <topic>x</topic>."),
        ("<topic>x</topic>", '<topic name="a b"/>', "Write <topic>NAME</topic>."),
        ("<topic>x</topic>", "<topic>a b</topic>", ""),
        ("topics", "topic", 'Write it in <topics publish="ALLOW"> or <topics subscribe="ALLOW">.'),
    ],
)
def test_an_obvious_mistake_comes_with_its_cure(
    right: str, wrong: str, fix: str, tmp_path: Path
) -> None:
    file, text = tmp_path / "p.xml", policy_text({"/a": publish("x")})
    file.write_text(text)
    read_policy(file)
    assert right in text
    file.write_text(text.replace(right, wrong))
    with pytest.raises(PolicyError) as error:
        read_policy(file)
    assert error.value.remedy == fix


def test_an_include_without_its_xpointer_is_named(tmp_path: Path) -> None:
    file, pointer = tmp_path / "p.xml", ' xpointer="xpointer(/profile/*)"'
    (tmp_path / "node.xml").write_text(f"<profile>{publish('x')}</profile>")
    text = with_includes(policy_text({"/a": f'\n<xi:include href="node.xml"{pointer}/>'}))
    file.write_text(text)
    read_policy(file)
    file.write_text(text.replace(pointer, ""))
    line = text[: text.index("<xi:include")].count("\n") + 1
    with pytest.raises(PolicyError) as error:
        read_policy(file)
    assert error.value.what == f"{file}:{line}: the include of 'node.xml' lacks{pointer}"
    assert error.value.remedy == f'Write <xi:include href="node.xml"{pointer}/>.'
