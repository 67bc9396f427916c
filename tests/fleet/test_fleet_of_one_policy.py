"""A fleet from one policy and one fleet file: three commands, and the rights written by hand.

Fifty robots in the long form of the tests, sixteen otherwise.

The policy that is compared with is made by this file's own text, with the names filled in.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.api import fleet_status
from sros_tool.dds.permissions import Permissions, parse_permissions
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.keystore.describe import history
from sros_tool.keystore.fleet import left_enclaves, load_fleet, recorded_fleet
from sros_tool.keystore.layout import enclave_names
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki import smime
from sros_tool.policy.document import read_policy
from tests.support.children import LONG
from tests.support.harness import Ended, copy_of, policy_text, publish, snapshot, sros, topics_of

ROBOTS = sorted(f"r{number}" for number in range(1, 51 if LONG else 17))
CARRIERS = [name for name in ROBOTS if int(name[1:]) % 2]
COUNT = len(ROBOTS) + len(CARRIERS) + 1
"""The enclaves: one of each robot, one of each carrier, and the dispatcher."""
POLICY = """<policy version="0.2.0"><enclaves>
<enclave path="/{robot}/base"><profiles><profile ns="{namespace}" node="base">
<topics publish="ALLOW"><topic>odom</topic><topic>/fleet/{robot}/state</topic></topics>
<topics subscribe="ALLOW"><topic>~/cmd</topic></topics>
<topics publish="DENY"><topic>{namespace}/secret/*</topic></topics>
<services reply="ALLOW"><service>/{robot}_reset</service></services>
</profile></profiles></enclave>
<enclave path="/{robot:carriers}/lift"><profiles><profile ns="{namespace}/lift" node="{robot}_lift">
<actions execute="ALLOW"><action>raise</action></actions>
</profile></profiles></enclave>
<enclave path="/dispatcher"><profiles><profile ns="/" node="dispatcher">
<topics publish="ALLOW"><topic>{namespaces}/base/cmd</topic></topics>
<topics subscribe="ALLOW"><topic>/fleet/{robots}/state</topic></topics>
<actions call="ALLOW"><action>{namespaces:carriers}/lift/raise</action></actions>
</profile></profiles></enclave>
</enclaves></policy>"""


FLEET = ("--fleet", "fleet.toml")


def space(robot: str) -> str:
    return f"/hall/{robot}" if robot in CARRIERS else f"/{robot}"


def written_by_hand() -> str:
    text = ""
    for robot in ROBOTS:
        text += f"""<enclave path="/{robot}/base"><profiles>
<profile ns="{space(robot)}" node="base">
<topics publish="ALLOW"><topic>odom</topic><topic>/fleet/{robot}/state</topic></topics>
<topics subscribe="ALLOW"><topic>~/cmd</topic></topics>
<topics publish="DENY"><topic>{space(robot)}/secret/*</topic></topics>
<services reply="ALLOW"><service>/{robot}_reset</service></services>
</profile></profiles></enclave>"""
    for robot in CARRIERS:
        text += f"""<enclave path="/{robot}/lift"><profiles>
<profile ns="{space(robot)}/lift" node="{robot}_lift">
<actions execute="ALLOW"><action>raise</action></actions></profile></profiles></enclave>"""
    commands = "".join(f"<topic>{space(robot)}/base/cmd</topic>" for robot in ROBOTS)
    states = "".join(f"<topic>/fleet/{robot}/state</topic>" for robot in ROBOTS)
    lifts = "".join(f"<action>{space(robot)}/lift/raise</action>" for robot in CARRIERS)
    return f"""<policy version="0.2.0"><enclaves>{text}
<enclave path="/dispatcher"><profiles><profile ns="/" node="dispatcher">
<topics publish="ALLOW">{commands}</topics><topics subscribe="ALLOW">{states}</topics>
<actions call="ALLOW">{lifts}</actions></profile></profiles></enclave></enclaves></policy>"""


def fleet_file(robots: list[str] = ROBOTS, domain: int = 5) -> str:
    text = f'[groups.carriers]\nnamespace = "/hall/{{robot}}"\ndomain = {domain}\n[robots]\n'
    for robot in robots:
        groups = ', groups = ["carriers"]' if robot in CARRIERS else ""
        text += f'{robot} = {{ address = "10.0.0.{robot[1:]}"{groups} }}\n'
    return text


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "robot.xml").write_text(POLICY)
    (folder / "fleet.toml").write_text(fleet_file())
    for line in (
        "create_keystore ks --template production --domain 0,5",
        "generate_artifacts -k ks -p robot.xml --fleet fleet.toml",
        "distribute_key ks --robot r7 r7",
    ):
        sros(*line.split(), cwd=folder).ok()
    return folder


def left_lines(root: Path) -> set[tuple[str, str]]:
    """Return the enclaves in the ledger's last lines on robots that left, with their status."""
    items = history(OpenedKeystore(root), now=datetime.now(UTC)).entries
    lines = {item.entry.enclave: item.status.value for item in items if item.entry.what == "left"}
    return {*lines.items()}


def permissions(root: Path, name: str) -> Permissions:
    signed = smime.parse((root / f"enclaves{name}/permissions.p7s").read_bytes())
    return parse_permissions(signed.document)


def test_the_rights_of_each_robot_are_those_written_by_hand(made: Path) -> None:
    (made / "hand.xml").write_text(written_by_hand())
    hand = read_policy(made / "hand.xml")
    assert sorted(each.path for each in hand.enclaves) == list(enclave_names(made / "ks"))
    assert len(hand.enclaves) == COUNT
    sros("diff_policy", "hand.xml", "ks", cwd=made).ok()
    assert topics_of(made / "ks/enclaves/r7/base") == {
        "ros_discovery_info",
        "rt/hall/r7/odom",
        "rt/fleet/r7/state",
        "rt/hall/r7/base/cmd",
        "rt/hall/r7/secret/*",
        "rq/r7_resetRequest",
        "rr/r7_resetReply",
    }
    fleet = load_fleet(OpenedKeystore(made / "ks"))
    assert fleet
    policy = read_policy(made / "robot.xml", placeholders=True)
    assert dict(FleetPolicy(policy, fleet)) == {each.path: each for each in hand.enclaves}


def test_the_domain_of_a_robot_is_in_its_permissions_and_only_there(made: Path) -> None:
    for name, domains in (("/r1/base", "5"), ("/r1/lift", "5"), ("/r2/base", "0,5"),
                          ("/dispatcher", "0,5")):  # fmt: skip
        (grant,) = permissions(made / "ks", name).grants
        assert {str(rule.domains) for rule in grant.rules} == {domains}, name
    sros("explain", "ks", "/r1/base", "publish", "/hall/r1/odom", "--domain", "5", cwd=made).ok()
    refused = sros(
        "explain", "ks", "/r1/base", "publish", "/hall/r1/odom", "--domain", "0", cwd=made
    )
    assert refused.status == 1
    assert "ROS_DOMAIN_ID=5" in sros("env", "ks", "/r1/base", cwd=made).ok().out
    assert "domain 0" in sros("env", "ks", "/r1/base", "--domain", "0", cwd=made).err
    assert sros("env", "ks", "/r1/base", "--domain", "0", cwd=made).status == 2


def test_check_and_verify_find_nothing_wrong_with_it(made: Path) -> None:
    found = json.loads(sros("check", "ks", "--json", cwd=made).out)["findings"]
    assert [each for each in found if "domain" in each["id"] or "fleet" in each["id"]] == []
    sros("verify", "r7", "--domain", "5", cwd=made).ok()
    assert "loadable in domain 5 until" in sros("verify", "r7", cwd=made).ok().out
    assert sros("verify", "r7", "--domain", "0", cwd=made).status == 1


def test_the_keystore_knows_whose_enclave_is_whose(made: Path) -> None:
    assert sros("list_enclaves", "ks", "--robot", "r7", cwd=made).out == "/r7/base\n/r7/lift\n"
    assert sros("list_enclaves", "ks", "--robot", "r2", cwd=made).out == "/r2/base\n"
    assert sros("list_enclaves", "r7", cwd=made).out == "/r7/base\n/r7/lift\n"
    found = json.loads(sros("list_enclaves", "ks", "--json", cwd=made).out)["robots"]
    assert found == {name: name.split("/")[1] for name in enclave_names(made / "ks")
                     if name != "/dispatcher"}  # fmt: skip
    unknown = sros("list_enclaves", "ks", "--robot", "r70", cwd=made)
    assert unknown.status == 2
    assert "no robot 'r70'. It has r7" in unknown.err
    group = sros("list_enclaves", "ks", "--robot", "carriers", cwd=made).err
    first = ", ".join(sorted(CARRIERS, key=lambda name: int(name[1:]))[:5])
    assert f"has no robot 'carriers'. carriers is a group: {first}" in group
    exported = sros("list_enclaves", "r7", "--robot", "r7", cwd=made)
    assert "An export for a robot has only the enclaves of that robot" in exported.err


def copied(made: Path, folder: Path) -> Path:
    return copy_of(made, folder / "w")


@pytest.mark.parametrize("name", ["<r7/>", "r7/../r8", "{robot}", 'r7"><x a="', "r7*", "r 7"])
def test_a_hostile_name_of_a_robot_is_refused(made: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "fleet.toml").write_text(f"[robots.{json.dumps(name)}]\n")
    before = snapshot(made / "ks")
    words = (
        "generate_artifacts",
        "-k",
        "ks",
        "-p",
        "robot.xml",
        "--fleet",
        tmp_path / "fleet.toml",
    )
    ended = sros(*words, cwd=made)
    assert ended.status == 2
    assert "fleet.toml': robots has" in ended.err
    assert "such as r7" in ended.err
    assert snapshot(made / "ks") == before


def test_a_policy_with_placeholders_needs_a_fleet(made: Path) -> None:
    ended = sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", cwd=made)
    assert ended.status == 2
    assert "robot.xml:2: '/{robot}/base' has a placeholder" in ended.err
    assert "--fleet FILE" in ended.err
    words, of_fleet = (
        "create_permission ks --robot r7 robot.xml --dry-run",
        ("--fleet", "fleet.toml"),
    )
    assert "has a placeholder" in sros(*words.split(), cwd=made).err
    done = sros(*words.split(), *of_fleet, cwd=made).ok()
    assert "nothing would change" in done.out and "has a placeholder" not in done.err
    for fleet in ((), of_fleet):  # without the option, it is that of the keystore
        done = sros("metrics", "ks", "--policy", "robot.xml", "--earliest", *fleet, cwd=made).ok()
        assert "sros_findings" in done.out and not done.err


def test_a_policy_with_placeholders_explains_the_enclaves_of_its_keystore(made: Path) -> None:
    asked = ("/r7/lift", "execute", "/hall/r7/lift/raise", "--policy", "robot.xml")
    signed = sros("explain", "ks", *asked, cwd=made).ok()
    assert "from      robot.xml:9: ALLOW execute raise" in signed.out
    planned = sros("explain", *asked, "--fleet", "fleet.toml", cwd=made).ok()
    assert "from      robot.xml:9: ALLOW execute raise" in planned.out
    assert "Name the fleet's file with --fleet FILE" in sros("explain", *asked, cwd=made).err
    other = sros("explain", "ks", *asked[:3], "--fleet", "fleet.toml", cwd=made)
    assert "--fleet goes with a policy only" in other.err


def test_the_rights_of_every_node_are_not_next_to_the_policy(made: Path, tmp_path: Path) -> None:
    include = '<xi:include href="{}" xpointer="xpointer(/profile/*)"/>'
    for file, ships in (("common/node.xml", True), ("common/x.xml", False)):
        text = POLICY.replace("<topics", include.format(file) + "<topics", 1).replace(
            "<policy ", '<policy xmlns:xi="http://www.w3.org/2001/XInclude" ', 1
        )
        (tmp_path / "robot.xml").write_text(text)
        ended = sros("check", tmp_path / "robot.xml", "--fleet", made / "fleet.toml")
        assert f"{file}' does not exist" in ended.out
        assert ("sros policies --copy" in ended.out) is ships


def test_findings_that_are_the_same_for_many_robots_are_said_once(made: Path) -> None:
    fleet = FLEET
    folded = sros("check", "robot.xml", *fleet, cwd=made).out
    assert f"{COUNT} nodes lack rights that every node needs" in folded
    ended = sros("check", "robot.xml", *fleet, "--exclude", "policy.no-parameter-events", cwd=made)
    lines = ended.out.splitlines()
    rosout = [at for at, each in enumerate(lines) if each.endswith("[policy.no-rosout]")]
    assert len(rosout) == 3, "base, lift and the dispatcher"
    said = [lines[at + 3] if at + 3 < len(lines) else "" for at in rosout]
    assert [each.strip().partition(":")[0] for each in said if "the same" in each] == [
        f"the same for {len(ROBOTS) - 1} more robots",
        f"the same for {len(CARRIERS) - 1} more robots",
    ]
    counted = json.loads(sros("check", "robot.xml", *fleet, "--json", cwd=made).out)
    assert f"{counted['counts']['error'] - COUNT} errors" in ended.err
    ids = [each["id"] for each in counted["findings"]]
    assert ids.count("policy.no-rosout") == COUNT


def test_what_differs_in_the_robot_is_said_once(made: Path, tmp_path: Path) -> None:
    """Findings about the names of robots in one enclave, and the rights that robots gain."""
    folder = copied(made, tmp_path)
    policy = folder / "robot.xml"
    policy.write_text(policy.read_text().replace("/fleet/{robots}/state", "/fleet/{robots}/stat"))
    ended = sros("check", "robot.xml", "--fleet", "fleet.toml", cwd=folder)
    _, _, said = ended.out.partition("[policy.name-misspelt]")
    assert said and "policy.name-misspelt" not in said
    assert f"    the same for {len(ROBOTS) - 1} more robots: r" in said
    more = "<topic>odom</topic><topic>grip/force</topic>"
    policy.write_text(POLICY.replace("<topic>odom</topic>", more))
    again = sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", *FLEET, cwd=folder).ok()
    (gains,) = (line for line in again.err.splitlines() if " gains: " in line)
    assert gains.startswith("/{robot}/base gains: publish topic {namespace}/grip/force"), gains


def test_a_new_node_comes_to_one_robot_first(made: Path, tmp_path: Path) -> None:
    """As do its rights; and who makes its enclave otherwise is told what it lacks."""
    folder = copied(made, tmp_path)
    lamp = POLICY[POLICY.index("<enclave ") : POLICY.index("</enclave>")].replace("base", "lamp")
    (folder / "robot.xml").write_text(
        POLICY.replace("<topic>odom", "<topic>grip</topic><topic>odom").replace(
            "<enclave ", f"{lamp}</enclave>\n<enclave ", 1
        )
    )
    sros("fleet", "publish", "ks", "pub", cwd=folder).ok()
    names = enclave_names(folder / "ks")
    chosen = ("create_permission", "ks", "--robot", "r7", "robot.xml", *FLEET)
    said = sros(*chosen, "--dry-run", cwd=folder).ok().err
    assert "note [enclave.left-out]: " in said and ": /r7/lamp. " in said
    first = ("generate_artifacts", "-k", "ks", "-p", "robot.xml", *FLEET, "--robot", "r7")
    assert "has no robot 'r70'" in sros(*first[:-1], "r70", cwd=folder).err
    bare = copy_of(folder / "ks", folder / "bare")
    done = sros(*first, cwd=folder).ok()
    assert done.out.splitlines() == [
        "created enclave /r7/lamp",
        "replaced the permissions of enclave /r7/base",
    ]
    assert {*enclave_names(folder / "ks")} == {*names, "/r7/lamp"}
    assert "left-out" not in sros(*chosen, cwd=folder).ok().err
    said = sros("fleet", "publish", "ks", "pub", "--dry-run", cwd=folder).ok().out
    assert "new releases of 1 robot" in said
    # By hand, it is an enclave of no robot, and no release has it.
    for verb in (
        ("create_enclave", bare, "/r7/lamp"),
        ("create_permission", bare, "/r7/lamp", "robot.xml", *FLEET),
        ("distribute_key", bare, "/r7/lamp", "lamp"),
    ):
        said = sros(*verb, cwd=folder).ok().err
        assert "note [fleet.unrecorded]: /r7/lamp belongs to no robot" in said, verb
        assert "robots that fetch" not in said


def test_a_robot_is_not_chosen_without_its_enclaves(made: Path, tmp_path: Path) -> None:
    policy = tmp_path / "policy.xml"
    chosen = ("generate_artifacts", "-k", "ks", "-p", policy, *FLEET, "--robot", "r8", "--dry-run")
    for paths, expected in (
        (("/{robot}/base", "/r8/lift"), "would leave out /r8/lift. A path"),
        (("/{robot:carriers}/lift", "/r8/base"), "would leave out /r8/base. A path"),
        (("/desk/r8",), "would leave out /desk/r8. A path"),
        (("/{robot}/base", "/desk/r8"), ""),
        (("/{robot:carriers}/lift",), "no enclave for the robot r8"),
    ):
        policy.write_text(policy_text({path: publish("x") for path in paths}))
        ended = sros(*chosen, cwd=made)
        assert ended.status == (2 if expected else 0) and expected in ended.err, ended.err


def test_what_happens_to_a_fleet(made: Path, tmp_path: Path) -> None:
    """Renewed and revoked by robot; a robot that leaves; a domain that changes; an edit by hand."""
    folder = copied(made, tmp_path)
    write_again = ("generate_artifacts", "-k", "ks", "-p", "robot.xml", "--fleet", "fleet.toml")
    record = (folder / "ks/fleet.toml").read_bytes()
    ended = sros("renew", "ks", "--robot", "r7", "--robot", "r8", cwd=folder).ok()
    assert ended.out == "".join(
        f"renewed enclave {each}\n" for each in ("/r7/base", "/r7/lift", "/r8/base")
    )
    ended = sros("revoke", "ks", "--robot", "r7", cwd=folder).ok()
    assert ended.out == "revoked enclave /r7/base\nrevoked enclave /r7/lift\n"
    assert "/r8/base" in enclave_names(folder / "ks")

    # A robot that leaves keeps its enclaves until they are revoked, as the note says.
    earlier = recorded_fleet(OpenedKeystore(folder / "ks"))
    (folder / "fleet.toml").write_text(fleet_file([r for r in ROBOTS if r not in ("r7", "r9")]))
    ended = sros(*write_again, cwd=folder).ok()
    assert "created" not in ended.out
    assert "no longer in the fleet, but its earlier enclaves /r9/base, /r9/lift stay" in ended.err
    assert "sros revoke ks --match '/r9/*'" in ended.err
    assert "r7" not in ended.err.replace("/r7", "")
    assert "the robot r9 is no longer in the fleet" in sros(*write_again, cwd=folder).ok().err
    timer = ("renew", "ks", "--all-expiring", "9000d")
    renewed = sros(*timer, cwd=folder)
    others = len([name for name in enclave_names(folder / "ks") if not name.startswith("/r9/")])
    assert (renewed.status, f"renewed {others} enclaves" in renewed.out) == (1, True), renewed
    assert (
        "not renewed: /r9/base, /r9/lift (of robots that left the fleet or their group: r9)"
        in renewed.err
    )
    kept = (folder / "ks/fleet.toml").read_text()
    for edited in ("", kept.replace("r10", "r9")):
        (folder / "ks/fleet.toml").write_text(edited)
        unsure = sros(*timer, "--dry-run", cwd=folder)
        assert (unsure.status, "not renewed: /r9/base" in unsure.err) == (1, True), unsure
        assert "is not the file that sros wrote" in unsure.err and "sros revoke" not in unsure.err
    (folder / "ks/fleet.toml").write_text(kept)
    left = "2 valid enclaves of robots that left the fleet or their group: /r9/base, /r9/lift. "
    assert f"{left}Revoke with `sros revoke" in sros("fleet", "status", "ks", cwd=folder).out
    assert not fleet_status(folder / "ks", now=datetime(2999, 1, 1, tzinfo=UTC)).left, "expired"
    assert "/hall/r9/base/cmd" not in str(permissions(folder / "ks", "/dispatcher"))
    assert "/hall/r11/base/cmd" in str(permissions(folder / "ks", "/dispatcher"))
    fleet = load_fleet(OpenedKeystore(folder / "ks"))
    assert fleet and "r9" not in fleet.robots and len(fleet.robots) == len(ROBOTS) - 2
    words = ("--include", "keystore.robot-left", "--json")
    found = json.loads(sros("check", "ks", *words, cwd=folder).out)["findings"]
    assert [each["text"] for each in found] == ["enclaves of r9: /r9/base, /r9/lift"]
    assert left_enclaves(OpenedKeystore(folder / "ks"), fleet) == dict.fromkeys(
        ("/r9/base", "/r9/lift"), "r9"
    )
    assert not left_enclaves(OpenedKeystore(folder / "ks"), earlier), "it may come back"
    rotated = sros("rotate_ca", "ks", "--next", "--dry-run", cwd=folder).ok().err
    assert "the robot r9 is no longer in the fleet" in rotated
    refused = sros("revoke", "ks", "--robot", "r9", cwd=folder)
    assert refused.status == 2
    assert "Name the enclaves themselves: --match '/r9/*'" in refused.err
    assert left_lines(folder / "ks") == {("/r9/base", "current"), ("/r9/lift", "current")}
    sros("revoke", "ks", "--match", "/r9/*", cwd=folder).ok()
    assert left_lines(folder / "ks") == {("/r9/base", "replaced"), ("/r9/lift", "replaced")}
    assert "/r9" not in sros(*timer, "--dry-run", cwd=folder).ok().err

    # Another domain is in all permissions, or refused.
    (folder / "fleet.toml").write_text(fleet_file([r for r in ROBOTS if r not in ("r7", "r9")], 6))
    ended = sros(*write_again, cwd=folder)
    assert ended.status == 2
    assert "is in domain 6, but the keystore is for domain 0,5" in ended.err
    (folder / "one.xml").write_text(
        POLICY.replace('<enclave path="/{robot:carriers}/lift">', "<!--").replace(
            '<enclave path="/dispatcher">', '--><enclave path="/dispatcher">'
        )
    )
    (folder / "fleet.toml").write_text(fleet_file([r for r in ROBOTS if r not in ("r7", "r9")], 0))
    ended = sros(
        "generate_artifacts", "-k", "ks", "-p", "one.xml", "--fleet", "fleet.toml", cwd=folder
    )
    assert ended.status == 2
    assert "according to the fleet file, enclave /r1/lift belongs to domain 0" in ended.err
    assert "Name the policies of all enclaves" in ended.err

    # Another domain of the keystore leaves the one of a robot as it is.
    sros("update_keystore", "ks", "--domain", "0,5,9", "--allow-looser", cwd=folder).ok()
    for name, domains in (("/r1/base", "5"), ("/r2/base", "0,5,9")):
        (grant,) = permissions(folder / "ks", name).grants
        assert {str(rule.domains) for rule in grant.rules} == {domains}, name
    ended = sros("update_keystore", "ks", "--domain", "0,9", cwd=folder)
    assert ended.status == 2
    assert "is in domain 5" in ended.err

    # An edit by hand is noticed before anything follows from it.
    text = (folder / "ks/fleet.toml").read_text()
    (folder / "ks/fleet.toml").write_text(text.replace("domain = 5", "domain = 0", 1))
    for line in ("renew ks --robot r1", "revoke ks --robot r1", "distribute_key ks --robot r1 x",
                 "create_enclave ks /new"):  # fmt: skip
        ended = sros(*line.split(), cwd=folder)
        assert ended.status == 2, line
        assert "fleet.toml' is not the file that sros wrote at" in ended.err
        assert "Take revoked robots out of the fleet file, and write" in ended.err, line
    # The refusal to revoke says what to revoke now: by the edited file, and by the paths.
    other_paths = 'enclaves = ["{namespace}/base"]\n[robots]\nr1 = {namespace = "/r2"}\n'
    for edited, names in (("[robots]\n", "--match '/r1/*'"), ("no fleet", "--match '/r1/*'"),
                          (other_paths, "/r1/base /r1/lift /r2/base")):  # fmt: skip
        (folder / "ks/fleet.toml").write_text(edited)
        ended = sros("revoke", "ks", "--robot", "r1", cwd=folder)
        assert f"To revoke now, name the enclaves: `sros revoke ks {names}`;" in ended.err
    sros("revoke", "ks", "--match", "/r1/*", "--dry-run", cwd=folder).ok()
    found = sros("check", "ks", "--include", "keystore.fleet-edited", cwd=folder)
    assert found.status == 1
    (folder / "fleet.toml").write_text(fleet_file())
    revoked = ("/r7/base", "/r7/lift", "/r9/base", "/r9/lift")
    create_again = ("generate_artifacts", "-k", "ks", "-p", "robot.xml", *FLEET, "-e", *revoked)
    (folder / "ks/fleet.toml").write_text("no fleet")
    assert "no robot of the fleet" not in sros(*create_again, "--dry-run", cwd=folder).ok().err
    kept_robots = [robot for robot in ROBOTS if robot not in ("r1", "r7", "r9")]
    (folder / "fleet.toml").write_text(fleet_file(kept_robots))
    for edited in ("no fleet", fleet_file(kept_robots)):
        (folder / "ks/fleet.toml").write_text(edited)
        left = sros(*create_again[:-5], "--dry-run", cwd=folder).ok().err
        assert left.count("/r1/base, /r1/lift belong to no robot of the fleet, but to a robot") == 1
        assert left.count("Until then, `sros renew --all-expiring` renews them.") == 1
    assert "ks/enclaves/r1/base/cert.pem" in sros(*timer, "--dry-run", cwd=folder).ok().out
    (folder / "fleet.toml").write_text(fleet_file())
    (folder / "ks/fleet.toml").write_text(other_paths)
    sros(*create_again, cwd=folder).ok()
    assert (folder / "ks/fleet.toml").read_bytes() == record, "without the paths of the edit"


def test_the_enclaves_that_policies_give_a_robot_are_listed(tmp_path: Path) -> None:
    """A robot needs their names to make its keys, before the keystore has the enclaves."""
    paths = ("/{robot}/base", "/{robot:arms}/hand", "/{robot}/arm", "/office")
    (tmp_path / "p.xml").write_text(policy_text({path: publish("x") for path in paths}))
    (tmp_path / "f.toml").write_text('[robots.r1]\ngroups = ["arms"]\n[robots.r2]\n')

    def listed(*options: str) -> Ended:
        return sros("list_enclaves", *options, cwd=tmp_path)

    options = ("-p", "p.xml", "--fleet", "f.toml")
    assert listed(*options, "--robot", "r1").ok().out == "/r1/arm\n/r1/base\n/r1/hand\n"
    assert listed(*options, "--match", "*base", "--match", "/o*").ok().out.split() == [
        *("/office", "/r1/base", "/r2/base")
    ]
    added_up = listed(*options, "--match", "*hand", "--robot", "r2").ok().out
    assert added_up == "/r1/hand\n/r2/arm\n/r2/base\n", "as for a keystore"
    found = json.loads(listed(*options, "--match", "*hand", "--json").ok().out)
    assert (found["keystore"], found["robots"]) == (None, {"/r1/hand": "r1"})
    for wrong in (("ks", *options), ("-p", "p.xml", "--robot", "r1"), ("--fleet", "f.toml")):
        assert listed(*wrong).status == 2
    assert "no enclave of the policies matches" in listed(*options, "--match", "/x").err
