"""Every format: the same bytes each time, whole, and nothing of keys or of this machine in it."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from lxml import etree

from sros_tool.report.formats import render_dot, render_mermaid, render_svg
from sros_tool.report.layout import scenes_of
from sros_tool.report.picture import Lack
from tests.report.pictures import HOSTILE, MOBILE_ROBOT, hostile_permissions, mobile_robot
from tests.support.children import importing, python, run
from tests.support.harness import copy_of, policy_text, publish, sros
from tests.support.long_form import some

pytest_plugins = ["tests.report.browsing"]

FORMATS = ("html", "svg", "dot", "mermaid", "markdown", "json")
REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("form", some(["svg", "dot", "mermaid", "markdown", "json"], 1))
def test_two_runs_write_the_same_bytes(form: str, robot_keystore: Path) -> None:
    outputs = set()
    for seed in ("1", "2"):
        words = ("-m", "sros_tool", "view", robot_keystore, "--format", form)
        done = python(*words, env=importing(PYTHONHASHSEED=seed))
        assert len(done.stdout) > 5000
        outputs.add(done.stdout)
    assert len(outputs) == 1


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("mobile_robot.svg", ("--template", "production")),
        ("drive.svg", ("--focus", "/cmd_vel", "--hops", "1")),
    ],
)
def test_the_pictures_of_the_docs_are_what_their_commands_write(
    tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    sros("view", MOBILE_ROBOT, *options, "-o", tmp_path / name).ok()
    assert (tmp_path / name).read_bytes() == (REPOSITORY / "docs" / name).read_bytes()


@pytest.mark.parametrize("form", FORMATS)
def test_no_key_and_no_path_of_the_machine_is_in_it(form: str, robot_keystore: Path) -> None:
    shown = sros("view", robot_keystore, "--format", form).ok().out
    keys = [*robot_keystore.rglob("*key.pem")]
    assert len(keys) >= 15
    for path in keys:
        lines = path.read_text().splitlines()[1:-1]
        assert lines
        for line in lines:
            assert line not in shown, path
    assert "PRIVATE KEY" not in shown
    for place in (robot_keystore.parent, Path.home(), REPOSITORY):
        assert str(place) not in shown
    assert "robot-keys" in shown


def test_a_broken_keystore_is_drawn_all_the_same(robot_keystore: Path, tmp_path: Path) -> None:
    root = tmp_path / "broken-keys"
    copy_of(robot_keystore, root)
    camera = root / "enclaves" / "mobile_robot" / "camera"
    (camera / "key.pem").unlink()
    (camera / "key.pem").symlink_to(tmp_path / "elsewhere" / "key.pem")
    (camera / "permissions.p7s").write_bytes(b"nonsense")
    value = json.loads(sros("view", root, "--format", "json").ok().out)
    camera = next(e for e in value["enclaves"] if e["path"] == "/mobile_robot/camera")
    assert any("key.pem" in problem for problem in camera["problems"])
    assert any(f["severity"] == "error" for f in value["findings"])
    assert str(tmp_path) not in json.dumps(value)


def test_svg_is_whole_xml_without_anything_that_runs_or_loads(tmp_path: Path) -> None:
    path = tmp_path / "hostile.xml"
    path.write_text(hostile_permissions())
    shown = sros("view", path, "--format", "svg", "--all").ok().out
    root = etree.fromstring(shown.encode())
    names = {etree.QName(element).localname for element in root.iter(etree.Element)}
    assert names <= {"svg", "title", "style", "defs", "marker", "path", "rect", "text", "g"}
    attributes = {name for element in root.iter(etree.Element) for name in element.attrib}
    assert not any(name.startswith("on") or "href" in name for name in attributes)
    texts = "".join(root.itertext())
    assert HOSTILE[0] in texts  # as text, and all of it


def test_svg_has_each_color_itself_and_another_one_for_the_dark(tmp_path: Path) -> None:
    shown = (
        sros("view", REPOSITORY / "policies" / "talker_listener.xml", "--format", "svg").ok().out
    )
    style = shown[shown.index("<style>") + 7 : shown.index("</style>")]
    assert "var(" not in style  # CairoSVG and Qt draw black for it
    assert "$" not in style
    light, dark = style.split("@media (prefers-color-scheme:dark){")
    colored = r"([^{}]+)\{[^{}]*#[^{}]*\}"
    words = r"(?:fill|stroke|background):#\w{3,6}\b"
    rules = [[rule[1].strip() for rule in re.finditer(colored, part)] for part in (light, dark)]
    assert rules[0] == rules[1]
    assert len(re.findall(words, light)) == len(re.findall(words, dark)) > 20


def test_dot_can_hold_any_name(tmp_path: Path) -> None:
    path = tmp_path / "hostile.xml"
    path.write_text(hostile_permissions())
    shown = sros("view", path, "--format", "dot").ok().out
    # Outside of quoted strings nothing is left of the names.
    plain = re.sub(r'"(?:[^"\\]|\\.)*"', "", shown)
    assert re.fullmatch(r"[\w\s\[\]{}=,.;#>/-]*", plain), plain
    if shutil.which("dot"):
        run(["dot", "-Tsvg"], said=shown)


def test_mermaid_holds_no_letter_of_markup_in_a_label(tmp_path: Path) -> None:
    path = tmp_path / "hostile.xml"
    path.write_text(hostile_permissions())
    shown = sros("view", path, "--format", "mermaid").ok().out
    for label in re.findall(r'"([^"]*)"', shown):
        assert re.fullmatch(r"(?:<br/>|#\d+;|[A-Za-z0-9 /_.,:+-])*", label), label


def test_no_cell_of_the_table_is_empty_where_a_denial_alone_names_something(tmp_path: Path) -> None:
    rights = '<topics subscribe="DENY"><topic>/q</topic><topic>/arm/*</topic></topics>'
    (tmp_path / "p.xml").write_text(policy_text({"/z": rights}))
    table = sros("view", tmp_path / "p.xml", "--format", "markdown").ok().out
    assert "| topic `/q` | no enclave here | no enclave here, `/z` is denied |" in table
    assert "| topic `/arm/*` | no enclave here | no enclave here, `/z` is denied |" in table


def test_a_table_says_which_names_move_or_are_protected(tmp_path: Path) -> None:
    two = sros("view", tmp_path / "p.xml", tmp_path / "q.xml", "--format", "markdown")
    assert two.status == 2 and "For several policies of a robot or package, name their" in two.err
    relative = '<topics publish="ALLOW"><topic>width</topic><topic>/tf</topic></topics>'
    absolute = '<topics subscribe="ALLOW"><topic>/width</topic></topics>'
    action = '<actions execute="ALLOW"><action>grasp</action></actions>'
    protected = publish('x<?sros protect="sign"?>', '/y<?sros protect="encrypt"?>')
    legend = "absolute names stay.\n"
    for rights, rows, end in (
        ({"/a": relative, "/b": absolute}, ("`/width` (relative for some nodes) |",), legend),
        ({"/a": relative + action}, ("`/width` (relative) |", "`/grasp` (rel", "`/tf` |"), legend),
        ({"/a": protected}, ("`/x` (relative; at least signed) |", "`/y` (encrypted) |"), legend),
        ({"/a": absolute}, (), "All names are absolute: the namespaces of"),
    ):
        (tmp_path / "p.xml").write_text(policy_text(rights))
        table = sros("view", tmp_path / "p.xml", "--format", "markdown").ok().out
        assert all(row in table for row in (*rows, end)), table
    (tmp_path / "permissions.xml").write_text(hostile_permissions())
    signed = sros("view", tmp_path / "permissions.xml", "--format", "markdown").ok().out
    assert "relative" not in signed and "absolute" not in signed  # DDS has only absolute names


def test_a_table_has_every_right_that_not_every_node_needs(tmp_path: Path) -> None:
    picture = mobile_robot()
    table = sros("view", MOBILE_ROBOT, "--format", "markdown").ok().out
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in table.splitlines() if line[:1] == "|"]
    cells = {name.split("`")[1]: (senders, receivers) for name, senders, receivers in rows[2:]}
    for edge in picture.edges:
        if not edge.common:
            assert f"`{edge.enclave}`" in cells[edge.name][not edge.sends], edge
    assert cells["/cmd_vel"][0].strip() == "`/mobile_robot/velocity_mux`"
    assert "`/mobile_robot/recorder` is denied by `/front_camera/*`" in table
    for name, sides in cells.items():
        lacks = {drawn_name.lacks for drawn_name in picture.names if drawn_name.name == name}
        texts = zip((Lack.SENDER, Lack.RECEIVER), sides, strict=True)
        lacking = {side for side, text in texts if text.strip().startswith("no enclave here")}
        assert lacking == lacks - {Lack.NOTHING}
    every = sros("view", MOBILE_ROBOT, "--format", "markdown", "--all").ok().out
    assert "`/parameter_events`" in every and "`/parameter_events`" not in table
    (tmp_path / "hostile.xml").write_text(hostile_permissions())
    hostile = sros("view", tmp_path / "hostile.xml", "--format", "markdown").ok().out
    table_rows = [line for line in hostile.splitlines() if line[:1] == "|"]
    assert len(table_rows) > 2
    for table_row in table_rows:  # three cells, whatever names are in them
        assert len(re.findall(r"(?<!\\)\|", table_row)) == 4, table_row
    two = sros("view", MOBILE_ROBOT, MOBILE_ROBOT, "--format", "markdown")
    assert two.status == 2 and "`sros diff_policy A B --format markdown`" in two.err


def test_json_is_complete() -> None:
    picture = mobile_robot()
    value = json.loads(sros("view", MOBILE_ROBOT, "--json").ok().out)
    assert value["version"] == 1
    assert len(value["edges"]) == len(picture.edges)
    scan = [e for e in value["edges"] if e["name"] == "/scan" and e["right"] == "publish"]
    assert [(e["enclave"], e["direction"], e["qualifier"]) for e in scan] == [
        ("/mobile_robot/lidar", "to the name", "ALLOW")
    ]
    assert set(value) >= {"enclaves", "names", "validities", "findings", "overlay", "origins"}


def test_graphs_hold_every_card_and_link_once() -> None:
    picture = mobile_robot()
    scene = scenes_of(picture)[0]
    nodes = {card.id if card.role == "names" else card.id[1:] for card in scene.cards}
    dot = render_dot(picture, scene)
    assert dot.count(" -> ") == len(scene.links)
    assert len(re.findall(r"^ +\"[^\"]+\" \[label", dot, re.M)) == len(nodes)
    mermaid = render_mermaid(picture, scene)
    assert mermaid.count('|"') == len(scene.links)
    assert "DENY subscribe" in dot and "DENY subscribe" in mermaid
    assert "arrowhead=tee" in dot and "--x" in mermaid
    # The rule is seldom "*" itself; the table names it.
    assert "subscribe by a wildcard" in dot and "subscribe by a wildcard" in mermaid


def test_svg_draws_every_name_of_the_scene() -> None:
    picture = mobile_robot()
    scene = scenes_of(picture)[0]
    root = etree.fromstring(render_svg(picture, scene).encode())
    texts = {element.text for element in root.iter("{*}text")}
    for card in scene.cards:
        assert set(card.lines) <= texts
        assert set(card.notes) <= texts
